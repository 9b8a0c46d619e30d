"""NetCDF-4 files of others, read in a process of its own: damage can make HDF5 hang or crash."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from posmas_fmi.apart import ApartError, call_apart
from posmas_fmi.errors import InputError

Array = np.ndarray[Any, np.dtype[np.float64]]

DEADLINE = 10.0  # s, and
SPEED = 10e6  # bytes/s of the file, which slow disks and packed numbers reach
_MEMORY = 4 * 2**30  # bytes, beside the size of the file a few times


@attrs.frozen
class Rows:
    """Which samples over time are read: every ``stride``-th of the first ``count``, and the last.

    The last sample is what a verdict is about, so it is there whatever the stride.
    """

    count: int
    stride: int = 1

    def of(self, variable: Any, axis: int = 0) -> Array:
        """Read these samples of a variable.

        Examples
        --------
        >>> Rows(6, 2).of(np.arange(10.0))
        array([0., 2., 4., 5.])
        """
        before = (slice(None),) * axis
        values = np.asarray(variable[(*before, slice(0, self.count, self.stride))])
        if self.count and (self.count - 1) % self.stride:
            last = np.asarray(variable[(*before, slice(self.count - 1, self.count))])
            values = np.concatenate([values, last], axis=axis)
        return values


@attrs.frozen(eq=False)
class Variable:
    """One variable.

    Attributes
    ----------
    dims : tuple of str
    dtype : str
    shape : tuple of int
        In the file.
    attrs : dict
        Texts and numbers.
    values : array, tuple of str, or None
        As CF means them: packed numbers unpacked, missing ones NaN. None: not asked for, or
        neither numbers nor text.
    offset : int or None
        Where in the file the values stand, if they stand there in one piece and as they are in
        memory (float64).
    """

    dims: tuple[str, ...]
    dtype: str
    shape: tuple[int, ...]
    attrs: dict[str, Any]
    values: Array | tuple[str, ...] | None = None
    offset: int | None = None

    @property
    def size(self) -> int:
        """Number of entries in the file."""
        return math.prod(self.shape)

    @property
    def numbers(self) -> Array | None:
        """Values, where they are numbers."""
        return self.values if isinstance(self.values, np.ndarray) else None


@attrs.frozen(eq=False)
class NetcdfFile:
    """What was read of a file.

    Attributes
    ----------
    sizes : dict
        Of the dimensions.
    attrs : dict
        Of the file.
    variables : dict
        All, though the values only of those that were asked for.
    rows : Rows
        Which of the samples over ``time`` were read.
    """

    sizes: dict[str, int]
    attrs: dict[str, Any]
    variables: dict[str, Variable]
    rows: Rows


def read_netcdf(
    path: Path,
    names: Sequence[str] | None = None,
    largest: int | None = None,
    limit: float = math.inf,
) -> NetcdfFile:
    """Read a NetCDF-4 file.

    Parameters
    ----------
    path : Path
    names : sequence of str, optional
        Variables whose values are wanted; others are only told. All by default.
    largest : int, optional
        Most entries of one variable that are read. Where one has more, all are read with a stride
        over ``time``, after the rows were left out that have no time yet. All by default.
    limit : float
        Most bytes that these variables may have.

    Raises
    ------
    InputError
        If there is no such file or it cannot be read; also where HDF5 hangs in it or crashes.
    """
    where = str(path)
    try:
        if not path.is_file():
            raise InputError("expected a NetCDF-4 file (there is none)", where)
        with path.open("rb"):  # HDF5 tells at length that it may not
            size = path.stat().st_size
        wanted = None if names is None else tuple(names)
        deadline = DEADLINE + size / SPEED
        arguments = (str(path), wanted, largest, limit)
        file: NetcdfFile = call_apart(
            "posmas_fmi.netcdf:read_here", arguments, deadline, _MEMORY + 8 * size
        )
    except ApartError as error:
        text = f"expected a NetCDF-4 file (it is damaged: HDF5 {error})"
        raise InputError(text, where) from None
    except OSError as error:
        text = f"expected a NetCDF-4 file ({error.strerror or error})"
        raise InputError(text, where) from None
    return file


# ---- in the process of its own ------------------------------------------------------------------


def read_here(
    path: str, names: Sequence[str] | None, largest: int | None, limit: float
) -> NetcdfFile:
    """Read a file in this process, as `read_netcdf`; a damaged one may be its end."""
    import h5netcdf
    import h5py

    try:
        with h5py.File(path, "r") as raw, h5netcdf.File(raw, "r") as file:
            read = _read(file, names, largest, limit)
            return attrs.evolve(read, variables=_placed(read.variables, raw))
    except InputError as error:
        raise InputError(error.message, path) from None
    except Exception as error:  # whatever HDF5 and what lies above it raise on a broken file
        lines = str(error).splitlines() or [type(error).__name__]
        raise InputError(f"expected a NetCDF-4 file ({lines[0][:200]})", path) from None


def _read(file: Any, names: Sequence[str] | None, largest: int | None, limit: float) -> NetcdfFile:
    wanted = [n for n, v in file.variables.items() if names is None or n in names]
    shapes = {name: tuple(map(int, variable.shape)) for name, variable in file.variables.items()}
    if 8 * sum(math.prod(shapes[name]) for name in wanted) > limit:
        raise InputError(f"it says to hold more than {limit:g} bytes")
    rows = _rows(file, [shapes[n] for n in wanted if "time" in file[n].dimensions], largest)
    variables = {
        name: Variable(
            tuple(map(str, variable.dimensions)),
            str(variable.dtype),
            shapes[name],
            _plain(variable.attrs),
            _values(variable, rows) if name in wanted else None,
        )
        for name, variable in file.variables.items()
    }
    sizes = {name: int(dimension.size) for name, dimension in file.dimensions.items()}
    return NetcdfFile(sizes, _plain(file.attrs), variables, rows)


def _placed(variables: dict[str, Variable], raw: Any) -> dict[str, Variable]:
    """Add where the values stand."""
    found = {}
    for name, variable in variables.items():
        plain = np.dtype(raw[name].dtype) == np.dtype(float)
        offset = raw[name].id.get_offset() if plain else None
        found[name] = attrs.evolve(variable, offset=offset)
    return found


def _rows(file: Any, shapes: Sequence[tuple[int, ...]], largest: int | None) -> Rows:
    time = file.variables.get("time")
    if time is None or time.dimensions != ("time",):
        return Rows(int(file.dimensions["time"].size) if "time" in file.dimensions else 0)
    if largest is None or _kind(time) != "number":
        return Rows(int(time.shape[0]))
    most = max(map(math.prod, shapes), default=0)
    return Rows(recorded(_unpacked(time, time[...])), max(1, math.ceil(most / largest)))


def recorded(time: Array) -> int:
    """Return the number of leading rows whose times are finite and increase.

    Examples
    --------
    >>> recorded(np.array([0.0, 1.0, np.nan]))
    2
    """
    if not time.size or not np.isfinite(time[0]):
        return 0
    ends = np.flatnonzero(~(np.diff(time) > 0))
    return int(ends[0]) + 1 if ends.size else len(time)


def _kind(variable: Any) -> str:
    if variable.dtype is str:
        return "text"
    kind = np.dtype(variable.dtype).kind
    return "number" if kind in "fiub" else "text" if kind in "OSU" else "other"


def _values(variable: Any, rows: Rows) -> Array | tuple[str, ...] | None:
    kind = _kind(variable)
    if kind == "number":
        if "time" in variable.dimensions:
            return _unpacked(variable, rows.of(variable, variable.dimensions.index("time")))
        return _unpacked(variable, variable[...])
    if kind == "text" and len(variable.dimensions) == 1:
        found = np.asarray(variable[...], dtype=object).tolist()
        return tuple(map(_text, found))
    return None


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _unpacked(variable: Any, read: Any) -> Array:
    values = np.asarray(read, dtype=float)
    missing = np.zeros(values.shape, dtype=bool)
    for name in ("_FillValue", "missing_value"):
        if name in variable.attrs:
            missing |= np.isin(values, np.asarray(variable.attrs[name], dtype=float))
    scale, offset = (
        float(np.ravel(variable.attrs.get(name, default))[0])
        for name, default in (("scale_factor", 1.0), ("add_offset", 0.0))
    )
    if scale == 1.0 and offset == 0.0 and not missing.any():
        return values
    return np.where(missing, np.nan, scale * values + offset)


def _plain(attributes: Any) -> dict[str, Any]:
    """Attributes that are texts or numbers: others may name types that only this process knows."""
    found: dict[str, Any] = {}
    for name, value in dict(attributes).items():
        if isinstance(value, bytes | str):
            found[str(name)] = _text(value)
        elif np.asarray(value).dtype.kind in "fiub":
            found[str(name)] = np.asarray(value)[()]
    return found
