"""A plant and a tracking problem from arrays: the sections of a file, by the names of arguments."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pwatrack.arrays import amount
from pwatrack.errors import InvalidSpec, Subject
from pwatrack.model.pwa import PWASystem
from pwatrack.spec.load import read_plant, read_spec
from pwatrack.spec.spec import Spec
from pwatrack.spec.yaml_tree import document_of, subscripts

Entries = Any  # an array, or lists of numbers, fractions and texts in each other
_SIGNS: Mapping[float, str] = {1: "+", -1: "-", 0: "0"}


class Plant:
    """A continuous piecewise affine plant from arrays: x' = A_i x + b_i + B u for x in cell i, y = C x (1).

    Every entry is a number, a fraction, or a text such as "-k/m" in the parameters. A number means the shortest decimal
    that is read as the same double: 0.1 is 1/10. Jumps of the field by rounding are repaired, as in a file.

    Attributes:
        system: The plant as everything else here knows it: A (l, n, n), b (l, n), B (n, m), C (q, n), all of them also
            in exact numbers; cells and facets.
        sections: The sections of a file that say the same, as text.

    Args:
        linear: A linear plant as it is elsewhere, in place of A, B, C and names: a StateSpace of python-control or of
            scipy.signal, in continuous time and without D.
        A: One matrix for each cell, (l, n, n); or one, (n, n), for a linear plant and with `nonlinearities`.
        B: Input matrix, the same in all cells, (n, m); or of one input (n,).
        C: What is measured, (q, n); or of one output (n,).
        b: One vector for each cell, (l, n), or one, (n,); 0 where nothing is given.
        H: Normals of the hyperplanes H x + h = 0, (k, n).
        h: Their offsets, (k,); 0 where nothing is given.
        signs: For each cell the sides of the hyperplanes that it is on, (l, k): 1 where H x + h ≥ 0, −1 where it is
            ≤ 0, 0 where it may be either.
        where: Instead of these, for each cell its inequalities as text, such as ["z >= 0.05"].
        cells: Names of the cells; "A[0]", "A[1]", … where nothing is given.
        nonlinearities: Scalar elements instead of cells, such as {"name": "stop", "kind": "spring", "of": "z", "start":
            0.1, "slope": 50, "into": {"v": -1}}: as in a file.
        states, inputs, outputs: Names; x1, x2, …, u (or u1, …) and y (or y1, …) where nothing is given.
        track: Names of the outputs that are to follow a reference, or forms of the states by name; all outputs where
            nothing is given.
        units: By name of a state, input or output.
        sizes: Deviation that matters, by name, in its unit.
        parameters: Numbers by name, for the entries that are text, and to vary in an ensemble.
        tolerance: For the continuity of rounded data, relative.

    Raises:
        InvalidSpec: With everything that is not well formed, each by the name of its argument, counted from 0.
        OutsideTheory: If cells overlap or leave a hole, or the field is not continuous.

    Example: a mass with a stop, in two cells.

        >>> from pwatrack import plant
        >>> stop = plant(
        ...     A=[[[0, 1], [-1, -1]], [[0, 1], [-3, -1]]], b=[[0, 0], [0, 0.1]], B=[[0], [1]], C=[[1, 0]],
        ...     H=[[1, 0]], h=[-0.05], signs=[[-1], [1]], states=["z", "v"],
        ... )
        >>> stop.system.cell_names, stop.system.b.tolist()
        (('A[0]', 'A[1]'), [[0.0, 0.0], [0.0, 0.1]])
        >>> plant(A=[[0, 1], [-1, -1]], B=[0, 1], C=[1, 0])
        <plant with 1 cell, n = 2, m = 1, q = 1>
        >>> plant(A=[[0, 1], [-1, "-d"]], B=[[0, 1]], C=[[1, 0]])
        Traceback (most recent call last):
        pwatrack.errors.InvalidSpec: A[1][1]: unknown name 'd'
        B: 1 row, expected 2, one for each of the states
    """

    system: PWASystem
    sections: Mapping[str, Any]

    def __init__(
        self,
        linear: Any = None,
        *,
        A: Entries | None = None,
        B: Entries | None = None,
        C: Entries | None = None,
        b: Entries | None = None,
        H: Entries | None = None,
        h: Entries | None = None,
        signs: Entries | None = None,
        where: Sequence[str | Sequence[str]] | None = None,
        cells: Sequence[str] | None = None,
        nonlinearities: Sequence[Mapping[str, Any]] | None = None,
        states: Sequence[str] | None = None,
        inputs: Sequence[str] | None = None,
        outputs: Sequence[str] | None = None,
        track: Sequence[str] | Mapping[str, str] | None = None,
        units: Mapping[str, str] | None = None,
        sizes: Mapping[str, Any] | None = None,
        parameters: Mapping[str, Any] | None = None,
        tolerance: Any = None,
    ) -> None:
        known = {name: v for name, v in {"A": A, "B": B, "C": C}.items() if v is not None}
        if linear is not None:
            known, named = _of_system(linear, known)
            states, inputs, outputs = (
                one or other for one, other in zip((states, inputs, outputs), named, strict=True)
            )
        if missing := [name for name in "ABC" if name not in known]:
            raise InvalidSpec(*(f"plant: {name} is missing: A, B and C are needed" for name in missing))
        A, B, C = known["A"], known["B"], known["C"]
        if len(_shape(B)) == 1:
            B = [[entry] for entry in _plain(B)]
        if len(_shape(C)) == 1:
            C = [_plain(C)]
        shape = _shape(A)
        system: dict[str, Any] = {
            "states": _names("x", shape[-1:]) if states is None else states,
            "inputs": _names("u", _shape(B)[1:]) if inputs is None else inputs,
            "outputs": _names("y", _shape(C)) if outputs is None else outputs,
            "track": track,
            "units": units,
            "sizes": sizes,
        }
        if len(shape) == 3 or any(each is not None for each in (signs, where, cells)):
            system["cells"] = _cells({"A": A, "b": b, "signs": signs, "where": where, "name": cells})
        else:
            system |= {"A": A, "b": b}
        system |= {"B": B, "C": C}
        if H is not None or h is not None:
            system["hyperplanes"] = _rows({"H": H, "h": h})
        system["nonlinearities"] = nonlinearities
        repaired = None if tolerance is None else {"continuity": tolerance}
        document = document_of({"parameters": parameters, "system": system, "tolerance": repaired}, argument)
        self.system, self.sections = read_plant(document), document.data

    def __repr__(self) -> str:
        plant = self.system
        (n, m), q = plant.B.shape, len(plant.C)
        return f"<plant with {amount(len(plant.A), 'cell')}, n = {n}, m = {m}, q = {q}>"


plant = Plant  # as who calls it says


def problem(
    plant: Plant,
    *,
    reference: str | Mapping[str, Any],
    simulation: Mapping[str, Any],
    tracking: str | None = None,
    controller: Mapping[str, Any] | None = None,
    observer: Mapping[str, Any] | None = None,
    estimate: str | Mapping[str, Any] | None = None,
    uncertain: Mapping[str, Any] | None = None,
    solver: str | None = None,
    require: Mapping[str, Any] | None = None,
    name: str = "from arrays",
    description: str | None = None,
) -> Spec:
    """Return a tracking problem: what `design` and `simulate` take, and `load_spec` reads from a file.

    Every argument is a section of a file, or an entry of its section `design`, and takes the same:
    see docs/reference/spec_file.md.

    Args:
        plant: What `plant` returned.
        reference: {"output": …}, or for state tracking {"state": …}, {"input": …} or {"setpoint": …}; a text is the
            formula of the one output in t (s).
        simulation: {"duration": s, "sample_time": s}, and starts, limits, disturbances, noise, a sampled controller …
        tracking: "output" (Theorem 3), "state" (Theorem 2) or "practical".
        controller: What is asked of K (m, n): nothing, or {"rate": 1/s}, {"gain": bound}, {"cost": {"Q": (n, n), "R":
            (m, m)}} or {"K": (m, n)}, which is proved.
        observer: Likewise of L (n, q).
        estimate: Unknown loads by name, or "input".
        uncertain: Intervals of parameters, by name.
        solver: "structured", "clarabel" or "cvxopt"; see `lmi.solve`.
        require: Limits that figures of design and run have to keep.
        name, description: Title of the problem, and a text that goes with it.

    Raises:
        InvalidSpec: With everything that is not well formed, each by the name of its argument.

    Example:
        >>> lag = Plant(A=[[-1]], B=[[1]], C=[[1]])
        >>> spec = problem(lag, reference="sin(t)", simulation={"duration": 10, "sample_time": 0.1})
        >>> spec.problem.tracking, spec.scenario.duration
        ('output', 10.0)
    """
    if not isinstance(plant, Plant):
        message = f"plant: a {type(plant).__name__} is none: what plant(A=…, B=…, C=…) returns is expected"
        raise InvalidSpec(message, subject=None)
    design = {"tracking": tracking, "controller": controller, "observer": observer}
    design |= {"estimate": estimate, "solver": solver, "uncertain": uncertain}
    asked = {"output": reference} if isinstance(reference, str) else reference
    sections = {"name": name, "description": description, **plant.sections, "design": design}
    sections |= {"reference": asked, "simulation": simulation, "require": require}
    return read_spec(document_of(sections, argument), outside=True, plant=plant.system)


def argument(subject: Subject) -> str:
    """Return how the value of a path in a file is called among the arguments of `plant` and `problem`."""
    match subject:
        case ("system", "cells" | "hyperplanes", int(number), str(name), *rest):
            name, steps = "cells" if name == "name" else name, (number, *rest)
        case ("system", "hyperplanes", *rest):
            name, steps = "H", tuple(rest)
        case ("tolerance", "continuity", *rest):
            name, steps = "tolerance", tuple(rest)
        case ("system" | "design", str(name), *rest) | (str(name), *rest):
            steps = tuple(rest)
        case _:
            return "problem"
    return ("plant" if name == "system" else name) + subscripts(steps)


def _of_system(linear: Any, given: Mapping[str, Any]) -> tuple[dict[str, Any], list[list[str] | None]]:
    """Return A, B and C of a linear system of python-control or scipy.signal, and its names where it has some."""
    parts = {name: getattr(linear, name, None) for name in "ABCD"}
    if any(value is None for value in parts.values()):
        kind = type(linear).__name__
        raise InvalidSpec(f"plant: a {kind} is no linear system: a StateSpace with A, B, C, D, or A=…, B=…, C=…")
    faults = [f"plant: {name} is given beside a system that has one" for name in given]
    if getattr(linear, "dt", None) not in (None, 0):
        faults.append(f"plant: the system is sampled every {linear.dt} s: one in continuous time is expected")
    if np.any(parts.pop("D")):
        faults.append("plant: D is not 0: an output that an input reaches at once is no y = C x of (1)")
    if faults:
        raise InvalidSpec(*faults)
    labels = [list(getattr(linear, f"{kind}_labels", None) or ()) for kind in ("state", "input", "output")]
    return parts, [names if names and all(map(str.isidentifier, names)) else None for names in labels]


def _cells(given: Mapping[str, Any]) -> Any:
    """Return a section for each cell, as many as the longest argument has."""
    cells = _rows(given)
    for number, cell in enumerate(cells):
        cell.setdefault("name", f"A[{number}]")
        if isinstance(signs := _plain(cell.get("signs")), list | tuple):
            cell["signs"] = [_SIGNS.get(sign, sign) if isinstance(sign, int | float) else sign for sign in signs]
        if isinstance(cell.get("where"), str):
            cell["where"] = [cell["where"]]
    return cells


def _rows(given: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return mappings: entry number k of each argument in the one with that number."""
    lists = {name: _plain(value) for name, value in given.items() if value is not None}
    lists = {name: value if isinstance(value, list | tuple) else [value] for name, value in lists.items()}
    most = max(map(len, lists.values()))
    return [{name: values[k] for name, values in lists.items() if k < len(values)} for k in range(most)]


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else value


def _shape(value: Any, most: int = 4) -> tuple[int, ...]:
    """Return how long lists in each other are, along first entries, so many of them at most."""
    value = _plain(value)
    return (len(value), *_shape(value[0], most - 1)) if isinstance(value, list | tuple) and value and most else ()


def _names(letter: str, shape: tuple[int, ...]) -> list[str]:
    count = shape[0] if shape else 1
    return [letter] if count == 1 and letter != "x" else [f"{letter}{k + 1}" for k in range(count)]
