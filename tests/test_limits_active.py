"""Inputs at their limits: from which starts errors go to 0 all the same; beyond them they need not."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.linalg import block_diag, solve_continuous_are, solve_continuous_lyapunov

from pwatrack import design, load_spec, simulate
from pwatrack.arrays import Array, IntArray
from pwatrack.ball_matrix import BallMatrix
from pwatrack.claims.limits import NoSaturation
from pwatrack.claims.region import LimitedRegion
from pwatrack.commands.verify import verify
from pwatrack.lmi import polynomial_region
from pwatrack.lmi.audit.certificate import audit
from pwatrack.lmi.ellipsoid import Inner
from pwatrack.lmi.polynomial import Monomials
from pwatrack.lmi.polynomial_region import AnyRegion, PolynomialRegion, region_around, scale_of
from pwatrack.lmi.saturated import LimitedGain, Region, SaturatedLoop
from pwatrack.model.conditions import Conditions
from pwatrack.model.reference import exosystem
from pwatrack.model.signal import ExponentialPolynomial, Signal
from pwatrack.simulation.closed_loop import closed_loop
from pwatrack.simulation.propagate import simulate_flow
from tests.test_cli import call, refused
from tests.test_within_limits import STAGE, written

TANK = """
name: A tank that is heated and not cooled
system:
  states: [T]
  inputs: [Q]
  outputs: [y]
  units: {T: degC, Q: kW, y: degC}
  sizes: {T: 1, Q: 5}
  A: [[-0.1]]
  B: [[0.5]]
  C: [[1]]
design: {tracking: state, MORE}
reference: {setpoint: {y: LEVEL}}
simulation: {duration: 60, sample_time: 0.1, actuator: {limits: {Q: [0, 8]}}}
"""


def region(path: Path) -> LimitedRegion:
    return design(load_spec(path)).claim(LimitedRegion)


def scaled(found: LimitedRegion) -> dict[str, float]:
    left = found.room.spare
    assert left is not None
    return {one.starts.kind: one.scale(left) for one in found.found}


@settings(max_examples=20)
@given(st.floats(0.1, 3), st.floats(0.2, 5), st.floats(1.2, 20), st.floats(0.1, 5))
def test_an_unstable_state_is_held_from_as_far_as_its_limit_holds_it(a: float, b: float, k: float, most: float) -> None:
    """e' = a e + b sat(−k a/b e), |sat| ≤ most, goes to 0 from |e| < b most / a, and from nowhere else."""
    A, B, D = (BallMatrix.of([[v]]) for v in (a, b, -k * a / b))
    loop = SaturatedLoop(M=[A + B @ D], B=B, D=D, inners=[Inner(Q=np.eye(1), most=2 * (k - 1) * a)])
    assert loop.everywhere() is None
    found = loop.around(np.array([[1.0]]), np.array([most]))
    assert found is not None
    share = most / found.sizes[0]
    assert 0.99 * b * most / a < share < b * most / a


def test_where_the_plant_is_stable_by_itself_it_is_from_every_start_without_room_on_one_side(tmp_path: Path) -> None:
    """The feedforward is at its limit of 0: no start is without one at its limit, and all of them converge."""
    for level in ("0", "20"):
        path = tmp_path / "tank.yaml"
        path.write_text(TANK.replace("MORE", "observer: {rate: 1}").replace("LEVEL", level), encoding="utf-8")
        said = " ".join(call("design", path, "--verbose", "--out", tmp_path / "out").stdout.split())
        assert "errors go to 0 from every start, with inputs at their limits too" in said
        assert verify(tmp_path / "out", path)
    made = design(load_spec(path))
    for start, limit in ((-300.0, 8.0), (500.0, 0.0)):
        loop = closed_loop(made, Conditions(limits=np.array([[0.0, 8.0]])))
        begin = loop.start(plant=np.array([start]), observer=np.zeros(1), generator=np.zeros(0))
        response = loop.response(simulate_flow(loop.flow, begin, duration=200.0, sample_time=0.1))
        assert (response.u == limit).any()
        assert abs(response.x[-1, 0] - 20) < 1e-4


def test_loads_that_every_start_bears_are_what_leaves_the_feedforward_in_its_limits(tmp_path: Path) -> None:
    """u_ff = 4 kW of 0 to 8 kW; loads from −4 to 4 kW are taken off it."""
    path = tmp_path / "tank.yaml"
    path.write_text(TANK.replace("MORE", "estimate: input").replace("LEVEL", "20"), encoding="utf-8")
    said = " ".join(call("design", path, "--verbose", "--out", tmp_path / "out").stdout.split())
    assert "errors go to 0 from every start and all constant loads at Q from −3.999 to 3.999 kW, with" in said
    made = design(load_spec(path))
    for load, rests in ((3.9, True), (-3.9, True), (4.4, False)):
        push = exosystem([Signal.of(ExponentialPolynomial.constant(load / 2))])
        loop = closed_loop(made, Conditions(limits=np.array([[0.0, 8.0]]), disturbance=push))
        begin = loop.start(plant=np.array([90.0]), observer=np.zeros(1), generator=np.zeros(0))
        response = loop.response(simulate_flow(loop.flow, begin, duration=300.0, sample_time=0.1))
        assert (abs(response.x[-1, 0] - 20) < 1e-3) == rests


BIG = STAGE.replace("  units:", "  sizes: {z: 0.5, v: 1, u: 2}\n  units:").replace("slope: 50", "slope: 2")


@pytest.mark.slow
def test_the_region_is_larger_than_where_no_limit_is_reached_and_is_audited(tmp_path: Path) -> None:
    path, out = written(tmp_path, BIG, REFERENCE="0.1*sin(t)", LIMITS="[-2, 2]"), tmp_path / "out"
    made = design(load_spec(path))
    left = made.claim(NoSaturation).room.left
    assert left is not None
    never = {one.starts.kind: one.scale(left) for one in made.claim(NoSaturation).promises}
    active = scaled(made.claim(LimitedRegion))
    assert active.keys() == never.keys() == {"exact", "sizes", "run"}
    assert all(active[kind] > 1.3 * scale for kind, scale in never.items())
    call("design", path, "--out", out)
    own = "errors go to 0 from 3 boxes of starts, with inputs at their limits too, as long as"
    assert any(text.startswith(own) for text in verify(out, path))


def test_a_region_by_an_ellipsoid_is_audited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(polynomial_region, "DEGREES", ())
    path, out = written(tmp_path, BIG, REFERENCE="0.1*sin(t)", LIMITS="[-2, 2]"), tmp_path / "out"
    call("design", path, "--out", out)
    content = json.loads((out / "certificate.json").read_text(encoding="utf-8"))
    entry = content["regions"][0]
    (h, *rest), *_ = entry["H"]
    for change, fault in (
        ({"H": [[str(-float(h)), *rest]]}, "errors can leave it, or do not go to 0"),
        ({"H": [[str(1.2 * float(h)), *rest]]}, "is not bounded by"),
        ({"H": []}, "the rows of a region do not fit"),
        ({"signals": [["input", 0, "1e-06"]]}, "input 0 is not bounded by 1e-06"),
        ({"signals": [], "H": []}, "a region of no input"),
        ({"starts": [["9000000000", "0"], ["0", "9000000000"]]}, "a start is not in the ellipsoid"),
        ({"weights": []}, "the weights of the starts are not positive"),
        ({"of": "every", "starts": [[], []], "weights": []}, "a region of every start has no starts, and no rows"),
        ({"of": "every", "weights": [], "H": [["0", "0"]]}, "errors can leave it, or do not go to 0"),
    ):
        wrong = audit(json.dumps(content | {"regions": [entry | change]}))[1]
        assert any(fault in each for each in wrong), (fault, wrong)


@pytest.mark.slow
def test_a_region_by_a_polynomial_is_larger_and_audited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, out = written(tmp_path, BIG, REFERENCE="0.1*sin(t)", LIMITS="[-2, 2]"), tmp_path / "out"
    call("design", path, "--out", out)
    content = json.loads((out / "certificate.json").read_text(encoding="utf-8"))
    larger = scaled(design(load_spec(path)).claim(LimitedRegion))
    monkeypatch.setattr(polynomial_region, "DEGREES", ())
    smaller = scaled(design(load_spec(path)).claim(LimitedRegion))
    assert larger["exact"] > 1.2 * smaller["exact"]
    assert all(larger[kind] >= smaller[kind] for kind in smaller)
    entry = content["regions"][0]
    V, (h, *rest) = entry["V"], entry["H"][0]
    N = V["N"][0]
    forged = N | {"integers": [[v + (j == k == 0) for k, v in enumerate(row)] for j, row in enumerate(N["integers"])]}
    for change, fault in (
        ({"H": [[str(-float(h)), *rest]]}, "errors can leave it, or do not go to 0"),
        ({"H": [[str(1.2 * float(h)), *rest]]}, "is not bounded by"),
        ({"H": []}, "the rows of a region do not fit"),
        ({"signals": [["input", 0, "1e-06"]]}, "input 0 is not bounded by 1e-06"),
        ({"signals": [["input", 0, "-10"]]}, "input 0 is not bounded by -10"),
        ({"starts": [["9000000000", "0"], ["0", "9000000000"]]}, "a start is not in the region"),
        ({"weights": entry["weights"][1:]}, "the weights of the starts are not positive"),
        ({"weights": [*entry["weights"][1:], "0.9"]}, "the weights of the starts are not positive"),
        ({"of": "every"}, "a polynomial holds a region of some starts"),
        ({"V": V | {"of": "observer"}}, "a polynomial holds a region of some starts"),
        ({"V": V | {"N": [forged, *V["N"][1:]]}}, "m^T N m is not 0"),
        ({"V": V | {"N": V["N"][1:]}}, "there is not one N for each different matrix"),
        ({"V": V | {"degree": "8"}}, "P is not of the order of the monomials"),
        ({"V": V | {"rate": "100"}}, "the inequality fails"),
    ):
        wrong = audit(json.dumps(content | {"regions": [entry | change]}))[1]
        assert any(fault in each for each in wrong), (fault, wrong)


def growth(loop: SaturatedLoop, found: AnyRegion, share: float, random: np.random.Generator, starts: int) -> float:
    """The most that a gauge grows by in a step from the edge of a region, cells at random, inputs at their limits.

    Of room 1 for each input, and of the region that is `share` times as large.
    """
    B, D = loop.B.floats, loop.D.floats
    z = random.normal(size=(starts, len(B)))
    z = share * found.reach(z)[:, None] * z
    A = np.array([M.floats - B @ D for M in loop.M])
    step = 0.05 / float(np.abs(np.linalg.eigvals([M.floats for M in loop.M])).max())

    def slope(mode: IntArray, z: Array) -> Array:
        return np.asarray(np.einsum("sij,sj->si", A[mode], z) + np.clip(z @ D.T, -1.0, 1.0) @ B.T)

    worst, before, cut, mode = -np.inf, np.ones(starts), 0, np.zeros(starts, dtype=np.int64)
    for k in range(200):
        mode = np.asarray(random.integers(len(A), size=starts)) if k % 5 == 0 else mode
        cut += int((np.abs(z @ D.T) > 1).any(axis=1).sum())
        k1 = slope(mode, z)
        k2 = slope(mode, z + step / 2 * k1)
        k3 = slope(mode, z + step / 2 * k2)
        z = z + step / 6 * (k1 + 2 * k2 + 2 * k3 + slope(mode, z + step * k3))
        gauge = 1 / (share * found.reach(z))
        worst, before = max(worst, float((gauge - before).max())), gauge
    assert cut > starts / 100
    return worst


def random_loop(random: np.random.Generator, n: int, m: int, cells: int) -> SaturatedLoop:
    """A loop of (e, Δ) whose cells differ a little, with gains of a regulator; its inputs are all limited."""
    A0, B = random.normal(size=(n, n)), random.normal(size=(n, m))
    X, Y = (
        solve_continuous_are(A0, B, np.eye(n), np.eye(m)),
        solve_continuous_are(A0.T, np.eye(n), np.eye(n), np.eye(n)),
    )
    K, L = -B.T @ X, -Y
    A = [A0 + 0.05 * random.normal(size=(n, n)) for _ in range(cells)]
    M = [np.block([[A_i + B @ K, B @ K], [np.zeros((n, n)), A_j + L]]) for A_i in A for A_j in A]
    B, D = np.vstack([B, np.zeros((n, m))]), np.hstack([K, K])
    inner = Inner(Q=block_diag(np.linalg.inv(X), Y), most=1.0)
    balls = [BallMatrix.of(F.round(6)) for F in (*M, B, D)]
    return SaturatedLoop(M=balls[:-2], B=balls[-2], D=balls[-1], inners=[inner])


@pytest.mark.parametrize("seed", range(4))
def test_no_start_on_the_edge_of_a_region_leaves_it_for_any_switching(seed: int) -> None:
    random = np.random.default_rng(seed)
    loop = random_loop(random, 2 + seed % 2, 1 + seed // 2, 2)
    N, m = loop.B.shape
    found = loop.around(np.eye(N), np.ones(m))
    assert found is not None
    assert growth(loop, found, 1 / max(found.sizes), random, 200) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_no_start_on_the_edge_of_a_polynomial_region_leaves_it(seed: int) -> None:
    """Nor does a start of the box that it is said to be around; degree 4 for two inputs, else 4 or 6."""
    random = np.random.default_rng(seed)
    loop = random_loop(random, 2, 1 + seed // 2, 2)
    N, m = loop.B.shape
    G = random.normal(size=(N, N)).round(3)
    ellipsoid, found = loop.around(G, np.ones(m)), region_around(loop, G, np.ones(m))
    assert ellipsoid is not None
    assert isinstance(found, PolynomialRegion)
    assert scale_of(found, np.ones(m)) > scale_of(ellipsoid, np.ones(m))
    assert growth(loop, found, scale_of(found, np.ones(m)), random, 200) < 1e-9
    starts = random.uniform(-1, 1, size=(1000, N)) @ G.T
    assert (found.reach(starts) >= 1).all()
    edge = found.reach(starts)[:, None] * starts
    assert (np.abs(edge @ found.H.T) <= found.sizes).all()


@pytest.mark.parametrize(("n", "k"), [(2, 3), (3, 1), (4, 2)])
def test_monomials_of_what_is_put_in_are_those_of_the_result(n: int, k: int) -> None:
    random, monomials = np.random.default_rng(n), Monomials.of(n, 3)
    X, v, h = random.normal(size=(n, k)), random.normal(size=k), random.normal(size=n)
    S = np.array(monomials.substituted(X.tolist())) * monomials.weights[:, None] / Monomials.of(k, 3).weights
    assert monomials.of_points((X @ v)[None])[0] == pytest.approx(S @ Monomials.of(k, 3).of_points(v[None])[0])
    z = random.normal(size=n)
    plain = monomials.of_points(z[None])[0] / monomials.weights
    assert np.array(monomials.power(h.tolist())) @ plain == pytest.approx(float(h @ z) ** 3)
    assert monomials.of_points(h[None])[0] @ monomials.of_points(z[None])[0] == pytest.approx(float(h @ z) ** 3)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31), st.integers(2, 3), st.integers(1, 2), st.floats(0, 0.5))
def test_whatever_a_gain_against_windup_proves_another_gain_proves_without_it(
    seed: int, n: int, m: int, size: float
) -> None:
    """z = (e, Δ), Δ moved by E (v − D z): R = Q_ee and K' = (H Q)_e R⁻¹ never reach a limit from eᵀ R⁻¹ e ≤ 1."""
    random = np.random.default_rng(seed)
    loop = random_loop(random, n, m, 2)
    B, K = loop.B.floats[:n], loop.D.floats[:, :n]
    E = size * random.normal(size=(n, m)).round(3)
    found = replace(loop, B=BallMatrix.of(np.vstack([B, E]))).around(np.eye(2 * n)[:, :n], np.ones(m))
    assume(found is not None)
    assert found is not None
    Q = np.array([[float(v.p) / float(v.q) for v in row] for row in found.P.tolist()])
    R = Q[:n, :n]
    other = (found.H @ Q)[:, :n] @ np.linalg.inv(R)
    for M in loop.M:
        falls = (M.floats[:n, :n] - B @ K + B @ other) @ R
        assert np.linalg.eigvalsh(falls + falls.T)[-1] < 0
    assert (np.sqrt(np.diag(other @ R @ other.T)) <= np.array(found.sizes) * (1 + 1e-9)).all()


def against_windup(A: list[Array], B: Array, K: Array, LC: Array, E: Array) -> SaturatedLoop:
    """(e, Δ) with all pairs of cells A and E (v − K (e + Δ)) in Δ'."""
    n = len(B)
    M = [np.block([[A_i + B @ K, B @ K], [np.zeros((n, n)), A_j + LC]]) for A_i in A for A_j in A]
    inner = solve_continuous_lyapunov(M[0], -np.eye(2 * n))
    balls = [BallMatrix.of(F.round(6)) for F in (*M, np.vstack([B, E]), np.hstack([K, K]))]
    return SaturatedLoop(M=balls[:-2], B=balls[-2], D=balls[-1], inners=[Inner(Q=inner, most=1e-3)])


CART = np.array([[0, 1, 0, 0], [0, 0, -0.981, 0], [0, 0, 0, 1], [0, 0, 21.582, 0]])
BENT = np.array([[0, 1], [0.5, 0]]), np.array([[0.0, 1], [0, 0]])


@pytest.mark.parametrize(
    ("A", "B", "C", "starts", "cost", "E", "more"),
    [
        ([CART], [0, 20, 0, -40], [0, 2], [0.5, 0.5, 0.2, 0.5], 1.0, [-1.388, 1.165, -0.131, 0.776], 1.08),
        (list(BENT), [0, 1], [0], [1, 1], 0.01, [0.001, -0.011], 1.02),
    ],
)
def test_a_gain_against_windup_can_help_and_never_as_much_as_a_gain_made_for_the_region(
    A: list[Array], B: list[float], C: list[int], starts: list[float], cost: float, E: list[float], more: float
) -> None:
    n, R, column = len(B), np.array([[cost]]), np.array(B, dtype=float)[:, None]
    K = -column.T @ solve_continuous_are(A[0], column, np.eye(n), R) / cost
    rows = np.eye(n)[C]
    LC = -solve_continuous_are(A[0].T, rows.T, np.eye(n), np.eye(len(C))) @ rows.T @ rows
    shares = list[float]()
    for gain in (np.zeros((n, 1)), np.array(E)[:, None]):
        found = against_windup(A, column, K, LC, gain).around(
            np.vstack([np.diag(starts), np.zeros((n, n))]), np.ones(1)
        )
        assert found is not None
        shares.append(1 / found.sizes[0])
    boxes, still = [np.diag(starts)], np.zeros((n, n))
    asked = LimitedGain(
        A=np.array(A), B=np.array([column] * len(A)), shift=still, starts=boxes, room=np.ones(1), over=np.inf
    )
    far = asked.farthest()
    assert far is not None
    assert more * shares[0] < shares[1] < far[2]


@pytest.mark.parametrize("seed", [0, 1, 2, 4])
def test_the_best_gain_against_windup_is_one_program_and_no_trial_is_better(seed: int) -> None:
    random = np.random.default_rng(seed)
    loop, n = random_loop(random, 2, 1, 2), 2
    starts, room = np.eye(2 * n)[:, :n], np.ones(1)

    def held(E: Array) -> float:
        found = replace(loop, B=BallMatrix.of(np.vstack([loop.B.floats[:n], E]))).around(starts, room)
        return 0.0 if found is None else 1 / found.sizes[0]

    E = loop.against_windup(starts, room, n, 1e-4, 1e4)
    assert E is not None
    best = held(E)
    assert best > held(np.zeros((n, 1))) * 0.999
    trials = [E * scale + size * np.abs(E).max() * random.normal(size=E.shape) for scale in (0, 1) for size in (0.1, 1)]
    assert all(held(trial) < best * 1.002 for trial in trials)


def test_a_stable_plant_is_brought_to_0_from_every_start_for_every_gain_by_one_against_windup() -> None:
    """1 / (s + 1)³: no Q is common to A and A + B K as A (A + B K) has a negative eigenvalue (Shorten and Narendra)."""
    A, B, nothing = np.array([[0.0, 1, 0], [0, 0, 1], [-1, -3, -3]]), np.array([[0.0], [0], [1]]), np.zeros((3, 3))
    K = -B.T @ solve_continuous_are(A, B, np.diag([1e4, 0, 0]), np.eye(1))
    eigenvalues = np.linalg.eigvals(A @ (A + B @ K))
    assert any(abs(v.imag) < 1e-9 and v.real < 0 for v in eigenvalues)
    assert against_windup([A], B, K, nothing, 0 * B).everywhere() is None
    assert against_windup([A], B, K, nothing, -B).everywhere() is not None


MOVED = STAGE.replace("slope: 50", "slope: 1").replace("  units:", "  sizes: {z: 0.1, v: SPEED, u: 100}\n  units:")
WAVE = {"REFERENCE": "0.1*sin(t)", "LIMITS": "[-2, 2]"}


@pytest.mark.slow
def test_a_smaller_gain_is_taken_where_starts_are_not_inside_and_what_it_costs_is_said(tmp_path: Path) -> None:
    """2 z'' = u with a u that costs little: the regulator is large, and a twentieth of the starts is in its region."""
    path, out = written(tmp_path, MOVED.replace("d: 3", "d: 0"), SPEED="1.2", **WAVE), tmp_path / "out"
    made = design(load_spec(path))
    cheaper = made.design.cheaper
    assert cheaper is not None
    assert scaled(made.claim(LimitedRegion))["exact"] >= 1
    ratio = float(np.linalg.norm(made.sizes.gain(cheaper)) / np.linalg.norm(made.sizes.gain(made.K)))
    assert ratio > 3
    said = " ".join(call("design", path, "--verbose", "--out", out).stdout.split())
    assert f"for that K is {ratio:.2g} times smaller in sizes than that of least cost, [-1000" in said
    assert any("it belongs to" in line for line in verify(out, path))
    told = json.loads((out / "run.json").read_text(encoding="utf-8"))["limits_active"]
    assert told["K_smaller_by"] == pytest.approx(ratio)


@pytest.mark.slow
def test_where_not_all_starts_can_be_inside_the_gain_stays_but_where_most_of_them_are_asked_for(tmp_path: Path) -> None:
    """At 2 m/s nothing holds 2 z'' = z + u with 2 N: z + √2 v has to be below 2."""
    text, shares = MOVED.replace("[0, -d/m]]", "[1/2, 0]]"), []
    for asked in ("", "design: {controller: {within: region}}\n"):
        spec = load_spec(written(tmp_path, text.replace("reference:", f"{asked}reference:"), SPEED="2", **WAVE))
        made = design(spec)
        shares.append(scaled(made.claim(LimitedRegion))["exact"])
        assert (made.design.cheaper is None) == (not asked)
    assert 3 * shares[0] < shares[1] < 1.8 / 2 / (0.1 / 2 + 2 / np.sqrt(2))
    for wrong in ("within: region, rate: largest", "within: region, gain: 3"):
        asked = f"design: {{controller: {{{wrong}}}}}\nreference:"
        path = written(tmp_path, text.replace("reference:", asked), SPEED="2", **WAVE)
        assert "'region' goes with a given rate, or with none" in refused(call("check", path), 2)


def test_a_given_gain_is_left_as_it_is(tmp_path: Path) -> None:
    given = "design: {controller: {K: [[-900, -80]]}}\nreference:"
    made = design(load_spec(written(tmp_path, MOVED.replace("reference:", given), SPEED="2", **WAVE)))
    assert made.design.cheaper is None
    assert made.K.tolist() == [[-900, -80]]


def test_where_nothing_is_left_on_one_side_of_an_unstable_plant_nothing_is_proved_and_it_is_said(
    tmp_path: Path,
) -> None:
    """T' = 0.1 T + Q/2 with Q in [0, 8] and u_ff = 0: from below 0 nothing brings it back."""
    path = tmp_path / "tank.yaml"
    text = TANK.replace("-0.1", "0.1").replace("MORE", "observer: {rate: 1}").replace("LEVEL", "0")
    path.write_text(text, encoding="utf-8")
    said = " ".join(call("design", path, "--verbose", "--out", tmp_path / "out").stdout.split())
    assert "limits active not proved: no ellipsoid was found that proves it" in said
    assert design(load_spec(path)).design.cheaper is None


def test_of_two_inputs_the_one_with_nothing_left_helps_where_it_can(tmp_path: Path) -> None:
    """The first state is unstable and held by f; the second is stable and heated by g, which is at its limit of 0."""
    path = tmp_path / "pair.yaml"
    path.write_text(
        """
name: Two states
system:
  states: [x, T]
  inputs: [f, g]
  outputs: [y, z]
  sizes: {x: 0.1, T: 1}
  A: [[0.5, 0], [0, -0.1]]
  B: [[1, 0], [0, 1]]
  C: [[1, 0], [0, 1]]
design: {tracking: state}
reference: {setpoint: {y: 0, z: 0}}
simulation: {duration: 10, sample_time: 0.1, actuator: {limits: {f: [-1, 1], g: [0, 5]}}}
""",
        encoding="utf-8",
    )
    found = scaled(region(path))
    assert 10 < found["exact"] < 1 / 0.5 / 0.1  # |x| < 2, whatever T is, within the proportions of the box
    assert found["sizes"] > 1


@pytest.mark.slow
@pytest.mark.parametrize("numbers", ["whole", "irrational"])
def test_a_polynomial_is_of_the_matrices_that_an_auditor_counts(numbers: str, tmp_path: Path) -> None:
    """Two saturations of one form have cells between others; of irrational numbers all that differ are counted."""
    pi, two = "1", "kind: saturation, of: v, lower: -0.1, upper: 0.1, slope: 3"
    if numbers == "irrational":
        pi, two = "pi", "kind: piecewise_linear, of: z, breakpoints: [-0.1, 0, 0.1], slopes: [0, 3, 5, 0]"
    text = f"""
name: a mass with friction of two kinds
system:
  states: [z, v]
  inputs: [F]
  outputs: [y, w]
  track: [y]
  A: [[0, 1], [0, -{pi}]]
  B: [[0], [1]]
  C: [[1, 0], [0, 1]]
  nonlinearities:
    - {{name: one, kind: saturation, of: v, lower: -0.05, upper: 0.05, slope: 20*{pi}, into: {{v: -1}}}}
    - {{name: two, {two}, into: {{v: -1}}}}
reference: {{output: 0.1}}
simulation: {{duration: 3, sample_time: 0.01, actuator: {{limits: {{F: [-10, 3]}}}}}}
"""
    path = tmp_path / "mass.yaml"
    path.write_text(text, encoding="utf-8")
    call("design", path, "--out", tmp_path / "out")
    content = json.loads((tmp_path / "out" / "certificate.json").read_text())
    assert any("V" in entry for entry in content["regions"])
    assert not audit(json.dumps(content))[1]


IDLE = """
name: Two actuators of which one does nothing
system:
  states: [x]
  inputs: [a, b]
  outputs: [y]
  A: [[0.5]]
  B: [[1, REACH]]
  C: [[1]]
  nonlinearities: [{name: k, kind: spring, of: x, slope: 1, into: {x: -1}}]
design: {DESIGN}
reference: {output: {sine: {amplitude: 0.5, frequency: 0.5}}}
simulation:
  duration: 5
  sample_time: 0.1
  actuator: {limits: {a: [-3, 3], b: [-1, 1]}}
  controller: {sample_time: 0.1}
"""


@pytest.mark.parametrize(
    ("reach", "goal"),
    [("0", ""), ("0.5", "controller: {K: [[-3], [0]]}")],
    ids=["moves nothing", "is not used"],
)
def test_an_input_that_does_nothing_is_at_no_limit(tmp_path: Path, reach: str, goal: str) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(IDLE.replace("REACH", reach).replace("DESIGN", goal), encoding="utf-8")
    spec = load_spec(path)
    controller = design(spec)
    regions = [one for claim in controller.claims_of(LimitedRegion) for one in claim.found]
    assert regions
    assert all(np.isfinite(one.held.H).all() for one in regions if isinstance(one.held, Region))
    assert simulate(spec).outcome.kind == "tracks"
