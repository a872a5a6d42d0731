"""Isolation of crossings in Bernstein form."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from numpy.polynomial import Polynomial

from pwatrack.simulation import kernel

NOWHERE = (math.inf, math.inf, math.inf)


def first_crossing(power: Any, tolerance: float) -> tuple[float, float, float]:
    """Where it crosses, touches, and stays near from."""
    padded = np.zeros(16)
    padded[: len(power)] = power
    return kernel.first_crossing(padded, tolerance, np.empty((32, 18)))


roots_in_reach = st.lists(st.floats(-0.5, 1.5), min_size=1, max_size=6)


@example([0.5, 0.75], 1.0)  # a dip from one halving point to another
@given(roots_in_reach, st.sampled_from([-1.0, 1.0]))
def test_the_first_sign_change_from_plus_to_minus_is_found(roots: list[float], sign: float) -> None:
    spread = np.sort([*roots, 0.0, 1.0])
    assume(np.diff(spread).min() >= 1e-3)  # close pairs have a test of their own
    p = Polynomial.fromroots(roots) * sign
    if p(0) < 0:
        p = -p
    inside = sorted(r for r in roots if 0 < r < 1)
    crossing, touch, near = first_crossing(p.coef, 1e-15)
    assert touch == near == math.inf
    assert crossing == (pytest.approx(inside[0], abs=1e-9) if inside else math.inf)


@pytest.mark.parametrize("exponent", range(-11, -1))
@pytest.mark.parametrize("centre", [0.1, 0.3, 0.5, 0.77, 1 - 1e-4])
def test_a_dip_of_any_depth_is_not_missed(exponent: int, centre: float) -> None:
    depth = 10.0**exponent
    dip = Polynomial([centre**2 - depth, -2 * centre, 1.0])  # (τ − centre)² − depth
    crossing, touch, near = first_crossing(dip.coef, 1e-15)
    assert crossing == pytest.approx(max(0.0, centre - np.sqrt(depth)), abs=1e-10 / np.sqrt(depth))
    assert touch == near == math.inf
    above = Polynomial([centre**2 + depth, -2 * centre, 1.0])
    assert first_crossing(above.coef, 1e-15) == NOWHERE


@pytest.mark.parametrize("depth", [0.0, 1e-13, -1e-13])
def test_a_touch_within_rounding_is_reported_and_is_no_crossing(depth: float) -> None:
    crossing, touch, near = first_crossing([0.25 - depth, -1.0, 1.0], 1e-12)
    assert crossing == near == math.inf
    assert touch == pytest.approx(0.5, abs=2e-6)


def test_what_stays_within_rounding_up_to_the_end_is_left_to_the_next_step() -> None:
    crossing, touch, near = first_crossing([1.0, -2.0, 1.0], 1e-12)
    assert crossing == touch == math.inf
    assert near == pytest.approx(1.0, abs=2e-6)


def test_a_stay_within_rounding_before_a_crossing_is_part_of_it() -> None:
    crossing, touch, near = first_crossing((-1.0 * Polynomial.fromroots([0.3, 0.3, 0.3])).coef, 1e-12)
    assert crossing == pytest.approx(0.3, abs=2e-4)
    assert touch == near == math.inf


def test_a_touch_and_a_crossing_after_it_are_both_reported() -> None:
    crossing, touch, near = first_crossing((-1.0 * Polynomial.fromroots([0.3, 0.3, 0.8])).coef, 1e-12)
    assert crossing == pytest.approx(0.8, abs=1e-12)
    assert touch == pytest.approx(0.3, abs=2e-6)
    assert near == math.inf


def test_a_start_on_the_guard_goes_where_the_first_derivative_points() -> None:
    assert first_crossing([1e-17, 1.0, 0.0], 1e-15) == NOWHERE
    assert first_crossing([1e-17, -1.0, 0.0], 1e-15)[0] == 0.0
    assert first_crossing([0.0, 1.0, -4.0], 1e-15)[0] == pytest.approx(0.25)


def test_a_guard_that_stays_zero_is_no_event() -> None:
    assert first_crossing([0.0], 1e-15) == NOWHERE
