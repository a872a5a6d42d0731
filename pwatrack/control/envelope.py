"""How large each signal may be over time, from where a run starts and under what acts on it: the proofs of `bounds`.

Every ellipsoid of `bounds` is one for a start too: V = zᵀ Q⁻¹ z has √V ≤ √V(0) e^(−a t / 2) + sup |d|, so each linear
form c z of a loop is at most √(c Q cᵀ) √V(0) e^(−a t / 2), plus what d does from 0. The least of all of these holds,
and so does the sum of the bounds for each entry of the start.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from pwatrack.arrays import OVER_POWERS, Array
from pwatrack.control.bounds import Bounds, Channel, Form
from pwatrack.control.trajectory import NoncausalTrajectory
from pwatrack.lmi.exact import Packed
from pwatrack.lmi.norm import root_above
from pwatrack.rational import doubles


def from_start(
    found: Sequence[Bounds], starts: Sequence[Bounds], start: Array, t: Array, *, states: int
) -> dict[Form, Array]:
    """Return the most that each signal is over time from a start, (K,), where nothing else acts and it is proved.

    Args:
        found: Bounds whose ellipsoids are looked at.
        starts: Those of all entries of a start, or none.
        start: (x − x_d, x̂ − x, ŝ − s) at t = 0, (2 n + p,).
        t: Times in s, (K,).
        states: n.

    Example: from 0 nothing comes.

        >>> from pwatrack import design, load_spec
        >>> controller = design(load_spec("specs/two_mass_backlash.yaml"))
        >>> still = from_start(controller.bounds, controller.starts, np.zeros(8), np.zeros(1), states=4)
        >>> still["output", 0].tolist()
        [0.0]
    """
    most: dict[Form, Array] = {}
    first = [bounds.channel[1] for bounds in starts]
    for signal in {signal for bounds in starts for signal in bounds.sizes}:
        if all(signal in bounds.sizes for bounds in starts):
            groups = zip(starts, np.split(start, first[1:]), strict=True)
            total = sum(bounds.sizes[signal] * float(np.linalg.norm(entries)) for bounds, entries in groups)
            most[signal] = np.full(len(t), total * OVER_POWERS)
    for part in (part for bounds in (*found, *starts) for part in bounds.parts):
        if part.loop == "controller":
            continue  # e by itself is driven by Δ
        size = _norm(part.ellipsoid, start if part.loop == "joint" else start[states:])
        decay = size * np.exp(-part.ellipsoid.a / 2 * t) * OVER_POWERS
        for signal, bound in zip(part.signals, part.ellipsoid.sizes, strict=True):
            if part.loop == "joint" or signal[0] == "estimate":  # the observer's loop has its half of others
                most[signal] = np.minimum(most.get(signal, np.inf), bound * decay)
    return most


def from_preview(found: Sequence[Bounds], columns: Array, preview: NoncausalTrajectory) -> dict[Form, float]:
    """Return the most that each signal is where η is off by what is played back, from error 0; nothing else acts.

    It drives e and not Δ, so that ellipsoids of e by itself do, and Δ stays 0.

    Args:
        found: Bounds whose ellipsoids are looked at.
        columns: What 1 of each η is of e, in each cell, (l, n, p).
        preview: By how much η is off.
    """
    most: dict[Form, float] = {}
    for part in (part for bounds in found for part in bounds.parts):
        if part.loop == "observer":
            most |= {signal: 0.0 for signal in part.signals if signal[0] == "estimate"}
            continue
        Q, rest = part.ellipsoid, [0.0] * (len(part.ellipsoid.exponents) - columns.shape[1])
        each = [[_norm(Q, np.append(column, rest)) for column in cell.T] for cell in columns]
        size = preview.measured(np.array(each), Q.a / 2) * OVER_POWERS
        for signal, bound in zip(part.signals, Q.sizes, strict=True):
            most[signal] = 0.0 if signal[0] == "estimate" else min(most.get(signal, np.inf), bound * size)
    return most


def with_acting(
    most: Mapping[Form, Array], found: Sequence[Bounds], acting: Mapping[Channel, Array]
) -> dict[Form, Array]:
    """Add what disturbances and noises do, as large as each has been so far, where all of that is bounded.

    Args:
        most: From `from_start`.
        found: The bounds of what acts.
        acting: The largest size of each so far, (K,).
    """
    by_channel = {bounds.channel: bounds.sizes for bounds in found}
    return {
        signal: values + sum(by_channel[channel][signal] * size * OVER_POWERS for channel, size in acting.items())
        for signal, values in most.items()
        if all(signal in by_channel[channel] for channel in acting)
    }


def _norm(Q: Packed, z: Array) -> float:
    """Return √(zᵀ Q⁻¹ z), rounded up."""
    column = doubles(z[:, None])
    return root_above((column.transpose() * Q.P.solve(column))[0, 0])
