import os
from pathlib import Path

import pytest
from hypothesis import settings

from pwatrack import Result, Spec, design, load_spec, simulate
from pwatrack.report.files import write_design

settings.register_profile("ci", derandomize=True)  # the same examples every time; fresh ones elsewhere
if os.environ.get("CI"):
    settings.load_profile("ci")

SPECS = Path(__file__).parent.parent / "specs"


def designed(folder: Path, text: str) -> Path:
    """Return the run folder of a design, with its spec beside it."""
    spec_file = folder / "plant.yaml"
    spec_file.write_text(text, encoding="utf-8")
    spec = load_spec(spec_file)
    return write_design(spec, design(spec), folder / "run")


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
