"""Certificate D: what delays and losses the same proof covers."""

from __future__ import annotations

from posmas_fmi.certify.loop import Loop


def statement(loop: Loop, proved: bool) -> tuple[str, ...]:
    """Say in words what a proved certificate covers beyond the nominal loop."""
    if not proved:
        return ()
    low, high = loop.agent.sector
    covered = [
        f"every sector nonlinearity in [{low:g}, {high:g}], varying in time and per agent",
        "observers started at or below the states, 0 <= xhat(0) <= x(0), for positivity",
    ]
    if loop.observer == "local":
        covered.append(
            "arbitrary bounded, time-varying delays per arc and lost messages replaced by the "
            "last one received, own estimate undelayed: convergence and positivity stay, the "
            "rate drops with the delay, a moving leader leaves an offset s(t) - s(t - tau)"
        )
    else:
        covered.append(
            "delays and losses of the controller's messages; output errors of neighbours must "
            "arrive undelayed for the distributed observer"
        )
    return tuple(covered)
