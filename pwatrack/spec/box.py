"""What a file says of parameters that are known to lie in intervals."""

from collections.abc import Mapping

from pwatrack.causes import Subject
from pwatrack.errors import Problem
from pwatrack.model.box import Box, Uncertain
from pwatrack.real import Real
from pwatrack.spec.design_section import DesignSection
from pwatrack.spec.names import unknown_names
from pwatrack.spec.parametric import ParametricPlant
from pwatrack.spec.paths import path_text
from pwatrack.spec.wording import shown

SUBJECT: Subject = ("design", "uncertain")


def box_problems(section: DesignSection, values: Mapping[str, Real | None]) -> list[Problem]:
    """Check that what is uncertain is a parameter whose interval contains its value."""
    where = path_text(SUBJECT)
    problems = [
        Problem(message=f"{where}: {shown(name)} is no parameter{meant}", subject=(*SUBJECT, name))
        for name, meant in unknown_names(section.uncertain, values)
    ]
    for name, given in section.uncertain.items():
        nominal = values.get(name)
        if nominal is None:
            continue
        low, high = _interval(nominal, given)
        if not low.centre < high.centre:
            message = f"{where}.{name}: a share of a value that is 0 is no interval"
            problems.append(Problem(message=message, subject=(*SUBJECT, name), hint="write [low, high]"))
        elif not low.centre <= nominal.centre <= high.centre:
            message = f"{where}.{name}: the value of the design, {float(nominal):g}, is not in it"
            problems.append(Problem(message=message, subject=(*SUBJECT, name)))
    return problems


def build_box(section: DesignSection, parametric: ParametricPlant) -> Box:
    """Return what is uncertain, of a section without a fault."""
    box, uses = [], parametric.uses if section.uncertain else {}
    for name, given in section.uncertain.items():
        nominal = parametric.names.parameters[name]
        assert nominal is not None
        low, high = _interval(nominal, given)
        box.append(Uncertain(name=name, nominal=nominal, low=low, high=high, uses=uses[name]))
    return tuple(box)


def _interval(nominal: Real, given: Real | tuple[Real, Real]) -> tuple[Real, Real]:
    if isinstance(given, tuple):
        return given
    low, high = nominal * (1 - given), nominal * (1 + given)
    return (low, high) if low.centre < high.centre else (high, low)
