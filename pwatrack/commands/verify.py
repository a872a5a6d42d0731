"""Prove a certificate again from its file, and make the files of its folder again from it and its spec."""

import json
import stat
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

from pwatrack.claims.bounds import BOUNDS
from pwatrack.claims.exact_text import CLOSE, decimal_texts
from pwatrack.claims.registry import STATEMENT
from pwatrack.commands.told import merged_as_told, told_design, told_gains
from pwatrack.control.goal import Given, Goal, LeastCost, demands
from pwatrack.errors import CheckFailed, InvalidSpec, Problem, PwatrackError
from pwatrack.export.stored import LARGEST, digest
from pwatrack.lmi.audit.certificate import audit
from pwatrack.lmi.audit.matrices import AuditFault
from pwatrack.lmi.audit.reading import number, parsed, refuses
from pwatrack.report.certificate import bound_content, subject_content
from pwatrack.report.controller import known_start, written
from pwatrack.report.figures import SIMULATED
from pwatrack.report.files import gain_content, proved_content
from pwatrack.report.kept_spec import load, spec_of
from pwatrack.report.run_folder import INDEX, REFUSAL, json_text
from pwatrack.spec.spec import Spec
from pwatrack.workflow.sizing import spec_sizes

CERTIFICATE, CONTROLLER = "certificate.json", "controller.json"
_ALONE = (  # of run.json, what no proof decides: what was simulated or found on the way, and how the run went
    *(
        "format",
        "spec",
        "simulation",
        "exit",
        "seconds",
        "answered",
        "versions",
        "remarks",
        "requirements",
        "conditions",
        "files",
    ),
    *("estimates", "tracked", "preview", "ensemble", "largest_box"),
)
_PARTLY = {"figures": SIMULATED, "uncertain": ("along_x_d",), "practical": ("exact_tracking",)}  # that have such keys
_WORDS = {"uncertain": "the uncertain parameters are", "limits": "the starts from which limits are kept are"}


def verify(path: Path, spec: Path | None = None) -> list[str]:
    """Check a certificate, or a run folder that holds one.

    What a proof speaks of is read from the spec; the files beside it are written again from the certificate and the
    spec, by what writes them, and compared whole.

    Args:
        path: certificate.json, or the folder it is in.
        spec: The spec it should belong to; without it, that of `spec_of`.

    Returns:
        What was checked, in sentences.

    Raises:
        InvalidSpec: If a file cannot be read.
        CheckFailed: With everything that does not hold.
    """
    file, text = certificate_text(path)
    said, faults = audit(text)
    if not faults:
        content, folder = parsed(text), file.parent
        faults += _misnamed(content, file)
        _tell_failed(file, said, faults)
    if not faults:
        said.append("every number was read as it is written; the proofs use fractions only")
        named, other = (spec, "") if spec else spec_of(_json(folder / INDEX) or {}, folder, content["spec_sha256"])
        try:
            if named is None:
                said.append("not compared with a spec: none is at hand; name it with --spec")
                if file.name != REFUSAL:
                    _compare("gains.json", folder, gain_content(*told_gains(content)), said, faults, exactly=True)
            else:
                described = load(named, content["set"])
                faults += _against_spec(content, described)
                changed = " with " * bool(content["set"]) + ", ".join(f"{k} = {v}" for k, v in content["set"].items())
                said += [f"it belongs to {named}{changed}: same plant, gains and goals", *filter(None, [other])]
                if not faults and not refuses(content):
                    _against_folder(content, folder, described, said, faults)
        except (AuditFault, KeyError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
            faults.append(f"it, or a file beside it, is not that of a run: {type(error).__name__}: {error}"[:200])
    if faults:
        raise CheckFailed(*(Problem(message=f"{file}: {fault}", subject=None) for fault in faults))
    beside = file.parent / REFUSAL
    if file.name == CERTIFICATE and content.get("practical") is not None and beside.is_file():
        verify(beside, spec)
        said.append(f"{REFUSAL} beside it proves that exact tracking is impossible")
    return said


def certificate_text(path: Path) -> tuple[Path, str]:
    """Return the certificate that a path is, or that is in the folder it is, and its text."""
    file = path if not path.is_dir() else _certificate_in(path)
    return file, _read(file)


def _certificate_in(folder: Path) -> Path:
    """Return the certificate of a run folder, or the refusal where there is only that."""
    refusal, certificate = folder / REFUSAL, folder / CERTIFICATE
    return refusal if refusal.is_file() and not certificate.is_file() else certificate


def _tell_failed(file: Path, said: list[str], faults: list[str]) -> None:
    """Add what a controller beside a certificate, in a run or an export, says that its run did not achieve."""
    told = (_json(file.parent / CONTROLLER) or {}).get("failed", []) if file.name == CERTIFICATE else []
    if isinstance(told, list) and all(isinstance(line, str) and line.isprintable() for line in told):
        said += [f"its run failed: {line}" for line in told]
    else:
        faults.append(f"'failed' in {CONTROLLER} is no list of texts on one line")


def _misnamed(content: dict[str, Any], file: Path) -> list[str]:
    """Return what keeps a file from being the certificate or the refusal of a run."""
    if content["claim"] != STATEMENT:
        return ["'claim' is not what a certificate of this format proves"]
    if file.name in (REFUSAL, CERTIFICATE) and refuses(content) != (file.name == REFUSAL):
        return [f"{REFUSAL} proves that there is no design, {CERTIFICATE} that there is one: this is the other"]
    return []


def _against_spec(content: dict[str, Any], spec: Spec) -> Iterator[str]:
    """Yield what of a certificate is not what the spec asks for."""
    impossible, asked = refuses(content), spec
    if not impossible:
        spec = merged_as_told(spec, content)
        if bool(content["uncertain"]) != bool(spec.objectives.uncertain):
            yield f"the uncertain parameters are not those of {spec.path}"
    listed = "elements" not in content["plant"]
    subject = subject_content(spec, (content["generator"] or {}).get("directions"), listed=listed)
    yield from (f"{name} is not that of {spec.path}" for name, value in subject.items() if content[name] != value)
    if content["spec_sha256"] != asked.sha256:
        yield f"{spec.path} has other bytes than the spec it was made for"
    norms = dict.fromkeys("KL", 0.0) if impossible else _norms(content, spec)
    for role, goal in spec.objectives.goals.items():
        part, letter = role.name, role.letter
        given = goal.gain if isinstance(goal, Given) else None
        proofs = [proof for proof in content["proofs"] if proof["of"] == part]
        if not impossible:
            yield from (f"{part}: {fault}" for fault in _missed(goal, norms[letter], proofs))
            if given is not None and content[letter] != decimal_texts(given):
                yield f"{letter} is not the one that {spec.path} gives"
        elif proofs and content[letter] != decimal_texts(given):
            yield f"{letter} is not the one that {spec.path} asks to be proved"
        elif proofs and number(proofs[0].get("rate", 0)) > Fraction(repr(demands(goal)[0])):
            yield f"{part}: a rate was refused that {spec.path} does not ask for"


def _norms(content: dict[str, Any], spec: Spec) -> dict[str, float]:
    """Return the norms of both gains in the sizes of a spec."""
    K, L, _ = told_gains(content)
    return dict(zip("KL", spec_sizes(spec).norms(K, L), strict=True))


def _missed(goal: Goal, norm: float, proofs: list[dict[str, Any]]) -> Iterator[str]:
    """Yield what of a goal is not proved."""
    rates = [number(proof["rate"]) for proof in proofs if "rate" in proof]
    least, most = demands(goal)
    if not rates or max(rates) < Fraction(repr(least)):
        yield f"the rate asked for, {least:g} 1/s, is not proved"
    if norm > most * (1 + CLOSE):
        yield f"the gain has a norm of {norm:.6g}, above the bound {most:g}"
    if isinstance(goal, LeastCost):
        wanted = decimal_texts(goal.Q), decimal_texts(goal.R)
        if not any((proof.get("Q"), proof.get("R")) == wanted for proof in proofs):
            yield "the bound of the cost asked for is not there"


def _against_folder(content: dict[str, Any], folder: Path, spec: Spec, said: list[str], faults: list[str]) -> None:
    """Make a certificate and the files beside it again, and add what was compared and what differs."""
    try:
        controller = told_design(spec, content)
    except PwatrackError as refusal:
        faults += [f"{spec.path} is refused: {problem.message}" for problem in refusal.problems]
        return
    made = written(spec, controller, known_start(spec, controller))
    for name in _different(content, parsed(made.certificate), exactly=True):
        faults.append(f"{_WORDS.get(name, name + ' is')} not {'those' if name in _WORDS else 'that'} of {spec.path}")
    _compare("gains.json", folder, gain_content(*told_gains(content)), said, faults, exactly=True)
    _compare(BOUNDS, folder, bound_content(spec, controller), said, faults)
    _compare("generator.json", folder, made.generator, said, faults)
    if made.controller is not None and (told := _json(folder / CONTROLLER)) is not None:
        again = made.controller | {"sha256": digest(told), "failed": told.get("failed")}
        other = spec.scenario.conditions.sampling is None and told.get("program") is not None  # that of another file
        _compare(CONTROLLER, folder, again, said, faults, ["program"] * other)
    _compare(INDEX, folder, proved_content(spec, controller), said, faults, _ALONE)


def _compare(
    name: str,
    folder: Path,
    made: Any,
    said: list[str],
    faults: list[str],
    alone: Sequence[str] = (),
    *,
    exactly: bool = False,
) -> None:
    """Compare a file with what was made again, but for keys that it alone tells; which ones, is said."""
    told = _json(folder / name)
    if told is None:
        return
    made, left = {} if made is None else json.loads(json_text(made)), [key for key in told if key in alone]
    told = {key: value for key, value in told.items() if key not in alone}
    made = {key: value for key, value in made.items() if key not in alone}
    for key in _PARTLY if name == INDEX else ():
        if isinstance(told.get(key), dict) and key in made:
            own = [one for one in told[key] if one in _PARTLY[key]]
            told[key] = {one: value for one, value in told[key].items() if one not in own}
            made[key] = {one: value for one, value in made[key].items() if one not in _PARTLY[key]}
            left += [f"{key}.{one}" for one in own]
    wrong = _different(told, made, exactly=exactly)
    faults += [f"{', '.join(wrong)} in {name} is not what was proved"] * bool(wrong)
    said.append(f"{name} beside it tells the same{', but for what it alone tells: ' * bool(left)}{', '.join(left)}")


def _different(told: dict[str, Any], made: dict[str, Any], *, exactly: bool) -> list[str]:
    """Return the keys of one of two objects that the other has not, or otherwise."""
    return [
        key
        for key in dict.fromkeys((*made, *told))
        if key not in told
        or key not in made
        or not (told[key] == made[key] if exactly else _same(told[key], made[key]))
    ]


def _same(told: Any, made: Any, scale: float | None = None) -> bool:
    """Say whether two trees are one, doubles but for `CLOSE` of their size, or that of the largest beside them."""
    if isinstance(made, dict) and isinstance(told, dict):
        return made.keys() == told.keys() and all(_same(told[key], value) for key, value in made.items())
    if isinstance(made, list) and isinstance(told, list):
        scale = _largest(made) if scale is None else scale
        return len(made) == len(told) and all(_same(*both, scale) for both in zip(told, made, strict=True))
    if isinstance(made, float) and isinstance(told, float):
        return told == made or abs(told - made) <= CLOSE * max(abs(made), scale or 0.0)
    return type(told) is type(made) and bool(told == made)


def _largest(values: Any) -> float:
    """Return the size of the largest double in nested lists."""
    if isinstance(values, list):
        return max(map(_largest, values), default=0.0)
    return abs(values) if isinstance(values, float) else 0.0


def _json(path: Path) -> Any:
    """Return what a JSON file holds that is a mapping, or None if there is no such file."""
    try:
        content = parsed(_read(path), float) if path.is_file() else None
    except AuditFault as fault:
        raise CheckFailed(Problem(message=f"{path}: {fault}", subject=None)) from None
    except (ValueError, RecursionError):
        raise CheckFailed(Problem(message=f"{path} is not JSON", subject=None)) from None
    if content is not None and not isinstance(content, dict):
        raise CheckFailed(Problem(message=f"{path} holds no mapping", subject=None))
    return content


def _read(path: Path) -> str:
    try:
        found = path.stat()
        if not stat.S_ISREG(found.st_mode):
            raise InvalidSpec(Problem(message=f"{path} is no regular file", subject=None))
        if found.st_size > LARGEST:
            message = f"{path} has {found.st_size:,} bytes, at most {LARGEST:,} are read"
            raise InvalidSpec(Problem(message=message, subject=None))
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidSpec(Problem(message=f"cannot read {path}: {error}", subject=None)) from None
