"""Runs that are too long, too fine or too busy are refused with the figure and the limit; busy ones are not."""

import tracemalloc
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pwatrack.arrays import Array
from pwatrack.errors import CheckFailed, InvalidSpec
from pwatrack.report.stays import joined
from pwatrack.simulation.flow import Flow, SwitchedPart
from pwatrack.simulation.propagate import simulate_flow, trace_blocks


def guarded(F0: Array, guard: list[float]) -> Flow:
    part = SwitchedPart(
        name="part",
        cells=("below", "above"),
        guards=np.array([guard]),
        signs=np.array([[-1], [1]]),
        F=np.zeros((2, *F0.shape)),
    )
    return Flow(F0=F0, parts=(part,))


def oscillation(omega: float) -> Flow:
    return guarded(np.array([[0.0, omega], [-omega, 0.0]]), [1.0, 0.0])


@pytest.mark.parametrize(("duration", "sample_time"), [(1e18, 1e17), (1e15, 1e14), (1e18, 1e18)])
def test_an_oscillation_whose_phase_is_lost_is_refused(duration: float, sample_time: float) -> None:
    with pytest.raises(InvalidSpec, match=r"are too long for .* rad/s|time constants"):
        simulate_flow(oscillation(1.0), np.array([0.0, 1.0]), duration=duration, sample_time=sample_time)


def test_times_that_cannot_be_told_apart_are_refused() -> None:
    flow = guarded(np.array([[-1e12, 1.0], [0.0, 0.0]]), [1.0, -1.0])
    with pytest.raises(InvalidSpec, match=r"1e\+06 s are too long for a closed loop with rates of 1e\+12 1/s"):
        simulate_flow(flow, np.array([0.0, 1.0]), duration=1e6, sample_time=1.0)


@pytest.mark.parametrize("entry", [np.inf, np.nan, 1e300])
def test_a_flow_beyond_all_numbers_is_refused(entry: float) -> None:
    with pytest.raises(InvalidSpec, match=r"too long for a closed loop|not finite"):
        simulate_flow(guarded(np.array([[entry]]), [1.0]), np.ones(1), duration=1.0, sample_time=0.1)


def test_poles_of_all_sizes_cost_nothing_once_they_are_dead() -> None:
    """Poles at 1e12 and 1e-9 beside a swing with period 2 pi."""
    F0 = np.diag([0.0, 0.0, -1e12, -1e-9, 0.0])
    F0[0, 1], F0[1, 0], F0[2, 0], F0[3, 0] = 1.0, -1.0, 1e12, 1.0
    trace = simulate_flow(
        guarded(F0, [1.0, 0, 0, 0, -0.5]), np.array([0.0, 1, 0, 0, 1]), duration=10.0, sample_time=0.1
    )
    expected = [np.pi / 6, 5 * np.pi / 6, 13 * np.pi / 6, 17 * np.pi / 6]
    np.testing.assert_allclose([event.t for event in trace.events], expected, atol=1e-12)
    np.testing.assert_allclose(trace.z[1:, 2], np.sin(trace.t[1:]), atol=1e-11)


def test_an_unstable_cell_takes_steps_shorter_than_a_sample() -> None:
    """e^{800} is beyond all numbers, but the state that would grow is exactly 0."""
    trace = simulate_flow(
        guarded(np.diag([1e3, -1.0]), [0.0, 1.0]), np.array([0.0, 1.0]), duration=4.0, sample_time=2.0
    )
    np.testing.assert_allclose(trace.z[:, 1], np.exp(-trace.t), rtol=1e-12)


def test_a_run_of_too_many_steps_says_how_far_it_got(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pwatrack.simulation.propagate.MOST_STEPS", (1_000, 10))
    with pytest.raises(CheckFailed, match=r"more than 1,000 steps and 10 for each sample: it got to t = \d"):
        simulate_flow(oscillation(1e3), np.array([0.0, 1.0]), duration=10.0, sample_time=5.0)
    trace = simulate_flow(oscillation(1.0), np.array([0.0, 1.0]), duration=100.0, sample_time=0.01)
    assert len(trace.events) == 31


def test_too_many_events_are_refused_and_in_blocks_they_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pwatrack.simulation.propagate.MOST_EVENTS", 100)
    arguments: dict[str, Any] = {"duration": 100.0, "sample_time": 0.1}
    with pytest.raises(CheckFailed, match=r"more than 100 mode changes: it got to t = \d+\.?\d* s of 100 s"):
        simulate_flow(oscillation(10.0), np.array([0.0, 1.0]), **arguments)
    blocks = trace_blocks(oscillation(10.0), np.array([0.0, 1.0]), **arguments, most=100)
    assert sum(len(block.events) for block in blocks) == 318


def test_events_take_little_memory() -> None:
    tracemalloc.start()
    try:
        trace = simulate_flow(oscillation(100.0), np.array([0.0, 1.0]), duration=1_000.0, sample_time=10.0)
        taken = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert len(trace.events) == 31_830
    assert taken / len(trace.events) < 130


@given(st.lists(st.floats(0.001, 5.0), min_size=1, max_size=40), st.floats(0.01, 2.0))
def test_bars_that_cannot_be_told_apart_arejoined_as_one(lengths: list[float], dot: float) -> None:
    """Every other stretch is a bar; what is drawn covers all bars, and no gap wider than a dot."""
    edges = np.cumsum([0.0, *lengths])
    bars = np.column_stack([edges[:-1], edges[1:]])[::2]
    drawn = [(start, start + length) for start, length in joined(bars, dot)]
    for start, end in bars.tolist():
        assert any(low <= start and end <= high + 1e-9 for low, high in drawn)
    for (_, end), (start, _) in pairwise(drawn):
        assert start - end > dot - 1e-9
    gaps = bars[1:, 0] - bars[:-1, 1]
    assert len(drawn) == 1 + int((gaps > dot).sum())
