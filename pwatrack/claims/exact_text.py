"""What a certificate holds in exact numbers, written and read again: matrices, signals, a plant, its form (11)."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix, text
from pwatrack.control.bounds import Bounds, Channel, Form, SignalEllipsoid
from pwatrack.lmi.audit.reading import number
from pwatrack.lmi.audit.shape import kind
from pwatrack.lmi.clocked import ClockedProof
from pwatrack.lmi.clocked_region import ClockedRegion
from pwatrack.lmi.clocked_tubes import Tube
from pwatrack.lmi.dichotomy import Dichotomy
from pwatrack.lmi.ellipsoid import InvariantEllipsoid, StartEllipsoid
from pwatrack.lmi.exact import Packed, Proof
from pwatrack.lmi.inequality import CONTROLLER, GENERATOR, OBSERVER, PLANT
from pwatrack.lmi.peak_gain import PeakGain
from pwatrack.lmi.polynomial import AnyProof, PolynomialProof
from pwatrack.lmi.polynomial_region import PolynomialRegion
from pwatrack.lmi.saturated import Region
from pwatrack.model.normal_form import NormalForm
from pwatrack.model.pwa import Matrices, PWASystem
from pwatrack.real import Real

_ROLES = {role.name: role for role in (PLANT, CONTROLLER, OBSERVER, GENERATOR)}
Held = StartEllipsoid | Region | ClockedRegion | PolynomialRegion  # what errors from some starts do not leave


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
    return np.array([[double(v) for v in row] for row in rows]).reshape(len(rows), len(rows[0]) if rows else 0)


def radii(matrices: Sequence[BallMatrix]) -> list[Any] | None:
    """Return by how much entries of some matrices may be off; None where all are exact."""
    return None if all(X.radius is None for X in matrices) else [X.radius_texts for X in matrices]


def packed(X: Packed) -> dict[str, Any]:
    """Return a symmetric matrix as integers_jk 2^(exponents_j + exponents_k)."""
    return {"integers": [list(row) for row in X.integers], "exponents": list(X.exponents)}


def whole(found: Any) -> dict[str, Any]:
    """Return integers and exponents of what `packed` gave, as the classes of proofs take them."""
    integers = tuple(tuple(int(number(v)) for v in row) for row in found["integers"])
    return {"integers": integers, "exponents": tuple(found["exponents"])}


class Text(NamedTuple):
    """How a value is written, and read again if it is."""

    write: Callable[[Any], Any]
    read: Callable[[Any], Any] = str

    def each(self) -> "Text":
        """Return how several values are."""
        return Text(lambda values: [self.write(v) for v in values], lambda told: tuple(map(self.read, told)))


class Record:
    """How objects of a class are written and read again: attributes by their names, in this order."""

    def __init__(self, make: Callable[..., Any] = dict, **texts: Text) -> None:
        self.make, self.texts = make, texts

    def write(self, one: Any) -> dict[str, Any]:
        """Return what is told of an object."""
        return {key: of.write(one if of is OWN else getattr(one, key)) for key, of in self.texts.items()}

    def read(self, told: Any, **known: Any) -> Any:
        """Return the object, with attributes that are told elsewhere."""
        for key, of in self.texts.items():
            found = of.read(told[key])
            known |= found if of is OWN else {key: found}
        return self.make(**known)


DECIMAL, MATRIX, NUMBER = Text(decimal, double), Text(decimal_texts, doubles), Text(int, int)
OWN = Text(packed, whole)  # the matrix that an object is itself, under a key of its own
FORMS, ROWS = Text(packed, lambda told: Packed(**whole(told))).each(), DECIMAL.each().each()

CLOCKED = Record(ClockedProof, rate=DECIMAL, P=FORMS, T=ROWS)
TUBE = Record(Tube, a=DECIMAL, b=DECIMAL, summed=Text(int, bool), Q=FORMS, T=ROWS)
_ELLIPSOID = Record(InvariantEllipsoid, a=DECIMAL, Q=OWN)
_PEAK = Record(PeakGain, unit=NUMBER, steps=Text(list, tuple).each(), P=OWN, size=DECIMAL)
_PROOFS = {
    Proof: Record(Proof, rate=DECIMAL, margin=DECIMAL, radius=DECIMAL, P=OWN),
    PolynomialProof: Record(PolynomialProof, degree=NUMBER, rate=DECIMAL, T=MATRIX, P=OWN),
    Dichotomy: Record(Dichotomy, margin=DECIMAL, P=OWN),
}
_HELD = {
    StartEllipsoid: Record(StartEllipsoid, Q=OWN),
    Region: Record(Region, Q=OWN, H=MATRIX),
    ClockedRegion: Record(ClockedRegion, P=FORMS, T=ROWS, H=MATRIX),
}

_CENTRE = Text(lambda value: text(Real.of(value).centre))
_EXACT, _RADIUS, _LIST = Text(lambda X: X.texts), Text(lambda X: X.radius_texts), Text(list)
FUNCTION = Record(breakpoints=_CENTRE.each(), slopes=_CENTRE.each(), value=_CENTRE)
TERM = Record(row=_CENTRE.each(), constant=_CENTRE, direction=_CENTRE.each(), function=Text(FUNCTION.write))
_NAMES, _PORTS = Record(states=_LIST, inputs=_LIST, outputs=_LIST), Record(B=_EXACT, C=_EXACT)
_LOADS, _LOAD_RADII = Record(names=_LIST, where=_LIST, E=_EXACT, S=_EXACT), Record(E=_RADIUS, S=_RADIUS)
_FIELD, _FIELD_RADII = Record(A=_EXACT.each(), b=_EXACT.each()), Record(A=Text(radii), b=Text(radii))


def held_content(held: Held) -> dict[str, Any]:
    """Return what holds some starts."""
    if isinstance(held, PolynomialRegion):
        return {"V": proof_content(held.proof), "H": decimal_texts(held.H)}
    return _HELD[type(held)].write(held)


def read_held(entry: Any) -> Held:
    """Return what was written by `held_content`, with weights of the starts, and sizes."""
    sizes = tuple(size for _, size in read_signals(entry["signals"]))
    weights = DECIMAL.each().read(entry["weights"])
    if "V" in entry:
        proof = read_proof(entry["V"])
        assert isinstance(proof, PolynomialProof)
        return PolynomialRegion(proof=proof, H=doubles(entry["H"]), weights=weights, sizes=sizes)
    of = ClockedRegion if "P" in entry else Region if "H" in entry else StartEllipsoid
    held: Held = _HELD[of].read(entry, weights=weights, sizes=sizes)
    return held


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
        {"loop": part.loop, "channel": list(part.channel)}
        | _ELLIPSOID.write(part.ellipsoid)
        | {"signals": signals(zip(part.signals, part.ellipsoid.sizes, strict=True))}
        for part in bounds.parts
    ]
    peaks = [{"part": part} | _PEAK.write(gain) for part, gain in bounds.proved.items()]
    found = {"channel": list(bounds.channel), "signals": signals(bounds.certified.items()), "parts": parts}
    return found | ({"peaks": peaks} if peaks else {})


def read_bounds(entry: Any) -> Bounds:
    """Return what was written by `bounds_content`."""
    parts = list[SignalEllipsoid]()
    for part in entry["parts"]:
        each = list(read_signals(part["signals"]))
        channel, forms = read_channel(part["channel"]), tuple(form for form, _ in each)
        ellipsoid = _ELLIPSOID.read(part, sizes=tuple(size for _, size in each))
        parts.append(SignalEllipsoid(loop=part["loop"], channel=channel, signals=forms, ellipsoid=ellipsoid))
    return Bounds(
        channel=read_channel(entry["channel"]),
        sizes=dict(read_signals(entry["signals"])),
        parts=tuple(parts),
        proved={peak["part"]: _PEAK.read(peak) for peak in entry.get("peaks", [])},
    )


def read_channel(channel: Any) -> Channel:
    """Return a channel that was written as a list."""
    return channel[0], channel[1]


def proof_content(proof: AnyProof | Dichotomy) -> dict[str, Any]:
    """Return the proof of an inequality."""
    found: dict[str, Any] = {"of": proof.role.name} | ({"bounded": "both ways"} if isinstance(proof, Dichotomy) else {})
    found |= _PROOFS[type(proof)].write(proof)
    if isinstance(proof, PolynomialProof):
        found["N"] = [packed(Packed(integers=N_i, exponents=proof.N_exponents)) for N_i in proof.N]
    return found


def read_proof(proof: Any) -> AnyProof | Dichotomy:
    """Return what was written by `proof_content`."""
    known: dict[str, Any] = {"role": _ROLES[proof["of"]]}
    if "N" in proof:
        each = [whole(N) for N in proof["N"]]
        known |= {"N": tuple(N["integers"] for N in each), "N_exponents": each[0]["exponents"]}
    of = {"polynomial": PolynomialProof, "P of any sign": Dichotomy}.get(kind(proof), Proof)
    found: AnyProof | Dichotomy = _PROOFS[of].read(proof, **known)
    return found


def plant_content(plant: PWASystem) -> dict[str, Any]:
    """Return a plant by its cells."""
    exact, partition = plant.exact, plant.partition
    return _ports(plant) | {
        "cells": list(plant.cell_names),
        "H": [[text(v) for v in row] for row in partition.exact_H],
        "h": [text(v) for v in partition.exact_h],
        "signs": partition.signs.tolist(),
        **_FIELD.write(exact),
        "radius": _FIELD_RADII.write(exact) | _port_radii(exact),
    }


def corner_content(corner: Matrices) -> dict[str, Any]:
    """Return what is another in a plant at the corner of a box."""
    radius = _FIELD_RADII.write(corner) | {"B": corner.B.radius_texts}
    return _FIELD.write(corner) | {"B": corner.B.texts, "radius": radius}


def elements_content(plant: PWASystem) -> dict[str, Any]:
    """Return a plant as it was written: its cells are all combinations of segments."""
    assert plant.written is not None
    return _ports(plant) | {
        "A": plant.written.A.texts,
        "b": plant.written.b.texts,
        "elements": [
            TERM.write(one) | {"segments": [f"{one.name} {segment}" for segment in one.function.segments]}
            for one in plant.written.elements
        ],
        "radius": {"A": None, "b": None, **_port_radii(plant.exact)},
    }


def form_content(form: NormalForm, *, listed: bool) -> dict[str, Any]:
    """Return the form (11), of each cell where they are listed."""
    by_cell: dict[str, Any] = {"T": [form.exact.T[0].texts]}
    if listed:
        by_cell = {"T": [T.texts for T in form.exact.T], "A_eta": [X.texts for X in form.exact.A_eta]}
    return {
        "relative_degrees": list(form.degrees),
        "directions": form.exact.directions.texts,
        "scales": [text(Fraction(v)) for v in form.exact.scales],
        "internal": list(form.exact.internal),
        "eta": list(form.eta_names),
        **by_cell,
    }


def _ports(plant: PWASystem) -> dict[str, Any]:
    """Return what all ways of writing a plant have in common."""
    loads = plant.loads
    return {
        **_NAMES.write(plant),
        "tracked": list(plant.tracked_names),
        **_PORTS.write(plant.exact),
        "tracked_rows": plant.exact.tracked.texts,
        "loads": None if loads is None else _LOADS.write(loads) | {"radius": _LOAD_RADII.write(loads)},
    }


def _port_radii(exact: Matrices) -> dict[str, Any]:
    return {"B": exact.B.radius_texts, "C": exact.C.radius_texts, "tracked_rows": exact.tracked.radius_texts}
