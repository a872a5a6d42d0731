"""What acts on a sampled loop, in words."""

import numpy as np

from pwatrack.arrays import CLOSE
from pwatrack.ball_matrix import BallMatrix
from pwatrack.claims.practical import Practical
from pwatrack.control.bounds import Channel
from pwatrack.control.controller import ProvedController
from pwatrack.control.sampled_error import SampledErrors
from pwatrack.control.words import Words


def channel_text(
    channel: Channel, errors: SampledErrors, words: Words, controller: ProvedController
) -> tuple[str, str]:
    """Return what a channel of `control.sampled_disturbances` is, and its unit."""
    plant, units, (kind, k) = words.plant, words.units, channel
    of_states = {"drawn": "from x_d moving in a sample", "predicted": "predicted from ticks off their times"}
    of_inputs = {"input": "steps of {}", "swap": "{} changing off its time", "cell": "u_ff of another cell on {}"}
    if kind in of_states:
        _, name, unit = words.cause(("disturbance", k % len(plant.B)))
        return f"{name} {of_states[kind]}", unit
    if kind in of_inputs:
        return of_inputs[kind].format(plant.inputs[k]), units.get(plant.inputs[k], "")
    if kind == "eta":
        assert controller.form is not None
        return f"{controller.form.eta_names[k]} stepped in another cell", ""
    if kind == "load":
        assert plant.loads is not None
        return f"steps of {plant.loads.states[k]}", units.get(plant.loads.states[k], "")
    if kind == "deviation":
        merged = [merge for claim in controller.claims_of(Practical) for merge in claim.merges]
        return f"what is merged of {merged[k].nonlinearity.name}", ""
    if kind not in ("moved", "nominal"):
        _, name, unit = words.cause(channel)
        return name + " as drawn" * (kind == "noise" and words.conditions.noise is not None), unit
    of, late = _rows(channel, errors), k >= _rows(channel, errors).shape[0]
    k %= of.shape[0]
    entries = [(v, name) for v, name in zip(of.texts[k], plant.states, strict=True) if v != "0"]
    terms = " + ".join(name if v == "1" else f"({v}) {name}" for v, name in entries)
    said = "moving in a substep" if kind == "moved" else "off its reference in the mean cell"
    return f"{terms} {said}{' from ticks off their times' * late}", units.get(entries[0][1], "")


def _rows(channel: Channel, errors: SampledErrors) -> BallMatrix:
    """Return the rows on x that one of them is, of what moves or is off its reference."""
    return errors.followed if channel[0] == "nominal" else errors.R


def rounding(channel: Channel, errors: SampledErrors, controller: ProvedController) -> float:
    """Return what of a channel that x_d makes may be rounding, which processors differ in: a share of its size."""
    sizes, (kind, k) = controller.sizes, channel
    if kind in ("moved", "nominal"):
        of = _rows(channel, errors)
        return CLOSE * float(np.abs(of.floats[k % of.shape[0]]) @ sizes.state)
    if kind in ("drawn", "predicted"):
        return CLOSE * float(sizes.state[k % len(sizes.state)]) * sizes.speed
    return CLOSE * float(sizes.input[k]) if kind in ("swap", "cell") else 0.0
