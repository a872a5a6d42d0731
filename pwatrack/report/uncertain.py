"""What is said of uncertain parameters: what is proved for all of their box, and what a run shows of it."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from pwatrack.arrays import OVER_SUMS, up
from pwatrack.control.bounds import Form
from pwatrack.control.controller import Controller
from pwatrack.control.robust import Robust
from pwatrack.report.bounds import cause, limit_texts
from pwatrack.report.wording import down, signal_text, sized
from pwatrack.simulation.propagate import sample_count
from pwatrack.simulation.trace import tenths
from pwatrack.spec.spec import Spec
from pwatrack.study.bands import covered
from pwatrack.study.largest_box import LargestBox
from pwatrack.study.result import Result


def robust_content(spec: Spec, robust: Robust) -> dict[str, Any]:
    """Return what run.json says of uncertain parameters: their intervals; bounds.json has those of signals."""
    box = {interval.name: [float(interval.low), float(interval.high)] for interval in spec.objectives.uncertain}
    return {"parameters": box, "inequalities": robust.count, "rate": robust.rate}


def since(result: Result) -> tuple[int, float]:
    """Return from which tenth of a run on, and from which time in s, w is what it is taken for in the end.

    It is the last tenth, or as many as hold a period of the reference.
    """
    period, duration = result.controller.trajectory.exosystem.period or 0.0, result.spec.scenario.duration
    step = result.spec.scenario.sample_time
    starts = np.array(tenths(sample_count(duration, step))[:-1]) * step
    first = int(np.searchsorted(starts, min(starts[-1], result.end - period), side="right")) - 1
    return max(first, 0), float(starts[max(first, 0)])


def box_figures(result: Result, robust: Robust) -> dict[str, dict[str, float]]:
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
    left = result.controller.left_by_signal
    bound = {s: (size + left.get(s, 0.0)) * OVER_SUMS for s, size in reached.items()}
    return {signal_text(result.spec, s)[0]: {"bound": bound[s], "seen": seen[s]} for s in reached}


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
    said = (
        "w = f_p(x_d) − f(x_d) + (B_p − B) u_ff, f_p and B_p of that plant: what its entries leave in the end adds up"
    )
    if controller.trajectory.preview is not None:
        left = limit_texts(spec, ((s, controller.left_by_signal[s]) for s in robust.bounds[0].sizes))
        said += f", beside what is played back: {', '.join(left)} for all of them"
    yield said
    for bounds in robust.bounds:
        _, on, unit = cause(spec, bounds.channel, uncertain=True)
        yield f"{', '.join(limit_texts(spec, bounds.sizes.items()))} per {unit or '1'} of {on}"


def run_rows(result: Result) -> Iterator[str]:
    """Yield what a box can do along the x_d of a run, and what was seen of it where the run is one of the box."""
    robust = result.controller.robust
    if robust is None:
        return
    if result.w is None:
        yield "how large w is along the x_d of this run took too long to enclose: of this run nothing is said"
        return
    found = box_figures(result, robust)
    units = dict(signal_text(result.spec, signal) for signal in robust.bounds[0].sizes)
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
        yield f"the plant of this run is one of them; {while_small}, {here}"
    else:
        texts = [f"{sized(name)} ≤ {up(f['bound'])}{unit}" for name, unit, f in shown]
        yield f"this run is not one of them; {while_small}: {', '.join(texts)}"
