"""Method "contraction", for most uses: K and E by linear programs, proved by certificates P and T.

Feedback K is as strong as positivity allows; E is the least gain that estimates ten times as fast
as the network tracks, or as fast as one asks for.
"""

from __future__ import annotations

import attrs
import numpy as np

from posmas_fmi.agent import Agent
from posmas_fmi.certify import Loop
from posmas_fmi.certify.closed_loop import Prover
from posmas_fmi.certify.loop import Feedback
from posmas_fmi.design.certified import certified
from posmas_fmi.design.explain import clash
from posmas_fmi.design.program import Problem, Solution, alternate
from posmas_fmi.design.result import Design
from posmas_fmi.design.rounding import nearest, towards_zero
from posmas_fmi.design.settings import DesignSettings
from posmas_fmi.errors import DesignError
from posmas_fmi.expression import Array
from posmas_fmi.network import Network

OBSERVER_FACTOR = 10.0  # a common rule: estimate an order of magnitude faster than one controls
_TIGHTENINGS = (1e-5, 1e-4, 1e-3)


def design(
    agent: Agent, network: Network, settings: DesignSettings, period: float | None
) -> Design:
    """Design K and E, and certify the rounded gains."""
    network.require_reached()
    K, rate = controller_gain(agent, network, settings, period)
    E = observer_gain(agent, network, settings, period, rate)
    return certified(agent, network, K, E, settings, period)


def problem_of(loop: Loop, feedback: Feedback, tightening: float, period: float | None) -> Problem:
    """Plain floating-point data of one feedback."""
    controller = feedback.name == "controller"
    floor = loop.A_low.low
    if controller:
        floor = np.minimum(floor, (loop.A + -loop.H_growth).low)
    return Problem(
        A_low=loop.A_low.low,
        A_high=loop.A_high.high,
        floor=floor,
        left=loop.agent.B if controller else np.eye(loop.agent.m),
        right=np.eye(loop.agent.m) if controller else loop.agent.C,
        ratio=feedback.weak / feedback.strong,
        period=period,
        signed=controller,
        tightening=tightening,
    )


def controller_gain(
    agent: Agent,
    network: Network,
    settings: DesignSettings,
    period: float | None,
) -> tuple[Array, float]:
    """K ≤ 0 as it ships, and the rate that it gives [1/s].

    Raises
    ------
    DesignError
        If no K is both positive and contracting.
    """
    loop = _bare(agent, network, settings, period)
    weights = loop.weights if settings.weights == "p" else loop.weights_perron
    feedback = loop.controller(weights)
    for tightening in _TIGHTENINGS:
        problem = problem_of(loop, feedback, tightening, period)
        _require_metzler(loop, problem, "controller")
        found = alternate(problem, "fast")
        if found is None or found.rate <= (settings.rate or 0.0):
            raise clash(loop, feedback, problem, found, settings)
        if settings.objective == "gain":
            found = alternate(problem, "small", settings.rate, found.v) or found
        if settings.objective == "band":
            if settings.disturbance is not None:
                problem = attrs.evolve(problem, disturbance=np.array(settings.disturbance))
            narrow = alternate(problem, "band", v=found.v)
            found = narrow if narrow is not None and narrow.rate > 0 else found
        K = -towards_zero(found.X / feedback.strong, settings.digits)
        tried = attrs.evolve(loop, K=K)
        if Prover(tried, tried.controller(weights), weights).proved:
            return K + 0.0, found.rate
    raise _unproved("K")


def observer_gain(
    agent: Agent,
    network: Network,
    settings: DesignSettings,
    period: float | None,
    rate: float,
) -> Array:
    """E as it ships.

    Parameters
    ----------
    rate : float
        Tracking rate [1/s] from which the default observer rate follows.

    Raises
    ------
    DesignError
        If no E is both positive and contracting.
    """
    loop = _bare(agent, network, settings, period)
    weights = loop.weights_perron
    feedback = loop.estimator(weights)
    wanted = settings.observer_rate or OBSERVER_FACTOR * rate
    for tightening in _TIGHTENINGS:
        problem = problem_of(loop, feedback, tightening, period)
        _require_metzler(loop, problem, "observer")
        found = _reach(problem, wanted)
        if found is None or (settings.observer_rate and found.rate < wanted * (1 - 1e-9)):
            raise clash(loop, feedback, problem, found, settings)
        E = nearest(found.X / feedback.strong, settings.digits)
        tried = attrs.evolve(loop, E=E)
        if Prover(tried, tried.estimator(weights), weights).proved:
            return E
    raise _unproved("E")


def _unproved(letter: str) -> DesignError:
    return DesignError(
        f"a gain {letter} was found but could not be proved after rounding; more digits "
        "($.design.digits) or a shorter period help",
        "$.design",
    )


def _reach(problem: Problem, wanted: float) -> Solution | None:
    """Least gain for the wanted rate; the fastest one where that is out of reach."""
    if problem.period is None:
        # a continuous observer has no fastest gain: ask for the wanted rate directly
        return _by_continuation(problem, wanted)
    fastest = alternate(problem, "fast")
    if fastest is None or fastest.rate <= 0:
        return None
    if fastest.rate <= wanted * (1 + 1e-4):
        # stay a little below the limit: the last percent costs most of the gain
        wanted = 0.99 * fastest.rate
    return alternate(problem, "small", wanted, fastest.v) or fastest


def _by_continuation(problem: Problem, wanted: float) -> Solution | None:
    """Least gain in continuous time: v follows the rate from what is easy to what is wanted."""
    size = float(np.abs(problem.A_high).max())
    bounded = attrs.evolve(problem, period=min(0.2 / max(size, 1e-300), 1e3))
    fastest = alternate(bounded, "fast")
    if fastest is None:
        return None
    for rate in (min(wanted, 0.9 * fastest.rate), 0.5 * fastest.rate):
        found = alternate(problem, "small", rate, fastest.v)
        if found is not None and found.rate > 0:
            return found
    return None


def _require_metzler(loop: Loop, problem: Problem, name: str) -> None:
    """Refuse an agent for which no gain at all is positive."""
    off = ~np.eye(loop.agent.m, dtype=bool)
    floor = np.where(off, problem.floor, np.inf)
    if not np.isfinite(problem.A_high).all():
        raise DesignError(
            "g has no finite Lipschitz bound here: declare one ($.agent.lipschitz) or give a "
            "bounded region ($.agent.region)",
            "$.agent.g",
        )
    if floor.min() < 0:
        i, j = np.unravel_index(int(floor.argmin()), floor.shape)
        raise DesignError(
            f"no {name} gain is positive: A - |H|l has the entry {floor[i, j]:.6g} < 0 at row "
            f"{i + 1}, column {j + 1}, and feedback can only lower it; a smaller Lipschitz bound "
            'or a smaller H there helps, or method = "lmi" without positivity',
            "$.agent",
        )


def _bare(agent: Agent, network: Network, settings: DesignSettings, period: float | None) -> Loop:
    """Loop without gains yet."""
    return Loop(
        agent,
        network,
        np.zeros((agent.p, agent.m)),
        np.zeros((agent.m, agent.q)),
        phi=settings.phi,
        mu=settings.mu,
        observer=settings.observer,
        period=period,
    )
