"""What a reference made of set-points keeps, and what any such reference takes of the inputs."""

from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import accumulate
from typing import Any

import numpy as np

from pwatrack.arrays import Array
from pwatrack.ball_matrix import text
from pwatrack.lmi.audit.reading import number
from pwatrack.model.normal_form import NormalForm

Ends = tuple[Fraction, Fraction]


@dataclass(frozen=True, kw_only=True)
class Kept:
    """What a reference keeps."""

    degrees: tuple[int, ...]  # relative degree of each output
    # between what each entry of v is: for one output after the other y_d and its derivatives below y_d⁽ʳ⁾, then all
    # y_d⁽ʳ⁾. None for a y_d of which that is not said.
    box: tuple[Ends | None, ...]
    start: tuple[Fraction, ...]  # (ξ_d, η̂) at first, where all is at rest

    @classmethod
    def of(cls, form: NormalForm, pace: Array, ends: Array, y: Array, eta: Array) -> "Kept":
        """Return it of derivatives within ± pace (p, ≥ r) and outputs within ends (p, 2), from y (p,) and η̂ on."""
        xi, last, first = list[Ends | None](), list[Ends | None](), list[float]()
        for degree, limits, (low, high), at in zip(form.degrees, pace.tolist(), ends.tolist(), y.tolist(), strict=True):
            own: list[Ends | None] = [(exact(low), exact(high)) if np.isfinite([low, high]).all() else None]
            own += [(-exact(limit), exact(limit)) for limit in limits[:degree]]
            xi, last, first = xi + own[:-1], last + own[-1:], [*first, at, *[0.0] * (degree - 1)]
        return cls(degrees=form.degrees, box=(*xi, *last), start=tuple(map(exact, [*first, *eta.tolist()])))

    @property
    def firsts(self) -> list[int]:
        """Where each y_d is in the box."""
        return [*accumulate(self.degrees[:-1], initial=0)]

    @property
    def centre(self) -> list[Fraction]:
        """v_c; 0 where nothing is said."""
        return [Fraction(0) if ends is None else (ends[0] + ends[1]) / 2 for ends in self.box]

    @property
    def widths(self) -> list[Fraction]:
        """w, likewise."""
        return [Fraction(0) if ends is None else (ends[1] - ends[0]) / 2 for ends in self.box]

    @property
    def texts(self) -> list[list[str] | None]:
        """The box, as a certificate has it."""
        return [None if ends is None else [text(v) for v in ends] for ends in self.box]

    def of_output(self, k: int) -> tuple[int, int]:
        """Return of which output an entry of the box is, and which derivative."""
        if k >= sum(self.degrees):
            return k - sum(self.degrees), self.degrees[k - sum(self.degrees)]
        output = max(j for j, first in enumerate(self.firsts) if first <= k)
        return output, k - self.firsts[output]

    def times(self, k: int, share: Fraction) -> "Kept":
        """Return it with so much of one entry, on either side of where that starts."""
        ends, at = self.box[k], self.start[k] if k < sum(self.degrees) else Fraction(0)
        assert ends is not None
        less = (at + (ends[0] - at) * share, at + (ends[1] - at) * share)
        return replace(self, box=(*self.box[:k], less, *self.box[k + 1 :]))


@dataclass(frozen=True, kw_only=True)
class Demand:
    """Between what u_ff is for any reference that keeps its limits."""

    kept: Kept  # what it keeps
    low: Array  # of each input, (m,), rounded outward; infinite where that is not known
    high: Array  # likewise
    missing: str = ""  # why it is not known; "" where it is
    proof: Any = None  # what proves it, as a certificate has it

    @classmethod
    def unknown(cls, kept: Kept, inputs: int, missing: str) -> "Demand":
        """Return that it is not known, and why."""
        return cls(kept=kept, low=np.full(inputs, -np.inf), high=np.full(inputs, np.inf), missing=missing)

    def beyond(self, limits: Array) -> list[tuple[int, int]]:
        """Return where it is beyond limits (m, 2), if it is known: (input, 0 for its lower one)."""
        over = np.column_stack([limits[:, 0] > self.low, self.high > limits[:, 1]])
        return [] if self.missing else [(int(k), int(side)) for k, side in np.argwhere(over)]


def told(kept: Kept, content: Any, close: float) -> Demand:
    """Return what a certificate proves, for what a reference keeps; its start follows from a simulation, to rounding.

    Raises:
        ValueError: If that is of another reference.
    """
    start = [float(number(v)) for v in content["start"]]
    same = content["box"] == kept.texts and len(start) == len(kept.start)
    if not same or not np.allclose(start, [float(v) for v in kept.start], rtol=close, atol=close):
        raise ValueError("what set-points take is told of other set-points")
    low, high = np.array([[float(number(v)) for v in ends] for ends in content["u_ff"]]).T
    return Demand(kept=kept, low=low, high=high, proof=content)


def exact(value: float) -> Fraction:
    """Return a double as the decimal that it prints as."""
    return Fraction(repr(float(value)))
