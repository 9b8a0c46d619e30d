"""One worker process as its master sees it: start, requests, end, and what is left to tell."""

from __future__ import annotations

import ctypes
import logging
import os
import select
import signal
import socket
import subprocess
import sys
import time
import weakref
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import attrs

import posmas_fmi
from posmas_fmi import errors
from posmas_fmi.cosim import native
from posmas_fmi.cosim.failure import Leftover
from posmas_fmi.cosim.fmus import DEADLINE, DIED, NativeMessages
from posmas_fmi.cosim.worker import frames, layout
from posmas_fmi.cosim.worker.minder import REASONS, Limits
from posmas_fmi.cosim.worker.server import Settings
from posmas_fmi.errors import BuildError, FmuError, FmuLostError, PosmasError
from posmas_fmi.fmu.descendants import MARK, end_marked, new_mark
from posmas_fmi.fmu.scratch import Scratch

_LOG = logging.getLogger(__name__)

LOOK = 20  # ms between two looks at a process that does not answer
GRACE = 2.0  # s for a worker to free its FMUs at the end
TAIL = 2000  # characters of output that an error tells
# the package is found where the master has it, and nothing else comes from there
_START = (
    "import sys; sys.path.insert(0, sys.argv[1]); import posmas_fmi; del sys.path[0]; "
    "from posmas_fmi.cosim.worker.server import main; main(sys.argv[2])"
)


@attrs.frozen
class Patience:
    """How long a worker may take [s].

    Attributes
    ----------
    step : float
        For one call while stepping.
    start : float
        For one call that loads, instantiates, initialises or restores.
    """

    step: float = 10.0
    start: float = 60.0


@attrs.frozen
class Death:
    """How a worker ended.

    Attributes
    ----------
    text : str
        As a part of a sentence: "was ended by signal 11 (SIGSEGV)".
    signal : int or None
    exit_code : int or None
    call : str
        The call into an FMU that was going on, if it is known.
    output : str
        The end of what it wrote to stdout and stderr.
    """

    text: str
    signal: int | None
    exit_code: int | None
    call: str
    output: str


def require() -> None:
    """Check that FMUs can run in worker processes here.

    Raises
    ------
    BuildError
        If not, and why.
    """
    if not layout.possible():
        raise BuildError('worker processes need Linux or macOS; choose isolation = "none"')
    native.library(native.worker_sources())


class WorkerProcess:
    """A process that FMUs are loaded into.

    Parameters
    ----------
    limits : Limits
    patience : Patience
    looks : float
        How long it looks for work before it sleeps [s].

    Attributes
    ----------
    entry : layout.Worker
        What the C loop knows about it.
    leftover : Leftover
        What its FMUs left behind; complete when it is closed.
    """

    def __init__(self, limits: Limits, patience: Patience, looks: float) -> None:
        path = native.library(native.worker_sources())
        self._library = native.load(path)
        layout.check(self._library)
        for name in ("remote_ask", "remote_ended", "remote_kill"):
            getattr(self._library, name).argtypes = [ctypes.c_void_p]
        self._library.remote_ended.restype = ctypes.c_int64
        self._patience = patience
        scratch = Scratch("posmas-fmi-worker-")
        memory = layout.shared_file("posmas-fmi-worker", layout.HeadMemory.size())
        output = _append(layout.shared_file("posmas-fmi-output"))
        ours, theirs = socket.socketpair()
        mark = new_mark()
        settings = Settings(
            theirs.fileno(),
            memory,
            output,
            str(scratch.folder),
            str(path),
            attrs.asdict(limits),
            looks,
        )
        try:
            with theirs:
                self._process = subprocess.Popen(
                    [sys.executable, "-P", "-c", _START, _package(), settings.text()],
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=output,
                    pass_fds=(theirs.fileno(), memory, output),
                    start_new_session=True,  # Ctrl-C is for the master
                    env={**os.environ, **_SINGLE_THREADED, MARK: mark},
                )
        except BaseException:
            ours.close()
            os.close(output)
            scratch.cleanup()
            raise
        finally:
            shared = layout.HeadMemory.of(memory)
            os.close(memory)
        self._link, self._output = ours, output
        self._loaded: set[str] = set()
        self.head = shared.head
        self.messages = NativeMessages(self._library, shared.messages)
        self.entry = layout.Worker(ctypes.addressof(self.head), self._process.pid)
        ask = (self._library.remote_ask, self.entry, self.head)
        self.leftover = Leftover()
        self._end = weakref.finalize(
            self, _release, self._process, ask, ours, output, scratch, mark, self.leftover
        )

    @property
    def alive(self) -> bool:
        """Whether it can be asked."""
        return self._end.alive and not self.entry.ended

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    def load(self, path: str, unpacked: str, structure: Mapping[str, int]) -> None:
        """Load an FMU, once."""
        if path not in self._loaded:
            about = {"path": path, "unpacked": unpacked, "structure": dict(structure)}
            self.request({"do": "load", **about})
            self._loaded.add(path)

    def request(
        self, content: dict[str, Any], data: bytes = b"", handles: Sequence[int] = ()
    ) -> tuple[Any, bytes]:
        """Ask, and wait for the answer.

        Raises
        ------
        PosmasError
            What the worker raised.
        WorkerLost
            If it ends, or does not answer in time.
        """
        if not self.alive:
            raise WorkerLost(self.death())
        # told before it is sent: what is larger than the socket holds waits for the worker
        self._library.remote_ask(ctypes.addressof(self.entry))
        try:
            self._link.settimeout(self._patience.start)
            frames.send(self._link, content, data, handles)
        except OSError:
            self._lose(DIED)
        step = content["do"] == "replay" or content.get("method") in ("do_step", "read", "write")
        self._await(self._patience.step if step else self._patience.start)
        answer = frames.receive(self._link)
        if answer is None:
            self._lose(DIED)
        for line in answer.content.get("said", ()):
            _LOG.warning("%s", line)
        if "error" in answer.content:
            raise _error(answer.content["error"])
        return answer.content.get("result"), answer.data

    def _await(self, patience: float) -> None:
        """Wait until there is an answer; a worker that begins no other call for long is lost."""
        poll = select.poll()
        poll.register(self._link, select.POLLIN)
        begun, since = -1, time.monotonic()
        while not poll.poll(LOOK):
            if self._library.remote_ended(ctypes.addressof(self.entry)):
                self._lose(DIED)
            if self.head.calling.begun != begun:
                begun, since = self.head.calling.begun, time.monotonic()
            elif time.monotonic() - since > patience:
                self._lose(DEADLINE, patience)

    def _lose(self, why: int, patience: float = 0.0) -> NoReturn:
        self.kill(why)
        raise WorkerLost(self.death(patience))

    def kill(self, why: int = DIED) -> None:
        """End the process at once."""
        self._library.remote_kill(ctypes.addressof(self.entry))
        self.entry.ended = self.entry.ended or why

    def death(self, patience: float | None = None) -> Death:
        """Return how the process ended."""
        doing = self.head.doing.decode("utf-8", "replace")
        code = int(self.entry.code)
        if self.entry.ended == DEADLINE:
            seconds = self._patience.step if patience is None else patience
            text = f"did not answer within {seconds:g} s"
            return Death(text, None, None, doing, self.output())
        if self.head.gave_up in REASONS:
            text = f"was ended because {REASONS[self.head.gave_up]}"
        elif code < 0:
            text = f"was ended by signal {-code} ({_signal_name(-code)})"
        else:
            text = f"ended with exit code {code}"
        ended_by = -code if code < 0 else None
        return Death(text, ended_by, None if code < 0 else code, doing, self.output())

    def output(self) -> str:
        """Return the end of what the process wrote to stdout and stderr."""
        try:
            size = os.fstat(self._output).st_size
            data = os.pread(self._output, TAIL, max(0, size - TAIL))
        except OSError:
            return ""
        return data.decode("utf-8", "replace").replace("\0", "").strip()

    def say_goodbye(self) -> None:
        """Ask the process to end."""
        if self.alive:
            _say_goodbye(self._link)
            self._library.remote_ask(ctypes.addressof(self.entry))

    def close(self) -> None:
        """End the process and remove what it has left; a second call does nothing."""
        self._end()


class WorkerLost(Exception):  # noqa: N818  (turned into an error that names FMU and agent)
    """A worker ended, or did not answer."""

    def __init__(self, death: Death) -> None:
        super().__init__(death.text)
        self.death = death


def _release(
    process: subprocess.Popen[bytes],
    ask: tuple[Any, layout.Worker, layout.Head],
    link: socket.socket,
    output: int,
    scratch: Scratch,
    mark: str,
    leftover: Leftover,
) -> None:
    try:
        if process.poll() is None:
            _say_goodbye(link)
            function, entry, _ = ask
            function(ctypes.addressof(entry))
            try:
                process.wait(GRACE)
            except subprocess.TimeoutExpired:
                process.kill()
        process.wait()
    finally:
        link.close()
        os.close(output)
        leftover.number = end_marked(mark)
        scratch.cleanup()
    if leftover.number:
        who = f"{leftover.fmu or 'an FMU'}: {leftover.agent}"
        _LOG.warning("%s %s; ended", who.removesuffix(": "), leftover.text)


def _say_goodbye(link: socket.socket) -> None:
    try:
        link.settimeout(0.1)
        frames.send(link, {"do": "end"})
    except OSError:
        pass


def _append(handle: int) -> int:
    """Let all writes go to the end, wherever that has come to."""
    import fcntl

    fcntl.fcntl(handle, fcntl.F_SETFL, fcntl.fcntl(handle, fcntl.F_GETFL) | os.O_APPEND)
    return handle


_SINGLE_THREADED = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


def _package() -> str:
    """Folder that holds the package."""
    return str(Path(posmas_fmi.__file__).resolve().parents[1])


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return "unknown"


def _error(facts: dict[str, Any]) -> PosmasError:
    """Return the error that a worker tells about."""
    kind = getattr(errors, str(facts.pop("kind", "")), FmuError)
    if not (isinstance(kind, type) and issubclass(kind, PosmasError)):
        kind = FmuError
    try:
        error: PosmasError = kind(**facts)
    except TypeError:
        error = FmuError(str(facts.get("message")), str(facts.get("where", "")))
    return error


def lost_error(death: Death, fmu: str, instance: str, call: str, time: float) -> FmuLostError:
    """Return the end of a worker as an error about an FMU."""
    said = f"; it had written: {death.output}" if death.output else ""
    return FmuLostError(
        f"the process of the FMU {death.text} (at time {time:g} s){said}",
        f"{fmu}: {instance}: {call or 'between calls'}",
        instance,
        time,
        signal=death.signal,
        ended_with=death.exit_code,
    )
