"""Exact proofs, their independent audit, and exact decisions on stability."""

import json
import subprocess
import sys
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pwatrack import design, load_spec, write_design
from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix
from pwatrack.control.convergence import best_certificate, prove_convergence
from pwatrack.errors import CheckFailed, Infeasible, Undecided
from pwatrack.lmi import audit as auditor
from pwatrack.lmi.exact import prove_exactly
from pwatrack.rational import decimals, is_hurwitz, unreachable
from pwatrack.report.verify import verify

seeds = st.integers(0, 10_000)


def fractions(X: Array) -> list[list[Fraction]]:
    return [[Fraction(repr(float(v))) for v in row] for row in X]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, specs: Path) -> Path:
    spec = load_spec(specs / "two_mass_backlash.yaml")
    return write_design(spec, design(spec), tmp_path_factory.mktemp("run"))


def test_a_design_is_verified_from_its_file(run: Path) -> None:
    said = verify(run)
    assert [s.split(":")[0] for s in said[:6:2]] == ["controller", "observer", "generator"]
    assert any("same bytes, same matrices" in s for s in said)


def test_the_auditor_runs_alone_without_pwatrack_or_numpy(run: Path, tmp_path: Path) -> None:
    script = tmp_path / "audit.py"
    script.write_text(Path(auditor.__file__).read_text())
    assert len(script.read_text().splitlines()) < 120
    call = [sys.executable, "-I", "-S", str(script), str(run / "certificate.json")]
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "proved\n")


def test_the_certified_rates_of_the_paper_gains_are_at_least_006_and_the_best(specs: Path) -> None:
    proofs = design(load_spec(specs / "two_mass_paper_gains.yaml")).proofs
    best = {of: max(p.rate for p in proofs if p.of == of) for of in ("controller", "observer", "generator")}
    assert best == pytest.approx({"controller": 0.083, "observer": 0.084, "generator": 0.058}, abs=5e-4)
    assert all(p.rate >= 0.8 * best[p.of] for p in proofs)


@given(seeds, st.sampled_from(["A", "B", "C", "K", "L", "A_eta", "rate", "margin", "radius", "integers", "exponents"]))
@settings(deadline=None, max_examples=150)
def test_what_was_tampered_with_is_refused_or_still_true(run: Path, seed: int, where: str) -> None:
    """A change is accepted only if the changed claim holds, by eigenvalues far from 0."""
    random = np.random.default_rng(seed)
    content = json.loads((run / "certificate.json").read_text())
    if where in content:
        entry = content[where]
        while isinstance(entry[0], list):
            entry = entry[random.integers(len(entry))]
        k = int(random.integers(len(entry)))
        entry[k] = float(entry[k]) + float(random.choice([-1, 1]) * 10.0 ** random.uniform(-2, 2))
    else:
        proof = content["proofs"][random.integers(len(content["proofs"]))]
        if where in proof:
            proof[where] *= float(10.0 ** random.uniform(0.1, 4))
        else:
            values: Any = proof["P"][where]
            row = values[random.integers(len(values))] if where == "integers" else values
            row[random.integers(len(row))] += int(random.integers(1, 2**40) if where == "integers" else 3)
    if not auditor.audit(json.dumps(content)):
        for proof in content["proofs"]:
            e = np.array(proof["P"]["exponents"], dtype=float)
            P = np.array(proof["P"]["integers"], dtype=float) * 2.0 ** (e[:, None] + e)
            exact = json.loads(json.dumps(content), parse_float=Fraction, parse_int=Fraction)
            for M in auditor.problem(exact, proof["of"])[0]:
                M_float = np.array([[float(v) for v in r] for r in M])
                S = M_float @ P + P @ M_float.T + 2 * proof["rate"] * P
                assert np.linalg.eigvalsh(S)[-1] < 1e-9 * np.abs(P).max()


@given(seeds, st.integers(1, 6), st.floats(-17, -3), st.booleans())
@settings(deadline=None, max_examples=100)
def test_finder_and_auditor_never_disagree_and_never_err(seed: int, n: int, exponent: float, stable: bool) -> None:
    """A single triangular cell is stable exactly where its diagonal is negative."""
    random = np.random.default_rng(seed)
    M = np.triu(random.normal(size=(n, n)), 1) - np.diag(random.uniform(0.5, 2, size=n))
    M[0, 0] = (-1 if stable else 1) * 10.0**exponent
    assert is_hurwitz(decimals(M)) == stable
    certificate = best_certificate(M[None]) if stable else None
    proof = (
        None if certificate is None else prove_exactly("generator", [BallMatrix.of(M)], certificate.P, certificate.rate)
    )
    if proof is not None:
        P = {"integers": [list(r) for r in proof.integers], "exponents": list(proof.exponents)}
        claim = {"rate": proof.rate, "margin": proof.margin, "radius": proof.radius, "P": P}
        exact = json.loads(json.dumps(claim), parse_float=Fraction, parse_int=Fraction)
        assert auditor.check([fractions(M)], [], exact) == []
        exact["rate"] = -Fraction(repr(float(np.diag(M).max()))) * 2
        assert auditor.check([fractions(M)], [], exact) != []


@given(seeds, st.integers(1, 8))
@settings(deadline=None, max_examples=60)
def test_exact_stability_agrees_with_eigenvalues_where_these_are_sure(seed: int, n: int) -> None:
    M = np.random.default_rng(seed).normal(size=(n, n)) - 1.0 * np.eye(n)
    largest = float(np.linalg.eigvals(M).real.max())
    if abs(largest) > 1e-6:
        assert is_hurwitz(decimals(M)) == (largest < 0)


def test_a_stable_matrix_that_looks_unstable_in_floating_point_is_not_called_infeasible() -> None:
    n, a = 8, 2.0**-7
    random = np.random.default_rng(8)
    lower = np.tril(random.integers(-1, 2, (n, n)), -1) + np.eye(n, dtype=int)
    upper = np.triu(random.integers(-1, 2, (n, n)), 1) + np.eye(n, dtype=int)
    T = lower @ upper
    M = -a * np.eye(n) + T @ np.eye(n, k=1, dtype=int) @ np.rint(np.linalg.inv(T)).astype(int)
    assert np.linalg.eigvals(M).real.max() > 0  # NumPy is wrong here
    assert is_hurwitz(decimals(M))
    with pytest.raises(Undecided):
        prove_convergence(M[None], claim="(7)", cells=["a"])


@pytest.mark.parametrize("M", [[[0.0]], [[0.0, 1.0], [-1.0, 0.0]], [[-1.0, 0.0], [0.0, 0.0]]])
def test_a_marginal_cell_is_proved_infeasible(M: list[list[float]]) -> None:
    with pytest.raises(Infeasible, match="'a' not stable"):
        prove_convergence(np.array([M]), claim="(17)", cells=["a"])


def test_the_part_out_of_reach_is_found_exactly() -> None:
    random = np.random.default_rng(3)
    T = random.integers(-2, 3, size=(4, 4)).astype(float) + 4 * np.eye(4)
    A = np.array([[0.5, 0, 0, 0], [1, 0, 1, 0], [0, 2, 0, 1], [1, 1, 1, 1.0]])  # the first state runs alone
    exact = [[Fraction(v) for v in row] for row in (T @ A).tolist()]
    inverse = np.linalg.inv(T)
    assert np.allclose(T @ A @ inverse, np.array(exact, dtype=float) @ inverse)
    _, part = unreachable(decimals(A), decimals(np.array([[0.0], [0], [0], [1]])))
    assert part == decimals(np.array([[0.5]]))
    assert unreachable(decimals(A), decimals(np.array([[1.0], [0], [0], [0]])))[1].nrows() == 0


def test_a_certificate_of_another_spec_is_refused(run: Path, specs: Path) -> None:
    with pytest.raises(CheckFailed, match="other bytes"):
        verify(run / "certificate.json", specs / "two_mass_paper_gains.yaml")


@pytest.mark.parametrize(
    "text", ["", "{}", "[]", '{"format": "x"}', '{"format": "pwatrack certificate 1", "proofs": []}']
)
def test_what_is_no_certificate_is_refused(text: str) -> None:
    assert auditor.audit(text) != []


def test_a_P_that_is_not_positive_definite_proves_nothing_even_where_the_inequality_holds() -> None:
    """For M = 1 and P = −1 the inequality reads 2 + 2 rate − margin > 0: only P ≻ 0 stands against it."""
    claim = {"rate": 1, "margin": Fraction(1, 2), "radius": 0, "P": {"integers": [[-1]], "exponents": [0]}}
    assert auditor.check([[[Fraction(1)]]], [], claim) == [
        "P is not symmetric and positive definite, of the order of the matrices"
    ]
    assert prove_exactly("generator", [BallMatrix.of([[1.0]])], np.array([[1.0]]), 0.5) is None
