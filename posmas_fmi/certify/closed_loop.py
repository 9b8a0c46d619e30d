"""The certificate of a closed loop: P, and T where there is a control period, else C."""

from __future__ import annotations

import math
from typing import Literal

import attrs
import numpy as np

from posmas_fmi.certify import general
from posmas_fmi.certify.assumptions import assumptions
from posmas_fmi.certify.band import guaranteed_band
from posmas_fmi.certify.certificate import Certificate, Condition, Delayed
from posmas_fmi.certify.contraction import Rate, continuous_rate
from posmas_fmi.certify.delay import delayed_rates, statement
from posmas_fmi.certify.diverging import divergence
from posmas_fmi.certify.flow import Flow
from posmas_fmi.certify.loop import Feedback, Loop
from posmas_fmi.certify.positivity import between_samples, gain_sign, metzler, non_positive_gain
from posmas_fmi.certify.sampled import contracts, rate_of, sampled_factor
from posmas_fmi.certify.saturation import Contraction, region_of_attraction
from posmas_fmi.certify.weights import Weights
from posmas_fmi.expression import Array
from posmas_fmi.network import Network

Choice = Literal["auto", "p", "perron"]


def certify_loop(
    loop: Loop,
    weights: Choice = "auto",
    saturation: float | None = None,
    disturbance: Array | None = None,
) -> Certificate:
    """Prove what can be proved about given gains.

    Parameters
    ----------
    loop : Loop
    weights : {"auto", "p", "perron"}
        Agents' weights in the norm: p, the Perron vector of L_p, or p and, where p proves no rate,
        the Perron vector.
    saturation : float, optional
        Limit of ``|u|``: adds the certified region of attraction (R).
    disturbance : (m,) array, optional
        Bound on what is added to each state's derivative: adds the guaranteed band (G).

    Returns
    -------
    Certificate
        With every condition, failed ones included; gains that do not work do not raise.
    """
    unreached = loop.network.unreached()
    if unreached or loop.protocol == "printed":
        return _not_held(loop, unreached)
    plain, sharp = loop.weights, loop.weights_perron
    observer = Prover(loop, loop.estimator(sharp), sharp)
    best = Prover(loop, loop.controller(sharp), sharp)
    controller, chosen = best, sharp
    if weights != "perron":
        simple = Prover(loop, loop.controller(plain), plain, best.signs)
        if simple.rate is not None or weights == "p":
            controller, chosen = simple, plain
    conditions = (
        m_matrix(loop.network, chosen),
        *observer.signs,
        *controller.signs,
        observer.contracts,
        _or_refuted(controller.contracts, loop),
    )
    holds = all(c.holds for c in conditions)
    delays: tuple[Delayed, ...] = ()
    if holds and loop.network.adjacency.nnz:
        delays = delayed_rates(loop, controller.proved_rate, observer.proved_rate)
    band = guaranteed_band(loop, disturbance) if holds and disturbance is not None else None
    region = None
    if holds and saturation is not None:
        region = region_of_attraction(
            loop, controller.contraction, observer.contraction, saturation
        )
    return Certificate(
        assumptions=assumptions(loop),
        conditions=conditions,
        rate=controller.rate,
        observer_rate=observer.rate,
        positive=observer.positive and controller.positive,
        p_max=loop.network.p_max,
        period=loop.period,
        rate_perron=best.rate,
        rate_continuous=best.continuous,
        observer_rate_continuous=observer.continuous,
        covers=statement(loop, holds, delays),
        delays=delays,
        region_of_attraction=region,
        band=None if band is None else tuple(tuple(float(z) for z in row) for row in band),
    )


class Prover:
    """Everything about one feedback: its signs, its contraction, its rates.

    Parameters
    ----------
    loop : Loop
    feedback : Feedback
    weights : Weights
        Those of the feedback.
    signs : tuple of Condition, optional
        Conditions P and T on signs, where they are known already.
    """

    def __init__(
        self,
        loop: Loop,
        feedback: Feedback,
        weights: Weights,
        signs: tuple[Condition, ...] | None = None,
    ) -> None:
        self.loop, self.feedback, self.weights = loop, feedback, weights
        self.flow = Flow(loop.A_low, loop.A_high)
        self.signs = self._signs() if signs is None else signs  # they do not depend on weights
        self.positive = all(c.holds for c in self.signs)
        continuous = self._continuous()
        self.continuous = None if continuous is None else continuous.value
        proved = continuous
        if loop.period is None:
            self.contracts = _continuous_condition(continuous, feedback, self.positive)
            rate = None if continuous is None or continuous.value <= 0 else continuous.value
        else:
            proved = factor = self._factor()
            self.contracts = contracts(factor, feedback, loop.period, self.positive)
            rate = rate_of(factor, loop.period)
        self.rate = rate
        self.v = None if proved is None else proved.v

    @property
    def contraction(self) -> Contraction:
        """What certificate R takes from a feedback that contracts."""
        assert self.v is not None
        assert self.rate is not None
        local = self.feedback.name == "observer" and self.loop.observer == "local"
        nu = np.ones_like(self.weights.nu) if local else self.weights.nu
        return Contraction(nu, self.v, self.rate)

    @property
    def proved_rate(self) -> tuple[Feedback, Weights, float]:
        """What certificate D takes from a feedback that contracts."""
        assert self.rate is not None
        return self.feedback, self.weights, self.rate

    @property
    def proved(self) -> bool:
        """Whether signs and contraction are both proved."""
        return self.positive and self.contracts.holds

    def _signs(self) -> tuple[Condition, ...]:
        loop, feedback = self.loop, self.feedback
        found = [gain_sign(feedback), metzler(loop, feedback)]
        if feedback.name == "controller":
            found.insert(0, non_positive_gain(loop))
        if loop.period is not None:
            found.append(between_samples(self.flow, feedback, loop.period))
        return tuple(found)

    def _continuous(self) -> Rate | None:
        if self.positive:
            return continuous_rate(self.loop.A_high, self.feedback)
        return general.continuous_rate(self.loop, self.feedback.name, self.weights)

    def _factor(self) -> Rate | None:
        assert self.loop.period is not None
        if self.positive:
            return sampled_factor(self.flow, self.feedback, self.loop.period)
        return general.sampled_factor(self.loop, self.feedback.name, self.weights)


def _or_refuted(condition: Condition, loop: Loop) -> Condition:
    """Look for a loop that diverges, where contraction is neither proved nor refuted."""
    if condition.holds or condition.refuted:
        return condition
    found = divergence(loop, loop.phi * loop.K)
    if found is None:
        return condition
    return attrs.evolve(condition, refuted=True, proof=f"{condition.proof}; {found}")


def m_matrix(network: Network, weights: Weights) -> Condition:
    """L_p is a non-singular M-matrix: some ν > 0 has ``L_p ν > 0``."""
    return Condition.from_margin(
        "network: L + D is a non-singular M-matrix",
        weights.rate,
        f"nu > 0 with (L + D) nu >= {weights.rate:.9g} nu, rounding error bounded",
        f"p_max = {network.p_max:.6g}; weakest at {weights.weakest}",
    )


def _continuous_condition(rate: Rate | None, feedback: Feedback, positive: bool) -> Condition:
    name = f"C: {feedback.name} contracts"
    if rate is None:
        return Condition(name, False, -math.inf, "no finite Lipschitz bound of g", "")
    form = "positive form" if positive else "entrywise moduli, as P does not hold"
    return Condition.from_margin(
        name,
        rate.value,
        f"rho = {rate.estimate:.9g}, proved rho >= {rate.value:.9g} 1/s "
        f"with v = [{', '.join(f'{x:.6g}' for x in rate.v)}], {form}, interval arithmetic",
        f"weakest at {feedback.weakest}",
        rate.refuted,
    )


def _not_held(loop: Loop, unreached: tuple[int, ...]) -> Certificate:
    """Certificate of a loop that the leader does not hold: it names why, and proves nothing."""
    network = loop.network
    if loop.protocol == "printed":
        d = float(network.pinning.sum())
        condition = Condition(
            "network: L - D is a non-singular M-matrix",
            False,
            -float(network.pinning.max(initial=0.0)),
            "(L - D) 1 = -d <= 0, but a non-singular M-matrix has a non-negative inverse, which "
            "would give 1 = -(L - D)^-1 d <= 0; exact",
            "errata 1 and 2: with the printed sign the pinned agent is pushed away from the "
            f'leader (sum of d = {d:g}); use protocol = "corrected"',
            refuted=True,
        )
    else:
        names = ", ".join(network.names[i] for i in unreached[:10])
        condition = Condition(
            "network: L + D is a non-singular M-matrix",
            False,
            -1.0,
            "the rows of L + D of the agents that the leader does not reach sum to zero over "
            "these agents: singular; exact",
            f"no path from the leader to agent(s) {names}",
            refuted=True,
        )
    return Certificate(
        assumptions=assumptions(loop),
        conditions=(condition,),
        rate=None,
        observer_rate=None,
        positive=False,
        p_max=None if unreached else network.p_max,
        period=loop.period,
    )


def baseline(loop: Loop) -> float | None:
    """Best rate of certificate C with K = 0 [1/s]; negative where the plant does not contract."""
    idle = attrs.evolve(loop, K=np.zeros_like(loop.K))
    rate = continuous_rate(loop.A_high, Feedback("controller", idle.BK, 0.0, 0.0, "", ""))
    return None if rate is None else rate.value
