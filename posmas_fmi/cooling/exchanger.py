"""The counterflow heat exchanger of a cooling unit by the ε-NTU method."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from posmas_fmi.expression import Array

_SERIES = 1e-3  # below this x coth x is its series: the closed form loses digits
_STANDSTILL = 1e-12  # W/K: a smaller flow is none


def conductance(UA: ArrayLike, hot: ArrayLike, cold: ArrayLike) -> Array:
    """Heat taken per kelvin between the two inlets, ``κ = ε(NTU) C_min``.

    With ``q = UA (1/hot - 1/cold)`` the textbook's formula is
    ``1/κ = (1/hot + 1/cold)/2 + (q/2) coth(q/2)/UA``, symmetric in both streams and smooth where
    they are equal. It shows what the proofs need: κ < min(hot, cold), and κ rises with either flow.

    Parameters
    ----------
    UA : array_like
        Overall conductance [W/K].
    hot, cold : array_like
        Heat capacity flows of the two streams [W/K]; no heat passes where one is zero.

    Returns
    -------
    ndarray
        κ [W/K].

    References
    ----------
    Incropera, DeWitt: Fundamentals of Heat and Mass Transfer, table 11.3, counterflow.

    Examples
    --------
    >>> round(float(conductance(20e3, 8e3, 8e3)), 3)  # equal streams: NTU/(1 + NTU) C
    5714.286
    """
    UA, hot, cold = np.broadcast_arrays(*(np.asarray(v, dtype=float) for v in (UA, hot, cold)))
    flows = (hot > _STANDSTILL) & (cold > _STANDSTILL)
    a, b = np.where(flows, hot, 1.0), np.where(flows, cold, 1.0)
    q = UA * (1 / a - 1 / b)
    return np.where(flows, 1 / ((1 / a + 1 / b) / 2 + x_coth_x(q / 2) / UA), 0.0)


def conductance_slope(UA: ArrayLike, hot: ArrayLike, cold: ArrayLike) -> Array:
    """Return ∂κ/∂cold of `conductance`, from 0 (ample cold water) to 1 (very little of it).

    Examples
    --------
    >>> float(conductance_slope(20e3, 8e3, 1.0).round(6))
    1.0
    """
    UA, hot, cold = (np.asarray(v, dtype=float) for v in (UA, hot, cold))
    kappa = conductance(UA, hot, cold)
    half_q = UA * (1 / hot - 1 / cold) / 2
    return np.asarray((kappa / cold) ** 2 * (1 - x_coth_x_slope(half_q)) / 2)


def x_coth_x(x: Array) -> Array:
    """Return x coth x, 1 at zero."""
    small = np.abs(x) < _SERIES
    safe = np.where(small, 1.0, x)
    return np.where(small, 1 + np.where(small, x, 0.0) ** 2 / 3, safe / np.tanh(safe))


def x_coth_x_slope(x: Array) -> Array:
    """Return coth x - x/sinh² x, between -1 and 1."""
    small = np.abs(x) < _SERIES
    safe = np.where(small, 1.0, np.clip(x, -300, 300))  # sinh overflows later than this
    return np.where(small, 2 * x / 3, 1 / np.tanh(safe) - safe / np.sinh(safe) ** 2)
