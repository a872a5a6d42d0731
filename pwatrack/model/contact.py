"""Contacts: springs with dampers that push and never pull, on one side of a gap or on both.

With p = stiffness · (s − upper) and q = damping · ṡ, where s and ṡ are linear forms of the states, the force is

    f = max(0, min(p + q, 2 p))

in four cells: off (p ≤ 0), leaving (p ≥ 0, p + q ≤ 0), on (p + q), and closing (q ≥ p), where the damper is held to
what the spring does. So f ≥ 0, and f is continuous also where a touch begins at speed. It bends along half of the line
q = p alone, so it is no sum of functions of one linear form each. A second side, below a gap, has s − upper and ṡ
turned round.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import chain

from pwatrack.ball_matrix import BallMatrix
from pwatrack.model.linear_form import LinearForm, PiecewiseElement
from pwatrack.real import Real

_OFF = (-1, 0, 0)  # signs of p, p + q and q − p
_TOUCHING = {"leaving": (1, -1, 0), "": (0, 1, -1), "closing": (1, 0, 1)}


@dataclass(frozen=True, kw_only=True)
class Contact(PiecewiseElement):
    """Adds direction · f to ẋ.

    Raises:
        ValueError: If stiffness or damping is not positive, rate is a multiple of s, or there is no gap.
    """

    of: LinearForm  # s
    rate: LinearForm  # ṡ
    stiffness: Real  # of the spring
    damping: Real  # of the damper
    upper: Real  # where s touches
    lower: Real | None = None  # where it touches on the other side, or None

    def __post_init__(self) -> None:
        """Refuse numbers that make none."""
        for what, value in (("stiffness", self.stiffness), ("damping", self.damping)):
            if not float(value) > 0:
                hint = ": without damping it is a spring or a dead_zone" if what == "damping" else ""
                raise ValueError(f"{what} is {float(value):g}, expected more than 0{hint}")
        if BallMatrix.of([self.of.coefficients, self.rate.coefficients]).centre.rank() < 2:
            raise ValueError("rate is a multiple of 'of', or 0: it is to be how fast that changes, such as a speed")
        if self.lower is not None and not self.lower < self.upper:
            raise ValueError(f"{float(self.lower):g} and {float(self.upper):g} are not in increasing order")

    def __call__(self, s: float, rate: float) -> float:
        """Return f.

        Example: on, leaving, and closing faster than the spring is strong.

            >>> z, v = (LinearForm(row, Real.of(0)) for row in ((Real.of(1), Real.of(0)), (Real.of(0), Real.of(1))))
            >>> one = Real.of(1)
            >>> pad = Contact(name="pad", of=z, rate=v, stiffness=one, damping=one, upper=one, direction=[0, -1])
            >>> pad(3, 1), pad(3, -5), pad(3, 9), pad(0, 9)
            (3.0, 0.0, 4.0, 0.0)
        """
        found = self._force(s - float(self.upper), rate)
        return found if self.lower is None else found - self._force(float(self.lower) - s, -rate)

    def _force(self, deep: float, rate: float) -> float:
        p, q = float(self.stiffness) * deep, float(self.damping) * rate
        return max(0.0, min(p + q, 2 * p))

    @cached_property
    def planes(self) -> tuple[LinearForm, ...]:
        """Forms that are 0 on its hyperplanes: p, p + q and q − p of each side."""
        return tuple(chain.from_iterable((p, p + q, q - p) for _, _, p, q in self._sides))

    @property
    def _sides(self) -> Iterator[tuple[str, int, LinearForm, LinearForm]]:
        """Yield the name of each side, the sign of its force, p and q."""
        p, q = (self.of - self.upper) * self.stiffness, self.rate * self.damping
        yield "" if self.lower is None else "above", 1, p, q
        if self.lower is not None:
            yield "below", -1, (self.of - self.lower) * -self.stiffness, -q

    @cached_property
    def cells(self) -> list[tuple[str, tuple[int, ...], LinearForm]]:
        """Of each cell its name, the signs of the planes, 0 where one does not bound it, and f."""
        sides, nothing = list(self._sides), self.of * 0
        found = [("off" if self.lower is None else "inside", _OFF * len(sides), nothing)]
        for k, (where, sign, p, q) in enumerate(sides):
            before, after = (0, 0, 0) * k, (0, 0, 0) * (len(sides) - 1 - k)
            forms = (nothing, (p + q) * sign, p * (2 * sign))
            for (how, signs), form in zip(_TOUCHING.items(), forms, strict=True):
                name = " ".join(filter(None, (where, how))) or "on"
                found.append((name, (*before, *signs, *after), form))
        return found
