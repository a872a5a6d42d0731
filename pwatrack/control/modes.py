"""What is decided of (8) and (9) before anything is solved: modes that no gain moves, loads that no output shows.

By eigenvalues where they suffice, and exactly. A gain that is given is proved not to do where it does not.
"""

from fractions import Fraction
from math import lcm

import flint
import numpy as np

from pwatrack.control import refusal
from pwatrack.control.goal import Given, Goal, demands
from pwatrack.control.synthesis import given
from pwatrack.control.task import Task
from pwatrack.errors import Infeasible, OutsideTheory, ProblemPart, PwatrackError
from pwatrack.lmi.inequality import CONTROLLER, OBSERVER
from pwatrack.lmi.infeasibility import Impossibility, Refutation, refute, refute_by_modes
from pwatrack.model.loads import Loads
from pwatrack.model.pwa import PWASystem
from pwatrack.model.sizes import Sizes
from pwatrack.rational import Rational, beside, column_space, fraction_of, left_null_space, number, stacked

_HARDLY = 1e-6  # of the size of a cell: a mode that is reached by less, or decays by less, is looked at exactly


def check_modes(plant: PWASystem, controller: Goal, observer: Goal, sizes: Sizes) -> None:
    """Refuse goals that a single cell rules out, of (8) and (9) together: exactly, and in no time."""
    found = list[PwatrackError]()
    for role, goal in ((CONTROLLER, controller), (OBSERVER, observer)):
        task = Task.of(plant, role, sizes=sizes)
        try:
            if isinstance(goal, Given):
                K = role.oriented(goal.gain)
                if np.linalg.eigvals(task.unlike(K)).real.max() >= 0:
                    given(task, K)
            else:
                rate = demands(goal)[0]
                proof = refute_by_modes(task.A, task.B, _looked_at(task, rate), rate=rate, exact=task.centres)
                if proof is not None:
                    raise refusal.no_gain(task, rate, proof, np.nan)
        except PwatrackError as error:
            found.append(error)
    if found:
        raise type(found[0])(*(p for error in found for p in error.problems), evidence=found[0].evidence)


def _looked_at(task: Task, rate: float) -> list[int]:
    """Return the cells in which a mode that is too slow is hardly reached: there [A − λI, B], in sizes, is singular."""
    s, found = task.scale.state, []
    B = task.B / s[:, None] * task.scale.input
    for i, A in enumerate(task.A / s[:, None] * s):
        size = float(np.linalg.norm(A, 2))
        values = np.linalg.eigvals(A)
        slow = values[values.real >= -rate - _HARDLY * size]
        pencils = [np.hstack([A - v * np.eye(len(A)), B * (size or 1.0) / (np.linalg.norm(B, 2) or 1.0)]) for v in slow]
        if any(np.linalg.svd(X, compute_uv=False)[-1] <= _HARDLY * (size or 1.0) for X in pencils):
            found.append(i)
    return found


def check_loads(plant: PWASystem, *, output: bool) -> None:
    """Refuse loads that the outputs do not show, or that nothing makes up for; all exactly, at the middle of balls.

    Raises OutsideTheory if states are tracked and a load enters where no input does; Infeasible if (9) has no solution
    for the plant with its loads: [jω I − A_i, −E; C, 0] has not full column rank in some cell, E the columns of the
    loads of frequency ω; or there are as many constants as outputs and det [A_i, E; C, 0] has not the same sign in all
    cells, of which (9) holds in between too.
    """
    loads = plant.loads
    if loads is None:
        return
    if not output:
        _check_matched(plant, loads)
    frequencies = list(dict.fromkeys(load.frequency.centre for load in loads.each))
    for frequency in frequencies:
        members = [k for k, load in enumerate(loads.each) if load.frequency.centre == frequency]
        reason = _hidden(plant, loads, members, frequency)
        if reason:
            task = Task.of(plant, OBSERVER)
            raise _unseen(loads, members, reason, refute(task.A, task.B, exact=task.centres))
        if not frequency and len(members) == len(plant.outputs):
            _check_between(plant, loads, members)


def _check_matched(plant: PWASystem, loads: Loads) -> None:
    B = plant.exact.B.centre
    rank = column_space(B).ncols()
    for load, k in zip(loads.each, loads.where, strict=True):
        column = loads.E.part(range(len(plant.states)), [k]).centre
        if column_space(beside([B, column])).ncols() > rank:
            said = f"load '{load.name}' cannot be compensated in state tracking: it enters where no input does, and x_d"
            hint = "track an output instead: there x_d follows from the reference and the load"
            raise OutsideTheory(f"{said} is given", subject=(ProblemPart.ESTIMATE, load.name), hint=hint)


def _hidden(plant: PWASystem, loads: Loads, members: list[int], frequency: Fraction) -> str:
    """Say by what, and in which cell, loads of one frequency are hidden from the outputs, or nothing."""
    n, q, p = len(plant.states), len(plant.outputs), len(members)
    if p > q:
        outputs = "output does" if q == 1 else "outputs do"
        return f"{q} measured {outputs} not tell more than {q} of one frequency apart, and these are {p}"
    E, C = loads.E.part(range(n), [loads.where[k] for k in members]).centre, plant.exact.C.centre
    for name, A_i in zip(plant.cell_names, plant.exact.A, strict=True):
        kernel = left_null_space(_pencil(A_i.centre, E, C, frequency).transpose())
        if not kernel.nrows():
            continue
        blind = left_null_space(_pencil(A_i.centre, E, C, frequency, loads=False).transpose())
        rank = 2 * (n + p) - kernel.nrows()
        half = f"{rank // 2}" if rank % 2 == 0 else f"{rank / 2:g}"
        at = f"±{float(frequency):g}j rad/s" if frequency else "0"
        cause = f"not even the plant, which has an eigenvalue at {at}" if blind.nrows() else f"there is a zero at {at}"
        return (
            f"in cell '{name}' the outputs do not show {'them' if p > 1 else 'it'}, {cause}: the rank of "
            f"[A - jωI, E; C, 0] is {half}, and {n + p} is needed, of {n + q} rows"
        )
    return ""


def _check_between(plant: PWASystem, loads: Loads, members: list[int]) -> None:
    """Refuse as many constants as outputs that are hidden from them between two cells.

    Across a facet A changes by a matrix of rank one, so the determinant is affine on the way, and 0 at a fraction of
    it. There [A, E; C, 0] v = 0, and multipliers v vᵀ for both cells, weighted as A is, prove that (9) has no solution.
    """
    n, N = len(plant.states), plant.observed.C.shape[1]
    E, C = loads.E.part(range(n), [loads.where[k] for k in members]).centre, plant.exact.C.centre
    nothing = 0 * C * E
    pencils = [stacked([beside([A_i.centre, E]), beside([C, nothing])]) for A_i in plant.exact.A]
    sizes = [pencil.det() for pencil in pencils]
    facet = next((f for f in plant.partition.facets if sizes[f.i] * sizes[f.j] < 0), None)
    if facet is None:
        return
    i, j = facet.i, facet.j
    share = sizes[i] / (sizes[i] - sizes[j])
    v = left_null_space((pencils[i] + (pencils[j] - pencils[i]) * share).transpose()).tolist()[0]
    places = [*range(n), *(n + loads.where[k] for k in members)]
    whole = lcm(*(int(entry.q) for entry in v))
    known = {place: int((entry * whole).p) for place, entry in zip(places, v, strict=True)}
    x = [known.get(place, 0) for place in range(N)]
    weights = {i: int(share.q) - int(share.p), j: int(share.p)}
    Z = {cell: tuple(tuple(weight * a * b for b in x) for a in x) for cell, weight in weights.items()}
    names, figures = plant.cell_names, [f"{float(fraction_of(sizes[cell])):.3g}" for cell in (i, j)]
    raise _unseen(
        loads,
        members,
        f"the outputs, no more than these, do not show them between cells '{names[i]}' and '{names[j]}': "
        f"det [A, E; C, 0] has another sign in each, {figures[0]} and {figures[1]}",
        Refutation(Z=Z, eigenvalues={}),
    )


def _pencil(A: Rational, E: Rational, C: Rational, frequency: Fraction, *, loads: bool = True) -> Rational:
    """Return [A − jωI, E; C, 0] as a real matrix of twice the size: on real and imaginary parts."""
    n, wide = A.nrows(), beside([A, E]) if loads else A
    M = stacked([wide, beside([C, 0 * C * E]) if loads else C])
    N = flint.fmpq_mat(M.nrows(), M.ncols())
    for k in range(n):
        N[k, k] = number(frequency)
    return stacked([beside([M, N]), beside([-N, M])])


def _unseen(loads: Loads, members: list[int], reason: str, found: Refutation | None) -> Infeasible:
    """Return the refusal of (9) for the plant with these loads, with multipliers that prove it."""
    names = ", ".join(f"'{loads.each[k].name}'" for k in members)
    frequency = float(loads.each[members[0]].frequency)
    some = f"load{'s' * (len(members) > 1)}"
    kind = f"the {some} of {frequency:g} rad/s" if frequency else f"the constant {some}"
    return Infeasible(
        f"(9) is infeasible: {kind} {names} cannot be estimated: {reason}",
        subject=(ProblemPart.ESTIMATE,),
        hint="measure another output, or estimate fewer loads",
        evidence=None if found is None else Impossibility(role=OBSERVER, rate=0.0, refutation=found),
    )
