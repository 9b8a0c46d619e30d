"""The C functions of an FMU's binary: what it does not have fails when it is called, not before."""

from __future__ import annotations

import ctypes
import inspect
import os
import types
import typing
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from posmas_fmi.errors import FmuError

# told the name before each call; what it returns, if anything, is told the result after it
Trace = Callable[[str], Callable[[Any], None] | None]


class Binding:
    """A loaded binary and its functions, with the signatures that FMPy knows.

    Parameters
    ----------
    library : Path
        The shared library; its folder is the working directory while it loads, because some
        binaries look there for others.
    api : type
        FMPy's class for the interface, such as `fmpy.fmi2.FMU2Slave`: only its methods'
        signatures are used.
    where : str
        The FMU, for errors.
    needed : sequence of str, optional
        Functions without which the binary is of no use.
    trace : callable, optional
        Called with the name before each call, so that a crash can be told by its last call; a
        function that it returns is called with the result.

    symbol : callable, optional
        Name of a function in the binary, where that is another one.

    Attributes
    ----------
    functions : dict of str to callable
        One for each function of the standard; a function that the binary does not have raises
        `FmuError` when it is called. Real binaries often lack optional ones.
    missing : tuple of str

    Raises
    ------
    FmuError
        If the library cannot be loaded, or a needed function is not there.
    """

    def __init__(
        self,
        library: Path,
        api: type,
        where: str,
        needed: Sequence[str] = (),
        trace: Trace | None = None,
        symbol: Callable[[str], str] = str,
    ) -> None:
        done = None if trace is None else trace("dlopen")
        before = os.getcwd()
        os.chdir(library.parent)
        try:
            self.dll = ctypes.CDLL(str(library))
        except OSError as error:
            raise FmuError(f"the binary cannot be loaded: {error}", where) from error
        finally:
            os.chdir(before)
        if done is not None:
            done(None)
        self.functions: dict[str, Callable[..., Any]] = {}
        missing: list[str] = []
        for name, argument_types, result in _signatures(api):
            try:
                function = getattr(self.dll, symbol(name))
            except AttributeError:
                missing.append(name)
                self.functions[name] = _absent(name, where)
                continue
            function.argtypes = argument_types
            function.restype = result
            self.functions[name] = function if trace is None else _traced(name, function, trace)
        self.missing = tuple(missing)
        lacking = [name for name in needed if name in missing]
        if lacking:
            self.close()
            raise FmuError(f"the binary has no function {', '.join(lacking)}", where)

    def close(self) -> None:
        """Unload the library."""
        from fmpy import freeLibrary

        freeLibrary(self.dll._handle)


@lru_cache
def _signatures(api: type) -> tuple[tuple[str, list[Any], Any], ...]:
    """Return name, argument types and result type of each function, from annotations."""
    found = []
    for name, method in inspect.getmembers(api, inspect.isfunction):
        if not name.startswith("fmi"):
            continue
        signature = inspect.signature(method)
        arguments = [
            typing.get_args(p.annotation)[0]
            if isinstance(p.annotation, types.UnionType)
            else p.annotation
            for p in list(signature.parameters.values())[1:]  # without self
        ]
        result = {bytes: ctypes.c_char_p, int: ctypes.c_int}.get(
            signature.return_annotation, signature.return_annotation
        )
        found.append((name, arguments, result))
    return tuple(found)


def _absent(name: str, where: str) -> Callable[..., Any]:
    def absent(*_: object) -> Any:
        raise FmuError(f"the binary has no function {name}", where)

    return absent


def _traced(name: str, function: Callable[..., Any], trace: Trace) -> Callable[..., Any]:
    def traced(*arguments: object) -> Any:
        done = trace(name)
        result = function(*arguments)
        if done is not None:
            done(result)
        return result

    return traced
