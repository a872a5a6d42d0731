"""Normal equations that are solved block by block, against the same as one matrix."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pwatrack.arrays import Array
from pwatrack.lmi.normal import ChainNormal, Normal


def ring(seed: int, count: int, size: int, rest: int) -> tuple[Array, list[slice]]:
    """A matrix of blocks in a ring, each with entries with the next, and of unknowns that have entries with all."""
    random, end = np.random.default_rng(seed), count * size
    H, places = np.zeros((end + rest, end + rest)), [slice(k * size, (k + 1) * size) for k in range(count)]
    for k in range(count):
        both = [*range(end)[places[k]], *range(end)[places[(k + 1) % count]], *range(end, end + rest)]
        both = sorted(set(both))
        X = random.normal(size=(len(both), 2 * len(both)))
        H[np.ix_(both, both)] += X @ X.T
    return H, places


@settings(max_examples=40)
@given(st.integers(0, 10**6), st.integers(2, 9), st.integers(1, 6), st.integers(1, 4))
def test_block_by_block_is_the_same_as_at_once(seed: int, count: int, size: int, rest: int) -> None:
    H, places = ring(seed, count, size, rest)
    right = np.random.default_rng(seed).normal(size=len(H))
    lower = np.tril(H)
    x = ChainNormal(lower, places).solve(right)
    assert x == pytest.approx(Normal(lower).solve(right), rel=1e-9, abs=1e-12)
    assert H @ x == pytest.approx(right, abs=1e-8)


@pytest.mark.parametrize("wrong", [-1.0, np.nan])
def test_what_is_not_positive_semidefinite_is_refused(wrong: float) -> None:
    H, places = ring(0, 6, 3, 1)
    H[4, 4] = wrong
    with pytest.raises(np.linalg.LinAlgError):
        ChainNormal(H, places)


def test_unknowns_that_nothing_depends_on_are_0() -> None:
    H, places = ring(1, 6, 3, 2)
    H[5], H[:, 5] = 0.0, 0.0
    x = ChainNormal(H, places).solve(np.where(np.arange(len(H)) == 5, 0.0, 1.0))
    assert x[5] == 0
    assert np.isfinite(x).all()
