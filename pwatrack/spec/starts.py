"""Sections -> where a run and the members of an ensemble start."""

from collections.abc import Mapping, Sequence

from pwatrack.arrays import Array, readonly
from pwatrack.simulation.region import Box, Ellipsoid, Region
from pwatrack.spec.schema import EllipsoidSection, StartRegionsSection


def in_order(values: Mapping[str, float] | Sequence[float] | None, states: Sequence[str]) -> Array | None:
    """Return initial values in the order of the states; those that are not named are 0."""
    if values is None:
        return None
    return readonly([values.get(name, 0.0) for name in states] if isinstance(values, Mapping) else values)


def regions(
    section: StartRegionsSection | None, states: Sequence[str], nominal: Mapping[str, Array | None]
) -> dict[str, Region]:
    """Return where the members of an ensemble start, by part; entries that are not named stay at their nominal value.

    Args:
        section: None for nothing.
        states: Names of the states of plant and observer.
        nominal: Initial states of both by part; None for zero.
    """
    found: dict[str, Region] = {}
    for part in ("plant", "observer"):
        asked, start = getattr(section, part, None), nominal[part]
        if asked is None:
            continue
        center = dict(zip(states, [0.0] * len(states) if start is None else start.tolist(), strict=True))
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
