"""Controllers with all that an input can have, to be exported."""

from dataclasses import replace
from pathlib import Path

from pwatrack import load_spec
from pwatrack.commands.export import Subject, of_spec
from tests.conftest import SPECS, once
from tests.test_outcome import cart

_MOST = 1500  # steps that a test asks for
MACHINE = """controller: {sample_time: 0.01, delay: 2}
  quantum: {u: 0.01, y: 1e-4}
  rate_limit: {u: 30}
  actuator: {limits: {u: [-2, 3]}}"""
PIECES = "{polyline: {points: [[0, 0], [1, 0.03], [2, -0.02], [4, 0.04], [20, 0]], smooth: 0.3}}"


def exported(name: str, h: float | None = None, *, steps: int) -> Subject:
    """A spec that comes along, sampled, with some steps of its simulation; it is designed once for all tests."""
    made = once(lambda: of_spec(load_spec(SPECS / f"{name}.yaml"), h, given=True, steps=_MOST), name, h)
    return replace(made, vector=replace(made.vector, y=made.vector.y[:steps], w=made.vector.w[:steps]))


def machine_of(steps: int) -> Subject:
    """The paper's example on a machine."""
    return exported("two_mass_machine", steps=steps)


def with_pieces(folder: Path) -> Subject:
    """A controller with all that an input can have, a gain against windup too, and a reference in pieces that ends."""
    path = cart(folder, *MACHINE.split("\n  "), reference="PIECES", duration=10)
    path.write_text(path.read_text(encoding="utf-8").replace('"PIECES"', PIECES))
    subject = once(lambda: of_spec(load_spec(path), steps=1100), "pieces")
    program = subject.file.program
    assert program is not None
    assert program.inside.pieces
    inside = program.inside.model_copy(update={"end": 1080})
    against = [[0.01 / (2 + k)] * len(program.K) for k in range(len(program.M))]  # windup
    program = program.model_copy(update={"inside": inside, "E": against})
    return replace(subject, file=subject.file.model_copy(update={"program": program}))


def with_reversed_limits(subject: Subject) -> Subject:
    """A controller that no file may hold: its low limits are its high ones, and the other way round."""
    program = subject.file.program
    assert program is not None
    program = program.model_copy(update={"low": program.high, "high": program.low})
    return replace(subject, file=subject.file.model_copy(update={"program": program}))
