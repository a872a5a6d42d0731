"""Who is asked for a solution. What comes back proves nothing before it is looked at."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from itertools import accumulate
from math import prod
from typing import TypeVar

import numpy as np

from pwatrack.arrays import Array
from pwatrack.lmi import cone_program, primal_dual
from pwatrack.lmi.chain_map import ChainMap
from pwatrack.lmi.cone_program import symmetric_of, upper
from pwatrack.lmi.inequality import Solver
from pwatrack.lmi.program import SemidefiniteProgram, Solution

Found = TypeVar("Found")
Unknowns = Mapping[str, Array]  # each (c, …)

_asked: ContextVar[Solver] = ContextVar("asked", default="structured")
_answered: ContextVar[Counter[str] | None] = ContextVar("answered", default=None)


@contextmanager
def asking(solver: Solver) -> Iterator[None]:
    """Have a solver asked for all programs within: no inequality, and no search, needs to know which one it is.

    "structured" is `primal_dual`, and Clarabel for what it gives up. "clarabel" and "cvxopt" are asked through PICOS,
    and nobody else.
    """
    token = _asked.set(solver)
    try:
        yield
    finally:
        _asked.reset(token)


@contextmanager
def answers() -> Iterator[Counter[str]]:
    """Count who answers the programs within; "nobody" where nothing was found."""
    token = _answered.set(counted := Counter[str]())
    try:
        yield counted
    finally:
        _answered.reset(token)


def asked() -> Solver:
    """Return who is asked here."""
    return _asked.get()


def solve(
    program: SemidefiniteProgram, *, gap: float = 1e-6, against: float | None = None, after: Solution | None = None
) -> Solution | None:
    """Return a minimiser of a program, or None if nothing was found.

    `gap` is the share of the objective that may be missed; PICOS' solvers miss less. It is enough to know whether the
    objective can be below `against`; `after` is the answer to a program that differs little: see `primal_dual`.
    """
    if not program.finite:
        return None
    if asked() == "structured":
        found = primal_dual.solve(program, gap=gap, against=against, after=after)
        if found is not None:
            return _by("structured", found)
    from pwatrack.lmi import picos_model  # imports PICOS, which takes a while

    other: Solver = "cvxopt" if asked() == "cvxopt" else "clarabel"
    return _by(other, picos_model.solve(program, other))


def least(chain: ChainMap, *, gap: float) -> Array | None:
    """Return v that satisfies the constraints of a map without equalities with nearly the least cost, or None."""
    found = primal_dual.least(chain, gap=gap) if asked() == "structured" else None
    if found is not None:
        return _by("structured", found)
    (shape,) = chain.blocks.shapes
    sides = [upper(x.reshape(*shape, -1)) for x in (*map(chain.apply, np.eye(chain.size)), -chain.constant)]
    return semidefinite(chain.cost, [(block[:-1].T, block[-1]) for block in np.array(sides).transpose(1, 0, 2)])


def semidefinite(cost: Array, blocks: Sequence[cone_program.Block]) -> Array | None:
    """Return the answer to a program that is no inequality in P and Y: see `cone_program`, which has the arguments.

    `primal_dual` does not know such programs: Clarabel is asked in its place.
    """
    solver: Solver = "cvxopt" if asked() == "cvxopt" else "clarabel"
    return _by(solver, cone_program.semidefinite(cost, blocks, solver))


def minimised(
    shapes: Mapping[str, tuple[int, ...]], blocks: Callable[[Unknowns], Iterator[Array]]
) -> dict[str, Array] | None:
    """Minimise t subject to blocks ⪰ 0, written down as they stand, affine in all unknowns; Q is symmetric.

    Args:
        shapes: Of all unknowns.
        blocks: Makes symmetric matrices (c, N, N) of unknowns (c, …) and of "1", (c,), which stands for constants.

    Example: the least t with t ≥ 1 and t ≥ 2.

        >>> found = minimised({"t": ()}, lambda x: iter([(x["t"] - k * x["1"])[:, None, None] for k in (1, 2)]))
        >>> found["t"].round(6).tolist()
        2.0
    """
    sizes = {name: prod(shape) if name != "Q" else shape[0] * (shape[0] + 1) // 2 for name, shape in shapes.items()}
    places = {name: slice(end - sizes[name], end) for name, end in zip(sizes, accumulate(sizes.values()), strict=True)}
    total = sum(sizes.values())
    units = np.eye(1 + total)[:, 1:]
    unknowns = {name: _shaped(name, shape, units[:, places[name]].copy()) for name, shape in shapes.items()}
    columns = map(upper, blocks(unknowns | {"1": np.eye(1 + total)[0]}))
    cost = np.zeros(total)
    cost[places["t"]] = 1.0
    x = semidefinite(cost, [(-column[1:].T, column[0]) for column in columns])
    if x is None or not np.isfinite(x).all():
        return None
    return {name: _shaped(name, shape, x[None, places[name]])[0] for name, shape in shapes.items()}


def _shaped(name: str, shape: tuple[int, ...], entries: Array) -> Array:
    """Return entries (c, …) as what they are of; of Q as `upper` has it."""
    return symmetric_of(entries, shape[0]) if name == "Q" else entries.reshape(-1, *shape)


def _by(solver: Solver, found: Found | None) -> Found | None:
    counted = _answered.get()
    if counted is not None:
        counted[solver if found is not None else "nobody"] += 1
    return found
