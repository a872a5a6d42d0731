"""From where errors go to 0 although inputs are limited: what is proved, and how members of an ensemble went."""

import numpy as np
from matplotlib.figure import Figure

from pwatrack.errors import ExitCode
from pwatrack.report.plots.canvas import ACTUAL, BOUND, canvas, label, legend
from pwatrack.workflow.variation import EnsembleResult, sections

_POINTS = 400  # of an ellipse
_ROOM = 1.05  # of what is shown: so much of the plane
_STYLES = {"goes to 0, limits reached or not": ACTUAL, "no limit is reached": BOUND}


def starts_in_plane(many: EnsembleResult) -> Figure:
    """Draw where members in a plane start and how they end, and the ellipses that are proved there."""
    result, plane = many.nominal, list(many.nominal.spec.scenario.plane)
    names = [result.controller.plant.states[k] for k in plane]
    title = f"Starts in a plane, x̂ = x, all other errors 0: {len(many.outcomes):,} members, and what is proved"
    figure, (axes,) = canvas(result, title, [[0]], height=5.6)
    starts = np.column_stack([many.variation.values[name] for name in names]) - result.response.x_d[0, plane]
    small = np.array([one.code == ExitCode.DONE and one.kind != "off" for one in many.outcomes])
    axes.scatter(
        starts[small, 0],
        starts[small, 1],
        s=12,
        facecolors="none",
        edgecolors="0.45",
        linewidths=0.8,
        label="gets small",
    )
    axes.scatter(
        starts[~small, 0],
        starts[~small, 1],
        s=16,
        marker="x",
        color="#a3195b",
        linewidths=0.9,
        label="does not, in this run",
    )
    angles = np.linspace(0, 2 * np.pi, _POINTS)
    circle, seen = np.column_stack([np.cos(angles), np.sin(angles)]), [starts]
    for said, C in sections(result.controller, plane):
        axes.plot(*(C @ circle.T), label=f"proved: {said}", **_STYLES[said])
        seen.append(circle @ C.T)
    units = result.spec.problem.units
    texts = [f"{name} − {name}_d" + (f" ({units[name]})" if units.get(name) else "") for name in names]
    most = _ROOM * np.abs(np.vstack(seen)).max(axis=0)
    label(axes, texts[0], texts[1], (-most[0], most[0]))
    axes.set_ylim(-most[1], most[1])
    legend(axes, columns=2)
    return figure
