"""A program in single floats: by how much it rounds, as `rounding` asks it of any numbers."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pwatrack.arrays import Array
from pwatrack.control.program import SampledController
from pwatrack.export.fixed_point import most
from pwatrack.simulation.controller_arrays import memory, routine

_HALF = 2.0**-24  # of a number: what it is rounded by
_NAMES = {"normals": "H", "offsets": "h", "outputs": "C", "correction": "M", "feedforward": "u_ff", "gain": "K"}


@dataclass(frozen=True, kw_only=True)
class SingleFloats:
    """A program in single floats: 1 is 1."""

    program: SampledController  # in doubles
    started: tuple[ArrayLike, ArrayLike]  # what x̂ with ŝ, and η̂ start with
    spare: Mapping[str, Array]  # what numbers may be more than with real numbers

    one: ClassVar = 1.0  # what stands for 1 beside numbers
    largest: ClassVar = float(np.finfo(np.float32).max)  # number that counts

    @property
    def x(self) -> Array:
        """What 1 of (x̂, ŝ) is."""
        return np.ones(len(self.program.C[0]))

    @property
    def units(self) -> dict[str, Array]:
        """What 1 is."""
        return {name: np.ones(len(each)) for name, each in self.spare.items()}

    def off(self, table: str, sizes: Array) -> Array:
        """Return by how much rows of a table are off, rounding its entries and each product and sum."""
        exact = np.asarray(getattr(self.program, _NAMES.get(table, table)))
        count = exact.shape[-1] + len(self.program.K[0]) + 4  # of operations that a term goes through, at most
        return most((1 + count * 1.01) * _HALF * np.abs(exact), sizes)

    def kept(self, sizes: Array) -> Array:
        """Return by how much numbers of some sizes are rounded as they are read, or added to something that is kept."""
        return 2 * _HALF * sizes

    def along(self, program: SampledController, given: Array) -> dict[str, Array]:
        """Return cell_d, x_d, η̂ and w of a program after each tick, with no y."""
        return along(program, self.started, given, np.float32)


def along(
    program: SampledController, started: tuple[ArrayLike, ArrayLike], given: Array, real: type = np.float64
) -> dict[str, Array]:
    """Return cell_d, x_d, η̂ and w of a program in floats after each tick, with no y."""
    from pwatrack.simulation.kernel import tick

    arrays, kept, at = routine(program, real), memory(program, *started, real), program.places
    nothing: NDArray[Any] = np.zeros(program.sizes["q"], dtype=real)
    w: NDArray[Any] = given.astype(real)
    found: dict[str, list[NDArray[np.float64]]] = {"eta_hat": [], "w": [], "x_d": [], "cell_d": []}
    for each in w:
        tick(arrays, **kept, y=nothing, given=each)
        for name in ("eta_hat", "w", "x_d"):
            found[name].append(kept["memory"][at[name]].astype(np.float64))
        found["cell_d"].append(kept["counts"][0]["cell_d"])
    return {name: np.array(values) for name, values in found.items()}
