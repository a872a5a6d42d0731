"""Ensembles: members are single runs, whatever their number and order, and start where they should."""

import csv
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pwatrack import Result, ensemble, load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.control.guarantees import Guarantees
from pwatrack.errors import CheckFailed, InvalidSpec
from pwatrack.simulation.ensemble import Ensemble, Member, simulate_ensemble
from pwatrack.simulation.flow import Flow, SwitchedPart
from pwatrack.simulation.propagate import Propagator, simulate_flow
from pwatrack.simulation.region import BoxRegion, EllipsoidRegion, Region
from pwatrack.workflow.variation import EnsembleResult, Over, other_starts
from tests.plants import reset
from tests.scenarios import in_scenario
from tests.test_cli import call, refused, shortened
from tests.test_outcome import cart

seeds = st.integers(0, 2**32)
sizes = st.floats(1e-6, 1e6)
places = st.floats(-1e6, 1e6)


@pytest.fixture(scope="module")
def short(specs: Path, tmp_path_factory: pytest.TempPathFactory) -> Result:
    """Return four seconds of the paper's example."""
    path = tmp_path_factory.mktemp("short") / "plant.yaml"
    text = (specs / "two_mass_paper_gains.yaml").read_text(encoding="utf-8")
    path.write_text(text.replace("duration: 60", "duration: 4"), encoding="utf-8")
    return simulate(load_spec(path))


def members_of(result: Result, count: int) -> list[Member]:
    regions: dict[str, Region] = {
        "plant": BoxRegion(low=np.array([-0.3, -1, 0, 0]), high=np.array([0.3, 1, 0.1, 0])),
        "observer": EllipsoidRegion(center=np.zeros(4), radii=np.array([0.1, 0.2, 0.0, 0.3])),
        "generator": BoxRegion(low=np.array([0.0, -0.1]), high=np.array([0.3, 0.1])),
    }
    variation = other_starts(replace(result, spec=in_scenario(result.spec, regions=regions)), count, seed=7)
    return [variation.member(number) for number in range(count)]


def run_all(members: list[Member], *, duration: float, workers: int | None = None) -> Ensemble:
    return simulate_ensemble(members.__getitem__, len(members), duration=duration, sample_time=0.01, workers=workers)


@given(bounds=st.lists(st.tuples(places, places), min_size=1, max_size=5), seed=seeds)
def test_a_box_holds_what_is_drawn_from_it(bounds: list[tuple[float, float]], seed: int) -> None:
    low, high = (np.array(side) for side in zip(*map(sorted, bounds), strict=True))
    points = BoxRegion(low=low, high=high).draw(np.random.default_rng(seed), 50)
    assert points.shape == (50, len(bounds))
    assert ((low <= points) & (points <= high)).all()


@given(
    entries=st.lists(st.tuples(places, st.one_of(st.just(0.0), sizes)), min_size=1, max_size=5),
    seed=seeds,
)
def test_an_ellipsoid_holds_what_is_drawn_from_it(entries: list[tuple[float, float]], seed: int) -> None:
    center, radii = (np.array(side) for side in zip(*entries, strict=True))
    points = EllipsoidRegion(center=center, radii=radii).draw(np.random.default_rng(seed), 50)
    varied = radii > 0
    away = (points - center)[:, varied] / radii[varied]
    rounding = (1e-15 * (np.abs(center) + radii)[varied] / radii[varied]).sum()
    assert (np.linalg.norm(away, axis=1) <= 1 + 1e-12 + rounding).all()
    assert (points[:, ~varied] == center[~varied]).all()


@given(seed=seeds, n=st.integers(1, 4))
@settings(max_examples=20)
def test_boxes_and_ellipsoids_are_filled_evenly(seed: int, n: int) -> None:
    """The share of points in a half as large a copy is 2⁻ⁿ, and no direction is preferred."""
    count = 4000
    box = BoxRegion(low=-np.ones(n), high=np.ones(n)).draw(np.random.default_rng(seed), count)
    ball = EllipsoidRegion(center=np.zeros(n), radii=np.ones(n)).draw(np.random.default_rng(seed), count)
    for inside, points in (
        (np.abs(box).max(axis=1) <= 0.5, box),
        (np.linalg.norm(ball, axis=1) <= 0.5, ball),
    ):
        assert abs(inside.mean() - 0.5**n) < 0.05
        assert np.abs(points.mean(axis=0)).max() < 0.06
        assert abs(points.max() - 1) < 0.35


@given(seed=seeds, fewer=st.integers(1, 20))
@settings(max_examples=20)
def test_fewer_points_are_the_first_of_more(seed: int, fewer: int) -> None:
    for region in (
        BoxRegion(low=np.zeros(3), high=np.ones(3)),
        EllipsoidRegion(center=np.zeros(3), radii=np.array([1.0, 0.0, 2.0])),
    ):
        few, many = (region.draw(np.random.default_rng(seed), count) for count in (fewer, 20))
        assert few.tobytes() == many[:fewer].tobytes()


@pytest.mark.slow
def test_members_equal_single_runs_bit_for_bit(short: Result) -> None:
    members = members_of(short, 4)
    N = len(members[0].z0)
    ran = [run_all([replace(m, error=row[None]) for m in members], duration=4.0) for row in np.eye(N)]
    for number, member in enumerate(members):
        walk = Propagator(member.flow, duration=4.0, sample_time=0.01).walk(member.z0, member.resets)
        trace, alone = walk.trace(), np.empty(401)
        for k, one in enumerate(ran):
            walk.norms(np.eye(N)[[k]], alone)
            assert one.error[number].tobytes() == alone.tobytes()
            np.testing.assert_allclose(alone, np.abs(trace.z[:, k]), rtol=0, atol=1e-15 * np.abs(trace.z).max())
        assert ran[0].mode_changes[number] == len(trace.events)
        assert ran[0].unresolved[number] == len(trace.unresolved)
    assert ran[0].t.tobytes() == trace.t.tobytes()


@pytest.mark.parametrize("backwards", [False, True])
def test_neither_workers_nor_order_change_a_bit(short: Result, backwards: bool) -> None:
    members = members_of(short, 12)
    one = run_all(members, duration=4.0, workers=1)
    order = slice(None, None, -1 if backwards else 1)
    for workers in (2, 5):
        other = run_all(members[order], duration=4.0, workers=workers)
        for name in ("error", "mode_changes", "unresolved"):
            assert getattr(one, name)[order].tobytes() == getattr(other, name).tobytes(), name


def test_members_may_have_flows_and_jumps_of_their_own(short: Result) -> None:
    """What another variation needs: nothing is shared between different flows."""
    members = members_of(short, 4)
    softer = replace(members[1].flow, F0=members[1].flow.F0 * 0.9)
    members[1] = replace(members[1], flow=softer)
    members[2] = replace(members[2], flow=softer, resets=(reset(1.0, slice(0, 1), np.zeros(1)),))
    kept = run_all(members, duration=2.0)
    for number, m in enumerate(members):
        z = simulate_flow(m.flow, m.z0, duration=2.0, sample_time=0.01, resets=m.resets).z
        assert np.allclose(kept.error[number], np.abs(z @ m.error[0]), rtol=0, atol=1e-14)


def test_the_kept_error_is_the_tracking_error_of_the_run(short: Result) -> None:
    nominal = Member(flow=short.loop.flow, z0=short.response.trace.z[0], error=short.loop.tracking_error)
    kept = run_all([nominal], duration=4.0)
    assert np.allclose(kept.error[0], np.abs(short.response.tracking_error[:, 0]), rtol=0, atol=1e-15)
    assert kept.final[0] == pytest.approx(short.final_error, rel=1e-9)


def starts(many: EnsembleResult) -> Array:
    return np.column_stack(list(many.variation.values.values()))


def test_a_seed_gives_the_same_members_again_and_another_seed_others(short: Result) -> None:
    first, again, other = (ensemble(short, 3, seed=seed) for seed in (1, 1, 2))
    assert first.ensemble.error.tobytes() == again.ensemble.error.tobytes()
    assert not np.isclose(starts(first)[:, :4], starts(other)[:, :4]).any()
    more = ensemble(short, 5, seed=1).ensemble
    assert more.error[:3].tobytes() == first.ensemble.error.tobytes()


def test_without_a_region_states_start_within_their_size_in_the_nominal_run(short: Result) -> None:
    many = ensemble(short, 40)
    x = short.response.x
    away = np.abs(starts(many)[:, :4] - x[0]).max(axis=0) / np.abs(x).max(axis=0)
    assert not many.variation.given
    assert (away <= 1).all()
    assert (away > 0.9).all()
    assert (starts(many)[:, 4:8] == 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("over", ["parameters", "noise"])
def test_a_member_is_the_run_of_a_spec_with_what_was_drawn_for_it(over: Over, specs: Path, tmp_path: Path) -> None:
    """The machine's program, limits and disturbance are the same in all members."""
    spread = ("k3: [0.35, 0.45], d1: [0.15, 0.25]", "m2: [0.9, 1.2]")
    path = shortened(specs / "two_mass_machine.yaml", tmp_path / "machine.yaml", spread)
    many = ensemble(simulate(load_spec(path)), 3, over=over, seed=5)
    assert set(many.variation.values) == ({"k2", "m2"} if over == "parameters" else {"noise_seed"})
    for k in range(3):
        drawn = {name: values[k].item() for name, values in many.variation.values.items()}
        if over == "parameters":
            assert 0.35 <= drawn["k2"] <= 0.45
            assert 0.9 <= drawn["m2"] <= 1.2
            changed = ("k2: 0.38,", f"k2: {drawn['k2']!r}, m2: {drawn['m2']!r},")
        else:
            changed = ("seed: 1", f"seed: {drawn['noise_seed']}")
        other = tmp_path / "member.yaml"
        other.write_text(path.read_text(encoding="utf-8").replace(*changed), encoding="utf-8")
        alone = simulate(load_spec(other), many.nominal.controller)
        error = np.linalg.norm(alone.response.tracking_error, axis=1)
        assert np.allclose(many.ensemble.error[k], error, rtol=0, atol=1e-14)
        assert many.ensemble.mode_changes[k] == len(alone.response.trace.events)
    assert len({row.tobytes() for row in many.ensemble.error}) == 3
    more = ensemble(many.nominal, 4, over=over, seed=5, workers=1).ensemble
    assert more.error[:3].tobytes() == many.ensemble.error.tobytes()


@pytest.mark.slow
def test_without_intervals_the_parameters_of_the_plant_vary_by_a_twentieth(short: Result) -> None:
    """Those of the reference do not: no member has another one."""
    many = ensemble(short, 60, over="parameters")
    declared = dict(short.spec.parameters)
    assert not many.variation.given
    assert set(many.variation.values) == set(declared) - {"Ad", "omega"}
    for name, values in many.variation.values.items():
        away = values / declared[name] - 1
        assert np.abs(away).max() <= 0.05 + 1e-12
        assert np.abs(away).max() > 0.045


def test_what_cannot_vary_is_refused(specs: Path, short: Result, tmp_path: Path) -> None:
    with pytest.raises(InvalidSpec, match=r"no simulation\.noise: without it all members are the same"):
        ensemble(short, 2, over="noise")
    plant = simulate(load_spec(specs / "gallery" / "two_rooms.yaml"))
    bare = replace(plant, spec=replace(plant.spec, parameters={}))
    with pytest.raises(InvalidSpec, match="its plant depends on no parameter"):
        ensemble(bare, 2, over="parameters")
    spread = ("  initial:", "  ensemble: {parameters: {k9: [0.3, 0.5], k2: [2, 1]}}\n  initial:")
    path = shortened(specs / "two_mass_paper_gains.yaml", tmp_path / "plant.yaml", spread)
    with pytest.raises(InvalidSpec, match=r"k2: low 2 is above high 1"):
        load_spec(path)
    path.write_text(path.read_text(encoding="utf-8").replace("k2: [2, 1]", "k2: [1, 2]"), encoding="utf-8")
    with pytest.raises(InvalidSpec, match=r"simulation\.ensemble\.parameters: 'k9' is no parameter"):
        load_spec(path)


def test_a_member_outside_the_theory_is_named_with_its_parameters(specs: Path, tmp_path: Path) -> None:
    """An offset of its own: the field jumps at the facet wherever it is not k2 c2."""
    path = shortened(
        specs / "two_mass_paper_gains.yaml",
        tmp_path / "plant.yaml",
        ("  c2: 0.05", "  offset: 0.02\n  c2: 0.05"),
        ("[0, -k2*c2/m1, 0, k2*c2/m2]", "[0, -offset/m1, 0, offset/m2]"),
        ("  initial:", "  ensemble: {parameters: {offset: [0.02, 0.03]}}\n  initial:"),
    )
    run = call("simulate", path, "--ensemble", 5, "--over", "parameters", "--out", tmp_path / "out")
    error = refused(run, 3)
    assert re.search(r"plant.yaml:\d+:.*member 1: plant with offset = 0\.02\d+: .*must be continuous", error)
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == ["run.json", "spec.txt"]


def of(error: Array) -> Ensemble:
    count = np.zeros(len(error), dtype=np.int64)
    t = np.arange(error.shape[1], dtype=float)
    return Ensemble(t=t, error=error, mode_changes=count, unresolved=count, verdicts=(None,) * len(error))


def test_an_error_is_small_for_good_at_the_sample_after_the_last_large_error() -> None:
    rows = np.full((3, 20), 1e-3)
    rows[:, 0] = 1.0
    rows[1, 5] = 0.5
    rows[2, -1] = 0.5
    kept = of(rows)
    assert kept.small == pytest.approx(0.01)
    assert kept.small_from.tolist() == [1.0, 6.0, np.inf]
    assert kept.final.tolist() == [1e-3, 1e-3, 0.5]
    assert of(np.zeros((2, 5))).small_from.tolist() == [0.0, 0.0]


def test_a_member_without_progress_is_named() -> None:
    """A field that points to the guard from both sides: only the members that reach it chatter."""
    part = SwitchedPart(
        name="part",
        cells=("left", "right"),
        guards=np.array([[1.0, 0.0]]),
        signs=np.array([[-1], [1]]),
        F=np.array([[[0.0, 1.0], [0, 0]], [[0.0, -1.0], [0, 0]]]),
    )
    flow = Flow(F0=np.zeros((2, 2)), parts=(part,))
    members = [Member(flow=flow, z0=np.array([x, 1.0]), error=np.eye(2)) for x in (5.0, 0.5, 0.25)]
    with pytest.raises(CheckFailed, match=r"member 2: the part crosses guard 1 at t = 0\.5 s"):
        run_all(members, duration=1.0)


def test_too_much_to_keep_is_refused(short: Result) -> None:
    with pytest.raises(InvalidSpec, match="1,000,000 members with 401 samples each"):
        ensemble(short, 1_000_000)


def regions(path: Path, text: str) -> Path:
    return shortened(
        Path("specs/two_mass_paper_gains.yaml").absolute(),
        path,
        ("  initial:", f"  ensemble: {{initial: {{{text}}}}}\n  initial:"),
    )


@pytest.mark.slow
def test_the_command_writes_a_row_for_each_member_and_says_what_came_out(tmp_path: Path) -> None:
    text = "plant: {z1: [-0.3, 0.3], v1: [-1, 1]}, observer: {ellipsoid: {radii: {z2: 0.1}, center: {v1: 2}}}"
    path = regions(tmp_path / "plant.yaml", text + ", generator: [[0, 0.2], [0, 0]]")
    run = call(
        "simulate",
        path,
        "--ensemble",
        12,
        "--seed",
        3,
        "--over",
        "initial",
        "--verbose",
        "--out",
        tmp_path / "out",
        pictures=True,
    )
    assert run.exit_code == 0, run.output
    assert "12 members from other initial states, seed 3" in run.stdout
    assert "-0.3 ≤ z1 ≤ 0.3" in run.stdout
    assert "z2_hat = 0 ± 0.1" in run.stdout
    assert "last tenth" in run.stdout
    assert run.stderr == ""
    with (tmp_path / "out" / "ensemble.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["member"] for row in rows] == [str(k) for k in range(1, 13)]
    assert all(abs(float(row["z1"])) <= 0.3 and row["z2"] == "0.0" and row["v1_hat"] == "2.0" for row in rows)
    assert all(abs(float(row["z2_hat"])) <= 0.1 and 0 <= float(row["eta_hat1"]) <= 0.2 for row in rows)
    index = json.loads((tmp_path / "out" / "run.json").read_text(encoding="utf-8"))
    assert {"ensemble.csv", "ensemble.png"} < set(index["files"])
    worst = index["ensemble"]["largest_error"]
    assert repr(worst["worst"]) == rows[worst["member"] - 1]["largest_error"]
    assert index["ensemble"]["regions"]["observer"] == {"ellipsoid": {"z2_hat": [0.0, 0.1]}}
    assert "ensemble" in index["seconds"]
    call("simulate", path, "--out", tmp_path / "out")
    assert not (tmp_path / "out" / "ensemble.csv").exists()


def test_a_default_region_is_said(tmp_path: Path, specs: Path) -> None:
    path = shortened(specs / "two_mass_paper_gains.yaml", tmp_path / "plant.yaml")
    run = call("simulate", path, "-v", "--ensemble", 1, "--out", tmp_path / "out")
    assert run.exit_code == 0, run.output
    assert "the spec has no simulation.ensemble.initial" in run.stdout


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("generator: [[0, 1]]", "simulation.ensemble.initial.generator: 1 interval, expected 2"),
        ("plant: {z9: [0, 1]}", "simulation.ensemble.initial.plant.z9: 'z9' is no state; states: z1, v1, z2, v2"),
        ("plant: {z1: [1, 0]}", "simulation.ensemble.initial.plant.z1: low 1 is above high 0"),
        ("plant: {z1: [1]}", "simulation.ensemble.initial.plant.z1: two numbers [low, high] are expected"),
        ("plant: {z1: 0.1}", "simulation.ensemble.initial.plant.z1: a list is expected"),
        ("plant: [[0, 1]]", "simulation.ensemble.initial.plant: a mapping is expected"),
        ("plant: {}", "simulation.ensemble.initial: nothing is varied"),
        ("plant: {ellipsoid: {radii: {z1: -1}}}", "plant.ellipsoid.radii.z1: -1 is not positive"),
        ("plant: {ellipsoid: {radii: {q: 1}}}", "plant.ellipsoid.radii.q: 'q' is no state"),
        ("plant: {ellipsoid: {center: {z1: 1}}}", "plant.ellipsoid.radii is missing"),
        ("plant: {ellipsoid: {radius: {z1: 1}}}", "unknown key; did you mean 'radii'?"),
        ("plants: {z1: [0, 1]}", "simulation.ensemble.initial.plants: unknown key; did you mean 'plant'?"),
    ],
)
def test_a_wrong_region_is_refused_with_its_line_and_rule(tmp_path: Path, text: str, message: str) -> None:
    path = regions(tmp_path / "plant.yaml", text)
    error = refused(call("simulate", path, "--ensemble", 2, "--out", tmp_path / "out"), 2)
    line = 1 + path.read_text(encoding="utf-8").split("  ensemble:")[0].count("\n")
    assert f"plant.yaml:{line}:" in error
    assert message in error
    assert not (tmp_path / "out").exists()


def test_all_wrong_entries_are_said_at_once(tmp_path: Path) -> None:
    path = regions(tmp_path / "plant.yaml", "plant: {z9: [0, 1], z1: [2, x], v1: [2, 1]}, observer: {z2: [1, 2, 3]}")
    error = refused(call("simulate", path, "--out", tmp_path / "out"), 2)
    assert error.count("error: ") == 4


def test_a_region_for_a_generator_whose_start_is_fixed_is_refused(tmp_path: Path, specs: Path) -> None:
    text = (specs / "gallery" / "two_rooms.yaml").read_text(encoding="utf-8")
    path = tmp_path / "rooms.yaml"
    path.write_text(text.replace("simulation:", "simulation:\n  ensemble: {initial: {generator: [[0, 1]]}}"), "utf-8")
    error = refused(call("simulate", path, "--ensemble", 2, "--out", tmp_path / "out"), 2)
    assert "generator" in error


@pytest.mark.slow
def test_every_member_is_judged_as_a_run_of_its_own_and_one_that_grows_ends_with_6(tmp_path: Path) -> None:
    """From some stiffness on, the plant pushes harder than gains and stop pull."""
    path = cart(tmp_path, "ensemble: {parameters: {k: [0, 16]}}", duration=8)
    many = ensemble(simulate(load_spec(path)), 12, over="parameters")
    values = many.variation.values["k"].tolist()
    alone = [simulate(load_spec(cart(tmp_path, f"plant: {{parameters: {{k: {k!r}}}}}", duration=8))) for k in values]
    assert many.outcomes == tuple(result.outcome for result in alone)
    grown = [number for number, result in enumerate(alone, 1) if result.outcome.kind == "grows"]
    assert 0 < len(grown) < 12
    cart(tmp_path, "ensemble: {parameters: {k: [0, 16]}}", duration=8)
    run = call("simulate", path, "--ensemble", 12, "--over", "parameters", "--verbose", "--out", tmp_path / "out")
    said = f"{len(grown)} of 12 members fail; member {grown[0]}: the error grows"
    assert (run.exit_code, said in run.stderr) == (6, True)
    assert f"grows: {len(grown)}" in run.stdout
    index = json.loads((tmp_path / "out" / "run.json").read_text(encoding="utf-8"))
    assert (index["exit"], index["simulation"]["outcome"], index["ensemble"]["failed"]) == (6, "tracks", grown)
    with (tmp_path / "out" / "ensemble.csv").open(encoding="utf-8", newline="") as file:
        assert [row["outcome"] for row in csv.DictReader(file)] == [outcome.kind for outcome in many.outcomes]


def test_a_member_that_cannot_be_run_leaves_the_run_itself(tmp_path: Path) -> None:
    path = cart(tmp_path, "ensemble: {parameters: {k: [1e9, 1e9]}}", duration=8)
    run = call("simulate", path, "--ensemble", 2, "--over", "parameters", "--out", tmp_path / "out", "--plots", "none")
    assert (run.exit_code, "member 1" in run.stderr, "the run itself is in" in run.stderr) == (6, True, True)
    assert {"trace.csv", "certificate.json"} <= {file.name for file in (tmp_path / "out").iterdir()}


@pytest.mark.parametrize(
    ("asked", "said"), [({"over": "else"}, "none of"), ({"count": 0}, "at least 1"), ({"seed": -1}, "at least 0")]
)
def test_an_ensemble_that_cannot_be_is_refused(asked: dict[str, Any], said: str, short: Result) -> None:
    with pytest.raises(InvalidSpec, match=said):
        ensemble(short, **{"count": 2} | asked)


def test_a_member_above_its_own_bound_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The starts of members differ, and so do their bounds; here no bound is left."""
    result = simulate(load_spec(cart(tmp_path, "ensemble: {initial: {plant: {z: [-1, 1]}}}")))
    assert {outcome.kind for outcome in ensemble(result, 5).outcomes} == {"tracks"}
    promised = Guarantees.observer_error
    monkeypatch.setattr(Guarantees, "observer_error", lambda *arguments: 0 * promised(*arguments))
    many = ensemble(result, 5)
    assert (many.failed, many.failure[:34]) == ((0, 1, 2, 3, 4), "5 of 5 members fail; member 1: abo")
