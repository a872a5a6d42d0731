"""What is said of how far away a refused inequality is."""

from collections.abc import Sequence
from typing import Any

from pwatrack.workflow.how_far import HowFar, Proved


def texts(found: HowFar) -> list[str]:
    """Return it in sentences.

    Example:
        >>> near = Proved(parameter="k2", now=1.2, value=0.68998, degree=2)
        >>> texts(HowFar(claim="(17)", parameters=(near,), rate=None, asked=0.0))
        ['(17) is proved with k2 = 0.68998 (now 1.2)']
        >>> texts(HowFar(claim="(8)", parameters=(), rate=0.24, asked=0.3))[0]
        '(8) is proved at a rate of 0.24 1/s (asked: 0.3 1/s)'
    """
    said = []
    if found.asked:
        slower = "at no slower rate that was tried" if found.rate is None else f"at a rate of {found.rate:g} 1/s"
        said.append(f"{found.claim} is proved {slower} (asked: {found.asked:g} 1/s)")
    quadratic = [p for p in found.parameters if p.degree == 2]
    if quadratic:
        said.append(f"{found.claim} is proved with {_listed(quadratic)}")
    elif not found.entering:
        said.append(
            f"{found.claim}: no parameter of the file enters it: what has a name under 'parameters' is looked at"
        )
    else:
        said.append(f"{found.claim}: no value of a single parameter was found with which it is proved")
    if found.ended:
        said.append("the search ended before all values were tried: there may be nearer ones, and other parameters")
    for degree in sorted({p.degree for p in found.parameters} - {2}):
        nearer = [p for p in found.parameters if p.degree == degree]
        said.append(f"by a polynomial of degree {degree} in place of a common P with {_listed(nearer)}")
    return said


def _listed(found: Sequence[Proved]) -> str:
    *some, last = [f"{p.parameter} = {p.value:g} (now {p.now:g})" for p in found]
    return f"{', '.join(some)} or {last}, each by itself" if some else last


def content(found: HowFar) -> dict[str, Any]:
    """Return it for run.json."""
    return {
        "inequality": found.claim,
        "parameters": [
            {"name": p.parameter, "now": p.now, "proved": p.value, "degree": p.degree} for p in found.parameters
        ],
        "complete": not found.ended,
        "rate": {"asked": found.asked, "proved": found.rate} if found.asked else None,
    }
