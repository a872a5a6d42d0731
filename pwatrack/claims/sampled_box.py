"""What is proved of the program for every plant of a box: its errors go to a bound, and how large that is in a run."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from pwatrack.arrays import up
from pwatrack.claims.exact_text import CLOCKED
from pwatrack.claims.practical import Practical
from pwatrack.claims.robust import Robust
from pwatrack.claims.sampled import SampledClaim, SampledLoop, errors_of
from pwatrack.claims.sampled_bounds import TubeBounds, shown
from pwatrack.control.controller import Asked, ProvedController, Row, Told
from pwatrack.control.sampled_disturbances import Acting
from pwatrack.control.sampled_error import SampledErrors
from pwatrack.control.sampled_search import with_corners
from pwatrack.control.words import Words, down
from pwatrack.lmi.clocked import ClockedProof


@dataclass(frozen=True, kw_only=True)
class SampledBox(SampledClaim):
    """The sampled loop for the plants of a box, proved or not."""

    of: Robust  # what is proved of them in continuous time; it has the box

    statement: ClassVar[str] = (
        "Under sampled_uncertain: z as under sampled, for every plant as under uncertain: e' has A_i(p) and B(p) in "
        "place of A_i and B, Delta' A_i - A_i(p) and B - B(p) more, for the same i; P as under sampled, for that rate."
    )
    nothing: ClassVar[Mapping[str, Any]] = {"sampled_uncertain": None}

    @classmethod
    def prove(cls, controller: ProvedController, asked: Asked, told: Told = None) -> Iterator["SampledBox"]:
        """Yield the proof, or why there is none, where the loop is sampled and proved, and parameters are uncertain."""
        for loop, of, errors in _both(controller):
            assert loop.proof is not None
            if told is None:
                proof, missing = with_corners(errors, len(loop.proof.P) // errors.parts - 1)
            else:
                content = told["sampled_uncertain"]
                proof = None if content is None else CLOCKED.read(content)
                missing = "no proof is in the certificate" * (proof is None)
            yield cls(of=of, gains=loop.gains, proof=proof, missing=missing)

    def data(self, controller: ProvedController) -> dict[str, Any]:
        return {} if self.proof is None else {"sampled_uncertain": CLOCKED.write(self.proof)}

    def figures(self, words: Words, controller: ProvedController) -> dict[str, Any]:
        return {"sampled_uncertain": {"rate": None if self.proof is None else self.rate}}

    def rows(self, words: Words, controller: ProvedController) -> Iterator[Row]:
        box = self.of.parameters
        if self.proof is None:
            yield "box, sampled", f"not proved for every plant with {box}: {self.missing}"
        else:
            yield (
                "box, sampled",
                f"for every plant with {box}, also where they change with time, errors of the sampled loop go to a "
                f"bound at least as fast as e^(−{down(self.rate)} t), while no limit of an input is reached",
            )

    def brief(self, words: Words, controller: ProvedController) -> Iterator[Row]:
        if self.proof is not None:
            box = self.of.parameters
            yield "as sampled", f"to a bound for all plants with {box}: time constant {up(1 / self.rate)} s"


@dataclass(frozen=True, kw_only=True)
class SampledBoxBounds(TubeBounds):
    """Tubes for all that acts in a run, and for all that a plant of the box does otherwise."""

    statement: ClassVar[str] = (
        "Under sampled_uncertain_bounds: the same as under sampled_bounds for every plant as under uncertain, with z' "
        "as under sampled_uncertain; a disturbance has w = f_p(x_d) - f(x_d) + (B_p - B) u_nom in it, u_nom as it is "
        "held along x_nom, and each entry of x_nom - x_d acts."
    )
    nothing: ClassVar[Mapping[str, Any]] = {"sampled_uncertain_bounds": []}
    KEY: ClassVar[str] = "sampled_uncertain_bounds"

    @classmethod
    def known(cls, controller: ProvedController, asked: Asked) -> Iterator[tuple[ClockedProof, SampledErrors, Acting]]:
        proofs = [box.proof for box in controller.claims_of(SampledBox) if box.proof is not None]
        for proof in proofs if not controller.claims_of(Practical) else ():
            for _, _, errors in _both(controller):
                if (acts := asked.acting(controller, errors)) is not None:
                    yield proof, errors, acts

    def rows(self, words: Words, controller: ProvedController) -> Iterator[Row]:
        ends = ", ".join(words.limits(shown(self.ends_below(controller))))
        said, off = "for every plant of the box, also where it changes in the run", words.off_limits
        if self.idle:
            said = f"{said}, nothing acts on the sampled loop: its errors go to 0, but for rounding{off}"
        elif ends:
            said = f"{ends} in the end in the sampled loop, {said}, between ticks too"
            said += f", beside what is left of the start{off}"
        else:
            said = f"no bound was found for what is left in the sampled loop {said}"
        yield "box, in this run", said


def _both(controller: ProvedController) -> Iterator[tuple[SampledLoop, Robust, SampledErrors]]:
    """Yield the sampled loop where it is proved, the box, and the errors of the loop for its plants."""
    for loop in controller.claims_of(SampledLoop):
        for of in controller.claims_of(Robust) if loop.proof is not None else ():
            yield loop, of, replace(errors_of(controller, loop.gains), corners=of.corners)
