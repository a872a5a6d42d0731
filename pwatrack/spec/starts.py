"""Sections -> where a run and the members of an ensemble start."""

from collections.abc import Mapping, Sequence

import numpy as np

from pwatrack.arrays import Array, readonly
from pwatrack.simulation.region import Box, Ellipsoid, Region
from pwatrack.spec.simulation_section import EllipsoidSection, InitialSection, StartRegionsSection
from pwatrack.spec.spec import InitialStates, Measured, Steady


def initial_states(section: InitialSection, states: Sequence[str]) -> InitialStates:
    """Return where a run starts."""
    observer, generator = section.observer, section.generator
    return InitialStates(
        plant=Steady() if isinstance(section.plant, str) else _in_order(section.plant, states),
        observer=Measured() if isinstance(observer, str) else _in_order(observer, states),
        generator=Steady()
        if isinstance(generator, str)
        else readonly(generator)
        if isinstance(generator, list)
        else generator,
    )


def _in_order(values: Mapping[str, float] | Sequence[float] | None, states: Sequence[str]) -> Array | None:
    """Return initial values in the order of the states; those that are not named are 0."""
    if values is None:
        return None
    return readonly([values.get(name, 0.0) for name in states] if isinstance(values, Mapping) else values)


def regions(section: StartRegionsSection | None, states: Sequence[str], nominal: InitialStates) -> dict[str, Region]:
    """Return where the members of an ensemble start, by part; entries that are not named stay at their nominal value.

    Args:
        section: None for nothing.
        states: Names of the states of plant and observer.
        nominal: Where the run starts that is varied.
    """
    found: dict[str, Region] = {}
    for part in ("plant", "observer"):
        asked, start = getattr(section, part, None), getattr(nominal, part)
        if asked is None:
            continue
        center = dict(
            zip(states, start.tolist() if isinstance(start, np.ndarray) else [0.0] * len(states), strict=True)
        )
        if isinstance(asked, EllipsoidSection):
            center |= asked.ellipsoid.center
            radii = [asked.ellipsoid.radii.get(name, 0.0) for name in states]
            found[part] = Ellipsoid(center=readonly(list(center.values())), radii=readonly(radii))
        else:
            bounds = [asked.get(name, [value, value]) for name, value in center.items()]
            found[part] = Box(low=readonly([low for low, _ in bounds]), high=readonly([high for _, high in bounds]))
    if section is not None and section.generator is not None:
        low, high = zip(*section.generator, strict=True) if section.generator else ((), ())
        found["generator"] = Box(low=readonly(low), high=readonly(high))
    return found
