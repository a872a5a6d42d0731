"""Stable codes of errors, and what `pwatrack explain` says of each.

The first digit is the exit code. A code never changes its meaning; what has none of its own has that of its exit code.
"""

import re
from dataclasses import dataclass

from pwatrack.errors import ExitCode, InvalidSpec


@dataclass(frozen=True)
class Explained:
    """A kind of error: its code, what its messages are like, what it is in a few words, and what to do about it."""

    code: str
    like: str
    title: str
    text: str


CODES = (
    Explained("P201", r"not valid YAML|not UTF-8 text", "The file is not YAML", "The place is where reading stopped. Often a quote, bracket or colon above it is missing; text with ': ' or '#' in it needs quotes."),
    Explained("P202", r"unknown key", "A key that specs do not have", "docs/reference/spec_file.md has all keys; 'pwatrack schema' writes a schema with which editors complete and check them. A key may also stand in the wrong section."),
    Explained("P203", r"unknown name", "A name that is not declared", "Expressions know the names under 'parameters' and, where they speak of them, the states. Functions are listed in docs/reference/spec_file.md."),
    Explained("P204", r"is not a number or an expression", "No number", "Write a number or an expression such as 2*pi or k/m. Units are not read, a decimal comma is not either."),
    Explained("P205", r"(entry|entries|rows?), expected", "A matrix of the wrong shape", "Rows and columns follow the names under states, inputs and outputs, in their order: A has a row and a column for each state, B a column for each input, C a row for each output."),
    Explained("P206", r"at most .* (is|are) (read|taken|looked at|walked)", "More than is read", "The limit is in the message. It is there so that a file cannot take all memory and time."),
    Explained("P207", r"^table ", "A table that cannot be used", "A table is a text file with a header, a column of times that increase, and a column of values, in the folder of the spec; docs/reference/spec_file.md says how columns, units and decimal commas are given."),
    Explained("P208", r"^cannot write", "A place that cannot be written", "Nothing was changed there. Look for a full disk, missing rights, or a file where a folder should be; choose another folder (--out)."),
    Explained("P209", r"^cannot read|is no folder and no file", "A file that cannot be read", "Paths are relative to the folder that the program was started in; those in a spec to the folder of the spec."),
    Explained("P210", r"is missing", "Something that every spec has is missing", "A spec has at least name, system, reference and simulation. 'pwatrack init' writes one to start from."),
    Explained("P211", r"^--scheduler", "A scheduler that cannot be used", "docs/cluster.md says how scheduler and workers are started. Workers need the package under the same versions as here."),
    Explained("P301", r"do not cover", "Cells with a hole between them", "Together, the cells have to contain every state; the message has one that is in none. Border points belong to both neighbours."),
    Explained("P302", r"overlap", "Cells that overlap", "Two cells may share a border only; the message has a state inside both."),
    Explained("P303", r"must be continuous", "A field that jumps", "On the border of two cells both have to give the same A x + b: class (1) of the paper. Often b is missing, or a number is rounded; 'tolerance: {continuity: …}' accepts and repairs jumps by rounding."),
    Explained("P304", r"not of form \(11\)", "A plant without the normal form (11)", "Output tracking needs derivatives of the output that are the same in all cells until the input appears. Track another output, or track states: 'design: {tracking: state}'. Of a dead zone before the output, 'tracking: practical' proves a bound."),
    Explained("P305", r"no relative degree", "An output that the input never reaches", "However often it is differentiated, the input does not appear. Look for a zero in B, or for a sign."),
    Explained("P306", r"is not bounded", "A reference that is not bounded", "Theorems 2 and 3 are about bounded references. A signal that ends may be limited: {formula: …, until: T}."),
    Explained("P307", r"times differentiable", "A reference with a corner", "It has to be as smooth as the plant's relative degree. Round it: steps, trapezoids and polylines take 'smooth', in s."),
    Explained("P308", r"not realisable", "States that no input can follow", "x_d has to be a solution of the plant for some input, in every cell that it visits: (3) in the paper."),
    Explained("P401", r"^\(8\)", "No gain K", "It is proved that no K makes all cells decay together. The message names cells in conflict; make them less different, or ask for less."),
    Explained("P402", r"^\(9\)", "No gain L", "It is proved that no L makes the observer converge in all cells together. Another sensor may help."),
    Explained("P403", r"^\(17\)", "Zero dynamics that do not converge", "What the output does not show has to be convergent by itself: no controller can change that. Track another output, or track states."),
    Explained("P501", r"could not be proved exactly", "Found, but not proved", "A solution was found in floating point and is too close to the border for an exact proof. Ask for a little less, or try the other solver: --solver cvxopt."),
    Explained("P502", r"no gain with a norm of at most", "No gain as small as asked", "The smallest that was found is in the message; nothing is proved about smaller ones."),
    Explained("P601", r"requirement missed", "A requirement that is missed", "All files are written; 'require' in the spec has the limits, run.json what came out."),
    Explained("P602", r"grows|is unstable", "A loop that grows", "What the proof speaks of is the loop as designed; limits of inputs, other parameters or sampling may make another one of it."),
)  # fmt: skip

_GENERAL = {
    ExitCode.BUG: "A mistake in this program, or a process that was killed. Please report it together with the spec.",
    ExitCode.INVALID: "The description or the command is not well formed. The message says where, and what is expected.",
    ExitCode.OUTSIDE_THEORY: "The plant or the reference is not one that the theorems are about; 'pwatrack check' says which apply.",
    ExitCode.INFEASIBLE: "It is proved that what is asked cannot be had; refusal.json has the proof, 'pwatrack verify' checks it.",
    ExitCode.UNDECIDED: "Neither a design nor a proof that there is none was found. Ask for less, or try the other solver.",
    ExitCode.CHECK_FAILED: "The design is proved, and what was simulated is not as it should be. All files are written.",
}


def code_of(message: str, exit_code: ExitCode) -> str:
    """Return the code of a message.

    Example:
        >>> code_of("unknown name 'k9'", ExitCode.INVALID), code_of("something else", ExitCode.UNDECIDED)
        ('P203', 'P500')
    """
    number = str(int(exit_code))
    said = re.sub(r"(?<!\w)'[^']*'(?!\w)", "''", message)  # names in it are the file's
    fits = (kind.code for kind in CODES if kind.code[1] == number and re.search(kind.like, said))
    return next(fits, f"P{number}00")


def explanation(code: str) -> str:
    """Return what a code means; raises InvalidSpec if there is none of this name.

    Example:
        >>> print(explanation("p302"))
        P302: Cells that overlap (exit 3, outside the theory)
        <BLANKLINE>
        Two cells may share a border only; the message has a state inside both.
    """
    known = {kind.code: (kind.title, kind.text) for kind in CODES}
    known |= {f"P{int(number)}00": (number.verdict.capitalize(), text) for number, text in _GENERAL.items()}
    if code.upper() not in known:
        raise InvalidSpec(f"{code} is no code of an error", hint=f"there are {', '.join(sorted(known))}")
    title, text = known[code.upper()]
    return f"{code.upper()}: {title} (exit {code[1]}, {ExitCode(int(code[1])).verdict})\n\n{text}"
