"""What a refusal is about, and what may help: named here, spelled by whoever read the description.

No room below `spec` knows how a file or a command line writes things; see `spec/spelling.py` for that.
"""

from dataclasses import dataclass
from enum import Enum, auto


class ProblemPart(Enum):
    """What of a tracking problem a refusal can be about."""

    PLANT = auto()
    CELLS = auto()
    A = auto()
    b = auto()
    B = auto()
    C = auto()
    TRACKED = auto()
    REFERENCE = auto()
    START = auto()  # of x_d
    GENERATOR_START = auto()  # eta_hat(0)
    DESIGN = auto()
    CONTROLLER = auto()
    OBSERVER = auto()
    UNCERTAIN = auto()  # parameters
    K = auto()
    L = auto()
    RATE = auto()
    BOUND = auto()  # of the norm of a gain
    COST = auto()
    SAMPLE_TIME = auto()  # of the controller
    DURATION = auto()
    ESTIMATE = auto()  # of loads


Subject = tuple[ProblemPart | str | int, ...]


class Way(Enum):
    """What may help where the description is to be changed, or the question to be asked otherwise.

    The comments say which figures go with it.
    """

    STATE_TRACKING = auto()
    PRACTICAL = auto()  # tracking
    STATE_OR_PRACTICAL = auto()
    TRACKED = auto()  # the name of an output
    OFFSET = auto()  # entries of b, and the name of the cell that it is for
    TOLERANCE = auto()  # the tolerance in force
    INTERVAL = auto()  # of a formula that grows
    ROUNDED_CORNERS = auto()
    LONGER_ROUNDING = auto()  # the shortest time in s that would do
    EXACT_NUMBERS = auto()
    OTHER_SOLVER = auto()  # its name
    GAIN_BOUND = auto()
    DESIRED_STATE = auto()
    DESIRED_START = auto()
    SMALLER_BOX = auto()  # of uncertain parameters
    FASTER_SAMPLES = auto()  # a time in s at which simulated runs died out


@dataclass(frozen=True)
class Remedy:
    """What may help."""

    way: Way
    figures: tuple[str | float, ...] = ()  # names and numbers that go with it
