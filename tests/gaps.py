"""Random plants with dead zones that are merged, and the worst reference and start that is found for each."""

from dataclasses import dataclass, replace

import numpy as np

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix
from pwatrack.claims.practical import Practical, deviation_bounds
from pwatrack.control.controller import ProvedController
from pwatrack.control.trajectory import output_trajectory
from pwatrack.model.nonlinearity import Nonlinearity, ScalarForm, dead_zone
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import exosystem
from pwatrack.model.signal import Signal
from pwatrack.model.simplification import merged, merges
from pwatrack.simulation.closed_loop import closed_loop
from pwatrack.spec.expression import formula
from tests.plants import random_plant
from tests.promises import FLOOR, run, track


def plant_with_gaps(seed: int) -> tuple[PWASystem, ScalarForm]:
    """n = 2 … 5, one or two dead zones that are no part of the output's derivatives once they are merged."""
    random = np.random.default_rng(7000 + seed)
    r = 1 + seed % 3
    n = int(random.integers(max(2, r), 6))
    smooth = random_plant(seed, n=n, k=0, r=r)
    A, elements = smooth.exact.A[0], []
    for k in range(1 + seed % 2):
        row, direction = np.round(random.normal(size=(2, n)), 3)
        direction *= random.uniform(0.2, 1.5)
        half = float(np.round(10 ** random.uniform(-2, -0.5), 4))
        gap = dead_zone(lower=-half, upper=half * float(random.choice([1.0, 2.0])))
        A = A - BallMatrix.of(direction[:, None]) @ BallMatrix.of(row[None])
        elements.append(
            Nonlinearity(name=f"gap {k + 1}", function=gap, row=row.tolist(), constant=0, direction=direction.tolist())
        )
    form = ScalarForm(A=A, b=smooth.exact.b[0], elements=tuple(elements))
    return merged(smooth, form, {}), form


def practical_controller(plant: PWASystem, form: ScalarForm, *, watched: bool = False) -> ProvedController:
    """The design for all gaps merged, with its bounds."""
    chosen = {k: merges(form, k)[0] for k in range(len(form.elements))}
    less = merged(plant, form, chosen)
    if watched:
        less = replace(less, watched=plant)
    controller = track(less, "sin(t)").controller
    columns = [merge.column for merge in chosen.values()]
    bounds = deviation_bounds(controller, columns)
    assert bounds is not None
    practical = Practical(plant=plant, merges=tuple(chosen.values()), replaced=(), evidence=None, bounds=bounds)
    return replace(controller, running=plant, claims=(practical,))


@dataclass(frozen=True, kw_only=True)
class Seen:
    """The worst of some simulations.

    Attributes:
        final: |y − y_d| in the last third over what is proved of it there: what it ends below, and the start's rest.
        part: |y − y_d| and |x̂ − x| at any sample over what is proved of them there.
    """

    final: float
    part: float


def simulated(controller: ProvedController, y_d: str, x0: Array, *, fastest: float) -> Seen:
    """Run the true plant."""
    assert controller.generator is not None
    assert controller.claims_of(Practical)
    trajectory = output_trajectory(controller.generator, exosystem([Signal.of(formula(y_d, {}))]))
    loop = closed_loop(replace(controller, trajectory=trajectory))
    duration = 18 / controller.guarantees.rate + 30 / fastest
    response = run(loop, x0, duration, duration / 1500)
    floor = 100 * FLOOR * max(1.0, float(np.abs(response.x).max()))
    start, observer = response.x[0] - response.x_d[0], response.x_hat[0] - response.x[0]
    errors = (
        (response.error_norm, controller.tracking_bound(response.t, start, observer)),
        (response.observer_error, controller.observer_bound(response.t, observer)),
    )
    late = len(response.t) * 2 // 3
    return Seen(
        final=float((errors[0][0][late:] / errors[0][1][late:]).max()),
        part=max(float((error / (bound + floor)).max()) for error, bound in errors),
    )


def worst_found(controller: ProvedController, seed: int, *, tries: int, steps: int) -> Seen:
    """Optimise amplitude, frequency and offset of the reference, and the start: at random, then about the best."""
    random = np.random.default_rng(9000 + seed)
    rate, n = controller.guarantees.rate, controller.plant.A.shape[1]

    def tried(amplitude: float, frequency: float, offset: float, x0: Array) -> Seen:
        y_d = f"{offset:.6g} + {amplitude:.6g}*sin({frequency:.6g}*t)"
        return simulated(controller, y_d, x0, fastest=frequency)

    best, part = -1.0, 0.0
    at: tuple[float, float, float, Array] | None = None
    x0: Array
    for k in range(tries + steps):
        if k < tries or at is None:
            amplitude, frequency = float(10 ** random.uniform(-2.5, 0.5)), float(rate * 10 ** random.uniform(-0.7, 1))
            offset = float(random.normal() * 10 ** random.uniform(-2, 0))
            x0 = np.asarray(random.normal(size=n))
        else:
            amplitude, frequency = at[0] * np.exp(0.3 * random.normal()), at[1] * np.exp(0.3 * random.normal())
            offset, x0 = at[2] + 0.2 * random.normal() * max(abs(at[2]), 0.02), at[3]
        seen = tried(amplitude, frequency, offset, x0)
        part = max(part, seen.part)
        if seen.final > best:
            best, at = seen.final, (amplitude, frequency, offset, x0)
    return Seen(final=best, part=part)
