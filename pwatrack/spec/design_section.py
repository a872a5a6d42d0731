"""The section `design` as pydantic models: what is asked of the gains."""

from collections.abc import Iterator
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Discriminator, Field, Tag, WrapValidator

from pwatrack.arrays import Array
from pwatrack.errors import Subject
from pwatrack.lmi.inequality import Solver
from pwatrack.real import Real
from pwatrack.spec.entries import (
    Exact,
    ExactPositive,
    Name,
    PositiveOrLargest,
    PositiveOrSmallest,
    Rows,
    ShareOrInterval,
)
from pwatrack.spec.section import Context, Fault, Section, also, misfits, named, shaped, unknown_names
from pwatrack.spec.wording import shown
from pwatrack.spec.yaml_tree import at_path

_SKEW = 1e-9  # of the largest entry of a weight: by less it is symmetric, and not negative, but for rounding


class CostSection(Section):
    """Weights Q and R of ∫(eᵀQe + vᵀRv) dt; for the observer, noise covariance densities of states and outputs."""

    Q: Rows
    R: Rows


def weighs(Q: str, R: str) -> WrapValidator:
    """Return a validator of weights that are square, with a row for each name of a kind."""

    def check(value: Any, context: Context) -> Iterator[Fault]:
        for name, axis in (("Q", Q), ("R", R)):
            yield from misfits(at_path(value, (name,)), (axis, axis), context, (name,))

    return also(check)


class GoalSection(Section):
    """What a gain is to achieve; with nothing said, an LQR or Kalman gain is found."""

    rate: PositiveOrLargest | None = None
    gain: PositiveOrSmallest | None = None
    cost: CostSection | None = None

    def rules(self, context: Context) -> Iterator[Fault]:
        """Yield what has no meaning beside the rest, and weights that are none."""
        names = ("K", "L", "cost", "rate", "gain", "within")
        given = [name for name in names if getattr(self, name, None) is not None]
        if len(given) > 1 and given[0] in ("K", "L", "cost"):
            yield Fault(f": '{given[0]}' settles the gain, '{given[1]}' beside it has no meaning", key=(given[1],))
        if self.gain == "smallest" and self.rate in (None, "largest"):
            text = ": 'gain: smallest' is the smallest gain of a given rate in 1/s, and none is given"
            yield Fault(text, hint="for example rate: 0.1", key=("gain",))
        if self.gain == "smallest" and "within" in given:
            yield Fault(": 'gain: smallest' settles the gain, 'within' beside it has no meaning", key=("within",))
        elif getattr(self, "within", None) == "region" and (self.rate == "largest" or (self.gain and not self.rate)):
            yield Fault(": 'region' goes with a given rate, or with none", hint="or within: limits", key=("within",))
        if self.cost is not None and context.states and context.inputs and context.outputs:
            yield from _no_weight("Q", np.array(self.cost.Q))
            yield from _no_weight("R", np.array(self.cost.R))


def _no_weight(name: str, X: Array) -> Iterator[Fault]:
    skew, least, size = float(np.abs(X - X.T).max()), float(np.linalg.eigvalsh(X)[0]), float(np.abs(X).max())
    if skew > _SKEW * size:
        yield Fault(f" is not symmetric: entries differ by {skew:.4g}", ("cost", name))
    elif least <= 0 if name == "R" else least < -_SKEW * size:
        wanted = "positive definite" if name == "R" else "positive semidefinite"
        yield Fault(f" is not {wanted}: its least eigenvalue is {least:.4g}", ("cost", name))


class ControllerSection(GoalSection):
    """What K is to achieve; a given K is proved instead."""

    cost: Annotated[CostSection, weighs("states", "inputs")] | None = None
    K: Annotated[Rows, shaped("inputs", "states")] | None = None
    within: Literal["limits", "region"] | None = Field(
        None,
        description="That no limit is reached from errors within sizes or where members start, or does no harm "
        "from most of these.",
    )


class ObserverSection(GoalSection):
    """What L is to achieve; a given L is proved instead."""

    cost: Annotated[CostSection, weighs("states_and_estimates", "outputs")] | None = None
    L: Annotated[Rows, shaped("states_and_estimates", "outputs")] | None = None


class LoadSection(Section):
    """An unknown load, added to d(state)/dt with a factor for each state in `into`; of known frequency in rad/s."""

    into: Annotated[dict[str, Exact], Field(min_length=1)]
    frequency: ExactPositive | None = None


Estimate = Annotated[
    Annotated[Literal["input"], Tag("a word")]
    | Annotated[dict[Name, LoadSection], Field(min_length=1), Tag("by name")],
    Discriminator(lambda value: "by name" if isinstance(value, dict) else "a word"),  # one load at each input
]


class DesignSection(Section):
    """What to design."""

    tracking: Literal["output", "state", "practical"] = "output"
    controller: ControllerSection = ControllerSection()
    observer: ObserverSection = ObserverSection()
    estimate: Estimate | None = None
    solver: Solver = "structured"
    uncertain: Annotated[dict[Name, ShareOrInterval], named("parameter", "parameters")] = Field(
        {}, description="Parameters that are known to lie in an interval, or within a share of their value."
    )

    def rules(self, context: Context) -> Iterator[Fault]:
        """Yield loads that do nothing, and intervals that are none about the value of the design."""
        for name, load in self.estimate.items() if isinstance(self.estimate, dict) else ():
            at: Subject = ("estimate", name, "into")
            for state, meant in unknown_names(load.into, context.states) if context.states else ():
                yield Fault(f"load '{name}': {shown(state)} is no state{meant}", at, key=(state,))
            if not any(factor.centre for factor in load.into.values()):
                yield Fault(f"load '{name}': all factors are 0: it does nothing", at)
        if self.tracking == "practical" and self.uncertain:
            text = "practical tracking is proved without uncertain parameters"
            yield Fault(text, ("uncertain",), "leave out one or the other")
        for name, given in self.uncertain.items():
            if (nominal := context.parameters.get(name)) is None:
                continue
            low, high = ends_of(nominal, given)
            if not low.centre < high.centre:
                text = ": a share of a value that is 0 is no interval"
                yield Fault(text, ("uncertain", name), "write [low, high]")
            elif not low.centre <= nominal.centre <= high.centre:
                yield Fault(f": the value of the design, {float(nominal):g}, is not in it", ("uncertain", name))


def ends_of(nominal: Real, given: Real | tuple[Real, Real]) -> tuple[Real, Real]:
    """Return the ends of an interval, or of a share of a value about it."""
    if isinstance(given, tuple):
        return given
    low, high = nominal * (1 - given), nominal * (1 + given)
    return (low, high) if low.centre < high.centre else (high, low)
