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
from pwatrack.spec.requirement import RANGES
from pwatrack.spec.spec import Spec
from pwatrack.workflow.outcome import SimulatedLoop
from pwatrack.workflow.variation import EnsembleResult

_OF_STEADY_STATE = ("largest_multiplier", "steady_state_residual")
_BESIDE = ("sampled", "time_share")  # what is said of a simulation beside its figures
SIMULATED = (  # the figures that no proof decides
    *(field.name for field in fields(Figures) if field.name not in _BESIDE),
    *_OF_STEADY_STATE,
)


def measures(result: SimulatedLoop) -> dict[str, Any]:
    """Return the figures of a simulation: numbers, or one for each of some signals by name."""
    figures = {name: value for name, value in asdict(result.figures).items() if name not in _BESIDE}
    for name in RANGES:  # of inputs the largest size is what is told
        limited = {of: value for of, value in figures.pop(name).items() if of not in figures["largest_input"]}
        figures |= {name: limited} if limited else {}
    if (steady := result.steady_state) is not None:
        largest = float(np.abs(steady.multipliers).max())
        figures |= zip(_OF_STEADY_STATE, (largest, steady.residual), strict=True)
    return figures


def figure_content(figures: Mapping[str, Any]) -> dict[str, Any]:
    """Return figures as run.json has them: a time that never comes is None."""
    return {
        name: figure_content(value) if isinstance(value, Mapping) else _finite(value) if value == np.inf else value
        for name, value in figures.items()
    }


def numbers(figures: Mapping[str, Any]) -> dict[str, float]:
    """Return the figures that are numbers; those of signals have the name of the signal in theirs: settling_time_y."""
    parts = ((name, value.items() if isinstance(value, Mapping) else [("", value)]) for name, value in figures.items())
    return {
        f"{name}_{of}".rstrip("_"): float(value)
        for name, each in parts
        for of, value in each
        if isinstance(value, int | float) and not isinstance(value, bool)
    }


def ensemble_measures(many: EnsembleResult) -> dict[str, Any]:
    """Return what is said of an ensemble; members count from 1, and a time that never comes is None."""
    kept, variation = many.ensemble, many.variation
    columns = member_figures(many) | {"mode_changes": kept.mode_changes}
    return {
        "members": len(kept.error),
        "seed": many.seed,
        "over": variation.over,
        "given": variation.given,
        "regions": {part: _region(region, variation.names[part]) for part, region in variation.regions.items()},
        **{
            name: {
                "median": _finite(np.nanquantile(values, 0.5, method="lower")),
                "95 %": _finite(np.nanquantile(values, 0.95, method="higher")),
                "worst": _finite(np.nanmax(values)),
                "member": int(np.nanargmax(values)) + 1,
            }
            for name, values in columns.items()
        },
        "sampled": sorted({name for figures in many.figures for name in figures.sampled}),
        "unresolved": int(np.count_nonzero(kept.unresolved)),
        "outcomes": dict(Counter(outcome.kind for outcome in many.outcomes)),
        "failed": [number + 1 for number in many.failed],
    }


def member_figures(many: EnsembleResult) -> dict[str, Array]:
    """Return the figures of each member, (M,), those of signals as `settling_time_y`; NaN where it has none."""
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


def norm_unit(spec: Spec, names: Sequence[str]) -> str:
    """Return the unit of the norm of some signals: of several it is in sizes."""
    return spec.problem.units.get(names[0], "") if len(names) == 1 else "sizes"


def percent(share: float) -> str:
    """Return a share in percent, to a tenth below 10 %; what is not nothing and not all is not said to be.

    Example:
        >>> [percent(share) for share in (0.4123, 0.0123, 1e-5, 0.99999, 1.0)]
        ['41 %', '1.2 %', '< 0.1 %', '> 99.9 %', '100 %']
    """
    if 0 < share < 1e-3:
        return "< 0.1 %"
    if 0.995 <= share < 1:
        return f"{100 * share:.1f} %" if share < 0.9995 else "> 99.9 %"
    return f"{100 * share:.{0 if share >= 0.0995 else 1}f} %"


def _region(region: Region, names: Sequence[str]) -> dict[str, Any]:
    if isinstance(region, BoxRegion):
        ends = zip(names, region.low.tolist(), region.high.tolist(), strict=True)
        return {"box": {name: [low, high] for name, low, high in ends if low < high}}
    around = zip(names, region.center.tolist(), region.radii.tolist(), strict=True)
    return {"ellipsoid": {name: [center, radius] for name, center, radius in around if radius > 0}}


def _finite(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None
