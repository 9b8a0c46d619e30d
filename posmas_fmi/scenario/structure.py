"""The network of a scenario as connected FMUs, as an SSP file has them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from posmas_fmi.cosim.fmu_plant import PlantSpec
from posmas_fmi.errors import InputError
from posmas_fmi.export import (
    Component,
    Connection,
    Connector,
    Controllers,
    Structure,
    values,
)
from posmas_fmi.expression import VectorFunction
from posmas_fmi.fmu.about import About, read_about
from posmas_fmi.fmu.build import agent_fmu
from posmas_fmi.fmu.start_values import spread
from posmas_fmi.scenario.build import Scenario
from posmas_fmi.scenario.plant import Instances, fmu_files, make_instances


def structure_of(scenario: Scenario, controllers: Controllers, controller: Path) -> Structure:
    """Return plants, controllers, leader and components, and what is connected with what.

    Parameters
    ----------
    scenario : Scenario
    controllers : Controllers
    controller : Path
        Their FMU, of FMI 2.

    Raises
    ------
    InputError
        If something of it has no place in an SSP file: an input that is a sum of several signals,
        an element of an array of FMI 3, a value that is no number, a reading that is no output.
    """
    scenario = _in_fmi_2(scenario)
    files = fmu_files(scenario)
    made = _Structure(scenario, controllers, make_instances(scenario, files), files)
    return made.of(controller)


def _in_fmi_2(scenario: Scenario) -> Scenario:
    """Take what ships as FMI 2: SSP 1.0 knows no arrays."""
    components = tuple(attrs.evolve(one, fmi=2) for one in scenario.components)
    plant = attrs.evolve(scenario.plant, fmi=2)
    return attrs.evolve(scenario, plant=plant, components=components)


class _Structure:
    def __init__(
        self,
        scenario: Scenario,
        controllers: Controllers,
        instances: Instances,
        files: list[Path],
    ) -> None:
        self._scenario, self._controllers, self._instances = scenario, controllers, instances
        self._abouts: dict[Path, About] = {path: read_about(path) for path in dict.fromkeys(files)}
        self._N = scenario.network.N
        plants = ["plant " + spec.name for spec in instances.specs[: self._N]]
        plants += [spec.name for spec in instances.specs[self._N :]]
        laws = ["controller " + name for name in scenario.network.names]
        names = _distinct([*plants, *laws, "leader"])
        self._plants, self._laws = names[: len(plants)], names[len(plants) : -1]
        self._lead = names[-1]
        self._connectors: dict[str, dict[str, Connector]] = {}
        self._connections: list[Connection] = []
        self._inputs: dict[str, None] = {}

    def of(self, controller: Path) -> Structure:
        self._wire_agents()
        self._wire_others()
        laws = [self._law(i, controller) for i in range(self._N)]
        plants = [self._plant(i) for i in range(len(self._plants))]
        scenario = self._scenario
        return Structure(
            scenario.name,
            (*plants, *laws, self._leader()),
            tuple(self._connections),
            tuple(self._inputs),
            scenario.clock.time(scenario.clock.steps),
        )

    # ---- connections ----------------------------------------------------------------------------

    def _connect(
        self,
        start: tuple[str, str],
        end: tuple[str, str],
        factor: float = 1.0,
        offset: float = 0.0,
    ) -> None:
        for (element, name), kind in ((start, "output"), (end, "input")):
            if element:
                connector = Connector(name, kind)  # type: ignore[arg-type]
                self._connectors.setdefault(element, {})[name] = connector
        self._connections.append(Connection(start, end, factor + 0.0, offset + 0.0))

    def _wire_agents(self) -> None:
        agent, controllers = self._scenario.agent, self._controllers
        for i, (plant, law) in enumerate(zip(self._plants, self._laws, strict=False)):
            spec, links = self._instances.specs[i], controllers.links[i]
            for j in range(agent.p):
                to = spec.inputs
                end = (plant, self._input(spec, to.variables[j]))
                self._connect((law, f"u[{j + 1}]"), end, to.scale[j], to.offset[j])
            for j in range(agent.q):
                of = spec.readings  # what the FMU shows is scale times y, and offset
                factor, offset = 1 / of.scale[j], -of.offset[j] / of.scale[j]
                start = (plant, self._output(spec, of.variables[j]))
                self._connect(start, (law, f"y[{j + 1}]"), factor, offset)
            sent = values(controllers, i)["heard"].shape[1]
            for k, sender in enumerate(links.senders):
                for j in range(sent):
                    end = (law, f"heard[{k + 1},{j + 1}]")
                    self._connect((self._laws[sender], f"sent[{j + 1}]"), end)
            for j in range(agent.m if links.leader else 0):
                self._connect((self._lead, f"y[{j + 1}]"), (law, f"s[{j + 1}]"))

    def _wire_others(self) -> None:
        """Connect what FMUs show, and signals from outside, to inputs beside u."""
        specs, wiring = self._instances.specs, self._instances.wiring
        at = np.cumsum([0, *(len(spec.readings.variables) for spec in specs)])
        for i, extras in enumerate(wiring.extras):
            spec = specs[i]
            first = self._scenario.agent.p if i < self._N else 0
            for variable, extra in zip(spec.inputs.variables[first:], extras, strict=False):
                if len(extra.terms) != 1:
                    raise InputError(
                        f"{spec.name}: the input {variable!r} is a sum of {len(extra.terms)} "
                        "signals, and SSP connects one output with an input"
                    )
                (term,) = extra.terms
                end = (self._plants[i], self._input(spec, variable))
                if term.source < 0:
                    start = ("", self._signal(-1 - term.source))
                else:
                    j = int(np.searchsorted(at, term.source, side="right")) - 1
                    shown = specs[j].readings.variables[term.source - at[j]]
                    start = (self._plants[j], self._output(specs[j], shown))
                self._connect(start, end, term.weight, extra.bias)

    def _signal(self, column: int) -> str:
        for name, where in self._scenario.signal_columns.items():
            if where.first <= column < where.first + where.count:
                own = name if where.count == 1 else f"{name}[{column - where.first + 1}]"
                self._inputs[own] = None
                return own
        raise AssertionError(column)

    def _input(self, spec: PlantSpec, variable: str) -> str:
        self._whole(spec, variable)
        return variable

    def _output(self, spec: PlantSpec, variable: str) -> str:
        self._whole(spec, variable)
        causality = self._abouts[spec.fmu].variable(variable).causality
        if causality != "output":
            raise InputError(
                f"{spec.fmu.name}: {variable!r} is no output (its causality is {causality}), and "
                "SSP connects outputs only"
            )
        return variable

    def _whole(self, spec: PlantSpec, variable: str) -> None:
        if variable not in self._abouts[spec.fmu].variables:
            raise InputError(
                f"{spec.fmu.name}: {variable!r} is an element of an array of FMI 3, which SSP 1.0 "
                "does not have; use an FMU of FMI 2"
            )

    # ---- components -----------------------------------------------------------------------------

    def _component(self, name: str, fmu: Path, given: Mapping[str, Any]) -> Component:
        return Component(name, fmu, tuple(self._connectors.get(name, {}).values()), given)

    def _plant(self, i: int) -> Component:
        spec = self._instances.specs[i]
        given = spread(self._abouts[spec.fmu], spec.values)
        for name, value in given.items():
            if isinstance(value, str) or np.ndim(value):
                raise InputError(
                    f"{spec.fmu.name}: the value of {name!r} is no single number, and only those "
                    "are written to an SSP file"
                )
        return self._component(
            self._plants[i], spec.fmu, {name: float(value) for name, value in given.items()}
        )

    def _law(self, i: int, controller: Path) -> Component:
        given = dict(_elements(values(self._controllers, i)))
        return self._component(self._laws[i], controller, given)

    def _leader(self) -> Component:
        agent = self._scenario.agent
        assert isinstance(agent.g, VectorFunction)
        assert isinstance(agent.sec, VectorFunction)
        path = agent_fmu(agent.g, agent.sec, agent.m, agent.p, agent.m, fmi=2)
        given = {
            "A": agent.A,
            "H": agent.H,
            "B": np.zeros_like(agent.B),
            "C": np.eye(agent.m),
            "x": self._controllers.s0,
        }
        return self._component(self._lead, path, dict(_elements(given)))


def _elements(given: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    for name, value in given.items():
        array = np.asarray(value, dtype=float)
        for index in np.ndindex(array.shape):
            label = ",".join(str(k + 1) for k in index)
            yield (f"{name}[{label}]" if label else name), float(array[index])


def _distinct(names: list[str]) -> list[str]:
    """Make identifiers of names, no two the same.

    Examples
    --------
    >>> _distinct(["plant 1", "plant-1", "leader"])
    ['plant_1', 'plant_1_2', 'leader']
    """
    found: dict[str, None] = {}
    for name in names:
        plain = re.sub(r"\W", "_", name)
        own, number = plain, 2
        while own in found:
            own, number = f"{plain}_{number}", number + 1
        found[own] = None
    return list(found)
