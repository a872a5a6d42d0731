"""References as outputs of a linear exosystem ẇ = S w, with resets where a signal has a new piece."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import accumulate, repeat
from math import factorial, gcd, isfinite, lcm, pi
from typing import Any

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
    played: Mapping[str, Any] | None = None  # as a controller.json tells what is played back; None: it is worked out

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


@dataclass(frozen=True, kw_only=True)
class StateResets:
    """At the times t the entries `where` of a state take new values."""

    t: Array  # in s, in order, (R,)
    where: slice  # some neighbouring entries
    values: Array  # their new values at each of these times, (R, number of entries)

    def behind(self, before: int) -> "StateResets":
        """Return the same of a state with so many entries more before these."""
        return replace(self, where=slice(self.where.start + before, self.where.stop + before))


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
    resets: tuple[StateResets, ...]  # of each signal that has some, the earliest ones first
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

    @property
    def breaks(self) -> Array:
        """When there are resets, in s, in order."""
        return np.unique(np.concatenate([np.zeros(0), *(resets.t for resets in self.resets)]))

    def states(self, times: NDArray[np.floating]) -> Array:
        """Return w at some times in s, (T, p), after any reset at that time; as precisely as the times are."""
        since, w = np.tile(times[:, None], len(self.w0)), np.tile(self.w0, (len(times), 1))
        for resets in self.resets:
            last = np.searchsorted(resets.t, times, side="right") - 1
            past = last >= 0
            since[past, resets.where] = (times[past] - resets.t[last[past]])[:, None]
            w[past, resets.where] = resets.values[last[past]]
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
    blocks, rows, rates, starts, resets = [], [], list[complex](), [], list[StateResets]()
    offset = 0
    for signal in signals:
        parts, row, states = list[Array](), np.zeros(0), np.zeros((len(signal.pieces), 0))
        for rate, c in _terms(signal).items():
            S, Q, v = _chain(rate, c)
            parts, row, states = [*parts, S], np.append(row, Q), np.hstack([states, v])
            rates += [rate] * len(S)
        where = slice(offset, offset + len(row))
        blocks += parts
        rows.append(row)
        starts.append(states[0])
        t = np.array([t for t in signal.starts[1:] if signal.end is None or t < signal.end])
        if len(t) and len(row):
            resets.append(StateResets(t=t, where=where, values=readonly(states[1 : len(t) + 1])))
        offset += len(row)
    ends = [signal.end for signal in signals if signal.end is not None]
    return Exosystem(
        S=readonly(block_diag(*blocks)) if offset else np.zeros((0, 0)),
        rates=np.array(rates, dtype=np.complex128),
        Q=readonly(block_diag(*[row[None] for row in rows]).reshape(len(signals), offset)),
        w0=readonly(np.concatenate([*starts, np.zeros(0)])),
        resets=tuple(sorted(resets, key=lambda each: each.t[0])),
        period=_period(signals),
        end=min(ends, default=None),
    )


def beside(one: Exosystem, other: Exosystem) -> Exosystem:
    """Return an exosystem with the signals of another one behind those that it has; together they have no period."""
    p = len(one.w0)
    return replace(
        one,
        S=readonly(block_diag(one.S, other.S)) if p else other.S,
        rates=np.concatenate([one.rates, other.rates]),
        Q=readonly(block_diag(one.Q, other.Q)),
        w0=readonly(np.concatenate([one.w0, other.w0])),
        resets=tuple(sorted([*one.resets, *(own.behind(p) for own in other.resets)], key=lambda each: each.t[0])),
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


def _terms(signal: Signal) -> dict[complex, NDArray[np.complex128]]:
    """Return the coefficients that some piece needs, (pieces, length of the chain), of each λ with Im λ ≥ 0."""
    terms = {rate: c for rate, c in signal.stacked().items() if rate.imag >= 0 and c.any()}
    return {rate: c[:, : np.flatnonzero(c.any(axis=0))[-1] + 1] for rate, c in terms.items()}


def _chain(rate: complex, c: NDArray[np.complex128]) -> tuple[Array, Array, Array]:
    """Return S and Q of a chain, and its state at the start of each piece, v_j(0) = j! c_j."""
    length = c.shape[1]
    v, shift = c * np.array([float(factorial(j)) for j in range(length)]), np.eye(length, k=1)
    if rate.imag == 0:
        return rate.real * np.eye(length) + shift, np.eye(length)[0], v.real
    turn = np.array([[rate.real, -rate.imag], [rate.imag, rate.real]])
    states = np.stack([v.real, v.imag], axis=2).reshape(len(v), -1)
    return np.kron(np.eye(length), turn) + np.kron(shift, np.eye(2)), 2.0 * np.eye(2 * length)[0], states


def _period(signals: Sequence[Signal]) -> float | None:
    """Return the least common period where all signals are sums of sinusoids with commensurable frequencies."""
    if any(len(signal.pieces) > 1 or signal.end is not None for signal in signals):
        return None
    chains = [chain for signal in signals for chain in _terms(signal).items()]
    if any(rate.real != 0 or c.shape[1] > 1 for rate, c in chains):
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
