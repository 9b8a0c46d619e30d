"""Certificates L and I: one quadratic function of the network proves given gains, at any size.

The function is ``Σ_ij W_ij z_iᵀ V z_j`` with one small V for all agents and a weighting W of the
network. All that the network contributes is a few numbers (`GraphScalar`): with ``u = -M̂ q'``,
``s = sec(u)`` in the sector and ``q = q' + r``,

    ``2 qᵀ W s + b sᵀ W s ≤ -(γ - g b) q'ᵀ W q' + c rᵀ W r``   for every b ≥ 0.

The gain K is taken as it ships: ``q' = -K z``, and ``r = (K + BᵀV) z`` is what it differs from the
gain that V stands for. So rounded gains, and gains from elsewhere, are proved as they are.
"""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any, Literal

import attrs
import numpy as np

from posmas_fmi.agent import Agent
from posmas_fmi.certify.enclosure import matmul, middle, typed
from posmas_fmi.certify.flow import Flow
from posmas_fmi.certify.loop import Loop
from posmas_fmi.certify.proof import (
    UNIT,
    Definiteness,
    dyadic,
    identity,
    positive_definite,
    rational,
    verified_cholesky,
)
from posmas_fmi.certify.weights import perron_weights
from posmas_fmi.expression import Array
from posmas_fmi.interval import Interval
from posmas_fmi.network import Network

_EXACT_AGENTS = 12  # up to which a network is proved in rational arithmetic
_UP = 1 + 1e-9  # covers the rounding of short sums of non-negative terms


@attrs.frozen(eq=False)
class GraphScalar:
    """What a network contributes to a quadratic certificate.

    Attributes
    ----------
    value : float
        Proved γ₀.
    kind : {"diagonal", "symmetric"}
        ``W = Θ``, for any digraph; or ``W = M̂`` of an undirected one, where the width of the
        sector costs nothing.
    Theta, T : (N,) array
        The diagonals that prove γ₀; ones for ``W = M̂``.
    proof : Definiteness
    cross, own : float
        What a mismatch r costs.
    reach : float
        What ``b sᵀ W s`` costs: g.
    spread : float
        Condition number of W: what terms that differ from agent to agent cost.
    """

    value: float
    kind: Literal["diagonal", "symmetric"]
    Theta: Array
    T: Array
    proof: Definiteness
    cross: float
    own: float
    reach: float
    spread: float

    def left(self, share: float) -> tuple[float, float]:
        """Return γ and c where the share of γ₀ is given to a mismatch."""
        if self.kind == "symmetric":
            return self.value * (1 - share) / _UP, self.cross / share * _UP
        given = share * abs(self.value)
        cost = math.inf if given == 0 else self.cross**2 / given
        return (self.value - given) - 1e-12 * abs(self.value), (cost + self.own) * _UP


def symmetric_scalar(network: Network, sector: tuple[float, float]) -> GraphScalar | None:
    """``γ₀ = 2 m_l λ_min(M̂)`` with ``W = M̂``, for an undirected network; None for a digraph.

    ``2 q'ᵀ M̂ s = -2 uᵀ s ≤ -2 m_l uᵀu``, whatever the width of the sector.
    """
    M = network.pinned_laplacian
    if abs(M - M.T).nnz:
        return None
    low, high = sector
    least = perron_weights(network).rate  # of an M-matrix, (M̂ν)_i/ν_i bounds λ_min from below
    most = float(abs(M).sum(axis=1).max()) * _UP
    value = 2 * low * least / _UP
    proof = Definiteness(
        value, value, "nu > 0 with (L + D) nu >= lambda nu, rounding error bounded; undirected"
    )
    one = np.ones(network.N)
    # |M̂ r|² ≤ λ_max rᵀM̂r and sᵀM̂s ≤ λ_max sᵀs ≤ λ_max m_h sᵀu
    return GraphScalar(
        value, "symmetric", one, one, proof,
        cross=high * most / 2 * _UP,
        own=0.0,
        reach=low * least * most * high * _UP,
        spread=most / least * _UP if least > 0 else math.inf,
    )  # fmt: skip


def diagonal_scalar(
    network: Network,
    sector: tuple[float, float],
    gamma: float,
    Theta: Array,
    T: Array,
    proof: Definiteness,
) -> GraphScalar:
    """γ₀ that is proved by the diagonals Θ and T, with the costs that follow from them."""
    M = network.pinned_laplacian
    root = np.sqrt(Theta)
    scaled = abs(M).multiply(root[:, None]).multiply(1 / root[None, :]).tocsr()
    rows, columns = float(scaled.sum(axis=1).max()), float(scaled.sum(axis=0).max())
    mean = 0.5 * (sector[0] + sector[1])
    ratio = float((Theta / T).max())
    cross = ratio + mean * math.sqrt(rows * columns)
    reach = sector[1] ** 2 * rows * columns
    return GraphScalar(
        gamma, "diagonal", Theta, T, proof, cross * _UP, ratio * _UP, reach * _UP, 1.0
    )


def graph_proof(
    network: Network, sector: tuple[float, float], gamma: float, Theta: Array, T: Array
) -> Definiteness:
    """Prove ``m(ΘM̂ + M̂ᵀΘ) - ρ² M̂ᵀTM̂ - ΘT⁻¹Θ - γΘ ≻ 0``.

    Exactly for few agents, else in floating point with the rounding of every entry bounded.
    """
    low, high = (Fraction(repr(float(x))) for x in sector)
    mean, half = (high + low) / 2, (high - low) / 2
    if network.N <= _EXACT_AGENTS:
        M = rational(network.pinned_laplacian.toarray())
        theta, t = (np.array([Fraction(float(x)) for x in D], dtype=object) for D in (Theta, T))
        weighted = theta[:, None] * M
        own = np.array([a * a / b + Fraction(gamma) * a for a, b in zip(theta, t, strict=True)])
        S = mean * (weighted + weighted.T) - half**2 * (M.T @ (t[:, None] * M))
        S[np.arange(network.N), np.arange(network.N)] -= own
        return positive_definite(S)
    L = network.pinned_laplacian
    m, squared = float(mean), float(half**2)

    def form(P: Any, sign: float, size: float) -> Any:
        weighted = P.multiply(Theta[:, None])
        inner = P.T @ P.multiply(T[:, None]).tocsr()
        both = m * (weighted + weighted.T) + sign * squared * inner
        return both.toarray() + np.diag(sign * (Theta**2 / T) + size * Theta)

    S = form(L, -1.0, -gamma)
    total = form(abs(L), 1.0, abs(gamma))
    terms = 2 * int(np.diff(L.indptr).max(initial=0)) + 20
    rounding = float((terms * UNIT * 1.01 * total).sum(axis=1).max())
    return verified_cholesky(0.5 * (S + S.T), rounding)


# ---- one agent -----------------------------------------------------------------------------------


def lipschitz_norm(agent: Agent) -> float:
    """Bound β of the Euclidean Lipschitz constant: ``√(‖ℓ‖₁‖ℓ‖_∞)``, exact for diagonal ℓ = βI."""
    ell = agent.ell
    return float(np.sqrt(ell.sum(axis=0).max() * ell.sum(axis=1).max())) * (1 + 1e-12)


def feedback_matrix(
    system: tuple[Array, Array, Array],
    gain: Any,
    V: Any,
    graph: GraphScalar,
    theta: Fraction,
    kappa: Fraction,
    beta: float,
    share: float,
) -> Any:
    """Minus ``[[VA + AᵀV - γ KᵀK + c ΔᵀΔ + θVHHᵀV + 2κV, βI], [βI, -θI]]`` in rationals.

    Positive definite, with V, it proves the rate κ of the continuous loop: ``Δ = K + BᵀV``, and
    the Lipschitz term by ``2zᵀVHg ≤ θ|HᵀVz|² + β²|z|²/θ``.

    Parameters
    ----------
    system : (A, B, H)
        Of shapes (n, n), (n, p), (n, m); g depends on the first m states.
    gain : (p, n) rational array
        As it ships, coupling included.
    V : (n, n) rational array
    graph : GraphScalar
    theta, kappa : Fraction
    beta : float
        Lipschitz norm of g.
    share : float
        Of γ₀ given to Δ; 0 if Δ = 0.
    """
    A, B, H = (rational(M) for M in system)
    n, m = len(A), H.shape[1]
    VA, VH = V @ A, V @ H
    off = gain + B.T @ V
    exact = not any(off.ravel())
    gamma, cost = (graph.value, 0.0) if exact else graph.left(share)
    top = VA + VA.T - Fraction(gamma) * (gain.T @ gain) + theta * (VH @ VH.T) + 2 * kappa * V
    if not exact:
        top = top + Fraction(cost) * (off.T @ off)
    slope = Fraction(beta * math.sqrt(graph.spread) * _UP)
    side = slope * identity(n)[:, :m]
    return -np.block([[top, side], [side.T, -theta * identity(m)]])


def mismatch(B: Array, gain: Array, V: Array, graph: GraphScalar) -> float:
    """Share of γ₀ that suits the difference of a gain from ``-BᵀV``."""
    size = float(np.linalg.norm(gain)) or 1.0
    off = float(np.linalg.norm(gain + B.T @ V)) / size
    scale = graph.cross / max(abs(graph.value), 1e-300)
    if graph.kind == "symmetric":
        scale = math.sqrt(scale)
    return float(np.clip(scale * off, 1e-9, 0.5))


@attrs.frozen(eq=False)
class Step:
    """One period of an agent: ``z⁺ = (A + E₁) z + (B + E₂) s``, with bounds on E₁ and E₂.

    Attributes
    ----------
    A, B : arrays
        Doubles, taken as they are.
    loose, loose_input : float
        Bounds of the spectral norms of E₁, which acts on the first m entries of z, and of E₂.
    m : int
        States of the agent; the others are integrals.
    """

    A: Array
    B: Array
    loose: float
    loose_input: float
    m: int


def step_of(loop: Loop, C_z: Array | None = None) -> Step | None:
    """Enclose one period with held input; with integrals ``w⁺ = w + h C_z x`` of samples.

    Returns
    -------
    Step or None
        None where bounds are not finite.
    """
    h = loop.period
    assert h is not None
    if not np.isfinite(loop.H_ell.high).all():
        return None
    Phi, Gamma = _period(loop, h)
    held = matmul(Gamma, typed(loop.agent.B))
    A, loose = middle(Phi)
    B, loose_input = middle(held)
    if not (np.isfinite(A).all() and np.isfinite(B).all()):
        return None
    m = loop.agent.m
    if C_z is not None:
        k = len(C_z)
        add = h * C_z
        A = np.block([[A, np.zeros((m, k))], [add, np.eye(k)]])
        B = np.vstack([B, np.zeros((k, loop.agent.p))])
        # h and C_z are decimals, and their product is rounded
        loose = math.hypot(loose, 4 * UNIT * float(np.linalg.norm(add))) * _UP
    return Step(A, B, loose, loose_input, m)


def _period(loop: Loop, h: float) -> tuple[Interval, Interval]:
    """Enclosures of Φ and Γ for every G(t) in the bounds."""
    flow = Flow(loop.A_low, loop.A_high)
    if flow.metzler:
        low, high, held_low, held_high = flow.over(h)
        return Interval(low.low, high.high), Interval(held_low.low, held_high.high)
    plain, grown, held, grown_held = Flow(loop.A, loop.A_high).over(h)
    spread, spread_held = grown.high - plain.low, grown_held.high - held.low
    return (
        Interval(plain.low - spread * _UP, plain.high + spread * _UP),
        Interval(held.low - spread_held * _UP, held.high + spread_held * _UP),
    )


def sampled_matrix(
    step: Step,
    gain: Any,
    P: Any,
    graph: GraphScalar,
    bounds: tuple[Fraction, Fraction],
    factor: Fraction,
    eta: Fraction,
    share: float,
) -> Any:
    """``r²P - (1+η)AᵀPA + (γ - g b)KᵀK - c ΔᵀΔ - a J`` in rationals: ≻ 0 proves r per period.

    ``Δ = K + (1+η)BᵀPA``; ``b = (1+η) b̄ + a_s`` bounds what the input adds by itself; a and a_s
    pay for E₁ and E₂, by ``|z + w|² ≤ (1+η)|z|² + (1+1/η)|w|²``.

    Parameters
    ----------
    step : Step
    gain : (p, n) rational array
    P : (n, n) rational array
    graph : GraphScalar
    bounds : (b̄, p̄)
        ``b̄I ⪰ BᵀPB``, ``p̄I ⪰ P``, proved elsewhere.
    factor : Fraction
        r.
    eta : Fraction
    share : float
        Of γ₀ given to Δ.
    """
    A, B = dyadic(step.A), dyadic(step.B)
    n, (b_bar, p_bar) = len(A), bounds
    one = 1 + eta
    PA = P @ A
    off = gain + one * (B.T @ PA)
    paid = 2 * (1 + 1 / eta) * p_bar * Fraction(graph.spread)
    a = paid * Fraction(step.loose) ** 2
    b = one * b_bar + paid * Fraction(step.loose_input) ** 2
    gamma, cost = graph.left(share)
    weight = Fraction(gamma) - Fraction(graph.reach) * b
    if graph.kind == "symmetric" and weight < 0:
        return -identity(n)  # the bound of a network needs a weight of at least zero
    J = identity(n)
    for k in range(step.m, n):
        J[k, k] = Fraction(0)
    return (
        factor**2 * P
        - one * (A.T @ PA)
        + weight * (gain.T @ gain)
        - Fraction(cost) * (off.T @ off)
        - a * J
    )


@attrs.frozen(eq=False)
class SampledProof:
    """A quadratic proof of the sampled loop.

    Attributes
    ----------
    factor : float
        Proved r per period.
    P : (n, n) array
    proof : Definiteness
    """

    factor: float
    P: Array
    proof: Definiteness


def prove_sampled(
    step: Step, gain: Any, P: Array, graph: GraphScalar, factor: float, eta: float, share: float
) -> SampledProof | None:
    """Prove r for a rounded P; None where it is not proved."""
    exact = dyadic(P)
    B = dyadic(step.B)
    b_bar = Fraction(float(np.linalg.eigvalsh(step.B.T @ P @ step.B)[-1]) * (1 + 1e-9) + 1e-300)
    p_bar = Fraction(float(np.linalg.eigvalsh(P)[-1]) * (1 + 1e-9))
    n, p = step.B.shape
    sides = (
        exact,
        b_bar * identity(p) - B.T @ exact @ B,
        p_bar * identity(n) - exact,
    )
    if not all(positive_definite(M).positive for M in sides):
        return None
    proof = positive_definite(
        sampled_matrix(
            step, gain, exact, graph, (b_bar, p_bar), Fraction(factor), Fraction(eta), share
        )
    )
    return SampledProof(factor, P, proof) if proof.positive else None


def prove_observer(loop: Loop, factor: float) -> SampledProof | None:
    """Prove r per period for the local observer: ``e⁺ = (Φ - Γ EC) e``, one agent by itself.

    ``r²P - (1+η)FᵀPF - (1+1/η) p̄ ‖E‖² I ≻ 0`` with ``Φ - Γ EC = F + E``; P solves a discrete
    Lyapunov equation.
    """
    from scipy.linalg import solve_discrete_lyapunov

    assert loop.period is not None
    if not np.isfinite(loop.H_ell.high).all():
        return None
    Phi, Gamma = _period(loop, loop.period)
    F, loose = middle(Phi + -matmul(Gamma, loop.EC))
    if not np.isfinite(F).all() or np.abs(np.linalg.eigvals(F)).max() >= factor:
        return None
    P = solve_discrete_lyapunov((F / factor).T, np.eye(len(F)))
    P = 0.5 * (P + P.T) / np.abs(P).max()
    p_bar = Fraction(float(np.linalg.eigvalsh(P)[-1]) * (1 + 1e-9))
    exact, f, one = dyadic(P), dyadic(F), identity(len(F))
    if not (positive_definite(exact).positive and positive_definite(p_bar * one - exact).positive):
        return None
    for eta in (1e-6, 1e-4, 1e-3, 1e-2, 1e-1):
        e = Fraction(eta)
        M = Fraction(factor) ** 2 * exact - (1 + e) * (f.T @ exact @ f)
        proof = positive_definite(M - (1 + 1 / e) * p_bar * Fraction(loose) ** 2 * one)
        if proof.positive:
            return SampledProof(factor, P, proof)
    return None
