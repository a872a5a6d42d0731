"""A mean of cells whose mode no gain moves: found, proved, audited, and told; where there is a gain, nothing is."""

import copy
import json
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.preview import spec_text
from pwatrack import design, load_spec
from pwatrack.arrays import Array
from pwatrack.ball_matrix import text
from pwatrack.cli import app
from pwatrack.errors import Infeasible
from pwatrack.lmi.audit.certificate import audit
from pwatrack.lmi.infeasibility import Impossibility, Refutation
from pwatrack.lmi.uncontrollable import Between, uncontrollable_mean
from pwatrack.rational import decimals
from pwatrack.report.certificate import refusal_certificate

TURNED = """\
name: two masses that one force pushes
system:
  states: [v, p, q]
  inputs: [u]
  outputs: [y, a, b]
  track: [y]
  A: [[0, 0, 0], [1, 1, 0], [1, 0, 2]]
  B: [[1], [0], [0]]
  C: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
  nonlinearities: [{name: valve, kind: spring, of: v, start: 0.5, slope: 1, into: {p: GAIN, q: -3}}]
design: {tracking: state}
reference: {setpoint: {y: 0}}
simulation: {duration: 5, sample_time: 0.01}
"""


def found_in(A: Array, B: Array) -> Between | None:
    return uncontrollable_mean(A, B, [decimals(A_i) for A_i in A], decimals(B))


def reach(A: Array, B: Array, found: Between) -> float:
    """Return how far [Σ w_i A_i − μ I, B] is from a matrix of less than full rank, relative to its size."""
    mean = sum(float(w) * A[i] for i, w in found.weights.items())
    values = np.linalg.svd(np.hstack([mean - float(found.eigenvalue) * np.eye(len(B)), B]), compute_uv=False)
    return float(values[-1] / values[0])


@pytest.mark.slow
@pytest.mark.parametrize("seed", [6, 51, 63, 95])
def test_random_plants_without_a_gain_are_proved_to_have_none(tmp_path: Path, seed: int) -> None:
    """No rational multipliers speak against these: the modes and the means are irrational."""
    path = tmp_path / "plant.yaml"
    path.write_text(spec_text(seed), encoding="utf-8")
    spec = load_spec(path)
    with pytest.raises(Infeasible, match=r"\(8\) is infeasible: it is about every mean of cells") as refused:
        design(spec)
    evidence, plant = refused.value.evidence, spec.problem.plant
    assert isinstance(evidence, Impossibility)
    assert isinstance(evidence.refutation, Refutation)
    assert evidence.refutation.between is not None
    assert reach(plant.A, plant.B, evidence.refutation.between) < 1e-14
    assert audit(json.dumps(refusal_certificate(spec, evidence)))[1] == []


@pytest.mark.parametrize("seed", [0, 2, 41, 56])
def test_where_a_gain_is_proved_no_mean_is_stuck(tmp_path: Path, seed: int) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(spec_text(seed), encoding="utf-8")
    spec = load_spec(path)
    plant = spec.problem.plant
    assert design(spec).design.controller.rate > 0
    assert found_in(plant.A, plant.B) is None


@pytest.mark.parametrize("inputs", [1, 2])
def test_what_is_found_has_a_mode_out_of_reach_and_a_mean_of_cells(inputs: int) -> None:
    """Cells that differ by as many products g hᵀ as there are inputs, in coordinates of all sizes."""
    count = 0
    for seed in range(60):
        random = np.random.default_rng(seed)
        n = int(random.integers(inputs + 2, 7))
        T = np.linalg.qr(random.normal(size=(n, n)))[0] * 10.0 ** random.uniform(-2, 2, size=n)
        first = random.normal(size=(n, n)) + np.eye(n)
        bends = [np.outer(random.normal(size=n), random.normal(size=n)) for _ in range(inputs)]
        A = np.array([first, *(first + bend for bend in bends), first + sum(bends)])[: 2**inputs]
        A, B = T @ A @ np.linalg.inv(T), T @ random.normal(size=(n, inputs))
        found = found_in(A, B)
        if found is not None:
            count += 1
            assert sum(found.weights.values()) == 1
            assert min(found.weights.values()) > 0 < found.eigenvalue
            assert len(found.weights) == inputs + 1
            assert reach(A, B, found) < 1e-12
            assert np.abs(found.v @ B).max() < 1e-12 * np.abs(found.v).max() * np.abs(B).max()
    assert count > 5


@pytest.mark.parametrize("seed", range(4))
def test_units_do_not_matter(tmp_path: Path, seed: int) -> None:
    """States in units that differ by 1e18, time in others: the same shares, and the same eigenvalue in the new unit."""
    path, random = tmp_path / "plant.yaml", np.random.default_rng(seed)
    path.write_text(spec_text(63), encoding="utf-8")
    plant = load_spec(path).problem.plant
    known = found_in(plant.A, plant.B)
    d, speed = 10.0 ** random.uniform(-9, 9, size=len(plant.B)), 10.0 ** int(random.integers(-6, 7))
    found = found_in(plant.A / d[:, None] * d * speed, plant.B / d[:, None] * 10.0 ** random.uniform(-9, 9))
    assert known is not None
    assert found is not None
    assert float(found.eigenvalue) == pytest.approx(float(known.eigenvalue) * speed, rel=1e-6)
    shares = [[float(share) for share in one.weights.values()] for one in (found, known)]
    assert shares[0] == pytest.approx(shares[1], rel=1e-6)


def test_a_mode_that_decays_is_no_obstacle() -> None:
    """An actuator that is turned round on the way, where what it then does not reach decays by itself."""
    for pole, stuck in ((1.0, True), (-1.0, False)):
        A = np.array([[[0.0, 0.0], [push, pole]] for push in (1.0, -2.0)])
        assert (found_in(A, np.array([[1.0], [0.0]])) is not None) == stuck


@pytest.mark.parametrize("gain", ["-0.5", "2"])
def test_check_and_design_say_it_and_verify_proves_it(tmp_path: Path, gain: str) -> None:
    """The force pushes p and q by 1 and 1, beyond 0.5 m/s by 1 + gain and −2."""
    path, out = tmp_path / "plant.yaml", tmp_path / "out"
    path.write_text(TURNED.replace("GAIN", gain), encoding="utf-8")
    check = CliRunner().invoke(app, ["check", str(path)])
    said = " ".join(check.output.split())
    assert check.exit_code == 4
    assert "no gain moves the eigenvalue 2 of 0.66667 of cell 'valve off' and 0.33333 of cell 'valve on'" in said
    assert "any that acts on dq/dt does, or cells that differ less" in said
    run = CliRunner().invoke(app, ["design", str(path), "--out", str(out)])
    assert run.exit_code == 4
    assert run.stderr.startswith(check.stderr)
    told = CliRunner().invoke(app, ["verify", str(out)])
    assert told.exit_code == 0, told.output
    assert "by a mode that no gain moves of a mean of 'valve off', 'valve on'" in " ".join(told.output.split())


CHANGES: list[tuple[str, Callable[[Any], Any]]] = [
    ("between", lambda w: dict(zip(reversed(w), w.values(), strict=True))),
    ("between", lambda w: {cell: str(float(share) * 1.1) for cell, share in w.items()}),
    ("between", lambda w: dict.fromkeys(w, "0.5")),
    ("between", lambda w: dict(zip(w, ["2", "-1"], strict=True))),
    ("between", lambda w: dict.fromkeys(list(w)[:1], "1")),
    ("rows", lambda rows: rows[:1]),
    ("rows", lambda rows: [rows[0], *rows[:-1]]),
    ("rows", lambda rows: [["1", *row[1:]] for row in rows]),
    ("mode", lambda z: z[::-1]),
    ("mode", lambda z: ["0" for _ in z]),
    ("mode", lambda z: [*z[:-1], "1/7"]),
    ("eigenvalue", lambda mu: "-" + mu),
    ("eigenvalue", lambda mu: "9" + mu),
    ("inverse", lambda C: [["0" for _ in row] for row in C]),
    ("inverse", lambda C: C[:-1]),
    ("radius", lambda r: r[:0] + "0"),
    ("radius", lambda r: r.partition("/")[0]),
    ("radius", lambda r: "-" + r),
    ("rate", lambda rate: "1" + rate),
    ("rate", lambda rate: "-1" + rate),
]


@pytest.fixture(scope="module")
def content(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The proof for a plant of four states, as it stands in the file."""
    path = tmp_path_factory.mktemp("refused") / "plant.yaml"
    path.write_text(spec_text(61), encoding="utf-8")
    spec = load_spec(path)
    with pytest.raises(Infeasible) as refused:
        design(spec)
    assert isinstance(refused.value.evidence, Impossibility)
    found = json.loads(json.dumps(refusal_certificate(spec, refused.value.evidence)))
    assert audit(json.dumps(found))[1] == []
    return found


@pytest.mark.parametrize(("part", "change"), CHANGES)
def test_a_tampered_proof_is_refused(content: Any, part: str, change: Any) -> None:
    tampered = copy.deepcopy(content)
    tampered["proofs"][0][part] = change(tampered["proofs"][0][part])
    assert audit(json.dumps(tampered))[1] != []


def test_a_proof_is_one_of_its_plant_only(content: Any) -> None:
    """With the unstable modes moved, or another input, it proves nothing."""
    for name in ("A", "B"):
        tampered = copy.deepcopy(content)
        row = tampered["plant"][name][1]  # its cells are written by elements: one A for all
        row[0] = text(Fraction(row[0]) + Fraction(1, 10**6))
        assert audit(json.dumps(tampered))[1] != []
