"""The notation in which a step is written once, and the languages that it is printed in.

It is a part of Python: assignments, `if` with `elif` and `else`, `for` over a range of two whole numbers, indices from
0, + - * / %, sqrt, one comparison at a time, `and`, `or`, `not`, whole numbers, floats, True and False. A text by
itself is a comment. A new language is a module with a function `write`, and a line of `LANGUAGES`.
"""

import ast
from collections import Counter
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass
from importlib import import_module
from textwrap import indent
from typing import Literal

Numbers = Literal["float64", "float32", "int32"]


@dataclass(frozen=True, kw_only=True)
class Language:
    """How a language writes it."""

    assign: str  # from target and value
    loop: str  # from index, first and last number, and body; bodies are indented
    branch: str  # `if`, from condition and body
    other: str  # `elif`, likewise
    otherwise: str  # `else`, from its body
    end: str  # what ends it
    within: str = ""  # what stands in an `else` that must end an `elif`; "" where none must
    truth: str = "{}"  # a flag as a condition
    words: Mapping[str, str]  # operators, numbers, True and False, where they are written in another way
    remainder: str  # from two whole numbers
    name: Callable[[str], str]  # a variable
    element: str  # from an array and its indices
    between: str = ", "  # what stands between indices
    from_one: bool  # whether indices begin with 1
    comment: str  # from its text
    once: str = ""  # a loop of one pass, from index, number and body, not indented; "" where it is a loop, too


_NEAREST = {"/": 2, "*": 1, "+": 1, "-": 1, "<": 1}
# what may be called, and how often it does each of + - * / and compares; what rounds whole numbers is in `reading`
_CALLED: Mapping[str, Mapping[str, int]] = {
    "sqrt": {"/": 1},
    "wide": {},
    "nearest": _NEAREST,
    "narrowed": {**_NEAREST, "<": 3},
    "stepped": {**_NEAREST, "*": 2},
}
_OPERATORS: dict[type[ast.AST], str] = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}
_SIGNS = _OPERATORS | {ast.Eq: "==", ast.Lt: "<", ast.Gt: ">", ast.LtE: "<=", ast.GtE: ">="}


def printed(text: str, language: Language) -> str:
    r"""Return lines of the notation in a language.

    Raises ValueError if something is no part of the notation.

    Example:
        >>> from pwatrack.export.structured_text import ST
        >>> print(printed("for k in range(1, 3):\n    u[k] = 2.0 * (u[k - 1] + 1.0)", ST))
        FOR k := 1 TO 2 DO
            u[k] := 2.0 * (u[k - 1] + 1.0);
        END_FOR;
    """
    return "\n".join(map(_Printer(language).statement, ast.parse(text).body))


def names(text: str | ast.AST) -> set[str]:
    """Return all names in lines of the notation, or in a part of their tree."""
    tree = ast.parse(text) if isinstance(text, str) else text
    return {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}


def most(text: str, reals: Set[str]) -> Counter[str]:
    r"""Return how often a text does each of + - * / with real numbers at most, sqrt as /, and compares them, "<".

    `reals` are the names of these: of floats, or of whole numbers that stand for them.

    Example:
        >>> text = "for k in range(0, 3):\n    if u[k] > 0.0:\n        u[k] = 2.0 * u[k - 1]"
        >>> sorted(most(text, {"u"}).items())
        [('*', 3), ('<', 3)]
        >>> sorted(most("u[0] = narrowed(v, 2)", {"u"}).items())
        [('*', 1), ('+', 1), ('-', 1), ('/', 2), ('<', 3)]
    """

    def of_value(node: ast.AST) -> Counter[str]:
        found = Counter[str]()
        for part in ast.walk(node):
            if isinstance(part, ast.BinOp | ast.Compare) and names(part) & reals:
                found[_SIGNS[type(part.op)] if isinstance(part, ast.BinOp) else "<"] += 1
            if isinstance(part, ast.Call) and isinstance(part.func, ast.Name):
                found.update(_CALLED.get(part.func.id, {}))
        return found

    def of_body(body: Sequence[ast.stmt]) -> Counter[str]:
        return sum(map(of_statement, body), Counter[str]())

    def of_statement(node: ast.stmt) -> Counter[str]:
        match node:
            case ast.For(iter=ast.Call(args=[ast.Constant(value=int(first)), ast.Constant(value=int(stop))])):
                return Counter({name: count * (stop - first) for name, count in of_body(node.body).items()})
            case ast.If():
                return of_value(node.test) + (of_body(node.body) | of_body(node.orelse))
        return of_value(node)

    return of_body(ast.parse(text).body)


@dataclass(frozen=True)
class _Printer:
    language: Language

    def block(self, body: Sequence[ast.stmt]) -> str:
        return indent("\n".join(map(self.statement, body)), "    ")

    def statement(self, node: ast.stmt) -> str:
        language = self.language
        match node:
            case ast.Expr(value=ast.Constant(value=str(text))):
                return language.comment.format(text)
            case ast.Assign(targets=[target], value=value):
                return language.assign.format(self.value(target), self.value(value))
            case ast.For(
                target=ast.Name(id=index),
                iter=ast.Call(args=[ast.Constant(value=int(first)), ast.Constant(value=int(stop))]),
                orelse=[],
            ):
                if language.once and stop - first == 1:
                    return language.once.format(language.name(index), first, "\n".join(map(self.statement, node.body)))
                return language.loop.format(language.name(index), first, stop - 1, self.block(node.body))
            case ast.If():
                return (self.branches(node, language.branch) + language.end).rstrip()
        raise ValueError(f"not a part of the notation: {ast.unparse(node)}")

    def branches(self, node: ast.If, form: str) -> str:
        test = self.value(node.test)
        test = self.language.truth.format(test) if isinstance(node.test, ast.Name) else test
        text = form.format(test, self.block(node.body))
        match node.orelse:
            case []:
                within = self.language.within if form == self.language.other else ""
                return text + (self.language.otherwise.format(indent(within, "    ")) if within else "")
            case [ast.If() as other]:
                return text + self.branches(other, self.language.other)
        return text + self.language.otherwise.format(self.block(node.orelse))

    def value(self, node: ast.expr) -> str:
        words = self.language.words
        match node:
            case ast.Name(id=name):
                return self.language.name(name)
            case ast.Constant(value=value):
                return words.get(str(value), str(value))
            case ast.Subscript(value=ast.Name(id=name), slice=place):
                places = place.elts if isinstance(place, ast.Tuple) else [place]
                indices = self.language.between.join(map(self.place, places))
                return self.language.element.format(self.language.name(name), indices)
            case ast.BinOp(left=left, op=ast.Mod(), right=right):
                return self.language.remainder.format(self.inner(left), self.inner(right))
            case ast.BinOp(left, op, right) | ast.Compare(left, [op], [right]):
                return f"{self.inner(left)} {self.word(_SIGNS[type(op)])} {self.inner(right)}"
            case ast.BoolOp(op=op, values=values):
                return f" {words['and' if isinstance(op, ast.And) else 'or']} ".join(map(self.inner, values))
            case ast.Call(func=ast.Name(id=called), args=args) if called in _CALLED:
                return f"{self.word(called)}({', '.join(map(self.value, args))})"
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                return f"{words['not']}{self.inner(operand)}"
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return f"-{self.inner(operand)}"
        raise ValueError(f"not a part of the notation: {ast.unparse(node)}")

    def word(self, operator: str) -> str:
        return self.language.words.get(operator, operator)

    def inner(self, node: ast.expr) -> str:
        """Return a part of a larger value: nothing is left to the precedence of a language."""
        text = self.value(node)
        return f"({text})" if isinstance(node, ast.BinOp | ast.Compare | ast.BoolOp | ast.UnaryOp) else text

    def place(self, node: ast.expr) -> str:
        """Return an index; what is added to make it begin with 1 goes into the number that it has, where it has one."""
        if not self.language.from_one:
            return self.value(node)
        match node:
            case ast.Constant(value=int(number)):
                return str(number + 1)
            case ast.BinOp(left=ast.Constant(value=int(number)), op=ast.Add(), right=right):
                return f"{number + 1} + {self.inner(right)}"
            case ast.BinOp(left=left, op=ast.Sub(), right=ast.Constant(value=1)):
                return self.value(left)
        return f"{self.inner(node)} + 1"


@dataclass(frozen=True, kw_only=True)
class Target:
    """A language that a controller is exported in."""

    module: str  # of this room, where `write` is
    help: str  # what is written, in a sentence
    example: str  # arguments of a command that writes it
    numbers: tuple[Numbers, ...] = ("float64", "float32")  # what it may compute in

    @property
    def write(self) -> Callable[..., list[str]]:
        """What writes a `Source`, and the `Vector` it reads in a test, to a folder, and returns the names of files."""
        found: Callable[..., list[str]] = import_module(f"pwatrack.export.{self.module}").write
        return found


LANGUAGES = {
    "c": Target(
        module="c",
        help="Write a controller in C99, with a test vector of its simulation.",
        example="runs/two_mass_machine --out firmware --float32",
        numbers=("float64", "float32", "int32"),
    ),
    "st": Target(
        module="structured_text",
        help="Write a controller as a function block in Structured Text of IEC 61131-3.",
        example="runs/two_mass_machine --out plc --float32",
    ),
    "mat": Target(
        module="matlab",
        help="Write a controller for MATLAB and Octave: a file of all its matrices, and a function that steps it.",
        example="runs/two_mass_machine --out matlab",
        numbers=("float64",),
    ),
}
