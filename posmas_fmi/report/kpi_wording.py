"""The sentences of the KPI page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from posmas_fmi.report.json_files import inputs_text
from posmas_fmi.report.kpi_data import Controller, KpiRun, Limit, alike
from posmas_fmi.report.kpi_figures import worst_line
from posmas_fmi.report.wording import join, show


def when(seconds: float) -> str:
    """Write a time for a reader.

    Examples
    --------
    >>> when(5.0), when(125.0), when(7230.0)
    ('5 s', '2 min 5 s', '2 h 0 min 30 s')
    """
    total = round(seconds)
    h, minutes, s = total // 3600, total // 60 % 60, total % 60
    parts = [f"{h} h"] * (h > 0) + [f"{minutes} min"] * (h > 0 or minutes > 0)
    return " ".join([*parts, *[f"{s} s"] * (s > 0 or not parts)])


def tone(run: KpiRun) -> str:
    """``good``, ``caution`` or ``bad``: the colour of the box, never the only sign."""
    if run.best.broken == 0:
        return "good"
    return "bad" if run.best.broken == len(run.limits) else "caution"


def headline(run: KpiRun) -> str:
    """One sentence: which controller, whether the limits are kept, how far from the set-point."""
    best = run.best
    worst = f"worst deviation {show(best.value('worst_K'))} K"
    limits = _limits(best, run)
    if len(run.controllers) == 1:
        return f"{best.name} {limits}; {worst}."
    if best.name == run.practice:
        return f"Stay with practice: {best.name} {limits}, {worst}, and no other is clearly better."
    practice = run.controller(run.practice)
    if practice is None:
        return f"{best.name} is the best of {len(run.controllers)}: it {limits}; {worst}."
    theirs = practice.value("worst_K")
    return (
        f"{best.name} is better than practice ({practice.name}): it {limits}; "
        f"{worst} against {show(theirs)} K."
    )


def _limits(controller: Controller, run: KpiRun) -> str:
    broken = [limit.name for limit in run.limits if controller.kept.get(limit.name) is False]
    if not run.limits:
        return "was run without stated limits"
    if not broken:
        unknown = sum(kept is None for kept in controller.kept.values())
        return "keeps every limit" + (f" that is known ({unknown} unknown)" if unknown else "")
    return f"breaks the limit {join([f'“{b}”' for b in broken])}"


def advice(run: KpiRun) -> str:
    """Say what else counts for the decision."""
    best, practice = run.best, run.controller(run.practice)
    parts = []
    if practice is not None and best is not practice:
        for key, more, less in (
            ("rms_K", "its RMS deviation is larger", "its RMS deviation is smaller"),
            ("valve_strokes_per_h", "its valves travel more", "its valves travel less"),
            ("spread_K", "the lines differ more", "the lines differ less"),
        ):
            ours, theirs = best.value(key), practice.value(key)
            if ours is not None and theirs is not None and not alike(ours, theirs):
                text = more if ours > theirs else less
                parts.append(f"{text} ({show(ours)} against {show(theirs)})")
    messages = best.value("messages_per_h")
    if messages:
        parts.append(f"it needs {show(messages)} messages per hour")
    text = f"{join(parts)[:1].upper()}{join(parts)[1:]}. " if parts else ""
    return text + "One run is evidence for these loads only; another load may rank otherwise."


def tiles(run: KpiRun) -> list[tuple[str, str, str, str]]:
    """Return the four figures that decide, of the best controller: name, value, text, tone."""
    best, practice = run.best, run.controller(run.practice)

    def tile(name: str, key: str, unit: str, low: bool = True) -> tuple[str, str, str, str]:
        value = best.value(key)
        text, colour = "", "plain"
        if practice is not None and practice is not best:
            base = practice.value(key)
            text = f"{practice.name}: {show(base)} {unit}".strip()
            if value is not None and base is not None and not alike(value, base):
                colour = "good" if (value < base) == low else "caution"
        return name, f"{show(value)} {unit}".strip(), text, colour

    kept = sum(k is True for k in best.kept.values())
    unknown = sum(k is None for k in best.kept.values())
    note = f"{best.name}; {unknown} not known" if unknown else best.name
    limits = ("Limits kept", f"{kept} of {len(run.limits)}", note, tone(run))
    return [
        limits,
        tile("Worst deviation", "worst_K", "K"),
        tile("Spread between lines", "spread_K", "K"),
        tile("Valve travel", "valve_strokes_per_h", "strokes/h"),
    ]


def limit_text(limit: Limit) -> str:
    """Say what a limit asks for."""
    sign = "≥" if limit.above else "≤"
    text = f"{limit.text}: " if limit.text else ""
    return f"{text}{sign} {show(limit.limit)} {limit.unit}".strip()


def describe_band(run: KpiRun, controller: Controller) -> str:
    """Alternative text of the deviations of one controller."""
    signals = controller.signals
    assert signals is not None
    finite = signals.deviation[np.isfinite(signals.deviation)]
    if not finite.size:
        return f"Deviations with {controller.name}: no values."
    outside = float(np.mean(np.abs(finite) > run.band))
    return (
        f"Deviation of the supply temperatures of {signals.N} lines from their set-point with "
        f"{controller.name}, from {show(float(finite.min()))} to {show(float(finite.max()))} K; "
        f"{100 * outside:.3g} % of the samples are outside ±{run.band:g} K. "
        f"The worst is line {signals.names[worst_line(signals)]}."
    )


def fault(row: Mapping[str, Any]) -> tuple[str, str, str, str, str]:
    """Return kind, agent, span, detail, and whether a certificate covers it, as text."""
    start, end = row.get("from"), row.get("until")
    span = "–" if not isinstance(start, int | float) else f"from {when(start)}"
    if isinstance(end, int | float):
        span += f" to {when(end)}"
    covered = row.get("covered")
    text = covered if isinstance(covered, str) else {True: "yes", False: "no"}.get(covered, "–")  # type: ignore[arg-type]
    return _text(row, "kind"), _text(row, "agent"), span, _text(row, "detail"), text


def incident(row: Mapping[str, Any]) -> tuple[str, str, str, str, str]:
    """Return agent, time, call, verdict with inputs, and action, as text."""
    time = row.get("time")
    moment = when(time) if isinstance(time, int | float) else "–"
    inputs, fmu, detail = row.get("inputs"), row.get("fmu"), row.get("detail")
    given = f" (inputs {inputs_text(inputs)})" if isinstance(inputs, dict) and inputs else ""
    return (
        _text(row, "agent"),
        moment,
        _text(row, "call") + (f" of {fmu}" if fmu else ""),
        _text(row, "verdict") + given,
        _text(row, "action") + (f": {detail}" if detail else ""),
    )


def _text(row: Mapping[str, Any], key: str) -> str:
    value = row.get(key)
    return "–" if value is None or value == "" else str(value)


def provenance(run: KpiRun) -> list[tuple[str, str]]:
    """Return the manifest as rows, long texts left out."""
    rows = []
    for key, value in run.manifest.items():
        if isinstance(value, dict):
            rows += [(f"{key} › {k}", str(v)) for k, v in value.items() if not isinstance(v, dict)]
        elif not (isinstance(value, str) and "\n" in value):
            rows.append((key, str(value)))
    return rows
