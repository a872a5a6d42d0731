"""Limits of the inputs: u is cut off at a lower and an upper limit, and kept from changing too fast."""

from dataclasses import dataclass

import numpy as np

from pwatrack.arrays import Array
from pwatrack.model.pwa import PWASystem
from pwatrack.simulation.flow import SwitchedPart
from pwatrack.simulation.layout import Layout


@dataclass(frozen=True, kw_only=True)
class Actuator(SwitchedPart):
    """The part of a limited input, whose cells are its segments."""

    input: int  # which one it is, from 0
    levels: tuple[float | None, ...]  # at which limit it holds the input in each cell; None where it lets it through


@dataclass(frozen=True, kw_only=True)
class RateLimit(SwitchedPart):
    """The part of an input that may change by so much from one sample to the next."""

    input: int  # which one it is, from 0
    most: float


def actuators(
    limits: Array, u: Array, generator: SwitchedPart, plant: PWASystem, model: PWASystem, at: Layout
) -> list[Actuator]:
    """Return one part for each limited input; beyond a limit it replaces the input by the limit.

    The limits are lower and upper ones, (m, 2), infinite where there is none; u are the rows of the input before them,
    u = u[cell of x_d] z, (l, m, N). Where these depend on the cell of the generator, so do the guards, and the segments
    of the actuator are told apart within each cell. u drives the plant that runs, and its model in the observer.
    """
    parts = list[Actuator]()
    for k, (low, high) in enumerate(limits.tolist()):
        all_: list[tuple[str, float | None]] = [("low", low), ("linear", None), ("high", high)]
        segments = [one for one in all_ if one[1] is None or np.isfinite(one[1])]
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
    """Return one part for each input of a sampled controller that may change by so much in a sample only, (m,)."""
    change, one = np.eye(at.order)[at.change], np.eye(at.order)[-1]
    return [
        RateLimit(
            name=f"rate {model.inputs[k]}",
            cells=("falls", "free", "rises"),
            guards=np.array([change[k] + most * one, change[k] - most * one]),
            signs=np.array([[-1, -1], [1, -1], [1, 1]]),
            F=np.zeros((3, at.order, at.order)),
            input=k,
            most=most,
        )
        for k, most in enumerate(steps.tolist())
        if np.isfinite(most)
    ]
