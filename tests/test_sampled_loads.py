"""The proof of a loop that is sampled where estimated loads move x_d and u_ff: against the loop as it runs."""

import copy
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flint import fmpq
from scipy.linalg import expm
from scipy.optimize import nnls

from pwatrack import Spec, design, load_spec, simulate
from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix, absolute
from pwatrack.claims.sampled import SampledLoop, errors_of
from pwatrack.claims.sampled_bounds import SampledBounds
from pwatrack.control.bounds import Channel
from pwatrack.control.controller import ProvedController
from pwatrack.control.estimated_loads import Mean, OnEstimates, integrals
from pwatrack.control.program import program
from pwatrack.control.sampled_disturbances import Acting, row
from pwatrack.control.sampled_error import SampledErrors
from pwatrack.control.sampled_gains import SampledGains, sampled_gains
from pwatrack.lmi.audit.balls import Ball
from pwatrack.lmi.audit.bounds import Loop
from pwatrack.lmi.audit.certificate import audit
from pwatrack.lmi.audit.estimates import integrals as audited_integrals
from pwatrack.lmi.audit.form import normal_form
from pwatrack.lmi.audit.plant import AuditedPlant
from pwatrack.lmi.audit.ticks import AuditedErrors
from pwatrack.lmi.clocked import ClockedProof, clocked_proof
from pwatrack.model.conditions import Conditions, Sampling
from pwatrack.model.reference import exosystem
from pwatrack.model.signal import Signal
from pwatrack.rational import rational
from pwatrack.report.certificate import design_certificate
from pwatrack.simulation.late_start import late_start
from tests.plain import Plain
from tests.sampled import asking, form_at, integrated, predicted, tubes_alone, with_sampled, worst_found
from tests.test_preview import blown

LEANING = """
name: a mass with friction, a belt that drifts, and a tank beside it that somebody fills
system:
  states: [z, v, a]
  inputs: [u]
  outputs: [y, level]
  track: [y]
  A: [[0, 1, 0], [-1, -1, -2], [0, 1, -2]]
  B: [[0], [1], [0]]
  C: [[1, 0, 0], [0, 0, 1]]
  nonlinearities:
    - {name: friction, kind: saturation, of: v, lower: -0.1, upper: 0.1, slope: 2, into: {v: -1, a: 0.3}}
design: {estimate: LOADS}
reference: {output: {constant: 0.05}}
simulation: {duration: 1, sample_time: 0.05}
"""
LOADS = {
    "constants": "{drift: {into: {z: 1}}, filling: {into: {a: 1, v: 0.5}}}",
    "sinusoids": "{shake: {into: {z: 1}, frequency: 3}, filling: {into: {a: 1}}}",
}
BENT = {  # a last derivative is piecewise affine: where it bends the reference alone decides, or η with it
    "bent": {"of: v,": "of: z,", "into: {v: -1, a: 0.3}": "into: {z: -1}", "LOADS": "{filling: {into: {a: 1}}}"},
    "bent by η": {
        "of: v,": "of: a,",
        "into: {v: -1, a: 0.3}": "into: {z: -1}",
        "slope: 2,": "slope: 1,",
        "LOADS": "{filling: {into: {a: 1}}}",
    },
}
HUMMING = """
name: a mass that hums, of which all is given
system:
  states: [z, v]
  inputs: [u, w]
  outputs: [y]
  A: [[0, 1], [-1, -1]]
  B: [[0, 1], [2, 1]]
  C: [[1, 0]]
  nonlinearities:
    - {name: stop, kind: spring, of: z, start: 0.1, slope: 3, into: {v: -1}}
design: {tracking: state, estimate: {hum: {into: {v: 1, z: 1}, frequency: 3}, pull: {into: {v: 3}}}}
reference: {setpoint: {y: 0}}
simulation: {duration: 1, sample_time: 0.05}
"""


def designed(text: str, folder: Path) -> tuple[Spec, ProvedController]:
    path = folder / "plant.yaml"
    path.write_text(text, encoding="utf-8")
    spec = load_spec(path)
    return spec, design(spec)


def written(name: str) -> str:
    """Return the spec of that name."""
    text = HUMMING if name == "humming" else LEANING
    for old, new in BENT.get(name, {"LOADS": LOADS.get(name, "")}).items():
        assert name == "humming" or old in text
        text = text.replace(old, new)
    return text


@pytest.fixture(scope="module", params=[*LOADS, *BENT, "humming"])
def loaded(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, Spec, ProvedController]:
    return request.param, *designed(written(request.param), tmp_path_factory.mktemp("loaded"))


def gains_of(controller: ProvedController, h: float, delay: int = 0, substeps: int = 2) -> SampledGains:
    made = sampled_gains(controller.plant, controller.K, controller.L, Sampling(sample_time=h, delay=delay))
    return replace(made, substeps=substeps)


def proved(spec: Spec, controller: ProvedController, gains: SampledGains) -> tuple[ProvedController, ClockedProof]:
    found = with_sampled(spec, controller, gains)
    proof = found.claim(SampledLoop).proof
    assert proof is not None, found.claim(SampledLoop).missing
    return found, proof


class Rest:
    """x_d, η and u_ff of some true loads that are constant, and a reference that rests."""

    def __init__(self, runs: Plain, s: Array) -> None:
        tables, w = runs.program, np.array(runs.state["w"])
        eta = np.zeros(tables.sizes["p"])
        for _ in range(20_000 if len(eta) else 1):
            known = np.concatenate([s, eta, w, [1.0]])
            self.cell = int(np.argmax((tables.sides * np.sign(tables.guards @ known) >= 0).all(axis=1)))
            eta = tables.generator[self.cell] @ known
        self.eta, self.x_d, self.u_ff = eta, tables.x_d[self.cell] @ known, tables.u_ff[self.cell] @ known


def running(
    errors: SampledErrors,
    controller: ProvedController,
    seed: int,
    ticks: int,
    jitter: float | None = None,
    start: tuple[Array, Array, Array, Array] | None = None,
) -> Iterator[tuple[int, int, Array]]:
    """Yield z along the loop of plant and program, as both run, in each substep many times.

    Loads that swing are 0, so that x_d rests; what is estimated of them is not. Ticks come early and late, as the gains
    say or by another jitter. It starts somewhere, or where x − x_d, (x̂, ŝ), s and η̂ of the program are as given.
    """
    size, early = 0.2, (errors.gains.jitter if jitter is None else jitter) / errors.gains.sample_time
    random, plant, gains, fine = np.random.default_rng(seed), controller.plant, errors.gains, 6
    sampling = Sampling(sample_time=gains.sample_time, delay=gains.delay)
    tables = program(replace(controller, claims=(SampledLoop(gains=gains, proof=None),)), Conditions(sampling=sampling))
    loads, n, r, d, of = plant.loads, len(plant.B), errors.parts, gains.delay, tables.sizes
    assert loads is not None
    s = random.normal(size=len(loads.S.floats)) * size * (not np.abs(loads.S.floats).any())
    s = s if start is None else start[2]
    rest = Rest(Plain(tables, np.zeros(of["N"]), np.zeros(of["p"])), s)
    known = np.append(rest.x_d, s) + random.normal(size=of["N"]) * size if start is None else start[1]
    runs, step = Plain(tables, known, rest.eta if start is None else start[3]), gains.sample_time / r / fine
    x = rest.x_d + (random.normal(size=n) * size if start is None else start[0])
    queue, seen = [[np.zeros(0)]] * d, [known] * errors.predicted
    for tick in range(ticks):
        assert runs.step(plant.C @ x) == 0
        now = runs.state
        seen = [np.array(now["x_hat"]), *seen[:-1]]
        acts, *queue = [*queue, put_out(errors, controller, runs, rest, s)]
        u = np.array(now["u"])
        pace = 1 + random.uniform(-1, 1) * early if early else 1.0
        for part in range(r):
            begin = seen
            for k in range(fine + 1):
                x = integrated(plant, x, plant.B @ u + loads.E.floats @ s, pace * step) if k else x
                seen = [predicted(plant, one, u, k * step) for one in begin]
                if tick >= d:
                    Delta = [one - np.append(x, s) for one in seen]
                    rho = [errors.R.floats @ (one - was)[:n] for one, was in zip(seen, begin, strict=True)]
                    yield part, k, np.concatenate([x - rest.x_d, acts[0], *Delta, *rho, *acts[1:]])


def put_out(errors: SampledErrors, controller: ProvedController, runs: Plain, rest: Rest, s: Array) -> list[Array]:
    """Return ν, ε and δ of what is put out at a tick."""
    now, tables, n, estimates = runs.state, runs.program, len(controller.plant.B), errors.estimates
    assert estimates is not None
    loads = controller.plant.loads
    assert loads is not None
    s_hat = expm(loads.S.floats * tables.sampling.delay * tables.sampling.sample_time) @ now["x_hat"][n:]
    eta, w, cell = np.array(now["eta_hat"]), np.array(now["w"]), now["j"]
    at_tick = controller.trajectory.u_ff[cell] @ [*eta, *w, 1.0] + controller.compensation.u_ff[cell] @ s_hat
    nu = np.array(now["late"][-1] if runs.delay else now["u"]) - at_tick
    after = tables.generator[cell] @ [*now["x_hat"][n:], *eta, *w, 1.0]
    off = [eta - rest.eta, after - rest.eta] if estimates.eta else [np.zeros(0)] * 2
    return [nu, s_hat - s, *off]


def falls_along(errors: SampledErrors, proof: ClockedProof, controller: ProvedController, seed: int) -> None:
    fallen, value, found = np.exp(-2 * proof.rate * errors.gains.sample_time / errors.parts / 6), np.inf, list[float]()
    for part, k, z in running(errors, controller, seed, 60):
        after = float(z @ form_at(proof, errors.parts, part, k / 6) @ z)
        assert after <= value * (fallen if k else 1) * (1 + 1e-6)
        value = after
        found.append(after)
    assert found[-1] < 0.9 * found[0]


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0, 1, 2])
def test_the_form_falls_along_the_loop_itself(delay: int, loaded: tuple[str, Spec, ProvedController]) -> None:
    _, _, controller = loaded
    errors = errors_of(controller, gains_of(controller, 0.01, delay, 2 if delay < 2 else 1))
    proof = clocked_proof(errors.clocked, knots=1, rate=0.11)
    assert errors.estimates is not None
    assert proof is not None
    assert proof.rate > 0.1
    falls_along(errors, proof, controller, seed=delay)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("delay", [1, 2])
def test_where_inputs_are_late_z_is_known_as_the_first_one_acts(
    delay: int, seed: int, loaded: tuple[str, Spec, ProvedController]
) -> None:
    """A tick makes of it what it makes of z of the loop, which runs from the same start on."""
    name, _, controller = loaded
    gains, random = gains_of(controller, 0.02, delay), np.random.default_rng(seed)
    errors, loads, n = errors_of(controller, gains), controller.plant.loads, len(controller.plant.B)
    assert loads is not None
    s = random.normal(size=len(loads.S.floats)) * 0.2 * (name not in ("sinusoids", "humming"))
    away, x_hat = random.normal(size=(2, n)) * 0.2
    runs = replace(controller, claims=(SampledLoop(gains=gains, proof=None),))
    tables = program(runs, Conditions(sampling=Sampling(sample_time=0.02, delay=delay)))
    rest = Rest(Plain(tables, np.zeros(tables.sizes["N"]), np.zeros(tables.sizes["p"])), s)
    acting = Conditions(disturbance=exosystem([Signal.of(float(each)) for each in loads.E.floats @ s]))
    quiet, begin = {"off": np.zeros(n), "noise": np.zeros(len(controller.plant.C))}, (rest.x_d + away, x_hat, rest.eta)
    found = late_start(runs, acting, errors, begin, **quiet)
    assert found is not None
    assert not found.off.any()
    known, eta = np.append(x_hat, 0 * s), rest.eta
    w = Plain(tables, known, eta).state["w"]
    for _ in range(delay):  # η̂ goes on to the time at which the first input acts, with the estimates that there are
        v = np.concatenate([0 * s, eta, w, [1.0]])
        eta = tables.generator[int(np.argmax((tables.sides * np.sign(tables.guards @ v) >= 0).all(axis=1)))] @ v
    *_, z = next(running(errors, controller, seed, delay + 1, start=(away, known, s, eta)))
    assert missed(np.array([J.floats for J in errors.clocked.J]), found.z, z) < 1e-6


def missed(vertices: Array, z: Array, after: Array) -> float:
    """Return by how much what is made of z is none of the means of what vertices make, beside its size."""
    sizes, weight = np.abs(vertices @ z).max(axis=0), 1e3
    scale = 1 / np.maximum(sizes, 1e-3 * sizes.max())
    A = np.vstack([(vertices @ z).T * scale[:, None], np.full(len(vertices), weight)])
    return float(nnls(A, np.append(after * scale, weight), maxiter=10_000)[1])


def along_the_loop(
    errors: SampledErrors, controller: ProvedController, seed: int, ticks: int, jitter: float | None = None
) -> tuple[float, float]:
    """Return by how much ticks and flows of the loop, as it runs, are none of those that are in the proof."""
    system, fine = errors.clocked, 6
    F, J = (np.array([X.floats for X in some]) for some in (list(system.vertices), system.J))
    step, at_ticks, between = float(system.period) / system.parts / fine, 0.0, 0.0
    past = list[Array]()
    for part, k, z in running(errors, controller, seed, ticks, jitter):
        if k == 0:
            if past and part == 0:
                at_ticks = max(at_ticks, missed(J, past[-1], z))
            past = []
        past = [*past[-2:], z]
        if len(past) == 3:
            between = max(between, missed(F, past[1], (past[2] - past[0]) / (2 * step)))
    return at_ticks, between


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("delay", [0, 1, 2])
def test_what_the_loop_does_is_a_mean_of_what_is_in_the_proof(
    delay: int, seed: int, loaded: tuple[str, Spec, ProvedController]
) -> None:
    """Exactly at ticks; between them, but for what differences of samples miss."""
    _, _, controller = loaded
    at_ticks, between = along_the_loop(errors_of(controller, gains_of(controller, 0.02, delay)), controller, seed, 40)
    assert at_ticks < 1e-9
    assert between < 5e-3


@pytest.mark.parametrize("seed", range(3))
def test_so_it_is_where_ticks_come_early_and_late(seed: int, tmp_path: Path) -> None:
    _, controller = designed(LEANING.replace("LOADS", LOADS["constants"]), tmp_path)
    gains = replace(gains_of(controller, 0.02), jitter=0.006)
    at_ticks, between = along_the_loop(errors_of(controller, gains), controller, seed, 40)
    assert at_ticks < 1e-9
    assert between < 5e-3
    at_ticks, between = along_the_loop(errors_of(controller, replace(gains, jitter=0.0)), controller, seed, 40, 0.006)
    assert between > 0.1


@pytest.mark.slow
@pytest.mark.parametrize(
    "loads", ["{wind: {into: {w: 1}}, push: {into: {v: 1}}}", "{hum: {into: {w: 1}, frequency: 3}}"]
)
def test_so_it_is_where_x_d_is_worked_out_beforehand(loads: str, tmp_path: Path) -> None:
    spec = blown(tmp_path, loads, "{w: 0.3}", (", step: {size: 0.7, at: 2.25, smooth: 1.5}", ""))
    controller = design(spec)
    found, _ = proved(spec, controller, gains_of(controller, 0.005))
    errors = errors_of(controller, found.claim(SampledLoop).gains)
    assert errors.estimates is not None
    assert (errors.estimates.eta, np.abs(errors.estimates.X.floats).max() > 0.03) == (0, True)
    at_ticks, between = along_the_loop(errors, controller, 0, 40)
    assert at_ticks < 1e-9
    assert between < 5e-3
    assert not audit(json.dumps(design_certificate(spec, found)))[1]
    (bounds,) = SampledBounds.prove(found, asking(spec, found, found.claim(SampledLoop).gains))
    assert bounds.ends_below(found)["output", 0] < 0.1, "m, where the push is no hum; 0.0003 where it is wind"


def test_a_sample_may_begin_in_a_cell_within_the_hull(tmp_path: Path) -> None:
    text = LEANING.replace("LOADS", LOADS["constants"])
    saturation = "kind: saturation, of: v, lower: -0.1, upper: 0.1, slope: 2,"
    assert saturation in text
    three = text.replace(saturation, "kind: piecewise_linear, of: v, breakpoints: [-0.1, 0.1], slopes: [0.5, 2, 1],")
    spec, controller = designed(three, tmp_path)
    found, _ = proved(spec, controller, gains_of(controller, 0.02))
    errors = errors_of(controller, found.claim(SampledLoop).gains)
    assert errors.estimates is not None
    assert (len(errors.estimates.cells), len(errors.estimates.hull), len(errors.ticks)) == (3, 2, 6)
    content = json.loads(json.dumps(design_certificate(spec, found)))
    assert "elements" in content["plant"]
    assert not audit(json.dumps(content))[1]
    again = AuditedErrors(
        content["sampled"],
        Loop(
            AuditedPlant(content["plant"]),
            [],
            [],
            normal_form(AuditedPlant(content["plant"]), content["generator"])[1],
            content["generator"],
        ),
    )
    assert len(again.ticks) == 6
    assert along_the_loop(errors, controller, 0, 40)[0] < 1e-9


def scaled(means: Sequence[Mean], by: tuple[Fraction, Fraction]) -> list[Mean]:
    return [(X.times(by[0]), D.times(by[1])) for X, D in means]


ONE, LESS, MORE = Fraction(1), Fraction(9, 10), Fraction(3, 2)
WRONG: dict[str, Callable[[OnEstimates], OnEstimates]] = {
    "held as at the tick": lambda of: replace(of, cells=[(F, u.times(Fraction(0))) for F, u in of.cells]),
    "pushed otherwise": lambda of: replace(of, moves=scaled(of.moves, (LESS, ONE))),
    "moved otherwise": lambda of: replace(of, moves=scaled(of.moves, (ONE, LESS)), hull=scaled(of.hull, (ONE, LESS))),
    "turned otherwise": lambda of: replace(of, hull=scaled(of.hull, (MORE, ONE))),
    "in one cell": lambda of: replace(of, hull=of.hull[:1], cells=of.cells[:1], moves=of.moves[:1]),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", WRONG)
def test_it_is_none_of_another_loop(what: str, loaded: tuple[str, Spec, ProvedController]) -> None:
    name, _, controller = loaded
    errors = errors_of(controller, gains_of(controller, 0.02))
    assert errors.estimates is not None
    other = replace(errors, estimates=WRONG[what](errors.estimates))
    at_ticks, between = along_the_loop(other, controller, 0, 40)
    given = what == "in one cell" and name in ("humming", "bent")  # it is the same in all cells
    given = given or (name, what) == ("humming", "moved otherwise")  # x_d is given
    assert (at_ticks > 1e-6 or between > 1e-2) != given


def test_integrals_hold_what_quadrature_says() -> None:
    F, h = np.array([[0.3, -2.0, 0.0], [4.0, -1.0, 0.5], [0.0, 3.0, -30.0]]), 0.7
    P, Q = integrals(BallMatrix.of(F), Fraction("0.7"))
    entries = [[Fraction(repr(float(v))) for v in row] for row in F]
    again = audited_integrals(Ball(entries), Fraction("0.7"))
    nodes, weights = np.polynomial.legendre.leggauss(60)
    turns, weights = np.array([expm(F * h / 2 * (t + 1)) for t in nodes]), weights * h / 2
    wanted = np.tensordot(weights, turns, 1), np.tensordot(weights * (1 - nodes) / 2, turns, 1)
    for own, audited, one in zip((P, Q), again, wanted, strict=True):
        assert own.floats == pytest.approx(one, abs=1e-12)
        assert np.array(audited.centre, dtype=float) == pytest.approx(one, abs=1e-12)
        off = absolute(own.centre - rational(audited.centre, (3, 3)))
        assert own.radius is not None
        radii = zip(off.entries(), own.radius.entries(), chain(*audited.radius), strict=True)
        for v, one_radius, other in radii:
            assert abs(v) <= one_radius + fmpq(other.numerator, other.denominator)


@pytest.mark.parametrize("delay", [0, 1])
def test_the_auditor_makes_the_same_matrices_from_the_file(
    delay: int, loaded: tuple[str, Spec, ProvedController]
) -> None:
    _, spec, controller = loaded
    gains = gains_of(controller, 0.02, delay)
    content = json.loads(json.dumps(design_certificate(spec, controller)))
    told = SampledLoop(gains=gains, proof=ClockedProof(P=(), T=(), rate=1.0)).data(controller)["sampled"]
    plant, generator = AuditedPlant(content["plant"]), content["generator"]
    X = None if generator is None else normal_form(plant, generator)[1]
    again, errors = AuditedErrors(told, Loop(plant, [], [], X, generator)), errors_of(controller, gains)
    system = errors.clocked
    assert system.between is not None
    flows, factors = zip(*((box.middle, box.factors) for box in again.opened(errors.flows[1])), strict=True)
    U, V = zip(*factors, strict=True)
    pairs = (system.F, flows), (system.J, again.ticks), ([system.between], [again.substep])
    for own, audited in (*pairs, (system.U, [Ball(X) for X in U if X]), (system.V, [Ball(X) for X in V if X])):
        assert len(own) == len(audited)
        found = [np.array(ball.centre, dtype=float) for ball in audited]
        for X_own in own:
            assert min(np.abs(one - X_own.floats).max() for one in found) < 1e-12


@pytest.fixture(scope="module")
def certified(loaded: tuple[str, Spec, ProvedController]) -> tuple[str, dict[str, Any]]:
    name, spec, controller = loaded
    found, _ = proved(spec, controller, gains_of(controller, 0.02))
    return name, json.loads(json.dumps(design_certificate(spec, found)))


@pytest.mark.slow
def test_the_auditor_agrees(certified: tuple[str, dict[str, Any]]) -> None:
    said, faults = audit(json.dumps(certified[1]))
    assert not faults
    assert [one for one in said if one.startswith("the sampled loop: every 0.02 s, rate ")]


FORGED: dict[str, Callable[[Any], Any]] = {
    "a larger rate": lambda c: c["sampled"].update(rate="3"),
    "another M": lambda c: c["sampled"]["M"][-1].__setitem__(0, "5"),
    "another K": lambda c: c["sampled"]["K"][0].__setitem__(0, "5"),
    "a longer sample time": lambda c: c["sampled"].update(sample_time="1"),
    "a much longer sample time": lambda c: c["sampled"].update(sample_time="1000"),
    "later inputs": lambda c: c["sampled"].update(delay=2),
    "knots that are missing": lambda c: c["sampled"]["P"].pop(),
    "a form that is changed": lambda c: c["sampled"]["P"][1]["integers"][-1].__setitem__(-1, "1"),
    "loads of another place": lambda c: c["plant"]["loads"]["E"][-1].__setitem__(-1, "7"),
    "loads of another frequency": lambda c: c["plant"]["loads"]["S"][-1].__setitem__(0, "-9"),
    "ticks that come anywhere": lambda c: c["sampled"].update(jitter="0.0199"),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", FORGED)
def test_a_forged_proof_is_refused(what: str, certified: tuple[str, dict[str, Any]]) -> None:
    content = copy.deepcopy(certified[1])
    FORGED[what](content)
    content["bounds"] = []  # they take long
    faults = audit(json.dumps(content))[1]
    assert faults
    assert not any(fault.startswith("not a certificate") for fault in faults), faults


@pytest.fixture(scope="module")
def bounded(loaded: tuple[str, Spec, ProvedController]) -> tuple[Spec, ProvedController, SampledBounds]:
    """With tubes of disturbances and noise of size 1."""
    _, spec, controller = loaded
    found, _ = proved(spec, controller, gains_of(controller, 0.02))
    asked = replace(asking(spec, found, found.claim(SampledLoop).gains), acting=of_size_one)
    (bounds,) = SampledBounds.prove(found, asked)
    return spec, replace(found, claims=(*found.claims, bounds)), bounds


def of_size_one(controller: ProvedController, _: object) -> Acting:
    plant = controller.plant
    channels: list[Channel] = [("disturbance", k) for k in range(len(plant.B))]
    channels += [("noise", k) for k in range(len(plant.C))]
    assert plant.loads is not None
    loads = np.ones(len(plant.loads.S.floats))
    channels += [("load", k) for k in range(len(loads))]
    near = np.zeros((1, len(plant.partition.H)))
    return Acting(
        squares={of: np.ones(1) for of in channels},
        means={},
        beside={},
        planes=plant.partition.H,
        near=near,
        apart=near,
        changes=np.zeros(plant.B.shape[1]),
        loads=loads,
    )


@pytest.mark.slow
def test_no_switching_is_above_a_tube(bounded: tuple[Spec, ProvedController, SampledBounds]) -> None:
    """Of what acts at its worst, with what is held and what drives it at ticks switched together."""
    _, controller, bounds = bounded
    assert tubes_alone(bounds).keys() == bounds.acts.squares.keys()
    for channel, (one, *_) in tubes_alone(bounds).items():
        c, size = row(bounds.errors, (controller.tracking, 0)).floats, one.sizes[0]
        found = max(worst_found(bounds, channel, c, seed, summed=one.summed) for seed in range(8))
        assert 0.05 * size < found <= size


SMALLER: dict[str, Callable[[Any], Any]] = {
    "a smaller bound": lambda tube: tube["signals"][0].__setitem__(2, "1e-3"),
    "another b": lambda tube: tube.update(b="0.9"),
    "of what acts elsewhere": lambda tube: tube.update(channel=["disturbance", 0], a=tube["b"], b="0"),
    "knots that are missing": lambda tube: tube["Q"].pop(),
    "a smaller Q": lambda tube: tube["Q"][0]["integers"][0].__setitem__(0, "1"),
}


@pytest.mark.slow
def test_the_auditor_agrees_with_tubes_and_refuses_forged_ones(
    bounded: tuple[Spec, ProvedController, SampledBounds],
) -> None:
    spec, controller, _ = bounded
    content = json.loads(json.dumps(design_certificate(spec, controller)))
    channels: list[Channel] = [("disturbance", 0), ("noise", 0)]
    for channel in channels:  # one by one: a small file may not ask for much
        (tube,) = [one for one in content["sampled_bounds"] if one["acts"][0]["channel"] == list(channel)]
        said, faults = audit(json.dumps(content | {"sampled_bounds": [tube]}))
        assert not faults
        assert "the sampled loop: what 1 disturbances, noises and inputs leave is proved" in said
        for change in SMALLER.values() if channel == ("noise", 0) else ():
            forged = copy.deepcopy(tube)
            change(forged)
            faults = audit(json.dumps(content | {"sampled_bounds": [forged]}))[1]
            assert faults
            assert "steps" not in faults[0]


def test_a_run_with_constants_between_inputs_stays_within_its_bound(tmp_path: Path) -> None:
    """E = B U, and no column of E is one of B: x_d is given, and what acts in the run is known."""
    text = HUMMING.replace("{v: 1, z: 1}, frequency: 3", "{v: 5, z: 1}").replace(
        "duration: 1, sample_time: 0.05}", "duration: 4, MACHINE}"
    )
    machine = (
        "sample_time: 0.05, controller: {sample_time: 0.05}, disturbance: {v: {constant: 0.3}, z: {constant: 0.1}}"
    )
    machine += ", noise: {std: {y: 1e-4}, sample_time: 0.05, seed: 1}"
    spec, controller = designed(text.replace("MACHINE", machine).replace(", pull: {into: {v: 3}}", ""), tmp_path)
    errors, bounds = controller.claim(SampledBounds).errors, controller.claim(SampledBounds)
    assert errors.estimates is not None
    assert len(errors.widths) == 6
    assert ("noise", 0) in tubes_alone(bounds)
    run = simulate(spec, controller)
    assert run.outcome.kind != "above its bound"
    assert bounds.ends_below(controller)["state", 0] > 0
    assert not audit(json.dumps(design_certificate(spec, controller)))[1]


def test_where_nothing_is_proved_it_is_said_why(tmp_path: Path) -> None:
    late = "ticks come early and late, and a load that is estimated oscillates"
    spec, controller = designed(LEANING.replace("LOADS", LOADS["sinusoids"]), tmp_path)
    (claim,) = SampledLoop.prove(controller, asking(spec, controller, replace(gains_of(controller, 0.02), jitter=1e-3)))
    assert claim.sentence == f"not proved: {late}"
