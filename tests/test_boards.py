"""Plants and programs of others: their readers, the rule for an element, and the models that we wrote down for them."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from benchmarks.boards import compleib, drivetrain, drivetrain_design, limited, modelica, page, sdplib
from pwatrack import load_spec, plant


def test_a_file_of_matlab_is_read_by_the_names_of_its_matrices(tmp_path: Path) -> None:
    A, B, C = np.arange(9.0).reshape(3, 3), np.ones((3, 1)), np.eye(2, 3)
    savemat(tmp_path / "some.mat", {"A": A, "B2": B, "C": C, "B1": np.zeros((3, 2))})
    for found, wanted in zip(compleib.matrices(tmp_path / "some.mat"), (A, B, C), strict=True):
        assert np.array_equal(found, wanted)
    savemat(tmp_path / "other.mat", {"A": A, "C": C})
    with pytest.raises(ValueError, match="no B; it has A, C"):
        compleib.matrices(tmp_path / "other.mat")


def test_the_element_is_on_the_state_that_the_first_output_shows_most() -> None:
    A = np.array([[0.0, 1.0, 0.0], [-2.0, -1.0, 0.0], [0.0, 0.0, 0.0]])
    B, C = np.array([[0.0], [1.0], [1.0]]), np.array([[1.0, -2.0, 3.0]])
    assert compleib.shown_most(A, C) == 1  # x3 acts on nothing
    found = load_spec(compleib.sections("three", A, B, C)).problem.plant
    stiffer = A + compleib.SHARE * np.outer(A[:, 1], [0, 1, 0])
    assert np.array_equal(found.A, np.stack([stiffer, A, stiffer]))
    x = np.array([0.0, 1.0, 0.0])
    assert np.allclose(found.A[2] @ x + found.b[2], A @ x)  # continuous at the end of the zone


def test_a_command_ends_with_its_time_and_its_memory() -> None:
    quick = limited.run(["sh", "-c", "echo said; exit 4"], seconds=5, gibibytes=1)
    assert (quick.code, quick.stopped, quick.text) == (4, False, "said\n")
    assert compleib.verdict(quick) == "refused with proof"
    endless = limited.run(["sh", "-c", "while :; do :; done"], seconds=1, gibibytes=1)
    assert endless.stopped
    assert compleib.verdict(endless) == "no time left"


@pytest.mark.parametrize("masses", [0, 1, 3])
def test_the_drivetrain_has_the_field_of_its_bodies(masses: int) -> None:
    """Newton's law for each body, written out here by itself."""
    found, (centre, delta) = plant(**drivetrain.system(masses)).system, drivetrain.start(masses)
    rng = np.random.default_rng(masses)
    for twist in (-0.05, 0.0, 0.05):
        x, u = centre + delta * rng.normal(size=len(centre)), rng.normal()
        x[0] = twist
        torque = 1e4 * (max(0.0, twist - 0.03) + min(0.0, twist + 0.03))
        angles, speeds = [*x[7::2], x[4]], [*x[8::2], x[5]]
        bends = [1e5 * (a - b) for a, b in pairwise(angles)]
        loads = [*zip([torque, *bends], [*bends, 0.0], strict=True)]
        motor = (x[1] - torque / 12) / 0.3
        asked = 0.5 * (12 * x[3] - x[6]) + 0.5 * (12 * u - motor) + 0.5 * 12 * (x[2] - x[0] - angles[0])
        wanted = np.zeros(len(x))
        wanted[:4] = x[6] / 12 - speeds[0], (asked - x[1]) / 0.1, x[3], u
        wanted[4:7] = x[5], (loads[-1][0] - 5.6 * x[5]) / 140, motor
        wanted[7::2] = x[8::2]
        wanted[8::2] = [0.01 * (a - b - v) for (a, b), v in zip(loads[:-1], x[8::2], strict=True)]
        cell = int(twist > -0.03) + int(twist > 0.03)
        assert np.allclose(found.A[cell] @ x + found.b[cell] + found.B[:, 0] * u, wanted, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("masses", [0, 1, 3])
def test_the_drivetrain_without_its_controller_has_the_field_of_its_bodies(masses: int) -> None:
    found, rng = plant(**drivetrain_design.sections(masses)["system"]).system, np.random.default_rng(masses)
    for cell, twist in enumerate((-0.05, 0.0, 0.05)):
        x, u = rng.normal(size=4 + 2 * masses), rng.normal()
        x[0] = twist
        torque = 1e4 * (max(0.0, twist - 0.03) + min(0.0, twist + 0.03))
        bends, speeds = 1e5 * x[3 : 3 + masses], x[3 + masses :]
        loads = [*zip([torque, *bends], [*bends, 0.0], strict=True)]
        rates = [0.01 * (a - b - v) for (a, b), v in zip(loads[:-1], speeds, strict=False)]
        rates.append((loads[-1][0] - 5.6 * x[-1]) / 140)
        wanted = [x[2] / 12 - speeds[0], (u - x[1]) / 0.1, (x[1] - torque / 12) / 0.3, *-np.diff(speeds), *rates]
        assert np.allclose(found.A[cell] @ x + found.b[cell] + found.B[:, 0] * u, wanted, rtol=1e-9, atol=1e-9)


def test_neighbours_of_the_drivetrain_stay_as_near_as_its_form_says() -> None:
    system, (centre, delta) = plant(**drivetrain.system(1)).system, drivetrain.start(1)
    most = drivetrain.spread(system, delta)
    ends = [drivetrain.integrated(system, centre + at * delta) for at in (-0.5, 0.1, 0.7)]
    assert 0 < max(abs(np.diff(ends))) <= 0.6 * most < np.inf


@pytest.mark.parametrize("name", modelica.MODELS)
def test_cells_of_a_model_are_the_formulas_that_integrators_take(name: str) -> None:
    model = modelica.MODELS[name]()
    flow, formula, rng = model.flow(), model.derivative(), np.random.default_rng(3)
    for _ in range(30):
        z = np.append(model.z0[:-1] + 1e-3 * rng.normal(size=len(model.z0) - 1), 1.0)
        F = flow.F0.copy()
        for part in flow.parts:
            values = part.guards @ z
            F += next(F for F, row in zip(part.F, part.signs, strict=True) if (row * values >= 0).all())
        assert np.allclose(F @ z, formula(0.0, z), rtol=1e-9, atol=1e-6)


def test_a_reference_is_read_on_its_grid_after_events(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_text('"time","y"\n0,1\n0.1,2\n0.1,3\n0.15,9\n0.2,4\n', encoding="utf-8")
    numbers, signals = modelica.reference(path, 0.1)
    assert numbers.tolist() == [0, 1, 2]
    assert signals["y"].tolist() == [1, 3, 4]


def test_exact_bounds_of_a_small_program_are_on_both_sides_of_its_optimum(tmp_path: Path) -> None:
    """Least x + y with [x, 1; 1, y] ⪰ 0: 2."""
    path = tmp_path / "small.dat-s"
    path.write_text("2\n1\n2\n1 1\n0 1 1 2 -1\n1 1 1 1 1\n2 1 2 2 1\n", encoding="utf-8")
    found = sdplib.Sides(sdplib.read(path)).bounds()
    assert found[0] is not None
    assert found[1] is not None
    assert 2 - 1e-6 < found[0] <= 2 <= found[1] < 2 + 1e-6


def test_a_program_without_an_interior_has_no_bound_on_that_side(tmp_path: Path) -> None:
    """Least x with diag(x, 0) ⪰ 0: no X is definite."""
    path = tmp_path / "flat.dat-s"
    path.write_text("1\n1\n2\n1\n1 1 1 1 1\n", encoding="utf-8")
    assert sdplib.Sides(sdplib.read(path)).bounds()[1] is None


def test_a_file_that_is_no_program_is_refused_with_its_name(tmp_path: Path) -> None:
    path = tmp_path / "bad.dat-s"
    path.write_text("2\n1\n2\n1\n1 1 1 1 1\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"bad\.dat-s: 2 variables and 1 blocks, but 1 and 1 are given"):
        sdplib.read(path)


def test_the_page_has_each_table_under_its_command(tmp_path: Path) -> None:
    for name in ("sdplib", "modelica"):
        text = limited.table(f"Of {name}, some processor", ["program", "s"], [["a", "1"]])
        (tmp_path / f"{name}.md").write_text(text, encoding="utf-8")
    assert page.page(tmp_path).splitlines()[2:8] == [
        "## Of sdplib, some processor",
        "",
        "    python -m benchmarks.boards.sdplib FOLDER-OR-FILES --vsdp SDPLIB_SYS1.csv",
        "",
        "| program | s |",
        "|---------|---|",
    ]
