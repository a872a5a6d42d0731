"""Runs beside each other: their figures in a table, their errors in one picture."""

import csv
import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from pwatrack.arrays import Array
from pwatrack.errors import InvalidSpec
from pwatrack.report.figures import numbers
from pwatrack.report.run_folder import read_index, written_at_once

_MOST = 20  # runs: more columns and curves are not told apart


@dataclass(frozen=True, kw_only=True)
class Run:
    """What a run folder says."""

    folder: Path
    index: Mapping[str, Any]
    t: Array  # in s; empty if it was not simulated
    error: Array  # the norm of the tracking error there
    unit: str  # of the error
    gains: Mapping[str, Array] | None = None  # K and L, where they are beside it

    @property
    def figures(self) -> dict[str, float]:
        """Its figures that are one number each, and those of each signal as `figure_signal`."""
        return numbers(self.index.get("figures", {}))

    def gains_in(self, sizes: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
        """Return the norms of its gains in other sizes, by the names of figures; none where signals are others."""
        own = self.index.get("sizes", {})
        if self.gains is None or not own or any(list(own[kind]) != list(sizes.get(kind, {})) for kind in own):
            return {}
        x, u, y = (np.array([*sizes[kind].values()]) for kind in ("states", "inputs", "outputs"))
        n = self.gains["K"].shape[1]
        K, L = self.gains["K"] * x[:n] / u[:, None], self.gains["L"] * y / x[:, None]
        return {"norm_K": float(np.linalg.norm(K, 2)), "norm_L": float(np.linalg.norm(L, 2))}

    def required(self) -> dict[str, str]:
        """Return how each requirement ended, by what it is of."""
        found = dict[str, str]()
        for asked in self.index.get("requirements", ()):
            best = "at most" if "at most" in asked else "at least"
            of = f" of {asked['signal']}" if asked["signal"] else ""
            label = f"{asked['figure']}{of}{' of members' * (asked['members'] is not None)}, {best}"
            found[label] = f"{asked[best]:.4g}: {'met' if asked['met'] else 'MISSED'}"
        return found


def read_run(folder: Path) -> Run:
    """Read a run folder; raises InvalidSpec if it tells no run, or its trace is not as its index says."""
    index = read_index(folder)
    if index is None:
        raise InvalidSpec(f"{folder} tells no run: there is no run.json of ours in it")
    gains = None
    with suppress(OSError, ValueError, KeyError, TypeError):
        content = json.loads((folder / "gains.json").read_text(encoding="utf-8"))
        gains = {name: np.array(content[name], dtype=float, ndmin=2) for name in ("K", "L")}
    tracked = index.get("tracked") or {}
    sizes: dict[str, float] = tracked.get("sizes", {})
    if "trace.csv" not in index["files"] or not sizes:
        return Run(folder=folder, index=index, t=np.zeros(0), error=np.zeros(0), unit="", gains=gains)
    try:
        with (folder / "trace.csv").open(encoding="utf-8", newline="") as file:
            header = next(csv.reader(file))
            wanted = [header.index(name) for name in ("t", *sizes, *(f"{name}_d" for name in sizes))]
            values = np.loadtxt(file, delimiter=",", usecols=wanted, ndmin=2)
    except (OSError, ValueError, StopIteration) as broken:
        reason = getattr(broken, "strerror", None) or broken
        raise InvalidSpec(f"cannot read {folder / 'trace.csv'}: {reason}") from None
    count = len(sizes)
    error = np.linalg.norm((values[:, 1 : count + 1] - values[:, count + 1 :]) / np.array([*sizes.values()]), axis=1)
    unit = str(tracked.get("unit", ""))
    return Run(folder=folder, index=index, t=values[:, 0], error=error, unit=unit, gains=gains)


def names_of(runs: Sequence[Run]) -> list[str]:
    """Return names that tell runs apart: of their folders, with as many of the folders above as that takes."""
    parts = [run.folder.resolve().parts for run in runs]
    for depth in range(1, max(map(len, parts)) + 1):
        names = ["/".join(part[-depth:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    return [str(run.folder) for run in runs]


def compare(screen: Console, folders: Sequence[Path], picture: Path | None) -> None:
    """Print runs beside each other, and draw their errors over each other."""
    if len(folders) > _MOST:
        raise InvalidSpec(f"{len(folders)} runs, at most {_MOST} stand beside each other")
    if picture is not None and picture.suffix.lower() != ".png":
        raise InvalidSpec(f"--picture {picture}: pictures are PNG files", hint="give it a name that ends in .png")
    runs = [read_run(folder) for folder in folders]
    names, table = names_of(runs), Table()
    table.add_column("figure", overflow="fold")
    for name in names:
        table.add_column(name, justify="right", overflow="fold")
    for label, key in (("spec", "name"), ("verdict", "verdict"), ("exit", "exit")):
        table.add_row(label, *(str(run.index.get(key, "")) for run in runs))
    simulations = [run.index.get("simulation") for run in runs]
    table.add_row("simulation", *(str(s.get("outcome", "")) if isinstance(s, dict) else "" for s in simulations))
    wishes, same_units = [run.required() for run in runs], len({run.unit for run in runs}) == 1
    for label in dict.fromkeys(label for run in wishes for label in run):
        table.add_row(label, *(run.get(label, "") for run in wishes))
    for name in dict.fromkeys(name for run in runs for name in run.figures):
        table.add_row(name, *(f"{run.figures[name]:.4g}" if name in run.figures else "" for run in runs))
    first: Mapping[str, Any] = next((run.index["sizes"] for run in runs if "sizes" in run.index), {})
    if not same_units:  # what is in sizes of one is in other units than the gains of another
        table.add_row("unit of what is tracked", *(run.unit for run in runs))
    elif any(run.index.get("sizes", first) != first for run in runs):
        norms = [run.gains_in(first) for run in runs]
        for name in ("norm_K", "norm_L"):
            cells = (f"{run[name]:.4g}" if run else "" for run in norms)
            table.add_row(f"{name} in sizes of {names[0]}", *cells)
    screen.print(table)
    drawn = [(name, run) for name, run in zip(names, runs, strict=True) if len(run.t)]
    if picture is None or not drawn:
        return
    from pwatrack.report.plots.canvas import png
    from pwatrack.report.plots.spread import run_errors

    units = {run.unit for _, run in drawn}
    figure = run_errors({name: (run.t, run.error) for name, run in drawn}, units.pop() if len(units) == 1 else "")
    with written_at_once(picture) as temporary:
        temporary.write_bytes(png(figure))
    screen.print(str(picture), soft_wrap=True)
