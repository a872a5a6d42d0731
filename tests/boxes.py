"""Random plants with uncertain parameters wherever a number can stand, and their field read without the package.

What is said of a box is held against this field: expressions are Python's, elements are written out from the manual.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from scipy.optimize import nnls

from pwatrack import design, load_spec
from pwatrack.arrays import Array
from pwatrack.claims.robust import Robust
from pwatrack.control.controller import ProvedController
from pwatrack.errors import OutsideTheory, PwatrackError, Undecided

_SECONDS, _STEP = 4.0, 0.04  # of a simulation: the slowest loops here settle in a second, the fastest in a tenth of one


def random_spec(seed: int) -> dict[str, Any]:
    """Return a spec of one or two states, as a mapping: each number may depend on up to three parameters."""
    rng = np.random.default_rng(seed)
    n, write = int(rng.integers(1, 3)), _Writer(rng)
    states = [f"x{k + 1}" for k in range(n)]
    A = [[write.number(0.4) if j != k else f"-6 + {write.number(0.4)}" for j in range(n)] for k in range(n)]
    b, one = [write.number(0.4) for _ in states], [[f"{v:.2f}" for v in rng.uniform(0.5, 1, n)]]
    b[0] += "".join(f" + 0.05*{write.term(name)}" for name in write.values)  # all of them are in the plant
    system: dict[str, Any] = {"states": states, "inputs": ["u"], "outputs": ["y"], "C": one}
    system["B"] = [[f"1 + {write.number(0.3)}"] if not k else [write.number(0.3)] for k in range(n)]
    if rng.random() < 0.03:
        system["C"] = [[write.number(1.0) for _ in states]]
    if rng.random() < 0.3:
        at, side = round(float(rng.uniform(-1, 1)), 2), [write.number(0.4) for _ in states]
        bent = [[f"({A[j][0]}) + ({side[j]})", *A[j][1:]] for j in range(n)]
        moved = [f"({b[j]}) - {at}*({side[j]})" for j in range(n)]
        low = {"name": "low", "where": [f"x1 <= {at}"], "A": A, "b": b}
        system["cells"] = [low, {"name": "high", "where": [f"x1 >= {at}"], "A": bent, "b": moved}]
    else:
        count = int(rng.integers(1, 3))
        system |= {"A": A, "b": b, "nonlinearities": [_element(write, states, k) for k in range(count)]}
    gains = {"controller": {"K": [rng.uniform(-1, 0, n).round(2).tolist()]}, "observer": {"L": [[-0.5]] * n}}
    shares = {name: [f"{0.8 * v:.3f}", f"{1.3 * v:.3f}"] for name, v in write.values.items()}
    return {
        "name": "random box",
        "parameters": {**write.values, "twice": f"2*{write.term('p0')}", "both": write.both},
        "system": system,
        "design": {"tracking": "state", "uncertain": shares, **gains},
        "reference": {"input": [{"sine": {"amplitude": 1, "frequency": 2}}], "start": [0] * n},
        "simulation": {"duration": 1, "sample_time": 0.1},
    }


class _Writer:
    """Writes numbers: mostly with one power of each parameter in a file, so that some files can be proved."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.values = {f"p{k}": round(float(rng.uniform(0.6, 2)), 2) for k in range(int(rng.integers(1, 4)))}
        self.powers = {name: int(rng.choice([1, 1, 1, -1, -1, 2])) for name in self.values}
        self.odd = float(rng.choice([0.0, 0.0, 0.1]))  # how often another power is written
        self.often = float(rng.choice([0.1, 0.3, 0.6]))  # how often there is a parameter at all
        self.both = "*".join(self.term(name) for name in list(self.values)[:2])

    def term(self, name: str) -> str:
        power = int(self.rng.choice([-2, -1, 1, 2])) if self.rng.random() < self.odd else self.powers[name]
        return {1: name, -1: f"(1/{name})", 2: f"{name}**2", -2: f"{name}**(-2)"}[power]

    def number(self, size: float) -> str:
        """Return a number or expression of about this size."""
        c, rng = round(float(rng_sign(self.rng) * self.rng.uniform(0.2, 1) * size), 2), self.rng
        if rng.random() > self.often:
            return f"{c}"
        names = rng.permutation(list(self.values)).tolist()
        forms = [f"{c}*{self.term(names[0])}"] * 4
        forms += [f"{c} + 0.1*{self.term(names[0])}", f"{c}*({self.term(names[0])} - 0.5)", f"{c}*twice", f"{c}*both"]
        forms += [f"{c}*{'*'.join(self.term(name) for name in names)}", f"{c}*{names[0]}/{names[0]}"]
        forms += [f"{c}*sqrt({names[0]})", f"{c}/(1 + {names[0]})"] if rng.random() < self.odd else []
        return str(rng.choice(forms))


def rng_sign(rng: np.random.Generator) -> int:
    """Return 1 or -1."""
    return int(rng.choice([-1, 1]))


def _element(write: _Writer, states: Sequence[str], number: int) -> dict[str, Any]:
    rng = write.rng
    kind = str(rng.choice(["dead_zone", "saturation", "spring", "absolute", "piecewise_linear"]))
    marks = sorted(rng.choice(np.arange(-20, 20), 2, replace=False) / 10)
    ends = [write.number(1.0) if rng.random() < 0.02 else f"{mark}" for mark in marks]
    of = [states[0], f"{states[0]} + 0.3", f"2*{states[-1]} - 0.4", " - ".join(states)][int(rng.integers(4))]
    into = [s for s in states if rng.random() < 0.7] or [states[0]]
    split = str(rng.choice(list(write.values))) if rng.random() < 0.4 else ""  # its power stands in two factors
    part = int(rng.choice([-1, 1, 2]))

    def factor(size: float, power: int) -> str:
        c = f"{write.rng.uniform(0.2, 0.8) * size:.2f}"
        return write.number(size) if not split else c if rng.random() < 0.2 or not power else f"{c}*{split}**({power})"

    def shape() -> str:
        return factor(0.8, write.powers.get(split, 0) - part)

    found: dict[str, Any] = {"name": f"e{number}", "kind": kind, "of": of, "into": {s: factor(0.8, part) for s in into}}
    if kind in ("dead_zone", "saturation"):
        found |= {"lower": ends[0], "upper": ends[1]}
    if kind == "spring":
        found["start"] = ends[0]
    if kind == "piecewise_linear":
        found |= {"breakpoints": ends, "slopes": [shape() for _ in range(3)]}
        found |= {"value": shape()} if rng.random() < 0.5 else {}
    elif rng.random() < 0.8:
        found["slope"] = shape()
    if kind == "dead_zone" and rng.random() < 0.5:
        found["lower_slope"] = shape()
    return found


@dataclass(frozen=True)
class Plant:
    """The plant of a spec with some values of its parameters: x (N, n) -> f(x) (N, n), and B (n, 1)."""

    f: Callable[[Array], Array]
    B: Array
    C: Array


def plant_of(spec: Mapping[str, Any], values: Mapping[str, float]) -> Plant:
    """Return the plant of a spec with some parameters changed."""
    known: dict[str, Any] = {"sqrt": math.sqrt}
    for name, text in spec["parameters"].items():
        known[name] = values[name] if name in values else eval(str(text), {}, known)
    system = spec["system"]
    states = system["states"]

    def number(text: Any) -> float:
        return float(eval(str(text), {}, known))

    def matrix(rows: Any) -> Array:
        return np.array([[number(v) for v in row] for row in rows])

    def form(text: str, x: Array) -> Array:
        return np.asarray(eval(text, {}, known | dict(zip(states, x.T, strict=True))))

    cells = system.get("cells")
    pieces = [(matrix(part["A"]), np.array([number(v) for v in part["b"]])) for part in cells or [system]]
    elements = system.get("nonlinearities", [])
    into = [np.array([number(e["into"].get(state, 0)) for state in states]) for e in elements]
    functions = [_function(e, number) for e in elements]
    edge = number(cells[0]["where"][0].split("<=")[1]) if cells else math.inf

    def f(x: Array) -> Array:
        sides = [x @ A.T + b for A, b in pieces]
        base = sides[0] if len(sides) == 1 else np.where(x[:, :1] <= edge, *sides)
        triples = zip(elements, into, functions, strict=True)
        return np.asarray(base + sum(np.outer(phi(form(e["of"], x)), d) for e, d, phi in triples))

    return Plant(f, matrix(system["B"]), matrix(system["C"]))


def _function(element: Mapping[str, Any], number: Callable[[Any], float]) -> Callable[[Array], Array]:
    """Return φ as the manual has it."""
    slope = number(element.get("slope", 1))
    low, high = number(element.get("lower", 0)), number(element.get("upper", 0))
    left, start = number(element.get("lower_slope", slope)), number(element.get("start", 0))
    if element["kind"] == "dead_zone":
        return lambda s: left * np.minimum(s - low, 0) + slope * np.maximum(s - high, 0)
    if element["kind"] == "saturation":
        return lambda s: slope * np.clip(s, low, high)
    if element["kind"] == "spring":
        return lambda s: slope * np.maximum(s - start, 0)
    if element["kind"] == "absolute":
        return lambda s: slope * np.abs(s)
    first, last = (number(v) for v in element["breakpoints"])
    slopes = [number(v) for v in element["slopes"]]

    def from_first(s: Array) -> Array:
        bounded = np.clip(s, first, last) - first
        return slopes[0] * np.minimum(s - first, 0) + slopes[1] * bounded + slopes[2] * np.maximum(s - last, 0)

    value = number(element["value"]) if "value" in element else -float(from_first(np.zeros(1))[0])
    return lambda s: value + from_first(s)


@dataclass(frozen=True)
class Verdict:
    """What came of a random spec.

    Attributes:
        kind: "refused", "undecided" or "proved".
        said: The message of a refusal.
        outside: How far the plants inside the box are from the means of its corners, of their size.
        part: The largest share of its bound that an error or an input came to.
        real: The largest real part of an eigenvalue of a loop inside the box, plus the rate that is proved.
    """

    kind: str
    said: str
    outside: float
    part: float = 0.0
    real: float = -math.inf


def judge(seed: int, *, inner: int = 12) -> Verdict:
    """Design for a random spec, and hold what is said against plants inside its box and plants that change."""
    spec, rng = random_spec(seed), np.random.default_rng([seed, 1])
    box = {name: tuple(map(float, ends)) for name, ends in spec["design"]["uncertain"].items()}
    low, high = np.array(list(box.values())).T
    drawn = [dict(zip(box, low + (high - low) * share, strict=True)) for share in rng.random((inner, len(box)))]
    try:
        controller = design(load_spec(spec))
    except (OutsideTheory, Undecided, PwatrackError) as refusal:
        kind = "undecided" if isinstance(refusal, Undecided) else "refused"
        return Verdict(kind, str(refusal), _outside(spec, box, drawn, rng))
    outside = _outside(spec, box, drawn, rng)
    at_ends = [dict(zip(box, values, strict=True)) for values in product(*box.values())]
    plants = [plant_of(spec, values) for values in drawn + at_ends]
    nominal = plant_of(spec, {})
    return Verdict(
        "proved", "", outside, _part(controller, nominal, plants, rng), _real(controller, nominal, plants, rng)
    )


def _outside(spec: Any, box: Mapping[str, tuple[float, ...]], drawn: Any, rng: np.random.Generator) -> float:
    """Return how far fields inside the box are from the means of those at its corners, at random states."""
    x = rng.normal(size=(14, len(spec["system"]["states"]))) * np.geomspace(0.3, 30, 14)[:, None]

    def features(values: Mapping[str, float]) -> Array:
        plant = plant_of(spec, values)
        return np.concatenate([plant.f(x).ravel(), plant.B.ravel()])

    ends = np.array([features(dict(zip(box, values, strict=True))) for values in product(*box.values())]).T
    size, worst = np.abs(ends).max(), 0.0
    for values in drawn:
        wanted = np.append(features(values), size)
        _, left = nnls(np.vstack([ends, np.full(ends.shape[1], size)]), wanted)
        worst = max(worst, left / np.linalg.norm(wanted))
    return float(worst)


def _real(controller: ProvedController, nominal: Plant, plants: Sequence[Plant], rng: np.random.Generator) -> float:
    """Return the largest real part of an eigenvalue of (e, Δ)' = M (e, Δ), A by differences at random states."""
    K, L = controller.design.K, controller.design.L
    assert controller.claims_of(Robust)
    worst = -math.inf
    for plant in plants:
        one, other = rng.normal(size=(2, len(K[0]))) * 3
        A_p, A, A_hat = (_slope(f, at) for f, at in ((plant.f, one), (nominal.f, one), (nominal.f, other)))
        off = (nominal.B - plant.B) @ K
        M = np.block([[A_p + plant.B @ K, plant.B @ K], [A - A_p + off, A_hat + L @ nominal.C + off]])
        worst = max(worst, float(np.linalg.eigvals(M).real.max()))
    return worst + controller.claim(Robust).rate


def _slope(f: Callable[[Array], Array], x: Array, step: float = 1e-7) -> Array:
    return np.asarray((f(x + step * np.eye(len(x))) - f(x - step * np.eye(len(x)))).T / (2 * step))


def _part(controller: ProvedController, nominal: Plant, plants: Sequence[Plant], rng: np.random.Generator) -> float:
    """Return the largest part of its bound that a signal comes to from error 0, with plants that change at random."""
    K, L, robust, n = controller.design.K, controller.design.L, controller.claim(Robust), len(nominal.B)
    assert robust is not None
    z, w, seen = np.tile(rng.normal(size=n), 3)[None], np.zeros(n), dict.fromkeys(robust.bounds[0].sizes, 0.0)
    frequency, size, plant = rng.uniform(0.5, 6), rng.uniform(0.5, 5), plants[0]

    def u_ff(t: float) -> float:
        return float(size * math.sin(frequency * t) + 0.5 * size)

    def rate(t: float, z: Array) -> Array:
        x, x_hat, x_d = z[:, :n], z[:, n : 2 * n], z[:, 2 * n :]
        u = (x_hat - x_d) @ K.T + u_ff(t)
        observer = nominal.f(x_hat) + u @ nominal.B.T + (x_hat - x) @ nominal.C.T @ L.T
        return np.hstack([plant.f(x) + u @ plant.B.T, observer, nominal.f(x_d) + u_ff(t) * nominal.B.T])

    for k in range(int(_SECONDS / _STEP)):
        t, h = k * _STEP, _STEP
        if k % 10 == 0:
            plant = plants[int(rng.integers(len(plants)))]
        first = rate(t, z)
        second = rate(t + h / 2, z + h / 2 * first)
        third = rate(t + h / 2, z + h / 2 * second)
        w = np.maximum(
            w, np.abs(plant.f(z[:, 2 * n :]) - nominal.f(z[:, 2 * n :]) + u_ff(t) * (plant.B - nominal.B).T)[0]
        )
        z = z + h / 6 * (first + 2 * second + 2 * third + rate(t + h, z + h * third))
        errors = {"state": z[0, :n] - z[0, 2 * n :], "input": K @ (z[0, n : 2 * n] - z[0, 2 * n :])}
        errors["output"] = nominal.C @ errors["state"]
        for kind, j in seen:
            seen[kind, j] = max(seen[kind, j], abs(float(errors[kind][j])))
    bounds = robust.reached(1.02 * w + 1e-9)  # between steps w is a little larger
    return max(size / max(bounds[signal], 1e-12) for signal, size in seen.items())  # 0 / 0: w does not reach it
