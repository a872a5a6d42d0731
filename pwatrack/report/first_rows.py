"""What the first screen says of a design or a run: what it means for this machine.

All of it is of claims, figures and `workflow.cautions`; what has room is decided in `report.screen`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from math import degrees

from pwatrack.arrays import number_text
from pwatrack.claims.registry import brief
from pwatrack.claims.sampled import SampledLoop
from pwatrack.control.controller import ProvedController, Row
from pwatrack.report.figures import design_remarks, ensemble_measures, error_unit
from pwatrack.report.parameters import largest_text
from pwatrack.report.required import Checked
from pwatrack.simulation.margins import worst
from pwatrack.spec.spec import Spec
from pwatrack.workflow.cautions import Assessment
from pwatrack.workflow.how_far import LargestBox
from pwatrack.workflow.result import SimulatedLoop
from pwatrack.workflow.variation import EnsembleResult

_MEASURED = ("tracks", "within its bound", "off")  # ends of a run that its error says all of


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
    yield from _came_out(checked, result, many)
    yield from (("warning", text) for text in assessment.warnings)
    remarks = design_remarks(spec, controller) if result is None else result.remarks
    yield from (("remark", text) for text in remarks)
    yield from _proved(spec, controller)
    if largest is not None:
        yield "largest box", largest_text(largest)
    yield from _assessed(spec, controller, assessment)
    yield from _beyond(spec, controller, assessment)
    yield from _inputs(result)


def _proved(spec: Spec, controller: ProvedController) -> Iterator[Row]:
    """Yield what is proved, and the gains, of the loop that runs; if it is sampled the rest is of one that is not."""
    labels = {"sampled": "guarantee", "guarantee": "continuous"}
    sampling, rows = spec.scenario.conditions.sampling, list(brief(spec.words, controller))
    own = any(label == "K, M" for label, _ in rows)
    for label, text in rows:
        if not own or label != "K, L":
            yield label if sampling is None else labels.get(label, label), text


def _came_out(checked: Sequence[Checked], result: SimulatedLoop | None, many: EnsembleResult | None) -> Iterator[Row]:
    """Yield what is missed, how the simulation went and with what, how an ensemble went, and what is met."""
    yield from (("missed", each.text) for each in checked if not each.met)
    if result is not None:
        how, outcome, unit = ", ".join(_conditions(result)), result.outcome, error_unit(result.spec, result.controller)
        said = f"error {result.figures.final_error:.3g} {unit}".rstrip()
        said += f" in the last tenth, {result.figures.largest_error:.3g} at worst"
        yield "simulated", f"{how}: {outcome.kind}, {said}" if outcome.kind in _MEASURED else f"{outcome.text} ({how})"
    if many is not None:
        figures, unit = ensemble_measures(many), error_unit(many.nominal.spec, many.nominal.controller)
        ends = ", ".join(f"{count:,} {kind}" for kind, count in figures["outcomes"].items())
        worst = f"{figures['final_error']['worst']:.2e} {unit}".rstrip()
        said = f"{figures['members']:,} members {many.variation.text}: {ends}; error at the end {worst} at worst"
        yield "ensemble", f"{said}, member {figures['final_error']['member']}"
    if met := [each.short for each in checked if each.met]:
        yield "required", f"{len(met)} of {len(checked)} met: {'; '.join(met)}"


def _conditions(result: SimulatedLoop) -> Iterator[str]:
    """Yield what the loop that ran had, in a word or two each."""
    conditions = result.loop.conditions
    yield f"{result.end:g} s"
    if conditions.sampling is not None:
        yield f"sampled every {number_text(conditions.sampling.sample_time)} s"
    parts = {
        "parameters": "other parameters",
        "limits": "limits",
        "disturbance": "disturbance",
        "noise": "noise",
        "quanta": "quantisation",
        "rates": "rate limits",
    }
    yield from (said for name, said in parts.items() if getattr(conditions, name) is not None)


def _assessed(spec: Spec, controller: ProvedController, assessment: Assessment) -> Iterator[Row]:
    """Yield what is proved with what the file declares, and margins of each cell beside those of the proofs."""
    words, margins = spec.words, worst(assessment.margins)
    if assessment.acting or assessment.ends:
        tracked = [(form, size) for form, size in assessment.ends.items() if form[0] == controller.tracking]
        bounds = ", ".join(words.limits(tracked)) or "no bound is proved"
        yield "in the end", f"{bounds} {assessment.condition}"
    _, of_K, _ = controller.guarantees.robust
    if margins is not None and margins.crossover:
        low, high = (number_text(v, ".3g") for v in margins.gain)
        cells = f"gain × {low} to {high}, phase {degrees(margins.phase):.0f}°, delay {margins.delay:.2g} s"
        yield "margins", f"any switching: K ± {100 * of_K:.2g} %; each cell alone: {cells}"


def _beyond(spec: Spec, controller: ProvedController, assessment: Assessment) -> Iterator[Row]:
    """Yield what no claim takes in of what is not as the theorems assume."""
    conditions, loads = spec.scenario.conditions, controller.plant.loads
    disturbance = conditions.disturbance
    if loads is not None and disturbance is not None and loads.are(disturbance):
        conditions = replace(conditions, disturbance=None)
    if assessment.ends:
        quanta = conditions.quanta
        steps = quanta is not None and bool(quanta.inputs.any())
        conditions = replace(conditions, noise=None, disturbance=None, quanta=quanta if steps else None)
    if controller.claims_of(SampledLoop):  # which says so itself
        conditions = replace(conditions, sampling=None)
    if said := conditions.texts(controller.plant):
        yield "NOT proved", f"for {'; '.join(said)}"
    if controller.trajectory.growth is not None:
        yield "NOT proved", "that x_d is bounded and what was asked for: it is not"


def _inputs(result: SimulatedLoop | None) -> Iterator[Row]:
    """Yield the largest inputs beside their limits."""
    if result is None:
        return
    limits, units = result.loop.conditions.limits, result.spec.problem.units
    for k, (name, size) in enumerate(result.figures.largest_input.items()):
        of = "" if limits is None else f" within {number_text(limits[k, 0], 'g')} to {number_text(limits[k, 1], 'g')}"
        yield "input", f"|{name}| up to {size:.4g}{of} {units.get(name, '')}".rstrip()
