"""The same closed loop many times: members on all cores, of which only the tracking error is kept."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from pwatrack.arrays import Array, IntArray
from pwatrack.errors import CheckFailed
from pwatrack.simulation.flow import Flow
from pwatrack.simulation.propagate import Propagator, StateReset
from pwatrack.simulation.trace import last_tenth

_SETTLED = 0.01  # of the median of the largest errors


@dataclass(frozen=True, kw_only=True)
class Member:
    """One trajectory of an ensemble.

    Attributes:
        flow: Of order N. Neighbours with the same flow share what is computed for its modes.
        z0: Initial state, (N,).
        error: Rows with e = error z, whose norm is kept, (q, N).
        resets: In order of time.
    """

    flow: Flow
    z0: Array
    error: Array
    resets: tuple[StateReset, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Ensemble:
    """What is kept of M trajectories at K sample times.

    Attributes:
        t: Sample times in s, (K,).
        z0: Initial states, (M, N).
        error: ‖e‖ at each sample, (M, K).
        mode_changes: How many there were, (M,).
        unresolved: Touches of a guard that rounding could not decide, (M,).
    """

    t: Array
    z0: Array
    error: Array
    mode_changes: IntArray
    unresolved: IntArray

    @property
    def largest(self) -> Array:
        """The largest ‖e‖ of each member, (M,)."""
        return np.asarray(self.error.max(axis=1))

    @property
    def final(self) -> Array:
        """The largest ‖e‖ of each member in the last tenth of the time, (M,)."""
        return np.asarray(self.error[:, last_tenth(self.t)].max(axis=1))

    @property
    def settled_below(self) -> float:
        """The size of ‖e‖ that counts as settled: 1 % of the median of the largest ones."""
        return _SETTLED * float(np.median(self.largest))

    @property
    def settling_time(self) -> Array:
        """When ‖e‖ falls to `settled_below` or less for good, in s; infinity where it does not, (M,)."""
        above = self.error > self.settled_below
        samples = self.error.shape[1]
        first = np.where(above.any(axis=1), samples - np.argmax(above[:, ::-1], axis=1), 0)
        return np.asarray(np.append(self.t, np.inf)[first])


def simulate_ensemble(
    members: Sequence[Member],
    *,
    duration: float,
    sample_time: float,
    workers: int | None = None,
    progress: Callable[[int], object] | None = None,
) -> Ensemble:
    """Propagate every member from t = 0, each exactly as `simulate_flow` does.

    Args:
        members: At least one; their flows may differ.
        duration, sample_time: As for `simulate_flow`.
        workers: Threads; None for one on each core. The result does not depend on it.
        progress: Called with the number of members done, now and then.

    Raises:
        CheckFailed: If a member has more than 1,000 events without progress in time; the first one is named.

    Example: oscillators with a one-sided spring, dropped from ten heights.

        >>> from pwatrack.simulation.flow import SwitchedPart
        >>> spring = SwitchedPart(name="spring", cells=("touching", "free"), guards=np.array([[1.0, 0, 0]]),
        ...     signs=np.array([[-1], [1]]), F=np.array([[[0, 0, 0], [-9.0, 0, 0], [0, 0, 0]], np.zeros((3, 3))]))
        >>> flow = Flow(F0=np.array([[0, 1.0, 0], [-1.0, -0.5, 0], [0, 0, 0]]), parts=(spring,))
        >>> height = np.array([[1.0, 0.0, 0.0]])
        >>> members = [Member(flow=flow, z0=np.array([h, 0.0, 1.0]), error=height) for h in range(1, 11)]
        >>> ensemble = simulate_ensemble(members, duration=20.0, sample_time=0.1)
        >>> ensemble.error.shape, ensemble.largest.tolist() == list(range(1, 11)), set(ensemble.mode_changes.tolist())
        ((10, 201), True, {10})
    """
    propagators = _propagators(members, duration, sample_time)
    samples = propagators[0].samples
    error, mode_changes, unresolved = np.empty((len(members), samples)), *np.empty((2, len(members)), dtype=np.int64)

    def run(number: int) -> None:
        member, propagator = members[number], propagators[number]
        walk = propagator.walk(member.z0, member.resets)
        walk.norms(member.error, error[number])
        mode_changes[number], unresolved[number] = walk.events, walk.unresolved

    pool = ThreadPoolExecutor(workers or _cores())
    try:
        for number, done in enumerate([pool.submit(run, number) for number in range(len(members))], 1):
            try:
                done.result()
            except CheckFailed as refusal:
                raise CheckFailed(
                    *(replace(p, message=f"member {number}: {p.message}") for p in refusal.problems)
                ) from None
            if progress:
                progress(number)
    finally:
        pool.shutdown(cancel_futures=True)
    return Ensemble(
        t=sample_time * np.arange(samples, dtype=np.float64),
        z0=np.array([member.z0 for member in members]),
        error=error,
        mode_changes=mode_changes,
        unresolved=unresolved,
    )


def _propagators(members: Sequence[Member], duration: float, sample_time: float) -> list[Propagator]:
    """Return what each member is propagated by, one for neighbours with the same flow."""
    made: list[Propagator] = []
    for before, member in zip([None, *members], members, strict=False):
        shared = before is not None and before.flow is member.flow
        made.append(made[-1] if shared else Propagator(member.flow, duration=duration, sample_time=sample_time))
    return made


def _cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
