"""The plots over time and the sector plot: one function per figure, each returns an SVG element."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from posmas_fmi.expression import Array
from posmas_fmi.report.data import Run
from posmas_fmi.report.svg import (
    BLACK,
    BLUE,
    CYCLE,
    GREY,
    SKY,
    VERMILION,
    look,
    power_of_ten,
    to_svg,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_LINES = 12  # agents up to which each has a line of its own; beyond, bands
MOST_POINTS = 700  # per line: about two per pixel
LEAST = 0.1  # part of the agents that the bands of a logarithmic plot leave out: they cross zero
PANEL = (5.0, 2.75)  # inches
DASHES = ("solid", (0, (4.0, 1.4)))

# A plot cannot show more; far beyond it matplotlib's transforms overflow.
LARGEST_SHOWN = 1e60
FAULT = "#f6e3cf"  # behind the lines while a fault holds
FLOOR = 1e-16  # of the first error, under which a logarithmic plot shows rounding only


def line_look(i: int) -> tuple[str, str]:
    """Colour and name of the dash pattern of agent i."""
    return CYCLE[i % len(CYCLE)], ("solid", "dashed")[i // len(CYCLE) % 2]


def index_of(k: int, count: int) -> str:
    """Subscript of component k (from 0) out of count; nothing if there is only one."""
    digits = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")
    return "" if count == 1 else str(k + 1).translate(digits)


def state_panel(run: Run, values: Array, k: int, symbol: str, name: str, alt: str) -> str:
    """Draw component k of the states or estimates of all agents, against the leader.

    Parameters
    ----------
    run : Run
    values : (T, N, m) array
    k : int
    symbol : str
        ``x`` or ``x̂``, for the axis.
    name, alt : str
        As for `posmas_fmi.report.svg.to_svg`.

    Returns
    -------
    str
    """
    with look():
        figure, axes = _panel(run, f"{symbol}{index_of(k, run.m)}", run.units.get("x", ""))
        largest = _largest(values[:, :, k])
        leader = _largest(run.s[:, k])
        _agents(axes, run, values[:, :, k])
        axes.plot(*thin(run.time, run.s[:, k]), color=BLACK, lw=1.5, ls=(0, (1.2, 1.2)))
        if largest > 1e3 * max(leader, 1e-300):
            _symlog(axes, leader or 1.0)
        _mark_loss(axes, run)
        return to_svg(figure, name, alt)


def error_panel(
    run: Run, error: Array, k: int, symbol: str, rate: float | None, name: str, alt: str
) -> str:
    """Draw the modulus of component k of an error on a logarithmic scale.

    Parameters
    ----------
    run : Run
    error : (T, N, m) array
    k : int
    symbol : str
        For the axis.
    rate : float or None
        Proved rate [1/s]; its slope is drawn where it is positive.
    name, alt : str
        As for `posmas_fmi.report.svg.to_svg`.

    Returns
    -------
    str
    """
    with look():
        label = f"|{symbol}{index_of(k, run.m)}|"
        figure, axes = _panel(run, label, run.units.get("x", ""))
        modulus = np.abs(error[:, :, k])
        _agents(axes, run, modulus, least=LEAST)
        _guide(axes, run, modulus, rate)
        _log(axes, modulus)
        _mark_loss(axes, run)
        return to_svg(figure, name, alt)


def output_panel(run: Run, k: int, name: str, alt: str) -> str:
    """Draw output k of all agents: what there is when a plant does not show its state."""
    with look():
        count = run.y.shape[2]
        figure, axes = _panel(run, f"y{index_of(k, count)}", run.units.get("y", ""))
        _agents(axes, run, run.y[:, :, k])
        if _largest(run.y[:, :, k]) > 1e6:
            _symlog(axes, 1.0)
        _mark_loss(axes, run)
        return to_svg(figure, name, alt)


def input_panel(run: Run, k: int, name: str, alt: str) -> str:
    """Draw input k of all agents."""
    with look():
        figure, axes = _panel(run, f"u{index_of(k, run.p)}", run.units.get("u", ""))
        _agents(axes, run, run.u[:, :, k])
        if _largest(run.u[:, :, k]) > 1e6:
            _symlog(axes, 1.0)
        _mark_loss(axes, run)
        return to_svg(figure, name, alt)


def recorded_panel(run: Run, label: str, name: str, alt: str) -> str:
    """Draw what was recorded besides: of all agents, or one line of the run."""
    with look():
        figure, axes = _panel(run, label, run.units.get(label, ""))
        values = run.recorded[label]
        if values.ndim == 1:
            axes.plot(*thin(run.time, values), color=BLUE)
        else:
            _agents(axes, run, values)
        if _largest(values) > 1e9:
            _symlog(axes, 1.0)
        _mark_loss(axes, run)
        return to_svg(figure, name, alt)


def sector_panel(run: Run, k: int, name: str, alt: str) -> str:
    """Draw ``sec(u)`` against ``u`` for input k, with the sector ``[m_l, m_h]``."""
    assert run.sec_u is not None
    with look():
        figure, axes = _figure()
        u, force = run.u[:, :, k].ravel(), run.sec_u[:, :, k].ravel()
        finite = np.isfinite(u) & np.isfinite(force)
        u, force = np.clip([u[finite], force[finite]], -LARGEST_SHOWN, LARGEST_SHOWN)
        chosen = _spread(u)
        reach = 1.08 * max(_largest(u), 1e-12)
        wide = reach > 1e6
        grid = np.geomspace(1e-3, reach, 120) if wide else np.array([0.0, reach])
        grid = np.concatenate([-grid[::-1], grid])
        if run.design.sector is not None:
            _cone(axes, grid, *run.design.sector, wide)
        axes.plot(u[chosen], force[chosen], ls="none", marker=".", ms=4, mew=0, color=VERMILION)
        if wide:
            _symlog(axes, 1.0)
            axes.set_xscale("symlog", linthresh=1.0)
            _decades(axes.xaxis)
        axes.axhline(0, color=GREY, lw=0.6)
        axes.axvline(0, color=GREY, lw=0.6)
        subscript = index_of(k, run.p)
        axes.set_xlabel(f"u{subscript}{_unit(run.units.get('u', ''))}")
        axes.set_ylabel(f"sec(u{subscript}){_unit(run.units.get('sec_u', ''))}")
        return to_svg(figure, name, alt)


def baseline_panel(run: Run, name: str, alt: str) -> str:
    """Draw the largest tracking error over agents and states, designed gains against K = 0."""
    assert run.baseline_error is not None
    with look():
        figure, axes = _panel(run, "largest |x − s|", run.units.get("x", ""))
        both = []
        for error, colour, dash, text in (
            (run.baseline_error, VERMILION, DASHES[1], "K = 0"),
            (run.tracking_error, BLUE, DASHES[0], "designed K"),
        ):
            modulus = np.abs(error).max(axis=(1, 2))
            both.append(modulus)
            axes.plot(*thin(run.time, _positive(modulus)), color=colour, ls=dash, label=text)
        _log(axes, np.stack(both, axis=1))
        axes.legend(loc="best")
        return to_svg(figure, name, alt)


# ---------------------------------------------------------------------------------------------
# parts of figures


def _figure() -> tuple[Figure, Axes]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=PANEL)
    return figure, figure.subplots()


def _panel(run: Run, label: str, unit: str) -> tuple[Figure, Axes]:
    figure, axes = _figure()
    axes.set_xlabel(f"t{_unit(run.units.get('time', 's'))}")
    axes.set_ylabel(label + _unit(unit))
    if run.time.size > 1:
        axes.set_xlim(run.time[0], run.time[-1])
    for begin, end in faulty(run):
        axes.axvspan(begin, end, facecolor=FAULT, edgecolor="none", zorder=0)
    return figure, axes


def faulty(run: Run) -> list[tuple[float, float]]:
    """Return when faults of the scenario hold, as far as the run went [s]."""
    spans = []
    for fault in run.summary.faults:
        begin = run.time[0] if fault.begin is None else fault.begin
        end = run.until if fault.end is None else min(fault.end, run.until)
        if np.isfinite([begin, end]).all() and begin < end:
            spans.append((float(begin), float(end)))
    return spans


def _unit(unit: str) -> str:
    return f" [{unit[:16]}]" if unit and unit != "1" else ""


def _largest(values: Array) -> float:
    finite = np.abs(values[np.isfinite(values)])
    return float(min(finite.max(initial=0.0), LARGEST_SHOWN))


def _agents(axes: Axes, run: Run, values: Array, least: float = 0.0) -> None:
    """Draw one line per agent, or bands when there are too many.

    ``values`` is (T, N); the bands leave out the fraction ``least`` of the smallest values.
    """
    if run.N > MOST_LINES:
        _bands(axes, run, values, least)
        return
    for i in range(run.N):
        colour, dash = line_look(i)
        time, line = thin(run.time, values[:, i])
        marker = "." if len(run.time) < 3 else None
        axes.plot(time, line, color=colour, ls=DASHES[dash == "dashed"], marker=marker)
        ends = np.flatnonzero(np.isfinite(line))
        if ends.size and not np.isfinite(values[-1, i]):
            axes.plot(time[ends[-1]], line[ends[-1]], marker="X", ms=6, color=colour)


def _bands(axes: Axes, run: Run, values: Array, least: float) -> None:
    """Draw all agents, the middle half, the median, and the agent with the largest final error."""
    index = np.unique(np.linspace(0, len(run.time) - 1, 400).astype(int))
    time, rows = run.time[index], _shown(values[index])
    seen = np.isfinite(rows).any(axis=1)
    time, rows = time[seen], rows[seen]
    if time.size:
        low, q1, median, q3, high = np.nanquantile(rows, (least, 0.25, 0.5, 0.75, 1), axis=1)
        axes.fill_between(time, low, high, color=SKY, alpha=0.28, lw=0)
        axes.fill_between(time, q1, q3, color=BLUE, alpha=0.35, lw=0)
        axes.plot(time, median, color=BLUE)
    axes.plot(*thin(run.time, values[:, run.worst]), color=VERMILION, lw=1.1)


def _shown(values: Array) -> Array:
    """Clip to what can be drawn; NaN stays NaN, infinity ends a line."""
    return np.where(np.isfinite(values), np.clip(values, -LARGEST_SHOWN, LARGEST_SHOWN), np.nan)


def _positive(values: Array) -> Array:
    return np.where(values > 0, values, np.nan)


def thin(time: Array, values: Array) -> tuple[Array, Array]:
    """Return the lowest and the highest sample of every stretch, so that no peak is lost."""
    values = _shown(values)
    if len(time) <= MOST_POINTS:
        return time, values
    edges = np.linspace(0, len(time), MOST_POINTS // 2 + 1).astype(int)[:-1]
    widths = np.diff(np.append(edges, len(time)))
    keep = [np.array([0, len(time) - 1])]
    for extreme, filler in ((np.fmin, np.inf), (np.fmax, -np.inf)):
        filled = np.where(np.isnan(values), filler, values)
        hit = filled == np.repeat(extreme.reduceat(filled, edges), widths)
        first = np.flatnonzero(hit)
        stretch = np.searchsorted(edges, first, side="right")
        keep.append(first[np.unique(stretch, return_index=True)[1]])
    index = np.unique(np.concatenate(keep))
    return time[index], values[index]


def _cone(axes: Axes, grid: Array, low: float, high: float, wide: bool) -> None:
    axes.fill_between(grid, low * grid, high * grid, color=SKY, alpha=0.3, lw=0)
    for slope in (low, high):
        axes.plot(grid, slope * grid, color=BLUE, lw=0.9, ls=(0, (5, 2)))
    at = 0.62 * grid[-1]
    labels = [
        (f"m_l = {low:g}", low, (7, -2), "left", "top"),
        (f"m_h = {high:g}", high, (-7, 2), "right", "bottom"),
    ]
    if wide:  # the two lines are one on a logarithmic scale
        labels = [(f"m_l = {low:g}, m_h = {high:g}", high, (-24, 4), "right", "center")]
    for text, slope, offset, ha, va in labels:
        axes.annotate(text, (at, slope * at), offset, textcoords="offset points", ha=ha, va=va,
                      color=BLUE)  # fmt: skip


def _spread(u: Array) -> Array:
    """Choose samples that show where inputs are often and how far they reach."""
    if not u.size:
        return np.empty(0, dtype=int)
    order = np.argsort(u, kind="stable")
    often = np.linspace(0, u.size - 1, 250).astype(int)
    far = np.searchsorted(u[order], np.linspace(u.min(), u.max(), 250)).clip(max=u.size - 1)
    return np.asarray(order[np.unique(np.concatenate([often, far]))])


def _guide(axes: Axes, run: Run, modulus: Array, rate: float | None) -> None:
    """Draw the slope of the proved rate, starting from the largest first value."""
    first = modulus[0][np.isfinite(modulus[0])] if len(modulus) else np.empty(0)
    if rate is None or not 0 < rate < math.inf or not first.max(initial=0.0) > 0 or run.N == 0:
        return
    time = np.array([run.time[0], run.time[-1]])
    line = first.max() * np.exp(-np.minimum(rate * (time - time[0]), 600.0))
    axes.plot(time, line, color=GREY, lw=1.0, ls=(0, (6, 3)), zorder=1.5)


def _log(axes: Axes, modulus: Array) -> None:
    finite = modulus[np.isfinite(modulus) & (modulus > 0)]
    if not finite.size:
        axes.text(0.5, 0.5, "zero throughout", transform=axes.transAxes, ha="center", color=GREY)
        return
    top = min(float(finite.max()), LARGEST_SHOWN)
    first = modulus[0][np.isfinite(modulus[0])].max(initial=0.0)
    rounding = FLOOR * (min(float(first), top) or top)
    bottom = max(float(finite.min()), rounding, 1e-300)
    axes.set_yscale("log", nonpositive="mask")
    axes.set_ylim(bottom / 2, top * 3)
    _decades(axes.yaxis)


def _symlog(axes: Axes, threshold: float) -> None:
    linear = 10.0 ** math.ceil(math.log10(min(max(threshold, 1e-12), 1e12)))
    axes.set_yscale("symlog", linthresh=linear)
    _decades(axes.yaxis)
    axes.set_ylabel(f"{axes.get_ylabel()}  (log beyond ±{linear:g})")


def _decades(axis: object) -> None:
    """At most seven powers of ten as ticks, written without mathtext."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    low, high = axis.get_view_interval()  # type: ignore[attr-defined]
    linear = getattr(axis.get_transform(), "linthresh", 0.0)  # type: ignore[attr-defined]
    ticks: list[float] = []
    if linear:
        first, last = math.log10(linear), math.log10(max(abs(low), abs(high), 10 * linear))
        step = max(1, math.ceil((last - first) / 3))
        crowded = last - first > 3  # the threshold would touch the zero
        powers = 10.0 ** np.arange(first + step * crowded, last + 1e-9, step)
        both = np.concatenate([-powers[::-1], [0.0], powers])
        ticks = [t for t in both if low <= t <= high]
    elif low > 0:
        first, last = math.ceil(math.log10(low) - 1e-9), math.floor(math.log10(high) + 1e-9)
        ticks = [10.0**e for e in range(first, last + 1, max(1, math.ceil((last - first) / 6)))]
    axis.set_major_locator(FixedLocator(ticks))  # type: ignore[attr-defined]
    axis.set_minor_locator(NullLocator())  # type: ignore[attr-defined]
    axis.set_major_formatter(FuncFormatter(power_of_ten))  # type: ignore[attr-defined]


def _mark_loss(axes: Axes, run: Run) -> None:
    if run.first_lost is None:
        return
    agent, time = run.first_lost
    axes.axvline(time, color=VERMILION, lw=1.0, ls=(0, (2, 2)))
    right = run.time.size > 1 and time < run.time[0] + 0.55 * (run.time[-1] - run.time[0])
    axes.annotate(
        f"agent {run.names[agent][:16]} lost, t = {time:.3g}",
        (time, 1.0),
        (0, 2),
        xycoords=("data", "axes fraction"),
        textcoords="offset points",
        ha="left" if right else "right",
        va="bottom",
        color="#a34700",
        fontsize=8,
    )
