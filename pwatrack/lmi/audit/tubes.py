"""What is left of the errors of a loop that is sampled: tubes that depend on the time since a tick."""

from fractions import Fraction
from functools import reduce
from itertools import pairwise
from typing import Any

from .balls import Ball, enlarge, falls, stacked, unlike
from .bounds import CHANNEL, SIGNALS, Loop
from .clocked import Form, predicted, shrinks
from .matrices import AuditFault, Matrix, added, definite, identity
from .reading import distinct, number, packed, place
from .shape import NUMBER, PACKED, WHOLE, of
from .ticks import AuditedErrors

KEY = "sampled_bounds"
SHAPE = [{"channel": CHANNEL, "Q": [PACKED], "signals": SIGNALS, "summed": WHOLE} | of(NUMBER, "a b")]


def decided(found: Any, loop: Loop, whole: Any) -> tuple[list[str], list[str]]:
    """Return what is wrong with the tubes, and what they claim."""
    if not found:
        return [], []
    if whole["sampled"] is None:
        raise AuditFault("there are bounds of a sampled loop, and none is proved")
    merged = [] if whole["practical"] is None else whole["practical"]["merged"]
    return left(found, Tubes(AuditedErrors(whole["sampled"], loop, predicted(whole)), whole["sampled"], merged), "")


def left(found: Any, tubes: "Tubes", of: str) -> tuple[list[str], list[str]]:
    """Return what is wrong with tubes, and what they claim, of some plants."""
    distinct([(*entry["channel"], entry["summed"]) for entry in found], "a channel of the sampled loop")
    faults = [f"the sampled loop{of}, {entry['channel']}: {fault}" for entry in found for fault in tubes.faults(entry)]
    channels = {tuple(entry["channel"]) for entry in found}
    return faults, [f"the sampled loop{of}: what {len(channels)} disturbances, noises and inputs leave is proved"]


class Tubes:
    """-(Q_k+1 - Q_k) / step + F Q_e + Q_e F^T + a Q_e + g g^T / a < 0, J Q_N J^T / (1 - b) + h h^T / b < Q_0.

    Of what is summed g g^T < Q_e in place of the term with g.
    """

    def __init__(self, errors: AuditedErrors, sampled: Any, merged: Any) -> None:
        self.merged = [[number(v) for v in one["direction"]] for one in merged]
        self.errors = errors
        self.parts, self.period = sampled["substeps"] if errors.changes else 1, number(sampled["sample_time"])
        self.sizes = errors.n, errors.m, errors.N, len(errors.R[0])

    def faults(self, entry: Any) -> list[str]:
        """Return what is wrong with one tube."""
        errors, a, b = self.errors, number(entry["a"]), number(entry["b"])
        forms, ticks = [packed(Q) for Q in entry["Q"]], entry["channel"][0] == "noise"
        knots, rest = divmod(len(forms), self.parts)
        if rest or knots < 2 or any(len(Q) != errors.order for Q, _ in forms):
            raise AuditFault("the tube of the sampled loop is not that of its knots")
        summed = entry["summed"] == 1
        if a < 0 or not 0 <= b < 1 or not (b if ticks else a):
            raise AuditFault("a or b of a tube is out of range")
        if entry["summed"] not in (0, 1) or (summed and ticks):
            raise AuditFault("only what acts between ticks is summed")
        faults = [] if all(definite(Q) for Q, _ in forms) else ["Q is not positive definite"]
        held, between, kicks = self.drive(entry["channel"])
        runs = [forms[j : j + knots] for j in range(0, len(forms), knots)]
        (last, powers), (first, others) = runs[-1][-1], runs[0][0]
        kept: Form = ([[v / (1 - b) for v in row] for row in last], powers)
        for tick, kick in zip(errors.ticks, kicks, strict=True):
            inside = less_square(first, kick, b, others) if ticks else first
            if not shrinks(tick.T, kept, (inside, others)):
                faults.append("a tick leaves its tube")
        if not all(shrinks(errors.substep.T, before[-1], after[0]) for before, after in pairwise(runs)):
            faults.append("the end of a substep leaves its tube")
        flows = [(F, F @ held + between) for F in errors.flows]
        if summed and not all(holds(Q, g) for _, g in unlike([g for _, g in flows]) for Q in forms):
            faults.append("what is summed leaves its tube")
        if not all(self.inside(run, flows, a, summed) for run in runs):
            faults.append("it is left between ticks")
        for kind, k, size in entry["signals"]:
            c = self.row(kind, k)
            values = (c @ Ball(Q) @ c.T for Q, _ in forms)
            if number(size) < 0 or any(v[0][0] + (R[0][0] if R else 0) > number(size) ** 2 for v, R in values):
                faults.append(f"{kind} {k} is not bounded by {size}")
        return faults

    def inside(self, run: list[Form], flows: list[tuple[Ball, Ball]], a: Fraction, summed: bool) -> bool:
        """Decide that a tube is not left in a substep."""
        n, rate = self.errors.order, (len(run) - 1) * self.parts / self.period
        for one, other in pairwise(run):
            fall = [[-v * rate for v in row] for row in added(other[0], one[0], -1)]
            for F, g in flows:
                square, open_ = ([[v / a for v in row] for row in X] for X in g @ g.T) if a and not summed else ([], [])
                turned = Ball(added(F.centre, identity(n, a / 2)), F.radius)
                rest, half = added(fall, square) if square else fall, [[v / 2 for v in row] for row in open_]
                if not all(falls(turned, *Q, rest, half) for Q in (one, other)):
                    return False
        return True

    def drive(self, channel: Any) -> tuple[Ball, Ball, list[Ball]]:
        """Return what 1 of a channel is beside z, adds to z', and to z at a tick, for each that there may be."""
        (kind, k), (n, m, _, q) = channel, self.sizes
        counts = {
            "disturbance": n,
            "deviation": len(self.merged),
            "noise": len(self.errors.plant.C[0]),
            "input": m,
            "moved": q,
            "nominal": len(self.errors.followed),
        }
        if kind not in counts:
            raise AuditFault("a channel of the sampled loop is unknown")
        place(k, counts[kind])
        d, (e, nu, Delta, rho) = self.errors.predicted, ([Fraction(0)] * size for size in self.sizes)
        rest = [Fraction(0)] * (self.errors.order - self.errors.held)
        nothing = column([e, nu, *d * [Delta], *d * [rho], rest])
        none = [nothing] * len(self.errors.ticks)
        if kind == "noise":
            M, blank = self.errors.M.column(k), column([Delta])
            delta = column([[Fraction(0)] * p]) if (p := self.errors.widths[-1] if rest else 0) else None
            put_out = self.errors.put_out(column([e]), blank if self.errors.late else M, delta)
            others = column([*(d - 1) * [Delta], *d * [rho]])
            below = [others] if others.centre else []
            kicks = [reduce(stacked, [column([e]), nu, M, *below, *more]) for nu, more in put_out]
            return nothing, nothing, kicks
        if kind == "nominal":
            at = self.errors.followed[k]
            mean = self.errors.mean.column(at)
            e[at] = Fraction(1)
            nominal = [
                mean,
                column([nu, *d * [Delta]]),
                *d * [self.errors.R @ mean],
                *([column([rest])] if rest else []),
            ]
            return column([e, nu, *d * [Delta], *d * [rho], rest]), -reduce(stacked, nominal), none
        if kind == "deviation":
            e = self.merged[k]
            if self.errors.watched and len(self.errors.paces) > 1:  # it would be in Delta, by 1 - pace
                raise AuditFault("what is merged acts otherwise where ticks come early and late")
            if self.errors.watched:
                rho = [v for (v,) in (self.errors.R @ column([e])).centre] if q else rho
            else:
                Delta = [*(-v for v in e), *Delta[n:]]
        elif kind == "disturbance":
            e[k], Delta[k] = Fraction(1), Fraction(-1)
        else:
            (nu if kind == "input" else rho)[k] = Fraction(1)
        one = column([e, nu, *d * [Delta], *d * [rho], rest])
        return (one, nothing, none) if kind in ("input", "moved") else (nothing, one, none)

    def row(self, kind: str, k: int) -> Ball:
        """Return the row that reads a signal off z."""
        n, m, N, _ = self.sizes
        tracked = self.errors.plant.tracked
        counts = {"output": len(tracked[0]), "state": n, "input": m, "estimate": N}
        if kind not in counts:
            raise AuditFault("a signal of the sampled loop is unknown")
        place(k, counts[kind])
        if kind == "output":
            row = tracked.row(k)
            return stacked(row.T, column([[Fraction(0)] * (self.errors.order - n)])).T
        at = {"state": 0, "input": n, "estimate": n + m}[kind] + k
        return Ball([[Fraction(int(j == at)) for j in range(self.errors.order)]])


def holds(form: Form, g: Ball) -> bool:
    """Decide g g^T < Q for all g in a ball."""
    (Q, powers), (square, open_) = form, g @ g.T
    left = added(square, Q, -1)
    enlarge(left, [[v / 2 for v in row] for row in open_], powers)
    return definite(left, sign=-1)


def less_square(first: Matrix, kick: Ball, b: Fraction, powers: list[Fraction]) -> Matrix:
    """Return Q - h h^T / b, or what is below it for all h in a ball."""
    square, open_ = kick @ kick.T
    left = added(square, first, -b)
    enlarge(left, [[v / 2 for v in row] for row in open_], powers)
    return [[-v / b for v in row] for row in left]


def column(parts: list[list[Fraction]]) -> Ball:
    """Return entries below each other."""
    return Ball([[v] for part in parts for v in part])
