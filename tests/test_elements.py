"""Plants that are proved as they are written: the corners of the box of slopes stand for all cells."""

import json
import shutil
from collections.abc import Callable
from fractions import Fraction
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pwatrack import design, load_spec
from pwatrack.ball_matrix import BallMatrix
from pwatrack.commands.export import of_spec
from pwatrack.commands.verify import verify
from pwatrack.errors import CheckFailed, Infeasible, InvalidSpec
from pwatrack.lmi.audit.certificate import audit
from pwatrack.lmi.audit.elements import Elements
from pwatrack.lmi.audit.reading import FORMAT
from pwatrack.lmi.infeasibility import Impossibility
from pwatrack.model.nonlinearity import Nonlinearity, ScalarForm, generate_cells, piecewise_linear
from pwatrack.rational import fraction_of
from pwatrack.report.certificate import design_certificate, refusal_certificate, subject_content
from pwatrack.report.files import write_design
from tests.conftest import designed
from tests.test_cli import call, refused

STOPS = """
name: stops
system:
  states: [z, v, w]
  inputs: [u]
  outputs: [y]
  A: [[0, 1, 0], [-1, -1, 0.1], [0.2, 0, -1]]
  b: [0, 0.5, 0]
  B: [[0], [1], [0]]
  C: [[1, 0, 0]]
  nonlinearities:
    - {name: stop, kind: dead_zone, of: z, lower: -1, upper: 0.5, lower_slope: 2, upper_slope: 0.3, into: {v: -1}}
    - {name: valve, kind: saturation, of: w - 2*z + 0.1, lower: -0.2, upper: 0.4, slope: 0.25, into: {w: -1, v: 0.5}}
reference: {output: "0.1*sin(t)"}
simulation: {duration: 1, sample_time: 0.1}
"""


@pytest.fixture(scope="module")
def stops(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return designed(tmp_path_factory.mktemp("stops"), STOPS)


def certificate(folder: Path) -> dict[str, Any]:
    return dict(json.loads((folder / "certificate.json").read_text()))


@given(st.integers(0, 10_000))
@settings(max_examples=60)
def test_every_cell_is_a_mean_of_the_corners_of_the_box_of_slopes_and_is_read_as_it_is(seed: int) -> None:
    """The weights are the products of how far each slope is from its least one; b_i is no mean, and need not be."""
    random = np.random.default_rng(seed)
    n, count = int(random.integers(2, 5)), int(random.integers(1, 4))
    count = min(n, count)
    elements = []
    for k in range(count):
        marks = sorted(random.choice(20, int(random.integers(1, 4)), replace=False).tolist())
        slopes = [float(v) for v in random.integers(-3, 4, len(marks) + 1)]
        function = piecewise_linear(breakpoints=[float(v) for v in marks], slopes=slopes)
        row = [float(v) for v in random.integers(-2, 3, n)]
        row[k], row[:k] = 1.0, [0.0] * k  # independent
        direction = random.integers(-2, 3, n).tolist()
        elements.append(Nonlinearity(name=f"e{k}", function=function, row=row, constant=0.5, direction=direction))
    A, b = random.integers(-3, 4, (n, n)).tolist(), random.integers(-3, 4, (n, 1)).tolist()
    form = ScalarForm(A=BallMatrix.of(A), b=BallMatrix.of(b), elements=tuple(elements))
    assert form.product
    partition, found, offsets = generate_cells(form.A, form.b, elements)
    counts = [len(e.function.slopes) for e in elements]
    assert len(found) == prod(counts)
    ends = [[s.centre for s in e.function.slopes] for e in elements]
    for i, A_i in enumerate(found):
        cell = np.unravel_index(i, counts)
        total = BallMatrix.of(np.zeros((n, n)))
        for corner in form.corners:
            weight = Fraction(1)
            for slopes_, here, there in zip(ends, cell, np.unravel_index(corner, counts), strict=True):
                low, high = min(slopes_), max(slopes_)
                share = (slopes_[here] - low) / (high - low) if high > low else Fraction(1)
                weight *= share if slopes_[there] == high else 1 - share
            assert weight >= 0
            total = total + scaled(found[corner], weight)
        assert total.centre == A_i.centre
    audited = Elements(content_of(form))
    assert audited.count == len(found)
    assert [audited.name(i) for i in range(audited.count)] == list(partition.names)
    fields = audited.fields([audited.segments(i) for i in range(audited.count)])
    for ours, theirs in zip((found, offsets), fields, strict=True):
        assert [[list(map(fraction_of, row)) for row in X.centre.tolist()] for X in ours] == [X for X, _ in theirs]


def scaled(X: BallMatrix, factor: Fraction) -> BallMatrix:
    return BallMatrix.of([[fraction_of(v) * factor for v in row] for row in X.centre.tolist()])


def content_of(form: ScalarForm) -> dict[str, Any]:
    return {
        "A": form.A.texts,
        "b": form.b.texts,
        "elements": [
            {
                "row": [str(Fraction(v)) for v in e.row],
                "constant": "0.5",
                "direction": [str(Fraction(v)) for v in e.direction],
                "function": {
                    "breakpoints": [str(v.centre) for v in e.function.breakpoints],
                    "slopes": [str(v.centre) for v in e.function.slopes],
                    "value": str(e.function.value.centre),
                },
                "segments": [f"{e.name} {name}" for name in e.function.segments],
            }
            for e in form.elements
        ],
    }


@pytest.mark.slow
def test_a_plant_of_nonlinearities_is_proved_as_it_is_written(stops: Path) -> None:
    """Of nine cells with six different A_i four are the corners; listed they are all proved by the same P."""
    plant = certificate(stops)["plant"]
    assert [element["segments"][0] for element in plant["elements"]] == ["stop below", "valve low"]
    assert not {"cells", "H", "signs"} & set(plant)
    said = verify(stops)
    assert said[0] == "plant: 9 cells cover the state space, the field is continuous"
    assert "generator.json beside it tells the same" in said
    listed = certificate(stops) | subject_content(load_spec(stops.parent / "plant.yaml"), listed=True)
    assert len(listed["plant"]["A"]) == 9
    found, faults = audit(json.dumps(listed))
    assert not faults
    assert found[:-1] == audit(json.dumps(certificate(stops)))[0][:-1]


def first(content: Any) -> Any:
    return content["plant"]["elements"][0]


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda c: first(c)["function"]["slopes"].__setitem__(0, "200"), "the inequality fails for M_"),
        (lambda c: first(c)["function"]["slopes"].__setitem__(1, "-200"), "the inequality fails for M_"),
        (lambda c: first(c)["direction"].__setitem__(1, "50"), "the inequality fails for M_"),
        (lambda c: first(c)["direction"].__setitem__(0, "1"), "the last derivative of an output differs"),
        (lambda c: first(c)["function"]["breakpoints"].reverse(), "the breakpoints of a function do not increase"),
        (lambda c: first(c)["function"]["slopes"].append("1"), "a function does not fit together"),
        (lambda c: first(c)["segments"].append("beyond"), "a segment of an element has no name"),
        (lambda c: first(c).update(row=["0", "0", "0"]), "an element does not fit the plant"),
        (lambda c: first(c).update(row=["-2", "0", "1"]), "the rows of the elements are not independent"),
        (lambda c: c["plant"].update(elements=[]), "the rows of the elements are not independent"),
        (lambda c: c["plant"]["elements"].append(first(c)), "the rows of the elements are not independent"),
        (lambda c: c["plant"]["radius"].update(A=[[["1"] * 3] * 3]), "the numbers of elements are exact"),
        (lambda c: c["generator"].update(T=[[["1"] * 3] * 3]), "T is not that of the plant"),
        (
            lambda c: c.update(uncertain={"parameters": [], "corners": [], "bounds": []}),
            "where parameters are uncertain, all cells are listed",
        ),
    ],
)
def test_a_changed_element_is_refused(stops: Path, change: Callable[[Any], Any], fault: str) -> None:
    content = certificate(stops)
    change(content)
    assert any(fault in found for found in audit(json.dumps(content))[1])


def test_a_certificate_is_of_the_elements_of_its_spec(stops: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.yaml"
    other.write_text(STOPS.replace("upper_slope: 0.3", "upper_slope: 0.31"))
    with pytest.raises(CheckFailed, match="plant is not that of"):
        verify(stops / "certificate.json", other)


def test_generator_json_is_not_vouched_for_where_neither_spec_nor_cells_are_at_hand(
    stops: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    run.mkdir()
    for name in ("certificate.json", "generator.json"):
        (run / name).write_text((stops / name).read_text())
    assert verify(run)[-1].endswith("; generator.json beside it is not looked at")
    generator = json.loads((run / "generator.json").read_text())
    generator["A_eta"][4][0][0] += 1.0
    (run / "generator.json").write_text(json.dumps(generator))
    with pytest.raises(CheckFailed, match=r"A_eta in generator\.json is not what was proved"):
        verify(run, stops.parent / "plant.yaml")


@pytest.mark.parametrize(
    ("reference", "kind"),
    [("output: sin(t)", "P"), ("input: [sin(t)], start: [0, 0, 0]}\ndesign: {tracking: state", "Z")],
)
def test_a_refusal_names_cells_that_are_not_listed(tmp_path: Path, reference: str, kind: str) -> None:
    """The state w grows wherever its valve is shut: in six cells that differ from each other in the stop alone."""
    text = STOPS.replace("[0.2, 0, -1]", "[0, 0, 0.1]").replace("-2*z + 0.1", "+ 0.1").replace("v: 0.5", "v: 0")
    (tmp_path / "s.yaml").write_text(text.replace('output: "0.1*sin(t)"', reference))
    spec = load_spec(tmp_path / "s.yaml")
    with pytest.raises(Infeasible) as refused:
        design(spec)
    assert isinstance(refused.value.evidence, Impossibility)
    content = refusal_certificate(spec, refused.value.evidence)
    assert "elements" in content["plant"]
    said, faults = audit(json.dumps(content))
    assert not faults
    (proof,) = content["proofs"]
    names = [f"'{spec.problem.plant.cell_names[int(i)]}'" for i in proof[kind]]
    assert any(all(name in sentence for name in names) for sentence in said)
    proof[kind] = {"9": next(iter(proof[kind].values()))}
    assert audit(json.dumps(content))[1] == ["there is no 9 among 9"]


def test_elements_that_do_not_make_all_combinations_are_listed(tmp_path: Path) -> None:
    """Two stops on one coordinate: the field is proved in its cells, not for slopes that never meet."""
    text = STOPS.replace("of: w - 2*z + 0.1", "of: 2*z + 0.1")
    (tmp_path / "s.yaml").write_text(text)
    spec = load_spec(tmp_path / "s.yaml")
    content = design_certificate(spec, design(spec))
    assert len(content["plant"]["cells"]) == 5
    assert not audit(json.dumps(content))[1]


@pytest.mark.slow
def test_of_very_many_cells_no_tables_are_written_and_nothing_is_exported(tmp_path: Path) -> None:
    """Two elements with 150 corners each, of two slopes: 22,801 cells with four different matrices."""
    marks = ", ".join(str(k / 10) for k in range(150))
    element = f"kind: piecewise_linear, breakpoints: [{marks}], slopes: [{', '.join(['0.1', '0.2'] * 75)}, 0.1]"
    stops = [f"    - {{name: e{j}, of: {x}, {element}, into: {{v: -1}}}}" for j, x in enumerate("zv")]
    rows = (("  A: [[0, 1], [-1, -1]]", "  B: [[0], [1]]", "  C: [[1, 0]]"), ("  nonlinearities:", *stops))
    head = ("name: many", "system:", "  states: [z, v]", "  inputs: [u]", "  outputs: [y]")
    tail = ("reference: {output: sin(t)}", "simulation: {duration: 1, sample_time: 0.1}")
    (tmp_path / "s.yaml").write_text("\n".join((*head, *rows[0], *rows[1], *tail)) + "\n")
    spec = load_spec(tmp_path / "s.yaml")
    assert [remark for remark in spec.problem.plant.remarks if remark.startswith("22,801 cells, of which no tables")]
    folder = write_design(spec, design(spec), tmp_path / "run")
    assert not {"generator.json", "controller.json"} & {file.name for file in folder.iterdir()}
    assert len((folder / "certificate.json").read_text()) < 30_000
    assert verify(folder)[0] == "plant: 22801 cells cover the state space, the field is continuous"
    with pytest.raises(InvalidSpec, match="the controller has 22,801 cells, too many for its tables"):
        of_spec(spec, 0.1)


LAST = int(FORMAT.split()[-1])


@pytest.mark.parametrize("name", [*(f"pwatrack certificate {LAST + k}" for k in (-1, 1)), "x\n", 11, None])
def test_another_format_is_refused_by_the_names_of_both_and_what_to_do(stops: Path, tmp_path: Path, name: Any) -> None:
    """Also where all else is as it should be: an older file may hold keys, or numbers, that meant something else."""
    shutil.copytree(stops, tmp_path / "run")
    text = json.dumps(certificate(stops) | {"format": name})
    (tmp_path / "run" / "certificate.json").write_text(text)
    shown = repr(name) if isinstance(name, str) else "none that is known"
    (fault,) = audit(text)[1]
    assert fault.startswith(
        f"the format is {shown}, this program reads '{FORMAT}': write it anew with 'pwatrack design'"
    )
    (line,) = refused(call("verify", tmp_path / "run"), 6).splitlines()
    assert fault in line
