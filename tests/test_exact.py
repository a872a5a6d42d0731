"""Exact proofs, their independent audit, and exact decisions on stability."""

import json
import os
import shutil
import subprocess
import sys
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from pwatrack import design, load_spec
from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix, text
from pwatrack.claims.registry import CLAIMS
from pwatrack.commands.verify import verify
from pwatrack.control.convergence import best_certificate, prove_convergence
from pwatrack.errors import CheckFailed, Infeasible, Undecided
from pwatrack.lmi import audit as auditor
from pwatrack.lmi.audit.balls import Ball
from pwatrack.lmi.audit.cells import strictly_feasible
from pwatrack.lmi.audit.certificate import audit
from pwatrack.lmi.audit.form import normal_form
from pwatrack.lmi.audit.plant import AuditedPlant
from pwatrack.lmi.audit.proofs import check
from pwatrack.lmi.audit.reading import matrix, number
from pwatrack.lmi.exact import prove_exactly
from pwatrack.lmi.inequality import GENERATOR
from pwatrack.rational import decimals, is_hurwitz, unreachable
from pwatrack.report.certificate import subject_content
from pwatrack.report.files import write_design
from tests.conftest import designed
from tests.scenarios import STOP, mass

AUDITOR = Path(auditor.__path__[0])
seeds = st.integers(0, 10_000)


def fractions(X: Array) -> list[list[Fraction]]:
    return [[Fraction(repr(float(v))) for v in row] for row in X]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, specs: Path) -> Path:
    spec = load_spec(specs / "two_mass_backlash.yaml")
    return write_design(spec, design(spec), tmp_path_factory.mktemp("run"))


def test_a_design_is_verified_from_its_file(run: Path) -> None:
    said = verify(run)
    assert [s.split(":")[0] for s in said[1:7:2]] == ["(8) controller", "(9) observer", "(17) generator"]
    assert any("same plant, gains and goals" in s for s in said)
    assert [s.partition(", but")[0] for s in said if "tells the same" in s] == [
        f"{name} beside it tells the same"
        for name in ("gains.json", "bounds.json", "generator.json", "controller.json", "run.json")
    ]


def test_the_auditor_runs_alone_without_pwatrack_or_numpy(run: Path, tmp_path: Path) -> None:
    shutil.copytree(AUDITOR, tmp_path / "a copy")
    call = [sys.executable, "-I", "-S", str(tmp_path / "a copy"), str(run / "certificate.json")]
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert "(17) generator: proved, rate 0.0578" in done.stdout
    assert "none of its inequalities is absent" in done.stdout


def test_the_certified_rates_of_the_paper_gains_are_at_least_006_and_the_best(specs: Path) -> None:
    proofs = design(load_spec(specs / "two_mass_paper_gains.yaml")).proofs
    best = {of: max(p.rate for p in proofs if p.role.name == of) for of in ("controller", "observer", "generator")}
    assert best == pytest.approx({"controller": 0.083, "observer": 0.084, "generator": 0.058}, abs=5e-4)
    assert all(p.rate >= 0.8 * best[p.role.name] for p in proofs)


PLANT = ("A", "b", "B", "C", "H", "h")
PLACES = (*PLANT, "signs", "K", "L", "A_eta", "T", "internal", "rate", "margin", "radius", "integers", "exponents")


@pytest.mark.slow
@given(seeds, st.sampled_from(PLACES))
@settings(max_examples=20)
def test_what_was_tampered_with_is_refused_or_still_true(run: Path, seed: int, where: str) -> None:
    """A change is accepted only if the changed claim holds, by eigenvalues far from 0."""
    random = np.random.default_rng(seed)
    content = json.loads((run / "certificate.json").read_text())
    tamper(content, where, random)
    said, faults = audit(json.dumps(content))
    assert bool(said) or bool(faults)
    if not faults:
        assert where not in ("A", "b", "C", "H", "A_eta", "T", "internal")  # without which nothing fits
        plant = AuditedPlant(content["plant"])
        K, L = matrix(content["K"]), matrix(content["L"])
        A_eta, _ = normal_form(plant, content["generator"])
        for proof in content["proofs"]:
            e = np.array(proof["P"]["exponents"], dtype=float)
            P = np.array(proof["P"]["integers"], dtype=float) * 2.0 ** (e[:, None] + e)
            for M, _ in plant.problem(proof["of"], K, L, A_eta)[0]:
                M_float = np.array([[float(v) for v in r] for r in M])
                S = M_float @ P + P @ M_float.T + 2 * float(proof["rate"]) * P
                assert np.linalg.eigvalsh(S)[-1] < 1e-9 * np.abs(P).max()


def tamper(content: Any, where: str, random: np.random.Generator) -> None:
    proof = content["proofs"][random.integers(len(content["proofs"]))]
    if where in ("rate", "margin", "radius"):
        proof[where] = repr(float(proof[where]) * 10.0 ** random.uniform(0.1, 4))
        return
    home: Any = content["plant"] if where in (*PLANT, "signs") else content if where in "KL" else content["generator"]
    entry = home[where] if where in home else proof["P"][where]
    while isinstance(entry[0], list):
        entry = entry[random.integers(len(entry))]
    k = int(random.integers(len(entry)))
    if where in ("integers", "exponents"):
        entry[k] += int(random.integers(1, 2**40)) if where == "integers" else 3
    elif where in ("signs", "internal"):
        entry[k] = {"signs": -entry[k] or 1, "internal": 1 - entry[k] % 2}[where]
    else:
        entry[k] = text(
            number(entry[k]) + Fraction(repr(float(random.choice([-1, 1]) * 10.0 ** random.uniform(-2, 2))))
        )


def forged(run: Path, **changes: Any) -> list[str]:
    content = json.loads((run / "certificate.json").read_text())
    return audit(json.dumps(content | changes))[1]


def test_no_forgery_passes(run: Path) -> None:
    content = json.loads((run / "certificate.json").read_text())
    proofs, plant, generator = content["proofs"], content["plant"], content["generator"]
    empty = {"rate": "1", "margin": "1", "radius": "0", "P": {"integers": [], "exponents": []}}
    assert forged(run, proofs=[empty | {"of": "generator"}], K=[["1e6"] * 4], L=[["1e6"]] * 4)
    assert forged(run, proofs=proofs[:2]) == [
        "(17) generator is absent, which Theorem 3, output tracking needs",
        "(9) observer is absent, which Theorem 3, output tracking needs",
    ]
    assert forged(run, generator=generator | {"A_eta": [[["-1"]]] * 3}) == ["A_eta is not that of the plant"]
    assert forged(run, generator=None)
    assert forged(run, tracking="state")
    assert forged(run, proofs=[]) != []
    upper = plant | {name: plant[name][:2] for name in ("A", "b", "signs", "cells")}
    assert forged(run, plant=upper, generator=generator | {name: generator[name][:2] for name in ("A_eta", "T")}) == [
        "the cells do not cover the state space"
    ]
    shifted = [[["0"], ["0.1"], ["0"], ["0"]], *plant["b"][1:]]
    assert "the field jumps between cells 1 and 2" in forged(run, plant=plant | {"b": shifted})
    K = [[*content["K"][0][:3], "99999999999999993.0"]]
    assert forged(run, K=K) != []


@pytest.mark.slow
@given(seeds, st.sampled_from(["size", "a", "integers", "exponents", "signal"]))
@settings(max_examples=15)
def test_a_tampered_bound_is_refused_unless_it_is_looser(run: Path, seed: int, where: str) -> None:
    random = np.random.default_rng(seed)
    content = json.loads((run / "certificate.json").read_text())
    driven = [entry for entry in content["bounds"] if entry["channel"][0] != "start"]
    entry = driven[random.integers(len(driven))]
    part = entry["parts"][random.integers(len(entry["parts"]))]
    looser = False
    if where == "size":
        signal = entry["signals"][random.integers(len(entry["signals"]))]
        factor = 10.0 ** random.uniform(-0.5, 0.5)
        signal[2], looser = repr(float(signal[2]) * factor), factor > 1
    elif where == "signal":
        entry["signals"][0][1] = 3
    elif where == "a":
        part["a"] = repr(float(part["a"]) * random.choice([0.3, 3.0]))
    else:
        values = part["Q"]["exponents"] if where == "exponents" else part["Q"]["integers"][0]
        values[0] += int(random.choice([-1, 1]) * (2**37 if where == "integers" else 1))
    assert (audit(json.dumps(content))[1] == []) == looser


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ("a", "an ellipsoid can be left"),
        ("Q", "the start is not in the ellipsoid"),
        ("channel", "there is no 8 among 8"),
        ("size", "output 0 is not bounded by 0.5"),
    ],
)
def test_a_tampered_bound_of_a_start_is_refused(run: Path, change: str, fault: str) -> None:
    """The first mass starts 1 m off: so does y, and no bound of it can be below 1 m."""
    content = json.loads((run / "certificate.json").read_text())
    entry = next(entry for entry in content["bounds"] if entry["channel"] == ["start", 0])
    part = entry["parts"][0]
    if change == "a":
        part["a"] = "99"
    elif change == "Q":
        part["Q"]["exponents"] = [e - 1 for e in part["Q"]["exponents"]]
    elif change == "channel":
        entry["channel"] = part["channel"] = ["start", 8]
    else:
        entry["signals"][0][2] = "0.5"
    assert any(fault in said for said in audit(json.dumps(content))[1])


@pytest.mark.parametrize(
    "change",
    [
        {"rate": "1e9999999"},
        {"rate": [1]},
        {"rate": "0x10"},
        {"rate": "NaN"},
        {"P": {"integers": [[1]], "exponents": [10_000_000_000]}},
        {"P": {"integers": [["1" * 200_000]], "exponents": [0]}},
        {"of": "nobody"},
        {"Z": []},
        {"Z": {"0": []}},
        {"Z": {}, "rate": "0"},
    ],
)
def test_a_malformed_proof_is_refused_at_once(run: Path, change: dict[str, Any]) -> None:
    content = json.loads((run / "certificate.json").read_text())
    content["proofs"][0] |= change
    assert audit(json.dumps(content))[1] != []


@pytest.mark.parametrize("content", [b"\xff\xfe", b"[" * 100_000, b'{"format": "pwatrack certificate 8"}', None])
def test_the_auditor_alone_says_what_is_wrong_with_a_file_and_shows_no_traceback(
    tmp_path: Path, content: bytes | None
) -> None:
    if content is not None:
        (tmp_path / "c.json").write_bytes(content)
    call = [sys.executable, "-I", "-S", str(AUDITOR), str(tmp_path / "c.json")]
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    assert done.returncode == 6
    assert done.stdout.startswith("wrong: ")
    assert not done.stderr


@pytest.mark.parametrize("where", ["fifo", "/dev/zero"])
def test_the_auditor_alone_waits_for_no_pipe_and_reads_no_device(tmp_path: Path, where: str) -> None:
    os.mkfifo(tmp_path / "fifo")
    call = [sys.executable, "-I", "-S", str(AUDITOR), str(tmp_path / where)]
    done = subprocess.run(call, capture_output=True, text=True, check=False, timeout=20)
    assert done.returncode == 6
    assert "no regular file" in done.stdout


@pytest.mark.slow
def test_a_spec_of_another_gain_or_goal_is_told_from_the_certificate(run: Path, specs: Path, tmp_path: Path) -> None:
    text = (specs / "two_mass_backlash.yaml").read_text()
    for goal, said in (
        ("controller: {K: [[-2, -3, 1, 0]]}", "K is not the one"),
        ("controller: {rate: 0.2}", "rate asked for, 0.2 1/s, is not proved"),
        ("observer: {gain: 1}", "above the bound 1"),
        ("observer: {cost: {Q: [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]], R: [[1]]}}", "bound of the cost"),
    ):
        other = tmp_path / "other.yaml"
        other.write_text(text.replace("  tracking: output\n", f"  tracking: output\n  {goal}\n"))
        with pytest.raises(CheckFailed, match=said):
            verify(run, other)
    other.write_text(text.replace("k3: 0.4", "k3: 0.4000000000000001"))
    with pytest.raises(CheckFailed, match="plant is not that of"):
        verify(run, other)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("gains.json", lambda c: c["K"][0].__setitem__(0, 1.0)),
        ("generator.json", lambda c: c["b_eta"][0].__setitem__(0, 1.0)),
        ("generator.json", lambda c: c.__setitem__("delta", 2.0)),
        ("run.json", lambda c: c["figures"].__setitem__("controller_rate", 5.0)),
        ("run.json", lambda c: c.__setitem__("spec_sha256", "0")),
        ("bounds.json", lambda c: c["table"][0]["signals"]["y - y_d"].__setitem__("at_worst", 1e-3)),
        ("bounds.json", lambda c: c["start_within_sizes"]["signals"]["y - y_d"].__setitem__("at_worst", 1e-3)),
    ],
)
def test_a_folder_whose_files_do_not_agree_is_refused(run: Path, tmp_path: Path, name: str, change: Any) -> None:
    shutil.copytree(run, tmp_path / "run")
    content = json.loads((tmp_path / "run" / name).read_text())
    change(content)
    (tmp_path / "run" / name).write_text(json.dumps(content))
    with pytest.raises(CheckFailed, match=name):
        verify(tmp_path / "run")


def test_irrational_entries_are_proved_for_all_of_their_balls(tmp_path: Path) -> None:
    spec_text = """
name: irrational
parameters: {w: sqrt(2), s: pi/3}
system:
  states: [z, v]
  inputs: [u]
  outputs: [y]
  B: [[0], [s]]
  C: [[w, 0]]
  cells:
    - {name: low, where: ["z <= 1"], A: [[0, 1], [-w, -2*s]]}
    - {name: high, where: ["z >= 1"], A: [[0, 1], [-2*w, -2*s]], b: [0, w]}
reference: {output: "sin(t)"}
simulation: {duration: 1, sample_time: 0.1}
"""
    folder = designed(tmp_path, spec_text)
    assert verify(folder, tmp_path / "plant.yaml")
    content = json.loads((folder / "certificate.json").read_text())
    assert content["plant"]["radius"]["A"] is not None
    content["plant"]["radius"]["A"][0] = [["0", "0"], ["10", "0"]]
    faults = audit(json.dumps(content))[1]
    assert {f"({k}) {of}: the inequality fails for M_1" for k, of in ((8, "controller"), (9, "observer"))} <= set(
        faults
    )


@given(seeds, st.integers(1, 6), st.floats(-17, -3), st.booleans())
@settings(max_examples=100)
def test_finder_and_auditor_never_disagree_and_never_err(seed: int, n: int, exponent: float, stable: bool) -> None:
    """A single triangular cell is stable exactly where its diagonal is negative."""
    random = np.random.default_rng(seed)
    M = np.triu(random.normal(size=(n, n)), 1) - np.diag(random.uniform(0.5, 2, size=n))
    M[0, 0] = (-1 if stable else 1) * 10.0**exponent
    assert is_hurwitz(decimals(M)) == stable
    certificate = best_certificate(M[None]) if stable else None
    proof = (
        None if certificate is None else prove_exactly(GENERATOR, [BallMatrix.of(M)], certificate.P, certificate.rate)
    )
    if proof is not None:
        P = {"integers": [list(r) for r in proof.integers], "exponents": list(proof.exponents)}
        claim = {name: repr(getattr(proof, name)) for name in ("rate", "margin", "radius")} | {"P": P}
        assert check([Ball(fractions(M))], [], claim, None) == []
        claim["rate"] = repr(-2 * float(np.diag(M).max()))
        assert check([Ball(fractions(M))], [], claim, None) != []


@given(seeds, st.integers(1, 8))
@settings(max_examples=60)
def test_exact_stability_agrees_with_eigenvalues_where_these_are_sure(seed: int, n: int) -> None:
    M = np.random.default_rng(seed).normal(size=(n, n)) - 1.0 * np.eye(n)
    largest = float(np.linalg.eigvals(M).real.max())
    assume(abs(largest) > 1e-6)
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
    assert audit(text)[1] != []


def test_a_P_that_is_not_positive_definite_proves_nothing_even_where_the_inequality_holds() -> None:
    """For M = 1 and P = −1 the inequality reads 2 + 2 rate − margin > 0: only P ≻ 0 stands against it."""
    claim = {"rate": 1, "margin": "0.5", "radius": 0, "P": {"integers": [[-1]], "exponents": [0]}}
    assert check([Ball([[Fraction(1)]])], [], claim, None) == [
        "P is not symmetric and positive definite, of the order of the matrices"
    ]
    assert prove_exactly(GENERATOR, [BallMatrix.of([[1.0]])], np.array([[1.0]]), 0.5) is None


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return designed(tmp_path_factory.mktemp("two"), mass(STOP, C="[[0.5, 1]]"))


def listed(folder: Path) -> dict[str, Any]:
    """Return a certificate with all cells of its plant, which is written by elements."""
    content = json.loads((folder / "certificate.json").read_text())
    return dict(content | subject_content(load_spec(folder.parent / "plant.yaml"), listed=True))


@pytest.mark.parametrize("factor", [1, -2, Fraction(1, 3)])
def test_a_hyperplane_written_twice_hides_no_jump(two: Path, factor: Fraction) -> None:
    content = listed(two)
    plant = content["plant"]
    plant["H"].append([str(factor * Fraction(v)) for v in plant["H"][0]])
    plant["h"].append(str(factor * Fraction(plant["h"][0])))
    for signs in plant["signs"]:
        signs.append(signs[0] if factor > 0 else -signs[0])
    plant["b"][1][1][0] = "7"
    assert audit(json.dumps(content))[1] == ["two hyperplanes are one"]


I2 = [["1", "0"], ["0", "1"]]


@pytest.mark.parametrize(
    ("of", "rate", "more"),
    [
        ("plant", "100", {}),
        ("generator", "1000000000", {}),
        ("generator", "1e400", {}),
        ("controller", "1000000000", {}),
        ("controller", "1000000000", {"K": None, "L": None}),
    ],
)
def test_a_refusal_is_about_one_inequality_that_a_theorem_needs_and_its_own_gain(
    two: Path, of: str, rate: str, more: dict[str, Any]
) -> None:
    """The multiplier I proves each of these impossible, but that is no reason to refuse the plant."""
    Z = {"0": [["1"]]} if of == "generator" else {"0": I2}
    claim = {"of": of, "rate": rate, "Z": Z}
    assert forged(two, proofs=[claim], bounds=[], **more) != []


def test_a_refusal_hides_no_inequality_that_is_absent(two: Path) -> None:
    content = json.loads((two / "certificate.json").read_text())
    proofs = [proof for proof in content["proofs"] if proof["of"] == "controller"]
    Z = {"of": "generator", "rate": "0", "Z": {"0": [["1"]]}}
    (fault,) = forged(two, proofs=[Z, *proofs])
    assert fault.endswith(" is no key in the certificate")


@pytest.mark.parametrize(
    "signal", [["state", 7, "0"], ["state", -1, "0"], ["input", False, "9"], ["estimate", "0", "9"]]
)
def test_a_bound_of_a_signal_that_there_is_not_is_refused(two: Path, signal: list[Any]) -> None:
    bounds = json.loads((two / "certificate.json").read_text())["bounds"]
    for part in bounds[0]["parts"]:
        part["signals"].append(signal)
    bounds[0]["signals"].append(signal)
    wanted = "there is no" if type(signal[1]) is int else "is no whole number"
    assert any(wanted in fault for fault in forged(two, bounds=bounds))


@pytest.mark.parametrize("channel", [["noise", -1], ["noise", 1], ["disturbance", 2], ["disturbance", -1]])
def test_a_bound_of_a_channel_that_there_is_not_is_refused(two: Path, channel: list[Any]) -> None:
    bounds = json.loads((two / "certificate.json").read_text())["bounds"]
    for part in bounds[-1]["parts"]:
        part["channel"] = channel
    bounds[-1]["channel"] = channel
    assert any("there is no" in fault for fault in forged(two, bounds=bounds))


def test_a_bound_below_0_and_one_of_nothing_are_refused(two: Path) -> None:
    bounds = json.loads((two / "certificate.json").read_text())["bounds"]
    bounds[0]["signals"][0][2] = "-100000000"
    bounds[0]["parts"][0]["signals"][0][2] = "-1e20"
    bounds[1] |= {"signals": [], "parts": []}
    faults = forged(two, bounds=bounds)
    assert "bound of ['disturbance', 0]: output 0 is not bounded by -1e20" in faults
    assert "bound of ['disturbance', 1]: it bounds nothing" in faults


def test_continuity_is_claimed_at_the_centres_where_entries_lie_in_balls(two: Path) -> None:
    """Entries that vary independently of each other would jump."""
    content = listed(two)
    assert audit(json.dumps(content))[0][0] == "plant: 2 cells cover the state space, the field is continuous"
    content["plant"]["radius"]["b"] = [[["1e-09"], ["1e-09"]]] * 2
    said, faults = audit(json.dumps(content))
    assert not faults
    assert said[0].endswith("the field is continuous, at the centres of the balls that its numbers lie in")
    content["plant"]["radius"]["b"] = [[["1e-09"], ["1e-09"]]] * 3
    assert audit(json.dumps(content))[1] == ["the matrices of the plant do not fit together"]


def test_where_the_observer_has_no_gain_no_noise_enters_and_its_bounds_are_audited(tmp_path: Path) -> None:
    (tmp_path / "s.yaml").write_text(mass(STOP, C="[[0.5, 1]]", design="{observer: {rate: 0.1, gain: smallest}}"))
    spec = load_spec(tmp_path / "s.yaml")
    controller = design(spec)
    assert not controller.design.L.any()
    assert any("are proved" in sentence for sentence in verify(write_design(spec, controller, tmp_path / "run")))


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("certificate.json", {"set": 3}),
        ("certificate.json", {"claim": "The loop is stable for all plants."}),
        ("certificate.json", {"set": {"k": 1}}),
        ("certificate.json", {"spec_sha256": None}),
        ("run.json", {"figures": []}),
        ("run.json", {"figures": None}),
        ("bounds.json", {"table": 3}),
        ("bounds.json", {"table": [{"signals": {"y": 3}}]}),
        ("bounds.json", {"start_within_sizes": None}),
        ("gains.json", {"K": None}),
        ("gains.json", {"K": [["a", None]]}),
        ("gains.json", {"K": [["1/0", 0.0]]}),
        ("gains.json", {"L": "0/0"}),
        ("generator.json", {"T": None}),
    ],
)
def test_a_folder_with_parts_of_other_kinds_is_refused_in_words(
    two: Path, tmp_path: Path, name: str, change: dict[str, Any]
) -> None:
    shutil.copytree(two, tmp_path / "run")
    file = tmp_path / "run" / name
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(CheckFailed):
        verify(tmp_path / "run")


ODD: tuple[Any, ...] = (
    "1/0",
    "1e9999",
    "-1e-9999",
    "9" * 50,
    "1/3",
    "x",
    "",
    None,
    True,
    [],
    {},
    [[]],
    [None],
    0,
    -1,
    1.5,
    10**30,
)


@given(st.data())
@settings(max_examples=20)
def test_any_value_in_any_place_of_any_file_is_judged_in_words(
    two: Path, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("odd") / "run"
    shutil.copytree(two, folder)
    file = folder / data.draw(st.sampled_from(["certificate.json", "gains.json", "generator.json", "run.json"]))
    content = json.loads(file.read_text())
    home: Any = content
    key: Any = data.draw(st.sampled_from(sorted(content)))
    for _ in range(data.draw(st.integers(0, 6))):
        if not isinstance(home[key], dict | list) or not home[key]:
            break
        home = home[key]
        key = data.draw(st.sampled_from(sorted(home) if isinstance(home, dict) else range(len(home))))
    was, home[key] = home[key], data.draw(st.sampled_from(ODD))
    file.write_text(json.dumps(content))
    refused = True
    with suppress(CheckFailed):
        verify(folder)
        refused = False
    assert refused or file.name != "certificate.json" or was == home[key]


@pytest.mark.parametrize("size", ["1e9999", "1e-9999"])
def test_a_bound_beyond_all_doubles_is_not_that_of_the_run(two: Path, tmp_path: Path, size: str) -> None:
    shutil.copytree(two, tmp_path / "run")
    content = json.loads((two / "certificate.json").read_text())
    content["bounds"][0]["signals"][0][2] = size
    (tmp_path / "run" / "certificate.json").write_text(json.dumps(content))
    with pytest.raises(CheckFailed):
        verify(tmp_path / "run")


def test_a_gain_that_differs_from_the_proved_one_beyond_doubles_is_told(two: Path, tmp_path: Path) -> None:
    """The decimals are what is proved: next to them the loop may be marginal."""
    shutil.copytree(two, tmp_path / "run")
    file = tmp_path / "run" / "certificate.json"
    content = json.loads(file.read_text())
    content["K"][0][0] += "0000000000000000000001"
    file.write_text(json.dumps(content))
    assert float(content["K"][0][0]) == json.loads((two / "gains.json").read_text())["K"][0][0]
    with pytest.raises(CheckFailed, match="not a number as it is to be written"):
        verify(tmp_path / "run")


def test_a_certificate_that_only_refuses_is_no_certificate(two: Path, tmp_path: Path) -> None:
    shutil.copytree(two, tmp_path / "run")
    content = json.loads((two / "certificate.json").read_text())
    claim = {"of": "controller", "rate": "1000000000", "Z": {"0": I2}}
    content |= {"proofs": [claim], "L": None, "K": [["0", "0"]]}
    of_a_design = {key for claim in CLAIMS for key in claim.nothing} - {"proofs"}
    content = {key: content[key] for key in content if key not in of_a_design}
    (tmp_path / "run" / "certificate.json").write_text(json.dumps(content))
    with pytest.raises(CheckFailed, match="this is the other"):
        verify(tmp_path / "run")


@given(st.data())
@settings(max_examples=60)
def test_parallel_hyperplanes_are_decided_as_all_rows_together_are(two: Path, data: st.DataObject) -> None:
    content = listed(two)["plant"]
    directions = data.draw(st.lists(st.sampled_from([(1, 0), (0, 1), (1, 1), (-1, 2)]), min_size=2, max_size=7))
    factors = data.draw(st.lists(st.sampled_from([1, -1, 2, -3]), min_size=len(directions), max_size=len(directions)))
    offsets = data.draw(st.lists(st.integers(-2, 2), min_size=len(directions), max_size=len(directions)))
    planes = {(*direction, h): f for direction, h, f in zip(directions, offsets, factors, strict=True)}
    rows = [[f * v for v in plane] for plane, f in planes.items()]
    signs = data.draw(st.lists(st.sampled_from([-1, 0, 1]), min_size=len(rows), max_size=len(rows)))
    content |= {"H": [[str(v) for v in row[:2]] for row in rows], "h": [str(row[2]) for row in rows]}
    plant = AuditedPlant(content | {"signs": [signs, [0] * len(rows)]})
    wanted = [[Fraction(s * v) for v in row] for s, row in zip(signs, rows, strict=True) if s]
    assert plant.cells.interior(plant.cells.signs[0]) == strictly_feasible(wanted)
    on = data.draw(st.integers(0, len(rows) - 1))
    a, b, h = (Fraction(v) for v in rows[on])
    line = [(-h / a if a else Fraction(0), Fraction(0) if a else -h / b), (b, -a)]  # a point and a direction
    along = [
        [row[0] * line[1][0] + row[1] * line[1][1], row[0] * line[0][0] + row[1] * line[0][1] + row[2]]
        for k, row in enumerate([[Fraction(s * v) for v in r] for s, r in zip(signs, rows, strict=True)])
        if k != on and signs[k]
    ]
    assert plant.cells.interior(plant.cells.signs[0], on=on) == strictly_feasible(along)


def test_the_bound_of_a_cost_beside_the_gains_is_the_one_that_was_proved(tmp_path: Path) -> None:
    cost = "{controller: {cost: {Q: [[1, 0], [0, 1]], R: [[0.3]]}}}"
    folder = designed(tmp_path, mass(STOP, C="[[0.5, 1]]", design=cost))
    verify(folder)
    content = json.loads((folder / "gains.json").read_text())
    content["cost_bounds"]["controller"][0][0] *= 0.5
    (folder / "gains.json").write_text(json.dumps(content))
    with pytest.raises(CheckFailed, match=r"cost_bounds in gains\.json"):
        verify(folder)
