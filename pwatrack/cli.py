"""The command line: parse, call, print."""

import json
from contextlib import nullcontext
from functools import partial
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from pwatrack.cli_export import Set, exports, folder
from pwatrack.report.terminal import console, refusals, refusals_as
from pwatrack.version import __version__

if TYPE_CHECKING:
    from concurrent.futures import Executor
    from contextlib import AbstractContextManager

    from pwatrack.commands.run import Shown
    from pwatrack.lmi.inequality import Solver

app = typer.Typer(
    help="Output tracking control of continuous piecewise affine systems, with proofs.",
    epilog="Example: pwatrack simulate specs/two_mass_backlash.yaml",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)

SpecPath = Annotated[Path, typer.Argument(metavar="SPEC", help="The YAML file.", show_default=False)]
Certificate = Annotated[
    Path, typer.Argument(metavar="DIR|FILE", help="A run folder or a certificate.json.", show_default=False)
]
Out = Annotated[
    Path | None,
    typer.Option("--out", parser=folder, metavar="DIR", help="Run folder.", show_default="runs/<name of the spec>"),
]
Plots = Annotated[
    Literal["all", "failed", "none"],
    typer.Option("--plots", help="Which runs have pictures: all, those that do not end as expected, none."),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]
Verbose = Annotated[
    bool, typer.Option("--verbose", "-v", help="Print all that is proved, and how long each step took.")
]
Outside = Annotated[bool, typer.Option("--allow-outside", help="Let specs refer to files outside of their folder.")]
Json = Annotated[bool, typer.Option("--json", help="Print run.json instead of the first screen.")]
Scheduler = Annotated[
    str | None,
    typer.Option("--scheduler", metavar="ADDRESS", help="Let the workers of this dask scheduler do it."),
]
SolverName = Annotated[
    Literal["structured", "clarabel", "cvxopt"] | None, typer.Option("--solver", help="Who is asked for solutions.")
]


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"pwatrack {__version__}")
        raise typer.Exit


@app.callback()
def main(
    context: typer.Context,
    _: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")] = False,
    style: Annotated[
        Literal["text", "json", "github"], typer.Option("--format", help="How errors are said, on stderr.")
    ] = "text",
) -> None:
    """Output tracking control of continuous piecewise affine systems, with proofs."""
    context.with_resource(refusals_as(style))  # until the command ends: a process may call several


@app.command(epilog="Example: pwatrack check specs/two_mass_backlash.yaml")
def check(
    spec_path: SpecPath,
    parameters: Set = None,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Print also facets, zero dynamics, and every route with its reason.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, for machines.")] = False,
    picture: Annotated[
        Path | None, typer.Option("--picture", metavar="FILE", help="Draw each nonlinearity, with its slopes.")
    ] = None,
    outside: Outside = False,
) -> None:
    """Say what the plant is, which routes there are, and whether the reference is one that they are about."""
    with refusals():
        from pwatrack.errors import PwatrackError
        from pwatrack.spec.load import assignments, load_spec

        report, refusal, reference, sizes, name, remarks = None, None, "", None, "", tuple[str, ...]()
        try:
            spec = load_spec(spec_path, assignments(parameters or []), outside=outside)

            from pwatrack.control.applicability import applicability  # which a spec in error does not need
            from pwatrack.lmi.solve import asking
            from pwatrack.workflow.pipeline import not_judged
            from pwatrack.workflow.simplified import checked
            from pwatrack.workflow.sizing import spec_sizes
            from pwatrack.workflow.tracking import reference_remarks

            problem, objectives, sizes = spec.problem, spec.objectives, spec_sizes(spec)
            asked = {"asked": objectives.practical, "uncertain": bool(objectives.uncertain)}
            known_before = getattr(problem.reference, "preview", True)
            with asking(objectives.solver):
                report = applicability(
                    problem.plant, tracking=problem.tracking, sizes=sizes, known=known_before, **asked
                )
                name = spec.name
                reference, sizes = checked(spec, report)
            remarks = (*reference_remarks(spec, report.form), *not_judged(spec))
        except PwatrackError as error:  # raised below what can be said of the plant
            refusal = error
        if picture is not None and report is not None:
            from pwatrack.report.plots.elements import write_nonlinearities

            write_nonlinearities(picture, spec)
        if as_json:
            from pwatrack.report.plant import check_json

            typer.echo(json.dumps(check_json(name, report, reference, sizes, refusal, remarks), indent=2))
        elif report is not None and verbose:
            from pwatrack.report.plant import print_plant

            print_plant(console(), name, report, reference, sizes, remarks)
        elif report is not None:
            from pwatrack.report.check import check_screen
            from pwatrack.report.screen import print_screen

            known: Any = {"reference": reference, "sizes": sizes, "remarks": remarks, "units": problem.units}
            print_screen(console(), check_screen(name, report, refused=refusal is not None, **known))
        if refusal is not None:
            raise refusal


@app.command(epilog="Example: pwatrack design specs/two_mass_backlash.yaml --set k2=0.3 --pareto")
def design(
    spec_path: SpecPath,
    out: Out = None,
    parameters: Set = None,
    solver: SolverName = None,
    pareto: Annotated[bool, typer.Option("--pareto", help="Draw what a faster decay costs in gain.")] = False,
    robust: Annotated[
        Literal["largest"] | None,
        typer.Option("--robust", help="Find how far the box of uncertain parameters can be scaled."),
    ] = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
    as_json: Json = False,
    outside: Outside = False,
) -> None:
    """Find the gains and prove them; write gains, certificate and generator."""
    chosen: dict[str, Any] = {"paretos": pareto, "scaled": robust is not None, "shown": _shown(quiet, verbose, as_json)}
    _run(spec_path, out, parameters, solver, simulated=False, outside=outside, **chosen)


@app.command(epilog="Example: pwatrack simulate specs/two_mass_backlash.yaml --out runs/first")
def simulate(
    spec_path: SpecPath,
    out: Out = None,
    parameters: Set = None,
    solver: SolverName = None,
    ensemble: Annotated[int | None, typer.Option(min=1, metavar="M", help="Also run M variations of the loop.")] = None,
    over: Annotated[
        Literal["initial", "parameters", "noise", "plane"] | None,
        typer.Option(help="What differs between them; plane: starts in two states.", show_default="initial"),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Of the random numbers that they are drawn with.", show_default="1")
    ] = None,
    scheduler: Scheduler = None,
    plots: Plots = "all",
    quiet: Quiet = False,
    verbose: Verbose = False,
    as_json: Json = False,
    outside: Outside = False,
    controller: Annotated[
        Path | None,
        typer.Option("--controller", metavar="FILE", help="Run this controller.json instead of designing one."),
    ] = None,
) -> None:
    """Design, then run the closed loop exactly; write traces and plots too."""
    for name, value in (("--over", over), ("--seed", seed), ("--scheduler", scheduler)):
        if ensemble is None and value is not None:
            raise typer.BadParameter("it goes with --ensemble M", param_hint=name)
    many = {"count": ensemble, "over": over or "initial", "seed": 1 if seed is None else seed} if ensemble else None
    chosen = {"stored": controller, "plots": plots, "shown": _shown(quiet, verbose, as_json), "outside": outside}
    _run(spec_path, out, parameters, solver, many, scheduler, simulated=True, **chosen)


@app.command(epilog="Example: pwatrack batch specs/ --jobs 2 --report report.xml")
def batch(
    paths: Annotated[
        list[Path], typer.Argument(metavar="PATH…", help="Specs, and folders of them.", show_default=False)
    ],
    out: Annotated[
        Path, typer.Option("--out", parser=folder, metavar="DIR", help="A run folder for each spec goes in here.")
    ] = Path("runs"),
    pattern: Annotated[
        str | None,
        typer.Option("--glob", metavar="PATTERN", help="What specs are named like.", show_default="*.yaml, *.yml"),
    ] = None,
    parameters: Set = None,
    jobs: Annotated[int, typer.Option("--jobs", min=1, help="Specs at a time, here.")] = 1,
    scheduler: Scheduler = None,
    timeout: Annotated[
        float, typer.Option("--timeout", min=1, help="Seconds before a spec is given up; inf for never.")
    ] = 600.0,
    memory: Annotated[
        float | None, typer.Option("--memory", min=1, help="Megabytes that a spec may take.", show_default="any")
    ] = None,
    fail_fast: Annotated[bool, typer.Option("--fail-fast", help="Begin no other once one has failed.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Run only what has changed or is not complete.")] = False,
    rerun: Annotated[
        Literal["failed", "all"] | None,
        typer.Option("--rerun", help="Run also what failed, or all.", show_default="all"),
    ] = None,
    plots: Plots = "all",
    outside: Outside = False,
    reports: Annotated[
        list[Path] | None,
        typer.Option("--report", metavar="FILE", help="Write a report: .xml, .jsonl, .sarif or .html."),
    ] = None,
    junit: Annotated[Path | None, typer.Option("--junit", metavar="FILE", help="Write a JUnit XML report.")] = None,
) -> None:
    """Design and simulate many specs, each by itself: one that crashes or hangs stops no other."""
    for name, value in (("--timeout", timeout), ("--memory", memory)):
        if value is not None and isnan(value):
            raise typer.BadParameter("it is no number", param_hint=name)
    if resume and rerun:
        raise typer.BadParameter("it says which specs to run, as --resume does", param_hint="--rerun")
    with refusals():
        from pwatrack.batch.command import batch
        from pwatrack.batch.run import Options

        options = Options(
            pattern=pattern,
            parameters=tuple(parameters or ()),
            plots=plots,
            outside=outside,
            jobs=jobs,
            timeout=timeout,
            memory=memory,
            fail_fast=fail_fast,
            again="changed" if resume else rerun or "all",
        )
        raise SystemExit(batch(paths, out, options, reports=reports or (), junit=junit, scheduler=scheduler))


@app.command(epilog="Example: pwatrack sweep specs/two_mass_backlash.yaml --sweep k2=0.1:0.9:17 --sweep d1=0.1:1:10")
def sweep(
    spec_path: SpecPath,
    ranges: Annotated[
        list[str] | None,
        typer.Option(
            "--sweep",
            metavar="NAME=LOW:HIGH:POINTS",
            help="A parameter that varies; may be repeated.",
            show_default="those of 'sweep' in the file",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", parser=folder, metavar="DIR", show_default="runs/<name>-sweep")
    ] = None,
    parameters: Set = None,
    method: Annotated[Literal["grid", "random", "lhs"], typer.Option(help="Where to look.")] = "grid",
    count: Annotated[
        int | None, typer.Option("--points", min=1, help="How often, where it is no grid.", show_default="100")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the random numbers.")] = 1,
    simulated: Annotated[bool, typer.Option("--simulate/--design", help="Whether to simulate too.")] = True,
    refine: Annotated[
        float | None,
        typer.Option(min=1e-15, max=1, metavar="SHARE", help="Find where proofs end, to a share of each range."),
    ] = None,
    jobs: Annotated[int, typer.Option("--jobs", min=1, help="Designs at a time, here.")] = 1,
    scheduler: Scheduler = None,
) -> None:
    """Design a spec at many values of its parameters: a table, curves or maps, and where proofs end."""
    if method == "grid" and count is not None:
        raise typer.BadParameter("a grid has its points in --sweep NAME=LOW:HIGH:POINTS", param_hint="--points")
    with refusals():
        from pwatrack.batch.find import run_name
        from pwatrack.batch.sweep import swept

        folder = out or Path("runs") / f"{run_name(spec_path)}-sweep"
        where: Any = {"method": method, "count": count or 100, "seed": seed, "refine": refine}
        how: Any = {"parameters": parameters or (), "simulated": simulated, "jobs": jobs, "scheduler": scheduler}
        code = swept(spec_path, ranges or (), folder, **where, **how)
    raise typer.Exit(code)


@app.command(epilog="Example: pwatrack compare runs/first runs/softer --picture errors.png")
def compare(
    folders: Annotated[list[Path], typer.Argument(metavar="RUN…", help="Run folders.", show_default=False)],
    picture: Annotated[
        Path | None, typer.Option("--picture", metavar="FILE", help="Draw all errors in one picture.")
    ] = None,
) -> None:
    """Put runs beside each other: verdicts and figures in a table, errors in one picture."""
    with refusals():
        from pwatrack.commands.compare import compare

        compare(console(), folders, picture)


@app.command(epilog="Example: pwatrack explain P303")
def explain(code: Annotated[str, typer.Argument(metavar="CODE", help="As errors end.", show_default=False)]) -> None:
    """Say what an error means, and what to do about it."""
    with refusals():
        from pwatrack.report.codes import explanation

        typer.echo(explanation(code))


@app.command(epilog="Example: pwatrack verify runs/two_mass_backlash")
def verify(
    path: Certificate,
    spec: Annotated[Path | None, typer.Option("--spec", metavar="SPEC", help="The spec it should belong to.")] = None,
) -> None:
    """Prove a certificate again from its file, with whole numbers only."""
    with refusals():
        from pwatrack.commands.verify import verify

        for sentence in verify(path, spec):
            typer.echo(sentence)


@app.command(epilog="Example: pwatrack certify runs/two_mass_backlash --out coq")
def certify(
    path: Certificate,
    out: Annotated[
        Path, typer.Option("--out", parser=folder, metavar="DIR", help="Where it goes.", show_default=False)
    ],
) -> None:
    """Write a certificate as a development for Coq, whose kernel proves the theorem for these gains."""
    with refusals():
        from pwatrack.commands.export import certify

        files = certify(path, out)
        typer.echo(f"Development in {out}/: {', '.join(files)}")
        typer.echo(f"Coq 8.16 with Bignums checks it: make -C {out}")


@app.command(epilog="Example: pwatrack init --from backlash drive.yaml")
def init(
    path: Annotated[Path, typer.Argument(metavar="[SPEC]", help="The file to write.", show_default=True)] = Path(
        "spec.yaml"
    ),
    kind: Annotated[
        Literal["output", "state", "backlash", "cells", "example"],
        typer.Option("--from", help="What to start from; example is that of the paper."),
    ] = "output",
) -> None:
    """Write a spec to start from, with comments, and the schema that editors complete it with."""
    with refusals():
        from pwatrack.starter import write_starter

        for written in write_starter(path, kind):
            typer.echo(written)
        typer.echo(f"next: pwatrack simulate {path}")


@app.command(epilog="Example: pwatrack schema --out pwatrack.schema.json")
def schema(
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Where to write it.", show_default="stdout")
    ] = None,
) -> None:
    """Print the JSON Schema of a spec: editors complete and check with it."""
    with refusals():
        from pwatrack.report.run_folder import written_at_once
        from pwatrack.spec.schema import schema_text

        if out is None:
            typer.echo(schema_text(), nl=False)
        else:
            with written_at_once(out) as temporary:
                temporary.write_text(schema_text(), encoding="utf-8")


def _shown(quiet: bool, verbose: bool, as_json: bool) -> "Shown":
    if quiet + verbose + as_json > 1:
        raise typer.BadParameter("one of --quiet, --verbose and --json", param_hint="--quiet")
    return "nothing" if quiet else "more" if verbose else "json" if as_json else "summary"


app.add_typer(exports, name="export")


def _run(
    path: Path,
    out: Path | None,
    parameters: list[str] | None,
    solver: "Solver | None",
    members: dict[str, Any] | None = None,
    scheduler: str | None = None,
    **options: Any,
) -> None:
    with refusals(), _drawing(options.get("plots", "none")) as drawing:
        from pwatrack.batch.find import run_name
        from pwatrack.commands.run import run

        folder = out or Path("runs") / run_name(path)
        task = partial(run, path, folder, parameters or [], solver, drawing=drawing, **options)
        if members is None or scheduler is None:
            task(members=members)
            return
        from pwatrack.batch.cluster import Cluster

        with Cluster(scheduler) as cluster:
            task(members={"executor": cluster, "workers": cluster.jobs, **members})


def _drawing(plots: str) -> "AbstractContextManager[Executor | None]":
    """Return who draws pictures while the rest goes on: other processes, on a single core nobody."""
    from pwatrack.cores import cores

    if plots != "all" or cores() == 1:
        return nullcontext()
    from pwatrack.batch.pool import DRAWING, Pool
    from pwatrack.report.drawing import PROCESSES, prepare

    pool = Pool(PROCESSES, preload=DRAWING)
    prepare(pool)  # at once: both import as long as this process does
    return pool
