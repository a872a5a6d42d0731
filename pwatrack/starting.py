"""Where the parts of a run start, as its spec says."""

from collections.abc import Mapping

import numpy as np

from pwatrack.arrays import Array
from pwatrack.causes import Subject
from pwatrack.control.generator import TrajectoryGenerator
from pwatrack.control.trajectory import DesiredTrajectory
from pwatrack.errors import InvalidSpec, Problem
from pwatrack.simulation.startup import steady_start
from pwatrack.spec.spec import Spec, Steady
from pwatrack.spec.wording import guess, shown


def generator_start(spec: Spec, trajectory: DesiredTrajectory, generator: TrajectoryGenerator | None) -> Array:
    """Return η̂(0), in order or by the names of the states of the generator.

    Raises:
        InvalidSpec: If it has another number of entries, or names, or begins in a steady state that there is not.
    """
    given, names, subject = spec.scenario.initial.generator, trajectory.names, ("simulation", "initial", "generator")
    if isinstance(given, Steady):
        return steady_start(trajectory, generator)
    if not isinstance(given, Mapping):
        return initial_values(given, len(names), "generator")
    unknown = [
        Problem(
            message=f"{'.'.join(subject)}: {shown(name)} is no state of the generator: "
            f"{', '.join(names) or 'it has none'}{guess(name, names)}",
            subject=(*subject, name),
        )
        for name in given
        if name not in names
    ]
    if unknown:
        raise InvalidSpec(*unknown)
    return np.array([given.get(name, 0.0) for name in names])


def initial_values(values: Array | None, length: int, part: str) -> Array:
    """Return where a part starts, 0 where nothing is said.

    Raises:
        InvalidSpec: If it has another number of entries.
    """
    if values is None:
        return np.zeros(length)
    if len(values) != length:
        subject: Subject = ("simulation", "initial", part)
        raise InvalidSpec(
            Problem(message=f"simulation.initial.{part}: {len(values)} entries, expected {length}", subject=subject)
        )
    return values
