"""A design as certificate.json tells it: the objects that its files are written from, made again without a solver."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np

from pwatrack.arrays import Array
from pwatrack.control.bounds import Bounds, Channel, Form, Loops, Part, ProvedPeak
from pwatrack.control.controller import Controller
from pwatrack.control.limits import Limited, Starts, promises
from pwatrack.control.practical import Practical
from pwatrack.control.robust import Robust, joint_matrices
from pwatrack.control.synthesis import Design
from pwatrack.lmi.audit.reading import number
from pwatrack.lmi.audit.shape import kind
from pwatrack.lmi.chords import PeakGain
from pwatrack.lmi.dichotomy import Dichotomy
from pwatrack.lmi.ellipsoid import Ellipsoid
from pwatrack.lmi.exact import Proof
from pwatrack.lmi.exact_polynomial import AnyProof, PolynomialProof
from pwatrack.lmi.role import CONTROLLER, GENERATOR, OBSERVER, PLANT
from pwatrack.lmi.starts import Held
from pwatrack.model.merging import Merge, merges
from pwatrack.model.scalar_form import scalar_form
from pwatrack.report.certificate import output_form
from pwatrack.spec.box import corners
from pwatrack.spec.spec import Spec
from pwatrack.study.limiting import room_within_limits
from pwatrack.study.merged import merged_spec
from pwatrack.study.sizing import spec_sizes
from pwatrack.study.tracking import desired_trajectory

_ROLES = {role.name: role for role in (PLANT, CONTROLLER, OBSERVER, GENERATOR)}
CLOSE = 1e-9  # of the largest of some numbers: what two processors may make of one formula
_NOT_TOLD = cast(Any, None)  # what exact proofs were made from: no file has it, and nothing is written from it


def told_design(spec: Spec, content: dict[str, Any]) -> Controller:
    """Return the design that a certificate tells, with the plant and the reference of a spec.

    Args:
        spec: What it is to be a design of.
        content: What an audited certificate.json holds.

    Raises:
        ValueError: If gains or elements do not fit to the spec.
        PwatrackError: As `desired_trajectory`.
    """
    practical, true = content["practical"], spec
    spec = merged_as_told(spec, content)
    form = output_form(spec, content["generator"]["directions"]) if content["generator"] else None
    trajectory, generator = desired_trajectory(spec, True, form)
    plant = spec.problem.plant if generator is None else generator.form.plant
    proofs = [_proof(proof) for proof in content["proofs"] if kind(proof) != "cost"]
    for proof in proofs:
        if isinstance(proof, Dichotomy) and generator is not None:
            generator = replace(generator, certificate=proof)
    K, L, costs = told_gains(content)
    controller = Controller(
        plant=plant,
        design=Design(K=K, L=L, controller=_NOT_TOLD, observer=_NOT_TOLD),
        trajectory=trajectory,
        generator=generator,
        proofs=tuple(proof for proof in proofs if not isinstance(proof, Dichotomy)),
        sizes=spec_sizes(spec),
        costs=costs,
        practical=_practical(true, practical),
    )
    loops = Loops(
        plant, *controller.design.exact, controller.proofs, controller.compensation.X, output=generator is not None
    )
    found = replace(
        controller,
        robust=_robust(spec, controller, content["uncertain"]),
        limited=_limited(spec, controller, {entry["of"]: entry for entry in content["limits"]}),
    )
    vars(found).update(_bounds_of_all(loops, content["bounds"]))  # in place of what would be searched for
    return found


def merged_as_told(spec: Spec, content: dict[str, Any]) -> Spec:
    """Return the spec that a certificate is about: with those cells merged that are merged there."""
    practical = content["practical"]
    if practical is None:
        return spec
    return merged_spec(spec, _ways(practical, spec), watched=practical["observer_runs"] == "all cells")


def told_gains(content: dict[str, Any]) -> tuple[Array, Array, dict[str, Array]]:
    """Return K, L and the bounds of costs."""
    costs = {proof["of"]: _doubles(proof["X"]) for proof in content["proofs"] if kind(proof) == "cost"}
    return _doubles(content["K"]), _doubles(content["L"]), costs


def _ways(practical: Any, spec: Spec) -> list[Merge]:
    """Return what is merged, as it would be in the plant of a spec."""
    form, found = scalar_form(spec.problem.plant), dict[tuple[int, int, int], Merge]()
    if form is not None:
        each = (way for k in range(len(form.elements)) for way in merges(form, k))
        found = {(way.element, way.first, way.last): way for way in each}
    places = [(one["element"], one["first"], one["last"]) for one in practical["merged"]]
    if not set(places) <= found.keys():
        raise ValueError("what is merged, in practical, is nothing of this plant")
    return [found[place] for place in places]


def _practical(true: Spec, content: Any) -> Practical | None:
    if content is None:
        return None
    bounds, chosen = tuple(_bounds(entry) for entry in content["bounds"]), tuple(_ways(content, true))
    return Practical(plant=true.problem.plant, merges=chosen, replaced=(), evidence=None, bounds=bounds)


def _robust(spec: Spec, controller: Controller, content: Any) -> Robust | None:
    box = spec.objectives.uncertain
    if content is None or not box:
        return None
    found = corners(spec.problem.parametric, controller.plant, box)
    count = len(joint_matrices(controller.plant.exact, found, *controller.design.exact))
    bounds = tuple(_bounds(entry) for entry in content["bounds"])
    return Robust(plant=controller.plant, corners=tuple(found), count=count, bounds=bounds)


def _limited(spec: Spec, controller: Controller, entries: dict[str, Any]) -> Limited | None:
    found = room_within_limits(spec, controller.trajectory, controller.generator, controller.sizes)
    if found is None or found.left is None:
        return found
    known = {
        of: Held(
            **_whole(entry["Q"]),
            weights=tuple(map(_double, entry["weights"])),
            sizes=tuple(size for _, size in _sizes(entry["signals"])),
        )
        for of, entry in entries.items()
    }
    starts, (plant, design) = [_nearby(one, entries) for one in found.starts], (controller.plant, controller.design)
    proved = promises(plant, design, controller.proofs, found.left, starts, controller.compensation, known=known)
    return replace(found, promises=proved if controller.practical is None else ())


def _nearby(starts: Starts, entries: dict[str, Any]) -> Starts:
    """Return starts as a certificate has them, if it has: those of a run follow from a simulation, to rounding."""
    G, n, N = starts.G, len(starts.e), 0 if starts.delta is None else len(starts.e)
    told = _doubles(entries[starts.kind]["starts"]) if starts.kind in entries else G
    if told.shape != G.shape or not np.allclose(told, G, rtol=CLOSE, atol=CLOSE * np.abs(G).max(initial=0.0)):
        return starts
    delta, load = told[n : n + N] if N else None, None if starts.load is None else told[n + N :]
    return replace(starts, e=told[:n], delta=delta, load=load)


def _bounds_of_all(loops: Loops, entries: Sequence[Any]) -> dict[str, tuple[Bounds, ...]]:
    """Return what each disturbance and noise, and each start can do, in the order in which they are written."""
    known = {tuple(entry["channel"]): _bounds(entry) for entry in entries}
    acting: list[Channel] = [("disturbance", k) for k in range(loops.n)]
    acting += [("noise", k) for k in range(loops.L.shape[1])]
    begun: list[Channel] = [("start", group[0]) for group in loops.starts]
    found = {"bounds": list[Bounds](), "starts": list[Bounds]()}
    for name, channels in (("bounds", acting), ("starts", begun)):
        for channel in channels:
            one = known.get(channel, Bounds(channel=channel, sizes={}, parts=()))
            peaks = {form: gain for form, gain in loops.peaks(channel).items() if form in one.sizes}
            sizes = {form: min(size, peaks.get(form, (0.0, np.inf))[1]) for form, size in one.sizes.items()}
            found[name].append(replace(one, sizes=sizes, peaks=peaks))
    return {name: tuple(bounds) for name, bounds in found.items()}


def _bounds(entry: Any) -> Bounds:
    parts = tuple(
        Part(
            loop=part["loop"],
            channel=_channel(part["channel"]),
            signals=tuple(form for form, _ in _sizes(part["signals"])),
            ellipsoid=Ellipsoid(
                **_whole(part["Q"]), a=_double(part["a"]), sizes=tuple(size for _, size in _sizes(part["signals"]))
            ),
        )
        for part in entry["parts"]
    )
    proved = tuple(
        ProvedPeak(
            part=peak["part"],
            gain=PeakGain(
                unit=peak["unit"],
                steps=tuple((k, count) for k, count in peak["steps"]),
                size=_double(peak["size"]),
                **_whole(peak["P"]),
            ),
        )
        for peak in entry.get("peaks", [])
    )
    sizes = dict(_sizes(entry["signals"]))
    return Bounds(channel=_channel(entry["channel"]), sizes=sizes, parts=parts, proved=proved)


def _proof(proof: Any) -> AnyProof | Dichotomy:
    role, P = _ROLES[proof["of"]], _whole(proof["P"])
    if kind(proof) == "polynomial":
        each = [_whole(N) for N in proof["N"]]
        return PolynomialProof(
            role=role,
            degree=int(proof["degree"]),
            rate=_double(proof["rate"]),
            T=_doubles(proof["T"]),
            N=tuple(N["integers"] for N in each),
            N_exponents=each[0]["exponents"],
            **P,
        )
    if kind(proof) == "P of any sign":
        return Dichotomy(role=role, margin=_double(proof["margin"]), **P)
    rate, margin, radius = (_double(proof[name]) for name in ("rate", "margin", "radius"))
    return Proof(role=role, rate=rate, margin=margin, radius=radius, **P)


def _whole(packed: Any) -> dict[str, Any]:
    integers = tuple(tuple(int(number(v)) for v in row) for row in packed["integers"])
    return {"integers": integers, "exponents": tuple(packed["exponents"])}


def _sizes(signals: Any) -> Iterable[tuple[Form, float]]:
    """Yield what was written, a double above it."""
    for of, k, size in signals:
        yield (of, k), float(np.nextafter(_double(size), -np.inf))


def _channel(channel: Any) -> Channel:
    return channel[0], channel[1]


def _double(value: Any) -> float:
    return float(number(value))


def _doubles(rows: Any) -> Array:
    return np.array([[_double(v) for v in row] for row in rows])
