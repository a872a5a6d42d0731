"""What a certificate may hold: the keys of each object, all of them and no others, and what stands behind them.

A list [s] has any length, [s, t] these entries; of a tuple (None, s, t) one is there, with its own keys; a key with a
question mark may be absent; {WHOLE: s} has cells by number, {TEXT: s} names.
"""

from typing import Any

from .matrices import AuditFault
from .reading import number

TEXT, NUMBER, WHOLE, DIGEST = "text on one line", "number", "whole number", "digest of 64 hexadecimal digits"
LEAVES = {
    TEXT: lambda value: type(value) is str and value.isprintable(),
    WHOLE: lambda value: type(value) is int and abs(value) <= 10**9,
    DIGEST: lambda value: type(value) is str and len(value) == 64 and {*value} <= {*"0123456789abcdef"},
}
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
    if shape == NUMBER:
        number(value)
    elif isinstance(shape, str):
        if not LEAVES[shape](value):
            raise AuditFault(f"{place} is no {shape}")
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
