"""Measured references: a filter without a phase, and a word where the feedforward follows noise."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import BSpline

from pwatrack import design, load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.model.profile import Table, low_passed
from pwatrack.workflow.tracking import reference_remarks
from tests.test_cli import call, index_of

T = np.arange(0.0, 6.0, 0.01)


@given(st.floats(0.5, 20.0), st.floats(0.1, 4.5))
def test_a_sinusoid_keeps_its_phase_and_loses_what_the_gain_says(cutoff: float, share: float) -> None:
    """Inside, where the ends do not reach; straight lines between rows cost another little."""
    t = np.arange(0.0, 20 / cutoff, 0.01 / cutoff)
    w = 2 * np.pi * share * cutoff
    times, values = low_passed(t, np.sin(w * t), cutoff)
    inner = (times > 1 / cutoff) & (times < 19 / cutoff)
    gain = np.sinc(0.2275119577344921 * share) ** 4
    np.testing.assert_allclose(values[inner], gain * np.sin(w * times[inner]), atol=2e-3)
    assert gain == pytest.approx(np.sqrt(0.5), abs=1e-12) or share != 1


@given(st.lists(st.floats(-1e3, 1e3), min_size=4, max_size=4), st.floats(0.8, 20.0))
def test_a_polynomial_up_to_the_ends_is_moved_by_its_curvature_only(c: list[float], cutoff: float) -> None:
    """An average moves a cubic p by σ²/2 p'', with σ² = 4 box²/12 the variance of the kernel."""
    p = np.polynomial.Polynomial(c)
    times, values = low_passed(T, p(T), cutoff)
    box, row = 0.2275119577344921 / cutoff, 0.01
    moved = p(times) + (4 * box**2 / 12) / 2 * p.deriv(2)(times)
    least = row**2 * np.abs(p.deriv(2)(T)).max() + 1e-9 * np.abs(p(T)).max() + 1e-300  # the last of what has no digits
    np.testing.assert_allclose(values, moved, atol=least)


def test_it_is_the_average_that_it_is_said_to_be() -> None:
    """Against quadrature, for rows that are not evenly spaced."""
    random = np.random.default_rng(3)
    t = np.sort(np.append(random.uniform(0, 4, 200), [0.0, 4.0]))
    y, cutoff = random.normal(size=len(t)), 2.0
    times, values = low_passed(t, y, cutoff)
    box = 0.2275119577344921 / cutoff
    kernel = BSpline.basis_element(np.arange(-2, 3) * box, extrapolate=False)
    for k in range(len(times) // 3, 2 * len(times) // 3, 5):
        s = times[k]
        u = np.linspace(s - 2 * box, s + 2 * box, 100_001)
        weights = np.nan_to_num(kernel(u - s))
        assert values[k] == pytest.approx(weights @ np.interp(u, t, y) / weights.sum(), abs=1e-6)


@pytest.mark.parametrize("r", [1, 2, 3, 4])
def test_what_is_left_has_r_smooth_derivatives_near_the_true_ones(r: int) -> None:
    """0.15 m there and back, measured to 0.1 mm a hundred times in a second."""
    random = np.random.default_rng(1)
    w = np.pi
    clean = 0.15 * (1 - np.cos(w * T))
    noisy = clean + 1e-4 * random.normal(size=len(T))
    signal = Table(*low_passed(T, noisy, 2.0), filtered=True).signal(r)
    assert all(signal.jump(order) is None for order in range(r + 1))
    inner = np.arange(0.5, 5.5, 0.01)
    for order in range(min(r, 2) + 1):
        size = 0.15 * w**order
        found = np.array([signal(float(t), derivative=order) for t in inner])
        truth = -size * np.real(1j**order * np.exp(1j * w * inner)) + (0.15 if order == 0 else 0)
        assert np.abs(found - truth).max() < 0.1 * size


def stage(folder: Path, y: Array, options: str = "", *, order: int = 2) -> Path:
    lines = "\n".join(f"{1000 * t!r};{v!r}" for t, v in zip(T.tolist(), y.tolist(), strict=True))
    (folder / "wanted.csv").write_text(("t_ms;pos\n" + lines).replace(".", ","), encoding="utf-8-sig")
    plants = {
        2: "A: [[0, 1], [0, 0]], B: [[0], [1/5]], C: [[1, 0]]",
        3: "A: [[0, 1, 0], [0, 0, 1], [0, 0, -10]], B: [[0], [0], [2]], C: [[1, 0, 0]]",
    }
    states = ["x", "v", "a"][:order]
    path = folder / "stage.yaml"
    path.write_text(
        f"""name: Stage
system:
  {{states: {states}, inputs: [F], outputs: [y], units: {{F: N}}, {plants[order]}}}
reference: {{output: {{table: {{file: wanted.csv, time: t_ms, scale: 1e-3{options}}}}}}}
simulation: {{duration: 5, sample_time: 0.01}}
""",
        encoding="utf-8",
    )
    return path


CLEAN = 0.15 * (1 - np.cos(np.pi * T))
NOISY = CLEAN + 1e-4 * np.random.default_rng(1).normal(size=len(T))


@pytest.mark.slow
@pytest.mark.parametrize("order", [2, 3])
def test_a_feedforward_that_follows_noise_is_remarked_with_figures(tmp_path: Path, order: int) -> None:
    path = stage(tmp_path, NOISY, order=order)
    result = simulate(load_spec(path))
    (said,) = result.remarks
    found = re.search(
        r"make its derivative (\d) (\S+) times .* below 5 Hz; .*: about (\S+) N instead of (\S+) N;", said
    )
    assert found is not None, said
    assert int(found[1]) == order
    assert float(found[2]) > 10
    assert float(found[3]) == pytest.approx(np.abs(result.response.u_ff).max(), rel=0.5)
    for command in (("check", path), ("design", path, "--out", tmp_path / "out")):
        assert re.search(r"(?m)^remark +noise or corners of the table", call(*command).stdout)
    assert said in json.loads(call("check", path, "--json").stdout)["remarks"]
    assert index_of(tmp_path / "out")["remarks"] == [said]
    filtered = simulate(load_spec(stage(tmp_path, NOISY, ", filter: {cutoff: 2}", order=order)))
    assert filtered.remarks == ()
    assert np.abs(filtered.response.u_ff).max() < 0.2 * np.abs(result.response.u_ff).max()
    assert np.abs(filtered.response.y_d[:, 0] - np.interp(filtered.response.t, T, CLEAN)).max() < 6e-3


def test_nothing_is_said_of_what_is_smooth_or_coarse(tmp_path: Path) -> None:
    for y in (CLEAN, 1e-5 * np.sin(300 * T), np.where(T > 2, 0.3, 0.0)):
        controller = design(load_spec(stage(tmp_path, y)))
        assert reference_remarks(load_spec(stage(tmp_path, y)), controller.form) == ()
