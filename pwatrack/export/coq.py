"""A certificate as a development for Coq, whose kernel decides its inequalities and applies the theorem to them.

The theory is written once, in `theory`: vectors, definiteness by elimination, convergence of continuous piecewise
affine loops, and what is left to computation. A run adds its numbers, as whole numbers over one denominator.
"""

import re
from collections.abc import Iterator, Sequence
from fractions import Fraction
from importlib.resources import files
from itertools import chain
from math import gcd, lcm
from textwrap import wrap
from typing import Any

import flint

from pwatrack.errors import InvalidSpec
from pwatrack.lmi.audit.elements import Elements
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
_DECIDED = "Proof. vm_cast_no_check (eq_refl true). Qed."

Cell = list[tuple[list[Fraction], Fraction]]  # row x + constant >= 0, for each


def development(content: Any, name: str) -> dict[str, str]:
    """Return the files of a development that proves what a certificate says of its gains.

    Args:
        content: A certificate, as `parsed` reads it; that its proofs hold is for Coq to find out.
        name: What the theorem is called.

    Raises:
        InvalidSpec: If there is nothing that the theory speaks of: a refusal, a proof by a polynomial, too many cells.
    """
    theory = {f"{part}.v": files("pwatrack.export").joinpath(f"theory/{part}.v").read_text() for part in THEORY}
    order = " ".join(f"{part}.v" for part in (*THEORY, RUN))
    check = f".PHONY: check\ncheck:\n\tset -e; for file in {order}; do coqc $$file; done\n"
    make = f"# Every file has to pass. The last prints what its theorems rest on.\n{check}"
    return theory | {f"{RUN}.v": "\n".join(_Run(content, name).lines()) + "\n", "Makefile": make}


class _Run:
    """What belongs to one run: its numbers, what is computed of them, and what follows."""

    def __init__(self, content: Any, name: str) -> None:
        if refuses(content):
            raise InvalidSpec("it proves that something is impossible: there is no loop to prove anything of")
        self.content, self.name, practical = content, name, content.get("practical")
        self.proofs = {of: _best(content["proofs"], of) for of in ("controller", "observer", "generator")}
        for of in ("controller", "observer"):
            if self.proofs[of] is None:
                raise InvalidSpec(
                    f"the {of} is not proved by a quadratic form at a rate, of which alone the theory speaks"
                )
        self.spec = str(content["spec_sha256"])
        if not re.fullmatch("[0-9a-f]{64}", self.spec):
            raise InvalidSpec("its digest of the spec is none")
        self.merged = practical is not None
        self.apart = practical is not None and practical["observer_runs"] == "all cells"
        plant = _all_cells(content["plant"])
        A_eta, shift = _generator(plant, content)
        if not A_eta:
            self.proofs["generator"] = None
        self.numbers = _numbers(plant, content, shift)
        if self.apart:
            seen = _all_cells(practical["plant"])
            self.numbers["A_seen"] = ("slopes of the plant that the observer runs", [X for X, _ in seen.seen_A])
        if self.proofs["generator"] is not None:
            self.numbers["A_eta"] = ("slopes of the generator (15), by the normal form (11) of the plant", A_eta)
        self.n, self.N = len(plant.B[0]), len(plant.seen_A[0][0])
        self.rates = {of: number(proof["rate"]) for of, proof in self.proofs.items() if proof is not None}
        self.D = lcm(
            *(v.denominator for v in _flat([*(value for _, value in self.numbers.values()), *self.rates.values()]))
        )

    def lines(self) -> Iterator[str]:
        """Yield the lines of the file."""
        centres = at_centres(self.content)
        yield f"(* {self.name}: the gains of a certificate for the spec with SHA-256"
        yield f"   {self.spec}{' with parameters replaced' * bool(self.content['set'])}."
        yield "   Its numbers stand here over the denominator D, exactly as they are written there."
        if centres:
            yield "   The plant is the one at the centres of the balls that its numbers lie in: of the others there"
            yield "   nothing is proved here ('pwatrack verify' does that)."
        yield f"   {', '.join(f'{part}.v' for part in THEORY)} are compiled before, in this order. *)"
        yield "From Coq Require Import Reals List."
        yield "From Bignums Require Import BigZ."
        yield f"Require Import {' '.join(THEORY)}."
        yield "Import ListNotations."
        yield "Open Scope bigZ_scope."
        yield "Open Scope list_scope.  (* where [a] is a list *)"
        yield ""
        yield f"Definition D := {self.D}."
        for symbol, (meaning, value) in self.numbers.items():
            yield f"(* {meaning} *)"
            yield from _definition(symbol, _scaled(value, self.D))
        yield from self._lemmas()
        yield "\nOpen Scope R_scope.\n"
        names = ["controller", "observer"]
        if self.apart:
            yield "(* The observer runs all cells and the gain is of merged ones: no theorem here joins the two. *)"
        else:
            yield from self._tracks()
            names = [f"{self.name}_tracks"]
        if "generator" in self.rates:
            yield from self._generator()
            names.append(f"{self.name}_generator")
        elif self.content["generator"] is not None:
            yield "\n(* Of (17) nothing: there are no internal states, or it is not by a P > 0 that it is proved. *)"
        yield ""
        yield f"Definition all := ({', '.join(names)})."
        yield "Print Assumptions all."

    def _lemmas(self) -> Iterator[str]:
        """Yield the forms, and what the kernel computes of them."""
        P, n, N = _form(self.proofs["controller"]), self.n, self.N
        W, d = inverse(P)
        yield "\n(* (8) by P, with d times its inverse, at the rate alpha / D *)"
        for symbol, value in (("P", P), ("W", W), ("d", d)):
            yield from _definition(symbol, value)
        yield f"Definition alpha := {self.rates['controller'] * self.D}."
        yield f"Lemma controller : controller_proved {n} D alpha A B K P W d = true.\n{_DECIDED}"
        yield "\n(* (9) by Q, at the rate beta / D *)"
        yield from _definition("Q", _form(self.proofs["observer"]))
        yield f"Definition beta := {self.rates['observer'] * self.D}."
        yield f"Lemma observer : observer_proved {N} D beta {'A_seen' if self.apart else 'A'} C L Q = true.\n{_DECIDED}"
        if "generator" in self.rates:
            r = len(self.numbers["A_eta"][1][0])
            yield "\n(* (17) by P_eta, at the rate gamma / D *)"
            yield from _definition("P_eta", _form(self.proofs["generator"]))
            yield f"Definition gamma := {self.rates['generator'] * self.D}."
            yield f"Lemma generator : observer_proved {r} D gamma A_eta [] [] P_eta = true.\n{_DECIDED}"

    def _tracks(self) -> Iterator[str]:
        n, N = self.n, self.N
        of = " of the plant with merged cells" * self.merged
        yield f"(* For the f that is A_i x + b_i in each cell{of}, and from"
        yield "   every start: x - x_d and x_hat - x go to 0, at least as fast as e^(-min(alpha, beta) t / D);"
        yield "   where plant and observer are disturbed, or x_d is off (3), as close to 0 as that is small. *)"
        yield f"Theorem {self.name}_tracks : exists c g, forall f x x_hat x_d u_ff disturbance noise off jumps most,"
        yield f"  field {N} (length A) (polyhedra D cells) (slopes D A) (offsets D b) f ->"
        yield f"  closed_loop {n} {N} (length K) (length C) (over D B) (over D K) (over D C) (over D L) (over D G)"
        yield "    f x x_hat x_d u_ff disturbance noise off jumps ->"
        yield "  (forall t, 0 <= t ->"
        yield f"    dot {N} (disturbance t) (disturbance t) + dot {N} (noise t) (noise t)"
        yield f"      + dot {n} (off t) (off t) <= most) ->"
        yield "  forall t, 0 <= t ->"
        yield f"    errors {n} {N} x x_hat x_d t"
        yield "      <= c * exp (- (2 * Rmin (ratio alpha D) (ratio beta D)) * t)"
        yield f"        * errors {n} {N} x x_hat x_d 0 + g * most."
        yield "Proof."
        yield f"  exact (tracks {n} {N} D A b cells B K C L G alpha P W d beta Q eq_refl controller observer)."
        yield "Qed."

    def _generator(self) -> Iterator[str]:
        r = len(self.numbers["A_eta"][1][0])
        yield "\n(* Any two solutions of the generator for one reference and the same loads approach each other. *)"
        yield f"Theorem {self.name}_generator : exists c, forall cells b (f : R -> vec -> vec) x y jumps,"
        yield f"  (forall t, field {r} (length A_eta) (cells t) (slopes D A_eta) (b t) (f t)) ->"
        yield f"  locally_finite jumps -> solves {r} f jumps x -> solves {r} f jumps y ->"
        yield f"  forall t, 0 <= t -> dot {r} (minus (x t) (y t)) (minus (x t) (y t))"
        yield f"    <= c * exp (- (2 * ratio gamma D) * t) * dot {r} (minus (x 0) (y 0)) (minus (x 0) (y 0))."
        yield f"Proof. exact (generator_converges {r} D A_eta gamma P_eta generator). Qed."


def _generator(plant: AuditedPlant, content: Any) -> tuple[list[Matrix], Any]:
    """Return A_eta of each cell, and what loads shift x_d by; neither where there is no generator."""
    if content["generator"] is None:
        return [], None
    slopes, shift, *_ = normal_form(plant, content["generator"], content.get("eta_with_loads"))
    return [X for X, _ in slopes[-plant.count :]], shift


def _numbers(plant: AuditedPlant, content: Any, shift: Any) -> dict[str, tuple[str, Any]]:
    last, loads = -plant.count, plant.loads[1][0] if plant.loads is not None else []
    L = matrix(content["L"])
    return {
        "A": ("slopes of the field, cell by cell", [X for X, _ in plant.seen_A[last:]]),
        "b": ("its constants", [[v for row in b for v in row] for b, _ in plant.b[last:]]),
        "cells": ("each is where all of its rows x + constant are at least 0", _cells(plant)),
        "B": ("the input enters here", plant.B[0] + [[Fraction(0)] * len(plant.B[0][0]) for _ in loads]),
        "C": ("what is measured", plant.seen_C[0]),
        "K": ("feedback", matrix(content["K"])),
        "L": ("observer", L),
        "G": ("what errors of estimated loads move x_d by", _moved(shift, plant, L)),
    }


def _all_cells(content: Any) -> AuditedPlant:
    """Return a plant whose last A and b are those of all cells in turn, also where it is written by elements."""
    plant = AuditedPlant(content)
    if plant.count > _MOST_CELLS:
        raise InvalidSpec(f"its plant has {plant.count} cells, and at most {_MOST_CELLS} are written down")
    return plant if plant.elements is None else AuditedPlant(content, range(plant.count))


def _cells(plant: AuditedPlant) -> list[Cell]:
    if plant.elements is not None:
        return [_between(plant.elements, plant.elements.segments(i)) for i in range(plant.count)]
    each = [zip(signs, plant.cells.planes, strict=True) for signs in plant.cells.signs]
    return [[([s * v for v in plane[:-1]], s * plane[-1]) for s, plane in planes if s] for planes in each]


def _between(elements: Elements, segments: Sequence[int]) -> Cell:
    """Return where the argument of each element is in one of its segments."""
    found: Cell = []
    for element, k in zip(elements.each, segments, strict=True):
        marks = element.function.breakpoints
        if k > 0:
            found.append((element.row, element.constant - marks[k - 1]))
        if k < len(marks):
            found.append(([-v for v in element.row], marks[k] - element.constant))
    return found


def _moved(shift: Any, plant: AuditedPlant, L: Matrix) -> Matrix:
    """Return G of (3): loads move x_d by X s_hat, and s_hat' = S s_hat + L_s C (x_hat - x)."""
    if shift is None or not any(map(any, shift[0])):
        return []
    return product(shift[0], product(L[len(plant.B[0]) :], plant.seen_C[0]))


def _best(proofs: Any, of: str) -> Any:
    """Return the proof by a quadratic form with the largest rate, above 0; None if there is none."""
    known = [p for p in proofs if p["of"] == of and kind(p) == "common P" and number(p["rate"]) > 0]
    return max(known, key=lambda proof: number(proof["rate"]), default=None)


def _form(proof: Any) -> list[list[int]]:
    """Return P of a proof, times what makes its entries whole numbers without a common factor."""
    entries = packed(proof["P"])[0]
    whole = _scaled(entries, lcm(*(v.denominator for v in _flat(entries))))
    common = gcd(*_flat(whole))
    return [[v // common for v in row] for row in whole]


def inverse(P: list[list[int]]) -> tuple[list[list[int]], int]:
    """Return W and d > 0 with P W = d I, all whole numbers, of P > 0."""
    inverse: Any = flint.fmpz_mat(P).inv()
    entries = [[Fraction(int(v.p), int(v.q)) for v in row] for row in inverse.tolist()]
    d = lcm(*(v.denominator for v in _flat(entries)))
    return _scaled(entries, d), d


def _definition(symbol: str, value: Any) -> Iterator[str]:
    text = f"Definition {symbol} : {_TYPES.get(symbol, 'matrix')} := {literal(value)}."
    yield from wrap(text, _WIDTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


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
