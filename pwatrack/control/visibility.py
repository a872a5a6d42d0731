"""Whether the outputs show unknown loads, and whether inputs can make up for them: decided exactly."""

from fractions import Fraction
from math import lcm

import flint

from pwatrack.causes import Part
from pwatrack.control.task import Task
from pwatrack.errors import Infeasible, OutsideTheory, Problem
from pwatrack.lmi.infeasibility import Impossibility, Refutation, refute
from pwatrack.lmi.role import OBSERVER
from pwatrack.model.loads import Loads
from pwatrack.model.pwa import PWASystem
from pwatrack.rational import Rational, beside, column_space, fraction_of, left_null_space, stacked


def check_loads(plant: PWASystem, *, output: bool) -> None:
    """Refuse loads that the outputs do not show, or that nothing makes up for; all exactly, at the middle of balls.

    Args:
        plant: The system (1) with its loads.
        output: Whether outputs are tracked, else states.

    Raises:
        OutsideTheory: If states are tracked and a load enters where no input does.
        Infeasible: If (9) has no solution for the plant with its loads: [jω I − A_i, −E; C, 0] has not full column rank
            in some cell, E the columns of the loads of frequency ω; or there are as many constants as outputs and
            det [A_i, E; C, 0] has not the same sign in all cells: (9) is affine in A_i, so it speaks of all matrices
            between two cells too, and in one of them the determinant is 0.
    """
    loads = plant.loads
    if loads is None:
        return
    if not output:
        _check_matched(plant, loads)
    frequencies = list(dict.fromkeys(load.frequency.centre for load in loads.each))
    for frequency in frequencies:
        members = [k for k, load in enumerate(loads.each) if load.frequency.centre == frequency]
        reason = _too_many(plant, members) or _hidden(plant, loads, members, frequency)
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
            message = f"load '{load.name}' cannot be compensated in state tracking: it enters where no input does, and "
            message += "x_d is given"
            hint = "track an output instead: there x_d follows from the reference and the load"
            raise OutsideTheory(Problem(message=message, subject=(Part.ESTIMATE, load.name), hint=hint))


def _too_many(plant: PWASystem, members: list[int]) -> str:
    """Say that there are more loads of one frequency than outputs, where it is so."""
    q = len(plant.outputs)
    if len(members) <= q:
        return ""
    outputs = "output does" if q == 1 else "outputs do"
    return f"{q} measured {outputs} not tell more than {q} of one frequency apart, and these are {len(members)}"


def _hidden(plant: PWASystem, loads: Loads, members: list[int], frequency: Fraction) -> str:
    """Say in which cell, and by what, loads of one frequency are hidden from the outputs, or nothing."""
    n, q, p = len(plant.states), len(plant.outputs), len(members)
    E, C = loads.E.part(range(n), [loads.where[k] for k in members]).centre, plant.exact.C.centre
    for name, A_i in zip(plant.cell_names, plant.exact.A, strict=True):
        pencil = _pencil(A_i.centre, E, C, frequency)
        kernel = left_null_space(pencil.transpose())
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
    x = [0] * N
    for place, entry in zip(places, v, strict=True):
        x[place] = int((entry * whole).p)
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
    (n, p), q = (A.nrows(), E.ncols() if loads else 0), C.nrows()
    X = flint.fmpq_mat(2 * (n + q), 2 * (n + p))
    w = flint.fmpq(frequency.numerator, frequency.denominator)
    for part in range(2):
        row, column = part * (n + q), part * (n + p)
        for j in range(n):
            for k in range(n):
                X[row + j, column + k] = A[j, k]
            for k in range(p):
                X[row + j, column + n + k] = E[j, k]
            X[row + j, (1 - part) * (n + p) + j] = w if part == 0 else -w
        for j in range(q):
            for k in range(n):
                X[row + n + j, column + k] = C[j, k]
    return X


def _unseen(loads: Loads, members: list[int], reason: str, found: Refutation | None) -> Infeasible:
    """Return the refusal of (9) for the plant with these loads, with multipliers that prove it."""
    names = ", ".join(f"'{loads.each[k].name}'" for k in members)
    frequency = float(loads.each[members[0]].frequency)
    some = f"load{'s' * (len(members) > 1)}"
    kind = f"the {some} of {frequency:g} rad/s" if frequency else f"the constant {some}"
    evidence = None if found is None else Impossibility(role=OBSERVER, rate=0.0, refutation=found)
    problem = Problem(
        message=f"(9) is infeasible: {kind} {names} cannot be estimated: {reason}",
        subject=(Part.ESTIMATE,),
        hint="measure another output, or estimate fewer loads",
    )
    return Infeasible(problem, evidence=evidence)
