"""Preflight of one FMU: everything that is known about it, and what is wrong."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import attrs

from posmas_fmi.errors import InputError
from posmas_fmi.fmu.archive import DESCRIPTION, entry_names, examine, read_entry, require_file
from posmas_fmi.fmu.check.binaries import Binary, binary_findings, read_binaries
from posmas_fmi.fmu.check.described import Described, Description, read_description
from posmas_fmi.fmu.check.description import (
    description_findings,
    more_findings,
    strict_findings,
)
from posmas_fmi.fmu.check.finding import SEVERITIES, Finding, worst
from posmas_fmi.fmu.check.supervisor import Bounds, Outcome, Supervisor

FINE, ERRORS, UNUSABLE = 0, 1, 3  # exit codes
VERDICTS = {FINE: "fine", ERRORS: "usable, with errors", UNUSABLE: "not usable"}


@attrs.frozen(eq=False)
class Preflight:
    """What is known about an FMU.

    Attributes
    ----------
    path : Path
    findings : tuple of Finding
        The worst first.
    told : Description or None
        What its model description says; None if it could not be read safely.
    binaries : tuple of Binary
    results : dict
        Measurements of the trial by name; empty without one.
    """

    path: Path
    findings: tuple[Finding, ...]
    told: Description | None = None
    binaries: tuple[Binary, ...] = ()
    results: dict[str, Any] = attrs.field(factory=dict)

    @property
    def exit_code(self) -> int:
        """0 fine (notes and warnings), 1 errors but usable, 3 unsafe or unusable."""
        found = worst(self.findings)
        return UNUSABLE if found == "fatal" else ERRORS if found == "error" else FINE

    @property
    def verdict(self) -> str:
        """The exit code in words."""
        return VERDICTS[self.exit_code]

    def ports(self, causality: str) -> list[Described]:
        """Return the real variables of that causality."""
        known = self.told.variables if self.told else ()
        return [v for v in known if v.causality == causality and v.real]

    def count(self, severity: str) -> int:
        """Return how many findings have that severity."""
        return sum(f.severity == severity for f in self.findings)

    def to_dict(self) -> dict[str, Any]:
        """Return everything as lists, texts and numbers, for JSON."""
        told = self.told
        return {
            "fmu": str(self.path),
            "verdict": self.verdict,
            "exit_code": self.exit_code,
            "findings": [attrs.asdict(f) for f in self.findings],
            "fmi": told.version if told else None,
            "model": told.root.get("modelName") if told else None,
            "tool": told.root.get("generationTool") if told else None,
            "interfaces": [attrs.asdict(i) for i in told.interfaces] if told else [],
            "binaries": [b.to_dict() for b in self.binaries],
            "experiment": told.experiment if told else {},
            "variables": len(told.variables) if told else None,
            "inputs": [_port(v) for v in self.ports("input")],
            "outputs": [_port(v) for v in self.ports("output")],
            "annotations": list(told.annotations) if told else [],
            "trial": _finite(self.results),
        }


def check_fmu(
    path: str | Path,
    inputs: Sequence[str] = (),
    outputs: Sequence[str] = (),
    values: Mapping[str, float] | None = None,
    *,
    run: bool = True,
    control: bool = True,
    supervisor: Supervisor | None = None,
    bounds: Bounds | None = None,
) -> Preflight:
    """Examine an FMU of FMI 1, 2 or 3, then try it in a process of its own.

    Parameters
    ----------
    path : path-like
    inputs, outputs : sequence of str
        Variables that will carry the protocol's u and y; must be there.
    values : mapping, optional
        Parameters, start values and inputs by name; those of the file by default.
    run : bool
        Whether to try it if nothing fatal was found before.
    control : bool
        Whether the trial ends with the control report.
    supervisor : Supervisor, optional
        That tries it, to spare a start for each FMU; one for this FMU alone by default.
    bounds : Bounds, optional
        What the trial may take.

    Returns
    -------
    Preflight

    Raises
    ------
    InputError
        If there is no such file, or no such variable.

    Examples
    --------
    >>> from posmas_fmi.expression import VectorFunction
    >>> from posmas_fmi.fmu.build import agent_fmu
    >>> g = VectorFunction.parse(["0"], ["t", "x1"])
    >>> path = agent_fmu(g, VectorFunction.parse(["tanh(u1)"], ["u1"]), 1, 1, 1)
    >>> check_fmu(path, run=False).verdict
    'fine'
    """
    path = Path(path)
    values = dict(values or {})
    require_file(path)
    findings = examine(path, whole=True)
    if worst(findings) == "fatal":
        return Preflight(path, _ordered(findings))
    told = read_description(read_entry(path, DESCRIPTION))
    _names_exist(path, told, [*inputs, *outputs, *values])
    findings += description_findings(told) + more_findings(entry_names(path))
    if worst(findings) == "fatal":
        return Preflight(path, _ordered(findings), told)
    binaries = read_binaries(path)
    findings += binary_findings(path, told, binaries)
    findings += strict_findings(path, told)
    if not run or worst(findings) == "fatal":
        return Preflight(path, _ordered(findings), told, tuple(binaries))
    job = _job(told, inputs, outputs, values)
    outcome = _tried(path, told, job, supervisor, bounds, control)
    findings += outcome.findings
    return Preflight(path, _ordered(findings), told, tuple(binaries), outcome.results)


def _job(
    told: Description, inputs: Sequence[str], outputs: Sequence[str], values: dict[str, float]
) -> dict[str, Any]:
    interface = told.interface("Co-Simulation") or told.interface("Model Exchange")
    assert interface is not None
    return {
        "interface": interface.kind,
        "inputs": tuple(inputs),
        "outputs": tuple(outputs),
        "values": values,
        "major": told.major,
        "single": interface.has("canBeInstantiatedOnlyOncePerProcess"),
        "serialises": interface.has("canSerializeFMUstate")
        or interface.has("canSerializeFMUState"),
    }


def _tried(
    path: Path,
    told: Description,
    job: dict[str, Any],
    supervisor: Supervisor | None,
    bounds: Bounds | None,
    control: bool,
) -> Outcome:
    if supervisor is not None:
        return supervisor.examine(path, job, bounds, control)
    with Supervisor(bounds) as own:
        return own.examine(path, job, None, control)


def _ordered(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    return tuple(sorted(findings, key=lambda f: -SEVERITIES.index(f.severity)))


def _names_exist(path: Path, told: Description, names: Sequence[str]) -> None:
    known = {v.name for v in told.variables}
    arrays = {v.name for v in told.variables if v.dimensions}
    for name in names:
        if name in known or re.sub(r"\[\d+(,\d+)*\]$", "", name) in arrays:
            continue
        near = get_close_matches(name, known, 1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise InputError(f"there is no variable {name!r}{hint}", str(path))


def _finite(value: Any) -> Any:
    """Replace numbers that JSON does not know by None."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(one) for key, one in value.items()}
    return [_finite(one) for one in value] if isinstance(value, list | tuple) else value


def _port(variable: Described) -> dict[str, Any]:
    facts = {
        "name": variable.name,
        "unit": variable.unit,
        "start": variable.start,
        "min": variable.low,
        "max": variable.high,
        "nominal": variable.nominal,
        "dimensions": list(variable.dimensions),
    }
    return {k: v for k, v in facts.items() if v not in (None, [])}


def facts(made: Preflight) -> Iterator[tuple[str, str]]:
    """Return label and text of what is worth showing about an FMU."""
    told = made.told
    if told is None:
        return
    kinds = " and ".join(i.kind for i in told.interfaces) or "no interface"
    tool = told.root.get("generationTool")
    yield "FMI", f"{told.version}, {kinds}" + (f", by {tool}" if tool else "")
    systems = [
        f"{b.folder}" + (f" ({'/'.join(b.image.machines)})" if b.image else "")
        for b in made.binaries
    ]
    yield "platforms", ", ".join(dict.fromkeys(systems)) or "none"
    for label, causality in (("inputs", "input"), ("outputs", "output")):
        yield label, _listed(made.ports(causality))
    for interface in told.interfaces:
        able = [flag for flag in interface.flags if interface.has(flag)]
        if able:
            yield interface.kind, ", ".join(able)


def measured(made: Preflight) -> Iterator[tuple[str, str]]:
    """Return label and text of what the trial has measured."""
    found = made.results

    def seconds(name: str) -> str:
        return f"{_engineering(found[name])}s" if name in found else "-"

    if "load_s" not in found:
        return
    times = (f"load {seconds('load_s')}", f"instantiate {seconds('instantiate_s')}")
    yield "trial", ", ".join([*times, f"initialise {seconds('initialise_s')}"])
    if "steps" in found:
        yield (
            "step",
            f"{found['steps']} of {found['step']:g} s: median {seconds('step_median_s')}, "
            f"longest {seconds('step_max_s')}",
        )
    words = {
        "reset_noise": "after a reset",
        "replay_noise": "from a saved state",
        "serialise_noise": "from a serialised state",
        "repeat_noise": "in another instance",
    }
    again = [
        f"{text} {'the same bits' if found[name] == 0 else f'off by {found[name]:.2g}'}"
        for name, text in words.items()
        if math.isfinite(found.get(name, math.nan))
    ]
    if again:
        yield "done again", ", ".join(again)


def _engineering(value: float) -> str:
    for unit, size in (("", 1.0), ("m", 1e-3), ("µ", 1e-6)):
        if value >= size:
            return f"{value / size:.3g} {unit}"
    return f"{value / 1e-9:.3g} n"


_SHOWN = 8  # ports in the text


def _listed(ports: list[Described]) -> str:
    texts = [
        v.name
        + (f"({','.join(v.dimensions)})" if v.dimensions else "")
        + (f" [{v.unit}]" if v.unit else "")
        for v in ports
    ]
    more = f" and {len(texts) - _SHOWN} more" if len(texts) > _SHOWN else ""
    return (", ".join(texts[:_SHOWN]) + more) or "none"
