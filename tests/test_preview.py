"""Zero dynamics with unstable modes: (17±), its one bounded solution, and tracking with it."""

import json
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rich.console import Console
from scipy.integrate import solve_bvp
from scipy.linalg import expm

from benchmarks.preview import INTEGRATED, followed, grazing_text, integrated, last_tenth, left_by_pieces, spec_text
from pwatrack import design, load_spec, plant, problem, simulate
from pwatrack.arrays import Array, up
from pwatrack.ball_matrix import BallMatrix
from pwatrack.claims.bounds import SignalBounds
from pwatrack.claims.decay import sentences
from pwatrack.claims.robust import Robust
from pwatrack.claims.sampled_bounds import SampledBounds
from pwatrack.claims.stable_inversion import StableInversion
from pwatrack.commands.verify import verify
from pwatrack.control import generator as generator_module
from pwatrack.control.bounds import Form
from pwatrack.control.compensation import beside_given
from pwatrack.control.generator import trajectory_generator
from pwatrack.control.sampled_disturbances import ROUNDING
from pwatrack.control.trajectory import DesiredTrajectory, output_trajectory
from pwatrack.errors import CheckFailed, Infeasible, OutsideTheory, Undecided
from pwatrack.export.stored import digest
from pwatrack.lmi.audit.certificate import audit
from pwatrack.lmi.dichotomy import prove_dichotomy, refute_dichotomy
from pwatrack.lmi.inequality import GENERATOR
from pwatrack.lmi.infeasibility import Impossibility
from pwatrack.model.cells import Partition
from pwatrack.model.normal_form import normal_form
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import exosystem
from pwatrack.model.signal import ExponentialPolynomial, Signal
from pwatrack.report.certificate import design_certificate, refusal_certificate
from pwatrack.report.files import write_design
from pwatrack.report.parameters import box_figures
from pwatrack.report.screen import Findings
from pwatrack.report.summary import print_all
from pwatrack.simulation import stable_inversion as preview_module
from pwatrack.simulation.acting import acting
from pwatrack.simulation.curve import Pieces, told_pieces
from pwatrack.simulation.stable_inversion import bounded_solution, played_back
from pwatrack.spec.spec import Spec
from pwatrack.workflow.how_far import how_far
from pwatrack.workflow.tracking import desired_trajectory
from tests.conftest import SPECS
from tests.plants import saddle
from tests.test_cli import call, refused

T = ExponentialPolynomial.time()


def plant_of(*, H: object, h: object, signs: Any, tolerance: float = 1e-12, **matrices: Any) -> PWASystem:
    """A plant whose cells are named by their numbers."""
    partition = Partition.create(H=H, h=h, signs=signs, names=[str(k) for k in range(len(signs))])
    return PWASystem.create(partition=partition, tolerance=tolerance, **matrices)


def saddles(seed: int) -> tuple[PWASystem, Array]:
    """A plant η' of two cells with up to four unstable modes of 0.1 to 2,000 rad/s, and a direction to drive it."""
    random = np.random.default_rng(seed)
    poles, first, g, h = saddle(random, 5)
    p = len(poles)
    edge = 0.2 * float(random.normal())
    plant = plant_of(
        A=[first, first + np.outer(g, h)],
        b=[np.zeros(p), g * edge],
        B=random.normal(size=(p, 1)),
        C=np.eye(p),
        H=[h],
        h=[edge],
        signs=[[-1], [1]],
        tolerance=1e-9,
    )
    return plant, random.normal(size=p) * np.sqrt(np.abs(poles).max())


def driven(plant: PWASystem, direction: Array, signal: Signal) -> DesiredTrajectory:
    """η' = f(η) + direction · signal, as if it were a generator with x_d = η."""
    system, p = exosystem([signal]), plant.A.shape[1]
    rows = np.hstack([np.eye(p), np.zeros((p, len(system.w0) + 1))])
    rate = np.zeros((len(plant.A), *rows.shape))
    rate[:, :, :p], rate[:, :, p:-1], rate[:, :, -1] = plant.A, direction[:, None] * system.Q, plant.b
    names = tuple(f"eta{k}" for k in range(p))
    nothing = np.zeros((len(plant.A), 1, rows.shape[1]))
    return DesiredTrajectory.linear(
        plant,
        exosystem=system,
        names=names,
        to_eta=np.eye(p),
        eta_offset=np.zeros(p),
        rate=rate,
        x_d=rows,
        u_ff=nothing,
    )


def move(at: float, span: float) -> Signal:
    """From 0 to 1 with two continuous derivatives."""
    rise = ExponentialPolynomial.polynomial(np.array([0, 0, 0, 10, -15, 6.0]) / span ** np.arange(6))
    pieces = ExponentialPolynomial.constant(0.0), rise, ExponentialPolynomial.constant(1.0)
    return Signal((0.0, at, at + span), pieces)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12))
def test_the_bounded_solution_satisfies_its_equation(seed: int) -> None:
    plant, direction = saddles(seed)
    speed = 10 ** np.random.default_rng(seed).uniform(-1, 1.5)
    wave = (speed * T).sin() + 0.3 * (2 * speed * T).cos()
    signal, duration = (Signal.of(wave), 15 / speed) if seed % 2 else (move(1.0, 1 / speed), 3.0 + 1 / speed)
    signals, preview = bounded_solution(driven(plant, direction, signal), duration)
    assert (preview.residual <= 1e-9 * preview.terms).all()
    random = np.random.default_rng(seed)
    for t in random.uniform(0, duration, 20):  # and without its own word for it
        eta = np.array([s(t) for s in signals])
        slope = np.array([s(t, derivative=1) for s in signals])
        cell = plant.partition.locate(eta)
        terms = np.abs(plant.A[cell]) @ np.abs(eta) + np.abs(plant.b[cell]) + np.abs(direction * signal(t))
        np.testing.assert_array_less(
            np.abs(slope - plant.A[cell] @ eta - plant.b[cell] - direction * signal(t)), 1e-9 * terms + 1e-12
        )


def test_it_is_that_of_a_second_method() -> None:
    """The hand test of two saddles with one P, driven through both cells: solve_bvp over a period."""
    plant = plant_of(
        A=[[[-2, 1], [1, 1]], [[-2, 1], [1, 3]]],
        b=[[0, 0], [0, 0.2]],
        B=[[1], [1]],
        C=np.eye(2),
        H=[[0, 1]],
        h=[0.1],
        signs=[[-1], [1]],
    )
    signals, _ = bounded_solution(driven(plant, np.ones(2), Signal.of((2 * T).sin())), np.pi)

    def slope(t: Array, eta: Array) -> Array:
        upper = 2 * np.maximum(eta[1] + 0.1, 0.0)
        return np.vstack([-2 * eta[0] + eta[1], eta[0] + eta[1] + upper]) + np.sin(2 * t)

    mesh = np.linspace(0, np.pi, 400)
    found: Any = solve_bvp(slope, lambda a, b: a - b, mesh, np.zeros((2, 400)), tol=1e-9, max_nodes=100_000)
    assert found.success
    for t in np.linspace(0, np.pi, 50, endpoint=False):
        np.testing.assert_allclose([s(t) for s in signals], found.sol(t), atol=1e-7)


def test_a_move_is_prepared_for_and_forgotten() -> None:
    """η' = 3 η − y_d has η = ∫ e^(−3 s) y_d(t + s) ds over all that is to come: e^(−3 (1 − t)) before a move at 1."""
    plant = plant_of(A=[[[3]]] * 2, b=[[0]] * 2, B=[[1]], C=[[1]], H=[[1]], h=[0], signs=[[-1], [1]])
    (eta,), preview = bounded_solution(driven(plant, -np.ones(1), move(1.0, 0.5)), 4.0)
    assert eta(0.4) == pytest.approx(eta(0.9) * np.exp(-1.5), rel=1e-9)
    assert eta(4.0) == pytest.approx(1 / 3, rel=1e-12)
    lead = np.log(eta(1.0) / (1e-3 * 1 / 3)) / 3  # when it has gone 1/1000 of its way
    assert preview.lead == pytest.approx(min(1.0, lead), abs=0.05)


def test_what_is_played_back_is_continuous() -> None:
    """Modes of 0.1 and 1,500 rad/s, and corners of the reference that the fast one forgets at once."""
    plant = plant_of(
        A=[[[0.1, 0], [0, 1500]], [[0.1, 0], [0, 1510]]],
        b=[[0, 0]] * 2,
        B=[[1], [1]],
        C=np.eye(2),
        H=[[0, 1]],
        h=[0],
        signs=[[-1], [1]],
    )
    signals, _ = bounded_solution(driven(plant, np.array([1.0, 1500.0]), move(1.0, 0.5)), 4.0)
    for signal in signals:
        size = max(abs(signal(t)) for t in np.linspace(0, 4, 50))
        for k, start in enumerate(signal.starts[1:]):
            before, after = (signal.pieces[j](start - signal.starts[j]) for j in (k, k + 1))
            assert abs(before - after) <= 4e-13 * size


@pytest.mark.slow
@pytest.mark.parametrize("seed", [5])
def test_gains_of_a_million_do_not_enlarge_rounding(tmp_path: Path, seed: int) -> None:
    """Of K x̂ and K x_d, each by itself, doubles keep so little that y would be off by 1e-6 to 1e-5."""
    path = tmp_path / "plant.yaml"
    path.write_text(spec_text(seed), encoding="utf-8")
    found = followed(path)
    assert max(found.near, found.left) < 1e-8


@pytest.mark.slow
def test_a_played_back_trajectory_has_no_filter() -> None:
    spec = load_spec(SPECS / "gallery" / "cart_and_pole_on_the_move.yaml")
    controller = design(spec)
    trajectory, generator = controller.trajectory, controller.generator
    assert generator is not None
    assert generator.played_back
    assert trajectory.rate.shape[1] == 0
    y_d = exosystem([Signal.of((2 * T).sin() * 0.1)])
    again = played_back(output_trajectory(generator, y_d), 1.0)
    start = np.append(again.exosystem.w0, 1.0)
    assert (controller.plant.tracked @ again.x_d[0] @ start) == pytest.approx([0.0], abs=1e-12)


@pytest.mark.slow
def test_an_unknown_load_is_compensated_too() -> None:
    result = simulate(load_spec(SPECS / "gallery" / "cart_and_pole_on_the_move.yaml"))
    assert result.final_error < 1e-8
    assert np.abs(result.response.estimates[-1]) == pytest.approx([0.5], rel=1e-6)


@pytest.mark.slow
def test_what_is_played_back_leaves_little_in_the_sampled_loop_too(specs: Path) -> None:
    """A run is below its bounds; where η is off (15) by more than rounding nothing is said of it."""
    text = (specs / "gallery" / "flexible_arm.yaml").read_text(encoding="utf-8")
    spec = load_spec(yaml.safe_load(text.replace("simulation:", "simulation:\n  controller: {sample_time: 0.001}", 1)))
    controller = design(spec)
    (bounds,) = controller.claims_of(SampledBounds)
    response = simulate(spec, controller).response
    seen = {
        "output": np.abs(response.tracking_error),
        "state": np.abs(response.x - response.x_d),
        "input": np.abs(response.u - response.u_ff),
    }
    for (kind, k), most in bounds.from_start.items():
        assert kind == "estimate" or seen[kind][:, k].max() <= most.max()
    assert bounds.ends_below(controller)["output", 0] < 1e-8  # m
    preview = controller.trajectory.preview
    assert preview is not None
    assert preview.share < ROUNDING
    conditions, eta = spec.scenario.conditions, np.zeros(0)
    for more in replace(preview, residual=1e-10 * preview.terms), replace(preview, jumps=1e-10 + preview.jumps):
        off = replace(controller, trajectory=replace(controller.trajectory, preview=more))
        assert acting(off, conditions, bounds.errors, eta, 1.0) is None
    assert acting(controller, conditions, bounds.errors, eta, 1.0) is not None


def test_a_reference_that_is_not_known_beforehand_is_refused(tmp_path: Any) -> None:
    text = (SPECS / "gallery" / "cart_and_pole_swaying.yaml").read_text(encoding="utf-8")
    path = tmp_path / "spec.yaml"
    path.write_text(text.replace("0.4*sin(2*t)}", "0.4*sin(2*t), preview: none}"), encoding="utf-8")
    with pytest.raises(Infeasible, match=r"\(17\), convergence of the zero dynamics, is infeasible"):
        design(load_spec(path))


def blown(folder: Path, loads: str, acts: str, *replaced: tuple[str, str]) -> Spec:
    """The cart and pole on the move with unknown loads that its input does not reach."""
    text = (SPECS / "gallery" / "cart_and_pole_on_the_move.yaml").read_text(encoding="utf-8")
    path = folder / "spec.yaml"
    for old, new in (("estimate: input", f"estimate: {loads}"), ("{v: 0.5/M, w: -0.5/(M*l)}", acts), *replaced):
        assert old in text
        text = text.replace(old, new)
    path.write_text(text.replace(", load_F: N", ""), encoding="utf-8")
    return load_spec(path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("loads", "acts"),
    [
        ("{wind: {into: {w: 1}}, push: {into: {v: 1}}}", "{w: 0.3, v: 0.2}"),
        ("{hum: {into: {w: 1}, frequency: 3}}", '{w: "0.2*sin(3*t)"}'),
    ],
)
def test_a_load_on_what_is_worked_out_is_made_up_for(tmp_path: Path, loads: str, acts: str) -> None:
    """It only shifts the bounded solution, as the pole leans against a wind, the same in all cells."""
    result = simulate(blown(tmp_path, loads, acts))
    assert result.final_error < 1e-8
    controller = result.controller
    content = json.loads(json.dumps(design_certificate(result.spec, controller)))
    assert not audit(json.dumps(content))[1]
    for spoiled in (None, [["0.1"] * len(row) for row in content["eta_with_loads"]], content["eta_with_loads"][1:]):
        assert audit(json.dumps(content | {"eta_with_loads": spoiled}))[1]
    plant, added = controller.plant, beside_given(controller.plant, controller.compensation.X)
    assert plant.loads is not None
    X, S, E = added.X.floats, plant.loads.S.floats, plant.loads.E.floats
    np.testing.assert_allclose(plant.B @ added.u_ff, X @ S - plant.A @ X - E, atol=1e-12)


def test_a_load_that_moves_what_is_worked_out_in_other_ways_in_other_cells_is_refused(tmp_path: Path) -> None:
    leaning = (
        "of: p, lower: -gap, upper: gap, slope: k, into: {v: -1/M, w: 1/(M*l)}",
        "of: lean, lower: -0.2, upper: 0.2, slope: 1, into: {w: -1}",
    )
    with pytest.raises(OutsideTheory, match=r"the load wind acts on η .* is not the same in all cells"):
        design(blown(tmp_path, "{wind: {into: {w: 1}}}", "{w: 0.3}", leaning))


def test_cells_with_different_numbers_of_unstable_modes_have_no_P() -> None:
    M = [BallMatrix.of([[a]]) for a in (1, -1)]
    assert prove_dichotomy(GENERATOR, M) is None
    plant = plant_of(
        A=[[[0, 1, 0], [0, 0, 1], [0, 0, 1]], [[0, 1, 0], [0, 0, 1], [0, 0, -1]]],
        b=[[0, 0, 0]] * 2,
        B=[[0], [1], [0]],
        C=[[1, 0, 0]],
        H=[[0, 0, 1]],
        h=[0],
        signs=[[1], [-1]],
    )
    with pytest.raises(Infeasible, match=r"no P of any sign, \(17±\), exists: 0 of the eigenvalues"):
        trajectory_generator(normal_form(plant))


def doubled(folder: Path, *, spring: float = 4.0, into: str = "e2: -k", damping: float = 0.1) -> Path:
    """A plant η' with a mode that grows beside an oscillator, where a spring begins to act."""
    path = folder / "spec.yaml"
    path.write_text(
        f"""
name: One mode that grows
parameters: {{k: {spring}, d: {damping}}}
system:
  states: [y, e1, e2, e3]
  inputs: [u]
  outputs: [m_y, m_1, m_2, m_3]
  track: [m_y]
  A: [[0, 1, 0, 1], [0, 0, 1, 0], [1, -1, -d, 0], [1, 0, 0, 2]]
  B: [[1], [0], [0], [0]]
  C: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  nonlinearities:
    - {{name: spring, kind: spring, of: {"e3" if "e3" in into else "e1"}, start: 0.1, slope: 1, into: {{{into}}}}}
reference: {{output: "sin(t)"}}
simulation: {{duration: 1, sample_time: 0.01}}
""",
        encoding="utf-8",
    )
    return path


@pytest.mark.parametrize(
    ("into", "spring", "damping", "reason"),
    [
        ("e2: -k", 4.0, 0.1, "cells 'spring off' and 'spring on' conflict"),
        (
            "e3: -k",
            4.0,
            0.1,
            "0 of the eigenvalues in cell 'spring on' have positive real parts, 1 in cell 'spring off'",
        ),
        ("e2: -k", 4.0, 0.0, "an eigenvalue in cell 'spring off' is on the imaginary axis"),
    ],
)
def test_that_no_P_of_any_sign_does_is_proved_and_audited(
    tmp_path: Path, into: str, spring: float, damping: float, reason: str
) -> None:
    spec = load_spec(doubled(tmp_path, into=into, spring=spring, damping=damping))
    with pytest.raises(Infeasible, match=r"; and no P of any sign, \(17±\), exists: ") as refusal:
        design(spec)
    assert reason in str(refusal.value)
    evidence = refusal.value.evidence
    assert isinstance(evidence, Impossibility)
    content = json.loads(json.dumps(refusal_certificate(spec, evidence)))
    said, faults = audit(json.dumps(content))
    assert not faults
    assert any("(17) generator: proved impossible with a P of any sign, by " in sentence for sentence in said)
    (proof,) = content["proofs"]
    one = next(iter(proof.get("Z", proof.get("P"))))
    spoiled: list[dict[str, Any]] = [{"of": "plant"}, {"no_P": "of one sign"}, {"Z": {}}]
    if "Z" in proof:
        Z = {k: [row[:] for row in Z_k] for k, Z_k in proof["Z"].items()}
        Z[one][0][0] += 1
        spoiled += [{"Z": Z}, {"Z": {k: [[-v for v in row] for row in Z_k] for k, Z_k in proof["Z"].items()}}]
    else:
        P = {**proof["P"][one], "integers": [[-v for v in row] for row in proof["P"][one]["integers"]]}
        spoiled += [{"P": {**proof["P"], one: P}}, {"P": {one: proof["P"][one]}}, {"P": {"0": P, "1": P}}]
    for change in spoiled:
        assert audit(json.dumps(content | {"proofs": [proof | change]}))[1], change


def test_where_neither_is_found_it_is_undecided(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = load_spec(doubled(tmp_path))
    monkeypatch.setattr(generator_module, "refute_dichotomy", lambda *_, **__: None)
    with pytest.raises(Undecided, match=r"whether a P of any sign does, \(17±\), .* is undecided") as refusal:
        design(spec)
    assert refusal.value.evidence is None


def test_how_far_it_is_from_a_P_of_any_sign(tmp_path: Path) -> None:
    """The oscillator alone: a common P exists from a damping of √(1 + k) − √1 on."""
    spec = load_spec(doubled(tmp_path))
    with pytest.raises(Infeasible) as refusal:
        design(spec)
    assert isinstance(refusal.value.evidence, Impossibility)
    found = how_far(spec, refusal.value.evidence)
    assert found is not None
    assert found.claim == "(17±)"
    at = {p.parameter: p.value for p in found.parameters if p.degree == 2}
    assert at["d"] == pytest.approx(np.sqrt(5) - 1, rel=1e-4)
    assert at["k"] == pytest.approx(1.1**2 - 1, rel=1e-4)
    design(load_spec(doubled(tmp_path, damping=1.01 * at["d"])))


@pytest.mark.parametrize("seed", range(20))
def test_random_cells_have_a_P_of_any_sign_or_a_proof_that_they_have_none(seed: int) -> None:
    random = np.random.default_rng(seed)
    n, cells, k = int(random.integers(2, 5)), int(random.integers(2, 4)), int(random.integers(1, 3))
    first, away, M = random.normal(size=(n, n)), 10 ** random.uniform(-1.5, 1), []
    for _ in range(cells):
        T = first + away * random.normal(size=(n, n))
        poles = np.concatenate([10 ** random.uniform(-1, 1, k), -(10 ** random.uniform(-1, 1, n - k))])
        M.append(BallMatrix.of((T @ np.diag(poles) @ np.linalg.inv(T)).round(6)))
    found, against = prove_dichotomy(GENERATOR, M), refute_dichotomy(GENERATOR, M)
    assert (found is None) != (against is None)


@pytest.mark.slow
def test_the_auditor_reads_the_proof(tmp_path: Any) -> None:
    spec = load_spec(SPECS / "gallery" / "cart_and_pole_on_the_move.yaml")
    content = json.loads(json.dumps(design_certificate(spec, design(spec))))
    said, faults = audit(json.dumps(content))
    assert not faults
    assert "(17) generator: proved with a P of any sign, for a bounded solution that is played back" in said
    (proof,) = (proof for proof in content["proofs"] if "bounded" in proof)
    kept = json.dumps(proof)
    for spoiled in (
        {"P": {**proof["P"], "integers": [[-v for v in row] for row in proof["P"]["integers"]]}},
        {"margin": "1e3"},
        {"margin": "0"},
        {"of": "controller"},
    ):
        proof.update(json.loads(kept) | spoiled)
        assert audit(json.dumps(content))[1]


def test_a_generator_that_runs_is_left_to_run() -> None:
    controller = design(load_spec(SPECS / "two_mass_backlash.yaml"))
    assert controller.trajectory.preview is None
    assert controller.claims_of(StableInversion) == ()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 18])
def test_what_is_played_back_leaves_no_more_than_is_said(tmp_path: Path, seed: int) -> None:
    """By another method: e' = (A_i + B K) e + ρ, with the jumps of x_d, in more digits."""
    path = tmp_path / "plant.yaml"
    path.write_text(spec_text(seed), encoding="utf-8")
    spec = load_spec(path)
    controller = design(spec)
    assert 0 < left_by_pieces(controller, spec.scenario.duration) < controller.claim(StableInversion).error < 1e-3


PRESSED = """\
name: a stop that is hardly pressed
system:
  states: [x, h]
  inputs: [u]
  outputs: [y]
  A: [[0, 1], [-1, 1]]
  B: [[1], [0]]
  C: [[1, 0]]
  nonlinearities: [{name: stop, kind: spring, of: x, start: 0.999, slope: 100, into: {h: -1}}]
reference: {output: {sine: {amplitude: 1, frequency: 1, phase: -0.9062286500739787}}}
simulation: {duration: 7, sample_time: 0.01}
"""


@pytest.mark.slow
@pytest.mark.parametrize("seed", [-1, 0])
def test_no_short_stay_beyond_a_facet_is_missed(tmp_path: Path, seed: int) -> None:
    """x_d is beyond a facet for a small part of a radian; the true plant, by another integrator, keeps what is said."""
    path = tmp_path / "plant.yaml"
    path.write_text(PRESSED if seed < 0 else grazing_text(seed), encoding="utf-8")
    spec = load_spec(path)
    controller = design(spec)
    preview, told = controller.trajectory.preview, controller.claim(StableInversion).error
    assert preview is not None
    assert (preview.residual <= 1e-10 * preview.terms).all()
    assert integrated(controller, min(spec.scenario.duration, 7.0)) <= told + INTEGRATED
    start = controller.trajectory.state(np.append(controller.trajectory.exosystem.w0, 1.0))
    assert last_tenth(spec, controller, start)[0] <= told
    said = f"but for what is played back, which leaves at most {up(told)} of it"
    assert sentences(spec.words, controller) == [f"all solutions track y_d with error going to 0, {said}"]


def test_a_simulation_shows_what_is_left_by_what_is_played_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Polynomials that are a millionth off: the loop follows the true plant, and what is said is above."""
    monkeypatch.setattr(preview_module, "FITTED", 1e-6)
    path = tmp_path / "plant.yaml"
    path.write_text(PRESSED, encoding="utf-8")
    found = followed(path)
    assert found.left > 1e-9
    assert found.near == pytest.approx(found.left, rel=0.1)
    assert max(found.near, found.left) <= found.bound


def test_what_is_played_back_is_no_more_than_what_bounds_of_signals_say_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over a run so long that nothing else is left of the start."""
    monkeypatch.setattr(preview_module, "FITTED", 1e-6)
    path = tmp_path / "plant.yaml"
    path.write_text(PRESSED.replace("duration: 7", "duration: 200"), encoding="utf-8")
    result = simulate(load_spec(path))
    r, left = result.response, result.controller.claim(StableInversion).by_signal
    assert result.outcome.kind == "tracks"  # and not above its own bound
    seen: dict[Form, Array] = {("output", 0): r.tracking_error[:, 0], ("input", 0): (r.u - r.u_ff)[:, 0]}
    for signal, values in seen.items():
        late = np.abs(values[-2000:]).max()
        assert 1e-8 < late <= left[signal]
        assert (np.abs(values) <= result.bands[signal]).all()
    assert [left["estimate", k] for k in range(2)] == [0.0, 0.0]
    said = "each signal is in the end at most the sum of these, beside what is played back, in proportion to what acts"
    assert said in next(result.controller.claim(SignalBounds).rows(result.spec.words, result.controller))[1]
    console = Console(file=StringIO(), width=300)
    print_all(console, Findings(spec=result.spec, controller=result.controller))
    printed = console.file.getvalue()  # type: ignore[attr-defined]
    assert "from every start y − y_d and x − x_d go to what is played back leaves of it at least as fast" in printed


def test_what_is_played_back_adds_to_the_bounds_of_a_box(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The box is so small that w makes less of the error than the residual does."""
    monkeypatch.setattr(preview_module, "FITTED", 1e-6)
    box = "parameters: {k: 100}\ndesign: {uncertain: {k: [99.9999999, 100.0000001]}}\nsystem:"
    text = PRESSED.replace("slope: 100", "slope: k").replace("system:", box).replace("duration: 7", "duration: 60")
    path = tmp_path / "plant.yaml"
    path.write_text(text, encoding="utf-8")
    result = simulate(load_spec(path))
    controller, robust = result.controller, result.controller.claim(Robust)
    assert robust is not None
    assert result.w is not None
    r, alone = result.response, robust.reached(result.w.max(axis=0))
    late, (found, _) = np.abs(r.tracking_error[-600:, 0]).max(), box_figures(result, robust).values()
    assert alone["output", 0] < late <= found["bound"]
    assert found["seen"] <= found["bound"]
    assert (np.abs(r.tracking_error[:, 0]) <= result.bands["output", 0]).all()
    assert (
        f"beside what is played back: |y − y_d| ≤ {up(controller.claim(StableInversion).by_signal['output', 0])}, "
        in " ".join(text for _, text in controller.claim(Robust).rows(result.spec.words, controller))
    )


def test_a_residual_is_enclosed_at_all_times(tmp_path: Path) -> None:
    """At 2,000 times of a run of more than a period, with more digits."""
    path = tmp_path / "plant.yaml"
    path.write_text(PRESSED, encoding="utf-8")
    spec = load_spec(path)
    trajectory = desired_trajectory(spec, True)
    preview, system = trajectory.preview, trajectory.exosystem
    assert preview is not None
    assert trajectory.turns is not None
    t = np.random.default_rng(0).uniform(0, 7, 2000).astype(np.longdouble)
    s = np.hstack([system.states(t), np.ones((len(t), 1))])
    cell = (trajectory.signs * np.sign(s @ trajectory.guards.T)[:, None] >= 0).all(axis=2).argmax(axis=1)
    rho = s[:, :-1] @ system.S.T - np.einsum("tij,tj->ti", trajectory.turns[cell], s)[:, :-1]
    eta = system.Q[-1] != 0
    assert np.abs(rho[:, eta]).max() <= preview.residual[0]
    assert np.abs(rho[:, eta]).max() >= preview.residual[0] / 10  # the largest of so many times, and at most
    left = preview.left.states(t) @ preview.left.Q.T
    np.testing.assert_allclose(left[:, 0], rho[:, eta][:, 0], atol=0.1 * preview.residual[0])


def test_a_constant_reference_is_played_back_as_a_constant() -> None:
    arrays = plant(A=[[0, 1], [-1, 1]], B=[[1], [0]], C=[[1, 0]])
    spec = problem(arrays, reference="0.7", simulation={"duration": 1000, "sample_time": 1})
    trajectory = desired_trajectory(spec, True)
    system = trajectory.exosystem
    np.testing.assert_allclose(system.states(np.array([0.0, 1000.0]))[:, -10:] @ system.Q[-1, -10:], 0.7, rtol=1e-12)


TANKS = """\
name: four tanks and two pumps
system:
  states: [h1, h2, h3, h4]
  inputs: [p1, p2]
  outputs: [y1, y2]
  A: [[-0.05, 0, 0.08, 0], [0, -0.06, 0, 0.09], [0, 0, -0.08, 0], [0, 0, 0, -0.09]]
  B: [[0.03, 0], [0, 0.03], [0, 0.07], [0.07, 0]]
  C: [[1, 0, 0, 0], [0, 1, 0, 0]]
  nonlinearities: [{name: drain, kind: spring, of: h3, start: 0.3, slope: 0.02, into: {h3: -1, h1: 1}}]
reference:
  output:
    y1: {constant: 0.5, step: {size: 0.2, centre: 200, smooth: 100}}
    y2: {constant: 0.4, step: {size: 0.2, centre: LATER, smooth: 100}}
simulation: {duration: 800, sample_time: 0.5}
"""


@pytest.mark.parametrize("later", [1e-12, 1e-11, 1e-10, 1e-9])
def test_a_stay_of_no_length_has_the_slope_of_the_field(tmp_path: Path, later: float) -> None:
    """Between two moves of the reference, one just after the other: in so short a time rounding looks like a slope.

    Such stays are left over too where x_d crosses a facet, or not, as rounding has it.
    """
    path = tmp_path / "tanks.yaml"
    path.write_text(TANKS.replace("LATER", repr(200 + later)), encoding="utf-8")
    controller = design(load_spec(path))
    preview = controller.trajectory.preview
    assert preview is not None
    assert 0 < np.diff(preview.times).min() < 1.1 * later
    assert (preview.residual / preview.terms).max() < 1e-11
    assert controller.claim(StableInversion).error < 1e-8


def test_how_long_before_a_move_it_begins_is_said() -> None:
    spec = load_spec(SPECS / "gallery" / "cart_and_pole_swaying.yaml")
    controller = design(spec)
    trajectory = controller.trajectory
    assert trajectory.preview is not None
    assert trajectory.preview.lead is None
    for lead, said in ((None, ""), (0.0, "as the reference moves"), (0.8125, "0.812 s before the reference moves")):
        told = replace(controller.claim(StableInversion), preview=replace(trajectory.preview, lead=lead))
        ahead = list(told.texts(spec.words))[1].partition("known beforehand")[2]
        assert ahead == (said and f"; η leaves its rest {said}")


def test_jumps_of_what_is_played_back_count_one_after_the_other() -> None:
    spec = load_spec(SPECS / "gallery" / "cart_and_pole_swaying.yaml")
    controller = design(spec)
    preview, promised, form = controller.trajectory.preview, controller.guarantees, controller.form
    assert preview is not None
    assert form is not None
    assert len(preview.times) == len(preview.jumps) > 0
    assert preview.jumps.max() < 1e-12
    columns, nothing = np.array([X[:, form.r :] for X in form.T_inverse]), np.zeros(len(form.eta_names))
    jump, late = np.array([0.0, 1.0]), 1e3 / controller.guarantees.rate

    def left(*times: float) -> float:
        jumps = np.tile(jump, (len(times), 1))
        return promised.left(columns, replace(preview, residual=nothing, times=np.array(times), jumps=jumps))

    alone = left(1.0)
    assert left() == 0.0
    assert left(1.0, 1.0) == pytest.approx(2 * alone)
    assert left(1.0, late) == pytest.approx(alone)
    assert alone < left(1.0, 1.1) < 2 * alone
    t = np.linspace(0, 20, 400)
    for A in controller.plant.A + controller.plant.B @ controller.design.K:
        runs = np.array([controller.plant.tracked @ expm(A * s) @ columns[0] @ jump for s in t])
        assert np.abs(runs).max() <= alone


def test_where_nothing_drives_an_unstable_mode_it_rests_at_0_and_no_gain_is_found() -> None:
    arrays = plant(A=[[-1, 0], [0, 1]], B=[[1], [0]], C=[[1, 0], [0, 1]], track=["y1"])
    spec = problem(arrays, reference="sin(t)", simulation={"duration": 10, "sample_time": 0.1})
    with pytest.raises(Infeasible, match=r"no gain moves the eigenvalue 1"):
        design(spec)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "move", "other"),
    [("flexible_arm", "size: 0.9", "size: 0.8"), ("cart_and_pole_on_the_move", "at: 2.25", "at: 2.5")],
)
def test_what_another_processor_worked_out_in_other_steps_is_verified_as_it_is_told(
    specs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, move: str, other: str
) -> None:
    spec = load_spec(specs / "gallery" / f"{name}.yaml")
    with monkeypatch.context() as elsewhere:
        elsewhere.setattr(preview_module, "FITTED", 1e-11)
        run = write_design(spec, design(spec), tmp_path / "run")
    told = "controller.json beside it plays back another x_d than is worked out here"
    assert any(said.startswith(told) for said in verify(run))
    file = run / "controller.json"
    again = "simulate", spec.path, "--controller", file, "--out", tmp_path / "again"
    ended = call(*again)
    assert ended.exit_code == spec.expected_exit, ended.output
    moved = tmp_path / "moved.yaml"
    moved.write_text(spec.path.read_text(encoding="utf-8").replace(move, other), encoding="utf-8")
    assert "not one for this spec: trajectory" in refused(call("simulate", moved, *again[2:]), 2)
    forged = json.loads(file.read_text(encoding="utf-8"))
    pieces = forged["trajectory"]["reference"]["pieces"]
    pieces[-1]["w"][0] += 1e-3 * max(abs(v) for piece in pieces for v in piece["w"][:1])
    file.write_text(json.dumps(forged | {"sha256": digest(forged)}), encoding="utf-8")
    with pytest.raises(CheckFailed, match=r"claims.* in controller\.json is not what was proved"):
        verify(run)


def test_what_is_told_to_be_played_back_is_a_curve() -> None:
    told = {"S": [[0.0, 1.0], [0.0, 0.0]], "Q": [[1.0, 0.0]], "w0": [2.0, 3.0]}
    then = [{"t": 1.0, "start": 0, "w": [5.0, 4.0]}]
    found = told_pieces(told | {"pieces": then}, 0, None, 3.0)
    assert found.start.tolist() == [0.0, 1.0]
    assert found.length.tolist() == [1.0, 2.0]
    assert found.c[:, 0, :3].tolist() == [[2.0, 3.0, 0.0], [5.0, 4.0, 0.0]]
    for wrong in ([], [{"t": 4.0, "start": 0, "w": [5.0, 4.0]}], [{"t": 1.0, "start": 0, "w": [5.0]}], [{"t": 1.0}]):
        with pytest.raises(ValueError, match=r"played back|broadcast|reshape"):
            told_pieces(told | {"pieces": wrong, "w0": [2.0, 3.0] if wrong else []}, 0, None, 3.0)


def test_curves_are_near_in_units_in_which_their_entries_are_alike() -> None:
    """One that rests at 0 is rounding of the other; what grows is seen at the end, another number of them at once."""

    def curve(*ends: float) -> Pieces:
        c = np.zeros((1, len(ends), 2))
        c[0, :, 0], c[0, :, 1] = 1.0, np.array(ends) - 1.0
        return Pieces(start=np.zeros(1), length=np.ones(1), c=c, of=np.zeros(1, dtype=np.int64))

    resting = replace(curve(1, 1), c=np.array([[[1.0, 0.0], [2e-16, 0.0]]]))
    other = replace(curve(1, 1), c=np.array([[[1.0, 0.0], [-1e-16, 0.0]]]))
    assert resting.is_near(other, np.ones(2))
    assert not resting.is_near(other, np.array([1.0, 1e-9]))
    assert curve(2.0, 1.0).is_near(curve(2.0 + 1e-7, 1.0), np.ones(2))
    assert not curve(2.0, 1.0).is_near(curve(2.0 + 1e-5, 1.0), np.ones(2))
    assert not curve(2.0, 1.0).is_near(curve(2.0), np.ones(2))
