"""`python -m pwatrack` is the command line."""

from pwatrack.cli import app


def run() -> None:
    """Entry point of the console script."""
    app(prog_name="pwatrack")


if __name__ == "__main__":
    run()
