"""Between what the numbers of the program are: against runs of the exported program beside an independent plant."""

from dataclasses import replace
from math import ceil, floor
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from pwatrack import Spec, design, load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.claims.ranges import ProgramRanges
from pwatrack.claims.sampled import SampledLoop
from pwatrack.claims.sampled_bounds import SampledBounds
from pwatrack.control.controller import ProvedController
from pwatrack.control.sampled_disturbances import row
from pwatrack.export.controller import Controller
from pwatrack.report.files import write_design
from pwatrack.simulation.late_start import late_start
from tests.beside import beside, moved
from tests.test_cli import call
from tests.test_sampled_bounds import FRICTION, MACHINE

PUSHED = (
    FRICTION.replace("reference:", "design: {estimate: {d: {into: LOAD}}}\nreference:").rstrip()
    + """
  disturbance: {v: STEP, x: DRIFT}
  initial: {plant: [0.1, 0.2], observer: [0.05, 0]}
"""
)
MORE = {
    "a load at the input that steps": PUSHED.replace("LOAD", "{v: 1}")
    .replace("STEP", "{constant: 0.2, step: {size: 0.5, at: 3}}")
    .replace("DRIFT", "0"),
    "a load that moves x_d": PUSHED.replace("LOAD", "{x: 1}").replace("STEP", "0").replace("DRIFT", "0.05"),
    "late": FRICTION.replace(
        "{sample_time: 0.1}", "{sample_time: 0.1, delay: 1}"
    ).replace(  # at rest as its first input acts
        "{sine: {amplitude: 0.3, frequency: 4}}", "{step: {size: 0.3, at: 1, smooth: 1}}"
    ),
    "late, from a start on a plane, with noise": FRICTION.replace("sample_time: 0.1}", "sample_time: 0.1, delay: 2}")
    + """  noise: {std: {y: 1e-3}, sample_time: 0.1, seed: 1}
  initial: {plant: [0.1, 0.2], observer: [0.05, 0.2]}
""",
}
MORE |= {
    f"late, with {name}": text.replace("sample_time: 0.1}", "sample_time: 0.1, delay: 2}").replace("at: 3", "at: 0.1")
    for name, text in MORE.items()
    if "load" in name
}


LATE = [name for name in MORE if name.startswith("late, ")]


@pytest.fixture(scope="module", params=["two masses", *MORE])
def machine(
    request: pytest.FixtureRequest, specs: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Spec, ProvedController, Path]:
    text = (specs / "two_mass_paper_gains.yaml").read_text(encoding="utf-8")
    text = (
        text.replace("\nsimulation:\n", f"\nsimulation:{MACHINE}")
        if request.param == "two masses"
        else MORE[request.param]
    )
    folder = tmp_path_factory.mktemp("ranges")
    (folder / "plant.yaml").write_text(text, encoding="utf-8")
    spec = load_spec(folder / "plant.yaml")
    controller = design(spec)
    return spec, controller, write_design(spec, controller, folder / "out")


def ran(spec: Spec, controller: ProvedController, folder: Path, seed: int, *, single: bool) -> dict[str, Array]:
    """Return y, u, x̂, ŝ, x_d, η̂ and w of the program at its ticks, beside the plant from the start of the run on.

    Noise is as large as it is drawn at a tick, and a disturbance of v1 as large as it gets, of any sign.
    """
    plant, random, disturbance = controller.plant, np.random.default_rng(seed), spec.scenario.conditions.disturbance
    loop = Controller.load(folder / "controller.json", single=single)
    bounds, h = controller.claim(ProgramRanges).bounds, loop.sample_time
    ticks, seen = int(spec.scenario.duration / h), dict[str, list[Array]]()
    noise = np.sqrt(bounds.acts.squares.get(("noise", 0), np.zeros(len(bounds.acts.near))))
    push = 0.007 * np.array([name == "v1" for name in plant.states])

    def step(k: int, x: Array) -> Array:
        u = loop.step(plant.C @ x + random.choice([-1, 1]) * noise[k * len(noise) // ticks])
        for name in ("y", "u", "x_hat", "s_hat", "x_d", "eta_hat", "w"):
            seen.setdefault(name, []).append(loop.state(name).astype(float))
        return u.astype(float)

    def pushed(t: float) -> Array:
        loads = 0.0 if plant.loads is None or disturbance is None else disturbance(t)
        return np.asarray(random.choice([-1, 1]) * push + loads)

    beside(plant, step, simulate(spec, controller).response.x[0], ticks=ticks, h=h, disturbance=pushed)
    return {name: np.array(values) for name, values in seen.items()}


@pytest.mark.slow
@pytest.mark.parametrize("single", [False, True])
def test_no_number_of_the_program_is_outside(machine: tuple[Spec, ProvedController, Path], single: bool) -> None:
    spec, controller, folder = machine
    ranges = controller.claim(ProgramRanges).ranges
    each = [ran(spec, controller, folder, seed, single=single) for seed in range(3)]
    for name in each[0]:
        values = np.concatenate([one[name] for one in each])
        low, high = ranges[name].T
        slack = 1e-6 * np.abs(ranges[name]).max(initial=0.0) if single or name in ("x_d", "eta_hat", "w") else 0.0
        assert (values >= low - slack).all(), name
        assert (values <= high + slack).all(), name
        assert (high - low <= 20 * (values.max(axis=0) - values.min(axis=0)) + slack).all(), name


@pytest.mark.slow
@pytest.mark.parametrize("machine", LATE, indirect=True)
def test_what_is_predicted_as_the_first_input_acts_is_known_but_for_noise(
    machine: tuple[Spec, ProvedController, Path],
) -> None:
    """Noise adds what it would in the cells that it is predicted in; if these are others, there is a little more."""
    spec, controller, _ = machine
    plant, gains, random = controller.plant, controller.claim(SampledLoop).gains, np.random.default_rng(1)
    of, noise = controller.claim(SampledBounds).errors, controller.claim(SampledBounds).noise
    (n, m, N, *_), d, r = of.widths, gains.delay, gains.substeps
    run = simulate(spec, controller).response
    x = run.x[:: round(gains.sample_time / spec.scenario.sample_time)][: d + 1]
    assert of.starts is not None
    centre, *wide = (column.floats[:, 0] for column in of.starts)
    off = sum(map(np.abs, wide), np.zeros(of.order))[n + m :][: d * N]
    flows = []
    for A, b in zip(plant.observed.A, plant.b, strict=True):
        F = np.pad(A.floats, ((0, 1), (0, 1)))
        F[:n, -1] = b
        flows.append(expm(F * gains.sample_time / r))
    kept = np.eye(N) + gains.M @ plant.observed.C.floats

    def predicted(values: Array) -> tuple[Array, Array]:
        """Return what is predicted, the newest first, and what noise adds in the cells without it, (d N,) each."""
        v, more = [np.append(controller_start(spec, n), np.zeros(N - n))], [np.zeros(N)]
        for k in range(d):
            v = [v[0] + gains.M @ (plant.observed.C.floats @ v[0] - plant.C @ x[k] - values[k]), *v[: d - 1]][: k + 1]
            more = [kept @ more[0] - gains.M @ values[k], *more][: k + 1]
            for _ in range(r):
                for i, one in enumerate(v):
                    cell = plant.partition.locate(one[:n])
                    v[i], more[i] = (flows[cell] @ np.append(one, 1.0))[:N], flows[cell][:N, :N] @ more[i]
        return np.concatenate(v), np.concatenate(more)

    true = np.tile(np.append(x[d], of_loads(spec, controller, d * gains.sample_time)), d)
    at = slice(n + m, n + m + d * N)
    nominal = predicted(np.zeros((d, len(noise))))[0]
    assert np.abs(nominal - true - centre[at]).max() < 1e-9
    for _ in range(200):
        found, more = predicted(random.choice([-1, 1], size=(d, len(noise))) * noise)
        assert (np.abs(found - more - nominal) <= off + 1e-9).all()
    assert off.any() == (bool(noise.any()) and len(wide) > 0)


def controller_start(spec: Spec, n: int) -> Array:
    """Return x̂(0) of a spec that says it."""
    return np.asarray(spec.scenario.initial.observer, dtype=float).reshape(n)


def of_loads(spec: Spec, controller: ProvedController, t: float) -> Array:
    """Return the loads s of a run that are constants, (k,)."""
    loads, disturbance = controller.plant.loads, spec.scenario.conditions.disturbance
    return np.zeros(0) if loads is None or disturbance is None else np.linalg.pinv(loads.E.floats) @ disturbance(t)


WAITING = """
name: a tank with one cell
system: {states: [x], inputs: [u], outputs: [y], B: [[1]], C: [[1]], cells: [{name: all, A: [[-1]]}]}
design: {observer: {rate: 6}, estimate: {d: {into: {x: 1}}}}
reference: {output: {constant: 0}}
simulation: {duration: 6, sample_time: 0.01, controller: {sample_time: 0.1, delay: 1}, MORE}
"""
WAITED = {
    "the load is known at once": "disturbance: {x: {constant: 10}}, initial: {plant: [-1.05], observer: [-3.2588]}",
    "x̂ is far off": "initial: {plant: [0], observer: [5]}",
    "what acts is over": "disturbance: {x: {constant: 5, step: {size: -5, at: 0.1}}}, initial: {observer: [0]}",
}


@pytest.mark.parametrize("how", WAITED)
def test_what_the_program_has_as_inputs_wait_is_in_its_ranges(how: str, tmp_path: Path) -> None:
    """What it starts with, x̂ as it is predicted and as it is corrected, and no input."""
    (tmp_path / "plant.yaml").write_text(WAITING.replace("MORE", WAITED[how]), encoding="utf-8")
    spec = load_spec(tmp_path / "plant.yaml")
    controller = design(spec)
    run = simulate(spec, controller)
    ranges = controller.claim(ProgramRanges).ranges
    assert ranges["u"][0, 0] <= 0 <= ranges["u"][0, 1]
    assert ranges["s_hat"][0, 0] <= 0 <= ranges["s_hat"][0, 1]
    for at in (controller_start(spec, 1), *run.response.x_hat):
        assert (ranges["x_hat"][:, 0] <= at + 1e-9).all()
        assert (at - 1e-9 <= ranges["x_hat"][:, 1]).all()
    bounds = controller.claim(SampledBounds)
    most = bounds.from_start["output", 0]
    step = bounds.errors.gains.sample_time / bounds.errors.gains.substeps
    at = np.minimum((run.response.t / step + 1e-9).astype(int), len(most) - 1)
    assert (np.abs(run.response.tracking_error[:, 0]) <= most[at] * (1 + 1e-9) + 1e-12).all()
    said = " ".join(text for _, text in bounds.rows(spec.words, controller))
    assert "from the start of this run on never more than" in said


@pytest.mark.slow
@pytest.mark.parametrize("machine", [name for name in LATE if "moves" not in name], indirect=True)
def test_ticks_off_their_times_move_where_the_run_is_as_the_first_input_acts(
    machine: tuple[Spec, ProvedController, Path],
) -> None:
    """x goes on for longer, or not so long, and is measured earlier and later: by as much as is said, and not far less.

    Before, what is seen of x at any time that may be that of a substep is within what signals are in it.
    """
    spec, controller, _ = machine
    plant, conditions, theta = controller.plant, spec.scenario.conditions, 0.004
    errors = controller.claim(SampledBounds).errors
    gains = replace(errors.gains, jitter=2 * theta)
    n, d, h, r = len(plant.B), gains.delay, gains.sample_time, gains.substeps
    scenario = replace(spec.scenario, duration=0.5, sample_time=theta, conditions=replace(conditions, noise=None))
    run = simulate(replace(spec, scenario=scenario), controller).response
    x_hat, K, last = controller_start(spec, n), d * r, round(d * h / theta)
    begin, quiet = (run.x[0], x_hat, run.eta_hat[0]), {"off": np.zeros(n), "noise": np.zeros(len(plant.C))}
    found = late_start(controller, scenario.conditions, replace(errors, gains=gains), begin, **quiet)
    exact = late_start(controller, scenario.conditions, errors, begin, **quiet)
    assert found is not None
    assert exact is not None
    assert found.z[:n] == pytest.approx(exact.z[:n], abs=1e-12)
    assert not exact.missed.any()
    x = [run.x[0]]  # without input
    for k in range(last + 1):
        pushed = 0.0 if conditions.disturbance is None else conditions.disturbance((k + 0.5) * theta)
        x.append(moved(plant, x[-1], pushed + np.zeros(n), theta / 20, 20))
    e = np.array(x) - run.x_d[: last + 2]
    later = np.abs(np.array([e[last - 1], e[last + 1]]) - e[last]).max(axis=0)
    assert (later <= found.moved).all()
    assert later[-1] >= 0.5 * found.moved[-1]
    y, ticks = np.array(x) @ plant.C.T, [round(k * h / theta) for k in range(1, d + 1)]
    missed = np.abs([y[k + one] - y[k] for k in ticks for one in (-1, 1)]).max(axis=0)
    assert (missed <= found.missed).all()
    assert (missed >= 0.5 * found.missed).all()
    tracked = np.abs(e @ plant.tracked.T)[:, 0]
    for j in range(K):
        first, end = floor((j * h / r / theta) - 1 + 1e-9), ceil(((j + 1) * h / r) / theta + 1 - 1e-9)
        assert tracked[max(first, 0) : end + 1].max() <= found.beside["output", 0][j] * (1 + 1e-9)


def test_a_stiff_plant_has_a_start_too(tmp_path: Path) -> None:
    text = WAITING.replace("A: [[-1]]", "A: [[-10000]]").replace("B: [[1]]", "B: [[10000]]")
    text = text.replace("design: {observer: {rate: 6}, estimate: {d: {into: {x: 1}}}}\n", "")
    (tmp_path / "plant.yaml").write_text(text.replace("MORE", "initial: {plant: [1]}"), encoding="utf-8")
    assert design(load_spec(tmp_path / "plant.yaml")).claim(SampledBounds).acts.late is not None


def test_what_is_off_is_at_least_what_the_bounds_of_signals_say(machine: tuple[Spec, ProvedController, Path]) -> None:
    _, controller, _ = machine
    bounds = controller.claim(ProgramRanges).bounds
    for form, most in bounds.from_zero.items():
        if form[0] == "estimate":
            assert bounds.off(row(bounds.errors, form).floats)[0] >= most.max() * (1 - 1e-9)


def test_they_are_said(machine: tuple[Spec, ProvedController, Path]) -> None:
    spec, controller, _ = machine
    said = " ".join(text for _, text in controller.claim(ProgramRanges).rows(spec.words, controller))
    said = f"numbers {said}"
    assert said.startswith("numbers in the program, in this run from ")


@pytest.mark.slow
def test_a_limit_of_the_rate_is_a_limit_too(tmp_path: Path) -> None:
    """An input that may hardly change leaves all bounds: they say what they are of, and how long it was so."""
    path = tmp_path / "plant.yaml"
    path.write_text(f"{FRICTION.rstrip()}\n  rate_limit: {{u: 0.1}}\n", encoding="utf-8")
    said = " ".join(call("design", path, "--out", tmp_path / "out", "--verbose").stdout.split())
    held = "while no input changes as fast as it may"
    assert said.count(held) >= 2
    short = " ".join(call("simulate", path, "--out", tmp_path / "out").stdout.split())
    assert "the rate of u is at a limit" in short
    first = " ".join(call("design", path, "--out", tmp_path / "out").stdout.split())
    assert f"proved {held}" in first
