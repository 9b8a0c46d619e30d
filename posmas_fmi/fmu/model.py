"""What an FMU is made from: its variables, its experiment and its own C code."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from typing import Literal, get_args

import attrs

from posmas_fmi.errors import BuildError

Role = Literal["parameter", "input", "state", "memory", "derivative", "output", "local"]
ROLES: tuple[Role, ...] = get_args(Role)


@attrs.frozen
class Variable:
    """A real variable, scalar or array.

    Attributes
    ----------
    name : str
        As importers see it.
    role : {"parameter", "input", "state", "memory", "derivative", "output", "local"}
        Parameters are tunable; the derivative of a state is added by `FmuModel`. Memory is what a
        sampled model keeps besides its states and computes itself, from the start on.
    shape : tuple of int
        ``()`` for a scalar. Arrays are one variable in FMI 3 and one per element in FMI 2.
    start : tuple of float
        Row-major start values of a parameter, input or state; empty for what is computed.
    unit : str
        As `posmas_fmi.fmu.units.parse_unit` reads it: ``K``, ``kPa``, ``L/min``, ``W/(m2.K)``.
    description : str
        One line.
    nominal : float
        Typical size of a state.
    depends : tuple of str or None
        Inputs and states (names of variables) on which an output, local or derivative depends;
        None for all of them.
    """

    name: str
    role: Role
    shape: tuple[int, ...] = ()
    start: tuple[float, ...] = ()
    unit: str = "1"
    description: str = ""
    nominal: float = 1.0
    depends: tuple[str, ...] | None = None

    def __attrs_post_init__(self) -> None:
        if self.role not in ROLES:
            raise BuildError(f"expected one of {', '.join(ROLES)} (got {self.role!r})", self.name)
        if not isinstance(self.unit, str):
            raise BuildError(f"expected a unit as text (got {self.unit!r})", self.name)
        if self.needs_start and len(self.start) != self.size:
            raise BuildError(f"expected {self.size} start values (got {self.start})", self.name)
        if not self.needs_start and self.start:
            raise BuildError(f"{self.role} is computed and has no start value", self.name)
        if not all(math.isfinite(value) for value in self.start):
            raise BuildError(f"start values must be finite (got {self.start})", self.name)
        if not (math.isfinite(self.nominal) and self.nominal > 0):
            raise BuildError(f"nominal must be > 0 (got {self.nominal!r})", self.name)

    @property
    def needs_start(self) -> bool:
        """Whether the value is given (rather than computed)."""
        return self.role in ("parameter", "input", "state")

    @property
    def size(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)

    @property
    def elements(self) -> tuple[str, ...]:
        """Names of the elements, row-major: ``A[1,1]``, ``A[1,2]``, …; the name of a scalar."""
        return tuple(element_names(self.name, self.shape))


def element_names(name: str, shape: tuple[int, ...]) -> Iterator[str]:
    """Names of the elements of an array, row-major, counted from 1.

    Examples
    --------
    >>> list(element_names("A", (2, 2)))
    ['A[1,1]', 'A[1,2]', 'A[2,1]', 'A[2,2]']
    >>> list(element_names("der(x)", (2,)))
    ['der(x[1])', 'der(x[2])']
    """
    inner = re.fullmatch(r"der\((.*)\)", name)
    pattern = "der({}[{}])" if inner else "{}[{}]"
    base = inner.group(1) if inner else name
    if not shape:
        yield name
        return
    for flat in range(math.prod(shape)):
        rest = flat
        index: list[int] = []
        for length in reversed(shape):
            index.insert(0, rest % length + 1)
            rest //= length
        yield pattern.format(base, ",".join(map(str, index)))


@attrs.frozen
class Experiment:
    """The default experiment of an FMU: stop time, communication step [s], relative tolerance."""

    stop: float = attrs.field(default=10.0, converter=float)
    step: float = attrs.field(default=0.01, converter=float)
    tolerance: float = attrs.field(default=1e-10, converter=float)


@attrs.frozen
class FmuModel:
    """Everything that one FMU is generated from.

    Parameters
    ----------
    name : str
        C identifier; the modelIdentifier.
    description : str
        One line.
    variables : tuple of Variable
        Without time and derivatives, which are added.
    code : mapping of str to str
        The model's own C files by name; they define the functions of ``model.h``.
    experiment : Experiment
    period : float, optional
        [s] Of a sampled model: its states change at communication points only, which are one
        period apart, and it has Co-Simulation only. Left out: the states have derivatives.

    Attributes
    ----------
    table : tuple of Variable
        All variables but time in the order of their values: parameters, inputs, states, memory,
        derivatives, outputs and locals.

    Raises
    ------
    BuildError
        If the name is no C identifier, a variable name occurs twice, or the roles of variables do
        not fit the kind of the model.
    """

    name: str
    description: str
    variables: tuple[Variable, ...]
    code: Mapping[str, str]
    experiment: Experiment = Experiment()
    period: float | None = None
    table: tuple[Variable, ...] = attrs.field(init=False)

    @table.default
    def _table(self) -> tuple[Variable, ...]:
        states = [v for v in self.variables if v.role == "state"]
        derivatives = [
            Variable(
                f"der({v.name})",
                "derivative",
                v.shape,
                unit=_per_second(v.unit),
                description=f"Derivative of {v.name}",
            )
            for v in (() if self.sampled else states)
        ]
        first = [v for role in ROLES[:4] for v in self.variables if v.role == role]
        computed = [v for v in self.variables if v.role in ("output", "local")]
        return (*first, *derivatives, *computed)

    def __attrs_post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]{0,63}", self.name):
            raise BuildError(f"expected a C identifier as the model's name (got {self.name!r})")
        if self.period is not None and not (math.isfinite(self.period) and self.period > 0):
            raise BuildError(f"expected a period > 0 s (got {self.period!r})", self.name)
        if not self.sampled and self.count("memory"):
            raise BuildError("only a sampled model has memory: it needs a period", self.name)
        names = ["time", *(name for v in self.table for name in v.elements)]
        twice = {name for name in names if names.count(name) > 1}
        if twice:
            raise BuildError(f"variable names occur twice: {', '.join(sorted(twice))}", self.name)
        known = {v.name for v in self.table if v.role in ("input", "state")}
        for variable in self.table:
            unknown = set(variable.depends or ()) - known
            if unknown:
                raise BuildError(
                    f"depends on {', '.join(sorted(unknown))}, not an input or state", variable.name
                )

    @property
    def sampled(self) -> bool:
        """Whether the states change at communication points only."""
        return self.period is not None

    def count(self, *roles: Role) -> int:
        """Return the number of values of these roles."""
        return sum(v.size for v in self.table if v.role in roles)

    def references(self) -> dict[str, int]:
        """Value reference of each variable: the place of its first element; 0 is time."""
        places, at = {}, 1
        for variable in self.table:
            places[variable.name] = at
            at += variable.size
        return places


def _per_second(unit: str) -> str:
    """Return the unit of a rate; a unit has one stroke at most.

    Examples
    --------
    >>> [_per_second(unit) for unit in ("1", "K", "m3/h", "J/(kg.K)")]
    ['1/s', 'K/s', 'm3/(h.s)', 'J/(kg.K.s)']
    """
    above, stroke, below = unit.partition("/")
    return f"{above}/({below.strip('()')}.s)" if stroke else f"{above}/s"
