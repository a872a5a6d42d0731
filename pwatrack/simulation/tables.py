"""What is worked out once for each mode of a flow, for the compiled walk to look up."""

from threading import Lock
from typing import Any

import numpy as np

from pwatrack.arrays import EPS, OVER_SUMS, Array
from pwatrack.simulation.flow import Flow, Mode

_NEGLIGIBLE = 2.0**-56  # of a sum of positive terms
_LARGEST = 1e100  # of an entry
_MOST_BYTES = 2**30  # of tables


class Tables:
    """What is precomputed for each mode, as the kernel wants it; there is room for `most` modes."""

    def __init__(self, flow: Flow, h: float, doublings: int) -> None:
        from pwatrack.simulation.kernel import ModeTables

        self.flow, self.h, self.guards = flow, h, flow.guards().T
        (N, K), D = self.guards.shape, doublings + 1
        self.first = np.cumsum([0, *(len(part.cells) for part in flow.parts)])[:-1]
        self.met: list[Mode] = []
        self.numbers: dict[Mode, int] = {}
        self._lock = Lock()
        self.arrays = ModeTables(
            cells=np.zeros((1, len(flow.parts)), dtype=np.int64),
            sides=np.zeros((1, K), dtype=np.int64),
            F=np.zeros((1, N, N)),
            degree=np.zeros(1, dtype=np.int64),
            longest=np.zeros(1, dtype=np.int64),
            growth=np.zeros((1, D, N, N)),
            margin=np.zeros((1, D, N, K)),
            first=np.zeros((1, D, N, K)),
            second=np.zeros((1, D, N, K)),
            rounding=np.zeros((1, N, K)),
        )
        self.most = max(2, _MOST_BYTES // sum(a.nbytes for a in self.arrays))

    def known(self) -> tuple[Any, int]:
        """Return the arrays, and how many modes are filled in; what is filled in later changes none of these."""
        with self._lock:
            return self.arrays, len(self.met)

    def number(self, mode: Mode) -> int | None:
        """Return the number of a mode, None if there is no room for it; one that is new is filled in first."""
        with self._lock:
            if mode not in self.numbers and len(self.met) < self.most:
                self._add(mode)
            return self.numbers.get(mode)

    def _add(self, mode: Mode) -> None:
        m = len(self.met)
        if m == len(self.arrays.cells):
            more = min(m, self.most - m)
            self.arrays = type(self.arrays)(*(np.concatenate([a, np.zeros_like(a[:more])]) for a in self.arrays))
        arrays, guards, u = self.arrays, np.abs(self.guards), unit(len(self.guards))
        F = self.flow.matrix(mode).T * self.h
        terms = taylor(F)
        j = np.arange(len(terms))
        growth = terms[:0:-1, 0].sum(axis=0)  # e^F − 1 by itself: it keeps the digits that e^F would lose
        first, second = np.tensordot([1 / (j + 1), 1 / ((j + 1) * (j + 2))], terms[:, 1], 1)
        eye, size, absolute = terms[0, 1], terms[::-1, 1].sum(axis=0), np.abs(F)
        reach = size  # bounds on e^{Fσ}, for every σ up to the step
        off = u * (size - eye) + _NEGLIGIBLE * size  # how far growth can be from e^F − 1
        bend = np.abs(F @ F @ self.guards) + u * absolute @ absolute @ guards
        arrays.cells[m], arrays.sides[m] = self.first + mode, self.flow.sides(mode)
        arrays.F[m], arrays.degree[m], arrays.rounding[m] = F, len(terms) - 1, u * size @ guards
        for d in range(arrays.growth.shape[1]):
            arrays.growth[m, d], arrays.longest[m] = growth, d
            arrays.margin[m, d] = OVER_SUMS * (reach @ (2 * u * guards + 4.0**d / 8 * bend) + off @ guards)
            arrays.first[m, d] = OVER_SUMS * first @ guards
            arrays.second[m, d] = OVER_SUMS * second @ guards
            if d + 1 == arrays.growth.shape[1]:
                break
            with np.errstate(over="ignore", invalid="ignore"):
                stretch = np.abs(eye + growth) + off
                second = 2.0**d * first + second + second @ stretch
                first = first + first @ stretch
                off = off @ stretch + (stretch + off) @ off + u * np.abs(growth) @ np.abs(growth)
                reach = np.maximum(reach, reach @ stretch)
                growth = 2 * growth + growth @ growth
            if not np.max([second.max(), first.max(), off.max(), reach.max()]) < _LARGEST:
                break  # an unstable mode takes shorter steps
        self.numbers[mode] = m
        self.met.append(mode)


def taylor(F: Array) -> Array:
    """Return Fʲ / j! and |F|ʲ / j! from j = 0 on, as many fours as e^F takes to rounding in every entry, (J, 2, N, N).

    If term j of e^|F| is in every entry at most τ times the sum of terms 0 … j, then all from j on together are at
    most (j + 1) τ e^|F| in every entry: multiplied by |F|ⁱ j! / (j + i)!, the inequality says that term j + i is at
    most τ times the sum over q ≤ j of C(q + i, i) / C(j + i, i) ≤ 1 times term q + i, and over all i each term comes
    up to j + 1 times.

    Example: an entry that only the third term reaches is kept.

        >>> len(taylor(np.eye(4, k=1) / 4)), len(taylor(np.eye(5, k=1) / 4))
        (4, 8)
    """
    both = np.array([F, np.abs(F)])
    terms = [np.array([np.eye(len(F))] * 2)]
    whole = terms[0][1]
    while True:
        j = len(terms)
        term = terms[-1] @ both / j
        whole = whole + term[1]
        if j % 4 == 0 and ((j + 1) * term[1] <= _NEGLIGIBLE * whole).all():
            return np.array(terms)
        terms.append(term)


def unit(order: int) -> float:
    """Return what a sum of so many products, with a few steps of arithmetic, can be off by, of its terms' sizes."""
    return max(64, 2 * order) * EPS
