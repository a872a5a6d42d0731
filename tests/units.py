"""The same spec in other units: what an engineer writes who measures in mm and ms."""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from pwatrack.control.synthesis import Gains
from pwatrack.model.sizes import Sizes

POWERS = [f"1e{k}" for k in range(-9, 10)]
ODD = ["0.0254", "0.3048", "101325", "60", "3600", "4.186", "1/3", "735.49875", "2*pi"]


@dataclass(frozen=True)
class Units:
    """What a new unit of each signal, and of time, is in the old one, as text: a length of 1 mm is 1e-3 m."""

    of: Mapping[str, str]
    time: str

    @classmethod
    def random(cls, path: Path, seed: int) -> "Units":
        random, system = np.random.default_rng(seed), tree(path)["system"]
        names = [name for kind in ("states", "inputs", "outputs", "track") for name in system.get(kind, [])]
        return cls({name: str(random.choice(POWERS + ODD)) for name in names}, str(random.choice(POWERS[4:15] + ODD)))

    def value(self, name: str) -> float:
        return float(eval(self.of[name], {"pi": np.pi}))

    @property
    def tick(self) -> float:
        return float(eval(self.time, {"pi": np.pi}))


def tree(path: Path) -> dict[str, Any]:
    content: dict[str, Any] = yaml.load(path.read_text(encoding="utf-8"), yaml.BaseLoader)
    return content


def in_units(path: Path, units: Units) -> str:
    """Return a spec with the same plant, reference and limits, and what is asked of the gains, in other units."""
    spec = tree(path)
    system, design, reference, simulation = (spec.get(k, {}) for k in ("system", "design", "reference", "simulation"))
    x, u, y = ([units.of[name] for name in system[kind]] for kind in ("states", "inputs", "outputs"))
    flow = [f"({units.time})/({d})" for d in x]
    if design.get("estimate") == "input":  # one for each input, which keeps its unit
        pairs = zip(system["inputs"], zip(*system["B"], strict=True), strict=True)
        design["estimate"] = {
            f"load_{name}": {"into": dict(zip(system["states"], column, strict=True))} for name, column in pairs
        }
    spec["system"] |= {
        "B": matrix(system["B"], flow, u),
        "C": matrix(system["C"], [f"1/({g})" for g in y], x),
        "sizes": {  # a load keeps its unit
            name: times(size, f"1/({units.of[name]})") if name in units.of else size
            for name, size in system.get("sizes", {}).items()
        },
    }
    for part in (system, *system.get("cells", [])):
        part |= {"A": matrix(part["A"], flow, x)} if "A" in part else {}
        part |= {"b": [times(v, f) for v, f in zip(part["b"], flow, strict=True)]} if "b" in part else {}
        part |= {"where": [form(text, units) for text in part["where"]]} if "where" in part else {}
    for plane in system.get("hyperplanes", []):
        plane["H"] = [times(v, d) for v, d in zip(plane["H"], x, strict=True)]
    for element in system.get("nonlinearities", []):
        element |= {key: form(element[key], units) for key in ("of", "rate") if key in element}
        element["into"] = {name: times(v, f"({units.time})/({units.of[name]})") for name, v in element["into"].items()}
    tracked = system.get("track", system["outputs"])
    if isinstance(tracked, dict):
        system["track"] = {k: times(form(text, units), f"1/({units.of[k]})") for k, text in tracked.items()}
    for load in design.get("estimate", {}).values():
        load["into"] = {name: times(v, f"({units.time})/({units.of[name]})") for name, v in load["into"].items()}
        load |= {"frequency": times(load["frequency"], units.time)} if "frequency" in load else {}
    for part, rows, columns in (("controller", u, x), ("observer", flow, y)):
        asked = design.get(part, {})
        for letter in ("K", "L"):
            if letter in asked:
                left = [f"1/({e})" for e in rows] if letter == "K" else rows
                asked[letter] = matrix(asked[letter], left, columns)
        for key in ("rate", "gain"):
            if re.match(r"[\d.]", asked.get(key, "")) and (key == "rate" or part == "observer"):
                asked[key] = times(asked[key], units.time)
        if part == "controller" and "cost" in asked:
            asked["cost"] = {"Q": matrix(asked["cost"]["Q"], x, x), "R": matrix(asked["cost"]["R"], u, u)}
        elif "cost" in asked:
            back = [f"({f})/({units.time})" for f in flow]
            asked["cost"] = {
                "Q": scaled(matrix(asked["cost"]["Q"], back, back), units.time),
                "R": scaled(matrix(asked["cost"]["R"], *[[f"1/({g})" for g in y]] * 2), f"1/({units.time})"),
            }
    for key, names in (("output", list(tracked)), ("state", system["states"]), ("input", system["inputs"])):
        if key in reference and isinstance(reference[key], dict) and set(reference[key]) <= set(names):
            reference[key] = {name: course(c, units.of[name], units.time) for name, c in reference[key].items()}
        elif key in reference:
            one = not isinstance(reference[key], list)
            given = [reference[key]] if one else reference[key]
            new = [course(c, units.of[name], units.time) for c, name in zip(given, names, strict=True)]
            reference[key] = new[0] if one else new
    if "setpoint" in reference:
        reference["setpoint"] = {k: times(v, f"1/({units.of[k]})") for k, v in reference["setpoint"].items()}
    spec["simulation"] = {k: times(simulation[k], f"1/({units.time})") for k in ("duration", "sample_time")}
    if "actuator" in simulation:
        limits = simulation["actuator"]["limits"].items()
        spec["simulation"]["actuator"] = {
            "limits": {name: [times(v, f"1/({units.of[name]})") for v in pair] for name, pair in limits}
        }
    return json.dumps(spec)


def form(text: str, units: Units) -> str:
    return re.sub(r"\b[A-Za-z_]\w*\b", lambda m: f"(({units.of[m[0]]})*{m[0]})" if m[0] in units.of else m[0], text)


def times(value: str, factor: str) -> str:
    return f"({value})*({factor})"


def matrix(rows: list[list[str]], left: list[str], right: list[str]) -> list[list[str]]:
    return [
        [times(v, f"({a})*({b})") for v, b in zip(row, right, strict=True)] for row, a in zip(rows, left, strict=True)
    ]


def scaled(rows: list[list[str]], factor: str) -> list[list[str]]:
    return [[times(v, factor) for v in row] for row in rows]


def course(given: Any, unit: str, time: str) -> Any:
    """Return a course with values in one unit and times in another."""
    if isinstance(given, str):
        return times(re.sub(r"\bt\b", f"(({time})*t)", given), f"1/({unit})")
    factors = {
        **dict.fromkeys(("constant", "amplitude", "size", "low", "high"), f"1/({unit})"),
        **dict.fromkeys(("at", "smooth", "start", "rise", "hold", "fall", "rest", "until"), f"1/({time})"),
        "frequency": time,
        "phase": "1",
    }
    result: dict[str, Any] = {}
    for key, value in given.items():
        if key == "formula":
            result[key] = course(value, unit, time)
        elif key == "points":
            result[key] = [[times(t, f"1/({time})"), times(v, f"1/({unit})")] for t, v in value]
        elif isinstance(value, list):
            result[key] = [course(part, unit, time) for part in value]
        else:
            result[key] = course(value, unit, time) if isinstance(value, dict) else times(value, factors[key])
    return result


def apart(one: Gains, other: Gains, sizes: Sizes, units: Units) -> float:
    """Return by how much the gains of a design differ from those of the same in other units, both in sizes."""
    names = list(sizes.by_name)[: sum(map(len, (sizes.state, sizes.input, sizes.output)))]  # those of loads are behind
    old = np.array([units.value(name) for name in names])
    n, m = len(sizes.state), len(sizes.input)
    x, u, y = old[:n], old[n : n + m], old[n + m :]
    x = np.append(x, np.ones(len(one.L) - n))  # loads keep their units
    pairs = ((other.K * u[:, None] / x[:n], one.K), ((other.L * x[:, None] / y / units.tick).T, one.L.T))
    scaled = [[part.gain(X) for X in pair] for part, pair in zip((sizes, sizes.dual()), pairs, strict=True)]
    return max(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in scaled)
