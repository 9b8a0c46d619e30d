"""Proofs that a symmetric matrix is definite: exact rational LDLᵀ, or a verified Cholesky.

A solver's status proves nothing. Small matrices are taken through LDLᵀ in rational arithmetic;
larger ones through one floating-point Cholesky factorisation whose backward error is bounded by
Σ|a||b| (Rump 2006, *Verification of positive definiteness*; Higham 2002, theorem 10.3).
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import attrs
import numpy as np

from posmas_fmi.expression import Array

UNIT = 2.0**-53  # rounding unit of IEEE 754 double precision
EXACT_LIMIT = 20  # rows up to which rational arithmetic is used
_STEP_BACK = 1e-6  # the bound that is proved is this much (relative) below the estimate


@attrs.frozen
class Definiteness:
    """Outcome of a proof about the smallest eigenvalue of a symmetric matrix.

    Attributes
    ----------
    estimate : float
        Smallest eigenvalue in plain floating point.
    bound : float
        Proved lower bound of it; ``-inf`` if nothing was proved.
    method : str
        How.
    """

    estimate: float
    bound: float
    method: str

    @property
    def positive(self) -> bool:
        """Whether the matrix is proved positive definite."""
        return self.bound > 0

    def __str__(self) -> str:
        return f"smallest eigenvalue {self.estimate:.6g}, proved >= {self.bound:.6g}, {self.method}"


def rational(value: Any) -> Any:
    """Decimals as typed: an object array of fractions of the same shape.

    Examples
    --------
    >>> rational([[0.1]])[0, 0]
    Fraction(1, 10)
    """
    array = np.asarray(value)
    if array.dtype == object:
        return array
    exact = [Fraction(repr(float(x))) for x in array.ravel()]
    out = np.empty(array.size, dtype=object)
    out[:] = exact
    return out.reshape(array.shape)


def dyadic(value: Any) -> Any:
    """Doubles as they are, as fractions."""
    array = np.asarray(value, dtype=float)
    out = np.empty(array.size, dtype=object)
    out[:] = [Fraction(float(x)) for x in array.ravel()]
    return out.reshape(array.shape)


def identity(n: int) -> Any:
    """Rational identity matrix."""
    return dyadic(np.eye(n))


def diagonal(values: Any) -> Any:
    """Diagonal matrix of fractions; floats are taken as the doubles they are."""
    exact = values if np.asarray(values).dtype == object else dyadic(values)
    out = np.full((len(exact), len(exact)), Fraction(0), dtype=object)
    for k, value in enumerate(exact):
        out[k, k] = value
    return out


def pivots(M: Any) -> list[Fraction]:
    """Pivots of LDLᵀ of a symmetric rational matrix, up to the first that is not positive.

    Parameters
    ----------
    M : (n, n) object array of Fraction

    Returns
    -------
    list of Fraction
        n positive pivots iff M is positive definite.

    Examples
    --------
    >>> pivots(rational([[2.0, 1.0], [1.0, 2.0]]))
    [Fraction(2, 1), Fraction(3, 2)]
    >>> pivots(rational([[1.0, 2.0], [2.0, 1.0]]))
    [Fraction(1, 1), Fraction(-3, 1)]
    """
    rest = M.copy()
    found: list[Fraction] = []
    for k in range(len(rest)):
        pivot = rest[k, k]
        found.append(pivot)
        if pivot <= 0:
            break
        column = rest[k + 1 :, k] / pivot
        rest[k + 1 :, k + 1 :] -= np.outer(column, rest[k, k + 1 :])
    return found


def exactly_positive(M: Any) -> bool:
    """Whether a symmetric rational matrix is positive definite; a proof either way."""
    found = pivots(M)
    return len(found) == len(M) and found[-1] > 0


def positive_definite(M: Any) -> Definiteness:
    """Prove a symmetric matrix positive definite.

    Parameters
    ----------
    M : (n, n) array
        Fractions (taken exactly) or floats (taken as the doubles they are).

    Returns
    -------
    Definiteness

    Examples
    --------
    >>> positive_definite(np.array([[2.0, 1.0], [1.0, 2.0]])).positive
    True
    """
    exact = np.asarray(M).dtype == object
    if len(M) > EXACT_LIMIT:
        if exact:
            return _enclosed_cholesky(M)
        return verified_cholesky(np.asarray(M, dtype=float))
    fractions = M if exact else dyadic(M)
    approximate = np.array(fractions, dtype=float)
    if not np.isfinite(approximate).all():
        return Definiteness(float("nan"), -np.inf, "entries beyond double precision")
    estimate = float(np.linalg.eigvalsh(approximate)[0])
    size = float(np.abs(approximate).sum(axis=1).max(initial=0.0))
    positive = exactly_positive(fractions)
    for distance in (_STEP_BACK * abs(estimate), 1e-12 * size):
        shift = estimate - distance
        if positive and shift <= 0:
            continue  # known to be too low a bound already
        if exactly_positive(fractions - identity(len(fractions)) * Fraction(shift)):
            return Definiteness(estimate, shift, "exact rational LDL^T")
    if positive:
        return Definiteness(estimate, 5e-324, "exact rational LDL^T")
    return Definiteness(estimate, -np.inf, "exact rational LDL^T fails")


def verified_cholesky(M: Array, inexact: float = 0.0) -> Definiteness:
    """Lower bound of the smallest eigenvalue from one Cholesky factorisation of ``M - αI``.

    Parameters
    ----------
    M : (n, n) array
        Symmetric.
    inexact : float
        Bound on the spectral norm of what M leaves out of the matrix meant.
    """
    import scipy.linalg

    n = len(M)
    if not np.isfinite(M).all():
        return Definiteness(float("nan"), -np.inf, "entries that are not finite")
    estimate = float(scipy.linalg.eigvalsh(M, subset_by_index=[0, 0])[0])
    gamma = (n + 2) * UNIT / (1 - (n + 2) * UNIT)
    trace = float(np.abs(np.diag(M)).sum()) + n * abs(estimate)
    # backward error of the factorisation, of subtracting the shift, and underflow
    error = 1.01 * (gamma / (1 - gamma) * trace + UNIT * trace + n * n * 1e-300) + inexact
    method = f"verified Cholesky, rounding error <= {error:.3g}"
    for distance in (_STEP_BACK * abs(estimate), 4 * error):
        shift = estimate - distance
        try:
            np.linalg.cholesky(M - shift * np.eye(n))
        except np.linalg.LinAlgError:
            continue
        bound = float(np.nextafter(shift - error, -np.inf))
        return Definiteness(estimate, bound, method)
    return Definiteness(estimate, -np.inf, method + "; the factorisation broke down")


def _enclosed_cholesky(M: Any) -> Definiteness:
    """Prove a rational matrix positive that is too large for rational elimination."""
    nearest = np.array(M, dtype=float)
    rounding = float(UNIT * 1.01 * np.abs(nearest).sum(axis=1).max())
    return verified_cholesky(0.5 * (nearest + nearest.T), rounding)


def refuted(M: Any, w: Any) -> Fraction:
    """``wᵀMw`` exactly, for a rational M and a vector: not above zero refutes ``M ≻ 0``."""
    exact = dyadic(w) if np.asarray(w).dtype != object else w
    value: Fraction = exact @ M @ exact
    return value
