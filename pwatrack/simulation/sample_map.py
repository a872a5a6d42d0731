"""What one sample does to errors in each cell by itself, and at which sample times that lets them grow."""

from dataclasses import dataclass, field, replace
from decimal import ROUND_FLOOR, Context

import numpy as np
from scipy.linalg import expm

from pwatrack.arrays import Array
from pwatrack.control.controller import ProvedController
from pwatrack.control.program import SampledController, program
from pwatrack.errors import InvalidSpec
from pwatrack.model.conditions import Conditions, Sampling
from pwatrack.model.pwa import PWASystem

_HALVINGS = 40  # of a sample time that is too long, until one is found
_BISECTIONS = 12  # of a sample time: to a part in 4,000
_SHORTER = 16  # times below one that are looked at too
_SURE = 1 + 1e-9  # the eigenvalues of a map are known to less


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
    longest = maps.longest(sampling.sample_time)  # none: however short, it is unstable; that is seen when it runs
    message = (
        f"sampled every {sampling.sample_time:g} s, the loop is unstable in cell "
        f"'{controller.plant.cell_names[cell]}': as long as it stays there, one sample multiplies an error by "
        f"{radius:.4g} in the long run"
    )
    return None if longest is None else (message, maps, longest)


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
        stepped = of.observer[cell][:, -N - m - 1 : -1]  # on (u, x̂, ŝ)
        if self.sampling.corrects:
            once = np.vstack([np.eye(m, m + N), stepped])
            stepped = np.linalg.matrix_power(once, of.substeps)[m:]
        else:
            of_y = of.observer[cell][:, : of.sizes["q"]] @ self.plant.C
        of_u, seen = stepped[:, :m], stepped[:, m:]
        law = self._law(cell, of)
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

    def _law(self, cell: int, of: SampledController) -> Array:
        """Return the rows of u on x̂ and, where loads are estimated, on their estimates ŝ and on η̂."""
        if self.controller.plant.loads is None:
            return of.K
        known = of.sizes["N"] - of.sizes["n"] + of.sizes["p"]
        return np.hstack([of.K, of.u_ff[cell][:, :known] - of.K @ of.x_d[cell][:, :known]])

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
