"""Certificate I: what is proved of the integral protocol, and on which assumptions."""

from __future__ import annotations

import math

import numpy as np
import sympy

from posmas_fmi.agent import Agent, Assumption
from posmas_fmi.certify import Loop
from posmas_fmi.certify.assumptions import assumptions
from posmas_fmi.certify.certificate import Certificate, Condition
from posmas_fmi.certify.closed_loop import Prover, m_matrix
from posmas_fmi.certify.diverging import Divergence
from posmas_fmi.certify.quadratic import SampledProof
from posmas_fmi.certify.weights import Weights
from posmas_fmi.design.integral_gains import IntegralDesign, exact_gain
from posmas_fmi.design.sampled import sampled_condition, sampled_feedback, sampled_observer
from posmas_fmi.expression import Array, VectorFunction, symbol
from posmas_fmi.interval import bounds

_GRID = 2001  # points at which the slope of sec is looked at


def certificate(
    loop: Loop, made: IntegralDesign, C_z: Array, sampled: SampledProof | None = None
) -> Certificate:
    """Put what is proved together; what is neither proved nor refuted is an assumption."""
    agent, h, graph = loop.agent, loop.period, made.graph
    weights = loop.weights_perron
    conditions = [
        m_matrix(loop.network, weights),
        Condition.from_margin(
            "I: graph scalar",
            graph.value if graph.kind == "symmetric" else graph.proof.bound,
            f"gamma_0 = {graph.value:.9g} (W {graph.kind}): {graph.proof}",
        ),
    ]
    if sampled is None:
        conditions.append(
            Condition.from_margin(
                "I: feedback with integral contracts",
                made.proof.bound,
                f"kappa = {made.kappa:.9g} 1/s: {made.proof}"
                if made.proof.positive
                else made.proof.method,
            )
        )
    else:
        assert h is not None
        conditions.append(sampled_condition("I: sampled loop contracts", sampled, h))
    found = [*assumptions(loop), slope_assumption(agent)]
    rate: float | None = made.kappa if made.proof.positive else None
    if h is not None and rate is not None and sampled is None:
        gain = exact_gain(loop.phi, made.K, made.K_q)
        proof = sampled_feedback(loop, gain, made.V, graph, rate, C_z)
        if proof is None:
            found.append(
                Assumption(
                    "sampling",
                    "declared",
                    f"a period of {h:g} s is taken as continuous: no quadratic proof of the "
                    "sampled loop was found; a shorter period or a lower rate helps",
                )
            )
        else:
            conditions.append(sampled_condition("I: sampled loop contracts", proof, h))
            rate = -math.log(proof.factor) / h
    contracts, observer_rate, continuous = _observer(loop, weights)
    conditions.append(contracts)
    return Certificate(
        assumptions=tuple(found),
        conditions=tuple(conditions),
        rate=rate,
        observer_rate=observer_rate,
        positive=False,
        p_max=loop.network.p_max,
        period=h,
        rate_continuous=made.kappa if sampled is None and made.proof.positive else None,
        observer_rate_continuous=continuous,
        covers=_covers(agent) if all(c.holds for c in conditions) else (),
    )


def _observer(loop: Loop, weights: Weights) -> tuple[Condition, float | None, float | None]:
    """Contraction of the observer, its rate, and that of the continuous one."""
    observer = Prover(loop, loop.estimator(weights), weights)
    if not observer.contracts.holds and loop.period is not None:
        proof = sampled_observer(loop)
        if proof is not None:
            condition = sampled_condition("I: sampled observer contracts", proof, loop.period)
            return condition, -math.log(proof.factor) / loop.period, observer.continuous
    return observer.contracts, observer.rate, observer.continuous


def refuting(loop: Loop, diverges: Divergence) -> Certificate:
    """Certificate of gains with which a loop inside the claim is proved not to converge."""
    weights = loop.weights_perron
    observer = Prover(loop, loop.estimator(weights), weights)
    return Certificate(
        assumptions=(*assumptions(loop), slope_assumption(loop.agent)),
        conditions=(
            m_matrix(loop.network, weights),
            Condition(
                "I: sampled loop contracts", False, 1 - diverges.factor, str(diverges), refuted=True
            ),
            observer.contracts,
        ),
        rate=None,
        observer_rate=observer.rate,
        positive=False,
        p_max=loop.network.p_max,
        period=loop.period,
    )


def _covers(agent: Agent) -> tuple[str, ...]:
    low, high = agent.m_l, agent.m_h
    return (
        f"every nonlinearity with slopes in [{low:g}, {high:g}], per agent; within a period the "
        "input's effect is that of the state at its start",
        "constant loads, unequal from agent to agent: what is integrated has no offset",
        "not covered: delays and losses of messages (a run with them is evidence only), "
        "saturation that the integrals wind up against, and positivity, which has to be structural",
    )


def slope_assumption(agent: Agent) -> Assumption:
    """Whether the sector bounds the slope of sec, which integral action needs."""
    if not isinstance(agent.sec, VectorFunction):
        return Assumption("slope", "declared", "sec is no expression: its slope is not known")
    low, high = agent.m_l, agent.m_h
    if agent.slope is not None and low <= agent.slope[0] and agent.slope[1] <= high:
        known = "[{:.6g}, {:.6g}]".format(*agent.slope)
        return Assumption(
            "slope", "verified", f"[{low:.6g}, {high:.6g}] holds d sec/du in {known}, closed form"
        )
    texts, statuses = [], []
    for k, expr in enumerate(agent.sec.expressions):
        name = f"u{k + 1}"
        region = agent.region.get(name, (-math.inf, math.inf))
        found = bounds(sympy.diff(expr, symbol(name)), {name: region}, (low, high))
        slack = 1e-9 * high
        if found.low >= low - slack and found.high <= high + slack:
            statuses.append("verified")
            texts.append(f"d sec/d{name} in [{found.low:.6g}, {found.high:.6g}]")
            continue
        least, most = _secants(agent, k, region)
        beyond = least < low * (1 - 1e-6) or most > high * (1 + 1e-6)
        statuses.append("contradicted" if beyond else "declared")
        texts.append(f"quotients of differences of sec({name}) in [{least:.6g}, {most:.6g}]")
    detail = f"[{low:g}, {high:g}] declared for the slope of sec; {'; '.join(texts)}"
    for status in ("contradicted", "declared"):
        if status in statuses:
            return Assumption("slope", status, detail)
    return Assumption("slope", "verified", detail)


def _secants(agent: Agent, k: int, region: tuple[float, float]) -> tuple[float, float]:
    """Least and largest quotient of differences on a grid: slopes are attained between."""
    low, high = (
        math.copysign(min(abs(end), 100.0), end) if math.isinf(end) else end for end in region
    )
    u = np.zeros((_GRID, agent.p))
    u[:, k] = np.linspace(low, high, _GRID)
    values = agent.sec_numpy(u)[:, k]
    slopes = np.diff(values) / np.diff(u[:, k])
    return float(slopes.min()), float(slopes.max())
