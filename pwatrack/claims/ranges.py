"""How large the numbers get that the program of a sampled loop works with, in this run: what needs room for them."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from pwatrack.arrays import OVER_SUMS, Array, up
from pwatrack.claims.sampled_bounds import SampledBounds
from pwatrack.control.controller import Asked, Claim, ProvedController, Row, Told
from pwatrack.control.sampled_disturbances import joined, numbers
from pwatrack.control.words import Words, down

_ROUNDED = 1e-11  # of a number: what a program that steps them for long rounds
_SAID = ("y", "u", "x_hat", "s_hat")  # what a summary has; run.json has all


@dataclass(frozen=True, kw_only=True)
class ProgramRanges(Claim):
    """Between what each number of the program is, for all that acts in the run."""

    # of what acts, and of the start of the run; where that is not known from x = x̂ = x_d on, as the first input acts
    # where inputs are late
    bounds: SampledBounds = field(repr=False)
    steps: Array  # of inputs, half of each, (m,)

    @classmethod
    def prove(cls, controller: ProvedController, asked: Asked, told: Told = None) -> Iterator["ProgramRanges"]:
        """Yield them where all that acts has a bound; with loads if the start of the run is known."""
        quanta, loads = asked.words.conditions.quanta, controller.plant.loads
        steps = np.zeros(controller.plant.B.shape[1]) if quanta is None else quanta.inputs / 2
        for bounds in controller.claims_of(SampledBounds):
            if bounds.from_start if loads is not None or bounds.errors.starts is not None else bounds.from_zero:
                yield cls(bounds=bounds, steps=steps)

    @cached_property
    def ranges(self) -> dict[str, Array]:
        """The least and the largest of y as measured, u as put out, x̂, ŝ, x_d, u_ff, η̂ and w, (k, 2) each."""
        of, squares, along = numbers(self.bounds.errors), self.bounds.acts.squares, self.bounds.acts.along
        other = np.sqrt([squares.get(("cell", k), np.zeros(1)).max() for k in range(len(self.steps))])
        beside = {"y": self.bounds.noise, "u": self.steps + other, "u_ff": other}
        found, late = dict[str, Array](), self.bounds.acts.late
        before = {} if late is None else late.along
        for name, ends in along.items():
            off = sum((self._off(rows) for rows in of.get(name, ())), beside.get(name, 0.0)) * OVER_SUMS
            each = off + _ROUNDED * np.abs(ends).max(axis=1)
            found[name] = ends + np.multiply.outer(each, [-1, 1])
            found[name] = joined(found[name], before.get(name, found[name]))
        return found

    def _off(self, rows: Array) -> Array:
        """Return what rows (A, k, order) read off z at most, the largest of each A, (k,)."""
        flat = np.concatenate(rows)
        before = (np.abs(flat @ column.floats[:, 0]) for column in self.bounds.errors.starts or ())
        most = np.maximum(self.bounds.off(flat, start=True), sum(before, np.zeros(len(flat))))
        return np.asarray(most.reshape(rows.shape[:2]).max(axis=0))

    def named(self, words: Words, controller: ProvedController) -> Iterator[tuple[str, str, str, Array]]:
        """Yield of each number what it belongs to, its name, its unit and its ends, what is said first before."""
        plant, trajectory = controller.plant, controller.trajectory
        of = {"y": plant.outputs, "u": plant.inputs, "x_hat": plant.states, "x_d": plant.states, "u_ff": plant.inputs}
        loads = {} if plant.loads is None else dict(zip(plant.loads.states, plant.loads.load_of, strict=True))
        of |= {"eta_hat": trajectory.names, "s_hat": tuple(loads)}
        for kind in (*_SAID, "x_d", "u_ff", "eta_hat", "w"):
            ends = self.ranges[kind]
            for k, (name, each) in enumerate(zip(of.get(kind, range(len(ends))), ends, strict=True)):
                unit = words.units.get(loads.get(str(name), str(name)), "") if kind in of else ""
                yield kind, f"w{k + 1}" if kind == "w" else str(name), unit, each

    def figures(self, words: Words, controller: ProvedController) -> dict[str, Any]:
        found = dict[str, dict[str, Any]]()
        for kind, name, unit, (low, high) in self.named(words, controller):
            size = max(abs(low), abs(high))
            bits = int(np.frexp(size)[1]) if size else 0
            each = {"from": float(low), "to": float(high), "unit": unit, "bits": bits}
            found.setdefault(kind, {})[name] = each
        return {"numbers": found}

    def rows(self, words: Words, controller: ProvedController) -> Iterator[Row]:
        said = list[str]()
        for kind, name, unit, (low, high) in self.named(words, controller):
            if kind in _SAID:
                shown = {"y": f"{name} as measured", "u": name, "s_hat": f"estimate of {name}"}.get(kind, f"{name}_hat")
                ends = f"{down(low)} to {up(high)} {unit}".rstrip()
                said.append(f"{shown} {ends}")
        begins = "x = x̂ = x_d" + " as the first input acts" * (self.bounds.errors.gains.delay > 0)
        begins = "its start" if self.bounds.errors.starts is not None else begins
        of = f"in the program, in this run from {begins} on{words.as_designed}{words.off_limits}"
        yield "numbers", f"{of}: {'; '.join(said)}"
