"""The output folder of a run: made if needed, and for one run at a time."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from posmas_fmi.errors import InputError


def make_folder(folder: Path) -> None:
    """Make the folder of a run.

    Raises
    ------
    InputError
        If that is not possible.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"cannot make the output folder: {error.strerror}; choose another with --out",
            str(folder),
        ) from None


@contextmanager
def occupied(folder: Path) -> Iterator[None]:
    """Make the folder of a run and hold it: another run that wants it is refused.

    Raises
    ------
    InputError
        If it cannot be made, or another run holds it.
    """
    make_folder(folder)
    try:
        import fcntl
    except ImportError:  # no locks on folders here
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(
                "another run is writing to this folder; wait for it, or choose another with --out",
                str(folder),
            ) from None
        except OSError:  # not on this file system
            pass
        yield
    finally:
        os.close(handle)
