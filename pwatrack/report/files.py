"""Result -> files: JSON, CSV and, through `plots`, PNG."""

import csv
import hashlib
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from itertools import repeat
from math import degrees, isfinite
from pathlib import Path
from typing import Any

import numpy as np

from pwatrack.arrays import Array
from pwatrack.claims.bounds import BOUNDS
from pwatrack.claims.cost import Costs
from pwatrack.claims.practical import Practical
from pwatrack.claims.registry import figures
from pwatrack.claims.robust import Robust
from pwatrack.control.controller import ProvedController
from pwatrack.control.pareto import Front
from pwatrack.errors import ExitCode, PwatrackError
from pwatrack.lmi.infeasibility import Impossibility
from pwatrack.report.certificate import bound_content, refusal_certificate
from pwatrack.report.controller import known_start, starts, written
from pwatrack.report.drawing import Picture, begin, picture
from pwatrack.report.figures import ensemble_measures, figure_content, load_content, measures, member_figures, norm_unit
from pwatrack.report.kept_spec import keep
from pwatrack.report.page import page
from pwatrack.report.parameters import box_figures, how_far_content, largest_content
from pwatrack.report.required import Checked
from pwatrack.report.run_folder import PAGE, REFUSAL, SUMMARY, Plots, RunFolder, run_folder
from pwatrack.report.screen import Findings
from pwatrack.simulation.closed_loop import ClosedLoop, Response
from pwatrack.simulation.flow import SwitchedPart
from pwatrack.simulation.layout import Actuator, RateLimit
from pwatrack.simulation.margins import Margins
from pwatrack.simulation.trace import Trace
from pwatrack.spec.load import spec_bytes
from pwatrack.spec.spec import Spec
from pwatrack.version import versions
from pwatrack.workflow.how_far import HowFar
from pwatrack.workflow.outcome import SimulatedLoop
from pwatrack.workflow.variation import EnsembleResult

Effort = Mapping[str, Mapping[str, float]]  # what a run took: `seconds` by step, programs `answered` by solver

_ROWS = 10_000  # that are turned to text at a time
_NONE: Effort = {"seconds": {}, "answered": {}}  # an effort that nobody measured


def write_design(spec: Spec, controller: ProvedController, folder: str | Path) -> Path:
    """Write the files of a design: see `write`.

    Example:
        >>> from tempfile import mkdtemp
        >>> from pwatrack import design, load_spec
        >>> spec = load_spec("specs/gallery/kinked_tanks.yaml")
        >>> sorted(path.name for path in write_design(spec, design(spec), mkdtemp()).iterdir())[:3]
        ['bounds.json', 'certificate.json', 'controller.json']
    """
    return write(Findings(spec=spec, controller=controller), folder)


def write_result(result: SimulatedLoop, folder: str | Path, *, many: EnsembleResult | None = None, **how: Any) -> Path:
    """Write the files of a run, and of its ensemble: see `write`.

    Example:
        >>> from tempfile import mkdtemp
        >>> from pwatrack import load_spec, simulate
        >>> result = simulate(load_spec("specs/gallery/kinked_tanks.yaml"))
        >>> (write_result(result, mkdtemp(), plots="none") / "trace.csv").is_file()
        True
    """
    return write(Findings(spec=result.spec, controller=result.controller, result=result, many=many), folder, **how)


def write(
    found: Findings,
    folder: str | Path,
    *,
    fronts: Sequence[Front] = (),
    broken: PwatrackError | None = None,
    effort: Effort = _NONE,
    warned: bool = False,
    summary: str | None = None,
    plots: Plots = "all",
    executor: Executor | None = None,
) -> Path:
    """Write all files of a design, and those of its run and ensemble; return the folder, which is made.

    An earlier run in it is replaced, other files stay; raises InvalidSpec, with nothing changed, if that cannot be.
    `fronts` are what `pareto` returned, `broken` is why a simulation broke off, `summary` is for summary.txt; for
    run.json are `effort`, what it took, and, if `warned`, warnings and margins. `plots`: whether pictures and the page
    are made, or only if the run does not end as its spec expects, by processes of an `executor`, if there is one.
    """
    spec, controller, result = found.spec, found.controller, found.result
    index = _index(spec, effort) | proved_content(spec, controller)
    index |= {"remarks": found.remarks} if result is None else _result_content(result, index)
    if found.many:
        index["ensemble"] = ensemble_measures(found.many)
    if found.missed:
        index["exit"] = int(ExitCode.CHECK_FAILED)
    index["remarks"] += [f"required: {text}" for _, text in found.not_looked_at]
    if found.checked:
        index["requirements"] = [each.content for each in found.checked]
    said = "" if broken is None else "; ".join(problem.message for problem in broken.problems)
    why = ["".join(c if c.isprintable() else " " for c in said)] if said else []  # it may have the path of the spec
    with run_folder(folder) as run:
        certificate = _design_files(run, found, [*found.missed, *why])
        if fronts:
            _fronts(run, spec, fronts)
        if result is not None:
            wanted = plots == "all" or (plots == "failed" and index["exit"] != spec.expected_exit)
            pictures = _run_files(run, found, result, executor, drawn=wanted)
            if wanted:
                run.text(PAGE, page(found, pictures, certificate=certificate, summary=summary))
        if warned:
            index |= {"warnings": list(found.assessment.warnings), "questions": list(found.assessment.questions)}
            index["margins"] = [_margin_content(one) for one in found.assessment.margins]
        if summary is not None:
            run.text(SUMMARY, summary)
        if found.largest is not None:
            index["largest_box"] = largest_content(found.largest)
        if broken is not None:
            index |= {"simulation": {"outcome": "broken off", "said": said}, "exit": int(broken.code)}
        run.commit(index)
    return Path(folder)


def _run_files(
    run: RunFolder, found: Findings, result: SimulatedLoop, executor: Executor | None, *, drawn: bool
) -> dict[str, str]:
    """Write what a run leaves beside its design, and return its pictures as SVG files, by name."""
    pictures = begin(result, executor) if drawn else dict[str, Picture]
    _signals(run, result)
    fan = _ensemble(run, found.many, found.checked, drawn=drawn) if found.many else {}
    every = {**fan, **pictures()}
    for name, each in every.items():
        run.place(f"{name}.png").write_bytes(each.png)
    return {name: each.svg for name, each in every.items()}


def _result_content(result: SimulatedLoop, proved: Mapping[str, Any]) -> dict[str, Any]:
    # of what goes to 0: what each column that has a desired value counts in
    sizes = dict(zip(result.controller.error_names, result.response.error_sizes.tolist(), strict=True))
    content: dict[str, Any] = {
        "figures": proved["figures"] | figure_content(measures(result)),
        "simulation": {
            "outcome": result.outcome.kind,
            "said": result.outcome.text,
            "sampled": list(result.figures.sampled),
            "time_share": result.figures.time_share,
        },
        "conditions": result.loop.conditions.texts(result.spec.problem.plant, result.spec.problem.units),
        "remarks": list(result.remarks),
        "estimates": load_content(result),
        "tracked": {"sizes": sizes, "unit": norm_unit(result.spec, result.controller.error_names)},
    }
    for robust in result.controller.claims_of(Robust) if result.w is not None else ():
        content["uncertain"] = proved["uncertain"] | {"along_x_d": box_figures(result, robust)}
    return content


def _design_files(run: RunFolder, found: Findings, failed: Sequence[str]) -> str:
    """Write what a design leaves, and return the text of certificate.json."""
    spec, controller, result = found.spec, found.controller, found.result
    start = known_start(spec, controller) if result is None else starts(result.loop, result.start)
    keep(run, spec)
    costs = {role.name: X for claim in controller.claims_of(Costs) for role, X in claim.X.items()}
    run.json("gains.json", gain_content(controller.design.K, controller.design.L, costs))
    made = written(spec, controller, start, failed)
    run.text("certificate.json", made.certificate)
    run.json(BOUNDS, bound_content(spec, controller))
    if made.generator is not None:
        run.json("generator.json", made.generator)
    for practical in controller.claims_of(Practical):
        if isinstance(practical.evidence, Impossibility):
            run.json(REFUSAL, refusal_certificate(spec, practical.evidence))
    if made.controller is not None:
        run.json("controller.json", made.controller)
    return made.certificate


def gain_content(K: Array, L: Array, costs: Mapping[str, Array]) -> dict[str, Any]:
    """Return the content of gains.json."""
    gains = {"convention": "u = K (x_hat - x_d) + u_ff; observer + L (y_hat - y)", "K": K.tolist(), "L": L.tolist()}
    return gains | ({"cost_bounds": {part: X.tolist() for part, X in costs.items()}} if costs else {})


def proved_content(spec: Spec, controller: ProvedController) -> dict[str, Any]:
    """Return what of run.json follows from the spec and the proofs: nothing in it is simulated, or found on the way."""
    index, known = _index(spec, _NONE), ("name", "spec_sha256", "parameters", "verdict", "solver")
    told = {name: index[name] for name in known}
    return told | {"sizes": _size_content(controller), **figures(spec.words, controller)}


def _margin_content(one: Margins) -> dict[str, Any]:
    """Return the margins of a cell at an input as run.json has them, from 1; what nothing ends is None."""
    ends = [v if isfinite(v) else None for v in (*one.gain, degrees(one.phase), one.delay, one.crossover)]
    margins = {"gain": ends[:2], "phase": ends[2], "delay": ends[3], "crossover": ends[4]}
    return {"cell": one.cell + 1, "input": one.input + 1, **margins}


def _size_content(controller: ProvedController) -> dict[str, dict[str, float]]:
    """Return the sizes that the gains were weighed with; those of estimates stand behind those of the states."""
    plant, sizes = controller.plant, controller.sizes
    loads = () if plant.loads is None else plant.loads.each
    estimates = [load.name + "'" * k for load in loads for k in range(load.order)]  # a sinusoid has two
    return {
        "states": dict(zip([*plant.states, *estimates], [*sizes.state.tolist(), *sizes.load.tolist()], strict=True)),
        "inputs": dict(zip(plant.inputs, sizes.input.tolist(), strict=True)),
        "outputs": dict(zip(plant.outputs, sizes.output.tolist(), strict=True)),
    }


def write_refusal(
    refusal: PwatrackError,
    folder: str | Path,
    *,
    path: Path,
    parameters: Mapping[str, float | str],
    spec: Spec | None = None,
    effort: Effort = _NONE,
    far: HowFar | None = None,
) -> bool:
    """Write run.json with the verdict and its reasons, and refusal.json where there is a proof.

    Return whether there is a proof. The spec is there if its file, at `path`, could be read, and `far` if it was looked
    for how far away it is; the rest is as for `write`.
    """
    proof, index = None, dict[str, Any]()
    if spec is None:
        index |= {"name": path.stem, "spec": str(path), "spec_sha256": hashlib.sha256(spec_bytes(path)).hexdigest()}
        index |= {"parameters": dict(parameters), **effort, "versions": versions()}
    else:
        index = _index(spec, effort) | {"remarks": list(spec.problem.plant.remarks)}
        if isinstance(refusal.evidence, Impossibility):
            proof = refusal_certificate(spec, refusal.evidence)
    index |= {"verdict": refusal.code.verdict, "simulation": None, "exit": int(refusal.code)}
    index["reasons"] = [
        {"message": p.message, "hint": p.hint, "place": None if p.place is None else str(p.place)}
        for p in refusal.problems
    ]
    if far is not None:
        index["how_far"] = how_far_content(far)
    with run_folder(folder) as run:
        if proof is not None:
            run.json(REFUSAL, proof)
        if spec is not None:
            keep(run, spec)
        run.commit(index)
    return proof is not None


def _fronts(run: RunFolder, spec: Spec, fronts: Sequence[Front]) -> None:
    from pwatrack.report.plots.canvas import png
    from pwatrack.report.plots.spread import pareto_fronts

    points = [
        (front.role.name, *point)
        for front in fronts
        for point in sorted([*zip(front.rates.tolist(), front.norms.tolist(), repeat(0)), (*front.chosen, 1)])
    ]
    run.rows("pareto.csv", ["part", "rate", "norm", "chosen"], points)
    run.place("pareto.png").write_bytes(png(pareto_fronts(spec.name, fronts)))


def _signals(run: RunFolder, result: SimulatedLoop) -> None:
    columns = [name for names, _ in signal_columns(result, result.response) for name in names]
    columns += ["cell_" + part.name.replace(" ", "_") for part in result.loop.flow.parts]
    with (
        run.place("trace.csv").open("w", encoding="utf-8", newline="") as traces,
        run.place("events.csv").open("w", encoding="utf-8", newline="") as events,
    ):
        event = csv.writer(events)
        csv.writer(traces).writerow(columns)
        event.writerow(["t", "part", "from_cell", "to_cell", "guard"])
        for block in result.blocks():
            for first in range(0, len(block.t), _ROWS):
                rows = slice(first, first + _ROWS)
                values: Array = np.column_stack([values[rows] for _, values in signal_columns(result, block)])
                modes = block.trace.modes[rows].tolist()
                for row, cells in zip(values.tolist(), modes, strict=True):  # numbers need no quotes
                    traces.write(",".join(map(repr, row + cells)) + "\r\n")
            event.writerows(_event_rows(result.loop, block.trace))


def signal_columns(result: SimulatedLoop, response: Response) -> Sequence[tuple[Sequence[str], Array]]:
    """Return the names and values of all signals at some samples: t (K,), the others (K, ·)."""
    plant = result.spec.problem.plant
    loads = () if plant.loads is None else plant.loads.names
    forms = [k for k, name in enumerate(plant.tracked_names) if name not in plant.outputs]
    other = result.loop.conditions.sampling is not None or result.loop.conditions.noise is not None  # than y is read
    return (
        (["t"], response.t),
        (plant.states, response.x),
        ([f"{s}_hat" for s in plant.states], response.x_hat),
        ([f"{s}_d" for s in plant.states], response.x_d),
        ([f"eta_hat{k + 1}" for k in range(response.eta_hat.shape[1])], response.eta_hat),
        (plant.outputs, response.y),
        ([f"{y}_d" for y in plant.outputs], response.y_d),
        *([([f"{y}_measured" for y in plant.outputs], response.measured)] if other else []),
        ([plant.tracked_names[k] for k in forms], response.tracked[:, forms]),
        ([f"{plant.tracked_names[k]}_d" for k in forms], response.tracked_d[:, forms]),
        (loads, response.loads),
        ([f"{name}_hat" for name in loads], response.estimates),
        (plant.inputs, response.u),
        ([f"{u}_ff" for u in plant.inputs], response.u_ff),
    )


def _event_rows(loop: ClosedLoop, trace: Trace) -> Iterator[list[str]]:
    texts = dict[tuple[str, int, int], str]()
    for event in trace.events:
        for part, before, after in zip(loop.flow.parts, event.before, event.after, strict=True):
            if part.cells[before] != part.cells[after]:
                change = part.name, before, after
                if change not in texts:
                    texts[change] = _guard_text(loop, part, before, after)
                yield [repr(event.t), part.name, part.cells[before], part.cells[after], texts[change]]


def _guard_text(loop: ClosedLoop, part: SwitchedPart, before: int, after: int) -> str:
    """Say which hyperplanes lie between two cells of a part, or which limit of an input between two segments."""
    if isinstance(part, Actuator):
        limits = {level for level in (part.levels[before], part.levels[after]) if level is not None}
        return " and ".join(f"{loop.controller.plant.inputs[part.input]} = {limit:g}" for limit in sorted(limits))
    if isinstance(part, RateLimit):
        return f"change of {loop.controller.plant.inputs[part.input]} by {part.most:g}"
    model = loop.controller.plant
    plant = {"plant": loop.plant, "observer": model.model}.get(part.name, model)
    return " and ".join(plant.hyperplane_text(k) for k in plant.partition.between(before, after))


def _ensemble(run: RunFolder, many: EnsembleResult, checked: Sequence[Checked], *, drawn: bool) -> dict[str, Picture]:
    """Write a row for each member, empty where it has no figure, and return the picture of all, by name."""
    kept, values, figures = many.ensemble, many.variation.values, member_figures(many)
    header = ["member", *values, *figures, "mode_changes", "unresolved", "outcome"]
    columns = [*values.values(), *figures.values(), kept.mode_changes, kept.unresolved]
    rows = zip(*(np.where(np.isfinite(v), v.astype(object), "").tolist() for v in columns), strict=True)
    ends = (outcome.kind for outcome in many.outcomes)
    run.rows("ensemble.csv", header, ((k, *row, end) for k, (row, end) in enumerate(zip(rows, ends, strict=True), 1)))
    if not drawn:
        return {}
    from pwatrack.report.plots.spread import fan, starts_in_plane

    plane = {"starts": picture(starts_in_plane(many))} if many.variation.over == "plane" else {}
    return {"ensemble": picture(fan(many, checked))} | plane


def _index(spec: Spec, effort: Effort) -> dict[str, Any]:
    return {
        "name": spec.name,
        "spec": str(spec.path),
        "spec_sha256": spec.sha256,
        "parameters": dict(spec.parameters),
        "verdict": "proved",
        "simulation": None,
        "exit": int(ExitCode.DONE),
        "solver": spec.objectives.solver,
        **effort,
        "versions": versions(),
    }
