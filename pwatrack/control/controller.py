"""What runs on the machine: observer (18), controller (19), generator (15), feedforward (16)."""

from dataclasses import dataclass

from pwatrack.control.generator import TrajectoryGenerator
from pwatrack.control.synthesis import Design
from pwatrack.model.pwa import PWASystem


@dataclass(frozen=True, kw_only=True)
class Controller:
    """The overall design of Theorem 3.

    x̂' = A_i x̂ + b_i + B u + L (ŷ − y), ŷ = C x̂ (18);  u = K (x̂ − x̂_d) + û_ff (19);
    x̂_d from the generator (15); û_ff from the feedforward (16).
    """

    plant: PWASystem
    design: Design
    generator: TrajectoryGenerator
