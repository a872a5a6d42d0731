"""Limits of the inputs: u is cut off at a lower and an upper limit, and kept from changing too fast."""

from dataclasses import dataclass

import numpy as np

from pwatrack.arrays import Array
from pwatrack.model.pwa import PWASystem
from pwatrack.simulation.flow import SwitchedPart
from pwatrack.simulation.layout import Layout


@dataclass(frozen=True, kw_only=True)
class Actuator(SwitchedPart):
    """The part of a limited input, whose cells are its segments.

    Attributes:
        input: Which input it is, from 0.
        levels: The limit at which it holds the input in each of its cells; None where it lets the input through.
    """

    input: int
    levels: tuple[float | None, ...]


@dataclass(frozen=True, kw_only=True)
class RateLimit(SwitchedPart):
    """The part of an input that may change by so much from one sample to the next.

    Attributes:
        input: Which input it is, from 0.
        most: By how much it may change.
    """

    input: int
    most: float


def actuators(
    limits: Array, u: Array, generator: SwitchedPart, plant: PWASystem, model: PWASystem, at: Layout
) -> list[Actuator]:
    """Return one part for each limited input; beyond a limit it replaces the input by the limit.

    Args:
        limits: Lower and upper limit of each input, (m, 2); infinite where there is none.
        u: Rows of the input before its limits, u = u[cell of x_d] z, (l, m, N).
        generator: The part that has these l cells. Where u depends on them, so do the guards, and the
            segments of the actuator are told apart within each of these cells.
        plant, model: What u drives: the plant that runs, and the one in the observer.
        at: Where x and x̂ sit in z.
    """
    parts = list[Actuator]()
    for k, (low, high) in enumerate(limits.tolist()):
        segments: list[tuple[str, float | None]] = [("linear", None)]
        segments = [("low", low)] * bool(np.isfinite(low)) + segments + [("high", high)] * bool(np.isfinite(high))
        if len(segments) == 1:
            continue
        switched = bool((u[:, k] != u[0, k]).any())
        rows = u[:, k] if switched else u[:1, k]
        levels = [level for _, level in segments if level is not None]
        guards = np.repeat(rows, len(levels), axis=0)
        guards[:, -1] -= np.tile(levels, len(rows))
        sides = 2 * np.tri(len(segments), len(levels), -1, dtype=np.int64) - 1
        signs = np.kron(np.eye(len(rows), dtype=np.int64), sides)
        if switched:
            guards = np.vstack([generator.guards, guards])
            signs = np.hstack([np.repeat(generator.signs, len(segments), axis=0), signs])
        replaced = np.zeros((len(rows), len(segments), len(limits), at.order))  # what is added to u
        for j, (_, level) in enumerate(segments):
            if level is not None:
                replaced[:, j, k] = -rows
                replaced[:, j, k, -1] += level
        F = [at.driven(change, plant, model) for change in replaced.reshape(-1, len(limits), at.order)]
        cells = tuple(name for name, _ in segments) * len(rows)
        parts.append(
            Actuator(
                name=f"actuator {model.inputs[k]}",
                cells=cells,
                guards=guards,
                signs=signs,
                F=np.array(F),
                input=k,
                levels=tuple(level for _, level in segments) * len(rows),
            )
        )
    return parts


def rate_limits(steps: Array, model: PWASystem, at: Layout) -> list[RateLimit]:
    """Return one part for each input of a sampled controller whose changes are limited.

    Args:
        steps: By how much each input may change from one sample to the next, (m,); infinite where there is no limit.
        model: It has the names.
        at: Where everything sits in z.
    """
    parts, z = list[RateLimit](), np.eye(at.order)
    for k in np.flatnonzero(np.isfinite(steps)).tolist():
        change, most = z[at.change.start + k], float(steps[k])
        parts.append(
            RateLimit(
                name=f"rate {model.inputs[k]}",
                cells=("falls", "free", "rises"),
                guards=np.array([change + most * z[-1], change - most * z[-1]]),
                signs=np.array([[-1, -1], [1, -1], [1, 1]]),
                F=np.zeros((3, at.order, at.order)),
                input=k,
                most=most,
            )
        )
    return parts
