"""Every spec in specs/ ends as it says it should.

Where a spec requires a final error, `make batch` holds the run against it: what requires none is run here.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pwatrack import PwatrackError, design, load_spec, simulate
from pwatrack.claims.practical import Practical
from pwatrack.spec.load import expected_exit
from tests.conftest import SPECS

ALL = sorted(SPECS.rglob("*.yaml"))
WORKING = [path for path in ALL if not expected_exit(path)]
FREE = [path for path in WORKING if "final_error: " not in path.read_text(encoding="utf-8")]
REFUSED = [path for path in ALL if expected_exit(path)]


@pytest.mark.slow
@pytest.mark.parametrize("path", FREE, ids=lambda path: path.stem)
def test_a_plant_of_the_gallery_is_designed_and_tracks(path: Path) -> None:
    result = simulate(load_spec(path))
    desired = np.abs(result.response.y_d).max(axis=0)
    if result.controller.claims_of(Practical):
        assert result.outcome.kind == "within its bound"
        return
    small = 1e-4 if result.loop.conditions.nominal else 0.1
    assert result.final_error <= small * max(desired.max(), np.abs(result.response.x_d).max())


@pytest.mark.slow
@pytest.mark.parametrize("path", WORKING, ids=lambda path: path.stem)
def test_another_solver_proves_the_same(path: Path) -> None:
    """A second opinion, PICOS with Clarabel. Gains may differ where more than one is best; what is proved does not."""
    spec = load_spec(path)
    unsampled = replace(spec.scenario, conditions=replace(spec.scenario.conditions, sampling=None))
    ours = design(replace(spec, scenario=unsampled))  # what is proved of the program is not compared
    theirs = design(replace(spec, objectives=replace(spec.objectives, solver="clarabel")))
    assert [proof.role for proof in theirs.proofs] == [proof.role for proof in ours.proofs]
    assert [proof.rate for proof in theirs.proofs] == pytest.approx([proof.rate for proof in ours.proofs], rel=0.2)


@pytest.mark.parametrize("path", REFUSED, ids=lambda path: path.stem)
def test_a_plant_that_must_be_refused_is_refused(path: Path) -> None:
    with pytest.raises(PwatrackError) as refusal:
        simulate(load_spec(path))
    assert refusal.value.code == expected_exit(path)
    assert all(problem.place for problem in refusal.value.problems)


def test_the_gallery_shows_what_it_should() -> None:
    plants = {path.stem: load_spec(path).problem.plant for path in WORKING}
    orders = {name: plant.A.shape[1] for name, plant in plants.items()}
    cells = {name: len(plant.cell_names) for name, plant in plants.items()}
    assert len(WORKING) >= 12
    assert len(REFUSED) >= 5
    assert 27 in cells.values()
    assert max(orders.values()) >= 9
    assert any(plant.B.shape[1] == plant.C.shape[0] == 2 for plant in plants.values())
    assert max(float(np.abs(plant.A).max()) for plant in plants.values()) >= 1e6
