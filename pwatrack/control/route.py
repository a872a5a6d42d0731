"""Ways to a controller, each judged before an inequality is solved: yes, no with the reason, or what it needs."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pwatrack.arrays import number_text
from pwatrack.errors import OutsideTheory
from pwatrack.model.normal_form import NormalForm
from pwatrack.model.pwa import PWASystem

Tracking = Literal["output", "state", "practical"]
_ROUNDING = 1e-12  # of the largest eigenvalue, up to which a real part may be 0


@dataclass(frozen=True, kw_only=True)
class Facts:
    """What routes are judged by.

    Attributes:
        plant: The system (1); that it is one has been proved.
        form: Its normal form (11), or None.
        refusal: Why there is no normal form, else None.
        zero_dynamics: Eigenvalues of A_η in each cell, (l, n − r); None without a normal form.
        stuck: Why (8) or (9) have no solution, where the modes of single cells decide that; else "".
        tracking: What was asked for.
        asked: Whether practical tracking is asked for, after any refusal of the theory.
        uncertain: Whether only intervals of some parameters are known.
        known: Whether the reference is known beforehand.
        merged: The same of the plant with all cells merged that can be; None where none can.
    """

    plant: PWASystem
    form: NormalForm | None
    refusal: OutsideTheory | None
    zero_dynamics: NDArray[np.complex128] | None
    stuck: str = ""
    tracking: Tracking = "output"
    asked: bool = False
    uncertain: bool = False
    known: bool = True
    merged: "Facts | None" = None


@dataclass(frozen=True)
class Yes:
    """It can be gone, whatever an inequality says."""

    remark: str = ""

    @property
    def text(self) -> str:
        """In words."""
        return f"yes{self.remark and '; '}{self.remark}"


@dataclass(frozen=True)
class No:
    """It cannot be gone, and why."""

    reason: str

    @property
    def text(self) -> str:
        """In words."""
        return f"no: {self.reason}"


@dataclass(frozen=True)
class Needs:
    """It can be gone if some inequalities have a solution, which is not tried here."""

    inequalities: str
    remark: str = ""

    @property
    def text(self) -> str:
        """In words."""
        return f"needs {self.inequalities}{self.remark and '; '}{self.remark}"


Answer = Yes | No | Needs


@dataclass(frozen=True, kw_only=True)
class Route:
    """A way to a controller.

    Attributes:
        name: In a few words.
        takes: For which kinds of tracking `design` goes it; nothing where it is only of interest.
        judge: What can be said of it.
    """

    name: str
    takes: frozenset[Tracking] = frozenset()
    judge: Callable[[Facts], Answer]


def stable(plant: PWASystem, eigenvalues: NDArray[np.complex128], then: Needs, otherwise: str) -> Answer:
    """Return `then` if all eigenvalues (l, k) are in the left half plane, else no, with the worst one and its cell."""
    abscissa = eigenvalues.real.max(axis=1, initial=-np.inf)
    worst = int(np.argmax(abscissa))
    if abscissa[worst] < 0:
        return then
    is_rounding = sides(eigenvalues[worst]).max() == 0
    size = "0 to rounding" if is_rounding else number_text(abscissa[worst], "+.4g")
    return No(f"{otherwise}: an eigenvalue has real part {size} in cell '{plant.cell_names[worst]}'")


def sides(eigenvalues: NDArray[np.complex128]) -> NDArray[np.int64]:
    """Return on which side of the imaginary axis eigenvalues are: −1, 1, or 0 where only rounding decides it.

    Example:
        >>> sides(np.array([-3.0, 1e-17 + 2j, 0.1])).tolist()
        [-1, 0, 1]
    """
    real = eigenvalues.real
    near = np.abs(real) <= _ROUNDING * np.abs(eigenvalues).max(initial=0.0)
    return np.where(near, 0, np.sign(real)).astype(np.int64)
