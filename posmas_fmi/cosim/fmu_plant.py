"""FMU instances as the plants of the agents: ports, start values, steps."""

from __future__ import annotations

import ctypes
import logging
import os
import signal
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from posmas_fmi.cosim import native
from posmas_fmi.cosim.failure import Failure, Leftover
from posmas_fmi.cosim.fmus import (
    READING,
    FmuLoop,
    Fmus,
    Incident,
    NativeMessages,
    PortMap,
    Whole,
)
from posmas_fmi.cosim.worker.pool import Isolation, WorkerPool
from posmas_fmi.cosim.worker.process import WorkerProcess, require
from posmas_fmi.cosim.worker.proxy import RemoteFile, RemoteInstance
from posmas_fmi.cosim.worker.remote import Remote
from posmas_fmi.errors import BuildError, FmuError, InputError
from posmas_fmi.expression import Array
from posmas_fmi.fmu.about import About, read_about
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.instance import FmuInstance
from posmas_fmi.fmu.model import element_names
from posmas_fmi.fmu.open import open_fmu
from posmas_fmi.fmu.start_values import (
    StartFinding,
    StartValues,
    grouped,
    read_back,
    told,
)
from posmas_fmi.fmu.units import Conversion
from posmas_fmi.interrupt import Interrupt

log = logging.getLogger(__name__)

__all__ = ["FmuPlant", "Isolation", "PlantSpec", "PortMap", "converted"]

IN_PROCESS = Isolation("none")


@attrs.frozen(eq=False)
class PlantSpec:
    """One instance: an agent's plant, or an FMU that is no agent.

    Attributes
    ----------
    fmu : Path
    values : mapping
        Start values and parameters by name.
    name : str
        Of the agent or component, in errors and messages.
    inputs : PortMap
        What is set before each step: u of an agent, then what is wired.
    readings : PortMap
        What is read after it: y of an agent, its x where shown, then what else is used.
    tolerance : float, optional
        Relative, for the solver inside the FMU; its own default if left out.
    alone : bool
        Whether it shares its worker process with no other, if it has one.
    """

    fmu: Path
    values: Mapping[str, Any] = attrs.field(factory=dict)
    name: str = ""
    inputs: PortMap = attrs.field(default=PortMap.plain(()))
    readings: PortMap = attrs.field(default=PortMap.plain(()))
    tolerance: float | None = None
    alone: bool = False


class FmuPlant:
    """FMU instances: those of the agents first, each file loaded once.

    Parameters
    ----------
    specs : sequence of PlantSpec
        One per instance.
    shows_states : bool
        Whether the readings of agents contain x.
    stop : float
        End of the run [s].
    isolation : Isolation, optional
        Which FMUs run in worker processes, and what happens when one fails. By default all run in
        this process, and a failure is the end of the run.
    quiet : bool
        Whether no warning tells which start values an FMU did not take.

    Attributes
    ----------
    names : tuple of str
        Of the instances.
    fmus : Fmus
    isolated : bool
        Whether some of them are in worker processes.
    goes_on : bool
        Whether the others go on when an FMU fails.
    frozen : (instances,) array of bool
        Which have failed and are not stepped any more, where the loop is not the engine's.
    input_at, reading_at : (instances + 1,) array of int
        Where inputs and readings of each instance begin.
    start_values : tuple of StartFinding
        Those that could not be set, or that an FMU changed.

    Raises
    ------
    InputError
        If a port names a variable that the FMU does not have, or its unit does not fit.
    FmuError
        If an FMU cannot be loaded or initialised.
    """

    def __init__(
        self,
        specs: Sequence[PlantSpec],
        shows_states: bool,
        stop: float,
        isolation: Isolation = IN_PROCESS,
        quiet: bool = False,
    ) -> None:
        self.shows_states = shows_states
        self.names = tuple(spec.name for spec in specs)
        library = _compiled_loop()
        messages = None if library is None else NativeMessages(library)
        with ExitStack() as stack:
            pool = stack.enter_context(closing(WorkerPool(isolation, len(specs))))
            files = {
                path: stack.enter_context(
                    _open(path, messages, isolation, pool, structure_of(path, specs))
                )
                for path in dict.fromkeys(spec.fmu for spec in specs)
            }
            known = {
                (fmu, ports): converted(files[fmu].about, ports)
                for fmu, ports in dict.fromkeys(
                    (spec.fmu, ports) for spec in specs for ports in (spec.inputs, spec.readings)
                )
            }
            self._inputs = [known[spec.fmu, spec.inputs] for spec in specs]
            self._readings = [known[spec.fmu, spec.readings] for spec in specs]
            findings: list[StartFinding] = []
            of_each = [files[spec.fmu] for spec in specs]
            self._instances = _start_all(of_each, specs, stop, findings, stack)
            self.start_values = tuple(findings)
            for finding in () if quiet else grouped(findings):
                log.warning("%s", told(finding))
            self.fmus = Fmus(self._instances, self._inputs, self._readings, messages)
            self._remote = self._connect(isolation, pool, stack)
            self._release = stack.pop_all()
        self._pool = pool
        self.isolated = self._remote is not None
        self.input_at, self.reading_at = self.fmus.input_at, self.fmus.reading_at
        self.frozen = np.zeros(len(specs), dtype=bool)
        self._fresh = False  # what has been stepped last has been read as well
        self.goes_on = isolation.on_failure != "stop" and library is not None
        self._incidents = (Incident * len(specs))() if self.goes_on else None
        self._loop = None
        if library is not None:
            self._loop = FmuLoop(self.fmus, library, self._incidents)

    def _connect(self, isolation: Isolation, pool: WorkerPool, stack: ExitStack) -> Remote | None:
        """Let the loops find the instances that are in worker processes."""
        if not any(isinstance(one, RemoteInstance) for one in self._instances):
            return None
        remote = Remote(
            self._instances, self._inputs, self._readings, pool, isolation, self.fmus.failures
        )
        stack.enter_context(closing(remote))
        self.fmus.use(remote)
        return remote

    @property
    def failures(self) -> Sequence[Failure]:
        """What has failed so far."""
        return self.fmus.failures

    @property
    def leftovers(self) -> tuple[Leftover, ...]:
        """Processes that FMUs left behind and that had to be ended; complete after `close`."""
        return tuple(one for one in self._pool.leftovers if one.number)

    @classmethod
    def of_agents(
        cls,
        names: Sequence[str],
        specs: Sequence[PlantSpec],
        inputs: PortMap,
        outputs: PortMap,
        states: PortMap | None,
        stop: float,
        isolation: Isolation = IN_PROCESS,
    ) -> FmuPlant:
        """Make the plants of agents that have the same ports and nothing wired.

        Parameters
        ----------
        names : sequence of str
        specs : sequence of PlantSpec
            FMU and values of each agent.
        inputs, outputs : PortMap
        states : PortMap, optional
            Where the FMU shows x.
        stop : float
            End of the run [s].
        isolation : Isolation, optional
        """
        readings = outputs if states is None else outputs + states
        whole = [
            attrs.evolve(spec, name=name, inputs=inputs, readings=readings)
            for name, spec in zip(names, specs, strict=True)
        ]
        return cls(whole, states is not None, stop, isolation)

    def read(self, which: Whole, time: float, readings: Array) -> None:
        """Write the readings of some instances into those of all; see `Plant.read`."""
        if self._fresh and self._loop is not None:
            self._fresh = False
            self._loop.check_readings(time)
            return
        if self._loop is not None:
            before = readings.copy() if self.goes_on else readings
            self._loop.read(which, time, readings)
            self._freeze(time, time, readings, before)
            return
        for number in which:
            instance, ports = self._instances[number], self._readings[number]
            values = instance.read(instance.file.ports(ports.variables))
            at = slice(self.reading_at[number], self.reading_at[number + 1])
            readings[at] = (values - np.array(ports.offset)) / np.array(ports.scale)

    def step(self, which: Whole, t: Array, h: Array, inputs: Array, readings: Array) -> None:
        """Set the inputs of some instances and let them step."""
        if self._loop is not None:
            self.fmus.inputs = inputs
            before = readings.copy() if self.goes_on else readings
            self._loop.step(which, t, h, inputs, readings)
            self._fresh = True
            self._freeze(float(t[0]), float(t[0] + h[0]), readings, before)
            return
        for number, begin, length in zip(which, t, h, strict=True):
            instance, ports = self._instances[number], self._inputs[number]
            at = slice(self.input_at[number], self.input_at[number + 1])
            given, rates = np.split(inputs[at], [len(ports.variables)])
            values = given * np.array(ports.scale) + np.array(ports.offset)
            instance.write(instance.file.ports(ports.variables), values)
            if ports.rates:
                instance.set_input_derivatives(instance.file.ports(ports.rates), rates)
            instance.do_step(float(begin), float(length))

    def _freeze(self, begin: float, end: float, readings: Array, before: Array) -> None:
        """Leave instances that have failed as they were, in a step from begin to end [s]."""
        if self._incidents is None:
            return
        for number, incident in enumerate(self._incidents):
            if incident.call:
                if not self.fmus.is_remote(number):  # they tell themselves
                    self.fmus.freeze(incident, end if incident.call in READING else begin)
                self.frozen[number] = True
                at = slice(self.reading_at[number], self.reading_at[number + 1])
                readings[at] = before[at]
                incident.call = 0

    def obey(self, interrupt: Interrupt) -> None:
        """Wait for worker processes only until Ctrl-C comes, in the run that begins."""
        self.fmus.obey(interrupt)

    def checkpoint(self) -> None:
        """Save states to restart from, if it is time."""
        if self._remote is not None:
            self._remote.checkpoint()

    def crash(self, number: int) -> None:
        """Kill the process of an instance, as a fault.

        Raises
        ------
        InputError
            If the instance is in this process.
        """
        instance = self._instances[number]
        if not isinstance(instance, RemoteInstance):
            raise InputError(
                f"{self.names[number]} runs in this process; an FMU that is to crash needs "
                'isolation = "process"',
                "$.plant.isolation",
            )
        os.kill(instance.worker.pid, signal.SIGKILL)

    def save(self, which: Whole) -> Any:
        """Keep the states of some instances.

        Raises
        ------
        FmuCallError
            If an FMU cannot give its state.
        """
        return [(number, self._save(int(number))) for number in which if not self.frozen[number]]

    def _save(self, number: int) -> Any:
        if self._remote is not None and self._remote.is_remote[number]:
            return self._remote.save(number)
        return self._instances[number].get_state()

    def serialise(self) -> tuple[bytes, ...] | None:
        """Return the states of all instances as bytes; None if an FMU cannot give its own."""
        for file in dict.fromkeys(instance.file for instance in self._instances):
            interface = file.about.interface
            if not (interface.canGetAndSetFMUstate and interface.canSerializeFMUstate):
                return None
        try:
            return tuple(instance.serialise() for instance in self._instances)
        except FmuError as error:
            log.warning("an FMU that says it can does not give its state: %s", error)
            return None

    def deserialise(self, states: tuple[bytes, ...], time: float) -> None:
        """Bring all instances to states that `serialise` returned, at a time [s].

        Raises
        ------
        FmuCallError
            If an FMU refuses.
        """
        for number, (instance, data) in enumerate(zip(self._instances, states, strict=True)):
            instance.deserialise(data, time)
            if self._remote is not None and self._remote.is_remote[number]:
                self._remote.begin_at(number, data, time)

    def restore(self, saved: Any) -> None:
        """Go back to states that were kept."""
        for number, state in saved:
            if self.frozen[number]:
                continue
            if self._remote is not None and self._remote.is_remote[number]:
                self._remote.restore(number, state)
            else:
                self._instances[number].set_state(state)

    def stepped_to(self, time: float) -> None:
        """Note that the engine has taken the instances to a time [s]."""
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


def _open(
    path: Path,
    messages: NativeMessages | None,
    isolation: Isolation,
    pool: WorkerPool,
    structure: Mapping[str, int],
) -> FmuFile:
    """Open an FMU, to run here or in worker processes."""
    if isolation.mode == "none" or not isolation.separates(path):
        return open_fmu(path, messages, structure=structure)
    try:
        require()
    except BuildError as error:
        if isolation.mode == "process":
            raise
        log.warning("%s runs in this process: %s", path.name, error)
        return open_fmu(path, messages, structure=structure)
    return RemoteFile(path, pool.place, structure)


def _start_all(
    files: Sequence[FmuFile],
    specs: Sequence[PlantSpec],
    stop: float,
    findings: list[StartFinding],
    stack: ExitStack,
) -> list[FmuInstance]:
    """Make and initialise all instances; worker processes do it side by side."""
    instances: list[FmuInstance] = []
    told: dict[FmuInstance, list[StartFinding]] = {}
    start = {file: StartValues(file) for file in dict.fromkeys(files)}
    there: dict[WorkerProcess, list[tuple[RemoteInstance, PlantSpec]]] = {}
    for file, spec in zip(files, specs, strict=True):
        if isinstance(file, RemoteFile):
            instance: FmuInstance = file.prepare(spec.name, spec.alone)
            assert isinstance(instance, RemoteInstance)
            there.setdefault(instance.worker, []).append((instance, spec))
        else:
            instance = stack.enter_context(file.instantiate(spec.name))
            told[instance] = _initialise(instance, spec, start[file], stop)
        instances.append(instance)

    def make(worker: WorkerProcess) -> None:
        for one, spec in there[worker]:
            one.make(worker)
            told[one] = _initialise(one, spec, start[one.file], stop)

    with ThreadPoolExecutor(max(len(there), 1)) as threads:
        made = [threads.submit(make, worker) for worker in there]
        try:
            for one in made:
                one.result()
        except BaseException:
            for worker in there:  # so that the others need not be waited for
                worker.kill()
            raise
    for worker in there:
        for one_there, _ in there[worker]:
            stack.enter_context(one_there)
    for instance in instances:
        findings += told[instance]
    return instances


def _initialise(
    instance: FmuInstance, spec: PlantSpec, start: StartValues, stop: float
) -> list[StartFinding]:
    values, refused = start.of(spec.values, spec.name)
    instance.initialise(values, stop=stop, tolerance=spec.tolerance)
    return [*refused, *read_back(instance, values)]


def structure_of(path: Path, specs: Sequence[PlantSpec]) -> Mapping[str, int]:
    """Return the structural parameters among the values of all instances of an FMU.

    Raises
    ------
    InputError
        If instances differ in one: then arrays of theirs have different lengths.
    """
    about = read_about(path)
    if not about.structural:
        return {}
    found: dict[tuple[tuple[str, int], ...], str] = {}
    for spec in specs:
        if spec.fmu == path:
            structure = about.structured(spec.values).structure
            found.setdefault(tuple(sorted(structure.items())), spec.name)
    if len(found) > 1:
        names = " and ".join(list(found.values())[:2])
        raise InputError(
            f"{path.name}: expected the same structural parameters in all instances ({names} "
            "differ); use a copy of the file for those that are different"
        )
    return dict(next(iter(found), ()))


def converted(about: About, ports: PortMap) -> PortMap:
    """Return ports whose scale and offset convert units as well.

    Parameters
    ----------
    about : About
        The FMU.
    ports : PortMap

    Raises
    ------
    InputError
        If there is no such variable, it is no number, or the units do not fit.
    """
    scale, offset = [], []
    for name, unit, factor, shift in zip(
        ports.variables, ports.units, ports.scale, ports.offset, strict=True
    ):
        try:
            size = len(about.ports([name]).names)
            if size != 1:
                raise InputError(
                    f"{about.path.name}: {name!r} is an array of {size}; name one of its elements, "
                    f"as {next(element_names(name, about.variable(name).shape))!r}"
                )
            found = Conversion() if unit is None else about.conversion(name, unit)
        except FmuError as error:
            raise InputError(f"{about.path.name}: {error.message}", ports.place) from None
        except InputError as error:
            raise InputError(error.message, ports.place) from None
        scale.append(found.scale * factor)
        offset.append(found.scale * shift + found.offset)
    return attrs.evolve(ports, scale=tuple(scale), offset=tuple(offset), units=(None,) * len(scale))
