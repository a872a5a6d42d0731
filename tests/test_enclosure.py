"""What is said of a signal between samples is never below what it attains, and at most 1e-6 of it above."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import expm

from pwatrack.arrays import Array
from pwatrack.model.reference import StateResets
from pwatrack.simulation import enclosure
from pwatrack.simulation.enclosure import CLOSE, Range, Rows, Segments, enclosed
from pwatrack.simulation.flow import Flow, Mode, SwitchedPart
from pwatrack.simulation.propagate import simulate_flow, trace_blocks

ROUNDING = 1e-11  # of the largest signal


def sprung(A: Array, kink: Array) -> Flow:
    """ż = A z, and kink z₁ more where z₁ > 0 if that is anything; the last entry is the constant 1."""
    n = len(A) + 1
    F = np.zeros((2, n, n))
    F[1, :-1, 0] = kink
    guard = np.eye(n)[:1] if kink.any() else -np.eye(n)[-1:]
    part = SwitchedPart(name="x", cells=("low", "high"), guards=guard, signs=np.array([[-1], [1]]), F=F)
    F0 = np.zeros((n, n))
    F0[:-1, :-1] = A
    return Flow(F0=F0, parts=(part,))


def by_exponentials(flow: Flow, z0: Array, duration: float, rows: Rows, resets: list[StateResets]) -> Array:
    """r z at 400 times of each stretch between crossings and resets, (K, q), by matrix exponentials alone."""
    trace = simulate_flow(flow, z0, duration=duration, sample_time=duration / 7, resets=resets)
    jumps = sorted((float(t), r, k) for r in resets for k, t in enumerate(r.t))
    edges = sorted({0.0, duration, *(event.t for event in trace.events), *(t for t, _, _ in jumps if t < duration)})
    z, found = z0, []
    for a, b in pairwise(edges):
        for t, r, k in jumps:
            if t == a:
                z = z.copy()
                z[r.where] = r.values[k]
        mode = next(m for m, start, end in trace.stays() if start <= (a + b) / 2 <= end)
        step, middle = expm(flow.matrix(mode) * (b - a) / 400), z
        for _ in range(400):
            found.append(rows(mode) @ middle)
            middle = step @ middle
        z = middle
        found.append(rows(mode) @ z)
    return np.array(found)


def always(rows: Array | list[list[float]]) -> Rows:
    return lambda _: np.array(rows)


def walked(flow: Flow, z0: Array, duration: float, samples: int, resets: list[StateResets]) -> list[Segments]:
    blocks = trace_blocks(
        flow, z0, duration=duration, sample_time=duration / samples, resets=resets, most=max(2, samples // 3)
    )
    return [Segments.of(flow, trace) for trace in blocks]


def check(found: Range, values: Array) -> None:
    """Hold bounds against values that are attained."""
    size = np.abs(values).max(axis=0)
    assert (found.high >= values.max(axis=0) - ROUNDING * size).all()
    assert (found.low <= values.min(axis=0) + ROUNDING * size).all()
    said = np.maximum(found.high, -found.low)
    close = 1.001 * CLOSE * said
    assert (found.high - found.inner[:, 1] <= close).all()
    assert (found.inner[:, 0] - found.low <= close).all()
    assert (found.inner[:, 1] <= values.max(axis=0) + 1e-3 * size).all()
    assert (found.inner[:, 0] >= values.min(axis=0) - 1e-3 * size).all()


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("samples", [7, 500])
def test_random_signals_are_within_their_bounds_which_are_close(seed: int, samples: int) -> None:
    random = np.random.default_rng(seed)
    n = int(random.integers(2, 6))
    A = random.normal(size=(n, n)) * 3
    A -= (np.linalg.eigvals(A).real.max() + random.choice([-0.2, 0.0, 0.5])) * np.eye(n)
    flow, z0 = sprung(A, random.normal(size=n)), np.append(random.normal(size=n), 1.0)
    r = random.normal(size=(2, 3, n + 1)) * (1.0 + 9 * (random.random(3) < 0.3))[:, None]  # jumps across the facet
    resets = [StateResets(t=np.array([0.731, 2.9]), where=slice(1, 2), values=random.normal(size=(2, 1)) * 2)]

    def rows(mode: Mode) -> Array:
        return np.asarray(r[mode[0]])

    values = by_exponentials(flow, z0, 4.0, rows, resets)
    blocks = walked(flow, z0, 4.0, samples, resets)
    check(enclosed(blocks, rows), values)
    norm = enclosed(blocks, rows, norm=True)
    most = np.linalg.norm(values, axis=1).max()
    assert most * (1 - ROUNDING) <= norm.high[0] <= most * (1 + 1e-3)
    assert norm.high[0] - norm.inner[0, 1] <= 1.001 * CLOSE * norm.high[0]


@pytest.mark.parametrize("rate", [1e2, 1e4, 1e6])
def test_a_peak_that_is_over_long_before_the_next_sample_is_found(rate: float) -> None:
    # u = 1 + e^{−rate t} − e^{−2 rate t} is largest at t = ln 2 / rate, 1.25, and then 1 for good
    flow = sprung(np.diag([-rate, -2 * rate]), np.zeros(2))
    blocks = walked(flow, np.array([1.0, 1.0, 1.0]), 10.0, 100, [])
    found = enclosed(blocks, always(np.array([[1.0, -1.0, 1.0]])))
    assert 1.25 <= found.high[0] <= 1.25 * (1 + 2 * CLOSE)
    assert found.times[0, 1] == pytest.approx(np.log(2) / rate, rel=1e-2)
    assert 1 - 3 * CLOSE <= found.low[0] <= 1.0


def test_what_decayed_fast_costs_a_slow_signal_nothing() -> None:
    flow = sprung(np.array([[0, 1.0, 0], [-1, 0, 0], [1e7, 0, -1e7]]), np.zeros(3))
    found = enclosed(walked(flow, np.array([0.0, 1, 0, 1]), 20.0, 300, []), always(np.array([[0, 0, 1.0, 0]])))
    assert 1 - 1e-7 <= found.high[0] <= 1 + 1e-6 + 1e-7
    assert found.times[0, 1] == pytest.approx(np.pi / 2, abs=1e-2)


def test_of_equal_peaks_the_first_counts_and_a_constant_is_its_own_bound() -> None:
    flow = sprung(np.array([[0, 1.0], [-1, 0]]), np.zeros(2))
    blocks = walked(flow, np.array([0.0, 1, 1]), 60.0, 700, [])
    found = enclosed(blocks, always(np.array([[1.0, 0, 0], [0, 0, 3.0], [0, 0, 0]])))
    assert found.times[0] == pytest.approx([3 * np.pi / 2, np.pi / 2], abs=1e-3)
    assert found.low[1:].tolist() == pytest.approx([3, 0], rel=1e-12)
    assert found.high[1:].tolist() == pytest.approx([3, 0], rel=1e-12)
    assert found.times[1, 1] == 0.0


def test_what_is_seen_since_a_sample_is_the_end_of_a_run() -> None:
    flow = sprung(np.array([[-1.0, 10.0], [-10, -1.0]]), np.zeros(2))
    blocks = walked(flow, np.array([1.0, 0, 1]), 5.0, 50, [])
    late = enclosed([block.since(blocks[-1].t[-1] - 0.5) for block in blocks], always(np.eye(3)[:2]), norm=True)
    assert late.high[0] == pytest.approx(np.exp(-4.5), rel=2e-6)


def test_pieces_that_are_bounded_in_parts_say_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of very many states not all pieces fit into memory at once."""
    F = np.array([[0.0, 1.0], [-4.0, -0.1]])
    t = np.linspace(0.0, 9.9, 100)
    zeta = np.array([expm(F * at) @ [1.0, 0.0] for at in t])
    number = np.zeros(100, dtype=np.int64)
    segments = Segments(modes=((0,),), F=F[None], number=number, t=t, zeta=zeta, length=np.full(100, 0.1))
    whole = enclosed([segments], lambda _: np.eye(2))
    monkeypatch.setattr(enclosure, "TOGETHER", 100)
    parts = enclosed([segments], lambda _: np.eye(2))
    assert parts.high == pytest.approx(whole.high, rel=2e-7)
    assert parts.low == pytest.approx(whole.low, rel=2e-7)
    assert (parts.high >= parts.inner[:, 1]).all()
