"""The first screen of a design or a run: ten lines of 80 columns that say what it means for this machine.

All of it is of claims, figures and `workflow.cautions`. The long form is in `summary`.
"""

import textwrap
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import degrees, isfinite
from pathlib import Path

from rich.console import Console

from pwatrack.arrays import amount, number_text
from pwatrack.claims.limits import NoSaturation
from pwatrack.claims.region import LimitedRegion
from pwatrack.claims.registry import brief
from pwatrack.claims.sampled import SampledLoop, proved_as_sampled
from pwatrack.claims.sampled_bounds import SampledBounds
from pwatrack.claims.sampled_box import SampledBox
from pwatrack.claims.sampled_region import SampledRegion
from pwatrack.control.controller import ProvedController, Row
from pwatrack.report.figures import SIMULATED, ensemble_measures, norm_unit, percent
from pwatrack.report.parameters import largest_text
from pwatrack.report.required import Checked, required
from pwatrack.report.run_folder import SUMMARY, kept_files, read_index
from pwatrack.report.terminal import visible
from pwatrack.simulation.figures import ERRORS
from pwatrack.simulation.margins import worst
from pwatrack.simulation.sampled_runs import sampling_remarks
from pwatrack.spec.spec import Spec
from pwatrack.workflow.bands import covered, tube_bounds
from pwatrack.workflow.cautions import Assessment, assessed
from pwatrack.workflow.how_far import LargestBox
from pwatrack.workflow.outcome import SimulatedLoop
from pwatrack.workflow.tracking import reference_remarks
from pwatrack.workflow.variation import EnsembleResult

LINES, COLUMNS = 10, 80  # of the first screen
_LABEL = 12  # columns of what a row is about
_ORDER = {  # what comes first; the number says what gives way to what: the largest first
    "verdict": 0,  # which stands in the title
    "missed": 0,
    "simulated": 0,
    "plant": 1,
    "warning": 2,
    "question": 2,
    "remark": 8,
    "ensemble": 1,
    "required": 4,  # that all is met; what is not stands under "missed"
    "as sampled": 1,
    "ideal loop": 1,
    "largest box": 1,
    "NOT proved": 3,
    "input": 3,
    "margins": 6,
    "K, L": 7,
    "K, M": 7,
    "open loop": 4,
    "reference": 2,
    "sizes": 5,
    "files": 0,
}
_EACH = ("missed", "warning", "question", "remark", "open loop")  # a row for each; of other labels all is one sentence
_WHOLE = ("missed", "simulated", "warning", "question", "as sampled")  # the first two of each have two lines first
_WEIGHTY = 3  # what weighs so much has a line before anything has two: also what is NOT proved
_FIRST = 3  # of a label: more give way to the rest
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


@dataclass(frozen=True, kw_only=True)
class Findings:
    """A design, and what came of it: a run, its ensemble, how far its box can be scaled, where these are there."""

    spec: Spec
    controller: ProvedController
    result: SimulatedLoop | None = None
    many: EnsembleResult | None = None
    largest: LargestBox | None = None

    @cached_property
    def checked(self) -> tuple[Checked, ...]:
        """What is required, and what came out."""
        return required(self.spec, self.controller, self.result, self.many)

    @cached_property
    def assessment(self) -> Assessment:
        """What an engineer would be warned of."""
        return assessed(self.spec, self.controller)

    @property
    def remarks(self) -> list[str]:
        """What was noticed and is no promise."""
        if self.result is not None:
            return list(self.result.remarks)
        of_reference = reference_remarks(self.spec, self.controller.form)
        return [*self.controller.plant.remarks, *of_reference, *sampling_remarks(self.controller)]

    @property
    def not_looked_at(self) -> Iterator[Row]:
        """Whether members of an ensemble are required to keep limits in a run without one."""
        wishes = sum(asked.share is not None for asked in self.spec.requirements)
        if wishes and self.result is not None and self.many is None:
            yield "required", f"{wishes} more of an ensemble, not looked at without '--ensemble 100'"

    @property
    def missed(self) -> list[str]:
        """What the design, its run, or its ensemble, did not achieve, in sentences; [] where it ends with exit 0."""
        found = [each.text for each in self.checked if not each.met]
        found += [self.result.outcome.text] if self.result is not None and self.result.outcome.code else []
        return found + ([self.many.failure] if self.many is not None and self.many.failed else [])


def first_rows(found: Findings) -> Iterator[Row]:
    """Yield what the first screen says of a design or a run, if it has room."""
    result, assessment = found.result, found.assessment
    rows = [*_proved(found), *(("NOT proved", text) for text in _beyond(found))]
    yield "verdict", _verdict(found, whole=all(label != "NOT proved" for label, _ in rows))
    yield from _came_out(found)
    yield from (("warning", text) for text in assessment.warnings)
    yield from (("question", text) for text in assessment.questions)
    yield from (("remark", text) for text in found.remarks)
    yield from rows
    if found.largest is not None:
        yield "largest box", largest_text(found.largest)
    if result is not None:
        yield from _inputs(result)
    yield from _margins(found)


def _verdict(found: Findings, *, whole: bool) -> str:
    """Say in a few words whether this is for a machine: the worst that there is to say."""
    result, many, checked, assessment = found.result, found.many, found.checked, found.assessment
    if missed := sum(not each.met for each in checked):
        return f"NOT READY: {missed} of {len(checked)} requirements missed"
    if many is not None and many.failed:
        return f"NOT READY: {len(many.failed):,} of {amount(len(many.figures), 'member')} fail"
    ended: str = "designed" if result is None else result.outcome.kind
    absent = ", ".join(name for name in _EXPECTED if getattr(found.spec.scenario.conditions, name) is None)
    without = f"; without {absent}" * bool(absent)
    if ended in ("grows", "above its bound"):
        return f"NOT READY: {ended}{without}"
    if ended == "off" and not _as_required(found):
        return f"NOT READY: error above 1 %{without}"
    ended = "as required" if ended == "off" else ended
    if many is not None and (off := _off(found, many)):
        return f"NOT READY: {off:,} of {amount(len(many.outcomes), 'member')} off{without}"
    if assessment.warnings:
        return f"NOT READY: {amount(len(assessment.warnings), 'warning')}{without}"
    if assessment.questions:
        return f"{ended}{without}{'; partly proved' * (not whole)}; PLANT RIGHT?"
    return f"{ended}{without}{'; partly proved' * (not whole) or '; proved as it runs' * (not absent)}"


def _off(found: Findings, many: EnsembleResult) -> int:
    """Return how many members are off; none where starts are to show that, or what is left of members is required."""
    wished = [each for each in found.checked if "final_error" in each.requirement.figure]
    asked = any(each.requirement.share is not None for each in wished)
    return 0 if asked or many.variation.over == "plane" else len(many.small) - sum(many.small)


def _proved(found: Findings) -> Iterator[Row]:
    """Yield what is proved, and the gains, of the loop that runs; if that is not proved, of the ideal one."""
    spec, controller, assessment, result = found.spec, found.controller, found.assessment, found.result
    sampled = controller.claims_of(SampledLoop)
    ideal, runs = "ideal loop", proved_as_sampled(controller)
    for name, share in ({} if result is None or not runs or _settles(spec, controller) else result.at_limits).items():
        if share:
            held = f"at a limit {percent(share)} of the time{_computed(result)}"
            yield "as sampled", f"{name} is {held}, of which nothing is proved"
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
        bounds += "" if runs else spec.words.off_limits
        yield "as sampled" if runs else ideal, f"{assessment.condition} {bounds}".lstrip()


def _settles(spec: Spec, controller: ProvedController) -> bool:
    """Say whether errors of the sampled loop are proved to settle from the start of the run, limits reached or not."""
    settles = any(claim.from_this_start(controller) for claim in controller.claims_of(SampledRegion))
    return settles and not spec.scenario.conditions.another_plant


def _came_out(found: Findings) -> Iterator[Row]:
    checked, result, many = found.checked, found.result, found.many
    yield from (("missed", each.text) for each in checked if not each.met)
    if result is not None:
        conditions, outcome = result.loop.conditions, result.outcome
        had = [said for name, said in _PARTS.items() if getattr(conditions, name) is not None]
        if conditions.sampling is not None:
            had.insert(0, f"sampled every {number_text(conditions.sampling.sample_time)} s")
        how = ", ".join([f"{result.end:g} s", *(had or ["ideal loop"])])
        error = f"{outcome.worst or outcome.final}{result.figures.seen(*ERRORS)}"
        ends = "is as required" if outcome.kind == "off" and _as_required(found) else _ENDS.get(outcome.kind)
        said = f"{ends}, largest error {error} in the last tenth; {outcome.largest} at worst"
        said += "; 'tracks': ≤ 1 % of reference or start" * (outcome.kind != "within its bound")
        yield "simulated", f"{how}: {said}" if outcome.kind in _ENDS else f"{outcome.text} ({how})"
    if many is not None:
        figures, unit = ensemble_measures(many), norm_unit(many.nominal.spec, many.nominal.controller.error_names)
        kinds = ", ".join(f"{count:,} {kind}" for kind, count in figures["outcomes"].items())
        worst = f"{figures['final_error']['worst']:.2e} {unit}".rstrip()
        said = (
            f"{amount(figures['members'], 'member')} {many.variation.text}: {kinds}; error at the end {worst} at worst"
        )
        yield "ensemble", f"{said}, member {figures['final_error']['member']}"
    yield from found.not_looked_at
    if met := [each for each in checked if each.met]:
        here = " in this run" * any(each.requirement.figure in SIMULATED for each in met)
        yield "required", f"{len(met)} of {len(checked)} met{here}; {'; '.join(each.short for each in met)}"


def _as_required(found: Findings) -> bool:
    """Say whether what is left of every error that is tracked is required, and met, of the run itself."""
    wished = [each for each in found.checked if "final_error" in each.requirement.figure]
    own = [each.requirement for each in wished if each.requirement.share is None]
    names = {name for asked in own for name in ([asked.signal] if asked.signal else found.controller.error_names)}
    return all(each.met for each in wished) and names >= set(found.controller.error_names)


def _margins(found: Findings) -> Iterator[Row]:
    """Yield the margins of the worst cell by itself beside what the proof across cells leaves."""
    margins, (_, of_K, _) = worst(found.assessment.margins), found.controller.guarantees.robust
    if margins is not None and margins.crossover:
        low, high = (number_text(v, ".3g") for v in (max(margins.gain[0], _LEAST_GAIN), margins.gain[1]))
        phase, delay = f"{degrees(margins.phase):.3g}", number_text(margins.delay, ".3g")
        of = "each cell alone" if found.spec.scenario.conditions.sampling is None else "ideal loop by cell"
        across = f"; proved to K ± {100 * of_K:.2g} %" * bool(of_K)
        if isfinite(margins.gain[1]):
            gain = f"× {low} to {high}" if margins.gain[0] else f"up to × {high}"
        else:
            gain = f"≥ × {low}" if margins.gain[0] else "by any factor"
        yield "margins", f"{of}: phase {phase}°, delay {delay} s, gain {gain}{across}"


def _beyond(found: Findings) -> Iterator[str]:
    """Yield what no claim takes in of what is not as the theorems assume."""
    spec, controller = found.spec, found.controller
    conditions = spec.scenario.conditions.beside(controller.plant.loads)
    if found.assessment.ends:
        taken = any(claim.ends_below(controller) for claim in controller.claims_of(SampledBounds))
        steps = conditions.quanta is not None and bool(conditions.quanta.inputs.any()) and not taken
        conditions = replace(conditions, noise=None, quanta=conditions.quanta if steps else None)
        if taken or any(kind == "disturbance" for kind, _ in found.assessment.acting):
            conditions = replace(conditions, disturbance=None)  # else it is of loads that step
    if controller.claims_of(SampledLoop):  # which says so itself
        conditions = replace(conditions, sampling=None)
    boxes = controller.claims_of(SampledBox)
    for_all = any(claim.proof is not None for claim in boxes) if controller.claims_of(SampledLoop) else True
    if for_all and covered(spec.objectives.uncertain, conditions):
        box = conditions.texts(controller.plant, spec.problem.units)
        yield from (f"error to 0 for {changed}; to a bound only" for changed in box)
        conditions = replace(conditions, plant=None, parameters=None)
    if _settles(spec, controller):
        conditions = replace(conditions, limits=None, rates=None)
    limited = any(claim.from_this_start for claim in controller.claims_of(NoSaturation))
    limited = limited or any(claim.from_this_start(controller) for claim in controller.claims_of(LimitedRegion))
    alone = spec.scenario.conditions.beside(controller.plant.loads).undisturbed
    if limited and alone and replace(conditions, limits=None).nominal and spec.scenario.conditions.sampling is None:
        return
    if said := conditions.texts(controller.plant, spec.problem.units):
        yield f"for {'; '.join(said)}"
    if controller.trajectory.growth is not None:
        yield "that x_d is bounded and what was asked for: it is not"


def _computed(result: SimulatedLoop | None) -> str:
    """Say that inputs are looked at before they wait, where they act late."""
    sampling = None if result is None else result.loop.conditions.sampling
    return " as computed" * (sampling is not None and sampling.delay > 0)


def _inputs(result: SimulatedLoop) -> Iterator[Row]:
    """Yield between which values each input was, its limits, and how long it was at one."""
    limits, units, figures = result.loop.conditions.limits, result.spec.problem.units, result.figures
    for k, name in enumerate(figures.largest_input):
        low, high = (number_text(ends[name], ".4g") for ends in (figures.lowest, figures.highest))
        of = "no limit in the file"
        if limits is not None and name in result.at_limits:
            share = result.at_limits[name]
            ends = " and ".join(number_text(v, "g") for v in limits[k].tolist() if abs(v) < float("inf"))
            touched = figures.lowest[name] <= limits[k, 0] or figures.highest[name] >= limits[k, 1]
            never = "never asked for more" if touched else "never reached"
            of = f"limits {ends}, " + (f"at them {percent(share)} of the time{_computed(result)}" if share else never)
        seen = figures.seen("largest_input")
        yield "input", f"{name} from {low} to {high} {units.get(name, '')}".rstrip() + f"{seen} ({of})"


def screen(name: str, rows: Iterable[Row], folder: Path) -> list[str]:
    """Return the lines of the first screen: the title, and at most nine more of what there is to say, also of files."""
    count, lines = len((read_index(folder) or {"files": ()})["files"]), [*rows]
    lines.append(("files", f"{folder / SUMMARY!s} says all; {count} more files"))
    if kept := kept_files(folder):
        lines.append(("files", f"kept, as no run had left them so: {', '.join(kept)}"))
    (_, verdict), *others = joined(lines)
    room = COLUMNS - len(f": {verdict}")
    return [f"{textwrap.shorten(visible(name), room, placeholder=' …')}: {verdict}", *fitted(others, LINES - 1)]


def print_screen(console: Console, lines: Iterable[str]) -> None:
    """Print lines as they are, whatever the width of the terminal."""
    for line in lines:
        console.print(line, soft_wrap=True)


def joined(rows: Iterable[Row]) -> list[Row]:
    """Return rows in their order, those of a label in one, but for what stands by itself.

    Example:
        >>> joined([("K, L", "K = 1"), ("warning", "hot"), ("K, L", "L = 2"), ("warning", "late")])
        [('warning', 'hot'), ('warning', 'late'), ('K, L', 'K = 1; L = 2')]
    """
    found: dict[str, list[str]] = {label: [] for label in _ORDER}
    for label, text in rows:
        found[label].append(visible(text))
    return [
        (label, text)
        for label, texts in found.items()
        for text in (texts if label in _EACH else ["; ".join(texts)] if texts else [])
    ]


def fitted(rows: Sequence[Row], most: int) -> list[str]:
    """Return rows as so many lines at most: each has one, if need be cut; what is left goes to what weighs most.

    Example:
        >>> fitted([("simulated", "tracks"), ("margins", "gain 2"), ("files", "runs/a")], 2)
        ['simulated   tracks', 'files       runs/a']
    """
    seen, weighed, whole = dict[str, int](), list[tuple[int, int]](), list[bool]()
    for k, (label, _) in enumerate(rows):
        seen[label] = seen.get(label, 0) + 1
        weighed.append((_ORDER[label] + (max(_ORDER.values()) if seen[label] > _FIRST else 0), k))
        whole.append(label in _WHOLE and seen[label] < _FIRST)
    wanted, given, spare = [len(_wrapped(row, most)) for row in rows], [0] * len(rows), most
    ranked = [k for _, k in sorted(weighed)]
    first = [k for weight, k in sorted(weighed) if weight <= _WEIGHTY]
    for k, lines in (*((k, 1) for k in first), *((k, 1 + whole[k]) for k in ranked), *((k, most) for k in ranked)):
        more = min(spare, max(min(wanted[k], lines) - given[k], 0))
        given[k], spare = given[k] + more, spare - more
    last = {label: k for k, (label, _) in enumerate(rows) if given[k]}
    cut = {last[label] for k, (label, _) in enumerate(rows) if not given[k] and label in last}  # some have no room
    said = [(label, f"{text}; …" if k in cut else text) for k, (label, text) in enumerate(rows)]
    return [line for k in range(len(rows)) if given[k] for line in _wrapped(said[k], given[k])]


def _wrapped(row: Row, lines: int) -> list[str]:
    """Return a row in so many lines at most: of what has no room whole parts are left out, if the first one has."""
    label, text = row
    parts = text.split("; ")
    shorter = ["; ".join(parts[:count]) + "; …" for count in range(len(parts) - 1, 0, -1)]
    fits = (said for said in (text, *shorter) if len(_lines(label, said, None)) <= lines)
    return _lines(label, next(fits, text), lines)


def _lines(label: str, text: str, lines: int | None) -> list[str]:
    return textwrap.wrap(
        text,
        COLUMNS,
        initial_indent=label.ljust(_LABEL),
        subsequent_indent=" " * _LABEL,
        max_lines=lines,
        placeholder=" …",
        break_on_hyphens=False,
    ) or [label]
