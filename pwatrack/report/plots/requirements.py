"""What a spec requires of its run, as lines."""

from collections.abc import Sequence

from matplotlib.axes import Axes

from pwatrack.arrays import Array
from pwatrack.report.plots.canvas import REQUIRED
from pwatrack.simulation.figures import Move
from pwatrack.simulation.trace import last_tenth
from pwatrack.workflow.result import SimulatedLoop


def limits(result: SimulatedLoop, figure: str, signal: str | None = None) -> list[float]:
    """Return the limits of a figure of the run, or of one of its signals."""
    asked = (wish for wish in result.spec.requirements if wish.figure == figure and wish.share is None)
    return [wish.limit for wish in asked if wish.signal in (None, signal)]


def error_lines(axes: Axes, result: SimulatedLoop, signs: Sequence[int], signal: str | None = None) -> list[float]:
    """Draw the largest error that is required, in the last tenth of the time and in all of it; return the values.

    That of the norm of all, or of one of the signals by itself.
    """
    t, drawn = result.response.t, list[float]()
    late = float(t[last_tenth(len(t)).start])
    for figure, start in (("final_error", late), ("largest_error", float(t[0]))):
        for limit in limits(result, figure if signal is None else f"{figure}s", signal):
            for sign in signs:
                axes.plot([start, t[-1]], [sign * limit] * 2, label="required", **REQUIRED)
                drawn.append(sign * limit)
    return drawn


def step_lines(axes: Axes, result: SimulatedLoop, name: str, y: Array, y_d: Array) -> list[float]:
    """Draw when an output must have settled, within which band, and how far it may go beyond; return the values."""
    t, drawn = result.response.t, list[float]()
    move = Move(result.spec.scenario.bands.get(name))
    move.see(t, y, y_d)
    move.end(float(t[last_tenth(len(t)).start]))
    for limit in limits(result, "settling_time", name):
        axes.axvline(move.start + limit, label="required", **REQUIRED)
        for edge in (-move.band, move.band):
            late = t >= move.start + limit
            axes.plot(t[late], (move.target if move.rests else y_d[late]) + edge + 0 * t[late], **REQUIRED)
    for limit in limits(result, "overshoot", name) if move.distance else ():
        drawn.append(move.target + limit * move.distance)
        axes.plot([move.start, t[-1]], drawn[-1:] * 2, label="required", **REQUIRED)
    return drawn
