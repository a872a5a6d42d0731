"""A program as the arrays that its compiled form works on."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pwatrack.arrays import Array, IntArray
from pwatrack.control.program import SampledController
from pwatrack.model.conditions import Sampling

if TYPE_CHECKING:
    from pwatrack.simulation.kernel import ControllerArrays

_EVER = 2.0**100  # s
_AT_ONCE = 1_000_000  # signs that are looked at together
COUNTS = np.dtype([(name, np.int64) for name in ("started", "tick", "since", "piece", "cell", "cell_d", "status")])


def routine(program: SampledController, real: Any = np.float64) -> "ControllerArrays":
    """Return a program as arrays, of double or single floats."""
    from pwatrack.simulation.kernel import ControllerArrays, Places

    def numbers(values: Array) -> NDArray[Any]:
        return np.array(values, dtype=real, order="C")  # a copy: what is compiled is for arrays that may change

    def whole(values: Any) -> IntArray:
        return np.array(values, dtype=np.int64, order="C")

    of = program.sizes
    corrects, h = program.sampling.corrects, program.sampling.sample_time
    near = np.sqrt(np.finfo(real).eps) * (program.pace[:, 1:4] * h ** np.arange(1, 4)).min(axis=1, keepdims=True)
    windows = program.windows
    kept = windows * np.arange(4, 4 + windows.shape[1])
    s, known = of["s"], of["N"] - of["n"] + of["p"] + of["s"]
    follows = program.follows if s else None
    pieces, end = ((), None) if follows is None else (follows.pieces, follows.end)
    ticks, starts = [piece.tick for piece in pieces], np.cumsum([0, *(len(piece.w) for piece in pieces)])
    floats = ("H", "h", "observer", "M", "E", "generator", "x_d", "u_ff", "K", "guards", "change", "quantum")
    return ControllerArrays(
        at=Places(
            **of,
            known=known,
            delay=program.sampling.delay,
            ahead=program.sampling.ahead,
            substeps=program.substeps,
            **{key: at.start for key, at in program.places.items()},
        ),
        C=numbers(program.C[: len(program.C) * corrects]),
        **{name: numbers(getattr(program, name)) for name in floats},
        signs=whole(program.signs),
        sides=whole(program.sides),
        turn=numbers(np.zeros((0, s, s)) if follows is None else follows.turn),
        piece_values=numbers(np.concatenate([np.zeros(0), *(piece.w for piece in pieces)])),
        piece_tick=whole(ticks),
        piece_start=whole([piece.start for piece in pieces]),
        piece_length=whole(np.diff(starts)),
        piece_value=whole(starts[:-1]),
        low=numbers(program.limits[:, 0]),
        high=numbers(program.limits[:, 1]),
        pace=numbers(np.hstack([program.pace, near])),
        lowest=numbers(program.set_range[:, 0]),
        highest=numbers(program.set_range[:, 1]),
        windows=whole(windows),
        window_start=whole((np.cumsum(kept) - kept.ravel()).reshape(kept.shape)),
        weights=numbers(np.stack([windows, windows * h, h / (12 * windows)], axis=-1)),
        timing=numbers(np.array([h, 0.5, 1 / 3, _EVER, 0.0])),
        half=real(0.5),
        most=int(np.unique(ticks, return_counts=True)[1].max(initial=0)),
        end=-1 if end is None else end,
        last=max([-1, *ticks]) if end is None else end,
    )


def memory(
    program: SampledController, x_hat: ArrayLike, eta_hat: ArrayLike, real: Any = np.float64
) -> dict[str, NDArray[Any]]:
    """Return what the program remembers, as it starts, and room to work in: `memory`, `counts` and `room` of a tick.

    It starts from x̂(0), then ŝ(0), (N,), and η̂(0), (p,); where inputs are for later ticks, η̂ has gone on to the first.
    """
    at = program.places
    found = np.zeros(at["x_d"].stop, dtype=real)
    for w in () if program.follows is None else program.follows.early:
        known = np.concatenate([np.asarray(x_hat)[program.sizes["n"] :], eta_hat, w, [1.0]])
        eta_hat = program.generator[cell(program.sides, program.guards @ known)] @ known
    found[at["x_hat"].start : at["s_hat"].stop], found[at["eta_hat"]] = x_hat, eta_hat
    found[at["course"]][3::4] = program.pace[:, 0]
    past = [
        np.repeat([start, 0.0], [k, (3 + n) * k])
        for start, row in zip(program.pace[:, 0], program.windows, strict=True)
        for n, k in enumerate(row)
    ]
    found[at["past"]] = np.concatenate([np.zeros(0), *past])
    if program.follows is not None:
        found[at["w"]], found[at["copies"]] = program.follows.w0, np.tile(program.follows.w0, 2)
    return {"memory": found, "counts": np.zeros(2, COUNTS), "room": np.zeros(at["made"].stop, dtype=real)}


def cell(signs: IntArray, g: Array) -> int:
    """Return the first cell whose signs the guards contradict least."""
    return int(cells(signs, g[None])[0])


def cells(signs: IntArray, g: Array) -> IntArray:
    """Return that of each row of guards, (count, k)."""
    some = max(1, _AT_ONCE // max(1, signs.size))
    blocks = (g[first : first + some, None] for first in range(0, len(g), some))
    found = [np.maximum(-signs * each, 0.0).max(axis=2, initial=0.0).argmin(axis=1) for each in blocks]
    return np.concatenate([np.zeros(0, dtype=np.int64), *found])


_NOTHING: dict[str, Any] = dict.fromkeys(("C", "M", "E", "H", "K"), np.zeros((0, 0)))
_NOTHING |= dict.fromkeys(("h", "change", "quantum"), np.zeros(0)) | {"guards": np.zeros((0, 1))}
_NOTHING |= dict.fromkeys(("observer", "generator", "x_d", "u_ff"), np.zeros((0, 0, 1))) | {"limits": np.zeros((0, 2))}
_NOTHING |= dict.fromkeys(("signs", "sides"), np.zeros((0, 0), dtype=np.int64))
NONE = SampledController(
    sampling=Sampling(sample_time=1.0), substeps=1, follows=None, **_NOTHING
)  # one that never runs
