"""Forms that prove a loop that is sampled, looked for with as many substeps and knots as it takes, within a budget."""

from dataclasses import replace

import numpy as np

from pwatrack.control.sampled_error import SampledErrors
from pwatrack.control.sampled_gains import SampledGains
from pwatrack.control.vertices import outermost_cells
from pwatrack.lmi.clocked import ClockedProof, fastest
from pwatrack.model.pwa import PWASystem

_KNOTS = (1, 2, 4)  # segments of a substep that are tried
_MORE = (1, 2, 4)  # times as many substeps of a prediction are tried
_MOST_WORK = 40_000  # inequalities times the square of their order: an auditor takes about 10 steps for each
_MOST_CELLS = 200  # of a hull, that are looked at one by one


def too_much(plant: PWASystem, gains: SampledGains) -> str:
    """Say why nothing is tried; "" where it is."""
    if not (np.isfinite(gains.K).all() and np.isfinite(gains.M).all()):
        return "its gains are out of range: a sample is too long"
    if _least_work(plant, gains) > _MOST_WORK:
        return "its cells are too many"
    errors = SampledErrors.of(plant, gains)
    if not _tried(errors):
        return f"it takes {_inequalities(errors)} inequalities of order {errors.order}, which is too much"
    return ""


def with_forms(plant: PWASystem, gains: SampledGains) -> tuple[SampledGains, ClockedProof] | None:
    """Return gains with as many substeps as a proof needs, and that proof; None where none is found."""
    for more in _MORE if gains.substeps > 1 else (1,):
        finer = replace(gains, substeps=more * gains.substeps)
        errors = SampledErrors.of(plant, finer)
        for knots in _tried(errors):
            proof = fastest(errors.clocked, knots=knots)
            if proof is not None:
                return finer, proof
    return None


def _tried(errors: SampledErrors) -> list[int]:
    """Return the numbers of segments of a substep that are tried."""
    work = _inequalities(errors) * errors.order**2
    return [knots for knots in _KNOTS if work * knots <= _MOST_WORK]


def _inequalities(errors: SampledErrors) -> int:
    """Return how many there are between ticks, for one segment in each substep."""
    of_each = len(errors.cells) * max(1, len(errors.changes))
    return int(2 * errors.parts * len(errors.paces) * len(errors.cells) * of_each**errors.predicted)


def _least_work(plant: PWASystem, gains: SampledGains) -> int:
    """Return what inequalities times the square of their order are at least, without looking for changes.

    There are as many of these as cells at least: a hull of differences has no fewer corners than the hull.
    """
    cells = len(plant.hull) if len(plant.hull) > _MOST_CELLS else len(outermost_cells(plant))
    parts, predicted = gains.substeps if cells > 1 else 1, max(1, gains.delay)
    order = sum(plant.B.shape) + predicted * (plant.observed.C.shape[1] + (cells > 1))
    return int(2 * parts * cells ** (1 + 2 * predicted) * order**2)
