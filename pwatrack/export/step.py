"""One step of a controller, as `docs/arithmetic.md` says, in a notation that several languages are printed from.

The notation is a small part of Python, see `notation.py`: loops have fixed bounds, no array is handled as a whole, and
no number is written in it but whole ones, 0.0 and 1.0: each sum and each product is one of two numbers of one type.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from textwrap import indent
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pwatrack.export.source import Source

PRODUCT = "product"  # every product of floats is assigned to it before it is added to anything
Kind = Literal["real", "whole", "side", "flag"]  # sides are -1, 0, 1; whole numbers have 32 bits
_SHORT = {
    "H": "normals",
    "h": "offsets",
    "x_d": "desired",
    "u_ff": "feedforward",
    "K": "gain",
}  # no two alike but for case


@dataclass(frozen=True)
class Variable:
    """What is remembered, or worked with: its name, type, length (0: one number), and what it is."""

    name: str
    kind: Kind
    length: int = 0
    what: str = ""


@dataclass(frozen=True)
class Step:
    """A controller that runs once in a sample time.

    Attributes:
        constants: Arrays and numbers, by name.
        kept: What it remembers. From its start all of it is 0 that `begin` does not set.
        own: What it works with.
        begin: What makes it start anew, in the notation.
        body: One step, from `y`, and `given` if the reference is from outside; the input is `u`.
        hold: What puts the input out that is held: `body` ends with it.
    """

    constants: dict[str, tuple[Kind, NDArray[Any]]]
    kept: tuple[Variable, ...]
    own: tuple[Variable, ...]
    begin: str
    body: str
    hold: str


def step(source: Source) -> Step:
    """Return the step of a controller."""
    of, late = source.program.sizes, source.program.sampling.delay
    n, m, s = of["n"], of["m"], of["s"]
    memory = of["q"] + m + of["N"] + of["p"] + s
    kept: tuple[Variable, ...] = (
        Variable("v", "real", memory, "y, u, x_hat, s_hat, eta_hat, w"),
        Variable("copies", "real", source.copies * s, "of w, renewed every 2^10 and 2^20 samples"),
        Variable("late", "real", late * m, "inputs that wait to be put out, the next one first"),
        Variable("before", "real", m, "inputs computed last, limited"),
        Variable("wanted", "real", m, "inputs wanted before they were limited"),
        Variable("x_d", "real", n, "desired state"),
    )
    kept = tuple(variable for variable in kept if variable.length)
    own = [Variable(f"new_{variable.name}", "real", variable.length) for variable in kept]
    numbers = [Variable("tick", "whole", what="samples so far")] if source.counted else []
    numbers += [Variable("since", "whole", what="samples since the reference began anew")] if source.copies else []
    numbers += (
        [Variable("piece", "whole", what="pieces of the reference so far")] if "piece_tick" in source.whole else []
    )
    numbers += [Variable("cell", "whole", what="cell of x_hat, from 0")]
    numbers += [Variable("cell_d", "whole", what="cell of x_d, from 0"), Variable("status", "whole", what=_STATUS)]
    own += [Variable(f"new_{variable.name}", "whole") for variable in numbers]
    own += [Variable("g", "real", max(len(source.program.h), len(source.program.guards)))]
    own += [Variable("source", "real", s)] if source.follows is not None else []
    own += [Variable(name, "whole") for name in ("a", "b", "i", "k", "level")]
    own += [Variable(name, "real") for name in ("total", "product", "difference", "worst", "least", "value", "last")]
    hold = "\n".join(_hold(source))
    return Step(
        constants=_constants(source),
        kept=(*kept, *numbers, Variable("started", "flag", what="whether it has run")),
        own=(*(variable for variable in own if variable.length or variable.name != "g"), Variable("fine", "flag")),
        begin="\n".join(_begin(source, kept, numbers)),
        body="\n".join(_body(source, kept, numbers, hold)),
        hold=hold,
    )


_STATUS = "0; 1: the reference has ended; -1: not finite, and the last input is held; -2: overwritten, and u is 0"


def _constants(source: Source) -> dict[str, tuple[Kind, NDArray[Any]]]:
    program, finfo = source.program, np.finfo(source.real)
    found: dict[str, tuple[Kind, NDArray[Any]]] = {
        _SHORT.get(name, name): ("real", values.astype(source.real)) for name, values in source.tables.items()
    }
    kinds: dict[str, Kind] = {"signs": "side", "sides": "side"}
    found |= {name: (kinds.get(name, "whole"), values) for name, values in source.whole.items()}
    bounds = {"low": program.limits[:, 0], "high": program.limits[:, 1], "change": program.change}
    bounds["quantum"] = np.where(program.quantum > 0, program.quantum, np.inf)
    for name, values in bounds.items():
        if np.isfinite(values).any():
            found[name] = ("real", np.where(np.isfinite(values), values, 0.0).astype(source.real))
    found["largest"] = ("real", np.array(finfo.max))
    if (program.quantum > 0).any():
        found["half"] = ("real", np.array(0.5, dtype=source.real))
        found["all_whole"] = ("real", np.array(2.0**finfo.nmant, dtype=source.real))  # from here on there are no halves
    return found


def _begin(source: Source, kept: Iterable[Variable], numbers: Iterable[Variable]) -> Iterator[str]:
    of = source.program.sizes
    X, E = of["q"] + of["m"], of["q"] + of["m"] + of["N"]
    for variable in kept:
        yield _loop("k", variable.length, f"{variable.name}[k] = 0.0")
    starts = [("start_x_hat", f"v[{X} + k]", of["N"]), ("start_eta_hat", f"v[{E} + k]", of["p"])]
    if source.follows is not None:
        starts.append(("start_w", f"v[{E + of['p']} + k]", of["s"]))
        starts += [("start_w", f"copies[{_at(copy * of['s'], 'k')}]", of["s"]) for copy in range(source.copies)]
    for table, place, length in starts:
        yield _loop("k", length, f"{place} = {table}[k]")
    for number in numbers:
        yield f"{number.name} = 0"
    yield "started = False"


def _body(source: Source, kept: Iterable[Variable], numbers: Iterable[Variable], hold: str) -> Iterator[str]:
    """Yield a step, unless a number that is an index was overwritten: then the answer to that."""
    program = source.program
    below = {"cell": len(program.signs), "cell_d": len(program.sides), "since": 2 ** (10 * source.copies)}
    below["piece"] = len(source.whole.get("piece_tick", ())) + 1
    inside = [f"({v.name} >= 0) and ({v.name} < {below[v.name]})" for v in numbers if v.name in below]
    made = "\n".join(filter(None, [*_next(source, kept, numbers), hold]))
    yield f"if {' and '.join(inside)}:\n{indent(made, '    ')}"
    zeros = _loop("b", program.sizes["m"], "u[b] = 0.0")
    yield f"else:\n    'Overwritten.'\n    status = -2\n{indent(zeros, '    ')}"


def _hold(source: Source) -> Iterator[str]:
    """Yield what puts out the input that is held, and 0 where that is no number."""
    place = f"v[{source.program.sizes['q']} + b]"
    yield _loop("b", source.program.sizes["m"], f"u[b] = {place}\nif not {_finite(place)}:\n    u[b] = 0.0")


def _next(source: Source, kept: Iterable[Variable], numbers: Iterable[Variable]) -> Iterator[str]:
    program, of = source.program, source.program.sizes
    q, m, n, N, p, s = (of[name] for name in ("q", "m", "n", "N", "p", "s"))
    X, S, E, known = q + m, q + m + n, q + m + N, N - n + p + s
    for variable in kept:
        yield _loop("k", variable.length, f"new_{variable.name}[k] = {variable.name}[k]")
    for number in numbers:
        yield f"new_{number.name} = " + (number.name if number.name != "status" else "0")
    once = ["'1. Observer and generator, one sample later.'"]
    once.append(_loop("a", N, _row(f"new_v[{X} + a]", "observer", "cell, a", "v", 0, E)))
    once.append(_loop("a", p, _row(f"new_v[{E} + a]", "generator", "cell_d, a", "v", S, known)))
    once += ["'2. Reference.'", *_advance(source)] if source.follows is not None else []
    yield "if started:\n" + indent("\n".join(filter(None, once)), "    ")
    yield "'3. Measurement.'\n" + _loop("a", q, "new_v[a] = y[a]")
    if source.given:
        yield _loop("a", s, f"new_v[{E + p} + a] = given[a]")
    if len(program.h):
        yield "'4. Cell of x_hat: the first one whose signs are contradicted least.'"
        yield _loop("a", len(program.h), _row("g[a]", "normals", "a", "new_v", X, n, "offsets[a]"))
        yield _cell("new_cell", "signs", *program.signs.shape)
    if len(program.guards):
        yield "'4. Cell of x_d.'"
        yield _loop("a", len(program.guards), _row("g[a]", "guards", "a", "new_v", S, known))
        yield _cell("new_cell_d", "sides", *program.sides.shape)
    yield "'5. Desired state.'"
    yield _loop("a", n, _row("new_x_d[a]", "desired", "new_cell_d, a", "new_v", S, known))
    yield "fine = True"
    for b in range(m):
        yield f"'6. Law: input {b}.'\n" + _row("value", "feedforward", f"new_cell_d, {b}", "new_v", S, known)
        law = f"difference = new_v[{X} + a] - new_x_d[a]\nproduct = gain[{b}, a] * difference\nvalue = value + product"
        yield _loop("a", n, law)
        yield from _limited(source, b)
    yield "'Nothing is changed unless all of it is finite.'"
    for variable in kept:
        if variable.name in ("v", "copies", "late", "x_d"):
            yield _loop("k", variable.length, _checked(f"new_{variable.name}[k]"))
    done = [_loop("k", variable.length, f"{variable.name}[k] = new_{variable.name}[k]") for variable in kept]
    done += [f"{number.name} = new_{number.name}" for number in numbers]
    done.append("started = True")
    yield "if fine:\n" + indent("\n".join(done), "    ") + "\nelse:\n    status = -1"


def _loop(index: str, count: int, body: str, first: int = 0) -> str:
    """Return a loop, or nothing where it does not run."""
    return f"for {index} in range({first}, {count}):\n{indent(body, '    ')}" if count > first else ""


def _at(first: int, index: str) -> str:
    """Return an index that begins with a number."""
    return f"{first} + {index}" if first else index


def _row(target: str, table: str, place: str, vector: str, first: int, count: int, constant: str = "") -> str:
    """Return a row of a table applied to so many entries of a vector, and a constant: its last entry."""
    constant = constant or f"{table}[{place}, {count}]"
    if not count:
        return f"{target} = {constant}"
    more = f"product = {table}[{place}, k] * {vector}[{_at(first, 'k')}]\ntotal = total + product"
    lines = [f"product = {table}[{place}, 0] * {vector}[{first}]", "total = product", _loop("k", count, more, 1)]
    return "\n".join(filter(None, [*lines, f"{target} = total + {constant}"]))


def _checked(value: str) -> str:
    """Return what finds a number that is not finite: of one that is no number, every comparison is false."""
    return f"if not {_finite(value)}:\n    fine = False"


def _finite(value: str) -> str:
    return f"(({value} >= -largest) and ({value} <= largest))"


def _cell(target: str, table: str, cells: int, count: int) -> str:
    """Return the search for the first cell whose signs g contradicts least."""
    one = f"""\
if ({table}[i, k] > 0) and (-g[k] > worst):
    worst = -g[k]
if ({table}[i, k] < 0) and (g[k] > worst):
    worst = g[k]"""
    better = f"if (i == 0) or (worst < least):\n    {target} = i\n    least = worst"
    return "least = 0.0\n" + _loop("i", cells, "\n".join(["worst = 0.0", _loop("k", count, one), better]))


def _advance(source: Source) -> list[str]:
    """Return the step of the reference."""
    follows, of, copies = source.follows, source.program.sizes, source.copies
    assert follows is not None
    s, W = of["s"], of["q"] + of["m"] + of["N"] + of["p"]
    lines = ["level = 0"]
    if source.counted:
        last = follows.end if follows.end is not None else follows.pieces[-1].tick  # no more is asked of it
        lines.append(f"if tick <= {last}:\n    new_tick = tick + 1")
    if copies:
        lines.append("new_since = since + 1\nif new_since % 1024 == 0:\n    level = 1")
        level = "    level = 2\n" if copies == 2 else ""
        lines.append(f"if new_since == {2 ** (10 * copies)}:\n{level}    new_since = 0")
    lines.append(_loop("k", s, f"source[k] = v[{W} + k]"))
    if copies:
        older = _loop("k", s, f"source[k] = copies[level * {s} - {s} + k]")
        lines.append("if level > 0:\n" + indent(older, "    "))
    more = "product = turn[level, a, k] * source[k]\ntotal = total + product"
    turned = ["product = turn[level, a, 0] * source[0]", "total = product", _loop("k", s, more, 1)]
    turned.append(f"new_v[{W} + a] = total")
    turned += [_loop("k", copies, f"if k < level:\n    new_copies[k * {s} + a] = total")]
    lines.append(_loop("a", s, "\n".join(filter(None, turned))))
    if follows.pieces:
        lines.append(_pieces(source, W, s))
    if follows.end is None:
        return lines
    return [f"if tick >= {follows.end}:\n    new_status = 1\nelse:\n" + indent("\n".join(lines), "    ")]


def _pieces(source: Source, W: int, s: int) -> str:
    """Return what sets w where pieces begin: at most so many at a tick."""
    ticks = source.whole["piece_tick"]
    sets = f"""\
if (a >= piece_start[new_piece]) and (a < piece_start[new_piece] + piece_length[new_piece]):
    new_v[{W} + a] = piece_values[piece_value[new_piece] - piece_start[new_piece] + a]"""
    lines = [_loop("a", s, sets)]
    lines += [_loop("k", s, f"new_copies[{_at(copy * s, 'k')}] = new_v[{W} + k]") for copy in range(source.copies)]
    lines += ["new_since = 0"] * bool(source.copies) + ["new_piece = new_piece + 1"]
    begins = "if piece_tick[new_piece] == new_tick:\n" + indent("\n".join(lines), "    ")
    most = int(np.unique(ticks, return_counts=True)[1].max())
    return _loop("b", most, f"if new_piece < {len(ticks)}:\n" + indent(begins, "    "))


def _limited(source: Source, b: int) -> Iterator[str]:
    """Yield the limits of an input, its steps, and what is put out."""
    program, of = source.program, source.program.sizes
    m, late, before = of["m"], program.sampling.delay, f"new_before[{b}]"

    yield f"'7. Limits: input {b}.'\nlast = value - {before}\n{_checked('last')}"
    if np.isfinite(program.change[b]):
        yield f"last = {before} - change[{b}]\ndifference = {before} + change[{b}]"
        yield "if value < last:\n    value = last\nelif value > difference:\n    value = difference"
    yield f"new_wanted[{b}] = value"
    bounds = zip("<>", ("low", "high"), program.limits[b].tolist(), strict=True)
    cuts = [
        f"if value {sign} {name}[{b}]:\n    value = {name}[{b}]" for sign, name, bound in bounds if np.isfinite(bound)
    ]
    yield "\nel".join(cuts)
    yield f"{before} = value"
    if program.quantum[b] > 0:
        yield f"total = value / quantum[{b}]\ntotal = total + half\n{_FLOOR}"
        yield f"product = quantum[{b}] * product\nvalue = product"
    yield f"'8. Put out: input {b}.'"
    place = f"new_v[{of['q'] + b}]"
    yield f"{place} = late[{b}]" if late else f"{place} = value"
    for k in range(late - 1):
        yield f"new_late[{k * m + b}] = late[{(k + 1) * m + b}]"
    if late:
        yield f"new_late[{(late - 1) * m + b}] = value"


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
