"""What is said where no gain was found for (8) or (9): the reason, the cells in conflict, how far it was."""

from collections.abc import Sequence

import numpy as np

from pwatrack.arrays import Array, complex_text, number_text
from pwatrack.control.task import Task
from pwatrack.errors import Infeasible, InvalidSpec, Problem, ProblemPart, PwatrackError, Remedy, Undecided, Way, listed
from pwatrack.lmi.dichotomy import NoDichotomy
from pwatrack.lmi.inequality import CONTROLLER
from pwatrack.lmi.infeasibility import Impossibility, Refutation
from pwatrack.lmi.solve import asked
from pwatrack.rational import floats, unreachable

_SEEN = 1e-9  # of the largest entry of a mode: what is smaller is rounding
_NAMED = 3  # states that a mode is reached by, the best first


def no_gain(task: Task, rate: float, refutation: Refutation | None, margin: float) -> PwatrackError:
    """Return the refusal with the proof that no gain reaches the rate (1/s), or say that there is neither.

    The margin is the best that was found, relative to the largest entries.
    """
    claim = f"{task.role.claim} at a rate of {rate:g} 1/s" if rate else task.role.claim
    subject = (
        (task.role.part, ProblemPart.RATE) if rate else (ProblemPart.B if task.role is CONTROLLER else ProblemPart.C,)
    )
    if refutation is None:
        message = f"{claim} is undecided: no gain with a proof was found, and no proof that there is none"
        if np.isfinite(margin):
            message += f"; the best margin found is {margin:.2g}, relative to the largest entries"
        hint = "another actuator or measured output may help, or the other solver"
        return Undecided(message, subject=subject, hint=hint, remedy=other_solver())
    slower = ", or a slower rate" if rate else ""
    able = f"though each {'reaches that rate' if rate else 'can be stabilised'} by itself"
    if refutation.eigenvalues:
        worst = sorted(refutation.eigenvalues.items(), key=lambda item: -item[1].real)
        modes = [f"{complex_text(v - rate)} in cell '{task.cells[i]}'" for i, v in worst]
        hint = reached_by(task, *worst[0], rate)
    elif (mean := refutation.between) is not None:
        parts = [f"{number_text(float(share))} of cell '{task.cells[i]}'" for i, share in mean.weights.items()]
        moved = f"{number_text(float(mean.eigenvalue) - rate)} of {joined(parts)}"
        hint = f"{_reaching(task, mean.v)}, or cells that differ less"
    else:
        hint = "another actuator or another measured output may help, cells that differ less"

    def tell(most: int | None) -> str:
        if refutation.eigenvalues:
            return f"{claim} is infeasible: no gain moves the eigenvalue {listed(modes, most)}"
        if refutation.between is not None:
            said = f"it is about every mean of cells, and no gain moves the eigenvalue {moved}"
        else:
            said = f"{conflict_text(refutation, task.cells, most)}, no gain with a common P exists for them"
        return f"{claim} is infeasible: {said}, {able}"

    return Infeasible(
        Problem.of_many(tell, subject=subject, hint=hint + slower),
        evidence=Impossibility(role=task.role, rate=rate, refutation=refutation),
    )


def reached_by(task: Task, cell: int, eigenvalue: complex, rate: float) -> str:
    """Say which actuator would move a mode that no gain moves, or which sensor would see it.

    A mode v with vᵀ A_i = λ vᵀ and vᵀ B = 0 moves with each further input b that has vᵀ b ≠ 0. The states are named in
    the order of |v_k|, counted in sizes; for (9) all is transposed, and v is what a sensor c must see, c v ≠ 0.
    The eigenvalue λ is shifted by the rate (1/s).

    Example:
        >>> task = Task(A=np.diag([3.0, -1.0])[None], B=np.array([[0.0], [1.0]]), cells=["all"], states=["p", "q"])
        >>> reached_by(task, 0, 3.0, 0.0)
        'another actuator must reach this mode: any that acts on dp/dt does'
    """
    A, B = task.centres
    N, A_u = unreachable(A[cell], B)
    values, vectors = np.linalg.eig(floats(A_u).T)
    return _reaching(task, floats(N).T @ vectors[:, np.argmin(np.abs(values + rate - eigenvalue))])


def _reaching(task: Task, mode: Array) -> str:
    """Say which actuator would move a mode v (n,), or which sensor would see it."""
    seen = np.abs(mode * task.scale.state)[: len(task.states)]
    order = [k for k in np.argsort(-seen, kind="stable") if seen[k] > _SEEN * seen.max()]
    acts = task.role is CONTROLLER
    wanted = "another actuator must reach this mode" if acts else "another measured output must show this mode"
    if not order:
        return wanted
    names = [f"d{task.states[k]}/dt" if acts else task.states[k] for k in order[:_NAMED]]
    best = "" if len(names) == 1 else f", {'on' if acts else 'of'} the first most"
    return f"{wanted}: {'any that acts on' if acts else 'a sensor of'} {joined(names, 'or')} does{best}"


def joined(names: Sequence[str], by: str = "and") -> str:
    """Return names with commas, and a word before the last one."""
    *some, last = names
    return f"{', '.join(some)} {by} {last}" if some else last


def other_solver() -> Remedy:
    """Return the advice to ask another solver: one that has not answered yet.

    Example:
        >>> other_solver().figures
        ('cvxopt',)
    """
    return Remedy(Way.OTHER_SOLVER, ("clarabel" if asked() == "cvxopt" else "cvxopt",))


def too_large(task: Task, rate: float, bound: float, norm: float) -> Undecided:
    """Return the refusal of a bound on the gain that the smallest gain found, of this norm, is above."""
    at_rate = f" at a rate of {rate:g} 1/s" if rate else ""
    return Undecided(
        f"{task.role.claim}{at_rate}: no gain with a norm of at most {bound:g} was found; "
        f"the smallest that was found has {norm:.4g}",
        subject=(task.role.part, ProblemPart.BOUND),
        hint="allow a larger gain or a slower rate",
    )


def no_largest_rate(task: Task, rate: float) -> InvalidSpec:
    """Return the refusal to look for a largest rate, where even this one (1/s) is reached."""
    return InvalidSpec(
        f"{task.role.claim}: no largest rate was found: even {rate:.4g} 1/s can be reached, with ever larger gains",
        subject=(task.role.part, ProblemPart.RATE),
        hint="give a bound of the gain beside it, or the rate that is wanted",
        remedy=Remedy(Way.GAIN_BOUND),
    )


def conflict_text(refutation: Refutation | NoDichotomy, cells: Sequence[str], most: int | None = None) -> str:
    """Name the cells in conflict, or at most so many of them."""
    names = [f"'{cells[i]}'" for i in refutation.Z]
    few = most is None or len(names) <= most + 1
    return f"cells {joined(names) if few else listed(names, most)} conflict"


def eigenvalue_text(abscissa: Array, cells: Sequence[str], most: int | None = None) -> str:
    """Say the largest real part of the eigenvalues of each cell, the worst first, or of the worst so many."""
    parts = [f"{number_text(abscissa[i], '+.4g')} in cell '{cells[i]}'" for i in np.argsort(-abscissa, kind="stable")]
    return "largest real part of the eigenvalues: " + listed(parts, most)
