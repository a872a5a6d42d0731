"""A primal–dual interior-point method that uses the form of the inequalities: see `linear_map`.

With slacks S_i = −A_i(v) − C_i, multipliers Z_i and y of the equality fᵀv = value, a step solves

    ΔS_i + A_i(Δv) = −C_i − A_i(v) − S_i,    fᵀΔv = value − fᵀv,    Σ A_i*(ΔZ_i) + f Δy = −c − Σ A_i*(Z_i) − f y

and the linearised S_i Z_i = μ I in the coordinates of Nesterov and Todd, where S_i and Z_i are one diagonal matrix D:
G⁻¹ S G⁻ᵀ = Gᵀ Z G = D. Mehrotra's predictor says how far μ may fall, and gives the second-order term of the corrector
(Todd, Toh and Tütüncü, On the Nesterov–Todd direction in semidefinite programming, SIAM J. Optim. 8, 1998). Nothing
need be feasible at the start.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from threadpoolctl import ThreadpoolController

from pwatrack.arrays import Array
from pwatrack.lmi.linear_map import LinearMap
from pwatrack.lmi.program import Program, Solution

_FAR = 30.0  # times the objective's coefficients: the multipliers at the start
_OFF = 1e-8  # what the linear conditions may be off at the end, relative to the data
_ROUNDED = 1e-5  # the same for the multipliers, where rounding allows no less and the bound is hardly changed
_LEAST_GAP = 1e-12  # at which it ends where the objective is near 0
_MOST = 100  # iterations
_SHORTER = 0.8  # times the step, where a matrix is not definite after it
_LEAST_STEP = 1e-7
_CENTRED = 0.3  # of μ that the least eigenvalue of S Z has at a point that is called central
_IMPOSSIBLE = 1e-9  # A*(Z) relative to tr C Z > 0, at which the Z_i are called a proof that nothing satisfies all
_RIDGES = (1e-15, 1e-13, 1e-11, 1e-9)  # of the diagonal of H, the first that will do; for m ≥ 2 it is singular along
# P = 0, Y = Ω Bᵀ, Ω skew, and near the end to working precision
_FLAT = 1e-200  # of the largest curvature: what has less is left as it is
_DENSE = 20  # order up to which all eigenvalues are cheaper than Lanczos' method
_LANCZOS = 12  # of its steps


@dataclass(frozen=True, kw_only=True)
class _Iterate:
    """v, the slacks and multipliers of each constraint, (l, N, N), and the multiplier of the equality."""

    v: Array
    S: Sequence[Array]
    Z: Sequence[Array]
    y: float


@dataclass(frozen=True, kw_only=True)
class _Scaling:
    """G, its inverse and the diagonal of D for one constraint; W = G⁻ᵀ G⁻¹."""

    G: Array
    inverse: Array
    d: Array
    W: Array


Direction = tuple[Array, list[Array], list[Array], list[Array], list[Array], float]  # Δv, ΔS, ΔZ, both scaled, Δy


def solve(program: Program, *, gap: float = 1e-7, central: bool = False) -> Solution | None:
    """Minimise from an infeasible start.

    Args:
        program: What is asked.
        gap: Between the objective and its dual bound, relative to the objective, at which it ends.
        central: Whether the answer is to be near the central path there: then P, Y and the multipliers are well inside.

    Returns:
        What was reached; None where the constraints contradict each other, or an entry is not finite.

    Example: the largest t ≤ 1 with −2 P ⪯ −t I, t I ⪯ P ⪯ I.

        >>> from pwatrack.lmi.inequality import lyapunov
        >>> from pwatrack.lmi.program import largest_margin
        >>> found = solve(largest_margin(lyapunov(-np.eye(2)[None])))
        >>> round(found.t, 6), found.violation < 0, found.gap < 1e-6
        (1.0, True, True)
    """
    if not all(np.isfinite(x).all() for c in program.constraints for x in (c.L, c.R, c.M, c.N, c.constant)):
        return None
    with _threads().limit(limits=1, user_api="blas"), np.errstate(all="ignore"):
        linear = LinearMap(program)
        found = _minimise(linear, gap, central=central)
    if found is None:
        return None
    P, Y, t = linear.parts(found.v)
    bound = sum(float(np.vdot(c, z)) for c, z in zip(linear.constants, found.Z, strict=True))
    bound -= 0.0 if program.trace is None else found.y * program.trace
    multipliers = tuple(found.Z[: len(program.constraints)])
    return Solution(program=program, P=P, Y=Y.copy(), t=t, multipliers=multipliers, bound=bound)


@cache
def _threads() -> ThreadpoolController:
    return ThreadpoolController()


def _minimise(linear: LinearMap, share: float, *, central: bool) -> _Iterate | None:
    order = sum(c.shape[0] * c.shape[1] for c in linear.constants)
    at = _start(linear)
    units = [1 + max(float(np.abs(x).max(initial=0)) for x in xs) for xs in (linear.constants, [linear.cost])]
    best, scalings = None, _scalings(at)
    for _ in range(_MOST):
        if scalings is None:
            break
        missing = [-c - a - s for c, a, s in zip(linear.constants, linear.apply(at.v), at.S, strict=True)]
        slope, lacking = -linear.cost - linear.adjoint(at.Z), 0.0
        if linear.fixed is not None:
            slope, lacking = slope - at.y * linear.fixed[0], linear.fixed[1] - float(linear.fixed[0] @ at.v)
        gap = sum(float(np.vdot(s, z)) for s, z in zip(at.S, at.Z, strict=True))
        off = max(*(float(np.abs(x).max()) for x in missing), abs(lacking)) / units[0], np.abs(slope).max() / units[1]
        wanted = max(share * abs(float(linear.cost @ at.v)), _LEAST_GAP)
        if not np.isfinite(gap) or (not max(off) <= _OFF and _impossible(linear, at)):
            return None
        if off[0] <= _OFF:
            best = at
        flat = off[1] <= _OFF or (off[1] <= _ROUNDED and abs(float(slope @ at.v)) <= wanted)
        done, mu = off[0] <= _OFF and flat and gap <= wanted, gap / order
        if done and (not central or min(float((s.d**2).min()) for s in scalings) >= _CENTRED * mu):
            return at
        direction = None
        with suppress(np.linalg.LinAlgError):  # a scaling is singular to working precision
            step = _Step(linear, scalings, missing, (slope, lacking))
            direction = step.centring(mu) if done else step.corrected(mu, wanted / 2 / order if central else 0.0)
        if direction is None:
            break
        moved = _moved(at, direction, scalings)
        if moved is None:
            break
        at, scalings = moved
    return best


def _impossible(linear: LinearMap, at: _Iterate) -> bool:
    """Say whether the multipliers show that no v has A(v) + C ⪯ 0 (and the equality): A*(Z) + f y = 0, tr C Z > f y."""
    value = sum(float(np.vdot(c, z)) for c, z in zip(linear.constants, at.Z, strict=True))
    rest = linear.adjoint(at.Z)
    if linear.fixed is not None:
        rest, value = rest + at.y * linear.fixed[0], value - at.y * linear.fixed[1]
    return bool(value > 0 and np.abs(rest).max() <= _IMPOSSIBLE * value)


def _start(linear: LinearMap) -> _Iterate:
    """Return multiples of I that are large beside the data."""
    S, Z = [], []
    for constant, size in zip(linear.constants, linear.sizes, strict=True):
        N = constant.shape[1]
        largest = float(np.linalg.norm(constant, axis=(1, 2)).max())
        eye = np.broadcast_to(np.eye(N), constant.shape)
        S.append(max(1.0, largest, size) * np.sqrt(N) * eye)
        Z.append(_FAR * max(1.0, float(np.abs(linear.cost).max())) * eye)
    return _Iterate(v=np.zeros(linear.size), S=S, Z=Z, y=0.0)


def _scalings(at: _Iterate) -> list[_Scaling] | None:
    """Return the scalings; None if a slack or multiplier is not positive definite."""
    found = []
    with suppress(np.linalg.LinAlgError):
        for S, Z in zip(at.S, at.Z, strict=True):
            L = np.linalg.cholesky(S)
            values, Q = np.linalg.eigh(np.swapaxes(L, 1, 2) @ Z @ L)
            if not values.min() > 0:
                return None
            d = np.sqrt(values)
            root = np.sqrt(d)
            G = (L @ Q) / root[:, None]
            inverse = np.swapaxes(Q * root[:, None], 1, 2) @ np.linalg.inv(L)
            found.append(_Scaling(G=G, inverse=inverse, d=d, W=np.swapaxes(inverse, 1, 2) @ inverse))
        return found
    return None


class _Step:
    """The linear equations of one iteration, factorized once."""

    def __init__(
        self, linear: LinearMap, scalings: Sequence[_Scaling], missing: Sequence[Array], slope: tuple[Array, float]
    ) -> None:
        self.linear, self.scalings, self.missing = linear, scalings, missing
        self.slope, self.lacking = slope
        self.W = [scaling.W for scaling in scalings]
        self.H = linear.normal(self.W)
        self.factor = _factor(self.H)
        self.known = linear.adjoint([w @ x @ w for w, x in zip(self.W, missing, strict=True)])
        self.away = None if linear.fixed is None else self._inverse(linear.fixed[0])

    def corrected(self, mu: float, least: float) -> Direction | None:
        """Return Mehrotra's direction towards a smaller μ, at least so large."""
        first = self.towards([-_diagonal(s.d) for s in self.scalings])
        if first is None:
            return None
        _, _, _, s, z, _ = first
        lengths = [min(1.0, length) for length in _lengths(s, z, self.scalings)]
        after = sum(
            float(np.vdot(_diagonal(scaling.d) + lengths[0] * s_c, _diagonal(scaling.d) + lengths[1] * z_c))
            for s_c, z_c, scaling in zip(s, z, self.scalings, strict=True)
        )
        order = sum(scaling.d.size for scaling in self.scalings)
        sigma = min(1.0, max(0.0, after / order / mu)) ** max(1.0, 3 * min(lengths) ** 2)
        aim, targets = max(sigma * mu, least), []
        for s_c, z_c, scaling in zip(s, z, self.scalings, strict=True):
            both, d = s_c @ z_c, scaling.d
            target = -(both + np.swapaxes(both, 1, 2)) / (d[:, :, None] + d[:, None])
            targets.append(target + _diagonal(aim / d - d))
        return self.towards(targets)

    def centring(self, mu: float) -> Direction | None:
        """Return the direction to S Z = μ I."""
        return self.towards([_diagonal(mu / s.d - s.d) for s in self.scalings])

    def towards(self, targets: Sequence[Array]) -> Direction | None:
        """Return the direction on which both changes, scaled, add up to these."""
        if self.factor is None:
            return None
        wanted = [
            np.swapaxes(s.inverse, 1, 2) @ target @ s.inverse for s, target in zip(self.scalings, targets, strict=True)
        ]
        right, dy = self.slope + self.known - self.linear.adjoint(wanted), 0.0
        dv = self._inverse(right)
        if self.linear.fixed is not None and self.away is not None:
            row = self.linear.fixed[0]
            dy = float((row @ dv - self.lacking) / (row @ self.away))
            dv = dv - dy * self.away
        if not np.isfinite(dv).all():
            return None
        dS = [x - a for x, a in zip(self.missing, self.linear.apply(dv), strict=True)]
        s = [
            scaling.inverse @ x @ np.swapaxes(scaling.inverse, 1, 2)
            for x, scaling in zip(dS, self.scalings, strict=True)
        ]
        z = [target - s_c for target, s_c in zip(targets, s, strict=True)]
        dZ = [
            np.swapaxes(scaling.inverse, 1, 2) @ z_c @ scaling.inverse
            for z_c, scaling in zip(z, self.scalings, strict=True)
        ]
        return dv, dS, dZ, s, z, dy

    def _inverse(self, right: Array) -> Array:
        """Return the solution of the equations, refined once, of which H is what is left when W is eliminated."""
        if self.factor is None:
            return np.full_like(right, np.nan)
        d, factor = self.factor
        main = self.linear.without_W(right, self.W)
        found = d * cho_solve(factor, d * main, check_finite=False)
        found = found + d * cho_solve(factor, d * (main - self.H @ found), check_finite=False)
        return self.linear.with_W(found, right, self.W)


def _moved(at: _Iterate, direction: Direction, scalings: Sequence[_Scaling]) -> tuple[_Iterate, list[_Scaling]] | None:
    """Return the next iterate, almost at the boundary, and its scalings; None if there is no way to go."""
    dv, dS, dZ, s, z, dy = direction
    lengths = _lengths(s, z, scalings)
    share = 0.9 + 0.09 * min(1.0, *lengths)
    primal, dual = (min(1.0, share * length) for length in lengths)
    while max(primal, dual) >= _LEAST_STEP:
        moved = _Iterate(
            v=at.v + primal * dv,
            S=[S + primal * step for S, step in zip(at.S, dS, strict=True)],
            Z=[Z + dual * step for Z, step in zip(at.Z, dZ, strict=True)],
            y=at.y + dual * dy,
        )
        found = _scalings(moved)
        if found is not None:
            return moved, found
        primal, dual = _SHORTER * primal, _SHORTER * dual
    return None


def _lengths(s: Sequence[Array], z: Sequence[Array], scalings: Sequence[_Scaling]) -> tuple[float, float]:
    """Return how far S and Z may go along a direction, scaled, before they leave their cones."""
    least = [0.0, 0.0]
    for s_c, z_c, scaling in zip(s, z, scalings, strict=True):
        root = 1 / np.sqrt(scaling.d)
        for place, change in enumerate((s_c, z_c)):
            least[place] = min(least[place], _least_eigenvalue(root[:, :, None] * change * root[:, None]))
    first, second = (1 / -value if value < -1e-6 else 1e6 for value in least)
    return first, second


def _least_eigenvalue(X: Array) -> float:
    """Return the least eigenvalue of a stack of symmetric matrices; of large ones a bound by Lanczos' method."""
    cells, N, _ = X.shape
    if N <= _DENSE:
        return float(np.linalg.eigvalsh(X).min())
    q = np.broadcast_to(_direction(N), (cells, N)).copy()
    before, beta = np.zeros_like(q), np.zeros(cells)
    T = np.zeros((cells, _LANCZOS, _LANCZOS))
    for k in range(_LANCZOS):
        w = (X @ q[:, :, None])[:, :, 0] - beta[:, None] * before
        T[:, k, k] = (w * q).sum(axis=1)
        w -= T[:, k, k][:, None] * q
        beta = np.linalg.norm(w, axis=1)
        if k + 1 < _LANCZOS:
            T[:, k, k + 1] = T[:, k + 1, k] = beta
        before, q = q, w / np.maximum(beta, 1e-300)[:, None]
    values, vectors = np.linalg.eigh(T)
    return float((values[:, 0] - beta * np.abs(vectors[:, -1, 0])).min())


@cache
def _direction(N: int) -> Array:
    """Return a unit vector that is not likely to be special."""
    x = np.random.default_rng(N).normal(size=N)
    return np.asarray(x / np.linalg.norm(x))


def _diagonal(d: Array) -> Array:
    """Return diagonal matrices, (l, N, N), of their diagonals."""
    return np.asarray(d[:, :, None] * np.eye(d.shape[1]))


def _factor(H: Array) -> tuple[Array, tuple[Array, bool]] | None:
    """Return scales d and the Cholesky factor of diag(d) H diag(d), with as small a ridge as will do."""
    diagonal = np.diag(H)
    if not np.isfinite(diagonal).all() or not diagonal.max() > 0:
        return None
    d = 1 / np.sqrt(np.where(diagonal > _FLAT * diagonal.max(), diagonal, np.inf))
    scaled = H * d[:, None] * d
    own = np.diag(scaled).copy()
    for ridge in _RIDGES:
        np.fill_diagonal(scaled, np.where(own > 0, own + ridge, 1.0))
        with suppress(np.linalg.LinAlgError):
            return d, cho_factor(scaled, lower=True, check_finite=False)
    return None
