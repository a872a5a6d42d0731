"""Exact numbers as a certificate has them, written and read again: decimals, integers with exponents, signals."""

from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from typing import Any

import numpy as np

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix, text
from pwatrack.control.bounds import Bounds, Channel, Form, ProvedPeak, SignalEllipsoid
from pwatrack.lmi.audit.reading import number
from pwatrack.lmi.ellipsoid import InvariantEllipsoid
from pwatrack.lmi.peak_gain import PeakGain

CLOSE = 1e-9  # of the largest of some numbers: what two processors may make of one formula


def decimal(value: float) -> str:
    """Return a double as the decimals that it prints as."""
    return text(Fraction(repr(float(value))))


def double(value: Any) -> float:
    """Return the double that decimals were printed from."""
    return float(number(value))


def decimal_texts(X: Array | None) -> list[list[str]] | None:
    """Return a matrix of doubles as the decimals that they print as."""
    return None if X is None else BallMatrix.of(X, (X.shape[0], X.shape[1])).texts


def doubles(rows: Any) -> Array:
    """Return the matrix that decimals were printed from."""
    return np.array([[double(v) for v in row] for row in rows])


def radii(matrices: Sequence[BallMatrix]) -> list[Any] | None:
    """Return by how much entries of some matrices may be off; None where all are exact."""
    return None if all(X.radius is None for X in matrices) else [X.radius_texts for X in matrices]


def packed(integers: Sequence[Sequence[int]], exponents: Sequence[int]) -> dict[str, Any]:
    """Return a symmetric matrix as integers_jk 2^(exponents_j + exponents_k)."""
    return {"integers": [list(row) for row in integers], "exponents": list(exponents)}


def whole(found: Any) -> dict[str, Any]:
    """Return integers and exponents of what `packed` gave, as the classes of proofs take them."""
    integers = tuple(tuple(int(number(v)) for v in row) for row in found["integers"])
    return {"integers": integers, "exponents": tuple(found["exponents"])}


def signals(sizes: Iterable[tuple[Form, float]]) -> list[list[Any]]:
    """Return bounds of signals, each a double larger: its decimals are not below it."""
    return [[*form, decimal(np.nextafter(size, np.inf))] for form, size in sizes]


def read_signals(found: Any) -> Iterator[tuple[Form, float]]:
    """Yield what was written by `signals`."""
    for of, k, size in found:
        yield (of, k), float(np.nextafter(double(size), -np.inf))


def bounds_content(bounds: Bounds) -> dict[str, Any]:
    """Return what one channel can do, with the ellipsoids and peak gains that prove it."""
    parts = [
        {
            "loop": part.loop,
            "channel": list(part.channel),
            "a": decimal(part.ellipsoid.a),
            "Q": packed(part.ellipsoid.integers, part.ellipsoid.exponents),
            "signals": signals(zip(part.signals, part.ellipsoid.sizes, strict=True)),
        }
        for part in bounds.parts
    ]
    peaks = [
        {
            "part": peak.part,
            "unit": peak.gain.unit,
            "steps": [list(run) for run in peak.gain.steps],
            "P": packed(peak.gain.integers, peak.gain.exponents),
            "size": decimal(peak.gain.size),
        }
        for peak in bounds.proved
    ]
    found = {"channel": list(bounds.channel), "signals": signals(bounds.certified.items()), "parts": parts}
    return found | ({"peaks": peaks} if peaks else {})


def read_bounds(entry: Any) -> Bounds:
    """Return what was written by `bounds_content`."""
    parts = tuple(
        SignalEllipsoid(
            loop=part["loop"],
            channel=read_channel(part["channel"]),
            signals=tuple(form for form, _ in read_signals(part["signals"])),
            ellipsoid=InvariantEllipsoid(
                **whole(part["Q"]), a=double(part["a"]), sizes=tuple(size for _, size in read_signals(part["signals"]))
            ),
        )
        for part in entry["parts"]
    )
    proved = tuple(
        ProvedPeak(
            part=peak["part"],
            gain=PeakGain(
                unit=peak["unit"],
                steps=tuple((k, count) for k, count in peak["steps"]),
                size=double(peak["size"]),
                **whole(peak["P"]),
            ),
        )
        for peak in entry.get("peaks", [])
    )
    sizes = dict(read_signals(entry["signals"]))
    return Bounds(channel=read_channel(entry["channel"]), sizes=sizes, parts=parts, proved=proved)


def read_channel(channel: Any) -> Channel:
    """Return a channel that was written as a list."""
    return channel[0], channel[1]
