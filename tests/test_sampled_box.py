"""The sampled loop for every plant of a box: the program beside plants that it does not know."""

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pwatrack import Spec, design, load_spec
from pwatrack.claims.sampled_box import SampledBox
from pwatrack.commands.verify import told_design
from pwatrack.control.controller import ProvedController
from pwatrack.lmi.audit.certificate import audit
from pwatrack.model.conditions import Conditions, Sampling
from pwatrack.report.certificate import design_certificate
from pwatrack.simulation.closed_loop import closed_loop
from pwatrack.simulation.propagate import simulate_flow
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


def test_it_is_proved_with_jitter_and_delay_too_and_read_again(table: tuple[Spec, ProvedController]) -> None:
    spec, controller = table
    claim = controller.claim(SampledBox)
    assert claim.proof is not None
    assert 0 < claim.rate <= claim.of.rate * 1.2
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


@pytest.mark.parametrize("change", [raised, lighter, lambda c: c["sampled_uncertain"]["P"].reverse()])
def test_what_is_forged_is_found_out(change: Any, tmp_path: Path) -> None:
    spec = load_spec(written(tmp_path))
    content = copy.deepcopy(design_certificate(spec, design(spec)))
    change(content)
    _, faults = audit(json.dumps(content))
    assert any(one.startswith("the sampled loop for uncertain parameters: ") for one in faults), faults


def test_what_is_said_of_another_plant_is_of_the_loop_that_runs(tmp_path: Path) -> None:
    other = "plant: {parameters: {m: 2.1}}"
    said = call("design", written(tmp_path, more=other), "--out", tmp_path / "out").stdout
    assert "to a bound for all plants with m in [1.9, 2.2]" in " ".join(said.split())
    assert "error to 0 for other m = 2.1; to a bound only" in " ".join(said.split())
    wide = "{m: [1.9, 2.2], d: 10%, k: 10%}"
    far = written(tmp_path, box=wide, time="0.3", more=other)
    said = " ".join(call("design", far, "--out", tmp_path / "far", "--verbose").stdout.split())
    assert "to a bound only" not in said
    assert "to a bound for all plants" not in said.split("as sampled")[-1].split("NOT proved")[0]
