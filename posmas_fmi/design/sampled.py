"""Quadratic proofs of the sampled loop: a small program finds P, rational arithmetic judges it."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np

from posmas_fmi.certify.certificate import Condition
from posmas_fmi.certify.loop import Loop
from posmas_fmi.certify.proof import rational
from posmas_fmi.certify.quadratic import (
    GraphScalar,
    SampledProof,
    Step,
    prove_observer,
    prove_sampled,
    step_of,
)
from posmas_fmi.design.rounding import nearest
from posmas_fmi.design.solver import cvxpy, solve
from posmas_fmi.errors import DesignError
from posmas_fmi.expression import Array

_RATES = (0.95, 0.8, 0.5, 0.2, 0.05)  # of the continuous rate; tried from the fastest
_SHARES = (0.03, 0.15, 0.4)  # of the graph scalar, given to what P's own gain differs by


def sampled_feedback(
    loop: Loop,
    gain: Array,
    V: Array,
    graph: GraphScalar,
    rate: float,
    C_z: Array | None = None,
) -> SampledProof | None:
    """Prove the sampled loop with a given gain; None where no proof was found.

    Parameters
    ----------
    loop : Loop
        With a period.
    gain : (p, n) array of Fraction or float
        As it ships, coupling included.
    V : (n, n) array
        Of the continuous proof: where the search is scaled.
    graph : GraphScalar
    rate : float
        Of the continuous proof [1/s].
    C_z : (k, m) array, optional
        What is integrated.
    """
    step, h = step_of(loop, C_z), loop.period
    assert h is not None
    if step is None or rate <= 0:
        return None
    exact = rational(gain)
    gain = np.array(exact, dtype=float)
    for share_of_rate in _RATES:
        factor = math.exp(-share_of_rate * rate * h)
        gap = 1 - factor**2
        for eta in (1e-3 * gap,) if step.loose < 1e-9 * gap else (0.1 * gap, 0.3 * gap):
            for share in _SHARES:
                P = _search(step, gain, V, graph, factor, eta, share, h)
                if P is None:
                    continue
                found = prove_sampled(step, exact, P, graph, factor, eta, share)
                if found is not None:
                    return found
    return None


def _search(
    step: Step,
    gain: Array,
    V: Array,
    graph: GraphScalar,
    factor: float,
    eta: float,
    share: float,
    h: float,
) -> Array | None:
    """P with the largest slack, in coordinates in which V is the identity, times h."""
    cp = cvxpy()
    S = np.linalg.cholesky(V).T
    back = np.linalg.inv(S)
    A, B, K = S @ step.A @ back, S @ step.B, gain @ back
    n, p = B.shape
    J = back[: step.m].T @ back[: step.m]
    gamma, cost = graph.left(share)
    P = cp.Variable((n, n), symmetric=True)
    b_bar, p_bar, slack = cp.Variable(pos=True), cp.Variable(pos=True), cp.Variable()
    one = 1 + eta
    paid = 2 * (1 + 1 / eta) * graph.spread * p_bar
    weight = h * gamma - graph.reach * (one * b_bar + paid * step.loose_input**2)
    off = h * K + one * B.T @ P @ A
    top = factor**2 * P - one * A.T @ P @ A + weight * (K.T @ K) - paid * step.loose**2 * J
    # h c |off/h|² = |off sqrt(c/h)|²
    size = math.sqrt(cost / h)
    block = cp.bmat([[top, size * off.T], [size * off, np.eye(p)]])
    limits = [
        block >> slack * np.eye(n + p),
        b_bar * np.eye(p) >> B.T @ P @ B,
        p_bar * np.eye(n) >> S.T @ P @ S,
        P >> 1e-6 * np.eye(n),
        P << 1e6 * np.eye(n),
        slack <= 1,
    ]
    if graph.kind == "symmetric":
        limits.append(weight >= 0)
    program = cp.Problem(cp.Maximize(slack), limits)
    try:
        if not solve(program, "sampled loop") or P.value is None or slack.value <= 0:
            return None
    except DesignError:
        return None
    found = S.T @ P.value @ S / h
    return nearest(0.5 * (found + found.T), 12, relative_zero=0.0)


def sampled_condition(name: str, proof: SampledProof, h: float) -> Condition:
    """State a quadratic proof of the sampled loop."""
    rate = -math.log(proof.factor) / h
    return Condition.from_margin(
        name,
        proof.proof.bound,
        f"r = {proof.factor:.9g} per period of {h:g} s (rate >= {rate:.6g} 1/s): {proof.proof}",
    )


def sampled_observer(loop: Loop) -> SampledProof | None:
    """Prove the sampled local observer with the best of a few rates; None where none is found."""
    assert loop.period is not None
    if loop.observer != "local":
        return None
    F = loop.agent.A - loop.E @ loop.agent.C
    fastest = -float(np.linalg.eigvals(F).real.max())
    for share in (0.9, 0.7, 0.5, 0.3, 0.1):
        found = prove_observer(loop, math.exp(-share * max(fastest, 0.0) * loop.period))
        if found is not None:
            return found
    return None


def sampled_gain(
    step: Step, graph: GraphScalar, factor: float, phi: float, m: int, digits: int
) -> tuple[Array, SampledProof] | None:
    """Gain with r per period, rounded and proved; None where there is none.

    With ``Q = P⁻¹`` and ``K = -BᵀPA`` the inequality of `sampled_matrix` follows from
    ``AQAᵀ ≺ r²(Q + cBBᵀ)`` with ``BᵀQ⁻¹B ⪯ I`` and ``c ≤ γ²/4g``, which is linear; P is scaled so
    that the network bears the most.

    Parameters
    ----------
    step : Step
    graph : GraphScalar
    factor : float
        Wanted r.
    phi : float
        Coupling that the first `m` columns of the gain are divided by when they are rounded.
    m, digits : int
    """
    cp = cvxpy()
    A, B = step.A, step.B
    n, p = B.shape
    size = np.array([1.0] * n)
    for _ in range(20):  # coordinates in which A is balanced
        rows = np.abs(A / size[:, None] * size[None, :]).sum(axis=1)
        columns = np.abs(A / size[:, None] * size[None, :]).sum(axis=0)
        size = size * np.sqrt(np.maximum(rows, 1e-12) / np.maximum(columns, 1e-12))
    A, B = A / size[:, None] * size[None, :], B / size[:, None]
    unit = float(np.abs(B).max()) or 1.0
    B = B / unit
    Q, c = cp.Variable((n, n), symmetric=True), cp.Variable(nonneg=True)
    limits = [
        factor**2 * (Q + c * B @ B.T) - A @ Q @ A.T >> 1e-7 * (1 - factor**2) * np.eye(n),
        cp.bmat([[Q, B], [B.T, np.eye(p)]]) >> 0,
    ]
    program = cp.Problem(cp.Minimize(c), limits)
    try:
        if not solve(program, "sampled integral design") or Q.value is None:
            return None
    except DesignError:
        return None
    room = graph.value**2 / (4 * graph.reach)
    if not 0 < float(c.value) < 0.9 * room:
        return None
    P = np.linalg.inv(Q.value) * graph.value / (2 * graph.reach) * 0.99
    P = P / np.outer(size, size) / unit**2
    P = nearest(0.5 * (P + P.T), 12, relative_zero=0.0)
    gain = -(step.B.T @ P @ step.A)
    gain = np.hstack([nearest(gain[:, :m] / phi, digits), nearest(gain[:, m:], digits)])
    exact = rational(gain)
    exact[:, :m] = exact[:, :m] * Fraction(repr(float(phi)))
    gap = 1 - factor**2
    for eta in (1e-4 * gap, 0.1 * gap):
        for share in (1e-3, 0.01, 0.05):
            proof = prove_sampled(step, exact, P, graph, factor, eta, share)
            if proof is not None:
                return gain, proof
    return None
