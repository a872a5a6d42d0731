"""Where exact tracking is refused: the design with the least of the cells merged, and what is proved of it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from pwatrack.arrays import up
from pwatrack.claims.practical import Practical, deviation_bounds, least_merges
from pwatrack.control.applicability import PRACTICAL, Applicability
from pwatrack.control.controller import ProvedController
from pwatrack.control.modes import check_modes
from pwatrack.control.synthesis import synthesize
from pwatrack.errors import Infeasible, OutsideTheory, PwatrackError, Undecided
from pwatrack.lmi.infeasibility import Impossibility
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import SetPoint
from pwatrack.model.simplification import Simplification, merged, scalar_form, widest
from pwatrack.model.sizes import Sizes
from pwatrack.spec.spec import Spec
from pwatrack.workflow.headroom import room_within_limits
from pwatrack.workflow.sizing import reference_sizes, spec_sizes
from pwatrack.workflow.tracking import check_reference, desired_trajectory, spec_generator

Designed = Callable[[Spec], ProvedController]


def may_merge(spec: Spec, refusal: PwatrackError) -> bool:
    """Say whether practical tracking is to be tried: where (8), (9) or (17) is proved impossible, whatever the rate.

    Where the spec asks for it, after any refusal of the theory; with uncertain parameters it is not.
    """
    if spec.objectives.uncertain:
        return False
    if spec.objectives.practical:
        return isinstance(refusal, Infeasible | Undecided | OutsideTheory)
    return isinstance(refusal.evidence, Impossibility) and not refusal.evidence.rate


def checked(spec: Spec, facts: Applicability) -> tuple[str, Sizes]:
    """Check what can be known before gains are sought; of the merged plant where practical tracking is to be tried.

    Return what is known of the reference, and the sizes in force. Refuses as `check_reference` and `check_modes` do, or
    as `spec_generator` where the zero dynamics leave no route.
    """
    try:
        return _checked(spec, facts)
    except PwatrackError as refusal:
        if facts.merged is None or PRACTICAL not in facts.open or not may_merge(spec, refusal):
            raise
        less = replace(spec, problem=replace(spec.problem, plant=facts.merged.plant))
        try:
            said, sizes = _checked(less, facts.merged)
        except PwatrackError:
            raise refusal from None
        why = "; ".join(problem.short or problem.message for problem in refusal.problems)
        return f"{said}, with cells merged; exact tracking is refused: {why}", sizes


def _checked(spec: Spec, facts: Applicability) -> tuple[str, Sizes]:
    said, sizes = check_reference(spec, facts.form), spec_sizes(spec)
    with spec.located():
        if isinstance(spec.problem.reference, SetPoint) and spec.scenario.conditions.limits is not None:
            room_within_limits(spec, desired_trajectory(spec, growing=False), sizes)
        check_modes(spec.problem.plant, spec.objectives.controller, spec.objectives.observer, sizes)
        if facts.form is not None and facts.open in ([], [PRACTICAL]):  # by eigenvalues of the zero dynamics
            spec_generator(spec, facts.form, known=facts.known)
    return said, sizes


def practical_design(spec: Spec, refusal: PwatrackError, designed: Designed) -> ProvedController | str:
    """Return the design with the least of the cells merged, or why none is found; `designed` designs without claims."""
    plant, failed = spec.problem.plant, list[PwatrackError]()
    form = scalar_form(plant)
    if form is None or not widest(form):
        return "no scalar nonlinearity has two corners that could become one or none"

    def works(chosen: Mapping[int, Simplification]) -> bool:
        try:
            _solve(merged_spec(spec, list(chosen.values())))
        except PwatrackError as error:
            failed.append(error)
            return False
        return True

    chosen = least_merges(form, spec_sizes(spec), works)
    if chosen is None:
        return f"with all cells merged that can be: {failed[0].problems[0].message}"
    ways = list(chosen.values())
    made = merged_spec(spec, ways)
    found = [_bounded(made, plant, ways, refusal, designed)]
    if plant.loads is None:  # where (9) holds for all cells too: the one with the smaller bound is taken
        found.append(_bounded(merged_spec(spec, ways, watched=True), plant, ways, refusal, designed))

    def bound(made: ProvedController) -> float:  # what the tracking error ends below, of several entries in sizes
        return made.claim(Practical).leaves_norm(made.tracking, made.error_sizes.tolist())

    proved = [controller for controller in found if controller is not None]
    return min(proved, key=bound, default="no bound of what merging leaves out is proved")


def not_worth(spec: Spec, practical: Practical) -> str:
    """Say which signals are not proved to end below the size of their reference; '' where all are."""
    names = {"output": spec.problem.plant.tracked_names, "state": spec.problem.plant.states}
    said = []
    for (kind, k), size in practical.beyond.items():
        name = names[kind][k]
        unit = spec.problem.units.get(name, "")
        bound = f"{up(practical.final[kind, k])} {unit}".rstrip()
        said.append(f"|{name} − {name}_d| ends below {bound}, and the reference is of size {size:.4g} {unit}".rstrip())
    return ", ".join(said)


def merged_spec(spec: Spec, ways: Sequence[Simplification], *, watched: bool = False) -> Spec:
    """Return the spec for the plant in which elements are merged; `watched`: the observer runs all cells."""
    plant = spec.problem.plant
    form = scalar_form(plant)
    assert form is not None
    less = merged(plant, form, {way.element: way for way in ways})
    if watched:
        less = replace(less, watched=plant)
    return replace(spec, problem=replace(spec.problem, plant=less))


def _solve(spec: Spec) -> None:
    generator = desired_trajectory(spec, False).generator
    plant = spec.problem.plant if generator is None else generator.form.plant
    if plant.repair is not None and spec.problem.plant.repair is None:
        raise OutsideTheory("the merged plant has the form (11) but for rounding")
    goals = spec.objectives
    synthesize(plant, controller=goals.controller, observer=goals.observer, sizes=spec_sizes(spec))


def _bounded(
    spec: Spec, true: PWASystem, ways: Sequence[Simplification], refusal: PwatrackError, designed: Designed
) -> ProvedController | None:
    """Return a design with the bounds that are proved of it, or None where one is missing."""
    try:
        controller = designed(spec)
    except PwatrackError:
        return None
    if controller.trajectory.preview is not None:
        return None  # what its residual does is not in these bounds
    given = [k for k, name in enumerate(controller.plant.states) if name in spec.problem.sizes]
    bounds = deviation_bounds(controller, [way.column for way in ways], given)
    if bounds is None:
        return None
    practical = Practical(
        plant=true, merges=tuple(ways), replaced=refusal.problems, evidence=refusal.evidence, bounds=bounds
    )
    sizes = reference_sizes(spec, controller).tolist()
    ends = (((controller.tracking, k), size) for k, size in enumerate(sizes) if size)
    practical = replace(practical, beyond={form: size for form, size in ends if not practical.final[form] < size})
    return replace(controller, running=true, claims=(practical,))
