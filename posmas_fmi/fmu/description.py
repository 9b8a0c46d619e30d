"""modelDescription.xml for FMI 2.0 and 3.0, and the build description of the sources."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence

from posmas_fmi.errors import BuildError, InputError
from posmas_fmi.fmu.model import FmuModel, Variable
from posmas_fmi.fmu.sources import FmiVersion, instantiation_token
from posmas_fmi.fmu.units import BASES, Unit, parse_unit

_GENERATOR = "posmas-fmi"


def model_description(model: FmuModel, fmi: FmiVersion, sources: Sequence[str]) -> bytes:
    """Write modelDescription.xml.

    Parameters
    ----------
    model : FmuModel
    fmi : {2, 3}
    sources : sequence of str
        Names of the C files to compile (FMI 2 lists them here).

    Returns
    -------
    bytes
        UTF-8, the same for the same model.

    Raises
    ------
    BuildError
        If a unit is not known.
    """
    root = _fmi2(model, sources) if fmi == 2 else _fmi3(model)
    return _bytes(root)


def build_description(model: FmuModel, sources: Sequence[str]) -> bytes:
    """Write sources/buildDescription.xml (FMI 3.0, section 2.5.1.3)."""
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = ET.SubElement(root, "BuildConfiguration", modelIdentifier=model.name)
    files = ET.SubElement(configuration, "SourceFileSet", language="C99")
    for name in sources:
        ET.SubElement(files, "SourceFile", name=name)
    return _bytes(root)


def _bytes(root: ET.Element) -> bytes:
    ET.indent(root)
    body: bytes = ET.tostring(root, encoding="UTF-8", xml_declaration=True)
    return body + b"\n"


def _units(root: ET.Element, model: FmuModel) -> None:
    definitions = ET.SubElement(root, "UnitDefinitions")
    for name, unit in sorted({"s": parse_unit("s"), **_units_of(model)}.items()):
        powers = zip(BASES, unit.exponents, strict=True)
        attributes = {base: str(e) for base, e in powers if e}
        if unit.factor != 1:
            attributes["factor"] = repr(float(unit.factor))
        if unit.offset:
            attributes["offset"] = repr(float(unit.offset))
        element = ET.SubElement(definitions, "Unit", name=name)
        ET.SubElement(element, "BaseUnit", attributes)


def _units_of(model: FmuModel) -> dict[str, Unit]:
    found = {}
    for variable in model.table:
        try:
            found[variable.unit] = parse_unit(variable.unit)
        except InputError as error:
            what = f"the unit of {variable.name!r}: {error.message}; or 1, and the factor in C"
            raise BuildError(what, model.name) from None
    return found


def _log_categories(root: ET.Element) -> None:
    categories = ET.SubElement(root, "LogCategories")
    for name in ("logStatusDiscard", "logStatusError"):
        ET.SubElement(categories, "Category", name=name)


def _experiment(root: ET.Element, model: FmuModel) -> None:
    experiment = model.experiment
    ET.SubElement(
        root,
        "DefaultExperiment",
        startTime="0",
        stopTime=repr(experiment.stop),
        tolerance=repr(experiment.tolerance),
        stepSize=repr(experiment.step),
    )


_CAUSALITY = {
    "parameter": {"causality": "parameter", "variability": "tunable", "initial": "exact"},
    "input": {"causality": "input", "variability": "continuous"},
    "state": {"causality": "local", "variability": "continuous", "initial": "exact"},
    "memory": {"causality": "local", "variability": "continuous", "initial": "calculated"},
    "derivative": {"causality": "local", "variability": "continuous", "initial": "calculated"},
    "output": {"causality": "output", "variability": "continuous", "initial": "calculated"},
    "local": {"causality": "local", "variability": "continuous", "initial": "calculated"},
}


def _causality(model: FmuModel, variable: Variable) -> dict[str, str]:
    """Return causality, variability and initial; a sampled model's own variables are discrete."""
    found = _CAUSALITY[variable.role]
    if model.sampled and variable.role not in ("parameter", "input"):
        found = {**found, "variability": "discrete"}
    return found


def _value(variable: Variable) -> dict[str, str]:
    attributes = {"unit": variable.unit}
    if variable.role == "state" and variable.nominal != 1.0:
        attributes["nominal"] = repr(variable.nominal)
    return attributes


def _true(value: bool) -> str:
    return "true" if value else "false"


def _initial_unknowns(model: FmuModel) -> list[Variable]:
    return [v for v in model.table if v.role in ("output", "derivative")]


def _depends(model: FmuModel, variable: Variable) -> list[Variable]:
    """Return the inputs and states that a computed variable depends on."""
    known = [v for v in model.table if v.role in ("input", "state")]
    return [v for v in known if variable.depends is None or v.name in variable.depends]


# ---- FMI 2.0: one scalar variable per element ---------------------------------------------------


def _fmi2(model: FmuModel, sources: Sequence[str]) -> ET.Element:
    root = ET.Element(
        "fmiModelDescription",
        fmiVersion="2.0",
        modelName=model.name,
        guid=instantiation_token(model, 2),
        description=model.description,
        license="BSD-3-Clause",
        generationTool=_GENERATOR,
        variableNamingConvention="structured",
        numberOfEventIndicators="0",
    )
    common = {
        "modelIdentifier": model.name,
        # Instances are allocated by the FMU itself: an importer's allocator may be very slow.
        "canNotUseMemoryManagementFunctions": "true",
        "canGetAndSetFMUstate": "true",
        "canSerializeFMUstate": "true",
        "providesDirectionalDerivative": _true(not model.sampled),
    }
    if not model.sampled:
        ET.SubElement(root, "ModelExchange", {**common, "completedIntegratorStepNotNeeded": "true"})
    varies = {"canHandleVariableCommunicationStepSize": _true(not model.sampled)}
    ET.SubElement(root, "CoSimulation", {**common, **varies})
    for interface in list(root):
        files = ET.SubElement(interface, "SourceFiles")
        for name in sources:
            ET.SubElement(files, "File", name=name)
    _units(root, model)
    _log_categories(root)
    _experiment(root, model)

    variables = ET.SubElement(root, "ModelVariables")
    references = model.references()
    index = references  # variables are listed in the order of their values, counted from 1
    for variable in model.table:
        for k, name in enumerate(variable.elements):
            scalar = ET.SubElement(
                variables,
                "ScalarVariable",
                {
                    "name": name,
                    "valueReference": str(references[variable.name] + k),
                    "description": variable.description,
                    **_causality(model, variable),
                },
            )
            value = ET.SubElement(scalar, "Real", _value(variable))
            if variable.needs_start:
                value.set("start", repr(variable.start[k]))
            if variable.role == "derivative":
                value.set("derivative", str(index[variable.name[4:-1]] + k))

    structure = ET.SubElement(root, "ModelStructure")

    def unknowns(element: str, chosen: list[Variable], dependencies: bool) -> None:
        if not chosen:
            return
        parent = ET.SubElement(structure, element)
        for variable in chosen:
            on = [str(index[v.name] + k) for v in _depends(model, variable) for k in range(v.size)]
            for k in range(variable.size):
                unknown = ET.SubElement(parent, "Unknown", index=str(index[variable.name] + k))
                if dependencies:
                    unknown.set("dependencies", " ".join(on))

    unknowns("Outputs", [v for v in model.table if v.role == "output"], True)
    unknowns("Derivatives", [v for v in model.table if v.role == "derivative"], True)
    unknowns(
        "InitialUnknowns",
        sorted(_initial_unknowns(model), key=lambda v: index[v.name]),
        False,
    )
    return root


# ---- FMI 3.0: arrays ----------------------------------------------------------------------------


def _fmi3(model: FmuModel) -> ET.Element:
    root = ET.Element(
        "fmiModelDescription",
        fmiVersion="3.0",
        modelName=model.name,
        instantiationToken=instantiation_token(model, 3),
        description=model.description,
        license="BSD-3-Clause",
        generationTool=_GENERATOR,
        variableNamingConvention="structured",
    )
    common = {
        "modelIdentifier": model.name,
        "canGetAndSetFMUState": "true",
        "canSerializeFMUState": "true",
        "providesDirectionalDerivatives": _true(not model.sampled),
    }
    if not model.sampled:
        ET.SubElement(root, "ModelExchange", {**common, "needsCompletedIntegratorStep": "false"})
    varies = {"canHandleVariableCommunicationStepSize": _true(not model.sampled)}
    ET.SubElement(root, "CoSimulation", {**common, **varies})
    _units(root, model)
    _log_categories(root)
    _experiment(root, model)

    references = model.references()
    variables = ET.SubElement(root, "ModelVariables")
    ET.SubElement(
        variables,
        "Float64",
        name="time",
        valueReference="0",
        causality="independent",
        variability="continuous",
        description="Time",
        unit="s",
    )
    for variable in model.table:
        element = ET.SubElement(
            variables,
            "Float64",
            {
                "name": variable.name,
                "valueReference": str(references[variable.name]),
                "description": variable.description,
                **_causality(model, variable),
                **_value(variable),
            },
        )
        if variable.needs_start:
            element.set("start", " ".join(repr(value) for value in variable.start))
        if variable.role == "derivative":
            element.set("derivative", str(references[variable.name[4:-1]]))
        for length in variable.shape:
            ET.SubElement(element, "Dimension", start=str(length))

    structure = ET.SubElement(root, "ModelStructure")

    def unknowns(element: str, chosen: list[Variable], dependencies: bool) -> None:
        for variable in chosen:
            unknown = ET.SubElement(
                structure, element, valueReference=str(references[variable.name])
            )
            if dependencies:
                on = [str(references[v.name]) for v in _depends(model, variable)]
                unknown.set("dependencies", " ".join(on))

    unknowns("Output", [v for v in model.table if v.role == "output"], True)
    unknowns("ContinuousStateDerivative", [v for v in model.table if v.role == "derivative"], True)
    unknowns("InitialUnknown", _initial_unknowns(model), False)
    return root
