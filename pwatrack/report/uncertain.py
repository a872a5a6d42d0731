"""What is said of uncertain parameters: what is proved for all of their box, and what a run shows of it."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from pwatrack.arrays import up
from pwatrack.control.bounds import Form
from pwatrack.control.controller import Controller
from pwatrack.control.robust import Robust
from pwatrack.report.bounds import cause, limit_texts
from pwatrack.report.wording import down, signal_text, sized
from pwatrack.spec.spec import Spec
from pwatrack.study.bands import covered
from pwatrack.study.largest_box import LargestBox
from pwatrack.study.result import Result


def robust_content(spec: Spec, robust: Robust) -> dict[str, Any]:
    """Return what run.json says of uncertain parameters: their intervals; bounds.json has those of signals."""
    box = {interval.name: [float(interval.low), float(interval.high)] for interval in spec.objectives.uncertain}
    return {"parameters": box, "inequalities": robust.count, "rate": robust.rate}


def box_figures(result: Result, robust: Robust) -> dict[str, dict[str, float]]:
    """Return what a box of parameters can do along the x_d of a run, and what was seen of it.

    Returns:
        For each signal, by name: `bound`, what is proved of it in the end, and `seen`, its largest size at the samples
        of the last tenth of the run.
    """
    seen, largest = dict[Form, float](), np.zeros(len(result.controller.plant.B))
    late = 0.9 * result.end
    for block in result.blocks():
        largest = np.maximum(largest, robust.deviations(block.x_d, block.u_ff).max(axis=0))
        last, errors = block.t >= late, {"output": block.tracking_error, "state": block.x - block.x_d}
        errors["input"] = block.u - block.u_ff
        for kind, k in robust.bounds[0].sizes:
            size = float(np.abs(errors[kind][last, k]).max(initial=0.0))
            seen[kind, k] = max(size, seen.get((kind, k), 0.0))
    reached = robust.reached(largest)
    return {signal_text(result.spec, s)[0]: {"bound": size, "seen": seen[s]} for s, size in reached.items()}


def largest_content(largest: LargestBox) -> dict[str, Any]:
    """Return what run.json says of how far a box can be scaled."""
    box = {interval.name: [float(interval.low), float(interval.high)] for interval in largest.box}
    return {"factor": largest.factor, "beyond": largest.beyond, "parameters": box}


def largest_text(largest: LargestBox) -> str:
    """Say how far a box can be scaled."""
    box = ", ".join(interval.text for interval in largest.box)
    end = "" if largest.beyond is None else f"; scaled by {largest.beyond:g} no proof was found"
    return f"proved for the box scaled by {largest.factor:g}: {box}{end}"


def box_rows(spec: Spec, controller: Controller) -> Iterator[str]:
    """Yield what is proved for all of a box."""
    robust = controller.robust
    if robust is None:
        return
    box = ", ".join(interval.text for interval in spec.objectives.uncertain)
    order = 2 * len(controller.plant.B)
    yield (
        f"for every plant with {box}, also where they change with time: {robust.count} inequalities of order {order} "
        f"proved; errors go to their bounds at least as fast as e^(−{down(robust.rate)} t)"
    )
    yield "w = f_p(x_d) − f(x_d) + (B_p − B) u_ff, f_p and B_p of that plant: what its entries leave in the end adds up"
    for bounds in robust.bounds:
        _, on, unit = cause(spec, bounds.channel, uncertain=True)
        yield f"{', '.join(limit_texts(spec, bounds.sizes.items()))} per {unit or '1'} of {on}"


def run_rows(result: Result) -> Iterator[str]:
    """Yield what a box can do along the x_d of a run, and what was seen of it where the run is one of the box."""
    robust = result.controller.robust
    if robust is None:
        return
    found = box_figures(result, robust)
    units = dict(signal_text(result.spec, signal) for signal in robust.bounds[0].sizes)
    shown = ((name, f" {units[name]}".rstrip(), figures) for name, figures in found.items())
    while_small = "in the end, as long as w is no larger than along this x_d"
    if covered(result.spec.objectives.uncertain, result.loop.conditions):
        texts = [f"{sized(name)} ≤ {up(f['bound'])}{unit}, here {f['seen']:.3g}{unit}" for name, unit, f in shown]
        yield f"the plant of this run is one of them; {while_small}, and in the last tenth here: {'; '.join(texts)}"
    else:
        texts = [f"{sized(name)} ≤ {up(f['bound'])}{unit}" for name, unit, f in shown]
        yield f"this run is not one of them; {while_small}: {', '.join(texts)}"
