"""What the certificates promise, held against simulations; and what must not depend on how a plant is written."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import sqrtm

from pwatrack import Controller, Partition, PWASystem
from pwatrack.arrays import Array, IntArray, readonly
from pwatrack.control.generator import trajectory_generator
from pwatrack.control.goal import Goal
from pwatrack.control.synthesis import synthesize
from pwatrack.control.trajectory import output_trajectory
from pwatrack.errors import Infeasible
from pwatrack.model.normal_form import normal_form
from pwatrack.model.reference import exosystem
from pwatrack.model.signal import Signal
from pwatrack.simulation.closed_loop import ClosedLoop, Response, closed_loop
from pwatrack.simulation.propagate import simulate_flow
from pwatrack.spec.expression import formula
from tests.plants import random_plant


def track(plant: PWASystem, y_d: str, K: Array | None = None, L: Array | None = None) -> ClosedLoop:
    generator = trajectory_generator(normal_form(plant))
    trajectory = output_trajectory(generator, exosystem([Signal.of(formula(y_d, {}))]))
    gains = synthesize(plant, controller=Goal(given=K), observer=Goal(given=None if L is None else L.T))
    return closed_loop(Controller(plant=plant, design=gains, trajectory=trajectory, generator=generator, proofs=()))


def run(loop: ClosedLoop, x0: Array, duration: float, sample_time: float) -> Response:
    n, p = len(x0), loop.controller.trajectory.rate.shape[1]
    start = loop.start(plant=x0, observer=np.zeros(n), generator=np.zeros(p))
    return loop.response(simulate_flow(loop.flow, start, duration=duration, sample_time=sample_time))


class Bound:
    """|y − y_d| from the certificates alone: the observer error drives the tracking error, both contract.

    With ‖e‖_c = √(eᵀ P_c⁻¹ e) and ‖ẽ‖_o = √(ẽᵀ P_o ẽ):  d‖ẽ‖_o/dt ≤ −α_o ‖ẽ‖_o and
    d‖e‖_c/dt ≤ −α_c ‖e‖_c + κ ‖ẽ‖_o, whatever the switching.
    """

    def __init__(self, loop: ClosedLoop, e0: Array, e_hat0: Array) -> None:
        plant, gains = loop.controller.plant, loop.controller.design
        root_c = np.real(sqrtm(np.linalg.inv(gains.controller.P)))
        root_o = np.real(sqrtm(gains.observer.P))
        self.kappa = float(np.linalg.norm(root_c @ plant.B @ gains.K @ np.linalg.inv(root_o), 2))
        self.output = float(np.linalg.norm(plant.C @ np.linalg.inv(root_c), 2))
        self.e0, self.e_hat0 = float(np.linalg.norm(root_c @ e0)), float(np.linalg.norm(root_o @ e_hat0))
        self.rates = gains.controller.rate, gains.observer.rate

    def __call__(self, t: Array) -> Array:
        slow, fast = min(self.rates), max(self.rates)
        gap = max(fast - slow, 1e-9)
        driven = np.exp(-slow * t) * -np.expm1(-gap * t) / gap
        result: Array = self.output * (np.exp(-self.rates[0] * t) * self.e0 + self.kappa * driven * self.e_hat0)
        return result


@pytest.mark.parametrize("seed", range(52))
def test_the_tracking_error_is_gone_when_the_rates_say_so(seed: int) -> None:
    """n ≤ 8, r = 1 … 4, up to 16 cells: below 1e-6 of the amplitude at the time that the proofs predict."""
    random = np.random.default_rng(1000 + seed)
    r = 1 + seed % 4
    n = int(random.integers(r, 9))
    k = int(random.integers(1, 5))
    loop = track(random_plant(seed, n=n, k=k, r=r, strength=0.05), "0.2 + sin(2*t) + 0.5*cos(3*t)")
    x0 = random.normal(size=n)
    x_d0 = loop.x_d @ loop.start(
        plant=x0, observer=np.zeros(n), generator=np.zeros(loop.controller.trajectory.rate.shape[1])
    )
    bound = Bound(loop, x0 - x_d0, x0)
    grid = np.linspace(0, 60 / min(bound.rates), 20_000)
    predicted = float(grid[np.argmax(bound(grid) < 1e-6)])
    response = run(loop, x0, predicted, predicted / 500)
    error = np.abs(response.tracking_error[:, 0])
    assert error[-1] < 1e-6
    rounding = 1e-12 * max(1.0, float(np.abs(response.x).max()))
    assert (error <= bound(response.t) * (1 + 1e-9) + rounding).all()


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
