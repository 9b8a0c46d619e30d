"""Expressions for g and sec: parsed by a whitelist, held symbolically, turned into numpy and C."""

from __future__ import annotations

import ast
import math
from collections.abc import Callable, Sequence
from typing import Any

import attrs
import numpy as np
import sympy
from sympy.printing.c import C99CodePrinter
from sympy.printing.numpy import NumPyPrinter

from posmas_fmi.errors import ExpressionError

MAX_LENGTH = 4096
MAX_PARENTHESES = 64
MAX_DEPTH = 200  # of the syntax tree: a sum of n terms is n deep
MAX_NODES = 2000
MAX_EXPONENT = 64
MAX_CHOICES = 20  # of one min or max: its slope takes the cube of them
MAX_EXPANDED = 5000  # terms when all is multiplied out

Array = np.ndarray[Any, np.dtype[np.float64]]

_FUNCTIONS: dict[str, tuple[int, Callable[..., sympy.Expr]]] = {
    # name: (number of arguments, -1 for two or more; how to build it)
    "sin": (1, sympy.sin),
    "cos": (1, sympy.cos),
    "tan": (1, sympy.tan),
    "atan": (1, sympy.atan),
    "exp": (1, sympy.exp),
    "log": (1, sympy.log),
    "sqrt": (1, sympy.sqrt),
    "tanh": (1, sympy.tanh),
    "sinh": (1, sympy.sinh),
    "cosh": (1, sympy.cosh),
    "abs": (1, sympy.Abs),
    "sign": (1, sympy.sign),
    "min": (-1, sympy.Min),
    "max": (-1, sympy.Max),
    "clip": (3, lambda x, low, high: sympy.Min(sympy.Max(x, low), high)),
}
_CONSTANTS: dict[str, sympy.Expr] = {"pi": sympy.pi}
LANGUAGE = (
    "numbers, the listed variables, + - * / **, parentheses, pi and the functions "
    + ", ".join(_FUNCTIONS)
)


def symbol(name: str) -> sympy.Symbol:
    """Real symbol of that name: the one way in which this package makes symbols."""
    return sympy.Symbol(name, real=True)


def parse(text: str, variables: Sequence[str], where: str = "") -> sympy.Expr:
    """Turn text into a SymPy expression without ever evaluating it as Python.

    Parameters
    ----------
    text : str
        For example ``"x1*sin(0.31*x1*t)"``; decimals are taken exactly.
    variables : sequence of str
        The names that may occur.
    where : str, optional
        Place to name in an error.

    Returns
    -------
    sympy.Expr

    Raises
    ------
    ExpressionError
        If the text is not in the language, is too long or too deep.

    Examples
    --------
    >>> parse("x1*sin(0.31*x1*t)", ["t", "x1"])
    x1*sin(31*t*x1/100)
    >>> parse("__import__('os')", ["t", "x1"])
    Traceback (most recent call last):
        ...
    posmas_fmi.errors.ExpressionError: '__import__' is not a function of this language ...
    """
    if not isinstance(text, str):
        raise ExpressionError(f"expected an expression as text (got {text!r})", where)
    if len(text) > MAX_LENGTH:
        raise ExpressionError(
            f"expected at most {MAX_LENGTH} characters (got {len(text)}); split the expression",
            where,
        )
    if not text.strip():
        raise ExpressionError("expected an expression (got empty text); write 0 for none", where)
    if _nesting(text) > MAX_PARENTHESES:
        raise ExpressionError(f"parentheses are nested deeper than {MAX_PARENTHESES}", where)
    try:
        tree = ast.parse(text.strip(), mode="eval")
    except (SyntaxError, ValueError, MemoryError, RecursionError) as error:
        reason = error.msg if isinstance(error, SyntaxError) else str(error)
        raise ExpressionError(f"cannot read {_shorten(text)!r}: {reason}", where) from None
    if sum(1 for _ in ast.walk(tree)) > MAX_NODES:
        raise ExpressionError(f"expected at most {MAX_NODES} terms; split the expression", where)
    try:
        made = _Builder(tuple(variables), text, where).build(tree.body, 0)
        if _expanded(made) > MAX_EXPANDED:
            raise ExpressionError(
                f"multiplied out it has more than {MAX_EXPANDED} terms; take lower powers of "
                f"sums; in {_shorten(text)!r}",
                where,
            )
        return made
    except (MemoryError, RecursionError, ArithmeticError, TypeError, ValueError) as error:
        reason = f"it cannot be worked out ({type(error).__name__})"
        raise ExpressionError(f"cannot read {_shorten(text)!r}: {reason}", where) from error


def _nesting(text: str) -> int:
    depth = deepest = 0
    for character in text:
        depth += (character in "([{") - (character in ")]}")
        deepest = max(deepest, depth)
    return deepest


def _expanded(expr: sympy.Expr) -> int:
    """Bound on the number of terms after `sympy.expand`, of the expression or a part of it."""
    if not expr.args:
        return 1
    inside = [_expanded(arg) for arg in expr.args]
    if expr.is_Add:
        return sum(inside)
    if expr.is_Mul:
        return max(inside) if max(inside) > MAX_EXPANDED else math.prod(inside)
    if expr.is_Pow and expr.exp.is_Rational and 1 < inside[0] <= MAX_EXPANDED:
        power = math.ceil(abs(expr.exp))
        return math.comb(inside[0] + power - 1, power)
    return max(inside)


def _shorten(text: str, length: int = 60) -> str:
    return text if len(text) <= length else text[: length - 3] + "..."


@attrs.frozen
class _Builder:
    """One walk over a Python syntax tree; only what is named here gets through."""

    variables: tuple[str, ...]
    text: str
    where: str

    def build(self, node: ast.expr, depth: int) -> sympy.Expr:
        if depth > MAX_DEPTH:
            raise ExpressionError(f"the expression is nested deeper than {MAX_DEPTH}", self.where)
        match node:
            case ast.Constant(value=value):
                return self.number(node, value)
            case ast.Name(id=name):
                return self.name(name)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return -self.build(operand, depth + 1)
            case ast.UnaryOp(op=ast.UAdd(), operand=operand):
                return self.build(operand, depth + 1)
            case ast.BinOp(left=left, op=op, right=right):
                a, b = self.build(left, depth + 1), self.build(right, depth + 1)
                return self.finite(self.binary(a, op, b))
            case ast.Call(func=ast.Name(id=name), args=args, keywords=[]):
                return self.finite(self.call(name, args, depth))
            case ast.Call(func=ast.Name(id=name)):
                raise self.refuse(f"{name!r} takes no named arguments")
            case _:
                raise self.refuse(f"{type(node).__name__} is not part of this language")

    def number(self, node: ast.Constant, value: object) -> sympy.Expr:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.refuse(f"{_shorten(repr(value))} is not a number")
        if not math.isfinite(_as_float(value)):
            raise self.refuse(f"{_shorten(ast.unparse(node))} is too large for a double")
        return sympy.Rational(repr(value))

    def name(self, name: str) -> sympy.Expr:
        if name in self.variables:
            return symbol(name)
        if name in _CONSTANTS:
            return _CONSTANTS[name]
        raise self.refuse(f"unknown name {name!r}; variables here: {', '.join(self.variables)}")

    def binary(self, a: sympy.Expr, op: ast.operator, b: sympy.Expr) -> sympy.Expr:
        match op:
            case ast.Add():
                return a + b
            case ast.Sub():
                return a - b
            case ast.Mult():
                return a * b
            case ast.Div():
                if b.is_zero:
                    raise self.refuse("division by zero")
                return a / b
            case ast.Pow():
                return self.power(a, b)
            case _:
                raise self.refuse(f"the operator {type(op).__name__} is not part of this language")

    def power(self, base: sympy.Expr, exponent: sympy.Expr) -> sympy.Expr:
        if exponent.is_Rational:
            if abs(exponent) > MAX_EXPONENT:
                raise self.refuse(
                    f"the exponent {_shorten(str(exponent))} is beyond {MAX_EXPONENT}"
                )
            if base.is_zero and exponent < 0:
                raise self.refuse("division by zero")
            return base**exponent
        if base.is_number and base.is_positive:
            return sympy.exp(exponent * sympy.log(base))
        raise self.refuse("a power needs a constant exponent or a positive constant base")

    def call(self, name: str, args: Sequence[ast.expr], depth: int) -> sympy.Expr:
        if name not in _FUNCTIONS:
            raise self.refuse(f"{name!r} is not a function of this language ({LANGUAGE})")
        count, make = _FUNCTIONS[name]
        if len(args) != count and not (count == -1 and len(args) >= 2):
            wanted = "two or more" if count == -1 else str(count)
            raise self.refuse(f"{name} takes {wanted} argument(s) (got {len(args)})")
        made = make(*(self.build(arg, depth + 1) for arg in args))
        if isinstance(made, sympy.Min | sympy.Max) and len(made.args) > MAX_CHOICES:
            raise self.refuse(f"expected at most {MAX_CHOICES} arguments of one {name}")
        return made

    def finite(self, expr: sympy.Expr) -> sympy.Expr:
        if expr.has(sympy.nan, sympy.zoo, sympy.oo, -sympy.oo):
            raise self.refuse("the expression has no finite value")
        if not expr.is_number:
            return expr
        # before SymPy is asked more: exact answers about huge numbers fill the memory
        if not math.isfinite(_as_float(expr)):
            raise self.refuse("a constant is too large for a double")
        if not expr.is_real:
            raise self.refuse("the expression is not real")
        return expr

    def refuse(self, reason: str) -> ExpressionError:
        return ExpressionError(f"{reason}; in {_shorten(self.text)!r}", self.where)


def _as_float(value: Any) -> float:
    try:
        return float(value)
    except OverflowError:
        return math.inf
    except TypeError:  # a complex number
        return 0.0


def _nested(function: str, args: list[str]) -> str:
    """``f(a, f(b, c))`` for a function of two arguments."""
    return args[0] if len(args) == 1 else f"{function}({args[0]}, {_nested(function, args[1:])})"


class _ExactNumpy(NumPyPrinter):
    """NumPy code with each rational as the nearest double, as `_ExactC` prints it."""

    def _print_Rational(self, expr: sympy.Rational) -> str:
        return repr(float(expr))

    def _print_Heaviside(self, expr: sympy.Expr) -> str:
        return f"numpy.heaviside({self._print(expr.args[0])}, 0.5)"

    def _print_Min(self, expr: sympy.Expr) -> str:
        return _nested("numpy.minimum", [self._print(arg) for arg in expr.args])

    def _print_Max(self, expr: sympy.Expr) -> str:
        return _nested("numpy.maximum", [self._print(arg) for arg in expr.args])


class _ExactC(C99CodePrinter):
    """C code with each rational as the nearest double, only what math.h has by the standard."""

    def __init__(self) -> None:
        super().__init__({"math_macros": {}})  # M_SQRT2 and the like are no standard C

    def _print_Rational(self, expr: sympy.Rational) -> str:
        return repr(float(expr))

    _print_Integer = _print_Rational
    _print_Half = _print_Rational

    def _print_Pow(self, expr: sympy.Pow) -> str:
        base, exponent = expr.args
        if exponent.is_Integer and 2 <= exponent <= 4:
            return "(" + "*".join([f"({self._print(base)})"] * int(exponent)) + ")"
        return str(super()._print_Pow(expr))

    def _print_Pi(self, expr: sympy.Expr) -> str:
        return repr(math.pi)

    def _print_Exp1(self, expr: sympy.Expr) -> str:
        return repr(math.e)

    def _print_sign(self, expr: sympy.Expr) -> str:
        x = self._print(expr.args[0])
        return f"((({x}) > 0) - (({x}) < 0))"

    def _print_Heaviside(self, expr: sympy.Expr) -> str:
        x = self._print(expr.args[0])
        return f"(0.5*((({x}) > 0) - (({x}) < 0)) + 0.5)"


class _LanesC(_ExactC):
    """C code for many values at once: the types and functions of cosim/csrc/lanes.h."""

    _RANGED = ("sin", "cos", "exp")  # of lanes.h, with a range; others go to math.h one by one

    def lanes(self, expr: sympy.Expr) -> str:
        """Print an expression, as lanes also where it is a number."""
        code = str(self._print(expr))
        return code if expr.free_symbols else f"lanes_of({code})"

    def _print_Function(self, expr: sympy.Expr) -> str:
        name, args = expr.func.__name__, expr.args
        if not expr.free_symbols:
            return repr(float(expr))
        if name in self._RANGED:
            return f"lanes_{name}({self._print(args[0])}, range)"
        if name == "tanh":
            return f"lanes_tanh({self._print(args[0])})"
        return f"lanes_each({name}, {self._print(args[0])})"

    _print_sin = _print_cos = _print_exp = _print_tanh = _print_Function
    _print_tan = _print_atan = _print_log = _print_sinh = _print_cosh = _print_Function

    def _print_Abs(self, expr: sympy.Expr) -> str:
        if not expr.free_symbols:
            return repr(float(expr))
        return f"lanes_abs({self._print(expr.args[0])})"

    def _print_sign(self, expr: sympy.Expr) -> str:
        if not expr.free_symbols:
            return repr(float(expr))
        return f"lanes_sign({self._print(expr.args[0])})"

    def _print_Min(self, expr: sympy.Expr) -> str:
        if not expr.free_symbols:
            return repr(float(expr))
        return _nested("lanes_min", [self.lanes(arg) for arg in expr.args])

    def _print_Max(self, expr: sympy.Expr) -> str:
        if not expr.free_symbols:
            return repr(float(expr))
        return _nested("lanes_max", [self.lanes(arg) for arg in expr.args])

    def _print_Pow(self, expr: sympy.Pow) -> str:
        base, exponent = expr.args
        if not expr.free_symbols:
            return repr(float(expr))
        if exponent == sympy.Rational(1, 2):
            return f"lanes_sqrt({self._print(base)})"
        if exponent.is_Integer and (exponent == -1 or 2 <= exponent <= 4):
            return str(super()._print_Pow(expr))
        return f"lanes_pow({self.lanes(base)}, {self.lanes(exponent)})"


@attrs.frozen
class VectorFunction:
    """Expressions in common variables: one function in every form that this project needs.

    Parameters
    ----------
    expressions : tuple of sympy.Expr
        The components.
    variables : tuple of str
        Names in the order in which values are given.

    Examples
    --------
    >>> g = VectorFunction.parse(["x1*sin(t)", "x2"], ["t", "x1", "x2"])
    >>> g.numpy()(0.5, 2.0, 3.0)
    array([0.95885108, 3.        ])
    >>> print(g.c_code("g", {"t": "time", "x1": "x[0]", "x2": "x[1]"}))
    g[0] = x[0]*sin(time);
    g[1] = x[1];
    """

    expressions: tuple[sympy.Expr, ...]
    variables: tuple[str, ...]

    @classmethod
    def parse(
        cls, texts: Sequence[str], variables: Sequence[str], where: str = ""
    ) -> VectorFunction:
        """Parse one text per component; errors name ``where[k]``."""
        parsed = (parse(text, variables, f"{where}[{k}]") for k, text in enumerate(texts))
        return cls(tuple(parsed), tuple(variables))

    def __len__(self) -> int:
        return len(self.expressions)

    @property
    def symbols(self) -> tuple[sympy.Symbol, ...]:
        """The variables as symbols, in order."""
        return tuple(symbol(name) for name in self.variables)

    def derivative(self, variables: Sequence[str]) -> VectorFunction:
        """Row-major Jacobian with respect to `variables`, len(self)*len(variables) components."""
        rows = (sympy.diff(e, symbol(v)) for e in self.expressions for v in variables)
        return VectorFunction(tuple(rows), self.variables)

    def numpy(self) -> Callable[..., Array]:
        """Return a function of scalars or equal-shape arrays, stacking components on the last axis.

        Returns
        -------
        callable
            ``f(*values)`` with values of shape ``(...)`` gives shape ``(..., len(self))``. With
            ``out`` of shape ``(len(self), ...)`` it writes there, components on the first axis.
        """
        code = sympy.lambdify(
            self.symbols, list(self.expressions), "numpy", printer=_ExactNumpy, cse=True
        )

        def evaluate(*values: Any, out: Array | None = None) -> Array:
            # each component in one piece, seen with the components on the last axis
            if out is None:
                out = np.empty((len(self.expressions), *np.broadcast(*values).shape))
            for k, component in enumerate(code(*values)):
                out[k] = component
            return out if out.ndim == 1 else out.transpose(*range(1, out.ndim), 0)

        return evaluate

    def c_code(self, target: str, names: dict[str, str], lanes: bool = False) -> str:
        """Return C statements that assign the components to ``target[k]``.

        Parameters
        ----------
        target : str
            Name of a C array of doubles.
        names : dict
            C expression for each variable.
        lanes : bool
            For many values at once: ``Lanes`` of cosim/csrc/lanes.h instead of ``double``, with a
            ``LanesRange *range`` in scope.
        """
        printer = _LanesC() if lanes else _ExactC()
        put = printer.lanes if isinstance(printer, _LanesC) else printer.doprint
        kind = "Lanes" if lanes else "double"
        place = {symbol(v): sympy.Symbol(c) for v, c in names.items()}
        shared, reduced = sympy.cse(
            list(self.expressions), symbols=sympy.numbered_symbols(f"{target}_"), order="none"
        )
        lines = [f"const {kind} {s} = {put(e.xreplace(place))};" for s, e in shared]
        lines += [f"{target}[{k}] = {put(e.xreplace(place))};" for k, e in enumerate(reduced)]
        return "\n".join(lines)
