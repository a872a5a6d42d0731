"""What a program that is sampled makes of estimates of loads in x_d, u_ff and eta_hat, rebuilt from a plant."""

from fractions import Fraction
from itertools import accumulate
from typing import Any

from .balls import Ball, added_or, outermost, sides, sizes, stacked, unlike, zero
from .form import coordinates, once
from .matrices import AuditFault, added, identity, inverted, product, rank, transposed
from .plant import AuditedPlant
from .reading import matrix

_TURNS = 64  # h times the size of F: a sample in which it turns further is not looked at
_TAIL = Fraction(1, 2**60)  # share of h below which the rest of a sum may be
DIGITS = 60  # binary ones that are kept of each entry of what a tick makes
_MORE = 100  # of each entry of an integral and its terms, which may cancel


class Estimates:
    """v = (s_hat, eta_hat) at a tick, and epsilon, by how much it is more than that of the true loads.

    In cell j v' has the rows F_j on v, x_d has D_j = [X, N_j], and u_ff has u_j. From v of the true loads to that of
    the program F and D are those of one mean j, and B u_ff is more by (c_aj - A_j D_j) epsilon, a the cell in which the
    program is and c_aj = [X S - E, 0] + N_a (rows of F_j for eta). In a sample the program goes on by the law of a, so
    that beside that it holds u_a Q(F_a) F_j epsilon more, and has epsilon + P(F_a) F_j epsilon at the end, P the
    integral of e^(F t), Q that of (h - t) / h of it. While it is held, x - x_d has c_aj epsilon beside
    A_i (x - x_d - D_j epsilon). eta_hat is left out where no load acts on it.
    """

    def __init__(self, plant: AuditedPlant, X: Ball | None, generator: Any) -> None:
        if plant.loads is None:
            raise AuditFault("no load is estimated")
        self.plant, (self.E, self.S) = plant, plant.loads
        self.n, self.k = len(plant.A[0][0]), len(self.S[0])
        if generator is None or X is None:
            self.held_alone()
        else:
            self.shifted(X, generator)

    def held_alone(self) -> None:
        """Take u_ff - U s_hat with B U = E, where x_d is given."""
        (B, open_B), (E, open_E) = self.plant.B, self.E
        if open_B or open_E or rank(B) < len(B[0]):
            raise AuditFault("where loads enter is not known exactly, and x_d is given")
        back = transposed(B)
        U = product(inverted(product(back, B)), product(back, E))
        if product(B, U) != E:
            raise AuditFault("a load enters where no input does, and x_d is given")
        self.p, X = 0, zero(self.n, self.k)
        self.moves, self.cells, self.hull = [(-self.E, X)], [(self.S, -Ball(U))], [(self.S, X)]

    def shifted(self, X: Ball, generator: Any) -> None:
        """Take x_d + X s_hat, and what goes with it."""
        plant = self.plant
        T, degrees = coordinates(plant, generator)[0], generator["relative_degrees"]
        r, last, one = sum(degrees), [at - 1 for at in accumulate(degrees)], len(unlike(T)) == 1
        if plant.elements is not None and not one:
            raise AuditFault("the last derivative of an output differs between cells, which are not listed")
        self.Z, self.X, self.push, self.last = Ball(matrix(generator["directions"])), X, self.E - X @ self.S, last
        etas = [T[0].row(j) for j in range(r, self.n)]
        driven = (row @ (A @ X + self.push) for row in etas for _, A in unlike(plant.A))
        acted_on = any(open_ or any(map(any, centre)) for centre, open_ in driven)
        self.p, self.own = (len(etas), stacked(*etas)) if acted_on else (0, Ball([]))

        def eta(back: Ball) -> Ball:
            """Return the columns of x for eta."""
            return sides(zero(self.n, 0), *map(back.column, range(r, r + self.p)))

        N = once(lambda T_i: eta(T_i.inverse()), T)
        everywhere = plant.A if plant.elements is None else plant.elements.fields(plant.elements.slopes)[0]
        pairs = [(A, 0 if one else i) for i, A in unlike(everywhere)]
        laws = [self.law(A, T[i], N[i]) for A, i in pairs]
        self.cells = [(F, u) for F, u, _ in laws]
        corners = [self.law(A, T[0], N[0]) for A in outermost(plant.A)] if one else laws
        self.hull = means([(F, D) for F, _, D in corners])
        alone = sides(-self.push, zero(self.n, self.p))
        if self.p == 0:
            self.moves = means([(alone, D) for _, D in self.hull])
            return
        rows = [(F.rows(self.k, self.k + self.p), D) for F, D in self.hull]
        self.moves = means([(alone + N_a @ F_eta, D) for N_a in outermost(N) for F_eta, D in rows])

    def law(self, A: Ball, T: Ball, N: Ball) -> tuple[Ball, Ball, Ball]:
        """Return F_j, u_j and D_j of a cell."""
        D, C = sides(self.X, N), stacked(*map(T.row, self.last))
        rate = A @ D + sides(self.push, zero(self.n, self.p))
        u = -(self.Z @ (C @ self.plant.B @ self.Z).inverse() @ C @ rate)
        return stacked(sides(self.S, zero(self.k, self.p)), self.own @ rate), u, D

    def vertices(self, h: Fraction) -> list[tuple[Ball, Ball, Ball]]:
        """Return D_j, what is held beside u_ff at the tick, and eta_hat - eta one sample later: rows on epsilon."""
        found, eye, end = list[Ball](), Ball(identity(self.k + self.p, 1)), self.k + self.p
        for F_a, u_a in self.cells:
            P, Q = integrals(F_a, h)
            held = u_a @ Q
            found += [stacked(held @ F, (eye + P @ F).rows(self.k, end), D) for F, D in self.hull]
        m, p = len(self.plant.B[0][0]), self.p
        return [(X.rows(m + p, m + p + self.n), X.rows(0, m), X.rows(m, m + p)) for _, X in unlike(found)]


def means(pairs: list[tuple[Ball, Ball]]) -> list[tuple[Ball, Ball]]:
    """Return those that have all others in their hull, each pair as one."""
    first = len(pairs[0][0][0])
    return [(X.rows(0, first), X.rows(first, len(X[0]))) for X in outermost([stacked(*pair) for pair in pairs])]


def integrals(F: Ball, h: Fraction) -> tuple[Ball, Ball]:
    """Return the sums of F^k h^(k+1) / (k+1)! and of F^k h^(k+1) / (k+2)!.

    From where each term is at most half as large as the one before it, those that are left out are at most twice the
    first of them.
    """
    f = h * size_of(F)
    if f > _TURNS:
        raise AuditFault("the sample is too long for what x_d is made of")
    n, k = len(F[0]), 0
    term, P, Q = Ball(identity(n, h)), zero(n, n), zero(n, n)
    while 2 * f > k + 2 or 2 * size_of(term) > h * _TAIL:
        P, Q = P + term, Q + term.times(Fraction(1, k + 2))
        term, k = short((term @ F).times(h / (k + 2)), _MORE), k + 1
    left = 2 * size_of(term)
    open_ = Ball(zero(n, n)[0], [[left] * n for _ in range(n)])
    return short(P + open_, _MORE), short(Q + open_, _MORE)


def size_of(ball: Ball) -> Fraction:
    """Return the largest sum of the sizes in a row."""
    return max(sum(row, Fraction(0)) for row in ball.most)


def short(ball: Ball, digits: int) -> Ball:
    """Return a ball around one, with entries of so many binary digits."""
    centre = [[cut(v, digits) for v in row] for row in ball.centre]
    off = added_or(sizes(added(ball.centre, centre, -1)), ball.radius)
    return Ball(centre, [[2 * cut(v, digits) for v in row] for row in off])


def cut(v: Fraction, digits: int) -> Fraction:
    """Return a number of so many digits that is near."""
    unit = Fraction(2) ** (digits - v.numerator.bit_length() + v.denominator.bit_length())
    return round(v * unit) / unit
