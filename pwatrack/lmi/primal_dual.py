"""A primal–dual interior-point method that uses the form of the inequalities: see `linear_map`.

With slacks S_i = −A_i(v) − C_i, multipliers Z_i and y of the equalities F v = values, a step solves

    ΔS_i + A_i(Δv) = −C_i − A_i(v) − S_i,    F Δv = values − F v,    Σ A_i*(ΔZ_i) + Fᵀ Δy = −c − Σ A_i*(Z_i) − Fᵀ y

and the linearised S_i Z_i = μ I in the coordinates of Nesterov and Todd, where S_i and Z_i are one diagonal matrix D:
E S Eᵀ = E⁻ᵀ Z E⁻¹ = D. Mehrotra's predictor says how far μ may fall, and gives the second-order term of the corrector
(Todd, Toh and Tütüncü, On the Nesterov–Todd direction in semidefinite programming, SIAM J. Optim. 8, 1998). Nothing
need be feasible at the start.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from threadpoolctl import ThreadpoolController

from pwatrack.arrays import Array
from pwatrack.lmi.blocks import Scaling, step_lengths
from pwatrack.lmi.linear_map import DenseMap, LinearMap
from pwatrack.lmi.program import SemidefiniteProgram, Solution

_FAR = 15.0  # times the objective's coefficients: the multipliers at the start
_OFF = 1e-8  # what the linear conditions may be off at the end, relative to the data
_ROUNDED = 1e-5  # the same for the multipliers, where rounding allows no less and the bound is hardly changed
_EXACT = 1e-12  # likewise: what is off by less is as exact as rounding allows
_NONE = 1e-14  # of the data: what v lacks is rounding
_STALLED = 0.1  # of the gap that is wanted: where it is so small, and the multipliers are still off, they stay so
_PATIENCE, _FALLEN = 5, 0.7  # iterations, and what the gap falls to in them: else rounding allows no less
_SIGN, _SOON = 0.5, 0.1  # gap above which a sign is all that is asked for, and the one that leads to it soonest
# times the least gap so far, where the constraints are satisfied: there rounding is all that makes it grow; elsewhere
# the multipliers do, as nothing satisfies all
_LOST = 1e3
_LEAST_GAP = 1e-12  # at which it ends where the objective is near 0
_MOST = 60  # iterations: answers that count take at most 50
_SHORTER = 0.8  # times the step, where a matrix is not definite after it
_LEAST_STEP = 1e-7  # below which there is no way to go
_CORRECTIONS = 2  # made to the direction
_LONGER = 1.02  # times the product of the step lengths, what a correction must bring
_SHARE = (0.85, 0.995)  # of the way to the boundary, where that is short and where it is a whole step
_NOTHING = 1e-3  # of the objective of the program before it in a sequence: what counts as 0
_MARGIN, _WIDER = 0.01, 12  # t < 0 that a start near a known answer has, and how often it is made four times so large
_CHANGED = 0.1  # of the largest mean of S Z that an answer has in the next program: μ that this one begins with
_IMPOSSIBLE = 1e-8  # A*(Z) relative to tr C Z > 0, at which the Z_i are called a proof that nothing satisfies all
_DENSE = 2e6  # multiplications in a step, up to which one matrix for the whole program is quicker than its form


@dataclass(frozen=True, kw_only=True)
class _Iterate:
    """v, A(v), slacks and multipliers of all constraints, as a vector each, and the multipliers of the equalities."""

    v: Array
    image: Array
    s: Array
    z: Array
    y: Array


class _Move(NamedTuple):
    """Changes of v, of y, and of S and Z as D sees them, stack by stack."""

    v: Array
    y: Array
    s: list[Array]
    z: list[Array]


def solve(
    program: SemidefiniteProgram, *, gap: float = 1e-7, against: float | None = None, after: Solution | None = None
) -> Solution | None:
    """Minimise from an infeasible start.

    It ends at a gap between the objective and its dual bound, a share of the objective. With a number `against` it ends
    where the objective is less, and where it cannot be, of which P and Y need not be exact: the gap is a share of the
    distance. `after` is the answer to a program with constraints of the same shapes and nearly the same entries: it is
    begun there, and where that leads nowhere begun again; an objective far below the one before counts as 0.

    Returned is what was reached, or multipliers that say that nothing can be; None where it is stuck. With a large gap
    P, Y and the multipliers are well inside what they must satisfy, unless the objective is less than that number.
    """
    with _threads().limit(limits=1, user_api="blas"), np.errstate(all="ignore"):
        linear = _map(program)
        nothing = 0.0 if after is None else _NOTHING * abs(after.objective)
        continued = None if after is None else _continued(linear, after)
        found = None if continued is None else _minimise(linear, continued, gap, against, nothing)
        if found is None or found[2] or _lost(linear, found[0], gap, against, nothing):
            found = _minimise(linear, _start(linear), gap, against, nothing)
    if found is None:
        return None
    at, iterations, impossible = found
    unit = _Rest(linear, at).value if impossible else 1.0
    multipliers = tuple(Z / unit for Z in linear.blocks.parts(at.z)[: len(program.constraints)])
    P, Y, t = linear.parts(at.v)
    return Solution(
        program=program, P=P, Y=Y.copy(), t=t, multipliers=multipliers, impossible=impossible, iterations=iterations
    )


def least(linear: LinearMap, *, gap: float, against: float | None = None, near: Array | None = None) -> Array | None:
    """Return v that satisfies the constraints with nearly the least cost; None where none does, or it is stuck.

    With a number `against` it ends where the cost is less, and where it cannot be, as `solve` does. Where the cost is
    the last entry, which is a margin, it may begin `near` a v of which the others are good.

    Example: the largest t with t I ⪯ 2 P, tr P = 1.

        >>> from pwatrack.lmi.chain_map import Bound, ChainMap
        >>> map_of_P = ChainMap([Bound({0: (-np.eye(1), np.eye(1))}, np.eye(1))], 1)
        >>> least(map_of_P, gap=1e-6)[-1].round(4)
        np.float64(2.0)
    """
    with _threads().limit(limits=1, user_api="blas"), np.errstate(all="ignore"):
        begun = None if near is None else _centred(linear, near)
        found = None if begun is None else _minimise(linear, begun, gap, against, 0.0, proof=False)
        rest = None if found is None else _Rest(linear, found[0])
        good = rest is not None and against is not None and rest.objective < against
        known = rest is not None and np.abs(rest.slope).max() <= _ROUNDED * (1 + np.abs(linear.cost).max())
        if not (good or known):  # multipliers do not say how good v is
            found = _minimise(linear, _start(linear), gap, against, 0.0, proof=False)
    return None if found is None or found[2] else found[0].v


def _lost(linear: LinearMap, at: _Iterate, share: float, against: float | None, nothing: float) -> bool:
    """Say whether not even the size of the objective is known where it ended."""
    rest = _Rest(linear, at)
    below = against is not None and rest.objective < against
    return not below and rest.gap > rest.wanted(max(share, _SIGN), against, nothing)


def _map(program: SemidefiniteProgram) -> LinearMap:
    linear, cells = LinearMap(program), sum(len(c.constant) for c in program.constraints)
    size, order = linear.size, max(N for _, N in linear.blocks.shapes)
    return DenseMap(program) if cells * size * order**2 * (2 * order + size) <= _DENSE else linear


@cache
def _threads() -> ThreadpoolController:
    return ThreadpoolController()


def _minimise(
    linear: LinearMap, at: _Iterate, share: float, against: float | None, nothing: float, *, proof: bool = True
) -> tuple[_Iterate, int, bool] | None:
    """Return the last iterate that satisfies the constraints, its number, and whether it says that none can.

    Where no `proof` of that is wanted it ends as soon as nothing else would come.
    """
    best, gaps, lowest = None, list[float](), np.inf
    aim = 1.0 if share <= _SIGN else _SOON / share
    units = [1 + float(np.abs(x).max()) for x in (linear.constant, linear.cost)]
    scalings = _scalings(linear, at)
    for number in range(_MOST):
        if scalings is None:
            break
        rest = _Rest(linear, at)
        gap, mu = rest.gap, rest.gap / linear.blocks.order
        wanted = rest.wanted(share, against, nothing)
        off = rest.missed / units[0], float(np.abs(rest.slope).max()) / units[1]
        lowest = min(lowest, gap)
        if not 0 < gap < np.inf or ((best is not None or not proof) and gap > _LOST * lowest):
            break
        if not max(off) <= _OFF and rest.impossible:
            return at, number, True
        if off[0] <= _OFF:
            best = at, number, False
            if against is not None and rest.objective < against:
                return best
        above = against is not None and against < rest.value <= rest.objective  # as the dual objective alone says
        if against is not None and above and off[1] <= _OFF and gap <= share * (rest.value + gap - against):
            return at, number, False
        slight = abs(float(rest.slope @ at.v)) <= wanted or gap <= _STALLED * wanted
        flat = off[1] <= _OFF or (off[1] <= _ROUNDED and slight)
        if off[0] <= _OFF and off[1] <= _ROUNDED:
            gaps.append(gap)
            if len(gaps) > _PATIENCE and gap > _FALLEN * gaps[-1 - _PATIENCE]:
                return at, number, False
        if off[0] <= _OFF and flat and gap <= wanted:
            return at, number, False
        moved = None
        with suppress(np.linalg.LinAlgError):  # a scaling is singular to working precision
            step = _Step(linear, scalings, rest)
            move, reach = step.corrected(mu, wanted * aim / 2 / linear.blocks.order)
            moved = step.taken(at, move, reach)
        if moved is None:
            break
        at, scalings = moved
    return best


class _Rest:
    """What an iterate lacks: of the constraints, of the equalities, of the multipliers' equations; and where it is."""

    def __init__(self, linear: LinearMap, at: _Iterate) -> None:
        self.missing, self.lacking = -linear.constant - at.image - at.s, linear.values - linear.rows @ at.v
        self.missed = float(max(np.abs(self.missing).max(), np.abs(self.lacking).max(initial=0.0)))
        self.pull = linear.adjoint(at.z)  # A*(Z)
        self.slope = -linear.cost - self.pull - at.y @ linear.rows
        self.gap, self.objective = float(at.s @ at.z), float(linear.cost @ at.v)
        self.value = float(linear.constant @ at.z - at.y @ linear.values)  # of the dual
        # no v has A(v) + C ⪯ 0, F v = b where A*(Z) + Fᵀ y = 0 and tr C Z > bᵀ y
        self.impossible = self.value > 0 and bool(np.abs(self.slope + linear.cost).max() <= _IMPOSSIBLE * self.value)

    def wanted(self, share: float, against: float | None, nothing: float) -> float:
        """Return a share of the objective, or of its distance from a number, as a gap."""
        return max(share * max(abs(self.objective - (against or 0.0)), nothing), _LEAST_GAP)


def _start(linear: LinearMap) -> _Iterate:
    s, z = np.zeros(linear.blocks.size), np.zeros(linear.blocks.size)
    stacks = (linear.blocks.stacks(x) for x in (linear.constant, s, z))
    for constant, S, Z in zip(*stacks, strict=True):
        N = constant.shape[1]
        largest = float(np.linalg.norm(constant, axis=(1, 2)).max())
        S[:] = max(1.0, largest) * np.sqrt(N) * np.eye(N)
        Z[:] = _FAR * max(1.0, float(np.abs(linear.cost).max())) * np.eye(N)
    v, y = np.zeros(linear.size), np.zeros(len(linear.values))
    return _Iterate(v=v, image=np.zeros(linear.blocks.size), s=s, z=z, y=y)


def _centred(linear: LinearMap, near: Array) -> _Iterate | None:
    """Return a start with all but the last entry t of v as they are, and all S Z = μ I; None where there is none.

    All constraints are satisfied for some t < 0, and μ is such that so is the multipliers' equation of t.
    """
    v = near.copy()
    v[-1] = 0.0
    image, each = linear.apply(v), linear.apply(np.eye(1, linear.size, linear.size - 1)[0])
    for t in -_MARGIN * 4.0 ** np.arange(_WIDER):
        s, z = -linear.constant - image - t * each, np.empty(linear.blocks.size)
        with suppress(np.linalg.LinAlgError):
            for S, Z in zip(linear.blocks.stacks(s), linear.blocks.stacks(z), strict=True):
                np.linalg.cholesky(S)
                Z[:] = np.linalg.inv(S)
            v[-1] = t
            z *= -linear.cost[-1] / (z @ each)
            return _Iterate(v=v, image=image + t * each, s=s, z=z, y=np.zeros(len(linear.values)))
    return None


def _continued(linear: LinearMap, last: Solution) -> _Iterate | None:
    """Return a start of this program near the end of another one; None where it does not fit.

    With the slacks S that its P, Y and t have here, and its multipliers Z, it is the S' and Z' with S' − ρ Z' = S − ρ Z
    and S' Z' = μ I, one eigenvalue problem each. μ is as large as the change from one program to the other asks for.
    """
    shapes = [c.constant.shape for c in last.program.constraints]
    if last.multipliers is None or shapes != [part.shape for part in linear.blocks.parts(linear.constant)]:
        return None
    mean = last.gap / linear.blocks.order
    v = linear.vector(last.P, last.Y, last.t)
    image = linear.apply(v)
    s, z = -linear.constant - image, linear.blocks.of(last.multipliers, beside=mean)
    stacks = list(zip(linear.blocks.stacks(s), linear.blocks.stacks(z), strict=True))
    changed = max(float(np.abs((S * Z).sum(axis=(1, 2))).max()) / S.shape[1] for S, Z in stacks)
    ratio, mu = np.linalg.norm(s) / np.linalg.norm(z), max(mean, _CHANGED * changed)
    for S, Z in stacks:
        values, Q = np.linalg.eigh(S - ratio * Z)
        far = (np.abs(values) + np.sqrt(values**2 + 4 * ratio * mu)) / 2
        near, turned = ratio * mu / far, Q.transpose(0, 2, 1)
        S[:] = (Q * np.where(values > 0, far, near)[:, None]) @ turned
        Z[:] = (Q * np.where(values > 0, near, far)[:, None] / ratio) @ turned
    return _Iterate(v=v, image=image, s=s, z=z, y=np.zeros(len(linear.values)))


def _scalings(linear: LinearMap, at: _Iterate) -> list[Scaling] | None:
    with suppress(np.linalg.LinAlgError):
        return [Scaling.of(S, Z) for S, Z in zip(linear.blocks.stacks(at.s), linear.blocks.stacks(at.z), strict=True)]
    return None


class _Step:
    """The linear equations of one iteration, factorized once."""

    def __init__(self, linear: LinearMap, scalings: Sequence[Scaling], rest: _Rest) -> None:
        self.linear, self.scalings, self.rest = linear, scalings, rest
        self.equations = linear.step(scalings)
        stacks = linear.blocks.stacks(rest.missing)
        self.exact = rest.missed <= _NONE * (1 + float(np.abs(linear.constant).max()))  # then A*(Z) is all that is lost
        self.sums = [-(x.d[:, :, None] + x.d[:, None]) for x in scalings]
        self.lost = [scaling.into(X) for scaling, X in zip(scalings, stacks, strict=True)]
        away = [self.equations.solve(row) for row in linear.rows]
        self.away = np.array(away).reshape(linear.rows.shape)

    def corrected(self, mu: float, least: float) -> tuple[_Move, tuple[float, float]]:
        """Return a direction towards a smaller μ, at least so large, and how far S and Z may go.

        It is Mehrotra's; its second-order term is made again from where it led to, as long as steps grow longer by it.
        """
        nowhere = [-x.d[:, :, None] * np.eye(x.d.shape[1]) for x in self.scalings]
        first = self.towards(nowhere, self.rest.pull if self.exact else None)
        primal, dual = (min(1.0, length) for length in step_lengths(first.s, first.z, self.scalings, roughly=True))
        after = 0.0
        for s, z, x in zip(first.s, first.z, self.scalings, strict=True):
            ds, dz = (float(np.vdot(x.d, _diagonal(X))) for X in (s, z))
            after += float(np.vdot(x.d, x.d)) + primal * ds + dual * dz + primal * dual * float(np.vdot(s, z))
        aim = max(min(1.0, max(0.0, after / self.linear.blocks.order / mu)) ** 3 * mu, least)
        best = self.towards(self._targets(first, aim))
        reach = step_lengths(best.s, best.z, self.scalings)
        for _ in range(_CORRECTIONS):
            if min(reach) >= 1:
                break
            other = self.towards(self._targets(best, aim))
            further = step_lengths(other.s, other.z, self.scalings)
            if min(1.0, further[0]) * min(1.0, further[1]) <= _LONGER * min(1.0, reach[0]) * min(1.0, reach[1]):
                break
            best, reach = other, further
        return best, reach

    def _targets(self, move: _Move, aim: float) -> list[Array]:
        """Return what both changes, scaled, are to add up to for S Z = aim · I, with the second order of a move."""
        targets = []
        for s, z, x, sums in zip(move.s, move.z, self.scalings, self.sums, strict=True):
            both = s @ z
            target = both + both.transpose(0, 2, 1)
            target /= sums
            _diagonal(target)[:] += aim / x.d - x.d
            targets.append(target)
        return targets

    def towards(self, targets: Sequence[Array], pull: Array | None = None) -> _Move:
        """Return the direction on which both changes, scaled, add up to these; `pull`, of what is lost, if known."""
        if pull is None:
            pull = self.equations.adjoint([lost - target for lost, target in zip(self.lost, targets, strict=True)])
        v, y = self._inverse(self.rest.slope + pull, self.rest.lacking)
        s = [lost - image for lost, image in zip(self.lost, self.equations.apply(v), strict=True)]
        return _Move(v, y, s, [target - X for target, X in zip(targets, s, strict=True)])

    def refined(self, move: _Move) -> tuple[Array, Array, Array]:
        """Return how v, y and the Z change in a direction, refined once where that changes anything.

        What is added to v is far below its rounding, and not below that of the scaled changes, of which the
        multipliers are made: so they have it added by itself.
        """
        rows, dZ = self.linear.rows, self.linear.blocks.unscaled(move.z, self.scalings)
        slope = self.rest.slope - self.linear.adjoint(dZ) - move.y @ rows
        lacking = self.rest.lacking - rows @ move.v
        if max(np.abs(slope).max(), np.abs(lacking).max(initial=0.0)) <= _EXACT * (1 + np.abs(self.linear.cost).max()):
            return move.v, move.y, dZ
        v, y = self._inverse(slope, lacking)
        z = [X + image for X, image in zip(move.z, self.equations.apply(v), strict=True)]
        return move.v + v, move.y + y, self.linear.blocks.unscaled(z, self.scalings)

    def _inverse(self, right: Array, lacking: Array) -> tuple[Array, Array]:
        """Return the v whose scaled left-hand sides have this adjoint, but for y times the rows of the equalities."""
        rows, v = self.linear.rows, self.equations.solve(right)
        y = np.zeros(len(rows))
        if len(rows):
            y = np.asarray(np.linalg.solve(rows @ self.away.T, rows @ v - lacking), dtype=np.float64)
            v = v - y @ self.away
        if not np.isfinite(v).all():
            raise np.linalg.LinAlgError("the equations are singular to working precision")
        return v, y

    def taken(self, at: _Iterate, move: _Move, lengths: tuple[float, float]) -> tuple[_Iterate, list[Scaling]] | None:
        """Return the next iterate, almost at the boundary, and its scalings; None if there is no way to go."""
        share = _SHARE[0] + (_SHARE[1] - _SHARE[0]) * min(1.0, *lengths)
        primal, dual = (min(1.0, share * length) for length in lengths)
        dv, dy, dZ = self.refined(move)
        image = self.linear.apply(dv)
        dS = self.rest.missing - image
        while max(primal, dual) >= _LEAST_STEP:
            v, image_of_v, s = at.v + primal * dv, at.image + primal * image, at.s + primal * dS
            moved = _Iterate(v=v, image=image_of_v, s=s, z=at.z + dual * dZ, y=at.y + dual * dy)
            found = _scalings(self.linear, moved)
            if found is not None:
                return moved, found
            primal, dual = _SHORTER * primal, _SHORTER * dual
        return None


def _diagonal(X: Array) -> Array:
    return np.asarray(np.einsum("ijj->ij", X))
