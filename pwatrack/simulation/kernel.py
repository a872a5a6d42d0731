"""The compiled walk along a trajectory, from event to event, with no ODE solver: as in `docs/theory/events.md`.

Inside a mode ż = F z. A step of length h is taken at once if no guard g can reach 0 on it: a guard differs from its
chord by at most h²/8 sup |g F² e^{Fσ}| |z|; where that does not settle it, with v = F z, a = F v,

    g z(τ) ≥ g z − ∫|g e^{Fσ}|dσ |v|,   g z(τ) ≥ min(g z, g z + h g v) − ∫(h − σ)|g e^{Fσ}|dσ |a|.

All these bounds hold for the numbers as they are rounded: what g z, v, a, g v and the state at the end of the step can
be off by is added to them. Else the guard is a Taylor polynomial in τ ∈ [0, 1] on the finest step (Farouki, The
Bernstein polynomial basis: a centennial retrospective, CAGD 29, 2012).

Time is in finest steps here. All compiled functions live in this one file: the cache of compiled code is renewed when
the file of a function changes, but not when that of a function it calls does.
"""

import math
from collections import namedtuple
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, ParamSpec, TypeVar

import numpy as np
from numba import njit

from pwatrack.arrays import Array, IntArray
from pwatrack.compilation import listen

SAME_TIME = 1e-12  # relative, or in s before t = 1 s
MOST_IDLE = 1000  # crossings without progress in time
_DOUBLED = 20  # times at most that rounding counts twice where crossings come back
PIECES = 32  # of a step: more than how often it is halved
_FINEST = 2.0**-26  # a piece so short that a polynomial without monotony on it stays within rounding of 0
_VAGUE = 2.0**-22, 2.0**-30  # times known to this part of the finest step, or of a sample time, are known

listen()

_P = ParamSpec("_P")
_R = TypeVar("_R")


def jitted(function: Callable[_P, _R], **options: Any) -> Callable[_P, _R]:
    """Return the compiled function; with a name for others than this module, it is kept on disk."""
    compiler: Any = njit  # its types do not know every option
    kept = not function.__name__.startswith("_")  # what Python calls is kept on disk, with all that it calls
    options |= {"no_cpython_wrapper": not kept, "no_cfunc_wrapper": True}  # by which nobody calls, and which take time
    try:
        compiled = compiler(cache=kept, nogil=True, **options)(function)
    except RuntimeError:  # no folder for the cache is writable
        return compiler(nogil=True, **options)(function)  # type: ignore[no-any-return]
    if kept and hasattr(compiled, "_cache"):  # NUMBA_DISABLE_JIT leaves it as it is
        _forget_unreadable(compiled._cache)
    return compiled  # type: ignore[no-any-return]


def _forget_unreadable(cache: Any) -> None:
    """Forget what an earlier version left on disk, if that names types that are gone: Numba's reading it would fail."""
    try:
        cache._cache_file._load_index()
    except (AttributeError, ImportError):
        try:
            cache.flush()
        except OSError:  # nothing can be written there either
            cache.disable()


_FUSED = {"contract"}  # a b + c may be rounded once


_compiled = partial(jitted, fastmath=_FUSED)
# A part of the controller's program: every operation is rounded once, in the order that is written. It is said that it
# is not fused, or Numba takes that of whoever calls it.
_as_written = partial(jitted, fastmath=False)
# The walk allocates nothing: counting references to the arrays of `Workspace` took twice as long as the steps do.
_uncounted = partial(jitted, fastmath=_FUSED, _nrt=False)
# A part of the walk is put where it is called, before anything is compiled. Compiled on its own, each was compiled
# again within each that calls it: with what only Python or C calls each by, that was half of the time to compile.
# Handing over the arrays of `Workspace` took a third of that of the steps.
_inlined = partial(_uncounted, inline="always")


class FlowTables(NamedTuple):
    """A flow of order N with P parts, C cells and K guards in all, and the grid of steps."""

    first: IntArray  # first cell of each part, and C, (P + 1,)
    guards: Array  # rows on z, transposed, (N, K)
    signs: IntArray  # side of each guard that each cell is on; 0 for guards of other parts, (C, K)
    h: float  # the finest step in s
    doublings: int  # the longest step, from sample to sample, is 2^doublings finest ones
    unit: float  # what a product of matrix and vector can be off by, relative to the sum of the sizes of its terms


class Resets(NamedTuple):
    """What jumps, and when: R resets in order."""

    step: Array  # when, in finest steps, (R,)
    row: IntArray  # where in `values` the new ones are, or -1 where the controller's program runs, (R,)
    start: IntArray  # which entries take new values, with `stop`, (R,)
    stop: IntArray
    values: Array  # (V, N)
    counted: Array  # rows that entries are counted from, transposed: where these jump, such an entry does not, (N, N)


# Sizes of a controller (known: of ŝ, η̂ and w together), by how many samples its inputs are late, and where in its
# memory, and in the room beyond it, each part begins: see `Program.places`.
Places = namedtuple(
    "Places",
    "q m n N p s known delay ahead substeps "
    "y u x_hat s_hat eta_hat w copies course past late late_cut before wanted change x_d g source cut seen moved "
    "missed going lasting bending made",
)


class ControllerArrays(NamedTuple):
    """The program of a sampled controller, all of the same type of float: see `control.program.Program`."""

    at: Places
    H: Array  # from here to `sides`: as there
    h: Array
    observer: Array
    C: Array  # none where nothing is corrected
    M: Array
    E: Array  # none where nothing is done against windup
    generator: Array
    x_d: Array
    u_ff: Array
    K: Array
    guards: Array
    signs: IntArray
    sides: IntArray
    turn: Array  # w 1, 2¹⁰ and 2²⁰ samples later, as far as in range; none: w comes from outside, (0 … 3, s, s)
    piece_values: Array  # new values of entries of w
    piece_tick: IntArray  # from when on entries have them, (pieces,)
    piece_start: IntArray  # the first of these entries
    piece_length: IntArray  # how many
    piece_value: IntArray  # where in `piece_values` theirs begin
    low: Array  # limits of the inputs, with `high`, (m,)
    high: Array
    change: Array  # by how much an input may change in a sample, (m,)
    quantum: Array  # its steps, (m,)
    pace: Array  # of set-points: as there, and last how far from one counts as there, (outputs, 5 … 7)
    lowest: Array  # what set-points may be, with `highest`, infinite for any, (outputs,)
    highest: Array
    timing: Array  # the sample time, ½, ⅓, longer than anything lasts, 0, (5,)
    windows: IntArray  # over how many samples each derivative above the jerk is a mean, (outputs, 0 … 2)
    window_start: IntArray  # where in `past` its samples begin
    weights: Array  # how many they are, how long, and what the ends count besides, (outputs, 0 … 2, 3)
    half: Any  # ½
    most: int  # how many pieces begin at one tick at most
    end: int  # the last tick at which the reference is defined, -1 if there is none
    last: int  # the last tick that is asked for, -1 if none is


class ControllerClock(NamedTuple):
    """How a program sits in the loop."""

    routine: ControllerArrays
    measured: Array  # rows of the measured output on z, transposed, (N, q)
    quantum: Array  # what it is measured in whole multiples of, 0 for any value, (q,)
    source: IntArray  # which of the program's numbers are in z, (V,)
    place: IntArray  # and where
    scale: Array  # these, in z, are so many times as large, powers of two, (V,)


class ModeTables(NamedTuple):
    """What is known of each mode met so far; matrices are transposed, so that products run along rows."""

    cells: IntArray  # cell of each part, counted over all parts, (M, P)
    sides: IntArray  # side of every guard, 0 where it does not bound the mode, (M, K)
    F: Array  # F h, (M, N, N)
    degree: IntArray  # Taylor terms of e^{F h} beyond it are rounding in every entry; a multiple of four less one, (M,)
    longest: IntArray  # most doublings at which nothing below is beyond the largest number, (M,)
    growth: Array  # e^{F h 2^d} − 1 for d doublings, (M, D, N, N)
    margin: Array  # |z| times it is how far from 0 a guard must be at both ends of a step, (M, D, N, K)
    first: Array  # bounds on the first of the two integrals above, (M, D, N, K)
    second: Array  # and on the second
    rounding: Array  # |z| times it: below, a guard cannot be told from 0 on a finest step, (M, N, K)


class Log(NamedTuple):
    """What the walk writes down; times are in s."""

    z: Array  # samples, (S, N)
    mode: IntArray  # number of the mode at each, (S,)
    event_time: Array  # when the mode changed: the first is the start; there is room for more
    event_mode: IntArray  # and to which
    near_time: Array  # from when on a guard was within rounding of 0 and no sign can be given
    near_guard: IntArray
    near_span: Array  # for how long
    break_time: Array  # when it went on anew: after each crossing and each reset
    break_mode: IntArray
    break_z: Array


class KernelState(NamedTuple):
    """A trajectory on its way: where it is, and what it goes by."""

    state: Any  # where the walk is, one record of STATE
    z: Array  # (N,)
    near_since: Array  # since when in s each guard is within rounding of 0; infinite where it is not, (K,)
    crossed: Any  # whether each guard was crossed just now, (K,)
    cells: IntArray  # found last; those of a mode that is new are left here, (P,)
    memory: Array  # of the controller's program, with `counts`: see `tick`
    counts: Any
    room: Array  # for it to work in
    y: Array  # what it measures, (q,)


class Workspace(NamedTuple):
    """Room to work in, so that no step allocates anything."""

    terms: Array  # Taylor terms of the state, (most, N)
    powers: Array  # those of a guard, (most,)
    pieces: Array  # for `first_crossing`
    size: Array  # |z|, (N,)
    v: Array  # what a step adds
    following: Array  # the state after it
    speed: Array  # a bound on |v|
    bend: Array  # and on |a|
    off: Array  # what they can be off by
    off_after: Array
    now: Array  # the guards before a step, (K,)
    then: Array  # and after it
    slope: Array  # their derivatives
    off_slope: Array  # what these can be off by
    slopes: Array  # both bounds, (2, K)
    reach: Array  # how far a guard may come on a step, (K,)
    tolerance: Array  # the size below which it cannot be told from 0
    beyond: Array  # the guards, drawn in towards 0 by it
    touched: Array  # where each guard comes within rounding of 0 on a step
    near: Array  # and from where it stays so
    vague: Array  # when its side is sure
    sides: IntArray  # and which that is


def room_for(N: int, K: int, most: int) -> Workspace:
    """Return room to work in for a state (N,), K guards and so many Taylor terms."""
    of_terms = np.empty((most, N)), np.empty(most), np.empty((PIECES, most + 2))
    of_guards = *np.empty((4, K)), np.empty((2, K)), *np.empty((6, K)), np.empty(K, np.int64)
    return Workspace(*of_terms, *np.empty((7, N)), *of_guards)


STATE = np.dtype(
    [
        ("base", np.int64),  # number of the first sample that the log has room for
        ("k", np.int64),  # whole finest steps so far
        ("done", np.float64),  # part of the next one
        ("inside", np.bool_),  # within a step in which guards may be crossed
        ("settling", np.bool_),  # the mode is to be found from the state
        ("tries", np.int64),  # how often that has been tried
        ("m", np.int64),  # number of the mode
        ("d", np.int64),  # doublings of the last step
        ("fresh", np.bool_),  # `room.now` are the guards at z
        ("resets", np.int64),  # resets carried out
        ("events", np.int64),
        ("nears", np.int64),
        ("breaks", np.int64),
        ("last", np.float64),  # when time last moved on between crossings, in s
        ("idle", np.int64),  # crossings since
        ("guard", np.int64),  # the last guard crossed
        ("left", np.int64),  # steps that may yet be taken
    ]
)
DONE, NEW_MODE, FULL, STUCK, SPENT = range(5)  # why the walk stops
RAN, ENDED, REFUSED = 0, 1, -1  # what comes of running the controller
_TRIALS = 25  # halvings of a sample, of how long it goes on towards a set-point: the next sample makes up for the rest
_RENEWED = 1024  # samples after which a copy of w is renewed, and after the square of which the other one is


@_compiled
def leading(power: Array, tolerance: float) -> int:
    """Return the number of the first coefficient that is not within the tolerance of 0, or how many there are."""
    for j in range(len(power)):
        if abs(power[j]) > tolerance:
            return j
    return len(power)


@_compiled
def first_crossing(power: Array, tolerance: float, pieces: Array) -> tuple[float, float, float]:
    """Return where the polynomial Σ power_j τʲ of degree n first becomes negative on [0, 1), and two places more.

    All are infinity where there is none. They are: the first crossing; before it, the first place where the polynomial
    comes within the tolerance of 0, may or may not be negative, and then is positive again; and the place from which
    on it stays within the tolerance up to τ = 1, without being 0 all the time.

    Leading coefficients within the tolerance count as 0: the trajectory starts on the guard, and the first coefficient
    beyond decides which side it goes to. The tolerance must cover the rounding of the coefficients and of what is done
    with them: see `_to_bernstein` and `_halve`. Pieces are worked on in an array of (32, n + 3) or more.

    Example:
        >>> room = np.empty((32, 18))
        >>> first_crossing(np.array([0.25, -1.0] + 14 * [0.0]), 1e-15, room)
        (0.25, inf, inf)
        >>> first_crossing(np.array([0.26, -1.0, 1.0] + 13 * [0.0]), 1e-15, room)
        (inf, inf, inf)
    """
    n = len(power) - 1
    start = leading(power, tolerance)
    if start > n:
        return np.inf, np.inf, np.inf if leading(power, 0.0) > n else 0.0
    if power[start] < 0:
        return 0.0, np.inf, np.inf
    rest = 0.0
    for j in range(start + 1, n + 1):
        rest += abs(power[j])
    if power[start] > rest + tolerance:
        return np.inf, np.inf, np.inf

    _to_bernstein(power, start, pieces)
    near, touched, top = np.inf, np.inf, 0
    while top >= 0:
        b, low, high = pieces[top], pieces[top, n + 1], pieces[top, n + 1] + pieces[top, n + 2]
        least, most, rising, falling = _extent(b, n)
        first, last, small = b[0], b[n], max(-least, most) <= tolerance
        if least > tolerance:
            top -= 1
        elif first < -tolerance:
            return min(near, low), touched, np.inf
        elif rising or falling or small or high - low < _FINEST:
            if near == np.inf:
                near = low
                if falling and first > 0:
                    near = _root(power, start, low, high) if last < 0 else high
            if last < -tolerance:
                return near, touched, np.inf
            if last > tolerance:
                touched, near = min(touched, near), np.inf
            top -= 1
        else:
            _halve(pieces, top, n)
            top += 1
    return np.inf, touched, near


@_compiled
def _to_bernstein(power: Array, start: int, pieces: Array) -> None:
    """Write Σ power_j τ^(j − start), j ≥ start, in Bernstein's form on [0, 1] to the first piece.

    Behind its coefficients each piece says where it begins, and how wide it is. Each is a mean of partial sums,
    so it is off by no more than Σ |power_j| times n + 1 roundings for degree n.
    """
    n, binomial = len(power) - 1, 1.0
    for j in range(n + 1):
        pieces[0, j] = power[start + j] / binomial if start + j <= n else 0.0
        binomial = binomial * (n - j) / (j + 1)
    for j in range(1, n + 1):
        for i in range(n, j - 1, -1):
            pieces[0, i] += pieces[0, i - 1]
    pieces[0, n + 1], pieces[0, n + 2] = 0.0, 1.0


@_compiled
def _extent(b: Array, n: int) -> tuple[float, float, bool, bool]:
    """Return the least and the largest of n + 1 coefficients, and whether they rise or fall throughout."""
    least, most, rising, falling = b[0], b[0], True, True
    for i in range(n):
        least, most = min(least, b[i + 1]), max(most, b[i + 1])
        rising, falling = rising and b[i + 1] >= b[i], falling and b[i + 1] <= b[i]
    return least, most, rising, falling


@_compiled
def _halve(pieces: Array, top: int, n: int) -> None:
    """Halve the top piece by de Casteljau's algorithm: the right half stays, the left one goes on top.

    That adds n roundings of its largest coefficient, which shrinks from piece to piece towards a root.
    """
    b, left = pieces[top], pieces[top + 1]
    left[0] = b[0]
    for j in range(1, n + 1):
        for i in range(n + 1 - j):
            b[i] = 0.5 * (b[i] + b[i + 1])
        left[j] = b[0]
    left[n + 1], left[n + 2] = b[n + 1], 0.5 * b[n + 2]
    b[n + 2] *= 0.5
    b[n + 1] += b[n + 2]


@_compiled
def _root(power: Array, start: int, low: float, high: float) -> float:
    """Return the root of a polynomial that falls through 0 on [low, high], to 2⁻⁵³: Newton, then bisection."""
    x = 0.5 * (low + high)
    for _ in range(8):
        value, slope = _evaluate(power, start, x)
        if value < 0:
            high = x
        else:
            low = x
        if slope >= 0:
            break
        step = value / slope
        x -= step
        width = 2.0**-52 * max(1.0, 4 * x)
        if abs(step) <= width:
            for edge in (x - width, x + width):
                if low < edge < high:
                    if _evaluate(power, start, edge)[0] < 0:
                        high = edge
                    else:
                        low = edge
            break
        if not low < x < high:
            break
    while high - low > 2.0**-53 * max(1.0, 4 * high):
        x = 0.5 * (low + high)
        if _evaluate(power, start, x)[0] < 0:
            high = x
        else:
            low = x
    return low


@_compiled
def _evaluate(power: Array, start: int, x: float) -> tuple[float, float]:
    """Return Σ power_j x^(j − start) over j ≥ start, and its derivative."""
    value = slope = 0.0
    for j in range(len(power) - 1, start - 1, -1):
        slope = slope * x + value
        value = value * x + power[j]
    return value, slope


@_compiled
def _apply(transposed: Array, z: Array, result: Array, factor: float = 1.0) -> None:
    """Write factor · M z for M given as its transpose; four rows at a time, so that results are stored less."""
    n, j = len(z), 0
    for i in range(len(result)):
        result[i] = 0.0
    while j + 4 <= n:
        z0, z1, z2, z3 = factor * z[j], factor * z[j + 1], factor * z[j + 2], factor * z[j + 3]
        for i in range(len(result)):
            result[i] += (transposed[j, i] * z0 + transposed[j + 1, i] * z1) + (
                transposed[j + 2, i] * z2 + transposed[j + 3, i] * z3
            )
        j += 4
    while j < n:
        z0 = factor * z[j]
        for i in range(len(result)):
            result[i] += transposed[j, i] * z0
        j += 1


@_compiled
def _number(known_cells: IntArray, known: int, cells: IntArray) -> int:
    """Return the number of a mode, or `known` if it is new."""
    for m in range(known):
        same = True
        for p in range(len(cells)):
            same = same and known_cells[m, p] == cells[p]
        if same:
            return m
    return known


@_compiled
def _seen(guards: Array, k: int, terms: Array, power: Array) -> None:
    """Write the Taylor terms of guard k; four at a time, so that sums do not wait for each other."""
    for j in range(0, len(power), 4):
        p0 = p1 = p2 = p3 = 0.0
        for i in range(len(guards)):
            g = guards[i, k]
            p0 += g * terms[j, i]
            p1 += g * terms[j + 1, i]
            p2 += g * terms[j + 2, i]
            p3 += g * terms[j + 3, i]
        power[j], power[j + 1], power[j + 2], power[j + 3] = p0, p1, p2, p3


@_compiled
def _arrive(terms: Array, degree: int, tau: float, z: Array) -> None:
    """Write z(τ) by Horner's rule."""
    for i in range(len(z)):
        z[i] = 0.0
    for j in range(degree, 0, -1):
        for i in range(len(z)):
            z[i] = (z[i] + terms[j, i]) * tau
    for i in range(len(z)):
        z[i] += terms[0, i]


@_inlined
def _sides(F: Array, degree: int, guards: Array, at: KernelState, before: IntArray, room: Workspace) -> None:
    """Write on which side of each guard the trajectory goes on, 0 where rounding hides it, and when that is sure.

    A guard at 0 counts by its first derivative that is not 0: the field is continuous, so that derivative is the same
    on both sides. Where what comes before it is not 0 but within the tolerance, term j decides only after
    (2 tolerance / |term j|)^(1/j) finest steps: `vague` is that time, else 0. It is 0, too, if where another guard is
    crossed all terms say that this one goes on leaving to the side it was on `before`.
    """
    crossed, tolerance, terms, seen = at.crossed, room.tolerance, room.terms, room.now
    sides, vague = room.sides, room.vague
    open_, elsewhere = len(sides), False
    for k in range(len(sides)):
        sides[k], vague[k] = 0, 0.0
        elsewhere = elsewhere or crossed[k]
    for j in range(degree + 1):
        if j == 0:
            for i in range(len(at.z)):
                terms[0, i] = at.z[i]
        else:
            _apply(F, terms[j - 1], terms[j], 1.0 / j)
        _apply(guards, terms[j], seen)
        for k in range(len(sides)):
            if sides[k] != 0:
                continue
            at_root = j == 0 and crossed[k]
            if abs(seen[k]) > tolerance[k] and not at_root:
                sides[k] = 1 if seen[k] > 0 else -1
                open_ -= 1
                if vague[k] < 0.0:
                    vague[k] = 1.0 if sides[k] != before[k] else 0.0
                if vague[k] > 0.0:
                    vague[k] = (2.0 * tolerance[k] / abs(seen[k])) ** (1.0 / j)
            elif at_root or (seen[k] != 0.0 and not (elsewhere and seen[k] * before[k] > 0)):
                vague[k] = 1.0
            elif seen[k] != 0.0 and vague[k] == 0.0:
                vague[k] = -1.0  # so far it leaves
        if open_ == 0:
            return
    for k in range(len(sides)):
        if sides[k] == 0:
            vague[k] = 0.0  # how long it stays hidden is seen as it goes on


@_compiled
def fit(first: IntArray, signs: IntArray, sides: IntArray, cells: IntArray) -> bool:
    """Write the cells that lie on the given sides of the guards, and say whether they are other ones.

    0 fits either side. The present cell of a part is kept if it fits. If rounding leaves no cell that fits, the one
    with the fewest contradictions is taken.
    """
    changed = False
    for p in range(len(cells)):
        best, fewest = -1, len(sides) + 1
        for candidate in range(first[p] - 1, first[p + 1]):
            cell = cells[p] if candidate < first[p] else candidate  # the present one comes first
            wrong = 0
            for k in range(len(sides)):
                wrong += signs[cell, k] * sides[k] < 0
            if wrong < fewest:
                best, fewest = cell, wrong
            if fewest == 0:
                break
        changed = changed or best != cells[p]
        cells[p] = best
    return changed


@_compiled
def _apart(sides: IntArray, now: Array, then: Array, margin: Array) -> bool:
    """Say that no guard that bounds the mode is within its margin of 0 at either end of a step, or beyond.

    The margin is how far the guard can be from the chord between its ends, and how far `now` and `then` can be
    from the guard at these ends.
    """
    apart = True
    for k in range(len(now)):
        apart = apart and (sides[k] == 0 or min(sides[k] * now[k], sides[k] * then[k]) > margin[k])
    return apart


@_compiled
def rounded_product(F: Array, z: Array, doubt: Array, unit: float, result: Array, doubt_after: Array) -> None:
    """Write M z, for M given as its transpose F, and by how much that can be off as z can be, by `doubt`."""
    _apply(F, z, result)
    for i in range(len(result)):
        doubt_after[i] = 0.0
    for j in range(len(z)):
        off = doubt[j] + unit * abs(z[j])
        for i in range(len(result)):
            doubt_after[i] += abs(F[j, i]) * off


@_compiled
def stays_clear(
    sides: IntArray, now: Array, slope: Array, first: Array, speed: Array, second: Array, bend: Array, length: int
) -> bool:
    """Say, more carefully, that no guard that bounds the mode can reach 0 on a step of so many finest ones.

    The guards `now` are drawn in towards 0 by what they can be off by, (K,); their slopes are the least and the largest
    that they can be, (2, K). `first` and `second` are bounds on the two integrals, `speed` and `bend` on |v| and |a|.
    """
    for k in range(len(now)):
        side = sides[k]
        if side == 0:
            continue
        value = side * now[k]
        reach = 0.0
        for i in range(len(speed)):
            reach += first[i, k] * speed[i]
        if value > reach:
            continue
        reach = 0.0
        for i in range(len(bend)):
            reach += second[i, k] * bend[i]
        falls = length * (slope[0, k] if side > 0 else -slope[1, k])
        if not min(value, value + falls) > reach:
            return False
    return True


@_inlined
def _note(s: Any, log: Log, since: float, guard: int, span: float) -> None:
    """Write down that for a while from a time on nobody can say on which side of a guard the trajectory is."""
    log.near_time[s.nears], log.near_guard[s.nears], log.near_span[s.nears] = since, guard, span
    s.nears += 1


@_compiled
def matters(span: float, t: float, field: FlowTables) -> bool:
    """Say whether a doubt of some finest steps about when something happens, at t in s, is worth a word."""
    least = max(_VAGUE[0], _VAGUE[1] * 2.0**field.doublings)
    return span > least and span * field.h > SAME_TIME * max(1.0, t)


@_inlined
def _sample(field: FlowTables, at: KernelState, log: Log) -> None:
    """Write down state and mode where this is the time of a sample."""
    s = at.state[0]
    if s.k & ((1 << field.doublings) - 1) == 0 and s.done == 0.0:
        row = (s.k >> field.doublings) - s.base
        log.mode[row] = s.m
        for i in range(len(at.z)):
            log.z[row, i] = at.z[i]


@_inlined
def _enter(field: FlowTables, at: KernelState, log: Log) -> None:
    """Write down that a mode was entered. Changes within rounding of each other are one; the start is none."""
    s = at.state[0]
    if s.k == 0 and s.done == 0.0 and s.events == 1:
        log.event_mode[0] = s.m
    if s.m == log.event_mode[s.events - 1]:
        return
    t = (s.k + s.done) * field.h
    if s.events > 1 and t - log.event_time[s.events - 1] <= SAME_TIME * max(1.0, t):
        s.events -= 1
        t = log.event_time[s.events]
    if s.m != log.event_mode[s.events - 1]:
        log.event_time[s.events], log.event_mode[s.events] = t, s.m
        s.events += 1


@_inlined
def _settle(field: FlowTables, modes: ModeTables, known: int, at: KernelState, log: Log, room: Workspace) -> bool:
    """Find the mode in which the trajectory goes on from where it is; say whether it has one that is filled in.

    It may take some calls: a mode is right once its own field leads to the sides that it is on. Where crossings come
    back without progress in time, what decided is rounding: twice as much of it counts as none each time.
    """
    s, m, K = at.state[0], at.state[0].m, len(at.crossed)
    t = (s.k + s.done) * field.h
    for i in range(len(at.z)):
        room.size[i] = abs(at.z[i])
    _apply(modes.rounding[m], room.size, room.tolerance)
    if s.idle > 2 and t - s.last <= SAME_TIME * max(1.0, t):
        for i in range(K):
            room.tolerance[i] *= 2.0 ** min(s.idle - 2, _DOUBLED)
    was = modes.sides[log.event_mode[s.events - 1]]
    _sides(modes.F[m], modes.degree[m], field.guards, at, was, room)
    for p in range(len(at.cells)):
        at.cells[p] = modes.cells[m, p]
    if s.tries <= K and fit(field.first, field.signs, room.sides, at.cells):
        found = _number(modes.cells, known, at.cells)
        if found == known:
            return False
        s.m = found
        s.tries += 1
        return True
    s.settling, s.tries = False, 0
    for i in range(K):
        if modes.sides[m, i] == 0:
            at.near_since[i] = np.inf
        elif matters(room.vague[i], t, field):
            _note(s, log, t, i, room.vague[i] * field.h)
    _sample(field, at, log)
    if s.k == 0 and s.done == 0.0:  # from what all that happens at the start leaves
        s.breaks = 0
    log.break_time[s.breaks], log.break_mode[s.breaks] = (s.k + s.done) * field.h, s.m
    for i in range(len(at.z)):
        log.break_z[s.breaks, i] = at.z[i]
    s.breaks += 1
    _enter(field, at, log)
    return True


@_inlined
def _stride(field: FlowTables, modes: ModeTables, free: int, at: KernelState, room: Workspace) -> bool:
    """Take the longest step on the grid, of `free` finest ones, that meets no guard, and say whether there is one."""
    s, m, z = at.state[0], at.state[0].m, at.z
    for i in range(len(z)):
        room.size[i] = abs(z[i])
    d = min(s.d + 1, modes.longest[m])
    while d >= 0 and (s.k & ((1 << d) - 1) != 0 or 1 << d > free):
        d -= 1
    if not s.fresh:
        _apply(field.guards, z, room.now)
    careful = False
    while d >= 0:
        _apply(modes.growth[m, d], z, room.v)
        for i in range(len(z)):
            room.following[i] = z[i] + room.v[i]
        _apply(field.guards, room.following, room.then)
        _apply(modes.margin[m, d], room.size, room.reach)
        if _apart(modes.sides[m], room.now, room.then, room.reach):
            break
        if not careful:
            careful = True  # write how the guards and their slopes are at z, and how fast they may change
            _apply(modes.rounding[m], room.size, room.tolerance)
            for i in range(len(z)):
                room.off_after[i] = 0.0
            rounded_product(modes.F[m], z, room.off_after, field.unit, room.speed, room.off)
            rounded_product(field.guards, room.speed, room.off, field.unit, room.slope, room.off_slope)
            rounded_product(modes.F[m], room.speed, room.off, field.unit, room.bend, room.off_after)
            for i in range(len(z)):
                room.speed[i] = abs(room.speed[i]) + room.off[i]
                room.bend[i] = abs(room.bend[i]) + room.off_after[i]
            for i in range(len(room.now)):
                room.beyond[i] = room.now[i] - modes.sides[m, i] * room.tolerance[i]
                room.off_slope[i] += field.unit * abs(room.slope[i])
                room.slopes[0, i] = room.slope[i] - room.off_slope[i]
                room.slopes[1, i] = room.slope[i] + room.off_slope[i]
        first, second = modes.first[m, d], modes.second[m, d]
        if stays_clear(modes.sides[m], room.beyond, room.slopes, first, room.speed, second, room.bend, 1 << d):
            break
        d -= 1
    s.d, s.fresh = max(d, 0), d >= 0
    if d < 0:
        return False
    for i in range(len(z)):
        z[i] = room.following[i]
    for i in range(len(room.now)):
        room.now[i] = room.then[i]
    s.k += 1 << d
    return True


@_inlined
def _cross(field: FlowTables, modes: ModeTables, length: float, at: KernelState, log: Log, room: Workspace) -> bool:
    """Go on within a finest step, to its first crossing or for a length, and say whether a guard is crossed."""
    s, m, z = at.state[0], at.state[0].m, at.z
    tau, guard = _first_of_all(field, modes, length, at, log, room)
    for i in range(len(at.crossed)):
        if room.touched[i] < tau:
            _note(s, log, (s.k + s.done + room.touched[i] * length) * field.h, i, 0.0)
        if room.near[i] < tau and at.near_since[i] == np.inf:
            at.near_since[i] = (s.k + s.done + room.near[i] * length) * field.h
    _arrive(room.terms, modes.degree[m], min(tau, 1.0), z)
    if guard < 0 or tau * length >= 1e-15:
        for i in range(len(at.crossed)):
            at.crossed[i] = False
    s.done += length if guard < 0 else tau * length
    if guard < 0:
        return False
    at.crossed[guard] = True
    s.settling = True
    t = (s.k + s.done) * field.h
    if t - s.last > SAME_TIME * max(1.0, t):
        s.last, s.idle = t, 0
    s.idle, s.guard = s.idle + 1, guard
    return True


@_inlined
def _first_of_all(
    field: FlowTables, modes: ModeTables, length: float, at: KernelState, log: Log, room: Workspace
) -> tuple[float, int]:
    """Return where within a length the first guard is crossed, and which that is; infinity and -1 for none."""
    s, m, z, degree = at.state[0], at.state[0].m, at.z, modes.degree[at.state[0].m]
    power = room.powers[: degree + 1]
    for i in range(len(z)):
        room.size[i], room.terms[0, i] = abs(z[i]), z[i]
    _apply(modes.rounding[m], room.size, room.tolerance)
    for j in range(1, degree + 1):
        _apply(modes.F[m], room.terms[j - 1], room.terms[j], length / j)
    _apply(field.guards, z, room.now)
    for i in range(len(z)):
        room.speed[i] = abs(room.terms[1, i])
    _apply(modes.first[m, 0], room.speed, room.reach)
    tau, guard = np.inf, -1
    for i in range(len(at.crossed)):
        room.touched[i] = room.near[i] = crossing = np.inf
        side, away = modes.sides[m, i], False
        if side == 0:
            at.near_since[i] = np.inf
            continue
        if not at.crossed[i] and side * room.now[i] > room.reach[i] + 3 * room.tolerance[i]:
            away = True  # it stays beyond the tolerance: two more for what now and reach can be off by
        else:
            _seen(field.guards, i, room.terms, power)
            if at.crossed[i]:
                power[0] = 0.0
            for j in range(degree + 1):
                power[j] *= side
            crossing, room.touched[i], room.near[i] = first_crossing(power, room.tolerance[i], room.pieces)
        if at.near_since[i] < np.inf and (away or leading(power, room.tolerance[i]) <= degree):
            span = (s.k + s.done) - at.near_since[i] / field.h
            if crossing > 0.0 or matters(span, at.near_since[i], field):
                _note(s, log, at.near_since[i], i, span * field.h)
            at.near_since[i] = np.inf
        if crossing < tau:
            tau, guard = crossing, i
    return tau, guard


@_as_written
def _sum(row: Array, vector: Array, start: int, count: int) -> float:
    """Return row · vector[start:start + count]: products and sums one after the other, from left to right."""
    product: float = row[0] * vector[start]
    total = product
    for k in range(1, count):
        product = row[k] * vector[start + k]
        total = total + product
    return total


@_as_written
def _row(row: Array, vector: Array, start: int, count: int) -> float:
    """Return row · (vector[start:start + count], 1)."""
    if count == 0:
        constant: float = row[0]
        return constant
    result: float = _sum(row, vector, start, count) + row[count]
    return result


@_as_written
def _cell(found: int, signs: IntArray, room: Array, g: int) -> int:
    """Return the cell whose signs the guards at room[g:] contradict least, the first of several."""
    least = 0.0
    for i in range(len(signs)):
        worst = 0.0
        for k in range(signs.shape[1]):
            if signs[i, k] > 0 and -room[g + k] > worst:
                worst = -room[g + k]
            if signs[i, k] < 0 and room[g + k] > worst:
                worst = room[g + k]
        if i == 0 or worst < least:
            found = i
            least = worst
        if least == 0.0:
            break
    return found


@_as_written
def _advance(routine: ControllerArrays, memory: Array, room: Array, old: Any, new: Any) -> None:
    """Step the reference on by one sample: w, and the copies of it that are renewed every 2¹⁰ and 2²⁰ samples."""
    at, renewed = routine.at, len(routine.turn) - 1
    level = 0
    if routine.last >= 0 and old.tick <= routine.last:
        new.tick = old.tick + 1
    if renewed > 0:
        new.since = old.since + 1
        if new.since % _RENEWED == 0:
            level = 1
        if new.since == _RENEWED**renewed:
            if renewed == 2:
                level = 2
            new.since = 0
    for k in range(at.s):
        room[at.source + k] = memory[at.w + k]
    if renewed > 0 and level > 0:
        for k in range(at.s):
            room[at.source + k] = memory[at.copies + level * at.s - at.s + k]
    for a in range(at.s):
        total = _sum(routine.turn[level, a], room, at.source, at.s)
        room[at.w + a] = total
        for k in range(renewed):
            if k < level:
                room[at.copies + k * at.s + a] = total
    for b in range(routine.most):  # noqa: B007
        if new.piece < len(routine.piece_tick):  # noqa: SIM102  # there are languages that look at both
            if routine.piece_tick[new.piece] == new.tick:
                _begin(routine, room, new)


@_as_written
def _begin(routine: ControllerArrays, room: Array, new: Any) -> None:
    """Set the entries of w that a piece of the reference is about, and renew the copies."""
    at, renewed = routine.at, len(routine.turn) - 1
    for a in range(at.s):
        start = routine.piece_start[new.piece]
        if a >= start and a < start + routine.piece_length[new.piece]:
            room[at.w + a] = routine.piece_values[routine.piece_value[new.piece] - start + a]
    for copy in range(renewed):
        for k in range(at.s):
            room[at.copies + copy * at.s + k] = room[at.w + k]
    if renewed > 0:
        new.since = 0
    new.piece = new.piece + 1


@_as_written
def _wait(routine: ControllerArrays, memory: Array, room: Array, queue: int, channel: int, value: float) -> None:
    """Put a number of an input behind those that wait in a queue."""
    at = routine.at
    for place in range(at.delay - 1):
        room[queue + place * at.m + channel] = memory[queue + (place + 1) * at.m + channel]
    room[queue + (at.delay - 1) * at.m + channel] = value


@_as_written
def _put_out(routine: ControllerArrays, memory: Array, room: Array, channel: int, value: float, fine: bool) -> bool:
    """Limit the value that an input is to have, put it behind those that wait, and put the first of them out."""
    at = routine.at
    "7. Limits: input {channel}."
    last = value - room[at.before + channel]
    if not np.isfinite(last):
        fine = False
    room[at.change + channel] = last
    if len(routine.E) > 0:
        room[at.cut + channel] = value
    if routine.change[channel] < np.inf:
        last = room[at.before + channel] - routine.change[channel]
        difference = room[at.before + channel] + routine.change[channel]
        if value < last:
            value = last
        elif value > difference:
            value = difference
    room[at.wanted + channel] = value
    if routine.low[channel] > -np.inf and value < routine.low[channel]:
        value = routine.low[channel]
    elif routine.high[channel] < np.inf and value > routine.high[channel]:
        value = routine.high[channel]
    room[at.before + channel] = value
    if len(routine.E) > 0:
        room[at.cut + channel] = value - room[at.cut + channel]
    if routine.quantum[channel] > 0:
        total = value / routine.quantum[channel]
        total = total + routine.half
        product = np.floor(total)
        product = routine.quantum[channel] * product
        value = product
    "8. Put out: input {channel}."
    if at.delay == 0:
        room[at.u + channel] = value
    else:
        room[at.u + channel] = memory[at.late + channel]
        _wait(routine, memory, room, at.late, channel, value)
        if len(routine.E) > 0:
            _wait(routine, memory, room, at.late_cut, channel, room[at.cut + channel])
    return fine


@_as_written
def _predict(routine: ControllerArrays, room: Array) -> None:
    """Step (u, x̂, ŝ) at room[seen:] on by one sample, under u, each substep in the cell in which it begins."""
    at = routine.at
    here = 0
    for stage in range(at.substeps):  # noqa: B007
        for a in range(len(routine.h)):
            room[at.g + a] = _sum(routine.H[a], room, at.seen + at.m, at.n) + routine.h[a]
        here = _cell(here, routine.signs, room, at.g)
        for a in range(at.N):
            room[at.moved + a] = _row(routine.observer[here, a], room, at.seen, at.m + at.N)
        for a in range(at.N):
            room[at.seen + at.m + a] = room[at.moved + a]


@_as_written
def _observe(routine: ControllerArrays, memory: Array, room: Array, old: Any) -> None:
    """Step (x̂, ŝ) on by one sample: a prediction where y corrects it then, else with the y that is held."""
    at = routine.at
    if len(routine.M) > 0:
        for a in range(at.m + at.N):
            room[at.seen + a] = memory[at.u + a]
        _predict(routine, room)
        for a in range(at.N):
            room[at.x_hat + a] = room[at.seen + at.m + a]
    else:
        for a in range(at.N):
            room[at.x_hat + a] = _row(routine.observer[old.cell, a], memory, at.y, at.eta_hat)


@_as_written
def _correct(routine: ControllerArrays, room: Array) -> None:
    """Correct (x̂, ŝ) by what C (x̂, ŝ) misses of y."""
    at = routine.at
    "3. Correction by what is measured."
    for a in range(at.q):
        room[at.missed + a] = _sum(routine.C[a], room, at.x_hat, at.N) - room[at.y + a]
    for a in range(at.N):
        room[at.x_hat + a] = room[at.x_hat + a] + _sum(routine.M[a], room, at.missed, at.q)


@_as_written
def _unwind(routine: ControllerArrays, room: Array) -> None:
    """Move (x̂, ŝ) by what limits cut off the input that is put out."""
    at = routine.at
    for a in range(at.N):
        room[at.x_hat + a] = room[at.x_hat + a] + _sum(routine.E[a], room, at.cut, at.m)


@_as_written
def _unwind_late(routine: ControllerArrays, memory: Array, room: Array) -> None:
    """Do so for the input that is put out now, which was computed some samples ago."""
    at = routine.at
    "3. Against windup."
    for a in range(at.m):
        room[at.cut + a] = memory[at.late_cut + a]
    _unwind(routine, room)


@_as_written
def _act(routine: ControllerArrays, memory: Array, room: Array, new: Any, x: int) -> bool:
    """Put out what the law makes of the state at room[x:], and say whether all of it is finite."""
    at = routine.at
    fine = True
    for channel in range(at.m):
        "6. Law: input {channel}."
        value = _row(routine.u_ff[new.cell_d, channel], room, at.s_hat, at.known)
        for a in range(at.n):
            difference = room[x + a] - room[at.x_d + a]
            product = routine.K[channel, a] * difference
            value = value + product
        fine = _put_out(routine, memory, room, channel, value, fine)
    if len(routine.E) > 0 and at.delay == 0:
        "9. Against windup."
        _unwind(routine, room)
    return fine


@_as_written
def _bend(routine: ControllerArrays, room: Array, channel: int, target: float) -> None:
    """Write how (speed, acceleration) at room[going + 1:] gets to a speed in the least time: times, and their jerks.

    The acceleration is bent towards it at the jerk that is allowed, held at its limit, and bent back to 0.
    """
    at = routine.at
    gap = target - room[at.going + 1]
    lean = room[at.going + 2]
    rise = routine.pace[channel, 3]
    product = lean * lean
    product = product / rise
    product = routine.timing[1] * product
    part = product
    if lean < 0.0:
        part = -part
    if gap < part:
        gap = -gap
        lean = -lean
        rise = -rise
    product = lean * lean
    product = routine.timing[1] * product
    part = product
    product = routine.pace[channel, 3] * gap
    peak = product + part
    if peak < 0.0:
        peak = -peak
    peak = np.sqrt(peak)
    room[at.lasting + 1] = 0.0
    if peak > routine.pace[channel, 2]:
        peak = routine.pace[channel, 2]
        product = peak * peak
        part = product - part
        part = part / routine.pace[channel, 3]
        part = gap - part
        room[at.lasting + 1] = part / peak
    part = peak - lean
    room[at.lasting] = part / routine.pace[channel, 3]
    room[at.lasting + 2] = peak / routine.pace[channel, 3]
    room[at.bending] = rise
    room[at.bending + 1] = 0.0
    room[at.bending + 2] = -rise


@_as_written
def _pursue(routine: ControllerArrays, room: Array, channel: int, target: float, left: float) -> float:
    """Go on for a time, from (distance to go, speed, acceleration) at room[going:], to a speed in the least time.

    Returns what is left of the time: more than 0 where the speed is reached before.
    """
    at = routine.at
    _bend(routine, room, channel, target)
    for k in range(3):
        part = room[at.lasting + k]
        if part < 0.0:
            part = routine.timing[4]
        if part > left:
            part = left
        left = left - part
        product = part * room[at.bending + k]
        lean = product
        product = routine.timing[2] * lean
        gap = room[at.going + 2] + product
        product = routine.timing[1] * gap
        product = part * product
        gap = room[at.going + 1] + product
        product = part * gap
        room[at.going] = room[at.going] - product
        product = routine.timing[1] * lean
        gap = room[at.going + 2] + product
        product = part * gap
        room[at.going + 1] = room[at.going + 1] + product
        room[at.going + 2] = room[at.going + 2] + lean
    if left > 0.0:
        room[at.going + 1] = target
        room[at.going + 2] = 0.0
        product = left * target
        room[at.going] = room[at.going] - product
    return left


@_as_written
def _smooth(routine: ControllerArrays, memory: Array, room: Array, channel: int, nth: int) -> None:
    """Make y_d and its derivatives at room[made:] their means over a window that ends now: they have one more."""
    at = routine.at
    count, first = routine.windows[channel, nth], routine.window_start[channel, nth]
    part = memory[at.past + first + count - 1] - room[at.made]
    product = routine.timing[1] * part
    value = product
    for k in range(count - 1):
        part = memory[at.past + first + k] - room[at.made]
        value = value + part
    value = value / routine.weights[channel, nth, 0]
    part = room[at.made + 1] - memory[at.past + first + 2 * count - 1]
    product = routine.weights[channel, nth, 2] * part
    value = value - product
    for order in range(nth + 4):
        for k in range(count - 1):
            room[at.past + first + order * count + 1 + k] = memory[at.past + first + order * count + k]
        room[at.past + first + order * count] = room[at.made + order]
    for order in range(nth + 4):
        part = room[at.made + nth + 3 - order] - memory[at.past + first + (nth + 4 - order) * count - 1]
        room[at.made + nth + 4 - order] = part / routine.weights[channel, nth, 1]
    room[at.made] = room[at.made] + value


@_as_written
def _keep(routine: ControllerArrays, room: Array, channel: int, place: int) -> None:
    """Cut a finite set-point, or what is made of it, off at the ends of its range, where it has one."""
    if routine.lowest[channel] > -np.inf and np.isfinite(room[place]) and room[place] < routine.lowest[channel]:
        room[place] = routine.lowest[channel]
    if routine.highest[channel] < np.inf and np.isfinite(room[place]) and room[place] > routine.highest[channel]:
        room[place] = routine.highest[channel]


@_as_written
def _follow(routine: ControllerArrays, memory: Array, room: Array, given: Array, channel: int) -> None:
    """Make a set-point y_d and its derivatives: on towards it for as long as a stop would still end before it.

    The last derivative is its mean over the sample that begins.
    """
    at = routine.at
    "3. Set-point {channel}."
    room[at.course + 4 * channel + 3] = given[channel]
    _keep(routine, room, channel, at.course + 4 * channel + 3)
    part = room[at.course + 4 * channel + 3] - memory[at.course + 4 * channel + 3]
    room[at.course + 4 * channel] = memory[at.course + 4 * channel] + part
    early, width, aim, left = routine.timing[4], routine.timing[0], routine.timing[4], routine.timing[4]
    for i in range(_TRIALS + 2):
        for k in range(3):
            room[at.going + k] = room[at.course + 4 * channel + k]
        left = early
        if i > 0 and i <= _TRIALS:
            left = early + width
        left = _pursue(routine, room, channel, aim, left)
        left = routine.timing[3]
        if i > _TRIALS:
            left = routine.timing[0] - early
        left = _pursue(routine, room, channel, routine.timing[4], left)
        if i == 0:
            if room[at.going] > 0.0:
                aim = routine.pace[channel, 1]
            if room[at.going] < 0.0:
                aim = -routine.pace[channel, 1]
        elif i <= _TRIALS:
            part = room[at.going]
            if aim < 0.0:
                part = -part
            if part >= 0.0:
                early = early + width
        product = routine.timing[1] * width
        width = product
    width = routine.pace[channel, routine.pace.shape[1] - 1]
    if left > 0.0 and room[at.going] < width and room[at.going] > -width:
        room[at.going] = 0.0
    degree = at.s // len(routine.pace) - 1
    room[at.made] = room[at.course + 4 * channel + 3] - room[at.course + 4 * channel]
    for order in range(1, min(degree, 3) + 1):
        room[at.made + order] = room[at.course + 4 * channel + order]
        if order == min(degree, 3):
            part = room[at.going + order - 1] - room[at.course + 4 * channel + order - 1]
            if order == 1:
                part = room[at.course + 4 * channel] - room[at.going]
            room[at.made + order] = part / routine.timing[0]
    for nth in range(degree - 3):
        _smooth(routine, memory, room, channel, nth)
    _within(routine, room, channel, degree)
    for k in range(3):
        room[at.course + 4 * channel + k] = room[at.going + k]


@_as_written
def _within(routine: ControllerArrays, room: Array, channel: int, degree: int) -> None:
    """Write y_d and its derivatives at room[made:] to w, cut off at their limits."""
    at = routine.at
    room[at.w + channel] = room[at.made]
    _keep(routine, room, channel, at.w + channel)
    for order in range(1, degree + 1):
        value = room[at.made + order]
        if value > routine.pace[channel, order]:
            value = routine.pace[channel, order]
        if value < -routine.pace[channel, order]:
            value = -routine.pace[channel, order]
        room[at.w + order * len(routine.pace) + channel] = value


@_as_written
def _next(routine: ControllerArrays, memory: Array, room: Array, y: Array, given: Array, old: Any, new: Any) -> bool:
    """Write what the controller remembers after a tick to room and new, and say whether u may be put out.

    This and what it calls is the one statement of what a controller does: `export.step` prints it in other languages.
    So each sum and each product is one of two numbers, texts are comments, `break` only saves time, and each index of
    memory and room begins with the name of a part.
    """
    at = routine.at
    new.tick, new.since, new.piece = old.tick, old.since, old.piece
    new.cell, new.cell_d, new.status = old.cell, old.cell_d, RAN
    if old.started:
        "1. Observer and generator, one sample later."
        _observe(routine, memory, room, old)
        for a in range(at.p):
            room[at.eta_hat + a] = _row(routine.generator[old.cell_d, a], memory, at.s_hat, at.known)
        if len(routine.turn) > 0:
            "2. Reference."
            if routine.end >= 0 and old.tick >= routine.end:
                new.status = ENDED
            else:
                _advance(routine, memory, room, old, new)
    "3. Measurement."
    for a in range(at.q):
        room[at.y + a] = y[a]
    if len(routine.turn) == 0:
        if len(routine.pace) > 0:
            for channel in range(len(routine.pace)):
                _follow(routine, memory, room, given, channel)
        else:
            for a in range(at.s):
                room[at.w + a] = given[a]
    if len(routine.M) > 0:
        _correct(routine, room)
        if len(routine.E) > 0 and at.delay > 0:
            _unwind_late(routine, memory, room)
    if len(routine.h) > 0:
        "4. Cell of x_hat: the first one whose signs are contradicted least."
        for a in range(len(routine.h)):
            room[at.g + a] = _sum(routine.H[a], room, at.x_hat, at.n) + routine.h[a]
        new.cell = _cell(new.cell, routine.signs, room, at.g)
    if len(routine.guards) > 0:
        "4. Cell of x_d."
        for a in range(len(routine.guards)):
            room[at.g + a] = _row(routine.guards[a], room, at.s_hat, at.known)
        new.cell_d = _cell(new.cell_d, routine.sides, room, at.g)
    "5. Desired state."
    for a in range(at.n):
        room[at.x_d + a] = _row(routine.x_d[new.cell_d, a], room, at.s_hat, at.known)
    if at.ahead > 0:
        "6. State at the time at which the input acts."
        for a in range(at.N):
            room[at.seen + at.m + a] = room[at.x_hat + a]
        for b in range(at.ahead):
            for a in range(at.m):
                room[at.seen + a] = memory[at.late + b * at.m + a]
            _predict(routine, room)
        fine = _act(routine, memory, room, new, at.seen + at.m)
    else:
        fine = _act(routine, memory, room, new, at.x_hat)
    return fine


@_as_written
def tick(routine: ControllerArrays, memory: Array, counts: Any, room: Array, y: Array, given: Array) -> int:
    """Run the controller once, as docs/arithmetic.md says; what it remembers is of `controller_arrays.memory`.

    y was measured, (q,); `given` is w from outside, (s,), where it is from there, or set-points that it is made of,
    (outputs,). Returns RAN, ENDED (the reference has ended, and w stays as it is) or REFUSED (a number is not finite;
    nothing changes).
    """
    old, new = counts[0], counts[1]
    for k in range(len(memory)):
        room[k] = memory[k]
    fine = _next(routine, memory, room, y, given, old, new)
    for k in range(len(memory)):
        if not np.isfinite(room[k]):
            fine = False
    if not fine:
        return REFUSED
    for k in range(len(memory)):
        memory[k] = room[k]
    old.tick, old.since, old.piece = new.tick, new.since, new.piece
    old.cell, old.cell_d, old.status, old.started = new.cell, new.cell_d, new.status, 1
    return int(new.status)


@_inlined
def _run(ticks: ControllerClock, at: KernelState) -> None:
    """Measure, and run the controller."""
    y, z, memory = at.y, at.z, at.memory
    for a in range(len(y)):
        total = 0.0
        for i in range(len(z)):
            total += ticks.measured[i, a] * z[i]
        quantum = ticks.quantum[a]
        y[a] = quantum * np.floor(total / quantum + 0.5) if quantum > 0.0 else total
    tick(ticks.routine, memory, at.counts, at.room, y, y)
    for k in range(len(ticks.place)):
        z[ticks.place[k]] = ticks.scale[k] * memory[ticks.source[k]]
    at.state[0].resets += 1
    at.state[0].settling = True


@_inlined
def _reset(resets: Resets, at: KernelState) -> None:
    """Carry out what is due: all entries that take new values at once; the controller comes after that."""
    s, z = at.state[0], at.z
    r, step = s.resets, resets.step[s.resets]
    while r < len(resets.step) and resets.step[r] <= step and resets.row[r] >= 0:
        for i in range(resets.start[r], resets.stop[r]):
            jump = resets.values[resets.row[r], i] - z[i]
            z[i] = resets.values[resets.row[r], i]
            for k in range(len(z)):
                z[k] -= resets.counted[i, k] * jump
        r += 1
    s.resets, s.settling = r, True


@_uncounted
def walk(
    field: FlowTables,
    modes: ModeTables,
    known: int,
    resets: Resets,
    ticks: ControllerClock,
    at: KernelState,
    log: Log,
    room: Workspace,
) -> int:
    """Walk on from where the state says until the last sample that the log has room for, and say why it stops.

    That is DONE, NEW_MODE (`at.cells` must be filled in first, beside the `known` ones), FULL (no room for events),
    STUCK or SPENT (no steps are left).
    """
    s, K = at.state[0], len(at.crossed)
    end = (s.base + len(log.z) - 1) << field.doublings
    s.fresh = False
    while True:
        due = resets.step[s.resets] if s.resets < len(resets.step) else np.inf
        if not (s.k < end or s.settling or due <= end):
            return DONE
        if s.settling:
            s.fresh = False
            if s.breaks == len(log.break_time):
                return FULL
            if not _settle(field, modes, known, at, log, room):
                return NEW_MODE
            continue
        if s.events == len(log.event_time) or s.nears + 3 * K > len(log.near_time):
            return FULL
        if s.left == 0:
            return SPENT
        s.left -= 1
        if not s.inside:
            if not _stride(field, modes, min(end - s.k, int(np.floor(min(due - s.k, 2.0**53)))), at, room):
                s.inside, s.done = True, 0.0
                continue
        else:  # up to the first crossing, reset or the end of a finest step
            s.fresh, falls = False, due < s.k + 1
            if _cross(field, modes, (max(s.done, due - s.k) if falls else 1.0) - s.done, at, log, room):
                if s.idle > MOST_IDLE:
                    return STUCK
                continue
            if falls:
                if resets.row[s.resets] < 0:
                    _run(ticks, at)
                else:
                    _reset(resets, at)
                continue
            s.k, s.done, s.inside = s.k + 1, 0.0, False
        _sample(field, at, log)


@_compiled
def norms(rows: Array, z: Array, result: Array) -> None:
    """Write ‖rows z‖ for each row of samples z (S, N), rows being (q, N)."""
    for k in range(len(z)):
        total = 0.0
        for q in range(len(rows)):
            entry = 0.0
            for i in range(z.shape[1]):
                entry += rows[q, i] * z[k, i]
            total += entry * entry
        result[k] = math.sqrt(total)
