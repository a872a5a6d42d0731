"""What is left by an x_d that was worked out beforehand, for zero dynamics with unstable modes: (17±)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np

from pwatrack.arrays import OVER_POWERS, Array, up
from pwatrack.ball_matrix import BallMatrix
from pwatrack.claims.bounds import SignalBounds, in_ellipsoid
from pwatrack.claims.robust import Robust
from pwatrack.control.bounds import Form
from pwatrack.control.compensation import resting
from pwatrack.control.controller import Asked, Claim, ProvedController, Told
from pwatrack.control.trajectory import NoncausalTrajectory
from pwatrack.control.words import Words, all_cells
from pwatrack.model.normal_form import NormalForm


@dataclass(frozen=True, kw_only=True)
class StableInversion(Claim):
    """What residual and jumps of an η that was worked out beforehand leave of each signal in the end.

    With η' = (15) + ρ, x_d' = f(x_d) + B u_ff + T⁻¹ [0; ρ], so that e' has −T⁻¹ [0; ρ] more; and where η jumps by J so
    does e, by −T⁻¹ [0; J], or by a mean of these where x_d changes its cell.
    """

    preview: NoncausalTrajectory  # what is known of η
    form: NormalForm  # the plant in the form (11)
    error: float  # what is left of ‖y − y_d‖
    bounds: SignalBounds | Robust  # whose ellipsoids say what is left of each signal

    beside: ClassVar[str] = "what is played back"

    @classmethod
    def prove(cls, controller: ProvedController, asked: Asked, told: Told = None) -> Iterator["StableInversion"]:
        preview, form = controller.trajectory.preview, controller.form
        if preview is None or form is None:
            return
        bounds: SignalBounds | Robust = next(iter(controller.claims_of(Robust)), controller.claim(SignalBounds))
        error = controller.guarantees.left(_of_eta(form), preview)
        yield cls(preview=preview, form=form, error=error, bounds=bounds)

    @cached_property
    def by_signal(self) -> dict[Form, float]:
        """What is left of each signal, in its unit, from error 0: it drives e, by any ellipsoid, and Δ stays 0."""
        found = self.bounds.bounds if isinstance(self.bounds, Robust) else self.bounds.acting
        columns, most = _of_eta(self.form), dict[Form, float]()
        for part in (part for bounds in found for part in bounds.parts):
            if part.loop == "observer":
                most |= {signal: 0.0 for signal in part.signals if signal[0] == "estimate"}
                continue
            Q, rest = part.ellipsoid, [0.0] * (len(part.ellipsoid.exponents) - columns.shape[1])
            each = [[in_ellipsoid(Q, np.append(column, rest)) for column in cell.T] for cell in columns]
            size = self.preview.measured(np.array(each), Q.a / 2) * OVER_POWERS
            for signal, bound in zip(part.signals, Q.sizes, strict=True):
                most[signal] = 0.0 if signal[0] == "estimate" else min(most.get(signal, np.inf), bound * size)
        return most

    def leaves(self, form: Form) -> float | None:
        return self.by_signal.get(form)

    def leaves_norm(self, of: Literal["output", "state", "estimate"], sizes: Sequence[float]) -> float:
        return 0.0 if of == "estimate" else self.error

    def data(self, controller: ProvedController) -> dict[str, Any]:
        loads = controller.plant.loads
        if loads is None:
            return {}
        H = resting(loads, self.form)
        return {"eta_with_loads": BallMatrix(H).texts} if any(H.entries()) else {}

    def figures(self, words: Words, controller: ProvedController) -> dict[str, Any]:
        preview = self.preview
        return {
            "preview": {
                "eta": list(preview.names),
                "residual": preview.residual.tolist(),
                "terms": preview.terms.tolist(),
                "jumps": preview.jumps.max(axis=0, initial=0.0).tolist(),
                "lead": preview.lead,
                "error": self.error,
            }
        }

    def texts(self, words: Words) -> Iterator[str]:
        """Yield what is proved of it, how far ahead it looks, and what is left of its own error."""
        preview, etas = self.preview, ", ".join(self.preview.names)
        cells = all_cells(len(words.plant.A))
        yield f"proved for {cells}, with a P of mixed sign: there is one bounded x_d; η = {etas}"
        before = f"{preview.lead:.3g} s before" if preview.lead else "as"
        ahead = "" if preview.lead is None else f"; η leaves its rest {before} the reference moves"
        yield f"x_d and u_ff are worked out for this run and played back: the reference is known beforehand{ahead}"
        share = float(np.max(preview.residual / np.maximum(preview.terms, np.finfo(float).tiny)))
        left = f"|y − y_d| ≤ {up(self.error)} {words.unit_of_tracked()}".rstrip()
        yield (
            f"(15) is satisfied to {share:.1e} of its terms at all times of this run; with the jumps of what is played "
            f"back that leaves {left} in the end"
        )


def _of_eta(form: NormalForm) -> Array:
    """Return T⁻¹ [0; I] in each cell, (l, n, p)."""
    return np.array([inverse[:, form.r :] for inverse in form.T_inverse])
