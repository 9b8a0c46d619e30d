"""A finding: what is wrong with an FMU, how bad it is, where, and what to do about it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

import attrs

Severity = Literal["note", "warning", "error", "fatal"]
SEVERITIES: tuple[Severity, ...] = ("note", "warning", "error", "fatal")


@attrs.frozen
class Finding:
    """One thing that was found.

    Attributes
    ----------
    severity : {"note", "warning", "error", "fatal"}
        note: good to know; warning: works, but not as the standard says; error: a part of the FMU
        does not work; fatal: unsafe or unusable.
    code : str
        Names the kind of defect; the same defect has the same code in every version.
    place : str
        Archive entry, line of the description, variable, or FMI call.
    message : str
        What was expected and what was found.
    remedy : str
        What to do; empty if there is nothing to do.

    Examples
    --------
    >>> str(Finding("warning", "no-unit", "u", "it has no unit", "declare one"))
    'warning no-unit: u: it has no unit; declare one'
    """

    severity: Severity
    code: str
    place: str
    message: str
    remedy: str = ""

    def __str__(self) -> str:
        text = f"{self.place}: {self.message}" if self.place else self.message
        return f"{self.severity} {self.code}: {text}" + (f"; {self.remedy}" if self.remedy else "")


def worst(findings: Iterable[Finding]) -> Severity | None:
    """Return the highest severity; None if nothing was found.

    Examples
    --------
    >>> worst([Finding("note", "a", "", ""), Finding("error", "b", "", "")])
    'error'
    """
    return max((f.severity for f in findings), key=SEVERITIES.index, default=None)
