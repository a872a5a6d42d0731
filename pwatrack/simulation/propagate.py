"""Propagation of a flow from event to event, exact to rounding, with no ODE solver.

The walk itself is compiled: see `kernel`. Here a flow is balanced, handed over as arrays, and made into a trace.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from pwatrack.arrays import EPS, Array, balancing
from pwatrack.errors import CheckFailed, InvalidSpec, ProblemPart
from pwatrack.model.conditions import Sampling
from pwatrack.model.reference import StateResets
from pwatrack.simulation.controller_arrays import NONE, memory, routine
from pwatrack.simulation.flow import Clock, Flow
from pwatrack.simulation.tables import Tables, unit
from pwatrack.simulation.trace import Breaks, Event, Trace, Unresolved

MOST_STEPS = 20_000_000, 10  # of a run, and for each sample more: half a minute, and ten times what a sample takes
MOST_EVENTS = 1_000_000  # at a time in memory
_MOST_FINEST = 2.0**52  # finest steps of a run: their times must be different numbers
_MOST_RADIANS = 2.0**32  # of what oscillates for good: its phase is then right to 1e-6
_LASTING = 50.0, 1e-9  # time constants in a run, or part of its frequency, below which a decay does not count
_SEED = 1  # of the times of ticks that vary
_ON_GRID = 1e-9, 1e-15  # of a finest step, or of the time: what is nearer to the grid is on it but for rounding
_UNBOUNDED = 1e100  # no tracking loop gets there
_GROWING = ("event_time", "event_mode", "near_time", "near_guard", "near_span", "break_time", "break_mode", "break_z")


def simulate_flow(
    flow: Flow, z0: Array, *, duration: float, sample_time: float, resets: Sequence[StateResets] = ()
) -> Trace:
    """Propagate a flow from t = 0 and sample it.

    There is no step size and no tolerance: the states are those of exact arithmetic to within about ε ‖F‖ T of the
    largest one, in balanced coordinates, with ε = 2.2e-16 and T the time; 0.01 to 1.1 times that was measured
    against 50 digits. Where rounding hides on which side of a guard the state is, the trace says so.

    The initial state is (N,); the last sample is at the last multiple of `sample_time` up to the duration, both in s.
    Where some resets happen at the same time, the later ones in the list come last. Raises InvalidSpec if an entry of
    the flow is not finite, or floating point cannot resolve the run: it has more than 2⁵² finest steps, or more than
    2³² radians of an oscillation that lasts; CheckFailed if more than 1,000 events happen without progress in time, z
    grows beyond all bounds, or the run takes more than 20 million steps and 10 for each sample, has more than a million
    events, or enters more modes than there is room for.

    Example: a ball on a one-sided spring returns to its height.

        >>> from pwatrack.simulation.flow import SwitchedPart
        >>> spring = SwitchedPart(name="ball", cells=("touching", "free"), guards=np.array([[1.0, 0, 0]]),
        ...     signs=np.array([[-1], [1]]), F=np.array([[[0, 0, 0], [-100.0, 0, 0], [0, 0, 0]], np.zeros((3, 3))]))
        >>> ball = Flow(F0=np.array([[0, 1.0, 0], [0, 0, -9.81], [0, 0, 0]]), parts=(spring,))
        >>> trace = simulate_flow(ball, np.array([0.2, 0, 1.0]), duration=1.0, sample_time=0.01)
        >>> round(float(trace.z[:, 0].max()), 12), len(trace.events)
        (0.2, 2)
    """
    return Propagator(flow, duration=duration, sample_time=sample_time).walk(z0, resets).trace()


def trace_blocks(
    flow: Flow, z0: Array, *, duration: float, sample_time: float, resets: Sequence[StateResets] = (), most: int
) -> Iterator[Trace]:
    """Do what `simulate_flow` does in blocks of at most so many samples: long runs need no more memory than short ones.

    Each sample and each event is in one block. Args and raises: as `simulate_flow`.
    """
    propagator = Propagator(flow, duration=duration, sample_time=sample_time)
    walk = Walk(propagator, z0, resets, most)
    while walk.first < propagator.samples:
        walk.run()
        yield walk.block()


def sample_count(duration: float, sample_time: float) -> int:
    """Return how many samples there are from t = 0 on.

    Example:
        >>> sample_count(0.3, 0.1), sample_count(0.35, 0.1)
        (4, 4)
    """
    return int(np.floor(duration / sample_time * (1 + 1e-12))) + 1


class Propagator:
    """A flow made ready for the kernel: balanced, its grid of steps, and what is known of each mode met so far.

    Any number of trajectories may share one, from several threads at a time: what is known of a mode depends on the
    flow alone, so no trajectory depends on another.
    """

    def __init__(self, flow: Flow, *, duration: float, sample_time: float) -> None:
        from pwatrack.simulation import kernel  # imports numba, which takes a while

        if not np.isfinite(flow.size()).all():
            raise InvalidSpec("the closed loop has an entry that is not finite", hint="scale the units of its signals")
        self.d = balancing(flow.size()[None])
        self.flow = flow = flow.scaled(self.d)
        self.sample_time = sample_time
        self.samples = sample_count(duration, sample_time)
        self.places = [(part.name, k) for part in flow.parts for k in range(len(part.guards))]
        _check_resolved(flow, sample_time, self.samples)
        norm = float(np.linalg.norm(flow.size(), 2)) * sample_time
        doublings = max(0, int(np.ceil(np.log2(norm / 0.5)))) if norm > 0 else 0
        self.field = kernel.FlowTables(
            first=np.cumsum([0, *(len(part.cells) for part in flow.parts)]),
            guards=np.ascontiguousarray(flow.guards().T),
            signs=block_diag(*(part.signs for part in flow.parts)).astype(np.int64),
            h=sample_time / 2**doublings,
            doublings=doublings,
            unit=unit(len(self.d)),
        )
        self.modes = Tables(flow, self.field.h, doublings)
        nowhere = np.zeros(0, dtype=np.int64)
        never = Clock(NONE, np.zeros((0, len(self.d))), np.zeros(0), nowhere, nowhere, nowhere)
        self.clock = clock = flow.clock or never
        self.ticks = kernel.ControllerClock(
            routine=routine(clock.program),
            measured=np.ascontiguousarray((clock.measured * self.d).T),
            quantum=clock.quantum.copy(),
            source=clock.source,
            place=clock.place,
            scale=1 / self.d[clock.place],
        )

    def walk(self, z0: Array, resets: Sequence[StateResets] = ()) -> "Walk":
        """Return the trajectory from z0 (N,), or refuse it as `simulate_flow` does."""
        walk = Walk(self, z0, resets)
        walk.run()
        return walk


class Walk:
    """A trajectory in balanced coordinates: what the compiled kernel works on.

    What was written down is in `log`: `log.z` are the samples in coordinates D⁻¹ ζ, of which `first` is the number of
    the first one.
    """

    def __init__(
        self, propagator: Propagator, z0: Array, resets: Sequence[StateResets], most: int | None = None
    ) -> None:
        from pwatrack.simulation import kernel

        self.kernel, self.propagator = kernel, propagator
        flow, places, d, samples = propagator.flow, propagator.places, propagator.d, propagator.samples
        self.resets = _schedule(flow, propagator.field.h, (samples - 1) * propagator.sample_time, resets, d)
        early = int(((self.resets.step <= 0) & (self.resets.row >= 0)).sum())
        self.first, self.most = 0, samples if most is None else min(most, samples)
        self.z = z0 / d
        for k in range(early):
            where = slice(self.resets.start[k], self.resets.stop[k])
            self.z[where] = self.resets.values[self.resets.row[k], where]
        self.z = np.array(flow.relative(self.z))
        starts = propagator.field.first[:-1]
        cells = starts.copy()
        kernel.fit(propagator.field.first, propagator.field.signs, np.sign(flow.guards() @ self.z).astype(int), cells)
        first = propagator.modes.number(tuple((cells - starts).tolist()))
        self.state: Any = np.zeros(1, kernel.STATE)
        self.state[["resets", "settling", "events", "last", "m", "left"]] = early, True, 1, -1.0, first, 0
        self.state["left"] = MOST_STEPS[0] + MOST_STEPS[1] * samples
        self.near_since = np.full(len(places), np.inf)
        clock, whole = propagator.clock, self.z * d
        program, started = clock.program, np.zeros(clock.program.places["x_d"].stop)
        started[clock.source] = whole[clock.place]
        x_hat = started[program.places["x_hat"].start : program.places["s_hat"].stop]
        eta_hat = whole[clock.eta] if program.sampling.corrects else started[program.places["eta_hat"]]
        self._at = kernel.KernelState(
            state=self.state,
            z=self.z,
            near_since=self.near_since,
            crossed=np.zeros(len(places), dtype=np.bool_),
            cells=starts.copy(),
            **memory(program, x_hat, eta_hat),
            y=np.zeros(program.sizes["q"]),
        )
        self.log = kernel.Log(
            z=np.empty((min(samples, self.most + 1), len(z0))),  # one more than is given out: it may jump yet
            mode=np.zeros(min(samples, self.most + 1), dtype=np.int64),
            event_time=np.zeros(64),
            event_mode=np.zeros(64, dtype=np.int64),
            near_time=np.zeros(8 * len(places)),
            near_guard=np.zeros(8 * len(places), dtype=np.int64),
            near_span=np.zeros(8 * len(places)),
            break_time=np.zeros(64),
            break_mode=np.zeros(64, dtype=np.int64),
            break_z=np.zeros((64, len(z0))),
        )
        self.log.z[0] = self.z

    @property
    def events(self) -> int:
        """Mode changes after the start."""
        return int(self.state[0]["events"]) - 1

    @property
    def unresolved(self) -> int:
        """Places near a guard where rounding could not decide."""
        return int(self.state[0]["nears"]) + len(self._staying())

    def _staying(self) -> list[tuple[float, int, float]]:
        """Return since when, of which guard, and for how long the last state was within rounding, where it was."""
        field, found = self.propagator.field, []
        end = (self.propagator.samples - 1) * self.propagator.sample_time
        for guard in np.flatnonzero(self.near_since < np.inf).tolist():
            since = float(self.near_since[guard])
            if self.kernel.matters((end - since) / field.h, since, field):
                found.append((since, guard, end - since))
        return found

    def run(self) -> None:
        """Walk to the end of the log, with a stop wherever a new mode is entered or more room is needed."""
        kernel, field, modes = self.kernel, self.propagator.field, self.propagator.modes
        while True:
            arrays, known = modes.known()
            room = kernel.room_for(len(self.z), len(self.near_since), int(arrays.degree[:known].max()) + 1)
            stop = kernel.walk(field, arrays, known, self.resets, self.propagator.ticks, self._at, self.log, room)
            if stop == kernel.DONE:
                return self._check_bounded()
            if stop == kernel.NEW_MODE:
                if modes.number(tuple((self._at.cells - field.first[:-1]).tolist())) is None:
                    raise self._too_much(f"enters more than {modes.most:,} joint modes")
            elif stop == kernel.FULL:
                if max(self.events, int(self.state[0]["nears"])) > MOST_EVENTS:
                    raise self._too_much(f"has more than {MOST_EVENTS:,} mode changes")
                self.log = self.log._replace(
                    **{name: np.concatenate([getattr(self.log, name)] * 2) for name in _GROWING}
                )
            elif stop == kernel.SPENT:
                many, each = MOST_STEPS
                raise self._too_much(f"takes more than {many:,} steps and {each} for each sample")
            else:
                at = self.state[0]
                part, guard = self.propagator.places[at["guard"]]
                raise CheckFailed(
                    f"the {part} crosses guard {guard + 1} at t = {at['last']:.9g} s, and more than "
                    f"{kernel.MOST_IDLE:,} mode changes follow without progress in time",
                    subject=None,
                    hint="the vector field may be discontinuous there",
                )

    def _too_much(self, what: str) -> CheckFailed:
        end = (self.propagator.samples - 1) * self.propagator.sample_time
        t = float(self.state[0]["k"]) * self.propagator.field.h
        hint = (
            "a shorter duration, slower signals, or less stiff cells: the run changes or turns too fast for its length"
        )
        message = f"the run {what}: it got to t = {t:.6g} s of {end:.6g} s"
        return CheckFailed(message, subject=(ProblemPart.DURATION,), hint=hint)

    def _check_bounded(self) -> None:
        size = np.abs(self.log.z).max(axis=1)
        if not size.max() < _UNBOUNDED:
            first = (self.first + int(np.argmin(size < _UNBOUNDED))) * self.propagator.sample_time
            raise CheckFailed(
                f"the closed loop is unstable: a state is beyond {_UNBOUNDED:.0e} at t = {first:.6g} s",
                subject=None,
                hint="the proofs are about a bounded x_d, and no limits, sampling, noise or other parameters",
            )

    def norms(self, rows: Array, result: Array) -> None:
        """Write ‖rows z‖ at every sample to `result`, (K,), for rows (q, N)."""
        on = self.propagator
        self.kernel.norms(np.ascontiguousarray(on.flow.rows(rows * on.d)), self.log.z, result)

    def trace(self, count: int | None = None) -> Trace:
        """Return what was written down, or so many samples of it."""
        log, on, met = self.log, self.propagator, self.propagator.modes.met
        breaks, events, nears = (int(self.state[0][name]) for name in ("breaks", "events", "nears"))
        count = len(log.z) if count is None else count
        entered = [met[m] for m in log.event_mode[:events].tolist()]
        noted = (log.near_time, log.near_guard, log.near_span)
        near = list(zip(*(values[:nears].tolist() for values in noted), strict=True))
        last = self.first + count == on.samples
        if last:
            near += self._staying()
        return Trace(
            t=on.sample_time * np.arange(self.first, self.first + count, dtype=np.float64),
            z=on.flow.absolute(log.z[:count]) * on.d,
            modes=np.array(met)[log.mode[:count]],
            events=tuple(map(Event, log.event_time[1:events].tolist(), entered[:-1], entered[1:])),
            unresolved=tuple(
                Unresolved(t=t, part=on.places[k][0], guard=on.places[k][1], span=span) for t, k, span in near
            ),
            breaks=Breaks(
                t=log.break_time[:breaks].copy(),
                z=on.flow.absolute(log.break_z[:breaks]) * on.d,
                modes=np.array(met)[log.break_mode[:breaks]],
                until=on.sample_time * (self.first + count - last),
            ),
        )

    def block(self) -> Trace:
        """Return the samples in the log, and make room for the next ones."""
        rows, log, samples = len(self.log.z), self.log, self.propagator.samples
        count = rows if self.first + rows == samples and rows <= self.most else rows - 1
        trace = self.trace(count)
        if count < rows:  # go on from the last row; the last event says from which mode
            last, left = self.events, min(rows, samples - self.first - count)
            log.event_time[0], log.event_mode[0] = log.event_time[last], log.event_mode[last]
            self.log = log._replace(z=np.empty((left, len(self.z))), mode=np.full(left, log.mode[-1]))
            self.log.z[0] = self.z
            self.state[["base", "events", "nears", "breaks"]] = self.first + count, 1, 0, 0
        self.first += count
        return trace


def _schedule(flow: Flow, h: float, end: float, resets: Sequence[StateResets], d: Array) -> Any:
    """Return resets, of D⁻¹ z, and ticks of the clock in order of time; at the same time the resets come first."""
    from pwatrack.simulation.kernel import Resets

    times = [r.t for r in resets]
    edges = [np.tile([r.where.start, r.where.stop], (len(r.t), 1)) for r in resets]
    count = sum(map(len, times))
    row = np.arange(count)
    values = np.zeros((count, len(flow.F0)))
    for last, r in zip(np.cumsum([len(t) for t in times]), resets, strict=True):
        values[last - len(r.t) : last, r.where] = r.values / d[r.where]
    if flow.clock is not None:
        times.append(tick_times(flow.clock.program.sampling, end))
        edges.append(np.zeros((len(times[-1]), 2), dtype=np.int64))
        row = np.append(row, np.full(len(times[-1]), -1))
    step = np.concatenate([np.empty(0), *times]) / h
    grid = np.round(step)
    step = np.where(np.abs(step - grid) < np.maximum(_ON_GRID[0], _ON_GRID[1] * step), grid, step)
    order = np.lexsort((np.arange(len(step)), np.round(step, 6)))  # times that differ by rounding are the same
    start, stop = np.concatenate([np.empty((0, 2), dtype=np.int64), *edges])[order].T.copy()
    return Resets(
        step=np.maximum.accumulate(step[order]),
        row=row[order],
        start=start,
        stop=stop,
        values=values,
        counted=np.ascontiguousarray((np.zeros_like(flow.F0) if flow.counted is None else flow.counted).T),
    )


def tick_times(sampling: Sampling, end: float) -> Array:
    """Return when a clock ticks: with jitter somewhere about its times, the first at 0, so that none gets away."""
    count = sample_count(end, sampling.sample_time)
    away = np.random.default_rng(_SEED).uniform(-0.5, 0.5, size=count) * sampling.jitter
    away[:1] = 0.0
    return np.asarray(np.minimum(sampling.sample_time * np.arange(count) + away, end))


def _check_resolved(flow: Flow, sample_time: float, samples: int) -> None:
    """Refuse a run whose times or oscillations floating point cannot resolve."""
    subject, rate, end = (ProblemPart.DURATION,), float(np.linalg.norm(flow.size(), 2)), (samples - 1) * sample_time
    if not (samples - 1) * max(1.0, 4 * rate * sample_time) <= _MOST_FINEST:
        message = (
            f"{end:.6g} s are too long for a closed loop with rates of {rate:.3g} 1/s: these are {rate * end:.3g} time "
            f"constants, and {_MOST_FINEST / 4:.2g} can be told apart"
        )
        raise InvalidSpec(message, subject=subject, hint="a shorter duration, or slower poles")
    poles = np.linalg.eigvals(flow.matrix(tuple(0 for _ in flow.parts)))
    lasting = (-poles.real * end <= _LASTING[0]) | (-poles.real <= _LASTING[1] * np.abs(poles.imag))
    fastest = float(np.abs(poles.imag[lasting]).max(initial=0.0))
    if fastest * end > _MOST_RADIANS:
        message = (
            f"{end:.6g} s are too long for an oscillation of {fastest:.4g} rad/s: of {fastest * end:.3g} rad, floating "
            f"point keeps {fastest * end * EPS:.2g}; at most {_MOST_RADIANS:.2g} are taken"
        )
        raise InvalidSpec(message, subject=subject, hint="a shorter duration, or a lower frequency")
