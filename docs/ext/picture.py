"""The picture of the README, made by `python -m docs.ext.picture`: a plant that switches follows, as is proved."""

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from docs.ext.cells import ROOT
from pwatrack import load_spec, simulate
from pwatrack.report.plots.canvas import LOOK

_SPEC = ROOT / "specs" / "gallery" / "gear_with_backlash.yaml"
_SHOWN = 6.0  # s


def picture() -> Figure:
    """Return it: what the gear does to its shaft, the load beside its reference, its error within the proved band."""
    spec = load_spec(_SPEC)
    result = simulate(spec)
    response, (k, play) = result.response, (spec.parameters[name] for name in ("k", "play"))
    shown = response.t <= _SHOWN
    t = response.t[shown]
    figure = Figure(figsize=(9.6, 2.9), layout="constrained")
    FigureCanvasAgg(figure)
    gear, load, error = figure.subplots(1, 3, width_ratios=(1, 1.5, 1.5))
    gear.plot([-3 * play, -play, play, 3 * play], [-2 * k * play, 0, 0, 2 * k * play], **LOOK["actual"])
    gear.set(title="a plant that switches:\na gear with play", xlabel="twist (rad)", ylabel="torque (N m)")
    load.plot(t, response.tracked_d[shown, 0], label="reference", **LOOK["desired"])
    load.plot(t, response.tracked[shown, 0], label="load", **LOOK["actual"])
    load.set(title="made to follow,\nfrom the motor's sensor alone", xlabel="time (s)", ylabel="angle (rad)")
    load.legend(frameon=False, loc="upper center", fontsize="small")
    band = result.bands[("output", 0)][shown]
    error.fill_between(t, -band, band, label="proved", **LOOK["band"])
    error.plot(t, response.tracking_error[shown, 0], label="simulated", **LOOK["actual"])
    error.set(title="with a proof,\nfrom any start, for any switching", xlabel="time (s)", ylabel="error (rad)")
    error.set_ylim(-6 * band[-1], 6 * band[-1])
    error.legend(frameon=False, loc="upper right", fontsize="small")
    for axes in (gear, load, error):
        axes.grid(color="0.92")
        axes.spines[["top", "right"]].set_visible(False)
        axes.title.set_fontsize("medium")
    return figure


if __name__ == "__main__":
    picture().savefig(ROOT / "docs" / "static" / "tracking.png", dpi=110)
