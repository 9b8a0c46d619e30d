"""Start values: what an FMU does not let one set, and what it made of those that were set."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import attrs
import numpy as np

from posmas_fmi.errors import FmuError, InputError
from posmas_fmi.fmu.about import About
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.given import Form, Given, Key, as_arrays, flattened
from posmas_fmi.fmu.instance import FmuInstance
from posmas_fmi.fmu.variables import REAL, WHOLE, Variable

_SAME = {"Float32": 1e-6}  # relative, by type: rounding of what was set
_SAME_DOUBLE = 1e-12


@attrs.frozen
class StartFinding:
    """A start value that the FMU does not have as it was asked for.

    Attributes
    ----------
    instance, fmu, variable : str
    what : {"not set", "changed", "not read back"}
    message : str
        Why, or what the values are.
    """

    instance: str
    fmu: str
    variable: str
    what: str
    message: str


class StartValues:
    """Start values for instances of one file; those of the same names and shapes are checked once.

    Parameters
    ----------
    file : FmuFile
    """

    def __init__(self, file: FmuFile) -> None:
        self._file = file
        self._known: dict[Key, _Chosen] = {}

    def of(self, values: Mapping[str, Any], instance: str) -> tuple[Given, list[StartFinding]]:
        """Return the values that may be set before initialisation, and findings about the others.

        Parameters
        ----------
        values : mapping
            By name; arrays also where the FMU has a scalar for each element.
        instance : str
            Name for errors and findings.

        Raises
        ------
        InputError
            If there is no such variable, or a value is not of its type or shape.
        """
        plain, key = as_arrays(values)
        if key not in self._known:
            self._known[key] = self._choose(plain)
        chosen = self._known[key]
        flat = flattened(plain)[chosen.at]
        given = chosen.form.given(flat, {name: plain[name] for name in chosen.form.texts})
        return given, [attrs.evolve(one, instance=instance) for one in chosen.refused]

    def _choose(self, values: Mapping[str, Any]) -> _Chosen:
        about = self._file.about
        kept, refused = settable(about, spread(about, values))
        form = self._file.given(kept).form
        places, begin = {}, 0  # of each number, in its stead
        for name, value in values.items():
            if not _is_text(value):
                places[name] = begin + np.arange(value.size, dtype=float).reshape(value.shape)
                begin += value.size
        place = spread(about, places)
        at = [np.ravel(place[name]) for name in form.names]
        return _Chosen(form, np.concatenate([*at, []]).astype(int), tuple(refused))


@attrs.frozen(eq=False)
class _Chosen:
    """Which of values of the same names and shapes are set.

    Attributes
    ----------
    form : Form
        Of those that are set.
    at : (n,) array of int
        Where their numbers are among all.
    refused : tuple of StartFinding
        About the others.
    """

    form: Form
    at: np.ndarray[Any, np.dtype[np.int64]]
    refused: tuple[StartFinding, ...]


def spread(about: About, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values as this FMU takes them: arrays by element where it has no arrays.

    Parameters
    ----------
    about : About
    values : mapping
        By name.

    Raises
    ------
    InputError
        If there is no such variable, or a value is not of its type or shape.
    """
    spreads: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, str) or name in about.variables or not shape_of(name, value):
            spreads[name] = value
            continue
        array = np.asarray(value, dtype=float)
        for index in np.ndindex(array.shape):
            label = ",".join(str(i + 1) for i in index)
            spreads[f"{name}[{label}]"] = float(array[index])
    for name, value in spreads.items():
        problem = _misfit(about, name, value)
        if problem:
            raise InputError(f"{about.path.name}: {problem}")
    return spreads


def shape_of(name: str, value: Any) -> tuple[int, ...]:
    """Return the shape of a value; lists of different lengths in it are an InputError."""
    try:
        return np.shape(value)
    except ValueError:
        raise InputError(f"expected rows of the same length for {name!r} (got {value!r})") from None


def _misfit(about: About, name: str, value: Any) -> str:
    """Tell what keeps a value from being one of the variable of that name, or nothing."""
    try:
        variable, index = about.names.resolve(name)
    except FmuError as error:
        return error.message
    if _is_text(value) and variable.type in REAL | WHOLE:
        return f"expected a number for {name!r}, which is {variable.type} (got {value!r})"
    if not _is_text(value) and variable.type == "String":
        return f"expected a text for {name!r} (got {value!r})"
    shape = () if index is not None else variable.shape
    if not _is_text(value) and np.shape(value) not in (shape, (math.prod(shape),)):
        words = f"an array of shape {shape}" if shape else "one number"
        return f"expected {words} for {name!r} (got {value!r})"
    return ""


def settable(
    about: About, values: Mapping[str, Any], instance: str = ""
) -> tuple[dict[str, Any], list[StartFinding]]:
    """Return the values that may be set before initialisation, and findings about the others.

    Parameters
    ----------
    about : About
    values : mapping
        By name; all names are known to the FMU.
    instance : str
        Name for the findings.
    """
    kept, findings = {}, []
    for name, value in values.items():
        if name in about.structure and np.array_equal(about.structure[name], value):
            continue  # set when the instance was made
        why = _not_settable(about.variable(name))
        if why:
            findings.append(StartFinding(instance, about.path.name, name, "not set", why))
        else:
            kept[name] = value
    return kept, findings


def _not_settable(variable: Variable) -> str:
    if variable.variability == "constant":
        return "it is a constant"
    if variable.causality == "structuralParameter":
        return "it is a structural parameter, which is set when a file is opened"
    if variable.causality in ("calculatedParameter", "independent"):
        return f"its causality is {variable.causality}"
    # some exporters give a start value and forget to say that it counts
    if variable.initial == "calculated" and variable.start is None and variable.text is None:
        return "the FMU calculates it (initial is calculated)"
    return ""


def read_back(instance: FmuInstance, values: Mapping[str, Any]) -> list[StartFinding]:
    """Return findings about values that an initialised instance no longer has.

    Parameters
    ----------
    instance : FmuInstance
    values : mapping
        What was set, by name.
    """
    findings, about = [], instance.file.about
    for name, wanted, found in _pairs(instance, instance.file.given(values)):
        if isinstance(found, FmuError):
            what, message = "not read back", found.message
        elif _same(about.variable(name), wanted, found):
            continue
        else:
            what, message = "changed", f"set to {_shown(wanted)}, and it is {_shown(found)}"
        findings.append(StartFinding(instance.name, about.path.name, name, what, message))
    return findings


def _pairs(instance: FmuInstance, given: Given) -> Iterable[tuple[str, Any, Any]]:
    """Name, what was set and what is there; all numbers in one call where that works.

    Where all of the numbers are the very same, as they nearly always are, they are left out.
    """
    form = given.form
    if form.names:
        try:
            found = instance.read(form.ports)
        except FmuError:
            for name in form.names:
                yield name, given[name], _attempt(instance, name)
        else:
            if not (found == given.flat).all():
                for k, name in enumerate(form.names):
                    yield name, given.flat[form.part(k)], found[form.part(k)]
    for name, text in given.texts.items():
        yield name, text, _attempt(instance, name)


def _attempt(instance: FmuInstance, name: str) -> Any:
    try:
        value = instance.get(name)
    except FmuError as error:
        return error
    return value if _is_text(value) else np.ravel(np.asarray(value, float))


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _same(variable: Variable, wanted: Any, found: Any) -> bool:
    if _is_text(wanted) or _is_text(found):
        return bool(wanted == found)
    near = np.isclose(found, wanted, rtol=_SAME.get(variable.type, _SAME_DOUBLE), atol=0.0)
    return bool(np.all(near))


def _shown(value: Any) -> str:
    if _is_text(value):
        return repr(value)
    if value.size == 1:
        return f"{value[0]:.9g}"
    numbers = [f"{one:.9g}" for one in value[:4]]
    return f"[{', '.join(numbers)}{', …' if value.size > 4 else ''}]"


def told(finding: Mapping[str, Any]) -> str:
    """Say one of the findings of `grouped` in words.

    Examples
    --------
    >>> one = StartFinding("b", "a.fmu", "m", "not set", "it is a constant")
    >>> told(grouped([one, one])[0])
    "a.fmu: b and 1 more: start value 'm' not set: it is a constant"
    """
    who = finding["instances"]
    more = f" and {len(who) - 1} more" if len(who) > 1 else ""
    return (
        f"{finding['fmu']}: {who[0]}{more}: start value {finding['variable']!r} "
        f"{finding['what']}: {finding['message']}"
    )


def grouped(findings: Iterable[StartFinding]) -> list[dict[str, Any]]:
    """Return findings as a manifest shows them: what is the same for many instances stands once.

    Examples
    --------
    >>> same = [StartFinding(name, "a.fmu", "m", "not set", "it is a constant") for name in "ab"]
    >>> grouped(same)[0]["instances"]
    ['a', 'b']
    """
    groups: dict[tuple[str, ...], list[str]] = {}
    for one in findings:
        key = (one.fmu, one.variable, one.what, one.message)
        groups.setdefault(key, []).append(one.instance)
    names = ("fmu", "variable", "what", "message")
    return [{**dict(zip(names, key, strict=True)), "instances": who} for key, who in groups.items()]
