"""Every picture of a run, by its name."""

from collections.abc import Callable
from functools import partial

from matplotlib.figure import Figure

from pwatrack.report.plots.cells import active_cells, portrait
from pwatrack.report.plots.elements import nonlinearities
from pwatrack.report.plots.errors import observer_error, tracking_error
from pwatrack.report.plots.signals import control_input, estimates, internal_states, outputs, states, steady_state
from pwatrack.workflow.outcome import SimulatedLoop


def pictures(result: SimulatedLoop) -> dict[str, Callable[[], Figure]]:
    """Return what draws each picture, by its name.

    tracking_error and observer_error are the paper's Figure 2, internal_states its Figure 3, steady_state its Figure 4.
    """
    of_result = {
        "tracking_error": tracking_error,
        "observer_error": observer_error,
        "outputs": outputs,
        "states": states,
        "input": control_input,
        "cells": active_cells,
    }
    if result.response.eta.shape[1]:
        of_result["internal_states"] = internal_states
    if result.steady_state is not None:
        of_result["steady_state"] = steady_state
    if result.response.estimates.shape[1]:
        of_result["estimates"] = estimates
    found: dict[str, Callable[[], Figure]] = {name: partial(draw, result) for name, draw in of_result.items()}
    problem = result.spec.problem
    if problem.plant.elements:
        draw = partial(nonlinearities, result.spec.name, problem.plant, problem.units, result.response.x)
        found["nonlinearities"] = draw
    for k, forms in enumerate(result.spec.scenario.portraits, 1):
        found[f"portrait_{k}"] = partial(portrait, result, forms)
    return found
