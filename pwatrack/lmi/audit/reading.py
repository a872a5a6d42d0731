"""What a certificate may hold, the keys of each object, all of them and no others; its numbers and matrices.

Of shapes: a list [s] has any length, [s, t] these entries; of a tuple (None, s, t) one is there, with its own keys; a
key with a question mark may be absent; {WHOLE: s} has cells by number, {TEXT: s} names.
"""

import json
import re
from fractions import Fraction
from functools import lru_cache
from itertools import pairwise
from typing import Any

from .matrices import AuditFault, Ball, Matrix, spend, transposed

FORMAT = "pwatrack certificate 12"  # of the file: 12 has exactly the keys below, and one form of each number

_NUMBER = re.compile(r"-?[0-9]{1,4000}(\.[0-9]{1,40})?(e-?[0-9]{1,3})?|-?[0-9]{1,4000}/[0-9]{1,4000}")
_LARGEST = 2_000  # binary exponent: beyond those of doubles


def parsed(text: str, decimals: Any = str) -> Any:
    """Return what JSON holds, its decimals as they are written, or as doubles; each key of an object once."""
    return json.loads(text, parse_float=decimals, parse_constant=str, object_pairs_hook=_object)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs) or not all(map(str.isprintable, found)):
        twice = next((key for k, (key, _) in enumerate(pairs) if key in dict(pairs[:k])), None)
        raise AuditFault("a key is no text on one line" if twice is None else f"the key {twice!r} is there twice")
    return found


@lru_cache(2**16)  # the entries of many cells are written alike
def _fraction(value: str) -> Fraction:
    """Return a number that is written as there is one way to: the shortest decimal of a double, or a fraction."""
    if not _NUMBER.fullmatch(value):
        raise AuditFault(f"not a number: {ascii(value)[:40]}")
    found = Fraction(value)
    shown = repr(float(found)).removesuffix(".0").replace("e+", "e") if abs(found) < 1e300 else ""
    if value != (shown if shown and Fraction(shown) == found else str(found)):
        raise AuditFault(f"not a number as it is to be written: {value[:40]}")
    return found


def number(value: Any) -> Fraction:
    """Return a number of the file as the decimal or fraction it is written as."""
    spend(1)
    if type(value) not in (str, int):
        raise AuditFault(f"not a number: {ascii(value)[:40]}")
    return _fraction(value) if isinstance(value, str) else Fraction(value)


def place(k: Any, count: int) -> int:
    """Return the place of something among so many, counted from 0."""
    if type(k) is not int or not 0 <= k < count:
        raise AuditFault(f"there is no {str(k)[:40]} among {count}")
    return k


def distinct(things: list[Any], what: str) -> None:
    """Raise a fault if one thing is there twice."""
    if any(one == other for one, other in pairwise(sorted(things))):
        raise AuditFault(f"{what} is there twice")


def matrix(rows: Any) -> Matrix:
    """Return a matrix of the file."""
    return [[number(v) for v in row] for row in rows]


def symmetric(rows: Any, name: str) -> Matrix:
    """Return a symmetric matrix of the file."""
    X = matrix(rows)
    if transposed(X) != X:
        raise AuditFault(f"{name} is not symmetric")
    return X


def ball(rows: Any, radius: Any) -> Ball:
    """Return a matrix of the file with its radius; [] for none."""
    R = matrix(radius) if radius else []
    if any(v < 0 for row in R for v in row):
        raise AuditFault("a radius is negative")
    centre = matrix(rows)
    if R and [*map(len, R)] != [*map(len, centre)]:
        raise AuditFault("a radius is not of the shape of its matrix")
    return Ball(centre, R)


def packed(content: Any) -> tuple[Matrix, list[Fraction]]:
    """Return the symmetric matrix integers_jk * 2**(exponents_j + exponents_k), and the powers of two."""
    if any(abs(e) > _LARGEST for e in content["exponents"]):
        raise AuditFault("an exponent is too large to be read")
    powers = [Fraction(2) ** e for e in content["exponents"]]
    rows = zip(symmetric(content["integers"], "P or Q"), powers, strict=True)
    return [[v * a * b for v, b in zip(row, powers, strict=True)] for row, a in rows], powers


TEXT, NUMBER, WHOLE, DIGEST = "text on one line", "number", "whole number", "digest of 64 hexadecimal digits"
HEX = {*"0123456789abcdef"}
Shape = dict[str, Any]


def of(shape: Any, keys: str) -> Shape:
    """Return these keys, each with the same behind it."""
    return dict.fromkeys(keys.split(), shape)


ROWS, OPEN = [[NUMBER]], (None, [[NUMBER]])  # a matrix; radii of its entries, or none
PACKED = {"integers": ROWS, "exponents": [WHOLE]}
PROOFS: dict[str, Shape] = {  # the claims that there are, by name: which one a proof is, its keys say
    "common P": of(NUMBER, "rate margin radius") | {"P": PACKED},
    "polynomial": of(NUMBER, "degree rate") | {"T": ROWS, "P": PACKED, "N": [PACKED]},
    "P of any sign": {"bounded": TEXT, "margin": NUMBER, "P": PACKED},
    "cost": of(ROWS, "X Q R"),
    "multipliers": {"rate": NUMBER, "Z": {WHOLE: ROWS}},
    "mode of a mean": of(NUMBER, "rate eigenvalue radius")
    | of(ROWS, "rows inverse")
    | {"between": {WHOLE: NUMBER}, "mode": [NUMBER]},
    "no P, by multipliers": {"no_P": TEXT, "Z": {WHOLE: ROWS}},
    "no P, by unstable modes": {"no_P": TEXT, "P": {WHOLE: PACKED}},
}
CELLS = {"multipliers": "Z", "mode of a mean": "between"}  # the proofs that nothing is possible, and their cells
CELLS |= {"no P, by multipliers": "Z", "no P, by unstable modes": "P"}
for each in PROOFS.values():
    each["of"] = TEXT
RADII = of((None, [OPEN]), "A b") | {"B": OPEN}
LOADS = {"names": [TEXT], "where": [WHOLE], "E": ROWS, "S": ROWS, "radius": of(OPEN, "E S")}
PORTS = of([TEXT], "states inputs outputs tracked") | of(ROWS, "B C tracked_rows")
PORTS |= {"loads": (None, LOADS), "radius": RADII | of(OPEN, "C tracked_rows")}
LISTED = PORTS | {"cells": [TEXT], "H": ROWS, "h": [NUMBER], "signs": [[WHOLE]]} | of([ROWS], "A b")
FUNCTION = of([NUMBER], "breakpoints slopes") | {"value": NUMBER}
TERM = of([NUMBER], "row direction") | {"constant": NUMBER, "function": FUNCTION}
ELEMENTS = PORTS | of(ROWS, "A b") | {"elements": [TERM | {"segments": [TEXT]}]}
GENERATOR = of([WHOLE], "relative_degrees internal") | of([ROWS], "T A_eta?")
GENERATOR |= {"directions": ROWS, "scales": [NUMBER], "eta": [TEXT]}
REFUSAL = of(TEXT, "format claim tracking") | of(OPEN, "K L") | {"spec_sha256": DIGEST, "set": {TEXT: TEXT}}
REFUSAL |= {"plant": (LISTED, ELEMENTS), "generator": (None, GENERATOR), "proofs": [tuple(PROOFS.values())]}


def fit(value: Any, shape: Any, place: str) -> None:
    """Raise a fault, with its place, unless a value of the file has a shape."""
    if isinstance(shape, tuple):
        if value is None and None in shape:
            return
        found = value.keys() if isinstance(value, dict) else set[str]()
        nearest = {len(found ^ one.keys()) if isinstance(one, dict) else 0: one for one in shape[::-1] if one}
        shape = nearest[min(nearest)]
    if isinstance(shape, str):
        fits = type(value) is {TEXT: str, DIGEST: str, WHOLE: int}.get(shape, type(value))
        if not fits or (shape == TEXT and not value.isprintable()) or (shape == WHOLE and abs(value) > 10**9):
            raise AuditFault(f"{place} is no {shape}")
        if shape == DIGEST and (len(value) != 64 or not {*value} <= HEX):
            raise AuditFault(f"{place} is no {shape}")
        if shape == NUMBER:
            number(value)
    elif type(value) is not type(shape):
        raise AuditFault(f"{place} is {'no list' if isinstance(shape, list) else 'no object'}")
    elif isinstance(shape, list):
        if len(shape) > 1 and len(value) != len(shape):
            raise AuditFault(f"{place} has not {len(shape)} entries")
        for k, entry in enumerate(value):
            fit(entry, shape[k if len(shape) > 1 else 0], f"{place}.{k}")
    elif shape.keys() & {TEXT, WHOLE}:
        (kind,) = shape
        for key, entry in value.items():
            if kind == WHOLE and not (key.isdecimal() and key == str(int(key))):
                raise AuditFault(f"{place} has a key that is no {WHOLE}, {key!r}")
            fit(entry, shape[kind], f"{place}.{key}")
    else:
        keys = {key.removesuffix("?"): one for key, one in shape.items()}
        for key in (*value, *keys):
            if key not in keys or (key not in value and key in shape):
                raise AuditFault(f"'{key}' {'is missing' if key in keys else 'is no key'} in {place}")
        for key, entry in value.items():
            fit(entry, keys[key], f"{place}.{key}")


def kind(proof: Any) -> str:
    """Return which claim a proof is, by its keys: what it is decided by, and what is said of it."""
    found = [name for name, shape in PROOFS.items() if shape.keys() == proof.keys()]
    if not found:
        raise AuditFault(f"no claim has the keys {', '.join(map(repr, proof))}")
    return found[0]


def by_cell(proof: Any) -> Any:
    """Return what a proof of impossibility has for some cells, by their numbers; nothing of any other."""
    return proof[CELLS[kind(proof)]] if kind(proof) in CELLS else {}


def refuses(content: Any) -> bool:
    """Say whether a certificate is one of a refusal: some proof in it says that nothing is possible."""
    return any(kind(proof) in CELLS for proof in content["proofs"])
