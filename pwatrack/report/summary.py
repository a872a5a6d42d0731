"""The short text for people: what was found, in the terminal."""

from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from pwatrack.arrays import Array
from pwatrack.control.controller import Controller
from pwatrack.control.generator import TrajectoryGenerator
from pwatrack.model.normal_form import NormalForm
from pwatrack.pipeline import Result
from pwatrack.report.files import measures
from pwatrack.spec.load import Spec


def print_plant(console: Console, spec: Spec, form: NormalForm) -> None:
    """Say what the plant is: cells, facets, relative degree, zero dynamics."""
    plant = spec.plant
    n, m, q = plant.A.shape[1], plant.B.shape[1], plant.C.shape[0]
    table = _titled(spec.name)
    table.add_row(
        "plant (1)",
        f"{n} states, {m} input, {q} output, {len(plant.cell_names)} cells: " + ", ".join(plant.cell_names),
    )
    for facet in plant.partition.facets:
        one, other = plant.cell_names[facet.i], plant.cell_names[facet.j]
        table.add_row("facet", f"{one} | {other} on {plant.hyperplane_text(facet.k)}: continuous")
    table.add_row("relative degree", f"{form.r}, the same in all cells; form (11) holds")
    table.add_row("internal states η", ", ".join(form.eta_names) or "none")
    for name, A_eta in zip(plant.cell_names, form.Psi, strict=True):
        if A_eta.size:
            table.add_row(f"zero dynamics in '{name}'", "eigenvalues " + _eigenvalues(A_eta))
    console.print(table)


def print_design(console: Console, spec: Spec, controller: Controller) -> None:
    """Say what was proved and the gains."""
    design, generator = controller.design, controller.generator
    table = _titled(spec.name)
    for claim, letter, gain, given, certificate in (
        ("(8) controller", "K", design.K, spec.K is not None, design.controller),
        ("(9) observer", "Lᵀ", design.L.T, spec.L is not None, design.observer),
    ):
        table.add_row(claim, f"proved for all {len(certificate.M)} cells, rate {certificate.rate:.4g} 1/s")
        size = f"‖{letter[0]}‖ = {np.linalg.norm(gain, 2):.4g}, {'given' if given else 'designed'}"
        table.add_row("", f"{letter} = {_matrix(gain)}, {size}")
    if generator is None:
        table.add_row("Assumption 1", "x_d and u_ff satisfy (3)")
        table.add_row("Theorem 2", "all solutions track x_d with error going to 0, if x_d stays bounded")
    else:
        _generator_rows(table, generator)
    console.print(table)


def _generator_rows(table: Table, generator: TrajectoryGenerator) -> None:
    if not generator.A_eta.shape[1]:
        table.add_row("(17) generator", "none needed: relative degree = number of states")
    else:
        rate = generator.certificate.rate
        table.add_row("(17) generator", f"proved, rate {rate:.4g} 1/s; η = {', '.join(generator.form.eta_names)}")
        if generator.shift is not None:
            table.add_row("Assumption 2", f"holds with η = η̄ + M ξ_d, M = {_matrix(generator.shift)}")
        else:
            reason = "(17) suffices, as the tracking dynamics are continuous in (ξ_d, η)"
            table.add_row("Assumption 2", f"holds for no shift; {reason}")
    table.add_row("Theorem 3", "all solutions track y_d with error going to 0")


def print_result(console: Console, result: Result, folder: Path) -> None:
    """Say how the simulation went and where the files are."""
    figures = measures(result)
    unit = result.spec.units.get(result.spec.plant.outputs[0], "")
    table = _titled(None)
    table.add_row(
        "simulated",
        f"{result.response.t[-1]:g} s, {figures['mode_changes']} mode changes, {figures['joint_modes']} joint modes",
    )
    table.add_row(
        "tracking error",
        f"at most {figures['final_tracking_error']:.2e} {unit} in the last tenth of the time "
        f"({figures['largest_tracking_error']:.2e} at worst)",
    )
    table.add_row("observer error", f"‖x − x̂‖ = {figures['final_observer_error']:.2e} at the end")
    table.add_row(
        "largest input",
        f"{figures['largest_input']:.4g} {result.spec.units.get(result.spec.plant.inputs[0], '')}",
    )
    console.print(table)
    print_files(console, folder)


def print_files(console: Console, folder: Path) -> None:
    """Say where the files are."""
    console.print(
        f"Results in {folder!s}/: " + ", ".join(sorted(p.name for p in folder.iterdir() if not p.name.startswith("."))),
        highlight=False,
        soft_wrap=True,
    )


def _titled(title: str | None) -> Table:
    table = Table(
        show_header=False,
        box=None,
        padding=(0, 2, 0, 0),
        title=title if title else None,
        title_justify="left",
        title_style="bold",
    )
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    return table


def _matrix(X: Array) -> str:
    rows = [" ".join(f"{v:.5g}" for v in row) for row in X]
    return "[" + "; ".join(rows) + "]"


def _eigenvalues(A: Array) -> str:
    values = np.linalg.eigvals(A)
    return ", ".join(f"{v.real:.4g}{v.imag:+.4g}j" if v.imag else f"{v.real:.4g}" for v in values)
