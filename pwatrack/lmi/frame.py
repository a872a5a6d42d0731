"""Coordinates that are long one way and short another: in them matrices are products of longer numbers than doubles."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import flint
import numpy as np

from pwatrack.arrays import Array
from pwatrack.rational import Rational, middle, near

_BITS = 160  # of products: where a condition of 1e16 takes twice its digits, more than doubles have are left


@dataclass(frozen=True)
class Frame:
    """Coordinates L z.

    Example:
        >>> frame = Frame(np.array([[1e9, 1.0], [0.0, 1e-9]]))
        >>> frame.inside(np.array([[[1.0, 1e-18], [0.0, 1.0]]])).tolist()
        [[[1.0, 1.0], [0.0, 1.0]]]
    """

    L: Array  # (n, n)

    def inside(self, X: Array) -> Array:
        """Return L X_i L⁻¹ of matrices, (v, n, n)."""
        L, back = self._both
        return _each(X, lambda X_i: L * X_i * back)

    def left(self, X: Array) -> Array:
        """Return L X_i, (v, n, k)."""
        return _each(X, lambda X_i: self._both[0] * X_i)

    def right(self, X: Array) -> Array:
        """Return X_i L⁻¹, (v, k, n)."""
        return _each(X, lambda X_i: X_i * self._both[1])

    def outside(self, Q: Array, size: float) -> Rational:
        """Return size L⁻¹ Q L⁻ᵀ of a symmetric Q, (n, n), far more exactly than in doubles."""
        back, half = self._both[1], _balls((Q + Q.T) / 2)
        with flint.ctx.workprec(_BITS):
            upper = middle(back * half * back.transpose() * flint.arb(size))
        return (upper + upper.transpose()) / 2

    @cached_property
    def _both(self) -> tuple[Any, Any]:
        L = _balls(self.L)
        with flint.ctx.workprec(_BITS):
            return L, L.inv()


def _each(X: Array, product: Callable[[Any], Any]) -> Array:
    with flint.ctx.workprec(_BITS):
        found = [near(product(_balls(X_i))) if X_i.size else X_i for X_i in X]
    return np.array(found)


def _balls(X: Array) -> Any:
    return flint.arb_mat(X.shape[0], X.shape[1], X.ravel().tolist())
