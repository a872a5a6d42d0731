import ast
import contextlib
import math
import re
import warnings
from collections.abc import Iterator, Mapping
from fractions import Fraction

import numpy as np
import pytest
from flint import arb, fmpq
from hypothesis import assume, given
from hypothesis import strategies as st

from pwatrack.real import Real
from pwatrack.spec.expression import (
    BrokenParameter,
    ExpressionError,
    UnknownName,
    inequalities,
    linear_form,
    real,
)
from tests.precise import digits

PARAMETERS = {"k1": 2.0, "c": -0.5}


def rows(text: str) -> list[list[float]]:
    return [[*form.row.tolist(), form.constant] for form in inequalities(text, ["z", "w"], PARAMETERS)]


def number(text: str, parameters: Mapping[str, float | None]) -> float:
    return float(real(text, parameters))


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 1e-3),
        ("-1E+3", -1000.0),
        (".5", 0.5),
        ("5.", 5.0),
        ("0", 0.0),
        ("2*pi", 2 * math.pi),
        ("-2**2", -4.0),
        ("2**-1", 0.5),
        ("2**3**2", 512.0),
        ("1 - 2 - 3", -4.0),
        ("8/4/2", 1.0),
        ("-(k1 + c)/3", -0.5),
        ("+-+1", -1.0),
        ("atan2(1, -1)", math.atan2(1, -1)),
        ("log(8, 2)", 3.0),
        ("min(3, k1, 5) + max(c, 0)", 2.0),
        ("abs(c)", 0.5),
        ("sqrt(k1)", math.sqrt(2)),
        ("  1 ", 1.0),
    ],
)
def test_a_number_has_the_value_that_it_has_on_paper(text: str, value: float) -> None:
    assert number(text, PARAMETERS) == value


NO_NUMBER = ["010", "-007", "12:30:45", "1.5.2", "1e", "1,5", "3 4", "", "   ", "k1 k1", "2k1"]


@pytest.mark.parametrize("text", NO_NUMBER)
def test_what_only_looks_like_a_number_is_refused(text: str) -> None:
    with pytest.raises(ExpressionError):
        number(text, PARAMETERS)


@pytest.mark.parametrize("text", ["no", "yes", "on", "off", "true", "null", "nan", "inf", "e", "sin"])
def test_a_word_that_is_not_declared_is_an_unknown_name(text: str) -> None:
    with pytest.raises(ExpressionError, match=f"unknown name '{text}'"):
        number(text, PARAMETERS)


def test_a_declared_name_that_yaml_would_read_as_false_is_a_name() -> None:
    assert number("2*no + on", {"no": 3.0, "on": 1.0}) == 7.0


def test_a_misspelt_name_gets_a_guess() -> None:
    with pytest.raises(UnknownName, match="unknown name 'omgea'") as caught:
        number("2*omgea", {"omega": 1.0, "m1": 1.0})
    assert caught.value.guess == "; did you mean 'omega'?"


NO_ARITHMETIC = [
    "k1.real",
    "(1).__class__",
    "().__class__.__bases__[0]",
    "k1[0]",
    "print(1)",
    "open('x')",
    "__import__('os')",
    "__import__('os').system('true')",
    "eval('1')",
    "sin.__call__(1)",
    "sin(1)(2)",
    "math.sin(1)",
    "log(8, base=2)",
    "max(*[1, 2])",
    "max(**{})",
    "lambda: 1",
    "(lambda: 1)()",
    "[x for x in (1, 2)]",
    "min(x for x in (1, 2))",
    "{x: 1 for x in (1, 2)}",
    "'a'",
    "b'a'",
    "f'{k1}'",
    "'a' * 9",
    "[1]",
    "(1, 2)",
    "{1}",
    "{}",
    "...",
    "True",
    "None",
    "1j",
    "1 if k1 else 2",
    "k1 and 2",
    "not k1",
    "~1",
    "1 < 2",
    "7 // 2",
    "7 % 2",
    "1 << 2",
    "1 | 2",
    "1 @ 2",
    "(x := 1)",
    "x = 1",
    "1; 2",
    "import os",
    "await k1",
    "(yield)",
    "1\n+ 1",
    "k1\0",
    "`1`",
    "$",
]


@pytest.mark.parametrize("text", NO_ARITHMETIC)
def test_what_is_not_arithmetic_is_refused(text: str) -> None:
    with pytest.raises(ExpressionError):
        number(text, PARAMETERS)


def test_an_unknown_function_is_named_with_the_known_ones() -> None:
    with pytest.raises(ExpressionError, match=r"unknown function 'sine'.*\bsin\b"):
        number("sine(1)", {})


NOT_FINITE = [
    "9**9**9",
    "9**9**9**9",
    "10**400",
    "1" * 400,
    "1e400",
    "-1e400",
    "1e308*10",
    "1e308 + 1e308",
    "1/5e-324",
    "1e308/1e-308",
    "1/0",
    "1/(k1 - 2)",
    "0**-1",
    "0/0",
    "(-1)**0.5",
    "sqrt(-1)",
    "log(0)",
    "log(-1)",
    "exp(1000)",
    "asin(2)",
    "1e400 - 1e400",
    "min()",
    "min(1)",
    "sin()",
    "sin(1, 2)",
]


@pytest.mark.parametrize("text", NOT_FINITE)
def test_what_has_no_finite_real_value_is_refused(text: str) -> None:
    with pytest.raises(ExpressionError):
        number(text, PARAMETERS)


def test_a_refusal_quotes_the_number_as_it_was_written() -> None:
    with pytest.raises(ExpressionError, match="1e400"):
        number("1e400", {})


def test_a_very_long_expression_is_refused_by_its_length() -> None:
    with pytest.raises(ExpressionError, match=r"100001 characters, at most \d+"):
        number("1" + "+1" * 50_000, {})


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("-" * 498 + "1", 1.0),
        ("+" * 499 + "1", 1.0),
        ("1" + "+1" * 249, 250.0),
        ("1" + "**1" * 166, 1.0),
        ("(" * 249 + "1" + ")" * 249, 1.0),
        ("abs(" * 99 + "1" + ")" * 99, 1.0),
        ("abs(-" * 83 + "1" + ")" * 83, 1.0),
        ("[" * 199 + "1" + "]" * 199, None),
        ("k1" + ".a" * 248, None),
        ("-" * 480 + "1//2", None),
        ("1" + "+1" * 240 + "//2", None),
        ("lambda:" * 71 + "1", None),
        ("not " * 124 + "1", None),
        ("1" + "<1" * 249, None),
        ("(" * 200, None),
    ],
    ids=lambda value: value[:8] if isinstance(value, str) else "",
)
def test_a_deeply_nested_expression_is_read_or_refused(text: str, value: float | None) -> None:
    if value is None:
        with pytest.raises(ExpressionError):
            number(text, PARAMETERS)
    else:
        with contextlib.suppress(ExpressionError):
            assert number(text, PARAMETERS) == value


@pytest.mark.parametrize("text", [r"'\d'", "1if 1else 2", "1or 2", "0x1for x in y", "1is 1"])
def test_a_refused_expression_leaves_no_warning_of_the_python_compiler(text: str) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with pytest.raises(ExpressionError):
            number(text, {})
    assert [str(w.message) for w in caught] == []


def test_a_broken_parameter_is_told_apart_from_an_unknown_one() -> None:
    with pytest.raises(BrokenParameter):
        number("2*k", {"k": None})
    with pytest.raises(ExpressionError) as caught:
        number("2*q", {"k": None})
    assert not isinstance(caught.value, BrokenParameter)


def test_a_state_is_no_number() -> None:
    with pytest.raises(ExpressionError, match="unknown name 'z'"):
        number("2*z", PARAMETERS)


@pytest.mark.parametrize(
    ("text", "row"),
    [
        ("z", [1, 0, 0]),
        ("3", [0, 0, 3]),
        ("-(z - w)/k1 + c", [-0.5, 0.5, -0.5]),
        ("(z + 1)*4 - 2*(w - z)", [6, -2, 4]),
        ("z - z", [0, 0, 0]),
        ("sqrt(4)*z", [2, 0, 0]),
        ("k1**2*w", [0, 4, 0]),
        ("-z*-w**0", None),
        ("z*w", None),
        ("z*z", None),
        ("z/z", None),
        ("1/z", None),
        ("z**2", None),
        ("2**z", None),
        ("sin(z)", None),
        ("abs(z - w)", None),
        ("max(z, 0)", None),
        ("z // 2", None),
        ("z > w", None),
    ],
)
def test_a_linear_form_is_read_and_nothing_else(text: str, row: list[float] | None) -> None:
    if row is None:
        with pytest.raises(ExpressionError):
            linear_form(text, ["z", "w"], PARAMETERS)
    else:
        form = linear_form(text, ["z", "w"], PARAMETERS)
        assert [*form.row.tolist(), form.constant] == row


@pytest.mark.parametrize("text", ["1e308*(10*z)", "1e308*z + 1e308*z", "z/5e-324", "1e308*(10*z + 1)"])
def test_a_linear_form_with_a_coefficient_that_overflows_is_refused(text: str) -> None:
    with pytest.raises(ExpressionError, match="not finite"):
        linear_form(text, ["z", "w"], {})


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("z - w >= c", [[1, -1, 0.5]]),
        ("z - w > c", [[1, -1, 0.5]]),
        ("z <= 3", [[-1, 0, 3]]),
        ("3 < z", [[1, 0, -3]]),
        ("-1 <= z < k1", [[1, 0, 1], [-1, 0, 2]]),
        ("k1 >= z > w >= c", [[-1, 0, 2], [1, -1, 0], [0, 1, 0.5]]),
        ("0 <= z > 1", [[1, 0, 0], [1, 0, -1]]),
    ],
)
def test_an_inequality_is_the_linear_forms_that_are_not_negative(text: str, expected: list[list[float]]) -> None:
    assert rows(text) == expected


NO_INEQUALITY = [
    "z",
    "z == 1",
    "z != 1",
    "z is 1",
    "z in w",
    "not z < 1",
    "z < 1 and w < 2",
    "(z < 1) < 2",
    "(z < 1) + 1 < 2",
    "1 < 2",
    "0 < 1 < z",
    "z - z < 1",
    "z*w < 1",
    "z <",
    "z => 1",
    "z < 1e400",
    "",
    "q < 1",
]


@pytest.mark.parametrize("text", NO_INEQUALITY)
def test_what_is_no_inequality_in_the_states_is_refused(text: str) -> None:
    with pytest.raises(ExpressionError):
        rows(text)


@pytest.mark.parametrize("text", ["1e308*z >= -1e308*z", "z + 1e308 >= -1e308"])
def test_an_inequality_whose_difference_overflows_is_refused(text: str) -> None:
    with pytest.raises(ExpressionError, match="not finite"):
        rows(text)


_literals = st.floats(0.25, 4.0).map(repr) | st.sampled_from(["k", "0.0", "1e30", "1e-30", "0.1000000000000000055511"])


def _grow(children: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    return st.one_of(
        st.tuples(children, st.sampled_from([" + ", " - ", " * ", " / "]), children).map("".join),
        st.tuples(children, st.integers(-3, 4)).map(lambda pair: f"({pair[0]}) ** {pair[1]}"),
        children.map(lambda text: f"({text})"),
        children.map(lambda text: f"-{text}"),
        children.map(lambda text: f"abs({text})"),
        st.tuples(st.sampled_from(["min", "max"]), children, children).map(
            lambda triple: f"{triple[0]}({triple[1]}, {triple[2]})"
        ),
    )


@given(st.recursive(_literals, _grow, max_leaves=8))
def test_arithmetic_with_decimals_is_that_of_fractions(text: str) -> None:
    as_fractions = re.sub(r"\d+\.\d*(?:e-?\d+)?|\d+e-?\d+", r"Fraction('\g<0>')", text)
    try:
        expected = eval(as_fractions, {"__builtins__": {}}, _FRACTIONS)
    except ZeroDivisionError:
        with pytest.raises(ExpressionError, match="divides by zero"):
            real(text, {"k": 1.75})
    else:
        if any(abs(value) >= 2**1024 for value in _values(as_fractions)):
            with pytest.raises(ExpressionError, match="is not finite"):
                real(text, {"k": 1.75})
        else:
            assert real(text, {"k": 1.75}) == Real(expected)


def _values(text: str) -> Iterator[Fraction]:
    """Yield what all parts of an expression are, itself too."""
    for node in ast.walk(ast.parse(text, mode="eval")):
        if isinstance(node, ast.BinOp | ast.UnaryOp):
            yield eval(ast.unparse(node), {"__builtins__": {}}, _FRACTIONS)


_PLAIN = {"abs": abs, "min": min, "max": max}
_FRACTIONS = {"Fraction": Fraction, "k": Fraction(7, 4)} | _PLAIN


@pytest.mark.parametrize("name", ["sin", "cos", "tan", "atan", "sinh", "cosh", "tanh", "exp", "log", "sqrt"])
@given(x=st.integers(1, 1000).map(lambda k: k / 64))
def test_a_function_is_the_nearest_double_in_a_ball_that_holds_the_true_value(name: str, x: float) -> None:
    value, expected = real(f"{name}({x!r})", {}), getattr(math, name)(x)
    assert abs(float(value) - expected) <= 2 * math.ulp(expected)
    with digits(100):
        exact = Fraction(repr(x))
        true = getattr(arb(fmpq(exact.numerator, exact.denominator)), name)()
        centre, radius = (arb(fmpq(v.numerator, v.denominator)) for v in (value.centre, value.radius))
        assert abs(true - centre) <= radius
    assert value.radius <= Fraction(math.ulp(expected))


@given(st.integers(1, 40), st.integers(1, 40))
def test_what_cancels_on_paper_cancels_exactly(a: int, b: int) -> None:
    assert real(f"{a}*{b}e-1 - {b}*{a}e-1", {}) == Real(Fraction(0))
    assert real(f"sqrt({a})*{b}e-1 - {b}*sqrt({a})*0.1", {}).centre == 0


def test_a_number_that_grows_too_long_becomes_a_ball() -> None:
    long = real("(1.23456789012345678901234567890 ** 40) ** 40 / 1e140", {})
    assert not long.exact
    assert long.radius < abs(long.centre) / 2**48


_coefficients = st.integers(-9, 9).map(lambda k: f"({k})")
_linear = st.recursive(
    st.sampled_from(["z1", "z2", "z3"]) | _coefficients,
    lambda forms: st.one_of(
        st.tuples(forms, st.sampled_from([" + ", " - "]), forms).map("".join),
        st.tuples(_coefficients, forms).map(lambda pair: f"{pair[0]} * ({pair[1]})"),
        st.tuples(forms, st.sampled_from(["2", "-4"])).map(lambda pair: f"({pair[0]}) / {pair[1]}"),
        forms.map(lambda text: f"-({text})"),
    ),
    max_leaves=8,
)
_points = st.lists(st.integers(-9, 9), min_size=3, max_size=3)


@given(_linear, _points)
def test_a_linear_form_has_the_value_that_python_computes_at_every_point(text: str, point: list[int]) -> None:
    form = linear_form(text, ["z1", "z2", "z3"], {})
    expected = eval(text, {"__builtins__": {}}, {f"z{k + 1}": float(v) for k, v in enumerate(point)})
    assert float(form.row @ np.array(point, dtype=float)) + form.constant == expected


@given(_linear, _linear, st.sampled_from(["<", "<=", ">", ">="]), _points)
def test_an_inequality_holds_exactly_where_its_form_is_not_negative(
    left: str, right: str, comparison: str, point: list[int]
) -> None:
    names = ["z1", "z2", "z3"]
    assume(linear_form(f"({left}) - ({right})", names, {}).row.any())  # else it is refused
    (form,) = inequalities(f"{left} {comparison} {right}", names, {})
    states = {f"z{k + 1}": float(v) for k, v in enumerate(point)}
    held = eval(f"{left} {comparison[0]}= {right}", {"__builtins__": {}}, states)
    assert (float(form.row @ np.array(point, dtype=float)) + form.constant >= 0) == held


@pytest.mark.parametrize("text", ["1 < 2", "z1 - z1 >= 0", "0*z2 > -1"])
def test_an_inequality_without_a_state_is_refused(text: str) -> None:
    with pytest.raises(ExpressionError, match="does not depend on any state"):
        inequalities(text, ["z1", "z2", "z3"], {})


@pytest.mark.parametrize("text", ["8.6e-05", "1e+07", "2.E-010", "z - 3e-05"])
def test_an_exponent_may_begin_with_0(text: str) -> None:
    form = linear_form(text, ["z"], {})
    assert float(form.offset) == float(text.replace("z", "").replace(" ", ""))


@given(st.floats(allow_nan=False, allow_infinity=False) | st.integers(-(10**17), 10**17))
def test_a_number_alone_is_the_same_as_in_an_expression(value: float) -> None:
    assert real(str(value), {}) == real(f"({value})", {})
