"""Unknown loads that act on a plant: constants, or sinusoids of known frequency."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import product

import numpy as np
from numpy.typing import NDArray

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix, above, beside
from pwatrack.model.reference import Exosystem, spectral_terms
from pwatrack.real import Real


@dataclass(frozen=True, kw_only=True)
class Load:
    """d added to ẋ with a factor for each state; d is constant, or a sinusoid, of unknown size and phase."""

    name: str
    into: Mapping[int, Real]  # factors by the number of the state
    frequency: Real = Real(Fraction(0))  # in rad/s; 0 for a constant  # noqa: RUF009 - it is frozen

    @property
    def order(self) -> int:
        """How many states make it: d, and for a sinusoid ḋ / frequency."""
        return 2 if self.frequency.centre else 1


@dataclass(frozen=True, kw_only=True)
class Loads:
    """All loads together: ẋ = A_i x + b_i + B u + E s with ṡ = S s; d_k is the entry `where[k]` of s.

    Example: a constant on the first of two states, and a sinusoid of 3 rad/s on the second.

        >>> from pwatrack.model.reference import Exosystem, spectral_terms
        >>> from pwatrack.real import Real
        >>> loads = Loads.of([Load(name="leak", into={0: Real.of(-1)}),
        ...     Load(name="hum", into={1: Real.of(2)}, frequency=Real.of(3))], states=2)
        >>> loads.E.floats.tolist(), loads.S.floats.tolist(), loads.where
        ([[-1.0, 0.0, 0.0], [0.0, 2.0, 0.0]], [[0.0, 0.0, 0.0], [0.0, 0.0, 3.0], [0.0, -3.0, 0.0]], (0, 1))
    """

    each: tuple[Load, ...]
    E: BallMatrix  # (n, p)
    S: BallMatrix  # (p, p), in 1/s; a sinusoid is d' = ω a, a' = −ω d

    @classmethod
    def of(cls, loads: Sequence[Load], *, states: int) -> "Loads":
        """Return some loads of a plant with so many states."""
        zero, p = Real.of(0), sum(load.order for load in loads)
        E = [[zero] * p for _ in range(states)]
        S = [[zero] * p for _ in range(p)]
        start = 0
        for load in loads:
            for state, factor in load.into.items():
                E[state][start] = factor
            if load.order == 2:
                S[start][start + 1], S[start + 1][start] = load.frequency, -load.frequency
            start += load.order
        return cls(each=tuple(loads), E=BallMatrix.of(E, (states, p)), S=BallMatrix.of(S, (p, p)))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the loads."""
        return tuple(load.name for load in self.each)

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the entries of s: of a sinusoid the load, and what it is a quarter of a period later."""
        each = ((load.name, f"{load.name} a quarter on")[: load.order] for load in self.each)
        return tuple(name for names in each for name in names)

    @property
    def load_of(self) -> tuple[str, ...]:
        """Of which load each entry of s is."""
        return tuple(load.name for load in self.each for _ in range(load.order))

    @property
    def where(self) -> tuple[int, ...]:
        """Which entry of s each load is."""
        return tuple(np.cumsum([0, *(load.order for load in self.each)])[:-1].tolist())

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """The entries of s that belong to each load."""
        return tuple(tuple(range(k, k + load.order)) for k, load in zip(self.where, self.each, strict=True))

    def inputs(self, B: BallMatrix) -> tuple[int, ...] | None:
        """Return the input of B (n, m) that each load is added to, if all are constants added to inputs, exactly."""
        (n, m), found = B.shape, []
        if self.E.radius is not None or B.radius is not None or len(self.where) < self.S.shape[0]:
            return None
        sizes = np.linalg.norm(B.floats, axis=0)
        if int(np.linalg.matrix_rank(B.floats / np.where(sizes, sizes, 1.0))) < m:
            return None
        columns = [B.part(range(n), [k]).centre for k in range(m)]
        for k in range(self.E.shape[1]):
            same = [j for j, column in enumerate(columns) if column == self.E.part(range(n), [k]).centre]
            found += same[:1]
        return tuple(found) if len(found) == self.E.shape[1] else None

    def observed(self, A_i: BallMatrix) -> BallMatrix:
        """Return [A_i, E; 0, S]: the plant and its loads as one system, which the observer runs."""
        nothing = BallMatrix.of(np.zeros((self.S.shape[0], A_i.shape[0])))
        return above(beside(A_i, self.E), beside(nothing, self.S))

    def sizes(self, state: Array, speed: float, known: Mapping[str, tuple[float, object]]) -> Array:
        """Return the size of each entry of s: the known one, else that which pushes x by a size in 1 / speed."""
        sizes = speed / np.linalg.norm(self.E.floats / state[:, None], axis=0)[list(self.where)]
        sizes = [
            known[name][0] if name in known else size for name, size in zip(self.names, sizes.tolist(), strict=True)
        ]
        return np.repeat(sizes, [load.order for load in self.each])

    def are(self, disturbance: Exosystem) -> bool:
        """Say whether a disturbance is such loads at all times: nothing is left over, steps or drifts."""
        return not disturbance.resets and self.make(disturbance)

    def make(self, disturbance: Exosystem) -> bool:
        """Say whether a disturbance is such loads from each step to the next: nothing is left over, or drifts."""
        Q, rates = disturbance.Q, disturbance.rates
        left = Q - self.E.floats[:, self.where] @ self.truth(Q, rates)
        frequencies = {float(load.frequency) for load in self.each}
        starts = disturbance.states(np.append(0.0, disturbance.breaks))
        for (rate, chain), w in product(spectral_terms(disturbance.S, rates), starts):
            first, *more = (E @ w for E in chain)
            missed = np.abs(left @ first).max(initial=0.0) > 1e-12 * (np.abs(Q) @ np.abs(first)).max(initial=0.0)
            if missed or abs(rate) not in frequencies or rate.real or np.any(more):
                return False
        return True

    def truth(self, Q: Array, rates: NDArray[np.complex128]) -> Array:
        """Return rows that read the loads off the exosystem of a disturbance w: what of E d they can make up.

        A load takes what has its own frequency: a constant all that does not oscillate, also where it steps or drifts.
        The disturbance on ẋ is Q w, Q (n, s), its `rates` are as those of `Exosystem`; the rows are (loads, s).
        """
        rows, columns = np.zeros((len(self.each), Q.shape[1])), self.E.floats[:, self.where]
        frequencies = np.array([float(load.frequency) for load in self.each])
        for frequency in np.unique(frequencies):
            same = frequencies == frequency
            oscillates = np.abs(rates - 1j * frequency) <= 1e-12 * frequency if frequency else rates.imag == 0
            rows[same] = np.linalg.pinv(columns[:, same]) @ np.where(oscillates, Q, 0.0)
        return rows
