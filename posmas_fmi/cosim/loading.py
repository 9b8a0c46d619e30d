"""Compiled libraries, loaded once, and where arrays are for them."""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path
from typing import Any

from posmas_fmi.errors import BuildError

_Bytes = ctypes.c_char * 0


@cache
def load(path: Path) -> ctypes.CDLL:
    """Load a library; it stays loaded, for FMUs hold addresses in it.

    Raises
    ------
    BuildError
        If it cannot be loaded here.
    """
    try:
        return ctypes.CDLL(str(path))
    except OSError as error:
        raise BuildError(f"the library cannot be loaded: {error}", str(path)) from error


def address(array: Any) -> int:
    """Return where an array is; `array.ctypes.data` takes three times as long.

    Raises
    ------
    TypeError
        If it does not stand in one piece, or cannot be written to.
    """
    return ctypes.addressof(_Bytes.from_buffer(array))
