"""What is said of a run between its samples, with limits, noise and ticks: against the same machine written by hand."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pwatrack import Result, load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.simulation.figures import Figures

CARTS = """
name: two carts with a stop between them
system:
  states: [p, v, q, w]
  inputs: [f, g]
  outputs: [y1, y2]
  sizes: {y1: 0.3, y2: 0.2}
  A: [[0, 1, 0, 0], [-4, -0.5, 0, 0], [0, 0, 0, 1], [0, 0, -1.5, -0.5]]
  B: [[0, 0], [1, 0], [0, 0], [0, 0.5]]
  C: [[1, 0, 0, 0], [0, 0, 1, 0]]
  nonlinearities: [{name: stop, kind: spring, of: p - q, start: 0.4, slope: 8, into: {v: -1, w: 0.5}}]
reference: {output: {y1: 0.3*sin(2*t), y2: 0.2*cos(3*t)}}
simulation:
  duration: 6.2
  sample_time: STEP
  initial: {plant: [0.5, 0, -0.4, 0]}
  disturbance: {v: {sine: {amplitude: 0.6, frequency: 9}}}
  CONDITIONS
"""
LIMITS = "actuator: {limits: {f: [-1.5, 1.6], g: [-4.2, 3.6]}}"
NOISE = "noise: {std: {y1: 0.02, y2: 0.01}, sample_time: 0.1, seed: 4}"
TICKS = "controller: {sample_time: 0.05}"
SIZES = np.array([0.3, 0.2])
LOW, HIGH = np.array([-1.5, -4.2]), np.array([1.6, 3.6])
BETWEEN = 400  # times that are looked at in each stretch


def force(x: Array) -> float:
    return 8 * max(0.0, float(x[0] - x[2]) - 0.4)


def motion(x: Array, u: Array) -> Array:
    F = force(x)
    rates = [x[1], -4 * x[0] - 0.5 * x[1] + u[0] - F, x[3], -1.5 * x[2] - 0.5 * x[3] + 0.5 * u[1] + 0.5 * F]
    return np.array(rates)


def desired(t: float) -> tuple[Array, Array]:
    """x_d and u_ff."""
    x = np.array([0.3 * np.sin(2 * t), 0.6 * np.cos(2 * t), 0.2 * np.cos(3 * t), -0.6 * np.sin(3 * t)])
    F, second = force(x), np.array([-1.2 * np.sin(2 * t), -1.8 * np.cos(3 * t)])
    f = second[0] + 0.5 * x[1] + 4 * x[0] + F
    return x, np.array([f, 2 * (second[1] + 1.5 * x[2] + 0.5 * x[3] - 0.5 * F)])


def pushed(t: float) -> Array:
    return np.array([0, 0.6 * np.sin(9 * t), 0, 0])


def run(folder: Path, step: float, *conditions: str) -> Result:
    path = folder / "carts.yaml"
    text = CARTS.replace("STEP", repr(step)).replace("CONDITIONS", "\n  ".join(conditions))
    path.write_text(text, encoding="utf-8")
    return simulate(load_spec(path))


def held(figures: Figures, t: Array, x: Array, u: Array, start: float) -> None:
    """Hold figures against signals at many times, (K, 4) and (K, 2); the last tenth begins at the start."""
    errors = np.abs(x[:, [0, 2]] - np.array([desired(s)[0][[0, 2]] for s in t]))
    norms, late = np.linalg.norm(errors / SIZES, axis=1), t >= start
    seen = {
        ("largest_error", ""): norms.max(),
        ("final_error", ""): norms[late].max(),
        **{("largest_errors", name): errors[:, k].max() for k, name in enumerate(("y1", "y2"))},
        **{("final_errors", name): errors[late, k].max() for k, name in enumerate(("y1", "y2"))},
        **{("largest_input", name): np.abs(u[:, k]).max() for k, name in enumerate(("f", "g"))},
    }
    assert not figures.sampled
    for (figure, name), size in seen.items():
        found = getattr(figures, figure)
        said = found[name] if name else found
        assert size * (1 - 1e-8) <= said <= size * (1 + 1e-4), (figure, name)


def walked(rhs: Any, z: Array, first: float, last: float) -> tuple[Array, Array]:
    t = np.linspace(first, last, BETWEEN)
    found = solve_ivp(rhs, (first, last), z, t_eval=t, method="DOP853", rtol=1e-11, atol=1e-12, max_step=0.01)
    return t, found.y.T


@pytest.mark.slow
@pytest.mark.parametrize("conditions", [(LIMITS,), (LIMITS, NOISE), (NOISE,)])
def test_a_run_is_nowhere_beyond_what_is_said_of_it(tmp_path: Path, conditions: tuple[str, ...]) -> None:
    coarse = run(tmp_path, 0.31, *conditions)
    K, L = coarse.controller.K, coarse.controller.L
    noisy = NOISE in conditions
    edges = np.append(np.arange(0, 6.15, 0.1), 6.2)
    drawn = np.random.default_rng(4).normal(size=(len(edges), 2)) * [0.02, 0.01] * noisy

    def put_out(t: float, x_hat: Array) -> Array:
        x_d, u_ff = desired(t)
        u = u_ff + K @ (x_hat - x_d)
        return np.asarray(np.clip(u, LOW, HIGH) if LIMITS in conditions else u)

    z, every = np.array([0.5, 0, -0.4, 0, *np.zeros(4)]), list[tuple[Array, Array, Array]]()
    for first, last, v in zip(edges[:-1], edges[1:], drawn, strict=False):

        def rhs(t: float, z: Array, v: Array = v) -> Array:
            x, x_hat = z[:4], z[4:]
            u = put_out(t, x_hat)
            return np.concatenate([motion(x, u) + pushed(t), motion(x_hat, u) + L @ (x_hat[[0, 2]] - x[[0, 2]] - v)])

        t, found = walked(rhs, z, first, last)
        every.append((t, found[:, :4], np.array([put_out(s, x_hat) for s, x_hat in zip(t, found[:, 4:], strict=True)])))
        z = found[-1]
    t, x, u = (np.concatenate(part) for part in zip(*every, strict=True))
    assert ((u == LOW) | (u == HIGH)).any() == (LIMITS in conditions)
    held(coarse.figures, t, x, u, 18 * 0.31)


@pytest.mark.slow
@pytest.mark.parametrize("conditions", [(TICKS,), (TICKS, LIMITS, NOISE)])
def test_between_ticks_a_run_is_nowhere_beyond_what_is_said_of_it(tmp_path: Path, conditions: tuple[str, ...]) -> None:
    """From tick to tick the input is held: what the plant does there is integrated by another method."""
    result = run(tmp_path, 0.05, *conditions)
    r, every = result.response, list[tuple[Array, Array, Array]]()
    x = r.x[0]
    for k in range(len(r.t) - 1):
        t, found = walked(lambda t, x, u=r.u[k]: motion(x, u) + pushed(t), x, float(r.t[k]), float(r.t[k + 1]))
        np.testing.assert_allclose(found[-1], r.x[k + 1], atol=1e-8)
        every.append((t, found, np.tile(r.u[k], (len(t), 1))))
        x = r.x[k + 1]
    every.append((r.t[-1:], r.x[-1:], r.u[-1:]))
    t, x, u = (np.concatenate(part) for part in zip(*every, strict=True))
    assert ((u == LOW) | (u == HIGH)).any() == (LIMITS in conditions)
    samples = len(r.t)
    held(result.figures, t, x, u, float(r.t[samples - -(-samples // 10)]))
    coarse = run(tmp_path, 0.31, *conditions).figures
    assert coarse.largest_error == pytest.approx(result.figures.largest_error, rel=1e-6)
    assert coarse.largest_input == pytest.approx(result.figures.largest_input, rel=1e-6)
