"""The FMU of model (1): x' = A x + H g(t, x) + B sec(u), y = C x."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import sympy

from posmas_fmi.errors import BuildError
from posmas_fmi.expression import VectorFunction
from posmas_fmi.fmu.model import Experiment, FmuModel, Variable

_TEMPLATE = Path(__file__).parent / "csrc" / "positive_agent.c"


def positive_agent(
    g: VectorFunction,
    sec: VectorFunction,
    m: int,
    p: int,
    q: int,
    *,
    start: Mapping[str, Sequence[float]] | None = None,
    experiment: Experiment | None = None,
    name: str = "positive_agent",
) -> FmuModel:
    """Generate the FMU model of an agent.

    Parameters
    ----------
    g : VectorFunction
        Of ``t, x1, …, xm`` with m components.
    sec : VectorFunction
        Of ``u1, …, up``; component k depends on ``uk`` only.
    m, p, q : int
        Numbers of states, inputs, outputs.
    start : mapping, optional
        Row-major start values of ``A, H, B, C, x``. Defaults: A = -I, H = 0, B = 1, C = I, x = 0.
    experiment : Experiment, optional
    name : str, optional

    Returns
    -------
    FmuModel
        Parameters A (m, m), H (m, m), B (m, p), C (q, m), inputs u (p), states x (m), outputs
        y (q).

    Raises
    ------
    BuildError
        If g or sec do not fit the sizes, or component k of sec depends on another input.

    Examples
    --------
    >>> g = VectorFunction.parse(["x1*sin(t)"], ["t", "x1"])
    >>> sec = VectorFunction.parse(["tanh(u1)"], ["u1"])
    >>> model = positive_agent(g, sec, 1, 1, 1)
    >>> [variable.name for variable in model.table]
    ['A', 'H', 'B', 'C', 'u', 'x', 'der(x)', 'y']
    """
    _check(g, sec, m, p, q)
    identity = [[float(i == j) for j in range(m)] for i in range(m)]
    given: dict[str, Sequence[float]] = {
        "A": [0.0 - e for row in identity for e in row],
        "H": [0.0] * (m * m),
        "B": [1.0] * (m * p),
        "C": [float(i == j) for i in range(q) for j in range(m)],
        "x": [0.0] * m,
        **(start or {}),
    }

    def value(key: str) -> tuple[float, ...]:
        return tuple(float(v) for v in given[key])

    variables = (
        Variable("A", "parameter", (m, m), value("A"), "1/s", "State matrix (Metzler)"),
        Variable("H", "parameter", (m, m), value("H"), "1/s", "Weights of g(t, x)"),
        Variable("B", "parameter", (m, p), value("B"), "1/s", "Input matrix (non-negative)"),
        Variable("C", "parameter", (q, m), value("C"), "1", "Output matrix"),
        Variable("u", "input", (p,), (0.0,) * p, "1", "Control input, before sec"),
        Variable("x", "state", (m,), value("x"), "1", "State"),
        Variable("y", "output", (q,), unit="1", description="Output C x", depends=("x",)),
    )
    code = {
        "model.c": _TEMPLATE.read_text(encoding="utf-8"),
        "agent_functions.h": functions_header(g, sec, m, p, q),
    }
    description = "Positive agent x' = A x + H g(t, x) + B sec(u), y = C x"
    return FmuModel(name, description, variables, code, experiment or Experiment())


def _names(letter: str, count: int) -> tuple[str, ...]:
    return tuple(f"{letter}{k + 1}" for k in range(count))


def _check(g: VectorFunction, sec: VectorFunction, m: int, p: int, q: int) -> None:
    if min(m, p, q) < 1:
        raise BuildError(f"expected at least one state, input and output (got {m}, {p}, {q})")
    wanted = (("g", g, m, ("t", *_names("x", m))), ("sec", sec, p, _names("u", p)))
    for name, function, count, variables in wanted:
        if len(function) != count or function.variables != variables:
            raise BuildError(
                f"expected {count} component(s) in {', '.join(variables)} (got {len(function)} in "
                f"{', '.join(function.variables)})",
                name,
            )
    for k, (component, own) in enumerate(zip(sec.expressions, sec.symbols, strict=True)):
        others = component.free_symbols - {own}
        if others:
            raise BuildError(f"component {k + 1} depends on {sorted(map(str, others))}", "sec")


def functions_header(
    g: VectorFunction, sec: VectorFunction, m: int, p: int, q: int, lanes: bool = False
) -> str:
    """Return ``agent_functions.h``: the sizes M, P, Q, g and sec in C, and their slopes.

    With `lanes` g and sec are those of many agents at once, for the engine, without slopes.

    Raises
    ------
    BuildError
        If g or sec do not fit the sizes, or component k of sec depends on another input.
    """
    _check(g, sec, m, p, q)
    if lanes:
        return _lanes_header(g, sec, m, p, q)
    states = {"t": "t"} | {f"x{k + 1}": f"x[{k}]" for k in range(m)}
    inputs = {f"u{k + 1}": f"u[{k}]" for k in range(p)}
    own_slopes = tuple(
        sympy.diff(component, own)
        for component, own in zip(sec.expressions, sec.symbols, strict=True)
    )
    parts = [
        ("agent_g", "double t, const double *x", ("t", "x"), "g", g, states),
        (
            "agent_g_slope",
            "double t, const double *x",
            ("t", "x"),
            "slope",
            _almost_everywhere(g.derivative(_names("x", m))),
            states,
        ),
        ("agent_sec", "const double *u", ("u",), "sec", sec, inputs),
        (
            "agent_sec_slope",
            "const double *u",
            ("u",),
            "slope",
            _almost_everywhere(VectorFunction(own_slopes, sec.variables)),
            inputs,
        ),
    ]
    lines = [
        "/* g and sec of model (1) and their slopes, generated from the agent's expressions. */",
        "#ifndef AGENT_FUNCTIONS_H",
        "#define AGENT_FUNCTIONS_H",
        "",
        "#include <math.h>",
        "",
        f"enum {{ M = {m}, P = {p}, Q = {q} }};",
    ]
    for name, arguments, unused, target, function, names in parts:
        body = function.c_code(target, names).splitlines()
        lines += ["", f"static void {name}({arguments}, double *{target})", "{"]
        lines += [f"    (void){argument};" for argument in unused]
        lines += [f"    {line}" for line in body] + ["}"]
    return "\n".join([*lines, "", "#endif", ""])


def _lanes_header(g: VectorFunction, sec: VectorFunction, m: int, p: int, q: int) -> str:
    states = {"t": "t"} | {f"x{k + 1}": f"x[{k}]" for k in range(m)}
    inputs = {f"u{k + 1}": f"u[{k}]" for k in range(p)}
    lines = [
        "/* g and sec of model (1) for the agents of all lanes, generated from the expressions. */",
        "#ifndef AGENT_FUNCTIONS_H",
        "#define AGENT_FUNCTIONS_H",
        "",
        f"enum {{ M = {m}, P = {p}, Q = {q} }};",
        "",
        "#ifdef LANES",
        '#include "lanes.h"',
    ]
    for name, arguments, unused, target, function, names in (
        ("agent_g", "Lanes t, const Lanes *x", ("t", "x"), "g", g, states),
        ("agent_sec", "const Lanes *u", ("u",), "sec", sec, inputs),
    ):
        head = f"LANES_INLINE void {name}({arguments}, Lanes *{target}, LanesRange *range)"
        lines += ["", head, "{"]
        lines += [f"    (void){argument};" for argument in (*unused, "range")]
        lines += [f"    {line}" for line in function.c_code(target, names, True).splitlines()]
        lines += ["}"]
    return "\n".join([*lines, "#endif", "", "#endif", ""])


def _almost_everywhere(function: VectorFunction) -> VectorFunction:
    """Take the derivative of a jump as 0: there is none at the jump itself."""
    smooth = tuple(
        e.replace(sympy.DiracDelta, lambda *_: sympy.Integer(0)) for e in function.expressions
    )
    return VectorFunction(smooth, function.variables)
