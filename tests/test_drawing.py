from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

import pytest

from pwatrack import Result, load_spec, simulate
from pwatrack.batch.pool import Lost, Pool
from pwatrack.report.drawing import begin, prepare
from pwatrack.report.files import write_result
from pwatrack.report.plots.canvas import png
from pwatrack.report.plots.pictures import pictures


@pytest.fixture(scope="module")
def result(specs: Path) -> Result:
    return simulate(load_spec(specs / "gallery" / "kinked_tanks.yaml"))


@pytest.fixture(scope="module")
def alone(result: Result) -> dict[str, bytes]:
    """All pictures, drawn here."""
    return begin(result, None)()


@pytest.mark.slow
def test_other_processes_draw_the_same_pictures_to_the_last_bit(result: Result, alone: dict[str, bytes]) -> None:
    with Pool(2) as pool:
        prepare(pool)
        shared = begin(result, pool)()
    assert shared == alone
    assert all(content.startswith(b"\x89PNG") for content in alone.values())


@pytest.mark.slow
def test_what_others_do_not_draw_is_drawn_here(result: Result, alone: dict[str, bytes], tmp_path: Path) -> None:
    class Losing(Executor):
        def submit(self, *_: Any, **__: Any) -> "Future[Any]":
            future = Future[Any]()
            future.set_exception(Lost("killed by signal 9"))
            return future

    folder = write_result(result, tmp_path, executor=Losing())
    assert {file.name: file.read_bytes() for file in folder.glob("*.png")} == alone


@pytest.mark.slow
@pytest.mark.parametrize("spec", ["kinked_tanks", "payload_in_wind"])
def test_panels_fill_a_picture_and_leave_room_for_what_is_written_beside_them(
    result: Result, alone: dict[str, bytes], specs: Path, spec: str
) -> None:
    found = result if spec == "kinked_tanks" else simulate(load_spec(specs / "gallery" / f"{spec}.yaml"))
    for name, draw in pictures(found).items():
        figure = draw()
        drawn = png(figure)
        if found is result:
            assert drawn == alone[name]
            assert drawn == png(figure)  # drawn again, nothing moves
        panels, (width, height) = figure.axes, figure.bbox.size
        boxes = [box for axes in panels if (box := axes.get_tightbbox(for_layout_only=True))]
        for k, box in enumerate(boxes):
            assert box.x0 > 0
            assert box.y0 > 0
            assert box.x1 < width
            assert box.y1 < height
            for other in boxes[:k]:
                assert box.x1 < other.x0 or other.x1 < box.x0 or box.y1 < other.y0 or other.y1 < box.y0
        room = 0.1 * figure.dpi
        assert min(box.x0 for box in boxes) < room
        assert min(box.y0 for box in boxes) < room
        assert max(box.x1 for box in boxes) > width - room
        labels = dict[int, list[float]]()
        for axes in panels:
            spec_of = axes.get_subplotspec()
            assert spec_of is not None
            place = axes.yaxis.label.get_transform().transform(axes.yaxis.label.get_position())
            labels.setdefault(spec_of.colspan.start, []).append(place[0])
        assert all(max(places) - min(places) < 0.01 for places in labels.values())
