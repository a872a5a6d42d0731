"""What bounds.json holds: the table "what 1 unit of … does to …"."""

from collections.abc import Iterator
from typing import Any

from pwatrack.claims.bounds import SignalBounds, bound_entry
from pwatrack.claims.robust import Robust
from pwatrack.control.controller import ProvedController
from pwatrack.spec.spec import Spec

FORMAT = "pwatrack bounds 1"


def bound_content(spec: Spec, controller: ProvedController) -> dict[str, Any]:
    """Return the content of bounds.json."""
    words, found = spec.words, controller.claim(SignalBounds)
    table = [bound_entry(words, bounds) for bounds in (*found.acting, *found.starts)]
    for robust in controller.claims_of(Robust):
        table += [bound_entry(words, bounds, uncertain=True) for bounds in robust.bounds]
    return {
        "format": FORMAT,
        "name": spec.name,
        "spec_sha256": spec.sha256,
        "meaning": "signals are at most the sum of these bounds, each times the size of what acts; in_the_end: once "
        "the start is forgotten; at_worst: at any time, for what acts from the start on",
        "table": table,
        "start_within_sizes": {
            "sizes": dict(_start_sizes(controller)),
            "signals": {
                name: {"in_the_end": 0.0, "at_worst": size, "unit": unit}
                for (name, unit), size in (
                    (words.signal(form), size) for form, size in found.from_sizes(controller).items()
                )
            },
        },
    }


def _start_sizes(controller: ProvedController) -> Iterator[tuple[str, float]]:
    plant, sizes = controller.plant, controller.sizes
    yield from zip(plant.states, sizes.state.tolist(), strict=True)
    if plant.loads is not None:
        yield from zip(plant.loads.names, sizes.load[list(plant.loads.where)].tolist(), strict=True)
