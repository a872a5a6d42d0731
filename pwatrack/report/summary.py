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
from pwatrack.claims.sampled import SampledLoop
from pwatrack.control.words import sized
from pwatrack.report.figures import (
    design_remarks,
    ensemble_measures,
    load_content,
    measures,
    member_figures,
    norm_unit,
    percent,
)
from pwatrack.report.parameters import largest_text, run_rows
from pwatrack.report.run_folder import INDEX, kept_files, read_index
from pwatrack.report.screen import Findings
from pwatrack.report.terminal import titled
from pwatrack.workflow.outcome import SimulatedLoop
from pwatrack.workflow.variation import EnsembleResult

_SIGNALS = 6  # that are printed of all that are tracked
_CELLS = 6  # of a part of the loop that are printed with the time in them: those with the most


def print_all(console: Console, found: Findings) -> None:
    """Say all that came out."""
    if found.result is None:
        print_design(console, found)
    else:
        print_result(console, found)
    if found.many:
        print_ensemble(console, found.many)


def print_design(console: Console, found: Findings) -> None:
    """Say what was proved and the gains; above all what was required and is not so, and what to beware of."""
    table = titled(found.spec.name)
    _outcome_rows(table, found)
    _add(table, rows(found.spec.words, found.controller))
    if found.largest is not None:
        table.add_row("largest box", largest_text(found.largest))
    _margin_rows(table, found)
    _add(table, (("remark", remark) for remark in design_remarks(found.spec, found.controller)))
    console.print(table)


def _add(table: Table, found: Iterable[tuple[str, str]]) -> None:
    for row in found:
        table.add_row(*row)


def _outcome_rows(table: Table, found: Findings) -> None:
    """Say what is missed, how a simulation went, what to beware of, and what is met."""
    _add(table, (("missed", each.text) for each in found.checked if not each.met))
    if found.result is not None:
        table.add_row("simulated", f"{found.result.end:g} s: {found.result.outcome.text}")
    _add(table, (("warning", text) for text in found.assessment.warnings))
    _add(table, (("question", text) for text in found.assessment.questions))
    if met := [each.text for each in found.checked if each.met]:
        table.add_row("required", f"{len(met)} of {len(found.checked)} met: {'; '.join(met)}")
    _add(table, found.not_looked_at)


def _margin_rows(table: Table, found: Findings) -> None:
    """Say the margins of each cell by itself."""
    plant = found.controller.plant
    for one in found.assessment.margins:
        low, high = (number_text(v, ".3g") for v in one.gain)
        said = f"{plant.inputs[one.input]} in cell '{plant.cell_names[one.cell]}' by itself: stable with its gain "
        said += f"times {low} to {high}, "
        least = f"phase {np.degrees(one.phase):.3g}°, delay {one.delay:.3g} s, gain 1 up to {one.crossover:.3g} rad/s"
        table.add_row("margins", f"{said}{least if one.crossover else 'any phase and delay, as its gain is below 1'}")


def print_result(console: Console, found: Findings) -> None:
    """Say what was missed and how the simulation went, first of all; then what was proved, and of which loop."""
    assert found.result is not None
    result, figures = found.result, measures(found.result)
    table = titled(result.spec.name)
    _outcome_rows(table, found)
    if conditions := result.loop.beyond_the_proofs(result.spec.problem.units):
        sampled = any(claim.proof is not None for claim in result.controller.claims_of(SampledLoop))
        but = "; of these, the sampling is in the proof of the sampled loop" * sampled
        table.add_row("proofs", f"are about the loop without: {'; '.join(conditions)}{but}")
    if result.controller.trajectory.growth is not None:
        table.add_row("proofs", "are about an x_d that is bounded and what was asked for; this one is not")
    _add(table, rows(result.spec.words, result.controller))
    _margin_rows(table, found)
    for name, figure in load_content(result).items():
        unit = figure["unit"]
        size, estimate = (f"{number_text(figure[what], '.6g')} {unit}".rstrip() for what in ("load", "estimate"))
        table.add_row("estimate", f"of {name} at the end: {estimate}, and {size} acts")
    _add(table, (("uncertain", text) for text in run_rows(result)))
    counts = amount(figures["mode_changes"], "change"), amount(figures["joint_modes"], "joint mode")
    table.add_row("modes", ", ".join(counts))
    _add(table, (("time in", text) for text in _share_texts(result.figures.time_share)))
    off = f"{figures['final_observer_error']:.2e} {norm_unit(result.spec, result.spec.problem.plant.states)}".rstrip()
    table.add_row("observer error", f"‖x − x̂‖ = {off} at the end")
    units, plant = result.spec.problem.units, result.spec.problem.plant
    inputs = [f"|{u}| = {size:.4g} {units.get(u, '')}".rstrip() for u, size in figures["largest_input"].items()]
    table.add_row("largest input", ", ".join(inputs) + result.figures.seen("largest_input"))
    for name in plant.tracked_names[:_SIGNALS]:
        table.add_row("step" if name in figures["overshoot"] else "settling", _step_text(figures, name, result))
    if (steady := result.steady_state) is not None:
        multipliers = ", ".join(complex_text(complex(value)) for value in steady.multipliers)
        table.add_row(
            "steady state",
            f"of the generator, period {steady.t[-1]:.6g} s: Floquet multipliers {multipliers}; "
            f"after one period it misses itself by {steady.residual:.0e}",
        )
    _repair_rows(table, result)
    _add(table, (("remark", remark) for remark in result.remarks))
    console.print(table)


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


def _repair_rows(table: Table, result: SimulatedLoop) -> None:
    """Say what the numbers that were given, where they had to be repaired, could change in this run."""
    repair, spec = result.controller.plant.repair, result.spec
    if repair is None:
        return
    response, bounds, words = result.response, result.controller.claim(SignalBounds).acting, spec.words
    acting = repair.disturbance(np.abs(response.x).max(axis=0), np.abs(response.u).max(axis=0))
    on = [(k, *words.cause(("disturbance", k))[1:]) for k in np.flatnonzero(acting).tolist()]
    table.add_row(
        "repair",
        "with states and inputs no larger than at the samples here, the plant as it was given differs by at most "
        + ", ".join(f"{up(acting[k])} {unit} on {name}".replace("  ", " ") for k, name, unit in on),
    )
    for signal in bounds[0].sizes:
        if signal[0] in ("output", "state") and all(signal in bounds[k].sizes for k, _, _ in on):
            name, unit = words.signal(signal)
            total = float(sum(bounds[k].sizes[signal] * acting[k] for k, _, _ in on)) * (1 + 1e-12)
            size = f"{up(total)} {unit}".rstrip()
            table.add_row("", f"which adds at most {size} to {sized(name)} in the end of the ideal loop")


def written(printing: Callable[[Console], None]) -> str:
    """Return what is printed, as a text of 100 columns."""
    file = StringIO()
    printing(Console(file=file, width=100, highlight=False, markup=False, emoji=False, color_system=None))
    return "\n".join(line.rstrip() for line in file.getvalue().splitlines()) + "\n"


def print_ensemble(console: Console, many: EnsembleResult) -> None:
    """Say how the members of an ensemble went."""
    figures, unit = ensemble_measures(many), norm_unit(many.nominal.spec, many.nominal.controller.error_names)
    table = titled(None)
    table.add_row(
        "ensemble",
        f"{figures['members']:,} member{'s' * (figures['members'] != 1)} {many.variation.text}, seed {figures['seed']}",
    )
    for part, region in figures["regions"].items():
        for kind, entries in region.items():
            ends = {name: [number_text(v, ".4g") for v in entry] for name, entry in entries.items()}
            form = "{1} ≤ {0} ≤ {2}" if kind == "box" else "{0} = {1} ± {2}"
            said = ", ".join(form.format(name, *pair) for name, pair in ends.items())
            table.add_row("", f"{part}: {said or 'nothing varies'}")
    if not figures["given"]:
        defaults = {
            "initial": "each state of the plant starts within the largest size that it has in the run above of where "
            "that run starts",
            "parameters": "each parameter that matters to the plant is within 5 % of its value; what is 0 stays 0",
        }
        table.add_row("", f"the spec has no simulation.ensemble.{figures['over']}: {defaults[figures['over']]}")
    table.add_row("outcomes", ", ".join(f"{kind}: {count:,}" for kind, count in figures["outcomes"].items()))
    if many.failed:
        table.add_row("", many.failure)
    console.print(table)
    spread = Table(box=None, padding=(0, 2, 0, 0))
    spread.add_column("")
    for heading in ("median", "95 % below", "worst", "member"):
        spread.add_column(heading, justify="right")
    for name, label, form in (
        ("largest_error", f"largest error{f' ({unit})' if unit else ''}", ".2e"),
        ("final_error", "… in the last tenth of the time", ".2e"),
        *_signal_labels(many),
        ("mode_changes", "mode changes", ".0f"),
    ):
        values = figures[name]
        shown = (values[key] for key in ("median", "95 %", "worst"))
        label += ", at the samples" * any(name.startswith(each) for each in figures["sampled"])
        spread.add_row(label, *("never" if v is None else format(v, form) for v in shown), str(values["member"]))
    console.print(spread)
    if figures["unresolved"]:
        console.print(f"In {figures['unresolved']} members the state comes within rounding of a hyperplane.")


def _signal_labels(many: EnsembleResult) -> Iterator[tuple[str, str, str]]:
    """Yield the figures of outputs and inputs, what they are called, and how they are written."""
    units = many.nominal.spec.problem.units
    for name in member_figures(many):
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
