"""Compiled libraries, loaded once."""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path

from posmas_fmi.errors import BuildError


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
