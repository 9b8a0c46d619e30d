"""Distributed integral action (certificate I): no offset under unequal constant loads.

``u = (M̂ ⊗ K) δ + (I ⊗ K_q) q`` with ``q_i' = Σ_j M̂_ij C_z (x_j - s)`` is the pinned protocol of
the augmented agent ``[[A, 0], [C_z, 0]]``, ``[B; 0]``: route L proves it with one small program
whatever the number of agents. It needs the *slope* of sec in the sector, and gives up certificates
P and D; use it for plants whose positivity is structural.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import attrs
import numpy as np

from posmas_fmi.agent import Agent
from posmas_fmi.certify.proof import Definiteness, identity, positive_definite, rational
from posmas_fmi.certify.quadratic import GraphScalar
from posmas_fmi.design.lmi import graph_scalar, lipschitz_norm
from posmas_fmi.design.rounding import nearest
from posmas_fmi.design.solver import cvxpy, solve
from posmas_fmi.errors import DesignError
from posmas_fmi.expression import Array
from posmas_fmi.network import Network

_SAFETY = 1e-4


@attrs.frozen(eq=False)
class IntegralDesign:
    """Gains of the integral protocol and their proof.

    Attributes
    ----------
    K : (p, m) array
        On ``Σ_j (L_p)_ij δ_j``; φ is contained.
    K_q : (p, k) array
        On q_i.
    V : (m + k, m + k) array
        ``Σ θ_i z_iᵀ V z_i`` falls at the rate 2κ.
    kappa : float
        Proved rate [1/s] of the continuous loop.
    graph : GraphScalar
    proof : Definiteness
        Of the rational matrix inequality, with V as rounded.
    """

    K: Array
    K_q: Array
    V: Array
    kappa: float
    graph: GraphScalar
    proof: Definiteness


def augmented(agent: Agent, C_z: Array) -> tuple[Array, Array, Array]:
    """Return ``[[A, 0], [C_z, 0]]``, ``[B; 0]`` and ``[H; 0]``."""
    m, k = agent.m, len(C_z)
    A = np.block([[agent.A, np.zeros((m, k))], [C_z, np.zeros((k, k))]])
    return A, np.vstack([agent.B, np.zeros((k, agent.p))]), np.vstack([agent.H, np.zeros((k, m))])


def integral_design(
    agent: Agent, network: Network, C_z: Array, rate: float, digits: int = 8
) -> IntegralDesign:
    """Gains with the least bound on ``|K|`` that contract with the wanted rate.

    Parameters
    ----------
    agent : Agent
        Its sector has to bound the slope of sec.
    network : Network
    C_z : (k, m) array
        What is integrated, ``z = C_z x``.
    rate : float
        Wanted κ [1/s].
    digits : int
        Digits to which V is rounded.

    Returns
    -------
    IntegralDesign

    Raises
    ------
    DesignError
        If no quadratic design has that rate, or the rounded one could not be proved.

    Examples
    --------
    >>> from posmas_fmi.agent import linear_agent
    >>> from posmas_fmi.network import network_from_arcs
    >>> tank = linear_agent([[-0.1]], [[1.0]], [[1.0]])
    >>> made = integral_design(tank, network_from_arcs(1, [], [1]), np.eye(1), rate=0.05)
    >>> made.proof.positive, bool(made.K_q[0, 0] < 0)
    (True, True)
    """
    network.require_reached()
    C_z = np.atleast_2d(np.asarray(C_z, dtype=float))
    if C_z.shape[1] != agent.m:
        raise DesignError(f"expected C_z with {agent.m} columns (got {C_z.shape})", "$.design")
    graph = graph_scalar(network, (agent.m_l, agent.m_h))
    A, B, H = augmented(agent, C_z)
    beta = lipschitz_norm(agent)
    Pi, sigma, theta = _program(A, B, H, graph.value, beta, rate * (1 + _SAFETY))
    V = np.linalg.inv(Pi / sigma)
    V = nearest(0.5 * (V + V.T), digits, relative_zero=0.0)
    V = np.tril(V) + np.tril(V, -1).T
    gains = nearest(-(B.T @ V), 15, relative_zero=0.0)
    proof = positive_definite(_matrix(A, B, H, V, graph.value, theta / sigma, rate, beta))
    if not (proof.positive and positive_definite(rational(V)).positive):
        raise DesignError(
            f"the integral design could not be proved after rounding ({proof}); ask for a lower "
            "rate or more digits",
            "$.design",
        )
    return IntegralDesign(gains[:, : agent.m], gains[:, agent.m :], V, rate, graph, proof)


def _program(
    A: Array, B: Array, H: Array, gamma: float, beta: float, rate: float
) -> tuple[Array, float, float]:
    """Least σ with Π ⪰ I, as ``K = -σ BᵀΠ⁻¹`` is then bounded by σ‖B‖."""
    cp = cvxpy()
    n, m = len(A), H.shape[1]
    Pi = cp.Variable((n, n), symmetric=True)
    sigma, theta = cp.Variable(pos=True), cp.Variable(pos=True)
    seen = np.vstack([np.eye(m), np.zeros((n - m, m))])  # g depends on the agent's states only
    top = A @ Pi + Pi @ A.T - gamma * sigma * B @ B.T + theta * H @ H.T + 2 * rate * Pi
    side = beta * Pi @ seen
    block = cp.bmat([[top, side], [side.T, -theta * np.eye(m)]])
    room = 1e-6 * max(1e-6, rate)
    limits = [block << -room * np.eye(n + m), Pi >> np.eye(n)]
    program = cp.Problem(cp.Minimize(sigma), limits)
    if not solve(program, "integral design") or Pi.value is None:
        raise DesignError(
            f"no quadratic integral design has the rate {rate:.4g} 1/s; ask for a lower one",
            "$.design.rate",
        )
    return np.asarray(Pi.value), float(sigma.value), float(theta.value)


def _matrix(
    A: Array, B: Array, H: Array, V: Array, gamma: float, theta: float, rate: float, beta: float
) -> Any:
    """Minus the inequality of `_program` in the coordinates V, in rational arithmetic."""
    n, m = len(A), H.shape[1]
    W, a, b, h = (rational(M) for M in (V, A, B, H))
    WA, WB, WH = W @ a, W @ b, W @ h
    t = Fraction(theta)
    top = (
        WA
        + WA.T
        - Fraction(gamma) * (WB @ WB.T)
        + t * (WH @ WH.T)
        + 2 * Fraction(repr(float(rate))) * W
    )
    side = Fraction(beta) * identity(n)[:, :m]
    return -np.block([[top, side], [side.T, -t * identity(m)]])
