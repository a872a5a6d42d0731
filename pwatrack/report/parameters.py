"""What is said of parameters: of a box of uncertain ones, and of values with which what was refused is proved."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from pwatrack.arrays import up
from pwatrack.claims.robust import Robust
from pwatrack.control.bounds import Form
from pwatrack.control.words import sized
from pwatrack.real import inside
from pwatrack.simulation.propagate import sample_count
from pwatrack.simulation.trace import tenths
from pwatrack.workflow.bands import covered
from pwatrack.workflow.how_far import HowFar, LargestBox, Proved
from pwatrack.workflow.outcome import SimulatedLoop


def _since(result: SimulatedLoop) -> tuple[int, float]:
    """Return the tenth of a run, and the time in s, from which on a whole period, or the last tenth, is left."""
    period, duration = result.controller.trajectory.exosystem.period or 0.0, result.spec.scenario.duration
    step = result.spec.scenario.sample_time
    starts = np.array(tenths(sample_count(duration, step))[:-1]) * step
    first = int(np.searchsorted(starts, min(starts[-1], result.end - period), side="right")) - 1
    return max(first, 0), float(starts[max(first, 0)])


def box_figures(result: SimulatedLoop, robust: Robust) -> dict[str, dict[str, float]]:
    """Return what a box can do along the x_d of a run, and what was seen of it, for each signal by name.

    `bound` is proved of it in the end for a w as large as in the run from the time of `_since` on, with what is played
    back, and `seen` its largest size at the samples of its last tenth.
    """
    assert result.w is not None
    seen, late = dict[Form, float](), 0.9 * result.end
    for block in result.blocks():
        last, errors = block.t >= late, {"output": block.tracking_error, "state": block.x - block.x_d}
        errors["input"] = block.u - block.u_ff
        for kind, k in robust.bounds[0].sizes:
            size = float(np.abs(errors[kind][last, k]).max(initial=0.0))
            seen[kind, k] = max(size, seen.get((kind, k), 0.0))
    reached = robust.reached(result.w[_since(result)[0] :].max(axis=0))
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
    units = dict(result.spec.words.signal(form) for form in robust.bounds[0].sizes)
    start = _since(result)[1]
    window = f" from t = {start:.6g} s on" if start else ""
    while_small = f"in the end, as long as w is no larger than in this run{window}"
    box, conditions, texts = result.spec.objectives.uncertain, result.loop.conditions, list[str]()
    covered_here = covered(box, conditions)
    for name, found in box_figures(result, robust).items():
        unit, late = f" {units[name]}".rstrip(), ", not yet" if found["seen"] > found["bound"] else ""
        here = f", here {found['seen']:.3g}{unit}{late}" if covered_here else ""
        texts.append(f"{sized(name)} ≤ {up(found['bound'])}{unit}{here}")
    if covered_here:
        here = f"and at the samples of the last tenth here: {'; '.join(texts)}"
        return f"the plant of this run is one of them; {while_small}, {here}"
    which = "this run is not one of them"
    if inside(box, conditions.parameters or {}):
        which = "the plant of this run is one of them, its loop is not the ideal one"
    return f"{which}; of the ideal loop, {while_small}: {', '.join(texts)}"


def how_far_texts(found: HowFar) -> list[str]:
    """Say how far away a refused inequality is, in sentences.

    Example:
        >>> near = Proved(parameter="k2", now=1.2, value=0.68998, degree=2)
        >>> how_far_texts(HowFar(claim="(17)", parameters=(near,), rate=None, asked=0.0))
        ['(17) is proved with k2 = 0.68998 (now 1.2)']
        >>> how_far_texts(HowFar(claim="(8)", parameters=(), rate=0.24, asked=0.3))[0]
        '(8) is proved at a rate of 0.24 1/s (asked: 0.3 1/s)'
    """
    said = []
    if found.asked:
        slower = "at no slower rate that was tried" if found.rate is None else f"at a rate of {found.rate:g} 1/s"
        said.append(f"{found.claim} is proved {slower} (asked: {found.asked:g} 1/s)")
    quadratic = [p for p in found.parameters if p.degree == 2]
    if quadratic:
        said.append(f"{found.claim} is proved with {_listed(quadratic)}")
    elif found.entering:
        said.append(f"{found.claim}: no value of a single parameter was found with which it is proved")
    else:
        named = "what has a name under 'parameters' is looked at"
        said.append(f"{found.claim}: no parameter of the file enters it: {named}")
    if found.ended:
        said.append("the search ended before all values were tried: there may be nearer ones, and other parameters")
    for degree in sorted({p.degree for p in found.parameters} - {2}):
        nearer = [p for p in found.parameters if p.degree == degree]
        said.append(f"by a polynomial of degree {degree} in place of a common P with {_listed(nearer)}")
    return said


def _listed(found: Sequence[Proved]) -> str:
    *some, last = [f"{p.parameter} = {p.value:g} (now {p.now:g})" for p in found]
    return f"{', '.join(some)} or {last}, each by itself" if some else last


def how_far_content(found: HowFar) -> dict[str, Any]:
    """Return what run.json says of how far away a refused inequality is."""
    return {
        "inequality": found.claim,
        "parameters": [
            {"name": p.parameter, "now": p.now, "proved": p.value, "degree": p.degree} for p in found.parameters
        ],
        "complete": not found.ended,
        "rate": {"asked": found.asked, "proved": found.rate} if found.asked else None,
    }
