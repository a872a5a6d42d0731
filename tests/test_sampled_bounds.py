"""What is left of the errors of a sampled loop: against closed forms, worst cases that are built, and the loop."""

import copy
import json
import re
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from scipy.integrate import simpson
from scipy.linalg import expm

from pwatrack import Spec, design, load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix
from pwatrack.claims import tube_text
from pwatrack.claims.bounds import SignalBounds
from pwatrack.claims.practical import Practical
from pwatrack.claims.sampled import SampledLoop
from pwatrack.claims.sampled_bounds import SampledBounds
from pwatrack.claims.sampled_start import is_start
from pwatrack.claims.tube_search import TubeSearch
from pwatrack.control.bounds import Channel
from pwatrack.control.controller import ProvedController, Seen
from pwatrack.control.program import program
from pwatrack.control.sampled_disturbances import Acting, driven, level, row
from pwatrack.control.sampled_gains import SampledGains
from pwatrack.lmi.audit.certificate import audit
from pwatrack.lmi.clocked import Clocked
from pwatrack.lmi.clocked_tubes import Drive, Tube, TubeProgram, tube
from pwatrack.model.conditions import Conditions, Sampling
from pwatrack.report.certificate import design_certificate
from pwatrack.simulation import acting
from pwatrack.simulation.desired import desired_flow
from pwatrack.simulation.held import Held
from pwatrack.simulation.loads_along import LoadsAlong
from pwatrack.simulation.propagate import simulate_flow
from pwatrack.workflow.bands import start_of_errors
from pwatrack.workflow.pipeline import asked_of
from tests.plain import Plain
from tests.sampled import all_of_size_one, asking, integrated, tubes_alone, worst_found
from tests.test_cli import call

MACHINE = """
  controller: {sample_time: 0.1}
  noise: {std: {y: 1e-4}, sample_time: 0.1, seed: 1}
  quantum: {y: 1e-5, u: 0.01}
  disturbance: {v1: {constant: 0.002, sine: {amplitude: 0.005, frequency: 3}}}
"""


@pytest.fixture(scope="module")
def sampled(specs: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Spec, ProvedController]:
    text = (specs / "two_mass_paper_gains.yaml").read_text(encoding="utf-8")
    path = tmp_path_factory.mktemp("sampled") / "plant.yaml"
    path.write_text(text.replace("\nsimulation:\n", f"\nsimulation:{MACHINE}"), encoding="utf-8")
    spec = load_spec(path)
    return spec, design(spec)


FRICTION = """
name: A mass with friction
system:
  states: [x, v]
  inputs: [u]
  outputs: [y]
  B: [[0], [1]]
  C: [[1, 0]]
  cells:
    - {name: forwards, where: ["v >= 0.2"], A: [[0, 1], [0, -0.5]], b: [0, -0.2]}
    - {name: slow, where: ["v <= 0.2", "v >= -0.2"], A: [[0, 1], [0, -1.5]]}
    - {name: backwards, where: ["v <= -0.2"], A: [[0, 1], [0, -0.5]], b: [0, 0.2]}
reference:
  output: {sine: {amplitude: 0.3, frequency: 4}}
simulation:
  duration: 8
  sample_time: 0.01
  controller: {sample_time: 0.1}
"""

TANK = """  states: [x]
  inputs: [u]
  outputs: [y]
  B: [[2]]
  C: [[1]]
  cells:
    - {name: high, where: ["x >= 0.1"], A: [[-1]], b: [-0.1]}
    - {name: low, where: ["x <= 0.1"], A: [[-2]]}
reference"""


@pytest.fixture(scope="module")
def friction(tmp_path_factory: pytest.TempPathFactory) -> tuple[Spec, ProvedController]:
    """A plant with cells of what its input drives: R B is not 0."""
    path = tmp_path_factory.mktemp("friction") / "plant.yaml"
    path.write_text(FRICTION, encoding="utf-8")
    spec = load_spec(path)
    return spec, design(spec)


def the_bounds(controller: ProvedController) -> SampledBounds:
    return controller.claim(SampledBounds)


@pytest.mark.parametrize("g", [0.9, 0.5, -0.7])
def test_noise_at_ticks_leaves_the_sum_of_what_each_tick_leaves(g: float) -> None:
    """z' = −z and z⁺ = g z + d: at most 1 / (1 − |g| e^(−h)), and a tube is an ellipse of one dimension: exact."""
    h, one, nothing = 0.1, BallMatrix.of([[1]]), BallMatrix.of([[0]])
    system = Clocked(F=[BallMatrix.of([[-1]])], J=[BallMatrix.of([[g]])], period=Fraction("0.1"))
    program = TubeProgram(system=system, near=np.eye(1), knots=4)
    worst = 1 / (1 - abs(g) * np.exp(-h))
    decays = np.geomspace(0.1, 1.9 * program.clock.most, 25)
    drive = Drive(held=nothing, between=nothing, ticks=[one])
    found = [tube(program, drive, one, np.ones(1), float(f"{decay:.3g}")) for decay in decays]
    least = min(each.sizes[0] for each in found if each is not None)
    assert worst <= least < 1.03 * worst


def test_what_drives_beside_a_state_is_what_that_state_drives() -> None:
    """z' = −(z + d) is at most 1."""
    one, nothing = BallMatrix.of([[1]]), BallMatrix.of([[0]])
    system = Clocked(F=[BallMatrix.of([[-1]])], J=[one], period=Fraction("0.1"))
    program = TubeProgram(system=system, near=np.eye(1), knots=1)
    found = tube(program, Drive(held=one, between=nothing), one, np.ones(1), 1.0)
    assert found is not None
    assert 1.0 <= found.sizes[0] < 1.01


@pytest.mark.parametrize("seed", range(4))
def test_no_switching_and_nothing_that_acts_is_above_a_tube(seed: int, sampled: tuple[Spec, ProvedController]) -> None:
    _, controller = sampled
    claim = the_bounds(controller)
    assert {kind for kind, _ in tubes_alone(claim)} == {"disturbance", "noise", "input", "nominal", "moved", "start"}
    assert [one.summed for one in tubes_alone(claim)["moved", 0]] == [False, True]
    for channel, each in tubes_alone(claim).items():
        for one in each:
            c = row(claim.errors, ("output", 0)).floats
            found = worst_found(claim, channel, c, seed, summed=one.summed)
            assert 0.05 * one.sizes[0] < found <= one.sizes[0]


@pytest.fixture(scope="module")
def together(sampled: tuple[Spec, ProvedController]) -> ProvedController:
    """The same controller with one tube for all that acts between ticks; of others there is one."""
    _, controller = sampled
    claim, proof = the_bounds(controller), controller.claim(SampledLoop).proof
    assert proof is not None
    search = TubeSearch.of(controller, claim.forms, claim.errors, proof)
    joined = replace(claim, tubes=tuple(search.together(claim.acts)))
    return replace(controller, claims=tuple(joined if one is claim else one for one in controller.claims))


def test_in_a_form_that_is_not_definite_to_working_precision_no_tube_is_found(
    sampled: tuple[Spec, ProvedController],
) -> None:
    _, controller = sampled
    claim, proof = the_bounds(controller), controller.claim(SampledLoop).proof
    assert proof is not None
    search = TubeSearch.of(controller, claim.forms, claim.errors, proof)
    thin = np.diag(np.logspace(0, -400, len(search.program.near)))
    whole, found = (
        tubes_alone(replace(claim, tubes=tuple(each.tubes(claim.acts))))
        for each in (search, replace(search, program=replace(search.program, near=thin)))
    )
    assert found.keys() < whole.keys() or not found


@pytest.mark.parametrize("seed", range(4))
def test_channels_are_below_the_tube_that_they_have_together(seed: int, together: ProvedController) -> None:
    """For one switching each does its worst, and each has what share of d² makes the sum largest."""
    claim, c = the_bounds(together), row(the_bounds(together).errors, ("output", 0)).floats
    ((sizes, (one,)),) = (each for each in claim.tubes if len(each[0]) > 1)
    assert {kind for kind, _ in sizes} == {"nominal", "moved", "disturbance", "input"}
    assert tubes_alone(claim).keys() == {("noise", 0), ("start", 0)}
    each = [size * worst_found(claim, of, c, seed) for of, size in sizes.items()]
    assert 0.05 * one.sizes[0] < np.linalg.norm(each) <= one.sizes[0]


def test_a_tube_together_says_about_what_one_for_each_channel_says(
    sampled: tuple[Spec, ProvedController], together: ProvedController
) -> None:
    """That of most of what is left is as large; others give way a little. The largest causes are the same."""
    spec, controller = sampled
    own, joined = the_bounds(controller), the_bounds(together)
    for form in (("output", 0), ("input", 0)):
        ends, others = own.ends_below(controller)[form], joined.ends_below(together)[form]
        assert 0.7 * ends < others < 1.2 * ends
        by = own.ends_by(controller, form), joined.ends_by(together, form)
        causes = [max(one, key=lambda at: one[at]) for one in by]
        assert causes[0] == causes[1]
        assert sum(by[1].values()) < 1.01 * others
        assert (joined.from_start[form] < 1.5 * own.from_start[form]).all()
    told = [one.figures(spec.words, controller)["sampled_bounds"]["per_1"] for one in (own, joined)]
    assert told[0].keys() == told[1].keys()
    for name, each in told[0].items():
        assert all(told[1][name][signal] > 0.5 * most for signal, most in each.items()), name


def test_a_tube_together_is_in_the_certificate(
    sampled: tuple[Spec, ProvedController], together: ProvedController
) -> None:
    spec, _ = sampled
    content, claim = design_certificate(spec, together), the_bounds(together)
    said, faults = audit(json.dumps(content))
    assert not faults
    assert "the sampled loop: what 5 disturbances, noises and inputs leave is proved" in said
    (told,) = SampledBounds.prove(together, asking(spec, together, claim.errors.gains), content)
    assert told.data(together) == claim.data(together)
    assert told.ends_below(together) == claim.ends_below(together)
    acts = content["sampled_bounds"][0]["acts"]
    for one in acts:
        forged = copy.deepcopy(content)
        forged["sampled_bounds"][0]["acts"][acts.index(one)]["size"] = f"{100 * float(one['size']):.3g}"
        assert audit(json.dumps(forged))[1], one


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("summed", [False, True])
def test_scalars_beside_what_edges_see_stay_in_their_tube(summed: bool, seed: int) -> None:
    """Two act beside z₁ and z₂, which an edge of a box sees; the other one by itself: for any ε(t) and ‖d‖ ≤ 1."""
    random = np.random.default_rng(seed)
    A, u, v = np.array([[-2.0, 1.0], [-1.0, -3.0]]), np.array([[0.6], [0.3]]), np.array([[0.5, -0.7]])
    E, G = np.array([[1.0, 0.0, 0.0], [0.0, 0.5, 0.0]]), np.array([[0.0, 0.0, 0.4], [0.2, 0.0, 0.0]])
    F, U, V, J, rows = (BallMatrix.of(X) for X in (A, u, v, 0.9 * np.eye(2), np.eye(2)))
    system = Clocked(F=[F], U=[U], V=[V], J=[J], period=Fraction("0.2"))
    program, whole = (
        TubeProgram(system=system, near=np.eye(2), knots=2),
        Drive(held=BallMatrix.of(E), between=BallMatrix.of(G)),
    )
    found, half = (
        tube(program, drive, rows, np.ones(2), 1.5, summed=summed) for drive in (whole, Drive.together([whole], [0.5]))
    )
    assert found is not None
    assert half is not None
    assert np.array(half.sizes) == pytest.approx(0.5 * np.array(found.sizes), rel=0.02)
    z, most, dt = np.zeros((200, 2)), np.zeros(2), 0.01
    for k in range(400):
        eps, d = random.choice([-1, 1], size=(200, 1)), random.normal(size=(200, 3))
        d /= np.linalg.norm(d, axis=1)[:, None]
        acting = d / dt * (k == 7) if summed else d
        moved = z + acting @ E.T
        z = z + dt * (moved @ A.T + eps * (moved @ v.T) @ u.T + acting @ G.T)
        if k % 20 == 19:
            z = 0.9 * z
        most = np.maximum(most, np.abs(z).max(axis=0))
    assert (most <= found.sizes).all()
    assert (most >= 0.02 * np.array(found.sizes)).all()


@pytest.mark.parametrize("kind", ["noise", "disturbance", "moved"])
def test_a_level_is_above_what_v_can_come_to(kind: Literal["noise", "disturbance", "moved"]) -> None:
    """V' = −a V + a d², V⁺ = (1 − b) V + b d², v' = −(a / 2) v + |d|, for d that jumps eight times in a substep."""
    random, parts, fine, K = np.random.default_rng(5), 3, 8, 90
    gains = SampledGains(K=np.eye(1), M=np.eye(1), sample_time=0.3, substeps=parts)
    d = random.normal(size=(K, fine)) * (random.random((K, 1)) < 0.3)
    squares, means = (d**2).mean(axis=1), np.abs(d).mean(axis=1)
    if kind == "noise":
        squares = np.repeat(d[::parts, 0] ** 2, parts)
    acts = Acting(
        squares={(kind, 0): squares},
        means={(kind, 0): means},
        beside={},
        planes=np.eye(1),
        near=np.zeros((K, 1)),
        apart=np.zeros((K, 1)),
        changes=np.zeros(1),
        loads=np.zeros(0),
    )
    one = Tube(
        Q=(),
        T=(),
        a=0.0 if kind == "noise" else 0.8,
        b=0.2 if kind == "noise" else 0.0,
        sizes=(),
        summed=kind == "moved",
    )
    found, V, dt = level(acts.together({(kind, 0): 1.0}, one, {}), one, gains), 0.0, 0.1 / fine
    for k in range(K):
        if kind == "noise" and k % parts == 0:
            V = 0.8 * V + 0.2 * d[k, 0] ** 2
        for each in np.abs(d[k]):
            if kind == "disturbance":
                V = each**2 + (V - each**2) * np.exp(-0.8 * dt)
            if kind == "moved":
                V = 2.5 * each + (V - 2.5 * each) * np.exp(-0.4 * dt)
            assert found[k] >= (V if kind == "moved" else V**0.5) * (1 - 1e-12)
        if k % 10 == 9:
            assert found[k] <= 1.1 * (V if kind == "moved" else V**0.5) + 0.1


def fine_walk(spec: Spec, controller: ProvedController, start: list[float], fine: int) -> tuple[Array, Array, Array]:
    """Return x_d, e₀ and u − u_ff of the nominal loop at so many points of each substep, both ends in.

    What the program holds is what it has at ticks: a run of one cell, below, shows it too.
    """
    claim, trajectory, plant = the_bounds(controller), controller.trajectory, controller.plant
    gains = claim.errors.gains
    runs = program(controller, Conditions(sampling=Sampling(sample_time=gains.sample_time)))
    r, step = gains.substeps, gains.sample_time / (gains.substeps * fine)
    z0 = np.concatenate([start, trajectory.exosystem.w0, [1.0]])
    trace = simulate_flow(desired_flow(plant, trajectory), z0, duration=spec.scenario.duration, sample_time=step)
    cell, count = trace.modes[:, 0], (len(trace.t) - 1) // (r * fine)
    own = Held(runs, np.array(start), LoadsAlong.of(controller, spec.scenario.conditions, gains)).take(count)
    u_ff = np.einsum("kmj,kj->km", trajectory.u_ff[cell], trace.z)
    x_d = np.einsum("knj,kj->kn", trajectory.x_d[cell], trace.z)
    A, B = np.mean(np.unique(plant.A, axis=0), axis=0), plant.B
    turn = expm(np.block([[A, B], [np.zeros((1, len(A) + 1))]]) * step)
    e, found = np.zeros(len(A)), list[tuple[Array, Array, Array]]()
    for k in range(count * r):
        if k % r == 0:
            held = own.u_ff[k // r] + gains.K @ (x_d[k * fine] - own.x_d[k // r]) + gains.K @ e
        for i in range(fine + 1):
            at_i = k * fine + i
            found.append((x_d[at_i], e, held - u_ff[at_i]))
            if i < fine:
                mean = held - (u_ff[at_i] + u_ff[at_i + 1]) / 2
                e = (turn @ np.append(e, mean))[: len(A)]
    return tuple(np.array(part).reshape(count * r, fine + 1, -1) for part in zip(*found, strict=True))  # type: ignore[return-value]


@pytest.mark.parametrize("which", ["sampled", "friction"])
def test_what_acts_is_what_the_walk_shows_in_between(which: str, request: pytest.FixtureRequest) -> None:
    """The desired trajectory and the nominal loop in small steps, means by Simpson's rule."""
    spec, controller = request.getfixturevalue(which)
    claim, plant, acts = the_bounds(controller), controller.plant, the_bounds(controller).acts
    x_d, e, off = fine_walk(spec, controller, {"sampled": [0.2, 0.0], "friction": []}[which], 20)
    R, count = claim.errors.R.floats, len(x_d)
    moved = ((x_d + e - (x_d + e)[:, :1]) @ R.T)[..., 0]
    near = np.abs((x_d + e) @ plant.partition.H.T + plant.partition.h)
    machine = 0.005 if which == "sampled" else 0.0

    def close(found: Array, wanted: Array, share: float) -> None:
        assert found[:count] == pytest.approx(wanted, abs=share * wanted.max())

    close(np.sqrt(acts.squares["moved", 0]), np.sqrt(simpson(moved**2, axis=1) / 20), 0.03)
    close(acts.means["moved", 0], simpson(np.abs(moved), axis=1) / 20, 0.03)
    close(np.sqrt(acts.squares["nominal", 0]), np.sqrt(simpson((e @ R.T)[..., 0] ** 2, axis=1) / 20), 0.03)
    close(acts.beside["input", 0] - machine, np.abs(off).max(axis=1)[:, 0], 0.03)
    close(acts.beside["output", 0], np.abs(e @ plant.tracked.T).max(axis=1)[:, 0], 0.03)
    for k in range(near.shape[2]):
        close(acts.near[:, k], near.min(axis=1)[:, k], 0.02)


def test_what_ticks_off_their_times_add_is_enclosed_closely(friction: tuple[Spec, ProvedController]) -> None:
    """Of all times t within half of the jitter of each τ of a fine walk: never above, nor far off."""
    spec, controller = friction
    plain, plant, fine = the_bounds(controller).errors, controller.plant, 20
    h, r = plain.gains.sample_time, plain.gains.substeps
    theta = 2 * h / (r * fine)  # two points of the walk
    errors = replace(plain, gains=replace(plain.gains, jitter=2 * theta))
    acts = asking(spec, controller, errors.gains).acting(controller, errors)
    assert acts is not None
    x_d, e, off = fine_walk(spec, controller, [], fine)
    count, (n, m) = len(x_d), plant.B.shape
    R, A0, cells = errors.R.floats, errors.mean.floats, np.unique(plant.A, axis=0)

    def away(each: Array) -> list[Array]:
        """Return by how much something is more at each t, in each substep, (K, fine + 1, k) each."""
        points = np.concatenate([each[:, :-1].reshape(-1, each.shape[2]), each[-1, -1:]])
        at = np.arange(count)[:, None] * fine + np.arange(fine + 1)
        return [points[np.clip(at + w, 0, len(points) - 1)] - each for w in (-2, -1, 1, 2)]

    def close(found: Array, least: Array, share: float) -> None:
        """Hold what is found against the largest that was seen in each substep; none is looked at near the ends."""
        inside, found = slice(r, count - r), found[:count]
        assert (found[inside] >= least[inside] * (1 - 1e-6) - 1e-12).all()
        assert found[inside].max() <= share * least[inside].max()

    moved = [np.abs(each).max(axis=1) for each in away(x_d + e)]
    for k in range(n):
        close(acts.beside["estimate", k], np.max([each[:, k] for each in moved], axis=0), 1.3)
    measured = np.max([np.abs(each @ plant.C.T)[:, 0, 0] for each in away(x_d + e)], axis=0)
    first = np.arange(count) % r == 0
    close(np.sqrt(acts.squares["noise", 0])[:count] * first, measured * first, 1.5)
    q = np.zeros((count, n))
    for of_x_d, of_e in zip(away(x_d), away(e), strict=True):
        for A_m in cells:
            for A_j in cells:
                q = np.maximum(q, np.abs(of_x_d @ (A_m - A_j).T + of_e @ (A0 - A_j).T).max(axis=1))
    for k in np.flatnonzero(q.max(axis=0)).tolist():
        close(np.sqrt(acts.squares["predicted", k]), q[:, k], 1.5)
    change, swap = np.abs(np.diff(off[:, [0, -1]].reshape(-1, m)[1:], axis=0))[::2], np.zeros((count, m))
    share = theta / (h / r)
    swap[1:] += change * share
    swap[:-1] += change * share
    close(acts.means["swap", 0], swap[:, 0], 1.3)
    nearby = [np.abs((e + each) @ plant.tracked.T).max(axis=1) for each in away(e)]
    close(acts.beside["output", 0], np.max(nearby, axis=0)[:, 0], 1.1)
    means = [(((e + each) @ R.T) ** 2).mean(axis=1) for each in away(e)]
    close(np.sqrt(acts.squares["nominal", 0]), np.sqrt(np.max(means, axis=0)[:, 0]), 2.0)
    assert set(acts.squares) == {
        *(("nominal", k) for k in range(2 * len(R))),
        *((kind, 0) for kind in ("moved", "noise", "swap")),
        *(("predicted", k) for k in np.flatnonzero(q.max(axis=0)).tolist()),
    }


@pytest.mark.parametrize("which", ["sampled", "friction"])
def test_what_acts_does_not_depend_on_how_the_walk_is_cut(
    which: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec, controller = request.getfixturevalue(which)
    acts = the_bounds(controller).acts
    monkeypatch.setattr(acting, "BLOCK", 7)
    monkeypatch.setattr(acting, "AT_ONCE", 3)
    asked = asking(spec, controller, the_bounds(controller).errors.gains)
    found = asked.acting(controller, the_bounds(controller).errors)
    assert found is not None
    acts = replace(acts, squares={channel: each for channel, each in acts.squares.items() if channel[0] != "start"})
    assert (found.squares.keys(), found.beside.keys()) == (acts.squares.keys(), acts.beside.keys())
    pairs = [(found.squares[channel], each) for channel, each in acts.squares.items()]
    pairs += [(found.means[channel], each) for channel, each in acts.means.items()]
    pairs += [(found.beside[form], each) for form, each in acts.beside.items()]
    for one, other in pairs:
        assert one == pytest.approx(other, rel=1e-4, abs=1e-6 * other.max())
    assert found.near == pytest.approx(acts.near, abs=1e-6)


def test_noise_and_disturbances_act_as_large_as_they_are(sampled: tuple[Spec, ProvedController]) -> None:
    _, controller = sampled
    claim = the_bounds(controller)
    acts, parts = claim.acts.squares, claim.errors.gains.substeps
    step = claim.errors.gains.sample_time / parts
    t = step * (np.arange(len(acts["noise", 0]))[:, None] + (np.arange(50) + 0.5) / 50)
    drawn = 0.002 + 0.005 * np.sin(3 * t)
    assert acts["disturbance", 1] == pytest.approx((drawn**2).mean(axis=1), rel=0.02, abs=2e-7)
    noise = np.abs(np.random.default_rng(1).normal(size=(601, 1)) * 1e-4)[:, 0] + 5e-6
    assert acts["noise", 0] == pytest.approx(np.repeat(noise**2, parts)[: len(t)])


@pytest.mark.parametrize("seed", range(3))
def test_less_the_nominal_loop_only_what_is_otherwise_is_left(
    seed: int, friction: tuple[Spec, ProvedController]
) -> None:
    """z under ω that jumps and rises is e₀, and what R e₀ and what R e₀ moved drive, at all times."""
    errors, random, fine = the_bounds(friction[1]).errors, np.random.default_rng(seed), 4
    system, (n, m, N, _) = errors.clocked, errors.widths
    F, J, K = np.array([X.floats for X in system.vertices]), system.J[0].floats, errors.gains.K
    assert system.between is not None
    B, R, A0 = friction[1].plant.B, errors.R.floats, errors.mean.floats
    ends, dt = system.between.floats, float(system.period) / system.parts / fine
    nominal, moved = (driven(errors, (kind, 0)) for kind in ("nominal", "moved"))
    z, left, e, order = np.zeros(errors.order), np.zeros(errors.order), np.zeros(n), errors.order
    for _ in range(20):
        z, left, held = J @ z, J @ left, K @ e
        for k in range(system.parts * fine):
            if k % fine == 0:
                z, left, p = (ends @ z, ends @ left, R @ e) if k else (z, left, R @ e)
            omega, slope = random.normal(size=2)
            A = np.tensordot(random.dirichlet(np.full(len(F), 0.1)), F, 1)
            whole = np.zeros((2 * order + n + 2, 2 * order + n + 2))  # (z, what is left, e₀, ω, 1)
            at_e, at_w = slice(2 * order, 2 * order + n), 2 * order + n
            whole[:order, :order] = whole[order : 2 * order, order : 2 * order] = A
            whole[:n, at_w] = whole[at_e, at_w] = B[:, 0]
            whole[n + m + N : order, at_w] = (R @ B)[:, 0]
            g, h = A @ nominal.held.floats + nominal.between.floats, A @ moved.held.floats
            whole[order : 2 * order, at_e] = (g + h) @ R
            whole[order : 2 * order, -1] = -(h @ p)
            whole[at_e, at_e], whole[at_e, -1], whole[at_w, -1] = A0, B @ held, slope
            z, left, e = np.split((expm(whole * dt) @ [*z, *left, *e, omega, 1.0])[:-2], [order, 2 * order])
            known = np.concatenate([e, held, np.zeros(N), R @ e - p])
            assert z == pytest.approx(left + known, abs=1e-10)
            assert np.abs(z).max() > 1e-4
            assert np.abs(left).max() > 1e-6


@pytest.mark.parametrize(("seed", "delay"), [(0, 0), (1, 0), (2, 2)])
def test_where_time_is_not_that_of_the_program_what_acts_makes_up_for_it(
    seed: int, delay: int, friction: tuple[Spec, ProvedController]
) -> None:
    """At a time τ of the program it is t: of any states and x_n = x_d + e₀ at both, z' and a tick are as it is said.

    z is that of x − x_n(t), of what was predicted less x_n(τ), and of inputs less those of the nominal loop at τ.
    """
    plain, random = the_bounds(friction[1]).errors, np.random.default_rng(seed)
    h = plain.gains.sample_time
    errors = replace(plain, gains=replace(plain.gains, jitter=0.3 * h, delay=delay))
    plant, d, R, A0 = errors.plant, errors.predicted, errors.R.floats, errors.mean.floats
    (n, m), q = plant.B.shape, len(R)
    at = [int(np.flatnonzero(row == 1)[0]) for row in R]

    def law(x: Array) -> tuple[Array, Array]:
        i = plant.partition.locate(x)
        return plant.A[i], plant.b[i]

    def f(x: Array) -> Array:
        A, b = law(x)
        return np.asarray(A @ x + b)

    def mean(x: Array, other: Array) -> Array:
        """Return the A with f(other) − f(x) = A (other − x): planes are crossed by lines at known places."""
        H, offset = plant.partition.H, plant.partition.h
        with np.errstate(all="ignore"):
            cut = -(H @ x + offset) / (H @ (other - x))
        places = np.unique([0.0, 1.0, *cut[(cut > 0) & (cut < 1)]])
        middles = (places[1:] + places[:-1]) / 2
        return np.asarray(sum(w * law(x + s * (other - x))[0] for w, s in zip(np.diff(places), middles, strict=True)))

    for _ in range(20):
        pace, nu = random.uniform(0.7, 1.3), random.normal(size=m)
        (x_d, d_t), (e0, e_t), (u, u_t) = (random.normal(size=(2, size)) for size in (n, n, m))
        x = np.asarray(random.normal(size=n))
        seen, begins = random.normal(size=(2, d, n))
        moved: Array = random.normal(size=q)
        e, Delta = x - d_t - e_t, seen - x_d - e0 - (x - d_t - e_t)
        rho = (seen - begins) @ R.T - moved
        z = np.concatenate([e, nu, Delta.ravel(), rho.ravel()])
        # by what each is
        rate, rate_t = f(x_d) + A0 @ e0 + plant.B @ u, f(d_t) + A0 @ e_t + plant.B @ u_t
        e_rate = pace * (f(x) + plant.B @ (u + nu) - rate_t)
        Delta_rate = np.array([law(p)[0] @ s + law(p)[1] for p, s in zip(begins, seen, strict=True)])
        Delta_rate = Delta_rate + plant.B @ (u + nu) - rate - e_rate
        wanted = np.concatenate([e_rate, 0 * nu, Delta_rate.ravel(), ((Delta_rate + e_rate) @ R.T).ravel()])
        # by what is said
        F = np.zeros((len(z), len(z)))
        F[:n, :n], F[:n, n : n + m] = mean(d_t, x), plant.B
        for i in range(d):
            own, place = slice(n + m + i * n, n + m + (i + 1) * n), n + m + d * n + i * q
            F[own, : n + m], F[own, own] = (1 - pace) * F[:n, : n + m], mean(x, seen[i])
            F[own, place : place + q] = (law(begins[i])[0] - mean(begins[i], seen[i]))[:, at]
            F[place : place + q] = R @ (F[:n] + F[own] - (1 - pace) * F[:n])
        F[:n] *= pace

        def added(kind: Any, k: int, size: float, F: Array = F) -> Array:
            drive = driven(errors, (kind, k))
            return np.asarray(F @ drive.held.floats + drive.between.floats)[:, 0] * size

        found = F @ z
        for k in range(q):
            size = float(R[k] @ e_t)
            found += (
                added("nominal", k, size) + added("nominal", q + k, (1 - pace) * size) + added("moved", k, moved[k])
            )
        for k in range(m):
            found += added("swap", k, u[k] - u_t[k])
        for i in range(d):
            A_j = mean(x, seen[i])
            off = (mean(x_d, d_t) - A_j) @ (d_t - x_d) + (A0 - A_j) @ (e_t - e0)
            for k in range(n):
                found += added("predicted", i * n + k, off[k])
        assert wanted == pytest.approx(found, abs=1e-9)
        # and at a tick what is measured is that of t
        K, M, away = errors.gains.K, errors.gains.M, d_t + e_t - x_d - e0
        after = seen[0] + M @ plant.C @ (seen[0] - x)
        nu = K @ ((seen[-1] if delay else after) - x_d - e0)
        others = [after, *seen[: d - 1]]
        wanted = np.concatenate([e, nu, np.ravel([one - x_d - e0 - e for one in others]), np.zeros(d * q)])
        noise = np.hstack([driven(errors, ("noise", k)).ticks[0].floats for k in range(len(plant.C))])  # type: ignore[index]
        assert wanted == pytest.approx(errors.ticks[0].floats @ z - noise @ plant.C @ away, abs=1e-9)


@pytest.mark.slow
def test_bounds_where_ticks_come_early_and_late(tmp_path: Path) -> None:
    """Those of a jitter of nearly 0 are those of none, and of more they are more; the auditor has it too."""
    ends = list[float]()
    for h, jitter in ((0.05, 0), (0.05, 1e-9), (0.05, 0.002), (0.005, 0.0002)):
        sampling = f"{{nominal: {h}, jitter: {jitter}}}" if jitter else f"{h}"
        text = FRICTION.replace("{sample_time: 0.1}", f"{{sample_time: {sampling}}}")
        (tmp_path / "plant.yaml").write_text(text, encoding="utf-8")
        spec = load_spec(tmp_path / "plant.yaml")
        controller = design(spec)
        claim = the_bounds(controller)
        late = {"noise", "predicted", "swap"} if jitter else set()
        assert {kind for kind, _ in tubes_alone(claim)} - {"start"} == {"nominal", "moved"} | late
        assert not audit(json.dumps(design_certificate(spec, controller)))[1]
        ends.append(claim.ends_below(controller)["output", 0])
    assert ends[1] == pytest.approx(ends[0], rel=0.1)
    assert 7 * ends[0] > ends[2] > 1.2 * ends[0]
    assert ends[3] < 0.15 * ends[2], "what the same share of a shorter sample leaves is less"


def off_times(way: str, ticks: int, theta: float, seed: int) -> Array:
    """By how much ticks are off their times, in s; the first is not."""
    random, k = np.random.default_rng(seed), np.arange(ticks)
    found = {
        "in turn": (-1.0) ** k,
        "anywhere": random.uniform(-1, 1, size=ticks),
        "at an end": random.choice([-1.0, 1.0], size=ticks),
        "with the reference": np.sign(np.sin(4 * 0.05 * k + seed)),
    }[way]
    return np.concatenate([[0.0], found[1:]]) * theta


@pytest.mark.slow
@pytest.mark.parametrize("way", ["in turn", "anywhere", "at an end", "with the reference"])
@pytest.mark.parametrize("delay", [0, 1])
def test_no_run_whose_ticks_are_off_their_times_is_above_its_bounds(way: str, delay: int, tmp_path: Path) -> None:
    """The program beside the plant, which is integrated for as long as ticks happen to be apart."""
    h, jitter = 0.05, 0.005
    sampling = f"{{sample_time: {{nominal: {h}, jitter: {jitter}}}, delay: {delay}}}"
    (tmp_path / "plant.yaml").write_text(FRICTION.replace("{sample_time: 0.1}", sampling), encoding="utf-8")
    spec = load_spec(tmp_path / "plant.yaml")
    controller = design(spec)
    claim, plant = the_bounds(controller), controller.plant
    conditions = replace(spec.scenario.conditions, sampling=Sampling(sample_time=h, jitter=jitter, delay=delay))
    runs = Plain(program(controller, conditions), np.zeros(2), np.zeros(0))
    x, count, fine = np.zeros(2), int(spec.scenario.duration / h), 20
    away = off_times(way, count + 1, jitter / 2, seed=3)
    t = h * np.arange(count + 1) + away
    most, ends = 0.0, 0.0
    for k in range(count):
        runs.step(plant.C @ x)
        held, step = np.array(runs.state["u"], dtype=float), (t[k + 1] - t[k]) / fine
        for j in range(fine):
            off = abs(x[0] - 0.3 * np.sin(4 * (t[k] + j * step)))
            most, ends = max(most, off), max(ends, off * (k >= 0.9 * count))
            x = integrated(plant, x, plant.B @ held, step)
    below = claim.ends_below(controller)["output", 0]
    assert 0 < ends <= below
    if not delay:
        assert most <= claim.from_start["output", 0].max()
        run = simulate(spec, controller)
        found, band = np.abs(run.response.tracking_error[:, 0]), run.bands["output", 0]
        assert (found <= band).all()
        assert band.max() <= claim.from_start["output", 0].max() < 3 * most


RESTING = """
name: A mass at rest on a spring, with friction
system:
  states: [x, v]
  inputs: [u]
  outputs: [y]
  A: [[0, 1], [0, -2]]
  B: [[0], [1]]
  C: [[1, 0]]
  nonlinearities:
    - {name: spring, kind: spring, of: x, into: {v: -1}, start: 0.2, slope: 50}
    - {name: friction, kind: saturation, of: v, into: {v: -1}, lower: -0.4, upper: 0.4, slope: 20}
reference:
  output: {y: {constant: 0.3}}
simulation:
  duration: 2
  sample_time: 0.01
  controller: {sample_time: 0.001}
"""


def test_of_what_is_rounding_alone_a_share_of_its_size_is_told(tmp_path: Path) -> None:
    """v_d is 0 but for rounding, which is another one on another processor."""
    (tmp_path / "plant.yaml").write_text(RESTING, encoding="utf-8")
    spec = load_spec(tmp_path / "plant.yaml")
    controller = design(spec)
    claim = controller.claim(SampledBounds)
    told = claim.figures(spec.words, controller)["sampled_bounds"]["acts"]
    moved = told["v off its reference in the mean cell"]["at_most"]
    assert np.sqrt(claim.acts.squares["nominal", 1].max()) < 1e-12
    assert moved == pytest.approx(1e-9 * controller.sizes.state[1], rel=1e-3)


LINEAR = re.sub(r"(?s)  cells:.*?reference", "  A: [[0, 1], [0, -0.5]]\nreference", FRICTION)


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_of_a_plant_with_one_cell_the_bound_is_what_the_run_shows(delay: int, tmp_path: Path) -> None:
    text = LINEAR.replace("sample_time: 0.1}", f"sample_time: 0.1, delay: {delay}}}")
    (tmp_path / "plant.yaml").write_text(text, encoding="utf-8")
    spec = load_spec(tmp_path / "plant.yaml")
    controller = design(spec)
    claim = the_bounds(controller)
    assert not {kind for kind, _ in claim.covered} - {"start"}
    assert claim.ends_below(controller)["output", 0] == pytest.approx(simulate(spec, controller).final_error, rel=0.02)
    assert claim.ends_below(controller)["estimate", 0] == 0


@pytest.mark.slow
@pytest.mark.parametrize("delay", [1, 2])
def test_bounds_where_inputs_are_late_hold_for_switchings_and_in_the_run(delay: int, tmp_path: Path) -> None:
    text = FRICTION.replace(
        "sample_time: 0.1}", f"sample_time: 0.05, delay: {delay}}}\n  quantum: {{y: 1e-4, u: 0.01}}"
    )
    (tmp_path / "plant.yaml").write_text(text, encoding="utf-8")
    spec = load_spec(tmp_path / "plant.yaml")
    controller = design(spec)
    claim = the_bounds(controller)
    assert {kind for kind, _ in tubes_alone(claim)} == {"noise", "input", "nominal", "moved", "start"}
    for channel, each in tubes_alone(claim).items():
        for form in (("output", 0), ("input", 0)):
            c = row(claim.errors, form).floats
            for one in each:
                size = one.sizes[claim.forms.index(form)]
                assert max(worst_found(claim, channel, c, seed, summed=one.summed) for seed in range(3)) <= size
    assert not audit(json.dumps(design_certificate(spec, controller)))[1]
    run, ends = simulate(spec, controller), claim.ends_below(controller)["output", 0]
    at = (run.response.t * claim.errors.gains.substeps / 0.05 + 1e-9).astype(int)
    off, most = np.abs(run.response.tracking_error[:, 0]), claim.from_start["output", 0][at]
    assert 0.02 * ends < run.final_error <= ends
    assert (off <= most * (1 + 1e-6)).all()
    assert off[5 * delay - 1] > 0.5 * most[5 * delay - 1]  # no input acts, which is known


def test_nothing_moves_where_no_plane_is_near(sampled: tuple[Spec, ProvedController]) -> None:
    claim = the_bounds(sampled[1])
    far, at = (replace(claim.acts, near=np.full_like(claim.acts.near, each)) for each in (1e9, 0.0))
    still = {channel: each for channel, each in claim.acts.squares.items() if channel[0] != "moved"}
    tubes = tuple(each for each in claim.tubes if ("moved", 0) not in each[0])
    without = replace(claim, acts=replace(claim.acts, squares=still), tubes=tubes)
    for form in claim.forms:
        assert replace(claim, acts=far).from_zero[form] == pytest.approx(without.anywhere[form])
        assert replace(claim, acts=at).from_zero[form] == pytest.approx(claim.anywhere[form])
        assert (claim.from_zero[form] <= claim.anywhere[form]).all()


@pytest.mark.parametrize("which", ["sampled", "friction"])
def test_a_run_from_the_reference_on_is_below_in_every_substep(which: str, request: pytest.FixtureRequest) -> None:
    spec, controller = request.getfixturevalue(which)
    claim = the_bounds(controller)
    x_d = fine_walk(spec, controller, {"sampled": [0.2, 0.0], "friction": []}[which], 1)[0][0, 0]
    initial = replace(spec.scenario.initial, plant=x_d, observer=x_d)
    response = simulate(replace(spec, scenario=replace(spec.scenario, initial=initial)), controller).response
    at = np.floor(response.t * claim.errors.parts / claim.errors.gains.sample_time).astype(int)
    seen = {"output": response.tracking_error, "input": response.u - response.u_ff}
    for form, most in claim.from_zero.items():
        if form[0] in seen:
            allowed = np.max([most[np.clip(at + k, 0, len(most) - 1)] for k in (-1, 0, 1)], axis=0)
            found = np.abs(seen[form[0]][:, form[1]])
            assert (found <= allowed * (1 + 1e-9)).all()
            assert found[len(found) // 2 :].max() > 0.02 * allowed.max()


@pytest.fixture(scope="module")
def content(sampled: tuple[Spec, ProvedController]) -> dict[str, Any]:
    return design_certificate(*sampled)


def test_tubes_are_in_the_certificate_and_read_again(
    sampled: tuple[Spec, ProvedController], content: dict[str, Any]
) -> None:
    spec, controller = sampled
    claim = the_bounds(controller)
    said, faults = audit(json.dumps(content))
    assert not faults
    assert "the sampled loop: what 5 disturbances, noises and inputs leave is proved" in said
    (told,) = SampledBounds.prove(controller, asking(spec, controller, claim.errors.gains), content)
    assert told.data(controller) == claim.data(controller)
    assert told.figures(spec.words, controller) == claim.figures(spec.words, controller)


def exchange(tubes: Any, one: str, other: str) -> None:
    """Say of each of two tubes that it is of the channel of the other."""
    first, second = (next(tube for tube in tubes if tube["acts"][0]["channel"][0] == kind) for kind in (one, other))
    first["acts"], second["acts"] = second["acts"], first["acts"]


FORGED: dict[str, Callable[[Any], Any]] = {
    "a smaller bound": lambda t: t[0]["signals"][0].__setitem__(2, "1e-9"),
    "another channel": lambda t: t[0]["acts"][0].update(channel=["disturbance", 0]),
    "a channel that there is not": lambda t: t[0]["acts"][0].update(channel=["disturbance", 9]),
    "one of another kind": lambda t: t[0]["acts"][0].update(channel=["start", 0]),
    "one twice": lambda t: t.append(t[0]),
    "another a": lambda t: t[0].update(a="3"),
    "summed where it is not": lambda t: t[0].update(summed=1),
    "what is summed as if it were not": lambda t: t.append(next(one for one in t if one["summed"]) | {"summed": 0}),
    "summed by halves": lambda t: t[0].update(summed=2),
    "no a": lambda t: t[0].update(a="0"),
    "a negative bound": lambda t: t[0]["signals"][0].__setitem__(2, "-9"),
    "a signal that there is not": lambda t: t[0]["signals"][0].__setitem__(1, 9),
    "knots that are missing": lambda t: t[0]["Q"].pop(),
    "knots in another order": lambda t: t[0]["Q"].reverse(),
    "no Q": lambda t: t[0].update(Q=[]),
    "a smaller Q": lambda t: t[0]["Q"].__setitem__(0, t[1]["Q"][0]),
    "b of 1": lambda t: t[[one["acts"][0]["channel"][0] for one in t].index("noise")].update(b="1"),
    "another b": lambda t: t[[one["acts"][0]["channel"][0] for one in t].index("noise")].update(b="0.5"),
    "steps for the nominal loop": lambda t: exchange(t, "input", "nominal"),
    "what moves for the nominal loop": lambda t: exchange(t, "moved", "nominal"),
    "a between ticks and b at them": lambda t: t[0].update(b="1e-9"),
    "of nothing": lambda t: t[0].update(acts=[]),
    "of a size of 0": lambda t: t[0]["acts"][0].update(size="0"),
    "of a larger size": lambda t: t[0]["acts"][0].update(size="1.1"),
    "at ticks and between": lambda t: t[0]["acts"].append({"channel": ["noise", 0], "size": "1e-9"}),
    "no b": lambda t: t[[one["acts"][0]["channel"][0] for one in t].index("noise")].update(b="0"),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", FORGED)
def test_a_forged_tube_is_refused(what: str, content: dict[str, Any]) -> None:
    forged = copy.deepcopy(content)
    FORGED[what](forged["sampled_bounds"])
    assert audit(json.dumps(forged))[1]


def test_tubes_of_two_starts_are_refused(content: dict[str, Any]) -> None:
    entries = copy.deepcopy(content["sampled_bounds"])
    tube_text.read(entries)
    (one,) = (each for each in entries if each["acts"][0]["channel"][0] == "start")
    other = copy.deepcopy(one)
    other["acts"][0]["start"][0] = "0.5"
    with pytest.raises(ValueError, match="different starts"):
        tube_text.read([*entries, other])


def test_a_run_above_its_bound_is_a_numerical_error(sampled: tuple[Spec, ProvedController]) -> None:
    spec, controller = sampled
    result = simulate(spec, controller)
    assert result.outcome.kind != "above its bound"
    claim = the_bounds(controller)
    assert result.final_error < claim.ends_below(controller)["output", 0]
    small = tuple(
        (of, tuple(replace(one, sizes=tuple(v * 1e-3 for v in one.sizes)) for one in each)) for of, each in claim.tubes
    )
    acts = replace(claim.acts, beside={})
    claims = tuple(replace(one, tubes=small, acts=acts) if one is claim else one for one in controller.claims)
    broken = simulate(spec, replace(controller, claims=claims))
    assert broken.outcome.kind == "above its bound"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "h"),
    [("two_mass_machine", "2e-3"), ("gallery/asymmetric_damper", "3e-5"), ("gallery/diode_ladder", "1e-6")],
)
def test_sampled_often_enough_bounds_are_those_in_continuous_time(name: str, h: str, specs: Path) -> None:
    """About 500 samples in a period of the fastest mode: of all that acts, on what is tracked."""
    spec = load_spec(specs / f"{name}.yaml")
    conditions = replace(spec.scenario.conditions, sampling=None, noise=None, quanta=None)
    spec = replace(spec, scenario=replace(spec.scenario, conditions=conditions))
    controller = design(spec)
    conditions = replace(conditions, sampling=Sampling(sample_time=float(h)))
    often = replace(spec, scenario=replace(spec.scenario, conditions=conditions, duration=500 * float(h)))
    asked = asked_of(often, None, controller)
    (loop,) = SampledLoop.prove(controller, asked)
    controller = replace(controller, claims=(*controller.claims, loop))
    (found,) = SampledBounds.prove(controller, replace(asked, acting=all_of_size_one))
    for bounds in controller.claim(SignalBounds).acting:
        if bounds.channel[0] in ("disturbance", "noise"):
            (of_sampled, *_) = tubes_alone(found)[bounds.channel]
            tracked = {form: bounds.sizes[form] for form in found.forms if form[0] == controller.tracking}
            for form, size in tracked.items():
                assert 0.9 * size < of_sampled.sizes[found.forms.index(form)] < 1.2 * size


@pytest.fixture(scope="module", params=["gear_with_backlash", "carriage_on_slack_rope"])
def merged(
    request: pytest.FixtureRequest, specs: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Spec, ProvedController]:
    """Plants whose exact tracking is refused: a play is merged in the design, in the first in the program too."""
    text = (specs / "gallery" / f"{request.param}.yaml").read_text(encoding="utf-8")
    path, h = tmp_path_factory.mktemp("merged") / "plant.yaml", 3e-3 if "gear" in request.param else 7e-4
    path.write_text(
        text.replace("simulation: {", f"simulation: {{controller: {{sample_time: {h}}}, "), encoding="utf-8"
    )
    spec = load_spec(path)
    return spec, design(spec)


def test_what_is_merged_acts_on_the_sampled_loop_as_large_as_it_is(merged: tuple[Spec, ProvedController]) -> None:
    _, controller = merged
    claim, (merge,) = the_bounds(controller), controller.claim(Practical).merges
    watched = controller.plant.watched is not None
    assert set(tubes_alone(claim)) - {("start", 0)} == {("deviation", 0)} | ({("moved", 0)} if watched else set())
    assert np.sqrt(claim.acts.squares["deviation", 0]) == pytest.approx(float(merge.largest), rel=1e-12)
    drive, (n, m, N, *_) = driven(claim.errors, ("deviation", 0)), claim.errors.widths
    column = merge.column.floats[:, 0]
    assert drive.between.floats[:n, 0] == pytest.approx(column)
    felt = np.zeros(N) if watched else -column  # where merged cells are predicted x̂ does not feel it
    assert drive.between.floats[n + m : n + m + N, 0] == pytest.approx(felt)
    assert drive.between.floats[n + m + N :, 0] == pytest.approx(claim.errors.R.floats @ (column + felt))
    for form in claim.forms:
        size = tubes_alone(claim)["deviation", 0][0].sizes[claim.forms.index(form)]
        worst = max(worst_found(claim, ("deviation", 0), row(claim.errors, form).floats, seed) for seed in range(3))
        assert (0.1 * size if form[0] == "output" else 0.0) < worst <= size


def test_a_run_of_the_true_plant_ends_within_the_bound_of_the_sampled_loop(
    merged: tuple[Spec, ProvedController],
) -> None:
    spec, controller = merged
    run, end = simulate(spec, controller), the_bounds(controller).ends_below(controller)["output", 0]
    assert run.outcome.kind == "within its bound"
    assert 0.02 * end < run.final_error <= end
    continuous = controller.claim(Practical).final["output", 0]
    assert continuous < end < 2 * continuous
    assert len(run.loop.flow.parts[1].cells) == len(controller.plant.model.cell_names)


def test_with_early_and_late_ticks_what_is_merged_is_in_the_proof_where_the_program_has_it_merged_too(
    merged: tuple[Spec, ProvedController],
) -> None:
    """Else it would act on the observer's error by how much later a tick is: that is refused, by the auditor too."""
    spec, controller = merged
    gains, conditions = the_bounds(controller).errors.gains, spec.scenario.conditions
    sampling = Sampling(sample_time=gains.sample_time, jitter=0.02 * gains.sample_time)
    late = replace(spec, scenario=replace(spec.scenario, conditions=replace(conditions, sampling=sampling)))
    found = design(late)
    claim = found.claim(SampledLoop)
    if controller.plant.watched is None:
        assert claim.proof is not None
        bounds = the_bounds(found)
        assert np.sqrt(bounds.acts.squares["deviation", 0].max()) == pytest.approx(
            1.02 * float(found.claim(Practical).merges[0].largest)
        )
        assert not audit(json.dumps(design_certificate(late, found)))[1]
    else:
        assert claim.missing == "ticks come early and late, and the program runs cells that are merged in the design"
        content = json.loads(json.dumps(design_certificate(spec, controller)))
        content["sampled"]["jitter"] = "0.0001"
        said, faults = audit(json.dumps(content))
        assert (said, faults) == ([], ["what is merged acts otherwise where ticks come early and late"])


def test_what_is_merged_is_in_the_certificate_of_the_sampled_loop(merged: tuple[Spec, ProvedController]) -> None:
    spec, controller = merged
    content = json.loads(json.dumps(design_certificate(spec, controller)))
    said, faults = audit(json.dumps(content))
    assert not faults
    channels = len({*tubes_alone(the_bounds(controller))} - {("start", 0)})
    assert f"the sampled loop: what {channels} disturbances, noises and inputs leave is proved" in said
    (told,) = SampledBounds.prove(controller, asking(spec, controller, the_bounds(controller).errors.gains), content)
    assert told.data(controller) == the_bounds(controller).data(controller)
    number = [entry["acts"][0]["channel"][0] for entry in content["sampled_bounds"]].index("deviation")
    for forged in (["deviation", 1], ["disturbance", 0]):
        other = copy.deepcopy(content)
        other["sampled_bounds"][number]["acts"][0]["channel"] = forged
        assert audit(json.dumps(other))[1]
    runs = {"all cells": "merged cells", "merged cells": "all cells"}
    content["practical"]["observer_runs"] = runs[content["practical"]["observer_runs"]]
    assert audit(json.dumps(content))[1]


def test_where_nothing_acts_but_sampling_a_bound_above_what_is_required_is_said_so(tmp_path: Path) -> None:
    path = tmp_path / "friction.yaml"
    path.write_text(FRICTION + "require:\n  final_errors: {y: 1e-6}\n", encoding="utf-8")
    said = " ".join(call("design", path, "--out", tmp_path / "out").stdout.split())
    assert "warning sampled loop: no better than |y − y_d| ≤" in said
    assert "most by sampling" in said


JITTERY = """
name: Measured at ticks that come early or late
system:
  states: [x]
  inputs: [u]
  outputs: [y]
  A: [[-1]]
  B: [[1]]
  C: [[1]]
reference: {output: {constant: 0}}
simulation:
  duration: 2
  sample_time: 0.01
  controller: {sample_time: 0.1}
  noise: {std: {y: 0.1}, sample_time: 0.1, seed: 3}
  disturbance: {x: {step: {size: 1, at: 1, smooth: 0.1}}}
"""


def test_with_jitter_a_tick_counts_what_is_there_up_to_half_of_it_before_or_after(tmp_path: Path) -> None:
    """A tick that is early reads the noise of the one before, and sees a step so much later."""
    path, found = tmp_path / "plant.yaml", list[SampledBounds]()
    for sample_time in ("0.1", "{nominal: 0.1, jitter: 0.001}"):
        path.write_text(JITTERY.replace("{sample_time: 0.1}", f"{{sample_time: {sample_time}}}"), encoding="utf-8")
        found.append(the_bounds(design(load_spec(path))))
    exact, jittery = (bounds.acts.squares for bounds in found)
    parts = found[0].errors.gains.substeps
    channels: list[Channel] = [("noise", 0), ("disturbance", 0)]
    for channel in channels:
        own = exact[channel][::parts] if parts > 1 else exact[channel]
        before = np.maximum(own, np.append(own[0], own[:-1]))
        assert (jittery[channel][::parts] >= before * (1 - 1e-12)).all()
    assert (exact["noise", 0][1:] < exact["noise", 0][:-1]).any()


def test_the_end_of_a_run_holds_a_period_of_the_reference(friction: tuple[Spec, ProvedController]) -> None:
    _, controller = friction
    bounds = the_bounds(controller)
    step = bounds.errors.gains.sample_time / bounds.errors.gains.substeps
    for form, end in bounds.ends_below(controller).items():
        most = bounds.from_zero[form]
        assert end == pytest.approx(most[-int(np.pi / 2 / step) :].max(), rel=1e-3)
        assert end >= most[len(most) - int(np.pi / 2 / step) :].max()


STOPS = """
name: A cart between two stops of different stiffness
parameters: {T: SECONDS}
system:
  states: [z, v]
  inputs: [u]
  outputs: [y]
  A: [[0, 1/T], [0, -1/T]]
  B: [[0], [1/T]]
  C: [[1, 0]]
  nonlinearities:
    - {name: stops, kind: stop, of: z, lower: -0.1, upper: 0.1, lower_slope: 20/T, upper_slope: 50/T, into: {v: -1}}
reference: {output: {sine: {amplitude: 0.15, frequency: 1/T}}}
simulation: {duration: 4*T, sample_time: 0.01*T, initial: {plant: steady}, controller: {sample_time: 0.01*T}}
"""


@pytest.fixture(scope="module")
def of_stops(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Spec, ProvedController]]:
    """A plant whose cells have three slopes, in three units of time."""
    found = list[tuple[Spec, ProvedController]]()
    for seconds in ("1", "1e-5", "1e7"):
        path = tmp_path_factory.mktemp("stops") / "plant.yaml"
        path.write_text(STOPS.replace("SECONDS", seconds), encoding="utf-8")
        spec = load_spec(path)
        found.append((spec, design(spec)))
    return found


def test_a_slope_between_two_others_moves_the_mean_of_neither_half(
    of_stops: list[tuple[Spec, ProvedController]],
) -> None:
    spec, controller = of_stops[0]
    assert set(tubes_alone(the_bounds(controller))) == {("nominal", 0), ("moved", 0), ("start", 0)}
    assert audit(json.dumps(design_certificate(spec, controller)))[1] == []


def test_units_of_time_change_no_tube(of_stops: list[tuple[Spec, ProvedController]]) -> None:
    one, *others = (tubes_alone(the_bounds(controller)) for _, controller in of_stops)
    for other in others:
        assert other.keys() == one.keys()
        for channel, each in one.items():
            assert [tube.sizes[0] for tube in other[channel] if not tube.summed] == pytest.approx(
                [tube.sizes[0] for tube in each if not tube.summed], rel=1e-3
            )


def test_the_band_of_a_sampled_run_is_that_of_its_tubes(tmp_path: Path) -> None:
    """From another start, with noise: every error of the run is within it, and it ends at what acts leaves."""
    path = tmp_path / "plant.yaml"
    more = "initial: {plant: [0.05, 0]}, noise: {std: {y: 1e-4}, sample_time: 0.01}, controller"
    text = STOPS.replace("SECONDS", "1").replace("initial: {plant: steady}, controller", more)
    path.write_text(text, encoding="utf-8")
    result = simulate(load_spec(path))
    bands, response, n = result.bands, result.response, 2
    assert bands.keys() == set(the_bounds(result.controller).anywhere)
    assert (np.abs(response.tracking_error[:, 0]) <= bands["output", 0]).all()
    assert (np.abs(response.x_hat - response.x) <= np.array([bands["estimate", k] for k in range(n)]).T).all()
    assert bands["output", 0].max() > 1.5 * bands["output", 0][-1]
    assert bands["output", 0][0] >= 0.05
    claim = the_bounds(result.controller)
    assert bands["output", 0].max() <= claim.from_start["output", 0].max(), "what is said is what is drawn"
    own = start_of_errors(result.loop, response)
    assert [is_start(claim.errors, share * own, claim.noise) for share in (1, -1, 0.5, 1.01)] == [
        True,
        True,
        True,
        False,
    ]
    assert not is_start(claim.errors, own + np.eye(2 * n)[n] * 1e-3, claim.noise), "another estimate is another start"
    tubes = tuple((of, each) for of, each in claim.tubes if not any(kind == "start" for kind, _ in of))
    without = replace(claim, tubes=tubes)
    seen = Seen(t=response.t, start=own, acting={}, designed=False, w=None, sampled=True)
    assert (without.allows(result.controller, seen)["output", 0] >= bands["output", 0]).all()
    scenario = result.spec.scenario
    finer = replace(result.spec, scenario=replace(scenario, sample_time=scenario.sample_time / 4))
    between = simulate(finer, result.controller)  # there x̂ is what it was at the tick, and no estimate
    assert between.bands.keys() == {form for form in bands if form[0] != "estimate"}
