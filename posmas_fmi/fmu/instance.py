"""Co-Simulation instances of an FMU in this process: every status and every value is checked."""

from __future__ import annotations

import ctypes
import logging
import math
import weakref
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import attrs
import numpy as np
from numpy.typing import ArrayLike

from posmas_fmi.errors import FmuCallError, FmuEndedError, FmuError
from posmas_fmi.fmu.callbacks import said
from posmas_fmi.fmu.live import free_instance
from posmas_fmi.fmu.state import FmuState, joined, parted
from posmas_fmi.fmu.variables import WHOLE, Group, Ports, Variable, pointer

if TYPE_CHECKING:
    from posmas_fmi.expression import Array
    from posmas_fmi.fmu.file import FmuFile as FmuFile

_LOG = logging.getLogger(__name__)
_MOST_RETURNS = 100_000  # before the end of one step
MOST_STUCK = 100  # of them at the same time
_SAME = 1e-9  # of a step: times that are the same
_DISCARD, _PENDING = 2, 5
_LAST_SUCCESSFUL_TIME, _TERMINATED = 2, 3  # fmi2StatusKind
_STATUS = ("OK", "Warning", "Discard", "Error", "Fatal", "Pending")


def __getattr__(name: str) -> Any:
    if name == "FmuFile":  # moved; until all users have followed
        from posmas_fmi.fmu.file import FmuFile

        return FmuFile
    raise AttributeError(name)


def status_label(status: int) -> str:
    """Return the standard's name of a status."""
    return _STATUS[status] if 0 <= status < len(_STATUS) else "outside the standard"


@attrs.frozen
class Step:
    """Where one call of DoStep ended.

    Attributes
    ----------
    reached : float
        [s]
    early : bool
        Whether that is before the end that was asked for.
    event : bool
        Whether the FMU asks for Event Mode.
    """

    reached: float
    early: bool = False
    event: bool = False


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
        self._real = "Real" if file.version < 3 else "Float64"
        self._state = "FMUstate" if file.version == 2 else "FMUState"
        self._status = 0  # of the last call
        self._free = weakref.finalize(self, free_instance, file._live, key, file._frees)

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

    def call(self, function: str, *arguments: Any) -> None:
        """Call a function of the FMI, named without its prefix, and check the status.

        Raises
        ------
        FmuCallError
        """
        if self.key not in self.file._live:
            raise self.error(function, "the instance was freed")
        self.file._messages.forget(self.key)
        status = self.file._functions[self._prefix + function](self.component, *arguments)
        self._status = status
        if status == 0:
            return
        if status == 1:
            self.warn(function, self.messages)
            return
        raise self.status_error(function, status, self.messages)

    def warn(self, function: str, messages: Iterable[str]) -> None:
        """Log that a call returned Warning; parameters as `status_error`."""
        _LOG.warning("%s", said(f"{self._where(function)} warns", messages))

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
        text = f"returned status {status} ({status_label(status)})"
        if status == _PENDING:
            text += ", as if the call went on by itself; such asynchronous steps are not supported"
        return self.error(function, said(text, messages))

    def _where(self, function: str) -> str:
        return f"{self.file.path.name}: {self.name}: {self._prefix}{function}"

    def error(self, function: str, message: str) -> FmuCallError:
        """Return an error with the FMU, the instance, the call and the time."""
        return FmuCallError(
            f"{message} (at time {self.time:g} s)", self._where(function), self.name, self.time
        )

    def ended_early(self, terminates: bool, reached: float) -> FmuCallError:
        """Return the error for a step that did not get to its end."""
        if terminates:
            return self.ended("DoStep", reached)
        return self.error(
            "DoStep",
            f"returned early at {reached!r} s: expected times within the step, then its end",
        )

    def ended(self, function: str, reached: float) -> FmuEndedError:
        """Return what is told when the FMU asks to end the simulation, which is no failure."""
        where = self._where(function)
        return FmuEndedError(
            f"asked to end the simulation at {reached:g} s", where, self.name, reached
        )

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
        given = self.file.given(values or {})
        self.set(given)
        self.enter_initialization(start=start, stop=stop, tolerance=tolerance)
        if given.inputs is not None:
            self.set(given.inputs)
        self.exit_initialization()

    def configure(self, structure: Mapping[str, int]) -> None:
        """Set structural parameters in Configuration Mode, right after instantiation (FMI 3)."""
        self.call("EnterConfigurationMode")
        self.set(structure)
        self.call("ExitConfigurationMode")

    def enter_initialization(
        self, *, start: float = 0.0, stop: float | None = None, tolerance: float | None = None
    ) -> None:
        """Tell the experiment and enter Initialization Mode; parameters as `initialise`."""
        tolerances = (tolerance is not None, tolerance or 0.0)
        experiment = (*tolerances, start, stop is not None, stop or 0.0)
        self.time = start
        if self.file.version == 2:
            self.call("SetupExperiment", *experiment)
            self.call("EnterInitializationMode")
        else:
            self.call("EnterInitializationMode", *experiment)

    def exit_initialization(self) -> None:
        """Leave Initialization Mode; the first step may follow."""
        self.call("ExitInitializationMode")

    def do_step(self, time: float, step: float) -> None:
        """Advance from `time` by `step` [s].

        Where the FMU returns before the end, the step is continued to its end.

        Raises
        ------
        FmuCallError
            Also if the FMU asks to end the simulation.
        """
        end, now, length = time + step, time, step
        stuck = 0
        for _ in range(_MOST_RETURNS):
            done = self.step_once(now, length)
            if not done.early or done.reached >= end - _SAME * step:
                self.time = end
                return
            stuck = 0 if done.reached > now else stuck + 1
            if stuck > MOST_STUCK:
                raise self.error("DoStep", f"returned early {stuck} times at {now!r} s")
            now, length = done.reached, end - done.reached
        raise self.error("DoStep", f"returned early {_MOST_RETURNS} times, at last at {now!r} s")

    def step_once(self, time: float, step: float) -> Step:
        """Call DoStep once.

        Raises
        ------
        FmuCallError
            Also if the FMU asks to end the simulation, or returns at a time outside the step.
        """
        if self.file.version == 2:
            try:
                self.call("DoStep", time, step, 0)
            except FmuCallError:
                if self._status == _DISCARD and self._asks_to_end():
                    raise self.ended_early(True, self._last_time(time)) from None
                raise
            return Step(time + step)
        event, terminate, early = ctypes.c_bool(), ctypes.c_bool(), ctypes.c_bool()
        last = ctypes.c_double(time)
        by = ctypes.byref
        self.call("DoStep", time, step, False, by(event), by(terminate), by(early), by(last))
        inside = time <= last.value <= time + step * (1 + _SAME)  # not of NaN
        if terminate.value:
            raise self.ended_early(True, last.value if inside else time)
        if early.value and not inside:
            raise self.ended_early(False, last.value)
        return Step(last.value if early.value else time + step, early.value, event.value)

    def _asks_to_end(self) -> bool:
        """After Discard: whether it is because the FMU wants to end the simulation (FMI 2)."""
        terminated = ctypes.c_int()
        with suppress(FmuError):
            self.call("GetBooleanStatus", _TERMINATED, ctypes.byref(terminated))
        return bool(terminated.value)

    def _last_time(self, time: float) -> float:
        """Where the step got to [s]."""
        reached = ctypes.c_double(time)
        with suppress(FmuError):
            self.call("GetRealStatus", _LAST_SUCCESSFUL_TIME, ctypes.byref(reached))
        return reached.value if math.isfinite(reached.value) else time

    def terminate(self) -> None:
        """End the simulation; values may still be read."""
        self.call("Terminate")

    def reset(self) -> None:
        """Go back to the state after instantiation."""
        self.call("Reset")
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
        self.read_whole(ports, values)
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
        self.write_whole(ports, whole)

    def read_whole(self, ports: Ports, values: Array) -> None:
        """Read all values that the calls for the ports exchange, (ports.size,)."""
        self._exchange("Get", ports, values)

    def write_whole(self, ports: Ports, values: Array) -> None:
        """Set all values that the calls for the ports exchange, (ports.size,)."""
        self._exchange("Set", ports, values)

    def _exchange(self, direction: str, ports: Ports, values: Array) -> None:
        begin = 0
        for group in ports.groups:
            part = values[begin : begin + group.size]
            if direction == "Set":
                self._transfer("Set", group, group.encode(part, self.name))
            elif group.dtype == float:
                self._transfer("Get", group, part)
            else:
                typed = np.empty(group.size, group.dtype)
                self._transfer("Get", group, typed)
                part[:] = typed
            begin += group.size

    def _transfer(self, direction: str, group: Group, values: np.ndarray[Any, Any]) -> None:
        count = (group.size,) if self.file.version == 3 else ()
        references = group.references
        self.call(direction + group.kind, references, len(references), pointer(values), *count)

    def set_input_derivatives(self, ports: Ports, values: ArrayLike, order: int = 1) -> None:
        """Tell how continuous inputs go on during the next step, instead of being held (FMI 2).

        Parameters
        ----------
        ports : Ports
            Inputs that are Reals.
        values : (n,) array_like
            Derivative of that order of each [1/s**order].
        order : int
            From 1.

        Raises
        ------
        FmuError
            If the FMU does not say that it interpolates inputs (canInterpolateInputs).
        """
        interface = self.file.about.interface
        if self.file.version != 2 or not getattr(interface, "canInterpolateInputs", False):
            raise self.error(
                "SetRealInputDerivatives", "it does not interpolate inputs (canInterpolateInputs)"
            )
        given = np.array(values, dtype=float).reshape(-1)
        if given.size != len(ports.names):
            raise FmuError(f"expected {len(ports.names)} values (got {given.size})", self.name)
        n = len(ports.references)
        in_order, orders = np.empty(n), (ctypes.c_int * n)(*[order] * n)
        in_order[ports.places] = given
        self.call("SetRealInputDerivatives", ports.references, n, orders, pointer(in_order))

    def get(self, name: str) -> Any:
        """Return a value by name: a float, an int, a str, or an array of the variable's shape."""
        variable, index = self.file._variables.resolve(name)
        if variable.type == "String":
            return self._get_text(variable)
        if variable.type in WHOLE:
            whole = self._whole(variable)
            return whole if index is None and variable.shape else int(whole.flat[index or 0])
        values = self.read(self.file.ports((name,)))
        if index is not None or not variable.shape:
            return float(values[0])
        return values.reshape(variable.shape)

    def set(self, values: Mapping[str, Any]) -> None:
        """Set values by name: scalars, elements (``u[1]``) or whole arrays, also flattened.

        Raises
        ------
        FmuError
            If a name is unknown or a shape wrong.
        InputError
            If a value is neither a text nor numbers.
        """
        given = self.file.given(values)
        for name, text in given.texts.items():
            self._set_text(given.form.texts[name], text)
        if given.flat.size:
            self.write(given.form.ports, given.flat)

    def _whole(self, variable: Variable) -> np.ndarray[Any, Any]:
        """Read integers without going through floats."""
        ports = self.file.ports((variable.name,))
        typed = np.empty(ports.size, ports.groups[0].dtype)
        self._transfer("Get", ports.groups[0], typed)
        return typed.reshape(variable.shape)

    def _get_text(self, variable: Variable) -> str:
        found = (ctypes.c_char_p * 1)()
        count = (1,) if self.file.version == 3 else ()
        self.call("GetString", (ctypes.c_uint * 1)(variable.reference), 1, found, *count)
        return (found[0] or b"").decode("utf-8", "replace")

    def _set_text(self, variable: Variable, text: str) -> None:
        texts = (ctypes.c_char_p * 1)(text.encode())
        count = (1,) if self.file.version == 3 else ()
        self.call("SetString", (ctypes.c_uint * 1)(variable.reference), 1, texts, *count)

    # ---- state ----------------------------------------------------------------------------------

    def get_state(self) -> FmuState:
        """Save the whole state of the instance."""
        handle = ctypes.c_void_p()
        self.call(f"Get{self._state}", ctypes.byref(handle))
        return FmuState(self, handle, self.time, self._beside())

    def set_state(self, state: FmuState) -> None:
        """Go back to a state saved from this instance."""
        self.call(f"Set{self._state}", state.handle)
        self.time = state.time
        if state.beside:
            self._set_beside(state.beside)

    def _beside(self) -> dict[str, Any]:
        """Return what is kept here and not in the FMU, as JSON has it; empty for nothing."""
        return {}

    def _set_beside(self, kept: dict[str, Any]) -> None:
        """Go back to what `_beside` returned."""

    def serialise(self) -> bytes:
        """Return the whole state as bytes, which `deserialise` takes, also in another process."""
        size = ctypes.c_size_t()
        with self.get_state() as state:
            self.call(f"Serialized{self._state}Size", state.handle, ctypes.byref(size))
            buffer = ctypes.create_string_buffer(size.value)
            self.call(f"Serialize{self._state}", state.handle, self._bytes(buffer), size.value)
            return joined(buffer.raw, state.beside)

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
        inside, beside = parted(data)
        buffer = ctypes.create_string_buffer(inside, max(len(inside), 1))
        word = "DeSerializeFMUstate" if self.file.version == 2 else "DeserializeFMUState"
        self.call(word, self._bytes(buffer), len(inside), ctypes.byref(handle))
        with FmuState(self, handle, time, beside) as state:
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
            arguments += [pointer(direction), pointer(result)]
        else:
            arguments += [pointer(direction), by.size, pointer(result), of.size]
        self.call("GetDirectionalDerivative", *arguments)
        return np.asarray(result[of.places])
