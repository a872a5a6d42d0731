"""A stored controller in the loop again: it must be the one of the spec."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from pwatrack.control.controller import Controller
from pwatrack.control.goal import Given
from pwatrack.control.program import Program
from pwatrack.errors import InvalidSpec, Problem
from pwatrack.export.schema import ControllerFile, Sampled
from pwatrack.export.stored import content, runs, sampled
from pwatrack.spec.spec import Spec

_CLOSE = 1e-9  # of the largest entry of a table: what two matrix exponentials may differ by
_SAME = ("tracking", "K", "L", "plant", "trajectory")  # that two files of one controller have in common
_CHOSEN = ("sample_time", "method", "delay", "low", "high", "change", "quantum")


def with_gains(spec: Spec, known: ControllerFile) -> Spec:
    """Return a spec that asks for the gains of a stored controller, and no others.

    Raises:
        InvalidSpec: If they have other sizes.
    """
    K, L = np.array(known.K), np.array(known.L)
    plant = spec.problem.plant
    (n, m), (N, q) = plant.B.shape, (plant.observed.A[0].shape[0], len(plant.C))
    if K.shape != (m, n) or L.shape != (N, q):
        raise _other("K and L have other sizes")
    return replace(spec, objectives=replace(spec.objectives, controller=Given(gain=K), observer=Given(gain=L)))


def check_same(spec: Spec, controller: Controller, known: ControllerFile) -> tuple[Spec, Program | None]:
    """Return the spec with the sample time of a stored controller, and its program.

    Args:
        spec: The spec, with its gains.
        controller: These gains, proved for the plant of the spec.
        known: The file.

    Raises:
        InvalidSpec: If plant, reference or the limits of the program are not those of the spec.
    """
    again = content(spec, controller, proof=known.proof, generator=None, start=None)
    here = ControllerFile.model_validate(again).model_dump()
    for name in _SAME:
        for place in _different(known.model_dump()[name], here[name], name):
            raise _other(place)
    if known.program is None:
        return spec, None
    found, conditions = runs(known), spec.scenario.conditions
    conditions = replace(conditions, sampling=conditions.sampling or found.sampling)
    made = Sampled.model_validate(sampled(controller, conditions))
    for name in _CHOSEN:
        for place in _different(getattr(known.program, name), getattr(made, name), f"program.{name}"):
            raise _other(place)
    for name in ("observer", "generator", "x_d", "u_ff", "guards"):
        one, other = getattr(found, name), getattr(runs(known.model_copy(update={"program": made})), name)
        if np.abs(one - other).max(initial=0.0) > _CLOSE * np.abs(other).max(initial=0.0):
            raise _other(f"program, '{name}'")
    return replace(spec, scenario=replace(spec.scenario, conditions=conditions)), found


def _different(one: Any, other: Any, place: str) -> Iterator[str]:
    """Yield where two trees differ."""
    if isinstance(one, dict) and isinstance(other, dict) and one.keys() == other.keys():
        for key in one:
            yield from _different(one[key], other[key], f"{place}.{key}")
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        for k, (a, b) in enumerate(zip(one, other, strict=True)):
            yield from _different(a, b, f"{place}.{k}")
    elif one != other:
        yield f"{place} is {one!r} in the file and {other!r} in the spec"[:200]


def _other(what: str) -> InvalidSpec:
    message = f"the stored controller is not one for this spec: {what}"
    hint = "'simulation: {plant: {parameters: …}}' runs a controller on another plant than it was designed for"
    return InvalidSpec(Problem(message=message, subject=None, hint=hint))
