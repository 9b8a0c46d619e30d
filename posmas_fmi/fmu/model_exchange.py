"""Model Exchange instances of an FMU: its right-hand side, its events, and an integrator for it."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from posmas_fmi.fmu.events import EventInfo, settle, update_discrete_states
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.instance import FmuInstance
from posmas_fmi.fmu.variables import pointer

if TYPE_CHECKING:
    from posmas_fmi.expression import Array  # SymPy, which a worker does not need

_MOST_EVENTS = 10_000  # on the way to one point in time
_EVENT_WIDTH = 1e-12  # relative: how closely a state event is located


class ModelExchangeFile(FmuFile):
    """An FMU unpacked and loaded once, for any number of Model Exchange instances.

    Parameters, attributes and errors are those of `posmas_fmi.fmu.file.FmuFile`.
    """

    kind = "Model Exchange"

    def _binding(self) -> Any:
        from fmpy.fmi2 import FMU2Model
        from fmpy.fmi3 import FMU3Model

        return FMU2Model if self.version == 2 else FMU3Model

    def _needed(self) -> list[str]:
        kinds = {2: "Instantiate", 3: "InstantiateModelExchange"}
        steps = ["SetTime", "SetContinuousStates", "EnterContinuousTimeMode", "FreeInstance"]
        rates = {2: "GetDerivatives", 3: "GetContinuousStateDerivatives"}
        names = (kinds[self.version], *steps, rates[self.version])
        return [f"fmi{self.version}{name}" for name in names]

    def _instantiate(self, name: str, key: int, callbacks: Any) -> int | None:
        text, token = name.encode(), self.token.encode()
        quiet = (False, self._logs)  # not visible
        if self.version == 2:
            arguments: tuple[Any, ...] = (text, 0, token, self._resources)
            arguments += (ctypes.byref(callbacks), *quiet)
            function = "fmi2Instantiate"
        else:
            arguments = (text, token, self._resources, *quiet)
            arguments += (self._messages.environment(key), callbacks)
            function = "fmi3InstantiateModelExchange"
        component: int | None = self._functions[function](*arguments)
        return component

    def _made(self, name: str, key: int) -> ModelExchangeInstance:
        return ModelExchangeInstance(self, name, key)

    def instantiate(self, name: str) -> ModelExchangeInstance:
        """Create an instance; see `FmuFile.instantiate`."""
        made = super().instantiate(name)
        assert isinstance(made, ModelExchangeInstance)
        return made


class ModelExchangeInstance(FmuInstance):
    """One Model Exchange instance; made by `ModelExchangeFile.instantiate`.

    The order of calls: `initialise`, `start`, then `evaluate` wherever the right-hand side is
    wanted, or `advance` along the trajectory.

    Attributes
    ----------
    n_states, n_indicators : int
        Numbers of continuous states and event indicators.
    next_event : float
        Time of the next time event [s]; inf if none is known.

    Raises
    ------
    FmuCallError
        As `posmas_fmi.fmu.instance.FmuInstance`.
    """

    def __init__(self, file: FmuFile, name: str, key: int) -> None:
        super().__init__(file, name, key)
        self.n_states = int(file.description.numberOfContinuousStates)
        self.n_indicators = int(file.description.numberOfEventIndicators)
        self.next_event = math.inf
        interface = file.description.modelExchange
        self._completes = not interface.completedIntegratorStepNotNeeded
        if file.version == 3:
            self._completes = bool(interface.needsCompletedIntegratorStep)

    # ---- modes ----------------------------------------------------------------------------------

    def configure(self, structure: Mapping[str, int]) -> None:
        """Set structural parameters, which the numbers of states and indicators may follow."""
        super().configure(structure)
        for name, what in (
            ("n_states", "ContinuousStates"),
            ("n_indicators", "EventIndicators"),
        ):
            count = ctypes.c_size_t()
            self.call(f"GetNumberOf{what}", ctypes.byref(count))
            setattr(self, name, count.value)

    def start(self) -> None:
        """After `initialise`: settle the discrete states and enter Continuous-Time Mode."""
        self._settle()

    def handle_event(self) -> None:
        """Go through Event Mode and back to Continuous-Time Mode."""
        self.call("EnterEventMode")
        self._settle()

    def _settle(self) -> None:
        self.next_event = settle(self, self.update_discrete_states)
        self.call("EnterContinuousTimeMode")

    def update_discrete_states(self) -> EventInfo:
        """In Event Mode: update the discrete states once."""
        return update_discrete_states(self)

    # ---- state ----------------------------------------------------------------------------------

    def _beside(self) -> dict[str, Any]:
        return {"time": self.time, "next_event": self.next_event}

    def _set_beside(self, kept: dict[str, Any]) -> None:
        self.time, self.next_event = kept["time"], kept["next_event"]

    # ---- values ---------------------------------------------------------------------------------

    def set_time(self, time: float) -> None:
        """Set the independent variable [s]."""
        self.call("SetTime", time)
        self.time = time

    def set_states(self, x: ArrayLike) -> None:
        """Set the continuous states, (n_states,)."""
        values = np.array(x, dtype=float).reshape(-1)
        if values.size != self.n_states:
            raise self.error(
                "SetContinuousStates", f"expected {self.n_states} states (got {values.size})"
            )
        if values.size:
            self.call("SetContinuousStates", pointer(values), values.size)

    def states(self) -> Array:
        """Return the continuous states, (n_states,)."""
        return self._vector("GetContinuousStates", self.n_states)

    def derivatives(self) -> Array:
        """Return the derivatives of the continuous states, (n_states,)."""
        version = self.file.version
        name = "GetDerivatives" if version < 3 else "GetContinuousStateDerivatives"
        return self._vector(name, self.n_states)

    def nominals(self) -> Array:
        """Return the typical sizes of the continuous states, (n_states,); 1 where it says 0."""
        values = np.abs(self._vector("GetNominalsOfContinuousStates", self.n_states))
        return np.where(values > 0, values, 1.0)

    def event_indicators(self) -> Array:
        """Return the event indicators, (n_indicators,); a sign change is a state event."""
        return self._vector("GetEventIndicators", self.n_indicators)

    def _vector(self, function: str, size: int) -> Array:
        values = np.full(size, np.nan)
        if size:
            self.call(function, pointer(values), size)
        if not np.isfinite(values).all():
            k = int(np.flatnonzero(~np.isfinite(values))[0])
            raise self.error(function, f"value {k + 1} is not finite ({values[k]:g})")
        return values

    # ---- the way through time -------------------------------------------------------------------

    def advance(self, until: float, rtol: float = 1e-9) -> None:
        """Integrate to a later time with the inputs as they are.

        Events on the way are handled, and those at its end, so what is read there is what comes
        after them.

        Parameters
        ----------
        until : float
            [s]
        rtol : float
            Relative tolerance; the absolute one is this times the nominal values.

        Raises
        ------
        FmuCallError
            Also if the integration fails, or events crowd.
        """
        for _ in range(_MOST_EVENTS):
            here = self.time + _EVENT_WIDTH * max(abs(self.time), 1.0)  # is the same time
            if self.next_event <= here:
                if self.time < self.next_event:  # by rounding; the FMU looks at the time itself
                    self.set_time(self.next_event)
                self.handle_event()
            elif until <= here:  # LSODA takes no step of a few units in the last place
                return
            elif self._integrate(min(until, self.next_event), rtol):
                self.handle_event()
        raise self.error("DoStep", f"more than {_MOST_EVENTS} events before {until:g} s")

    def _integrate(self, until: float, rtol: float) -> bool:
        """Integrate up to a time or to the first event before it; return whether there is one."""
        from scipy.integrate import LSODA

        if not self.n_states:
            self.set_time(until)
            return self._completed()

        def f(t: float, x: Array) -> Array:
            self.set_time(t)
            self.set_states(x)
            return self.derivatives()

        atol = rtol * self.nominals()
        solver = LSODA(f, self.time, self.states(), until, rtol=rtol, atol=atol)
        before = self.event_indicators()
        while solver.status == "running":
            reason = solver.step()
            if solver.status == "failed":
                raise self.error("GetDerivatives", f"the integration failed: {reason}")
            dense = solver.dense_output()
            self._go_to(solver.t, dense(solver.t))
            after = self.event_indicators()
            if _changed(before, after):
                self._locate(dense, before, solver.t_old, solver.t)
                return True
            before = after
            if self._completed():
                return True
        return False

    def _go_to(self, t: float, x: Array) -> None:
        self.set_time(t)
        self.set_states(x)

    def _locate(self, dense: Any, before: Array, low: float, high: float) -> None:
        """Bisect to just behind the first sign change."""
        while high - low > _EVENT_WIDTH * max(abs(high), 1.0):
            middle = (low + high) / 2
            self._go_to(middle, dense(middle))
            if _changed(before, self.event_indicators()):
                high = middle
            else:
                low = middle
        self._go_to(high, dense(high))

    def _completed(self) -> bool:
        """Tell the FMU that a step is done; return whether it wants an event."""
        if not self._completes:
            return False
        kind = ctypes.c_int if self.file.version == 2 else ctypes.c_bool
        event, terminate = kind(), kind()
        by = ctypes.byref
        self.call("CompletedIntegratorStep", True, by(event), by(terminate))
        if terminate.value:
            raise self.ended("CompletedIntegratorStep", self.time)
        return bool(event.value)

    def do_step(self, time: float, step: float) -> None:
        """Not there in Model Exchange; see `advance`."""
        raise self.error("DoStep", "a Model Exchange instance takes no steps; use advance")


def _changed(before: Iterable[float], after: Iterable[float]) -> bool:
    return any((a > 0) != (b > 0) for a, b in zip(before, after, strict=True))
