"""Method "integral": distributed integral action, no offset under unequal constant loads.

``u = (M̂ ⊗ φK) δ + (I ⊗ K_q) q`` with ``q_i' = Σ_j M̂_ij C_z (x_j - s)`` is the pinned protocol of
the augmented agent ``[[A, 0], [C_z, 0]]``, ``[B; 0]``: route L proves it with small programs
whatever the number of agents (certificate I). It needs the *slope* of sec in the sector, and gives
up certificates P and D; use it for plants whose positivity is structural.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from contextlib import suppress

import attrs
import numpy as np

from posmas_fmi.agent import Agent
from posmas_fmi.certify import Loop, baseline, certify_loop
from posmas_fmi.certify.certificate import Certificate
from posmas_fmi.certify.diverging import divergence
from posmas_fmi.certify.quadratic import GraphScalar, lipschitz_norm, step_of, symmetric_scalar
from posmas_fmi.design.certified import checked_gains, loop_of
from posmas_fmi.design.contraction import observer_gain
from posmas_fmi.design.graph_scalar import graph_scalar
from posmas_fmi.design.integral_certificate import certificate, refuting
from posmas_fmi.design.integral_gains import (
    IntegralDesign,
    exact_gain,
    halvings,
    integral_design,
    nothing,
)
from posmas_fmi.design.integral_given import as_designed, guessed, judged, no_graph
from posmas_fmi.design.result import Baseline, Design
from posmas_fmi.design.sampled import sampled_gain
from posmas_fmi.design.settings import DesignSettings
from posmas_fmi.errors import DesignError, InputError
from posmas_fmi.expression import Array
from posmas_fmi.network import Network


def design(
    agent: Agent, network: Network, settings: DesignSettings, period: float | None
) -> Design:
    """Design K, K_q and E: the fastest rate, or the least gain for the rate that is asked for."""
    network.require_reached()
    agent = incremental(agent)
    C_z, names = integrated(agent, settings)
    found: tuple[IntegralDesign, Loop, Certificate] | None = None
    weak = 0.0
    for graph in graphs_of(agent, network):
        weak = max(weak, graph.value)
        if period is not None and graph.value > 0:
            sampled = _sampled(agent, network, settings, period, graph, C_z)
            if sampled is not None:
                return _result(settings, *sampled, names)
        for rate in _rates(agent, settings) if graph.value > 0 else ():
            with suppress(DesignError):
                made = integral_design(agent, graph, C_z, rate, settings.phi, settings.digits)
                loop = _with_observer(agent, network, settings, period, made.K, rate)
                gain = exact_gain(settings.phi, made.K, made.K_q).astype(float)
                if divergence(loop, gain, C_z) is not None:
                    continue  # good in continuous time only
                tried = certificate(loop, made, C_z)
                if period is None or not any(a.name == "sampling" for a in tried.assumptions):
                    return _result(settings, made, loop, tried, names)
                found = found or (made, loop, tried)
        if found is not None:
            break
    if found is None:
        wanted = "any rate that was tried" if settings.rate is None else f"{settings.rate:.4g} 1/s"
        raise DesignError(
            f"no quadratic integral design has {wanted} (graph scalar {weak:.4g}); what helps: a "
            "lower rate, a narrower sector, more pins, an undirected network (there the width of "
            "the sector costs nothing), other outputs to integrate ($.design.integrates)",
            "$.design.rate" if settings.rate else "$.design",
        )
    return _result(settings, *found, names)


def _sampled(
    agent: Agent,
    network: Network,
    settings: DesignSettings,
    period: float,
    graph: GraphScalar,
    C_z: Array,
) -> tuple[IntegralDesign, Loop, Certificate] | None:
    """Fastest gains that are proved for the sampled loop itself."""
    bare = loop_of(
        agent, network, np.zeros((agent.p, agent.m)), np.zeros((agent.m, agent.q)), settings, period
    )
    step = step_of(bare, C_z)
    if step is None:
        return None
    for rate in _rates(agent, settings):
        factor = math.exp(-rate * period)
        made = sampled_gain(step, graph, factor, settings.phi, agent.m, settings.digits)
        if made is None:
            continue
        gain, proof = made
        K, K_q = gain[:, : agent.m], gain[:, agent.m :]
        loop = _with_observer(agent, network, settings, period, K, rate)
        shown = IntegralDesign(K, K_q, proof.P, rate * (1 - 1e-14), graph, proof.proof)
        return shown, loop, certificate(loop, shown, C_z, proof)
    return None


def certify(
    agent: Agent, network: Network, settings: DesignSettings, period: float | None
) -> Design:
    """Prove given gains K, K_q and E; V is found by a small program."""
    assert settings.K is not None
    assert settings.E is not None
    assert settings.K_q is not None
    agent = incremental(agent)
    C_z, names = integrated(agent, settings)
    K, E = checked_gains(agent, settings.K, settings.E)
    if settings.K_q.shape != (agent.p, len(C_z)):
        raise InputError(
            f"expected a matrix of shape {(agent.p, len(C_z))}, one column per integrated output "
            f"(got {settings.K_q.shape})",
            "$.design.K_q",
        )
    loop = loop_of(agent, network, K, E, settings, period)
    if network.unreached() or loop.protocol == "printed":
        failed = IntegralDesign(K, settings.K_q, np.eye(1), 0.0, no_graph(), nothing())
        return _result(settings, failed, loop, certify_loop(loop), names)
    if period is not None:
        gain = exact_gain(settings.phi, K, settings.K_q)
        diverges = divergence(loop, gain.astype(float), C_z)
        if diverges is not None:
            refuted = IntegralDesign(K, settings.K_q, np.eye(1), 0.0, no_graph(), nothing())
            return _result(settings, refuted, loop, refuting(loop, diverges), names)
        step = step_of(loop, C_z)
        for graph in graphs_of(agent, network):
            if step is None:
                break
            proof = as_designed(step, gain, graph, loop, settings)
            proof = proof or guessed(step, gain, graph, loop, C_z)
            if proof is not None:
                rate = -math.log(proof.factor) / period * (1 - 1e-14)
                shown = IntegralDesign(K, settings.K_q, proof.P, rate, graph, proof.proof)
                return _result(settings, shown, loop, certificate(loop, shown, C_z, proof), names)
    made = judged(agent, graphs_of(agent, network), C_z, K, settings.K_q, settings)
    return _result(settings, made, loop, certificate(loop, made, C_z), names)


def incremental(agent: Agent) -> Agent:
    """Return the agent with the slopes of sec as its sector, where they are known."""
    return agent if agent.slope is None else attrs.evolve(agent, sector=agent.slope)


def integrated(agent: Agent, settings: DesignSettings) -> tuple[Array, tuple[str, ...]]:
    """Rows of C that are integrated, and the names of these outputs.

    Raises
    ------
    InputError
        If an output is unknown, or there are more of them than inputs to hold them.
    """
    known = [f"y{k + 1}" for k in range(agent.q)]
    names = settings.integrates or tuple(known[: agent.p] if agent.q <= agent.p else known[-1:])
    for name in names:
        if name not in known:
            raise InputError(
                f"expected outputs out of {', '.join(known)} (got {name!r})", "$.design.integrates"
            )
    if len(set(names)) < len(names) or len(names) > agent.p:
        raise InputError(
            f"expected at most {agent.p} different outputs, one per input (got {list(names)})",
            "$.design.integrates",
        )
    return agent.C[[known.index(name) for name in names]], names


def graphs_of(agent: Agent, network: Network) -> Iterator[GraphScalar]:
    """Graph scalars to try: of an undirected network the one that any sector suits comes first."""
    sector = (agent.m_l, agent.m_h)
    symmetric = symmetric_scalar(network, sector)
    if symmetric is not None:
        yield symmetric
    if symmetric is None or lipschitz_norm(agent) > 0:
        with suppress(DesignError):
            yield graph_scalar(network, sector)


def _rates(agent: Agent, settings: DesignSettings) -> Iterable[float]:
    return halvings(agent) if settings.rate is None else (settings.rate,)


def _with_observer(
    agent: Agent,
    network: Network,
    settings: DesignSettings,
    period: float | None,
    K: Array,
    rate: float,
) -> Loop:
    E = observer_gain(agent, network, settings, period, rate)
    return loop_of(agent, network, K, E, settings, period)


def _result(
    settings: DesignSettings,
    made: IntegralDesign,
    loop: Loop,
    certificate: Certificate,
    names: tuple[str, ...],
) -> Design:
    free = baseline(loop)
    notes: tuple[str, ...] = ()
    if certificate.certified == "no" and settings.method == "gains":
        notes = ('method = "integral" finds gains that are proved, where there are any',)
    return Design(
        method=settings.method,
        observer=settings.observer,
        phi=settings.phi,
        mu=settings.mu,
        K=made.K,
        E=loop.E,
        network=loop.network,
        certificate=certificate,
        baseline=Baseline(free is not None and free > 0, free),
        protocol=settings.protocol,
        form=settings.form,
        K_q=made.K_q,
        integrates=names,
        notes=notes,
    )
