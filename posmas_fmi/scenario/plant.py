"""The plants of a scenario: which FMU each agent has, and with which ports and values."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from posmas_fmi.cosim.fmu_plant import FmuPlant, Isolation, PlantSpec, PortMap
from posmas_fmi.cosim.wiring import Whole, Wiring
from posmas_fmi.cosim.worker.minder import Limits
from posmas_fmi.cosim.worker.process import Patience
from posmas_fmi.errors import InputError, ScenarioError
from posmas_fmi.expression import VectorFunction
from posmas_fmi.fmu.about import About, read_about
from posmas_fmi.fmu.archive import require_file
from posmas_fmi.fmu.build import agent_fmu, fmu
from posmas_fmi.fmu.period import check_period
from posmas_fmi.fmu.plant import read_plant, shipped_plants
from posmas_fmi.fmu.start_values import shape_of, spread
from posmas_fmi.scenario.build import Scenario
from posmas_fmi.scenario.faults import make_crashes
from posmas_fmi.scenario.tables import Override, Port
from posmas_fmi.scenario.wire import Instance, Recorded, Wires

SHIPPED = "positive_agent"


def fmu_files(scenario: Scenario) -> list[Path]:
    """Return the FMU of each agent, then of each component; shipped ones are built if need be."""
    plant = scenario.plant
    wanted = [(plant.fmu, plant.fmi, "$.plant.fmu")] * scenario.network.N
    for k, override in enumerate(plant.override):
        if override.fmu is not None:
            place = f"$.plant.override[{k}].fmu"
            wanted[override.agent - 1] = (override.fmu, plant.fmi, place)
    wanted += [
        (component.fmu, component.fmi, f"$.component[{k}].fmu")
        for k, component in enumerate(scenario.components)
    ]
    found = {one: _locate(scenario, *one) for one in dict.fromkeys(wanted)}
    return [found[one] for one in wanted]


def _locate(scenario: Scenario, name: str, fmi: int, place: str) -> Path:
    if name == SHIPPED:
        return _agent_fmu(scenario)
    plants = shipped_plants()
    if name in plants:
        return fmu(read_plant(plants[name]), scenario.plant.fmi if fmi not in (2, 3) else fmi)
    path = scenario.path.parent / name
    if not path.is_file():
        raise ScenarioError(
            (
                (
                    place,
                    f"there is no FMU {name!r} beside the scenario, and none shipped of that name "
                    f"({', '.join(plants)})",
                ),
            ),
            str(scenario.path),
        )
    try:
        require_file(path)
    except InputError as error:
        raise ScenarioError(((place, f"{name}: {error.message}"),), str(scenario.path)) from None
    return path


def _agent_fmu(scenario: Scenario) -> Path:
    agent = scenario.agent
    assert isinstance(agent.g, VectorFunction)
    assert isinstance(agent.sec, VectorFunction)
    return agent_fmu(agent.g, agent.sec, agent.m, agent.p, agent.q, fmi=scenario.plant.fmi)


@attrs.frozen(eq=False)
class Instances:
    """All instances of a scenario, before they are loaded.

    Attributes
    ----------
    specs : tuple of PlantSpec
        Of the agents, then of the components.
    wiring : Wiring
    recorded : Recorded
        What the columns are that the wiring records.
    shows_states : bool
    stop : float
        End of the run [s].
    every : (instances,) array of int
        Period of each in communication steps.
    isolation : Isolation
    """

    specs: tuple[PlantSpec, ...]
    wiring: Wiring
    recorded: Recorded
    shows_states: bool
    stop: float
    every: Whole
    isolation: Isolation

    def start(self, quiet: bool = False) -> FmuPlant:
        """Load and initialise them; if quiet, without a warning about start values.

        Raises
        ------
        InputError
            If ports or parameters do not fit an FMU.
        FmuError
            If one cannot be loaded or initialised.
        """
        return FmuPlant(self.specs, self.shows_states, self.stop, self.isolation, quiet)


def make_instances(
    scenario: Scenario, files: list[Path], extras: tuple[str, ...] = ()
) -> Instances:
    """Put ports, values and wiring of all instances together.

    Parameters
    ----------
    scenario : Scenario
    files : list of Path
        From `fmu_files`.
    extras : tuple of str
        What the law measures beside y.

    Raises
    ------
    InputError
        If an FMU does not allow the period, ports or start values do not fit it or its units, ports
        are missing, or what is wired to what is not clear.
    """
    plant, N = scenario.plant, scenario.network.N
    values = [_values(scenario, k) for k in range(N)]
    values += [table.parameters for table in scenario.components]
    abouts: dict[Path, About] = {}
    first: dict[Path, int] = {}
    for k, (path, given) in enumerate(zip(files, values, strict=True)):
        if path not in abouts:
            about = read_about(path)
            about.require_interface()
            for name in sorted(about.structural & set(given)):
                try:
                    about = about.structured({name: given[name]})
                except InputError as error:
                    raise InputError(error.message, _place(scenario, k, name)) from None
            abouts[path], first[path] = about, k
        for name in abouts[path].structural if first[path] != k else ():
            if given.get(name) != values[first[path]].get(name):
                raise InputError(
                    f"{path.name}: expected the structural parameter {name!r} to be the same for "
                    "all instances of a file; use a copy of the file for those that are different",
                    _place(scenario, k if name in given else first[path], name),
                )
    every = periods(scenario)
    _check_periods(scenario, [abouts[path] for path in files], every)
    shows_states = _shows_states(scenario)
    agents = [
        _agent_instance(scenario, k, abouts[path], shows_states) for k, path in enumerate(files[:N])
    ]
    nothing = PortMap.plain(())
    components = [
        Instance(table.name, abouts[path], table.parameters, nothing, nothing, table.tolerance)
        for table, path in zip(scenario.components, files[N:], strict=True)
    ]
    _check_values(scenario, (*agents, *components))
    wires = Wires(
        agents,
        components,
        scenario.signal_columns,
        every.tolist(),
        scenario.settings.input_derivatives,
    )
    for k in range(N):
        wires.exogenous(k, plant.exogenous, "$.plant.exogenous")
    for k, table in enumerate(scenario.components):
        wires.exogenous(N + k, table.exogenous, f"$.component[{k}].exogenous")
    for k, connection in enumerate(scenario.connections):
        wires.connect(connection, f"$.connection[{k}]")
    wires.measure(_measured(scenario, extras), "$.plant.measured")
    wiring, recorded = wires.wiring(
        plant.record, [c.record for c in scenario.components], scenario.signals
    )
    faults = list(scenario.faults)
    crashing = {k for _, k in make_crashes(faults, scenario.network, scenario.clock)}
    return Instances(
        tuple(
            attrs.evolve(one.spec(), alone=k in crashing)
            for k, one in enumerate((*agents, *components))
        ),
        wiring,
        recorded,
        shows_states,
        scenario.clock.time(scenario.clock.steps),
        every,
        _isolation(scenario),
    )


def _isolation(scenario: Scenario) -> Isolation:
    plant = scenario.plant
    problems = [
        (f"$.plant.{key}", f"expected a number above 0 (got {value:g})")
        for key, value in (("deadline", plant.deadline), ("memory", plant.memory))
        if value <= 0
    ]
    if plant.workers < 0:
        problems.append(("$.plant.workers", f"expected 0 or more (got {plant.workers})"))
    if problems:
        raise ScenarioError(tuple(problems), str(scenario.path))
    return Isolation(
        plant.isolation,
        plant.workers,
        plant.on_failure,
        Limits(memory=plant.memory),
        Patience(step=plant.deadline, start=max(plant.deadline, Patience().start)),
    )


def _agent_instance(scenario: Scenario, k: int, about: About, shows_states: bool) -> Instance:
    agent, own = scenario.agent, _override(scenario, k)
    readings = _ports(scenario, "outputs", agent.q, own)
    if shows_states:
        readings = readings + _ports(scenario, "states", agent.m, own)
    inputs = _ports(scenario, "inputs", agent.p, own)
    made = Instance(
        scenario.network.names[k],
        about,
        _values(scenario, k),
        inputs,
        readings,
        scenario.plant.tolerance,
    )
    for variable in inputs.variables:
        made.check_input(variable, inputs.place)
    return made


def _override(scenario: Scenario, k: int) -> tuple[int, Override] | None:
    """Last of the overrides for agent k, and its number."""
    found = [(i, o) for i, o in enumerate(scenario.plant.override) if o.agent == k + 1]
    return found[-1] if found else None


def periods(scenario: Scenario) -> Whole:
    """Period of each instance in communication steps."""
    every = np.ones(scenario.network.N + len(scenario.components), dtype=np.int64)
    for k, override in enumerate(scenario.plant.override):
        place = f"$.plant.override[{k}].every"
        if override.every < 1 or scenario.clock.steps % override.every:
            raise InputError(
                f"expected a whole number >= 1 that divides the {scenario.clock.steps} "
                f"communication steps of the run (got {override.every})",
                place,
            )
        every[override.agent - 1] = override.every
    return every


def _check_periods(scenario: Scenario, abouts: list[About], every: Whole) -> None:
    """Refuse periods that an FMU does not allow."""
    problems = []
    for about, steps in dict.fromkeys(zip(abouts, every.tolist(), strict=True)):
        found = check_period(about, steps * scenario.clock.h)
        if not found.allowed:
            text = f"{about.path.name} does not allow this period: {found.reason}"
            if steps > 1:
                text += f" (every = {steps})"
            problems.append(("$.scenario.period", text))
    if problems:
        raise ScenarioError(tuple(problems), str(scenario.path))


def _measured(scenario: Scenario, extras: tuple[str, ...]) -> dict[str, str]:
    """Return the sources of what the law measures, in its order."""
    given = scenario.plant.measured
    problems = [
        (f"$.plant.measured.{name}", "this key is missing: the control law measures it")
        for name in extras
        if name not in given
    ]
    words = ", ".join(extras) or "nothing beside y"
    problems += [
        (f"$.plant.measured.{name}", f"the control law measures {words}")
        for name in given
        if name not in extras
    ]
    if problems:
        raise ScenarioError(tuple(problems), str(scenario.path))
    return {name: given[name] for name in extras}


def _values(scenario: Scenario, k: int) -> dict[str, Any]:
    """Start values and parameters of agent k."""
    plant = scenario.plant
    values: dict[str, Any] = dict(plant.parameters)
    if plant.fmu == SHIPPED:
        values = {**_shipped_values(scenario), "x": scenario.x0[k], **values}
    for override in plant.override:
        if override.agent == k + 1:
            values |= override.parameters
    return values


def parameters(scenario: Scenario) -> list[Any]:
    """Return what a scenario says about start values, of agents and of components."""
    plant = scenario.plant
    of_agents = [plant.fmu, plant.parameters]
    of_some = [[one.agent, one.fmu, one.parameters] for one in plant.override]
    return [
        of_agents,
        of_some,
        [[one.name, one.fmu, one.parameters] for one in scenario.components],
    ]


def _check_values(scenario: Scenario, instances: Sequence[Instance]) -> None:
    """Refuse start values that an FMU does not have, or of another type or shape."""
    known, problems = set(), []
    for k, one in enumerate(instances):
        told: list[tuple[Any, ...]] = []
        for name, value in one.values.items():
            try:
                told.append((name, type(value), shape_of(name, value)))
            except InputError as error:
                problems.append((_place(scenario, k, name), error.message))
        if (key := (one.about.path, *told)) in known:
            continue
        known.add(key)
        for name, *_ in told:
            try:
                spread(one.about, {name: one.values[name]})
            except InputError as error:
                problems.append((_place(scenario, k, name), error.message))
    if problems:
        raise ScenarioError(tuple(dict.fromkeys(problems)), str(scenario.path))


def _place(scenario: Scenario, k: int, name: str) -> str:
    """Where the start value of instance k of that name stands in the scenario."""
    if k >= scenario.network.N:
        return f"$.component[{k - scenario.network.N}].parameters"
    for i, override in reversed(list(enumerate(scenario.plant.override))):
        if override.agent == k + 1 and name in override.parameters:
            return f"$.plant.override[{i}].parameters"
    return "$.plant.parameters" if name in scenario.plant.parameters else "$.agent"


def _shipped_values(scenario: Scenario) -> dict[str, Any]:
    agent = scenario.agent
    return {"A": agent.A, "H": agent.H, "B": agent.B, "C": agent.C}


def _shows_states(scenario: Scenario) -> bool:
    return scenario.plant.states is not None or scenario.plant.fmu == SHIPPED


def _ports(
    scenario: Scenario, kind: str, count: int, override: tuple[int, Override] | None
) -> PortMap:
    """Port map in the order of the protocol's names; the shipped FMU's by default."""
    letter = {"inputs": "u", "outputs": "y", "states": "x"}[kind]
    names = [f"{letter}{k + 1}" for k in range(count)]
    table: dict[str, str | Port] | None = getattr(scenario.plant, kind)
    place = f"$.plant.{kind}"
    if override is not None and getattr(override[1], kind) is not None:
        table, place = getattr(override[1], kind), f"$.plant.override[{override[0]}].{kind}"
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
    variables = [port.variable if isinstance(port, Port) else port for port in ports]
    if kind == "inputs" and len(set(variables)) < len(variables):
        k = next(k for k, name in enumerate(variables) if name in variables[:k])
        by = names[variables.index(variables[k])]
        text = f"{variables[k]!r} is set by {by} already; an input is set by one thing"
        raise ScenarioError(((f"{place}.{names[k]}", text),), str(scenario.path))
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
