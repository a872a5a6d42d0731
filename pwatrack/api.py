"""What a program or a notebook calls: design, simulate and ensemble, and what they return. Files only where asked."""

from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pwatrack.arrays import Array, IntArray
from pwatrack.claims.bounds import SignalBounds
from pwatrack.claims.practical import Practical
from pwatrack.control.bounds import Bounds
from pwatrack.control.controller import ProvedController
from pwatrack.errors import InvalidSpec
from pwatrack.spec.spec import Spec
from pwatrack.workflow import pipeline, variation
from pwatrack.workflow.outcome import SimulatedLoop as Simulated
from pwatrack.workflow.variation import EnsembleResult, Over

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from pwatrack.export.controller import Controller as Program
    from pwatrack.report.notebook import Pictures
    from pwatrack.report.run_folder import Plots


@dataclass(frozen=True, kw_only=True, repr=False)
class Design(ProvedController):
    """A controller that is proved, and the problem that it is for: what `design` returns.

    u = K (x̂ − x_d) + u_ff, x̂' = A_i x̂ + b_i + B u + L (ŷ − y): (10), (18), (19).

    Attributes:
        spec: The problem.
        K, L: The gains, (m, n) and (n, q); with estimated loads L has a row for each of their states, too.
        plant, generator, proofs, guarantees, claims: As `ProvedController` of `pwatrack.control.controller` has them.

    Example:
        >>> from pwatrack import design, plant, problem
        >>> lag = plant(A=[[-1]], B=[[1]], C=[[1]])
        >>> made = design(problem(lag, reference="sin(t)", simulation={"duration": 10, "sample_time": 0.1}))
        >>> made.verdict, made.K.shape, made.L.shape, made.figures["rate"] > 1
        ('proved', (1, 1), (1, 1), True)
        >>> sorted(file.name for file in made.save("/tmp/pwatrack-lag").glob("*.json"))[:3]
        ['bounds.json', 'certificate.json', 'controller.json']
    """

    spec: Spec

    def __repr__(self) -> str:
        return f"<design of {self.spec.name!r}: {self.verdict}, rate {self.figures['rate']:.4g} 1/s>"

    def _repr_html_(self) -> str:
        return _html(self)

    @staticmethod
    def of(spec: Spec, controller: ProvedController) -> "Design":
        """Return a controller with the problem that it is for."""
        return controller if isinstance(controller, Design) else Design(**_parts(controller), spec=spec)

    @property
    def bounds(self) -> tuple[Bounds, ...]:
        """What a disturbance of each state equation and the noise of each sensor can do to each signal."""
        return self.claim(SignalBounds).acting

    @property
    def starts(self) -> tuple[Bounds, ...]:
        """What each entry of the start, of x − x_d, of x̂ − x and of the estimates of loads, can do to each signal."""
        return self.claim(SignalBounds).starts

    @property
    def verdict(self) -> str:
        """What is proved: "proved", or where cells are merged "practical"; whatever else is a refusal, and raised."""
        return "practical" if self.claims_of(Practical) else "proved"

    @property
    def figures(self) -> dict[str, float]:
        """Sizes of the gains and what is proved of them, by name, as in run.json: rates in 1/s."""
        from pwatrack.claims.decay import gain_figures

        return gain_figures(self)

    @property
    def certificate(self) -> dict[str, Any]:
        """The plant in exact numbers and all proofs, as in certificate.json: `pwatrack verify` checks these."""
        from pwatrack.report.certificate import design_certificate

        return design_certificate(self.spec, self)

    @property
    def controller(self) -> "Program":
        """The controller as a program that runs step by step: bit for bit what `simulate` runs and is exported.

        Raises:
            InvalidSpec: If the problem has no sample time: `simulation["controller"]["sample_time"]`.
        """
        from pwatrack.export.controller import Controller as Program
        from pwatrack.export.stored import parsed
        from pwatrack.report.controller import known_start, written

        found = written(self.spec, self, known_start(self.spec, self)).controller
        return Program(parsed(found, self.spec.path))

    def to_control(self, part: Literal["plant", "controller", "loop"] = "loop") -> Any:
        """Return a system of python-control in continuous time, as the theorems have it: no limits, no sampling.

        `params["start"]` is its state at t = 0, as `simulate` has it without noise, and
        `params["units"]` the units of its signals. `controller.to_control()` is the controller that is sampled.

        Args:
            part: The plant, the controller with its reference inside, or both connected.

        Raises:
            InvalidSpec: If python-control is not installed.
            PwatrackError: What `simulate` raises where it cannot start.
        """
        from pwatrack.export.python_control import controller_system, loop_system, plant_system
        from pwatrack.export.source import prefix
        from pwatrack.model.conditions import NOMINAL
        from pwatrack.simulation.closed_loop import closed_loop

        spec, name = self.spec, prefix(self.spec.name)
        units = {label: str(unit) for label, unit in spec.problem.units.items()}
        nominal = closed_loop(self, NOMINAL)
        with spec.located():
            start, _ = pipeline.start_of(spec, nominal)
        plant = plant_system(self, f"{name}_plant", units, start[nominal.at.x].tolist())
        if part == "plant":
            return plant
        own = [*start[nominal.at.observer].tolist(), *start[nominal.at.eta_hat].tolist()]
        made = controller_system(self, f"{name}_controller", units, own)
        return made if part == "controller" else loop_system(plant, made, name)

    def save(self, folder: str | Path) -> Path:
        """Write the files of `pwatrack design` into a folder, which is made, and return it.

        Raises:
            InvalidSpec: If the folder cannot be written; nothing is changed then.
        """
        from pwatrack.report.files import write_design

        return write_design(self.spec, self, folder)


@dataclass(frozen=True, kw_only=True, repr=False)
class Result(Simulated):
    """A closed loop that was simulated: what `simulate` returns.

    Attributes:
        spec, controller: The problem, and the design.
        response: All signals: those below, and with loads `estimates` and `loads`. Of a run with more than a few
            hundred thousand samples only every so many-th is kept; `figures` are of all, and so is what `save` writes.
        figures: What was measured: final_error, largest_error, largest_input, settling_time, overshoot, …
        outcome: How the run ended, in a word (`kind`) and in a sentence (`text`).

    Example:
        >>> from pwatrack import plant, problem, simulate
        >>> lag = plant(A=[[-1]], B=[[1]], C=[[1]], units={"y": "m"})
        >>> run = simulate(problem(lag, reference="sin(t)", simulation={"duration": 10, "sample_time": 0.1}))
        >>> run.verdict, run.t.shape, run.x.shape, run.u.shape
        ('tracks', (101,), (101, 1), (101, 1))
        >>> run.names["y"], run.units, bool(abs(run.e[-1]) < 1e-3)
        (('y',), {'y': 'm'}, True)
    """

    controller: Design

    def __repr__(self) -> str:
        return f"<run of {self.spec.name!r}: {self.outcome.text}>"

    def _repr_html_(self) -> str:
        return _html(self.controller, self)

    @property
    def verdict(self) -> str:
        """How the run ended: "tracks", "within its bound", "off", "grows" or "above its bound"; see `outcome.text`."""
        return self.outcome.kind

    @property
    def t(self) -> Array:
        """Sample times in s, (K,)."""
        return self.response.t

    @property
    def x(self) -> Array:
        """States of the plant, (K, n)."""
        return self.response.x

    @property
    def x_hat(self) -> Array:
        """What the observer takes them for, (K, n)."""
        return self.response.x_hat

    @property
    def x_d(self) -> Array:
        """Where they should be, (K, n)."""
        return self.response.x_d

    @property
    def y(self) -> Array:
        """Measured outputs without their noise, (K, q)."""
        return self.response.y

    @property
    def y_d(self) -> Array:
        """What they are at x_d, (K, q)."""
        return self.response.y_d

    @property
    def u(self) -> Array:
        """Inputs, (K, m)."""
        return self.response.u

    @property
    def u_ff(self) -> Array:
        """Their feedforward parts, (K, m)."""
        return self.response.u_ff

    @property
    def e(self) -> Array:
        """What goes to 0: y − y_d of what is tracked, (K, p), or x − x_d for state tracking, (K, n)."""
        return self.response.tracking_error

    @property
    def names(self) -> dict[str, tuple[str, ...]]:
        """Names of the columns of x, y, u and e; those of x_hat, x_d, y_d and u_ff are of the same signals."""
        plant = self.spec.problem.plant
        return {"x": plant.states, "y": plant.outputs, "u": plant.inputs, "e": self.controller.error_names}

    @property
    def units(self) -> Mapping[str, str]:
        """Units by name of a state, input or output, where they were given."""
        return self.spec.problem.units

    @property
    def signals(self) -> dict[str, Array]:
        """Every signal by its name in trace.csv, (K,) each: t, z, z_hat, z_d and so on."""
        from pwatrack.report.files import signal_columns

        return {
            name: values if values.ndim == 1 else values[:, k]
            for names, values in signal_columns(self, self.response)
            for k, name in enumerate(names)
        }

    def save(self, folder: str | Path, *, plots: "Plots" = "none") -> Path:
        """Write the files of `pwatrack simulate` into a folder, which is made, and return it.

        Args:
            folder: An earlier run in it is replaced, other files stay.
            plots: Whether pictures are drawn: "all", "none", or "failed" for a run that does not end well.

        Raises:
            InvalidSpec: If the folder cannot be written; nothing is changed then.
        """
        from pwatrack.report.files import write_result

        return write_result(self, folder, plots=plots)

    def to_dataframe(self) -> Any:
        """Return `signals` as a table of pandas by time in s, a column each, with `attrs["units"]`.

        Raises:
            InvalidSpec: If pandas is not installed.
        """
        from pwatrack.report.notebook import frame

        table = frame(self.signals, "t")
        table.attrs["units"] = dict(self.units)
        return table

    def plot(self) -> "Pictures":
        """Return the pictures of a run folder as figures of matplotlib, by name, such as "tracking_error".

        A notebook shows all of them where they are left on the last line of a cell, or one where it is.
        """
        from pwatrack.report.notebook import Pictures
        from pwatrack.report.plots.pictures import pictures

        return Pictures.of(pictures(self))


@dataclass(frozen=True, kw_only=True, repr=False)
class Many(EnsembleResult):
    """A loop in many variations: what `ensemble` returns.

    Attributes:
        nominal: The run that was varied.
        outcomes: How each member ended, (M,).
        figures: What was measured of each, (M,).
        ensemble: What was kept of them.
    """

    def __repr__(self) -> str:
        said = self.failure or f"{len(self.outcomes):,} members {self.variation.text}, none fails"
        return f"<ensemble of {self.nominal.spec.name!r}: {said}>"

    def _repr_html_(self) -> str:
        return _html(Design.of(self.nominal.spec, self.nominal.controller), self.nominal, self)

    def to_dataframe(self) -> Any:
        """Return `table` as a table of pandas, a row for each member, from 0.

        Raises:
            InvalidSpec: If pandas is not installed.
        """
        from pwatrack.report.notebook import frame

        return frame(self.table)

    @property
    def t(self) -> Array:
        """Sample times in s, (K,)."""
        return self.ensemble.t

    @property
    def e(self) -> Array:
        """The norm of each member's tracking error, in sizes where it has several entries, (M, K)."""
        return self.ensemble.error

    @property
    def table(self) -> dict[str, Array | IntArray]:
        """What was drawn and what was measured of each member, by name, as in ensemble.csv, (M,) each."""
        from pwatrack.report.figures import member_figures

        return dict(self.variation.values) | member_figures(self)

    def save(self, folder: str | Path, *, plots: "Plots" = "none") -> Path:
        """Write the files of the nominal run and of the ensemble: see `Result.save`."""
        from pwatrack.report.files import write_result

        return write_result(self.nominal, folder, many=self, plots=plots)

    def plot(self) -> "Figure":
        """Return a figure of matplotlib: how the tracking errors spread over time."""
        from pwatrack.report.notebook import Pictures, spread

        return Pictures.of({"ensemble": lambda: spread(self)})["ensemble"]


def design(spec: Spec, *, growing: bool = False) -> Design:
    """Find gains and prove that the closed loop tracks: Theorem 2 or 3, or with cells merged practically.

    Args:
        spec: What `problem` or `load_spec` returned.
        growing: Whether to design also where x_d, the response to given inputs, is seen to grow without bound: the
            proofs hold, and the theorem does not speak of it.

    Raises:
        OutsideTheory: If the plant is not of form (11), or the reference is not bounded, smooth or realisable, or takes
            more than the limits of the inputs.
        Infeasible: If (8), (9) or (17) is proved to have no solution; `evidence` is the proof.
        Undecided: If neither is proved.
        CheckFailed: If x_d, the response to given inputs, is seen to grow without bound, unless `growing`.

    Example:
        >>> from pwatrack import load_spec
        >>> made = design(load_spec("specs/two_mass_backlash.yaml"))
        >>> made.verdict, made.generator.shift.round(12).tolist()
        ('proved', [[1.0, 0.0], [0.0, 0.0]])
    """
    _check("design", spec, Spec)
    return Design.of(spec, pipeline.design(spec, growing=growing))


def simulate(asked: Spec | Design, controller: ProvedController | None = None) -> Result:
    """Run the closed loop from event to event, exactly to rounding.

    Args:
        asked: A design, or a problem, for which one is made first if none is given; then also where x_d grows without
            bound, which the outcome says.
        controller: A design for the same plant, for another scenario or reference than its own.

    Raises:
        PwatrackError: Whatever `design` raises; InvalidSpec if the design is for another plant, a start does not fit
            the generator, or a long run the disk; CheckFailed if the loop chatters.

    Example:
        >>> from pwatrack import load_spec
        >>> run = simulate(load_spec("specs/two_mass_paper_gains.yaml"))
        >>> run.verdict, run.final_error < 1e-3
        ('tracks', True)
    """
    _check("simulate", asked, Spec, Design)
    spec = asked.spec if isinstance(asked, Design) else asked
    known = controller or (asked if isinstance(asked, Design) else None)
    if known is not None:
        pipeline.check_plant(spec, known.running)
    run = pipeline.simulate(spec, known)
    return Result(**_parts(run) | {"controller": Design.of(run.spec, run.controller)})


def ensemble(
    result: Simulated,
    count: int,
    *,
    over: Over = "initial",
    seed: int = 1,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Callable[[int], object] | None = None,
) -> Many:
    """Run a simulated closed loop again in many variations, each as exactly as `simulate` does.

    Args:
        result: What `simulate` returned.
        count: How many members; the first members of a larger ensemble are the same.
        over: What differs: the "initial" states, of two of them alone in a "plane", "parameters" of the plant, or the
            seed of the "noise"; within what the problem gives, else within what `pwatrack.workflow.variation` names.
        seed: Of the random numbers, at least 0.
        workers: Threads; None for one on each core. The result does not depend on it.
        executor: Where members run instead of threads here, `workers` at a time.
        progress: Called with the number of members done, now and then.

    Raises:
        InvalidSpec: If there is too much to keep, nothing to vary, or a region does not fit the generator.
        OutsideTheory: If the plant of a member is not of class (1).
        CheckFailed: If a member chatters or grows without bound.

    Example:
        >>> from pwatrack import load_spec
        >>> many = ensemble(simulate(load_spec("specs/two_mass_paper_gains.yaml")), 4)
        >>> many.e.shape, bool(many.table["final_error"].max() < 1e-3), list(many.table)[:2]
        ((4, 6001), True, ['z1', 'v1'])
    """
    _check("ensemble", result, Simulated)
    found = variation.ensemble(
        result, count, over=over, seed=seed, workers=workers, executor=executor, progress=progress
    )
    return Many(**_parts(found))


def _html(design: Design, result: Simulated | None = None, many: Many | None = None) -> str:
    from pwatrack.report.notebook import html
    from pwatrack.report.screen import Findings

    return html(Findings(spec=design.spec, controller=design, result=result, many=many))


def _check(function: str, value: object, *kinds: type) -> None:
    if not isinstance(value, kinds):
        wanted = {Spec: "problem or load_spec", Design: "design", Simulated: "simulate"}
        found = f"{function}: a value of type {type(value).__name__} is none of those that it takes"
        said = " or ".join(wanted[kind] for kind in kinds)
        raise InvalidSpec(found, subject=None, hint=f"it takes what {said} returned")


def _parts(made: Any) -> dict[str, Any]:
    return {field.name: getattr(made, field.name) for field in fields(made)}
