import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from pwatrack import load_spec, simulate
from pwatrack.cli import app
from pwatrack.commands.compare import names_of, read_run
from pwatrack.errors import InvalidSpec
from pwatrack.report.files import write_result


@pytest.fixture(scope="module")
def runs(specs: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two runs of an output that is tracked, and one of states."""
    folder = tmp_path_factory.mktemp("runs")
    text = (specs / "two_mass_paper_gains.yaml").read_text(encoding="utf-8").replace("duration: 60", "duration: 2")
    (folder / "paper.yaml").write_text(text, encoding="utf-8")
    state = (specs / "gallery" / "two_rooms.yaml").read_text(encoding="utf-8")
    (folder / "rooms.yaml").write_text(state, encoding="utf-8")
    for name, spec, k2 in (("a/run", "paper", {}), ("b/run", "paper", {"k2": 0.35}), ("rooms", "rooms", {})):
        result = simulate(load_spec(folder / f"{spec}.yaml", k2))
        write_result(result, folder / name, plots="none")
        np.save(folder / name / "expected.npy", result.response.error_norm)
    return [folder / "a" / "run", folder / "b" / "run", folder / "rooms"]


@pytest.mark.slow
def test_the_error_that_is_read_is_that_of_the_run(runs: list[Path]) -> None:
    for folder in runs:
        run = read_run(folder)
        assert np.allclose(run.error, np.load(folder / "expected.npy"), rtol=1e-9, atol=1e-15)
        assert len(run.t) == len(run.error)


def test_names_have_as_much_as_tells_them_apart(runs: list[Path]) -> None:
    assert names_of([read_run(folder) for folder in runs]) == ["a/run", "b/run", f"{runs[2].parent.name}/rooms"]
    assert names_of([read_run(runs[0])]) == ["run"]


def test_figures_stand_beside_each_other_and_errors_in_one_picture(runs: list[Path], tmp_path: Path) -> None:
    picture = tmp_path / "errors.png"
    run = CliRunner().invoke(app, ["compare", *map(str, runs), "--picture", str(picture)], env={"COLUMNS": "150"})
    assert run.exit_code == 0, run.output
    row = next(line for line in run.stdout.splitlines() if "norm_K" in line)
    assert len(re.findall(r"\d\.\d+", row)) == 3
    assert picture.stat().st_size > 1_000


def test_what_tells_no_run_is_refused(runs: list[Path], tmp_path: Path) -> None:
    with pytest.raises(InvalidSpec, match="tells no run"):
        read_run(tmp_path)
    broken = shutil.copytree(runs[2], tmp_path / "broken")
    (broken / "trace.csv").write_text("t\n")
    with pytest.raises(InvalidSpec, match="cannot read"):
        read_run(broken)
    run = CliRunner().invoke(app, ["compare", *[str(runs[0])] * 21])
    assert run.exit_code == 2
    assert "at most 20" in run.stderr


def test_a_refusal_stands_beside_a_run(runs: list[Path], specs: Path, tmp_path: Path) -> None:
    refused = tmp_path / "refused"
    CliRunner().invoke(app, ["simulate", str(specs / "refused" / "printed_A1.yaml"), "--out", str(refused)])
    run = CliRunner().invoke(app, ["compare", str(runs[0]), str(refused)], env={"COLUMNS": "150"})
    assert run.exit_code == 0, run.output
    assert "outside the theory" in run.stdout
