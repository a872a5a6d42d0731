"""What `check` says first: whether a controller can be designed, what the plant is, and what is odd of it."""

import textwrap
from collections.abc import Iterator, Mapping, Sequence

from pwatrack.control.applicability import Applicability
from pwatrack.control.controller import Row
from pwatrack.model.sizes import Sizes
from pwatrack.report.plant import mode_text, orders
from pwatrack.report.screen import COLUMNS, LINES, fitted, joined
from pwatrack.report.terminal import visible
from pwatrack.simulation.modes import modes
from pwatrack.workflow.cautions import plant_questions

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
    units: Mapping[str, str],
    remarks: Sequence[str],
    refused: bool,
) -> list[str]:
    """Return what `check` says first: whether a controller can be designed, what the plant is and what is odd of it."""
    reference, _, why_not = reference.partition("; exact tracking is refused: ")
    said = can_be_designed(report, why_not, refused=refused)
    first = textwrap.wrap(visible(said), COLUMNS, max_lines=3, placeholder=" …")
    rows = [*plant_rows(report, name), *([("reference", f"checked: {reference}")] if reference else [])]
    if sizes:
        each = (
            f"{name} {size:.4g} {units.get(name, '')}".rstrip() + " (given)" * (sizes.origins[name] == "given")
            for name, size in sizes.by_name.items()
        )
        rows.append(("sizes", f"what counts as 1: {'; '.join(each)}"))
    rows += [("remark", remark) for remark in (*report.plant.remarks, *remarks)]
    return [*first, *fitted(joined(rows), LINES - len(first))]


def plant_rows(report: Applicability, name: str) -> Iterator[Row]:
    """Yield what a plant is, what is odd of it, and the modes of each different cell, without a controller."""
    plant, form, alike = report.plant, report.form, dict[bytes, list[int]]()
    said = [orders(plant), f"tracks {', '.join(plant.tracked_names)}, measures {', '.join(plant.outputs)}"]
    if form is not None and report.zero_dynamics is not None:
        stable = "stable in each cell" if (report.zero_dynamics.real < 0).all() else "not stable in some cell"
        internal = f"internal states {', '.join(form.eta_names)}, {stable}" if form.eta_names else "no internal states"
        said += [f"relative degree {form.degrees_text}", internal]
    yield "plant", "; ".join([*said, name])
    yield from (("question", text) for text in plant_questions(plant))
    for i, A in enumerate(plant.A):
        alike.setdefault(A.tobytes(), []).append(i)
    for first, *others in alike.values():
        like = f" (and {len(others)} like it)" * bool(others)
        yield "open loop", f"{plant.cell_names[first]}{like}: {mode_text(modes(plant.A[first]))}"


def can_be_designed(report: Applicability, why_not: str, *, refused: bool) -> str:
    """Say whether a controller can be designed, by which route; why not is said by the refusal itself."""
    if refused or not report.open:
        return "No controller can be designed as it stands: the error says why, and what helps"
    answers = dict(report.answers)
    first = report.open[0]
    said = f"A controller can be designed: {_EXACT.get(first.name, first.name)}, unless 'design' finds no solution of "
    said += f"the paper's {answers[first].needed(', or no ')}"
    if first.name in _EXACT:
        return said
    exact = why_not or next(answers[route].reason for route in answers if report.tracking in route.takes)
    return f"{said}. Not exact tracking: {exact}"
