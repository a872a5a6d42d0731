"""Looks for tubes of what acts on the errors of a sampled loop: see `lmi.clocked_tubes`."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix, above
from pwatrack.control.bounds import Channel, Form
from pwatrack.control.controller import ProvedController
from pwatrack.control.sampled_disturbances import SUMMED, Acting, driven, numbers, row
from pwatrack.control.sampled_error import SampledErrors
from pwatrack.lmi.clocked import ClockedProof
from pwatrack.lmi.clocked_tubes import Tube, TubeProgram, tube
from pwatrack.lmi.exact import rounded_down
from pwatrack.rational import floats

_BESIDE = 0.01  # of the weight of what is tracked, in sizes: that of inputs and of other signals
_SHARES = (0.5, 0.25, 0.1)  # of the rate that vertices have by themselves: what tubes decay with, until one is found
_MORE = (1.6, 2.0)  # times that, as long as bounds get less


@dataclass(kw_only=True)
class TubeSearch:
    """Looks for tubes: of the first with what it decays with best, of the others of its kind with the same."""

    errors: SampledErrors
    program: TubeProgram
    forms: Sequence[Form]
    rows: BallMatrix  # of the forms, and of inputs where these are none of them
    weights: Array
    shares: dict[bool, float] = field(default_factory=dict)

    @classmethod
    def of(
        cls, controller: ProvedController, forms: Sequence[Form], errors: SampledErrors, proof: ClockedProof
    ) -> "TubeSearch":
        system = errors.clocked
        program = TubeProgram(system=system, near=floats(proof.P[0].P), knots=len(proof.P) // system.parts - 1)
        rows, weights = [row(errors, form) for form in forms], _weights(controller, forms)
        if not controller.compensation.alone:  # what is put out, if x_d moves, and as it does
            for put_out in (each[0] for each in numbers(errors)["u"]):
                rows.append(BallMatrix.of(put_out, put_out.shape))
                weights = np.concatenate([weights, _BESIDE / controller.sizes.input**2])
        return cls(errors=errors, program=program, forms=forms, rows=above(*rows), weights=weights)

    def tubes(self, acts: Acting) -> dict[Channel, tuple[Tube, ...]]:
        """Return the tubes that are proved, of each channel that has one: first that of its mean square."""
        found = dict[Channel, tuple[Tube, ...]]()
        for channel in acts.squares:
            ways = (True,) if channel[0] in SUMMED else (False, True)[: 1 + (channel in acts.means)]
            each = (self._best(channel, summed) for summed in ways)
            if tubes := tuple(one for one in each if one is not None):
                found[channel] = tubes
        return found

    def _best(self, channel: Channel, summed: bool) -> Tube | None:
        known = self.shares.get(summed)
        best = next(filter(None, (self._at(channel, one, summed) for one in (known, *_SHARES) if one)), None)
        if best is None:
            return None
        share = best[1]
        for factor in () if known else _MORE:
            more = self._at(channel, factor * share, summed)
            if more is None or more[0] > best[0]:
                break
            best = more
        self.shares[summed] = best[1]
        return best[2]

    def _at(self, channel: Channel, share: float, summed: bool) -> tuple[float, float, Tube] | None:
        decay = rounded_down(share * self.program.most, 3)
        found = tube(self.program, driven(self.errors, channel), self.rows, self.weights, decay, summed=summed)
        if found is None:
            return None
        ends = np.array(found.sizes) / (decay if summed else 1.0)  # of 1 for good
        cost = float(self.weights @ np.square(ends))
        return cost, share, replace(found, sizes=found.sizes[: len(self.forms)])


def _weights(controller: ProvedController, forms: Sequence[Form]) -> Array:
    """Return what the square of each signal counts: of what is tracked, in sizes, most."""
    sizes = controller.sizes
    of = {"output": sizes.tracked, "state": sizes.state, "input": sizes.input, "estimate": sizes.state}
    each = ((1.0 if kind == controller.tracking else _BESIDE) / of[kind][k] ** 2 for kind, k in forms)
    return np.array(list(each))
