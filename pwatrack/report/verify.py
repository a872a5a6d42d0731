"""Prove a certificate again from its file, and check that the files of its folder and its spec tell the same story."""

import json
import stat
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from pwatrack.ball_matrix import BallMatrix
from pwatrack.control.bounds import Loops
from pwatrack.control.compensation import compensation
from pwatrack.control.generator import assumption_2_shift, tracking_dynamics
from pwatrack.control.goal import Given, Goal, LeastCost, demands
from pwatrack.errors import CheckFailed, InvalidSpec, Problem
from pwatrack.export.stored import LARGEST
from pwatrack.lmi.audit.certificate import audit, refuses
from pwatrack.lmi.audit.matrices import Fault
from pwatrack.lmi.audit.reading import number
from pwatrack.model.merging import Merge, merges
from pwatrack.model.scalar_form import scalar_form
from pwatrack.report.bounds import BOUNDS
from pwatrack.report.certificate import (
    CLAIM,
    corner_content,
    decimals,
    generator_content,
    merged_content,
    output_form,
    subject_content,
)
from pwatrack.report.run_folder import INDEX, REFUSAL, named_spec
from pwatrack.spec.corners import corners
from pwatrack.spec.load import load_spec
from pwatrack.spec.spec import Spec
from pwatrack.study.limiting import room_within_limits
from pwatrack.study.merged import merged_spec
from pwatrack.study.sizing import spec_sizes
from pwatrack.study.tracking import desired_trajectory

CERTIFICATE = "certificate.json"
_CLOSE = 1e-12  # relative: figures that are computed again


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
    said, faults = audit(text)
    if not faults:
        faults += _misnamed(json.loads(text), file)
    if not faults:
        said.append("every number was read as it is written; the proofs use fractions only")
        content, index = json.loads(text, parse_float=str), _json(file.parent / INDEX)
        named = spec or _named_spec(index, file.parent)
        described = None if named is None else load_spec(named, content["set"])
        try:
            if described is None:
                said.append("not compared with a spec: none is at hand; name it with --spec")
            else:
                faults += _against_spec(content, described)
                changed = " with " * bool(content["set"]) + ", ".join(f"{k} = {v}" for k, v in content["set"].items())
                said.append(f"it belongs to {named}{changed}: same plant, gains and goals")
            if file.name != REFUSAL and not faults:
                for name, fault in _against_folder(content, file.parent, index, described):
                    faults += [fault] if fault else []
                    said.append(f"{name} beside it tells the same")
        except (Fault, KeyError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
            faults.append(f"it, or a file beside it, is not that of a run: {type(error).__name__}: {error}"[:200])
    if faults:
        raise CheckFailed(*(Problem(message=f"{file}: {fault}", subject=None) for fault in faults))
    beside = file.parent / REFUSAL
    if file.name == CERTIFICATE and content.get("practical") is not None and beside.is_file():
        verify(beside, spec)
        said.append(f"{REFUSAL} beside it proves that exact tracking is impossible")
    return said


def _certificate_in(folder: Path) -> Path:
    """Return the certificate of a run folder, or the refusal where there is only that."""
    refusal, certificate = folder / REFUSAL, folder / CERTIFICATE
    return refusal if refusal.is_file() and not certificate.is_file() else certificate


def _misnamed(content: dict[str, Any], file: Path) -> list[str]:
    """Return what keeps a file from being the certificate or the refusal of a run."""
    sets = content.get("set")
    if not isinstance(sets, dict) or not all(isinstance(value, str) for value in sets.values()):
        return ["not a certificate of a run: 'set' holds no texts"]
    if not isinstance(content.get("spec_sha256"), str) or ("bounds" not in content and file.name != REFUSAL):
        return ["not a certificate of a run: 'spec_sha256' or 'bounds' is missing"]
    if content.get("claim") != CLAIM:
        return ["'claim' is not what a certificate of this format proves"]
    refusal = refuses(content)
    if file.name in (REFUSAL, CERTIFICATE) and refusal != (file.name == REFUSAL):
        return [f"{REFUSAL} proves that there is no design, {CERTIFICATE} that there is one: this is the other"]
    return []


def _against_spec(content: dict[str, Any], spec: Spec) -> list[str]:
    """Return what of a certificate is not what the spec asks for."""
    practical, missing = content.get("practical"), list[str]()
    if practical is not None:
        ways = _ways(practical, spec)
        wanted = merged_content(spec, ways) if ways else {}
        missing = [f"what is merged, in practical, is not that of {spec.path}"] * (
            any(practical.get(name) != value for name, value in wanted.items()) or not wanted
        )
        spec = merged_spec(spec, ways, watched=practical["observer_runs"] == "all cells")
    listed = "elements" not in content["plant"]
    subject = subject_content(spec, (content["generator"] or {}).get("directions"), listed=listed)
    faults = missing + [
        f"{name} is not that of {spec.path}"
        for name in ("tracking", "plant", "generator")
        if content[name] != subject[name]
    ]
    impossible = refuses(content)
    faults += [] if impossible else _other_box(content.get("uncertain"), spec)
    faults += _other_starts(content.get("limits"), spec)
    if content["spec_sha256"] != spec.sha256:
        faults.append(f"{spec.path} has other bytes than the spec it was made for")
    norms = {} if impossible else _norms(content, spec)
    for role, goal in spec.objectives.goals.items():
        part, letter = role.name, role.letter
        given = goal.gain if isinstance(goal, Given) else None
        proofs = [proof for proof in content["proofs"] if proof["of"] == part]
        if not impossible:
            faults += [f"{part}: {fault}" for fault in _missed(goal, norms[letter], proofs)]
        elif proofs and content[letter] != decimals(given):
            faults.append(f"{letter} is not the one that {spec.path} asks to be proved")
        elif proofs and number(proofs[0]["rate"]) > Fraction(repr(demands(goal)[0])):
            faults.append(f"{part}: a rate was refused that {spec.path} does not ask for")
        if given is not None and not impossible and content[letter] != decimals(given):
            faults.append(f"{letter} is not the one that {spec.path} gives")
    return faults


def _ways(practical: Any, spec: Spec) -> list[Merge]:
    """Return what is merged, as it would be in the plant of a spec; nothing where that has not such elements."""
    form = scalar_form(spec.problem.plant)
    if form is None:
        return []
    places = {(way.element, way.first, way.last): way for k in range(len(form.elements)) for way in merges(form, k)}
    found = [places.get((one["element"], one["first"], one["last"])) for one in practical["merged"]]
    return [way for way in found if way is not None] if None not in found else []


def _other_box(uncertain: Any, spec: Spec) -> list[str]:
    """Return whether the corners of uncertain parameters are not those that the spec asks for."""
    box = spec.objectives.uncertain
    wanted = None
    if box and uncertain is not None:
        wanted = corner_content(spec, corners(spec.problem.parametric, spec.problem.plant, box))
    found = None if uncertain is None else {name: uncertain[name] for name in ("parameters", "corners")}
    return (
        [f"the uncertain parameters are not those of {spec.path}"]
        if found != wanted or bool(box) != bool(found)
        else []
    )


def _other_starts(limits: Any, spec: Spec) -> list[str]:
    """Return whether the starts from which inputs keep their limits are not those of the spec."""
    if not limits:
        return []
    found = room_within_limits(spec, *desired_trajectory(spec, True), spec_sizes(spec))
    wanted = {one.kind: one.G for one in (() if found is None else found.starts)}
    for entry in limits:
        G = np.array([[float(number(v)) for v in row] for row in entry["starts"]])
        other = wanted.get(entry["of"])
        if (
            other is None
            or G.shape != other.shape
            or not np.allclose(G, other, rtol=_CLOSE, atol=_CLOSE * np.abs(G).max())
        ):
            return [f"the starts from which limits are kept are not those of {spec.path}"]
    return []


def _norms(content: dict[str, Any], spec: Spec) -> dict[str, float]:
    """Return the norms of both gains in the sizes of a spec."""
    K, L = (np.array([[float(number(v)) for v in row] for row in content[letter]]) for letter in ("K", "L"))
    return dict(zip(("K", "L"), spec_sizes(spec).norms(K, L), strict=True))


def _missed(goal: Goal, norm: float, proofs: list[dict[str, Any]]) -> Iterator[str]:
    """Yield what of a goal is not proved."""
    rates = [number(proof["rate"]) for proof in proofs if "rate" in proof]
    least, most = demands(goal)
    if not rates or max(rates) < Fraction(repr(least)):
        yield f"the rate asked for, {least:g} 1/s, is not proved"
    if norm > most * (1 + _CLOSE):
        yield f"the gain has a norm of {norm:.6g}, above the bound {most:g}"
    if isinstance(goal, LeastCost):
        wanted = decimals(goal.Q), decimals(goal.R)
        if not any((proof.get("Q"), proof.get("R")) == wanted for proof in proofs):
            yield "the bound of the cost asked for is not there"


def _against_folder(content: dict[str, Any], folder: Path, index: Any, spec: Spec | None) -> Iterator[tuple[str, str]]:
    """Yield each file of the folder that was looked at, and what is wrong with it ('' for nothing)."""
    if spec is not None and (practical := content.get("practical")) is not None:
        spec = merged_spec(spec, _ways(practical, spec), watched=practical["observer_runs"] == "all cells")
    if (gains := _json(folder / "gains.json")) is not None:
        wrong = [letter for letter in ("K", "L") if _exact(gains.get(letter)) != _exact(content[letter])]
        costs = {proof["of"]: _exact(proof["X"]) for proof in content["proofs"] if "X" in proof}
        given = {part: _exact(X) for part, X in gains.get("cost_bounds", {}).items()}
        wrong += ["cost_bounds"] * (given != costs)
        yield "gains.json", f"{' and '.join(wrong)} in gains.json is not the one that was proved" if wrong else ""
    if (generator := _json(folder / "generator.json")) is not None:
        subject = content["generator"] or {}
        told = "A_eta" in subject  # not where cells are not listed
        same = not told or all(_same(generator.get(name), subject.get(name)) for name in ("T", "A_eta"))
        if spec is not None and same:
            form = output_form(spec, subject.get("directions"))
            A_eta, B_eta, _ = tracking_dynamics(form)
            moved = assumption_2_shift(A_eta, B_eta[:, :, : form.r])
            same = generator == generator_content(form, moved, played_back=_played_back(content))
        if told or spec is not None:
            yield "generator.json", "" if same else "generator.json is not that of this plant"
    if (bounds := _json(folder / BOUNDS)) is not None:
        gains = [list(signal["peak_gain"]) for signal in _signals(bounds) if "peak_gain" in signal]
        same = _bounded(bounds, content) and (spec is None or gains == _peaks(content, spec))
        if spec is not None or not gains or not same:  # a peak gain is not in the certificate
            yield BOUNDS, "" if same else f"a bound in {BOUNDS} is not the one that was proved"
    if index is not None:
        figures, proved = index.get("figures", {}), dict[str, list[float]]()
        for proof in content["proofs"]:
            if "rate" in proof:
                proved.setdefault(f"{proof['of']}_rate", []).append(float(number(proof["rate"])))
        wrong = [name for name, rates in proved.items() if figures.get(name) != max(rates)]
        wrong += ["spec_sha256"] * (index.get("spec_sha256") != content["spec_sha256"])
        wrong += ["practical"] * (not _ends(index.get("practical"), content.get("practical")))
        wrong += ["limits"] * (not _kept(index.get("limits"), content.get("limits", [])))
        yield INDEX, f"{', '.join(wrong)} in {INDEX} is not what was proved" if wrong else ""


def _ends(told: Any, proved: Any) -> bool:
    """Say whether what the index tells of practical tracking is what a certificate proves."""
    shown = [signal["bound"] for signal in told["ends_below"].values() if signal["bound"]] if told else []
    sizes = [float(number(size)) for *_, size in proved["ends_below"]] if proved else []
    return [float(np.nextafter(size, np.inf)) for size in shown] == sizes


def _kept(told: Any, proved: list[dict[str, Any]]) -> bool:
    """Say whether what the index tells of limits is no more than what a certificate proves."""
    starts = told["starts"] if told else []
    moved = [entry for entry in starts if any(entry["inputs"].values())]
    if len(moved) != len(proved):
        return False
    left = {name: entry["left"] for name, entry in told["inputs"].items()} if told else {}
    return all(
        [float(np.nextafter(size, np.inf)) for size in entry["inputs"].values()]
        == [float(number(size)) for *_, size in entry_proved["signals"]]
        and all(entry["scale"] * (size + entry["loads"][name]) <= left[name] for name, size in entry["inputs"].items())
        for entry, entry_proved in zip(moved, proved, strict=True)
    )


def _signals(told: Any) -> list[Any]:
    """Return all bounds of signals in the table of bounds.json."""
    return [signal for entry in told["table"] for signal in entry["signals"].values()]


def _peaks(content: dict[str, Any], spec: Spec) -> list[list[float]]:
    """Return the peak gains of the gains of a certificate, in the order of the table."""
    output = spec.problem.tracking == "output"
    form = output_form(spec, (content["generator"] or {}).get("directions")) if output else None
    plant = spec.problem.plant if form is None else form.plant
    K, L = (BallMatrix.of([[number(v) for v in row] for row in content[letter]]) for letter in ("K", "L"))
    loops = Loops(plant, K, L, (), compensation(plant, form, 0, played_back=_played_back(content)).X, output=output)
    channels = [entry["channel"] for entry in content["bounds"] if entry["channel"][0] != "start"]
    found = [loops.peaks((kind, k)) for kind, k in channels]
    return [list(gain) for peaks in found for gain in peaks.values()]


def _played_back(content: dict[str, Any]) -> bool:
    return any("bounded" in proof for proof in content["proofs"])


def _bounded(told: Any, content: dict[str, Any]) -> bool:
    """Say whether bounds.json has the bounds of a certificate, and their sum for a start within the sizes."""
    box, shown = content["uncertain"], _signals(told)
    proofs = [*content["bounds"], *(box["bounds"] if box else [])]
    proved = [float(number(size)) for entry in proofs for *_, size in entry["signals"]]
    certified = [signal.get("certified", signal["at_worst"]) for signal in shown]
    if [float(np.nextafter(size, np.inf)) for size in certified] != proved:
        return False
    if any(
        signal["at_worst"] < min(signal["certified"], signal["peak_gain"][1]) for signal in shown if len(signal) > 3
    ):
        return False
    starts = [entry for entry in told["table"] if entry["kind"] in ("load", "start")]
    known, within = told["start_within_sizes"]["sizes"], told["start_within_sizes"]["signals"]
    n = len(content["plant"]["states"])
    sizes = [*list(known.values())[:n], *known.values()]
    return all(
        sum(size * entry["signals"][name]["at_worst"] for size, entry in zip(sizes, starts, strict=True))
        <= signal["at_worst"]
        <= 1e300
        for name, signal in within.items()
    )


def _exact(values: Any) -> Any:
    """Return nested lists of numbers, doubles or texts, as the fractions that they are written as."""
    if isinstance(values, list):
        return [_exact(value) for value in values]
    return number(repr(values) if isinstance(values, float) else values)


def _same(doubles: Any, texts: Any) -> bool:
    """Say whether nested lists of doubles are the doubles nearest to the numbers that are written."""
    if isinstance(doubles, list) and isinstance(texts, list):
        return len(doubles) == len(texts) and all(map(_same, doubles, texts))
    return isinstance(doubles, int | float) and not isinstance(texts, list) and float(number(texts)) == doubles


def _named_spec(index: Any, folder: Path) -> Path | None:
    named = named_spec(index, folder) if isinstance(index, dict) else Path()
    return named if named.is_file() else None


def _json(path: Path) -> Any:
    """Return what a JSON file holds that is a mapping, or None if there is no such file."""
    try:
        content = json.loads(_read(path)) if path.is_file() else None
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
