"""What a trial writes down as it goes, in shared memory: it stays when the process dies."""

from __future__ import annotations

import json
import mmap
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

SIZE = 16 * 2**20  # bytes of the file
_NAME = 120  # bytes of the call's name
_HEAD = struct.Struct(f"<QQ???{_NAME}s{_NAME}s")
_BEGIN = 512  # of the entries


class Board:
    """A file in shared memory with the call that is going on, and entries one after the other.

    Parameters
    ----------
    path : Path
        Of the file, which `create` has made.

    Attributes
    ----------
    calls : int
        Number of calls begun and ended.
    calling : bool
        Whether one is going on.
    done : bool
        Whether the trial got to its end.
    vital : bool
        Whether the FMU is of no use if the present call fails.
    call, phase : str
        The last call, and the part of the trial.
    """

    def __init__(self, path: Path) -> None:
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), SIZE)
        self._written = 0
        self.calls = 0
        self.calling = self.done = False
        self.vital = True
        self.call = self.phase = ""

    @staticmethod
    def create(path: Path) -> None:
        """Make the file."""
        with path.open("wb") as file:
            file.truncate(SIZE)

    def close(self) -> None:
        """Unmap the file."""
        self._memory.close()

    # ---- the trial's side -----------------------------------------------------------------------

    def begin(self, call: str) -> None:
        """Say which call begins."""
        self.calls += 1
        self.calling, self.call = True, call
        self._write()

    def end(self) -> None:
        """Say that it came back."""
        self.calls += 1
        self.calling = False
        self._write()

    def finish(self) -> None:
        """Say that the trial is at its end."""
        self.done = True
        self._write()

    def enter(self, phase: str, vital: bool = False) -> None:
        """Say which part of the trial begins, and whether all depends on it."""
        self.phase, self.vital = phase, vital
        self._write()

    def add(self, entry: dict[str, Any]) -> None:
        """Append an entry; one that does not fit any more is left out."""
        data = json.dumps(entry).encode() + b"\n"
        start = _BEGIN + self._written
        if start + len(data) <= SIZE:
            self._memory[start : start + len(data)] = data
            self._written += len(data)
            self._write()

    def _write(self) -> None:
        names = (self.call.encode()[:_NAME], self.phase.encode()[:_NAME])
        _HEAD.pack_into(
            self._memory,
            0,
            *(self.calls, self._written, self.calling, self.done, self.vital),
            *names,
        )

    # ---- the other side -------------------------------------------------------------------------

    def look(self) -> None:
        """Read the head."""
        head = _HEAD.unpack_from(self._memory, 0)
        self.calls, written, self.calling, self.done, self.vital, call, phase = head
        self._written = min(written, SIZE - _BEGIN)  # an FMU may have written anything
        self.call, self.phase = (
            name.rstrip(b"\0").decode("utf-8", "replace") for name in (call, phase)
        )

    def entries(self) -> Iterator[dict[str, Any]]:
        """Go through the entries; what an FMU has overwritten is left out."""
        data = bytes(self._memory[_BEGIN : _BEGIN + self._written])
        for line in data.splitlines():
            try:
                entry = json.loads(line)
            except ValueError:
                continue
            if isinstance(entry, dict):
                yield entry
