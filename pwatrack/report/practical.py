"""What is said of practical tracking: what is merged, why, and below what each signal ends."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from pwatrack.arrays import number_text, up
from pwatrack.control.controller import Controller
from pwatrack.control.practical import Practical
from pwatrack.model.merging import Merge
from pwatrack.model.pwa import linear_form_text
from pwatrack.report.bounds import cause, limit_texts
from pwatrack.report.wording import signal_text, sized
from pwatrack.spec.spec import Spec

_SHOWN = 8  # signals beside what is tracked
Row = tuple[str, str]


def practical_rows(spec: Spec, controller: Controller) -> Iterator[Row]:
    """Yield what is proved of a loop with merged cells, the bound of what is tracked first."""
    practical = controller.practical
    if practical is None:
        return
    tracked, final = controller.tracking, practical.final
    ends = list[str]()
    for signal in (form for form in final if form[0] == tracked):
        name, unit = signal_text(spec, signal)
        larger = ", larger than the reference" if signal in practical.beyond else ""
        ends.append(f"{sized(name)} {'' if ends else 'ends '}below {up(final[signal])} {unit}".rstrip() + larger)
    yield "practical tracking", f"{', '.join(ends)}, proved for every start; {_all_texts(spec, practical)}"
    for problem in practical.replaced:
        yield "exact tracking", f"refused: {problem.short or problem.message}"
    for merge in practical.merges:
        yield "merged", _merge_text(spec, merge)
    others = [(form, size) for form, size in final.items() if form[0] not in (tracked, "estimate")]
    if others:
        yield "", f"also in the end: {', '.join(limit_texts(spec, others[:_SHOWN]))}"
    cells = len(controller.plant.model.cell_names)
    if controller.plant.watched is not None:
        yield "", f"the observer runs all {cells} cells of the plant, and its error goes to 0"
    else:
        estimates = [(form, size) for form, size in final.items() if form[0] == "estimate"]
        yield (
            "",
            f"the observer runs the merged cells too: {', '.join(limit_texts(spec, estimates[:_SHOWN]))} in the end",
        )


def practical_content(spec: Spec, practical: Practical, *, watched: bool) -> dict[str, Any]:
    """Return what run.json says of practical tracking."""
    return {
        "exact_tracking": [problem.message for problem in practical.replaced],
        "merged": [
            {
                "name": merge.nonlinearity.name,
                "of": _form_text(spec, merge),
                "from": float(merge.nonlinearity.function.breakpoints[merge.first]),
                "to": float(merge.nonlinearity.function.breakpoints[merge.last]),
                "unit": _unit(spec, merge),
                "largest": float(merge.largest),
                "deviates_by": {cause(spec, ("disturbance", j))[1]: size for j, size in _deviations(merge).items()},
            }
            for merge in practical.merges
        ],
        "observer_runs": "all cells" if watched else "merged cells",
        "ends_below": {
            name: {"bound": size, "unit": unit}
            for (name, unit), size in ((signal_text(spec, form), size) for form, size in practical.final.items())
        },
        "per_deviation": [
            {signal_text(spec, form)[0]: size for form, size in bounds.sizes.items()} for bounds in practical.bounds
        ],
    }


def _all_texts(spec: Spec, practical: Practical) -> str:
    """Say how wide all is that was merged."""
    return ", ".join(_width_text(spec, merge) for merge in practical.merges)


def _width_text(spec: Spec, merge: Merge) -> str:
    """Say between which values an element was merged."""
    marks, unit = merge.nonlinearity.function.breakpoints, _unit(spec, merge)
    low, high = float(marks[merge.first]), float(marks[merge.last])
    if low == -high:
        return f"the {merge.nonlinearity.name} is ±{number_text(high, '.6g')} {unit}".rstrip()
    between = f"from {number_text(low, '.6g')} to {number_text(high, '.6g')} {unit}".rstrip()
    return f"the {merge.nonlinearity.name} is merged {between}"


def _merge_text(spec: Spec, merge: Merge) -> str:
    """Say what becomes of an element, and by how much the plant then deviates at most."""
    slopes = merge.function.slopes
    straight = slopes[0].centre == slopes[-1].centre and len(slopes) == 2
    count = merge.last - merge.first + 1
    became = "one line" if straight else f"with {count} corners fewer" if _gone(merge) == count else "with one corner"
    parts = []
    for j, size in _deviations(merge).items():
        _, on, unit = cause(spec, ("disturbance", j))
        parts.append(f"{up(size)} {unit} on {on}".replace("  ", " "))
    return (
        f"{merge.nonlinearity.name}, of {_form_text(spec, merge)}, {became}: it deviates by at most {', '.join(parts)}"
    )


def _gone(merge: Merge) -> int:
    return len(merge.nonlinearity.function.breakpoints) - len(merge.function.breakpoints)


def _deviations(merge: Merge) -> dict[int, float]:
    """Return by how much each state equation deviates at most, where it does."""
    column = np.abs(merge.column.floats[:, 0])
    return {int(j): float(column[j]) * float(merge.largest) for j in np.flatnonzero(column)}


def _form_text(spec: Spec, merge: Merge) -> str:
    row = np.array([float(v) for v in merge.nonlinearity.row])
    return linear_form_text(row, spec.problem.plant.states)


def _unit(spec: Spec, merge: Merge) -> str:
    """Return the unit of what an element looks at, where all states in it have the same and count once."""
    row = [float(v) for v in merge.nonlinearity.row]
    names = [name for name, v in zip(spec.problem.plant.states, row, strict=True) if v]
    units = {spec.problem.units.get(name, "") for name in names}
    return units.pop() if len(units) == 1 and all(abs(v) in (0.0, 1.0) for v in row) else ""
