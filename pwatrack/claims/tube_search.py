"""Looks for tubes of what acts on the errors of a sampled loop: see `lmi.clocked_tubes`."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

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
_SHARES = (1.0, 0.8, 0.6, 0.4, 0.25, 0.1)  # of the rate that vertices have by themselves: what tubes decay with
_BEYOND = 4.0  # times what forms that are proved fall with, as squares: no tube was found that decays faster
_MIDDLE = 0.5  # of that rate, where one has to do for shares of many
_FINER = 2  # tubes that are looked for in coordinates of the one before, as long as that helps
_LESS = 0.01  # of a logarithm: what helps
_QUICK = 1e9  # cube of the unknowns up to which other rates are tried: a second or so


@dataclass(kw_only=True)
class TubeSearch:
    """Looks for tubes, each with what it decays with best.

    Signals are taken in their sizes in the file first, then in those that they have in the tube that is found so, in
    whose coordinates the next is looked for: so a signal that hardly anything acts on has a bound as small.
    """

    errors: SampledErrors
    program: TubeProgram
    forms: Sequence[Form]
    rows: BallMatrix  # of the forms, of estimated loads, and of inputs where these are no forms
    counts: Array  # of each: what is tracked most
    sizes: Array  # of each, in the file
    proved: float  # the rate with which the forms that are proved fall, in 1/s

    @classmethod
    def of(
        cls, controller: ProvedController, forms: Sequence[Form], errors: SampledErrors, proof: ClockedProof
    ) -> "TubeSearch":
        system = errors.clocked
        program = TubeProgram(system=system, near=floats(proof.P[0].P), knots=len(proof.P) // system.parts - 1)
        counts, sizes = zip(*(_counted(controller, form) for form in forms), strict=True)
        rows, read = [row(errors, form) for form in forms], numbers(errors)
        others = [(each[0], controller.sizes.load) for each in read.get("s_hat", ())]
        if not controller.compensation.alone:  # what is put out, if x_d moves, and as it does
            others += [(each[0], controller.sizes.input) for each in read["u"]]
        for more, own in others:
            rows.append(BallMatrix.of(more, more.shape))
            counts, sizes = (*counts, *[_BESIDE] * len(more)), (*sizes, *own)
        return cls(
            errors=errors,
            program=program,
            forms=forms,
            rows=above(*rows),
            counts=np.array(counts),
            sizes=np.array(sizes),
            proved=proof.rate,
        )

    def tubes(self, acts: Acting) -> Iterator[tuple[Sizes, tuple[Tube, ...]]]:
        """Yield the tubes that are proved, of each channel that has one: first that of its mean square."""
        for channel in acts.squares:
            drive = driven(self.errors, channel)
            both = channel in acts.means and drive.corners(self.program.system) <= _CORNERS
            ways = (True,) if channel[0] in SUMMED else (False, True)[: 1 + both]
            each = (self._best(drive, summed) for summed in ways)
            if tubes := tuple(one for one in each if one is not None):
                yield {channel: 1.0}, tubes

    def together(self, acts: Acting) -> Iterator[tuple[Sizes, tuple[Tube, ...]]]:
        """Yield tubes of channels of one kind each, all in one: what a search takes less of.

        As large as they act, they leave what they would by themselves, in the loop of the mean of all vertices, if each
        has its share of d². An ellipsoid that holds a sum of others is no larger, in what is asked of it, than these.
        """
        kinds = dict[tuple[bool, bool], dict[Channel, Drive]]()
        for channel in acts.squares:
            drive = driven(self.errors, channel)
            kinds.setdefault((channel[0] in SUMMED, drive.ticks is None), {})[channel] = drive
        for (summed, _), drives in kinds.items():
            sizes = dict.fromkeys(drives, 1.0) if len(drives) == 1 else self._sizes(acts, drives, summed)
            best = self._best(Drive.together([*drives.values()], [*sizes.values()]), summed)
            if best is not None:
                yield sizes, (best,)
            elif not all(kind == "start" for kind, _ in drives):
                break  # without it nothing is known

    def _sizes(self, acts: Acting, drives: Mapping[Channel, Drive], summed: bool) -> Sizes:
        """Return what of each channel is to be 1."""
        squares = np.array([acts.squares[channel] for channel in drives])
        most = np.sqrt(squares.max(axis=1) if summed else np.maximum(squares.mean(axis=1), _RARE * squares.max(axis=1)))
        rows, whole = self.rows.floats, Drive.together([*drives.values()], [1.0] * len(drives))
        a, b = whole.decay(_MIDDLE * self.program.clock.most, self.program.system)
        shares = most * self.program.alone(whole, rows, self.counts / self.sizes**2, a=a, b=b)
        known = shares.any() and np.isfinite(shares).all()
        shares = np.maximum(shares / shares.sum(), _LEAST) if known else np.ones(len(shares))
        sizes = most / np.sqrt(shares / shares.sum())
        return {channel: float(f"{size:.3g}") for channel, size in zip(drives, sizes.tolist(), strict=True)}

    def _best(self, drive: Drive, summed: bool) -> Tube | None:
        """Return the best tube that is found, from the rate on with which the mean of all vertices leaves least."""
        of_mean = self._of_mean(drive)
        most = max(2 * _BEYOND * self.proved / self.program.clock.most, _SHARES[-1])
        slow = (share for share in _SHARES[of_mean:] if share <= most)
        best = next(filter(None, (self._at(drive, share, summed) for share in slow)), None)
        if best is None:
            return None
        at = _SHARES.index(best.share)
        best = self._walked(drive, best, [best.share] * _FINER, summed)
        quick = self.program.clock.unknowns**3 <= _QUICK
        if quick:
            best = self._walked(drive, best, _SHARES[at + 1 :], summed)
        if quick and best.share == _SHARES[of_mean]:
            best = self._walked(drive, best, _SHARES[:at][::-1], summed)
        return replace(best.tube, sizes=best.tube.sizes[: len(self.forms)])

    def _walked(self, drive: Drive, best: "_Found", shares: Iterable[float], summed: bool) -> "_Found":
        """Return the last of tubes with some shares, each looked for beside the one before, as long as that helps."""
        for share in shares:
            more = self._at(drive, share, summed, best.tube)
            if more is None or more.cost > best.cost - _LESS:
                break
            best = more
        return best

    def _of_mean(self, drive: Drive) -> int:
        """Return which share of the rate leaves least in the loop of the mean of all vertices."""
        program, weights, found = self.program, self.counts / self.sizes**2, list[float]()
        for share in _SHARES:
            a, b = drive.decay(share * program.clock.most, program.system)
            with np.errstate(all="ignore"):  # what does not decay as fast is out of range
                alone = program.alone(drive, self.rows.floats, weights, a=a, b=b)
            found.append(float(alone.sum() / np.sqrt(share)))
        return int(np.argmin(np.nan_to_num(found, nan=np.inf)))

    def _at(self, drive: Drive, share: float, summed: bool, near: Tube | None = None) -> "_Found | None":
        decay = rounded_down(share * self.program.clock.most, 3)
        sizes = self.sizes if near is None else np.array(near.sizes)
        weights = self.counts / np.where(sizes, sizes, np.inf) ** 2
        found = None
        with suppress(np.linalg.LinAlgError, ZeroDivisionError):  # a form is not definite to working precision
            found = tube(self.program, drive, self.rows, weights, decay, summed=summed, near=near)
        if found is None:
            return None
        sizes = np.array(found.sizes) / (decay if summed else 1.0)  # of 1 for good
        cost = self.counts[sizes > 0] @ np.log(sizes[sizes > 0]) / self.counts.sum()
        return _Found(cost=float(cost), share=share, tube=found)


@dataclass(frozen=True, kw_only=True)
class _Found:
    """A tube, with the share of the rate that it decays with, and the mean of the logarithms of what signals have."""

    cost: float
    share: float
    tube: Tube


def _counted(controller: ProvedController, form: Form) -> tuple[float, float]:
    """Return what a signal counts, what is tracked most, and its size."""
    (kind, k), sizes = form, controller.sizes
    of = {"output": sizes.tracked, "state": sizes.state, "input": sizes.input, "estimate": sizes.state}
    return 1.0 if kind == controller.tracking else _BESIDE, float(of[kind][k])
