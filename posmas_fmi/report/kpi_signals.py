"""The signals of a cooling run, from its ``results.nc``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from posmas_fmi.expression import Array
from posmas_fmi.netcdf import NetcdfFile
from posmas_fmi.network import Network
from posmas_fmi.report.foreign import number
from posmas_fmi.report.results_file import (
    open_results,
    read_labels,
    read_network,
    read_variable,
)

_WANTED = (
    *("time", "agent", "arc_from", "arc_to", "arc_weight", "pinning"),
    *("supply_temperature", "set_point", "facility_temperature"),
    *("valve_position", "case_temperature", "heat_load"),
)


@attrs.frozen(eq=False)
class Signals:
    """What was recorded with one controller; arrays over time and line, (T, N), or None.

    Attributes
    ----------
    time : (T,) array
        [s]
    deviation : (T, N) array
        Supply temperature minus its set-point [K].
    supply, valve, case, heat : (T, N) array or None
        Supply temperature [K], valve position (0 to 1), case temperature [K], heat load [W].
    set_point, facility : (T, 1) or (T, N) array or None
        [K]
    """

    time: Array
    names: tuple[str, ...]
    network: Network
    deviation: Array
    supply: Array
    set_point: Array
    facility: Array | None
    valve: Array | None
    case: Array | None
    heat: Array | None
    stride: int

    @property
    def N(self) -> int:
        """Number of lines."""
        return int(self.deviation.shape[1])


def read_signals(path: Path, summary: Mapping[str, Any]) -> Signals | None:
    """Read what the KPI page draws; None where no supply temperature was recorded.

    Parameters
    ----------
    path : Path
        The file.
    summary : mapping
        ``set_point_K`` and ``facility_K`` in it stand in for what was not recorded.

    Raises
    ------
    InputError
        If the file is damaged.
    """
    return _signals(open_results(path, _WANTED), path, summary)


def _signals(file: NetcdfFile, path: Path, summary: Mapping[str, Any]) -> Signals | None:
    if "supply_temperature" not in file.variables:
        return None

    def read(name: str) -> Array | None:
        if name not in file.variables:
            return None
        per_line = "agent" in file.variables[name].dims
        values = read_variable(file, name, ("time", "agent") if per_line else ("time",), path)
        return values if per_line else values[:, None]

    supply = read("supply_temperature")
    assert supply is not None
    filled = np.flatnonzero(~np.isnan(supply).all(axis=1))
    stop = int(filled[-1]) + 1 if filled.size else 0

    def column(name: str, constant: str) -> Array | None:
        values = read(name)
        if values is not None:
            return values[:stop]
        fixed = number(summary.get(constant))
        return None if fixed is None else np.full((stop, 1), fixed)

    def rest(name: str) -> Array | None:
        values = read(name)
        return None if values is None else values[:stop]

    set_point = column("set_point", "set_point_K")
    if set_point is None:
        return None
    n = file.sizes["agent"]
    return Signals(
        time=read_variable(file, "time", ("time",), path)[:stop],
        names=read_labels(file, "agent", n),
        network=read_network(file, n, path),
        deviation=supply[:stop] - set_point,
        supply=supply[:stop],
        set_point=set_point,
        facility=column("facility_temperature", "facility_K"),
        valve=rest("valve_position"),
        case=rest("case_temperature"),
        heat=rest("heat_load"),
        stride=file.rows.stride,
    )
