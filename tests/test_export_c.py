"""Exported C is the stored controller in every bit, compiles without a warning, and answers faults as documented."""

import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pwatrack import load_spec
from pwatrack.errors import ExitCode, InvalidSpec
from pwatrack.export.c_project import FLAGS, write_c
from pwatrack.export.c_source import CSource, header
from pwatrack.report.export import CONTROLLER, Subject, of_spec
from pwatrack.report.verify import CERTIFICATE
from tests.conftest import SPECS
from tests.exported import with_pieces, with_reversed_limits
from tests.misra import checked, listed
from tests.test_cli import call, refused
from tests.test_outcome import cart

COMPILERS = [name for name in ("gcc", "clang") if shutil.which(name)]
pytestmark = pytest.mark.skipif(not COMPILERS, reason="no C compiler is installed")
SANE = "-g -fsanitize=address,undefined -fno-sanitize-recover=all"


def built(folder: Path, compiler: str, options: str, main: str = "main.c") -> str:
    """Compile a folder with no warning and return what the program says."""
    sources = [main, *(path.name for path in folder.glob("*.c") if path.name not in ("main.c", "faults.c"))]
    command = [compiler, *FLAGS.split(), *options.split(), "-o", "program", *sources]
    found = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr
    ran = subprocess.run([folder / "program"], cwd=folder, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout


def written(subject: Subject, folder: Path, *, single: bool = False, given: bool = False) -> Path:
    code = CSource(file=subject.file, name="loop", single=single, given=given, unproved=subject.unproved)
    write_c(code, subject.vector, folder)
    return folder


@pytest.fixture(scope="module")
def machine() -> Subject:
    return of_spec(load_spec(SPECS / "two_mass_machine.yaml"), given=True, steps=1500)


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("options", ["-O0", "-O2", "-O3", "-O3 -march=native", f"-O1 {SANE}"])
def test_no_bit_differs_from_the_simulation_at_any_level(
    machine: Subject, tmp_path: Path, compiler: str, options: str
) -> None:
    """The vector is written by the stored controller, which is the simulation bit for bit: test_controller_file."""
    for single in (False, True):
        for given in (False, True):
            folder = written(machine, tmp_path / f"{single}{given}", single=single, given=given)
            assert built(folder, compiler, options).startswith("1500 steps, 0 wrong; state")


SOME = {
    "gallery/two_pumps_two_tanks": 1e-2,  # two inputs, a set point
    "gallery/payload_without_sensor": 1e-3,  # loads
    "gallery/stage_with_bumpers": 1e-3,
    "gallery/drive_with_end_stop": 1e-3,
    "gallery/three_tanks_weirs": 1.0,
    "gallery/flexible_arm": 1e-3,  # a desired trajectory that is played back
    "gallery/carriage_on_slack_rope": 5e-4,  # the observer has more cells than the desired trajectory
    "gallery/train_slack_couplings": 1e-2,  # many cells
}


@pytest.mark.parametrize("name", SOME)
def test_specs_of_all_kinds_give_the_same_bits(name: str, tmp_path: Path) -> None:
    subject = of_spec(load_spec(SPECS / f"{name}.yaml"), SOME[name], given=True, steps=300)
    for given in (False, True):
        folder = written(subject, tmp_path / str(given), given=given)
        assert " 0 wrong;" in built(folder, COMPILERS[0], "-O2")


@pytest.mark.skipif(not shutil.which("cppcheck"), reason="cppcheck is not installed")
@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("given", [False, True])
def test_misra_finds_only_the_deviations_that_are_listed(
    machine: Subject, tmp_path: Path, single: bool, given: bool
) -> None:
    found = checked(written(machine, tmp_path, single=single, given=given))
    assert found.broken == listed()
    assert not found.others, found.said


def test_delays_limits_steps_and_pieces_are_in_the_code(tmp_path: Path) -> None:
    subject = with_pieces(tmp_path)
    for single in (False, True):
        folder = written(subject, tmp_path / str(single), single=single)
        assert " 0 wrong;" in built(folder, COMPILERS[0], f"-O2 {SANE}")
        text = (folder / "loop.c").read_text(encoding="utf-8")
        assert all(f" {name}" in text for name in ("change", "low", "high", "quantum", "piece_tick"))


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


def test_faults_are_answered_and_nothing_is_undefined(machine: Subject, tmp_path: Path) -> None:
    folder = written(machine, tmp_path / "c", given=True)
    (folder / "faults.c").write_text(FAULTS)
    assert built(folder, COMPILERS[0], f"-O1 {SANE}", "faults.c") == "answered\n"


def test_a_wrong_bit_in_the_vector_is_found(machine: Subject, tmp_path: Path) -> None:
    folder = written(machine, tmp_path / "c")
    text = (folder / "loop.c").read_text(encoding="utf-8")
    gain = machine.file.K[0][0]
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
    K = [[1e39, *machine.file.K[0][1:]]]
    subject = replace(machine, file=machine.file.model_copy(update={"K": K}))
    assert "1e+39" in (written(subject, tmp_path / "double") / "loop.c").read_text(encoding="utf-8")
    with pytest.raises(InvalidSpec, match=r"a number of 1e\+39, and single floats end at 3\.4e\+38"):
        written(subject, tmp_path / "single", single=True)
    assert not list((tmp_path / "single").glob("*"))


def test_the_header_says_what_is_proved_of_the_error(machine: Subject) -> None:
    """A practical design has a bound, rounded up; it does not claim that the error goes to 0."""
    code = CSource(file=machine.file, name="loop", single=False, given=False, unproved=())
    assert "all solutions track y_d with error going to 0." in header(code)
    geared = of_spec(load_spec(SPECS / "gallery/gear_with_backlash.yaml"), 1e-3, steps=2)
    assert geared.file.practical is not None
    (bound,) = geared.file.practical
    code = CSource(file=geared.file, name="loop", single=False, given=False, unproved=())
    (line,) = [line for line in header(code).splitlines() if "ends below" in line]
    assert float(line.partition("below ")[2].split()[0]) >= bound.below > 0
    assert line.endswith(" rad; it need not go to 0.")
    assert "going to 0" not in header(code)


def test_every_claim_of_the_header_is_among_the_claims(machine: Subject) -> None:
    text = (SPECS.parent / "docs/claims.md").read_text(encoding="utf-8")
    listed = [
        re.escape(claim).replace("…", ".*") for claim in re.findall(r"^\| code \| `(.+?)` \|", text, re.MULTILINE)
    ]
    geared = of_spec(load_spec(SPECS / "gallery/gear_with_backlash.yaml"), 1e-3, steps=2)
    for file, unproved in ((machine.file, ()), (machine.file, ("the reference grows",)), (geared.file, ())):
        code = CSource(file=file, name="loop", single=False, given=False, unproved=unproved)
        said = header(code).partition("of pwatrack.\n")[2].partition(" *\n")[0]
        claims = [line.removeprefix(" * ") for line in said.splitlines()]
        assert claims
        assert all(any(re.fullmatch(claim, line) for claim in listed) for line in claims), claims


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


def test_a_controller_without_sample_time_needs_one(tmp_path: Path) -> None:
    path = cart(tmp_path, duration=2)
    assert "--sample-time" in refused(call("export", "c", path, "--out", tmp_path / "c"), int(ExitCode.INVALID))
    assert call("export", "c", path, "--out", tmp_path / "c", "--sample-time", "0.01").exit_code == 0
    error = refused(call("export", "c", path, "--out", tmp_path / "c", "--sample-time", "1000"), 6)
    assert "the loop is unstable" in error


def test_a_title_cannot_leave_its_comment(machine: Subject, tmp_path: Path) -> None:
    bad = machine.file.model_copy(update={"name": 'x */ #error "out" /* \n #error'})
    folder = tmp_path / "c"
    write_c(CSource(file=bad, name="loop", single=False, given=False, unproved=("*/ #error",)), machine.vector, folder)
    assert " 0 wrong;" in built(folder, COMPILERS[0], "-O2")
