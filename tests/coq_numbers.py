"""The numbers of a development for Coq, read by another reader and decided by another method."""

import json
import re
from fractions import Fraction
from math import lcm
from typing import Any

import flint

Rows = list[list[Fraction]]


def written(text: str) -> dict[str, Any]:
    """Return the numbers that a file defines, by their names."""
    found = re.findall(r"Definition (\w+)[^=]*? :=\s(.*?)\.(?:\s|$)", text, re.DOTALL)
    return {name: json.loads(_listed(value)) for name, value in found if name != "all"}


def _listed(text: str) -> str:
    return re.sub(r"\((-\d+)\)", r"\1", text).translate(str.maketrans("();", "[],"))


def definite(rows: list[list[int]]) -> bool:
    """Say whether all leading minors are positive."""
    return all(flint.fmpz_mat([row[:k] for row in rows[:k]]).det() > 0 for k in range(1, len(rows) + 1))


def gains_hold(found: dict[str, Any]) -> bool:
    """Say whether (8) holds for the numbers that are written."""
    K, B = _over(found, "K"), _over(found, "B")
    n = len(K[0])
    loops = [_plus([row[:n] for row in X[:n]], B, K) for X in _slopes(found, "A")]
    return definite(found["P"]) and all(_falls(M, found["P"], Fraction(found["alpha"], found["D"])) for M in loops)


def observer_holds(found: dict[str, Any]) -> bool:
    """Say whether (9) holds for them."""
    C, L = _over(found, "C"), _over(found, "L")
    name = "A_seen" if "A_seen" in found else "A"
    seen = [_plus(X, L, C) for X in _slopes(found, name)]
    flipped = [[list(column) for column in zip(*M, strict=True)] for M in seen]
    return definite(found["Q"]) and all(_falls(M, found["Q"], Fraction(found["beta"], found["D"])) for M in flipped)


def _falls(M: Rows, P: list[list[int]], rate: Fraction) -> bool:
    """Say whether M P + P M^T + 2 rate P is negative definite."""
    n = range(len(P))
    S = [[-_dot(M[i], P[j]) - _dot(P[i], M[j]) - 2 * rate * P[i][j] for j in n] for i in n]
    common = lcm(*(v.denominator for row in S for v in row))
    return definite([[int(v * common) for v in row] for row in S])


def _over(found: dict[str, Any], name: str) -> Rows:
    return [[Fraction(v, found["D"]) for v in row] for row in found[name]]


def _slopes(found: dict[str, Any], name: str) -> list[Rows]:
    return [[[Fraction(v, found["D"]) for v in row] for row in X] for X in found[name]]


def _plus(A: Rows, B: Rows, K: Rows) -> Rows:
    """Return A + B K."""
    columns = list(zip(*K, strict=True))
    return [[a + _dot(B[i], column) for a, column in zip(row, columns, strict=True)] for i, row in enumerate(A)]


def _dot(a: Any, b: Any) -> Any:
    return sum((v * w for v, w in zip(a, b, strict=True)), Fraction(0))
