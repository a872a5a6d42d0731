"""What is proved of the program itself: a loop that is sampled, with inputs that are held, between its ticks too."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from pwatrack.arrays import number_text, up
from pwatrack.claims.exact_text import decimal, decimal_texts, double, doubles, packed, whole
from pwatrack.claims.practical import Practical
from pwatrack.control.controller import Asked, Claim, ProvedController, Row
from pwatrack.control.sampled_error import SampledErrors
from pwatrack.control.sampled_gains import SampledGains, sampled_gains
from pwatrack.control.words import Words, down, matrix_text
from pwatrack.lmi.clocked import ClockedProof, fastest
from pwatrack.lmi.exact import Packed
from pwatrack.model.conditions import Sampling

_KNOTS = (1, 2, 4)  # segments of a substep that are tried
_MORE = (1, 2, 4)  # times as many substeps of a prediction are tried
_MOST_WORK = 40_000  # inequalities times the square of their order: an auditor takes about 10 steps for each
_LAST_DIGIT = 1e-7  # of an entry of a gain, as a share
_NOT_FOUND = "no forms were found that prove it"
_SHORTER = 0.5, 5  # of a sample time at which it is not proved: what is tried next, and how often


@dataclass(frozen=True, kw_only=True)
class SampledLoop(Claim):
    """The sampled loop, proved or not.

    Attributes:
        gains: Of the program.
        proof: Forms that prove it; None where it is not proved.
        missing: Why it is not; "" where it is.
        shorter: A sample time (s) at which it would be; None where it is, or none was found.
    """

    gains: SampledGains
    proof: ClockedProof | None
    missing: str = ""
    shorter: float | None = None

    statement: ClassVar[str] = (
        "Under sampled: P of z = (x - x_d, nu = K (x_hat - x_d) at the tick, x_hat - x, s_hat - s, rho), with x_hat as "
        "it is predicted between ticks, rho = R (x_hat - p) - R (x_d - x_d at p), p where a substep begins, linear in "
        "time between the knots of each substep, is positive definite and z^T P z falls as e^(-2 rate t): "
        "(P_k+1 - P_k) / step + F^T P_e + P_e F + 2 rate P_e < 0 at both ends e of each segment for all F of the "
        "cells, J^T P_0 J < P_N at ticks and at the ends of substeps."
    )
    nothing: ClassVar[Mapping[str, Any]] = {"sampled": None}

    @classmethod
    def prove(cls, controller: ProvedController, asked: Asked) -> Iterator["SampledLoop"]:
        """Yield the proof, or why there is none, where the loop is to be sampled."""
        if asked.sampled is not None:
            missing = _beyond(controller, asked.sampled)
            yield (
                cls(gains=asked.sampled, proof=None, missing=missing) if missing else _proved(controller, asked.sampled)
            )

    @classmethod
    def read(cls, content: Mapping[str, Any], controller: ProvedController, asked: Asked) -> Iterator["SampledLoop"]:
        """Yield what was proved, or that nothing was."""
        told = content["sampled"]
        if told is not None:
            gains = _read_gains(told)
            if asked.sampled is not None and not _same(gains, asked.sampled):
                raise ValueError("the gains of the sampled loop are not those of its certificate")
            P = tuple(Packed(**whole(one)) for one in told["P"])
            yield cls(gains=gains, proof=ClockedProof(P=P, rate=double(told["rate"])))
        elif asked.sampled is not None:
            missing = _beyond(controller, asked.sampled) or _NOT_FOUND
            yield cls(gains=asked.sampled, proof=None, missing=missing)

    @property
    def runs_with(self) -> SampledGains:
        """The gains of the program, proved or not."""
        return self.gains

    def data(self, controller: ProvedController) -> dict[str, Any]:
        """Return gains and forms."""
        if self.proof is None:
            return {}
        gains, errors = self.gains, _errors(controller, self.gains)
        return {
            "sampled": {
                "K": decimal_texts(gains.K),
                "M": decimal_texts(gains.M),
                "rows": errors.R.texts,
                "sample_time": decimal(gains.sample_time),
                "substeps": gains.substeps,
                "rate": decimal(self.proof.rate),
                "P": [packed(P.integers, P.exponents) for P in self.proof.P],
            }
        }

    def rows(self, words: Words, controller: ProvedController) -> Iterator[Row]:
        """Yield what is proved of it, and what it runs with."""
        at = "" if self.shorter is None else f"; every {number_text(self.shorter)} s it is proved"
        yield "sampled loop", self.sentence + at
        yield "", f"runs with K = {matrix_text(self.gains.K)}, M = {matrix_text(self.gains.M)}, made of K and L for it"

    @property
    def sentence(self) -> str:
        """What is proved of it."""
        if self.proof is None:
            return f"not proved: {self.missing}"
        every = f"sampled every {number_text(self.gains.sample_time)} s"
        if self.gains.substeps > 1:
            every += f", predicted in {self.gains.substeps} steps"
        return (
            f"{every}, of the plant as designed, while no limit of an input is reached: errors go at least as fast as "
            f"e^(−{down(self.proof.rate)} t), for any switching, between ticks too, to what acts on it leaves: x_d and "
            "u_ff moving in a sample time, what is played back, disturbances, noise, steps and rounding"
        )

    def figures(self, words: Words, controller: ProvedController) -> dict[str, Any]:
        """Return the rate, none where it is not proved."""
        gains, rate = self.gains, None if self.proof is None else self.proof.rate
        found = {"sample_time": gains.sample_time, "substeps": gains.substeps, "rate": rate}
        return {"sampled": found | {"K": gains.K.tolist(), "M": gains.M.tolist()}}

    def brief(self, words: Words, controller: ProvedController) -> Iterator[Row]:
        """Yield whether the sampling is in a proof, and how fast it is."""
        if self.proof is None:
            at = "" if self.shorter is None else f", it is every {number_text(self.shorter)} s"
            yield "NOT proved", f"sampled every {number_text(self.gains.sample_time)} s{at} ({self.missing})"
        else:
            every, constant = number_text(self.gains.sample_time), up(1 / self.proof.rate)
            yield "sampled", f"every {every} s, proved too: time constant {constant} s"


def _errors(controller: ProvedController, gains: SampledGains) -> SampledErrors:
    return SampledErrors.of(controller.plant, gains)


def _beyond(controller: ProvedController, gains: SampledGains) -> str:
    """Return why nothing is tried; "" where it is."""
    if controller.claims_of(Practical) or controller.plant.watched is not None:
        return "cells are merged, and what is merged would act on the prediction too"
    if gains.delay:
        return "inputs are late, and what waits is not in the proof"
    plant, square = controller.plant, len(controller.plant.tracked) == controller.plant.B.shape[1]
    if plant.loads is not None and (plant.loads.inputs(plant.exact.B) is None or not (square or not controller.form)):
        return "loads that are estimated do not only act at inputs, one for each tracked output"
    if not (np.isfinite(gains.K).all() and np.isfinite(gains.M).all()):
        return "its gains are out of range: a sample is too long"
    if SampledErrors.least_work(plant, gains) > _MOST_WORK:
        return "its cells are too many"
    errors = _errors(controller, gains)
    if not _tried(errors):
        return f"it takes {errors.inequalities} inequalities of order {errors.order}, which is too much"
    return ""


def _tried(errors: SampledErrors) -> list[int]:
    """Return the numbers of segments of a substep that are tried."""
    work = errors.inequalities * errors.order**2
    return [knots for knots in _KNOTS if work * knots <= _MOST_WORK]


def _proved(controller: ProvedController, gains: SampledGains) -> SampledLoop:
    """Return a proof with as many substeps as it needs; of the gains as they are where none is found."""
    found = _with_forms(controller, gains)
    if found is not None:
        return found
    (share, times), h = _SHORTER, gains.sample_time
    for k in range(1, times + 1):
        sampling = Sampling(sample_time=float(f"{h * share**k:.2g}"))
        shorter = sampled_gains(controller.plant, controller.design.K, controller.design.L, sampling)
        if _with_forms(controller, shorter) is not None:
            return SampledLoop(gains=gains, proof=None, missing=_NOT_FOUND, shorter=sampling.sample_time)
    return SampledLoop(gains=gains, proof=None, missing=_NOT_FOUND)


def _with_forms(controller: ProvedController, gains: SampledGains) -> SampledLoop | None:
    """Return the loop with forms that prove it, or None."""
    for more in _MORE if gains.substeps > 1 else (1,):
        finer = replace(gains, substeps=more * gains.substeps)
        errors = _errors(controller, finer)
        for knots in _tried(errors):
            proof = fastest(errors.clocked, knots=knots)
            if proof is not None:
                return SampledLoop(gains=finer, proof=proof)
    return None


def _same(one: SampledGains, other: SampledGains) -> bool:
    """Say whether gains are for one sample time, and the same but for what processors round apart."""
    pairs = (one.K, other.K), (one.M, other.M)
    close = all(a.shape == b.shape and np.allclose(a, b, rtol=_LAST_DIGIT, atol=0.0) for a, b in pairs)
    return (one.sample_time, one.delay) == (other.sample_time, other.delay) and close


def _read_gains(told: Any) -> SampledGains:
    return SampledGains(
        K=np.asarray(doubles(told["K"])),
        M=np.asarray(doubles(told["M"])),
        sample_time=double(told["sample_time"]),
        substeps=told["substeps"],
    )
