"""Arithmetic in a spec: numbers, linear forms, inequalities, signals; read with `ast`, never run as code."""

import ast
import difflib
import math
import operator
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pwatrack.arrays import Array
from pwatrack.model.signal import ExponentialPolynomial, NotRepresentable

CONSTANTS = {"pi": math.pi}
FUNCTIONS: dict[str, Callable[..., float]] = {
    name: getattr(math, name)
    for name in ("sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "exp", "log", "sqrt")
} | {"abs": abs, "min": min, "max": max}
TIME = "t"
RESERVED = frozenset(CONSTANTS) | frozenset(FUNCTIONS) | {TIME}
_LONGEST = 500
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


Parameters = Mapping[str, float | None]  # None: in error


@dataclass(frozen=True)
class LinearForm:
    """The form row · x + constant; sums and multiples are forms again."""

    row: Array
    constant: float

    def __add__(self, other: "LinearForm | float") -> "LinearForm":
        """Return the sum."""
        if isinstance(other, LinearForm):
            return LinearForm(self.row + other.row, self.constant + other.constant)
        return LinearForm(self.row, self.constant + other)

    def __mul__(self, other: "LinearForm | float") -> "LinearForm":
        """Return a multiple."""
        if isinstance(other, LinearForm):
            raise NotRepresentable("is not linear in the states")
        return LinearForm(self.row * other, self.constant * other)

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self) -> "LinearForm":
        """Return the negative."""
        return self * -1.0

    def __sub__(self, other: "LinearForm | float") -> "LinearForm":
        """Return the difference."""
        return self + -other

    def __rsub__(self, other: float) -> "LinearForm":
        """Return the difference."""
        return -self + other

    def __truediv__(self, other: "LinearForm | float") -> "LinearForm":
        """Return a multiple."""
        if isinstance(other, LinearForm):
            raise NotRepresentable("is not linear in the states")
        if other == 0:
            raise ZeroDivisionError("division by zero")
        return LinearForm(self.row / other, self.constant / other)

    def __rtruediv__(self, other: float) -> "LinearForm":
        """Refuse."""
        raise NotRepresentable("is not linear in the states")

    __pow__ = __rpow__ = __rtruediv__


def number(text: str, parameters: Parameters) -> float:
    """Return the value of an expression in the parameters.

    Raises:
        ExpressionError: If the text is not such an expression or its value is not finite.

    Example:
        >>> number("-(k1 + 1e-3)/2**2", {"k1": 3.999})
        -1.0
    """
    return float(_evaluate(text, {**CONSTANTS, **parameters}))


def linear_form(text: str, states: Sequence[str], parameters: Parameters) -> LinearForm:
    """Return an expression as row · x + constant.

    Raises:
        ExpressionError: If the text is not linear in the states.

    Example:
        >>> linear_form("2*(z2 - z1) + c", ["z1", "z2"], {"c": 5.0})
        LinearForm(row=array([-2.,  2.]), constant=5.0)
    """
    value = _evaluate(text, {**CONSTANTS, **parameters, **_units(states)})
    return value if isinstance(value, LinearForm) else LinearForm(np.zeros(len(states)), value)


def inequalities(text: str, states: Sequence[str], parameters: Parameters) -> list[LinearForm]:
    """Return the linear forms that a comparison, or a chain of them, says are ≥ 0.

    Raises:
        ExpressionError: If the text is not a comparison of linear forms by <, <=, > or >=.

    Example:
        >>> [f.row.tolist() + [f.constant] for f in inequalities("-1 < z <= 2", ["z"], {})]
        [[1.0, 1.0], [-1.0, 2.0]]
    """
    tree = _parse(text)
    if not isinstance(tree, ast.Compare):
        raise ExpressionError(f"'{text}' is not an inequality such as 'z2 - z1 >= 0.05'")
    reader = _Reader(text, {**CONSTANTS, **parameters, **_units(states)})
    sides = [reader.read(node) for node in (tree.left, *tree.comparators)]
    forms = []
    for left, right, comparison in zip(sides[:-1], sides[1:], tree.ops, strict=True):
        if not isinstance(comparison, ast.Gt | ast.GtE | ast.Lt | ast.LtE):
            raise ExpressionError(f"'{text}': only <, <=, > and >= bound a cell")
        larger, smaller = (left, right) if isinstance(comparison, ast.Gt | ast.GtE) else (right, left)
        form = reader.combine(tree, operator.sub, larger, smaller)
        if not isinstance(form, LinearForm) or not form.row.any():
            raise ExpressionError(f"'{text}' does not depend on any state")
        forms.append(form)
    return forms


def formula(text: str, parameters: Parameters) -> ExponentialPolynomial:
    """Return an expression in the parameters and the time t.

    Sums and products of polynomials, sines, cosines and exponentials with
    arguments linear in t have exact derivatives of every order; nothing else is read.

    Raises:
        ExpressionError: If the text is not such an expression.

    Example:
        >>> round(formula("a*sin(2*t)**2", {"a": 3.0})(0.25), 6)
        0.689547
    """
    value = _evaluate(text, {**CONSTANTS, **parameters, TIME: ExponentialPolynomial.time()})
    return value if isinstance(value, ExponentialPolynomial) else ExponentialPolynomial.constant(value)


def _units(states: Sequence[str]) -> dict[str, LinearForm]:
    return {name: LinearForm(row, 0.0) for name, row in zip(states, np.eye(len(states)), strict=True)}


def _evaluate(text: str, names: Mapping[str, Any]) -> Any:
    return _Reader(text, names).read(_parse(text))


def _parse(text: str) -> ast.expr:
    if len(text) > _LONGEST:
        raise ExpressionError(f"expression of {len(text)} characters, at most {_LONGEST} are read")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the compiler's remarks on odd literals, which are refused below
            return ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise ExpressionError(f"'{text}' is not a number or an expression") from None


_ALLOWED = {
    "t": "allowed are sums and products of powers of t and of sin, cos, exp of a*t + b",
    "the states": "a nonlinearity is written under system.nonlinearities",
}


class _Reader:
    """Turns an expression tree into a float, or into what its names make of it."""

    def __init__(self, text: str, names: Mapping[str, Any]) -> None:
        self.text = text.strip()
        self.names = names

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
        except NotRepresentable as error:
            raise ExpressionError(f"{self._quote(node)} {error}") from None
        except ZeroDivisionError:
            raise ExpressionError(f"{self._quote(node)} divides by zero") from None
        except OverflowError:
            raise ExpressionError(f"{self._quote(node)} is not finite") from None
        except TypeError:
            raise ExpressionError(f"{self._quote(node)} has arguments that do not fit") from None
        except ValueError as error:
            raise ExpressionError(f"{self._quote(node)}: {error}") from None
        if isinstance(value, complex):
            raise ExpressionError(f"{self._quote(node)} is not real")
        value = float(value) if isinstance(value, int | float) else value
        parts = (
            [value]
            if isinstance(value, float)
            else [value.constant, *value.row]
            if isinstance(value, LinearForm)
            else []
        )
        if not np.isfinite(parts).all():
            raise ExpressionError(f"{self._quote(node)} is not finite")
        return value

    def _read(self, node: ast.AST) -> Any:
        if isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool):
            return self.combine(node, float, node.value)
        if isinstance(node, ast.Name):
            return self._named(node.id)
        if isinstance(node, ast.UnaryOp) and type(node.op) in _OPERATORS:
            return self.combine(node, _OPERATORS[type(node.op)], self._read(node.operand))
        if isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS:
            return self.combine(node, _OPERATORS[type(node.op)], self._read(node.left), self._read(node.right))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and not node.keywords:
            return self._called(node, node.func.id, [self._read(argument) for argument in node.args])
        raise ExpressionError(f"{self._quote(node)} is not allowed in an expression")

    def _named(self, name: str) -> Any:
        if name not in self.names:
            close = difflib.get_close_matches(name, self.names, n=1)
            guess = f"; did you mean '{close[0]}'?" if close else ""
            raise ExpressionError(f"unknown name '{name}'{guess}")
        if self.names[name] is None:
            raise BrokenParameter(f"parameter '{name}' is in error")
        return self.names[name]

    def _called(self, node: ast.AST, name: str, arguments: list[Any]) -> Any:
        if name not in FUNCTIONS:
            raise ExpressionError(f"unknown function '{name}'; known are {', '.join(sorted(FUNCTIONS))}")
        if all(isinstance(argument, float) for argument in arguments):
            return self.combine(node, FUNCTIONS[name], *arguments)
        method = getattr(arguments[0], name, None) if len(arguments) == 1 else None
        if method is None:
            what = "the states" if any(isinstance(a, LinearForm) for a in arguments) else "t"
            raise ExpressionError(
                f"{self._quote(node)}: {name} of a function of {what} is not supported; {_ALLOWED[what]}"
            )
        return self.combine(node, method)

    def _quote(self, node: ast.AST) -> str:
        return f"'{ast.get_source_segment(self.text, node) or self.text}'"
