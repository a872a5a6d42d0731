"""The start of a run as something that acts on the errors of a sampled loop, once."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from pwatrack.arrays import Array, alike
from pwatrack.ball_matrix import BallMatrix
from pwatrack.claims.exact_text import doubles
from pwatrack.control.bounds import Channel
from pwatrack.control.controller import Asked, ProvedController
from pwatrack.control.sampled_disturbances import ROUNDING, Acting, begun
from pwatrack.control.sampled_error import SampledErrors


def from_start(
    controller: ProvedController, asked: Asked, errors: SampledErrors, acts: Acting
) -> tuple[SampledErrors, Acting]:
    """Return them with the start of the run, where it is known, as something more that acts.

    Where inputs are late that is where the run is as the first one acts.
    """
    noise = acts.noise(len(controller.plant.C))
    if errors.gains.delay:
        late = asked.late(controller, errors, noise)
        if late is None or late.substeps >= len(acts.near):
            return errors, acts
        return _begun(errors, acts.after(late), begun(errors, acts, late))
    starts = asked.begins(controller)
    if starts is None:
        return errors, acts
    if asked.measured is not None:
        loads = len(controller.L) - len(controller.plant.B)
        starts = starts.with_more(asked.measured * noise, loads)
    return _begun(errors, acts, errors.before(starts))


def _begun(errors: SampledErrors, acts: Acting, columns: Array) -> tuple[SampledErrors, Acting]:
    """Return them with what z is a mean of as the first input acts, of any sign, (order, k)."""
    sizes = np.abs(columns) / np.array(errors.clocked.sizes)[:, None]
    columns = columns[:, (sizes > ROUNDING).any(axis=0)]
    first = np.zeros(len(acts.near))
    first[errors.gains.delay * errors.gains.substeps] = 1.0
    squares = dict(acts.squares) | {("start", k): first for k in range(columns.shape[1])}
    starts_at = [BallMatrix.of(column[:, None], (errors.order, 1)) for column in columns.T]
    return replace(errors, starts=starts_at), replace(acts, squares=squares)


def is_start(errors: SampledErrors, start: Array, noise: Array) -> bool:
    """Say whether errors (e, Δ, σ) after the first tick follow from these starts, with so much noise at most, (q,)."""
    if errors.starts is None:
        return False
    (n, m, N, *_), M, of = errors.widths, errors.gains.M, errors.estimates
    before = np.hstack([np.zeros((errors.order, 0)), *(column.floats for column in errors.starts)])
    corrected = np.eye(N) + M @ errors.plant.observed.C.floats
    after = np.vstack([before[:n], corrected @ before[n + m : n + m + N]])
    drawn = np.vstack([np.zeros((n, len(noise))), M * noise])
    sizes = np.array(errors.clocked.sizes)[[*range(n), *range(n + m, n + m + N)], None]
    e = start[:n] if of is None else start[:n] + of.X.floats @ start[2 * n :]
    columns, z = np.hstack([after, drawn]) / sizes, np.append(e, start[n:])[:, None] / sizes
    parts = np.linalg.lstsq(columns, z)[0]
    return bool(np.abs(columns @ parts - z).max() <= ROUNDING and np.abs(parts).max(initial=0.0) <= 1 + ROUNDING)


def of_this_start(told: Mapping[Channel, Any], errors: SampledErrors) -> tuple[bool, SampledErrors]:
    """Return errors with the start that a certificate tells of, and whether it is that of the run."""
    starts = errors.starts or ()
    found = [doubles([told[channel]])[0] for channel in sorted(told)]
    own = [column.floats[:, 0] for column in starts]
    same = len(own) == len(found) and all(alike(*both, together=True) for both in zip(found, own, strict=True))
    if not (same and found):
        return same, errors
    return True, replace(errors, starts=[BallMatrix.of(z[:, None], (len(z), 1)) for z in found])
