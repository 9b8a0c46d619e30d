"""Gains as they ship: rounded to a few significant digits before anything is proved about them."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from posmas_fmi.expression import Array


def nearest(M: Array, digits: int, relative_zero: float = 1e-9) -> Array:
    """Round each entry to `digits` significant digits; entries near zero become zero.

    Examples
    --------
    >>> nearest(np.array([[0.123456789, 1e-12]]), 3)
    array([[0.123, 0. ]])
    """
    return _rounded(M, digits, relative_zero, round)


def towards_zero(M: Array, digits: int, relative_zero: float = 1e-9) -> Array:
    """Round as `nearest` does, but never to a larger modulus.

    Examples
    --------
    >>> towards_zero(np.array([[-0.56789]]), 3)
    array([[-0.567]])
    """
    return _rounded(M, digits, relative_zero, math.trunc)


def _rounded(M: Array, digits: int, relative_zero: float, integer: Callable[[float], int]) -> Array:
    top = float(np.abs(M).max(initial=0.0))
    out = np.zeros_like(M, dtype=float)
    for index, value in np.ndenumerate(M):
        if abs(value) > relative_zero * top:
            places = digits - 1 - math.floor(math.log10(abs(value)))
            # the decimal string makes the double the one that a reader would type
            out[index] = float(f"{integer(value * 10.0**places)}e{-places}")
    return out + 0.0  # no negative zeros
