"""Which method solves a program. What comes back proves nothing before it is looked at."""

from pwatrack.lmi import primal_dual
from pwatrack.lmi.inequality import Solver
from pwatrack.lmi.program import Program, Solution


def solve(
    program: Program,
    solver: Solver = "clarabel",
    *,
    gap: float = 1e-6,
    against: float | None = None,
    after: Solution | None = None,
) -> Solution | None:
    """Return a minimiser of a program, or None if nothing was found.

    The method of `primal_dual` is asked first, unless CVXOPT is wanted; what it gives up is for Clarabel.

    Args:
        program: What is asked.
        solver: Which solver PICOS asks.
        gap: Share of the objective that may be missed; PICOS' solvers miss less.
        against: It is enough to know whether the objective can be below this number: see `primal_dual`.
        after: The answer to a program that differs little, as the one before it in a sequence.
    """
    if not program.finite:
        return None
    if solver == "clarabel":
        found = primal_dual.solve(program, gap=gap, against=against, after=after)
        if found is not None:
            return found
    from pwatrack.lmi import picos_model  # imports PICOS, which takes a while

    return picos_model.solve(program, solver)
