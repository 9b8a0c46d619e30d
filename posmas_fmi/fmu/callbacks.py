"""What an FMU calls back: where its messages go, and its allocator."""

from __future__ import annotations

import ctypes
from collections import deque
from collections.abc import Iterable
from functools import cache
from typing import Any, Protocol

_KEPT_MESSAGES = 20
_LONGEST_MESSAGE = 2000


class Messages(Protocol):
    """Where the messages of instances go, told apart by their keys."""

    def logger(self, version: int) -> int:
        """Address of the function that FMUs of this FMI version call."""

    def environment(self, key: int) -> int:
        """Return what the instance gives to that function."""

    def forget(self, key: int) -> None:
        """Leave out what the instance has said so far."""

    def of(self, key: int) -> list[str]:
        """Return the last few messages of the instance."""


class PythonMessages:
    """Messages kept by Python functions; implements `Messages`."""

    def __init__(self) -> None:
        from fmpy.fmi2 import fmi2CallbackLoggerTYPE
        from fmpy.fmi3 import fmi3LogMessageCallback

        kept: dict[int, deque[str]] = {}  # the functions must not keep self alive

        def keep(key: int | None, message: bytes | None) -> None:
            text = (message or b"")[:_LONGEST_MESSAGE].decode("utf-8", "replace")
            kept.setdefault(key or 0, deque(maxlen=_KEPT_MESSAGES)).append(text)

        self._kept = kept
        self._functions = {
            2: fmi2CallbackLoggerTYPE(lambda key, _n, _s, _c, text: keep(key, text)),
            3: fmi3LogMessageCallback(lambda key, _s, _c, text: keep(key, text)),
        }

    def logger(self, version: int) -> int:
        """Address of the function that FMUs of this FMI version call."""
        return int(ctypes.cast(self._functions[version], ctypes.c_void_p).value or 0)

    def environment(self, key: int) -> int:
        """Return what the instance gives to that function."""
        return key

    def forget(self, key: int) -> None:
        """Leave out what the instance has said so far."""
        self._kept.pop(key, None)

    def of(self, key: int) -> list[str]:
        """Return the last few messages of the instance."""
        return list(self._kept.get(key, ()))


def callbacks_for(version: int, messages: Messages, key: int) -> Any:
    """Return what an instance gets to call back; none of it goes through Python by itself."""
    if version == 3:
        return _callback_fmi3(messages.logger(3))
    if version == 1:
        return _callbacks_fmi1(messages, key)

    from fmpy import calloc, free
    from fmpy.fmi2 import (
        fmi2CallbackAllocateMemoryTYPE,
        fmi2CallbackFreeMemoryTYPE,
        fmi2CallbackFunctions,
        fmi2CallbackLoggerTYPE,
    )

    functions = fmi2CallbackFunctions()
    functions.logger = fmi2CallbackLoggerTYPE(messages.logger(2))
    functions.allocateMemory = ctypes.cast(calloc, fmi2CallbackAllocateMemoryTYPE)
    functions.freeMemory = ctypes.cast(free, fmi2CallbackFreeMemoryTYPE)
    functions.componentEnvironment = messages.environment(key)
    return functions


@cache
def _callback_fmi3(logger: int) -> Any:
    from fmpy.fmi3 import fmi3LogMessageCallback

    return fmi3LogMessageCallback(logger)


def _callbacks_fmi1(messages: Messages, key: int) -> Any:
    """Callbacks of FMI 1.0, where the logger is not given back what tells the instances apart."""
    from fmpy import calloc, free
    from fmpy.fmi1 import (
        fmi1CallbackAllocateMemoryTYPE,
        fmi1CallbackFreeMemoryTYPE,
        fmi1CallbackFunctions,
        fmi1CallbackLoggerTYPE,
    )

    keep = _callback_fmi3(messages.logger(3))
    environment = messages.environment(key)

    def log(_: Any, __: Any, status: int, category: bytes | None, text: bytes | None) -> None:
        keep(environment, status, category, text)

    functions = fmi1CallbackFunctions()
    functions.logger = fmi1CallbackLoggerTYPE(log)
    functions.allocateMemory = ctypes.cast(calloc, fmi1CallbackAllocateMemoryTYPE)
    functions.freeMemory = ctypes.cast(free, fmi1CallbackFreeMemoryTYPE)
    return functions


def said(message: str, messages: Iterable[str]) -> str:
    """Append what an FMU said to a message."""
    lines = list(messages)
    return f"{message}: {'; '.join(lines)}" if lines else message
