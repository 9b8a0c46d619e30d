"""Requests and answers over a socket: JSON, and bytes beside it; nothing that could be run."""

from __future__ import annotations

import json
import os
import socket
import struct
from collections.abc import Sequence
from typing import Any

import attrs

_HEAD = struct.Struct("<IQ")


@attrs.frozen
class Frame:
    """A message.

    Attributes
    ----------
    content : dict
        What JSON can hold; floats come over exactly.
    data : bytes
    handles : tuple of int
        File descriptors that came with it.
    """

    content: dict[str, Any]
    data: bytes = b""
    handles: tuple[int, ...] = ()


def send(
    link: socket.socket, content: dict[str, Any], data: bytes = b"", handles: Sequence[int] = ()
) -> None:
    """Send a message."""
    text = json.dumps(content).encode()
    head = _HEAD.pack(len(text), len(data))
    if handles:
        socket.send_fds(link, [head], list(handles))
    else:
        link.sendall(head)
    link.sendall(text)
    if data:
        link.sendall(data)


def receive(link: socket.socket) -> Frame | None:
    """Return the next message, None at the end; what is no message ends it as well."""
    handles: list[int] = []
    try:
        head, handles, _, _ = socket.recv_fds(link, _HEAD.size, 4)
        if not head:
            return None
        head += _exactly(link, _HEAD.size - len(head))
        text_size, data_size = _HEAD.unpack(head)
        content = json.loads(_exactly(link, text_size))
        if not isinstance(content, dict):
            raise ValueError("no message")
        return Frame(content, _exactly(link, data_size), tuple(handles))
    except (OSError, EOFError, ValueError, RecursionError, MemoryError, OverflowError):
        for handle in handles:
            os.close(handle)
        return None


def _exactly(link: socket.socket, size: int) -> bytes:
    parts: list[bytes] = []
    while size > 0:
        part = link.recv(min(size, 1 << 20))
        if not part:
            raise EOFError
        parts.append(part)
        size -= len(part)
    return b"".join(parts)
