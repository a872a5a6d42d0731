"""Time against true error: our propagation and scipy's integrators on the paper's example, in one run.

    make bench

The peers integrate equations (1), (18), (19), (21), (23) written by hand in plain Python floats, the
fastest form they have here; ours propagates the closed loop from event to event. Both are sampled
100 times a second for 60 s (694 mode changes). The truth is DOP853 at rtol 1e-13, which ours must
meet to 1e-9 before anything is timed.
"""

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.integrate import solve_ivp

from pwatrack import design, load_spec
from pwatrack.arrays import Array
from pwatrack.simulation.closed_loop import closed_loop
from pwatrack.simulation.propagate import simulate_flow

SPEC = Path(__file__).parent.parent / "specs" / "two_mass_paper_gains.yaml"
START = [0.25, 0, 0, 0, 0, 0, 0, 0, 0.2, 0]
PEERS = [("RK45", 1e-6), ("RK45", 1e-9), ("DOP853", 1e-6), ("DOP853", 1e-9), ("DOP853", 1e-11), ("Radau", 1e-6)]
REPEATS = 3


def spring(gap: float) -> float:
    """Return the force of the one-sided springs."""
    return 0.4 * (gap - 0.05) if gap > 0.05 else 0.4 * (gap + 0.1) if gap < -0.1 else 0.0


def right_hand_side(t: float, s: Sequence[float]) -> list[float]:
    """Return the closed loop of Section V in (x, x̂, η̄), with ERRATA's corrections."""
    z1, v1, z2, v2, p1, w1, p2, w2, e, de = s
    omega = 2 * math.pi
    z_d, v_d = 0.15 * math.sin(omega * t), 0.15 * omega * math.cos(omega * t)
    u_ff = -omega * omega * z_d - 0.1 * (de - v_d) - spring(e)
    u = -1.6088 * (p1 - z_d) - 1.1260 * (w1 - v_d) + 0.2282 * (p2 - e - z_d) - 0.1182 * (w2 - de) + u_ff
    force, force_hat, off = spring(z2 - z1) + 0.1 * (v2 - v1), spring(p2 - p1) + 0.1 * (w2 - w1), p1 - z1
    return [
        v1,
        force + u,
        v2,
        -force - z2 - 0.2 * v2,
        w1 - 1.1056 * off,
        force_hat + u - 1.5348 * off,
        w2 - 0.1027 * off,
        -force_hat - p2 - 0.2 * w2 + 0.1653 * off,
        de - v_d,
        -spring(e) - (e + z_d) - 0.3 * de + 0.1 * v_d,
    ]


def timed(run: Callable[[], Array]) -> tuple[float, Array]:
    """Return the least time of a few runs in s, and the answer."""
    best, answer = math.inf, np.zeros(0)
    for _ in range(REPEATS):
        start = time.perf_counter()
        answer = run()
        best = min(best, time.perf_counter() - start)
    return best, answer


def main() -> None:
    """Print the table."""
    spec = load_spec(SPEC)
    controller = design(spec)
    t = np.arange(6001) * 0.01

    def ours() -> Array:
        loop = closed_loop(controller)
        start = loop.start(plant=np.array(START[:4]), observer=np.zeros(4), generator=np.array(START[8:]))
        trace = simulate_flow(loop.flow, start, duration=60.0, sample_time=0.01)
        answer = trace.z[:, :10].copy()
        answer[:, 8] -= trace.z @ loop.x_d[0]  # η̄_1 = η̂_1 − z_d
        return answer

    def peer(method: str, rtol: float) -> Array:
        solution = solve_ivp(right_hand_side, (0, 60), START, method=method, rtol=rtol, atol=rtol / 100, t_eval=t)
        return np.asarray(solution.y.T)

    truth = peer("DOP853", 1e-13)
    our_time, our_answer = timed(ours)
    our_error = float(np.abs(our_answer - truth).max())
    if our_error > 1e-9:
        raise SystemExit(f"ours and the truth differ by {our_error:.2g}: nothing is timed")
    table = Table("method", "rtol", "seconds", "largest error", "times slower than ours")
    table.add_row("pwatrack", "", f"{our_time:.3f}", f"{our_error:.1e}", "1")
    for method, rtol in PEERS:
        seconds, answer = timed(lambda method=method, rtol=rtol: peer(method, rtol))  # type: ignore[misc]
        error = float(np.abs(answer - truth).max())
        table.add_row(method, f"{rtol:g}", f"{seconds:.3f}", f"{error:.1e}", f"{seconds / our_time:.1f}")
    Console().print(table)


if __name__ == "__main__":
    main()
