"""A controller for MATLAB and Octave: functions that step it, and a .mat file of all that is known of it."""

from io import BytesIO
from pathlib import Path
from textwrap import indent, wrap
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.io import savemat

from pwatrack.export.controller import Controller
from pwatrack.export.notation import Language, names, printed
from pwatrack.export.source import Source, Vector, template, write_texts
from pwatrack.export.step import Step

_GIVEN = {"y": "y", "u": "u", "given": "ref"}
_HEADER = b"MATLAB 5.0 MAT-file, written by pwatrack".ljust(116)  # without the time at which it was
_FREE = ("units", "set")  # their keys are names of signals and parameters
_NAMES = {"end": "until"}  # what is no name in MATLAB
_NO_LIMIT = {"low": -np.inf, "high": np.inf, "change": np.inf}


def _named(found: Step) -> Language:
    """Return MATLAB, with what is remembered in `state` and constants in `t`."""
    kept = {variable.name for variable in found.kept}

    def name(text: str) -> str:
        if text in kept:
            return f"state.{text}"
        return f"t.{text}" if text in found.constants else _GIVEN.get(text, text)

    return Language(
        assign="{} = {};",
        loop="for {} = {}:{}\n{}\nend",
        branch="if {}\n{}\n",
        other="elseif {}\n{}\n",
        otherwise="else\n{}\n",
        end="end",
        words={"and": "&&", "or": "||", "not": "~", "True": "true", "False": "false"},
        remainder="mod({}, {})",
        name=name,
        element="{}({})",
        from_one=True,
        comment="% {}",
    )


def write(source: Source, vector: Vector, out: Path) -> list[str]:
    """Write the functions and the file to a folder and return their names."""
    return write_texts({**functions(source), f"{source.name}.mat": mat_file(source, vector)}, out)


def functions(source: Source) -> dict[str, str]:
    """Return the functions, by file name."""
    found, of, name = source.step, source.program.sizes, source.name
    language, used = _named(found), names(found.body)
    sizes = {"y": of["q"], "ref": len(source.program.given)} if source.given else {"y": of["q"]}
    checks = "\n".join(
        f"if numel({part}) ~= {size}\n    error('{name}:size', '{part} must have {size} entries');\nend"
        for part, size in sizes.items()
    )
    parts = ", ".join(f"'{variable.name}'" for variable in found.kept)
    error = f"    error('{name}:state', 'state must come from {name}_init')"
    checks = f"if ~isstruct(state) || ~all(isfield(state, {{{parts}}}))\n{error}\nend\n{checks}"
    own = [f"{v.name} = zeros({v.length}, 1);" for v in found.own if v.length and v.name in used]
    own.append(f"u = zeros({of['m']}, 1);")
    kept = [f"state.{v.name} = zeros({v.length}, 1);" for v in found.kept if v.length]
    tables = [f"known.{name} = {_table(values)};" for name, (_, values) in found.constants.items()]
    text = {
        "name": name,
        "ref": ", ref" if source.given else "",
        "w": ", vector.ref(k, :)" if source.given else "",
        "about": "\n".join(f"% {line}".rstrip() for line in source.about()),
        "checks": checks,
        "body": printed(found.body, language),
        "begin": printed(found.begin, language),
        "tables": indent("\n".join(tables), "    "),
    }
    zeros = {"init": "\n".join(kept), "step": "\n".join(own)}
    return {
        f"{name}_{part}.m": template(f"mat_{part}.m", **text, zeros=zeros.get(part, ""))
        for part in ("init", "step", "tables", "replay")
    }


def _table(values: NDArray[Any]) -> str:
    """Return an array; each float is the shortest decimal that gives it."""
    if not values.ndim:
        return repr(values.item())
    lines = " ...\n    ".join(wrap(", ".join(map(repr, values.reshape(-1, order="F").tolist())), 108))
    shape = ", ".join(map(str, values.shape if values.ndim > 1 else (values.size, 1)))
    return f"reshape([ ...\n    {lines}], [{shape}])"


def mat_file(source: Source, vector: Vector) -> bytes:
    """Return a file of version 5 with three variables: `controller`, `vector` and `not_proved`.

    `controller` has what controller.json has: vectors as columns, matrices as they are there, and of a stack of
    matrices the last index is that of the stack, which is the cell: A(:, :, i). Names are cells of text; units and
    replaced parameters have a row each, of name and value; null is [], a limit that there is not infinite, and `end`,
    which is no name in MATLAB, is `until`. Octave 7 cuts text with letters that are not ASCII at its end.
    """
    controller = Controller(source.file)
    u = [controller.step(y, w if source.given else None) for y, w in zip(vector.y, vector.w, strict=True)]
    known = {
        "controller": _content(source.file.model_dump()),
        "vector": {"y": vector.y, "ref": vector.w, "u": np.array(u), "origin": vector.origin},
        "not_proved": _content(list(source.unproved)),
        "failed": _content(list(source.file.failed)),
    }
    found = BytesIO()
    savemat(found, known, long_field_names=True, do_compression=True)  # type: ignore[arg-type]  # a file will do
    return _HEADER + found.getvalue()[len(_HEADER) :]


def _content(value: Any, key: str = "") -> Any:
    if isinstance(value, dict):
        if key in _FREE:
            return np.array(list(value.items()), dtype=object).reshape(-1, 2)
        return {_NAMES.get(name, name): _content(part, name) for name, part in value.items()}
    if value is None:
        return np.zeros((0, 0))
    if not isinstance(value, list):
        return value
    if key in _NO_LIMIT:
        value = [_NO_LIMIT[key] if entry is None else entry for entry in value]
    try:
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        cells = np.empty((len(value), 1), dtype=object)
        for k, part in enumerate(value):
            cells[k, 0] = _content(part)
        return cells
    if numbers.ndim == 1:
        return numbers[:, None]
    return np.moveaxis(numbers, 0, -1) if numbers.ndim > 2 else numbers
