"""Sizes: the deviation that matters of each signal, in its own unit. They are the norm that a design speaks of.

Those that nobody gives are what makes the numbers of the plant as nearly 1 as can be: one convex problem.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from scipy.sparse import csr_matrix

from pwatrack.arrays import Array, readonly
from pwatrack.model.pwa import PWASystem

_PULL = 1e-3  # of the square of a logarithm beside x²/2 − log x: enough for one solution, to rounding
_STEPS = 200  # of Newton's method at most
_SHORTEST = 1e-3  # of a step, which rounding may stop
_ENDED = 1e-26  # of the cost: what a last step may still take off it; the step itself is the root of that
_STEEPEST = 5.0  # of a logarithm, above which x²/2 goes on as a parabola: about all that pull can keep a number there
_LOOSE = 1e-6  # what is left of a unit vector outside the range of a matrix of whole numbers
Origin = Literal["given", "limits", "reference", "noise", "ensemble", "balanced"]

_LARGEST = 150.0  # of the logarithm of a size


def numbers(A: Array, B: Array, C: Array) -> tuple[Array, csr_matrix]:
    """Return the numbers of a plant that are not 0 and, for each, how its logarithm depends on those of the sizes.

    a_jk x_k / (x_j speed), b_jk u_k / (x_j speed) and c_jk x_k / y_j: columns for states, inputs, outputs, speed.
    """
    n, m = B.shape
    whole = np.block([[A, B], [C, np.zeros((len(C), m))]])
    place = np.concatenate([np.arange(n), n + m + np.arange(len(C))])  # of the signal that a row is about
    row, column = np.nonzero(whole)
    count, last = len(row), n + m + len(C)
    moving = np.flatnonzero(row < n)
    at = np.concatenate([np.arange(count), np.arange(count), moving])
    of = np.concatenate([column, place[row], np.full(len(moving), last)])
    sign = np.concatenate([np.ones(count), -np.ones(count + len(moving))])
    return whole[row, column], csr_matrix((sign, (at, of)), shape=(count, last + 1))


def nearest_to_one(rows: csr_matrix, offset: Array, states: int) -> Array:
    """Return the θ (k,) of the least Σ e^{2r}/2 − r + ε r² with r = rows θ + offset, by Newton's method.

    Of many such θ it is one whose first entries, those of states, are small.

    Example: ẋ = 3 u with a speed of 1: u is a third of x.

        >>> theta = nearest_to_one(csr_matrix([[-1.0, 1.0]]), np.log([3.0]), 1)
        >>> np.exp(theta).round(6).tolist()
        [1.0, 0.333333]
    """
    gram = (rows.T @ rows).toarray()
    values, vectors = np.linalg.eigh(gram)
    still = vectors[:, values < _LOOSE]  # directions that change no r
    theta = np.linalg.solve(gram + still @ still.T, -(rows.T @ offset))
    value, slope, bend = _cost(rows @ theta + offset)
    for _ in range(_STEPS):
        H = (rows.T @ rows.multiply(bend[:, None])).toarray()
        step = -np.linalg.solve(H + (1 + np.trace(H)) * still @ still.T, rows.T @ slope)
        towards, share = float(slope @ (rows @ step)), 1.0
        trial = _cost(rows @ (theta + step) + offset)
        while trial[0] > value + share * towards / 4 and share > _SHORTEST:
            share /= 2
            trial = _cost(rows @ (theta + share * step) + offset)
        theta, (value, slope, bend) = theta + share * step, trial
        if -towards < _ENDED * abs(value):
            break
    shift = np.linalg.lstsq(still[:states], theta[:states], rcond=None)[0]
    return np.asarray(theta - still @ shift)


def _cost(r: Array) -> tuple[float, Array, Array]:
    """Return Σ e^{2r}/2 − r + ε r², and of each term the first and the second derivative."""
    squares, beyond = np.exp(2 * np.minimum(r, _STEEPEST)), np.maximum(r - _STEEPEST, 0.0)
    value = float((squares * (0.5 + beyond + beyond**2) - r + _PULL * r**2).sum())
    return value, squares * (1 + 2 * beyond) - 1 + 2 * _PULL * r, 2 * squares + 2 * _PULL


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """How far each signal may be off before it matters, and how fast that is.

    With z = x / state, v = u / input, w = y / output and time τ = speed · t all numbers of a plant have no unit. So
    what is said there, such as |z| = 1 or weights of one, does not depend on the units of the file.

    Example: a mass of 2 kg whose position matters to 0.1 m, and its speed to 1 m/s. It takes about 20 N.

        >>> A, B, C = np.array([[[0.0, 1.0], [0.0, 0.0]]]), np.array([[0.0], [0.5]]), np.array([[1.0, 0.0]])
        >>> sizes = Sizes.balanced(A, B, C, state=[0.1, 1.0])
        >>> round(sizes.speed, 9), sizes.input.round(9).tolist(), sizes.output.round(9).tolist()
        (10.0, [20.0], [0.1])
    """

    state: Array  # (n,), positive, as are all
    input: Array  # (m,)
    output: Array  # (q,)
    speed: float  # in 1/s: a state moves by about its size in 1 / speed
    origins: Mapping[str, Origin] = field(default_factory=dict)  # by name of the signal, where its size is from
    load: Array = field(default_factory=lambda: np.zeros(0))  # of states of loads, (p,)
    where: tuple[int, ...] = ()  # which of these each load is
    tracked: Array = field(default_factory=lambda: np.zeros(0))  # of what is tracked, (p,)

    @classmethod
    def of(
        cls, plant: PWASystem, known: Mapping[str, tuple[float, Origin]] | None = None, *, tempo: float = 1.0
    ) -> "Sizes":
        """Return the sizes of a plant: those `known` by name, and where they are from; and what balances it with them.

        `tempo` is the speed in 1/s of a plant that has none of its own, as a chain of integrators.
        """
        known = known or {}
        kinds = (plant.states, plant.inputs, plant.outputs)
        state, input_, output = ([known.get(name, (np.nan, "balanced"))[0] for name in names] for names in kinds)
        found = cls.balanced(plant.A, plant.B, plant.C, state=state, input_=input_, output=output, tempo=tempo)
        loads = plant.loads
        names = [name for kind in (*kinds, () if loads is None else loads.names) for name in kind]
        forms = np.linalg.norm(plant.tracked * found.state, axis=1)
        outputs = dict(zip(plant.outputs, found.output.tolist(), strict=True))
        tracked = [
            known[name][0] if name in known else outputs.get(name, size)
            for name, size in zip(plant.tracked_names, forms.tolist(), strict=True)
        ]
        load = np.zeros(0) if loads is None else loads.sizes(found.state, found.speed, known)
        return replace(
            found,
            load=load,
            where=() if loads is None else loads.where,
            tracked=readonly(tracked),
            origins={name: known[name][1] if name in known else "balanced" for name in names},
        )

    @classmethod
    def balanced(
        cls,
        A: Array,
        B: Array,
        C: Array | None = None,
        *,
        state: Sequence[float] | None = None,
        input_: Sequence[float] | None = None,
        output: Sequence[float] | None = None,
        tempo: float = 1.0,
    ) -> "Sizes":
        """Return sizes that make every number of A and B, with time in 1 / speed, and of C as nearly 1 as can be.

        That is the least Σ x²/2 − log x + ε (log x)² over the sizes x of all numbers that are not 0 (of A the largest
        over the cells): x²/2 − log x is least at 1, much larger above it and little larger below, so that a number
        which is nearly 0 counts for little. In the logarithms of the sizes it is convex, and other units shift its
        solution by their ratio: the sizes found are the same in all of them. Where the numbers leave the speed open,
        it is `tempo`. What they leave open besides is one factor for all sizes of a part of the plant, which matters to
        no gain.

        A is (l, n, n), B (n, m), C (q, n); of what is known NaN stands for what is not.
        """
        n, m = B.shape
        C = np.zeros((0, n)) if C is None else C
        parts = ((state, n), (input_, m), (output, len(C)))
        known = np.concatenate([np.full(k, np.nan) if part is None else np.asarray(part) for part, k in parts])
        values, rows = numbers(np.abs(A).max(axis=0), np.abs(B), np.abs(C))
        logs = np.append(np.log(known), np.nan)
        gram = (rows[:, np.isnan(logs)].T @ rows[:, np.isnan(logs)]).toarray()
        unit = np.eye(len(gram))[-1]
        if not np.abs(gram @ np.linalg.lstsq(gram, unit, rcond=None)[0] - unit).max() < _LOOSE:
            logs[-1] = np.log(tempo)  # its column is in the span of the others
        free = np.isnan(logs)
        offset = np.log(values) + rows[:, ~free] @ logs[~free]
        logs[free] = nearest_to_one(rows[:, free], offset, int(free[:n].sum()))
        sizes = readonly(np.exp(np.clip(logs, -_LARGEST, _LARGEST)))
        return cls(state=sizes[:n], input=sizes[n : n + m], output=sizes[n + m : -1], speed=float(sizes[-1]))

    @property
    def by_name(self) -> dict[str, float]:
        """The size of each signal that has a name."""
        sizes = np.concatenate([self.state, self.input, self.output, self.load[list(self.where)]]).tolist()
        return dict(zip(self.origins, sizes, strict=True)) if self.origins else {}

    def gain(self, K: Array) -> Array:
        """Return the gain of u = K x (m, n) in sizes: by how many the inputs move for one of a state."""
        return np.asarray(K * self.state / self.input[:, None])

    def correction(self, L: Array) -> Array:
        """Return a gain of x' = L y, or of x̂⁺ = x̂ + M y, (n, q), in sizes."""
        return np.asarray(L * self.output / np.append(self.state, self.load)[:, None])

    def norm(self, K: Array) -> float:
        """Return the spectral norm of a gain K (m, n) of the controller, counted in sizes."""
        return float(np.linalg.norm(self.gain(K), 2))

    def norms(self, K: Array, L: Array) -> tuple[float, float]:
        """Return how large the gains of u = K x (m, n) and of x' = L y (n, q) are: ‖E⁻¹ K S‖, and in 1/s ‖S⁻¹ L E‖."""
        return self.norm(K), float(np.linalg.norm(self.correction(L), 2))

    def dual(self) -> "Sizes":
        """Return those of the transposed plant, whose input matrix is Cᵀ and whose gain is Lᵀ.

        There 1 / speed stands beside the output: an output that is off by its size weighs as much as a state that is
        pushed by its size in 1 / speed.
        """
        state = 1 / np.append(self.state, self.load)
        return replace(
            self,
            state=state,
            input=self.speed / self.output,
            output=1 / self.input,
            load=np.zeros(0),
            where=(),
            origins={},
        )
