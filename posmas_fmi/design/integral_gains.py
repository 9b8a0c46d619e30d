"""Gains of the integral protocol in continuous time: one small program, then exact arithmetic."""

from __future__ import annotations

import math
from collections.abc import Iterator
from fractions import Fraction
from typing import Any

import attrs
import numpy as np

from posmas_fmi.agent import Agent
from posmas_fmi.certify.proof import Definiteness, positive_definite, rational
from posmas_fmi.certify.proof import dyadic as exactly
from posmas_fmi.certify.quadratic import GraphScalar, feedback_matrix, lipschitz_norm, mismatch
from posmas_fmi.design.rounding import nearest
from posmas_fmi.design.solver import cvxpy, solve
from posmas_fmi.errors import DesignError
from posmas_fmi.expression import Array

_SAFETY = 1e-4
_HALVINGS = 14


@attrs.frozen(eq=False)
class IntegralDesign:
    """Gains of the integral protocol and their proof.

    Attributes
    ----------
    K : (p, m) array
        On ``Σ_j (L_p)_ij δ_j``, to be multiplied by φ.
    K_q : (p, k) array
        On q_i.
    V : (m + k, m + k) array
        ``Σ_ij W_ij z_iᵀ V z_j`` falls at the rate 2κ.
    kappa : float
        Proved rate [1/s] of the continuous loop.
    graph : GraphScalar
    proof : Definiteness
        Of the rational matrix inequality, with the gains as they ship.
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
    agent: Agent,
    graph: GraphScalar,
    C_z: Array,
    rate: float,
    phi: float = 1.0,
    digits: int = 6,
) -> IntegralDesign:
    """Gains with the least bound on ``|K|`` that contract with the wanted rate.

    Parameters
    ----------
    agent : Agent
        Its sector has to bound the slope of sec.
    graph : GraphScalar
        Of the network.
    C_z : (k, m) array
        What is integrated, ``z = C_z x``.
    rate : float
        Wanted κ [1/s].
    phi : float
        Coupling, which K is divided by.
    digits : int
        Significant digits of the gains, which are rounded before anything is proved.

    Raises
    ------
    DesignError
        If no quadratic design has that rate, or the rounded gains could not be proved.

    Examples
    --------
    >>> from posmas_fmi.agent import linear_agent
    >>> from posmas_fmi.certify.quadratic import symmetric_scalar
    >>> from posmas_fmi.network import network_from_arcs
    >>> tank = linear_agent([[-0.1]], [[1.0]], [[1.0]])
    >>> one = symmetric_scalar(network_from_arcs(1, [], [1]), (1.0, 1.0))
    >>> made = integral_design(tank, one, np.eye(1), rate=0.05)
    >>> made.proof.positive, bool(made.K_q[0, 0] < 0)
    (True, True)
    """
    C_z = np.atleast_2d(np.asarray(C_z, dtype=float))
    if C_z.shape[1] != agent.m:
        raise DesignError(f"expected C_z with {agent.m} columns (got {C_z.shape})", "$.design")
    system = augmented(agent, C_z)
    V, theta = _program(system, graph, lipschitz_norm(agent), rate * (1 + _SAFETY))
    gain = -(system[1].T @ V)
    K = nearest(gain[:, : agent.m] / phi, digits)
    K_q = nearest(gain[:, agent.m :], digits)
    proof = prove(agent, C_z, phi, K, K_q, V, graph, theta, rate)
    if not proof.positive:
        raise DesignError(
            f"the integral design could not be proved after rounding ({proof}); ask for a lower "
            "rate or more digits",
            "$.design",
        )
    return IntegralDesign(K, K_q, V, rate, graph, proof)


def exact_gain(phi: float, K: Array, K_q: Array) -> Any:
    """``[φK  K_q]`` in fractions."""
    return np.hstack([Fraction(repr(float(phi))) * rational(K), rational(K_q)])


def prove(
    agent: Agent,
    C_z: Array,
    phi: float,
    K: Array,
    K_q: Array,
    V: Array,
    graph: GraphScalar,
    theta: float,
    rate: float,
    share: float | None = None,
) -> Definiteness:
    """Prove κ for gains as they are."""
    system = augmented(agent, C_z)
    if not positive_definite(exactly(V)).positive:
        return nothing()
    exact = exact_gain(phi, K, K_q)
    gain = np.hstack([phi * K, K_q])
    if share is None:
        share = mismatch(system[1], gain, V, graph)
    return positive_definite(
        feedback_matrix(
            system, exact, exactly(V), graph, Fraction(theta), Fraction(repr(float(rate))),
            lipschitz_norm(agent), share,
        )
    )  # fmt: skip


def _program(
    system: tuple[Array, Array, Array], graph: GraphScalar, beta: float, rate: float
) -> tuple[Array, float]:
    """Least σ with Π ⪰ I, as ``K = -σ BᵀΠ⁻¹`` is then bounded by σ‖B‖; V = σ Π⁻¹ and θ."""
    cp = cvxpy()
    A, B, H = system
    n, m = len(A), H.shape[1]
    unit = float(np.abs(B).max(initial=0.0)) or 1.0
    B = B / unit
    slope = beta * math.sqrt(graph.spread) * (1 + 1e-6)
    if not math.isfinite(slope):
        raise DesignError("the integral design needs a finite Lipschitz bound", "$.agent.lipschitz")
    Pi = cp.Variable((n, n), symmetric=True)
    sigma, theta = cp.Variable(pos=True), cp.Variable(pos=True)
    seen = np.vstack([np.eye(m), np.zeros((n - m, m))])  # g depends on the agent's states only
    # γσ in place of σ: graph scalars of large networks are small
    top = A @ Pi + Pi @ A.T - sigma * B @ B.T + theta * H @ H.T + 2 * rate * Pi
    side = slope * Pi @ seen
    block = cp.bmat([[top, side], [side.T, -theta * np.eye(m)]])
    room = 1e-6 * max(1e-6, rate)
    limits = [block << -room * np.eye(n + m), Pi >> np.eye(n)]
    program = cp.Problem(cp.Minimize(sigma), limits)
    if not solve(program, "integral design") or Pi.value is None:
        raise DesignError(
            f"no quadratic integral design has the rate {rate:.4g} 1/s; ask for a lower one",
            "$.design.rate",
        )
    scale = float(sigma.value) / unit**2 / graph.value * (1 + _SAFETY)
    V = np.linalg.inv(np.asarray(Pi.value)) * scale
    return 0.5 * (V + V.T), float(theta.value) / scale


def halvings(agent: Agent) -> Iterator[float]:
    """Rates to look for [1/s], from the fastest pole of A on."""
    fastest = float(np.abs(np.linalg.eigvals(agent.A)).max()) or 1.0
    for k in range(_HALVINGS):
        yield float(f"{fastest * 0.5**k:.3g}")


def nothing() -> Definiteness:
    """Outcome of a search that found no quadratic function: nothing proved, nothing refuted."""
    return Definiteness(float("nan"), -math.inf, "the search found no quadratic function")
