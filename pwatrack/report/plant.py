"""What `check` says of a plant, for people and for machines."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from rich.console import Console

from pwatrack.arrays import amount, complex_text
from pwatrack.control.applicability import Applicability
from pwatrack.control.controller import Row
from pwatrack.errors import PwatrackError
from pwatrack.model.pwa import PWASystem
from pwatrack.model.sizes import Sizes
from pwatrack.report.terminal import print_rows
from pwatrack.simulation.modes import Mode, modes

_MOST_SHOWN = 20  # of cells or facets at the terminal
_FEW = 5  # of more than that


def print_plant(
    console: Console, name: str, report: Applicability, reference: str, sizes: Sizes | None, remarks: Sequence[str] = ()
) -> None:
    """Say what the plant is, its routes, the reference and the sizes in force; of many cells or signals a few."""
    print_rows(console, name, _plant_rows(report, reference, sizes, remarks))


def _plant_rows(report: Applicability, reference: str, sizes: Sizes | None, remarks: Sequence[str]) -> Iterator[Row]:
    plant, form, cells, facets = report.plant, report.form, report.plant.cell_names, report.plant.partition.facets
    yield "plant (1)", f"{orders(plant)}; continuous across {amount(len(facets), 'facet')}"
    zeros = [()] * len(cells) if report.zero_dynamics is None else report.zero_dynamics
    said = (", ".join(complex_text(complex(v)) for v in row) for row in zeros)
    alone = (f"{name}: {mode_text(modes(A))}" for name, A in zip(cells, plant.A, strict=True))
    each = [f"{text}; zero dynamics {zero}" if zero else text for text, zero in zip(alone, said, strict=True)]
    yield from _some_rows("cell", each, str)
    yield from _some_rows("facet", facets, lambda f: f"{cells[f.i]} | {cells[f.j]}, on {plant.hyperplane_text(f.k)}")
    if form is not None:
        internal = ", ".join(form.eta_names) or "none"
        yield "form (11)", f"relative degree {form.degrees_text}, internal states η = {internal}"
    yield from report.routes().items()
    yield "design takes", report.taken
    if reference:
        yield "reference", reference
    for k, text in enumerate(size_texts(sizes) if sizes else ()):
        yield "" if k else "sizes", text
    yield from (("remark", remark) for remark in (*plant.remarks, *remarks))


def orders(plant: PWASystem) -> str:
    """Say how many states, inputs, outputs and cells a plant has."""
    parts = {"state": plant.states, "input": plant.inputs, "output": plant.outputs, "cell": plant.cell_names}
    return ", ".join(amount(len(names), kind) for kind, names in parts.items())


def _some_rows(kind: str, things: Sequence[Any], text: Callable[[Any], str]) -> Iterator[Row]:
    """Yield a row for each of some things, or for the first of many."""
    shown = things if len(things) <= _MOST_SHOWN else things[:_FEW]
    yield from ((kind, text(each)) for each in shown)
    if len(shown) < len(things):
        yield "", f"… and {len(things) - len(shown):,} more {kind}s (--json lists all)"


def mode_text(found: Sequence[Mode]) -> str:
    """Return modes with frequency, damping and time constant τ, the slowest first.

    Example:
        >>> import numpy as np
        >>> mode_text(modes(np.array([[0.0, 1.0], [-4.0, -0.4]]))), mode_text(modes(np.array([[0.0]])))
        ('2 rad/s damped 0.1 (τ 5 s)', 'integrates')
    """
    return "; ".join(
        "integrates"
        if not mode.frequency
        else f"runs away (τ {-mode.time_constant:.3g} s)"
        if mode.time_constant < 0
        else f"τ {mode.time_constant:.3g} s"
        if mode.damping == 1
        else f"{mode.frequency:.3g} rad/s undamped"
        if not mode.damping
        else f"{mode.frequency:.3g} rad/s damped {mode.damping:.2g} (τ {mode.time_constant:.3g} s)"
        for mode in found
    )


def check_json(
    name: str,
    report: Applicability | None,
    reference: str,
    sizes: Sizes | None,
    refusal: PwatrackError | None,
    remarks: Sequence[str],
) -> dict[str, Any]:
    """Return what `check` says, for machines: of the plant as far as it was read, and every problem in full."""
    problems = () if refusal is None else refusal.problems
    told = {"problems": [{"place": str(p.place or ""), "message": p.message, "hint": p.hint} for p in problems]}
    if report is None:
        return told
    plant, form = report.plant, report.form
    cells, planes = plant.cell_names, [plant.hyperplane_text(k) for k in range(len(plant.partition.h))]
    values = report.zero_dynamics if report.zero_dynamics is not None else ()
    return {
        "name": name,
        "states": list(plant.states),
        "inputs": list(plant.inputs),
        "outputs": list(plant.outputs),
        "tracked": list(plant.tracked_names),
        "cells": list(cells),
        "facets": [
            {"cells": [cells[facet.i], cells[facet.j]], "hyperplane": planes[facet.k]}
            for facet in plant.partition.facets
        ],
        "continuous": True,
        "form_11": form is not None,
        "relative_degrees": None if form is None else list(form.degrees),
        "eta": [] if form is None else list(form.eta_names),
        "zero_dynamics": {
            cell: [[float(v.real), float(v.imag)] for v in row] for cell, row in zip(cells, values, strict=False)
        },
        "routes": report.routes(),
        "design_takes": report.taken,
        "reference": reference or None,
        "sizes": sizes and {k: {"size": v, "from": sizes.origins[k]} for k, v in sizes.by_name.items()},
        "speed": sizes and sizes.speed,
        "remarks": [*plant.remarks, *remarks],
        **told,
    }


def size_texts(sizes: Sizes) -> list[str]:
    """Return the sizes as a file would give them, of many the first, and where they are from.

    Example:
        >>> from pwatrack import load_spec
        >>> from pwatrack.workflow.sizing import spec_sizes
        >>> size_texts(spec_sizes(load_spec("specs/gallery/two_rooms.yaml")))[1]
        'balanced: T1, T2, y1, y2; reference: u1, u2; speed 0.001449 1/s'
    """
    known = sizes.by_name
    shown = list(known)[:_MOST_SHOWN]
    said = [f"sizes: {{{', '.join(f'{name}: {known[name]:.4g}' for name in shown)}}}"]
    if len(known) > len(shown):
        said.append(f"… and {len(known) - len(shown)} more sizes (--json lists all)")
    origins = dict.fromkeys(sizes.origins[name] for name in shown)
    groups = [f"{origin}: {', '.join(n for n in shown if sizes.origins[n] == origin)}" for origin in origins]
    return [*said, f"{'; '.join(groups)}; speed {sizes.speed:.4g} 1/s"]
