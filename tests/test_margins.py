"""Margins of each cell's loop, against python-control and against the loop that they end."""

from pathlib import Path

import numpy as np
import pytest

from pwatrack import design, load_spec
from pwatrack.simulation.margins import loop_margins, response, worst
from pwatrack.simulation.modes import Mode, modes

control = pytest.importorskip("control")


@pytest.fixture(scope="module")
def found(specs: Path):  # type: ignore[no-untyped-def]
    """A design, and its margins."""
    made = design(load_spec(specs / "two_mass_paper_gains.yaml"))
    return made, loop_margins(made)


def test_margins_are_those_of_python_control_for_observer_and_gain_in_each_cell(found) -> None:  # type: ignore[no-untyped-def]
    made, margins = found
    plant, K, L = made.plant, made.K, made.L
    assert len(margins) == 2  # both springs are alike
    for one in margins:
        A, B, C = plant.A[one.cell], plant.B, plant.C
        of_plant = control.ss(A, B, C, 0)
        of_controller = control.ss(A + B @ K + L @ C, -L, K, 0)
        opened = -of_controller * of_plant
        gain, phase, *_, crossing, _ = control.stability_margins(opened)
        assert one.gain[1] == pytest.approx(gain, rel=1e-6)
        assert np.degrees(one.phase) == pytest.approx(phase, rel=1e-5)
        assert one.crossover >= crossing * (1 - 1e-6)
        assert 0 < one.delay < np.inf


def closed(made, cell: int, factor: complex) -> float:  # type: ignore[no-untyped-def]
    """Return the largest real part of the loop whose input passes a factor."""
    A, B, C, K, L = made.plant.A[cell], made.plant.B, made.plant.C, made.K, made.L
    both = np.block([[A, factor * B @ K], [-L @ C, A + B @ K + L @ C]])
    return float(np.linalg.eigvals(both).real.max())


def test_at_each_margin_the_loop_is_about_to_be_unstable(found) -> None:  # type: ignore[no-untyped-def]
    made, margins = found
    for one in margins:
        low, high = one.gain
        for factor in [f for f in (low, high) if 0 < f < np.inf]:
            inner, outer = (factor + (1 - factor) * share for share in (1e-3, -1e-3))
            assert closed(made, one.cell, inner) < 0 < closed(made, one.cell, outer)
        turned = [np.exp(1j * sign * one.phase * 1.001) for sign in (-1, 1)]
        assert max(closed(made, one.cell, factor) for factor in turned) > 0
        assert all(closed(made, one.cell, np.exp(1j * s * one.phase * 0.999)) < 0 for s in (-1, 1))


def test_the_worst_has_the_least_of_each(found) -> None:  # type: ignore[no-untyped-def]
    _, margins = found
    least = worst(margins)
    assert least is not None
    assert least.phase == min(one.phase for one in margins)
    assert least.gain[1] == min(one.gain[1] for one in margins)
    assert worst([]) is None


def test_a_pole_that_a_search_comes_upon_to_the_last_bit_is_passed_by() -> None:
    """1 / (s² + 4) has no value at ω = 2; beside it it is very large, elsewhere it is as it was."""
    A, b, c = np.array([[0.0, 1.0], [-4.0, 0.0]]), np.array([0.0, 1.0]), np.array([1.0, 0.0])
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.solve(2j * np.eye(2) - A, b)
    found = response(A, b, c, np.array([1.0, 2.0, 3.0]))
    assert abs(found[1]) > 1e13
    assert found[[0, 2]] == pytest.approx([1 / 3, -1 / 5])


def test_modes_have_frequency_damping_and_time_constant() -> None:
    oscillator, unstable = np.array([[0.0, 1.0], [-9.0, 0.0]]), np.array([[0.5, 0.0], [0.0, 0.0]])
    (still,) = modes(oscillator)
    assert still.frequency == pytest.approx(3.0)
    assert (still.damping, still.time_constant) == (0.0, np.inf)
    assert modes(unstable) == [
        Mode(frequency=0.0, damping=0.0, time_constant=np.inf),
        Mode(frequency=0.5, damping=-1.0, time_constant=-2.0),
    ]
