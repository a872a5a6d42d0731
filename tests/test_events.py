"""Isolation of crossings in Bernstein form."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import Polynomial

from pwatrack.simulation.events import bernstein_matrix, first_crossing

roots_in_reach = st.lists(st.floats(-0.5, 1.5), min_size=1, max_size=6)


@given(roots_in_reach, st.sampled_from([-1.0, 1.0]))
def test_the_first_sign_change_from_plus_to_minus_is_found(roots: list[float], sign: float) -> None:
    spread = np.sort([*roots, 0.0, 1.0])
    if np.diff(spread).min(initial=1.0) < 1e-3:
        return  # close pairs have a test of their own
    p = Polynomial.fromroots(roots) * sign
    if p(0) < 0:
        p = -p
    inside = sorted(r for r in roots if 0 < r < 1)
    crossing = first_crossing(p.coef.astype(np.float64), 1e-15)
    if inside:
        assert crossing is not None
        assert not crossing.grazing
        assert crossing.tau == pytest.approx(inside[0], abs=1e-9)
    else:
        assert crossing is None


@pytest.mark.parametrize("exponent", range(-11, -1))
@pytest.mark.parametrize("centre", [0.1, 0.3, 0.5, 0.77, 1 - 1e-4])
def test_a_dip_of_any_depth_is_not_missed(exponent: int, centre: float) -> None:
    depth = 10.0**exponent
    dip = Polynomial([centre**2 - depth, -2 * centre, 1.0])  # (τ − centre)² − depth
    crossing = first_crossing(dip.coef.astype(np.float64), 1e-15)
    if centre - np.sqrt(depth) <= 0:
        assert crossing is not None
    else:
        assert crossing is not None
        assert crossing.tau == pytest.approx(centre - np.sqrt(depth), abs=1e-10 / np.sqrt(depth))
    above = Polynomial([centre**2 + depth, -2 * centre, 1.0])
    assert first_crossing(above.coef.astype(np.float64), 1e-15) is None


def test_a_touch_within_rounding_is_called_grazing() -> None:
    crossing = first_crossing(np.array([0.25, -1.0, 1.0]), 1e-15)
    assert crossing is None or crossing.grazing or crossing.tau == pytest.approx(0.5, abs=1e-6)


def test_a_start_on_the_guard_goes_where_the_first_derivative_points() -> None:
    assert first_crossing(np.array([1e-17, 1.0, 0.0]), 1e-15) is None
    leaving = first_crossing(np.array([1e-17, -1.0, 0.0]), 1e-15)
    assert leaving is not None
    assert leaving.tau == 0.0
    later = first_crossing(np.array([0.0, 1.0, -4.0]), 1e-15)
    assert later is not None
    assert later.tau == pytest.approx(0.25)


def test_a_guard_that_stays_zero_is_no_event() -> None:
    assert first_crossing(np.zeros(5), 1e-15) is None


def test_bernstein_coefficients_enclose_the_polynomial() -> None:
    power = np.array([0.3, -2.0, 5.0, -1.0])
    b = bernstein_matrix(3) @ power
    values = Polynomial(power)(np.linspace(0, 1, 101))
    assert b.min() <= values.min()
    assert values.max() <= b.max()
    assert b[0] == power[0]
    assert b[-1] == pytest.approx(power.sum())
