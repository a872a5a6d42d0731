"""Prove a certificate again from its file, and check that it belongs to its gains and its spec."""

import json
from pathlib import Path
from typing import Any

from pwatrack.errors import CheckFailed, InvalidSpec, Problem
from pwatrack.lmi.audit import audit
from pwatrack.report.run_folder import INDEX, REFUSAL
from pwatrack.spec.load import load_spec


def verify(path: Path, spec: Path | None = None) -> list[str]:
    """Check a certificate, or a run folder that holds one.

    Args:
        path: certificate.json, or the folder it is in.
        spec: The spec it should belong to; without it, the one that run.json names, if that is still there.

    Returns:
        What was checked, in sentences.

    Raises:
        InvalidSpec: If a file cannot be read.
        CheckFailed: With everything that does not hold.
    """
    file = path if not path.is_dir() else _certificate_in(path)
    text = _read(file)
    faults = audit(text)
    if faults:
        raise CheckFailed(*(Problem(message=f"{file}: {fault}", subject=None) for fault in faults))
    content = json.loads(text)
    said = [_claim(proof, content["cells"]) for proof in content["proofs"]]
    said.append("every number was read as the decimal it is; the proof uses whole numbers only")
    faults = []
    gains = file.parent / "gains.json"
    if gains.is_file() and file.name != REFUSAL:
        beside = json.loads(_read(gains))
        faults += [
            f"{letter} in gains.json is not the one that was proved"
            for letter in ("K", "L")
            if beside.get(letter) != content[letter]
        ]
        said.append("it belongs to gains.json beside it")
    spec = spec or _named_spec(file.parent)
    if spec is not None:
        faults += _against_spec(content, spec)
        said.append(f"it belongs to {spec}: same bytes, same matrices")
    if faults:
        raise CheckFailed(*(Problem(message=f"{file}: {fault}", subject=None) for fault in faults))
    return said


def _certificate_in(folder: Path) -> Path:
    """Return the certificate of a run folder, or the refusal where there is only that."""
    refusal, certificate = folder / REFUSAL, folder / "certificate.json"
    return refusal if refusal.is_file() and not certificate.is_file() else certificate


def _claim(proof: dict[str, Any], cells: list[str]) -> str:
    if "Z" not in proof:
        return f"{proof['of']}: proved, rate {proof['rate']:g} 1/s, for changes below {proof['radius']:g}"
    names = ", ".join(f"'{cells[int(i)]}'" for i in proof["Z"])
    rate = f" at a rate of {proof['rate']:g} 1/s" if proof["rate"] else ""
    return f"{proof['of']}: proved impossible{rate}, by multipliers for {names}"


def _against_spec(content: dict[str, Any], path: Path) -> list[str]:
    spec = load_spec(path, content["parameters"])
    faults = [] if spec.sha256 == content["spec_sha256"] else [f"{path} has other bytes than the spec it was made for"]
    differ = [letter for letter in ("A", "B", "C") if getattr(spec.plant, letter).tolist() != content[letter]]
    return faults + [f"{letter} is not that of {path}" for letter in differ]


def _named_spec(folder: Path) -> Path | None:
    try:
        named = Path(json.loads((folder / INDEX).read_text(encoding="utf-8"))["spec"])
        return named if named.is_file() else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidSpec(Problem(message=f"cannot read {path}: {error}", subject=None)) from None
