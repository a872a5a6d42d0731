"""References as outputs of a linear exosystem ẇ = S w, with resets where a signal has a new piece."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import accumulate, repeat
from math import factorial, gcd, isfinite, lcm, pi

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from pwatrack.arrays import EPS, Array, readonly
from pwatrack.errors import OutsideTheory, Remedy, Subject, Way
from pwatrack.model.profile import Course, Profile
from pwatrack.model.signal import Signal


@dataclass(frozen=True)
class OutputReference:
    """Wanted outputs y_d, some courses per tracked output: output tracking (Theorem 3)."""

    courses: tuple[tuple[Course, ...], ...]  # by output
    preview: bool = True  # whether it is known beforehand, so that x_d may be worked out

    def signals(self, degrees: Sequence[int]) -> list[Signal]:
        """Return y_d, each with as many continuous derivatives as its degree where rounding was asked for."""
        return [total_signal(courses, r) for courses, r in zip(self.courses, degrees, strict=True)]


@dataclass(frozen=True)
class StateReference:
    """A wanted x_d in closed form, some courses per state: state tracking (Theorem 2)."""

    courses: tuple[tuple[Course, ...], ...]

    def signals(self) -> list[Signal]:
        """Return x_d; its first derivative is continuous where rounding was asked for."""
        return [total_signal(courses, 1) for courses in self.courses]


@dataclass(frozen=True)
class InputReference:
    """A feedforward u_ff, some courses per input; x_d is the plant's own response from `start` (state tracking).

    Without `start`, x_d is the periodic steady state.
    """

    courses: tuple[tuple[Course, ...], ...]
    start: Array | None

    def signals(self) -> list[Signal]:
        """Return u_ff."""
        return [total_signal(courses, 0) for courses in self.courses]


@dataclass(frozen=True)
class SetPoint:
    """Wanted constant outputs: the plant shall rest at x_d with c x_d = y for the tracked rows c (state tracking)."""

    y: Array


Reference = OutputReference | StateReference | InputReference | SetPoint


@dataclass(frozen=True)
class Reset:
    """At time t (s) the entries `where` of w take new values."""

    t: float
    where: slice
    w: Array


@dataclass(frozen=True, kw_only=True)
class Exosystem:
    """Signals s_j(t) = Q_j w(t), where ẇ = S w between resets and w(0) = w0.

    Every derivative is again linear in w: s⁽ᵏ⁾ = Q Sᵏ w.

    Example:
        >>> from pwatrack.model.signal import ExponentialPolynomial
        >>> wave = (np.pi * ExponentialPolynomial.time()).sin() * 2.0 + 1.0
        >>> y_d = exosystem([Signal.of(wave)])
        >>> y_d(0.5).round(12).tolist(), y_d(1.0, derivative=1).round(6).tolist(), y_d.period
        ([3.0], [-6.283185], 2.0)
    """

    S: Array  # (p, p), in 1/s
    rates: NDArray[np.complex128]  # the eigenvalue of S of each entry of w, with its imaginary part ≥ 0, (p,)
    Q: Array  # (q, p), one row per signal
    w0: Array  # (p,)
    resets: tuple[Reset, ...]  # in order of time
    period: float | None  # in s, or None if the signals are constant or not periodic
    end: float | None  # last time at which all signals are defined, or None

    @property
    def constant(self) -> bool:
        """Whether no signal ever changes."""
        return not self.resets and not self.S.any()

    def begins(self) -> float | None:
        """Return the period (s) with which all signals begin, up to the first reset; 0 if at rest, None if neither."""
        frequencies = set[float]()
        for rate, chain in spectral_terms(self.S, self.rates):
            for power, E in enumerate(chain):
                if not np.abs(E @ self.w0).max(initial=0.0) > 32 * EPS * np.abs(self.w0).max(initial=0.0):
                    continue
                if power or rate.real:
                    return None
                frequencies |= {rate.imag} if rate.imag else set()
        return _common_period(frequencies) if frequencies else 0.0

    def derivative_rows(self, r: int) -> Array:
        """Return Q, Q S, …, Q Sʳ, (r + 1, q, p)."""
        return np.array([*accumulate(repeat(self.S, r), np.matmul, initial=self.Q)])

    def __call__(self, t: float, derivative: int = 0) -> Array:
        """Return the derivative of the given order of all signals at time t in s, (q,)."""
        result: Array = self.derivative_rows(derivative)[-1] @ self.states(np.array([t]))[0]
        return result

    def pieces(self) -> list[tuple[slice, Array, Array]]:
        """Return the resets signal by signal: the entries of w, the times (R,), and the new values (R, entries)."""
        found: dict[tuple[int, int], list[Reset]] = {}
        for reset in self.resets:
            found.setdefault((reset.where.start, reset.where.stop), []).append(reset)
        return [
            (slice(*where), np.array([reset.t for reset in resets]), np.array([reset.w for reset in resets]))
            for where, resets in found.items()
        ]

    def states(self, times: NDArray[np.floating]) -> Array:
        """Return w at some times in s, (T, p), after any reset at that time; as precisely as the times are."""
        since, w = np.tile(times[:, None], len(self.w0)), np.tile(self.w0, (len(times), 1))
        for where, t, values in self.pieces():
            last = np.searchsorted(t, times, side="right") - 1
            past = last >= 0
            since[past, where] = (times[past] - t[last[past]])[:, None]
            w[past, where] = values[last[past]]
        total = np.zeros(w.shape, dtype=since.dtype)
        with np.errstate(all="ignore"):  # what grows may be out of range
            for rate, chain in spectral_terms(self.S, self.rates):
                own = np.flatnonzero(chain[0].any(axis=1))
                turned = np.exp(rate * since[:, own])
                for m, E in enumerate(chain):
                    total[:, own] += (turned * (since[:, own] ** m / factorial(m)) * (w @ E[own].T)).real
        return total


def spectral_terms(S: Array, rates: NDArray[np.complex128]) -> list[tuple[complex, list[NDArray[np.complex128]]]]:
    """Return λ and E_λ0, E_λ1, … with e^{St} = Re Σ_λ e^{λt} Σ_m t^m/m! E_λm, each (p, p), for the S of an exosystem.

    A row has R e^{St} w = 0 for all t exactly where R E_λm w = 0 for all of them. Exponents that differ by
    rounding are one.

    Example:
        >>> S = np.array([[0.0, -2.0], [2.0, 0.0]])
        >>> [(rate, [E.tolist() for E in chain]) for rate, chain in spectral_terms(S, np.array([2j, 2j]))]
        [(2j, [[[(1+0j), 1j], [-1j, (1+0j)]]])]
    """
    found: dict[complex, list[int]] = {}
    for k, rate in enumerate(rates.tolist()):
        same = next((known for known in found if abs(known - rate) <= 32 * EPS * abs(known)), rate)
        found.setdefault(same, []).append(k)
    result = []
    for rate, members in found.items():
        own = np.zeros(S.shape)
        own[np.ix_(members, members)] = S[np.ix_(members, members)]
        turn = np.zeros(S.shape)
        starts = members[::2] if rate.imag else []
        for k in starts:
            turn[k : k + 2, k : k + 2] = [[0.0, -1.0], [1.0, 0.0]]
            own[k : k + 2, k : k + 2] = 0.0
        if not rate.imag:
            own[members, members] = 0.0
        E = np.diag(np.isin(np.arange(len(S)), members).astype(np.complex128)) - 1j * turn
        chain = []
        while E.any():
            chain.append(E)
            E = E @ own
        result.append((rate, chain))
    return result


def exosystem(signals: Sequence[Signal]) -> Exosystem:
    """Return one exosystem for several signals.

    A term p(t) e^{λt} of degree d is the chain v_j = p⁽ʲ⁾(t) e^{λt}, j = 0 … d,
    with v̇_j = λ v_j + v_{j+1}; a conjugate pair is kept as real and imaginary part.
    """
    blocks, rows, rates, starts, resets = [], [], list[complex](), [], []
    offset = 0
    for signal in signals:
        chains = _chains(signal)
        S, Q = zip(*(_chain(rate, length) for rate, length in chains.items()), strict=True) if chains else ((), ())
        block, row = (block_diag(*S), np.concatenate(Q)) if chains else (np.zeros((0, 0)), np.zeros(0))
        blocks.append(block)
        rows.append(row)
        rates += [rate for rate, length in chains.items() for _ in range(length * (1 if rate.imag == 0 else 2))]
        where = slice(offset, offset + len(row))
        states = _chain_states(signal, chains)
        starts.append(states[0])
        resets += [
            Reset(t, where, readonly(w))
            for t, w in zip(signal.starts[1:], states[1:], strict=True)
            if signal.end is None or t < signal.end
        ]
        offset += len(row)
    ends = [signal.end for signal in signals if signal.end is not None]
    return Exosystem(
        S=readonly(block_diag(*blocks)) if offset else np.zeros((0, 0)),
        rates=np.array(rates, dtype=np.complex128),
        Q=readonly(block_diag(*[row[None] for row in rows]).reshape(len(signals), offset)),
        w0=readonly(np.concatenate([*starts, np.zeros(0)])),
        resets=tuple(sorted(resets, key=lambda reset: reset.t)),
        period=_period(signals),
        end=min(ends, default=None),
    )


def beside(one: Exosystem, signals: Sequence[Signal]) -> Exosystem:
    """Return an exosystem with more signals behind those that it has; together they have no period."""
    other = exosystem(signals)
    p = len(one.w0)
    moved = (replace(reset, where=slice(reset.where.start + p, reset.where.stop + p)) for reset in other.resets)
    return replace(
        one,
        S=readonly(block_diag(one.S, other.S)) if p else other.S,
        rates=np.concatenate([one.rates, other.rates]),
        Q=readonly(block_diag(one.Q, other.Q)),
        w0=readonly(np.concatenate([one.w0, other.w0])),
        resets=tuple(sorted([*one.resets, *moved], key=lambda reset: reset.t)),
        period=None,
    )


def total_signal(courses: Sequence[Course], r: int) -> Signal:
    """Return the sum of some courses, r times differentiable where rounding was asked for."""
    total = courses[0].signal(r)
    for course in courses[1:]:
        total = total + course.signal(r)
    return total


def shortest_rounding(courses: Sequence[Sequence[Course]]) -> float | None:
    """Return the shortest time in s over which corners are rounded, or None if none are."""
    profiles = (course for own in courses for course in own if isinstance(course, Profile))
    return min((course.smooth for course in profiles if course.smooth is not None), default=None)


def check_bounded(signal: Signal, *, name: str, subject: Subject) -> None:
    """Refuse a signal that grows without bound: Theorems 2 and 3 need bounded references."""
    growing = signal.pieces[-1].unbounded_term() if signal.end is None else ""
    if growing:
        raise OutsideTheory(
            f"{name} is not bounded: it has {growing} (Theorems 2 and 3 need bounded ones)",
            subject=subject,
            hint="give the interval it is meant for",
            remedy=Remedy(Way.INTERVAL),
        )


def check_smooth(signal: Signal, r: int, *, name: str, subject: Subject) -> None:
    """Refuse a signal that is not r times differentiable."""
    for order in range(r + 1):
        jump = signal.jump(order)
        if jump is not None:
            what = "itself" if order == 0 else f"derivative {order}"
            raise OutsideTheory(
                f"{name} is not {r} times differentiable, as relative degree {r} needs: "
                f"{what} jumps by {jump[1]:.4g} at t = {jump[0]:.6g} s",
                subject=subject,
                hint="round its corners, or choose a smoother one",
                remedy=Remedy(Way.ROUNDED_CORNERS),
            )


def _chains(signal: Signal) -> dict[complex, int]:
    """Return the length of the chain for each λ with Im λ ≥ 0 that some piece needs."""
    lengths = {
        rate: int(np.max(np.flatnonzero(c.any(axis=0)), initial=-1)) + 1
        for rate, c in signal.stacked().items()
        if rate.imag >= 0
    }
    return {rate: length for rate, length in lengths.items() if length}


def _chain(rate: complex, length: int) -> tuple[Array, Array]:
    shift = np.eye(length, k=1)
    if rate.imag == 0:
        return rate.real * np.eye(length) + shift, np.eye(length)[0]
    turn = np.array([[rate.real, -rate.imag], [rate.imag, rate.real]])
    return np.kron(np.eye(length), turn) + np.kron(shift, np.eye(2)), 2.0 * np.eye(2 * length)[0]


def _chain_states(signal: Signal, chains: dict[complex, int]) -> Array:
    """Return the state of all chains at the start of each piece, (pieces, p): v_j(0) = j! c_j."""
    parts, terms = [np.zeros((len(signal.pieces), 0))], signal.stacked()
    for rate, length in chains.items():
        v = terms[rate][:, :length] * np.array([float(factorial(j)) for j in range(length)])
        parts.append(v.real if rate.imag == 0 else np.stack([v.real, v.imag], axis=2).reshape(len(v), -1))
    return np.hstack(parts)


def _period(signals: Sequence[Signal]) -> float | None:
    """Return the least common period where all signals are sums of sinusoids with commensurable frequencies."""
    if any(len(signal.pieces) > 1 or signal.end is not None for signal in signals):
        return None
    chains = [(rate, length) for signal in signals for rate, length in _chains(signal).items()]
    if any(rate.real != 0 or length > 1 for rate, length in chains):
        return None
    return _common_period({rate.imag for rate, _ in chains if rate.imag > 0})


def _common_period(rates: Iterable[float]) -> float | None:
    """Return the least common period in s of frequencies in rad/s that have whole-number ratios."""
    frequencies = sorted(rates)
    if not frequencies or not np.isfinite(frequencies[-1] / frequencies[0]):
        return None
    first = frequencies[0]
    ratios = [Fraction(f / first).limit_denominator(1000) for f in frequencies]
    if any(abs(float(q) * first - f) > 1e-12 * f for q, f in zip(ratios, frequencies, strict=True)):
        return None
    turns = lcm(*(q.denominator for q in ratios))
    period = 2 * pi / first * turns / gcd(*(int(q * turns) for q in ratios))
    return period if isfinite(period) else None
