"""A small compiler of Structured Text to Python, on what blark's grammar makes of it: strict where there is room.

Nothing is turned into another type, `AND` and `OR` work out both sides, an index must be inside its array, the bounds
of a loop must be whole numbers as written, a constant is not assigned to, and names differ by more than their case.
The grammar takes a millisecond for each character, and time that grows with the square of a table: so tables are read
by themselves, and what is in many blocks is parsed once. With `whole_text` the grammar takes it all at once; that both
are the same is tested.
"""

import gc
import re
from collections.abc import Iterator, Sequence
from functools import cache
from itertools import product
from operator import itemgetter
from textwrap import indent
from typing import Any

import blark.transform as tree
import numpy as np
from blark.parse import parse_source_code

WORDS = {"AND": "&", "OR": "|", "=": "==", "MOD": "%"}
COMPARED = ("<", ">", "<=", ">=", "=")
RANGES = {"SINT": (-(2**7), 2**7), "DINT": (-(2**31), 2**31), "UDINT": (0, 2**32)}
FLOATS = {"REAL": np.float32, "LREAL": float}


NAME = re.compile(r"[A-Za-z](_?[A-Za-z0-9])*")
TABLE = re.compile(r"(\w+) : (ARRAY.*) := \[([^\]]*)\];")
COMMENT = re.compile(r"\(\*.*?\*\)", re.DOTALL)


@cache
def parsed(text: str) -> tree.FunctionBlock:
    gc.disable()  # its many objects are looked through again and again while they are made
    try:
        found = parse_source_code(text)
    finally:
        gc.enable()
    assert found.exception is None, found.exception
    (block,) = found.transform().items
    assert isinstance(block, tree.FunctionBlock)
    return block


SECTION = re.compile(r"^(VAR.*)\n((?: .*\n)*)END_VAR\n", re.MULTILINE)
SIMPLE = re.compile(r"(?:^(?! *FOR )[^:;\n]+ := [^;\n]+;\n(?: *\n)*)+", re.MULTILINE)
INNERMOST = re.compile(r"\b(IF|FOR)\b(?:(?!\b(?:IF|FOR)\b).)*?END_\1;", re.DOTALL)
PART = "__"  # legal names are others: `__ := 7` stands for the statements of part 7

known: dict[tuple[str, str], Any] = {}
parts: dict[str, int] = {}
of_part: list[Sequence[Any]] = []


def learned(lines: Sequence[str], head: str = "", end: str = "") -> list[Any]:
    """Return what statements are parsed to, or lines of a section, each with its section: each parsed once."""
    new = [line for line in dict.fromkeys(lines) if (head, line) not in known]
    if new:
        block = parsed("\n".join(["FUNCTION_BLOCK f", head, *new, end, "END_FUNCTION_BLOCK"]))
        found = [(item, section) for section in block.declarations for item in section.items]
        known.update(zip([(head, line) for line in new], found if head else block.body.statements, strict=True))
    return [known[head, line] for line in lines]


def lines_of(text: str) -> list[str]:
    return [line.strip() for line in text.splitlines() if line.strip()]


def part(found: re.Match[str]) -> str:
    """Return a statement that stands for simple ones, or for one `IF` or `FOR`."""
    text = found[0]
    if text not in parts:
        parts[text] = len(parts)
        of_part.append(learned([" ".join(text.split())] if found.lastindex else lines_of(text)))
    return f"{PART} := {parts[text]};\n"


def in_parts(text: str) -> tuple[tree.FunctionBlock, list[tuple[Any, Any]]]:
    """Return a block with parts for statements, and its declarations, each with its section."""
    declared = [one for head, inside in SECTION.findall(text) for one in learned(lines_of(inside), head, "END_VAR")]
    text = SECTION.sub("", text)
    learned([line for found in SIMPLE.finditer(text) for line in lines_of(found[0])])
    text = SIMPLE.sub(part, text)
    while INNERMOST.search(text):
        text = INNERMOST.sub(part, text)
    return parsed(text), declared


class Block:
    """A function block that can be called.

    Attributes:
        types: Of each variable, or of its entries.
        inputs, outputs: Their names, in order.
        memory: All variables; an array by the indices of its entries.
        body: Its statements, in Python.
    """

    def __init__(self, text: str, *, whole_text: bool = False) -> None:
        (self.float,) = set(re.findall(r"L?REAL", re.sub(COMMENT, "", text)))
        self._tables = {} if whole_text else {name: numbers.split(",") for name, _, numbers in TABLE.findall(text)}
        text = text if whole_text else re.sub(COMMENT, "", TABLE.sub(r"\1 : \2;", text))
        text = text.replace("LREAL", "REAL")
        block, declared = (parsed(text), None) if whole_text else in_parts(text)
        if declared is None:
            declared = [(item, section) for section in block.declarations for item in section.items]
        self.types: dict[str, str] = {}
        self.constants: set[str] = set()
        self.inputs: list[str] = []
        self.outputs: list[str] = []
        self.memory: dict[str, Any] = {}
        for item, section in declared:
            self._declare(item, section)
        assert len({name.upper() for name in self.types}) == len(self.types)
        self.body = indent("\n".join(self._statements(block.body.statements)), "    ")
        changed = ", ".join(name for name in self.types if name not in self.constants)
        made: dict[str, Any] = {"real": FLOATS[self.float], "whole": whole, "root": root}
        exec(f"def run({', '.join(self.types)}):\n{self.body}\n    return dict({same(changed)})", made)
        self._run = made["run"]

    def __call__(self, **inputs: Any) -> dict[str, Any]:
        """Run once and return all variables, arrays of one index as lists."""
        assert sorted(inputs) == sorted(self.inputs)
        for name, value in inputs.items():
            self.memory[name] = bool(value) if self.types[name] == "BOOL" else FLOATS[self.float](value)
        with np.errstate(all="ignore"):
            self.memory |= self._run(**self.memory)
        return {name: [*value.values()] if isinstance(value, dict) else value for name, value in self.memory.items()}

    def _declare(self, item: Any, section: Any) -> None:
        (variable,) = item.variables
        name, shape = str(variable.variable.name), list[int]()
        assert NAME.fullmatch(name), name
        array = isinstance(item.init, tree.ArrayTypeInitialization)
        for limits in item.init.spec.subranges if array else ():
            assert int(limits.start.value) == 0
            shape.append(int(limits.stop.value) + 1)
        kind = str(item.init.spec.type.type_name if array else item.init.spec.type)
        kind, size = self.float if kind == "REAL" else kind, int(np.prod(shape))
        values: list[Any] = list(leaves(item.init.value)) if item.init.value is not None else [0] * size
        values = self._tables.get(name, values)
        assert len(values) == size
        assert name not in self.types
        self.types[name] = kind
        if isinstance(section, tree.InputDeclarations):
            self.inputs.append(name)
        if isinstance(section, tree.OutputDeclarations):
            self.outputs.append(name)
        if getattr(section, "attrs", None) is not None:
            assert section.attrs == tree.VariableAttributes.constant
            self.constants.add(name)
        make: Any = {**FLOATS, "BOOL": bool}.get(kind, int)
        entries = [make(value) for value in values]
        assert kind not in RANGES or all(RANGES[kind][0] <= entry < RANGES[kind][1] for entry in entries)
        places = [place if len(shape) > 1 else place[0] for place in product(*map(range, shape))] if shape else []
        self.memory[name] = dict(zip(places, entries, strict=True)) if shape else entries[0]

    def _statements(self, statements: Sequence[Any]) -> Iterator[str]:
        for node in statements:
            if isinstance(node, tree.AssignmentStatement) and str(node.variables[0].name) == PART:
                yield from self._statements(of_part[int(node.expression.value)])
            elif isinstance(node, tree.AssignmentStatement):
                yield self._assignment(node)
            elif isinstance(node, tree.ForStatement):
                first, last, name = int(node.from_.value), int(node.to.value), str(node.control.name)
                assert node.step is None
                assert self.types[name] == "DINT"
                yield f"for {name} in range({first}, {last + 1}):\n{self._block(node.statements)}"
            else:
                assert isinstance(node, tree.IfStatement)
                branches = [("if", node.if_expression, node.statements)]
                branches += [("elif", other.if_expression, other.statements) for other in node.else_ifs]
                for word, test, body in branches:
                    yield f"{word} {self._value(test, 'BOOL')}:\n{self._block(body)}"
                if node.else_clause:
                    yield f"else:\n{self._block(node.else_clause.statements)}"

    def _block(self, body: Any) -> str:
        return indent("\n".join(self._statements(body.statements)), "    ")

    def _assignment(self, node: Any) -> str:
        (target,) = node.variables
        place, kind = self._typed(target)
        name = place.partition("[")[0]
        assert name not in self.constants
        value = self._value(node.expression, kind)
        value = f"whole({value}, {RANGES[kind]})" if kind in RANGES else value
        return f"assert {place} is not None; {place} = {value}"  # an entry that is not there is not made

    def _value(self, node: Any, kind: str) -> str:
        """Return a value that must be of a type."""
        text, found = self._typed(node)
        assert found == kind or (found == "whole" and kind in RANGES), f"{text} is {found}, not {kind}"
        return text

    def _typed(self, node: Any) -> tuple[str, str]:
        """Return a value in Python, and its type; that of a whole number as written is `whole`."""
        match node:
            case tree.ParenthesizedExpression(expr=inner):
                return self._typed(inner)
            case tree.Integer(value=value):
                return str(value), "whole"
            case tree.Real(value=value):
                return f"real({value})", self.float
            case tree.Boolean(value=value):
                return str(value).title(), "BOOL"
            case tree.UnaryOperation(op=op, expr=inner) if op == "NOT":
                return f"(not {self._value(inner, 'BOOL')})", "BOOL"
            case tree.UnaryOperation(expr=inner):
                text, kind = self._typed(inner)
                assert kind != "BOOL"
                return f"(-{text})", kind
            case tree.BinaryOperation(left=left, op=op, right=right):
                (one, first), (other, second) = self._typed(left), self._typed(right)
                kind = second if first == "whole" else first
                assert {first, second} <= {kind, "whole"}, f"{one} {op} {other}"
                assert (kind == "BOOL") == (op in ("AND", "OR"))
                assert kind not in FLOATS or (op != "MOD" and "whole" not in (first, second))
                assert kind in FLOATS or op != "/"
                text = f"({one} {WORDS.get(op, op)} {other})"
                return (f"bool{text}", "BOOL") if op in COMPARED else (text, kind)
            case tree.SimpleVariable(name=name):
                return str(name), self.types[name]
            case tree.FunctionCall(name=called, parameters=[square]):
                assert str(called.name) == "SQRT"
                return f"root({self._value(square.value, self.float)})", self.float
        assert isinstance(node, tree.MultiElementVariable)
        name, (subscripts,) = str(node.name.name), node.elements
        places = [self._typed(place) for place in subscripts.subscripts]
        assert all(kind in ("DINT", "whole") for _, kind in places)
        return f"{name}[{', '.join(text for text, _ in places)}]", self.types[name]


class Program:
    """A program that calls one block once, and reads what that puts out.

    Attributes:
        types: Of each variable; that of `instance` is the block.
        instance: What the block is called.
    """

    def __init__(self, text: str, block: Block) -> None:
        found = parse_source_code(text)
        assert found.exception is None, found.exception
        (program,) = found.transform().items
        assert isinstance(program, tree.Program)
        items = [item for part in program.declarations for item in part.items]
        variables = [(str(item.variables[0].variable.name), item.init) for item in items]
        self.types = {name: str(getattr(init, "spec", init)) for name, init in variables}
        assert len({name.upper() for name in self.types}) == len(self.types)
        assert all(NAME.fullmatch(name) for name in self.types)
        call, *reads = program.body.statements
        assert isinstance(call, tree.FunctionCallStatement)
        self.instance, self._block = str(call.name.name), block
        self._inputs = {str(one.name.name): str(one.value.name) for one in call.parameters}
        self._reads = [(str(one.variables[0].name), one.expression) for one in reads]
        for name, value in self._inputs.items():
            assert self.types[value] == block.types[name]

    def __call__(self, **inputs: Any) -> dict[str, Any]:
        """Run once and return what is assigned to its variables."""
        found = self._block(**{name: inputs[value] for name, value in self._inputs.items()})
        return {target: self._value(target, node, found) for target, node in self._reads}

    def _value(self, target: str, node: Any, found: dict[str, Any]) -> Any:
        if isinstance(node, tree.BinaryOperation):
            assert (str(node.op), self.types[target]) == ("<", "BOOL")
            return self._field(node.left)[0](found) < int(node.right.value)
        value, kind = self._field(node)
        assert self.types[target] == kind
        return value(found)

    def _field(self, node: Any) -> tuple[Any, str]:
        (field,) = node.elements
        name = str(field.field.name)
        assert str(node.name.name) == self.instance
        assert name in self._block.outputs
        return itemgetter(name), self._block.types[name]


def root(square: Any) -> Any:
    return type(square)(np.sqrt(square))


def whole(value: int, limits: tuple[int, int]) -> int:
    assert limits[0] <= value < limits[1]
    return value


def same(names: str) -> str:
    return ", ".join(f"{name}={name}" for name in names.split(", "))


def leaves(node: Any) -> Iterator[Any]:
    """Yield the numbers of an initial value, in order."""
    if isinstance(node, tree.ArrayInitialization):
        for element in node.elements:
            yield from leaves(element.element)
    elif isinstance(node, tree.UnaryOperation):
        (value,) = leaves(node.expr)
        yield -value
    elif isinstance(node, tree.Boolean):
        yield str(node.value) == "TRUE"
    else:
        yield int(node.value) if isinstance(node, tree.Integer) else float(node.value)
