"""Programs in several unknown matrices, written down as they stand: a linear objective, and blocks that are ⪰ 0."""

from collections.abc import Callable, Iterator, Mapping

import numpy as np

from pwatrack.arrays import Array
from pwatrack.lmi.cone_program import Block, symmetric_of, upper
from pwatrack.lmi.solve import semidefinite

Unknowns = Mapping[str, Array]  # each (c, …)


def minimised(
    what: str, shapes: Mapping[str, tuple[int, ...]], blocks: Callable[[Unknowns], Iterator[Array]]
) -> dict[str, Array] | None:
    """Minimise an unknown subject to blocks ⪰ 0 that are affine in all of them; Q is symmetric.

    Args:
        what: Its name.
        shapes: Of all unknowns.
        blocks: Makes symmetric matrices (c, N, N) of unknowns (c, …) and of "1", (c,), which stands for constants.

    Example: the least t with t ≥ 1 and t ≥ 2.

        >>> found = minimised("t", {"t": ()}, lambda x: iter([(x["t"] - k * x["1"])[:, None, None] for k in (1, 2)]))
        >>> found["t"].round(6).tolist()
        2.0
    """
    unknowns, at, places = {}, 0, {}
    sizes = {name: _count(name, shape) for name, shape in shapes.items()}
    total = sum(sizes.values())
    for name, shape in shapes.items():
        batch = np.zeros((1 + total, sizes[name]))
        batch[1 + at : 1 + at + sizes[name]] = np.eye(sizes[name])
        unknowns[name], places[name] = _shaped(name, shape, batch), slice(at, at + sizes[name])
        at += sizes[name]
    unknowns["1"] = np.eye(1 + total)[0]
    told: list[Block] = []
    for block in blocks(unknowns):
        columns = upper(block)
        told.append((-columns[1:].T, columns[0]))
    cost = np.zeros(total)
    cost[places[what]] = 1.0
    x = semidefinite(cost, told)
    if x is None or not np.isfinite(x).all():
        return None
    return {name: _shaped(name, shape, x[None, places[name]])[0] for name, shape in shapes.items()}


def _count(name: str, shape: tuple[int, ...]) -> int:
    return shape[0] * (shape[0] + 1) // 2 if name == "Q" else int(np.prod(shape))


def _shaped(name: str, shape: tuple[int, ...], entries: Array) -> Array:
    """Return entries (c, …) as what they are of; of Q as `upper` has it."""
    return symmetric_of(entries, shape[0]) if name == "Q" else entries.reshape(-1, *shape)
