"""The variables of an FMU as its description tells them, and names resolved for the calls."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Iterable, Iterator, Mapping
from difflib import get_close_matches
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any

import attrs
import numpy as np

from posmas_fmi.errors import FmuError
from posmas_fmi.fmu.model import element_names

if TYPE_CHECKING:
    from posmas_fmi.expression import Array

REAL = frozenset({"Real", "Float64", "Float32"})
WHOLE = frozenset(
    {"Integer", "Boolean", "Enumeration"}
    | {f"{sign}Int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64)}
)
_DOUBLES = {1: "Real", 2: "Real", 3: "Float64"}
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
    lengths : tuple of (int or str)
        Of each dimension; a name is that of the structural parameter that says it.
    text : str or None
        Start value of a variable that is no number.
    initial : str
        ``exact``, ``approx``, ``calculated``, or nothing.
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
    lengths: tuple[int | str, ...] = ()
    text: str | None = None
    initial: str = ""

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
            lengths=tuple(
                d.variable.name if d.variable is not None else int(d.start)
                for d in source.dimensions or ()
            ),
            text=source.start if source.type == "String" else None,
            initial=source.initial or "",
        )

    def resized(self, structure: Mapping[str, int]) -> Variable:
        """Return it with the lengths that structural parameters of these values give it."""
        lengths = [
            structure.get(one, known) if isinstance(one, str) else known
            for one, known in zip(self.lengths, self.shape, strict=False)
        ]
        shape = tuple(lengths) if self.lengths else self.shape
        if shape == self.shape:
            return self
        return attrs.evolve(self, shape=shape, start=None)

    @property
    def size(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)


@attrs.frozen(eq=False)
class Group:
    """Variables of one type, exchanged in one call.

    Attributes
    ----------
    kind : str
        End of the function's name: ``Real``, ``Float64``, ``Int32``, ``Boolean``.
    dtype : numpy dtype
        Of the values in the call.
    references : ctypes array of unsigned int
        Value reference of each variable.
    size : int
        Number of values.
    """

    kind: str
    dtype: np.dtype[Any]
    references: ctypes.Array[ctypes.c_uint]
    size: int

    def encode(self, values: Array, where: str) -> np.ndarray[Any, Any]:
        """Return numbers as the call takes them: whole ones rounded, Booleans true from 0.5.

        Raises
        ------
        FmuError
            If one is not finite or out of range.
        """
        if self.dtype == float:
            return np.ascontiguousarray(values, dtype=float)
        if self.kind == "Float32":
            return np.ascontiguousarray(values, dtype=self.dtype)
        if not np.isfinite(values).all():
            raise FmuError(f"expected finite values for variables of type {self.kind}", where)
        if self.kind == "Boolean":
            return np.ascontiguousarray(values >= 0.5, dtype=self.dtype)
        rounded, limits = np.rint(values), np.iinfo(self.dtype)
        outside = (rounded < float(limits.min)) | (rounded > float(limits.max))
        if outside.any():
            raise FmuError(
                f"expected values of type {self.kind} from {limits.min} to {limits.max} "
                f"(got {rounded[outside][0]:g})",
                where,
            )
        return np.ascontiguousarray(rounded, dtype=self.dtype)


def kind_of(variable: Variable, version: int) -> tuple[str, np.dtype[Any]]:
    """Return by which function, and as which type, the values of a variable are exchanged."""
    kind = variable.type
    if kind == "Enumeration":
        kind = "Integer" if version < 3 else "Int64"
    if kind in ("Real", "Float64"):
        return kind, np.dtype(float)
    if version < 3:
        return kind, np.dtype(np.int32)
    return kind, np.dtype(bool if kind == "Boolean" else kind.lower())


@attrs.frozen(eq=False)
class Ports:
    """Names resolved once, to read or write many times.

    Attributes
    ----------
    names : tuple of str
        Variables or elements (``u[1]``) in the order of the values.
    groups : tuple of Group
        One call each; their values follow one another.
    size : int
        Number of values that the calls exchange.
    places : (n,) int array
        Where among those the named values stand.
    """

    names: tuple[str, ...]
    groups: tuple[Group, ...]
    size: int
    places: np.ndarray[Any, np.dtype[np.intp]]

    @cached_property
    def partial(self) -> bool:
        """Whether some elements of the variables touched are not named."""
        return len(set(self.places.tolist())) < self.size

    @property
    def plain(self) -> bool:
        """Whether all are doubles, which one call exchanges."""
        return all(group.dtype == float for group in self.groups)

    @property
    def references(self) -> ctypes.Array[ctypes.c_uint]:
        """Value references, where all are doubles.

        Raises
        ------
        FmuError
            If they are not: such ports are read and written by `FmuInstance.read` and `write`.
        """
        if not self.plain:
            raise FmuError(f"expected ports that are doubles (got {', '.join(self.names)})")
        (group,) = self.groups
        return group.references


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
    def structural(self) -> frozenset[str]:
        """Names of the structural parameters."""
        return frozenset(
            name for name, one in self.by_name.items() if one.causality == "structuralParameter"
        )

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

    def ports(self, names: Iterable[str], version: int) -> Ports:
        """Resolve names of variables that are numbers, or of elements of arrays (``u[1]``).

        An array's name stands for all of its elements. Integers, Booleans (0 and 1) and
        enumerations are numbers as well.

        Raises
        ------
        FmuError
            If there is no such variable, or it is no number.
        """
        asked = [(name, *self.resolve(name)) for name in names]
        touched: dict[tuple[str, int], Variable] = {}  # by kind and reference
        for name, variable, _ in asked:
            if variable.type not in REAL | WHOLE:
                raise FmuError(
                    f"expected {name!r} to be a number (it is {variable.type})", self.where
                )
            touched.setdefault((kind_of(variable, version)[0], variable.reference), variable)
        first: dict[tuple[str, int], int] = {}  # place of its first value
        groups: list[Group] = []
        size = 0
        for kind, dtype in dict.fromkeys(kind_of(v, version) for v in touched.values()):
            members = [(key, v) for key, v in touched.items() if key[0] == kind]
            begin = size
            for key, variable in members:
                first[key] = size
                size += variable.size
            references = (ctypes.c_uint * len(members))(*(v.reference for _, v in members))
            groups.append(Group(kind, dtype, references, size - begin))
        resolved: list[str] = []
        places: list[int] = []
        for name, variable, index in asked:
            start = first[kind_of(variable, version)[0], variable.reference]
            if index is None:
                resolved += element_names(variable.name, variable.shape)
                places += range(start, start + variable.size)
            else:
                resolved.append(name)
                places.append(start + index)
        if not groups:  # nothing, as doubles
            groups.append(Group(_DOUBLES[version], np.dtype(float), (ctypes.c_uint * 0)(), 0))
        return Ports(tuple(resolved), tuple(groups), size, np.array(places, dtype=np.intp))


def pointer(values: np.ndarray[Any, Any]) -> Any:
    """Return values, which stand in one piece, as the FMI functions take them."""
    if not values.flags.writeable:
        values = values.copy()
    # three times as fast as `values.ctypes.data_as`
    return _array_type(values.dtype, values.size).from_buffer(values)


@cache
def _array_type(dtype: np.dtype[Any], size: int) -> Any:
    return np.ctypeslib.as_ctypes_type(dtype) * size
