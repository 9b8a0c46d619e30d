"""Results as NetCDF-4, written in chunks while the run goes on."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from itertools import product
from pathlib import Path
from types import TracebackType
from typing import Any

import attrs
import numpy as np

from posmas_fmi.errors import InputError, ResultsError
from posmas_fmi.expression import Array
from posmas_fmi.network import Network

CHUNK = 512  # rows held in memory before they are written,
HELD = 16_000_000  # or fewer: bytes
SPARE = 250_000  # bytes that the file itself may need, beside the rows


@attrs.frozen
class Layout:
    """What the columns of a result are: sizes, names and units.

    Attributes
    ----------
    agents, states, inputs, outputs : tuple of str
        Labels of the dimensions.
    of_agents, of_run : tuple of str
        Further variables with one value for each agent, and with one for all.
    """

    agents: tuple[str, ...]
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    of_agents: tuple[str, ...] = ()
    of_run: tuple[str, ...] = ()

    def shape(self, variable: str) -> tuple[tuple[str, ...], tuple[int, ...]]:
        """Dimensions and sizes of one row of a variable."""
        n, m = len(self.agents), len(self.states)
        if variable in self.of_agents:
            return ("agent",), (n,)
        if variable in self.of_run:
            return (), ()
        p, q = len(self.inputs), len(self.outputs)
        return {
            "x": (("agent", "state"), (n, m)),
            "x_baseline": (("agent", "state"), (n, m)),
            "xhat": (("agent", "state"), (n, m)),
            "u": (("agent", "input"), (n, p)),
            "sec_u": (("agent", "input"), (n, p)),
            "y": (("agent", "output"), (n, q)),
            "s": (("state",), (m,)),
        }[variable]


class Recorder:
    """Write rows of named arrays to one NetCDF-4 file.

    Parameters
    ----------
    path : Path
        Replaced if it exists.
    layout : Layout
    network : Network
        Stored with the results, so that a report needs nothing else.
    variables : tuple of str
        Of `Layout.shape`; ``time`` comes by itself.
    attributes : dict
        Global attributes of the file. ``complete`` is 0 until `finish`.
    keep : int, optional
        Go on with the file that is there, after so many of its rows.

    Raises
    ------
    InputError
        If the file to go on with cannot be read, has other variables or fewer rows.
    """

    def __init__(
        self,
        path: Path,
        layout: Layout,
        network: Network,
        variables: tuple[str, ...],
        attributes: dict[str, Any],
        keep: int | None = None,
    ) -> None:
        import h5netcdf
        import h5py

        self._layout = layout
        self._blocks: dict[str, list[Array]] = {name: [] for name in ("time", *variables)}
        self._taken: dict[str, int] = dict.fromkeys(self._blocks, 0)  # rows, written or not
        self._written = dict(self._taken)
        self._held = 0  # bytes
        self._path, self._full = path, False
        if keep is not None:
            self._go_on(path, keep)
            return
        # opened below h5netcdf, whose own flush leaves everything in memory; NetCDF wants the order
        self._disk = h5py.File(path, "w", track_order=True)
        self._reserve(SPARE)
        self._file = h5netcdf.File(self._disk, "a")
        self._define(network, variables, attributes)
        # rows go past h5netcdf, which takes milliseconds for each write
        self._data = {name: self._disk[name] for name in self._blocks}

    def _go_on(self, path: Path, keep: int) -> None:
        import h5netcdf
        import h5py

        try:
            self._disk = h5py.File(path, "r+", track_order=True)
        except OSError as error:
            raise InputError(f"cannot go on with these results: {error}", str(path)) from None
        missing = [name for name in self._blocks if name not in self._disk]
        if missing or len(self._disk["time"]) < keep:
            found = f"no {missing[0]}" if missing else f"{len(self._disk['time'])} rows"
            self._disk.close()
            raise InputError(
                f"cannot go on with these results: expected {keep} rows of "
                f"{', '.join(self._blocks)} (there is {found})",
                str(path),
            )
        self._file = h5netcdf.File(self._disk, "a")
        self._file.attrs["complete"] = 0
        self._data = {name: self._disk[name] for name in self._blocks}
        for name, data in self._data.items():
            if len(data) > keep:
                data.resize(keep, axis=0)
            if name != "x_baseline":  # that run is made anew
                self._taken[name] = self._written[name] = keep

    def _define(
        self, network: Network, variables: tuple[str, ...], attributes: dict[str, Any]
    ) -> None:
        file, layout = self._file, self._layout
        file.dimensions = {
            "time": None,
            "agent": len(layout.agents),
            "state": len(layout.states),
            "input": len(layout.inputs),
            "output": len(layout.outputs),
            "arc": network.adjacency.nnz,
        }
        for name in ("agent", "state", "input", "output"):
            labels = np.array(getattr(layout, f"{name}s"), dtype=object)
            file.create_variable(name, (name,), _text(), data=labels)
        receiver = np.repeat(np.arange(network.N), np.diff(network.adjacency.indptr))
        for name, data in (
            ("arc_from", network.adjacency.indices.astype(np.int64)),
            ("arc_to", receiver.astype(np.int64)),
            ("arc_weight", network.adjacency.data),
        ):
            file.create_variable(name, ("arc",), data.dtype, data=data)
        file.create_variable("pinning", ("agent",), float, data=network.pinning)
        time = file.create_variable("time", ("time",), float, chunks=(CHUNK,))
        time.attrs["units"] = "s"
        for name in variables:
            dimensions, sizes = layout.shape(name)
            file.create_variable(
                name, ("time", *dimensions), float, chunks=_chunks(sizes), fillvalue=np.nan
            )
        file.attrs.update({**attributes, "complete": 0})
        self._disk.flush()
        self._release()

    def record(self, time: float, values: dict[str, Array]) -> None:
        """Add one row; the arrays are copied. A variable that is left out stays NaN there."""
        rows = {name: np.asarray(value)[None] for name, value in values.items()}
        self.record_block(np.array([time]), rows)

    def record_block(self, times: Array, values: dict[str, Array]) -> None:
        """Add rows: times (r,) and arrays (r, …), which are copied or written at once."""
        self.add({"time": times, **values})

    def add(self, values: dict[str, Array]) -> None:
        """Add rows (r, …) of these variables only, after the last row that they have."""
        large = max(len(block) for block in values.values()) >= CHUNK
        for name, block in values.items():
            self._blocks[name].append(block if large else np.array(block, dtype=float))
            self._taken[name] += len(block)
            self._held += block.nbytes
        rows = max(self._taken[name] - self._written[name] for name in values)
        if rows >= CHUNK or self._held >= HELD:
            self.flush()

    def flush(self) -> None:
        """Write what is held in memory.

        Raises
        ------
        ResultsError
            If there is no room for it; what was written before stays.
        """
        if self._full or not any(self._blocks.values()):
            return
        self._reserve(SPARE + sum(map(self._growth, self._data)))
        for name, data in self._data.items():
            if len(data) < self._taken["time"]:
                data.resize(self._taken["time"], axis=0)
            blocks = self._blocks[name]
            if blocks:
                rows = blocks[0] if len(blocks) == 1 else np.concatenate(blocks)
                data[self._written[name] : self._taken[name]] = rows
                blocks.clear()
        self._written = dict(self._taken)
        self._held = 0
        self._disk.flush()
        self._release()

    def _growth(self, name: str) -> int:
        """Bytes that the file grows by at most, for one variable."""
        data = self._data[name]
        rows = data.chunks[0]
        chunks = -(-self._taken["time"] // rows) - self._written[name] // rows
        return int(chunks * rows * np.prod(data.shape[1:], dtype=int) * data.dtype.itemsize)

    def _reserve(self, size: int) -> None:
        """Have the system set room aside: when HDF5 finds none, the file is lost."""
        if not hasattr(os, "posix_fallocate"):
            return
        try:
            os.posix_fallocate(self._disk.id.get_vfd_handle(), self._disk.id.get_filesize(), size)
        except OSError as error:
            if error.errno in (errno.EOPNOTSUPP, errno.EINVAL):  # not on this file system
                return
            self._full = True
            raise ResultsError(
                f"no room for more results: {error.strerror}; what was written stays readable",
                str(self._path),
            ) from None

    def _release(self) -> None:
        """Give back what was set aside and not needed."""
        if hasattr(os, "posix_fallocate"):
            os.ftruncate(self._disk.id.get_vfd_handle(), self._disk.id.get_filesize())

    @property
    def rows(self) -> int:
        """Number of communication points recorded."""
        return self._taken["time"]

    def finish(self) -> None:
        """Write the rest and mark the result as complete."""
        self.flush()
        if not self._full:
            self._file.attrs["complete"] = 1

    def close(self) -> None:
        """Write the rest and close the file; `complete` stays as it is."""
        try:
            self.flush()
        finally:
            self._file.close()
            self._disk.close()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


class Thinned:
    """Rows that come in blocks, thinned out: the first, every k-th after it, and the last.

    Parameters
    ----------
    add : callable
        Gets what is left of each block: arrays (r, …) by name.
    every : int
        k; 1 leaves all.
    rows : int
        Number of rows that came before.

    Attributes
    ----------
    rows : int
        Number of rows that came.

    Examples
    --------
    >>> thinned = Thinned(lambda values: print(values["a"]), every=2)
    >>> thinned({"a": np.array([0, 1, 2])})
    [0 2]
    >>> thinned({"a": np.array([3])})
    >>> thinned.finish()
    [3]
    """

    def __init__(self, add: Callable[[dict[str, Array]], None], every: int, rows: int = 0) -> None:
        self._add, self._every = add, every
        self._last: dict[str, Array] = {}
        self.rows = rows

    def __call__(self, values: dict[str, Array]) -> None:
        """Take a block."""
        first, every = -self.rows % self._every, self._every
        count = max(map(len, values.values()), default=0)
        if first < count:
            self._add({name: block[first::every] for name, block in values.items()})
        self.rows += count
        between = count and (self.rows - 1) % every
        self._last = {n: np.array(b[-1:]) for n, b in values.items()} if between else {}

    def finish(self) -> None:
        """Pass the last row on if it was left out."""
        if self._last:
            self._add(self._last)
            self._last = {}


def write_csv(results: Path, path: Path) -> None:
    """Write the signals of a result as CSV: a column for each number, named by its coordinates.

    Parameters
    ----------
    results : Path
        Of a `Recorder` that is closed.
    path : Path
        Replaced if it exists. Columns are ``time``, ``x.AGENT.STATE``, ``u.AGENT.INPUT``,
        ``s.STATE`` and so on; a number that is missing is left empty.
    """
    import csv

    import h5netcdf

    with h5netcdf.File(results, "r") as file, path.open("w", newline="", encoding="utf-8") as text:
        labels = {
            name: [label.decode() if isinstance(label, bytes) else label for label in variable[...]]
            for name, variable in file.variables.items()
            if variable.dimensions == (name,) and name != "time"
        }
        signals = {n: v for n, v in file.variables.items() if v.dimensions[:1] == ("time",)}
        names = ["time", *sorted(name for name in signals if name != "time")]
        writer = csv.writer(text)
        writer.writerow(
            ".".join((name, *coordinates))
            for name in names
            for coordinates in product(*(labels[d] for d in signals[name].dimensions[1:]))
        )
        rows = len(file.dimensions["time"])
        width = sum(int(np.prod(signals[name].shape[1:])) for name in names)
        block = max(1, HELD // (64 * width))  # numbers take more room as text
        for begin in range(0, rows, block):
            end = min(begin + block, rows)
            columns = [signals[name][begin:end].reshape(end - begin, -1) for name in names]
            for row in np.concatenate(columns, axis=1).tolist():
                writer.writerow("" if value != value else value for value in row)


def _text() -> Any:
    import h5py

    return h5py.string_dtype("utf-8")


def _chunks(sizes: tuple[int, ...]) -> tuple[int, ...]:
    """About one megabyte per chunk, at least one row, at most `CHUNK` rows."""
    row = 8 * int(np.prod(sizes))
    return (max(1, min(CHUNK, 1_000_000 // max(1, row))), *sizes)
