"""What is said of limits of inputs: what the feedforward takes of them, and which starts never lead to them."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from pwatrack.arrays import number_text
from pwatrack.control.controller import Controller
from pwatrack.control.limits import Limited, Peak, Promise
from pwatrack.report.wording import down
from pwatrack.spec.spec import Spec


def limit_content(spec: Spec, controller: Controller) -> dict[str, Any]:
    """Return what run.json says of limits: by input; nothing where there are none."""
    limited = controller.limited
    if limited is None:
        return {}
    left = limited.left
    inputs = {
        spec.problem.plant.inputs[k]: {
            "limits": [float(v) if np.isfinite(v) else None for v in limited.limits[k]],
            "feedforward": None if limited.peak is None else _peak(limited.peak, k),
            "lasting": None if limited.lasting is None else _peak(limited.lasting, k),
            "left": None if left is None else float(left[k]),
        }
        for k in _finite(limited)
    }
    said = [
        {
            "starts": p.starts.kind,
            "scale": float(p.scale(left)) if np.isfinite(p.scale(left)) else None,
            "inputs": _sizes(spec, p, p.held.sizes if p.held else [0.0] * len(p.inputs)),
            "loads": _sizes(spec, p, p.loads),
        }
        for p in limited.promises
        if left is not None
    ]
    return {"limits": {"inputs": inputs, "ever": limited.ever, "starts": said}}


def _sizes(spec: Spec, promise: Promise, values: Sequence[float]) -> dict[str, float]:
    return dict(zip((spec.problem.plant.inputs[k] for k in promise.inputs), values, strict=True))


def _peak(peak: Peak, k: int) -> dict[str, list[float]]:
    return {"range": [float(peak.low[k]), float(peak.high[k])], "times": peak.times[k].tolist()}


def limit_rows(spec: Spec, controller: Controller) -> Iterator[str]:
    """Yield what the limits leave beside the feedforward."""
    limited = controller.limited
    if limited is None:
        return
    for k in _finite(limited):
        name, unit = spec.problem.plant.inputs[k], spec.problem.units.get(spec.problem.plant.inputs[k], "")
        low, high = (number_text(float(v), "g") for v in limited.limits[k])
        said = f"{name} from {low} to {high} {unit}".rstrip()
        if limited.peak is None:
            yield f"{said}: x_d takes too long to follow, so what its feedforward takes is not known"
            continue
        takes = f"its feedforward takes {_range(limited.peak, k, unit)}"
        if any(input_ == k for input_, _ in limited.peak.beyond(limited.limits)):
            after = (
                "" if limited.lasting is None else f"; once that start is forgotten {_range(limited.lasting, k, unit)}"
            )
            yield f"{said}: {takes}, more than that, from where the generator starts{after}"
        else:
            room = float(limited.peak.left(limited.limits)[k])
            left = f"leaves {down(room)} {unit}".rstrip() if room else "takes the whole limit: nothing is left"
            yield f"{said}: {takes}, which {left} for what is off"
    yield from _promise_rows(controller, limited)


def _promise_rows(controller: Controller, limited: Limited) -> Iterator[str]:
    """Yield from which starts no limit is reached: ever, or in this run where more may be taken after it."""
    never = "no limit is ever reached" if limited.ever else "no limit is reached in this run"
    for promise in limited.promises:
        assert limited.left is not None
        scale, kind = promise.scale(limited.left), promise.starts.kind
        much = f"up to {down(scale)} times its size" if np.isfinite(scale) else "whatever it is"
        if kind == "exact":
            idle = "" if controller.plant.loads is None else ", while no load acts"
            starts = f"each |x_k − x_dk| {much} and x̂ = x{idle}"
        elif kind == "sizes":
            loads = "" if promise.starts.load is None else " and each load"
            starts = f"each |x_k − x_dk| and |x̂_k − x_k|{loads} {much}"
        else:
            starts = "the start of this run" if kind == "run" else "the starts of its ensemble"
            starts += " with its loads" if promise.starts.load is not None else ""
            starts = starts if scale >= 1 else f"{down(scale)} times the errors of {starts}"
            starts += " with x̂ = x" * (kind == "members")
        yield f"in the loop as designed {never} from {starts}"
    if limited.left is not None and not limited.promises:
        yield f"from which starts {never} could not be proved"


def _range(peak: Peak, k: int, unit: str) -> str:
    (first, last), low, high = peak.times[k].tolist(), float(peak.low[k]), float(peak.high[k])
    ends = f"{number_text(low, '.4g')} to {number_text(high, '.4g')} {unit}".rstrip()
    return f"{ends} (t = {first:.4g} s, {last:.4g} s)"


def _finite(limited: Limited) -> list[int]:
    return [int(k) for k in np.flatnonzero(np.isfinite(limited.limits).any(axis=1))]
