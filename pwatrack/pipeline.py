"""From a spec to its result, step by step as in Section IV of the paper. No input or output."""

from dataclasses import dataclass

import numpy as np

from pwatrack.arrays import Array
from pwatrack.control.controller import Controller
from pwatrack.control.generator import trajectory_generator
from pwatrack.control.synthesis import synthesize
from pwatrack.errors import InvalidSpec, Problem, Subject
from pwatrack.model.normal_form import normal_form
from pwatrack.simulation.closed_loop import ClosedLoop, Response, closed_loop
from pwatrack.simulation.propagate import simulate_flow
from pwatrack.simulation.steady_state import periodic_state
from pwatrack.simulation.trace import Trace
from pwatrack.spec.load import Spec


@dataclass(frozen=True, kw_only=True)
class Result:
    """A designed and simulated closed loop.

    Attributes:
        spec: What was asked.
        controller: Gains, generator and their proofs.
        loop: The closed loop.
        response: Its signals.
        steady_state: One period of the generator's steady state (η̂, w, 1), or None if y_d has no period.
    """

    spec: Spec
    controller: Controller
    loop: ClosedLoop
    response: Response
    steady_state: Trace | None

    @property
    def final_error(self) -> float:
        """The largest |y − y_d| in the last tenth of the simulation."""
        tail = -(-len(self.response.t) // 10)
        return float(np.abs(self.response.tracking_error[-tail:]).max())


def design(spec: Spec) -> Controller:
    """Find the gains and prove that the closed loop tracks: Theorem 3.

    Raises:
        OutsideTheory: If the plant is not of form (11).
        Infeasible: If (8), (9) or (17) is proved to have no solution.
        Undecided: If neither is proved.

    Example:
        >>> from pwatrack import load_spec
        >>> controller = design(load_spec("specs/two_mass_backlash.yaml"))
        >>> controller.generator.shift.round(12).tolist()
        [[1.0, 0.0], [0.0, 0.0]]
    """
    with spec.located():
        form = normal_form(spec.plant)
        generator = trajectory_generator(form, solver=spec.solver)  # (15)–(17)
        gains = synthesize(spec.plant, K=spec.K, L=spec.L, solver=spec.solver)  # (8), (9)
        return Controller(plant=spec.plant, design=gains, generator=generator)  # (18), (19)


def simulate(spec: Spec, controller: Controller | None = None) -> Result:
    """Run the closed loop exactly, from event to event.

    Args:
        spec: What to simulate.
        controller: What `design(spec)` returned; designed first if not given.

    Raises:
        PwatrackError: Whatever `design` raises, and InvalidSpec if the
            generator's initial state has the wrong length.
    """
    controller = controller or design(spec)
    with spec.located():
        loop = closed_loop(controller, spec.reference)
        n, order = spec.plant.A.shape[1], controller.generator.A_eta.shape[1]
        start = loop.start(
            plant=_initial(spec.x0, n, "plant"),
            observer=_initial(spec.x_hat0, n, "observer"),
            generator=_initial(spec.eta_hat0, order, "generator"),
        )
        trace = simulate_flow(loop.flow, start, duration=spec.duration, sample_time=spec.sample_time)
        period = spec.reference.period
        steady_state = None
        if period is not None and order:
            steady_state = periodic_state(loop.generator_flow(), start[loop.eta_hat.start :], free=order, period=period)
        return Result(
            spec=spec,
            controller=controller,
            loop=loop,
            response=loop.response(trace),
            steady_state=steady_state,
        )


def _initial(values: Array | None, length: int, part: str) -> Array:
    if values is None:
        return np.zeros(length)
    if len(values) != length:
        subject: Subject = ("simulation", "initial", part)
        raise InvalidSpec(
            Problem(
                message=f"simulation.initial.{part}: {len(values)} entries, expected {length}",
                subject=subject,
            )
        )
    return values
