"""What is asked of each gain, where it has no meaning."""

import numpy as np

from pwatrack.causes import Subject
from pwatrack.errors import Problem
from pwatrack.spec.design_section import CostSection, GoalSection
from pwatrack.spec.paths import path_text
from pwatrack.spec.schema import SpecFile


def goal_problems(file: SpecFile) -> list[Problem]:
    """Check that what is asked of each gain makes sense."""
    problems = []
    for part, letter in (("controller", "K"), ("observer", "L")):
        section: GoalSection = getattr(file.design, part)
        subject: Subject = ("design", part)
        where = path_text(subject)
        given = [name for name in (letter, "cost", "rate", "gain") if getattr(section, name, None) is not None]
        if given[0:1] in ([letter], ["cost"]) and len(given) > 1:
            message = f"{where}: '{given[0]}' settles the gain, '{given[1]}' beside it has no meaning"
            problems.append(Problem(message=message, subject=(*subject, given[1])))
        if section.gain == "smallest" and section.rate in (None, "largest"):
            message = f"{where}: 'gain: smallest' is the smallest gain of a given rate in 1/s, and none is given"
            problems.append(Problem(message=message, subject=(*subject, "gain"), hint="for example rate: 0.1"))
        if section.cost is not None:
            problems += _weight_problems(section.cost, (*subject, "cost"))
    return problems


def _weight_problems(cost: CostSection, subject: Subject) -> list[Problem]:
    problems = []
    for letter, strict in (("Q", False), ("R", True)):
        X = np.array(getattr(cost, letter))
        where, at = path_text((*subject, letter)), (*subject, letter)
        skew, least = float(np.abs(X - X.T).max()), float(np.linalg.eigvalsh(X)[0])
        size = float(np.abs(X).max())
        if skew > 1e-9 * size:
            problems.append(Problem(message=f"{where} is not symmetric: entries differ by {skew:.4g}", subject=at))
        elif least <= 0 if strict else least < -1e-9 * size:
            wanted = "positive definite" if strict else "positive semidefinite"
            problems.append(
                Problem(message=f"{where} is not {wanted}: its least eigenvalue is {least:.4g}", subject=at)
            )
    return problems
