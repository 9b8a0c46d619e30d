"""FMU instances whose calls go through Python, as the C loops see them.

The C loops call Get, Set and DoStep with the signatures of FMI 3. Here these three are Python
functions that serve any instance: the "component" is its key, and the one "value reference" is the
number of its ports. So the loops step what they cannot call themselves: ports that are no doubles,
Event Mode, and models that an integrator here takes through time.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

import numpy as np

from posmas_fmi.errors import FmuEndedError, FmuError
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.instance import FmuInstance
from posmas_fmi.fmu.variables import Ports

_int, _size, _bool, _double = ctypes.c_int, ctypes.c_size_t, ctypes.c_bool, ctypes.c_double
_key, _references = ctypes.c_void_p, ctypes.POINTER(ctypes.c_uint32)
_values, _flag = ctypes.POINTER(_double), ctypes.POINTER(_bool)
_Exchange = ctypes.CFUNCTYPE(_int, _key, _references, _size, _values, _size)
_Step = ctypes.CFUNCTYPE(_int, _key, _double, _double, _bool, _flag, _flag, _flag, _values)
_Rates = ctypes.CFUNCTYPE(_int, _key, _references, _size, ctypes.c_void_p, _values)
_OK, _ERROR = 0, 3


def needs_python(file: FmuFile, *ports: Ports) -> bool:
    """Whether the C loops cannot call an FMU with these ports themselves."""
    return file.in_python or not all(one.plain for one in ports)


class Served:
    """The three functions, and the instances and ports that they serve.

    Parameters
    ----------
    tell : callable, optional
        Gets the key of an instance and what its call raised: another process sees no errors.

    Attributes
    ----------
    get, set, do_step, set_rates : int
        Addresses of the functions.
    """

    def __init__(self, tell: Callable[[int, str], None] | None = None) -> None:
        self._instances: dict[int, FmuInstance] = {}
        self._ports: list[Ports] = []
        self._failures: dict[int, BaseException] = {}
        instances, failures, known = self._instances, self._failures, self._ports

        def guarded(key: int | None, call: Callable[[FmuInstance], None]) -> int:
            try:
                call(instances[key or 0])
            except BaseException as error:  # nothing can be raised through C
                failures[key or 0] = error
                if tell is not None and isinstance(error, FmuError):
                    tell(key or 0, error.message)
                return _ERROR
            return _OK

        def get(key: int | None, references: Any, _n: int, values: Any, size: int) -> int:
            def read(instance: FmuInstance) -> None:
                found = instance.read(known[references[0]])
                np.ctypeslib.as_array(values, (size,))[:] = found

            return guarded(key, read)

        def set_(key: int | None, references: Any, _n: int, values: Any, size: int) -> int:
            given = np.ctypeslib.as_array(values, (size,))
            return guarded(key, lambda instance: instance.write(known[references[0]], given))

        def do_step(
            key: int | None, time: float, step: float, _: bool, __: Any, ends: Any, *rest: Any
        ) -> int:
            def go(instance: FmuInstance) -> None:
                try:
                    instance.do_step(time, step)
                except FmuEndedError as end:
                    ends[0], rest[1][0] = True, end.time

            return guarded(key, go)

        def set_rates(key: int | None, references: Any, n: int, _: Any, values: Any) -> int:
            rates = np.ctypeslib.as_array(values, (n,))
            ports = known[references[0]]
            return guarded(key, lambda instance: instance.set_input_derivatives(ports, rates))

        self._functions = _Exchange(get), _Exchange(set_), _Step(do_step), _Rates(set_rates)
        self.get, self.set, self.do_step, self.set_rates = (
            int(ctypes.cast(function, ctypes.c_void_p).value or 0) for function in self._functions
        )

    def add(self, instance: FmuInstance) -> int:
        """Serve an instance from now on; return what the C loops take for its address."""
        self._instances[instance.key] = instance
        return instance.key

    def number(self, ports: Ports) -> int:
        """Return what stands for the ports."""
        self._ports.append(ports)
        return len(self._ports) - 1

    def failure(self, instance: FmuInstance) -> BaseException | None:
        """Return what its last call raised, once."""
        return self._failures.pop(instance.key, None)
