"""FMU instances as the plants of the agents: ports, start values, steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from posmas_fmi.errors import FmuCallError, FmuError, InputError
from posmas_fmi.expression import Array
from posmas_fmi.fmu.instance import FmuFile, FmuInstance


@attrs.frozen
class PortMap:
    """Which FMU variables carry a protocol vector: FMU value = scale × value + offset.

    Attributes
    ----------
    variables : tuple of str
    scale, offset : tuple of float
    units : tuple of (str or None)
        Checked against the FMU's description where given.
    place : str
        Where in the scenario they are declared.
    """

    variables: tuple[str, ...]
    scale: tuple[float, ...]
    offset: tuple[float, ...]
    units: tuple[str | None, ...]
    place: str

    @classmethod
    def plain(cls, variables: Sequence[str], place: str = "") -> PortMap:
        """Ports without conversion."""
        n = len(variables)
        return cls(tuple(variables), (1.0,) * n, (0.0,) * n, (None,) * n, place)


@attrs.frozen
class PlantSpec:
    """One agent's plant.

    Attributes
    ----------
    fmu : Path
    values : mapping
        Start values and parameters by name.
    """

    fmu: Path
    values: Mapping[str, Any] = attrs.field(factory=dict, eq=False)


class FmuPlant:
    """All agents' FMUs: one file loaded once, one instance per agent.

    Parameters
    ----------
    agents : sequence of str
        Names.
    specs : sequence of PlantSpec
        One per agent.
    inputs, outputs : PortMap
    states : PortMap, optional
        Where the FMU shows x.
    stop : float
        End of the run [s].

    Raises
    ------
    InputError
        If a port names a variable that the FMU does not have, or with another unit.
    FmuError
        If an FMU cannot be loaded or initialised.
    """

    def __init__(
        self,
        agents: Sequence[str],
        specs: Sequence[PlantSpec],
        inputs: PortMap,
        outputs: PortMap,
        states: PortMap | None,
        stop: float,
    ) -> None:
        self._agents = tuple(agents)
        self._inputs, self._outputs, self._states = inputs, outputs, states
        with ExitStack() as stack:
            self._files = {spec.fmu: None for spec in specs}
            files = {path: stack.enter_context(FmuFile(path)) for path in self._files}
            for file in files.values():
                for ports in (inputs, outputs, states):
                    if ports is not None:
                        _check_ports(file, ports)
            self._instances = [
                stack.enter_context(self._start(files[spec.fmu], name, spec, stop))
                for name, spec in zip(agents, specs, strict=True)
            ]
            self._ports = [
                _Ports.of(file, inputs, outputs, states)
                for file in (files[spec.fmu] for spec in specs)
            ]
            self._release = stack.pop_all()

    def _start(self, file: FmuFile, agent: str, spec: PlantSpec, stop: float) -> FmuInstance:
        instance = file.instantiate(agent)
        try:
            instance.initialise(_existing(file, spec.values), stop=stop)
        except FmuCallError as error:
            raise FmuCallError(error.message, error.where, agent, error.time) from error
        return instance

    def outputs(self) -> Array:
        """Return y, (N, q)."""
        return self._read("outputs", self._outputs)

    def states(self) -> Array | None:
        """Return x, (N, m), if the FMU shows it."""
        return None if self._states is None else self._read("states", self._states)

    def _read(self, kind: str, ports: PortMap) -> Array:
        scale, offset = np.array(ports.scale), np.array(ports.offset)
        values = np.empty((len(self._instances), len(ports.variables)))
        for k, instance in enumerate(self._instances):
            try:
                values[k] = instance.read(getattr(self._ports[k], kind))
            except FmuCallError as error:
                raise self._named(error, k) from error
        return np.asarray((values - offset) / scale)

    def step(self, k: int, t: float, h: float, U: Array) -> None:
        """Set the inputs of every FMU and let it step."""
        values = U * np.array(self._inputs.scale) + np.array(self._inputs.offset)
        for i, instance in enumerate(self._instances):
            try:
                instance.write(self._ports[i].inputs, values[i])
                instance.do_step(t, h)
            except FmuCallError as error:
                raise self._named(error, i) from error

    def _named(self, error: FmuCallError, k: int) -> FmuCallError:
        return FmuCallError(error.message, error.where, self._agents[k], error.time)

    def close(self) -> None:
        """Free instances, libraries and temporary folders."""
        self._release.close()

    def __enter__(self) -> FmuPlant:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@attrs.frozen(eq=False)
class _Ports:
    inputs: Any
    outputs: Any
    states: Any

    @classmethod
    def of(cls, file: FmuFile, inputs: PortMap, outputs: PortMap, states: PortMap | None) -> _Ports:
        return cls(
            file.ports(inputs.variables),
            file.ports(outputs.variables),
            None if states is None else file.ports(states.variables),
        )


def _check_ports(file: FmuFile, ports: PortMap) -> None:
    for name, unit in zip(ports.variables, ports.units, strict=True):
        try:
            file.ports([name])
        except FmuError as error:
            raise InputError(f"{file.path.name}: {error.message}", ports.place) from None
        declared = file.variable(name).unit
        if unit is not None and unit != declared:
            raise InputError(
                f"{file.path.name}: {name!r} is in {declared or 'no unit'} (got {unit!r}); "
                "correct the unit, and scale and offset with it",
                ports.place,
            )


def _existing(file: FmuFile, values: Mapping[str, Any]) -> dict[str, Any]:
    """Spread arrays over elements where the FMU (version 2) has no arrays; refuse unknown names."""
    spread: dict[str, Any] = {}
    for name, value in values.items():
        array = np.asarray(value, dtype=float)
        if name in file.variables or array.ndim == 0:
            spread[name] = value
            continue
        for index in np.ndindex(array.shape):
            label = ",".join(str(i + 1) for i in index)
            spread[f"{name}[{label}]"] = float(array[index])
    for name in spread:
        try:
            file.variable(name)
        except FmuError as error:
            raise InputError(f"{file.path.name}: {error.message}", "$.plant.parameters") from None
    return spread
