"""``results.nc``: the signals of a run and its network."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from posmas_fmi.errors import InputError, NetworkError
from posmas_fmi.expression import Array
from posmas_fmi.netcdf import NetcdfFile, read_netcdf
from posmas_fmi.network import Network
from posmas_fmi.report.foreign import AGAIN, clean, number

# Entries read of one variable. Longer runs are read with a stride: a plot cannot show more, and
# the figures of merit are in summary.json, computed by the master from every sample.
LARGEST_VARIABLE = 8_000_000


def read_results(path: Path) -> dict[str, Any]:
    """Read the signals and the network.

    Parameters
    ----------
    path : Path

    Returns
    -------
    dict
        Arguments of `posmas_fmi.report.data.Run`.

    Raises
    ------
    InputError
        If the file is missing, damaged, or not the results of a run.
    """
    return _signals(open_results(path), path)


def open_results(path: Path, names: Sequence[str] | None = None) -> NetcdfFile:
    """Read the file, thinned out where it is long.

    Parameters
    ----------
    path : Path
    names : sequence of str, optional
        What is wanted; all by default.

    Raises
    ------
    InputError
        If it is missing, damaged or not NetCDF-4.
    """
    if not path.is_file():
        raise InputError(f"the file is missing; {AGAIN}", str(path))
    try:
        return read_netcdf(path, names, LARGEST_VARIABLE)
    except InputError as error:
        raise InputError(f"{clean(error.message)}; {AGAIN}", str(path)) from None


_SIGNALS = {
    "xhat": ("time", "agent", "state"),
    "u": ("time", "agent", "input"),
    "y": ("time", "agent", "output"),
    "s": ("time", "state"),
}
_OPTIONAL = {
    "x": ("time", "agent", "state"),
    "x_baseline": ("time", "agent", "state"),
    "sec_u": ("time", "agent", "input"),
}


def _signals(file: NetcdfFile, path: Path) -> dict[str, Any]:
    for name in ("time", *_SIGNALS, "pinning", "arc_from", "arc_to"):
        if name not in file.variables:
            found = clean(", ".join(sorted(file.variables)))
            raise InputError(f"expected a variable '{name}' (found {found}); {AGAIN}", str(path))
    time = read_variable(file, "time", ("time",), path)
    present = {n: d for n, d in {**_SIGNALS, **_OPTIONAL}.items() if n in file.variables}
    signals = {n: read_variable(file, n, d, path) for n, d in present.items()}
    filled = np.flatnonzero(~np.all([_blank(signals[n]) for n in ("xhat", "u", "s")], axis=0))
    stop = int(filled[-1]) + 1 if filled.size else 0
    optional = dict.fromkeys(_OPTIONAL) | {
        n: v[:stop] for n, v in signals.items() if n in _OPTIONAL and not np.isnan(v).all()
    }
    others = {clean(n): read_variable(file, n, d, path)[:stop] for n, d in _besides(file).items()}
    sizes = {dim: file.sizes[dim] for dim in ("agent", "state", "input", "output")}
    labels = {dim: read_labels(file, dim, size) for dim, size in sizes.items()}
    return {
        **_attributes(file),
        "stride": file.rows.stride,
        "names": labels.pop("agent"),
        "labels": labels,
        "network": read_network(file, sizes["agent"], path),
        "time": time[:stop],
        **{n: signals[n][:stop] for n in _SIGNALS},
        **optional,
        "recorded": {n: values for n, values in others.items() if not np.isnan(values).all()},
    }


def _besides(file: NetcdfFile) -> dict[str, tuple[str, ...]]:
    """Return what was recorded besides the signals of the protocol, with its dimensions."""
    found: dict[str, tuple[str, ...]] = {}
    for name, variable in file.variables.items():
        known = name in {"time": (), **_SIGNALS, **_OPTIONAL}
        if known or variable.numbers is None:
            continue
        if set(variable.dims) == {"time", "agent"} and len(variable.dims) == 2:
            found[name] = ("time", "agent")
        elif variable.dims == ("time",):
            found[name] = variable.dims
    return found


def _attributes(file: NetcdfFile) -> dict[str, Any]:
    units = {
        name: clean(str(variable.attrs["units"]))
        for name, variable in file.variables.items()
        if "units" in variable.attrs
    }
    return {
        "scenario": clean(str(file.attrs.get("scenario", "run"))),
        "created_by": clean(str(file.attrs.get("created_by", ""))),
        "complete": bool(np.all(file.attrs.get("complete", 1))),
        "period": number(file.attrs.get("period")),
        "units": units,
    }


def read_variable(file: NetcdfFile, name: str, dims: tuple[str, ...], path: Path) -> Array:
    """Return a variable with its dimensions in this order."""
    variable = file.variables[name]
    values = variable.numbers
    if sorted(variable.dims) != sorted(dims) or values is None:
        raise InputError(
            f"expected numbers over ({', '.join(dims)}) in '{name}' "
            f"(got {variable.dtype} over ({clean(', '.join(variable.dims))})); {AGAIN}",
            str(path),
        )
    return values.transpose([variable.dims.index(dim) for dim in dims])


def _blank(values: Array) -> Array:
    """Rows that were allocated but never written."""
    return np.asarray(np.isnan(values).all(axis=tuple(range(1, values.ndim))))


def read_labels(file: NetcdfFile, dim: str, count: int) -> tuple[str, ...]:
    """Return the names along a dimension, numbers from 1 where it has none."""
    labels = file.variables[dim].values if dim in file.variables else None
    if labels is None or len(labels) != count:
        return tuple(str(k + 1) for k in range(count))
    return tuple(clean(x if isinstance(x, str) else f"{x:g}") for x in labels)


def read_network(file: NetcdfFile, n: int, path: Path) -> Network:
    """Return the digraph with its pinning, as stored beside the signals."""

    def read(name: str, dim: str) -> Array:
        return read_variable(file, name, (dim,), path)

    source, target = read("arc_from", "arc"), read("arc_to", "arc")
    weighted = "arc_weight" in file.variables
    weight = read("arc_weight", "arc") if weighted else np.ones(len(source))
    ends = np.concatenate([source, target])
    if not ((ends >= 0) & (ends < n) & (ends == np.floor(ends))).all():
        raise InputError(
            f"expected agents from 0 to {n - 1} in 'arc_from' and 'arc_to'; {AGAIN}", str(path)
        )
    adjacency = sp.csr_array((weight, (target.astype(int), source.astype(int))), shape=(n, n))
    try:
        return Network(adjacency, read("pinning", "agent"))
    except NetworkError as error:
        raise InputError(
            f"the stored network is not usable ({error}); {AGAIN}", str(path)
        ) from error
