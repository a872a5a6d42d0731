"""What any set-points take of the inputs: closed forms, programs that are told to go anywhere, forged certificates."""

import json
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numba import njit

from pwatrack import ProvedController, design, load_spec
from pwatrack.arrays import Array
from pwatrack.claims.registry import data, figures, rows
from pwatrack.claims.set_points import SetPoints
from pwatrack.commands.export import of_spec
from pwatrack.commands.verify import told_design
from pwatrack.control.program import _given_trajectory
from pwatrack.control.set_points import Demand
from pwatrack.errors import InvalidSpec, OutsideTheory
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


def told(name: str, low: float, high: float, h: float, **limits: float) -> dict[str, Any]:
    """A spec with each output told where to go, from its middle."""
    spec: dict[str, Any] = yaml.safe_load((SPECS / f"{name}.yaml").read_text(encoding="utf-8"))
    outputs = spec["system"].get("track", spec["system"]["outputs"])
    middle = (low + high) / 2
    spec["reference"] = {
        "output": {y: {"constant": middle} for y in outputs},
        "outside": {"filter": {y: limits | {"range": [low, high]} for y in outputs}},
    }
    kept = {key: value for key, value in spec["simulation"].items() if key in ("duration", "sample_time")}
    spec["simulation"] = kept | {"controller": {"sample_time": h}}
    return {key: value for key, value in spec.items() if key not in ("require", "design")}


PLANTS = {
    "spring": lambda: cart(-0.1, 0.3, spring=K),
    "stop": lambda: cart(-0.1, 0.1),
    "backlash": lambda: told("two_mass_backlash", -1, 1, 0.01, speed=1, acceleration=2, jerk=20),
    "kinked": lambda: told("gallery/kinked_tanks", 0.5, 1.5, 0.01, speed=0.2, acceleration=0.1, jerk=0.5),
    "diode": lambda: told("gallery/diode_ladder", 0, 2, 0.001, speed=1, acceleration=20, jerk=400),
    "two outputs": lambda: told("gallery/three_tanks_pumps", 0.1, 0.4, 0.05, speed=0.01, acceleration=0.01, jerk=0.05),
}


@cache
def made(name: str) -> tuple[ProvedController, Demand]:
    controller = design(load_spec(PLANTS[name]()))
    return controller, controller.claim(SetPoints).demand


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
    controller, _ = made(name)
    spec = load_spec(PLANTS[name]())
    program = runs(of_spec(spec, given=True, steps=2).file, given=True)
    trajectory, at, sizes = _given_trajectory(controller)[0], program.places, program.sizes
    kept = memory(program, np.zeros(sizes["N"]), np.array(of_spec(spec, given=True, steps=2).file.started[1]))
    low, high = program.set_range[0]
    told_to = sequence(np.random.default_rng(seed), low, high, len(program.pace), count, program.sampling.sample_time)
    state = np.zeros((count, len(kept["memory"])))
    args = (*(kept[part] for part in ("memory", "counts", "room")), np.zeros(sizes["q"]), told_to, state)
    assert ticked(routine(program), *args) == count
    s = np.hstack([state[:, at["eta_hat"]], state[:, at["w"]], np.ones((count, 1))])
    w = state[:, at["w"]][:, : len(program.pace)]
    assert (w >= program.set_range[:, 0]).all()
    assert (w <= program.set_range[:, 1]).all()
    wrong = (-(trajectory.signs[:, None] * (s @ trajectory.guards.T)[None])).max(axis=2, initial=0.0)
    cell = wrong.argmin(axis=0)
    ideal = np.einsum("kms,ks->km", trajectory.u_ff[cell], s)
    return ideal, np.einsum("kms,ks->km", program.u_ff[cell], s)


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


@pytest.mark.parametrize("name", PLANTS)
def test_no_sequence_of_set_points_leaves_the_interval(name: str) -> None:
    """10,000 steps: neither u_ff of (16) at a tick does, nor what the program makes of it over a sample."""
    _, found = made(name)
    for values in taken(name, 1, 10_000):
        assert (values >= found.low).all()
        assert (values <= found.high).all()
        used = np.ptp(values, axis=0) / (found.high - found.low)
        print(name, found.low, found.high, values.min(axis=0), values.max(axis=0), used)
