"""Does anything false ever pass? Tampered certificates, and matrices that are singular but for a hair.

    make false-accepts

A tampered certificate may be accepted only where the changed claim is true, which a third method decides: the
leading minors, each an exact determinant, and for polynomials in two variables Sturm's count of real roots. A nearly
singular case is a stack of matrices with a real mode at ±10^-10 … ±10^-17 of their size; they are triangular, so its
sign is known exactly.
"""

import argparse
import copy
import json
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from pwatrack import design, load_spec
from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix, text
from pwatrack.lmi.audit import proofs
from pwatrack.lmi.audit.balls import Ball, flipped
from pwatrack.lmi.audit.certificate import audit
from pwatrack.lmi.audit.form import normal_form
from pwatrack.lmi.audit.plant import Plant
from pwatrack.lmi.audit.reading import matrix, packed
from pwatrack.lmi.certificate import prove
from pwatrack.lmi.exact import Proof, prove_exactly
from pwatrack.lmi.infeasibility import refute
from pwatrack.lmi.role import CONTROLLER
from pwatrack.report.certificate import design_certificate

SPECS = Path(__file__).parent.parent / "specs"
NAMES = ("two_mass_backlash.yaml", "gallery/quarter_car_bump_stop.yaml")
POLYNOMIAL = "gallery/two_mass_stiff_springs.yaml"


PLANT = ("A", "b", "B", "C", "H", "h")
PLACES = (*PLANT, "K", "L", "A_eta", "T", "rate", "margin", "radius", "integers", "exponents")


def tampered(content: dict[str, Any], random: np.random.Generator) -> dict[str, Any]:
    """Return a certificate with one number changed."""
    changed = copy.deepcopy(content)
    proof = changed["proofs"][random.integers(len(changed["proofs"]))]
    homes = (changed["plant"], changed, changed["generator"], proof["P"])
    there = [where for where in PLACES if any(where in home for home in (*homes, proof))]  # some list no cells
    where = str(random.choice(there))
    if where in ("rate", "margin", "radius"):
        proof[where] = repr(float(proof[where]) * float(10 ** random.uniform(-1, 3)))
        return changed
    entry: Any = next(home[where] for home in homes if where in home)
    while isinstance(entry[0], list):
        entry = entry[random.integers(len(entry))]
    k = int(random.integers(len(entry)))
    if where == "integers":
        entry[k] += int(random.integers(-(2**41), 2**41))
    elif where == "exponents":
        entry[k] += int(random.choice([-2, -1, 1, 2]))
    else:
        change = float(random.choice([-1, 1]) * 10.0 ** random.uniform(-6, 2))
        entry[k] = text(Fraction(entry[k]) + Fraction(repr(change)))
    return changed


def tampered_polynomial(content: dict[str, Any], random: np.random.Generator) -> dict[str, Any]:
    """Return a certificate with one number changed in what a polynomial proves; matrices stay symmetric."""
    changed = copy.deepcopy(content)
    proof = next(proof for proof in changed["proofs"] if "degree" in proof)
    where = str(random.choice(["plant", "rate", "T", "P", "N"]))
    size = float(random.choice([-1, 1]) * 10.0 ** random.uniform(-9, 1))
    if where == "plant":
        row = changed["plant"]["A"][random.integers(len(changed["plant"]["A"]))]
        row = row[random.integers(len(row))]
    else:
        row = proof["T"][random.integers(len(proof["T"]))]
    if where == "rate":
        proof["rate"] = repr(float(proof["rate"]) * (1 + abs(size)))
    elif where in ("plant", "T"):
        k = int(random.integers(len(row)))
        row[k] = text(Fraction(row[k]) + Fraction(repr(size)))
    else:
        part = proof["P"] if where == "P" else proof["N"][random.integers(len(proof["N"]))]
        j, k = random.integers(len(part["integers"]), size=2).tolist()
        if random.integers(4):
            value = int(part["integers"][j][k])
            value += round(size * abs(value)) + int(random.integers(-1, 2))
            part["integers"][j][k] = part["integers"][k][j] = value
        else:
            part["exponents"][j] += int(random.choice([-2, -1, 1, 2]))
    return changed


def falls(proof: dict[str, Any], matrices: list[Ball]) -> bool:
    """Decide in exact arithmetic that V > 0 falls at its rate along e' = M e, for two states: forms of V(1, s)."""
    import flint

    def exact(rows: list[list[Fraction]]) -> list[list[Any]]:
        return [[flint.fmpq(v.numerator, v.denominator) for v in row] for row in rows]

    (P, _), degree, rate = packed(proof["P"]), int(proof["degree"]), Fraction(proof["rate"])
    one, other = (flint.fmpq_poly(row) for row in exact(matrix(proof["T"])))
    monomials = [one ** (degree // 2 - k) * other**k for k in range(degree // 2 + 1)]
    terms = zip(exact(P), monomials, strict=True)
    V = sum((v * m * w for row, m in terms for v, w in zip(row, monomials, strict=True)), flint.fmpq_poly())
    s, by_s = flint.fmpq_poly([0, 1]), V.derivative()
    forms = [V]
    for (a, b), (c, d) in (exact(M) for M, _ in matrices):
        slope = (degree * V - s * by_s) * (a + b * s) + by_s * (c + d * s)
        forms.append(-slope - degree * flint.fmpq(rate.numerator, rate.denominator) * V)
    return rate > 0 and all(form_positive(form, degree) for form in forms)


def form_positive(p: Any, degree: int) -> bool:
    """Decide whether a form of even degree in two variables, p = its values at (1, s), is positive (Sturm)."""
    chain = [p, p.derivative()]
    while chain[-1].degree() > 0:
        chain.append(-(chain[-2] % chain[-1]))
    ends = [[q[q.degree()] * sign ** q.degree() for q in chain if q] for sign in (-1, 1)]
    left, right = (sum(a * b < 0 for a, b in pairwise(values)) for values in ends)
    return bool(p.degree() == degree and p[degree] > 0 and left == right)


def is_true(content: dict[str, Any]) -> bool:
    """Decide every matrix inequality of a certificate by leading minors in exact rational arithmetic."""
    plant = Plant(content["plant"])
    K, L = matrix(content["K"]), matrix(content["L"])
    A_eta, _ = normal_form(plant, content["generator"])
    for proof in content["proofs"]:
        if "degree" in proof:
            matrices = plant.problem(proof["of"], K, L, A_eta)[0]
            if not falls(proof, matrices if proof["of"] == "controller" else [flipped(M) for M in matrices]):
                return False
            continue
        rate, margin, radius = (Fraction(proof[name]) for name in ("rate", "margin", "radius"))
        powers = [Fraction(2) ** int(e) for e in proof["P"]["exponents"]]
        n = len(powers)
        P = [[proof["P"]["integers"][j][k] * powers[j] * powers[k] for k in range(n)] for j in range(n)]
        if any(P[j][k] != P[k][j] for j in range(n) for k in range(n)) or not minors_positive(P):
            return False
        if min(rate, margin) <= 0 or (2 * radius) ** 2 * sum(v * v for row in P for v in row) > margin**2:
            return False
        for M, _ in plant.problem(proof["of"], K, L, A_eta)[0]:
            MP = [[sum(M[j][s] * P[s][k] for s in range(n)) for k in range(n)] for j in range(n)]
            S = [[-MP[j][k] - MP[k][j] - 2 * rate * P[j][k] - margin * (j == k) for k in range(n)] for j in range(n)]
            if not minors_positive(S):
                return False
    return True


def minors_positive(X: list[list[Fraction]]) -> bool:
    """Decide X ≻ 0 by its leading principal minors, each a determinant of its own (FLINT's)."""
    import flint

    exact = [[flint.fmpq(v.numerator, v.denominator) for v in row] for row in X]
    return all(flint.fmpq_mat([row[:k] for row in exact[:k]]).det() > 0 for k in range(1, len(X) + 1))


def nearly_singular(seed: int) -> tuple[Array, bool]:
    """Return matrices (l, n, n) with a mode at ±10^-k, and whether it is stable."""
    random = np.random.default_rng(seed)
    n, cells = int(random.integers(1, 5)), int(random.integers(1, 4))
    stable, size = bool(random.integers(2)), 10.0 ** -random.uniform(10, 17)
    M = np.array([np.diag(-(2.0 ** random.integers(-1, 3, size=n))) for _ in range(cells)])
    M[0, 0, 0] = -size if stable else size
    d = 2.0 ** random.integers(-3, 4, size=n)
    M = M * d[:, None] / d  # exact
    if n > 1:
        M[:, 0, 1:] = random.integers(-2, 3, size=n - 1) / 4.0  # triangular: the eigenvalues stay
    return M, stable


def claim_of(proof: Proof) -> dict[str, Any]:
    """Return a proof as it stands in a file."""
    P = {"integers": [list(row) for row in proof.integers], "exponents": list(proof.exponents)}
    return {name: repr(getattr(proof, name)) for name in ("rate", "margin", "radius")} | {"P": P}


def main() -> None:
    """Print the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tampered", type=int, default=10_000)
    parser.add_argument("--polynomials", type=int, default=2_000)
    parser.add_argument("--singular", type=int, default=5_000)
    options, console = parser.parse_args(), Console(highlight=False)
    for kind, names, change, count in (
        ("tampered certificates", NAMES, tampered, options.tampered),
        ("tampered polynomials", (POLYNOMIAL,), tampered_polynomial, options.polynomials),
    ):
        false = true = 0
        for name in names:
            spec = load_spec(SPECS / name)
            content = json.loads(json.dumps(design_certificate(spec, design(spec))))
            random = np.random.default_rng(2026)
            for _ in range(count // len(names)):
                changed = change(content, random)
                if not audit(json.dumps(changed))[1]:
                    true, false = (true + 1, false) if is_true(changed) else (true, false + 1)
        console.print(f"{kind}: {count}, accepted {true + false}, of these false: {false}")
    proved = refuted = wrong = 0
    for seed in range(options.singular):
        M, stable = nearly_singular(seed)
        n = M.shape[1]
        P = np.diag(1.0 / 4.0 ** np.arange(n)) if seed % 2 else np.eye(n)
        certificate = prove(M, P)
        exact = [BallMatrix.of(M_i) for M_i in M]
        proof = None if certificate is None else prove_exactly(CONTROLLER, exact, certificate.P, certificate.rate)
        balls = [(matrix(ball.texts), []) for ball in exact]
        if proof is not None:
            proved += 1
            wrong += not stable or bool(proofs.check(balls, [], claim_of(proof), None))
        found = refute(M, np.zeros((n, 0))) if not stable else refute(M[:1], np.zeros((n, 0)))
        if found is not None:
            refuted += 1
            Z = {"rate": 0, "Z": {str(i): Z_i for i, Z_i in found.Z.items()}}
            wrong += stable or bool(proofs.refuted(balls, [], Z, None))
    console.print(
        f"nearly singular stacks: {options.singular}, proved stable {proved}, proved impossible {refuted}, "
        f"wrong or in disagreement: {wrong}"
    )


if __name__ == "__main__":
    main()
