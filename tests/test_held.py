"""What a program has at its ticks, all at once, against the program stepped tick by tick."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from pwatrack.arrays import Array
from pwatrack.control.program import Follows, Piece, SampledController
from pwatrack.model.conditions import Sampling
from pwatrack.simulation.controller_arrays import NONE
from pwatrack.simulation.held import AtTicks, Held
from pwatrack.simulation.loads_along import LoadsAlong
from pwatrack.simulation.recursions import powers, recursion

seeds = st.integers(0, 2**32 - 1)


@given(seeds, st.integers(0, 40), st.integers(1, 4))
@settings(max_examples=40)
def test_a_recursion_is_its_steps(seed: int, count: int, n: int) -> None:
    random = np.random.default_rng(seed)
    M, c, x = random.normal(size=(count, n, n)) / n, random.normal(size=(count, n)), random.normal(size=n)
    steps = [x]
    for M_k, c_k in zip(M, c, strict=True):
        steps.append(M_k @ steps[-1] + c_k)
    np.testing.assert_allclose(recursion(M, c, x), steps, rtol=1e-9, atol=1e-9)
    if count:
        alike = [np.linalg.matrix_power(M[0], k) @ x for k in range(count)]
        np.testing.assert_allclose(powers(M[0], x, count), alike, rtol=1e-9, atol=1e-12)


def stepped(program: SampledController, eta: Array, loads: LoadsAlong, count: int) -> AtTicks:
    """The same tick by tick, as `docs/arithmetic.md` has it."""
    follows, h, ahead = program.follows, program.sampling.sample_time, program.sampling.ahead
    assert follows is not None
    rows, w, back = [], follows.w0.copy(), expm(loads.S * (-ahead * h))
    for number, (tick, s) in enumerate(zip(range(-len(follows.early), count), loads.ticks, strict=False)):
        if number == count:
            break
        for piece in follows.pieces if tick >= 0 else ():
            if piece.tick == tick or (tick == 0 and piece.tick < 0):
                w[piece.start : piece.start + len(piece.w)] = piece.w
        now = follows.early[number] if tick < 0 else w
        known = np.concatenate([back @ s, eta, now, [1.0]])
        g = program.guards @ known
        worst = [max([-sign * each for sign, each in zip(row, g, strict=True)], default=0) for row in program.sides]
        j = int(np.argmin(np.maximum(worst, 0.0)))
        rows.append((program.x_d[j] @ known, program.u_ff[j] @ known * (tick >= 0), eta, now.copy(), s))
        eta = program.generator[j] @ known
        if tick >= 0:
            w = follows.turn[0] @ w
    return AtTicks(*(np.array(each) for each in zip(*rows, strict=True)))


def turning(speed: float) -> Array:
    return np.array([[np.cos(speed), np.sin(speed)], [-np.sin(speed), np.cos(speed)]])


@pytest.mark.parametrize("delay", [0, 2])
@pytest.mark.parametrize("cells", [1, 3])
@given(seed=seeds)
@settings(max_examples=15)
def test_what_is_held_is_what_a_program_has_tick_by_tick(cells: int, delay: int, seed: int) -> None:
    """With pieces of its reference, steps of loads, cells that change all the time, and in blocks of any size."""
    random = np.random.default_rng(seed)
    k, p, s, n, m, h = 2, 2, 2, 3, 1, 0.1
    C = k + p + s + 1
    generator = random.normal(size=(cells, p, C)) * 0.2
    program = replace(
        NONE,
        sampling=Sampling(sample_time=h, delay=delay),
        generator=generator,
        x_d=random.normal(size=(cells, n, C)),
        u_ff=random.normal(size=(cells, m, C)),
        guards=random.normal(size=(2, C))[: cells - 1],
        sides=np.array([[1, 0], [-1, 1], [-1, -1]])[:cells, : cells - 1],
        follows=Follows(
            turn=turning(0.3)[None],
            w0=random.normal(size=s),
            pieces=tuple(
                Piece(tick=tick, start=start, w=random.normal(size=size))
                for tick, start, size in [(-1, 0, 1), (7, 0, 2), (7, 1, 1), (40, 1, 1)]
            ),
            end=None,
            early=random.normal(size=(delay, s)),
        ),
    )
    loads = LoadsAlong(
        S=np.array([[0.0, 0.0], [0.0, -0.3]]),
        start=random.normal(size=k),
        sample_time=h,
        steps={0: np.ones(2), 5: random.normal(size=k), 41: random.normal(size=k)},
    )
    eta, found = random.normal(size=p), list[AtTicks]()
    held = Held(program, eta, loads)
    for count in (1, 2, 50, 100):
        found.append(held.take(count))
    both = [np.concatenate(each) for each in zip(*found, strict=True)]
    for one, other in zip(both, stepped(program, eta, loads, 153), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)
