"""Gains: one module per method, all behind `design`; given gains are judged by `certify`."""

from __future__ import annotations

from importlib import import_module

import attrs
import numpy as np

from posmas_fmi.agent import Agent
from posmas_fmi.design.result import Baseline, Design
from posmas_fmi.design.settings import METHODS, DesignSettings, Method
from posmas_fmi.errors import AgentError, NotBuiltError
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


LARGEST = 1e12  # of an entry of A, H, B or C times the period: beyond it nothing can be computed


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
    AgentError
        If a matrix has an entry with which nothing can be computed.

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
    if settings.method != "gains":  # given gains are judged whatever they are for
        _check_sizes(agent, period)
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


def _check_sizes(agent: Agent, period: float | None) -> None:
    """Name an entry that is far beyond what the period, or doubles, can take."""
    for name in "AHBC":
        entries = np.abs(getattr(agent, name)) * (period or 1.0)
        if entries.max(initial=0.0) > LARGEST:
            i, j = (int(k) for k in np.unravel_index(entries.argmax(), entries.shape))
            raise AgentError(
                f"expected entries up to {LARGEST:g}, counted per control period (got "
                f"{getattr(agent, name)[i, j]:g}): correct it, or take other units or a shorter "
                "period",
                f"$.agent.{name}[{i}][{j}]",
            )


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
