"""FMU instances as the C loops see them: calls, ports, messages; and what went wrong, as errors."""

from __future__ import annotations

import ctypes
import logging
import weakref
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any
from typing import Protocol as Interface

import attrs
import numpy as np

from posmas_fmi.cosim.failure import Action, Failure
from posmas_fmi.cosim.loading import address
from posmas_fmi.cosim.served import Served, needs_python
from posmas_fmi.errors import FmuCallError, FmuEndedError, FmuError
from posmas_fmi.fmu.instance import FmuFile, FmuInstance
from posmas_fmi.fmu.variables import Ports
from posmas_fmi.interrupt import Interrupt

if TYPE_CHECKING:
    from posmas_fmi.expression import Array

_LOG = logging.getLogger(__name__)

_int, _double, _pointer = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p
Whole = np.ndarray[tuple[int], np.dtype[np.int64]]


@attrs.frozen(cache_hash=True)  # of many instances, one map
class PortMap:
    """Which FMU variables carry a protocol vector: FMU value = scale × value + offset.

    Attributes
    ----------
    variables : tuple of str
    scale, offset : tuple of float
    units : tuple of (str or None)
        In which scale × value + offset is; it is converted to that of the FMU's variable. None:
        to be taken as it is.
    place : str
        Where in the scenario they are declared.
    rates : tuple of str
        Inputs beside these whose derivative follows: how they go on during a step (FMI 2).
    """

    variables: tuple[str, ...]
    scale: tuple[float, ...]
    offset: tuple[float, ...]
    units: tuple[str | None, ...]
    place: str
    rates: tuple[str, ...] = ()

    @classmethod
    def plain(cls, variables: Sequence[str], place: str = "") -> PortMap:
        """Ports without conversion."""
        n = len(variables)
        return cls(tuple(variables), (1.0,) * n, (0.0,) * n, (None,) * n, place)

    def __add__(self, other: PortMap) -> PortMap:
        return PortMap(
            self.variables + other.variables,
            self.scale + other.scale,
            self.offset + other.offset,
            self.units + other.units,
            self.place,
            self.rates + other.rates,
        )

    @property
    def width(self) -> int:
        """Number of values, rates included."""
        return len(self.variables) + len(self.rates)

    def values_of(self, values: Array) -> dict[str, float]:
        """Return what protocol values are to the FMU, by variable."""
        ports = zip(self.variables, values, self.scale, self.offset, strict=False)
        found = {name: float(v * scale + offset) for name, v, scale, offset in ports}
        rates = zip(self.rates, values[len(self.variables) :], strict=True)
        return found | {f"der({name})": float(value) for name, value in rates}

    @property
    def converts(self) -> bool:
        """Whether the FMU's values are not those of the protocol."""
        return any(s != 1.0 for s in self.scale) or any(b != 0.0 for b in self.offset)


# ---- the structures of csrc/fmus.h and csrc/message_log.h ----------------------------------------


class _Ports(ctypes.Structure):
    _fields_ = (
        ("references", _pointer),
        ("n_references", _int),
        ("n_values", _int),
        ("n_ports", _int),
        ("places", _pointer),
        ("scale", _pointer),
        ("offset", _pointer),
        ("partial", _int),
    )


class _Binding(ctypes.Structure):
    _fields_ = (
        ("fmi", _int),
        ("get", _pointer),
        ("set", _pointer),
        ("do_step", _pointer),
        ("boolean_status", _pointer),
        ("real_status", _pointer),
        ("inputs", _Ports),
        ("readings", _Ports),
        ("set_rates", _pointer),
        ("rate_references", _pointer),
        ("rate_orders", _pointer),
        ("n_rates", _int),
    )


class _Fmus(ctypes.Structure):
    _fields_ = (
        ("n", _int),
        ("bindings", _pointer),
        ("binding", _pointer),
        ("component", _pointer),
        ("input_at", _pointer),
        ("reading_at", _pointer),
        ("room", _int),
        ("messages", _pointer),
        ("remote", _pointer),
        ("is_remote", _pointer),
        ("calling", _pointer),
    )


class Incident(ctypes.Structure):
    """Which call of an FMU was not right; ``call`` is 0 where none."""

    _fields_ = (
        ("call", _int),
        ("instance", _int),
        ("status", _int),
        ("port", _int),
        ("value", _double),
        ("said", _int),
    )


class Report(ctypes.Structure):
    """What the C loops say about the calls of FMUs; ``failure.call`` is 0 where there is none."""

    _fields_ = (("failure", Incident), ("warning", Incident), ("warnings", _int))


_CALLS = (
    *("", "Set", "Get", "DoStep", "DoStep", "DoStep", "Get", "Get", "DoStep", "DoStep", ""),
    "SetRealInputDerivatives",
)
TERMINATED, EARLY, NOT_FINITE = 4, 5, 7
DIED, DEADLINE, INTERRUPTED = 8, 9, 10  # of an FMU in another process
SET_RATES = 11
HOLD_THEM = '; [scenario] input_derivatives = "none" holds the inputs'
READING = (6, NOT_FINITE)  # calls after a step


def call_name(call: int, fmi: int) -> str:
    """Return the name of the FMI function of a call; empty for none."""
    name = _CALLS[call] if 0 <= call < len(_CALLS) else ""
    if name in ("Get", "Set"):
        name += "Real" if fmi < 3 else "Float64"
    return name and f"fmi{fmi}{name}"


_KEPT, _LONGEST = 64, 1016


class _Message(ctypes.Structure):
    _fields_ = (("sender", _int), ("text", ctypes.c_char * _LONGEST))


class MessageLog(ctypes.Structure):
    """The structure of csrc/message_log.h."""

    _fields_ = (("written", _int), ("busy", _int), ("message", _Message * _KEPT))


class _Sender(ctypes.Structure):
    _fields_ = (("log", _pointer), ("key", _int), ("next", _pointer))


class NativeMessages:
    """Messages kept by C functions; implements `posmas_fmi.fmu.instance.Messages`.

    Parameters
    ----------
    library : ctypes.CDLL
        Of `posmas_fmi.cosim.native.fmus_sources`.
    log : MessageLog, optional
        Where they are kept; made here by default.
    """

    def __init__(self, library: ctypes.CDLL, log: MessageLog | None = None) -> None:
        self._library = library
        self._log = MessageLog() if log is None else log
        self._senders: dict[int, _Sender] = {}
        for name in ("message_log_enter", "message_log_leave"):
            getattr(library, name).argtypes = [_pointer]
            getattr(library, name).restype = None
        weakref.finalize(self, _leave, library, self._senders)
        self._begin: dict[int, int] = {}
        self._loggers = {
            version: int(ctypes.cast(function, _pointer).value or 0)
            for version, function in ((2, library.message_log_fmi2), (3, library.message_log_fmi3))
        }

    @property
    def address(self) -> int:
        """Where the C loops find it."""
        return ctypes.addressof(self._log)

    def logger(self, version: int) -> int:
        """Address of the function that FMUs of this FMI version call."""
        return self._loggers[version]

    def environment(self, key: int) -> int:
        """Return what the instance gives to that function."""
        if key not in self._senders:
            sender = self._senders[key] = _Sender(self.address, key)
            self._library.message_log_enter(ctypes.addressof(sender))
        return ctypes.addressof(self._senders[key])

    def add(self, key: int, text: str) -> None:
        """Keep what was found out about an instance, as if it had said it."""
        write = self._library.message_log_fmi3
        write.argtypes, write.restype = [_pointer, ctypes.c_int, *(ctypes.c_char_p,) * 2], None
        write(self.environment(key), 3, b"error", text.encode())

    def forget(self, key: int) -> None:
        """Leave out what the instance has said so far."""
        self._begin[key] = self._log.written

    def of(self, key: int) -> list[str]:
        """Return the last few messages of the instance."""
        return self.since(key, self._begin.get(key, 0))

    def since(self, key: int, begin: int) -> list[str]:
        """Return those of its messages that came after the first `begin` of all, if still kept."""
        written = self._log.written
        kept = (self._log.message[k % _KEPT] for k in range(max(begin, written - _KEPT), written))
        return [m.text.decode("utf-8", "replace") for m in kept if m.sender == key]


def _leave(library: ctypes.CDLL, senders: dict[int, _Sender]) -> None:
    for sender in reversed(senders.values()):  # the last that came is found at once
        library.message_log_leave(ctypes.addressof(sender))


# ---- the instances -------------------------------------------------------------------------------


class Elsewhere(Interface):
    """Instances in other processes.

    Attributes
    ----------
    address : int
        Of the structure `Remote` in csrc/fmus.h.
    is_remote : (n,) array of int
        Of each instance.
    interrupt : Interrupt
        Of the run that goes on.
    """

    is_remote: Whole
    interrupt: Interrupt

    @property
    def address(self) -> int:
        """Of the structure."""

    def error(self, incident: Incident) -> FmuCallError:
        """Return what ended the run as an error, and note it."""


class Fmus:
    """FMU instances with their ports: the agents' first, then those that are no agents.

    Parameters
    ----------
    instances : sequence of FmuInstance
        Initialised. They must outlive this object.
    inputs, readings : sequence of PortMap
        What is set before and read after each step, of each instance.
    messages : NativeMessages, optional
        Where the instances log, if not in Python.

    Attributes
    ----------
    input_at, reading_at : (n + 1,) array of int
        Where the inputs and readings of each instance begin among those of all.
    inputs : array or None
        Those of all, where the loop that is running has them.
    failures : list of Failure
        Those that have been told so far.
    """

    def __init__(
        self,
        instances: Sequence[FmuInstance],
        inputs: Sequence[PortMap],
        readings: Sequence[PortMap],
        messages: NativeMessages | None = None,
    ) -> None:
        self._instances = list(instances)
        self._messages = messages
        self._inputs, self._readings = tuple(inputs), tuple(readings)
        self.inputs: Array | None = None
        self._remote: Elsewhere | None = None
        self._interrupt = Interrupt()
        self.failures: list[Failure] = []
        self._keep: list[Any] = []  # what the structures point to
        self._served = Served(None if messages is None else messages.add)
        kinds = list(zip((i.file for i in instances), inputs, readings, strict=True))
        number = {kind: k for k, kind in enumerate(dict.fromkeys(kinds))}
        bindings = (_Binding * len(number))(*(self._bind(*kind) for kind in number))
        places = np.array([number[kind] for kind in kinds], dtype=np.int64)
        self._components = np.array(
            [self._component(*kind, i) for kind, i in zip(kinds, instances, strict=True)],
            dtype=np.uintp,
        )
        self.input_at = _starts([ports.width for ports in inputs])
        self.reading_at = _starts([len(ports.variables) for ports in readings])
        self._keep += [bindings, places]
        rooms = [max(b.inputs.n_values, b.readings.n_values) for b in bindings]
        self.room = -(-max(rooms) // 8) * 8  # whole cache lines
        self.structure = _Fmus(
            len(instances),
            ctypes.addressof(bindings),
            places.ctypes.data,
            self._components.ctypes.data,
            self.input_at.ctypes.data,
            self.reading_at.ctypes.data,
            self.room,
            messages.address if messages else None,
            None,
            None,
        )

    def __len__(self) -> int:
        return len(self._instances)

    def _component(
        self, file: FmuFile, inputs: PortMap, readings: PortMap, instance: FmuInstance
    ) -> int:
        ports = (file.ports(one.variables) for one in (inputs, readings))
        return self._served.add(instance) if needs_python(file, *ports) else instance.component

    def use(self, remote: Elsewhere) -> None:
        """Step some of the instances in other processes."""
        self._remote = remote
        self.structure.remote = remote.address
        self.structure.is_remote = remote.is_remote.ctypes.data

    def is_remote(self, number: int) -> bool:
        """Whether an instance is in another process."""
        return self._remote is not None and bool(self._remote.is_remote[number])

    def obey(self, interrupt: Interrupt) -> None:
        """Wait for other processes only while no Ctrl-C has come."""
        self._interrupt = interrupt
        if self._remote is not None:
            self._remote.interrupt = interrupt

    def check_interrupt(self) -> None:
        """Raise KeyboardInterrupt if Ctrl-C has come."""
        self._interrupt.check()

    def _bind(self, file: FmuFile, inputs: PortMap, readings: PortMap) -> _Binding:
        if needs_python(file, file.ports(inputs.variables), file.ports(readings.variables)):
            served = self._served
            return _Binding(
                *(3, served.get, served.set, served.do_step, None, None),
                *(self._served_ports(file, ports) for ports in (inputs, readings)),
                *self._served_rates(file, inputs.rates),
            )
        prefix, real = f"fmi{file.version}", "Real" if file.version == 2 else "Float64"
        return _Binding(
            file.version,
            file.address(f"{prefix}Get{real}"),
            file.address(f"{prefix}Set{real}"),
            file.address(f"{prefix}DoStep"),
            *(_optional(file, name) for name in ("fmi2GetBooleanStatus", "fmi2GetRealStatus")),
            self._c_ports(file.ports(inputs.variables), inputs),
            self._c_ports(file.ports(readings.variables), readings),
            *self._rates(file, inputs.rates),
        )

    def _rates(self, file: FmuFile, names: tuple[str, ...]) -> tuple[int | None, ...]:
        """How input derivatives are set."""
        if not names:
            return None, None, None, 0
        n, function = len(names), _optional(file, "fmi2SetRealInputDerivatives")
        if function is None:
            _LOG.warning(
                "%s says that it interpolates inputs, but has no function for it: they are held",
                file.path.name,
            )
        references = (ctypes.c_uint32 * n)(*(file.variable(name).reference for name in names))
        orders = (ctypes.c_int32 * n)(*[1] * n)
        self._keep += [references, orders]
        places = ctypes.addressof(references), ctypes.addressof(orders)
        return function, *places, n

    def _served_rates(self, file: FmuFile, names: tuple[str, ...]) -> tuple[int | None, ...]:
        """How Python sets them: their number stands for all."""
        if not names:
            return None, None, None, 0
        reference = (ctypes.c_uint32 * 1)(self._served.number(file.ports(names)))
        self._keep.append(reference)
        return self._served.set_rates, ctypes.addressof(reference), None, len(names)

    def _c_ports(self, ports: Ports, port_map: PortMap) -> _Ports:
        n = len(ports.names)
        in_order = ports.size == n and bool((ports.places == np.arange(n)).all())
        places = None if in_order else ports.places.astype(np.int64)
        self._keep += [ports, places]
        return _Ports(
            ctypes.addressof(ports.references),
            len(ports.references),
            ports.size,
            n,
            None if places is None else places.ctypes.data,
            *self._conversion(port_map),
            ports.partial,
        )

    def _served_ports(self, file: FmuFile, port_map: PortMap) -> _Ports:
        """Ports that Python reads and writes: one reference, their number, stands for all."""
        ports = file.ports(port_map.variables)
        n = len(ports.names)
        reference = (ctypes.c_uint32 * 1)(self._served.number(ports))
        self._keep.append(reference)
        return _Ports(
            ctypes.addressof(reference), int(n > 0), n, n, None, *self._conversion(port_map), 0
        )

    def _conversion(self, port_map: PortMap) -> tuple[int | None, int | None]:
        """Addresses of scale and offset; None where nothing is converted."""
        if not port_map.converts:
            return None, None
        scale, offset = np.array(port_map.scale), np.array(port_map.offset)
        self._keep += [scale, offset]
        return scale.ctypes.data, offset.ctypes.data

    @property
    def address(self) -> int:
        """Where the C loops find the structure."""
        return ctypes.addressof(self.structure)

    def set_time(self, time: float) -> None:
        """Tell the instances where the C loops have taken them [s]."""
        for instance in self._instances:
            instance.time = time

    def warn(self, report: Report, time: float) -> None:
        """Log the first of the calls that returned Warning, if any, and how many there were."""
        if not report.warnings:
            return
        instance, function, messages = self._call_of(report.warning, time)
        instance.warn(function, messages)
        if report.warnings > 1:
            _LOG.warning("%d more calls of FMUs returned Warning", report.warnings - 1)

    def error(self, failure: Incident, time: float) -> FmuCallError:
        """Return what ended the run as an error, and note it; the run stood at `time` [s].

        An FMU that asked for the end is an `FmuEndedError`, and no failure. What a call through
        Python raised, and is no `FmuError`, is raised here.
        """
        if self._remote is not None and self._remote.is_remote[failure.instance]:
            return self._remote.error(failure)
        error = self._error(failure, time)
        if not isinstance(error, FmuEndedError):
            self.failures.append(self._failure(failure, error, "stopped"))
        return error

    def freeze(self, incident: Incident, time: float) -> None:
        """Note that an instance of this process has failed and is not stepped any more."""
        failure = self._failure(incident, self._error(incident, time), "frozen")
        self.failures.append(failure)
        _LOG.warning("%s; it is frozen", failure)

    def _failure(self, incident: Incident, error: FmuCallError, action: Action) -> Failure:
        instance = self._instances[incident.instance]
        return Failure(
            agent=instance.name,
            fmu=instance.file.path.name,
            call=call_name(incident.call, instance.file.version),
            time=error.time,
            inputs=self._inputs_of(incident.instance),
            cause=error.message.removesuffix(f" (at time {error.time:g} s)"),
            action=action,
            status=incident.status or None,
        )

    def _inputs_of(self, number: int) -> dict[str, float]:
        """Return what an instance was given for the present step, as it takes it."""
        if self.inputs is None:
            return {}
        values = self.inputs[self.input_at[number] : self.input_at[number + 1]]
        return self._inputs[number].values_of(values)

    def _error(self, failure: Incident, time: float) -> FmuCallError:
        instance, function, messages = self._call_of(failure, time)
        raised = self._served.failure(instance)
        if isinstance(raised, FmuCallError):
            return raised
        if isinstance(raised, FmuError):
            return instance.error(function, raised.message)
        if raised is not None:
            raise raised
        if failure.call in (TERMINATED, EARLY):
            return instance.ended_early(failure.call == TERMINATED, failure.value)
        if failure.call == NOT_FINITE:
            name = self._readings[failure.instance].variables[failure.port]
            return instance.not_finite(name, failure.value)
        error = instance.status_error(function, failure.status, messages)
        if failure.call == SET_RATES:
            error.message += HOLD_THEM
        return error

    def _call_of(self, incident: Any, time: float) -> tuple[FmuInstance, str, Sequence[str]]:
        instance = self._instances[incident.instance]
        instance.time = time
        function = _CALLS[incident.call]
        if function in ("Get", "Set"):
            function += "Real" if instance.file.version < 3 else "Float64"
        messages: Sequence[str] = instance.messages
        if self.is_remote(incident.instance):
            return instance, function, messages
        if self._messages is not None:
            messages = self._messages.since(instance.key, incident.said)
        return instance, function, messages


class FmuLoop:
    """Many FMUs stepped and read by one call each: for a loop that is written in Python.

    Parameters
    ----------
    fmus : Fmus
    library : ctypes.CDLL
        Of `posmas_fmi.cosim.native.fmus_sources`.
    incidents : array of Incident, optional
        One for each instance: those that fail are noted there, and the others go on.
    """

    def __init__(self, fmus: Fmus, library: ctypes.CDLL, incidents: Any = None) -> None:
        self._fmus = fmus
        self._incidents = None if incidents is None else ctypes.addressof(incidents)
        self._step, self._read = library.fmus_step_all, library.fmus_read_all
        self._step.argtypes = [_pointer, _pointer, _int, *(_pointer,) * 7]
        self._read.argtypes = [_pointer, _pointer, _int, *(_pointer,) * 4]
        self._step.restype = self._read.restype = None
        self._scratch = np.zeros(fmus.room)
        self._unread = Report()  # of the last step: an FMU that could not be read after it

    def step(self, which: Whole, t: Array, h: Array, inputs: Array, readings: Array) -> None:
        """Set the inputs of some instances, let them step, and write their readings.

        Parameters
        ----------
        which : (n,) array of int
            Numbers of the instances.
        t, h : (n,) array
            From where, and how far [s].
        inputs, readings : array
            Of all instances, one after the other.

        Raises
        ------
        FmuCallError
            For the first FMU that cannot be stepped, unless incidents are noted; those after it
            have not stepped. One that cannot be read is for `check_readings`.
        """
        report = Report()
        self._step(
            self._fmus.address,
            address(which),
            len(which),
            address(t),
            address(h),
            address(inputs),
            address(readings),
            address(self._scratch),
            ctypes.addressof(report),
            self._incidents,
        )
        self._unread = Report()
        if report.failure.call in READING:
            self._unread.failure, report.failure = report.failure, Incident()
        self._check(report, float(t[0]) if len(t) else 0.0)

    def check_readings(self, t: float) -> None:
        """Raise what the last step, which ended at t [s], could not read.

        Raises
        ------
        FmuCallError
            For the first FMU.
        """
        self._check(self._unread, t)

    def read(self, which: Whole, t: float, readings: Array) -> None:
        """Write the readings of some instances into those of all.

        Raises
        ------
        FmuCallError
            For the first FMU that fails.
        """
        report = Report()
        self._read(
            self._fmus.address,
            address(which),
            len(which),
            address(readings),
            address(self._scratch),
            ctypes.addressof(report),
            self._incidents,
        )
        self._check(report, t)

    def _check(self, report: Report, time: float) -> None:
        self._fmus.check_interrupt()
        self._fmus.warn(report, time)
        if report.failure.call:
            raise self._fmus.error(report.failure, time)


def _optional(file: FmuFile, function: str) -> int | None:
    """Address of a function of FMI 2 that not every binary has."""
    try:
        return file.address(function) if file.version == 2 else None
    except FmuError:
        return None


def _starts(sizes: Sequence[int]) -> Whole:
    return np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
