"""What modelDescription.xml of FMI 1, 2 or 3 says; no mistake in it stops the reading."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any
from xml.etree import ElementTree as ET

import attrs

KINDS = {
    "CoSimulation": "Co-Simulation",
    "ModelExchange": "Model Exchange",
    "ScheduledExecution": "Scheduled Execution",
}
_STATE = {"canGetAndSetFMUState": "canGetAndSetFMUstate"}
_MODEL_LINE = ["Real", "Integer", "Boolean", "String", "Enumeration"]


@attrs.frozen
class Interface:
    """One way to use the FMU.

    Attributes
    ----------
    kind : str
        ``"Co-Simulation"``, ``"Model Exchange"`` or ``"Scheduled Execution"``.
    identifier : str
        modelIdentifier.
    flags : dict of str to str
        Capabilities and other attributes, as written.
    """

    kind: str
    identifier: str
    flags: dict[str, str]

    def has(self, flag: str) -> bool:
        """Whether a capability flag is set."""
        return self.flags.get(flag) in ("true", "1")


@attrs.frozen
class Described:
    """A variable as written.

    Attributes
    ----------
    name, type, causality, variability, initial, reference : str
    start, unit, low, high, nominal : str or None
    dimensions : tuple of str
        Start lengths of an array, or ``vr n`` where a variable tells them.
    """

    name: str
    type: str
    causality: str
    variability: str
    initial: str
    reference: str
    start: str | None = None
    unit: str | None = None
    low: str | None = None
    high: str | None = None
    nominal: str | None = None
    dimensions: tuple[str, ...] = ()
    clocks: str | None = None

    @property
    def real(self) -> bool:
        """Whether it holds floating-point numbers."""
        return self.type in ("Real", "Float64", "Float32")


@attrs.frozen(eq=False)
class Description:
    """A model description.

    Attributes
    ----------
    version : str
        fmiVersion.
    root : dict of str to str
        Attributes of the root element.
    interfaces : tuple of Interface
    variables : tuple of Described
    units : frozenset of str
        That are defined.
    experiment : dict of str to str
        DefaultExperiment; empty if there is none.
    outputs : tuple of str or None
        Value references (FMI 3) or indices (FMI 2) in the ModelStructure; None without one.
    annotations : tuple of str
        Tools that left vendor annotations.
    categories : int
        Number of log categories.
    """

    version: str
    root: dict[str, str]
    interfaces: tuple[Interface, ...]
    variables: tuple[Described, ...]
    units: frozenset[str]
    experiment: dict[str, str]
    outputs: tuple[str, ...] | None
    annotations: tuple[str, ...]

    @property
    def major(self) -> int:
        """1, 2 or 3; 0 for any other version."""
        if self.version == "1.0":
            return 1
        if self.version == "2.0":
            return 2
        return 3 if self.version.startswith("3.") else 0

    @property
    def token(self) -> str:
        """GUID or instantiationToken."""
        return self.root.get("instantiationToken") or self.root.get("guid") or ""

    def interface(self, kind: str) -> Interface | None:
        """Return the interface of that kind, if it has one."""
        return next((i for i in self.interfaces if i.kind == kind), None)


def read_description(data: bytes) -> Description:
    """Read a model description that `posmas_fmi.fmu.check.xml.scan` let through.

    Raises
    ------
    xml.etree.ElementTree.ParseError
        If it is not XML after all.
    """
    root = ET.fromstring(data)
    version = root.get("fmiVersion") or ""
    types = dict(_declared_units(root))
    outputs = root.find("ModelStructure")
    names = None
    if outputs is not None:
        names = tuple(
            e.get("index") or e.get("valueReference") or ""
            for e in [*outputs.iterfind("Outputs/Unknown"), *outputs.iterfind("Output")]
        )
    experiment = root.find("DefaultExperiment")
    listed = root.find("ModelVariables")
    return Description(
        version=version,
        root={**root.attrib, "#tag": root.tag},
        interfaces=tuple(_interfaces(root, version)),
        variables=tuple(_variable(e, types) for e in ([] if listed is None else listed)),
        units=frozenset(_units(root)),
        experiment={} if experiment is None else dict(experiment.attrib),
        outputs=names,
        annotations=tuple(
            e.get("name") or e.get("type") or "?"
            for place in ("VendorAnnotations/Tool", "VendorAnnotations/Annotation", "Annotations/*")
            for e in root.iterfind(place)
        ),
    )


def _interfaces(root: ET.Element, version: str) -> Iterator[Interface]:
    if version == "1.0":
        kind = "Model Exchange" if root.find("Implementation") is None else "Co-Simulation"
        capabilities = root.find("Implementation/*/Capabilities")
        flags = {} if capabilities is None else dict(capabilities.attrib)
        if root.find("Implementation/CoSimulation_Tool") is not None:
            flags["needsExecutionTool"] = "true"
        yield Interface(kind, root.get("modelIdentifier") or "", flags)
        return
    for tag, kind in KINDS.items():
        element = root.find(tag)
        if element is not None:
            flags = {_STATE.get(k, k): v for k, v in element.attrib.items()}
            yield Interface(kind, flags.pop("modelIdentifier", ""), flags)


def _units(root: ET.Element) -> Iterator[str]:
    for element in root.iterfind("UnitDefinitions/*"):
        yield element.get("name") or element.get("unit") or ""


def _declared_units(root: ET.Element) -> Iterator[tuple[str, str | None]]:
    for element in root.iterfind("TypeDefinitions/*"):
        inner = element[0] if len(element) else element
        yield element.get("name") or "", element.get("unit") or inner.get("unit")


def _variable(element: ET.Element, types: dict[str, str | None]) -> Described:
    inner = element
    kind = element.tag
    if kind == "ScalarVariable":  # FMI 1 and 2
        found = next((child for child in element if child.tag in _MODEL_LINE), None)
        inner = element if found is None else found
        kind = "" if found is None else found.tag
    get: Any = inner.get
    start = get("start")
    if start is None and kind in ("String", "Binary"):
        first = element.find("Start")
        start = None if first is None else first.get("value")
    return Described(
        name=element.get("name") or "",
        type=kind,
        causality=element.get("causality") or "local",
        variability=element.get("variability") or "",
        initial=element.get("initial") or "",
        reference=element.get("valueReference") or "",
        start=start,
        unit=get("unit") or types.get(get("declaredType") or ""),
        low=get("min"),
        high=get("max"),
        nominal=get("nominal"),
        dimensions=tuple(
            d.get("start") or f"vr {d.get('valueReference')}" for d in element.iterfind("Dimension")
        ),
        clocks=element.get("clocks"),
    )
