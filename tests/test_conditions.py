"""Limits, other parameters, disturbances, noise and sampled controllers, against the same machine written by hand."""

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from pwatrack import Result, Spec, ensemble, load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.errors import CheckFailed, InvalidSpec, OutsideTheory
from pwatrack.model.conditions import Conditions, Noise, Sampling
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import exosystem
from pwatrack.model.signal import ExponentialPolynomial, Signal
from pwatrack.report.files import write_result
from pwatrack.report.plots.pictures import pictures
from pwatrack.simulation.layout import Actuator
from pwatrack.spec.spec import Steady
from tests.scenarios import in_scenario, mass

TIGHT: dict[str, Any] = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-12}


def loaded(spec: Spec, tmp_path: Path, extra: str, duration: float = 3.0) -> Spec:
    """The spec with more under `simulation`, and shorter."""
    text = spec.path.read_text().replace("duration: 60", f"duration: {duration}")
    path = tmp_path / "spec.yaml"
    path.write_text(text.rstrip() + "\n" + extra)
    return load_spec(path)


def cell_of(plant: PWASystem, x: Array) -> int:
    """The cell by its inequalities, with no regard to which one it was."""
    sides = np.sign(plant.partition.H @ x + plant.partition.h)
    return int(np.argmin((plant.partition.signs * sides < 0).sum(axis=1)))


class Machine:
    """The loop as an engineer would write it down: equations (1), (15), (16), (18), (19), one after the other."""

    def __init__(self, result: Result) -> None:
        self.controller, self.conditions, self.spec = result.controller, result.loop.conditions, result.spec
        self.model = self.controller.plant
        self.plant = self.conditions.plant or self.model
        self.limits = self.conditions.limits
        self.K, self.L = self.controller.design.K, self.controller.design.L
        self.sizes = [4, 4, len(result.controller.trajectory.names)]
        self.last = -1.0, np.zeros(0)

    def w(self, t: float) -> Array:
        """The state of the exosystem, which is asked for twice at each time."""
        if self.last[0] != t:
            self.last = t, self.controller.trajectory.exosystem.states(np.array([t]))[0]
        return self.last[1]

    def desired(self, t: float, eta_hat: Array) -> tuple[Array, Array, int]:
        trajectory = self.controller.trajectory
        s = np.concatenate([eta_hat, self.w(t), [1.0]])
        x_d = trajectory.x_d[0] @ s
        cell = cell_of(self.model, x_d)
        return x_d, trajectory.u_ff[cell] @ s, cell

    def u_ff(self, t: float, eta_hat: Array, cell: int) -> Array:
        trajectory = self.controller.trajectory
        found: Array = trajectory.u_ff[cell] @ np.concatenate([eta_hat, self.w(t), [1.0]])
        return found

    def generator(self, t: float, eta_hat: Array, cell: int) -> Array:
        trajectory = self.controller.trajectory
        s = np.concatenate([eta_hat, self.w(t), [1.0]])
        rate: Array = trajectory.rate[cell] @ s
        return rate

    def input(self, t: float, x_hat: Array, eta_hat: Array) -> Array:
        x_d, u_ff, _ = self.desired(t, eta_hat)
        return self.limited(u_ff + self.K @ (x_hat - x_d))

    def limited(self, u: Array) -> Array:
        return u if self.limits is None else np.clip(u, self.limits[:, 0], self.limits[:, 1])

    def put_out(self, u: Array, before: Array) -> Array:
        """What a sampled controller makes of an input that it computed, after another."""
        rates, sampling = self.conditions.rates, self.conditions.sampling
        if rates is not None and sampling is not None:
            u = np.clip(u, before - rates * sampling.sample_time, before + rates * sampling.sample_time)
        return self.limited(u)

    def observer(self, x_hat: Array, u: Array, y: Array) -> Array:
        i = cell_of(self.model, x_hat)
        rate: Array = self.model.A[i] @ x_hat + self.model.b[i] + self.model.B @ u
        return rate + self.L @ (self.model.C @ x_hat - y)

    def motion(self, t: float, x: Array, u: Array) -> Array:
        i = cell_of(self.plant, x)
        rate: Array = self.plant.A[i] @ x + self.plant.b[i] + self.plant.B @ u
        return rate if self.conditions.disturbance is None else rate + self.conditions.disturbance(t)

    def measured(self, x: Array, v: Array) -> Array:
        y: Array = self.plant.C @ x
        return y + v

    def continuous(self, start: Array, span: tuple[float, float], v: Array, times: Array) -> Any:
        def rhs(t: float, z: Array) -> Array:
            x, x_hat, eta_hat = np.split(z, np.cumsum(self.sizes)[:-1])
            u, cell = self.input(t, x_hat, eta_hat), self.desired(t, eta_hat)[2]
            return np.concatenate(
                [self.motion(t, x, u), self.observer(x_hat, u, self.measured(x, v)), self.generator(t, eta_hat, cell)]
            )

        return solve_ivp(rhs, span, start, t_eval=times, max_step=0.01, **TIGHT)


def by_hand(result: Result) -> Array:
    """(x, x̂, η̂) at every sample of a loop that is not sampled."""
    machine, noise = Machine(result), result.loop.conditions.noise
    z = result.response.trace.z[0, : sum(machine.sizes)]
    t = result.response.t
    edges = np.array([0.0, t[-1]]) if noise is None else np.append(np.arange(0.0, t[-1], noise.sample_time), t[-1])
    draws = np.zeros((len(edges), 1))
    if noise is not None:
        draws = np.random.default_rng(noise.seed).normal(size=(len(edges), 1)) * noise.std
    rows = []
    for first, last, v in zip(edges[:-1], edges[1:], draws, strict=False):
        inside = t[(t >= first - 1e-9) & (t < last - 1e-9)].clip(first, last)
        found = machine.continuous(z, (first, last), v, np.append(inside, last))
        rows += found.y.T[:-1].tolist()
        z = found.y[:, -1]
    return np.array([*rows, z])


EXTRAS = {
    "limits": "  actuator: {limits: {u: [-3, 4]}}\n",
    "one limit": "  actuator: {limits: {u: [-.inf, 4]}}\n",
    "parameters": "  plant: {parameters: {k2: 0.3, c1: 0.12, m1: 1.1}}\n",
    "disturbance": "  disturbance: {v2: {sine: {amplitude: 0.3, frequency: 5}, constant: 0.1}, v1: 'exp(-t)'}\n",
    "noise": "  noise: {std: {y: 0.01}, sample_time: 0.05, seed: 7}\n",
}


@pytest.mark.slow
@pytest.mark.parametrize("extra", [*EXTRAS.values(), "".join(v for k, v in EXTRAS.items() if k != "one limit")])
def test_a_loop_under_other_conditions_is_the_one_written_by_hand(
    extra: str, paper_spec: Spec, paper: Result, tmp_path: Path
) -> None:
    result = simulate(loaded(paper_spec, tmp_path, extra, 0.5), paper.controller)
    expected = by_hand(result)
    np.testing.assert_allclose(result.response.trace.z[:, : expected.shape[1]], expected, atol=1e-8)
    machine = Machine(result)
    for k in range(0, len(result.response.t), 7):
        u = machine.input(result.response.t[k], result.response.x_hat[k], result.response.eta_hat[k])
        np.testing.assert_allclose(result.response.u[k], u, atol=1e-9)
    if result.loop.conditions.limits is not None:
        assert {
            part for e in result.response.trace.events for part in np.flatnonzero(np.subtract(e.before, e.after))
        } >= {3}


@pytest.mark.slow
@pytest.mark.parametrize(("method", "late"), [("emulated", 0), ("euler", 0), ("emulated", 1), ("euler", 3)])
@pytest.mark.parametrize(
    "extra",
    [
        "",
        EXTRAS["limits"] + EXTRAS["parameters"] + EXTRAS["disturbance"],
        "  quantum: {y: 0.003, u: 0.07}\n",
        "  rate_limit: {u: 40}\n",
        EXTRAS["limits"] + "  quantum: {y: 0.003, u: 0.1}\n  rate_limit: {u: 30}\n",
    ],
)
def test_a_sampled_controller_is_the_program_written_by_hand(
    method: str, late: int, extra: str, paper_spec: Spec, paper: Result, tmp_path: Path
) -> None:
    step, waiting, last = 0.02, [np.zeros(1)] * late, np.zeros(1)
    extra += f"  controller: {{sample_time: {step}, method: {method}, delay: {late}}}\n"
    result = simulate(loaded(paper_spec, tmp_path, extra, 0.5), paper.controller)
    machine = Machine(result)
    x, x_hat, eta_hat = np.split(result.response.trace.z[0, : sum(machine.sizes)], np.cumsum(machine.sizes)[:-1])
    for tick in range(25):
        t = tick * step
        row = result.response.t.tolist().index(pytest.approx(t, abs=1e-12))
        np.testing.assert_allclose(result.response.x[row], x, atol=1e-8)
        np.testing.assert_allclose(result.response.x_hat[row], x_hat, atol=1e-8)
        np.testing.assert_allclose(result.response.eta_hat[row], eta_hat, atol=1e-8)
        x_d, u_ff, _ = machine.desired(t, eta_hat)
        last = machine.put_out(u_ff + machine.K @ (x_hat - x_d), last)
        quanta = result.loop.conditions.quanta
        waiting.append(last if quanta is None else quanta.inputs * np.round(last / quanta.inputs))
        u, y = waiting.pop(0), machine.measured(x, np.zeros(1))
        if quanta is not None:
            y = quanta.outputs * np.round(y / quanta.outputs)
        np.testing.assert_allclose(result.response.u[row], u, atol=1e-7)
        found = solve_ivp(machine.motion, (t, t + step), x, args=(u,), max_step=step / 4, **TIGHT)
        x, cell = found.y[:, -1], machine.desired(t, eta_hat)[2]
        if method == "euler":
            x_hat = x_hat + step * machine.observer(x_hat, u, y)
            eta_hat = eta_hat + step * machine.generator(t, eta_hat, cell)
        else:
            i = cell_of(machine.model, x_hat)
            A = machine.model.A[i] + machine.L @ machine.model.C
            c = machine.model.b[i] + machine.model.B @ u - machine.L @ y
            x_hat = (expm(np.block([[A, c[:, None]], [np.zeros((1, 5))]]) * step) @ np.append(x_hat, 1.0))[:4]
            eta_hat = solve_ivp(machine.generator, (t, t + step), eta_hat, args=(cell,), **TIGHT).y[:, -1]


@pytest.mark.slow
@pytest.mark.parametrize("late", [0, 1, 3])
@pytest.mark.parametrize(
    "extra",
    ["", EXTRAS["limits"] + EXTRAS["parameters"] + EXTRAS["disturbance"], EXTRAS["limits"] + "  rate_limit: {u: 30}\n"],
)
def test_a_controller_that_corrects_is_the_program_written_by_hand(
    late: int, extra: str, paper_spec: Spec, paper: Result, tmp_path: Path
) -> None:
    """x̂ is predicted, with inputs that wait up to when u acts; u_ff is its mean over the hold, by quadrature."""
    step, waiting, last = 0.02, [np.zeros(1)] * late, np.zeros(1)
    extra += f"  controller: {{sample_time: {step}, delay: {late}}}\n"
    result = simulate(loaded(paper_spec, tmp_path, extra, 0.5), paper.controller)
    machine, gains = Machine(result), paper.controller.sampled_gains(Sampling(sample_time=step, delay=late))
    x, x_hat, eta = np.split(result.start[: sum(machine.sizes)], np.cumsum(machine.sizes)[:-1])
    held, desired = wanted(machine, eta, step, 25 + late)
    for tick in range(25):
        x_hat = x_hat + gains.M @ (machine.model.C @ x_hat - machine.measured(x, np.zeros(1)))
        row = result.response.t.tolist().index(pytest.approx(tick * step, abs=1e-12))
        np.testing.assert_allclose(result.response.x[row], x, atol=1e-8)
        np.testing.assert_allclose(result.response.x_hat[row], x_hat, atol=1e-8)
        ahead = x_hat
        for u in waiting:
            ahead = predicted(machine, ahead, u, step, gains.substeps)
        last = machine.put_out(held[tick + late] + gains.K @ (ahead - desired[tick + late]), last)
        waiting.append(last)
        u = waiting.pop(0)
        np.testing.assert_allclose(result.response.u[row], u, atol=1e-7)
        span = (tick * step, (tick + 1) * step)
        x = solve_ivp(machine.motion, span, x, args=(u,), max_step=step / 4, **TIGHT).y[:, -1]
        x_hat = predicted(machine, x_hat, u, step, gains.substeps)


def wanted(machine: "Machine", eta: Array, step: float, ticks: int) -> tuple[list[Array], list[Array]]:
    """The mean of u_ff over each sample, in the cell in which x_d begins it, and x_d there."""
    nodes, weights = np.polynomial.legendre.leggauss(6)
    means, desired = [], []
    for tick in range(ticks):
        t = tick * step
        x_d, _, cell = machine.desired(t, eta)
        found = solve_ivp(machine.generator, (t, t + step), eta, args=(cell,), dense_output=True, **TIGHT)
        assert found.sol is not None
        values = [machine.u_ff(s, found.sol(s), cell) for s in t + (nodes + 1) * step / 2]
        means.append(np.average(values, axis=0, weights=weights))
        desired.append(x_d)
        eta = found.y[:, -1]
    return means, desired


def predicted(machine: "Machine", x_hat: Array, u: Array, step: float, substeps: int) -> Array:
    """One sample later under u, in some steps, each with the affine law of the cell in which it begins."""
    model = machine.model
    for _ in range(substeps):
        i = cell_of(model, x_hat)
        c = model.b[i] + model.B @ u
        affine = np.block([[model.A[i], c[:, None]], [np.zeros((1, len(x_hat) + 1))]])
        x_hat = (expm(affine * step / substeps) @ np.append(x_hat, 1.0))[:-1]
    return x_hat


def test_a_controller_that_corrects_is_nearer_to_the_continuous_one(paper_spec: Spec, paper: Result) -> None:
    """From x̂ = x: what is measured acts at once, and what is held is a mean."""
    start = paper_spec.scenario.initial.plant
    assert not isinstance(start, Steady)
    initial = replace(paper_spec.scenario.initial, observer=start)
    short = in_scenario(paper_spec, duration=3.0, initial=initial)
    exact = simulate(short, paper.controller).response.x

    def gap(sampling: Sampling) -> float:
        spec = in_scenario(short, conditions=Conditions(sampling=sampling))
        return float(np.abs(simulate(spec, paper.controller).response.x - exact).max())

    for step in (4e-3, 1e-3):
        assert gap(Sampling(sample_time=step)) < gap(Sampling(sample_time=step, method="emulated")) / 20


@pytest.mark.parametrize("method", ["emulated", "euler"])
def test_a_sampled_controller_approaches_the_continuous_one_with_the_first_order(
    method: Any, paper_spec: Spec, paper: Result
) -> None:
    """The held input is late by half a sample time on the average, so the difference halves with the sample time."""
    short = in_scenario(paper_spec, duration=3.0)
    exact = simulate(short, paper.controller).response.x
    gaps = []
    for step in (4e-3, 2e-3, 1e-3, 5e-4):
        conditions = Conditions(sampling=Sampling(sample_time=step, method=method))
        gaps.append(
            np.abs(simulate(in_scenario(short, conditions=conditions), paper.controller).response.x - exact).max()
        )
    np.testing.assert_allclose(np.divide(gaps[:-1], gaps[1:]), 2.0, atol=0.15)
    assert gaps[-1] < 2e-3


def test_limits_at_infinity_change_no_bit(paper_spec: Spec, paper: Result, tmp_path: Path) -> None:
    spec = loaded(paper_spec, tmp_path, "  actuator: {limits: {u: [-.inf, .inf]}}\n", 60)
    assert np.array_equal(simulate(spec, paper.controller).response.trace.z, paper.response.trace.z)


def test_limits_out_of_reach_change_nothing_but_rounding(paper_spec: Spec, paper: Result) -> None:
    far = in_scenario(paper_spec, conditions=Conditions(limits=np.array([[-1e3, 1e3]])))
    trace = simulate(far, paper.controller).response.trace
    np.testing.assert_allclose(trace.z, paper.response.trace.z, atol=1e-11)
    assert [e.after[:3] for e in trace.events] == [e.after for e in paper.response.trace.events]


def test_a_limited_input_stays_at_its_limit_and_events_say_when(
    paper_spec: Spec, paper: Result, tmp_path: Path
) -> None:
    limits = np.array([[-2.0, 1.5]])
    result = simulate(in_scenario(paper_spec, conditions=Conditions(limits=limits)), paper.controller)
    u, part = result.response.u[:, 0], result.loop.flow.parts[3]
    names = np.array(part.cells)[result.response.trace.modes[:, 3]]
    assert u.min() == -2.0
    assert u.max() == 1.5
    assert set(names) == {"low", "linear", "high"}
    assert (u[names == "low"] == -2.0).all()
    assert (u[names == "high"] == 1.5).all()
    assert ((u[names == "linear"] > -2.0) & (u[names == "linear"] < 1.5)).all()
    assert isinstance(part, Actuator)
    assert (part.input, part.levels) == (0, (-2.0, None, 1.5) * 3)  # in each cell of x_d
    write_result(result, tmp_path, plots="none")
    with (tmp_path / "events.csv").open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["part"] == part.name]
    said = {(row["from_cell"], row["to_cell"], row["guard"]) for row in rows}
    assert said == {
        (*(("linear", limited) if into else (limited, "linear")), f"u = {limit:g}")
        for limited, limit in (("low", -2.0), ("high", 1.5))
        for into in (True, False)
    }


def test_two_inputs_are_limited_each_by_its_own_limits(specs: Path) -> None:
    spec = load_spec(specs / "gallery/two_driven_carts.yaml")
    assert len(spec.problem.plant.inputs) == 2
    free = simulate(spec)
    sizes = np.abs(free.response.u).max(axis=0)
    limits = np.array([[-np.inf, np.inf], [-0.5 * sizes[1], 0.5 * sizes[1]]])
    result = simulate(in_scenario(spec, conditions=Conditions(limits=limits)), free.controller)
    assert np.abs(result.response.u[:, 1]).max() == pytest.approx(0.5 * sizes[1])
    assert [part.name for part in result.loop.flow.parts][3:] == [f"actuator {spec.problem.plant.inputs[1]}"]


def test_noise_is_seeded_and_has_its_deviation(paper_spec: Spec, paper: Result) -> None:
    runs = [
        simulate(
            in_scenario(paper_spec, conditions=Conditions(noise=Noise(std=np.array([0.02]), sample_time=0.01, seed=s))),
            paper.controller,
        )
        for s in (3, 3, 4)
    ]
    assert np.array_equal(runs[0].response.trace.z, runs[1].response.trace.z)
    assert not np.array_equal(runs[0].response.trace.z, runs[2].response.trace.z)
    v = runs[0].response.trace.z[:, runs[0].loop.at.v]
    assert np.std(v) == pytest.approx(0.02, rel=0.05)
    assert abs(np.corrcoef(v[:-1, 0], v[1:, 0])[0, 1]) < 0.05
    response, sizes = runs[0].response, paper.controller.bounds[-1].sizes
    error = np.abs(response.y - response.y_d)[-1000:, 0]
    assert 1e-4 < error.max() < sizes["output", 0] * np.abs(v).max()
    off = np.abs(response.x_hat - response.x)[-1000:].max(axis=0)
    assert all(off[k] < sizes["estimate", k] * np.abs(v).max() for k in range(4))


def test_a_disturbance_leaves_no_more_error_than_its_bounds_say(paper_spec: Spec, paper: Result) -> None:
    """What two of them leave adds up."""
    push = exosystem([Signal.of(ExponentialPolynomial.constant(c)) for c in (0.0, 0.01, 0.0, -0.02)])
    response = simulate(in_scenario(paper_spec, conditions=Conditions(disturbance=push)), paper.controller).response
    first, second = (paper.controller.bounds[k].sizes for k in (1, 3))
    most = {signal: 0.01 * first[signal] + 0.02 * second[signal] for signal in first}
    assert 1e-3 < np.abs(response.y - response.y_d)[-500:].max() < most["output", 0]
    assert 1e-3 < np.abs(response.u - response.u_ff)[-500:].max() < most["input", 0]
    off = np.abs(response.x_hat - response.x)[-500:].max(axis=0)
    assert all(off[k] < most["estimate", k] for k in range(4))


@pytest.mark.parametrize("method", ["corrected", "emulated"])
@pytest.mark.parametrize(("limits", "quantum"), [((-0.31, 0.4), 0.04), ((-0.5, 0.333), 0.1), ((-0.3, 0.3), 0.1)])
def test_an_input_with_steps_stays_within_its_limits(limits: tuple[float, float], quantum: float, method: str) -> None:
    def starting(z: float, step: float = quantum) -> Spec:
        more = f"quantum: {{u: {step}}}, actuator: {{limits: {{u: [{limits[0]}, {limits[1]}]}}}}, "
        more += f"controller: {{sample_time: 0.02, method: {method}}}, initial: {{plant: [{z}, 0]}}"
        return load_spec(yaml.safe_load(mass(simulation=f"{{duration: 4, sample_time: 0.02, {more}}}")))

    for z in (-3, 3):
        spec = starting(z)
        u = simulate(spec).response.u[:, 0]
        assert limits[0] - 1e-12 <= u.min() < u.max() <= limits[1] + 1e-12
        assert np.abs(u / quantum - np.round(u / quantum)).max() < 1e-9
        assert spec.scenario.conditions.limits is not None
        assert (u.min(), u.max())[z < 0] == spec.scenario.conditions.limits[0, int(z < 0)]
    with pytest.raises(InvalidSpec, match="at most one multiple of 20 is within"):
        starting(0, 20.0)


def test_every_fault_under_simulation_is_said_at_once_with_its_line(paper_spec: Spec, tmp_path: Path) -> None:
    extra = (
        "  actuator: {limits: {w: [-1, 1], u: [2, 1]}}\n"
        "  disturbance: {q: 1.0}\n"
        "  noise: {std: {y: -1, z9: 1}, sample_time: 0}\n"
        "  controller: {sample_time: 0.01, method: heun}\n"
    )
    with pytest.raises(InvalidSpec) as caught:
        loaded(paper_spec, tmp_path, extra)
    text = str(caught.value)
    for part in ("limit 2 is not below the upper one, 1", "-1 is negative", "0 is not positive", "method"):
        assert part in text
    extra = "  actuator: {limits: {w: [-1, 1]}}\n  disturbance: {q: 1.0}\n  plant: {parameters: {k9: 1}}\n"
    with pytest.raises(InvalidSpec) as caught:
        loaded(paper_spec, tmp_path, extra)
    for part in ("'w' is no input (u)", "'q' is no state (z1, v1, z2, v2)", "'k9' is no parameter"):
        assert part in str(caught.value)
    assert all(p.place is not None and p.place.line > 60 for p in caught.value.problems)


def test_a_plant_that_is_not_continuous_with_its_own_parameters_is_refused(specs: Path, tmp_path: Path) -> None:
    text = (specs / "two_mass_backlash.yaml").read_text()
    text = text.replace("omega: 2*pi", "jump: 0  # m\n  omega: 2*pi").replace("k2*c2/m2]", "k2*c2/m2 + jump]")
    path = tmp_path / "spec.yaml"
    path.write_text(text.rstrip() + "\n  plant: {parameters: {jump: 0.1}}\n")
    with pytest.raises(OutsideTheory, match=r"plant with jump = .*: .*must be continuous") as caught:
        load_spec(path)
    assert caught.value.problems[0].place is not None
    path.write_text(text.rstrip() + "\n  plant: {parameters: {m1: 0}}\n")
    with pytest.raises(InvalidSpec, match=r"plant with m1 = .*: "):
        load_spec(path)


def test_pictures_and_summary_name_the_conditions(paper_spec: Spec, paper: Result, tmp_path: Path) -> None:
    extra = EXTRAS["limits"] + EXTRAS["noise"] + "  controller: {sample_time: 0.01}\n"
    result = simulate(loaded(paper_spec, tmp_path, extra), paper.controller)
    assert result.tracking_bound is None
    for draw in pictures(result).values():
        title = draw().get_suptitle()
        assert all(
            text in title.replace("\n", " ") for text in ("u limited to [-3, 4] N", "noise of 0.01 m on y", "0.01 s")
        )


def test_a_portrait_shows_the_facets_and_cells_that_can_be_seen_in_it(paper_spec: Spec, tmp_path: Path) -> None:
    spec = loaded(paper_spec, tmp_path, "  portraits: [[z2 - z1, v2 - v1], [2*z1, v1 + 1]]\n")
    figures = pictures(simulate(spec))
    across, own = (figures[f"portrait_{k}"]().axes[0] for k in (1, 2))
    assert {text.get_text() for text in across.texts} == {"lower spring", "gap", "upper spring"}
    assert (across.get_xlabel(), across.get_ylabel()) == ("z2 - z1 (m)", "v2 - v1 (m/s)")
    assert not own.texts
    assert np.ravel(across.lines[0].get_xdata())[0] == pytest.approx(-0.25)
    for wrong, message in (("[z1]", "two linear forms"), ("[z1 - z2, 2*z2 - 2*z1]", "multiples of each other")):
        with pytest.raises(InvalidSpec, match=message):
            loaded(paper_spec, tmp_path, f"  portraits: [{wrong}]\n")


def test_a_plant_that_the_gains_do_not_hold_is_said_to_be_unstable(specs: Path, tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    text = (specs / "two_mass_paper_gains.yaml").read_text(encoding="utf-8")
    path.write_text(text.replace("  initial:", "  plant: {parameters: {d1: -60}}\n  initial:"), encoding="utf-8")
    with pytest.raises(CheckFailed, match=r"the closed loop is unstable: a state is beyond 1e\+100 at t = 3\.\d+ s"):
        simulate(load_spec(path))
    path.write_text(path.read_text(encoding="utf-8").replace("{d1: -60}", "{d1: -0.5}"), encoding="utf-8")
    result = simulate(load_spec(path))
    with pytest.raises(CheckFailed, match=r"member 1, with d1 = -6.*: the closed loop is unstable: a state"):
        ensemble(replace(result, spec=in_scenario(result.spec, intervals={"d1": (-65.0, -60.0)})), 2, over="parameters")


@pytest.mark.slow
@pytest.mark.parametrize(
    "extra",
    [
        "  controller: {sample_time: 0.5}\n",
        "  noise: {std: {y: 0.1}, sample_time: 0.5}\n",
        "  disturbance: {v1: {step: {size: 1, at: 1}}}\n",
    ],
)
def test_the_last_sample_of_a_run_is_that_of_a_longer_one(extra: str, specs: Path, tmp_path: Path) -> None:
    """What happens at the very end has happened: a tick, a draw, a jump of a signal."""
    text = (specs / "two_mass_paper_gains.yaml").read_text(encoding="utf-8")
    runs = []
    for duration in ("1", "2"):
        path = tmp_path / f"{duration}.yaml"
        path.write_text(text.replace("duration: 60", f"duration: {duration}") + extra, encoding="utf-8")
        runs.append(simulate(load_spec(path)).response)
    short, long = runs
    count = len(short.t)
    assert short.t[-1] == 1.0
    for name in ("x", "x_hat", "eta_hat", "u"):
        assert np.allclose(getattr(short, name), getattr(long, name)[:count], rtol=0, atol=1e-13), name
    assert short.trace.z[-1] == pytest.approx(long.trace.z[count - 1], abs=1e-13)


@pytest.mark.parametrize(
    "extra",
    ["noise: {std: {y: 0}, sample_time: 0.1}", "disturbance: {v1: 0}", "actuator: {limits: {u: [-.inf, .inf]}}"],
)
def test_a_condition_of_size_0_is_none(extra: str, paper_spec: Spec, tmp_path: Path) -> None:
    assert loaded(paper_spec, tmp_path, f"  {extra}\n").scenario.conditions.nominal


@pytest.mark.parametrize("part", ["noise: {std: {y: 1}, sample_time: 1e-9}", "controller: {sample_time: 1e-9}"])
def test_more_ticks_than_can_be_kept_are_refused(part: str, paper_spec: Spec, tmp_path: Path) -> None:
    with pytest.raises(InvalidSpec, match=r"3e\+09 (draws|ticks), at most 2,000,000 are taken") as caught:
        loaded(paper_spec, tmp_path, f"  {part}\n")
    assert caught.value.problems[0].subject == ("simulation", part.split(":")[0], "sample_time")


def test_a_run_that_ends_before_its_duration_says_so(specs: Path, tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    text = (specs / "two_mass_paper_gains.yaml").read_text(encoding="utf-8")
    path.write_text(text.replace("duration: 60", "duration: 1.009"), encoding="utf-8")
    result = simulate(load_spec(path))
    assert result.response.t[-1] == 1.0
    assert "the run ends with the last sample, at t = 1 s" in result.remarks[0]


def test_a_start_that_the_reference_gives_is_not_given_twice(specs: Path, tmp_path: Path) -> None:
    path = tmp_path / "rooms.yaml"
    text = (specs / "gallery" / "two_rooms.yaml").read_text(encoding="utf-8")
    path.write_text(text.replace("plant: [5, 5]", "plant: [5, 5], generator: [1, 1]"), encoding="utf-8")
    with pytest.raises(InvalidSpec, match="the reference itself says where the desired trajectory starts"):
        simulate(load_spec(path))


RESTS = """
name: A cart that rests where its spring begins
system:
  states: [z, v]
  inputs: [u]
  outputs: [y]
  A: [[0, 1], [0, -1]]
  B: [[0], [1]]
  C: [[1, 0]]
  nonlinearities:
    - {name: s, kind: spring, of: z, start: 0, slope: 60, into: {v: -1}}
reference: {output: {step: {size: SIZE, at: AT, smooth: 0.6}}}
simulation: {duration: 1.5, sample_time: 0.01, controller: {sample_time: 0.01}}
"""


@pytest.mark.slow
@pytest.mark.parametrize("size", ["0.12", "-0.12"])
@pytest.mark.parametrize("at", ["0.505", "0.5037", "0.5"])
def test_a_reference_that_rests_on_a_corner_leaves_it_between_ticks(size: str, at: str, tmp_path: Path) -> None:
    """There the guard and all but its third derivative are 0, but for rounding, which must not decide."""
    path = tmp_path / "plant.yaml"
    path.write_text(RESTS.replace("SIZE", size).replace("AT", at), encoding="utf-8")
    result = simulate(load_spec(path))
    assert result.response.error_norm.max() < 1e-4
    assert result.response.error_norm[-1] < 5e-6
