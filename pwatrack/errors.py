"""The error family: what went wrong, where, by how much, and what to do next."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import IntEnum

Subject = tuple[str | int, ...]


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


_VERDICTS = {
    ExitCode.DONE: "proved",
    ExitCode.BUG: "crashed",
    ExitCode.INVALID: "invalid spec",
    ExitCode.OUTSIDE_THEORY: "outside the theory",
    ExitCode.INFEASIBLE: "infeasible",
    ExitCode.UNDECIDED: "undecided",
    ExitCode.CHECK_FAILED: "check failed",
}


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

    `subject` says what it is about as a path in the description, for example
    `("system", "cells", 0, "A")`; whoever read the description from a file
    knows the `place` of each path. None: it is not about the description.
    """

    message: str
    subject: Subject | None = ()
    hint: str = ""
    place: Place | None = None

    def __str__(self) -> str:
        where = f"{self.place}: " if self.place else ""
        hint = f"\n  hint: {self.hint}" if self.hint else ""
        return f"{where}{self.message}{hint}"


class PwatrackError(Exception):
    """A refusal with its reasons; `code` is its exit code, `evidence` its proof where there is one."""

    code = ExitCode.BUG

    def __init__(self, *problems: Problem | str, hint: str = "", evidence: object = None) -> None:
        self.evidence = evidence
        self.problems = tuple(p if isinstance(p, Problem) else Problem(message=p, hint=hint) for p in problems)
        super().__init__("\n".join(str(p) for p in self.problems))

    def sorted(self) -> "PwatrackError":
        """Return the same refusal with its problems in the order of the file."""
        order = sorted(self.problems, key=lambda p: (p.place.line, p.place.column) if p.place else (0, 0))
        return type(self)(*order, evidence=self.evidence)

    def located(self, places: Mapping[Subject, Place]) -> "PwatrackError":
        """Return the same refusal with the place of the nearest known subject filled in."""
        return type(self)(*(_locate(p, places) for p in self.problems), evidence=self.evidence)


class InvalidSpec(PwatrackError):
    """The description is not well formed."""

    code = ExitCode.INVALID


class OutsideTheory(PwatrackError):
    """The system is not one that the theorems cover."""

    code = ExitCode.OUTSIDE_THEORY


class Infeasible(PwatrackError):
    """A matrix inequality is proved to have no solution; `evidence` is the proof."""

    code = ExitCode.INFEASIBLE


class Undecided(PwatrackError):
    """Neither a solution nor a proof that there is none was found."""

    code = ExitCode.UNDECIDED


class CheckFailed(PwatrackError):
    """A result was computed, but a check on it failed."""

    code = ExitCode.CHECK_FAILED


def _locate(problem: Problem, places: Mapping[Subject, Place]) -> Problem:
    if problem.place is not None or problem.subject is None:
        return problem
    subject = problem.subject
    while subject and subject not in places:
        subject = subject[:-1]
    return replace(problem, place=places.get(subject))
