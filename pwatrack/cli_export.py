"""`pwatrack export …`: parse, call, print."""

from collections.abc import Callable
from inspect import signature
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from pwatrack.export.notation import LANGUAGES, Numbers
from pwatrack.report.terminal import compiling, console, refusals


def folder(text: str | Path) -> Path:
    """Return the folder that an option names; an empty text names none, and is not the current one."""
    if not str(text):
        raise typer.BadParameter("no folder is named: '.' is the current one")
    return Path(text)


Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE", help="Replace a parameter; may be repeated."),
]
Exported = Annotated[
    Path, typer.Argument(metavar="RUN|SPEC", help="A run folder, a spec or a controller.json.", show_default=False)
]
Folder = Annotated[Path, typer.Option("--out", parser=folder, metavar="DIR", help="Where it goes.", show_default=False)]
SampleTime = Annotated[float | None, typer.Option("--sample-time", metavar="H", help="In s, instead of the spec's.")]
Prefix = Annotated[str | None, typer.Option(help="Prefix of all names.", show_default="from the spec's name")]
Single = Annotated[bool, typer.Option("--float32", help="Compute in single floats.")]
Whole = Annotated[bool, typer.Option("--int32", help="Compute in whole numbers of 32 bits; what they round is proved.")]
From = Annotated[Literal["inside", "outside"], typer.Option(help="Where the reference comes from.")]
Unproved = Annotated[bool, typer.Option("--unproved", help="Export what is not proved, too.")]
Failed = Annotated[bool, typer.Option("--failed", help="Export the controller of a run that failed, too.")]

exports = typer.Typer(help="Write a controller for a machine.", no_args_is_help=True)


def _command(to: str) -> Callable[..., None]:
    def command(
        target: Exported,
        out: Folder,
        parameters: Set = None,
        sample_time: SampleTime = None,
        name: Prefix = None,
        single: Single = False,
        whole: Whole = False,
        reference: From = "inside",
        unproved: Unproved = False,
        failed: Failed = False,
    ) -> None:
        if single and whole:
            raise typer.BadParameter("numbers are of one kind: --float32 or --int32", param_hint="--int32")
        asked = {"target": target, "name": name, "unproved": unproved, "failed": failed}
        kind: Numbers = "int32" if whole else "float32" if single else "float64"
        _export(to, out, parameters, sample_time, reference, asked, numbers=kind)

    known, offered = signature(command), {"single": "float32", "whole": "int32"}
    left = [each for name, each in known.parameters.items() if offered.get(name, "float64") in LANGUAGES[to].numbers]
    command.__signature__ = known.replace(parameters=left)  # type: ignore[attr-defined]
    return command


for _to, _language in LANGUAGES.items():
    exports.command(name=_to, help=_language.help, epilog=f"Example: pwatrack export {_to} {_language.example}")(
        _command(_to)
    )


@exports.command(name="fmu", epilog="Example: pwatrack export fmu specs/two_mass_machine.yaml --out blocks --fmi 3")
def export_to_fmu(
    target: Exported,
    out: Folder,
    parameters: Set = None,
    sample_time: SampleTime = None,
    name: Prefix = None,
    fmi: Annotated[Literal["2", "3", "both"], typer.Option(help="Version of FMI.")] = "both",
    of: Annotated[Literal["controller", "plant", "both"], typer.Option(help="What is exported.")] = "both",
    reference: From = "inside",
    unproved: Unproved = False,
    failed: Failed = False,
) -> None:
    """Write controller and plant as FMUs for co-simulation."""
    versions = (2, 3) if fmi == "both" else (int(fmi),)
    parts = ("controller", "plant") if of == "both" else (of,)
    asked = {"target": target, "name": name, "unproved": unproved, "failed": failed}
    _export("fmu", out, parameters, sample_time, reference, asked, versions=versions, of=parts)


def _export(
    to: str,
    out: Path,
    parameters: list[str] | None,
    sample_time: float | None,
    reference: str,
    asked: dict[str, Any],
    **options: Any,
) -> None:
    if sample_time is not None and not 0 < sample_time < float("inf"):
        raise typer.BadParameter("it is no positive number", param_hint="--sample-time")
    with refusals():
        from pwatrack.commands.export import ExportTask, export, export_fmu
        from pwatrack.spec.load import assignments

        asked |= {"parameters": assignments(parameters or []), "sample_time": sample_time}
        task = ExportTask(given=reference == "outside", **asked)
        with compiling(console(stderr=True)):
            said = export_fmu(task, out, **options) if to == "fmu" else export(to, task, out, **options)
        typer.echo("\n".join(said))
