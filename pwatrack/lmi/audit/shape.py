"""What a certificate may hold: the keys of each object, all of them and no others, and what stands behind them.

A list [s] has any length, [s, t] these entries; of a tuple (None, s, t) one is there, with its own keys; a key with a
question mark may be absent; {WHOLE: s} has cells by number, {TEXT: s} names.
"""

from typing import Any

from .matrices import Fault
from .reading import number

TEXT, NUMBER, WHOLE = "text on one line", "number", "whole number"
ROWS, OPEN = [[NUMBER]], (None, [[NUMBER]])  # a matrix; radii of its entries, or none
PACKED = {"integers": ROWS, "exponents": [WHOLE]}
PROOFS: dict[str, dict[str, Any]] = {  # the claims that there are, by name: which one a proof is, its keys say
    "common P": {"of": TEXT, "rate": NUMBER, "margin": NUMBER, "radius": NUMBER, "P": PACKED},
    "polynomial": {"of": TEXT, "degree": NUMBER, "rate": NUMBER, "T": ROWS, "P": PACKED, "N": [PACKED]},
    "P of any sign": {"of": TEXT, "bounded": TEXT, "margin": NUMBER, "P": PACKED},
    "cost": {"of": TEXT, "X": ROWS, "Q": ROWS, "R": ROWS},
    "multipliers": {"of": TEXT, "rate": NUMBER, "Z": {WHOLE: ROWS}},
    "mode of a mean": {"of": TEXT, "rate": NUMBER, "between": {WHOLE: NUMBER}, "rows": ROWS, "mode": [NUMBER]}
    | {"eigenvalue": NUMBER, "inverse": ROWS, "radius": NUMBER},
    "no P, by multipliers": {"of": TEXT, "no_P": TEXT, "Z": {WHOLE: ROWS}},
    "no P, by unstable modes": {"of": TEXT, "no_P": TEXT, "P": {WHOLE: PACKED}},
}
CELLS = {  # the proofs that nothing is possible, and what they have for some cells
    "multipliers": "Z",
    "mode of a mean": "between",
    "no P, by multipliers": "Z",
    "no P, by unstable modes": "P",
}
RADII = {"A": (None, [OPEN]), "b": (None, [OPEN]), "B": OPEN}
LOADS = {"names": [TEXT], "where": [WHOLE], "E": ROWS, "S": ROWS, "radius": {"E": OPEN, "S": OPEN}}
PORTS = {"states": [TEXT], "inputs": [TEXT], "outputs": [TEXT], "tracked": [TEXT], "B": ROWS, "C": ROWS} | {
    "tracked_rows": ROWS,
    "loads": (None, LOADS),
    "radius": RADII | {"C": OPEN, "tracked_rows": OPEN},
}
LISTED = PORTS | {"cells": [TEXT], "H": ROWS, "h": [NUMBER], "signs": [[WHOLE]], "A": [ROWS], "b": [ROWS]}
FUNCTION = {"breakpoints": [NUMBER], "slopes": [NUMBER], "value": NUMBER}
TERM = {"row": [NUMBER], "constant": NUMBER, "direction": [NUMBER], "function": FUNCTION}
ELEMENTS = PORTS | {"A": ROWS, "b": ROWS, "elements": [TERM | {"segments": [TEXT]}]}
MERGED = TERM | {"element": WHOLE, "first": WHOLE, "last": WHOLE, "name": TEXT, "merged": FUNCTION, "largest": NUMBER}
GENERATOR = {
    "relative_degrees": [WHOLE],
    "directions": ROWS,
    "scales": [NUMBER],
    "internal": [WHOLE],
    "eta": [TEXT],
} | {
    "T": [ROWS],
    "A_eta?": [ROWS],
}
CHANNEL, SIGNALS = [TEXT, WHOLE], [[TEXT, WHOLE, NUMBER]]
PART = {"loop": TEXT, "channel": CHANNEL, "a": NUMBER, "Q": PACKED, "signals": SIGNALS}
PEAK = {"part": WHOLE, "unit": WHOLE, "steps": [[WHOLE, WHOLE]], "P": PACKED, "size": NUMBER}
BOUNDS = [{"channel": CHANNEL, "signals": SIGNALS, "parts": [PART], "peaks?": [PEAK]}]
LIMIT = {"of": TEXT, "loop": TEXT, "starts": ROWS, "weights": [NUMBER], "Q": PACKED, "signals": SIGNALS}
CORNER = {"A": [ROWS], "b": [ROWS], "B": ROWS, "radius": RADII}
REFUSAL = {"format": TEXT, "claim": TEXT, "spec_sha256": TEXT, "set": {TEXT: TEXT}, "tracking": TEXT} | {
    "plant": (LISTED, ELEMENTS),
    "generator": (None, GENERATOR),
    "K": OPEN,
    "L": OPEN,
    "proofs": [tuple(PROOFS.values())],
}
DESIGN = REFUSAL | {
    "bounds": BOUNDS,
    "limits": [LIMIT],
    "uncertain": (None, {"parameters": [[TEXT, NUMBER, NUMBER]], "corners": [CORNER], "bounds": BOUNDS}),
    "practical": (
        None,
        {"plant": LISTED, "merged": [MERGED], "observer_runs": TEXT, "ends_below": SIGNALS, "bounds": BOUNDS},
    ),
    "eta_with_loads?": ROWS,
}


def fit(value: Any, shape: Any, place: str) -> None:
    """Raise a fault, with its place, unless a value of the file has a shape."""
    if isinstance(shape, tuple):
        if value is None and None in shape:
            return
        found = value.keys() if isinstance(value, dict) else set[str]()
        nearest = {len(found ^ one.keys()) if isinstance(one, dict) else 0: one for one in shape[::-1] if one}
        shape = nearest[min(nearest)]
    if isinstance(shape, str):
        fits = type(value) is {TEXT: str, WHOLE: int}.get(shape, type(value))
        if not fits or (shape == TEXT and not value.isprintable()) or (shape == WHOLE and abs(value) > 10**9):
            raise Fault(f"{place} is no {shape}")
        if shape == NUMBER:
            number(value)
    elif type(value) is not type(shape):
        raise Fault(f"{place} is {'no list' if isinstance(shape, list) else 'no object'}")
    elif isinstance(shape, list):
        if len(shape) > 1 and len(value) != len(shape):
            raise Fault(f"{place} has not {len(shape)} entries")
        for k, entry in enumerate(value):
            fit(entry, shape[k if len(shape) > 1 else 0], f"{place}.{k}")
    elif shape.keys() & {TEXT, WHOLE}:
        (kind,) = shape
        for key, entry in value.items():
            if kind == WHOLE and not (key.isdecimal() and key == str(int(key))):
                raise Fault(f"{place} has a key that is no {WHOLE}, {key!r}")
            fit(entry, shape[kind], f"{place}.{key}")
    else:
        keys = {key.removesuffix("?"): one for key, one in shape.items()}
        for key in (*value, *keys):
            if key not in keys or (key not in value and key in shape):
                raise Fault(f"'{key}' {'is missing' if key in keys else 'is no key'} in {place}")
        for key, entry in value.items():
            fit(entry, keys[key], f"{place}.{key}")


def kind(proof: Any) -> str:
    """Return which claim a proof is, by its keys: what it is decided by, and what is said of it."""
    found = [name for name, shape in PROOFS.items() if shape.keys() == proof.keys()]
    if not found:
        raise Fault(f"no claim has the keys {', '.join(map(repr, proof))}")
    return found[0]


def by_cell(proof: Any) -> Any:
    """Return what a proof of impossibility has for some cells, by their numbers; nothing of any other."""
    return proof[CELLS[kind(proof)]] if kind(proof) in CELLS else {}


def refuses(content: Any) -> bool:
    """Say whether a certificate is one of a refusal: some proof in it says that nothing is possible."""
    return any(kind(proof) in CELLS for proof in content["proofs"])
