"""Plant, controller and closed loop as systems of python-control, with the names of their signals.

What python-control has no field for is in `params` of a system: `units`, by signal, and `start`, its state at t = 0.
"""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pwatrack.arrays import Array
from pwatrack.control.controller import ProvedController
from pwatrack.control.program import SampledController, on_estimates
from pwatrack.errors import InvalidSpec
from pwatrack.simulation.controller_arrays import cell, memory, routine


def plant_system(controller: ProvedController, name: str, units: Mapping[str, str], start: Sequence[float]) -> Any:
    """Return the plant (1): from its inputs, and the loads that are estimated, to what is measured and tracked.

    The name is that of the system, the units are of its signals, and it starts from x(0), (n,). Raises InvalidSpec if
    python-control is not installed.
    """
    plant, loads = controller.running, controller.plant.loads
    m, A, b, B, H, h = plant.B.shape[1], plant.A, plant.b, plant.B, plant.partition.H, plant.partition.h
    E = np.zeros((len(B), 0)) if loads is None else loads.E.floats[:, list(loads.where)]
    names = dict(zip([*plant.outputs, *plant.tracked_names], np.vstack([plant.C, plant.tracked]), strict=True))
    C = np.array(list(names.values()))

    def rate(_: float, x: Array, u: Array, __: Any) -> Array:
        i = cell(plant.partition.signs, H @ x + h)
        return np.asarray(A[i] @ x + b[i] + B @ u[:m] + E @ u[m:])

    def output(_: float, x: Array, *__: Any) -> Array:
        return np.asarray(C @ x)

    inputs = [*plant.inputs, *(() if loads is None else loads.names)]
    return _system(rate, output, units, start, name=name, inputs=inputs, outputs=list(names), states=list(plant.states))


def controller_system(controller: ProvedController, name: str, units: Mapping[str, str], start: Sequence[float]) -> Any:
    """Return observer (18), generator (15) and law (19) in continuous time, as they are proved: without any limit.

    It goes from what is measured to u, x̂ and x_d. The reference is made inside, of t. Args and raises: as
    `plant_system`; `start` is (x̂, ŝ, η̂)(0).
    """
    plant, L, K, trajectory = controller.plant, controller.design.L, controller.design.K, controller.trajectory
    added, (n, N, p) = controller.compensation, (len(plant.B), len(L), len(trajectory.names))
    model = plant.model  # its cells are more than those of x_d where cells are merged
    A, C = np.array([matrix.floats for matrix in plant.observed.A]), plant.observed.C.floats

    guards, generator = on_estimates(trajectory.guards, added.guards), on_estimates(trajectory.rate, added.rate)
    x_d, u_ff = on_estimates(trajectory.x_d, added.X.floats), on_estimates(trajectory.u_ff, added.u_ff)

    @lru_cache(maxsize=8)
    def reference(t: float) -> Array:
        return np.asarray(trajectory.exosystem.states(np.array([t]))[0])

    def wanted(t: float, z: Array) -> tuple[Array, Array, Array]:
        s = np.concatenate([z[n:], reference(float(t)), [1.0]])
        j = cell(trajectory.signs, guards @ s)
        desired = x_d[j] @ s
        return K @ (z[:n] - desired) + u_ff[j] @ s, desired, generator[j] @ s

    def rate(t: float, z: Array, y: Array, _: Any) -> Array:
        u, _, eta = wanted(t, z)
        i = cell(model.partition.signs, model.partition.H @ z[:n] + model.partition.h)
        observed = A[i] @ z[:N] + L @ (C @ z[:N] - y)
        observed[:n] += model.b[i] + plant.B @ u
        return np.concatenate([observed, eta])

    def output(t: float, z: Array, _: Array, __: Any) -> Array:
        u, desired, _ = wanted(t, z)
        return np.concatenate([u, z[:n], desired])

    hats = [f"{state}_hat" for state in plant.states]
    outputs = [*plant.inputs, *hats, *(f"{state}_d" for state in plant.states)]
    states = [*hats, *(f"s_hat_{k}" for k in range(N - n)), *(f"eta_hat_{k}" for k in range(p))]
    return _system(rate, output, units, start, name=name, inputs=list(plant.outputs), outputs=outputs, states=states)


def loop_system(plant: Any, controller: Any, name: str) -> Any:
    """Return a plant and its controller connected by names; inputs are loads that are estimated."""
    control = _control()
    free = [label for label in plant.input_labels if label not in controller.output_labels]
    outputs = list(dict.fromkeys([*plant.output_labels, *controller.output_labels]))
    params = plant.params | {"start": [*plant.params["start"], *controller.params["start"]]}
    return control.interconnect([plant, controller], inputs=free, outputs=outputs, name=name, params=params)


def sampled_system(
    program: SampledController, started: tuple[ArrayLike, ArrayLike], real: Any, units: Mapping[str, str], **labels: Any
) -> Any:
    """Return a controller that is sampled, in discrete time: from what is measured to u, and in every bit what runs.

    Its state is that of the program, and 1. All 0 is what python-control begins with where no state is given: no
    program is in that state, and the system starts as `params["start"]` says.

    It starts from x̂ with ŝ, and η̂; a reference that is given is an input too. `real` is the type of its floats;
    `labels` are `name`, `inputs` and `outputs`. Raises as `plant_system`.
    """
    table, q, at = routine(program, real), program.sizes["q"], program.places
    first = memory(program, *started, real)
    size = len(first["memory"])
    start = np.array([*first["memory"].tolist(), *first["counts"][0].tolist(), 1.0])

    def ticked(z: Array, v: Array) -> tuple[Array, Any]:
        from pwatrack.simulation.kernel import tick

        z = z if z.any() else start
        if z[-1] != 1:
            raise ValueError("the last entry of a state is 1, as in params['start']: change what is before it")
        kept = memory(program, *started, real)
        kept["memory"][:], kept["counts"][0] = z[:size], tuple(z[size:-1].astype(np.int64))
        tick(table, **kept, y=v[:q].astype(real), given=v[q:].astype(real))
        return kept["memory"], kept["counts"][0].tolist()

    def after(_: float, z: Array, v: Array, __: Any) -> Array:
        numbers, counts = ticked(z, v)
        return np.array([*numbers, *counts, 1.0], dtype=np.float64)

    def output(_: float, z: Array, v: Array, __: Any) -> Array:
        return np.asarray(ticked(z, v)[0][at["u"]], dtype=np.float64)

    return _system(after, output, units, start.tolist(), states=len(start), dt=program.sampling.sample_time, **labels)


def _system(update: Any, output: Any, units: Mapping[str, str], start: Sequence[float], **labels: Any) -> Any:
    return _control().NonlinearIOSystem(update, output, params={"units": dict(units), "start": list(start)}, **labels)


def _control() -> Any:
    try:
        return import_module("control")
    except ImportError:
        message, hint = "to_control: the package control is not installed", "pip install 'pwatrack[control]'"
        raise InvalidSpec(message, hint=hint) from None
