"""Gains as they ship: the loop that they close, and the certificate about exactly these numbers."""

from __future__ import annotations

import numpy as np

from posmas_fmi.agent import Agent
from posmas_fmi.certify import Loop, baseline, certify_loop
from posmas_fmi.design.result import Baseline, Design
from posmas_fmi.design.settings import DesignSettings
from posmas_fmi.errors import InputError
from posmas_fmi.expression import Array
from posmas_fmi.network import Network


def checked_gains(agent: Agent, K: Array, E: Array) -> tuple[Array, Array]:
    """Return gains as matrices of the right shape.

    Raises
    ------
    InputError
        If they are none.
    """
    K, E = np.atleast_2d(np.asarray(K, dtype=float)), np.atleast_2d(np.asarray(E, dtype=float))
    for name, value, shape, words in (
        ("K", K, (agent.p, agent.m), "(p, m), one row per input"),
        ("E", E, (agent.m, agent.q), "(m, q), one row per state"),
    ):
        if value.shape != shape:
            raise InputError(
                f"expected a matrix of shape {shape}, that is {words} (got {value.shape})",
                f"$.design.{name}",
            )
    return K, E


def loop_of(
    agent: Agent,
    network: Network,
    K: Array,
    E: Array,
    settings: DesignSettings,
    period: float | None,
) -> Loop:
    """Return the closed loop with these gains."""
    return Loop(
        agent,
        network,
        K,
        E,
        phi=settings.phi,
        mu=settings.mu,
        observer=settings.observer,
        protocol=settings.protocol,
        period=period,
    )


def certified(
    agent: Agent,
    network: Network,
    K: Array,
    E: Array,
    settings: DesignSettings,
    period: float | None,
    notes: tuple[str, ...] = (),
) -> Design:
    """Return gains with the certificate that is proved about exactly these numbers."""
    K, E = checked_gains(agent, K, E)
    if period is not None and not 0.0 < period < np.inf:
        raise InputError(f"expected a period > 0 s (got {period!r})", "$.scenario.period")
    loop = loop_of(agent, network, K, E, settings, period)
    free = baseline(loop)
    disturbance = None if settings.disturbance is None else np.array(settings.disturbance)
    if disturbance is not None and disturbance.shape != (agent.m,):
        raise InputError(
            f"expected {agent.m} bounds, one per state (got {disturbance.size})",
            "$.design.disturbance",
        )
    return Design(
        method=settings.method,
        observer=settings.observer,
        phi=settings.phi,
        mu=settings.mu,
        K=K,
        E=E,
        network=network,
        certificate=certify_loop(loop, settings.weights, settings.saturation, disturbance),
        baseline=Baseline(free is not None and free > 0, free),
        protocol=settings.protocol,
        form=settings.form,
        notes=notes,
    )
