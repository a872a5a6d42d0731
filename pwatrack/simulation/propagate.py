"""Exact propagation of a flow from event to event, with no ODE solver.

The walk itself is compiled: see `kernel`. Here a flow is balanced, handed over
as arrays, and what comes back becomes a trace.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from pwatrack.arrays import Array, balancing
from pwatrack.errors import CheckFailed, Problem
from pwatrack.simulation.flow import Flow, Mode
from pwatrack.simulation.trace import Event, Trace, Unresolved

_DEGREE = 15  # ‖F h‖ ≤ 1/2 leaves a remainder below 2⁻⁵⁶ of the sum
_ROUNDING = 64 * float(np.finfo(np.float64).eps)  # of the size of its terms: a smaller sum may be 0
_OUTWARD = 1 + 1e-12  # covers the rounding of a sum of positive terms
_GROWING = ("event_time", "event_mode", "near_time", "near_guard")


@dataclass(frozen=True, kw_only=True)
class StateReset:
    """At time t (s) the entries `where` of z take new values."""

    t: float
    where: slice
    value: Array


def simulate_flow(
    flow: Flow, z0: Array, *, duration: float, sample_time: float, resets: Sequence[StateReset] = ()
) -> Trace:
    """Propagate a flow from t = 0 and sample it.

    Args:
        flow: The flow, of order N.
        z0: Initial state (N,).
        duration: In s; the last sample is at the last multiple of `sample_time` up to it.
        sample_time: In s.
        resets: In order of time.

    Returns:
        The samples, the mode at each, every event in between, and where rounding could not decide.

    Raises:
        CheckFailed: If more than 1,000 events happen without progress in time.

    Example: a ball on a one-sided spring returns to its height.

        >>> from pwatrack.simulation.flow import SwitchedPart
        >>> spring = SwitchedPart(name="ball", cells=("touching", "free"), guards=np.array([[1.0, 0, 0]]),
        ...     signs=np.array([[-1], [1]]), F=np.array([[[0, 0, 0], [-100.0, 0, 0], [0, 0, 0]], np.zeros((3, 3))]))
        >>> ball = Flow(F0=np.array([[0, 1.0, 0], [0, 0, -9.81], [0, 0, 0]]), parts=(spring,))
        >>> trace = simulate_flow(ball, np.array([0.2, 0, 1.0]), duration=1.0, sample_time=0.01)
        >>> round(float(trace.z[:, 0].max()), 12), len(trace.events)
        (0.2, 2)
    """
    (trace,) = trace_blocks(flow, z0, duration=duration, sample_time=sample_time, resets=resets)
    return trace


def trace_blocks(
    flow: Flow,
    z0: Array,
    *,
    duration: float,
    sample_time: float,
    resets: Sequence[StateReset] = (),
    most: int | None = None,
) -> Iterator[Trace]:
    """Do what `simulate_flow` does in blocks of at most so many samples: long runs need no more memory than short ones.

    Each sample and each event is in one block. Args and raises: as `simulate_flow`.
    """
    d = balancing(flow.size()[None])
    samples = sample_count(duration, sample_time)
    scaled = [StateReset(t=r.t, where=r.where, value=r.value / d[r.where]) for r in resets]
    walk = _Walk(flow.scaled(d), z0 / d, samples, min(samples, most or samples), sample_time, scaled)
    while walk.first < samples:
        yield walk.block(d)


def sample_count(duration: float, sample_time: float) -> int:
    """Return how many samples there are from t = 0 on.

    Example:
        >>> sample_count(0.3, 0.1), sample_count(0.35, 0.1)
        (4, 4)
    """
    return int(np.floor(duration / sample_time * (1 + 1e-12))) + 1


class _Walk:
    """A trajectory in balanced coordinates: what the compiled kernel works on."""

    def __init__(
        self, flow: Flow, z0: Array, samples: int, most: int, sample_time: float, resets: Sequence[StateReset]
    ) -> None:
        from pwatrack.simulation import kernel  # imports numba, which takes a while

        self.kernel, self.flow, self.sample_time, self.samples, self.most = kernel, flow, sample_time, samples, most
        self.first = 0  # sample of the next block
        self.places = [(part.name, k) for part in flow.parts for k in range(len(part.guards))]
        doublings = _doublings(flow.size(), sample_time)
        h = sample_time / 2**doublings
        self.field = kernel.Field(
            first=np.cumsum([0, *(len(part.cells) for part in flow.parts)]),
            guards=np.ascontiguousarray(flow.guards().T),
            signs=block_diag(*(part.signs for part in flow.parts)).astype(np.int64),
            h=h,
            doublings=doublings,
        )
        self.resets = _schedule(flow, h, (samples - 1) * sample_time, resets)
        early = sum(reset.t <= 0 for reset in resets)
        self.z = z0.copy()
        for reset in resets[:early]:
            self.z[reset.where] = reset.value
        self.modes = _Modes(flow, h, doublings)
        self.modes.add(flow.mode_on(np.sign(flow.guards() @ self.z).astype(np.int64), None))
        self.state: Any = np.zeros(1, kernel.STATE)
        self.state[["resets", "settling", "events", "last"]] = early, True, 1, -1.0
        self.near_since, self.crossed = np.full(len(self.places), np.inf), np.zeros(len(self.places), dtype=np.bool_)
        self.log = kernel.Log(
            z=np.empty((min(samples, most + 1), len(z0))),  # one more than is given out: it may jump yet
            mode=np.zeros(min(samples, most + 1), dtype=np.int64),
            event_time=np.zeros(64),
            event_mode=np.zeros(64, dtype=np.int64),
            near_time=np.zeros(4 * len(self.places)),
            near_guard=np.zeros(4 * len(self.places), dtype=np.int64),
        )
        self.log.z[0] = self.z

    def block(self, d: Array) -> Trace:
        """Walk through the next block of samples and return it, in coordinates D z."""
        self._run()
        rows, state = len(self.log.z), self.state[0]
        count = rows if self.first + rows == self.samples and rows <= self.most else rows - 1
        trace = self._trace(d, count)
        if count < rows:  # go on from the last row; the last event says from which mode
            left = min(rows, self.samples - self.first - count)
            last = int(state["events"]) - 1
            self.log.event_time[0], self.log.event_mode[0] = self.log.event_time[last], self.log.event_mode[last]
            mode = self.log.mode[-1]
            self.log = self.log._replace(z=np.empty((left, len(self.z))), mode=np.zeros(left, dtype=np.int64))
            self.log.z[0], self.log.mode[0] = self.z, mode
            self.state[["base", "events", "nears"]] = self.first + count, 1, 0
        self.first += count
        return trace

    def _run(self) -> None:
        """Walk to the end of the log, with a stop wherever a new mode is entered or more room is needed."""
        kernel, first = self.kernel, self.field.first[:-1]
        cells = first.copy()
        while True:
            stop = kernel.walk(
                self.field,
                self.modes.arrays,
                len(self.modes.met),
                self.resets,
                self.state,
                self.z,
                self.near_since,
                self.crossed,
                cells,
                self.log,
            )
            if stop == kernel.DONE:
                return
            if stop == kernel.NEW_MODE:
                self.modes.add(tuple((cells - first).tolist()))
            elif stop == kernel.FULL:
                self.log = self.log._replace(**{name: np.tile(getattr(self.log, name), 2) for name in _GROWING})
            else:
                at = self.state[0]
                part, guard = self.places[at["guard"]]
                raise CheckFailed(
                    Problem(
                        message=f"the {part} crosses guard {guard + 1} at t = {at['last']:.9g} s, and more than "
                        f"{kernel.MOST_IDLE:,} mode changes follow without progress in time",
                        subject=None,
                        hint="the vector field may be discontinuous there",
                    )
                )

    def _trace(self, d: Array, count: int) -> Trace:
        """Return so many rows of what was written down."""
        log, events, nears = self.log, int(self.state[0]["events"]), int(self.state[0]["nears"])
        entered = [self.modes.met[m] for m in log.event_mode[:events].tolist()]
        near = sorted(zip(log.near_time[:nears].tolist(), log.near_guard[:nears].tolist(), strict=True))
        return Trace(
            t=self.sample_time * np.arange(self.first, self.first + count, dtype=np.float64),
            z=log.z[:count] * d,
            modes=np.array(self.modes.met)[log.mode[:count]],
            events=tuple(map(Event, log.event_time[1:events].tolist(), entered[:-1], entered[1:])),
            unresolved=tuple(Unresolved(t=t, part=self.places[k][0], guard=self.places[k][1]) for t, k in near),
        )


class _Modes:
    """What is precomputed for each mode, as the kernel wants it; there is always room for one more."""

    def __init__(self, flow: Flow, h: float, doublings: int) -> None:
        from pwatrack.simulation.kernel import Modes

        N, K, D = len(flow.F0), len(flow.guards()), doublings + 1
        self.flow, self.h = flow, h
        self.first = np.cumsum([0, *(len(part.cells) for part in flow.parts)])[:-1]
        self.met: list[Mode] = []
        self.arrays = Modes(
            cells=np.zeros((1, len(flow.parts)), dtype=np.int64),
            sides=np.zeros((1, K), dtype=np.int64),
            F=np.zeros((1, N, N)),
            growth=np.zeros((1, D, N, N)),
            first=np.zeros((1, D, N, K)),
            second=np.zeros((1, D, N, K)),
            rounding=np.zeros((1, N, K)),
            jumps=np.zeros((1, len(flow.clock.maps) if flow.clock else 0, N, N)),
        )

    def add(self, mode: Mode) -> None:
        """Fill in one more mode."""
        m = len(self.met)
        if m == len(self.arrays.cells):
            self.arrays = type(self.arrays)(*(np.concatenate([a, np.zeros_like(a)]) for a in self.arrays))
        self.met.append(mode)
        arrays, guards = self.arrays, np.abs(self.flow.guards().T)
        F = self.flow.matrix(mode).T * self.h
        eye, growth = np.eye(len(F)), np.zeros_like(F)
        for j in range(_DEGREE, 0, -1):  # e^{F h} − 1 by Horner's rule: it keeps the digits that e^{F h} would lose
            growth = (F + F @ growth) / j
        absolute = np.abs(F)
        term = size = first = eye
        second = eye / 2
        for j in range(1, _DEGREE + 1):
            term = term @ absolute / j
            size, first, second = size + term, first + term / (j + 1), second + term / ((j + 1) * (j + 2))
        arrays.cells[m], arrays.sides[m] = self.first + mode, self.flow.sides(mode)
        arrays.F[m], arrays.rounding[m] = F, _ROUNDING * size @ guards
        for number in range(arrays.jumps.shape[1]):
            arrays.jumps[m, number] = self.flow.jump(number, mode).T
        for d in range(arrays.growth.shape[1]):
            arrays.growth[m, d] = growth
            arrays.first[m, d] = _OUTWARD * first @ guards
            arrays.second[m, d] = _OUTWARD * second @ guards
            stretch = np.abs(eye + growth)
            second = 2.0**d * first + second + second @ stretch
            first = first + first @ stretch
            growth = 2 * growth + growth @ growth


def _schedule(flow: Flow, h: float, end: float, resets: Sequence[StateReset]) -> Any:
    """Return resets and ticks of the clock in order of time; at the same time the resets come first."""
    from pwatrack.simulation.kernel import Resets

    times, maps = [reset.t for reset in resets], [-1] * len(resets)
    if flow.clock is not None:
        count = len(flow.clock.maps)
        ticks = flow.clock.period * np.arange(int(end / flow.clock.period * (1 + 1e-12)) + 1)
        times += np.repeat(ticks, count)[flow.clock.first :].tolist()
        maps += np.tile(np.arange(count), len(ticks))[flow.clock.first :].tolist()
    step = np.array([_snapped(t / h) for t in times], dtype=np.float64)
    order = np.lexsort((np.arange(len(step)), np.round(step, 6)))  # times that differ by rounding are the same
    row = np.append(np.arange(len(resets)), np.zeros(len(step) - len(resets), dtype=np.int64))
    edges = np.zeros((len(step), 2), dtype=np.int64)
    values = np.zeros((len(resets), len(flow.F0)))
    for k, reset in enumerate(resets):
        edges[k] = reset.where.start, reset.where.stop
        values[k, reset.where] = reset.value
    return Resets(
        step=np.maximum.accumulate(step[order]),
        map=np.array(maps, dtype=np.int64)[order],
        start=edges[order, 0],
        stop=edges[order, 1],
        row=row[order].astype(np.int64),
        values=values,
    )


def _doublings(size: Array, sample_time: float) -> int:
    norm = float(np.linalg.norm(size, 2)) * sample_time
    return max(0, int(np.ceil(np.log2(norm / 0.5)))) if norm > 0 else 0


def _snapped(step: float) -> float:
    """Return a time in steps, on the grid if it is there but for rounding."""
    return float(round(step)) if abs(step - round(step)) < max(1e-9, 1e-15 * step) else step
