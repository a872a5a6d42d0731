"""The version of the program, for the package, the command line and every run."""

__version__ = "0.1.0"
