"""Which matrix inequality of the paper something is about: (7), (8), (9) or (17).

All four are M_i P + P M_iᵀ ≺ 0 in every cell, for M_i = A_i + B K in (8), and for the transposes of A_i in (7),
of A_i + L C in (9) and of A_ηi in (17).
"""

from dataclasses import dataclass

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix
from pwatrack.causes import ProblemPart


@dataclass(frozen=True, kw_only=True)
class Role:
    """What is proved to converge."""

    name: str  # "controller", "observer", "generator" or "plant", as in the files that a run writes
    claim: str  # its inequality, `"(8)"`
    part: ProblemPart  # what a refusal of it is about
    letter: str = ""  # the gain that it has, "K" or "L"; empty where it has none
    transposed: bool = True  # whether M_i is the transpose of what changes errors: P, not P⁻¹, is their norm

    def oriented(self, X: Array) -> Array:
        """Return M_i of the matrix by which errors change, or the other way round; the gain of (8) of K or L too."""
        return X.swapaxes(-1, -2) if self.transposed else X

    def exact(self, X: BallMatrix) -> BallMatrix:
        """Do the same with an exact matrix."""
        return X.transpose() if self.transposed else X


PLANT = Role(name="plant", claim="(7)", part=ProblemPart.PLANT)
CONTROLLER = Role(name="controller", claim="(8)", part=ProblemPart.CONTROLLER, letter="K", transposed=False)
OBSERVER = Role(name="observer", claim="(9)", part=ProblemPart.OBSERVER, letter="L")
GENERATOR = Role(name="generator", claim="(17)", part=ProblemPart.CELLS)
