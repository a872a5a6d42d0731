"""What is measured of a run, block by block."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from pwatrack.simulation.closed_loop import Response
from pwatrack.simulation.flow import Mode
from pwatrack.simulation.trace import last_tenth


@dataclass(kw_only=True)
class Figures:
    """Measures of a run, taken block by block.

    Attributes:
        final_tracking_error: Largest norm in the last tenth of the time.
        largest_tracking_error: Largest norm.
        final_observer_error: ‖x − x̂‖ at the end.
        largest_input: Largest entry of u.
        mode_changes: How many.
        joint_modes: How many there were.
    """

    final_tracking_error: float = 0.0
    largest_tracking_error: float = 0.0
    final_observer_error: float = 0.0
    largest_input: float = 0.0
    mode_changes: int = 0
    joint_modes: int = 0

    @staticmethod
    def of(blocks: Iterable[Response], samples: int) -> "Figures":
        """Measure all blocks of a run of so many samples."""
        figures, visited, number, tail = Figures(), set[Mode](), 0, last_tenth(samples).start
        for block in blocks:
            size = np.linalg.norm(block.tracking_error, axis=1)
            figures.largest_tracking_error = max(figures.largest_tracking_error, float(size.max()))
            last = size[max(0, tail - number) :]
            figures.final_tracking_error = max(figures.final_tracking_error, float(last.max(initial=0.0)))
            figures.final_observer_error = float(block.observer_error[-1])
            figures.largest_input = max(figures.largest_input, float(np.abs(block.u).max()))
            figures.mode_changes += len(block.trace.events)
            visited |= block.trace.visited()
            number += len(size)
        figures.joint_modes = len(visited)
        return figures
