"""What is measured and what is tracked are two things: (9) uses the one, (11)–(17) the other."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pwatrack import design, load_spec, simulate
from pwatrack.claims.cost import Costs
from pwatrack.errors import InvalidSpec
from pwatrack.lmi.audit.certificate import audit
from pwatrack.lmi.inequality import OBSERVER
from pwatrack.report.certificate import design_certificate
from pwatrack.report.files import write_result
from pwatrack.spec.spec import Spec
from tests.conftest import SPECS

STAGE = """
name: Stage
parameters: {{k: 4, c: 0.5, far: 1}}
system:
  states: [z1, v1, z2, v2]
  inputs: [u]
  outputs: {outputs}
  {track}
  A: [[0, 1, 0, 0], [-k - 1, -c - 1, k, c], [0, 0, 0, 1], [k, c, -k, -c]]
  nonlinearities:
    - {{name: stop, kind: spring, of: z1, start: 0.1, slope: 3, into: {{v1: -1}}}}
  B: [[0], [1], [0], [0]]
  C: {C}
{design}
reference: {reference}
simulation: {{duration: 40, sample_time: 0.01, initial: {{plant: [0.2, 0, 0.1, 0]}}}}
"""
ROWS = {"z1": [1, 0, 0, 0], "v1": [0, 1, 0, 0], "z2": [0, 0, 1, 0]}


def stage(
    folder: Path, sensors: list[str], track: str, *, reference: str = "{output: 0.2*sin(t)}", more: str = ""
) -> Spec:
    outputs = [f"y_{sensor}" for sensor in sensors]
    path = folder / "stage.yaml"
    C = [ROWS[sensor] for sensor in sensors]
    text = STAGE.format(outputs=outputs, track=track, C=C, reference=reference, design=more).replace("'", "")
    path.write_text(text, encoding="utf-8")
    return load_spec(path)


def test_the_generator_knows_the_tracked_row_only_and_the_observer_the_measured_ones_only(tmp_path: Path) -> None:
    """One sensor or two, of this or that: K and (11)–(17) are those of the tracked form, by hand η = z1."""
    makers = [(["z2"], "track: [y_z2]"), (["z1", "z2"], "track: [y_z2]"), (["v1", "z1"], "track: {payload: z2}")]
    controllers = [design(stage(tmp_path, sensors, track)) for sensors, track in makers]
    for controller, (sensors, _) in zip(controllers, makers, strict=True):
        assert controller.generator is not None
        plant, L, form = controller.plant, controller.design.L, controller.generator.form
        assert (form.r, form.eta_names) == (3, ("z1",))
        assert np.allclose(form.Psi, -4 / 0.5, rtol=1e-12)  # the zero at -k/c
        assert np.allclose(controller.design.K, controllers[0].design.K, rtol=1e-9)
        C = np.array([ROWS[sensor] for sensor in sensors], dtype=float)
        assert L.shape == (4, len(sensors))
        assert all(np.linalg.eigvals(A + L @ C).real.max() < 0 for A in plant.A)


def test_what_no_sensor_measures_follows_its_reference(tmp_path: Path) -> None:
    """The closed loop, integrated by scipy from the equations (10), (18) and the trajectory of the trace."""
    result = simulate(stage(tmp_path, ["v1", "z1"], "track: {payload: z2}"))
    r, gains = result.response, result.controller.design
    payload = r.x[:, 2]
    assert np.allclose(r.tracked_d[:, 0], 0.2 * np.sin(r.t), atol=1e-14)
    assert np.array_equal(r.tracking_error[:, 0], r.tracked[:, 0] - r.tracked_d[:, 0])
    assert np.abs(payload - 0.2 * np.sin(r.t))[-400:].max() < 1e-5 < np.abs(payload - 0.2 * np.sin(r.t))[:400].max()

    A = np.array([[0, 1, 0, 0], [-5, -1.5, 4, 0.5], [0, 0, 0, 1], [4, 0.5, -4, -0.5]])
    C, B = np.array([ROWS["v1"], ROWS["z1"]], dtype=float), np.array([0.0, 1, 0, 0])

    def field(t: float, z: np.ndarray) -> np.ndarray:
        x, x_hat, z1_d = z[:4], z[4:8], z[8]
        y, dy, ddy, dddy = (0.2 * np.sin(t + k * np.pi / 2) for k in range(4))
        v1_d = (ddy + 4 * (y - z1_d) + 0.5 * dy) / 0.5  # of the payload: z2'' = 4 (z1 - z2) + 0.5 (v1 - v2)
        x_d = np.array([z1_d, v1_d, y, dy])
        rate = (dddy + 4 * (dy - v1_d) + 0.5 * ddy) / 0.5  # of v1_d
        u_ff = rate - A[1] @ x_d + 3 * max(0.0, z1_d - 0.1)
        u = float((gains.K @ (x_hat - x_d))[0]) + u_ff
        plant, observer = (A @ s - 3 * B * max(0.0, s[0] - 0.1) + B * u for s in (x, x_hat))
        return np.concatenate([plant, observer + gains.L @ C @ (x_hat - x), [v1_d]])

    start = np.concatenate([r.x[0], r.x_hat[0], [r.x_d[0, 0]]])
    alone = solve_ivp(field, (0, 5), start, rtol=1e-10, atol=1e-12, max_step=0.01, t_eval=r.t[:501])
    assert np.abs(alone.y[:4].T - r.x[:501]).max() < 1e-6


@pytest.mark.slow
def test_the_order_of_the_sensors_changes_nothing(tmp_path: Path) -> None:
    one, other = (design(stage(tmp_path, s, "track: {payload: z2}")) for s in (["z1", "v1"], ["v1", "z1"]))
    assert np.allclose(one.design.L, other.design.L[:, ::-1], rtol=1e-5, atol=1e-6)
    assert [bounds.channel for bounds in one.bounds][-2:] == [("noise", 0), ("noise", 1)]
    last = [bounds.sizes["output", 0] for bounds in one.bounds], [b.sizes["output", 0] for b in other.bounds]
    assert np.allclose(last[0][4:], last[1][:3:-1], rtol=1e-2)


def test_a_second_sensor_lowers_what_noise_and_pushes_can_do(tmp_path: Path) -> None:
    """Kalman gains: the covariance of the error with more measured is below that with less."""
    more = "design: {observer: {cost: {Q: [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]], R: %s}}}"
    few = design(stage(tmp_path, ["z1"], "", more=more % "[[0.01]]", reference="{output: 0.2*sin(t)}"))
    two = design(stage(tmp_path, ["z1", "z2"], "track: [y_z1]", more=more % "[[0.01, 0], [0, 0.01]]"))
    assert np.trace(two.claim(Costs).X[OBSERVER]) < 0.9 * np.trace(few.claim(Costs).X[OBSERVER])


def test_a_set_point_is_one_of_what_is_tracked(tmp_path: Path) -> None:
    spec = stage(
        tmp_path,
        ["v1", "z1"],
        "track: {payload: far*z2}",
        reference="{setpoint: {payload: 0.3}}",
        more="design: {tracking: state}",
    )
    x_d = design(spec).trajectory.x_d[0, :, -1]
    assert np.allclose(x_d, [0.3, 0, 0.3, 0], atol=1e-15)  # at rest the spring between them is free
    doubled, _ = spec.problem.parametric.at({"far": 2}, ())
    assert doubled.tracked.tolist() == [[0, 0, 2, 0]]


@pytest.mark.parametrize(
    ("track", "message"),
    [
        ("track: [z2]", "track: 'z2' is no output; outputs: y_z1, y_v1"),
        ("track: {far_end: z2 + 0.1}", "far_end: a constant does not belong into what is tracked"),
        ("track: {z2: z2}", "'z2' is declared under states and under track"),
        ("track: {y_v1: z2}", "'y_v1' is declared under outputs and under track"),
        ("track: {far_end: z3}", "z3"),
        ("track: []", "at least one name is expected"),
        ("track: {}", "at least 1 entry is expected"),
        ("track: {z1_hat: z2}", "'z1_hat' is how the trace names"),
    ],
)
def test_what_cannot_be_tracked_is_refused_with_its_place(tmp_path: Path, track: str, message: str) -> None:
    with pytest.raises(InvalidSpec) as refusal:
        stage(tmp_path, ["z1", "v1"], track)
    assert any(message in problem.message and problem.place for problem in refusal.value.problems), refusal.value


def test_an_output_that_is_tracked_under_its_own_name_is_to_be_listed(tmp_path: Path) -> None:
    with pytest.raises(InvalidSpec, match=r"track: \[y_v1\]"):
        stage(tmp_path, ["z1", "v1"], "track: {y_v1: z2}")


def test_with_several_sensors_it_must_be_said_which_one_is_tracked(tmp_path: Path) -> None:
    with pytest.raises(InvalidSpec, match="one signal, and 2 outputs are tracked: y_z1, y_z2") as refusal:
        stage(tmp_path, ["z1", "z2"], "")
    assert "say which one follows the reference: track: [y_z1]" in refusal.value.problems[0].hint


@pytest.mark.slow
def test_the_certificate_holds_what_is_tracked_and_the_auditor_reads_it(tmp_path: Path) -> None:
    result = simulate(stage(tmp_path, ["v1", "z1"], "track: {payload: z2}"))
    content = design_certificate(result.spec, result.controller)
    assert content["plant"]["tracked_rows"] == [["0", "0", "1", "0"]]
    assert audit(json.dumps(content))[1] == []
    other = json.loads(json.dumps(content))
    other["plant"]["tracked_rows"] = [["1", "0", "0", "0"]]
    assert "the relative degree is not 3" in audit(json.dumps(other))[1][0]
    halved = json.loads(json.dumps(content))
    halved["plant"]["tracked_rows"] = [["0", "0", "2", "0"]]
    assert audit(json.dumps(halved))[1]
    folder = write_result(result, tmp_path / "run", plots="none")
    header = (folder / "trace.csv").read_text(encoding="utf-8").split("\n", 1)[0].split(",")
    assert {"y_v1", "y_v1_d", "payload", "payload_d"} <= set(header)
    signals = json.loads((folder / "bounds.json").read_text(encoding="utf-8"))["table"][0]["signals"]
    assert "payload - payload_d" in signals


def test_where_nothing_is_said_all_outputs_are_tracked() -> None:
    plant = load_spec(SPECS / "two_mass_backlash.yaml").problem.plant
    assert plant.tracked_names == plant.outputs
    assert np.array_equal(plant.tracked, plant.C)
