"""What is said of uncertain parameters: what is proved for all of their box, and what a run shows of it."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from pwatrack.arrays import up
from pwatrack.claims.robust import Robust
from pwatrack.control.bounds import Form
from pwatrack.control.words import sized
from pwatrack.simulation.propagate import sample_count
from pwatrack.simulation.trace import tenths
from pwatrack.workflow.bands import covered
from pwatrack.workflow.largest_box import LargestBox
from pwatrack.workflow.result import SimulatedLoop


def since(result: SimulatedLoop) -> tuple[int, float]:
    """Return from which tenth of a run on, and from which time in s, w is what it is taken for in the end.

    It is the last tenth, or as many as hold a period of the reference.
    """
    period, duration = result.controller.trajectory.exosystem.period or 0.0, result.spec.scenario.duration
    step = result.spec.scenario.sample_time
    starts = np.array(tenths(sample_count(duration, step))[:-1]) * step
    first = int(np.searchsorted(starts, min(starts[-1], result.end - period), side="right")) - 1
    return max(first, 0), float(starts[max(first, 0)])


def box_figures(result: SimulatedLoop, robust: Robust) -> dict[str, dict[str, float]]:
    """Return what a box of parameters can do along the x_d of a run, and what was seen of it.

    Returns:
        For each signal, by name: `bound`, what is proved of it in the end for a w as large as it is in the run from the
        time of `since` on, and for what is played back, and `seen`, its largest size at the samples of its last tenth.
    """
    assert result.w is not None
    seen, late = dict[Form, float](), 0.9 * result.end
    for block in result.blocks():
        last, errors = block.t >= late, {"output": block.tracking_error, "state": block.x - block.x_d}
        errors["input"] = block.u - block.u_ff
        for kind, k in robust.bounds[0].sizes:
            size = float(np.abs(errors[kind][last, k]).max(initial=0.0))
            seen[kind, k] = max(size, seen.get((kind, k), 0.0))
    reached = robust.reached(result.w[since(result)[0] :].max(axis=0))
    bound, words = result.controller.with_left(reached), result.spec.words
    return {words.signal(form)[0]: {"bound": bound[form], "seen": seen[form]} for form in bound}


def largest_content(largest: LargestBox) -> dict[str, Any]:
    """Return what run.json says of how far a box can be scaled."""
    box = {interval.name: [float(interval.low), float(interval.high)] for interval in largest.box}
    return {"factor": largest.factor, "beyond": largest.beyond, "parameters": box}


def largest_text(largest: LargestBox) -> str:
    """Say how far a box can be scaled."""
    box = ", ".join(interval.text for interval in largest.box)
    end = "" if largest.beyond is None else f"; scaled by {largest.beyond:g} no proof was found"
    return f"proved for the box scaled by {largest.factor:g}: {box}{end}"


def run_rows(result: SimulatedLoop) -> Iterator[str]:
    """Yield what a box can do along the x_d of a run, and what was seen of it where the run is one of the box."""
    for robust in result.controller.claims_of(Robust):
        if result.w is None:
            yield "how large w is along the x_d of this run took too long to enclose: of this run nothing is said"
        else:
            yield _along_text(result, robust)


def _along_text(result: SimulatedLoop, robust: Robust) -> str:
    found = box_figures(result, robust)
    units = dict(result.spec.words.signal(form) for form in robust.bounds[0].sizes)
    shown = ((name, f" {units[name]}".rstrip(), figures) for name, figures in found.items())
    start = since(result)[1]
    window = f" from t = {start:.6g} s on" if start else ""
    while_small = f"in the end, as long as w is no larger than in this run{window}"
    if covered(result.spec.objectives.uncertain, result.loop.conditions):
        texts = []
        for name, unit, f in shown:
            late = ", not yet" if f["seen"] > f["bound"] else ""
            texts.append(f"{sized(name)} ≤ {up(f['bound'])}{unit}, here {f['seen']:.3g}{unit}{late}")
        here = f"and at the samples of the last tenth here: {'; '.join(texts)}"
        return f"the plant of this run is one of them; {while_small}, {here}"
    texts = [f"{sized(name)} ≤ {up(f['bound'])}{unit}" for name, unit, f in shown]
    return f"this run is not one of them; {while_small}: {', '.join(texts)}"
