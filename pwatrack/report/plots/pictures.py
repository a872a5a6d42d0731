"""Every picture of a run, by file name."""

from matplotlib.figure import Figure

from pwatrack.report.plots.cells import active_cells, portrait
from pwatrack.report.plots.errors import observer_error, tracking_error
from pwatrack.report.plots.signals import control_input, estimates, internal_states, outputs, states, steady_state
from pwatrack.study.result import Result


def draw(result: Result) -> dict[str, Figure]:
    """Return every picture by file name.

    tracking_error and observer_error are the paper's Figure 2, internal_states
    its Figure 3, steady_state its Figure 4.
    """
    figures = {
        "tracking_error.png": tracking_error(result),
        "observer_error.png": observer_error(result),
        "outputs.png": outputs(result),
        "states.png": states(result),
        "input.png": control_input(result),
        "cells.png": active_cells(result),
    }
    if result.response.eta.shape[1]:
        figures["internal_states.png"] = internal_states(result)
    if result.steady_state is not None:
        figures["steady_state.png"] = steady_state(result)
    if result.response.estimates.shape[1]:
        figures["estimates.png"] = estimates(result)
    for k, forms in enumerate(result.spec.scenario.portraits):
        figures[f"portrait_{k + 1}.png"] = portrait(result, forms)
    return figures
