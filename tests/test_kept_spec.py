"""The spec that a run was made from stays with it: its own copy and tables come before any file of that name."""

import shutil
from pathlib import Path

import numpy as np
import pytest

import pwatrack
from pwatrack.commands.verify import verify
from pwatrack.errors import CheckFailed
from tests.scenarios import mass
from tests.test_cli import call
from tests.test_courses import rows

SINE = '"0.1*sin(t)"'
T = np.linspace(0, 2, 21)


def belongs(run: Path) -> list[str]:
    """Return what `verify` says of the spec of a run."""
    return [said for said in verify(run) if said.startswith("it belongs") or "other bytes" in said]


def cart(output: str, acts: str = "") -> str:
    simulation = f"{{{acts}duration: 1, sample_time: 0.1, controller: {{sample_time: 0.01}}}}"
    return mass(reference=f"{{output: {output}}}", simulation=simulation)


def made(folder: Path, output: str = SINE, *options: str, acts: str = "") -> Path:
    """Design a cart in a folder, and return the run, which is in `folder/runs/cart`."""
    folder.mkdir(exist_ok=True)
    (folder / "cart.yaml").write_text(cart(output, acts), encoding="utf-8")
    done = call("design", folder / "cart.yaml", "--out", folder / "runs" / "cart", *options)
    assert done.exit_code == 0, done.output
    return folder / "runs" / "cart"


def test_a_folder_without_a_design_says_why_and_another_plant_is_said_to_be_one(tmp_path: Path) -> None:
    text = cart(SINE).replace("duration: 1", "actuator: {limits: {u: [5, 6]}}, duration: 1")
    (tmp_path / "cart.yaml").write_text(text, encoding="utf-8")
    folder = tmp_path / "refused"
    assert call("design", tmp_path / "cart.yaml", "--out", folder).exit_code == 3
    for said in (call("verify", folder), call("export", "c", folder, "--out", tmp_path / "c")):
        assert said.exit_code == 2
        assert "its run was refused (exit 3), so there is no c" in said.output
        assert "the reference takes u = " in " ".join(said.output.split())
    assert "so it is no folder of a run" in call("verify", tmp_path).output
    run = made(tmp_path / "good")
    specs = Path(__file__).parent.parent / "specs"
    with pytest.raises(CheckFailed) as caught:
        verify(run, specs / "two_mass_backlash.yaml")
    assert "K and L are no gains of the plant of" in str(caught.value)
    assert "ValueError" not in str(caught.value)


def test_the_own_copy_comes_first_and_a_changed_file_of_its_name_is_a_remark(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run = made(Path())
    same = f"it belongs to {run / 'spec.txt'}: same plant, gains and goals"
    assert belongs(run) == [same]
    Path("cart.yaml").write_text(cart('"0.2*sin(t)"'), encoding="utf-8")
    assert belongs(run) == [same, "cart.yaml has other bytes than the spec it was made for, and was not looked at"]
    (tmp_path / "runs" / "cart.yaml").write_text(cart(SINE), encoding="utf-8")
    assert belongs(run) == [same]  # the file of that name that is as it was read is nearer to the run
    with pytest.raises(CheckFailed, match=r"cart\.yaml has other bytes"):
        verify(run, Path("cart.yaml"))


def test_a_copy_that_was_changed_is_not_what_the_run_was_made_from(tmp_path: Path) -> None:
    run = made(tmp_path)
    (run / "spec.txt").write_text("name: another\n", encoding="utf-8")
    assert belongs(run) == [f"it belongs to {tmp_path / 'cart.yaml'}: same plant, gains and goals"]
    (tmp_path / "cart.yaml").unlink()
    assert call("verify", run).exit_code != 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["data/course.csv", "../elsewhere/course.csv"])
def test_a_run_of_tables_is_moved_with_them(tmp_path: Path, name: str) -> None:
    home = tmp_path / "home"
    for folder in ("home/data", "elsewhere"):
        (tmp_path / folder).mkdir(parents=True)
    for file, size in ((name, 0.1), ("other.csv", 0.2)):
        (home / file).write_text(rows(T, size * np.sin(T)), encoding="utf-8")
    output = f"{{table: {{file: {name}, filter: {{cutoff: 4}}}}}}"
    run = made(home, output, "--allow-outside", acts="disturbance: {v: {table: {file: other.csv}}}, ")
    kept = [(run / f"table_{k}.csv").read_text(encoding="utf-8") for k in (1, 2)]
    assert kept == [(home / file).read_text(encoding="utf-8") for file in (name, "other.csv")]
    moved = tmp_path / "moved"
    shutil.move(run, moved)
    for folder in ("home", "elsewhere"):
        shutil.rmtree(tmp_path / folder)
    assert belongs(moved) == [f"it belongs to {moved / 'spec.txt'}: same plant, gains and goals"]
    done = call("export", "c", moved, "--out", tmp_path / "code", "--name", "loop")
    assert done.exit_code == 0, done.output
    assert "is from the exact simulation of its spec" in " ".join((tmp_path / "code/README.md").read_text().split())
    again = call("verify", moved, "--spec", moved / "spec.txt")
    assert again.exit_code == 0, again.output
    (moved / "table_1.csv").write_text(rows(T, 0.05 * np.sin(T)), encoding="utf-8")
    with pytest.raises(CheckFailed, match=r"trajectory.* in controller\.json"):
        verify(moved)
    (moved / "table_1.csv").unlink()
    alone = "not compared with a spec: none is at hand; name it with --spec; controller.json, "
    assert any(said.startswith(alone) for said in verify(moved))


def test_a_problem_from_python_keeps_its_tables_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("course.csv").write_text(rows(T, 0.1 * np.sin(T)), encoding="utf-8")
    made_of = pwatrack.plant(A=[[0, 1], [-1, -1]], B=[[0], [1]], C=[[1, 0]])
    reference = {"output": {"table": {"file": "course.csv", "filter": {"cutoff": 4}}}}
    asked = pwatrack.problem(made_of, reference=reference, simulation={"duration": 1, "sample_time": 0.1})
    pwatrack.design(asked).save("run")
    Path("course.csv").unlink()
    assert belongs(Path("run")) == ["it belongs to run/from_python.yaml: same plant, gains and goals"]
