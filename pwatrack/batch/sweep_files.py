"""A sweep as tables and a picture."""

import csv
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from pwatrack.batch.sweep import Edge, Point
from pwatrack.report.run_folder import written_at_once
from pwatrack.spec.axis import Axis


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
