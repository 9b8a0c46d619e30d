"""The plots of the KPI page: deviations against the band, the worst line, valves, loads."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from posmas_fmi.expression import Array
from posmas_fmi.report.figures import DASHES, thin
from posmas_fmi.report.kpi_data import Controller, KpiRun, largest
from posmas_fmi.report.kpi_signals import Signals
from posmas_fmi.report.svg import BLACK, BLUE, CYCLE, GREY, ORANGE, SKY, VERMILION, look, to_svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Indices = np.ndarray[Any, np.dtype[np.intp]]

PANEL = (5.0, 2.6)  # inches
MOST_SAMPLES = 360  # of a band
LIMIT_DASH = (0, (5, 2.5))


def time_unit(time: Array) -> tuple[float, str]:
    """Return by how much to divide seconds, and the unit that is then shown."""
    span = float(time[-1] - time[0]) if time.size else 0.0
    if span >= 5400:
        return 3600.0, "h"
    return (60.0, "min") if span >= 300 else (1.0, "s")


def reach(run: KpiRun) -> float:
    """Return the deviation [K] that the axes of all controllers go to, the same for all."""
    worst = [largest(c.signals.deviation) for c in run.controllers if c.signals is not None]
    finite = [w for w in worst if w < 100.0]
    return 1.08 * max([1.3 * run.band, *finite])


def band_panel(run: KpiRun, signals: Signals, name: str, alt: str) -> str:
    """Draw the deviations of all lines as bands, with the limits and the worst line.

    Parameters
    ----------
    run : KpiRun
    signals : Signals
    name, alt : str
        As for `posmas_fmi.report.svg.to_svg`.

    Returns
    -------
    str
    """
    with look():
        figure, axes = _panel(signals, "deviation [K]")
        scale, _ = time_unit(signals.time)
        index = _stretches(len(signals.time))
        deviation = np.where(np.isfinite(signals.deviation), signals.deviation, np.nan)
        low, q1, median, q3, high = _quantiles(deviation, index)
        time = signals.time[index] / scale
        axes.fill_between(time, low, high, color=SKY, alpha=0.35, lw=0)
        axes.fill_between(time, q1, q3, color=BLUE, alpha=0.35, lw=0)
        axes.plot(time, median, color=BLUE)
        at, worst = thin(signals.time / scale, deviation[:, worst_line(signals)])
        axes.plot(at, worst, color=VERMILION, lw=1.0)
        for sign in (-1, 1):
            axes.axhline(sign * run.band, color=BLACK, lw=1.1, ls=LIMIT_DASH)
        limit = reach(run)
        axes.set_ylim(-limit, limit)
        return to_svg(figure, name, alt)


def worst_line(signals: Signals) -> int:
    """Index of the line with the largest modulus of its deviation."""
    finite = np.where(np.isfinite(signals.deviation), np.abs(signals.deviation), 0.0)
    return int(finite.max(axis=0).argmax()) if len(finite) else 0


def line_panel(run: KpiRun, shown: Sequence[Controller], line: int, name: str, alt: str) -> str:
    """Draw the deviation of one line under several controllers."""
    with look():
        first = shown[0].signals
        assert first is not None
        figure, axes = _panel(first, "deviation [K]")
        scale, _ = time_unit(first.time)
        for k, controller in enumerate(shown):
            signals = controller.signals
            assert signals is not None
            colour, dash = CYCLE[k % len(CYCLE)], DASHES[k // len(CYCLE) % 2]
            axes.plot(
                *thin(signals.time / scale, signals.deviation[:, line]),
                color=colour,
                ls=dash,
                label=controller.name,
            )
        for sign in (-1, 1):
            axes.axhline(sign * run.band, color=BLACK, lw=1.1, ls=LIMIT_DASH)
        limit = reach(run)
        axes.set_ylim(-limit, limit)
        axes.legend(loc="upper left", ncols=2, bbox_to_anchor=(0, -0.2))
        return to_svg(figure, name, alt)


def load_panel(signals: Signals, name: str, alt: str) -> str:
    """Draw the heat loads: range over the lines, mean, and that of the worst line."""
    assert signals.heat is not None
    with look():
        figure, axes = _panel(signals, "heat load [kW]")
        scale, _ = time_unit(signals.time)
        index = _stretches(len(signals.time))
        heat = signals.heat / 1e3
        low, _, _, _, high = _quantiles(heat, index)
        time = signals.time[index] / scale
        axes.fill_between(time, low, high, color=ORANGE, alpha=0.3, lw=0)
        axes.plot(*thin(signals.time / scale, heat.mean(axis=1)), color="#8a5a00")
        if signals.N > 1:
            axes.plot(
                *thin(signals.time / scale, heat[:, worst_line(signals)]), color=VERMILION, lw=0.9
            )
        axes.set_ylim(bottom=0)
        return to_svg(figure, name, alt)


def wear_panel(values: Sequence[tuple[str, Array]], label: str, name: str, alt: str) -> str:
    """Draw one mark per line and a bar at the mean, per controller, beside each other.

    Parameters
    ----------
    values : sequence of (str, (N,) array)
        Controller and its value per line.
    label : str
        Of the axis.
    name, alt : str
        As for `posmas_fmi.report.svg.to_svg`.

    Returns
    -------
    str
    """
    from matplotlib.figure import Figure

    with look():
        figure = Figure(figsize=(PANEL[0], max(1.4, 0.42 * len(values) + 0.8)))
        axes = figure.subplots()
        for k, (_, row) in enumerate(values):
            shown = row[np.isfinite(row)]
            spread = np.linspace(-0.22, 0.22, len(shown)) if len(shown) > 1 else np.zeros(1)
            if len(shown) > 120:  # more marks than can be told apart
                order = np.argsort(shown)[np.linspace(0, len(shown) - 1, 120).astype(int)]
                shown, spread = shown[order], spread[order]
            axes.barh(k, row[np.isfinite(row)].mean() if len(shown) else 0, 0.6, color=SKY, lw=0)
            axes.plot(shown, k + spread[: len(shown)], ls="none", marker=".", ms=4, color=BLUE)
        axes.set_yticks(range(len(values)), [name[:24] for name, _ in values])
        axes.set_ylim(len(values) - 0.4, -0.6)
        axes.set_xlim(left=0)
        axes.grid(axis="y", visible=False)
        axes.set_xlabel(label)
        return to_svg(figure, name, alt)


# ---------------------------------------------------------------------------------------------


def _panel(signals: Signals, label: str) -> tuple[Figure, Axes]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=PANEL)
    axes = figure.subplots()
    scale, unit = time_unit(signals.time)
    axes.set_xlabel(f"t [{unit}]")
    axes.set_ylabel(label)
    if signals.time.size > 1:
        axes.set_xlim(signals.time[0] / scale, signals.time[-1] / scale)
    axes.axhline(0, color=GREY, lw=0.6)
    return figure, axes


def _stretches(count: int) -> Indices:
    """Return where stretches of samples begin."""
    return np.unique(np.linspace(0, max(count - 1, 0), MOST_SAMPLES).astype(np.intp))[:count]


def _quantiles(values: Array, index: Indices) -> tuple[Array, ...]:
    """Extremes over the stretches, so that no peak is lost; quartiles at their first sample."""
    if not len(values):
        return tuple(np.empty(0) for _ in range(5))
    with np.errstate(all="ignore"):
        low = np.fmin.reduceat(np.fmin.reduce(values, axis=1), index)
        high = np.fmax.reduceat(np.fmax.reduce(values, axis=1), index)
    rows = values[index]
    empty = np.isnan(rows).all(axis=1, keepdims=True)
    filled = np.where(empty, 0.0, rows)
    q1, median, q3 = np.nanquantile(filled, (0.25, 0.5, 0.75), axis=1)
    return low, q1, median, q3, high
