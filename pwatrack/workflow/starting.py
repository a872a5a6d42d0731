"""Where the parts of a run start, as its spec says."""

from collections.abc import Iterator, Mapping
from typing import Literal

import numpy as np

from pwatrack.arrays import Array
from pwatrack.control.generator import TrajectoryGenerator
from pwatrack.control.headroom import Starts
from pwatrack.control.trajectory import DesiredTrajectory
from pwatrack.errors import InvalidSpec, Problem, Subject
from pwatrack.model.sizes import Sizes
from pwatrack.simulation.region import BoxRegion, Region
from pwatrack.simulation.steady_state import consistent_start, from_measured
from pwatrack.spec.spec import Spec
from pwatrack.spec.wording import guess, shown


def generator_start(spec: Spec, trajectory: DesiredTrajectory, generator: TrajectoryGenerator | None) -> Array:
    """Return η̂(0), in order or by the generator's names of states; that of `consistent_start` if none is given."""
    given, names, subject = spec.scenario.initial.generator, trajectory.names, ("simulation", "initial", "generator")
    if given is None or isinstance(given, str):
        return consistent_start(trajectory, generator)[0]
    if not isinstance(given, Mapping):
        return initial_values(given, len(names), "generator")
    unknown = [
        Problem(
            message=f"{'.'.join(subject)}: {shown(name)} is no state of the generator: "
            f"{', '.join(names) or 'it has none'}{guess(name, names)}",
            subject=(*subject, name),
        )
        for name in given
        if name not in names
    ]
    if unknown:
        raise InvalidSpec(*unknown)
    return np.array([given.get(name, 0.0) for name in names])


def start_remarks(spec: Spec, trajectory: DesiredTrajectory, generator: TrajectoryGenerator | None) -> tuple[str, ...]:
    """Say what was taken where a steady state is asked for that there is not."""
    initial = spec.scenario.initial
    asked = [part for part in ("plant", "generator") if isinstance(getattr(initial, part), str)]
    if not asked or trajectory.eta0 is not None:
        return ()
    said = consistent_start(trajectory, generator)[1]
    return (f"simulation.initial.{asked[-1]}: there is no steady state: {said}",) if said else ()


def plant_start(
    spec: Spec, trajectory: DesiredTrajectory, generator: TrajectoryGenerator | None, eta: Array | None = None
) -> Array:
    """Return x(0); in steady state it is x_d(0), from which the plant follows its reference, or rests with it.

    `eta` is η̂(0), where the reference says it; else it is that of `consistent_start`.
    """
    given = spec.scenario.initial.plant
    if not isinstance(given, str):
        return initial_values(given, len(spec.problem.plant.states), "plant")
    eta = consistent_start(trajectory, generator)[0] if eta is None else eta
    return trajectory.state(np.concatenate([eta, trajectory.exosystem.w0, [1.0]]))


def initial_values(values: Array | None, length: int, part: str) -> Array:
    """Return where a part starts, 0 where nothing is said; refuses another number of entries."""
    if values is None:
        return np.zeros(length)
    if len(values) != length:
        subject: Subject = ("simulation", "initial", part)
        raise InvalidSpec(f"simulation.initial.{part}: {len(values)} entries, expected {length}", subject=subject)
    return values


def starts_of(
    spec: Spec, trajectory: DesiredTrajectory, plant_at: Array, generator: Array | None, sizes: Sizes
) -> Iterator[Starts]:
    """Yield the errors with which a run begins, and the members of its ensemble, where it is known where x_d does.

    Noise and steps of a sensor are left out, and a disturbance that is no load which is estimated. Estimates of loads
    start at 0.

    `plant_at` is x(0), `generator` η̂(0) if it is known; in the sizes the observer makes the least of what is measured.
    """
    plant, initial, regions = spec.problem.plant, spec.scenario.initial, spec.scenario.regions
    if "generator" in regions or (generator is None and trajectory.names):
        return
    eta = np.zeros(0) if generator is None else generator
    x_d = trajectory.state(np.concatenate([eta, trajectory.exosystem.w0, [1.0]]))
    n, loads, disturbance = len(x_d), plant.loads, spec.scenario.conditions.disturbance
    acting = np.zeros(len(sizes.load))
    if loads is not None and disturbance is not None and loads.are(disturbance):
        acting[list(loads.where)] = -loads.truth(disturbance.Q, disturbance.rates) @ disturbance.w0
    for varied in ({}, regions) if regions else ({},):
        x = _columns(varied.get("plant"), plant_at)
        if isinstance(initial.observer, str):
            x_hat, own = from_measured(sizes, plant.C) @ plant.C @ x, np.zeros((n, 0))
        else:
            start = _columns(varied.get("observer"), initial_values(initial.observer, n, "observer"))
            x_hat, own = np.hstack([start[:, :1], np.zeros((n, x.shape[1] - 1))]), start[:, 1:]
        e = np.hstack([x, np.zeros(own.shape)])
        e[:, 0] -= x_d
        load, delta = np.zeros((len(sizes.load), e.shape[1])), np.hstack([x_hat - x, own])
        load[:, 0] = acting
        if not varied and not delta.any() and not load.any():
            yield Starts(kind="run", e=e)
            continue
        kind: Literal["ensemble", "run"] = "ensemble" if varied else "run"
        yield Starts(kind=kind, e=e, delta=delta, load=load if len(load) else None)
        if varied:
            yield Starts(kind="members", e=e[:, : x.shape[1]])


def _columns(region: Region | None, point: Array) -> Array:
    """Return the centre of a region and, for each entry that varies, by how much; of an ellipsoid the box around it."""
    if region is None:
        return point[:, None]
    if isinstance(region, BoxRegion):
        centre, radii = (region.low + region.high) / 2, (region.high - region.low) / 2
    else:
        centre, radii = region.center, region.radii
    return np.hstack([centre[:, None], np.diag(radii)[:, radii > 0]])
