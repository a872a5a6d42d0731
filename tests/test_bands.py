"""What the proofs allow of each signal over time: no run is above it."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from pwatrack import Result, load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.control.bounds import Form
from pwatrack.control.controller import ProvedController
from pwatrack.report.plots.pictures import pictures

PUSHED = "  disturbance: {v1: {constant: 0.05, sine: {amplitude: 0.2, frequency: 3}}}\n"
NOISY = "  noise: {std: {y: 0.01}, sample_time: 0.05}\n"


@cache
def simulated(path: Path) -> Result:
    return simulate(load_spec(path))


def changed(specs: Path, tmp_path: Path, extra: str, controller: ProvedController | None = None) -> Result:
    text = (specs / "two_mass_backlash.yaml").read_text(encoding="utf-8")
    path = tmp_path / "changed.yaml"
    path.write_text(text.rstrip() + "\n" + extra, encoding="utf-8")
    return simulate(load_spec(path), controller)


def errors(result: Result) -> dict[Form, Array]:
    r, found = result.response, dict[Form, Array]()
    loads = result.controller.plant.loads
    off = [r.x_hat - r.x] if loads is None else [r.x_hat - r.x, r.estimates - r.loads]
    where = range(r.x.shape[1]) if loads is None else [*range(r.x.shape[1]), *(r.x.shape[1] + k for k in loads.where)]
    found |= {("estimate", k): values for k, values in zip(where, np.hstack(off).T, strict=True)}
    found |= {("output", k): values for k, values in enumerate((r.tracked - r.tracked_d).T)}
    found |= {("state", k): values for k, values in enumerate((r.x - r.x_d).T)}
    return found | {("input", k): values for k, values in enumerate((r.u - r.u_ff).T)}


def held(result: Result) -> dict[Form, float]:
    """The largest share of its band that each signal takes."""
    off, floor = errors(result), 1e-11 * float(np.abs(result.response.x).max())
    return {form: float((np.abs(off[form]) / (band + floor)).max()) for form, band in result.bands.items()}


@pytest.mark.slow
@pytest.mark.parametrize(
    "path", ["two_mass_backlash", "gallery/payload_in_wind", "gallery/two_driven_carts", "gallery/robust_positioning"]
)
def test_no_signal_of_a_run_leaves_its_band(specs: Path, path: str) -> None:
    result = simulated(specs / f"{path}.yaml")
    shares = held(result)
    assert {"input"} | {"state" if "carts" in path else "output"} <= {kind for kind, _ in shares}
    assert max(shares.values()) <= 1 + 1e-9


@pytest.mark.parametrize("limit", ["rate_limit: {u: 1}", ""])
def test_a_sampled_loop_has_bands_where_no_input_is_at_a_limit_of_any_kind(
    specs: Path, tmp_path: Path, limit: str
) -> None:
    result = changed(specs, tmp_path, f"  controller: {{sample_time: 0.01}}\n  {limit}\n")
    assert bool(result.bands) == (not limit)


@pytest.mark.parametrize("extra", [PUSHED, NOISY, PUSHED + NOISY])
def test_a_band_counts_what_acts_and_goes_to_the_bound_of_that(specs: Path, tmp_path: Path, extra: str) -> None:
    result = changed(specs, tmp_path, extra, simulated(specs / "two_mass_backlash.yaml").controller)
    assert 0.01 < max(held(result).values()) <= 1 + 1e-9
    sizes = {bounds.channel: bounds.sizes["output", 0] for bounds in result.controller.bounds}
    most = float(np.abs(0.05 + 0.2 * np.sin(3 * result.response.t)).max()) * sizes["disturbance", 1] * (extra != NOISY)
    if extra == PUSHED:
        assert most <= result.bands["output", 0][-1] <= most + 0.1
    else:
        assert result.bands["output", 0][-1] > most


def test_a_limit_that_no_input_comes_to_changes_no_band_and_one_that_it_comes_to_ends_all(
    specs: Path, tmp_path: Path
) -> None:
    free = changed(specs, tmp_path, "")
    largest = free.figures.largest_input["u"]

    def limited(share: float) -> dict[Form, Array]:
        extra = f"  actuator: {{limits: {{u: [{-share * largest!r}, {share * largest!r}]}}}}\n"
        return changed(specs, tmp_path, extra, free.controller).bands

    assert np.array_equal(free.bands["output", 0], limited(1.01)["output", 0])
    assert limited(0.99) == {}
    assert changed(specs, tmp_path, "  controller: {sample_time: 0.001}\n", free.controller).bands == {}


@pytest.mark.slow
def test_pictures_have_a_panel_for_each_error_with_its_band_and_what_is_required(specs: Path, tmp_path: Path) -> None:
    wishes = "require: {final_error: 0.2, largest_input: 50, settling_time: 50}\n"
    result = changed(specs, tmp_path, "  actuator: {limits: {u: [-60, 60]}}\n" + wishes)
    figures = {name: draw() for name, draw in pictures(result).items()}
    shown = {
        name: {text.get_text() for axes in figure.axes if (box := axes.get_legend()) for text in box.get_texts()}
        for name, figure in figures.items()
    }
    assert "proved, whatever the switching" in shown["tracking_error"] & shown["observer_error"]
    assert all("required" in shown[name] for name in ("tracking_error", "outputs", "input"))
    assert "limit" in shown["input"]
    assert shown["states"] == {"plant", "desired", "estimate"}
    panels = [axes.get_title(loc="left") for axes in figures["observer_error"].axes]
    assert panels == ["z1_hat − z1", "v1_hat − v1", "z2_hat − z2", "v2_hat − v2", ""]


@pytest.mark.slow
def test_a_spike_at_the_start_does_not_squash_the_rest_of_an_input(specs: Path) -> None:
    result = simulated(specs / "gallery" / "payload_in_wind.yaml")
    whole, start, _ = pictures(result)["input"]().axes
    (inset,) = whole.child_axes
    late, most = result.response.u[result.response.t > 1.5], float(result.response.u.max())
    assert most > 4 * float(late.max())
    assert inset.get_ylim()[1] < 1.5 * float(late.max())
    assert min(whole.get_ylim()[1], start.get_ylim()[1]) > most  # what is large is in view too


@pytest.mark.slow
def test_a_load_that_steps_is_counted_as_one_that_sets_in_and_is_forgotten(specs: Path, tmp_path: Path) -> None:
    text = (specs / "gallery" / "payload_in_wind.yaml").read_text(encoding="utf-8")
    before, _, _ = text.partition("  disturbance:")
    path = tmp_path / "gust.yaml"
    path.write_text(f"{before}  disturbance: {{v2: {{constant: 1, step: {{size: 2, at: 5}}}}}}\n", encoding="utf-8")
    result = simulate(load_spec(path))
    assert 0.01 < max(held(result).values()) <= 1 + 1e-9
    band, t = result.bands["output", 0], result.response.t
    gust = band[t >= 5][0]
    assert gust > 2 * band[t < 5][-1]
    assert band[-1] < 0.2 * gust
    sizes = {bounds.channel: bounds.sizes["output", 0] for bounds in result.controller.bounds}
    assert band[-1] < 3 * sizes["disturbance", 3]
