"""Check a pwatrack certificate with fractions only; runs alone: python audit.py certificate.json .

Nothing is taken from the file but the plant, the gains and the proofs; all between them is worked out again.

- The cells cover R^n without overlap, and the field is continuous: no two hyperplanes are one, and two cells on
  opposite sides of H x + h = 0 alone have [A_i b_i] - [A_j b_j] = g [H h], or do not touch there. Linear programs in
  fractions decide the geometry. Where entries lie in balls, this and the next line are about their centres.
- The normal form (11): c_0 is the tracked row, c_k+1 = c_k A_i in all cells, c_k B = 0 for k < r - 1, and N = e_j -
  B_j / delta c_r-1 for the internal states j give T = [c; N], and A_eta_i is the lower right part of T A_i T^-1.
- A design has P_jk = integers_jk * 2**(exponents_j + exponents_k), P > 0 and -(M_i P + P M_i^T) - 2 rate P - margin I
  > 0 for every i: so every x' = A(t) x with A(t) in the convex hull of the M_i, or of their transposes, decays at least
  as fast as exp(-rate t). M_i is A_i + B K for (8), (A_i + L C)^T for (9), A_eta_i^T for (17). Where entries lie in
  balls, this and all that follows but the last holds for everything in them.
- A bound has Q > 0 and -(M Q + Q M^T) - a Q - g g^T / a > 0 for M = [A_i + B K, B K; 0, A_j + L C] and all i, j, or for
  one of its diagonal blocks: so from z = 0 on, z' = M z + g d stays where z^T Q^-1 z <= sup |d|^2, and |c z| is at
  most (c Q c^T)^(1/2) sup |d|. z = (e, Delta) = (x - x_d, x_hat - x); g and c are those of the channel and the signal.
- Loads E s with s' = S s are estimated: then [A_i, E; 0, S] and [C, 0] stand for A_i and C in (9), Delta has the errors
  of the estimates below x_hat - x, and [B K - X L_s C, -E] stands for B K beside A_i + B K, by which noise reaches e
  too: L_s is the part of L that is below, and X = -T^-1 G, G = [g; 0], g_0 = 0, g_k+1 = c_k E + g_k S, the shift of x_d
  by the estimates; for state tracking X = 0, and every load enters where an input does.
- Uncertain parameters have corners: other A_c, b_c and B_c for the same cells, whose fields are continuous too. Their
  bounds are such bounds for M = [A_ci + B_c K, B_c K; A_i - A_ci - (B_c - B) K, A_j + L C - (B_c - B) K], all corners
  and all i, j; M is affine in A_c and B_c, so they hold for all means of the corners. g = (w, -w) with one entry of w;
  each entry in which a corner differs from the plant has its bounds.
- A cost has X M_i + M_i^T X + Q + K^T R K < 0 and X > 0; for the observer with A_i^T, C^T, L^T.
- An impossibility has Z_i with sum Z_i B = 0 and sum Z_i (M_i + rate I) + transpose >= 0, where all Z_i >= 0 and not
  all are 0, or there is one alone and it is not <= 0: so no P > 0 and Y have M_i P + P M_i^T + B Y + Y^T B^T + 2 rate P
  < 0 for all i. It is about the centres of balls.
"""

import json
import os
import re
import stat
import sys
from collections.abc import Iterator
from fractions import Fraction
from itertools import combinations
from math import lcm
from typing import Any

FORMAT = "pwatrack certificate 6"
NAMES = {
    "plant": "(7) plant",
    "controller": "(8) controller",
    "observer": "(9) observer",
    "generator": "(17) generator",
}
Matrix = list[list[Fraction]]
Ball = tuple[Matrix, Matrix]  # centre and radius
_NUMBER = re.compile(r"-?[0-9]+(\.[0-9]+)?(e-?[0-9]{1,4})?(/0*[1-9][0-9]*)?")
_MOST_BYTES = 2**28  # of the file
_LARGEST = 100_000  # characters of a file's number, and binary exponent


class Fault(Exception):
    """Something in the file is wrong, or does not hold."""


def audit(text: str) -> tuple[list[str], list[str]]:
    """Return what a certificate proves, and what is wrong with it, both in sentences."""
    try:
        content = json.loads(text, parse_float=str, parse_constant=str)
        if content["format"] != FORMAT:
            return [], [f"the format is not '{FORMAT}'"]
        return judged(content)
    except Fault as fault:
        return [], [str(fault)]
    except (KeyError, TypeError, ValueError, IndexError, ArithmeticError, AttributeError, RecursionError) as error:
        missing = f"{error} is missing" if isinstance(error, KeyError) else f"{type(error).__name__}: {error}"
        return [], [f"not a certificate: {missing}"[:200]]


def judged(content: Any) -> tuple[list[str], list[str]]:
    """Decide every claim of a certificate."""
    plant = Plant(content["plant"])
    open_ = [content["plant"], *([content["plant"]["loads"]] if content["plant"]["loads"] else [])]
    inexact = any(any(part["radius"].values()) for part in open_)
    centres = ", at the centres of the balls that its numbers lie in" if inexact else ""
    said = [f"plant: {len(plant.A)} cells cover the state space, the field is continuous{centres}"]
    faults = plant.faults()
    if content["tracking"] == "state" and plant.unmatched():
        faults.append("a load enters where no input does, and x_d is given")
    K, L = (None if content[name] is None else matrix(content[name]) for name in ("K", "L"))
    generator = content["generator"]
    A_eta = None if generator is None else plant.tracking_dynamics(generator)
    refusal = any("Z" in proof for proof in content["proofs"])
    faults += misplaced(content) if refusal else []
    decided = set()
    for proof in content["proofs"]:
        of = proof["of"]
        if "X" in proof and of not in ("controller", "observer"):
            raise Fault(f"no cost is that of {NAMES[of]}")
        M, B = plant.problem(of, K, L, A_eta)
        kind = refuted if "Z" in proof else cost if "X" in proof else check
        wrong = kind(M, B, proof, K if of == "controller" else L and transposed(L))
        faults += [f"{NAMES[of]}: {fault}" for fault in wrong]
        about = centres if "Z" in proof else ""
        said.append(f"{NAMES[of]}: {claim(proof, [str(name) for name in content['plant']['cells']])}{about}")
        decided.add("" if "X" in proof else of)
    for entry in content.get("bounds", []):
        faults += [f"bound of {entry['channel']}: {fault}" for fault in plant.exceeded(entry, K or [], L or [])]
    if content.get("bounds"):
        said.append(f"the bounds of {len(content['bounds'])} disturbances and noises are proved")
    if (uncertain := content.get("uncertain")) is not None:
        wrong, sentence = plant.uncertain(content["plant"], uncertain, K or [], L or [])
        faults += [f"uncertain parameters: {fault}" for fault in wrong]
        said.append(sentence)
    if not refusal:
        wanted = {"controller", "observer"} | ({"generator"} if A_eta is not None and A_eta[0][0] else set())
        absent = sorted(NAMES[of] for of in wanted - decided)
        if content["tracking"] not in ("output", "state") or (content["tracking"] == "output") != (A_eta is not None):
            faults.append("a generator goes with output tracking, and only with that")
        theorem = "Theorem 3, output tracking" if A_eta is not None else "Theorem 2, state tracking"
        faults += [f"{name} is absent, which {theorem} needs" for name in absent]
        said.append(f"{theorem}: none of its inequalities is absent")
    return said, faults


def misplaced(content: Any) -> list[str]:
    """Return what does not belong into the proof of a refusal."""
    proof, *more = content["proofs"]
    of = proof["of"]
    extra = more or content.get("bounds") or content.get("uncertain")
    faults = ["a refusal has one proof, and no bounds"] if extra else []
    if of == "plant" or (of == "generator" and number(proof["rate"])):
        faults.append(f"no theorem needs {NAMES[of]}" + " at a rate" * (of == "generator"))
    if (of != "controller" and content["K"] is not None) or (of != "observer" and content["L"] is not None):
        faults.append("a refusal has no gain but the one that it is about")
    return faults


def claim(proof: Any, cells: list[str]) -> str:
    """Say what one entry claims."""
    if "X" in proof:
        return "the bound of the cost is proved"
    rate = f"{float(number(proof['rate'])):g} 1/s"
    if "Z" in proof:
        beyond = f" at a rate of {rate}" if number(proof["rate"]) else ""
        return f"proved impossible{beyond}, by multipliers for " + ", ".join(f"'{cells[int(i)]}'" for i in proof["Z"])
    return f"proved, rate {rate}"


class Plant:
    """x' = A_i x + b_i + B u in cell i; y = C x is measured, the tracked rows are to follow a reference."""

    def __init__(self, content: Any) -> None:
        radius = content["radius"]
        self.A, self.b = (
            [ball(X, radius[name] and radius[name][i]) for i, X in enumerate(content[name])] for name in ("A", "b")
        )
        self.B, self.C, self.tracked = (ball(content[name], radius[name]) for name in ("B", "C", "tracked_rows"))
        self.loads: tuple[Ball, Ball] | None = None
        self.seen_A, self.seen_C = self.A, self.C
        if content["loads"] is not None:
            self.estimate(content["loads"])
        self.planes = [[number(v) for v in (*row, h)] for row, h in zip(content["H"], content["h"], strict=True)]
        self.parallel = [normalised(plane) for plane in self.planes]
        self.signs = [[int(s) for s in row] for row in content["signs"]]
        n, k, cells = len(self.B[0]), len(self.planes), len(self.A)
        if any(radius[name] and len(radius[name]) != cells for name in ("A", "b")) or len(content["cells"]) != cells:
            raise Fault("the matrices of the plant do not fit together")
        shapes = {(len(X), len(row)) for X, _ in self.A for row in X} | {(len(row),) for row in self.signs}
        rows = {len(row) for row in (*self.C[0], *self.tracked[0], *(plane[1:] for plane in self.planes))}
        if not n or not cells or len(self.signs) != cells or len(self.b) != cells or not shapes <= {(n, n), (k,)}:
            raise Fault("the matrices of the plant do not fit together")
        if not rows <= {n} or any([len(row) for row in X] != [1] * n for X, _ in self.b):
            raise Fault("the matrices of the plant do not fit together")
        if len({plane[:2] for plane in self.parallel}) != k:
            raise Fault("two hyperplanes are one")

    def estimate(self, content: Any) -> None:
        """Take in the loads E s, s' = S s, that the observer estimates: it runs plant and loads as one system."""
        E, S = (ball(content[name], content["radius"][name]) for name in ("E", "S"))
        n, p = len(self.B[0]), len(S[0])
        if not p or len(E[0]) != n or {len(row) for row in (*E[0], *S[0])} != {p}:
            raise Fault("the loads do not fit to the plant")
        below: Ball = [[Fraction(0)] * n for _ in range(p)], []
        beside: Ball = [[Fraction(0)] * p for _ in self.C[0]], []
        self.loads = E, S
        self.seen_A = [stacked(sides(A, E), sides(below, S)) for A in self.A]
        self.seen_C = sides(self.C, beside)
        self.shift: Ball = [[Fraction(0)] * p for _ in range(n)], []

    def unmatched(self) -> bool:
        """Say whether some load enters where no input does: nothing makes up for it while all of x_d is given."""
        return self.loads is not None and rank(sides((self.B[0], []), (self.loads[0][0], []))[0]) != rank(self.B[0])

    def problem(self, of: str, K: Any, L: Any, A_eta: Any) -> tuple[list[Ball], Matrix]:
        """Return the matrices M_i that a proof speaks of, and B where the gain is free (else an empty one)."""
        if of == "plant":
            return [flipped(A) for A in self.A], []
        if of == "generator":
            return [flipped(A) for A in A_eta], []
        A, B, gain = (self.A, self.B, K)
        if of != "controller":
            A, B, gain = [flipped(A) for A in self.seen_A], flipped(self.seen_C), L
        if gain is None:
            return A, B[0]
        BK = times(B, (gain if of == "controller" else transposed(gain), []))
        return [(added(X, BK[0]), added_or(R, BK[1])) for X, R in A], []

    def tracking_dynamics(self, generator: Any) -> list[Ball]:
        """Return A_eta, (17), after checking that the plant has the form (11) that is claimed."""
        n, r = len(self.B[0]), int(generator["relative_degree"])
        internal = [int(j) for j in generator["internal"]]
        if len(self.tracked[0]) != 1 or len(self.B[0][0]) != 1 or not 1 <= r <= n or len(internal) != n - r:
            raise Fault("the form (11) does not fit the plant")
        row, T = self.tracked, self.tracked
        for k in range(r):
            following, reached = times(row, self.A[0]), product(row[0], self.B[0])[0][0]
            if (reached == 0) != (k < r - 1):
                raise Fault(f"the relative degree is not {r}")
            for (A, _), (b, _) in zip(self.A, self.b, strict=True):
                if k < r - 1 and (
                    product(row[0], A) != following[0] or product(row[0], b) != product(row[0], self.b[0][0])
                ):
                    raise Fault("the derivatives of the output differ between cells before the input enters")
            if k < r - 1:
                row = following
                T = stacked(T, row)
        delta, derivatives = times(row, self.B), T
        for j in internal:
            share = times(([self.B[0][j]], [self.B[1][j]] if self.B[1] else []), inverse(delta))
            taken = times(share, row)
            T = stacked(T, (added([[Fraction(int(j == k)) for k in range(n)]], taken[0], -1), taken[1]))
        back = inverse(T)
        if self.loads is not None:
            self.shift = self.shifted(derivatives, back)
        found = []
        for cell in self.A:
            X, R = times(times(T, cell), back)
            found.append(([line[r:] for line in X[r:]], [line[r:] for line in R[r:]] if R else []))
        if [matrix(X) for X in generator["A_eta"]] != [X for X, _ in found] or matrix(generator["T"]) != T[0]:
            raise Fault("A_eta or T is not that of the plant")
        return found

    def shifted(self, rows: Ball, back: Ball) -> Ball:
        """Return X = -T^-1 G, by which estimated loads shift x_d: g_0 = 0, g_k+1 = c_k E + g_k S, G = [g; 0]."""
        assert self.loads is not None
        E, S = self.loads
        n, p = len(E[0]), len(S[0])
        g: Ball = [[Fraction(0)] * p], []
        G = g
        for k in range(len(rows[0]) - 1):
            row = [rows[0][k]], [rows[1][k]] if rows[1] else []
            g = plus(times(row, E), times(g, S))
            G = stacked(G, g)
        G = stacked(G, ([[Fraction(0)] * p for _ in range(n - len(G[0]))], []))
        X, R = times(back, G)
        return [[-v for v in row] for row in X], R

    def coupling(self, K: Matrix, L: Matrix) -> Ball:
        """Return the matrix by which errors of the observer drive e: B K, with loads [B K - X L_s C, -E]."""
        BK = times(self.B, (K, []))
        if self.loads is None:
            return BK
        (X, R), (E, S) = times(times(self.shift, (L[len(K[0]) :], [])), self.C), self.loads[0]
        return sides((added(BK[0], X, -1), added_or(BK[1], R)), ([[-v for v in row] for row in E], S))

    def exceeded(self, entry: Any, K: Matrix, L: Matrix) -> list[str]:
        """Return what is wrong with the bounds of what one disturbance or noise can do to each signal."""
        found: dict[Any, Fraction] = {}
        faults = [] if entry["signals"] else ["it bounds nothing"]
        for part in entry["parts"]:
            loop, channel = part["loop"], part["channel"]
            M, g = self.loop(loop, K, L), self.drive(loop, channel, L)
            Q, powers = packed(part["Q"])
            rate = number(part["a"])
            if not definite(Q) or rate <= 0:
                raise Fault("Q or a is not positive")
            square, open_ = times(g, flipped(g))
            for X, R in M:
                half = product(added(X, identity(len(Q), rate / 2)), Q)
                left = added(added(half, transposed(half)), [[v / rate for v in row] for row in square])
                enlarge(left, product(R, sizes(Q)) if R else [], powers)
                enlarge(left, [[v / rate / 2 for v in row] for row in open_], powers)
                if not definite(left, sign=-1):
                    faults.append("an ellipsoid can be left")
            for kind, k, size in part["signals"]:
                c = self.row(loop, kind, k, K, L)
                value, radius = times(times(c, (Q, [])), flipped(c))
                if value[0][0] + (radius[0][0] if radius else 0) > number(size) ** 2 or number(size) < 0:
                    faults.append(f"{kind} {k} is not bounded by {size}")
                found[loop, *channel, kind, k] = number(size)
        for kind, k, size in entry["signals"]:
            self.row("joint", kind, k, K, L)
            if self.bound(found, entry["channel"], kind, k, K, L) > number(size):
                faults.append(f"{kind} {k} is not bounded by {size}")
        return faults

    def uncertain(self, plant: Any, content: Any, K: Matrix, L: Matrix) -> tuple[list[str], str]:
        """Return what is wrong with the bounds for all plants between some corners, and what they claim."""
        box = Box(plant, content["corners"])
        faults = [f"corner {k + 1}: {fault}" for k, corner in enumerate(box.corners) for fault in corner.faults()]
        bounded, signals = set[int](), [{(kind, k) for kind, k, _ in entry["signals"]} for entry in content["bounds"]]
        for entry in content["bounds"]:
            kind, k = entry["channel"]
            if kind != "disturbance":
                raise Fault("a bound of uncertain parameters is one of an entry of w")
            bounded.add(k)
            faults += [f"entry {k + 1}: {fault}" for fault in box.exceeded(entry, K, L)]
        if bounded < box.varying() or any(one != signals[0] for one in signals):
            faults.append("an entry of w, or a signal of one, has no bound")
        names = ", ".join(str(name) for name, _, _ in content["parameters"])
        count = len(unlike(box.loop("joint", K, L)))
        return faults, f"uncertain parameters: {names}: {count} inequalities are proved, for {len(box.corners)} corners"

    def bound(self, found: Any, channel: Any, kind: str, k: int, K: Matrix, L: Matrix) -> Fraction:
        """Return the bound of a signal that the ellipsoids prove: at once, or that of K Delta first, which drives e."""
        name, where = channel
        if kind == "estimate":
            return self.known(found, "observer", channel, kind, k, L)
        if ("joint", name, where, kind, k) in found:
            return Fraction(found["joint", name, where, kind, k])
        total = self.known(found, "controller", channel, kind, k, L)
        within, acts, drivers = "input", "input", list(range(len(K)))
        if self.loads is not None:  # each entry of what drives e acts as a disturbance of that equation
            X, R = self.coupling(K, L)
            within, acts, drivers = (
                "coupling",
                "disturbance",
                [j for j, row in enumerate(X) if any(row) or (R and any(R[j]))],
            )
        for j in drivers:
            drive = self.known(found, "observer", channel, within, j, L)
            total += drive * self.known(found, "controller", [acts, j], kind, k, L) if drive else 0
        return total + (self.known(found, "observer", channel, kind, k, L) if kind == "input" else 0)

    def known(self, found: Any, loop: str, channel: Any, kind: str, k: int, L: Matrix) -> Fraction:
        """Return the size in one loop; 0 where nothing enters it."""
        if not any(any(map(any, X)) for X in self.drive(loop, channel, L)):
            return Fraction(0)
        return Fraction(found[loop, *channel, kind, k])

    def loop(self, name: str, K: Matrix, L: Matrix) -> list[Ball]:
        """Return the matrices of e' = (A_i + B K) e + ..., of Delta' = (A_j + L C) Delta + ..., or of both together."""
        controller, _ = self.problem("controller", K, L, None)
        observer = [flipped(M) for M in self.problem("observer", K, L, None)[0]]
        if name != "joint":
            return {"controller": controller, "observer": observer}[name]
        drives, n, N = self.coupling(K, L), len(K[0]), len(L)
        nothing: Ball = [[Fraction(0)] * n for _ in range(N)], []
        pairs = [stacked(sides(X, drives), sides(nothing, Y)) for X in controller for Y in observer]
        return [pair for _, pair in unlike(pairs)]

    def drive(self, loop: str, channel: Any, L: Matrix) -> Ball:
        """Return the column by which a disturbance, a noise or an input enters a loop."""
        kind, n = channel[0], len(self.B[0])
        k = place(channel[1], {"disturbance": n, "noise": len(self.C[0]), "input": len(self.B[0][0])}[kind])
        e: Ball = [[Fraction(int(j == k))] for j in range(n)], []
        Delta: Ball = [[Fraction(-int(j == k))] for j in range(len(L))], []
        if kind == "noise":
            column = [[row[k]] for row in L]
            e, Delta = ([[Fraction(0)]] * n, []), ([[-v for v in row] for row in column], [])
            if self.loads is not None:
                e = times(self.shift, (column[n:], []))
        if kind == "input":
            if loop != "controller":
                raise Fault("an input drives the controller's loop only")
            e = [[row[k]] for row in self.B[0]], [[row[k]] for row in self.B[1]]
        return {"joint": stacked(e, Delta), "controller": e, "observer": Delta}[loop]

    def row(self, loop: str, kind: str, k: int, K: Matrix, L: Matrix) -> Ball:
        """Return the row that reads a signal off (e, Delta), or off one of both."""
        n, N = len(self.B[0]), len(self.seen_A[0][0])
        place(k, {"output": len(self.tracked[0]), "input": len(K), "state": n, "estimate": N, "coupling": n}[kind])
        if kind == "coupling":
            if loop != "observer" or self.loads is None:
                raise Fault("what drives e is a signal of the observer's loop, where loads are estimated")
            X, R = self.coupling(K, L)
            return [X[k]], [R[k]] if R else []
        e = [Fraction(int(j == k and kind == "state")) for j in range(n)]
        e = {"output": self.tracked[0], "input": K}[kind][k] if kind in ("output", "input") else e
        Delta = [Fraction(int(j == k and kind == "estimate")) for j in range(N)]
        Delta = e + [Fraction(0)] * (N - n) if kind == "input" else Delta
        radius, zero = (self.tracked[1][k] if kind == "output" and self.tracked[1] else []), [Fraction(0)] * N
        rows = {"joint": e + Delta, "controller": e, "observer": Delta}
        radii = {"joint": radius + zero, "controller": radius, "observer": zero}
        return [rows[loop]], [radii[loop]] if radius else []

    def faults(self) -> list[str]:
        """Return where cells overlap, where none is, and where the field jumps."""
        faults = []
        for i, j, opposite in self.neighbours():
            both = [s or t for s, t in zip(self.signs[i], self.signs[j], strict=True)]
            if not opposite and self.interior(both):
                faults.append(f"cells {i + 1} and {j + 1} overlap")
            if len(opposite) == 1 and self.jumps(i, j, opposite[0]) and self.interior(both, on=opposite[0]):
                faults.append(f"the field jumps between cells {i + 1} and {j + 1}")
        if not faults and self.hole([0] * len(self.planes), list(range(len(self.A)))):
            faults.append("the cells do not cover the state space")
        return faults

    def neighbours(self) -> Iterator[tuple[int, int, list[int]]]:
        """Yield pairs of cells on opposite sides of one hyperplane at most: the others do not touch in a facet."""
        if not all(map(all, self.signs)):  # some hyperplanes do not bound some cells
            for i, j in combinations(range(len(self.signs)), 2):
                pairs = zip(self.signs[i], self.signs[j], strict=True)
                opposite = [k for k, (s, t) in enumerate(pairs) if s * t < 0]
                if len(opposite) <= 1:
                    yield i, j, opposite
            return
        places: dict[tuple[int, ...], int] = {}
        for j, row in enumerate(map(tuple, self.signs)):
            if row in places:
                yield places[row], j, []
            for k in range(len(row)):
                beside = places.get((*row[:k], -row[k], *row[k + 1 :]))
                if beside is not None:
                    yield beside, j, [k]
            places[row] = j

    def jumps(self, i: int, j: int, k: int) -> bool:
        """Say whether [A_i b_i] - [A_j b_j] is no g [H h]."""
        plane = self.planes[k]
        pivot = next(p for p, v in enumerate(plane) if v)
        for a, b, c, d in zip(self.A[i][0], self.A[j][0], self.b[i][0], self.b[j][0], strict=True):
            row = [v - w for v, w in zip((*a, *c), (*b, *d), strict=True)]
            if any(v * plane[pivot] != row[pivot] * p for v, p in zip(row, plane, strict=True)):
                return True
        return False

    def hole(self, region: list[int], cells: list[int]) -> bool:
        """Say whether some point strictly inside a region is in none of these cells."""
        if not self.interior(region):
            return False
        for position, i in enumerate(cells):
            if any(s * t < 0 for s, t in zip(region, self.signs[i], strict=True)):
                continue
            inside = list(region)
            for k, s in enumerate(self.signs[i]):
                if s and not region[k]:
                    outside = list(inside)
                    outside[k] = -s
                    if self.hole(outside, cells[position + 1 :]):
                        return True
                    inside[k] = s
            return False
        return True

    def interior(self, signs: list[int], on: int | None = None) -> bool:
        """Decide whether s (H x + h) > 0 has a solution for all signs s but 0, on a hyperplane if one is given."""
        if on is None:
            return self.between(signs)
        rows = [[s * v for v in self.planes[k]] for k, s in enumerate(signs) if s and k != on]
        plane = self.planes[on]
        pivot = next(p for p, v in enumerate(plane) if v)
        rows = [[v - row[pivot] / plane[pivot] * p for v, p in zip(row, plane, strict=True)] for row in rows]
        return strictly_feasible(rows)

    def between(self, signs: list[int]) -> bool:
        """Decide the same off all hyperplanes: of those that are parallel only the nearest on either side count."""
        above: dict[Any, Fraction] = {}
        below: dict[Any, Fraction] = {}
        for s, (direction, offset, turned) in zip(signs, self.parallel, strict=True):
            if s * turned > 0:
                above[direction] = min(offset, above.get(direction, offset))
            elif s:
                below[direction] = max(offset, below.get(direction, offset))
        if any(offset <= below[direction] for direction, offset in above.items() if direction in below):
            return False
        rows = [[*direction, offset] for direction, offset in above.items()]
        rows += [[-v for v in (*direction, offset)] for direction, offset in below.items()]
        return strictly_feasible(rows)


class Box(Plant):
    """The same plant, where another one runs that is a mean of some corners."""

    def __init__(self, content: Any, corners: Any) -> None:
        super().__init__(content)
        if self.loads is not None:
            raise Fault("uncertain parameters go without estimated loads")
        self.corners = [
            Plant(content | {name: X[name] for name in ("A", "b", "B")} | {"radius": content["radius"] | X["radius"]})
            for X in corners
        ]
        if not corners or any(len(corner.B[0][0]) != len(self.B[0][0]) for corner in self.corners):
            raise Fault("the matrices of the corners do not fit those of the plant")

    def varying(self) -> set[int]:
        """Return the state equations in which a corner differs from the plant."""
        return {
            k
            for corner in self.corners
            for own, other in zip((*self.A, *self.b, self.B), (*corner.A, *corner.b, corner.B), strict=True)
            for k, row in enumerate(own[0])
            if row != other[0][k]
        }

    def loop(self, name: str, K: Matrix, L: Matrix) -> list[Ball]:
        """Return the matrices of (e, Delta) for all corners and pairs of cells."""
        if name != "joint":
            raise Fault("the bounds of uncertain parameters are those of the joint loop")
        observer, pairs = [flipped(M) for M in self.problem("observer", K, L, None)[0]], list[Ball]()
        for corner in self.corners:
            BK, off = times(corner.B, (K, [])), times(less(self.B, corner.B), (K, []))
            for A_c, A in zip(corner.A, self.A, strict=True):
                lower = plus(less(A, A_c), off)
                pairs += [stacked(sides(plus(A_c, BK), BK), sides(lower, plus(A_j, off))) for A_j in observer]
        return [pair for _, pair in unlike(pairs)]


def less(one: Ball, other: Ball) -> Ball:
    """Return all differences of what is in two balls."""
    return added(one[0], other[0], -1), added_or(one[1], other[1])


def normalised(plane: list[Fraction]) -> tuple[tuple[Fraction, ...], Fraction, int]:
    """Return H and h over the first entry of H that is not 0, and the sign of that."""
    pivot = next((v for v in plane[:-1] if v), None)
    if pivot is None:
        raise Fault("a hyperplane has a zero normal")
    return tuple(v / pivot for v in plane[:-1]), plane[-1] / pivot, 1 if pivot > 0 else -1


def strictly_feasible(rows: list[list[Fraction]]) -> bool:
    """Decide whether a x + c > 0 for all rows (a, c) has a solution.

    The least w >= 0 with a x + c >= 1 - w is below 1 then; it is found by the simplex method with Bland's rule.
    """
    width = 2 * (len(rows[0]) - 1) + 1 if rows else 0  # x as a difference of two positive vectors, and w
    table = [
        [*row[:-1], *(-v for v in row[:-1]), Fraction(1), row[-1] - 1] for row in rows
    ]  # each basic variable of these
    basis, free = [-1 - k for k in range(len(rows))], list(range(width))
    if all(row[-1] >= 0 for row in table):
        return True
    goal: list[Fraction] = [Fraction(0)] * width + [Fraction(0)]
    goal[width - 1] = Fraction(1)
    leaving, entering = min(range(len(table)), key=lambda k: table[k][-1]), width - 1
    while True:
        row = table[leaving]
        factor = -1 / row[entering]
        row[entering] = Fraction(-1)
        table[leaving] = row = [factor * v for v in row]
        basis[leaving], free[entering] = free[entering], basis[leaving]
        for other in (*(t for k, t in enumerate(table) if k != leaving), goal):
            scale, other[entering] = other[entering], Fraction(0)
            if scale:
                other[:] = [v + scale * p for v, p in zip(other, row, strict=True)]
        if goal[-1] < 1:
            return True
        falling = [k for k in range(width) if goal[k] < 0]
        if not falling:
            return False
        entering = min(falling, key=lambda k: free[k])
        limits = [(t[-1] / -t[entering], basis[k], k) for k, t in enumerate(table) if t[entering] < 0]
        leaving = min(limits)[2]


def check(matrices: list[Ball], _: Matrix, proof: Any, __: Any) -> list[str]:
    """Return what is wrong with one proof of a design."""
    rate, margin, radius = (number(proof[name]) for name in ("rate", "margin", "radius"))
    P, powers = packed(proof["P"])
    if not P or not definite(P) or not matrices or any(len(M) != len(P) for M, _ in matrices):
        return ["P is not symmetric and positive definite, of the order of the matrices"]
    faults = [] if rate > 0 and margin > 0 and radius >= 0 else ["rate, margin and radius must be positive"]
    for i, (M, R) in unlike(matrices):
        half = product(added(M, identity(len(P), rate)), P)
        left = added(added(half, transposed(half)), identity(len(P), margin))
        enlarge(left, product(R, sizes(P)) if R else [], powers)
        if not definite(left, sign=-1):
            faults.append(f"the inequality fails in cell {i + 1}")
    if 4 * radius**2 * sum(v * v for row in P for v in row) > margin**2:
        faults.append("the radius is larger than margin / (2 |P|)")
    return faults


def unlike(matrices: list[Ball]) -> list[tuple[int, Ball]]:
    """Return the matrices that are no repetition of an earlier one, with their cells."""
    first: dict[Any, tuple[int, Ball]] = {}
    for i, ball_ in enumerate(matrices):
        first.setdefault(tuple(tuple(map(tuple, X)) for X in ball_), (i, ball_))
    return list(first.values())


def packed(content: Any) -> tuple[Matrix, list[Fraction]]:
    """Return the symmetric matrix integers_jk * 2**(exponents_j + exponents_k), and the powers of two."""
    exponents = [int(e) for e in content["exponents"]]
    if any(abs(e) > _LARGEST for e in exponents):
        raise Fault("an exponent is too large to be read")
    powers = [Fraction(2) ** e for e in exponents]
    rows = zip(content["integers"], powers, strict=True)
    P = [[number(v) * a * b for v, b in zip(row, powers, strict=True)] for row, a in rows]
    if transposed(P) != P:
        raise Fault("P or Q is not symmetric")
    return P, powers


def enlarge(left: Matrix, half: Matrix, powers: list[Fraction]) -> None:
    """Add a diagonal above every symmetric E with |E| <= half + half^T.

    For any a > 0, 2 |v_j v_k| <= v_j^2 a_j / a_k + v_k^2 a_k / a_j.
    """
    for j, row in enumerate(added(half, transposed(half))):
        left[j][j] += sum((v * powers[j] / power for v, power in zip(row, powers, strict=True)), Fraction(0))


def cost(matrices: list[Ball], _: Matrix, proof: Any, K: Any) -> list[str]:
    """Return what is wrong with one bound of a cost."""
    X, Q, R = (matrix(proof[name]) for name in ("X", "Q", "R"))
    if transposed(X) != X or not definite(X) or not definite(R) or not definite(Q, semi=True):
        return ["X, Q or R is not positive definite"]
    weight, faults = added(Q, product(transposed(K), product(R, K))), []
    powers = [
        Fraction(2) ** ((row[j].numerator.bit_length() - row[j].denominator.bit_length()) // 2)
        for j, row in enumerate(X)
    ]
    for i, (M, radius) in unlike(matrices):
        half = product(X, M)
        left = added(added(half, transposed(half)), weight)
        enlarge(left, product(sizes(X), radius) if radius else [], powers)
        if not definite(left, sign=-1):
            faults.append(f"the bound of the cost fails in cell {i + 1}")
    return faults


def refuted(matrices: list[Ball], B: Matrix, proof: Any, _: Any) -> list[str]:
    """Return what is wrong with one proof of impossibility."""
    n, Z = len(matrices[0][0]), {int(i): matrix(Z_i) for i, Z_i in proof["Z"].items()}
    total = S = identity(n, 0)
    for i, Z_i in Z.items():
        if len(Z_i) != n or transposed(Z_i) != Z_i or i < 0:
            return ["Z is not symmetric of the order of the matrices"]
        half = product(Z_i, added(matrices[i][0], identity(n, number(proof["rate"]))))
        total, S = added(total, Z_i), added(S, added(half, transposed(half)))
    alone = len(Z) == 1 and not definite(total, semi=True, sign=-1)
    right = alone or (any(map(any, total)) and all(definite(Z_i, semi=True) for Z_i in Z.values()))
    faults = [] if right else ["the Z are not positive semidefinite, or all 0"]
    if B and any(map(any, product(total, B))):
        faults.append("the sum of Z B is not 0")
    return faults if definite(S, semi=True) else [*faults, "the sum of Z M + M^T Z is not positive semidefinite"]


def definite(X: Matrix, *, semi: bool = False, sign: int = 1) -> bool:
    """Decide whether sign X, symmetric, is positive (semi)definite, by Bareiss' elimination in integers."""
    scale = sign * lcm(*(v.denominator for row in X for v in row))
    rows, previous = [[int(v * scale) for v in row] for row in X], 1
    for k, pivot_row in enumerate(rows):
        pivot = pivot_row[k]
        if pivot < 0 or (pivot == 0 and (not semi or any(pivot_row[k + 1 :]))):
            return False
        for row in rows[k + 1 :] if pivot else []:
            factor, pairs = row[k], zip(row[k + 1 :], pivot_row[k + 1 :], strict=True)
            row[k + 1 :] = [(v * pivot - factor * p) // previous for v, p in pairs]
        previous = pivot or previous
    return True


def number(value: Any) -> Fraction:
    """Return a number of the file as the decimal or fraction it is written as."""
    if isinstance(value, str) and len(value) < _LARGEST and _NUMBER.fullmatch(value):
        return Fraction(value)
    if isinstance(value, int) and not isinstance(value, bool) and value.bit_length() < _LARGEST:
        return Fraction(value)
    raise Fault(f"not a number: {str(value)[:40]}")


def place(k: Any, count: int) -> int:
    """Return the place of something among so many, counted from 0."""
    if type(k) is not int or not 0 <= k < count:
        raise Fault(f"there is no {str(k)[:40]} among {count}")
    return k


def matrix(rows: Any) -> Matrix:
    """Return a matrix of the file."""
    return [[number(v) for v in row] for row in rows]


def ball(rows: Any, radius: Any) -> Ball:
    """Return a matrix of the file with its radius; [] for none."""
    R = matrix(radius) if radius else []
    if any(v < 0 for row in R for v in row):
        raise Fault("a radius is negative")
    return matrix(rows), R


def times(one: Ball, other: Ball) -> Ball:
    """Return all products of what is in two balls."""
    (X, R), (Y, S) = one, other
    radius: Matrix = product(sizes(X), S) if S else []
    radius = added_or(radius, product(R, added_or(sizes(Y), S)) if R else [])
    return product(X, Y), radius


def sizes(X: Matrix) -> Matrix:
    """Return the sizes of all entries."""
    return [[abs(v) for v in row] for row in X]


def inverse(ball_: Ball) -> Ball:
    """Return all inverses: |(X + E)^-1 - X^-1| <= (I - Q)^-1 Q |X^-1| with Q = |X^-1| |E|, if (I - Q)^-1 >= 0."""
    X, R = ball_
    back = inverted(X)
    if not R:
        return back, []
    size = sizes(back)
    Q = product(size, R)
    grown = inverted(added(identity(len(X), 1), Q, -1))
    if any(v < 0 for row in grown for v in row):
        raise Fault("a change of state in a ball may be singular")
    return back, product(grown, product(Q, size))


def inverted(X: Matrix) -> Matrix:
    """Return the inverse, by Gauss and Jordan's elimination."""
    n = len(X)
    rows = [[*row, *unit] for row, unit in zip(X, identity(n, 1), strict=True)]
    for k in range(n):
        found = next((j for j in range(k, n) if rows[j][k]), None)
        if found is None:
            raise Fault("a change of state is singular")
        rows[k], rows[found] = rows[found], rows[k]
        rows[k] = [v / rows[k][k] for v in rows[k]]
        for j in range(n):
            if j != k and rows[j][k]:
                rows[j] = [v - rows[j][k] * p for v, p in zip(rows[j], rows[k], strict=True)]
    return [row[n:] for row in rows]


def flipped(ball_: Ball) -> Ball:
    """Return the transposes."""
    return transposed(ball_[0]), transposed(ball_[1])


def stacked(one: Ball, other: Ball) -> Ball:
    """Return one matrix on top of another."""
    (X, R), (Y, S) = one, other
    zero = [[[Fraction(0)] * len(row) for row in Z] for Z in (X, Y)]
    return X + Y, ((R or zero[0]) + (S or zero[1]) if R or S else [])


def sides(one: Ball, other: Ball) -> Ball:
    """Return one matrix beside another."""
    return flipped(stacked(flipped(one), flipped(other)))


def plus(one: Ball, other: Ball) -> Ball:
    """Return all sums of what is in two balls."""
    return added(one[0], other[0]), added_or(one[1], other[1])


def rank(X: Matrix) -> int:
    """Return the rank, by Gauss' elimination."""
    rows, found = [list(row) for row in X], 0
    for k in range(len(rows[0])):
        pivot = next((j for j in range(found, len(rows)) if rows[j][k]), None)
        if pivot is None:
            continue
        rows[found], rows[pivot] = rows[pivot], rows[found]
        for row in rows[found + 1 :]:
            factor = row[k] / rows[found][k]
            row[:] = [v - factor * p for v, p in zip(row, rows[found], strict=True)]
        found += 1
    return found


def identity(n: int, factor: Any) -> Matrix:
    """Return factor I."""
    return [[Fraction(factor) * (j == k) for k in range(n)] for j in range(n)]


def product(X: Matrix, Y: Matrix) -> Matrix:
    """Return X Y."""
    columns = transposed(Y)
    if any(len(row) != len(Y) for row in X):
        raise Fault("matrices do not fit together")
    return [[sum((a * b for a, b in zip(row, c, strict=True) if a and b), Fraction(0)) for c in columns] for row in X]


def added(X: Matrix, Y: Matrix, factor: int = 1) -> Matrix:
    """Return X + factor Y."""
    return [[a + factor * b for a, b in zip(one, two, strict=True)] for one, two in zip(X, Y, strict=True)]


def added_or(X: Matrix, Y: Matrix) -> Matrix:
    """Return X + Y, where [] is 0."""
    return added(X, Y) if X and Y else X or Y


def transposed(X: Matrix) -> Matrix:
    """Return the transpose."""
    return [list(column) for column in zip(*X, strict=True)]


def main(path: str) -> int:
    """Print what the file proves and what is wrong with it; return the exit code."""
    try:
        found = os.stat(path)  # noqa: PTH116
        if not stat.S_ISREG(found.st_mode) or found.st_size > _MOST_BYTES:
            raise OSError(f"it is no regular file of at most {_MOST_BYTES:,} bytes")
        with open(path, encoding="utf-8") as file:  # noqa: PTH123
            said, faults = audit(file.read())
    except (OSError, UnicodeDecodeError) as error:
        said, faults = [], [f"cannot read {path}: {error}"]
    lines = [f"wrong: {fault}" for fault in faults] or [*said, "every number was read as it is written; fractions only"]
    print("\n".join(lines))  # noqa: T201
    return 6 if faults else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]) if len(sys.argv) == 2 else "usage: python audit.py certificate.json")
