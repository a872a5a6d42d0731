"""Sample times at which a cell is unstable are refused before anything is simulated; what is offered dies out."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from pwatrack import load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.commands.export import of_spec
from pwatrack.errors import CheckFailed
from pwatrack.export.controller import Controller
from pwatrack.model.conditions import Conditions, Method, Sampling
from pwatrack.simulation.closed_loop import ClosedLoop, closed_loop
from pwatrack.simulation.propagate import simulate_flow, tick_times
from pwatrack.simulation.sampled_runs import SampleMaps, check_sample_time, dying_out
from tests.plants import random_plant
from tests.promises import random_loop, track
from tests.test_cli import call, index_of, refused
from tests.test_outcome import cart

methods: st.SearchStrategy[Method] = st.sampled_from(["corrected", "emulated", "euler"])


def errors(loop: ClosedLoop, x0: Array, sampling: Sampling, ticks: int) -> Array:
    """|x − x_d| at every tick, from rest but for the plant, (ticks + 1,)."""
    run, h = closed_loop(loop.controller, Conditions(sampling=sampling)), sampling.sample_time
    p = len(loop.controller.trajectory.names)
    start = run.start(plant=x0, observer=np.zeros(len(x0)), generator=np.zeros(p))
    trace = simulate_flow(run.flow, start, duration=ticks * h, sample_time=h, resets=run.resets(ticks * h))
    response = run.response(trace)
    return np.asarray(np.linalg.norm(response.x - response.x_d, axis=1))


@pytest.mark.slow
@given(st.integers(0, 60), methods, st.integers(0, 3), st.floats(0.01, 0.5))
@settings(max_examples=12)
def test_the_map_of_a_sample_is_what_the_simulation_does(seed: int, method: Method, delay: int, h: float) -> None:
    """A plant with one cell, at rest: the loop is linear, and z(k + 1) = M z(k)."""
    plant = random_plant(seed, n=3, k=0, r=2)
    x_0 = np.linalg.solve(plant.A[0], -plant.b[0])
    loop = track(plant, repr(float((plant.C @ x_0)[0])))
    sampling = Sampling(sample_time=h, method=method, delay=delay)
    run, random = closed_loop(loop.controller, Conditions(sampling=sampling)), np.random.default_rng(seed)
    eta = loop.controller.trajectory.to_eta @ x_0 + loop.controller.trajectory.eta_offset
    away = random.normal(size=3)
    start = run.start(plant=x_0 + away, observer=x_0, generator=eta)
    trace = simulate_flow(run.flow, start, duration=20 * h, sample_time=h, resets=run.resets(20 * h))
    M = SampleMaps(loop.controller, plant, sampling).loop(0, h)
    at = run.at
    rest = np.concatenate([x_0, x_0, np.zeros(len(M) - 6)])
    found = np.hstack([trace.z[:, at.x], trace.z[:, at.x_hat], trace.z[:, at.u.start : at.late.stop - 1]])[:, : len(M)]
    z = found - rest
    expected = z[:-1] @ M.T
    np.testing.assert_allclose(z[1:], expected, atol=1e-9 * (1 + np.abs(z).max()))


@pytest.mark.slow
@given(st.integers(0, 400), methods, st.integers(0, 2))
@settings(max_examples=2)  # `make sampling` runs 120
def test_at_the_time_that_is_offered_random_designs_do_not_run_away(seed: int, method: Method, delay: int) -> None:
    loop, x0 = random_loop(seed)
    too_long = Sampling(sample_time=1e3, method=method, delay=delay)
    maps = SampleMaps(loop.controller, loop.controller.plant, too_long)
    assume(maps.worst(1e3)[1] >= 1)  # not so where the plant rests by itself, and the gain is small
    longest = maps.longest(1e3)
    assert longest is not None
    offer = dying_out(maps, longest)
    assume(offer is not None)
    assert offer is not None
    assert offer[0] < longest
    sampling = replace(too_long, sample_time=offer[0])
    error = errors(loop, x0, sampling, 4000)
    assert error[3500:].max() <= 1.05 * error[:3500].max()  # it may take long to get to its steady oscillation
    check_sample_time(loop.controller, Conditions(sampling=sampling))
    assert max(maps.worst(h)[1] for h in longest * np.linspace(1.0, 1.15, 16)) >= 1


SLOW = "controller: {sample_time: 0.5, method: euler}"


def test_a_sample_time_that_diverges_is_refused_with_one_that_does(tmp_path: Path) -> None:
    path = cart(tmp_path, SLOW, reference="0.08*cos(t)")
    error = refused(call("simulate", path, "--out", tmp_path / "out"), 6)
    line = 1 + path.read_text(encoding="utf-8").split("controller: {sample_time")[0].count("\n")
    assert f"{path}:{line}:" in error
    found = re.search(
        r"sampled every 0\.5 s, the loop is unstable in cell '(?:stop on|stop off)': as long as it stays there, one "
        r"sample multiplies an error by (\S+) in the long run; at (\S+) s no cell by itself is unstable, and "
        r"at (\S+) s all of (\d+) simulated runs from other starts died out",
        error,
    )
    assert found is not None, error
    assert float(found[1]) > 1
    assert float(found[3]) < float(found[2]) < 0.5
    assert int(found[4]) > 20
    assert f"hint: write 'sample_time: {found[3]}' (s): simulated runs died out there, which is no proof" in error
    assert "would do" not in error
    index = index_of(tmp_path / "out")
    assert (index["verdict"], index["exit"], index["simulation"]["outcome"]) == ("proved", 6, "broken off")
    made = {"gains.json", "certificate.json", "generator.json", "bounds.json", "controller.json", "spec.txt"}
    assert {*index["files"]} == made
    good = cart(tmp_path, SLOW.replace("0.5", found[3]), reference="0.08*cos(t)")
    result = simulate(load_spec(good))
    assert result.outcome.code == 0
    assert result.response.tracking_error.max() < 1


@pytest.mark.slow
def test_an_output_that_is_late_takes_a_shorter_sample_time(tmp_path: Path) -> None:
    found = []
    for delay in (0, 1, 5):
        with pytest.raises(CheckFailed) as refusal:
            simulate(load_spec(cart(tmp_path, f"controller: {{sample_time: 5, delay: {delay}, method: emulated}}")))
        figure = re.search(r"(\S+) s no cell by itself", str(refusal.value))
        assert figure is not None
        found.append(float(figure[1]))
    assert found == sorted(found, reverse=True)
    assert len(set(found)) == 3


BENT = """name: stable in each cell, and it runs away
system:
  states: [x]
  inputs: [u]
  outputs: [y]
  A: [[2.3243911]]
  B: [[1]]
  C: [[1]]
  nonlinearities:
    - {name: bend, kind: spring, of: x, start: 0, slope: -9.988668, into: {x: 1}}
design: {controller: {K: [[-8.893888]]}, observer: {L: [[-2.5135667]]}}
reference: {output: {constant: 0}}
simulation:
  duration: 60
  sample_time: 0.1
  initial: {plant: [0.3], observer: [-0.2]}
  controller: {sample_time: TIME, method: emulated}
"""


def scalar_growth(a: tuple[float, float], k: float, l_: float, h: float, start: Array, samples: int = 400) -> float:
    """Return ln of the growth of (x, x̂) of x' = a(x) x + u, sampled: in closed form, with the crossings of 0."""

    def phi(rate: float, time: float) -> tuple[float, float]:
        return float(np.exp(rate * time)), time if abs(rate) < 1e-12 else float(np.expm1(rate * time)) / rate

    z, grown = start / np.linalg.norm(start), 0.0
    for _ in range(samples):
        x, x_hat = z.tolist()
        u, left, here = k * x_hat, h, x
        rate = a[int(here > 0 or (here == 0 and u > 0))]
        e, g = phi(rate, left)
        if here != 0 and (e * here + g * u) * here < 0:
            left -= float(np.log((u / rate) / (here + u / rate)) / rate)
            e, g = phi(a[int(u > 0)], left)
            here = 0.0
        observer, held = phi(a[int(x_hat > 0)] + l_, h)
        z = np.array([e * here + g * u, observer * x_hat + held * (u - l_ * x)])
        size = float(np.linalg.norm(z))
        if size == 0:
            return -np.inf
        grown, z = grown + float(np.log(size)), z / size
    return grown


def test_where_each_cell_is_stable_and_the_loop_runs_away_no_such_time_is_offered(tmp_path: Path) -> None:
    """0.73 s was offered, as stable in all cells: at 0.73, 0.72, 0.6 and 0.5 s the loop runs away."""
    path = tmp_path / "bent.yaml"
    path.write_text(BENT.replace("TIME", "1"), encoding="utf-8")
    with pytest.raises(CheckFailed) as refusal:
        simulate(load_spec(path))
    (problem,) = refusal.value.problems
    assert "would do" not in problem.message
    found = re.search(r"at (\S+) s all of", problem.message)
    assert found is not None
    offered = float(found[1])
    assert 0.1 < offered < 0.45
    starts = np.random.default_rng(3).normal(size=(50, 2))

    def worst(h: float) -> float:
        return max(scalar_growth((2.3243911, 2.3243911 - 9.988668), -8.893888, -2.5135667, h, z) for z in starts)

    assert all(worst(h) > 5 for h in (0.73, 0.72, 0.6, 0.5))
    assert worst(offered) < -5
    path.write_text(BENT.replace("TIME", "0.72"), encoding="utf-8")
    assert simulate(load_spec(path)).outcome.kind == "grows"


@pytest.mark.slow
def test_design_says_beforehand_that_a_cell_is_unstable_as_it_is_sampled(tmp_path: Path) -> None:
    path = tmp_path / "bent.yaml"
    path.write_text(BENT.replace("TIME", "1"), encoding="utf-8")
    run = call("design", path, "--verbose", "--out", tmp_path / "out")
    assert run.exit_code == 0, run.output
    said = "sampled every 1 s, the loop is unstable in cell 'bend off'"
    assert said in " ".join(run.output.split())
    assert any(remark.startswith(said) for remark in index_of(tmp_path / "out")["warnings"])
    assert said in " ".join(call("check", path).output.split())
    path.write_text(BENT.replace("TIME", "0.01"), encoding="utf-8")
    assert "unstable in cell" not in call("design", path, "--out", tmp_path / "out").output
    assert "unstable in cell" not in call("check", path).output


def test_ticks_with_jitter_are_as_far_apart_as_it_says_and_do_not_get_away() -> None:
    h, jitter, end = 0.01, 0.002, 5.0
    times = tick_times(Sampling(sample_time=h, jitter=jitter), end)
    apart = np.diff(times)
    assert times[0] == 0
    assert h - jitter < apart.min() < h - 0.8 * jitter
    assert h + 0.8 * jitter < apart.max() < h + jitter
    assert np.abs(times - h * np.arange(len(times))).max() <= jitter / 2
    assert times[-1] <= end


def test_a_loop_with_jitter_is_simulated_and_the_program_is_the_same(tmp_path: Path) -> None:
    """What little the ticks move moves the run as little."""
    still, moved = (
        simulate(load_spec(cart(tmp_path, f"controller: {{sample_time: {ticks}}}", duration=4)))
        for ticks in ("0.01", "{nominal: 0.01, jitter: 0.001}")
    )
    none = simulate(load_spec(cart(tmp_path, "controller: {sample_time: {nominal: 0.01, jitter: 0}}", duration=4)))
    assert (none.response.x == still.response.x).all()
    off = np.abs(still.response.x - moved.response.x).max()
    assert 1e-9 < off < 1e-2 * np.abs(still.response.x).max()


@pytest.mark.parametrize("jitter", ["0.01", "-1e-3"])
def test_a_tick_does_not_come_before_the_last_one(tmp_path: Path, jitter: str) -> None:
    path = cart(tmp_path, f"controller: {{sample_time: {{nominal: 0.01, jitter: {jitter}}}}}")
    assert "simulation.controller.sample_time" in refused(call("check", path), 2)


@pytest.mark.parametrize("delay", ["-1", "11", "0.5"])
def test_a_delay_is_a_few_whole_samples(tmp_path: Path, delay: str) -> None:
    path = cart(tmp_path, f"controller: {{sample_time: 0.01, delay: {delay}}}")
    assert "simulation.controller.delay: " in refused(call("check", path), 2)


def test_a_late_output_is_said(tmp_path: Path) -> None:
    result = simulate(load_spec(cart(tmp_path, "controller: {sample_time: 0.01, delay: 2}", duration=2)))
    (said,) = result.loop.conditions.texts(result.loop.plant)
    assert said == "controller sampled every 0.01 s (corrected), its output 2 samples late"
    assert not result.response.u[:1].any()


MACHINE = "controller: {sample_time: 0.01}", "quantum: {y: 1e-3, u: 0.25}", "rate_limit: {u: 3}"


@pytest.mark.slow
def test_what_is_put_out_and_measured_comes_in_steps_and_changes_no_faster(tmp_path: Path) -> None:
    limits = "actuator: {limits: {u: [-2, 2]}}"
    result, free = (
        simulate(load_spec(cart(tmp_path, *conditions, limits, reference="0.08*cos(t)")))
        for conditions in (MACHINE, MACHINE[:2])
    )
    u, y = result.response.u[:, 0], result.response.trace.z[:, result.loop.at.y]
    for values, quantum in ((u, 0.25), (y, 1e-3)):
        np.testing.assert_allclose(values / quantum, np.round(values / quantum), atol=1e-9)
    assert np.abs(u).max() <= 2
    assert np.abs(np.diff(u)).max() == pytest.approx(0.25)  # 0.03 at a time, of which a step comes now and then
    assert (u[0], abs(free.response.u[0, 0])) == pytest.approx((0, 0.25))
    assert result.outcome.kind in ("tracks", "off")
    assert result.loop.conditions.texts(result.loop.plant)[-3:] == [
        "y in steps of 0.001",
        "u in steps of 0.25",
        "|du/dt| at most 3",
    ]
    assert result.remarks == ()


TWO_INPUTS = """
name: two lags
system:
  states: [a, b]
  inputs: [p, q]
  outputs: [y, z]
  A: [[-1, 0.1], [0.1, -2]]
  B: [[1, 0], [0, 1]]
  C: [[1, 0], [0, 1]]
reference: {output: {y: "sin(t)", z: "sin(t)"}}
simulation: {duration: 2, sample_time: 0.01, rate_limit: {LIMITED: 0.5}, controller: {sample_time: 0.01}}
"""


@pytest.mark.parametrize("limited", [0, 1])
def test_one_of_two_inputs_may_change_no_faster(tmp_path: Path, limited: int) -> None:
    """And the other one as it likes; the controller that is stored is the one that ran."""
    path = tmp_path / "two.yaml"
    path.write_text(TWO_INPUTS.replace("LIMITED", "pq"[limited]), encoding="utf-8")
    result = simulate(load_spec(path))
    steps = np.abs(np.diff(result.response.u, axis=0)).max(axis=0)
    assert steps[limited] == pytest.approx(0.005)
    assert steps[1 - limited] > 0.01
    (said,) = result.loop.conditions.texts(result.loop.plant)[1:]
    assert said == f"|d{'pq'[limited]}/dt| at most 0.5"
    subject = of_spec(load_spec(path), steps=100)
    assert subject.file.program is not None
    assert subject.file.program.change == [[0.005, None], [None, 0.005]][limited]
    controller, y = Controller(subject.file), result.response.trace.z[:100, result.loop.at.y]
    assert [controller.step(row).tolist() for row in y] == result.response.u[:100].tolist()


@pytest.mark.parametrize("number", [1, 2])
def test_steps_and_rates_are_those_of_a_sampled_controller(tmp_path: Path, number: int) -> None:
    error = refused(call("check", cart(tmp_path, MACHINE[number])), 2)
    name = MACHINE[number].partition(":")[0]
    assert f"simulation.{name} is about the values of a sampled controller, and there is none" in error


@pytest.mark.parametrize(
    ("condition", "said"),
    [
        ("quantum: {q: 1}", "simulation.quantum: 'q' is no input or output (u, y)"),
        ("rate_limit: {y: 1}", "simulation.rate_limit: 'y' is no input (u)"),
        ("quantum: {y: 0}", "simulation.quantum.y: 0 is not positive"),
    ],
)
def test_names_and_sizes_of_steps_are_checked(tmp_path: Path, condition: str, said: str) -> None:
    assert said in refused(call("check", cart(tmp_path, MACHINE[0], condition)), 2)


def test_an_observer_starts_from_a_whole_step(tmp_path: Path) -> None:
    path = cart(tmp_path, MACHINE[0], "quantum: {y: 0.04}", duration=1)
    path.write_text(path.read_text(encoding="utf-8").replace("[0.05, 0]", "[0.05, 0], observer: measured"))
    assert simulate(load_spec(path)).response.x_hat[0].tolist() == pytest.approx([0.04, 0])


def test_the_files_of_a_run_with_steps_and_rates_are_written(tmp_path: Path) -> None:
    run = call("simulate", cart(tmp_path, *MACHINE, duration=2), "--out", tmp_path / "out")
    assert run.exit_code == 0, run.output
    header = (tmp_path / "out" / "trace.csv").read_text(encoding="utf-8").splitlines()[0]
    assert header.endswith("cell_rate_u")


def test_check_says_what_design_says_of_a_sample_time_where_the_gains_are_given(tmp_path: Path) -> None:
    said = "sampled every 0.5 s, the loop is unstable in cell 'stop "
    path = cart(tmp_path, SLOW, reference="0.08*cos(t)")
    remarks = json.loads(call("check", path, "--json").stdout)["remarks"]
    assert [remark[: len(said)] for remark in remarks] == [said]
    assert remarks[0] in " ".join(call("design", path, "--verbose", "--out", tmp_path / "out").output.split())
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("  observer: {L: [[-10], [-30]]}\n", ""), encoding="utf-8")
    (remark,) = json.loads(call("check", path, "--json").stdout)["remarks"]
    assert remark == "sampling every 0.5 s is not judged here: 'design' does, with its gains"
    fast = cart(tmp_path, SLOW.replace("0.5", "0.01"), reference="0.08*cos(t)")
    assert json.loads(call("check", fast, "--json").stdout)["remarks"] == []
