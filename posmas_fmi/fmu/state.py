"""Saved states of FMU instances."""

from __future__ import annotations

import ctypes
import weakref
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from posmas_fmi.fmu.live import free_state

if TYPE_CHECKING:
    from posmas_fmi.fmu.instance import FmuInstance


class FmuState:
    """A saved state of one instance; freed by `free`, a ``with`` block, or with the instance.

    Attributes
    ----------
    time : float
        Of the instance then [s].
    beside : object
        What the instance keeps outside the FMU.
    """

    def __init__(self, instance: FmuInstance, handle: ctypes.c_void_p, time: float) -> None:
        self.handle = handle
        self.time = time
        self.beside: Any = None
        live = instance._live
        live.states[id(handle)] = handle
        self._free = weakref.finalize(self, free_state, live, handle, instance.file._frees)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.free()

    def free(self) -> None:
        """Free the memory of the state; a second call does nothing."""
        self._free()
