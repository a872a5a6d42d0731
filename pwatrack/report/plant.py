"""What `check` says of a plant, for people and for machines."""

from collections.abc import Callable, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from pwatrack.arrays import amount, complex_text
from pwatrack.control.applicability import Applicability
from pwatrack.errors import PwatrackError
from pwatrack.model.cells import Facet
from pwatrack.model.pwa import PWASystem
from pwatrack.model.sizes import Sizes
from pwatrack.report.terminal import remark_rows, titled
from pwatrack.report.wording import size_texts

_MOST_SHOWN = 20  # of cells or facets at the terminal
_FEW = 5  # of more than that


def print_plant(
    console: Console,
    name: str,
    report: Applicability,
    reference: str = "",
    sizes: Sizes | None = None,
    remarks: Sequence[str] = (),
) -> None:
    """Say what the plant is, which routes there are, what is known of the reference, and which sizes are in force.

    Of many cells, facets or signals only the first ones.
    """
    plant, form = report.plant, report.form
    facets = plant.partition.facets
    parts = {"state": plant.states, "input": plant.inputs, "output": plant.outputs, "cell": plant.cell_names}
    orders = ", ".join(amount(len(names), kind) for kind, names in parts.items())
    table = titled(name)
    table.add_row("plant (1)", f"{orders}; continuous across {amount(len(facets), 'facet')}")
    _some_rows(table, "cell", len(plant.cell_names), lambda i: _cell_text(report, i))
    _some_rows(table, "facet", len(facets), lambda k: _facet_text(plant, facets[k]))
    if form is not None:
        table.add_row(
            "form (11)",
            f"relative degree {form.degrees_text}, internal states η = {', '.join(form.eta_names) or 'none'}",
        )
    for route, answer in report.routes().items():
        table.add_row(route, answer)
    table.add_row("design takes", report.taken)
    if reference:
        table.add_row("reference", reference)
    for k, text in enumerate(size_texts(sizes, _MOST_SHOWN) if sizes else ()):
        table.add_row("" if k else "sizes", text)
    remark_rows(table, (*plant.remarks, *remarks))
    console.print(table)


def _some_rows(table: Table, kind: str, count: int, text: Callable[[int], str]) -> None:
    """Add a row for each of some things, or for the first of many."""
    shown = count if count <= _MOST_SHOWN else _FEW
    for k in range(shown):
        table.add_row(kind, text(k))
    if shown < count:
        table.add_row("", f"… and {count - shown:,} more {kind}s (--json lists all)")


def _cell_text(report: Applicability, i: int) -> str:
    name = report.plant.cell_names[i]
    values = () if report.zero_dynamics is None else report.zero_dynamics[i]
    return f"{name}: zero dynamics {', '.join(complex_text(complex(v)) for v in values)}" if len(values) else name


def _facet_text(plant: PWASystem, facet: Facet) -> str:
    return f"{plant.cell_names[facet.i]} | {plant.cell_names[facet.j]}, on {plant.hyperplane_text(facet.k)}"


def plant_json(
    name: str,
    report: Applicability,
    reference: str = "",
    sizes: Sizes | None = None,
    remarks: Sequence[str] = (),
) -> dict[str, Any]:
    """Return what `print_plant` says, for machines; `reference` is null where it is refused."""
    plant, form = report.plant, report.form
    planes = [plant.hyperplane_text(k) for k in range(len(plant.partition.h))]
    values = report.zero_dynamics if report.zero_dynamics is not None else ()
    return {
        "name": name,
        "states": list(plant.states),
        "inputs": list(plant.inputs),
        "outputs": list(plant.outputs),
        "tracked": list(plant.tracked_names),
        "cells": list(plant.cell_names),
        "facets": [
            {
                "cells": [plant.cell_names[facet.i], plant.cell_names[facet.j]],
                "hyperplane": planes[facet.k],
            }
            for facet in plant.partition.facets
        ],
        "continuous": True,
        "form_11": form is not None,
        "relative_degrees": None if form is None else list(form.degrees),
        "eta": [] if form is None else list(form.eta_names),
        "zero_dynamics": {
            cell: [[float(v.real), float(v.imag)] for v in row]
            for cell, row in zip(plant.cell_names, values, strict=False)
        },
        "routes": report.routes(),
        "design_takes": report.taken,
        "reference": reference or None,
        "sizes": sizes and {k: {"size": v, "from": sizes.origins[k]} for k, v in sizes.by_name.items()},
        "speed": sizes and sizes.speed,
        "remarks": [*plant.remarks, *remarks],
    }


def check_json(
    name: str,
    report: Applicability | None,
    reference: str,
    sizes: Sizes | None,
    refusal: PwatrackError | None,
    remarks: Sequence[str] = (),
) -> dict[str, Any]:
    """Return what `check` says, for machines: of the plant as far as it was read, and every problem in full."""
    plant = {} if report is None else plant_json(name, report, reference, sizes, remarks)
    problems = () if refusal is None else refusal.problems
    return plant | {"problems": [{"place": str(p.place or ""), "message": p.message, "hint": p.hint} for p in problems]}
