"""What is said of a design, a run or an ensemble in figures: the same in run.json, at the terminal and in pictures."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from typing import Any

import numpy as np

from pwatrack.arrays import Array
from pwatrack.control.words import load_kind
from pwatrack.simulation.figures import Figures
from pwatrack.simulation.region import BoxRegion, Region
from pwatrack.workflow.result import SimulatedLoop
from pwatrack.workflow.variation import EnsembleResult

_OF_STEADY_STATE = ("largest_multiplier", "steady_state_residual")
SIMULATED = (  # the figures that no proof decides
    *(field.name for field in fields(Figures) if field.name != "sampled"),
    *_OF_STEADY_STATE,
)


def measures(result: SimulatedLoop) -> dict[str, Any]:
    """Return the figures of a simulation: numbers, or one for each of some signals by name."""
    steady_state, figures = result.steady_state, asdict(result.figures)
    del figures["sampled"]
    if steady_state is None:
        return figures
    largest = float(np.abs(steady_state.multipliers).max())
    return figures | dict(zip(_OF_STEADY_STATE, (largest, steady_state.residual), strict=True))


def figure_content(figures: Mapping[str, Any]) -> dict[str, Any]:
    """Return figures as run.json has them: a time that never comes is None."""
    return {
        name: figure_content(value) if isinstance(value, Mapping) else _finite(value) if value == np.inf else value
        for name, value in figures.items()
    }


def ensemble_measures(many: EnsembleResult) -> dict[str, Any]:
    """Return what is said of an ensemble; members count from 1, and a time that never comes is None."""
    kept, variation = many.ensemble, many.variation
    regions, names = variation.regions.items(), variation.names
    return {
        "members": len(kept.error),
        "seed": many.seed,
        "over": variation.over,
        "given": variation.given,
        "regions": {part: _region(region, names[part]) for part, region in regions},
        **{
            name: {
                "median": _finite(np.nanquantile(values, 0.5, method="lower")),
                "95 %": _finite(np.nanquantile(values, 0.95, method="higher")),
                "worst": _finite(np.nanmax(values)),
                "member": int(np.nanargmax(values)) + 1,
            }
            for name, values in (
                *member_figures(many).items(),
                ("mode_changes", kept.mode_changes),
            )
        },
        "sampled": sorted({name for figures in many.figures for name in figures.sampled}),
        "unresolved": int(np.count_nonzero(kept.unresolved)),
        "outcomes": dict(Counter(outcome.kind for outcome in many.outcomes)),
        "failed": [number + 1 for number in many.failed],
    }


def member_figures(many: EnsembleResult) -> dict[str, Array]:
    """Return the figures of each member that are of interest side by side, (M,); NaN where it has none.

    Those of signals have the name of the signal in theirs: `settling_time_y`. What no member has is left out.
    """
    columns = {name: np.array([getattr(f, name) for f in many.figures]) for name in ("largest_error", "final_error")}
    for name in ("settling_time", "rise_time", "overshoot", "largest_input"):
        found: list[Mapping[str, float]] = [getattr(figures, name) for figures in many.figures]
        for signal in dict.fromkeys(signal for values in found for signal in values):
            columns[f"{name}_{signal}"] = np.array([values.get(signal, np.nan) for values in found])
    return columns


def load_content(result: SimulatedLoop) -> dict[str, dict[str, Any]]:
    """Return what run.json says of each load that is estimated: what is known of it, what it and its estimate are."""
    loads, response = result.controller.plant.loads, result.response
    return {
        load.name: {
            "kind": load_kind(load),
            "unit": result.spec.problem.units.get(load.name, ""),
            "load": float(response.loads[-1, k]),
            "estimate": float(response.estimates[-1, k]),
        }
        for k, load in enumerate(() if loads is None else loads.each)
    }


def _region(region: Region, names: Sequence[str]) -> dict[str, Any]:
    """Return what of a region varies, by name."""
    box = isinstance(region, BoxRegion)
    first, second = (region.low, region.high) if isinstance(region, BoxRegion) else (region.center, region.radii)
    entries = zip(names, first.tolist(), second.tolist(), strict=True)
    varied = {name: [a, b] for name, a, b in entries if (a < b if box else b > 0)}
    return {"box" if box else "ellipsoid": varied}


def _finite(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None
