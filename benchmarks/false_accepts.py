"""Does anything false ever pass? Tampered certificates, and matrices that are singular but for a hair.

    make false-accepts

A tampered certificate may be accepted only where the changed claim is true, which a third method decides: the
leading minors, each an exact determinant; for polynomials in two variables Sturm's count of real roots; for a mean of
cells with a mode that no gain moves that det [B, A B, …] of means changes its sign within the radius. Certificates have
no bounds here: these are another claim. Forged ones do: they get keys of other claims, or one twice, lose keys, list
entries or the symmetry of a matrix, or have names and numbers in other forms; what is left must claim less. Told files
are those beside a certificate with one thing changed, which `verify` must find. Long ones are made to take time: see
`long_audits`. A nearly singular case is a stack of
matrices with a real mode at ±10^-10 … ±10^-17 of their size; they are triangular, so its sign is known exactly.
"""

import argparse
import copy
import json
from collections.abc import Callable
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from benchmarks.long_audits import SECONDS, longest
from benchmarks.preview import spec_text
from pwatrack import design, load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix, text
from pwatrack.commands.verify import verify
from pwatrack.errors import CheckFailed, Infeasible
from pwatrack.lmi.audit import proofs
from pwatrack.lmi.audit.balls import Ball
from pwatrack.lmi.audit.certificate import audit
from pwatrack.lmi.audit.form import normal_form
from pwatrack.lmi.audit.plant import AuditedPlant
from pwatrack.lmi.audit.reading import matrix, packed
from pwatrack.lmi.exact import Proof, prove, prove_exactly
from pwatrack.lmi.inequality import CONTROLLER
from pwatrack.lmi.infeasibility import refute
from pwatrack.report.certificate import design_certificate, refusal_certificate
from pwatrack.report.files import write_design, write_result

PROGRESS = Console(stderr=True)
SPECS = Path(__file__).parent.parent / "specs"
NAMES = ("two_mass_backlash.yaml", "gallery/quarter_car_bump_stop.yaml")
POLYNOMIAL = "gallery/two_mass_stiff_springs.yaml"
WEIGHED = """
name: cart
parameters: {m: 1}
system:
  states: [z, v]
  inputs: [u]
  outputs: [y]
  A: [[0, 1], [-1, -1]]
  B: [[0], [1/m]]
  C: [[1, 0]]
  nonlinearities:
    - {name: stop, kind: spring, of: z, start: 1, slope: 0.3, into: {v: -1}}
design: {controller: {cost: {Q: [[1, 0], [0, 1]], R: [[0.3]]}}, uncertain: {m: 2%}}
reference: {output: "0.1*sin(t)"}
simulation: {duration: 1, sample_time: 0.1, actuator: {limits: {u: [-9, 9]}}}
"""
LESS = ("proofs", "bounds", "limits", "signals", "parts", "corners")  # lists of which a certificate may have fewer
SYMMETRIC = ("X", "Q", "R", "integers")
ALONE = ("format", "spec", "simulation", "exit", "seconds", "versions", "remarks", "conditions", "files", "tracked")
ALONE_TOO = ("estimates", "along_x_d", "answered")  # of run.json, as the one before: simulated, or how it went
Place = tuple[Any, ...]


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
        proof[where] = text(Fraction(float(proof[where]) * float(10 ** random.uniform(-1, 3))))
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
        proof["rate"] = text(Fraction(float(proof["rate"]) * (1 + abs(size))))
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


def refused_mean() -> dict[str, Any]:
    """Return the proof that there is no gain for a plant of `benchmarks.preview`, with its cells listed."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "plant.yaml"
        path.write_text(spec_text(61), encoding="utf-8")
        spec = load_spec(path)
        evidence: Any = None
        try:
            design(spec)
        except Infeasible as refusal:
            evidence = refusal.evidence
        return dict(json.loads(json.dumps(refusal_certificate(spec, evidence))))


def tampered_mean(content: dict[str, Any], random: np.random.Generator) -> dict[str, Any]:
    """Return the proof of a mean of cells with one number changed, in the plant or in what is claimed."""
    changed = copy.deepcopy(content)
    proof = changed["proofs"][0]
    where = str(random.choice(["A", "B", "between", "rows", "mode", "eigenvalue", "inverse", "radius", "rate"]))
    entry: Any = changed["plant"][where] if where in PLANT else proof[where]
    size = float(random.choice([-1, 1]) * 10.0 ** random.uniform(-17, 2))
    if isinstance(entry, str | int):
        factor = 1 + size if where != "radius" else abs(size) * 1e6
        proof[where] = text(Fraction(entry) * Fraction(factor) if Fraction(entry) else Fraction(size))
        return changed
    while not isinstance(next(iter(entry.values() if isinstance(entry, dict) else entry)), str):
        entry = entry[random.integers(len(entry))]
    k = str(random.choice(list(entry))) if isinstance(entry, dict) else int(random.integers(len(entry)))
    entry[k] = text(Fraction(entry[k]) + Fraction(size))
    if where == "between" and random.integers(2):  # they still add up to 1
        other = next(cell for cell in entry if cell != k)
        entry[other] = text(1 - Fraction(entry[k]))
    return changed


def mean_is_stuck(content: dict[str, Any]) -> bool:
    """Decide that a mean within the radius has an eigenvalue within it that one input does not reach.

    det [B, A B, …] has another sign at the other end; where it is 0 is found by bisection.
    """
    plant, (proof,) = AuditedPlant(content["plant"], [0, 1]), content["proofs"]
    A, B = plant.problem(proof["of"], None, None, None)
    first, other = (A[int(i)][0] for i in plant.placed(proof)["between"])
    w = Fraction(next(iter(proof["between"].values())))
    radius, mu, rate = (Fraction(proof[name]) for name in ("radius", "eigenvalue", "rate"))

    def mean(w: Fraction) -> list[list[Fraction]]:
        pairs = (zip(*rows, strict=True) for rows in zip(first, other, strict=True))
        return [[w * a + (1 - w) * b for a, b in row] for row in pairs]

    low, high = w - radius, w + radius
    sign = reached(mean(low), B)
    if not 0 <= low <= high <= 1 or mu < radius or sign * reached(mean(high), B) > 0:
        return False
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if sign * reached(mean(middle), B) > 0 else (low, middle)
    values = np.linalg.eigvals(np.array([[float(v) for v in row] for row in mean(high)]))
    return bool(np.abs(values - float(mu - rate)).min() <= 1e-10 * np.abs(values).max() + float(radius))


def reached(A: list[list[Fraction]], B: list[list[Fraction]]) -> int:
    """Return the sign of det [B, A B, …] for one input, an exact determinant (FLINT's)."""
    import flint

    X, column = flint.fmpq_mat([list(map(_fmpq, row)) for row in A]), flint.fmpq_mat([[_fmpq(v)] for (v,) in B])
    columns = [column]
    for _ in range(len(B) - 1):
        columns.append(X * columns[-1])
    size = flint.fmpq_mat([[Y[j, 0] for Y in columns] for j in range(len(B))]).det()
    return int(size > 0) - int(size < 0)


def _fmpq(v: Fraction) -> Any:
    import flint

    return flint.fmpq(v.numerator, v.denominator)


def is_true(content: dict[str, Any]) -> bool:
    """Decide every matrix inequality of a certificate by leading minors in exact rational arithmetic."""
    plant = AuditedPlant(content["plant"])
    K, L = matrix(content["K"]), matrix(content["L"])
    A_eta, _ = normal_form(plant, content["generator"])
    for proof in content["proofs"]:
        if "degree" in proof:
            matrices = plant.problem(proof["of"], K, L, A_eta)[0]
            if not falls(proof, matrices if proof["of"] == "controller" else [M.T for M in matrices]):
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


def places(content: Any, at: Place = ()) -> list[Place]:
    """Return the paths of everything in a tree."""
    parts = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    return [at, *(place for key, value in parts for place in places(value, (*at, key)))]


def at(content: Any, place: Place) -> Any:
    """Return what is at a path."""
    for key in place:
        content = content[key]
    return content


def forged(content: dict[str, Any], random: np.random.Generator) -> tuple[str, bool]:
    """Return a certificate of another form as text, and whether it may be accepted: it then claims less."""
    changed, right = copy.deepcopy(content), False
    where = places(changed)

    def some(kind: Callable[[Any], bool]) -> Place:
        found = [place for place in where if place and kind(at(changed, place))]
        return found[random.integers(len(found))]

    how = str(random.choice(["key", "twice", "gone", "entry", "asymmetric", "name", "number"]))
    if how in ("key", "twice", "gone"):
        home = at(changed, some(lambda value: isinstance(value, dict) and bool(value)))
        own, keys = list(home), [place[-1] for place in where if place and isinstance(place[-1], str)]
        one = str(random.choice(own))
        if how == "gone":
            right = one in changed["set"] and "spec_sha256" not in home
            del home[one]
        elif how == "twice":
            home[one + "@@"] = [None, 0, "1", home[one]][random.integers(4)]
        else:
            home[next(key for key in random.permutation([*keys, "note"]).tolist() if key not in home)] = "1"
    elif how == "entry":
        place = some(lambda value: isinstance(value, list) and bool(value))
        entries, k = at(changed, place), int(random.integers(len(at(changed, place))))
        drop = bool(random.integers(2))
        entries.pop(k) if drop else entries.insert(k, copy.deepcopy(entries[k]))
        right = (drop and place[-1] in LESS) or (not drop and place[-1] in ("proofs", "parts", "corners"))  # as before
    elif how == "asymmetric":
        places_ = [place for place in where if place and place[-1] in SYMMETRIC]
        matrices = [at(changed, place) for place in places_ if isinstance(at(changed, place), list)]
        X = [X for X in matrices if len(X) > 1][int(random.integers(sum(len(X) > 1 for X in matrices)))]
        j, k = random.permutation(len(X))[:2].tolist()
        add = Fraction(float(10.0 ** random.uniform(-9, 9))) * int(random.choice([-1, 1]))
        X[j][k] = int(X[j][k] + add) + 1 if isinstance(X[j][k], int) else text(Fraction(X[j][k]) + add)
    else:
        numeric = how == "number"
        place = some(lambda value: isinstance(value, str) and value.lstrip("-")[:1].isdecimal() == numeric)
        value, right = at(changed, place), False
        odd = [f"+{value}", f"0{value}", f"{value}e0", f" {value}", f"{value}_0", f"{value}/1"] if numeric else []
        at(changed, place[:-1])[place[-1]] = str(
            random.choice(odd or [f"{value}\n(8): proved", f"{value}\x1b", "\u202e"])
        )
    return json.dumps(changed).replace('@@"', '"'), right


def weighed() -> dict[str, Any]:
    """Return a certificate with a cost, bounds, limits and a box."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "plant.yaml"
        path.write_text(WEIGHED, encoding="utf-8")
        spec = load_spec(path)
        return dict(json.loads(json.dumps(design_certificate(spec, design(spec)))))


def forged_ones(count: int) -> tuple[int, int]:
    """Return how many certificates of other forms are accepted, and how many of these claim more, or nothing known."""
    content = weighed()
    random, accepted, false = np.random.default_rng(2026), 0, 0
    for _ in track(range(count), "forged", console=PROGRESS):
        forgery, right = forged(content, random)
        if not audit(forgery)[1]:
            accepted += 1
            false += not right and forgery != json.dumps(content)  # a change of an entry may round to none
    return accepted, false


def retold(content: dict[str, Any], random: np.random.Generator) -> Place:
    """Change one thing in a file beside a certificate, and return its path."""
    where = [place for place in places(content) if place]
    place = where[random.integers(len(where))]
    home, key, value = at(content, place[:-1]), place[-1], at(content, place)
    if isinstance(value, float) and random.integers(4):
        start = next(k for k in range(len(place) + 1) if all(isinstance(step, int) for step in place[k:]))
        near = [at(content, place[:start] + rest) for rest in places(at(content, place[:start]))]
        largest = max(abs(v) for v in near if isinstance(v, float)) or 1.0
        home[key] = value + float(random.choice([-1, 1])) * largest * float(10.0 ** random.uniform(-6, 1))
    elif isinstance(value, dict) and random.integers(2):
        value["note"] = 1.0
    elif random.integers(2):
        home.pop(key)
    else:
        home[key] = "other" if isinstance(value, str) else [value, value]
    return place


def retold_ones(count: int) -> tuple[int, int]:
    """Return how many changed files of a run are accepted, and how often what was changed is not told by it alone."""
    random, accepted, false = np.random.default_rng(2026), 0, 0
    with TemporaryDirectory() as folder:
        path, run = Path(folder) / "plant.yaml", Path(folder) / "run"
        path.write_text(WEIGHED, encoding="utf-8")
        write_result(simulate(load_spec(path)), run, plots="none")
        figures = set(json.loads((run / "run.json").read_text())["figures"])
        with TemporaryDirectory() as other:
            alone = figures - set(json.loads((designed_alone(path, Path(other)) / "run.json").read_text())["figures"])
        for _ in track(range(count), "told", console=PROGRESS):
            name = str(random.choice(["run", "bounds", "gains", "generator", "controller"])) + ".json"
            file, was = run / name, (run / name).read_text()
            content = json.loads(was)
            place = retold(content, random)
            file.write_text(json.dumps(content))
            try:
                verify(run, path)
                accepted += 1
                false += not (
                    name == "run.json" and (place[0] in (*ALONE, *ALONE_TOO) or {*place[:2]} & {*alone, *ALONE_TOO})
                )
            except CheckFailed:
                pass
            file.write_text(was)
    return accepted, false


def designed_alone(path: Path, folder: Path) -> Path:
    """Return the run folder of a design that is not simulated: all of its figures are proved."""
    spec = load_spec(path)
    return write_design(spec, design(spec), folder)


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
    return {name: text(Fraction(repr(getattr(proof, name)))) for name in ("rate", "margin", "radius")} | {"P": P}


def proved(name: str) -> dict[str, Any]:
    """Return the certificate of a design, without bounds."""
    spec = load_spec(SPECS / name)
    content = json.loads(json.dumps(design_certificate(spec, design(spec))))
    return dict(content | {"bounds": [], "limits": []})


def attacked(
    contents: list[dict[str, Any]],
    change: Callable[[dict[str, Any], np.random.Generator], dict[str, Any]],
    holds: Callable[[dict[str, Any]], bool],
    count: int,
) -> tuple[int, int]:
    """Return how many tampered certificates are accepted, and how many of these are false."""
    accepted = false = 0
    for content in contents:
        random = np.random.default_rng(2026)
        for _ in track(range(count // len(contents)), change.__name__, console=PROGRESS):
            changed = change(content, random)
            if not audit(json.dumps(changed))[1]:
                accepted += 1
                false += not holds(changed)
    return accepted, false


def nearly_singular_stacks(count: int) -> str:
    """Say how many are proved stable or impossible, and how often wrongly."""
    stable_ones = refuted = wrong = 0
    for seed in track(range(count), "nearly singular", console=PROGRESS):
        M, stable = nearly_singular(seed)
        n = M.shape[1]
        P = np.diag(1.0 / 4.0 ** np.arange(n)) if seed % 2 else np.eye(n)
        certificate = prove(M, P)
        exact = [BallMatrix.of(M_i) for M_i in M]
        proof = None if certificate is None else prove_exactly(CONTROLLER, exact, certificate.P, certificate.rate)
        balls = [Ball(matrix(ball.texts)) for ball in exact]
        if proof is not None:
            stable_ones += 1
            wrong += not stable or bool(proofs.check(balls, [], claim_of(proof), None))
        found = refute(M, np.zeros((n, 0))) if not stable else refute(M[:1], np.zeros((n, 0)))
        if found is not None:
            refuted += 1
            Z = {"rate": 0, "Z": {str(i): Z_i for i, Z_i in found.Z.items()}}
            wrong += stable or bool(proofs.refuted(balls, [], Z, None))
    return f"proved stable {stable_ones}, proved impossible {refuted}, wrong or in disagreement: {wrong}"


def main() -> None:
    """Print the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tampered", type=int, default=10_000)
    parser.add_argument("--polynomials", type=int, default=2_000)
    parser.add_argument("--means", type=int, default=2_000)
    parser.add_argument("--forged", type=int, default=2_000)
    parser.add_argument("--long", type=int, default=500)
    parser.add_argument("--told", type=int, default=200)
    parser.add_argument("--singular", type=int, default=5_000)
    options, console = parser.parse_args(), Console(highlight=False, width=140)
    for kind, contents, change, holds, count in (
        ("tampered certificates", [proved(name) for name in NAMES], tampered, is_true, options.tampered),
        ("tampered polynomials", [proved(POLYNOMIAL)], tampered_polynomial, is_true, options.polynomials),
        ("tampered means of cells", [refused_mean()], tampered_mean, mean_is_stuck, options.means),
    ):
        accepted, false = attacked(contents, change, holds, count)
        console.print(f"{kind}: {count}, accepted {accepted}, of these false: {false}")
    for kind, count, found in (("forged", options.forged, forged_ones), ("told", options.told, retold_ones)):
        accepted, false = found(count)
        console.print(f"{kind} files: {count}, accepted {accepted}, of these false: {false}")
    slow, most, said = longest([weighed(), refused_mean()] if options.long else [], options.long, PROGRESS)
    console.print(
        f"long files: {options.long}, over {SECONDS:g} s: {slow}; longest {most:.2f} s, of {said}", markup=False
    )
    console.print(f"nearly singular stacks: {options.singular}, {nearly_singular_stacks(options.singular)}")


if __name__ == "__main__":
    main()
