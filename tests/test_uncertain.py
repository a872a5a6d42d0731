"""Uncertain parameters: the corners speak for the box, and the bounds hold for every plant in it."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from itertools import product
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from pwatrack import design, load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix
from pwatrack.claims.robust import Robust
from pwatrack.commands.run import run
from pwatrack.commands.verify import verify
from pwatrack.errors import CheckFailed, ExitCode, PwatrackError
from pwatrack.lmi.audit.certificate import audit
from pwatrack.rational import fraction_of
from pwatrack.report.certificate import design_certificate
from pwatrack.report.files import write_result
from pwatrack.report.parameters import box_figures, run_rows
from pwatrack.spec.box import corners
from pwatrack.workflow.bands import covered
from pwatrack.workflow.tracking import check_reference
from tests.boxes import judge
from tests.promises import with_claim

SPRING = """
name: mass on a spring
parameters: {{m: 2, k: 3, d: 1, e: 0, c: 0.1, j: d/2}}
system:
  states: [z, v]
  inputs: [u]
  outputs: [y]
  A: [[0, 1], [{stiff}, -d/m]]
  B: [[0], [{push}]]
  C: [[{seen}, 0]]
  nonlinearities:
    - {{name: stop, kind: spring, of: z, start: {start}, slope: 2*k, into: {{v: -1/m}}}}
design: {{uncertain: {{{box}}}}}
reference: {{output: 0.1*sin(t)}}
simulation: {{duration: 30, sample_time: 0.05{conditions}}}
"""
PLAIN = {"stiff": "-k/m", "push": "1/m", "seen": "1", "start": "0.05", "box": "m: 5%", "conditions": ""}


def spring(folder: Path, **changes: str) -> Path:
    path = folder / "spring.yaml"
    path.write_text(SPRING.format(**PLAIN | changes))
    return path


def backlash(specs: Path, folder: Path, share: str, conditions: str = "") -> Path:
    text = (specs / "two_mass_backlash.yaml").read_text(encoding="utf-8")
    text = text.replace("k3: 0.4 ", "k3: k2 ").replace("\nsimulation:\n", f"\nsimulation:\n{conditions}")
    box = ", ".join(f"{name}: {share}" for name in ("k1", "k2", "d1", "d2"))
    path = folder / "backlash.yaml"
    path.write_text(text.replace("  tracking: output\n", f"  tracking: output\n  uncertain: {{{box}}}\n"))
    return path


def exactly(matrices: Any) -> list[Fraction]:
    """Return all entries of A, b and B."""
    every: list[BallMatrix] = [*matrices.A, *matrices.b, matrices.B]
    return [fraction_of(v) for X in every for v in X.centre.entries()]


@pytest.mark.parametrize(
    ("box", "inverse"), [("m: [1.5, 3], k: 10%, d: [0.5, 1]", {"m"}), ("k: [-1, 4], d: 100%", set[str]())]
)
def test_plants_of_the_box_are_means_of_the_corners(tmp_path: Path, box: str, inverse: set[str]) -> None:
    path = spring(tmp_path, box=box, stiff="-(k + 2*d*k)/m + j*k/m")
    spec, rng = load_spec(path), np.random.default_rng(3)
    problem, intervals = spec.problem, spec.objectives.uncertain
    found = [exactly(X) for X in corners(problem.parametric, problem.plant, intervals)]
    for _ in range(5):
        point, shares = {}, []
        for interval in intervals:
            low, high = interval.low.centre, interval.high.centre
            value = low + (high - low) * Fraction(int(rng.integers(1, 1000)), 1000)
            point[interval.name] = str(value)
            q: Callable[[Fraction], Fraction] = (lambda v: 1 / v) if interval.name in inverse else (lambda v: v)
            shares.append((q(value) - q(low)) / (q(high) - q(low)))
        weights = [
            prod([s if end else 1 - s for s, end in zip(shares, ends, strict=True)])
            for ends in product((0, 1), repeat=len(shares))
        ]
        assert all(w >= 0 for w in weights)
        mean = [sum(w * v for w, v in zip(weights, entry, strict=True)) for entry in zip(*found, strict=True)]
        there = load_spec(path, point)
        assert exactly(there.problem.plant.exact) == mean


@pytest.mark.parametrize(
    ("changes", "code", "said"),
    [
        ({"stiff": "-k/m - m"}, 3, "not affine in a power of 'm'"),
        ({"box": "k: 5%", "stiff": "-k**2/m"}, 3, "not affine in a power of 'k'"),
        ({"box": "d: 5%", "stiff": "-j*d"}, 3, "not affine in a power of 'd'"),
        ({"box": "k: 5%", "stiff": "-sqrt(k)"}, 3, "no sum of products"),
        ({"box": "m: 5%", "push": "1/(m + 1)"}, 3, "no sum of products"),
        ({"box": "c: 5%", "start": "c"}, 3, "hyperplanes are to be known"),
        ({"box": "m: 5%", "seen": "m"}, 3, "what is measured and tracked is to be known"),
        ({"box": "m: [-1, 3]"}, 3, "contains 0"),
        ({"box": "c: 5%"}, 2, "in no matrix"),
        ({"box": "e: 5%"}, 2, "a share of a value that is 0"),
        ({"box": "m: [3, 4]"}, 2, "the value of the design, 2, is not in it"),
        ({"box": "mass: 5%"}, 2, "'mass' is no parameter"),
        ({"box": "m: 5"}, 2, "a share such as 5%"),
        ({"box": "m: [3, 1]"}, 2, "not below"),
        ({"box": "m: -5%"}, 2, "no positive share"),
        ({"box": "k: [-400, 9]"}, 5, "no common P was found"),
    ],
)
def test_what_the_corners_do_not_speak_for_is_refused(
    tmp_path: Path, changes: dict[str, str], code: int, said: str
) -> None:
    path = spring(tmp_path, **changes)
    for refuses in (check_reference, design) if code != ExitCode.UNDECIDED else (design,):  # before a solver is asked
        with pytest.raises(PwatrackError, match=said) as refused:
            refuses(load_spec(path))
        assert refused.value.code == code
        assert refused.value.problems[0].place is not None


BEND = """
name: one element
parameters: {{k: 1, m: 2, q: k*m}}
system:
  states: [x, z]
  inputs: [u]
  outputs: [y]
  A: [[{own}, 0], [0, -1]]
  B: [[1], [0]]
  C: [[1, 0]]
  nonlinearities: [{{name: bend, of: x, {shape}, into: {{{into}}}}}]
design: {{tracking: state, uncertain: {{{box}}}, controller: {{K: [[-0.1, 0]]}}, observer: {{L: [[-0.1], [0]]}}}}
reference: {{setpoint: {{y: 0}}}}
simulation: {{duration: 1, sample_time: 0.1}}
"""
FREE = "kind: piecewise_linear, breakpoints: [0.5]"


@pytest.mark.parametrize(
    ("own", "shape", "into", "one", "two"),
    [
        (
            "-15",
            f"{FREE}, slopes: [-k, 10]",
            "x: k",
            r"k\*\*2 in .*into.x = 'k' times .*slopes\[1\] = '-k'",
            r"as k in .*= 10",
        ),
        ("-1", f"{FREE}, slopes: [k, 2*k], value: 3", "x: -k", r"as k\*\*2 in .*slopes", r"as k in .*value = 3"),
        (
            "-5 - 1/k",
            f"{FREE}, slopes: [k, 1.1*k]",
            "x: -1, z: 1/k",
            r"as k in .*into.x = -1 times",
            r"1/k in system.A\[1\]\[1\]",
        ),
        (
            "-5 - 1/k",
            "kind: saturation, lower: -1, upper: 1, slope: 2*k",
            "x: -1/k, z: 1/m",
            "as k in .*into.z",
            "as 1/k in",
        ),
        ("-5 - k", "kind: saturation, lower: -1, upper: 1, slope: q", "x: -k", r"k\*\*2 in", "not affine"),
        ("-5 - k", "kind: spring", "x: -k**2", r"as k\*\*2 in .*into.x = '-k\*\*2' ", "as k in"),
        (
            "-5 - k",
            "kind: dead_zone, lower: 0, upper: 1, slope: k, lower_slope: 2",
            "x: -k",
            "lower_slope = 2|A",
            "not affine",
        ),
    ],
)
def test_a_power_is_seen_through_all_factors(
    tmp_path: Path, own: str, shape: str, into: str, one: str, two: str
) -> None:
    path = tmp_path / "bend.yaml"
    path.write_text(BEND.format(own=own, shape=shape, into=into, box="k: [0.5, 2]"))
    spec = load_spec(path)
    for said in (one, two):
        with pytest.raises(PwatrackError, match=said) as refused:
            corners(spec.problem.parametric, spec.problem.plant, spec.objectives.uncertain)
        assert refused.value.code == ExitCode.OUTSIDE_THEORY


@pytest.mark.parametrize(
    ("own", "shape", "into", "box"),
    [
        ("-15", f"{FREE}, slopes: [1, 10]", "x: k", "k: [0.5, 2]"),
        ("-15", f"{FREE}, slopes: [-k, 10], value: 2", "x: m, z: k*m", "m: 10%"),
        ("-15 + m", f"{FREE}, slopes: [m, 2*m]", "x: -1/m, z: k", "m: 10%, k: 10%"),
        ("-15 - k - k**2", "kind: saturation, lower: -1, upper: 1, slope: -k", "x: m/k, z: 1", "m: 10%"),
        ("-15 + k**2", f"{FREE}, slopes: [-k, -k]", "x: k, z: 1", "k: 10%"),
        ("-15", f"{FREE}, slopes: [q/k, 3]", "x: -1", "m: 10%"),
        (
            "-15",
            "kind: dead_zone, lower: 0, upper: 1, slope: 1/k, lower_slope: 2/k, upper_slope: 1",
            "x: 3*k",
            "k: 10%",
        ),
    ],
)
def test_what_cancels_is_no_power(tmp_path: Path, own: str, shape: str, into: str, box: str) -> None:
    path = tmp_path / "bend.yaml"
    path.write_text(BEND.format(own=own, shape=shape, into=into, box=box))
    spec = load_spec(path)
    assert corners(spec.problem.parametric, spec.problem.plant, spec.objectives.uncertain)


@pytest.mark.parametrize("seed", [*range(76, 86), 100, 200, 300, 400])
def test_nothing_false_is_said_of_a_box_with_parameters_everywhere(seed: int) -> None:
    """Against a field that is read without the package: at corners, inside, and with parameters that change."""
    found = judge(seed)
    if found.kind == "proved":
        assert found.outside < 1e-9
        assert found.part <= 1
        assert found.real < 1e-4


SHORT = """
name: what no sample sees
parameters: {{m: 2, d: 8}}
system:
  states: [z, v]
  inputs: [F]
  outputs: [y]
  A: [[0, 1], [0, -d/2]]
  B: [[0], [1/m]]
  C: [[1, 0]]
design: {{uncertain: {{{box}}}}}
reference: {{output: {reference}}}
simulation:
  duration: {duration}
  sample_time: {step}
  initial: {{plant: [{start}, 0], observer: [{start}, 0]}}
  plant: {{parameters: {{{other}}}}}
"""


@pytest.mark.slow
def test_of_a_w_that_took_too_long_to_enclose_nothing_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "short.yaml"
    changes = {"box": "d: 10%", "reference": '"0.15*cos(2*pi*t)"', "duration": 20.25, "step": 0.5, "start": 0.15}
    path.write_text(SHORT.format(**changes, other="d: 8.8"))
    monkeypatch.setattr("pwatrack.simulation.enclosure.MOST_NUMBERS", 3)
    result = simulate(load_spec(path))
    assert result.w is None
    assert list(run_rows(result)) == [
        "how large w is along the x_d of this run took too long to enclose: of this run nothing is said"
    ]
    assert not result.bands
    write_result(result, tmp_path / "out")
    assert "along_x_d" not in json.loads((tmp_path / "out" / "run.json").read_text(encoding="utf-8"))["uncertain"]


@pytest.mark.parametrize(
    ("other", "more", "said"),
    [
        ("d: 8.8", "", "the plant of this run is one of them; in the end"),
        (
            "d: 8.8",
            "  noise: {std: {y: 0.0001}, sample_time: 0.05, seed: 1}",
            "one of them, its loop is not the ideal one; of the ideal loop, in",
        ),
        ("d: 9.8", "", "this run is not one of them; of the ideal loop, in the end"),
        ("m: 2.1", "", "this run is not one of them; of the ideal loop, in the end"),
    ],
)
def test_it_is_said_whether_plant_and_loop_are_those_of_the_bounds(
    tmp_path: Path, other: str, more: str, said: str
) -> None:
    path = tmp_path / "short.yaml"
    changes = {"box": "d: 10%", "reference": '"0.15*cos(2*pi*t)"', "duration": 2, "step": 0.05, "start": 0.15}
    path.write_text(SHORT.format(**changes, other=other) + more + "\n")
    [row] = run_rows(simulate(load_spec(path)))
    assert said in row


def test_w_is_enclosed_where_every_sample_misses_it(tmp_path: Path) -> None:
    """A sinusoid of 1 Hz whose velocity is 0 at each sample, twice a second: |w| ≤ 0.8/2 |v_d| everywhere else."""
    path = tmp_path / "short.yaml"
    changes = {"box": "d: 10%", "reference": '"0.15*cos(2*pi*t)"', "duration": 20.25, "step": 0.5, "start": 0.15}
    path.write_text(SHORT.format(**changes, other="d: 8.8"))
    result = simulate(load_spec(path))
    assert result.outcome.code == 0
    assert result.w is not None
    assert result.w[:, 1] == pytest.approx(np.full(10, 0.4 * 0.15 * 2 * np.pi), rel=2e-6)
    assert (result.w[:, 1] >= 0.4 * 0.15 * 2 * np.pi * (1 - 1e-12)).all()
    assert not result.w[:, 0].any()
    [said] = run_rows(result)
    assert "no larger than in this run from t = 18 s on" in said


def test_w_of_a_step_between_two_samples_counts_while_it_lasts(tmp_path: Path) -> None:
    path = tmp_path / "short.yaml"
    changes = {"box": "m: 10%", "reference": "{step: {size: 1, at: 1.005, smooth: 0.004}}", "duration": 5, "step": 0.01}
    path.write_text(SHORT.format(**changes, start=0, other="m: 2.2"))
    result = simulate(load_spec(path))
    assert result.outcome.code == 0
    assert result.w is not None
    y_d, t = result.controller.trajectory.exosystem, np.linspace(1, 1.01, 1001)
    u_ff = [2 * float(y_d(s, derivative=2)[0]) + 8 * float(y_d(s, derivative=1)[0]) for s in t]
    worst = (1 / 1.8 - 1 / 2) * np.abs(u_ff).max()
    assert worst * (1 - 1e-9) <= result.w[:, 1].max() <= worst * (1 + 5e-3)  # between two of 1001 times
    assert np.argmax(result.w[:, 1]) == 2  # 1 s to 1.5 s
    assert result.w[3:, 1].max() < 1e-9 * worst
    [said] = run_rows(result)
    assert ", not yet" in said
    assert result.bands["output", 0][-1] > np.abs(result.response.tracking_error).max()


def test_a_run_whose_other_parameters_follow_is_not_one_of_the_box(tmp_path: Path) -> None:
    changes = {"box": "d: 5%, j: 1%", "stiff": "-(k + j)/m"}
    for other, one_of_them in (("d: 1.04", False), ("d: 1.04, j: 0.5", True)):
        spec = load_spec(spring(tmp_path, **changes, conditions=f", plant: {{parameters: {{{other}}}}}"))
        assert covered(spec.objectives.uncertain, spec.scenario.conditions) == one_of_them


def test_a_box_with_too_many_corners_is_undecided_before_anything_is_solved(tmp_path: Path) -> None:
    names = [f"p{k}" for k in range(13)]
    text = SPRING.format(**PLAIN | {"stiff": "-(" + "+".join(names) + ")", "box": ", ".join(f"{p}: 5%" for p in names)})
    path = tmp_path / "many.yaml"
    path.write_text(text.replace("parameters: {", "parameters: {" + "".join(f"{p}: 1, " for p in names)))
    with pytest.raises(PwatrackError, match=r"2\^13 corners") as refused:
        design(load_spec(path))
    assert refused.value.code == ExitCode.UNDECIDED


@pytest.mark.slow
def test_the_papers_example_is_proved_to_nine_percent_and_not_to_ten(specs: Path, tmp_path: Path) -> None:
    robust = design(load_spec(backlash(specs, tmp_path, "5%"))).claim(Robust)
    assert robust.count == (16 + 8) * 2  # corners of the cells with a spring, which are alike, and of the gap
    assert [bounds.channel[1] for bounds in robust.bounds] == [1, 3]
    assert design(load_spec(backlash(specs, tmp_path, "9.3%"))).claims_of(Robust)
    with pytest.raises(PwatrackError, match="no common P") as refused:
        design(load_spec(backlash(specs, tmp_path, "10%")))
    assert refused.value.code == ExitCode.UNDECIDED


def peak_gain(F: Array, g: Array, c: Array) -> float:
    """Return ∫|c e^{Ft} g| dt from below, by a sum over a fine grid."""
    step = 0.02 / float(np.abs(np.linalg.eigvals(F)).max())
    end = 12 / -float(np.linalg.eigvals(F).real.max())
    E, z, total = expm(F * step), g, 0.0
    for _ in range(int(end / step)):
        after = E @ z
        total += step * min(abs(float(c @ z)), abs(float(c @ after)))
        z = after
    return total


ONE_CELL = """
name: one cell
parameters: {{{parameters}}}
system:
  states: [a, b, c]
  inputs: [u]
  outputs: [y]
  A: [[-1, p0, 0.3], [0.5*p1, -0.4, 1], [p0*p1, 0.2, -2]]
  B: [[0], [{gain}], [1]]
  C: [[1, 0, 0.5]]
design: {{tracking: state, uncertain: {{{box}}}}}
reference: {{setpoint: {{y: 1}}}}
simulation: {{duration: 1, sample_time: 0.1}}
"""


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_no_plant_of_the_box_has_a_peak_gain_above_its_bound(tmp_path: Path, seed: int) -> None:
    """Of (x, x̂)' in one cell, where w acts on x alone: no common P, no ellipsoid and no error coordinates."""
    rng, path = np.random.default_rng(seed), tmp_path / "one.yaml"
    nominal = {"p0": rng.uniform(0.3, 1), "p1": rng.uniform(-1, 1), "p2": rng.uniform(0.5, 1.5)}
    parameters = ", ".join(f"{name}: {value:.3f}" for name, value in nominal.items())
    path.write_text(ONE_CELL.format(parameters=parameters, gain="1/p2", box="p0: 8%, p1: 8%, p2: 8%"))
    spec = load_spec(path)
    controller = design(spec)
    K, L, known, robust = controller.design.K, controller.design.L, controller.plant, controller.claim(Robust)
    assert robust is not None
    ratios = []
    for bounds in robust.bounds:
        g, worst = np.eye(6)[bounds.channel[1]], dict.fromkeys(bounds.sizes, 0.0)
        ends = product(*((float(i.low), float(i.high)) for i in spec.objectives.uncertain))
        inner = [[float(rng.uniform(float(i.low), float(i.high))) for i in spec.objectives.uncertain] for _ in range(3)]
        for values in [*ends, *inner]:
            plant = load_spec(path, dict(zip(nominal, map(repr, values), strict=True))).problem.plant
            A_hat = known.A[0] + known.B @ K + L @ known.C
            F = np.block([[plant.A[0], plant.B @ K], [-L @ known.C, A_hat]])
            for kind, k in worst:
                c = np.hstack([np.eye(3)[k], np.zeros(3)]) if kind == "state" else np.hstack([np.zeros(3), K[k]])
                worst[kind, k] = max(worst[kind, k], peak_gain(F, g, c))
        assert all(worst[signal] <= size for signal, size in bounds.sizes.items())
        ratios += [size / worst[signal] for signal, size in bounds.sizes.items()]
    assert np.median(ratios) < 3


@pytest.mark.slow
@pytest.mark.parametrize("values", [(1, 1, 1, 1), (-1, -1, -1, -1), (1, -1, -1, 1), (0.3, 0.9, -0.7, -0.2)])
def test_simulated_errors_stay_below_what_is_proved_for_the_box(
    specs: Path, tmp_path: Path, values: tuple[float, ...]
) -> None:
    nominal = {"k1": 1, "k2": 0.4, "d1": 0.2, "d2": 0.1}
    moved = ", ".join(f"{p}: {v * (1 + 0.05 * s):.9g}" for (p, v), s in zip(nominal.items(), values, strict=True))
    path = backlash(specs, tmp_path, "5%", f"  plant: {{parameters: {{{moved}}}}}\n")
    result = simulate(load_spec(path, {}))
    assert covered(result.spec.objectives.uncertain, result.loop.conditions)
    assert result.controller.claims_of(Robust)
    along = box_figures(result, result.controller.claim(Robust))
    assert set(along) == {"y - y_d", "u - u_ff"}
    late = result.response.t > 54
    seen = np.abs(result.response.y - result.response.y_d)[late].max()
    assert along["y - y_d"]["seen"] == pytest.approx(seen, rel=1e-2)
    assert 0 < along["y - y_d"]["seen"] <= along["y - y_d"]["bound"]
    assert 0 < along["u - u_ff"]["seen"] <= along["u - u_ff"]["bound"]


def test_deviation_is_that_of_the_worst_plant_of_the_box(tmp_path: Path) -> None:
    spec = load_spec(spring(tmp_path, box="m: 5%, k: 5%"))
    controller, rng = design(spec), np.random.default_rng(1)
    assert controller.claims_of(Robust)
    x_d, u_ff = rng.normal(size=(7, 2)), rng.normal(size=(7, 1))
    D, cells = controller.claim(Robust).differences, [controller.plant.partition.locate(x) for x in x_d]
    deviations = [D.A[:, i] @ x + D.b[:, i] + D.B @ u for i, x, u in zip(cells, x_d, u_ff, strict=True)]
    found, reached = np.zeros(2), 0.0
    np.maximum.at(found, D.of, np.abs(deviations).max(axis=0))
    for m, k in product(np.linspace(1.9, 2.1, 5), np.linspace(2.85, 3.15, 5)):
        plant = load_spec(spec.path, {"m": repr(float(m)), "k": repr(float(k))}).problem.plant
        for x, u in zip(x_d, u_ff, strict=True):
            w = plant.field(x, u) - controller.plant.field(x, u)
            assert w[0] == pytest.approx(0, abs=1e-15)
            assert abs(w[1]) <= found[1] * (1 + 1e-12)
            reached = max(reached, abs(w[1]))
    assert reached == pytest.approx(found[1])
    assert found[0] == 0


def test_a_run_of_the_box_is_held_to_what_is_proved_for_the_box(tmp_path: Path) -> None:
    spec = load_spec(spring(tmp_path, box="m: 5%, k: 5%", conditions=", plant: {parameters: {m: 2.05}}"))
    result = simulate(spec)
    robust = result.controller.claim(Robust)
    assert result.outcome.code == 0
    assert robust is not None
    smaller = tuple(
        replace(
            bounds,
            sizes={signal: 1e-3 * size for signal, size in bounds.sizes.items()},
            parts=tuple(
                replace(part, ellipsoid=replace(part.ellipsoid, sizes=tuple(1e-3 * v for v in part.ellipsoid.sizes)))
                for part in bounds.parts
            ),
        )
        for bounds in robust.bounds
    )
    again = simulate(spec, with_claim(result.controller, replace(robust, bounds=smaller)))
    assert again.outcome.kind == "above its bound"
    assert again.outcome.text.startswith("above its own proved bound: |y − y_d| is ")


def drop_a_corner(box: Any) -> None:
    box["corners"].pop()


def stiffer_corner(box: Any) -> None:
    box["corners"][0]["B"][1][0] = "0.4"


def no_bounds(box: Any) -> None:
    box["bounds"].clear()


def smaller_bound(box: Any) -> None:
    box["bounds"][0]["signals"][0][2] = "1e-6"


def smaller_ellipsoid(box: Any) -> None:
    Q = box["bounds"][0]["parts"][0]["Q"]
    Q["exponents"] = [e - 3 for e in Q["exponents"]]


def jumping_corner(box: Any) -> None:
    box["corners"][0]["b"][0][1][0] = "0.1"


def wider_interval(box: Any) -> None:
    box["parameters"][0][2] = "9"


@pytest.fixture(scope="module")
def boxed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of a box, whose certificate is whole."""
    folder = tmp_path_factory.mktemp("boxed")
    path = spring(folder, box="m: 5%, k: 5%")
    run = write_result(simulate(load_spec(path)), folder / "run", plots="none")
    assert any("uncertain parameters: m, k" in sentence for sentence in verify(run))
    return run


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "alone"),
    [
        (drop_a_corner, False),
        (wider_interval, False),
        (stiffer_corner, True),
        (no_bounds, True),
        (smaller_bound, True),
        (smaller_ellipsoid, True),
        (jumping_corner, True),
    ],
)
def test_a_certificate_that_was_changed_is_found_out(
    boxed: Path, tmp_path: Path, change: Callable[[Any], None], alone: bool
) -> None:
    folder = tmp_path / "run"
    shutil.copytree(boxed, folder)
    file = folder / "certificate.json"
    content = json.loads(file.read_text())
    change(content["uncertain"])
    file.write_text(json.dumps(content))
    _, faults = audit(file.read_text())
    assert bool(faults) == alone
    with pytest.raises(CheckFailed):
        verify(folder)


def test_a_corner_that_is_listed_twice_is_one_corner(tmp_path: Path) -> None:
    spec = load_spec(spring(tmp_path, box="m: 5%, k: 5%"))
    content = design_certificate(spec, design(spec))
    claims, faults = audit(json.dumps(content))
    assert not faults
    content["uncertain"]["corners"].append(content["uncertain"]["corners"][0])
    assert audit(json.dumps(content)) == (claims, [])
    assert any(claim.endswith("for 4 corners") for claim in claims)


CHAIN = """
name: chain
parameters: {p: 2, q: 3}
system:
  states: [x1, x2, x3]
  inputs: [u]
  outputs: [y]
  A: [[-1, 1, 0], [0, -p, 1], [0, 0, -q]]
  B: [[0], [0], [1]]
  C: [[1, 0, 0]]
design: {uncertain: {p: 10%, q: 10%}}
reference: {output: "sin(t)"}
simulation: {duration: 2, sample_time: 0.1}
"""


@pytest.mark.parametrize("rows", [[0, 1], [0, 1, 2], [2, 1], [1]])
def test_the_entries_of_w_that_are_bounded_are_those_that_vary(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rows: list[int]
) -> None:
    """Here {1, 2} vary: genuine bounds of {0, 1}, as many, say nothing."""
    (tmp_path / "chain.yaml").write_text(CHAIN)
    spec = load_spec(tmp_path / "chain.yaml")
    monkeypatch.setattr("pwatrack.claims.robust.varying_rows", lambda *_: rows)
    content = json.dumps(design_certificate(spec, design(spec)))
    assert audit(content)[1] == [
        "the bounds of uncertain parameters are not those of the entries of w that vary, each once"
    ]


@pytest.mark.slow
def test_a_proof_for_no_box_does_not_belong_to_a_spec_with_one(tmp_path: Path) -> None:
    folder = write_result(simulate(load_spec(spring(tmp_path))), tmp_path / "run")
    content = json.loads((folder / "certificate.json").read_text())
    content["uncertain"] = None
    (folder / "certificate.json").write_text(json.dumps(content))
    with pytest.raises(CheckFailed, match="uncertain parameters are not those"):
        verify(folder)


def test_estimated_loads_beside_uncertain_parameters_are_refused(tmp_path: Path) -> None:
    path = spring(tmp_path)
    path.write_text(path.read_text().replace("design: {", "design: {estimate: input, "))
    with pytest.raises(PwatrackError, match="without estimates") as refused:
        design(load_spec(path))
    assert refused.value.code == ExitCode.OUTSIDE_THEORY


@pytest.mark.slow
def test_the_largest_box_is_found_with_its_proof(specs: Path, tmp_path: Path) -> None:
    path = backlash(specs, tmp_path, "5%")
    run(path, tmp_path / "run", [], None, simulated=False, scaled=True)
    largest = json.loads((tmp_path / "run" / "run.json").read_text())["largest_box"]
    assert 1 < largest["factor"] < largest["beyond"] <= 1.011 * largest["factor"]
    assert largest["parameters"]["k1"] == pytest.approx([1 - 0.05 * largest["factor"], 1 + 0.05 * largest["factor"]])
    assert verify(tmp_path / "run")
    assert design(load_spec(backlash(specs, tmp_path, f"{5 * largest['factor']:.9g}%"))).claims_of(Robust)
    with pytest.raises(PwatrackError, match="no common P"):
        design(load_spec(backlash(specs, tmp_path, f"{5 * largest['beyond']:.9g}%")))


@pytest.mark.slow
def test_a_box_that_is_too_large_is_undecided_and_says_which_is_not(specs: Path, tmp_path: Path) -> None:
    path = backlash(specs, tmp_path, "20%")
    with pytest.raises(PwatrackError, match=r"undecided; proved for the box scaled by 0\.[3-5]") as refused:
        run(path, tmp_path / "run", [], None, simulated=False, scaled=True)
    assert refused.value.code == ExitCode.UNDECIDED


def test_without_uncertain_parameters_no_box_is_scaled(specs: Path, tmp_path: Path) -> None:
    with pytest.raises(PwatrackError, match="no parameter is uncertain") as refused:
        run(specs / "two_mass_backlash.yaml", tmp_path / "run", [], None, simulated=False, scaled=True)
    assert refused.value.code == ExitCode.INVALID


BETWEEN = """
name: A stop of two stiffnesses beside uncertain mass, with limits
parameters: {m: 2, d: 1, k: 20, c: 3}
system:
  states: [z, v]
  inputs: [u]
  outputs: [y]
  A: [[0, 1], [-c/m, -d/m]]
  B: [[0], [1/m]]
  C: [[1, 0]]
  nonlinearities:
    - {name: s, kind: stop, of: z, lower: -0.05, upper: 0.1, lower_slope: k, upper_slope: 2*k, into: {v: -1/m}}
design: {uncertain: {m: 3%}}
reference: {output: {step: {size: 0.2, at: 1, smooth: 1}}}
simulation: {duration: 8, sample_time: 0.01, initial: {plant: steady}, actuator: {limits: {u: [-30, 20]}}}
"""


def test_a_polynomial_region_of_cells_with_one_between_two_others_is_audited(tmp_path: Path) -> None:
    """The cells are listed for the box, and the region is of those that have the others in their hull."""
    path = tmp_path / "plant.yaml"
    path.write_text(BETWEEN, encoding="utf-8")
    spec = load_spec(path)
    content = design_certificate(spec, design(spec))
    assert any("V" in region for region in content["regions"])
    assert audit(json.dumps(content))[1] == []
