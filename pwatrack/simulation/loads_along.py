"""Loads of a run that are estimated, as the errors of a sampled loop count them.

A load that steps between two ticks counts as it was up to the next tick: till then its step acts as a disturbance, and
just before that tick the load has it. There σ = ŝ − s loses it, and e = x − x_d what x_d, which is that of the loads,
moves by: see `control.sampled_disturbances`. Where a load steps in a run, errors count from s = 0 on: then s(0) steps
before the first tick.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from math import ceil

import numpy as np
from scipy.linalg import expm

from pwatrack.arrays import Array
from pwatrack.control.controller import ProvedController
from pwatrack.control.sampled_disturbances import ROUNDING
from pwatrack.control.sampled_gains import SampledGains
from pwatrack.control.trajectory import DesiredTrajectory
from pwatrack.model.conditions import Conditions
from pwatrack.model.loads import Loads
from pwatrack.model.reference import Exosystem, StateResets, beside

_ON_TICK = 1e-9  # of a sample: a step that is nearer after a tick is on it but for rounding


def loads_at_start(controller: ProvedController, conditions: Conditions) -> Array:
    """Return s(0), (k,); 0 where the disturbance is not at all times the loads, or steps: then it counts from 0 on."""
    loads, disturbance = controller.plant.loads, conditions.disturbance
    if loads is None or disturbance is None or not loads.are(disturbance):
        return np.zeros(0 if loads is None else len(loads.S.floats))
    return _loads_of(loads, disturbance, disturbance.w0)


def steps_of(loads: Loads, disturbance: Exosystem) -> Iterator[tuple[float, Array, Array]]:
    """Yield when loads that a disturbance is made of step, by what, (k,), and to what; first by s(0), at t = 0."""
    S, s, last = loads.S.floats, np.zeros(len(loads.S.floats)), 0.0
    times = np.append(0.0, disturbance.breaks)
    for t, w in zip(times.tolist(), disturbance.states(times), strict=True):
        before, s, last = expm(S * (t - last)) @ s, _loads_of(loads, disturbance, w), t
        yield t, s - before, s


@dataclass(frozen=True, kw_only=True)
class LoadsAlong:
    """Loads s, s' = S s, and what they step by just before a tick."""

    S: Array  # in 1/s, (k, k)
    start: Array  # s from the first tick on, (k,)
    sample_time: float  # from tick to tick, in s
    # by the number of a tick, (k,) each; what errors are without at first is one at the first
    steps: Mapping[int, Array] = field(default_factory=dict)
    rest: Exosystem | None = None  # what of the disturbance acts beside them; None where nothing does

    @classmethod
    def of(cls, controller: ProvedController, conditions: Conditions, gains: SampledGains) -> "LoadsAlong":
        """Return the loads of a run with a program of such gains; none where the disturbance is not made of them."""
        loads, disturbance, h = controller.plant.loads, conditions.disturbance, gains.sample_time
        S = np.zeros((0, 0)) if loads is None else loads.S.floats
        none = cls(S=S, start=loads_at_start(controller, conditions), sample_time=h)
        if disturbance is None or loads is None or not loads.make(disturbance):
            return replace(none, rest=disturbance)
        if not disturbance.resets:
            return none
        found = list(steps_of(loads, disturbance))
        start, s = found[0][1], found[-1][2]
        steps = {0: start}
        for t, step, _ in found[1:]:
            tick = ceil((t + gains.jitter / 2) / h - _ON_TICK)  # by then it has stepped, if that is late or not
            steps[tick] = steps.get(tick, 0.0) + expm(S * (tick * h - t)) @ step
        sizes = np.max([np.abs(s), *(np.abs(step) for step in steps.values())], axis=0)
        whole = {tick: np.where(np.abs(step) > ROUNDING * sizes, step, 0.0) for tick, step in steps.items()}
        along = replace(none, start=start, steps={tick: step for tick, step in whole.items() if step.any()})
        seen = np.zeros((len(disturbance.Q), len(S)))
        seen[:, list(loads.where)] = loads.E.floats[:, loads.where]
        return replace(along, rest=replace(along.behind(disturbance), Q=np.hstack([disturbance.Q, -seen])))

    @property
    def none(self) -> "LoadsAlong":
        """None of them."""
        return replace(self, start=0 * self.start, steps={})

    @property
    def ticks(self) -> Iterator[Array]:
        """They from each tick on."""
        s, turn, tick = self.start, expm(self.S * self.sample_time), 0
        while True:
            yield s
            tick += 1
            s = turn @ s + self.steps.get(tick, 0.0)

    @property
    def _stepped(self) -> dict[int, Array]:
        """They at the first tick, and at those by which they have stepped."""
        ticks = zip(range(max(self.steps, default=0) + 1), self.ticks, strict=False)
        return {tick: s for tick, s in ticks if not tick or tick in self.steps}

    @property
    def ends(self) -> Array:
        """Between what each is, (k, 2): of an oscillating one its amplitude."""
        s = np.array([*self._stepped.values()])
        other = s @ (self.S != 0).T  # d' = ω a: of one that does not oscillate it is 0
        size = np.where(self.S.any(axis=1), np.hypot(s, other), np.nan)
        low, high = np.where(np.isnan(size), s, -size), np.where(np.isnan(size), s, size)
        return np.column_stack([low.min(axis=0), high.max(axis=0)])

    @property
    def largest(self) -> Array:
        """How large each gets, of loads that step and are constants in between, (k,); 0 of others."""
        return np.asarray(np.abs(self.ends).max(axis=1) * bool(self.steps) * ~self.S.any(axis=1))

    def behind(self, system: Exosystem) -> Exosystem:
        """Return an exosystem with them as the last entries of its w, on which no signal depends."""
        ticks, values = (np.array([*each])[1:] for each in (self._stepped, self._stepped.values()))
        steps = StateResets(t=ticks * self.sample_time, where=slice(0, len(self.S)), values=values)
        own = Exosystem(
            S=self.S,
            rates=-1j * np.abs(self.S).sum(axis=1),  # d' = ω a turns the other way
            Q=np.zeros((0, len(self.S))),
            w0=self.start,
            resets=(steps,) if len(steps.t) else (),
            period=None,
            end=None,
        )
        return replace(beside(system, own), period=None if self.S.any() else system.period)


def with_loads(controller: ProvedController, along: LoadsAlong) -> DesiredTrajectory:
    """Return the desired trajectory of true loads, which are the last entries of w."""
    trajectory, added = controller.trajectory, controller.compensation

    def wider(rows: Array, more: Array) -> Array:
        return np.concatenate([rows[..., :-1], more, rows[..., -1:]], axis=-1)

    X = np.broadcast_to(added.X.floats, (*trajectory.x_d.shape[:2], len(along.S)))
    return replace(
        trajectory,
        exosystem=along.behind(trajectory.exosystem),
        rate=wider(trajectory.rate, added.rate),
        x_d=wider(trajectory.x_d, X),
        u_ff=wider(trajectory.u_ff, added.u_ff),
        guards=wider(trajectory.guards, added.guards),
    )


def _loads_of(loads: Loads, disturbance: Exosystem, w: Array) -> Array:
    """Return s (k,) of a disturbance made of loads, which is at w."""
    s = np.zeros(len(loads.S.floats))
    rows = loads.truth(disturbance.Q, disturbance.rates)
    for load, row, group in zip(loads.each, rows, loads.groups, strict=True):
        s[group[0]] = row @ w
        if load.order == 2:
            s[group[1]] = row @ disturbance.S @ w / float(load.frequency)
    return s
