"""Findings about the model description: what keeps an FMU from being used, or is doubtful."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from posmas_fmi.fmu.archive import is_file_name
from posmas_fmi.fmu.check.described import Described, Description, Interface
from posmas_fmi.fmu.check.finding import Finding

_SHOWN = 5  # examples in one finding
_MANY = 50_000  # variables
_MOST_PARSED = 300  # names of variables that FMPy's grammar reads, at 6 ms each
_PLACE = "modelDescription.xml"
_UNUSED = {
    "providesIntermediateUpdate": "it can tell values during a step",
    "canReturnEarlyAfterIntermediateUpdate": "it can be asked to return early",
    "providesAdjointDerivatives": "it has adjoint derivatives",
    "providesEvaluateDiscreteStates": "it can evaluate discrete states",
}
_FOLDERS = {"terminalsAndIcons": "terminals and icons", "extra": "files of layered standards"}
_CAUSALITIES = {
    1: {"input", "output", "internal", "none", "local"},
    2: {"parameter", "calculatedParameter", "input", "output", "local", "independent"},
    3: {"parameter", "calculatedParameter", "structuralParameter", "input", "output", "local"}
    | {"independent", "dependent"},
}


def description_findings(told: Description) -> list[Finding]:
    """Return the findings about a model description."""
    findings = list(_root(told))
    if any(f.severity == "fatal" for f in findings):
        return findings
    for part in (
        _interfaces,
        _experiment,
        _names,
        _references,
        _starts,
        _units,
        _structure,
        _ports,
    ):
        findings += part(told)
    return findings


def strict_findings(fmu: Path, told: Description) -> list[Finding]:
    """Validate against the schema and the rules of the standard, by FMPy; never fatal."""
    import fmpy
    from fmpy.model_description import ValidationError

    problems: list[str] = []
    try:
        fmpy.read_model_description(
            str(fmu),
            validate=True,
            validate_variable_names=len(told.variables) <= _MOST_PARSED,
            validate_model_structure=True,
        )
    except ValidationError as error:
        problems = error.problems
    except Exception as error:  # FMPy and lxml raise many kinds
        problems = [str(error) or type(error).__name__]
    if not problems:
        return []
    return [
        Finding(
            "warning",
            "not-valid",
            _PLACE,
            f"strict validation finds {_count(len(problems), 'problem')}: {_some(problems)}",
            "tell the maker of the FMU; it is used all the same",
        )
    ]


def _count(n: int, word: str) -> str:
    return f"{n} {word}" + ("s" if n != 1 else "")


def _some(items: Iterable[str]) -> str:
    listed = [" ".join(str(item).split())[:160] for item in items]
    more = f" and {len(listed) - _SHOWN} more" if len(listed) > _SHOWN else ""
    return "; ".join(listed[:_SHOWN]) + more


def _about(
    severity: str, code: str, names: Iterable[str], message: str, remedy: str = ""
) -> Iterator[Finding]:
    """One finding about several variables."""
    listed = list(names)
    if listed:
        text = message.replace("{n}", _count(len(listed), "variable"))
        yield Finding(severity, code, _some(listed), text, remedy)  # type: ignore[arg-type]


# ---- the file as a whole ------------------------------------------------------------------------


def _root(told: Description) -> Iterator[Finding]:
    if told.root["#tag"] != "fmiModelDescription":
        message = f"expected fmiModelDescription (got {told.root['#tag'][:60]})"
        yield Finding("fatal", "description-root", _PLACE, message)
        return
    if not told.major:
        yield Finding(
            "fatal",
            "fmi-version",
            _PLACE,
            f"expected FMI 1.0, 2.0 or 3.0 (it says {told.version[:40]!r})",
            "export the model for FMI 2.0 or 3.0",
        )
        return
    if not told.interfaces:
        yield Finding(
            "fatal",
            "no-interface",
            _PLACE,
            "expected Co-Simulation or Model Exchange (has neither)",
        )
    for interface in told.interfaces:
        if not is_file_name(interface.identifier):
            yield Finding(
                "fatal",
                "identifier-unsafe",
                interface.kind,
                f"the modelIdentifier {interface.identifier[:80]!r} is no file name",
            )
        elif not interface.identifier.isidentifier():
            yield Finding(
                "fatal" if told.major == 1 else "warning",  # FMI 1 makes function names of it
                "identifier",
                interface.kind,
                f"the modelIdentifier {interface.identifier[:80]!r} is no C identifier",
            )
    if not told.variables:
        yield Finding("fatal", "no-variables", _PLACE, "expected ModelVariables (there are none)")
    if not told.token:
        yield Finding(
            "error", "token-missing", _PLACE, "expected a guid or instantiationToken (it has none)"
        )


def _interfaces(told: Description) -> Iterator[Finding]:
    if told.major == 1:
        yield Finding(
            "note",
            "fmi1",
            _PLACE,
            "this is FMI 1.0: its calls go through Python, and it has no saved states",
            "steps cannot be repeated, and a run goes on from a snapshot by doing all again",
        )
    elif told.interface("Co-Simulation") is None:
        kinds = " and ".join(i.kind for i in told.interfaces)
        continuous = told.interface("Model Exchange") is not None
        yield Finding(
            "warning" if continuous else "fatal",
            "no-co-simulation",
            _PLACE,
            f"it has {kinds} only: "
            + (
                "an integrator here takes it through time, at about a millisecond per step"
                if continuous
                else "'posmas-fmi run' takes Co-Simulation and Model Exchange"
            ),
            "export it for Co-Simulation" + (" if that is too slow" if continuous else ""),
        )
    for interface in told.interfaces:
        yield from _capabilities(told, interface)


def _capabilities(told: Description, interface: Interface) -> Iterator[Finding]:
    kind, has = interface.kind, interface.has
    if has("needsExecutionTool"):
        yield Finding(
            "warning",
            "needs-tool",
            kind,
            "it needs another program on this machine at run time (needsExecutionTool)",
            "install that program and its licence, or export without it",
        )
    if has("canBeInstantiatedOnlyOncePerProcess"):
        yield Finding("note", "one-per-process", kind, "each instance needs a process of its own")
    if told.major > 1 and kind == "Co-Simulation" and not has("canGetAndSetFMUstate"):
        yield Finding(
            "note", "no-rollback", kind, "its state cannot be saved: steps cannot be done again"
        )
    fixed = interface.flags.get("fixedInternalStepSize")
    if kind == "Co-Simulation" and not has("canHandleVariableCommunicationStepSize"):
        step = fixed or told.experiment.get("stepSize")
        yield Finding(
            "note",
            "fixed-step",
            kind,
            "it takes communication steps of one length only"
            + (f", perhaps {step} s" if step else ""),
        )
    if has("hasEventMode"):
        yield Finding("note", "event-mode", kind, "it has an Event Mode")


def _experiment(told: Description) -> Iterator[Finding]:
    experiment, place = told.experiment, "DefaultExperiment"
    if not experiment:
        return
    values = {key: _number(text) for key, text in experiment.items()}
    bad = [key for key, value in values.items() if value is None and not key.startswith("{")]
    if bad:
        yield Finding(
            "error",
            "experiment",
            place,
            f"expected numbers (got {_some(f'{k} = {experiment[k]!r}' for k in bad)})",
        )
        return
    start, stop = values.get("startTime") or 0.0, values.get("stopTime")
    if stop is not None and stop <= start:
        yield Finding("warning", "experiment", place, f"it ends ({stop:g} s) before it begins")
    step = values.get("stepSize")
    if step is not None and step <= 0:
        yield Finding("warning", "experiment", place, f"expected a step > 0 s (got {step:g})")


def _number(text: str | None) -> float | None:
    """Return a number as XML writes it; None if it is none."""
    try:
        return float(text) if text is not None and "_" not in text else None
    except ValueError:
        return None


# ---- variables ----------------------------------------------------------------------------------


def _names(told: Description) -> Iterator[Finding]:
    if len(told.variables) > _MANY:
        yield Finding(
            "note",
            "many-variables",
            _PLACE,
            f"it has {len(told.variables)} variables: loading is slow",
        )
    counts = Counter(v.name for v in told.variables)
    yield from _about(
        "error",
        "name-twice",
        [name for name, n in counts.items() if n > 1],
        "{n} with a name that another one has: which one is meant is not clear",
    )
    if counts[""]:
        yield Finding("error", "name-missing", _PLACE, f"{counts['']} variables have no name")
    legal = _CAUSALITIES[told.major]
    yield from _about(
        "error",
        "causality",
        [f"{v.name} ({v.causality})" for v in told.variables if v.causality not in legal],
        "{n} with a causality that the standard does not know",
    )
    yield from _about(
        "error",
        "type-missing",
        [v.name for v in told.variables if not v.type],
        "{n} without a type",
    )


def _references(told: Description) -> Iterator[Finding]:
    bad = [
        f"{v.name} ({v.reference[:30]!r})"
        for v in told.variables
        if not (v.reference.isascii() and v.reference.isdigit() and int(v.reference) < 2**32)
    ]
    yield from _about("fatal", "reference", bad, "{n} without a value reference below 2^32")
    owners: dict[tuple[str, str], Described] = {}
    clashes = []
    for v in told.variables:
        key = v.reference, v.type if told.major < 3 else ""
        other = owners.setdefault(key, v)
        if other is v:
            continue
        if told.major == 3 or (
            "input" in (v.causality, other.causality) and v.causality != other.causality
        ):
            clashes.append(f"{v.name} and {other.name}")
    yield from _about(
        "warning", "reference-shared", clashes, "{n} with the value reference of another one"
    )


def _starts(told: Description) -> Iterator[Finding]:
    needs = [
        v.name
        for v in told.variables
        if v.start is None
        and told.major > 1
        and v.type != "Clock"
        and (v.causality in ("input", "parameter", "structuralParameter") or v.initial == "exact")
    ]
    yield from _about("warning", "start-missing", needs, "{n} without the start value it must have")
    numbers: list[str] = []
    outside: list[str] = []
    nominal: list[str] = []
    ranges: list[str] = []
    for v in told.variables:
        if not v.real and "Int" not in v.type:
            continue
        low, high = _number(v.low), _number(v.high)
        if low is not None and high is not None and low > high:
            ranges.append(f"{v.name} ({v.low} … {v.high})")
        for word in (v.start or "").split():
            value = _number(word)
            if value is None or not math.isfinite(value):
                numbers.append(f"{v.name} ({word[:30]!r})")
            elif (low is not None and value < low) or (high is not None and value > high):
                outside.append(f"{v.name} ({value:g})")
            else:
                continue
            break
        size = _number(v.nominal)
        if v.nominal is not None and not (size is not None and 0 < size < math.inf):
            nominal.append(f"{v.name} ({v.nominal[:30]!r})")
    yield from _about("error", "start-not-finite", numbers, "{n} whose start is no finite number")
    yield from _about("warning", "start-outside", outside, "{n} that start outside min … max")
    yield from _about("warning", "range", ranges, "{n} with min above max")
    yield from _about("warning", "nominal", nominal, "{n} whose nominal is not a number > 0")


def _units(told: Description) -> Iterator[Finding]:
    ports = [v for v in told.variables if v.real and v.causality in ("input", "output")]
    yield from _about(
        "note",
        "unit-missing",
        [v.name for v in ports if not v.unit],
        "{n} among inputs and outputs without a unit",
        "check by hand what they are in: K or °C, kg/s or L/min",
    )
    yield from _about(
        "warning",
        "unit-undefined",
        sorted({f"{v.unit}" for v in ports if v.unit and v.unit not in told.units}),
        "units that the file does not define",
    )


def _structure(told: Description) -> Iterator[Finding]:
    if told.major == 1:
        return
    if told.outputs is None:
        yield Finding("warning", "structure-missing", _PLACE, "expected a ModelStructure")
        return
    if told.major == 3:
        named = set(told.outputs)  # there may be hundred thousands
        listed = {v.name for v in told.variables if v.reference in named}
        known = {v.reference for v in told.variables}
        wrong = [text for text in told.outputs if text not in known]
    else:
        places = [int(text) if text.isascii() and text.isdigit() else 0 for text in told.outputs]
        good = {k for k in places if 1 <= k <= len(told.variables)}
        wrong = [t for t, k in zip(told.outputs, places, strict=True) if k not in good]
        listed = {told.variables[k - 1].name for k in good}
    yield from _about(
        "error", "structure-index", wrong, "outputs in the ModelStructure that are no variables"
    )
    yield from _about(
        "warning",
        "structure-output",
        [v.name for v in told.variables if v.causality == "output" and v.name not in listed],
        "{n} of causality output that the ModelStructure does not list",
    )


def _ports(told: Description) -> Iterator[Finding]:
    def named(test: Callable[[Described], bool]) -> list[str]:
        return [v.name for v in told.variables if test(v)]

    if not named(lambda v: v.causality == "input" and v.real):
        yield Finding(
            "warning", "no-inputs", _PLACE, "it has no real input: nothing can be controlled"
        )
    if not named(lambda v: v.causality == "output" and v.real):
        yield Finding(
            "note",
            "no-outputs",
            _PLACE,
            "it declares no real output",
            "any real variable can be read: name it with --out",
        )
    yield from _about(
        "note",
        "structural",
        named(lambda v: v.causality == "structuralParameter"),
        "{n} that change the sizes of arrays; here they stay as they are: a scenario may give "
        "others, as parameters",
    )
    yield from _about("note", "clocks", named(lambda v: v.type == "Clock"), "{n} that are clocks")
    yield from _about(
        "note",
        "kinds-unused",
        named(lambda v: v.type in ("String", "Binary") and v.causality == "input"),
        "inputs that are no numbers; they keep their start values",
    )
    yield from _about(
        "note",
        "kinds-unused",
        named(lambda v: v.type in ("String", "Binary") and v.causality == "output"),
        "outputs that are no numbers; they are not read",
    )
    for interface in told.interfaces:
        for flag, text in _UNUSED.items():
            if interface.has(flag):
                yield Finding("note", "not-used", interface.kind, f"{text} ({flag}): not used")


def more_findings(names: Iterable[str]) -> list[Finding]:
    """Return the findings about files beside the description, by their names in the archive."""
    there = {name.split("/")[0] for name in names if "/" in name}
    return [
        Finding("note", "not-used", folder, f"{text}: not used")
        for folder, text in _FOLDERS.items()
        if folder in there
    ]
