"""Co-Simulation in which the events of an FMU are handled here, and its clocks tick (FMI 3)."""

from __future__ import annotations

import ctypes
import math
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from posmas_fmi.errors import FmuError
from posmas_fmi.fmu.about import About
from posmas_fmi.fmu.clocks import Clock
from posmas_fmi.fmu.events import settle, update_discrete_states
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.instance import MOST_STUCK, FmuInstance
from posmas_fmi.fmu.period import allows_steps_of_different_length
from posmas_fmi.fmu.variables import REAL, Ports

_MOST_EVENTS = 100_000  # in one step
_SAME = 1e-9  # of a step: times that are the same
_CHANGED = 2  # fmi3IntervalChanged


def needs_event_mode(about: About) -> bool:
    """Whether an FMU has clocks, which tick in Event Mode only."""
    has = any(variable.type == "Clock" for variable in about.variables.values())
    return has and about.kind == "Co-Simulation" and _has_event_mode(about)


def _has_event_mode(about: About) -> bool:
    return about.version == 3 and bool(getattr(about.interface, "hasEventMode", False))


class EventFile(FmuFile):
    """A Co-Simulation FMU whose instances go through Event Mode.

    Parameters, attributes and errors are those of `posmas_fmi.fmu.file.FmuFile`; an FMU that has
    no Event Mode is an error.
    """

    events = True

    def _load(self, identifier: str) -> None:
        if not _has_event_mode(self.about):
            raise FmuError("expected an FMU with Event Mode (hasEventMode)", str(self.path))
        super()._load(identifier)

    def _made(self, name: str, key: int) -> EventInstance:
        return EventInstance(self, name, key)

    @property
    def in_python(self) -> bool:
        """True: events are handled here."""
        return True

    @property
    def clocks(self) -> tuple[Clock, ...]:
        """Input clocks that time makes tick."""
        return self.about.clocks

    @cached_property
    def clocked(self) -> dict[str, tuple[int, ...]]:
        """References of the clocks of each variable that has any."""
        return {
            one.name: tuple(clock.valueReference for clock in one.clocks)
            for one in self.description.modelVariables
            if one.clocks
        }


class EventInstance(FmuInstance):
    """An instance whose events are handled between steps.

    Inputs that may jump only in Event Mode (discrete ones) are set there, those that belong to a
    clock when it ticks. A clock that ticks at a communication point ticks when the step from there
    begins, so with the inputs of that point.

    Attributes
    ----------
    next_event : float
        Time of the next time event that the FMU has told [s]; inf if none is known.
    """

    def __init__(self, file: EventFile, name: str, key: int) -> None:
        super().__init__(file, name, key)
        self.file: EventFile = file
        self.next_event = math.inf
        self._runs = False
        self._begin = 0.0
        self._ticks = dict.fromkeys(file.clocks, 0)  # so far
        self._tick_at = dict.fromkeys(file.clocks, math.inf)  # the next one [s]
        self._interval: dict[Clock, float] = {}  # as the FMU has told it last
        self._waiting: dict[str, float] = {}  # discrete inputs as they were written last
        self._held: dict[str, float] = {}  # and as the FMU has them
        self._varies = allows_steps_of_different_length(file)

    def enter_initialization(
        self, *, start: float = 0.0, stop: float | None = None, tolerance: float | None = None
    ) -> None:
        """Tell the experiment and enter Initialization Mode."""
        self._begin = start
        super().enter_initialization(start=start, stop=stop, tolerance=tolerance)

    def exit_initialization(self) -> None:
        """Leave Initialization Mode, settle the discrete states, enter Step Mode."""
        super().exit_initialization()
        self.next_event = settle(self, partial(update_discrete_states, self))
        for clock in self.file.clocks:
            if clock.periodic:
                self._tick_at[clock] = self._begin + clock.tick(0)
        self._ask(self._begin)
        self.call("EnterStepMode")
        self._runs = True

    def reset(self) -> None:
        """Go back to the state after instantiation."""
        super().reset()
        self._runs, self.next_event = False, math.inf
        self._ticks = dict.fromkeys(self._ticks, 0)
        self._tick_at = dict.fromkeys(self._tick_at, math.inf)
        self._waiting, self._held, self._interval = {}, {}, {}

    # ---- values ---------------------------------------------------------------------------------

    def write(self, ports: Ports, values: ArrayLike) -> None:
        """Set the values at the ports; discrete ones are kept for the next event."""
        given = np.array(values, dtype=float).reshape(-1)
        if not self._runs:
            super().write(ports, given)
            return
        jumps = np.array([self._jumps(name) for name in ports.names], dtype=bool)
        if not jumps.any():
            super().write(ports, given)
            return
        if not jumps.all():
            names = tuple(n for n, jump in zip(ports.names, jumps, strict=True) if not jump)
            super().write(self.file.ports(names), given[~jumps])
        for name, value, jump in zip(ports.names, given, jumps, strict=True):
            if jump:
                self._waiting[name] = float(value)

    def _jumps(self, name: str) -> bool:
        variable = self.file.variable(name)
        return variable.type not in REAL or variable.variability == "discrete"

    def _to_set(self, due: list[Clock]) -> list[str]:
        """Discrete inputs that are to be set now."""
        ticking = {clock.reference for clock in due}

        def wanted(name: str) -> bool:
            clocks = self.file.clocked.get(self.file.variable(name).name)
            if clocks:
                return not ticking.isdisjoint(clocks)
            return self._held.get(name) != self._waiting[name]

        return [name for name in self._waiting if wanted(name)]

    # ---- time -----------------------------------------------------------------------------------

    def do_step(self, time: float, step: float) -> None:
        """Advance from `time` by `step` [s]; events on the way are handled.

        Raises
        ------
        FmuCallError
            Also if a clock ticks between two communication points and the FMU cannot take steps
            of different length.
        """
        end, same = time + step, _SAME * step
        self._check_ticks(time - same)
        due = self._due(time + same)
        if due or self._to_set(due):
            self._event(time, due)
        now, stuck = time, 0
        for _ in range(_MOST_EVENTS):
            until = min((self.next_event, *self._tick_at.values())) if self._varies else end
            until = until if now + same < until < end - same else end
            done = self.step_once(now, until - now)
            moved = not done.early or done.reached > now
            stuck = 0 if moved or done.event else stuck + 1
            if stuck > MOST_STUCK:
                raise self.ended_early(False, now)
            now = done.reached if done.early else until
            self.time = now
            ends = now >= end - same
            due = [] if ends else self._due(now + same)
            if due or done.event or self.next_event <= now + same:
                self._event(now, due)
            if ends:
                self.time = end
                return
        raise self.error("DoStep", f"more than {_MOST_EVENTS} events before {end:g} s")

    def _due(self, time: float) -> list[Clock]:
        return [clock for clock, at in self._tick_at.items() if at <= time]

    def _check_ticks(self, time: float) -> None:
        late = [(at, clock) for clock, at in self._tick_at.items() if at < time]
        if late:
            at, clock = min(late, key=lambda one: one[0])
            raise self.error(
                "SetClock",
                f"the clock {clock.name!r} ticks at {at:g} s, between two communication points, "
                "and the FMU takes no steps of different length; choose another period",
            )

    def _event(self, now: float, due: list[Clock]) -> None:
        """Go through Event Mode: clocks tick, discrete inputs are set, discrete states settle."""
        self.call("EnterEventMode")
        for _ in range(_MOST_EVENTS):
            if due:
                n = len(due)
                references = (ctypes.c_uint * n)(*(clock.reference for clock in due))
                self.call("SetClock", references, n, (ctypes.c_bool * n)(*[True] * n))
            names = self._to_set(due)
            if names:
                values = [self._waiting[name] for name in names]
                super().write(self.file.ports(names), values)
                self._held |= dict(zip(names, values, strict=True))
            self.next_event = settle(self, partial(update_discrete_states, self))
            for clock in due:
                self._ticks[clock] += 1
                self._tick_at[clock] = (
                    self._begin + clock.tick(self._ticks[clock]) if clock.periodic else math.inf
                )
            self._ask(now)
            due = [clock for clock in self._due(now) if not clock.periodic]
            if not due:
                self.call("EnterStepMode")
                return
        raise self.error("SetClock", f"more than {_MOST_EVENTS} ticks at {now:g} s")

    def _ask(self, now: float) -> None:
        """Ask for the next tick of the clocks whose intervals the FMU decides."""
        asked = [clock for clock in self.file.clocks if clock.asked]
        if not asked:
            return
        n = len(asked)
        references = (ctypes.c_uint * n)(*(clock.reference for clock in asked))
        intervals, qualifiers = (ctypes.c_double * n)(), (ctypes.c_int * n)()
        self.call("GetIntervalDecimal", references, n, intervals, qualifiers)
        for clock, interval, qualifier in zip(asked, intervals, qualifiers, strict=True):
            changed, again = qualifier == _CHANGED, clock.variability != "countdown"
            if changed and again:
                self._interval[clock] = interval
            first = changed and again and not self._runs
            if first:
                self._tick_at[clock] = self._begin + float(clock.shift)
            elif changed and not again:
                self._tick_at[clock] = now + interval
            elif again and self._tick_at[clock] == math.inf:
                self._tick_at[clock] = now + self._interval.get(clock, math.inf)

    # ---- state ----------------------------------------------------------------------------------

    def _beside(self) -> dict[str, Any]:
        clocks = [
            [self._ticks[clock], self._tick_at[clock], self._interval.get(clock)]
            for clock in self.file.clocks
        ]
        return {
            "next_event": self.next_event,
            "clocks": clocks,
            "waiting": dict(self._waiting),
            "held": dict(self._held),
        }

    def _set_beside(self, kept: dict[str, Any]) -> None:
        self.next_event = kept["next_event"]
        self._waiting, self._held = dict(kept["waiting"]), dict(kept["held"])
        self._interval = {}
        for clock, (ticks, at, interval) in zip(self.file.clocks, kept["clocks"], strict=True):
            self._ticks[clock], self._tick_at[clock] = ticks, at
            if interval is not None:
                self._interval[clock] = interval
