"""Co-Simulation instances of an FMU in this process: every status and every value is checked."""

from __future__ import annotations

import ctypes
import itertools
import logging
import math
import os
import tempfile
import weakref
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Protocol, Self

import attrs
import numpy as np
from numpy.typing import ArrayLike

from posmas_fmi.errors import ArchiveError, FmuCallError, FmuError
from posmas_fmi.expression import Array
from posmas_fmi.fmu.archive import unpack
from posmas_fmi.fmu.binding import Binding, Trace
from posmas_fmi.fmu.variables import WHOLE, Ports, Variable, Variables

_LOG = logging.getLogger(__name__)
_STATUS = ("OK", "Warning", "Discard", "Error", "Fatal", "Pending")
_KEPT_MESSAGES = 20
_LONGEST_MESSAGE = 2000


class Messages(Protocol):
    """Where the messages of instances go, told apart by their keys."""

    def logger(self, version: int) -> int:
        """Address of the function that FMUs of this FMI version call."""

    def environment(self, key: int) -> int:
        """Return what the instance gives to that function."""

    def forget(self, key: int) -> None:
        """Leave out what the instance has said so far."""

    def of(self, key: int) -> list[str]:
        """Return the last few messages of the instance."""


class FmuFile:
    """An FMU unpacked and loaded once, for any number of Co-Simulation instances.

    Parameters
    ----------
    path : path-like
        The .fmu file.
    messages : Messages, optional
        Where the messages of its instances go; kept by Python functions if left out.
    trace : callable, optional
        Called with the name before each call into the binary.

    Attributes
    ----------
    path : Path
    version : {2, 3}
        FMI version.
    token : str
        GUID or instantiationToken.
    description : fmpy ModelDescription
        All that the file says about itself.
    variables : mapping of str to Variable
        By name.
    library : Path
        The shared library that was loaded.

    Raises
    ------
    ArchiveError
        If the file cannot be unpacked or its description not be read.
    FmuError
        If it has no Co-Simulation interface of FMI 2 or 3, or no binary that loads here.

    Notes
    -----
    Use as a context manager or call `close`, which frees the instances that are left, the library
    and the temporary folder. What is forgotten is released when the object is collected.
    """

    kind = "Co-Simulation"

    def __init__(
        self, path: str | Path, messages: Messages | None = None, trace: Trace | None = None
    ) -> None:
        self.path = Path(path)
        self._trace = trace
        folder = tempfile.TemporaryDirectory(prefix="posmas-fmi-", ignore_cleanup_errors=True)
        try:
            self._open(Path(folder.name))
        except BaseException:
            folder.cleanup()
            raise
        self._messages = messages or _PythonMessages()
        self._live: dict[int, _Live] = {}
        self._known_ports: dict[tuple[str, ...], Ports] = {}
        self._close = weakref.finalize(
            self, _release, self._live, self._frees, self._fmu.close, folder
        )

    def _open(self, folder: Path) -> None:
        import fmpy

        unpack(self.path, folder)
        where = str(self.path)
        try:
            description = fmpy.read_model_description(str(folder), validate=False)
        except Exception as error:  # FMPy and lxml raise many kinds
            raise ArchiveError(f"cannot read modelDescription.xml: {error}", where) from error
        if description.fmiVersion != "2.0" and not description.fmiVersion.startswith("3."):
            raise FmuError(f"expected FMI 2.0 or 3.0 (got {description.fmiVersion})", where)
        interface = self._interface(description)
        if interface is None:
            raise FmuError(f"expected a {self.kind} interface (it has none)", where)
        self.version: Literal[2, 3] = 2 if description.fmiVersion == "2.0" else 3
        self.description = description
        self.token = str(description.guid)
        self.variables: Mapping[str, Variable] = {
            v.name: v for v in map(Variable.read, description.modelVariables)
        }
        self._variables = Variables(self.variables, where)
        self._folder = folder
        self._load(str(interface.modelIdentifier))

    def _interface(self, description: Any) -> Any:
        """Return what the description says about the interface used; None if it has none."""
        return description.coSimulation

    def _binding(self) -> Any:
        """Return FMPy's class for the binary."""
        from fmpy.fmi2 import FMU2Slave
        from fmpy.fmi3 import FMU3Slave

        return FMU2Slave if self.version == 2 else FMU3Slave

    def _needed(self) -> list[str]:
        """Return the functions without which no run is possible."""
        steps = ["EnterInitializationMode", "ExitInitializationMode", "DoStep", "FreeInstance"]
        if self.version == 2:
            return [f"fmi2{name}" for name in ("Instantiate", "SetupExperiment", *steps)]
        return [f"fmi3{name}" for name in ("InstantiateCoSimulation", *steps)]

    def _load(self, identifier: str) -> None:
        import fmpy

        where = str(self.path)
        if not identifier.isidentifier():
            raise ArchiveError(f"the modelIdentifier {identifier!r} is no C identifier", where)
        binaries = fmpy.platform if self.version == 2 else fmpy.platform_tuple
        name = identifier + fmpy.sharedLibraryExtension
        self.library = self._folder / "binaries" / binaries / name
        if not self.library.is_file():
            there = sorted(path.parent.name for path in self._folder.glob("binaries/*/*"))
            has = ", ".join(dict.fromkeys(there)) or "none"
            raise FmuError(
                f"expected {name} among the binaries for {binaries} (the FMU has {has})", where
            )
        self._fmu = Binding(self.library, self._binding(), where, self._needed(), self._trace)
        self._functions = self._fmu.functions
        resources = self._folder / "resources"
        place = resources.as_uri() if self.version == 2 else f"{resources}{os.sep}"
        self._resources = place.encode()
        state = "FMUstate" if self.version == 2 else "FMUState"
        self._frees = _Frees(
            self._functions[f"fmi{self.version}FreeInstance"],
            self._functions[f"fmi{self.version}Free{state}"],
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Free all instances, the library and the unpacked files; a second call does nothing."""
        self._close()

    @property
    def closed(self) -> bool:
        """Whether `close` was called."""
        return not self._close.alive

    def instantiate(self, name: str) -> FmuInstance:
        """Create an instance.

        Parameters
        ----------
        name : str
            Of the instance, as its messages and errors show it.

        Raises
        ------
        FmuCallError
            If the FMU refuses.
        """
        if self.closed:
            raise FmuError("the file is closed", str(self.path))
        key = next(_KEYS)
        live = self._live[key] = _Live(
            self._messages, _callbacks(self.version, self._messages, key)
        )
        live.component = self._instantiate(name, key, live.callbacks) or 0
        if not live.component:
            del self._live[key]
            raise FmuCallError(
                _said("the FMU returned no instance", self._messages.of(key)),
                f"{self.path.name}: {name}: fmi{self.version}Instantiate",
                name,
            )
        return self._made(name, key)

    def _made(self, name: str, key: int) -> FmuInstance:
        return FmuInstance(self, name, key)

    def _instantiate(self, name: str, key: int, callbacks: Any) -> int | None:
        text, token = name.encode(), self.token.encode()
        if self.version == 2:
            arguments: tuple[Any, ...] = (
                *(text, 1, token, self._resources),
                *(ctypes.byref(callbacks), 0, 0),  # neither visible nor debug logging
            )
            function = "fmi2Instantiate"
        else:
            from fmpy.fmi3 import fmi3IntermediateUpdateCallback

            arguments = (
                *(text, token, self._resources),
                *(False, False),  # neither visible nor debug logging
                *(False, False, None, 0),  # no event mode, early return, intermediate variables
                *(self._messages.environment(key), callbacks, fmi3IntermediateUpdateCallback()),
            )
            function = "fmi3InstantiateCoSimulation"
        component: int | None = self._functions[function](*arguments)
        return component

    def address(self, function: str) -> int:
        """Address of a function of the binary, for callers that are not Python.

        Raises
        ------
        FmuError
            If the binary has no such function.
        """
        try:
            symbol = getattr(self._fmu.dll, function)
        except AttributeError:
            raise FmuError(f"the binary has no function {function}", str(self.path)) from None
        return int(ctypes.cast(symbol, ctypes.c_void_p).value or 0)

    def variable(self, name: str) -> Variable:
        """Return the variable of that name, or the array that has that element (``u[1]``).

        Raises
        ------
        FmuError
            If there is none; the message names the nearest one.
        """
        return self._variables.resolve(name)[0]

    def ports(self, names: Iterable[str]) -> Ports:
        """Resolve names for `FmuInstance.read` and `write`; see `Variables.ports`."""
        key = tuple(names)
        if key not in self._known_ports:
            self._known_ports[key] = self._variables.ports(key)
        return self._known_ports[key]


class FmuInstance:
    """One Co-Simulation instance; made by `FmuFile.instantiate`.

    The order of calls is that of the standard: set parameters and start values, `initialise` (or
    `enter_initialization`, inputs, `exit_initialization`), then inputs, `do_step` and outputs.

    Attributes
    ----------
    file : FmuFile
    name : str
    time : float
        Where the last successful step ended [s].
    component : int
        Address of the instance, for callers that are not Python.
    key : int
        Tells the instance apart from all others, in its messages.

    Raises
    ------
    FmuCallError
        From every method, when the FMU returns a status other than OK or Warning: with the FMU,
        the instance, the call, the time, and what the FMU logged.
    """

    def __init__(self, file: FmuFile, name: str, key: int) -> None:
        self.file = file
        self.name = name
        self.time = 0.0
        self.key = key
        self._live = file._live[key]
        self.component = self._live.component
        self._prefix = f"fmi{file.version}"
        self._real = "Real" if file.version == 2 else "Float64"
        self._state = "FMUstate" if file.version == 2 else "FMUState"
        self._free = weakref.finalize(self, _free_instance, file._live, key, file._frees)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.free()

    def free(self) -> None:
        """Free the instance and its saved states; a second call does nothing."""
        self._free()

    @property
    def messages(self) -> tuple[str, ...]:
        """What the instance logged during the last call, the last few lines."""
        return tuple(self.file._messages.of(self.key))

    def _call(self, function: str, *arguments: Any) -> None:
        if self.key not in self.file._live:
            raise self.error(function, "the instance was freed")
        self.file._messages.forget(self.key)
        status = self.file._functions[self._prefix + function](self.component, *arguments)
        if status == 0:
            return
        if status == 1:
            self.warn(function, self.messages)
            return
        raise self.status_error(function, status, self.messages)

    def warn(self, function: str, messages: Iterable[str]) -> None:
        """Log that a call returned Warning; parameters as `status_error`."""
        _LOG.warning("%s", _said(f"{self._where(function)} warns", messages))

    def status_error(self, function: str, status: int, messages: Iterable[str]) -> FmuCallError:
        """Return the error for a status other than OK and Warning.

        Parameters
        ----------
        function : str
            Without the prefix: ``DoStep``.
        status : int
            As the FMU returned it.
        messages : iterable of str
            What the instance said during the call.
        """
        label = _STATUS[status] if 0 <= status < len(_STATUS) else "outside the standard"
        return self.error(function, _said(f"returned status {status} ({label})", messages))

    def _where(self, function: str) -> str:
        return f"{self.file.path.name}: {self.name}: {self._prefix}{function}"

    def error(self, function: str, message: str) -> FmuCallError:
        """Return an error with the FMU, the instance, the call and the time."""
        return FmuCallError(
            f"{message} (at time {self.time:g} s)", self._where(function), self.name, self.time
        )

    def ended_early(self, terminates: bool, reached: float) -> FmuCallError:
        """Return the error for a step that did not get to its end."""
        what = "asked to end the simulation" if terminates else "returned early"
        return self.error("DoStep", f"{what} at {reached!r} s")

    def not_finite(self, port: str, value: float) -> FmuCallError:
        """Return the error for a value that is not finite."""
        return self.error(f"Get{self._real}", f"{port} is not finite ({value:g})")

    # ---- life -----------------------------------------------------------------------------------

    def initialise(
        self,
        values: Mapping[str, ArrayLike] | None = None,
        *,
        start: float = 0.0,
        stop: float | None = None,
        tolerance: float | None = None,
    ) -> None:
        """Set parameters, start values and inputs and go through initialisation.

        Parameters
        ----------
        values : mapping, optional
            Name to value; set before and, for inputs, again in Initialization Mode.
        start, stop : float
            Of the experiment [s]; without a stop time none is promised to the FMU.
        tolerance : float, optional
            Relative, for the solver inside the FMU.

        Raises
        ------
        FmuError
            If a name is unknown or a shape wrong.
        """
        values = values or {}
        variable = self.file.variable
        self.set(values)
        self.enter_initialization(start=start, stop=stop, tolerance=tolerance)
        self.set({n: v for n, v in values.items() if variable(n).causality == "input"})
        self.exit_initialization()

    def enter_initialization(
        self, *, start: float = 0.0, stop: float | None = None, tolerance: float | None = None
    ) -> None:
        """Tell the experiment and enter Initialization Mode; parameters as `initialise`."""
        tolerances = (tolerance is not None, tolerance or 0.0)
        experiment = (*tolerances, start, stop is not None, stop or 0.0)
        self.time = start
        if self.file.version == 2:
            self._call("SetupExperiment", *experiment)
            self._call("EnterInitializationMode")
        else:
            self._call("EnterInitializationMode", *experiment)

    def exit_initialization(self) -> None:
        """Leave Initialization Mode; the first step may follow."""
        self._call("ExitInitializationMode")

    def do_step(self, time: float, step: float) -> None:
        """Advance from `time` by `step` [s].

        Raises
        ------
        FmuCallError
            Also if the FMU ends the step early or asks to end the simulation.
        """
        if self.file.version == 2:
            self._call("DoStep", time, step, 0)
        else:
            event, terminate, early = ctypes.c_bool(), ctypes.c_bool(), ctypes.c_bool()
            last = ctypes.c_double()
            by = ctypes.byref
            self._call("DoStep", time, step, False, by(event), by(terminate), by(early), by(last))
            if terminate.value or early.value:
                raise self.ended_early(terminate.value, last.value)
        self.time = time + step

    def terminate(self) -> None:
        """End the simulation; values may still be read."""
        self._call("Terminate")

    def reset(self) -> None:
        """Go back to the state after instantiation."""
        self._call("Reset")
        self.time = 0.0

    # ---- values ---------------------------------------------------------------------------------

    def read(self, ports: Ports) -> Array:
        """Return the values at the ports, in the order of their names.

        Raises
        ------
        FmuCallError
            Also if a value is not finite.
        """
        values = np.empty(ports.size)
        self._exchange("Get", ports, values)
        chosen: Array = values[ports.places]
        if not np.isfinite(chosen).all():
            k = int(np.flatnonzero(~np.isfinite(chosen))[0])
            raise self.not_finite(ports.names[k], chosen[k])
        return chosen

    def write(self, ports: Ports, values: ArrayLike) -> None:
        """Set the values at the ports, in the order of their names."""
        given = np.asarray(values, dtype=float).reshape(-1)
        if given.size != len(ports.names):
            raise FmuError(f"expected {len(ports.names)} values (got {given.size})", self.name)
        whole = np.empty(ports.size)
        if ports.partial:  # the other elements of these arrays stay as they are
            self._exchange("Get", ports, whole)
        whole[ports.places] = given
        self._exchange("Set", ports, whole)

    def _exchange(self, direction: str, ports: Ports, values: Array) -> None:
        arguments = [ports.references, len(ports.references), _pointer(values)]
        if self.file.version == 3:
            arguments.append(ports.size)
        self._call(direction + self._real, *arguments)

    def get(self, name: str) -> Any:
        """Return a value by name: a float, an int, or an array of the variable's shape."""
        variable, index = self.file._variables.resolve(name)
        if variable.type in WHOLE:
            return self._whole("Get", variable, 0)
        values = self.read(self.file.ports((name,)))
        if index is not None or not variable.shape:
            return float(values[0])
        return values.reshape(variable.shape)

    def set(self, values: Mapping[str, ArrayLike]) -> None:
        """Set values by name: scalars, elements (``u[1]``) or whole arrays, also flattened.

        Raises
        ------
        FmuError
            If a name is unknown or a shape wrong.
        """
        real: dict[str, Array] = {}  # all in one call
        for name, value in values.items():
            variable, index = self.file._variables.resolve(name)
            if variable.type in WHOLE:
                self._whole("Set", variable, int(np.asarray(value)))
                continue
            given = np.asarray(value, dtype=float)
            shape = () if index is not None else variable.shape
            if given.shape != shape and given.shape != (math.prod(shape),):
                raise FmuError(f"expected {name!r} of shape {shape} (got {given.shape})", self.name)
            real[name] = given.reshape(-1)
        if real:
            self.write(self.file.ports(real), np.concatenate(list(real.values())))

    def _whole(self, direction: str, variable: Variable, value: int) -> int:
        """Get or set an integer, Boolean or enumeration."""
        if variable.size != 1:
            raise FmuError(f"arrays of {variable.type} are not supported", variable.name)
        kind = variable.type
        if kind == "Enumeration":
            kind = "Integer" if self.file.version == 2 else "Int64"
        name = {"Integer": "c_int", "Boolean": "c_bool"}.get(kind, f"c_{kind.lower()}")
        ctype = ctypes.c_int if self.file.version == 2 else getattr(ctypes, name)
        one = (ctype * 1)(value)
        count = (1,) if self.file.version == 3 else ()
        self._call(direction + kind, (ctypes.c_uint * 1)(variable.reference), 1, one, *count)
        return int(one[0])

    # ---- state ----------------------------------------------------------------------------------

    def get_state(self) -> FmuState:
        """Save the whole state of the instance."""
        handle = ctypes.c_void_p()
        self._call(f"Get{self._state}", ctypes.byref(handle))
        return FmuState(self, handle, self.time)

    def set_state(self, state: FmuState) -> None:
        """Go back to a state saved from this instance."""
        self._call(f"Set{self._state}", state.handle)
        self.time = state.time

    def serialise(self) -> bytes:
        """Return the whole state as bytes, which `deserialise` takes, also in another process."""
        size = ctypes.c_size_t()
        with self.get_state() as state:
            self._call(f"Serialized{self._state}Size", state.handle, ctypes.byref(size))
            buffer = ctypes.create_string_buffer(size.value)
            self._call(f"Serialize{self._state}", state.handle, self._bytes(buffer), size.value)
            return buffer.raw

    def deserialise(self, data: bytes, time: float) -> None:
        """Go to a serialised state.

        Parameters
        ----------
        data : bytes
            From `serialise`.
        time : float
            The instance's time then [s]; the standard has no way to ask for it.
        """
        handle = ctypes.c_void_p()
        buffer = ctypes.create_string_buffer(data, max(len(data), 1))
        word = "DeSerializeFMUstate" if self.file.version == 2 else "DeserializeFMUState"
        self._call(word, self._bytes(buffer), len(data), ctypes.byref(handle))
        with FmuState(self, handle, time) as state:
            self.set_state(state)

    def _bytes(self, buffer: ctypes.Array[ctypes.c_char]) -> Any:
        if self.file.version == 2:
            return buffer
        return ctypes.cast(buffer, ctypes.POINTER(ctypes.c_uint8))

    # ---- derivatives ----------------------------------------------------------------------------

    def directional_derivative(
        self, unknowns: Sequence[str], knowns: Sequence[str], seed: ArrayLike
    ) -> Array:
        """Return the derivative of `unknowns` in the direction `seed` of `knowns`.

        Parameters
        ----------
        unknowns, knowns : sequence of str
            Variables; in FMI 3 an element stands for its array in the call.
        seed : (n,) array_like
            One value per element of the knowns.

        Returns
        -------
        (k,) ndarray
            One value per element of the unknowns.
        """
        of, by = self.file.ports(unknowns), self.file.ports(knowns)
        direction, result = np.zeros(by.size), np.empty(of.size)
        direction[by.places] = np.asarray(seed, dtype=float)
        arguments = [of.references, len(of.references), by.references, len(by.references)]
        if self.file.version == 2:
            arguments += [_pointer(direction), _pointer(result)]
        else:
            arguments += [_pointer(direction), by.size, _pointer(result), of.size]
        self._call("GetDirectionalDerivative", *arguments)
        return np.asarray(result[of.places])


class FmuState:
    """A saved state of one instance; freed by `free`, a ``with`` block, or with the instance."""

    def __init__(self, instance: FmuInstance, handle: ctypes.c_void_p, time: float) -> None:
        self.handle = handle
        self.time = time
        live = instance._live
        live.states[id(handle)] = handle
        self._free = weakref.finalize(self, _free_state, live, handle, instance.file._frees)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.free()

    def free(self) -> None:
        """Free the memory of the state; a second call does nothing."""
        self._free()


# ---- what is alive in the binary, and how it is released -----------------------------------------


_KEYS = itertools.count(1)


@attrs.define(eq=False)
class _Live:
    """An instance as the binary knows it; what it calls back must live as long."""

    messages: Messages
    callbacks: Any
    component: int = 0
    states: dict[int, ctypes.c_void_p] = attrs.field(factory=dict)


@attrs.frozen
class _Frees:
    """The functions of the binary that free an instance and a state."""

    instance: Any
    state: Any


def _free_state(live: _Live, handle: ctypes.c_void_p, frees: _Frees) -> None:
    if live.states.pop(id(handle), None) is not None:
        frees.state(live.component, ctypes.byref(handle))


def _free_instance(instances: dict[int, _Live], key: int, frees: _Frees) -> None:
    live = instances.pop(key, None)
    if live is None:
        return
    for handle in list(live.states.values()):
        _free_state(live, handle, frees)
    frees.instance(live.component)
    live.messages.forget(key)


def _release(
    instances: dict[int, _Live],
    frees: _Frees,
    unload: Any,
    folder: tempfile.TemporaryDirectory[str],
) -> None:
    for key in list(instances):
        _free_instance(instances, key, frees)
    unload()
    folder.cleanup()


class _PythonMessages:
    """Messages kept by Python functions."""

    def __init__(self) -> None:
        from fmpy.fmi2 import fmi2CallbackLoggerTYPE
        from fmpy.fmi3 import fmi3LogMessageCallback

        kept: dict[int, deque[str]] = {}  # the functions must not keep self alive

        def keep(key: int | None, message: bytes | None) -> None:
            text = (message or b"")[:_LONGEST_MESSAGE].decode("utf-8", "replace")
            kept.setdefault(key or 0, deque(maxlen=_KEPT_MESSAGES)).append(text)

        self._kept = kept
        self._functions = {
            2: fmi2CallbackLoggerTYPE(lambda key, _n, _s, _c, text: keep(key, text)),
            3: fmi3LogMessageCallback(lambda key, _s, _c, text: keep(key, text)),
        }

    def logger(self, version: int) -> int:
        return int(ctypes.cast(self._functions[version], ctypes.c_void_p).value or 0)

    def environment(self, key: int) -> int:
        return key

    def forget(self, key: int) -> None:
        self._kept.pop(key, None)

    def of(self, key: int) -> list[str]:
        return list(self._kept.get(key, ()))


def _callbacks(version: int, messages: Messages, key: int) -> Any:
    """Return what an instance gets to call back; none of it goes through Python by itself."""
    if version == 3:
        from fmpy.fmi3 import fmi3LogMessageCallback

        return fmi3LogMessageCallback(messages.logger(3))

    from fmpy import calloc, free
    from fmpy.fmi2 import (
        fmi2CallbackAllocateMemoryTYPE,
        fmi2CallbackFreeMemoryTYPE,
        fmi2CallbackFunctions,
        fmi2CallbackLoggerTYPE,
    )

    functions = fmi2CallbackFunctions()
    functions.logger = fmi2CallbackLoggerTYPE(messages.logger(2))
    functions.allocateMemory = ctypes.cast(calloc, fmi2CallbackAllocateMemoryTYPE)
    functions.freeMemory = ctypes.cast(free, fmi2CallbackFreeMemoryTYPE)
    functions.componentEnvironment = messages.environment(key)
    return functions


def _said(message: str, messages: Iterable[str]) -> str:
    lines = list(messages)
    return f"{message}: {'; '.join(lines)}" if lines else message


def _pointer(values: Array) -> Any:
    return values.ctypes.data_as(ctypes.POINTER(ctypes.c_double))
