"""How signals, their units and sizes, and numbers are written: the same in files, at the terminal and in pictures."""

from decimal import ROUND_FLOOR, Context

from pwatrack.arrays import number_text
from pwatrack.control.bounds import Form
from pwatrack.model.loads import Load
from pwatrack.model.sizes import Sizes
from pwatrack.spec.spec import Spec
from pwatrack.study.result import Result


def all_cells(count: int) -> str:
    """Return all cells of a plant in words.

    Example:
        >>> all_cells(1), all_cells(3)
        ('the one cell', 'all 3 cells')
    """
    return "the one cell" if count == 1 else f"all {count} cells"


def error_unit(result: Result) -> str:
    """Return the unit of the norm of the tracking error: of several entries it is in sizes."""
    names = result.controller.error_names
    return result.spec.problem.units.get(names[0], "") if len(names) == 1 else "sizes"


def states_unit(spec: Spec) -> str:
    """Return the unit of a norm of all states: of several it is in sizes."""
    states = spec.problem.plant.states
    return spec.problem.units.get(states[0], "") if len(states) == 1 else "sizes"


def load_kind(load: Load) -> str:
    """Return what is known of an unknown load."""
    return f"{number_text(float(load.frequency), 'g')} rad/s" if load.frequency.centre else "constant"


def signal_text(spec: Spec, signal: Form) -> tuple[str, str]:
    """Return a signal that is bounded, as text, and its unit."""
    kind, k = signal
    plant = spec.problem.plant
    named = {"output": plant.tracked_names, "input": plant.inputs}.get(kind, plant.states)
    loads = {} if plant.loads is None else dict(zip(plant.loads.where, plant.loads.names, strict=True))
    name = named[k] if k < len(named) else loads[k - len(named)]
    texts = {"input": f"{name} - {name}_ff", "estimate": f"{name}_hat - {name}"}
    return texts.get(kind, f"{name} - {name}_d"), spec.problem.units.get(name, "")


def size_texts(sizes: Sizes, most: int) -> list[str]:
    """Return the sizes as a file would give them, of many the first, and where they are from.

    Example:
        >>> from pwatrack import load_spec
        >>> from pwatrack.study.sizing import spec_sizes
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


def sized(name: str) -> str:
    """Return the size of a signal in words."""
    return f"|{name.replace('-', '−')}|"


def down(value: float) -> str:
    """Return a number in four digits, not larger: what is said must be proved too.

    Example:
        >>> down(0.0826799), down(1.4009)
        ('0.08267', '1.4')
    """
    return number_text(float(Context(prec=4, rounding=ROUND_FLOOR).create_decimal(value)), ".4g")


def per_second(unit: str) -> str:
    """Return the unit of a derivative.

    Example:
        >>> [per_second(unit) for unit in ("m", "m/s", "K/s", "N m", "m3/h", "")]
        ['m/s', 'm/s²', 'K/s²', 'N m/s', '(m3/h)/s', '']
    """
    if unit.endswith("/s"):
        return f"{unit}²"
    return unit and (f"({unit})/s" if "/" in unit else f"{unit}/s")
