"""FMUs of FMI 1.0, for Co-Simulation and for Model Exchange, as those of later versions are used.

They have no saved states, no modes and no structural parameters; all their calls go through Python.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np

from posmas_fmi.errors import FmuError
from posmas_fmi.fmu.binding import Binding
from posmas_fmi.fmu.events import EventInfo, settle
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.instance import FmuInstance, Step
from posmas_fmi.fmu.live import Frees
from posmas_fmi.fmu.state import FmuState
from posmas_fmi.fmu.stepped import SteppedFile, SteppedInstance
from posmas_fmi.fmu.variables import Group

_NO, _YES = b"\0", b"\1"
_TIMEOUT = 10_000.0  # ms, for FMUs that start a tool
# FMPy has other result types for these than the standard
_STATUS = ("fmi1InitializeSlave", "fmi1DoStep")


class _Fmi1File(FmuFile):
    """What both kinds have in common."""

    _freeing: str

    @property
    def in_python(self) -> bool:
        """True: the calls are not those that the C loops know."""
        return True

    def _logged(self) -> bytes:
        return _YES if self._logs else _NO

    def _bind(self, where: str) -> None:
        identifier = str(self.about.interface.modelIdentifier)

        def symbol(name: str) -> str:
            return f"{identifier}_fmi{name.removeprefix('fmi1')}"

        self._fmu = Binding(
            self.library, self._binding(), where, self._needed(), self._trace, symbol
        )
        for name in _STATUS:
            if hasattr(self._fmu.dll, symbol(name)):
                getattr(self._fmu.dll, symbol(name)).restype = ctypes.c_int
        self._functions = self._fmu.functions
        self._resources = self.folder.as_uri().encode()
        self._frees = Frees(self._functions[self._freeing], lambda *_: None)


class Fmi1File(_Fmi1File):
    """An FMU of FMI 1.0 for Co-Simulation; parameters, attributes, errors as `FmuFile`."""

    _freeing = "fmi1FreeSlaveInstance"

    def _binding(self) -> Any:
        from fmpy.fmi1 import FMU1Slave

        return FMU1Slave

    def _needed(self) -> list[str]:
        names = ("InstantiateSlave", "InitializeSlave", "DoStep", "FreeSlaveInstance")
        return [f"fmi1{name}" for name in names]

    def _instantiate(self, name: str, key: int, callbacks: Any) -> int | None:
        component: int | None = self._functions["fmi1InstantiateSlave"](
            *(name.encode(), self.token.encode(), self._resources),
            *(b"application/x-fmu-sharedlibrary", _TIMEOUT, _NO, _NO, callbacks, self._logged()),
        )
        return component

    def _made(self, name: str, key: int) -> Fmi1Slave:
        return Fmi1Slave(self, name, key)


class Fmi1SteppedFile(_Fmi1File, SteppedFile):
    """An FMU of FMI 1.0 for Model Exchange, whose instances an integrator steps."""

    _freeing = "fmi1FreeModelInstance"

    def _binding(self) -> Any:
        from fmpy.fmi1 import FMU1Model

        return FMU1Model

    def _needed(self) -> list[str]:
        names = ("InstantiateModel", "Initialize", "SetTime", "SetContinuousStates")
        return [f"fmi1{name}" for name in (*names, "GetDerivatives", "FreeModelInstance")]

    def _instantiate(self, name: str, key: int, callbacks: Any) -> int | None:
        component: int | None = self._functions["fmi1InstantiateModel"](
            name.encode(), self.token.encode(), callbacks, self._logged()
        )
        return component

    def _made(self, name: str, key: int) -> Fmi1Model:
        return Fmi1Model(self, name, key)


class _Fmi1Instance(FmuInstance):
    """What both kinds have in common."""

    _start, _stop, _tolerance = 0.0, None, None  # type: tuple[float, float | None, float | None]

    def enter_initialization(
        self, *, start: float = 0.0, stop: float | None = None, tolerance: float | None = None
    ) -> None:
        """Keep the experiment: there is no such mode, all is told when it is left."""
        self._start, self._stop, self._tolerance = start, stop, tolerance
        self.time = start

    def _transfer(self, direction: str, group: Group, values: np.ndarray[Any, Any]) -> None:
        if group.kind != "Boolean":  # these are single characters
            super()._transfer(direction, group, values)
            return
        buffer = ctypes.create_string_buffer(values.astype(np.int8).tobytes(), max(group.size, 1))
        self.call(f"{direction}Boolean", group.references, len(group.references), buffer)
        values[:] = np.frombuffer(buffer.raw, np.int8)[: group.size]

    def get_state(self) -> FmuState:
        """Not there in FMI 1.0."""
        raise self.error("GetFMUstate", "FMI 1.0 has no saved states")


class Fmi1Slave(_Fmi1Instance):
    """One instance for Co-Simulation; made by `Fmi1File.instantiate`."""

    def exit_initialization(self) -> None:
        """Initialise."""
        stop = _NO if self._stop is None else _YES
        self.call("InitializeSlave", self._start, stop, self._stop or 0.0)

    def step_once(self, time: float, step: float) -> Step:
        """Call DoStep once."""
        self.call("DoStep", time, step, _YES)
        return Step(time + step)

    def terminate(self) -> None:
        """End the simulation."""
        self.call("TerminateSlave")

    def reset(self) -> None:
        """Go back to the state after instantiation."""
        self.call("ResetSlave")
        self.time = 0.0


class Fmi1Model(_Fmi1Instance, SteppedInstance):
    """One instance for Model Exchange that takes steps; made by `Fmi1SteppedFile.instantiate`."""

    def call(self, function: str, *arguments: Any) -> None:
        """Call a function under the name that it has in FMI 1.0; there are no modes to enter."""
        if function in ("EnterEventMode", "EnterContinuousTimeMode"):
            return
        if function == "GetNominalsOfContinuousStates":
            function = "GetNominalContinuousStates"
        super().call(function, *arguments)

    def exit_initialization(self) -> None:
        """Initialise, and settle the discrete states."""
        from fmpy.fmi1 import fmi1EventInfo

        self.set_time(self._start)
        self.rtol = self._tolerance or self.rtol
        info, given = fmi1EventInfo(), self._tolerance is not None
        arguments = (_YES if given else _NO, self._tolerance or 0.0)
        self.call("Initialize", *arguments, ctypes.byref(info))
        found = _told(info)
        if found.terminate:
            raise self.ended("Initialize", self.time)
        self.next_event = (
            settle(self, self.update_discrete_states) if found.again else found.next_event
        )
        self._runs = True

    def start(self) -> None:
        """Do nothing: the discrete states are settled."""

    def update_discrete_states(self) -> EventInfo:
        """Update the discrete states once."""
        from fmpy.fmi1 import fmi1EventInfo

        info = fmi1EventInfo()
        self.call("EventUpdate", _NO, ctypes.byref(info))
        return _told(info)

    def _completed(self) -> bool:
        event = ctypes.c_char()
        self.call("CompletedIntegratorStep", ctypes.byref(event))
        return bool(event.value != _NO)

    def reset(self) -> None:
        """Not there in Model Exchange of FMI 1.0."""
        raise FmuError("FMI 1.0 cannot reset a Model Exchange instance", self.file.path.name)


def _told(info: Any) -> EventInfo:
    return EventInfo(
        again=info.iterationConverged == _NO,
        terminate=info.terminateSimulation != _NO,
        nominals_changed=False,
        states_changed=info.stateValuesChanged != _NO,
        next_event=float(info.nextEventTime) if info.upcomingTimeEvent != _NO else np.inf,
    )
