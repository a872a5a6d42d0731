"""What is odd of a plant by itself: elements that give energy, modes that run away or are not damped."""

import numpy as np

from pwatrack.arrays import Array
from pwatrack.model.nonlinearity import Nonlinearity
from pwatrack.model.pwa import PWASystem
from pwatrack.simulation.modes import modes

_UNDAMPED = 1e-3  # damping of a mode: real machines have more


def plant_warnings(plant: PWASystem) -> list[str]:
    """Say which elements give energy, and which modes of a plant run away or are not damped.

    Example: no cell of the paper's example does.

        >>> from pwatrack import load_spec
        >>> plant_warnings(load_spec("specs/two_mass_backlash.yaml").problem.plant)
        []
    """
    found = [(mode, name) for A, name in zip(plant.A, plant.cell_names, strict=True) for mode in modes(A)]
    away, said = [(mode, name) for mode, name in found if mode.frequency and mode.time_constant < 0], list[str]()
    form = plant.written if away else None
    for element, A in () if form is None else ((one, form.A.floats) for one in form.elements):
        rate = _pushes(A, element)
        if rate > 0 and not any(f"'{element.name}'" in remark for remark in plant.remarks):
            said.append(
                f"'{element.name}' gives energy: it pushes {_looked_at(element, plant)} on, {rate:.3g} 1/s² per unit: "
                "turn the sign of its 'into' if it should hold back"
            )
    if away:
        mode, name = max(away, key=lambda one: -1 / one[0].time_constant)
        cells = f"{len({name for _, name in away})} of {len(plant.A)} cells"
        said.append(
            f"the plant runs away in {cells}, time constant {-mode.time_constant:.3g} s: right for a pendulum, wrong "
            f"for a spring (fastest in '{name}')"
        )
    still = [(mode, name) for mode, name in found if mode.frequency and 0 <= mode.damping < _UNDAMPED]
    if still:
        mode, name = min(still, key=lambda one: one[0].damping)
        said.append(
            f"a mode at {mode.frequency:.3g} rad/s has damping {mode.damping:.2g}: the file leaves it out, or give it "
            f"some (in '{name}')"
        )
    return said


def _pushes(A: Array, element: Nonlinearity) -> float:
    """Return the most by which an element drives what it looks at away, per unit of it: in 1/s², through one rate.

    As in `drives_away`, but of each slope by itself, and of what the element does as a whole.
    """
    row, d = (np.array([float(v) for v in values]) for values in (element.row, element.direction))
    if row @ d != 0:
        return 0.0
    terms = (row @ A) * d
    through = float(terms.sum()) if abs(terms.sum()) > 1e-12 * np.abs(terms).sum() else 0.0
    return max(through * float(slope) for slope in element.function.slopes)


def _looked_at(element: Nonlinearity, plant: PWASystem) -> str:
    names = [name for name, v in zip(plant.states, element.row, strict=True) if float(v)]
    return names[0] if len(names) == 1 else "what it looks at"
