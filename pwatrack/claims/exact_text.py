"""What a certificate holds in exact numbers, written and read again: matrices, signals, a plant, its form (11)."""

from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from typing import Any

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
from pwatrack.model.loads import Loads
from pwatrack.model.nonlinearity import Nonlinearity, Number, PiecewiseLinear
from pwatrack.model.normal_form import NormalForm
from pwatrack.model.pwa import Matrices, PWASystem
from pwatrack.real import Real

_ROLES = {role.name: role for role in (PLANT, CONTROLLER, OBSERVER, GENERATOR)}
Held = StartEllipsoid | Region | ClockedRegion | PolynomialRegion  # what errors from some starts do not leave
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


def packed(X: Packed) -> dict[str, Any]:
    """Return a symmetric matrix as integers_jk 2^(exponents_j + exponents_k)."""
    return {"integers": [list(row) for row in X.integers], "exponents": list(X.exponents)}


def whole(found: Any) -> dict[str, Any]:
    """Return integers and exponents of what `packed` gave, as the classes of proofs take them."""
    integers = tuple(tuple(int(number(v)) for v in row) for row in found["integers"])
    return {"integers": integers, "exponents": tuple(found["exponents"])}


def knots(one: ClockedProof | ClockedRegion | Tube) -> dict[str, Any]:
    """Return the forms, and the diagonals, at the knots of a loop that is sampled."""
    name, forms = ("Q", one.Q) if isinstance(one, Tube) else ("P", one.P)
    return {name: [packed(form) for form in forms], "T": [[decimal(v) for v in row] for row in one.T]}


def read_knots(told: Any) -> dict[str, Any]:
    """Return what was written by `knots`, as the classes of proofs take it."""
    name = "Q" if "Q" in told else "P"
    forms = tuple(Packed(**whole(form)) for form in told[name])
    return {name: forms, "T": tuple(tuple(map(double, row)) for row in told["T"])}


def clocked_content(proof: ClockedProof) -> dict[str, Any]:
    """Return the forms that prove a loop that is sampled."""
    return {"rate": decimal(proof.rate)} | knots(proof)


def read_clocked(told: Any) -> ClockedProof:
    """Return what was written by `clocked_content`."""
    return ClockedProof(rate=double(told["rate"]), **read_knots(told))


def held_content(held: Held) -> dict[str, Any]:
    """Return what holds some starts."""
    if isinstance(held, ClockedRegion | PolynomialRegion):
        form = knots(held) if isinstance(held, ClockedRegion) else {"V": proof_content(held.proof)}
        return form | {"H": decimal_texts(held.H)}
    return {"Q": packed(held)} | ({"H": decimal_texts(held.H)} if isinstance(held, Region) else {})


def read_held(entry: Any) -> Held:
    """Return what was written by `held_content`, with weights of the starts, and sizes."""
    sizes = tuple(size for _, size in read_signals(entry["signals"]))
    known: dict[str, Any] = {"weights": tuple(map(double, entry["weights"])), "sizes": sizes}
    if "H" not in entry:
        return StartEllipsoid(**whole(entry["Q"]), **known)
    known["H"] = doubles(entry["H"])
    if "Q" in entry:
        return Region(**whole(entry["Q"]), **known)
    if "P" in entry:
        return ClockedRegion(**read_knots(entry), **known)
    proof = read_proof(entry["V"])
    assert isinstance(proof, PolynomialProof)
    return PolynomialRegion(proof=proof, **known)


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
            "Q": packed(part.ellipsoid),
            "signals": signals(zip(part.signals, part.ellipsoid.sizes, strict=True)),
        }
        for part in bounds.parts
    ]
    peaks = [
        {
            "part": part,
            "unit": gain.unit,
            "steps": [list(run) for run in gain.steps],
            "P": packed(gain),
            "size": decimal(gain.size),
        }
        for part, gain in bounds.proved.items()
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
    proved = {
        peak["part"]: PeakGain(
            unit=peak["unit"],
            steps=tuple((k, count) for k, count in peak["steps"]),
            size=double(peak["size"]),
            **whole(peak["P"]),
        )
        for peak in entry.get("peaks", [])
    }
    sizes = dict(read_signals(entry["signals"]))
    return Bounds(channel=read_channel(entry["channel"]), sizes=sizes, parts=parts, proved=proved)


def read_channel(channel: Any) -> Channel:
    """Return a channel that was written as a list."""
    return channel[0], channel[1]


def proof_content(proof: AnyProof | Dichotomy) -> dict[str, Any]:
    """Return the proof of an inequality."""
    P = packed(proof)
    if isinstance(proof, PolynomialProof):
        N = [packed(Packed(integers=N_i, exponents=proof.N_exponents)) for N_i in proof.N]
        told = {"degree": proof.degree, "rate": decimal(proof.rate)}
        return {"of": proof.role.name, **told, "T": decimal_texts(proof.T), "P": P, "N": N}
    if isinstance(proof, Dichotomy):
        return {"of": proof.role.name, "bounded": "both ways", "margin": decimal(proof.margin), "P": P}
    told = {"rate": decimal(proof.rate), "margin": decimal(proof.margin), "radius": decimal(proof.radius)}
    return {"of": proof.role.name, **told, "P": P}


def read_proof(proof: Any) -> AnyProof | Dichotomy:
    """Return what was written by `proof_content`."""
    role, P = _ROLES[proof["of"]], whole(proof["P"])
    if kind(proof) == "polynomial":
        each = [whole(N) for N in proof["N"]]
        return PolynomialProof(
            role=role,
            degree=int(proof["degree"]),
            rate=double(proof["rate"]),
            T=doubles(proof["T"]),
            N=tuple(N["integers"] for N in each),
            N_exponents=each[0]["exponents"],
            **P,
        )
    if kind(proof) == "P of any sign":
        return Dichotomy(role=role, margin=double(proof["margin"]), **P)
    rate, margin, radius = (double(proof[name]) for name in ("rate", "margin", "radius"))
    return Proof(role=role, rate=rate, margin=margin, radius=radius, **P)


def plant_content(plant: PWASystem) -> dict[str, Any]:
    """Return a plant by its cells."""
    exact, partition = plant.exact, plant.partition
    return _ports(plant) | {
        "cells": list(plant.cell_names),
        "H": [[text(v) for v in row] for row in partition.exact_H],
        "h": [text(v) for v in partition.exact_h],
        "signs": partition.signs.tolist(),
        "A": [X.texts for X in exact.A],
        "b": [X.texts for X in exact.b],
        "radius": {"A": radii(exact.A), "b": radii(exact.b), **_port_radii(exact)},
    }


def elements_content(plant: PWASystem) -> dict[str, Any]:
    """Return a plant as it was written: its cells are all combinations of segments."""
    assert plant.written is not None
    return _ports(plant) | {
        "A": plant.written.A.texts,
        "b": plant.written.b.texts,
        "elements": [
            term_content(one) | {"segments": [f"{one.name} {segment}" for segment in one.function.segments]}
            for one in plant.written.elements
        ],
        "radius": {"A": None, "b": None, **_port_radii(plant.exact)},
    }


def term_content(element: Nonlinearity) -> dict[str, Any]:
    """Return direction function(row x + constant)."""
    return {
        "row": [_centre(v) for v in element.row],
        "constant": _centre(element.constant),
        "direction": [_centre(v) for v in element.direction],
        "function": function_content(element.function),
    }


def function_content(function: PiecewiseLinear) -> dict[str, Any]:
    """Return a piecewise linear function."""
    return {
        "breakpoints": [_centre(v) for v in function.breakpoints],
        "slopes": [_centre(v) for v in function.slopes],
        "value": _centre(function.value),
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
    return {
        "states": list(plant.states),
        "inputs": list(plant.inputs),
        "outputs": list(plant.outputs),
        "tracked": list(plant.tracked_names),
        "B": plant.exact.B.texts,
        "C": plant.exact.C.texts,
        "tracked_rows": plant.exact.tracked.texts,
        "loads": None if plant.loads is None else _loads(plant.loads),
    }


def _port_radii(exact: Matrices) -> dict[str, Any]:
    return {"B": exact.B.radius_texts, "C": exact.C.radius_texts, "tracked_rows": exact.tracked.radius_texts}


def _loads(loads: Loads) -> dict[str, Any]:
    return {
        "names": list(loads.names),
        "where": list(loads.where),
        "E": loads.E.texts,
        "S": loads.S.texts,
        "radius": {"E": loads.E.radius_texts, "S": loads.S.radius_texts},
    }


def _centre(value: Number) -> str:
    return text(Real.of(value).centre)
