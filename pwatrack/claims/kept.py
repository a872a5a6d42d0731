"""From which starts, and under what acts in a file, outputs and states keep their limits: searched, proved, said.

c x = c x_d + c e. The reference takes its part of the limits, enclosed; what disturbs in the file takes |c e| ≤ Σ bound
· size from error 0, see `control.bounds`; and from some starts an ellipsoid holds c e, see `lmi.ellipsoid`. Along one
solution the error is linear in all of these together, so what is left after the first two is for the third.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from pwatrack.arrays import Array, number_text, outward, up
from pwatrack.claims.bounds import SignalBounds
from pwatrack.claims.limits import WITHOUT, StartGuarantee, promises
from pwatrack.control.controller import Asked, Claim, ProvedController, Row, Told
from pwatrack.control.headroom import OFF, SignalRoom
from pwatrack.control.words import Words

_ROUNDING = 1e-12  # of what is left: what is subtracted is known to that


@dataclass(frozen=True, kw_only=True)
class KeptLimits(Claim):
    """Limits of outputs and states: what the reference takes of them, what disturbs, and from where they are kept."""

    signals: SignalRoom  # the limits, and what the reference leaves
    # how much of it what acts in the file takes, (q,), from error 0; None where no bound is proved
    taken: Array | None = None
    promises: tuple[StartGuarantee, ...] = ()  # what is proved of some starts, with what acts
    missing: str = ""  # why nothing can be proved; "" where it can

    statement: ClassVar[str] = "Under limits too: of signals of x, how far from x_d they may be at any time, likewise."

    @classmethod
    def prove(cls, controller: ProvedController, asked: Asked, told: Told = None) -> Iterator["KeptLimits"]:
        """Yield what is proved of the limits of outputs and states, where there are some."""
        if (signals := asked.signals) is None:
            return
        room, missing = signals.room, ""
        if controller.running is not controller.plant:
            missing = "cells are merged"
        elif controller.trajectory.preview is not None:
            missing = "x_d is played back"
        elif room.left is None:
            missing = "the reference leaves nothing of a limit, or is not known"
        elif (
            signals.acting and not controller.compensation.alone and any(kind != "output" for kind, _ in signals.forms)
        ):
            missing = "estimates of loads move x_d, as what acts moves them"
        claim = cls(signals=signals, taken=None if missing else _taken(controller, signals), missing=missing)
        if missing:
            yield claim
        elif claim.left is None:
            yield replace(claim, missing="what disturbs may take all that is left")
        else:
            starts = list(room.starts)
            if asked.measured is not None:
                noise = np.array([signals.acting.get(("noise", k), 0.0) for k in range(len(controller.plant.C))])
                off, loads = asked.measured * noise, len(controller.L) - len(controller.plant.B)
                starts = [one.with_more(off, loads) for one in starts]
            yield replace(claim, promises=promises(controller, claim.left, starts, told, forms=signals.forms))

    def data(self, controller: ProvedController) -> dict[str, Any]:
        return {"limits": [promise.data for promise in self.promises if promise.held is not None]}

    @property
    def left(self) -> Array | None:
        """How far each signal may be from what it is to be beside what acts, (q,); None where nothing is left."""
        left = self.signals.room.left
        left = None if left is None or self.taken is None else (left - self.taken) * (1 - _ROUNDING)
        return left if left is not None and (left > 0).all() else None

    def figures(self, words: Words, controller: ProvedController) -> dict[str, Any]:
        signals, left = self.signals, self.left
        peak = signals.room.peak
        each = {
            name: {
                "limits": [float(v) if np.isfinite(v) else None for v in signals.room.limits[k]],
                "reference": None if peak is None else [float(peak.low[k]), float(peak.high[k])],
                "acting": None if self.taken is None else float(self.taken[k]),
                "left": None if left is None else float(left[k]),
            }
            for k, name in enumerate(signals.names)
        }
        said = [] if left is None else [p.figures(left, signals.names) for p in self.promises]
        return {"kept_limits": {"signals": each, "starts": said, "missing": self.missing}}

    def rows(self, words: Words, controller: ProvedController) -> Iterator[Row]:
        idle = WITHOUT * (controller.plant.loads is not None)
        for k, text in enumerate([*self._takes(words, idle), *self._kept(words, controller)]):
            yield "" if k else "kept", text

    def _takes(self, words: Words, idle: str) -> Iterator[str]:
        """Yield what is taken of each limit, without loads that are estimated."""
        signals, peak = self.signals, self.signals.room.peak
        for k, name in enumerate(signals.names):
            unit = words.units.get(name, "")
            said = f"{name} {_between(*signals.room.limits[k].tolist())} {unit}".rstrip()
            if peak is None:
                yield f"{said}: x_d takes too long to follow, so what the reference takes is not known"
                continue
            span = f"the reference takes {peak.span(k, unit)}{idle}"
            over = float(peak.left(signals.room.limits)[k])
            leaves = f"leaves {outward(over, -1, OFF)} {unit}".rstrip() if over else "takes the whole limit"
            if signals.acting and self.taken is not None:
                much = f"{up(float(self.taken[k]))} {unit}".rstrip()
                leaves += f"; what acts in this file{_but_steps(words)} takes at most {much}"
            yield f"{said}: {span}, which {leaves}"

    def _kept(self, words: Words, controller: ProvedController) -> Iterator[str]:
        """Yield from which starts all limits are kept, and which of them binds."""
        left, signals = self.left, self.signals
        disturbance = words.conditions.beside(controller.plant.loads).disturbance  # after the run more of it may act
        lasts = signals.room.ever and disturbance is None
        kept = f"these limits are kept {'for good' if lasts else 'in this run'}"
        kept += " along the reference of the file" * (words.conditions.pace is not None)
        acting = self._acting(words)
        for promise in self.promises if left is not None else ():
            assert left is not None
            stepping = any(kind == "disturbance" for kind, _ in signals.acting)  # among what acts, if loads do
            starts = promise.said(left, loads=controller.plant.loads is not None and not stepping)
            binds = f"; {signals.names[promise.binds(left)]} binds" if np.isfinite(promise.scale(left)) else ""
            yield f"in the loop as designed {kept}{acting} from {starts}{binds}"
        if left is None or not self.promises:
            yield f"from which starts {kept} is not proved{': ' * bool(self.missing)}{self.missing}"

    def _acting(self, words: Words) -> str:
        """Say under what they are kept."""
        kinds, off = {kind for kind, _ in self.signals.acting}, words.off_limits
        noise = ", noise up to 3 standard deviations" * ("noise" in kinds)
        if kinds:
            return f", with what acts in this file{_but_steps(words)}{noise}{off},"
        return f" while nothing disturbs{off.replace(', while', ' and')}"

    def brief(self, words: Words, controller: ProvedController) -> Iterator[Row]:
        """Yield whether they are kept from the start of the run, where that is proved of the loop that runs."""
        names = ", ".join(self.signals.names)
        for promise in self.promises:
            if promise.of_this_run(self.left):
                yield "ideal loop", f"limits of {names} kept from this start{self._acting(words).removesuffix(',')}"


def _but_steps(words: Words) -> str:
    """Say that steps of inputs are not counted, where there are some: they are none of the loop as designed."""
    quanta = words.conditions.quanta
    return " but steps of inputs" * (quanta is not None and bool(quanta.inputs.any()))


def _between(low: float, high: float) -> str:
    if np.isfinite([low, high]).all():
        return f"from {number_text(low, 'g')} to {number_text(high, 'g')}"
    return f"at least {number_text(low, 'g')}" if np.isfinite(low) else f"at most {number_text(high, 'g')}"


def _taken(controller: ProvedController, signals: SignalRoom) -> Array | None:
    """Return what all that acts in a file does to each signal from error 0, (q,); None where a bound is missing."""
    if not signals.acting:
        return np.zeros(len(signals.forms))
    found = controller.claim(SignalBounds).under(controller, signals.acting)
    return np.array([found[form] for form in signals.forms]) if found.keys() >= set(signals.forms) else None
