"""What the first screen says of a design or a run: what it means for this machine.

All of it is of claims, figures and `workflow.cautions`; what has room is decided in `report.screen`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from math import degrees, isfinite

from pwatrack.arrays import amount, number_text
from pwatrack.claims.limits import NoSaturation
from pwatrack.claims.region import LimitedRegion
from pwatrack.claims.registry import brief
from pwatrack.claims.sampled import SampledLoop
from pwatrack.claims.sampled_bounds import SampledBounds
from pwatrack.claims.sampled_box import SampledBox
from pwatrack.claims.sampled_region import SampledRegion
from pwatrack.control.controller import ProvedController, Row
from pwatrack.model.conditions import Sampling
from pwatrack.report.figures import SIMULATED, design_remarks, ensemble_measures, error_unit, percent
from pwatrack.report.parameters import largest_text
from pwatrack.report.required import Checked
from pwatrack.simulation.figures import ERRORS
from pwatrack.simulation.margins import worst
from pwatrack.spec.spec import Spec
from pwatrack.workflow.bands import covered, tube_bounds
from pwatrack.workflow.cautions import Assessment
from pwatrack.workflow.how_far import LargestBox
from pwatrack.workflow.result import SimulatedLoop
from pwatrack.workflow.variation import EnsembleResult

_ENDS = {  # how a run ended, and by which measure
    "tracks": "tracks",
    "within its bound": "within its proved bound",
    "off": "does NOT track",
}
_PARTS = {  # of what is not as the theorems assume
    "limits": "limits",
    "noise": "noise",
    "disturbance": "disturbance",
    "parameters": "other parameters",
    "quanta": "quantisation",
    "rates": "rate limits",
}
_EXPECTED = ("sampling", "limits", "noise")  # of the file of a machine
_LEAST_GAIN = 1e-3  # times what it is: a gain that may be less still is said to be stable from here on


def first_rows(
    spec: Spec,
    controller: ProvedController,
    assessment: Assessment,
    *,
    checked: Sequence[Checked] = (),
    result: SimulatedLoop | None = None,
    many: EnsembleResult | None = None,
    largest: LargestBox | None = None,
) -> Iterator[Row]:
    """Yield what the first screen says of a design or a run, if it has room."""
    beyond = list(_beyond(spec, controller, assessment))
    rows = [*_proved(spec, controller, assessment, result), *(("NOT proved", text) for text in beyond)]
    whole = all(label != "NOT proved" for label, _ in rows)
    yield "verdict", _verdict(spec, assessment, checked, result, many, whole=whole)
    yield from _came_out(checked, result, many)
    yield from (("warning", text) for text in assessment.warnings)
    yield from (("question", text) for text in assessment.questions)
    remarks = design_remarks(spec, controller) if result is None else result.remarks
    yield from (("remark", text) for text in remarks)
    yield from rows
    if largest is not None:
        yield "largest box", largest_text(largest)
    yield from _inputs(result)
    yield from _margins(controller, assessment, spec.scenario.conditions.sampling)


def _verdict(
    spec: Spec,
    assessment: Assessment,
    checked: Sequence[Checked],
    result: SimulatedLoop | None,
    many: EnsembleResult | None,
    *,
    whole: bool,
) -> str:
    """Say in a few words whether this is for a machine: the worst that there is to say."""
    if missed := sum(not each.met for each in checked):
        return f"NOT READY: {missed} of {len(checked)} requirements missed"
    if many is not None and many.failed:
        return f"NOT READY: {len(many.failed):,} of {len(many.figures):,} members fail"
    ended: str = "designed" if result is None else result.outcome.kind
    absent = ", ".join(name for name in _EXPECTED if getattr(spec.scenario.conditions, name) is None)
    without = f"; without {absent}" * bool(absent)
    if ended in ("grows", "above its bound"):
        return f"NOT READY: {ended}{without}"
    if ended == "off" and not any("final_error" in each.requirement.figure for each in checked):
        return f"NOT READY: error above 1 %{without}"
    ended = "as required" if ended == "off" else ended
    if assessment.warnings:
        return f"NOT READY: {amount(len(assessment.warnings), 'warning')}{without}"
    if assessment.questions:
        return f"{ended}{without}{'; partly proved' * (not whole)}; PLANT RIGHT?"
    return f"{ended}{without}{'; partly proved' * (not whole) or '; proved as it runs' * (not absent)}"


def _proved(
    spec: Spec, controller: ProvedController, assessment: Assessment, result: SimulatedLoop | None
) -> Iterator[Row]:
    """Yield what is proved, and the gains, of the loop that runs; if that is not proved, of the ideal one."""
    sampled = [claim.proof is not None for claim in controller.claims_of(SampledLoop)]
    ideal, runs = "ideal loop", any(sampled)
    for name, share in ({} if result is None or not runs or _settles(spec, controller) else result.at_limits).items():
        if share:
            yield "as sampled", f"{name} is at a limit {percent(share)} of the time, of which nothing is proved"
    for label, text in brief(spec.words, controller):
        if not (runs and label == ideal) and not (sampled and label == "K, L"):
            yield label, text
    if assessment.acting or assessment.ends:
        tracked = [(form, size) for form, size in assessment.ends.items() if form[0] == controller.tracking]
        bounds = "in the end " + (", ".join(spec.words.limits(tracked)) or "no bound is proved")
        bounds = "error to 0" if tracked and not any(size for _, size in tracked) else bounds
        conditions = spec.scenario.conditions
        of_box = runs and tube_bounds(controller, spec.objectives.uncertain, conditions)
        bounds += " with the plant as designed" * (conditions.another_plant and not of_box)
        yield "as sampled" if runs else ideal, f"{assessment.condition} {bounds}".lstrip()


def _settles(spec: Spec, controller: ProvedController) -> bool:
    """Say whether errors of the sampled loop are proved to settle from the start of the run, limits reached or not."""
    settles = any(claim.from_this_start(controller) for claim in controller.claims_of(SampledRegion))
    return settles and not spec.scenario.conditions.another_plant


def _came_out(checked: Sequence[Checked], result: SimulatedLoop | None, many: EnsembleResult | None) -> Iterator[Row]:
    """Yield what is missed, how the simulation went and with what, how an ensemble went, and what is met."""
    yield from (("missed", each.text) for each in checked if not each.met)
    if result is not None:
        how, outcome = _conditions(result), result.outcome
        error = f"{outcome.final}{result.figures.seen(*ERRORS)}"
        said = f"{_ENDS.get(outcome.kind)}, largest error {error} in the last tenth; {outcome.largest} before"
        said += "; 'tracks': ≤ 1 % of reference or start" * (outcome.kind != "within its bound")
        yield "simulated", f"{how}: {said}" if outcome.kind in _ENDS else f"{outcome.text} ({how})"
    if many is not None:
        figures, unit = ensemble_measures(many), error_unit(many.nominal.spec, many.nominal.controller)
        ends = ", ".join(f"{count:,} {kind}" for kind, count in figures["outcomes"].items())
        worst = f"{figures['final_error']['worst']:.2e} {unit}".rstrip()
        said = f"{figures['members']:,} members {many.variation.text}: {ends}; error at the end {worst} at worst"
        yield "ensemble", f"{said}, member {figures['final_error']['member']}"
    if met := [each for each in checked if each.met]:
        here = " in this run" * any(each.requirement.figure in SIMULATED for each in met)
        yield "required", f"{len(met)} of {len(checked)} met{here}; {'; '.join(each.short for each in met)}"


def _conditions(result: SimulatedLoop) -> str:
    """Say what the loop that ran had, in a word or two each, and what it had not."""
    conditions = result.loop.conditions
    had = [said for name, said in _PARTS.items() if getattr(conditions, name) is not None]
    if conditions.sampling is not None:
        had.insert(0, f"sampled every {number_text(conditions.sampling.sample_time)} s")
    had = had or ["ideal loop"]
    return ", ".join([f"{result.end:g} s", *had])


def _margins(controller: ProvedController, assessment: Assessment, sampling: Sampling | None) -> Iterator[Row]:
    """Yield the margins of the worst cell by itself beside what the proof across cells leaves."""
    margins, (_, of_K, _) = worst(assessment.margins), controller.guarantees.robust
    if margins is not None and margins.crossover:
        low, high = (number_text(v, ".3g") for v in (max(margins.gain[0], _LEAST_GAIN), margins.gain[1]))
        phase, delay = f"{degrees(margins.phase):.3g}", number_text(margins.delay, ".3g")
        of = "each cell alone" if sampling is None else "ideal loop by cell"
        across = f"; proved to K ± {100 * of_K:.2g} %" * bool(of_K)
        if isfinite(margins.gain[1]):
            gain = f"× {low} to {high}" if margins.gain[0] else f"up to × {high}"
        else:
            gain = f"≥ × {low}" if margins.gain[0] else "by any factor"
        yield "margins", f"{of}: phase {phase}°, delay {delay} s, gain {gain}{across}"


def _beyond(spec: Spec, controller: ProvedController, assessment: Assessment) -> Iterator[str]:
    """Yield what no claim takes in of what is not as the theorems assume."""
    conditions, loads = spec.scenario.conditions, controller.plant.loads
    disturbance = conditions.disturbance
    if loads is not None and disturbance is not None and loads.are(disturbance):
        conditions = replace(conditions, disturbance=None)
    if assessment.ends:
        taken = any(claim.ends_below(controller) for claim in controller.claims_of(SampledBounds))
        steps = conditions.quanta is not None and bool(conditions.quanta.inputs.any()) and not taken
        conditions = replace(conditions, noise=None, disturbance=None, quanta=conditions.quanta if steps else None)
    if controller.claims_of(SampledLoop):  # which says so itself
        conditions = replace(conditions, sampling=None)
    boxes = controller.claims_of(SampledBox)
    for_all = any(claim.proof is not None for claim in boxes) if controller.claims_of(SampledLoop) else True
    if for_all and covered(spec.objectives.uncertain, conditions):
        yield from (f"error to 0 for {changed}; to a bound only" for changed in conditions.texts(controller.plant))
        conditions = replace(conditions, plant=None, parameters=None)
    if _settles(spec, controller):
        conditions = replace(conditions, limits=None, rates=None)
    limited = any(claim.from_this_start for claim in controller.claims_of(NoSaturation))
    limited = limited or any(claim.from_this_start(controller) for claim in controller.claims_of(LimitedRegion))
    if limited and replace(conditions, limits=None).nominal and spec.scenario.conditions.sampling is None:
        return
    if said := conditions.texts(controller.plant):
        yield f"for {'; '.join(said)}"
    if controller.trajectory.growth is not None:
        yield "that x_d is bounded and what was asked for: it is not"


def _inputs(result: SimulatedLoop | None) -> Iterator[Row]:
    """Yield between which values each input was, its limits, and how long it was at one."""
    if result is None:
        return
    limits, units, figures = result.loop.conditions.limits, result.spec.problem.units, result.figures
    for k, name in enumerate(figures.largest_input):
        low, high = (number_text(ends[name], ".4g") for ends in (figures.lowest, figures.highest))
        of = "no limit in the file"
        if limits is not None and name in result.at_limits:
            share = result.at_limits[name]
            ends = " and ".join(number_text(v, "g") for v in limits[k].tolist() if abs(v) < float("inf"))
            of = f"limits {ends}, " + (f"at them {percent(share)} of the time" if share else "never reached")
        seen = figures.seen("largest_input")
        yield "input", f"{name} from {low} to {high} {units.get(name, '')}".rstrip() + f"{seen} ({of})"
