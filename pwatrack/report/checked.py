"""What `check` says, for machines."""

from collections.abc import Sequence
from typing import Any

from pwatrack.control.applicability import Applicability
from pwatrack.errors import PwatrackError
from pwatrack.model.sizes import Sizes


def plant_json(
    name: str,
    report: Applicability,
    reference: str = "",
    sizes: Sizes | None = None,
    remarks: Sequence[str] = (),
) -> dict[str, Any]:
    """Return what `summary.print_plant` says; `reference` is null where it is refused."""
    plant, form = report.plant, report.form
    planes = [plant.hyperplane_text(k) for k in range(len(plant.partition.h))]
    values = report.zero_dynamics if report.zero_dynamics is not None else ()
    return {
        "name": name,
        "states": list(plant.states),
        "inputs": list(plant.inputs),
        "outputs": list(plant.outputs),
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
        "relative_degree": None if form is None else form.r,
        "eta": [] if form is None else list(form.eta_names),
        "zero_dynamics": {
            cell: [[float(v.real), float(v.imag)] for v in row]
            for cell, row in zip(plant.cell_names, values, strict=False)
        },
        "theorems": report.theorems(),
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
    """Return what `check` says: of the plant as far as it was read, and every problem in full."""
    plant = {} if report is None else plant_json(name, report, reference, sizes, remarks)
    problems = () if refusal is None else refusal.problems
    return plant | {"problems": [{"place": str(p.place or ""), "message": p.message, "hint": p.hint} for p in problems]}
