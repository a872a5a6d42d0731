"""The proof of a loop that is sampled: against the loop itself, random switching, and forged certificates."""

import copy
import json
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from pwatrack import Spec, design, load_spec
from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix
from pwatrack.claims.sampled import SampledLoop
from pwatrack.control.controller import ProvedController
from pwatrack.control.sampled_error import SampledErrors
from pwatrack.control.sampled_gains import SampledGains, sampled_gains
from pwatrack.control.sampled_optimal import candidates
from pwatrack.control.sampled_search import with_forms
from pwatrack.control.vertices import boxes, differences, held_rows, outermost
from pwatrack.lmi.audit.balls import Ball
from pwatrack.lmi.audit.bounds import Loop
from pwatrack.lmi.audit.boxes import boxes as audited_boxes
from pwatrack.lmi.audit.certificate import audit
from pwatrack.lmi.audit.plant import AuditedPlant
from pwatrack.lmi.audit.ticks import AuditedErrors
from pwatrack.lmi.clocked import ClockedProof, fastest
from pwatrack.model.conditions import Conditions, Sampling
from pwatrack.rational import floats as floats_of
from pwatrack.rational import fraction_of
from pwatrack.report.certificate import design_certificate
from pwatrack.simulation.sampled_runs import SampleMaps, refused, sampling_remarks
from pwatrack.workflow.pipeline import asked_of
from tests.sampled import asking, form_at, kalman, regulator, running, with_sampled
from tests.scenarios import mass

LOADED = """
name: mass on a spring, pushed by a load
system:
  states: [z, v]
  inputs: [u]
  outputs: [y]
  A: [[0, 1], [-1, -1]]
  B: [[0], [2]]
  C: [[1, 0]]
  nonlinearities:
    - {name: stop, kind: spring, of: z, start: 0.1, slope: 3, into: {v: -1}}
design: {tracking: state, estimate: input}
reference: {setpoint: {y: 0.05}}
simulation: {duration: 1, sample_time: 0.05}
"""


@pytest.fixture(scope="module")
def section(specs: Path) -> tuple[Spec, ProvedController]:
    spec = load_spec(specs / "two_mass_paper_gains.yaml")
    return spec, design(spec)


@pytest.fixture(scope="module")
def loaded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Spec, ProvedController]:
    path = tmp_path_factory.mktemp("loaded") / "plant.yaml"
    path.write_text(LOADED)
    spec = load_spec(path)
    return spec, design(spec)


def gains_of(controller: ProvedController, h: float, substeps: int = 1, K: Array | None = None) -> SampledGains:
    K = controller.K if K is None else K
    return SampledGains(K=K, M=kalman(controller.plant, h), sample_time=h, substeps=substeps)


def the_claim(controller: ProvedController) -> SampledLoop:
    return controller.claim(SampledLoop)


def proof_of(controller: ProvedController) -> ClockedProof:
    proof = the_claim(controller).proof
    assert proof is not None
    return proof


@pytest.mark.parametrize("h", [0.002, 0.01, 0.05])
def test_the_example_of_section_five_is_proved(h: float, section: tuple[Spec, ProvedController]) -> None:
    spec, controller = section
    found = with_sampled(spec, controller, gains_of(controller, h))
    assert proof_of(found).rate > 0.01
    (label, said), (_, runs) = the_claim(found).rows(spec.words, found)
    assert label == "sampled loop"
    assert runs.startswith("runs with K = [-1.6088 -1.126 0.2282 -0.1182], M = [-0.0")
    assert said.startswith(f"sampled every {h} s, of the plant as designed, while no limit of an input is reached: ")


def falls_along(errors: SampledErrors, proof: ClockedProof, starts: Array, ticks: int) -> None:
    """The form falls along the loop as it runs, cells crossed wherever they are."""
    fine, N = 6, errors.plant.observed.C.shape[1]
    fallen = np.exp(-2 * proof.rate * errors.gains.sample_time / errors.parts / fine)
    for start in starts:
        value = float("inf")
        for part, k, z in running(errors, start[:N], start[N:], ticks, fine):
            after = float(z @ form_at(proof, errors.parts, part, k / fine) @ z)
            assert after <= value * (fallen if k else 1) * (1 + 1e-7)
            value = after


@pytest.mark.slow
@pytest.mark.parametrize(
    ("substeps", "delay", "jitter"), [(1, 0, 0.0), (3, 0, 0.0), (2, 1, 0.0), (1, 2, 0.0), (1, 1, 0.005)]
)
def test_the_form_falls_along_the_loop_itself(
    substeps: int, delay: int, jitter: float, section: tuple[Spec, ProvedController]
) -> None:
    spec, controller = section
    gains = replace(gains_of(controller, 0.05, substeps), delay=delay, jitter=jitter)
    found = with_sampled(spec, controller, gains)
    errors = SampledErrors.of(controller.plant, the_claim(found).gains)
    starts = np.random.default_rng(1).normal(size=(3, 8)) * 0.3
    falls_along(errors, proof_of(found), starts, ticks=60 // (substeps + delay))


@pytest.mark.parametrize("delay", [0, 1, 2])
def test_so_it_does_where_a_load_is_estimated(delay: int, loaded: tuple[Spec, ProvedController]) -> None:
    spec, controller = loaded
    h, plant = 0.05, controller.plant
    found = with_sampled(spec, controller, replace(gains_of(controller, h, K=regulator(plant, h)), delay=delay))
    errors = SampledErrors.of(plant, the_claim(found).gains)
    falls_along(errors, proof_of(found), np.random.default_rng(2).normal(size=(3, 6)) * 0.3, ticks=60)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_the_form_falls_for_switching_that_no_plant_makes(seed: int, section: tuple[Spec, ProvedController]) -> None:
    random = np.random.default_rng(seed)
    _, controller = section
    errors = SampledErrors.of(controller.plant, gains_of(controller, 0.1, 2))
    system = errors.clocked
    proof = fastest(system, knots=1)
    assert proof is not None
    assert system.between is not None
    P = [np.array(P_k.P.tolist(), dtype=float) for P_k in proof.P]
    F, (J,), R = np.array([X.floats for X in system.vertices]), system.J, system.between.floats
    z, steps = random.normal(size=errors.order), 10
    for _ in range(20):
        for part in range(2):
            one, other = P[2 * part : 2 * part + 2]
            for k in range(steps):
                value = z @ (one + k / steps * (other - one)) @ z
                share = random.dirichlet(np.full(len(F), 0.2))
                z = expm(np.tensordot(share, F, 1) * 0.05 / steps) @ z
                after = z @ (one + (k + 1) / steps * (other - one)) @ z
                assert after <= value * np.exp(-2 * proof.rate * 0.05 / steps) * (1 + 1e-9)
            z = (R if part == 0 else J.floats) @ z
            assert z @ P[2 - 2 * part] @ z <= after


@pytest.fixture(scope="module")
def certified(loaded: tuple[Spec, ProvedController]) -> tuple[Spec, ProvedController, dict[str, Any]]:
    spec, controller = loaded
    K = regulator(controller.plant, 0.05)
    found = with_sampled(spec, controller, gains_of(controller, 0.05, 2, K))
    return spec, found, design_certificate(spec, found)


def test_a_certificate_holds_the_proof_and_is_read_again(
    certified: tuple[Spec, ProvedController, dict[str, Any]],
) -> None:
    spec, found, content = certified
    said, faults = audit(json.dumps(content))
    assert not faults
    assert [one for one in said if one.startswith("the sampled loop: every 0.05 s, rate ")]
    (told,) = SampledLoop.prove(found, asking(spec, found, the_claim(found).gains), content)
    assert told.data(found) == the_claim(found).data(found)
    assert list(told.rows(spec.words, found)) == list(the_claim(found).rows(spec.words, found))
    assert told.figures(spec.words, found)["sampled"]["rate"] == proof_of(found).rate
    other = replace(the_claim(found).gains, delay=1)
    with pytest.raises(ValueError, match="not those of its certificate"):
        list(SampledLoop.prove(found, asking(spec, found, other), content))


def test_where_gains_of_the_mean_have_no_proof_those_for_all_cells_have_one(specs: Path) -> None:
    spec = load_spec(specs / "gallery" / "carriage_on_slack_rope.yaml")
    spec = replace(spec, scenario=replace(spec.scenario, conditions=Conditions(sampling=Sampling(sample_time=0.0055))))
    controller = design(spec)
    claim, own = controller.claim(SampledLoop), asked_of(spec, None, replace(controller, claims=()))
    assert claim.proof is not None
    assert own.sampled is not None
    every = list(candidates(controller.plant, controller.sizes, spec.objectives.goals, own.sampled))
    proved = [with_forms(controller.plant, each, claim.estimates, controller.sizes) is not None for each in every[:-1]]
    assert not any(proved[:-1])
    assert (claim.gains.M == every[-1 - proved[-1]].M).all()
    content = design_certificate(spec, controller)
    assert not audit(json.dumps(content))[1]
    (told,) = SampledLoop.prove(controller, own, content)
    assert told.data(controller) == claim.data(controller)
    assert not any("other gains" in one for one in sampling_remarks(controller))


def test_without_a_proof_it_runs_with_gains_that_are_stable_in_each_cell_if_there_are_some(tmp_path: Path) -> None:
    stops = "{name: stops, kind: dead_zone, of: z, lower: -0.05, upper: 0.05, slope: 20, into: {v: -1}}"
    text = mass(stops, simulation="{duration: 1, sample_time: 0.1, controller: {sample_time: 0.3}}")
    (tmp_path / "mass.yaml").write_text(text, encoding="utf-8")
    spec = load_spec(tmp_path / "mass.yaml")
    controller = design(spec)
    claim, own = controller.claim(SampledLoop), asked_of(spec, None, replace(controller, claims=()))
    assert claim.proof is None
    assert own.sampled is not None
    stable = [refused(replace(controller, claims=(claim,)), spec.scenario.conditions) is None]
    made = replace(claim, gains=own.sampled)
    stable.append(refused(replace(controller, claims=(made,)), spec.scenario.conditions) is None)
    assert stable == [True, False]
    content = design_certificate(spec, controller)
    (told,) = SampledLoop.prove(controller, own, content)
    assert (told.gains.K == claim.gains.K).all()
    assert (told.gains.M == claim.gains.M).all()


FORGED: dict[str, Callable[[Any], Any]] = {
    "a larger rate": lambda s: s.update(rate="3"),
    "no rate": lambda s: s.update(rate="0"),
    "a longer sample time": lambda s: s.update(sample_time="0.5"),
    "no sample time": lambda s: s.update(sample_time="0"),
    "another K": lambda s: s["K"][0].__setitem__(0, "5"),
    "another M": lambda s: s["M"][0].__setitem__(0, "5"),
    "a K with a column more": lambda s: s["K"][0].append("0"),
    "an M with a row less": lambda s: s["M"].pop(),
    "no K": lambda s: s.update(K=[]),
    "one substep": lambda s: s.update(substeps=1, P=s["P"][:2]),
    "more substeps than knots": lambda s: s.update(substeps=3),
    "very many substeps": lambda s: s.update(substeps=10**9),
    "inputs that are later": lambda s: s.update(delay=1),
    "inputs that are much later": lambda s: s.update(delay=2),
    "inputs that are early": lambda s: s.update(delay=-1),
    "ticks that come anywhere": lambda s: s.update(jitter="0.049"),
    "ticks that come before the one before": lambda s: s.update(jitter="0.05"),
    "a jitter that is negative": lambda s: s.update(jitter="-0.001"),
    "no substep": lambda s: s.update(substeps=0),
    "knots that are missing": lambda s: s["P"].pop(),
    "no knots": lambda s: s.update(P=[]),
    "knots in another order": lambda s: s["P"].reverse(),
    "a form that is changed": lambda s: s["P"][1]["integers"][0].__setitem__(0, "1"),
    "a form with a row less": lambda s: s["P"][0]["integers"].pop(),
    "a form of other size": lambda s: s["P"].__setitem__(0, {"integers": [["1"]], "exponents": [0]}),
    "a negative form": lambda s: [
        P.update(integers=[[str(-int(v)) for v in row] for row in P["integers"]]) for P in s["P"]
    ],
    "no rows": lambda s: s.update(rows=[]),
    "rows of 0": lambda s: s.update(rows=[["0", "0"]]),
    "other rows": lambda s: s.update(rows=[["0", "1"]]),
    "rows of other length": lambda s: s.update(rows=[["1"]]),
    "very many rows": lambda s: s.update(rows=[["1", "0"]] * 5000),
    "a key that is missing": lambda s: s.pop("rate"),
    "a key more": lambda s: s.update(alpha="1"),
    "whole numbers that are texts": lambda s: s.update(substeps="2"),
}


@pytest.mark.parametrize("name", FORGED)
def test_a_forged_proof_is_refused(name: str, certified: tuple[Spec, ProvedController, dict[str, Any]]) -> None:
    content = copy.deepcopy(certified[2])
    FORGED[name](content["sampled"])
    content["bounds"] = []  # they take long
    faults = audit(json.dumps(content))[1]
    assert faults
    assert not any(fault.startswith("not a certificate") for fault in faults), faults


def test_a_proof_of_a_plant_with_other_loads_is_refused(
    certified: tuple[Spec, ProvedController, dict[str, Any]],
) -> None:
    content = copy.deepcopy(certified[2])
    content["plant"]["loads"]["S"] = [["-1"]]
    faults = audit(json.dumps(content))[1]
    assert faults == ["the forms of the sampled loop are not those of its knots"]


def test_a_plant_of_one_cell_is_proved_without_rows(tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text("\n".join(line for line in LOADED.splitlines() if "stop" not in line and "nonlin" not in line))
    spec = load_spec(path)
    controller = design(spec)
    found = with_sampled(spec, controller, gains_of(controller, 0.05, 4))
    content = design_certificate(spec, found)
    assert content["sampled"]["rows"] == []
    assert len(content["sampled"]["P"]) == 2
    assert audit(json.dumps(content))[1] == []
    content["sampled"]["rows"] = [["1", "0"]]
    faults = audit(json.dumps(content))[1]
    assert faults == ["the rows of the sampled loop do not span the differences of its cells"]


@pytest.mark.parametrize("which", ["section", "loaded"])
@pytest.mark.parametrize(("delay", "jitter"), [(0, 0.0), (1, 0.01), (2, 0.01)])
def test_the_auditor_makes_the_same_matrices_from_the_file(
    which: str, delay: int, jitter: float, request: pytest.FixtureRequest
) -> None:
    spec, controller = request.getfixturevalue(which)
    gains = gains_of(controller, 0.05, 2, regulator(controller.plant, 0.05))
    gains = replace(gains, delay=delay, jitter=jitter)
    errors = SampledErrors.of(controller.plant, gains)
    content = design_certificate(spec, controller)
    told = SampledLoop(gains=gains, proof=ClockedProof(P=(), T=(), rate=1.0)).data(controller)["sampled"]
    again = AuditedErrors(told, Loop(AuditedPlant(content["plant"]), [], [], None))
    system = errors.clocked
    assert system.between is not None
    flows, factors = zip(*((box.middle, box.factors) for box in again.opened(errors.flows[1])), strict=True)
    U, V = zip(*factors, strict=True)
    assert (len(flows), len(V[0])) == errors.flows
    pairs = (system.F, flows), (system.J, again.ticks), ([system.between], [again.substep])
    for own, audited in (*pairs, (system.U, map(Ball, U)), (system.V, map(Ball, V))):
        texts = [tuple(tuple(map(Fraction, row)) for row in X.texts) for X in own]
        assert sorted(texts) == sorted(tuple(map(tuple, ball.centre)) for ball in audited if ball.centre)


def test_what_is_not_proved_is_said(section: tuple[Spec, ProvedController]) -> None:
    spec, controller = section
    slow = replace(gains_of(controller, 2.0), K=10 * controller.K)
    found = with_sampled(spec, controller, slow)
    assert the_claim(found).proof is None
    assert the_claim(found).data(found) == {}
    rows = list(the_claim(found).rows(spec.words, found))
    assert rows[0] == ("sampled loop", "not proved: no forms were found that prove it")
    (told,) = SampledLoop.prove(controller, asking(spec, controller, slow), {"sampled": None})
    assert list(told.rows(spec.words, found))[1:] == rows[1:]
    assert told.sentence == the_claim(found).sentence
    assert list(SampledLoop.prove(controller, replace(asking(spec, controller, slow), sampled=None))) == []


@pytest.mark.slow
@pytest.mark.parametrize(("h", "delay"), [(0.1, 0), (1.5, 1)])
def test_the_longest_sample_time_is_proved_and_below_one_that_is_unstable(
    h: float, delay: int, loaded: tuple[Spec, ProvedController]
) -> None:
    _, controller = loaded
    sampling, design = Sampling(sample_time=h, delay=delay), (controller.plant, controller.K, controller.L)
    claim = SampledLoop(gains=sampled_gains(*design, sampling), proof=None, design=(*design, controller.sizes))
    longest = claim.longest
    assert longest is not None
    assert with_forms(controller.plant, sampled_gains(*design, replace(sampling, sample_time=longest))) is not None
    unstable = SampleMaps(controller, controller.plant, sampling).longest(100.0)
    assert unstable is not None
    assert 0.2 * unstable < longest < unstable
    found = replace(controller, claims=(claim,))
    (remark,) = sampling_remarks(found)
    assert f"up to a sample time of {longest:g} s" in remark
    assert remark.startswith("1.5 s are too long for a proof: ") == (h > longest)


def test_a_plant_with_too_many_cells_is_not_tried(section: tuple[Spec, ProvedController]) -> None:
    spec, controller = section
    gains = gains_of(controller, 0.05, 1000)
    (claim,) = SampledLoop.prove(controller, asking(spec, controller, gains))
    assert claim.missing == "its cells are too many"


def test_outermost_matrices_and_the_rows_that_they_differ_in() -> None:
    grid = [BallMatrix.of([[a, b], [0, 1]]) for a in (0, 1, 5) for b in ("0.5", 2, 3)]
    corners = outermost(grid)
    assert sorted((X.floats[0, 0], X.floats[0, 1]) for X in corners) == [(0, 0.5), (0, 3), (5, 0.5), (5, 3)]
    assert held_rows(differences(corners), 2).texts == [["1", "0"], ["0", "1"]]
    assert held_rows(differences(corners[:3]), 2).texts == [["1", "0"], ["0", "1"]]
    one = [BallMatrix.of([[0, 2, 4]]), BallMatrix.of([[0, 1, 2]])]
    assert held_rows(differences(one), 3).texts == [["0", "1", "2"]]
    unsure = [BallMatrix(X.centre, BallMatrix.of([["0", "0", "0.1"]]).centre) for X in one]
    assert held_rows(differences(unsure), 3).texts == [["0", "1", "0"], ["0", "0", "1"]]
    assert len(outermost([*unsure, unsure[0]])) == 2


small = st.integers(-3, 3)
columns = st.lists(small, min_size=3, max_size=3)
edges_of = st.lists(st.tuples(columns, columns), min_size=1, max_size=3)


@given(edges_of, st.randoms())
@settings(max_examples=60)
def test_corners_of_a_box_are_known_as_one_by_both_halves(
    edges: list[tuple[list[int], list[int]]], chance: Any
) -> None:
    """All ± sums of products u vᵀ that are independent; one corner less, or one that is moved, is no box."""
    each = [np.outer(u, v) for u, v in edges]
    assume(np.linalg.matrix_rank([X.ravel() for X in each]) == len(each))
    floats = [sum((s * X for s, X in zip(signs, each, strict=True)), np.eye(3)) for signs in all_signs(len(each))]
    chance.shuffle(floats)
    corners = [BallMatrix.of(X.astype(int).tolist()) for X in floats]
    (box,), (again,) = boxes(corners), audited_boxes([ball_of(X) for X in corners])
    assert box.middle.floats.tolist() == np.eye(3).tolist()
    assert again.edges == [[list(map(fraction_of, row)) for row in D.tolist()] for D in box.edges]
    assert {tuple(abs(floats_of(D)).ravel()) for D in box.edges} == {tuple(abs(X).ravel().astype(float)) for X in each}
    moved = [corners[0] + BallMatrix.of([[0, 0, 0], [0, 1, 0], [0, 0, 7]]), *corners[1:]]
    for some in (corners[1:], moved) if len(corners) > 2 else ():
        assert len(boxes(some)) == len(audited_boxes([ball_of(X) for X in some])) == len(some)


def all_signs(count: int) -> list[tuple[int, ...]]:
    return list(product((1, -1), repeat=count))


def ball_of(X: BallMatrix) -> Ball:
    return Ball([[Fraction(v) for v in row] for row in X.texts])


IN_UNITS = """
name: A mass and a bumper
parameters: {m: 2, d: 8, k: 60, s: SIZE}
system:
  states: [z, v]
  inputs: [F]
  outputs: [y]
  A: [[0, 1], [-3/m, -d/m]]
  B: [[0], [s/m]]
  C: [[1, 0]]
  nonlinearities:
    - {name: bumper, kind: spring, of: z, start: 0.1*s, slope: k, into: {v: -1/m}}
reference: {output: "0.15*s*sin(t)"}
simulation: {duration: 12, sample_time: 0.01, controller: {sample_time: {nominal: 0.01, jitter: 0.0002}}}
"""


def test_other_units_change_neither_the_program_nor_what_is_proved(tmp_path: Path) -> None:
    found = list[SampledLoop]()
    for size in ("1", "1e6", "1e-6"):
        path = tmp_path / "plant.yaml"
        path.write_text(IN_UNITS.replace("SIZE", size), encoding="utf-8")
        found.append(the_claim(design(load_spec(path))))
    one, *others = found
    for other in others:
        assert other.gains.substeps == one.gains.substeps == 2
        assert other.rate == pytest.approx(one.rate, rel=1e-3)
