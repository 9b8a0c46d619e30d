"""The verdict on a run: per agent and for the network, as it stands in summary.json."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from posmas_fmi.cosim.failure import Leftover
from posmas_fmi.cosim.master import Outcome

NEGATIVE = -1e-9  # a state above this counts as non-negative: the noise of the integration


def not_about(law: str) -> dict[str, Any]:
    """Return what design.json says where the certificate is not about the law that runs."""
    return {
        "certified": "no",
        "conditions": [],
        "covers": [],
        "rate": None,
        "observer_rate": None,
        "rate_perron": None,
        "positive": False,
        "notes": [f"The certificate of the design is not about {law}"],
    }


def summarise(
    outcome: Outcome,
    names: tuple[str, ...],
    tolerance: float,
    left: Sequence[Leftover] = (),
) -> dict[str, Any]:
    """Return the content of summary.json but for the wall time.

    Parameters
    ----------
    outcome : Outcome
    names : tuple of str
        Of the agents.
    tolerance : float
        Largest final tracking error that counts as converged.
    left : sequence of Leftover
        Processes that FMUs left behind: incidents too, though no failures.

    Returns
    -------
    dict
        ``verdict`` is one of ``converged``, ``not settled`` (it would be converged, but the
        iteration of coupled FMUs did not settle in every step), ``not converged``,
        ``positivity lost``, ``diverged``, ``failed``, ``cancelled``. ``ended`` tells how the run
        ended; ``terminated``: an FMU asked for it, and the verdict is about the state by then.
    """
    agents = [
        {
            "name": name,
            "status": _status(outcome, k, name, tolerance),
            "final_error": _finite(outcome.tracking_error[k]),
            "converged": bool(outcome.tracking_error[k] <= tolerance),
            "non_negative": bool(outcome.min_state[k] >= NEGATIVE),
            "min_state": _finite(outcome.min_state[k]),
            "min_time": _finite(outcome.min_time[k]),
        }
        for k, name in enumerate(names)
    ]
    incidents = [failure.to_dict() for failure in outcome.incidents]
    reasons = (_frozen_reason(outcome), _unsettled_reason(outcome), _left_reason(left))
    noise, iterated = outcome.replay_noise, outcome.replay_noise is not None
    return {
        **({} if noise is None else {"replay_noise": _finite(noise)}),
        **({"unsettled_steps": outcome.unsettled} if iterated else {}),
        "verdict": _verdict(outcome, [str(agent["status"]) for agent in agents]),
        "ended": outcome.ended,
        "reason": outcome.reason or "; ".join(filter(None, reasons)),
        "agents": agents,
        "tracking_error_final": _finite(outcome.tracking_error.max()),
        "estimation_error_final": _finite(outcome.estimation_error.max()),
        "min_state": _finite(outcome.min_state.min()),
        "steps": outcome.steps,
        "time": outcome.time,
        "messages_sent": outcome.messages,
        "messages_lost": outcome.lost,
        "incidents": [*incidents, *(one.to_dict() for one in left)],
    }


def _status(outcome: Outcome, k: int, name: str, tolerance: float) -> str:
    error = outcome.tracking_error[k]
    if outcome.ended == "diverged" or not math.isfinite(error):
        return "diverged"
    if outcome.ended == "failed" and outcome.failed_agent == name:
        return "failed"
    if name in _frozen(outcome):
        return "frozen"
    if outcome.min_state[k] < NEGATIVE:
        return "positivity lost"
    return "converged" if error <= tolerance else "not converged"


def _verdict(outcome: Outcome, statuses: list[str]) -> str:
    if outcome.ended in ("diverged", "failed", "cancelled"):
        return outcome.ended
    return overall(statuses, outcome.unsettled)


def overall(statuses: list[str], unsettled: int = 0) -> str:
    """Verdict on a run that came to its end.

    Parameters
    ----------
    statuses : list of str
        Of the agents.
    unsettled : int
        Steps in which the iteration of coupled FMUs did not settle.

    Examples
    --------
    >>> overall(["converged", "frozen"]), overall(["converged"], unsettled=1)
    ('not converged', 'not settled')
    """
    for status in ("diverged", "positivity lost", "not converged"):
        if status in statuses:
            return status
    if "frozen" in statuses:
        return "not converged"
    return "not settled" if unsettled else "converged"


def _frozen_reason(outcome: Outcome) -> str:
    names = _frozen(outcome)
    return f"frozen after a failure of the FMU: {', '.join(names)}" if names else ""


def _unsettled_reason(outcome: Outcome) -> str:
    if not outcome.unsettled:
        return ""
    return (
        f"the coupling of FMUs did not settle in {outcome.unsettled} of {outcome.steps} steps: "
        "what they show is not that of the coupled system"
    )


def _left_reason(left: Sequence[Leftover]) -> str:
    return "; ".join(f"{one.fmu}: {one.agent} {one.text}, which had to be ended" for one in left)


def _frozen(outcome: Outcome) -> list[str]:
    """Names of the instances that failed and stayed as they were."""
    names = (failure.agent for failure in outcome.incidents if failure.action == "frozen")
    return list(dict.fromkeys(names))


def _finite(value: Any) -> float | None:
    """JSON has no NaN and no infinity."""
    number = float(value)
    return number if math.isfinite(number) else None
