"""Practical tracking: what is merged is the least, what is proved holds for the true plant, and all files say so."""

import copy
import json
import re
from dataclasses import replace
from fractions import Fraction
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from pwatrack import Spec, design, load_spec, simulate
from pwatrack.arrays import up
from pwatrack.ball_matrix import text
from pwatrack.claims.practical import Practical, least_merges
from pwatrack.commands.run import run
from pwatrack.commands.verify import verify
from pwatrack.control.bounds import Form
from pwatrack.errors import CheckFailed, ExitCode, Infeasible, InvalidSpec, OutsideTheory
from pwatrack.lmi.audit.certificate import audit
from pwatrack.model.simplification import Simplification, merges, scalar_form
from pwatrack.model.sizes import Sizes
from pwatrack.report.certificate import design_certificate
from pwatrack.report.screen import Findings
from pwatrack.report.summary import print_all
from pwatrack.simulation.closed_loop import closed_loop
from tests.gaps import plant_with_gaps, practical_controller, worst_found
from tests.promises import run as run_loop
from tests.promises import with_claim, worst

GEAR = "gallery/gear_with_backlash.yaml"
CART = """
name: cart on a slack rope
parameters: {{gap: 0.1}}
system:
  states: [z1, v1, z2, v2]
  inputs: [u]
  outputs: [y1, y2]
  track: {{y: z1}}
  units: {{z1: m, z2: m, v1: m/s, v2: m/s, u: N}}
  A: [[0, 1, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1], [0, 0, 0, -0.5]]
  B: [[0], [1], [0], [0]]
  C: [[1, 0, 0, 0], [0, 0, 1, 0]]
  nonlinearities:
    - {{name: rope, kind: {kind}, of: z1 - z2, {shape}, into: {{v1: -1, v2: 1}}}}
    {more}
design: {{tracking: {tracking}}}
reference: {{output: 0.5*sin(0.5*t)}}
simulation: {{duration: 40, sample_time: 0.02, initial: {{plant: [0.3, 0, 0.2, 0]}}}}
"""
PLAIN = {
    "kind": "dead_zone",
    "shape": "lower: -gap, upper: gap, slope: 20",
    "more": "",
    "tracking": "output",
}


def cart(folder: Path, **changes: str) -> Path:
    path = folder / "cart.yaml"
    path.write_text(CART.format(**PLAIN | changes), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def gear(specs: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Spec, Path]:
    path, out = specs / GEAR, tmp_path_factory.mktemp("gear")
    run(path, out, [], None, simulated=True, plots="none")
    return load_spec(path), out


@pytest.mark.slow
def test_the_gear_of_a_backlash_of_5_mrad_ends_below_14_8_mrad(gear: tuple[Spec, Path]) -> None:
    index = json.loads((gear[1] / "run.json").read_text())
    assert (index["verdict"], index["exit"]) == ("practical", 0)
    ends = index["practical"]["ends_below"]
    assert ends["load - load_d"]["unit"] == "rad"
    assert 0.0085 < ends["load - load_d"]["bound"] <= 0.0148
    assert {"u - u_ff", "q1_hat - q1"} <= ends.keys()
    assert [one["name"] for one in index["practical"]["merged"]] == ["backlash"]
    assert index["practical"]["merged"][0]["deviates_by"] == {"dw1/dt": 25, "dw2/dt": 5}
    assert "is infeasible" in index["practical"]["exact_tracking"][0]
    assert (gear[1] / "refusal.json").is_file()
    assert index["simulation"]["outcome"] == "within its bound"
    assert any("ends below" in said for said in verify(gear[1]))


@pytest.mark.slow
def test_all_that_is_tracked_ends_below_something(gear: tuple[Spec, Path]) -> None:
    """Without the load, what is printed is that of nothing."""
    content = by_ellipsoids(json.loads((gear[1] / "certificate.json").read_text()))
    ends = content["practical"]["ends_below"]
    assert audit(json.dumps(content))[1] == []
    for told in ([], [signal for signal in ends if signal[0] != "output"], [*ends, ends[0]]):
        content["practical"]["ends_below"] = told
        assert any("ends_below" in fault for fault in audit(json.dumps(content))[1])


def test_the_bound_is_above_the_peak_gain_and_close_to_it(gear: tuple[Spec, Path]) -> None:
    controller = design(gear[0])
    practical, plant = controller.claim(Practical), controller.plant
    assert practical is not None
    A, B, C, K, L = plant.A[0], plant.B, plant.C, controller.design.K, controller.design.L
    M = np.block([[A + B @ K, B @ K], [np.zeros((4, 4)), A + L @ C]])
    E = practical.merges[0].column.floats[:, 0]
    rows: dict[Form, Any] = {("output", 0): np.r_[plant.tracked[0], np.zeros(4)], ("input", 0): np.r_[K[0], K[0]]}
    for signal, row in rows.items():
        peak = 0.25 * worst(M[None], np.r_[E, -E], row, duration=2.0, steps=4000)
        assert 1 < practical.final[signal] / peak < 1.01


@pytest.mark.slow
def test_a_slack_rope_is_refused_exactly_and_tracked_practically(tmp_path: Path) -> None:
    path, out = cart(tmp_path), tmp_path / "out"
    run(path, out, [], None, simulated=True, plots="none")
    index = json.loads((out / "run.json").read_text())
    assert index["verdict"] == "practical"
    assert "(8) is infeasible" in index["practical"]["exact_tracking"][0] or "(17)" in str(index["practical"])
    assert (out / "refusal.json").is_file()
    assert verify(out)[-1] == "refusal.json beside it proves why exact tracking is refused"
    refusal = json.loads((out / "refusal.json").read_text())
    refusal["proofs"][0]["Z"] = {}
    (out / "refusal.json").write_text(json.dumps(refusal))
    with pytest.raises(CheckFailed):
        verify(out)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("reference", "worth"),
    [
        ("output: 0.1*sin(0.5*t)", False),  # the bound is 0.107, for a constant 0.147
        ("output: 0.11*sin(0.5*t)", True),
        ("output: 9 + 0.1*sin(0.5*t)", False),  # its swing counts, not where it is
        ("output: {constant: 0.1}", False),
        ("output: {constant: 0.9}", True),
        ("output: {constant: 0}", True),  # there is nothing to compare it with
    ],
)
def test_a_bound_that_is_not_below_the_size_of_the_reference_is_no_reason_to_take_a_refusal_back(
    tmp_path: Path, reference: str, worth: bool
) -> None:
    def written(tracking: str) -> Path:
        path = cart(tmp_path, tracking=tracking)
        text = path.read_text(encoding="utf-8").replace("output: 0.5*sin(0.5*t)", reference)
        path.write_text(text.replace("plant: [0.3, 0, 0.2, 0]", "plant: [0.1, 0, 0.1, 0]"), encoding="utf-8")
        return path

    asked = design(load_spec(written("output" if worth else "practical")))
    assert asked.claims_of(Practical)
    bound = asked.claim(Practical).final["output", 0]
    assert bound > 0.1  # the gap
    assert bool(asked.claim(Practical).beyond) is not worth
    console = Console(file=StringIO(), width=300)
    print_all(console, Findings(spec=load_spec(written("practical")), controller=asked))
    first = console.file.getvalue().splitlines()[1]  # type: ignore[attr-defined]
    assert (f"{up(bound)} m, larger than the reference, proved for every start" in first) is not worth, first
    if worth:
        return
    with pytest.raises(Infeasible) as refusal:
        design(load_spec(written("output")))
    assert refusal.value.code == ExitCode.INFEASIBLE
    assert refusal.value.evidence is not None
    (problem,) = refusal.value.problems
    assert "is infeasible" in problem.message
    said = f"not worth having: |y − y_d| ends below {up(bound)} m, and the reference is of size 0.1 m"
    assert said in problem.message


def test_where_exact_tracking_is_found_nothing_is_merged(specs: Path, tmp_path: Path) -> None:
    text = (specs / "two_mass_backlash.yaml").read_text().replace("tracking: output", "tracking: practical")
    path = tmp_path / "asked.yaml"
    path.write_text(text)
    assert design(load_spec(path)).claims_of(Practical) == ()


def test_a_rate_out_of_reach_is_refused_unless_practical_tracking_is_asked(specs: Path, tmp_path: Path) -> None:
    path = specs / "refused" / "rate_out_of_reach.yaml"
    with pytest.raises(Infeasible, match="at a rate of"):
        design(load_spec(path))
    asked = tmp_path / "asked.yaml"
    asked.write_text(path.read_text().replace("tracking: output", "tracking: practical"))
    controller = design(load_spec(asked))
    assert controller.claims_of(Practical)
    assert max(proof.rate for proof in controller.guarantees.controller) >= 0.3


def test_what_merging_cannot_help_stays_refused(specs: Path) -> None:
    for name in ("printed_gains", "tank_without_outlet"):
        with pytest.raises(Infeasible):
            design(load_spec(specs / "refused" / f"{name}.yaml"))


def test_only_the_slack_is_merged_and_the_stops_stay(tmp_path: Path) -> None:
    shape = "breakpoints: [-0.6, -gap, gap, 0.6], slopes: [24, 20, 0, 20, 24]"
    other = "- {name: rail, kind: dead_zone, of: z2, lower: -2, upper: 2, slope: 0.1, into: {v2: -1}}"
    spec = load_spec(cart(tmp_path, kind="piecewise_linear", shape=shape, more=other))
    practical = design(spec).claim(Practical)
    (merge,) = practical.merges
    assert (merge.nonlinearity.name, merge.first, merge.last) == ("rope", 1, 2)
    assert float(merge.largest) == pytest.approx(2)


def test_the_choice_is_the_least_that_works(tmp_path: Path) -> None:
    more = "- {name: rail, kind: dead_zone, of: z2, lower: -2, upper: 2, slope: 0.1, into: {v2: -1}}"
    plant = load_spec(cart(tmp_path, more=more)).problem.plant
    form = scalar_form(plant)
    assert form is not None
    asked: list[set[int]] = []

    def needs(*elements: int) -> Any:
        def works(chosen: Any) -> bool:
            asked.append(set(chosen))
            return set(elements) <= set(chosen)

        return works

    for elements in ((0,), (1,), (0, 1)):
        found = least_merges(form, Sizes.of(plant), needs(*elements))
        assert found is not None
        assert set(found) == set(elements)
    assert all(asked)
    assert least_merges(form, Sizes.of(plant), lambda _: False) is None
    both: dict[int, Simplification] = {k: merges(form, k)[0] for k in range(2)}
    assert all(merge.largest > 0 for merge in both.values())


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
def test_no_simulation_ends_above_its_bound(seed: int) -> None:
    plant, form = plant_with_gaps(seed)
    controller = practical_controller(plant, form)
    seen = worst_found(controller, seed, tries=4, steps=3)
    assert seen.final < 1
    assert seen.part < 1 + 1e-9


def test_an_observer_with_all_cells_has_no_error_in_the_end_and_a_smaller_bound() -> None:
    plant, form = plant_with_gaps(0)
    merged_, true = (practical_controller(plant, form, watched=watched) for watched in (False, True))
    assert merged_.claims_of(Practical)
    assert true.claims_of(Practical)
    assert true.claim(Practical).final["output", 0] < merged_.claim(Practical).final["output", 0]
    assert all(size == 0 for (kind, _), size in true.claim(Practical).final.items() if kind == "estimate")
    seen = worst_found(true, 0, tries=4, steps=2)
    assert seen.final < 1
    assert seen.part < 1 + 1e-9
    loop = closed_loop(true)
    assert [len(part.cells) for part in loop.flow.parts] == [len(plant.A), len(plant.A), 1]
    duration = 40 / true.guarantees.rate
    response = run_loop(loop, np.ones(len(plant.states)), duration, duration / 500)
    assert response.observer_error[-1] < 1e-9 * response.observer_error[0]


@pytest.mark.slow
def test_no_gain_of_the_observer_enlarges_rounding() -> None:
    """Of x̂ and x, each by itself, doubles keep so little that with L = 6e5 2e-7 would be left of x̂ − x for good."""
    plant, form = plant_with_gaps(97)
    controller = practical_controller(plant, form, watched=True)
    assert np.abs(controller.design.L).max() > 1e5
    seen = worst_found(controller, 97, tries=5, steps=10)
    assert max(seen.final, seen.part) < 1 + 1e-9


def test_a_simulation_above_its_own_bound_is_said_first(gear: tuple[Spec, Path]) -> None:
    controller = design(gear[0])
    practical = controller.claim(Practical)
    tiny = tuple(replace(bounds, sizes=dict.fromkeys(bounds.sizes, 1e-6)) for bounds in practical.bounds)
    result = simulate(gear[0], with_claim(controller, replace(practical, bounds=tiny)))
    assert result.outcome.kind == "above its bound"
    assert result.outcome.code == ExitCode.CHECK_FAILED
    assert "above its own proved bound" in result.outcome.text


def test_practical_tracking_goes_without_uncertain_parameters(tmp_path: Path) -> None:
    path = cart(tmp_path, tracking="practical, uncertain: {gap: 5%}")
    with pytest.raises(InvalidSpec, match="without uncertain parameters"):
        load_spec(path)


def paths(content: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return where all texts that are numbers stand."""
    if isinstance(content, dict):
        return [path for key, value in content.items() for path in paths(value, (*at, key))]
    if isinstance(content, list):
        return [path for k, value in enumerate(content) for path in paths(value, (*at, k))]
    return [at] if isinstance(content, str) and content.lstrip("-")[:1].isdigit() else []


def by_ellipsoids(content: Any) -> Any:
    """The same certificate without peak gains: quick to audit."""
    found = copy.deepcopy(content)
    practical = found["practical"]
    (entry,), (merge,) = practical["bounds"], practical["merged"]
    del entry["peaks"]
    sizes = {(kind, k): size for part in entry["parts"] for kind, k, size in part["signals"]}
    entry["signals"] = [[kind, k, sizes[kind, k]] for kind, k, _ in entry["signals"]]
    total = {signal: text(Fraction(merge["largest"]) * Fraction(size)) for signal, size in sizes.items()}
    practical["ends_below"] = [[kind, k, total[kind, k]] for kind, k, _ in practical["ends_below"]]
    return found


@pytest.mark.parametrize(
    ("kind", "reason"),
    [
        ("saturation, lower: -1, upper: 1", "with all cells merged that can be: no relative degree"),
        ("spring, start: 0.5", "no scalar nonlinearity has two corners that could become one or none"),
    ],
)
def test_where_it_is_asked_for_and_not_found_the_refusal_says_why(tmp_path: Path, kind: str, reason: str) -> None:
    """A valve that ends, between pump and level: with both ends merged nothing of the pump arrives."""
    path = tmp_path / "valve.yaml"
    path.write_text(
        f"""name: valve
system:
  states: [h, p]
  inputs: [u]
  outputs: [y]
  A: [[-0.5, 0], [0, -1]]
  B: [[0], [1]]
  C: [[1, 0]]
  nonlinearities: [{{name: valve, of: p, into: {{h: 1}}, kind: {kind}}}]
design: {{tracking: practical}}
reference: {{output: "0.2*sin(t)"}}
simulation: {{duration: 20, sample_time: 0.02}}
"""
    )
    with pytest.raises(OutsideTheory, match=f"practical tracking is asked for, and not found: {reason}"):
        design(load_spec(path))


@pytest.mark.slow
def test_a_tampered_split_or_bound_is_found(gear: tuple[Spec, Path]) -> None:
    content = by_ellipsoids(json.loads((gear[1] / "certificate.json").read_text()))
    assert audit(json.dumps(content))[1] == []
    tried = 0
    for path in list(paths(content["practical"]))[::6]:
        if (path[0] == "plant" and path[1] not in ("A", "b")) or path[-1] == "a" or "Q" in path:
            continue  # another ellipsoid may be a proof too
        tampered = copy.deepcopy(content)
        at: Any = tampered["practical"]
        for key in path[:-1]:
            at = at[key]
        at[path[-1]] = "0.7" if Fraction(at[path[-1]]) == 0 else "0"
        assert audit(json.dumps(tampered))[1], path
        tried += 1
    assert tried > 12


@pytest.mark.slow
def test_a_tampered_peak_gain_is_found(specs: Path) -> None:
    spec = load_spec(specs / "gallery" / "drivetrain_with_backlash.yaml")
    content = json.loads(json.dumps(design_certificate(spec, design(spec))))
    assert audit(json.dumps(content))[1] == []
    (entry,) = content["practical"]["bounds"]
    first = entry["peaks"][0]
    changes: list[dict[str, Any]] = [
        {"size": str(0.99 * float(first["size"]))},
        {"unit": first["unit"] + 2},
        {"unit": -99_999},
        {"steps": []},
        {"steps": first["steps"][:2]},
        {"steps": [[0, 1], [101, 1]]},
        {"part": 0},
        {"P": entry["parts"][1]["Q"]},
    ]
    for change in changes:
        tampered = copy.deepcopy(content)
        tampered["practical"]["bounds"][0]["peaks"][0] |= change
        assert audit(json.dumps(tampered))[1], change


@pytest.mark.slow
def test_beside_an_estimated_load_it_is_within_its_bound_and_no_error_is_said_to_go_to_0(
    specs: Path, tmp_path: Path
) -> None:
    """The gear with a drag on its load: what the estimate is off by, as the backlash drives it, is in the bound."""
    text = (specs / "gallery/gear_with_backlash.yaml").read_text(encoding="utf-8")
    head = text.partition("design:\n")[0]
    path = tmp_path / "gear.yaml"
    path.write_text(
        f"{head}design:\n  tracking: practical\n  estimate: {{drag: {{into: {{w2: -1/J2}}}}}}\n\n"
        "reference: {output: 0.3*sin(2*t)}\n"
        "simulation: {duration: 20, sample_time: 0.005, disturbance: {w2: {constant: -0.1/J2}}}\n"
    )
    result = simulate(load_spec(path))
    practical = result.controller.claim(Practical)
    assert result.verdict == "within its bound"
    assert 0 < result.final_error < practical.final["output", 0]
    printed = StringIO()
    print_all(Console(width=200, file=printed), Findings(spec=result.spec, controller=result.controller))
    said = printed.getvalue()
    assert "drag (constant): estimated and compensated; errors end below the bounds said here" in said
    assert "go to 0" not in said


SLACK = """
name: two carts, the second on a slack rope
parameters: {{gap: {gap}}}
system:
  states: [z1, v1, z2, v2]
  inputs: [u]
  outputs: [y1, y2]
  A: [[0, 1, 0, 0], [-4, -1, 0, 0], [0, 0, 0, 1], [0, 0, 0, -0.5]]
  B: [[0], [1], [0], [0]]
  C: [[1, 0, 0, 0], [0, 0, 1, 0]]
  nonlinearities:
    - {{name: rope, kind: dead_zone, of: z1 - z2, lower: -gap, upper: gap, slope: 20, into: {{v1: -1, v2: 1}}}}
design: {{tracking: state}}
reference: {{input: ["{u}"], start: {start}}}
simulation: {{duration: 40, sample_time: 0.02}}
"""


@pytest.mark.parametrize(
    ("gap", "u", "start", "worth"),
    [
        (0.001, "6*sin(0.5*t)", "periodic", True),
        (0.001, "6", "periodic", True),  # speeds of a response that rests are rounding, and no size
        (0.5, "0.2*sin(0.5*t)", "periodic", False),
        (0.5, "0.2*sin(0.5*t)", "[0, 0, 0, 0]", False),
    ],
)
def test_a_bound_beside_the_response_to_given_inputs_must_be_worth_having(
    tmp_path: Path, gap: float, u: str, start: str, worth: bool
) -> None:
    path = tmp_path / "slack.yaml"
    path.write_text(SLACK.format(gap=gap, u=u, start=start), encoding="utf-8")
    if worth:
        practical = design(load_spec(path)).claim(Practical)
        assert not practical.beyond
        return
    with pytest.raises(Infeasible, match="practical tracking is proved, and not worth having") as refusal:
        design(load_spec(path))
    said = re.search(r"\|z1 − z1_d\| ends below (\S+), and the reference is of size (\S+),", str(refusal.value))
    assert said is not None
    amplitude = _amplitude(0.5) * 0.2  # of z1 with the rope as a spring
    assert float(said[2]) == pytest.approx(amplitude, rel=0.1 if "[" in start else 5e-3)
    assert float(said[1]) > amplitude


def _amplitude(frequency: float) -> float:
    """Of z1 per amplitude of u, with the rope as a spring of 20."""
    A = np.array([[0, 1, 0, 0], [-24, -1, 20, 0], [0, 0, 0, 1], [20, 0, -20, -0.5]])
    return float(np.abs(np.linalg.solve(1j * frequency * np.eye(4) - A, np.eye(4)[:, 1]))[0])
