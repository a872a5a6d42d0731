"""Polynomials that decay where no quadratic form does: where they end, and that they are what they say."""

import copy
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from pwatrack import load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix
from pwatrack.commands.verify import verify
from pwatrack.lmi.audit.balls import Ball
from pwatrack.lmi.audit.matrices import AuditFault
from pwatrack.lmi.audit.polynomials import polynomial as audit_polynomial
from pwatrack.lmi.inequality import CONTROLLER, GENERATOR
from pwatrack.lmi.polynomial import (
    Monomials,
    PolynomialLyapunov,
    PolynomialProof,
    best_polynomial,
    degrees,
    prove_polynomial,
)
from pwatrack.lmi.presolve import Coordinates
from pwatrack.rational import floats
from pwatrack.real import Real
from pwatrack.report.files import write_result

LARGEST = {2: 0.690, 4: 1.017, 6: 1.037, 8: 1.098, 10: 1.113}  # k2 = k3 for (17) of the example, by degree


def zero_dynamics(k: float) -> Array:
    """A_eta of the example with k2 = k3 = k, in the gap and beyond it."""
    return np.array([[[0.0, 1.0], [-1.0, -0.3]], [[0.0, 1.0], [-1.0 - k, -0.3]]])


def near(A: Array) -> Coordinates:
    at = Coordinates.balanced(A.swapaxes(1, 2))
    return at.of_mean(at.system(A.swapaxes(1, 2)))


def proved(A: Array, degree: int) -> PolynomialProof | None:
    found = best_polynomial(A, degree, near(A))
    return None if found is None else prove_polynomial(GENERATOR, [BallMatrix.of(A_i).transpose() for A_i in A], found)


@pytest.mark.parametrize("degree", LARGEST)
def test_each_degree_ends_where_it_should_and_is_proved_a_thousandth_below(degree: int) -> None:
    low, high = 0.6, 1.168
    while high - low > 1e-4:
        middle = (low + high) / 2
        low, high = (
            (middle, high)
            if best_polynomial(zero_dynamics(middle), degree, near(zero_dynamics(middle)))
            else (low, middle)
        )
    assert round(low, 3) == LARGEST[degree]
    proof = proved(zero_dynamics(round(0.999 * low, 6)), degree)
    assert proof is not None
    assert proof.degree == degree


def test_a_polynomial_falls_at_its_rate_along_any_switching() -> None:
    A = zero_dynamics(1.1)
    proof = proved(A, 10)
    assert proof is not None
    monomials, P = proof.monomials, floats(proof.P)
    rng = np.random.default_rng(1)

    def V(e: Array) -> float:
        z = proof.T @ e
        m = np.array([np.prod(z**a) for a in monomials.exponents])
        return float(m @ P @ m)

    for _ in range(200):
        e, tau = rng.normal(size=2), 10.0 ** rng.uniform(-3, 1)
        share = rng.uniform()
        after = expm(tau * (share * A[0] + (1 - share) * A[1])) @ e
        assert 0 < V(after) <= V(e) * np.exp(-10 * proof.rate * tau) * (1 + 1e-9)


def test_lifts_are_those_of_the_monomials_and_keep_rotations() -> None:
    rng, monomials = np.random.default_rng(2), Monomials.of(3, 3)
    A, e = rng.normal(size=(3, 3)), rng.normal(size=3)

    def m(e: Array) -> Array:
        return np.asarray(monomials.weights * [np.prod(e**a) for a in monomials.exponents])

    assert m(e) @ m(e) == pytest.approx(float(e @ e) ** 3)
    lift = monomials.lift(A[None])[0]
    assert m(expm(A) @ e) == pytest.approx(expm(lift) @ m(e))
    turning = monomials.lift((A - A.T)[None])[0]
    assert turning == pytest.approx(-turning.T)
    exact = floats(monomials.exactly(BallMatrix.of(A)).centre)
    assert exact * monomials.weights[:, None] / monomials.weights == pytest.approx(lift)


def test_units_of_the_states_do_not_matter() -> None:
    A, units = zero_dynamics(1.0), np.array([1e6, 1e-4])
    other = A * units[:, None] / units
    one, two = best_polynomial(A, 4, near(A)), best_polynomial(other, 4, near(other))
    assert one is not None
    assert two is not None
    assert two.rate == pytest.approx(one.rate, rel=0.05)
    assert prove_polynomial(CONTROLLER, [BallMatrix.of(A_i) for A_i in other], two) is not None


def test_a_rounded_polynomial_is_proved_for_no_other_plant() -> None:
    A = zero_dynamics(1.0)
    found = best_polynomial(A, 4, near(A))
    assert found is not None
    worse = zero_dynamics(1.168)
    moved = PolynomialLyapunov(A=worse, degree=4, T=found.T, P=found.P, N=found.N, rate=found.rate)
    assert prove_polynomial(GENERATOR, [BallMatrix.of(A_i).transpose() for A_i in worse], moved) is None
    assert prove_polynomial(GENERATOR, [BallMatrix.of(A_i).transpose() for A_i in worse], found) is None


def test_degrees_that_take_long_are_not_tried() -> None:
    assert degrees(1, 2) == ()
    assert degrees(2, 2) == (4, 6, 8, 10)
    assert degrees(4, 3) == (4, 6)
    assert degrees(20, 3) == ()


def content_of(proof: PolynomialProof) -> dict[str, Any]:
    """Return what a certificate has of it."""
    return {
        "of": "controller",
        "degree": proof.degree,
        "rate": repr(proof.rate),
        "T": [[repr(v) for v in row] for row in proof.T.tolist()],
        "P": {"integers": [list(row) for row in proof.integers], "exponents": list(proof.exponents)},
        "N": [{"integers": [list(r) for r in N], "exponents": list(proof.N_exponents)} for N in proof.N],
    }


def tampered(rng: np.random.Generator, proof: dict[str, Any], A: Array) -> tuple[dict[str, Any], Array]:
    """Return a proof with something changed in it, or for other matrices."""
    proof, A, kind = copy.deepcopy(proof), A.copy(), rng.integers(8)
    part = proof["P"] if kind < 3 else proof["N"][rng.integers(len(proof["N"]))]
    rows = part["integers"]
    j, k = rng.integers(len(rows), size=2).tolist()
    if kind in (0, 3):
        rows[j][k] = rows[k][j] = round(rows[j][k] * rng.choice([-1.0, 0.0, 0.7, 1.4, 3.0])) + int(rng.integers(-3, 4))
    elif kind in (1, 4):
        part["exponents"][j] += int(rng.choice([-2, -1, 1, 2]))
    elif kind in (2, 5):
        a, b = rng.permutation(len(rows))[:2].tolist()
        rows[a], rows[b] = rows[b], rows[a]
        for row in rows:
            row[a], row[b] = row[b], row[a]
    elif kind == 6:
        proof["rate"] = repr(float(f"{float(proof['rate']) * rng.uniform(1.01, 50):.4g}"))
    else:
        A[rng.integers(len(A)), rng.integers(2), rng.integers(2)] += rng.normal() * rng.choice([1e-4, 1e-2, 1.0])
    return proof, A


def holds(proof: dict[str, Any], A: Array) -> bool:
    """Look in all directions whether V > 0 falls at the rate claimed, with other means than either proof."""
    d = proof["degree"] // 2
    P = np.array([[float(v) for v in row] for row in proof["P"]["integers"]])
    scale = np.exp2(np.array(proof["P"]["exponents"], dtype=float))
    P, T = P * scale[:, None] * scale, np.array(proof["T"], dtype=float)
    angles = np.linspace(0, np.pi, 721)
    e = np.stack([np.cos(angles), np.sin(angles)])

    def V(e: Array) -> Array:
        z = T @ e
        m = np.array([z[0] ** (d - k) * z[1] ** k for k in range(d + 1)])
        return np.asarray(np.einsum("ak,ab,bk->k", m, P, m))

    steps = np.exp(1j * 2 * np.pi * np.arange(4 * d + 4) / (4 * d + 4))  # V(e + s A e) is a polynomial in s
    value = V(e)
    if not (value > 0).all():
        return False
    for A_i in A:
        slope = np.mean([V(e + s * (A_i @ e)) / s for s in steps], axis=0).real
        if not (slope < -2 * d * float(proof["rate"]) * value + 1e-12 * np.abs(value).max()).all():
            return False
    return True


@pytest.mark.slow
@pytest.mark.parametrize(("degree", "k"), [(4, 1.0), (6, 1.03)])
def test_no_tampered_proof_is_accepted_that_does_not_hold(degree: int, k: float) -> None:
    """1,000 of each degree: whatever the auditor accepts is true, and nearly all of it is refused."""
    A, rng = zero_dynamics(k), np.random.default_rng(degree)
    found = best_polynomial(A, degree, near(A))
    assert found is not None
    proof = prove_polynomial(CONTROLLER, [BallMatrix.of(A_i) for A_i in A], found)
    assert proof is not None
    content, accepted = content_of(proof), 0
    assert audited(content, A)
    assert holds(content, A)
    for _ in range(1000):
        other, matrices = tampered(rng, content, A)
        if (other, matrices.tolist()) != (content, A.tolist()) and audited(other, matrices):
            accepted += 1
            assert holds(other, matrices)
    assert accepted < 200


def audited(proof: dict[str, Any], A: Array) -> bool:
    """Say whether the auditor accepts a proof."""
    matrices = [Ball([[Fraction(repr(v)) for v in row] for row in A_i.tolist()]) for A_i in A]
    try:
        return not audit_polynomial(matrices, [], proof, None)
    except AuditFault:
        return False


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"degree": 3}, "half the degree"),
        ({"degree": 0}, "half the degree"),
        ({"degree": 6}, "half the degree"),
        ({"degree": 10**9}, "half the degree"),
        ({"N": []}, "one N for each"),
        ({"T": [["1", "0"], ["1", "0"]]}, "singular"),
        ({"T": [["1", "0"]]}, "half the degree"),
    ],
)
def test_a_proof_that_does_not_fit_is_a_fault(change: dict[str, Any], words: str) -> None:
    A = zero_dynamics(1.0)
    found = best_polynomial(A, 4, near(A))
    assert found is not None
    proof = prove_polynomial(CONTROLLER, [BallMatrix.of(A_i) for A_i in A], found)
    assert proof is not None
    matrices = [Ball([[Fraction(repr(v)) for v in row] for row in A_i.tolist()]) for A_i in A]
    with pytest.raises(AuditFault, match=words):
        audit_polynomial(matrices, [], content_of(proof) | change, None)


def test_a_proof_of_balls_holds_for_all_in_them() -> None:
    """The same entry with a radius: as long as it is small both accept, and neither when it is not."""
    A = zero_dynamics(0.9)
    found = best_polynomial(A, 4, near(A))
    assert found is not None
    seen = []
    for radius in ("1e-16", "1e-9", "0.2"):
        uncertain = [
            [[v if v != -0.3 else Real(Fraction("-0.3"), Fraction(radius)) for v in row] for row in A_i]
            for A_i in A.tolist()
        ]
        M = [BallMatrix.of(rows) for rows in uncertain]
        proof = prove_polynomial(CONTROLLER, M, found)
        exact = prove_polynomial(CONTROLLER, [BallMatrix.of(A_i) for A_i in A], found)
        assert exact is not None
        R = [[Fraction(0), Fraction(0)], [Fraction(0), Fraction(radius)]]
        balls = [Ball([[Fraction(repr(v)) for v in row] for row in A_i.tolist()], R) for A_i in A]
        wrong = audit_polynomial(balls, [], content_of(proof or exact), None)
        assert bool(wrong) == (proof is None)
        seen.append(proof is not None)
    assert seen == [True, True, False]


GIVEN = """\
name: given
system:
  states: [z, v]
  inputs: [u]
  outputs: [y]
  B: [[0], [1]]
  C: [[1, 0]]
  cells:
    - {name: free, where: ["z <= 0.05"], A: [[0, 1], [-1, -0.3]]}
    - {name: touching, where: ["z >= 0.05"], A: [[0, 1], [-2, -0.3]], b: [0, 0.05]}
design: {controller: {K: [[0, 0]]}, observer: {L: [[0], [0]]}}
reference: {output: 0.1*sin(t)}
simulation: {duration: 60, sample_time: 0.1, initial: {plant: [0.2, 0], observer: [-1, 3]}, portraits: []}
"""


def test_given_gains_are_proved_by_polynomials_and_kept_to_what_these_promise(tmp_path: Path) -> None:
    (tmp_path / "given.yaml").write_text(GIVEN)
    result = simulate(load_spec(tmp_path / "given.yaml"))
    assert [(p.role.name, p.degree) for p in result.controller.proofs] == [("controller", 8), ("observer", 8)]
    assert result.outcome.kind == "tracks"
    r = result.response
    for bound, error in ((result.tracking_bound, r.error_norm), (result.observer_bound, r.observer_error)):
        assert bound is not None
        assert (error <= bound * (1 + 1e-9)).all()
        assert error[0] > 0.1 * bound[0]
    assert all(not size for bounds in result.controller.bounds for size in bounds.sizes.values())
    verify(write_result(result, tmp_path / "run", plots="none"), tmp_path / "given.yaml")
