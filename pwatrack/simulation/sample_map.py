"""Sample times: what one sample does to errors in each cell by itself; which times are refused, and which offered."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from decimal import ROUND_FLOOR, Context

import numpy as np
from scipy.linalg import expm

from pwatrack.arrays import Array
from pwatrack.causes import ProblemPart, Remedy, Way
from pwatrack.control.controller import ProvedController
from pwatrack.errors import CheckFailed, InvalidSpec, Problem
from pwatrack.model.conditions import Conditions, Sampling
from pwatrack.model.pwa import PWASystem
from pwatrack.simulation.closed_loop import ClosedLoop, Response, closed_loop
from pwatrack.simulation.propagate import Propagator

_HALVINGS = 40  # of a sample time that is too long, until one is found
_BISECTIONS = 12  # of a sample time: to a part in 4,000
_SHORTER = 16  # times below one that are looked at too
_SURE = 1 + 1e-9  # the eigenvalues of a map are known to less
_SCALES = 0.01, 1.0, 100.0  # of the way to the farthest facet: in one cell, across facets, and where they look near
_DIRECTIONS = 6  # at each of these
_MOST_CELLS = 8  # whose slowest deviation is a start, and facets that runs start at
_BESIDE = 1e-3  # of the way to a facet: how far from it, with the observer on its other side
_GONE = 1e-3  # of a start: what is left of one that died out
_LONGER = 2.0  # than the slowest of the cells would take to that
_FEWEST, _MOST = 60, 8_000  # samples of a run: one that takes more is not seen to the end
_NEXT = 0.8  # from one sample time that is tried to the next
_TRIES = 12  # of them: down to a twelfth
_SEED = 1  # of the directions: the same ones each time


def unstable_cell(controller: ProvedController, conditions: Conditions) -> "tuple[str, SampleMaps, float] | None":
    """Say in which cell the sampled loop is unstable by itself, where it is not in any at a shorter sample time.

    Nothing is said of a loop that is stable in each cell: switching between them may still make it run away. Returned
    are the words, the maps of one sample, and the longest time (s) found at which no cell is unstable by itself.
    """
    sampling, merged = conditions.sampling, controller.running is not controller.plant
    if sampling is None:
        return None
    plant = controller.plant if merged else conditions.plant or controller.plant  # merged cells may be unstable
    maps = SampleMaps(controller, plant, sampling)
    cell, radius = maps.worst(sampling.sample_time)
    if radius < _SURE:
        return None
    longest = maps.longest(sampling.sample_time)
    if longest is None:
        return None  # however short, it is unstable: that is not for its sampling, and is seen when it runs
    name = controller.plant.cell_names[cell]
    message = (
        f"sampled every {sampling.sample_time:g} s, the loop is unstable in cell '{name}': "
        f"as long as it stays there, one sample multiplies what is off by {radius:.4g} in the long run"
    )
    return message, maps, longest


def sampling_remarks(controller: ProvedController, conditions: Conditions) -> tuple[str, ...]:
    """Say beforehand that a simulation will be refused for its sample time."""
    found = unstable_cell(controller, conditions)
    return () if found is None else (f"{found[0]}; so it is not simulated",)


@dataclass(frozen=True)
class SampleMaps:
    """What deviations of plant, observer and generator become in one sample, where all are at rest in one cell.

    There the loop is linear: with the held input u and output y, x⁺ = Φ x + Γ u, and the program steps x̂ and η̂ on.
    """

    controller: ProvedController
    plant: PWASystem  # the one that runs
    sampling: Sampling  # but for its sample time, which is what the methods are asked for

    def radius(self, cell: int, h: float) -> float:
        """Return the spectral radius of the map in a cell for a sample time h (s): below 1, deviations vanish."""
        A = self.controller.trajectory.rate[cell, :, : len(self.controller.trajectory.names)]
        with np.errstate(all="ignore"):
            maps = self.loop(cell, h), self._stepped(A, h)
        if not all(np.isfinite(M).all() for M in maps):
            return np.inf  # what grows is out of range
        return max(float(np.abs(np.linalg.eigvals(M)).max(initial=0.0)) for M in maps)

    def worst(self, h: float) -> tuple[int, float]:
        """Return the cell with the largest radius, and that."""
        radii = {cell: self.radius(cell, h) for cell in self.cells}
        cell = max(radii, key=lambda cell: radii[cell])
        return cell, radii[cell]

    def loop(self, cell: int, h: float) -> Array:
        """Return the map of (x, x̂, u, …): u and what waits to be put out where the output is late, (N, N).

        Example: four states of the plant and four of the observer.

            >>> from pwatrack import design, load_spec
            >>> controller = design(load_spec("specs/two_mass_paper_gains.yaml"))
            >>> maps = SampleMaps(controller, controller.plant, Sampling(sample_time=0.1))
            >>> maps.loop(0, 0.1).shape, maps.radius(0, 0.1) < 1
            ((8, 8), True)
        """
        model, L, law = self.controller.plant, self.controller.design.L, self._law(cell)
        (n, m), (N, q), late = model.B.shape, L.shape, self.sampling.delay
        plant = expm(np.block([[self.plant.A[cell], self.plant.B], [np.zeros((m, n + m))]]) * h)  # u is held
        seen = replace(model, watched=None).observed.A[cell].floats + L @ model.observed.C.floats
        inputs = np.hstack([np.vstack([model.B, np.zeros((N - n, m))]), -L])
        observer = self._stepped(np.block([[seen, inputs], [np.zeros((m + q, N + m + q))]]), h)
        k = n + law.shape[1]  # of plant, observer and, with loads, generator
        M = np.zeros((k + m * late, k + m * late))
        M[:n, :n], M[n : n + N, n : n + N] = plant[:n, :n], observer[:N, :N]
        M[n : n + N, :n] = observer[:N, N + m :] @ self.plant.C
        M[n + N : k, 2 * n : k] = self._generator(cell, h)[:, : k - 2 * n]
        driven = np.vstack([plant[:n, n:], observer[:N, N : N + m], np.zeros((k - n - N, m))])
        if not late:
            M[:, n:] += driven @ law
            return M
        M[:k, k : k + m] = driven
        M[k:-m, k + m :] = np.eye(m * (late - 1))
        M[-m:, n:k] = law
        return M

    def _law(self, cell: int) -> Array:
        """Return the rows of u on x̂ and, where loads are estimated, on their estimates ŝ and on η̂."""
        K, trajectory, added = self.controller.design.K, self.controller.trajectory, self.controller.compensation
        if self.controller.plant.loads is None:
            return K
        p = trajectory.rate.shape[1]
        of_eta = trajectory.u_ff[cell][:, :p] - K @ trajectory.x_d[cell][:, :p]
        return np.hstack([K, added.u_ff[cell] - K @ added.X.floats, of_eta])

    def _generator(self, cell: int, h: float) -> Array:
        """Return the rows of η̂ one sample later on (ŝ, η̂); none without loads, where nothing drives it in the loop."""
        loads, rate = self.controller.plant.loads, self.controller.trajectory.rate[cell]
        if loads is None:
            return np.zeros((0, 0))
        S, p = loads.S.floats, len(rate)
        rates = np.block([[S, np.zeros((len(S), p))], [self.controller.compensation.rate[cell], rate[:, :p]]])
        return self._stepped(rates, h)[len(S) :]

    def longest(self, h: float) -> float | None:
        """Return the longest sample time below a given one at which each cell is stable by itself, in s, or None.

        So it is at shorter ones, as far as was looked. Where two digits are as good, it has two.
        """
        high = h
        for _ in range(_HALVINGS):
            low = high / 2
            if all(self.worst(time)[1] < 1 for time in low * np.linspace(1.0, 1 / _SHORTER, _SHORTER)):
                break
            high = low
        else:
            return None
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            low, high = (middle, high) if self.worst(middle)[1] < 1 else (low, middle)
        rounded = float(Context(prec=2, rounding=ROUND_FLOOR).create_decimal(low))
        return rounded if self.worst(rounded)[1] < 1 else low

    @property
    def cells(self) -> list[int]:
        """The cells of the plant that are not all alike."""
        found: dict[bytes, int] = {}
        A_eta = self.controller.trajectory.rate
        for cell in range(min(len(self.plant.A), len(self.controller.plant.A))):
            key = self.plant.A[cell].tobytes() + self.controller.plant.A[cell].tobytes() + A_eta[cell].tobytes()
            found.setdefault(key, cell)
        return list(found.values())

    def _stepped(self, F: Array, h: float) -> Array:
        """Return what the program makes of ż = F z in one sample."""
        return np.asarray(expm(F * h)) if self.sampling.method == "exponential" else np.eye(len(F)) + F * h


def check_sample_time(controller: ProvedController, conditions: Conditions) -> None:
    """Refuse a sample time at which the loop is unstable in some cell, where no cell is at a shorter one.

    Raises:
        CheckFailed: With the cell, the spectral radius there, and a time at which runs die out if one is found.
    """
    found = unstable_cell(controller, conditions)
    if found is None:
        return
    message, maps, longest = found
    offer = dying_out(maps, longest)
    message += f"; at {longest:g} s no cell by itself is unstable, "
    if offer is None:
        message += f"but no time was found at which simulated runs from other starts die out within {_MOST:,} samples"
    else:
        message += f"and at {offer[0]:g} s all of {offer[1]} simulated runs from other starts died out"
    remedy = None if offer is None else Remedy(Way.FASTER_SAMPLES, (offer[0],))
    raise CheckFailed(Problem(message=message, subject=(ProblemPart.SAMPLE_TIME,), remedy=remedy))


def dying_out(maps: SampleMaps, longest: float) -> tuple[float, int] | None:
    """Return a sample time (s) at which all runs are seen to die out, and how many; None if none is found.

    They do at a time that is a quarter longer, too.

    Args:
        maps: Of the loop.
        longest: Up to which it is stable in each cell by itself, in s.
    """
    before, time = False, longest
    for _ in range(_TRIES):
        rounded = float(f"{time:.2g}")
        count = _all_die_out(maps, rounded)
        if before and count:
            return rounded, count
        before, time = bool(count), time * _NEXT
    return None


def _all_die_out(maps: SampleMaps, h: float) -> int:
    """Return how many runs there were, 0 where one did not die out.

    What is off is the difference to the run that begins on x_d with x̂ = x: what a moving reference leaves of an error
    in a sampled loop is in both.
    """
    _, radius = maps.worst(h)
    if not 0 < radius < 1:
        return 0
    ticks = max(_FEWEST, int(np.ceil(_LONGER * np.log(_GONE) / np.log(radius))))
    controller, end = maps.controller, maps.controller.trajectory.exosystem.end
    if ticks > _MOST or (end is not None and ticks * h > end):
        return 0
    sampling = replace(maps.sampling, sample_time=h)
    other = None if maps.plant is controller.plant else maps.plant
    loop = closed_loop(controller, Conditions(plant=other, sampling=sampling))
    at_rest = np.zeros(2 * len(controller.sizes.state))
    try:
        propagator = Propagator(loop.flow, duration=ticks * h, sample_time=h)
        nominal, found = _run(loop, propagator, at_rest), 0
        for away in _starts(maps, h, nominal.x_d[0]):
            run, sizes = _run(loop, propagator, away), controller.sizes.state
            off = np.hstack([run.x - nominal.x, run.x_hat - nominal.x_hat]) / np.tile(sizes, 2)
            left = np.linalg.norm(off[-ticks // 10 :], axis=1).max()
            if not left <= _GONE * np.linalg.norm(off[0]):
                return 0
            found += 1
    except (CheckFailed, InvalidSpec):  # it runs away, or floating point does not resolve it
        return 0
    return found


def _run(loop: ClosedLoop, propagator: Propagator, away: Array) -> Response:
    """Run the loop from (x, x̂) that are so far from x_d, (2 n,)."""
    trajectory = loop.controller.trajectory
    eta = np.zeros(len(trajectory.names)) if trajectory.eta0 is None else trajectory.eta0
    x_d = trajectory.state(np.concatenate([eta, trajectory.exosystem.w0, [1.0]]))
    x, x_hat = np.split(np.tile(x_d, 2) + away, 2)
    start, end = loop.start(plant=x, observer=x_hat, generator=eta), propagator.samples * propagator.sample_time
    return loop.response(propagator.walk(start, loop.resets(end)).trace())


def _starts(maps: SampleMaps, h: float, x_d: Array) -> Iterator[Array]:
    """Yield how far (x, x̂) begin from x_d: in all directions, in the slowest of each cell, and on facets."""
    sizes, partition = maps.controller.sizes.state, maps.controller.plant.partition
    both, n, random = np.tile(sizes, 2), len(sizes), np.random.default_rng(_SEED)
    distance = (partition.H @ x_d + partition.h) / np.maximum(np.linalg.norm(partition.H * sizes, axis=1), 1e-300)
    far = max(1.0, float(np.abs(distance).max(initial=0.0)))
    for scale in _SCALES:
        for direction in random.normal(size=(_DIRECTIONS, 2 * n)):
            yield scale * far * both * direction / np.linalg.norm(direction)
    for cell in sorted(maps.cells, key=lambda cell: -maps.radius(cell, h))[:_MOST_CELLS]:
        values, vectors = np.linalg.eig(maps.loop(cell, h))
        slowest = vectors[: 2 * n, np.argmax(np.abs(values))].real
        if slowest.any():
            yield _SCALES[-1] * far * slowest / np.linalg.norm(slowest / both)
    for row, away in [*zip(partition.H, distance, strict=True)][:_MOST_CELLS]:
        step = sizes**2 * row / max(np.linalg.norm(sizes * row), 1e-300)
        beside = _BESIDE * max(abs(away), 1.0)
        yield np.concatenate([-(away - beside) * step, -(away + beside) * step])
