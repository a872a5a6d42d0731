"""What a spec asks to be proved of a controller: what claims take of it."""

from pwatrack.control.controller import Asked
from pwatrack.control.headroom import Headroom
from pwatrack.spec.box import corners
from pwatrack.spec.spec import Spec


def asked_of(spec: Spec, room: Headroom | None) -> Asked:
    """Return what a spec asks to be proved.

    Args:
        spec: What is asked.
        room: What the feedforward leaves of the limits of its inputs, where there are some.
    """
    problem, goals = spec.problem, spec.objectives
    return Asked(
        words=spec.words,
        room=room,
        box=goals.uncertain,
        corners=lambda plant: corners(problem.parametric, plant, goals.uncertain),
        solver=goals.solver,
    )
