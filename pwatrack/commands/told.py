"""A design as certificate.json tells it: the objects that its files are written from, made again without a solver."""

from dataclasses import replace
from typing import Any, cast

from pwatrack.arrays import Array
from pwatrack.claims.cost import read_costs
from pwatrack.claims.decay import read_proofs
from pwatrack.claims.exact_text import doubles
from pwatrack.claims.practical import merged_ways
from pwatrack.claims.registry import read
from pwatrack.control.controller import ProvedController
from pwatrack.control.synthesis import Gains
from pwatrack.lmi.dichotomy import Dichotomy
from pwatrack.report.certificate import output_form
from pwatrack.spec.spec import Spec
from pwatrack.workflow.headroom import room_within_limits
from pwatrack.workflow.pipeline import asked_of
from pwatrack.workflow.simplified import merged_spec
from pwatrack.workflow.sizing import spec_sizes
from pwatrack.workflow.tracking import desired_trajectory

_NOT_TOLD = cast(Any, None)  # what exact proofs were made from: no file has it, and nothing is written from it


def told_design(spec: Spec, content: dict[str, Any]) -> ProvedController:
    """Return the design that a certificate tells, with the plant and the reference of a spec.

    Args:
        spec: What it is to be a design of.
        content: What an audited certificate.json holds.

    Raises:
        ValueError: If gains or elements do not fit to the spec.
        PwatrackError: As `desired_trajectory`.
    """
    true = spec.problem.plant
    spec = merged_as_told(spec, content)
    form = output_form(spec, content["generator"]["directions"]) if content["generator"] else None
    trajectory, generator = desired_trajectory(spec, True, form)
    plant = spec.problem.plant if generator is None else generator.form.plant
    proofs = read_proofs(content)
    for proof in proofs:
        if isinstance(proof, Dichotomy) and generator is not None:
            generator = replace(generator, certificate=proof)
    K, L, _ = told_gains(content)
    controller = ProvedController(
        plant=plant,
        running=plant if content["practical"] is None else true,
        design=Gains(K=K, L=L, controller=_NOT_TOLD, observer=_NOT_TOLD),
        trajectory=trajectory,
        generator=generator,
        proofs=tuple(proof for proof in proofs if not isinstance(proof, Dichotomy)),
        sizes=spec_sizes(spec),
    )
    room = room_within_limits(spec, trajectory, generator, controller.sizes)
    return read(content, controller, asked_of(spec, room))


def merged_as_told(spec: Spec, content: dict[str, Any]) -> Spec:
    """Return the spec that a certificate is about: with those cells merged that are merged there."""
    practical = content["practical"]
    if practical is None:
        return spec
    ways = merged_ways(practical["merged"], spec.problem.plant)
    return merged_spec(spec, ways, watched=practical["observer_runs"] == "all cells")


def told_gains(content: dict[str, Any]) -> tuple[Array, Array, dict[str, Array]]:
    """Return K, L and the bounds of costs."""
    return doubles(content["K"]), doubles(content["L"]), read_costs(content)
