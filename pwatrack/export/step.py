"""One step of a controller in a notation that several languages are printed from, see `notation.py`.

What a controller does is stated once, as Python that `simulation.kernel` compiles: `_next` there. Here it is read
and worked out for one controller, as far as that is known: numbers of loops and places are whole numbers, what never
happens is left out, functions stand where they are called, and inputs are gone through one by one. What is left is in
the notation: loops have fixed bounds, no array is handled as a whole, and no number is written but whole ones, 0.0
and 1.0.
"""

import ast
from collections.abc import Iterable, Iterator, Mapping
from copy import copy, deepcopy
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from textwrap import indent
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from pwatrack.export.notation import names

if TYPE_CHECKING:
    from pwatrack.simulation.kernel import ControllerArrays

PRODUCT = "product"  # every product of floats is assigned to it before it is added to anything
Kind = Literal["real", "wide", "whole", "side", "flag"]  # sides are -1, 0, 1; wide numbers have 64 bits, whole ones 32
_ORDER = """
H h observer C M E generator x_d u_ff K guards start_x_hat start_eta_hat turn start_w piece_values
signs sides piece_tick piece_start piece_length piece_value low high change quantum pace lowest highest timing weights
"""
_SHORT = {"H": "normals", "h": "offsets", "x_d": "desired", "u_ff": "feedforward", "K": "gain"}  # cases are alike
_ENDLESS = ("low", "high", "change", "lowest", "highest")  # infinite where there is none
_SHORT |= {"C": "outputs", "M": "correction", "E": "windup"}
_NUMBERS = {
    "tick": "samples so far",
    "since": "samples since the reference began anew",
    "piece": "pieces of the reference so far",
    "cell": "cell of x_hat, from 0",
    "cell_d": "cell of x_d, from 0",
    "status": "0; 1: the reference has ended; -1: refused, and the last input is held; -2: overwritten, and u is 0",
}
_FLOOR = """\
product = total
if (total >= 0.0) and (total < all_whole):
    product = total + all_whole
    product = product - all_whole
if (total < 0.0) and (total > -all_whole):
    product = total - all_whole
    product = product + all_whole
if product > total:
    product = product - 1.0"""  # the sum is a whole number next to total: a floor without a function of any library


_PACING = ("gap", "lean", "rise", "peak", "part", "early", "width", "aim", "left")  # what set-points take


@dataclass(frozen=True)
class Variable:
    """What is remembered, or worked with: its name, type, length (0: one number), and what it is."""

    name: str
    kind: Kind
    length: int = 0
    what: str = ""


@dataclass(frozen=True)
class Step:
    """A controller that runs once in a sample time."""

    constants: dict[str, tuple[Kind, NDArray[Any]]]  # arrays and numbers, by name
    kept: tuple[Variable, ...]  # what it remembers. From its start all of it is 0 that `begin` does not set.
    own: tuple[Variable, ...]  # what it works with
    begin: str  # what makes it start anew, in the notation
    body: str  # one step, from `y`, and `given` if the reference is from outside; the input is `u`
    hold: str  # what puts the input out that is held: `body` ends with it


def step(routine: "ControllerArrays", starts: Mapping[str, NDArray[Any]]) -> Step:
    """Return the step of a controller that starts from `start_x_hat` (with ŝ), `start_eta_hat`, `start_w` if inside."""
    at, copies = routine.at, max(len(routine.turn) - 1, 0)
    past = at.late - at.past
    arrays: tuple[Variable, ...] = (
        Variable("v", "real", at.w + at.s, "y, u, x_hat, s_hat, eta_hat, w"),
        Variable("copies", "real", copies * at.s, "of w, renewed every 2^10 and 2^20 samples"),
        Variable("course", "real", 4 * len(routine.pace), "of each set-point: distance to go, speed, acceleration; it"),
        Variable("past", "real", past, "what means are made of"),
        Variable("late", "real", at.delay * at.m, "inputs that wait to be put out, the next one first"),
        Variable("late_cut", "real", at.before - at.late_cut, "what limits cut off these"),
        Variable("before", "real", at.m, "inputs computed last, limited"),
        Variable("wanted", "real", at.m, "inputs wanted before they were limited"),
        Variable("x_d", "real", at.n, "desired state"),
    )
    arrays = tuple(variable for variable in arrays if variable.length)
    asked = {"tick": routine.last >= 0, "since": copies > 0, "piece": routine.most > 0}
    numbers = [Variable(name, "whole", what=what) for name, what in _NUMBERS.items() if asked.get(name, True)]
    own = [Variable(f"new_{variable.name}", variable.kind, variable.length) for variable in (*arrays, *numbers)]
    own += [Variable("g", "real", at.source - at.g)] if at.source > at.g else []
    own += [Variable("source", "real", at.s)] if len(routine.turn) else []
    predicted = {"seen": at.m + at.N, "moved": at.N, "missed": at.q} if len(routine.M) else {}
    paced = {"going": 3, "lasting": 3, "bending": 3, "made": at.s // len(routine.pace)} if len(routine.pace) else {}
    cut = {"cut": at.m} if len(routine.E) else {}
    own += [Variable(name, "real", length) for name, length in {**cut, **predicted, **paced}.items()]
    own += [
        Variable(name, "whole") for name in ("a", "b", "i", "k", "level", *(("here", "stage") if predicted else ()))
    ]
    own += [Variable(name, "real") for name in ("total", PRODUCT, "difference", "worst", "least", "value", "last")]
    own += [Variable(name, "real") for name in _PACING if paced]
    own.append(Variable("fine", "flag"))
    kept = (*arrays, *numbers, Variable("started", "flag", what="whether it has run"))
    hold = _loop("b", at.m, f"u[b] = v[{at.u} + b]\nif not {_finite(f'v[{at.u} + b]')}:\n    u[b] = 0.0")
    return Step(
        constants=_constants(routine, starts),
        kept=kept,
        own=tuple(own),
        begin="\n".join(_begin(routine, arrays, numbers)),
        body="\n".join(_body(routine, arrays, numbers, {v.name for v in (*kept, *own)}, hold)),
        hold=hold,
    )


def _constants(routine: "ControllerArrays", starts: Mapping[str, NDArray[Any]]) -> dict[str, tuple[Kind, NDArray[Any]]]:
    real = type(routine.half)
    finfo, known = np.finfo(real), {**routine._asdict(), **starts}
    found = dict[str, tuple[Kind, NDArray[Any]]]()
    for name in _ORDER.split():
        values = known.get(name, np.zeros(0))
        there = np.isfinite(values) if name in _ENDLESS else values > 0 if name == "quantum" else True
        if values.size and np.any(there):
            kind: Kind = "real" if values.dtype.kind == "f" else "side" if name in ("signs", "sides") else "whole"
            found[_SHORT.get(name, name)] = (kind, np.where(there, values, 0))  # 0 where there is none
    found["largest"] = ("real", np.array(finfo.max))
    if "quantum" in found:
        found["half"] = ("real", np.array(routine.half))
        found["all_whole"] = ("real", np.array(2.0**finfo.nmant, dtype=real))  # from here on there are no halves
    return found


def _begin(routine: "ControllerArrays", arrays: Iterable[Variable], numbers: Iterable[Variable]) -> Iterator[str]:
    at = routine.at
    for variable in arrays:
        yield _loop("k", variable.length, f"{variable.name}[k] = 0.0")
    starts = [("start_x_hat", f"v[{at.x_hat} + k]", at.N), ("start_eta_hat", f"v[{at.eta_hat} + k]", at.p)]
    if len(routine.turn):
        starts.append(("start_w", f"v[{at.w} + k]", at.s))
        starts += [("start_w", f"copies[{_at(copy * at.s, 'k')}]", at.s) for copy in range(len(routine.turn) - 1)]
    for table, place, length in starts:
        yield _loop("k", length, f"{place} = {table}[k]")
    for c in range(len(routine.pace)):
        yield f"course[{4 * c + 3}] = pace[{c}, 0]"
        for start, count in zip(routine.window_start[c], routine.windows[c], strict=True):
            yield _loop("k", count, f"past[{_at(start, 'k')}] = pace[{c}, 0]")
    for number in numbers:
        yield f"{number.name} = 0"
    yield "started = False"


def _body(
    routine: "ControllerArrays", arrays: Iterable[Variable], numbers: Iterable[Variable], variables: set[str], hold: str
) -> Iterator[str]:
    """Yield a step, unless a number that is an index was overwritten: then the answer to that."""
    below = {"cell": len(routine.signs), "cell_d": len(routine.sides), "piece": len(routine.piece_tick) + 1}
    below["since"] = 2 ** (10 * max(len(routine.turn) - 1, 0))
    inside = [f"({v.name} >= 0) and ({v.name} < {below[v.name]})" for v in numbers if v.name in below]
    lines = [_loop("k", variable.length, f"new_{variable.name}[k] = {variable.name}[k]") for variable in arrays]
    lines += [_Worked(routine, variables).text("_next"), "'Nothing is changed unless all of it is finite.'"]
    for variable in arrays:
        if variable.name not in ("before", "wanted"):  # which were looked at
            lines.append(_loop("k", variable.length, f"if not {_finite(f'new_{variable.name}[k]')}:\n    fine = False"))
    done = [_loop("k", variable.length, f"{variable.name}[k] = new_{variable.name}[k]") for variable in arrays]
    done += [f"{number.name} = new_{number.name}" for number in numbers] + ["started = True"]
    lines += ["if fine:\n" + indent("\n".join(done), "    ") + "\nelse:\n    status = -1", hold]
    made = indent("\n".join(filter(None, lines)), "    ")
    yield f"if {' and '.join(inside)}:\n{made}"
    yield f"else:\n    'Overwritten.'\n    status = -2\n{indent(_loop('b', routine.at.m, 'u[b] = 0.0'), '    ')}"


def _loop(index: str, count: int, body: str) -> str:
    return f"for {index} in range(0, {count}):\n{indent(body, '    ')}" if count else ""


def _at(first: int, index: str) -> str:
    return f"{first} + {index}" if first else index


def _finite(value: str) -> str:
    """Return whether a number is finite: of one that is no number, every comparison is false."""
    return f"(({value} >= -largest) and ({value} <= largest))"


@cache
def _statement() -> tuple[dict[str, ast.FunctionDef], dict[str, Any]]:
    body = ast.parse(files("pwatrack.simulation").joinpath("kernel.py").read_text(encoding="utf-8")).body
    known: dict[str, Any] = {"np": np, "len": len, "min": min}
    for node in body:
        match node:
            case ast.Assign(targets=[ast.Name(id=name)], value=ast.Constant(value=int(value))):
                known[name] = value
            case ast.Assign(targets=[ast.Tuple(elts=names)], value=ast.Tuple(elts=values)) if len(names) == len(values):
                known |= {ast.unparse(name): ast.literal_eval(value) for name, value in zip(names, values, strict=True)}
    return {node.name: node for node in body if isinstance(node, ast.FunctionDef)}, known


class _Worked:
    """The statement worked out for one controller.

    Names of a `known` mapping stand for their values, or for what is written there; `variables` go by their names.
    """

    def __init__(self, routine: Any, variables: set[str]) -> None:
        self.functions, constants = _statement()
        self.variables, self.constants, self.at = variables, constants | {"routine": routine}, routine.at

    def text(self, name: str) -> str:
        """Return a function in the notation."""
        lines = self.block(self.functions[name].body[1:], self.constants)
        return ast.unparse(ast.fix_missing_locations(ast.Module(lines, [])))

    def block(self, body: Iterable[ast.stmt], known: dict[str, Any]) -> list[ast.stmt]:
        """Return what is left of statements by themselves."""
        found = list[ast.stmt]()
        self.statements(body, dict(known), found)
        return found

    def statements(self, body: Iterable[ast.stmt], known: dict[str, Any], found: list[ast.stmt]) -> ast.expr | None:
        """Write what is left of statements, and return what they return."""
        for node in body:
            match node:
                case ast.Expr(value=ast.Constant(value=str(text))):
                    found.append(ast.Expr(ast.Constant(text.format(**known))))
                case ast.Expr(value=ast.Call() as call):
                    self.value(call, known, found)
                case ast.Return(value=ast.expr() as value):
                    return self.value(value, known, found)
                case ast.Assign([target], value) | ast.AnnAssign(target=target, value=ast.expr() as value):
                    self.assign(target, value, known, found)
                case ast.For(target=ast.Name(id=index), iter=ast.Call(args=args)):
                    numbers = range(*(self.decided(arg, known) for arg in args))
                    if index not in self.variables:
                        for number in numbers:
                            self.statements(node.body, known | {index: number}, found)
                    elif numbers:
                        bounds: list[ast.expr] = [ast.Constant(numbers.start), ast.Constant(numbers.stop)]
                        counted = ast.Call(ast.Name("range"), bounds, [])
                        found.append(ast.For(ast.Name(index), counted, self.block(node.body, known), []))
                case ast.If(body=[ast.Break()]):
                    pass
                case ast.If():
                    if (result := self.branch(node, known, found)) is not None:
                        return result
                case _:
                    raise ValueError(f"not a part of the statement: {ast.unparse(node)}")
        return None

    def branch(self, node: ast.If, known: dict[str, Any], found: list[ast.stmt]) -> ast.expr | None:
        """Write the branches that there are, and return what the one that is taken returns."""
        test, parts = node.test, list[ast.expr]()
        for part in test.values if isinstance(test, ast.BoolOp) and isinstance(test.op, ast.And) else [test]:
            decided = self.decided(part, known)
            if decided is None:
                parts.append(self.value(part, known, found))
            elif not decided:
                return self.statements(node.orelse, known, found)
        if not parts:
            return self.statements(node.body, known, found)
        left = parts[0] if len(parts) == 1 else ast.BoolOp(ast.And(), parts)
        found.append(ast.If(left, *(self.block(each, known) for each in (node.body, node.orelse))))
        return None

    def assign(self, target: ast.expr, value: ast.expr, known: dict[str, Any], found: list[ast.stmt]) -> None:
        """Write an assignment to a variable; any other name stands for the value."""
        if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
            for one, other in zip(target.elts, value.elts, strict=True):
                self.assign(one, other, known, found)
            return
        if isinstance(target, ast.Name) and target.id not in self.variables:
            decided = self.decided(value, known)
            known[target.id] = self.value(value, known, found) if decided is None else decided
            return
        place = self.value(target, known, found)
        if names(place) <= self.variables:  # else nobody asks
            made = self.value(value, known, found)
            if ast.unparse(made) != ast.unparse(place):
                found.append(ast.Assign([place], made))

    def decided(self, node: ast.expr, known: dict[str, Any]) -> Any:
        """Return a value that is known, or None."""
        if any(isinstance(known.get(name), ast.expr | None) for name in names(node)):
            return None
        whole = ast.fix_missing_locations(ast.Expression(deepcopy(node)))
        return eval(compile(whole, "kernel", "eval"), {"__builtins__": {}}, known)  # noqa: S307  # our own code

    def value(self, node: ast.expr, known: dict[str, Any], found: list[ast.stmt]) -> ast.expr:
        """Return what is left of a value; what must be done before it is written."""
        decided = None if isinstance(node, ast.Constant) else self.decided(node, known)
        if isinstance(decided, int | np.integer):
            return ast.Constant(int(decided))
        match node:
            case ast.Name(id=name):
                stands: ast.expr = deepcopy(known.get(name, node))
                return stands
            case ast.Attribute(value=ast.Name(id=of), attr=name):
                return ast.Name({"new": f"new_{name}", "routine": _SHORT.get(name, name)}.get(of, name))
            case ast.Subscript(value=ast.Name(id="memory" | "room" as of), slice=place):
                return self.place(of, place, known, found)
            case ast.Call(func=ast.Attribute(attr="isfinite"), args=[inner]):
                return ast.parse(_finite(ast.unparse(self.value(inner, known, found))), mode="eval").body
            case ast.Call(func=ast.Attribute(attr="sqrt"), args=[inner]):
                return ast.Call(ast.Name("sqrt"), [self.value(inner, known, found)], [])
            case ast.Call(func=ast.Attribute(attr="floor")):
                found += ast.parse(_FLOOR).body
                return ast.Name(PRODUCT)
            case ast.Call(func=ast.Name(id=name), args=args):
                return self.called(self.functions[name], args, known, found)
        made = copy(node)
        for name, part in ast.iter_fields(node):
            if isinstance(part, list):
                part = [self.value(each, known, found) if isinstance(each, ast.expr) else each for each in part]
            setattr(made, name, self.value(part, known, found) if isinstance(part, ast.expr) else part)
        if isinstance(made, ast.Subscript) and isinstance(made.value, ast.Subscript):  # of a row: all indices in one
            places = [
                place.elts if isinstance(place, ast.Tuple) else [place] for place in (made.value.slice, made.slice)
            ]
            return ast.Subscript(made.value.value, ast.Tuple([*places[0], *places[1]]))
        return made

    def called(
        self, function: ast.FunctionDef, args: Iterable[ast.expr], known: dict[str, Any], found: list[ast.stmt]
    ) -> ast.expr:
        """Write what a function does, and return what it returns."""
        names = {arg.arg: value for arg, value in zip(function.args.args, args, strict=True)}
        body = [_Named(names).visit(deepcopy(node)) for node in function.body[1:]]
        result = self.statements(body, dict(known), found)
        return ast.Constant(None) if result is None else result

    def place(self, of: str, index: ast.expr, known: dict[str, Any], found: list[ast.stmt]) -> ast.expr:
        """Return an entry of memory or room: its index begins with the name of a part."""
        terms = list[tuple[ast.operator, ast.expr]]()
        while isinstance(index, ast.BinOp) and isinstance(index.op, ast.Add | ast.Sub):
            terms.insert(0, (index.op, index.right))
            index = index.left
        assert isinstance(index, ast.Attribute)
        part = index.attr
        whole, first = ("v", getattr(self.at, part)) if part in _IN_V else (part, 0)
        while terms and (more := self.decided(terms[0][1], known)) is not None:
            first += more if isinstance(terms.pop(0)[0], ast.Add) else -more
        place: ast.expr | None = ast.Constant(int(first)) if first or not terms else None
        for op, term in terms:
            value = self.value(term, known, found)
            place = value if place is None else ast.BinOp(place, op, value)
        assert place is not None
        return ast.Subscript(ast.Name(f"new_{whole}" if of == "room" and part not in _WORK else whole), place)


_IN_V = ("y", "u", "x_hat", "s_hat", "eta_hat", "w")  # parts of memory that are one array
# parts of the room that are not remembered
_WORK = ("g", "source", "cut", "seen", "moved", "missed", "going", "lasting", "bending", "made")


class _Named(ast.NodeTransformer):
    def __init__(self, values: dict[str, ast.expr]) -> None:
        self.values = values

    def visit_Name(self, node: ast.Name) -> ast.expr:
        return deepcopy(self.values.get(node.id, node))
