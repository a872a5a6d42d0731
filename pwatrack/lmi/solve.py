"""Which method solves a program. What comes back is a candidate: it proves nothing before it is looked at."""

from pwatrack.lmi import structured
from pwatrack.lmi.inequality import Solver
from pwatrack.lmi.program import Candidate, Program

LARGE = 10  # states from which on the structured method is the faster one, and more so with every state


def solve(program: Program, solver: Solver = "clarabel") -> Candidate | None:
    """Return a minimiser of a program, or None if nothing was found.

    Large programs with a known start go to the barrier method of `structured`, unless CVXOPT is asked for; all others,
    and those that it gives up, to PICOS.
    """
    if program.n >= LARGE and solver == "clarabel":
        candidate = structured.solve(program)
        if candidate is not None:
            return candidate
    from pwatrack.lmi import picos_model  # imports PICOS, which takes a while

    return picos_model.solve(program, solver)
