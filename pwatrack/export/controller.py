"""A controller that runs, step by step, in the arithmetic of `docs/arithmetic.md`."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pwatrack.arrays import Array, amount
from pwatrack.errors import InvalidSpec
from pwatrack.export.schema import ControllerFile
from pwatrack.export.source import prefix
from pwatrack.export.stored import read, runs
from pwatrack.simulation.controller_arrays import memory, routine

_RAN = 0  # status before any step, and after one that was no fault: see `kernel.tick`


class Controller:
    """A controller of controller.json that runs once in a sample time.

    In every bit of u and of its state it is what `simulate` runs and what `export c` writes.

    Attributes:
        file: All of controller.json.
        status: Of the last step: 0; 1 where the reference has ended and stays; −1 where a number was not finite, and
            nothing was changed.

    Args:
        file: A file with a program.
        single: Whether to compute in single floats.

    Example:
        >>> from pwatrack import design, load_spec
        >>> from pwatrack.report.files import write_design
        >>> spec = load_spec("specs/two_mass_machine.yaml")
        >>> folder = write_design(spec, design(spec), "/tmp/pwatrack-controller")
        >>> controller = Controller.load(folder / "controller.json")
        >>> controller.step([0.1]).shape, controller.cells
        ((1,), ('gap', 'upper spring'))
    """

    def __init__(self, file: ControllerFile, *, single: bool = False) -> None:
        if file.program is None:
            raise InvalidSpec(
                f"the controller '{file.name}' has no sample time, so no steps",
                hint="design it with a sample time: simulation.controller.sample_time",
            )
        self.file = file
        self._real: Any = np.float32 if single else np.float64
        self._programs = {given: runs(file, given=given, single=single) for given in (False, True)}
        self._given: bool | None = None
        self.reset()

    @classmethod
    def load(cls, path: str | Path, *, single: bool = False) -> "Controller":
        """Return the controller of a file.

        Raises:
            InvalidSpec: If the file cannot be read, is of another version, was changed, or has no sample time.
        """
        return cls(read(Path(path)), single=single)

    @property
    def K(self) -> Array:
        """Controller gain that it runs with, (m, n)."""
        return self._programs[False].K

    @property
    def M(self) -> Array:
        """What a missed measurement corrects, (N, q); (0, q) where nothing is corrected."""
        return self._programs[False].M

    @property
    def E(self) -> Array:
        """What x̂ and ŝ are moved by for what limits cut off an input, (N, m); (0, m) where they are not."""
        return self._programs[False].E

    @property
    def L(self) -> Array:
        """Observer gain of the design in continuous time, (N, q)."""
        return np.array(self.file.L)

    @property
    def sample_time(self) -> float:
        """In s."""
        return self._programs[False].sampling.sample_time

    @property
    def cells(self) -> tuple[str, str]:
        """The cells of x̂ and of x_d, at the last step.

        Where x_d has other cells than x̂, since cells are merged, they are counted: "1", "2", …
        """
        names, kept = self.file.plant.cells, self._kept["counts"][0]
        i, j = int(kept["cell"]), int(kept["cell_d"])
        same = len(self._programs[bool(self._given)].sides) == len(names)
        return names[i], names[j] if same else str(j + 1)

    def state(self, name: str) -> NDArray[Any]:
        """Return a part of the state: y, u, x_hat, s_hat, eta_hat, w, late, before, wanted or x_d."""
        places = self._programs[bool(self._given)].places
        if name not in places:
            raise InvalidSpec(f"{name!r} is no part of the state: it has {', '.join(places)}", subject=None)
        return self._kept["memory"][places[name]].copy()

    def reset(self, x_hat: ArrayLike | None = None, eta_hat: ArrayLike | None = None) -> None:
        """Start anew: from what the file says, where nothing else is given.

        Args:
            x_hat: x̂(0) and ŝ(0), (N,).
            eta_hat: η̂(0), (p,).
        """
        known = self.file.started
        x_hat, eta_hat = known[0] if x_hat is None else x_hat, known[1] if eta_hat is None else eta_hat
        self._start = np.array(x_hat, dtype=np.float64), np.array(eta_hat, dtype=np.float64)
        self._given, self.status = None, _RAN
        self._prepare(False)

    def step(self, y: ArrayLike, y_d: ArrayLike | None = None) -> NDArray[Any]:
        """Run once, and return the inputs to put out now, (m,).

        Args:
            y: What is measured, (q,).
            y_d: The reference and its derivatives, or set-points alone: what `file.program.outside.given`
                names; None for the one that is stored. From a reset on all steps have one, or none has.

        Raises:
            ValueError: If a length is wrong, or a reference is given in some steps only.
        """
        from pwatrack.simulation.kernel import tick

        given = y_d is not None
        if self._given is None:
            self._prepare(given)
            self._given = given
        elif self._given != given:
            raise ValueError("the reference is given in some steps and not in others: reset in between")
        q, entries = self._programs[given].sizes["q"], len(self._programs[given].given)
        measured, wanted = (np.array(v if v is not None else [], dtype=self._real).reshape(-1) for v in (y, y_d))
        if len(measured) != q or (given and len(wanted) != entries):
            more = f" and {entries} entr{'y' if entries == 1 else 'ies'} of the reference" * given
            raise ValueError(f"what is expected: {amount(q, 'output')}{more}")
        self.status = int(tick(self._routine, **self._kept, y=measured, given=wanted))
        return self.state("u")

    def to_control(self, *, given: bool = False) -> Any:
        """Return it as a system of python-control in discrete time, from what is measured to u.

        Its step is this one, in every bit. `params["start"]` is its state at the start, from which it also runs where
        none is given, and `params["units"]` the units of its signals: `control.input_output_response(system, T, y)`.

        Args:
            given: Whether the reference comes from outside: then its entries are inputs behind what is measured,
                each with "_ref" behind its name.

        Raises:
            InvalidSpec: If python-control is not installed.
        """
        from pwatrack.export.python_control import sampled_system

        plant, of = self.file.plant, self._programs[given]
        inputs = [*plant.outputs, *(f"{w}_ref" for w in of.given)]
        labels = {"name": prefix(self.file.name), "inputs": inputs, "outputs": plant.inputs}
        return sampled_system(of, self.file.started, self._real, plant.units, **labels)

    def _prepare(self, given: bool) -> None:
        program, real = self._programs[given], self._real
        self._routine, self._kept = routine(program, real), memory(program, *self._start, real)
