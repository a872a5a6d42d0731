"""The version of the program, for the package, the command line and every run."""

import platform
from functools import cache

__version__ = "0.1.0"


@cache
def versions() -> dict[str, str]:
    """Return the versions of the program and of what it computes with."""
    from importlib.metadata import version  # takes as long as all else of a file that cannot be read

    libraries = ("numpy", "scipy", "picos", "clarabel", "cvxopt", "python-flint")
    own = {"pwatrack": __version__, "python": platform.python_version()}
    return own | {name: version(name) for name in libraries}
