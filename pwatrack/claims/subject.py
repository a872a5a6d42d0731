"""What a certificate speaks of, in exact numbers: a plant, by its cells or by its elements, and its form (11)."""

from fractions import Fraction
from typing import Any

from pwatrack.ball_matrix import text
from pwatrack.claims.exact_text import radii
from pwatrack.model.loads import Loads
from pwatrack.model.nonlinearity import Nonlinearity, Number, PiecewiseLinear
from pwatrack.model.normal_form import NormalForm
from pwatrack.model.pwa import Matrices, PWASystem
from pwatrack.real import Real


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
            {
                **term_content(element),
                "segments": [f"{element.name} {segment}" for segment in element.function.segments],
            }
            for element in plant.written.elements
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
    return {
        "B": exact.B.radius_texts,
        "C": exact.C.radius_texts,
        "tracked_rows": exact.tracked.radius_texts,
    }


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
