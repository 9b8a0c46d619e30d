"""An FMU unpacked and loaded once, for any number of instances."""

from __future__ import annotations

import ctypes
import os
import weakref
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from posmas_fmi.errors import ArchiveError, FmuCallError, FmuError
from posmas_fmi.fmu.about import About, Kind, read_description
from posmas_fmi.fmu.archive import is_file_name, unpack
from posmas_fmi.fmu.binding import Binding, Trace
from posmas_fmi.fmu.callbacks import Messages, PythonMessages, callbacks_for, said
from posmas_fmi.fmu.given import Forms, Given
from posmas_fmi.fmu.image import ImageError, read_image
from posmas_fmi.fmu.instance import FmuInstance
from posmas_fmi.fmu.live import KEYS, Frees, Live, release
from posmas_fmi.fmu.scratch import Scratch
from posmas_fmi.fmu.units import Conversion, Units
from posmas_fmi.fmu.variables import Ports, Variable


class FmuFile:
    """An FMU unpacked and loaded once, for any number of Co-Simulation instances.

    Parameters
    ----------
    path : path-like
        The .fmu file.
    messages : Messages, optional
        Where the messages of its instances go; kept by Python functions if left out.
    trace : callable, optional
        Called with the name before each call into the binary; see `Binding`.
    unpacked : Path, optional
        Where somebody has unpacked the archive already, who removes it again.
    structure : mapping of str to int, optional
        Structural parameters: set in Configuration Mode before all else, in every instance.

    Attributes
    ----------
    path : Path
    about : About
        What the file says about itself.
    version : {1, 2, 3}
        FMI version.
    token : str
        GUID or instantiationToken.
    description : fmpy ModelDescription
        All that the file says about itself.
    variables : mapping of str to Variable
        By name.
    folder : Path
        Where the file is unpacked.
    library : Path
        The shared library that was loaded.

    Raises
    ------
    ArchiveError
        If the file cannot be unpacked or its description not be read.
    FmuError
        If it has no Co-Simulation interface of FMI 2 or 3, or no binary that loads here.

    Notes
    -----
    Use as a context manager or call `close`, which frees the instances that are left, the library
    and the temporary folder. What is forgotten is released when the object is collected.
    """

    kind: Kind = "Co-Simulation"
    events = False  # whether its instances use Event Mode and may return early
    _logs = False  # whether instances are asked to log more than errors

    def __init__(
        self,
        path: str | Path,
        messages: Messages | None = None,
        trace: Trace | None = None,
        unpacked: Path | None = None,
        structure: Mapping[str, int] | None = None,
    ) -> None:
        self.path = Path(path)
        self._structure = dict(structure or {})
        self._trace = trace
        folder = None
        try:
            if unpacked is None:
                folder = Scratch()
                unpacked = folder.folder
                unpack(self.path, unpacked)
            self._open(unpacked)
        except BaseException:
            if folder is not None:
                folder.cleanup()
            raise
        self._messages = messages or PythonMessages()
        self._live: dict[int, Live] = {}
        self._known_ports: dict[tuple[str, ...], Ports] = {}
        self._close = weakref.finalize(
            self, release, self._live, self._frees, self._fmu.close, folder
        )

    def _open(self, folder: Path) -> None:
        where = str(self.path)
        about = About.of(self.path, read_description(folder, self.path), self.kind)
        self.about = about.structured(self._structure)
        self.about.require_interface()
        interface = self.about.interface
        if interface is None:
            raise FmuError(f"expected a {self.kind} interface (it has none)", where)
        self.version = self.about.version
        self.description = self.about.description
        self.token = str(self.description.guid or "")
        self.variables = self.about.variables
        self._variables = self.about.names
        self._forms = Forms(self._variables, self.version)
        self.folder = folder
        self._load(str(interface.modelIdentifier))

    def _binding(self) -> Any:
        """Return FMPy's class for the binary."""
        from fmpy.fmi2 import FMU2Slave
        from fmpy.fmi3 import FMU3Slave

        return FMU2Slave if self.version == 2 else FMU3Slave

    def _needed(self) -> list[str]:
        """Return the functions without which no run is possible."""
        steps = ["EnterInitializationMode", "ExitInitializationMode", "DoStep", "FreeInstance"]
        if self.version == 2:
            return [f"fmi2{name}" for name in ("Instantiate", "SetupExperiment", *steps)]
        return [f"fmi3{name}" for name in ("InstantiateCoSimulation", *steps)]

    def _load(self, identifier: str) -> None:
        import fmpy

        where = str(self.path)
        if not is_file_name(identifier):
            raise ArchiveError(f"the modelIdentifier {identifier!r} is no file name", where)
        binaries = fmpy.platform if self.version < 3 else fmpy.platform_tuple
        name = identifier + fmpy.sharedLibraryExtension
        self.library = self.folder / "binaries" / binaries / name
        if not self.library.is_file():
            there = sorted(path.parent.name for path in self.folder.glob("binaries/*/*"))
            has = ", ".join(dict.fromkeys(there)) or "none"
            raise FmuError(
                f"expected {name} among the binaries for {binaries} (the FMU has {has})", where
            )
        try:
            read_image(self.library.read_bytes())  # the loader crashes at one that is cut off
        except (ImageError, OSError) as error:
            raise FmuError(f"the binary cannot be loaded: {error}", where) from error
        self._bind(where)

    def _bind(self, where: str) -> None:
        """Load the library."""
        self._fmu = Binding(self.library, self._binding(), where, self._needed(), self._trace)
        self._functions = self._fmu.functions
        resources = self.folder / "resources"
        place = resources.as_uri() if self.version == 2 else f"{resources}{os.sep}"
        self._resources = place.encode()
        state = "FMUstate" if self.version == 2 else "FMUState"
        self._frees = Frees(
            self._functions[f"fmi{self.version}FreeInstance"],
            self._functions[f"fmi{self.version}Free{state}"],
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Free all instances, the library and the unpacked files; a second call does nothing."""
        self._close()

    @property
    def closed(self) -> bool:
        """Whether `close` was called."""
        return not self._close.alive

    def instantiate(self, name: str) -> FmuInstance:
        """Create an instance.

        Parameters
        ----------
        name : str
            Of the instance, as its messages and errors show it.

        Raises
        ------
        FmuCallError
            If the FMU refuses.
        """
        if self.closed:
            raise FmuError("the file is closed", str(self.path))
        self._check_only_once()
        key = next(KEYS)
        live = self._live[key] = Live(
            self._messages, callbacks_for(self.version, self._messages, key)
        )
        live.component = self._instantiate(name, key, live.callbacks) or 0
        if not live.component and not self._messages.of(key):
            self._logs = True  # asked once more, for the reason: many tell it only then
            live.component = self._instantiate(name, key, live.callbacks) or 0
            self._logs = False
        if not live.component:
            del self._live[key]
            raise FmuCallError(
                said("the FMU returned no instance", self._messages.of(key)),
                f"{self.path.name}: {name}: fmi{self.version}Instantiate",
                name,
            )
        instance = self._made(name, key)
        if self.about.structure:
            instance.configure(self.about.structure)
        return instance

    def _check_only_once(self) -> None:
        interface = self.about.interface
        if self._live and getattr(interface, "canBeInstantiatedOnlyOncePerProcess", False):
            raise FmuError(
                "it says that a process can have only one instance of it "
                "(canBeInstantiatedOnlyOncePerProcess), and there is one; run its instances in "
                "processes of their own",
                str(self.path),
            )

    def _made(self, name: str, key: int) -> FmuInstance:
        return FmuInstance(self, name, key)

    def _instantiate(self, name: str, key: int, callbacks: Any) -> int | None:
        text, token = name.encode(), self.token.encode()
        if self.version == 2:
            arguments: tuple[Any, ...] = (
                *(text, 1, token, self._resources),
                *(ctypes.byref(callbacks), 0, int(self._logs)),  # not visible
            )
            function = "fmi2Instantiate"
        else:
            from fmpy.fmi3 import fmi3IntermediateUpdateCallback

            arguments = (
                *(text, token, self._resources),
                *(False, self._logs),  # not visible
                *(self.events, self.events, None, 0),  # event mode, early return; no variables
                *(self._messages.environment(key), callbacks, fmi3IntermediateUpdateCallback()),
            )
            function = "fmi3InstantiateCoSimulation"
        component: int | None = self._functions[function](*arguments)
        return component

    def address(self, function: str) -> int:
        """Address of a function of the binary, for callers that are not Python.

        Raises
        ------
        FmuError
            If the binary has no such function.
        """
        try:
            symbol = getattr(self._fmu.dll, function)
        except AttributeError:
            raise FmuError(f"the binary has no function {function}", str(self.path)) from None
        return int(ctypes.cast(symbol, ctypes.c_void_p).value or 0)

    def variable(self, name: str) -> Variable:
        """Return the variable of that name, or the array that has that element (``u[1]``).

        Raises
        ------
        FmuError
            If there is none; the message names the nearest one.
        """
        return self.about.variable(name)

    @property
    def in_python(self) -> bool:
        """Whether steps need more than one call, which C loops leave to `FmuInstance.do_step`."""
        return False

    @property
    def units(self) -> Units:
        """The units that the file defines."""
        return self.about.units

    def conversion(self, name: str, unit: str) -> Conversion:
        """Return how a value in that unit becomes one of the variable of that name.

        Raises
        ------
        FmuError
            If there is no such variable.
        InputError
            If the units do not fit; see `posmas_fmi.fmu.units.Units.conversion`.
        """
        return self.about.conversion(name, unit)

    def given(self, values: Mapping[str, Any]) -> Given:
        """Resolve values by name for `FmuInstance.set`; see `Forms.given`."""
        return self._forms.given(values)

    def ports(self, names: Iterable[str]) -> Ports:
        """Resolve names for `FmuInstance.read` and `write`; see `Variables.ports`."""
        key = tuple(names)
        if key not in self._known_ports:
            self._known_ports[key] = self.about.ports(key)
        return self._known_ports[key]
