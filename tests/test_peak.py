"""The peak gain of a linear system is between its bounds, and they are close."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from pwatrack import design, load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix
from pwatrack.commands.verify import verify
from pwatrack.errors import CheckFailed
from pwatrack.lmi.peak_gain import peak_gains
from pwatrack.report.files import write_result

STAGE = """
name: linear stage
system:
  states: [z, v]
  inputs: [F]
  outputs: [y]
  B: [[0], [0.5]]
  C: [[1, 0]]
  A: [[0, 1], [-0.5, -1.5]]
reference: {output: "0.1*sin(t)"}
simulation: {duration: 5, sample_time: 0.05}
"""


def by_samples(M: Array, g: Array, c: Array) -> float:
    """∫ |c e^(M t) g| dt by the trapezoidal rule."""
    values = np.linalg.eigvals(M)
    end, fastest = 25 / -float(values.real.max()), float(np.abs(values).max())
    steps = int(60 * fastest * end) + 1
    E, z, samples = expm(M * end / steps), g, []
    for _ in range(steps + 1):
        samples.append(abs(float(c @ z)))
        z = E @ z
    return float(np.trapezoid(samples, dx=end / steps))


@pytest.mark.parametrize("n", [1, 2, 3, 5, 8])
@pytest.mark.parametrize("damping", [1.0, 0.1])
def test_the_gain_by_samples_is_between_the_bounds(n: int, damping: float) -> None:
    random = np.random.default_rng(n)
    M = random.normal(size=(n, n))
    M -= (float(np.linalg.eigvals(M).real.max()) + damping) * np.eye(n)
    g, c = random.normal(size=(n, 1)), random.normal(size=(2, n))
    found = peak_gains(*map(BallMatrix.of, (M, g, c)))
    assert found is not None
    for row, (low, high) in zip(c, found, strict=True):
        gain = by_samples(M, g[:, 0], row)
        assert low * (1 - 2e-3) <= gain <= high * (1 + 2e-3)
        assert high <= 1.02 * low


@pytest.mark.parametrize("M", [[[-1.0, 1], [0, -1]], [[0.1, 0], [0, -1]], [[0.0, 1], [-1, 0]]])
def test_no_gain_is_claimed_of_eigenvalues_that_are_not_apart_or_do_not_decay(M: list[list[float]]) -> None:
    assert peak_gains(BallMatrix.of(M), BallMatrix.of([[1], [1]]), BallMatrix.of([[1, 0]])) is None


def test_a_plant_with_one_cell_is_bounded_by_its_peak_gain_and_verify_finds_out_a_smaller_one(tmp_path: Path) -> None:
    path = tmp_path / "stage.yaml"
    path.write_text(STAGE)
    controller = design(load_spec(path))
    for bounds in controller.bounds:
        for signal, (low, high) in bounds.peaks.items():
            assert low <= high == bounds.sizes[signal] < bounds.certified[signal]
    assert all(set(bounds.peaks) == set(bounds.sizes) for bounds in controller.bounds[:2])
    folder = write_result(simulate(load_spec(path), controller), tmp_path / "run", plots="none")
    assert "bounds.json beside it tells the same" in verify(folder)
    content = json.loads((folder / "bounds.json").read_text())
    signal = content["table"][0]["signals"]["y - y_d"]
    signal["peak_gain"] = [value / 2 for value in signal["peak_gain"]]
    signal["at_worst"] /= 2
    (folder / "bounds.json").write_text(json.dumps(content))
    with pytest.raises(CheckFailed, match=r"table in bounds\.json"):
        verify(folder)
