"""A step, read as Python."""

import ast
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pwatrack.export.step import Step

FULL = 2**31 - 1  # where numbers are cut off; one less is the largest that counts
_FORM = """
def running():
    {begin}
    y, given = yield
    while True:
        {body}
        y, given = yield {kept},
"""


def nearest(value: int, unit: int) -> int:
    """Return how many units a number is, rounded to nearest, the upper one of two.

    Example:
        >>> nearest(-5, 2), nearest(5, 2), nearest(7, 1)
        (-2, 3, 7)
    """
    return (value + unit // 2) // unit


def narrowed(value: int, unit: int) -> int:
    """Return the same, cut off where 32 bits end."""
    return max(-FULL, min(FULL, nearest(value, unit)))


def stepped(value: int, step: int) -> int:
    """Return the multiple of a step that is nearest, the upper one of two."""
    return nearest(value, step) * step


class Reading:
    """A step that runs from its start: in floats, without set-points, or in whole numbers: see `fixed_point`."""

    def __init__(self, step: Step) -> None:
        inputs = next(variable.length for variable in step.kept if variable.name == "before")
        room = {v.name: [0] * v.length for v in (*step.kept, *step.own) if v.length} | {"u": [0] * inputs}
        known: dict[str, Any] = {"wide": int, "nearest": nearest, "narrowed": narrowed, "stepped": stepped}
        known |= {name: values.tolist() for name, (_, values) in step.constants.items()} | room
        self._names = [variable.name for variable in step.kept] + ["u"]
        text = _FORM.format(
            begin=step.begin.replace("\n", "\n    "),
            body=step.body.replace("\n", "\n        "),
            kept=", ".join(f"{name}[:]" if name in room else name for name in self._names),
        )
        tree = ast.fix_missing_locations(_Lists().visit(ast.parse(text)))
        exec(compile(tree, "step", "exec"), known)  # noqa: S102  # our own code
        self._running = known["running"]()
        next(self._running)

    def step(self, y: Sequence[Any], given: Sequence[Any] = ()) -> dict[str, Any]:
        """Run once, and return all that is remembered, and u, by name."""
        return dict(zip(self._names, self._running.send((y, given)), strict=True))


def run(step: Step, y: NDArray[Any], given: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Run a step as `Reading` does, y and references in rows; return all that it remembers, and u, after each tick."""
    reading = Reading(step)
    found = [reading.step(*each) for each in zip(y.tolist(), given.tolist(), strict=True)]
    return {name: np.array([each[name] for each in found]) for name in found[0]}


class _Lists(ast.NodeTransformer):
    def visit_Subscript(self, node: ast.Subscript) -> ast.expr:
        if not isinstance(node.slice, ast.Tuple):
            return node
        found = node.value
        for place in node.slice.elts:
            found = ast.Subscript(found, place, node.ctx if place is node.slice.elts[-1] else ast.Load())
        return found
