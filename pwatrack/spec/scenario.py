"""Checked sections -> objectives of a design, and the scenario that is simulated: starts, what a machine adds."""

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Literal

import numpy as np

from pwatrack.arrays import Array, readonly
from pwatrack.ball_matrix import BallMatrix
from pwatrack.control.goal import AtLeast, Fastest, Given, Goal, LeastCost, Smallest
from pwatrack.model.conditions import Conditions, Noise, Quanta, Sampling
from pwatrack.model.loads import Load, Loads
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import exosystem, total_signal
from pwatrack.rational import fraction_of
from pwatrack.real import Real
from pwatrack.simulation.region import BoxRegion, EllipsoidRegion, Region
from pwatrack.spec.box import build_box
from pwatrack.spec.design_section import DesignSection, GoalSection, LoadSection
from pwatrack.spec.parametric import ParametricPlant
from pwatrack.spec.profiles import all_courses
from pwatrack.spec.signal_section import ProfileSection
from pwatrack.spec.simulation_section import EllipsoidSection, InitialSection, SimulationSection, StartRegionsSection
from pwatrack.spec.spec import InitialStates, Measured, Objectives, Scenario, Steady
from pwatrack.spec.table import Folder


def build_loads(estimate: Literal["input"] | Mapping[str, LoadSection] | None, plant: PWASystem) -> Loads | None:
    """Return the loads that are to be estimated; None for none."""
    if estimate is None:
        return None
    if isinstance(estimate, str):
        columns = [_reals(plant.exact.B.part(range(len(plant.states)), [k])) for k in range(len(plant.inputs))]
        loads = [Load(name=f"load_{name}", into=into) for name, into in zip(plant.inputs, columns, strict=True)]
    else:
        loads = [
            Load(
                name=name,
                into={plant.states.index(state): factor for state, factor in section.into.items()},
                frequency=section.frequency or Real.of(0),
            )
            for name, section in estimate.items()
        ]
    return Loads.of(loads, states=len(plant.states))


def _reals(column: BallMatrix) -> dict[int, Real]:
    """Return the entries of a column that are not 0."""
    centres = [fraction_of(v) for v in column.centre.entries()]
    radii = [Fraction(0)] * len(centres)
    if column.radius is not None:
        radii = [fraction_of(v) for v in column.radius.entries()]
    return {j: Real(c, r) for j, (c, r) in enumerate(zip(centres, radii, strict=True)) if c or r}


def _vector(values: Mapping[str, float], names: Sequence[str], missing: float = 0.0) -> Array:
    """Return values in the order of names; `missing` may be infinite."""
    found = np.array([values.get(name, missing) for name in names], dtype=np.float64)
    found.flags.writeable = False
    return found


def initial_states(section: InitialSection, states: Sequence[str]) -> InitialStates:
    """Return where a run starts; states that are not named start at 0."""

    def start(values: Mapping[str, float] | Sequence[float] | None) -> Array | None:
        return _vector(values, states) if isinstance(values, Mapping) else None if values is None else readonly(values)

    plant, observer, generator = section.plant, section.observer, section.generator
    return InitialStates(
        plant=Steady() if isinstance(plant, str) else start(plant),
        observer=Measured() if isinstance(observer, str) else start(observer),
        generator=Steady()
        if isinstance(generator, str)
        else readonly(generator)
        if isinstance(generator, list)
        else generator,
    )


def regions(section: StartRegionsSection | None, states: Sequence[str], nominal: InitialStates) -> dict[str, Region]:
    """Return where the members of an ensemble start, by part; entries that are not named stay at the nominal start."""
    found: dict[str, Region] = {}
    for part in ("plant", "observer"):
        asked, start = getattr(section, part, None), getattr(nominal, part)
        if asked is None:
            continue
        center = dict.fromkeys(states, 0.0)
        if isinstance(start, np.ndarray):
            center |= zip(states, start.tolist(), strict=True)
        if isinstance(asked, EllipsoidSection):
            center |= asked.ellipsoid.center
            found[part] = EllipsoidRegion(center=_vector(center, states), radii=_vector(asked.ellipsoid.radii, states))
        else:
            low, high = zip(*(asked.get(name, [value, value]) for name, value in center.items()), strict=True)
            found[part] = BoxRegion(low=readonly(low), high=readonly(high))
    if section is not None and section.generator is not None:
        low, high = zip(*section.generator, strict=True) if section.generator else ((), ())
        found["generator"] = BoxRegion(low=readonly(low), high=readonly(high))
    return found


def build_objectives(section: DesignSection, parametric: ParametricPlant) -> Objectives:
    """Return what the gains are to achieve; `parametric` is the plant as a function of its parameters."""
    return Objectives(
        controller=_goal(section.controller, section.controller.K),
        observer=_goal(section.observer, section.observer.L),
        solver=section.solver,
        uncertain=build_box(section, parametric),
        practical=section.tracking == "practical",
    )


def _goal(section: GoalSection, given: list[list[float]] | None) -> Goal:
    """Return what a gain is to achieve; `given` is K or L itself."""
    rate, gain = section.rate, section.gain
    if given is not None:
        return Given(gain=readonly(given))
    if section.cost is not None:
        return LeastCost(Q=readonly(section.cost.Q), R=readonly(section.cost.R))
    bound = np.inf if gain is None or gain == "smallest" else gain
    if rate == "largest" or (rate is None and gain is not None):
        return Fastest(bound=bound)
    if gain == "smallest":
        return Smallest(rate=rate or 0.0)
    return AtLeast(rate=rate or 0.0, bound=bound)


def build_conditions(
    section: SimulationSection, plant: PWASystem, parametric: ParametricPlant, folder: Folder
) -> Conditions:
    """Return what is not as the theorems assume; raises as `build_courses`, and as the plant does that runs."""
    running = changed = limits = noise = disturbance = None
    if section.actuator is not None:
        limits = np.array([section.actuator.limits.get(name, [-np.inf, np.inf]) for name in plant.inputs])
    if section.noise is not None and any(section.noise.std.values()):
        std = _vector(section.noise.std, plant.outputs)
        noise = Noise(std=std, sample_time=section.noise.sample_time, seed=section.noise.seed)
    if section.disturbance is not None:
        signals = [(section.disturbance.get(name, ProfileSection()), (name,)) for name in plant.states]
        courses = all_courses(signals, folder, section.duration, ("simulation", "disturbance"))
        found = exosystem([total_signal(course, 0) for course in courses])
        disturbance = found if found.Q.any() else None
    if section.plant is not None:
        running, changed = parametric.at(section.plant.parameters, ("simulation", "plant", "parameters"))
    quantum, sampled = section.quantum, section.controller
    return Conditions(
        quanta=Quanta(inputs=_vector(quantum, plant.inputs), outputs=_vector(quantum, plant.outputs))
        if quantum
        else None,
        rates=_vector(section.rate_limit, plant.inputs, np.inf) if section.rate_limit else None,
        plant=running,
        parameters=changed,
        limits=limits if limits is not None and np.isfinite(limits).any() else None,
        disturbance=disturbance,
        noise=noise,
        sampling=Sampling(sample_time=sampled.sample_time, method=sampled.method, delay=sampled.delay)
        if sampled
        else None,
    )


def build_scenario(section: SimulationSection, states: Sequence[str], conditions: Conditions) -> Scenario:
    """Return what is simulated under given conditions."""
    initial = initial_states(section.initial, states)
    return Scenario(
        duration=section.duration,
        sample_time=section.sample_time,
        initial=initial,
        conditions=conditions,
        regions=regions(section.ensemble.initial, states, initial),
        intervals={name: (low, high) for name, (low, high) in section.ensemble.parameters.items()},
        portraits=tuple((first, second) for first, second in section.portraits),
        bands=section.settled,
    )
