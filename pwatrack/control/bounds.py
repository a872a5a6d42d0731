"""What a disturbance, the noise of a sensor or a start can do to each signal: bounds in the signal's own unit.

The loop is (e, Δ)' = M (e, Δ) + g d for e = x − x_d and Δ = x̂ − x, with M in the hull of the M_ij of pairs of cells.
An ellipsoid of it, or its peak gain where all cells have one matrix, bounds linear forms of (e, Δ). Bounds of all that
acts, and of all entries of a start, add up: it is proved in `docs/theory/beyond.md`, *Bounds, one signal at a time*.
Where there are too many pairs i, j the same is done in two steps, which gives larger bounds: Δ by itself, then e.

Where loads are estimated, Δ has the errors of their estimates below x̂ − x, A_j and C are those of plant and loads
together, and what drives e instead of B K is their coupling (see `compensation`), by which noise reaches e too.
"""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from typing import Literal

import numpy as np
from scipy.linalg import block_diag, eigh

from pwatrack.arrays import OVER_SUMS, Array, symmetric_part
from pwatrack.ball_matrix import BallMatrix, above, beside, zero
from pwatrack.control.compensation import coupling
from pwatrack.lmi.ellipsoid import Inner, InvariantEllipsoid, ellipsoid, from_start
from pwatrack.lmi.exact import Proof
from pwatrack.lmi.inequality import CONTROLLER, OBSERVER
from pwatrack.lmi.peak_gain import PeakGain, peak_gains
from pwatrack.lmi.polynomial import AnyProof
from pwatrack.model.pwa import PWASystem
from pwatrack.rational import floats, identity, near, solved

MOST_WORK = 700_000  # matrices · order⁴: what a Newton step may cost
_MUCH_WORK = 100_000  # from here on two values of a are tried, not three

Loop = Literal["joint", "controller", "observer"]
Acts = Literal[
    "disturbance",
    "noise",
    "start",
    "input",
    "deviation",
    "moved",
    "nominal",
    "drawn",
    "cell",
    "eta",
    "load",
    "predicted",
    "swap",
    "rounding",
]
Channel = tuple[Acts, int]
Form = tuple[Literal["output", "state", "measured", "input", "estimate", "coupling", "drive", "change"], int]


@dataclass(frozen=True, kw_only=True)
class SignalEllipsoid:
    """One ellipsoid: what d = 1 at most, or a start, can make of some signals of z' = M z + g d, M ∈ conv{M_p}."""

    # "joint": z = (e, Δ) with M_ij as above, for all pairs of cells i, j. "controller": z = e, A_i + B K.
    # "observer": z = Δ, A_j + L C.
    loop: Loop
    # where d enters. ("disturbance", k): g = (ε_k, −ε_k), of which a single loop has its half;
    # ("noise", k): (0, −L ε_k); ("input", k), for the controller's loop only: B ε_k; ("start", k): z(0) = ε_k of (e, Δ)
    # and no d; of a sinusoidal load all starts |v| ≤ 1 in its two entries, of which k is the first;
    # ("deviation", k): see `practical`.
    channel: Channel
    # the rows c. ("output", k): c e for the k-th tracked row; ("state", k): e; ("input", k): K (e + Δ), of which a
    # single loop has its half; ("estimate", k): Δ; ("coupling", k), for the observer's loop only: what of Δ drives e_k,
    # where loads are estimated.
    signals: tuple[Form, ...]
    ellipsoid: InvariantEllipsoid  # Q, a and the sizes, one for each signal

    def size(self, signal: Form) -> float:
        """Return the bound of one signal."""
        return self.ellipsoid.sizes[self.signals.index(signal)]


@dataclass(frozen=True, kw_only=True)
class Bounds:
    """What one channel can do to each signal, per sup |d|, or per 1 of an entry of the start."""

    # ("disturbance", k) for d added to the k-th entry of ẋ, ("noise", k) to the k-th measured output, ("start", k) for
    # the k-th entry of (x − x_d, x̂ − x, ŝ − s) at the start, s the states of loads
    channel: Channel
    # ("output", k): |y_k − y_dk| of what is tracked, for output tracking; ("state", k): |x_k − x_dk| for state
    # tracking, and of what has limits; ("measured", k): |y_k − y_dk| of a measured output that has some; ("input", k):
    # |u_k − u_ffk|; ("estimate", k): |x̂_k − x_k|. What could not be bounded is not there.
    sizes: dict[Form, float]
    # the ellipsoids that this is proved by: one of the joint loop; or the observer's, and those of the controller's
    # loop with this channel and all inputs, where a size is their sum
    parts: tuple[SignalEllipsoid, ...]
    # where all cells have one matrix, the peak gain of a disturbance or noise: a lower and an upper bound
    peaks: Mapping[Form, tuple[float, float]] = field(default_factory=dict)
    # peak gains, with their proofs, that stand for sizes where a loop has one matrix: they are less than what the
    # ellipsoid says. By the place in `parts` of the ellipsoid for the same loop, channel and signal.
    proved: Mapping[int, PeakGain] = field(default_factory=dict)

    @property
    def certified(self) -> dict[Form, float]:
        """What the ellipsoids alone prove: a peak gain may be smaller."""
        by_peak = {form: part.size(form) for part in self.parts for form in part.signals if form in self.peaks}
        return self.sizes | by_peak


Sized = tuple[dict[Form, float], tuple[SignalEllipsoid, ...]]  # of signals, and what proves it


class Loops:
    """The three loops, exact: their matrices, where d enters, the rows of the signals.

    X is of the `Compensation` of loads. `acting` are a disturbance of each state equation, then the noise of each
    measured output; `starts` the entries of (x − x_d, x̂ − x, ŝ − s) that are 1 together: each alone, but for a
    sinusoidal load. `limited` are further signals of x − x_d that are to be bounded, `deviations` columns E_k (n, 1) of
    what the plant may deviate by.
    """

    def __init__(
        self,
        plant: PWASystem,
        K: BallMatrix,
        L: BallMatrix,
        proofs: Sequence[AnyProof],
        X: BallMatrix,
        *,
        output: bool,
        limited: Sequence[Form] = (),
        deviations: Sequence[BallMatrix] = (),
    ) -> None:
        exact, seen, n, N = plant.exact, plant.observed, plant.exact.B.shape[0], L.shape[0]
        A, B, drive = [exact.A[i] for i in plant.hull], exact.B, coupling(plant, K, L, X)
        self.B, self.C, self.c, self.K, self.L = B, exact.C, exact.tracked, K, L
        self.n, self.N, self.coupling, self.deviations = n, N, drive, deviations
        self.seen = plant.watched is None  # whether deviations drive the observer's error too
        self.shifted = X @ L.part(range(n, N), range(L.shape[1]))  # by which noise reaches x_d
        self.M: dict[Loop, list[BallMatrix]] = {
            "controller": [A_i + B @ K for A_i in A],
            "observer": [seen.A[i] + L @ seen.C for i in plant.model.hull],
        }
        self.at_inputs = plant.load_inputs
        cells, watched = len(A), len(self.M["observer"])
        self.few_pairs = cells * watched * (n + N) ** 4 <= MOST_WORK
        self.few_cells = max(cells, watched) * N**4 <= MOST_WORK
        self.tracked: list[Form] = [("output", k) for k in range(exact.tracked.shape[0])] if output else []
        self.tracked += [] if output else [("state", k) for k in range(n)]
        self.tracked += [form for form in limited if form not in self.tracked]
        self.inputs: list[Form] = [("input", k) for k in range(K.shape[0])]
        rows = [drive.part([k], range(N)) for k in range(n)]
        acting: list[Form] = [("coupling", k) for k, row in enumerate(rows) if row.radius or any(row.centre.entries())]
        self.drivers = acting if plant.loads else self.inputs
        self.driven_as: Literal["disturbance", "input"] = "disturbance" if plant.loads else "input"
        loads = () if plant.loads is None else plant.loads.groups
        self.estimates: list[Form] = [("estimate", k) for k in (*range(n), *(n + group[0] for group in loads))]
        self.starts = [(k,) for k in range(2 * n)] + [tuple(2 * n + k for k in group) for group in loads]
        self.acting: list[Channel] = [("disturbance", k) for k in range(n)]
        self.acting += [("noise", k) for k in range(L.shape[1])]
        quadratic = [proof for proof in proofs if isinstance(proof, Proof)]  # where there is none, no ellipsoid is
        self.inners: dict[Loop, list[Inner]] = {
            "controller": [_inner(proof, invert=False) for proof in quadratic if proof.role is CONTROLLER],
            "observer": [_inner(proof, invert=True) for proof in quadratic if proof.role is OBSERVER],
        }
        if self.few_pairs:
            self.M["joint"] = [
                above(beside(Z, drive), beside(zero(N, n), Y)) for Z in self.M["controller"] for Y in self.M["observer"]
            ]
            self.inners["joint"] = _blocks(self.M, self.inners, drive.floats)

    def bounds(self, channel: Channel) -> Bounds:
        """Bound e and u by the joint loop, or in two steps; Δ by the observer's own loop.

        A start of e alone leaves Δ at 0: the controller's loop is all then.
        """
        if not self.few_cells:
            return Bounds(channel=channel, sizes={}, parts=())
        found: Sized = {}, ()
        if channel[0] == "start" and channel[1] < self.n:
            found = self.sizes("controller", channel, self.tracked + self.inputs)
        elif self.few_pairs:
            found = self.sizes("joint", channel, self.tracked + self.inputs)
        if not found[0]:
            found = self.in_two_steps(channel)
        estimates = self.sizes("observer", channel, self.estimates)
        certified, parts, peaks = found[0] | estimates[0], found[1] + estimates[1], self.peaks(channel)
        peaks = {form: gain for form, gain in peaks.items() if form in certified}
        sizes = {form: min(size, peaks.get(form, (0.0, np.inf))[1]) for form, size in certified.items()}
        return Bounds(channel=channel, sizes=sizes, parts=parts, peaks=peaks)

    def peaks(self, channel: Channel) -> dict[Form, tuple[float, float]]:
        """Return the peak gains of a disturbance or noise where there is one matrix, each between two bounds."""
        found = dict[Form, tuple[float, float]]()
        signals: dict[Loop, list[Form]] = {"joint": self.tracked + self.inputs, "observer": self.estimates}
        for loop, forms in signals.items():
            M, g = self.M.get(loop, []), self.drive(loop, channel)
            if len(M) == 1 and channel[0] != "start" and (g.radius is not None or any(g.centre.entries())):
                gains = peak_gains(M[0], g, above(*(self.row(loop, form) for form in forms)))
                found |= dict(zip(forms, gains or (), strict=gains is not None))
        return found

    def in_two_steps(self, channel: Channel) -> Sized:
        """Bound K Δ and what drives e, then e driven by d and by that: K (e + Δ) is at most K e and K Δ together."""
        seen, within = self.tracked + self.inputs, list(dict.fromkeys(self.inputs + self.drivers))
        feedback = self.sizes("observer", channel, within)
        steps = [(1.0, self.sizes("controller", channel, seen))]
        steps += [(feedback[0].get(signal, np.inf), self.driven[signal]) for signal in self.drivers]
        total = {signal: feedback[0].get(signal, 0.0) for signal in seen}
        for signal in seen:
            total[signal] += sum(drive * sizes.get(signal, np.inf) for drive, (sizes, _) in steps if drive)
        sizes = {signal: size * OVER_SUMS for signal, size in total.items() if np.isfinite(size)}
        proofs = (part for drive, (_, parts) in steps if drive for part in parts)
        return sizes, (*feedback[1], *proofs) if sizes else ()

    @cached_property
    def driven(self) -> dict[Form, Sized]:
        """What each driver can do to e and K e."""
        signals, kind = self.tracked + self.inputs, self.driven_as
        return {driver: self.sizes("controller", (kind, driver[1]), signals) for driver in self.drivers}

    def sizes(self, loop: Loop, channel: Channel, signals: list[Form], *, tries: int | None = None) -> Sized:
        """Return the bounds of signals and the ellipsoid they are from; nothing where none could be proved."""
        g = self.drive(loop, channel)
        if not signals or (g.radius is None and not any(g.centre.entries())):
            return dict.fromkeys(signals, 0.0), ()
        if not self.inners[loop]:
            return {}, ()
        rows = above(*(self.row(loop, signal) for signal in signals))
        if channel[0] == "start":
            found = from_start(self.M[loop], g, rows, self.inners[loop])
        else:
            tries = tries or (3 if len(self.M[loop]) * g.shape[0] ** 4 <= _MUCH_WORK else 2)
            found = ellipsoid(self.M[loop], g, rows, self.inners[loop], tries=tries)
        if found is None:
            return {}, ()
        part = SignalEllipsoid(loop=loop, channel=channel, signals=tuple(signals), ellipsoid=found)
        return dict(zip(signals, found.sizes, strict=True)), (part,)

    def drive(self, loop: Loop, channel: Channel) -> BallMatrix:
        """Return g, (N, 1); of a start G, with a column for each entry that is 1 together with others."""
        kind, k = channel
        nothing = zero(self.N, 1)
        if kind == "start":
            entries = next(group for group in self.starts if k == group[0])
            both = BallMatrix(identity(self.n + self.N)).part(range(self.n + self.N), entries)
            columns = range(len(entries))
            e, delta = (both.part(rows, columns) for rows in (range(self.n), range(self.n, self.n + self.N)))
        elif kind == "disturbance":
            unit = _column(BallMatrix(identity(self.N)), k)
            e, delta = unit.part(range(self.n), [0]), nothing - unit
        elif kind == "noise":
            e, delta = _column(self.shifted, k), nothing - _column(self.L, k)
        elif kind == "deviation":
            e = self.deviations[k]
            delta = nothing - above(e, zero(self.N - self.n, 1)) if self.seen else nothing
        else:
            e, delta = _column(self.B, k), nothing
        return of_loop(loop, e, delta)

    def row(self, loop: Loop, signal: Form) -> BallMatrix:
        """Return c, (1, N)."""
        kind, k = signal
        e, delta = zero(self.n, 1), zero(self.N, 1)
        if kind == "coupling":
            delta = _column(self.coupling.transpose(), k)
        elif kind == "estimate":
            delta = _column(BallMatrix(identity(self.N)), k)
        else:
            of = {"output": self.c, "measured": self.C, "input": self.K, "drive": self.K}
            e = _column(of.get(kind, BallMatrix(identity(self.n))).transpose(), k)
        if kind in ("input", "drive"):
            loads = zero(self.N - self.n, 1)
            if kind == "drive":  # less what estimates of loads at this input take off it
                loads = BallMatrix.of([[-int(j == k)] for j in self.at_inputs], (self.N - self.n, 1))
            delta = above(e, loads)
        return of_loop(loop, e, delta).transpose()


def state_rows(plant: PWASystem, forms: Iterable[Form]) -> Array:
    """Return the rows that read what is tracked, states and measured outputs off x, (q, n)."""
    of = {"output": plant.tracked, "measured": plant.C, "state": np.eye(len(plant.states))}
    return np.array([of[kind][k] for kind, k in forms])


def of_loop(loop: Loop, e: BallMatrix, delta: BallMatrix) -> BallMatrix:
    """Return what columns of e and of Δ are in the z of a loop."""
    return {"joint": above(e, delta), "controller": e, "observer": delta}[loop]


def _inner(proof: Proof, *, invert: bool) -> Inner:
    """Return the Q of a proof: (8) is stated for it, (9) for its inverse."""
    P = proof.P
    return Inner.proved(near(solved(P, identity(P.nrows()))) if invert else floats(P), proof.rate)


def _blocks(M: Mapping[Loop, list[BallMatrix]], inners: Mapping[Loop, list[Inner]], BK: Array) -> list[Inner]:
    """Return [κ Q_c, 0; 0, Q_o] for the first proofs and the last ones; by the Schur complement κ is large enough."""
    found = []
    for place in (0, -1) if inners["controller"] and inners["observer"] else ():
        c, o = inners["controller"][place], inners["observer"][place]
        most = min(c.most, o.most)
        with suppress(np.linalg.LinAlgError):
            V, W = np.linalg.cholesky(c.Q), np.linalg.cholesky(o.Q)
            slacks = [
                [-symmetric_part(np.linalg.solve(root, X.floats @ root)) - most * np.eye(len(root)) for X in matrices]
                for matrices, root in ((M["controller"], V), (M["observer"], W))
            ]
            X = np.linalg.solve(V, BK @ W)
            least = max(
                float(eigh(X @ np.linalg.solve(S_o, X.T), S_c, eigvals_only=True)[-1]) for S_c, S_o in product(*slacks)
            )
            found.append(Inner(Q=block_diag((2 * least + 1e-6) * c.Q, o.Q), most=most))
    return found


def _column(X: BallMatrix, k: int) -> BallMatrix:
    return X.part(range(X.shape[0]), [k])
