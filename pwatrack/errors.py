"""The error family: what went wrong, where, by how much, and what to do next.

What a refusal is about, and what may help, is named here, and spelled by whoever read the description: no room below
`spec` knows how a file or a command line writes things; see `spec/spelling.py` for that.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum, IntEnum, auto
from functools import partial

_FEW = 3  # entries of a long list that a terminal shows


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
    SET_POINTS = auto()  # at run time
    DURATION = auto()
    ESTIMATE = auto()  # of loads


Subject = tuple[ProblemPart | str | int, ...]
KEY = -1  # at the end of a path in a file: the key itself, not what stands under it


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
    SLOWER_GAINS = auto()


@dataclass(frozen=True)
class Remedy:
    """What may help."""

    way: Way
    figures: tuple[str | float, ...] = ()  # names and numbers that go with it


class ExitCode(IntEnum):
    """What the shell sees."""

    DONE = 0
    BUG = 1
    INVALID = 2
    OUTSIDE_THEORY = 3
    INFEASIBLE = 4
    UNDECIDED = 5
    CHECK_FAILED = 6

    @property
    def verdict(self) -> str:
        """The verdict of a run that ends with this code before anything is simulated."""
        return _VERDICTS[self]


_VERDICTS = "proved", "crashed", "invalid spec", "outside the theory", "infeasible", "undecided", "check failed"


@dataclass(frozen=True)
class Place:
    """A position in a source file, counted from 1."""

    file: str
    line: int
    column: int

    def __str__(self) -> str:
        return f"{self.file}:{self.line}:{self.column}"


@dataclass(frozen=True, kw_only=True)
class Problem:
    """One thing that is wrong.

    Its subject is what it is about: `(Part.CELLS, 0, Part.A)`, or a path in a file, `("system", "cells", 0, "A")`.
    Whoever read the file knows the `place` of each. None: it is not about the description.
    """

    message: str  # what is wrong, complete
    subject: Subject | None = ()
    hint: str = ""  # what to do, in plain words
    remedy: Remedy | None = None  # the same as a name, for who knows how a file says it
    place: Place | None = None
    short: str = ""  # the message for a terminal, where it lists very many things; empty where it is the same

    @staticmethod
    def of_many(
        tell: Callable[[int | None], str], *, subject: Subject | None = (), hint: str = "", remedy: Remedy | None = None
    ) -> "Problem":
        """Return a problem that lists many things, the worst first: `tell` takes how many, None for all.

        Example:
            >>> Problem.of_many(lambda most: "wrong: " + listed(["a", "b", "c", "d", "e", "f"], most)).short
            'wrong: a, b, c … and 3 more'
        """
        full, short = tell(None), tell(_FEW)
        return Problem(message=full, short=short if short != full else "", subject=subject, hint=hint, remedy=remedy)

    def prefixed(self, text: str) -> "Problem":
        """Return the same problem with a text before its message."""
        return replace(self, message=text + self.message, short=self.short and text + self.short)

    def followed(self, text: str) -> "Problem":
        """Return the same problem with a text behind its message."""
        return replace(self, message=self.message + text, short=self.short and self.short + text)

    @property
    def where(self) -> str:
        """The place and a colon, where there is one and the message does not begin with it."""
        place = str(self.place or "")
        rest = self.message.removeprefix(place)
        return f"{place}: " if place and (rest == self.message or rest[:1] not in (":", "[", " ")) else ""

    def __str__(self) -> str:
        hint = f"\n  hint: {self.hint}" if self.hint else ""
        return f"{self.where}{self.message}{hint}"


def listed(items: Sequence[str], most: int | None) -> str:
    """Return items joined by commas: all of them, or where there are clearly more only the first ones.

    Example:
        >>> listed(["a", "b", "c"], 2), listed(["a", "b", "c", "d", "e"], 2)
        ('a, b, c', 'a, b … and 3 more')
    """
    if most is None or len(items) <= most + 1:
        return ", ".join(items)
    return f"{', '.join(items[:most])} … and {len(items) - most:,} more"


class PwatrackError(Exception):
    """A refusal with its reasons: all that pwatrack raises on purpose is one.

    Attributes:
        code: The exit code of the command line, with the `verdict` in words.
        problems: What is wrong, each with `message`, `hint` and `place`: line and column of a file, or an argument.
        evidence: Its proof where there is one.

    Example:
        >>> from pwatrack import plant
        >>> try:
        ...     plant(A=[[-1]], B=[[1, 2, 3]], C=[[1]], inputs=["u"])
        ... except PwatrackError as refusal:
        ...     print(refusal.code.verdict, "-", refusal.problems[0].place, "-", refusal)
        invalid spec - B[0] - B[0]: 3 entries, expected 1, one for each of the inputs
    """

    code = ExitCode.BUG

    def __init__(
        self,
        *problems: Problem | str,
        subject: Subject | None = (),
        hint: str = "",
        remedy: Remedy | None = None,
        place: Place | None = None,
        evidence: object = None,
    ) -> None:
        about = partial(Problem, subject=subject, hint=hint, remedy=remedy, place=place)
        self.evidence, self.problems = evidence, tuple(about(message=p) if isinstance(p, str) else p for p in problems)
        super().__init__("\n".join(str(p) for p in self.problems))

    def sorted(self) -> "PwatrackError":
        """Return the same refusal with its problems in the order of the file."""
        order = sorted(self.problems, key=lambda p: (p.place.line, p.place.column) if p.place else (0, 0))
        return type(self)(*order, evidence=self.evidence)


class InvalidSpec(PwatrackError):
    """The description is not well formed; `problems` is everything that is wrong with it.

    Example:
        >>> from pwatrack import load_spec
        >>> try:
        ...     load_spec({"name": "nothing yet"})
        ... except InvalidSpec as refusal:
        ...     print([problem.message for problem in refusal.problems])
        ['system is missing', 'reference is missing', 'simulation is missing']
    """

    code = ExitCode.INVALID


class OutsideTheory(PwatrackError):
    """The system is not one that the theorems cover.

    Example: a field that jumps.

        >>> from pwatrack import plant
        >>> try:
        ...     plant(A=[[[-1]], [[-2]]], b=[[0], [1]], B=[[1]], C=[[1]], where=["x1 <= 0", "x1 >= 0"])
        ... except OutsideTheory as refusal:
        ...     print(refusal.problems[0].message[:56])
        cells 'A[0]' and 'A[1]' disagree on x1 = 0: b jumps by 1
    """

    code = ExitCode.OUTSIDE_THEORY


class Infeasible(PwatrackError):
    """A matrix inequality is proved to have no solution; `evidence` is the proof, where it is more than a reason.

    Example: an unstable mode that no input moves.

        >>> from pwatrack import design, plant, problem
        >>> runaway = plant(A=[[-1, 0], [0, 1]], B=[[1], [0]], C=[[1, 0], [0, 1]], track=["y1"])
        >>> try:
        ...     design(problem(runaway, reference="sin(t)", simulation={"duration": 1, "sample_time": 0.1}))
        ... except Infeasible as refusal:
        ...     print(refusal.problems[0].place, refusal.code.verdict)
        B infeasible
    """

    code = ExitCode.INFEASIBLE


class Undecided(PwatrackError):
    """Neither a solution nor a proof that there is none was found.

    Example:
        >>> Undecided("(8) is undecided").code.verdict
        'undecided'
    """

    code = ExitCode.UNDECIDED


class CheckFailed(PwatrackError):
    """A result was computed, but a check on it failed.

    Example:
        >>> int(CheckFailed("the error grows").code)
        6
    """

    code = ExitCode.CHECK_FAILED
