"""Temporary folders that are removed at the latest by the next run, whatever ended this one."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
import weakref
from pathlib import Path

from posmas_fmi.interrupt import Interrupt

PREFIX = "posmas-fmi-"
_LOCK = ".in-use"


class Scratch:
    """A temporary folder; its owner holds a lock on a file in it for as long as it lives.

    Parameters
    ----------
    prefix : str
        Begins with `PREFIX`.

    Attributes
    ----------
    folder : Path

    Examples
    --------
    >>> scratch = Scratch()
    >>> scratch.folder.is_dir()
    True
    >>> scratch.cleanup()
    >>> scratch.folder.exists()
    False
    """

    def __init__(self, prefix: str = PREFIX) -> None:
        with Interrupt(soon=True) as interrupt:  # or the folder is there and nobody knows
            self.folder = Path(tempfile.mkdtemp(prefix=prefix))
            handle = os.open(self.folder / _LOCK, os.O_CREAT | os.O_RDWR, 0o600)
            _lock(handle)
            self._end = weakref.finalize(self, _release, self.folder, handle)
        interrupt.check()

    def cleanup(self) -> None:
        """Remove the folder; a second call does nothing."""
        self._end()


def sweep() -> list[Path]:
    """Remove the folders of processes that were killed, and return them."""
    gone = []
    for folder in Path(tempfile.gettempdir()).glob(f"{PREFIX}*"):
        with contextlib.suppress(OSError):
            if folder.is_dir() and not folder.is_symlink() and _abandoned(folder):
                shutil.rmtree(folder, ignore_errors=True)
                gone.append(folder)
    return gone


def size_of(folder: Path, enough: float) -> int:
    """Bytes in the files of a folder, counted until there are more than enough."""
    total = 0
    for place, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(OSError):
                total += os.lstat(os.path.join(place, name)).st_blocks * 512
            if total > enough:
                return total
    return total


def _abandoned(folder: Path) -> bool:
    try:
        handle = os.open(folder / _LOCK, os.O_RDWR)
    except FileNotFoundError:
        return False  # of something else, or just being made
    try:
        return _lock(handle)
    finally:
        os.close(handle)


def _lock(handle: int) -> bool:
    """Lock an open file; whether nobody else had. Without locks nobody is ever gone."""
    try:
        import fcntl
    except ImportError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _release(folder: Path, handle: int) -> None:
    with Interrupt(soon=True) as interrupt:
        os.close(handle)
        shutil.rmtree(folder, ignore_errors=True)
    interrupt.check()
