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
@settings(max_examples=15, deadline=None)
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
        ("generator: steady", '{formula: "0.1*t", until: 9}', "begins neither at rest nor as a sum of sinusoids"),
        ("generator: steady", '"exp(-t)"', "begins neither at rest nor as a sum of sinusoids"),
        ("generator: steady", '"sin(t) + sin(sqrt(2)*t)"', "begins neither at rest nor as a sum of sinusoids"),
        ("generator: stedy", "", "'stedy' is not 'steady'"),
        ("observer: steady", "", "'steady' is not 'measured'"),
        ("plant: measured", "", "a list is expected"),
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


def test_a_generator_without_a_state_cannot_be_in_steady_state(tmp_path: Path) -> None:
    path = cart(tmp_path)
    path.write_text(path.read_text(encoding="utf-8").replace("plant: [0.05, 0]", "generator: steady"), encoding="utf-8")
    assert "the trajectory generator has no state" in refused(call("simulate", path, "--out", tmp_path / "out"), 2)
    state = two_sensors(tmp_path, "[[1, 0], [0, 1]]")
    state.write_text(state.read_text(encoding="utf-8").replace("observer: measured", "generator: steady"))
    assert "there is no trajectory generator" in refused(call("simulate", state, "--out", tmp_path / "out"), 2)


def test_two_starts_of_an_observer_are_one_too_many(specs: Path, tmp_path: Path) -> None:
    boxes = "ensemble: {initial: {observer: {z1: [-1, 1]}}}\n  initial"
    path = paper(specs, tmp_path, "observer: measured", "", ("initial", boxes))
    said = "simulation.ensemble.initial.observer: each observer starts from what is measured then"
    assert said in refused(call("check", path), 2)
