"""Rounding: C in whole numbers is its plain reading in every bit, and no loop rounds more than is proved."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from math import floor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import nnls

from pwatrack import load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.claims.ranges import ProgramRanges
from pwatrack.commands.export import Subject, of_spec
from pwatrack.control.bounds import Channel
from pwatrack.control.program import SampledController
from pwatrack.errors import ExitCode, PwatrackError
from pwatrack.export.c import write
from pwatrack.export.controller import Controller
from pwatrack.export.fixed_point import FixedPoint
from pwatrack.export.reading import FULL, Reading, narrowed, nearest, run, stepped
from pwatrack.export.rounding import Rounding, beside_cells, largest, of_run, units_of
from pwatrack.export.source import Source
from tests.beside import beside
from tests.exported import machine_of, with_pieces
from tests.misra import checked, listed
from tests.test_cli import call, refused
from tests.test_export_c import built
from tests.test_ranges import MORE
from tests.test_sampled_bounds import FRICTION, TANK
from tests.tools import COMPILERS, SANE

COARSE = 2.0**12  # times the units that are needed: what 20 bits would have
KINDS = {
    "friction": FRICTION,
    "load": MORE["a load at the input that steps"],
    "late": MORE["late"],
    "late with a load": MORE["late, with a load at the input that steps"],
    "steps": f"{FRICTION.rstrip()}\n  quantum: {{u: 0.01, y: 1e-4}}\n",
}


@given(st.integers(-(2**62), 2**62), st.integers(0, 56))
def test_a_number_is_rounded_to_nearest_and_cut_off_where_32_bits_end(value: int, shift: int) -> None:
    right = floor(Fraction(value, 2**shift) + Fraction(1, 2))
    assert nearest(value, 2**shift) == right
    assert narrowed(value, 2**shift) == max(-FULL, min(FULL, right))
    assert stepped(value, 2**shift) == right * 2**shift


@given(st.integers(1, 3), st.integers(1, 4), st.randoms(use_true_random=False))
def test_a_point_that_planes_contradict_by_little_is_near_the_cell(n: int, planes: int, random: object) -> None:
    rng = np.random.default_rng(getattr(random, "randrange")(2**32))  # noqa: B009
    H, signs = rng.normal(size=(planes, n)), rng.choice([-1, 0, 1], size=(1, planes))
    h = signs[0] * rng.uniform(0, 1, size=planes)  # so that 0 is in the cell
    x, chosen = 2 * rng.normal(size=n), signs[0] != 0
    off = np.maximum(-signs[0] * (H @ x + h), 0.0)
    program = of_cells(H, h, signs)
    most = beside_cells(program, off)
    rows = (signs[0][:, None] * H)[chosen]
    assert (np.abs(shortest(rows, -(rows @ x + (signs[0] * h)[chosen]))) <= most + 1e-7).all()


def shortest(G: Array, g: Array) -> Array:
    """Return the shortest d with G d ≥ g (Lawson and Hanson 1974, chapter 23)."""
    if not len(G):
        return np.zeros(G.shape[1])
    E, f = np.vstack([G.T, g]), np.append(np.zeros(G.shape[1]), 1.0)
    r = E @ nnls(E, f)[0] - f
    return np.asarray(-r[:-1] / r[-1])


def of_cells(H: Array, h: Array, signs: NDArray[np.int64]) -> SampledController:
    from pwatrack.simulation.controller_arrays import NONE

    return replace(NONE, H=H, h=h, signs=signs)


def source(subject: Subject, *, given: bool = False) -> Source:
    return Source(file=subject.file, name="loop", single=False, given=given, unproved=subject.unproved)


def in_sight(code: Source, subject: Subject) -> Source:
    """Code in whole numbers for twice what the numbers are in the test vector: no range is proved."""
    floats = code.step
    seen = run(floats, subject.vector.y, subject.vector.w)
    at = code.program.places
    most = {name: 2 * np.abs(seen["v"][:, at[name]]).max(axis=0) for name in ("y", "u", "s_hat", "eta_hat", "w")}
    x = 2 * np.maximum(np.abs(seen["v"][:, at["x_hat"]]), np.abs(seen["x_d"])).max(axis=0)
    units = units_of(code.program, {**most, "x_hat": x, "x_d": x})
    return replace(code, whole=FixedPoint(program=code.program, units=units, starts=code.starts))


@pytest.mark.slow
@pytest.mark.skipif(not COMPILERS, reason="no C compiler is installed")
@pytest.mark.parametrize("of", ["machine", "outside", "pieces"])
def test_c_is_the_plain_reading_in_every_bit(of: str, tmp_path: Path) -> None:
    """With a reference from inside and outside; inputs late, in steps and with limits, E, and pieces that end."""
    subject = with_pieces(tmp_path) if of == "pieces" else machine_of(1000)
    code = in_sight(source(subject, given=of == "outside"), subject)
    y = subject.vector.y.copy()
    y[700:][np.random.default_rng(1).random(y[700:].shape) < 0.2] = 1e30  # and what no sensor should give
    y[800:] *= np.random.default_rng(2).choice([-1, 1], size=y[800:].shape)
    vector = replace(subject.vector, y=y, w=subject.vector.w if code.given else np.zeros((len(y), 0)))
    write(code, vector, tmp_path / of)
    main = tmp_path / of / "main.c"
    main.write_text(main.read_text().replace("status < LOOP_OK", "status > LOOP_ENDED"))  # what is refused is compared
    for options in ("-O0", "-O2", f"-O1 {SANE}"):
        assert f"{len(vector.y)} steps, 0 wrong" in built(tmp_path / of, COMPILERS[0], options)
    assert "double" not in (tmp_path / of / "loop.c").read_text()
    assert "float" not in (tmp_path / of / "loop.c").read_text()


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("cppcheck"), reason="cppcheck is not installed")
def test_misra_finds_only_the_deviations_that_are_listed(tmp_path: Path) -> None:
    subject = with_pieces(tmp_path)
    write(in_sight(source(subject), subject), subject.vector, tmp_path / "code")
    found = checked(tmp_path / "code")
    assert found.broken <= listed(), found.said
    assert not found.others, found.said


def test_whole_numbers_do_what_floats_do(tmp_path: Path) -> None:
    """To a few units of each number, in a run with all that an input can have."""
    subject = with_pieces(tmp_path)
    code = in_sight(source(subject), subject)
    assert code.whole is not None
    nothing = np.zeros((len(subject.vector.y), 0))
    real = run(source(subject).step, subject.vector.y, nothing)
    made = run(code.step, code.whole.counts("y", subject.vector.y), nothing)
    assert (made["status"] == real["status"]).all()
    assert np.abs(made["x_d"] * code.whole.units["x_hat"] - real["x_d"]).max() <= 1e-6 * np.abs(real["x_d"]).max()
    off = np.abs(made["u"] * code.whole.units["u"] - real["u"])
    assert (off[:-20] <= 0.01 + 1e-9).all()  # a step of the input
    assert np.mean(off > 1e-9) < 0.02


@pytest.fixture(scope="module", params=KINDS)
def rounded(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Subject, Rounding]:
    """A controller in whole numbers, in units that are coarser than need be, so that rounding is seen."""
    path = tmp_path_factory.mktemp("whole") / "plant.yaml"
    path.write_text(KINDS[request.param], encoding="utf-8")
    subject = of_spec(load_spec(path))
    assert subject.controller is not None
    assert subject.spec is not None
    code = source(subject)
    ticks = int(subject.spec.scenario.duration / code.program.sampling.sample_time) + 1
    found = of_run(subject.controller, code, "int32", np.zeros((ticks, 0)))
    coarse = {name: unit * COARSE for name, unit in found.numbers.units.items()}
    return subject, replace(found, numbers=replace(whole(found), units=coarse))


def whole(found: Rounding) -> FixedPoint:
    assert isinstance(found.numbers, FixedPoint)
    return found.numbers


def ran(subject: Subject, step: Callable[[Array], Array], seed: int) -> tuple[Array, Array]:
    """Return x and u of the plant at ticks, beside a program, with noise as large as it may be."""
    assert subject.controller is not None
    assert subject.spec is not None
    spec, controller = subject.spec, subject.controller
    plant, bounds = controller.plant, controller.claim(ProgramRanges).bounds
    h, disturbance = bounds.errors.gains.sample_time, spec.scenario.conditions.disturbance
    x = simulate(spec, controller).response.x[0]
    random, u = np.random.default_rng(seed), list[Array]()

    def put_out(_: int, x: Array) -> Array:
        u.append(step(plant.C @ x + random.choice([-1, 1]) * bounds.noise))
        return u[-1]

    loads, ticks = None if plant.loads is None else disturbance, int(spec.scenario.duration / h)
    found = beside(plant, put_out, x, ticks=ticks, h=h, disturbance=loads)
    return found, np.array(u)


def whole_of(found: Rounding) -> tuple[Callable[[Array], Array], list[dict[str, object]]]:
    """Return what steps a program in whole numbers with real ones, and where it writes what it remembers."""
    reading, seen = Reading(whole(found).step), list[dict[str, object]]()

    def step(y: Array) -> Array:
        seen.append(reading.step(whole(found).counts("y", y).tolist()))
        return np.asarray(np.array(seen[-1]["u"]) * found.numbers.units["u"])

    return step, seen


def ticks(found: Rounding, **changes: Any) -> tuple[Array, dict[str, Array]]:
    """Return y, at random in a hundredth of its range, and what a program with some other tables remembers of it."""
    numbers = replace(whole(found), program=replace(found.numbers.program, **changes))
    units, most = numbers.units, largest(found.ranges, found.given)
    y = np.random.default_rng(1).uniform(-0.01, 0.01, size=(300, len(units["y"]))) * most["y"]
    seen = run(numbers.step, numbers.counts("y", y), np.zeros((len(y), 0)))
    assert (seen["status"] >= 0).all()
    at = numbers.program.places
    return y, {name: seen["v"][:, at[name]] * units[name] for name in ("u", "x_hat", "s_hat", "eta_hat", "w")} | {
        "x_d": seen["x_d"] * units["x_hat"],
        "cell_d": seen["cell_d"],
    }


@pytest.mark.slow
def test_a_prediction_rounds_by_no_more_than_is_said(rounded: tuple[Subject, Rounding]) -> None:
    _, found = rounded
    of = found.numbers.program
    _, seen = ticks(found, M=np.zeros_like(of.M))
    x = np.hstack([seen["x_hat"], seen["s_hat"]])
    off = np.zeros_like(x[1:])
    for row, before, u, after in zip(off, x[:-1], seen["u"][:-1], x[1:], strict=True):
        z = before
        for _ in range(of.substeps):
            i = np.maximum(-of.signs * (of.H @ z[: of.H.shape[1]] + of.h), 0.0).max(axis=1).argmin()
            z = of.observer[i] @ np.concatenate([u, z, [1.0]])
        row[:] = np.abs(after - z)
    most, m, N = np.zeros(x.shape[1]), len(of.K), len(of.M)
    for _ in range(of.substeps):  # what one substep rounds the next one takes on
        most = np.abs(of.observer[:, :, m : m + N]).max(axis=0) @ most + found.predicted / of.substeps
    assert (off <= most * 1.0001).all()
    assert (off.max(axis=0) >= 0.1 * most)[: of.H.shape[1]].any()


def test_a_correction_rounds_by_no_more_than_is_said(rounded: tuple[Subject, Rounding]) -> None:
    _, found = rounded
    of = found.numbers.program
    m, N = len(of.K), len(of.M)
    y, seen = ticks(found, observer=np.zeros_like(of.observer) + np.eye(N, m + N + 1, m))
    x = np.hstack([seen["x_hat"], seen["s_hat"]])
    off = np.abs(x[1:] - x[:-1] - (x[:-1] @ of.C.T - y[1:]) @ of.M.T)
    assert (off <= found.corrected * 1.0001).all()
    assert (off.max(axis=0) >= 0.5 * found.corrected).all()


def test_a_law_rounds_by_no_more_than_is_said(rounded: tuple[Subject, Rounding]) -> None:
    _, found = rounded
    of = found.numbers.program
    if of.quantum.any() or of.sampling.ahead:
        return  # u is in steps there, or of what is predicted
    _, seen = ticks(found, M=np.zeros_like(of.M))
    known = np.hstack([*(seen[name] for name in ("s_hat", "eta_hat", "w")), np.ones((len(seen["u"]), 1))])
    u_ff = np.einsum("kmc,kc->km", of.u_ff[seen["cell_d"]], known)
    off = np.abs(seen["u"] - u_ff - (seen["x_hat"] - seen["x_d"]) @ of.K.T)
    assert (off <= found.law * 1.0001).all()
    assert (off.max(axis=0) >= 0.2 * found.law).all()


def test_what_is_stepped_is_off_by_what_is_said(rounded: tuple[Subject, Rounding]) -> None:
    """x_d and u_ff of the run, beside those of the program in floats that was proved."""
    subject, found = rounded
    of, nothing = whole(found), np.zeros((len(found.given), len(found.numbers.units["y"])))
    real, made = run(source(subject).step, nothing, found.given), run(of.step, nothing.astype(int), found.given)
    off = (made["x_d"] * of.units["x_hat"] - real["x_d"]) @ of.program.K.T
    assert (np.abs(off).max(axis=0) <= 10 * found.put_out).all()
    assert (found.put_out > found.law).all()


def test_no_loop_rounds_more_than_is_proved(rounded: tuple[Subject, Rounding]) -> None:
    """Beside an independent plant: in 20 bits, so that rounding is more than all else that is left."""
    subject, found = rounded
    controller = subject.controller
    assert controller is not None
    bounds, known = found.bounds, found.ranges.bounds
    step, seen = whole_of(found)
    x, _ = ran(subject, step, 1)
    assert {each["status"] for each in seen} <= {0, 1}
    x_d = np.array([each["x_d"] for each in seen]) * found.numbers.units["x_hat"]
    parts, late = known.errors.gains.substeps, known.errors.gains.delay  # x_d is that of the time at which u acts
    off = np.abs((x[late:] - x_d[: len(x) - late]) @ controller.plant.tracked.T)
    most = bounds.from_start["output", 0][::parts][late:][: len(off)]
    real = known.from_start["output", 0][::parts][late:][: len(off)]
    assert (off[:, 0] <= most * (1 + 1e-9) + 1e-9).all()
    assert (most >= real).all()
    assert most[-1] > 1.02 * real[-1]


def test_single_floats_are_within_what_is_said_of_them(rounded: tuple[Subject, Rounding]) -> None:
    """A loop in single floats beside one in doubles, with the same noise: less apart than what rounding may leave."""
    subject, found = rounded
    controller = subject.controller
    assert controller is not None
    code = source(subject)
    single = of_run(controller, code, "float32", found.given)
    steps = {kind: Controller(subject.file, single=kind) for kind in (False, True)}
    x, other = (ran(subject, one.step, 4)[0] for one in steps.values())
    off = np.abs((x - other) @ controller.plant.tracked.T)[:, 0]
    real, most = found.ranges.bounds.ends_below(controller), single.bounds.ends_below(controller)
    assert off.max() <= most["output", 0] - real["output", 0] or code.program.quantum.any()
    assert 0 < most["output", 0] - real["output", 0] < 0.1


def test_no_number_leaves_its_range(rounded: tuple[Subject, Rounding]) -> None:
    subject, found = rounded
    step, seen = whole_of(found)
    ran(subject, step, 2)
    at, units = source(subject).program.places, found.numbers.units
    most = largest(replace(found.ranges, bounds=found.bounds), found.given)
    for name in ("y", "u", "x_hat", "s_hat", "eta_hat", "w"):
        values = np.array([each["v"] for each in seen])[:, at[name]] * units[name]
        assert (np.abs(values).max(axis=0, initial=0.0) <= most[name] + units[name]).all(), name


def test_the_difference_to_floats_is_within_what_rounding_adds(rounded: tuple[Subject, Rounding]) -> None:
    """Of two loops with the same noise, one in floats: they differ by at most what rounding may leave."""
    subject, found = rounded
    floats = Reading(source(subject).step)
    step, _ = whole_of(found)
    x, _ = ran(subject, step, 3)
    other, _ = ran(subject, lambda y: np.array(floats.step(y.tolist())["u"]), 3)
    assert subject.controller is not None
    off = np.abs((x - other) @ subject.controller.plant.tracked.T)[:, 0]
    bounds, count = found.bounds, len(found.bounds.acts.near)
    squares: dict[Channel, Array] = {
        ("rounding", 0): bounds.acts.squares["rounding", 0],
        ("input", 0): np.full(count, found.put_out[0] ** 2),
    }
    alone = replace(bounds, acts=replace(bounds.acts, squares=squares))
    tracked = np.pad(
        subject.controller.plant.tracked, ((0, 0), (0, bounds.errors.order - len(subject.controller.plant.B)))
    )
    assert off.max() <= alone.off(tracked)[0]
    assert off.max() > 0 or found.numbers.program.quantum.any()  # steps may hide it


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (FRICTION.replace("{sample_time: 0.1}", "{sample_time: 0.1, method: emulated}"), "emulated"),
        (MORE["a load that moves x_d"], "depend on estimates that are no constants"),
    ],
)
def test_what_is_not_made_in_whole_numbers_is_refused(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "plant.yaml").write_text(text, encoding="utf-8")
    run = call("export", "c", tmp_path / "plant.yaml", "--out", tmp_path / "c", "--int32")
    line = refused(run, ExitCode.OUTSIDE_THEORY)
    assert said in line
    assert "--float32" in line
    assert not (tmp_path / "c").exists()
    run = call("export", "c", tmp_path / "plant.yaml", "--out", tmp_path / "c", "--float32")
    assert run.exit_code == 0, run.output
    unknown = "What single floats add to the bounds of its run is not proved: "
    assert said in " ".join(run.stdout.split()).partition(unknown)[2]
    assert unknown in " ".join(next((tmp_path / "c").glob("*.h")).read_text(encoding="utf-8").split())


@pytest.mark.slow
def test_a_reference_from_outside_gives_numbers_room_for_what_it_lacks() -> None:
    """Half a sample of the last derivative, which is more than a thousandth of what u is at most."""
    subject = machine_of(1000)
    told = subject.rounded(source(subject, given=True), "int32").rounding
    assert "no number leaves its range" in told
    assert "with real numbers and its own reference" in told


def exported(text: str, folder: Path) -> tuple[Subject, Rounding]:
    (folder / "plant.yaml").write_text(text, encoding="utf-8")
    subject = of_spec(load_spec(folder / "plant.yaml"))
    assert subject.controller is not None
    assert subject.spec is not None
    subject.rounded(source(subject), "int32")  # which refuses what does not fit
    ticks = int(subject.spec.scenario.duration / source(subject).program.sampling.sample_time) + 1
    return subject, of_run(subject.controller, source(subject), "int32", np.zeros((ticks, 0)))


def test_an_input_may_swing_from_one_end_of_its_range_to_the_other(tmp_path: Path) -> None:
    swinging = FRICTION.replace("frequency: 4", "frequency: 30").replace("amplitude: 0.3", "amplitude: 0.055")
    subject, found = exported(swinging, tmp_path)
    step, seen = whole_of(found)
    _, u = ran(subject, step, 5)
    assert np.abs(np.diff(u, axis=0)).max() > 2.0**31 * found.numbers.units["u"][0]
    assert {each["status"] for each in seen} == {0}


def test_steps_larger_than_the_input_fit(tmp_path: Path) -> None:
    text = f"name: A tank\nsystem:\n{TANK}: {{output: {{sine: {{amplitude: 0.01, frequency: 4}}}}}}\n"
    text += "design: {controller: {K: [[-0.0001]]}}\nsimulation:\n  {duration: 8, sample_time: 0.01, "
    _, found = exported(text + "controller: {sample_time: 0.1}, quantum: {u: 1}}\n", tmp_path)
    assert 0 < whole(found).step.constants["quantum"][1].max() <= 2**30


BESIDE = """
name: A tank beside another
system:
  {states: [x, z], inputs: [u], outputs: [y], B: [[1], [0]], C: [[1, 0]], cells: [{name: all, A: [[-1, 1], [1, -3]]}]}
reference: {output: {sine: {amplitude: 0.1, frequency: 1}}}
simulation:  # its members start with other η̂, so that of its start nothing is proved
  duration: 6
  sample_time: 0.01
  controller: {sample_time: 0.1, delay: 1}
  ensemble: {initial: {generator: [[-0.1, 0.1]]}}
  START
"""


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            BESIDE.replace("START", "initial: {plant: [50, 0], observer: [0, 0], generator: [0]}"),
            "out of range at tick 0",
        ),
        (
            FRICTION.replace("{sine: {amplitude: 0.3, frequency: 4}}", "{step: {size: 30, at: 12, smooth: 1}}"),
            "do not hold",
        ),
    ],
)
def test_a_start_or_a_reference_beyond_the_ranges_is_refused(text: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(PwatrackError, match=said):
        exported(text, tmp_path)


def test_numbers_that_32_bits_do_not_hold_are_refused(rounded: tuple[Subject, Rounding]) -> None:
    _, found = rounded
    small = {name: unit / 2.0**14 for name, unit in found.numbers.units.items()}
    with pytest.raises(PwatrackError, match="32 bits"):
        _ = replace(found, numbers=replace(whole(found), units=small)).bounds


def test_a_number_out_of_range_is_refused_and_the_input_is_held(rounded: tuple[Subject, Rounding]) -> None:
    _, found = rounded
    step, seen = whole_of(found)
    q = len(found.numbers.units["y"])
    step(np.zeros(q))
    before, kept = seen[-1]["u"], seen[-1]["v"]
    step(np.full(q, 1e9))
    assert [seen[-1]["status"]] == [-1]
    assert (seen[-1]["u"], seen[-1]["v"]) == (before, kept)
    step(np.zeros(q))
    assert [seen[-1]["status"]] == [0]


@pytest.mark.slow
def test_the_command_says_what_is_proved(tmp_path: Path) -> None:
    (tmp_path / "plant.yaml").write_text(FRICTION, encoding="utf-8")
    call("design", tmp_path / "plant.yaml", "--out", tmp_path / "run")
    said = call("export", "c", tmp_path / "run", "--out", tmp_path / "c", "--int32").stdout
    assert "In whole numbers of 32 bits, in the run of its spec" in said
    header = next(path for path in (tmp_path / "c").glob("*.h") if path.name != "vector.h").read_text()
    assert "In whole numbers of 32 bits, in the run of its spec" in header
    assert "Y0_UNIT" in header
    two = call("export", "c", tmp_path / "run", "--out", tmp_path / "d", "--int32", "--float32")
    assert two.exit_code == 2
    assert "one kind" in two.output
    (tmp_path / "run" / "spec.txt").unlink()
    (tmp_path / "plant.yaml").unlink()
    alone = call("export", "c", tmp_path / "run", "--out", tmp_path / "e", "--int32")
    assert "needs the ranges" in refused(alone, ExitCode.INVALID)
