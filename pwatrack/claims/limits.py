"""From which starts no limit of an input is reached: what is searched, proved, stored and said of it.

As long as no limit is reached, the loop is the one without limits. So if in that one |u − u_ff| is at most what is left
beside u_ff at all times, from a start, no limit is ever reached from there, and all that is proved holds with limits.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import numpy as np

from pwatrack.arrays import Array, alike, number_text, outward
from pwatrack.ball_matrix import BallMatrix, above
from pwatrack.claims.bounds import loops_of
from pwatrack.claims.exact_text import Held, decimal, decimal_texts, doubles, held_content, read_held, signals
from pwatrack.control.bounds import Form, Loop, Loops
from pwatrack.control.controller import Asked, Claim, ProvedController, Row, Told
from pwatrack.control.headroom import OFF, Headroom, Peak, Starts
from pwatrack.control.words import Words, down
from pwatrack.lmi.ellipsoid import held

WITHOUT = " while no load acts"  # where loads are estimated
_NOTHING = "takes the whole limit: nothing is left"
_ROUNDING = 1e-12  # of the 1 that a load at an input is taken off it with


@dataclass(frozen=True, kw_only=True)
class StartGuarantee:
    """By how much inputs, or signals of x, are not what they are to be, from some starts, in the loop as designed."""

    starts: Starts  # which
    loop: Loop  # of which loop the ellipsoid is: of e alone, or of (e, Δ)
    inputs: tuple[int, ...]  # those that have limits, or places in `forms`
    held: Held | None  # the ellipsoid, or what stands for it; None where none of them is moved
    # how large the loads at each of these inputs are together; their estimates make the input differ by that
    loads: tuple[float, ...]
    forms: tuple[Form, ...] = ()  # what it is about where it is not about inputs

    @property
    def _sizes(self) -> tuple[float, ...]:
        return self.held.sizes if self.held else (0.0,) * len(self.inputs)

    def scale(self, left: Array) -> float:
        """Return how many times as large a start may be, so that each |u − u_ff| ≤ left, (m,); rounded down."""
        return min(self._ratios(left).values(), default=np.inf) * (1 - 1e-12)

    def binds(self, left: Array) -> int:
        """Return which of them has the least left beside what the starts make of it."""
        ratios = self._ratios(left)
        return min(ratios, key=ratios.__getitem__)

    def _ratios(self, left: Array) -> dict[int, float]:
        """Return what is left of each of them that is moved, over what the starts make of it."""
        moved = (size + load for size, load in zip(self._sizes, self.loads, strict=True))
        return {k: float(left[k]) / size for k, size in zip(self.inputs, moved, strict=True) if size}

    def outline(self, left: Array, plane: Sequence[int], directions: Array) -> Array | None:
        """Return how far x − x_d may be off in two states, all other errors 0, along directions (s, 2): points (s, 2).

        None where it is about no such start, or about all.
        """
        scale = self.scale(left)
        if self.held is None or not 0 < scale < np.inf:
            return None
        rays = np.zeros((len(directions), len(_rows(self.starts))))
        rays[:, plane] = directions
        return np.asarray(scale * self.held.reach(rays)[:, None] * directions)

    def said(self, left: Array, *, loads: bool) -> str:
        """Say from which starts it is that each |u − u_ff| ≤ left, (m,), of a plant with or without loads."""
        scale, kind = self.scale(left), self.starts.kind
        much = f"up to {down(scale)} times its size" if np.isfinite(scale) else "whatever it is"
        if kind == "exact":
            idle = f",{WITHOUT}" if loads else ""
            return f"each |x_k − x_dk| {much} and x̂ = x{idle}"
        if kind == "sizes":
            acting = "" if self.starts.load is None else " and each load"
            return f"each |x_k − x_dk| and |x̂_k − x_k|{acting} {much}"
        starts = "the start of this run" if kind == "run" else "the starts of its ensemble"
        starts += " with its loads" if self.starts.load is not None else ""
        starts = starts if scale >= 1 else f"{down(scale)} times the errors of {starts}"
        return starts + " with x̂ = x" * (kind == "members")

    def of_this_run(self, left: Array | None) -> bool:
        """Whether it is of the start of the run, where the feedforward leaves so much, (m,)."""
        return left is not None and self.starts.kind == "run" and self.scale(left) >= 1

    def figures(self, left: Array, names: Sequence[str]) -> dict[str, Any]:
        scale, of = self.scale(left), [names[k] for k in self.inputs]
        return {
            "starts": self.starts.kind,
            "scale": float(scale) if np.isfinite(scale) else None,
            "inputs": dict(zip(of, self._sizes, strict=True)),
            "loads": dict(zip(of, self.loads, strict=True)),
        }

    @property
    def data(self) -> dict[str, Any]:
        """What a certificate holds of it."""
        assert self.held is not None
        kind: Literal["drive", "input"] = "input" if self.starts.load is None else "drive"
        return {
            "of": self.starts.kind,
            "loop": self.loop,
            "starts": decimal_texts(_rows(self.starts)),
            "weights": [decimal(w) for w in self.held.weights],
            "signals": signals(
                (self.forms[k] if self.forms else (kind, k), size)
                for k, size in zip(self.inputs, self.held.sizes, strict=True)
            ),
            **held_content(self.held),
        }


@dataclass(frozen=True, kw_only=True)
class NoSaturation(Claim):
    """Limits of the inputs: what the feedforward takes of them, and from which starts none is reached."""

    room: Headroom  # what the feedforward leaves
    promises: tuple[StartGuarantee, ...] = ()  # what is proved of some starts

    statement: ClassVar[str] = (
        "Under limits: from every start (x - x_d, x_hat - x) = starts v with |v_k| <= 1, or x - x_d = starts v with "
        "x_hat = x, loads and their estimates at 0, how far u may be from u_ff at any time; drive: with constant loads "
        "at inputs (x - x_d, x_hat - x, s_hat - s) = starts v, u_ff without estimates, and u + s for u."
    )
    nothing: ClassVar[Mapping[str, Any]] = {"limits": []}

    @classmethod
    def prove(cls, controller: ProvedController, asked: Asked, told: Told = None) -> Iterator["NoSaturation"]:
        """Yield what is known of limits where there are some; of starts only where nothing else acts."""
        if (room := asked.room) is not None:
            alone = controller.running is controller.plant  # else what is merged acts too
            found = promises(controller, room.left, room.starts, told) if alone and room.left is not None else ()
            yield cls(room=room, promises=found)

    def data(self, controller: ProvedController) -> dict[str, Any]:
        return {"limits": [promise.data for promise in self.promises if promise.held is not None]}

    def figures(self, words: Words, controller: ProvedController) -> dict[str, Any]:
        room, left, names = self.room, self.room.left, words.plant.inputs
        inputs = {
            names[k]: {
                "limits": [float(v) if np.isfinite(v) else None for v in room.limits[k]],
                "feedforward": None if room.peak is None else _peak(room.peak, k),
                "lasting": None if room.lasting is None else _peak(room.lasting, k),
                "left": None if left is None else float(left[k]),
            }
            for k in room.inputs
        }
        said = [p.figures(left, names) for p in self.promises if left is not None]
        return {"limits": {"inputs": inputs, "ever": room.ever, "starts": said}}

    def rows(self, words: Words, controller: ProvedController) -> Iterator[Row]:
        loads = controller.plant.loads is not None
        for k, text in enumerate([*self._takes(words, WITHOUT * loads), *self._reaches(words, loads=loads)]):
            yield "" if k else "limits", text

    def _takes(self, words: Words, idle: str) -> Iterator[str]:
        """Yield what the feedforward takes of each limit, without loads that are estimated."""
        room = self.room
        for k in room.inputs:
            name, unit = words.plant.inputs[k], words.units.get(words.plant.inputs[k], "")
            low, high = (number_text(float(v), "g") for v in room.limits[k])
            said = f"{name} from {low} to {high} {unit}".rstrip()
            if room.peak is None:
                yield f"{said}: x_d takes too long to follow, so what its feedforward takes is not known"
                continue
            takes = f"its feedforward takes {_range(room.peak, k, unit)}{idle}"
            if any(input_ == k for input_, _ in room.peak.beyond(room.limits)):
                after = f"; once that start is forgotten {_range(room.lasting, k, unit)}" if room.lasting else ""
                yield f"{said}: {takes}, more than that, from where the generator starts{after}"
            else:
                over = float(room.peak.left(room.limits)[k])
                much = f"leaves {outward(over, -1, OFF)} {unit}".rstrip()
                yield f"{said}: {takes}, which {much if over else _NOTHING} for what is off"

    def _reaches(self, words: Words, *, loads: bool) -> Iterator[str]:
        """Yield from which starts no limit is reached: ever, or in this run where more may be taken after it."""
        left = self.room.left
        if left is None:
            return
        never = "no limit is ever reached" if self.room.ever else "no limit is reached in this run"
        for promise in self.promises:
            starts = promise.said(left, loads=loads)
            starts += self.room.whatever_said(promise.starts)
            several = len(promise.inputs) > 1 and np.isfinite(promise.scale(left))
            binds = f"; {words.plant.inputs[promise.binds(left)]} binds" if several else ""
            yield f"in the loop as designed {never}{words.undisturbed} from {starts}{binds}"
        if not self.promises:
            yield f"from which starts {never} could not be proved"

    @property
    def from_this_start(self) -> bool:
        """Whether it is proved that no limit is reached from the start of the run."""
        return any(promise.of_this_run(self.room.left) for promise in self.promises)


def ideal(controller: ProvedController, words: Words) -> str:
    """Return what the loop of the theorems is without, and that no limit is reached from the start of the run."""
    conditions = words.conditions.beside(controller.plant.loads)
    disturbed = " disturbance," * (conditions.disturbance is not None)
    if conditions.undisturbed and any(claim.from_this_start for claim in controller.claims_of(NoSaturation)):
        return "no limit reached from this start; with no noise or sampling"
    return f"with no limits,{disturbed} noise or sampling"


def promises(
    controller: ProvedController,
    left: Array,
    starts: Sequence[Starts],
    told: Told = None,
    forms: tuple[Form, ...] = (),
) -> tuple[StartGuarantee, ...]:
    """Prove from which starts inputs stay near their feedforward, or forms near x_d; what is not proved is not there.

    With x̂ = x they are about e' = (A_i + B K) e, else about (e, Δ) for all pairs of cells, as in `bounds`. Where loads
    are estimated the first is about a time when none acts, and its estimate is 0. The second is looked at where all are
    constants s at inputs: then x_d does not depend on them, and with Δ of x̂ − x and σ = ŝ − s

        u − u_ff = K (e + Δ) − ŝ = (K (e + Δ) − σ) − s,    u_ff without estimates.

    Args:
        left: How far each input may be from its feedforward, (m,); infinite where it has no limit.
        starts: Which starts.
        told: A certificate: then nothing is searched.
        forms: Signals of x − x_d; `left` is about these then.
    """
    loops = loops_of(controller, unmoved=True)
    inputs, found = tuple(int(k) for k in np.flatnonzero(np.isfinite(left))), list[StartGuarantee]()
    entries = [] if told is None else told["limits"]
    known = {one["of"]: one for one in entries if (one["signals"][0][0] not in ("input", "drive")) == bool(forms)}
    for one in starts if told is None else [nearby(one, known) for one in starts]:
        loop: Loop = "controller" if one.delta is None else "joint"
        if loop not in loops.M or not looked_at(controller, one):
            continue
        if forms:
            rows, loads = above(*(loops.row(loop, forms[k]) for k in inputs)), (0.0,) * len(inputs)
        else:
            rows, loads = drive_rows(loops, loop, inputs), loads_at(controller, one, inputs)
        promise = StartGuarantee(starts=one, loop=loop, inputs=inputs, held=None, loads=loads, forms=forms)
        if not one.G.any() or not any(rows.centre.entries()):
            found.append(promise)
            continue
        if told is not None:
            if (entry := known.get(one.kind)) is not None:
                found.append(replace(promise, held=read_held(entry)))
            continue
        tries = (held(loops.M[loop], one.G, rows, left[list(inputs)], inner) for inner in loops.inners[loop])
        best = max((replace(promise, held=h) for h in tries if h), key=lambda p: p.scale(left), default=None)
        found += [best] if best else []
    return tuple(found)


def drive_rows(loops: Loops, loop: Loop, inputs: Sequence[int]) -> BallMatrix:
    """Return the rows of u − u_ff and what is taken off for loads, for some inputs."""
    kind: Literal["drive", "input"] = "drive" if loops.n < loops.N and loop == "joint" else "input"
    return above(*(loops.row(loop, (kind, k)) for k in inputs))


def loads_at(controller: ProvedController, starts: Starts, inputs: Sequence[int]) -> tuple[float, ...]:
    """Return how large the loads at each of these inputs are together."""
    if starts.load is None or not starts.load.any():
        return (0.0,) * len(inputs)
    acting, at = np.abs(starts.load).sum(axis=1), np.array(controller.plant.load_inputs, dtype=int)
    return tuple(float(acting[at == k].sum()) for k in inputs)


def taken_off(controller: ProvedController) -> bool:
    """Say whether estimates of loads, if any, do nothing but to be taken off the input that each load is added to."""
    added, at = controller.compensation, controller.plant.load_inputs
    if not at or any(added.X.centre.entries()) or added.X.radius is not None:
        return controller.plant.loads is None
    off = added.u_ff + np.eye(added.u_ff.shape[1])[:, list(at)]
    return bool(np.abs(off).max() <= _ROUNDING and np.abs(added.rate).max(initial=0.0) <= _ROUNDING)


def looked_at(controller: ProvedController, starts: Starts) -> bool:
    """Say whether starts can be looked at: with another x̂ loads act too, and are to be taken off inputs."""
    told = (starts.load is None) == (controller.plant.loads is None)
    return starts.delta is None or (told and taken_off(controller))


def nearby(starts: Starts, entries: dict[str, Any]) -> Starts:
    """Return starts as a certificate has them, if it has: those of a run follow from a simulation, to rounding."""
    G, n = _rows(starts), len(starts.e)
    told = doubles(entries[starts.kind]["starts"]) if starts.kind in entries else G
    G = np.pad(G, ((0, max(len(told) - len(G), 0)), (0, 0)))  # Δ = 0, where it is about (e, Δ) all the same
    if not alike(told, G, together=True):
        return starts
    if starts.z is not None:
        return replace(starts, z=told)
    delta, load = (rows if len(rows) else None for rows in (told[n : 2 * n], told[2 * n :]))
    return replace(starts, e=told[:n], delta=delta, load=load)


def _rows(starts: Starts) -> Array:
    """Return G as the loop that they are looked at in has it."""
    return starts.G if starts.z is None else starts.z


def _peak(peak: Peak, k: int) -> dict[str, list[float]]:
    return {"range": [float(peak.low[k]), float(peak.high[k])], "times": peak.times[k].tolist()}


def _range(peak: Peak, k: int, unit: str) -> str:
    first, last = peak.times[k].tolist()
    return f"{peak.span(k, unit)} (t = {first:.4g} s, {last:.4g} s)"
