"""The steps between events: how many Taylor terms they take, and that none is read that was not written."""

from fractions import Fraction
from math import factorial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pwatrack.arrays import Array
from pwatrack.simulation.flow import Flow, SwitchedPart
from pwatrack.simulation.propagate import Propagator, simulate_flow

EPS = float(np.finfo(np.float64).eps)


def watched(F0: Array, *guards: list[float]) -> Flow:
    """A flow that does the same on both sides of each guard; each guard has a part of its own."""
    parts = tuple(
        SwitchedPart(
            name=f"part {k}",
            cells=("below", "above"),
            guards=np.array([guard]),
            signs=np.array([[-1], [1]]),
            F=np.zeros((2, *F0.shape)),
        )
        for k, guard in enumerate(guards)
    )
    return Flow(F0=F0, parts=parts)


def chain(n: int) -> Array:
    """ż_i = z_{i+1}."""
    return np.eye(n, k=1)


def exactly(z0: list[Fraction], t: Fraction) -> list[Fraction]:
    """The state of a chain of integrators at a time, in rationals."""
    return [sum((z * t**j / factorial(j) for j, z in enumerate(z0[i:])), Fraction(0)) for i in range(len(z0))]


def test_a_term_that_was_not_renewed_makes_no_crossing() -> None:
    """e^{-t} and e^{-1.01 (t - 45) - 45} meet once; the second guard, which is always 0, has all terms looked at."""
    flow = watched(np.diag([-1.0, -1.01, 0.0, 0.0]), [1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0])
    trace = simulate_flow(flow, np.array([1.0, np.exp(0.45), 0.0, 1.0]), duration=90.0, sample_time=0.2)
    assert [event.t for event in trace.events] == [pytest.approx(45.0, abs=1e-9)]


@pytest.mark.parametrize("n", range(5, 31))
def test_a_chain_of_integrators_rises_as_its_polynomial(n: int) -> None:
    """All rests but the last of the chain: every entry is t^k / k!, in the units of the file to the last digit."""
    z0 = np.eye(n)[-1]
    trace = simulate_flow(watched(chain(n), [0.0] * (n - 1) + [1.0]), z0, duration=3.0, sample_time=0.25)
    for t, z in zip(trace.t[1:], trace.z[1:], strict=True):
        true = [float(value) for value in exactly([Fraction(v) for v in z0.tolist()], Fraction(t))]
        np.testing.assert_allclose(z, true, rtol=1e-14)


@pytest.mark.parametrize("n", range(5, 31))
def test_a_chain_of_integrators_crosses_when_its_polynomial_does(n: int) -> None:
    """The first of the chain reaches what it has at t = 1.7, seen through a step, a long sample, and a scaled guard."""
    k, t = n - 2, Fraction(17, 10)
    level = float(t**k / factorial(k))
    z0, scale = np.zeros(n), 2.0**-k
    z0[k], z0[-1] = 1.0, 1.0  # the constant 1 is no part of the chain
    F0 = np.zeros((n, n))
    F0[:-1, :-1] = chain(n - 1)
    flow = watched(F0, [scale, *[0.0] * (n - 2), -scale * level])
    for sample_time in (0.05, 0.5, 2.0):
        (event,) = simulate_flow(flow, z0, duration=2.0, sample_time=sample_time).events
        assert event.t == pytest.approx(1.7, abs=1e-14)


@pytest.mark.slow
@given(st.integers(2, 8), st.integers(0, 10_000), st.sampled_from([1e-12, 1e-6, 1.0]))
@settings(max_examples=12)
def test_what_a_step_leaves_out_is_rounding_in_every_entry(n: int, seed: int, weak: float) -> None:
    """Sparse positive flows with links of all sizes: no cancellation, so every entry must be right to rounding."""
    random = np.random.default_rng(seed)
    F = np.where(random.random((n, n)) < 0.3, random.random((n, n)), 0.0) + chain(n) * weak
    rational = [[Fraction(v) for v in row] for row in F.tolist()]
    propagator = Propagator(watched(F, [0.0] * (n - 1) + [1.0]), duration=0.5, sample_time=0.5)
    for column in range(n):
        z = np.eye(n)[column]
        true = term = [Fraction(v) for v in z.tolist()]
        for j in range(1, 60):
            term = [sum((a * b for a, b in zip(row, term, strict=True)), Fraction(0)) / (2 * j) for row in rational]
            true = [a + b for a, b in zip(true, term, strict=True)]
        found = propagator.walk(z).trace().z[-1]
        np.testing.assert_allclose(found, [float(v) for v in true], rtol=50 * n * EPS)
