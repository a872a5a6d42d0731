"""What one sample does to errors in each cell by itself, and at which sample times that lets them grow."""

from dataclasses import dataclass, replace
from decimal import ROUND_FLOOR, Context

import numpy as np
from scipy.linalg import expm

from pwatrack.arrays import Array
from pwatrack.control.controller import ProvedController
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
        f"'{controller.plant.cell_names[cell]}': as long as it stays there, one sample multiplies what is off by "
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
