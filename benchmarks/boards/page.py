"""One page of the tables that the other boards have written, each with the command that makes it anew.

python -m benchmarks.boards.page [--out runs/boards]
"""

import argparse
import sys
from pathlib import Path

COMMANDS = {  # by the name of the table's file
    "drivetrain": "drivetrain",
    "drivetrain_design": "drivetrain_design",
    "compleib": "compleib FOLDER-OR-FILES",
    "sdplib": "sdplib FOLDER-OR-FILES --vsdp SDPLIB_SYS1.csv",
    "modelica": "modelica FOLDER",
}


def page(out: Path) -> str:
    """Return the page of the tables in a folder; those that are not there are left out.

    Example:
        >>> page(Path("no such folder")).strip()
        '# Boards of others'
    """
    parts, tables = ["# Boards of others\n"], ((out / f"{name}.md", command) for name, command in COMMANDS.items())
    for path, command in tables:
        if path.exists():
            title, rest = path.read_text(encoding="utf-8").split("\n", 1)
            parts.append(f"\n## {title.strip('*')}\n\n    python -m benchmarks.boards.{command}\n{rest}")
    return "".join(parts)


def main() -> None:
    """Write the page beside the tables, and say where."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/boards"))
    out = parser.parse_args().out
    (out / "boards.md").write_text(page(out), encoding="utf-8")
    sys.stdout.write(f"{out / 'boards.md'}\n")


if __name__ == "__main__":
    main()
