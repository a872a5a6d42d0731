"""Which method solves a program. What comes back proves nothing before it is looked at."""

from pwatrack.lmi import primal_dual
from pwatrack.lmi.inequality import Solver
from pwatrack.lmi.program import Program, Solution

LARGE = 10  # states from which on the primal–dual method of our own is the faster one, and more so with every state


def solve(program: Program, solver: Solver = "clarabel", *, gap: float = 1e-6) -> Solution | None:
    """Return a minimiser of a program, or None if nothing was found.

    Large programs go to the method of `primal_dual`, unless CVXOPT is asked for; all others, and those
    that it gives up, to PICOS.

    Args:
        program: What is asked.
        solver: Which solver PICOS asks.
        gap: Share of the objective that may be missed; PICOS' solvers miss less.
    """
    if program.n >= LARGE and solver == "clarabel":
        found = primal_dual.solve(program, gap=gap)
        if found is not None:
            return found
    from pwatrack.lmi import picos_model  # imports PICOS, which takes a while

    return picos_model.solve(program, solver)
