"""Exact propagation of a flow from event to event, with no ODE solver.

Inside a mode z(t + τ h) = Σ_j T_j z τʲ with T_j = (F h)ʲ / j!. The step h is
so short that 16 terms are the matrix exponential to rounding. The same terms,
seen through the guards, say whether any guard is crossed on the step; whole
blocks of steps are cleared with one matrix product.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from pwatrack.arrays import Array, IntArray, balancing
from pwatrack.errors import Problem, PwatrackError
from pwatrack.simulation.events import bernstein_matrix, first_crossing
from pwatrack.simulation.flow import Flow, Mode
from pwatrack.simulation.trace import Event, Trace

_DEGREE = 15  # ‖F h‖ ≤ 1/2 leaves a remainder below 2⁻⁵⁶ of the sum
_BLOCK = 16  # steps cleared at once
_ROUNDING = 64 * float(np.finfo(np.float64).eps)
_STUCK = 1000  # events without progress in time
_SAME_TIME = 1e-12  # relative, or in s before t = 1 s


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
        The samples, the mode at each and every event in between.

    Raises:
        PwatrackError: If 1,000 events happen without progress in time.

    Example: a ball on a one-sided spring returns to its height.

        >>> from pwatrack.simulation.flow import SwitchedPart
        >>> spring = SwitchedPart(name="ball", cells=("touching", "free"), guards=np.array([[1.0, 0, 0]]),
        ...     signs=np.array([[-1], [1]]), F=np.array([[[0, 0, 0], [-100.0, 0, 0], [0, 0, 0]], np.zeros((3, 3))]))
        >>> ball = Flow(F0=np.array([[0, 1.0, 0], [0, 0, -9.81], [0, 0, 0]]), parts=(spring,))
        >>> trace = simulate_flow(ball, np.array([0.2, 0, 1.0]), duration=1.0, sample_time=0.01)
        >>> round(float(trace.z[:, 0].max()), 12), len(trace.events)
        (0.2, 2)
    """
    d = balancing(flow.size()[None])
    balanced = flow.scaled(d)
    halvings = _halvings(balanced.size(), sample_time)
    samples = int(np.floor(duration / sample_time * (1 + 1e-12))) + 1
    h = sample_time / 2**halvings
    scaled = [_GridReset(_snapped(r.t / h), r.where, r.value / d[r.where]) for r in resets]
    walk = _Walk(balanced, z0 / d, h, scaled)
    z = np.empty((samples, len(z0)))
    modes = np.empty((samples, len(flow.parts)), dtype=np.int64)
    z[0], modes[0] = walk.z, walk.mode
    stride = 2**halvings
    end = (samples - 1) * stride
    while walk.k < end:
        first = walk.k
        mode = walk.mode
        states = walk.forward(min(_BLOCK, end - first))
        for k in range(first + 1, walk.k + 1):
            if k % stride == 0:
                z[k // stride], modes[k // stride] = states[k - first - 1], mode if k < walk.k else walk.mode
    return Trace(t=sample_time * np.arange(samples, dtype=np.float64), z=z * d, modes=modes, events=tuple(walk.events))


@dataclass(frozen=True)
class _GridReset:
    """A reset with its time in steps."""

    step: float
    where: slice
    value: Array


class _Walk:
    """A trajectory on the grid of step h: state, mode and step index, and the events so far."""

    def __init__(self, flow: Flow, z0: Array, h: float, resets: list[_GridReset]) -> None:
        self.flow = flow
        self.h = h
        self.resets = resets[::-1]
        self.guards = flow.guards()
        self.tables: dict[Mode, _Table] = {}
        self.events: list[Event] = []
        self.z = z0
        self.k = 0
        if self.resets and self.resets[-1].step <= 0:
            self._reset()
        self.mode = self._settle(None, set())

    def forward(self, steps: int) -> Array:
        """Advance by up to `steps` whole steps, at least one; return the state after each."""
        table = self.table(self.mode)
        if self.resets:
            steps = min(steps, int(self.resets[-1].step - self.k))
        if steps <= 0:
            self._step_with_events()
            self.k += 1
            return self.z[None]
        states = table.powers[:steps] @ self.z
        clear = table.clear(np.vstack([self.z, states[:-1]]))
        count = steps if clear.all() else int(np.argmin(clear))
        if count == 0:
            self._step_with_events()
            self.k += 1
            return self.z[None]
        self.z = states[count - 1]
        self.k += count
        return states[:count]

    def table(self, mode: Mode) -> "_Table":
        """Return what is precomputed for a mode."""
        if mode not in self.tables:
            self.tables[mode] = _Table.of(self.flow, mode, self.guards, self.h)
        return self.tables[mode]

    def _step_with_events(self) -> None:
        """Advance by one step in which guards may be crossed and resets may fall."""
        done = 0.0
        while self.resets and self.resets[-1].step < self.k + 1:
            done = self._part(done, max(done, self.resets[-1].step - self.k))
            self._reset()
            self._change_mode(self._settle(self.mode, set()), done)
        self._part(done, 1.0)

    def _reset(self) -> None:
        """Carry out all resets that fall on the same instant."""
        self.z, step = self.z.copy(), self.resets[-1].step
        while self.resets and self.resets[-1].step <= step:
            reset = self.resets.pop()
            self.z[reset.where] = reset.value

    def _part(self, done: float, end: float) -> float:
        """Advance from `done` to `end`, in steps from k, and return `end`."""
        idle, crossed = 0, set[int]()
        while True:
            rest = end - done
            table = self.table(self.mode)
            terms = (table.terms @ self.z) * rest ** np.arange(_DEGREE + 1)[:, None]
            crossing = self._first_event(table, terms, crossed)
            if crossing is None:
                self.z = terms.sum(axis=0)
                return end
            tau, guard = crossing
            self.z = _horner(terms, tau)
            done += tau * rest
            idle, crossed = (idle + 1, {*crossed, guard}) if tau * rest < 1e-15 else (0, {guard})
            self._change_mode(self._settle(self.mode, crossed), done)
            if idle > _STUCK:
                time = (self.k + done) * self.h
                raise PwatrackError(
                    Problem(
                        message=f"more than {_STUCK} mode changes at t = {time:.9g} s without progress in time",
                        subject=None,
                        hint="the vector field may be discontinuous there",
                    )
                )

    def _change_mode(self, mode: Mode, done: float) -> None:
        """Record a mode change; changes within rounding of each other are one."""
        if mode == self.mode:
            return
        t, before = (self.k + done) * self.h, self.mode
        if self.events and t - self.events[-1].t <= _SAME_TIME * max(1.0, t):
            t, before = self.events[-1].t, self.events.pop().before
        if mode != before:
            self.events.append(Event(t=t, before=before, after=mode))
        self.mode = mode

    def _first_event(self, table: "_Table", terms: Array, crossed: set[int]) -> tuple[float, int] | None:
        """Return (τ, guard) of the first crossing out of the current cells; `crossed` guards start at 0."""
        values = terms @ table.active.T
        values[0, np.isin(table.index, list(crossed))] = 0.0
        tolerance = table.rounding(self.z)[table.index]
        best: tuple[float, int] | None = None
        for column, guard in enumerate(table.index):
            crossing = first_crossing(values[:, column], float(tolerance[column]))
            if crossing and not crossing.grazing and (best is None or crossing.tau < best[0]):
                best = crossing.tau, int(guard)
        return best

    def _settle(self, current: Mode | None, crossed: set[int]) -> Mode:
        """Return the mode that the trajectory enters from its present state.

        A guard at 0 counts by its first derivative that is not 0: the field
        is continuous, so that derivative is the same on both sides.
        """
        for _ in range(len(self.guards) + 1):
            start = current or self.flow.mode_on(np.sign(self.guards @ self.z).astype(np.int64), None)
            terms = self.table(start).terms @ self.z
            values = terms @ self.guards.T
            significant = np.abs(values) > self.table(start).rounding(self.z)
            significant[0, list(crossed)] = False
            order = significant.argmax(axis=0)
            leading = values[order, np.arange(len(self.guards))]
            sides = np.where(significant.any(axis=0), np.sign(leading), 0).astype(np.int64)
            mode = self.flow.mode_on(sides, current)
            if current is not None or mode == start:
                return mode
            current = mode
        return mode


@dataclass(frozen=True, kw_only=True)
class _Table:
    """Precomputed for one mode and step h.

    Attributes:
        terms: T_j = (F h)ʲ / j!, (16, N, N).
        powers: exp(F h)ᵏ for k = 1 …, (16, N, N).
        active: Guards that bound the mode, turned so that they are positive inside, (K, N).
        index: Their numbers among all guards, (K,).
        enclosure: Bernstein coefficients of the active guards on the step as rows on z, (K · 16, N).
        size: Bounds |guard| on the step by size |z|, for all guards, (all, N).
    """

    terms: Array
    powers: Array
    active: Array
    index: IntArray
    enclosure: Array
    size: Array

    @classmethod
    def of(cls, flow: Flow, mode: Mode, guards: Array, h: float) -> "_Table":
        Fh = flow.matrix(mode) * h
        terms = [np.eye(len(Fh))]
        for j in range(1, _DEGREE + 1):
            terms.append(terms[-1] @ Fh / j)
        step = expm(Fh)
        powers = [step]
        while len(powers) < _BLOCK:
            powers += [powers[-1] @ p for p in powers]
        sides = flow.sides(mode)
        index = np.flatnonzero(sides)
        active = guards[index] * sides[index, None]
        rows = np.einsum("bj,kn,jnm->kbm", bernstein_matrix(_DEGREE), active, np.array(terms))
        return cls(
            terms=np.array(terms),
            powers=np.array(powers),
            active=active,
            index=index,
            enclosure=rows.reshape(-1, len(Fh)),
            size=np.abs(guards) @ np.abs(np.array(terms)).sum(axis=0),
        )

    def clear(self, states: Array) -> Array:
        """Say for each state (s, N) whether no active guard can reach 0 on the step that follows it."""
        least = (states @ self.enclosure.T).reshape(len(states), len(self.index), _DEGREE + 1).min(axis=2)
        return np.asarray((least > self.rounding(states)[:, self.index]).all(axis=1))

    def rounding(self, z: Array) -> Array:
        """Return the size below which each guard (…, all) at a state z (…, N) cannot be told from 0."""
        result: Array = _ROUNDING * (np.abs(z) @ self.size.T)
        return result


def _halvings(size: Array, sample_time: float) -> int:
    norm = float(np.linalg.norm(size, 2)) * sample_time
    return max(0, int(np.ceil(np.log2(norm / 0.5)))) if norm > 0 else 0


def _snapped(step: float) -> float:
    """Return a time in steps, on the grid if it is there but for rounding."""
    return float(round(step)) if abs(step - round(step)) < 1e-9 else step


def _horner(terms: Array, tau: float) -> Array:
    total: Array = terms[-1]
    for term in terms[-2::-1]:
        total = total * tau + term
    return total
