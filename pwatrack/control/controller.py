"""What runs on the machine, observer (18), controller (19), desired trajectory and feedforward, and its claims.

Everything that is proved of a loop is a claim, one class in the room `claims` for each kind of them. What is said of a
loop is what its claims say; nothing else lists them but `claims.registry`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Literal, TypeVar

import numpy as np

from pwatrack.arrays import OVER_SUMS, Array
from pwatrack.control.bounds import Channel, Form
from pwatrack.control.compensation import Compensation, compensation
from pwatrack.control.demand import Demand
from pwatrack.control.generator import TrajectoryGenerator
from pwatrack.control.guarantees import Guarantees, guarantees
from pwatrack.control.headroom import Headroom, SignalRoom, Starts
from pwatrack.control.sampled_disturbances import Acting, LateStart
from pwatrack.control.sampled_error import SampledErrors
from pwatrack.control.sampled_gains import SampledGains, sampled_gains
from pwatrack.control.synthesis import Gains
from pwatrack.control.trajectory import DesiredTrajectory
from pwatrack.control.words import Words
from pwatrack.lmi.inequality import Solver
from pwatrack.lmi.polynomial import AnyProof
from pwatrack.model.conditions import Sampling
from pwatrack.model.normal_form import NormalForm
from pwatrack.model.pwa import Matrices, PWASystem
from pwatrack.model.sizes import Sizes
from pwatrack.real import Box

Told = Mapping[str, Any] | None  # a certificate, where there is one
Row = tuple[str, str]  # a label, or nothing where it is that of the row before, and a sentence


@dataclass(frozen=True, kw_only=True)
class Asked:
    """What a loop is to be proved for."""

    words: Words  # what it is called, and the goals of its gains
    room: Headroom | None  # what the feedforward leaves of the limits of inputs, where there are some
    signals: SignalRoom | None  # what the reference leaves of those of outputs and states, where there are some
    set_points: Demand | None  # what a reference made of set-points takes, where the program makes one
    box: Box  # parameters that are uncertain
    corners: Callable[[PWASystem], Sequence[Matrices]]  # the matrices at its corners, for the plant of a design
    acting: "Callable[[ProvedController, SampledErrors], Acting | None]"  # in the run, if known
    begins: "Callable[[ProvedController], Starts | None]"  # with which errors the run does, if known
    late: "Callable[[ProvedController, SampledErrors, Array], LateStart | None]"  # and noise: likewise
    solver: Solver = "structured"  # who is asked for what is proved later
    sampled: SampledGains | None = None  # the gains of a program that predicts and corrects, where they matter
    changes: Array | None = None  # by how much inputs may change in a sample, (m,), infinite where by any
    measured: Array | None = None  # X of x̂(0) = X y, (n, q), where the observer starts from what is measured


@dataclass(frozen=True, kw_only=True)
class Seen:
    """What of a run decides which claims speak of it, and what they allow."""

    t: Array  # times of samples in s, (K,)
    start: Array  # (x − x_d, x̂ − x, ŝ − s) at t = 0, (2 n + p,)
    acting: Mapping[Channel, Array]  # the largest size so far of what disturbs, and of noise at any time, (K,) each
    designed: bool  # whether the loop is the one that was designed, but for disturbances, noise and limits not come to
    steps: Sequence[tuple[float, Array]] = ()  # when loads step that are no disturbance, and by what, (p,)
    w: Array | None = None  # how large each entry of w is so far, (K, n), where the plant is one of a box
    sampled: bool = False  # whether it is the loop of the program, with the plant of the design, limits not come to


class Claim(ABC):
    """Something that is proved of a loop: how it is stated, stored, said, drawn and held against a run.

    Beside each in `lmi.audit` is how it is decided again from its data.
    """

    statement: ClassVar[str] = ""  # the exact sentence, for the text of a certificate; "" where another's says it
    nothing: ClassVar[Mapping[str, Any]] = {}  # what a certificate holds by key where it is not made, for `data`
    beside: ClassVar[str] = ""  # what adds to all bounds of signals, in words; "" where it leaves nothing

    @classmethod
    @abstractmethod
    def prove(cls, controller: "ProvedController", asked: Asked, told: Told = None) -> "Iterator[Claim]":
        """Yield what can be proved of a controller with the claims that come before: none, one or several.

        From a certificate, if there is one, what it holds of it is taken, without a solver.

        Raises:
            PwatrackError: If it was asked for and is not so, or not proved.
            ValueError: If what is told does not fit to the controller.
        """

    def data(self, controller: "ProvedController") -> dict[str, Any]:
        """Return its part of a certificate, by key: exact numbers as text. Lists of several claims are joined."""
        return {}

    def rows(self, words: Words, controller: "ProvedController") -> Iterator[Row]:
        """Yield what a summary says of it."""
        yield from ()

    def brief(self, words: Words, controller: "ProvedController") -> Iterator[Row]:
        """Yield what the first screen says of it, in a line or less each, by the labels of `report.screen`."""
        yield from ()

    def figures(self, words: Words, controller: "ProvedController") -> dict[str, Any]:
        """Return what run.json says of it, by keys of its own."""
        return {}

    @property
    def runs_with(self) -> SampledGains | None:
        """What the program runs with that it is about; None where it is about none."""
        return None

    def leaves(self, form: Form) -> float | None:
        """Return what it adds to every bound of a signal, in its unit; None where it cannot tell: then no bound is."""
        return 0.0

    def leaves_norm(self, of: Literal["output", "state", "estimate"], sizes: Sequence[float]) -> float:
        """Return what it adds to a bound of the norm of all signals of a kind, each counted in its size."""
        return 0.0

    def allows(self, controller: "ProvedController", seen: Seen) -> dict[Form, Array]:
        """Return how large each signal may be at the samples of a run, (K,), without what claims leave."""
        return {}


C = TypeVar("C", bound=Claim)


@dataclass(frozen=True, kw_only=True)
class ProvedController:
    """The overall design of Theorem 2 (state tracking) or Theorem 3 (output tracking).

    x̂' = A_i x̂ + b_i + B u + L (ŷ − y), ŷ = C x̂ (18);  u = K (x̂ − x_d) + u_ff (10), (19). Where the plant has loads, the
    observer runs these too, and `compensation` says what they add to x_d and u_ff.
    """

    plant: PWASystem  # the system (1) that gains and trajectory are made for; for practical tracking with merged cells
    running: PWASystem  # the plant that it controls
    design: Gains  # the gains with their proofs
    trajectory: DesiredTrajectory  # where x_d and u_ff come from
    proofs: tuple[AnyProof, ...]  # exact proofs of (8), (9) and (17) for the matrices and gains as printed
    sizes: Sizes  # of all signals of the plant: what the gains were weighed with
    claims: tuple[Claim, ...] = ()  # what is proved of the loop, in the order in which it is said

    @property
    def generator(self) -> TrajectoryGenerator | None:
        """The trajectory generator (15), for output tracking only."""
        return self.trajectory.generator

    @property
    def tracking(self) -> Literal["output", "state"]:
        """What goes to 0: y − y_d of what is tracked (Theorem 3), or x − x_d (Theorem 2)."""
        return "state" if self.generator is None else "output"

    @property
    def error_names(self) -> tuple[str, ...]:
        """Names of what the tracking error has entries for."""
        return self.plant.states if self.generator is None else self.plant.tracked_names

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

    def sampled_gains(self, sampling: Sampling) -> SampledGains:
        """Return what a program runs with that corrects: the gains that a claim is about, or those made for it now."""
        for gains in (claim.runs_with for claim in self.claims):
            if gains is not None and gains.of(sampling):
                return gains
        return sampled_gains(self.plant, self.design.K, self.design.L, sampling)

    def claims_of(self, kind: type[C]) -> tuple[C, ...]:
        """Return the claims of a kind: none, one or several."""
        return tuple(claim for claim in self.claims if isinstance(claim, kind))

    def claim(self, kind: type[C]) -> C:
        """Return the one claim of a kind.

        Raises:
            LookupError: If there is none.
        """
        for claim in self.claims_of(kind):
            return claim
        raise LookupError(f"no claim is a {kind.__name__}")

    @property
    def beside(self) -> str:
        """What adds to all bounds of signals, in words; "" where nothing does."""
        return "".join(f", beside {claim.beside}" for claim in self.claims if claim.beside)

    def leaves(self, form: Form) -> float | None:
        """Return what adds to every bound of a signal; None where that is not known: then there is no bound."""
        each = [claim.leaves(form) for claim in self.claims]
        known = [part for part in each if part is not None]
        return sum(known) if len(known) == len(each) else None

    def with_left(self, sizes: Mapping[Form, Any]) -> dict[Form, Any]:
        """Add to bounds of signals what adds to every one; those of which that is not known are none."""
        found = {}
        for form, size in sizes.items():
            left = self.leaves(form)
            if left is not None:
                found[form] = (size + left) * OVER_SUMS if left else size
        return found

    def tracking_bound(self, t: Array, start: Array, observer_start: Array) -> Array:
        """Return what is proved of |x − x_d|, in sizes where there are several, or of |y − y_d|: see `guarantees`."""
        bound = self.guarantees.tracking_error(t, start, observer_start, output=self.tracking == "output")
        return bound + sum(claim.leaves_norm(self.tracking, self.error_sizes.tolist()) for claim in self.claims)

    def observer_bound(self, t: Array, start: Array) -> Array:
        """Return what is proved of |x̂ − x|, likewise."""
        sizes = self.sizes.state.tolist() if len(self.sizes.state) > 1 else [1.0]
        left = sum(claim.leaves_norm("estimate", sizes) for claim in self.claims)
        return self.guarantees.observer_error(t, start) + left

    @property
    def error_sizes(self) -> Array:
        """What each entry of the tracking error counts in a norm of them all: its size; 1 where it is the only one."""
        sizes = self.sizes.state if self.tracking == "state" else self.sizes.tracked
        return np.ones(1) if len(sizes) == 1 else sizes
