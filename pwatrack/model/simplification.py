"""Cells that are merged: of a scalar element some breakpoints become one or none, and it deviates by a bounded amount.

Let φ have the slopes l before and r after some of its breakpoints in a row. Outside them φ̃ has the same slopes, between
them it has at most one corner: with l < r it is the largest max(l s + a, r s + b) ≤ φ there, shifted up by half of the
largest difference D; with l > r likewise from above; with l = r a line. A function max(l s + a', r s + b') that is
nowhere more than w̄ from φ is, shifted down by w̄, below φ, so it is at most that largest one, which is D below φ
somewhere: no other corner and offset has less than w̄ = D / 2.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import chain

from pwatrack.ball_matrix import BallMatrix
from pwatrack.model.nonlinearity import Nonlinearity, PiecewiseLinear, ScalarForm
from pwatrack.model.pwa import PWASystem
from pwatrack.model.scalar_form import with_elements
from pwatrack.real import Real


@dataclass(frozen=True, kw_only=True)
class Simplification:
    """φ = φ̃ + w with |w| ≤ largest everywhere."""

    element: int  # of those of a plant, counted from 0
    nonlinearity: Nonlinearity  # that one, with φ
    first: int  # the first breakpoint of φ, and
    last: int  # the last one, of those that become one or none
    function: PiecewiseLinear  # φ̃; where it is a line it has one breakpoint with the same slope on either side
    largest: Fraction  # w̄, exact; an upper bound of it where φ has irrational numbers

    @property
    def column(self) -> BallMatrix:
        """By which w enters ẋ, (n, 1)."""
        return BallMatrix.of([[v] for v in self.nonlinearity.direction])


def merges(form: ScalarForm, element: int) -> list[Simplification]:
    """Return all ways to merge cells of one element, those with the least deviation first."""
    count = len(form.elements[element].function.breakpoints)
    found = (_ways(form, element, width) for width in range(1, count))
    return sorted(chain.from_iterable(found), key=lambda merge: (merge.largest, merge.last - merge.first, merge.first))


def widest(form: ScalarForm) -> dict[int, Simplification]:
    """Return each element merged whole, or as much of it as can be, where it can be."""
    chosen = dict[int, Simplification]()
    for k, element in enumerate(form.elements):
        widths = (_ways(form, k, width) for width in reversed(range(1, len(element.function.breakpoints))))
        ways = next(filter(None, widths), [])
        if ways:
            chosen[k] = min(ways, key=lambda merge: merge.largest)
    return chosen


def _ways(form: ScalarForm, element: int, width: int) -> list[Simplification]:
    """Return all ways to merge so many cells of an element, and the next one."""
    nonlinearity, found = form.elements[element], list[Simplification]()
    function = nonlinearity.function
    for first in range(len(function.breakpoints) - width):
        other = _merged(function, first, first + width)
        if other is not None:
            marks = (*function.breakpoints, *other.breakpoints)  # outside all of these, both have the same slopes
            gaps = [_at(function, mark) - _at(other, mark) for mark in marks]
            found.append(
                Simplification(
                    element=element,
                    nonlinearity=nonlinearity,
                    first=first,
                    last=first + width,
                    function=other,
                    largest=max(abs(gap.centre) + gap.radius for gap in gaps),
                )
            )
    return found


def merged(plant: PWASystem, form: ScalarForm, chosen: Mapping[int, Simplification]) -> PWASystem:
    """Return the plant f̃ in which some elements of its form are merged, each in one way; `chosen` has their numbers."""
    elements = tuple(
        replace(element, function=chosen[k].function) if k in chosen else element
        for k, element in enumerate(form.elements)
    )
    return with_elements(plant, replace(form, elements=elements))


def _merged(function: PiecewiseLinear, first: int, last: int) -> PiecewiseLinear | None:
    """Return φ̃, or None where it is not known whether the slopes on both sides are the same."""
    left, right = function.slopes[first], function.slopes[last + 1]
    if left.centre == right.centre and left is not right and not (left.exact and right.exact):
        return None
    marks = function.breakpoints[first : last + 1]
    sign = 1 if left.centre <= right.centre else -1
    points, lines = [mark.centre for mark in marks], [sign * left.centre, sign * right.centre]
    heights = [sign * _at(function, mark).centre for mark in marks]
    offsets = [min(v - slope * s for v, s in zip(heights, points, strict=True)) for slope in lines]
    corner = points[0] if lines[0] == lines[1] else (offsets[0] - offsets[1]) / (lines[1] - lines[0])
    points, heights = [*points, corner], [*heights, sign * _at(function, Real.of(corner)).centre]
    D = max(
        v - max(slope * s + c for slope, c in zip(lines, offsets, strict=True))
        for v, s in zip(heights, points, strict=True)
    )
    offset = sign * (offsets[0] + D / 2)  # φ̃ = left s + offset before the corner
    before, after = function.breakpoints[:first], function.breakpoints[last + 1 :]
    inner = () if lines[0] == lines[1] and (before or after) else (Real.of(corner),)
    breakpoints = (*before, *inner, *after)
    slopes = (*function.slopes[: first + 1], *function.slopes[last + 1 + (not inner) :])
    value = Real.of(offset) + left * breakpoints[0]
    if before:  # there φ̃ − φ is constant
        value = function.value + Real.of(offset) - function.intercepts[first]
    names = function.segments
    joined = names[first] if names[first] == names[last + 1] else f"{names[first]} or {names[last + 1]}"
    middle = (names[first], names[last + 1]) if inner else (joined,)
    segments = (*names[:first], *middle, *names[last + 2 :])
    return PiecewiseLinear(breakpoints=breakpoints, slopes=slopes, value=value, segments=segments)


def _at(function: PiecewiseLinear, s: Real) -> Real:
    """Return φ(s)."""
    k = sum(mark.centre < s.centre for mark in function.breakpoints)
    return function.slopes[k] * s + function.intercepts[k]
