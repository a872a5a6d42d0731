"""Polyhedra in whole numbers: whether they have an interior, and which of their inequalities bound them.

Nothing here rounds. An inequality a·x + c ≥ 0 is a `Row` (a_1, …, a_n, c) of whole numbers without a common factor,
a point x = X / W a `Point` (X_1, …, X_n, W) with W > 0, so that their product has the sign of a·x + c.
"""

from collections.abc import Iterable, Sequence
from fractions import Fraction
from math import gcd, lcm
from operator import mul

import flint

Row = tuple[int, ...]
Point = tuple[int, ...]


def primitive(values: Sequence[Fraction | int]) -> Row:
    """Return the whole numbers without a common factor that are a positive multiple of some fractions."""
    common = lcm(*(v.denominator for v in values))
    whole = [v.numerator * (common // v.denominator) for v in values]
    return reduced(tuple(whole))


def oriented(row: Row) -> tuple[Row, int]:
    """Return the hyperplane of an inequality, its first entry positive, and the side ±1 that is meant."""
    if next(v for v in row if v) > 0:
        return row, 1
    return opposite(row), -1


def opposite(row: Row) -> Row:
    """Return the inequality of the other side."""
    return tuple(-v for v in row)


def value(row: Row, point: Point) -> int:
    """Return a positive multiple of a·x + c."""
    return sum(map(mul, row, point))


def reduced(numbers: Row) -> Row:
    """Return whole numbers without their common factor."""
    factor = gcd(*numbers) or 1
    return tuple(v // factor for v in numbers)


def coordinates(point: Point) -> tuple[Fraction, ...]:
    """Return x = X / W."""
    return tuple(Fraction(v, point[-1]) for v in point[:-1])


def moved(point: Point, direction: Sequence[int], rows: Iterable[Row]) -> Point:
    """Return a point a good way along a direction: no row that was not 0 changes its sign."""
    room = None
    for row in rows:
        here, step = value(row, point), sum(map(mul, row, direction))
        if here and step:
            bits = here.bit_length() - step.bit_length() - 2
            room = bits if room is None else min(room, bits)
    up, down = max(room or 0, 0), max(-(room or 0), 0)
    *X, W = (v << down for v in point)
    return reduced((*(x + (d << up) for x, d in zip(X, direction, strict=True)), W))


def shortened(point: Point, rows: Iterable[Row]) -> Point:
    """Return a point close by with fewer digits, on the same side of every row; none of them may be 0."""
    W, bits = point[-1], 0
    for row in rows:
        size = sum(abs(a) for a in row[:-1])
        bits = max(bits, size.bit_length() + W.bit_length() - abs(value(row, point)).bit_length() + 1)
    if bits > W.bit_length():
        return point
    return reduced((*((v << bits) // W for v in point[:-1]), 1 << bits))


def generic(point: Point, rows: Sequence[Row]) -> Point:
    """Return a point close by where no row with a normal is 0; those that were not 0 keep their signs."""
    zero = [row for row in rows if not value(row, point)]
    t = 0
    while zero:  # a row vanishes along (1, t, t², …) for fewer than n values of t
        t += 1
        direction = [t**k for k in range(len(point) - 1)]
        if all(sum(map(mul, row, direction)) for row in zero):
            return moved(point, direction, rows)
    return point


def restricted(rows: Iterable[Row], plane: Row) -> list[Row]:
    """Return inequalities on a hyperplane, whose first entry is positive and whose coordinate there is eliminated.

    Example: x_1 − x_2 ≥ 0 on 2 x_1 + x_2 = 3 is 1 − x_2 ≥ 0.

        >>> restricted([(1, -1, 0)], (2, 1, -3))
        [(-1, 1)]
    """
    j, found = pivot(plane), []
    for row in rows:
        if row[j]:
            row = reduced(tuple(plane[j] * a - row[j] * p for a, p in zip(row, plane, strict=True)))
        found.append(row[:j] + row[j + 1 :])
    return found


def lifted(point: Point, plane: Row) -> Point:
    """Return a point of a hyperplane from its coordinates there; `restricted` undone."""
    j = pivot(plane)
    others = plane[:j] + plane[j + 1 :]
    scaled = [plane[j] * v for v in point]
    return reduced((*scaled[:j], -value(others, point), *scaled[j:]))


def pivot(plane: Row) -> int:
    """Return the coordinate that a hyperplane is solved for."""
    return next(j for j, v in enumerate(plane) if v)


def borders(rows: Iterable[Row], n: int) -> tuple[Row, ...] | None:
    """Return those of some inequalities in ℝⁿ that bound their polyhedron, or None if it has no interior.

    The answer depends on the polyhedron alone: two with the same borders are the same.
    """
    kept = tightest(rows)
    if kept is None:
        return None
    normals = [[*line] for line in {oriented(_direction(row))[0] for row in kept}]
    if len(normals) > n or flint.fmpz_mat(normals).rank() < len(normals):  # else every side of every strip is a border
        inside = interior_point(kept, n)
        if inside is None:
            return None
        met = {_first_met(inside, [-a for a in row[:-1]], kept) for row in kept}
        sure = [row for row in kept if row in met]
        for row in [row for row in kept if row not in met]:
            others = tuple(other for other in kept if other != row)
            if any(interior_point([*some, opposite(row)], n) is None for some in (sure, others)):
                kept = others
    return kept


def tightest(rows: Iterable[Row]) -> tuple[Row, ...] | None:
    """Return the tightest of parallel inequalities, sorted, or None if those leave no interior already.

    Example:
        >>> tightest([(1, 0), (2, -1), (-1, 3)])
        ((-1, 3), (2, -1))
    """
    tight: dict[Row, tuple[int, Row]] = {}
    for row in rows:
        size = gcd(*row[:-1])
        if not size:
            if row[-1] <= 0:
                return None
            continue
        direction = _direction(row)
        other = tight.get(direction)
        if other is None or row[-1] * other[0] < other[1][-1] * size:
            tight[direction] = (size, row)
    for direction, (size, row) in tight.items():
        facing = tight.get(opposite(direction))
        if facing is not None and row[-1] * facing[0] + facing[1][-1] * size <= 0:
            return None
    return tuple(sorted(row for _, row in tight.values()))


def _direction(row: Row) -> Row:
    return reduced(row[:-1])


def _first_met(point: Point, direction: Sequence[int], rows: Sequence[Row]) -> Row | None:
    """Return the inequality that ends first on a ray from an inner point, which is a border; None if two do."""
    met, best, nearness = None, 0, 1  # the ray meets it at the time best / nearness
    for row in rows:
        speed = -sum(map(mul, row, direction))
        if speed > 0:
            here = value(row, point)
            sooner = here * nearness - best * speed
            if (met is None and best == 0) or sooner < 0:
                met, best, nearness = row, here, speed
            elif sooner == 0:
                met = None
    return met


def interior_point(rows: Sequence[Row], n: int) -> Point | None:
    """Return a point of ℝⁿ where every inequality holds strictly, or None if there is none.

    The linear program M z ≥ 1 for z = (X, W), where M has a row for W too, in whole numbers over one denominator.
    Its pivots are those of Bland: they come to an end, at a point or at a row that shows that there is none
    (a slack that is a sum of slacks with factors ≤ 0 and something negative).
    """
    m, columns = len(rows) + 1, n + 1
    T = [[*row, -1] for row in (*rows, (0,) * n + (1,))]  # the slacks s = M z − 1, times the denominator
    basic, free, denominator = list(range(m)), list(range(m, m + columns)), 1

    def exchange(r: int, c: int) -> None:
        nonlocal denominator
        chosen, p = T[r], T[r][c]
        sign = 1 if p > 0 else -1
        for i, row in enumerate(T):
            q = row[c]
            if i != r and q:
                T[i] = [sign * (p * a - q * b) // denominator for a, b in zip(row, chosen, strict=True)]
                T[i][c] = sign * q
            elif i != r:
                T[i] = [sign * p * a // denominator for a in row]
        T[r] = [-sign * b for b in chosen]
        T[r][c], denominator = sign * denominator, sign * p
        basic[r], free[c] = free[c], basic[r]

    for column in range(columns):  # z has no sign: it becomes basic and stays so
        row = next((r for r in range(m) if basic[r] < m and T[r][column]), None)
        if row is not None:
            exchange(row, column)
    while True:
        r = min((r for r in range(m) if basic[r] < m and T[r][-1] < 0), key=basic.__getitem__, default=None)
        if r is None:
            break
        c = min((c for c in range(columns) if free[c] < m and T[r][c] > 0), key=free.__getitem__, default=None)
        if c is None:
            return None
        exchange(r, c)
    z = [0] * columns
    for label, numbers in zip(basic, T, strict=True):
        if label >= m:
            z[label - m] = numbers[-1]
    return primitive(z)
