"""The shift of Assumption 2, η = η̄ + M ξ_d, and what holds where there is none."""

from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pwatrack import design, load_spec
from pwatrack.control.generator import assumption_2_shift

seeds = st.integers(0, 10_000)


@given(seeds, st.integers(1, 4), st.integers(1, 3))
def test_a_shift_is_found_wherever_there_is_one(seed: int, p: int, r: int) -> None:
    random = np.random.default_rng(seed)
    A_eta, M, common = random.normal(size=(3, p, p)), random.normal(size=(p, r)), random.normal(size=(p, r))
    found = assumption_2_shift(A_eta, common - A_eta @ M)
    assert found is not None
    B_bar = A_eta @ found + common - A_eta @ M
    np.testing.assert_allclose(B_bar, np.broadcast_to(B_bar[0], B_bar.shape), atol=1e-8)


@given(seeds)
def test_input_matrices_that_no_shift_can_equal_have_none(seed: int) -> None:
    """Two unknowns per column, four equations: A_η2 − A_η1 and A_η3 − A_η1 must agree on M."""
    random = np.random.default_rng(seed)
    assert assumption_2_shift(random.normal(size=(3, 2, 2)), random.normal(size=(3, 2, 1))) is None


def test_without_a_shift_the_design_still_stands_on_17(specs: Path) -> None:
    controller = design(load_spec(specs / "gallery" / "three_tanks_weirs.yaml"))
    assert controller.generator is not None
    assert controller.generator.shift is None
    assert {proof.role.name for proof in controller.proofs} == {"controller", "observer", "generator"}
