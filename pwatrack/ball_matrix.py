"""Matrices whose entries are exact, or known to within a radius: what a proof is about."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, lru_cache
from typing import Any

import flint

from pwatrack.arrays import Array, readonly
from pwatrack.rational import Rational, floats, fraction_of, identity, number, on_entries, rational, stacked
from pwatrack.real import Real


@dataclass(frozen=True)
class BallMatrix:
    """All X with |X_jk − centre_jk| ≤ radius_jk.

    Sums and products hold every sum and product of what is in them.

    Example:
        >>> A = BallMatrix.of([["1/3", Real(Fraction(2), Fraction(1, 10))]])
        >>> (A @ A.transpose()).texts, A.floats.round(3).tolist()
        ([['37/9']], [[0.333, 2.0]])
        >>> (A @ A.transpose()).radius_texts
        [['0.41']]
    """

    centre: Rational  # (j, k)
    radius: Rational | None = None  # (j, k), nowhere negative; None where all is exact

    @classmethod
    def of(cls, rows: Any, shape: tuple[int, int] | None = None) -> "BallMatrix":
        """Return a matrix of numbers as they are written: `Real`, fractions, doubles as the decimals they print as."""
        numbers = [
            [Real.of(v if isinstance(v, Real | Fraction | int | str) else float(v)) for v in row] for row in rows
        ]
        shape = shape or (len(numbers), len(numbers[0]))
        uncertain = any(v.radius for row in numbers for v in row)
        return cls(
            rational([[v.centre for v in row] for row in numbers], shape),
            rational([[v.radius for v in row] for row in numbers], shape) if uncertain else None,
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.centre.nrows(), self.centre.ncols()

    @cached_property
    def floats(self) -> Array:
        """The doubles nearest to the centre, (j, k)."""
        return readonly(floats(self.centre))

    def __add__(self, other: "BallMatrix") -> "BallMatrix":
        return BallMatrix(self.centre + other.centre, _sum(self.radius, other.radius))

    def __sub__(self, other: "BallMatrix") -> "BallMatrix":
        return BallMatrix(self.centre - other.centre, _sum(self.radius, other.radius))

    def __matmul__(self, other: "BallMatrix") -> "BallMatrix":
        radius = None
        if other.radius is not None:
            radius = absolute(self.centre) * other.radius
        if self.radius is not None:
            radius = _sum(radius, self.radius * absolute(other.centre))
        if self.radius is not None and other.radius is not None:
            radius = _sum(radius, self.radius * other.radius)
        return BallMatrix(self.centre * other.centre, radius)

    def inverse(self) -> "BallMatrix":
        """Return all inverses: |(T + E)⁻¹ − T⁻¹| ≤ (I − Q)⁻¹ Q |T⁻¹| with Q = |T⁻¹| |E|, where I − Q is an M-matrix.

        Raises ZeroDivisionError if a matrix in it may be singular.
        """
        inverse = self.centre.inv()
        if self.radius is None:
            return BallMatrix(inverse)
        size = absolute(inverse)
        Q = size * self.radius
        grown = (identity(Q.nrows()) - Q).inv()
        if any(v < 0 for v in grown.entries()):
            raise ZeroDivisionError("a matrix in the ball may be singular")
        return BallMatrix(inverse, grown * Q * size)

    def part(self, rows: Sequence[int], columns: Sequence[int]) -> "BallMatrix":
        """Return the entries of some rows and columns."""
        chosen = (None if X is None else on_entries(X, rows, columns) for X in (self.centre, self.radius))
        return BallMatrix(*chosen)

    def transpose(self) -> "BallMatrix":
        """Return the transpose."""
        return BallMatrix(self.centre.transpose(), None if self.radius is None else self.radius.transpose())

    def times(self, share: Fraction) -> "BallMatrix":
        """Return a multiple."""
        return BallMatrix(
            number(share) * self.centre, None if self.radius is None else number(abs(share)) * self.radius
        )

    @cached_property
    def texts(self) -> list[list[str]]:
        """The centre as decimals and fractions."""
        return texts(self.centre)

    @property
    def radius_texts(self) -> list[list[str]] | None:
        """The radius, likewise; None where all is exact."""
        return None if self.radius is None else texts(self.radius)


def above(*matrices: BallMatrix) -> BallMatrix:
    """Return matrices on top of each other."""
    exact = all(X.radius is None for X in matrices)
    radii = None if exact else stacked([X.centre - X.centre if X.radius is None else X.radius for X in matrices])
    return BallMatrix(stacked([X.centre for X in matrices]), radii)


def beside(*matrices: BallMatrix) -> BallMatrix:
    """Return matrices beside each other."""
    return above(*(X.transpose() for X in matrices)).transpose()


def zero(rows: int, columns: int) -> BallMatrix:
    """Return 0."""
    return BallMatrix(flint.fmpq_mat(rows, columns))


def each(function: Callable[[BallMatrix], BallMatrix], matrices: Sequence[BallMatrix]) -> list[BallMatrix]:
    """Apply a function to matrices, once to each object: cells that share a matrix still share it afterwards."""
    found = {id(X): X for X in matrices}
    results = {key: function(X) for key, X in found.items()}
    return [results[id(X)] for X in matrices]


def different(matrices: Sequence[BallMatrix]) -> list[BallMatrix]:
    """Return the matrices without repetitions, in their order: equal cells say the same."""
    return [matrices[i] for i in places(matrices)]


def places(matrices: Sequence[BallMatrix]) -> list[int]:
    """Return the places of those that are no repetition of an earlier one."""
    seen, alike, found = set[int](), dict[bytes, list[BallMatrix]](), list[int]()
    for i, X in enumerate(matrices):
        if id(X) in seen:
            continue
        seen.add(id(X))
        others = alike.setdefault(X.floats.tobytes(), [])
        if not any(X.centre == Y.centre and X.radius == Y.radius for Y in others):
            others.append(X)
            found.append(i)
    return found


def stack(matrices: Sequence[BallMatrix]) -> Array:
    """Return the doubles nearest to some matrices of one shape, (l, j, k)."""
    return readonly([matrix.floats for matrix in matrices])


def texts(X: Rational) -> list[list[str]]:
    """Return a rational matrix as text that no reader rounds: decimals where they end, else fractions.

    Example:
        >>> texts(rational([[Fraction(3, 10), Fraction(-1, 3), Fraction(10) ** 20]], (1, 3)))
        [['0.3', '-1/3', '1e20']]
    """
    return [[text(fraction_of(v)) for v in row] for row in X.tolist()]


@lru_cache(maxsize=1 << 14)
def text(value: Fraction) -> str:
    """Return a rational number as text that no reader rounds."""
    shown = repr(float(value)) if abs(value) < 1e300 else ""
    if shown and Fraction(shown) == value:
        return shown.removesuffix(".0").replace("e+", "e")
    return str(value)


def absolute(X: Rational) -> Rational:
    """Return the sizes of all entries."""
    return flint.fmpq_mat(X.nrows(), X.ncols(), [abs(v) for v in X.entries()])


def _sum(one: Rational | None, other: Rational | None) -> Rational | None:
    if one is None or other is None:
        return other if one is None else one
    return one + other
