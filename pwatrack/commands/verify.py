"""Prove a certificate again from its file, and make its design and the files of its folder again, without a solver."""

import json
from collections.abc import Collection, Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any, cast

import numpy as np

from pwatrack.arrays import CLOSE
from pwatrack.claims.bounds import BOUNDS
from pwatrack.claims.cost import read_costs
from pwatrack.claims.decay import read_proofs
from pwatrack.claims.exact_text import decimal_texts, doubles
from pwatrack.claims.practical import merged_ways
from pwatrack.claims.registry import STATEMENT, proved
from pwatrack.control.controller import ProvedController
from pwatrack.control.goal import Given, Goal, LeastCost, demands
from pwatrack.control.synthesis import Gains
from pwatrack.errors import CheckFailed, InvalidSpec, PwatrackError
from pwatrack.export.schema import Sampled
from pwatrack.export.stored import LARGEST, differing, digest, lists_of, with_played, with_sampling
from pwatrack.lmi.audit.certificate import audit
from pwatrack.lmi.audit.matrices import AuditFault
from pwatrack.lmi.audit.reading import number, parsed
from pwatrack.lmi.audit.shape import refuses
from pwatrack.lmi.dichotomy import Dichotomy
from pwatrack.remote_files import regular
from pwatrack.report.certificate import bound_content, output_form, subject_content
from pwatrack.report.controller import known_start, written
from pwatrack.report.figures import SIMULATED
from pwatrack.report.files import gain_content, proved_content
from pwatrack.report.kept_spec import load, spec_of
from pwatrack.report.run_folder import INDEX, REFUSAL, json_text, lacking
from pwatrack.spec.spec import Spec
from pwatrack.workflow.pipeline import asked
from pwatrack.workflow.simplified import merged_spec
from pwatrack.workflow.sizing import spec_sizes
from pwatrack.workflow.tracking import desired_trajectory

CERTIFICATE, CONTROLLER = "certificate.json", "controller.json"
_ALONE = [  # of run.json, what no proof decides: what was simulated or found on the way, and how the run went
    *("format", "spec", "simulation", "exit", "seconds", "answered", "versions"),
    *("remarks", "warnings", "questions", "margins", "requirements"),
    *("conditions", "files", "estimates", "tracked", "preview", "ensemble", "largest_box"),
]
_PARTLY = {"figures": SIMULATED, "uncertain": ("along_x_d",), "practical": ("exact_tracking",)}  # that have such keys
_WORDS = {"uncertain": "the uncertain parameters are", "limits": "the starts from which limits are kept are"}
_WORDS |= {"set_points": "the intervals that set-points take are"}
_PLAYED = (
    f"{CONTROLLER} beside it plays back another x_d than is worked out here, as other processors do: what that leaves "
    "was enclosed again"
)
_NOT_TOLD = cast(Any, None)  # what exact proofs were made from: no file has it, and nothing is written from it


def verify(path: Path, spec: Path | None = None) -> list[str]:
    """Check a certificate, or a run folder that holds one, and return in sentences what was checked.

    What a proof speaks of is read from the spec, by default that of `spec_of`; the files beside it are written again
    from the certificate and the spec, by what writes them, and compared whole. Raises InvalidSpec if a file cannot be
    read, CheckFailed with everything that does not hold.
    """
    file, text = certificate_text(path)
    said, faults = audit(text)
    if not faults:
        content, folder = parsed(text), file.parent
        told = (_json(folder / CONTROLLER) or {}).get("failed", []) if file.name == CERTIFICATE else []
        if content["claim"] != STATEMENT:
            faults.append("'claim' is not what a certificate of this format proves")
        elif file.name in (REFUSAL, CERTIFICATE) and refuses(content) != (file.name == REFUSAL):
            faults.append(
                f"{REFUSAL} proves that there is no design, {CERTIFICATE} that there is one: this is the other"
            )
        if isinstance(told, list) and all(isinstance(line, str) and line.isprintable() for line in told):
            said += [f"its run failed: {line}" for line in told]  # what a run or an export says beside it
        else:
            faults.append(f"'failed' in {CONTROLLER} is no list of texts on one line")
    if not faults:
        said.append("every number was read as it is written; the proofs use fractions only")
        named, other = (spec, "") if spec else spec_of(_json(folder / INDEX) or {}, folder, content["spec_sha256"])
        try:
            if named is None:
                said.append(f"not compared with a spec: none is at hand; name it with --spec{_unseen(file)}")
                if file.name != REFUSAL:
                    _compare("gains.json", folder, _told_gains(content), said, faults, exactly=True)
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
        raise CheckFailed(*(f"{file}: {fault}" for fault in faults))
    beside = file.parent / REFUSAL
    if file.name == CERTIFICATE and content.get("practical") is not None and beside.is_file():
        verify(beside, spec)
        said.append(f"{REFUSAL} beside it proves why exact tracking is refused")
    return said


def told_design(spec: Spec, content: dict[str, Any]) -> ProvedController:
    """Return the design that an audited certificate tells, or raise ValueError where it does not fit the spec."""
    true = spec.problem.plant
    spec = _merged_as_told(spec, content)
    form = output_form(spec, content["generator"]["directions"]) if content["generator"] else None
    trajectory = desired_trajectory(spec, True, form)
    generator = trajectory.generator
    plant = spec.problem.plant if generator is None else generator.form.plant
    proofs = read_proofs(content)
    for proof in proofs:
        if isinstance(proof, Dichotomy) and generator is not None:
            trajectory = replace(trajectory, generator=replace(generator, certificate=proof))
    K, L = (doubles(content[name]) for name in ("K", "L"))
    cheaper = None if (least := content.get("K_of_least_cost")) is None else doubles(least)
    controller = ProvedController(
        plant=plant,
        running=plant if content["practical"] is None else true,
        design=Gains(K=K, L=L, controller=_NOT_TOLD, observer=_NOT_TOLD, cheaper=cheaper),
        trajectory=trajectory,
        proofs=tuple(proof for proof in proofs if not isinstance(proof, Dichotomy)),
        sizes=spec_sizes(spec),
    )
    return proved(controller, asked(spec, controller, content), told=content)


def _merged_as_told(spec: Spec, content: dict[str, Any]) -> Spec:
    """Return the spec that a certificate is about: with those cells merged that are merged there."""
    practical = content["practical"]
    if practical is None:
        return spec
    ways = merged_ways(practical["merged"], spec.problem.plant)
    return merged_spec(spec, ways, watched=practical["observer_runs"] == "all cells")


def _told_gains(content: dict[str, Any]) -> dict[str, Any]:
    return gain_content(doubles(content["K"]), doubles(content["L"]), read_costs(content))


def certificate_text(path: Path) -> tuple[Path, str]:
    """Return the certificate that a path is, or that is in the folder it is, and its text; a refusal, if only that."""
    if path.is_dir():
        found = next((path / name for name in (CERTIFICATE, REFUSAL) if (path / name).exists()), None)
        if found is None:
            raise lacking(path, CERTIFICATE)
        path = found
    return path, _read(path)


def _against_spec(content: dict[str, Any], spec: Spec) -> Iterator[str]:
    """Yield what of a certificate is not what the spec asks for."""
    impossible, asked = refuses(content), spec
    if not impossible:
        spec = _merged_as_told(spec, content)
        if bool(content["uncertain"]) != bool(spec.objectives.uncertain):
            yield f"the uncertain parameters are not those of {spec.path}"
    listed = "elements" not in content["plant"]
    subject = subject_content(spec, (content["generator"] or {}).get("directions"), listed=listed)
    yield from (f"{name} is not that of {spec.path}" for name, value in subject.items() if content[name] != value)
    if content["spec_sha256"] != asked.sha256:
        yield f"{spec.path} has other bytes than the spec it was made for"
    gains = [np.array(doubles(content[letter])) for letter in "KL" if not impossible]
    (n, m), (q, N) = spec.problem.plant.B.shape, spec.problem.plant.observed.C.shape
    if gains and [gain.shape for gain in gains] != [(m, n), (N, q)]:
        yield f"K and L are no gains of the plant of {spec.path}"
        return
    norms = dict(zip("KL", spec_sizes(spec).norms(*gains), strict=True)) if gains else {}
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


def _missed(goal: Goal, norm: float, proofs: list[dict[str, Any]]) -> Iterator[str]:
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
    known = _json(folder / CONTROLLER)
    if known is not None and known.get("program"):
        own = spec.scenario.conditions.sampling
        spec = as_exported(spec, Sampled.model_validate(known["program"]), folder)
        if own is not None and spec.scenario.conditions.sampling != own:
            h = known["program"]["sample_time"]
            said.append(f"exported at a sample time of its own, {h:g} s, where the spec has {own.sample_time:g} s")
    try:
        controller = told_design(spec, content)
        if controller.trajectory.preview is not None and known is not None:
            told = known["trajectory"]["reference"]
            if any(differing(told, lists_of(controller.trajectory)["reference"], "trajectory.reference")):
                spec = with_played(spec, told)
                controller = told_design(spec, content)
                said.append(_PLAYED)
    except PwatrackError as refusal:
        faults += [f"{spec.path} is refused: {problem.message}" for problem in refusal.problems]
        return
    made = written(spec, controller, known_start(spec, controller))
    for name in _different(content, parsed(made.certificate), exactly=True):
        faults.append(f"{_WORDS.get(name, name + ' is')} not {'those' if name in _WORDS else 'that'} of {spec.path}")
    _compare("gains.json", folder, _told_gains(content), said, faults, exactly=True)
    _compare(BOUNDS, folder, bound_content(spec, controller), said, faults)
    _compare("generator.json", folder, made.generator, said, faults)
    if made.controller is not None and known is not None:
        run = _json(folder / INDEX)
        if run is not None and bool(run.get("exit")) != bool(known.get("failed")):
            faults.append(f"{INDEX} ends with exit {run.get('exit')}, which is not what 'failed' in {CONTROLLER} says")
        again = made.controller | {"sha256": digest(known), "failed": known.get("failed")}
        _compare(CONTROLLER, folder, again, said, faults, ["failed"] * (run is None))
    _compare(INDEX, folder, proved_content(spec, controller), said, faults, _ALONE)


def as_exported(spec: Spec, program: Sampled | None, folder: Path) -> Spec:
    """Return a spec with the sample time of a program whose folder is none of a run: an export may have its own."""
    return with_sampling(spec, program, instead=not (folder / INDEX).is_file())


def _compare(
    name: str,
    folder: Path,
    made: Any,
    said: list[str],
    faults: list[str],
    alone: Collection[str] = (),
    *,
    exactly: bool = False,
) -> None:
    """Compare a file with what was made again, but for keys that it alone tells; which ones, is said."""
    told = _json(folder / name)
    if told is None:
        return
    left = [key for key in told if key in alone]
    told, made = (_without(tree, alone) for tree in (told, {} if made is None else json.loads(json_text(made))))
    for key, own in _PARTLY.items() if name == INDEX else ():
        if isinstance(told.get(key), dict) and key in made:
            left += [f"{key}.{one}" for one in told[key] if one in own]
            told[key], made[key] = _without(told[key], own), _without(made[key], own)
    wrong = _different(told, made, exactly=exactly)
    faults += [f"{', '.join(wrong)} in {name} is not what was proved"] * bool(wrong)
    said.append(f"{name} beside it tells the same{', but for what it alone tells: ' * bool(left)}{', '.join(left)}")


def _unseen(file: Path) -> str:
    """Say which files beside a certificate are made again from a spec alone."""
    names = [name for name in (CONTROLLER, BOUNDS, "generator.json", INDEX) if (file.parent / name).is_file()]
    return f"; {', '.join(names)} beside it {'are' if len(names) > 1 else 'is'} not looked at" * bool(names)


def _without(tree: dict[str, Any], keys: Collection[str]) -> dict[str, Any]:
    return {key: value for key, value in tree.items() if key not in keys}


def _different(told: dict[str, Any], made: dict[str, Any], *, exactly: bool) -> list[str]:
    """Return the keys of one of two objects that the other has not, or otherwise."""
    return [
        key
        for key in dict.fromkeys((*made, *told))
        if key not in told
        or key not in made
        or not (told[key] == made[key] if exactly else not any(differing(told[key], made[key], key)))
    ]


def _json(path: Path) -> Any:
    """Return what a JSON file holds that is a mapping, or None if there is no such file."""
    try:
        content = parsed(_read(path), float) if path.is_file() else None
    except AuditFault as fault:
        raise CheckFailed(f"{path}: {fault}") from None
    except (ValueError, RecursionError):
        raise CheckFailed(f"{path} is not JSON") from None
    if content is not None and not isinstance(content, dict):
        raise CheckFailed(f"{path} holds no mapping")
    return content


def _read(path: Path) -> str:
    try:
        return regular(path, LARGEST).decode("utf-8")
    except (OSError, ValueError) as error:
        raise InvalidSpec(f"cannot read {path}: {getattr(error, 'strerror', None) or error}") from None
