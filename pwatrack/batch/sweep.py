"""A spec at many values of its parameters, and where between two of them a kind of proof ends: tables, a picture."""

import csv
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import groupby, product
from math import prod
from pathlib import Path
from typing import Any, Literal

from pwatrack.batch.cluster import Cluster, packed, with_files
from pwatrack.batch.pool import PRELOAD, Lost, Pool
from pwatrack.claims.practical import Practical
from pwatrack.control.controller import ProvedController
from pwatrack.errors import ExitCode, InvalidSpec, PwatrackError
from pwatrack.interruption import as_ended
from pwatrack.report.run_folder import written_at_once
from pwatrack.report.terminal import console, told
from pwatrack.spec.axis import MOST, Axis, axis
from pwatrack.spec.load import assignments, read_sweep
from pwatrack.spec.requirement import QUANTITIES

Method = Literal["grid", "random", "lhs"]
PROVED, POLYNOMIAL, PRACTICAL, NONE = "proved", "proved by a polynomial", "practical", "none"
PROOFS = (PROVED, POLYNOMIAL, PRACTICAL, NONE)  # kinds, the strongest first

_TOLD = ("rate", "settling_time", "final_error")  # figures of which the best is said
_LIMIT = 600.0  # s: for a point
_TRIED = 20  # places at which a spec is read before it is refused for all
_TIMES = 20  # that a log is told how far it is
_HALVINGS = 60  # of an interval at most: more than a double has digits


@dataclass(frozen=True, kw_only=True)
class Point:
    """What came out at one place, for these values of the parameters."""

    values: Mapping[str, float]
    exit: int | None  # the exit code that a run there ends with; None if it did not end
    said: str = ""  # why it was refused, or did not end
    figures: Mapping[str, float] = field(default_factory=dict)  # of the design, and of the run if it was simulated
    proof: str = NONE  # one of `PROOFS`; the last one if it is refused

    @property
    def proved(self) -> bool:
        """Whether a design is proved there, whatever its simulation came to."""
        return self.proof != NONE

    @property
    def known(self) -> bool:
        """Whether it says something: it was not lost, and the spec is not in error there."""
        return self.exit not in (None, ExitCode.BUG, ExitCode.INVALID)

    @property
    def verdict(self) -> str:
        """The kind of proof, or else the exit code in words."""
        if self.exit == ExitCode.DONE:
            return self.proof
        return "lost" if self.exit is None else ExitCode(self.exit).verdict


@dataclass(frozen=True, kw_only=True)
class Edge:
    """Where a kind of proof ends along the parameter of this name, each side by a design of its own."""

    inside: Point  # the last place that is known to have this kind of proof
    beyond: Point  # the first one that has another kind, or none
    name: str


def places(axes: Sequence[Axis], method: Method = "grid", count: int = 100, seed: int = 1) -> list[dict[str, float]]:
    """Return the values at which to look: a grid, or drawn at random or as a Latin hypercube; raises InvalidSpec."""
    names = [one.name for one in axes]
    if len(set(names)) < len(names):
        raise InvalidSpec(f"--sweep: {', '.join(names)}: each parameter once")
    total = prod(len(one.values) for one in axes) if method == "grid" else count
    if total > MOST:
        raise InvalidSpec(f"--sweep: {total:,} points, at most {MOST:,} are looked at")
    if method == "grid":
        return [dict(zip(names, row, strict=True)) for row in product(*(map(float, one.values) for one in axes))]
    import numpy as np
    from scipy.stats import qmc

    draw = np.random.default_rng(seed)
    rows = (
        draw.random((total, len(axes))) if method == "random" else qmc.LatinHypercube(len(axes), rng=draw).random(total)
    )
    return [{one.name: one.at(share) for one, share in zip(axes, row, strict=True)} for row in rows.tolist()]


def look(spec: Path, fixed: Mapping[str, str], values: Mapping[str, float], *, simulated: bool) -> Point:
    """Design at one place, and simulate if asked."""
    from pwatrack.claims.decay import gain_figures
    from pwatrack.report.figures import figure_content, measures, numbers
    from pwatrack.report.required import required
    from pwatrack.spec.load import load_spec
    from pwatrack.workflow import pipeline

    figures: dict[str, Any] = {}
    code, said, proof = int(ExitCode.DONE), "", NONE
    try:
        loaded = load_spec(spec, {**fixed, **{name: repr(value) for name, value in values.items()}})
        controller = pipeline.design(loaded, growing=simulated)
        figures, proof = gain_figures(controller), kind_of_proof(controller)
        result = pipeline.simulate(loaded, controller) if simulated else None
        if result is not None:
            figures |= figure_content(measures(result))
            code, said = int(result.outcome.code), result.outcome.text
        missed = [each.text for each in required(loaded, controller, result) if not each.met]
        if missed and code == ExitCode.DONE:
            code, said = int(ExitCode.CHECK_FAILED), f"missed: {'; '.join(missed)}"
    except MemoryError:
        raise
    except PwatrackError as error:
        code, said = int(error.code), error.problems[0].short or error.problems[0].message
    except Exception as error:
        number, lines = told(error)
        code, said = int(number), lines[0]
    return Point(values=values, exit=code, said=said, figures=numbers(figures), proof=proof)


def kind_of_proof(controller: ProvedController) -> str:
    """Return which kind of proof a design has: by common matrices P, by polynomials, or of practical tracking."""
    if controller.claims_of(Practical):
        return PRACTICAL
    promised = controller.guarantees
    claims = [claim for claim in (promised.controller, promised.observer, promised.generator) if claim]
    return PROVED if all(min(proof.degree for proof in claim) == 2 for claim in claims) else POLYNOMIAL


def bisect(spec: Path, fixed: Mapping[str, str], one: Point, other: Point, name: str, width: float) -> Edge:
    """Return where the stronger kind of proof ends between two places that differ in one parameter: within `width`."""
    inside, beyond = sorted((one, other), key=lambda point: PROOFS.index(point.proof))
    for _ in range(_HALVINGS):
        low, high = inside.values[name], beyond.values[name]
        middle = (low + high) / 2
        if abs(high - low) <= width or middle in (low, high):
            break
        found = look(spec, fixed, {**inside.values, name: middle}, simulated=False)
        inside, beyond = (found, beyond) if found.proof == inside.proof else (inside, found)
    return Edge(inside=inside, beyond=beyond, name=name)


def sweep(
    spec: Path,
    axes: Sequence[Axis],
    executor: Executor,
    *,
    at: Sequence[Mapping[str, float]],
    fixed: Mapping[str, str] | None = None,
    simulated: bool = True,
    refine: float | None = None,
    progress: Callable[[int, int], object] = lambda *_: None,
) -> tuple[list[Point], list[Edge]]:
    """Look at many places, from `places`, and refine where a kind of proof ends: points and ends, in order.

    The executor does `look` and `bisect`, one place at a time, on whatever machine. `refine` is the share of each range
    within which ends are found, between neighbours of a grid. `progress` is told how many are done, of how many.
    """
    set_, files = dict(fixed or {}), packed(spec)
    futures = [executor.submit(with_files, files, look, spec, set_, values, simulated=simulated) for values in at]
    points = [_point(f, v) for f, v in zip(_ended(futures, progress), at, strict=True)]
    if refine is None:
        return points, []
    found = [
        executor.submit(with_files, files, bisect, spec, set_, one, other, axis.name, refine * axis.width)
        for one, other, axis in neighbours(points, axes)
        if one.proof != other.proof and one.known and other.known
    ]
    return points, [future.result() for future in _ended(found, progress) if not future.exception()]


def neighbours(points: Sequence[Point], axes: Sequence[Axis]) -> Iterator[tuple[Point, Point, Axis]]:
    """Yield the neighbours on a grid, with the parameter in which they differ."""
    step = 1
    for one in reversed(axes):
        for k, point in enumerate(points):
            if k // step % len(one.values) < len(one.values) - 1:
                yield point, points[k + step], one
        step *= len(one.values)


def _ended(futures: Sequence[Future[Any]], progress: Callable[[int, int], object]) -> Sequence[Future[Any]]:
    for done, _ in enumerate(as_ended(futures), 1):
        progress(done, len(futures))
    return futures


def _point(future: Future[Point], values: Mapping[str, float]) -> Point:
    try:
        return future.result()
    except Lost as lost:
        return Point(values=values, exit=None, said=lost.reason)


def told_of(points: Sequence[Point], edges: Sequence[Edge]) -> Iterator[str]:
    """Yield what a sweep found: where what is proved, over one parameter, and what is best where every check passes.

    Example:
        >>> values = (("a", 1.0, 0.3), ("a", 2.0, 0.5))
        >>> found = [Point(values={n: v}, exit=0, figures={"rate": r}, proof=PROVED) for n, v, r in values]
        >>> list(told_of([*found, Point(values={"a": 3.0}, exit=3)], []))
        ['proved at 2 of 3 values: a = 1 to 2', 'largest rate 0.5 1/s at a = 2']
    """
    names, found = list(points[0].values), [point for point in points if point.proved]
    for name in names if len(names) == 1 and found else ():
        for proof, run in groupby(sorted(points, key=lambda point: point.values[name]), lambda point: point.proof):
            values = [point.values[name] for point in run]
            low, high = (f"{values[k]:.6g}" for k in (0, -1))
            where = f"{name} = {low}" + f" to {high}" * (low != high)
            if proof != NONE:
                yield f"{proof} at {len(values):,} of {len(points):,} values: {where}"
    for edge in edges if len(names) == 1 else ():
        yield f"{edge.inside.proof} at {_at(edge.inside)}, {edge.beyond.verdict} at {_at(edge.beyond)}"
    good = [point for point in found if point.exit == ExitCode.DONE]
    for name in dict.fromkeys(name for point in good for name in point.figures):
        figure = next((f for f in _TOLD if name == f or name.startswith(f"{f}_")), "")
        if figure:
            least = QUANTITIES[figure].best == "at most"
            have = [point for point in good if name in point.figures]
            best = min(have, key=lambda point: point.figures[name] * (1 if least else -1))
            unit = QUANTITIES[figure].unit if not QUANTITIES[figure].unit.startswith("of") else ""
            value = f"{best.figures[name]:.4g} {unit}".rstrip()
            yield f"{'least' if least else 'largest'} {name} {value} at {_at(best)}"


def _at(point: Point) -> str:
    return ", ".join(f"{name} = {value:.6g}" for name, value in point.values.items())


def write_sweep(folder: Path, axes: Sequence[Axis], points: Sequence[Point], edges: Sequence[Edge]) -> list[Path]:
    """Write sweep.csv, boundary.csv if the ends of the proof were sought, and sweep.parquet if pyarrow is there."""
    names = [axis.name for axis in axes]
    figures = list(dict.fromkeys(name for point in points for name in point.figures))
    header = [*names, "exit", "verdict", *figures, "said"]
    rows = [
        [*(p.values[n] for n in names), p.exit, p.verdict, *(p.figures.get(n) for n in figures), p.said] for p in points
    ]
    files = [folder / "sweep.csv"]
    _table(files[0], header, rows)
    if edges:
        files.append(folder / "boundary.csv")
        ends = [
            [e.name, *(e.inside.values[n] for n in names), e.inside.proof, e.beyond.values[e.name], e.beyond.verdict]
            for e in edges
        ]
        _table(files[1], ["along", *names, "proof", "beyond", "verdict_beyond"], ends)
    with suppress(ImportError):
        import pyarrow as arrow
        import pyarrow.parquet as parquet

        files.append(folder / "sweep.parquet")
        with written_at_once(files[-1]) as temporary:
            columns = dict(zip(header, map(list, zip(*rows, strict=True)), strict=True))
            parquet.write_table(arrow.table(columns), temporary)
    return files


def draw_sweep(path: Path, title: str, axes: Sequence[Axis], points: Sequence[Point], edges: Sequence[Edge]) -> bool:
    """Draw curves over one parameter or maps over two; return whether there is such a picture."""
    if len(axes) > 2:
        return False
    import numpy as np

    from pwatrack.report.plots.canvas import png
    from pwatrack.report.plots.spread import sweep_curves, sweep_maps

    names = [axis.name for axis in axes]
    at = [np.array([point.values[name] for point in points]) for name in names]
    known = dict.fromkeys(name for point in points for name in point.figures)
    figures = {n: np.array([p.figures.get(n, np.nan) if p.proved else np.nan for p in points]) for n in known}
    ends = [tuple((e.inside.values[n] + e.beyond.values[n]) / 2 for n in names) for e in edges]
    if len(axes) == 1:
        figure = sweep_curves(title, names[0], at[0], figures, [end[0] for end in ends])
    else:
        verdicts = [point.verdict for point in points]
        pairs = [(end[0], end[1]) for end in ends]
        figure = sweep_maps(title, (names[0], names[1]), (at[0], at[1]), verdicts, figures, pairs)
    with written_at_once(path) as temporary:
        temporary.write_bytes(png(figure))
    return True


def _table(path: Path, header: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    with written_at_once(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows([repr(v) if isinstance(v, float) else v for v in row] for row in rows)


def _name(spec: Path, fixed: Mapping[str, str], at: Sequence[Mapping[str, float]]) -> str:
    """Return the name of a spec; raises InvalidSpec if it is in error wherever it is looked at, as at the first one."""
    refusals = list[InvalidSpec]()
    for values in at[:: max(len(at) // _TRIED, 1)]:
        try:
            return read_sweep(spec, {**fixed, **{key: repr(value) for key, value in values.items()}})[0]
        except InvalidSpec as refusal:
            refusals.append(refusal)
    raise refusals[0]


def swept(
    spec: Path,
    ranges: Sequence[str],
    out: Path,
    *,
    parameters: Sequence[str],
    method: Method,
    count: int,
    seed: int,
    simulated: bool,
    refine: float | None,
    jobs: int,
    scheduler: str | None,
) -> int:
    """Sweep a spec as the command line does, over given ranges or those of the file; return its exit code."""
    fixed = assignments(parameters)
    axes = [axis(text) for text in ranges] or read_sweep(spec, fixed)[1]
    if twice := sorted({one.name for one in axes} & fixed.keys()):
        raise InvalidSpec(f"--set {twice[0]}: it varies in this sweep", hint="leave one of the two out")
    if not axes:
        raise InvalidSpec(f"{spec}: nothing varies", hint="--sweep k=0.1:0.9:17, or 'sweep' in the file")
    at = places(axes, method, count, seed)
    name = _name(spec, fixed, at)
    told = console(stderr=True)

    def progress(done: int, total: int) -> None:
        status.update(f"{done:,} of {total:,}")
        if not told.is_terminal and done * _TIMES // total > (done - 1) * _TIMES // total:
            told.print(f"{done:,} of {total:,}")

    with (
        told.status("Starting") as status,
        Cluster(scheduler, timeout=_LIMIT) if scheduler else Pool(jobs, timeout=_LIMIT, preload=PRELOAD) as executor,
    ):
        points, edges = sweep(
            spec,
            axes,
            executor,
            at=at,
            fixed=fixed,
            simulated=simulated,
            refine=refine if method == "grid" else None,
            progress=progress,
        )
    screen = console()
    files = write_sweep(out, axes, points, edges)
    if draw_sweep(out / "sweep.png", f"{name}: {len(points):,} designs", axes, points, edges):
        files.append(out / "sweep.png")
    for verdict in dict.fromkeys(point.verdict for point in points):
        screen.print(f"{sum(point.verdict == verdict for point in points):,} {verdict}")
    for sentence in told_of(points, edges):
        screen.print(sentence, soft_wrap=True)
    if edges and len(axes) > 1:
        screen.print(f"a kind of proof ends at {len(edges):,} places: boundary.csv has both sides of each")
    screen.print(f"{out}: {', '.join(file.name for file in files)}", soft_wrap=True)
    return int(ExitCode.BUG if any(point.exit in (None, ExitCode.BUG) for point in points) else ExitCode.DONE)
