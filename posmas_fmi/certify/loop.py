"""The closed loop that a certificate is about, as two feedbacks around one agent.

With ``A ± |H|ℓ`` around the agent, controller and observer have one and the same form: agent i's
error obeys ``z_i' = (A + H G_i(t)) z_i - N g_i(t) Σ_j M_ij z_j`` with ``N ≥ 0`` (B|K| or EC), gains
``g_i`` in an interval and a matrix M (L_p, or I for a local observer). All certificates follow
from N, the smallest gain times ``λ = min_i (Mν)_i/ν_i`` and the largest gain times ``max M_ii``.
"""

from __future__ import annotations

from functools import cached_property
from typing import Literal

import attrs
import numpy as np

from posmas_fmi.agent import Agent
from posmas_fmi.certify.enclosure import magnitude, matmul, point, typed
from posmas_fmi.certify.weights import Weights, p_weights, perron_weights
from posmas_fmi.expression import Array
from posmas_fmi.interval import Interval
from posmas_fmi.network import Network

Kind = Literal["local", "distributed"]
Protocol = Literal["corrected", "printed"]


@attrs.frozen(eq=False)
class Feedback:
    """One feedback loop, reduced to what its certificates need.

    Attributes
    ----------
    name : {"controller", "observer"}
    N : (m, m) Interval
        B|K| or EC.
    weak, strong : float
        No agent is fed back less than ``weak·N`` in the weighted norm, nor more than
        ``strong·N`` on its own state; both are proved bounds.
    weakest, strongest : str
        Where these occur, for a person.
    """

    name: Literal["controller", "observer"]
    N: Interval
    weak: float
    strong: float
    weakest: str
    strongest: str


@attrs.frozen(eq=False)
class Loop:
    """Agents, network and gains.

    Parameters
    ----------
    agent : Agent
    network : Network
    K : (p, m) array
    E : (m, q) array
    phi, mu : float
    observer : {"local", "distributed"}
    protocol : {"corrected", "printed"}
    period : float, optional
        Control period h [s].
    """

    agent: Agent
    network: Network
    K: Array
    E: Array
    phi: float = 1.0
    mu: float = 1.0
    observer: Kind = "local"
    protocol: Protocol = "corrected"
    period: float | None = None

    @cached_property
    def A(self) -> Interval:
        """A as typed."""
        return typed(self.agent.A)

    @cached_property
    def H_ell(self) -> Interval:
        """``|H|ℓ``; infinite where ℓ is."""
        return _product(magnitude(typed(self.agent.H)), self.agent.ell)

    @cached_property
    def H_growth(self) -> Interval:
        """``|H| diag(c)`` with the growth bound c, or ``|H|ℓ`` where there is none."""
        c = self.agent.growth
        if np.isfinite(c).all():
            return _product(magnitude(typed(self.agent.H)), np.diag(c))
        return self.H_ell

    @cached_property
    def A_low(self) -> Interval:
        """``A - |H|ℓ``: lower bound of ``A + H G(t)``."""
        return self.A + -self.H_ell

    @cached_property
    def A_high(self) -> Interval:
        """``A + |H|ℓ``: upper bound of ``A + H G(t)``."""
        return self.A + self.H_ell

    @cached_property
    def EC(self) -> Interval:
        """Observer feedback."""
        return matmul(typed(self.E), typed(self.agent.C))

    @cached_property
    def BK(self) -> Interval:
        """``-BK``, equal to ``B|K|`` where K ≤ 0."""
        return matmul(typed(self.agent.B), -typed(self.K))

    @cached_property
    def weights(self) -> Weights:
        """Weights p."""
        return p_weights(self.network)

    @cached_property
    def weights_perron(self) -> Weights:
        """Perron vector of L_p."""
        return perron_weights(self.network)

    def controller(self, weights: Weights) -> Feedback:
        """Feedback φ K through the sector and L_p."""
        m_l, m_h = self.agent.m_l, self.agent.m_h
        gain = m_l if weights.rate >= 0 else m_h
        weak = (typed(self.phi) * point(gain) * point(weights.rate)).low[0]
        degree, at = _largest_degree(self.network)
        strong = (typed(self.phi) * point(m_h) * point(degree)).high[0]
        return Feedback("controller", self.BK, float(weak), float(strong), weights.weakest, at)

    def estimator(self, weights: Weights) -> Feedback:
        """Feedback E of the output errors: through I, or through μ L_p."""
        if self.observer == "local":
            return Feedback("observer", self.EC, 1.0, 1.0, "every agent", "every agent")
        weak = (typed(self.mu) * point(weights.rate)).low[0]
        degree, at = _largest_degree(self.network)
        strong = (typed(self.mu) * point(degree)).high[0]
        return Feedback("observer", self.EC, float(weak), float(strong), weights.weakest, at)


def _product(H: Interval, bound: Array) -> Interval:
    """``|H|`` times a non-negative bound that may be infinite."""
    if np.isfinite(bound).all():
        return matmul(H, point(bound))
    finite = matmul(H, point(np.where(np.isfinite(bound), bound, 0.0)))
    unbounded = ((H.high > 0).astype(float) @ np.isinf(bound).astype(float)) > 0
    return Interval(finite.low, np.where(unbounded, np.inf, finite.high))


def _largest_degree(network: Network) -> tuple[float, str]:
    """Upper bound of max (L_p)_ii and the agent where it occurs."""
    degrees = network.in_degree + network.pinning
    i = int(degrees.argmax())
    terms = int(np.diff(network.adjacency.indptr).max(initial=0)) + 2
    # weights are decimals and their sum is rounded: a relative error below (2·terms) u
    whole = bool((network.adjacency.data % 1 == 0).all() and (network.pinning % 1 == 0).all())
    bound = degrees[i] if whole else degrees[i] * (1.0 + 4e-16 * terms)
    pinned = ", pinned" if network.pinning[i] > 0 else ""
    return float(bound), f"agent {network.names[i]} (in-degree {network.in_degree[i]:g}{pinned})"
