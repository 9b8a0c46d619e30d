"""The worker process: answers the requests of its master, and steps FMUs between them."""

from __future__ import annotations

import ctypes
import json
import logging
import os
import signal
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from posmas_fmi.cosim.fmus import Fmus, NativeMessages, PortMap
from posmas_fmi.cosim.loading import load
from posmas_fmi.cosim.worker import frames, layout
from posmas_fmi.cosim.worker.minder import Limits, Minder, bound
from posmas_fmi.errors import FmuCallError, PosmasError
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.instance import FmuInstance
from posmas_fmi.fmu.open import open_fmu
from posmas_fmi.fmu.state import FmuState

Answer = tuple[Any, bytes]


@attrs.frozen
class Settings:
    """What the master tells at the start: descriptors, places, limits."""

    link: int
    memory: int
    output: int
    folder: str
    library: str
    limits: dict[str, Any]
    looks: float

    def text(self) -> str:
        """As an argument of the process."""
        return json.dumps(attrs.asdict(self))


def main(text: str) -> None:
    """Run a worker until its master says so, or is gone."""
    settings = Settings(**json.loads(text))
    limits = Limits(**settings.limits)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the master decides
    folder = Path(settings.folder)
    os.chdir(folder)
    os.environ["TMPDIR"] = str(folder)
    memory = layout.HeadMemory.of(settings.memory)
    os.close(settings.memory)
    Minder(settings.link, settings.output, folder, memory.head, limits).start()
    bound(limits)
    server = Server(settings, memory)
    server.serve()
    os._exit(0)  # what a library does at the end of its process is of no interest


class Server:
    """Files, instances and the loop of one worker process.

    Parameters
    ----------
    settings : Settings
    memory : HeadMemory
    """

    def __init__(self, settings: Settings, memory: layout.HeadMemory) -> None:
        self._link = socket.socket(fileno=settings.link)
        self._head = memory.head
        self._library = load(Path(settings.library))
        layout.check(self._library)
        self._library.surroundings_keep()
        self._library.worker_run.argtypes = [ctypes.c_void_p]
        self._library.worker_run.restype = None
        self._replay = self._library.worker_replay
        self._replay.argtypes = [ctypes.c_void_p, ctypes.c_int64, ctypes.c_void_p, ctypes.c_int64]
        self._replay.restype = ctypes.c_int64
        self._messages = NativeMessages(self._library, memory.messages)
        self._files: dict[str, FmuFile] = {}
        self._instances: dict[int, FmuInstance] = {}
        self._kept: dict[int, FmuState] = {}
        self._loop = layout.WorkerLoop(
            *(ctypes.addressof(memory.head), None, None, None),
            *(int(1e9 * settings.looks), 0),
        )
        self._keep: list[Any] = []  # what the loop points to
        self._said: list[str] = []
        logging.getLogger("posmas_fmi").addHandler(_Keep(self._said))

    def serve(self) -> None:
        """Answer requests until there are no more."""
        while True:
            if self._loop.fmus:
                self._library.worker_run(ctypes.addressof(self._loop))
            request = frames.receive(self._link)
            if request is None or request.content.get("do") == "end":
                break
            self._loop.answered += 1
            self._said.clear()
            content, data = self._answer(request)
            self._library.surroundings_put_back()
            self._head.doing = b""
            frames.send(self._link, {**content, "said": self._said}, data)
        for file in self._files.values():
            file.close()

    def _answer(self, request: frames.Frame) -> tuple[dict[str, Any], bytes]:
        do: Callable[[frames.Frame], Answer] = getattr(self, f"_do_{request.content['do']}")
        try:
            result, data = do(request)
        except PosmasError as error:
            return {"error": _facts(error)}, b""
        except Exception as error:  # FMPy and ctypes raise many kinds
            message = f"{type(error).__name__}: {error}"
            return {"error": {"kind": "FmuError", "message": message, "where": ""}}, b""
        return {"result": result}, data

    def _trace(self, function: str) -> None:
        self._head.doing = function.encode()[:63]
        self._head.calling.begun += 1

    # ---- requests -------------------------------------------------------------------------------

    def _do_load(self, request: frames.Frame) -> Answer:
        path, unpacked = request.content["path"], request.content["unpacked"]
        if path not in self._files:
            structure = request.content["structure"]
            self._files[path] = open_fmu(
                path, self._messages, self._trace, Path(unpacked), structure
            )
        return None, b""

    def _do_instantiate(self, request: frames.Frame) -> Answer:
        instance = self._files[request.content["path"]].instantiate(request.content["name"])
        self._instances[instance.key] = instance
        return instance.key, b""

    def _do_call(self, request: frames.Frame) -> Answer:
        instance = self._instances[request.content["key"]]
        method, arguments = request.content["method"], request.content["arguments"]
        if method not in CALLS:
            raise ValueError(f"no method {method}")
        if method == "free":
            del self._instances[request.content["key"]]
            self._kept.pop(request.content["key"], None)
        if method in ("read", "write"):
            arguments = {**arguments, "ports": instance.file.ports(arguments["ports"])}
        if method == "deserialise":
            arguments = {**arguments, "data": request.data}
        result = getattr(instance, method)(**arguments)
        if isinstance(result, bytes):
            return instance.time, result
        if isinstance(result, np.ndarray):
            result = result.tolist()
        return result, b""

    def _do_keep(self, request: frames.Frame) -> Answer:
        """Keep the state of an instance here, in place of the one that was kept before."""
        key = request.content["key"]
        if key in self._kept:
            self._kept.pop(key).free()
        self._kept[key] = self._instances[key].get_state()
        return None, b""

    def _do_go_back(self, request: frames.Frame) -> Answer:
        """Take an instance back to the state that is kept here."""
        key = request.content["key"]
        self._instances[key].set_state(self._kept[key])
        return None, b""

    def _do_bind(self, request: frames.Frame) -> Answer:
        """Take the instances that the loop is to step, and where their values are exchanged."""
        entries, (handle,) = request.content["instances"], request.handles
        instances = [self._instances[entry["key"]] for entry in entries]
        inputs = [port_map(entry["inputs"]) for entry in entries]
        readings = [port_map(entry["readings"]) for entry in entries]
        fmus = Fmus(instances, inputs, readings, self._messages)
        fmus.structure.calling = ctypes.addressof(self._head.calling)
        widths = [(i.width, len(r.variables)) for i, r in zip(inputs, readings, strict=True)]
        memory = layout.SlotMemory.of(handle, widths)
        os.close(handle)
        slots = np.array(memory.addresses, dtype=np.uintp)
        scratch = np.zeros(fmus.room)
        self._keep = [fmus, memory, slots, scratch]
        self._loop.fmus, self._loop.slots = fmus.address, slots.ctypes.data
        self._loop.scratch = scratch.ctypes.data
        return None, b""

    def _do_replay(self, request: frames.Frame) -> Answer:
        """Do steps again, one row of t, h, inputs each, and read; return how many went well."""
        rows = np.frombuffer(request.data, float)
        number, count = request.content["number"], request.content["steps"]
        loop = ctypes.addressof(self._loop)
        return int(self._replay(loop, number, rows.ctypes.data, count)), b""


CALLS = frozenset(
    {
        *("initialise", "enter_initialization", "exit_initialization", "do_step", "terminate"),
        *("reset", "read", "write", "get", "set", "serialise", "deserialise", "free"),
    }
)


def port_map(facts: dict[str, Any]) -> PortMap:
    """Return a port map from what JSON made of it."""
    return PortMap(
        tuple(facts["variables"]),
        tuple(facts["scale"]),
        tuple(facts["offset"]),
        tuple(facts["units"]),
        facts["place"],
        tuple(facts["rates"]),
    )


def _facts(error: PosmasError) -> dict[str, Any]:
    facts: dict[str, Any] = {
        "kind": type(error).__name__,
        "message": error.message,
        "where": error.where,
    }
    if isinstance(error, FmuCallError):
        facts |= {"agent": error.agent, "time": error.time}
    return facts


class _Keep(logging.Handler):
    """Keeps warnings for the next answer."""

    def __init__(self, lines: list[str]) -> None:
        super().__init__(logging.WARNING)
        self._lines = lines

    def emit(self, record: logging.LogRecord) -> None:
        if len(self._lines) < 100:
            self._lines.append(record.getMessage())
