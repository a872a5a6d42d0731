"""Loads that are estimated and step in a run: what that leaves of the errors of a sampled loop, and that runs obey."""

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from pwatrack import Spec, design, load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.claims.sampled_bounds import SampledBounds
from pwatrack.control.controller import ProvedController
from pwatrack.control.sampled_disturbances import driven
from pwatrack.control.sampled_error import SampledErrors
from pwatrack.lmi.audit.certificate import audit
from pwatrack.report.certificate import design_certificate
from pwatrack.simulation.loads_along import LoadsAlong
from tests.test_sampled_estimates import ACTS, moving
from tests.test_sampled_loads import BENT, LOADS

STEPS = {
    "constants": "z: {step: {size: 0.1, at: 3.013}}, a: {step: [{size: 0.2, at: 0.5}, {size: -0.2, at: 4.5}]}, "
    "v: {step: [{size: 0.1, at: 0.5}, {size: -0.1, at: 4.5}]}",
    "sinusoids": "z: 0.1*sin(3*t), a: {step: {size: 0.2, at: 2}}",
    "bent": "a: {step: {size: 0.2, at: 1.5}}",
    "bent by η": "a: {step: {size: 0.1, at: 1.511}}",
}
ONE = """
name: a cart that somebody pushes
system:
  states: [z, v]
  inputs: [u]
  outputs: [y, w]
  track: [y]
  A: [[0, 1], [-1, -0.5]]
  B: [[0], [1]]
  C: [[1, 0], [0, 1]]
design: {estimate: LOADS}
reference: {output: {constant: 0}}
simulation:
  duration: 6
  sample_time: TICK
  controller: {sample_time: TICK, delay: DELAY}
  disturbance: {ACTS}
  initial: BEGINS
"""
ALONE = {
    "at the input": ("{push: {into: {v: 1}}}", "v: {step: {size: 2, at: AT}}"),
    "moving x_d": ("{drift: {into: {z: 1}}}", "z: {step: {size: 0.4, at: AT}}"),
    "both, from the start on": (
        "{push: {into: {v: 1}}, drift: {into: {z: 1}}}",
        "v: {constant: 0.7}, z: {step: {size: 0.4, at: AT}}",
    ),
}


def stepping(name: str, more: str = "") -> str:
    return moving(name, more).replace(ACTS[name], STEPS[name])


def designed(text: str, folder: Path) -> tuple[Spec, ProvedController]:
    path = folder / "plant.yaml"
    path.write_text(text, encoding="utf-8")
    spec = load_spec(path)
    return spec, design(spec)


def along_of(spec: Spec, controller: ProvedController, errors: SampledErrors) -> LoadsAlong:
    return LoadsAlong.of(controller, spec.scenario.conditions, errors.gains)


def first_ticks(errors: SampledErrors, z: Array, parts: list[tuple[float, Array]]) -> Array:
    """Return z just before the tick of a step, from z after the one before: at rest but for d from a time on."""
    F, h = errors.clocked.F[0].floats, float(errors.clocked.period)
    for t, g in parts:
        whole = expm(np.block([[F, g[:, None]], [np.zeros((1, len(F) + 1))]]) * (h - t))
        z = z + whole[: len(F), -1]
    return z


@pytest.mark.slow
@pytest.mark.parametrize("late", [0, 1, 2])
@pytest.mark.parametrize("at", [2.0, 2.03])
@pytest.mark.parametrize("which", ALONE)
def test_of_one_cell_a_step_makes_what_the_run_shows(which: str, at: float, late: int, tmp_path: Path) -> None:
    """With one cell all is linear: kicks before ticks, and the step as a disturbance up to then, are all that acts."""
    tick, (loads, acts) = 0.1, ALONE[which]
    text = ONE.replace("LOADS", loads).replace("ACTS", acts).replace("AT", str(at))
    begins = "{plant: [0, 0]}" if late else "{plant: [0.2, -0.1], observer: [0.1, 0]}"
    text = text.replace("TICK", str(tick)).replace("DELAY", str(late)).replace("BEGINS", begins)
    spec, controller = designed(text, tmp_path)
    errors = controller.claim(SampledBounds).errors
    along, plant = along_of(spec, controller, errors), controller.plant
    assert plant.loads is not None
    E, order, first = plant.loads.E.floats, errors.order, int(np.ceil(at / tick - 1e-9))
    assert set(along.steps) == ({0, first} if "start" in which else {first})
    F, J = expm(errors.clocked.F[0].floats * tick), errors.clocked.J[0].floats
    response = simulate(spec, controller).response
    z, found = np.zeros(order), list[Array]()
    for k in range(60):
        if k == first and at < first * tick - 1e-9:
            drives = [driven(errors, ("disturbance", j)).between.floats[:, 0] for j in range(2)]
            g = sum(share * d for share, d in zip(E @ along.steps[k], drives, strict=True))
            z = first_ticks(errors, z, [(at - (first - 1) * tick, np.asarray(g))])
        if k == 0 and not late:
            (start,) = errors.starts or ()
            z = start.floats[:, 0]
        z = J @ z
        for j, change in enumerate(along.steps.get(k, ())):
            kicks = driven(errors, ("load", j)).ticks
            assert kicks is not None
            z = z - kicks[0].floats[:, 0] * change
        found.append(z)
        z = F @ z
    e = np.array(found)[:, :2]
    s = np.array([each for each, _ in zip(along.ticks, range(60), strict=False)])
    x_d = s @ controller.compensation.X.floats.T
    assert np.abs(response.x[:60] - x_d - e).max() < 1e-9
    assert np.abs(response.x).max() > 1e-2


@pytest.fixture(scope="module", params=[*LOADS, *BENT])
def loop(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, Spec, ProvedController, SampledBounds]:
    spec, controller = designed(stepping(request.param), tmp_path_factory.mktemp("steps"))
    return request.param, spec, controller, controller.claim(SampledBounds)


@pytest.mark.slow
def test_runs_stay_within_their_bounds(loop: tuple[str, Spec, ProvedController, SampledBounds], tmp_path: Path) -> None:
    _, spec, controller, bounds = loop
    assert "load" in {kind for kind, _ in bounds.acts.squares}
    run = simulate(spec, controller)
    assert run.outcome.kind != "above its bound"
    error, ends = np.abs(run.response.tracking_error[:, 0]), bounds.ends_below(controller)["output", 0]
    assert 0 < error[-len(error) // 10 :].max() < ends


def test_a_step_is_forgotten_and_a_disturbance_from_then_on_is_not(
    loop: tuple[str, Spec, ProvedController, SampledBounds],
) -> None:
    name, spec, controller, bounds = loop
    along = along_of(spec, controller, bounds.errors)
    assert along.rest is not None
    squares, r = bounds.acts.squares, bounds.errors.gains.substeps
    for (kind, k), each in squares.items():
        if kind == "load":
            ticks = [tick for tick, change in along.steps.items() if change[k]]
            assert sorted(np.flatnonzero(each).tolist()) == [tick * r for tick in sorted(ticks)]
        if kind == "disturbance":
            at = np.unique(np.flatnonzero(each) // r) + 1
            assert set(at.tolist()) <= set(along.steps)
    assert ("disturbance" in {kind for kind, _ in squares}) == (name in ("constants", "bent by η"))


FORGED: dict[str, Callable[[Any], Any]] = {
    "another load": lambda t: t.update(channel=["load", 7]),
    "not summed": lambda t: t.update(summed=0),
    "as noise": lambda t: t.update(channel=["noise", 0], b="0.9"),
    "a smaller bound": lambda t: t["signals"][0].__setitem__(2, "1e-9"),
    "another b": lambda t: t.update(b="0.9"),
    "no b": lambda t: t.update(b="0"),
}


@pytest.mark.slow
def test_the_auditor_agrees(loop: tuple[str, Spec, ProvedController, SampledBounds]) -> None:
    name, spec, controller, _ = loop
    content = json.loads(json.dumps(design_certificate(spec, controller)))
    assert not audit(json.dumps(content))[1]
    for forge in FORGED.values() if name == "bent" else ():  # of the others it takes long, and is found out likewise
        forged = copy.deepcopy(
            next(tube for tube in content["sampled_bounds"] if tube["acts"][0]["channel"][0] == "load")
        )
        forge(forged)
        assert audit(json.dumps(content | {"sampled_bounds": [forged]}))[1]


def test_with_jitter_a_step_counts_from_a_tick_that_comes_after_it_in_any_case(tmp_path: Path) -> None:
    ticks = list[list[int]]()
    for at in (1.9, 1.9995, 2.0, 2.0005):
        text = ONE.replace("LOADS", "{push: {into: {v: 1}}}").replace("ACTS", f"v: {{step: {{size: 2, at: {at}}}}}")
        text = text.replace("BEGINS", "{}").replace(
            "{sample_time: TICK, delay: DELAY}", "{sample_time: {nominal: 0.1, jitter: 0.002}}"
        )
        spec, controller = designed(text.replace("TICK", "0.1"), tmp_path)
        ticks.append([*along_of(spec, controller, controller.claim(SampledBounds).errors).steps])
        run = simulate(spec, controller)
        assert run.outcome.kind != "above its bound"
    assert ticks == [[20], [21], [21], [21]]


def test_with_jitter_nothing_is_said_of_a_step_that_moves_x_d(tmp_path: Path) -> None:
    """Past its tick x_d goes on as if it had not stepped, for as long as that is late: that is not walked."""
    for acts, said in (("z: 0.4", True), ("z: {step: {size: 0.4, at: 2}}", False)):
        text = ONE.replace("LOADS", "{drift: {into: {z: 1}}}").replace("ACTS", acts).replace("BEGINS", "{}")
        text = text.replace("{sample_time: TICK, delay: DELAY}", "{sample_time: {nominal: 0.1, jitter: 0.002}}")
        _, controller = designed(text.replace("TICK", "0.1"), tmp_path)
        assert bool(controller.claims_of(SampledBounds)) == said


def test_what_drifts_or_is_left_over_is_a_disturbance_from_0_on(tmp_path: Path) -> None:
    for acts in ("v: {step: {size: 1, at: 1, smooth: 0.5}}", "v: sin(t)", "z: {step: {size: 1, at: 1}}"):
        text = (
            ONE.replace("LOADS", "{push: {into: {v: 1}}}")
            .replace("ACTS", acts)
            .replace(", delay: DELAY", "")
            .replace("BEGINS", "{}")
        )
        spec, controller = designed(text.replace("TICK", "0.1"), tmp_path)
        along = along_of(spec, controller, controller.claim(SampledBounds).errors)
        assert not along.steps
        assert along.rest is spec.scenario.conditions.disturbance


def test_limits_leave_what_loads_that_step_take(tmp_path: Path) -> None:
    """u has −ŝ: a load of 2 that is there for half of the run takes 2 of the limits, and as it steps a little more."""
    text = ONE.replace("LOADS", "{push: {into: {v: 1}}}").replace("ACTS", "v: {step: {size: 2, at: 2}}")
    text = (
        text.replace(", delay: DELAY", "")
        .replace("BEGINS", "{}")
        .replace("TICK", "0.1")
        .replace("duration: 6", "duration: 30")
    )
    spec, controller = designed(text, tmp_path)
    bounds = controller.claim(SampledBounds)
    (most,), (changes,) = bounds.taken([0], np.zeros((1, bounds.errors.order)))
    assert most >= 2
    assert changes >= 4
    u = simulate(spec, controller).response.u
    (most,), _ = bounds.taken([0], np.eye(bounds.errors.order)[[2]] - np.eye(bounds.errors.order)[[5]])
    assert 1.9 < np.abs(u).max() < most
