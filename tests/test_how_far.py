"""Refusals that say how far away it is: modes, and what would reach them."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from pwatrack import Partition, PWASystem
from pwatrack.arrays import Array
from pwatrack.cli import app
from pwatrack.control.goal import DEFAULT, AtLeast
from pwatrack.control.modes import check_modes
from pwatrack.errors import Infeasible
from pwatrack.model.sizes import Sizes

HIDDEN = """\
name: hidden
system:
  states: [z, v, w]
  inputs: [u]
  outputs: [y]
  B: [[0], [1], [{push}]]
  C: [[1, 0, {sensor}]]
  cells:
    - {{name: free, where: ["z <= 0.05"], A: [[0, 1, 0], [0, -0.3, {back}], [0, {forth}, 0.1]]}}
    - {{name: touching, where: ["z >= 0.05"], A: [[0, 1, 0], [-1, -0.3, {back}], [0, {forth}, 0.1]], b: [0, 0.05, 0]}}
design: {{tracking: state}}
reference: {{setpoint: {{y: 0}}}}
simulation: {{duration: 60, sample_time: 0.1}}
"""
OPEN = {"push": 0, "sensor": 1, "back": 0, "forth": 0.2}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sensor": 0}, ["(9) is infeasible: no gain moves the eigenvalue 0.1 in cell 'free'", "a sensor of w does"]),
        ({"forth": 0, "back": 1}, ["(8) is infeasible: no gain moves the eigenvalue 0.1", "that acts on dw/dt does"]),
        ({"push": 1}, []),
    ],
)
def test_check_refuses_a_mode_that_no_gain_moves_and_says_what_would_reach_it(
    tmp_path: Path, changes: dict[str, float], words: list[str]
) -> None:
    path = tmp_path / "hidden.yaml"
    path.write_text(HIDDEN.format(**OPEN | changes))
    run = CliRunner().invoke(app, ["check", str(path)])
    said = " ".join(run.output.split())
    assert run.exit_code == (4 if words else 0), said
    assert all(word in said for word in words)
    assert "Theorem 2" in said
    assert f"{path}:" in said or not words
    told = json.loads(CliRunner().invoke(app, ["check", str(path), "--json"]).stdout)
    assert len(told["problems"]) == (1 if words else 0)


def test_check_refuses_what_design_refuses(tmp_path: Path) -> None:
    path = tmp_path / "hidden.yaml"
    path.write_text(HIDDEN.format(**OPEN | {"sensor": 0}))
    commands = ["check", str(path)], ["design", str(path), "--out", str(tmp_path / "run")]
    one, two = (CliRunner().invoke(app, command) for command in commands)
    assert one.exit_code == two.exit_code == 4
    assert one.stderr.splitlines() == two.stderr.splitlines()[:2]


def test_given_gains_that_a_cell_is_unstable_with_are_refused_by_check(specs: Path) -> None:
    run = CliRunner().invoke(app, ["check", str(specs / "refused" / "printed_gains.yaml")])
    assert run.exit_code == 4
    assert "(8) for the given gain K is infeasible" in run.stderr
    assert "(9) for the given gain L is infeasible" in run.stderr


@pytest.mark.parametrize("seed", range(12))
def test_a_hidden_mode_is_found_in_any_coordinates_and_what_is_named_reaches_it(seed: int) -> None:
    random = np.random.default_rng(seed)
    n = int(random.integers(2, 6))
    tenths, B = random.integers(-20, 20, size=(n, n)), random.integers(1, 4, size=(n, 1)).astype(float)
    tenths[0, 1:], B[0] = 0, 0
    tenths[0, 0] = mode = int(random.choice([0, 5, 20]))
    T = np.tril(random.integers(-2, 3, size=(n, n)), -1) + np.eye(n, dtype=int)  # whole numbers, and so is its inverse
    A = (T @ tenths @ np.round(np.linalg.inv(T))) / 10
    plant = linear(A, T @ B)
    with pytest.raises(Infeasible, match=rf"the eigenvalue {mode / 10:g} in cell") as refused:
        check_modes(plant, DEFAULT, DEFAULT, Sizes.of(plant))
    named = re.findall(r"dx(\d)/dt", refused.value.problems[0].hint)
    for k in map(int, named):
        wider = linear(A, np.hstack([T @ B, np.eye(n)[:, [k]]]))
        check_modes(wider, DEFAULT, DEFAULT, Sizes.of(wider))
    assert named
    seen = linear(A.T, np.eye(n), (T @ B).T)
    with pytest.raises(Infeasible, match=r"\(9\) is infeasible: no gain moves") as refused:
        check_modes(seen, DEFAULT, DEFAULT, Sizes.of(seen))
    for k in map(int, re.findall(r"x(\d)\b", refused.value.problems[0].hint)):
        wider = linear(A.T, np.eye(n), np.vstack([(T @ B).T, np.eye(n)[[k]]]))
        check_modes(wider, DEFAULT, DEFAULT, Sizes.of(wider))


def test_a_mode_that_decays_too_slowly_for_the_rate_asked_is_refused() -> None:
    plant = linear(np.diag([-0.5, -3.0]), np.array([[0.0], [1.0]]), np.ones((1, 2)))
    check_modes(plant, AtLeast(rate=0.4), DEFAULT, Sizes.of(plant))
    said = r"at a rate of 0\.6 1/s is infeasible: no gain moves the eigenvalue -0\.5"
    with pytest.raises(Infeasible, match=said) as no:
        check_modes(plant, AtLeast(rate=0.6), DEFAULT, Sizes.of(plant))
    assert "dx0/dt" in no.value.problems[0].hint


def linear(A: Array, B: Array, C: Array | None = None) -> PWASystem:
    """One cell, all states measured by default."""
    n = len(A)
    return PWASystem.create(
        partition=Partition.create(H=np.zeros((0, n)), h=[], signs=[[]], names=["all"]),
        A=A[None],
        b=np.zeros((1, n)),
        B=B,
        C=np.eye(n) if C is None else C,
        states=[f"x{k}" for k in range(n)],
    )
