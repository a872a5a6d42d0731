"""Every claim of a certificate, decided."""

import os
import stat
from json import JSONDecodeError
from typing import Any

from . import bounds, clocked, corners, region, sampled_box, sampled_region, set_points, simplified, starts, tubes
from .bounds import Loop
from .form import normal_form
from .matrices import AuditFault, counted, transposed
from .plant import AuditedPlant, at_centres
from .polynomials import polynomial
from .proofs import between, both_ways, check, cost, no_P_by_modes, no_P_by_Z, refuted
from .reading import FORMAT, matrix, number, parsed
from .shape import CELLS, REFUSAL, ROWS, by_cell, fit, kind, refuses

NAMES = {
    "plant": "(7) plant",
    "controller": "(8) controller",
    "observer": "(9) observer",
    "generator": "(17) generator",
}
DECIDED = {  # each claim of `reading.PROOFS`
    "common P": check,
    "polynomial": polynomial,
    "P of any sign": both_ways,
    "cost": cost,
    "multipliers": refuted,
    "mode of a mean": between,
    "no P, by multipliers": no_P_by_Z,
    "no P, by unstable modes": no_P_by_modes,
}
# claims of a design: each has its SHAPE, by key, and `decided` where there is something of it
CLAIMS = (bounds, set_points, starts, region, corners, simplified, clocked, tubes, sampled_region, sampled_box)
DESIGN = REFUSAL | {"eta_with_loads?": ROWS, "K_of_least_cost?": ROWS}
DESIGN |= {key: shape for claim in CLAIMS for key, shape in claim.SHAPE.items()}
ANEW = "write it anew with 'pwatrack design', or check it with the version that wrote it"
_MOST_BYTES = 2**28  # of the file


def audit(text: str) -> tuple[list[str], list[str]]:
    """Return what a certificate proves, and what is wrong with it, both in sentences."""
    try:
        with counted(len(text)):
            content = parsed(text)
            if content["format"] != FORMAT:
                raise AuditFault(f"the format is {_shown(content['format'])}, this program reads '{FORMAT}': {ANEW}")
            fit(content["proofs"], REFUSAL["proofs"], "proofs")
            fit(content, REFUSAL if refuses(content) else DESIGN, "the certificate")
            return judged(content)
    except AuditFault as fault:
        return [], [str(fault)]
    except (KeyError, TypeError, ValueError, IndexError, ArithmeticError, AttributeError, RecursionError) as error:
        missing = f"{error} is missing" if isinstance(error, KeyError) else f"{type(error).__name__}: {error}"
        missing = f"no JSON: {error}" if isinstance(error, JSONDecodeError) else missing
        return [], [f"not a certificate: {missing}"[:200]]


def _shown(name: Any) -> str:
    """Return what a file calls its format, as it may be printed."""
    return f"'{ascii(name)[1:-1][:80]}'" if isinstance(name, str) else "none that is known"


def judged(content: Any) -> tuple[list[str], list[str]]:
    """Decide every claim of a certificate."""
    named = sorted({int(i) for proof in content["proofs"] for i in by_cell(proof)})
    plant, practical = AuditedPlant(content["plant"], named), content.get("practical")
    if practical is not None and practical["observer_runs"] == "all cells":
        plant.seen_A = AuditedPlant(practical["plant"]).A
    centres = at_centres(content)
    cells = "1 cell covers" if plant.count == 1 else f"{plant.count} cells cover"
    said = [f"plant: {cells} the state space, the field is continuous{centres}"]
    faults = plant.faults()
    if content["tracking"] == "state" and plant.unmatched():
        faults.append("a load enters where no input does, and x_d is given")
    K, L = (None if content[name] is None else matrix(content[name]) for name in ("K", "L"))
    generator = content["generator"]
    A_eta, X = (None, None) if generator is None else normal_form(plant, generator, content.get("eta_with_loads"))
    refusal = refuses(content)
    faults += misplaced(content) if refusal else []
    decided = set()
    for proof in content["proofs"]:
        of, which = proof["of"], kind(proof)
        if of not in NAMES or (which == "cost" and of not in ("controller", "observer")):
            raise AuditFault(f"there is no {which} of '{of}'")
        M, B = plant.problem(of, K, L, A_eta)
        wrong = DECIDED[which](M, B, plant.placed(proof), K if of == "controller" else L and transposed(L))
        faults += [f"{NAMES[of]}: {fault}" for fault in wrong]
        said.append(f"{NAMES[of]}: {claim(proof, plant)}{centres if which in CELLS else ''}")
        decided |= {of} - ({of} if which == "cost" else set())
    loop = Loop(plant, K or [], L or [], X, generator)
    for one in () if refusal else [one for one in CLAIMS if any(content[key] for key in one.SHAPE)]:
        wrong, sentences = one.decided(loop, content)
        faults += wrong
        said += sentences
    if not refusal:
        wanted = {"controller", "observer"} | ({"generator"} if A_eta is not None and A_eta[0][0] else set())
        absent = sorted(NAMES[of] for of in wanted - decided)
        if content["tracking"] not in ("output", "state") or (content["tracking"] == "output") != (A_eta is not None):
            faults.append("a generator goes with output tracking, and only with that")
        theorem = "Theorem 3, output tracking" if A_eta is not None else "Theorem 2, state tracking"
        faults += [f"{name} is absent, which {theorem} needs" for name in absent]
        of = ", of the plant with merged cells" if practical is not None else ""
        said.append(f"{theorem}{of}: none of its inequalities is absent")
    return said, faults


def misplaced(content: Any) -> list[str]:
    """Return what does not belong into the proof of a refusal."""
    proof, *more = content["proofs"]
    of = proof["of"]
    faults = ["a refusal has one proof"] if more else []
    if of == "plant" or (of == "generator" and number(proof.get("rate", 0))):
        faults.append(f"no theorem needs {NAMES[of]}" + " at a rate" * (of == "generator"))
    if (of != "controller" and content["K"] is not None) or (of != "observer" and content["L"] is not None):
        faults.append("a refusal has no gain but the one that it is about")
    return faults


def claim(proof: Any, plant: AuditedPlant) -> str:
    """Say what one entry claims."""
    which, names = kind(proof), [f"'{plant.name(int(i))}'" for i in by_cell(proof)]
    if which == "cost":
        return "the bound of the cost is proved"
    if which == "P of any sign":
        return "proved with a P of any sign, for a bounded solution that is played back"
    if which.startswith("no P"):
        by = "multipliers for" if which == "no P, by multipliers" else "the numbers of unstable modes in"
        return f"proved impossible with a P of any sign, by {by} {' and '.join(names)}"
    rate = f"{proof['rate']} 1/s"
    if which in CELLS:
        beyond = f" at a rate of {rate}" if number(proof["rate"]) else ""
        by = "multipliers for" if which == "multipliers" else "a mode that no gain moves of a mean of"
        return f"proved impossible{beyond}, by {by} {', '.join(names)}"
    by = f" by a polynomial of degree {proof['degree']}" if which == "polynomial" else ""
    return f"proved{by}, rate {rate}"


def main(path: str) -> int:
    """Print what the file proves and what is wrong with it; return the exit code."""
    try:
        found = os.stat(path)  # noqa: PTH116
        if not stat.S_ISREG(found.st_mode) or found.st_size > _MOST_BYTES:
            raise OSError(f"it is no regular file of at most {_MOST_BYTES:,} bytes")
        with open(path, encoding="utf-8") as file:  # noqa: PTH123
            said, faults = audit(file.read())
    except (OSError, UnicodeDecodeError) as error:
        said, faults = [], [f"cannot read {path}: {error}"]
    lines = [f"wrong: {fault}" for fault in faults] or [*said, "every number was read as it is written; fractions only"]
    print("\n".join(lines))  # noqa: T201
    return 6 if faults else 0
