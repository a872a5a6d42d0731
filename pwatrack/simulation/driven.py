"""Linear modes that a reference drives: the stable ones forward in time, the unstable ones backward, for any time."""

from math import factorial

import numpy as np
from scipy.linalg import schur, solve_sylvester

from pwatrack.arrays import Array, balancing
from pwatrack.model.reference import Exosystem, spectral_terms

_TAYLOR = 14  # terms of e^{M t} for ‖M t‖ ≤ 1/2: the next is below 1e-16


class SplitModes:
    """A_i split into its stable and its unstable part, A_i V = V diag(Λ_s, Λ_u), each driven by the reference."""

    def __init__(self, A: Array, B: Array, turns: "ReferenceTransition") -> None:
        T, Z, q = schur(A, sort="lhp")
        X = solve_sylvester(T[:q, :q], -T[q:, q:], -T[:q, q:]) if 0 < q < len(A) else np.zeros((q, len(A) - q))
        unit = np.eye(len(A))
        unit[:q, q:] = X
        self.stable, self.V = q, Z @ unit
        unit[:q, q:] = -X
        W = unit @ Z.T
        self.forward = Driven(T[:q, :q], (W @ B)[:q], turns, 1.0)
        self.backward = Driven(-T[q:, q:], -(W @ B)[q:], turns, -1.0)


class ReferenceTransition:
    """t ↦ e^{S t} of the reference and the constant 1, in closed form."""

    def __init__(self, system: Exosystem) -> None:
        self.S = np.zeros((len(system.w0) + 1,) * 2)
        self.S[:-1, :-1] = system.S
        self._terms = spectral_terms(system.S, system.rates)

    def __call__(self, t: Array) -> Array:
        """Return it at some times, (K, s + 1, s + 1)."""
        found = np.zeros((len(t), *self.S.shape))
        found[:, -1, -1] = 1.0
        for rate, chain in self._terms:
            for m, E in enumerate(chain):
                found[:, :-1, :-1] += (np.multiply.outer(np.exp(rate * t) * t**m / factorial(m), E)).real
        return found


class Driven:
    """v' = Λ v + B w with w' = ±S w and Λ stable: v(t) = E(t) v(0) + F(t) w(0), for many t ≥ 0.

    By doubling: E(2t) = E(t)², F(2t) = E(t) F(t) + F(t) e^{±S t}, from a t so short that a Taylor polynomial is exact.
    Of E what it adds to 1 is kept, or slow modes beside fast ones would lose their digits. What lasts, e^{±S t}, is in
    closed form, so that errors do not double with it.
    """

    def __init__(self, L: Array, B: Array, turns: ReferenceTransition, sign: float) -> None:
        self._q, self._turns, self._sign = len(L), turns, sign
        self._M = np.block([[L, B], [np.zeros((len(turns.S), len(L))), sign * turns.S]])
        self._d = balancing(self._M[None])
        self._M = self._M / self._d[:, None] * self._d
        self._norm = float(np.abs(self._M).sum(axis=1).max())

    def __call__(self, t: Array) -> tuple[Array, Array]:
        """Return E, (K, q, q), and F, (K, q, s + 1)."""
        q, d = self._q, self._d
        halvings = int(np.ceil(np.log2(max(1.0, 2 * self._norm * float(t.max(initial=0.0))))))
        first = t / 2.0**halvings
        step = np.multiply.outer(first, self._M)
        total = unit = np.broadcast_to(np.eye(len(self._M)), step.shape)
        for k in range(_TAYLOR, 1, -1):
            total = unit + step @ total / k
        total = step @ total * d[:, None] / d
        G, F = total[:, :q, :q], total[:, :q, q:]
        for k in range(halvings):
            G, F = 2 * G + G @ G, F + G @ F + F @ self._turns(self._sign * first * 2.0**k)
        return np.eye(q) + G, F
