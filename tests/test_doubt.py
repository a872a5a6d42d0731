"""Where rounding hides on which side of a guard a trajectory is, it is said; where it does not, nothing is."""

from decimal import Decimal, localcontext
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pwatrack.arrays import Array
from pwatrack.simulation.flow import Flow, SwitchedPart
from pwatrack.simulation.propagate import simulate_flow, trace_blocks
from tests.plants import reset

PARABOLA = np.array([[0.0, 1, 0], [0, 0, 2], [0, 0, 0]])  # z_1 = z_1(0) + z_2(0) t + t² for z_3 = 1


def guarded(F0: Array, *guards: list[float]) -> Flow:
    """One part with a cell on each side of each guard, all with the same field."""
    signs = np.array([[1 if cell >> k & 1 else -1 for k in range(len(guards))] for cell in range(2 ** len(guards))])
    part = SwitchedPart(
        name="part",
        cells=tuple(map(str, range(len(signs)))),
        guards=np.array(guards),
        signs=signs,
        F=np.zeros((len(signs), *F0.shape)),
    )
    return Flow(F0=F0, parts=(part,))


@pytest.mark.parametrize("value", [3e-15, -3e-15])
def test_a_start_within_rounding_of_a_guard_that_hardly_moves_is_told(value: float) -> None:
    """z_1 = 1 + value + t² against 1: for -3e-15 it crosses at 5e-8 s, for 3e-15 never; the tolerance hides both."""
    flow, start = guarded(PARABOLA, [1.0, 0.0, -1.0]), np.array([1.0 + value, 0.0, 1.0])
    trace = simulate_flow(flow, start, duration=1.0, sample_time=0.1)
    (doubt,) = trace.unresolved
    assert (doubt.t, doubt.part, doubt.guard) == (0.0, "part", 0)
    assert np.sqrt(abs(value)) <= doubt.span < 1e-5


@pytest.mark.parametrize(("value", "slope"), [(0.0, 0.0), (0.0, -0.5), (0.0, 0.5), (3e-15, 1.0), (-3e-15, 1.0)])
def test_a_start_exactly_on_a_guard_or_with_a_clear_slope_is_no_doubt(value: float, slope: float) -> None:
    flow, start = guarded(PARABOLA, [1.0, 0.0, -1.0]), np.array([1.0 + value, slope, 1.0])
    assert simulate_flow(flow, start, duration=1.0, sample_time=0.1).unresolved == ()


@pytest.mark.parametrize("miss", [0.0, 2e-15, -2e-15])
def test_a_corner_where_one_guard_is_touched_within_rounding_is_told(miss: float) -> None:
    """At t = 1/2 one guard is crossed with slope 1; there the other is (t - 1/2)² + miss, of numbers of size 1."""
    F0 = np.zeros((4, 4))
    F0[:3, :3], F0[3, 2] = PARABOLA, 1.0
    flow = guarded(F0, [1.0, 0.0, -1.0, 0.0], [0.0, 0.0, 0.0, 1.0])
    trace = simulate_flow(flow, np.array([1.25 + miss, -1.0, 1.0, -0.5]), duration=1.0, sample_time=0.4)
    assert 1 in [int(abs(event.before[0] - event.after[0]) == 2) for event in trace.events]
    assert {doubt.guard for doubt in trace.unresolved} == {0}
    assert all(doubt.t == pytest.approx(0.5, abs=1e-6) for doubt in trace.unresolved)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("offset", [0.0, 1.4e-17, 4e-16, -4e-16])
def test_a_path_along_a_guard_within_rounding_is_told(side: float, offset: float) -> None:
    """It stays a rounding away from the guard, or exactly on it, until it is kicked."""
    kick = [reset(0.55, slice(1, 2), np.array([side]))]
    flow = guarded(np.array([[0.0, 1.0, 0.0], [0, 0, 0], [0, 0, 0]]), [1.0, 0.0, -0.1])
    start = np.array([0.1 + offset, 0.0, 1.0])
    trace = simulate_flow(flow, start, duration=1.0, sample_time=0.1, resets=kick)
    assert [doubt.t for doubt in trace.unresolved] == ([0.0] if offset else [])
    assert [doubt.span for doubt in trace.unresolved] == (pytest.approx([0.55]) if offset else [])
    blocks = trace_blocks(flow, start, duration=1.0, sample_time=0.1, resets=kick, most=3)
    assert tuple(doubt for block in blocks for doubt in block.unresolved) == trace.unresolved


def test_a_state_that_comes_to_rest_on_a_guard_is_told() -> None:
    """1 + e^{-t} against 1: from t = 32 s on nobody can say more than that."""
    flow = guarded(np.array([[-1.0, 1.0], [0.0, 0.0]]), [1.0, -1.0])
    trace = simulate_flow(flow, np.array([2.0, 1.0]), duration=60.0, sample_time=0.5)
    (doubt,) = trace.unresolved
    assert 28 < doubt.t < 36
    assert doubt.t + doubt.span == pytest.approx(60.0)
    assert trace.events == ()


@given(st.floats(-1.0, 1.0), st.floats(0.01, 2.0), st.sampled_from([-1.0, 1.0]), st.floats(0.01, 1.0))
@settings(max_examples=60)
def test_a_clean_crossing_is_no_doubt(value: float, slope: float, side: float, sample_time: float) -> None:
    """Swinging through a guard with any clear slope."""
    F0 = np.array([[0.0, 1.0, 0], [-1.0, 0, 0], [0, 0, 0]])
    trace = simulate_flow(
        guarded(F0, [1.0, 0.0, -value]), np.array([value, side * slope, 1.0]), duration=10.0, sample_time=sample_time
    )
    assert trace.unresolved == ()


def roots(a: Fraction, b: Fraction) -> list[float]:
    """Where a + b t + t² changes its sign after t = 0, from rationals with 40 digits."""
    discriminant = b * b / 4 - a
    if discriminant <= 0:
        return []
    with localcontext() as context:
        context.prec = 40
        root = (Decimal(discriminant.numerator) / Decimal(discriminant.denominator)).sqrt()
        middle = -Decimal((b / 2).numerator) / Decimal((b / 2).denominator)
        return [float(t) for t in (middle - root, middle + root) if t > 0]


@given(
    st.sampled_from([0.0, 1e-9, 0.1, 0.25, 0.3, 0.7323]),
    st.integers(-400, 400),
    st.sampled_from([1e-17, 1e-15, 1e-14]),
    st.sampled_from([0.05, 0.3, 1.0]),
    st.booleans(),
)
@settings(max_examples=150)
def test_no_crossing_is_missing_or_shifted_without_a_word(
    t0: float, steps: int, size: float, sample_time: float, corner: bool
) -> None:
    """1 + (t - t0)² + some roundings against 1, alone or where another guard is crossed at t0 too."""
    F0 = np.zeros((4, 4))
    F0[:3, :3], F0[3, 2] = PARABOLA, 1.0
    start = np.array([1.0 + t0 * t0 + steps * size, -2 * t0, 1.0, -t0 if corner else 1.0])
    flow = guarded(F0, [1.0, 0.0, -1.0, 0.0], [0.0, 0.0, 0.0, 1.0])
    trace = simulate_flow(flow, start, duration=1.0, sample_time=sample_time)
    expected = roots(Fraction(start[0]) - 1, Fraction(start[1]))
    found = [event.t for event in trace.events if (event.before[0] ^ event.after[0]) & 1]
    told = 1e-11 + 2.0**-22 * sample_time  # more than that
    off = [t for t in expected if not any(abs(t - other) < told for other in found)]
    off += [t for t in found if not any(abs(t - other) < told for other in expected)]
    spans = [(doubt.t, max(doubt.span, 1e-6)) for doubt in trace.unresolved if doubt.guard == 0]
    for t in off:
        assert any(since - 1e-6 <= t <= since + 2 * span for since, span in spans), (expected, found, spans)
