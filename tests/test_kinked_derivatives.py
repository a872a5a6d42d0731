"""A last derivative that is piecewise affine: Φ with its cells, a feedforward that jumps."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pwatrack import OutsideTheory, design, ensemble, load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.commands.verify import verify
from pwatrack.control.generator import trajectory_generator
from pwatrack.control.trajectory import output_trajectory
from pwatrack.lmi.audit.certificate import audit
from pwatrack.model.cells import Partition
from pwatrack.model.normal_form import normal_form
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import exosystem
from pwatrack.model.signal import Signal
from pwatrack.report.files import write_result
from pwatrack.simulation.closed_loop import ClosedLoop
from pwatrack.spec.expression import formula
from tests.conftest import SPECS
from tests.plants import random_outputs
from tests.promises import follow, followed

KINDS = [((2,), 2, 0), ((3,), 1, 0), ((2, 2), 1, 0), ((2, 1), 2, 1), ((2,), 2, 1)]


def bent_plant(seed: int) -> PWASystem:
    degrees, internal, spare = KINDS[seed % len(KINDS)]
    return random_outputs(seed, degrees, internal, spare, k=1 + seed % 2, bent=True)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12))
def test_random_plants_with_a_kinked_last_derivative_are_followed(seed: int) -> None:
    plant = bent_plant(seed)
    assert normal_form(plant).piecewise == tuple(r > 1 for r in KINDS[seed % len(KINDS)][0])
    assert follow(plant, seed) < 1e-8


@pytest.mark.parametrize("seed", range(10))
def test_every_xi_and_eta_belong_to_one_state_and_it_is_found(seed: int) -> None:
    """Φ is one-to-one and onto: for any (ξ, η) the state of exactly one cell is inside its cell."""
    plant, random = bent_plant(seed), np.random.default_rng(seed)
    form = normal_form(plant)
    waves = [Signal.of(formula("sin(t)", {})) for _ in form.degrees]
    trajectory = output_trajectory(trajectory_generator(form), exosystem(waves))
    visited = set()
    for _ in range(50):
        w = random.normal(size=len(trajectory.exosystem.w0)) * 2
        s = np.concatenate([random.normal(size=len(trajectory.names)) * 2, w, [1.0]])
        x = trajectory.state(s)
        inside = []
        for i in range(len(form.T)):
            x_i = trajectory.x_d[i] @ s
            sides = plant.partition.H @ x_i + plant.partition.h
            inside += [i] if (plant.partition.signs[i] * np.sign(sides) >= 0).all() else []
        assert len(inside) == 1
        assert plant.partition.locate(x) == inside[0]
        visited.add(inside[0])
        xi = form.T[inside[0]] @ x + form.offset[inside[0]]
        place = 0
        for j, degree in enumerate(form.degrees):  # ξ is y, ẏ, … of the plant, from its own field
            row, rows = plant.tracked[j], 0.0
            for k in range(degree):
                assert xi[place + k] == pytest.approx(float(row @ x) + rows, abs=1e-9)
                rows = float(row @ plant.b[inside[0]])
                row = row @ plant.A[inside[0]]
            place += degree
    assert len(visited) > 1


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1])
def test_the_closed_loop_agrees_with_a_tight_integrator(seed: int) -> None:
    """(1), (18), (19) and the generator written out with located cells; u jumps where x_d crosses."""
    loop, response = followed(bent_plant(seed), seed, duration=3.0)
    solution = solve_ivp(
        lambda t, state: right_hand_side(loop, t, state),
        (0.0, 3.0),
        start_of(loop, seed),
        t_eval=[1.0, 2.0, 3.0],
        rtol=1e-10,
        atol=1e-12,
        max_step=5e-3,
    )
    n = len(loop.plant.B)
    for k, state in zip((1, 2, 3), solution.y.T, strict=True):
        sample = round(k / 3.0 * (len(response.t) - 1))
        np.testing.assert_allclose(response.x[sample], state[:n], atol=2e-4 * np.abs(response.x).max())


def start_of(loop: ClosedLoop, seed: int) -> Array:
    n, p = len(loop.plant.B), loop.controller.trajectory.rate.shape[1]
    return np.concatenate([np.random.default_rng(seed).normal(size=n), np.zeros(n + p)])


def right_hand_side(loop: ClosedLoop, t: float, state: Array) -> Array:
    controller, plant, trajectory = loop.controller, loop.controller.plant, loop.controller.trajectory
    n = plant.A.shape[1]
    x, x_hat, eta = state[:n], state[n : 2 * n], state[2 * n :]
    s = np.concatenate([eta, trajectory.exosystem.states(np.array([t]))[0], [1.0]])
    x_d = trajectory.state(s)
    cell = plant.partition.locate(x_d)
    u = controller.design.K @ (x_hat - x_d) + trajectory.u_ff[cell] @ s
    innovation = controller.design.L @ (plant.C @ (x_hat - x))
    return np.concatenate([plant.field(x, u), plant.field(x_hat, u) + innovation, trajectory.rate[cell] @ s])


def tanks(low: str, high: str) -> PWASystem:
    """ẋ1 = −2 x1 + u, ẋ2 = p(x1) − x2, y = x2; p has one slope below x1 = 1 and another above."""
    return PWASystem.create(
        partition=Partition.create(H=[["1", "0"]], h=["-1"], signs=[[-1], [1]], names=["below", "above"]),
        A=[[["-2", "0"], [slope, "-1"]] for slope in (low, high)],
        b=[["0", "0"], ["0", str(int(low) - int(high))]],
        B=[["1"], ["0"]],
        C=[["0", "1"]],
    )


def test_two_tanks_by_hand() -> None:
    """x1 = p⁻¹(ẏ + y) and u = (ÿ + ẏ) / p' + 2 x1, which jumps at x1 = 1 by (1 − 1/3) (ÿ + ẏ)."""
    form = normal_form(tanks("1", "3"))
    assert (form.degrees, form.piecewise) == ((2,), (True,))
    assert form.D[:, 0, 0].tolist() == [1.0, 3.0]
    assert form.exact.T[1].texts == [["0", "1"], ["3", "-1"]]
    y_d = formula("0.6 + sin(t)", {})
    trajectory = output_trajectory(trajectory_generator(form), exosystem([Signal.of(y_d)]))
    for t in np.linspace(0, 6, 25):
        y, dy, ddy = 0.6 + np.sin(t), np.cos(t), -np.sin(t)
        flow = dy + y
        x1, slope = (flow, 1.0) if flow < 1 else (1 + (flow - 1) / 3, 3.0)
        s = np.append(trajectory.exosystem.states(np.array([t]))[0], 1.0)
        np.testing.assert_allclose(trajectory.state(s), [x1, y], atol=1e-12)
        cell = int(flow > 1)
        np.testing.assert_allclose(trajectory.u_ff[cell] @ s, [(ddy + dy) / slope + 2 * x1], atol=1e-12)


def test_an_input_that_does_not_move_the_last_derivative_the_same_way_everywhere_is_refused() -> None:
    with pytest.raises(OutsideTheory, match=r"no input enters it in 'above'.*'x1' is 0 and 1.*jumps on x1 = 1"):
        normal_form(tanks("1", "0"))
    with pytest.raises(OutsideTheory, match=r"the same way in all: .* is -1 in cell 'above' and 1 in 'below'"):
        normal_form(tanks("1", "-1"))


def test_kinked_tanks_are_followed_to_rounding_through_every_kink(tmp_path: Path) -> None:
    """In the end plant, observer and generator cross together, within rounding, and nothing chatters."""
    result = simulate(load_spec(SPECS / "gallery" / "kinked_tanks.yaml"))
    assert np.abs(result.response.tracking_error[-200:]).max() < 1e-12
    late = [event.t for event in result.response.trace.events if event.t > 600]
    periods = 5  # of 120 s, with two passes of the hole in each, and of the edge
    together = np.count_nonzero(np.diff(late) > 1e-3) + 1
    assert together == 4 * periods
    jump = np.abs(np.diff(result.response.u_ff[:, 0])).max()
    assert jump > 0.005
    folder = write_result(result, tmp_path / "run", plots="none")
    assert "Theorem 3, output tracking: none of its inequalities is absent" in verify(folder)
    content = json.loads((folder / "certificate.json").read_text())
    generator = content["generator"]
    for other in ({"scales": ["-1"]}, {"relative_degrees": [1]}, {"T": generator["T"][::-1]}, {"directions": [["0"]]}):
        assert audit(json.dumps(content | {"generator": generator | other}))[1]


def test_an_ensemble_and_a_sampled_controller_follow_through_kinks(tmp_path: Path) -> None:
    text = (SPECS / "gallery" / "kinked_tanks.yaml").read_text().split("require:")[0]
    path = tmp_path / "tanks.yaml"
    path.write_text(text + "  ensemble: {initial: {plant: {h1: [0.2, 0.8], h2: [0.3, 1.1]}}}\n")
    assert ensemble(simulate(load_spec(path)), 5).ensemble.final.max() < 1e-9
    path.write_text(text + "  controller: {sample_time: 0.5}\n")
    assert np.abs(simulate(load_spec(path)).response.tracking_error[-200:]).max() < 1e-2


def estimating(tmp_path: Path, estimate: str, disturbance: str) -> Path:
    text = (SPECS / "gallery" / "kinked_tanks.yaml").read_text().split("require:")[0]
    path = tmp_path / "tanks.yaml"
    text = text.replace("reference:", f"design: {{estimate: {estimate}}}\nreference:", 1)
    path.write_text(f"{text}  disturbance: {disturbance}\n")
    return path


def test_loads_where_the_input_enters_are_made_up_for_through_kinks(tmp_path: Path) -> None:
    result = simulate(load_spec(estimating(tmp_path, "input", "{h1: -0.002/a}")))
    assert np.abs(result.response.tracking_error[-200:]).max() < 1e-7
    assert result.response.estimates[-1, 0] == pytest.approx(-0.002, abs=1e-6)
    assert verify(write_result(result, tmp_path / "run", plots="none"))


def test_loads_that_move_a_kinked_derivative_are_refused_by_name(tmp_path: Path) -> None:
    spec = load_spec(estimating(tmp_path, "{rain: {into: {h2: 1/b}}}", "{h2: 0.001/b}"))
    with pytest.raises(OutsideTheory, match="unknown loads rain move the last derivative of 'y'") as refusal:
        design(spec)
    assert refusal.value.problems[0].place is not None
