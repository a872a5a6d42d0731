"""What most of a bound is made of, and what would lessen it."""

from collections import defaultdict
from collections.abc import Mapping

import numpy as np

from pwatrack.claims.robust import Robust
from pwatrack.claims.sampled_bounds import TubeBounds
from pwatrack.claims.sampled_box import SampledBoxBounds
from pwatrack.control.bounds import Channel, Form
from pwatrack.control.controller import ProvedController
from pwatrack.model.conditions import Conditions
from pwatrack.workflow.bands import SIGMAS

_WAYS = {  # of what a bound is made of, what may lessen it
    "noise": "try larger 'sizes' of outputs",  # for a calmer observer
    "steps of sensors": "take finer ones",
    "steps of inputs": "take finer ones",
    "disturbances": "larger 'sizes' of inputs",  # for a faster K
    "parameters": "a smaller box, or larger 'sizes' of inputs",
    "parameters and disturbances": "a smaller box, or larger 'sizes' of inputs",
    "steps of loads": "smaller 'sizes' of outputs",  # for a faster observer
    "jitter": "sample with less, or more often",
    "sampling": "sample more often",
    "what is merged": "larger 'sizes' of inputs",
}
FASTER = "disturbances", "parameters", "parameters and disturbances", "steps of loads", "what is merged"  # gains help
_OF = {  # by the kinds of `control.sampled_disturbances`; what is in none is left by sampling
    "disturbance": "disturbances",
    "input": "steps of inputs",
    "load": "steps of loads",
    "deviation": "what is merged",
    "swap": "jitter",
    "predicted": "jitter",
}


def way(cause: str, controller: ProvedController) -> str:
    """Return what may lessen what a cause leaves."""
    free = controller.plant.loads is None and not controller.claims_of(Robust)
    return "'estimate' them, or " * (cause == "disturbances" and free) + _WAYS[cause]


def of_sampled(tubes: TubeBounds, controller: ProvedController, conditions: Conditions, form: Form) -> dict[str, float]:
    """Return how much of a bound of the sampled loop each cause has."""
    found, p = defaultdict[str, float](float), tubes.errors.followed.shape[0]
    box = isinstance(tubes, SampledBoxBounds)
    for channel, size in tubes.ends_by(controller, form).items():
        kind, k = channel
        if kind == "noise":
            most = float(np.sqrt(tubes.acts.squares[channel].max()))
            for cause, share in of_measured(conditions, k, most).items():
                found[cause] += share * size
        elif kind == "disturbance" and box:
            found["parameters" if conditions.disturbance is None else "parameters and disturbances"] += size
        else:
            found["jitter" if kind == "nominal" and k >= p else _OF.get(kind, "sampling")] += size
    return found


def of_designed(sizes: Mapping[Channel, float], conditions: Conditions) -> dict[str, float]:
    """Return how much of a bound of the loop as designed each cause has, whose parts are of `bands.declared`."""
    found = defaultdict[str, float](float)
    for (kind, k), size in sizes.items():
        shares = of_measured(conditions, k) if kind == "noise" else {"disturbances": 1.0}
        for cause, share in shares.items():
            found[cause] += share * size
    return found


def of_measured(conditions: Conditions, k: int, most: float | None = None) -> dict[str, float]:
    """Return the shares of causes by which an output is measured off, in all or by so much: jitter has the rest."""
    noise = 0.0 if conditions.noise is None else SIGMAS * float(conditions.noise.std[k])
    steps = 0.0 if conditions.quanta is None else float(conditions.quanta.outputs[k]) / 2
    total = noise + steps if most is None else max(most, steps)
    late = 0.0 if conditions.sampling is None or not conditions.sampling.jitter else max(total - 2 * noise - steps, 0.0)
    parts = {"noise": total - steps - late, "steps of sensors": steps, "jitter": late}
    return {cause: size / total for cause, size in parts.items() if size > 0}
