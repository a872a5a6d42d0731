"""How the runs of a batch ended."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

from pwatrack.batch.work import Ended
from pwatrack.errors import ExitCode
from pwatrack.report.terminal import JobFault

_T = TypeVar("_T")
_LARGEST = 1e300  # of a figure that is shown
FIGURES = {"norm_K": "‖K‖", "norm_L": "‖L‖ (1/s)", "final_error": "final error"}  # norms are in sizes


@dataclass(frozen=True, kw_only=True)
class SpecOutcome:
    """How the run of one spec ended."""

    spec: Path
    folder: Path  # of its run
    exit: int | None  # its exit code; negative if a signal ended it, None if it did not end: see `reason`
    expected: int = 0  # exit code that the spec expects
    reason: str = ""  # why it did not end by itself; empty if it did
    how: Literal["run", "cached", "skipped"] = "run"  # run now, or before with nothing changed since, or not
    figures: Mapping[str, float] = field(default_factory=dict)  # from its run.json, empty if this run left none
    unit: str = ""  # of its errors; sizes where several signals are tracked
    notes: tuple[str, ...] = ()  # the remarks of the run, and what its simulation came to if that is not that it tracks
    required: tuple[tuple[str, bool], ...] = ()  # each requirement with what came out, and whether it is met
    messages: str = ""  # what it said on stderr
    faults: tuple[JobFault, ...] = ()  # what is wrong with it, one by one
    seconds: float = 0.0
    kind: str = ""  # of the proof of a run that is done: practical, where it is not of exact tracking

    @staticmethod
    def of(spec: Path, folder: Path, ended: Ended, *, seconds: float, cached: bool = False) -> "SpecOutcome":
        """Return the outcome of a run that ended by itself; what its index has of another kind is left out."""
        simulation = _part(ended.index, "simulation", dict)
        said = [] if simulation.get("outcome") == "tracks" else [simulation.get("said")]
        required = [each for each in _part(ended.index, "requirements", list) if isinstance(each, dict)]
        return SpecOutcome(
            spec=spec,
            folder=folder,
            exit=ended.exit,
            expected=ended.expected,
            how="cached" if cached else "run",
            figures={name: value for name, value in _part(ended.index, "figures", dict).items() if _shown(value)},
            unit=_part(_part(ended.index, "tracked", dict), "unit", str),
            notes=tuple(note for note in (*said, *_part(ended.index, "remarks", list)) if isinstance(note, str)),
            required=tuple((r["said"], r.get("met") is True) for r in required if isinstance(r.get("said"), str)),
            messages=ended.messages,
            faults=ended.faults,
            seconds=seconds,
            kind=_part(ended.index, "verdict", str),
        )

    @property
    def passed(self) -> bool:
        """Whether it ended as expected."""
        return not self.reason and self.exit == self.expected

    @property
    def failed(self) -> bool:
        """Whether it ended, and not as expected."""
        return not self.passed and self.how != "skipped"

    @property
    def missed(self) -> tuple[str, ...]:
        """The requirements that are not met, with what came out."""
        return tuple(text for text, met in self.required if not met)

    @property
    def code(self) -> int:
        """What it contributes to the exit code of the batch."""
        if not self.failed:
            return int(ExitCode.DONE)
        if self.exit is None:
            return int(ExitCode.CHECK_FAILED)
        if self.exit < 0:
            return int(ExitCode.BUG)
        return self.exit or int(ExitCode.CHECK_FAILED)

    @property
    def crashed(self) -> bool:
        """Whether it ended by a bug or a signal, and was not to."""
        return self.code == ExitCode.BUG

    @property
    def result(self) -> str:
        """What the table says of it in a word."""
        if self.how == "skipped":
            return "skipped"
        if self.how == "cached":
            return "cached" if self.passed else "FAIL, cached"
        return "pass" if self.passed else "FAIL"

    @property
    def verdict(self) -> str:
        """The exit code in words; of a run that is done what is proved."""
        if self.reason or (self.exit == ExitCode.DONE and self.kind):
            return self.reason or self.kind
        return ExitCode(self.exit).verdict if self.exit in list(ExitCode) else "crashed"

    @property
    def ending(self) -> str:
        """How it ended and what was expected."""
        exit_code = "" if self.exit is None else f", exit {self.exit}"
        return f"{self.verdict}{exit_code}, expected {self.expected}"


def exit_code(outcomes: Sequence[SpecOutcome]) -> int:
    """Return the exit code of a batch: that of a crash if there is one, else the largest."""
    return int(ExitCode.BUG) if any(each.crashed for each in outcomes) else max(each.code for each in outcomes)


def counted(outcomes: Sequence[SpecOutcome]) -> str:
    """Return how many passed, failed, were cached or skipped."""
    cached = sum(o.how == "cached" and o.passed for o in outcomes)
    skipped = sum(o.how == "skipped" for o in outcomes)
    passed, failed = sum(o.passed for o in outcomes), sum(o.failed for o in outcomes)
    more = f" ({cached} cached)" if cached else ""
    return f"{passed} passed{more}, {failed} failed" + (f", {skipped} skipped" if skipped else "")


def _part(index: Mapping[str, Any], name: str, kind: type[_T]) -> _T:
    """Return an entry of an index if it is of the kind that we write, else an empty one."""
    found = index.get(name)
    return found if isinstance(found, kind) else kind()


def _shown(value: object) -> bool:
    return isinstance(value, float | int) and not isinstance(value, bool) and abs(value) < _LARGEST
