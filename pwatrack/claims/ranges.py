"""How large the numbers get that the program of a sampled loop works with, in this run: what needs room for them."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from pwatrack.arrays import OVER_SUMS, Array, up
from pwatrack.claims.sampled_bounds import SampledBounds
from pwatrack.control.controller import Asked, Claim, ProvedController, Row
from pwatrack.control.sampled_disturbances import across
from pwatrack.control.words import Words, down

_ROUNDED = 1e-11  # of a number: what a program that steps them for long rounds
_SAID = ("y", "u", "x_hat")  # what a summary has; run.json has all


@dataclass(frozen=True, kw_only=True)
class ProgramRanges(Claim):
    """Between what each number of the program is, from x = x̂ = x_d on, for all that acts in the run.

    Attributes:
        bounds: Of what acts.
        steps: Of inputs, half of each, (m,).
    """

    bounds: SampledBounds = field(repr=False)
    steps: Array

    @classmethod
    def prove(cls, controller: ProvedController, asked: Asked) -> Iterator["ProgramRanges"]:
        """Yield them where all that acts has a bound, no load is estimated, and no input waits at first."""
        quanta = asked.words.conditions.quanta
        steps = np.zeros(controller.plant.B.shape[1]) if quanta is None else quanta.inputs / 2
        for bounds in controller.claims_of(SampledBounds) if controller.plant.loads is None else ():
            if bounds.from_zero and not bounds.errors.gains.delay:
                yield cls(bounds=bounds, steps=steps)

    @cached_property
    def ranges(self) -> dict[str, Array]:
        """The least and the largest of y as measured, u as put out, x̂, x_d, u_ff, η̂ and w, (k, 2) each."""
        bounds, errors = self.bounds, self.bounds.errors
        (n, m, *_), C = errors.widths, errors.plant.C
        of_y = np.hstack([C, np.zeros((len(C), errors.order - n))])
        of_x_hat = bounds.off(np.concatenate(across(errors, np.eye(n)))).reshape(-1, n).max(axis=0)
        off = {"y": bounds.off(of_y) + bounds.noise, "x_hat": of_x_hat}
        off["u"] = bounds.off(np.eye(m, errors.order, n)) + self.steps
        rounded = {name: _ROUNDED * np.abs(ends).max(axis=1) for name, ends in bounds.acts.along.items()}
        each = {name: off.get(name, 0.0) * OVER_SUMS + least for name, least in rounded.items()}
        return {name: ends + np.multiply.outer(each[name], [-1, 1]) for name, ends in bounds.acts.along.items()}

    def named(self, words: Words, controller: ProvedController) -> Iterator[tuple[str, str, str, Array]]:
        """Yield of each number what it belongs to, its name, its unit and its ends, what is said first before."""
        plant, trajectory = controller.plant, controller.trajectory
        of = {"y": plant.outputs, "u": plant.inputs, "x_hat": plant.states, "x_d": plant.states, "u_ff": plant.inputs}
        of["eta_hat"] = trajectory.names
        for kind in (*_SAID, "x_d", "u_ff", "eta_hat", "w"):
            ends = self.ranges[kind]
            for k, (name, each) in enumerate(zip(of.get(kind, range(len(ends))), ends, strict=True)):
                unit = words.units.get(str(name), "") if kind in of else ""
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
                shown = f"{name}_hat" if kind == "x_hat" else f"{name} as measured" if kind == "y" else name
                ends = f"{down(low)} to {up(high)} {unit}".rstrip()
                said.append(f"{shown} {ends}")
        of = f"in the program, from x = x̂ = x_d on, in this run{words.as_designed}{words.off_limits}"
        yield "numbers", f"{of}: {'; '.join(said)}"
