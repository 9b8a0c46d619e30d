"""Method "gains": nothing is designed, the given K and E are certified."""

from __future__ import annotations

import attrs

from posmas_fmi.agent import Agent
from posmas_fmi.design import integral
from posmas_fmi.design.certified import certified, loop_of
from posmas_fmi.design.explain import remedies
from posmas_fmi.design.result import Design
from posmas_fmi.design.settings import DesignSettings
from posmas_fmi.network import Network


def design(
    agent: Agent, network: Network, settings: DesignSettings, period: float | None
) -> Design:
    """Certify ``settings.K`` and ``settings.E``; say what would help where that fails."""
    assert settings.K is not None, "settings check it"
    assert settings.E is not None, "settings check it"
    if settings.K_q is not None:
        return integral.certify(agent, network, settings, period)
    made = certified(agent, network, settings.K, settings.E, settings, period)
    if made.certificate.certified != "no":
        return made
    return attrs.evolve(
        made, notes=remedies(loop_of(agent, network, made.K, made.E, settings, period))
    )
