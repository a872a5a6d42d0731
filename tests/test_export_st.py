"""The function block, read by a grammar of IEC 61131-3 and run, is the controller in every bit."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pwatrack import load_spec
from pwatrack.commands.export import Subject, of_spec
from pwatrack.commands.verify import CERTIFICATE, CONTROLLER
from pwatrack.export.controller import Controller
from pwatrack.export.source import Source
from pwatrack.export.structured_text import function_block, program_text
from tests.exported import exported, machine_of, with_pieces, with_reversed_limits
from tests.structured_text import Block, Program
from tests.test_cli import call, refused
from tests.test_outcome import cart

SOME = {
    "two_mass_machine": None,
    "gallery/payload_without_sensor": 1e-3,  # loads
    "gallery/cart_and_pole_on_the_move": 1e-2,  # preview
}


STEPS = 25  # each is run by an interpreter


class Loop(Block):
    """A block whose signals are given and put out in their order."""

    def __call__(self, **known: Any) -> dict[str, Any]:
        values = [*known["y"], *known.get("given", ()), known["reset"]]
        found = super().__call__(**dict(zip(self.inputs, values, strict=True)))
        reals = [found[name] for name in self.outputs if self.types[name] == self.float]
        m = len(reals) // 2
        return found | {"u": reals[:m], "wanted": reals[m:]}


def source(subject: Subject, *, single: bool = False, given: bool = False) -> Source:
    return Source(file=subject.file, name="loop", single=single, given=given, unproved=subject.unproved)


def block(subject: Subject, *, single: bool = False, given: bool = False) -> Loop:
    return Loop(function_block(source(subject, single=single, given=given)))


def both(subject: Subject, *, single: bool = False, given: bool = False) -> Iterator[tuple[bytes, bytes]]:
    """Yield u, x̂ and what else is remembered, of the function block and of the controller, step by step."""
    run, controller = block(subject, single=single, given=given), Controller(subject.file, single=single)
    real = np.float32 if single else np.float64
    for y, w in zip(subject.vector.y.astype(real), subject.vector.w.astype(real), strict=True):
        found = run(y=y, reset=False, **({"given": w} if given else {}))
        u = controller.step(y, w if given else None)
        places = ("y", "u", "x_hat", "s_hat", "eta_hat", "w")
        v = np.concatenate([controller.state(name) for name in places])
        cells = tuple(subject.file.plant.cells[found[name]] for name in ("cell", "cell_d"))
        assert (found["status"], cells) == (controller.status, controller.cells)
        one = np.array([*found["u"], *found["v"], *found["wanted"], *found["x_d"]], dtype=real)
        other = np.concatenate([u, v, controller.state("wanted"), controller.state("x_d")])
        yield one.tobytes(), other.tobytes()


FORMS = {  # single, given: two of the four each, since it takes time to parse
    "two_mass_machine": [(False, False), (True, True)],
    "gallery/payload_without_sensor": [(False, True), (True, False)],
    "gallery/cart_and_pole_on_the_move": [(False, False), (True, False)],  # whose reference cannot be given
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SOME)
def test_no_bit_differs_from_the_controller(name: str) -> None:
    subject = exported(name, SOME[name], steps=STEPS)
    for single, given in FORMS[name]:
        pairs = list(both(subject, single=single, given=given))
        assert len(pairs) == STEPS
        assert all(one == other for one, other in pairs)


@pytest.mark.slow
def test_what_compilers_get_wrong_is_not_in_it(tmp_path: Path) -> None:
    """Numbers that no REAL holds, which matiec refuses; loops to where they begin, which some leave out."""
    sampled = "controller: {sample_time: 0.01, method: emulated}"  # a correction by the largest number overflows
    subject = of_spec(load_spec(cart(tmp_path, sampled, duration=2)), steps=20)
    for single in (False, True):
        text, real = function_block(source(subject, single=single)), np.float32 if single else np.float64
        assert not re.search(r"FOR \w+ := (\d+) TO \1 DO", text)
        statements = text.partition("END_VAR\n\n")[2]  # matiec works these out in single floats
        assert max(abs(float(number)) for number in re.findall(r"\d\.\d*(?:E-?\d+)?", statements)) < 1e38
        limit = np.finfo(real).max
        for y, status in ((limit, 0), (np.inf, -1), (np.nan, -1), (-np.inf, -1)):
            run = Loop(text)
            run(y=np.array([0.0], dtype=real), reset=False)
            found = run(y=np.array([y], dtype=real), reset=False)
            assert (found["status"], bool(np.isfinite(found["u"][0]))) == (status, True)


@pytest.mark.slow
def test_delays_limits_steps_and_pieces_are_in_the_block(tmp_path: Path) -> None:
    subject = with_pieces(tmp_path)
    for single in (False, True):
        assert all(one == other for one, other in both(subject, single=single))
    controller = Controller(subject.file)
    assert [controller.step(y) is not None and controller.status for y in subject.vector.y][-1] == 1


@pytest.fixture(scope="module")
def machine() -> Subject:
    return machine_of(1100)


@pytest.mark.slow
def test_the_copies_of_a_long_reference_are_renewed(machine: Subject) -> None:
    assert all(one == other for one, other in both(machine))


def test_faults_are_answered_and_a_reset_starts_anew(machine: Subject) -> None:
    run, w = block(machine, given=True), machine.vector.w
    first = run(y=[0.1], given=w[0], reset=False)["u"]
    known = run(y=[0.1], given=w[1], reset=False)
    assert first != known["u"]
    remembered = [name for name in known if f"new_{name}" in known and name != "status"]
    assert {"v", "before", "cell"} <= {*remembered}
    for y, given in ((np.nan, w[2]), (np.inf, w[2]), (0.1, [0.1, -np.inf, 0.0]), (0.1, [0.1, 1.7e308, 0.0])):
        found = run(y=[y], given=given, reset=False)
        assert (found["status"], found["u"]) == (-1, known["u"])
        assert [found[name] for name in remembered] == [known[name] for name in remembered]
    assert run(y=[0.1], given=w[2], reset=False)["status"] == 0
    assert run(y=[0.1], given=w[0], reset=True)["u"] == first
    assert run(y=[0.1], given=w[1], reset=False)["u"] == known["u"]


OVERWRITTEN = {"cell": (1000, -1), "cell_d": (-(2**31), 3), "since": (2**31 - 1, -1)}


def test_a_memory_that_was_overwritten_is_noticed(machine: Subject) -> None:
    run = block(machine)
    first = run(y=[0.1], reset=False)["u"]
    for name, values in OVERWRITTEN.items():
        for value in values:
            run.memory[name] = value
            found = run(y=[0.1], reset=False)
            assert (found["status"], found["u"], found[name]) == (-2, [0.0], value)
            assert run(y=[0.1], reset=True)["u"] == first
    run.memory["v"] = dict.fromkeys(run.memory["v"], np.nan)
    for found in (run(y=[0.1], reset=False), run(y=[0.1], reset=False)):
        assert (found["status"], found["u"]) == (-1, [0.0])
    assert run(y=[0.1], reset=True)["u"] == first
    run.memory["ready"] = False
    assert run(y=[0.1], reset=False)["u"] == first


@pytest.mark.slow
def test_of_limits_that_are_reversed_one_or_the_other_is_put_out(tmp_path: Path) -> None:
    subject = with_reversed_limits(with_pieces(tmp_path))
    assert all(one == other for one, other in both(subject))
    run = block(subject)
    assert {run(y=y, reset=False)["u"][0] for y in subject.vector.y[:300]} == {0.0, 3.0}  # 0 while it is late


@pytest.mark.slow
def test_the_grammar_takes_the_whole_file(tmp_path: Path) -> None:
    subject = of_spec(load_spec(cart(tmp_path, "controller: {sample_time: 0.01}")), steps=100)
    text = function_block(source(subject))
    one, other = Loop(text, whole_text=True), Loop(text)
    assert one.body == other.body
    assert (one.memory, one.types, one.constants) == (other.memory, other.types, other.constants)
    assert [one(y=y, reset=False)["u"] for y in subject.vector.y] == [
        other(y=y, reset=False)["u"] for y in subject.vector.y
    ]


def test_a_wrong_bit_is_found(machine: Subject) -> None:
    assert machine.file.program is not None
    gain = machine.file.program.K[0][0]
    text = function_block(source(machine))
    assert repr(gain) in text
    wrong = Loop(text.replace(repr(gain), repr(float(np.nextafter(gain, 0.0)))))
    u = [np.array(wrong(y=y, reset=False)["u"]).tobytes() for y in machine.vector.y[:200]]
    controller = Controller(machine.file)
    assert u != [controller.step(y).tobytes() for y in machine.vector.y[:200]]


def renamed(subject: Subject, outputs: Sequence[str], inputs: Sequence[str], units: dict[str, str]) -> Subject:
    changed = {"outputs": [*outputs], "inputs": [*inputs], "units": units}
    plant = subject.file.plant.model_copy(update=changed)
    return replace(subject, file=subject.file.model_copy(update={"plant": plant}))


def said_of(text: str) -> dict[str, str]:
    """Return what is said of each number that is an input or an output."""
    head = text.partition("VAR CONSTANT")[0]
    return dict(re.findall(r"^    (\w+) : L?REAL; \(\* (.*) \*\)$", head, re.MULTILINE))


@pytest.fixture(scope="module")
def pumps() -> Subject:
    return exported("gallery/two_pumps_two_tanks", 1e-2, steps=60)


NAMED: dict[tuple[str, ...], list[str]] = {
    ("F", "v", "k", "largest"): ["F", "v", "k", "largest"],  # what is the block's own gives way
    ("level", "Level", "LEVEL", "level_1"): ["level", "Level_1", "LEVEL_2", "level_1_1"],
    ("at", "Sin", "status", "cell"): ["at_1", "Sin_1", "status_1", "cell_1"],
    ("in__1", "_p", "p_", "η"): ["in_1", "p", "p_1", "eta"],
    ("FB_loop", "prg_loop", "reset", "new_v"): ["FB_loop_1", "prg_loop_1", "reset_1", "new_v"],
    ("control", "fault", "x", "x_wanted"): ["control", "fault", "x", "x_wanted"],
}


@pytest.mark.slow
@pytest.mark.parametrize("names", list(NAMED)[1::2])
def test_signals_have_their_names_or_legal_ones(pumps: Subject, names: tuple[str, ...]) -> None:
    subject = renamed(pumps, names[:2], names[2:], {})
    run, controller, called = block(subject), Controller(pumps.file), NAMED[names]
    assert (run.inputs, run.outputs[:2]) == ([*called[:2], "reset"], called[2:])
    for y in pumps.vector.y:
        assert np.array(run(y=y, reset=False)["u"]).tobytes() == controller.step(y).tobytes()
    said = said_of(function_block(source(subject)))
    for name, other in zip(names, called, strict=True):
        assert said[other].endswith(" in the spec") == (name != other)
    if names[3] == "x_wanted":
        assert run.outputs[2:4] == ["x_wanted_1", "x_wanted_wanted"]


def test_units_and_entries_of_the_reference_are_said(pumps: Subject) -> None:
    subject = renamed(pumps, ("q", "at"), ("u1", "T_2"), {"q": "m³/s", "at": "°C *)", "T_2": "N m", "h3": "m"})
    assert said_of(function_block(source(subject, given=True))) == {
        "q": "measured, in m3/s",
        "at_1": "measured, in degC * ); at in the spec",
        "ref_h3_d": "reference: h3_d, in m",
        "ref_h2_d": "reference: h2_d",
        "ref_dh3_d_dt": "reference: dh3_d/dt, in m/s",
        "ref_dh2_d_dt": "reference: dh2_d/dt",
        "u1": "to be put out now",
        "T_2": "to be put out now, in N m",
        "u1_wanted": "before its limits",
        "T_2_wanted": "before its limits, in N m",
    }


@pytest.mark.slow
@pytest.mark.parametrize(("single", "given"), [(False, True), (True, False)])
def test_the_program_beside_it_calls_the_block(pumps: Subject, single: bool, given: bool) -> None:
    subject = renamed(pumps, ("control", "fault"), ("u1", "at"), {})
    code, real = source(subject, single=single, given=given), np.float32 if single else np.float64
    program = Program(program_text(code), Block(function_block(code)))
    controller, vector = Controller(pumps.file, single=single), pumps.vector
    references = ["ref_h3_d", "ref_h2_d", "ref_dh3_d_dt", "ref_dh2_d_dt"] if given else []
    assert (program.types[program.instance], program.instance) == ("FB_loop", "control_1")
    for y, w in zip(vector.y.astype(real), vector.w.astype(real), strict=True):
        known = dict(zip(["control", "fault", *references], [*y, *w[: len(references)]], strict=True))
        found = program(reset=False, **known)
        u = controller.step(y, w if given else None)
        assert np.array([found["u1"], found["at_1"]], dtype=real).tobytes() == u.tobytes()
        assert found["fault_1"] is False
    assert program(reset=False, **{**known, "control": np.nan})["fault_1"] is True


@pytest.mark.parametrize(
    ("time", "said"), [(1.0, "1000ms"), (1e-3, "1ms"), (2.5e-4, "0.25ms"), (1e-7, "0.0001ms"), (120.0, "120000ms")]
)
def test_the_task_has_the_sample_time(machine: Subject, time: float, said: str) -> None:
    program = machine.file.program
    assert program is not None
    file = machine.file.model_copy(update={"program": program.model_copy(update={"sample_time": time})})
    text = program_text(source(replace(machine, file=file)))
    (task,) = re.findall(r"^ *TASK (\w+)\(INTERVAL := T#(.*), PRIORITY := 0\);$", text, re.MULTILINE)
    assert task == ("TASK_loop", said)
    assert "PROGRAM RUN_loop WITH TASK_loop : PRG_loop;" in text


@pytest.mark.slow
def test_the_command_exports_a_run_and_refuses_what_is_not_proved(tmp_path: Path) -> None:
    path = cart(tmp_path, "controller: {sample_time: 0.01}", duration=2)
    run, out = tmp_path / "run", tmp_path / "code"
    assert call("design", path, "--out", run).exit_code == 0
    found = call("export", "st", run, "--out", out, "--name", "loop", "--float32")
    assert found.exit_code == 0, found.output
    assert sorted(file.name for file in out.iterdir()) == sorted(
        ["loop.st", "loop_program.st", CONTROLLER, CERTIFICATE]
    )
    text = (out / "loop.st").read_text(encoding="ascii")
    assert "Proved for the gains" in text
    assert Block(text).types["u"] == "REAL"
    (out / CERTIFICATE).unlink()
    error = refused(call("export", "st", out, "--out", tmp_path / "no"), 6)
    assert f"not proved: there is no {CERTIFICATE} beside it" in error
    assert not (tmp_path / "no").exists()
    assert call("export", "st", out, "--out", tmp_path / "no", "--name", "loop", "--unproved").exit_code == 0
    assert f"NOT PROVED: there is no {CERTIFICATE}" in (tmp_path / "no" / "loop.st").read_text(encoding="ascii")


def test_a_title_cannot_leave_its_comment(machine: Subject) -> None:
    bad = machine.file.model_copy(update={"name": "x *) END_VAR (* \n *"})
    code = Source(file=bad, name="loop", single=False, given=False, unproved=("*) *", "(* open"))
    (one, *_) = islice(machine.vector.y, 1)
    assert Loop(function_block(code))(y=one, reset=False)["status"] == 0
