"""Specs to start from, and the schema beside them."""

from importlib.resources import files
from pathlib import Path

from pwatrack.errors import InvalidSpec
from pwatrack.report.run_folder import written_at_once
from pwatrack.spec.schema import schema_text

SCHEMA = "pwatrack.schema.json"


def write_starter(path: Path, kind: str) -> list[Path]:
    """Write a commented spec that runs, and its schema; return both paths. A file that is there is not replaced."""
    if path.exists():
        raise InvalidSpec(f"{path} exists", hint="name another file: 'pwatrack init other.yaml'")
    texts = {path: files("pwatrack.starters").joinpath(f"{kind}.yaml").read_text(encoding="utf-8")}
    texts[path.with_name(SCHEMA)] = schema_text()
    for target, text in texts.items():
        with written_at_once(target) as temporary:
            temporary.write_text(text.replace("spec.yaml", path.name), encoding="utf-8")
    return list(texts)
