"""What a spec requires of its run, held against the figures that came out."""

from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import ceil, inf, isfinite
from typing import Any

from pwatrack.arrays import up
from pwatrack.claims.decay import gain_figures
from pwatrack.control.controller import ProvedController
from pwatrack.errors import InvalidSpec, Problem
from pwatrack.model.pwa import PWASystem
from pwatrack.report.figures import measures, norm_unit
from pwatrack.simulation.figures import ERRORS, Figures
from pwatrack.simulation.margins import margin_figures
from pwatrack.spec.requirement import Requirement
from pwatrack.spec.spec import Spec
from pwatrack.workflow.outcome import SimulatedLoop
from pwatrack.workflow.variation import EnsembleResult

_NO_REST = "the reference does not come to rest before the last tenth of the run, or the output starts there"
_NO_MARGIN = "no input changes anything, or to look for it in all cells would take long"
_NO_PERIOD = "no periodic steady state of a trajectory generator was looked for"
_ABSENT = {  # why a run has no such figure
    "rise_time": _NO_REST,
    "overshoot": _NO_REST,
    "generator_rate": "there is no trajectory generator, or it has no state",
    "gain_margin": _NO_MARGIN,
    "phase_margin": _NO_MARGIN,
    "delay_margin": _NO_MARGIN,
    "largest_multiplier": _NO_PERIOD,
    "steady_state_residual": _NO_PERIOD,
}


@dataclass(frozen=True, kw_only=True)
class Checked:
    """A requirement of a signal, and what came out, also in words."""

    requirement: Requirement
    signal: str  # '' where the figure is not one of a signal
    label: str  # of the figure
    unit: str
    members: tuple[float, ...]  # the figure of each member of an ensemble
    found: float  # the figure, of an ensemble that of its worst member; infinite for a time that never comes
    met: bool
    text: str
    short: str  # the text for the first screen

    @property
    def scale(self) -> float:
        """By what its figures are multiplied to be in its unit: shares are said in percent."""
        return _scale(self.requirement)

    @property
    def content(self) -> dict[str, Any]:
        """What run.json says of it; a time that never comes is None."""
        asked = self.requirement
        return {
            "figure": asked.figure,
            "signal": self.signal or None,
            "found": self.found if isfinite(self.found) else None,
            asked.quantity.best: asked.limit,
            "members": asked.share,
            "met": self.met,
            "said": self.text,
        }


def required(
    spec: Spec, controller: ProvedController, result: SimulatedLoop | None = None, many: EnsembleResult | None = None
) -> tuple[Checked, ...]:
    """Hold what a spec requires against what came out; what is about a run or an ensemble that there is none of waits.

    Raises InvalidSpec for a figure that this run has not, as the overshoot over a reference that never comes to rest.

    Example:
        >>> from dataclasses import replace
        >>> from pwatrack import design, load_spec
        >>> spec = load_spec("specs/two_mass_paper_gains.yaml")
        >>> wish = Requirement(figure="norm_K", signal=None, limit=1.0, share=None, subject=("require", "norm_K"))
        >>> [checked.text for checked in required(replace(spec, requirements=(wish,)), design(spec))]
        ['norm_K: 1.98, at most 1 required']
    """
    found, problems = list[Checked](), list[Problem]()
    plant, of_design = spec.problem.plant, gain_figures(controller)
    if any(asked.figure.endswith("_margin") for asked in spec.requirements):
        of_design |= margin_figures(controller)
    for asked in spec.requirements:
        members: Sequence[Mapping[str, Any]] = ()
        if asked.share is not None:
            members = [_with_shares(plant, vars(figures), figures) for figures in many.figures] if many else ()
        elif asked.quantity.of == "design":
            members = [of_design]
        elif result is not None:
            own = measures(result) | {"sampled": result.figures.sampled}
            members = [_with_shares(plant, own, result.figures)]
        if not members:
            continue
        values = dict(_values(asked, members))
        sampled = {k for k, figures in enumerate(members) if asked.figure in figures.get("sampled", ())}
        if not values:
            signal = f" of {asked.signal}" if asked.signal else ""
            message = f"{'.'.join(map(str, asked.subject))}: there is no {asked.figure}{signal}"
            message += f": {_ABSENT[asked.figure]}" if asked.figure in _ABSENT else ""
            problems.append(Problem(message=message, subject=asked.subject, hint="leave it out"))
        rounded = result.outcome.rounded if result is not None and asked.figure in ERRORS and not many else 0.0
        for signal, each in values.items():
            unit = _unit(spec, controller, asked, signal)
            found.append(_checked(asked, signal, each, unit, sampled, rounded if rounded > asked.limit else 0.0))
    if problems:
        with spec.located():
            raise InvalidSpec(*problems)
    return tuple(found)


def _with_shares(plant: PWASystem, figures: Mapping[str, Any], found: Figures) -> dict[str, Any]:
    """Return figures with the share of the time in each cell of a plant, and in what each of its elements is."""
    cells, shares = found.time_share.get("plant", {}), dict[str, float]()
    for cell in dict.fromkeys(plant.cell_names):
        for part in {cell, *cell.split(", ")}:
            shares[part] = shares.get(part, 0.0) + cells.get(cell, 0.0)
    return {**figures, "time_share": shares}


def _values(asked: Requirement, members: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, dict[int, float]]]:
    """Yield for each signal that is asked for, '' for none, the figure of each member that has it."""
    if asked.quantity.per is None:
        each = {k: float(figures[asked.figure]) for k, figures in enumerate(members) if asked.figure in figures}
        yield from [("", each)] if each else []
        return
    names = dict.fromkeys(name for figures in members for name in figures[asked.figure])
    for name in names if asked.signal is None else [asked.signal] if asked.signal in names else []:
        found = ((k, figures[asked.figure]) for k, figures in enumerate(members))
        yield name, {k: values[name] for k, values in found if name in values}


def _checked(
    asked: Requirement, signal: str, values: Mapping[int, float], unit: str, sampled: Container[int], rounded: float
) -> Checked:
    """Hold the figure of each member against what is asked; one at the samples alone keeps no limit."""
    best = asked.quantity.best
    worst = max(values, key=lambda k: values[k] if best == "at most" else -values[k])
    kept = sum(asked.met(value) and k not in sampled for k, value in values.items())
    of_range = asked.quantity.per == "limited"
    label = f"{asked.figure if of_range else asked.subject[-1]} of {signal}" if signal else asked.figure
    scale = _scale(asked)
    came, limit = _texts(scale * values[worst], scale * asked.limit, unit, never=best == "at most")
    came += " at the samples, not known between them" * (worst in sampled)
    came += f", known to {up(rounded)} {unit}".rstrip() * (rounded > 0)
    if asked.share is None:
        text, met = f"{label}: {came}, {best} {limit} required", kept == 1
        short = f"{label} {came} ({best} {limit})"
    else:
        least = ceil(asked.share * len(values) * (1 - 1e-12))
        count = f"{kept:,} of {len(values):,} members, in {least:,} required"
        text, met = f"{label}: {best} {limit} in {count}; worst {came}, member {worst + 1}", kept >= least
        short = f"{label} {came} at worst ({best} {limit})"
    members = tuple(values.values()) if asked.share is not None else ()
    return Checked(
        requirement=asked,
        signal=signal,
        label=label,
        unit=unit,
        members=members,
        found=values[worst],
        met=met,
        text=text,
        short=short,
    )


def _unit(spec: Spec, controller: ProvedController, asked: Requirement, signal: str) -> str:
    quantity = asked.quantity
    if quantity.share:
        return "%"
    if quantity.unit == "of the signal":
        return spec.problem.units.get(signal, "")
    if quantity.unit == "of the error":
        return norm_unit(spec, controller.error_names)
    return quantity.unit


def _scale(asked: Requirement) -> float:
    return 100.0 if asked.quantity.share else 1.0


def _texts(value: float, limit: float, unit: str, *, never: bool) -> tuple[str, str]:
    """Return two numbers with their unit, and enough digits to tell them apart; `never`: of what is best small."""
    for digits in (4, 6, 9, 17):
        came, asked = (format(v, f".{digits}g") for v in (value, limit))
        if came != asked or value == limit:
            break
    endless = "never" if never else "without end"
    return endless if value == inf else f"{came} {unit}".rstrip(), f"{asked} {unit}".rstrip()
