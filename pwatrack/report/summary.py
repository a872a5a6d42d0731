"""The short text for people: what was found, in the terminal."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from pwatrack.arrays import Array, complex_text, number_text, up
from pwatrack.ball_matrix import different
from pwatrack.control.controller import Controller
from pwatrack.control.cost import noise_level
from pwatrack.control.generator import TrajectoryGenerator
from pwatrack.control.goal import AtLeast, Fastest, Given, Goal, LeastCost, Smallest
from pwatrack.control.guarantees import Contraction
from pwatrack.export.stored import claims
from pwatrack.lmi.role import CONTROLLER, OBSERVER, Role
from pwatrack.report.bounds import bound_rows, cause
from pwatrack.report.figures import ensemble_measures, load_content, measures, member_figures
from pwatrack.report.limits import limit_rows
from pwatrack.report.practical import practical_rows
from pwatrack.report.preview import preview_rows
from pwatrack.report.required import Checked
from pwatrack.report.run_folder import INDEX, kept_files, read_index
from pwatrack.report.terminal import remark_rows, titled
from pwatrack.report.uncertain import box_rows, largest_text, run_rows
from pwatrack.report.wording import all_cells, down, error_unit, load_kind, signal_text, sized, states_unit
from pwatrack.simulation.sample_map import sampling_remarks
from pwatrack.spec.spec import Spec
from pwatrack.study.largest_box import LargestBox
from pwatrack.study.result import Result
from pwatrack.study.tracking import reference_remarks
from pwatrack.study.variation import EnsembleResult

_SIGNALS = 6  # that are printed of all that are tracked


_NO_GAIN = {"K": "no gain: the input does nothing", "L": "no gain: the output shows nothing"}


def print_design(
    console: Console,
    spec: Spec,
    controller: Controller,
    checked: Sequence[Checked] = (),
    largest: LargestBox | None = None,
) -> None:
    """Say what was proved and the gains; above all what was required and is not so."""
    table = titled(spec.name)
    _missed_rows(table, checked)
    _met_row(table, checked)
    _proved_rows(table, spec, controller)
    if largest is not None:
        table.add_row("largest box", largest_text(largest))
    remarks = (*reference_remarks(spec, controller.form), *sampling_remarks(controller, spec.scenario.conditions))
    remark_rows(table, (*controller.plant.remarks, *remarks))
    console.print(table)


def _proved_rows(table: Table, spec: Spec, controller: Controller) -> None:
    design, generator = controller.design, controller.generator
    promised = controller.guarantees
    for row in practical_rows(spec, controller):
        table.add_row(*row)
    plant, goals = controller.plant, spec.objectives
    norm_K, norm_L = controller.sizes.norms(design.K, design.L)
    for role, proved, run, through, gain, norm, goal in (
        (CONTROLLER, promised.controller, plant, plant.B, design.K, f"{norm_K:.4g}", goals.controller),
        (OBSERVER, promised.observer, plant.model, plant.C, design.L.T, f"{norm_L:.4g} 1/s", goals.observer),
    ):
        table.add_row(f"{role.claim} {role.name}", f"proved for {all_cells(len(run.cell_names))}{_rate(proved)}")
        origin = _origin(goal) if through.any() or isinstance(goal, Given) else _NO_GAIN[role.letter]
        origin += " within the limits" * (
            role is CONTROLLER and bool(plant.B.any()) and _within_limits(goal, controller)
        )
        size = f"‖{role.letter}‖ = {norm} in sizes, {origin}"
        table.add_row("", f"{role.letter}{'ᵀ' * role.transposed} = {_matrix(gain)}, {size}")
        if role.name in controller.costs and controller.practical is None:
            table.add_row("", _cost_text(role, spec, controller))
    if (loads := controller.plant.loads) is not None:
        named = [f"{load.name} ({load_kind(load)})" for load in loads.each]
        end = "go to 0 as said here" if controller.practical is None else "end below the bounds said here"
        table.add_row("loads", f"{', '.join(named)}: estimated and compensated; errors {end} whatever their size")
    if generator is None:
        until = controller.trajectory.until
        end = "" if until is None else f" up to t = {until:.6g} s, the end of the run"
        table.add_row("Assumption 1", f"x_d and u_ff satisfy (3){end}")
        if controller.practical is None:
            table.add_row("Theorem 2", *claims(spec, controller))
    else:
        _generator_rows(table, spec, controller, generator)
    _promise_rows(table, controller)
    for k, text in enumerate(limit_rows(spec, controller)):
        table.add_row("" if k else "limits", text)
    for k, text in enumerate(bound_rows(spec, controller)):
        table.add_row("" if k else "bounds", text)
    for k, text in enumerate(box_rows(spec, controller)):
        table.add_row("" if k else "uncertain", text)


def _cost_text(role: Role, spec: Spec, controller: Controller) -> str:
    """Say what the proved bound of a cost means."""
    if role is CONTROLLER:
        return (
            "∫(eᵀQe + vᵀRv) dt ≤ e(0)ᵀ X e(0) from x̂(0) = x(0), for any switching; e = x − x_d, v = u − u_ff, "
            "X in gains.json"
        )
    X, goal = controller.costs[role.name], spec.objectives.observer
    assert isinstance(goal, LeastCost)
    if len(different(spec.problem.plant.exact.A)) == 1:
        return "covariance of Δ = x̂ − x ⪯ X under the white noise given, from x̂(0) = x(0); X in gains.json"
    level = noise_level(X, controller.design.L, goal.Q, goal.R)
    return (
        f"E[Δᵀ X⁻¹ W X⁻¹ Δ] ≤ {up(level)} 1/s under the white noise given, averaged over a long time, for any "
        "switching; Δ = x̂ − x, W = Q + L R Lᵀ, X in gains.json"
    )


def _within_limits(goal: Goal, controller: Controller) -> bool:
    """Say whether a gain was to keep limits, and is proved to from all starts that it was designed for."""
    limited = controller.limited
    if limited is None or limited.left is None or not isinstance(goal, AtLeast | Fastest):
        return False
    kind = "members" if any(one.kind == "members" for one in limited.starts) else "exact"
    return any(p.starts.kind == kind and p.scale(limited.left) >= 1 for p in limited.promises)


def _origin(goal: Goal) -> str:
    """Say where a gain is from."""
    match goal:
        case Given():
            return "given"
        case LeastCost():
            return "designed for the cost asked"
        case Smallest(rate=rate):
            asked = [f"rate {rate}", "gain smallest"]
        case Fastest(bound=bound):
            asked = ["rate largest"] + [f"gain {bound}"] * bool(np.isfinite(bound))
        case AtLeast(rate=rate, bound=bound):
            asked = [f"rate {rate}"] * bool(rate) + [f"gain {bound}"] * bool(np.isfinite(bound))
    return f"designed for {', '.join(asked)}" if asked else "designed"


def _generator_rows(table: Table, spec: Spec, controller: Controller, generator: TrajectoryGenerator) -> None:
    proved = controller.guarantees.generator
    if controller.trajectory.preview is not None:
        for k, text in enumerate(preview_rows(spec, controller)):
            table.add_row("" if k else "(17±) preview", text)
    elif not proved:
        table.add_row("(17) generator", "none needed: relative degree = number of states")
    else:
        table.add_row("(17) generator", f"proved{_rate(proved)}; η = {', '.join(generator.form.eta_names)}")
        if generator.shift is not None:
            table.add_row("Assumption 2", f"holds with η = η̄ + M ξ_d, M = {_matrix(generator.shift)}")
        else:
            reason = "(17) suffices, as the tracking dynamics are continuous in (ξ_d, η)"
            table.add_row("Assumption 2", f"holds for no shift; {reason}")
    if controller.practical is None:
        table.add_row("Theorem 3", *claims(spec, controller))


def _rate(proved: Sequence[Contraction]) -> str:
    """Say the best rate that one inequality is proved for, and by which polynomial if it is by one."""
    best = max(proved, key=lambda p: p.rate)
    by = f" by a polynomial of degree {best.degree}" if best.degree > 2 else ""
    return f"{by}, rate {down(best.rate)} 1/s"


def _promise_rows(table: Table, controller: Controller) -> None:
    """Say how fast errors go to 0, and by how much the gains may change."""
    promised = controller.guarantees
    if controller.practical is not None:
        ends = "from every start errors go to these bounds at least as fast as"
        table.add_row("promise", f"{ends} e^(−{down(promised.rate)} t), for any switching")
        return
    errors = ", ".join(f"{name} − {name}_d" for name in controller.plant.tracked_names)
    error = f"{errors} and x − x_d go" if controller.tracking == "output" else "x − x_d goes"
    ends = "0" if controller.trajectory.preview is None else "what is played back leaves of it"
    text = f"from every start {error} to {ends} at least as fast as e^(−{down(promised.rate)} t), for any switching"
    if promised.generator:
        own = down(max(p.rate for p in promised.generator))
        text += f"; x_d is the generator's, which forgets its own start as e^(−{own} t)"
    rate, of_K, of_L = promised.robust
    table.add_row("promise", text)
    if any(part.degree > 2 for part in (*promised.controller, *promised.observer)):
        table.add_row("", "by how much K and L may change is not proved: a polynomial stands for a common P")
        return
    table.add_row(
        "",
        f"at least as fast as e^(−{down(rate)} t) with K and L changed in every entry by less than "
        f"{down(100 * of_K)} % and {down(100 * of_L)} % of it, the plant as designed",
    )


def _missed_rows(table: Table, checked: Sequence[Checked]) -> None:
    for each in checked:
        if not each.met:
            table.add_row("missed", each.text)


def _met_row(table: Table, checked: Sequence[Checked]) -> None:
    met = [each.text for each in checked if each.met]
    if met:
        table.add_row("required", f"{len(met)} of {len(checked)} met: {'; '.join(met)}")


def print_result(console: Console, result: Result, checked: Sequence[Checked] = ()) -> None:
    """Say what was missed and how the simulation went, first of all; then what was proved, and of which loop."""
    figures = measures(result)
    table = titled(result.spec.name)
    _missed_rows(table, checked)
    table.add_row("simulated", f"{result.end:g} s: {result.outcome.text}")
    _met_row(table, checked)
    if conditions := result.loop.beyond_the_proofs:
        table.add_row("proofs", f"are about the loop without: {'; '.join(conditions)}")
    if result.controller.trajectory.growth is not None:
        table.add_row("proofs", "are about an x_d that is bounded and what was asked for; this one is not")
    _proved_rows(table, result.spec, result.controller)
    for name, figure in load_content(result).items():
        unit = figure["unit"]
        size, estimate = (f"{number_text(figure[what], '.6g')} {unit}".rstrip() for what in ("load", "estimate"))
        table.add_row("estimate", f"of {name} at the end: {estimate}, and {size} acts")
    for text in run_rows(result):
        table.add_row("uncertain", text)
    table.add_row("modes", f"{figures['mode_changes']} changes, {figures['joint_modes']} joint modes")
    off = f"{figures['final_observer_error']:.2e} {states_unit(result.spec)}".rstrip()
    table.add_row("observer error", f"‖x − x̂‖ = {off} at the end")
    units, plant = result.spec.problem.units, result.spec.problem.plant
    inputs = [f"|{u}| = {size:.4g} {units.get(u, '')}".rstrip() for u, size in figures["largest_input"].items()]
    seen = " at the samples" * ("largest_input" in result.figures.sampled)
    table.add_row("largest input", ", ".join(inputs) + seen)
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
    remark_rows(table, result.remarks)
    console.print(table)


def _step_text(figures: Mapping[str, Any], name: str, result: Result) -> str:
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


def _repair_rows(table: Table, result: Result) -> None:
    """Say what the numbers that were given, where they had to be repaired, could change in this run."""
    repair, spec = result.controller.plant.repair, result.spec
    if repair is None:
        return
    response, bounds = result.response, result.controller.bounds
    acting = repair.disturbance(np.abs(response.x).max(axis=0), np.abs(response.u).max(axis=0))
    on = [(k, *cause(spec, ("disturbance", k))[1:]) for k in np.flatnonzero(acting).tolist()]
    table.add_row(
        "repair",
        "with states and inputs no larger than at the samples here, the plant as it was given differs by at most "
        + ", ".join(f"{up(acting[k])} {unit} on {name}".replace("  ", " ") for k, name, unit in on),
    )
    for signal in bounds[0].sizes:
        if signal[0] in ("output", "state") and all(signal in bounds[k].sizes for k, _, _ in on):
            name, unit = signal_text(spec, signal)
            total = float(sum(bounds[k].sizes[signal] * acting[k] for k, _, _ in on)) * (1 + 1e-12)
            size = f"{up(total)} {unit}".rstrip()
            table.add_row("", f"which adds at most {size} to {sized(name)} in the end")


def print_ensemble(console: Console, many: EnsembleResult) -> None:
    """Say how the members of an ensemble went."""
    figures, unit = ensemble_measures(many), error_unit(many.nominal)
    table = titled(None)
    table.add_row(
        "ensemble",
        f"{figures['members']:,} member{'s' * (figures['members'] != 1)} {many.variation.text}, seed {figures['seed']}",
    )
    for part, region in figures["regions"].items():
        for kind, entries in region.items():
            said = ", ".join(_varied(kind, *entry) for entry in entries.items())
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
        for figure, text in (("settling_time", "settling time of {} (s)"), ("largest_input", "largest {}")):
            if name.startswith(f"{figure}_"):
                signal = name.removeprefix(f"{figure}_")
                of = units.get(signal, "") if figure == "largest_input" else ""
                yield name, text.format(signal) + (f" ({of})" if of else ""), ".4g"


def _varied(kind: str, name: str, entry: Sequence[float]) -> str:
    low, high = (number_text(value, ".4g") for value in entry)
    return f"{low} ≤ {name} ≤ {high}" if kind == "box" else f"{name} = {low} ± {high}"


def print_files(console: Console, folder: Path) -> None:
    """Say where the files of the run are, and which it found under its names and kept."""
    names = [INDEX, *(read_index(folder) or {"files": {}})["files"]]
    console.print(f"Results in {folder!s}/: {', '.join(sorted(names))}", highlight=False, soft_wrap=True)
    if kept := kept_files(folder):
        console.print(f"Kept, as no run had left them so: {', '.join(kept)}", highlight=False, soft_wrap=True)


def _matrix(X: Array) -> str:
    rows = [" ".join(number_text(v) for v in row) for row in X]
    return "[" + "; ".join(rows) + "]"
