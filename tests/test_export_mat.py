"""What is written for MATLAB and Octave: every bit of u in Octave, and every number of controller.json in the file."""

import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import loadmat

from pwatrack.commands.export import Subject
from pwatrack.commands.verify import CERTIFICATE, CONTROLLER
from pwatrack.export.controller import Controller
from pwatrack.export.matlab import write
from pwatrack.export.source import Source
from tests.exported import exported, machine_of, with_pieces, with_reversed_limits
from tests.test_cli import call, refused
from tests.test_export_st import SOME
from tests.test_outcome import cart

OCTAVE = shutil.which("octave-cli")
octave = pytest.mark.skipif(OCTAVE is None, reason="octave-cli is not installed")


def said(folder: Path, text: str) -> list[str]:
    """Run lines in Octave and return what they print."""
    assert OCTAVE is not None
    command = [OCTAVE, "--no-init-file", "--quiet", "--eval", f"{text}\nfflush(stdout); exit(0)"]
    ran = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout.split()


def written(subject: Subject, folder: Path, *, given: bool = False) -> Path:
    source = Source(file=subject.file, name="loop", single=False, given=given, unproved=subject.unproved)
    write(source, subject.vector, folder)
    return folder


@octave
@pytest.mark.parametrize("name", SOME)
def test_no_bit_of_the_input_differs_in_octave(name: str, tmp_path: Path) -> None:
    subject = exported(name, SOME[name], steps=300)
    for given in (False, True):
        folder = written(subject, tmp_path / str(given), given=given)
        assert said(folder, "disp(loop_replay()); s = load('loop.mat'); disp(size(s.vector.y, 1));") == ["0", "300"]


LAST = """
s = load('loop.mat'); state = loop_init();
for k = 1:size(s.vector.y, 1) [u, state] = loop_step(state, s.vector.y(k, :)); end
disp(num2hex(state.v)); disp(state.status)
"""


@octave
def test_delays_limits_steps_and_pieces_are_in_the_function(tmp_path: Path) -> None:
    """And all that it remembers in the end has the bits of the controller, past the end of its reference."""
    subject = with_pieces(tmp_path)
    folder, controller = written(subject, tmp_path / "m"), Controller(subject.file)
    for y in subject.vector.y:
        controller.step(y)
    v = np.concatenate([controller.state(name) for name in ("y", "u", "x_hat", "s_hat", "eta_hat", "w")])
    assert said(folder, LAST) == [*(f"{bits:016x}" for bits in v.view(np.uint64)), "1"]
    assert said(folder, "disp(loop_replay())") == ["0"]


@pytest.fixture(scope="module")
def machine() -> Subject:
    return machine_of(100)


@octave
def test_a_wrong_bit_is_found(machine: Subject, tmp_path: Path) -> None:
    folder = written(machine, tmp_path / "m")
    table, gain = folder / "loop_tables.m", machine.file.K[0][0]
    text = table.read_text(encoding="ascii")
    assert repr(gain) in text
    table.write_text(text.replace(repr(gain), repr(float(np.nextafter(gain, 0.0)))), encoding="ascii")
    assert int(said(folder, "disp(loop_replay())")[0]) > 0


FAULTS = """
[first, state] = loop_step(loop_init(), 0.1, [0.1 0 0]);
[second, known] = loop_step(state, 0.1, [0.1 0 0]);
faults = {NaN, [0.1 0 0]; Inf, [0.1 0 0]; 0.1, [0.1 -Inf 0]; 0.1, [0.1 1.7e308 0]};
for k = 1:4
    [u, state] = loop_step(known, faults{k, :});
    disp([isequal(u, second), state.status, isequal(rmfield(state, 'status'), rmfield(known, 'status'))])
end
try loop_step(known, [1 2], [0.1 0 0]); catch error, disp(error.identifier); end
try loop_step(known, 1, 0.1); catch error, disp(error.identifier); end
[u, state] = loop_step(state, 0.1, [0.1 0 0]);
disp(state.status)
"""


@octave
def test_faults_are_answered(machine: Subject, tmp_path: Path) -> None:
    folder = written(machine, tmp_path / "m", given=True)
    assert said(folder, FAULTS) == [*["1", "-1", "1"] * 4, "loop:size", "loop:size", "0"]


OVERWRITTEN = """
y = 0.1; [first, fresh] = loop_step(loop_init(), y);
for fault = {{'cell', 1000}, {'cell', -1}, {'cell', NaN}, {'cell_d', 3}, {'since', -1}, {'since', Inf}}
    state = setfield(fresh, fault{1}{:});
    [u, state] = loop_step(state, y);
    disp([u, state.status])
end
state = fresh; state.v(:) = NaN;
[u, state] = loop_step(state, y); disp([u, state.status])
for state = {[], 0, struct(), rmfield(fresh, 'before')}
    try loop_step(state{1}, y); catch error, disp(error.identifier); end
end
"""


@octave
def test_a_memory_that_was_overwritten_is_noticed(machine: Subject, tmp_path: Path) -> None:
    answers = [*["0", "-2"] * 6, "0", "-1", *["loop:state"] * 4]
    assert said(written(machine, tmp_path / "m"), OVERWRITTEN) == answers


@octave
def test_of_limits_that_are_reversed_one_or_the_other_is_put_out(tmp_path: Path) -> None:
    folder = written(with_reversed_limits(with_pieces(tmp_path)), tmp_path / "m")
    assert said(folder, "disp(loop_replay()); load('loop.mat'); disp(unique(vector.u)')") == ["0", "0", "3"]


def found(folder: Path) -> Any:
    return loadmat(folder / "loop.mat", simplify_cells=True)


@pytest.mark.slow
def test_the_file_has_every_number_of_the_controller(machine: Subject, tmp_path: Path) -> None:
    known, file = found(written(machine, tmp_path / "m")), machine.file
    assert file.program is not None
    controller, plant, program = known["controller"], known["controller"]["plant"], known["controller"]["program"]
    assert (controller["sha256"], controller["name"], controller["proof"]) == (file.sha256, file.name, file.proof)
    assert [*plant["cells"]] == file.plant.cells
    assert [*plant["states"]] == file.plant.states
    assert dict(plant["units"]) == file.plant.units
    for i in range(len(file.plant.cells)):
        assert plant["A"][:, :, i].tolist() == file.plant.A[i]
        assert plant["b"][i].tolist() == file.plant.b[i]
        assert program["observer"][:, :, i].tolist() == file.program.observer[i]
        assert program["inside"]["generator"][:, :, i].tolist() == file.program.inside.generator[i]
    assert controller["K"].tolist() == file.K[0]  # a row, and a column below
    assert controller["L"].tolist() == [row[0] for row in file.L]
    assert program["outside"]["reference"].tolist() == file.program.outside.reference
    assert np.array_equal(program["change"], np.inf)
    assert controller["trajectory"]["reference"]["until"].size == 0
    assert known["vector"]["y"].tolist() == machine.vector.y[:, 0].tolist()


@octave
def test_octave_reads_the_same_file_whatever_its_names_are(machine: Subject, tmp_path: Path) -> None:
    """Of text with letters that are not ASCII Octave 7 drops as many at the end; nothing else is lost."""
    plant = machine.file.plant.model_copy(update={"units": {"y": "µm", "Ω": "°"}})
    bad = machine.file.model_copy(update={"name": "Größe '%\n end", "plant": plant})
    folder = tmp_path / "m"
    write(Source(file=bad, name="loop", single=False, given=False, unproved=("x\nend",)), machine.vector, folder)
    known = found(folder)["controller"]
    assert known["name"] == "Größe '%\n end"
    assert known["plant"]["units"].tolist() == [["y", "µm"], ["Ω", "°"]]
    value = np.array(bad.plant.A[2][1][0]).view(np.uint64)
    shown = "c = s.controller; disp(c.plant.cells{1}); disp(num2hex(c.plant.A(2, 1, 3))); disp(loop_replay())"
    assert said(folder, f"s = load('loop.mat'); {shown}") == ["upper", "spring", f"{int(value):016x}", "0"]


def test_a_file_is_the_same_whenever_it_is_written(machine: Subject, tmp_path: Path) -> None:
    one, other = (written(machine, tmp_path / name) / "loop.mat" for name in "ab")
    assert one.read_bytes() == other.read_bytes()
    assert one.read_bytes().startswith(b"MATLAB 5.0 MAT-file, written by pwatrack  ")


def test_the_command_exports_a_run_and_refuses_what_is_not_proved(tmp_path: Path) -> None:
    path = cart(tmp_path, "controller: {sample_time: 0.01}", duration=2)
    run, out = tmp_path / "run", tmp_path / "code"
    assert call("design", path, "--out", run).exit_code == 0
    result = call("export", "mat", run, "--out", out, "--name", "loop")
    assert result.exit_code == 0, result.output
    functions = [f"loop_{name}.m" for name in ("init", "step", "tables", "replay")]
    assert sorted(file.name for file in out.iterdir()) == sorted([*functions, "loop.mat", CONTROLLER, CERTIFICATE])
    assert "% Proved for the gains" in (out / "loop_init.m").read_text(encoding="ascii")
    assert found(out)["not_proved"].size == 0
    (out / CERTIFICATE).unlink()
    error = refused(call("export", "mat", out, "--out", tmp_path / "no"), 6)
    assert f"not proved: there is no {CERTIFICATE} beside it" in error
    assert not (tmp_path / "no").exists()
    assert call("export", "mat", out, "--out", tmp_path / "no", "--name", "loop", "--unproved").exit_code == 0
    text = (tmp_path / "no" / "loop_init.m").read_text(encoding="ascii")
    assert f"% NOT PROVED: there is no {CERTIFICATE}" in text
    assert f"no {CERTIFICATE}" in str(found(tmp_path / "no")["not_proved"])
