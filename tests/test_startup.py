"""A controller that is switched on: its observer knows what is measured, its generator is in steady state."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pwatrack import Result, ensemble, load_spec, simulate
from pwatrack.errors import InvalidSpec
from tests.test_cli import call, refused, shortened
from tests.test_outcome import cart


def paper(specs: Path, folder: Path, initial: str, reference: str = "", *more: tuple[str, str]) -> Path:
    changes = [("  initial: {plant: [0.25, 0, 0, 0], generator: [0.2, 0]}", f"  initial: {{{initial}}}")]
    if reference:
        changes.append(("output: {sine: {amplitude: Ad, frequency: omega}}", f"output: {reference}"))
    return shortened(specs / "two_mass_paper_gains.yaml", folder / "plant.yaml", *changes, *more)


def test_an_observer_starts_from_what_is_measured(specs: Path, tmp_path: Path) -> None:
    result = simulate(load_spec(paper(specs, tmp_path, "plant: [0.25, 1, 2, 3], observer: measured")))
    assert result.response.x_hat[0].tolist() == pytest.approx([0.25, 0, 0, 0])


def test_what_is_measured_has_its_noise(specs: Path, tmp_path: Path) -> None:
    noise = "noise: {std: {y: 0.01}, sample_time: 0.1, seed: SEED}\n  initial"
    path = paper(specs, tmp_path, "observer: measured", "", ("  initial", f"  {noise}"))
    text, starts = path.read_text(encoding="utf-8"), set[float]()
    for seed in (1, 2):
        path.write_text(text.replace("SEED", str(seed)), encoding="utf-8")
        result = simulate(load_spec(path))
        drawn = result.response.trace.z[0, result.loop.at.v]
        assert result.response.x_hat[0, 0] == pytest.approx(drawn[0])
        starts.add(result.response.x_hat[0, 0])
    assert len(starts) == 2
    many = ensemble(result, 3, over="noise")
    first = [many.variation.member(k).resets[-1].values[0, 0] for k in range(3)]
    assert [many.variation.member(k).z0[4] for k in range(3)] == pytest.approx(first)


def two_sensors(folder: Path, rows: str) -> Path:
    path = folder / "two.yaml"
    path.write_text(
        f"""
name: Two sensors that measure about the same
system:
  states: [z, v]
  inputs: [u]
  outputs: [y1, y2]
  sizes: {{z: 2, v: 2, y1: 3, y2: 3}}
  A: [[0, 1], [-2, -1]]
  B: [[0], [1]]
  C: {rows}
design: {{tracking: state}}
reference: {{state: ["0", "0"]}}
simulation: {{duration: 1, sample_time: 0.1, initial: {{plant: [3, 4], observer: measured}}}}
""",
        encoding="utf-8",
    )
    return path


@pytest.mark.parametrize(
    ("rows", "expected"), [("[[1, 0], [0, 1]]", [3, 4]), ("[[1, 0], [1, 0]]", [3, 0]), ("[[1, 1], [1, 1]]", [3.5, 3.5])]
)
def test_the_smallest_state_that_explains_all_sensors_is_taken(
    tmp_path: Path, rows: str, expected: list[float]
) -> None:
    result = simulate(load_spec(two_sensors(tmp_path, rows)))
    assert result.response.x_hat[0].tolist() == pytest.approx(expected)


def test_each_member_starts_from_its_own_measurement(specs: Path, tmp_path: Path) -> None:
    boxes = "ensemble: {initial: {plant: {z1: [-1, 1], v1: [-1, 1]}}, parameters: {k2: [0.3, 0.4]}}\n  initial"
    result = simulate(
        load_spec(paper(specs, tmp_path, "plant: [0.25, 0, 0, 0], observer: measured", "", ("initial", boxes)))
    )
    many = ensemble(result, 4)
    values = many.variation.values
    assert values["z1_hat"].tolist() == pytest.approx(values["z1"].tolist())
    assert len(set(values["z1_hat"].tolist())) == 4
    assert not values["v1_hat"].any()
    assert ensemble(result, 2, over="parameters").variation.member(1).z0[4] == pytest.approx(0.25)


def late(result: Result) -> float:
    """How far the generator goes away from where it was one period before, relative to its size."""
    response = result.response
    samples = round(1 / result.spec.scenario.sample_time)
    moved = response.eta_hat[samples:] - response.eta_hat[:-samples]
    return float(np.abs(moved).max() / np.abs(response.eta_hat).max())


def test_a_generator_in_steady_state_repeats_from_the_start(specs: Path, tmp_path: Path) -> None:
    steady, not_so = (
        simulate(load_spec(paper(specs, tmp_path, f"generator: {start}"))) for start in ("steady", "[0.2, 0]")
    )
    assert late(steady) < 1e-9
    assert late(not_so) > 1e-2
    assert steady.steady_state is not None
    np.testing.assert_allclose(steady.response.eta_hat[0], steady.steady_state.z[0, :2], rtol=1e-9)


@given(st.floats(-0.3, 0.3).filter(lambda y: abs(y) > 0.12))  # beyond the gap
@settings(max_examples=8)
def test_a_generator_starts_in_its_equilibrium_and_stays_until_the_reference_moves(
    tmp_path_factory: pytest.TempPathFactory, y: float
) -> None:
    specs, folder = Path("specs").absolute(), tmp_path_factory.mktemp("rest")
    reference = f"{{constant: {y!r}, step: {{size: 0.1, at: 1.25, smooth: 0.5}}}}"
    response = simulate(load_spec(paper(specs, folder, "generator: steady", reference))).response
    before = response.t < 1.24
    away = np.abs(response.eta_hat - response.eta_hat[0]).max(axis=1)
    assert away[before].max() < 1e-9
    assert away[-1] > 1e-4
    assert np.abs(response.eta_hat[0]).max() > 1e-5


def test_states_of_a_generator_have_names(specs: Path, tmp_path: Path) -> None:
    result = simulate(load_spec(paper(specs, tmp_path, "generator: {v2: 0.3}")))
    assert result.start[result.loop.at.eta_hat].tolist() == [0, 0.3]
    with pytest.raises(InvalidSpec, match=r"'v22' is no state of the generator: z2, v2; did you mean 'v2'"):
        simulate(load_spec(paper(specs, tmp_path, "generator: {v22: 0.3}")))


@pytest.mark.parametrize(
    ("initial", "reference", "said"),
    [
        ("generator: stedy", "", "'stedy' is neither 'steady' nor a list or mapping"),
        ("observer: stedy", "", "'stedy' is neither 'measured' or 'steady' nor a list or mapping"),
        ("plant: measured", "", "'measured' is neither 'steady' nor a list or mapping"),
    ],
)
def test_a_start_that_there_is_not_is_refused(
    specs: Path, tmp_path: Path, initial: str, reference: str, said: str
) -> None:
    path = paper(specs, tmp_path, initial, reference)
    error = refused(call("simulate", path, "--out", tmp_path / "out"), 2)
    line = 1 + path.read_text(encoding="utf-8").split("  initial:")[0].count("\n")
    assert f"{path}:{line}:" in error
    assert said in error


def balance(result: Result, y: float) -> np.ndarray:
    """What the second mass does at η̂(0) while the first one is held at y, by the plant."""
    plant = result.spec.problem.plant
    x = np.array([y, 0.0, *result.response.eta_hat[0]])
    cell = plant.partition.locate(x)
    return np.asarray((plant.A[cell] @ x + plant.b[cell])[2:])


@pytest.mark.parametrize("reference", ['{formula: "0.3 + 0.1*t", until: 9}', '"0.3*exp(-t)"', '"0.3 + sin(t)*exp(-t)"'])
@pytest.mark.parametrize("asked", [True, False])
def test_without_a_steady_state_a_generator_starts_where_the_reference_is_and_says_so(
    specs: Path, tmp_path: Path, reference: str, asked: bool
) -> None:
    result = simulate(
        load_spec(paper(specs, tmp_path, "generator: steady" if asked else "plant: {z1: 0.1}", reference))
    )
    assert np.abs(balance(result, 0.3)).max() < 1e-9
    assert np.abs(result.response.eta_hat[0]).max() > 1e-3
    said = [remark for remark in result.remarks if "there is no steady state" in remark]
    assert len(said) == asked
    assert not said or "begins neither at rest nor as a sum of sinusoids" in said[0]
    assert not said or "rests while the reference stays as it is at t = 0" in said[0]


def test_a_generator_begins_in_its_steady_state_where_nothing_is_said(specs: Path, tmp_path: Path) -> None:
    default, steady, zero = (
        simulate(load_spec(paper(specs, tmp_path, start))).response.eta_hat[0]
        for start in ("plant: [0.25, 0, 0, 0]", "generator: steady", "generator: [0, 0]")
    )
    assert default.tolist() == steady.tolist()
    assert np.abs(default).max() > 1e-3
    assert not zero.any()


GEAR = """name: geared drive with backlash, load speed tracked
parameters: {Jm: 0.002, Jl: 0.05, k: 80, c: 0.05, dm: 0.002, dl: 0.05, gap: 0.01}
system:
  states: [wm, q, wl]
  inputs: [T]
  outputs: [y]
  track: {load: wl}
  sizes: {wm: 1, wl: 1, q: 0.02, T: 2, y: 0.05}
  A: [[-(dm+c)/Jm, 0, c/Jm], [1, 0, -1], [c/Jl, 0, -(dl+c)/Jl]]
  B: [[1/Jm], [0], [0]]
  C: [[1, 0, 0]]
  nonlinearities:
    - {name: teeth, kind: dead_zone, of: q, lower: -gap, upper: gap, slope: k, into: {wm: -1/Jm, wl: 1/Jl}}
reference: {output: "20*sin(2*t)"}
simulation: {duration: 2, sample_time: 0.001, initial: {plant: [5, 0, 5]}}
"""


def test_the_feedforward_does_not_begin_with_a_transient_of_its_own(tmp_path: Path) -> None:
    """It began with −126 N m, where the load takes 6.4 N m."""
    path = tmp_path / "gear.yaml"
    path.write_text(GEAR, encoding="utf-8")
    u_ff = simulate(load_spec(path)).response.u_ff
    assert np.abs(u_ff).max() < 6.5


def test_where_a_generator_has_no_state_steady_has_nothing_to_do(tmp_path: Path) -> None:
    path = cart(tmp_path)
    text = path.read_text(encoding="utf-8")
    for initial in ("generator: steady", "plant: steady, generator: steady"):
        path.write_text(text.replace("plant: [0.05, 0]", initial), encoding="utf-8")
        assert simulate(load_spec(path)).outcome.code == 0
    state = two_sensors(tmp_path, "[[1, 0], [0, 1]]")
    state.write_text(state.read_text(encoding="utf-8").replace("observer: measured", "generator: steady"))
    assert simulate(load_spec(state)).remarks == ()


@pytest.mark.parametrize("reference", ["", "{constant: 0.2}", "{constant: 0.2, step: {size: -0.1, at: 2, smooth: 1}}"])
def test_a_plant_in_steady_state_follows_its_reference_from_the_start(
    specs: Path, tmp_path: Path, reference: str
) -> None:
    path = paper(specs, tmp_path, "plant: steady, observer: measured", reference)
    path.write_text(path.read_text(encoding="utf-8").replace("observer: measured", "observer: [0, 0, 0, 0]"))
    result = simulate(load_spec(path))
    np.testing.assert_array_equal(result.response.x[0], result.response.x_d[0])
    if reference:  # it rests
        plant, x, u = result.spec.problem.plant, result.response.x[0], result.response.u_ff[0]
        rates = [np.abs(A @ x + b + plant.B @ u).max() for A, b in zip(plant.A, plant.b, strict=True)]
        assert min(rates) < 1e-9
        assert x[0] == pytest.approx(0.2)
    exact = path.read_text(encoding="utf-8").replace(
        "observer: [0, 0, 0, 0]", f"observer: {result.response.x[0].tolist()}"
    )
    path.write_text(exact, encoding="utf-8")
    assert simulate(load_spec(path)).figures.largest_error < 1e-8


def test_a_plant_in_steady_state_goes_with_given_inputs(tmp_path: Path) -> None:
    path = two_sensors(tmp_path, "[[1, 0], [0, 1]]")
    text = path.read_text(encoding="utf-8").replace("plant: [3, 4], observer: measured", "plant: steady")
    for start in ("periodic", "[0.5, -1]"):
        path.write_text(text.replace('state: ["0", "0"]', f'input: ["sin(2*t)"], start: {start}'), encoding="utf-8")
        result = simulate(load_spec(path))
        np.testing.assert_allclose(result.response.x[0], result.response.x_d[0], atol=1e-12)
        assert np.abs(result.response.x[0]).max() > 0.1


def test_members_do_not_start_around_a_steady_plant_whose_place_is_not_known(specs: Path, tmp_path: Path) -> None:
    boxes = "ensemble: {initial: {plant: {z1: [-1, 1]}}}\n  initial"
    path = paper(specs, tmp_path, "plant: steady", "", ("initial", boxes))
    said = "simulation.ensemble.initial.plant: where 'plant: steady' is, is not known before the design"
    assert said in refused(call("check", path), 2)


def test_two_starts_of_an_observer_are_one_too_many(specs: Path, tmp_path: Path) -> None:
    boxes = "ensemble: {initial: {observer: {z1: [-1, 1]}}}\n  initial"
    path = paper(specs, tmp_path, "observer: measured", "", ("initial", boxes))
    said = "simulation.ensemble.initial.observer: each observer starts from what is measured then"
    assert said in refused(call("check", path), 2)


@pytest.mark.parametrize("reference", ["", "0.2 + 0*t"])
def test_an_observer_in_steady_state_begins_with_its_plant(specs: Path, tmp_path: Path, reference: str) -> None:
    path = paper(specs, tmp_path, "plant: steady, observer: steady", reference)
    result = simulate(load_spec(path))
    np.testing.assert_array_equal(result.response.x_hat[0], result.response.x_d[0])
    assert result.figures.largest_error < 1e-8
    path.write_text(path.read_text(encoding="utf-8").replace(", observer: steady", ""), encoding="utf-8")
    assert any("'observer: steady' begins there too" in remark for remark in simulate(load_spec(path)).remarks)


@pytest.mark.parametrize("command", ["check", "simulate"])
def test_a_generator_without_states_has_no_start(tmp_path: Path, command: str) -> None:
    path = two_sensors(tmp_path, "[[1, 0], [1, 0]]")
    text = (
        path.read_text(encoding="utf-8")
        .replace("{tracking: state}", "{}")
        .replace("[y1, y2]", "[y1, y2]\n  track: [y1]")
    )
    text = text.replace('{state: ["0", "0"]}', "{output: sin(t)}").replace("observer: measured", "generator: [1]")
    path.write_text(text, encoding="utf-8")
    run = call(command, path)
    assert run.exit_code == 2
    assert "simulation.initial.generator: the trajectory generator has no states here" in run.stderr
