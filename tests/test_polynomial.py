"""Polynomials that decay where no quadratic form does: where they end, and that they are what they say."""

import numpy as np
import pytest
from scipy.linalg import expm

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix
from pwatrack.lmi.coordinates import Coordinates
from pwatrack.lmi.exact_polynomial import PolynomialProof, prove_polynomial
from pwatrack.lmi.monomials import Monomials
from pwatrack.lmi.polynomial import Candidate, degrees, polynomial
from pwatrack.lmi.role import CONTROLLER, GENERATOR
from pwatrack.rational import floats

LARGEST = {2: 0.690, 4: 1.017, 6: 1.037, 8: 1.098, 10: 1.113}  # k2 = k3 for (17) of the example, by degree


def zero_dynamics(k: float) -> Array:
    """A_eta of the example with k2 = k3 = k, in the gap and beyond it."""
    return np.array([[[0.0, 1.0], [-1.0, -0.3]], [[0.0, 1.0], [-1.0 - k, -0.3]]])


def near(A: Array) -> Coordinates:
    at = Coordinates.balanced(A.swapaxes(1, 2))
    return at.of_mean(at.system(A.swapaxes(1, 2)))


def proved(A: Array, degree: int) -> PolynomialProof | None:
    found = polynomial(A, degree, near(A))
    return None if found is None else prove_polynomial(GENERATOR, [BallMatrix.of(A_i).transpose() for A_i in A], found)


@pytest.mark.parametrize("degree", LARGEST)
def test_each_degree_ends_where_it_should_and_is_proved_a_thousandth_below(degree: int) -> None:
    low, high = 0.6, 1.168
    while high - low > 1e-4:
        middle = (low + high) / 2
        low, high = (
            (middle, high) if polynomial(zero_dynamics(middle), degree, near(zero_dynamics(middle))) else (low, middle)
        )
    assert round(low, 3) == LARGEST[degree]
    proof = proved(zero_dynamics(round(0.999 * low, 6)), degree)
    assert proof is not None
    assert proof.degree == degree


def test_a_polynomial_falls_at_its_rate_along_any_switching() -> None:
    A = zero_dynamics(1.1)
    proof = proved(A, 10)
    assert proof is not None
    monomials, P = proof.monomials, floats(proof.P)
    rng = np.random.default_rng(1)

    def V(e: Array) -> float:
        z = proof.T @ e
        m = np.array([np.prod(z**a) for a in monomials.exponents])
        return float(m @ P @ m)

    for _ in range(200):
        e, tau = rng.normal(size=2), 10.0 ** rng.uniform(-3, 1)
        share = rng.uniform()
        after = expm(tau * (share * A[0] + (1 - share) * A[1])) @ e
        assert 0 < V(after) <= V(e) * np.exp(-10 * proof.rate * tau) * (1 + 1e-9)


def test_lifts_are_those_of_the_monomials_and_keep_rotations() -> None:
    rng, monomials = np.random.default_rng(2), Monomials.of(3, 3)
    A, e = rng.normal(size=(3, 3)), rng.normal(size=3)

    def m(e: Array) -> Array:
        return np.asarray(monomials.weights * [np.prod(e**a) for a in monomials.exponents])

    assert m(e) @ m(e) == pytest.approx(float(e @ e) ** 3)
    lift = monomials.lift(A[None])[0]
    assert m(expm(A) @ e) == pytest.approx(expm(lift) @ m(e))
    turning = monomials.lift((A - A.T)[None])[0]
    assert turning == pytest.approx(-turning.T)
    exact = floats(monomials.exactly(BallMatrix.of(A)).centre)
    assert exact * monomials.weights[:, None] / monomials.weights == pytest.approx(lift)


def test_units_of_the_states_do_not_matter() -> None:
    A, units = zero_dynamics(1.0), np.array([1e6, 1e-4])
    other = A * units[:, None] / units
    one, two = polynomial(A, 4, near(A)), polynomial(other, 4, near(other))
    assert one is not None
    assert two is not None
    assert two.rate == pytest.approx(one.rate, rel=0.05)
    assert prove_polynomial(CONTROLLER, [BallMatrix.of(A_i) for A_i in other], two) is not None


def test_a_rounded_polynomial_is_proved_for_no_other_plant() -> None:
    A = zero_dynamics(1.0)
    found = polynomial(A, 4, near(A))
    assert found is not None
    worse = zero_dynamics(1.168)
    moved = Candidate(A=worse, degree=4, T=found.T, P=found.P, N=found.N, rate=found.rate)
    assert prove_polynomial(GENERATOR, [BallMatrix.of(A_i).transpose() for A_i in worse], moved) is None
    assert prove_polynomial(GENERATOR, [BallMatrix.of(A_i).transpose() for A_i in worse], found) is None


def test_degrees_that_take_long_are_not_tried() -> None:
    assert degrees(1, 2) == ()
    assert degrees(2, 2) == (4, 6, 8, 10)
    assert degrees(4, 3) == (4, 6)
    assert degrees(20, 3) == ()
