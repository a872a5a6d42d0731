"""What a faster decay costs: the smallest gain at each rate, (8) and (9)."""

from dataclasses import dataclass

import numpy as np

from pwatrack.arrays import Array, readonly
from pwatrack.control.synthesis import Search
from pwatrack.control.task import Task
from pwatrack.lmi.bisection import bisected
from pwatrack.lmi.inequality import Role

_FACTORS = (0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)  # of the rate at hand
_SAME_RATE = 1e-3  # of a rate: what is slower by less counts as reaching it
_BISECTIONS = 4  # between the fastest rate that was reached and the next


@dataclass(frozen=True, kw_only=True)
class Front:
    """The trade between decay and gain."""

    role: Role  # CONTROLLER or OBSERVER
    rates: Array  # certified rates in 1/s, increasing, (k,)
    norms: Array  # ‖K‖ or ‖L‖ in sizes of the smallest gain found for each, (k,); see `Task.norm`
    limit: float  # a rate in 1/s at which no gain was found any more; infinite if none was reached
    chosen: tuple[float, float]  # rate and norm of the gain that the design has


def pareto(task: Task, K: Array, rate: float) -> Front:
    """Return the smallest gains at rates around that (1/s) of a design with the gain K (m, n)."""
    search, points = Search(task), list[tuple[float, float]]()

    def at(trial: float) -> tuple[float, None] | None:
        found = search.smallest(trial)
        if found is None:
            return None
        points.append((found[1].rate, task.norm(found[0])))
        return found[1].rate, None

    limit = next((factor * rate for factor in _FACTORS if at(factor * rate) is None), np.inf)
    if np.isfinite(limit) and points:
        limit = bisected((points[-1][0], None), limit, at, near=0.0, most=_BISECTIONS)[2]
    chosen = rate, task.norm(K)
    found = np.array([*points, chosen])  # what reaches a rate reaches every lower one
    points = [(a, float(found[found[:, 0] >= a * (1 - _SAME_RATE), 1].min())) for a, _ in points]
    columns = np.array(points).reshape(-1, 2)
    return Front(
        role=task.role, rates=readonly(columns[:, 0]), norms=readonly(columns[:, 1]), limit=limit, chosen=chosen
    )
