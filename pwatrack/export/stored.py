"""A controller <-> controller.json; and one that is stored in the loop again: it must be the one of the spec."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from pwatrack.arrays import Array, alike
from pwatrack.claims.decay import ends_below, sentences
from pwatrack.claims.sampled import SampledLoop
from pwatrack.claims.set_points import SetPoints
from pwatrack.control.compensation import Compensation
from pwatrack.control.controller import ProvedController
from pwatrack.control.goal import Given
from pwatrack.control.program import PACE, Follows, Piece, SampledController, program
from pwatrack.control.trajectory import DesiredTrajectory
from pwatrack.errors import InvalidSpec
from pwatrack.export.schema import FORMAT, ControllerFile, Inside, Outside, Sampled
from pwatrack.model.conditions import Conditions
from pwatrack.model.loads import Loads
from pwatrack.model.reference import OutputReference
from pwatrack.remote_files import regular
from pwatrack.spec.spec import Spec

LARGEST = 2**28  # bytes of a file that is read
_SINGLE = float(np.finfo(np.float32).max)
_LOOKED = "not proved for switching between cells"
_SAME = ("tracking", "K", "L", "plant", "trajectory")  # that two files of one controller have in common
_FOLLOWED = ("generator", "x_d", "u_ff", "guards", "sides")  # tables of a desired trajectory in samples
_SAID = ("program.proved ", "program.outside.takes ")  # what is said of a program, and runs nothing
_RUNS = ("K", "L", "plant.", "trajectory.", "program.")  # what runs: of what is said, 0 may be rounding of the others
_ENDS = "from", "to"  # of an interval, compared as one table: one of them may be rounding of the other
_MOST_SHOWN = 60  # characters of what differs


def content(
    spec: Spec,
    controller: ProvedController,
    *,
    proof: str,
    generator: dict[str, Any] | None,
    start: dict[str, Any] | None,
    failed: Sequence[str] = (),
) -> dict[str, Any]:
    """Return what controller.json holds of `design(spec)`.

    `proof` is the digest of certificate.json, `generator` what generator.json holds; `start` has `x_hat` (with what it
    has of loads) and `eta_hat`, where they are known; `failed` says what its run did not achieve, in sentences.
    """
    trajectory, conditions = controller.trajectory, spec.scenario.conditions
    found: dict[str, Any] = {
        "format": FORMAT,
        "name": spec.name,
        "spec_sha256": spec.sha256,
        "set": {name: str(value) for name, value in spec.overrides.items()},
        "tracking": spec.problem.tracking,
        "proof": proof,
        "claims": sentences(spec.words, controller),
        "practical": ends_below(spec.words, controller) or None,
        "open": [] if trajectory.growth is None else [trajectory.growth.message],
        "failed": list(failed),
        "plant": _plant(spec, controller),
        "K": controller.design.K.tolist(),
        "L": controller.design.L.tolist(),
        "generator": generator,
        "trajectory": lists_of(trajectory),
        "start": start,
        "program": None if conditions.sampling is None else sampled(controller, conditions),
    }
    return {"format": FORMAT, "sha256": digest(found), **found}


def digest(found: dict[str, Any]) -> str:
    """Return the digest of all but the digest."""
    rest = {key: value for key, value in found.items() if key != "sha256"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def sampled(controller: ProvedController, conditions: Conditions) -> dict[str, Any]:
    """Return the part `program` of the file."""
    inside, outside = (program(controller, conditions, given=given) for given in (False, True))
    follows = inside.follows
    assert follows is not None
    made = {
        **lists(follows, "turn", "w0"),
        "pieces": [{"tick": piece.tick, "start": piece.start, "w": piece.w.tolist()} for piece in follows.pieces],
        "end": follows.end,
        "early": follows.early.tolist(),
    }
    ends = [ends if np.isfinite(ends).all() else None for ends in outside.set_range.tolist()]
    given = {
        "reference": list(outside.reference),
        "pace": outside.pace.tolist(),
        "range": ends if any(ends) else [],
        "takes": next((claim.takes for claim in controller.claims_of(SetPoints)), []),
    }
    return {
        "sample_time": inside.sampling.sample_time,
        "method": inside.sampling.method,
        "proved": next((claim.sentence for claim in controller.claims_of(SampledLoop)), _LOOKED),
        "delay": inside.sampling.delay,
        "jitter": inside.sampling.jitter,
        "substeps": inside.substeps,
        **lists(inside, "K", "M", "E", "observer"),
        "low": _finite(inside.limits[:, 0]),
        "high": _finite(inside.limits[:, 1]),
        "change": _finite(inside.change),
        "quantum": inside.quantum.tolist(),
        "inside": lists(inside, *_FOLLOWED) | made,
        "outside": lists(outside, *_FOLLOWED) | given,
    }


def read(path: Path) -> ControllerFile:
    """Return a controller from its file. Raises: as `parsed`, and if it cannot be read."""
    try:
        found = json.loads(regular(path, LARGEST).decode("utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError):
        raise _refused(path, "it is not JSON", "a controller is read from the controller.json of a run") from None
    except (OSError, ValueError) as error:
        raise InvalidSpec(f"cannot read {path}: {getattr(error, 'strerror', None) or error}") from None
    return parsed(found, path)


def parsed(found: Any, path: Path) -> ControllerFile:
    """Return a controller from what its file holds; InvalidSpec if that was changed, or is not as its schema says."""
    version = found.get("format") if isinstance(found, dict) else None
    if version != FORMAT:
        said = f"'{version}'"[:80] if isinstance(version, str) else "none that is known"
        raise _refused(path, f"its format is {said}, this program reads '{FORMAT}'", "write it anew with 'design'")
    try:
        known = ControllerFile.model_validate(found)
        right = digest(found) == known.sha256
        if right and known.program is not None:
            _check_runs(known)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise _refused(path, f"{place}: {first['msg']}, and {error.error_count() - 1} more") from None
    except ValueError as error:  # a number that JSON does not have, or tables that do not fit each other
        raise _refused(path, str(error)) from None
    if not right:
        raise _refused(path, "its digest is not that of its content: it was changed", "write it anew with 'design'")
    return known


def runs(known: ControllerFile, *, given: bool = False, single: bool = False) -> SampledController:
    """Return the program of a file that has one, with its reference from outside where it is given.

    Raises InvalidSpec if single floats do not hold its numbers; ValueError if its tables do not fit each other, which
    those of a file that was read do.
    """
    part, plant = known.program, known.plant
    assert part is not None
    side, followed = ("outside", part.outside) if given else ("inside", part.inside)
    cells, n, m, q = map(len, (plant.cells, plant.states, plant.inputs, plant.outputs))
    planes, sides, guards = len(plant.h), len(followed.sides), len(followed.guards)
    N, p, s = len(known.L), len(known.trajectory.eta), len(part.outside.reference if given else part.inside.w0)
    columns, corrects, outputs = N - n + p + s + 1, part.method == "corrected", len(part.outside.pace)
    entries = max(4, len(part.outside.reference) // outputs) if outputs else 4  # of the pace of each
    if n > N or not (cells and sides):
        raise ValueError("L has fewer rows than there are states, or there is no cell")

    def table(place: str, *shape: int, missing: float = np.nan, whole: bool = False) -> Any:
        values: Any = known
        for name in place.split("."):
            values = getattr(values, name)
        if not _has(values, shape):
            raise ValueError(f"{place} has not the shape {shape}")
        if not np.isnan(missing):
            values = [missing if value is None else value for value in values]
        return np.array(values, dtype=np.int64 if whole else np.float64).reshape(shape)

    table("K", m, n)
    found = SampledController(
        sampling=part.sampling,
        H=table("plant.H", planes, n),
        h=table("plant.h", planes),
        signs=table("plant.signs", cells, planes, whole=True),
        substeps=part.substeps,
        K=table("program.K", m, n),
        C=np.hstack([table("plant.C", q, n), np.zeros((q, N - n))]),
        M=table("program.M", N if corrects else 0, q),
        E=table("program.E", N if part.E else 0, m),
        observer=table("program.observer", cells, N, m + N + 1 + q * (not corrects)),
        generator=table(f"program.{side}.generator", sides, p, columns),
        x_d=table(f"program.{side}.x_d", sides, n, columns),
        guards=table(f"program.{side}.guards", guards, columns),
        sides=table(f"program.{side}.sides", sides, guards, whole=True),
        u_ff=table(f"program.{side}.u_ff", sides, m, columns),
        limits=np.stack([table("program.low", m, missing=-np.inf), table("program.high", m, missing=np.inf)], axis=1),
        change=table("program.change", m, missing=np.inf),
        quantum=table("program.quantum", m),
        follows=None if given else _follows(part.inside, table("program.inside.turn", len(part.inside.turn), s, s)),
        reference=tuple(part.outside.reference) if given else (),
        pace=table("program.outside.pace", outputs, entries) if given else np.zeros((0, 4)),
        set_range=_range(part.outside) if given else np.zeros((0, 2)),
    )
    for name in ("H", "h", "observer", "C", "M", "E", "generator", "x_d", "u_ff", "guards", "K") if single else ():
        largest = float(np.abs(getattr(found, name)).max(initial=0.0))
        if largest > _SINGLE:
            raise InvalidSpec(
                f"{name} of '{known.name}' has a number of {largest:.3g}, and single floats end at {_SINGLE:.3g}",
                hint="use double floats; a shorter sample time makes smaller numbers",
            )
    return found


def _range(outside: Outside) -> Array:
    ends = outside.range or [None] * len(outside.pace)
    if len(ends) != len(outside.pace):
        raise ValueError("program.outside.range has not an entry for each output")
    return np.array([one or [-np.inf, np.inf] for one in ends]).reshape(len(ends), 2)


def _follows(inside: Inside, turn: Array) -> Follows:
    pieces = tuple(Piece(tick=piece.tick, start=piece.start, w=np.array(piece.w)) for piece in inside.pieces)
    w0 = np.array(inside.w0, dtype=np.float64)
    if any(len(w) != len(w0) for w in inside.early):
        raise ValueError(f"program.inside.early has not {len(w0)} columns")
    early = np.array(inside.early, dtype=np.float64).reshape(len(inside.early), len(w0))
    return Follows(turn=turn, w0=w0, pieces=pieces, end=inside.end, early=early)


def _check_runs(known: ControllerFile) -> None:
    inside, outside = (runs(known, given=given) for given in (False, True))
    outputs, entries = len(outside.pace), len(outside.reference)
    if (outside.pace[:, 1:] <= 0).any() or (outputs and entries not in outputs * np.arange(2, 2 + len(PACE))):
        raise ValueError("program.outside.pace: a limit is not positive, or its reference has other entries")
    if ((outside.set_range[:, 0] > outside.pace[:, 0]) | (outside.set_range[:, 1] < outside.pace[:, 0])).any():
        raise ValueError("program.outside.range: an output does not start in it")
    follows, of = inside.follows, inside.sizes
    assert follows is not None
    if len(follows.early) != inside.sampling.ahead:
        raise ValueError("program.inside.early has not one row for each sample that inputs are predicted ahead")
    if [*map(len, known.started)] != [of["N"], of["p"]]:
        raise ValueError(f"start has not {of['N']} and {of['p']} entries")
    if (inside.limits[:, 0] > inside.limits[:, 1]).any():
        raise ValueError("program: a lower limit is above the upper one")
    ticks = [piece.tick for piece in follows.pieces]
    fits = all(piece.tick > 0 and piece.start + len(piece.w) <= of["s"] for piece in follows.pieces)
    if not 1 <= len(follows.turn) <= 3 or ticks != sorted(ticks) or not fits:
        raise ValueError("program.inside: its pieces are not in order, or do not fit")


def _has(values: Any, shape: tuple[int, ...]) -> bool:
    if len(values) != shape[0]:
        return False
    return len(shape) == 1 or all(_has(value, shape[1:]) for value in values)


def _refused(path: Path, what: str, hint: str = "") -> InvalidSpec:
    return InvalidSpec(f"{path}: {what}", hint=hint)


def _plant(spec: Spec, controller: ProvedController) -> dict[str, Any]:
    plant, model = controller.plant, controller.plant.model
    return {
        "states": list(plant.states),
        "inputs": list(plant.inputs),
        "outputs": list(plant.outputs),
        "tracked": list(plant.tracked_names),
        "units": {name: str(unit) for name, unit in spec.problem.units.items()},
        "cells": list(model.cell_names),
        **lists(model.partition, "H", "h", "signs"),
        **lists(model, "A", "b"),
        **lists(plant, "B", "C"),
        "tracked_rows": plant.tracked.tolist(),
        "loads": None if plant.loads is None else loads_content(plant.loads, controller.compensation),
    }


def loads_content(loads: Loads, added: Compensation) -> dict[str, Any]:
    """Return what is said of loads, and of what their estimates add: to u_ff and to the rate of eta_hat by cell."""
    return {
        "names": list(loads.names),
        "where": list(loads.where),
        "E": loads.E.floats.tolist(),
        "S": loads.S.floats.tolist(),
        "x_d": added.X.floats.tolist(),
        **lists(added, "u_ff", "rate"),
    }


def lists_of(trajectory: DesiredTrajectory) -> dict[str, Any]:
    """Return what is said of a desired trajectory."""
    system = trajectory.exosystem
    pieces = [
        {"t": t, "start": resets.where.start, "w": w}
        for resets in system.resets
        for t, w in zip(resets.t.tolist(), resets.values.tolist(), strict=True)
    ]
    return {
        "eta": list(trajectory.names),
        **lists(trajectory, "rate", "x_d", "u_ff", "guards", "signs"),
        "reference": {
            **lists(system, "S", "Q", "w0"),
            "pieces": sorted(pieces, key=lambda piece: (piece["t"], piece["start"])),
            "period": system.period,
            "end": system.end,
        },
    }


def lists(of: Any, *names: str) -> dict[str, Any]:
    """Return some arrays of something as lists, by their names."""
    return {name: getattr(of, name).tolist() for name in names}


def _finite(values: Array) -> list[float | None]:
    return [value if np.isfinite(value) else None for value in values.tolist()]


def with_gains(spec: Spec, known: ControllerFile) -> Spec:
    """Return a spec that asks for gains, sampling and x_d of a stored controller; InvalidSpec if they do not fit."""
    K, L = np.array(known.K), np.array(known.L)
    plant = spec.problem.plant
    (n, m), (N, q) = plant.B.shape, (plant.observed.A[0].shape[0], len(plant.C))
    if K.shape != (m, n) or L.shape != (N, q):
        raise _other("K and L have other sizes")
    asked = replace(spec.objectives, controller=Given(gain=K), observer=Given(gain=L))
    spec = with_played(spec, known.trajectory.reference.model_dump())
    return replace(with_sampling(spec, known.program), objectives=asked)


def with_played(spec: Spec, played: dict[str, Any]) -> Spec:
    """Return a spec in which x_d is that of a file where it is played back: what it leaves is enclosed anew."""
    reference = spec.problem.reference
    if not isinstance(reference, OutputReference):
        return spec
    return replace(spec, problem=replace(spec.problem, reference=replace(reference, played=played)))


def with_sampling(spec: Spec, program: Sampled | None, *, instead: bool = False) -> Spec:
    """Return a spec that says no sample time with that of a program, if there is one; or any with it `instead`."""
    conditions = spec.scenario.conditions
    if program is None or (conditions.sampling is not None and not instead):
        return spec
    own = conditions.sampling  # of which the rest stays
    sampling = program.sampling if own is None else replace(own, sample_time=program.sample_time)
    return replace(spec, scenario=replace(spec.scenario, conditions=replace(conditions, sampling=sampling)))


def check_same(spec: Spec, controller: ProvedController, known: ControllerFile) -> SampledController | None:
    """Return the program of a stored controller, if it has one; InvalidSpec if a spec `with_gains` makes another."""
    again = content(spec, controller, proof=known.proof, generator=None, start=None)
    there, here = known.model_dump(), ControllerFile.model_validate(again).model_dump()
    for name in _SAME if known.program is None else (*_SAME, "program"):
        for place in differing(there[name], here[name], name):
            if not place.startswith(_SAID):
                raise _other(place)
    return None if known.program is None else runs(known)


def differing(told: Any, made: Any, place: str) -> Iterator[str]:
    """Yield where two trees are not one, tables of doubles but for what two processors may make of them.

    Example:
        >>> list(differing({"a": [1.0, 2.0], "b": {"c": "no"}}, {"a": [1.0, 2.0 + 1e-12], "b": {"c": "yes"}}, "file"))
        ["file.b.c is 'no', not 'yes'"]
    """
    one, other = _table(told), _table(made)
    if isinstance(told, dict) and isinstance(made, dict):
        told, made = _with_intervals(told), _with_intervals(made)
        for key in dict.fromkeys((*made, *told)):
            if key in told and key in made:
                yield from differing(told[key], made[key], f"{place}.{key}")
            else:
                yield f"{place}.{key} is {'missing' if key in made else 'there'}"
    elif one is not None and other is not None:
        same = alike(one, other, together=not place.startswith(_RUNS))
        yield from () if same else (f"{place} is {_shown(told)}, not {_shown(made)}",)
    elif isinstance(told, list) and isinstance(made, list) and len(told) == len(made):
        for k, both in enumerate(zip(told, made, strict=True)):
            yield from differing(*both, f"{place}.{k}")
    elif type(told) is not type(made) or told != made:
        yield f"{place} is {_shown(told)}, not {_shown(made)}"


def _with_intervals(tree: dict[str, Any]) -> dict[str, Any]:
    """Return a mapping with both ends of an interval under one key, if it has such."""
    ends = {key: value for key, value in tree.items() if key in _ENDS}
    rest = {key: value for key, value in tree.items() if key not in _ENDS}
    return rest | {" to ".join(ends): [*ends.values()]} if len(ends) == len(_ENDS) else tree


def _shown(tree: Any) -> str:
    text = repr(tree)
    return text if len(text) <= _MOST_SHOWN else f"{text[:_MOST_SHOWN]}…"


def _table(tree: Any) -> Array | None:
    """Return a double, or a list or table of doubles, as an array; None where it is something else."""
    leaves = [tree] if isinstance(tree, float) else tree
    if not isinstance(leaves, list) or not leaves:
        return None
    if all(isinstance(leaf, float) for leaf in leaves):
        return np.array(leaves)
    rows = [_table(row) for row in leaves if isinstance(row, list)]
    fits = len(rows) == len(leaves) and len({None if row is None else row.shape for row in rows}) == 1
    return np.array(rows) if fits and rows[0] is not None else None


def _other(what: str) -> InvalidSpec:
    hint = "'simulation: {plant: {parameters: …}}' runs a controller on another plant than it was designed for"
    return InvalidSpec(f"the stored controller is not one for this spec: {what}", hint=hint)
