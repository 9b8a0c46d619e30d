"""Small interval matrices: products, and exponentials that lose no digits to cancellation.

``A + σI ≥ 0`` turns every sum in the Taylor series of ``e^{Aτ} = e^{-στ} e^{(A+σI)τ}`` into a sum
of non-negative terms: nothing cancels, so the enclosures stay tight entry by entry.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from posmas_fmi.expression import Array
from posmas_fmi.interval import Interval, Mask

_DEGREE = 16  # with ‖X‖ ≤ 1/2 the remainder is below 2e-20
_MAX_EXPONENT = 600.0  # e^600 is still far from overflow
_UNDERFLOW = 1e-300  # far above what sums of underflowing products can lose
_UP = 1 + 2.0**-51


def typed(value: Any) -> Interval:
    """Enclose decimals as typed: the double read from text is off by half a unit at most.

    Examples
    --------
    >>> tenth = typed(0.1)
    >>> float(tenth.low[0]) < 0.1 < float(tenth.high[0])
    True
    """
    array = np.atleast_1d(np.asarray(value, dtype=float))
    whole = (array == np.round(array)) & (np.abs(array) <= 2.0**53)
    low, high = np.nextafter(array, -np.inf), np.nextafter(array, np.inf)
    return Interval(np.where(whole, array, low), np.where(whole, array, high))


def point(value: Any) -> Interval:
    """Doubles taken as they are."""
    array = np.atleast_1d(np.asarray(value, dtype=float))
    return Interval(array, array)


def middle(M: Interval) -> tuple[Array, float]:
    """Middle of a matrix, and a bound of the Frobenius norm of what is left; NaN where infinite."""
    with np.errstate(invalid="ignore"):
        centre = 0.5 * (M.low + M.high)
        radius = np.maximum(M.high - centre, centre - M.low)
    return centre, float(np.linalg.norm(radius)) * (1 + 1e-9) + _UNDERFLOW


def matmul(a: Interval, b: Interval) -> Interval:
    """Matrix product over the last two axes; leading axes broadcast."""
    total = _column(a, 0) * _row(b, 0)
    for k in range(1, a.low.shape[-1]):
        total = total + _column(a, k) * _row(b, k)
    return total


def _column(a: Interval, k: int) -> Interval:
    return Interval(a.low[..., :, k, None], a.high[..., :, k, None])


def _row(b: Interval, k: int) -> Interval:
    return Interval(b.low[..., None, k, :], b.high[..., None, k, :])


def magnitude(a: Interval) -> Interval:
    """Entrywise modulus."""
    crosses = (a.low <= 0) & (a.high >= 0)
    low, high = np.abs(a.low), np.abs(a.high)
    return Interval(np.where(crosses, 0.0, np.minimum(low, high)), np.maximum(low, high))


def block(a: Interval, rows: slice, columns: slice) -> Interval:
    """Part of the last two axes."""
    return Interval(a.low[..., rows, columns], a.high[..., rows, columns])


def shift_of(*matrices: Interval) -> float:
    """Smallest σ ≥ 0 that makes the diagonals of all of ``M + σI`` non-negative."""
    lowest = min(float(np.diagonal(M.low).min()) for M in matrices)
    return max(0.0, -lowest)


def shifted(M: Interval, sigma: float) -> Interval:
    """``M + σI`` with the diagonal kept at or above zero."""
    diagonal = np.eye(M.low.shape[-1], dtype=bool)
    total = M + point(np.where(diagonal, sigma, 0.0))
    return total.keep_sign(diagonal, np.zeros_like(diagonal))


def exp_nonnegative(P: Interval, times: Array) -> tuple[Interval, Interval, Interval]:
    """``φ₀ = e^{Pτ}``, ``φ₁ = (1/τ) ∫₀^τ e^{Ps} ds`` and ``φ₂ = Σ (Pτ)^k/(k+2)!`` for P ≥ 0.

    Parameters
    ----------
    P : (m, m) Interval
        Entries whose lower ends are ≥ 0.
    times : (n,) array
        Exact doubles ≥ 0.

    Returns
    -------
    phi0, phi1, phi2 : (n, m, m) Interval
        Where ``‖P‖τ`` is beyond 600 only ``[0, inf]``.

    Examples
    --------
    >>> E, _, _ = exp_nonnegative(point([[1.0]]), np.array([1.0]))
    >>> bool(E.low[0, 0, 0] <= np.e <= E.high[0, 0, 0]), bool(E.high[0, 0, 0] < 2.7182818284592)
    (True, True)
    """
    m = P.low.shape[-1]
    norm = float(P.high.sum(axis=-1).max()) * float(times.max(initial=0.0))
    if not norm <= _MAX_EXPONENT:
        shape = (len(times), m, m)
        unknown = Interval(np.zeros(shape), np.full(shape, np.inf))
        return unknown, unknown, unknown
    squarings = max(0, math.ceil(math.log2(max(norm, 1e-300))) + 1)
    scaled = np.ldexp(times, -squarings)[:, None, None]
    X = P * point(scaled)
    identity = point(np.eye(m)[None])
    phi = list(_taylor(X, identity))
    for _ in range(squarings):
        half = product((phi[0] + identity) * point(0.5), phi[1])
        phi[2] = (product(phi[1], phi[1]) + phi[2] + phi[2]) * point(0.25)
        phi[0], phi[1] = product(phi[0], phi[0]), half
    reached = _reached(P)
    return _masked(phi[0], reached), _masked(phi[1], reached), _masked(phi[2], reached)


def _masked(a: Interval, reached: Mask) -> Interval:
    return Interval(a.low, np.where(reached, a.high, 0.0))


def _reached(P: Interval) -> Mask:
    """Where a power of P can be non-zero: elsewhere the exponential is exactly zero."""
    m = P.low.shape[-1]
    pattern = (P.high > 0) | np.eye(m, dtype=bool)
    for _ in range(max(1, math.ceil(math.log2(m))) if m > 1 else 0):
        pattern = pattern.astype(float) @ pattern.astype(float) > 0
    return pattern


def _taylor(X: Interval, identity: Interval) -> tuple[Interval, Interval, Interval]:
    """Series of φ₀, φ₁ and φ₂ by Horner's rule for ‖X‖ ≤ 1/2, remainders added above."""
    zeroth = first = identity
    second = identity
    for k in range(_DEGREE, 0, -1):
        second = identity + _over(product(X, second), k + 2)
        first = identity + _over(product(X, first), k + 1)
        zeroth = identity + _over(product(X, zeroth), k)
    # the first term left out is at most 2^-17/17!, the following ones shrink by 1/36
    remainder = 1.1 * 2.0**-17 / math.factorial(17)
    second = second * point(0.5)
    return _raise(zeroth, remainder), _raise(first, remainder), _raise(second, remainder)


def product(a: Interval, b: Interval) -> Interval:
    """Matrix product of non-negative intervals: two products with a relative error bound.

    Exact zeros stay exact: an entry is zero only where every term of its sum is.
    """
    roundings = 2 * (a.low.shape[-1] + 2) * 2.0**-53
    low = np.maximum((a.low @ b.low) * (1 - roundings) - _UNDERFLOW, 0.0)
    with np.errstate(invalid="ignore", over="ignore"):
        high = np.nan_to_num((a.high @ b.high) * (1 + roundings), nan=np.inf, posinf=np.inf)
    reached = (a.high > 0).astype(float) @ (b.high > 0).astype(float) > 0
    return Interval(low, np.where(reached, high + _UNDERFLOW, 0.0))


def _over(a: Interval, k: int) -> Interval:
    return Interval(np.nextafter(a.low / k, 0.0), np.where(a.high > 0, a.high / k * _UP, 0.0))


def _raise(a: Interval, amount: float) -> Interval:
    return Interval(a.low, np.nextafter(a.high + amount, np.inf))


def exp_scalar(x: Interval) -> Interval:
    """Scalar exponential."""
    return x.monotone(np.exp, 0.0, np.inf)
