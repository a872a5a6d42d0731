"""The compiled walk along a trajectory, from event to event, with no ODE solver.

Inside a mode ż = F z. The finest step is so short that 16 Taylor terms are e^{F h}
to rounding; longer ones, up to the sample time, come from it by doubling.

A step of length h is taken at once if no guard g can reach 0 on it. A guard differs
from the chord between its ends by at most h²/8 sup |g F² e^{Fσ}| |z|, which is bounded
once per mode and step length; where that does not settle it, with v = F z, a = F v,

    g z(τ) ≥ g z − ∫|g e^{Fσ}|dσ |v|,   g z(τ) ≥ min(g z, g z + h g v) − ∫(h − σ)|g e^{Fσ}|dσ |a|,

and the integrals are bounded like that too. If even the finest
step may meet a guard, the guard is a Taylor polynomial in τ ∈ [0, 1] there. Its
Bernstein coefficients enclose it, and those of its derivative tell where it is
monotone, so a crossing is isolated, excluded, or reported as within rounding of
the guard (Farouki, The Bernstein polynomial basis: a centennial retrospective,
CAGD 29, 2012).

Time is in finest steps here. All compiled functions live in this one file: the
cache of compiled code is renewed when the file of a function changes, but not
when that of a function it calls does.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple, ParamSpec, TypeVar

import numpy as np
from numba import njit

from pwatrack.arrays import Array, IntArray

DEGREE = 15  # ‖F h‖ ≤ 1/2 leaves a remainder below 2⁻⁵⁶ of the sum
SAME_TIME = 1e-12  # relative, or in s before t = 1 s
MOST_IDLE = 1000  # crossings without progress in time
_FINEST = 2.0**-26  # a piece so short that a polynomial without monotony on it stays within rounding of 0
_BINOMIAL = (1.0, 15.0, 105.0, 455.0, 1365.0, 3003.0, 5005.0, 6435.0)  # 15 over 0 … 7; the rest mirrors them

_P = ParamSpec("_P")
_R = TypeVar("_R")


def _compiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    fused = {"contract"}  # a b + c may be rounded once
    try:
        return njit(cache=True, nogil=True, fastmath=fused)(function)
    except RuntimeError:  # no folder for the cache is writable
        return njit(nogil=True, fastmath=fused)(function)


class Field(NamedTuple):
    """A flow of order N with P parts, C cells and K guards in all, and the grid of steps.

    Attributes:
        first: First cell of each part, and C, (P + 1,).
        guards: Rows on z, transposed, (N, K).
        signs: Side of each guard that each cell is on; 0 for guards of other parts, (C, K).
        h: The finest step in s.
        doublings: The longest step, from sample to sample, is 2^doublings finest ones.
        degree: Taylor terms of e^{F h} beyond it are rounding, in every mode and entry.
    """

    first: IntArray
    guards: Array
    signs: IntArray
    h: float
    doublings: int
    degree: int


class Resets(NamedTuple):
    """What jumps, and when: R resets in order.

    Attributes:
        step: When, in finest steps, (R,).
        map: Number of the map that is applied, or -1 where entries take new values, (R,).
        start, stop, row: Which entries, and where in `values` the new ones are, (R,).
        values: (V, N).
    """

    step: Array
    map: IntArray
    start: IntArray
    stop: IntArray
    row: IntArray
    values: Array


class Modes(NamedTuple):
    """What is known of each mode met so far; matrices are transposed, so that products run along rows.

    Attributes:
        cells: Cell of each part, counted over all parts, (M, P).
        sides: Side of every guard, 0 where it does not bound the mode, (M, K).
        F: F h, (M, N, N).
        growth: e^{F h 2^d} − 1 for d doublings, (M, D, N, N).
        margin: |z| times it is how far from 0 a guard must be at both ends of a step, (M, D, N, K).
        first, second: Bounds on the two integrals above, (M, D, N, K).
        rounding: |z| times it is the size below which a guard cannot be told from 0, (M, N, K).
        jumps: The maps of the clock, (M, J, N, N).
    """

    cells: IntArray
    sides: IntArray
    F: Array
    growth: Array
    margin: Array
    first: Array
    second: Array
    rounding: Array
    jumps: Array


class Log(NamedTuple):
    """What the walk writes down.

    Attributes:
        z: Samples, (S, N).
        mode: Number of the mode at each sample, (S,).
        event_time, event_mode: When the mode changed, in s, and to which. The first is the start;
            there is room for more.
        near_time, near_guard: Where a guard came within rounding of 0 and no sign can be given.
    """

    z: Array
    mode: IntArray
    event_time: Array
    event_mode: IntArray
    near_time: Array
    near_guard: IntArray


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
        ("resets", np.int64),  # resets carried out
        ("events", np.int64),
        ("nears", np.int64),
        ("last", np.float64),  # when time last moved on between crossings, in s
        ("idle", np.int64),  # crossings since
        ("guard", np.int64),  # the last guard crossed
    ]
)
DONE, NEW_MODE, FULL, STUCK = range(4)  # why the walk stops


@_compiled
def leading(power: Array, tolerance: float) -> int:
    """Return the number of the first coefficient that is not within the tolerance of 0, or 16."""
    for j in range(DEGREE + 1):
        if abs(power[j]) > tolerance:
            return j
    return DEGREE + 1


@_compiled
def first_crossing(power: Array, tolerance: float, pieces: Array) -> tuple[float, float, float]:
    """Return where the polynomial Σ power_j τʲ first becomes negative on [0, 1).

    Leading coefficients within the tolerance count as 0: the trajectory starts
    on the guard, and the first coefficient beyond decides which side it goes to.

    Args:
        power: Power coefficients, (16,).
        tolerance: Values of smaller size are indistinguishable from 0.
        pieces: Room to work, (32, 18).

    Returns:
        Three places, each infinity if there is none: the first crossing;
        before it, the first place where the polynomial comes within the
        tolerance of 0, may or may not be negative, and then is positive again;
        and the place from which on it stays within the tolerance up to τ = 1.

    Example:
        >>> room = np.empty((32, 18))
        >>> first_crossing(np.array([0.25, -1.0] + 14 * [0.0]), 1e-15, room)
        (0.25, inf, inf)
        >>> first_crossing(np.array([0.26, -1.0, 1.0] + 13 * [0.0]), 1e-15, room)
        (inf, inf, inf)
    """
    start = leading(power, tolerance)
    if start > DEGREE:
        return np.inf, np.inf, np.inf
    if power[start] < 0:
        return 0.0, np.inf, np.inf
    rest = 0.0
    for j in range(start + 1, DEGREE + 1):
        rest += abs(power[j])
    if power[start] > rest + tolerance:
        return np.inf, np.inf, np.inf

    LOW, WIDTH = DEGREE + 1, DEGREE + 2  # behind the Bernstein coefficients of a piece
    for j in range(DEGREE + 1):
        pieces[0, j] = power[start + j] / _BINOMIAL[min(j, DEGREE - j)] if start + j <= DEGREE else 0.0
    for j in range(1, DEGREE + 1):
        for i in range(DEGREE, j - 1, -1):
            pieces[0, i] += pieces[0, i - 1]
    pieces[0, LOW], pieces[0, WIDTH] = 0.0, 1.0
    near, touched, top = np.inf, np.inf, 0
    while top >= 0:
        b, low, high = pieces[top], pieces[top, LOW], pieces[top, LOW] + pieces[top, WIDTH]
        least, most, rising, falling = b[0], b[0], True, True
        for i in range(DEGREE):
            least, most = min(least, b[i + 1]), max(most, b[i + 1])
            rising, falling = rising and b[i + 1] >= b[i], falling and b[i + 1] <= b[i]
        first, last, small = b[0], b[DEGREE], max(-least, most) <= tolerance
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
        else:  # halve it by de Casteljau's algorithm: the right half stays, the left one goes on top
            left = pieces[top + 1]
            left[0] = b[0]
            for j in range(1, DEGREE + 1):
                for i in range(DEGREE + 1 - j):
                    b[i] = 0.5 * (b[i] + b[i + 1])
                left[j] = b[0]
            left[LOW], left[WIDTH] = low, 0.5 * b[WIDTH]
            b[WIDTH] *= 0.5
            b[LOW] = low + b[WIDTH]
            top += 1
    return np.inf, touched, near


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
    for j in range(DEGREE, start - 1, -1):
        slope = slope * x + value
        value = value * x + power[j]
    return value, slope


@_compiled
def _apply(transposed: Array, z: Array, result: Array) -> None:
    """Write M z to `result` for M given as its transpose; four rows at a time, so that results are stored less."""
    n, j = len(z), 0
    for i in range(len(result)):
        result[i] = 0.0
    while j + 4 <= n:
        z0, z1, z2, z3 = z[j], z[j + 1], z[j + 2], z[j + 3]
        for i in range(len(result)):
            result[i] += (transposed[j, i] * z0 + transposed[j + 1, i] * z1) + (
                transposed[j + 2, i] * z2 + transposed[j + 3, i] * z3
            )
        j += 4
    while j < n:
        for i in range(len(result)):
            result[i] += transposed[j, i] * z[j]
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
def _next_term(F: Array, factor: float, terms: Array, j: int) -> None:
    """Write factor · F times row j − 1 of terms (16, N) to row j: what `_apply` does, without views of rows."""
    N, k = terms.shape[1], 0
    for i in range(N):
        terms[j, i] = 0.0
    while k + 4 <= N:
        t0, t1 = factor * terms[j - 1, k], factor * terms[j - 1, k + 1]
        t2, t3 = factor * terms[j - 1, k + 2], factor * terms[j - 1, k + 3]
        for i in range(N):
            terms[j, i] += (F[k, i] * t0 + F[k + 1, i] * t1) + (F[k + 2, i] * t2 + F[k + 3, i] * t3)
        k += 4
    while k < N:
        t0 = factor * terms[j - 1, k]
        for i in range(N):
            terms[j, i] += F[k, i] * t0
        k += 1


@_compiled
def _expand(F: Array, z: Array, length: float, degree: int, terms: Array) -> None:
    """Write the Taylor terms of z(τ length) up to a degree, (16, N)."""
    for i in range(len(z)):
        terms[0, i] = z[i]
    for j in range(1, degree + 1):
        _next_term(F, length / j, terms, j)


@_compiled
def _seen(guards: Array, k: int, terms: Array, power: Array) -> None:
    """Write the Taylor terms of guard k, (16,); four at a time, so that sums do not wait for each other."""
    for j in range(0, DEGREE + 1, 4):
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


@_compiled
def _sides(
    F: Array, guards: Array, tolerance: Array, crossed: Any, z: Array, terms: Array, seen: Array, sides: IntArray
) -> None:
    """Write on which side of each guard the trajectory goes on, 0 where rounding hides it.

    A guard at 0 counts by its first derivative that is not 0: the field is
    continuous, so that derivative is the same on both sides.
    """
    open_ = len(sides)
    for k in range(len(sides)):
        sides[k] = 0
    for j in range(DEGREE + 1):
        if j == 0:
            terms[0] = z
        else:
            _next_term(F, 1.0 / j, terms, j)
        _apply(guards, terms[j], seen)
        for k in range(len(sides)):
            if sides[k] == 0 and abs(seen[k]) > tolerance[k] and not (j == 0 and crossed[k]):
                sides[k] = 1 if seen[k] > 0 else -1
                open_ -= 1
        if open_ == 0:
            return


@_compiled
def _fit(first: IntArray, signs: IntArray, sides: IntArray, cells: IntArray) -> bool:
    """Write the cells that lie on the given sides of the guards, and say whether they are other ones.

    0 fits either side. The present cell of a part is kept if it fits. If
    rounding leaves no cell that fits, the one with the fewest contradictions is taken.
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
    """Say that no guard that bounds the mode is within its margin of 0 at either end of a step, or beyond."""
    apart = True
    for k in range(len(now)):
        apart = apart and (sides[k] == 0 or min(sides[k] * now[k], sides[k] * then[k]) > margin[k])
    return apart


@_compiled
def _clear(
    sides: IntArray, now: Array, slope: Array, first: Array, speed: Array, second: Array, bend: Array, length: int
) -> bool:
    """Say, more carefully, that no guard that bounds the mode can reach 0 on a step."""
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
        if min(value, value + length * side * slope[k]) <= reach:
            return False
    return True


@_compiled
def walk(
    field: Field,
    modes: Modes,
    known: int,
    resets: Resets,
    state: Any,
    z: Array,
    near_since: Array,
    crossed: Any,
    cells: IntArray,
    log: Log,
) -> int:
    """Walk on from where the state says until the last sample that the log has room for, and say why it stops.

    Args:
        field, modes, resets: What is given; `known` modes are filled in.
        state: Where the walk is, one record of STATE.
        z, near_since, crossed: More of that: the state (N,); since when each guard is within rounding of 0,
            and whether it was crossed just now, (K,).
        cells: The mode that must be filled in first is left here, (P,).
        log: What is written down.

    Returns:
        DONE, NEW_MODE, FULL (no room for events) or STUCK.
    """
    s, K, N, D = state[0], len(crossed), len(z), field.doublings
    end = (s.base + len(log.z) - 1) << D
    terms, power, pieces = np.zeros((DEGREE + 1, N)), np.empty(DEGREE + 1), np.empty((32, DEGREE + 3))
    now, then, slope, reach, tolerance = np.empty(K), np.empty(K), np.empty(K), np.empty(K), np.empty(K)
    beyond, touched, near, sides = np.empty(K), np.empty(K), np.empty(K), np.empty(K, np.int64)
    v, following, size, speed, bend = np.empty(N), np.empty(N), np.empty(N), np.empty(N), np.empty(N)
    known_now = False  # `now` are the guards at z
    while s.k < end or s.settling or (s.resets < len(resets.step) and resets.step[s.resets] <= end):
        m = s.m
        for i in range(N):
            size[i] = abs(z[i])

        if s.settling:
            known_now = False
            _apply(modes.rounding[m], size, tolerance)
            _sides(modes.F[m], field.guards, tolerance, crossed, z, terms, now, sides)
            for p in range(len(cells)):
                cells[p] = modes.cells[m, p]
            if s.tries <= K and _fit(field.first, field.signs, sides, cells):
                s.m = _number(modes.cells, known, cells)
                if s.m == known:
                    s.m = m
                    return NEW_MODE
                s.tries += 1
                continue
            s.settling, s.tries = False, 0
            t = (s.k + s.done) * field.h
            if s.k & ((1 << D) - 1) == 0 and s.done == 0.0:
                log.mode[(s.k >> D) - s.base] = m
                for i in range(N):
                    log.z[(s.k >> D) - s.base, i] = z[i]
                if s.k == 0 and s.events == 1:
                    log.event_mode[0] = m  # the start is no event
            if m != log.event_mode[s.events - 1]:  # changes within rounding of each other are one
                if s.events > 1 and t - log.event_time[s.events - 1] <= SAME_TIME * max(1.0, t):
                    s.events -= 1
                    t = log.event_time[s.events]
                if m != log.event_mode[s.events - 1]:
                    log.event_time[s.events], log.event_mode[s.events] = t, m
                    s.events += 1
            continue

        if s.events == len(log.event_time) or s.nears + 2 * K > len(log.near_time):
            return FULL

        if not s.inside:  # the longest step on the grid that meets neither guard nor reset
            free = end - s.k
            if s.resets < len(resets.step):
                free = min(free, int(np.floor(resets.step[s.resets] - s.k)))
            d = min(s.d + 1, D)
            while d >= 0 and (s.k & ((1 << d) - 1) != 0 or 1 << d > free):
                d -= 1
            if not known_now:
                _apply(field.guards, z, now)
                known_now = True
            careful = False
            while d >= 0:
                _apply(modes.growth[m, d], z, v)
                for i in range(N):
                    following[i] = z[i] + v[i]
                _apply(field.guards, following, then)
                _apply(modes.margin[m, d], size, reach)
                if _apart(modes.sides[m], now, then, reach):
                    break
                if not careful:
                    careful = True
                    _apply(modes.rounding[m], size, tolerance)
                    _apply(modes.F[m], z, speed)
                    _apply(modes.F[m], speed, bend)
                    _apply(field.guards, speed, slope)
                    for i in range(N):
                        speed[i], bend[i] = abs(speed[i]), abs(bend[i])
                    for i in range(K):
                        beyond[i] = now[i] - modes.sides[m, i] * tolerance[i]
                if _clear(modes.sides[m], beyond, slope, modes.first[m, d], speed, modes.second[m, d], bend, 1 << d):
                    break
                d -= 1
            s.d = max(d, 0)
            if d < 0:
                s.inside, s.done = True, 0.0
                continue
            for i in range(N):
                z[i] = following[i]
            for i in range(K):
                now[i] = then[i]
            s.k += 1 << d
        else:  # up to the first crossing, reset or the end of a finest step
            falls = s.resets < len(resets.step) and resets.step[s.resets] < s.k + 1
            length = (max(s.done, resets.step[s.resets] - s.k) if falls else 1.0) - s.done
            known_now = False
            _apply(modes.rounding[m], size, tolerance)
            _expand(modes.F[m], z, length, field.degree, terms)
            _apply(field.guards, z, now)
            for i in range(N):
                speed[i] = abs(terms[1, i])
            _apply(modes.first[m, 0], speed, reach)
            tau, guard = np.inf, -1
            for i in range(K):
                touched[i] = near[i] = crossing = np.inf
                side, away = modes.sides[m, i], False
                if side == 0:
                    near_since[i] = np.inf
                    continue
                if not crossed[i] and side * now[i] > reach[i] + 2 * tolerance[i]:
                    away = True  # it stays beyond the tolerance
                else:
                    _seen(field.guards, i, terms, power)
                    if crossed[i]:
                        power[0] = 0.0
                    for j in range(DEGREE + 1):
                        power[j] *= side
                    crossing, touched[i], near[i] = first_crossing(power, tolerance[i], pieces)
                if near_since[i] < np.inf and (away or leading(power, tolerance[i]) <= DEGREE):
                    if crossing > 0.0:
                        log.near_time[s.nears], log.near_guard[s.nears] = near_since[i], i
                        s.nears += 1
                    near_since[i] = np.inf
                if crossing < tau:
                    tau, guard = crossing, i
            for i in range(K):
                if touched[i] < tau:
                    log.near_time[s.nears] = (s.k + s.done + touched[i] * length) * field.h
                    log.near_guard[s.nears] = i
                    s.nears += 1
                if near[i] < tau:
                    near_since[i] = (s.k + s.done + near[i] * length) * field.h
            _arrive(terms, field.degree, min(tau, 1.0), z)
            if guard >= 0:
                s.done += tau * length
                if tau * length >= 1e-15:
                    for i in range(K):
                        crossed[i] = False
                crossed[guard] = True
                s.settling = True
                t = (s.k + s.done) * field.h
                if t - s.last > SAME_TIME * max(1.0, t):
                    s.last, s.idle = t, 0
                s.idle, s.guard = s.idle + 1, guard
                if s.idle > MOST_IDLE:
                    return STUCK
                continue
            s.done += length
            for i in range(K):
                crossed[i] = False
            if falls:
                r, step = s.resets, resets.step[s.resets]
                if resets.map[r] >= 0:
                    _apply(modes.jumps[m, resets.map[r]], z, v)
                    z[:] = v
                    r += 1
                else:  # all that take new values at once; a map comes after, in the mode that is right then
                    while r < len(resets.step) and resets.step[r] <= step and resets.map[r] < 0:
                        for i in range(resets.start[r], resets.stop[r]):
                            z[i] = resets.values[resets.row[r], i]
                        r += 1
                s.resets, s.settling = r, True
                continue
            s.k, s.done, s.inside = s.k + 1, 0.0, False
        if s.k & ((1 << D) - 1) == 0:
            for i in range(N):
                log.z[(s.k >> D) - s.base, i] = z[i]
            log.mode[(s.k >> D) - s.base] = s.m
    return DONE


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
