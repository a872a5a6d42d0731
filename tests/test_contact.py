"""Contacts that push and never pull: their cells, and what a run through them is."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from pwatrack import design, load_spec, plant, simulate
from pwatrack.arrays import Array
from pwatrack.errors import OutsideTheory
from pwatrack.model.contact import Contact
from pwatrack.report.plots.elements import nonlinearities
from tests.conftest import SPECS
from tests.test_cli import call, refused
from tests.test_drawing import points

SPEC = """
name: carriage
parameters: {m: 2, c: 40, d: 3, r: 1}
system:
  states: [z, v]
  inputs: [F]
  outputs: [y]
  units: {z: m, v: m/s, F: N, y: m}
  A: [[0, 1], [0, -r/m]]
  nonlinearities:
    - {name: pad, kind: contact, of: z, rate: v, start: 0.1, stiffness: c, damping: d, into: {v: -1/m}}
  B: [[0], [1/m]]
  C: [[1, 0]]
reference: {output: {sine: {amplitude: 0.3, frequency: 2}}}
simulation: {duration: 8, sample_time: 0.01, initial: {plant: [0.2, -2]}}
"""


def written(folder: Path, **changes: str) -> Path:
    """Return the spec above with other text in places."""
    text = SPEC
    for old, new in changes.items():
        key = {"kind": "contact", "start": "start: 0.1"}.get(old, old)
        assert key in text
        text = text.replace(key, new)
    (folder / "spec.yaml").write_text(text, encoding="utf-8")
    return folder / "spec.yaml"


def force(s: float, rate: float, *, c: float, d: float) -> float:
    """Return the force of Modelica's ElastoGap for a compression, with its branches."""
    if s <= 0:
        return 0.0
    spring, damper = c * s, d * rate
    return spring + min(max(damper, -spring), spring)


sizes = st.integers(1, 9)


@given(c=sizes, d=sizes, seed=st.integers(0, 10_000), two=st.booleans())
@settings(max_examples=30)
def test_the_cells_cover_the_plane_and_the_field_is_the_formula(c: int, d: int, seed: int, two: bool) -> None:
    rng = np.random.default_rng(seed)
    M = rng.integers(-4, 5, (3, 3)).tolist()
    ends = {"kind": "elasto_backlash", "lower": -0.5, "upper": 0.25} if two else {"kind": "contact", "start": 0.25}
    pad = {"name": "pad", "of": "a - b", "rate": "w + a", "stiffness": c, "damping": d, "into": {"w": -2, "b": 1}}
    found = plant(A=M, B=[[0], [0], [1]], C=[[1, 0, 0]], states=["a", "b", "w"], nonlinearities=[pad | ends]).system
    found.partition.check()
    assert len(found.cell_names) == (7 if two else 4)
    for x in rng.normal(size=(40, 3)):
        s, rate = x[0] - x[1], x[2] + x[0]
        f = force(s - 0.25, rate, c=c, d=d) - (force(-0.5 - s, -rate, c=c, d=d) if two else 0.0)
        assert found.field(x, np.zeros(1)) == pytest.approx(np.array(M) @ x + f * np.array([0, 1, -2.0]), abs=1e-9)
        (element,) = found.elements
        assert isinstance(element, Contact)
        assert element(s, rate) == pytest.approx(f, abs=1e-9)
    for facet in found.partition.facets:  # on each facet both cells say the same, exactly
        jump = found.exact.A[facet.i].centre - found.exact.A[facet.j].centre
        H = np.array(found.partition.H[facet.k])
        assert np.linalg.matrix_rank(np.vstack([np.array(jump.tolist(), dtype=float), H])) == 1


def test_a_run_through_contacts_is_what_an_integrator_of_the_formula_finds() -> None:
    """The plant is integrated from the input of the run; no cell is known to the integrator."""
    result = simulate(load_spec(SPECS / "gallery" / "carriage_between_contacts.yaml"))
    controller, x, t = result.controller, result.response.x, result.response.t
    K, L, (m, c, d, gap, r) = controller.K, controller.L, (1.0, 10.0, 1.5, 0.5, 0.2)

    def field(x: Array, u: float) -> Array:
        f = force(x[0] - gap, x[1], c=c, d=d) - force(-gap - x[0], -x[1], c=c, d=d)
        return np.array([x[1], (u - r * x[1] - f) / m])

    def both(t: float, z: Array) -> Array:
        desired = np.array([0.8 * np.sin(1.5 * t), 1.2 * np.cos(1.5 * t)])
        feedforward = m * -1.8 * np.sin(1.5 * t) - field(desired, 0.0)[1] * m
        u = float(K[0] @ (z[2:] - desired)) + feedforward
        return np.concatenate([field(z[:2], u), field(z[2:], u) + L[:, 0] * (z[2] - z[0])])

    z0 = np.concatenate([x[0], result.response.x_hat[0]])
    found = solve_ivp(both, (0, t[-1]), z0, method="DOP853", t_eval=t, rtol=1e-12, atol=1e-13)
    assert np.abs(found.y[:2].T - x).max() < 1e-8
    assert len(result.figures.time_share["plant"]) == 7, "it has been in all cells"


def test_a_contact_never_pulls_and_begins_without_a_jump(tmp_path: Path) -> None:
    (pad,) = load_spec(written(tmp_path)).problem.plant.elements
    assert isinstance(pad, Contact)
    for rate in (-50.0, -1.0, 0.0, 1.0, 50.0):
        values = [pad(s, rate) for s in np.linspace(0.05, 0.4, 400)]
        assert min(values) == 0
        assert np.abs(np.diff(values)).max() <= 2 * 40 * 0.35 / 399 + 1e-12


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"damping: d": "damping: 0"}, "damping is 0, expected more than 0: without damping it is a spring"),
        ({"stiffness: c": "stiffness: -c"}, "stiffness is -40, expected more than 0"),
        ({"rate: v": "rate: 2*z"}, "rate is a multiple of 'of', or 0"),
        ({"kind": "elasto_backlash", "start": "lower: 1, upper: 0"}, "1 and 0 are not in increasing order"),
        ({"into: {v: -1/m}": "into: {w: -1/m}"}, "'w' is no state"),
    ],
)
def test_numbers_that_make_no_contact_are_refused(tmp_path: Path, change: dict[str, str], said: str) -> None:
    run = call("check", written(tmp_path, **change))
    assert f"nonlinearity 'pad': {said}" in " ".join(refused(run, 2).split())


def test_a_wrong_sign_and_a_rate_that_is_none_are_remarked(tmp_path: Path) -> None:
    away = load_spec(written(tmp_path, **{"-1/m}}": "1/m}}"})).problem.plant.remarks
    assert any("'pad' pushes z on, away from where it acts: write into: {v: -0.5}" in remark for remark in away)
    other = load_spec(written(tmp_path, **{"rate: v": "rate: 2*v"})).problem.plant.remarks
    assert other == ("nonlinearity 'pad' has rate: 2*v, and d/dt of what it looks at is v",)
    assert not load_spec(written(tmp_path)).problem.plant.remarks


def test_a_mass_may_be_uncertain_and_a_stiffness_not(tmp_path: Path) -> None:
    path = written(tmp_path, **{"reference:": "design: {uncertain: {m: 10%}}\nreference:"})
    run = call("design", path, "--out", tmp_path / "out")
    assert run.exit_code == 0, run.output
    path = written(tmp_path, **{"reference:": "design: {uncertain: {c: 10%}}\nreference:"})
    with pytest.raises(OutsideTheory, match="hyperplanes are to be known"):
        design(load_spec(path))


def test_units_change_nothing(tmp_path: Path) -> None:
    """In millimetres, each cell has the same matrices but for their units."""
    mm = written(
        tmp_path,
        **{"d: 3, r: 1": "d: 3, r: 1, k: 1000", "start: 0.1": "start: 0.1*k", "stiffness: c": "stiffness: c/k"}
        | {"damping: d": "damping: d/k", "-1/m}}": "-k/m}}", "[1/m]": "[k/m]"},
    )
    other = load_spec(mm).problem.plant
    one = load_spec(written(tmp_path)).problem.plant
    assert one.cell_names == other.cell_names
    assert all(a.centre == b.centre for a, b in zip(one.exact.A, other.exact.A, strict=True))


def test_a_contact_is_drawn_at_rest_closing_and_leaving(tmp_path: Path) -> None:
    problem = load_spec(written(tmp_path)).problem
    (axes,) = nonlinearities("carriage", problem.plant, problem.units).axes
    for line in axes.lines[1:]:
        rate = float(str(line.get_label()).split()[2].replace("−", "-"))
        s, f = points(line).T
        assert f == pytest.approx([force(v - 0.1, rate, c=40, d=3) for v in s], abs=3 * 0.05 * abs(rate) + 1e-9)
