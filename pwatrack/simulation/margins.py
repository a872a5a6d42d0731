"""How far the loop of a cell by itself is from where it is not stable: gain, phase and delay at an input of the plant.

They are read off the loop transfer in floating point, and are about one cell that is never left: no proof of switching.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pwatrack.arrays import EPS, Array
from pwatrack.control.controller import ProvedController
from pwatrack.simulation.closed_loop import closed_loop
from pwatrack.simulation.modes import NOTHING

_POINTS = 400  # of a grid of frequencies, beside those around each mode
_BEYOND = 100.0  # times the fastest mode and below the slowest it goes
_AROUND = np.linspace(-5.0, 5.0, 11)  # half widths of a resonance that are looked at
_BESIDE = 1 + 1e-7  # at a mode that is not damped there is no L(jω)
_NEXT = 8 * EPS  # of a frequency: by no more are ω and its neighbours apart
_ROUNDS = 40  # of halving the interval of a crossing
_NO_GAIN = (
    1e-9  # times what it is: a gain that may be less is as good as none, where a pole at 0 is so but for rounding
)
_MOST_WORK = 3_000_000_000  # cells · inputs · frequencies · order³: a few seconds

Frequencies = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Margins:
    """What the loop of one cell may be changed by at one input before it is not stable."""

    cell: int  # which
    input: int  # likewise
    # between which factors the input may be scaled; from 0, to infinity, where nothing ends it
    gain: tuple[float, float]
    phase: float  # by how much it may be turned to either side, in rad; π where the gain is 1 at no frequency
    delay: float  # by how much it may be late, in s; infinite likewise
    crossover: float  # the highest frequency at which the gain is 1, in rad/s; 0 where there is none
    stable: bool  # whether it is, as it is

    @property
    def least_gain(self) -> float:
        """The factor, either way, that the input may be scaled by."""
        low, high = self.gain
        return min(high, 1 / low if low else np.inf)


def loop_margins(controller: ProvedController) -> list[Margins]:
    """Return the margins of each different cell of the plant of a design at each input; nothing where that takes long.

    The loop is broken at one input of the plant, behind observer and K; the observer knows what was to be put out.

    Example: u = −2 x̂ for x' = u, and an observer that is never wrong as it knows u: the loop is 2/s.

        >>> from pwatrack import design, load_spec
        >>> found = loop_margins(design(load_spec("specs/two_mass_paper_gains.yaml")))
        >>> len(found), all(one.gain[0] < 1 < one.gain[1] and one.phase > 0 < one.delay for one in found)
        (2, True)
    """
    plant = replace(controller.plant, watched=None)
    loop = closed_loop(replace(controller, plant=plant, running=plant))
    at, flow = loop.at, loop.flow
    keep = np.r_[at.x, at.x_hat, at.s_hat, at.eta_hat]
    counted = np.zeros((at.order, at.order)) if flow.counted is None else flow.counted
    drive = np.zeros((at.order, plant.B.shape[1]))
    drive[at.x] = plant.B
    drive = (drive - counted @ drive)[keep]
    cells = {flow.matrix((i,) * 3)[np.ix_(keep, keep)].tobytes(): i for i in reversed(range(len(plant.A)))}
    if len(cells) * plant.B.shape[1] * (_POINTS + len(_AROUND) * len(keep)) * len(keep) ** 3 > _MOST_WORK:
        return []
    found = list[Margins]()
    for cell in sorted(cells.values()):
        M, rows = flow.matrix((cell,) * 3)[np.ix_(keep, keep)], flow.rows(loop.u[cell])[:, keep]
        for k in range(plant.B.shape[1]):
            if drive[:, k].any() and rows[k].any():
                found.append(_margins(M, drive[:, k], rows[k], cell, k))
    return found


def worst(found: Sequence[Margins]) -> Margins | None:
    """Return the least of all margins at any input, with the cell of the least phase; None where there are none."""
    if not found:
        return None
    least = min(found, key=lambda one: one.phase)
    return replace(
        least,
        gain=(max(one.gain[0] for one in found), min(one.gain[1] for one in found)),
        delay=min(one.delay for one in found),
        crossover=max(one.crossover for one in found),
        stable=all(one.stable for one in found),
    )


def margin_figures(controller: ProvedController) -> dict[str, float]:
    """Return the least of all margins: gain as a factor either way, phase in °, delay in s; {} where none is known.

    Example:
        >>> from pwatrack import design, load_spec
        >>> found = margin_figures(design(load_spec("specs/two_mass_paper_gains.yaml")))
        >>> [f"{name} {value:.3g}" for name, value in found.items()]
        ['gain_margin 1.97', 'phase_margin 23.5', 'delay_margin 0.407']
    """
    found = worst(loop_margins(controller))
    if found is None:
        return {}
    return {
        "gain_margin": found.least_gain,
        "phase_margin": float(np.degrees(found.phase)),
        "delay_margin": found.delay,
    }


def _margins(M: Array, g: Array, row: Array, cell: int, k: int) -> Margins:
    """Return the margins of ż = M z, in which g row z is what passes the input: stable as 1 − L(jω) turns about 0."""
    opened = M - np.outer(g, row)

    def transfer(frequencies: Frequencies) -> NDArray[np.complex128]:
        return response(opened, g, row, frequencies)

    values = np.concatenate([np.linalg.eigvals(M), np.linalg.eigvals(opened)])  # all that it does is seen near these
    sizes = np.abs(values)
    sizes = sizes[sizes > NOTHING * sizes.max(initial=0.0)]
    low, high = (sizes.min(), sizes.max()) if len(sizes) else (1.0, 1.0)
    near = (np.abs(values.imag)[:, None] + np.abs(values.real)[:, None] * _AROUND).ravel()
    grid = np.concatenate([np.geomspace(low / _BEYOND, high * _BEYOND, _POINTS), near * _BESIDE])
    grid = np.unique(grid[grid >= low / _BEYOND])
    passing = _crossings(transfer, grid, lambda L: np.log(np.abs(L) + np.finfo(float).tiny))
    angles = np.angle(transfer(passing)) if len(passing) else np.zeros(0)
    turned = transfer(_crossings(transfer, grid, lambda L: L.imag))
    ends = transfer(grid[:1])  # towards 0 it is real
    factors = [1 / L.real for L in (*turned, *ends[np.abs(ends.imag) <= 0.1 * np.abs(ends.real)]) if L.real > 0]
    low, high = max((f for f in factors if f < 1), default=0.0), min((f for f in factors if f > 1), default=np.inf)
    return Margins(
        cell=cell,
        input=k,
        gain=(float(low) if low > _NO_GAIN else 0.0, float(high)),
        phase=float(np.abs(angles).min(initial=np.pi)),
        delay=float(np.min(np.mod(angles, 2 * np.pi) / passing, initial=np.inf)),
        crossover=float(passing.max(initial=0.0)),
        stable=bool((values[: len(M)].real < 0).all()),
    )


def response(A: Array, b: Array, c: Array, frequencies: Frequencies) -> NDArray[np.complex128]:
    """Return c (jω − A)⁻¹ b; where one of these ω, in rad/s, is a pole to the last bit, all for the next doubles."""
    for omega in (frequencies, frequencies * (1 + _NEXT), frequencies * (1 - _NEXT)):
        shifted = 1j * omega[:, None, None] * np.eye(len(A)) - A
        with suppress(np.linalg.LinAlgError):
            return np.asarray(np.linalg.solve(shifted, b[:, None].astype(complex))[..., 0] @ c)
    return np.full(len(frequencies), np.inf + 0j)


def _crossings(
    transfer: Callable[[Frequencies], NDArray[np.complex128]],
    grid: Frequencies,
    of: Callable[[NDArray[np.complex128]], Array],
) -> Frequencies:
    """Return where a function of L(jω) changes its sign between points of a grid, in rad/s."""
    signs = of(transfer(grid)) > 0
    at = np.flatnonzero(signs[1:] != signs[:-1])
    low, high = grid[at], grid[at + 1]
    for _ in range(_ROUNDS if len(at) else 0):
        middle = np.sqrt(low * high)
        below = (of(transfer(middle)) > 0) == signs[at]
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return np.asarray(np.sqrt(low * high))
