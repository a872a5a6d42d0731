"""`docs/arithmetic.md` read word for word, in floats of Python: slow, and nothing is fused or reordered."""

from math import floor, isfinite
from typing import Any

import numpy as np

from pwatrack.control.program import SampledController


class Plain:
    """A program that runs."""

    def __init__(self, program: SampledController, x_hat: Any, eta_hat: Any, real: Any = float) -> None:
        def floats(values: Any) -> Any:
            return [floats(v) for v in values] if np.ndim(values) else real(values)

        self.program, self.real = program, real
        of, follows = program.sizes, program.follows
        self.n, self.m, self.delay = of["n"], of["m"], program.sampling.delay
        self.H, self.h, self.K = floats(program.H), floats(program.h), floats(program.K)
        self.observer, self.generator = floats(program.observer), floats(program.generator)
        self.x_d, self.u_ff, self.guards = floats(program.x_d), floats(program.u_ff), floats(program.guards)
        self.C, self.M, self.E = floats(program.C), floats(program.M), floats(program.E)
        self.change, self.quantum = floats(program.change), floats(program.quantum)
        self.low, self.high = floats(program.limits[:, 0]), floats(program.limits[:, 1])
        self.turn = [] if follows is None else floats(follows.turn)
        self.pieces = [] if follows is None else [(piece, floats(piece.w)) for piece in follows.pieces]
        zero = real(0.0)
        self.state: dict[str, Any] = {"y": [zero] * of["q"], "u": [zero] * self.m}
        self.state |= {"x_hat": floats(x_hat), "eta_hat": floats(eta_hat)}
        w = [zero] * of["s"] if follows is None else floats(follows.w0)
        self.state |= {"w": w, "w1": w, "w2": w, "late": [[zero] * self.m] * self.delay, "before": [zero] * self.m}
        self.state["late_cut"] = self.state["late"]
        self.pace = floats(program.pace)
        self.windows = program.windows.tolist()
        self.state |= {"course": [[zero, zero, zero, pace[0]] for pace in self.pace]}
        rest = [[(pace[0], *[zero] * (3 + n)) for n in range(len(pace) - 4)] for pace in self.pace]
        self.state["past"] = [
            [[row] * N for row, N in zip(rows, Ns, strict=True)] for rows, Ns in zip(rest, self.windows, strict=True)
        ]
        self.state |= {"run": False, "tick": 0, "since": 0, "i": 0, "j": 0, "x_d": [zero] * self.n}

    def row(self, a: Any, v: Any) -> Any:
        if not v:
            return a[0]
        s = a[0] * v[0]
        for k in range(1, len(v)):
            s = s + a[k] * v[k]
        return s + a[len(v)] if len(a) > len(v) else s

    def cell(self, cells: Any, values: Any) -> int:
        worst = []
        for signs in cells.tolist():
            wrong = [self.real(0.0)]
            for g, side in zip(values, signs, strict=True):
                if side:
                    wrong.append(-g if side > 0 else g)
            worst.append(max(wrong))
        return worst.index(min(worst))

    def step(self, y: Any, given: Any = None) -> int:
        old, new, status = self.state, dict(self.state), 0
        follows = self.program.follows
        if old["run"]:
            if self.M:
                new["x_hat"] = self.predicted(old["u"], old["x_hat"])
            else:
                seen = [*old["y"], *old["u"], *old["x_hat"]]
                new["x_hat"] = [self.row(a, seen) for a in self.observer[old["i"]]]
            known = [*old["x_hat"][self.n :], *old["eta_hat"], *old["w"]]
            new["eta_hat"] = [self.row(a, known) for a in self.generator[old["j"]]]
            if follows is not None and follows.end is not None and old["tick"] >= follows.end:
                status = 1
            elif follows is not None:
                self.turned(new)
        new["y"] = [self.real(v) for v in y]
        if follows is None:
            new["w"] = [self.real(v) for v in given]
            if self.pace:
                self.followed(old, new)
        if self.M:
            missed = [self.row(a, new["x_hat"]) - y for a, y in zip(self.C, new["y"], strict=True)]
            new["x_hat"] = [v + self.row(a, missed) for v, a in zip(new["x_hat"], self.M, strict=True)]
        if self.E and self.delay:
            waited = old["late_cut"][0]
            new["x_hat"] = [v + self.row(a, waited) for v, a in zip(new["x_hat"], self.E, strict=True)]
        known = [*new["x_hat"][self.n :], *new["eta_hat"], *new["w"]]
        new["i"] = self.cell_of(new["x_hat"])
        new["j"] = self.cell(self.program.sides, [self.row(guard, known) for guard in self.guards])
        new["x_d"] = [self.row(a, known) for a in self.x_d[new["j"]]]
        acts = new["x_hat"]
        for waiting in old["late"] if self.M else ():
            acts = self.predicted(waiting, acts)
        put, cut, new["before"] = [], [], list(old["before"])
        for b in range(self.m):
            v = self.row(self.u_ff[new["j"]][b], known)
            for a in range(self.n):
                v = v + self.K[b][a] * (acts[a] - new["x_d"][a])
            least, most = new["before"][b] - self.change[b], new["before"][b] + self.change[b]
            if not isfinite(v - new["before"][b]):
                return -1
            wanted = v
            v = least if v < least else most if v > most else v
            v = self.low[b] if v < self.low[b] else self.high[b] if v > self.high[b] else v
            new["before"][b] = v
            cut.append(v - wanted)
            if self.quantum[b]:
                v = self.quantum[b] * self.real(floor(v / self.quantum[b] + self.real(0.5)))
            put.append(v)
        queue, cuts = [*old["late"], put], [*old["late_cut"], cut]
        if self.E and not self.delay:
            new["x_hat"] = [v + self.row(a, cut) for v, a in zip(new["x_hat"], self.E, strict=True)]
        new["u"], new["late"], new["late_cut"], new["run"] = queue[0], queue[1:], cuts[1:], True
        if not all(isfinite(v) for name in ("y", "u", "x_hat", "eta_hat", "w", "x_d", "before") for v in new[name]):
            return -1
        self.state = new
        return status

    def cell_of(self, x_hat: Any) -> int:
        values = [self.row(H, x_hat[: self.n]) + h for H, h in zip(self.H, self.h, strict=True)]
        return self.cell(self.program.signs, values)

    def predicted(self, u: Any, x_hat: Any) -> Any:
        for _ in range(self.program.substeps):
            i = self.cell_of(x_hat)
            x_hat = [self.row(a, [*u, *x_hat]) for a in self.observer[i]]
        return x_hat

    def followed(self, old: Any, new: Any) -> None:
        """Set-points, of which w is made."""
        h, made, new["course"], new["past"] = self.real(self.program.sampling.sample_time), [], [], []
        parts = zip(self.pace, old["course"], old["past"], new["w"], strict=True)
        for k, ((_, *limits), (d, v, a, r), past, given) in enumerate(parts):
            zero = self.real(0.0)
            given = self.ranged(k, given)
            now = (d + (given - r), v, a)
            d_end = self.pursued(now, zero, self.real(2.0**100), limits)[0][0]
            aim = limits[0] if d_end > 0 else -limits[0] if d_end < 0 else zero
            early, width = zero, h
            for _ in range(25):
                width = self.real(0.5) * width
                after, _ = self.pursued(now, aim, early + width, limits)
                d_end = self.pursued(after, zero, self.real(2.0**100), limits)[0][0]
                if (-d_end if aim < 0 else d_end) >= 0:
                    early = early + width
            after, _ = self.pursued(now, aim, early, limits)
            after, left = self.pursued(after, zero, h - early, limits)
            eps, steps = np.finfo(self.real).eps, enumerate(limits[:3], 1)
            near = self.real(np.sqrt(eps) * min(float(m) * self.program.sampling.sample_time**k for k, m in steps))
            if left > 0 and -near < after[0] < near:
                after = (zero, *after[1:])
            degree = min(self.program.sizes["s"] // len(self.pace) - 1, 3)
            top = (now[0] - after[0]) / h if degree == 1 else (after[degree - 1] - now[degree - 1]) / h
            row, later = [given - now[0], *now[1:degree], top], []
            for window in past:
                later.append([tuple(row), *window[:-1]])
                row = self.mean(row, window)
            new["past"].append(later)
            made.append([self.ranged(k, row[0]), *(max(-m, min(v, m)) for v, m in zip(row[1:], limits, strict=False))])
            new["course"].append([*after, given])
        new["w"] = [value for values in zip(*made, strict=True) for value in values]

    def ranged(self, k: int, value: Any) -> Any:
        """A set-point, or what is made of it, within its range."""
        low, high = map(self.real, self.program.set_range[k]) if len(self.program.set_range) else (-np.inf, np.inf)
        return value if not isfinite(value) else low if value < low else high if value > high else value

    def mean(self, row: Any, window: Any) -> Any:
        """The mean over a window, newest first, that ends with a row: it has one more derivative."""
        h, N, half = self.program.sampling.sample_time, len(window), self.real(0.5)
        total = half * (window[-1][0] - row[0])
        for before in window[:-1]:
            total = total + (before[0] - row[0])
        total = total / self.real(N) - self.real(h / (12 * N)) * (row[1] - window[-1][1])
        return [row[0] + total, *((new - old) / self.real(N * h) for new, old in zip(row, window[-1], strict=True))]

    def pursued(self, at: Any, target: Any, left: Any, limits: Any) -> Any:
        """Go on for a time towards a speed: where that ends, and what is left of the time."""
        half, third, zero = self.real(0.5), self.real(1 / 3), self.real(0.0)
        (d, v, a), (_, largest, jerk) = at, limits[:3]
        gap, bend = target - v, half * (a * a / jerk)
        up = gap >= (-bend if a < 0 else bend)
        gap, lean, rise = (gap, a, jerk) if up else (-gap, -a, -jerk)
        turned = half * (lean * lean)
        peak, hold = self.real(np.sqrt(abs(jerk * gap + turned))), zero
        if peak > largest:
            peak = largest
            hold = (gap - (peak * peak - turned) / jerk) / peak
        for lasting, bent in (((peak - lean) / jerk, rise), (hold, zero), (peak / jerk, -rise)):
            t = min(max(lasting, zero), left)
            left, more = left - t, t * bent
            d = d - t * (v + t * (half * (a + third * more)))
            v, a = v + t * (a + half * more), a + more
        return ((d - left * target, target, zero) if left > 0 else (d, v, a)), left

    def turned(self, new: Any) -> None:
        new["tick"] += 1
        new["since"] += 1
        if new["since"] == 2**20 and len(self.turn) == 3:
            new["w2"] = [self.row(a, new["w2"]) for a in self.turn[2]]
            new["w1"] = new["w"] = new["w2"]
            new["since"] = 0
        elif new["since"] % 2**10 == 0 and len(self.turn) >= 2:
            new["w1"] = [self.row(a, new["w1"]) for a in self.turn[1]]
            new["w"] = new["w1"]
        else:
            new["w"] = [self.row(a, new["w"]) for a in self.turn[0]]
        for piece, w in self.pieces:
            if piece.tick == new["tick"]:
                new["w"] = [*new["w"][: piece.start], *w, *new["w"][piece.start + len(w) :]]
                new["w1"] = new["w2"] = new["w"]
                new["since"] = 0
