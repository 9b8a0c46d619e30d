"""Faults of a scenario: what is otherwise for a time, and what the certificate says of it."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

from posmas_fmi.agent import Agent
from posmas_fmi.cosim.clock import Clock
from posmas_fmi.cosim.conditions import NEVER, Episode, steps_of
from posmas_fmi.errors import InputError, ScenarioError
from posmas_fmi.network import Network
from posmas_fmi.scenario.tables import FaultTable

log = logging.getLogger(__name__)

# What each kind does, and what is proved all the same where P, C or T hold.
KINDS = {
    "sensor stuck": "shows its last value; not covered: the observer follows a false output",
    "sensor bias": "an added value; not covered, but bounded: certificate G gives the band of a "
    "bounded disturbance E·bias",
    "sensor noise": "white noise is added; not covered, but bounded noise is a disturbance for "
    "certificate G",
    "actuator stuck": "keeps its last position; not covered",
    "actuator slow": "goes a part of the way in each step; not covered",
    "messages lost": "the last message is held; covered by certificate D as a delay of at most "
    "the episode, if what is proved covers delays",
    "leader lost": "the last state heard is held; covered by certificate D as a delay of at most "
    "the episode, if what is proved covers delays; meanwhile the leader may go on",
    "FMU crash": "the process of the FMU is killed, what follows is [plant] on_failure; not "
    "covered: a frozen agent is heard with its last message and follows nobody",
    "arc off": "the arc is not in the digraph; not covered by itself: design again without the arc "
    "to see whether that digraph is certified; changes must be rare",
}


# The keys that a kind takes beside ``kind``, ``at`` and, where it lasts, ``until``.
KEYS = {
    "sensor stuck": ("agents", "ports"),
    "sensor bias": ("agents", "ports", "value"),
    "sensor noise": ("agents", "ports", "value"),
    "actuator stuck": ("agents", "ports"),
    "actuator slow": ("agents", "ports", "value"),
    "messages lost": ("arcs", "value"),
    "leader lost": ("value",),
    "FMU crash": ("agents",),
    "arc off": ("arcs",),
}


def check_times(faults: list[FaultTable], clock: Clock, shortened: bool) -> list[FaultTable]:
    """Return the faults that come to pass.

    Parameters
    ----------
    faults : list of FaultTable
    clock : Clock
    shortened : bool
        Whether the run ends elsewhere than its scenario says: then what begins after it is left
        out with a warning, else it is a mistake.

    Raises
    ------
    ScenarioError
        Naming every fault that begins too late.
    """
    late = [k for k, f in enumerate(faults) if steps_of(f.at, clock.h) >= clock.steps]
    told = "begins at {:g} s, but the run ends at {:g} s"
    texts = {k: told.format(faults[k].at, clock.time(clock.steps)) for k in late}
    if late and not shortened:
        raise ScenarioError(
            tuple(
                (f"$.fault[{k}].at", f"{text}: expected a time before") for k, text in texts.items()
            )
        )
    for k, text in texts.items():
        log.warning("$.fault[%d].at: %s: left out", k, text)
    return [fault for k, fault in enumerate(faults) if k not in texts]


def make_episodes(
    faults: list[FaultTable], network: Network, agent: Agent, clock: Clock
) -> tuple[Episode, ...]:
    """Return the episodes of the faults.

    Parameters
    ----------
    faults : list of FaultTable
    network : Network
        With its pins.
    agent : Agent
    clock : Clock

    Raises
    ------
    InputError
        If an agent, a port or an arc does not exist, a value is missing or out of range, or a key
        means nothing for this kind.
    """
    return tuple(
        episode
        for k, fault in enumerate(faults)
        for episode in _episodes(fault, network, agent, clock, f"$.fault[{k}]")
    )


def make_crashes(
    faults: list[FaultTable], network: Network, clock: Clock
) -> tuple[tuple[int, int], ...]:
    """Return communication points and numbers of the agents whose FMUs crash there."""
    return tuple(
        (steps_of(fault.at, clock.h), number)
        for k, fault in enumerate(faults)
        if fault.kind == "FMU crash"
        for number in _agents(fault, network, f"$.fault[{k}]")
    )


def _episodes(
    fault: FaultTable, network: Network, agent: Agent, clock: Clock, place: str
) -> list[Episode]:
    begin, end = steps_of(fault.at, clock.h), steps_of(fault.until, clock.h)
    _check_keys(fault, place)
    if not fault.at >= 0:
        raise InputError(f"expected a time >= 0 s (got {fault.at:g})", f"{place}.at")
    if end <= begin:
        raise InputError(f"expected a time after {fault.at:g} s", f"{place}.until")
    if fault.kind == "FMU crash":
        _agents(fault, network, place)
        return []
    if fault.kind in ("messages lost", "leader lost", "arc off"):
        arcs = _arcs(fault, network, place)
        if fault.kind == "arc off":
            return [Episode("arc_off", arcs, 1.0, begin, end)]
        return [Episode("loss", arcs, _value(fault, place, 1.0, 0.0, 1.0), begin, end)]
    agents = _agents(fault, network, place)
    if fault.kind.startswith("sensor"):
        ports = _ports(fault, agent.q, "outputs", place)
        if fault.kind == "sensor noise":
            deviation = _value(fault, place, None, 0.0)
            return [Episode("sensor_noise", np.ix_(agents, ports), deviation, begin, end)]
        if fault.kind == "sensor stuck":
            return [Episode("sensor_gain", np.ix_(agents, ports), 0.0, begin, end)]
        bias = _value(fault, place, None)
        return [Episode("sensor_offset", np.ix_(agents, ports), bias, begin, end)]
    ports = _ports(fault, agent.p, "inputs", place)
    gain = 0.0 if fault.kind == "actuator stuck" else _value(fault, place, None, 0.0, 1.0)
    return [Episode("actuator_gain", np.ix_(agents, ports), gain, begin, end)]


def _check_keys(fault: FaultTable, place: str) -> None:
    takes = KEYS[fault.kind]
    for key in ("agents", "ports", "arcs", "value"):
        if getattr(fault, key) not in ([], None) and key not in takes:
            raise InputError(
                f"{fault.kind!r} takes {' and '.join(takes)}, not {key}; leave it out",
                f"{place}.{key}",
            )
    if fault.kind == "FMU crash" and fault.until is not None:
        raise InputError(
            "a crash happens once; what follows is [plant] on_failure: leave it out",
            f"{place}.until",
        )


def _value(
    fault: FaultTable, place: str, default: float | None, low: float = -1e300, high: float = 1e300
) -> float:
    value = default if fault.value is None else fault.value
    if value is None:
        raise InputError(f"this key is missing: {fault.kind!r} needs it", f"{place}.value")
    if not low <= value <= high:
        raise InputError(f"expected {low:g} to {high:g} (got {value:g})", f"{place}.value")
    return value


def _agents(fault: FaultTable, network: Network, place: str) -> list[int]:
    given = fault.agents or list(range(1, network.N + 1))
    for k, number in enumerate(given):
        if not 1 <= number <= network.N:
            raise InputError(f"expected 1 to {network.N} (got {number})", f"{place}.agents[{k}]")
    return [number - 1 for number in given]


def _ports(fault: FaultTable, count: int, what: str, place: str) -> list[int]:
    given = fault.ports or list(range(1, count + 1))
    for k, number in enumerate(given):
        if not 1 <= number <= count:
            raise InputError(
                f"expected 1 to {count}, a number of the agent's {what} (got {number})",
                f"{place}.ports[{k}]",
            )
    return [number - 1 for number in given]


def _arcs(fault: FaultTable, network: Network, place: str) -> Any:
    numbers = network.arc_numbers()
    if fault.kind == "leader lost":
        return [k for (sender, _), k in numbers.items() if sender == 0]
    if not fault.arcs:
        return list(numbers.values())
    chosen = []
    for k, arc in enumerate(fault.arcs):
        if arc not in numbers:
            raise InputError(
                f"there is no arc from {arc[0]} to {arc[1]} in the network", f"{place}.arcs[{k}]"
            )
        chosen.append(numbers[arc])
    return chosen


def _covered(fault: FaultTable, delays: bool) -> str:
    """Say why messages that are lost are not covered; nothing where they are."""
    if fault.kind not in ("messages lost", "leader lost"):
        return ""
    if not delays:
        return "not covered: certificate D, of delays, is not proved of what ran"
    if fault.until is None and (fault.value is None or fault.value >= 1.0):
        return "not covered: what is held there never changes, a delay without bound"
    return ""


def _where(fault: FaultTable, network: Network) -> str:
    """Say on which agents or arcs."""
    names = ("leader", *network.names)
    if fault.kind == "leader lost":
        return "the arcs from the leader"
    if "arcs" in KEYS[fault.kind]:
        arcs = (f"arc {names[sender]} -> {names[to]}" for sender, to in fault.arcs)
        return ", ".join(arcs) or "all arcs"
    return ", ".join(names[n] for n in fault.agents) or "all"


def describe(
    faults: list[FaultTable], network: Network, clock: Clock, delays: bool = True
) -> list[dict[str, Any]]:
    """Say for summary.json what was otherwise, when, and what is proved of it.

    Parameters
    ----------
    faults : list of FaultTable
    network : Network
    clock : Clock
    delays : bool
        Whether what is proved covers delays.
    """
    rows = []
    for fault in faults:
        detail, _, covered = KINDS[fault.kind].partition("; ")
        begin, end = steps_of(fault.at, clock.h), steps_of(fault.until, clock.h)
        rows.append(
            {
                "kind": fault.kind,
                "agent": _where(fault, network),
                "from": clock.time(begin),
                "until": None if end == NEVER else clock.time(end),
                "detail": detail,
                "covered": _covered(fault, delays) or covered,
            }
        )
    return rows
