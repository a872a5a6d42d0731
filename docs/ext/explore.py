"""A page on which one moves a parameter: each place of a grid is designed and simulated when the site is built.

Nothing runs in the browser but a short script that draws what was computed: the walk of a simulation needs Numba, and
browsers have no compiler.
"""

import json
from collections.abc import Iterator, Mapping
from html import escape
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from pwatrack import PwatrackError, Result, design, load_spec, simulate
from pwatrack.model.nonlinearity import Nonlinearity
from pwatrack.report.stays import stays
from pwatrack.spec.axis import axis

_STATIC = Path(__file__).parents[1] / "static"
_TIMES = 300  # of a curve
_DOTS = 600  # of the bars of cells
_DIGITS = 4  # of a number


def explored(spec: Path, told: list[str]) -> str:
    """Return HTML with sliders for the parameters of these axes, such as 'k=0.1:0.9:5', and what came out at each."""
    axes = [axis(text) for text in told]
    at = list(product(*(range(len(one.values)) for one in axes)))
    grids = {one.name: list(map(float, one.values)) for one in axes}
    found = [
        _place(spec, {name: grid[k] for (name, grid), k in zip(grids.items(), place, strict=True)}) for place in at
    ]
    content = json.dumps({"axes": grids, "places": found}, separators=(",", ":"), allow_nan=False).replace(
        "<", "\\u003c"
    )
    sliders = "".join(
        f'<label>{escape(name)} = <output></output><input type="range" min="0" max="{len(grid) - 1}" '
        f'value="{len(grid) // 2}" data-name="{escape(name)}"></label>'
        for name, grid in grids.items()
    )
    script = (_STATIC / "explore.js").read_text(encoding="utf-8")
    return (
        '```{raw} html\n<div class="explore"><div class="sliders">'
        + sliders
        + '</div><p class="verdict" aria-live="polite"></p><div class="pictures"></div></div>\n'
        + f'<script type="application/json" id="explored">{content}</script>\n<script>{script}</script>\n```\n'
    )


def _place(spec: Path, values: Mapping[str, float]) -> dict[str, Any]:
    """Return what came out at one place: a verdict, the element, and the run where there is a design."""
    loaded = load_spec(spec, dict(values))
    plant = loaded.problem.plant
    (element, *_) = plant.elements
    assert isinstance(element, Nonlinearity)
    marks = [float(mark) for mark in element.function.breakpoints]
    beside = 2 * (marks[-1] - marks[0]) or 1.0
    phi = [[s, float(element.function(s))] for s in (marks[0] - beside, *marks, marks[-1] + beside)]
    shown = {"element": element.name, "phi": phi}
    try:
        made = design(loaded)
    except PwatrackError as refusal:
        return shown | {"verdict": refusal.code.verdict, "said": refusal.problems[0].message}
    return shown | {"verdict": made.verdict, "said": "; ".join(_said(made.figures))} | _run(simulate(made))


def _said(figures: Mapping[str, float]) -> Iterator[str]:
    yield f"every error goes to 0 at least as fast as e^(−{figures['rate']:.3g} t), for any switching (1/s)"
    yield f"‖K‖ = {figures['norm_K']:.3g}, ‖L‖ = {figures['norm_L']:.3g} 1/s in sizes"
    yield f"it holds with every entry of K changed by {100 * figures['robust_share_K']:.2g} %"


def _run(run: Result) -> dict[str, Any]:
    """Return the curves of a run, the band of its error, and its cells over time."""
    every = slice(None, None, max(1, len(run.t) // _TIMES))
    plant = next(rows for name, rows in stays(run, _DOTS) if name == "plant")
    cells = [{"name": stay.name, "share": stay.share, "bars": _short(np.array(stay.bars))} for stay in plant]
    return {
        "t": _short(run.t[every]),
        "y": _short(run.y[every, 0]),
        "y_d": _short(run.y_d[every, 0]),
        "e": _short(run.e[every, 0]),
        "ran": run.outcome.text,
        "cells": cells,
    }


def _short(values: Any) -> Any:
    """Return numbers with as many digits as a picture shows."""
    scale = float(np.abs(values).max(initial=0.0))
    decimals = _DIGITS - int(np.floor(np.log10(scale))) - 1 if scale else 0
    return np.round(values, max(decimals, 0)).tolist()
