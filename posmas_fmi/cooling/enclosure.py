"""Enclosure of the slope ∂κ/∂y over ranges of valve position and header pressure."""

from __future__ import annotations

import math

import numpy as np

from posmas_fmi.cooling.exchanger import x_coth_x, x_coth_x_slope
from posmas_fmi.cooling.line import LineParameters
from posmas_fmi.errors import InputError
from posmas_fmi.interval import Interval

# coth has a pole where both streams of the exchanger are equal, κ does not: there the text of an
# agent holds |q|/2 at this value, which changes κ by less than 1e-6 of itself. Enclosures hold for
# both.
POLE = 1e-3
_BOXES = (2048, 64)  # over y and h: the enclosure is wider than the range by 2 to 3 %
_OWN_ULPS = 4096  # x coth x and its slope lose this much where the closed form meets the series


def kappa_slope_range(
    line: LineParameters,
    opening: tuple[float, float] = (0.0, 1.0),
    header: tuple[float, float] = (1.0, 1.0),
) -> tuple[float, float]:
    """Enclose ∂κ/∂y over valve positions and header pressures, by interval arithmetic on a grid.

    Parameters
    ----------
    line : LineParameters
    opening : (float, float)
        Range of the valve position.
    header : (float, float)
        Range of the header pressure factor h, above 0.

    Returns
    -------
    (float, float)
        No slope lies outside [W/K].

    Raises
    ------
    InputError
        If a range is empty or outside ``0 <= y <= 1``, ``h > 0``.

    Examples
    --------
    >>> line = LineParameters()
    >>> low, high = kappa_slope_range(line, (0.3, 1.0))
    >>> low < float(line.kappa_slope(0.5)) < high
    True
    """
    if not 0 <= opening[0] < opening[1] <= 1:
        raise InputError(f"expected 0 <= low < high <= 1 (got {opening})", "opening")
    if not 0 < header[0] <= header[1] < math.inf:
        raise InputError(f"expected 0 < low <= high (got {header})", "header")
    y, h = _boxes(opening, header)
    log_r = _point(math.log(line.R)).widen(2)
    closing = ((_point(2.0) + -(y * _point(2.0))) * log_r).monotone(np.exp, 0.0, math.inf)
    closing = closing * _point(line.N)
    kv = (closing + _point(1 - line.N).widen()).monotone(np.sqrt, 0.0, math.inf).reciprocal()
    kv_slope = kv.power(3) * closing * log_r
    flow = _point(line.cw * line.wmax).widen() * h.monotone(np.sqrt, 0.0, math.inf)
    per_cold, per_hot = (flow * kv).reciprocal(), _point(line.ws).reciprocal()
    x = _point(line.UA / 2) * (per_hot + -per_cold)
    size = Interval(np.maximum(np.maximum(x.low, -x.high), 0.0), np.maximum(-x.low, x.high))
    held = size.low <= POLE
    size = Interval(size.low, np.maximum(size.high, POLE))
    even = size.monotone(x_coth_x, 1.0, math.inf).widen(_OWN_ULPS)
    odd = x.monotone(x_coth_x_slope, -1.0, 1.0)
    low, high = odd.low - _OWN_ULPS * 2.0**-52, odd.high + _OWN_ULPS * 2.0**-52
    odd = Interval(
        np.where(held, np.minimum(low, 0.0), low), np.where(held, np.maximum(high, 0.0), high)
    )
    half = _point(0.5)
    kappa = (half * (per_hot + per_cold) + even * _point(line.UA).reciprocal()).reciprocal()
    by_cold = (kappa * per_cold).power(2) * half * (_point(1.0) + -odd)
    slope = by_cold * flow * kv_slope
    return max(0.0, float(slope.low.min())), float(slope.high.max())


def _point(value: float) -> Interval:
    return Interval.of(value, value)


def _boxes(opening: tuple[float, float], header: tuple[float, float]) -> tuple[Interval, Interval]:
    """Intervals of y and h whose pairs cover both ranges."""
    y = np.linspace(*opening, _BOXES[0] + 1)
    h = np.linspace(*header, _BOXES[1] + 1) if header[0] < header[1] else np.array(2 * header[:1])
    low = np.meshgrid(y[:-1], h[:-1], indexing="ij")
    high = np.meshgrid(y[1:], h[1:], indexing="ij")
    return Interval(low[0].ravel(), high[0].ravel()), Interval(low[1].ravel(), high[1].ravel())
