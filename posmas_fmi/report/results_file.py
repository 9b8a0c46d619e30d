"""``results.nc``: the signals of a run and its network."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import scipy.sparse as sp

from posmas_fmi.errors import InputError, NetworkError
from posmas_fmi.expression import Array
from posmas_fmi.network import Network
from posmas_fmi.report.foreign import AGAIN, clean, number, one_line

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
    with open_results(path) as dataset:
        try:
            return _signals(dataset, path)
        except InputError:
            raise
        except Exception as error:  # a truncated file may open and then fail while being read
            raise InputError(
                f"the file is damaged (reading it failed: {one_line(error)}); {AGAIN}", str(path)
            ) from error


def open_results(path: Path) -> Any:
    """Open the file as an xarray.Dataset, a context manager; nothing is decoded.

    Raises
    ------
    InputError
        If it is missing or not NetCDF-4.
    """
    import h5py
    import xarray

    if not path.is_file():
        raise InputError(f"the file is missing; {AGAIN}", str(path))
    try:
        with h5py.File(path, "r") as file:  # the layers above leave a half-open file behind
            dict(file.attrs)
        return xarray.open_dataset(path, engine="h5netcdf", decode_times=False, decode_coords=False)
    except Exception as error:  # whatever the HDF5 stack raises on a broken file
        raise InputError(
            f"expected a NetCDF-4 file (reading it failed: {one_line(error)}); {AGAIN}", str(path)
        ) from error


@attrs.frozen
class Rows:
    """Which samples are read: every ``stride``-th of the first ``count``, and the last one.

    The last sample is what the verdict is about, so it is there whatever the stride.
    """

    count: int
    stride: int

    def of(self, variable: Any) -> Array:
        """Read these samples of a variable whose first dimension is time."""
        values = np.asarray(variable[: self.count : self.stride], dtype=float)
        if self.count and (self.count - 1) % self.stride:
            last = np.asarray(variable[self.count - 1 : self.count], dtype=float)
            values = np.concatenate([values, last])
        return values


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


def _signals(dataset: Any, path: Path) -> dict[str, Any]:
    for name in ("time", *_SIGNALS, "pinning", "arc_from", "arc_to"):
        if name not in dataset.variables:
            found = clean(", ".join(sorted(map(str, dataset.variables))))
            raise InputError(f"expected a variable '{name}' (found {found}); {AGAIN}", str(path))
    time = np.asarray(read_variable(dataset, "time", ("time",), path), dtype=float)
    present = {n: d for n, d in {**_SIGNALS, **_OPTIONAL}.items() if n in dataset.variables}
    besides = _besides(dataset)
    largest = max(dataset[name].size for name in (*present, *besides))
    rows = Rows(recorded(time), max(1, math.ceil(largest / LARGEST_VARIABLE)))
    signals = {n: rows.of(read_variable(dataset, n, d, path)) for n, d in present.items()}
    filled = np.flatnonzero(~np.all([_blank(signals[n]) for n in ("xhat", "u", "s")], axis=0))
    stop = int(filled[-1]) + 1 if filled.size else 0
    optional = dict.fromkeys(_OPTIONAL) | {
        n: v[:stop] for n, v in signals.items() if n in _OPTIONAL and not np.isnan(v).all()
    }
    others = {
        clean(n): rows.of(read_variable(dataset, n, d, path))[:stop] for n, d in besides.items()
    }
    sizes = {dim: int(dataset.sizes[dim]) for dim in ("agent", "state", "input", "output")}
    labels = {dim: read_labels(dataset, dim, size) for dim, size in sizes.items()}
    return {
        **_attributes(dataset),
        "stride": rows.stride,
        "names": labels.pop("agent"),
        "labels": labels,
        "network": read_network(dataset, sizes["agent"], path),
        "time": rows.of(time)[:stop],
        **{n: signals[n][:stop] for n in _SIGNALS},
        **optional,
        "recorded": {n: values for n, values in others.items() if not np.isnan(values).all()},
    }


def _besides(dataset: Any) -> dict[str, tuple[str, ...]]:
    """Return what was recorded besides the signals of the protocol, with its dimensions."""
    found: dict[str, tuple[str, ...]] = {}
    for name, variable in dataset.data_vars.items():
        dims = tuple(map(str, variable.dims))
        if name not in {**_SIGNALS, **_OPTIONAL} and variable.dtype.kind in "fiub":
            if set(dims) == {"time", "agent"}:
                found[str(name)] = ("time", "agent")
            elif dims == ("time",):
                found[str(name)] = dims
    return found


def _attributes(dataset: Any) -> dict[str, Any]:
    units = {
        str(name): clean(str(dataset[name].attrs["units"]))
        for name in dataset.variables
        if "units" in dataset[name].attrs
    }
    return {
        "scenario": clean(str(dataset.attrs.get("scenario", "run"))),
        "created_by": clean(str(dataset.attrs.get("created_by", ""))),
        "complete": bool(np.all(dataset.attrs.get("complete", 1))),
        "period": number(dataset.attrs.get("period")),
        "units": units,
    }


def read_variable(dataset: Any, name: str, dims: tuple[str, ...], path: Path) -> Any:
    """Return a variable, not yet read, with its dimensions in this order."""
    variable = dataset[name]
    if set(variable.dims) != set(dims) or variable.dtype.kind not in "fiub":
        raise InputError(
            f"expected numbers over ({', '.join(dims)}) in '{name}' "
            f"(got {variable.dtype} over ({clean(', '.join(map(str, variable.dims)))})); {AGAIN}",
            str(path),
        )
    return variable.transpose(*dims)


def _blank(values: Array) -> Array:
    """Rows that were allocated but never written."""
    return np.asarray(np.isnan(values).all(axis=tuple(range(1, values.ndim))))


def recorded(time: Array) -> int:
    """Return the number of leading rows whose times are finite and increase."""
    if not time.size or not np.isfinite(time[0]):
        return 0
    ends = np.flatnonzero(~(np.diff(time) > 0))
    return int(ends[0]) + 1 if ends.size else len(time)


def read_labels(dataset: Any, dim: str, count: int) -> tuple[str, ...]:
    """Return the names along a dimension, numbers from 1 where it has none."""
    if dim not in dataset.variables:
        return tuple(str(k + 1) for k in range(count))
    return tuple(
        clean(label.decode("utf-8", "replace") if isinstance(label, bytes) else str(label))
        for label in dataset[dim].values.tolist()
    )


def read_network(dataset: Any, n: int, path: Path) -> Network:
    """Return the digraph with its pinning, as stored beside the signals."""

    def read(name: str, dim: str) -> Array:
        return np.asarray(read_variable(dataset, name, (dim,), path), dtype=float)

    source, target = read("arc_from", "arc"), read("arc_to", "arc")
    weighted = "arc_weight" in dataset.variables
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
