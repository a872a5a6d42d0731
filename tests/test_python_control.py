"""python-control's own simulation of what `to_control` returns is ours."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from pwatrack import Controller, Design, InvalidSpec, design, load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.commands.export import Subject
from pwatrack.model.conditions import NOMINAL, Conditions
from tests.conftest import SPECS
from tests.exported import machine_of

control = pytest.importorskip("control", reason="python-control is not installed")
TIGHT = {"rtol": 1e-10, "atol": 1e-11}
LOOPS = {  # how long, in s
    "two_mass_backlash": 2.0,
    "gallery/payload_in_wind": 0.3,  # loads
    "gallery/two_pumps_two_tanks": 60.0,  # two inputs, a set point
    "gallery/carriage_on_slack_rope": 0.15,  # the observer has more cells than the desired trajectory
    "gallery/stage_with_bumpers": 0.2,  # the observer starts from what is measured
    "gallery/heated_hall": 2880.0,  # the generator starts in steady state
    "gallery/two_rooms": 7200.0,  # the desired trajectory is periodic
}


def made(name: str, duration: float, conditions: Conditions = NOMINAL) -> Design:
    spec = load_spec(SPECS / f"{name}.yaml")
    objectives = replace(spec.objectives, practical=True)  # in so short a run no reference moves far
    scenario = replace(spec.scenario, duration=duration, conditions=conditions)
    return design(replace(spec, objectives=objectives, scenario=scenario))


def off(ours: Array, signals: dict[str, Array], names: list[str]) -> float:
    """How far signals are off, in the largest that they are here, or 1."""
    size = max(1.0, float(np.abs(ours).max()))
    return float(np.abs(np.array([signals[name] for name in names]).T - ours).max()) / size


@pytest.mark.slow
@pytest.mark.parametrize("name", LOOPS)
def test_the_loop_runs_in_python_control_as_it_runs_here(name: str) -> None:
    found = made(name, LOOPS[name])
    ours, loop = simulate(found.spec, found), found.to_control()
    start = [*loop.params["start"]]
    theirs = control.input_output_response(loop, ours.t, 0, start, solve_ivp_kwargs=TIGHT)
    plant, states = found.plant, [*found.plant.states]
    signals = dict(zip(theirs.output_labels, theirs.outputs, strict=True))
    assert off(ours.y, signals, [*plant.outputs]) < 1e-6
    assert off(ours.u, signals, [*plant.inputs]) < 1e-6
    assert off(ours.x_hat, signals, [f"{x}_hat" for x in states]) < 1e-6
    assert off(ours.x_d, signals, [f"{x}_d" for x in states]) < 1e-6
    assert np.abs(ours.x[0] - ours.x[-1]).max() > 1e-3  # it moves
    assert loop.params["units"] == {label: str(unit) for label, unit in found.spec.problem.units.items()}
    loads = [] if plant.loads is None else [*plant.loads.names]
    assert loop.input_labels == loads


@pytest.fixture(scope="module")
def machine() -> Subject:
    return machine_of(100)


@pytest.mark.slow
@pytest.mark.parametrize("given", [False, True])
@pytest.mark.parametrize("single", [False, True])
def test_no_bit_of_the_sampled_controller_differs(machine: Subject, given: bool, single: bool) -> None:
    controller = Controller(machine.file, single=single)
    system = controller.to_control(given=given)
    y, w = machine.vector.y, machine.vector.w
    t = np.arange(len(y)) * system.dt
    inputs = np.hstack([y, w]) if given else y
    found = control.input_output_response(system, t, inputs.T, system.params["start"])
    ours = np.array([controller.step(y[k], w[k] if given else None) for k in range(len(y))], dtype=np.float64)
    assert found.outputs.reshape(-1).tobytes() == ours.reshape(-1).tobytes()
    unsaid = control.input_output_response(system, t, inputs.T)
    assert unsaid.outputs.tobytes() == found.outputs.tobytes()
    assert np.ptp(found.outputs) > 0
    with pytest.raises(ValueError, match="last entry of a state is 1"):
        control.input_output_response(system, t, inputs.T, [0.1, *[0.0] * (system.nstates - 1)])
    assert system.dt == controller.sample_time
    assert system.input_labels == ["y", *(["y_ref", "dy/dt_ref", "d2y/dt2_ref"] if given else [])]
    assert system.params["units"]["u"] == "N"


@pytest.mark.slow
def test_plant_in_continuous_and_controller_in_discrete_time_are_the_sampled_loop() -> None:
    """Between samples python-control runs the plant with the input held."""
    spec = load_spec(SPECS / "two_mass_machine.yaml")
    sampling = replace(NOMINAL, sampling=spec.scenario.conditions.sampling, limits=spec.scenario.conditions.limits)
    found = made("two_mass_machine", 0.4, sampling)
    assert sampling.sampling is not None
    h = sampling.sampling.sample_time
    found = replace(found, spec=replace(found.spec, scenario=replace(found.spec.scenario, sample_time=h)))
    ours, plant, controller = simulate(found.spec, found), found.to_control("plant"), found.controller
    assert found.spec.scenario.initial.plant is not None
    x, states = np.array(plant.params["start"]), []
    for y in ours.y:
        states.append(x)
        held = np.array(controller.step(plant.output(0.0, x, np.zeros(1))))
        assert np.abs(plant.output(0.0, x, held) - y).max() < 1e-6
        x = control.input_output_response(plant, [0, h], held[:, None] * [1, 1], x, solve_ivp_kwargs=TIGHT).states[
            :, -1
        ]
    assert len(states) > 100
    assert np.abs(np.array(states) - ours.x).max() < 1e-6


def test_each_part_has_the_names_of_its_signals() -> None:
    found = made("two_mass_backlash", 1.0)
    plant, controller = found.to_control("plant"), found.to_control("controller")
    assert (plant.input_labels, plant.output_labels) == ([*found.plant.inputs], [*found.plant.outputs])
    assert plant.state_labels == [*found.plant.states]
    assert controller.input_labels == [*found.plant.outputs]
    assert controller.state_labels[-2:] == ["eta_hat_0", "eta_hat_1"]
    assert plant.params["start"] == [0.25, 0.0, 0.0, 0.0]
    assert controller.params["start"][-2:] == [0.2, 0.0]
    A = control.linearize(plant, [0.0] * 4, [0.0]).A
    assert np.abs(A - found.plant.A[found.plant.cell_names.index("gap")]).max() < 1e-5


def test_without_python_control_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    found = made("two_mass_backlash", 1.0)
    monkeypatch.setitem(sys.modules, "control", None)
    with pytest.raises(InvalidSpec, match="control is not installed") as error:
        found.to_control()
    assert "pwatrack[control]" in str(error.value.problems[0].hint)
