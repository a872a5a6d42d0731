"""What one sample does to errors in each cell by itself, and so which sample times are refused.

Where one is, runs from many starts show another at which they die out, which is no proof.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from decimal import ROUND_FLOOR, Context

import numpy as np
from scipy.linalg import expm

from pwatrack.arrays import Array
from pwatrack.claims.sampled import SampledLoop
from pwatrack.control.controller import ProvedController
from pwatrack.control.program import SampledController, program
from pwatrack.errors import CheckFailed, InvalidSpec, ProblemPart, Remedy, Way
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
_ALIKE = 1e-6  # of a radius: less is no difference
_GONE = 1e-3  # of a start: what is left of one that died out
_LONGER = 2.0  # than the slowest of the cells would take to that
_FEWEST, _MOST = 60, 8_000  # samples of a run: one that takes more is not seen to the end
_NEXT = 0.8  # from one sample time that is tried to the next
_TRIES = 12  # of them: down to a twelfth
_SEED = 1  # of the directions: the same ones each time


@dataclass(frozen=True)
class SampleMaps:
    """What deviations of plant, observer and generator become in one sample, where all are at rest in one cell.

    There the loop is linear: with the held input u and output y, x⁺ = Φ x + Γ u, and the program steps x̂ and η̂ on.
    """

    controller: ProvedController
    plant: PWASystem  # the one that runs
    sampling: Sampling  # but for its sample time, which is what the methods are asked for
    _kept: dict[float, SampledController] = field(default_factory=dict, repr=False)

    def radius(self, cell: int, h: float) -> float:
        """Return the spectral radius of the map in a cell for a sample time h (s): below 1, deviations vanish."""
        with np.errstate(all="ignore"):
            try:
                eta = self.runs(h).generator[cell][:, len(self.controller.design.L) - self.plant.A.shape[1] :]
            except InvalidSpec:  # what a cell does in a sample is out of range
                return np.inf
            maps = self.loop(cell, h), eta[:, : len(eta)]
        if not all(np.isfinite(M).all() for M in maps):
            return np.inf  # what grows is out of range
        return max(float(np.abs(np.linalg.eigvals(M)).max(initial=0.0)) for M in maps)

    def grows(self, cell: int, h: float, radius: float) -> str:
        """Say that it is the observer by itself that has a radius in a cell; "" where it is not."""
        of, m = self.runs(h), self.plant.B.shape[1]
        stepped = self._stepped(cell, of)
        error = stepped[:, m:] + (of.M @ of.C @ stepped[:, m:] if self.sampling.corrects else 0.0)
        own = float(np.abs(np.linalg.eigvals(error)).max()) if np.isfinite(error).all() else 0.0
        said = ", its observer by itself: larger 'sizes' of outputs make that calmer"
        return said if own > radius * (1 - _ALIKE) else ""

    def worst(self, h: float) -> tuple[int, float]:
        """Return the cell with the largest radius, and that."""
        radii = {cell: self.radius(cell, h) for cell in self.cells}
        cell = max(radii, key=lambda cell: radii[cell])
        return cell, radii[cell]

    def loop(self, cell: int, h: float) -> Array:
        """Return the map of (x, x̂, u, …): u and what waits to be put out where the output is late, (N, N)."""
        (n, m), of, late = self.plant.B.shape, self.runs(h), self.sampling.delay
        plant = expm(np.block([[self.plant.A[cell], self.plant.B], [np.zeros((m, n + m))]]) * h)  # u is held
        N, of_y = of.sizes["N"], np.zeros((of.sizes["N"], n))
        stepped = self._stepped(cell, of)
        if not self.sampling.corrects:
            of_y = of.observer[cell][:, : of.sizes["q"]] @ self.plant.C
        of_u, seen = stepped[:, :m], stepped[:, m:]
        law = of.K  # of u on x̂ and, where loads are estimated, on their estimates ŝ and on η̂
        if self.controller.plant.loads is not None:
            known = N - of.sizes["n"] + of.sizes["p"]
            law = np.hstack([law, of.u_ff[cell][:, :known] - law @ of.x_d[cell][:, :known]])
        k = n + law.shape[1]  # of plant, observer and, with loads, generator
        M, driven = np.zeros((k + m * late, k + m * late)), np.zeros((k, m))
        M[:n, :n], M[n : n + N, :n], M[n : n + N, n : n + N] = plant[:n, :n], of_y, seen
        M[n + N : k, 2 * n : k] = of.generator[cell][:, : k - 2 * n] if k > n + N else 0.0
        driven[:n], driven[n : n + N] = plant[:n, n:], of_u
        for rows in (M, driven) if self.sampling.corrects else ():  # with y of the next tick
            rows[n : n + N] += of.M @ (of.C @ rows[n : n + N] - self.plant.C @ rows[:n])
        if not late:
            M[:, n:] += driven @ law
            return M
        M[:k, k : k + m] = driven
        M[k:-m, k + m :] = np.eye(m * (late - 1))
        of_state, of_late = np.eye(N), np.zeros((N, m * late))
        for j in range(self.sampling.ahead):  # the law gets what is predicted with the inputs that wait
            of_state, of_late = seen @ of_state, seen @ of_late
            of_late[:, m * j : m * (j + 1)] += of_u
        M[-m:, n : n + N], M[-m:, n + N : k], M[-m:, k:] = law[:, :N] @ of_state, law[:, N:], law[:, :N] @ of_late
        return M

    def runs(self, h: float) -> SampledController:
        """Return what runs at a sample time (s), with the cells of the plant; the last one is kept."""
        if h not in self._kept:
            self._kept.clear()
            of = replace(self.controller, plant=replace(self.controller.plant, watched=None))
            self._kept[h] = program(of, Conditions(sampling=replace(self.sampling, sample_time=h, jitter=0.0)))
        return self._kept[h]

    def _stepped(self, cell: int, of: SampledController) -> Array:
        """Return the rows of (x̂, ŝ) after one sample on (u, x̂, ŝ), before what is measured corrects it."""
        N, m = of.sizes["N"], self.plant.B.shape[1]
        once: Array = of.observer[cell][:, -N - m - 1 : -1]
        if not self.sampling.corrects:
            return once
        return np.asarray(np.linalg.matrix_power(np.vstack([np.eye(m, m + N), once]), of.substeps)[m:])

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


def sampling_remarks(controller: ProvedController) -> Iterator[str]:
    """Say which sample times could be proved."""
    for claim in controller.claims_of(SampledLoop):
        h, longest = claim.gains.sample_time, claim.longest
        if longest is not None and (claim.proof is None or longest > h):
            but = f"{h:g} s are too long for a proof: " if claim.proof is None and longest < h else ""
            yield (
                f"{but}with other gains, made for it, a proof was found up to a sample time of {longest:g} s; "
                "it is not about these gains"
            )


def refused(controller: ProvedController, conditions: Conditions) -> tuple[str, Remedy] | None:
    """Say why a sample time is refused at which the loop is unstable in some cell, where none is at a shorter one.

    Nothing is said of a loop that is stable in each cell: switching between them may still make it run away. Returned
    are the cell and the spectral radius there, and a time at which runs die out if one is found.
    """
    sampling, merged = conditions.sampling, controller.running is not controller.plant
    if sampling is None:
        return None
    plant = controller.plant if merged else conditions.plant or controller.plant  # merged cells may be unstable
    maps, h = SampleMaps(controller, plant, sampling), sampling.sample_time
    cell, radius = maps.worst(h)
    longest = maps.longest(h) if radius >= _SURE else None
    if longest is None:  # however short, it is unstable: that is seen when it runs
        return None
    message = (
        f"sampled every {h:g} s, the loop is unstable in cell '{controller.plant.cell_names[cell]}': as long as it "
        f"stays there, one sample multiplies an error by {radius:.{4 if radius > 1.001 else 9}g} in the long run"
        f"{maps.grows(cell, h, radius)}"
    )
    offer = dying_out(maps, longest)
    if offer is None:
        message += f"; shorter times were tried down to {_tried(longest)[-1]:g} s, and with none do all "
        return message + "simulated runs from other starts die out", Remedy(Way.SLOWER_GAINS)
    message += f"; at {longest:g} s no cell by itself is unstable, "
    message += f"and at {offer[0]:g} s all of {offer[1]} simulated runs from other starts died out"
    return message, Remedy(Way.FASTER_SAMPLES, (offer[0],))


def not_simulated(why: str) -> str:
    """Say before a run what a refused sample time means for it."""
    return f"{why}; so it is not simulated"


def check_sample_time(controller: ProvedController, conditions: Conditions) -> None:
    """Refuse a sample time; raises CheckFailed with why, see `refused`."""
    if found := refused(controller, conditions):
        raise CheckFailed(found[0], subject=(ProblemPart.SAMPLE_TIME,), remedy=found[1])


def dying_out(maps: SampleMaps, longest: float) -> tuple[float, int] | None:
    """Return a sample time (s) at which all runs are seen to die out, and how many; None if none is found.

    They do at a time that is a quarter longer, too. Up to `longest` (s) it is stable in each cell by itself.
    """
    before = False
    for time in _tried(longest):
        count = _all_die_out(maps, time)
        if before and count:
            return time, count
        before = bool(count)
    return None


def _tried(longest: float) -> list[float]:
    """Return the sample times that are tried, in s, the longest first."""
    return [float(f"{longest * _NEXT**k:.2g}") for k in range(_TRIES)]


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
    sampling = replace(maps.sampling, sample_time=h, jitter=0.0)
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
