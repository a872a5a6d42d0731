"""A program in whole numbers of 32 bits: its tables, and its step in the notation.

What is remembered is a whole number times a unit of its own, so small that the range that is proved of it just fits.
A row of a table T on such numbers v is, with R of 32 bits and a shift s that all rows of the table share,

    ⌊(R_1 v_1 + … + R_k v_k + 2³¹ R_c + 2^(s − 1)) / 2^s⌋,    R ≈ 2^s T in the units of what it is made of,

in 64 bits, which |R_1| + … + |R_c| ≤ 2³⁰ does not leave; what 32 bits do not hold is cut off at ±(2³¹ − 1), which
counts as no number. Of what is stepped T is by how much it changes, which small numbers say more exactly. Planes have
64 bits and are not rounded. The step is that of `step`, read with these rules.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from pwatrack.arrays import Array, IntArray
from pwatrack.control.program import SampledController
from pwatrack.errors import OutsideTheory
from pwatrack.export.reading import FULL, run
from pwatrack.export.step import PRODUCT, Step, step
from pwatrack.export.whole_notation import ONE, WholeNumbers
from pwatrack.simulation.controller_arrays import routine

_WEIGHT = 30  # bits that the entries of a row have together
_LONGEST = 56  # shift, of tables of small numbers
_LAW = 30  # shift, of the law, at which inputs are held against limits
# Tables that have one shift: what their rows make is added up.
_GROUPS = (
    ("normals", "offsets"),
    ("guards",),
    ("observer",),
    ("outputs",),
    ("correction",),
    ("windup",),
    ("generator",),
    ("desired",),
    ("feedforward", "gain"),
    ("turn",),
)
_BEYOND = "units are for the run: a start and a reference beyond it may be larger"
_SPARE = 2.0**20  # units that rounding may make numbers larger by
_UNUSED = ("timing", "half", "all_whole")  # of set-points, which are not made in whole numbers, and of floors
_WIDE = ("total", PRODUCT, "difference", "worst", "least", "value", "last", "g")  # numbers of 64 bits


def unit_of(largest: Array) -> Array:
    """Return the smallest powers of two of which 2³¹ are more than some numbers; 2⁻³¹ for those that are 0.

    Example:
        >>> (unit_of(np.array([1.0, 3.0, 0.0])) * 2.0**31).tolist()
        [2.0, 4.0, 1.0]
    """
    return np.asarray(np.ldexp(1.0, np.where(largest > 0, np.frexp(largest)[1], 0) - 31))


@dataclass(frozen=True, kw_only=True)
class FixedPoint:
    """A program in whole numbers."""

    program: SampledController  # in floats
    units: Mapping[str, Array]  # what 1 is of y, u, x_hat, s_hat, eta_hat, w, planes of x̂, guards of x_d
    starts: Mapping[str, Array]  # of x̂ with ŝ, η̂ and w, in floats: `start_x_hat`, `start_eta_hat`, `start_w`

    one: ClassVar = float(ONE)  # what stands for 1 beside numbers
    largest: ClassVar = FULL - 1.0  # number that counts, in units

    @cached_property
    def counted(self) -> SampledController:
        """The program in these units, with 1 as 2³¹, still in floats; of what is stepped by how much it changes."""
        of, units = self.program, self.units
        x, y, u, known, eta = self.x, units["y"], units["u"], self.known, units["eta_hat"]
        N, m, p, loads = len(x), len(u), len(eta), len(units["s_hat"])

        def rows(table: Array, to: Array, by: Array) -> Array:
            return table * by / to[:, None]

        turn = rows(of.follows.turn, units["w"], units["w"]) - np.eye(len(units["w"])) if of.follows else np.zeros(0)
        most = len(turn) and next((k for k, each in enumerate(turn) if _shift(each) < 0), len(turn))
        follows = (
            of.follows
            and replace(
                of.follows,
                turn=turn[: max(most, 1)],  # what grows goes on by single samples
                w0=of.follows.w0 / units["w"],
                pieces=tuple(
                    replace(one, w=one.w / units["w"][one.start : one.start + len(one.w)]) for one in of.follows.pieces
                ),
            )
        )
        return replace(
            of,
            H=rows(of.H, units["planes"], units["x_hat"]),
            h=of.h / units["planes"],
            guards=rows(of.guards, units["guards"], known),
            observer=rows(of.observer, x, np.concatenate([u, x, [1 / ONE]])) - np.eye(N, m + N + 1, m),
            C=rows(of.C, y, x),
            M=rows(of.M, x[: len(of.M)], y),
            E=rows(of.E, x[: len(of.E)], u),
            generator=rows(of.generator, eta, known) - np.eye(p, len(known), loads),
            x_d=rows(of.x_d, units["x_hat"], known),
            u_ff=rows(of.u_ff, u, known),
            K=rows(of.K, u, units["x_hat"]),
            limits=_within(of.limits / u[:, None]),
            change=_within(of.change / u),
            quantum=of.quantum / u,
            follows=follows,
        )

    def counts(self, name: str, values: Array) -> IntArray:
        """Return how many units numbers of a kind are, (…, k), cut off where 32 bits end; k = 0 where none are."""
        return _whole(np.clip(values / (self.units[name] if values.shape[-1] else 1.0), -FULL, FULL))

    @property
    def x(self) -> Array:
        """Units of (x̂, ŝ)."""
        return np.concatenate([self.units["x_hat"], self.units["s_hat"]])

    @property
    def known(self) -> Array:
        """Units of (ŝ, η̂, w, 1)."""
        return np.concatenate([*(self.units[name] for name in ("s_hat", "eta_hat", "w")), [1 / ONE]])

    @cached_property
    def _made(self) -> tuple[Step, dict[str, int]]:
        """The step of `counted`, and by how many bits sums with each table are shifted."""
        of = {"start_x_hat": self.x, "start_eta_hat": self.units["eta_hat"], "start_w": self.units["w"]}
        made = step(routine(self.counted), {name: values / of[name] for name, values in self.starts.items()})
        return made, _shifts({name: values for name, (_, values) in made.constants.items() if name != "turn"})

    @cached_property
    def step(self) -> Step:
        """Its step, in the notation. What `wide`, `nearest`, `narrowed` and `stepped` do is in `reading`."""
        made, shifts = self._made
        constants = {name: each for name, each in made.constants.items() if name not in _UNUSED}
        constants["largest"] = ("real", np.array(FULL - 1.0))
        if "turn" in constants:  # of which each has a shift of its own
            turn = constants["turn"][1]
            by = 2.0 ** np.array([_shifts({"turn": each})["turn"] for each in turn])
            constants |= {"turn": ("real", turn * by[:, None, None]), "turn_unit": ("wide", _whole(by))}
        for name, (kind, values) in constants.items():
            if kind == "real":
                whole = _whole(values * 2.0 ** shifts.get(name, 0))
                if name != "offsets" and np.abs(whole).max(initial=0) > FULL:
                    raise OutsideTheory(f"whole numbers of 32 bits do not hold '{name}'", hint=_BEYOND)
                constants[name] = "wide" if name == "offsets" else kind, whole
        own = tuple(replace(each, kind="wide") if each.name in _WIDE else each for each in made.own)
        kinds = {name: kind for name, (kind, _) in constants.items()} | dict.fromkeys(("y", "u", "given"), "real")
        text = WholeNumbers(shifts, kinds | {each.name: each.kind for each in (*made.kept, *own)}, len(self.units["u"]))
        read: Any = {part: text.of(getattr(made, part)) for part in ("body", "begin", "hold")}
        return replace(made, constants=constants, own=own, **read)

    def off(self, table: str, sizes: Array) -> Array:
        """Return by how much rounding the entries of a table moves its rows on what is so large, in units, at most."""
        made, shifts = self._made
        exact, by = made.constants[table][1], 2.0 ** shifts[table]
        return most(np.abs(_whole(exact * by) / by - exact), sizes)

    def kept(self, sizes: Array) -> Array:
        """Return by how much numbers of some sizes are rounded as they are read or kept, in units."""
        return np.full(len(sizes), 0.5)

    @property
    def spare(self) -> Mapping[str, Array]:
        """What numbers may be more than with real numbers, in units."""
        return {name: np.full(len(unit), _SPARE) for name, unit in self.units.items()}

    def along(self, program: SampledController, given: Array) -> dict[str, Array]:
        """Return what `single_floats.along` does in these units; OutsideTheory if a number leaves its 32 bits."""
        of, nothing = replace(self, program=program), np.zeros((len(given), len(self.units["y"])), dtype=np.int64)
        found = run(of.step, nothing, of.counts("w", given))
        if (found["status"] < 0).any():
            raise OutsideTheory("whole numbers of 32 bits do not hold the reference, or the start of x_hat")
        at, units = program.places, self.units
        real = {name: found["v"][:, at[name]] * units[name] for name in ("eta_hat", "w")}
        return {**real, "x_d": found["x_d"] * units["x_hat"], "cell_d": found["cell_d"]}


def most(off: Array, sizes: Array) -> Array:
    """Return rows of tables (…, k) times sizes (k,), of all cells the most; of a list of offsets for the size 1."""
    each = (off[:, None] if off.ndim == 1 else off) @ sizes
    return np.asarray(each.max(axis=0) if each.ndim > 1 else each)


def _within(limits: Array) -> Array:
    """Return limits in units as 32 bits hold them: what is beyond limits nothing."""
    return np.where(np.isfinite(limits), np.clip(limits, 1 - FULL, FULL - 1), limits)


def _whole(values: Array) -> IntArray:
    return np.asarray(np.rint(values), dtype=np.int64)


def _shifts(tables: Mapping[str, Array]) -> dict[str, int]:
    """Return by how many bits sums with each table are shifted; OutsideTheory if rows weigh too much for 30 bits."""
    found = dict[str, int]()
    for group in _GROUPS:
        there = [name for name in group if name in tables]
        weighed = {name: tables[name] for name in there}  # in 2³¹ of what each is of
        if "offsets" in weighed:  # which have 64 bits
            weighed["offsets"] = weighed["offsets"][:, None] / ONE
        if "gain" in weighed:  # of differences of two numbers
            weighed["gain"] = 2 * weighed["gain"]
        shift = _shift(*weighed.values())
        if shift < 0:
            raise OutsideTheory(f"whole numbers of 32 bits: '{there[0]}' makes numbers 2^{-shift} times too large")
        found |= dict.fromkeys(there, min(shift, _LAW if "gain" in group else _LONGEST))
    return found


def _shift(*tables: Array) -> int:
    """Return by how many bits sums with some tables, row by row, may be shifted."""
    most = float(np.max(sum(np.abs(each).sum(axis=-1) for each in tables), initial=0.0))
    return _WEIGHT - (int(np.frexp(most)[1]) if most else 0)
