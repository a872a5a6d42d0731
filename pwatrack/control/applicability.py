"""What the theory can do for a plant, before any inequality is solved."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pwatrack.arrays import number_text
from pwatrack.errors import OutsideTheory
from pwatrack.model.normal_form import NormalForm, normal_form
from pwatrack.model.pwa import PWASystem


@dataclass(frozen=True, kw_only=True)
class Applicability:
    """Which theorems apply to a plant, and why not where they do not.

    Attributes:
        plant: The system (1); that it is one has been proved.
        form: Its normal form (11), or None.
        refusal: Why there is no normal form, else None.
        zero_dynamics: Eigenvalues of A_η in each cell, (l, n − r); None without a normal form.
    """

    plant: PWASystem
    form: NormalForm | None
    refusal: OutsideTheory | None
    zero_dynamics: NDArray[np.complex128] | None

    def theorems(self) -> dict[str, str]:
        """Say of each theorem whether it applies, and under which inequalities.

        Example:
            >>> from pwatrack import load_spec
            >>> plant = load_spec("specs/two_mass_backlash.yaml").problem.plant
            >>> applicability(plant).theorems()["Theorem 3"]
            'applies if (8), (9) and (17) are feasible; every cell by itself is minimum phase'
        """
        open_loop = np.linalg.eigvals(self.plant.A).real.max(axis=1)
        first = _stable(self.plant, open_loop, "applies if (7) is feasible; every cell by itself is stable")
        if self.refusal is not None:
            third = f"does not apply: {self.refusal.problems[0].message}"
        else:
            assert self.zero_dynamics is not None
            abscissa = self.zero_dynamics.real.max(axis=1, initial=-np.inf)
            feasible = "applies if (8), (9) and (17) are feasible; every cell by itself is minimum phase"
            third = _stable(self.plant, abscissa, feasible)
        return {"Theorem 1": first, "Theorem 2": "applies if (8) and (9) are feasible", "Theorem 3": third}


def applicability(plant: PWASystem) -> Applicability:
    """Return what the theory can do for a plant.

    Example:
        >>> from pwatrack import load_spec
        >>> applicability(load_spec("specs/two_mass_backlash.yaml").problem.plant).form.r
        2
    """
    try:
        form = normal_form(plant)
    except OutsideTheory as error:
        return Applicability(plant=plant, form=None, refusal=error, zero_dynamics=None)
    return Applicability(
        plant=plant, form=form, refusal=None, zero_dynamics=np.linalg.eigvals(form.Psi).astype(complex)
    )


def _stable(plant: PWASystem, abscissa: NDArray[np.float64], then: str) -> str:
    worst = int(np.argmax(abscissa))
    if abscissa[worst] < 0:
        return then
    size = number_text(abscissa[worst], "+.4g")
    return f"does not apply: an eigenvalue has real part {size} in cell '{plant.cell_names[worst]}'"
