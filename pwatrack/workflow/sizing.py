"""The sizes of a spec's signals: those that the file gives, and those that follow from what else it says."""

from collections.abc import Iterable, Iterator

import numpy as np

from pwatrack.arrays import Array
from pwatrack.control.controller import ProvedController
from pwatrack.control.trajectory import DesiredTrajectory
from pwatrack.errors import OutsideTheory, PwatrackError
from pwatrack.model.normal_form import normal_form
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import Exosystem, InputReference, OutputReference, SetPoint, exosystem
from pwatrack.model.sizes import Origin, Sizes
from pwatrack.simulation.desired import blocks, desired_flow
from pwatrack.simulation.region import BoxRegion
from pwatrack.simulation.steady_state import periodic_state
from pwatrack.spec.spec import Spec

_SPAN = 20.0  # time constants in a run, for a plant that has no speed of its own: what decays so is over long before
_TIMES = 4096  # at which a reference is looked at, beside its breaks
_GOLDEN = (np.sqrt(5.0) - 1) / 2  # its multiples, less whole numbers, are even over [0, 1] and in step with no period
_BRIEF = 0.05  # of the time of a run: a signal that moves no longer does so in spikes
_STILL = 1e-9  # of the largest value, or of a size: what moves less is a constant, or 0, but for rounding


def spec_sizes(spec: Spec) -> Sizes:
    """Return the sizes of all signals of a spec.

    Each is the first of these that there is: what the file gives under `sizes`; of an input, half the width of its
    limits; how far the reference moves the signal for more than a moment, half of its range, or where it rests; for a
    state half the width of the region that members of an ensemble start in. The rest, and the speed, is what balances
    the plant. An output that the file gives no size is at least as large as its noise: what is below cannot be seen.
    """
    plant, known = spec.problem.plant, dict[str, tuple[float, Origin]]()
    tempo, noise = _SPAN / spec.scenario.duration, spec.scenario.conditions.noise
    for name, size, origin in _told(spec):
        if name not in known and 0 < size < np.inf:
            known[name] = size, origin
    sizes = Sizes.of(plant, known, tempo=tempo)
    if noise is None:
        return sizes
    for name, size, std in zip(plant.outputs, sizes.output.tolist(), noise.std.tolist(), strict=True):
        if name not in spec.problem.sizes and std > size:
            known[name] = std, "noise"
    return Sizes.of(plant, known, tempo=tempo)


def reference_sizes(spec: Spec, controller: ProvedController) -> Array:
    """Return how large the reference of each signal of the tracking error is, half of its swing in a run, (q,).

    Of one that rests it is its size, at samples never more than it is; 0 where that is 0, or it is a response to given
    inputs that cannot be followed: there is nothing to compare an error with.
    """
    trajectory, plant = controller.trajectory, controller.plant
    p, of_state = len(trajectory.names), controller.tracking == "state"
    rows = trajectory.x_d[0] if of_state else plant.tracked @ trajectory.x_d[0]
    if of_state and p:  # the response to given inputs
        try:
            moves = _moves(_response(plant, trajectory, spec.scenario.duration))
            return np.where(moves > _STILL * controller.sizes.state, moves, 0.0)
        except PwatrackError:
            return np.zeros(len(rows))
    t = _times(trajectory.exosystem, spec.scenario.duration)
    return _moves(trajectory.exosystem.states(t) @ rows[:, p:-1].T + rows[:, -1])


def _response(plant: PWASystem, trajectory: DesiredTrajectory, duration: float) -> Array:
    """Return x_d of given inputs at samples, from its start, or over a period of its periodic solution, (T, n)."""
    system, p = trajectory.exosystem, len(trajectory.names)
    eta = np.zeros(p) if trajectory.eta0 is None else trajectory.eta0
    z0 = np.concatenate([eta, system.w0, [1.0]])
    if trajectory.eta0 is not None:
        return np.concatenate([trace.z[:, :p] for trace in blocks(plant, trajectory, z0, duration)])
    period = duration if system.constant or system.period is None else system.period
    return np.asarray(periodic_state(desired_flow(plant, trajectory), z0, free=p, period=period).z[:, :p])


def _told(spec: Spec) -> Iterator[tuple[str, float, Origin]]:
    """Yield what a spec says of sizes, in the order in which it counts."""
    plant, scenario = spec.problem.plant, spec.scenario
    for name, size in spec.problem.sizes.items():
        yield name, size, "given"
    limits = scenario.conditions.limits
    for name, (low, high) in zip(plant.inputs, () if limits is None else limits.tolist(), strict=False):
        yield name, (high - low) / 2, "limits"
    for name, size in _reference(spec):
        yield name, size, "reference"
    region = scenario.regions.get("plant")
    if region is not None:
        radii = (region.high - region.low) / 2 if isinstance(region, BoxRegion) else region.radii
        for name, radius in zip(plant.states, radii.tolist(), strict=True):
            yield name, radius, "ensemble"


def _reference(spec: Spec) -> Iterable[tuple[str, float]]:
    """Return how far the reference moves each signal that it determines."""
    plant, reference, duration = spec.problem.plant, spec.problem.reference, spec.scenario.duration
    if isinstance(reference, OutputReference):
        return _through_xi(spec, reference)
    if isinstance(reference, SetPoint):
        y = np.abs(reference.y)
        found = [*zip(plant.tracked_names, y.tolist(), strict=True)]
        for row, size in zip(plant.tracked, y, strict=True):  # an output that is a multiple of one state says its size
            j = np.flatnonzero(row)
            found += [(plant.states[k], float(size / abs(row[k]))) for k in j if len(j) == 1]
        return found
    names = plant.inputs if isinstance(reference, InputReference) else plant.states
    system = exosystem(reference.signals())
    return zip(names, _moves(system.states(_times(system, duration)) @ system.Q.T).tolist(), strict=True)


def _through_xi(spec: Spec, reference: OutputReference) -> Iterator[tuple[str, float]]:
    """Yield how far y_d moves the output, and each state that is a function of ξ = (y, ẏ, …) alone.

    A state that is moved in short spikes only, as the speed is by a step that is hardly rounded, has no size from them:
    they say how sharp the corner is, and nothing of what matters.
    """
    plant = spec.problem.plant
    try:
        form = normal_form(plant)
    except OutsideTheory:  # nothing can be said; the design says why
        return
    system = exosystem(reference.signals(form.degrees))
    t = _times(system, spec.scenario.duration)
    w = system.states(t)
    rows = system.derivative_rows(max(form.degrees) - 1)
    xi = w @ np.vstack([rows[:degree, j] for j, degree in enumerate(form.degrees)]).T
    firsts = np.cumsum((0, *form.degrees[:-1]))
    yield from zip(plant.tracked_names, _moves(xi[:, firsts]).tolist(), strict=True)
    moved = form.T_inverse[0]
    bent = (form.T_inverse != moved).any(axis=(0, 2))  # functions of ξ, but not the same in all cells
    alone = np.flatnonzero(~moved[:, form.r :].any(axis=1) & ~bent)
    x = (xi - form.offset[0, : form.r]) @ moved[alone, : form.r].T
    for j, size, lasts in zip(alone.tolist(), _moves(x).tolist(), _lasting(t, x).tolist(), strict=True):
        if lasts > _BRIEF:
            yield plant.states[j], size


def _lasting(t: Array, values: Array) -> Array:
    """Return the share of time that signals (T, k) spend away from where they are most, by a tenth of their range."""
    middle, reach = np.median(values, axis=0), np.ptp(values, axis=0) / 10
    away = np.abs(values - middle) >= np.where(reach > 0, reach, 0.0)
    return np.asarray(np.gradient(t) @ away / np.gradient(t).sum())


def _times(system: Exosystem, duration: float) -> Array:
    """Return times in s up to the end of a run or of the signals."""
    end = duration if system.end is None else min(duration, system.end)
    breaks = np.append(0.0, system.breaks[system.breaks < end])
    even = end * (np.arange(1, _TIMES + 1) * _GOLDEN % 1.0)
    return np.sort(np.concatenate([breaks, (breaks + np.append(breaks[1:], end)) / 2, even]))


def _moves(values: Array) -> Array:
    """Return half of the range of signals (T, k), or where they are constant their size, (k,)."""
    half, largest = np.ptp(values, axis=0) / 2, np.abs(values).max(axis=0)
    return np.asarray(np.where(half > _STILL * largest, half, largest))
