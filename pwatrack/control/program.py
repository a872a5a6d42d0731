"""The controller as a program that runs once in a sample time: its numbers. What it does: `docs/arithmetic.md`."""

from dataclasses import dataclass, field, replace
from math import ceil, factorial

import numpy as np
from scipy.linalg import expm
from scipy.sparse.csgraph import connected_components

from pwatrack.arrays import Array, IntArray
from pwatrack.control.compensation import beside_given
from pwatrack.control.controller import ProvedController
from pwatrack.control.realisable import input_trajectory, state_trajectory
from pwatrack.control.trajectory import DesiredTrajectory, output_trajectory
from pwatrack.errors import InvalidSpec, OutsideTheory, ProblemPart
from pwatrack.model.conditions import Conditions, Sampling
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import Exosystem

PACE = "speed", "acceleration", "jerk", "snap", "crackle"  # what of y_d has limits where it is made of set-points
RENEWED = 1, 2**10, 2**20  # samples after which w and its two copies are stepped on
_LONGEST_WINDOW = 500  # samples: each is remembered, and looked at in each step
_ON_TICK = 1e-9  # of a sample time: what is nearer to a tick is on it but for rounding
_LARGEST = 1e100  # of an entry of a map that a machine may use


@dataclass(frozen=True, kw_only=True)
class Piece:
    """From a tick on some neighbouring entries of w go on from other values."""

    tick: int  # which one
    start: int  # the first of the entries
    w: Array  # their values at that tick


@dataclass(frozen=True, kw_only=True)
class Follows:
    """A reference that the program makes itself."""

    turn: Array  # w one sample later, 2¹⁰ and 2²⁰ samples later, as far as these are in range, (1 … 3, s, s)
    w0: Array  # w at the first tick, (s,)
    pieces: tuple[Piece, ...]  # in order of time
    end: int | None  # the last tick at which it is defined, or None
    early: Array  # w at the ticks before the first that it is for, where inputs are for later ones, (ahead, s)


@dataclass(frozen=True, kw_only=True)
class SampledController:
    """Observer, generator and law of a controller, sampled.

    Rows on v = (y, u, x̂, ŝ, η̂, w) and a last entry for the constant 1; columns that are always 0 are left out. Where
    it corrects, η̂ and w are those of the time at which u acts.
    """

    sampling: Sampling  # sample time, how observer and generator step, how late u is
    substeps: int  # in how many steps a prediction is made, each in the cell in which it begins; 1 where none is
    H: Array  # of the cells of x̂, (K, n)
    h: Array  # likewise, (K,)
    signs: IntArray  # (l, K)
    # of the cells of x_d, which are fewer where cells are merged: rows on (ŝ, η̂, w, 1)
    guards: Array  # that are 0 where one ends, (k, C)
    sides: IntArray  # on which side of these each is, (d, k)
    # x̂ and ŝ one sample later, in the cell of x̂, on (y, u, x̂, ŝ, 1), (l, N, q + m + N + 1). Where it corrects:
    # predicted, one substep later, on (u, x̂, ŝ, 1), (l, N, m + N + 1)
    observer: Array
    C: Array  # what would be measured, on (x̂, ŝ), (q, N)
    M: Array  # what a difference of that to y corrects of (x̂, ŝ), (N, q); (0, q) where nothing is corrected
    E: Array  # what x̂ and ŝ are moved by for what limits cut off an input, (N, m); (0, m) where they are not
    generator: Array  # η̂ one sample later, in the cell of x_d, on (ŝ, η̂, w, 1), (d, p, C)
    x_d: Array  # x_d in its cell, on the same, (d, n, C)
    u_ff: Array  # u_ff in the cell of x_d, on the same, (d, m, C)
    K: Array  # (m, n)
    limits: Array  # lower and upper limit of each input, (m, 2); infinite for none
    change: Array  # by how much each may change from one sample to the next, (m,); likewise
    quantum: Array  # steps of each input, (m,); 0 for none
    follows: Follows | None  # where w comes from; None if it is given at each tick
    reference: tuple[str, ...] = ()  # names of the entries of w, where it is given
    # of each output whose set-points are given, and not w: where it starts, and the limits of its speed, acceleration,
    # jerk and what is beyond, up to the relative degree, (outputs, 4 … 6); (0, 4) where w is given
    pace: Array = field(default_factory=lambda: np.zeros((0, 4)))
    # what each set-point may be, (outputs, 2): one beyond counts as its end; infinite for any
    set_range: Array = field(default_factory=lambda: np.zeros((0, 2)))

    @property
    def windows(self) -> IntArray:
        """Over how many samples each derivative of `pace` beyond the jerk is a mean, (outputs, 0 … 2).

        A derivative within ± a limit differs over a window by twice that at most, and its mean has this divided by the
        window as its derivative.
        """
        lengths = 2 * self.pace[:, 3:-1] / self.pace[:, 4:] / self.sampling.sample_time
        return np.asarray(np.maximum(np.ceil(lengths), 1), dtype=np.int64)

    @property
    def given(self) -> tuple[str, ...]:
        """Names of what is given at each tick: w, or the set-points that it is made of."""
        return self.reference[: len(self.pace) or None]

    @property
    def sizes(self) -> dict[str, int]:
        """Lengths of y, u, x, (x̂, ŝ), η̂ and w."""
        (m, n), (q, N), (_, p, columns) = self.K.shape, self.C.shape, self.generator.shape
        return {"q": q, "m": m, "n": n, "N": N, "p": p, "s": columns - (N - n) - p - 1}

    @property
    def places(self) -> dict[str, slice]:
        """Where each of its numbers is in its memory, and behind that what it works with.

        That is: guards, the last w; what limits cut off; what is predicted, in a substep from (u, x̂, ŝ), and by how
        much y is missed; the way to a set-point, and how long it is bent and how.
        """
        of, late = self.sizes, self.sampling.delay
        lengths = {"y": of["q"], "u": of["m"], "x_hat": of["n"], "s_hat": of["N"] - of["n"], "eta_hat": of["p"]}
        lengths |= {"w": of["s"], "copies": 2 * of["s"], "course": 4 * len(self.pace)}
        lengths |= {"past": int((self.windows * np.arange(4, 4 + self.windows.shape[1])).sum()), "late": late * of["m"]}
        lengths |= {"late_cut": late * of["m"] if len(self.E) else 0}
        lengths |= dict.fromkeys(("before", "wanted", "change"), of["m"]) | {"x_d": of["n"]}
        lengths |= {"g": max(len(self.h), len(self.guards)), "source": of["s"]}
        predicted = of["N"] if self.sampling.corrects else 0
        lengths |= {"cut": of["m"] if len(self.E) else 0}
        lengths |= {"seen": predicted and of["m"] + predicted, "moved": predicted, "missed": predicted and of["q"]}
        lengths |= dict.fromkeys(("going", "lasting", "bending"), 3 * bool(len(self.pace)))
        lengths |= {"made": of["s"] // len(self.pace) if len(self.pace) else 0}
        edges = np.cumsum([0, *lengths.values()]).tolist()
        return dict(zip(lengths, map(slice, edges[:-1], edges[1:]), strict=True))


@np.errstate(all="ignore")  # what is out of range is refused
def program(controller: ProvedController, conditions: Conditions, *, given: bool = False) -> SampledController:
    """Return the program of a controller that is sampled, within `conditions`: limits, rates and steps of inputs too.

    Where w is `given` at each tick it is y_d and its derivatives up to the relative degree, between ticks a Taylor
    polynomial; or x_d and its derivative; or, where x_d is the response to u_ff, that. With limits of set-points in
    `conditions`, the program makes w of these.

    Example: the paper's example, 500 times a second.

        >>> from pwatrack import design, load_spec
        >>> controller = design(load_spec("specs/two_mass_paper_gains.yaml"))
        >>> found = program(controller, Conditions(sampling=Sampling(sample_time=0.002)))
        >>> found.sizes
        {'q': 1, 'm': 1, 'n': 4, 'N': 4, 'p': 2, 's': 2}
        >>> program(controller, Conditions(sampling=Sampling(sample_time=0.002)), given=True).reference
        ('y', 'dy/dt', 'd2y/dt2')
    """
    sampling, plant = conditions.sampling, controller.plant
    assert sampling is not None
    trajectory, names = _given_trajectory(controller) if given else (controller.trajectory, ())
    m, partition, h = plant.B.shape[1], plant.model.partition, sampling.sample_time
    s_hat = len(controller.design.L) - len(plant.B)
    own = controller.compensation
    added = beside_given(plant, own.X) if given and controller.trajectory.preview else own
    each = flows(controller, trajectory)
    u_ff, late = on_estimates(trajectory.u_ff, added.u_ff), _ahead(controller, sampling, each.shape[1])
    if sampling.corrects:
        gains = controller.sampled_gains(sampling)
        K, M, E, substeps = gains.K, gains.M, gains.E.reshape(-1, m), gains.substeps
        observer = _observer(plant, M[:, :0], replace(sampling, sample_time=h / substeps))
        u_ff = u_ff @ means(each, h)
    else:
        K, M, E, substeps = controller.K, np.zeros((0, len(plant.C))), np.zeros((0, m)), 1
        observer = _observer(plant, controller.L, sampling)
    return _checked(
        SampledController(
            sampling=sampling,
            substeps=substeps,
            H=partition.H,
            h=partition.h,
            signs=partition.signs,
            observer=observer,
            C=plant.observed.C.floats,
            M=M,
            E=E,
            generator=np.array([_step(F_j, sampling)[s_hat : s_hat + trajectory.rate.shape[1]] for F_j in each]) @ late,
            guards=on_estimates(trajectory.guards, added.guards) @ late,
            sides=trajectory.signs,
            x_d=on_estimates(trajectory.x_d, added.X.floats) @ late,
            u_ff=u_ff @ late,
            K=K,
            limits=np.tile([-np.inf, np.inf], (m, 1)) if conditions.limits is None else conditions.limits,
            change=np.full(m, np.inf) if conditions.rates is None else conditions.rates * h,
            quantum=np.zeros(m) if conditions.quanta is None else conditions.quanta.inputs,
            follows=None if given else _follows(trajectory.exosystem, sampling),
            reference=names,
            pace=_pace(controller, conditions) if given else np.zeros((0, 4)),
            set_range=np.zeros((0, 2)) if conditions.set_range is None or not given else conditions.set_range,
        )
    )


def _step(F: Array, sampling: Sampling) -> Array:
    """Return the map of one sample time under ż = F z."""
    F = F * sampling.sample_time
    return np.asarray(np.eye(len(F)) + F if sampling.method == "euler" else expm(F))


def _observer(plant: PWASystem, L: Array, sampling: Sampling) -> Array:
    """Return the rows of x̂ and ŝ one step later, on (y, u, x̂, ŝ, 1): (18) with held y and u, and with the loads.

    Where nothing is measured on the way, L is (N, 0).
    """
    (n, m), (N, q) = plant.B.shape, L.shape
    F = np.zeros((len(plant.observed.A), q + m + N + 1, q + m + N + 1))
    rows = slice(q + m, q + m + N)
    F[:, rows, :q] = -L
    F[:, q + m : q + m + n, q : q + m] = plant.B
    F[:, rows, rows] = [A.floats + L @ plant.observed.C.floats[:q] for A in plant.observed.A]
    F[:, q + m : q + m + n, -1] = plant.model.b
    return np.array([_step(F_i, sampling)[rows] for F_i in F])


def flows(controller: ProvedController, trajectory: DesiredTrajectory) -> Array:
    """Return F of (ŝ, η̂, w, 1)' = F (ŝ, η̂, w, 1) in each cell of x_d: (15), while its reference and the loads go on."""
    loads, S, rate = controller.plant.loads, trajectory.exosystem.S, trajectory.rate
    cells, p, size = rate.shape
    k = 0 if loads is None else len(loads.S.floats)
    F = np.zeros((cells, k + size, k + size))
    if p:
        F[:, k : k + p] = on_estimates(rate, controller.compensation.rate)
    F[:, k + p : k + size - 1, k + p : k + size - 1] = S
    if loads is not None:
        F[:, :k, :k] = loads.S.floats
    return F


def means(flows: Array, h: float) -> Array:
    """Return the means of e^(F t) over the sample in which an input is held."""
    N = flows.shape[1]
    zero = np.zeros((N, N))
    return np.array([expm(np.block([[F * h, np.eye(N)], [zero, zero]]))[:N, N:] for F in flows])


def _ahead(controller: ProvedController, sampling: Sampling, size: int) -> Array:
    """Return what turns (ŝ, η̂, w, 1) into that with the ŝ of the time at which u acts: loads go on by themselves."""
    found, loads = np.eye(size), controller.plant.loads
    if loads is not None and sampling.ahead:
        S = loads.S.floats
        found[: len(S), : len(S)] = expm(S * (sampling.ahead * sampling.sample_time))
    return found


def on_estimates(rows: Array, added: Array) -> Array:
    """Return rows on (ŝ, η̂, w, 1) of rows on (η̂, w, 1) and what estimates of loads add, in each cell or in all."""
    return np.concatenate([np.broadcast_to(added, (*rows.shape[:-1], added.shape[-1])), rows], axis=-1)


def _follows(exosystem: Exosystem, sampling: Sampling) -> Follows:
    """Return the exosystem in samples: where a signal has a new piece, its values at the next tick.

    The first tick is that at which the first input acts.
    """
    S, h, found = exosystem.S, sampling.sample_time, []
    for resets in exosystem.resets:
        for t, w in zip(resets.t.tolist(), resets.values, strict=True):
            tick, where = ceil(t / h - _ON_TICK), resets.where
            found.append(Piece(tick=tick, start=where.start, w=turned(S[where, where] * max(tick * h - t, 0.0)) @ w))
    latest = {(piece.tick, piece.start): piece for piece in found}
    w, before = exosystem.w0, list[Array]()
    for tick in range(sampling.ahead + 1):
        begun = [key for key in sorted(latest) if key[0] == tick]
        w = np.array(w if tick == 0 else turned(S * h) @ w)
        for piece in map(latest.pop, begun) if sampling.ahead else ():
            w[piece.start : piece.start + len(piece.w)] = piece.w
        before.append(w)
    pieces = tuple(replace(latest[key], tick=key[0] - sampling.ahead) for key in sorted(latest))
    turn = list[Array]()
    with np.errstate(all="ignore"):
        for count in RENEWED:
            after = turned(S * (count * h))
            if turn and not np.abs(after).max(initial=0.0) < _LARGEST:
                break  # what grows has an end
            turn.append(after)
    end = None if exosystem.end is None else max(int(exosystem.end / h * (1 + 1e-12)) - sampling.ahead, 0)
    early = np.array(before[:-1]).reshape(sampling.ahead, len(S))
    return Follows(turn=np.array(turn), w0=before[-1], pieces=pieces, end=end, early=early)


def turned(S: Array) -> Array:
    """Return e^S of an exosystem, signal by signal: of a polynomial by its series, which ends and loses no digit.

    Example:
        >>> turned(np.diag([1e6, 1e6], 1))[0].tolist()
        [1.0, 1000000.0, 500000000000.0]
    """
    found, (_, signals) = np.zeros_like(S), connected_components(S != 0, directed=False)
    for signal in range(signals.max(initial=-1) + 1):
        at = np.ix_(*2 * [np.flatnonzero(signals == signal)])
        powers = [np.linalg.matrix_power(S[at], k) for k in range(len(S[at]) + 1)]
        ends = not powers.pop().any()
        found[at] = sum(power / factorial(k) for k, power in enumerate(powers)) if ends else expm(S[at])
    return found


def _given_trajectory(controller: ProvedController) -> tuple[DesiredTrajectory, tuple[str, ...]]:
    """Return the desired trajectory for a reference from outside, and the names of its entries."""
    plant, generator = controller.plant, controller.generator
    n, m = plant.B.shape
    if generator is not None and not generator.played_back:
        degree, outputs = max(generator.form.degrees), plant.tracked_names
        powers = ["", *map(str, range(2, degree + 1))]
        names = [*outputs, *(f"d{k}{y}/dt{k}" for k in powers[:degree] for y in outputs)]
        return output_trajectory(generator, _chains(len(outputs), degree + 1)), tuple(names)
    if controller.trajectory.names:
        return input_trajectory(plant, _chains(m, 1), None), tuple(f"{u}_ff" for u in plant.inputs)
    names = [f"{x}_d" for x in plant.states]
    return state_trajectory(plant, _chains(n, 2)), (*names, *(f"d{name}/dt" for name in names))


def _pace(controller: ProvedController, conditions: Conditions) -> Array:
    """Return where each output starts, and its limits; they are refused where w is no y_d, or has more derivatives."""
    if conditions.pace is None:
        return np.zeros((0, 4))
    generator, system, subject = controller.generator, controller.trajectory.exosystem, (ProblemPart.SET_POINTS,)
    if generator is None or generator.played_back:
        text = "set-points at run time need a trajectory generator that runs: output tracking without preview"
        raise OutsideTheory(text, subject=subject)
    if (degree := max(generator.form.degrees)) > len(PACE):
        text = f"the relative degree is {degree}, and what is made of set-points has {len(PACE)} derivatives"
        raise OutsideTheory(text, subject=subject)
    if (needed := max(degree, 3)) != conditions.pace.shape[1]:
        names = ", ".join(PACE[:needed])
        raise InvalidSpec(f"limits of {names} are needed, for a relative degree of {degree}", subject=subject)
    start = system.derivative_rows(0)[0] @ system.w0
    if conditions.set_range is not None:
        for name, at, (low, high) in zip(controller.plant.tracked_names, start, conditions.set_range, strict=True):
            if not low <= at <= high:
                text = f"{name} starts at {at:.6g}, where its reference does, and its range is {low:g} to {high:g}"
                raise InvalidSpec(text, subject=subject)
    return np.hstack([start[:, None], conditions.pace])


def _checked(found: SampledController) -> SampledController:
    """Refuse limits so low that means are over too many samples, and samples so long that tables are out of range."""
    longest, h = found.windows.max(axis=0, initial=0), found.sampling.sample_time
    for beyond in np.flatnonzero(longest > _LONGEST_WINDOW).tolist():
        name, least = PACE[3 + beyond], 2 * found.pace[:, 3 + beyond].max() / h
        message = f"the limit of {name} is so low that it takes means over {longest[beyond]:,} samples"
        hint = f"at most {_LONGEST_WINDOW:,}: at least {least / _LONGEST_WINDOW:.3g}, or a lower limit before it"
        raise InvalidSpec(message, subject=(ProblemPart.SET_POINTS,), hint=hint)
    if not all(np.isfinite(table).all() for table in (found.observer, found.generator, found.u_ff, found.K, found.M)):
        message = f"{h:g} s are too long a sample: what a cell does in it is out of range"
        raise InvalidSpec(message, subject=(ProblemPart.SAMPLE_TIME,), hint="a shorter sample time")
    return found


def _chains(signals: int, length: int) -> Exosystem:
    """Return an exosystem whose w are some signals, then their first derivatives, and so on; the last are constant."""
    size = signals * length
    return Exosystem(
        S=np.eye(size, k=signals),
        rates=np.zeros(size, dtype=np.complex128),
        Q=np.eye(signals, size),
        w0=np.zeros(size),
        resets=(),
        period=None,
        end=None,
    )
