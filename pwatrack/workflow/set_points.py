"""What a spec says of set-points: what a reference made of them keeps, and what that takes of the inputs."""

from collections.abc import Sequence
from fractions import Fraction
from typing import Any

from pwatrack.arrays import Array, number_text
from pwatrack.claims.exact_text import CLOSE
from pwatrack.control.demand import Demand, Kept, told
from pwatrack.control.generator import TrajectoryGenerator
from pwatrack.control.program import PACE
from pwatrack.control.set_points import demand, not_tried, unsaid
from pwatrack.control.trajectory import DesiredTrajectory
from pwatrack.control.words import down
from pwatrack.errors import InvalidSpec, OutsideTheory, Problem, ProblemPart
from pwatrack.spec.spec import Spec
from pwatrack.workflow.starting import generator_start

_HALVINGS = 12  # of a limit of set-points, until it is known how much of it would do
_NOT_FOUND = "no ellipsoid was found that the internal states stay in"


def demand_of(
    spec: Spec, trajectory: DesiredTrajectory, generator: TrajectoryGenerator | None, content: Any = None
) -> Demand | None:
    """Return what set-points take of the inputs; None where the file has no limits of them.

    It is read from the content of a certificate where that is given, else searched and proved.

    Raises:
        InvalidSpec: If inputs have limits, and what an output itself takes has no end as no range of it is given.
        OutsideTheory: If set-points take more than the limits, for a plant without internal states.
        ValueError: If what was told is of other limits.
    """
    kept = _kept(spec, trajectory, generator)
    if kept is None or generator is None:
        return None
    limits = spec.scenario.conditions.limits
    if limits is not None and (open_ := unsaid(generator.form, kept)):
        names = " and ".join(open_)
        text = f"no range of {names} is given: what it takes of the inputs, which have limits, has no end"
        hint = f"say what set-points may be, {{{open_[0]}: {{range: [low, high], …}}}}"
        raise InvalidSpec(Problem(message=text, subject=(ProblemPart.SET_POINTS,), hint=hint))
    if content is None:
        found = demand(generator, kept)
    elif content["set_points"] is None:
        found = Demand.unknown(kept, generator.form.D.shape[2], not_tried(generator, kept) or _NOT_FOUND)
    else:
        found = told(kept, content["set_points"], CLOSE)
    if limits is not None and not generator.form.eta_names:
        _check(spec, generator, found, limits)
    return found


def _kept(spec: Spec, trajectory: DesiredTrajectory, generator: TrajectoryGenerator | None) -> Kept | None:
    """Return what a reference made of set-points keeps; None where there is none, or `program` refuses it."""
    conditions, system = spec.scenario.conditions, trajectory.exosystem
    if conditions.pace is None or conditions.set_range is None or generator is None or generator.played_back:
        return None
    if max(generator.form.degrees) > conditions.pace.shape[1]:
        return None
    eta = generator_start(spec, trajectory, generator)
    return Kept.of(generator.form, conditions.pace, conditions.set_range, system(0.0), eta)


def _check(spec: Spec, generator: TrajectoryGenerator, found: Demand, limits: Array) -> None:
    """Refuse what may be beyond a limit of an input, with what limits of the set-points would do."""
    problems, names, beyond = list[Problem](), spec.problem.plant.inputs, found.beyond(limits)
    would = _would_do(spec, generator, found.kept, limits) if beyond else ()
    for k, side in beyond:
        unit, ends = spec.problem.units.get(names[k], ""), (found.low, found.high)[side]
        needed, limit = (f"{number_text(float(v), '.4g')} {unit}".rstrip() for v in (ends[k], limits[k, side]))
        way = "above its upper" if side else "below its lower"
        message = f"set-points may take {names[k]} = {needed}, {way} limit, {limit}"
        hint = (
            f"it is within with {' or '.join(would)}" if would else "no limit of them by itself would do: lower several"
        )
        problems.append(Problem(message=message, subject=(ProblemPart.SET_POINTS,), hint=hint))
    if problems:
        raise OutsideTheory(*problems)


def _would_do(spec: Spec, generator: TrajectoryGenerator, kept: Kept, limits: Array) -> Sequence[str]:
    """Return which single limits of set-points would do, and how low they have to be: that of least change first."""
    outputs, units, found = spec.problem.plant.tracked_names, spec.problem.units, list[tuple[float, str]]()
    for k, ends in enumerate(kept.box):
        if ends is None or ends[0] == ends[1] or demand(generator, kept.times(k, Fraction(0))).beyond(limits):
            continue
        low, high = Fraction(0), Fraction(1)
        for _ in range(_HALVINGS):
            share = (low + high) / 2
            low, high = (low, share) if demand(generator, kept.times(k, share)).beyond(limits) else (share, high)
        if not low:
            continue  # only if it is 0, which no limit may be
        output, order = kept.of_output(k)
        less = kept.times(k, low).box[k]
        assert less is not None
        unit = units.get(outputs[output], "")
        name = f" of {outputs[output]}" * (len(outputs) > 1)
        if order:
            per = f" {unit}/s{order if order > 1 else ''}" if unit else ""
            found.append((float(low), f"{PACE[order - 1]}{name} {down(float(less[1]))}{per}"))
        else:
            lower, upper = number_text(-float(down(-float(less[0]))), ".4g"), down(float(less[1]))
            found.append((float(low), f"range{name} [{lower}, {upper}]"))
    return [text for _, text in sorted(found, reverse=True)]
