"""Files that are there whole or not at all, whatever ends the process that writes them."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from posmas_fmi.errors import ResultsError


@contextmanager
def whole(path: Path, mode: str = "w") -> Iterator[IO[Any]]:
    """Open a file that gets its name when all is written; text is UTF-8.

    Parameters
    ----------
    path : Path
        Replaced if it exists.
    mode : {"w", "wb"}

    Raises
    ------
    ResultsError
        If it cannot be written, on a full disk say; what has the name then stays.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "facts.txt")
    ...     with whole(path) as file:
    ...         _ = file.write("all")
    ...     path.read_text()
    'all'
    """
    partial = path.with_name(f"{path.name}.partial")
    encoding, newline = (None, None) if "b" in mode else ("utf-8", "")
    try:
        try:
            with partial.open(mode, encoding=encoding, newline=newline) as file:
                yield file
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        raise ResultsError(
            f"cannot be written: {error.strerror or error}; make room, or choose another folder",
            str(path),
        ) from error
