"""What any set-points take of the inputs: closed forms, programs that are told to go anywhere, forged certificates."""

import json
import re
from copy import deepcopy
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numba import njit

from pwatrack import design, load_spec
from pwatrack.arrays import Array
from pwatrack.claims.exact_text import decimal
from pwatrack.claims.limits import NoSaturation
from pwatrack.claims.registry import brief, data, figures, rows
from pwatrack.claims.set_points import SetPoints
from pwatrack.commands.export import of_spec
from pwatrack.commands.run import run
from pwatrack.commands.verify import told_design, verify
from pwatrack.control.controller import ProvedController
from pwatrack.control.demand import Demand
from pwatrack.errors import InvalidSpec, OutsideTheory
from pwatrack.export.schema import ControllerFile
from pwatrack.export.stored import runs
from pwatrack.lmi.audit.certificate import audit
from pwatrack.report.certificate import design_certificate
from pwatrack.report.run_folder import json_text
from pwatrack.simulation import kernel
from pwatrack.simulation.controller_arrays import memory, routine

SPECS = Path(__file__).parents[1] / "specs"
M, D, K, GAP = 2.0, 0.5, 100.0, 0.04
V, A, J = 0.2, 1.0, 20.0


def cart(low: float, high: float, *, spring: float = 0.0, limits: Any = None, **pace: float) -> dict[str, Any]:
    """A mass with a spring, and a stop from GAP on where there is none."""
    stop = {"name": "stop", "kind": "spring", "of": "z", "start": GAP, "slope": K, "into": {"v": -1 / M}}
    system = {
        "states": ["z", "v"],
        "inputs": ["u"],
        "outputs": ["y"],
        "units": {"u": "N", "y": "m"},
        "A": [[0, 1], [-spring / M, -D / M]],
        "B": [[0], [1 / M]],
        "C": [[1, 0]],
    }
    kept = {"speed": V, "acceleration": A, "jerk": J, "range": [low, high]} | pace
    actuator = {"actuator": {"limits": {"u": limits}}} if limits else {}
    return {
        "name": "Cart",
        "system": system if spring else system | {"nonlinearities": [stop]},
        "reference": {"output": {"constant": 0}, "outside": {"filter": {"y": kept}}},
        "simulation": {"duration": 1, "sample_time": 0.01, "controller": {"sample_time": 0.002}} | actuator,
    }


def told(
    name: str, low: float, high: float, h: float, *, generator: Any = None, emulated: bool = False, **limits: float
) -> dict[str, Any]:
    """A spec with each output told where to go, from its middle."""
    spec: dict[str, Any] = yaml.safe_load((SPECS / f"{name}.yaml").read_text(encoding="utf-8"))
    outputs = spec["system"].get("track", spec["system"]["outputs"])
    middle = (low + high) / 2
    spec["reference"] = {
        "output": {y: {"constant": middle} for y in outputs},
        "outside": {"filter": {y: limits | {"range": [low, high]} for y in outputs}},
    }
    kept = {key: value for key, value in spec["simulation"].items() if key in ("duration", "sample_time")}
    sampled = {"sample_time": h} | ({"method": "emulated"} if emulated else {})
    spec["simulation"] = kept | {"controller": sampled}
    spec["simulation"] |= {"initial": {"generator": generator}} if generator else {}
    return {key: value for key, value in spec.items() if key not in ("require", "design")}


PLANTS = {
    "spring": lambda: cart(-0.1, 0.3, spring=K),
    "stop": lambda: cart(-0.1, 0.1),
    "backlash": lambda: told("two_mass_backlash", -1, 1, 0.01, speed=1, acceleration=2, jerk=20),
    "backlash, from afar": lambda: told(
        "two_mass_backlash", -0.1, 0.1, 0.01, generator=[3, 0], speed=0.1, acceleration=0.2, jerk=2
    ),
    "kinked": lambda: told("gallery/kinked_tanks", 0.5, 1.5, 0.01, speed=0.2, acceleration=0.1, jerk=0.5),
    "diode": lambda: told("gallery/diode_ladder", 0, 2, 0.001, speed=1, acceleration=20, jerk=400),
    "two outputs": lambda: told(
        "gallery/three_tanks_pumps", 0.1, 0.4, 0.05, emulated=True, speed=0.01, acceleration=0.01, jerk=0.05
    ),
}


def limited(name: str, limit: float) -> dict[str, Any]:
    """With limits of its input, on either side."""
    spec: dict[str, Any] = PLANTS[name]()
    spec["simulation"]["actuator"] = {"limits": {"u": [-limit, limit]}}
    return spec


def anywhere() -> dict[str, Any]:
    """A cart on a spring that may be told to go anywhere."""
    spec = cart(-0.1, 0.3, spring=K)
    del spec["reference"]["outside"]["filter"]["y"]["range"]
    return spec


TOLD = {  # what there is to say of set-points
    "two_told": PLANTS["two outputs"],
    "cart_told": lambda: limited("stop", 12),
    "backlash_told": lambda: limited("backlash", 5),
    "anywhere_told": anywhere,
}
USED = dict(zip(PLANTS, (0.7, 0.8, 0.4, 0.3, 0.95, 0.4, 0.5), strict=True))  # of the interval, by what is tried


@cache
def made(name: str) -> tuple[ControllerFile, ProvedController, Demand]:
    subject = of_spec(load_spec(PLANTS[name]()), given=True, steps=2)
    assert subject.controller is not None
    return subject.file, subject.controller, subject.controller.claim(SetPoints).demand


@njit
def ticked(table: Any, kept: Array, counts: Any, room: Array, y: Array, set_points: Array, found: Array) -> int:
    for k in range(len(set_points)):
        if kernel.tick(table, kept, counts, room, y, set_points[k]) != 0:
            return k
        found[k] = kept
    return len(set_points)


def sequence(random: np.random.Generator, low: float, high: float, outputs: int, count: int, h: float) -> Array:
    """Anywhere, beyond the range too, for a sample or for seconds; and from end to end at every frequency there is."""
    found, blocks = np.zeros((count, outputs)), 10
    for column in found.T:
        for block in np.array_split(column, blocks):
            k = 0
            period = 10 ** random.uniform(-0.5, 1.5) / h
            back_and_forth = random.random() < 0.5
            while k < len(block):
                held = int(period / 2) if back_and_forth else int(random.choice([1, 5, 50, 500]))
                r = high + 1 if k // max(held, 1) % 2 else low - 1
                block[k : k + max(held, 1)] = r if back_and_forth else random.uniform(low - 0.1, high + 0.1)
                k += max(held, 1)
    return found


def taken(name: str, seed: int, count: int) -> tuple[Array, Array]:
    """u_ff of (16) at each tick of its program, and what the program puts out for it, (count, m)."""
    file, controller, _ = made(name)
    program = runs(file, given=True)
    at, sizes = program.places, program.sizes
    kept = memory(program, np.zeros(sizes["N"]), np.array(file.started[1]))
    low, high = program.set_range[0]
    told_to = sequence(np.random.default_rng(seed), low, high, len(program.pace), count, program.sampling.sample_time)
    state = np.zeros((count, len(kept["memory"])))
    args = (*(kept[part] for part in ("memory", "counts", "room")), np.zeros(sizes["q"]), told_to, state)
    assert ticked(routine(program), *args) == count
    known, form = np.hstack([state[:, at["eta_hat"]], state[:, at["w"]], np.ones((count, 1))]), controller.form
    assert form is not None
    w = state[:, at["w"]].reshape(count, -1, len(program.pace))
    assert (w[:, 0] >= program.set_range[:, 0]).all()
    assert (w[:, 0] <= program.set_range[:, 1]).all()
    xi = np.hstack([w[:, :degree, j] for j, degree in enumerate(form.degrees)])
    last = np.column_stack([w[:, degree, j] for j, degree in enumerate(form.degrees)])
    x = np.hstack([xi, state[:, at["eta_hat"]]])
    beyond = form.boundary.signs[:, None] * (x @ form.boundary.H.T + form.boundary.h)
    cell = beyond.min(axis=2, initial=0.0).argmax(axis=0)
    free = np.concatenate([form.alpha, form.beta], axis=2)
    missed = last - np.einsum("kpx,kx->kp", free[cell], x) - form.gamma[cell]
    ideal = np.einsum("kmp,kp->km", form.right_inverse[cell], missed)
    return ideal, np.einsum("kms,ks->km", program.u_ff[cell], known)


@pytest.mark.parametrize(
    ("spec", "low", "high"),
    [
        (cart(-0.1, 0.3, spring=K), -(M * A + D * V + K * 0.1), M * A + D * V + K * 0.3),
        (cart(-0.1, 0.1), -(M * A + D * V), M * A + D * V + K * (0.1 - GAP)),
        (cart(-0.1, 0.03), -(M * A + D * V), M * A + D * V),  # the stop is not reached
        (cart(0.05, 0.1) | {}, None, None),
    ],
    ids=["spring", "stop", "stop not reached", "starts outside"],
)
def test_it_is_the_closed_form_where_there_are_no_internal_states(
    spec: dict[str, Any], low: float | None, high: float | None
) -> None:
    if low is None or high is None:
        with pytest.raises(InvalidSpec, match=r"y starts at 0, .* its range is 0.05 to 0.1"):
            design(load_spec(spec))
        return
    found = design(load_spec(spec)).claim(SetPoints).demand
    np.testing.assert_allclose([found.low[0], found.high[0]], [low, high], rtol=1e-12)
    assert found.low[0] <= low + 1e-15
    assert found.high[0] >= high - 1e-15


@pytest.mark.slow
@pytest.mark.parametrize("name", PLANTS)
def test_no_sequence_of_set_points_leaves_the_interval(name: str) -> None:
    """10,000 steps: neither u_ff of (16) at a tick does, nor what the program makes of it over a sample."""
    *_, found = made(name)
    for values in taken(name, 1, 10_000):
        assert (values >= found.low).all()
        assert (values <= found.high).all()
        assert (np.ptp(values, axis=0) > USED[name] * (found.high - found.low)).all()


def test_more_limits_more_room_and_cells_that_are_not_reached_take_nothing() -> None:
    """It grows with each limit; a stop out of reach is no stop, and its multipliers show it."""
    before, after = (design(load_spec(cart(-0.1, high))).claim(SetPoints).demand for high in (0.039, 0.041))
    assert [[*cell] for cell in before.proof["cells"]] == [["lowest", "highest"], ["not_reached"]]
    assert [[*cell] for cell in after.proof["cells"]] == [["lowest", "highest"]] * 2
    for limit in ("speed", "acceleration"):
        more = design(load_spec(cart(-0.1, 0.039, **{limit: 2 * {"speed": V, "acceleration": A}[limit]})))
        assert more.claim(SetPoints).demand.high[0] > before.high[0]


def test_what_is_left_of_limits_is_left_whatever_the_set_points_are() -> None:
    spec = load_spec(cart(-0.1, 0.3, spring=K, limits=[-30, 40]))
    controller = design(spec)
    claim, said = controller.claim(SetPoints), dict(rows(spec.words, controller))
    assert (
        said["set-points"] == "any y_d within its limits takes u from -12.1 to 32.1 N: "
        "beside it and the reference of the file 7.899 N is left"
    )
    found = figures(spec.words, controller)
    assert found["set_points"]["inputs"]["u"]["takes"] == claim.takes[0]
    assert found["set_points"]["inputs"]["u"]["left"] == pytest.approx(40 - 32.1, rel=1e-4)
    (limits,) = controller.claims_of(NoSaturation)
    assert limits.room.left is not None
    assert limits.room.left[0] == found["set_points"]["inputs"]["u"]["left"]
    assert [text.count("whatever the set-points") for _, text in limits.rows(spec.words, controller)] == [0, 1, 1, 0]
    less = design(load_spec(cart(-0.1, 0.3, spring=K, limits=[-30, 34]))).claims_of(NoSaturation)[0]
    for wide, narrow in list(zip(limits.promises, less.promises, strict=True))[:2]:
        assert less.room.left is not None
        assert narrow.scale(less.room.left) < 0.5 * wide.scale(limits.room.left)


@pytest.mark.parametrize(
    ("limits", "figure", "would"),
    [
        ([-40, 30], "32.1 N, above its upper limit, 30 N", r"it is within with range \[-0\.09\d*, 0\.27\d*\]$"),
        (
            [-12, 40],
            "-12.1 N, below its lower limit, -12 N",
            r"range \[-0\.09\d*, 0\.29\d*\] or acceleration 0\.949\d* m/s2$",
        ),
    ],
)
def test_what_takes_more_than_there_is_is_refused_with_what_would_do(limits: Any, figure: str, would: str) -> None:
    with pytest.raises(OutsideTheory) as refusal:
        design(load_spec(cart(-0.1, 0.3, spring=K, limits=limits)))
    (problem,) = refusal.value.problems
    assert problem.message == f"set-points may take u = {figure}"
    assert problem.subject == ("reference", "outside", "filter")
    assert problem.hint is not None
    assert re.search(would, problem.hint), problem.hint


def test_with_what_would_do_it_is_within() -> None:
    """The figure of the hint, put into the file, is accepted; five parts in a thousand more are not."""
    with pytest.raises(OutsideTheory, match="above its upper limit, 31 N") as refusal:
        design(load_spec(cart(-0.1, 0.3, spring=K, limits=[-31, 31])))
    hint = refusal.value.problems[0].hint or ""
    found = re.search(r"acceleration ([0-9.]+) m/s2", hint)
    assert found is not None
    most = float(found[1])
    assert most == pytest.approx((31 - D * V - K * 0.3) / M, rel=1e-3)
    design(load_spec(cart(-0.1, 0.3, spring=K, limits=[-31, 31], acceleration=most)))
    with pytest.raises(OutsideTheory):
        design(load_spec(cart(-0.1, 0.3, spring=K, limits=[-31, 31], acceleration=most * 1.005)))


@pytest.mark.slow
def test_a_range_is_asked_for_where_it_matters_and_only_there() -> None:
    spec = anywhere()
    bare = load_spec(spec)
    assert dict(rows(bare.words, design(bare)))["set-points"] == (
        "what any y_d within its limits takes is not known, since it depends on y, of which no range is given"
    )
    spec["simulation"]["actuator"] = {"limits": {"u": [-40, 40]}}
    with pytest.raises(InvalidSpec, match="no range of y is given: what it takes of the inputs, which have limits"):
        design(load_spec(spec))
    free = deepcopy(spec)
    free["system"]["A"] = [[0, 1], [0, -D / M]]
    found = design(load_spec(free)).claim(SetPoints).demand
    np.testing.assert_allclose([found.low[0], found.high[0]], [-(M * A + D * V), M * A + D * V], rtol=1e-12)


@pytest.mark.slow
def test_where_internal_states_may_take_more_it_is_said_and_not_refused() -> None:
    spec = load_spec(PLANTS["backlash"]() | {"name": "Backlash"})
    less = load_spec(limited("backlash", 5))
    controller = design(less)
    said = dict(rows(less.words, controller))["set-points"]
    assert said.endswith(
        "N, as far as is proved: more than its limits; what is said of these is of the reference in the file"
    )
    assert ("NOT proved", "limits with set-points at run time") in list(brief(less.words, controller))
    assert controller.claim(NoSaturation).room.left is not None
    assert "whatever" not in " ".join(text for _, text in rows(less.words, controller))
    assert dict(brief(spec.words, design(spec))).get("NOT proved") is None


def forged(content: dict[str, Any], *path: Any, by: Any) -> list[str]:
    """What the auditor finds wrong where one entry is another."""
    changed = deepcopy(content)
    at: Any = changed["set_points"]
    for key in path[:-1]:
        at = at[key]
    at[path[-1]] = by(at[path[-1]])
    return audit(json_text(changed))[1]


def smaller(value: str) -> str:
    return decimal(0.9 * float(Fraction(value)))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["stop", "backlash", "backlash, from afar", "kinked", "two outputs"])
def test_the_auditor_agrees_and_sees_every_number_that_is_forged(name: str) -> None:
    spec = load_spec(PLANTS[name]())
    _, controller, found = made(name)
    content = json.loads(json_text(design_certificate(spec, controller)), parse_float=str)
    said, faults = audit(json_text(content))
    assert not faults
    assert any(text.startswith("set-points: whatever they are, u_ff is within") for text in said)
    for k in range(len(found.low)):
        assert forged(content, "u_ff", k, 0, by=smaller)
        assert forged(content, "u_ff", k, 1, by=smaller)
    assert forged(content, "box", 1, 1, by=lambda v: decimal(2 * float(v)))
    assert forged(content, "cells", by=lambda cells: cells[:-1])
    assert forged(content, "cells", 0, by=lambda _: {"not_reached": ["0"] * len(content["plant"]["H"])})
    for k, part in enumerate(content["set_points"]["parts"]):
        assert forged(content, "parts", by=lambda parts, k=k: parts[:k] + parts[k + 1 :])
        assert forged(content, "parts", k, "sizes", 0, by=smaller)
        entry = max(range(len(part["Q"]["integers"])), key=lambda j: abs(part["Q"]["integers"][j][j]))
        assert forged(content, "parts", k, "Q", "integers", entry, entry, by=lambda v: v // 2)
    if content["set_points"]["parts"]:
        assert forged(content, "start", -1, by=lambda v: decimal(float(v) + 1000))
        assert forged(content, "centre", 0, by=lambda v: decimal(float(Fraction(v)) + 1000))
        assert forged(content, "M", 0, 0, by=lambda v: decimal(float(v) + 100))
    again = told_design(spec, content)
    assert data(again) == data(controller)
    assert list(rows(spec.words, again)) == list(rows(spec.words, controller))


def test_a_run_folder_is_verified_and_its_controller_has_the_numbers(tmp_path: Path) -> None:
    spec = tmp_path / "told.yaml"
    spec.write_text(json.dumps(PLANTS["stop"]()), encoding="utf-8")
    run(spec, tmp_path / "run", [], None, simulated=False)
    said = verify(tmp_path / "run")
    (proved,) = (text for text in said if text.startswith("set-points: whatever they are, u_ff is within"))
    ends = [float(v) for v in proved.split("within ")[1].split(" to ")]
    stored = json.loads((tmp_path / "run" / "controller.json").read_text(encoding="utf-8"))
    assert stored["program"]["outside"]["takes"] == [ends]
    assert (
        json.loads((tmp_path / "run" / "run.json").read_text(encoding="utf-8"))["set_points"]["inputs"]["u"]["takes"]
        == ends
    )
