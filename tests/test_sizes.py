"""Sizes: where they are from, that they are the weights and the norm of a design, and that units change nothing."""

import re
from io import StringIO
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from scipy.linalg import solve_continuous_are

from pwatrack import Spec, design, load_spec
from pwatrack.control.applicability import applicability
from pwatrack.control.goal import AtLeast, Fastest
from pwatrack.control.synthesis import Gains, gain, synthesize
from pwatrack.control.task import Task
from pwatrack.errors import Infeasible, InvalidSpec
from pwatrack.lmi.inequality import CONTROLLER, OBSERVER
from pwatrack.model.sizes import Sizes
from pwatrack.report.plant import print_plant
from pwatrack.workflow.sizing import spec_sizes
from tests.conftest import SPECS
from tests.units import Units, apart, in_units

GALLERY = sorted((SPECS / "gallery").glob("*.yaml"))

CART = """
name: Cart
system:
  states: [z, v]
  inputs: [u]
  outputs: [y]
  SIZES
  B: [[0], [1/2]]
  C: [[1, 0]]
  cells:
    - {name: all, where: [], A: [[0, 1], [0, DAMPING]]}
design: {tracking: TRACKING}
reference: {REFERENCE}
simulation: {duration: 10, sample_time: 0.1, MORE}
"""


TANK = """
name: Tank
system: {states: [h], inputs: [u], outputs: [y], sizes: {h: SIZE}, A: [[-0.5]], B: [[1]], C: [[1]]}
DESIGN
reference: {output: sin(t)}
simulation: {duration: 1, sample_time: 0.1}
"""


def cart(
    folder: Path,
    *,
    sizes: str = "",
    damping: str = "0",
    reference: str = "setpoint: {y: 0}",
    more: str = "initial: {plant: [1, 0]}",
) -> Spec:
    tracking = "output" if "output" in reference else "state"
    text = CART.replace("SIZES", f"sizes: {sizes}" if sizes else "").replace("DAMPING", damping)
    text = text.replace("TRACKING", tracking).replace("REFERENCE", reference).replace("MORE", more)
    path = folder / "cart.yaml"
    path.write_text(text, encoding="utf-8")
    return load_spec(path)


def designed(spec: Spec) -> tuple[Gains, Sizes]:
    sizes, goals = spec_sizes(spec), spec.objectives
    plant = spec.problem.plant
    try:
        return synthesize(plant, controller=goals.controller, observer=goals.observer, sizes=sizes), sizes
    except Infeasible:  # with some of the cells merged
        controller = design(spec)
        return controller.design, controller.sizes


@pytest.mark.slow
@pytest.mark.parametrize("path", [*GALLERY[::5], SPECS / "two_mass_goals.yaml"], ids=lambda path: path.stem)
def test_other_units_give_the_same_controller(path: Path, tmp_path: Path) -> None:
    first, sizes = designed(load_spec(path))
    other = tmp_path / path.name
    for seed in range(2):
        units = Units.random(path, seed)
        other.write_text(in_units(path, units), encoding="utf-8")
        assert apart(first, designed(load_spec(other))[0], sizes, units) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("asked", ["rate: largest, gain: 2", "rate: 0.05, gain: 3", "rate: 0.2", "gain: 1"])
def test_other_units_keep_what_is_asked_of_a_gain(asked: str, tmp_path: Path) -> None:
    text = (SPECS / "two_mass_goals.yaml").read_text(encoding="utf-8")
    path, other = tmp_path / "asked.yaml", tmp_path / "other.yaml"
    path.write_text(re.sub(r"controller: \{.*\}", f"controller: {{{asked}}}", text), encoding="utf-8")
    units = Units.random(path, 5)
    other.write_text(in_units(path, units), encoding="utf-8")
    first, sizes = designed(load_spec(path))
    assert apart(first, designed(load_spec(other))[0], sizes, units) < 1e-5


def test_each_size_is_from_the_first_that_says_it(tmp_path: Path) -> None:
    limits = "actuator: {limits: {u: [-2, 6]}}"
    box = "ensemble: {initial: {plant: {z: [0.1, 0.5], v: [-3, 1]}}}"
    noise = "noise: {std: {y: 0.7}, sample_time: 0.1}"
    wave = "output: 5 + 0.5*sin(3*t)"
    for given, said, found in (
        ({}, "", {"z": "balanced", "v": "balanced", "u": "balanced", "y": "balanced"}),
        ({}, limits, {"z": "balanced", "v": "balanced", "u": (4, "limits"), "y": "balanced"}),
        ({}, box, {"z": (0.2, "ensemble"), "v": (2, "ensemble"), "u": "balanced", "y": (0.2, "balanced")}),
        ({"reference": wave}, box, {"z": (0.5, "reference"), "v": (1.5, "reference"), "y": (0.5, "reference")}),
        ({"reference": wave}, noise, {"z": (0.5, "reference"), "y": (0.7, "noise")}),
        ({"reference": wave}, noise.replace("0.7", "0.4"), {"y": (0.5, "reference")}),
        (
            {"sizes": "{y: 0.01, u: 3}", "reference": wave},
            f"{noise}, {limits}",
            {"y": (0.01, "given"), "u": (3, "given")},
        ),
        ({"reference": "setpoint: {y: -4}"}, "", {"z": (4, "reference"), "y": (4, "reference"), "v": "balanced"}),
        ({"reference": "state: [0.5*sin(3*t), 1.5*cos(3*t)]"}, "", {"v": (1.5, "reference"), "u": "balanced"}),
        ({"reference": "input: [0.3*sin(t)], start: [0, 0]", "damping": "-1"}, "", {"u": (0.3, "reference")}),
    ):
        sizes = spec_sizes(cart(tmp_path, **given, **({"more": said} if said else {})))
        for name, wanted in found.items():
            if isinstance(wanted, str):
                assert sizes.origins[name] == wanted, name
            else:
                assert sizes.origins[name] == wanted[1], name
                assert sizes.by_name[name] == pytest.approx(wanted[0], rel=1e-5), name


def test_a_reference_sizes_every_state_that_is_a_function_of_it(tmp_path: Path) -> None:
    """y = 2 z + v / 5 has relative degree 1: neither state is ξ alone. y = 2 z has 2, and both are."""
    assert spec_sizes(cart(tmp_path, reference="output: sin(t)")).origins["v"] == "reference"
    text = (tmp_path / "cart.yaml").read_text(encoding="utf-8")
    (tmp_path / "mixed.yaml").write_text(text.replace("C: [[1, 0]]", "C: [[2, 1/5]]"), encoding="utf-8")
    sizes = spec_sizes(load_spec(tmp_path / "mixed.yaml"))
    assert sizes.origins == {"z": "balanced", "v": "balanced", "u": "balanced", "y": "reference"}
    (tmp_path / "twice.yaml").write_text(text.replace("C: [[1, 0]]", "C: [[2, 0]]"), encoding="utf-8")
    assert spec_sizes(load_spec(tmp_path / "twice.yaml")).state == pytest.approx([0.5, 0.5], rel=1e-5)


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ("{vv: 1}", "system.sizes: 'vv' is no state, input or output; did you mean 'v'"),
        ("{z: 0}", "0 is not positive"),
        ("{z: -1}", "-1 is not positive"),
        ("{z: wide}", "wide"),
        ("[1, 2]", "system.sizes"),
    ],
)
def test_sizes_that_say_nothing_are_refused(tmp_path: Path, sizes: str, message: str) -> None:
    with pytest.raises(InvalidSpec) as refusal:
        cart(tmp_path, sizes=sizes)
    assert message in str(refusal.value)
    assert all(problem.place for problem in refusal.value.problems)


def test_default_gains_follow_brysons_rule(tmp_path: Path) -> None:
    spec = cart(tmp_path, sizes="{z: 0.1, v: 3/2, u: 20, y: 0.004}", damping="-1/3")
    design, sizes = designed(spec)
    plant = spec.problem.plant
    A, B, C = plant.A[0], plant.B, plant.C
    X = solve_continuous_are(A, B, np.diag([100, 1 / 1.5**2]), np.eye(1) / 400)
    np.testing.assert_allclose(design.K, -400 * B.T @ X, rtol=1e-4)
    speed = np.sqrt(np.mean(np.square([15, 1 / 3, 20 / 2 / 1.5])))  # of v / z, of the damping, of u / (2 v)
    assert sizes.speed == pytest.approx(speed, rel=0.01)
    X = solve_continuous_are(A.T, C.T, np.diag([0.01, 2.25]), np.eye(1) * (0.004 / sizes.speed) ** 2)
    np.testing.assert_allclose(design.L, -X @ C.T * (sizes.speed / 0.004) ** 2, rtol=1e-4)


def test_a_smaller_size_of_an_input_makes_a_smaller_gain(tmp_path: Path) -> None:
    gains = [designed(cart(tmp_path, sizes=f"{{z: 0.1, v: 1, u: {u}}}"))[0].K for u in (100, 10, 1)]
    assert all((np.abs(K) > np.abs(smaller)).all() for K, smaller in pairwise(gains))


def test_a_bound_on_a_gain_is_one_in_sizes(tmp_path: Path) -> None:
    spec = cart(tmp_path, sizes="{z: 1e-3, v: 0.5, u: 40, y: 1e-5}")
    plant, sizes = spec.problem.plant, spec_sizes(spec)
    K, _ = gain(Task.of(plant, CONTROLLER, sizes=sizes), Fastest(bound=2.0))
    assert 1.9 < np.hypot(K[0, 0] * 1e-3, K[0, 1] * 0.5) / 40 <= 2.0
    L, _ = gain(Task.of(plant, OBSERVER, sizes=sizes), AtLeast(rate=0.3, bound=3.0))
    assert np.hypot(L[0, 0] / 1e-3, L[0, 1] / 0.5) * 1e-5 <= 3.0


def test_what_check_prints_is_taken_as_it_stands(tmp_path: Path) -> None:
    spec = cart(tmp_path, reference="output: 0.2*sin(3*t)", more="actuator: {limits: {u: [-50, 50]}}")
    first, sizes = designed(spec)
    screen = StringIO()
    print_plant(Console(file=screen, width=60), spec.name, applicability(spec.problem.plant), "", sizes)
    found = re.search(r"sizes: (\{[^}]*\})", screen.getvalue())
    assert found
    again, other = designed(cart(tmp_path, sizes=" ".join(found[1].split()), reference="setpoint: {y: 7}"))
    np.testing.assert_allclose(again.K, first.K, rtol=2e-3)
    np.testing.assert_allclose(again.L, first.L, rtol=2e-3)
    assert set(other.origins.values()) == {"given"}


def test_a_plant_without_a_speed_of_its_own_takes_that_of_its_run(tmp_path: Path) -> None:
    """Nothing in z'' = u / 2 says what is fast: 10 s does."""
    design, sizes = designed(cart(tmp_path))
    assert sizes.speed == pytest.approx(20 / 10)
    assert design.controller.rate == pytest.approx(2 * np.sqrt(3) / 2, rel=0.01)


def test_numbers_that_are_nearly_zero_change_little() -> None:
    A, B = np.array([[[0.0, 1.0], [-4.0, -0.4]]]), np.array([[0.0], [1.0]])
    exact, rounded = Sizes.balanced(A, B), Sizes.balanced(A + 1e-16, B + 1e-16)
    for one, other in ((exact.state, rounded.state), (exact.input, rounded.input)):
        assert np.log(other / one) == pytest.approx(0.0, abs=0.4)


@pytest.mark.parametrize("n", [1, 3, 30])
def test_sizes_of_any_plant_are_those_of_the_plant_in_other_units(n: int) -> None:
    random = np.random.default_rng(n)
    A, B, C = random.normal(size=(2, n, n)), random.normal(size=(n, 2)), random.normal(size=(1, n))
    A[:, random.random((n, n)) < 0.7] = 0.0
    x, u, y, t = (10.0 ** random.uniform(-8, 8, size=k) for k in (n, 2, 1, 1))
    one = Sizes.balanced(A, B, C)
    other = Sizes.balanced(A * x / x[:, None] * t, B * u / x[:, None] * t, C * x / y[:, None], tempo=float(t[0]))
    assert other.speed / one.speed / t == pytest.approx(1.0, rel=1e-9)
    for K in (np.ones((2, n)), random.normal(size=(2, n))):
        np.testing.assert_allclose(other.gain(K / u[:, None] * x), one.gain(K), rtol=1e-9)


@pytest.mark.parametrize("estimate", ["", "design: {estimate: input}"])
def test_a_bound_of_a_single_state_is_in_its_unit_whatever_its_size(tmp_path: Path, estimate: str) -> None:
    bounds = []
    for size in ("1", "100"):
        path = tmp_path / "tank.yaml"
        path.write_text(TANK.replace("SIZE", size).replace("DESIGN", estimate), encoding="utf-8")
        spec = load_spec(path)
        gains = design(spec)
        bounds.append(gains.guarantees.observer_error(np.zeros(1), np.ones(1))[0])
    assert min(bounds) >= 1.0


@pytest.mark.parametrize("smooth", ["0.09", "1e-2", "1e-5"])
def test_how_sharp_a_step_is_says_nothing_of_what_speed_matters(tmp_path: Path, smooth: str) -> None:
    """A corner of 0.01 ms would make the speed 2·10⁵ m/s, and its size with it."""
    path = tmp_path / "step.yaml"
    path.write_text(
        f"""
name: step
system:
  states: [z, v]
  inputs: [u]
  outputs: [y]
  A: [[0, 1], [-1, -2]]
  B: [[0], [1]]
  C: [[1, 0]]
reference: {{output: {{step: {{size: 1, at: 1, smooth: {smooth}}}}}}}
simulation: {{duration: 2, sample_time: 0.01}}
"""
    )
    sizes = spec_sizes(load_spec(path))
    assert sizes.by_name["y"] == pytest.approx(0.5)
    assert (sizes.origins["y"], sizes.origins["v"]) == ("reference", "balanced")
    assert sizes.by_name["v"] < 5
    slow = path.read_text().replace(f"smooth: {smooth}", "smooth: 0.6")
    path.write_text(slow)
    sizes = spec_sizes(load_spec(path))
    assert sizes.origins["v"] == "reference"
    assert sizes.by_name["v"] == pytest.approx(1.875, rel=1e-3)
