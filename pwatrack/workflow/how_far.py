"""How far away a refused inequality is, by parameters and rate, and how far a box of uncertain ones can be scaled."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pwatrack.ball_matrix import BallMatrix, different, stack
from pwatrack.claims.robust import Robust
from pwatrack.control.candidates import Candidates
from pwatrack.control.controller import ProvedController
from pwatrack.control.convergence import FEW_ROWS, first_certificate, near_polynomial
from pwatrack.control.goal import Given
from pwatrack.control.task import Task
from pwatrack.errors import OutsideTheory, PwatrackError, Undecided
from pwatrack.lmi.bisection import bisected
from pwatrack.lmi.dichotomy import NoDichotomy, prove_dichotomy
from pwatrack.lmi.exact import Proof, prove_exactly
from pwatrack.lmi.inequality import CONTROLLER, GENERATOR, OBSERVER, Role
from pwatrack.lmi.infeasibility import Impossibility, seems_impossible
from pwatrack.lmi.polynomial import PolynomialProof, best_polynomial, degrees, prove_polynomial
from pwatrack.lmi.presolve import distinct
from pwatrack.lmi.solve import asking
from pwatrack.model.normal_form import normal_form
from pwatrack.model.pwa import PWASystem
from pwatrack.real import Box, Real
from pwatrack.spec.expression import Expression
from pwatrack.spec.spec import Spec
from pwatrack.workflow.pipeline import asked_of
from pwatrack.workflow.sizing import spec_sizes

_STEPS = tuple(0.02 * 3.0**k for k in range(8))  # relative distances from the present value that are tried: up to 44
_FROM_ZERO = tuple(1e-4 * 8.0**k for k in range(8))  # the same of a parameter that is 0, in its unit: up to 210
_DIGITS = 5  # of a value that is tried
_CLOSE = 3e-5  # relative, of a value that is proved and one that is not: where the bisection ends
_ROOM = 1.003  # times the rate asked: so that a design, in other sizes, finds a gain too
_MOST_PROOFS, _LEAST_PROOFS = 250, 40  # that are tried, for all parameters; with fewer it is not looked for
_EACH = 30  # that a parameter, or the rate, may take, or more where there are few parameters
_MOST_WORK = 200_000  # different cells · order³, of all proofs together: some seconds
_NEAR = 1 / 99  # of the factor: where the search ends
_DOUBLED = tuple(2.0**k for k in range(7))  # factors that are tried first
_TRIALS = 16  # together with these: ten halvings


@dataclass(frozen=True, kw_only=True)
class Proved:
    """A value of one parameter, the others as they are, at which the refused inequality is proved."""

    parameter: str  # its name
    now: float  # its present value
    value: float  # one at which there is a proof; of one that is nearer by a few parts in 1e5 none was found
    degree: int  # 2 for a common P; that of a polynomial that takes its place


@dataclass(frozen=True, kw_only=True)
class HowFar:
    """What was found."""

    claim: str  # the inequality
    parameters: tuple[Proved, ...]  # where it is proved, the relatively nearest first; then those for polynomials
    rate: float | None  # the largest rate in 1/s that is proved, where one was refused; None where none was found
    asked: float  # the rate that was refused; 0 if none was
    ended: bool = False  # whether the number of proofs that may be tried ended the search for some parameter
    entering: bool = True  # whether any parameter of the file enters it


def how_far(spec: Spec, evidence: Impossibility, progress: Callable[[str], object] = lambda _: None) -> HowFar | None:
    """Look how far away a refused inequality is; each step is an exact proof.

    Each independent parameter of the file that enters it is moved by itself: outwards in growing steps, then by
    bisection between the last value without a proof and the first with one. None where the inequality is too large to
    be asked so often, or none that depends on the plant.
    """
    inequality, rate = _Inequality(spec, evidence), None
    if inequality.proofs < _LEAST_PROOFS:
        return None
    if evidence.rate:
        progress("a slower rate")
        inequality.allow(min(_EACH, inequality.proofs // 3))
        rate = inequality.largest_rate()
    proved, entering = list[Proved](), list(inequality.parameters())
    for name, now in entering:
        progress(f"parameter {name}")
        inequality.allow(max(_EACH, inequality.proofs // len(entering)))
        found = inequality.nearest(name, now)
        if found is None:
            continue
        proved.append(Proved(parameter=name, now=now, value=found, degree=2))
        nearer = inequality.polynomial_between(name, now, found)
        proved += [] if nearer is None else [Proved(parameter=name, now=now, value=nearer[0], degree=nearer[1])]
    proved.sort(key=lambda one: (one.degree > 2, abs(one.value - one.now) / (abs(one.now) or 1.0)))
    return HowFar(
        claim=evidence.claim,
        parameters=tuple(proved),
        rate=rate,
        asked=evidence.rate,
        ended=inequality.ended,
        entering=bool(entering),
    )


class _Inequality:
    """The refused inequality at other values of a parameter."""

    def __init__(self, spec: Spec, evidence: Impossibility) -> None:
        self._spec, self._role, self._rate = spec, evidence.role, evidence.rate
        self._any_sign = isinstance(evidence.refutation, NoDichotomy)
        self._sizes = spec_sizes(spec)
        goal = spec.objectives.goals.get(evidence.role)
        self._gain = evidence.role.oriented(goal.gain) if isinstance(goal, Given) else None
        self._fixed = self._role is GENERATOR or self._gain is not None  # no gain is to be found
        self._left, self._spent, self.ended = 0, 0, False

    @cached_property
    def proofs(self) -> int:
        """How many proofs may be tried: 0 where it is not made from the parameters alone."""
        loads = self._spec.problem.plant.loads is not None
        if self._role not in (CONTROLLER, OBSERVER, GENERATOR) or (self._role is OBSERVER and loads) or not self._now:
            return 0
        return min(_MOST_PROOFS, _MOST_WORK // (len(different(self._now)) * self._now[0].shape[0] ** 3 or 1))

    def allow(self, proofs: int) -> None:
        """Let so many proofs be tried from now on."""
        self._left = min(proofs, self.proofs - self._spent)

    def parameters(self) -> Iterator[tuple[str, float]]:
        """Yield the parameters that are given as numbers and enter the inequality, with their values."""
        parametric = self._spec.problem.parametric
        for name, written in parametric.parameters.items():
            value = parametric.names.parameters[name]
            own = not (isinstance(written, Expression) and written.names & set(parametric.parameters))
            if value is not None and own and self._enters(name, float(value)):
                yield name, float(value)

    def nearest(self, name: str, now: float) -> float | None:
        """Return the nearest value that is found at which there is a common P, or a gain with one."""
        ends, last = list[float](), {1: now, -1: now}
        for step in _STEPS if now else _FROM_ZERO:
            for side in last:
                value = (now * (1 + step) if side > 0 else now / (1 + step)) if now else side * step
                if self._proved(name, value):
                    ends.append(self._bisected(lambda v: self._proved(name, v), last[side], value))
                last[side] = value
            if ends:
                return min(ends, key=lambda value: abs(value - now))
        return None

    def polynomial_between(self, name: str, now: float, found: float) -> tuple[float, int] | None:
        """Return a nearer value at which a polynomial is proved, with its degree, if there is one."""
        if not self._fixed:
            return None
        seen = dict[float, int]()

        def proved(value: float) -> bool:
            M = self._of(self._plant(name, value)) if self._paid() else None
            proof = None if M is None else _polynomial(self._role, M)
            if proof is not None:
                seen[value] = proof.degree
            return proof is not None

        value = self._bisected(proved, now, found)
        return (value, seen[value]) if value in seen else None

    def largest_rate(self) -> float | None:
        """Return the largest rate that is proved, with as many digits as `nearest` gives."""

        def proved(rate: float) -> bool:
            return self._paid() and self._some_gain(self._spec.problem.plant, rate)

        slow = _short(self._rate / 2)
        while not proved(slow):
            slow = _short(slow / 4)
            if slow < self._rate / 1000:
                return None
        return self._bisected(proved, self._rate, slow)

    def _bisected(self, proved: Callable[[float], bool], without: float, value: float) -> float:
        """Return the value nearest to one without a proof that has one, by bisection."""
        return bisected(
            (value, None),
            without,
            lambda v: (v, None) if proved(v) else None,
            near=_CLOSE,
            middle=lambda one, other: _short((one + other) / 2),
        )[0]

    def _proved(self, name: str, value: float) -> bool:
        plant = self._plant(name, value) if self._paid() else None
        if plant is None or not self._fixed:
            return plant is not None and self._some_gain(plant, self._rate)
        M = self._of(plant)
        return M is not None and bool(_common_P(self._role, M) or (self._any_sign and prove_dichotomy(self._role, M)))

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # likewise
    def _some_gain(self, plant: PWASystem, rate: float) -> bool:
        """Say whether a gain is proved to reach a rate (1/s), of whatever size."""
        task, rate = Task.of(plant, self._role, sizes=self._sizes), _ROOM * rate
        candidates = Candidates(task)
        if seems_impossible(candidates.A, task.B, rate=rate):
            return False
        for candidate in candidates.largest_margins(rate):
            found = None if candidate.P is None else task.reached(candidate.K, candidate.P, rate)
            if found is not None:
                proof = prove_exactly(task.role, different(task.exactly_closed(candidate.K)), found.P, found.rate)
                if proof is not None and proof.rate >= rate:
                    return True
        return False

    def _paid(self) -> bool:
        """Count one more trial; say whether it may be made."""
        self._left, self._spent = self._left - 1, self._spent + 1
        self.ended |= self._left < 0
        return self._left >= 0

    def _plant(self, name: str, value: float) -> PWASystem | None:
        try:
            return self._spec.problem.parametric.at({name: _short(value)}, ())[0]
        except PwatrackError:  # no plant of class (1)
            return None

    def _of(self, plant: PWASystem | None) -> list[BallMatrix] | None:
        """Return the M_i of (17), or of (8) or (9) with the gain that is given; None where there are none."""
        if plant is None:
            return None
        if self._role is not GENERATOR:
            task = Task.of(plant, self._role, sizes=self._sizes)
            if self._gain is not None:
                return task.exactly_closed(self._gain)
            assert task.exact is not None
            return [*task.exact[0], task.exact[1]]
        try:
            return [GENERATOR.exact(A_i) for A_i in normal_form(plant, input_sizes=self._sizes.input).exact.A_eta]
        except PwatrackError:  # no form (11)
            return None

    @cached_property
    def _now(self) -> list[BallMatrix] | None:
        return self._of(self._spec.problem.plant)

    def _enters(self, name: str, now: float) -> bool:
        for value in (now * 1.01, now * 0.99) if now else (1e-3, -1e-3):
            M = self._of(self._plant(name, value))
            if M is not None and self._now is not None:
                return [X.centre for X in M] != [Y.centre for Y in self._now]
        return False


def _short(value: float) -> float:
    return float(np.format_float_scientific(value, precision=_DIGITS - 1))


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # entries may be 1e300: what overflows proves nothing
def _common_P(role: Role, M: Sequence[BallMatrix]) -> Proof | None:
    """Return an exact proof of M_i P + P M_iᵀ ≺ 0 for all cells, of any rate; None where none is found."""
    exact = different(M)
    found = first_certificate(stack(exact))
    return None if found is None else prove_exactly(role, exact, found.P, found.rate)


def _polynomial(role: Role, M: Sequence[BallMatrix]) -> PolynomialProof | None:
    """Return an exact proof by a polynomial of the highest degree that is small enough; None where none is found."""
    exact = different(M)
    A = distinct(role.oriented(stack(exact)))[0]
    tried = degrees(A.shape[1], len(A), FEW_ROWS)
    if not tried or not np.linalg.eigvals(A).real.max() < 0:
        return None
    found = best_polynomial(A, tried[-1], near_polynomial(A), trials=1)
    return None if found is None else prove_polynomial(role, exact, found)


@dataclass(frozen=True, kw_only=True)
class LargestBox:
    """The largest box that was proved."""

    factor: float  # all ends are so many times as far from the values of the design as the spec has them
    beyond: float | None  # the least factor for which no proof was found; None up to 64
    box: Box  # the box itself


def largest_box(spec: Spec, controller: ProvedController) -> LargestBox:
    """Find it by bisection, with a proof for each box that is kept; raises Undecided if none was proved."""
    uncertain, refusals = spec.objectives.uncertain, [Undecided()]

    def box(factor: float) -> Box:
        return tuple(interval.scaled(Real.of(factor)) for interval in uncertain)

    def at(factor: float) -> tuple[float, None] | None:
        try:
            asked = replace(spec, objectives=replace(spec.objectives, uncertain=box(factor)))
            with spec.located(), asking(spec.objectives.solver):
                next(Robust.prove(controller, asked_of(asked, None, controller)))
        except (Undecided, OutsideTheory) as error:
            refusals.append(Undecided(*error.problems))
            return None
        return factor, None

    low, beyond = 0.0, None
    for tried, factor in enumerate(_DOUBLED, 1):
        if at(factor) is None:
            low, _, beyond = bisected(
                (low, None),
                factor,
                at,
                near=_NEAR,
                most=_TRIALS - tried,
                middle=lambda one, other: float(f"{(one + other) / 2:.4g}"),
            )
            break
        low = factor
    if not low:
        raise refusals[-1]
    return LargestBox(factor=low, beyond=beyond, box=box(low))
