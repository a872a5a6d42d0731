"""Examples of Modelica's standard library whose elements are continuous PWA, beside Dymola's reference results.

    python -m benchmarks.boards.modelica FOLDER [--out runs/boards]

The folder has `Backlash.Backlash.csv`, `ElastoGap.ElastoGap.csv`, `PreLoad.PreLoad.csv` and
`SlewRateLimiter.SlewRateLimiter.csv`, as MAP-LIB_ReferenceResults has them (Dymola, DASSL with a tolerance of 1e-6).

What is continuous piecewise affine: a contact whose damper only pushes, and never more than the spring, has the force
max(0, min(p + q, 2 p)) with p = c · compression and q = d · its rate: three planes p = 0, p + q = 0, q = p through one
line, a field of two linear forms: `kind: contact` of a spec. That is ElastoGap with the exponent 1; ElastoBacklash is
`kind: elasto_backlash`, one on either side. A slew-rate
limiter is a saturation of (u − y) / Td. What is not: ElastoBacklash2, whose torque jumps where contact begins, and
ElastoGap with another exponent.

Printed is, for each signal of a reference, the largest difference at the times of its grid, as a share of the largest
value of the signal: of ours from the reference, and of ours from an integrator of SciPy at a tolerance of 1e-12, on
the first part of the run where that would take long.
"""

import argparse
import csv
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from benchmarks.boards.limited import machine, table
from pwatrack.arrays import Array
from pwatrack.model.contact import Contact
from pwatrack.model.linear_form import LinearForm
from pwatrack.model.reference import StateResets
from pwatrack.real import Real
from pwatrack.simulation.flow import Flow, SwitchedPart
from pwatrack.simulation.propagate import simulate_flow

RTOL, ATOL = 1e-12, 1e-14
GRID = 1e-7  # of the interval: what is nearer to a time of the grid is on it
Row = Mapping[str, float]  # a linear form: factors by name of a state, "1" for what is constant


@dataclass(frozen=True, kw_only=True)
class Model:
    """One example.

    Attributes:
        start: Where each state is at t = 0; what is constant is not named.
        linear: What of the derivative of a state does not switch.
        contacts: For each its name, p, q, and the factors with which its force drives states.
        signals: What the columns of the reference are.
        duration, interval: In s, as the reference has them.
        resets: New values of a state from some times on.
        checked: The part of the run that is integrated again, in s.
        integrator: By which one of SciPy: explicit steps follow kinks of stiff contacts more exactly, and take long.
        limiter: Whether a slew-rate limiter drives y and a from u.
    """

    start: Mapping[str, float]
    linear: Mapping[str, Row]
    contacts: Sequence[tuple[str, Row, Row, Row]] = ()
    signals: Mapping[str, Row]
    duration: float
    interval: float
    resets: Sequence[tuple[str, float, float]] = ()
    checked: float
    integrator: Literal["LSODA", "DOP853"] = "LSODA"
    limiter: bool = False
    names: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        """List the names of z, the constant last."""
        object.__setattr__(self, "names", (*self.start, "1"))

    def row(self, form: Row) -> Array:
        """Return a linear form as a row, (N,)."""
        found = np.zeros(len(self.names))
        for name, factor in form.items():
            found[self.names.index(name)] += factor
        return found

    @property
    def z0(self) -> Array:
        """The start, (N,)."""
        return np.array([*self.start.values(), 1.0])

    def flow(self) -> Flow:
        """Return the exact flow."""
        N = len(self.names)
        F0 = np.zeros((N, N))
        for name, form in self.linear.items():
            F0[self.names.index(name)] = self.row(form)
        parts = [touch(name, self.row(p), self.row(q), self.row(into)) for name, p, q, into in self.contacts]
        return Flow(F0=F0, parts=(*parts, *([slew_rates(self)] if self.limiter else [])))

    def derivative(self) -> Callable[[float, Array], Array]:
        """Return z' for an integrator, from the formulas and not from cells."""
        F0 = Flow(F0=self.flow().F0, parts=()).F0
        forces = [(self.row(p), self.row(q), self.row(into)) for _, p, q, into in self.contacts]
        at = {name: self.names.index(name) for name in ("u", "y", "a")} if self.limiter else {}

        def of(_: float, z: Array) -> Array:
            found = F0 @ z
            for p, q, into in forces:
                spring, damper = float(p @ z), float(q @ z)
                found = found + into * max(0.0, min(spring + damper, 2 * spring))
            if at:
                v = np.clip((z[at["u"]] - z[at["y"]]) / TD, -V_MAX, V_MAX)
                found[at["y"]], found[at["a"]] = v, np.clip((v - z[at["a"]]) / TD, -A_MAX, A_MAX)
            return np.asarray(found)

        return of


def touch(name: str, p: Array, q: Array, into: Array) -> SwitchedPart:
    """Return what a `contact` with p and q, rows (N,) of z, adds to ż.

    Example: spring and damper, and a damper that is held to the force of the spring.

        >>> part = touch("stop", np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), np.array([0, -1.0, 0]))
        >>> cells = [part.cells.index(name) for name in ("on", "on", "closing")]
        >>> [float((part.F[k] @ [2.0, v, 1.0])[1]) for k, v in zip(cells, (0.0, -1.0, 5.0))]
        [-2.0, -1.0, -4.0]
    """
    one, (spring, damper) = Real.of(1), (LinearForm(tuple(map(Real.of, row.tolist())), Real.of(0)) for row in (p, q))
    direction = [Real.of(v) for v in into.tolist()]
    element = Contact(
        name=name, of=spring, rate=damper, stiffness=one, damping=one, upper=Real.of(0), direction=direction
    )
    F = np.stack([np.outer(into, form.row) for form in element.forms])
    guards = np.stack([plane.row for plane in element.planes])
    return SwitchedPart(name=name, cells=element.segments, guards=guards, signs=element.signs, F=F)


TD, V_MAX, A_MAX = 1e-4, 2.0, 20.0  # s, m/s, m/s²


def slew_rates(model: Model) -> SwitchedPart:
    """Return y' = v = clip((u − y) / Td, ± v_max), a' = clip((v − a) / Td, ± a_max): a saturation inside of another."""
    one, a = model.row({"1": 1.0}), model.row({"a": 1.0})
    asked = model.row({"u": 1 / TD, "y": -1 / TD})
    speeds = -V_MAX * one, asked, V_MAX * one
    guards, signs, F = [asked + V_MAX * one, asked - V_MAX * one], [], []
    for speed in speeds:
        guards += [(speed - a) / TD + A_MAX * one, (speed - a) / TD - A_MAX * one]
    sides = (-1, 0), (1, -1), (0, 1)
    for i, speed in enumerate(speeds):
        for j, rate in enumerate((-A_MAX * one, (speed - a) / TD, A_MAX * one)):
            row = np.zeros(8, dtype=np.int64)
            row[:2], row[2 + 2 * i : 4 + 2 * i] = sides[i], sides[j]
            signs.append(row)
            F.append(np.outer(model.row({"y": 1.0}), speed) + np.outer(a, rate))
    cells = tuple(f"v {i}, a {j}" for i in ("low", "free", "high") for j in ("low", "free", "high"))
    return SwitchedPart(name="limiter", cells=cells, guards=np.stack(guards), signs=np.array(signs), F=np.stack(F))


def backlash() -> Model:
    """Return two inertias, on a spring and damper with backlash and on one without."""
    c, d, half, J = 20e3, 50.0, np.pi / 8, 5.0
    upper = "upper side", {"f": c, "1": -c * half}, {"w": d}, {"w": -1 / J}
    lower = "lower side", {"f": -c, "1": -c * half}, {"w": -d}, {"w": 1 / J}
    return Model(
        start={"f": np.pi / 2, "w": 0.0, "g": np.pi / 2, "r": 0.0},
        linear={"f": {"w": 1.0}, "g": {"r": 1.0}, "r": {"g": -c / J, "r": -d / J}},
        contacts=(upper, lower),
        signals={
            "elastoBacklash.phi_rel": {"f": 1.0},
            "elastoBacklash.w_rel": {"w": 1.0},
            "springDamper.phi_rel": {"g": 1.0},
            "springDamper.w_rel": {"r": 1.0},
        },
        duration=1.0,
        interval=5e-4,
        checked=1.0,
    )


def elasto_gap() -> Model:
    """Return two masses between two walls, on contacts and on springs with dampers."""
    c, d, free = 10.0, 1.5, 1.5
    left = "left contact", {"s": -c, "1": c * (free - 2)}, {"v": -d}, {"v": 1.0}
    right = "right contact", {"s": c, "1": c * (free - 2)}, {"v": d}, {"v": -1.0}
    return Model(
        start={"s": 2.0, "v": 0.0, "x": 2.0, "w": 0.0},
        linear={"s": {"v": 1.0}, "x": {"w": 1.0}, "w": {"x": -2 * c, "w": -2 * d}},
        contacts=(left, right),
        signals={
            "elastoGap1.v_rel": {"v": 1.0},
            "elastoGap2.s_rel": {"s": -1.0, "1": 2.0},
            "springDamper1.v_rel": {"w": 1.0},
            "springDamper2.s_rel": {"x": -1.0, "1": 2.0},
        },
        duration=5.0,
        interval=5e-3,
        checked=5.0,
    )


def preload() -> Model:
    """Return a spool that two plates with a spring between them preload, with four contacts."""
    c, d, stiff, m, plate = 1e6, 250.0, 20e3, 0.15, 0.01
    gaps: dict[str, tuple[float, dict[str, float], Row]] = {
        "outerContactA": (0.0015, {"A": 1.0, "1": 0.0945}, {"vA": 1 / plate}),
        "outerContactB": (0.0015, {"B": -1.0, "1": -0.066}, {"vB": -1 / plate}),
        "innerContactA": (0.001, {"A": 1.0, "s": -1.0, "1": 0.10875}, {"v": -1 / m, "vA": 1 / plate}),
        "innerContactB": (0.001, {"s": 1.0, "B": -1.0, "1": -0.08125}, {"v": 1 / m, "vB": -1 / plate}),
    }
    speed, pull = {"A": "vA", "B": "vB", "s": "v"}, 150.0
    rates = {name: {speed[k]: v for k, v in far.items() if k != "1"} for name, (_, far, _) in gaps.items()}
    contacts = []
    for name, (free, far, into) in gaps.items():
        p = {k: -c * v for k, v in far.items()}
        p["1"] += c * free
        contacts.append((name, p, {k: -d * v for k, v in rates[name].items()}, into))
    squeeze = {"A": stiff, "B": -stiff, "1": stiff * (0.025 + 0.002)}  # c (s_rel0 − s_rel), s_rel = B − A − 0.002
    omega = 2 * np.pi * 0.01
    return Model(
        start={"s": 0.01475, "v": 0.0, "A": -0.093, "vA": 0.0, "B": -0.06925, "vB": 0.0, "sin": 0.0, "cos": 1.0},
        linear={
            "s": {"v": 1.0},
            "A": {"vA": 1.0},
            "B": {"vB": 1.0},
            "v": {"v": -2500.0 / m, "sin": pull / m},
            "vA": {k: -v / plate for k, v in squeeze.items()},
            "vB": {k: v / plate for k, v in squeeze.items()},
            "sin": {"cos": omega},
            "cos": {"sin": -omega},
        },
        contacts=contacts,
        signals={
            "friction.v_rel": {"v": 1.0},
            "innerContactA.s_rel": gaps["innerContactA"][1],
            "innerContactB.s_rel": gaps["innerContactB"][1],
            "outerContactA.v_rel": rates["outerContactA"],
            "outerContactB.s_rel": gaps["outerContactB"][1],
            "outerContactB.v_rel": rates["outerContactB"],
        },
        duration=100.0,
        interval=0.05,
        checked=0.2,
        integrator="DOP853",
    )


def slew_rate_limiter() -> Model:
    """Return a step of a position, limited in speed and acceleration."""
    return Model(
        start={"u": 0.0, "y": 0.0, "a": 0.0, "s": 0.0},
        linear={"s": {"a": 1.0}},
        signals={"limit_a.y": {"a": 1.0}, "limit_v.y": {"y": 1.0}, "positionSmoothed.y": {"s": 1.0}},
        duration=1.0,
        interval=5e-4,
        resets=(("u", 0.1, 1.0),),
        checked=1.0,
        limiter=True,
    )


MODELS = {"Backlash": backlash, "ElastoGap": elasto_gap, "PreLoad": preload, "SlewRateLimiter": slew_rate_limiter}


def reference(path: Path, interval: float) -> tuple[Array, dict[str, Array]]:
    """Return the numbers of the grid that a file has, and its signals there, the last row of each time."""
    with path.open(newline="", encoding="utf-8") as lines:
        rows = csv.reader(lines)
        names = next(rows)
        values = np.array([[float(v) for v in row] for row in rows])
    numbers = np.round(values[:, 0] / interval).astype(int)
    on = np.abs(values[:, 0] - numbers * interval) <= GRID * interval
    last = np.append(np.diff(numbers[on]) > 0, True)
    values, numbers = values[on][last], numbers[on][last]
    return numbers, {name: values[:, k] for k, name in enumerate(names) if k}


def integrated(model: Model) -> Array:
    """Return z on the grid, as far as it is checked, by an integrator, begun again where a state is set anew."""
    from scipy.integrate import solve_ivp

    grid = model.interval * np.arange(round(model.checked / model.interval) + 1)
    ends = [*(t for _, t, _ in model.resets), model.checked]
    found, z, start = [model.z0], model.z0, 0.0
    for k, end in enumerate(ends):
        times = grid[(grid > start + GRID * model.interval) & (grid <= end + GRID * model.interval)]
        run = solve_ivp(
            model.derivative(),
            (start, max(end, times[-1])),
            z,
            method=model.integrator,
            t_eval=times,
            rtol=RTOL,
            atol=ATOL,
        )
        found += list(run.y.T)
        z, start = run.y[:, -1].copy(), end
        if k < len(model.resets):
            z[model.names.index(model.resets[k][0])] = model.resets[k][2]
    return np.array(found)


def rows(folder: Path) -> Iterator[list[str]]:
    """Yield a row of the table for each signal."""
    for name, of in MODELS.items():
        model = of()
        numbers, wanted = reference(folder / f"{name}.{name}.csv", model.interval)
        resets = [
            StateResets(t=np.array([t]), where=slice(k, k + 1), values=np.array([[value]]))
            for k, t, value in ((model.names.index(state), t, value) for state, t, value in model.resets)
        ]
        began = time.process_time()
        trace = simulate_flow(
            model.flow(), model.z0, duration=model.duration, sample_time=model.interval, resets=resets
        )
        seconds, own = time.process_time() - began, integrated(model)
        for signal, form in model.signals.items():
            row, size = model.row(form), float(np.abs(wanted[signal]).max())
            off = np.abs(trace.z[numbers] @ row - wanted[signal]).max() / size
            apart = np.abs((trace.z[: len(own)] - own) @ row).max() / size
            part = "" if model.checked == model.duration else f" to {model.checked:g} s"
            yield [name, signal, f"{len(trace.events)}", f"{off:.1e}", f"{apart:.1e}{part}", f"{seconds:.2f}"]


def main() -> None:
    """Print the table, and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, default=Path("runs/boards"))
    given = parser.parse_args()
    columns = ["model", "signal", "events", "from Dymola", "from SciPy", "s"]
    text = table(f"Modelica, {machine()}", columns, list(rows(given.folder)))
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "modelica.md").write_text(text, encoding="utf-8")
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
