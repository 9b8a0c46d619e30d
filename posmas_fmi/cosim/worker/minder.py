"""What a worker process looks after beside its FMUs: that its master lives, and its own limits."""

from __future__ import annotations

import errno
import os
import select
import shutil
import signal
import sys
import threading
from pathlib import Path

import attrs

from posmas_fmi.cosim.worker.layout import Head
from posmas_fmi.fmu.descendants import MARK, end_marked
from posmas_fmi.fmu.scratch import size_of

LOOK = 100  # ms between two looks
KEPT = 1 << 20  # bytes of output that are kept
MEMORY, OUTPUT, ALONE, CLOSED, HANDLES, FILES = 1, 2, 3, 4, 5, 6  # reasons to give up
SELDOM = 10  # looks between two at the folder
REASONS = {
    MEMORY: "it used more memory than it may",
    OUTPUT: "it wrote more output than it may",
    HANDLES: "it opened more files than it may",
    FILES: "it wrote more to its folder for temporary files than it may",
    CLOSED: "it closed a file descriptor that was not its own",
}


@attrs.frozen
class Limits:
    """What a worker may use.

    Attributes
    ----------
    memory : float
        Resident [GiB].
    output : float
        To stdout and stderr in all [MiB].
    handles : int
        Open files, sockets and the like.
    files : float
        In its folder for temporary files [GiB].
    """

    memory: float = 4.0
    output: float = 64.0
    handles: int = 4096
    files: float = 4.0


class Minder(threading.Thread):
    """A thread that ends this process when its time has come, whatever an FMU is doing.

    Parameters
    ----------
    link : int
        Descriptor of the socket to the master, which closes when the master ends.
    output : int
        Descriptor of the file that stdout and stderr go to.
    folder : Path
        Working directory of this process; removed when the master cannot do it any more.
    head : Head
        Where the reason is written.
    limits : Limits
    """

    def __init__(self, link: int, output: int, folder: Path, head: Head, limits: Limits) -> None:
        super().__init__(daemon=True)
        self._link, self._output, self._folder, self._head = link, output, folder, head
        self._memory = limits.memory * 2**30
        self._most_output = limits.output * 2**20
        self._handles, self._files = limits.handles, limits.files * 2**30
        self._cut = 0

    def run(self) -> None:
        """Look from time to time."""
        poll, looks = select.poll(), 0
        poll.register(self._link, 0)  # hang-ups are always told
        while True:
            for _, event in poll.poll(LOOK):
                if event & select.POLLNVAL:
                    self._end(CLOSED)
                end_marked(os.environ.get(MARK, ""))
                shutil.rmtree(self._folder, ignore_errors=True)
                self._end(ALONE)
            looks += 1
            try:
                if resident() > self._memory:
                    self._end(MEMORY)
                if handles() > self._handles:
                    self._end(HANDLES)
            except OSError as error:
                if error.errno not in (errno.EMFILE, errno.ENFILE):
                    raise
                self._end(HANDLES)
            if looks % SELDOM == 0 and size_of(self._folder, self._files) > self._files:
                self._end(FILES)
            self._look_at_output()

    def _look_at_output(self) -> None:
        try:
            size = os.fstat(self._output).st_size
            if size > KEPT:
                self._cut += size
                os.ftruncate(self._output, 0)
        except OSError:
            self._end(CLOSED)
        if self._cut > self._most_output:
            self._end(OUTPUT)

    def _end(self, reason: int) -> None:
        self._head.gave_up = reason
        os.kill(os.getpid(), signal.SIGKILL)


def handles() -> int:
    """How many descriptors are open; 0 where the system does not tell."""
    try:
        return len(os.listdir("/proc/self/fd"))
    except FileNotFoundError:
        return 0


def resident() -> int:
    """Bytes of memory in use."""
    if Path("/proc/self/statm").exists():
        pages = int(Path("/proc/self/statm").read_bytes().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE")
    import resource

    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024


def bound(limits: Limits) -> None:
    """Let the system bound what the thread might see too late; call it before FMUs are loaded."""
    import resource

    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    most = int(2 * limits.memory * 2**30)
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    if hard == resource.RLIM_INFINITY or most < hard:
        resource.setrlimit(resource.RLIMIT_DATA, (most, hard))
