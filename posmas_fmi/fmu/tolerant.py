"""Model descriptions that break a rule of the standard without being ambiguous, made readable.

FMPy refuses a description for two mistakes even where it is told not to validate it: a variable
whose causality does not go with its variability, and a declared type that is not there. FMUs that
run well have them. What is read here differs in nothing else.
"""

from __future__ import annotations

import io
import zipfile
from xml.etree import ElementTree

_LEGAL = {
    "constant": ("output", "local"),
    "fixed": ("parameter", "calculatedParameter", "structuralParameter", "local"),
    "tunable": ("parameter", "calculatedParameter", "structuralParameter", "local"),
    "discrete": ("input", "output", "local"),
    "continuous": ("input", "output", "local", "independent"),
}
_KNOWN = {causality for allowed in _LEGAL.values() for causality in allowed}


def mended(description: bytes) -> io.BytesIO:
    """Return an archive with the model description, without these two mistakes.

    Parameters
    ----------
    description : bytes
        ``modelDescription.xml`` of FMI 2.0 or 3; examined before, so that it is safe to parse.

    Examples
    --------
    >>> xml = '<a><ModelVariables><ScalarVariable name="p" causality="parameter" {}>{}'
    >>> end = '<Real declaredType="T"/></ScalarVariable></ModelVariables></a>'
    >>> archive = mended(xml.format('variability="constant"', end).encode())
    >>> text = zipfile.ZipFile(archive).read("modelDescription.xml").decode()
    >>> 'initial="exact"' in text, "declaredType" in text
    (True, False)
    """
    root = ElementTree.fromstring(description)
    types = {one.get("name") for one in root.iterfind("TypeDefinitions/*")}
    for variable in root.iterfind("ModelVariables/*"):
        for element in (variable, *variable):
            if element.get("declaredType", "") not in types:
                element.attrib.pop("declaredType", None)
        if variable.get("initial") is None and _is_odd(variable):
            variable.set("initial", "exact")  # what is said of it is taken as it is
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("modelDescription.xml", ElementTree.tostring(root))
    archive.seek(0)
    return archive


def _is_odd(variable: ElementTree.Element) -> bool:
    """Whether causality and variability, each one of the standard, do not go together."""
    causality, variability = variable.get("causality", "local"), variable.get("variability")
    if variability not in _LEGAL or causality not in _KNOWN:
        return False  # one that is left out has a default; what is not known stays refused
    return causality not in _LEGAL[variability]
