"""The sampled loop of the simulation is `docs/arithmetic.md`, bit for bit; `tests.plain` is that page read aloud."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from pwatrack import design, load_spec
from pwatrack.arrays import Array
from pwatrack.control.controller import ProvedController
from pwatrack.control.program import Follows, SampledController, program
from pwatrack.model.conditions import Conditions, Quanta, Sampling
from pwatrack.simulation import kernel
from pwatrack.simulation.closed_loop import ClosedLoop, closed_loop
from pwatrack.simulation.controller_arrays import memory, routine
from pwatrack.simulation.propagate import simulate_flow
from tests.exported import machine_of
from tests.plain import Plain
from tests.promises import random_loop

SAMPLED = [
    Sampling(sample_time=0.002),
    Sampling(sample_time=0.01, method="euler"),
    Sampling(sample_time=0.005, delay=1),
    Sampling(sample_time=0.003, delay=3),
    Sampling(sample_time=0.002, method="corrected"),
    Sampling(sample_time=0.005, method="corrected", delay=2),
]


@cache
def designed() -> ProvedController:
    controller = machine_of(1).controller
    assert controller is not None
    return controller


def bits(values: Any) -> bytes:
    return np.array(values, dtype=np.float64).tobytes()


def differ(loop: ClosedLoop, ticks: int, x0: Array) -> int:
    """How many bits of u and the state differ between a simulation and the page, fed with what was measured."""
    clock, at = loop.flow.clock, loop.at
    assert clock is not None
    h, model = clock.program.sampling.sample_time, loop.controller.plant
    p, random = len(loop.controller.trajectory.names), np.random.default_rng(7)
    start = loop.start(plant=x0, observer=random.normal(size=len(model.states)), generator=random.normal(size=p))
    trace = simulate_flow(loop.flow, start, duration=ticks * h, sample_time=h, resets=loop.resets(ticks * h))
    kept, places = memory(clock.program, start[at.observer], start[at.eta_hat])["memory"], clock.program.places
    plain = Plain(clock.program, start[at.observer], kept[places["eta_hat"]])
    wrong = 0
    for z in trace.z:
        assert plain.step(z[at.y].tolist()) == 0
        found = plain.state
        pairs = [(at.u, "u"), (at.observer, "x_hat")]
        pairs += [] if clock.program.sampling.corrects else [(at.eta_hat, "eta_hat"), (at.w_held, "w")]
        wrong += sum(bits(z[where]) != bits(found[name]) for where, name in pairs)
    return wrong


@pytest.mark.parametrize("sampling", SAMPLED)
def test_the_simulation_is_the_page_in_every_bit(sampling: Sampling) -> None:
    controller = designed()
    machine = Conditions(
        sampling=sampling,
        limits=np.array([[-6.0, 7.0]]),
        rates=np.array([2000.0]),
        quanta=Quanta(inputs=np.array([0.01]), outputs=np.array([1e-5])),
    )
    x0 = np.array([0.25, 0.0, 0.1, 0.0])
    for conditions in (Conditions(sampling=sampling), machine):
        assert differ(closed_loop(controller, conditions), 1100, x0) == 0
    if sampling.corrects:
        made = replace(program(controller, machine), E=np.array([[1e-4], [0.02], [-3e-5], [0.01]]))
        assert differ(closed_loop(controller, machine, made), 1100, x0) == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "h"),
    [
        ("payload_in_wind", 1e-4),
        ("payload_without_sensor", 1e-3),
        ("two_pumps_two_tanks", 1e-2),
        ("stage_with_bumpers", 1e-3),
    ],
)
def test_loads_set_points_and_references_in_pieces_are_the_page_too(name: str, h: float) -> None:
    """Loads that are estimated, two inputs, x_d in closed form, a polyline."""
    controller = design(load_spec(f"specs/gallery/{name}.yaml"))
    loop = closed_loop(controller, Conditions(sampling=Sampling(sample_time=h)))
    assert differ(loop, 400, np.zeros(len(controller.plant.states))) == 0


@pytest.mark.parametrize("seed", range(4))
def test_random_designs_are_the_page_in_every_bit(seed: int) -> None:
    loop, x0 = random_loop(seed)
    sampled = closed_loop(loop.controller, Conditions(sampling=Sampling(sample_time=0.01, delay=seed % 2)))
    assert differ(sampled, 200, x0) == 0


class Running:
    """The compiled program by itself."""

    def __init__(self, found: SampledController, real: Any) -> None:
        self.routine, self.found, self.real = routine(found, real), found, real
        zeros = np.zeros(found.sizes["N"]), np.zeros(found.sizes["p"])
        self.kept = memory(found, *zeros, real)
        self.plain = Plain(found, zeros[0], self.kept["memory"][found.places["eta_hat"]], real=real)
        self.memory, self.counts = self.kept["memory"], self.kept["counts"]

    def step(self, y: Any, given: Any = ()) -> int:
        y, given = np.array(y, self.real), np.array(given, self.real)
        status = kernel.tick(self.routine, self.memory, self.counts, self.kept["room"], y, given)
        with np.errstate(all="ignore"):
            assert self.plain.step(y, given) == status
        at = self.found.places
        for name, where in (("u", at["u"]), ("w", at["w"]), ("eta_hat", at["eta_hat"]), ("x_d", at["x_d"])):
            assert self.memory[where].tobytes() == np.array(self.plain.state[name], self.real).tobytes(), name
        assert (self.counts[0]["cell"], self.counts[0]["cell_d"]) == (self.plain.state["i"], self.plain.state["j"])
        return int(status)


@pytest.mark.parametrize("real", [np.float32, np.float64])
def test_single_floats_and_a_reference_from_outside_follow_the_page(real: Any) -> None:
    controller = designed()
    conditions, random = Conditions(sampling=SAMPLED[2], limits=np.array([[-6.0, 7.0]])), np.random.default_rng(3)
    for given in (False, True):
        running = Running(program(controller, conditions, given=given), real)
        for _ in range(300):
            assert running.step(random.normal(size=1) * 0.2, random.normal(size=3) * given) == 0


def test_what_is_not_finite_changes_nothing() -> None:
    controller = designed()
    running = Running(program(controller, Conditions(sampling=SAMPLED[0]), given=True), np.float64)
    running.step([0.1], [0.1, 0.2, 0.3])
    before = running.memory.copy(), running.counts.copy()
    for y, given in (([np.nan], [0.0] * 3), ([0.0], [0.0, np.inf, 0.0]), ([1e308], [1e308, 0.0, 0.0])):
        assert running.step(y, given) in (-1, 0)
        if np.isnan(y[0]) or np.isinf(given[1]):
            assert running.step(y, given) == -1
            np.testing.assert_array_equal(running.memory, before[0])
            np.testing.assert_array_equal(running.counts[0], before[1][0])


def turning(end: int | None = None) -> SampledController:
    controller = designed()
    found = program(controller, Conditions(sampling=SAMPLED[0]))
    assert found.follows is not None
    return replace(found, follows=replace(found.follows, end=end))


def test_a_reference_that_goes_on_for_long_stays_in_place() -> None:
    """Copies of w that are stepped on by 2¹⁰ and 2²⁰ ticks at a time keep the roundings from adding up."""
    running = Running(turning(), np.float64)
    follows = running.found.follows
    assert isinstance(follows, Follows)
    assert len(follows.turn) == 3
    running.step([0.0])
    running.counts[0]["since"] = running.plain.state["since"] = 2**20 - 3
    for _ in range(5):
        running.step([0.0])
    assert running.counts[0]["since"] == 2
    w = running.memory[running.found.places["w"]]
    expected = np.linalg.matrix_power(follows.turn[0], 2) @ follows.turn[2] @ follows.w0
    np.testing.assert_allclose(w, expected, rtol=1e-12)


def test_after_its_end_a_reference_stays_and_says_so() -> None:
    running = Running(turning(end=2), np.float64)
    assert [running.step([0.0]) for _ in range(5)] == [0, 0, 0, 1, 1]


def test_what_comes_from_outside_has_names() -> None:
    found = program(
        design(load_spec("specs/gallery/two_pumps_two_tanks.yaml")), Conditions(sampling=SAMPLED[0]), given=True
    )
    assert len(found.reference) == found.sizes["s"]
