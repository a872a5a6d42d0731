"""Which specs a batch is about, and in which folder each of them leaves its run."""

import os
from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path

from pwatrack.errors import InvalidSpec

_ENDINGS = (".yaml", ".yml")


def find_specs(paths: Sequence[Path], pattern: str | None = None) -> dict[Path, Path]:
    """Return the specs among files and below folders, in order, each with a folder of its own for its run.

    Below a folder the path of a file, or its name, is like the pattern, as in a shell, or ends in .yaml or .yml.
    """
    found = dict[Path, Path]()
    known = set[Path]()
    for path in paths:
        if not path.exists():
            raise InvalidSpec(f"{path} is no folder and no file")
        specs = sorted(p for p in _named(path, pattern) if p.is_file()) if path.is_dir() else [path]
        for spec in specs:
            if (real := Path(os.path.realpath(spec))) not in known:
                known.add(real)
                found[spec] = spec.relative_to(path) if path.is_dir() else Path(spec.name)
    if not found:
        message = f"no {f'file like {pattern}' if pattern else '.yaml file'} in {', '.join(map(str, paths))}"
        raise InvalidSpec(message, hint="name folders that hold specs, or the specs")
    return _apart(found)


def left_out(paths: Sequence[Path], pattern: str | None = None) -> list[tuple[Path, str]]:
    """Return what is named like a spec below folders and is none, in order, with the reason."""
    return [
        (path, "no file of this name is where the link leads" if path.is_symlink() and not path.exists() else "no file")
        for folder in paths
        if folder.is_dir()
        for path in sorted(_named(folder, pattern))
        if not path.is_file() and not path.is_dir()
    ]


def run_name(spec: Path) -> str:
    """Return the name of a spec's run folder: that of the file without its ending, unless only dots are left.

    Example:
        >>> run_name(Path("specs/cart.yaml")), run_name(Path("..yaml"))
        ('cart', '..yaml')
    """
    return spec.stem if spec.stem.strip(".") else spec.name


def _named(folder: Path, pattern: str | None) -> list[Path]:
    def is_named(path: Path) -> bool:
        names = path.name, str(path.relative_to(folder))
        return path.suffix.lower() in _ENDINGS if pattern is None else any(fnmatchcase(n, pattern) for n in names)

    return list(filter(is_named, folder.rglob("*")))


def _apart(found: dict[Path, Path]) -> dict[Path, Path]:
    """Return folders for runs, all different: without the ending where that is enough."""
    short = [place.with_name(run_name(place)) for place in found.values()]
    places = dict[Path, Path]()
    for (spec, place), name in zip(found.items(), short, strict=True):
        folder, number = name if short.count(name) == 1 else place, 1
        while folder in places.values():
            number += 1
            folder = place.with_name(f"{place.name}~{number}")
        places[spec] = folder
    return places
