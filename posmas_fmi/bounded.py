"""Files of others, read no further than they may be long."""

from __future__ import annotations

import errno
from pathlib import Path


def read_bounded(path: Path, most: int) -> bytes:
    """Return what is in a file, or comes through a pipe; `/dev/zero` would have no end.

    Parameters
    ----------
    path : Path
    most : int
        Bytes that it may have.

    Raises
    ------
    OSError
        If it cannot be read, or has more.

    Examples
    --------
    >>> read_bounded(Path(__file__), 10)
    Traceback (most recent call last):
        ...
    OSError: [Errno 27] it is larger than 10 bytes: '...'
    """
    with path.open("rb") as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise OSError(errno.EFBIG, f"it is larger than {most:g} bytes", str(path))
    return data


def require_regular(path: Path) -> None:
    """See that opening a file will not wait for somebody at the other end of a pipe.

    Raises
    ------
    OSError
        If there is something else, a folder too; of what is not there nothing is said.
    """
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "it is no regular file", str(path))
