from concurrent.futures import Executor, Future
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.transforms import Bbox, BboxBase
from PIL import Image

from pwatrack import Result, ensemble, load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.batch.pool import Lost, Pool
from pwatrack.report.drawing import Picture, begin, prepare
from pwatrack.report.files import write_result
from pwatrack.report.plots.canvas import png
from pwatrack.report.plots.elements import nonlinearities
from pwatrack.report.plots.pictures import active_cells, pictures
from pwatrack.report.plots.signals import observer_error, outputs
from pwatrack.report.plots.spread import fan
from tests.scenarios import mass
from tests.test_cli import call


@pytest.fixture(scope="module")
def result(specs: Path) -> Result:
    return simulate(load_spec(specs / "gallery" / "kinked_tanks.yaml"))


@pytest.fixture(scope="module")
def alone(result: Result) -> dict[str, Picture]:
    """All pictures, drawn here."""
    return begin(result, None)()


@pytest.mark.slow
def test_other_processes_draw_the_same_pictures_to_the_last_bit(result: Result, alone: dict[str, Picture]) -> None:
    with Pool(2) as pool:
        prepare(pool)
        shared = begin(result, pool)()
    assert shared == alone
    assert all(each.png.startswith(b"\x89PNG") and each.svg.endswith("</svg>\n") for each in alone.values())


@pytest.mark.slow
def test_what_others_do_not_draw_is_drawn_here(result: Result, alone: dict[str, Picture], tmp_path: Path) -> None:
    class Losing(Executor):
        def submit(self, *_: Any, **__: Any) -> "Future[Any]":
            future = Future[Any]()
            future.set_exception(Lost("killed by signal 9"))
            return future

    folder = write_result(result, tmp_path, executor=Losing())
    assert {file.stem: file.read_bytes() for file in folder.glob("*.png")} == {
        name: each.png for name, each in alone.items()
    }


@pytest.mark.slow
@pytest.mark.parametrize("spec", ["kinked_tanks", "payload_in_wind"])
def test_panels_fill_a_picture_and_leave_room_for_what_is_written_beside_them(
    result: Result, alone: dict[str, Picture], specs: Path, spec: str
) -> None:
    found = result if spec == "kinked_tanks" else simulate(load_spec(specs / "gallery" / f"{spec}.yaml"))
    for name, draw in pictures(found).items():
        figure = draw()
        drawn = png(figure)
        if found is result:
            assert drawn == alone[name].png
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


def written(figure: Figure, monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, Bbox]]:
    """Return every text that is drawn into a picture, with its place in dots."""
    png(figure)  # panels are placed
    found = list[tuple[str, Bbox]]()
    draw = Text.draw

    def noted(self: Text, renderer: Any) -> None:
        if self.get_visible() and self.get_text().strip():
            found.append((self.get_text(), self.get_window_extent(renderer)))
        draw(self, renderer)

    with monkeypatch.context() as patched:
        patched.setattr(Text, "draw", noted)
        png(figure)
    return found


def points(line: Line2D) -> Array:
    return np.asarray(line.get_xydata(), dtype=float)


def shared(one: BboxBase, other: BboxBase) -> float:
    """Return how many dots two boxes have in common, at least, in either direction; negative where they are apart."""
    wide = float(min(one.x1, other.x1) - max(one.x0, other.x0))
    return min(wide, float(min(one.y1, other.y1) - max(one.y0, other.y0)))


@pytest.mark.slow
def test_how_far_an_output_may_go_is_drawn_beyond_all_that_its_reference_is(tmp_path: Path) -> None:
    line = "{polyline: {points: [[0, 0], [2, 1.5], [5, 1], [20, 1]], smooth: 0.5}}"
    text = mass(reference=f"{{output: {line}}}", simulation="{duration: 20, sample_time: 0.01}")
    text += "require: {overshoot: 10%}\n"
    (tmp_path / "mass.yaml").write_text(text, encoding="utf-8")
    result = simulate(load_spec(tmp_path / "mass.yaml"))
    drawn = [each for axes in outputs(result).axes for each in axes.lines if each.get_label() == "required"]
    (height,) = {float(np.asarray(each.get_ydata())[0]) for each in drawn}
    assert height == pytest.approx(result.response.tracked_d.max() + 0.1, rel=1e-3)


@pytest.mark.parametrize("spec", ["payload_in_wind", "three_tanks_pumps", "beam_one_sided_spring", "two_rooms"])
def test_no_text_is_cut_or_on_another_and_no_inset_is_on_what_is_drawn(
    specs: Path, spec: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = simulate(load_spec(specs / "gallery" / f"{spec}.yaml"))
    figures = {name: draw() for name, draw in pictures(result).items()}
    problem, insets = result.spec.problem, 0
    figures["as `check` draws them"] = nonlinearities(result.spec.name, problem.plant, problem.units)
    if spec == "payload_in_wind":
        figures["ensemble"] = fan(ensemble(result, 3))
    for name, figure in figures.items():
        texts = written(figure, monkeypatch)
        assert len(texts) > 10
        if name in ("outputs", "states"):
            shown = {text.split(" ")[0] for text, _ in texts}
            plant = problem.plant
            assert set(plant.tracked_names if name == "outputs" else plant.states) <= shown
        whole = figure.bbox
        for k, (text, box) in enumerate(texts):
            assert shared(box, whole) > 0, (name, text)
            assert box.x0 >= 0, (name, text)
            assert box.y0 >= 0, (name, text)
            assert box.x1 <= whole.x1, (name, text)
            assert box.y1 <= whole.y1, (name, text)
            assert not [other for other, place in texts[:k] if shared(box, place) > 1], (name, text)
        for axes in figure.axes:
            for inset in axes.child_axes:
                insets += 1
                assert not [text for text, box in texts if shared(box, inset.bbox) > 1], name
                around = inset.get_tightbbox()
                assert around is not None
                for curve in axes.lines:
                    places = axes.transData.transform(points(curve))
                    assert len(places) == 2 or not any(around.contains(x, y) for x, y in places), (name, curve)
    assert insets or spec == "beam_one_sided_spring"


def test_the_start_is_shown_to_the_end_of_a_move_that_goes_on(tmp_path: Path) -> None:
    """A tenth of the time is 1 s; the reference moves from 0.8 s to 1.6 s."""
    (tmp_path / "moving.yaml").write_text(
        """
name: a mass
system: {states: [z, v], inputs: [u], outputs: [y], A: [[0, 1], [-1, -1]], B: [[0], [1]], C: [[1, 0]]}
reference: {output: {step: {size: 1, at: 0.8, smooth: 0.8}}}
simulation: {duration: 10, sample_time: 0.01}
"""
    )
    result = simulate(load_spec(tmp_path / "moving.yaml"))
    _, start, end = pictures(result)["outputs"]().axes
    assert start.get_xlim() == pytest.approx((0, 1.1 * 1.6), abs=0.03)
    assert end.get_xlim()[1] == 10
    y_d = points(start.lines[1])[:, 1]
    assert (y_d[0], y_d[-1]) == pytest.approx((0, 1), abs=1e-9)


def test_a_long_title_and_a_brief_start_of_an_input_are_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nine states that decay in 1 s, and one that its input holds and that is off for 0.01 s of 60."""
    poles = [-1.0] * 9 + [1.0]
    (tmp_path / "many.yaml").write_text(
        f"""
name: ten states
system:
  states: [{", ".join(f"x{k}" for k in range(10))}]
  inputs: [u]
  outputs: [y]
  sizes: {{x9: 1e-3, u: 1, y: 1e-3}}
  A: {np.diag(poles).tolist()}
  B: {[[0.0]] * 9 + [[1.0]]}
  C: [{[0.0] * 9 + [1.0]}]
design: {{tracking: state}}
reference: {{state: {[0] * 10}}}
simulation: {{duration: 60, sample_time: 0.005, initial: {{plant: {[1] * 9 + [0.1]}, observer: measured}}}}
"""
    )
    drawn = pictures(simulate(load_spec(tmp_path / "many.yaml")))
    error = drawn["tracking_error"]()
    assert all(box.x0 >= 0 and box.x1 <= error.bbox.x1 for _, box in written(error, monkeypatch))
    (said,) = [text for text, _ in written(error, monkeypatch) if "furthest off" in " ".join(text.split())]
    assert max(map(len, said.splitlines())) <= 100 < len(said.splitlines()[-1]) + len(said.splitlines()[-2])
    _, start, end = drawn["input"]().axes
    assert start.get_xlim()[1] < 0.1
    assert np.diff(end.get_xlim()) == pytest.approx(6)


def test_each_nonlinearity_is_drawn_with_its_slopes_and_where_the_run_was(result: Result) -> None:
    figure = pictures(result)["nonlinearities"]()
    elements = result.spec.problem.plant.written
    assert elements is not None
    for axes, element in zip(figure.axes, elements.elements, strict=True):
        (curve,) = (line for line in axes.lines if len(points(line)) > 2)
        s, phi = points(curve).T
        np.testing.assert_allclose(phi, [element.function(v) for v in s])
        slopes = np.diff(phi) / np.diff(s)
        np.testing.assert_allclose(slopes, [float(v) for v in element.function.slopes])
        said = axes.get_title(loc="left").replace("\n", " ")
        assert all(f": {float(v):.6g}" in said for v in element.function.slopes)
        s = result.response.x @ [float(v) for v in element.row] + float(element.constant)
        (seen,) = axes.patches
        assert seen.get_extents().intervalx == pytest.approx(
            axes.transData.transform([[s.min(), 0], [s.max(), 0]])[:, 0]
        )


def test_check_draws_the_nonlinearities_of_a_plant_that_has_some(specs: Path, tmp_path: Path) -> None:
    picture = tmp_path / "phi.png"
    run = call("check", specs / "gallery" / "kinked_tanks.yaml", "--picture", picture)
    assert (run.exit_code, picture.read_bytes()[:4]) == (0, b"\x89PNG")
    run = call("check", specs / "two_mass_backlash.yaml", "--picture", tmp_path / "none.png")
    assert run.exit_code == 2
    assert "written by its cells" in run.stderr
    assert not (tmp_path / "none.png").exists()


@pytest.mark.slow
def test_a_stay_that_is_shorter_than_a_dot_is_seen(specs: Path) -> None:
    """Each row of a cell that was visited has ink: some stays of this run are a hundredth of a dot long."""
    result = simulate(load_spec(specs / "gallery" / "train_slack_couplings.yaml"))
    figure = active_cells(result)
    ink = np.asarray(Image.open(BytesIO(png(figure))).convert("L")) < 128
    for axes in figure.axes:
        for row in range(len(axes.get_yticks())):
            middle = axes.transData.transform((0, row))[1]
            line = ink[int(ink.shape[0] - middle)]
            assert line[int(axes.bbox.x0) + 3 : int(axes.bbox.x1) - 3].any(), axes.get_yticklabels()[row].get_text()


def test_an_error_that_is_0_at_all_times_is_said_to_be(result: Result) -> None:
    still = replace(result, response=replace(result.response, x_hat=result.response.x))
    texts = [text.get_text() for axes in observer_error(still).axes for text in axes.texts]
    assert texts == ["0 at all times, in the simulation"]
    assert not [axes.texts for axes in observer_error(result).axes if axes.texts]
