"""Two matrices that differ by one of rank one: what Riccati equations give beside the programs in their place."""

import numpy as np
import pytest

from pwatrack.control.convergence import best_certificate, least_overshoot_certificate, well_conditioned
from pwatrack.lmi import pair as of_pairs
from pwatrack.lmi.exact import prove
from pwatrack.lmi.inequality import quadratic_cost
from pwatrack.lmi.pair import Pair, riccati
from pwatrack.lmi.program import least_cost
from pwatrack.lmi.solve import solve


def of_rank_one(seed: int, n: int, size: float = 0.3) -> np.ndarray:
    """Return two stable matrices (2, n, n) that differ by one of rank one."""
    rng = np.random.default_rng(seed)
    M = rng.normal(size=(n, n)) / np.sqrt(n)
    M -= (np.linalg.eigvals(M).real.max() + 0.5) * np.eye(n)
    apart = size * np.outer(rng.normal(size=n), rng.normal(size=n)) / n
    return np.stack([M - apart, M + apart])


@pytest.mark.parametrize("seed", range(4))
def test_the_largest_rate_of_a_pair_is_that_of_the_program(seed: int) -> None:
    M = of_rank_one(seed, 6)
    program, pair = best_certificate(M), Pair.of(M)
    assert program is not None
    assert pair is not None
    shown = next(proof for proof in (prove(M, P) for P in pair.certificates()) if proof is not None)
    assert shown.rate == pytest.approx(program.rate, rel=2e-3)
    assert shown.rate <= program.rate * (1 + 1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_the_least_guaranteed_cost_of_a_pair_is_that_of_the_program(seed: int) -> None:
    A, rng = of_rank_one(seed, 5) + 0.7 * np.eye(5), np.random.default_rng(seed)
    B, Q, R = rng.normal(size=(5, 2)), np.diag(rng.uniform(0.5, 2, 5)), np.diag([1.0, 3.0])
    pair, program = Pair.of(A), solve(least_cost(quadratic_cost(A, B, np.sqrt(Q), R), np.eye(5)))
    assert pair is not None
    assert program is not None
    X = pair.regulator(B, Q, R, np.eye(5))
    assert X is not None
    assert np.trace(X) == pytest.approx(np.trace(np.linalg.inv(program.P)), rel=1e-2)
    K = -np.linalg.solve(R, B.T @ X)
    for A_i in A:
        left = X @ (A_i + B @ K) + (A_i + B @ K).T @ X + Q + K.T @ R @ K
        assert np.linalg.eigvalsh(left).max() < 1e-8 * np.linalg.norm(X)


@pytest.mark.parametrize("decade", range(-8, 5, 2))
def test_a_regulator_of_a_hardly_damped_chain_is_found_however_much_the_input_costs(decade: int) -> None:
    """A stop couples a driven mass to one that swings 10⁵ times: only a τ far from the sizes of the cost has an X."""
    free = np.array([[0, 1, 0, 0], [0, -0.1, 0, 0], [0, 0, 0, 1], [0, 0, -1, -1e-5]])
    push = np.outer([0, -1.0, 0, 1.0], [1.0, 0, 0, 0])
    B, A = np.array([[0.0], [1], [0], [0]]), np.stack([free, free + push])
    pair = Pair.of(A)
    assert pair is not None
    X = pair.regulator(B, np.eye(4), 10.0**decade * np.eye(1), np.eye(4))
    assert X is not None
    K = -(10.0**-decade) * B.T @ X
    for A_i in A:
        assert np.linalg.eigvalsh(X @ (A_i + B @ K) + (A_i + B @ K).T @ X).max() < 0


@pytest.mark.parametrize(("scale_of_B", "scale_of_M"), [(0.0, 1.0), (1.0, 0.0), (1e-150, 1.0), (1e150, 1e-100)])
def test_a_regulator_of_sizes_far_apart_is_found_or_none(scale_of_B: float, scale_of_M: float) -> None:
    pair = Pair.of(scale_of_M * of_rank_one(3, 4))
    assert pair is not None
    with np.errstate(all="ignore"):
        X = pair.regulator(scale_of_B * np.ones((4, 1)), np.eye(4), np.eye(1), np.eye(4))
    assert X is None or np.linalg.eigvalsh(X)[0] > 0


def test_what_is_no_pair_is_none() -> None:
    M = of_rank_one(1, 4)
    assert Pair.of(np.stack([M[0], M[1] + np.diag([0.1, 0.2, 0, 0])])) is None
    assert Pair.of(np.stack([M[0], M[1], M[0]])) is None


def test_a_pair_without_a_common_form_has_none() -> None:
    M = np.array([[[-0.1, 1.0], [-10.0, -0.1]], [[-0.1, 10.0], [-10.0, -0.1]]])  # each stable, A₁A₂ has a value < 0
    apart = np.array([[[0.0, 1.0], [-1.0, -0.1]], [[0.0, 1.0], [-50.0, -0.1]]])
    for cells in (M, apart):
        pair = Pair.of(cells)
        found = [] if pair is None else [P for P in pair.certificates() if prove(cells, P) is not None]
        assert bool(found) == (best_certificate(cells) is not None)


def test_of_many_states_the_search_takes_the_pair(monkeypatch: pytest.MonkeyPatch) -> None:
    n = of_pairs.MANY_STATES
    M = of_rank_one(3, n)
    monkeypatch.setattr("pwatrack.control.convergence.solve", lambda *_, **__: pytest.fail("a program was solved"))
    found = best_certificate(M)
    assert found is not None
    assert max(np.linalg.eigvalsh(A @ found.P + found.P @ A.T + 2 * found.rate * found.P).max() for A in M) < 0


def test_the_form_of_small_condition_is_between_that_of_the_program_and_that_of_the_best_rate() -> None:
    M = of_rank_one(2, 6)
    best = best_certificate(M)
    assert best is not None
    rate = 0.9 * best.rate
    least, P = least_overshoot_certificate(M, rate), well_conditioned(M, rate, apart=M[1] - M[0])
    assert least is not None
    assert P is not None
    shown = prove(M, P)
    assert shown is not None
    assert shown.rate >= rate
    assert np.linalg.cond(least.P) <= np.linalg.cond(P) * (1 + 1e-6) < np.linalg.cond(best.P)


def test_riccati_takes_quadratic_terms_of_either_sign() -> None:
    A, g, Q = np.array([[-2.0, 1.0], [0.0, -3.0]]), np.array([0.4, 0.2]), np.eye(2)
    X = riccati(A, -np.outer(g, g), Q)
    assert X is not None
    assert np.abs(A.T @ X + X @ A + X @ np.outer(g, g) @ X + Q).max() < 1e-12
    assert np.linalg.eigvals(A + np.outer(g, g) @ X).real.max() < 0
