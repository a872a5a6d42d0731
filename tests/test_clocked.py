"""Forms that depend on a clock: against closed forms, and against switching that was never looked at."""

from dataclasses import replace
from fractions import Fraction
from itertools import product

import numpy as np
import picos
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from pwatrack.arrays import Array
from pwatrack.ball_matrix import BallMatrix
from pwatrack.lmi.chain_map import Bound, ChainMap
from pwatrack.lmi.clocked import Clocked, ClockedProof, clocked_proof, fastest, looked_for, proves
from pwatrack.lmi.clocked_forms import best_margin
from pwatrack.lmi.clocked_tubes import Drive, TubeProgram, contains, tube
from pwatrack.lmi.exact import Packed
from pwatrack.real import Real


def scalar(a: float, g: float, h: str) -> Clocked:
    return Clocked(F=[BallMatrix.of([[a]])], J=[BallMatrix.of([[g]])], period=Fraction(h))


@given(st.floats(-3, 3), st.floats(-2, 2), st.sampled_from(["0.1", "0.5", "1"]), st.integers(8, 16))
@settings(max_examples=40)
def test_one_state_is_proved_where_its_knots_allow_it_and_nowhere_else(a: float, g: float, h: str, N: int) -> None:
    """At best P_k+1 = P_k (1 − 2 a h / N), as the smaller of both decides where they rise: g² < (1 − 2 a h / N)^N."""
    a, g = round(a, 3), round(g, 3)
    most = N / 2 * np.log(1 - 2 * a * float(Fraction(h)) / N)
    assert most <= -a * float(Fraction(h))
    size = np.log(max(abs(g), 1e-12))
    found = clocked_proof(scalar(a, g, h), knots=N)
    if size > most + 1e-9:
        assert found is None
    if size < most - 0.1:
        assert found is not None


def random_system(seed: int) -> Clocked:
    """Two flows near each other and a tick that feeds back a sample of the state, held between ticks."""
    random = np.random.default_rng(seed)
    A = random.normal(size=(2, 2)) - 0.5 * np.eye(2)
    B, push = random.normal(size=(2, 1)), 0.1 * random.normal(size=(2, 2))
    K = -np.linalg.lstsq(B, A + 0.3 * np.eye(2), rcond=None)[0]
    flows = [np.block([[X, B], [np.zeros((1, 3))]]) for X in (A - 1.5 * np.eye(2), A - 1.5 * np.eye(2) + push)]
    jump = np.block([[np.eye(2), np.zeros((2, 1))], [K, np.zeros((1, 1))]])
    F, J = ([BallMatrix.of(X.round(3)) for X in matrices] for matrices in (flows, [jump]))
    return Clocked(F=F, J=J, period=Fraction("0.05"))


@pytest.mark.parametrize("seed", range(4))
def test_the_form_falls_for_switching_of_any_kind(seed: int) -> None:
    system, rate = random_system(seed), 0.05
    found = clocked_proof(system, knots=2, rate=rate)
    assert found is not None
    assert found.rate > 0
    P, random = [np.array(P_k.P.tolist(), dtype=float) for P_k in found.P], np.random.default_rng(seed)
    z, h, steps = random.normal(size=3), float(system.period), 40
    value = z @ P[0] @ z
    for _ in range(60):
        for k in range(steps):
            share = random.uniform()
            F = share * system.F[0].floats + (1 - share) * system.F[1].floats
            z = expm(F * h / steps) @ z
            after = z @ at(P, (k + 1) / steps) @ z
            assert after <= value * np.exp(-2 * found.rate * h / steps) * (1 + 1e-9)
            value = after
        z = system.J[0].floats @ z
        after = z @ P[0] @ z
        assert after <= value * (1 + 1e-12)
        value = after


def at(P: list[Array], share: float) -> Array:
    """P(τ), linear between its knots."""
    place = share * (len(P) - 1)
    k = min(int(place), len(P) - 2)
    return P[k] + (place - k) * (P[k + 1] - P[k])


def test_what_was_changed_is_no_proof() -> None:
    system = random_system(0)
    found = clocked_proof(system, knots=1, rate=0.05)
    assert found is not None
    assert holds(system, found)
    last = found.P[-1]
    smaller = replace(last, integers=tuple(tuple(v // 2 for v in row) for row in last.integers))
    assert not holds(system, replace(found, P=(found.P[0], smaller)))
    assert not holds(system, replace(found, rate=found.rate * 1e3))


def test_a_ball_of_a_jump_counts() -> None:
    """|g| is at most 1/2 in the ball of one jump and may be 2 in that of the other."""
    system = scalar(-0.1, 0.4, "1")
    near, far = (BallMatrix(system.J[0].centre, BallMatrix.of([[radius]]).centre) for radius in (0.1, 1.6))
    assert clocked_proof(replace(system, J=[near]), knots=1) is not None
    assert clocked_proof(replace(system, J=[far]), knots=1) is None


def holds(system: Clocked, found: ClockedProof) -> bool:
    packed: tuple[Packed, ...] = found.P
    return proves(system, packed, found.T, found.rate)


def test_parts_of_a_period_with_a_jump_after_each() -> None:
    """x' = −x + y/2, y' = x; the end of a part makes y 0, and so does the tick: proved, and not where y only grows."""
    F = [BallMatrix.of([[-1, 0.5], [1, 0]]), BallMatrix.of([[-1, -0.5], [1, 0]])]
    reset = BallMatrix.of([[1, 0], [0, 0]])
    system = Clocked(F=F, J=[reset], period=Fraction(2), parts=4, between=reset)
    found = fastest(system, knots=1)
    assert found is not None
    assert len(found.P) == 8
    assert 0.05 < found.rate < 1
    assert holds(system, found)
    assert not holds(replace(system, period=Fraction(40)), found)
    assert not proves(system, found.P[:7], found.T[:7], found.rate)
    assert not holds(system, replace(found, rate=1.5))
    kept = replace(system, between=BallMatrix.of([[1, 0], [0, 2]]))
    assert fastest(kept, knots=1) is None


def test_of_many_vertices_those_that_decide_are_found() -> None:
    """What is asked of a few alone would not hold for all."""
    random = np.random.default_rng(3)
    A = [np.array([[-1.0, a], [b, -1.0]]) for a, b in random.uniform(-0.6, 0.6, size=(60, 2)).round(3)]
    system = Clocked(F=[BallMatrix.of(X) for X in A], J=[BallMatrix.of([[1, 0], [0, 1]])], period=Fraction("0.1"))
    found = fastest(system, knots=1)
    assert found is not None
    assert holds(system, found)
    slowest = min(-np.linalg.eigvals(X).real.max() for X in A)
    assert 0.5 * slowest < found.rate <= slowest


@pytest.mark.parametrize("order", [2, 7])
def test_the_margin_is_that_of_another_solver(order: int) -> None:
    random = np.random.default_rng(order)
    F = random.normal(size=(3, order, order)) * 0.2 - np.eye(order)
    J, eye = random.normal(size=(order, order)) / order, np.eye(order)
    less, more = (-eye / 2, eye), (eye / 2, eye)
    bounds = [Bound({0: (X.T, eye), 1: less}, eye) for X in F]
    bounds += [Bound({1: less, 0: (J.T / 2, J)}, eye / 10), Bound({1: more, 0: less}, eye / 10)]
    found = best_margin(bounds, 2)
    assert found is not None
    near, some = best_margin(bounds, 2, begin=found), best_margin(bounds, 2, any_margin=True)
    assert near is not None
    assert some is not None
    (P, Q), _, t = found
    assert np.trace(P) <= order * (1 + 1e-6)
    for X in F:
        assert np.linalg.eigvalsh(X.T @ P + P @ X - Q + t * eye)[-1] < 1e-6
    assert np.linalg.eigvalsh(J.T @ P @ J - Q + t / 10 * eye)[-1] < 1e-6
    assert np.linalg.eigvalsh(Q - P + t / 10 * eye)[-1] < 1e-6
    problem, X, Y, s = (
        picos.Problem(),
        *(picos.SymmetricVariable(name, order) for name in "XY"),
        picos.RealVariable("s"),
    )
    problem.add_list_of_constraints([A.T * X + X * A - Y + s * eye << 0 for A in F])
    problem.add_list_of_constraints([J.T * X * J - Y + s / 10 * eye << 0, Y - X + s / 10 * eye << 0])
    problem.add_constraint(picos.trace(X) == order)
    problem.set_objective("max", s)
    problem.solve(solver="cvxopt")
    assert t == pytest.approx(float(s.value), rel=0.03)
    assert 0.9 < near[2] / float(s.value) < 1.001
    assert 0 < some[2] / float(s.value) < 1.001
    growing = [Bound({0: (X.T + 2 * eye, eye), 1: less}, eye) for X in F] + bounds[3:]
    for any_margin, begin in product((False, True), (None, found)):
        assert best_margin(growing, 2, begin=begin, any_margin=any_margin) is None


@pytest.mark.parametrize("edges", [1, 2, 3])
def test_what_is_proved_of_a_box_is_so_of_its_corners(edges: int) -> None:
    """Each corner by itself, and all means of them, with the same forms and without T."""
    random, n = np.random.default_rng(edges), 3
    U, V = (BallMatrix.of((0.3 * random.normal(size=shape)).round(3)) for shape in ((n, edges), (edges, n)))
    F = [BallMatrix.of((0.2 * random.normal(size=(n, n)) - 1.5 * np.eye(n)).round(3)) for _ in range(2)]
    jump = BallMatrix.of((np.eye(n) + 0.02 * random.normal(size=(n, n))).round(3))
    system = Clocked(F=F, U=[U, U], V=[V, V], J=[jump], period=Fraction("0.3"))
    found = fastest(system, knots=2)
    assert found is not None
    assert holds(system, found)
    corners = list(system.vertices)
    assert len(corners) == 2 * 2**edges
    alone = replace(system, F=corners, U=(), V=())
    assert proves(alone, found.P, ((),) * len(found.P), found.rate)
    by_corners = fastest(alone, knots=2)
    assert by_corners is not None
    assert 0.5 * by_corners.rate < found.rate < looked_for(alone, 2).most
    lighter = replace(found, T=tuple(tuple(v / 50 for v in row) for row in found.T))
    assert not holds(system, lighter)
    assert not holds(system, replace(found, T=found.T[:-1]))
    assert not holds(system, replace(found, T=tuple(row[:-1] for row in found.T)))
    assert not holds(system, replace(found, T=tuple(tuple(-v for v in row) for row in found.T)))


def test_a_slow_mode_beside_fast_ones_is_proved() -> None:
    """Ticks are 3e-6 of its time constant apart: a margin counts in what a form loses in one of them."""
    n = 8
    A = -np.diag(np.append(6e-4, np.linspace(0.5, 40, n - 1)))
    A[0, 1:], A[1:, 0] = 0.1, 1e-5
    system = Clocked(F=[BallMatrix.of(A)], J=[BallMatrix.of(np.eye(n))], period=Fraction("0.005"))
    found = fastest(system, knots=1)
    assert found is not None
    assert holds(system, found)
    assert 0.2 * 6e-4 < found.rate <= 6e-4


def test_the_form_of_the_terms_gives_the_matrix_of_a_step() -> None:
    """Against the same from the left-hand sides of all unit vectors; some inequalities are larger, and have numbers."""
    random, n, N = np.random.default_rng(0), 3, 5
    terms, bounds = [{0, 1}, {1, 2}, {2}, {0}], list[Bound]()
    for at, each in enumerate(terms):
        order = n if at == 2 else N
        pairs = {k: (random.normal(size=(order, n)), random.normal(size=(n, order))) for k in each}
        S = random.normal(size=(2, N, N))
        numbers = {} if order == n else {"places": (at % 2, 2), "S": S + S.transpose(0, 2, 1)}
        bounds.append(Bound(pairs, np.eye(order) * at, **numbers))  # type: ignore[arg-type]
    chain = ChainMap(bounds, 3, None, 3)
    W = random.normal(size=(len(bounds), N, N))
    W, Z = W @ W.transpose(0, 2, 1), W + W.transpose(0, 2, 1)
    images = np.array([chain.apply(unit) for unit in np.eye(chain.size)])
    sides = images.reshape(chain.size, len(bounds), N, N)
    assert (sides[:, 2, n:] == 0).all()
    H, right = np.einsum("ujab,jbc,vjcd,jda->uv", sides, W, sides, W), random.normal(size=chain.size)
    assert H @ chain.normal(W.ravel())[0].solve(right) == pytest.approx(right, rel=1e-9)
    assert chain.adjoint(Z.ravel()) == pytest.approx(images @ Z.ravel(), rel=1e-12)


@pytest.mark.parametrize("summed", [False, True])
@pytest.mark.parametrize("radius", [Fraction(0), Fraction(1, 10**17)])
def test_what_drives_by_rounding_alone_has_a_tube_of_nothing(radius: Fraction, summed: bool) -> None:
    """z₂ keeps d, as what moves in a substep does, and z₁ sees of it what the numbers of a file leave open."""
    ball = Real(Fraction(0), radius)
    system = Clocked(
        F=[BallMatrix.of([[-2, ball], [0, ball]])], J=[BallMatrix.of([[1, 0], [0, 0]])], period=Fraction(1, 10)
    )
    held, between, rows = (BallMatrix.of(X) for X in ([[0], [1]], [[0], [0]], [[1, 0], [0, 1]]))
    program = TubeProgram(system=system, near=np.eye(2), knots=1)
    found = tube(program, Drive(held=held, between=between), rows, np.ones(2), 1.0, summed=summed)
    assert found is not None
    assert max(found.sizes) < 1e-7
    drive = Drive(held=BallMatrix.of([[0], [0]]), between=BallMatrix.of([[1e-6], [0]]))
    assert not contains(system, drive, found.Q, found.T, found.a, found.b, summed=summed)
