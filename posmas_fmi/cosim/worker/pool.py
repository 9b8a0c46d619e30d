"""The worker processes of a run: how many, and which instance goes where."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import attrs

from posmas_fmi.cosim.failure import Leftover
from posmas_fmi.cosim.worker.minder import Limits
from posmas_fmi.cosim.worker.process import Patience, WorkerProcess
from posmas_fmi.cosim.worker.proxy import RemoteFile, built_here

OnFailure = Literal["stop", "freeze", "restart"]

# Looking before sleeping [s], where workers leave a processor to the master, and where they do not:
# a processor that sleeps takes longer to wake than a short step; but who looks keeps one busy.
AMPLE, SHORT = 200e-6, 50e-6


@attrs.frozen
class Isolation:
    """How FMUs are kept apart.

    Attributes
    ----------
    mode : {"auto", "process", "none"}
        Auto: FMUs that this installation has not built run in worker processes.
    workers : int
        Number of processes; 0: one for each processor.
    on_failure : {"stop", "freeze", "restart"}
        What the rest of the network does when an FMU fails.
    limits : Limits
    patience : Patience
    """

    mode: Literal["auto", "process", "none"] = "none"
    workers: int = 0
    on_failure: OnFailure = "stop"
    limits: Limits = attrs.field(factory=Limits)
    patience: Patience = attrs.field(factory=Patience)

    def separates(self, path: Path) -> bool:
        """Whether an FMU file belongs into worker processes."""
        return self.mode == "process" or (self.mode == "auto" and not built_here(path))


def processors() -> int:
    """Return how many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class WorkerPool:
    """Worker processes, started when they are needed.

    Parameters
    ----------
    isolation : Isolation
    instances : int
        Number of instances that will be placed; no more processes than that are started.

    Attributes
    ----------
    looks : float
        How long master and workers look for what they wait for before they sleep [s].
    leftovers : list of Leftover
        Of each process that was started.
    """

    def __init__(self, isolation: Isolation, instances: int) -> None:
        self.leftovers: list[Leftover] = []
        self._isolation = isolation
        cores = processors()
        self._most = max(1, min(isolation.workers or cores, instances))
        self.looks = AMPLE if self._most < cores else SHORT
        self._shared: list[WorkerProcess] = []
        self._all: list[WorkerProcess] = []
        self._next = 0

    def __iter__(self) -> Iterator[WorkerProcess]:
        return iter(self._all)

    def start(self) -> WorkerProcess:
        """Start one more process."""
        worker = WorkerProcess(self._isolation.limits, self._isolation.patience, self.looks)
        self._all.append(worker)
        self.leftovers.append(worker.leftover)
        return worker

    def place(self, file: RemoteFile, alone: bool = False) -> WorkerProcess:
        """Return the process for the next instance of a file; if `alone`, one of its own."""
        if file.only_once or alone:
            return self.start()
        while len(self._shared) < self._most:  # all at once: they start side by side
            self._shared.append(self.start())
        worker = self._shared[self._next % len(self._shared)]
        self._next += 1
        return worker

    def drop(self, worker: WorkerProcess) -> None:
        """End a process that is of no use any more."""
        worker.close()
        if worker in self._all:
            self._all.remove(worker)
        if worker in self._shared:
            self._shared.remove(worker)

    def close(self) -> None:
        """End all processes."""
        for worker in self._all:
            worker.say_goodbye()
        for worker in self._all:
            worker.close()
        self._all.clear()
        self._shared.clear()
