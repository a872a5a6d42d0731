"""What runs on the machine: observer (18), controller (19), desired trajectory and feedforward."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np

from pwatrack.arrays import Array
from pwatrack.control.bounds import Bounds, Form, Loops, signal_bounds, start_bounds
from pwatrack.control.compensation import Compensation, compensation
from pwatrack.control.envelope import from_preview
from pwatrack.control.generator import TrajectoryGenerator
from pwatrack.control.guarantees import Guarantees, guarantees
from pwatrack.control.limits import Limited, Promise
from pwatrack.control.practical import Practical
from pwatrack.control.robust import Robust
from pwatrack.control.synthesis import Design
from pwatrack.control.trajectory import DesiredTrajectory
from pwatrack.lmi.exact_polynomial import AnyProof
from pwatrack.lmi.inequality import Solver
from pwatrack.lmi.solve import asking
from pwatrack.model.normal_form import NormalForm
from pwatrack.model.pwa import PWASystem
from pwatrack.model.sizes import Sizes


@dataclass(frozen=True, kw_only=True)
class Controller:
    """The overall design of Theorem 2 (state tracking) or Theorem 3 (output tracking).

    x̂' = A_i x̂ + b_i + B u + L (ŷ − y), ŷ = C x̂ (18);  u = K (x̂ − x_d) + u_ff (10), (19). Where the plant has loads, the
    observer runs these too, and `compensation` says what they add to x_d and u_ff.

    Attributes:
        plant: The system (1); for practical tracking with merged cells.
        design: The gains with their proofs.
        trajectory: Where x_d and u_ff come from.
        generator: The trajectory generator (15), for output tracking only.
        proofs: Exact proofs of (8), (9) and (17) for the matrices and gains as printed.
        sizes: Of all signals of the plant: what the gains were weighed with.
        costs: For "controller" and "observer", where a cost was asked: X (n, n), the proved bound; see `cost_bound`.
        robust: What is proved for uncertain parameters, where some are.
        limited: What is known of inputs that have limits, where some have.
        practical: What is proved of the loop with the true plant, where cells of it are merged.
        solver: Who is asked for what is still to be proved.
    """

    plant: PWASystem
    design: Design
    trajectory: DesiredTrajectory
    generator: TrajectoryGenerator | None
    proofs: tuple[AnyProof, ...]
    sizes: Sizes
    costs: Mapping[str, Array] = field(default_factory=dict)
    robust: Robust | None = None
    limited: Limited | None = None
    practical: Practical | None = None
    solver: Solver = "structured"

    @property
    def tracking(self) -> Literal["output", "state"]:
        """What goes to 0: y − y_d of what is tracked (Theorem 3), or x − x_d (Theorem 2)."""
        return "state" if self.generator is None else "output"

    @property
    def error_names(self) -> tuple[str, ...]:
        """Names of what the tracking error has entries for."""
        return self.plant.states if self.generator is None else self.plant.tracked_names

    @property
    def running(self) -> PWASystem:
        """The plant that it controls."""
        return self.plant if self.practical is None else self.practical.plant

    @property
    def K(self) -> Array:
        """Controller gain, (m, n)."""
        return self.design.K

    @property
    def L(self) -> Array:
        """Observer gain, (N, q)."""
        return self.design.L

    @property
    def form(self) -> NormalForm | None:
        """The plant in the form (11), for output tracking only."""
        return None if self.generator is None else self.generator.form

    @cached_property
    def compensation(self) -> Compensation:
        """What the estimates of loads add to the desired trajectory."""
        played_back = self.trajectory.preview is not None
        return compensation(self.plant, self.form, self.trajectory.rate.shape[1], played_back=played_back)

    @cached_property
    def guarantees(self) -> Guarantees:
        """What the proofs promise: rates, bounds on errors, and by how much the gains may change."""
        return guarantees(self.plant, self.design, self.proofs, self.sizes, self.compensation.X)

    def tracking_bound(self, t: Array, start: Array, observer_start: Array) -> Array:
        """Return what is proved of |x − x_d|, in sizes where there are several, or of |y − y_d|: see `guarantees`.

        With merged cells what these leave in the end comes on top of it, and so does what is played back.
        """
        bound = self.guarantees.tracking_error(t, start, observer_start, output=self.tracking == "output")
        bound += self.left_by_preview
        if self.practical is None:
            return bound
        return bound + self.practical.norm(self.tracking, self.error_sizes.tolist())

    def observer_bound(self, t: Array, start: Array) -> Array:
        """Return what is proved of |x̂ − x|, likewise."""
        bound, sizes = self.guarantees.observer_error(t, start), self.sizes.state
        if self.practical is None:
            return bound
        return bound + self.practical.norm("estimate", sizes.tolist() if len(sizes) > 1 else [1.0])

    @property
    def error_sizes(self) -> Array:
        """What each entry of the tracking error counts in a norm of them all: its size; 1 where it is the only one."""
        sizes = self.sizes.state if self.tracking == "state" else self.sizes.tracked
        return np.ones(1) if len(sizes) == 1 else sizes

    @cached_property
    def left_by_preview(self) -> float:
        """What residual and jumps of an η that was worked out beforehand leave of ‖y − y_d‖ in the end, 0 without one.

        With η' = (15) + ρ, x_d' = f(x_d) + B u_ff + T⁻¹ [0; ρ], so that e' has −T⁻¹ [0; ρ] more; and where η jumps
        by J so does e, by −T⁻¹ [0; J], or by a mean of these where x_d changes its cell.
        """
        preview = self.trajectory.preview
        return 0.0 if preview is None else self.guarantees.left(self._of_eta, preview)

    @cached_property
    def left_by_signal(self) -> dict[Form, float]:
        """The same of each signal; of uncertain parameters for every plant of their box. Nothing without one."""
        preview, bounds = self.trajectory.preview, self.bounds if self.robust is None else self.robust.bounds
        return {} if preview is None else from_preview(bounds, self._of_eta, preview)

    @property
    def _of_eta(self) -> Array:
        """T⁻¹ [0; I] in each cell, (l, n, p)."""
        assert self.form is not None
        return np.array([inverse[:, self.form.r :] for inverse in self.form.T_inverse])

    @property
    def promises(self) -> tuple[Promise, ...]:
        """From which starts inputs that have limits stay near their feedforward."""
        return () if self.limited is None else self.limited.promises

    @cached_property
    def _loops(self) -> Loops:
        K, L = self.design.exact
        return Loops(self.plant, K, L, self.proofs, self.compensation.X, output=self.tracking == "output")

    @cached_property
    def bounds(self) -> tuple[Bounds, ...]:
        """What a disturbance of each state equation and the noise of each sensor can do to each signal."""
        with asking(self.solver):
            return signal_bounds(self._loops)

    @cached_property
    def starts(self) -> tuple[Bounds, ...]:
        """What each entry of the start, of x − x_d, of x̂ − x and of the estimates of loads, can do to each signal."""
        with asking(self.solver):
            return start_bounds(self._loops)
