"""Results as NetCDF-4, written while the run goes on."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from itertools import product
from pathlib import Path
from time import monotonic
from types import TracebackType
from typing import Any

import attrs
import numpy as np

from posmas_fmi.errors import InputError, ResultsError
from posmas_fmi.expression import Array
from posmas_fmi.netcdf import read_netcdf, recorded
from posmas_fmi.network import Network
from posmas_fmi.writing import whole

CHUNK = 512  # rows held in memory before they are written,
HELD = 16_000_000  # or fewer: bytes,
LATEST = 0.5  # or, at the next row, after so many seconds
FIRST = 64_000_000  # bytes that a file begins with at most
SPARE = 250_000  # bytes that the file itself may need, beside the rows


_FIXED = {"time", "agent", "state", "input", "output", "arc", "arc_from", "arc_to", "arc_weight"}
_OURS = {"pinning", "x", "xhat", "u", "sec_u", "y", "s", "x_baseline", "extra", "set_point"}
TAKEN = frozenset(_FIXED | _OURS)  # names that a result has anyhow


@attrs.frozen
class Layout:
    """What the columns of a result are: sizes, names and units.

    Attributes
    ----------
    agents, states, inputs, outputs : tuple of str
        Labels of the dimensions.
    of_agents, of_run : tuple of str
        Further variables with one value for each agent, and with one for all.
    units : mapping of str to str
        Of variables, where they are known.
    """

    agents: tuple[str, ...]
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    of_agents: tuple[str, ...] = ()
    of_run: tuple[str, ...] = ()
    units: Mapping[str, str] = attrs.field(factory=dict)

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
    """Write rows of named arrays to one NetCDF-4 file, which is whole at every moment.

    The structure of the file is complete before it gets its name; a run then only fills in numbers
    that were missing (NaN). So whatever ends the process, the file can be read. Where it turns
    out too small or too large, a new file takes its place at once.

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
    expected : int
        Number of rows that there will be, if all goes well; more or fewer may come.

    Raises
    ------
    InputError
        If the file to go on with cannot be read, has other variables or fewer rows.
    ResultsError
        If there is no room for the file.
    """

    def __init__(
        self,
        path: Path,
        layout: Layout,
        network: Network,
        variables: tuple[str, ...],
        attributes: dict[str, Any],
        keep: int | None = None,
        expected: int = 0,
    ) -> None:
        self._path, self._layout, self._network = path, layout, network
        self._variables, self._attributes = variables, attributes
        self._blocks: dict[str, list[Array]] = {name: [] for name in ("time", *variables)}
        self._taken: dict[str, int] = dict.fromkeys(self._blocks, 0)  # rows, written or not
        self._written = dict(self._taken)
        self._given = dict(self._taken)  # rows, written or being written
        self._held = 0  # bytes
        self._thread = ThreadPoolExecutor(1, "posmas-fmi-results")
        self._writing: Future[None] | None = None
        self._flushed = monotonic()
        self._full = False
        self._handle = -1
        self._offsets: dict[str, int] = {}
        self._rows = 0  # of the file
        self._expected = expected
        if keep is not None:
            self._offsets = _check(path, {name: self._shape(name) for name in self._blocks}, keep)
            for name in self._blocks:
                if name != "x_baseline":  # that run is made anew
                    self._taken[name] = self._written[name] = self._given[name] = keep
        first = max(CHUNK, FIRST // self._row_size)
        self._replace(max(min(first, expected) if expected else CHUNK, self.rows))

    @property
    def _row_size(self) -> int:
        """Bytes of one row of all variables."""
        return sum(8 * int(np.prod(self._shape(name))) for name in self._blocks)

    # ---- the file -------------------------------------------------------------------------------

    def _replace(self, rows: int, complete: bool = False) -> None:
        """Put a file with room for so many rows in the place of the one there is."""
        partial = self._path.with_name(f"{self._path.name}.partial")
        try:
            offsets = self._make(partial, rows, complete)
            if any(self._written.values()):
                handle = os.open(partial, _FLAGS)
                try:
                    self._copy(handle, offsets)
                finally:
                    os.close(handle)
            self._let_go()  # not every system replaces a file that is open
            os.replace(partial, self._path)
            self._handle = os.open(self._path, _FLAGS)
        except OSError as error:
            raise self._no_room(error) from None
        finally:
            partial.unlink(missing_ok=True)
        self._offsets, self._rows = offsets, rows

    def _let_go(self) -> None:
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1

    def _make(self, path: Path, rows: int, complete: bool) -> dict[str, int]:
        """Write a file without results; return where those of each variable begin in it."""
        import h5netcdf
        import h5py

        path.unlink(missing_ok=True)
        # opened below h5netcdf, whose own flush leaves everything in memory; NetCDF wants the order
        with h5py.File(path, "w", track_order=True) as disk:
            self._reserve(disk, rows * self._row_size)
            with h5netcdf.File(disk, "a") as file:
                self._define(file, rows, complete)
            data = {name: disk[name] for name in self._blocks}
            for one in data.values() if rows else ():
                one[:1] = np.nan  # makes HDF5 fill all of it
            disk.flush()
            if hasattr(os, "posix_fallocate"):  # give back what was not needed
                os.ftruncate(disk.id.get_vfd_handle(), disk.id.get_filesize())
            return {name: one.id.get_offset() or 0 for name, one in data.items()}

    def _reserve(self, disk: Any, size: int) -> None:
        """Have the system set room aside: HDF5 does not end well when it finds none."""
        if not hasattr(os, "posix_fallocate"):
            return
        size += SPARE + 500 * len(self._layout.agents) + 24 * self._network.adjacency.nnz
        try:
            os.posix_fallocate(disk.id.get_vfd_handle(), disk.id.get_filesize(), size)
        except OSError as error:
            if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL):  # not on this file system
                raise

    def _no_room(self, error: OSError) -> ResultsError:
        self._full = True
        why = error.strerror or error
        if self._rows:
            what = f"no room for more results ({why}); what was written stays readable, and the "
            return ResultsError(f"{what}run goes on with --resume when there is", str(self._path))
        size = max(self._expected, CHUNK) * self._row_size / 1e6
        return ResultsError(
            f"no room for the results ({why}), which will take {size:.3g} MB; choose another "
            "folder, or record less: [record] has every and variables",
            str(self._path),
        )

    def _copy(self, handle: int, offsets: dict[str, int]) -> None:
        """Take the rows over from the file there is."""
        old = os.open(self._path, os.O_RDONLY | _OPEN)
        try:
            for name, count in self._written.items():
                size = 8 * count * int(np.prod(self._shape(name)))
                os.lseek(old, self._offsets[name], os.SEEK_SET)
                for begin in range(0, size, HELD):
                    rows = os.read(old, min(HELD, size - begin))
                    _write(handle, np.frombuffer(rows, dtype=np.uint8), offsets[name] + begin)
        finally:
            os.close(old)

    def _shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of a row."""
        return () if name == "time" else self._layout.shape(name)[1]

    def _define(self, file: Any, rows: int, complete: bool) -> None:
        layout, network = self._layout, self._network
        file.dimensions = {
            "time": rows or None,
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
        time = file.create_variable("time", ("time",), float, fillvalue=np.nan)
        time.attrs["units"] = "s"
        for name in self._variables:
            dimensions, _ = layout.shape(name)
            values = file.create_variable(name, ("time", *dimensions), float, fillvalue=np.nan)
            if name in layout.units:
                values.attrs["units"] = layout.units[name]
        file.attrs.update({**self._attributes, "complete": int(complete)})

    # ---- rows -----------------------------------------------------------------------------------

    def record(self, time: float, values: dict[str, Array]) -> None:
        """Add one row; the arrays are copied. A variable that is left out stays NaN there."""
        rows = {name: np.asarray(value)[None] for name, value in values.items()}
        self.record_block(np.array([time]), rows)

    def record_block(self, times: Array, values: dict[str, Array]) -> None:
        """Add rows: times (r,) and arrays (r, …), which are copied."""
        self.add({"time": times, **values})

    def add(self, values: dict[str, Array]) -> None:
        """Add rows (r, …) of these variables only, after the last row that they have.

        Raises
        ------
        ResultsError
            If there was no room for rows that were added before.
        """
        for name, block in values.items():
            self._blocks[name].append(np.array(block, dtype=float))
            self._taken[name] += len(block)
            self._held += block.nbytes
        rows = max(self._taken[name] - self._given[name] for name in values)
        if rows >= CHUNK or self._held >= HELD or monotonic() - self._flushed > LATEST:
            self._hand_over()

    def flush(self) -> None:
        """Write what is held in memory, and wait for that.

        Raises
        ------
        ResultsError
            If there is no room for it; what was written before stays.
        """
        self._hand_over()
        self._wait()

    def _hand_over(self) -> None:
        """Have a thread write what is held, while the run goes on; one such job at a time."""
        self._wait()
        self._flushed = monotonic()
        if self._full or not any(self._blocks.values()):
            return
        blocks, self._blocks = self._blocks, {name: [] for name in self._blocks}
        self._given, self._held = dict(self._taken), 0
        self._writing = self._thread.submit(self._write, blocks, dict(self._taken))

    def _wait(self) -> None:
        if self._writing is not None:
            job = self._writing
            wait([job])
            self._writing = None
            job.result()

    def _write(self, blocks_of: dict[str, list[Array]], taken: dict[str, int]) -> None:
        """Write rows up to those taken, times last: a row with a time is there."""
        if taken["time"] > self._rows:
            self._grow(taken["time"])
        for name in (*self._variables, "time"):
            blocks, begin = blocks_of[name], self._written[name]
            if not blocks:
                continue
            rows = blocks[0] if len(blocks) == 1 else np.concatenate(blocks)
            size = rows.nbytes // max(1, len(rows))
            try:
                _write(self._handle, rows, self._offsets[name] + begin * size)
            except OSError as error:
                raise self._no_room(error) from None
            self._written[name] = taken[name]

    def _grow(self, rows: int) -> None:
        """Make room for so many: for much more, or, where the disk is short, just for those."""
        more = max(rows, 4 * self._rows)
        try:
            self._replace(max(rows, min(more, self._expected)) if self._expected else more)
        except ResultsError:
            self._full = False
            self._replace(rows)

    @property
    def rows(self) -> int:
        """Number of communication points recorded."""
        return self._taken["time"]

    # ---- the end --------------------------------------------------------------------------------

    def finish(self) -> None:
        """Write the rest and mark the result as complete."""
        self.flush()
        if self._full:
            return
        if self._rows != self.rows:
            self._replace(self.rows, complete=True)
            return
        import h5py

        with h5py.File(self._path, "r+", track_order=True) as file:
            file.attrs.modify("complete", 1)

    def close(self) -> None:
        """Write the rest, leave out room that was not needed; `complete` stays as it is."""
        if self._handle < 0:
            return
        try:
            self.flush()
            if self._rows != self.rows:
                with suppress(ResultsError):  # then it stays: its times are missing
                    self._replace(self.rows)
        finally:
            self._thread.shutdown()
            self._let_go()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def _check(path: Path, shapes: dict[str, tuple[int, ...]], keep: int) -> dict[str, int]:
    """See that one can go on after so many rows of a file; return where its variables begin."""
    what = "cannot go on with these results"
    try:
        file = read_netcdf(path, ("time",))
    except InputError as error:
        raise InputError(f"{what}: {error.message}", str(path)) from None
    found = file.variables
    missing = [n for n, shape in shapes.items() if n not in found or found[n].shape[1:] != shape]
    time = found["time"].numbers if "time" in found else None
    rows = 0 if time is None else recorded(time)
    if missing or rows < keep:
        there = f"no {missing[0]}" if missing else f"{rows} rows"
        raise InputError(
            f"{what}: expected {keep} rows of {', '.join(shapes)} (there is {there})", str(path)
        )
    size, offsets = path.stat().st_size, {}
    for name, shape in shapes.items():
        offset = found[name].offset
        if keep and (offset is None or offset + 8 * keep * int(np.prod(shape)) > size):
            raise InputError(f"{what}: {name} is not as this version writes it", str(path))
        offsets[name] = offset or 0
    return offsets


def _write(handle: int, rows: Array, at: int) -> None:
    """Write all of an array at a place in a file."""
    left = memoryview(np.ascontiguousarray(rows).data).cast("B")
    os.lseek(handle, at, os.SEEK_SET)
    while left:
        left = left[os.write(handle, left) :]


_OPEN = getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0)
_FLAGS = os.O_RDWR | _OPEN


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

    with h5netcdf.File(results, "r") as file, whole(path) as text:
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
        rows = recorded(file["time"][...])
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
