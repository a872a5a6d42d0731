"""What is said of bounds per signal: the table "what 1 unit of … does to …" at the terminal and in bounds.json."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Literal

from pwatrack.arrays import OVER_SUMS, up
from pwatrack.control.bounds import Bounds, Channel, Form
from pwatrack.control.controller import Controller
from pwatrack.report.wording import per_second, signal_text, sized
from pwatrack.spec.spec import Spec

BOUNDS = "bounds.json"
FORMAT = "pwatrack bounds 1"
_CAUSES, _SIGNALS = 6, 6  # that are printed of all that act and of all that each does

Kind = Literal["disturbance", "noise", "load", "start", "uncertain"]


def bound_content(spec: Spec, controller: Controller) -> dict[str, Any]:
    """Return the content of bounds.json."""
    robust = controller.robust
    table = [_entry(spec, bounds) for bounds in (*controller.bounds, *controller.starts)]
    table += [_entry(spec, bounds, uncertain=True) for bounds in (robust.bounds if robust else ())]
    return {
        "format": FORMAT,
        "name": spec.name,
        "spec_sha256": spec.sha256,
        "meaning": "signals are at most the sum of these bounds, each times the size of what acts; in_the_end: once "
        "the start is forgotten; at_worst: at any time, for what acts from the start on",
        "table": table,
        "start_within_sizes": {
            "sizes": dict(_start_sizes(controller)),
            "signals": {
                name: {"in_the_end": 0.0, "at_worst": size, "unit": unit}
                for (name, unit), size in (
                    (signal_text(spec, signal), size) for signal, size in from_sizes(controller).items()
                )
            },
        },
    }


def from_sizes(controller: Controller) -> dict[Form, float]:
    """Return the most that each signal is at any time from a start with all errors of x, x̂ and loads within sizes."""
    sizes, found = controller.sizes, controller.starts
    within = [*sizes.state.tolist(), *sizes.state.tolist(), *sizes.load.tolist()]
    total = dict.fromkeys((signal for signal in found[0].sizes if all(signal in b.sizes for b in found)), 0.0)
    for bounds in found:
        for signal in total:
            total[signal] += bounds.sizes[signal] * within[bounds.channel[1]] * OVER_SUMS
    if controller.practical is None and controller.trajectory.preview is None:
        return total
    practical = controller.practical  # what merged cells leave, or what is played back, comes on top
    left = controller.left_by_signal if practical is None else practical.final
    return {signal: (size + left[signal]) * OVER_SUMS for signal, size in total.items() if signal in left}


def cause(spec: Spec, channel: Channel, *, uncertain: bool = False) -> tuple[Kind, str, str]:
    """Return what acts: its kind, where or what it is, and its unit. On dv/dt that is the one of v per second."""
    kind, k = channel
    plant, units = spec.problem.plant, spec.problem.units
    n = len(plant.states)
    if kind == "noise":
        return "noise", f"measured {plant.outputs[k]}", units.get(plant.outputs[k], "")
    if kind == "disturbance":
        name = plant.states[k]
        where = f"w in d{name}/dt" if uncertain else f"d{name}/dt"
        return "uncertain" if uncertain else "disturbance", where, per_second(units.get(name, ""))
    if k < 2 * n:
        name = plant.states[k % n]
        return "start", f"{name} - {name}_d" if k < n else f"{name}_hat - {name}", units.get(name, "")
    assert plant.loads is not None
    name = dict(zip(plant.loads.where, plant.loads.names, strict=True))[k - 2 * n]
    return "load", name, units.get(name, "")


def bound_rows(spec: Spec, controller: Controller) -> Iterator[str]:
    """Yield what acts and what it does to what is tracked, the inputs and what has a size; declared ones come first."""
    found = sorted(controller.bounds, key=lambda bounds: not declared(spec, bounds.channel))
    beside = ", beside what is merged" if controller.practical else ""
    beside = ", beside what is played back" if controller.trajectory.preview else beside
    yield (
        f"in the loop as designed, for any switching, each signal is in the end at most the sum of these{beside}, in "
        "proportion to what acts; from error 0 at all times"
    )
    for bounds in found[:_CAUSES]:
        kind, on, unit = cause(spec, bounds.channel)
        yield f"{_limits(spec, bounds.sizes)} per {unit or '1'} {'of noise ' * (kind == 'noise')}on {on}"
    if len(found) > _CAUSES:
        yield f"{len(found) - _CAUSES} more in {BOUNDS}"
    starts = controller.starts
    for bounds in starts[2 * len(controller.plant.B) :]:
        _, name, unit = cause(spec, bounds.channel)
        yield f"{_limits(spec, bounds.sizes)} per {unit or '1'} of {name} that sets in, and 0 in the end"
    yield f"from a start with all errors within their sizes, at all times {_limits(spec, from_sizes(controller))}"


def limit_texts(spec: Spec, sizes: Iterable[tuple[Form, float]]) -> Iterator[str]:
    """Yield the bounds of signals in words, rounded up."""
    for signal, size in sizes:
        name, unit = signal_text(spec, signal)
        yield f"{sized(name)} ≤ {up(size)} {unit}".rstrip()


def declared(spec: Spec, channel: Channel) -> bool:
    """Whether the simulation has this disturbance or noise."""
    kind, k = channel
    disturbance, noise = spec.scenario.conditions.disturbance, spec.scenario.conditions.noise
    if kind == "noise":
        return noise is not None and bool(noise.std[k])
    return disturbance is not None and bool(disturbance.Q[k].any())


def _limits(spec: Spec, sizes: Mapping[Form, float]) -> str:
    """Say the bounds of what is tracked, of inputs, and of estimates of states that the file gives a size."""
    states = spec.problem.plant.states
    shown = {
        signal: size
        for signal, size in sizes.items()
        if signal[0] != "estimate" or (signal[1] < len(states) and states[signal[1]] in spec.problem.sizes)
    }
    return ", ".join(limit_texts(spec, list(shown.items())[:_SIGNALS])) or "no bound proved"


def _entry(spec: Spec, bounds: Bounds, *, uncertain: bool = False) -> dict[str, Any]:
    kind, of, unit = cause(spec, bounds.channel, uncertain=uncertain)
    passes = kind in ("load", "start")
    signals = dict[str, dict[str, Any]]()
    for signal, size in bounds.sizes.items():
        name, its = signal_text(spec, signal)
        signals[name] = {"in_the_end": 0.0 if passes else size, "at_worst": size, "unit": its}
        if signal in bounds.peaks:
            signals[name] |= {"certified": bounds.certified[signal], "peak_gain": list(bounds.peaks[signal])}
    return {"kind": kind, "of": of, "per": f"1 {unit}".rstrip(), "signals": signals}


def _start_sizes(controller: Controller) -> Iterator[tuple[str, float]]:
    plant, sizes = controller.plant, controller.sizes
    yield from zip(plant.states, sizes.state.tolist(), strict=True)
    if plant.loads is not None:
        yield from zip(plant.loads.names, sizes.load[list(plant.loads.where)].tolist(), strict=True)
