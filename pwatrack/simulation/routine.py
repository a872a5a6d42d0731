"""A program as the arrays that its compiled form works on."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pwatrack.arrays import Array, IntArray
from pwatrack.control.program import Follows, Program
from pwatrack.model.conditions import Sampling

if TYPE_CHECKING:
    from pwatrack.simulation.kernel import Routine

COUNTS = 6  # whether it has run, ticks, ticks since a piece of the reference began, pieces so far, cells of x̂ and x_d
_NEVER = 2**62  # ticks


def routine(program: Program, real: Any = np.float64) -> "Routine":
    """Return a program as arrays, of double or single floats."""
    from pwatrack.simulation.kernel import Routine

    def numbers(values: Array) -> NDArray[Any]:
        return np.array(values, dtype=real, order="C")  # a copy: what is compiled is for arrays that may change

    def whole(values: list[int]) -> IntArray:
        return np.array(values, dtype=np.int64)

    s = program.sizes["s"]
    follows = program.follows or Follows(turn=np.zeros((0, s, s)), w0=np.zeros(s), pieces=(), end=None)
    pieces = follows.pieces
    starts = np.cumsum([0, *(len(piece.w) for piece in pieces)]).tolist()
    return Routine(
        H=numbers(program.H),
        h=numbers(program.h),
        signs=np.array(program.signs, dtype=np.int64, order="C"),
        guards=numbers(program.guards),
        sides=np.array(program.sides, dtype=np.int64, order="C"),
        observer=numbers(program.observer),
        generator=numbers(program.generator),
        x_d=numbers(program.x_d),
        u_ff=numbers(program.u_ff),
        K=numbers(program.K),
        low=numbers(program.limits[:, 0]),
        high=numbers(program.limits[:, 1]),
        change=numbers(program.change),
        quantum=numbers(program.quantum),
        turn=numbers(follows.turn),
        piece_tick=whole([piece.tick for piece in pieces]),
        piece_start=whole([piece.start for piece in pieces]),
        piece_stop=whole([piece.start + len(piece.w) for piece in pieces]),
        piece_value=whole(starts[:-1]),
        values=numbers(np.concatenate([np.zeros(0), *(piece.w for piece in pieces)])),
        end=_NEVER if follows.end is None else follows.end,
        delay=program.sampling.delay,
    )


def memory(program: Program, x_hat: Array, eta_hat: Array, real: Any = np.float64) -> NDArray[Any]:
    """Return what the program starts with: x̂ with ŝ, η̂, the reference at its first tick, and 0.

    Args:
        program: The program.
        x_hat: x̂(0), then ŝ(0), (N,).
        eta_hat: η̂(0), (p,).
        real: Type of float.
    """
    at = program.places
    found = np.zeros(at["x_d"].stop, dtype=real)
    found[at["x_hat"].start : at["s_hat"].stop], found[at["eta_hat"]] = x_hat, eta_hat
    if program.follows is not None:
        found[at["w"]], found[at["w_copies"]] = program.follows.w0, np.tile(program.follows.w0, 2)
    return found


def room(program: Program, real: Any = np.float64) -> NDArray[Any]:
    """Return room to work in."""
    return np.zeros(program.places["x_d"].stop + max(len(program.h), len(program.guards)), dtype=real)


NONE = Program(  # one that never runs
    sampling=Sampling(sample_time=1.0),
    H=np.zeros((0, 0)),
    h=np.zeros(0),
    signs=np.zeros((0, 0), dtype=np.int64),
    observer=np.zeros((0, 0, 1)),
    generator=np.zeros((0, 0, 1)),
    guards=np.zeros((0, 1)),
    sides=np.zeros((0, 0), dtype=np.int64),
    x_d=np.zeros((0, 0, 1)),
    u_ff=np.zeros((0, 0, 1)),
    K=np.zeros((0, 0)),
    limits=np.zeros((0, 2)),
    change=np.zeros(0),
    quantum=np.zeros(0),
    follows=None,
)
