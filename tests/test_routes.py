"""What check says of every route, against what design does."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from pwatrack import OutsideTheory, PwatrackError, design, load_spec
from pwatrack.claims.practical import Practical
from pwatrack.cli import app
from pwatrack.control.applicability import ROUTES, Applicability, applicability
from pwatrack.workflow.sizing import spec_sizes
from pwatrack.workflow.tracking import check_reference
from tests.conftest import SPECS

TAKEN = {
    "two_mass_backlash": "Theorem 3",
    "gallery/gantry": "several outputs",
    "gallery/three_tanks_pumps": "several outputs",
    "gallery/kinked_tanks": "kinked derivative",
    "gallery/two_rooms": "Theorem 2",
    "gallery/cart_and_pole_swaying": "preview",
}
NONE = {
    "refused/kink_upstream": ("Theorem 3", "before an input enters"),
    "refused/output_upstream_of_input": ("Theorem 3", "no input ever reaches the output 'y'"),
    "refused/runaway_upstream": ("Theorem 2", "no gain moves the eigenvalue 0.01 in cell 'reaction linear'"),
    "refused/tank_without_outlet": ("practical tracking", "no scalar nonlinearity has two corners"),
}


def judged(name: str) -> Applicability:
    spec = load_spec(SPECS / f"{name}.yaml")
    asked, uncertain = spec.objectives.practical, bool(spec.objectives.uncertain)
    return applicability(
        spec.problem.plant,
        tracking=spec.problem.tracking,
        sizes=spec_sizes(spec),
        asked=asked,
        uncertain=uncertain,
    )


@pytest.mark.slow
@pytest.mark.parametrize(("name", "route"), TAKEN.items())
def test_the_route_that_check_names_is_the_one_that_design_goes(name: str, route: str) -> None:
    found = judged(name)
    assert found.taken.split(", else ")[0] == route
    controller = design(load_spec(SPECS / f"{name}.yaml"))
    assert (controller.generator is None) == (route == "Theorem 2")
    if controller.generator is not None:
        form = controller.generator.form
        several, kinked = max(form.D.shape[1:]) > 1, any(form.piecewise)
        assert (several and not kinked, kinked) == (route == "several outputs", route == "kinked derivative")


def test_a_dead_zone_before_the_output_is_refused_with_the_ways_that_the_plant_has(tmp_path: Path) -> None:
    """Of form (11) it is not; practical tracking is named, and found once it is asked for."""
    text = """
name: Load on a hook
system:
  states: [p, v, z, w]
  inputs: [F]
  outputs: [drum, laser]
  track: {height: z}
  A: [[0, 1, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1], [0, 0, 0, -1]]
  B: [[0], [1], [0], [0]]
  C: [[1, 0, 0, 0], [0, 0, 1, 0]]
  nonlinearities:
    - {name: hook, kind: dead_zone, of: p - z, lower: -0.1, upper: 0, slope: 20, into: {v: -1, w: 1}}
reference: {output: "0.1*sin(t)"}
simulation: {duration: 1, sample_time: 0.1}
"""
    path = tmp_path / "hook.yaml"
    path.write_text(text, encoding="utf-8")
    plant = load_spec(path).problem.plant
    routes = applicability(plant, tracking="output", sizes=spec_sizes(load_spec(path))).routes()
    assert "it is not asked for" in routes["practical tracking"]
    assert "0 to rounding" in routes["Theorem 1"]
    with pytest.raises(OutsideTheory, match="'tracking: practical'"):
        design(load_spec(path))
    path.write_text(text + "design: {tracking: practical}\n", encoding="utf-8")
    assert design(load_spec(path)).verdict == "practical"


@pytest.mark.parametrize(("name", "reason"), NONE.items())
def test_where_there_is_no_route_each_says_why_and_design_refuses(name: str, reason: tuple[str, str]) -> None:
    found = judged(name)
    assert reason[1] in found.routes()[reason[0]]
    with pytest.raises(PwatrackError):
        design(load_spec(SPECS / f"{name}.yaml"))


ROPE = """
name: A load on a rope
system:
  states: [xw, vw, xl, vl]
  inputs: [force]
  outputs: [winch, height]
  A: [[0, 1, 0, 0], [0, -2, 0, 0], [0, 0, 0, 1], [0, 0, 0, 0]]
  B: [[0], [1], [0], [0]]
  C: [[1, 0, 0, 0], [0, 0, 1, 0]]
  track: {load: xl}
  nonlinearities: [{name: rope, kind: spring, of: xw - xl, slope: 9, into: {vw: -1, vl: 1}}]
reference: {output: 0.1*sin(t)}
simulation: {duration: 1, sample_time: 0.1}
"""


def test_state_tracking_is_advised_only_where_no_eigenvalue_decides_against_it(tmp_path: Path) -> None:
    """Of a load on a rope that is slack no gain moves the eigenvalue 0; in `kink_upstream` nothing is stuck."""
    (tmp_path / "rope.yaml").write_text(ROPE)
    for path, state in ((tmp_path / "rope.yaml", False), (SPECS / "refused/kink_upstream.yaml", True)):
        with pytest.raises(PwatrackError) as refusal:
            check_reference(load_spec(path))
        hint = refusal.value.problems[0].hint
        assert "another output may" in hint
        assert ("write 'tracking: state'" in hint) == state


def test_of_zero_dynamics_too_state_tracking_is_advised_only_where_it_may_be_had() -> None:
    """Without an outlet the level of a tank that is not measured is seen by nobody; the cart and pole has both."""
    for name, state in (("refused/tank_without_outlet", False), ("gallery/cart_and_pole_swaying", True)):
        spec = load_spec(SPECS / f"{name}.yaml")
        reference = replace(spec.problem.reference, preview=False)  # type: ignore[arg-type]
        with pytest.raises(PwatrackError, match=r"\(17\), convergence") as refusal:
            design(replace(spec, problem=replace(spec.problem, reference=reference)))
        assert ("write 'tracking: state'" in refusal.value.problems[0].hint) == state


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["gear_with_backlash", "valve_with_dead_band", "train_slack_couplings", "stiff_springs"]
)
def test_where_cells_are_merged_check_names_that_route_too(name: str) -> None:
    found = judged(f"gallery/{name}")
    answers = {route.name: answer for route, answer in found.answers}
    assert answers["practical tracking"].word == "needs"
    controller = design(load_spec(SPECS / f"gallery/{name}.yaml"))
    assert bool(controller.claims_of(Practical)) == (name != "train_slack_couplings")
    assert found.taken.split(", else ")[-1] == "practical tracking"


@pytest.mark.parametrize(
    ("changes", "reason", "words"),
    [
        (("0.4*sin(2*t)}", "0.4*sin(2*t), preview: none}"), "the reference is not known beforehand", "not stable"),
        (("g: 9.81", "g: -9.81"), "real part 0 to rounding in cell", "is on the imaginary axis"),
    ],
)
def test_check_refuses_zero_dynamics_as_design_does(
    tmp_path: Path, changes: tuple[str, str], reason: str, words: str
) -> None:
    """A reference that is not known beforehand; and a pole that hangs and swings: then there is no P of any sign."""
    text = (SPECS / "gallery/cart_and_pole_swaying.yaml").read_text(encoding="utf-8")
    assert changes[0] in text
    path = tmp_path / "cart.yaml"
    path.write_text(text.replace(*changes), encoding="utf-8")
    check = CliRunner().invoke(app, ["check", str(path)])
    run = CliRunner().invoke(app, ["design", str(path), "--out", str(tmp_path / "run")])
    assert check.exit_code == run.exit_code == 4
    assert words in check.stderr
    assert run.stderr.startswith(check.stderr)
    told = json.loads(CliRunner().invoke(app, ["check", str(path), "--json"]).stdout)
    assert reason in told["routes"]["preview"]
    assert told["design_takes"].startswith("none")


def test_of_many_cells_too_it_says_whether_merging_helps(tmp_path: Path) -> None:
    """81 cells: two staircases of eight corners, each of which could be one line."""
    marks, slopes = ", ".join(str(k / 8) for k in range(8)), ", ".join(["0.1, 0.2"] * 4)
    stairs = f"kind: piecewise_linear, breakpoints: [{marks}], slopes: [{slopes}, 0.1]"
    (tmp_path / "stairs.yaml").write_text(
        f"""\
name: stairs
system:
  states: [z, v]
  inputs: [u]
  outputs: [y]
  A: [[0, 1], [-1, -1]]
  B: [[0], [1]]
  C: [[1, 0]]
  nonlinearities: [{{name: one, of: z, {stairs}, into: {{v: -1}}}}, {{name: two, of: v, {stairs}, into: {{v: -1}}}}]
reference: {{output: "0.1*sin(t)"}}
simulation: {{duration: 1, sample_time: 0.1}}
"""
    )
    plant = load_spec(tmp_path / "stairs.yaml").problem.plant
    found = applicability(plant)
    assert (len(plant.A), found.taken) == (81, "Theorem 3, else practical tracking")
    assert found.merged is not None
    assert len(found.merged.plant.A) == 1


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("gallery/robust_positioning", "its bounds are not proved with uncertain parameters"),
        ("gallery/cart_and_pole_on_the_move", "with all cells merged that can be: the zero dynamics do not converge"),
    ],
)
def test_where_merging_does_not_help_it_says_why(name: str, reason: str) -> None:
    assert judged(name).routes()["practical tracking"].startswith(f"no: {reason}")


def test_every_route_is_judged_for_every_plant_with_a_reason() -> None:
    """No route is left out, and each that is closed says why."""
    for path in sorted(Path(SPECS / "gallery").glob("*tank*.yaml")):
        spec = load_spec(path)
        answers = applicability(spec.problem.plant).answers
        assert [route.name for route, _ in answers] == [route.name for route in ROUTES]
        for _, answer in answers:
            assert answer.reason if answer.word == "no" else answer.word == "needs"
