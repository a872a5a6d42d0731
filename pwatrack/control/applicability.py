"""What the theory can do for a plant, before an inequality is solved: all routes, and the one design takes."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pwatrack.arrays import number_text
from pwatrack.control.goal import DEFAULT
from pwatrack.control.modes import check_modes
from pwatrack.errors import OutsideTheory, PwatrackError
from pwatrack.model.normal_form import NormalForm, normal_form
from pwatrack.model.pwa import PWASystem
from pwatrack.model.simplification import merged, scalar_form, widest
from pwatrack.model.sizes import Sizes
from pwatrack.rational import is_hurwitz

Tracking = Literal["output", "state"]
_ROUNDING = 1e-12  # of the largest eigenvalue, up to which a real part may be 0
_OUTPUT: frozenset[Tracking] = frozenset({"output"})


@dataclass(frozen=True, kw_only=True)
class Applicability:
    """Which routes there are for a plant, why not where there are none, and what they are judged by."""

    plant: PWASystem  # the system (1); that it is one has been proved
    form: NormalForm | None  # its normal form (11), or None
    refusal: str  # why there is no normal form, else ""
    stuck: str  # why (8) or (9) have no solution, where the modes of single cells decide that; else ""
    tracking: Tracking  # what was asked for
    asked: bool = False  # whether practical tracking is asked for, after any refusal of the theory
    uncertain: bool = False  # whether only intervals of some parameters are known
    known: bool = True  # whether the reference is known beforehand
    merged: "Applicability | None" = None  # of the plant with all cells merged that can be; None where none can

    @cached_property
    def zero_dynamics(self) -> NDArray[np.complex128] | None:
        """Eigenvalues of A_η in each cell, (l, n − r); None without a normal form."""
        return None if self.form is None else np.linalg.eigvals(self.form.Psi).astype(complex)

    @cached_property
    def answers(self) -> "tuple[tuple[Route, Answer], ...]":
        """What can be said of each of the routes."""
        return tuple((route, route.judge(self)) for route in ROUTES)

    def routes(self) -> dict[str, str]:
        """Say of each route whether it can be gone, and under which inequalities."""
        return {route.name: answer.text for route, answer in self.answers}

    @property
    def open(self) -> "list[Route]":
        """Those that `design` may take: nothing rules them out before an inequality is solved."""
        return [route for route, answer in self.answers if self.tracking in route.takes and answer.word != "no"]

    @property
    def taken(self) -> str:
        """Which of them `design` takes, the next one where the inequalities of the one before are refused."""
        return ", else ".join(route.name for route in self.open) or "none: design refuses, with the reason"


@dataclass(frozen=True)
class Answer:
    """What can be said of a route."""

    # "yes": it can be gone, whatever an inequality says. "no": it cannot, and why. "needs": it can if some
    # inequalities, the reason, have a solution, which is not tried here.
    word: Literal["yes", "no", "needs"]
    reason: str = ""
    remark: str = ""
    beside: str = ""  # what has to exist beside a solution of the inequalities
    plant: str = ""  # of which other plant all this is said, where it is not the one of the spec

    @property
    def text(self) -> str:
        """In words."""
        between = {"yes": "", "no": ": ", "needs": " "}[self.word]
        return f"{self.word}{between}{self.needed(', and an ')}{self.remark and '; '}{self.remark}"

    def needed(self, between: str) -> str:
        """Say what it takes, or why it cannot be gone, with words between inequalities and what has to be beside."""
        return f"{self.reason}{self.beside and between}{self.beside}{self.plant and ', '}{self.plant}"


_no, _needs = partial(Answer, "no"), partial(Answer, "needs")


@dataclass(frozen=True, kw_only=True)
class Route:
    """A way to a controller."""

    name: str  # in a few words
    takes: frozenset[Tracking] = frozenset()  # what `design` goes it for; nothing where it is only of interest
    judge: Callable[[Applicability], Answer]  # what can be said of it


def _stable(plant: PWASystem, eigenvalues: NDArray[np.complex128], then: Answer, otherwise: str) -> Answer:
    """Return `then` if all eigenvalues (l, k) are in the left half plane, else no, with the worst one and its cell."""
    abscissa = eigenvalues.real.max(axis=1, initial=-np.inf)
    worst = int(np.argmax(abscissa))
    if abscissa[worst] < 0:
        return then
    is_rounding = _sides(eigenvalues[worst]).max() == 0
    size = "0 to rounding" if is_rounding else number_text(abscissa[worst], "+.4g")
    return _no(f"{otherwise}: an eigenvalue has real part {size} in cell '{plant.cell_names[worst]}'")


def _sides(eigenvalues: NDArray[np.complex128]) -> NDArray[np.int64]:
    """Return on which side of the imaginary axis eigenvalues are: −1, 1, or 0 where only rounding decides it."""
    real = eigenvalues.real
    near = np.abs(real) <= _ROUNDING * np.abs(eigenvalues).max(initial=0.0)
    return np.where(near, 0, np.sign(real)).astype(np.int64)


def _alone(facts: Applicability) -> Answer:
    if len(facts.plant.A) == 1 and is_hurwitz(facts.plant.exact.A[0].centre):
        return Answer("yes", remark="its one cell is stable")
    eigenvalues = np.linalg.eigvals(facts.plant.A).astype(complex)
    then = _needs("(7)", "every cell by itself is stable")
    return _stable(facts.plant, eigenvalues, then, "the plant does not converge by itself")


def _state(facts: Applicability) -> Answer:
    return _no(facts.stuck) if facts.stuck else _needs("(8) and (9)", beside="x_d that satisfies (3)")


def _smooth(facts: Applicability, *, several: bool) -> Answer:
    m, p = facts.plant.B.shape[1], len(facts.plant.tracked)
    if several and m == p == 1:
        return _no("there is one input and one tracked output")
    if not several and facts.form is not None and (m > 1 or p > 1):
        what = f"as the paper has it, it is about one input and one output, the plant has {m} and tracks {p}"
        return _no(f"{what}: 'several outputs' extends it")
    return _output(facts, kinked=False)


def _output(facts: Applicability, *, kinked: bool) -> Answer:
    """Judge output tracking with last derivatives that depend on the cell, or with none that does."""
    if facts.form is None:
        return _no(facts.refusal)
    names = zip(facts.plant.tracked_names, facts.form.piecewise, strict=True)
    bent = [name for name, piecewise in names if piecewise]
    if kinked and not bent:
        return _no("no last derivative is another form of the state in other cells")
    if bent and not kinked:
        what = f"the last derivative of {', '.join(bent)} is another form of the state in other cells"
        return _no(f"{what}: 'kinked derivative' extends the theorem")
    if facts.stuck:
        return _no(facts.stuck)
    assert facts.zero_dynamics is not None
    if not facts.zero_dynamics.shape[1]:
        return _needs("(8) and (9)", "there are no zero dynamics")
    then = _needs("(8), (9) and (17)", "every cell by itself is minimum phase")
    return _stable(facts.plant, facts.zero_dynamics, then, "the zero dynamics do not converge")


def _preview(facts: Applicability) -> Answer:
    """Judge whether x_d can be worked out beforehand: see `lmi.dichotomy`."""
    if facts.form is None:
        return _no(facts.refusal)
    if facts.stuck:
        return _no(facts.stuck)
    assert facts.zero_dynamics is not None
    side, names = _sides(facts.zero_dynamics), facts.plant.cell_names
    still = (side == 0).any(axis=1)
    if still.any():
        where = names[int(still.argmax())]
        return _no(f"an eigenvalue of the zero dynamics has real part 0 to rounding in cell '{where}'")
    unstable = (side > 0).sum(axis=1)
    few, many = int(unstable.argmin()), int(unstable.argmax())
    if not unstable[many]:
        return _no("no mode of the zero dynamics is unstable")
    if not facts.known:
        return _no("the reference is not known beforehand: preview is none")
    if unstable[few] != unstable[many]:
        return _no(
            f"cell '{names[few]}' has {unstable[few]} unstable modes of the zero dynamics, '{names[many]}' has "
            f"{unstable[many]}"
        )
    return _needs("(8), (9) and (17±)", "the reference is known beforehand, and all cells have as many unstable modes")


def _practical(facts: Applicability) -> Answer:
    """Judge whether merging cells leaves a plant that can be tracked exactly: see `claims.practical`."""
    if facts.uncertain:
        return _no("its bounds are not proved with uncertain parameters")
    if facts.merged is None:
        return _no("no scalar nonlinearity has two corners that could become one or none")
    if facts.tracking == "output" and facts.form is None and not facts.asked:
        return _no("it is not asked for, and by itself it is tried only where an inequality is proved impossible")
    form = facts.merged.form
    bent = form is not None and any(form.piecewise)
    exact = _state(facts.merged) if facts.tracking == "state" else _output(facts.merged, kinked=bent)
    if exact.word == "no":
        return _no(f"with all cells merged that can be: {exact.reason}")
    return replace(exact, plant="with cells merged", remark="errors end below a bound")


PRACTICAL = Route(name="practical tracking", judge=_practical, takes=frozenset({"output", "state"}))
ROUTES: tuple[Route, ...] = (
    Route(name="Theorem 1", judge=_alone),
    Route(name="Theorem 2", judge=_state, takes=frozenset({"state"})),
    Route(name="Theorem 3", judge=partial(_smooth, several=False), takes=_OUTPUT),
    Route(name="several outputs", judge=partial(_smooth, several=True), takes=_OUTPUT),
    Route(name="kinked derivative", judge=partial(_output, kinked=True), takes=_OUTPUT),
    Route(name="preview", judge=_preview, takes=_OUTPUT),
    PRACTICAL,
)
"""In the order in which `design` tries them. A new one is a line here."""


def applicability(
    plant: PWASystem,
    *,
    tracking: Tracking = "output",
    sizes: Sizes | None = None,
    asked: bool = False,
    uncertain: bool = False,
    known: bool = True,
) -> Applicability:
    """Return what the theory can do for a plant."""
    sizes = sizes or Sizes.of(plant)
    scalar = scalar_form(plant)
    ways = {} if scalar is None else widest(scalar)
    less = merged(plant, scalar, ways) if scalar is not None and ways else None
    return replace(
        _facts(plant, sizes, tracking),
        asked=asked,
        uncertain=uncertain,
        known=known,
        merged=None if less is None else _facts(less, sizes, tracking),
    )


def _facts(plant: PWASystem, sizes: Sizes, tracking: Tracking) -> Applicability:
    stuck, form, refusal = "", None, ""
    try:
        check_modes(plant, DEFAULT, DEFAULT, sizes)
    except PwatrackError as error:
        stuck = error.problems[0].message
    try:
        form = normal_form(plant, input_sizes=sizes.input)
    except OutsideTheory as error:
        refusal = error.problems[0].message
    return Applicability(plant=plant, form=form, refusal=refusal, stuck=stuck, tracking=tracking)
