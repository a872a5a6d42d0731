"""What keeps a gain within limits of its inputs: errors with which a run may begin, and what the inputs may then do.

With P ⪰ z zᵀ for all these errors z, the inequality of the decay and [ū_j², Y_j; Y_jᵀ, P] ⪰ 0, the gain K = Y P⁻¹ has
|K_j e| ≤ ū_j √(eᵀ P⁻¹ e) ≤ ū_j at all times (Boyd et al., Linear Matrix Inequalities in System and Control Theory,
1994, section 7.2.3).
"""

from dataclasses import dataclass

import numpy as np

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix, different
from pwatrack.control.task import Task
from pwatrack.lmi.ellipsoid import Inner, held
from pwatrack.lmi.exact import Certificate


@dataclass(frozen=True, kw_only=True)
class InputConstraint:
    """Errors e = G ζ, |ζ_k| ≤ 1, from which |K e| is to stay within bounds.

    Attributes:
        starts: G (n, k), of rank n.
        left: ū (m,), positive; infinite where an input has no limit.
    """

    starts: Array
    left: Array

    def share(self, task: Task, K: Array, proof: Certificate) -> float:
        """Return how many times as large these errors may be for a gain, by an exact proof; 0 where there is none.

        Args:
            task: It has the plant.
            K: (m, n), as printed.
            proof: That it stabilises.

        Example: |e| ≤ 2 at the start and u = −e / 2 is at most 1, of 3 that there are.

            >>> task = Task(A=np.zeros((1, 1, 1)), B=np.eye(1), cells=["all"])
            >>> K = np.array([[-0.5]])
            >>> within = InputConstraint(starts=np.array([[2.0]]), left=np.array([3.0]))
            >>> 2.999 < within.share(task, K, task.reached(K, np.eye(1), 0.0)) <= 3
            True
        """
        if not K.any():
            return np.inf
        limited = np.flatnonzero(np.isfinite(self.left))
        rows = BallMatrix.of(K[limited], (len(limited), K.shape[1]))
        closed, inner = different(task.exactly_closed(K)), Inner.proved(proof.P, proof.rate)
        found = held(closed, self.starts, rows, self.left[limited], inner)
        sizes = np.zeros(0) if found is None else np.array(found.sizes)
        return 0.0 if found is None else float(1 / (sizes / self.left[limited]).max())
