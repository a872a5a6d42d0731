"""How signals, their units and sizes, and numbers are written: the same in files, at the terminal and in pictures."""

from pwatrack.model.sizes import Sizes
from pwatrack.spec.spec import Spec
from pwatrack.workflow.result import SimulatedLoop


def error_unit(result: SimulatedLoop) -> str:
    """Return the unit of the norm of the tracking error: of several entries it is in sizes."""
    names = result.controller.error_names
    return result.spec.problem.units.get(names[0], "") if len(names) == 1 else "sizes"


def states_unit(spec: Spec) -> str:
    """Return the unit of a norm of all states: of several it is in sizes."""
    states = spec.problem.plant.states
    return spec.problem.units.get(states[0], "") if len(states) == 1 else "sizes"


def size_texts(sizes: Sizes, most: int) -> list[str]:
    """Return the sizes as a file would give them, of many the first, and where they are from.

    Example:
        >>> from pwatrack import load_spec
        >>> from pwatrack.workflow.sizing import spec_sizes
        >>> size_texts(spec_sizes(load_spec("specs/gallery/two_rooms.yaml")), 20)[1]
        'balanced: T1, T2, y1, y2; reference: u1, u2; speed 0.001449 1/s'
    """
    known = sizes.by_name
    shown = list(known)[:most]
    said = [f"sizes: {{{', '.join(f'{name}: {known[name]:.4g}' for name in shown)}}}"]
    if most < len(known):
        said.append(f"… and {len(known) - most} more sizes (--json lists all)")
    origins = dict.fromkeys(sizes.origins[name] for name in shown)
    groups = [f"{origin}: {', '.join(n for n in shown if sizes.origins[n] == origin)}" for origin in origins]
    return [*said, f"{'; '.join(groups)}; speed {sizes.speed:.4g} 1/s"]
