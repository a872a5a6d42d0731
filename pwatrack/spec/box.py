"""What a file says of parameters that lie in intervals, and the plants at the corners of that box.

Where every entry of A_i, b_i and B, with all its factors (see `dependence`), is a sum of products of the p_k^q_k, each
of them at most once in a product, with one whole exponent q_k for each parameter, the same in all of them, the entries
are affine in each p_k^q_k by itself. This is monotone over an interval (without 0, unless q_k = 1), so the plant for
any p is a mean of the plants at the corners, with the same weights for all cells and entries: products of the shares
at which the p_k^q_k lie between their ends. What is affine in A_i, b_i and B, such as a matrix inequality or a jump at
a facet that does not move, then holds for all p where it holds at the corners.
"""

from itertools import product

from pwatrack.causes import Subject
from pwatrack.errors import InvalidSpec, OutsideTheory, Problem, Undecided
from pwatrack.model.box import Box, Uncertain
from pwatrack.model.pwa import Matrices, PWASystem
from pwatrack.spec.dependence import Dependence
from pwatrack.spec.design_section import DesignSection, ends_of
from pwatrack.spec.parametric import ParametricPlant

_MOST_CORNERS = 4096  # of 12 parameters: a plant is made for each
SUBJECT: Subject = ("design", "uncertain")


def build_box(section: DesignSection, parametric: ParametricPlant) -> Box:
    """Return what is uncertain, of a section without a fault."""
    box, uses = [], parametric.uses if section.uncertain else {}
    for name, given in section.uncertain.items():
        nominal = parametric.names.parameters[name]
        assert nominal is not None
        low, high = ends_of(nominal, given)
        box.append(Uncertain(name=name, nominal=nominal, low=low, high=high, uses=uses[name]))
    return tuple(box)


def corners(parametric: ParametricPlant, nominal: PWASystem, box: Box) -> tuple[Matrices, ...]:
    """Return the matrices of the plant at all corners of a box that they speak for.

    Raises:
        InvalidSpec: If a parameter is nowhere in the plant.
        OutsideTheory: If the corners do not speak for all of the box, or hyperplanes or C are uncertain too.
        Undecided: If there are too many.

    Example:
        >>> from pwatrack import load_spec
        >>> from pwatrack.real import Real
        >>> from pwatrack.model.box import Uncertain
        >>> problem = load_spec("specs/two_mass_backlash.yaml").problem
        >>> mass = Uncertain(name="m1", nominal=Real.of(1), low=Real.of("0.8"), high=Real.of("1.25"))
        >>> [float(X.B.floats[1, 0]) for X in corners(problem.parametric, problem.plant, (mass,))]
        [1.25, 0.8]
    """
    if 2 ** len(box) > _MOST_CORNERS:
        message = f"{len(box)} uncertain parameters have 2^{len(box)} corners, at most {_MOST_CORNERS:,} are tried"
        raise Undecided(Problem(message=message, subject=SUBJECT, hint="let those that matter least be known"))
    _check_dependence(parametric, box)
    found = []
    for ends in product(*((interval.low, interval.high) for interval in box)):
        plant, _ = parametric.at({i.name: end for i, end in zip(box, ends, strict=True)}, SUBJECT)
        found.append(plant)
    if nominal.repair is not None or any(plant.repair is not None for plant in found):
        message = "the data of the plant jump at facets by rounding: for uncertain parameters they must be continuous"
        raise OutsideTheory(Problem(message=message, subject=SUBJECT, hint="write b as an expression that closes it"))
    return tuple(plant.exact for plant in found)


def _check_dependence(parametric: ParametricPlant, box: Box) -> None:
    """Refuse a box whose corners do not speak for all of it."""
    seen = Dependence(parametric, {interval.name for interval in box}).powers()
    problems, invalid = [], []
    for interval in box:
        name, found = interval.name, [(k, text) for (of, k), text in seen.items() if of == interval.name]
        where = (*SUBJECT, name)
        if not found:
            invalid.append(Problem(message=f"'{name}' is in no matrix of the plant", subject=where))
        elif len(found) > 1:
            (k, one), (other, two), *_ = found
            message = (
                f"the plant is not affine in a power of '{name}': it is there as {_power(name, k)} in {one} and as "
                f"{_power(name, other)} in {two}, so the corners do not speak for all of the interval"
            )
            problems.append(Problem(message=message, subject=where))
        elif found[0][0] != 1 and float(interval.low) <= 0 <= float(interval.high):
            message = f"{interval.text} contains 0, and the plant has {_power(name, found[0][0])} in {found[0][1]}"
            problems.append(Problem(message=message, subject=where))
    if invalid:
        raise InvalidSpec(*invalid)
    if problems:
        raise OutsideTheory(*problems)


def _power(name: str, k: int) -> str:
    return {1: name, -1: f"1/{name}"}.get(k, f"{name}**{k}")
