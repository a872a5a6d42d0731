"""Looks for tubes of what acts on the errors of a sampled loop: see `lmi.clocked_tubes`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix, above
from pwatrack.claims.tube_text import Sizes
from pwatrack.control.bounds import Channel, Form
from pwatrack.control.controller import ProvedController
from pwatrack.control.sampled_disturbances import SUMMED, Acting, driven, numbers, row
from pwatrack.control.sampled_error import SampledErrors
from pwatrack.lmi.clocked import ClockedProof
from pwatrack.lmi.clocked_tubes import Drive, Tube, TubeProgram, tube
from pwatrack.lmi.exact import rounded_down
from pwatrack.rational import floats

KINDS = 4  # of channels that have a tube together: between ticks and at them, summed or not
_CORNERS = 64  # at which something acts, up to which it has a tube of its sum beside another: each is asked for
_RARE = 0.01  # of the largest square: what counts of a channel that acts seldom
_LEAST = 1e-4  # of d²: the share of a channel that does little
_BESIDE = 0.01  # of the weight of what is tracked, in sizes: that of inputs and of other signals
_SHARES = (0.5, 0.25, 0.1)  # of the rate that vertices have by themselves: what tubes decay with, until one is found
_MORE = (1.6, 2.0)  # times that, as long as bounds get less


@dataclass(kw_only=True)
class TubeSearch:
    """Looks for tubes: of the first with what it decays with best, of the others of its kind with the same.

    Signals are taken in their sizes in the file first, then in those that they have in the tube that is found so: of
    all tubes at that decay it is the last that is small by each signal's own measure.
    """

    errors: SampledErrors
    program: TubeProgram
    forms: Sequence[Form]
    rows: BallMatrix  # of the forms, and of inputs where these are none of them
    counts: Array  # of each: what is tracked most
    sizes: Array  # of each, in the file
    shares: dict[bool, float] = field(default_factory=dict)

    @classmethod
    def of(
        cls, controller: ProvedController, forms: Sequence[Form], errors: SampledErrors, proof: ClockedProof
    ) -> "TubeSearch":
        system = errors.clocked
        program = TubeProgram(system=system, near=floats(proof.P[0].P), knots=len(proof.P) // system.parts - 1)
        counts, sizes = zip(*(_counted(controller, form) for form in forms), strict=True)
        rows = [row(errors, form) for form in forms]
        if not controller.compensation.alone:  # what is put out, if x_d moves, and as it does
            for put_out in (each[0] for each in numbers(errors)["u"]):
                rows.append(BallMatrix.of(put_out, put_out.shape))
                counts, sizes = (*counts, *[_BESIDE] * len(put_out)), (*sizes, *controller.sizes.input)
        return cls(
            errors=errors,
            program=program,
            forms=forms,
            rows=above(*rows),
            counts=np.array(counts),
            sizes=np.array(sizes),
        )

    def tubes(self, acts: Acting) -> dict[Channel, tuple[Tube, ...]]:
        """Return the tubes that are proved, of each channel that has one: first that of its mean square."""
        found = dict[Channel, tuple[Tube, ...]]()
        for channel in acts.squares:
            drive = driven(self.errors, channel)
            both = channel in acts.means and drive.corners(self.program.system) <= _CORNERS
            ways = (True,) if channel[0] in SUMMED else (False, True)[: 1 + both]
            each = (self._best(drive, summed) for summed in ways)
            if tubes := tuple(one for one in each if one is not None):
                found[channel] = tubes
        return found

    def together(self, acts: Acting) -> tuple[dict[Channel, tuple[Tube, ...]], tuple[Sizes, ...]]:
        """Return tubes of channels of one kind each, all in one, and the sizes of these: what a search takes less of.

        As large as they act, they leave what they would by themselves, in the loop of the mean of all vertices, if each
        has its share of d². An ellipsoid that holds a sum of others is no larger, in what is asked of it, than these.
        """
        kinds = dict[tuple[bool, bool], dict[Channel, Drive]]()
        for channel in acts.squares:
            drive = driven(self.errors, channel)
            kinds.setdefault((channel[0] in SUMMED, drive.ticks is None), {})[channel] = drive
        tubes, found = dict[Channel, tuple[Tube, ...]](), list[Sizes]()
        for (summed, _), drives in kinds.items():
            alone = len(drives) == 1
            sizes = dict.fromkeys(drives, 1.0) if alone else self._sizes(acts, drives, summed)
            best = self._best(Drive.together([*drives.values()], [*sizes.values()]), summed)
            if best is not None:
                tubes[next(iter(drives)) if alone else ("together", len(found))] = (best,)
                found += [] if alone else [sizes]
            elif not all(kind == "start" for kind, _ in drives):
                break  # without it nothing is known
        return tubes, tuple(found)

    def _sizes(self, acts: Acting, drives: Mapping[Channel, Drive], summed: bool) -> Sizes:
        """Return what of each channel is to be 1."""
        squares = np.array([acts.squares[channel] for channel in drives])
        most = np.sqrt(squares.max(axis=1) if summed else np.maximum(squares.mean(axis=1), _RARE * squares.max(axis=1)))
        rows, whole = self.rows.floats, Drive.together([*drives.values()], [1.0] * len(drives))
        a, b = whole.decay(_SHARES[0] * self.program.most, self.program.system)
        shares = most * self.program.alone(whole, rows, self.counts / self.sizes**2, a=a, b=b)
        known = shares.any() and np.isfinite(shares).all()
        shares = np.maximum(shares / shares.sum(), _LEAST) if known else np.ones(len(shares))
        sizes = most / np.sqrt(shares / shares.sum())
        return {channel: float(f"{size:.3g}") for channel, size in zip(drives, sizes.tolist(), strict=True)}

    def _best(self, drive: Drive, summed: bool) -> Tube | None:
        known = self.shares.get(summed)
        best = next(filter(None, (self._at(drive, one, summed, self.sizes) for one in (known, *_SHARES) if one)), None)
        if best is None:
            return None
        share = best[1]
        for factor in () if known else _MORE:
            more = self._at(drive, factor * share, summed, self.sizes)
            if more is None or more[0] > best[0]:
                break
            best = more
        self.shares[summed] = best[1]
        found = self._at(drive, best[1], summed, np.array(best[2].sizes)) or best
        return replace(found[2], sizes=found[2].sizes[: len(self.forms)])

    def _at(self, drive: Drive, share: float, summed: bool, sizes: Array) -> tuple[float, float, Tube] | None:
        """Return what a tube costs where signals have some sizes, the share that was asked for, and the tube."""
        decay, weights = rounded_down(share * self.program.most, 3), self.counts / np.where(sizes, sizes, np.inf) ** 2
        found = tube(self.program, drive, self.rows, weights, decay, summed=summed)
        if found is None:
            return None
        ends = np.array(found.sizes) / (decay if summed else 1.0)  # of 1 for good
        return float(weights @ np.square(ends)), share, found


def _counted(controller: ProvedController, form: Form) -> tuple[float, float]:
    """Return what a signal counts, what is tracked most, and its size."""
    (kind, k), sizes = form, controller.sizes
    of = {"output": sizes.tracked, "state": sizes.state, "input": sizes.input, "estimate": sizes.state}
    return 1.0 if kind == controller.tracking else _BESIDE, float(of[kind][k])
