"""What eigenvalues decide of (8) and (9) before anything is solved: modes that no gain moves, or the given one not."""

import numpy as np

from pwatrack.control import refusal
from pwatrack.control.goal import Given, Goal, demands
from pwatrack.control.synthesis import given
from pwatrack.control.task import Task
from pwatrack.errors import PwatrackError
from pwatrack.lmi.between import stuck_between
from pwatrack.lmi.infeasibility import Refutation
from pwatrack.lmi.multipliers import whole
from pwatrack.lmi.presolve import corners
from pwatrack.lmi.role import CONTROLLER, OBSERVER
from pwatrack.lmi.stuck import stuck_modes
from pwatrack.model.pwa import PWASystem
from pwatrack.model.sizes import Sizes
from pwatrack.rational import decimals, identity

_HARDLY = 1e-6  # of the size of a cell: a mode that is reached by less, or decays by less, is looked at exactly


def check_modes(plant: PWASystem, controller: Goal, observer: Goal, sizes: Sizes) -> None:
    """Refuse goals that a single cell rules out: exactly, and in no time.

    Args:
        plant: The system (1).
        controller, observer: What K and L are to achieve.
        sizes: Those of the plant's signals.

    Raises:
        Infeasible: With the modes, of (8) and (9) together.
    """
    found = list[PwatrackError]()
    for role, goal in ((CONTROLLER, controller), (OBSERVER, observer)):
        task = Task.of(plant, role, sizes=sizes)
        try:
            if isinstance(goal, Given):
                K = role.oriented(goal.gain)
                if np.linalg.eigvals(task.unlike(K)).real.max() >= 0:
                    given(task, K)
            else:
                _check(task, demands(goal)[0])
        except PwatrackError as error:
            found.append(error)
    if found:
        raise type(found[0])(*(p for error in found for p in error.problems), evidence=found[0].evidence)


def _check(task: Task, rate: float) -> None:
    cells = _looked_at(task, rate)
    A, B = task.numbers
    shift = decimals(np.array([[rate]]))[0, 0] * identity(B.nrows())
    Z, eigenvalues = stuck_modes([A[i] + shift for i in cells], B)
    if Z:
        named = {cells[i]: v for i, v in eigenvalues.items()}
        proof = Refutation(Z=whole({cells[i]: Z_i for i, Z_i in Z.items()}), eigenvalues=named)
        raise refusal.no_gain(task, rate, proof, np.nan)
    at = corners(task.A).tolist()
    mean = stuck_between(task.A[at] + rate * np.eye(B.nrows()), task.B, [A[i] + shift for i in at], B)
    if mean is not None:
        raise refusal.no_gain(task, rate, Refutation(Z={}, eigenvalues={}, between=mean.of(at)), np.nan)


def _looked_at(task: Task, rate: float) -> list[int]:
    """Return the cells in which a mode that is too slow is hardly reached: there [A − λI, B], in sizes, is singular."""
    s, found = task.scale.state, []
    B = task.B / s[:, None] * task.scale.input
    for i, A in enumerate(task.A / s[:, None] * s):
        size = float(np.linalg.norm(A, 2))
        values = np.linalg.eigvals(A)
        slow = values[values.real >= -rate - _HARDLY * size]
        pencils = [np.hstack([A - v * np.eye(len(A)), B * (size or 1.0) / (np.linalg.norm(B, 2) or 1.0)]) for v in slow]
        if any(np.linalg.svd(X, compute_uv=False)[-1] <= _HARDLY * (size or 1.0) for X in pencils):
            found.append(i)
    return found
