"""What `check` says first: whether a controller can be designed, what the plant is, and what is odd of it."""

import textwrap
from collections.abc import Iterator, Sequence

from pwatrack.arrays import amount
from pwatrack.control.applicability import Applicability
from pwatrack.control.controller import Row
from pwatrack.model.sizes import Sizes
from pwatrack.report.plant import size_texts
from pwatrack.report.screen import COLUMNS, LINES, fitted, joined
from pwatrack.report.terminal import visible
from pwatrack.simulation.modes import Mode, modes
from pwatrack.workflow.cautions import plant_warnings

_EXACT = {  # what a route is, by its name
    "Theorem 2": "state tracking, Theorem 2",
    "Theorem 3": "exact tracking, Theorem 3",
    "several outputs": "exact tracking of several outputs",
    "kinked derivative": "exact tracking with a kinked derivative",
    "preview": "exact tracking of a reference known beforehand",
}


def check_screen(
    name: str,
    report: Applicability,
    *,
    reference: str,
    sizes: Sizes | None,
    remarks: Sequence[str],
    refused: bool,
) -> list[str]:
    """Return what `check` says first: whether a controller can be designed, what the plant is and what is odd of it."""
    reference, _, why_not = reference.partition("; exact tracking is refused: ")
    said = can_be_designed(report, why_not, refused=refused)
    first = textwrap.wrap(visible(said), COLUMNS, max_lines=3, placeholder=" …")
    rows = [*plant_rows(report, name), *([("reference", reference)] if reference else [])]
    rows += [("sizes", f"what counts as 1: {size_texts(sizes)[0].removeprefix('sizes: ')}")] if sizes else []
    rows += [("remark", remark) for remark in (*report.plant.remarks, *remarks)]
    return [*first, *fitted(joined(rows), LINES - len(first))]


def plant_rows(report: Applicability, name: str) -> Iterator[Row]:
    """Yield what a plant is, what is odd of it, and the modes of each different cell."""
    plant, form, alike = report.plant, report.form, dict[bytes, int]()
    parts = {"state": plant.states, "input": plant.inputs, "output": plant.outputs, "cell": plant.cell_names}
    orders = ", ".join(amount(len(names), kind) for kind, names in parts.items())
    internal = "" if form is None else f", internal states {', '.join(form.eta_names) or 'none'}"
    degree = "" if form is None else f"; relative degree {form.degrees_text}{internal}"
    yield "plant", f"{orders}{degree} ({name})" if name else f"{orders}{degree}"
    yield from (("warning", text) for text in plant_warnings(plant))
    for i, A in enumerate(plant.A):
        alike.setdefault(A.tobytes(), i)
    yield from (("open loop", f"{plant.cell_names[i]}: {mode_text(modes(plant.A[i]))}") for i in alike.values())


def can_be_designed(report: Applicability, why_not: str, *, refused: bool) -> str:
    """Say whether a controller can be designed, by which route; why not is said by the refusal itself."""
    if refused or not report.open:
        return "No controller can be designed as it stands: the error says why, and what helps"
    answers = dict(report.answers)
    first = report.open[0]
    needs = answers[first]
    said = f"A controller can be designed: {_EXACT.get(first.name, first.name)}, as far as is known until design "
    said += f"solves the paper's {needs.reason}"
    if first.name in _EXACT:
        return said
    exact = why_not or next(answers[route].reason for route in answers if report.tracking in route.takes)
    return f"{said}. Not exact tracking: {exact}"


def mode_text(found: Sequence[Mode]) -> str:
    """Return modes with frequency, damping and time constant τ, the slowest first.

    Example:
        >>> import numpy as np
        >>> mode_text(modes(np.array([[0.0, 1.0], [-4.0, -0.4]]))), mode_text(modes(np.array([[0.0]])))
        ('2 rad/s damped 0.1 (τ 5 s)', 'integrates')
    """
    return ", ".join(
        "integrates"
        if not mode.frequency
        else f"runs away (τ {-mode.time_constant:.3g} s)"
        if mode.time_constant < 0
        else f"τ {mode.time_constant:.3g} s"
        if mode.damping == 1
        else f"{mode.frequency:.3g} rad/s damped {mode.damping:.2g} (τ {mode.time_constant:.3g} s)"
        for mode in found
    )
