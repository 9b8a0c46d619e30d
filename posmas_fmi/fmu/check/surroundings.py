"""What an FMU may change in its process without being asked: noticed, told, and put back."""

from __future__ import annotations

import ctypes
import locale
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

_ACTION = 256  # bytes, more than a struct sigaction has anywhere
_FENV = 512  # bytes, more than an fenv_t has anywhere
_MODES = {0: "to nearest", 0x400: "down", 0x800: "up", 0xC00: "towards zero"}
_TINY = sys.float_info.min


class Surroundings:
    """The state of this process as it was when the object was made.

    Attributes
    ----------
    threads, descriptors : int
        How many there were.
    """

    def __init__(self) -> None:
        self._libc = ctypes.CDLL(None)
        self._libm = ctypes.CDLL("libm.so.6") if sys.platform == "linux" else self._libc
        self._watched = [n for n in range(1, 32) if n not in (signal.SIGKILL, signal.SIGSTOP)]
        self._environment = ctypes.create_string_buffer(_FENV)
        self._libm.fegetenv(self._environment)
        self.keep()
        self.threads, self.descriptors = threads(), len(_descriptors())

    def keep(self) -> None:
        """Take the present state as the one to compare with."""
        self._folder = os.getcwd()
        self._locale = locale.setlocale(locale.LC_ALL)
        self._signals = self._actions()
        self._files = {fd: _identity(fd) for fd in _descriptors()}
        self._arithmetic = self._floats()
        self._variables = self._variables_now()

    def changes(self) -> Iterator[tuple[str, str]]:
        """Go through code and text of what is different, putting it back where that can be done."""
        yield from self._folder_changes()
        now = locale.setlocale(locale.LC_ALL)
        if now != self._locale:
            yield "changes-locale", f"it set the locale to {now}"
            locale.setlocale(locale.LC_ALL, self._locale)
        floats = self._floats()
        if floats != self._arithmetic:
            mode, flushes, traps = floats
            if mode != self._arithmetic[0]:
                yield "changes-rounding", f"floats are now rounded {_MODES.get(mode, mode)}"
            if flushes != self._arithmetic[1]:
                yield "changes-denormals", "very small floats are now taken as zero"
            if traps != self._arithmetic[2]:
                yield "changes-traps", "floating-point exceptions now end the process"
            self._libm.fesetenv(self._environment)
        yield from self._signal_changes()
        gone = [fd for fd, was in self._files.items() if _identity(fd) != was]
        if gone:
            listed = ", ".join(map(str, gone[:5]))
            yield (
                "closes-descriptors",
                f"it closed file descriptors that are not its own ({listed})",
            )
            self._files = {fd: _identity(fd) for fd in self._files if fd not in gone}
        variables = self._variables_now()
        if variables != self._variables:
            names = sorted({v.split(b"=")[0] for v in variables ^ self._variables})
            text = ", ".join(name.decode("utf-8", "replace")[:40] for name in names[:5])
            yield "changes-environment", f"it changed environment variables ({text})"
            self._variables = variables

    def _folder_changes(self) -> Iterator[tuple[str, str]]:
        try:
            now = os.getcwd()
        except OSError as error:
            now = str(error)
        if now != self._folder:
            yield "changes-folder", f"it changed the working directory to {now}"
            os.chdir(self._folder)

    def _signal_changes(self) -> Iterator[tuple[str, str]]:
        actions = self._actions()
        changed = [n for n, action in actions.items() if action[:8] != self._signals[n][:8]]
        if changed:
            names = ", ".join(signal.Signals(n).name for n in changed[:5])
            yield "changes-signals", f"it took the handlers of {names}"
            for n in changed:
                self._libc.sigaction(n, self._signals[n], None)

    def _actions(self) -> dict[int, bytes]:
        buffer = ctypes.create_string_buffer(_ACTION)
        found = {}
        for number in self._watched:
            self._libc.sigaction(number, None, buffer)
            found[number] = buffer.raw  # begins with the address of the handler
        return found

    def _floats(self) -> tuple[int, bool, int]:
        """Return the rounding mode, whether small numbers are flushed, which exceptions trap."""
        half = _TINY / 2
        traps = self._libm.fegetexcept() if sys.platform == "linux" else 0
        return self._libm.fegetround(), half == 0 or half * 2 == 0, traps

    def _variables_now(self) -> set[bytes]:
        table = ctypes.POINTER(ctypes.c_char_p).in_dll(self._libc, "environ")
        found = set()
        if table:
            k = 0
            while table[k] is not None:
                found.add(table[k])
                k += 1
        return found


def threads() -> int:
    """Count the threads of this process."""
    with suppress(OSError):
        return len(os.listdir("/proc/self/task"))
    return threading.active_count()


def descriptors() -> int:
    """Count the open file descriptors."""
    return len(_descriptors())


def resident() -> int:
    """Bytes of memory that this process has in use; 0 where the system does not tell."""
    return resident_of("self")


def resident_of(process: int | str) -> int:
    """Bytes of memory that a process has in use; 0 where the system does not tell."""
    try:
        pages = int(Path(f"/proc/{process}/statm").read_bytes().split()[1])
    except (OSError, ValueError, IndexError):
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def handles_of(process: int | str) -> int:
    """How many descriptors a process has open; 0 where the system does not tell."""
    try:
        return len(os.listdir(f"/proc/{process}/fd"))
    except OSError:
        return 0


def _descriptors() -> list[int]:
    return [fd for fd in range(256) if _identity(fd) is not None]


def _identity(fd: int) -> Any:
    try:
        found = os.fstat(fd)
    except OSError:
        return None
    return found.st_dev, found.st_ino
