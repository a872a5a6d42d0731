"""The short text for people: what was found, in the terminal."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from pwatrack.arrays import amount, complex_text, number_text, up
from pwatrack.claims.bounds import SignalBounds
from pwatrack.claims.registry import rows
from pwatrack.claims.sampled import proved_as_sampled
from pwatrack.control.controller import Row
from pwatrack.control.words import sized
from pwatrack.report.figures import ensemble_measures, load_content, measures, norm_unit, percent
from pwatrack.report.parameters import largest_text, run_rows
from pwatrack.report.run_folder import INDEX, kept_files, read_index
from pwatrack.report.screen import Findings
from pwatrack.report.terminal import print_rows
from pwatrack.workflow.outcome import SimulatedLoop
from pwatrack.workflow.variation import EnsembleResult

_SIGNALS = 6  # that are printed of all that are tracked
_CELLS = 6  # of a part of the loop that are printed with the time in them: those with the most
_DEFAULTS = {  # of what varies
    "initial": "each state of the plant starts within the largest size that it has in the run above of where "
    "that run starts",
    "parameters": "each parameter that matters to the plant is within 5 % of its value; what is 0 stays 0",
}


def print_all(console: Console, found: Findings) -> None:
    """Say all that came out; above all what was required and is not so, how it went, and what to beware of."""
    print_rows(console, found.spec.name, _all_rows(found))
    if found.many:
        print_ensemble(console, found.many)


def _all_rows(found: Findings) -> Iterator[Row]:
    result = found.result
    yield from (("missed", each.text) for each in found.checked if not each.met)
    if result is not None:
        yield "simulated", f"{result.end:g} s: {result.outcome.text}"
    yield from (("warning", text) for text in found.assessment.warnings)
    yield from (("question", text) for text in found.assessment.questions)
    if met := [each.text for each in found.checked if each.met]:
        yield "required", f"{len(met)} of {len(found.checked)} met: {'; '.join(met)}"
    yield from found.not_looked_at
    if result is not None:
        yield from (("proofs", text) for text in _proof_texts(result))
    yield from rows(found.spec.words, found.controller)
    if found.largest is not None:
        yield "largest box", largest_text(found.largest)
    yield from (("margins", text) for text in _margin_texts(found))
    if result is not None:
        yield from _result_rows(result)
    yield from (("remark", remark) for remark in found.remarks)


def _proof_texts(result: SimulatedLoop) -> Iterator[str]:
    """Yield what of the loop that ran the proofs are not about."""
    if conditions := result.loop.beyond_the_proofs(result.spec.problem.units):
        sampled = proved_as_sampled(result.controller)
        but = "; of these, the sampling is in the proof of the sampled loop" * sampled
        yield f"are about the loop without: {'; '.join(conditions)}{but}"
    if result.controller.trajectory.growth is not None:
        yield "are about an x_d that is bounded and what was asked for; this one is not"


def _margin_texts(found: Findings) -> Iterator[str]:
    plant = found.controller.plant
    for one in found.assessment.margins:
        low, high = (number_text(v, ".3g") for v in one.gain)
        said = f"{plant.inputs[one.input]} in cell '{plant.cell_names[one.cell]}' by itself: stable with its gain "
        said += f"times {low} to {high}, "
        least = f"phase {np.degrees(one.phase):.3g}°, delay {one.delay:.3g} s, gain 1 up to {one.crossover:.3g} rad/s"
        yield f"{said}{least if one.crossover else 'any phase and delay, as its gain is below 1'}"


def _result_rows(result: SimulatedLoop) -> Iterator[Row]:
    figures, units, plant = measures(result), result.spec.problem.units, result.spec.problem.plant
    for name, figure in load_content(result).items():
        unit = figure["unit"]
        size, estimate = (f"{number_text(figure[what], '.6g')} {unit}".rstrip() for what in ("load", "estimate"))
        yield "estimate", f"of {name} at the end: {estimate}, and {size} acts"
    yield from (("uncertain", text) for text in run_rows(result))
    yield "modes", f"{amount(figures['mode_changes'], 'change')}, {amount(figures['joint_modes'], 'joint mode')}"
    yield from (("time in", text) for text in _share_texts(result.figures.time_share))
    off = f"{figures['final_observer_error']:.2e} {norm_unit(result.spec, plant.states)}".rstrip()
    yield "observer error", f"‖x − x̂‖ = {off} at the end"
    inputs = [f"|{u}| = {size:.4g} {units.get(u, '')}".rstrip() for u, size in figures["largest_input"].items()]
    yield "largest input", ", ".join(inputs) + result.figures.seen("largest_input")
    for name in plant.tracked_names[:_SIGNALS]:
        yield "step" if name in figures["overshoot"] else "settling", _step_text(figures, name, result)
    if (steady := result.steady_state) is not None:
        multipliers = ", ".join(complex_text(complex(value)) for value in steady.multipliers)
        said = f"of the generator, period {steady.t[-1]:.6g} s: Floquet multipliers {multipliers}; "
        yield "steady state", f"{said}after one period it misses itself by {steady.residual:.0e}"
    yield from _repair_rows(result)


def _share_texts(shares: Mapping[str, Mapping[str, float]]) -> Iterator[str]:
    """Yield how much of the time each part of the loop that changes cells is in each."""
    for part, cells in shares.items():
        most = sorted(cells.items(), key=lambda one: -one[1])
        said = ", ".join(f"{name} {percent(share)}" for name, share in most[:_CELLS])
        if len(cells) > 1:
            yield f"{part}: {said}" + f", {len(cells) - _CELLS:,} others" * (len(cells) > _CELLS)


def _step_text(figures: Mapping[str, Any], name: str, result: SimulatedLoop) -> str:
    """Say how an output went to where its reference rests, or when it settled on one that does not."""
    settled, band = figures["settling_time"][name], result.spec.scenario.bands.get(name)
    within = "2 %" if band is None else f"{band:g} {result.spec.problem.units.get(name, '')}".rstrip()
    said = f"{name} is within {within} for good after {settled:.4g} s"
    said = said if np.isfinite(settled) else f"{name} does not stay within {within}"
    if name not in figures["overshoot"]:
        return said
    rise = figures["rise_time"][name]
    risen = f"rises in {rise:.4g} s" if np.isfinite(rise) else "does not get to 90 %"
    return f"{said}, {risen}, goes beyond by {100 * figures['overshoot'][name]:.3g} %"


def _repair_rows(result: SimulatedLoop) -> Iterator[Row]:
    """Yield what the numbers that were given, where they had to be repaired, could change in this run."""
    repair, words = result.controller.plant.repair, result.spec.words
    if repair is None:
        return
    response, bounds = result.response, result.controller.claim(SignalBounds).acting
    acting = repair.disturbance(np.abs(response.x).max(axis=0), np.abs(response.u).max(axis=0))
    on = [(k, *words.cause(("disturbance", k))[1:]) for k in np.flatnonzero(acting).tolist()]
    most = ", ".join(f"{up(acting[k])} {unit} on {name}".replace("  ", " ") for k, name, unit in on)
    said = "with states and inputs no larger than at the samples here, the plant as it was given differs by at most"
    yield "repair", f"{said} {most}"
    for signal in bounds[0].sizes:
        if signal[0] in ("output", "state") and all(signal in bounds[k].sizes for k, _, _ in on):
            name, unit = words.signal(signal)
            total = float(sum(bounds[k].sizes[signal] * acting[k] for k, _, _ in on)) * (1 + 1e-12)
            size = f"{up(total)} {unit}".rstrip()
            yield "", f"which adds at most {size} to {sized(name)} in the end of the ideal loop"


def written(printing: Callable[[Console], None]) -> str:
    """Return what is printed, as a text of 100 columns."""
    file = StringIO()
    printing(Console(file=file, width=100, highlight=False, markup=False, emoji=False, color_system=None))
    return "\n".join(line.rstrip() for line in file.getvalue().splitlines()) + "\n"


def print_ensemble(console: Console, many: EnsembleResult) -> None:
    """Say how the members of an ensemble went."""
    figures, unit = ensemble_measures(many), norm_unit(many.nominal.spec, many.nominal.controller.error_names)
    print_rows(console, None, _ensemble_rows(many, figures))
    spread = Table(box=None, padding=(0, 2, 0, 0))
    spread.add_column("")
    for heading in ("median", "95 % below", "worst", "member"):
        spread.add_column(heading, justify="right")
    for name, label, form in (
        ("largest_error", f"largest error{f' ({unit})' if unit else ''}", ".2e"),
        ("final_error", "… in the last tenth of the time", ".2e"),
        *_signal_labels(many, figures),
        ("mode_changes", "mode changes", ".0f"),
    ):
        values = figures[name]
        shown = (values[key] for key in ("median", "95 %", "worst"))
        label += ", at the samples" * any(name.startswith(each) for each in figures["sampled"])
        spread.add_row(label, *("never" if v is None else format(v, form) for v in shown), str(values["member"]))
    console.print(spread)
    if figures["unresolved"]:
        console.print(f"In {amount(figures['unresolved'], 'member')} the state comes within rounding of a hyperplane.")


def _ensemble_rows(many: EnsembleResult, figures: Mapping[str, Any]) -> Iterator[Row]:
    count = amount(figures["members"], "member")
    yield "ensemble", f"{count} {many.variation.text}, seed {figures['seed']}"
    for part, region in figures["regions"].items():
        for kind, entries in region.items():
            ends = {name: [number_text(v, ".4g") for v in entry] for name, entry in entries.items()}
            form = "{1} ≤ {0} ≤ {2}" if kind == "box" else "{0} = {1} ± {2}"
            said = ", ".join(form.format(name, *pair) for name, pair in ends.items())
            yield "", f"{part}: {said or 'nothing varies'}"
    if not figures["given"]:
        yield "", f"the spec has no simulation.ensemble.{figures['over']}: {_DEFAULTS[figures['over']]}"
    yield "outcomes", ", ".join(f"{kind}: {count:,}" for kind, count in figures["outcomes"].items())
    if many.failed:
        yield "", many.failure


def _signal_labels(many: EnsembleResult, figures: Iterable[str]) -> Iterator[tuple[str, str, str]]:
    units = many.nominal.spec.problem.units
    for name in figures:
        if name.startswith("settling_time_"):
            yield name, f"settling time of {name.removeprefix('settling_time_')} (s)", ".4g"
        elif name.startswith("largest_input_"):
            signal = name.removeprefix("largest_input_")
            unit = units.get(signal, "")
            yield name, f"largest {signal}{f' ({unit})' if unit else ''}", ".4g"


def print_files(console: Console, folder: Path) -> None:
    """Say where the files of the run are, and which it found under its names and kept."""
    names = [INDEX, *(read_index(folder) or {"files": {}})["files"]]
    console.print(f"Results in {folder!s}/: {', '.join(sorted(names))}", soft_wrap=True)
    if kept := kept_files(folder):
        console.print(f"Kept, as no run had left them so: {', '.join(kept)}", soft_wrap=True)
