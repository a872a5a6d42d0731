"""What the certificates promise, held against simulations; and what must not depend on how a plant is written."""

from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pwatrack import Partition, PWASystem, Result, design, load_spec, simulate
from pwatrack.arrays import Array, IntArray, readonly
from pwatrack.control.synthesis import synthesize
from pwatrack.errors import Infeasible
from pwatrack.simulation.closed_loop import ClosedLoop
from pwatrack.simulation.propagate import simulate_flow
from tests.plants import random_plant
from tests.promises import disturbed, gains_again, judge, random_loop, run, track


@pytest.mark.parametrize("seed", range(52))
def test_no_error_is_ever_above_what_the_proofs_promise(seed: int) -> None:
    """n ≤ 8, r = 1 … 4, up to 16 cells; and the error is below 1e-6 at the time that the proofs predict."""
    loop, x0 = random_loop(seed)
    promised = loop.controller.guarantees
    start = run(loop, x0, 1e-3, 1e-3)
    grid = np.linspace(0, 60 / promised.rate, 20_000)
    bound = promised.tracking_error(grid, start.x[0] - start.x_d[0], -start.x[0], output=True)
    predicted = float(grid[np.argmax(bound < 1e-6)])
    response = run(loop, x0, predicted, predicted / 500)
    assert abs(response.tracking_error[-1, 0]) < 1e-6
    verdict = judge(loop, response)
    assert max(verdict.output, verdict.state, verdict.observer, verdict.later) <= 1
    assert verdict.decay <= 1 + 1e-9
    assert verdict.opinions == pytest.approx((1, 1), rel=1e-5)


@pytest.mark.parametrize("path", ["two_mass_paper_gains", "gallery/two_driven_carts", "gallery/two_rooms"])
def test_the_same_of_the_paper_and_of_state_tracking_from_random_states(specs: Path, path: str) -> None:
    spec = load_spec(specs / f"{path}.yaml")
    controller = design(spec)
    n = spec.plant.A.shape[1]
    for seed in range(4):
        x0, x_hat0 = np.random.default_rng(seed).normal(size=(2, n))
        result = simulate(replace(spec, x0=x0, x_hat0=x_hat0), controller)
        verdict = judge(result.loop, result.response)
        assert max(verdict.output, verdict.state, verdict.observer, verdict.later) <= 1
        assert verdict.decay <= 1 + 1e-9
        assert verdict.opinions == pytest.approx((1, 1), rel=1e-5)
        size = np.linalg.norm(result.response.tracking_error, axis=1)
        assert result.tracking_bound is not None
        assert result.observer_bound is not None
        assert (size <= result.tracking_bound * (1 + 1e-9) + 1e-12).all()
        assert (result.response.observer_error <= result.observer_bound * (1 + 1e-9) + 1e-12).all()


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize(("w", "v"), [(1.0, 0.0), (0.0, 1.0)])
def test_no_disturbance_and_no_noise_does_more_than_the_gains_say(seed: int, w: float, v: float) -> None:
    loop, _ = random_loop(seed)
    gains = loop.controller.guarantees.gains
    assert list(astuple(gains)) == pytest.approx(gains_again(loop), rel=1e-5)
    fastest = float(
        np.abs(np.linalg.eigvals(loop.controller.plant.A + loop.controller.design.L @ loop.controller.plant.C)).max()
    )
    observer, tracking = disturbed(loop, w, v, duration=4.0, step=min(0.02, 0.2 / fastest))
    integration = 1e-6  # error of the integrator
    assert observer.max() <= w * gains.disturbance_to_observer + v * gains.noise_to_observer + integration
    assert tracking.max() <= w * gains.disturbance_to_tracking + v * gains.noise_to_tracking + integration
    assert observer.max() > 1e-3 * (w * gains.disturbance_to_observer + v * gains.noise_to_observer)


def test_a_second_proof_makes_the_paper_s_gains_robust_for_little_of_the_rate(paper: Result) -> None:
    promised = paper.controller.guarantees
    for best, second in (promised.controller, promised.observer):
        assert second.rate > 0.8 * best.rate
        assert second.overshoot < 1.5 < 4.5 < best.overshoot
        assert second.radius > 100 * best.radius
    assert promised.robust[1] > 1e-3


def test_changed_closed_loops_below_the_radius_decay_as_fast(paper: Result) -> None:
    """Of any change of the radius, that along P hurts most: E = radius · p pᵀ with p the long axis of P."""
    controller = paper.controller
    closed = controller.plant.A + controller.plant.B @ controller.design.K
    random = np.random.default_rng(0)
    for proof in (p for p in controller.proofs if p.of == "controller"):
        e = np.array(proof.exponents, dtype=float)
        P = np.array(proof.integers, dtype=float) * 2.0 ** (e[:, None] + e)
        axis = np.linalg.eigh(P)[1][:, -1:]
        changes = [axis @ axis.T] + [random.normal(size=(4, 4)) for _ in range(50)]
        for E in changes:
            M = closed + proof.radius * E / np.linalg.norm(E, 2)
            left = M @ P + P @ M.swapaxes(1, 2) + 2 * proof.rate * P
            assert np.linalg.eigvalsh(left).max() < 0


def changed(plant: PWASystem, T: Array, o: Array, cells: IntArray, speed: float) -> PWASystem:
    """The plant in z with x = T z + o, its cells in another order, time t' = t / speed."""
    inverse = np.linalg.inv(T)
    return PWASystem.create(
        partition=Partition.create(
            H=plant.partition.H @ T,
            h=plant.partition.h + plant.partition.H @ o,
            signs=plant.partition.signs[cells],
            names=[plant.cell_names[i] for i in cells],
        ),
        A=speed * (inverse @ plant.A @ T)[cells],
        b=speed * ((plant.b + plant.A @ o) @ inverse.T)[cells],
        B=speed * inverse @ plant.B,
        C=plant.C @ T,
    )


CHANGES = ["cells", "states", "affine", "state scales", "time"]


@pytest.mark.parametrize("change", CHANGES)
@given(seed=st.integers(0, 10_000))
@settings(deadline=None, max_examples=8, derandomize=True)
def test_neither_verdict_nor_output_depends_on_how_the_plant_is_written(change: str, seed: int) -> None:
    random = np.random.default_rng(seed)
    n, r = 4, 1 + seed % 3
    plant = random_plant(seed, n=n, k=2, r=r, strength=0.05)
    T, o, cells, speed = np.eye(n), np.zeros(n), np.arange(4, dtype=np.int64), 1.0
    if change == "cells":
        cells = random.permutation(4).astype(np.int64)
    elif change == "states":
        T = np.eye(n)[random.permutation(n)]
    elif change == "affine":
        T, o = random.normal(size=(n, n)) + 2 * np.eye(n), 0.1 * random.normal(size=n)
    elif change == "state scales":
        T = np.diag(10.0 ** random.uniform(-6, 6, size=n))
    else:
        speed = 10.0 ** random.uniform(-6, 6)
    other = changed(plant, T, o, cells, speed)
    y_shift = float((plant.C @ o)[0])  # y = C x = C T z + C o: the output must be the same signal
    loop = track(plant, "sin(2*t)")
    gains = loop.controller.design
    again = track(other, f"sin({2 * speed!r}*t) - ({y_shift!r})")  # designed afresh: still proved
    assert again.controller.generator is not None
    assert again.controller.generator.r == r
    same = track(
        other,
        f"sin({2 * speed!r}*t) - ({y_shift!r})",
        K=gains.K @ T,
        L=readonly(speed * np.linalg.solve(T, gains.L)),
    )
    x0 = random.normal(size=n)
    response = run(loop, x0, 10.0, 0.05)
    start_hat = readonly(np.linalg.solve(T, -o))
    p = same.controller.trajectory.rate.shape[1]
    eta0 = same.controller.trajectory.to_eta @ np.linalg.solve(T, _x_with_eta_zero(loop) - o)
    start = same.start(plant=readonly(np.linalg.solve(T, x0 - o)), observer=start_hat, generator=eta0[:p])
    trace = simulate_flow(same.flow, start, duration=10.0 / speed, sample_time=0.05 / speed)
    y = same.response(trace).y[:, 0] + y_shift
    assert y == pytest.approx(response.y[:, 0], abs=1e-8 * float(np.abs(response.y).max()))


@pytest.mark.parametrize("where", [0, 1])
def test_a_zero_mode_out_of_reach_or_out_of_sight_in_one_cell_is_refused(where: int) -> None:
    """x3 drifts freely in one cell only: nothing acts on it there, and for the transposed plant nothing shows it."""
    stiff = np.zeros(2)
    stiff[1 - where] = -2.0
    A = np.array([[[0, 1.0, 0], [-1, -1, 0], [0, 0, k]] for k in stiff])
    cells = Partition.create(H=[[0.0, 0, 1]], h=[0.0], signs=[[-1], [1]], names=["below", "above"])
    plant = PWASystem.create(partition=cells, A=A, b=np.zeros((2, 3)), B=[[0], [1], [0]], C=[[1.0, 0, 1]])
    with pytest.raises(Infeasible, match=f"no gain moves the eigenvalue 0 in cell '{cells.names[where]}'"):
        synthesize(plant)
    unseen = PWASystem.create(partition=cells, A=A, b=np.zeros((2, 3)), B=[[0], [1], [1]], C=[[1.0, 0, 0]])
    with pytest.raises(Infeasible, match=r"\(9\) is infeasible: no gain moves the eigenvalue 0 in cell"):
        synthesize(unseen)


def _x_with_eta_zero(loop: ClosedLoop) -> Array:
    """x_d(0) of a loop whose generator starts at 0."""
    n, p = len(loop.x_d), loop.controller.trajectory.rate.shape[1]
    result: Array = loop.x_d @ loop.start(plant=np.zeros(n), observer=np.zeros(n), generator=np.zeros(p))
    return result
