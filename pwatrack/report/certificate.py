"""What certificate.json, refusal.json and generator.json hold: plant, gains and proofs in exact numbers."""

from collections.abc import Iterable, Sequence
from fractions import Fraction
from typing import Any, Literal

import numpy as np

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix, text
from pwatrack.control.bounds import Bounds, Form
from pwatrack.control.compensation import compensation, resting
from pwatrack.control.controller import Controller
from pwatrack.control.generator import tracking_dynamics
from pwatrack.control.goal import Given
from pwatrack.control.limits import Promise
from pwatrack.control.robust import Robust
from pwatrack.lmi.audit.reading import FORMAT, number
from pwatrack.lmi.dichotomy import Dichotomy
from pwatrack.lmi.exact_polynomial import AnyProof, PolynomialProof
from pwatrack.lmi.infeasibility import Impossibility
from pwatrack.lmi.no_dichotomy import NoDichotomy
from pwatrack.lmi.role import CONTROLLER, OBSERVER
from pwatrack.model.loads import Loads
from pwatrack.model.merging import Merge
from pwatrack.model.nonlinearity import Nonlinearity, Number, PiecewiseLinear
from pwatrack.model.normal_form import NormalForm, normal_form
from pwatrack.model.pwa import Matrices, PWASystem
from pwatrack.real import Real
from pwatrack.spec.spec import Spec
from pwatrack.study.merged import merged_spec
from pwatrack.study.sizing import spec_form

CLAIM = (
    "Exactly, for the numbers as they are written here (decimals, fractions): the cells cover the state space, the "
    "field is continuous and, for output tracking, the plant has the form (11). For them and, where a radius is "
    "given, for every value within it of the entry: controller: M_i = A_i + B K; observer: M_i = (A_i + L C)^T, "
    "where loads are estimated with [A_i, E; 0, S] and [C, 0] in place of A_i and C; "
    "generator: M_i = A_eta_i^T, the tracking dynamics of this plant; P > 0 and -(M_i P + P M_i^T) - 2 rate P - "
    "margin I > 0 for every cell i, P_jk = integers_jk 2^(exponents_j + exponents_k). A plant with elements is A x + b "
    "+ B u and the sum of direction function(row x + constant); its cells are all combinations of segments, the last "
    "element's first. Bounded both ways: the same "
    "without a rate and without P > 0, so that the generator has one bounded solution, which is played back; with "
    "estimates s_hat of loads eta + H s_hat, H = eta_with_loads, so that no load acts on eta in any cell. With a "
    "degree 2 d: the monomials "
    "m of degree d of z = T e have m' = F_i m for e' = M_i e (controller) or M_i^T e; P > 0 and -(P F_i + F_i^T P) - "
    "2 d rate P - N_i > 0 for every different M_i, and m^T N_i m = 0 for all z. X bounds a cost: X > 0 and X "
    "M_i + M_i^T X + Q + K^T R K < 0. Under bounds: from x = x_hat = x_d on, what d = 1 at most, on one state "
    "equation or one measured output, can make of each signal; of a start, what 1 in that entry of (x - x_d, x_hat - "
    "x), the states of loads last, can. Under uncertain: for every plant whose A, b and B are "
    "a mean of those of the corners, with the same weights in all cells, and may change with time: what 1 at most in "
    "an entry of w = f_p(x_d) - f(x_d) + (B_p - B) u_ff can make of each signal from x = x_hat = x_d on; entries "
    "without a bound are 0. Under limits: from every start (x - x_d, x_hat - x) = starts v with |v_k| <= 1, or x - x_d "
    "= starts v with x_hat = x, loads and their estimates at 0, how far u may be from u_ff at any time; drive: with "
    "constant loads at inputs (x - x_d, x_hat - x, s_hat - s) = starts v, u_ff without estimates, and u + s for u. "
    "Under practical: the field of the true plant there is that of this plant and the sum of direction (function - "
    "merged)(row x + constant), each difference at most largest; the loop is that of the true plant, and each signal "
    "ends below ends_below, from every start. Multipliers Z_i prove, for the numbers as they are written, that no "
    "such P exists for any gain, or for the one that is given; no P of any sign, where it says so: there either Z_i >= "
    "0 and the sum of Z_i M_i + M_i^T Z_i is 0, or two cells have a P_i each with M_i P_i + P_i M_i^T < 0, and these "
    "have different numbers of positive eigenvalues. The file can be checked with pwatrack verify, or with "
    "the folder audit of pwatrack alone."
)


def design_certificate(spec: Spec, controller: Controller) -> dict[str, Any]:
    """Return the content of certificate.json."""
    proofs: list[dict[str, Any]] = [_proof(proof) for proof in controller.proofs]
    if controller.generator is not None and isinstance(controller.generator.certificate, Dichotomy):
        proofs.append(_dichotomy(controller.generator.certificate))
    for of, X in controller.costs.items():
        goal = getattr(spec.objectives, of)
        proofs.append({"of": of, "X": decimals(X), "Q": decimals(goal.Q), "R": decimals(goal.R)})
    bounds = [_bounds(bounds) for bounds in (*controller.bounds, *controller.starts) if bounds.sizes]
    uncertain = None if controller.robust is None else _uncertain(spec, controller.robust)
    practical = None if controller.practical is None else _practical(spec, controller)
    if controller.practical is not None:
        spec = merged_spec(spec, controller.practical.merges, watched=controller.plant.watched is not None)
    listed = practical is not None or uncertain is not None or any("degree" in proof for proof in proofs)
    form = controller.form if practical is None else None  # it is that of the spec
    content = _content(spec, controller.design.K, controller.design.L, proofs, listed=listed, form=form)
    limits = [_limit(promise) for promise in controller.promises if promise.held is not None]
    if (shifted := _with_loads(controller)) is not None:
        content["eta_with_loads"] = shifted
    return content | {"bounds": bounds, "limits": limits, "uncertain": uncertain, "practical": practical}


def _with_loads(controller: Controller) -> list[list[str]] | None:
    """Return H with eta_ref + H s for a bounded eta that is played back beside loads; None where there is none."""
    plant, form = controller.plant, controller.form
    if plant.loads is None or form is None or controller.trajectory.preview is None:
        return None
    H = resting(plant.loads, form)
    return BallMatrix(H).texts if any(H.entries()) else None


def refusal_certificate(spec: Spec, evidence: Impossibility) -> dict[str, Any]:
    """Return the content of refusal.json."""
    goals = spec.objectives.goals.items()
    known = {role: goal.gain for role, goal in goals if role is evidence.role and isinstance(goal, Given)}
    proofs = [{"of": evidence.role.name} | _refutation(evidence)]
    return _content(spec, known.get(CONTROLLER), known.get(OBSERVER), proofs)


def corner_content(spec: Spec, corners: Sequence[Matrices]) -> dict[str, Any]:
    """Return the part of a proof for uncertain parameters that the spec alone decides."""
    return {
        "parameters": [
            [interval.name, *(text(end.centre) for end in (interval.low, interval.high))]
            for interval in spec.objectives.uncertain
        ],
        "corners": [_corner(X) for X in corners],
    }


def merged_content(spec: Spec, merges: Sequence[Merge]) -> dict[str, Any]:
    """Return the part of a proof of practical tracking that the spec and the choice of what is merged decide."""
    return {
        "plant": _plant(spec.problem.plant),
        "merged": [
            {
                "element": merge.element,
                "first": merge.first,
                "last": merge.last,
                "name": merge.nonlinearity.name,
                **_term(merge.nonlinearity),
                "merged": _function(merge.function),
                "largest": text(merge.largest),
            }
            for merge in merges
        ],
    }


def subject_content(
    spec: Spec, directions: Any = None, *, listed: bool = False, form: NormalForm | None = None
) -> dict[str, Any]:
    """Return the part of either that the spec alone decides: what is proved something of.

    Args:
        spec: What was asked.
        directions: Of the inputs, where they are given: see `NormalForm`.
        listed: Whether all cells are listed, also those of nonlinearities: what is not affine in A_i needs them.
        form: The normal form of the spec, if it is known already.
    """
    if form is None and spec.problem.tracking == "output":
        form = output_form(spec, directions)
    plant = spec.problem.plant if form is None else form.plant
    listed = listed or plant.written is None or not plant.written.product
    listed = listed or (form is not None and any(X is not form.exact.T[0] for X in form.exact.T))
    return {
        "tracking": spec.problem.tracking,
        "plant": _plant(plant) if listed else _elements(plant),
        "generator": None if form is None else _generator(form, listed),
    }


def output_form(spec: Spec, directions: Any = None) -> NormalForm:
    """Return the normal form of a spec, for directions of the inputs as a certificate has them, or those of a design.

    Raises:
        ValueError: If these are not of its shape.
    """
    plant = spec.problem.plant
    if directions is None:
        return spec_form(spec)
    m, p = plant.B.shape[1], len(plant.tracked)
    if [len(row) for row in directions] != [p] * m:
        raise ValueError("the directions of the inputs do not fit the plant")
    return normal_form(plant, directions=BallMatrix.of([[number(v) for v in row] for row in directions], (m, p)))


def generator_content(form: NormalForm, shift: Array | None, *, played_back: bool) -> dict[str, Any]:
    """Return the content of generator.json: (15) and (16) in doubles.

    Args:
        form: The normal form (11).
        shift: M of Assumption 2, or None if there is none.
        played_back: Whether its bounded solution is, in place of a filter.
    """
    A_eta, B_eta, b_eta = tracking_dynamics(form)
    return {
        "relative_degrees": list(form.degrees),
        "eta": list(form.eta_names),
        "T": form.T.tolist(),
        "offset": form.offset.tolist(),
        "cells": list(form.plant.cell_names),
        "A_eta": A_eta.tolist(),
        "b_eta": b_eta.tolist(),
        "B_eta": B_eta.tolist(),
        "alpha": form.alpha.tolist(),
        "beta": form.beta.tolist(),
        "gamma": form.gamma.tolist(),
        "right_inverse": form.right_inverse.tolist(),
        "shift": None if shift is None else shift.tolist(),
        "loads": _compensation_content(form, played_back=played_back),
    }


def _compensation_content(form: NormalForm, *, played_back: bool) -> dict[str, Any] | None:
    """Return what estimates s_hat of loads add: to x_d, to u_ff and to the rate of eta_hat, the last two by cell."""
    loads = form.plant.loads
    if loads is None:
        return None
    added = compensation(form.plant, form, len(form.eta_names), played_back=played_back)
    return {
        "names": list(loads.names),
        "where": list(loads.where),
        "E": loads.E.floats.tolist(),
        "S": loads.S.floats.tolist(),
        "x_d": added.X.floats.tolist(),
        "u_ff": added.u_ff.tolist(),
        "rate": added.rate.tolist(),
    }


def decimals(X: Array | None) -> list[list[str]] | None:
    """Return a matrix of doubles as the decimals that they print as."""
    return None if X is None else BallMatrix.of(X, (X.shape[0], X.shape[1])).texts


def _content(spec: Spec, K: Array | None, L: Array | None, proofs: Sequence[Any], **known: Any) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "claim": CLAIM,
        "spec_sha256": spec.sha256,
        "set": {name: str(value) for name, value in spec.overrides.items()},
        **subject_content(spec, **known),
        "K": decimals(K),
        "L": decimals(L),
        "proofs": list(proofs),
    }


def _plant(plant: PWASystem) -> dict[str, Any]:
    exact, partition = plant.exact, plant.partition
    return _ports(plant) | {
        "cells": list(plant.cell_names),
        "H": [[text(v) for v in row] for row in partition.exact_H],
        "h": [text(v) for v in partition.exact_h],
        "signs": partition.signs.tolist(),
        "A": [X.texts for X in exact.A],
        "b": [X.texts for X in exact.b],
        "radius": {"A": _radii(exact.A), "b": _radii(exact.b), **_port_radii(exact)},
    }


def _elements(plant: PWASystem) -> dict[str, Any]:
    """Return a plant as it was written: its cells are all combinations of segments."""
    assert plant.written is not None
    return _ports(plant) | {
        "A": plant.written.A.texts,
        "b": plant.written.b.texts,
        "elements": [
            {
                **_term(element),
                "segments": [f"{element.name} {segment}" for segment in element.function.segments],
            }
            for element in plant.written.elements
        ],
        "radius": {"A": None, "b": None, **_port_radii(plant.exact)},
    }


def _term(element: Nonlinearity) -> dict[str, Any]:
    """Return direction function(row x + constant)."""
    return {
        "row": [_centre(v) for v in element.row],
        "constant": _centre(element.constant),
        "direction": [_centre(v) for v in element.direction],
        "function": _function(element.function),
    }


def _ports(plant: PWASystem) -> dict[str, Any]:
    """Return what all ways of writing a plant have in common."""
    return {
        "states": list(plant.states),
        "inputs": list(plant.inputs),
        "outputs": list(plant.outputs),
        "tracked": list(plant.tracked_names),
        "B": plant.exact.B.texts,
        "C": plant.exact.C.texts,
        "tracked_rows": plant.exact.tracked.texts,
        "loads": None if plant.loads is None else _loads(plant.loads),
    }


def _port_radii(exact: Matrices) -> dict[str, Any]:
    return {
        "B": exact.B.radius_texts,
        "C": exact.C.radius_texts,
        "tracked_rows": exact.tracked.radius_texts,
    }


def _corner(exact: Matrices) -> dict[str, Any]:
    return {
        "A": [X.texts for X in exact.A],
        "b": [X.texts for X in exact.b],
        "B": exact.B.texts,
        "radius": {"A": _radii(exact.A), "b": _radii(exact.b), "B": exact.B.radius_texts},
    }


def _loads(loads: Loads) -> dict[str, Any]:
    return {
        "names": list(loads.names),
        "where": list(loads.where),
        "E": loads.E.texts,
        "S": loads.S.texts,
        "radius": {"E": loads.E.radius_texts, "S": loads.S.radius_texts},
    }


def _uncertain(spec: Spec, robust: Robust) -> dict[str, Any]:
    return corner_content(spec, robust.corners) | {"bounds": [_bounds(bounds) for bounds in robust.bounds]}


def _practical(spec: Spec, controller: Controller) -> dict[str, Any]:
    practical = controller.practical
    assert practical is not None
    runs = "all cells" if controller.plant.watched is not None else "merged cells"
    ends = ((form, size) for form, size in practical.final.items() if size or form[0] == controller.tracking)
    return merged_content(spec, practical.merges) | {
        "observer_runs": runs,
        "ends_below": _sizes(ends),
        "bounds": [_bounds(bounds) for bounds in practical.bounds],
    }


def _function(function: PiecewiseLinear) -> dict[str, Any]:
    return {
        "breakpoints": [_centre(v) for v in function.breakpoints],
        "slopes": [_centre(v) for v in function.slopes],
        "value": _centre(function.value),
    }


def _centre(value: Number) -> str:
    return text(Real.of(value).centre)


def _radii(matrices: Sequence[BallMatrix]) -> list[Any] | None:
    return None if all(X.radius is None for X in matrices) else [X.radius_texts for X in matrices]


def _generator(form: NormalForm, listed: bool) -> dict[str, Any]:
    by_cell: dict[str, Any] = {"T": [form.exact.T[0].texts]}
    if listed:
        by_cell = {"T": [T.texts for T in form.exact.T], "A_eta": [X.texts for X in form.exact.A_eta]}
    return {
        "relative_degrees": list(form.degrees),
        "directions": form.exact.directions.texts,
        "scales": [text(Fraction(v)) for v in form.exact.scales],
        "internal": list(form.exact.internal),
        "eta": list(form.eta_names),
        **by_cell,
    }


def _proof(proof: AnyProof) -> dict[str, Any]:
    if isinstance(proof, PolynomialProof):
        return {
            "of": proof.role.name,
            "degree": proof.degree,
            "rate": _decimal(proof.rate),
            "T": decimals(proof.T),
            "P": _packed(proof.integers, proof.exponents),
            "N": [_packed(N, proof.N_exponents) for N in proof.N],
        }
    return {
        "of": proof.role.name,
        "rate": _decimal(proof.rate),
        "margin": _decimal(proof.margin),
        "radius": _decimal(proof.radius),
        "P": _packed(proof.integers, proof.exponents),
    }


def _dichotomy(proof: Dichotomy) -> dict[str, Any]:
    return {
        "of": proof.role.name,
        "bounded": "both ways",
        "margin": _decimal(proof.margin),
        "P": _packed(proof.integers, proof.exponents),
    }


def _refutation(evidence: Impossibility) -> dict[str, Any]:
    against = evidence.refutation
    Z = {str(i): [list(row) for row in Z_i] for i, Z_i in against.Z.items()}
    if not isinstance(against, NoDichotomy):
        found = {"Z": Z} if against.between is None else against.between.content
        return {"rate": _decimal(evidence.rate)} | found
    P = {str(i): _packed(proof.integers, proof.exponents) for i, proof in against.P.items()}
    return {"no_P": "of any sign"} | ({"P": P} if P else {"Z": Z})


def _packed(integers: Sequence[Sequence[int]], exponents: Sequence[int]) -> dict[str, Any]:
    return {"integers": [list(row) for row in integers], "exponents": list(exponents)}


def _bounds(bounds: Bounds) -> dict[str, Any]:
    parts = [
        {
            "loop": part.loop,
            "channel": list(part.channel),
            "a": _decimal(part.ellipsoid.a),
            "Q": _packed(part.ellipsoid.integers, part.ellipsoid.exponents),
            "signals": _sizes(zip(part.signals, part.ellipsoid.sizes, strict=True)),
        }
        for part in bounds.parts
    ]
    peaks = [
        {
            "part": peak.part,
            "unit": peak.gain.unit,
            "steps": [list(run) for run in peak.gain.steps],
            "P": {"integers": [list(row) for row in peak.gain.integers], "exponents": list(peak.gain.exponents)},
            "size": _decimal(peak.gain.size),
        }
        for peak in bounds.proved
    ]
    found = {"channel": list(bounds.channel), "signals": _sizes(bounds.certified.items()), "parts": parts}
    return found | ({"peaks": peaks} if peaks else {})


def _limit(promise: Promise) -> dict[str, Any]:
    held = promise.held
    assert held is not None
    kind: Literal["drive", "input"] = "input" if promise.starts.load is None else "drive"
    return {
        "of": promise.starts.kind,
        "loop": promise.loop,
        "starts": decimals(promise.starts.G),
        "weights": [_decimal(w) for w in held.weights],
        "Q": {"integers": [list(row) for row in held.integers], "exponents": list(held.exponents)},
        "signals": _sizes(((kind, k), size) for k, size in zip(promise.inputs, held.sizes, strict=True)),
    }


def _sizes(signals: Iterable[tuple[Form, float]]) -> list[list[Any]]:
    return [
        [*signal, _decimal(np.nextafter(size, np.inf))] for signal, size in signals
    ]  # its decimals are not below it


def _decimal(value: float) -> str:
    return text(Fraction(repr(float(value))))
