"""A closed loop varied: many members of one design, and what became of them."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import Literal, cast

import numpy as np

from pwatrack.arrays import Array, IntArray, amount
from pwatrack.claims.limits import NoSaturation
from pwatrack.claims.region import LimitedRegion
from pwatrack.claims.sampled_region import SampledRegion
from pwatrack.control.controller import ProvedController
from pwatrack.errors import ExitCode, InvalidSpec, PwatrackError
from pwatrack.interruption import in_order
from pwatrack.model.conditions import Conditions
from pwatrack.simulation.closed_loop import ClosedLoop, closed_loop
from pwatrack.simulation.ensemble import Ensemble, Member, joined, simulate_ensemble
from pwatrack.simulation.figures import Figures
from pwatrack.simulation.propagate import sample_count
from pwatrack.simulation.region import BoxRegion, Region
from pwatrack.simulation.steady_state import measured_start
from pwatrack.simulation.trace import Trace
from pwatrack.spec.spec import Measured, Spec
from pwatrack.workflow.outcome import Outcome, RunMonitor, SimulatedLoop
from pwatrack.workflow.tracking import start_fixed, start_given_twice

Over = Literal["initial", "parameters", "noise", "plane"]

_MOST_KEPT = 250_000_000  # tracking errors: 2 GB
_PARTS = 4  # of an ensemble for each worker: they need not take the same time
_SPREAD = 0.05  # of the value of a parameter
_POINTS = 400  # of the edge of a region
_AS_SMALL = 2.0  # times what is left of the error in the run: a member that ends with less ends as the run does
_BEYOND = 1.2  # of what is proved of starts: how far those in a plane go


@dataclass(frozen=True, kw_only=True)
class Variation:
    """What differs between the members of an ensemble."""

    over: Over  # the kind of what differs
    values: Mapping[str, Array | IntArray]  # what was drawn, by name, one for each member
    member: Callable[[int], Member]  # returns a member by its index
    given: bool = True  # whether the spec says how much; else it is the default
    regions: Mapping[str, Region] = field(default_factory=dict)  # what the members are drawn from, by part
    names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # of the entries of each region

    @property
    def text(self) -> str:
        """What differs, in words that go after "members"."""
        words = {"initial": "from other initial states", "parameters": "with other parameters"}
        words |= {"plane": "from starts in a plane, x̂ = x"}
        return words.get(self.over, "with other noise")


@dataclass(frozen=True, kw_only=True)
class EnsembleResult:
    """What became of a closed loop in many variations."""

    nominal: SimulatedLoop  # the run that was varied
    variation: Variation  # what differs
    seed: int  # of the random numbers
    ensemble: Ensemble  # the members; number k in files and messages is index k − 1
    outcomes: tuple[Outcome, ...]  # how each member ended, judged as a single run is
    figures: tuple[Figures, ...]  # what was measured of each, as of a single run

    @property
    def failed(self) -> tuple[int, ...]:
        """The indices of members that grow or are above their bound; of starts in a plane, which show that, none."""
        if self.variation.over == "plane":
            return ()
        return tuple(number for number, outcome in enumerate(self.outcomes) if outcome.code != ExitCode.DONE)

    @property
    def small(self) -> list[bool]:
        """Of which members the error gets small: they are not off, or end as a run does that settles."""
        run = self.nominal.figures
        usual = _AS_SMALL * run.final_error if _AS_SMALL * run.final_error <= run.largest_error else 0.0
        ends = zip(self.outcomes, self.figures, strict=True)
        return [one.code == ExitCode.DONE and (one.kind != "off" or of.final_error <= usual) for one, of in ends]

    @property
    def failure(self) -> str:
        """How many members failed and how the first of them did, in words; '' if none did."""
        if not self.failed:
            return ""
        count, first = f"{len(self.failed):,} of {amount(len(self.outcomes), 'member')}", self.failed[0]
        return f"{count} fail; member {first + 1}: {self.outcomes[first].text}"


def ensemble(
    result: SimulatedLoop,
    count: int,
    *,
    over: Over = "initial",
    seed: int = 1,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Callable[[int], object] | None = None,
) -> EnsembleResult:
    """Run a simulated closed loop again in many variations: what `pwatrack.api.ensemble` does, which says the rest.

    Where the spec says no regions of initial states, each state of the plant starts within the largest size it has in
    `result` of its nominal start; where it says no intervals, each parameter that matters is within 5 % of its value.
    An executor does the work instead of threads here, `workers` parts at a time; the result does not depend on it.
    """
    spec = result.spec
    samples = sample_count(spec.scenario.duration, spec.scenario.sample_time)
    if over not in _VARIED:
        raise InvalidSpec(f"over = {over!r} is none of {', '.join(_VARIED)}", subject=None)
    if not all(isinstance(v, int | np.integer) for v in (count, seed)) or count < 1 or seed < 0:
        message = f"{count!r} members and seed {seed!r}: whole numbers, at least 1 and at least 0, are expected"
        raise InvalidSpec(message, subject=None)
    if count * samples > _MOST_KEPT:
        message = f"{count:,} members with {samples:,} samples each, at most {_MOST_KEPT:,} samples in all are kept"
        raise InvalidSpec(message, subject=None, hint="fewer members, or a longer sample_time: it moves no event")
    with spec.located():
        variation = _VARIED[over](result, count, seed)
        if executor is None:
            kept = _simulated(spec, variation, range(count), workers, progress)
        else:
            kept = _handed_on(executor, result, (over, count, seed), workers or 1, progress)
        outcomes, figures = zip(*cast("tuple[tuple[Outcome, Figures], ...]", kept.verdicts), strict=True)
        return EnsembleResult(
            nominal=result,
            variation=variation,
            seed=seed,
            ensemble=kept,
            outcomes=outcomes,
            figures=figures,
        )


def _simulated(
    spec: Spec, variation: Variation, which: range, workers: int | None, progress: Callable[[int], object] | None = None
) -> Ensemble:
    return simulate_ensemble(
        variation.member,
        len(which),
        first=which.start,
        duration=spec.scenario.duration,
        sample_time=spec.scenario.sample_time,
        workers=workers,
        progress=progress,
    )


def _handed_on(
    executor: Executor,
    result: SimulatedLoop,
    drawn: tuple[Over, int, int],
    workers: int,
    progress: Callable[[int], object] | None,
) -> Ensemble:
    """Return all members; others simulate them, in parts, each from the run and the random numbers that it draws."""
    count, known = drawn[1], replace(result, spool=None)  # which no member needs
    size = max(1, -(-count // (_PARTS * workers)))
    futures = [
        executor.submit(_part, known, *drawn, range(first, min(first + size, count))) for first in range(0, count, size)
    ]
    parts = list[Ensemble]()
    try:
        for future in in_order(futures):
            parts.append(future.result())
            if progress:
                progress(sum(len(part.verdicts) for part in parts))
    finally:
        for future in futures:
            future.cancel()
    return joined(parts)


def _part(result: SimulatedLoop, over: Over, count: int, seed: int, which: range) -> Ensemble:
    return _simulated(result.spec, _VARIED[over](result, count, seed), which, 1)


def other_starts(result: SimulatedLoop, count: int, seed: int) -> Variation:
    """Return the loop from initial states drawn from regions; parts without one start as in `result`."""
    loop, spec = result.loop, result.spec
    regions = dict(spec.scenario.regions)
    if not regions:
        x, size = result.response.x, np.abs(result.response.x).max(axis=0)
        regions = {"plant": BoxRegion(low=x[0] - size, high=x[0] + size)}
    places = {"plant": loop.at.x, "observer": loop.at.x_hat, "generator": loop.at.eta_hat}
    states, etas = spec.problem.plant.states, range(loop.at.eta_hat.stop - loop.at.eta_hat.start)
    names = {
        "plant": tuple(states),
        "observer": tuple(f"{state}_hat" for state in states),
        "generator": tuple(f"eta_hat{k + 1}" for k in etas),
    }
    starts = np.tile(result.start, (count, 1))
    for number, (part, where) in enumerate(places.items()):
        if part not in regions:
            continue
        random = np.random.default_rng([seed, number])  # so that no part depends on another
        drawn = regions[part].draw(random, count)
        if part == "generator":
            subject = ("simulation", "ensemble", "initial", "generator")
            if start_fixed(spec, result.controller):
                raise start_given_twice(subject)
            if drawn.shape[1] != len(etas):
                message = f"{'.'.join(subject)}: {amount(drawn.shape[1], 'interval')}, expected {len(etas)}, "
                raise InvalidSpec(f"{message}one for each state of the generator", subject=subject)
        starts[:, where] = drawn
    for start in starts:
        _observe(spec, loop, start)
    member = _member(result, loop)
    return Variation(
        over="initial",
        given=bool(spec.scenario.regions),
        regions=regions,
        names=names,
        values={name: x for part, at in places.items() for name, x in zip(names[part], starts[:, at].T, strict=True)},
        member=lambda number: replace(member, z0=starts[number]),
    )


def other_parameters(result: SimulatedLoop, count: int, seed: int) -> Variation:
    """Return the loop, controller as designed, with plants of class (1) whose parameters are drawn from intervals."""
    loop, spec = result.loop, result.spec
    intervals = dict(spec.scenario.intervals) or _near(result)
    names = tuple(intervals)
    low, high = np.array(list(intervals.values())).T
    box = BoxRegion(low=low, high=high)
    drawn = box.draw(np.random.default_rng([seed, 3]), count)

    def member(number: int) -> Member:
        values = dict(zip(names, drawn[number].tolist(), strict=True))
        plant, _ = spec.problem.parametric.at(_changed(result, values), _OVER)
        varied = closed_loop(loop.controller, replace(loop.conditions, plant=plant))
        text = "with " + ", ".join(f"{name} = {value:.6g}" for name, value in values.items())
        return replace(_member(result, varied), text=text)

    return Variation(
        over="parameters",
        given=bool(spec.scenario.intervals),
        regions={"plant": box},
        names={"plant": names},
        values=dict(zip(names, drawn.T, strict=True)),
        member=member,
    )


def other_noise(result: SimulatedLoop, count: int, seed: int) -> Variation:
    """Return the loop with other random numbers for its noise."""
    loop = result.loop
    noise = loop.conditions.noise
    if noise is None:
        message = "the spec has no simulation.noise: without it all members are the same"
        hint = f"for example noise: {{std: {{{result.spec.problem.plant.outputs[0]}: 1e-3}}, sample_time: 0.01}}"
        raise InvalidSpec(message, subject=("simulation",), hint=hint)
    seeds = np.random.default_rng([seed, 4]).integers(2**53, size=count)
    first = _member(result, loop)

    def member(number: int) -> Member:
        conditions = replace(loop.conditions, noise=replace(noise, seed=int(seeds[number])))
        varied, start = replace(loop, conditions=conditions), result.start.copy()
        _observe(result.spec, varied, start)
        return replace(first, z0=start, resets=tuple(varied.resets(result.spec.scenario.duration)))

    return Variation(over="noise", values={"noise_seed": seeds}, member=member)


def starts_in_a_plane(result: SimulatedLoop, count: int, seed: int) -> Variation:
    """Return the loop from x_d(0) and errors of two states, x̂ = x: around what is proved, or else as in `result`."""
    loop, plane = result.loop, list(result.spec.scenario.plane)
    if plane[0] == plane[1]:
        raise InvalidSpec("the plant has one state: there is no plane", subject=None, hint="'--over initial'")
    edges = [edge for _, edge in sections(result.controller, loop.conditions, plane)]
    sizes = [np.abs(edge).max(axis=0) for edge in edges] or [np.abs(result.response.x[:, plane]).max(axis=0)]
    most = _BEYOND * np.max(sizes, axis=0)
    random = np.random.default_rng([seed, 5])
    errors, starts = random.uniform(-most, most, size=(count, 2)), np.tile(result.start, (count, 1))
    x = np.tile(result.response.x_d[0], (count, 1))
    x[:, plane] += errors
    starts[:, loop.at.x] = starts[:, loop.at.x_hat] = x
    names, member = tuple(loop.plant.states[k] for k in plane), _member(result, loop)
    return Variation(
        over="plane",
        values=dict(zip(names, x[:, plane].T, strict=True)),
        member=lambda number: replace(member, z0=starts[number]),
    )


def sections(controller: ProvedController, conditions: Conditions, plane: Sequence[int]) -> Iterator[tuple[str, Array]]:
    """Yield what is proved of starts with limits, and the edge of the largest region of it in a plane, (s, 2).

    Nothing of another loop than the one that runs, or of a time when no load acts where one does.
    """
    angles = np.linspace(0, 2 * np.pi, _POINTS)
    circle = np.column_stack([np.cos(angles), np.sin(angles)]) * controller.sizes.state[list(plane)]
    loaded = controller.plant.loads is not None and conditions.disturbance is not None
    reached: Sequence[LimitedRegion | SampledRegion] = controller.claims_of(SampledRegion)
    never: Sequence[NoSaturation] = ()
    if replace(conditions, limits=None).nominal:
        reached, never = controller.claims_of(LimitedRegion), controller.claims_of(NoSaturation)
    elif conditions.sampling is None or conditions.sampling.delay or conditions.another_plant or loaded:
        return  # where inputs are late it is of errors later than at the start
    kinds = [("start forgotten, limits reached or not", one.left, one.found) for one in reached]
    kinds += [("no limit is reached", one.room.spare, one.promises) for one in never]
    for said, left, guarantees in kinds:
        found = (one.outline(left, plane, circle) for one in guarantees) if left is not None else ()
        edges = [edge for edge in found if edge is not None]
        if edges:
            yield said, max(edges, key=_area)


def _area(edge: Array) -> float:
    """Return the area inside a closed line of points (s, 2)."""
    x, y = edge.T
    return float(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2


_VARIED = {"initial": other_starts, "parameters": other_parameters, "noise": other_noise, "plane": starts_in_a_plane}
_OVER = ("simulation", "ensemble", "parameters")
_NUMBERS = attrgetter("A", "b", "B", "C", "tracked", "partition.H", "partition.h")  # of a plant


def _member(result: SimulatedLoop, loop: ClosedLoop) -> Member:
    spec, start = result.spec, result.start.copy()

    def judge(trace: Trace) -> tuple[Outcome, Figures]:
        watch, response = RunMonitor(loop, len(trace.t), units=spec.problem.units), loop.response(trace)
        watch.see(response)
        figures = Figures.of(response, loop, **spec.measured)
        return watch.outcome(figures), figures

    _observe(spec, loop, start)
    error, resets = loop.tracking_error / loop.controller.error_sizes[:, None], loop.resets(spec.scenario.duration)
    return Member(flow=loop.flow, z0=start, error=error, resets=tuple(resets), judge=judge)


def _observe(spec: Spec, loop: ClosedLoop, start: Array) -> None:
    """Let the observer of a member start from what is measured of its own plant, where the spec asks for it."""
    if isinstance(spec.scenario.initial.observer, Measured):
        start[loop.at.x_hat] = measured_start(loop, start[loop.at.x])


def _near(result: SimulatedLoop) -> dict[str, tuple[float, float]]:
    """Return the default: 5 % around each parameter that matters to the plant."""
    spec, plant = result.spec, result.loop.plant
    values = {**spec.parameters, **(result.loop.conditions.parameters or {})}
    intervals = {}
    for name, value in values.items():
        away = _SPREAD * abs(value)
        try:
            other, _ = spec.problem.parametric.at(_changed(result, {name: value + away}), _OVER)
        except PwatrackError as refusal:
            hint = "say under simulation.ensemble.parameters which parameters vary, and how far"
            raise type(refusal)(*(replace(p, hint=hint, remedy=None) for p in refusal.problems)) from None
        if not all(map(np.array_equal, _NUMBERS(plant), _NUMBERS(other))):
            intervals[name] = (value - away, value + away)
    if not intervals:
        message = "the spec has no simulation.ensemble.parameters, and its plant depends on no parameter"
        hint = "declare the numbers that vary under 'parameters' and use their names in 'system'"
        raise InvalidSpec(message, subject=("simulation",), hint=hint)
    return intervals


def _changed(result: SimulatedLoop, parameters: Mapping[str, float]) -> dict[str, float]:
    """Return these parameters, and those that are not as designed anyway."""
    return {**(result.loop.conditions.parameters or {}), **parameters}
