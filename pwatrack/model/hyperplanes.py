"""Hyperplanes that several cells write: which of them are one."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from math import log2

import numpy as np

from pwatrack.arrays import IntArray
from pwatrack.model.polyhedron import Row, borders, opposite, oriented

_ROUNDING = Fraction(1, 10**12)  # of its own numbers, up to which a border is taken for another one


@dataclass(frozen=True, kw_only=True)
class SharedHyperplanes:
    """Which hyperplanes are kept, and the sides of these that the cells claim."""

    kept: tuple[int, ...]  # numbers of the hyperplanes that stand for all, in ascending order
    signs: IntArray  # (l, k), for those that are kept
    repairs: tuple[tuple[int, int, Fraction], ...] = ()  # (k, other, by how much of its numbers k differs), not 0


def merge(rows: Sequence[Row], signs: IntArray) -> SharedHyperplanes:
    """Merge hyperplanes that are the same set, and those that two cells write with numbers rounded differently.

    The latter are those whose numbers (after a common factor) differ by at most 1e-12 of themselves, where no cell is
    between them: none claims opposite sides of the two, and none loses its interior.
    """
    exact = _same(rows, signs)
    rows = [rows[k] for k in exact.kept]
    banned: set[int] = set()
    while True:
        rounded = _nearly_same(rows, exact.signs, banned)
        moved = [k for repair in rounded.repairs for k in repair[:2]]
        claimants = np.flatnonzero(exact.signs[:, moved].any(axis=1))
        lost = [
            i
            for i in claimants
            if _has_interior(rows, exact.signs[i])
            and not _has_interior([rows[k] for k in rounded.kept], rounded.signs[i])
        ]
        if not lost:
            break
        banned |= {int(k) for i in lost for k in np.flatnonzero(exact.signs[i])}
    return replace(
        rounded,
        kept=tuple(exact.kept[k] for k in rounded.kept),
        repairs=tuple((exact.kept[k], exact.kept[other], size) for k, other, size in rounded.repairs),
    )


def _same(rows: Sequence[Row], signs: IntArray) -> SharedHyperplanes:
    """Merge equal sets. Of one whose both sides a cell claims, which has no interior, that cell has a second copy."""
    kept: list[int] = []
    columns: list[IntArray] = []
    homes: dict[Row, list[tuple[int, int]]] = {}
    for k, row in enumerate(rows):
        plane, side = oriented(row)
        claimed = signs[:, k]
        for position, other in homes.setdefault(plane, []):
            facing = side * other * claimed
            free = columns[position] * facing >= 0
            columns[position] = np.where(free & (facing != 0), facing, columns[position])
            claimed = np.where(free, 0, claimed)
        if claimed.any() or not homes[plane]:
            homes[plane].append((len(kept), side))
            columns.append(claimed)
            kept.append(k)
    return SharedHyperplanes(kept=tuple(kept), signs=np.array(columns, dtype=np.int64).reshape(len(kept), len(signs)).T)


def _nearly_same(rows: Sequence[Row], signs: IntArray, banned: set[int]) -> SharedHyperplanes:
    """Merge distinct hyperplanes by rounding, the closest ones first."""
    table = signs.copy()
    home = list(range(len(rows)))
    repairs: dict[int, tuple[int, Fraction]] = {}
    for _, one, other in sorted(_close(rows)):
        k, to = max(home[one], home[other]), min(home[one], home[other])
        group = [j for j in range(len(rows)) if home[j] == k]
        away = {j: difference(rows[j], rows[to]) for j in group}
        if k == to or banned & {*group, to} or any(size is None for size in away.values()):
            continue
        claimed = oriented(rows[k])[1] * oriented(rows[to])[1] * table[:, k]
        if not claimed.any() or not table[:, to].any() or (table[:, to] * claimed < 0).any():
            continue
        table[:, to] = np.where(claimed != 0, claimed, table[:, to])
        for j, size in away.items():
            assert size is not None
            home[j], repairs[j] = to, (to, size)
    kept = [k for k in range(len(rows)) if home[k] == k]
    return SharedHyperplanes(
        kept=tuple(kept),
        signs=table[:, kept],
        repairs=tuple((k, to, size) for k, (to, size) in sorted(repairs.items())),
    )


def difference(one: Row, other: Row) -> Fraction | None:
    """Return by how much of themselves the numbers of two hyperplanes differ at most, in any units; None if by more."""
    if any((a == 0) != (b == 0) for a, b in zip(one, other, strict=True)):
        return None
    ratios = [Fraction(a, b) for a, b in zip(one, other, strict=True) if b]
    if min(ratios) < 0 < max(ratios):
        return None
    sizes = [abs(ratio) for ratio in ratios]
    spread = max(sizes) / min(sizes) - 1
    return spread if spread <= _ROUNDING else None


def _close(rows: Sequence[Row]) -> list[tuple[Fraction, int, int]]:
    logs = np.array([[log2(abs(a)) if a else -np.inf for a in row] for row in rows])
    found = []
    for k in range(len(rows) - 1):
        with np.errstate(invalid="ignore"):  # of entries that are 0 in both
            ratio = logs[k + 1 :] - logs[k]
            spread = np.nanmax(ratio, axis=1) - np.nanmin(ratio, axis=1)
        for other in np.flatnonzero(spread < 1e-6).tolist():  # far coarser than these logarithms and the true limit
            size = difference(rows[k], rows[k + 1 + other])
            if size is not None:
                found.append((size, k, k + 1 + other))
    return found


def _has_interior(rows: Sequence[Row], signs: IntArray) -> bool:
    return borders(claims(rows, signs), len(rows[0]) - 1) is not None


def claims(rows: Sequence[Row], signs: IntArray) -> list[Row]:
    """Return the inequalities of a vector of signs."""
    return [rows[k] if signs[k] > 0 else opposite(rows[k]) for k in np.flatnonzero(signs).tolist()]
