"""The signals of a cooling run, from its ``results.nc``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from posmas_fmi.errors import InputError
from posmas_fmi.expression import Array
from posmas_fmi.report.foreign import AGAIN, number
from posmas_fmi.report.kpi_data import Signals
from posmas_fmi.report.results_file import (
    LARGEST_VARIABLE,
    Rows,
    open_results,
    read_labels,
    read_network,
    read_variable,
    recorded,
)


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
    with open_results(path) as dataset:
        try:
            return _signals(dataset, path, summary)
        except InputError:
            raise
        except Exception as error:  # a truncated file may open and then fail while being read
            raise InputError(f"the file is damaged ({error}); {AGAIN}", str(path)) from error


def _signals(dataset: Any, path: Path, summary: Mapping[str, Any]) -> Signals | None:
    if "supply_temperature" not in dataset.variables:
        return None
    time = np.asarray(read_variable(dataset, "time", ("time",), path), dtype=float)
    size = dataset["supply_temperature"].size
    rows = Rows(recorded(time), max(1, math.ceil(size / LARGEST_VARIABLE)))

    def read(name: str) -> Array | None:
        if name not in dataset.variables:
            return None
        per_line = "agent" in dataset[name].dims
        dims = ("time", "agent") if per_line else ("time",)
        values = rows.of(read_variable(dataset, name, dims, path))
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
    n = int(dataset.sizes["agent"])
    return Signals(
        time=rows.of(time)[:stop],
        names=read_labels(dataset, "agent", n),
        network=read_network(dataset, n, path),
        deviation=supply[:stop] - set_point,
        supply=supply[:stop],
        set_point=set_point,
        facility=column("facility_temperature", "facility_K"),
        valve=rest("valve_position"),
        case=rest("case_temperature"),
        heat=rest("heat_load"),
        stride=rows.stride,
    )
