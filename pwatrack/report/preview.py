"""What is said of an x_d that was worked out beforehand, for zero dynamics with unstable modes."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from pwatrack.arrays import up
from pwatrack.control.controller import Controller
from pwatrack.report.wording import all_cells
from pwatrack.spec.spec import Spec


def preview_content(controller: Controller) -> dict[str, Any]:
    """Return what run.json says of it; nothing where x_d is made by a generator that runs."""
    preview = controller.trajectory.preview
    if preview is None:
        return {}
    return {
        "preview": {
            "eta": list(preview.names),
            "residual": preview.residual.tolist(),
            "terms": preview.terms.tolist(),
            "jumps": preview.jumps.max(axis=0, initial=0.0).tolist(),
            "lead": preview.lead,
            "error": controller.left_by_preview,
        }
    }


def preview_rows(spec: Spec, controller: Controller) -> Iterator[str]:
    """Yield what is proved of it, how far ahead it looks, and what is left of its own error."""
    preview, form = controller.trajectory.preview, controller.form
    assert preview is not None
    assert form is not None
    cells = len(spec.problem.plant.A)
    etas = ", ".join(preview.names)
    yield f"proved for {all_cells(cells)}, with a P of mixed sign: there is one bounded x_d; η = {etas}"
    before = f"{preview.lead:.3g} s before" if preview.lead else "as"
    ahead = "" if preview.lead is None else f"; η leaves its rest {before} the reference moves"
    yield f"x_d and u_ff are worked out for this run and played back: the reference is known beforehand{ahead}"
    share = float(np.max(preview.residual / np.maximum(preview.terms, np.finfo(float).tiny)))
    units = {spec.problem.units.get(name, "") for name in form.plant.tracked_names}
    unit = units.pop() if len(units) == 1 else ""
    left = f"|y − y_d| ≤ {up(controller.left_by_preview)} {unit}".rstrip()
    yield (
        f"(15) is satisfied to {share:.1e} of its terms at all times of this run; with the jumps of what is played "
        f"back that leaves {left} in the end"
    )
