"""Why no gain works: which of positivity and contraction clash, where, and what would help."""

from __future__ import annotations

from typing import Any

import attrs

from posmas_fmi.certify import Loop
from posmas_fmi.certify.closed_loop import Prover
from posmas_fmi.certify.loop import Feedback
from posmas_fmi.design.program import Problem, Solution, alternate
from posmas_fmi.design.settings import DesignSettings
from posmas_fmi.errors import DesignError

_PINS_TRIED = 200
_PINS_PROVED = 30  # a proof costs more than a linear program
_LOWER = (0.9, 0.8, 0.65, 0.5, 0.35, 0.2, 0.1)
_SHORTER = (0.5, 0.2, 0.1, 0.05, 0.02, 0.01)


def clash(
    loop: Loop,
    feedback: Feedback,
    problem: Problem,
    found: Solution | None,
    settings: DesignSettings,
) -> DesignError:
    """Explain a failed design of one feedback."""
    controller = feedback.name == "controller"
    wanted = (settings.rate if controller else settings.observer_rate) or 0.0
    letter = "K" if controller else "E"
    best = (
        "no gain is positive"
        if found is None
        else f"the largest {letter} that is positive gives the rate {found.rate:.4g} 1/s"
    )
    text = (
        f"positivity and contraction of the {feedback.name} clash: {best} (wanted > {wanted:g}). "
        f"Positivity limits {letter} at {feedback.strongest}, contraction is short at "
        f"{feedback.weakest}"
    )
    tolerant = alternate(problem, "tolerant", max(wanted, 1e-9))
    if tolerant is not None:
        text += (
            f"; contraction would need the sign conditions to give way by {tolerant.excess:.4g} 1/s"
        )
    else:
        text += "; no gain contracts even without positivity"
    helps = _period(problem, wanted)
    if controller:
        helps += _pins(loop, problem, wanted) + _sector(loop, problem, wanted)
    advice = (
        "; ".join(helps) if helps else "no single change of pin, period or sector was found to help"
    )
    return DesignError(f"{text}. What helps: {advice}", "$.design")


def _works(problem: Problem, wanted: float) -> float | None:
    found = alternate(problem, "fast")
    return found.rate if found is not None and found.rate > wanted else None


def _period(problem: Problem, wanted: float) -> list[str]:
    if problem.period is None:
        return []
    for factor in _SHORTER:
        h = factor * problem.period
        rate = _works(attrs.evolve(problem, period=h), wanted)
        if rate is not None:
            return [f"a period of {h:.3g} s instead of {problem.period:.3g} s gives {rate:.3g} 1/s"]
    return []


def _sector(loop: Loop, problem: Problem, wanted: float) -> list[str]:
    """Smallest lower end of the sector that works, to three digits; the rest unchanged."""
    m_l, m_h = loop.agent.m_l, loop.agent.m_h
    whole = loop.weights_perron.rate / float((loop.network.in_degree + loop.network.pinning).max())

    def rate(low: float) -> float | None:
        return _works(attrs.evolve(problem, ratio=whole * low / m_h), wanted)

    if m_l >= m_h or rate(m_h) is None:
        return []
    low, high = m_l, m_h
    while high - low > 1e-3 * m_h:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if rate(middle) is None else (low, middle)
    return [f"a sector from m_l = {high:.3g} instead of {m_l:.3g} gives {rate(high):.2g} 1/s"]


def _pins(loop: Loop, problem: Problem, wanted: float) -> list[str]:
    """Another pinned agent, else one more."""
    network = loop.network
    if network.N > _PINS_TRIED:
        return []
    now = network.pinned
    weight = float(network.pinning.max())
    one = [(i,) for i in range(network.N) if len(now) == 1 and i not in now]
    more = [(*now, i) for i in range(network.N) if i not in now]
    for choices, words in ((one, "pinning agent {} instead"), (more, "pinning agent {} as well")):
        best: tuple[float, tuple[int, ...]] | None = None
        for pins in choices:
            other = network.with_pinned(pins, weight)
            if other.unreached():
                continue
            moved = attrs.evolve(loop, network=other)
            feedback = moved.controller(moved.weights_perron)
            ratio = feedback.weak / feedback.strong
            if best is None or ratio > best[0]:
                best = ratio, pins
        if best is not None:
            rate = _works(attrs.evolve(problem, ratio=best[0]), wanted)
            if rate is not None:
                return [f"{words.format(network.names[best[1][-1]])} gives {rate:.3g} 1/s"]
    return []


def remedies(loop: Loop) -> tuple[str, ...]:
    """Say which single change of period, coupling or pin would make given gains provable."""
    network = loop.network
    if loop.protocol == "printed":
        return ('protocol = "corrected" (L + D) is what can be certified',)
    if network.unreached() or _proved(loop):
        return ()
    found = []
    if loop.period is not None:
        h = next((f * loop.period for f in _SHORTER if _proved(loop, period=f * loop.period)), None)
        if h is not None:
            found.append(f"with these gains a period of {h:.3g} s is certified")
    phi = next((f * loop.phi for f in _LOWER if _proved(loop, phi=f * loop.phi)), None)
    if phi is not None:
        found.append(f"with these gains phi = {phi:.3g} is certified")
    if len(network.pinned) == 1 and network.N <= _PINS_PROVED:
        weight = float(network.pinning.max())
        for i in range(network.N):
            other = network.with_pinned([i], weight)
            if i not in network.pinned and not other.unreached() and _proved(loop, network=other):
                found.append(f"with these gains pinning agent {network.names[i]} is certified")
                break
    return tuple(found) or (
        "no shorter period, lower phi or other single pin makes these gains provable: design new "
        'ones with method = "contraction"',
    )


def _proved(loop: Loop, **changes: Any) -> bool:
    changed = attrs.evolve(loop, **changes)
    weights = changed.weights_perron
    feedbacks = (changed.controller(weights), changed.estimator(weights))
    return all(Prover(changed, f, weights).proved for f in feedbacks)
