"""What refusals are about, and what may help, in the paths and words of a file and of the command line."""

from collections.abc import Mapping
from dataclasses import replace

from pwatrack.errors import KEY, Place, Problem, ProblemPart, PwatrackError, Subject, Way
from pwatrack.spec.yaml_tree import Arguments

_PATHS: Mapping[ProblemPart, Subject] = {
    ProblemPart.PLANT: ("system",),
    ProblemPart.CELLS: ("system", "cells"),
    ProblemPart.B: ("system", "B"),
    ProblemPart.C: ("system", "C"),
    ProblemPart.TRACKED: ("system", "track"),
    ProblemPart.REFERENCE: ("reference",),
    ProblemPart.START: ("reference", "start"),
    ProblemPart.SET_POINTS: ("reference", "outside", "filter"),
    ProblemPart.DESIGN: ("design",),
    ProblemPart.CONTROLLER: ("design", "controller"),
    ProblemPart.OBSERVER: ("design", "observer"),
    ProblemPart.UNCERTAIN: ("design", "uncertain"),
    ProblemPart.GENERATOR_START: ("simulation", "initial", "generator"),
    ProblemPart.SAMPLE_TIME: ("simulation", "controller", "sample_time"),
    ProblemPart.ESTIMATE: ("design", "estimate"),
    ProblemPart.DURATION: ("simulation", "duration"),
    # of a cell
    ProblemPart.A: ("A",),
    ProblemPart.b: ("b",),
    # of a gain
    ProblemPart.K: ("K",),
    ProblemPart.L: ("L",),
    ProblemPart.RATE: ("rate",),
    ProblemPart.BOUND: ("gain",),
    ProblemPart.COST: ("cost",),
}
_STATE_TRACKING = "{hint}; state tracking (Theorem 2) needs no form (11) and no (17), only (8) and (9)"
_PRACTICAL = "{hint}; cells that are merged may give a bound of the error"
_WORDS: Mapping[Way, str] = {
    Way.STATE_TRACKING: f"{_STATE_TRACKING}: write 'tracking: state', with a reference 'setpoint', 'state' or 'input'",
    Way.PRACTICAL: f"{_PRACTICAL}: write 'tracking: practical'",
    Way.STATE_OR_PRACTICAL: f"{_STATE_TRACKING}: write 'tracking: state'; or 'tracking: practical', for a bound",
    Way.TRACKED: "{hint}: for example track: [{0}] under system",
    Way.OFFSET: "b: [{0}] in cell '{1}' would make it continuous there",
    Way.TOLERANCE: "correct the cell; for data rounded in print, 'tolerance: {{continuity: …}}' accepts a larger jump "
    "(in force: {0:g})",
    Way.INTERVAL: "{hint}: {{formula: …, until: T}}, with T in s",
    Way.ROUNDED_CORNERS: "write 'smooth: T' (s) inside its step, trapezoid or polyline, or choose a smoother one",
    Way.LONGER_ROUNDING: "write 'smooth: {0:.1e}' (s) or more",
    Way.EXACT_NUMBERS: "{hint}: write 2*pi instead of its decimals, and the like",
    Way.OTHER_SOLVER: "{hint}: --solver {0}",
    Way.GAIN_BOUND: "give a bound beside it, for example gain: 100, or the rate that is wanted",
    Way.DESIRED_STATE: "{hint}: give x_d as state or setpoint instead",
    Way.DESIRED_START: "{hint}: give x_d(0) as start instead",
    Way.SMALLER_BOX: "{hint}: 'design --robust largest' finds how far the box can be scaled",
    Way.FASTER_SAMPLES: "write 'sample_time: {0:g}' (s): simulated runs died out there, which is no proof",
    Way.SLOWER_GAINS: "slow the gains down: larger 'sizes' of outputs for L, smaller ones of inputs for K",
}
_IN_PYTHON: Mapping[Way, str] = {
    Way.STATE_TRACKING: f"{_STATE_TRACKING}: tracking='state'",
    Way.PRACTICAL: f"{_PRACTICAL}: tracking='practical'",
    Way.STATE_OR_PRACTICAL: f"{_STATE_TRACKING}: tracking='state'; or tracking='practical', for a bound",
    Way.TRACKED: "{hint}: for example track=['{0}']",
    Way.OFFSET: "b = [{0}] in cell '{1}' would make it continuous there",
    Way.TOLERANCE: "correct the cell; for data rounded in print, tolerance=… accepts a larger jump (in force: {0:g})",
    Way.INTERVAL: "{hint}: {{'formula': …, 'until': T}}, with T in s",
    Way.ROUNDED_CORNERS: "write 'smooth': T (s) inside its step, trapezoid or polyline, or choose a smoother one",
    Way.LONGER_ROUNDING: "write 'smooth': {0:.1e} (s) or more",
    Way.EXACT_NUMBERS: "{hint}: write the text '2*pi' instead of its decimals, and the like",
    Way.OTHER_SOLVER: "{hint}: solver='{0}'",
    Way.GAIN_BOUND: "give a bound beside it, for example 'gain': 100, or the rate that is wanted",
    Way.FASTER_SAMPLES: "'sample_time': {0:g} (s): simulated runs died out there, which is no proof",
}


def path_of(subject: Subject) -> Subject:
    """Return the path in a file of what a refusal is about."""
    return tuple(step for part in subject for step in (_PATHS[part] if isinstance(part, ProblemPart) else (part,)))


def located(refusal: PwatrackError, places: Mapping[Subject, Place]) -> PwatrackError:
    """Return the same refusal in the words of the file, with the place of the nearest path that is written there."""
    problems = list[Problem]()
    for problem in refusal.problems:
        problem = spelled(problem, python=isinstance(places, Arguments))
        if problem.place is None and problem.subject is not None:
            subject = path_of(problem.subject)
            problem = replace(problem, subject=subject)
            if isinstance(places, Arguments):
                problem = places.said(replace(problem, subject=subject[:-1] if subject[-1:] == (KEY,) else subject))
            while subject and subject not in places:
                subject = subject[:-1]
            problem = replace(problem, place=places.get(subject))
        problems.append(problem)
    return type(refusal)(*problems, evidence=refusal.evidence)


def spelled(problem: Problem, *, python: bool = False) -> Problem:
    """Return the same problem with what may help in the words of a file or the command line, or of Python."""
    if problem.remedy is None:
        return problem
    way, figures = problem.remedy.way, problem.remedy.figures
    words = ((python and _IN_PYTHON.get(way)) or _WORDS[way]).format(*figures, hint=problem.hint)
    return replace(problem, hint=words, remedy=None)
