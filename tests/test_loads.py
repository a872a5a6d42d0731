"""Unknown loads: seen by the outputs or not, estimated, compensated; against frequency responses and plain ranks."""

import json
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.linalg import block_diag, expm

from pwatrack import design, load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.claims.bounds import SignalBounds
from pwatrack.commands.verify import verify
from pwatrack.control.modes import check_loads
from pwatrack.control.program import program
from pwatrack.errors import Infeasible, InvalidSpec, OutsideTheory
from pwatrack.lmi.audit.certificate import audit
from pwatrack.lmi.infeasibility import Impossibility
from pwatrack.model.conditions import Conditions, Sampling
from pwatrack.model.loads import Load, Loads
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import exosystem
from pwatrack.model.signal import Signal
from pwatrack.real import Real
from pwatrack.report.certificate import design_certificate, refusal_certificate
from pwatrack.report.files import write_result
from pwatrack.simulation.closed_loop import ClosedLoop, closed_loop
from pwatrack.simulation.sampled_runs import SampleMaps
from pwatrack.spec.expression import formula
from pwatrack.workflow.sizing import spec_sizes
from tests.conftest import SPECS
from tests.plants import random_plant
from tests.promises import run, track, worst

PAYLOAD = """
name: Payload
parameters: {{k: 4, c: 0.5}}
system:
  states: [z1, v1, z2, v2]
  inputs: [u]
  outputs: [y1, y2]
  track: {track}
  units: {{z1: m, v1: m/s, z2: m, v2: m/s, u: N}}
  A: [[0, 1, 0, 0], [-k - 1, -c - 1, k, c], [0, 0, 0, 1], [k, c, -k, -c]]
  nonlinearities:
    - {{name: stop, kind: spring, of: z1, start: 0.5, slope: 3, into: {{v1: -1}}}}
  B: [[0], [1], [0], [0]]
  C: {C}
design: {design}
reference: {reference}
simulation: {{duration: 60, sample_time: 0.01, {simulation}}}
"""
POSITIONS = "[[1, 0, 0, 0], [0, 0, 1, 0]]"
WIND = "{estimate: {wind: {into: {v2: 2}}, hum: {into: {v1: 1, v2: -1}, frequency: 3}}}"
ACTING = "disturbance: {v2: {constant: 0.4, sine: {amplitude: -0.3, frequency: 3, phase: 1}}, "
ACTING += "v1: {sine: {amplitude: 0.3, frequency: 3, phase: 1}}}"


def write(
    folder: Path,
    design: str = WIND,
    simulation: str = ACTING,
    reference: str = "{output: 0.1}",
    track: str = "[y2]",
    C: str = POSITIONS,
) -> Path:
    path = folder / "payload.yaml"
    values = {"design": design, "simulation": simulation, "reference": reference, "track": track, "C": C}
    path.write_text(PAYLOAD.format(**values), encoding="utf-8")
    return path


def with_loads(plant: PWASystem, E: Array, frequencies: list[float]) -> PWASystem:
    loads = [
        Load(
            name=f"d{k}",
            into={j: Real.of(float(v)) for j, v in enumerate(column) if v},
            frequency=Real.of(frequency),
        )
        for k, (column, frequency) in enumerate(zip(E.T, frequencies, strict=True))
    ]
    return replace(plant, loads=Loads.of(loads, states=len(plant.states)))


def test_estimates_compensate_as_the_frequency_response_says(tmp_path: Path) -> None:
    """In one cell: (jω − A) X = B U + E and c X = 0 say how x_d and u_ff move with a load, by hand; none is matched."""
    result = simulate(load_spec(write(tmp_path)))
    r, A = result.response, np.array([[0, 1, 0, 0], [-5, -1.5, 4, 0.5], [0, 0, 0, 1], [4, 0.5, -4, -0.5]])
    B, c = np.array([[0.0], [1], [0], [0]]), np.array([[0.0, 0, 1, 0]])

    def response(frequency: float, push: Array, y: complex = 0.0) -> np.ndarray:
        left = np.block([[1j * frequency * np.eye(4) - A, -B], [c, np.zeros((1, 1))]])
        return np.asarray(np.linalg.solve(left, np.append(push, y)))

    steady = response(0, np.array([0, 0, 0, 0.4]), 0.1).real
    hum = response(3, np.array([0, 0.3, 0, -0.3]) * np.exp(1j))
    expected = steady + (hum * np.exp(3j * r.t)[:, None]).imag
    late = r.t > 50
    assert np.abs(expected[late, 0]).max() < 0.5  # before the stop
    assert np.allclose(r.x[late], expected[late, :4], atol=1e-9)
    assert np.allclose(r.x_d[late], expected[late, :4], atol=1e-9)
    assert np.allclose(r.u_ff[late, 0], expected[late, 4], atol=1e-8)
    assert np.allclose(r.estimates[late], r.loads[late], atol=1e-8)
    assert np.allclose(r.loads, np.column_stack([0 * r.t + 0.2, 0.3 * np.sin(3 * r.t + 1)]), atol=1e-12)
    assert np.abs(r.tracking_error[late]).max() < 1e-9
    assert np.abs(np.diff(r.tracked_d, axis=0)).max() < 1e-12  # learning moves no y_d
    blind = simulate(load_spec(write(tmp_path, "{tracking: output}"))).response
    assert np.abs(blind.tracking_error[late]).max() > 0.05


def effect(seed: int) -> tuple[float, float]:
    """The final tracking error of a random plant under loads, with their estimates and without."""
    random = np.random.default_rng(7000 + seed)
    r = 1 + seed % 3
    n = int(random.integers(max(r, 2), 6))
    plant = random_plant(seed, n=n, k=1 + seed % 2, r=r, strength=0.05)
    frequencies = [[0.0], [round(random.uniform(0.5, 4), 2)], [0.0, 1.5]][seed // 2 % 3]
    E = plant.B @ random.normal(size=(1, len(frequencies))) if seed % 2 else random.normal(size=(n, len(frequencies)))
    pushes = [f"{random.uniform(0.5, 2)}" + (f"*sin({w}*t + {random.uniform(0, 6)})" if w else "") for w in frequencies]
    signals = [" + ".join(f"({E[j, k]})*{push}" for k, push in enumerate(pushes)) for j in range(n)]
    disturbance = exosystem([Signal.of(formula(signal, {})) for signal in signals])
    found = []
    for system in (plant, with_loads(plant, E, frequencies)):
        loop = track(system, "0.5*sin(2*t)")
        loop = closed_loop(loop.controller, Conditions(disturbance=disturbance))
        promised = loop.controller.guarantees
        slowest = min(promised.rate, *(p.rate for p in promised.generator)) if promised.generator else promised.rate
        end = min(40 / slowest + 20, 4000)
        response = run(loop, random.normal(size=n) * 0.3, end, end / 2000)
        found.append(float(np.abs(response.tracking_error[-300:]).max()))
    return found[1], found[0]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2, 3, 4, 5])
def test_with_estimates_next_to_nothing_is_left_of_what_loads_do(seed: int) -> None:
    estimated, blind = effect(seed)
    assert estimated < 1e-6 * blind


def test_errors_are_driven_as_the_proof_says(tmp_path: Path) -> None:
    """e' = (A_i + B K) e + [B K − X L_s C, −E] (Δ, σ) holds for every state of the flow that is simulated."""
    loop = simulate(load_spec(write(tmp_path))).loop
    plant, gains, at = loop.controller.plant, loop.controller.design, loop.at
    assert loop.conditions.disturbance is not None
    S_w = loop.conditions.disturbance.S
    wind, hum = loop.load_rows
    turned = np.zeros(at.order)
    turned[at.d] = hum[at.d] @ S_w / 3  # ḋ / ω
    z = np.eye(at.order)  # of ζ, whose x is counted from x_d, and x̂ from x
    assert loop.flow.counted is not None
    assert np.array_equal(loop.flow.counted[at.x], loop.x_d[0])
    e, Delta = z[at.x], z[at.x_hat]
    sigma = z[at.s_hat] - np.array([wind, hum, turned])
    X = loop.x_d[0, :, at.s_hat]
    E = np.array([[0, 0, 0], [0, 1, 0], [0, 0, 0], [2, -1, 0]])
    assert np.abs(X).max() > 0.1
    states = np.random.default_rng(1).normal(size=(20, at.order))
    states[:, at.d] = loop.conditions.disturbance.states(np.linspace(0.0, 5.0, 20))  # of loads, and nothing beside
    for i in range(2):
        B_K = plant.B @ gains.K
        expected = (plant.A[i] + B_K) @ e + (B_K - X @ gains.L[4:] @ plant.C) @ Delta - E @ sigma
        found = e @ loop.flow.matrix((i, i, i))
        assert np.allclose((found @ states.T), (expected @ states.T), atol=1e-10 * np.abs(found).max())


def joint_with_loads(loop: ClosedLoop, k: int) -> tuple[Array, Array]:
    """M_ij of (e, Δ, σ) and g of the noise of sensor k, in plain floating point."""
    plant, K, L = loop.controller.plant, loop.controller.design.K, loop.controller.design.L
    X, E = loop.x_d[0, :, loop.at.s_hat], np.array([[0, 0, 0], [0, 1, 0], [0, 0, 0], [2, -1, 0.0]])
    S, C = np.array([[0, 0, 0], [0, 0, 3], [0, -3, 0.0]]), np.hstack([plant.C, np.zeros((2, 3))])
    drive = np.hstack([plant.B @ K - X @ L[4:] @ plant.C, -E])
    observers = [np.block([[A, E], [np.zeros((3, 4)), S]]) + L @ C for A in plant.A]
    M = [np.block([[A + plant.B @ K, drive], [np.zeros((7, 4)), watch]]) for A in plant.A for watch in observers]
    return np.array(M), np.concatenate([X @ L[4:, k], -L[:, k]])


@pytest.mark.slow
def test_bounds_hold_beside_loads_and_are_not_far_above_what_noise_can_do(tmp_path: Path) -> None:
    loop = simulate(load_spec(write(tmp_path))).loop
    for bounds in loop.controller.claim(SignalBounds).acting[-2:]:
        M, g = joint_with_loads(loop, bounds.channel[1])
        row = np.concatenate([loop.controller.plant.tracked[0], np.zeros(7)])
        least = worst(M, g, row, duration=30)
        assert least <= bounds.sizes["output", 0] <= 4 * least
        assert {("estimate", 4), ("estimate", 5)} <= set(bounds.sizes)
        assert ("estimate", 6) not in bounds.sizes  # only half of a sinusoid


@pytest.mark.slow
def test_bounds_in_two_steps_are_proved_beside_loads_too() -> None:
    """Of 16 cells there are too many pairs; what is bounded in two steps is above what one pair can do."""
    plant = with_loads(random_plant(3, n=4, k=4, r=2, strength=0.05), np.eye(4)[:, 1:2] + np.eye(4)[:, 3:], [0.0])
    loop = track(plant, "0.2*sin(t)")
    kinds = {part.loop for bounds in loop.controller.claim(SignalBounds).acting for part in bounds.parts}
    assert kinds == {"controller", "observer"}
    K, L, X = loop.controller.design.K, loop.controller.design.L, loop.x_d[0, :, loop.at.s_hat]
    E = np.eye(4)[:, 1:2] + np.eye(4)[:, 3:]
    drive = np.hstack([plant.B @ K - X @ L[4:] @ plant.C, -E])
    C = np.hstack([plant.C, [[0.0]]])
    observer = np.block([[plant.A[0], E], [np.zeros((1, 5))]]) + L @ C
    M = np.block([[plant.A[0] + plant.B @ K, drive], [np.zeros((5, 4)), observer]])
    row = np.concatenate([plant.tracked[0], np.zeros(5)])
    for bounds in loop.controller.claim(SignalBounds).acting:
        kind, k = bounds.channel
        push = np.concatenate([np.eye(4)[k], -np.eye(5)[k]])
        g = push if kind == "disturbance" else np.concatenate([X @ L[4:, k], -L[:, k]])
        least = worst(M[None], g, row, duration=60)
        assert least <= bounds.sizes["output", 0] <= 300 * least


@pytest.mark.slow
def test_the_auditor_proves_two_steps_again_and_finds_a_smaller_bound(tmp_path: Path) -> None:
    path = write(tmp_path, "{estimate: {wind: {into: {v2: 2}}}}", "")
    springs = "".join(
        f"    - {{name: s{k}, kind: spring, of: z{1 + k % 2}, start: {0.6 + 0.1 * k}, slope: 0.2, into: {{v1: -1}}}}\n"
        for k in range(5)
    )
    text = path.read_text(encoding="utf-8").replace("  B: [[0]", springs.replace("of: z2", "of: v1") + "  B: [[0]")
    path.write_text(text, encoding="utf-8")
    spec = load_spec(path)
    content = design_certificate(spec, design(spec))
    assert audit(json.dumps(content))[1] == []
    steps = [part for part in content["bounds"][0]["parts"] if part["loop"] == "observer"]
    place = next(k for k, signal in enumerate(steps[0]["signals"]) if signal[0] == "coupling")
    steps[0]["signals"][place][2] = "1e-06"
    assert any("coupling" in fault for fault in audit(json.dumps(content))[1])


small = st.integers(-2, 2)


@settings(max_examples=60)
@given(*(st.lists(small, min_size=size, max_size=size) for size in (9, 6, 6)))
def test_what_is_hidden_is_what_the_rank_of_the_pencil_says(a: list[int], e: list[int], c: list[int]) -> None:
    A, E, C = np.array(a).reshape(3, 3), np.array(e).reshape(3, 2), np.array(c).reshape(2, 3)
    assume(E.any(axis=0).all() and C.any())
    plant = random_plant(1, n=3, k=1, r=1)
    plant = PWASystem.create(partition=plant.partition, A=np.array([A, A]), b=np.zeros((2, 3)), B=plant.B, C=C)
    for frequency in (0.0, 2.0):
        pencil = np.block([[A - 1j * frequency * np.eye(3), E], [C, np.zeros((2, 2))]])
        hidden = np.linalg.matrix_rank(pencil, tol=1e-9) < 5
        loaded = with_loads(plant, E.astype(float), [frequency, frequency])
        with pytest.raises(Infeasible, match="the rank of") if hidden else nullcontext():
            check_loads(loaded, output=True)


@pytest.mark.parametrize(
    ("C", "estimate", "message"),
    [
        (POSITIONS, "{a: {into: {v1: 1}}, b: {into: {v2: 1}}, leak: {into: {z1: 1}}}", "not tell more than 2"),
        ("[[0, 1, 0, 0], [0, 0, 0, 1]]", "{a: {into: {z1: 1, z2: 1, v1: 1}}}", None),
        ("[[0, 1, 0, 0], [0, 0, 0, 1]]", "{a: {into: {v1: 1}}}", "in cell '.*' .*there is a zero at 0.* is 4, and 5"),
    ],
)
def test_loads_that_no_output_shows_are_refused_with_a_proof(
    tmp_path: Path, C: str, estimate: str, message: str | None
) -> None:
    """Two speeds do not tell a constant force on a mass that a spring holds: at rest both are 0."""
    spec = load_spec(write(tmp_path, f"{{estimate: {estimate}}}", "", C=C, track="{payload: z2}"))
    if message is None:
        check_loads(spec.problem.plant, output=True)
        return
    with pytest.raises(Infeasible, match=message) as refusal:
        design(spec)
    problem = refusal.value.problems[0]
    assert problem.place is not None
    assert "estimate" in spec.path.read_text(encoding="utf-8").splitlines()[problem.place.line - 1]
    assert refusal.value.evidence is not None


def test_as_many_loads_as_outputs_must_be_seen_with_one_sign_in_all_cells(tmp_path: Path) -> None:
    """At rest v = −d and v = 2 z or −z, so z + 2 v falls or rises with d: somewhere between it does not move."""
    path = tmp_path / "hill.yaml"
    path.write_text(
        """
name: Hill
system:
  states: [z, v]
  inputs: [u]
  outputs: [y]
  A: [[0, 1], [2, -1]]
  nonlinearities: [{name: far, kind: spring, of: z, start: 0, slope: 3, into: {v: -1}}]
  B: [[0], [1]]
  C: [[1, 0]]
design: {estimate: {tilt: {into: {z: 1}}}}
reference: {output: 0.1*sin(t)}
simulation: {duration: 5, sample_time: 0.1}
""",
        encoding="utf-8",
    )
    assert design(load_spec(path)).plant.loads is not None  # det = C adj(A) E: the same in both cells
    path.write_text(
        path.read_text(encoding="utf-8").replace("C: [[1, 0]]", "C: [[1, 2]]\n  track: {place: z}"), encoding="utf-8"
    )
    spec = load_spec(path)
    sizes = [np.linalg.det(np.vstack([np.column_stack([A, [1, 0]]), [1, 2, 0]])) for A in spec.problem.plant.A]
    assert sizes[0] * sizes[1] < 0
    with pytest.raises(Infeasible, match=r"det \[A, E; C, 0\] has another sign in each, 5 and -1|-1 and 5") as refusal:
        design(spec)
    evidence = refusal.value.evidence
    assert isinstance(evidence, Impossibility)
    assert audit(json.dumps(refusal_certificate(spec, evidence)))[1] == []


@pytest.mark.slow
def test_the_certificate_holds_the_loads_and_the_auditor_finds_what_is_changed(tmp_path: Path) -> None:
    result = simulate(load_spec(write(tmp_path)))
    content = json.dumps(design_certificate(result.spec, result.controller))
    assert audit(content)[1] == []

    def faults(change: str, *path: object) -> list[str]:
        other = json.loads(content)
        inside = other
        for key in path[:-1]:
            inside = inside[key]
        inside[path[-1]] = json.loads(change)
        return audit(json.dumps(other))[1]

    assert faults("null", "plant", "loads")
    assert faults('[["0","0","0"],["0","1","0"],["0","0","0"],["20","-1","0"]]', "plant", "loads", "E")
    assert faults('[["0","0","0"],["0","0","30"],["0","-30","0"]]', "plant", "loads", "S")
    folder = write_result(result, tmp_path / "run")
    assert any("the same" in said for said in verify(folder))
    estimates = json.loads((folder / "run.json").read_text(encoding="utf-8"))["estimates"]
    assert estimates["wind"]["load"] == pytest.approx(0.2)
    assert estimates["wind"]["estimate"] == pytest.approx(0.2, rel=1e-6)
    assert (estimates["wind"]["kind"], estimates["hum"]["kind"]) == ("constant", "3 rad/s")
    assert (folder / "estimates.png").is_file()
    added = json.loads((folder / "generator.json").read_text(encoding="utf-8"))["loads"]
    loop = result.loop
    assert np.array_equal(np.array(added["x_d"]), loop.x_d[0, :, loop.at.s_hat])
    assert np.shape(added["u_ff"]) == (2, 1, 3)
    header = (folder / "trace.csv").read_text(encoding="utf-8").split("\n", 1)[0].split(",")
    assert {"wind", "wind_hat", "hum", "hum_hat"} <= set(header)


def test_the_proofs_are_about_loads_that_are_estimated_and_not_about_others(tmp_path: Path) -> None:
    cases = {
        ACTING: [],
        "disturbance: {v2: {constant: 0.4}}": [],
        "disturbance: {v2: {sine: {amplitude: 1, frequency: 2}}}": ["disturbance on dv2/dt"],  # of another frequency
        "disturbance: {v1: {constant: 1}}": ["disturbance on dv1/dt"],  # at another place
        "disturbance: {v2: {formula: 0.01*t, until: 60}}": ["disturbance on dv2/dt"],
        "disturbance: {v2: {step: {size: 1, at: 3}}}": ["disturbance on dv2/dt"],  # each step is learned anew
    }
    controller = design(load_spec(write(tmp_path)))
    for simulation, beyond in cases.items():
        conditions = load_spec(write(tmp_path, simulation=simulation)).scenario.conditions
        assert closed_loop(controller, conditions).beyond_the_proofs() == beyond


def test_a_load_at_each_input_is_short_for_its_column(tmp_path: Path) -> None:
    short = design(load_spec(write(tmp_path, "{estimate: input}", "")))
    long = design(load_spec(write(tmp_path, "{estimate: {load_u: {into: {v1: 1}}}}", "")))
    assert short.plant.loads is not None
    assert short.plant.loads.names == ("load_u",)
    assert np.array_equal(short.design.L, long.design.L)
    added = short.compensation
    assert np.allclose(added.u_ff, -1)  # matched: it is taken off, and nothing else moves
    assert not added.X.floats.any()
    assert np.abs(added.rate).max() < 1e-12


def test_the_unit_of_a_load_does_not_matter(tmp_path: Path) -> None:
    one, other = (
        design(load_spec(write(tmp_path, f"{{estimate: {{wind: {{into: {{v2: {factor}}}}}}}}}", "")))
        for factor in ("1", "1/1048576")
    )
    assert np.allclose(one.design.L[:4], other.design.L[:4], rtol=1e-6)
    assert np.allclose(one.design.L[4:] * 2**20, other.design.L[4:], rtol=1e-6)


def test_a_load_of_larger_size_is_learned_faster(tmp_path: Path) -> None:
    plain = load_spec(write(tmp_path, "{estimate: {wind: {into: {v2: 2}}}}", ""))
    balanced = spec_sizes(plain).load
    path = write(tmp_path, "{estimate: {wind: {into: {v2: 2}}}}", "")
    text = path.read_text(encoding="utf-8").replace("  units:", f"  sizes: {{wind: {100 * balanced[0]}}}\n  units:")
    path.write_text(text, encoding="utf-8")
    sized = load_spec(path)
    assert np.allclose(spec_sizes(sized).load, 100 * balanced)
    assert np.abs(design(sized).design.L[4]).max() > 10 * np.abs(design(plain).design.L[4]).max()


def test_a_set_point_is_held_exactly_with_wrong_parameters(tmp_path: Path) -> None:
    """At rest a wrong stiffness is a constant force: with one estimated nothing is left of it."""
    other = "plant: {parameters: {k: 5, c: 0.6}}, initial: {plant: [0.1, 0, 0.1, 0]}"
    ref, wall = "{output: 0.3}", "[[1, 0, 0, 0], [0, 0, 1, 0]]"
    errors = [
        simulate(load_spec(write(tmp_path, plan, other + ", disturbance: {v1: {constant: 0.1}}", ref, C=wall)))
        for plan in ("{estimate: input}", "{tracking: output}")
    ]
    assert errors[0].final_error < 1e-8 < 1e-3 < errors[1].final_error


@pytest.mark.slow
def test_a_sampled_controller_estimates_too(tmp_path: Path) -> None:
    spec = load_spec(write(tmp_path, reference="{output: 0.1*sin(t)}"))
    fast = replace(spec.scenario.conditions, sampling=Sampling(sample_time=0.002))
    sampled = simulate(replace(spec, scenario=replace(spec.scenario, conditions=fast)))
    assert sampled.final_error < 2e-3
    assert np.abs((sampled.response.estimates - sampled.response.loads)[-500:]).max() < 5e-3


def test_between_ticks_the_program_turns_sinusoids_on(tmp_path: Path) -> None:
    """η̂ is stepped by the exponential of the generator, its reference and the loads, which turn meanwhile."""
    controller = design(load_spec(write(tmp_path, reference="{output: 0.1*sin(2*t)}")))
    found = program(controller, Conditions(sampling=Sampling(sample_time=0.3)))
    trajectory, added = controller.trajectory, controller.compensation
    assert controller.plant.loads is not None
    for cell in range(2):
        rate = trajectory.rate[cell]
        p = len(rate)
        whole = block_diag(rate[:, :p], trajectory.exosystem.S, [[0.0]], controller.plant.loads.S.floats)
        whole[:p, p:] = np.hstack([rate[:, p:], added.rate[cell]])
        expected = expm(0.3 * whole)[:p]
        size = rate.shape[1]
        assert np.allclose(found.generator[cell], np.hstack([expected[:, size:], expected[:, :size]]), atol=1e-12)


def test_the_map_of_one_sample_has_estimates_and_generator_in_it(tmp_path: Path) -> None:
    """Its eigenvalues are among those of the flow that is simulated, from tick to tick in one mode."""
    controller = design(load_spec(write(tmp_path, reference="{output: 0.1*sin(2*t)}")))
    for h in (0.01, 0.2):
        sampling = Sampling(sample_time=h, method="emulated")
        loop = closed_loop(controller, Conditions(sampling=sampling))
        flow, at, z = loop.flow, loop.at, np.eye(loop.at.order)
        assert flow.clock is not None
        runs = flow.clock.program
        for cell in range(2):
            whole, step, law = expm(flow.matrix((cell, cell, cell)) * h), z.copy(), z.copy()
            step[at.w_held] = z[at.w]
            step[at.observer] = runs.observer[cell] @ np.vstack([z[at.y], z[at.u], z[at.observer], z[-1:]])
            known = np.vstack([z[at.s_hat], z[at.eta_hat], z[at.w_held], z[-1:]])
            step[at.eta_hat] = runs.generator[cell] @ known
            law[at.y] = flow.clock.measured
            law[at.u] = runs.u_ff[cell] @ known + runs.K @ (z[at.x_hat] - runs.x_d[cell] @ known)
            whole = law @ step @ whole
            values = np.linalg.eigvals(whole)
            found = np.linalg.eigvals(SampleMaps(controller, controller.plant, sampling).loop(cell, h))
            assert len(found) == 4 + 4 + 3 + 1
            assert all(np.abs(values - value).min() < 1e-6 for value in found)


@pytest.mark.slow
def test_state_tracking_takes_loads_where_inputs_act_and_no_others(tmp_path: Path) -> None:
    matched = "{tracking: state, estimate: {push: {into: {v1: 2}}, hum: {into: {v1: 1}, frequency: 3}}}"
    acting = "disturbance: {v1: {constant: 0.4, sine: {amplitude: 0.3, frequency: 3}}}"
    result = simulate(load_spec(write(tmp_path, matched, acting, "{setpoint: {y2: 0.2}}")))
    assert result.final_error < 1e-8
    assert np.allclose(result.response.x[-1], [0.2, 0, 0.2, 0], atol=1e-8)
    content = json.loads(json.dumps(design_certificate(result.spec, result.controller)))
    assert audit(json.dumps(content))[1] == []
    content["plant"]["loads"]["E"][3][0] = "1"
    assert "a load enters where no input does, and x_d is given" in audit(json.dumps(content))[1]
    with pytest.raises(OutsideTheory, match="load 'wind' cannot be compensated in state tracking"):
        design(load_spec(write(tmp_path, WIND.replace("{est", "{tracking: state, est"), "", "{setpoint: {y2: 0.2}}")))


@pytest.mark.parametrize(
    ("design", "message"),
    [
        ("{estimate: output}", "estimate: 'output' is neither 'input' nor a list or mapping"),
        ("{estimate: {}}", "at least 1 entry is expected"),
        ("{estimate: {wind: {into: {v3: 1}}}}", "load 'wind': 'v3' is no state"),
        ("{estimate: {wind: {into: {v1: 0}}}}", "load 'wind': all factors are 0"),
        ("{estimate: {wind: {into: {v1: 1}, frequency: -3}}}", "-3 is not positive"),
        ("{estimate: {u: {into: {v1: 1}}}}", "'u' is declared under inputs and under estimate"),
        ("{estimate: {z1_hat: {into: {v1: 1}}}}", "'z1_hat' is how the trace names a signal that belongs to 'z1'"),
        ("{estimate: {wind: {v1: 1}}}", "design.estimate.wind.into is missing"),
        (
            "{estimate: {wind: {into: {v1: 1}}}, observer: {L: [[1, 1], [1, 1], [1, 1], [1, 1]]}}",
            "4 rows, expected 5, one for each of the states and estimates",
        ),
    ],
)
def test_what_is_no_load_is_refused_with_its_place(tmp_path: Path, design: str, message: str) -> None:
    with pytest.raises(InvalidSpec) as refusal:
        load_spec(write(tmp_path, design, ""))
    assert any(message in problem.message and problem.place for problem in refusal.value.problems), refusal.value


def test_the_payload_of_the_gallery_leans_against_the_wind() -> None:
    result = simulate(load_spec(SPECS / "gallery" / "payload_in_wind.yaml"))
    assert result.final_error < 1e-12
    x_d = result.response.x_d[-1000:].mean(axis=0)  # whole periods
    assert np.isclose(x_d[0] - x_d[2], -2 / 500, rtol=1e-6)
