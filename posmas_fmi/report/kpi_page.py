"""The KPI page of a cooling row: what an engineer decides from."""

from __future__ import annotations

import base64
import hashlib
import json
from importlib import resources
from typing import TYPE_CHECKING, Any

import attrs
import numpy as np

from posmas_fmi.report import kpi_figures, kpi_network, kpi_wording
from posmas_fmi.report.kpi_data import Controller, Kpi, KpiRun, alike
from posmas_fmi.report.network_drawing import MOST_NODES
from posmas_fmi.report.wording import show

if TYPE_CHECKING:
    from markupsafe import Markup

_NO_LIST = ("rms_K_by_line", "worst_K_by_line")


@attrs.frozen
class Cell:
    """One figure of one controller: the value, whether it is the best, and against practice."""

    value: str
    best: bool
    against: str
    tone: str  # "good", "bad", ""


@attrs.frozen
class Row:
    """One key figure over all controllers."""

    label: str
    unit: str
    cells: tuple[Cell, ...]


@attrs.frozen
class Panel:
    """A plot with its caption."""

    title: str
    caption: str
    plot: Markup


def render(run: KpiRun) -> str:
    """Return the HTML page of a comparison, or of one cooling run.

    Parameters
    ----------
    run : KpiRun

    Returns
    -------
    str
        One self-contained document. Its only script moves the slider of the network view.
    """
    import jinja2

    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["show"] = show
    files = resources.files(__package__)
    source = files.joinpath("kpi.html.j2").read_text(encoding="utf-8")
    script = files.joinpath("kpi.js").read_text(encoding="utf-8")
    style = files.joinpath("style.css").read_text(encoding="utf-8")
    digest = hashlib.sha256(script.encode()).digest()
    drawn = [c for c in run.controllers if c.signals is not None and c.signals.time.size]
    return environment.from_string(source).render(
        run=run,
        best=run.best,
        practice=run.controller(run.practice),
        style=_safe(style),
        script=_safe(script),
        script_hash=base64.b64encode(digest).decode(),
        headline=kpi_wording.headline(run),
        advice=kpi_wording.advice(run),
        tone=kpi_wording.tone(run),
        tiles=kpi_wording.tiles(run),
        rows=[_row(run, kpi) for kpi in run.kpis if kpi.key not in _NO_LIST],
        limits=[(limit, kpi_wording.limit_text(limit), _kept(run, limit)) for limit in run.limits],
        network=_network(run, drawn) if drawn else None,
        bands=[_band(run, c) for c in drawn],
        worst=_worst(run, drawn) if drawn else None,
        worst_rows=[_worst_row(c) for c in run.controllers],
        wear=_wear(drawn),
        loads=_loads(drawn),
        faults=[kpi_wording.fault(f) for f in run.faults],
        incidents=[kpi_wording.incident(i) for i in run.incidents],
        provenance=kpi_wording.provenance(run),
        most=max((c.signals.stride for c in drawn if c.signals is not None), default=1),
    )


def _safe(text: str) -> Markup:
    from markupsafe import Markup

    return Markup(text)


def _row(run: KpiRun, kpi: Kpi) -> Row:
    better = run.better(kpi)
    practice = run.controller(run.practice)
    base = practice.value(kpi.key) if practice else None
    cells = []
    for controller in run.controllers:
        value = controller.value(kpi.key)
        against, tone = "", ""
        if practice is not None and controller is not practice and kpi.better is not None:
            against, tone = _against(value, base, kpi.better)
        cells.append(Cell(_number(kpi, value), controller.name in better, against, tone))
    return Row(kpi.label, kpi.unit, tuple(cells))


def _number(kpi: Kpi, value: float | None) -> str:
    if value is None:
        return "never" if kpi.key.startswith("settling") else "–"
    if kpi.key == "worst_line":
        return f"{value:.0f}"
    return show(value)


def _against(value: float | None, base: float | None, better: str) -> tuple[str, str]:
    """Say how a figure compares with that of practice, and whether this is good or bad."""
    if value is None or base is None:
        return "", ""
    if alike(value, base):
        return "= as practice", ""
    good = (value < base) == (better == "low")
    word, tone = ("✓ better", "good") if good else ("✗ worse", "bad")
    if base and value / base > 3:
        word += f", {show(value / base, 2)} times"
    elif base and value / base >= 0:
        part = abs(value / base - 1)
        word += f", {100 * part:.0f} % {'less' if value < base else 'more'}"
    return word, tone


def _kept(run: KpiRun, limit: Any) -> list[tuple[bool | None, str]]:
    return [(c.kept.get(limit.name), show(c.value(limit.kpi))) for c in run.controllers]


def _network(run: KpiRun, drawn: list[Controller]) -> dict[str, Any]:
    times, moment = kpi_network.frames(run)
    main = run.best if run.best in drawn else drawn[0]
    beside = run.controller(run.practice)
    beside = beside if beside in drawn and beside is not main else None
    assert main.signals is not None
    picture = _safe(kpi_network.drawing(main.signals.network, main.signals.names))
    data = json.dumps(kpi_network.view_data(run, times), separators=(",", ":"))
    return {
        "main": main.name,
        "beside": beside.name if beside is not None else "",
        "picture": picture,
        "choices": [c.name for c in drawn],
        "moment": moment,
        "last": len(times) - 1,
        "data": _safe(data.replace("<", "\\u003c").replace("&", "\\u0026")),
        "palette": kpi_network.palette(33),
        "few": main.signals.N <= MOST_NODES,
        "N": main.signals.N,
    }


def _band(run: KpiRun, controller: Controller) -> Panel:
    signals = controller.signals
    assert signals is not None
    alt = kpi_wording.describe_band(run, controller)
    name = f"band-{run.controllers.index(controller)}"
    plot = _safe(kpi_figures.band_panel(run, signals, name, alt))
    line = signals.names[kpi_figures.worst_line(signals)]
    note = " · practice" if controller.name == run.practice else ""
    return Panel(f"{controller.name}{note}", f"Worst: line {line}.", plot)


def _worst(run: KpiRun, drawn: list[Controller]) -> Panel:
    """Draw the line that is worst under practice, under a choice of controllers."""
    practice = run.controller(run.practice)
    base = practice if practice in drawn and practice is not None else drawn[0]
    assert base.signals is not None
    line = kpi_figures.worst_line(base.signals)
    by_worst = sorted(drawn, key=lambda c: c.value("worst_K") or np.inf)
    chosen = list({c.name: c for c in [base, run.best, *by_worst] if c in drawn}.values())[:4]
    name = base.signals.names[line]
    alt = f"Deviation of line {name} over time with {', '.join(c.name for c in chosen)}."
    plot = _safe(kpi_figures.line_panel(run, chosen, line, "worst-line", alt))
    caption = f"The line that is worst with {base.name}, with up to four of the controllers."
    return Panel(f"Line {name}", caption, plot)


def _worst_row(controller: Controller) -> tuple[str, str, str, str, str]:
    signals = controller.signals
    if signals is None or not signals.time.size:
        line = controller.value("worst_line")
        name = "–" if line is None else f"{line:.0f}"
        return controller.name, name, show(controller.value("worst_K")), "–", "–"
    k = kpi_figures.worst_line(signals)
    column = np.nan_to_num(signals.deviation[:, k])
    at = int(np.abs(column).argmax())
    heat = "–" if signals.heat is None else show(float(signals.heat[at, k]) / 1e3)
    moment = kpi_wording.when(float(signals.time[at]))
    return controller.name, signals.names[k], show(float(column[at])), moment, heat


def _wear(drawn: list[Controller]) -> list[Panel]:
    from posmas_fmi.report.kpi_wear import MOST_LINES, cycles_per_hour, strokes_per_hour

    panels = []
    for key, title, label, of in (
        ("valve", "Valve travel", "full strokes per hour", strokes_per_hour),
        ("case", "Thermal cycles of the case", "cycles of 2 K or more per hour", cycles_per_hour),
    ):
        values = [
            (c.name, of(c.signals.time, data))
            for c in drawn
            if c.signals is not None and (data := getattr(c.signals, key)) is not None
        ]
        if values:
            means = ", ".join(f"{name} {show(float(np.nanmean(row)))}" for name, row in values)
            alt = f"{title}, {label}, mean over the lines: {means}."
            plot = _safe(kpi_figures.wear_panel(values, label, f"wear-{key}", alt))
            lines = max(c.signals.N for c in drawn if c.signals is not None)
            dots = "A dot per line"
            if key == "case" and lines > MOST_LINES:
                dots = f"A dot for each of {MOST_LINES} of the {lines} lines, evenly chosen"
            panels.append(Panel(title, f"{dots}, a bar at their mean.", plot))
    return panels


def _loads(drawn: list[Controller]) -> Panel | None:
    with_heat = [c for c in drawn if c.signals is not None and c.signals.heat is not None]
    if not with_heat:
        return None
    signals = with_heat[0].signals
    assert signals is not None
    assert signals.heat is not None
    total = signals.heat.sum(axis=1) / 1e3
    alt = (
        f"Heat loads of {signals.N} lines; together between {show(float(total.min()))} and "
        f"{show(float(total.max()))} kW."
    )
    plot = _safe(kpi_figures.load_panel(signals, "loads", alt))
    extra = "" if signals.N == 1 else " Red: the worst line. Brown: the mean."
    return Panel("Heat loads", f"The same for every controller.{extra}", plot)
