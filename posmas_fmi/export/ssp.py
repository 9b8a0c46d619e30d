"""Connected FMUs as a file of System Structure and Parameterization (SSP 1.0)."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree as ET

import attrs

_SPACE = "http://ssp-standard.org/SSP1/SystemStructure"
_PREFIX = {"ssd": "Description", "ssc": "Common", "ssv": "ParameterValues"}
_GENERATOR = "posmas-fmi"


@attrs.frozen
class Connector:
    """A real input or output of a component, or of the system.

    Attributes
    ----------
    name : str
        Of a component: of the FMU's variable.
    kind : {"input", "output"}
    """

    name: str
    kind: Literal["input", "output"]


@attrs.frozen
class Component:
    """An instance of an FMU.

    Attributes
    ----------
    name : str
    fmu : Path
    connectors : tuple of Connector
    values : mapping of str to float
        Start values by name.
    """

    name: str
    fmu: Path
    connectors: tuple[Connector, ...]
    values: Mapping[str, float] = attrs.field(factory=dict)


@attrs.frozen
class Connection:
    """``end = factor start + offset``; an element without a name is the system.

    Attributes
    ----------
    start, end : (str, str)
        Component and connector.
    factor, offset : float
    """

    start: tuple[str, str]
    end: tuple[str, str]
    factor: float = 1.0
    offset: float = 0.0


@attrs.frozen
class Structure:
    """Components and how they are connected.

    Attributes
    ----------
    name : str
    components : tuple of Component
    connections : tuple of Connection
    inputs : tuple of str
        Of the system: signals from outside.
    stop : float
        End of the default experiment [s].
    """

    name: str
    components: tuple[Component, ...]
    connections: tuple[Connection, ...]
    inputs: tuple[str, ...] = ()
    stop: float = 1.0


def ssp(structure: Structure) -> bytes:
    """Return the SSP file: the structure, and each FMU once.

    The same arguments give the same bytes.
    """
    places: dict[Path, str] = {}
    for component in structure.components:
        if component.fmu not in places:
            taken = set(places.values())
            place, number = f"resources/{component.fmu.name}", 2
            while place in taken:  # another file of that name
                place = f"resources/{component.fmu.stem}-{number}{component.fmu.suffix}"
                number += 1
            places[component.fmu] = place
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        _put(archive, "SystemStructure.ssd", _description(structure, places))
        for path, place in places.items():
            _put(archive, place, path.read_bytes())
    return content.getvalue()


def _put(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    entry = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
    entry.compress_type = zipfile.ZIP_DEFLATED
    archive.writestr(entry, data)


def _tag(name: str) -> str:
    prefix, local = name.split(":")
    return f"{{{_SPACE}{_PREFIX[prefix]}}}{local}"


def _under(parent: ET.Element, tag: str, **attributes: str) -> ET.Element:
    return ET.SubElement(parent, _tag(tag), attributes)


def _description(structure: Structure, places: Mapping[Path, str]) -> bytes:
    for prefix, space in _PREFIX.items():
        ET.register_namespace(prefix, _SPACE + space)
    root = ET.Element(
        _tag("ssd:SystemStructureDescription"),
        {"version": "1.0", "name": structure.name, "generationTool": _GENERATOR},
    )
    system = _under(root, "ssd:System", name=structure.name)
    if structure.inputs:
        _connectors(system, [Connector(name, "input") for name in structure.inputs])
    elements = _under(system, "ssd:Elements")
    for component in structure.components:
        element = _under(
            elements,
            "ssd:Component",
            name=component.name,
            type="application/x-fmu-sharedlibrary",
            source=places[component.fmu],
        )
        _connectors(element, component.connectors)
        if component.values:
            _values(element, component)
    connections = _under(system, "ssd:Connections")
    for one in structure.connections:
        named = {
            "startElement": one.start[0],
            "startConnector": one.start[1],
            "endElement": one.end[0],
            "endConnector": one.end[1],
        }
        element = _under(connections, "ssd:Connection", **{k: v for k, v in named.items() if v})
        if (one.factor, one.offset) != (1.0, 0.0):
            scaled = {"factor": repr(one.factor), "offset": repr(one.offset)}
            _under(element, "ssc:LinearTransformation", **scaled)
    _under(root, "ssd:DefaultExperiment", startTime="0", stopTime=repr(structure.stop))
    ET.indent(root)
    body: bytes = ET.tostring(root, encoding="UTF-8", xml_declaration=True)
    return body + b"\n"


def _connectors(parent: ET.Element, connectors: tuple[Connector, ...] | list[Connector]) -> None:
    group = _under(parent, "ssd:Connectors")
    for one in connectors:
        connector = _under(group, "ssd:Connector", name=one.name, kind=one.kind)
        _under(connector, "ssc:Real")


def _values(parent: ET.Element, component: Component) -> None:
    binding = _under(_under(parent, "ssd:ParameterBindings"), "ssd:ParameterBinding")
    values = _under(binding, "ssd:ParameterValues")
    given = _under(values, "ssv:ParameterSet", version="1.0", name="start")
    parameters = _under(given, "ssv:Parameters")
    for name, value in component.values.items():
        parameter = _under(parameters, "ssv:Parameter", name=name)
        _under(parameter, "ssv:Real", value=repr(float(value)))
