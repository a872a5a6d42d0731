"""What came out of a spec: a designed and simulated closed loop."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pwatrack.arrays import Array, amount
from pwatrack.control.bounds import Form
from pwatrack.control.controller import ProvedController
from pwatrack.simulation.closed_loop import ClosedLoop, Response
from pwatrack.simulation.figures import Figures
from pwatrack.simulation.layout import Actuator
from pwatrack.simulation.propagate import sample_count
from pwatrack.simulation.steady_state import SteadyState
from pwatrack.simulation.trace import Trace, TraceOnDisk, Unresolved
from pwatrack.spec.spec import Spec
from pwatrack.workflow.bands import bands, so_far
from pwatrack.workflow.outcome import Outcome
from pwatrack.workflow.starting import start_remarks
from pwatrack.workflow.tracking import reference_remarks


@dataclass(frozen=True, kw_only=True)
class SimulatedLoop:
    """A designed and simulated closed loop."""

    spec: Spec  # what was asked
    controller: ProvedController  # gains, desired trajectory and their proofs
    loop: ClosedLoop  # the closed loop
    response: Response  # its signals; of a very long run only every so many-th, and in events only what these show
    figures: Figures  # what was measured over all samples
    outcome: Outcome  # how the run ended, said by all samples
    start: Array  # z(0)
    steady_state: SteadyState | None  # one period of the generator's (η̂, w, 1), or None if it has none
    spool: TraceOnDisk | None  # all samples and events of a run of which `response` has not all
    # of uncertain parameters, how large each entry of w gets in each tenth of the run for any plant of the box,
    # enclosed: see `workflow.bands`, (10, n). None where that took too long.
    w: Array | None = None

    @property
    def remarks(self) -> tuple[str, ...]:
        """What was noticed and changes no verdict."""
        S = self.controller.trajectory.exosystem.S
        fastest = float(np.abs(np.linalg.eigvals(S).imag).max(initial=0.0)) if S.size else 0.0
        remarks = list(dict.fromkeys(self.spec.problem.plant.remarks + self.loop.plant.remarks))
        remarks += reference_remarks(self.spec, self.controller.form)
        remarks += start_remarks(self.spec, self.controller.trajectory, self.controller.generator)
        duration, step = self.spec.scenario.duration, self.spec.scenario.sample_time
        if fastest * step > 2 * np.pi / 10:
            remarks.append(
                f"sample_time {step:g} s is too long for a reference with a period of "
                f"{2 * np.pi / fastest:.4g} s: pictures and times miss what lies between samples"
            )
        if self.end < duration * (1 - 1e-9):
            remarks.append(
                f"the run ends with the last sample, at t = {self.end:.9g} s: the duration, {duration:g} s, "
                f"is no multiple of the sample time, {step:g} s"
            )
        remarks += _unresolved(self.response.trace)
        return tuple(remarks)

    @property
    def tracking_bound(self) -> Array | None:
        """What the proofs promise of |y − y_d|, for state tracking of |x − x_d|, from these initial states, (K,).

        None if the loop is not the one that they are about.
        """
        if not self.loop.conditions.nominal:
            return None
        r = self.response
        return self.controller.tracking_bound(r.t, r.x[0] - r.x_d[0], r.x_hat[0] - r.x[0])

    @property
    def observer_bound(self) -> Array | None:
        """What the proofs promise of |x̂ − x| from these initial states, (K,); None as for `tracking_bound`."""
        if not self.loop.conditions.nominal:
            return None
        r = self.response
        return self.controller.observer_bound(r.t, r.x_hat[0] - r.x[0])

    @cached_property
    def bands(self) -> dict[Form, Array]:
        """What is proved of each signal at the samples that were kept, from this start and for what acts, (K,) each."""
        if self.spool is not None and self.loop.conditions.limits is not None:
            return {}  # whether an input came to its limit, what was kept does not tell
        r, w = self.response, self.w
        if w is not None:
            samples = sample_count(self.spec.scenario.duration, self.spec.scenario.sample_time)
            w = so_far(w, r.t, samples, self.spec.scenario.sample_time)
        return bands(self.loop, r, self.spec.objectives.uncertain, w)

    @property
    def at_limits(self) -> dict[str, float]:
        """The share of the time that each input with limits was at one of them, by name."""
        shares, found = self.figures.time_share, dict[str, float]()
        for part in self.loop.flow.parts:
            if isinstance(part, Actuator):
                held = {cell for cell, level in zip(part.cells, part.levels, strict=True) if level is not None}
                time = shares.get(part.name, {}).items()
                found[self.loop.plant.inputs[part.input]] = sum(share for cell, share in time if cell in held)
        return found

    @property
    def end(self) -> float:
        """The time of the last sample in s, whether it was kept or not."""
        step = self.spec.scenario.sample_time
        return (sample_count(self.spec.scenario.duration, step) - 1) * step

    @property
    def final_error(self) -> float:
        """The largest norm of the tracking error in the last tenth of the simulation."""
        return self.figures.final_error

    def blocks(self) -> Iterator[Response]:
        """Yield the signals at all samples, with all events; those of a long run block by block, off the disk."""
        if self.spool is None:
            yield self.response
        else:
            yield from map(self.loop.response, self.spool)


def _unresolved(trace: Trace) -> list[str]:
    """Return a remark of all guards that were within rounding of 0, if there are any."""
    if not trace.unresolved:
        return []
    found: dict[tuple[str, int], list[Unresolved]] = {}
    for doubt in trace.unresolved:
        found.setdefault((doubt.part, doubt.guard), []).append(doubt)
    spans = [doubt.span for doubt in trace.unresolved]
    late = " or ".join([f"{max(spans):.2g} s"] * bool(max(spans)) + ["a step of the simulation"] * (0 in spans))
    places = [
        f"{part} at hyperplane {guard + 1}, t = {doubts[0].t:.9g} s"
        + f" and {amount(len(doubts) - 1, 'more time')}" * (len(doubts) > 1)
        for (part, guard), doubts in found.items()
    ]
    said = f"within rounding of a hyperplane for up to {late}, on which side cannot be told"
    said += f"; a mode change may be missing there, or early or late by up to {late}"
    return ["; ".join([f"{said}, which changes the signals by no more than rounding", *places])]
