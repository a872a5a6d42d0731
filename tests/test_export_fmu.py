"""Exported FMUs are valid, whole, the stored controller in every bit, and the plant to rounding."""

import ctypes
import shutil
import subprocess
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import fmpy
import numpy as np
import pytest
from fmpy.build import build_platform_binary
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu
from scipy.linalg import expm

from pwatrack import Result, Spec, design, load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.commands.export import of_spec
from pwatrack.export.c import FLAGS
from pwatrack.export.controller import Controller
from pwatrack.export.fmu import Version, c_compiler, compiled, packed, write_fmu
from pwatrack.export.fmu_models import controller_model, plant_model
from pwatrack.export.schema import ControllerFile
from pwatrack.export.source import Source
from pwatrack.model.cells import Partition
from pwatrack.model.conditions import Conditions, Sampling
from pwatrack.model.pwa import PWASystem
from pwatrack.simulation.flow import Flow, SwitchedPart
from pwatrack.simulation.propagate import simulate_flow
from pwatrack.spec.spec import InitialStates
from tests.conftest import SPECS
from tests.fmus import BINARIES, NEEDED, Block, missing
from tests.grazing import near_grazing
from tests.misra import checked, listed
from tests.plants import random_plant
from tests.precise import precise
from tests.scenarios import in_scenario
from tests.test_cli import call, refused
from tests.test_outcome import cart
from tests.tools import COMPILERS, SANE, needs

COMPILER = c_compiler()
pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C compiler for Linux on x86-64 is installed")
VERSIONS: tuple[Version, ...] = (2, 3)
both = pytest.mark.parametrize("version", VERSIONS)

EXACT = {  # sample times in s, and how long
    "two_mass_machine": (0.002, 6.0),
    "gallery/two_pumps_two_tanks": (0.01, 10.0),  # two inputs and outputs, a set point
    "gallery/cart_and_pole_swaying": (0.002, 4.0),  # a desired trajectory that is played back
    "gallery/payload_without_sensor": (0.001, 3.0),  # its load is not measured
    "gallery/train_slack_couplings": (0.01, 20.0),  # 27 cells
}


def exact(name: str) -> Spec:
    """A spec with a sampled controller, and nothing that an FMU is not told of."""
    h, duration = EXACT[name]
    spec = load_spec(SPECS / f"{name}.yaml")
    conditions = replace(
        spec.scenario.conditions, noise=None, disturbance=None, quanta=None, sampling=Sampling(sample_time=h)
    )
    return in_scenario(spec, conditions=conditions, duration=duration, sample_time=h)


@cache
def made(name: str) -> tuple[Spec, Result, ControllerFile]:
    spec = exact(name)
    subject = of_spec(spec, steps=10)
    return spec, simulate(spec, subject.controller), subject.file


def source_of(file: ControllerFile, *, given: bool = False) -> Source:
    return Source(file=file, name="loop", single=False, given=given, unproved=())


def written(spec: Spec, file: ControllerFile, version: Version, folder: Path, *, given: bool = False) -> list[Path]:
    found = []
    for parts in (controller_model(source_of(file, given=given), 10.0, {}), plant_model(spec, "loop")):
        found.append(folder / f"{parts.identifier}_fmi{version}.fmu")
        write_fmu(packed(parts, version, COMPILER), found[-1])
    return found


def starts(names: tuple[str, ...], values: Array) -> Mapping[str, float]:
    return dict(zip((f"start.{name}" for name in names), values.tolist(), strict=True))


@pytest.fixture(scope="module")
def machine() -> tuple[Spec, ControllerFile]:
    spec, _, file = made("two_mass_machine")
    return spec, file


@pytest.mark.slow
@both
def test_they_are_valid_whole_and_the_same_again(
    machine: tuple[Spec, ControllerFile], version: Version, tmp_path: Path
) -> None:
    first = {path: path.read_bytes() for path in written(*machine, version, tmp_path)}
    for path in written(*machine, version, tmp_path):
        assert path.read_bytes() == first[path]
        assert validate_fmu(str(path)) == []
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            (binary,) = [name for name in names if name.startswith("binaries/")]
            library = Path(archive.extract(binary, tmp_path))
        assert binary.startswith(f"binaries/{BINARIES[version]}/")
        assert missing(library, version) == []


@pytest.mark.slow
@both
def test_a_binary_without_a_needed_function_is_noticed(
    machine: tuple[Spec, ControllerFile], version: Version, tmp_path: Path
) -> None:
    parts = plant_model(machine[0], "loop")
    found = {k.removeprefix("sources/"): v.decode() for k, v in packed(parts, version, None).items() if "sources/" in k}
    for name in NEEDED[version][::18]:  # all of them take a minute
        library = tmp_path / f"{name}.so"
        library.write_bytes(without(name, found))
        assert missing(library, version) == [name]
    path, broken = tmp_path / "loop_plant.fmu", packed(parts, version, None)
    broken[f"binaries/{BINARIES[version]}/loop_plant.so"] = without(f"fmi{version}DoStep", found)
    write_fmu(broken, path)
    assert validate_fmu(str(path)) == []  # that sees nothing of it
    with pytest.raises(AttributeError, match="DoStep"):
        Block(path, tmp_path)


def without(name: str, sources: Mapping[str, str]) -> bytes:
    assert COMPILER is not None
    return compiled(sources, COMPILER, [f"-D{name}=another_name"])


@pytest.mark.slow
@pytest.mark.parametrize("compiler", COMPILERS)
@both
def test_the_sources_compile_without_a_warning(
    machine: tuple[Spec, ControllerFile], version: Version, compiler: str, tmp_path: Path
) -> None:
    """But for parameters that the standard wants and a refusal does not read."""
    for path in written(*machine, version, tmp_path):
        with zipfile.ZipFile(path) as archive:
            archive.extractall(tmp_path / path.stem)
        folder = tmp_path / path.stem / "sources"
        names = sorted(file.name for file in folder.glob("*.c"))
        command = [
            compiler,
            *FLAGS.split(),
            "-Wno-unused-parameter",
            "-O2",
            "-fPIC",
            "-shared",
            "-o",
            "x",
            *names,
            "-lm",
        ]
        ran = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert ran.returncode == 0, ran.stderr


@pytest.mark.parametrize("standard", ["gnu99", "gnu17"])
@pytest.mark.parametrize("name", EXACT)
def test_the_sources_compile_in_a_compilers_own_mode(name: str, standard: str) -> None:
    """Beside all that the headers of such a mode declare: a name of ours may be none of theirs."""
    assert COMPILER is not None
    spec = exact(name)
    for version in VERSIONS:
        found = packed(plant_model(spec, "loop"), version, None)
        sources = {k.removeprefix("sources/"): v.decode() for k, v in found.items() if "sources/" in k}
        assert compiled(sources, COMPILER, [f"-std={standard}", "-O0", "-Werror"])


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("cmake"), reason="cmake is not installed")
@both
def test_fmpy_compiles_them_again(machine: tuple[Spec, ControllerFile], version: Version, tmp_path: Path) -> None:
    """What it builds of the sources does what our binary does, in every bit."""
    for path in written(*machine, version, tmp_path):
        output = "u" if path.stem.endswith("controller") else "z1"
        first = fmpy.simulate_fmu(str(path), stop_time=0.1, output_interval=0.02, output=[output])
        folder = tmp_path / path.stem
        fmpy.extract(str(path), str(folder))
        (binary,) = (folder / "binaries").rglob("*.so")
        binary.unlink()
        build = tmp_path / f"{path.stem}_build"
        build.mkdir()
        build_platform_binary(folder, build)
        assert binary.is_file()
        again = fmpy.simulate_fmu(str(folder), stop_time=0.1, output_interval=0.02, output=[output])
        assert again.tobytes() == first.tobytes()


@pytest.mark.skipif(not shutil.which("cppcheck"), reason="cppcheck is not installed")
@both
def test_misra_finds_only_the_deviations_that_are_listed(
    machine: tuple[Spec, ControllerFile], version: Version, tmp_path: Path
) -> None:
    broken = set[str]()
    for path in written(*machine, version, tmp_path, given=True):
        folder = tmp_path / path.stem
        fmpy.extract(str(path), str(folder))
        found = checked(folder / "sources", *sorted(file.name for file in (folder / "sources").glob("*.c")))
        assert not found.others, found.said
        broken |= found.broken
    assert broken == listed("An FMU")


@pytest.mark.slow
@both
@pytest.mark.parametrize(("name", "given"), [("two_mass_machine", True), ("gallery/cart_and_pole_swaying", False)])
def test_the_controller_is_the_stored_one_in_every_bit(
    name: str, given: bool, version: Version, tmp_path: Path
) -> None:
    file = made(name)[2]
    path = tmp_path / "controller.fmu"
    write_fmu(packed(controller_model(source_of(file, given=given), 10.0, {}), version, COMPILER), path)
    assert validate_fmu(str(path)) == []
    random, python, h = np.random.default_rng(1), Controller(file), EXACT[name][0]
    N, p = len(file.L), len(file.trajectory.eta)
    x_hat, eta_hat = random.normal(size=N) * 0.1, random.normal(size=p) * 0.1
    python.reset(x_hat, eta_hat)
    block = Block(path, tmp_path)
    first = block.named("start.")
    assert len(first) == N + p
    block.fmu.reset()
    block.begin(dict(zip(first, [*x_hat, *eta_hat], strict=True)))
    inputs, u = block.named("", "input"), list(file.plant.inputs)
    q = len(file.plant.outputs)
    for k in range(3000):
        if k == 1500:
            saved = block.fmu.serializeFMUState(block.fmu.getFMUState())
        values = 0.1 * np.sin(0.01 * k * (1 + np.arange(len(inputs)))) + 0.01 * random.normal(size=len(inputs))
        block.set(inputs, values)
        block.step(k * h, h)
        wanted = python.step(values[:q], values[q:] if given else None)
        assert block.get(u).tobytes() == wanted.tobytes()
        estimates = np.concatenate([python.state("x_hat"), python.state("s_hat")])
        assert block.get(block.named("estimate.")).tobytes() == estimates.tobytes()
        assert block.get(block.named("generator.")).tobytes() == python.state("eta_hat").tobytes()
        assert block.get(block.named("desired.")).tobytes() == python.state("x_d").tobytes()
        status, cell, cell_d = block.get(block.named("diagnosis."))
        assert (status, file.plant.cells[cell], file.plant.cells[cell_d]) == (python.status, *python.cells)
    last = block.get(u)
    block.fmu.setFMUState(block.fmu.deserializeFMUState(saved))
    assert block.get(u).tobytes() != last.tobytes()
    block.close()


@pytest.mark.slow
@both
@pytest.mark.parametrize("name", ["two_mass_machine", "gallery/train_slack_couplings"])
def test_controller_and_plant_give_the_trace_of_the_closed_loop(name: str, version: Version, tmp_path: Path) -> None:
    """To rounding: what is found is below 5e-15 of the largest state."""
    (spec, result, file), h = made(name), EXACT[name][0]
    at, z = result.loop.at, result.response.trace.z
    paths, of = written(spec, file, version, tmp_path), result.loop.plant
    controller, plant = Block(paths[0], tmp_path), Block(paths[1], tmp_path, starts(of.states, z[0, at.x]))
    found = np.zeros((len(z), len(of.states)))
    for k in range(len(z)):
        found[k] = plant.get(of.states)
        controller.set(of.outputs, plant.get(of.outputs))
        controller.step(k * h, h)
        plant.set(of.inputs, controller.get(of.inputs))
        plant.step(k * h, h)
    assert np.abs(found - z[:, at.x]).max() <= 1e-12 * np.abs(z[:, at.x]).max()
    controller.close()
    plant.close()


@pytest.mark.slow
@both
def test_with_a_delay_both_may_be_stepped_at_once(version: Version, tmp_path: Path) -> None:
    path = cart(tmp_path, "controller: {sample_time: 0.01, delay: 1}", reference="0.15*sin(t)", duration=5)
    spec = in_scenario(load_spec(path), sample_time=0.01)
    result = simulate(spec)
    at, z = result.loop.at, result.response.trace.z
    paths = written(spec, of_spec(spec, steps=10).file, version, tmp_path)
    assert all(validate_fmu(str(file)) == [] for file in paths)
    controller, plant = Block(paths[0], tmp_path), Block(paths[1], tmp_path)
    for k in range(len(z)):
        assert np.abs(plant.get(["z", "v"]) - z[k, at.x]).max() <= 1e-12 * np.abs(z[:, at.x]).max()
        y, u = plant.get(["y"]), controller.get(["next.u"])
        controller.set(["y"], y)
        plant.set(["u"], u)
        for block in (plant, controller):
            block.step(k * 0.01, 0.01)
    assert result.response.trace.events
    controller.close()
    plant.close()


@pytest.mark.slow
@both
@pytest.mark.parametrize("seed", range(6))
def test_a_plant_is_exact_however_many_crossings_a_step_has(seed: int, version: Version, tmp_path: Path) -> None:
    """Random plants with nine cells, in 50 digits, at steps of up to a second."""
    of = random_plant(seed, n=4, k=2, strength=3.0)
    (n, m), random = of.B.shape, np.random.default_rng(seed)
    x, u = random.normal(size=(n, 1))[:, 0], random.normal(size=(m, 1))[:, 0]
    F = np.zeros((len(of.A), n + m + 1, n + m + 1))
    F[:, :n, :n], F[:, :n, n:-1], F[:, :n, -1] = of.A, of.B, of.b
    part = SwitchedPart.of("plant", of, np.eye(n, n + m + 1), F)
    flow, z0 = Flow(F0=np.zeros((n + m + 1, n + m + 1)), parts=(part,)), np.array([*x, *u, 1.0])
    trace = simulate_flow(flow, z0, duration=20.0, sample_time=1.0)
    wanted, _ = precise(flow, z0, trace)
    spec = in_scenario(exact("two_mass_machine"), conditions=Conditions(plant=of), initial=InitialStates(plant=x))
    path = tmp_path / "plant.fmu"
    write_fmu(packed(plant_model(spec, "loop"), version, COMPILER), path)
    block = Block(path, tmp_path)
    block.set(of.inputs, u)
    for k in range(20):
        assert np.abs(block.get(of.states) - wanted[k, :n]).max() <= 1e-11 * np.abs(wanted[: k + 1]).max()
        block.step(float(k), 1.0)
    block.close()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5, 13))  # four of each kind
def test_a_dip_below_a_border_is_seen_and_a_pass_above_it_is_none(seed: int, tmp_path: Path) -> None:
    """By 1e-11 to 1e-2 of the state, in one step to the lowest point and one from there."""
    near = near_grazing(seed)
    F, guard, z0 = near.flow.F0, near.flow.parts[0].guards[0], near.z0
    low, high = 0.0, near.duration
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if guard @ F @ expm(F * middle) @ z0 < 0 else (low, middle)
    partition = Partition.create(H=[guard[:4]], h=[guard[4]], signs=[[-1], [1]], names=["below", "above"])
    A = F[:4, :4]
    of = PWASystem.create(partition=partition, A=[A, A], b=np.zeros((2, 4)), B=np.eye(4, 1), C=np.eye(1, 4))
    spec = in_scenario(exact("two_mass_machine"), conditions=Conditions(plant=of), initial=InitialStates(plant=z0[:4]))
    path = tmp_path / "plant.fmu"
    write_fmu(packed(plant_model(spec, "loop"), 3, COMPILER), path)
    block = Block(path, tmp_path)
    cells = [block.get(["diagnosis.cell"])[0]]
    for start, end in ((0.0, low), (low, near.duration)):
        block.step(start, end - start)
        cells.append(block.get(["diagnosis.cell"])[0])
    assert cells == [1, 0 if near.crossings else 1, 1]
    assert np.abs(block.get(of.states) - (expm(F * near.duration) @ z0)[:4]).max() < 1e-12
    block.close()


@pytest.mark.parametrize("seed", [10, 11, 14, 20, 28, 30])
def test_a_dip_within_a_step_leaves_its_trace(seed: int, tmp_path: Path) -> None:
    """By 4e-8 to 3e-3 of the state, against a stiff spring, far from the ends of the step."""
    near = near_grazing(seed)
    F, guard, z0 = near.flow.F0, near.flow.parts[0].guards[0], near.z0
    partition = Partition.create(H=[guard[:4]], h=[guard[4]], signs=[[-1], [1]], names=["below", "above"])
    pushed = np.zeros((5, 5))
    pushed[1] = -1000 * F[0, 1] * guard
    A, b = np.array([F + pushed, F])[:, :4, :4], np.array([pushed, 0 * pushed])[:, :4, 4]
    of = PWASystem.create(partition=partition, A=A, b=b, B=np.eye(4, 1), C=np.eye(1, 4))
    part = replace(near.flow.parts[0], F=np.array([pushed, 0 * pushed]))
    trace = simulate_flow(replace(near.flow, parts=(part,)), z0, duration=near.duration, sample_time=near.duration)
    assert len(trace.events) == 2
    spec = in_scenario(exact("two_mass_machine"), conditions=Conditions(plant=of), initial=InitialStates(plant=z0[:4]))
    path = tmp_path / "plant.fmu"
    write_fmu(packed(plant_model(spec, "loop"), 3, COMPILER), path)
    block = Block(path, tmp_path)
    block.step(0.0, near.duration)
    trail = np.abs(trace.z[-1] - expm(F * near.duration) @ z0).max()
    assert np.abs(block.get(of.states) - trace.z[-1, :4]).max() < 1e-12 < 0.01 * trail
    block.close()


FAULTS = """
#include "loop.h"
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

int main(void)
{
    double x[LOOP_STATES], u[LOOP_INPUTS], size;
    loop_state state, before;
    long k, wrong = 0;
    int a, q;

    for (k = 0; k < 400; k++) {
        size = pow(10.0, (double)(rand() % 13) - 6.0);
        for (a = 0; a < LOOP_STATES; a++) {
            x[a] = (k % 7 == 0) ? 0.0 : size * ((double)rand() / RAND_MAX - 0.5);
        }
        for (a = 0; a < LOOP_INPUTS; a++) {
            u[a] = size * ((double)rand() / RAND_MAX - 0.5);
        }
        x[0] = (k == 5) ? NAN : (k == 6) ? INFINITY : x[0];
        u[0] = (k == 8) ? NAN : u[0];
        for (a = 0; (k == 9) && (a < LOOP_STATES); a++) {
            x[a] = 1.7e308;
        }
        loop_start(&state, x);
        for (q = 0; q < 20; q++) {
            before = state;
            if (loop_advance(&state, u, pow(10.0, -(double)(rand() % 6))) != LOOP_OK) {
                wrong += (k < 5) || (k == 7) || (k > 9) || (memcmp(before.x, state.x, sizeof state.x) != 0);
            }
            wrong += (state.cell >= CELLS);
        }
    }
    printf("%ld", wrong);
    return 0;
}
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", EXACT)
def test_nothing_is_undefined_from_any_state(name: str, tmp_path: Path) -> None:
    """At rest, on a facet, far away, beyond all numbers: a step is done, or the state is kept."""
    spec = exact(name)
    for file, text in plant_model(spec, "loop").sources.items():
        (tmp_path / file).write_text(text, encoding="utf-8")
    cells = f"#define CELLS {len(spec.problem.plant.A)}u"
    (tmp_path / "main.c").write_text(cells + FAULTS, encoding="utf-8")
    assert COMPILER is not None
    needs(COMPILER, SANE)
    command = [COMPILER, "-std=c99", "-O1", *SANE.split(), "-o", "faults", "main.c", "loop.c", "-lm"]
    subprocess.run(command, cwd=tmp_path, check=True)
    ran = subprocess.run([tmp_path / "faults"], capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stdout) == (0, "0"), ran.stderr


@both
def test_fmpy_simulates_them(machine: tuple[Spec, ControllerFile], version: Version, tmp_path: Path) -> None:
    controller, plant = written(*machine, version, tmp_path)
    found = fmpy.simulate_fmu(str(controller), stop_time=0.1, output_interval=0.002, output=["u", "estimate.z1"])
    assert found["u"][-1] != 0
    found = fmpy.simulate_fmu(str(plant), stop_time=1.0, output_interval=0.1, start_values={"u": 1.0, "start.z1": 0.0})
    assert found["z1"][0] == 0
    assert found["z1"][-1] > 0.1
    assert found["y"].tolist() == found["z1"].tolist()


@both
def test_what_cannot_be_done_is_said(machine: tuple[Spec, ControllerFile], version: Version, tmp_path: Path) -> None:
    spec, file = machine
    controller, plant = written(spec, file, version, tmp_path)
    block = Block(controller, tmp_path)
    with pytest.raises(FMICallException):
        block.step(0.0, 0.003)
    assert block.said == ["the step is not a whole number of samples of 0.002 s"]
    block.step(0.0, 0.006)
    with pytest.raises(FMICallException):
        block.step(0.0, 0.002)
    assert block.said[1:] == ["the step does not begin where the last one ended"]
    with pytest.raises(FMICallException):
        block.set(["u"], [0.0])
    with pytest.raises(FMICallException):
        block.set(["start.z1"], [0.0])
    assert block.said[2:] == ["only inputs and parameters can be set", "it is too late to set this variable"]
    held = block.get(["u"])
    block.set(["y"], [np.nan])
    block.step(0.006, 0.002)  # a warning
    assert block.get(["u"]).tolist() == held.tolist()
    assert block.get(["diagnosis.status"]).tolist() == [-1]
    assert block.said[4:] == ["an input, or what comes of it, is not finite: the last output is held"]
    block.close()
    block = Block(plant, tmp_path)
    before = block.get(["z1", "v1"]).tolist()
    block.set(["u"], [np.inf])
    with pytest.raises(FMICallException):
        block.step(0.0, 0.1)
    assert block.said == ["an input or a state is not finite, or grew beyond all numbers"]
    assert block.get(["z1", "v1"]).tolist() == before
    block.close()


@both
def test_sources_do_without_a_compiler(
    machine: tuple[Spec, ControllerFile], version: Version, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is left out can be compiled later, from what the description names."""
    path, out = cart(tmp_path, "controller: {sample_time: 0.01}", duration=2), tmp_path / "out"
    monkeypatch.setenv("PATH", str(tmp_path))
    found = call("export", "fmu", path, "--out", out, "--fmi", version, "--of", "plant")
    monkeypatch.undo()
    assert found.exit_code == 0, found.output
    assert "sources only: no C compiler" in found.stdout
    (fmu,) = out.iterdir()
    assert validate_fmu(str(fmu)) == []
    folder = tmp_path / "unzipped"
    fmpy.extract(str(fmu), str(folder))
    assert not (folder / "binaries").exists()
    description = fmpy.read_model_description(folder)
    names = description.buildConfigurations[0].sourceFileSets[0].sourceFiles
    assert COMPILER is not None
    command = [COMPILER, "-std=c99", "-fPIC", "-shared", *names, "-lm", "-o"]
    subprocess.run([*command, tmp_path / "one.so"], cwd=folder / "sources", check=True)
    assert missing(tmp_path / "one.so", version) == []
    prefixed = [*command, tmp_path / "two.so", f"-DFMI{version}_FUNCTION_PREFIX=cart_"]
    subprocess.run(prefixed, cwd=folder / "sources", check=True)  # for who links several of them into one program
    assert hasattr(ctypes.CDLL(str(tmp_path / "two.so")), f"cart_fmi{version}DoStep")


@pytest.mark.slow
def test_the_command_exports_runs_and_refuses_what_is_not_proved(tmp_path: Path) -> None:
    path = cart(tmp_path, "controller: {sample_time: 0.01}", duration=2)
    run, out = tmp_path / "run", tmp_path / "out"
    assert call("design", path, "--out", run).exit_code == 0
    found = call("export", "fmu", run, "--out", out, "--name", "loop")
    assert found.exit_code == 0, found.output
    names = [f"loop_{part}_fmi{version}.fmu" for part in ("controller", "plant") for version in VERSIONS]
    assert sorted(file.name for file in out.iterdir()) == names
    with zipfile.ZipFile(out / names[0]) as archive:
        assert archive.read("resources/certificate.json") == (run / "certificate.json").read_bytes()
    (run / "certificate.json").unlink()
    error = refused(call("export", "fmu", run, "--out", tmp_path / "no"), 6)
    assert "not proved: there is no certificate.json beside it" in error
    assert not (tmp_path / "no").exists()
    again = call("export", "fmu", run, "--out", tmp_path / "un", "--unproved", "--of", "controller", "--fmi", "2")
    assert again.exit_code == 0, again.output
    (file,) = (tmp_path / "un").iterdir()
    assert "NOT PROVED: there is no certificate.json" in str(fmpy.read_model_description(str(file)).description)
    path.write_text(path.read_text(encoding="utf-8") + "# changed\n", encoding="utf-8")
    assert call("export", "fmu", run, "--out", tmp_path / "plant", "--of", "plant").exit_code == 0  # of the copy
    (run / "spec.txt").unlink()
    error = refused(call("export", "fmu", run, "--out", tmp_path / "no", "--of", "plant"), 2)
    assert "the spec that it was made from is not at hand, or was changed since" in error


def test_options_that_do_nothing_are_refused(tmp_path: Path) -> None:
    path, run, no = cart(tmp_path, "controller: {sample_time: 0.01}", duration=2), tmp_path / "run", tmp_path / "no"
    assert call("design", path, "--out", run).exit_code == 0
    for target in (run, run / "controller.json"):
        for options in (("--set", "k=2"), ("--sample-time", "0.02")):
            error = refused(call("export", "fmu", target, "--out", no, *options), 2)
            assert "--set and --sample-time go with a spec" in error
            assert "design with them and export that run" in error
    assert "go with a spec" in refused(call("export", "fmu", run, "--out", no, "--of", "plant", "--set", "k=2"), 2)
    for target in (run, path):
        for option in ("--sample-time 0.02", "--reference outside", "--unproved"):
            error = refused(call("export", "fmu", target, "--out", no, "--of", "plant", *option.split()), 2)
            assert option.removesuffix(" 0.02") in error
            assert "that is for a controller, and only the plant is exported" in error
            assert "--of both" in error
    assert not no.exists()


def test_a_plant_needs_no_design_and_says_its_units(tmp_path: Path) -> None:
    path = cart(tmp_path, "disturbance: {v: {constant: 0.1}}", duration=2)
    assert call("export", "fmu", path, "--out", tmp_path, "--of", "plant", "--name", "loop").exit_code == 0
    description = fmpy.read_model_description(str(tmp_path / "loop_plant_fmi3.fmu"))
    variables = {v.name: v for v in description.modelVariables}
    assert {name: v.unit for name, v in variables.items() if v.causality == "input"} == {
        "u": "N",
        "disturbance.v": "m/s/s",
    }
    assert (variables["start.z"].start, variables["start.z"].unit) == ("0.05", "m")
    base = {unit.name: unit.baseUnit for unit in description.unitDefinitions}
    newton, acceleration = base["N"], base["m/s/s"]
    assert (newton.kg, newton.m, newton.s, newton.factor) == (1, 1, -2, 1.0)
    assert (acceleration.m, acceleration.s) == (1, -2)
    block = Block(tmp_path / "loop_plant_fmi3.fmu", tmp_path)
    block.set(["disturbance.v"], [0.5])
    block.step(0.0, 0.25)
    assert block.get(["v"])[0] == pytest.approx(0.125, rel=1e-14)
    block.close()


def test_too_many_cells_are_refused_with_their_number(tmp_path: Path) -> None:
    springs = "\n".join(f"    - {{name: s{k}, kind: absolute, of: z{k}, into: {{z{k}: -1}}}}" for k in range(12))
    names = ", ".join(f"z{k}" for k in range(12))
    path = tmp_path / "many.yaml"
    path.write_text(
        f"name: Many\nsystem:\n  states: [{names}]\n  inputs: [u]\n  outputs: [y]\n"
        f"  A: {(-np.eye(12)).tolist()}\n  B: {np.ones((12, 1)).tolist()}\n  C: {np.eye(1, 12).tolist()}\n"
        f"  nonlinearities:\n{springs}\nreference: {{output: 0.1*sin(t)}}\n"
        "simulation: {duration: 1, sample_time: 0.1}\n",
        encoding="utf-8",
    )
    error = refused(call("export", "fmu", path, "--out", tmp_path / "no", "--of", "plant"), 2)
    assert "the plant has 4,096 cells: A_i and b_i are 638,976 numbers, and at most 524,288 are exported" in error
    assert not (tmp_path / "no").exists()


@pytest.mark.slow
def test_a_stored_controller_by_itself_has_no_plant(tmp_path: Path) -> None:
    spec = load_spec(cart(tmp_path, "controller: {sample_time: 0.01}", duration=2))
    folder = design(spec).save(tmp_path / "run")
    alone = tmp_path / "controller.json"
    shutil.copy(folder / "controller.json", alone)
    found = call("export", "fmu", alone, "--out", tmp_path / "out", "--of", "controller", "--unproved")
    assert found.exit_code == 0, found.output
    refused(call("export", "fmu", alone, "--out", tmp_path / "no", "--unproved"), 2)
