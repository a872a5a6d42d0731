"""What certificate.json, refusal.json, generator.json and bounds.json hold: plant, gains, and what is proved."""

from collections.abc import Sequence
from typing import Any

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix
from pwatrack.claims.bounds import SignalBounds, bound_entry
from pwatrack.claims.exact_text import decimal, decimal_texts, elements_content, form_content, packed, plant_content
from pwatrack.claims.practical import Practical
from pwatrack.claims.registry import STATEMENT, data
from pwatrack.claims.robust import Robust
from pwatrack.control.compensation import compensation
from pwatrack.control.controller import ProvedController
from pwatrack.control.generator import TrajectoryGenerator
from pwatrack.control.goal import Given
from pwatrack.export.stored import lists, loads_content
from pwatrack.lmi.audit.reading import FORMAT, number
from pwatrack.lmi.dichotomy import NoDichotomy
from pwatrack.lmi.inequality import CONTROLLER, OBSERVER
from pwatrack.lmi.infeasibility import Impossibility
from pwatrack.model.normal_form import NormalForm, normal_form
from pwatrack.spec.spec import Spec
from pwatrack.workflow.simplified import merged_spec
from pwatrack.workflow.tracking import spec_form


def design_certificate(spec: Spec, controller: ProvedController) -> dict[str, Any]:
    """Return the content of certificate.json."""
    content, form = data(controller), controller.form
    for practical in controller.claims_of(Practical):
        spec, form = merged_spec(spec, practical.merges, watched=controller.plant.watched is not None), None
    listed = bool(
        content["practical"]
        or content["uncertain"]
        or content["set_points"]
        or any("degree" in proof for proof in content["proofs"])
    )
    subject = _content(spec, controller.design.K, controller.design.L, [], listed=listed, form=form)
    return subject | content


def refusal_certificate(spec: Spec, evidence: Impossibility) -> dict[str, Any]:
    """Return the content of refusal.json."""
    goals = spec.objectives.goals.items()
    known = {role: goal.gain for role, goal in goals if role is evidence.role and isinstance(goal, Given)}
    proofs = [{"of": evidence.role.name} | _refutation(evidence)]
    return _content(spec, known.get(CONTROLLER), known.get(OBSERVER), proofs)


def subject_content(
    spec: Spec, directions: Any = None, *, listed: bool = False, form: NormalForm | None = None
) -> dict[str, Any]:
    """Return the part of either that the spec alone decides: what is proved something of.

    `listed`: all cells are, also those of nonlinearities: what is not affine in A_i needs them. The normal form is that
    of the spec, if it is known already; of given directions of the inputs else: see `NormalForm`.
    """
    if form is None and spec.problem.tracking == "output":
        form = output_form(spec, directions)
    plant = spec.problem.plant if form is None else form.plant
    listed = listed or plant.written is None or not plant.written.product
    listed = listed or (form is not None and any(X is not form.exact.T[0] for X in form.exact.T))
    return {
        "tracking": spec.problem.tracking,
        "plant": plant_content(plant) if listed else elements_content(plant),
        "generator": None if form is None else form_content(form, listed=listed),
    }


def output_form(spec: Spec, directions: Any = None) -> NormalForm:
    """Return the normal form of a spec, for a certificate's directions of inputs (ValueError if none) or its own."""
    plant = spec.problem.plant
    if directions is None:
        return spec_form(spec)
    m, p = plant.B.shape[1], len(plant.tracked)
    if [len(row) for row in directions] != [p] * m:
        raise ValueError("the directions of the inputs do not fit the plant")
    return normal_form(plant, directions=BallMatrix.of([[number(v) for v in row] for row in directions], (m, p)))


def generator_content(generator: TrajectoryGenerator) -> dict[str, Any]:
    """Return the content of generator.json: (15) and (16) in doubles."""
    form, shift, loads = generator.form, generator.shift, generator.form.plant.loads
    told = None
    if loads is not None:
        added = compensation(form.plant, form, len(form.eta_names), played_back=generator.played_back)
        told = loads_content(loads, added)
    return {
        "relative_degrees": list(form.degrees),
        "eta": list(form.eta_names),
        **lists(form, "T", "offset"),
        "cells": list(form.plant.cell_names),
        **lists(generator, "A_eta", "b_eta", "B_eta"),
        **lists(form, "alpha", "beta", "gamma", "right_inverse"),
        "shift": None if shift is None else shift.tolist(),
        "loads": told,
    }


def bound_content(spec: Spec, controller: ProvedController) -> dict[str, Any]:
    """Return the content of bounds.json."""
    words, found = spec.words, controller.claim(SignalBounds)
    table = [bound_entry(words, bounds) for bounds in (*found.acting, *found.starts)]
    for robust in controller.claims_of(Robust):
        table += [bound_entry(words, bounds, uncertain=True) for bounds in robust.bounds]
    plant, sizes = controller.plant, controller.sizes
    start = dict(zip(plant.states, sizes.state.tolist(), strict=True))
    if plant.loads is not None:
        start |= zip(plant.loads.names, sizes.load[list(plant.loads.where)].tolist(), strict=True)
    worst = {words.signal(form): size for form, size in found.from_sizes(controller).items()}
    return {
        "format": "pwatrack bounds 1",
        "name": spec.name,
        "spec_sha256": spec.sha256,
        "meaning": "signals are at most the sum of these bounds, each times the size of what acts; in_the_end: once "
        "the start is forgotten; at_worst: at any time, for what acts from the start on",
        "table": table,
        "start_within_sizes": {
            "sizes": start,
            "signals": {
                name: {"in_the_end": 0.0, "at_worst": size, "unit": unit} for (name, unit), size in worst.items()
            },
        },
    }


def _content(spec: Spec, K: Array | None, L: Array | None, proofs: Sequence[Any], **known: Any) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "claim": STATEMENT,
        "spec_sha256": spec.sha256,
        "set": {name: str(value) for name, value in spec.overrides.items()},
        **subject_content(spec, **known),
        "K": decimal_texts(K),
        "L": decimal_texts(L),
        "proofs": list(proofs),
    }


def _refutation(evidence: Impossibility) -> dict[str, Any]:
    against = evidence.refutation
    Z = {str(i): [list(row) for row in Z_i] for i, Z_i in against.Z.items()}
    if not isinstance(against, NoDichotomy):
        found = {"Z": Z} if against.between is None else against.between.content
        return {"rate": decimal(evidence.rate)} | found
    P = {str(i): packed(proof) for i, proof in against.P.items()}
    return {"no_P": "of any sign"} | ({"P": P} if P else {"Z": Z})
