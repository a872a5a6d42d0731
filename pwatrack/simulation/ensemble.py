"""The same closed loop many times: members on all cores, of which only the tracking error is kept."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from pwatrack.arrays import Array, IntArray
from pwatrack.cores import cores
from pwatrack.errors import PwatrackError
from pwatrack.interruption import in_order, uninterrupted
from pwatrack.model.reference import StateResets
from pwatrack.simulation.flow import Flow
from pwatrack.simulation.propagate import Propagator, sample_count
from pwatrack.simulation.trace import Trace, last_tenth

_SMALL = 0.01  # of the median of the largest errors


@dataclass(frozen=True, kw_only=True)
class Member:
    """One trajectory of an ensemble."""

    flow: Flow  # of order N; those with the flow of the first member share what is computed for its modes
    z0: Array  # initial state, (N,)
    error: Array  # rows with e = error z, whose norm is kept, (q, N)
    resets: tuple[StateResets, ...] = ()
    text: str = ""  # what is said of it where it fails
    judge: Callable[[Trace], object] | None = None  # says how it went, from any thread; see `Ensemble.verdicts`


@dataclass(frozen=True, kw_only=True)
class Ensemble:
    """What is kept of M trajectories at K sample times."""

    t: Array  # sample times in s, (K,)
    error: Array  # ‖e‖ at each sample, (M, K)
    mode_changes: IntArray  # how many there were, (M,)
    unresolved: IntArray  # touches of a guard that rounding could not decide, (M,)
    verdicts: tuple[object, ...]  # what each member's `judge` said of it, None without one, (M,)

    @property
    def largest(self) -> Array:
        """The largest ‖e‖ of each member, (M,)."""
        return np.asarray(self.error.max(axis=1))

    @property
    def final(self) -> Array:
        """The largest ‖e‖ of each member in the last tenth of the time, (M,)."""
        return np.asarray(self.error[:, last_tenth(len(self.t))].max(axis=1))

    @property
    def small(self) -> float:
        """The size of ‖e‖ that counts as small beside the others: 1 % of the median of the largest ones."""
        return _SMALL * float(np.median(self.largest))

    @property
    def small_from(self) -> Array:
        """When ‖e‖ falls to `small` or less for good, in s; infinity where it does not, (M,)."""
        above = self.error > self.small
        first = np.where(above.any(axis=1), self.error.shape[1] - np.argmax(above[:, ::-1], axis=1), 0)
        return np.asarray(np.append(self.t, np.inf)[first])


def joined(parts: Sequence[Ensemble]) -> Ensemble:
    """Return the ensemble whose members are those of its parts, in order."""
    names = ("error", "mode_changes", "unresolved")
    each = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return replace(parts[0], **each, verdicts=tuple(verdict for part in parts for verdict in part.verdicts))


def simulate_ensemble(
    member: Callable[[int], Member],
    count: int,
    *,
    duration: float,
    sample_time: float,
    first: int = 0,
    workers: int | None = None,
    progress: Callable[[int], object] | None = None,
) -> Ensemble:
    """Propagate every member from t = 0, each exactly as `simulate_flow` does.

    `member` returns one by its index, from any thread, when its turn comes; `first` is the index of the first of them,
    and their flows may differ. `workers` are threads, None for one on each core; the result does not depend on it.
    `progress` is called with the number of members done, now and then. Raises PwatrackError: what `member` raises, and
    CheckFailed as `simulate_flow`; the first such member is named.
    """
    samples = sample_count(duration, sample_time)
    error, mode_changes, unresolved = np.empty((count, samples)), *np.empty((2, count), dtype=np.int64)
    verdicts: list[object] = [None] * count
    with _named(f"member {first + 1}"):
        flow = member(first).flow
    shared = Propagator(flow, duration=duration, sample_time=sample_time)

    def run(number: int) -> None:
        label = f"member {first + number + 1}"
        with _named(label):
            one = member(first + number)
        with _named(f"{label}, {one.text}" if one.text else label):
            on = shared if one.flow is flow else Propagator(one.flow, duration=duration, sample_time=sample_time)
            walk = on.walk(one.z0, one.resets)
        walk.norms(one.error, error[number])
        mode_changes[number], unresolved[number] = walk.events, walk.unresolved
        if one.judge is not None:
            verdicts[number] = one.judge(walk.trace())

    pool = ThreadPoolExecutor(workers or cores())
    try:
        with uninterrupted():
            futures = [pool.submit(run, number) for number in range(count)]
        for number, future in enumerate(in_order(futures), 1):
            future.result()  # what the first of them raises ends it
            if progress:
                progress(number)
    finally:
        pool.shutdown(cancel_futures=True)
    return Ensemble(
        t=sample_time * np.arange(samples, dtype=np.float64),
        error=error,
        mode_changes=mode_changes,
        unresolved=unresolved,
        verdicts=tuple(verdicts),
    )


@contextmanager
def _named(label: str) -> Iterator[None]:
    """Let every refusal raised inside begin with what it is about."""
    try:
        yield
    except PwatrackError as refusal:
        problems = (replace(p, message=f"{label}: {p.message}") for p in refusal.problems)
        raise type(refusal)(*problems) from None
