"""What is alive in the binary of an FMU, and how it is released."""

from __future__ import annotations

import ctypes
import itertools
from typing import Any

import attrs

from posmas_fmi.fmu.callbacks import Messages
from posmas_fmi.fmu.scratch import Scratch

KEYS = itertools.count(1)


@attrs.define(eq=False)
class Live:
    """An instance as the binary knows it; what it calls back must live as long."""

    messages: Messages
    callbacks: Any
    component: int = 0
    states: dict[int, ctypes.c_void_p] = attrs.field(factory=dict)


@attrs.frozen
class Frees:
    """The functions of the binary that free an instance and a state."""

    instance: Any
    state: Any


def free_state(live: Live, handle: ctypes.c_void_p, frees: Frees) -> None:
    """Free a saved state, unless it was freed with its instance."""
    if live.states.pop(id(handle), None) is not None:
        frees.state(live.component, ctypes.byref(handle))


def free_instance(instances: dict[int, Live], key: int, frees: Frees) -> None:
    """Free an instance and its saved states, unless that was done before."""
    live = instances.pop(key, None)
    if live is None:
        return
    for handle in list(live.states.values()):
        free_state(live, handle, frees)
    frees.instance(live.component)
    live.messages.forget(key)


def release(
    instances: dict[int, Live],
    frees: Frees,
    unload: Any,
    folder: Scratch | None,
) -> None:
    """Free all instances, the library and the unpacked files."""
    for key in list(instances):
        free_instance(instances, key, frees)
    unload()
    if folder is not None:
        folder.cleanup()
