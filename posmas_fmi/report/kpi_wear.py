"""What wears: valve travel and thermal cycles of each line, from the recorded signals."""

from __future__ import annotations

import numpy as np

from posmas_fmi.expression import Array

MOST_LINES = 64  # of which cycles are counted one by one; of more lines, as many spread evenly


def strokes_per_hour(time: Array, valve: Array) -> Array:
    """Return the travel of each valve [full strokes/h], (N,).

    Examples
    --------
    >>> strokes_per_hour(np.array([0.0, 1800.0, 3600.0]), np.array([[0.0], [0.5], [0.25]]))
    array([0.75])
    """
    travel = np.abs(np.diff(valve, axis=0))
    return np.asarray(np.nansum(travel, axis=0) / _hours(time))


def cycles_per_hour(time: Array, case: Array) -> Array:
    """Return the thermal cycles of 2 K or more of each case [1/h], of up to `MOST_LINES` lines."""
    from posmas_fmi.cooling.kpi import thermal_cycles

    n = case.shape[1]
    chosen = np.unique(np.linspace(0, n - 1, min(n, MOST_LINES)).astype(int))
    counts = [thermal_cycles(_known(case[:, i])) for i in chosen]
    return np.array(counts) / _hours(time)


def _known(values: Array) -> Array:
    return values[np.isfinite(values)]


def _hours(time: Array) -> float:
    return max(float(time[-1] - time[0]), 1e-9) / 3600.0
