"""What the program of a sampled loop makes of its reference at its ticks, with the true loads in place of ŝ."""

from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, expm

from pwatrack.arrays import Array
from pwatrack.control.program import SampledController
from pwatrack.simulation.controller_arrays import cell, cells
from pwatrack.simulation.loads_along import LoadsAlong
from pwatrack.simulation.recursions import powers

_LONGEST = 4096  # ticks that are made at once
_SHORTEST = 16  # those at first, and after x_d changed its cell, and then each time twice as many


class AtTicks(NamedTuple):
    """What it has at some ticks, a row each; u_ff is 0 before the first input that it puts out."""

    x_d: Array
    u_ff: Array
    eta_hat: Array
    w: Array
    s: Array


class Held:
    """x_d, u_ff, η̂, w and s as the program has them for what it holds from each tick on, from η̂(0) at the first.

    In a cell of x_d (s, η̂, w, 1) is multiplied by one matrix from tick to tick, till a load steps or w has a new piece.
    """

    def __init__(self, runs: SampledController, eta: Array, loads: LoadsAlong) -> None:
        follows, h, ahead = runs.follows, runs.sampling.sample_time, runs.sampling.ahead
        assert follows is not None
        k, p, s = len(loads.start), len(eta), len(follows.w0)
        known = block_diag(expm(loads.S * (-ahead * h)), np.eye(p + s + 1))  # ŝ is that of the tick, before u acts
        self._x_d, self._u_ff = runs.x_d @ known, runs.u_ff @ known
        self._guards, self._sides = runs.guards @ known, runs.sides
        turn: Array = follows.turn[0] if s else np.zeros((0, 0))
        later = block_diag(expm(loads.S * h), np.zeros((p, p)), turn, np.eye(1))
        self._turns = np.tile(later, (len(self._x_d), 1, 1))
        self._turns[:, k : k + p] = runs.generator @ known
        self._z, self._tick, self._length = np.concatenate([loads.start, eta, follows.w0, [1.0]]), 0, _SHORTEST
        self._edges, self._early = [k, k + p, k + p + s], len(follows.early)
        self._steps = {tick: step for tick, step in loads.steps.items() if tick}
        self._pieces = dict[int, list[tuple[int, Array]]]()  # of w: where each begins, and what is there
        for tick, w in enumerate([*follows.early, follows.w0]):
            self._pieces[tick] = [(0, w)]
        for piece in sorted(follows.pieces, key=lambda piece: (piece.tick, piece.start)):
            self._pieces.setdefault(self._early + max(piece.tick, 0), []).append((piece.start, piece.w))
        self._changes = sorted({*self._steps, *self._pieces})

    def take(self, count: int) -> AtTicks:
        """Return what it has at the next ticks, so many."""
        first, found = self._tick, list[tuple[Array, Array, Array]]()
        while self._tick < first + count:
            found.append(self._stretch(first + count - self._tick))
        x_d, u_ff, z = (np.vstack(each) for each in zip(*found, strict=True))
        u_ff[: max(self._early - first, 0)] = 0.0
        s, eta, w, _ = np.split(z, self._edges, axis=1)
        return AtTicks(x_d, u_ff, eta, w, s)

    def _stretch(self, most: int) -> tuple[Array, Array, Array]:
        """Return x_d, u_ff and (s, η̂, w, 1) up to where one matrix no longer does, or so many."""
        if self._changes[:1] == [self._tick]:
            tick, (k, at, _) = self._changes.pop(0), self._edges
            for start, w in self._pieces.get(tick, ()):
                self._z[at + start :][: len(w)] = w
            self._z[:k] += self._steps.get(tick, 0.0)
        more, here = min(most, self._length), cell(self._sides, self._guards @ self._z)
        if self._changes:
            more = min(more, self._changes[0] - self._tick)
        z = powers(self._turns[here], self._z, more + 1)
        other = cells(self._sides, z[1:-1] @ self._guards.T) != here
        self._length = min(2 * self._length, _LONGEST)
        if other.any():
            more, self._length = 1 + int(other.argmax()), _SHORTEST
        self._z, self._tick, z = z[more], self._tick + more, z[:more]
        return z @ self._x_d[here].T, z @ self._u_ff[here].T, z
