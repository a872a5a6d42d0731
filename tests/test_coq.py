"""A certificate for Coq: the numbers that are written are those of the run, and the kernel takes no others."""

import json
import re
import shutil
import subprocess
from importlib.resources import files
from pathlib import Path
from typing import Any

import flint
import numpy as np
import pytest
from numpy.testing import assert_allclose

from pwatrack import Result, Spec, design, load_spec
from pwatrack.errors import ExitCode, InvalidSpec
from pwatrack.export.coq import RUN, THEORY, development
from pwatrack.lmi.audit.reading import parsed
from pwatrack.lmi.audit.shape import PROOFS
from pwatrack.report.files import write_design
from tests.conftest import SPECS
from tests.coq_numbers import gains_hold, observer_holds, written
from tests.test_cli import call, refused

coq = pytest.mark.skipif(shutil.which("coqc") is None, reason="there is no coqc here (Coq 8.16 with Bignums)")


@pytest.fixture(scope="module")
def run(paper_spec: Spec, paper: Result, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_design(paper_spec, paper.controller, tmp_path_factory.mktemp("coq") / "two_mass")


@pytest.fixture(scope="module")
def content(run: Path) -> Any:
    return parsed((run / "certificate.json").read_text(encoding="utf-8"))


def test_the_numbers_are_those_of_the_run(content: Any, paper: Result) -> None:
    """Another reader finds K and L in them, and the inequalities hold for these."""
    found = written(development(content, "two_mass")[f"{RUN}.v"])
    for name, gain in (("K", paper.controller.K), ("L", paper.controller.L)):
        assert [[v / found["D"] for v in row] for row in found[name]] == gain.tolist()
    for i, A in enumerate(paper.controller.plant.A):
        assert [[v / found["D"] for v in row] for row in found["A"][i]] == A.tolist()
    assert gains_hold(found)
    assert observer_holds(found)
    product = flint.fmpz_mat(found["P"]) * flint.fmpz_mat(found["W"])
    assert product.tolist() == [[found["d"] * (i == j) for j in range(4)] for i in range(4)]
    assert min(found["alpha"], found["beta"]) / found["D"] == pytest.approx(paper.controller.guarantees.rate, rel=1e-12)


@pytest.mark.parametrize(
    "name", ["two_mass_machine", "gallery/payload_in_wind", pytest.param("gallery/gantry", marks=pytest.mark.slow)]
)
def test_the_cells_that_are_written_cover_the_space_with_the_field_of_the_plant(name: str, tmp_path: Path) -> None:
    """So there is an f of which the theorem speaks, and it is that of the plant with its loads."""
    spec = load_spec(SPECS / f"{name}.yaml")
    controller = design(spec)
    plant, folder = controller.plant, write_design(spec, controller, tmp_path / "run")
    content = parsed((folder / "certificate.json").read_text(encoding="utf-8"))
    found, n = written(development(content, "run")[f"{RUN}.v"]), len(plant.B)
    assert gains_hold(found)
    assert observer_holds(found)
    A, b, B, C = (np.array(found[key], dtype=float) / found["D"] for key in ("A", "b", "B", "C"))
    E = np.zeros((n, len(B) - n)) if plant.loads is None else plant.loads.E.floats
    assert_allclose(B, np.vstack([plant.B, np.zeros((len(B) - n, plant.B.shape[1]))]))
    assert_allclose(C[:, :n], plant.C)
    for z in np.random.default_rng(0).normal(size=(200, len(B))) * 3:
        x, s = z[:n], z[n:]
        inside = [i for i, rows in enumerate(found["cells"]) if all(np.dot(row, x) + c >= 0 for row, c in rows)]
        assert len(inside) == 1, "but on facets"
        felt = plant.field(x, np.zeros(plant.B.shape[1])) + E @ s
        assert_allclose(A[inside[0]][:n] @ z + b[inside[0]][:n], felt, rtol=1e-12, atol=1e-9)


def test_what_the_theory_does_not_speak_of_is_said(content: Any) -> None:
    proofs = [proof for proof in content["proofs"] if proof["of"] != "observer"]
    with pytest.raises(InvalidSpec, match="the observer is not proved by a quadratic form"):
        development(content | {"proofs": proofs}, "two_mass")
    impossible = [dict.fromkeys(PROOFS["multipliers"], "0")]
    with pytest.raises(InvalidSpec, match="proves that something is impossible"):
        development(content | {"proofs": impossible, "K": None, "L": None}, "two_mass")


def test_the_command_writes_it_and_refuses_a_forged_one(run: Path, tmp_path: Path) -> None:
    done = call("certify", run, "--out", tmp_path / "coq")
    assert done.exit_code == 0, done.output
    assert "make -C" in done.stdout
    names = {path.name for path in (tmp_path / "coq").iterdir()}
    assert names == {f"{part}.v" for part in (*THEORY, RUN)} | {"Makefile"}
    forged = json.loads((run / "certificate.json").read_text(encoding="utf-8"))
    forged["K"][0][0] = "14"
    (tmp_path / "certificate.json").write_text(json.dumps(forged), encoding="utf-8")
    assert "controller" in refused(call("certify", tmp_path, "--out", tmp_path / "none"), ExitCode.CHECK_FAILED)
    assert not (tmp_path / "none").exists()


def test_the_theory_takes_nothing_without_proof() -> None:
    text = "\n".join(files("pwatrack.export").joinpath(f"theory/{part}.v").read_text() for part in THEORY)
    assert not re.findall(r"\b(Admitted|admit|Axiom|Parameter|Conjecture|give_up)\b", text)
    assert text.count("Proof.") == text.count("Qed.") == len(re.findall(r"^(?:Lemma|Theorem) ", text, re.MULTILINE))
    assert len(text.splitlines()) <= 1500


@coq
@pytest.mark.slow
def test_the_kernel_takes_it_and_no_other_gain(content: Any, tmp_path: Path) -> None:
    for name, text in development(content, "two_mass").items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    done = subprocess.run(["make"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    axioms = set(re.findall(r"^([\w.]+)\s*:", done.stdout.split("Axioms:")[1], re.MULTILINE))
    of_reals = {"Classical_Prop.classic", "FunctionalExtensionality.functional_extensionality_dep"}
    of_reals |= {f"ClassicalDedekindReals.{name}" for name in ("sig_forall_dec", "sig_not_dec")}
    assert {axiom for axiom in axioms if not axiom.startswith(("Uint63.", "PrimInt63."))} == of_reals
    spoiled = development(content | {"K": [["14", "-5.6", "1.1", "-1.1"]]}, "two_mass")[f"{RUN}.v"]
    (tmp_path / f"{RUN}.v").write_text(spoiled, encoding="utf-8")
    done = subprocess.run(["coqc", f"{RUN}.v"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "controller_proved" in done.stderr
