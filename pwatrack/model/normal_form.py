"""The normal form (11)–(12): vector relative degree, the coordinates ξ and η, the change of state.

Tracked outputs y_j with relative degrees r_j give ξ_j = (y_j, …, y_j⁽ʳ⁻¹⁾). All of these are linear in the state but
the last, which may be another affine form c_i x + d_i in each cell i. With C_i these last rows, D_i = C_i B, and Z
(m, p) the directions that inputs take, u = Z (D_i Z)⁻¹ v makes y⁽ʳ⁾ = C_i (A_i x + b_i) + v. η = N x with N B Z = 0, so
v does not enter η̇ either. Why x → (ξ, η) is one-to-one and onto where no matrix in the hull of the D_i Z is singular,
and how that is proved, is in `docs/theory/beyond.md`, *A last derivative that is piecewise affine*.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pwatrack.arrays import TINY, Array, IntArray, balancing, readonly
from pwatrack.ball_matrix import BallMatrix, above, each, places, stack
from pwatrack.model.continuity import Repair
from pwatrack.model.decoupling import check_independent, input_directions, one_to_one, too_few_inputs
from pwatrack.model.derivatives import Derivatives, exact_rows, last_rows, output_derivatives, unsure
from pwatrack.model.pwa import Matrices, PWASystem, linear_form_text
from pwatrack.rational import floats, fraction_of

_FRESH = 0.3  # part of a state that the rows chosen so far must leave over for it to be taken as an η


@dataclass(frozen=True, kw_only=True)
class NormalForm:
    """A system in the coordinates [ξ; η] = T_i x + o_i in cell i of eq. (11), p tracked outputs after each other in ξ.

    With relative degrees r_1 … r_p and r their sum:

        ξ̇_jk = ξ_j(k+1) for k < r_j,   (ξ̇_jr_j)_j = α_i ξ + β_i η + γ_i + D_i u,
        η̇ = χ_i ξ + Ψ_i η + σ_i  for u = Z v,   y_j = ξ_j1.

    The plant is the one that has this form exactly: where c_k A_i differ between cells by rounding, or c_k B is
    rounding, the plant given is repaired.
    """

    plant: PWASystem
    degrees: tuple[int, ...]  # relative degree of each tracked output, p of them
    piecewise: tuple[bool, ...]  # of each tracked output, whether its last derivative in ξ is another form elsewhere
    exact: "ExactForm"  # T_i, o_i and A_ηi
    T: Array  # (l, n, n)
    offset: Array  # (l, n)
    T_inverse: Array  # x = T_inverse_i ([ξ; η] − o_i), (l, n, n)
    alpha: Array  # (l, p, r)
    beta: Array  # (l, p, n − r)
    gamma: Array  # (l, p)
    D: Array  # decoupling matrix, (l, p, m)
    right_inverse: Array  # Z (D_i Z)⁻¹, (l, m, p): inputs that make one of y⁽ʳ⁾ 1, and nothing else
    chi: Array  # (l, n − r, r)
    Psi: Array  # (l, n − r, n − r)
    sigma: Array  # (l, n − r)
    eta_names: tuple[str, ...]  # what each η is, in the names of the states

    @property
    def r(self) -> int:
        """How many ξ there are: the sum of the relative degrees."""
        return sum(self.degrees)

    @property
    def degrees_text(self) -> str:
        """The relative degree, of several outputs as a vector."""
        return str(self.degrees[0]) if len(self.degrees) == 1 else str(self.degrees)

    @property
    def hull(self) -> tuple[int, ...]:
        """Cells that have the A_ηi of all cells in their hull: those of the plant, where T is the same in all cells."""
        one = len({id(T_i) for T_i in self.exact.T}) == 1
        return self.plant.hull if one else tuple(places(self.exact.A_eta))

    @cached_property
    def boundary(self) -> "Boundary":
        """What bounds the cells: H_k T_i⁻¹ [ξ; η] + h_k − H_k T_i⁻¹ o_i = 0 for hyperplanes k of cells i, each once."""
        partition, exact = self.plant.partition, self.exact
        planes = BallMatrix.of(partition.exact_H, (len(partition.h), len(self.T[0])))
        constants = BallMatrix.of([[v] for v in partition.exact_h], (len(partition.h), 1))
        turned = each(lambda T_inverse: planes @ T_inverse, exact.inverse)
        known: dict[tuple[int, int], list[int]] = {}  # of the hyperplanes in `rows`, for cells that share T and o
        numbers: dict[tuple[int, tuple[str, ...]], int] = {}
        rows, found = list[tuple[Array, float]](), list[list[int]]()
        for H, o in zip(turned, exact.offset, strict=True):
            if (id(H), id(o)) not in known:
                here, h = list[int](), (constants - H @ o).centre.entries()
                for k, (line, constant) in enumerate(zip(H.centre.tolist(), h, strict=True)):
                    size = next(abs(v) for v in line if v)
                    here.append(numbers.setdefault((k, tuple(str(v / size) for v in (*line, constant))), len(rows)))
                    if here[-1] == len(rows):
                        rows.append((H.floats[k], float(fraction_of(constant))))
                known[id(H), id(o)] = here
            found.append(known[id(H), id(o)])
        signs = np.zeros((len(partition.signs), len(rows)), dtype=np.int64)
        for own, here, side in zip(signs, found, partition.signs, strict=True):
            own[here] = side
        kept = np.flatnonzero(signs.any(axis=0)).tolist()  # a hyperplane may bound no cell with some T
        rows, signs = [rows[k] for k in kept], signs[:, kept]
        H_all = np.array([row for row, _ in rows]).reshape(len(rows), len(self.T[0]))
        return Boundary(H=readonly(H_all), h=readonly([h for _, h in rows]), signs=signs)


@dataclass(frozen=True, kw_only=True)
class ExactForm:
    """What of a normal form proofs are about."""

    T: tuple[BallMatrix, ...]  # [ξ; η] = T x + offset, (n, n), one per cell, as are all
    offset: tuple[BallMatrix, ...]  # (n, 1)
    inverse: tuple[BallMatrix, ...]  # those of T
    directions: BallMatrix  # Z, (m, p)
    scales: tuple[float, ...]  # the diagonal of S
    internal: tuple[int, ...]  # the states j of the rows N = e_j − (B Z (D_1 Z)⁻¹)_j C_1 of T, n − r of them
    A_eta: tuple[BallMatrix, ...]  # (n − r, n − r), one per cell


@dataclass(frozen=True, kw_only=True)
class Boundary:
    """Hyperplanes of (ξ, η) that bound cells: H [ξ; η] + h = 0.

    Where a last derivative is piecewise affine, a hyperplane of x is one of several pieces here.
    """

    H: Array  # (k, n)
    h: Array  # (k,)
    signs: IntArray  # side of each that a cell is on, 0 where that does not bound it, (l, k)


def normal_form(
    plant: PWASystem, *, input_sizes: Array | None = None, directions: BallMatrix | None = None
) -> NormalForm:
    """Bring a system to the form (11) by a change of state, linear but for the last derivatives.

    Refuses fewer inputs than tracked outputs, y, ẏ, … that depend on the cell before inputs appear or in which these
    never do, and inputs that do not act on the outputs independently, in each cell or in some mean of them. Where there
    are more inputs than tracked outputs, u_ff is the least in `input_sizes` (m,), or along the `directions` Z (m, p).
    """
    if len(plant.tracked) > plant.B.shape[1]:
        raise too_few_inputs(plant)
    found = [output_derivatives(plant, j) for j in range(len(plant.tracked))]
    Z = directions or input_directions(plant, found, input_sizes)
    check_independent(plant, found, Z)
    last, n = last_rows(found), plant.A.shape[1]
    try:
        internal = _complement(plant, found, Z.floats)
        plant = _repaired(plant, found, Z, internal)
        T, offset = _coordinates(plant.exact, found, Z, internal)
        inverse = each(BallMatrix.inverse, T)
        D = each(lambda T_i: T_i.part(last, range(n)) @ plant.exact.B, T)
        right_inverse = each(lambda D_i: Z @ (D_i @ Z).inverse(), D)
    except ZeroDivisionError:
        raise unsure("C A^(r - 1) B, known to within a radius,", 0.0) from None
    scales = one_to_one(plant, found, [D_i @ Z for D_i in D])
    place = {id(A_i): i for i, A_i in enumerate(plant.exact.A)}
    whole = each(lambda A_i: T[place[id(A_i)]] @ A_i @ inverse[place[id(A_i)]], plant.exact.A)
    b = stack([T_i @ b_i - M @ o_i for T_i, b_i, M, o_i in zip(T, plant.exact.b, whole, offset, strict=True)])[:, :, 0]
    r, A = sum(d.degree for d in found), stack(whole)
    etas = range(r, n)
    return NormalForm(
        plant=plant,
        degrees=tuple(d.degree for d in found),
        piecewise=tuple(d.piecewise for d in found),
        exact=ExactForm(
            T=tuple(T),
            offset=tuple(offset),
            inverse=tuple(inverse),
            directions=Z,
            scales=scales,
            internal=tuple(internal),
            A_eta=tuple(each(lambda A_i: A_i.part(etas, etas), whole)),
        ),
        T=stack(T),
        offset=readonly(stack(offset)[:, :, 0]),
        T_inverse=stack(inverse),
        alpha=readonly(A[:, last, :r]),
        beta=readonly(A[:, last, r:]),
        gamma=readonly(b[:, last]),
        D=stack(D),
        right_inverse=stack(right_inverse),
        chi=readonly(A[:, r:, :r]),
        Psi=readonly(A[:, r:, r:]),
        sigma=readonly(b[:, r:]),
        eta_names=tuple(linear_form_text(row, plant.states) for row in T[0].floats[r:]),
    )


def _coordinates(
    exact: Matrices, found: Sequence[Derivatives], Z: BallMatrix, internal: Sequence[int]
) -> tuple[list[BallMatrix], list[BallMatrix]]:
    """Return T and the offset of each cell: the rows c_k of each output, then e_j − (B Z (D Z)⁻¹)_j C for states j."""
    n, last = exact.A[0].shape[0], last_rows(found)
    before, offsets = exact_rows(exact, found)
    C = above(*(before[k] for k in last))
    share = exact.B @ Z @ (C @ exact.B @ Z).inverse()
    units = BallMatrix.of(np.eye(n))
    N = [units.part([j], range(n)) - share.part([j], range(len(last))) @ C for j in internal]
    nothing = [BallMatrix.of([[0]])] * len(internal)
    bent = [k for k, d in zip(last, found, strict=True) if d.piecewise]

    def assembled(rows: list[BallMatrix], X: BallMatrix, below: list[BallMatrix]) -> BallMatrix:
        """Put the rows c X of a cell in the place of the last derivatives that differ from cell to cell."""
        return above(*(before[k - 1] @ X if k in bent else row for k, row in enumerate(rows)), *below)

    if not bent:
        return [above(*before, *N)] * len(exact.A), [above(*offsets, *nothing)] * len(exact.A)
    T = each(lambda A_i: assembled(before, A_i, N), exact.A)
    return T, each(lambda b_i: assembled(offsets, b_i, nothing), exact.b)


def _repaired(plant: PWASystem, found: Sequence[Derivatives], Z: BallMatrix, internal: Sequence[int]) -> PWASystem:
    """Return the plant with c_k A_i = c_{k+1} and c_k b_i = o_{k+1} wherever they are to be, and c_k B = 0, exactly.

    With S the columns of T⁻¹ that belong to these c_k, Ã_i = A_i − S (c A_i − c₊) and so on. The difference of two
    cells is multiplied by I − S c then, so that what was continuous stays so.
    """
    exact, n = plant.exact, plant.A.shape[1]
    T, offset = (X[0] for X in _coordinates(exact, found, Z, internal))
    last = last_rows(found)
    free = [k for k in range(last[-1]) if k not in last]
    bent = {k - 1 for k, d in zip(last, found, strict=True) if d.piecewise}
    kept = [k for k in free if k not in bent]  # these c have c A_i as their next one in every cell
    following = [k + 1 for k in kept]
    c, c_next, o_next = T.part(kept, range(n)).centre, T.part(following, range(n)).centre, offset.part(following, [0])
    c_free, inverse = T.part(free, range(n)).centre, BallMatrix(T.centre.inv())
    S, S_free = inverse.part(range(n), kept).centre, inverse.part(range(n), free).centre
    missed_A = [c * A_i.centre - c_next for A_i in exact.A]
    missed_b = [c * b_i.centre - o_next.centre for b_i in exact.b]
    missed_B = c_free * exact.B.centre
    if not any(any(X.entries()) for X in (*missed_A, *missed_b, missed_B)):
        return plant

    new = Matrices(
        A=tuple(BallMatrix(X.centre - S * off, X.radius) for X, off in zip(exact.A, missed_A, strict=True)),
        b=tuple(BallMatrix(X.centre - S * off, X.radius) for X, off in zip(exact.b, missed_b, strict=True)),
        B=BallMatrix(exact.B.centre - S_free * missed_B, exact.B.radius),
        C=exact.C,
        tracked=exact.tracked,
    )
    A, b = (np.abs([floats(S * off) for off in missed]).max(axis=0) for missed in (missed_A, missed_b))
    B = np.abs(floats(S_free * missed_B))
    repair = Repair(A=readonly(A), b=readonly(b[:, 0]), B=readonly(B), relative=_relative(plant, A, b, B))
    remark = (
        f"the form (11) holds but for rounding, {repair.size}: proofs and simulation are about the plant that has it"
    )
    repairs = repair.and_then(plant.repair)
    return replace(plant, exact=new, written=None, repair=repairs, remarks=(*plant.remarks, remark))


def _relative(plant: PWASystem, A: Array, b: Array, B: Array) -> float:
    """Return how large changes of a plant are beside its own numbers."""
    d, size = balancing(plant.A), np.abs(plant.A).max(axis=0)
    shares = [np.where(A.any(axis=1), A @ d, 0.0) / np.maximum(size @ d, TINY)]
    for change, given in ((b, plant.b.T), (B, plant.B)):
        rates = np.abs(given) / d[:, None]
        shares.append(change / d[:, None] / max(rates.max(), TINY))
    return max(float(share.max()) for share in shares)


def _complement(plant: PWASystem, found: Sequence[Derivatives], Z: Array) -> list[int]:
    """Return n − r states j for the rows of N, with [rows; N] invertible; those that are η themselves come first.

    State j itself qualifies if (B Z)_j = 0; otherwise x_j − (B Z (D Z)⁻¹)_j C x does.
    """
    rows = np.vstack([d.rows for d in found])
    n, last = rows.shape[1], rows[last_rows(found)]
    if len(rows) >= n:
        return []
    BZ = plant.B @ Z
    BZ[(plant.exact.B @ BallMatrix.of(Z)).floats == 0] = 0.0
    share = BZ @ np.linalg.inv(last @ BZ)
    d = balancing(plant.A)
    unit = np.eye(n)
    states = [j for j in range(n) if not BZ[j].any()] + [j for j in range(n) if BZ[j].any()]
    candidates = [(j, unit[j] - share[j] @ last) for j in states]
    candidates = [(j, v) for j, v in candidates if v.any()]
    directions = np.array([v for _, v in candidates]) * d
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    scaled = rows * d
    basis, _ = np.linalg.qr((scaled / np.linalg.norm(scaled, axis=1, keepdims=True)).T)
    chosen: list[int] = []
    while len(rows) + len(chosen) < n:
        rest = directions
        for _ in range(2):  # the second pass removes what rounding left
            rest = rest - (rest @ basis) @ basis.T
        fresh = np.linalg.norm(rest, axis=1)
        good = np.flatnonzero(fresh > _FRESH)
        best = int(good[0]) if len(good) else int(np.argmax(fresh))
        chosen.append(candidates[best][0])
        basis = np.column_stack([basis, rest[best] / fresh[best]])
    return chosen
