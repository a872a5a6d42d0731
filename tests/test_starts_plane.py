"""Members that start in a plane of two states, beside the regions that are proved there."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.path import Path as Outline

from pwatrack import Result, ensemble, load_spec, simulate
from pwatrack.claims.region import LimitedRegion
from pwatrack.errors import ExitCode, InvalidSpec
from pwatrack.lmi.ellipsoid import StartEllipsoid
from pwatrack.lmi.polynomial_region import PolynomialRegion
from pwatrack.rational import floats
from pwatrack.report.plots.signals import control_input
from pwatrack.report.plots.spread import starts_in_plane
from pwatrack.workflow.variation import EnsembleResult, sections
from tests.test_cli import call, index_of, refused
from tests.test_drawing import points, written

BAR = """
name: Balanced bar on a buffer
system:
  states: [z, v, f]
  inputs: [F]
  outputs: [y]
  units: {z: m, v: m/s, f: N, F: N, y: m}
  A: [[0, 1, 0], [1, 0, 1], [0, 0, -20]]
  nonlinearities:
    - {name: buffer, kind: spring, of: z, start: 0.4, slope: 0.5, into: {v: -1}}
  B: [[0], [0], [20]]
  C: [[1, 0, 0]]
reference: {output: {constant: 0.05}}
simulation:
  duration: 15
  sample_time: 0.05
  initial: {plant: [0.2, 0, 0], observer: measured}
  actuator: {limits: {F: [-1, 1]}}
"""


@pytest.fixture(scope="module")
def bar(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bar") / "bar.yaml"
    path.write_text(BAR, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def result(bar: Path) -> Result:
    return simulate(load_spec(bar))


@pytest.fixture(scope="module")
def many(result: Result) -> EnsembleResult:
    return ensemble(result, 300, over="plane")


@pytest.mark.slow
def test_members_differ_in_two_states_from_the_reference_with_the_observer_on_them(many: EnsembleResult) -> None:
    loop, x_d = many.nominal.loop, many.nominal.response.x_d[0]
    for number in (0, 7):
        z0 = many.variation.member(number).z0
        x = z0[loop.at.x]
        assert (z0[loop.at.x_hat] == x).all()
        assert x[2] == x_d[2]
        assert x[:2].tolist() == [many.variation.values[name][number] for name in ("z", "v")]


def test_from_inside_what_is_proved_every_member_gets_small_and_not_from_everywhere(many: EnsembleResult) -> None:
    off = np.column_stack([many.variation.values[name] for name in ("z", "v")]) - many.nominal.response.x_d[0, :2]
    small = np.array(many.small)
    assert (small >= [one.code == ExitCode.DONE and one.kind != "off" for one in many.outcomes]).all()
    found = dict(sections(many.nominal.controller, many.nominal.loop.conditions, [0, 1]))
    assert list(found) == ["start forgotten, limits reached or not", "no limit is reached"]
    inside = Outline(found["start forgotten, limits reached or not"]).contains_points(off)
    assert inside.sum() > 20
    assert small[inside].all()
    assert not small.all()
    never = Outline(found["no limit is reached"]).contains_points(off)
    most = np.array([figures.largest_input["F"] for figures in many.figures])
    assert never.any()
    assert most[never].max() <= 1
    assert not many.failed, "that some do not is what is to be seen"


def test_a_member_that_ends_as_the_run_does_gets_small_and_none_does_of_a_run_that_does_not(
    many: EnsembleResult,
) -> None:
    off = [replace(one, kind="off") for one in many.outcomes]
    usual, settled = many.nominal.figures.final_error, replace(many, outcomes=tuple(off))
    assert settled.small == [one.final_error <= 2 * usual for one in many.figures]
    assert any(settled.small)
    lost = replace(many.nominal, figures=replace(many.nominal.figures, largest_error=usual))
    assert not any(replace(settled, nominal=lost).small)


@given(angle=st.floats(0, 2 * np.pi))
@settings(max_examples=20)
def test_an_outline_is_where_the_region_meets_the_plane(angle: float, result: Result) -> None:
    """On its edge the form of the ellipsoid, or the polynomial, scaled for the limits, is 1."""
    claim = result.controller.claim(LimitedRegion)
    left = claim.room.spare
    assert left is not None
    seen = set()
    for one in claim.found:
        edge = one.outline(left, [1, 0], np.array([[np.cos(angle), np.sin(angle)]]))
        assert edge is not None
        start = np.zeros(3 if one.starts.delta is None else 6)
        start[[1, 0]] = edge[0]
        if isinstance(one.held, PolynomialRegion):
            z, P = one.held.proof.T @ start, floats(one.held.proof.P)
            m = [np.prod(z**a) for a in one.held.proof.monomials.exponents]
            assert m @ P @ m == pytest.approx(one.scale(left) ** one.held.proof.degree, rel=1e-6)
        else:
            assert isinstance(one.held, StartEllipsoid)
            assert start @ np.linalg.solve(floats(one.held.P), start) == pytest.approx(one.scale(left) ** 2, rel=1e-6)
        seen.add(type(one.held))
    assert PolynomialRegion in seen


def test_the_picture_shows_each_member_and_what_is_proved(many: EnsembleResult) -> None:
    (axes,) = starts_in_plane(many).axes
    small, others = (np.asarray(each.get_offsets()) for each in axes.collections)
    assert len(small) + len(others) == 300
    assert [line.get_label() for line in axes.lines] == [
        f"proved: {said}" for said, _ in sections(many.nominal.controller, many.nominal.loop.conditions, [0, 1])
    ]
    for line, (_, edge) in zip(
        axes.lines, sections(many.nominal.controller, many.nominal.loop.conditions, [0, 1]), strict=True
    ):
        assert (points(line) == edge).all()
    assert axes.get_xlabel() == "z − z_d (m)"


@pytest.mark.slow
@pytest.mark.parametrize(
    "acting", ["disturbance: {v: 0.01}", "noise: {std: {y: 1e-4}, sample_time: 0.05}", "plant: {parameters: {a: 0.6}}"]
)
def test_nothing_is_drawn_as_proved_of_a_loop_that_does_not_run(acting: str, tmp_path: Path) -> None:
    path = tmp_path / "bar.yaml"
    text = BAR.replace("system:", "parameters: {a: 0.5}\nsystem:", 1).replace("slope: 0.5", "slope: a")
    path.write_text(f"{text}  {acting}\n", encoding="utf-8")
    few = ensemble(simulate(load_spec(path)), 5, over="plane")
    assert few.nominal.controller.claim(LimitedRegion).found, "of the loop as designed there is a region"
    (axes,) = starts_in_plane(few).axes
    assert not axes.lines


@pytest.mark.slow
def test_a_run_writes_it_and_does_not_fail_by_it(bar: Path, tmp_path: Path) -> None:
    run = call("simulate", bar, "--ensemble", 20, "--over", "plane", "--out", tmp_path / "out", pictures=True)
    assert run.exit_code == 0, run.output
    assert "20 members from starts in a plane, x̂ = x: " in run.stdout
    assert "starts.png" in index_of(tmp_path / "out")["files"]


@pytest.mark.parametrize("plane", ["[z]", "[z, z]", "[z, w]", "[z, v, f]"])
def test_a_plane_is_one_of_two_states(plane: str, tmp_path: Path) -> None:
    path = tmp_path / "bar.yaml"
    path.write_text(BAR + f"  ensemble: {{plane: {plane}}}\n", encoding="utf-8")
    said = refused(call("check", path), 2)
    assert "simulation.ensemble.plane: two different states are expected, of z, v, f" in said


def test_another_plane_is_taken_and_one_state_makes_none(tmp_path: Path) -> None:
    (tmp_path / "bar.yaml").write_text(BAR + "  ensemble: {plane: [v, f]}\n", encoding="utf-8")
    run = simulate(load_spec(tmp_path / "bar.yaml"))
    values = ensemble(run, 5, over="plane").variation.values
    assert list(values) == ["v", "f"]
    text = "system: {states: [z], inputs: [u], outputs: [y], A: [[-1]], B: [[1]], C: [[1]]}\nreference: {output: 0.1}\n"
    (tmp_path / "one.yaml").write_text(f"name: one\n{text}simulation: {{duration: 1, sample_time: 0.1}}\n")
    with pytest.raises(InvalidSpec, match="the plant has one state: there is no plane"):
        ensemble(simulate(load_spec(tmp_path / "one.yaml")), 2, over="plane")


@pytest.mark.slow
@pytest.mark.parametrize("limits", ["[-1, 1]", "[-1, 0]"])
def test_an_input_is_marked_where_it_is_at_a_limit(
    tmp_path: Path, limits: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The marks take as much of the time as the events say, beside each limit that is reached and no other."""
    path = tmp_path / "far.yaml"
    path.write_text(BAR.replace("[0.2, 0, 0]", "[0.42, 0, 0]").replace("[-1, 1]", limits), encoding="utf-8")
    far = simulate(load_spec(path))
    figure, share = control_input(far), far.figures.time_share["actuator F"]
    marks = [points(line) for line in figure.axes[0].lines if line.get_label() == "at a limit"]
    low, high = map(float, limits.strip("[]").split(","))
    reached = {level: share[name] for level, name in ((low, "low"), (high, "high")) if share.get(name)}
    assert [np.nanmax(mark[:, 1]) for mark in marks] == list(reached)
    for mark, much in zip(marks, reached.values(), strict=True):
        assert abs(np.isfinite(mark[:, 1]).mean() - much) < 2 / len(mark)
    assert len(reached) == (2 if high == 0 else 1)
    for text, box in written(figure, monkeypatch):
        assert figure.bbox.x0 <= box.x0 <= box.x1 <= figure.bbox.x1, text
