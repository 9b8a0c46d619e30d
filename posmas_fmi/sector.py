"""The sector of an input nonlinearity, (2): an enclosure of sec(u)/u."""

from __future__ import annotations

import math
from itertools import pairwise

import sympy

from posmas_fmi.expression import symbol
from posmas_fmi.interval import Range, bounds


def sector_range(
    expr: sympy.Expr,
    name: str,
    region: tuple[float, float],
    claim: tuple[float, float] = (-math.inf, math.inf),
) -> Range:
    """Enclose ``sec(u)/u``: directly where it simplifies, else piecewise with the slope at zero.

    Parameters
    ----------
    expr : sympy.Expr
        ``sec`` of one input.
    name : str
        Of that input.
    region : (float, float)
        Where u ranges; may be infinite.
    claim : (float, float), optional
        Bounds to prove or refute, as for `posmas_fmi.interval.bounds`.

    Returns
    -------
    Range

    Examples
    --------
    >>> from posmas_fmi.expression import parse
    >>> saturation = parse("clip(u1, -2, 2)", ["u1"])
    >>> r = sector_range(saturation, "u1", (-4.0, 4.0), claim=(0.5, 1.0))
    >>> round(r.low, 9), round(r.high, 9)
    (0.5, 1.0)
    """
    u = symbol(name)
    ratio = sympy.expand(expr / u)
    direct = bounds(ratio, {name: region}, claim)
    if math.isfinite(direct.low) and math.isfinite(direct.high):
        return direct
    if sympy.simplify(expr.subs(u, 0)) != 0:
        return direct
    low, high = region
    size = max(abs(low), abs(high))
    size = size if 0 < size < math.inf else 1.0  # inputs come in W as well as in units of 1
    near, far = size * 2.0**-6, size * 2.0**10
    pieces = [bounds(sympy.diff(expr, u), {name: (max(low, -near), min(high, near))}, claim)]
    edges = [-math.inf, -far, -near, near, far, math.inf]
    for a, b in pairwise(edges):
        a, b = max(a, low), min(b, high)
        if a < b and (a >= near or b <= -near):
            pieces.append(bounds(_divide(expr, u, positive=a > 0), {name: (a, b)}, claim))
    # the slope encloses the ratio near zero but is not attained by it: witnesses come from ratios
    witnesses = pieces[1:] or pieces
    least = min(witnesses, key=lambda r: r.least)
    most = max(witnesses, key=lambda r: r.most)
    return Range(
        min(r.low for r in pieces),
        max(r.high for r in pieces),
        least.least,
        most.most,
        least.argmin,
        most.argmax,
    )


def _divide(expr: sympy.Expr, u: sympy.Symbol, positive: bool) -> sympy.Expr:
    """``expr / u`` for u of one sign, divided inside sums, Min and Max so that u cancels there."""
    if expr.is_Add:
        return sympy.Add(*(_divide(arg, u, positive) for arg in expr.args))
    if expr.func in (sympy.Min, sympy.Max):
        turned = {sympy.Min: sympy.Max, sympy.Max: sympy.Min}
        function = expr.func if positive else turned[expr.func]
        return function(*(_divide(arg, u, positive) for arg in expr.args))
    return sympy.expand(expr / u)
