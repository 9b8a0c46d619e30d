"""The plants of a scenario: which FMU each agent has, and with which ports and values."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from posmas_fmi.cosim.fmu_plant import FmuPlant, PlantSpec, PortMap
from posmas_fmi.errors import ScenarioError
from posmas_fmi.expression import VectorFunction
from posmas_fmi.fmu.build import agent_fmu, fmu
from posmas_fmi.fmu.plant import read_plant, shipped_plants
from posmas_fmi.scenario.build import Scenario
from posmas_fmi.scenario.tables import Port

SHIPPED = "positive_agent"


def fmu_files(scenario: Scenario) -> list[Path]:
    """Return the FMU of each agent; the shipped one is built if it is not there yet."""
    plant = scenario.plant
    chosen = [plant.fmu] * scenario.network.N
    for override in plant.override:
        if override.fmu is not None:
            chosen[override.agent - 1] = override.fmu
    found = {name: _locate(scenario, name) for name in dict.fromkeys(chosen)}
    return [found[name] for name in chosen]


def _locate(scenario: Scenario, name: str) -> Path:
    if name == SHIPPED:
        return _agent_fmu(scenario)
    plants = shipped_plants()
    if name in plants:
        return fmu(read_plant(plants[name]), scenario.plant.fmi)
    path = scenario.path.parent / name
    if not path.is_file():
        raise ScenarioError(
            (
                (
                    "$.plant.fmu",
                    f"there is no FMU {name!r} beside the scenario, and none shipped of that name "
                    f"({', '.join(plants)})",
                ),
            ),
            str(scenario.path),
        )
    return path


def _agent_fmu(scenario: Scenario) -> Path:
    agent = scenario.agent
    assert isinstance(agent.g, VectorFunction)
    assert isinstance(agent.sec, VectorFunction)
    return agent_fmu(agent.g, agent.sec, agent.m, agent.p, agent.q, fmi=scenario.plant.fmi)


def make_plant(scenario: Scenario, files: list[Path]) -> FmuPlant:
    """Load and initialise the FMUs of a scenario.

    Raises
    ------
    InputError
        If ports or parameters do not fit the FMU.
    FmuError
        If it cannot be loaded or initialised.
    """
    agent, plant = scenario.agent, scenario.plant
    given = _shipped_values(scenario) if plant.fmu == SHIPPED else {}
    specs = []
    for k, path in enumerate(files):
        values: dict[str, Any] = dict(plant.parameters)
        if plant.fmu == SHIPPED:
            values = {**given, "x": scenario.x0[k], **values}
        for override in plant.override:
            if override.agent == k + 1:
                values |= override.parameters
        specs.append(PlantSpec(path, values))
    states = _ports(scenario, "states", agent.m) if _shows_states(scenario) else None
    return FmuPlant.of_agents(
        scenario.network.names,
        specs,
        _required(scenario, "inputs", agent.p),
        _required(scenario, "outputs", agent.q),
        states,
        stop=scenario.clock.time(scenario.clock.steps),
    )


def _shipped_values(scenario: Scenario) -> dict[str, Any]:
    agent = scenario.agent
    return {"A": agent.A, "H": agent.H, "B": agent.B, "C": agent.C}


def _shows_states(scenario: Scenario) -> bool:
    return scenario.plant.states is not None or scenario.plant.fmu == SHIPPED


def _required(scenario: Scenario, kind: str, count: int) -> PortMap:
    ports = _ports(scenario, kind, count)
    assert ports is not None
    return ports


def _ports(scenario: Scenario, kind: str, count: int) -> PortMap | None:
    """Port map in the order of the protocol's names; the shipped FMU's by default."""
    letter = {"inputs": "u", "outputs": "y", "states": "x"}[kind]
    names = [f"{letter}{k + 1}" for k in range(count)]
    table: dict[str, str | Port] | None = getattr(scenario.plant, kind)
    place = f"$.plant.{kind}"
    if table is None:
        if scenario.plant.fmu != SHIPPED:
            raise ScenarioError(
                ((place, f"this key is missing: which FMU variables are {', '.join(names)}"),),
                str(scenario.path),
            )
        table = {name: f"{letter}[{k + 1}]" for k, name in enumerate(names)}
    problems = [(f"{place}.{n}", "this key is missing") for n in names if n not in table]
    problems += [
        (f"{place}.{n}", f"unknown name; expected {', '.join(names)}")
        for n in table
        if n not in names
    ]
    if problems:
        raise ScenarioError(tuple(problems), str(scenario.path))
    ports = [table[name] for name in names]
    whole = [port if isinstance(port, Port) else Port(port) for port in ports]
    zero = [n for n, port in zip(names, whole, strict=True) if port.scale == 0]
    if zero:
        raise ScenarioError(((f"{place}.{zero[0]}.scale", "expected a number other than 0"),))
    return PortMap(
        tuple(port.variable for port in whole),
        tuple(port.scale for port in whole),
        tuple(port.offset for port in whole),
        tuple(port.unit for port in whole),
        place,
    )
