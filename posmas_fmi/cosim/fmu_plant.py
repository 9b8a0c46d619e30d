"""FMU instances as the plants of the agents: ports, start values, steps."""

from __future__ import annotations

import ctypes
import logging
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from posmas_fmi.cosim import native
from posmas_fmi.cosim.fmus import FmuLoop, Fmus, NativeMessages, PortMap
from posmas_fmi.errors import BuildError, FmuError, InputError
from posmas_fmi.expression import Array
from posmas_fmi.fmu.instance import FmuFile, FmuInstance

log = logging.getLogger(__name__)

__all__ = ["FmuPlant", "PlantSpec", "PortMap"]


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
        self._inputs = inputs
        self._readings = outputs if states is None else outputs + states
        self._q, self._shows_states = len(outputs.variables), states is not None
        self._time = 0.0
        self._last: Array | None = None
        library = _compiled_loop()
        messages = None if library is None else NativeMessages(library)
        with ExitStack() as stack:
            paths = dict.fromkeys(spec.fmu for spec in specs)
            files = {path: stack.enter_context(FmuFile(path, messages)) for path in paths}
            for file in files.values():
                for ports in (inputs, outputs, states):
                    if ports is not None:
                        _check_ports(file, ports)
            self._instances = [
                stack.enter_context(_start(files[spec.fmu], name, spec, stop))
                for name, spec in zip(agents, specs, strict=True)
            ]
            self.fmus = Fmus(self._instances, inputs, self._readings, messages)
            self._release = stack.pop_all()
        self._loop = None
        if library is not None:
            self._loop = FmuLoop(self.fmus, library, len(self._readings.variables))

    @property
    def shows_states(self) -> bool:
        """Whether `states` returns x."""
        return self._shows_states

    def outputs(self) -> Array:
        """Return y, (N, q)."""
        return self._read()[:, : self._q]

    def states(self) -> Array | None:
        """Return x, (N, m), if the FMU shows it."""
        return self._read()[:, self._q :] if self._shows_states else None

    def _read(self) -> Array:
        """Return outputs and states; FMUs are asked once per communication point."""
        if self._last is None:
            if self._loop is not None:
                self._last = self._loop.read(self._time)
            else:
                self._last = self._read_one_by_one()
        return self._last

    def _read_one_by_one(self) -> Array:
        scale, offset = np.array(self._readings.scale), np.array(self._readings.offset)
        names = self._readings.variables
        values = np.array([i.read(i.file.ports(names)) for i in self._instances])
        return np.asarray((values - offset) / scale)

    def step(self, k: int, t: float, h: float, U: Array) -> None:
        """Set the inputs of every FMU and let it step."""
        self._last = None
        if self._loop is not None:
            self._loop.step(t, h, U)
        else:
            values = U * np.array(self._inputs.scale) + np.array(self._inputs.offset)
            for row, instance in zip(values, self._instances, strict=True):
                instance.write(instance.file.ports(self._inputs.variables), row)
                instance.do_step(t, h)
        self._time = t + h

    def stepped_to(self, time: float) -> None:
        """Take note that the engine has taken the FMUs to this time [s]."""
        self._time, self._last = time, None
        self.fmus.set_time(time)

    def close(self) -> None:
        """Free instances, libraries and temporary folders."""
        self._release.close()

    def __enter__(self) -> FmuPlant:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _compiled_loop() -> ctypes.CDLL | None:
    try:
        return native.load(native.library(native.fmus_sources()))
    except BuildError as error:
        log.info("FMUs are called one by one from Python: %s", error)
        return None


def _start(file: FmuFile, agent: str, spec: PlantSpec, stop: float) -> FmuInstance:
    instance = file.instantiate(agent)
    instance.initialise(_existing(file, spec.values), stop=stop)
    return instance


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
