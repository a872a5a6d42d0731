"""Arithmetic in a spec: numbers, linear forms, inequalities, signals; read with `ast`, never run as code.

Every function that takes a text raises an `ExpressionError` where it is not what is asked for.
"""

import ast
import math
import operator
import re
import warnings
from collections import ChainMap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np

from pwatrack.model.linear_form import LinearForm
from pwatrack.model.signal import ExponentialPolynomial, NotRepresentable
from pwatrack.real import Real, enclosed
from pwatrack.spec.wording import guess, misread, shown

_OF_ONE = ("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "exp", "sqrt")
FUNCTIONS: dict[str, Callable[..., Any]] = {name: getattr(math, name) for name in (*_OF_ONE, "atan2", "log")}
FUNCTIONS |= {"abs": abs, "min": min, "max": max}
CONSTANTS = {"pi": math.pi}
TIME = "t"
RESERVED = frozenset(CONSTANTS) | frozenset(FUNCTIONS) | {TIME}
_LONGEST = 500  # characters of an expression: nobody writes longer ones by hand
_PLAIN = re.compile(r"-?(0|[1-9][0-9]{0,16})(\.[0-9]{1,20})?(e[-+]?[0-9]{1,2})?")  # all doubles of common size
_OPERATORS: dict[type[ast.AST], Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.USub: operator.neg,
    ast.UAdd: lambda value: value,
}


class ExpressionError(ValueError):
    """The text is not an expression that is allowed here."""


class BrokenParameter(ExpressionError):
    """The expression uses a parameter that is in error itself, which is said elsewhere."""


class UnknownName(ExpressionError):
    """The expression has a name that is not known; `guess` finds one that may be meant, which takes a while."""

    def __init__(self, name: str, known: Mapping[str, Any]) -> None:
        super().__init__(f"unknown name '{name}'")
        self.name = name
        self._known = known

    @property
    def guess(self) -> str:
        """`"; did you mean 'x'?"`, or nothing."""
        return guess(self.name, self._known)


Parameters = Mapping[str, Real | float | None]  # None: in error


@dataclass(frozen=True)
class Expression:
    """An expression that is parsed, to be evaluated as often as is asked."""

    text: str
    tree: ast.expr

    @cached_property
    def names(self) -> frozenset[str]:
        """All names in it."""
        return frozenset(node.id for node in ast.walk(self.tree) if isinstance(node, ast.Name))


def is_number(text: str) -> bool:
    """Whether a text is a number in digits, as most entries of most files are: it need not be parsed."""
    return _PLAIN.fullmatch(text) is not None


def real(text: str | Expression, parameters: Parameters) -> Real:
    """Return the value of an expression in the parameters, exactly where it is rational."""
    if isinstance(text, str) and is_number(text):
        return Real(Fraction(text))
    value: Real = _evaluate(text, _names(parameters))
    return value


def linear_form(text: str | Expression, states: Sequence[str], parameters: Parameters) -> LinearForm:
    """Return an expression as row · x + constant."""
    value = _evaluate(text, _names(_units(states), parameters))
    return value if isinstance(value, LinearForm) else LinearForm((_ZERO,) * len(states), value)


def inequalities(text: str | Expression, states: Sequence[str], parameters: Parameters) -> list[LinearForm]:
    """Return the linear forms that a comparison, or a chain of them, says are ≥ 0."""
    expression = parsed(text)
    text, tree = expression.text, expression.tree
    if isinstance(tree, ast.BoolOp):
        raise ExpressionError(f"{shown(text)}: each inequality is an entry of its own in the list; all of them hold")
    if not isinstance(tree, ast.Compare):
        raise ExpressionError(f"'{text}' is not an inequality such as 'z2 - z1 >= 0.05'")
    reader = _Reader(text, _names(_units(states), parameters))
    sides = [reader.read(node) for node in (tree.left, *tree.comparators)]
    forms = []
    for left, right, comparison in zip(sides[:-1], sides[1:], tree.ops, strict=True):
        if not isinstance(comparison, ast.Gt | ast.GtE | ast.Lt | ast.LtE):
            raise ExpressionError(f"'{text}': only <, <=, > and >= bound a cell")
        larger, smaller = (left, right) if isinstance(comparison, ast.Gt | ast.GtE) else (right, left)
        form = reader.combine(tree, operator.sub, larger, smaller)
        if not isinstance(form, LinearForm) or all(c.centre == 0 for c in form.coefficients):
            raise ExpressionError(f"'{text}' does not depend on any state")
        forms.append(form)
    return forms


def formula(text: str | Expression, parameters: Parameters) -> ExponentialPolynomial:
    """Return an expression in the parameters and the time t.

    Sums and products of polynomials, sines, cosines and exponentials with
    arguments linear in t have exact derivatives of every order; nothing else is read.
    """
    value = _evaluate(text, _names({TIME: ExponentialPolynomial.time()}, parameters), exact=False)
    return value if isinstance(value, ExponentialPolynomial) else ExponentialPolynomial.constant(value)


_ZERO, _ONE = Real.of(0), Real.of(1)


def _names(*kinds: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return all names that an expression may use, without a copy: there may be very many parameters."""
    return ChainMap(*(dict(kind) if not isinstance(kind, dict) else kind for kind in kinds), CONSTANTS)


def _units(states: Sequence[str]) -> dict[str, LinearForm]:
    rows = [tuple(_ONE if k == j else _ZERO for k in range(len(states))) for j in range(len(states))]
    return {name: LinearForm(row, _ZERO) for name, row in zip(states, rows, strict=True)}


def _evaluate(text: str | Expression, names: Mapping[str, Any], *, exact: bool = True) -> Any:
    expression = parsed(text)
    return _Reader(expression.text, names, exact=exact).read(expression.tree)


def _log(x: Real, *base: Real) -> Real:
    return x.applied("log") / base[0].applied("log") if base else x.applied("log")


def _atan2(y: Real, x: Real) -> Real:
    import flint

    return enclosed(flint.arb.atan2, y, x)


_EXACT_FUNCTIONS: dict[str, Callable[..., Real]] = {name: lambda x, name=name: x.applied(name) for name in _OF_ONE}
_EXACT_FUNCTIONS |= {"log": _log, "atan2": _atan2, "abs": abs, "min": min, "max": max}


def parsed(text: str | Expression) -> Expression:
    """Parse an expression, or a comparison of expressions; one that is parsed stays as it is."""
    if isinstance(text, Expression):
        return text
    if len(text) > _LONGEST:
        raise ExpressionError(f"expression of {len(text)} characters, at most {_LONGEST} are read")
    if not text.strip():
        raise ExpressionError("nothing is given: a number or an expression is expected")
    if reason := misread(text):
        raise ExpressionError(f"{shown(text)} is not a number or an expression: {reason}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the compiler's remarks on odd literals, which are refused below
            return Expression(text, ast.parse(text.strip(), mode="eval").body)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise ExpressionError(f"{shown(text)} is not a number or an expression") from None


_FAILED = {
    ZeroDivisionError: " divides by zero",
    OverflowError: " is not finite",
    TypeError: " has arguments that do not fit",
}
_ALLOWED = {
    "t": "allowed are sums and products of powers of t and of sin, cos, exp of a*t + b",
    "the states": "a nonlinearity is written under system.nonlinearities",
}


class _Reader:
    """Turns an expression tree into a `Real`, or into what its names make of it; into doubles if not `exact`."""

    def __init__(self, text: str, names: Mapping[str, Any], *, exact: bool = True) -> None:
        self.text = text.strip()
        self.names = names
        self.exact = exact

    def read(self, node: ast.AST) -> Any:
        try:
            return self._read(node)
        except RecursionError:
            raise ExpressionError(f"'{self.text[:40]}…' is nested too deeply") from None

    def combine(self, node: ast.AST, function: Callable[..., Any], *arguments: Any) -> Any:
        """Apply an operation; every way it can fail is an ExpressionError that quotes the text."""
        try:
            with np.errstate(all="ignore"):
                value = function(*arguments)
            if isinstance(value, complex):
                raise NotRepresentable("is not real")
            value = value.shortened() if isinstance(value, Real) else value
            if isinstance(value, Real | float | int):
                parts = [float(value)]
            else:
                parts = [value.constant, *value.row] if isinstance(value, LinearForm) else []
            if not np.isfinite(parts).all():
                raise OverflowError
        except (ArithmeticError, TypeError, ValueError) as error:
            said = _FAILED.get(type(error), f" {error}" if isinstance(error, NotRepresentable) else f": {error}")
            raise ExpressionError(self._quote(node) + said) from None
        return float(value) if isinstance(value, int | float) else value

    def _read(self, node: ast.AST) -> Any:
        if isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool):
            return self.combine(node, self._literal, node)
        if isinstance(node, ast.Name):
            return self._named(node.id)
        if isinstance(node, ast.UnaryOp) and type(node.op) in _OPERATORS:
            return self.combine(node, _OPERATORS[type(node.op)], self._read(node.operand))
        if isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS:
            return self.combine(node, _OPERATORS[type(node.op)], self._read(node.left), self._read(node.right))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and not node.keywords:
            return self._called(node, node.func.id, [self._read(argument) for argument in node.args])
        raise ExpressionError(f"{self._quote(node)} is not allowed in an expression")

    def _literal(self, node: ast.Constant) -> Real | float:
        """Return a number with all the digits that it is written with."""
        value = float(node.value)  # type: ignore[arg-type]
        if not self.exact or math.isinf(value):
            return value
        try:
            written = ast.get_source_segment(self.text, node) or ""
            return Real(Fraction(written)) if abs(value) > 1e-300 else Real.of(value)
        except ValueError:
            return Real.of(node.value)  # type: ignore[arg-type]

    def _named(self, name: str) -> Any:
        if self.exact and name == "pi":
            import flint

            return enclosed(flint.arb.pi)
        if name not in self.names:
            raise UnknownName(name, self.names)
        if self.names[name] is None:
            raise BrokenParameter(f"parameter '{name}' is in error")
        value = self.names[name]
        if isinstance(value, Real | float):
            return Real.of(value) if self.exact else float(value)
        return value

    def _called(self, node: ast.AST, name: str, arguments: list[Any]) -> Any:
        if name in self.names:
            raise ExpressionError(f"'{name}' is no function: write {name}*(…) for a product")
        if name not in FUNCTIONS:
            raise ExpressionError(
                f"unknown function '{name}'; known are {', '.join(sorted(FUNCTIONS))}{guess(name, FUNCTIONS)}"
            )
        if all(isinstance(argument, Real | float) for argument in arguments):
            return self.combine(node, (_EXACT_FUNCTIONS if self.exact else FUNCTIONS)[name], *arguments)
        method = getattr(arguments[0], name, None) if len(arguments) == 1 else None
        if method is None:
            what = "the states" if any(isinstance(a, LinearForm) for a in arguments) else "t"
            raise ExpressionError(
                f"{self._quote(node)}: {name} of a function of {what} is not supported; {_ALLOWED[what]}"
            )
        return self.combine(node, method)

    def _quote(self, node: ast.AST) -> str:
        return f"'{ast.get_source_segment(self.text, node) or self.text}'"
