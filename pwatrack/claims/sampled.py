"""What is proved of the program itself: a loop that is sampled, with inputs that are held, between its ticks too."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain, tee
from typing import Any, ClassVar

import numpy as np

from pwatrack.arrays import Array, amount, number_text, up
from pwatrack.claims.decay import in_a_line
from pwatrack.claims.exact_text import CLOCKED, DECIMAL, MATRIX, NUMBER, Record, Text
from pwatrack.claims.practical import Practical
from pwatrack.control.controller import Asked, Claim, ProvedController, Row, Told
from pwatrack.control.estimated_loads import OnEstimates, refused
from pwatrack.control.goal import AtLeast
from pwatrack.control.sampled_error import SampledErrors
from pwatrack.control.sampled_gains import SampledGains, sampled_gains
from pwatrack.control.sampled_optimal import candidates
from pwatrack.control.sampled_search import longest, too_much, with_forms
from pwatrack.control.words import Words, down, matrix_text
from pwatrack.lmi.clocked import ClockedProof, looked_for
from pwatrack.lmi.inequality import CONTROLLER
from pwatrack.model.conditions import Sampling
from pwatrack.model.pwa import PWASystem
from pwatrack.model.sizes import Sizes

_LAST_DIGIT = 1e-5  # of the largest entry of a gain, in sizes
_NOT_FOUND = "no forms were found that prove it"
_TIMES: dict[str, Text] = {"sample_time": DECIMAL, "substeps": NUMBER, "delay": NUMBER, "jitter": DECIMAL}
_GAINS = Record(SampledGains, K=MATRIX, M=MATRIX, E=MATRIX, **_TIMES)


@dataclass(frozen=True, kw_only=True)
class SampledClaim(Claim):
    """What is proved of a loop that is sampled, or why nothing is."""

    gains: SampledGains  # of the program
    proof: ClockedProof | None  # forms that prove it; None where it is not proved
    missing: str = ""  # why it is not; "" where it is

    @property
    def rate(self) -> float:
        """In 1/s, of time as it passes where ticks are as far apart as they may be; not a number without proof."""
        return np.nan if self.proof is None else self.gains.passing(self.proof.rate)


@dataclass(frozen=True, kw_only=True)
class SampledLoop(SampledClaim):
    """The sampled loop, proved or not."""

    # plant, K, L and sizes that gains for other sample times can be made of; None where it is from a file
    design: tuple[PWASystem, Array, Array, Sizes] | None = field(default=None, compare=False, repr=False)
    # how x_d and u_ff of it depend on estimates
    estimates: OnEstimates | None = field(default=None, compare=False, repr=False)
    # whether cells are merged in the design and in the program: what that leaves out acts on the loop
    merged: bool = False
    # the K in whose place that of the program is, where this was made for limits, (m, n); else None
    cheaper: Array | None = field(default=None, compare=False, repr=False)

    statement: ClassVar[str] = (
        "Under sampled: P of z = (x - x_d, nu, x_hat_i - x, s_hat_i - s, rho_i), with x_hat_i as it is predicted for "
        "now from the tick i ago, i = 0 ... max(delay, 1) - 1, rho = R (x_hat - p) - R (x_d - x_d at p), p where a "
        "substep begins, and nu = K (x_hat_delay - x_d) at the tick, with delay less U (s_hat_delay - s), E = B U, "
        "linear in time between the knots of each substep, is positive definite and z^T P z falls as e^(-2 rate t), "
        "t as the program counts it, sample_time from tick to tick, which are within jitter of that apart: "
        "(P_k+1 - P_k) / step + F^T P_e + P_e F + 2 rate P_e + V^T T_e V + P_e U T_e^-1 U^T P_e < 0 at both ends e of "
        "each segment, T_e the diagonal of the knot, for boxes F + U diag(eps) V, |eps_k| <= 1, that have z' of all "
        "cells in them: with edges u v^T, sorted, the first entry of v but 0 being 1, of the box whose corners the "
        "rows of e', each A_j, and A_a - A_b are; where these are none, or T_e has no entries, each alone. J^T P_0 J < "
        "P_N at ticks and at the ends of substeps. Where loads are not all constants at inputs, one "
        "for each tracked output, x_d and eta are those of s itself, and z has behind it epsilon = (s_hat - s, eta_hat "
        "- eta) at the tick, eta where a load acts on it, and eta_hat - eta one sample later; nu is K (x_hat_delay - "
        "the x_d of the program) and what the mean of u_ff, which is held, is more above u_ff at the tick than for s."
    )
    nothing: ClassVar[Mapping[str, Any]] = {"sampled": None}

    @classmethod
    def prove(cls, controller: ProvedController, asked: Asked, told: Told = None) -> Iterator["SampledLoop"]:
        """Yield the proof, or why there is none, where the loop is to be sampled."""
        content = None if told is None else told["sampled"]
        if content is not None:
            gains = _GAINS.read(content)
            cheaper = None if asked.sampled is None else _cheaper(controller, asked, gains)
            merged = bool(controller.claims_of(Practical))
            yield cls(gains=gains, proof=CLOCKED.read(content), merged=merged, cheaper=cheaper)
        elif asked.sampled is not None:
            tried = _candidates(controller, asked, asked.sampled)
            found = _proved(controller, tried, search=told is None)
            own = asked.room is not None and told is None
            yield replace(found, cheaper=_cheaper(controller, asked, found.gains)) if own else found

    @property
    def runs_with(self) -> SampledGains:
        return self.gains

    def data(self, controller: ProvedController) -> dict[str, Any]:
        if self.proof is None:
            return {}
        gains, rows = _GAINS.write(self.gains), errors_of(controller, self.gains).R.texts
        before = {name: gains[name] for name in "KME"} | {"rows": rows}
        return {"sampled": before | gains | CLOCKED.write(self.proof)}

    def rows(self, words: Words, controller: ProvedController) -> Iterator[Row]:
        yield "sampled loop", self.sentence
        yield "", f"runs with K = {matrix_text(self.gains.K)}, M = {matrix_text(self.gains.M)}"
        if len(self.gains.E):
            E = matrix_text(self.gains.E)
            yield "", f"and x̂ moves by E = {E} times what limits cut off an input, against windup"
        if self.cheaper is not None:
            share = controller.sizes.norm(self.cheaper) / controller.sizes.norm(self.gains.K)
            much = f"{share:.2g} times smaller" if share >= 1 else f"{1 / share:.2g} times larger"
            yield "", f"K is made for starts with inputs at limits: {much} in sizes than {matrix_text(self.cheaper)}"

    @property
    def sentence(self) -> str:
        if self.proof is None:
            return f"not proved: {self.missing}"
        gains = self.gains
        every = f"sampled every {number_text(gains.sample_time)} s"
        if gains.jitter:
            every += f", give or take {number_text(gains.jitter)} s"
        if gains.delay:
            every += f", inputs {amount(gains.delay, 'sample')} late"
        if gains.substeps > 1:
            every += f", predicted in {gains.substeps} steps"
        return (
            f"{every}, of the plant as designed, while no limit of an input is reached: errors go at least as fast as "
            f"e^(−{down(self.rate)} t), for any switching, between ticks too, to what acts on it leaves: x_d and "
            f"u_ff moving in a sample time, what is played back{', what is merged' * self.merged}, disturbances, "
            "noise, steps and rounding"
        )

    @cached_property
    def longest(self) -> float | None:
        """The longest sample time (s) found at which gains that are made for it are proved; None without one."""
        return None if self.design is None else longest(*self.design[:3], self.gains, self.estimates, self.design[3])

    def figures(self, words: Words, controller: ProvedController) -> dict[str, Any]:
        gains, rate = self.gains, None if self.proof is None else self.rate
        found = {"sample_time": gains.sample_time, "substeps": gains.substeps, "rate": rate}
        return {"sampled": found | {"K": gains.K.tolist(), "M": gains.M.tolist(), "E": gains.E.tolist()}}

    def brief(self, words: Words, controller: ProvedController) -> Iterator[Row]:
        if self.proof is None:
            at = "" if self.longest is None else f", it is every {number_text(self.longest)} s"
            yield "NOT proved", f"for sampling every {number_text(self.gains.sample_time)} s{at} ({self.missing})"
        else:
            said = f"proved{words.off_limits[1:] or ' while no input is at a limit'}{words.as_designed}"
            yield "as sampled", f"{said}: time constant {up(1 / self.rate)} s"
        yield "K, M", in_a_line(words, self.gains.K, "M", self.gains.M, "K and M are in run.json, under sampled")


def on_estimates(controller: ProvedController) -> OnEstimates | None:
    """Return how x_d and u_ff of a controller depend on estimates of loads, where they do otherwise than by −U ŝ."""
    filtered = controller.trajectory.rate.shape[1]
    return OnEstimates.of(controller.plant, controller.form, controller.compensation.X, filtered)


def errors_of(controller: ProvedController, gains: SampledGains) -> SampledErrors:
    """Return the errors of the loop of a controller with these gains."""
    return SampledErrors.of(controller.plant, gains, on_estimates(controller), controller.sizes)


def _beyond(controller: ProvedController, gains: SampledGains) -> str:
    """Return why nothing is tried; "" where it is."""
    if controller.plant.watched is not None and gains.jitter:
        return "ticks come early and late, and the program runs cells that are merged in the design"
    if missing := refused(controller.plant, controller.form, gains.jitter):
        return missing
    return too_much(controller.plant, gains, on_estimates(controller))


def _candidates(controller: ProvedController, asked: Asked, made: SampledGains) -> Iterator[SampledGains]:
    return candidates(controller.plant, controller.sizes, asked.words.goals, made)


def _cheaper(controller: ProvedController, asked: Asked, gains: SampledGains) -> Array | None:
    """Return the K in whose place that of gains is, if it was sought for limits.

    Raises ValueError if they are not gains that this controller may run with.
    """
    assert asked.sampled is not None
    of, goal = asked.sampled, asked.words.goals.get(CONTROLLER)
    sampling = Sampling(sample_time=of.sample_time, delay=of.delay, jitter=of.jitter)
    own, sizes = list[SampledGains](), controller.sizes
    for each in _candidates(controller, asked, sampled_gains(controller.plant, controller.K, controller.L, sampling)):
        if _same(gains, each, sizes):
            return None
        own.append(each)
    sought = asked.room is not None and isinstance(goal, AtLeast)
    made = sought and any(_same(replace(gains, K=each.K), each, sizes) for each in own)
    if not made and not any(_same(gains, each, sizes) for each in _candidates(controller, asked, of)):
        raise ValueError("the gains of the sampled loop are not those of its certificate")
    return own[0].K if sought else None


def _proved(controller: ProvedController, tried: Iterator[SampledGains], *, search: bool) -> SampledLoop:
    """Return a proof of the first gains that have one, with as many substeps as it needs; else some without."""
    first = next(tried)
    if missing := _beyond(controller, first):
        return SampledLoop(gains=first, proof=None, missing=missing)
    if not search:
        return SampledLoop(gains=_steady(controller, first, tried), proof=None, missing=_NOT_FOUND)
    design = controller.plant, controller.design.K, controller.design.L, controller.sizes
    estimates = on_estimates(controller)
    others, tried = tee(tried)
    found = (with_forms(controller.plant, each, estimates, controller.sizes) for each in chain([first], tried))
    gains, proof = next(filter(None, found), None) or (_steady(controller, first, others), None)
    missing, merged = "" if proof else _NOT_FOUND, bool(controller.claims_of(Practical))
    return SampledLoop(gains=gains, proof=proof, missing=missing, design=design, estimates=estimates, merged=merged)


def _steady(controller: ProvedController, first: SampledGains, others: Iterable[SampledGains]) -> SampledGains:
    """Return the first gains with which errors fall in each cell, and each change of it, by itself; or the first."""
    every = chain([first], others)
    return next((each for each in every if looked_for(errors_of(controller, each).clocked, 1).most > 0), first)


def _same(one: SampledGains, other: SampledGains, sizes: Sizes) -> bool:
    """Say whether gains are for one sample time, and the same in sizes but for what processors round apart."""
    if (one.sample_time, one.delay, one.jitter) != (other.sample_time, other.delay, other.jitter):
        return False
    pairs = ((of.K, of.M) for of in (one, other))
    if any(a.shape != b.shape for a, b in zip(*pairs, strict=True)):
        return False
    seen = ((sizes.gain(of.K), sizes.correction(of.M)) for of in (one, other))
    return all(np.abs(a - b).max() <= _LAST_DIGIT * np.abs(b).max() for a, b in zip(*seen, strict=True))


def proved_as_sampled(controller: ProvedController) -> bool:
    """Say whether a proof is about the sampled loop itself."""
    return any(claim.proof is not None for claim in controller.claims_of(SampledLoop))
