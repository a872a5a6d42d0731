"""Limits of outputs and states: refused, proved from which starts and under what acts, or simulated and missed."""

import json
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from pwatrack import design, load_spec, simulate
from pwatrack.claims.kept import KeptLimits
from pwatrack.claims.registry import data, proved
from pwatrack.commands.verify import verify
from pwatrack.errors import InvalidSpec, OutsideTheory
from pwatrack.lmi.audit.certificate import audit
from pwatrack.workflow.pipeline import asked_of
from tests.test_cli import call

LAG = """
name: A lag
system:
  states: [x]
  inputs: [u]
  outputs: [y]
  units: {x: m, y: m, u: N}
  A: [[-1]]
  B: [[2]]
  C: [[1]]
design: {tracking: state, controller: {K: [[-1.5]]}, observer: {L: [[-4]]}}
reference: {state: [0.2*sin(t)]}
simulation: {duration: 12, sample_time: 0.01, INITIAL}
require: {limits: {LIMITS}}
"""
STOP = """
name: Stage
system:
  states: [z, v]
  inputs: [u]
  outputs: [y, w]
  track: [y]
  units: {z: m, v: m/s, u: N, y: m}
  A: [[0, 1], [0, -1.5]]
  B: [[0], [0.5]]
  C: [[1, 0], [1, 1]]
  nonlinearities: [{name: stop, kind: spring, of: z, start: 0.2, slope: 20, into: {v: -0.5}}]
reference: {output: 0.25*sin(2*t)}
simulation: {duration: 20, sample_time: 0.01, INITIAL}
require: {limits: {LIMITS}}
"""


def written(folder: Path, text: str, limits: str, initial: str = "initial: {plant: [0.1]}") -> Path:
    path = folder / "spec.yaml"
    path.write_text(text.replace("INITIAL", initial).replace("LIMITS", limits), encoding="utf-8")
    return path


def kept(path: Path) -> KeptLimits:
    return design(load_spec(path)).claim(KeptLimits)


def test_one_state_keeps_what_it_keeps_by_hand(tmp_path: Path) -> None:
    """|x_d| ≤ 0.2, so [-0.5, 0.4] leave 0.2. e' = -4 e + 3 Δ·…, and with x̂ = x it is largest at the start."""
    claim = kept(written(tmp_path, LAG, "x: [-0.5, 0.4]"))
    peak = claim.signals.room.peak
    assert peak is not None
    assert [peak.low[0], peak.high[0]] == pytest.approx([-0.2, 0.2], abs=1e-6)
    assert claim.left == pytest.approx([0.2], rel=1e-5)
    assert claim.left is not None
    size = design(load_spec(tmp_path / "spec.yaml")).sizes.state[0]
    scales = {p.starts.kind: p.scale(claim.left) for p in claim.promises}
    assert scales["exact"] == pytest.approx(0.2 / size, rel=1e-3)


def test_what_acts_takes_its_part(tmp_path: Path) -> None:
    """e' = -4 e - 3 Δ + d, Δ' = -5 Δ - d for |d| ≤ 0.1: from error 0 |e| ≤ 0.1 ∫ |g|, g = 4 e^(-4 t) - 3 e^(-5 t)."""
    path = written(tmp_path, LAG, "x: [-0.5, 0.5]", "disturbance: {x: {sine: {amplitude: 0.1, frequency: 3}}}")
    claim = kept(path)
    t = np.linspace(0, 10, 400_001)
    g = np.abs([(expm(np.array([[-4.0, -3.0], [0.0, -5.0]]) * s) @ [1.0, -1.0])[0] for s in t[::400]])
    assert claim.taken == pytest.approx([0.1 * np.trapezoid(g, t[::400])], rel=0.01)
    assert claim.left == pytest.approx([0.3 - claim.taken[0]], rel=1e-5) if claim.taken is not None else False
    said = " ".join(call("simulate", path, "--verbose", "--out", tmp_path / "out").stdout.split())
    assert "the reference takes -0.2 to 0.2 m, which leaves 0.3 m; what acts in this file takes at most" in said
    assert "these limits are kept in this run, with what acts in this file, from" in said  # more may act after it


def test_a_reference_beyond_a_limit_is_refused_with_time_and_figure(tmp_path: Path) -> None:
    """0.2 sin t is at its largest after a quarter of a period."""
    with pytest.raises(
        OutsideTheory, match=r"the reference goes to x = 0\.2 m at t = 1\.57080? s, above its upper limit, 0\.15 m"
    ):
        design(load_spec(written(tmp_path, LAG, "x: [-0.5, 0.15]")))


@pytest.mark.parametrize(
    ("limits", "said"),
    [
        ("q: [0, 1]", "'q' is no output or state (y, x)"),
        ("u: [0, 1]", "limits of inputs stand under simulation: actuator"),
        ("y: [1, 0]", "the lower limit 1 is not below the upper one, 0"),
        ("y: 3", "a lower and an upper limit such as [-1, 1] are expected"),
    ],
)
def test_what_is_no_limit_is_said_where_it_stands(tmp_path: Path, limits: str, said: str) -> None:
    with pytest.raises(InvalidSpec) as refused:
        load_spec(written(tmp_path, LAG, limits))
    assert said in str(refused.value)
    assert "require.limits." in str(refused.value)


def test_a_run_that_leaves_a_limit_is_missed_with_the_figure_between_samples(tmp_path: Path) -> None:
    """The highest of y is that of the run on a grid a hundred times finer; limits of what is not tracked count too."""
    path = written(tmp_path, STOP, "y: [-0.4, 0.3], v: [-9, 9], w: [-.inf, 9]", "initial: {plant: [0.1, 2]}")
    spec = load_spec(path)
    found = simulate(spec).figures
    fine = simulate(replace(spec, scenario=replace(spec.scenario, sample_time=1e-4))).response
    for name, values in (("y", fine.tracked[:, 0]), ("v", fine.x[:, 1]), ("w", fine.y[:, 1])):
        assert found.highest[name] == pytest.approx(values.max(), abs=1e-6)
        assert found.highest[name] >= values.max() - 1e-9
        assert found.lowest[name] == pytest.approx(values.min(), abs=1e-6)
    assert found.highest["y"] > 0.3
    ended = call("simulate", path, "--out", tmp_path / "out")
    assert ended.exit_code == 6
    assert "highest of y" in ended.output
    content = json.loads((tmp_path / "out" / "run.json").read_text(encoding="utf-8"))
    assert content["figures"]["highest"]["y"] == found.highest["y"]
    assert set(content["kept_limits"]["signals"]) == {"y", "v", "w"}


@pytest.mark.parametrize("seed", range(3))
def test_no_start_within_the_promise_leaves_a_limit_under_any_switching(tmp_path: Path, seed: int) -> None:
    """Errors from corners of the starts, cells of plant and observer that switch at random."""
    spec = load_spec(written(tmp_path, STOP, "y: [-0.5, 0.4], v: [-2, 2], w: [-1.5, 3]", "initial: {plant: [0.1, 0]}"))
    controller = design(spec)
    claim, plant = controller.claim(KeptLimits), controller.plant
    left, K, L = claim.left, controller.K, controller.L
    assert left is not None
    assert {p.starts.kind for p in claim.promises} == {"exact", "sizes", "run"}
    rows = np.array([plant.tracked[0], [0.0, 1.0], plant.C[1]])
    pairs = product(plant.A, plant.A)
    M = [np.block([[A + plant.B @ K, plant.B @ K], [np.zeros((2, 2)), H + L @ plant.C]]) for A, H in pairs]
    fastest = max(float(np.abs(np.linalg.eigvals(X)).max()) for X in M)
    steps, random, worst = [expm(X * 0.05 / fastest) for X in M], np.random.default_rng(seed), 0.0
    for promise in claim.promises:
        G, scale = promise.starts.G, promise.scale(left)
        for _ in range(40):
            corner = scale * G @ random.choice([-1.0, 1.0], size=G.shape[1])
            z, hold, mode = np.concatenate([corner, np.zeros(4 - len(corner))]), int(random.integers(1, 30)), 0
            for k in range(400):
                worst = max(worst, float((np.abs(rows @ z[:2]) / left).max()))
                mode = mode if k % hold else int(random.integers(len(steps)))
                z = steps[mode] @ z
    assert 0.3 < worst <= 1


def test_what_is_promised_is_audited_read_again_and_a_smaller_number_is_found_out(tmp_path: Path) -> None:
    path, out = written(tmp_path, STOP, "y: [-0.5, 0.4], w: [-1.5, 3]", "initial: {plant: [0.1, 0]}"), tmp_path / "out"
    call("design", path, "--out", out)
    assert "the bounds of signals with limits from 3 boxes of starts are proved" in verify(out, path)
    spec = load_spec(path)
    controller = design(spec)
    bare, asked = replace(controller, claims=()), asked_of(spec, None, controller)
    again = proved(bare, asked, told=data(controller)).claim(KeptLimits)
    before = controller.claim(KeptLimits)
    assert again.left == pytest.approx(before.left)
    assert [p.held.sizes for p in again.promises if p.held] == [p.held.sizes for p in before.promises if p.held]
    content = json.loads((out / "certificate.json").read_text(encoding="utf-8"))
    entry = content["limits"][0]
    assert [signal[:2] for signal in entry["signals"]] == [["output", 0], ["measured", 1]]
    for change, fault in (
        ({"signals": [["output", 0, "0.0001"]]}, "output 0 is not bounded by 0.0001"),
        ({"signals": [["output", 0, "9"], ["input", 0, "9"]]}, "limits are said of"),
        ({"loop": "observer"}, "limits are not said of the loop 'observer'"),
        ({"signals": [["measured", 2, "9"]]}, ""),
    ):
        assert any(fault in said for said in audit(json.dumps(content | {"limits": [entry | change]}))[1]), change


def test_members_of_an_ensemble_keep_them_too(tmp_path: Path) -> None:
    path = written(tmp_path, LAG, "x: [-0.9, 0.9]", "ensemble: {initial: {plant: {x: [-0.8, 0.8]}}}")
    text = path.read_text(encoding="utf-8").replace("require: {", "require: {ensemble: {limits: {x: [-0.5, 0.5]}}, ")
    path.write_text(text, encoding="utf-8")
    ended = call("simulate", path, "--ensemble", "20", "--out", tmp_path / "out")
    assert ended.exit_code == 6
    assert "of 20 members" in ended.output


def test_a_load_that_steps_takes_its_part_at_any_time(tmp_path: Path) -> None:
    """What a step leaves goes to 0, so it is none of what is left in the end: but it comes first."""
    text = STOP.replace("reference", "design: {estimate: input}\nreference").replace("0.25*sin(2*t)", "0.1*sin(t)")
    found = []
    for step in ("", ", disturbance: {v: {step: {size: 3, at: 10.3}}}"):
        path = written(
            tmp_path, text.replace("INITIAL", f"INITIAL{step}"), "y: [-0.3, 0.3]", "initial: {plant: steady}"
        )
        found.append(kept(path))
    still, stepping = found
    assert still.promises
    assert stepping.taken is not None
    assert stepping.taken[0] > 0.1
    later = path.read_text(encoding="utf-8").replace("at: 10.3", "at: 25")  # after the run
    path.write_text(later, encoding="utf-8")
    spec = load_spec(path)
    controller = design(spec)
    said = " ".join(text for _, text in controller.claim(KeptLimits).rows(spec.words, controller))
    assert "kept in this run" in said
    assert "for good" not in said


def test_noise_of_a_start_that_is_measured_is_part_of_it(tmp_path: Path) -> None:
    """x' = −x + u from x_d on, x̂(0) = y: all of its error is noise, of up to 3 standard deviations."""
    text = LAG.replace("[[2]]", "[[1]]").replace("[[-1.5]]", "[[-3]]").replace("[[-4]]", "[[-0.2]]")
    text = text.replace("tracking: state, ", "").replace("{state: [0.2*sin(t)]}", "{output: {constant: 0.3}}")
    noise = "initial: {plant: steady, observer: OBSERVER}, noise: {std: {y: 0.1}, sample_time: 0.05, seed: 8}"
    for name in ("steady", "measured"):
        (tmp_path / name).mkdir()
    paths = (
        written(tmp_path / name, text, "x: [0.24, 0.36]", noise.replace("OBSERVER", name))
        for name in ("steady", "measured")
    )
    steady, measured = map(kept, paths)
    assert any(one.of_this_run(steady.left) for one in steady.promises)
    assert not any(one.of_this_run(measured.left) for one in measured.promises)


def test_steps_of_inputs_are_not_counted_and_it_says_so(tmp_path: Path) -> None:
    sampled = "quantum: {u: 0.5}, controller: {sample_time: 0.01}, noise: {std: {y: 1e-6}, sample_time: 0.1, seed: 1}"
    path = written(tmp_path, STOP, "y: [-0.3, 0.3]", sampled)
    spec = load_spec(path)
    controller = design(spec)
    said = [text for _, text in controller.claim(KeptLimits).rows(spec.words, controller)]
    assert "what acts in this file but steps of inputs takes at most" in said[0]
    assert all("with what acts in this file but steps of inputs, noise" in text for text in said[1:])


def test_nothing_is_said_where_loads_move_what_is_limited(tmp_path: Path) -> None:
    """x' = v + d: d is made up for by another v_d, which no bound of v − v_d has in it."""
    text = STOP.replace("reference", "design: {estimate: {d: {into: {z: 1}}}}\nreference").replace(
        "0.25*sin(2*t)", "0.1*sin(t)"
    )
    text = text.replace("INITIAL", "INITIAL, disturbance: {z: {step: {size: 0.5, at: 5}}}")
    for limits, known in (("v: [-0.6, 0.6]", False), ("y: [-3, 3]", True)):
        claim = kept(written(tmp_path, text, limits, "initial: {plant: steady}"))
        assert (not claim.missing) is known
        assert bool(claim.promises) is known
