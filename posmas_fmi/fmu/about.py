"""What an FMU says about itself, read without loading its binary."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

import attrs
import numpy as np

from posmas_fmi.errors import ArchiveError, FmuError, InputError
from posmas_fmi.fmu.archive import DESCRIPTION, examine, read_entry
from posmas_fmi.fmu.clocks import Clock, read_clocks
from posmas_fmi.fmu.tolerant import mended
from posmas_fmi.fmu.units import Conversion, Units
from posmas_fmi.fmu.variables import Ports, Variable, Variables

_NEGATED, _BOOLEANS = "negatedAlias", ("true", "false", "1", "0")
Kind = Literal["Co-Simulation", "Model Exchange"]


@attrs.frozen(eq=False, slots=False)
class About:
    """What an FMU says about itself.

    Attributes
    ----------
    path : Path
    version : {1, 2, 3}
        FMI version.
    description : fmpy ModelDescription
        All of it.
    kind : {"Co-Simulation", "Model Exchange"}
        How it is run; Co-Simulation where it offers both.
    names : Variables
    structure : mapping of str to int
        Structural parameters that are not as the file says, by name.
    """

    path: Path
    version: Literal[1, 2, 3]
    description: Any
    kind: Kind
    names: Variables
    structure: Mapping[str, int] = attrs.field(factory=dict)

    @classmethod
    def of(cls, path: Path, description: Any, kind: Kind | None = None) -> About:
        """Take over FMPy's model description of the file `path`.

        Raises
        ------
        FmuError
            If it is not of FMI 1.0, 2.0 or 3, or a variable cannot be read.
        """
        where, told = str(path), description.fmiVersion
        if told not in ("1.0", "2.0") and not told.startswith("3."):
            raise FmuError(f"expected FMI 1.0, 2.0 or 3.0 (got {told})", where)
        if kind is None:
            kind = "Co-Simulation" if description.coSimulation else "Model Exchange"
        try:
            variables = {v.name: v for v in map(Variable.read, description.modelVariables)}
        except (ValueError, TypeError) as error:
            raise ArchiveError(f"cannot read the variables: {error}", where) from error
        version: Literal[1, 2, 3] = 1 if told == "1.0" else 2 if told == "2.0" else 3
        return cls(path, version, description, kind, Variables(variables, where))

    def structured(self, values: Mapping[str, Any]) -> About:
        """Return what it says with the structural parameters among these values: other shapes.

        Raises
        ------
        InputError
            If one is no whole number >= 0.
        """
        given = {name: value for name, value in values.items() if name in self.structural}
        if not given:
            return self
        for name, value in given.items():
            if isinstance(value, str) or np.ndim(value) or value < 0 or value != int(value):
                raise InputError(
                    f"{self.path.name}: expected a whole number >= 0 for {name!r} (got {value!r})"
                )
        structure = {**self.structure, **{name: int(value) for name, value in given.items()}}
        named = {name: one.resized(structure) for name, one in self.variables.items()}
        return attrs.evolve(
            self, names=attrs.evolve(self.names, by_name=named), structure=structure
        )

    @property
    def structural(self) -> frozenset[str]:
        """Names of the structural parameters."""
        return self.names.structural

    @property
    def variables(self) -> Mapping[str, Variable]:
        """By name."""
        return self.names.by_name

    @property
    def interface(self) -> Any:
        """What the description says about the interface of this kind; None if it has none."""
        told = self.description
        return told.coSimulation if self.kind == "Co-Simulation" else told.modelExchange

    def require_interface(self) -> None:
        """Refuse an FMU of which no interface is run.

        Raises
        ------
        FmuError
        """
        told = self.description
        if told.coSimulation is None and told.modelExchange is None:
            raise FmuError(
                "expected an interface for Co-Simulation or Model Exchange (it has Scheduled "
                "Execution only, which is not run)",
                str(self.path),
            )

    @cached_property
    def units(self) -> Units:
        """The units that it defines."""
        return Units.read(self.description)

    @cached_property
    def clocks(self) -> tuple[Clock, ...]:
        """Input clocks that time makes tick."""
        if not any(variable.type == "Clock" for variable in self.variables.values()):
            return ()
        return read_clocks(read_entry(self.path, DESCRIPTION))

    def variable(self, name: str) -> Variable:
        """Return the variable of that name, or the array that has that element (``u[1]``).

        Raises
        ------
        FmuError
            If there is none; the message names the nearest one.
        """
        return self.names.resolve(name)[0]

    def conversion(self, name: str, unit: str) -> Conversion:
        """Return how a value in that unit becomes one of the variable of that name.

        Raises
        ------
        FmuError
            If there is no such variable.
        InputError
            If the units do not fit; see `posmas_fmi.fmu.units.Units.conversion`.
        """
        variable = self.variable(name)
        try:
            return self.units.conversion(unit, variable.unit, relative=variable.relative)
        except InputError as error:
            raise InputError(f"{self.path.name}: {name!r}: {error.message}") from None

    def ports(self, names: Iterable[str]) -> Ports:
        """Resolve names for `FmuInstance.read` and `write`; see `Variables.ports`."""
        return self.names.ports(names, self.version)


def read_about(path: Path) -> About:
    """Read what an FMU says about itself; nothing is unpacked or loaded.

    Raises
    ------
    ArchiveError
        If the archive is unsafe, or its description cannot be read.
    FmuError
        If it is not of FMI 1.0, 2.0 or 3.
    """
    for finding in examine(path):
        if finding.severity == "fatal":
            inside = f"{finding.place}: " if finding.place else ""
            raise ArchiveError(f"{inside}{finding.message}", str(path))
    return About.of(path, read_description(path, path))


def read_description(place: Path, path: Path) -> Any:
    """Return FMPy's model description of an archive or folder; errors are about the file `path`.

    Raises
    ------
    ArchiveError
    """
    import fmpy

    def read(source: Any) -> Any:
        return fmpy.read_model_description(source, validate=False)

    try:
        try:
            found = read(str(place))
        except Exception as refused:  # FMPy and lxml raise many kinds
            try:
                found = read(mended(_description(place)))
            except Exception:
                raise refused from None
        return complete_fmi1(found, place) if found.fmiVersion == "1.0" else found
    except Exception as error:  # FMPy and lxml raise many kinds
        raise ArchiveError(f"cannot read modelDescription.xml: {error}", str(path)) from error


def _description(place: Path) -> bytes:
    return (place / DESCRIPTION).read_bytes() if place.is_dir() else read_entry(place, DESCRIPTION)


def complete_fmi1(description: Any, place: Path) -> Any:
    """Add what FMPy does not take over from FMI 1.0: capabilities; and leave negated aliases out.

    Their values are those of other variables with the other sign, which would be read wrongly.
    """
    root = ElementTree.fromstring(_description(place))
    capabilities = root.find("Implementation/*/Capabilities")
    if capabilities is not None:
        for name, value in capabilities.attrib.items():
            if hasattr(description.coSimulation, name) and value in _BOOLEANS:
                setattr(description.coSimulation, name, value in ("true", "1"))
    if root.find("Implementation/CoSimulation_Tool") is not None:
        description.coSimulation.needsExecutionTool = True
    negated = {v.get("name") for v in root.iter("ScalarVariable") if v.get("alias") == _NEGATED}
    description.modelVariables = [v for v in description.modelVariables if v.name not in negated]
    return description


def fitted(source: tuple[About, str], target: tuple[About, str]) -> Conversion:
    """Return how a value of one FMU's variable becomes one of another FMU's.

    Parameters
    ----------
    source, target : (About, str)
        The FMU and the name of its variable.

    Raises
    ------
    InputError
        If one has a unit and the other has none, or the units do not fit.
    """
    ends = [(about, about.variable(name)) for about, name in (source, target)]
    outer, inner = (variable for _, variable in ends)
    try:
        if outer.unit is None and inner.unit is None:
            return Conversion()
        if outer.unit is None or inner.unit is None:
            raise InputError("only one of them has a unit")
        if outer.relative != inner.relative:
            raise InputError("one of them is a difference (relativeQuantity), the other is not")
        return ends[1][0].units.between(
            ends[0][0].units, outer.unit, inner.unit, relative=inner.relative
        )
    except InputError as error:
        why = error.message.partition("; leave the unit out")[0]
        raise InputError(
            f"{source[1]!r} of {source[0].path.name} ({outer.unit or 'no unit'}) to {target[1]!r} "
            f"of {target[0].path.name} ({inner.unit or 'no unit'}): {why}; give scale and offset"
        ) from None
