import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from posmas_fmi.expression import VectorFunction, parse, symbol
from posmas_fmi.interval import Interval, bounds, evaluate

EXPRESSIONS = [
    "x1*sin(0.31*x1*t)",
    "sin(x1*t) + 0.31*x1*t*cos(x1*t)",
    "x1**3 - 2*x1*t + t**2",
    "x1/(1 + x1) - t/(2 + t*t)",
    "abs(x1 - t) + min(x1, t) - max(x1, 2*t)",
    "exp(-x1)*log(1 + t)",
    "tanh(x1 - t)*cosh(0.1*t)",
    "sqrt(x1 + 1)*atan(t) + sign(x1 - 1)",
    "clip(x1, -0.5, 0.5) - sinh(0.2*t)",
    "tan(0.2*x1)",
]
finite = st.floats(-5, 5)


@pytest.mark.parametrize("text", EXPRESSIONS)
@given(data=st.data())
@settings(max_examples=60)
def test_enclosure_holds_every_value(text, data):
    names = ["t", "x1"]
    expr = parse(text, names)
    low = np.array([data.draw(st.floats(0, 5)) for _ in names])
    width = np.array([data.draw(st.floats(0, 3)) for _ in names])
    inside = low + width * np.array([data.draw(st.floats(0, 1)) for _ in names])
    box = {symbol(n): Interval.of(a, a + w) for n, a, w in zip(names, low, width, strict=True)}
    inside = np.minimum(inside, low + width)
    enclosure = evaluate(expr, box)
    value = VectorFunction((expr,), tuple(names)).numpy()(*inside)[0]
    # the value itself is rounded: it may be off by a few units in the last place
    slack = 1e-12 * (1 + abs(value))
    assert enclosure.low[0] - slack <= value <= enclosure.high[0] + slack


@given(a=finite, b=finite, c=finite, d=finite)
def test_products_and_quotients_enclose_exact_ends(a, b, c, d):
    from fractions import Fraction

    x, y = Interval.of(min(a, b), max(a, b)), Interval.of(min(c, d), max(c, d))
    product = x * y
    ends = [Fraction(u) * Fraction(v) for u in (a, b) for v in (c, d)]
    assert Fraction(product.low[0]) <= min(ends)
    assert max(ends) <= Fraction(product.high[0])
    if min(abs(c), abs(d)) > 1e-300 and c * d > 0:
        quotients = [1 / Fraction(v) for v in (c, d)]
        inverse = y.reciprocal()
        assert Fraction(inverse.low[0]) <= min(quotients)
        assert max(quotients) <= Fraction(inverse.high[0])


def test_reciprocal_over_zero_is_the_whole_line():
    inverse = Interval.of(-1.0, 1.0).reciprocal()
    assert inverse.low[0] == -math.inf
    assert inverse.high[0] == math.inf


def test_infinite_regions_are_allowed():
    r = bounds(parse("1.2 - 0.3*abs(sin(u1))", ["u1"]), {"u1": (-math.inf, math.inf)})
    assert r.low == pytest.approx(0.9, abs=1e-12)
    assert r.high == pytest.approx(1.2, abs=1e-12)


def test_bounds_of_the_papers_slope():
    """Erratum 9: the slope of g is far from the declared 1 on the region of Example 1."""
    slope = VectorFunction.parse(["x1*sin(0.31*x1*t)"], ["t", "x1"]).derivative(["x1"])
    r = bounds(slope.expressions[0], {"t": (0.0, 10.0), "x1": (0.0, 4.0)})
    assert r.high == pytest.approx(r.most, rel=2e-3)
    assert r.most > 12.0
    value = slope.numpy()(r.argmax["t"], r.argmax["x1"])[0]
    assert value == pytest.approx(r.most)


def test_a_claim_is_proved_where_the_plain_enclosure_would_stop_short():
    ratio = parse("tanh(u1)", ["u1"]) / symbol("u1")
    claimed = bounds(ratio, {"u1": (0.1, 3.0)}, claim=(0.0, 1.0))
    assert claimed.high <= 1.0


def test_a_false_claim_is_refuted_by_a_point():
    r = bounds(parse("x1*(1 - x1)", ["x1"]), {"x1": (0.0, 1.0)}, claim=(0.0, 0.2))
    x = r.argmax["x1"]
    assert x * (1 - x) > 0.2
