"""Whether the certificate covers what a run used: its channel, periods, start and wiring."""

from __future__ import annotations

from typing import Any

import numpy as np

from posmas_fmi.design import Design
from posmas_fmi.scenario.build import Scenario
from posmas_fmi.scenario.tables import ArcTable, ChannelTable


def coverage(scenario: Scenario, designed: Design) -> list[dict[str, Any]]:
    """Say for summary.json what the run used beyond the nominal loop, and whether it is covered.

    Parameters
    ----------
    scenario : Scenario
    designed : Design
        With the certificate.

    Returns
    -------
    list of dict
        ``what``, ``covered`` (bool) and ``why``. Empty: nothing beyond the nominal loop.
    """
    proved = bool(designed.certificate.delays)
    rows: list[tuple[str, bool, str]] = []
    if scenario.control.python is not None:
        rows.append(
            (
                "controllers of one's own",
                False,
                "what is proved is about [design]'s gains",
            )
        )
    channel = scenario.channel
    arcs: list[ChannelTable | ArcTable] = [channel, *channel.arc]
    if any(c.delay or c.jitter for c in arcs):
        rows.append(("delay of messages", proved, _delays(designed)))
    if any((c.loss or 0.0) >= 1.0 for c in arcs):
        rows.append(
            ("arcs over which nothing ever arrives", False, "what is held there never changes")
        )
    elif any(c.loss for c in arcs):
        rows.append(("loss of messages", proved, f"{_delays(designed)}; with probability one"))
    if channel.resolution:
        rows.append(
            (
                "rounded messages",
                False,
                "a bounded disturbance of at most half the resolution; certificate G gives a band",
            )
        )
    sensors = scenario.sensors
    if sensors is not None and (sensors.noise.any() or sensors.resolution.any()):
        rows.append(
            (
                "noise or quantisation of sensors",
                False,
                "what they add enters through E; for a bounded disturbance certificate G gives a "
                "band",
            )
        )
    if any(o.every > 1 for o in scenario.plant.override):
        rows.append(
            ("longer periods of some agents", False, "certificate T is about one period for all")
        )
    if scenario.connections:
        rows.append(
            (
                "FMUs that act on each other beside the network",
                False,
                "model (1) has no such terms; for a bounded disturbance certificate G gives a band",
            )
        )
    known = scenario.plant.fmu == "positive_agent"  # elsewhere x0 is not where the FMUs start
    if known and (np.any(scenario.xhat0 < 0) or np.any(scenario.xhat0 > scenario.x0)):
        rows.append(
            (
                "observers that start above the states or below zero",
                False,
                "convergence is covered; positivity asks for 0 <= xhat(0) <= x(0)",
            )
        )
    return [{"what": what, "covered": covered, "why": why} for what, covered, why in rows]


def _delays(designed: Design) -> str:
    if designed.certificate.certified == "no":
        return "nothing is proved"
    if not designed.certificate.delays:
        return "what is proved is the loop without delay; certificate D is not proved"
    slower = [f"{d.rate:.3g} 1/s at {d.delay:.3g} s" for d in designed.certificate.delays[::3]]
    rates = f"; certified rate {', '.join(slower)}" if slower else ""
    stays = "convergence and positivity stay"
    if designed.observer == "distributed":
        stays = "convergence stays, also where output errors are as late"
    return f"certificate D: the last message is held, {stays}{rates}"
