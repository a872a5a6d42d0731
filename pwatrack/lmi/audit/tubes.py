"""What is left of the errors of a loop that is sampled: tubes that depend on the time since a tick."""

from fractions import Fraction
from itertools import chain, pairwise
from typing import Any

from .balls import Ball, beyond, falls, less_square, sides, stacked, unit, unlike, zero
from .bounds import CHANNEL, SIGNALS, Loop
from .boxes import AuditedBox, squares
from .clocked import Knot, predicted, runs_of, shrinks
from .matrices import AuditFault, Matrix, added, definite, identity, inverted, product, times, transposed
from .reading import distinct, number, place
from .shape import NUMBER, PACKED, ROWS, WHOLE, of
from .ticks import AuditedErrors

TICKS = "noise", "eta", "load", "start"  # what acts at ticks
ACTS = [{"channel": CHANNEL, "size": NUMBER, "start?": [NUMBER]}]
TUBE = {"acts": ACTS, "Q": [PACKED], "T": ROWS, "signals": SIGNALS, "summed": WHOLE}
TUBES = [TUBE | of(NUMBER, "a b")]
SHAPE = {"sampled_bounds": TUBES}


def decided(loop: Loop, whole: Any) -> tuple[list[str], list[str]]:
    """Return what is wrong with the tubes, and what they claim."""
    found = whole["sampled_bounds"]
    if whole["sampled"] is None:
        raise AuditFault("there are bounds of a sampled loop, and none is proved")
    merged = [] if whole["practical"] is None else whole["practical"]["merged"]
    return left(found, Tubes(AuditedErrors(whole["sampled"], loop, predicted(whole)), merged), "")


def left(found: Any, tubes: "Tubes", of: str) -> tuple[list[str], list[str]]:
    """Return what is wrong with tubes, and what they claim, of some plants."""
    each = [[tuple(one["channel"]) for one in entry["acts"]] for entry in found]
    told = [(*channel, entry["summed"]) for entry, some in zip(found, each, strict=True) for channel in some]
    distinct(told, "a channel of the sampled loop")
    named = [(", ".join(f"{kind} {k}" for kind, k in some), entry) for entry, some in zip(found, each, strict=True)]
    faults = [f"the sampled loop{of}, {name}: {fault}" for name, entry in named for fault in tubes.faults(entry)]
    channels = {channel for some in each for channel in some if channel[0] != "start"}
    return faults, [f"the sampled loop{of}: what {len(channels)} disturbances, noises and inputs leave is proved"]


class Tubes:
    """-(Q_k+1 - Q_k) / step + F Q_e + Q_e F^T + a Q_e + U T_e U^T + Q_e V^T T_e^-1 V Q_e + g S^-1 g^T < 0, all boxes.

    q is V of what d is beside, g how d acts at a middle + Q_e V^T T_e^-1 q, S = a I - q^T T_e^-1 q > 0; and at ticks
    J Q_N J^T / (1 - b) + h h^T / b < Q_0. Of what is summed g g^T < Q_e at all corners in place of the term with g.
    Several channels may act together, all between ticks or all at them, with a column each, as large as it is told.
    """

    def __init__(self, errors: AuditedErrors, merged: Any) -> None:
        self.merged = [Ball([[number(v)] for v in one["direction"]]) for one in merged]
        self.errors, self.sizes = errors, (errors.n, errors.m, errors.N, len(errors.R[0]))

    def faults(self, entry: Any) -> list[str]:
        """Return what is wrong with one tube."""
        errors, a, b = self.errors, number(entry["a"]), number(entry["b"])
        runs = runs_of(errors, entry["Q"], entry["T"], "the tube of the sampled loop is not that of its knots")
        forms, summed = [knot[:2] for knot in chain(*runs)], entry["summed"] == 1
        acts = [(one["channel"], number(one["size"]), one.get("start")) for one in entry["acts"]]
        ticks = bool(acts) and acts[0][0][0] in TICKS
        if not acts or any((channel[0] in TICKS) != ticks or size <= 0 for channel, size, _ in acts):
            raise AuditFault("what acts together acts between ticks, or at them, in a size above 0")
        if a < 0 or not 0 <= b < 1 or bool(a) == ticks or bool(b) != ticks:
            raise AuditFault("a or b of a tube is out of range")
        if not summed and any(channel[0] == "swap" for channel, _, _ in acts):
            raise AuditFault("what u is off its time is summed")
        if entry["summed"] not in (0, 1):
            raise AuditFault("what is summed is 1 or 0")
        faults = [] if all(definite(Q) for Q, _ in forms) else ["Q is not positive definite"]
        each = [[X.times(size) for X in self.drive(channel, start)] for channel, size, start in acts]
        held, between, *kicks = (sides(*columns) for columns in zip(*each, strict=True))
        (last, powers), (first, others) = forms[-1], forms[0]
        for tick, kick in zip(errors.ticks, kicks, strict=True):
            inside = less_square(first, others, kick, 1 / b) if ticks and not summed else first
            if ticks and summed and not definite(less_square(first, others, kick)):
                faults.append("what is summed leaves its tube")
            if not shrinks(tick.T, (times(last, 1 / (1 - b)), powers), (inside, others)):
                faults.append("a tick leaves its tube")
        if not all(shrinks(errors.substep.T, before[-1][:2], after[0][:2]) for before, after in pairwise(runs)):
            faults.append("the end of a substep leaves its tube")
        flows = errors.flows if summed and not ticks else []
        seen = [AuditedBox(F, [D for D in edges if any(map(any, product(D, held.centre)))]) for F, edges in flows]
        pushing = unlike([F @ held + between for box in seen for F in box.corners])
        if not all(definite(less_square(*Q, g)) for _, g in pushing for Q in forms):
            faults.append("what is summed leaves its tube")
        for run in runs:
            for one, other in pairwise(run):
                fall = times(added(one[0], other[0], -1), (len(run) - 1) * errors.parts / errors.period)
                if not all(self.inside(knot, fall, a, summed, held, between) for knot in (one, other)):
                    faults.append("it is left between ticks")
        for kind, k, size in entry["signals"]:
            if any(beyond(self.row(kind, k), Q, number(size)) for Q, _ in forms):
                faults.append(f"{kind} {k} is not bounded by {size}")
        return faults

    def inside(self, knot: Knot, fall: Matrix, a: Fraction, summed: bool, held: Ball, between: Ball) -> bool:
        """Decide that a tube that falls by so much is not left, with Q and T as they are at a knot."""
        Q, powers, T = knot
        for box in self.errors.opened(len(T)):
            F, (U, V) = box.middle, box.factors
            VQ = product(V, Q) if T else []
            rest = added(fall, squares(U, VQ, [1 / t for t in T])) if T else fall
            open_: Matrix = []
            if a and not summed:
                g, S = F @ held + between, times(identity(len(held.centre[0]), 1), a)
                if T:
                    q = product(V, held.centre)
                    back = [[v / t for v in row] for row, t in zip(q, T, strict=True)]
                    g, S = g + Ball(product(transposed(VQ), back)), added(S, product(transposed(q), back), -1)
                    if not definite(S):
                        return False
                square, open_ = g @ Ball(inverted(S)) @ g.T
                rest, open_ = added(rest, square), times(open_, Fraction(1, 2))
            if not falls(F, Q, powers, rest, open_, rate=a / 2):
                return False
        return True

    def drive(self, channel: Any, start: Any) -> list[Ball]:
        """Return what 1 of a channel is beside z, adds to z', and to z at each tick that there may be."""
        (kind, k), (n, m, N, q) = channel, self.sizes
        if (kind == "start") != (start is not None):
            raise AuditFault("a start is told of what is none, or not of one")
        if kind == "start":
            if len(start) != self.errors.order:
                raise AuditFault("a start does not fit the sampled loop")
            z = Ball([[number(v)] for v in start])
            return [zero(len(start), 1), zero(len(start), 1), *(tick @ z for tick in self.errors.ticks)]
        counts = dict.fromkeys(("disturbance", "drawn"), n) | dict.fromkeys(("input", "cell"), m)
        counts |= {"deviation": len(self.merged), "noise": len(self.errors.plant.C[0]), "moved": q, "load": N - n}
        paces = len(self.errors.paces)
        counts |= {"nominal": paces * len(self.errors.followed), "eta": self.errors.p, "swap": m * (paces - 1)}
        counts |= {"predicted": self.errors.predicted * n * (paces - 1)}
        if kind not in counts:
            raise AuditFault("a channel of the sampled loop is unknown")
        place(k, counts[kind])
        errors, d, (e, nu, Delta, rho) = self.errors, self.errors.predicted, (zero(size, 1) for size in self.sizes)
        nothing, rest = zero(errors.order, 1), zero(errors.order - errors.held, 1)
        if kind == "noise":
            M, others = errors.M.column(k), (d - 1) * [Delta] + d * [rho]
            put_out = errors.put_out(e, Delta if errors.late else M, zero(errors.p, 1))
            return [nothing, nothing, *(stacked(e, nu, M, *others, more) for nu, more in put_out)]
        if kind == "eta":
            return [nothing, nothing, *[unit(errors.order, errors.order - errors.p + k)] * len(errors.ticks)]
        if kind == "load":
            if errors.estimates is not None:
                e = errors.estimates.hull[0][1].column(k)
            step = stacked(e, nu, *d * [unit(N, n + k)], *d * [rho], rest)
            return [nothing, nothing, *(tick @ step for tick in errors.ticks)]
        held, (e, own, moved) = self.between(kind, k)
        return [held, stacked(e, nu, *own, *moved, rest), *[nothing] * len(errors.ticks)]

    def between(self, kind: str, k: int) -> tuple[Ball, tuple[Ball, list[Ball], list[Ball]]]:
        """Return what 1 of a channel is beside z, and adds to e', and to all Delta' and rho', between ticks."""
        (n, m, N, q), errors, d = self.sizes, self.errors, self.errors.predicted
        nothing, below, p = zero(errors.order, 1), zero(N - n, 1), len(errors.followed)
        e, Delta, rho = zero(n, 1), zero(N, 1), zero(q, 1)
        if kind == "predicted":
            i, k = divmod(k, n)
            own, moved = [Delta] * d, [rho] * d
            own[i], moved[i] = unit(N, k), errors.R @ unit(n, k)
            return nothing, (e, own, moved)
        if kind in ("input", "cell", "swap"):
            if kind == "swap":
                B = errors.plant.B.column(k)
                Delta, rho = stacked(-B, below), -(errors.R @ B)
            return unit(errors.order, n + k), (e, [Delta] * d, [rho] * d)
        if kind == "moved":
            first = n + m + d * N
            held = stacked(zero(first, 1), *d * [unit(q, k)], zero(errors.order - errors.held, 1))
            return held, (e, [Delta] * d, [rho] * d)
        if kind == "nominal" and k < p:
            mean = errors.mean.column(errors.followed[k])
            return unit(errors.order, errors.followed[k]), (-mean, [Delta] * d, [-(errors.R @ mean)] * d)
        if kind == "deviation" and errors.watched and len(errors.paces) > 1:  # it would be in Delta, by 1 - pace
            raise AuditFault("what is merged acts otherwise where ticks come early and late")
        if kind == "nominal":
            e = errors.mean.column(errors.followed[k - p])
        else:
            e = self.merged[k] if kind == "deviation" else unit(n, k)
        if kind == "drawn" or (kind == "deviation" and errors.watched):
            return nothing, (e, [Delta] * d, [errors.R @ e] * d)
        return nothing, (e, [stacked(-e, below)] * d, [rho] * d)

    def row(self, kind: str, k: int) -> Ball:
        """Return the row that reads a signal off z."""
        n, m, N, _ = self.sizes
        tracked = self.errors.plant.tracked
        counts = {"output": len(tracked[0]), "state": n, "input": m, "estimate": N}
        if kind not in counts:
            raise AuditFault("a signal of the sampled loop is unknown")
        place(k, counts[kind])
        if kind == "output":
            return sides(tracked.row(k), zero(1, self.errors.order - n))
        return unit(self.errors.order, {"state": 0, "input": n, "estimate": n + m}[kind] + k).T
