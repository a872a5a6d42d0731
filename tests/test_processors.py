"""Verdicts are the same whichever kernels the libraries of linear algebra choose for a processor."""

import pytest

from benchmarks.processors import drawn, further, verdicts

PAIRS = [(5, 0.1), (6, 0.3), (7, 1.0), *drawn(3)]


@pytest.mark.slow
def test_nearly_equal_modes_have_the_same_verdict_under_other_kernels() -> None:
    others = further()
    if not others:
        pytest.skip("this machine has no further kernels")
    for core in others[:2]:
        assert verdicts(core, PAIRS) == ["proved"] * len(PAIRS), core
