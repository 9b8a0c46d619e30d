"""Units of FMU variables, converted exactly or refused.

What a unit of an FMU means is taken from the unit definitions of its model description. A name
that is not defined there is read in the notation that the FMI standard recommends (that of the
Modelica language, chapter "Unit Expressions"): ``kg/s``, ``W/(m2.K)``, ``kJ/(kg.K)``, ``L/min``.
What neither of them explains is refused.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from fractions import Fraction
from typing import Any, NoReturn

import attrs

from posmas_fmi.errors import InputError

BASES = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")


@attrs.frozen
class Unit:
    """A unit: value in SI base units = factor × value + offset.

    Attributes
    ----------
    name : str
    exponents : tuple of int
        Of `BASES`.
    factor, offset : Fraction
    """

    name: str
    exponents: tuple[int, ...]
    factor: Fraction = Fraction(1)
    offset: Fraction = Fraction(0)

    @property
    def dimension(self) -> str:
        """The dimension in base units, for messages.

        Examples
        --------
        >>> parse_unit("W/K").dimension
        'kg.m2.s-3.K-1'
        >>> parse_unit("%").dimension
        '1'
        """
        powers = [(base, e) for base, e in zip(BASES, self.exponents, strict=True) if e]
        return ".".join(base + (str(e) if e != 1 else "") for base, e in powers) or "1"


@attrs.frozen
class Conversion:
    """How the value at a port becomes that of the FMU: scale × value + offset."""

    scale: float = 1.0
    offset: float = 0.0


@attrs.frozen
class Units:
    """The units that an FMU defines.

    Attributes
    ----------
    defined : mapping of str to Unit
    """

    defined: Mapping[str, Unit]

    @classmethod
    def read(cls, description: Any) -> Units:
        """Take over the unit definitions of an FMPy model description.

        A unit without base units says nothing and is left out.
        """
        found = {}
        for unit in description.unitDefinitions or ():
            base = unit.baseUnit
            if base is None or not unit.name or not base.factor:
                continue
            found[unit.name] = Unit(
                unit.name,
                tuple(int(getattr(base, name) or 0) for name in BASES),
                _exact(base.factor),
                _exact(base.offset or 0.0),
            )
        return cls(found)

    def conversion(self, port: str, variable: str | None, *, relative: bool = False) -> Conversion:
        """Return how a value in the unit of a port becomes one in the unit of an FMU's variable.

        Parameters
        ----------
        port : str
            Unit that the user declared. Read in the recommended notation, else as the FMU
            defines it.
        variable : str or None
            Unit of the variable in the model description.
        relative : bool
            Whether the variable is a difference (``relativeQuantity``): offsets do not count.

        Raises
        ------
        InputError
            If the variable has no unit, a unit is not known, or the dimensions differ.

        Examples
        --------
        >>> units = Units({})
        >>> units.conversion("degC", "K")
        Conversion(scale=1.0, offset=273.15)
        >>> units.conversion("degC", "K", relative=True)
        Conversion(scale=1.0, offset=0.0)
        >>> units.conversion("L/min", "m3/s").scale == 1e-3 / 60
        True
        >>> units.conversion("L/min", "kg/s")
        Traceback (most recent call last):
        ...
        posmas_fmi.errors.InputError: L/min (m3.s-1) cannot be converted to kg/s (kg.s-1); ...
        """
        if variable is None:
            _refuse(f"the FMU does not say in which unit it is (the port has {port!r})")
        if port == variable:
            return Conversion()
        outer = _parsed(port) or self.defined.get(port)
        return _converted(outer, port, self.find(variable), variable, relative)

    def between(
        self, other: Units, source: str, variable: str, *, relative: bool = False
    ) -> Conversion:
        """Return how a value in a unit of another FMU becomes one in a unit of this one.

        Parameters
        ----------
        other : Units
            Those of the other FMU.
        source, variable : str
            Unit there, and unit here.
        relative : bool
            As for `conversion`.

        Raises
        ------
        InputError
            If a unit is not known, or the dimensions differ.
        """
        outer, inner = other.find(source), self.find(variable)
        if source == variable and outer == inner:
            return Conversion()
        return _converted(outer, source, inner, variable, relative)

    def find(self, name: str) -> Unit | None:
        """Return the unit of that name as the FMU defines it, else in the usual notation."""
        return self.defined.get(name) or _parsed(name)


def _converted(
    outer: Unit | None, port: str, inner: Unit | None, variable: str, relative: bool
) -> Conversion:
    for unit, name in ((outer, port), (inner, variable)):
        if unit is None:
            _refuse(f"the unit {name!r} is neither known nor defined by the FMU")
    assert outer is not None
    assert inner is not None
    if outer.exponents != inner.exponents:
        _refuse(f"{port} ({outer.dimension}) cannot be converted to {variable} ({inner.dimension})")
    scale = outer.factor / inner.factor
    offset = Fraction(0) if relative else (outer.offset - inner.offset) / inner.factor
    return Conversion(float(scale), float(offset))


def _refuse(what: str) -> NoReturn:
    raise InputError(f"{what}; leave the unit out and give scale and offset")


def _exact(value: float) -> Fraction:
    """Return the decimal fraction that was written, not its binary neighbour."""
    return Fraction(repr(float(value)))


# ---- the recommended notation -------------------------------------------------------------------

_PREFIXES = {
    "y": -24,
    "z": -21,
    "a": -18,
    "f": -15,
    "p": -12,
    "n": -9,
    "u": -6,
    "µ": -6,
    "m": -3,
    "c": -2,
    "d": -1,
    "da": 1,
    "h": 2,
    "k": 3,
    "M": 6,
    "G": 9,
    "T": 12,
    "P": 15,
    "E": 18,
}


def _si(factor: float | Fraction = 1, **powers: int) -> tuple[tuple[int, ...], Fraction]:
    exact = factor if isinstance(factor, Fraction) else _exact(factor)
    return tuple(powers.get(base, 0) for base in BASES), exact


# Symbols that take prefixes: exponents of the base units, and the factor to them.
_PREFIXED = {
    "m": _si(m=1),
    "g": _si(0.001, kg=1),
    "s": _si(s=1),
    "A": _si(A=1),
    "K": _si(K=1),
    "mol": _si(mol=1),
    "cd": _si(cd=1),
    "rad": _si(rad=1),
    "Hz": _si(s=-1),
    "N": _si(kg=1, m=1, s=-2),
    "Pa": _si(kg=1, m=-1, s=-2),
    "J": _si(kg=1, m=2, s=-2),
    "W": _si(kg=1, m=2, s=-3),
    "C": _si(A=1, s=1),
    "V": _si(kg=1, m=2, s=-3, A=-1),
    "F": _si(kg=-1, m=-2, s=4, A=2),
    "Ohm": _si(kg=1, m=2, s=-3, A=-2),
    "S": _si(kg=-1, m=-2, s=3, A=2),
    "Wb": _si(kg=1, m=2, s=-2, A=-1),
    "T": _si(kg=1, s=-2, A=-1),
    "H": _si(kg=1, m=2, s=-2, A=-2),
    "l": _si(0.001, m=3),
    "L": _si(0.001, m=3),
    "bar": _si(1e5, kg=1, m=-1, s=-2),
    "Wh": _si(3600, kg=1, m=2, s=-2),
    "eV": _si(1.602176634e-19, kg=1, m=2, s=-2),
}
_PLAIN = {
    "min": _si(60, s=1),
    "h": _si(3600, s=1),
    "d": _si(86400, s=1),
    "t": _si(1000, kg=1),
    "atm": _si(101325, kg=1, m=-1, s=-2),
    "psi": _si(_exact(0.45359237) * _exact(9.80665) / _exact(0.0254) ** 2, kg=1, m=-1, s=-2),
    "deg": _si(math.pi / 180, rad=1),
    "rev": _si(2 * math.pi, rad=1),
    "rpm": _si(2 * math.pi / 60, rad=1, s=-1),
    "%": _si(0.01),
    "ppm": _si(1e-6),
    "1": _si(),
    "degC": _si(K=1),
    "degF": _si(Fraction(5, 9), K=1),
}
_PLAIN["°C"], _PLAIN["°F"], _PLAIN["°"] = _PLAIN["degC"], _PLAIN["degF"], _PLAIN["deg"]
_ZERO = {
    "degC": _exact(273.15),
    "degF": _exact(459.67) * Fraction(5, 9),
}  # of the scale [K]; only where the unit stands alone: in W/degC it is a difference
_ZERO["°C"], _ZERO["°F"] = _ZERO["degC"], _ZERO["degF"]

_POWER = re.compile(r"(.*?[^0-9+-])([+-]?[1-9][0-9]?)?")


def parse_unit(text: str) -> Unit:
    """Read a unit in the notation of the Modelica language.

    Parameters
    ----------
    text : str
        Factors joined by ``.``, at most one ``/`` with factors in brackets after it.

    Raises
    ------
    InputError
        If it is not in that notation, or a symbol is unknown.

    Examples
    --------
    >>> unit = parse_unit("kJ/(kg.K)")
    >>> unit.dimension, float(unit.factor)
    ('m2.s-2.K-1', 1000.0)
    >>> float(parse_unit("degC").offset)
    273.15
    """
    above, _, below = text.partition("/")
    if below.startswith("(") and below.endswith(")"):
        below = below[1:-1]
    elif "." in below:
        _unreadable(text)
    exponents, factor = [0] * len(BASES), Fraction(1)
    for part, sign in ((above, 1), (below, -1)):
        for symbol in part.split(".") if part or sign == 1 or "/" in text else ():
            found, power = _factor(symbol, text)
            exponents = [a + sign * power * b for a, b in zip(exponents, found[0], strict=True)]
            factor *= found[1] ** (sign * power)
    return Unit(text, tuple(exponents), factor, _ZERO.get(text, Fraction(0)))


def _factor(symbol: str, text: str) -> tuple[tuple[tuple[int, ...], Fraction], int]:
    if symbol == "1":
        return _PLAIN["1"], 1
    match = _POWER.fullmatch(symbol)
    if match is None:
        _unreadable(text)
    name, power = match[1], int(match[2] or 1)
    for table in (_PLAIN, _PREFIXED):
        if name in table:
            return table[name], power
    for length in (1, 2):
        prefix, rest = name[:length], name[length:]
        if prefix in _PREFIXES and rest in _PREFIXED:
            exponents, factor = _PREFIXED[rest]
            return (exponents, factor * Fraction(10) ** _PREFIXES[prefix]), power
    return _unreadable(text)


def _unreadable(text: str) -> NoReturn:
    raise InputError(f"expected a unit like kg/s, W/(m2.K), L/min, degC or % (got {text!r})")


def _parsed(text: str) -> Unit | None:
    try:
        return parse_unit(text)
    except InputError:
        return None
