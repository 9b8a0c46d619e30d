"""Processes that an FMU has started: found by a mark in their environment, and ended.

A process hands its environment on to those that it starts, also to those that leave its group and
its session, so that the mark finds what a signal to the group does not. Needs ``/proc``.
"""

from __future__ import annotations

import os
import secrets
import signal
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

MARK = "POSMAS_FMI_MARK"
_ROUNDS = 20  # one that starts others meanwhile is found in the next


def new_mark() -> str:
    """Return a value of `MARK` that no other process has.

    Examples
    --------
    >>> new_mark() != new_mark()
    True
    """
    return secrets.token_hex(16)


def end_marked(mark: str) -> int:
    """End all processes with a mark but this one, and return how many there were.

    Parameters
    ----------
    mark : str
        Value of `MARK` in the environment that they began with.

    Examples
    --------
    >>> end_marked(new_mark())
    0
    """
    ended: set[int] = set()
    for _ in range(_ROUNDS):
        found = set(_marked(f"{MARK}={mark}".encode()))
        if not found:
            break
        for process in found:
            with suppress(ProcessLookupError, PermissionError):
                os.kill(process, signal.SIGKILL)
        ended |= found
    return len(ended)


def _marked(entry: bytes) -> Iterator[int]:
    for place in Path("/proc").glob("[0-9]*"):
        process = int(place.name)
        if process == os.getpid():
            continue
        with suppress(OSError):  # it has ended, or is another user's
            if entry in (place / "environ").read_bytes().split(b"\0"):
                yield process
