"""Certificate T: the sampled loop, with input and innovation held over the control period h.

Over one period the error of the weakest agent is multiplied by at most
``e^{A_high h} - weak·Γ(A_low) N``, where ``Γ(M) = ∫₀^h e^{Mτ} dτ`` and `certify.positivity` proves
that no entry is below zero. A positive v with ``(…) v ≤ r v``, r < 1, proves the rate -ln(r)/h.
"""

from __future__ import annotations

import math

import numpy as np

from posmas_fmi.certify.certificate import Condition
from posmas_fmi.certify.contraction import Rate, perron_vector
from posmas_fmi.certify.enclosure import matmul, point
from posmas_fmi.certify.flow import Flow
from posmas_fmi.certify.loop import Feedback


def sampled_factor(flow: Flow, feedback: Feedback, h: float) -> Rate | None:
    """Prove ``r`` for one feedback.

    Returns
    -------
    Rate or None
        With `value` the proved r per sample; None where certificate P does not hold.
    """
    if not flow.metzler or not (feedback.N.low >= 0).all():
        return None
    _, growth, held_low, held_high = flow.over(h)
    # a negative gain (the leader does not hold the network) drives apart through the upper bound
    held = held_low if feedback.weak >= 0 else held_high
    T = growth + -(matmul(held, feedback.N) * point(feedback.weak))
    v = perron_vector(T.high)
    value = matmul(T, point(v[:, None])).high[:, 0]
    bound = float(np.nextafter(value / v, np.inf).max())
    estimate = float(np.abs(np.linalg.eigvals(T.high)).max())
    if not math.isfinite(bound):
        return None
    # Collatz-Wielandt: no v gives less than the smallest quotient of this one
    least = np.nextafter(matmul(T, point(v[:, None])).low[:, 0] / v, -np.inf).min()
    return Rate(bound, estimate, v, bool((T.low >= 0).all() and least >= 1))


def rate_of(factor: Rate | None, h: float) -> float | None:
    """``-ln(r)/h`` [1/s], rounded down; None unless r < 1."""
    if factor is None or not 0.0 <= factor.value < 1.0:
        return None
    if factor.value == 0.0:
        return math.inf
    return -math.log(factor.value) / h * (1 - 1e-15) - 1e-300


def contracts(factor: Rate | None, feedback: Feedback, h: float, positive: bool) -> Condition:
    """State r < 1 as a condition."""
    name = f"T: {feedback.name} contracts"
    if factor is None:
        return Condition(name, False, -math.inf, "no finite bound over one period", "")
    form = "positive form" if positive else "entrywise moduli, as P does not hold"
    rate = rate_of(factor, h)
    speed = "no rate" if rate is None else f"rate >= {rate:.6g} 1/s"
    weights = ", ".join(f"{x:.6g}" for x in factor.v)
    return Condition.from_margin(
        name,
        1.0 - factor.value,
        f"r = {factor.estimate:.9g}, proved r <= {factor.value:.9g} per period of {h:g} s "
        f"({speed}) with v = [{weights}], {form}, interval arithmetic",
        f"weakest at {feedback.weakest}",
        factor.refuted,
    )
