"""A certificate as a development for Coq, whose kernel decides its inequalities and applies the theorem to them.

The theory is written once, in `theory`: vectors, definiteness by elimination, convergence of continuous piecewise
affine loops, and what is left to computation. A run adds its numbers, as whole numbers over one denominator.
"""

import re
from collections.abc import Iterator
from fractions import Fraction
from importlib.resources import files
from itertools import chain
from math import gcd, lcm
from textwrap import fill
from typing import Any

import flint

from pwatrack.errors import InvalidSpec
from pwatrack.export.source import template
from pwatrack.lmi.audit.form import normal_form
from pwatrack.lmi.audit.matrices import Matrix, product
from pwatrack.lmi.audit.plant import AuditedPlant, at_centres
from pwatrack.lmi.audit.reading import matrix, number, packed
from pwatrack.lmi.audit.shape import kind, refuses

THEORY = ("Vectors", "Definite", "Convergence", "Instance")
RUN = "Run"
_WIDTH = 110  # of a line
_MOST_CELLS = 1000  # that are written down
_TYPES = {  # of names that are not matrices
    "A": "list matrix",
    "A_seen": "list matrix",
    "A_eta": "list matrix",
    "cells": "list (list (row * BigZ.t)%type)",
    "d": "BigZ.t",
}
_APART = "(* The observer runs all cells and the gain is of merged ones: no theorem here joins the two. *)\n"
_UNPROVED = "\n(* Of (17) nothing: there are no internal states, or it is not by a P > 0 that it is proved. *)\n"

Cell = list[tuple[list[Fraction], Fraction]]  # row x + constant >= 0, for each


def development(content: Any, name: str) -> dict[str, str]:
    """Return the files of a development that proves what a certificate says of its gains.

    The content is a certificate, as `parsed` reads it; that its proofs hold is for Coq to find out. The theorem has the
    name. Raises InvalidSpec where the theory speaks of nothing: a refusal, a proof by a polynomial, too many cells.
    """
    theory = {f"{part}.v": files("pwatrack.export").joinpath(f"theory/{part}.v").read_text() for part in THEORY}
    order = " ".join(f"{part}.v" for part in (*THEORY, RUN))
    check = f".PHONY: check\ncheck:\n\tset -e; for file in {order}; do coqc $$file; done\n"
    make = f"# Every file has to pass. The last prints what its theorems rest on.\n{check}"
    return theory | {f"{RUN}.v": _run(content, name), "Makefile": make}


def _run(content: Any, name: str) -> str:
    """Return the file of one run: its numbers, what is computed of them, and what follows."""
    controller, observer, generator = _proofs(content)
    spec, practical = str(content["spec_sha256"]), content.get("practical")
    if not re.fullmatch("[0-9a-f]{64}", spec):
        raise InvalidSpec("its digest of the spec is none")
    plant, apart = _all_cells(content["plant"]), practical is not None and practical["observer_runs"] == "all cells"
    A_eta, shift = _generator(plant, content)
    generator = generator if A_eta else None
    numbers = _numbers(plant, content, shift)
    if apart:
        seen = _all_cells(practical["plant"])
        numbers["A_seen"] = ("slopes of the plant that the observer runs", [X for X, _ in seen.seen_A])
    if generator is not None:
        numbers["A_eta"] = ("slopes of the generator (15), by the normal form (11) of the plant", A_eta)
    proofs = {"controller": controller, "observer": observer, "generator": generator}
    rates = {role: number(proof["rate"]) for role, proof in proofs.items() if proof is not None}
    D = lcm(*(v.denominator for v in _flat([*(value for _, value in numbers.values()), *rates.values()])))
    P = _form(controller)
    W, d = inverse(P)
    of = {
        "name": name,
        "spec": spec,
        "replaced": " with parameters replaced" * bool(content["set"]),
        "centres": template("coq_centres.v") if at_centres(content) else "",
        "files": ", ".join(f"{part}.v" for part in THEORY),
        "theory": " ".join(THEORY),
        "D": D,
        "numbers": "\n".join(
            f"(* {meaning} *)\n{_definition(symbol, _scaled(value, D))}" for symbol, (meaning, value) in numbers.items()
        ),
        "P": "\n".join(_definition(symbol, value) for symbol, value in (("P", P), ("W", W), ("d", d))),
        "Q": _definition("Q", _form(observer)),
        **{role: rate * D for role, rate in rates.items()},
        "n": len(plant.B[0]),
        "N": len(plant.seen_A[0][0]),
        "seen": "A_seen" if apart else "A",
        "merged": " of the plant with merged cells" * (practical is not None),
        "converges": "",
        "forgets": _UNPROVED if generator is None and content["generator"] is not None else "",
    }
    theorems = ["controller", "observer"] if apart else [f"{name}_tracks"]
    tracks = _APART if apart else template("coq_tracks.v", **of)
    if generator is not None:
        of |= {"r": len(A_eta[0]), "P_eta": _definition("P_eta", _form(generator))}
        of |= {part: template(f"coq_{part}.v", **of) for part in ("converges", "forgets")}
        theorems.append(f"{name}_generator")
    return template("coq_run.v", **of, tracks=tracks, theorems=", ".join(theorems))


def _proofs(content: Any) -> list[Any]:
    """Return the proofs of controller, observer, and generator, where it has one, by a quadratic form: the fastest."""
    if refuses(content):
        raise InvalidSpec("it proves that something is impossible: there is no loop to prove anything of")
    found = list[Any]()
    for of in ("controller", "observer", "generator"):
        known = [p for p in content["proofs"] if p["of"] == of and kind(p) == "common P" and number(p["rate"]) > 0]
        if not known and of != "generator":
            raise InvalidSpec(f"the {of} is not proved by a quadratic form at a rate, of which alone the theory speaks")
        found.append(max(known, key=lambda proof: number(proof["rate"]), default=None))
    return found


def _generator(plant: AuditedPlant, content: Any) -> tuple[list[Matrix], Any]:
    """Return A_eta of each cell, and what loads shift x_d by; neither where there is no generator."""
    if content["generator"] is None:
        return [], None
    slopes, shift, *_ = normal_form(plant, content["generator"], content.get("eta_with_loads"))
    return [X for X, _ in slopes[-plant.count :]], shift


def _numbers(plant: AuditedPlant, content: Any, shift: Any) -> dict[str, tuple[str, Any]]:
    last, loads = -plant.count, plant.loads[1][0] if plant.loads is not None else []
    L, G = matrix(content["L"]), list[Any]()
    if shift is not None and any(map(any, shift[0])):  # (3): loads move x_d by X s_hat, s_hat' = S s_hat + L_s C (…)
        G = product(shift[0], product(L[len(plant.B[0]) :], plant.seen_C[0]))
    return {
        "A": ("slopes of the field, cell by cell", [X for X, _ in plant.seen_A[last:]]),
        "b": ("its constants", [[v for row in b for v in row] for b, _ in plant.b[last:]]),
        "cells": ("each is where all of its rows x + constant are at least 0", _cells(plant)),
        "B": ("the input enters here", plant.B[0] + [[Fraction(0)] * len(plant.B[0][0]) for _ in loads]),
        "C": ("what is measured", plant.seen_C[0]),
        "K": ("feedback", matrix(content["K"])),
        "L": ("observer", L),
        "G": ("what errors of estimated loads move x_d by", G),
    }


def _all_cells(content: Any) -> AuditedPlant:
    """Return a plant whose last A and b are those of all cells in turn, also where it is written by elements."""
    plant = AuditedPlant(content)
    if plant.count > _MOST_CELLS:
        raise InvalidSpec(f"its plant has {plant.count} cells, and at most {_MOST_CELLS} are written down")
    return plant if plant.elements is None else AuditedPlant(content, range(plant.count))


def _cells(plant: AuditedPlant) -> list[Cell]:
    if plant.elements is None:
        each = [zip(signs, plant.cells.planes, strict=True) for signs in plant.cells.signs]
        return [[([s * v for v in plane[:-1]], s * plane[-1]) for s, plane in planes if s] for planes in each]
    found = list[Cell]()
    for i in range(plant.count):  # where the argument of each element is in one of its segments
        cell: Cell = []
        for element, k in zip(plant.elements.each, plant.elements.segments(i), strict=True):
            marks = element.function.breakpoints
            if k > 0:
                cell.append((element.row, element.constant - marks[k - 1]))
            if k < len(marks):
                cell.append(([-v for v in element.row], marks[k] - element.constant))
        found.append(cell)
    return found


def _form(proof: Any) -> list[list[int]]:
    """Return P of a proof, times what makes its entries whole numbers without a common factor."""
    entries = packed(proof["P"])[0]
    whole = _scaled(entries, lcm(*(v.denominator for v in _flat(entries))))
    common = gcd(*_flat(whole))
    return [[v // common for v in row] for row in whole]


def inverse(P: list[list[int]]) -> tuple[list[list[int]], int]:
    """Return W and d > 0 with P W = d I, all whole numbers, of P > 0."""
    inverse: Any = flint.fmpz_mat(P).inv()
    W, d = inverse.numer_denom()
    return [[int(v) for v in row] for row in W.tolist()], int(d)


def _definition(symbol: str, value: Any) -> str:
    text = f"Definition {symbol} : {_TYPES.get(symbol, 'matrix')} := {literal(value)}."
    return fill(text, _WIDTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


def literal(value: Any) -> str:
    """Return a number, or lists and pairs of them, as Coq reads it."""
    match value:
        case list():
            return f"[{'; '.join(map(literal, value))}]"
        case tuple():
            return f"({', '.join(map(literal, value))})"
    return f"({value})" if value < 0 else str(value)


def _scaled(value: Any, D: int) -> Any:
    return type(value)(_scaled(v, D) for v in value) if isinstance(value, list | tuple) else int(value * D)


def _flat(value: Any) -> Iterator[Any]:
    if isinstance(value, list | tuple):
        yield from chain.from_iterable(map(_flat, value))
    else:
        yield value
