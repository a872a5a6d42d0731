"""Refusals that say how far away it is: modes, and what would reach them."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from pwatrack import design, load_spec
from pwatrack.arrays import Array
from pwatrack.claims.practical import Practical
from pwatrack.cli import app
from pwatrack.commands.verify import verify
from pwatrack.control.generator import trajectory_generator
from pwatrack.control.goal import DEFAULT, AtLeast
from pwatrack.control.modes import check_modes
from pwatrack.control.synthesis import gain
from pwatrack.control.task import Task
from pwatrack.errors import Infeasible
from pwatrack.lmi.inequality import CONTROLLER
from pwatrack.lmi.infeasibility import Impossibility
from pwatrack.lmi.polynomial import PolynomialLyapunov
from pwatrack.model.cells import Partition
from pwatrack.model.normal_form import normal_form
from pwatrack.model.pwa import PWASystem
from pwatrack.model.sizes import Sizes
from pwatrack.spec.spec import Spec
from pwatrack.workflow.how_far import HowFar, how_far
from pwatrack.workflow.sizing import spec_sizes

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
    run = CliRunner().invoke(app, ["check", "--verbose", str(path)])
    said = " ".join(run.output.split())
    assert run.exit_code == (4 if words else 0), said
    assert all(word in said for word in words)
    assert ("Theorem 2 no: (" in said) == bool(words)
    assert f"{path}:" in said or not words
    told = json.loads(CliRunner().invoke(app, ["check", str(path), "--json"]).stdout)
    assert len(told["problems"]) == (1 if words else 0)


def test_check_refuses_what_design_refuses(tmp_path: Path) -> None:
    path = tmp_path / "hidden.yaml"
    path.write_text(HIDDEN.format(**OPEN | {"sensor": 0}))
    commands = ["check", str(path)], ["design", str(path), "--out", str(tmp_path / "run")]
    one, two = (CliRunner().invoke(app, command) for command in commands)
    assert one.exit_code == two.exit_code == 4
    assert two.stderr.startswith(one.stderr)


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


@pytest.fixture(scope="module")
def stiff(specs: Path) -> tuple[Spec, HowFar]:
    """The example with k2 = k3 = 1.2, moved together."""
    spec = load_spec(specs / "gallery" / "stiff_springs.yaml", {"k3": "k2"})
    practical = design(spec).claim(Practical)
    evidence = practical.evidence
    assert isinstance(evidence, Impossibility)
    found = how_far(spec, evidence)
    assert found is not None
    return spec, found


@pytest.mark.slow
def test_the_springs_and_dampers_at_which_seventeen_begins_to_hold_are_found_to_four_digits(
    stiff: tuple[Spec, HowFar],
) -> None:
    spec, found = stiff
    at = {p.parameter: p.value for p in found.parameters if p.degree == 2}
    k1, k2, d1, d2 = (spec.parameters[name] for name in ("k1", "k2", "d1", "d2"))
    assert set(at) == {"k1", "k2", "d1", "d2", "m2"}  # c1, c2 and what is on the other mass do not enter
    least = np.sqrt(k1 + k2) - np.sqrt(k1)
    assert at["k2"] == pytest.approx(0.69, rel=1e-4)
    assert at["d1"] + d2 == pytest.approx(least, rel=1e-4)
    assert d1 + at["d2"] == pytest.approx(least, rel=1e-4)
    assert np.sqrt(at["k1"] + k2) - np.sqrt(at["k1"]) == pytest.approx(d1 + d2, rel=1e-4)
    assert found.parameters[0].parameter == "k2"
    higher = {p.parameter: p for p in found.parameters if p.degree > 2}
    assert higher["k2"].value == pytest.approx(1.1129, rel=1e-4)
    assert {p.degree for p in higher.values()} == {10}
    for name, p in higher.items():
        assert abs(p.value - p.now) < abs(at[name] - p.now)


@pytest.mark.slow
def test_each_value_is_one_with_which_it_is_designed(specs: Path, stiff: tuple[Spec, HowFar]) -> None:
    path = specs / "gallery" / "stiff_springs.yaml"
    wanted = [p for p in stiff[1].parameters if p.parameter in ("k2", "d1")]
    assert [p.degree for p in wanted] == [2, 2, 10, 10]
    for p in wanted:
        spec = load_spec(path, {"k3": "k2", p.parameter: p.value})
        form = trajectory_generator(normal_form(spec.problem.plant))
        degree = form.certificate.degree if isinstance(form.certificate, PolynomialLyapunov) else 2
        assert degree == p.degree
        beyond = p.value * (1 + 2e-4 * np.sign(p.now - p.value))
        nearer = load_spec(path, {"k3": "k2", p.parameter: beyond})
        try:
            found = trajectory_generator(normal_form(nearer.problem.plant)).certificate
            assert p.degree == 2
            assert isinstance(found, PolynomialLyapunov)
        except Infeasible:
            assert p.degree == 10


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ("{far: 3}", "no parameter of the file enters it: what has a name under 'parameters' is looked at"),
        ("{far: 3, push: -3}", "(8) is proved with push = -0.99"),
    ],
)
def test_a_file_whose_parameters_do_not_enter_is_told_so(tmp_path: Path, parameters: str, words: str) -> None:
    """From push = −1 on the input turns round on the way from one cell to the next."""
    push = "push" if "push" in parameters else "-3"
    path = tmp_path / "turned.yaml"
    path.write_text(
        f"""\
name: turned
parameters: {parameters}
system:
  states: [v, p]
  inputs: [u]
  outputs: [y, z]
  A: [[0, 0], [1, 1]]
  B: [[1], [0]]
  C: [[1, 0], [0, 1]]
  nonlinearities: [{{name: valve, kind: spring, of: v, start: far, slope: 1, into: {{p: {push}}}}}]
design: {{tracking: state}}
reference: {{setpoint: {{y: 0, z: 0}}}}
simulation: {{duration: 5, sample_time: 0.01}}
"""
    )
    run = CliRunner().invoke(app, ["design", str(path), "--out", str(tmp_path / "out")])
    assert run.exit_code == 4
    assert words in " ".join(run.stderr.split())


@pytest.mark.slow
def test_a_refused_rate_is_told_the_largest_one_that_is_proved(specs: Path, tmp_path: Path) -> None:
    path = specs / "refused" / "rate_out_of_reach.yaml"
    run = CliRunner().invoke(app, ["design", str(path), "--out", str(tmp_path)])
    said = " ".join(run.stderr.split())
    assert run.exit_code == 4
    (rate,) = re.findall(r"how far: \(8\) is proved at a rate of ([0-9.]+) 1/s \(asked: 0\.3 1/s\)", said)
    assert 0.248 < float(rate) < 0.25
    told = json.loads((tmp_path / "run.json").read_text())["how_far"]
    assert told["inequality"] == "(8)"
    assert told["rate"] == {"asked": 0.3, "proved": float(rate)}
    at = {p["name"]: p for p in told["parameters"]}
    assert all(f"{name} = {p['proved']:g} (now {p['now']:g})" in said for name, p in at.items())
    assert "c1" not in at
    for name, p in at.items():
        spec = load_spec(path, {name: p["proved"]})
        task = Task.of(spec.problem.plant, CONTROLLER, sizes=spec_sizes(spec))
        assert gain(task, spec.objectives.controller)[1].rate >= 0.3, name
    assert verify(tmp_path, path)


def test_what_no_parameter_mends_is_said_so(specs: Path, tmp_path: Path) -> None:
    path = specs / "refused" / "printed_gains.yaml"
    run = CliRunner().invoke(app, ["design", str(path), "--out", str(tmp_path)])
    assert run.exit_code == 4
    assert "how far: (8): no value of a single parameter was found with which it is proved" in run.stderr
    assert json.loads((tmp_path / "run.json").read_text())["how_far"]["parameters"] == []


def test_values_that_make_a_matrix_singular_to_rounding_lose_no_refusal(tmp_path: Path) -> None:
    """Both vessels together hold as much as they did: an eigenvalue is 0 whatever the parameters are."""
    path = tmp_path / "vessels.yaml"
    path.write_text("""\
name: Closed loop of two vessels
parameters: {R: 1.0, Ca: 1.5, Cv: 10, L: 0.05, Rl: 0.1, ks: 3, P: 2}
system:
  states: [pa, pv, q]
  inputs: [H]
  outputs: [flow]
  A: [[-1/(R*Ca), 1/(R*Ca), 1/Ca], [1/(R*Cv), -1/(R*Cv), -1/Cv], [-1/L, 1/L, -Rl/L]]
  B: [[0], [0], [1/L]]
  C: [[0, 0, 1]]
  nonlinearities: [{name: suction, kind: spring, of: -pv, start: -P, slope: ks, into: {q: -1/L}}]
reference: {output: "80+20*sin(7*t)"}
simulation: {duration: 20, sample_time: 0.01}
""")
    run = CliRunner().invoke(app, ["design", str(path), "--out", str(tmp_path / "out")])
    assert run.exit_code == 4
    assert "no value of a single parameter was found" in run.stderr


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
