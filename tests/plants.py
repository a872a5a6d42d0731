"""Plants for tests: continuous by construction, as ẋ = A x + b + Σ_j g_j max(0, h_jᵀ x + c_j) + B u."""

from itertools import product

import numpy as np

from pwatrack.arrays import Array
from pwatrack.model.cells import Partition
from pwatrack.model.pwa import PWASystem
from pwatrack.model.reference import StateResets


def springs(A: Array, b: Array, B: Array, C: Array, g: Array, h: Array, c: Array) -> PWASystem:
    """One-sided springs g_j max(0, h_jᵀ x + c_j): 2^k cells for k springs in general position."""
    k = len(c)
    signs = np.array(list(product((-1, 1), repeat=k))).reshape(2**k, k)
    active = (signs > 0).astype(float)
    return PWASystem.create(
        partition=Partition.create(
            H=h, h=c, signs=signs, names=["".join("-+"[int(s > 0)] for s in row) for row in signs]
        ),
        A=A + np.einsum("ck,ki,kj->cij", active, g, h),
        b=b + active @ (g * c[:, None]),
        B=B,
        C=C,
    )


def saddle(random: np.random.Generator, bend: float) -> tuple[Array, Array, Array, Array]:
    """Two cells with one to four unstable modes of 0.1 to 2,000 rad/s, up to two stable ones, and one P of mixed sign.

    Returns:
        The eigenvalues of the first cell, its A, and g and h: A + g hᵀ is the second one's.
    """
    stable, unstable = int(random.integers(0, 3)), int(random.integers(1, 5))
    poles = np.concatenate([-(10 ** random.uniform(-1, 3.3, stable)), 10 ** random.uniform(-1, 3.3, unstable)])
    p = len(poles)
    V = np.linalg.qr(random.normal(size=(p, p)))[0]
    P, h = V @ np.diag(-np.sign(poles)) @ V.T, random.normal(size=p)
    g = -np.linalg.solve(P, h) * bend * abs(random.normal()) * np.abs(poles).min() / (h @ h)  # sym(P g hᵀ) ⪯ 0
    return poles, V @ np.diag(poles) @ V.T, g, h


def random_plant(seed: int, n: int = 4, k: int = 2, r: int = 2, strength: float = 1.0) -> PWASystem:
    """A random SISO plant of relative degree r whose tracking dynamics converge, in scrambled coordinates.

    In the coordinates (ξ, η) of (11) the springs act on the last of ξ and on η,
    and A_η is far in the left half plane, so (17) holds; springs of small strength
    leave (8) and (9) as feasible as they are without springs.
    """
    random = np.random.default_rng(seed)
    k = min(k, n)  # in general position
    A = np.zeros((n, n))
    A[: r - 1, 1:r] = np.eye(r - 1)
    A[r - 1 :] = random.normal(size=(n - r + 1, n))
    A[r:, r:] -= (np.linalg.norm(A[r:, r:], 2) + 2.0) * np.eye(n - r)
    g = strength * random.normal(size=(k, n))
    g[:, : r - 1] = 0.0
    g[:, r:] *= 0.2
    h = random.normal(size=(k, n))
    h /= np.linalg.norm(h, axis=1)[:, None]
    B = np.zeros((n, 1))
    B[r - 1] = random.choice([-1.0, 1.0]) * random.uniform(0.5, 2.0)
    B[r:, 0] = 0.0
    C = np.eye(n)[:1]
    T = np.linalg.qr(random.normal(size=(n, n)))[0] * random.uniform(0.5, 2.0, size=n)
    inverse = np.linalg.inv(T)
    c = random.normal(size=n)[:k] * 0.1
    b = random.normal(size=n) * 0.1
    b[: r - 1] = 0.0
    o = np.append(0.0, random.normal(size=n - 1) * 0.1)  # x = T (z + o), with y as before: offsets in ξ
    return springs(T @ A @ inverse, T @ (b - A @ o), T @ B, C @ inverse, g @ T.T, h @ inverse, c - h @ o)


def reset(t: float, where: slice, value: Array) -> StateResets:
    """Return one reset."""
    return StateResets(t=np.array([t]), where=where, values=value[None])


def random_outputs(
    seed: int, degrees: tuple[int, ...], internal: int = 2, spare: int = 0, k: int = 2, *, bent: bool = False
) -> PWASystem:
    """A random plant with outputs of these relative degrees, `spare` more inputs, and converging zero dynamics.

    As `random_plant`, in scrambled coordinates. Where it is bent, springs also push what the input pushes next: the
    last derivative of each output of degree 2 or more is piecewise affine, with slopes of one sign along the input.
    """
    random = np.random.default_rng(seed)
    p, r = len(degrees), sum(degrees)
    n, m, last = r + internal, p + spare, np.cumsum(degrees) - 1
    A = np.diag(np.ones(n - 1), 1)
    A[[*last, *range(r, n)]] = random.normal(size=(p + internal, n))
    A[r:, r:] -= (np.linalg.norm(A[r:, r:], 2) + 2.0) * np.eye(internal)
    h = random.normal(size=(k, n))
    h /= np.linalg.norm(h, axis=1)[:, None]
    g = 0.3 * random.normal(size=(k, n))
    g[:, r:] *= 0.2
    g[:, [j for j in range(r) if j not in last]] = 0.0
    for end, degree in zip(last, degrees, strict=True):
        if bent and degree > 1:
            g[:, end - 1] = 0.6 / k * random.uniform(-1, 1, size=k)
    D = np.linalg.qr(random.normal(size=(m, m)))[0][:p] * random.uniform(0.5, 2.0, size=(p, 1))
    B = np.zeros((n, m))
    B[last] = D
    B[r:] = random.normal(size=(internal, m)) @ (np.eye(m) - np.linalg.pinv(D) @ D)  # unseen by the least inputs
    C = np.eye(n)[last - np.array(degrees) + 1]
    T = np.linalg.qr(random.normal(size=(n, n)))[0] * random.uniform(0.5, 2.0, size=n)
    inverse, c, b = np.linalg.inv(T), random.normal(size=k) * 0.1, random.normal(size=n) * 0.1
    b[[j for j in range(r) if j not in last]] = 0.0
    return springs(T @ A @ inverse, T @ b, T @ B, C @ inverse, g @ T.T, h @ inverse, c)
