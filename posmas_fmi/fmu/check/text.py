"""A preflight as text for the terminal."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator

from posmas_fmi.fmu.check.control import lines as control_lines
from posmas_fmi.fmu.check.finding import Finding
from posmas_fmi.fmu.check.preflight import Preflight, facts, measured

_WIDTH = 100
_SEVERITY = 9  # columns


def to_text(made: Preflight) -> str:
    """Return a preflight as lines: facts, findings (severity, code, place, message), summary.

    Control characters that an FMU put into its names are shown, not sent to the terminal.
    """
    lines = [str(made.path)]
    report = made.results.get("control", {})
    for label, text in (*facts(made), *measured(made), *control_lines(report)):
        lines += _wrapped(f"  {label:<16}", text)
    for finding in made.findings:
        lines += _finding(finding)
    if report.get("toml"):
        lines += ["", "# to paste into a scenario; the FMU beside it"]
        lines += [*report["toml"].rstrip().splitlines(), ""]
    counts = [
        f"{n} {word if n == 1 else words}"
        for severity, word, words in (
            ("fatal", "fatal finding", "fatal findings"),
            ("error", "error", "errors"),
            ("warning", "warning", "warnings"),
            ("note", "note", "notes"),
        )
        if (n := made.count(severity)) or severity == "error"
    ]
    lines.append(f"{made.verdict}: {', '.join(counts)}")
    return "\n".join(_plain(line) for line in lines)


def _finding(finding: Finding) -> Iterator[str]:
    start = f"  {finding.severity:<{_SEVERITY}}"
    place = f"{finding.place}: " if finding.place else ""
    yield from _wrapped(start, f"{finding.code}: {place}{finding.message}")
    if finding.remedy:
        yield from _wrapped(" " * len(start), f"-> {finding.remedy}")


def _wrapped(start: str, text: str) -> list[str]:
    return textwrap.wrap(
        text,
        _WIDTH,
        initial_indent=start,
        subsequent_indent=" " * len(start),
        break_long_words=False,
        break_on_hyphens=False,
    ) or [start.rstrip()]


def _plain(line: str) -> str:
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)
