"""What lets a long step pass without a look at its guards, against matrix exponentials with 50 digits."""

from fractions import Fraction

import numpy as np
from flint import arb_mat
from hypothesis import given, settings
from hypothesis import strategies as st

from pwatrack.arrays import Array
from pwatrack.simulation import kernel
from pwatrack.simulation.flow import Flow, SwitchedPart
from pwatrack.simulation.tables import Tables, unit
from tests.precise import digits

seeds = st.integers(0, 10_000)


def random_flow(random: np.random.Generator, n: int, k: int) -> Flow:
    """Fast and slow modes, weakly coupled, and guards that see some of it."""
    F = random.normal(size=(n, n)) * 10.0 ** random.uniform(-6, 0, size=(n, n)) * (random.random((n, n)) < 0.6)
    F -= np.diag(np.abs(F).sum(axis=1) * random.choice([0.0, 1.0, 3.0]))
    guards = random.normal(size=(k, n)) * (random.random((k, n)) < 0.7)
    part = SwitchedPart(
        name="part",
        cells=("one",),
        guards=guards,
        signs=np.ones((1, k), dtype=np.int64),
        F=(0.4 * F / max(1.0, float(np.linalg.norm(np.abs(F), 2))))[None],
    )
    return Flow(F0=np.zeros((n, n)), parts=(part,))


def exponentials(F: Array, times: list[Fraction]) -> list[Array]:
    """e^{F t} to the last digit of floating point, for each time."""
    with digits(50):
        exact = arb_mat(F.tolist())
        found = [(exact * (float(t.numerator) / float(t.denominator))).exp().mid() for t in times]
        return [np.array([[float(v) for v in row] for row in matrix.tolist()]) for matrix in found]


@given(seeds, st.integers(2, 6), st.integers(1, 3))
@settings(max_examples=25)
def test_no_guard_leaves_its_bounds_on_a_step_of_any_length(seed: int, n: int, k: int) -> None:
    random = np.random.default_rng(seed)
    flow = random_flow(random, n, k)
    tables = Tables(flow, 1.0, 6)
    tables.number((0,))
    arrays, _ = tables.known()
    F, guards, z = flow.matrix((0,)), flow.guards(), random.normal(size=n)
    speed, bend = np.abs(F @ z), np.abs(F @ F @ z)
    for d in (0, 2, 6):
        parts = 16
        times = [Fraction(2**d * j, parts) for j in range(parts + 1)]
        flown = exponentials(F, times)
        seen = np.array([guards @ (E @ z) for E in flown])
        then = guards @ (z + z @ arrays.growth[0, d])
        share = np.linspace(0.0, 1.0, parts + 1)[:, None]
        chord = (1 - share) * (guards @ z) + share * then
        assert (np.abs(seen - chord) <= np.abs(z) @ arrays.margin[0, d]).all()
        rounding = 1e-13 * np.abs(guards) @ np.abs(z)
        assert (np.abs(seen - guards @ z) <= speed @ arrays.first[0, d] + rounding).all()
        line = guards @ z + share * 2**d * (guards @ (F @ z))
        assert (np.abs(seen - line) <= bend @ arrays.second[0, d] + rounding * 2**d).all()


@given(seeds, st.integers(1, 7), st.integers(1, 4))
@settings(max_examples=50)
def test_what_a_product_can_be_off_by_covers_its_rounding(seed: int, n: int, k: int) -> None:
    """Rows and vectors chosen so that nearly everything cancels, and vectors that are off themselves."""
    random = np.random.default_rng(seed)
    F, z = random.normal(size=(n, k)) * 10.0 ** random.integers(-8, 8, size=(n, k)), random.normal(size=n)
    if n > 1:
        F[-1] = -(z[:-1] @ F[:-1]) / z[-1]
    doubt = np.abs(z) * random.choice([0.0, 1e-12])
    off = doubt * random.uniform(-1, 1, size=n)
    result, after = np.empty(k), np.empty(k)
    kernel.rounded_product(F, z, doubt, unit(n), result, after)
    for i in range(k):
        true = sum((Fraction(F[j, i]) * (Fraction(z[j]) + Fraction(off[j])) for j in range(n)), Fraction(0))
        assert abs(Fraction(result[i]) - true) <= Fraction(after[i])


def test_a_slope_that_rounding_hides_does_not_let_a_long_step_pass() -> None:
    """It is 0 as far as floating point sees, but can be off by so much that in 2²⁰ steps the guard is reached."""
    sides, now, none = np.ones(1, dtype=np.int64), np.array([1e-9]), np.zeros((1, 1))
    far = np.full((1, 1), 1.0)
    for off, clear in ((0.0, True), (1e-16, True), (1e-14, False)):
        slopes = np.array([[-off], [off]])
        assert kernel.stays_clear(sides, now, slopes, far, np.ones(1), none, np.zeros(1), 1 << 20) is clear
