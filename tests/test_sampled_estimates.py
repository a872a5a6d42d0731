"""What acts on a sampled loop whose x_d, u_ff and η̂ depend on estimates of loads, while its reference moves."""

import copy
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from pwatrack import Spec, design, load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.claims.sampled_bounds import SampledBounds
from pwatrack.control.controller import ProvedController
from pwatrack.control.program import SampledController, program
from pwatrack.control.sampled_disturbances import row
from pwatrack.lmi.audit.certificate import audit
from pwatrack.model.conditions import Conditions, Sampling
from pwatrack.report.certificate import design_certificate
from pwatrack.simulation.acting_estimates import OtherCells, crossed
from pwatrack.simulation.controller_arrays import cell
from pwatrack.simulation.desired import desired_flow
from pwatrack.simulation.held import Held
from pwatrack.simulation.loads_along import LoadsAlong, with_loads
from pwatrack.simulation.propagate import simulate_flow
from tests.sampled import tubes_alone, worst_found
from tests.test_sampled_loads import BENT, LOADS, written

H = 0.02
ACTS = {
    "constants": "z: 0.1, a: 0.2, v: 0.1",
    "sinusoids": "z: 0.1*sin(3*t), a: 0.2",
    "bent": "a: 0.2",
    "bent by η": "a: 0.2",
}
MOVING = "reference: {output: 0.3*sin(t)}"


def moving(name: str, more: str = "") -> str:
    """Return a spec whose reference and loads move x_d through all cells, and whose loop is sampled."""
    text = written(name).replace("reference: {output: {constant: 0.05}}", MOVING)
    machine = f"controller: {{sample_time: {H}}}, disturbance: {{{ACTS[name]}}}{more}"
    machine += ", initial: {observer: measured, generator: [0.1]}"
    assert MOVING in text
    return text.replace("duration: 1, sample_time: 0.05", f"duration: 12, sample_time: {H}, {machine}")


@pytest.fixture(scope="module", params=[*LOADS, *BENT])
def loop(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, Spec, ProvedController, SampledBounds]:
    path = tmp_path_factory.mktemp("moving") / "plant.yaml"
    noise = f", noise: {{std: {{y: 1e-4, level: 1e-4}}, sample_time: {H}, seed: 1}}"
    path.write_text(moving(request.param, noise), encoding="utf-8")
    spec = load_spec(path)
    controller = design(spec)
    return request.param, spec, controller, controller.claim(SampledBounds)


class Program:
    """What a program of a controller makes of (ŝ, η̂, w, 1), and rows of x_d, u_ff and η̂' on it, cell by cell."""

    def __init__(self, controller: ProvedController) -> None:
        trajectory, added = controller.trajectory, controller.compensation
        loads = controller.plant.loads
        assert loads is not None
        self.tables: SampledController = program(controller, Conditions(sampling=Sampling(sample_time=H)))
        cells, n = trajectory.x_d.shape[:2]
        X = np.broadcast_to(added.X.floats, (cells, n, len(loads.S.floats)))
        self.x_d = np.concatenate([X, trajectory.x_d], axis=2)
        self.u_ff = np.concatenate([added.u_ff, trajectory.u_ff], axis=2)
        self.rate = np.concatenate([added.rate, trajectory.rate], axis=2)
        self.S, self.of = loads.S.floats, trajectory.exosystem.S
        self.k, self.p = len(loads.S.floats), trajectory.rate.shape[1]

    def flow(self, i: int) -> Array:
        """Return Φ of y' = Φ y in a cell."""
        F = np.zeros((self.x_d.shape[2], self.x_d.shape[2]))
        w = slice(self.k + self.p, -1)
        F[: self.k, : self.k], F[self.k : self.k + self.p], F[w, w] = self.S, self.rate[i], self.of
        return F

    def cell(self, y: Array) -> int:
        """Return the cell of x_d."""
        return cell(self.tables.sides, self.tables.guards @ y)


def between(made: Program, y: Array, other: Array) -> tuple[dict[int, float], Array]:
    """Return the shares of the cells on the straight way from y to another, and what it is."""
    way, count = other - y, 4000
    cells, numbers = np.unique([made.cell(y + way * (k + 0.5) / count) for k in range(count)], return_counts=True)
    return dict(zip(cells.tolist(), (numbers / count).tolist(), strict=True)), way


@pytest.mark.slow
def test_what_the_program_does_otherwise_in_another_cell_is_at_most_what_acts(
    loop: tuple[str, Spec, ProvedController, SampledBounds],
) -> None:
    """From y to ŷ by any way of estimates; of means that are counted along it, and programs as they are."""
    name, _, controller, bounds = loop
    made, plant, errors = Program(controller), controller.plant, bounds.errors
    others, random, loads = OtherCells(controller, errors), np.random.default_rng(0), controller.plant.loads
    assert loads is not None
    (n, m), k, p, E = plant.B.shape, made.k, made.p, loads.E.floats
    X, found = controller.compensation.X.floats, np.zeros((0, 2))
    for _ in range(60):
        t = random.uniform(0, 6)
        w = expm(made.of * t) @ controller.trajectory.exosystem.w0
        y = np.concatenate([random.normal(size=k) * 0.1, random.normal(size=p) * 0.2, w, [1.0]])
        hat = y + np.concatenate([random.normal(size=k + p) * 0.2, np.zeros(len(w) + 1)])
        shares, way = between(made, y, hat)
        a, b, epsilon = made.cell(hat), made.cell(y), way[: k + p]
        D = {j: made.x_d[j][:, : k + p] for j in shares}
        F = {j: np.vstack([np.hstack([made.S, np.zeros((k, p))]), made.rate[j][:, : k + p]]) for j in shares}
        alone, N = np.hstack([X @ made.S - E, np.zeros((n, p))]), made.x_d[a][:, k : k + p]
        c = sum(share * (alone + N @ F[j][k:] - plant.A[j] @ D[j]) for j, share in shares.items())
        mean = sum(share * F[j] for j, share in shares.items())
        F_a, nodes = made.flow(a)[: k + p, : k + p], np.polynomial.legendre.leggauss(12)
        times, weights = H / 2 * (nodes[0] + 1), H / 2 * nodes[1]
        P = sum(q * expm(F_a * t) for t, q in zip(times, weights, strict=True))
        Q = sum(q * (H - t) / H * expm(F_a * t) for t, q in zip(times, weights, strict=True))
        u = made.tables.u_ff[a] @ hat - made.tables.u_ff[b] @ y - np.linalg.pinv(plant.B) @ c @ epsilon
        u = u - made.u_ff[a][:, : k + p] @ Q @ mean @ epsilon
        eta = made.tables.generator[a] @ hat - made.tables.generator[b] @ y
        eta = eta - (epsilon + P @ mean @ epsilon)[k:]
        most_u, most_eta = (each[0] for each in others.at(y[None]))
        allowed = np.concatenate(
            [most_u, most_eta if errors.estimates is not None and errors.estimates.eta else 0 * eta]
        )
        left = np.abs([*u, *eta])
        counted = 2e-3 * np.abs(epsilon).max() * np.where(np.arange(len(left)) < m, 1.0, H)
        assert (left <= allowed * (1 + 1e-3) + counted).all()
        found = np.vstack([found, [float((left[:m] > 0.5 * allowed[:m]).all()), float(a != b)]])
    if name != "bent":  # there the reference alone decides
        assert found[:, 1].mean() > 0.2


@pytest.mark.parametrize("seed", range(5))
def test_what_is_crossed_is_at_most_what_acts(
    seed: int, loop: tuple[str, Spec, ProvedController, SampledBounds]
) -> None:
    name, _, controller, bounds = loop
    plant, random, largest = controller.plant, np.random.default_rng(seed), 0.0
    U, V = crossed(bounds.errors)
    assert bounds.errors.estimates is not None

    def f(x: Array) -> Array:
        i = plant.partition.locate(x)
        return np.asarray(plant.A[i] @ x + plant.b[i])

    for _ in range(300):
        x, step = random.normal(size=3) * 0.3, random.normal(size=3) * 0.1
        D = random.dirichlet(np.ones(len(bounds.errors.estimates.hull)))
        q = sum(share * D_j.floats for share, (_, D_j) in zip(D, bounds.errors.estimates.hull, strict=True))
        q = q @ random.normal(size=q.shape[1]) * 0.2
        left = np.abs(f(x + step + q) - f(x + step) - f(x + q) + f(x))
        allowed = U @ np.abs(V @ step) if len(V) else np.zeros(3)
        assert (left <= allowed + 1e-12).all()
        largest = max(largest, float((left / np.maximum(allowed, 1e-9)).max()))
    assert (largest > 0.9) == (name != "bent")
    assert (len(V) == 0) == (name == "bent")


def test_the_walk_shows_what_acts(loop: tuple[str, Spec, ProvedController, SampledBounds]) -> None:
    """The true trajectory in small steps, with its loads, and beside it the program's own at ticks."""
    _, spec, controller, bounds = loop
    acts, plant, fine, r = bounds.acts, controller.plant, 10, bounds.errors.gains.substeps
    along = LoadsAlong.of(controller, spec.scenario.conditions, bounds.errors.gains)
    assert np.abs(along.start).max() > 0.05
    trajectory, start = with_loads(controller, along), np.array([0.1])
    z0 = np.concatenate([start, trajectory.exosystem.w0, [1.0]])
    trace = simulate_flow(desired_flow(plant, trajectory), z0, duration=12, sample_time=H / fine)
    x_d = np.einsum("knj,kj->kn", trajectory.x_d[trace.modes[:, 0]], trace.z)
    own = Held(Program(controller).tables, start, along).take(600).x_d
    x_d = x_d[: 600 * fine + 1]
    moved = np.array([x_d[k * fine : (k + 1) * fine + 1] - own[k] for k in range(600)])
    U, V = crossed(bounds.errors)
    off = (np.abs(moved @ V.T).max(axis=1) @ U.T) if len(V) else np.zeros((600, 3))
    for k in range(3):
        most = acts.squares.get(("drawn", k), np.zeros(600 * r))[: 600 * r].reshape(600, r).max(axis=1)
        assert np.sqrt(most) == pytest.approx(off[:, k], rel=0.02, abs=0.02 * off[:, k].max() + 1e-12)
    planes = plant.partition
    g = np.array([np.vstack([x_d[k * fine : (k + 1) * fine + 1], own[k : k + 1]]) for k in range(600)]) @ planes.H.T
    g = g + planes.h
    apart = np.maximum(np.maximum(g.min(axis=1), -g.max(axis=1)), 0.0)
    assert acts.apart[: 600 * r : r] == pytest.approx(apart, abs=0.01 * np.abs(g).max())


def test_no_switching_is_above_the_tubes_of_what_acts(loop: tuple[str, Spec, ProvedController, SampledBounds]) -> None:
    _, _, controller, bounds = loop
    for channel, (one, *_) in tubes_alone(bounds).items():
        if channel[0] in ("drawn", "cell", "eta"):
            c, size = row(bounds.errors, (controller.tracking, 0)).floats, one.sizes[0]
            found = max(worst_found(bounds, channel, c, seed) for seed in range(10))
            assert 0.02 * size < found <= size


def test_runs_stay_within_their_bounds(loop: tuple[str, Spec, ProvedController, SampledBounds], tmp_path: Path) -> None:
    name, _, controller, bounds = loop
    kinds = {kind for kind, _ in tubes_alone(bounds)}
    assert ({"drawn", "cell", "eta"} <= kinds) == (name != "bent")
    ends = bounds.ends_below(controller)["output", 0]
    whole = float(bounds.anywhere["output", 0].max())
    assert 0 < ends <= whole
    worst = 0.0
    for seed in range(4):
        path = tmp_path / f"{seed}.yaml"
        noise = f", noise: {{std: {{y: 1e-4, level: 1e-4}}, sample_time: {H}, seed: {seed}}}"
        path.write_text(moving(name, noise), encoding="utf-8")
        run = simulate(load_spec(path), controller)
        assert run.outcome.kind != "above its bound"
        error = np.abs(run.response.tracking_error[:, 0])
        worst = max(worst, float(error[-len(error) // 10 :].max()))
    assert 0.01 * ends < worst < ends


@pytest.mark.slow
def test_the_auditor_agrees(loop: tuple[str, Spec, ProvedController, SampledBounds]) -> None:
    _, spec, controller, _ = loop
    content = json.loads(json.dumps(design_certificate(spec, controller)))
    said, faults = audit(json.dumps(content))
    assert not faults
    assert [one for one in said if one.startswith("the sampled loop: what ")]
    for tube in content["sampled_bounds"]:
        if tube["acts"][0]["channel"][0] == "eta":
            for changed in (["noise", 0], ["eta", 1], ["eta", -1]):
                forged = copy.deepcopy(
                    content | {"sampled_bounds": [tube | {"acts": [{"channel": changed, "size": "1"}]}]}
                )
                assert audit(json.dumps(forged))[1]


def test_of_loads_at_inputs_nothing_more_acts(tmp_path: Path) -> None:
    """E = B U: x_d is moved by none, and no cell makes another u_ff."""
    text = moving("constants").replace(
        "{drift: {into: {z: 1}}, filling: {into: {a: 1, v: 0.5}}}", "{push: {into: {v: 3}}}"
    )
    path = tmp_path / "plant.yaml"
    path.write_text(text.replace(ACTS["constants"], "v: 0.3"), encoding="utf-8")
    spec = load_spec(path)
    bounds = design(spec).claim(SampledBounds)
    assert not {"drawn", "cell", "eta"} & {kind for kind, _ in bounds.acts.squares}
