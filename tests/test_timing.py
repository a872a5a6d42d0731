"""Steps so sharp that the rounding of their times can be seen: estimated, simulated, refused."""

from pathlib import Path

import numpy as np
import pytest
from scipy.signal import place_poles

from pwatrack import load_spec, simulate
from pwatrack.control.trajectory import timing_error
from pwatrack.errors import InvalidSpec
from pwatrack.workflow import tracking

CHAIN = """
name: chain of integrators
system:
  states: %s
  inputs: [u]
  outputs: [y]
  A: %s
  B: %s
  C: %s
design: {controller: {K: %s}, observer: {L: %s}}
reference: {output: {step: {size: %s, centre: %s, smooth: %s}}}
simulation: {duration: %s, sample_time: 0.01}
"""


def chain(folder: Path, r: int, size: float, at: float, smooth: float) -> Path:
    A, B, C = np.eye(r, k=1), np.eye(r)[:, -1:], np.eye(r)[:1]
    poles = -1.0 - np.arange(r)
    K = -place_poles(A, B, poles).gain_matrix
    L = -place_poles(A.T, C.T, 2 * poles).gain_matrix.T
    path, names = folder / "chain.yaml", [f"x{k}" for k in range(r)]
    rows = [X.tolist() for X in (A, B, C, K.round(9), L.round(9))]
    path.write_text(CHAIN % (names, *rows, size, at, smooth, at + 3))
    return path


@pytest.mark.parametrize(
    ("r", "size", "at", "smooth"),
    [(1, 1, 1.003, 1e-9), (2, 1, 1.003, 1e-5), (2, 1e-3, 100.003, 1e-4), (3, 1, 1.003, 1e-3), (3, 1e6, 50.1, 1e-2)],
)
def test_the_estimated_error_is_that_of_a_simulation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, r: int, size: float, at: float, smooth: float
) -> None:
    monkeypatch.setattr(tracking, "ALLOWED", np.inf)
    result = simulate(load_spec(chain(tmp_path, r, size, at, smooth)))
    controller, plant = result.controller, result.spec.problem.plant
    estimate, time = timing_error(plant, controller.design.K, controller.trajectory, outputs=plant.C)
    assert time == pytest.approx(at, abs=smooth)
    assert estimate / 100 < result.figures.largest_error / size < 2 * estimate
    assert estimate > 1e-9


@pytest.mark.parametrize(("r", "at"), [(1, 1.003), (2, 1.003), (2, 300.1), (3, 20.0)])
def test_a_step_too_sharp_for_its_time_is_refused_with_the_rounding_that_would_do(
    tmp_path: Path, r: int, at: float
) -> None:
    with pytest.raises(InvalidSpec, match=r"chain.yaml:11:\d+: smooth: 1e-09 s is too short: the time of a break") as e:
        simulate(load_spec(chain(tmp_path, r, 1, at, 1e-9)))
    needed = float(e.value.problems[0].hint.split("smooth: ")[1].split("'")[0])
    result = simulate(load_spec(chain(tmp_path, r, 1, at, 1.1 * needed)))
    assert result.figures.largest_error < 1e-9
    with pytest.raises(InvalidSpec, match="too short"):
        simulate(load_spec(chain(tmp_path, r, 1, at, 0.3 * needed)))


TWO = """
name: two masses on one web
system:
  states: [a, b]
  inputs: [u, w]
  outputs: [ya, yb]
  A: [[-1, 0.5], [0.5, -1]]
  B: [[1, 0], [0, 1]]
  C: [[1, 0], [0, 1]]
reference: {output: {ya: {constant: AT}, yb: {step: {size: 2, at: 0.5, smooth: 1.5}}}}
simulation: {duration: 30, sample_time: 0.1}
"""


@pytest.mark.parametrize("at", ["0", "0.01", "-3"])
def test_an_output_that_rests_beside_one_that_moves_is_no_rounding(at: str, tmp_path: Path) -> None:
    """Of what rests an error counts beside where it rests: it has no swing to count it in."""
    path = tmp_path / "two.yaml"
    path.write_text(TWO.replace("AT", at), encoding="utf-8")
    assert simulate(load_spec(path)).response.error_norm[-1] < 1e-6
