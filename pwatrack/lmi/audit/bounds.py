"""What disturbances, noises and starts can do to each signal: ellipsoids that the errors do not leave."""

from fractions import Fraction
from functools import cached_property
from typing import Any

from .balls import Ball, beyond, falls, sides, squared, stacked, unit, unlike, zero
from .matrices import AuditFault, Matrix, added, definite, identity
from .peak_gain import peak_bound
from .plant import AuditedPlant
from .reading import distinct, number, packed, place
from .shape import NUMBER, PACKED, TEXT, WHOLE, of

CHANNEL, SIGNALS = [TEXT, WHOLE], [[TEXT, WHOLE, NUMBER]]
PART = {"loop": TEXT, "channel": CHANNEL, "a": NUMBER, "Q": PACKED, "signals": SIGNALS}
PEAK = of(WHOLE, "part unit") | {"steps": [[WHOLE, WHOLE]], "P": PACKED, "size": NUMBER}
BOUNDS = [{"channel": CHANNEL, "signals": SIGNALS, "parts": [PART], "peaks?": [PEAK]}]
SHAPE = {"bounds": BOUNDS}
ACTS = ("disturbance", "noise", "start")  # what bounds are of, in this order


def decided(loop: "Loop", whole: Any) -> tuple[list[str], list[str]]:
    """Return what is wrong with all bounds, and what they claim."""
    found = whole["bounds"]
    faults = [f"bound of {entry['channel']}: {fault}" for entry in found for fault in loop.faults(entry)]
    channels = [(ACTS.index(of), k) for of, k in (entry["channel"] for entry in found)]
    if channels != sorted(set(channels)):
        faults.append("the bounds are not in order, or one is there twice")
    return faults, [f"the bounds of {len(found)} disturbances, noises and starts are proved"]


def leaving(matrices: list[Ball], g: Ball, part: Any, *, start: bool) -> list[str]:
    """Return whether z from 0 on, driven by at most 1 along g, or from g on, can leave an ellipsoid."""
    (Q, powers), rate = packed(part["Q"]), number(part["a"])
    if not definite(Q) or rate <= 0:
        raise AuditFault("Q or a is not positive")
    outside = start and not definite(added(Q, squared(g)[0], -1))
    push = () if start else squared(g, 1 / rate)
    left = ["an ellipsoid can be left" for X in matrices if not falls(X, Q, powers, *push, rate=rate / 2)]
    return ["the start is not in the ellipsoid"] * outside + left


class Loop:
    """(e, Delta) = (x - x_d, x_hat - x) of a plant with its gains; X is the shift of x_d by estimated loads, if any."""

    def __init__(self, plant: AuditedPlant, K: Matrix, L: Matrix, X: Ball | None, generator: Any = None) -> None:
        self.plant, self.K, self.L, self.X, self.generator = plant, K, L, X, generator

    def faults(self, entry: Any) -> list[str]:
        """Return what is wrong with the bounds of what one disturbance, noise or start can do to each signal."""
        found: dict[Any, Fraction] = {}
        faults = [] if entry["signals"] else ["it bounds nothing"]
        distinct([signal[:2] for signal in entry["signals"]], "a signal of a bound")
        for proof in entry["parts"]:
            loop, channel = proof["loop"], proof["channel"]
            faults += leaving(self.matrices(loop), self.drive(loop, channel), proof, start=channel[0] == "start")
            Q, _ = packed(proof["Q"])
            distinct([signal[:2] for signal in proof["signals"]], "a signal of an ellipsoid")
            for kind, k, size in proof["signals"]:
                if beyond(self.row(loop, kind, k), Q, number(size)):
                    faults.append(f"{kind} {k} is not bounded by {size}")
                found[loop, *channel, kind, k] = number(size)
        for peak in entry.get("peaks", []):
            part = entry["parts"][place(peak["part"], len(entry["parts"]))]
            loop, ((kind, k, _),) = part["loop"], part["signals"]
            M, row, g = self.matrices(loop), self.row(loop, kind, k), self.drive(loop, part["channel"])
            if part["channel"][0] == "start" or len(M) != 1 or any(X[1] for X in (*M, row, g)):
                raise AuditFault("a peak gain is one of one matrix without radius")
            if peak_bound(M[0][0], g[0], row[0], part, peak) > number(peak["size"]):
                faults.append(f"the peak gain of {kind} {k} is above {peak['size']}")
            found[loop, *part["channel"], kind, k] = number(peak["size"])
        for kind, k, size in entry["signals"]:
            self.row("joint", kind, k)
            if self.bound(found, entry["channel"], kind, k) > number(size):
                faults.append(f"{kind} {k} is not bounded by {size}")
        return faults

    def bound(self, found: Any, channel: Any, kind: str, k: int) -> Fraction:
        """Return the bound of a signal that the ellipsoids prove: at once, or that of K Delta first, which drives e."""
        name, where = channel
        if kind == "estimate":
            return self.known(found, "observer", channel, kind, k)
        if ("joint", name, where, kind, k) in found:
            return Fraction(found["joint", name, where, kind, k])
        total = self.known(found, "controller", channel, kind, k)
        within, acts, drivers = "input", "input", list(range(len(self.K)))
        if self.plant.loads is not None:  # each entry of what drives e acts as a disturbance of that equation
            X, R = self.coupling
            within, acts = "coupling", "disturbance"
            drivers = [j for j, row in enumerate(X) if any(row) or (R and any(R[j]))]
        for j in drivers:
            drive = self.known(found, "observer", channel, within, j)
            total += drive * self.known(found, "controller", [acts, j], kind, k) if drive else 0
        return total + (self.known(found, "observer", channel, kind, k) if kind == "input" else 0)

    def known(self, found: Any, loop: str, channel: Any, kind: str, k: int) -> Fraction:
        """Return the size in one loop; 0 where nothing enters it."""
        if not any(any(map(any, X)) for X in self.drive(loop, channel)):
            return Fraction(0)
        return Fraction(found[loop, *channel, kind, k])

    @cached_property
    def coupling(self) -> Ball:
        """Return the matrix by which errors of the observer drive e: B K, with loads [B K - X L_s C, -E]."""
        BK = self.plant.B @ Ball(self.K)
        if self.plant.loads is None:
            return BK
        if self.X is not None:
            BK -= self.X @ Ball(self.L[len(self.K[0]) :]) @ self.plant.C
        return sides(BK, -self.plant.loads[0])

    def matrices(self, name: str) -> list[Ball]:
        """Return the matrices of e' = (A_i + B K) e + ..., of Delta' = (A_j + L C) Delta + ..., or of both together."""
        controller, _ = self.plant.problem("controller", self.K, self.L, None)
        observer = [M.T for M in self.plant.problem("observer", self.K, self.L, None)[0]]
        if name != "joint":
            return {"controller": controller, "observer": observer}[name]
        below = zero(len(self.L), len(self.K[0]))
        pairs = [stacked(sides(X, self.coupling), sides(below, Y)) for X in controller for Y in observer]
        return [pair for _, pair in unlike(pairs)]

    def drive(self, loop: str, channel: Any) -> Ball:
        """Return the column by which a disturbance, a noise or an input enters a loop, or those of a start."""
        kind, n, N = channel[0], len(self.plant.B[0]), len(self.L)
        counts = {"disturbance": n, "noise": len(self.plant.C[0]), "input": len(self.plant.B[0][0]), "start": n + N}
        k = place(channel[1], counts[kind])
        if kind == "disturbance":
            e, Delta = unit(n, k), -unit(N, k)
        elif kind == "noise":
            gain = Ball(self.L).column(k)
            e, Delta = zero(n, 1) if self.X is None else self.X @ gain.rows(n, N), -gain
        elif kind == "start":
            entries = [k, k + 1] if k + 1 - 2 * n in self.plant.seconds else [k]
            both = sides(*(unit(n + N, entry) for entry in entries))
            e, Delta = both.rows(0, n), both.rows(n, n + N)
        else:
            if loop != "controller":
                raise AuditFault("an input drives the controller's loop only")
            e, Delta = self.plant.B.column(k), zero(N, 1)
        return {"joint": stacked(e, Delta), "controller": e, "observer": Delta}[loop]

    def row(self, loop: str, kind: str, k: int) -> Ball:
        """Return the row that reads a signal off (e, Delta), or off one of both."""
        plant, K = self.plant, self.K
        n, N = len(plant.B[0]), len(plant.seen_A[0][0])
        of_e = {"output": plant.tracked, "measured": plant.C, "state": Ball(identity(n, 1)), "estimate": zero(N, n)}
        of_e |= {"coupling": zero(n, n), "input": Ball(K), "drive": Ball(K)}
        place(k, len(of_e[kind].centre))
        if kind == "coupling":
            if loop != "observer" or plant.loads is None:
                raise AuditFault("what drives e is a signal of the observer's loop, where loads are estimated")
            return self.coupling.row(k)
        e, Delta = of_e[kind].row(k), unit(N, k).T if kind == "estimate" else zero(1, N)
        if kind in ("input", "drive"):
            loads = plant.at_inputs() if kind == "drive" else [-1] * (N - n)
            Delta = Ball([K[k] + [Fraction(-int(j == k)) for j in loads]])
        return {"joint": sides(e, Delta), "controller": e, "observer": Delta}[loop]
