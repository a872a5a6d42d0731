"""Practical tracking: where cells are merged, errors end below a bound that is proved for every signal.

Let f = f̃ + Σ E_k w_k with |w_k| ≤ w̄_k at every x (see `model.merging`), and let (8), (9) and (17) hold for f̃. Generator
and feedforward run f̃, the plant is f. With e = x − x_d and Δ = x̂ − x, and an observer that runs f̃ too,

    (e, Δ)' = M (e, Δ) + Σ (E_k, −E_k) w_k,      M ∈ conv{M_ij},  M_ij = [Ã_i + B K, B K; 0, Ã_j + L C],

for f̃(x) − f̃(x_d) = Â e and f̃(x̂) − f̃(x) = Ã Δ with Â and Ã in conv{Ã_i}. It is linear in its start and in all w_k
together: what the start leaves goes to 0, and each w_k by itself is bounded as any disturbance is, by an ellipsoid (see
`lmi.ellipsoid`) for each signal. An ellipsoid for several w_k with weights that sum to 1 gives nothing less than that
sum: p_k Q is one for w_k alone. Where the loop has one matrix its peak gain is enclosed instead (see `lmi.chords`).

Where (9) holds for the cells of f the observer may run these: then Δ goes to 0 whatever w does, and in the end
e' = (Â + B K) e + Σ E_k w_k.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from typing import Any, Literal

import numpy as np

from pwatrack.arrays import OVER_SUMS
from pwatrack.ball_matrix import BallMatrix, above
from pwatrack.control.bounds import Bounds, Channel, Form, Loop, Loops, Part, ProvedPeak, of_loop
from pwatrack.control.synthesis import Design
from pwatrack.errors import Problem
from pwatrack.lmi.chords import PeakGain, peak_gain
from pwatrack.lmi.exact_polynomial import AnyProof
from pwatrack.model.merging import Merge, merges, widest
from pwatrack.model.nonlinearity import ScalarForm
from pwatrack.model.pwa import PWASystem
from pwatrack.model.sizes import Sizes

_MOST = 40  # mergings that are tried
_TRIES = 6  # values of a for each ellipsoid


@dataclass(frozen=True, kw_only=True)
class Practical:
    """What is proved of the loop with the true plant, where the design is that of one with merged cells.

    Attributes:
        plant: The true plant, f.
        merges: What is merged in it; f̃ is the plant of the controller.
        replaced: Why the error cannot be proved to go to 0.
        evidence: The proof of that, where there is one.
        bounds: What 1 of each w_k can make of each signal in the end, in the order of `merges`: of what is tracked, of
            each input, of states, of the observer's errors.
        beyond: Of what is tracked: those that are not proved to end below the size of their reference, with that.
    """

    plant: PWASystem
    merges: tuple[Merge, ...]
    replaced: tuple[Problem, ...]
    evidence: Any
    bounds: tuple[Bounds, ...]
    beyond: Mapping[Form, float] = field(default_factory=dict)

    @cached_property
    def final(self) -> dict[Form, float]:
        """Below what the size of each signal ends, from every start, in its unit."""
        total = dict.fromkeys(self.bounds[0].sizes, Fraction(0))
        for merge, bounds in zip(self.merges, self.bounds, strict=True):
            for signal in total:
                size = bounds.sizes[signal]
                total[signal] += merge.largest * Fraction(float(np.nextafter(size, np.inf))) if size else 0
        return {signal: float(np.nextafter(float(size), np.inf)) if size else 0.0 for signal, size in total.items()}

    def norm(self, kind: Literal["output", "state", "estimate"], sizes: Sequence[float]) -> float:
        """Return below what the norm of all signals of a kind ends, each counted in its size."""
        each = [self.final[kind, k] / size for k, size in enumerate(sizes)]
        return float(np.linalg.norm(each)) * OVER_SUMS


def least_merges(
    form: ScalarForm, sizes: Sizes, works: Callable[[Mapping[int, Merge]], bool]
) -> dict[int, Merge] | None:
    """Return how each element is merged such that none of them can be merged less while the others stay.

    It begins with all of them merged whole. One after the other, that of the largest deviation first, is then left as
    it is or merged in the way of the least deviation that will do. Less merged is harder in every way, since (8), (9)
    and (17) then speak of more cells: so what was found for one element stays the least while others are merged less.

    Args:
        form: The field as a sum of elements.
        sizes: Those of the states: what deviations are compared in.
        works: Whether a design is found for a merging. It is asked 40 times at most; what is left then stays merged.

    Returns:
        By element, or None where even all merged does not work, or nothing can be merged.
    """
    chosen = widest(form)
    ways = {k: merges(form, k) for k in chosen}
    if not chosen or not works(chosen):
        return None

    def effect(k: int) -> float:
        column = chosen[k].column.floats[:, 0]
        return float(np.abs(column / sizes.state).max() * float(chosen[k].largest))

    tried = 0
    for k in sorted(chosen, key=effect, reverse=True):
        others = {j: merge for j, merge in chosen.items() if j != k}
        for trial in [others, *(others | {k: way} for way in ways[k] if way.largest < chosen[k].largest)]:
            if not trial or tried == _MOST:
                continue
            tried += 1
            if works(trial):
                chosen = trial
                break
    return dict(sorted(chosen.items()))


def deviation_bounds(
    plant: PWASystem,
    design: Design,
    proofs: Sequence[AnyProof],
    X: BallMatrix,
    columns: Sequence[BallMatrix],
    *,
    output: bool,
    states: Sequence[int],
) -> tuple[Bounds, ...] | None:
    """Bound what each deviation can do to each signal in the end, proved exactly, per 1 of it.

    Args:
        plant: f̃; if the observer runs another plant, that one has no deviation.
        design: Its gains.
        proofs: What `prove_design` returned for them.
        X: Of the `Compensation` of loads.
        columns: E_k (n, 1).
        output: Whether outputs are tracked, else states.
        states: Which states are to be bounded beside.

    Returns:
        One for each deviation, or None where some signal could not be bounded.
    """
    K, L = design.exact
    loops = _Loops(plant, K, L, proofs, X, output=output)
    loops.columns, loops.seen = columns, plant.watched is None
    extra: list[Form] = [("state", k) for k in states if output]
    signals = loops.tracked + loops.inputs + extra
    found = [loops.ended(k, signals) for k in range(len(columns))]
    return tuple(bounds for bounds in found if bounds is not None) if None not in found else None


class _Loops(Loops):
    """The loops, driven by deviations.

    Attributes:
        columns: E_k.
        seen: Whether they drive the observer's error too.
    """

    columns: Sequence[BallMatrix]
    seen: bool

    def drive(self, loop: Loop, channel: Channel) -> BallMatrix:
        """Return g, (N, 1)."""
        if channel[0] != "deviation":
            return super().drive(loop, channel)
        e, nothing = self.columns[channel[1]], BallMatrix.of(np.zeros((self.N, 1)))
        rest = BallMatrix.of(np.zeros((self.N - self.n, 1)), (self.N - self.n, 1))
        delta = nothing - above(e, rest) if self.seen else nothing
        return of_loop(loop, e, delta)

    def ended(self, k: int, signals: Sequence[Form]) -> Bounds | None:
        """Return the bounds in the end; without a deviation in the observer that is what the controller's loop says."""
        channel: Channel = ("deviation", k)
        loop: Loop = "joint" if self.seen else "controller"
        estimates = [form for form in self.estimates if form[1] < self.n]
        sizes, parts = self.sizes("observer", channel, estimates)
        peaks = list[ProvedPeak]()
        if loop in self.M:
            for signal in signals:
                size, part = self.sizes(loop, channel, [signal], tries=_TRIES)
                sizes, parts = sizes | size, parts + part
                if part and (gain := self.proved_peak(part[0], signal)) is not None and gain.size < size[signal]:
                    peaks.append(ProvedPeak(part=len(parts) - 1, gain=gain))
                    sizes[signal] = gain.size
        else:
            size, part = self.in_two_steps(channel)
            sizes, parts = sizes | size, parts + part
        if any(form not in sizes for form in (*signals, *estimates)):
            return None
        sizes = {form: sizes[form] for form in (*signals, *estimates)}
        return Bounds(channel=channel, sizes=sizes, parts=parts, proved=tuple(peaks))

    def proved_peak(self, part: Part, signal: Form) -> PeakGain | None:
        """Return the peak gain, where the loop has one matrix."""
        if len(self.M[part.loop]) != 1:
            return None
        drive, row = self.drive(part.loop, part.channel), self.row(part.loop, signal)
        return peak_gain(self.M[part.loop][0], drive, row, part.ellipsoid)
