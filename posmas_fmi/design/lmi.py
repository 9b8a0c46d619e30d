"""Method "lmi": the corrected quadratic design, for when entrywise bounds are too coarse.

Route L of theory.md: one scalar γ₀ of the graph, then two small semidefinite programs whatever the
number of agents. ``V = Σ θ_i δ_iᵀ Π⁻¹ δ_i`` falls at the rate 2κ for every sector nonlinearity.
Numbers are rounded first; what is proved is proved about the rounded ones, in exact arithmetic.
"""

from __future__ import annotations

import math
from contextlib import suppress
from fractions import Fraction
from typing import Any

import attrs
import numpy as np

from posmas_fmi.agent import Agent, Assumption
from posmas_fmi.certify.certificate import Certificate, Condition
from posmas_fmi.certify.closed_loop import Prover
from posmas_fmi.certify.loop import Loop
from posmas_fmi.certify.proof import (
    Definiteness,
    diagonal,
    dyadic,
    identity,
    positive_definite,
    rational,
)
from posmas_fmi.certify.quadratic import (
    GraphScalar,
    feedback_matrix,
    lipschitz_norm,
    mismatch,
    symmetric_scalar,
)
from posmas_fmi.design.certified import certified, loop_of
from posmas_fmi.design.graph_scalar import graph_scalar
from posmas_fmi.design.result import Design
from posmas_fmi.design.rounding import nearest, towards_zero
from posmas_fmi.design.sampled import sampled_condition, sampled_feedback, sampled_observer
from posmas_fmi.design.settings import DesignSettings
from posmas_fmi.design.solver import cvxpy, feasible, solve
from posmas_fmi.errors import DesignError
from posmas_fmi.expression import Array
from posmas_fmi.network import Network

_BISECTIONS = 40
_FACTORS = (1.0, 0.98, 0.95, 0.9, 0.85, 0.8, 0.7, 0.6, 0.5)  # of K or κ_e: room for sampling
_OBSERVER_FACTOR = 3.0  # in a quadratic design fast observers cost much gain
_SAFETY = 1e-5  # relative distance of proved scalars from their optima


@attrs.frozen(eq=False)
class Feedback:
    """``K = -BᵀV/φ`` with V = Π⁻¹ diagonal, its rate κ and the proof.

    Attributes
    ----------
    K : (p, m) array
    V : (m,) array
    kappa : float
        Proved rate [1/s]; negative where none is.
    theta : float
        Multiplier of the Lipschitz bound.
    proof : Definiteness
    """

    K: Array
    V: Array
    kappa: float
    theta: float
    proof: Definiteness


def feedback_gain(
    agent: Agent,
    network: Network,
    phi: float,
    graph: GraphScalar,
    digits: int,
    room: Array | None,
) -> Feedback:
    """Fastest quadratic feedback, by bisection over κ.

    Parameters
    ----------
    room : (m, m) array or None
        ``room Π - m_h max(l_ii + d_i) BBᵀ`` is asked to be Metzler: ``A - |H|ℓ`` for certificate
        P, A for the weaker condition of the theory, None for no positivity.

    Raises
    ------
    DesignError
        If not even a negative κ is found.
    """
    cp = cvxpy()
    m, A, H, B = agent.m, agent.A, agent.H, agent.B
    gamma = graph.value
    beta = lipschitz_norm(agent) * float(np.sqrt(graph.spread))
    if not np.isfinite(beta):
        raise DesignError("route L needs a finite Lipschitz bound of g", "$.agent.lipschitz")
    # Π and the factor of BBᵀ scale together: Π is normalised, V = σ Π⁻¹, whatever the unit of u
    unit = float(np.abs(B).max(initial=0.0)) or 1.0
    B = B / unit
    pi, theta, sigma, slack = (
        cp.Variable(m, pos=True),
        cp.Variable(pos=True),
        cp.Variable(pos=True),
        cp.Variable(),
    )
    kappa = cp.Parameter()
    shifted = cp.Variable(m)
    Pi = cp.diag(pi)
    top = A @ Pi + Pi @ A.T - gamma * sigma * B @ B.T + theta * H @ H.T + 2 * cp.diag(shifted)
    block = cp.bmat([[top, beta * Pi], [beta * Pi, -theta * np.eye(m)]])
    constraints = [
        block << -slack * np.eye(2 * m),
        shifted == kappa * pi,
        cp.sum(pi) == m,
        pi >= 1e-6,
        sigma <= 1e6,
        sigma >= 1e-6,
        slack <= 1,
    ]
    if room is not None:
        degree = float((network.in_degree + network.pinning).max())
        BB = B @ B.T
        constraints += [
            room[i, j] * pi[j] >= agent.m_h * degree * BB[i, j] * (1 + _SAFETY) * sigma
            for i in range(m)
            for j in range(m)
            if i != j
        ]
    program = cp.Problem(cp.Maximize(slack), constraints)
    size = float(np.abs(A).sum() + np.abs(H).sum() * beta) + 1.0
    low, high, best = -size, 2 * size, None
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        kappa.value = middle
        if feasible(program, slack):
            factor = float(sigma.value) / unit**2
            low, best = middle, (pi.value / factor, max(float(theta.value), 1e-12) / factor)
        else:
            high = middle
        if high - low < 1e-6 * max(1.0, abs(high)):
            break
    if best is None:
        raise DesignError(
            "no diagonal quadratic feedback keeps signs: A + phi m_h max(Lp)_ii BK - |H|l Metzler "
            "leaves no room for a gain",
            "$.design.method",
        )
    return _proved_feedback(agent, phi, graph, best, low, digits)


def _proved_feedback(
    agent: Agent,
    phi: float,
    graph: GraphScalar,
    found: tuple[Array, float],
    kappa: float,
    digits: int,
) -> Feedback:
    """Form K from V, round it, and prove a rate for the rounded gain."""
    V = 1.0 / found[0]
    K = towards_zero(-(agent.B.T * V) / phi, digits)
    return prove_feedback(agent, phi, graph, K, V, found[1], kappa)


def prove_feedback(
    agent: Agent,
    phi: float,
    graph: GraphScalar,
    K: Array,
    V: Array,
    theta: float,
    kappa: float,
) -> Feedback:
    """Prove the rate κ, or the largest below it that K as it is given still has.

    Parameters
    ----------
    K : (p, m) array
        Near ``-BᵀV/φ``.
    V : (m,) array
    theta : float
        Multiplier of the Lipschitz bound.
    kappa : float
        Largest rate that is looked for.
    """
    judge = _Judge(agent, phi, graph, K, V, theta)
    if judge.least(kappa) <= 0:
        low, high = -float(np.abs(agent.A).sum()) - 1.0, kappa
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if judge.least(middle) > 0 else (low, middle)
        kappa = low
    outcome = Definiteness(float("nan"), -np.inf, "not tried")
    for step in (_SAFETY, 1e-4, 1e-3, 1e-2):
        rate = kappa - step * max(abs(kappa), 1e-3)
        outcome = positive_definite(judge.matrix(rate))
        if outcome.positive:
            return Feedback(K, V, rate, theta, outcome)
    return Feedback(K, V, -np.inf, theta, outcome)


@attrs.frozen(eq=False)
class _Judge:
    """The matrix that proves a rate of one gain."""

    agent: Agent
    phi: float
    graph: GraphScalar
    K: Array
    V: Array
    theta: float

    def least(self, rate: float) -> float:
        """Smallest eigenvalue in plain floating point."""
        return float(np.linalg.eigvalsh(np.array(self.matrix(rate), dtype=float))[0])

    def matrix(self, rate: float) -> Any:
        agent = self.agent
        return feedback_matrix(
            (agent.A, agent.B, agent.H),
            Fraction(repr(float(self.phi))) * rational(self.K),
            diagonal(self.V),
            self.graph,
            Fraction(self.theta),
            Fraction(rate),
            lipschitz_norm(agent),
            mismatch(agent.B, self.phi * self.K, np.diag(self.V), self.graph),
        )


def scaled_feedback(
    agent: Agent, phi: float, graph: GraphScalar, base: Feedback, factor: float, digits: int
) -> Feedback:
    """Return the same feedback times a factor below one, with the rate that it still has."""
    V, theta = base.V * factor, base.theta / factor
    K = towards_zero(base.K * factor, digits)
    size = float(np.abs(agent.A).sum()) + 1.0
    return prove_feedback(agent, phi, graph, K, V, theta, max(base.kappa, 0.0) + size)


def observer_gain(
    agent: Agent, rate: float, digits: int, spare: float = 0.0
) -> tuple[Array, float, Definiteness]:
    """Local observer with least ``‖W‖`` for the rate κ_e; E, the proved rate, the proof.

    Sign conditions are asked for with room for the rounding of E, and with that share of
    ``A - |H|ℓ`` to spare: sampling needs some.

    Raises
    ------
    DesignError
        If no positive observer has that rate.
    """
    cp = cvxpy()
    m, q, A, H, C = agent.m, agent.q, agent.A, agent.H, agent.C
    beta = lipschitz_norm(agent)
    p, s, W = cp.Variable(m, pos=True), cp.Variable(pos=True), cp.Variable((m, q))
    P = cp.diag(p)
    S = P @ A - W @ C
    top = S + S.T + beta**2 * s * np.eye(m) + 2 * rate * (1 + _SAFETY) * P
    block = cp.bmat([[top, P @ H], [H.T @ P, -s * np.eye(m)]])
    room = P @ (A - agent.H_ell) - W @ C
    constraints = [
        block << -1e-6 * np.eye(2 * m),
        p >= 1,
        W @ C >= 0,
    ]
    kept = max(1e-6, 10.0 ** (1 - digits) * float(np.abs(A).max())) + spare * np.maximum(
        A - agent.H_ell, 0.0
    )
    constraints += [room[i, j] >= kept[i, j] * p[i] for i in range(m) for j in range(m) if i != j]
    program = cp.Problem(cp.Minimize(cp.sum(cp.abs(W)) + 1e-6 * cp.sum(p)), constraints)
    if not solve(program, "observer") or W.value is None:
        raise DesignError(
            f"no positive quadratic observer has the rate {rate:.4g} 1/s; ask for a lower "
            'observer_rate, or use method = "contraction"',
            "$.design.observer_rate",
        )
    E = nearest(W.value / p.value[:, None], digits, relative_zero=1e-6)
    proof = positive_definite(
        observer_matrix(
            agent,
            rational(E),
            dyadic(p.value),
            Fraction(float(s.value)),
            Fraction(rate),
            Fraction(beta),
        )
    )
    return E, rate if proof.positive else -np.inf, proof


def observer_matrix(
    agent: Agent, E: Any, P: Any, s: Fraction, rate: Fraction, beta: Fraction
) -> Any:
    """Minus the observer LMI in rational arithmetic, (2m, 2m)."""
    A, H, C = rational(agent.A), rational(agent.H), rational(agent.C)
    one, D = identity(agent.m), diagonal(P)
    S, PH = D @ (A - E @ C), D @ H
    top = S + S.T + beta**2 * s * one + 2 * rate * D
    return -np.block([[top, PH], [PH.T, -s * one]])


def design(
    agent: Agent, network: Network, settings: DesignSettings, period: float | None
) -> Design:
    """Design by route L, then see what certificates P and T say about the shipped gains."""
    network.require_reached()
    graph, feedback = _best(agent, network, settings)
    estimate = _observer(agent, network, settings, period, feedback.kappa)
    made = None
    for factor in _FACTORS:
        if factor < 1.0:
            weaker = scaled_feedback(agent, settings.phi, graph, feedback, factor, settings.digits)
            if weaker.kappa <= 0:
                break
            feedback = weaker
        made = certified(agent, network, feedback.K, estimate.E, settings, period)
        failing = [c.name for c in made.certificate.failing]
        if not any("controller" in name or " BK" in name for name in failing):
            break
    assert made is not None
    loop = loop_of(agent, network, made.K, made.E, settings, period)
    return attrs.evolve(
        made, certificate=_with_route_l(made.certificate, loop, graph, feedback, estimate)
    )


def _best(agent: Agent, network: Network, settings: DesignSettings) -> tuple[GraphScalar, Feedback]:
    """Fastest of the quadratic feedbacks that the weightings of the network allow.

    Raises
    ------
    DesignError
        If none contracts.
    """
    sector, room = (agent.m_l, agent.m_h), agent.A - agent.H_ell
    found: list[tuple[GraphScalar, Feedback]] = []
    for graph in (graph_scalar(network, sector), symmetric_scalar(network, sector)):
        if graph is not None:
            with suppress(DesignError):
                found.append(
                    (
                        graph,
                        feedback_gain(agent, network, settings.phi, graph, settings.digits, room),
                    )
                )
    best = max(found, key=lambda pair: pair[1].kappa, default=None)
    if best is None:
        raise DesignError(
            "no diagonal quadratic feedback keeps signs: A + phi m_h max(Lp)_ii BK - |H|l Metzler "
            "leaves no room for a gain",
            "$.design.method",
        )
    if best[1].kappa <= 0:
        raise DesignError(
            f"route L proves no contraction: kappa = {best[1].kappa:.4g} 1/s with gamma_0 = "
            f"{best[0].value:.4g}; another pinned agent changes gamma_0, and "
            'method = "contraction" may do better',
            "$.design.method",
        )
    return best


@attrs.frozen(eq=False)
class Estimate:
    """Observer gain and what is proved about it by route L; `condition` None where P and T do."""

    E: Array
    rate: float | None
    condition: Condition | None


def _observer(
    agent: Agent,
    network: Network,
    settings: DesignSettings,
    period: float | None,
    kappa: float,
) -> Estimate:
    if settings.observer == "distributed":
        from posmas_fmi.design import contraction

        return Estimate(
            contraction.observer_gain(agent, network, settings, period, kappa), None, None
        )
    wanted = settings.observer_rate or _OBSERVER_FACTOR * kappa
    E, rate, proof = observer_gain(agent, wanted, settings.digits)
    for factor in _FACTORS if settings.observer_rate is None else ():
        with suppress(DesignError):
            slower = observer_gain(agent, factor * wanted, settings.digits, 1 - factor)
            if slower[2].positive and _keeps_signs(agent, network, settings, period, slower[0]):
                E, rate, proof = slower
                break
    condition = Condition.from_margin(
        "L: observer contracts", proof.bound, f"kappa_e = {rate:.9g} 1/s: {proof}"
    )
    return Estimate(E, rate if proof.positive else None, condition)


def _keeps_signs(
    agent: Agent, network: Network, settings: DesignSettings, period: float | None, E: Array
) -> bool:
    """Whether certificate P, and T's part of it, are proved of a local observer."""
    loop = loop_of(agent, network, np.zeros((agent.p, agent.m)), E, settings, period)
    return Prover(loop, loop.estimator(loop.weights), loop.weights).positive


def _with_route_l(
    found: Certificate, loop: Loop, graph: GraphScalar, feedback: Feedback, estimate: Estimate
) -> Certificate:
    """Put route L in front.

    It takes the place of C, and of T where it proves the sampled loop. What else is refuted stays
    as a condition that fails; what is neither proved nor refuted becomes an assumption.
    """
    own = [
        Condition.from_margin(
            "L: graph scalar", graph.proof.bound, f"gamma_0 = {graph.value:.9g}: {graph.proof}"
        ),
        Condition.from_margin(
            "L: feedback contracts",
            feedback.proof.bound,
            f"kappa = {feedback.kappa:.9g} 1/s: {feedback.proof}",
        ),
    ]
    if estimate.condition is not None:
        own.append(estimate.condition)
    rate, observer_rate = found.rate, found.observer_rate
    replaced = []
    for c in found.conditions:
        if c.holds or not c.name.endswith("contracts"):
            continue
        if "controller" in c.name:
            proved, rate = _instead(loop, graph, feedback)
        elif estimate.condition is None:
            continue
        else:
            proved, observer_rate = _instead_of_observer(loop, estimate)
        if proved is not None:
            replaced.append(c.name)
            own += proved
    rest = [c for c in found.conditions if c.name not in replaced]
    kept = [c for c in rest if c.holds or c.refuted or c.name.startswith("network")]
    dropped = [c for c in rest if c not in kept]
    assumed = list(found.assumptions)
    if estimate.condition is None:
        kept += [c for c in dropped if "observer" in c.name]
        dropped = [c for c in dropped if c not in kept]
    signs = [c for c in dropped if not c.name.endswith("contracts")]
    if signs:
        assumed.append(
            Assumption("positivity", "declared", _names("not proved entry by entry", signs))
        )
    speeds = [c for c in dropped if c.name.endswith("contracts")]
    if speeds:
        assumed.append(
            Assumption(
                "sampling",
                "declared",
                _names(f"a period of {loop.period:g} s is taken as continuous", speeds),
            )
        )
    return attrs.evolve(
        found,
        assumptions=tuple(assumed),
        conditions=(*own, *kept),
        rate=rate if rate is not None else feedback.kappa,
        observer_rate=observer_rate if observer_rate is not None else estimate.rate,
    )


def _instead(
    loop: Loop, graph: GraphScalar, feedback: Feedback
) -> tuple[list[Condition] | None, float | None]:
    """Return quadratic conditions that take the place of C or T of the controller, and the rate."""
    if loop.period is None:
        return [], feedback.kappa
    gain = Fraction(repr(float(loop.phi))) * rational(feedback.K)
    proof = sampled_feedback(loop, gain, np.diag(feedback.V), graph, feedback.kappa)
    if proof is None:
        return None, None
    rate = -math.log(proof.factor) / loop.period
    return [sampled_condition("L: sampled loop contracts", proof, loop.period)], rate


def _instead_of_observer(
    loop: Loop, estimate: Estimate
) -> tuple[list[Condition] | None, float | None]:
    if loop.period is None:
        return [], estimate.rate
    proof = sampled_observer(loop)
    if proof is None:
        return None, None
    rate = -math.log(proof.factor) / loop.period
    return [sampled_condition("L: sampled observer contracts", proof, loop.period)], rate


def _names(text: str, dropped: list[Condition]) -> str:
    return f"{text}; not proved: " + ", ".join(c.name for c in dropped)
