"""The structures of csrc/remote.h, and the memory that a master and a worker share."""

from __future__ import annotations

import ctypes
import mmap
import os
import sys
import tempfile
from typing import TYPE_CHECKING, Any

import attrs
import numpy as np

from posmas_fmi.cosim.fmus import Incident, MessageLog, Report
from posmas_fmi.errors import BuildError

if TYPE_CHECKING:
    from posmas_fmi.expression import Array

_int, _double, _pointer = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p
_LINE = 64


class Calling(ctypes.Structure):
    """Which call is going on."""

    _fields_ = (("begun", _int), ("call", _int), ("instance", _int))


class Head(ctypes.Structure):
    """Of one worker, in shared memory."""

    _fields_ = (
        ("bell", ctypes.c_uint32),
        ("waiting", ctypes.c_uint32),
        ("asked", _int),
        ("apart", ctypes.c_char * (_LINE - 16)),
        ("turn", ctypes.c_uint32),
        ("asleep", ctypes.c_uint32),
        ("calling", Calling),
        ("gave_up", _int),
        ("also_apart", ctypes.c_char * (_LINE - 40)),
        ("doing", ctypes.c_char * _LINE),
    )


class Slot(ctypes.Structure):
    """Of one instance, in shared memory; its inputs and then its readings follow."""

    _fields_ = (
        ("posted", _int),
        ("steps", _int),
        ("t", _double),
        ("h", _double),
        ("apart", ctypes.c_char * (_LINE - 32)),
        ("done", _int),
        ("report", Report),
        ("also_apart", ctypes.c_char * (2 * _LINE - 8 - ctypes.sizeof(Report))),
    )


class Worker(ctypes.Structure):
    """A worker as the master's C loop knows it."""

    _fields_ = (
        ("head", _pointer),
        ("process", _int),
        ("numbers", _pointer),
        ("instances", _int),
        ("posted", _int),
        ("ended", _int),
        ("code", _int),
    )


class Past(ctypes.Structure):
    """Steps since the last saved state."""

    _fields_ = (
        ("wanted", _int),
        ("n", _int),
        ("room", _int),
        ("most", _int),
        ("cut", _int),
        ("rows", _pointer),
    )


class InstanceEntry(ctypes.Structure):
    """An instance as the master's C loop knows it."""

    _fields_ = (
        ("worker", _int),
        ("slot", _pointer),
        ("inputs", _int),
        ("readings", _int),
        ("given_up", _int),
        ("incident", Incident),
        ("past", Past),
    )


Recover = ctypes.CFUNCTYPE(ctypes.c_int, _int)
Interrupted = ctypes.CFUNCTYPE(ctypes.c_int)


class Workers(ctypes.Structure):
    """All workers: the context of the functions in `Hook`."""

    _fields_ = (
        ("workers", _pointer),
        ("n_workers", _int),
        ("instances", _pointer),
        ("deadline", _double),
        ("looks", _int),
        ("recover", Recover),
        ("interrupted", Interrupted),
        ("recovering", _int),
    )


class Hook(ctypes.Structure):
    """`Remote` of csrc/fmus.h."""

    _fields_ = tuple((name, _pointer) for name in ("context", "post", "send", "wait", "read"))


class WorkerLoop(ctypes.Structure):
    """The loop of a worker."""

    _fields_ = (
        ("head", _pointer),
        ("fmus", _pointer),
        ("slots", _pointer),
        ("scratch", _pointer),
        ("looks", _int),
        ("answered", _int),
    )


def check(library: ctypes.CDLL) -> None:
    """Check that the library has the same structures.

    Raises
    ------
    BuildError
    """
    library.remote_size.argtypes, library.remote_size.restype = [_int], _int
    kinds = (Head, Slot, Worker, InstanceEntry, Workers, WorkerLoop)
    for k, kind in enumerate(kinds):
        if library.remote_size(k) != ctypes.sizeof(kind):
            raise BuildError("the library of the worker processes belongs to another version")


# ---- memory --------------------------------------------------------------------------------------


def shared_file(name: str, size: int = 0) -> int:
    """Return a descriptor of a file that has no name and goes with its last user."""
    if hasattr(os, "memfd_create"):
        handle = os.memfd_create(name, os.MFD_CLOEXEC)
    else:
        with tempfile.TemporaryFile() as file:  # removed already
            handle = os.dup(file.fileno())
    if size:
        os.ftruncate(handle, size)
    return handle


@attrs.frozen(eq=False)
class HeadMemory:
    """Shared memory of a worker that is there from its start: head and messages.

    Attributes
    ----------
    head : Head
    messages : MessageLog
    """

    head: Head
    messages: MessageLog

    @staticmethod
    def size() -> int:
        """Bytes."""
        return ctypes.sizeof(Head) + ctypes.sizeof(MessageLog)

    @classmethod
    def of(cls, handle: int) -> HeadMemory:
        """Map the memory behind a descriptor."""
        memory = mmap.mmap(handle, cls.size())
        return cls(Head.from_buffer(memory), MessageLog.from_buffer(memory, ctypes.sizeof(Head)))


@attrs.frozen(eq=False)
class SlotMemory:
    """Shared memory of the instances of a worker.

    Attributes
    ----------
    slots : tuple of Slot
    inputs, readings : tuple of array
        The values in each slot.
    """

    slots: tuple[Slot, ...]
    inputs: tuple[Array, ...]
    readings: tuple[Array, ...]

    @staticmethod
    def strides(widths: list[tuple[int, int]]) -> list[int]:
        """Bytes of each slot, from its numbers of inputs and readings."""
        lines = (ctypes.sizeof(Slot) + 8 * (n + m) for n, m in widths)
        return [-(-size // _LINE) * _LINE for size in lines]

    @classmethod
    def of(cls, handle: int, widths: list[tuple[int, int]]) -> SlotMemory:
        """Map the memory behind a descriptor."""
        strides = cls.strides(widths)
        memory = mmap.mmap(handle, max(sum(strides), 1))
        slots, inputs, readings = [], [], []
        at = 0
        for (n, m), stride in zip(widths, strides, strict=True):
            slots.append(Slot.from_buffer(memory, at))
            values: Any = np.ndarray(n + m, float, memory, at + ctypes.sizeof(Slot))
            inputs.append(values[:n])
            readings.append(values[n:])
            at += stride
        return cls(tuple(slots), tuple(inputs), tuple(readings))

    @property
    def addresses(self) -> list[int]:
        """Of the slots."""
        return [ctypes.addressof(slot) for slot in self.slots]


def possible() -> bool:
    """Whether FMUs can run in worker processes on this system."""
    return sys.platform != "win32"
