"""Interval arithmetic on SymPy expressions: enclosures of a range that hold in floating point.

Every operation works on many boxes at once and rounds outwards: by one unit in the last place
where IEEE 754 prescribes correct rounding, by `_FUNCTION_ULPS` for the functions of numpy.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import attrs
import numpy as np
import sympy

from posmas_fmi.expression import VectorFunction, symbol

Array = np.ndarray[Any, np.dtype[np.float64]]
Mask = np.ndarray[Any, np.dtype[np.bool_]]
_FUNCTION_ULPS = 8  # numpy documents at most 4 for its vectorised functions


@attrs.frozen(eq=False)
class Interval:
    """Arrays of intervals ``[low, high]`` of equal shape; infinite ends are allowed.

    Examples
    --------
    >>> product = Interval.of(-1.0, 2.0) * Interval.of(0.0, 3.0)
    >>> float(product.low[0]) <= -3.0, float(product.high[0]) >= 6.0
    (True, True)
    """

    low: Array
    high: Array

    @classmethod
    def of(cls, low: Any, high: Any) -> Interval:
        """Interval(s) from scalars or arrays."""
        a, b = np.broadcast_arrays(np.atleast_1d(low), np.atleast_1d(high))
        return cls(np.array(a, dtype=float), np.array(b, dtype=float))

    def widen(self, ulps: int = 1) -> Interval:
        """Move both ends outwards by that many units in the last place."""
        if ulps == 1:
            return Interval(np.nextafter(self.low, -np.inf), np.nextafter(self.high, np.inf))
        with np.errstate(invalid="ignore"):
            grow = ulps * np.spacing(np.maximum(np.abs(self.low), np.abs(self.high)))
        grow = np.where(np.isfinite(grow), grow, 0.0)
        return Interval(self.low - grow, self.high + grow)

    def keep_sign(self, positive: Mask, negative: Mask) -> Interval:
        """Undo a rounding across zero where the exact range is known not to cross it."""
        low = np.where(positive, np.maximum(self.low, 0.0), self.low)
        return Interval(low, np.where(negative, np.minimum(self.high, 0.0), self.high))

    def __neg__(self) -> Interval:
        return Interval(-self.high, -self.low)

    def __add__(self, other: Interval) -> Interval:
        wide = Interval(self.low + other.low, self.high + other.high).widen()
        return wide.keep_sign(
            (self.low >= 0) & (other.low >= 0), (self.high <= 0) & (other.high <= 0)
        )

    def __mul__(self, other: Interval) -> Interval:
        with np.errstate(invalid="ignore", over="ignore"):
            ends = np.stack(
                [
                    self.low * other.low,
                    self.low * other.high,
                    self.high * other.low,
                    self.high * other.high,
                ]
            )
        # 0 * inf: the factor is exactly zero there, so is every product with finite reals
        ends = np.where(np.isnan(ends), 0.0, ends)
        a_pos, a_neg = self.low >= 0, self.high <= 0
        b_pos, b_neg = other.low >= 0, other.high <= 0
        wide = Interval(ends.min(axis=0), ends.max(axis=0)).widen()
        return wide.keep_sign((a_pos & b_pos) | (a_neg & b_neg), (a_pos & b_neg) | (a_neg & b_pos))

    def reciprocal(self) -> Interval:
        """1/x; the whole line where the interval has zero inside."""
        with np.errstate(divide="ignore", over="ignore"):
            low, high = 1.0 / self.high, 1.0 / self.low
        zero_low, zero_high = self.low == 0, self.high == 0
        inside = (self.low < 0) & (self.high > 0) | (zero_low & zero_high)
        low = np.where(inside | zero_high, -np.inf, low)
        high = np.where(inside | zero_low, np.inf, high)
        return Interval(low, high).widen().keep_sign(self.low >= 0, self.high <= 0)

    def power(self, n: int) -> Interval:
        """x**n for an integer n ≥ 1."""
        with np.errstate(over="ignore"):
            a, b = self.low**n, self.high**n
        if n % 2 == 1:
            return Interval(a, b).widen(_FUNCTION_ULPS)
        crosses = (self.low <= 0) & (self.high >= 0)
        low = np.where(crosses, 0.0, np.minimum(a, b))
        wide = Interval(low, np.maximum(a, b)).widen(_FUNCTION_ULPS)
        return Interval(np.maximum(wide.low, 0.0), wide.high)

    def monotone(self, f: Callable[[Array], Array], low: float, high: float) -> Interval:
        """Apply an increasing function whose values lie in ``[low, high]``."""
        with np.errstate(all="ignore"):
            a, b = f(self.low), f(self.high)
        a, b = np.where(np.isnan(a), low, a), np.where(np.isnan(b), high, b)
        wide = Interval(a, b).widen(_FUNCTION_ULPS)
        return Interval(np.clip(wide.low, low, high), np.clip(wide.high, low, high))


def _contains_point(x: Interval, phase: float) -> Mask:
    """Whether phase + 2kπ may lie in the interval, for some k (never wrongly False)."""
    period = 2 * math.pi
    with np.errstate(invalid="ignore"):
        slack = 1e-9 * (1.0 + np.abs(x.low) + np.abs(x.high))
        k = np.ceil((x.low - slack - phase) / period)
        hit = phase + k * period <= x.high + slack
    return hit | ~np.isfinite(x.low) | ~np.isfinite(x.high)


def _sin(x: Interval, shift: float = 0.0) -> Interval:
    """sin(x + shift) for shift 0 (sine) or π/2 (cosine)."""
    f = np.sin if shift == 0.0 else np.cos
    with np.errstate(invalid="ignore"):
        a, b = np.nan_to_num(f(x.low)), np.nan_to_num(f(x.high))
    wide = Interval(np.minimum(a, b), np.maximum(a, b)).widen(_FUNCTION_ULPS)
    top = _contains_point(x, math.pi / 2 - shift)
    bottom = _contains_point(x, -math.pi / 2 - shift)
    low = np.where(bottom, -1.0, np.maximum(wide.low, -1.0))
    return Interval(low, np.where(top, 1.0, np.minimum(wide.high, 1.0)))


def _abs(x: Interval) -> Interval:
    crosses = (x.low <= 0) & (x.high >= 0)
    a, b = np.abs(x.low), np.abs(x.high)
    return Interval(np.where(crosses, 0.0, np.minimum(a, b)), np.maximum(a, b))


def _tan(x: Interval) -> Interval:
    # tan = sin/cos is enclosed by the whole line at a pole and is monotone between two
    pole = _contains_point(x, math.pi / 2) | _contains_point(x, -math.pi / 2)
    inner = x.monotone(np.tan, -np.inf, np.inf)
    return Interval(np.where(pole, -np.inf, inner.low), np.where(pole, np.inf, inner.high))


def _cosh(x: Interval) -> Interval:
    return _abs(x).monotone(np.cosh, 1.0, np.inf)


def _step(x: Interval) -> Interval:
    """Heaviside function, set-valued at its jump: the closure of both sides."""
    return Interval(np.where(x.low > 0, 1.0, 0.0), np.where(x.high >= 0, 1.0, 0.0))


_MONOTONE: dict[Any, tuple[Callable[[Array], Array], float, float]] = {
    sympy.exp: (np.exp, 0.0, np.inf),
    sympy.log: (np.log, -np.inf, np.inf),
    sympy.tanh: (np.tanh, -1.0, 1.0),
    sympy.sinh: (np.sinh, -np.inf, np.inf),
    sympy.atan: (np.arctan, -math.pi / 2, math.pi / 2),
}


def evaluate(expr: sympy.Expr, box: Mapping[sympy.Symbol, Interval]) -> Interval:
    """Enclose the range of an expression over boxes.

    Parameters
    ----------
    expr : sympy.Expr
        From `posmas_fmi.expression` or a derivative of such.
    box : mapping
        Interval of each symbol, all of equal shape.

    Returns
    -------
    Interval

    Examples
    --------
    >>> x = symbol("x1")
    >>> r = evaluate(sympy.sin(x), {x: Interval.of(0.0, 7.0)})
    >>> float(r.low[0]), float(r.high[0])
    (-1.0, 1.0)
    """
    if expr.is_Symbol:
        return box[expr]
    if expr.is_number:
        exact = float(expr)
        # a rational such as 31/100 is the double nearest to it up to half a unit
        is_double = expr.is_Integer and abs(exact) <= 2.0**53
        value = Interval.of(exact, exact)
        return value if is_double else value.widen(2)
    args = [evaluate(arg, box) for arg in expr.args if not expr.is_Pow]
    if expr.is_Add:
        return _fold(args, Interval.__add__)
    if expr.is_Mul:
        return _fold(args, Interval.__mul__)
    if expr.is_Pow:
        return _power(expr, box)
    if expr.func in _MONOTONE:
        f, low, high = _MONOTONE[expr.func]
        return args[0].monotone(f, low, high)
    match expr.func:
        case sympy.sin:
            return _sin(args[0])
        case sympy.cos:
            return _sin(args[0], math.pi / 2)
        case sympy.tan:
            return _tan(args[0])
        case sympy.cosh:
            return _cosh(args[0])
        case sympy.Abs:
            return _abs(args[0])
        case sympy.Heaviside:
            return _step(args[0])
        case sympy.sign:
            step = _step(args[0])
            return Interval(2.0 * step.low - 1.0, 2.0 * step.high - 1.0)
        case sympy.Min:
            return _fold(args, _minimum)
        case sympy.Max:
            return _fold(args, _maximum)
    # a function without an enclosure of its own: nothing is known, which is always true
    shape = next(iter(box.values())).low.shape
    return Interval(np.full(shape, -np.inf), np.full(shape, np.inf))


def _fold(parts: list[Interval], f: Callable[[Interval, Interval], Interval]) -> Interval:
    result = parts[0]
    for part in parts[1:]:
        result = f(result, part)
    return result


def _minimum(a: Interval, b: Interval) -> Interval:
    return Interval(np.minimum(a.low, b.low), np.minimum(a.high, b.high))


def _maximum(a: Interval, b: Interval) -> Interval:
    return Interval(np.maximum(a.low, b.low), np.maximum(a.high, b.high))


def _power(expr: sympy.Expr, box: Mapping[sympy.Symbol, Interval]) -> Interval:
    base, exponent = expr.args
    x = evaluate(base, box)
    if exponent.is_Integer:
        n = int(exponent)
        return x.power(n) if n > 0 else x.power(-n).reciprocal()
    c = float(exponent)
    root = x.monotone(lambda v: np.maximum(v, 0.0) ** abs(c), 0.0, np.inf)
    return root if c > 0 else root.reciprocal()


@attrs.frozen
class Range:
    """Enclosure of the range of an expression, with points that show how tight it is.

    Attributes
    ----------
    low, high : float
        No value lies outside.
    least, most : float
        Smallest and largest value found at a point (in plain floating point).
    argmin, argmax : dict of str to float
        Those points.
    """

    low: float
    high: float
    least: float
    most: float
    argmin: dict[str, float] = attrs.field(eq=False)
    argmax: dict[str, float] = attrs.field(eq=False)

    @property
    def magnitude(self) -> float:
        """Bound on the modulus."""
        return max(abs(self.low), abs(self.high))


def bounds(
    expr: sympy.Expr,
    region: Mapping[str, tuple[float, float]],
    claim: tuple[float, float] = (-math.inf, math.inf),
    tolerance: float = 1e-3,
    max_boxes: int = 20_000,
) -> Range:
    """Enclose the range of an expression over a region by branch and bound.

    Parameters
    ----------
    expr : sympy.Expr
        Expression in the variables of `region`.
    region : mapping
        ``name -> (low, high)``; infinite ends are allowed, such a variable is not bisected.
    claim : (float, float)
        Bounds to prove or refute, where finite: work goes on until the enclosure lies within them
        or a point outside is found.
    tolerance : float
        Elsewhere: stop once the enclosure is this close (relative to its size) to values found.
    max_boxes : int
        Stop before there are more boxes than this.

    Returns
    -------
    Range

    Examples
    --------
    >>> x = symbol("x1")
    >>> r = bounds(x - x**2, {"x1": (0.0, 1.0)})
    >>> round(r.most, 3), 0.25 <= r.high < 0.2503
    (0.25, True)
    """
    names = sorted(str(s) for s in expr.free_symbols)
    if not names:
        value = evaluate(expr, {symbol("_"): Interval.of(0.0, 0.0)})
        exact = float(expr)
        return Range(float(value.low[0]), float(value.high[0]), exact, exact, {}, {})
    corners = np.array([region[name] for name in names], dtype=float)
    low: Array = corners[:, :1].T.copy()  # (boxes, variables)
    high: Array = corners[:, 1:].T.copy()
    width0 = high[0] - low[0]
    splits = np.isfinite(width0) & (width0 > 0)
    point_value = VectorFunction((expr,), tuple(names)).numpy()
    least, most = math.inf, -math.inf
    argmin: dict[str, float] = {}
    argmax: dict[str, float] = {}
    settled_low, settled_high = math.inf, -math.inf  # hull of boxes no longer looked at
    while True:
        box = {symbol(n): Interval(low[:, k], high[:, k]) for k, n in enumerate(names)}
        value = evaluate(expr, box)
        points = np.concatenate([_inner_point(low, high), low, high])
        points = points[np.isfinite(points).all(axis=1)]
        with np.errstate(all="ignore"):
            found = point_value(*points.T)[:, 0]
        points, found = points[np.isfinite(found)], found[np.isfinite(found)]
        if found.size and found.min() < least:
            least, argmin = (
                float(found.min()),
                dict(zip(names, points[found.argmin()].tolist(), strict=True)),
            )
        if found.size and found.max() > most:
            most, argmax = (
                float(found.max()),
                dict(zip(names, points[found.argmax()].tolist(), strict=True)),
            )
        slack = tolerance * max(1e-300, abs(least), abs(most)) if math.isfinite(most) else 0.0
        low_enough = claim[0] if -math.inf < claim[0] <= least else least - slack
        high_enough = claim[1] if most <= claim[1] < math.inf else most + slack
        open_ = (value.low < low_enough) | (value.high > high_enough)
        settled_low = min(settled_low, float(value.low[~open_].min(initial=math.inf)))
        settled_high = max(settled_high, float(value.high[~open_].max(initial=-math.inf)))
        if not open_.any() or not splits.any() or 2 * open_.sum() > max_boxes:
            enclosure_low = min(settled_low, float(value.low[open_].min(initial=math.inf)))
            enclosure_high = max(settled_high, float(value.high[open_].max(initial=-math.inf)))
            return Range(enclosure_low, enclosure_high, least, most, argmin, argmax)
        low, high = _bisect(low[open_], high[open_], width0, splits)


def _inner_point(low: Array, high: Array) -> Array:
    """Return a finite point of each box: the middle, or near the end of an unbounded side."""
    with np.errstate(invalid="ignore"):
        middle = 0.5 * (low + high)
    one_sided = np.where(np.isfinite(low), low + 1.0, np.where(np.isfinite(high), high - 1.0, 0.5))
    return np.where(np.isfinite(middle), middle, one_sided)


def _bisect(low: Array, high: Array, width0: Array, splits: Array) -> tuple[Array, Array]:
    """Halve each box along the variable that is widest relative to the region."""
    with np.errstate(invalid="ignore", divide="ignore"):
        relative = np.where(splits, (high - low) / width0, -1.0)
    axis, rows = relative.argmax(axis=1), np.arange(len(low))
    middle = 0.5 * (low[rows, axis] + high[rows, axis])
    upper_low, lower_high = low.copy(), high.copy()
    upper_low[rows, axis] = middle
    lower_high[rows, axis] = middle
    return np.concatenate([low, upper_low]), np.concatenate([lower_high, high])
