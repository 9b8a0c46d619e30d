"""Gains: one module per method, all behind `design`; given gains are judged by `certify`."""

from __future__ import annotations

from importlib import import_module

import attrs

from posmas_fmi.agent import Agent
from posmas_fmi.design.result import Baseline, Design
from posmas_fmi.design.settings import METHODS, DesignSettings, Method
from posmas_fmi.errors import NotBuiltError
from posmas_fmi.expression import Array
from posmas_fmi.network import Network

__all__ = ["METHODS", "Baseline", "Design", "DesignSettings", "Method", "certify", "design"]

_MODULES: dict[Method, str] = {
    "contraction": "contraction",
    "lmi": "lmi",
    "integral": "integral",
    "paper-1": "paper",
    "paper-2": "paper",
    "gains": "gains",
}


def design(
    agent: Agent, network: Network, settings: DesignSettings, period: float | None = None
) -> Design:
    """Find gains with the method asked for, and prove what they do.

    Parameters
    ----------
    agent : Agent
        Model (1).
    network : Network
        The digraph with its pinning.
    settings : DesignSettings
        The method and what is wanted.
    period : float, optional
        Control period h [s]; without it the controller is taken as continuous.

    Returns
    -------
    Design

    Raises
    ------
    NetworkError
        If the leader does not reach every agent.
    DesignError
        If the method finds no gains, saying what clashes, where, and what would help.

    Examples
    --------
    >>> from posmas_fmi.agent import linear_agent
    >>> from posmas_fmi.network import network_from_arcs
    >>> tank = linear_agent([[-0.1]], [[1.0]], [[1.0]])
    >>> line = network_from_arcs(2, [(1, 2)], pinned=[1])
    >>> made = design(tank, line, DesignSettings(), period=0.1)
    >>> made.certificate.certified, made.certificate.positive
    ('yes', True)
    """
    try:
        method = import_module(f"posmas_fmi.design.{_MODULES[settings.method]}")
    except ModuleNotFoundError as error:
        if error.name is None or not error.name.startswith("posmas_fmi.design."):
            raise
        raise NotBuiltError(
            f"method {settings.method!r} is not in this version", "$.design.method"
        ) from None
    found: Design = method.design(agent, network, settings, period)
    return found


def certify(
    agent: Agent,
    network: Network,
    K: Array,
    E: Array,
    settings: DesignSettings,
    period: float | None = None,
    K_q: Array | None = None,
) -> Design:
    """Certificate for given gains; conditions that fail give ``"no"``, not an exception.

    Parameters
    ----------
    agent, network, settings, period
        As for `design`.
    K : (p, m) array_like
    E : (m, q) array_like
    K_q : (p, k) array_like, optional
        Gain of the integrals of ``settings.integrates``: certificate I in place of P, C and T.

    Returns
    -------
    Design

    Raises
    ------
    InputError
        If a gain has the wrong shape.
    """
    given = attrs.evolve(settings, method="gains", K=K, E=E, K_q=K_q)
    return design(agent, network, given, period)
