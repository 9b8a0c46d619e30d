"""Stepping FMUs in worker processes, and what happens when one of them fails."""

from __future__ import annotations

import ctypes
import logging
import os
import time
from collections.abc import Sequence
from typing import Any

import attrs
import numpy as np

from posmas_fmi.cosim import native
from posmas_fmi.cosim.failure import Failure
from posmas_fmi.cosim.fmus import (
    DEADLINE,
    DIED,
    EARLY,
    HOLD_THEM,
    NOT_FINITE,
    SET_RATES,
    TERMINATED,
    Incident,
    PortMap,
    call_name,
)
from posmas_fmi.cosim.worker import layout
from posmas_fmi.cosim.worker.pool import Isolation, WorkerPool
from posmas_fmi.cosim.worker.process import WorkerLost, WorkerProcess
from posmas_fmi.cosim.worker.proxy import RemoteInstance
from posmas_fmi.errors import FmuCallError, FmuError, FmuLostError
from posmas_fmi.fmu.instance import FmuInstance, status_label
from posmas_fmi.interrupt import Interrupt

_LOG = logging.getLogger(__name__)

SNAPSHOT_EVERY = 2.0  # s of wall time between two snapshots, at least
SNAPSHOT_SHARE = 20.0  # and so many times as long as the last one took
PAST = 64 * 2**20  # bytes of inputs that are kept for one instance
TOO_SOON = 10  # steps after a restart within which a failure is final
_FATAL = 4


class Remote:
    """The instances in worker processes, for the C loops and for those in Python.

    Parameters
    ----------
    instances : sequence of FmuInstance
        All instances, initialised; those that are `RemoteInstance` are stepped through this.
    inputs, readings : sequence of PortMap
        Of each instance.
    pool : WorkerPool
        Where they live.
    isolation : Isolation
    failures : list of Failure
        Where to note what goes wrong.

    Attributes
    ----------
    is_remote : (n,) array of int
    interrupt : Interrupt
        Of the run that goes on: then processes are not waited for any more.
    """

    def __init__(
        self,
        instances: Sequence[FmuInstance],
        inputs: Sequence[PortMap],
        readings: Sequence[PortMap],
        pool: WorkerPool,
        isolation: Isolation,
        failures: list[Failure],
    ) -> None:
        self._pool, self._isolation = pool, isolation
        self._inputs, self._readings = tuple(inputs), tuple(readings)
        self._library = native.load(native.library(native.worker_sources()))
        self._library.remote_define.argtypes = [ctypes.c_void_p] * 2
        self._library.remote_forget.argtypes = [ctypes.c_void_p]
        self._remote = {
            k: one for k, one in enumerate(instances) if isinstance(one, RemoteInstance)
        }
        n = len(instances)
        self.is_remote = np.array([k in self._remote for k in range(n)], dtype=np.int64)
        self.failures = failures
        self.interrupt = Interrupt()
        shared = list(dict.fromkeys(one.worker for one in self._remote.values()))
        self._first_own = len(shared)  # then one place for each instance that gets its own process
        self._workers: list[WorkerProcess | None] = [*shared, *(None for _ in range(n))]
        self._pointers = (ctypes.c_void_p * len(self._workers))()
        self._members: list[list[int]] = [[] for _ in self._workers]
        self._memory: list[layout.SlotMemory | None] = [None for _ in self._workers]
        self._numbers: list[Any] = [None for _ in self._workers]
        self._entries = (layout.InstanceEntry * max(n, 1))()
        self._saved: dict[int, _Saved] = {}
        self._final: dict[int, Failure] = {}  # the last one of each
        self._restarted: dict[int, float] = {}
        self._next_snapshot = time.monotonic() + SNAPSHOT_EVERY
        keeps = isolation.on_failure != "stop"
        for k in range(n):
            entry = self._entries[k]
            entry.worker = shared.index(self._remote[k].worker) if k in self._remote else -1
            entry.inputs = inputs[k].width
            entry.readings = len(readings[k].variables)
            entry.past.wanted = keeps and k in self._remote
            entry.past.most = PAST // (8 * (2 + entry.inputs))
            if k in self._remote:
                self._members[entry.worker].append(k)
        self._recover = layout.Recover(self._on_failure) if keeps else layout.Recover()
        self._look = layout.Interrupted(self._on_look)
        self._context = layout.Workers(
            ctypes.addressof(self._pointers),
            len(self._workers),
            ctypes.addressof(self._entries),
            isolation.patience.step,
            int(1e9 * pool.looks),
            self._recover,
            self._look,
        )
        self._hook = layout.Hook()
        self._library.remote_define(ctypes.addressof(self._hook), ctypes.addressof(self._context))
        for place in range(self._first_own):
            self._bind(place)

    @property
    def address(self) -> int:
        """Of the structure `Remote` in csrc/fmus.h."""
        return ctypes.addressof(self._hook)

    def close(self) -> None:
        """Release the memory of the C loop, and end processes that are in the middle of a step.

        The others are those of the pool.
        """
        for entry in self._entries:
            self._library.remote_forget(ctypes.addressof(entry))
        for worker, memory in zip(self._workers, self._memory, strict=True):
            if worker and memory and any(slot.done != slot.posted for slot in memory.slots):
                worker.kill()
        # functions that C may call hold this object, and it holds them
        self._context.recover, self._context.interrupted = layout.Recover(), layout.Interrupted()
        del self._recover, self._look

    # ---- places ---------------------------------------------------------------------------------

    def _bind(self, place: int) -> None:
        """Tell a worker which instances it steps, and share memory for their values."""
        worker, members = self._workers[place], self._members[place]
        assert worker is not None
        widths = [(self._entries[m].inputs, self._entries[m].readings) for m in members]
        handle = layout.shared_file("posmas-fmi-values", sum(layout.SlotMemory.strides(widths)))
        try:
            memory = layout.SlotMemory.of(handle, widths)
            told = [
                {
                    "key": self._remote[m].key,
                    "inputs": attrs.asdict(self._inputs[m]),
                    "readings": attrs.asdict(self._readings[m]),
                }
                for m in members
            ]
            worker.request({"do": "bind", "instances": told}, handles=[handle])
        except WorkerLost as lost:
            raise self._lost(lost, members[0]) from None
        finally:
            os.close(handle)
        self._memory[place] = memory
        self._numbers[place] = numbers = np.array(members, dtype=np.int64)
        worker.entry.numbers, worker.entry.instances = numbers.ctypes.data, len(members)
        for m, slot, address in zip(members, memory.slots, memory.addresses, strict=True):
            slot.t = self._remote[m].time
            self._entries[m].worker, self._entries[m].slot = place, address
        self._pointers[place] = ctypes.addressof(worker.entry)

    def _drop(self, place: int) -> None:
        """End the worker at a place."""
        worker = self._workers[place]
        self._pointers[place] = None
        self._workers[place], self._members[place] = None, []
        self._memory[place] = None
        if worker is not None:
            self._pool.drop(worker)

    def _slot(self, number: int) -> tuple[layout.Slot, Any, Any]:
        place = self._entries[number].worker
        memory, at = self._memory[place], self._members[place].index(number)
        assert memory is not None
        return memory.slots[at], memory.inputs[at], memory.readings[at]

    # ---- what went wrong ------------------------------------------------------------------------

    def failure(self, incident: Incident) -> Failure:
        """Return what an incident of the C loop means."""
        number = incident.instance
        instance = self._remote[number]
        slot, inputs, _ = self._slot(number)
        facts: dict[str, Any] = {
            "agent": instance.name,
            "fmu": instance.file.path.name,
            "time": slot.t,
            "inputs": self._inputs[number].values_of(inputs),
            "messages": instance.messages[-5:],
        }
        if incident.call in (DIED, DEADLINE):
            death = instance.worker.death(self._isolation.patience.step)
            call = call_name(incident.port, instance.file.version)
            return Failure(
                **facts,
                call=call or death.call,
                cause=f"the process of the FMU {death.text}",
                signal=death.signal,
                exit_code=death.exit_code,
                output=death.output,
            )
        call = call_name(incident.call, instance.file.version)
        if incident.call == NOT_FINITE:
            name = self._readings[number].variables[incident.port]
            return Failure(**facts, call=call, cause=f"{name} is not finite ({incident.value:g})")
        if incident.call == EARLY:
            return Failure(**facts, call=call, cause=f"returned early at {incident.value!r} s")
        cause = f"returned status {incident.status} ({status_label(incident.status)})"
        cause += HOLD_THEM if incident.call == SET_RATES else ""
        return Failure(**facts, call=call, cause=cause, status=incident.status)

    def error(self, incident: Incident) -> FmuCallError:
        """Return an incident that ended the run as an error, and note it."""
        number = incident.instance
        if incident.call == TERMINATED:
            return self._remote[number].ended("DoStep", incident.value)
        if self._entries[number].given_up:
            failure = self._final[number]
        else:
            failure = self.failure(incident)
            self.failures.append(failure)
        about = (failure.message, failure.where, failure.agent, failure.time)
        if incident.call in (DIED, DEADLINE):
            return FmuLostError(*about, failure.signal, failure.exit_code)
        return FmuCallError(*about)

    def _lost(self, lost: WorkerLost, number: int) -> FmuLostError:
        from posmas_fmi.cosim.worker.process import lost_error

        one = self._remote[number]
        return lost_error(lost.death, one.file.path.name, one.name, lost.death.call, one.time)

    # ---- bringing back --------------------------------------------------------------------------

    def _on_look(self) -> int:
        """Answer the C loop, which waits: whether Ctrl-C has come."""
        return self.interrupt.wanted

    def _on_failure(self, number: int) -> int:
        """Answer the C loop: whether to look at the instance again."""
        try:
            self._bring_back(number)
        except KeyboardInterrupt:  # the second one
            return 0
        except Exception:
            _LOG.exception("after a failure the FMUs could not be brought back")
            return 0
        return 1

    def _bring_back(self, number: int) -> None:
        incident = Incident.from_buffer_copy(self._entries[number].incident)
        process_over = incident.call in (DIED, DEADLINE)
        culprit = incident.instance if process_over else number
        failure = self.failure(incident)
        slot, _, _ = self._slot(culprit)
        at, step = slot.t, slot.h
        notes: list[str] = []
        fatal = incident.call in (1, 2, 3, 6) and incident.status == _FATAL
        if process_over or fatal:
            notes += self._replace_worker(self._entries[culprit].worker, culprit)
        entry = self._entries[culprit]
        entry.incident = incident
        restart = self._isolation.on_failure == "restart"
        if restart and at - self._restarted.get(culprit, -np.inf) < TOO_SOON * step:
            restart = False
            notes.insert(0, "it failed again so soon after a restart that it stays as it was")
        if restart:
            restart = self._restart(culprit, at, step, notes)
        if not restart:
            self._give_up(culprit)
        action: Any = "restarted" if restart else "frozen"
        self._note(culprit, attrs.evolve(failure, action=action, detail="; ".join(notes)))

    def _note(self, number: int, failure: Failure) -> None:
        self._final[number] = failure
        self.failures.append(failure)
        detail = f": {failure.detail}" if failure.detail else ""
        _LOG.warning("%s; %s%s", failure, failure.action, detail)

    def _give_up(self, number: int) -> None:
        self._entries[number].given_up = 1
        self._library.remote_forget(ctypes.addressof(self._entries[number]))

    def _replace_worker(self, place: int, culprit: int) -> list[str]:
        """Start another process for the instances that shared one with the culprit."""
        members = [m for m in self._members[place] if self._entries[m].worker == place]
        others = [m for m in members if m != culprit and not self._entries[m].given_up]
        self._drop(place)
        if not others:
            return []
        try:
            self._put(others, place)
            notes = [self._go_on(m) for m in others]
        except FmuError:
            self._drop(place)
            return [self._alone(m) for m in others]
        names = ", ".join(self._remote[m].name for m in others)
        return [f"{names} shared its process and went on in another one, {notes[0]}"]

    def _alone(self, number: int) -> str:
        """Bring one instance back in a process of its own, or give it up."""
        name = self._remote[number].name
        try:
            self._put([number], self._first_own + number)
            return f"{name} shared its process and went on in its own, {self._go_on(number)}"
        except FmuError as error:
            self._drop(self._first_own + number)
            self._entries[number].incident.call = DIED
            self._entries[number].incident.instance = number
            self._give_up(number)
            fmu, time = self._remote[number].file.path.name, self._remote[number].time
            cause = f"it shared a process with an FMU that failed, and then {error.message}"
            self._note(number, Failure(name, fmu, "", time, {}, cause, "frozen"))
            return f"{name} shared its process and could not be brought back: {error.message}"

    def _restart(self, number: int, at: float, step: float, notes: list[str]) -> bool:
        """Put a fresh instance in the place of one that failed, in a process of its own."""
        self._restarted[number] = at
        place = self._first_own + number
        if self._entries[number].worker == place:
            self._drop(place)
        else:
            notes += self._free(number)
        if not self._entries[number].past.cut:
            try:
                self._put([number], place)
                notes.insert(0, self._go_on(number))
                return True
            except FmuError as error:
                notes.insert(0, f"the same steps failed again ({error.message})")
                self._drop(place)
        instance = self._remote[number]
        assert instance.start is not None
        values, _, stop, tolerance = instance.start
        instance.start = (values, at + step, stop, tolerance)
        self._saved.pop(number, None)
        past = self._entries[number].past
        past.n = past.cut = 0
        try:
            self._put([number], place)
            self._go_on(number)
        except FmuError as error:
            notes.insert(0, f"a fresh instance failed as well ({error.message})")
            self._drop(place)
            return False
        notes.insert(0, f"from its start values at {at + step:g} s")
        return True

    def _free(self, number: int) -> list[str]:
        """Free an instance that has failed; should that end its process, bring the others back."""
        instance, place = self._remote[number], self._entries[number].worker
        if self._workers[place] is not instance.worker:
            return []  # its process has ended
        instance.free()
        return [] if instance.worker.alive else self._replace_worker(place, number)

    def _put(self, members: list[int], place: int) -> None:
        """Make fresh instances in a new process: in their saved state, or initialised."""
        worker = self._workers[place] = self._pool.start()
        self._members[place] = members
        for m in members:
            instance = self._remote[m]
            instance.make(worker)
            assert instance.start is not None
            values, start, stop, tolerance = instance.start
            instance.initialise(values, start=start, stop=stop, tolerance=tolerance)
            if m in self._saved:
                instance.deserialise(self._saved[m].data, self._saved[m].time)
        self._bind(place)

    def _go_on(self, number: int) -> str:
        """Let an instance do its steps since then again, and read it; say how."""
        instance, entry = self._remote[number], self._entries[number]
        past = entry.past
        if past.cut:
            raise instance.error("DoStep", "too many steps were done to be done again")
        width = 2 + entry.inputs
        rows = ctypes.string_at(past.rows, 8 * past.n * width) if past.n else b""
        at = self._members[entry.worker].index(number)
        try:
            done, _ = instance.worker.request({"do": "replay", "number": at, "steps": past.n}, rows)
        except WorkerLost as lost:
            instance.time = self._slot(number)[0].t
            raise self._lost(lost, number) from None
        slot, inputs, _ = self._slot(number)
        instance.time = slot.t
        if past.n:
            last = np.frombuffer(rows, float)[-width:]
            slot.t, slot.h, inputs[:] = last[0], last[1], last[2:]
        if done < past.n or slot.report.failure.call:
            raise instance.error(
                "DoStep", f"failed again at step {min(done + 1, past.n)} of {past.n}"
            )
        instance.time = slot.t + slot.h
        saved = self._saved.get(number)
        source = f"from the state at {saved.time:g} s" if saved else "from its start"
        return f"{source} with {past.n} steps done again"

    # ---- snapshots ------------------------------------------------------------------------------

    def checkpoint(self) -> None:
        """Save the states of the instances if it is time; call it between steps."""
        if self._isolation.on_failure == "stop" or time.monotonic() < self._next_snapshot:
            return
        began = time.monotonic()
        for number, instance in self._remote.items():
            entry = self._entries[number]
            if instance.file.saves and entry.past.n and not entry.given_up:
                self._save(number, instance)
        now = time.monotonic()
        self._next_snapshot = now + max(SNAPSHOT_EVERY, SNAPSHOT_SHARE * (now - began))

    def save(self, number: int) -> Any:
        """Keep the state of an instance, for `restore`; not what it is brought back to.

        Where it cannot be had as bytes, the worker keeps it: the last one of each instance.
        """
        instance = self._remote[number]
        slot, _, _ = self._slot(number)
        data = None
        if instance.file.saves:
            data = instance.serialise()
        else:
            instance.keep()
        return data, slot.t + slot.h, self._entries[number].past.n

    def begin_at(self, number: int, data: bytes, time: float) -> None:
        """Note that an instance stands in that state now, from which it can be brought back."""
        slot, _, _ = self._slot(number)
        slot.t, slot.h = time, 0.0
        self._saved[number] = _Saved(data, time)
        self._entries[number].past.n = self._entries[number].past.cut = 0

    def restore(self, number: int, saved: Any) -> None:
        """Go back to a state that was kept: the steps since then are as if they had not been."""
        data, time, steps = saved
        if data is None:
            self._remote[number].go_back(time)
        else:
            self._remote[number].deserialise(data, time)
        self._entries[number].past.n = steps

    def _save(self, number: int, instance: RemoteInstance) -> None:
        slot, _, _ = self._slot(number)
        try:
            data = instance.serialise()
        except FmuLostError:
            return  # the next step will find out, and say so
        except FmuError as error:
            _LOG.info("no snapshot: %s", error)
            return
        self._saved[number] = _Saved(data, slot.t + slot.h)
        self._entries[number].past.n = self._entries[number].past.cut = 0


@attrs.frozen
class _Saved:
    """The state of an instance.

    Attributes
    ----------
    data : bytes
    time : float
        Of the instance [s].
    """

    data: bytes
    time: float
