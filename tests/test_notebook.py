"""What a notebook shows is what the command line says and the files hold; linear systems of others are plants."""

from io import BytesIO
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy import signal

from pwatrack import Design, InvalidSpec, Result, design, ensemble, load_spec, plant, problem, simulate
from pwatrack.api import Many
from pwatrack.report.notebook import frame
from pwatrack.report.screen import Findings, first_rows, joined
from tests.conftest import SPECS

ASKED: dict[str, Any] = {"reference": "0.1*sin(t)", "simulation": {"duration": 5, "sample_time": 0.05}}
STOP = {"name": "<stop>", "kind": "spring", "of": "x1", "start": 0.05, "slope": 2, "into": {"x2": -1}}


@pytest.fixture(scope="module")
def made() -> Design:
    return design(problem(plant(A=[[0, 1], [-1, -1]], B=[0, 1], C=[1, 0], units={"x1": "m", "y": "m"}), **ASKED))


@pytest.fixture(scope="module")
def run(made: Design) -> Result:
    return simulate(made)


@pytest.fixture(scope="module")
def many(run: Result) -> Many:
    return ensemble(run, 5)


def test_a_notebook_shows_all_rows_of_the_first_screen(made: Design, run: Result, many: Many) -> None:
    for shown, came in ((made, {}), (run, {"result": run}), (many, {"result": run, "many": many})):
        rows = joined(first_rows(Findings(spec=made.spec, controller=made, **came)))
        html = shown._repr_html_()
        assert html.count("<tr>") == len(rows)
        assert all(f">{label}</th>" in html for label, _ in rows)
        assert html.count("<img") == (0 if shown is made else 1)


def test_names_of_a_file_are_text_and_no_markup(made: Design) -> None:
    spec = problem(plant(A=[[-1]], B=[1], C=[1]), **ASKED, name="<script>x</script>")
    assert "<script>" not in design(spec)._repr_html_()


def test_every_picture_shows_itself_where_pyplot_is_not_in_use(run: Result, many: Many) -> None:
    pictures = run.plot()
    assert pictures._repr_html_().count("<img") == len(pictures) >= 6
    for figure in (pictures["tracking_error"], many.plot()):
        content = vars(figure)["_repr_png_"]()
        assert Image.open(BytesIO(content)).size[0] == round(150 * figure.get_size_inches()[0])


def test_tables_of_pandas_have_the_signals_and_the_members(run: Result, many: Many) -> None:
    pytest.importorskip("pandas")
    table = run.to_dataframe()
    assert table.index.name == "t"
    assert np.array_equal(table.index, run.t)
    assert table.attrs["units"] == {"x1": "m", "y": "m"}
    for name, values in run.signals.items():
        assert name == "t" or np.array_equal(table[name], values)
    members = many.to_dataframe()
    assert list(members) == list(many.table)
    assert np.array_equal(members["final_error"], many.table["final_error"])


def test_without_pandas_it_is_said_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pandas", None)
    with pytest.raises(InvalidSpec, match="pandas is not installed"):
        frame({"t": [0.0]})


@pytest.mark.parametrize("kind", ["scipy", "control"])
def test_a_linear_system_of_others_is_a_plant_of_the_same_numbers(kind: str) -> None:
    A, B, C = np.array([[0.0, 1.0], [-2.0, -0.1]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
    if kind == "scipy":
        found = plant(signal.StateSpace(A, B, C, 0), nonlinearities=[STOP | {"name": "stop"}])
        assert found.system.states == ("x1", "x2")
    else:
        control = pytest.importorskip("control")
        found = plant(control.ss(A, B, C, 0, states=["z", "v"], inputs=["F"], outputs=["y"]))
        assert (found.system.states, found.system.inputs, found.system.outputs) == (("z", "v"), ("F",), ("y",))
        default = plant(control.ss(A, B, C, 0))  # x[0] is no name
        assert default.system.states == ("x1", "x2")
    assert np.array_equal(found.system.A[0], A)
    assert np.array_equal(found.system.B, B)
    assert np.array_equal(found.system.C, C)
    assert len(found.system.A) == (2 if kind == "scipy" else 1)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((np.eye(2),), "a ndarray is no linear system"),
        ((signal.StateSpace([[-1]], [[1]], [[1]], [[2]]),), "D is not 0"),
        ((signal.StateSpace([[0.5]], [[1]], [[1]], [[0]], dt=0.1),), "sampled every 0.1 s"),
        ((), "A is missing"),
    ],
)
def test_what_is_no_plant_in_continuous_time_is_refused_in_words(arguments: tuple[object, ...], said: str) -> None:
    with pytest.raises(InvalidSpec, match=said):
        plant(*arguments)


def test_what_a_system_has_is_not_given_beside_it() -> None:
    with pytest.raises(InvalidSpec, match="B is given beside a system that has one"):
        plant(signal.StateSpace([[-1]], [[1]], [[1]], [[0]]), B=[[1]])


def test_one_input_and_one_output_are_vectors_or_matrices_alike() -> None:
    flat = plant(A=[[0, 1], [-1, -1]], B=np.array([0, 1]), C=[1, 0])
    full = plant(A=[[0, 1], [-1, -1]], B=[[0], [1]], C=[[1, 0]])
    assert flat.sections == full.sections
    with pytest.raises(InvalidSpec, match="B: 3 rows, expected 2"):
        plant(A=[[0, 1], [-1, -1]], B=[0, 1, 2], C=[1, 0])


def test_a_run_of_a_file_shows_itself_too() -> None:
    made = design(load_spec(SPECS / "two_mass_paper_gains.yaml"))
    assert "Theorem 3" in made._repr_html_()
