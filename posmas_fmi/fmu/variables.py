"""The variables of an FMU as its description tells them, and names resolved for the calls."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Iterable, Iterator, Mapping
from difflib import get_close_matches
from functools import cached_property
from typing import Any

import attrs
import numpy as np

from posmas_fmi.errors import FmuError
from posmas_fmi.expression import Array
from posmas_fmi.fmu.model import element_names

REAL = frozenset({"Real", "Float64"})
WHOLE = frozenset(
    {"Integer", "Boolean", "Enumeration"}
    | {f"{sign}Int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64)}
)
_LARGEST_NAMED = 100_000  # elements of an array that can be called by name


@attrs.frozen
class Variable:
    """A variable of an FMU's model description.

    Attributes
    ----------
    name, type, causality, variability, description : str
        As in the model description; `type` is ``Real`` in FMI 2 and ``Float64`` in FMI 3.
    reference : int
        Value reference.
    shape : tuple of int
        ``()`` for a scalar.
    start : tuple of float or None
        Row-major; None where there is none, or not a number.
    unit : str or None
    nominal : float
    relative : bool
        Whether it is a difference (``relativeQuantity``).
    """

    name: str
    type: str
    causality: str
    variability: str
    reference: int
    shape: tuple[int, ...] = ()
    start: tuple[float, ...] | None = None
    unit: str | None = None
    nominal: float = 1.0
    description: str = ""
    relative: bool = False

    @classmethod
    def read(cls, source: Any) -> Variable:
        """Take over a variable of an FMPy model description."""
        start: tuple[float, ...] | None = None
        if source.start is not None and source.type in REAL | WHOLE:
            words = str(source.start).split()
            start = tuple(float({"true": "1", "false": "0"}.get(w, w)) for w in words)
        return cls(
            name=source.name,
            type=source.type,
            causality=source.causality,
            variability=source.variability or "",
            reference=source.valueReference,
            shape=tuple(source.shape or ()),
            start=start,
            unit=source.unit or (source.declaredType.unit if source.declaredType else None),
            nominal=float(source.nominal) if source.nominal else 1.0,
            description=source.description or "",
            relative=source.relativeQuantity in (True, "true"),
        )

    @property
    def size(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)


@attrs.frozen(eq=False)
class Ports:
    """Names resolved once, to read or write many times.

    Attributes
    ----------
    names : tuple of str
        Variables or elements (``u[1]``) in the order of the values.
    references : ctypes array of unsigned int
        Value reference of each variable touched.
    size : int
        Number of values that a call exchanges.
    places : (n,) int array
        Where among those the named values stand.
    """

    names: tuple[str, ...]
    references: ctypes.Array[ctypes.c_uint]
    size: int
    places: np.ndarray[Any, np.dtype[np.intp]]

    @property
    def partial(self) -> bool:
        """Whether some elements of the variables touched are not named."""
        return len(set(self.places.tolist())) < self.size


@attrs.frozen(slots=False, eq=False)
class Variables:
    """All variables of an FMU, found by their name or by that of an element.

    Attributes
    ----------
    by_name : mapping of str to Variable
    where : str
        The FMU, for errors.
    """

    by_name: Mapping[str, Variable]
    where: str

    @cached_property
    def _elements(self) -> dict[str, tuple[Variable, int]]:
        return dict(self._named_elements())

    def _named_elements(self) -> Iterator[tuple[str, tuple[Variable, int]]]:
        for variable in self.by_name.values():
            if variable.shape and variable.size <= _LARGEST_NAMED:
                for k, name in enumerate(element_names(variable.name, variable.shape)):
                    yield name, (variable, k)

    def resolve(self, name: str) -> tuple[Variable, int | None]:
        """Return the variable of that name, and which element of it (None: all).

        Raises
        ------
        FmuError
            If there is none; the message names the nearest one.
        """
        if name in self.by_name:
            return self.by_name[name], None
        if name in self._elements:
            return self._elements[name]
        near = get_close_matches(name, [*self.by_name, *self._elements], 1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise FmuError(f"there is no variable {name!r}{hint}", self.where)

    def ports(self, names: Iterable[str]) -> Ports:
        """Resolve names of real variables or of elements of arrays (``u[1]``).

        An array's name stands for all of its elements.

        Raises
        ------
        FmuError
            If there is no such variable, or it is not real.
        """
        resolved: list[str] = []
        first: dict[int, int] = {}  # value reference -> place of its first value
        places: list[int] = []
        size = 0
        for name in names:
            variable, index = self.resolve(name)
            if variable.type not in REAL:
                raise FmuError(f"expected {name!r} to be real (it is {variable.type})", self.where)
            if variable.reference not in first:
                first[variable.reference] = size
                size += variable.size
            start = first[variable.reference]
            if index is None:
                resolved += element_names(variable.name, variable.shape)
                places += range(start, start + variable.size)
            else:
                resolved.append(name)
                places.append(start + index)
        references = (ctypes.c_uint * len(first))(*first)
        return Ports(tuple(resolved), references, size, np.array(places, dtype=np.intp))


def pointer(values: Array) -> Any:
    """Return values as the FMI functions take them; the array must outlive the call."""
    return values.ctypes.data_as(ctypes.POINTER(ctypes.c_double))
