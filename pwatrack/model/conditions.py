"""How the loop that runs may differ from the one that the theorems are about."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pwatrack.arrays import Array, amount, number_text
from pwatrack.model.loads import Loads
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import Exosystem

_ROUNDED = 1e-12  # of a number of steps: what rounding of a limit that is a whole number of them explains

Method = Literal["corrected", "emulated", "euler"]


@dataclass(frozen=True, kw_only=True)
class Noise:
    """Independent normal noise on the outputs, drawn anew at every multiple of a sample time and held in between."""

    std: Array  # standard deviation of each output, (q,)
    sample_time: float  # in s
    seed: int = 1  # the same seed gives the same noise


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """The controller as a program that runs once in a sample time.

    "corrected" predicts, and corrects with what is measured in the tick in which it acts, with gains for this sample
    time. The others step the observer (18) on under the held y, in the cell it is in: "emulated" is exact for what the
    controller knows, "euler" is one explicit Euler step.
    """

    sample_time: float  # in s
    method: Method = "corrected"
    delay: int = 0  # how many sample times an input is put out after what it is computed from was measured
    jitter: float = 0.0  # by how much the time between two ticks may differ from the sample time, in s

    @property
    def corrects(self) -> bool:
        """Whether what is measured in a tick acts in it."""
        return self.method == "corrected"

    @property
    def ahead(self) -> int:
        """How many samples ahead the state is predicted that an input is for: it is late, and that is known."""
        return self.delay if self.corrects else 0


@dataclass(frozen=True, kw_only=True)
class Quanta:
    """What is put out and what is measured are whole multiples of a quantum, to the nearest; 0 for any value."""

    inputs: Array  # in the unit of the signal, (m,)
    outputs: Array  # (q,)

    def measured(self, y: Array) -> Array:
        """Return outputs as they are measured, (q,)."""
        fine = np.where(self.outputs > 0, self.outputs, 1.0)
        return np.where(self.outputs > 0, fine * np.floor(y / fine + 0.5), y)

    def within(self, limits: Array) -> Array:
        """Return the lowest and the highest multiples within limits of inputs, (m, 2), or these; infinite ones stay.

        Example:
            >>> Quanta(inputs=np.array([0.4]), outputs=np.zeros(0)).within(np.array([[-3.1, 3.2]])).round(9).tolist()
            [[-2.8, 3.2]]
        """
        step = np.where(self.inputs > 0, self.inputs, 1.0)[:, None]
        count = limits / step
        near = np.round(count)
        inside = np.column_stack([np.ceil(count[:, 0]), np.floor(count[:, 1])])
        with np.errstate(invalid="ignore"):  # of what has no limit
            whole = np.where(np.abs(count - near) <= _ROUNDED * np.abs(count), near, inside)
        return np.where((self.inputs > 0)[:, None] & np.isfinite(limits), step * whole, limits) + 0.0


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """What is not as the theorems assume. With nothing given, the loop is the nominal one.

    What is beyond a limit the actuator cuts off, and the observer knows it: it is given the input that the plant gets.
    """

    plant: PWASystem | None = None  # the plant that runs, where its parameters are not those of the design
    parameters: Mapping[str, float] | None = None  # the parameters that are changed in it
    limits: Array | None = None  # lower and upper limit of each input, (m, 2); whole steps, where it has some
    disturbance: Exosystem | None = None  # signals added to ẋ, one per state
    noise: Noise | None = None
    sampling: Sampling | None = None  # where the controller is sampled
    quanta: Quanta | None = None  # of inputs and measured outputs, of a controller that is sampled
    rates: Array | None = None  # by how much each input may change in a second, (m,); infinite for no limit
    pace: Array | None = None  # limits of the derivatives of y_d that a program makes of set-points, (tracked, 3 … 5)
    set_range: Array | None = None  # what these set-points may be, infinite where nothing is said, (tracked, 2)

    def texts(self, plant: PWASystem, units: Mapping[str, str] | None = None) -> list[str]:
        """Say what is not as the theorems assume, each in a few words; `plant` has the names of signals."""

        def of(name: str, text: str, unit_of: Callable[[str], str] = str) -> str:
            return f"{text} {unit_of((units or {}).get(name, ''))}".rstrip()

        said = []
        if self.parameters is not None:
            said.append(
                "other " + ", ".join(f"{name} = {number_text(value, 'g')}" for name, value in self.parameters.items())
            )
        if self.limits is not None:
            said += [
                f"{name} limited to {of(name, _range(low, high))}"
                for name, (low, high) in zip(plant.inputs, self.limits.tolist(), strict=True)
                if np.isfinite([low, high]).any()
            ]
        if self.disturbance is not None:
            hit = [name for name, row in zip(plant.states, self.disturbance.Q, strict=True) if row.any()]
            said.append("disturbance on " + ", ".join(f"d{name}/dt" for name in hit))
        if self.noise is not None:
            levels = zip(plant.outputs, self.noise.std.tolist(), strict=True)
            said.append("noise of " + ", ".join(f"{of(name, f'{std:g}')} on {name}" for name, std in levels if std))
        if self.sampling is not None:
            late, jitter = self.sampling.delay, self.sampling.jitter
            text = f"controller sampled every {self.sampling.sample_time:g} s ({self.sampling.method})"
            text += f", give or take {jitter:g} s" if jitter else ""
            said.append(text + (f", its output {amount(late, 'sample')} late" if late else ""))
        if self.quanta is not None:
            both = ((plant.outputs, self.quanta.outputs), (plant.inputs, self.quanta.inputs))
            sizes = [(name, size) for names, values in both for name, size in zip(names, values.tolist(), strict=True)]
            said += [f"{name} in steps of {of(name, f'{size:g}')}" for name, size in sizes if size]
        if self.rates is not None:
            rates = zip(plant.inputs, self.rates.tolist(), strict=True)
            said += [
                f"|d{name}/dt| at most {of(name, f'{rate:g}', per_second)}" for name, rate in rates if np.isfinite(rate)
            ]
        return said

    def beside(self, loads: Loads | None) -> "Conditions":
        """Return them without a disturbance that is such loads at all times."""
        known = loads is not None and self.disturbance is not None and loads.are(self.disturbance)
        return replace(self, disturbance=None) if known else self

    @property
    def another_plant(self) -> bool:
        """Whether another plant runs than the one of the design."""
        return self.plant is not None or self.parameters is not None

    @property
    def undisturbed(self) -> bool:
        """Whether there is no noise, disturbance or step that moves errors."""
        return self.noise is None and self.disturbance is None and self.quanta is None

    @property
    def nominal(self) -> bool:
        """Whether the loop is the one that the proofs are about."""
        return all(value is None for name, value in vars(self).items() if name not in ("pace", "set_range"))


def _range(low: float, high: float) -> str:
    if np.isfinite([low, high]).all():
        return f"[{number_text(low, 'g')}, {number_text(high, 'g')}]"
    return f"at least {number_text(low, 'g')}" if np.isfinite(low) else f"at most {number_text(high, 'g')}"


def per_second(unit: str) -> str:
    """Return the unit of a derivative.

    Example:
        >>> [per_second(unit) for unit in ("m", "m/s", "K/s", "N m", "m3/h", "")]
        ['m/s', 'm/s²', 'K/s²', 'N m/s', '(m3/h)/s', '']
    """
    if unit.endswith("/s"):
        return f"{unit}²"
    return unit and (f"({unit})/s" if "/" in unit else f"{unit}/s")


NOMINAL = Conditions()
