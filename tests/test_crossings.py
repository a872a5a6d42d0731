"""Any two extensions at once: what is said is right, or they are refused by a name. No crossing is a false word.

Three plants: one is followed exactly, with every pair of what may be added to it; one with cells merged and one by an
x_d that is played back, which are extensions themselves, with each of these. All are run and held against their bounds.
"""

import math
from collections.abc import Callable
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import pwatrack
from pwatrack import Result, design, load_spec, simulate
from pwatrack.claims.limits import NoSaturation
from pwatrack.claims.practical import Practical
from pwatrack.claims.robust import Robust
from pwatrack.claims.stable_inversion import StableInversion
from pwatrack.commands.verify import verify
from pwatrack.errors import ExitCode, PwatrackError
from pwatrack.report.files import write_result
from pwatrack.workflow.tracking import check_reference

PLANTS = {"two_mass_backlash": 20.0, "gallery/gear_with_backlash": 4.0, "gallery/cart_and_pole_swaying": 5.0}
VARIED = {"two_mass_backlash": "d1", "gallery/gear_with_backlash": "d1", "gallery/cart_and_pole_swaying": "d"}

Spec = dict[str, Any]
ADDED: dict[str, Callable[[Spec, str], None]] = {
    "loads": lambda spec, _: spec["design"].update(estimate={"push": {"into": at_input(spec)}}),
    "box": lambda spec, name: spec["design"].update(uncertain={VARIED[name]: "0.5%"}),
    "limits": lambda spec, _: spec["simulation"].update(
        actuator={"limits": {spec["system"]["inputs"][0]: [-200, 200]}}
    ),
    "noise": lambda spec, _: spec["simulation"].update(
        noise={"std": {spec["system"]["outputs"][0]: 1e-5}, "sample_time": 0.01}
    ),
    "sampling": lambda spec, _: spec["simulation"].update(controller={"sample_time": 0.001}),
}


CROSSED: list[tuple[str, tuple[str, ...]]] = [("two_mass_backlash", pair) for pair in combinations(ADDED, 2)]
CROSSED += [(name, (one,)) for name in [*PLANTS][1:] for one in ADDED]


def at_input(spec: Spec) -> dict[str, Any]:
    """Where a load at the input enters."""
    states, column = spec["system"]["states"], [row[0] for row in spec["system"]["B"]]
    return {state: entry for state, entry in zip(states, column, strict=True) if entry != 0}


def crossed(specs: Path, name: str, added: tuple[str, ...]) -> Spec:
    spec: Spec = yaml.safe_load((specs / f"{name}.yaml").read_text(encoding="utf-8"))
    spec.setdefault("design", {}).pop("observer", None)  # its cost would have a row for each estimate
    spec.pop("require", None)
    spec["simulation"]["duration"] = PLANTS[name]
    for one in added:
        ADDED[one](spec, name)
    return spec


@pytest.mark.slow
@pytest.mark.parametrize(("name", "added"), CROSSED, ids=str)
def test_two_extensions_together_are_right_or_refused(
    name: str, added: tuple[str, ...], specs: Path, tmp_path: Path
) -> None:
    spec = load_spec(crossed(specs, name, added))
    result, refused = run(spec)
    if result is None:
        assert refused is not None
        assert refused.code not in (ExitCode.BUG, ExitCode.DONE)
        assert all(problem.message for problem in refused.problems)
        return
    assert result.outcome.kind in ("tracks", "within its bound", "off"), result.outcome.text
    controller = result.controller
    assert bool(controller.claims_of(Robust)) == ("box" in added)
    assert bool(controller.claims_of(NoSaturation)) == ("limits" in added)
    assert bool(controller.claims_of(Practical)) == (name == "gallery/gear_with_backlash")
    assert bool(controller.claims_of(StableInversion)) == (name == "gallery/cart_and_pole_swaying")
    hold(result)
    if "limits" in added or not {"noise", "sampling"} & {*added}:  # else its certificate is that of one extension
        assert verify(write_result(result, tmp_path / "run", plots="none"))


def run(spec: pwatrack.Spec) -> tuple[Result | None, PwatrackError | None]:
    try:
        return simulate(spec), None
    except PwatrackError as refusal:
        return None, refusal


def hold(result: Result) -> None:
    """Hold all signals against their bands, and the limits against what is said of starts."""
    r, bands = result.response, result.bands
    errors = {"output": r.tracking_error, "input": r.u - r.u_ff, "estimate": r.x_hat - r.x, "state": r.x - r.x_d}
    size = float(np.abs(r.x).max())
    for (kind, k), band in bands.items():
        if k < errors[kind].shape[1]:
            seen = np.abs(errors[kind][:, k])
            assert (seen <= band + 1e-9 * size * (1 if kind != "input" else np.abs(result.controller.K).max())).all()
    for limited in result.controller.claims_of(NoSaturation):
        left = limited.room.left
        if left is not None and any(p.starts.kind == "run" and p.scale(left) >= 1 for p in limited.promises):
            low, high = limited.room.limits[0]
            assert low < r.u.min()
            assert r.u.max() < high
    assert all(math.isfinite(value) for band in bands.values() for value in band.max(initial=0.0, axis=0).reshape(-1))


def test_a_design_for_a_box_beside_loads_is_refused_by_both_names(specs: Path) -> None:
    spec = load_spec(crossed(specs, "two_mass_backlash", ("loads", "box")))
    for refuses in (check_reference, design):
        with pytest.raises(PwatrackError, match=r"uncertain parameters .* unknown loads"):
            refuses(spec)
