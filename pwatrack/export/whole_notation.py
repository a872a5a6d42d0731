"""The notation of a step, read in whole numbers: see `fixed_point`.

A value is one of 32 bits, or one of 64 that is larger than what it stands for by a shift, of the table whose rows it is
a sum of. What is remembered is rounded to 32 bits; what is added, subtracted or compared is lifted to one shift first.
What `wide`, `nearest`, `narrowed` and `stepped` do is in `reading`.
"""

import ast
from collections.abc import Mapping

from pwatrack.export.notation import names

ONE = 2**31  # what stands for 1 beside numbers of 32 bits


class WholeNumbers(ast.NodeTransformer):
    """Reads the notation in whole numbers: each real value has a shift, by which it is larger than what it stands for.

    Planes have none: which cell they choose is the same.
    """

    def __init__(self, shifts: Mapping[str, int], kinds: Mapping[str, str], inputs: int) -> None:
        self.tables, self.kinds, self.inputs = shifts, kinds, inputs  # kinds of all names
        self.shifts = dict[str, int]()  # of numbers of 64 bits, as they stand
        self.stepping = False  # whether what follows is how floats are put into steps
        self.table = ""  # the last one that was multiplied with

    def of(self, text: str) -> str:
        """Return lines of the notation in whole numbers."""
        return ast.unparse(ast.fix_missing_locations(self.visit(ast.parse(text))))

    def visit_If(self, node: ast.If) -> ast.AST | None:
        """Leave out what is of floats: steps, and whether a change is finite; what is kept is looked at in any case."""
        return None if self.stepping or {"last", "largest"} <= names(node.test) else self.generic_visit(node)

    def visit_Assign(self, node: ast.Assign) -> ast.stmt | None:
        """Return an assignment in whole numbers; None for what floats alone need."""
        (target,) = node.targets
        name = _name(target)
        if self.stepping:
            self.stepping = name != "value"
            return None
        if not self.real(target):
            return node
        if name == "last" and "value" in names(node.value):
            return None
        if self.kinds[name] == "real":
            assert isinstance(target, ast.Subscript)
            return ast.Assign([target], self.kept(target, node.value))
        if isinstance(node.value, ast.BinOp) and isinstance(node.value.op, ast.Div):
            self.stepping, shift = True, self.shifts["value"]
            made = _called("stepped", _called("narrowed", node.value.left, ast.Constant(2**shift)), node.value.right)
            return ast.Assign([node.value.left], _lifted(made, shift))
        value, shift = self.value(node.value)
        if name == "value":  # what an input is to have, until it is put out
            value, shift = _lifted(value, self.tables["gain"] - shift), self.tables["gain"]
        if isinstance(target, ast.Name):
            self.shifts[name] = shift
        return ast.Assign([target], value)

    def kept(self, target: ast.Subscript, node: ast.expr) -> ast.expr:
        """Return a value as it is remembered: of what is stepped, and of what is added to, that alone is rounded."""
        match node:
            case ast.Constant(value=float()):
                return ast.Constant(0)
            case ast.Subscript():
                return node
            case ast.BinOp(left=ast.Name() as total, op=ast.Sub() as op, right=ast.Subscript() as other):
                return _kept(ast.BinOp(_called("nearest", *self.units(total)), op, _wide(other)))
            case ast.BinOp(left=ast.Subscript() as own, op=ast.Add(), right=ast.Name() as total):
                return _kept(ast.BinOp(_wide(own), ast.Add(), _called("nearest", *self.units(total))))
        was = self.before(target)
        if was is None:
            return _called("narrowed", *self.units(node))
        return _kept(ast.BinOp(_wide(was), ast.Add(), _called("nearest", *self.units(node))))

    def units(self, node: ast.expr) -> tuple[ast.expr, ast.expr]:
        """Return a real value, and how much in it is one unit."""
        value, shift = self.value(node)
        turned = self.table == "turn"  # of which each matrix has a shift of its own
        return value, ast.parse("turn_unit[level]", mode="eval").body if turned else ast.Constant(2**shift)

    def before(self, target: ast.Subscript) -> ast.expr | None:
        """Return what it was, where the table that it is made of is by how much that changes."""
        match self.table:
            case "observer":
                return _entry("seen", ast.BinOp(ast.Constant(self.inputs), ast.Add(), target.slice))
            case "generator":
                return _entry(_name(target).removeprefix("new_"), target.slice)
            case "turn":
                return _entry("source", ast.Name("a"))
        return None

    def visit_Compare(self, node: ast.Compare) -> ast.expr:
        """Return a comparison of two values with one shift."""
        left, right = node.left, node.comparators[0]
        if not (self.real(left) or self.real(right)):
            return node
        (one, a), (other, b) = self.value(left), self.value(right)
        return ast.Compare(_lifted(one, b - a), node.ops, [_lifted(other, a - b)])

    def value(self, node: ast.expr) -> tuple[ast.expr, int]:
        """Return a real value in whole numbers of 64 bits, and its shift."""
        match node:
            case ast.Constant(value=float()):
                return ast.Constant(0), 0
            case ast.Name(id=name):
                return (node, self.shifts[name]) if self.kinds[name] == "wide" else (_wide(node), 0)
            case ast.Subscript() if (name := _name(node)) in self.tables:
                wide = self.kinds[name] == "wide"
                return node if wide else ast.BinOp(_wide(node), ast.Mult(), ast.Constant(ONE)), self.tables[name]
            case ast.Subscript():
                return node if self.kinds[_name(node)] == "wide" else _wide(node), 0
            case ast.UnaryOp(op=ast.USub() as op, operand=operand):
                made, shift = self.value(operand)
                return ast.UnaryOp(op, made), shift
            case ast.BinOp(left=ast.Subscript() as table, op=ast.Mult() as op, right=right):
                self.table = _name(table)
                return ast.BinOp(_wide(table), op, right), self.tables.get(self.table, 0)
            case ast.BinOp(left=left, op=ast.Add() | ast.Sub() as op, right=right):
                (one, a), (other, b) = self.value(left), self.value(right)
                return ast.BinOp(_lifted(one, b - a), op, _lifted(other, a - b)), max(a, b)
        raise ValueError(f"not a part of the notation in whole numbers: {ast.unparse(node)}")

    def real(self, node: ast.expr) -> bool:
        """Whether a value is one of real numbers."""
        return any(self.kinds.get(name) in ("real", "wide") for name in names(node)) or any(
            isinstance(part, ast.Constant) and isinstance(part.value, float) for part in ast.walk(node)
        )


def _name(node: ast.expr) -> str:
    while isinstance(node, ast.Subscript):
        node = node.value
    return node.id if isinstance(node, ast.Name) else ""


def _called(name: str, *args: ast.expr) -> ast.expr:
    return ast.Call(ast.Name(name), [*args], [])


def _wide(node: ast.expr) -> ast.expr:
    return _called("wide", node)


def _kept(node: ast.expr) -> ast.expr:
    return _called("narrowed", node, ast.Constant(1))


def _entry(name: str, place: ast.expr) -> ast.expr:
    return ast.Subscript(ast.Name(name), place, ast.Load())


def _lifted(node: ast.expr, bits: int) -> ast.expr:
    """Return a value times 2^bits, where that is more than it."""
    zero = isinstance(node, ast.Constant) and node.value == 0
    return node if bits <= 0 or zero else ast.BinOp(node, ast.Mult(), ast.Constant(2**bits))
