"""FMU files and instances that live in worker processes, used like those in this process."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from posmas_fmi import resources
from posmas_fmi.cosim.worker.process import WorkerLost, WorkerProcess, lost_error
from posmas_fmi.errors import FmuError
from posmas_fmi.expression import Array
from posmas_fmi.fmu.about import read_about
from posmas_fmi.fmu.build import cache_folder
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.instance import FmuInstance
from posmas_fmi.fmu.state import FmuState
from posmas_fmi.fmu.variables import Ports

Place = Callable[["RemoteFile", bool], WorkerProcess]


def built_here(path: Path) -> bool:
    """Whether this installation has built the file: its bytes are those of one that it keeps.

    What a file says about its origin does not count.
    """
    size, own = path.stat().st_size, None
    for folder in (resources.prebuilt(), cache_folder()):
        for kept in folder.glob("*.fmu"):
            if kept.stat().st_size != size:
                continue
            own = own or _hash(path)
            if _hash(kept) == own:
                return True
    return False


def _hash(path: Path) -> bytes:
    return hashlib.sha256(path.read_bytes()).digest()


class RemoteFile(FmuFile):
    """An FMU that is unpacked and described here, and loaded in worker processes only.

    Parameters
    ----------
    path : path-like
    place : callable
        Gives the worker process that the next instance of a file goes to.
    structure : mapping of str to int, optional
        Structural parameters.
    """

    def __init__(
        self, path: str | Path, place: Place, structure: Mapping[str, int] | None = None
    ) -> None:
        self._place = place
        self.kind = read_about(Path(path)).kind
        super().__init__(path, structure=structure)

    def _bind(self, where: str) -> None:
        self._fmu: Any = _NotLoaded()
        self._functions = {}
        self._frees: Any = None

    @property
    def only_once(self) -> bool:
        """Whether a process may hold one instance only."""
        return bool(self.about.interface.canBeInstantiatedOnlyOncePerProcess)

    @property
    def saves(self) -> bool:
        """Whether it says that its state can be taken out as bytes."""
        interface = self.about.interface
        return bool(interface.canGetAndSetFMUstate and interface.canSerializeFMUstate)

    def instantiate(self, name: str) -> RemoteInstance:
        """Create an instance in a worker process."""
        instance = self.prepare(name)
        instance.make(instance.worker)
        return instance

    def prepare(self, name: str, alone: bool = False) -> RemoteInstance:
        """Return an instance that is to be made in its worker process: see `make`."""
        if self.closed:
            raise FmuError("the file is closed", str(self.path))
        return RemoteInstance(self, name, self._place(self, alone))

    def address(self, function: str) -> int:
        """Return 0: there is nothing here to be called."""
        return 0


class _NotLoaded:
    def close(self) -> None:
        """Nothing to unload."""


class RemoteInstance(FmuInstance):
    """An instance in a worker process; made by `RemoteFile.instantiate` or `prepare`.

    Attributes
    ----------
    worker : WorkerProcess
    start : tuple or None
        Arguments of `initialise`, from which the instance can be made again.
    """

    def __init__(self, file: RemoteFile, name: str, worker: WorkerProcess) -> None:
        self.file: RemoteFile = file
        self.name = name
        self.time = 0.0
        self.component = 0
        self._prefix = f"fmi{file.version}"
        self._real = "Real" if file.version < 3 else "Float64"
        self.start: tuple[dict[str, Any], float, float | None, float | None] | None = None
        self.worker, self._freed = worker, True

    def make(self, worker: WorkerProcess) -> None:
        """Be a fresh instance in that worker process."""
        self.worker = worker
        worker.leftover.instances[self.name] = self.file.path.name
        path = str(self.file.path.absolute())  # the worker is in another folder
        with _Lost(self):
            worker.load(path, str(self.file.folder), self.file.about.structure)
            self.key, _ = worker.request({"do": "instantiate", "path": path, "name": self.name})
        self._freed = False

    def free(self) -> None:
        """Free the instance; a second call does nothing."""
        if self._freed:
            return
        self._freed = True
        if self.worker.alive:
            try:
                self._ask("free")
            except FmuError:
                self.worker.kill()  # nothing more is wanted from it

    @property
    def messages(self) -> tuple[str, ...]:
        """What the instance logged, the last few lines."""
        return tuple(self.worker.messages.since(self.key, 0))

    def _ask(self, method: str, data: bytes = b"", /, **arguments: Any) -> tuple[Any, bytes]:
        content = {"do": "call", "key": self.key, "method": method, "arguments": arguments}
        with _Lost(self):
            return self.worker.request(content, data)

    # ---- the methods of FmuInstance, over there -------------------------------------------------

    def initialise(
        self,
        values: Mapping[str, ArrayLike] | None = None,
        *,
        start: float = 0.0,
        stop: float | None = None,
        tolerance: float | None = None,
    ) -> None:
        """Set start values and inputs and go through initialisation."""
        plain = _plain(values or {})
        self.start = (plain, start, stop, tolerance)
        self._ask("initialise", values=plain, start=start, stop=stop, tolerance=tolerance)
        self.time = start

    def enter_initialization(
        self, *, start: float = 0.0, stop: float | None = None, tolerance: float | None = None
    ) -> None:
        """Tell the experiment and enter Initialization Mode."""
        self._ask("enter_initialization", start=start, stop=stop, tolerance=tolerance)
        self.time = start

    def exit_initialization(self) -> None:
        """Leave Initialization Mode."""
        self._ask("exit_initialization")

    def do_step(self, time: float, step: float) -> None:
        """Advance from `time` by `step` [s]."""
        self._ask("do_step", time=time, step=step)
        self.time = time + step

    def terminate(self) -> None:
        """End the simulation; values may still be read."""
        self._ask("terminate")

    def reset(self) -> None:
        """Go back to the state after instantiation."""
        self._ask("reset")
        self.time = 0.0

    def read(self, ports: Ports) -> Array:
        """Return the values at the ports, in the order of their names."""
        values, _ = self._ask("read", ports=list(ports.names))
        return np.array(values, dtype=float)

    def write(self, ports: Ports, values: ArrayLike) -> None:
        """Set the values at the ports, in the order of their names."""
        given = np.asarray(values, dtype=float).reshape(-1).tolist()
        self._ask("write", ports=list(ports.names), values=given)

    def get(self, name: str) -> Any:
        """Return a value by name."""
        value, _ = self._ask("get", name=name)
        return np.array(value) if isinstance(value, list) else value

    def set(self, values: Mapping[str, ArrayLike]) -> None:
        """Set values by name."""
        self._ask("set", values=_plain(values))

    def serialise(self) -> bytes:
        """Return the whole state as bytes."""
        self.time, data = self._ask("serialise")
        return data

    def deserialise(self, data: bytes, time: float) -> None:
        """Go to a serialised state."""
        self._ask("deserialise", data, time=time)
        self.time = time

    def keep(self) -> None:
        """Let the worker keep the state, in place of the one that it kept before."""
        with _Lost(self):
            self.worker.request({"do": "keep", "key": self.key})

    def go_back(self, time: float) -> None:
        """Go back to the state that the worker keeps, of that time [s]."""
        with _Lost(self):
            self.worker.request({"do": "go_back", "key": self.key})
        self.time = time

    def get_state(self) -> FmuState:
        """Not possible across processes; see `serialise`."""
        raise self.error(f"Get{self._state_name}", _BYTES_ONLY)

    def set_state(self, state: FmuState) -> None:
        """Not possible across processes; see `deserialise`."""
        raise self.error(f"Set{self._state_name}", _BYTES_ONLY)

    def directional_derivative(
        self, unknowns: Iterable[str], knowns: Iterable[str], seed: ArrayLike
    ) -> Array:
        """Not needed while stepping."""
        raise self.error("GetDirectionalDerivative", "is not asked across processes")

    @property
    def _state_name(self) -> str:
        return "FMUstate" if self.file.version == 2 else "FMUState"


_BYTES_ONLY = "the state of an instance in another process can be taken as bytes only"


class _Lost:
    """Turns the end of a worker into an error about the instance."""

    def __init__(self, instance: RemoteInstance) -> None:
        self._instance = instance

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        if isinstance(error, WorkerLost):
            self._raise(error)

    def _raise(self, error: WorkerLost) -> NoReturn:
        instance, death = self._instance, error.death
        raise lost_error(
            death, instance.file.path.name, instance.name, death.call, instance.time
        ) from None


def _plain(values: Mapping[str, ArrayLike]) -> dict[str, Any]:
    """Return values as JSON can hold them."""
    return {name: np.asarray(value).tolist() for name, value in values.items()}
