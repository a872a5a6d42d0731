"""The sampled loop for every plant of a box: the program beside plants that it does not know."""

import copy
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pwatrack import Spec, design, load_spec
from pwatrack.claims.sampled import errors_of
from pwatrack.claims.sampled_bounds import SampledBounds
from pwatrack.claims.sampled_box import SampledBox, SampledBoxBounds
from pwatrack.commands.verify import told_design
from pwatrack.control.controller import ProvedController
from pwatrack.control.sampled_disturbances import row
from pwatrack.lmi.audit.certificate import audit
from pwatrack.lmi.clocked import looked_for
from pwatrack.model.conditions import Conditions, Sampling
from pwatrack.report.certificate import design_certificate
from pwatrack.simulation.closed_loop import closed_loop
from pwatrack.simulation.propagate import simulate_flow
from tests.sampled import tubes_alone, worst_found
from tests.test_cli import call

H = 0.02
TABLE = """
name: A table whose mass is not known
parameters: {m: 2, d: 3, k: 20}
system:
  states: [z, v]
  inputs: [u]
  outputs: [y]
  A: [[0, 1], [0, -d/m]]
  B: [[0], [1/m]]
  C: [[1, 0]]
  nonlinearities: [{name: stop, kind: spring, of: z, start: 0, slope: k, into: {v: -1/m}}]
design: {tracking: state, uncertain: BOX}
reference: {setpoint: {y: 0}}
simulation:
  duration: 6
  sample_time: 0.02
  controller: {sample_time: TIME}
  initial: {plant: {z: 0.1}}
  MORE
"""
SMALL = "{m: [1.9, 2.2], d: 10%, k: 10%}"


def written(folder: Path, *, box: str = SMALL, time: str = "0.02", more: str = "") -> Path:
    path = folder / "table.yaml"
    text = TABLE.replace("BOX", box).replace("TIME", time).replace("MORE", more)
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture(scope="module", params=["0.02", "{nominal: 0.02, jitter: 0.002}", "{delay: 1}"])
def table(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Spec, ProvedController]:
    path, time = tmp_path_factory.mktemp("table"), request.param
    if "delay" in time:
        path = written(path, time="0.02")
        text = path.read_text().replace("{sample_time: 0.02}", "{sample_time: 0.02, delay: 1}")
        path.write_text(text, encoding="utf-8")
    else:
        path = written(path, time=time)
    spec = load_spec(path)
    return spec, design(spec)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_the_form_falls_along_the_program_beside_another_plant(seed: int, tmp_path: Path) -> None:
    """x_d = 0 for all plants, so w = 0; at ticks z is (x, u, x̂ − x, 0), from the run of the program itself."""
    random = np.random.default_rng(seed)
    spec = load_spec(written(tmp_path))
    controller = design(spec)
    claim = controller.claim(SampledBox)
    assert claim.proof is not None
    P = np.array(claim.proof.P[0].P.tolist(), dtype=float)
    ends = {"m": (1.9, 2.2), "d": (2.7, 3.3), "k": (18, 22)}
    at = {name: float(random.choice(end) if seed < 3 else random.uniform(*end)) for name, end in ends.items()}
    plant, _ = spec.problem.parametric.at({**spec.parameters, **at}, ("simulation",))
    loop = closed_loop(controller, Conditions(plant=plant, sampling=Sampling(sample_time=H)))
    x, x_hat = random.normal(size=(2, 2)) * 0.3
    begin = loop.start(plant=x, observer=x_hat, generator=np.zeros(0))
    response = loop.response(simulate_flow(loop.flow, begin, duration=4.0, sample_time=H))
    z = np.hstack([response.x, response.u, response.x_hat - response.x, np.zeros((len(response.x), 1))])[1:-1]
    V = np.einsum("ki,ij,kj->k", z, P, z)
    assert V[0] > 1e-3
    assert (V[1:] <= V[:-1] * np.exp(-2 * claim.proof.rate * H) * (1 + 1e-6) + 1e-15).all()


@pytest.mark.slow
def test_it_is_proved_with_jitter_and_delay_too_and_read_again(table: tuple[Spec, ProvedController]) -> None:
    spec, controller = table
    claim = controller.claim(SampledBox)
    assert claim.proof is not None
    errors = replace(errors_of(controller, claim.gains), corners=claim.of.corners)
    assert 0.5 * claim.of.rate < claim.rate <= looked_for(errors.clocked, 1).most
    content = design_certificate(spec, controller)
    assert told_design(spec, content).claim(SampledBox).proof == claim.proof
    said, faults = audit(json.dumps(content))
    assert not faults
    assert any(one.startswith("the sampled loop for uncertain parameters: rate") for one in said)


def raised(content: Any) -> None:
    told = content["sampled_uncertain"]
    told["rate"] = f"{10 * float(told['rate'])}"


def lighter(content: Any) -> None:
    """The first corner has twice the input."""
    corner = content["uncertain"]["corners"][0]
    corner["B"][1][0] = "0.99"


@pytest.mark.slow
@pytest.mark.parametrize("change", [raised, lighter, lambda c: c["sampled_uncertain"]["P"].reverse()])
def test_what_is_forged_is_found_out(change: Any, tmp_path: Path) -> None:
    spec = load_spec(written(tmp_path))
    content = copy.deepcopy(design_certificate(spec, design(spec)))
    change(content)
    _, faults = audit(json.dumps(content))
    assert any(one.startswith("the sampled loop for uncertain parameters: ") for one in faults), faults


@pytest.mark.slow
def test_what_is_said_of_another_plant_is_of_the_loop_that_runs(tmp_path: Path) -> None:
    other = "plant: {parameters: {m: 2.1}}"
    said = call("design", written(tmp_path, more=other), "--out", tmp_path / "out").stdout
    assert "to a bound for all plants with m in [1.9, 2.2]" in " ".join(said.split())
    assert "error to 0 for other m = 2.1; to a bound only" in " ".join(said.split())
    far = written(tmp_path, box="{m: [1, 3]}", time="0.1", more=other)
    said = " ".join(call("design", far, "--out", tmp_path / "far", "--verbose").stdout.split())
    assert "not proved for every plant with m in [1, 3]" in said
    assert "to a bound only" not in said
    assert "to a bound for all plants" not in said.split("as sampled")[-1].split("NOT proved")[0]


MOVING = """noise: {std: {y: 1e-5}, sample_time: 0.02, seed: 1}
  disturbance: {v: {sine: {amplitude: 0.01, frequency: 5}}}"""


@pytest.fixture(scope="module", params=["0.02", "{nominal: 0.02, jitter: 0.0005}", "{delay: 1}"])
def moving(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Spec, ProvedController]:
    """It follows a sinusoid, is pushed, and what is measured has noise."""
    folder = tmp_path_factory.mktemp("moving")
    late = "delay" in request.param
    path = written(folder, box="{m: [1.95, 2.1], k: 5%}", time="0.02" if late else request.param, more=MOVING)
    text = path.read_text(encoding="utf-8").replace("{tracking: state, ", "{")
    text = text.replace("{setpoint: {y: 0}}", "{output: 0.1*sin(t)}")
    text = text.replace("{sample_time: 0.02}", "{sample_time: 0.02, delay: 1}") if late else text
    path.write_text(text, encoding="utf-8")
    spec = load_spec(path)
    return spec, design(spec)


def bounds_of(controller: ProvedController) -> SampledBoxBounds:
    claim = controller.claim(SampledBoxBounds)
    assert claim.from_zero, "all that acts has a tube"
    return claim


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_no_plant_of_the_box_is_above_its_bound_in_any_substep(
    seed: int, moving: tuple[Spec, ProvedController]
) -> None:
    spec, controller = moving
    claim, random = bounds_of(controller), np.random.default_rng(seed)
    ends = {"m": (1.95, 2.1), "k": (19, 21)}
    at = {name: float(random.choice(end) if seed < 4 else random.uniform(*end)) for name, end in ends.items()}
    plant, _ = spec.problem.parametric.at({**spec.parameters, **at}, ("simulation",))
    loop = closed_loop(controller, replace(spec.scenario.conditions, plant=plant, parameters=at))
    start = np.array([0.0, 0.1])
    begin, gains = loop.start(plant=start, observer=start, generator=np.zeros(0)), claim.errors.gains
    resets = tuple(loop.resets(6.0))
    response = loop.response(simulate_flow(loop.flow, begin, duration=6.0, sample_time=0.005, resets=resets))
    index = np.floor(response.t * gains.substeps / gains.sample_time).astype(int)
    first = 0.0 if not gains.delay else 1.0
    for form, most in claim.from_zero.items():
        if form[0] != "output" or gains.jitter or first:
            allowed = np.full(len(response.t), most.max())
        else:
            allowed = np.max([most[np.clip(index + k, 0, len(most) - 1)] for k in (-1, 0, 1)], axis=0)
        found = {"output": response.tracking_error, "input": response.u - response.u_ff}.get(form[0])
        if found is not None and not (gains.delay and form[0] == "input"):
            assert (np.abs(found[:, form[1]]) <= allowed * (1 + 1e-9)).all()
    designed = controller.claim(SampledBounds).from_zero["output", 0].max()
    errors = np.abs(response.tracking_error[:, 0])
    assert errors.max() > 0.005 * claim.from_zero["output", 0].max()
    assert seed >= 4 or errors[len(errors) // 2 :].max() > 0.1 * designed


def test_no_switching_of_plants_and_nothing_that_acts_is_above_a_tube(moving: tuple[Spec, ProvedController]) -> None:
    claim = bounds_of(moving[1])
    kinds = {channel[0] for channel in tubes_alone(claim)}
    assert {"nominal", "moved", "disturbance", "noise"} <= kinds
    acting = {k for kind, k in tubes_alone(claim) if kind == "nominal"}
    assert acting == {*range(2 * len(claim.errors.paces))}, "all entries of e₀ act, not R e₀ alone"
    for channel, (one, *_) in tubes_alone(claim).items():
        for form, size in zip(claim.forms, one.sizes, strict=True):
            c = row(claim.errors, form).floats
            found = (worst_found(claim, channel, c, seed, summed=one.summed) for seed in range(3))
            assert max(found) <= size * (1 + 1e-9)


def test_what_another_plant_does_otherwise_is_enclosed_as_a_disturbance(moving: tuple[Spec, ProvedController]) -> None:
    """Of w = f_p(x_d) − f(x_d) + (B_p − B) u_ff at samples the largest, over the corners, is what is enclosed."""
    spec, controller = moving
    claim, loop = bounds_of(controller), closed_loop(controller, Conditions())
    t = np.arange(0, 6, 0.01)
    x_d = np.column_stack([0.1 * np.sin(t), 0.1 * np.cos(t)])
    u_ff = 2 * (-0.1 * np.sin(t) + 1.5 * x_d[:, 1] + 10 * np.maximum(x_d[:, 0], 0))
    assert loop.x_d is not None
    most = 0.0
    for m in (1.95, 2.1):
        for k in (19, 21):
            plant, _ = spec.problem.parametric.at({**spec.parameters, "m": m, "k": k}, ("simulation",))
            each = zip(x_d, u_ff, strict=True)
            w = [plant.field(x, np.array([u])) - controller.plant.field(x, np.array([u])) for x, u in each]
            most = max(most, float(np.abs(w).max()))
    late = 1 + claim.errors.gains.jitter / claim.errors.gains.sample_time
    enclosed = float(np.sqrt(claim.acts.squares["disturbance", 1].max()))
    assert most < enclosed < 1.1 * late * most + 0.0105 * late


@pytest.mark.slow
def test_the_bounds_are_read_again_and_what_is_forged_is_found_out(moving: tuple[Spec, ProvedController]) -> None:
    spec, controller = moving
    content = design_certificate(spec, controller)
    assert told_design(spec, content).claim(SampledBoxBounds).data(controller) == bounds_of(controller).data(controller)
    assert not audit(json.dumps(content))[1]
    forgeries: list[Any] = [
        lambda c: c["sampled_uncertain_bounds"][0]["signals"][0].__setitem__(2, "1e-9"),
        lambda c: c["sampled_uncertain_bounds"][0].update(channel=["nominal", 4]),
        lambda c: c["sampled_uncertain_bounds"].append(c["sampled_uncertain_bounds"][0]),
        lambda c: c["sampled_uncertain_bounds"][0].update(a="30"),
        lambda c: c.update(sampled_uncertain=None),
        lighter,
    ]
    for change in forgeries:
        forged = copy.deepcopy(content)
        change(forged)
        assert audit(json.dumps(forged))[1]


@pytest.mark.slow
def test_the_first_screen_says_the_bound_of_the_box_where_another_plant_of_it_runs(tmp_path: Path) -> None:
    path = written(tmp_path, box="{m: [1.95, 2.1], k: 5%}", more=MOVING + "\n  plant: {parameters: {m: 2.05}}")
    text = path.read_text(encoding="utf-8").replace("{tracking: state, ", "{")
    path.write_text(text.replace("{setpoint: {y: 0}}", "{output: 0.1*sin(t)}"), encoding="utf-8")
    run = call("simulate", path, "--out", tmp_path / "out", "--verbose")
    assert run.exit_code == 0, run.output
    said = " ".join(run.stdout.split())
    assert "box, in this run |y − y_d| ≤" in said
    assert "0.05 is half the reference; most by " in said
    short = " ".join(call("simulate", path, "--out", tmp_path / "out").stdout.split())
    assert "no better than |y − y_d| ≤" in short
    figures = json.loads((tmp_path / "out" / "run.json").read_text(encoding="utf-8"))
    assert figures["sampled_uncertain_bounds"]["ends_below"]["y - y_d"]["bound"] > 0
