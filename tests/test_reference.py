"""References: exact derivatives, boundedness, smoothness, exosystems."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pwatrack.errors import OutsideTheory
from pwatrack.model.profile import Profile, Table, polyline
from pwatrack.model.reference import check_bounded, check_smooth, exosystem
from pwatrack.model.signal import Signal
from pwatrack.spec.expression import ExpressionError, formula
from pwatrack.spec.spelling import spelled

FORMULAS = [
    "3",
    "0.1 + 2*sin(3*t + 1) - cos(t)",
    "sin(2*t)*cos(3*t)**2",
    "t*exp(-t/2)*sin(5*t)",
    "exp(-0.1*t)*(1 + t + t**3)",
    "2**(-t)",
    "(1 - exp(-t))**3",
]


@pytest.mark.parametrize("text", FORMULAS)
@pytest.mark.parametrize("t", [0.0, 0.7, 4.0])
def test_a_formula_has_the_value_that_python_gives_it(text: str, t: float) -> None:
    expected = eval(text, {"sin": np.sin, "cos": np.cos, "exp": np.exp, "t": t})
    assert formula(text, {})(t) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("text", FORMULAS)
@pytest.mark.parametrize("order", [1, 2, 3])
def test_derivatives_agree_with_finite_differences(text: str, order: int) -> None:
    signal, t, h = Signal.of(formula(text, {})), 1.3, 1e-4
    difference = (signal(t + h, order - 1) - signal(t - h, order - 1)) / (2 * h)
    scale = max(1.0, abs(signal(t, order + 2)))
    assert signal(t, order) == pytest.approx(difference, abs=1e-7 * scale)


@pytest.mark.parametrize("text", FORMULAS)
def test_the_exosystem_reproduces_the_signal_and_its_derivatives(text: str) -> None:
    signal = Signal.of(formula(text, {}))
    system = exosystem([signal, Signal.of(formula("sin(t)", {}))])
    for t in (0.0, 0.4, 3.0):
        for order in range(4):
            assert system(t, order)[0] == pytest.approx(signal(t, order), abs=1e-9)
            assert system(t, order)[1] == pytest.approx(np.sin(t + order * np.pi / 2), abs=1e-12)


@pytest.mark.parametrize(
    "text", ["tanh(t)", "sin(t**2)", "1/t", "t**0.5", "sin(t)**-1", "abs(t)", "exp(sin(t))", "t**t"]
)
def test_a_formula_without_an_exact_exosystem_is_refused(text: str) -> None:
    with pytest.raises(ExpressionError, match=r"'.*'"):
        formula(text, {})


@pytest.mark.parametrize(("text", "term"), [("0.1*t", "t "), ("exp(t/5)", "exp\\(0\\.2"), ("t*sin(t)", "t ")])
def test_a_reference_that_grows_is_refused_and_the_interval_named(text: str, term: str) -> None:
    with pytest.raises(OutsideTheory, match=f"y_d is not bounded: it has a term like {term}") as refusal:
        check_bounded(Signal.of(formula(text, {})), name="y_d", subject=())
    (problem,) = refusal.value.problems
    assert "until: T" in spelled(problem).hint
    check_bounded(Signal((0.0,), (formula(text, {}),), end=5.0), name="y_d", subject=())


@pytest.mark.parametrize("text", ["sin(t) - sin(t) + 1", "t - t", "exp(-t)*t**2", "(0.1*t + 0.2*t) - 0.3*t"])
def test_a_bounded_formula_is_accepted(text: str) -> None:
    check_bounded(Signal.of(formula(text, {})), name="y_d", subject=())


PRIMES = (983, 991, 997, 887, 883, 881, 877, 863)


@pytest.mark.parametrize(
    ("text", "period"),
    [
        ("sin(2*pi*t)", 1.0),
        ("sin(6*t) + cos(4*t)", np.pi),
        ("3", None),
        ("sin(t) + sin(pi*t)", None),
        ("sin(1e-320*t) + sin(1e10*t)", None),
        ("sin(1e-310*t)", None),
        ("sin(1e-300*t)", 2e300 * np.pi),
        ("+".join(f"sin(t/{p})" for p in PRIMES), 2 * np.pi * math.prod(PRIMES)),
    ],
)
def test_the_common_period_is_found(text: str, period: float | None) -> None:
    parameters = {"pi": np.pi}
    found = exosystem([Signal.of(formula(text, parameters))]).period
    assert found == (None if period is None else pytest.approx(period))


def step(smooth: float | None) -> Profile:
    from scipy.interpolate import PPoly

    return Profile(corners=PPoly(np.array([[0.0, 2.0]]), [-50.0, 1.0, 50.0]), continuous=False, smooth=smooth, end=None)


@pytest.mark.parametrize("r", [1, 2, 3, 4])
def test_a_rounded_step_has_r_continuous_derivatives_and_no_more_error_than_it_must(r: int) -> None:
    signal = step(0.8).signal(r)
    check_smooth(signal, r, name="y_d", subject=())
    assert signal.jump(r + 1) is not None
    assert signal(0.59) == pytest.approx(0.0, abs=1e-12)
    assert signal(1.41) == pytest.approx(2.0, abs=1e-12)
    assert signal(1.0) == pytest.approx(1.0, abs=1e-12)
    times = np.linspace(0, 3, 301)
    values = np.array([signal(t) for t in times])
    assert (np.diff(values) >= -1e-12).all()


def test_a_sharp_step_is_refused_with_time_and_size() -> None:
    with pytest.raises(OutsideTheory, match=r"itself jumps by 2 at t = 1 s") as refusal:
        check_smooth(step(None).signal(2), 2, name="y_d", subject=())
    assert "smooth" in refusal.value.problems[0].hint


def test_a_kink_is_refused_where_the_derivative_is_needed() -> None:
    kink = Profile(corners=polyline([-9, 1, 2, 9], [0, 0, 3, 3]), continuous=True, smooth=None, end=None).signal(1)
    with pytest.raises(OutsideTheory, match=r"derivative 1 jumps by 3 at t = [12] s"):
        check_smooth(kink, 1, name="y_d", subject=())


@given(st.integers(1, 4), st.floats(0.05, 0.9))
@settings(max_examples=20)
def test_rounding_a_polyline_keeps_what_is_straight(r: int, smooth: float) -> None:
    course = Profile(corners=polyline([-9, 1, 2, 9], [0, 0, 3, 3]), continuous=True, smooth=smooth, end=None)
    signal = course.signal(r)
    check_smooth(signal, r, name="y_d", subject=())
    assert signal(1.5) == pytest.approx(1.5, abs=1e-9)
    assert signal(1.0 - smooth / 2 - 1e-3) == pytest.approx(0.0, abs=1e-9)
    assert signal(2.0 + smooth / 2 + 1e-3) == pytest.approx(3.0, abs=1e-9)


@pytest.mark.parametrize("r", [1, 2, 3, 4])
def test_a_table_is_met_at_its_points_with_r_continuous_derivatives(r: int) -> None:
    t = np.linspace(0, 5, 26)
    signal = Table(t, np.sin(t)).signal(r)
    check_smooth(signal, r, name="y_d", subject=())
    for k in (0, 3, 25):
        assert signal(float(t[k])) == pytest.approx(np.sin(t[k]), abs=1e-12)
    assert signal(2.34) == pytest.approx(np.sin(2.34), abs=1e-4)
    assert signal.end == 5.0


def test_an_exosystem_with_resets_follows_the_pieces() -> None:
    signal = step(0.8).signal(2) + Signal.of(formula("0.3*sin(2*t)", {}))
    system = exosystem([signal])
    assert len(system.breaks) >= 3
    for t in (0.0, 0.7, 0.95, 1.2, 2.5):
        for order in range(3):
            assert system(t, order)[0] == pytest.approx(signal(t, order), abs=1e-10)


def test_a_table_file_is_read_from_the_folder_of_the_spec(specs: Path, tmp_path: Path) -> None:
    from pwatrack import load_spec, simulate

    t = np.linspace(0, 2, 41)
    rows = "\n".join(f"{a!r}, {b!r}" for a, b in zip(t.tolist(), (0.1 * np.sin(3 * t)).tolist(), strict=True))
    (tmp_path / "wanted.csv").write_text("t, y\n" + rows)
    text = (specs / "two_mass_backlash.yaml").read_text().replace("duration: 60", "duration: 2")
    line = next(line for line in text.splitlines() if line.strip().startswith("output: {sine"))
    (tmp_path / "plant.yaml").write_text(text.replace(line, "  output: {table: {file: wanted.csv}}"))
    result = simulate(load_spec(tmp_path / "plant.yaml"))
    assert result.response.y_d[:, 0] == pytest.approx(0.1 * np.sin(3 * result.response.t), abs=1e-5)
