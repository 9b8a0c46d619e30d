import contextlib
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from posmas_fmi.errors import ExpressionError
from posmas_fmi.expression import VectorFunction, parse

HOSTILE = [
    "__import__('os')",
    "().__class__",
    "x1.real",
    "9**9**9",
    "2**-9**9",
    "lambda: 1",
    "[x1 for x1 in (1,)]",
    "(" * 500_000 + ")" * 500_000,
    "-" * 4000 + "1",
    "x1 if t else 2",
    "x1 := 3",
    "f'{x1}'",
    "exec('1')",
    "sin.__call__(x1)",
    "sin(x1, *[1])",
    "sin(x=x1)",
    "1e999",
    "1e308*1e308",
    "9" * 4000,
    "1/0",
    "0**-1",
    "log(0)",
    "exp(1000)",
    "sin(exp(exp(20)))",
    "4**14**1.2**4**14**1.2**1",  # found by fuzzing: it filled the memory
    "sqrt(-1)",
    "x1**x1",
    "(-2)**x1",
    "1j",
    "True",
    "'a'",
    "x1 x2",
    "x3",
    "x1\n+1",
    "\x00",
    "",
    "   ",
    "x1 @ x1",
    "x1 < 2",
    "not x1",
]


@pytest.mark.parametrize("text", HOSTILE, ids=lambda text: repr(text[:20]))
def test_what_is_not_in_the_language_is_refused_with_its_place(text):
    with pytest.raises(ExpressionError) as caught:
        parse(text, ["t", "x1", "x2"], "$.agent.g[0]")
    assert str(caught.value).startswith("$.agent.g[0]: ")
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize("value", [3, None, ["x1"]])
def test_what_is_not_text_is_refused(value):
    with pytest.raises(ExpressionError):
        parse(value, ["x1"])


@given(st.text(alphabet="x1t+-*/().,93e sincoab_'[]", max_size=40))
def test_any_text_gives_an_expression_or_the_typed_error(text):
    with contextlib.suppress(ExpressionError):
        parse(text, ["t", "x1"])


CASES = {
    "x1*sin(0.31*x1*t)": lambda t, x: x * math.sin(0.31 * x * t),
    "-x1**2 + 3/(1 + t)": lambda t, x: -(x**2) + 3 / (1 + t),
    "clip(x1, 0.5, 1.5)": lambda t, x: min(max(x, 0.5), 1.5),
    "min(x1, t, 1) + max(x1, t)": lambda t, x: min(x, t, 1) + max(x, t),
    "50**(x1 - 1)": lambda t, x: 50 ** (x - 1),
    "abs(sin(x1)) + sign(t - x1)": lambda t, x: abs(math.sin(x)) + np.sign(t - x),
    "exp(-x1)*log(1 + t) + sqrt(x1) + tanh(x1)": lambda t, x: (
        math.exp(-x) * math.log(1 + t) + math.sqrt(x) + math.tanh(x)
    ),
    "x1**0.5 + pi": lambda t, x: x**0.5 + math.pi,
}


@pytest.mark.parametrize("text", CASES)
@given(t=st.floats(0, 10), x=st.floats(0, 4))
def test_numpy_form_is_what_the_text_says(text, t, x):
    f = VectorFunction.parse([text], ["t", "x1"]).numpy()
    assert f(t, x)[0] == pytest.approx(CASES[text](t, x), rel=1e-12, abs=1e-12)


def test_numpy_form_runs_over_all_agents_at_once():
    f = VectorFunction.parse(["x1*t", "3"], ["t", "x1"]).numpy()
    values = f(2.0, np.array([1.0, 2.0, 3.0]))
    np.testing.assert_array_equal([[2, 3], [4, 3], [6, 3]], values)


@given(t=st.floats(0.1, 10), x=st.floats(0.1, 4))
def test_derivative_is_the_slope(t, x):
    text = "x1*sin(0.31*x1*t) + clip(x1, 0.5, 1.5) + abs(x1 - 2)"
    f = VectorFunction.parse([text], ["t", "x1"])
    slope, h = f.derivative(["x1"]).numpy()(t, x)[0], 1e-6
    if min(abs(x - kink) for kink in (0.5, 1.5, 2.0)) > 2 * h:
        difference = (f.numpy()(t, x + h)[0] - f.numpy()(t, x - h)[0]) / (2 * h)
        assert slope == pytest.approx(difference, rel=1e-5, abs=1e-5)


def test_decimals_are_taken_exactly():
    assert str(parse("0.1 + 0.2", [])) == "3/10"
