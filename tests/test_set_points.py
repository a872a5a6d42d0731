"""What a program makes of set-points keeps its limits, and arrives as early as can be: third-order optima, a linear
program and a plain reading of `docs/arithmetic.md` say so.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy
from hypothesis import example, given
from hypothesis import strategies as st
from numba import njit

from pwatrack import Controller, load_spec
from pwatrack.arrays import Array
from pwatrack.commands.export import Subject, of_spec
from pwatrack.control.program import PACE, SampledController
from pwatrack.errors import InvalidSpec, OutsideTheory
from pwatrack.export.fmu import Version, c_compiler, packed, write_fmu
from pwatrack.export.fmu_models import controller_model
from pwatrack.export.source import Source
from pwatrack.export.stored import digest, parsed, runs
from pwatrack.simulation import kernel
from pwatrack.simulation.controller_arrays import memory, routine
from tests.fmus import Block
from tests.plain import Plain
from tests.test_export_c import built
from tests.test_export_c import written as written_in_c
from tests.test_export_mat import octave, said
from tests.test_export_mat import written as written_in_matlab
from tests.test_export_st import both
from tests.tools import COMPILERS

LIMITS = dict(zip(PACE, (0.5, 2.0, 40.0, 4000.0, 4e5), strict=True))
RELATIVE = 1e-12  # what rounding may add to a limit, beside what a difference of doubles divided by a sample time does


def chain(degree: int, **changes: Any) -> dict[str, Any]:
    """As many integrators as the relative degree is to be."""
    zeros = [0.0] * (degree - 1)
    return {
        "name": "Chain",
        "system": {
            "states": [f"x{k}" for k in range(degree)],
            "inputs": ["u"],
            "outputs": ["y"],
            "A": np.eye(degree, k=1).tolist(),
            "B": [*([v] for v in zeros), [1.0]],
            "C": [[1.0, *zeros]],
        },
        "reference": {
            "output": {"constant": 0.1},
            "outside": {"filter": {"y": dict(list(LIMITS.items())[: max(degree, 3)]) | changes}},
        },
        "simulation": {"duration": 1, "sample_time": 0.01, "controller": {"sample_time": 0.001}},
    }


@cache
def subject(degree: int) -> Subject:
    """With a range that set-points of some tests are beyond."""
    return of_spec(load_spec(chain(degree, range=[-0.05, 0.12])), given=True, steps=300)


def program(degree: int, limits: Any, h: float, start: float = 0.0, ends: Any = (-np.inf, np.inf)) -> SampledController:
    """A program whose law is of no interest here: what it makes of set-points is."""
    found = runs(subject(degree).file, given=True)
    return replace(
        found,
        pace=np.array([[start, *limits]]),
        set_range=np.array([ends]),
        sampling=replace(found.sampling, sample_time=h),
        K=0 * found.K,
    )


@njit
def ticked(table: Any, kept: Array, counts: Any, room: Array, set_points: Array, found: Array) -> int:
    y = np.zeros(1, dtype=kept.dtype)
    for k in range(len(set_points)):
        if kernel.tick(table, kept, counts, room, y, set_points[k : k + 1]) != 0:
            return k
        found[k] = kept
    return len(set_points)


class Made:
    """What a program makes of set-points: w, and (distance, speed, acceleration, set-point) at the next tick."""

    def __init__(self, found: SampledController, set_points: Any, state: Any = (0.0, 0.0, 0.0)) -> None:
        kept, at = memory(found, np.zeros(found.sizes["N"]), np.zeros(0)), found.places
        kept["memory"][at["course"]][:3] = state
        made = np.zeros((len(set_points), len(kept["memory"])))
        args = (*(kept[name] for name in ("memory", "counts", "room")), np.array(set_points), made)
        assert ticked(routine(found), *args) == len(set_points)
        self.w, self.course = made[:, at["w"]], made[:, at["course"]]


def sequence(random: np.random.Generator, degree: int) -> tuple[Array, float, Array]:
    """Limits, a sample time and set-points of all sizes: near, far, back again, held for one sample or many."""
    V, A, J, S, C = np.cumprod(10 ** random.uniform([-2, -1, -1, 0.3, 0.3], [2, 2, 2, 1.3, 1.3]))
    h = min(A / J, V / A) * 10 ** random.uniform(-2, 0.5)
    h = h if degree < 4 else max(h, *([2 * J / S / 200, 2 * S / C / 200][: degree - 3]))
    span = V * (V / A + A / J)
    sizes = span * 10 ** random.uniform(-6, 0.5, 8) * random.choice([-1, 0, 1], 8)
    return np.array([V, A, J, S, C]), h, np.repeat(sizes, random.choice([1, 2, 5, 20, 60], 8))


@pytest.mark.slow
@pytest.mark.parametrize("degree", [1, 2, 3, 4, 5])
def test_no_sequence_of_set_points_takes_a_derivative_beyond_its_limit(degree: int) -> None:
    """10,000 sequences in all. Each entry of w is what the entry below it changes by, which nothing limits there."""
    random, used = np.random.default_rng(degree), np.zeros(5)
    for _ in range(2000):
        limits, h, set_points = sequence(random, degree)
        made = Made(program(degree, limits[: max(degree, 3)], h), set_points)
        w = made.w
        assert (np.abs(w[:, 1:]) <= limits[:degree]).all()
        used[:degree] = np.maximum(used[:degree], np.abs(w[:, 1:]).max(axis=0) / limits[:degree])
        V, A, J = limits[:3]
        d, v, a, r = made.course.T
        assert np.abs(v).max() <= V * (1 + RELATIVE)
        assert np.abs(a).max() <= A * (1 + RELATIVE)
        y = r - d
        unit = np.abs(set_points).max() * 2.0**-50 + RELATIVE * (V * h + A * h**2 + J * h**3)
        assert np.abs(np.diff(a)).max() <= J * h * (1 + RELATIVE) + A * RELATIVE
        assert np.abs(np.diff(v) - a[:-1] * h).max() <= J * h**2 / 2 * (1 + RELATIVE) + (V + A * h) * RELATIVE
        step = v[:-1] * h + a[:-1] * h**2 / 2
        near = 2.0**-26 * min(V * h, A * h**2, J * h**3)  # where it is at rest, and this near, it is there
        assert np.abs(np.diff(y) - step).max() <= J * h**3 / 6 + near + unit
        for k in range(1, degree):  # y⁽ᵏ⁾ goes on as its derivatives say, but for what the last one does in a sample
            later = sum(w[:-1, k + i] * h**i / float(scipy.special.factorial(i)) for i in range(degree - k + 1))
            spread = 2 * limits[degree - 1] * h ** (degree - k) + (limits[k - 1] + limits[k] * h) * 1e-9
            assert np.abs(w[1:, k] - later).max() <= spread
    assert (used[:degree] > 0.99).all()


@pytest.mark.parametrize("degree", [1, 2, 3, 4, 5])
def test_no_sequence_of_set_points_takes_it_out_of_its_range(degree: int) -> None:
    """Set-points beyond it count as its ends: it is as if these were given, and y_d needs not be cut off there."""
    random = np.random.default_rng(degree)
    for _ in range(300):
        limits, h, set_points = sequence(random, degree)
        low, high = np.sort(random.uniform(-1, 1, 2) * np.abs(set_points).max())
        low, high = min(low, 0.0) - 1e-9, max(high, 0.0) + 1e-9
        made = Made(program(degree, limits[: max(degree, 3)], h, ends=(low, high)), set_points)
        other = Made(program(degree, limits[: max(degree, 3)], h), np.clip(set_points, low, high))
        assert made.w[:, 0].min() >= low
        assert made.w[:, 0].max() <= high
        assert (made.course == other.course).all()
        V, A, J = limits[:3]
        off = 1e-12 * (high - low) + (J * h**3 if degree > 3 else 2.0**-26 * min(V * h, A * h**2, J * h**3))
        assert np.abs(made.w - other.w)[:, 0].max() <= off


def optimum(D: float, V: float, A: float, J: float) -> float:
    """The shortest time from rest to rest within three limits, in closed form: A before V, or V before A."""
    if V * J < A * A:
        A = np.sqrt(V * J)
    if D >= V * (V / A + A / J):
        return D / V + V / A + A / J
    if D >= 2 * A**3 / J**2:
        return float(A / J + np.sqrt((A / J) ** 2 + 4 * D / A))
    return float(4 * np.cbrt(D / (2 * J)))


_SIZES = st.floats(-3, 3).map(lambda x: 10.0**x)


@given(_SIZES, _SIZES, _SIZES, st.floats(-4, 3), st.floats(-2, 3), st.sampled_from([-1.0, 1.0]))
def test_from_rest_to_rest_takes_the_shortest_time_there_is(
    V: float, A: float, J: float, size: float, fine: float, sign: float
) -> None:
    """And nothing is beyond the set-point, nor goes back; there, all derivatives are exactly 0."""
    D = V * min(V / A, A / J, np.sqrt(V / J)) * 10**size
    best = optimum(D, V, A, J)
    h = max(best / 20_000, best / 30 * 10**fine)
    made = Made(program(3, (V, A, J), h), np.full(int(best / h) + 4, sign * D))
    y = sign * (made.course[:, 3] - made.course[:, 0])
    arrived = int(np.argmax((made.course[:, :3] == 0).all(axis=1))) + 1
    assert best - h * 1e-6 <= arrived * h * (1 + 1e-9)
    assert arrived * h < best + 2 * h
    assert (made.course[arrived:, :3] == 0).all()
    assert (np.diff(y) >= -1e-12 * D).all()
    assert y.max() <= D * (1 + 1e-14) + 2.0**-26 * J * h**3  # rounding, and where it counts as there
    assert (made.w[arrived + 1 :] == [sign * D, 0, 0, 0]).all()


@given(st.sampled_from([4, 5]), st.integers(0, 10**6))
def test_with_snap_and_crackle_it_takes_the_windows_more(degree: int, seed: int) -> None:
    limits, h, set_points = sequence(np.random.default_rng(seed), degree)
    D, found = np.abs(set_points).max() + 1e-3 * limits[0] * h, program(degree, limits[:degree], h)
    best, windows = optimum(D, *limits[:3]), int(found.windows.sum())
    w = Made(found, np.full(min(int(best / h), 20_000) + windows + 4, D)).w
    arrived = int(np.argmax((w == [D, *np.zeros(degree)]).all(axis=1)))
    if best / h < 20_000:
        assert best + windows * h - 2 * h <= arrived * h <= best + windows * h + 3 * h
        assert (w[arrived:] == [D, *np.zeros(degree)]).all()
    assert w[:, 0].max() <= D * (1 + 1e-12) + limits[2] * h**3


@pytest.mark.slow
def test_each_of_two_outputs_goes_its_own_way() -> None:
    """Side by side in w, derivative by derivative, each in every bit what it is alone."""
    one, rows = chain(2), [[0.5, 2.0, 40.0], [3.0, 1.0, 5.0]]
    system: dict[str, Any] = {"states": ["s1", "s2", "s3", "s4"], "inputs": ["i1", "i2"], "outputs": ["o1", "o2"]}
    for name in ("A", "B", "C"):
        block = np.array(one["system"][name], dtype=float)
        system[name] = scipy.linalg.block_diag(block, block).tolist()
    paces = {f"o{k}": dict(zip(PACE, row, strict=False)) for k, row in enumerate(rows, 1)}
    reference = {"output": {f"o{k}": {"constant": 0} for k in (1, 2)}, "outside": {"filter": paces}}
    both_of = of_spec(load_spec(one | {"system": system, "reference": reference}), given=True, steps=5).file
    controller, random = Controller(both_of), np.random.default_rng(1)
    set_points = np.repeat(random.normal(size=(8, 2)), 50, axis=0)
    alone = [Made(program(2, row, 1e-3), set_points[:, k]).w for k, row in enumerate(rows)]
    for k, r in enumerate(set_points):
        controller.step([0.0, 0.0], r)
        wanted = np.array([alone[0][k], alone[1][k]]).T.ravel()
        assert controller.state("w").tobytes() == wanted.tobytes()


def on_a_grid(state: Any, limits: Any, h: float, count: int) -> bool:
    """Whether so many samples of a jerk that is held in each can bring it to rest at 0: a linear program."""
    V, A, J = limits
    F = scipy.linalg.expm(h * np.eye(4, k=1))
    F, G = F[:3, :3], F[:3, 3]
    powers = [np.eye(3)]
    for _ in range(count):
        powers.append(F @ powers[-1])
    columns = np.array([P @ G for P in powers[:-1]])  # of the jerk so many samples ago
    rows, most = list[Array](), list[float]()
    for k in range(1, count + 1):
        free, forced = powers[k] @ state, np.zeros((3, count))
        forced[:, :k] = columns[:k][::-1].T
        for entry, limit in ((1, V), (2, A)):
            for sign in (1, -1):
                rows.append(sign * forced[entry])
                most.append(limit - sign * free[entry])
    found = scipy.optimize.linprog(
        np.zeros(count), np.array(rows), most, columns[::-1].T, -(powers[count] @ state), bounds=(-J, J)
    )
    return bool(found.status == 0)


@pytest.mark.parametrize("seed", range(8))
def test_on_the_move_no_jerk_that_is_held_in_each_sample_arrives_earlier(seed: int) -> None:
    """From where a sequence left it. What is on a grid arrives no earlier than what is not: this is a lower bound."""
    random = np.random.default_rng(seed)
    limits, h = np.array([1.0, 2.0, 8.0]), 0.04
    for _ in range(5):
        before = Made(program(3, limits, h), np.repeat(random.uniform(-2, 2, 3), random.integers(1, 30, 3)))
        state = np.array([random.uniform(-2, 2), *before.course[-1, 1:3]])
        made = Made(program(3, limits, h), np.zeros(400), state)
        arrived = int(np.argmax((made.course[:, :3] == 0).all(axis=1))) + 1
        assert (made.course[arrived:, :3] == 0).all()
        assert not on_a_grid(state * [-1, 1, 1], limits * (1 - 1e-9), h, arrived - 2)
        assert on_a_grid(state * [-1, 1, 1], limits * (1 + 1e-9), h, arrived + 3)


def test_a_cart_with_a_stop_follows_what_is_made_of_set_points() -> None:
    """Into the stop and out of it, under inputs that are held, by an integrator for general systems."""
    cart, m, k, gap, h = chain(2), 2.0, 100.0, 0.04, 2e-3
    spring = {"name": "stop", "kind": "spring", "of": "x0", "start": gap, "slope": k, "into": {"x1": -1 / m}}
    cart["system"] |= {"B": [[0], [1 / m]], "nonlinearities": [spring]}
    cart["simulation"] |= {"controller": {"sample_time": h}}
    cart["reference"]["output"] = {"constant": 0}
    controller = Controller(of_spec(load_spec(cart), given=True, steps=5).file)
    x, random = np.zeros(2), np.random.default_rng(1)
    off, inside, r = 0.0, 0, 0.0
    for tick in range(900):
        r = random.uniform(-0.1, 0.1) if tick % 150 == 0 else r
        (u,) = controller.step(x[:1], [r])
        off, inside = max(off, abs(x[0] - controller.state("w")[0])), inside + (x[0] > gap)

        def flow(_: float, z: Any, u: float = u) -> list[float]:
            return [z[1], (u - k * max(z[0] - gap, 0.0)) / m]

        x = scipy.integrate.solve_ivp(flow, (0, h), x, rtol=1e-9, atol=1e-12).y[:, -1]
    assert 100 < inside < 800
    assert off < 2e-6


@given(st.integers(0, 10**6), st.sampled_from([1, 2, 3, 4, 5]), st.sampled_from([np.float32, np.float64]))
@example(45742, 4, np.float64)  # it comes to rest where it is not yet near enough
def test_the_program_is_the_page_in_every_bit(seed: int, degree: int, real: Any) -> None:
    random = np.random.default_rng(seed)
    limits, h, set_points = sequence(random, degree)
    start = float(random.normal())
    ends = random.choice([0.01, 1, np.inf]) * np.abs(set_points).max() * np.array([-1, 1]) + start
    found = program(degree, limits[: max(degree, 3)], h, start, ends)
    N = found.sizes["N"]
    kept, at, table = memory(found, np.zeros(N), np.zeros(0), real), found.places, routine(found, real)
    plain = Plain(found, np.zeros(N), [], real=real)
    for r in set_points[:60]:
        y, given_now = np.zeros(1, real), np.array([r], real)
        with np.errstate(all="ignore"):
            assert kernel.tick(table, kept["memory"], kept["counts"], kept["room"], y, given_now) == plain.step(
                y, given_now
            )
        assert kept["memory"][at["w"]].tobytes() == np.array(plain.state["w"], real).tobytes()
        assert kept["memory"][at["course"]].tobytes() == np.array(plain.state["course"], real).tobytes()


@pytest.mark.parametrize("degree", [1, 3, 5])
def test_no_bit_differs_in_any_language(degree: int, tmp_path: Path) -> None:
    found = subject(degree)
    jumps = np.repeat(np.random.default_rng(1).normal(size=(10, 1)) / 10, 30, axis=0)
    found = replace(found, vector=replace(found.vector, w=jumps))
    for single in (False, True):
        folder = written_in_c(found, tmp_path / f"c{single}", single=single, given=True)
        for compiler in COMPILERS:
            assert built(folder, compiler, "-O3 -march=native").startswith("300 steps, 0 wrong")


@pytest.mark.slow
def test_no_bit_differs_in_a_function_block() -> None:
    found = subject(4)
    vector = replace(found.vector, y=found.vector.y[:20], w=found.vector.w[:20] + np.arange(20)[:, None] // 7)
    for single in (False, True):
        assert all(one == other for one, other in both(replace(found, vector=vector), single=single, given=True))


@pytest.mark.skipif(c_compiler() is None, reason="no C compiler for Linux on x86-64 is installed")
@pytest.mark.parametrize("version", [2, 3])
def test_no_bit_differs_in_an_fmu(version: Version, tmp_path: Path) -> None:
    file, path, h = subject(3).file, tmp_path / "controller.fmu", 1e-3
    source = Source(file=file, name="loop", single=False, given=True, unproved=())
    write_fmu(packed(controller_model(source, 10.0, {}), version, c_compiler()), path)
    block, python = Block(path, tmp_path), Controller(file)
    assert [name.split(".")[-1] for name in block.named("", "input")] == ["y", "y"]
    for k in range(400):
        values = np.array([0.1 * np.sin(0.01 * k), k // 100 * 0.1])
        block.set(block.named("", "input"), values)
        block.step(k * h, h)
        assert block.get(["u"]).tobytes() == python.step(values[:1], values[1:]).tobytes()


@octave
def test_no_bit_differs_in_octave(tmp_path: Path) -> None:
    assert said(written_in_matlab(subject(4), tmp_path, given=True), "disp(loop_replay())") == ["0"]


def test_it_starts_at_rest_where_the_reference_does_and_says_what_is_given() -> None:
    file = subject(2).file
    controller = Controller(file)
    assert file.program is not None
    assert (file.program.outside.given, file.program.outside.reference) == (["y"], ["y", "dy/dt", "d2y/dt2"])
    controller.step([0.1], [0.1])
    np.testing.assert_array_equal(controller.state("w"), [0.1, 0, 0])
    with pytest.raises(ValueError, match="1 output and 1 entry of the reference"):
        controller.step([0.1], [0.1, 0.0, 0.0])


def test_a_set_point_that_is_no_number_changes_nothing() -> None:
    controller = Controller(subject(3).file)
    controller.step([0.1], [0.5])
    before = controller.state("course"), controller.state("w")
    for wrong in (np.nan, np.inf, -np.inf):
        controller.step([0.1], [wrong])
        assert controller.status == -1
        np.testing.assert_array_equal(controller.state("course"), before[0])
        np.testing.assert_array_equal(controller.state("w"), before[1])


@pytest.mark.parametrize(
    ("degree", "changes", "error", "text"),
    [
        (3, {"speed": 0}, InvalidSpec, r"'speed'\]: 0 is not positive"),
        (3, {"snap": 100}, InvalidSpec, "limits of speed, acceleration, jerk are needed, for a relative degree of 3"),
        (4, {"snap": None}, InvalidSpec, "limits of speed, acceleration, jerk, snap are needed"),
        (3, {"crackle": 100}, InvalidSpec, r"'snap'\] is missing: crackle is beyond it"),
        (4, {"snap": 100}, InvalidSpec, "so low that it takes means over 800 samples"),
        (6, {}, OutsideTheory, "the relative degree is 6, and what is made of set-points has 5 derivatives"),
    ],
)
def test_limits_that_do_not_fit_are_refused(degree: int, changes: Any, error: Any, text: str) -> None:
    from pwatrack import design

    asked = chain(degree, **changes)
    limits = asked["reference"]["outside"]["filter"]["y"]
    asked["reference"]["outside"]["filter"]["y"] = {name: v for name, v in limits.items() if v is not None}
    with pytest.raises(error, match=text):
        design(load_spec(asked))


@pytest.mark.parametrize(
    ("reference", "text"),
    [
        ({"output": {"constant": 0}, "outside": {"filter": {"z": LIMITS}}}, "'z' is no tracked output"),
        ({"state": ["0", "0"], "outside": {"filter": {"y": LIMITS}}}, r"'outside'\] goes with reference.output"),
        ({"output": {"constant": 0}, "outside": {}}, "filter"),
    ],
)
def test_what_it_cannot_be_for_is_refused(reference: Any, text: str) -> None:
    asked = chain(2) | {"reference": reference}
    with pytest.raises(InvalidSpec, match=text):
        load_spec(asked)


def test_a_stored_pace_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    known = subject(3).file.model_dump()
    known["program"]["outside"]["range"] = []
    for pace in ([[0.0, 1.0, 1.0, 0.0]], [[0.0, 1.0, 1.0]], [[0.0, 1.0, 1.0, 1.0]] * 3):
        known["program"]["outside"]["pace"] = pace
        with pytest.raises(InvalidSpec, match=r"outside\.pace"):
            parsed(known | {"sha256": digest(known)}, tmp_path)
