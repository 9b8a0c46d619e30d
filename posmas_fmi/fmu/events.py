"""Event Mode: the discrete states of an instance, updated until they settle."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable

import attrs

from posmas_fmi.fmu.instance import FmuInstance

_MOST_ITERATIONS = 100  # of the discrete states at one event


@attrs.frozen
class EventInfo:
    """What an FMU says at an event.

    Attributes
    ----------
    again : bool
        Whether the discrete states need another update.
    terminate : bool
    nominals_changed, states_changed : bool
    next_event : float
        Time of the next time event [s]; inf if none is known.
    """

    again: bool
    terminate: bool
    nominals_changed: bool
    states_changed: bool
    next_event: float


def update_discrete_states(instance: FmuInstance) -> EventInfo:
    """In Event Mode of FMI 2 or 3: update the discrete states once."""
    by = ctypes.byref
    if instance.file.version == 2:
        from fmpy.fmi2 import fmi2EventInfo

        info = fmi2EventInfo()
        instance.call(_name(instance), by(info))
        return EventInfo(
            bool(info.newDiscreteStatesNeeded),
            bool(info.terminateSimulation),
            bool(info.nominalsOfContinuousStatesChanged),
            bool(info.valuesOfContinuousStatesChanged),
            float(info.nextEventTime) if info.nextEventTimeDefined else math.inf,
        )
    flags = [ctypes.c_bool() for _ in range(5)]
    time = ctypes.c_double()
    instance.call(_name(instance), *map(by, flags), by(time))
    again, terminate, nominals, states, defined = (flag.value for flag in flags)
    return EventInfo(again, terminate, nominals, states, time.value if defined else math.inf)


def settle(instance: FmuInstance, update: Callable[[], EventInfo]) -> float:
    """In Event Mode: update the discrete states until no more is needed.

    Parameters
    ----------
    instance : FmuInstance
    update : callable
        Updates them once.

    Returns
    -------
    float
        Time of the next time event [s]; inf if none is known.

    Raises
    ------
    FmuCallError
        Also if the FMU asks to end the simulation, or the states do not settle.
    """
    for _ in range(_MOST_ITERATIONS):
        info = update()
        if info.terminate:
            raise instance.ended(_name(instance), instance.time)
        if not info.again:
            return info.next_event
    raise instance.error(
        _name(instance), f"the discrete states did not settle in {_MOST_ITERATIONS} updates"
    )


def _name(instance: FmuInstance) -> str:
    names = {1: "EventUpdate", 2: "NewDiscreteStates", 3: "UpdateDiscreteStates"}
    return names[instance.file.version]
