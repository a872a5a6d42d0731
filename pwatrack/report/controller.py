"""What controller.json says of a design, with the digest of its proof."""

import hashlib
from collections.abc import Sequence
from typing import Any, NamedTuple

from pwatrack.arrays import Array
from pwatrack.control.controller import ProvedController
from pwatrack.errors import PwatrackError
from pwatrack.export.stored import content
from pwatrack.model.nonlinearity import MOST_LISTED
from pwatrack.report.certificate import design_certificate, generator_content
from pwatrack.report.run_folder import json_text
from pwatrack.simulation.closed_loop import ClosedLoop, closed_loop
from pwatrack.spec.spec import Spec
from pwatrack.workflow.pipeline import start_of


class Written(NamedTuple):
    """A design as its files tell it: certificate.json as text, and the others, None where there is no such file."""

    certificate: str
    generator: dict[str, Any] | None
    controller: dict[str, Any] | None


def written(
    spec: Spec, controller: ProvedController, start: dict[str, Any] | None, failed: Sequence[str] = ()
) -> Written:
    """Return a design as its files tell it; `start` and `failed` as for `stored.content`."""
    certificate, made = json_text(design_certificate(spec, controller)), controller.generator
    if not has_tables(controller):
        return Written(certificate, None, None)
    generator = None if made is None else generator_content(made)
    proof = hashlib.sha256(certificate.encode()).hexdigest()
    told = content(spec, controller, proof=proof, generator=generator, start=start, failed=failed)
    return Written(certificate, generator, told)


def has_tables(controller: ProvedController) -> bool:
    """Say whether a controller has few enough cells for tables of them all."""
    return max(len(controller.plant.A), len(controller.plant.model.A)) <= MOST_LISTED


def known_start(spec: Spec, controller: ProvedController) -> dict[str, Any] | None:
    """Return where observer and generator of a design start in a run; None where that is refused, or has no tables."""
    if not has_tables(controller):
        return None
    try:
        loop = closed_loop(controller, spec.scenario.conditions)
        return starts(loop, start_of(spec, loop)[0])
    except PwatrackError:
        return None


def starts(loop: ClosedLoop, start: Array) -> dict[str, Any]:
    """Return where observer and generator of a loop start."""
    return {"x_hat": start[loop.at.observer].tolist(), "eta_hat": start[loop.at.eta_hat].tolist()}
