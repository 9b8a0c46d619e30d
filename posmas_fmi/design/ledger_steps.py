"""Ledger: what the paper prints before its designs (norms, spectra, sector, steps 1 and 2)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from fractions import Fraction
from typing import Any

import numpy as np
import sympy

from posmas_fmi.certify.proof import exactly_positive, identity, rational
from posmas_fmi.design.ledger_entry import Entry, agrees, show
from posmas_fmi.design.paper_examples import Example
from posmas_fmi.expression import Array

_HALF = Fraction(1, 20000)  # half a unit of the fourth digit, the last that is printed
_RADIUS = Fraction(1, 10**6)  # within which the solution of (14) is proved


def riccati(example: Example) -> Array:
    """Smallest solution P of (14)."""
    import scipy.linalg

    F = np.array(example.A) - np.array(example.E0) @ np.array(example.C)
    bound = (example.beta * np.linalg.norm(example.H, 2)) ** 2
    m = len(F)
    hamiltonian = np.block([[F, bound * np.eye(m)], [-(1 + example.delta) * np.eye(m), -F.T]])
    _, U, stable = scipy.linalg.schur(hamiltonian, sort="lhp")
    if stable != m:
        raise ArithmeticError("(14) has no stabilising solution")
    P = np.linalg.solve(U[:m, :m].T, U[m:, :m].T).T
    return np.asarray(0.5 * (P + P.T))


def residual(example: Example, P: Any) -> Any:
    """``FᵀP + PF + (β‖H‖)²PP + I`` with a rational upper bound of ‖H‖."""
    F = _observer(example)
    return F.T @ P + P @ F + _squared_norm(example) * (P @ P) + identity(len(F))


def _observer(example: Example) -> Any:
    """``F = A - E₀C`` exactly."""
    return rational(example.A) - rational(example.E0) @ rational(example.C)


def _squared_norm(example: Example) -> Fraction:
    """``‖H‖²``, rounded up to nine digits."""
    return Fraction(math.ceil(1e9 * float(np.linalg.norm(example.H, 2)) ** 2 + 1), 10**9)


def solution_of_14(example: Example) -> tuple[Any, bool]:
    """P of (14) to nine digits, and whether it is proved that a solution lies within 1e-6 of it.

    Newton and Kantorovich in rational numbers: with R the residual, J its derivative at P and Y
    close to J⁻¹, a box of radius r around P holds exactly one solution if
    ``‖Y R‖ + ‖I - Y J‖ r + ‖Y‖ 2 n b r² ≤ r`` in the largest entry, b = ‖H‖². A - E₀C + bP is then
    seen to be Hurwitz, by trace and determinant.
    """
    P = rational(np.round(riccati(example), 9))
    F, b, n = _observer(example), _squared_norm(example), len(P)
    off = residual(example, P) + Fraction(repr(example.delta)) * identity(n)
    one = identity(n)
    J = np.kron(one, (F + b * P).T) + np.kron((F + b * P).T, one)
    Y = rational(np.round(np.linalg.inv(J.astype(float)), 12))
    r, up = _RADIUS, 2 * Fraction(1, 10**9)  # up: what ‖H‖² is rounded up by, at most
    slack = up * (max(abs((P @ P).ravel())) + 2 * n * max(abs(P.ravel())) * r)
    size = max(abs(Y).sum(axis=1))
    error = max(abs(Y @ off.ravel())) + size * slack
    defect = max(abs(identity(n * n) - Y @ J).sum(axis=1))
    one_solution = error + defect * r + size * 2 * n * b * r**2 <= r
    closed = F + b * P
    trace, determinant = closed[0, 0] + closed[1, 1], closed[0, 0] * closed[1, 1]
    determinant -= closed[0, 1] * closed[1, 0]
    return P, bool(one_solution and trace < -1 and determinant > 1)


def changes_sign(polynomial: sympy.Poly, at: float) -> bool:
    """Whether a root lies within half a printed digit of a number: exact, by a change of sign."""
    low, high = (Fraction(repr(at)) + side * _HALF for side in (-1, 1))
    ends = [polynomial.eval(sympy.Rational(x.numerator, x.denominator)) for x in (low, high)]
    return bool(ends[0] * ends[1] < 0)


def steps(example: Example) -> Iterator[Entry]:
    """Entries of one example, in the order in which it prints them."""
    yield _spectrum(example)
    yield _norm(example)
    yield _sector(example)
    yield from _steps_1_and_2(example)


def _norm(ex: Example) -> Entry:
    H = rational(ex.H)
    trace = sum(x * x for x in H.ravel())
    determinant = H[0, 0] * H[1, 1] - H[0, 1] * H[1, 0]
    x = sympy.Symbol("x")
    squares = [sympy.Rational(y.numerator, y.denominator) for y in (trace, determinant**2)]
    polynomial = sympy.Poly(x**4 - squares[0] * x**2 + squares[1], x)
    held = changes_sign(polynomial, ex.norm_H)
    return Entry(
        ex.name,
        "||H||",
        show(ex.norm_H),
        show(float(np.linalg.norm(ex.H, 2)), 6),
        "reproduced" if held else "contradicted",
        f"x^4 - {float(trace):.6g} x^2 + {float(determinant**2):.6g} (tr(H^T H) and det(H)^2, "
        "taken exactly) changes sign within half a digit of the printed value",
    )


def _spectrum(ex: Example) -> Entry:
    L = ex.network(1).laplacian.toarray()
    x = sympy.Symbol("x")
    polynomial = sympy.Matrix(L.astype(int)).charpoly(x)
    whole = sympy.Poly(polynomial.as_expr(), x)
    spectrum = np.sort_complex(np.linalg.eigvals(L))
    real = [z.real for z in map(complex, ex.spectrum) if z.imag == 0]
    others = np.array([z for z in ex.spectrum if complex(z).imag != 0])
    near = all(np.abs(spectrum - z).min() <= float(_HALF) for z in others)
    held = near and all(whole.eval(0) == 0 if z == 0 else changes_sign(whole, z) for z in real)
    return Entry(
        ex.name,
        "spectrum of L (which recovers the digraph that the figure shows)",
        show(np.asarray(ex.spectrum)),
        show(np.round(spectrum.real if not len(others) else spectrum, 6) + 0.0),
        "reproduced" if held else "contradicted",
        f"arcs {list(ex.arcs)}; node labels stay unknown. Characteristic polynomial "
        f"{str(sympy.factor(whole.as_expr())).replace('**', '^')}; it changes sign within half a "
        "digit of every printed real eigenvalue, exactly",
    )


def _sector(ex: Example) -> Entry:
    bound = ex.agent().sector_bound
    assert bound is not None
    low, high = ex.sector
    held = abs(bound[0].low - low) < 1e-6 and abs(bound[0].high - high) < 1e-6
    return Entry(
        ex.name,
        "m_l and m_h of sec(u) = 1.2 u - 0.3 u |sin u|",
        f"{low:g}, {high:g}",
        f"{bound[0].low:.6g}, {bound[0].high:.6g}",
        "reproduced" if held else "contradicted",
        "sec(u)/u = 1.2 - 0.3 |sin u| with 0 <= |sin u| <= 1; at u = pi/2 it is 0.9, at u = pi 1.2",
    )


def _steps_1_and_2(ex: Example) -> Iterator[Entry]:
    printed_P = rational(ex.P)
    left = residual(ex, printed_P)
    proved = exactly_positive(-left) and exactly_positive(printed_P)
    F = np.array(_observer(ex), dtype=float)
    yield Entry(
        ex.name,
        "E_0 satisfies (13)",
        f"sigma_min(A - E_0 C - jwI) > {float(np.linalg.norm(ex.H, 2)):.4f}",
        f"A - E_0 C = {show(F)}",
        "reproduced" if proved else "contradicted",
        "bounded real lemma: the printed P > 0 makes the left side of (14) without delta negative "
        "definite, by exact rational LDL^T",
    )
    P, one_solution = solution_of_14(ex)
    found = np.array(P, dtype=float)
    agree = agrees(ex.P, found, 4)
    yield Entry(
        ex.name,
        "P of (14)",
        show(ex.P),
        show(found, 5),
        "reproduced" if agree and one_solution else "contradicted",
        ("exactly one solution lies within 1e-6 of" if one_solution else "not proved to be near")
        + f" {show(found, 9)}, the one with A - E_0 C + (beta ||H||)^2 P stable: "
        "Newton-Kantorovich in rational arithmetic"
        + ("" if agree else "; the printed P_22 is the one of Example 1"),
    )
    sigma = np.array(left, dtype=float)
    yield Entry(
        ex.name,
        "Sigma",
        show(ex.Sigma),
        f"{show(sigma, 5)} from the printed P; {-ex.delta:g} I from the exact P",
        "rounded" if agrees(ex.Sigma, sigma, 4) else "contradicted",
        "(14) makes Sigma = -delta I exactly; the printed matrix is the residual of the printed P",
    )
