"""Saved states of FMU instances."""

from __future__ import annotations

import ctypes
import json
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
    beside : dict
        What the instance keeps outside the FMU, as JSON has it; empty for nothing.
    """

    def __init__(
        self, instance: FmuInstance, handle: ctypes.c_void_p, time: float, beside: dict[str, Any]
    ) -> None:
        self.handle = handle
        self.time = time
        self.beside = beside
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


_MARK = b"\0posmas-fmi state\0"


def joined(inside: bytes, beside: dict[str, Any]) -> bytes:
    """Return the bytes of an FMU with what is kept beside them; those alone where that is nothing.

    Examples
    --------
    >>> parted(joined(b"of the FMU", {"next_event": 0.1}))
    (b'of the FMU', {'next_event': 0.1})
    >>> parted(joined(b"of the FMU", {}))
    (b'of the FMU', {})
    """
    if not beside:
        return inside
    kept = json.dumps(beside).encode()
    return _MARK + len(kept).to_bytes(8, "little") + kept + inside


def parted(data: bytes) -> tuple[bytes, dict[str, Any]]:
    """Return the two that `joined` has put together."""
    if not data.startswith(_MARK):
        return data, {}
    begin = len(_MARK) + 8
    end = begin + int.from_bytes(data[len(_MARK) : begin], "little")
    return data[end:], json.loads(data[begin:end])
