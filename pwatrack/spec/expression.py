"""Arithmetic in a spec: numbers, linear forms and inequalities, read with `ast`, never evaluated as code."""

import ast
import difflib
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pwatrack.arrays import Array

CONSTANTS = {"pi": math.pi}
FUNCTIONS: dict[str, Callable[..., float]] = {
    name: getattr(math, name)
    for name in (
        "sin",
        "cos",
        "tan",
        "asin",
        "acos",
        "atan",
        "atan2",
        "sinh",
        "cosh",
        "tanh",
        "exp",
        "log",
        "sqrt",
    )
} | {"abs": abs, "min": min, "max": max}
RESERVED = frozenset(CONSTANTS) | frozenset(FUNCTIONS)
_LONGEST = 500


class ExpressionError(ValueError):
    """The text is not an expression that is allowed here."""


class BrokenParameter(ExpressionError):
    """The expression uses a parameter that is in error itself, which is said elsewhere."""


Parameters = Mapping[str, float | None]  # None: in error


@dataclass(frozen=True)
class LinearForm:
    """row · x + constant."""

    row: Array
    constant: float

    def combine(self, other: "LinearForm", sign: float) -> "LinearForm":
        """Return self + sign · other."""
        return LinearForm(self.row + sign * other.row, self.constant + sign * other.constant)

    def scale(self, factor: float) -> "LinearForm":
        """Return factor · self."""
        return LinearForm(factor * self.row, factor * self.constant)


def number(text: str, parameters: Parameters) -> float:
    """Return the value of an expression in the parameters.

    Raises:
        ExpressionError: If the text is not such an expression or its value is not finite.

    Example:
        >>> number("-(k1 + 1e-3)/2**2", {"k1": 3.999})
        -1.0
    """
    value = _Reader(parameters, ()).value(_parse(text).body)
    if value.row.any():
        raise ExpressionError("a number is expected")
    return value.constant


def linear_form(text: str, states: Sequence[str], parameters: Parameters) -> LinearForm:
    """Return an expression as row · x + constant.

    Raises:
        ExpressionError: If the text is not linear in the states.

    Example:
        >>> linear_form("2*(z2 - z1) + c", ["z1", "z2"], {"c": 5.0})
        LinearForm(row=array([-2.,  2.]), constant=5.0)
    """
    return _Reader(parameters, states).value(_parse(text).body)


def inequalities(text: str, states: Sequence[str], parameters: Parameters) -> list[LinearForm]:
    """Return the linear forms that a comparison, or a chain of them, says are ≥ 0.

    Raises:
        ExpressionError: If the text is not a comparison of linear forms by <, <=, > or >=.

    Example:
        >>> [f.row.tolist() + [f.constant] for f in inequalities("-1 < z <= 2", ["z"], {})]
        [[1.0, 1.0], [-1.0, 2.0]]
    """
    tree = _parse(text).body
    if not isinstance(tree, ast.Compare):
        raise ExpressionError(f"'{text}' is not an inequality such as 'z2 - z1 >= 0.05'")
    reader = _Reader(parameters, states)
    sides = [reader.value(node) for node in (tree.left, *tree.comparators)]
    forms = []
    for low, high, comparison in zip(sides[:-1], sides[1:], tree.ops, strict=True):
        if isinstance(comparison, ast.Gt | ast.GtE):
            form = low.combine(high, -1.0)
        elif isinstance(comparison, ast.Lt | ast.LtE):
            form = high.combine(low, -1.0)
        else:
            raise ExpressionError(f"'{text}': only <, <=, > and >= bound a cell")
        if not form.row.any():
            raise ExpressionError(f"'{text}' does not depend on any state")
        forms.append(form)
    return forms


def _parse(text: str) -> ast.Expression:
    if len(text) > _LONGEST:
        raise ExpressionError(f"expression of {len(text)} characters, at most {_LONGEST} are read")
    try:
        return ast.parse(text.strip(), mode="eval")
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise ExpressionError(f"'{text}' is not a number or an expression") from None


_BINARY = {ast.Add: 1.0, ast.Sub: -1.0}


class _Reader:
    def __init__(self, parameters: Parameters, states: Sequence[str]) -> None:
        self.names = {**CONSTANTS, **parameters}
        self.states = {name: k for k, name in enumerate(states)}

    def value(self, node: ast.AST) -> LinearForm:
        result = self._value(node)
        if math.isinf(result.constant) or np.isinf(result.row).any():
            raise ExpressionError(f"'{ast.unparse(node)}' is not finite")
        return result

    def _value(self, node: ast.AST) -> LinearForm:
        if isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool):
            return self._constant(self._guarded(node, float, node.value))
        if isinstance(node, ast.Name):
            return self._name(node.id)
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.UAdd | ast.USub):
            return self.value(node.operand).scale(-1.0 if isinstance(node.op, ast.USub) else 1.0)
        if isinstance(node, ast.BinOp):
            return self._binary(node)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and not node.keywords:
            function = FUNCTIONS.get(node.func.id)
            if function is None:
                raise ExpressionError(f"unknown function '{node.func.id}'; known are {', '.join(sorted(FUNCTIONS))}")
            arguments = [self._plain(argument) for argument in node.args]
            return self._constant(self._guarded(node, function, *arguments))
        raise ExpressionError(f"'{ast.unparse(node)}' is not allowed in an expression")

    def _binary(self, node: ast.BinOp) -> LinearForm:
        if type(node.op) in _BINARY:
            return self.value(node.left).combine(self.value(node.right), _BINARY[type(node.op)])
        left, right = self.value(node.left), self.value(node.right)
        if isinstance(node.op, ast.Mult) and not (left.row.any() and right.row.any()):
            return left.scale(right.constant) if left.row.any() else right.scale(left.constant)
        if isinstance(node.op, ast.Div) and not right.row.any():
            if right.constant == 0:
                raise ExpressionError(f"'{ast.unparse(node)}' divides by zero")
            return LinearForm(left.row / right.constant, left.constant / right.constant)
        if isinstance(node.op, ast.Pow) and not (left.row.any() or right.row.any()):
            return self._constant(self._guarded(node, operator.pow, left.constant, right.constant))
        if left.row.any() or right.row.any():
            raise ExpressionError(f"'{ast.unparse(node)}' is not linear in the states")
        raise ExpressionError(f"'{ast.unparse(node)}' is not allowed in an expression")

    def _name(self, name: str) -> LinearForm:
        if name in self.states:
            row = np.zeros(len(self.states))
            row[self.states[name]] = 1.0
            return LinearForm(row, 0.0)
        if name in self.names:
            value = self.names[name]
            if value is None:
                raise BrokenParameter(f"parameter '{name}' is in error")
            return self._constant(value)
        close = difflib.get_close_matches(name, [*self.states, *self.names], n=1)
        guess = f"; did you mean '{close[0]}'?" if close else ""
        raise ExpressionError(f"unknown name '{name}'{guess}")

    def _plain(self, node: ast.AST) -> float:
        form = self.value(node)
        if form.row.any():
            raise ExpressionError(f"'{ast.unparse(node)}': a function of a state is not linear")
        return form.constant

    def _constant(self, value: float) -> LinearForm:
        return LinearForm(np.zeros(len(self.states)), value)

    @staticmethod
    def _guarded(node: ast.AST, function: Callable[..., float], *arguments: float) -> float:
        try:
            value = function(*arguments)
        except (ArithmeticError, ValueError, TypeError) as error:
            raise ExpressionError(f"'{ast.unparse(node)}': {error}") from None
        if isinstance(value, complex):
            raise ExpressionError(f"'{ast.unparse(node)}' is not real")
        return float(value)
