"""A controller <-> controller.json."""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pwatrack.arrays import Array
from pwatrack.claims.decay import ends_below, sentences
from pwatrack.control.controller import Controller
from pwatrack.control.program import Follows, Piece, Program, program
from pwatrack.control.trajectory import DesiredTrajectory
from pwatrack.errors import InvalidSpec, Problem
from pwatrack.export.schema import FORMAT, ControllerFile, Followed, Inside, Outside
from pwatrack.model.conditions import Conditions, Sampling
from pwatrack.spec.spec import Spec

LARGEST = 2**28  # bytes of a file that is read
_SINGLE = float(np.finfo(np.float32).max)


def content(
    spec: Spec,
    controller: Controller,
    *,
    proof: str,
    generator: dict[str, Any] | None,
    start: dict[str, Any] | None,
    failed: Sequence[str] = (),
) -> dict[str, Any]:
    """Return what controller.json holds.

    Args:
        spec: What was asked.
        controller: What `design(spec)` returned.
        proof: The digest of certificate.json.
        generator: What generator.json holds.
        start: `x_hat` (with what it has of loads) and `eta_hat`, where they are known.
        failed: What its run did not achieve, in sentences.
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
        "trajectory": _trajectory(trajectory),
        "start": start,
        "program": None if conditions.sampling is None else sampled(controller, conditions),
    }
    return {"format": FORMAT, "sha256": digest(found), **found}


def digest(found: dict[str, Any]) -> str:
    """Return the digest of all but the digest."""
    rest = {key: value for key, value in found.items() if key != "sha256"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def sampled(controller: Controller, conditions: Conditions) -> dict[str, Any]:
    """Return the part `program` of the file."""
    inside, outside = (program(controller, conditions, given=given) for given in (False, True))
    assert inside.follows is not None
    follows = inside.follows
    made = {
        "turn": follows.turn.tolist(),
        "w0": follows.w0.tolist(),
        "pieces": [{"tick": piece.tick, "start": piece.start, "w": piece.w.tolist()} for piece in follows.pieces],
        "end": follows.end,
    }
    return {
        "sample_time": inside.sampling.sample_time,
        "method": inside.sampling.method,
        "delay": inside.sampling.delay,
        "observer": inside.observer.tolist(),
        "low": _finite(inside.limits[:, 0]),
        "high": _finite(inside.limits[:, 1]),
        "change": _finite(inside.change),
        "quantum": inside.quantum.tolist(),
        "inside": _followed(inside) | made,
        "outside": _followed(outside) | {"reference": list(outside.reference)},
    }


def read(path: Path) -> ControllerFile:
    """Return a controller from its file.

    Raises:
        InvalidSpec: If it cannot be read, is of another version, has been changed, or is not as its schema says.
    """
    try:
        if path.stat().st_size > LARGEST:
            raise _refused(path, f"it has more than {LARGEST:,} bytes")
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise _refused(path, f"it cannot be read: {error}") from None
    return parsed(found, path)


def parsed(found: Any, path: Path) -> ControllerFile:
    """Return a controller from what its file holds. Args and raises: as `read`."""
    from pydantic import ValidationError

    version = found.get("format") if isinstance(found, dict) else None
    if version != FORMAT:
        said = f"'{version}'"[:80] if isinstance(version, str) else "none that is known"
        raise _refused(path, f"its format is {said}, this program reads '{FORMAT}'", "write it anew with 'design'")
    try:
        known = ControllerFile.model_validate(found)
        right = digest(found) == known.sha256
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise _refused(path, f"{place}: {first['msg']}, and {error.error_count() - 1} more") from None
    except ValueError as error:  # a number that JSON does not have
        raise _refused(path, str(error)) from None
    if not right:
        raise _refused(path, "its digest is not that of its content: it was changed", "write it anew with 'design'")
    if known.program is not None:
        _check_shapes(known, path)
    return known


def runs(known: ControllerFile, *, given: bool = False, single: bool = False) -> Program:
    """Return the program of a file.

    Args:
        known: The file; it has one.
        given: Whether the reference comes from outside.
        single: Whether it is for single floats.

    Raises:
        InvalidSpec: If single floats do not hold its numbers.
    """
    part = known.program
    assert part is not None
    followed: Followed = part.outside if given else part.inside
    m, n, desired = len(known.plant.inputs), len(known.plant.states), len(followed.sides)
    p, s_hat = len(known.trajectory.eta), len(known.L) - n
    s = len(part.outside.reference) if given else len(part.inside.w0)
    columns = s_hat + p + s + 1
    found = Program(
        sampling=Sampling(sample_time=part.sample_time, method=part.method, delay=part.delay),
        H=np.array(known.plant.H, dtype=np.float64).reshape(-1, n),
        h=np.array(known.plant.h, dtype=np.float64),
        signs=np.array(known.plant.signs, dtype=np.int64).reshape(len(known.plant.cells), -1),
        observer=np.array(part.observer),
        generator=np.array(followed.generator, dtype=np.float64).reshape(desired, p, columns),
        x_d=np.array(followed.x_d).reshape(desired, n, columns),
        guards=np.array(followed.guards, dtype=np.float64).reshape(-1, columns),
        sides=np.array(followed.sides, dtype=np.int64).reshape(desired, -1),
        u_ff=np.array(followed.u_ff).reshape(desired, m, columns),
        K=np.array(known.K),
        limits=np.column_stack([_numbers(part.low, -np.inf), _numbers(part.high, np.inf)]),
        change=_numbers(part.change, np.inf),
        quantum=np.array(part.quantum),
        follows=None if given else _follows(part.inside, s),
        reference=tuple(part.outside.reference) if given else (),
    )
    if single:
        for name in ("H", "h", "observer", "generator", "x_d", "u_ff", "guards", "K"):
            largest = float(np.abs(getattr(found, name)).max(initial=0.0))
            if largest > _SINGLE:
                raise InvalidSpec(
                    f"{name} of '{known.name}' has a number of {largest:.3g}, and single floats end at {_SINGLE:.3g}",
                    hint="use double floats; a shorter sample time makes smaller numbers",
                )
    return found


def _follows(inside: Inside, s: int) -> Follows:
    return Follows(
        turn=np.array(inside.turn, dtype=np.float64).reshape(len(inside.turn), s, s),
        w0=np.array(inside.w0, dtype=np.float64),
        pieces=tuple(Piece(tick=piece.tick, start=piece.start, w=np.array(piece.w)) for piece in inside.pieces),
        end=inside.end,
    )


def _check_shapes(known: ControllerFile, path: Path) -> None:
    """Refuse a file whose program has tables that do not fit each other."""
    plant, part = known.plant, known.program
    assert part is not None
    cells, n, m, q, N = len(plant.cells), len(plant.states), len(plant.inputs), len(plant.outputs), len(known.L)
    p, inside, outside = len(known.trajectory.eta), part.inside, part.outside
    s, planes = len(inside.w0), len(plant.h)
    width = N - n + p + 1
    wanted: list[tuple[str, Any, tuple[int, ...]]] = [
        ("plant.H", plant.H, (planes, n)),
        ("plant.signs", plant.signs, (cells, planes)),
        ("K", known.K, (m, n)),
        ("program.observer", part.observer, (cells, N, q + m + N + 1)),
        ("program.inside.turn", inside.turn, (len(inside.turn), s, s)),
        *((f"program.{name}", getattr(part, name), (m,)) for name in ("low", "high", "change", "quantum")),
    ]
    followed: Sequence[tuple[str, Inside | Outside, int]] = (
        ("inside", inside, width + s),
        ("outside", outside, width + len(outside.reference)),
    )
    for name, tables, columns in followed:
        desired = len(tables.sides)
        wanted += [
            (f"program.{name}.generator", tables.generator, (desired, p, columns)),
            (f"program.{name}.x_d", tables.x_d, (desired, n, columns)),
            (f"program.{name}.guards", tables.guards, (len(tables.guards), columns)),
            (f"program.{name}.sides", tables.sides, (desired, len(tables.guards))),
            (f"program.{name}.u_ff", tables.u_ff, (desired, m, columns)),
        ]
    for name, values, shape in wanted:
        if not _has(values, shape):
            raise _refused(path, f"{name} has not the shape {shape}")
    if any(low is not None and high is not None and low > high for low, high in zip(part.low, part.high, strict=True)):
        raise _refused(path, "program: a lower limit is above the upper one")
    ticks = [piece.tick for piece in inside.pieces]
    fits = all(piece.tick > 0 and piece.start + len(piece.w) <= s for piece in inside.pieces)
    if not 1 <= len(inside.turn) <= 3 or ticks != sorted(ticks) or not fits:
        raise _refused(path, "program.inside: its pieces are not in order, or do not fit")


def _has(values: Any, shape: tuple[int, ...]) -> bool:
    if len(values) != shape[0]:
        return False
    return len(shape) == 1 or all(_has(value, shape[1:]) for value in values)


def _refused(path: Path, what: str, hint: str = "") -> InvalidSpec:
    return InvalidSpec(Problem(message=f"{path}: {what}", subject=None, hint=hint))


def _plant(spec: Spec, controller: Controller) -> dict[str, Any]:
    plant, added, loads = controller.plant, controller.compensation, None
    model = plant.model
    if plant.loads is not None:
        loads = {
            "names": list(plant.loads.names),
            "where": list(plant.loads.where),
            "E": plant.loads.E.floats.tolist(),
            "S": plant.loads.S.floats.tolist(),
            "x_d": added.X.floats.tolist(),
            "u_ff": added.u_ff.tolist(),
            "rate": added.rate.tolist(),
        }
    return {
        "states": list(plant.states),
        "inputs": list(plant.inputs),
        "outputs": list(plant.outputs),
        "tracked": list(plant.tracked_names),
        "units": {name: str(unit) for name, unit in spec.problem.units.items()},
        "cells": list(model.cell_names),
        "H": model.partition.H.tolist(),
        "h": model.partition.h.tolist(),
        "signs": model.partition.signs.tolist(),
        "A": model.A.tolist(),
        "b": model.b.tolist(),
        "B": plant.B.tolist(),
        "C": plant.C.tolist(),
        "tracked_rows": plant.tracked.tolist(),
        "loads": loads,
    }


def _trajectory(trajectory: DesiredTrajectory) -> dict[str, Any]:
    system = trajectory.exosystem
    return {
        "eta": list(trajectory.names),
        "rate": trajectory.rate.tolist(),
        "x_d": trajectory.x_d.tolist(),
        "u_ff": trajectory.u_ff.tolist(),
        "guards": trajectory.guards.tolist(),
        "signs": trajectory.signs.tolist(),
        "reference": {
            "S": system.S.tolist(),
            "Q": system.Q.tolist(),
            "w0": system.w0.tolist(),
            "pieces": [{"t": float(r.t), "start": r.where.start, "w": r.w.tolist()} for r in system.resets],
            "period": system.period,
            "end": system.end,
        },
    }


def _followed(found: Program) -> dict[str, Any]:
    names = ("generator", "x_d", "u_ff", "guards", "sides")
    return {name: getattr(found, name).tolist() for name in names}


def _finite(values: Array) -> list[float | None]:
    return [value if np.isfinite(value) else None for value in values.tolist()]


def _numbers(values: Sequence[float | None], missing: float) -> Array:
    return np.array([missing if value is None else value for value in values], dtype=np.float64)
