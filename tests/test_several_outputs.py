"""Several tracked outputs: vector relative degree, decoupling, more inputs than outputs."""

import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import eigvals

from pwatrack import InvalidSpec, OutsideTheory, PwatrackError, design, load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.claims.robust import Robust
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
from pwatrack.spec.expression import formula
from tests.conftest import SPECS
from tests.plants import random_outputs
from tests.promises import follow

KINDS = [((1, 1), 2, 0), ((2, 1), 2, 0), ((2, 2), 1, 1), ((1, 2, 1), 1, 0), ((3, 1), 1, 1), ((1,), 3, 2)]


def kind(seed: int) -> tuple[tuple[int, ...], int, int]:
    return KINDS[seed % len(KINDS)]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(12))
def test_random_plants_with_several_outputs_are_followed(seed: int) -> None:
    degrees, internal, spare = kind(seed)
    plant = random_outputs(seed, degrees, internal, spare, k=1 + seed % 2)
    assert normal_form(plant).degrees == degrees
    assert follow(plant, seed) < 1e-8


def changed(
    plant: PWASystem, *, S: Array | None = None, outputs: Sequence[int] = (), inputs: Sequence[int] = ()
) -> PWASystem:
    """Return the plant in the state S x, with outputs and inputs in another order."""
    S = np.eye(plant.A.shape[1]) if S is None else S
    back, partition = np.linalg.inv(S), plant.partition
    rows, columns = list(outputs) or list(range(len(plant.C))), list(inputs) or list(range(plant.B.shape[1]))
    return PWASystem.create(
        partition=Partition.create(H=partition.H @ back, h=partition.h, signs=partition.signs, names=plant.cell_names),
        A=S @ plant.A @ back,
        b=plant.b @ S.T,
        B=(S @ plant.B)[:, columns],
        C=(plant.C @ back)[rows],
        tracked=(plant.tracked @ back)[rows],
    )


def verdict(plant: PWASystem) -> str:
    try:
        generator = trajectory_generator(normal_form(plant))
    except PwatrackError as refusal:
        return type(refusal).__name__
    return "played back" if generator.played_back else "proved"


def destabilised(plant: PWASystem, form_of: PWASystem, rate: float) -> PWASystem:
    """Return the plant with the rows of its zero dynamics moved by a rate to the right."""
    form = normal_form(form_of)
    shift = rate * form.T_inverse[0][:, form.r :] @ form.T[0][form.r :]
    return PWASystem.create(
        partition=plant.partition, A=plant.A + shift, b=plant.b, B=plant.B, C=plant.C, tracked=plant.tracked
    )


@pytest.mark.slow
@pytest.mark.parametrize("bent", [False, True])
@pytest.mark.parametrize("seed", range(12))
def test_verdicts_do_not_depend_on_coordinates_or_on_the_order_of_outputs_and_inputs(seed: int, bent: bool) -> None:
    degrees, internal, spare = kind(seed)
    random = np.random.default_rng(seed)
    plant = random_outputs(seed, degrees, internal, spare, k=2, bent=bent)
    if seed % 4 == 3:  # zero dynamics of the other kind
        plant = destabilised(plant, plant, 12.0)
    n, m, p = plant.A.shape[1], plant.B.shape[1], len(plant.C)
    S = np.linalg.qr(random.normal(size=(n, n)))[0] * random.uniform(0.5, 2.0, size=n)
    outputs, inputs = random.permutation(p).tolist(), random.permutation(m).tolist()
    form, found = normal_form(plant), verdict(plant)
    assert (found == "proved") == (seed % 4 != 3)
    for other in (changed(plant, S=S), changed(plant, outputs=outputs), changed(plant, inputs=inputs)):
        assert verdict(other) == found
        for one, two in zip(normal_form(other).Psi, form.Psi, strict=True):
            np.testing.assert_allclose(np.poly(one), np.poly(two), rtol=1e-5, atol=1e-7)
    assert normal_form(changed(plant, outputs=outputs)).degrees == tuple(form.degrees[j] for j in outputs)


@pytest.mark.parametrize("seed", range(12))
def test_one_cell_has_the_zeros_and_the_response_of_linear_theory(seed: int) -> None:
    """Zero dynamics against the zeros of the pencil; x_d and u_ff for sines against transfer functions."""
    degrees, internal, spare = kind(seed)
    plant = random_outputs(seed, degrees, internal, spare, k=0)
    form = normal_form(plant)
    A, Z, C = plant.A[0], form.exact.directions.floats, plant.C
    n, p = len(A), len(degrees)
    BZ = plant.B @ Z
    pencil = np.block([[A, BZ], [C, np.zeros((p, p))]])
    zeros = eigvals(pencil, np.diag([1.0] * n + [0.0] * p))
    zeros = zeros[np.argsort(np.abs(zeros))]
    assert (np.abs(zeros[n - sum(degrees) :]) > 1e3).all()  # those at infinity, of which rounding makes ε^(−1/3)
    zeros = zeros[: n - sum(degrees)]
    np.testing.assert_allclose(np.poly(zeros).real, np.poly(form.Psi[0]), rtol=1e-6, atol=1e-6)
    omega = 1.3
    s = 1j * omega
    Y = np.exp(1j * np.arange(p))
    V = np.linalg.solve(C @ np.linalg.solve(s * np.eye(n) - A, BZ), Y)
    X, at_rest = np.linalg.solve(s * np.eye(n) - A, BZ @ V), np.linalg.solve(pencil, -np.append(plant.b[0], 0 * Y.real))
    waves = [Signal.of(formula(f"cos({omega}*t + {j})", {})) for j in range(p)]
    generator = trajectory_generator(form)
    trajectory = output_trajectory(generator, exosystem(waves))
    eta = form.T[0][form.r :] @ (X.real + at_rest[:n]) + form.offset[0, form.r :]
    now = np.concatenate([eta, trajectory.exosystem.w0, [1.0]])
    scale = np.abs(X).max()
    np.testing.assert_allclose(trajectory.x_d[0] @ now, X.real + at_rest[:n], atol=1e-9 * scale)
    np.testing.assert_allclose(trajectory.u_ff[0] @ now, Z @ (V.real + at_rest[n:]), atol=1e-8 * np.abs(V).max())
    rate = form.T[0][form.r :] @ (s * X).real
    np.testing.assert_allclose(trajectory.rate[0] @ now, rate, atol=1e-8 * scale)


def test_the_feedforward_of_more_inputs_than_outputs_is_the_least_in_sizes() -> None:
    plant = PWASystem.create(
        partition=Partition.create(H=np.zeros((0, 1)), h=[], signs=np.zeros((1, 0)), names=["all"]),
        A=[[["-1"]]],
        b=[["0"]],
        B=[["1", "1"]],
        C=[["1"]],
    )
    shares = {1.0: [0.5, 0.5], 3.0: [0.9, 0.1]}  # of v = u1 + u2, by u1's size beside that of u2
    for size, share in shares.items():
        found = normal_form(plant, input_sizes=np.array([size, 1.0])).right_inverse[0, :, 0]
        np.testing.assert_allclose(found, share, atol=1e-6)
        assert found.sum() == pytest.approx(1.0, abs=1e-15)


def square(B: list[list[str]], C: list[list[str]]) -> PWASystem:
    return PWASystem.create(
        partition=Partition.create(H=np.zeros((0, 3)), h=[], signs=np.zeros((1, 0)), names=["all"]),
        A=[[["-1", "1", "0"], ["0", "-1", "1"], ["1", "0", "-2"]]],
        b=[["0"] * 3],
        B=B,
        C=C,
        outputs=["level", "flow"][: len(C)],
    )


def test_inputs_that_do_not_act_independently_are_refused_with_outputs_and_rows() -> None:
    plant = square([["1", "2"], ["0.1", "0.2"], ["0", "0"]], [["1", "0", "0"], ["0", "1", "0"]])
    with pytest.raises(OutsideTheory) as refusal:
        normal_form(plant)
    message = refusal.value.problems[0].message
    assert "the inputs do not act on 'level' and 'flow' independently" in message
    assert "level: row C A^0 B = (1, 2); flow: row C A^0 B = (0.1, 0.2)" in message
    with pytest.raises(OutsideTheory, match="as many inputs as tracked outputs, the plant has 1 and 2"):
        normal_form(square([["1"], ["0"], ["0"]], [["1", "0", "0"], ["0", "1", "0"]]))


GANTRY = (SPECS / "gallery" / "gantry.yaml").read_text()


def as_designed(text: str) -> str:
    """Return a spec without loads, limits and requirements."""
    return re.sub(r"(?m)^(require|design|  disturbance|  actuator): .*\n", "", text)


@pytest.mark.slow
def test_a_gantry_is_followed_by_both_axes_and_its_certificate_holds(tmp_path: Path) -> None:
    result = simulate(load_spec(SPECS / "gallery" / "gantry.yaml"))
    assert result.controller.generator is not None
    form = result.controller.generator.form
    assert (form.degrees, form.r) == ((2, 2), 4)
    assert np.abs(result.response.tracking_error[-100:]).max() < 1e-8
    ff = result.response.u_ff
    np.testing.assert_allclose(ff[2000:, 0], ff[2000:, 1], rtol=1e-6)  # both ends alike: the least that does it
    folder = write_result(result, tmp_path / "run", plots="none")
    assert "Theorem 3, output tracking: none of its inequalities is absent" in verify(folder)
    content = json.loads((folder / "certificate.json").read_text())
    for name, value in (("directions", [["1", "0"], ["0", "0"], ["0", "1"]]), ("relative_degrees", [2, 1])):
        assert audit(json.dumps(content | {"generator": content["generator"] | {name: value}}))[1]


@pytest.mark.parametrize(
    ("output", "message"),
    [
        ("{px: 0, pz: 1}", "pz: 'pz' is no tracked output"),
        ("{px: 0}", "must give every tracked output, and leaves out py"),
        ("sin(t)", "is one signal, and 2 outputs are tracked: px, py"),
        ("{px: 0, py: {step: {size: 1, at: 1}}}", "py_d is not 2 times differentiable"),
    ],
)
def test_a_reference_is_given_for_each_tracked_output(tmp_path: Path, output: str, message: str) -> None:
    path = tmp_path / "gantry.yaml"
    path.write_text(re.sub("output: .*", f"output: {output}", GANTRY, count=1))
    with pytest.raises(PwatrackError) as refusal:
        design(load_spec(path))
    assert message in refusal.value.problems[0].message
    assert refusal.value.problems[0].place is not None


@pytest.mark.parametrize("output", ["{px: 0}", "sin(t)", "{px: 0, pz: 1}"])
def test_so_it_is_where_tracking_is_practical(tmp_path: Path, output: str) -> None:
    text = re.sub("output: .*", f"output: {output}", as_designed(GANTRY), count=1)
    path = tmp_path / "gantry.yaml"
    path.write_text(text.replace("reference:", "design: {tracking: practical}\nreference:", 1))
    with pytest.raises(InvalidSpec, match="tracked") as refusal:
        load_spec(path)
    assert refusal.value.problems[0].place is not None


@pytest.mark.slow
def test_loads_are_made_up_for_with_several_outputs(tmp_path: Path) -> None:
    text = as_designed(GANTRY).replace("reference:", "design: {estimate: input}\nreference:", 1)
    path = tmp_path / "gantry.yaml"
    path.write_text(text.replace("  settled", "  disturbance: {v1: -20/m, w: 30/mt}\n  settled"))
    result = simulate(load_spec(path))
    assert np.abs(result.response.tracking_error[-100:]).max() < 1e-7
    np.testing.assert_allclose(result.response.estimates[-1], [-20, 0, 30], atol=1e-4)
    assert verify(write_result(result, tmp_path / "run", plots="none"))


@pytest.mark.slow
def test_a_box_of_parameters_is_proved_with_several_outputs(tmp_path: Path) -> None:
    text = (SPECS / "gallery" / "three_tanks_pumps.yaml").read_text()
    path = tmp_path / "tanks.yaml"
    path.write_text(as_designed(text) + "design: {uncertain: {w: 10%}}")
    result = simulate(load_spec(path))
    assert result.controller.claims_of(Robust)
    assert any(
        "uncertain parameters: w" in line for line in verify(write_result(result, tmp_path / "run", plots="none"))
    )


@pytest.mark.slow
def test_a_sampled_controller_is_off_by_the_square_of_its_sample_time_with_several_outputs(tmp_path: Path) -> None:
    errors, path = [], tmp_path / "gantry.yaml"
    path.write_text(as_designed(GANTRY))
    controller = design(load_spec(path))
    for sample_time in (0.001, 0.0005):
        sampled = f"  controller: {{sample_time: {sample_time}}}\n  settled"
        path.write_text(as_designed(GANTRY).replace("  settled", sampled))
        errors.append(np.abs(simulate(load_spec(path), controller).response.tracking_error[-100:]).max())
    assert errors[1] < 1e-3
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)
