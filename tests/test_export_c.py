"""Exported C is the stored controller in every bit, compiles without a warning, and answers faults as documented."""

import json
import re
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path, PurePosixPath

import numpy as np
import pytest

from pwatrack import load_spec
from pwatrack.commands.export import Subject, of_spec
from pwatrack.commands.verify import CERTIFICATE, CONTROLLER, verify
from pwatrack.errors import ExitCode, InvalidSpec
from pwatrack.export.c import FLAGS, header, write
from pwatrack.export.fmu import packed
from pwatrack.export.fmu_models import controller_model
from pwatrack.export.source import Source, prefix
from pwatrack.export.source import said as in_comment
from pwatrack.export.stored import read, with_sampling
from pwatrack.model.conditions import Sampling
from tests.conftest import SPECS
from tests.exported import exported, machine_of, with_pieces, with_reversed_limits
from tests.misra import checked, listed
from tests.test_cli import call, refused
from tests.test_outcome import cart
from tests.tools import COMPILERS, SANE, needs

pytestmark = pytest.mark.skipif(not COMPILERS, reason="no C compiler is installed")


def built(folder: Path, compiler: str, options: str, main: str = "main.c") -> str:
    """Compile a folder with no warning and return what the program says."""
    needs(compiler, options)
    sources = [main, *(path.name for path in folder.glob("*.c") if path.name not in ("main.c", "faults.c"))]
    command = [compiler, *FLAGS.split(), *options.split(), "-o", "program", *sources, "-lm"]
    found = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr
    ran = subprocess.run([folder / "program"], cwd=folder, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout


def written(subject: Subject, folder: Path, *, single: bool = False, given: bool = False) -> Path:
    code = Source(file=subject.file, name="loop", single=single, given=given, unproved=subject.unproved)
    write(code, subject.vector, folder)
    return folder


@pytest.fixture(scope="module")
def machine() -> Subject:
    return machine_of(1500)


@pytest.mark.slow
@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("options", ["-O0", "-O2", "-O3", "-O3 -march=native", f"-O1 {SANE}"])
def test_no_bit_differs_from_the_simulation_at_any_level(
    machine: Subject, tmp_path: Path, compiler: str, options: str
) -> None:
    """The vector is written by the stored controller, which is the simulation bit for bit: test_controller_file."""
    for single, given in product((False, True), repeat=2) if options == "-O2" else ((False, True), (True, False)):
        folder = written(machine, tmp_path / f"{single}{given}", single=single, given=given)
        assert built(folder, compiler, options).startswith("1500 steps, 0 wrong; state")


SOME = {
    "gallery/two_pumps_two_tanks": 1e-2,  # two inputs, a set point
    "gallery/payload_without_sensor": 1e-3,  # loads
    "gallery/flexible_arm": 1e-3,  # a desired trajectory that is played back
    "gallery/carriage_on_slack_rope": 5e-4,  # the observer has more cells than the desired trajectory
    "gallery/train_slack_couplings": 1e-2,  # many cells
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SOME)
def test_specs_of_all_kinds_give_the_same_bits(name: str, tmp_path: Path) -> None:
    subject = exported(name, SOME[name], steps=300)
    for given in (False, True):
        folder = written(subject, tmp_path / str(given), given=given)
        assert " 0 wrong;" in built(folder, COMPILERS[0], "-O2")


@pytest.fixture(scope="module")
def unrounded(tmp_path_factory: pytest.TempPathFactory) -> Subject:
    """A controller whose inputs have no steps: a product that is fused with a sum shows."""
    path = cart(tmp_path_factory.mktemp("cart"), "controller: {sample_time: 0.01}", duration=10)
    return of_spec(load_spec(path), steps=1000)


def replayed(folder: Path, command: Sequence[str]) -> str:
    """Compile a folder with these options alone, and return what the replay says."""
    ran = subprocess.run([*command, "-o", "program"], cwd=folder, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    return subprocess.run([folder / "program"], capture_output=True, text=True, check=False).stdout


@pytest.mark.slow
@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("single", [False, True])
def test_no_option_of_a_compiler_fuses_products_with_sums(
    unrounded: Subject, tmp_path: Path, compiler: str, single: bool
) -> None:
    """GCC does it in its own mode wherever the processor can, and every compiler where it is told to."""
    known = subprocess.run([compiler, "-march=native", "-dM", "-E", "-"], input="", capture_output=True, text=True)
    if "__FMA__" not in known.stdout:
        pytest.skip("this processor has no fused multiply-add")
    folder, sources = written(unrounded, tmp_path, single=single), ("main.c", "loop.c")
    for options in ("-O2 -march=native", "-O3 -march=native -ffp-contract=fast", "-Os -mfma", "-O1 -mfma -std=gnu17"):
        assert replayed(folder, [compiler, *options.split(), *sources]).startswith("1000 steps, 0 wrong;"), options
    other = [compiler, "-D__EDG__=1", "-O2", "-march=native", "-ffp-contract=fast", *sources]  # as for any other one
    assert replayed(folder, other).startswith("1000 steps, 0 wrong;")
    text = (folder / "loop.c").read_text(encoding="utf-8")
    text = re.sub(r"^#pragma GCC .*$", "", text, flags=re.MULTILINE).replace("ROUNDED volatile", "ROUNDED")
    (folder / "loop.c").write_text(text)
    fused = replayed(folder, [compiler, "-O2", "-march=native", "-ffp-contract=fast", *sources])
    assert not fused.startswith("1000 steps, 0 wrong;")


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("option", ["-ffast-math", "-Ofast", "-ffinite-math-only"])
def test_arithmetic_that_is_not_that_of_ieee_is_refused(
    unrounded: Subject, tmp_path: Path, compiler: str, option: str
) -> None:
    folder = written(unrounded, tmp_path)
    with pytest.raises(AssertionError, match="needs IEEE arithmetic: no -ffast-math"):
        replayed(folder, [compiler, option, "main.c", "loop.c"])


@pytest.mark.parametrize("single", [False, True])
def test_wider_registers_are_refused_where_they_hold_its_numbers(
    unrounded: Subject, tmp_path: Path, single: bool
) -> None:
    """With FLT_EVAL_METHOD 16 they hold half floats alone."""
    folder = written(unrounded, tmp_path, single=single)
    (folder / "float.h").write_text("#define FLT_EVAL_METHOD METHOD\n")
    for method, taken in {"0": True, "1": not single, "2": False, "16": True, "(-1)": False}.items():
        command = [COMPILERS[0], "-I.", f"-DMETHOD={method}", "-fsyntax-only", "loop.c"]
        found = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert (found.returncode == 0) is taken, found.stderr
        assert taken or "in the width of its numbers" in found.stderr


@pytest.mark.skipif(not shutil.which("g++"), reason="no C++ compiler is installed")
def test_a_program_in_cpp_links_it(unrounded: Subject, tmp_path: Path) -> None:
    folder = written(unrounded, tmp_path)
    (folder / "main.c").rename(folder / "main.cpp")
    subprocess.run([COMPILERS[0], *FLAGS.split(), "-c", "loop.c"], cwd=folder, check=True)
    command = ["g++", "-std=c++17", "-Wall", "-Wextra", "-Werror", "main.cpp", "loop.o"]
    assert replayed(folder, command).startswith("1000 steps, 0 wrong;")


def test_units_are_written_in_ascii(unrounded: Subject) -> None:
    plant = unrounded.file.plant.model_copy(update={"units": {"u": "m³/s", "y": "µm"}})
    file = unrounded.file.model_copy(update={"plant": plant})
    text = header(Source(file=file, name="loop", single=False, given=False, unproved=()))
    assert "u            u (m3/s)" in text
    assert "y            y (um)" in text


@pytest.mark.skipif(not shutil.which("cppcheck"), reason="cppcheck is not installed")
@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("given", [False, True])
def test_misra_finds_only_the_deviations_that_are_listed(
    machine: Subject, tmp_path: Path, single: bool, given: bool
) -> None:
    found = checked(written(machine, tmp_path, single=single, given=given))
    assert found.broken == listed()
    assert not found.others, found.said


@pytest.mark.slow
def test_delays_limits_steps_and_pieces_are_in_the_code(tmp_path: Path) -> None:
    subject = with_pieces(tmp_path)
    for single in (False, True):
        folder = written(subject, tmp_path / str(single), single=single)
        assert " 0 wrong;" in built(folder, COMPILERS[0], f"-O2 {SANE}")
        text = (folder / "loop.c").read_text(encoding="utf-8")
        assert all(f" {name}" in text for name in ("change", "low", "high", "quantum", "piece_tick"))


@pytest.mark.slow
def test_of_limits_that_are_reversed_one_or_the_other_is_put_out(tmp_path: Path) -> None:
    """No file may hold them: the vector is that of `docs/arithmetic.md`."""
    subject = with_reversed_limits(with_pieces(tmp_path))
    assert " 0 wrong;" in built(written(subject, tmp_path / "c"), COMPILERS[0], f"-O2 {SANE}")


FAULTS = """
#include "loop.h"
#include <float.h>
#include <math.h>
#include <stdio.h>
#include <string.h>
#define CHECK(condition) if (!(condition)) { printf("line %d\\n", __LINE__); return 1; }

int main(void)
{
    static loop_state fresh;
    loop_state state, before;
    loop_real u[LOOP_INPUTS], y[LOOP_OUTPUTS] = {0.1}, ref[LOOP_REFERENCE] = {0.1, 0.0, 0.0};
    loop_real held;

    u[0] = 7.0;
    CHECK(loop_init(NULL) == LOOP_REFUSED && loop_reset(NULL) == LOOP_REFUSED)
    CHECK(loop_step(&fresh, y, ref, u) == LOOP_NOT_READY && !(u[0] < 0.0) && !(u[0] > 0.0))
    CHECK(loop_init(&state) == LOOP_OK && loop_step(&state, y, ref, u) == LOOP_OK)
    held = u[0];
    before = state;
    CHECK(loop_step(NULL, y, ref, u) == LOOP_REFUSED)
    CHECK(loop_step(&state, NULL, ref, u) == LOOP_REFUSED && state.status == LOOP_REFUSED)
    CHECK(loop_step(&state, y, NULL, u) == LOOP_REFUSED)
    CHECK(loop_step(&state, y, ref, NULL) == LOOP_REFUSED)
    y[0] = (loop_real)NAN;
    u[0] = 0.0;
    CHECK(loop_step(&state, y, ref, u) == LOOP_REFUSED && memcmp(&u[0], &held, sizeof held) == 0)
    y[0] = 0.1;
    ref[1] = (loop_real)INFINITY;
    CHECK(loop_step(&state, y, ref, u) == LOOP_REFUSED && memcmp(&u[0], &held, sizeof held) == 0)
    ref[1] = DBL_MAX;
    CHECK(loop_step(&state, y, ref, u) == LOOP_REFUSED)
    ref[1] = 0.0;
    before.status = state.status;
    CHECK(memcmp(&before, &state, sizeof state) == 0)
    CHECK(loop_step(&state, y, ref, u) == LOOP_OK && state.status == LOOP_OK)
    memset(&state, 0xff, sizeof state);
    CHECK(loop_step(&state, y, ref, u) == LOOP_NOT_READY)
    loop_reset(&state);
    state.cell = 1000;
    CHECK(loop_step(&state, y, ref, u) == LOOP_NOT_READY)
    loop_reset(&state);
    state.cell_d = -1;
    u[0] = 7.0;
    CHECK(loop_step(&state, y, ref, u) == LOOP_NOT_READY && !(u[0] < 0.0) && !(u[0] > 0.0))
    loop_reset(&state);
    state.v[LOOP_OUTPUTS] = (loop_real)NAN;
    CHECK(loop_step(&state, y, ref, u) == LOOP_OK)
    loop_reset(&state);
    loop_step(&state, y, ref, u);
    state.v[LOOP_OUTPUTS] = (loop_real)NAN;
    CHECK(loop_step(&state, y, ref, u) == LOOP_REFUSED && !(u[0] < 0.0) && !(u[0] > 0.0))
    puts("answered");
    return 0;
}
"""


@pytest.mark.slow
def test_faults_are_answered_and_nothing_is_undefined(machine: Subject, tmp_path: Path) -> None:
    folder = written(machine, tmp_path / "c", given=True)
    (folder / "faults.c").write_text(FAULTS)
    assert built(folder, COMPILERS[0], f"-O1 {SANE}", "faults.c") == "answered\n"


def test_a_wrong_bit_in_the_vector_is_found(machine: Subject, tmp_path: Path) -> None:
    folder = written(machine, tmp_path / "c")
    text = (folder / "loop.c").read_text(encoding="utf-8")
    assert machine.file.program is not None
    gain = machine.file.program.K[0][0]
    (folder / "loop.c").write_text(text.replace(repr(gain), repr(float(np.nextafter(gain, 0.0)))))
    with pytest.raises(AssertionError, match=r"1500 steps, [1-9]\d* wrong"):
        built(folder, COMPILERS[0], "-O2")


def test_sizes_and_digests_are_in_the_header(machine: Subject, tmp_path: Path) -> None:
    """That the sizes are those of the compiled program, the source holds against it when it is compiled."""
    folder = written(machine, tmp_path / "c")
    header, file = (folder / "loop.h").read_text(encoding="utf-8"), machine.file
    assert all(digest in header for digest in (file.sha256, file.proof, file.spec_sha256))
    said = built(folder, COMPILERS[0], "-O2")
    (state,) = [line for line in header.splitlines() if "State  " in line]
    assert f"state {state.split()[2]} bytes" in said
    wrong = header.replace(f"STATE_BYTES {state.split()[2]}", "STATE_BYTES 1")
    (folder / "loop.h").write_text(wrong)
    with pytest.raises(AssertionError, match="state_size"):
        built(folder, COMPILERS[0], "-O2")


def test_numbers_that_single_floats_do_not_hold_are_refused(machine: Subject, tmp_path: Path) -> None:
    assert machine.file.program is not None
    K = [[1e39, *machine.file.program.K[0][1:]]]
    program = machine.file.program.model_copy(update={"K": K})
    subject = replace(machine, file=machine.file.model_copy(update={"program": program}))
    assert "1e+39" in (written(subject, tmp_path / "double") / "loop.c").read_text(encoding="utf-8")
    with pytest.raises(InvalidSpec, match=r"a number of 1e\+39, and single floats end at 3\.4e\+38"):
        written(subject, tmp_path / "single", single=True)
    assert not list((tmp_path / "single").glob("*"))


@pytest.mark.slow
def test_the_header_says_what_is_proved_of_the_error(machine: Subject) -> None:
    """A practical design has a bound, rounded up; it does not claim that the error goes to 0."""
    code = Source(file=machine.file, name="loop", single=False, given=False, unproved=())
    assert "all solutions track y_d with error going to 0." in header(code)
    geared = exported("gallery/gear_with_backlash", 1e-3, steps=2)
    assert geared.file.practical is not None
    (bound,) = geared.file.practical
    code = Source(file=geared.file, name="loop", single=False, given=False, unproved=())
    (line,) = [line for line in header(code).splitlines() if "ends below" in line]
    assert float(line.partition("below ")[2].split()[0]) >= bound.below > 0
    assert line.endswith(" rad; it need not go to 0.")
    assert "going to 0" not in header(code)


@pytest.mark.slow
def test_every_claim_of_the_header_is_among_the_claims(machine: Subject) -> None:
    text = (SPECS.parent / "docs/claims.md").read_text(encoding="utf-8")
    listed = [
        re.escape(claim).replace("…", ".*") for claim in re.findall(r"^\| code \| `(.+?)` \|", text, re.MULTILINE)
    ]
    geared = exported("gallery/gear_with_backlash", 1e-3, steps=2)
    for file, unproved in ((machine.file, ()), (machine.file, ("the reference grows",)), (geared.file, ())):
        code = Source(file=file, name="loop", single=False, given=False, unproved=unproved)
        said = header(code).partition("of pwatrack.\n")[2].partition(" *\n")[0]
        claims = [line.removeprefix(" * ") for line in said.splitlines()]
        assert claims
        assert all(any(re.fullmatch(claim, line) for claim in listed) for line in claims), claims


@pytest.mark.slow
def test_the_command_exports_a_run_and_refuses_what_is_not_proved(tmp_path: Path) -> None:
    path = cart(tmp_path, "controller: {sample_time: 0.01}", duration=2)
    run, out = tmp_path / "run", tmp_path / "code"
    assert call("design", path, "--out", run).exit_code == 0
    found = call("export", "c", run, "--out", out, "--name", "loop")
    assert found.exit_code == 0, found.output
    assert " 0 wrong;" in built(out, COMPILERS[0], "-O2")
    assert (out / CERTIFICATE).read_bytes() == (run / CERTIFICATE).read_bytes()
    assert "Proved for the gains" in (out / "loop.h").read_text(encoding="utf-8")
    again = call("export", "c", out, "--out", tmp_path / "again", "--name", "loop")
    assert again.exit_code == 0, again.output
    assert (tmp_path / "again" / "loop.c").read_bytes() == (out / "loop.c").read_bytes()
    assert "NOT CHECKED: its spec was not at hand" in (tmp_path / "again" / "loop.h").read_text(encoding="utf-8")
    assert "NOT CHECKED" not in (out / "loop.h").read_text(encoding="utf-8")
    (out / CERTIFICATE).unlink()
    error = refused(call("export", "c", out, "--out", tmp_path / "no", "--name", "loop"), 6)
    assert f"not proved: there is no {CERTIFICATE} beside it" in error
    assert not (tmp_path / "no").exists()
    assert call("export", "c", out, "--out", tmp_path / "no", "--name", "loop", "--unproved").exit_code == 0
    assert f"NOT PROVED: there is no {CERTIFICATE}" in (tmp_path / "no" / "loop.h").read_text(encoding="utf-8")
    certificate = run / CERTIFICATE
    certificate.write_text(certificate.read_text(encoding="utf-8").replace('"rate"', '"rate" '))
    assert "is not the one that it names" in refused(call("export", "c", run, "--out", tmp_path / "no"), 6)
    stored = json.loads((run / CONTROLLER).read_text(encoding="utf-8"))
    (run / CONTROLLER).write_text(json.dumps({**stored, "K": [[0.0, 0.0]]}))
    assert "its digest is not" in refused(call("export", "c", run, "--out", tmp_path / "no", "--unproved"), 2)


@pytest.mark.slow
def test_a_run_is_exported_from_anywhere_and_wherever_it_was_moved_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another spec of the same name, here or beside the folder, is not taken for its own."""
    for name in ("one", "two", "else"):
        (tmp_path / name).mkdir()
    cart(tmp_path / "one", "controller: {sample_time: 0.01}", duration=2)
    cart(tmp_path / "else", "controller: {sample_time: 0.02}", duration=2)
    monkeypatch.chdir(tmp_path / "one")
    assert call("design", "cart.yaml", "--out", "runs/cart").exit_code == 0
    monkeypatch.chdir(tmp_path / "else")

    def exported(run: str) -> None:
        found = call("export", "c", run, "--out", "code", "--name", "loop")
        assert found.exit_code == 0, found.output
        assert "is from the exact simulation of its spec" in " ".join(Path("code/README.md").read_text().split())

    exported("../one/runs/cart")
    assert "it belongs to ../one/runs/cart/spec.txt: same plant" in call("verify", "../one/runs/cart").output
    shutil.move(tmp_path / "one/runs/cart", tmp_path / "two")
    shutil.rmtree(tmp_path / "one")
    exported("../two/cart")
    Path("cart.yaml").unlink()
    assert "it belongs to ../two/cart/spec.txt: same plant" in call("verify", "../two/cart").output


@pytest.mark.slow
@pytest.mark.parametrize("stored", [False, True])
def test_the_controller_of_a_run_that_failed_is_exported_where_that_is_meant(tmp_path: Path, stored: bool) -> None:
    path = cart(tmp_path, "controller: {sample_time: 0.01}", duration=2)
    path.write_text(path.read_text(encoding="utf-8") + "require: {final_error: 1e-9, largest_input: {u: 1000}}\n")
    run, out = tmp_path / "run", tmp_path / "code"
    if stored:
        assert call("simulate", path, "--out", run, "--plots", "none").exit_code == 6
    for option in ((), ("--unproved",)):
        error = refused(call("export", "c", run if stored else path, "--out", out, *option), 6)
        assert "its run failed: final_error" in error
        assert "largest_input" not in error
        assert "--failed exports it all the same" in error
    assert not out.exists()
    assert call("export", "c", run if stored else path, "--out", out, "--name", "loop", "--failed").exit_code == 0
    title, empty, said = (out / "loop.h").read_text(encoding="utf-8").splitlines()[1:4]
    assert (title.removeprefix(" * "), empty) == (load_spec(path).name, " *")
    assert said.startswith(" * FAILED: final_error: ")
    assert "Its run FAILED: final_error: " in (out / "README.md").read_text(encoding="utf-8")
    (line,) = json.loads((out / CONTROLLER).read_text(encoding="utf-8"))["failed"]
    assert said == f" * FAILED: {in_comment(line)}"
    assert f"its run failed: {line}" in verify(out)
    again = tmp_path / "again"
    folder = run if stored else out
    for language, target in {"c": out, "st": out / CONTROLLER, "mat": folder, "fmu": folder / CONTROLLER}.items():
        assert f"its run failed: {line}" in refused(call("export", language, target, "--out", again), 6)
    assert not again.exists()
    assert call("export", "st", out, "--out", again, "--failed").exit_code == 0
    assert "FAILED: final_error: " in (again / "cart.st").read_text(encoding="utf-8")
    assert (again / CONTROLLER).read_bytes() == (out / CONTROLLER).read_bytes()


@pytest.mark.slow
def test_a_controller_whose_run_broke_off_says_so_and_one_that_ran_well_does_not(tmp_path: Path) -> None:
    path, run = cart(tmp_path, "controller: {sample_time: 100}", duration=200), tmp_path / "run"
    assert call("simulate", path, "--out", run, "--plots", "none").exit_code == 6
    (line,) = json.loads((run / CONTROLLER).read_text(encoding="utf-8"))["failed"]
    assert "the loop is unstable" in line
    assert f"its run failed: {line}" in verify(run)
    cart(tmp_path, "controller: {sample_time: 0.01}", duration=2)
    assert call("simulate", path, "--out", run, "--plots", "none").exit_code == 0
    assert json.loads((run / CONTROLLER).read_text(encoding="utf-8"))["failed"] == []
    assert not [said for said in verify(run) if "failed" in said]


@pytest.mark.slow
def test_a_controller_without_sample_time_needs_one(tmp_path: Path) -> None:
    path = cart(tmp_path, duration=2)
    assert "--sample-time" in refused(call("export", "c", path, "--out", tmp_path / "c"), int(ExitCode.INVALID))
    assert call("export", "c", path, "--out", tmp_path / "c", "--sample-time", "0.01").exit_code == 0
    error = refused(call("export", "c", path, "--out", tmp_path / "c", "--sample-time", "1000"), 6)
    assert "the loop is unstable" in error


def test_a_title_cannot_leave_its_comment(machine: Subject, tmp_path: Path) -> None:
    bad = machine.file.model_copy(update={"name": 'x */ #error "out" /* \n #error'})
    folder = tmp_path / "c"
    write(Source(file=bad, name="loop", single=False, given=False, unproved=("*/ #error",)), machine.vector, folder)
    assert " 0 wrong;" in built(folder, COMPILERS[0], "-O2")


@pytest.mark.slow
@pytest.mark.parametrize("title", ["Model", "main", "Vector", "math", "string", "test", "replay", "int", "C 11"])
def test_no_title_gives_a_name_that_is_taken(machine: Subject, tmp_path: Path, title: str) -> None:
    """By another file of the folder, by a header of C, or by a target of the build."""
    code = Source(file=machine.file, name=prefix(title), single=False, given=False, unproved=())
    vector = replace(machine.vector, y=machine.vector.y[:50], w=machine.vector.w[:50])
    names = write(code, vector, tmp_path)
    assert len({name.lower() for name in names}) == len(names) == len([*tmp_path.iterdir()])
    assert "50 steps, 0 wrong" in built(tmp_path, COMPILERS[0], f"-O1 -I{tmp_path}")  # as CMake has it
    for target in ("check", "clean"):
        found = subprocess.run(["make", "-s", target], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert found.returncode == 0, found.stderr


def test_no_title_gives_the_name_of_a_source_of_its_fmu(machine: Subject) -> None:
    for version in (2, 3):
        code = Source(file=machine.file, name="loop", single=False, given=False, unproved=())
        found = packed(controller_model(code, 1.0, {}), version, None)
        taken = {PurePosixPath(file).stem.lower() for file in found if file.endswith((".c", ".h"))} - {"loop"}
        assert {"model", f"fmi{version}"} <= taken
        for name in taken:
            assert prefix(name) == prefix(name.title()) == f"{name}_1"


def test_an_export_at_another_sample_time_is_verified_and_has_less_jitter_than_that(tmp_path: Path) -> None:
    path = cart(tmp_path, "controller: {sample_time: {nominal: 0.01, jitter: 0.001}}", duration=2)
    assert call("export", "c", path, "--out", tmp_path / "c", "--sample-time", "0.008").exit_code == 0
    assert call("verify", tmp_path / "c", "--spec", path).exit_code == 0
    known, spec = read(tmp_path / "c" / "controller.json"), load_spec(path)
    assert known.program is not None
    less = known.program.model_copy(update={"jitter": 0.0})  # as of a file that has none
    kept = with_sampling(spec, less, instead=True).scenario.conditions.sampling
    assert kept == Sampling(sample_time=0.008, jitter=0.001)
    said = refused(call("export", "c", path, "--out", tmp_path / "d", "--sample-time", "0.0005"), 2)
    assert "--sample-time 0.0005: the file has a jitter of 0.001 s, which is not below it" in said
