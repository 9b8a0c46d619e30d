"""The figures that a cooling row is judged by."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import attrs
import numpy as np
from numpy.typing import ArrayLike

from posmas_fmi.cooling.classes import exceedance
from posmas_fmi.errors import InputError
from posmas_fmi.expression import Array

BAND = 1.0  # K around the set-point that cooling units are specified to hold
NOMINAL_PRESSURE = 100e3  # Pa across the primary circuit of a line at header 1 (assumed)
WATER_DENSITY = 995.0  # kg/m³ at 32 °C
_END = 0.1  # part of the run that "at the end" is the mean over
_LEAST_CYCLE = 2.0  # K: smaller swings of the case do not count as thermal cycles


@attrs.frozen(eq=False)
class KeyFigures:
    """Key figures of a run; arrays have one value per line, (N,).

    Attributes
    ----------
    rms : float
        Deviation of the supply temperature from its set-point, over all lines and times [K].
    worst : float
        Largest modulus of the deviation [K].
    over : float
        Largest deviation upwards [K].
    exceedance_band : float
        Deviation beyond ±1 K, summed over the lines [K·s].
    exceedance_class : float or None
        Facility supply above the limit of its class [K·s].
    spread, spread_end : float
        Warmest line minus coolest: the largest, and the mean over the last tenth of the run [K].
    settling : float
        From when on every line stays within ±1 K, from the start [s]; inf if not.
    strokes_per_hour : float or None
        Valve travel in full strokes, mean over the lines [1/h].
    cycles_per_hour : float or None
        Thermal cycles of the case of 2 K or more, mean over the lines [1/h].
    hottest_case : float or None
        [K].
    pump_energy : float or None
        Hydraulic energy of the facility water through the valves, sum of the lines [J].
    messages_per_hour : float or None
        Over the network.
    lowest : float
        Lowest temperature above the facility supply, of any line [K].
    lowest_supply : float
        Lowest supply temperature, of any line [K].
    rms_by_line, worst_by_line : (N,) ndarray
        As above, of each line.
    """

    rms: float
    worst: float
    over: float
    exceedance_band: float
    exceedance_class: float | None
    spread: float
    spread_end: float
    settling: float
    strokes_per_hour: float | None
    cycles_per_hour: float | None
    hottest_case: float | None
    pump_energy: float | None
    messages_per_hour: float | None
    lowest: float
    lowest_supply: float
    rms_by_line: Array
    worst_by_line: Array

    @property
    def worst_line(self) -> int:
        """Index of the line with the largest deviation."""
        return int(self.worst_by_line.argmax())

    def as_dict(self) -> dict[str, Any]:
        """Return the figures of the row as plain numbers, for JSON; None where not known."""
        figures = attrs.asdict(self, filter=lambda a, _: not a.name.endswith("_by_line"))
        figures["settling"] = self.settling if np.isfinite(self.settling) else None
        return figures | {"worst_line": self.worst_line + 1}


def key_figures(
    time: ArrayLike,
    supply: ArrayLike,
    set_point: ArrayLike,
    facility: ArrayLike,
    valve: ArrayLike | None = None,
    case: ArrayLike | None = None,
    class_limit: float | None = None,
    messages: int | None = None,
    flow: ArrayLike | None = None,
    header: ArrayLike | None = None,
) -> KeyFigures:
    """Compute the key figures of a run.

    Parameters
    ----------
    time : (n,) array_like
        Increasing [s]; values are straight lines between.
    supply : (n, N) array_like
        Supply temperatures [K]; an xarray.DataArray of dimensions (time, agent) will do.
    set_point : array_like
        Broadcast against `supply` [K]; of shape (n,) it is one for all lines.
    facility : array_like
        Facility supply [K], a number, (n,) or (n, N).
    valve : (n, N) array_like, optional
        Positions, 0 to 1.
    case : (n, N) array_like, optional
        Case temperatures [K].
    class_limit : float, optional
        From `posmas_fmi.cooling.classes.class_limit` [K].
    messages : int, optional
        Sent during the run.
    flow : (n, N) array_like, optional
        Facility water of each line [kg/s].
    header : array_like, optional
        Pressure across the primary circuits, 1 nominal; a number, (n,) or (n, N); 1 by default.

    Raises
    ------
    InputError
        If shapes do not fit, there are fewer than two times, or a value is not finite.

    Examples
    --------
    >>> figures = key_figures([0.0, 60.0], [[311.0, 310.0], [310.0, 310.0]], 310.0, 305.0)
    >>> figures.worst, figures.spread, figures.settling, figures.worst_line
    (1.0, 1.0, 0.0, 0)
    """
    time = np.asarray(time, dtype=float)
    supply = _series(supply, time, "supply")
    n, lines = supply.shape
    error = supply - _column(set_point, n, "set_point")
    water = _column(facility, n, "facility")
    water = np.broadcast_to(water, (n, water.shape[1]))
    hours = (time[-1] - time[0]) / 3600
    squares = _mean(time, error**2)
    spread = np.ptp(supply, axis=1)
    end = time >= time[-1] - _END * (time[-1] - time[0])
    beyond = exceedance(time, error, BAND) + exceedance(time, -error, BAND)
    strokes = cycles = hottest = None
    if valve is not None:
        travel = np.abs(np.diff(_series(valve, time, "valve", lines), axis=0)).sum(axis=0)
        strokes = float(travel.mean() / hours)
    if case is not None:
        cases = _series(case, time, "case", lines)
        cycles = float(np.mean([thermal_cycles(c) for c in cases.T]) / hours)
        hottest = float(cases.max())
    return KeyFigures(
        rms=float(np.sqrt(squares.mean())),
        worst=float(np.abs(error).max()),
        over=float(error.max()),
        exceedance_band=float(beyond.sum()),
        exceedance_class=None
        if class_limit is None
        else float(exceedance(time, water.max(axis=1), class_limit)),
        spread=float(spread.max()),
        spread_end=float(spread[end].mean()),
        settling=settling_time(time, np.abs(error).max(axis=1), BAND),
        strokes_per_hour=strokes,
        cycles_per_hour=cycles,
        hottest_case=hottest,
        pump_energy=None
        if flow is None
        else _pump_energy(time, _series(flow, time, "flow", lines), header),
        messages_per_hour=None if messages is None else messages / hours,
        lowest=float((supply - water).min()),
        lowest_supply=float(supply.min()),
        rms_by_line=np.sqrt(squares),
        worst_by_line=np.abs(error).max(axis=0),
    )


def _pump_energy(time: Array, flow: Array, header: ArrayLike | None) -> float:
    """Pressure times volume flow, over lines and time [J]."""
    relative = _column(1.0 if header is None else header, len(time), "header")
    power = NOMINAL_PRESSURE * relative * flow / WATER_DENSITY
    return float(_mean(time, power).sum() * (time[-1] - time[0]))


def settling_time(time: ArrayLike, deviation: ArrayLike, band: float) -> float:
    """Return the time from the start after which a deviation stays within ±band; inf if never.

    Examples
    --------
    >>> settling_time([0.0, 1.0, 2.0, 3.0], [5.0, -0.5, 2.0, 0.1], 1.0)
    3.0
    """
    time = np.asarray(time, dtype=float)
    outside = np.flatnonzero(np.abs(np.asarray(deviation, dtype=float)) > band)
    if not outside.size:
        return 0.0
    last = int(outside[-1])
    return float("inf") if last == len(time) - 1 else float(time[last + 1] - time[0])


def rainflow(values: ArrayLike) -> Array:
    """Count the cycles in a series by the rainflow method.

    Parameters
    ----------
    values : (n,) array_like

    Returns
    -------
    (cycles, 3) ndarray
        Range, mean and count (1, or 0.5 for a half cycle) of each.

    References
    ----------
    ASTM E1049-85, section 5.4.4.

    Examples
    --------
    >>> rainflow([0.0, 3.0, 1.0, 2.0, 0.0]).tolist()
    [[1.0, 1.5, 1.0], [3.0, 1.5, 0.5], [3.0, 1.5, 0.5]]
    """
    cycles: list[tuple[float, float, float]] = []
    stack: list[float] = []

    def count(a: float, b: float, weight: float) -> None:
        cycles.append((abs(a - b), (a + b) / 2, weight))

    for point in _reversals(np.asarray(values, dtype=float)):
        stack.append(point)
        while len(stack) >= 3 and abs(stack[-1] - stack[-2]) >= abs(stack[-2] - stack[-3]):
            if len(stack) == 3:  # the range holds the start of the series
                count(stack[0], stack[1], 0.5)
                del stack[0]
            else:
                count(stack[-3], stack[-2], 1.0)
                del stack[-3:-1]
    for a, b in pairwise(stack):
        count(a, b, 0.5)
    return np.array(cycles, dtype=float).reshape(-1, 3)


def thermal_cycles(case: ArrayLike, least: float = _LEAST_CYCLE) -> float:
    """Return how many cycles of `least` kelvin or more a case temperature goes through.

    Examples
    --------
    >>> thermal_cycles([330.0, 340.0, 330.0, 330.5, 330.0])
    1.0
    """
    found = rainflow(case)
    return float(found[found[:, 0] >= least, 2].sum())


def _reversals(values: Array) -> list[float]:
    """First value, turning points and last value."""
    moving = values[np.concatenate([[True], np.diff(values) != 0])]
    if len(moving) < 3:
        return [float(v) for v in moving]
    turns = np.diff(np.sign(np.diff(moving))) != 0
    return [float(v) for v in moving[np.concatenate([[True], turns, [True]])]]


def _mean(time: Array, values: Array) -> Array:
    """Return the mean over time by the trapezium rule."""
    step = np.diff(time)[:, None]
    return np.asarray((step * (values[:-1] + values[1:]) / 2).sum(axis=0) / step.sum())


def _series(values: ArrayLike, time: Array, name: str, lines: int | None = None) -> Array:
    array = np.asarray(values, dtype=float)
    if time.ndim != 1 or len(time) < 2:
        raise InputError(f"expected two times or more (got shape {time.shape})", "time")
    if array.ndim != 2 or len(array) != len(time) or (lines or array.shape[1]) != array.shape[1]:
        wanted = f"({len(time)}, {lines or 'N'})"
        raise InputError(f"expected shape {wanted} (got {array.shape})", name)
    if not np.isfinite(array).all():
        raise InputError("expected finite values; leave out what was not recorded", name)
    return array


def _column(values: ArrayLike, n: int, name: str) -> Array:
    """Return a number, (n,) or (n, N) so that it broadcasts against (n, N)."""
    array = np.asarray(values, dtype=float)
    if array.ndim == 0:
        return array.reshape(1, 1)
    if len(array) != n or array.ndim > 2:
        raise InputError(f"expected a number, ({n},) or ({n}, N) (got {array.shape})", name)
    return array.reshape(n, -1)
