"""Certificate D: the certified rate as a function of the delay, and what else a proof covers.

Own estimates are used at once, those of neighbours up to τ later. With ``|δ_j| ≤ c ν_j v e^{-λt}``
late neighbours count ``e^{λτ}`` times, so agent i is fed back

    ``w_i - (e^{λτ} - 1) Σ_j a_ij ν_j/ν_i``  in place of  ``w_i = (L_p ν)_i/ν_i``,

and λ is proved if certificate C (T) with the smallest of these proves the rate λ. As λ tends to
zero that is the condition without delay: every delay leaves a rate. In steps of a sampled loop
``e^{λτ}`` is ``r^{-k}``; k lost messages in a row, the last one received held, are a delay of k.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import attrs
import numpy as np

from posmas_fmi.certify.certificate import Delayed
from posmas_fmi.certify.contraction import continuous_rate
from posmas_fmi.certify.enclosure import point, typed
from posmas_fmi.certify.flow import Flow
from posmas_fmi.certify.loop import Feedback, Loop
from posmas_fmi.certify.proof import UNIT
from posmas_fmi.certify.sampled import sampled_factor
from posmas_fmi.certify.weights import Weights
from posmas_fmi.expression import Array
from posmas_fmi.network import Network

STEPS = (1, 2, 5, 10, 20, 50, 100)  # of delay, that a certificate tells the rate for
_TIMES = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)  # the same in continuous time, in units of 1/rate
_BISECTIONS = 20
_UP = 1 + 1e-12  # covers the rounding of a handful of operations


@attrs.frozen(eq=False)
class Rows:
    """What certificate D takes from the network, agent by agent.

    Attributes
    ----------
    held : (n,) array
        Lower bounds of ``(L_p ν)_i/ν_i``.
    near : (n,) array
        Upper bounds of ``Σ_j a_ij ν_j/ν_i``.
    """

    held: Array
    near: Array

    @classmethod
    def of(cls, network: Network, weights: Weights) -> Rows:
        """Rows of a network."""
        nu = weights.nu
        terms = int(np.diff(network.adjacency.indptr).max(initial=0)) + 4
        near = (network.adjacency @ nu) / nu * (1 + 4 * terms * UNIT)
        error = 4 * terms * UNIT * (abs(network.pinned_laplacian) @ nu)
        return cls((network.pinned_laplacian @ nu - error) / nu, near)


@attrs.frozen(eq=False)
class Slower:
    """A rate that is proved with late messages [1/s], zero if none is, and the v that proves it."""

    rate: float
    v: Array | None


def delayed_rate(loop: Loop, feedback: Feedback, rows: Rows, rate: float, delay: float) -> Slower:
    """Largest rate [1/s] that is proved where messages are up to `delay` old.

    Parameters
    ----------
    loop : Loop
        For which P holds.
    feedback : Feedback
    rows : Rows
        With the weights of the feedback.
    rate : float
        Proved without delay [1/s].
    delay : float
        [s]; a multiple of the period, where there is one.

    Returns
    -------
    Slower
    """
    if feedback.name == "observer" and loop.observer == "local":
        return Slower(rate, None)
    weak = _weakened(loop, feedback.name, rows)
    flow, h = Flow(loop.A_low, loop.A_high), loop.period

    def proved(wanted: float) -> Array | None:
        late = weak(math.exp(wanted * delay * _UP) * _UP)
        fed = attrs.evolve(feedback, weak=late)
        if h is None:
            found = continuous_rate(loop.A_high, fed)
            return None if found is None or found.value < wanted else found.v
        factor = sampled_factor(flow, fed, h)
        if factor is None or factor.value > math.exp(-wanted * h * _UP) / _UP:
            return None
        return factor.v

    low, high, best = 0.0, min(rate, 600 / delay), None
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        v = proved(middle)
        low, high, best = (low, middle, best) if v is None else (middle, high, v)
    return Slower(low, best)


def _weakened(loop: Loop, name: str, rows: Rows) -> Callable[[float], float]:
    """Return what the weakest agent is fed back, as a function of ``e^{λτ}``; a lower bound."""
    held, near = rows.held, rows.near
    coupling = typed(loop.phi if name == "controller" else loop.mu)
    ends = (loop.agent.m_l, loop.agent.m_h) if name == "controller" else (1.0, 1.0)

    def weak(factor: float) -> float:
        paid = near * max(factor - 1, 0.0) * _UP
        least = float((held - paid - 4 * UNIT * (np.abs(held) + paid)).min())
        return float((coupling * point(ends[0] if least >= 0 else ends[1]) * point(least)).low[0])

    return weak


def delayed_rates(
    loop: Loop,
    tracking: tuple[Feedback, Weights, float],
    estimation: tuple[Feedback, Weights, float],
) -> tuple[Delayed, ...]:
    """Rates for a few delays; each feedback with its weights and its rate without delay.

    A continuous loop is told for multiples of the time constant of its rate.
    """
    h, found = loop.period, []
    parts = [
        (feedback, Rows.of(loop.network, weights), rate)
        for feedback, weights, rate in (tracking, estimation)
    ]
    steps = STEPS if h is not None else tuple(0 for _ in _TIMES)
    delays = [k * h for k in STEPS] if h is not None else [t / tracking[2] for t in _TIMES]
    for k, delay in zip(steps, delays, strict=True):
        rates = [delayed_rate(loop, *part, delay).rate for part in parts]
        found.append(Delayed(delay, k or None, *rates))
    return tuple(found)


def statement(loop: Loop, proved: bool, delays: tuple[Delayed, ...] = ()) -> tuple[str, ...]:
    """Say in words what a proved certificate covers beyond the nominal loop."""
    if not proved:
        return ()
    low, high = loop.agent.sector
    covered = [
        f"every sector nonlinearity in [{low:g}, {high:g}], varying in time and per agent",
        "observers started at or below the states, 0 <= xhat(0) <= x(0), for positivity",
    ]
    what = (
        "arbitrary bounded, time-varying delays per arc and lost messages replaced by the "
        "last one received, own estimate undelayed: convergence and positivity stay; with a "
        "moving leader s(t) - s(t - tau) is an additive disturbance"
    )
    if loop.observer == "distributed":
        what += "; output errors of neighbours are as late as their estimates"
    covered.append(what)
    if delays:
        rates = ", ".join(
            f"{d.rate:.4g} 1/s at {d.delay:.4g} s" + (f" ({d.steps} periods)" if d.steps else "")
            for d in delays[::2]
        )
        covered.append(
            f"certified rate by the largest age of a message: {rates}; k lost messages in a row "
            "are k periods"
        )
    return tuple(covered)
