import os
from pathlib import Path

import pytest
from hypothesis import settings

from pwatrack import Result, Spec, load_spec, simulate

settings.register_profile("ci", derandomize=True)  # the same examples every time; fresh ones elsewhere
if os.environ.get("CI"):
    settings.load_profile("ci")

SPECS = Path(__file__).parent.parent / "specs"


@pytest.fixture(scope="session")
def specs() -> Path:
    return SPECS


@pytest.fixture(scope="session")
def paper_spec() -> Spec:
    return load_spec(SPECS / "two_mass_paper_gains.yaml")


@pytest.fixture(scope="session")
def paper(paper_spec: Spec) -> Result:
    """The example of Section V with the gains of the paper; printed, both have the opposite sign."""
    return simulate(paper_spec)
