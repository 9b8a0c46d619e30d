"""Results as NetCDF-4, written in chunks while the run goes on."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Any

import attrs
import numpy as np

from posmas_fmi.expression import Array
from posmas_fmi.network import Network

CHUNK = 512  # rows held in memory before they are written


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
    """

    def __init__(
        self,
        path: Path,
        layout: Layout,
        network: Network,
        variables: tuple[str, ...],
        attributes: dict[str, Any],
    ) -> None:
        import h5netcdf
        import h5py

        self._layout = layout
        self._blocks: dict[str, list[Array]] = {name: [] for name in ("time", *variables)}
        self._taken: dict[str, int] = dict.fromkeys(self._blocks, 0)  # rows, written or not
        self._written = dict(self._taken)
        # opened below h5netcdf, whose own flush leaves everything in memory; NetCDF wants the order
        self._disk = h5py.File(path, "w", track_order=True)
        self._file = h5netcdf.File(self._disk, "a")
        self._define(network, variables, attributes)
        # rows go past h5netcdf, which takes milliseconds for each write
        self._data = {name: self._disk[name] for name in self._blocks}

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
        if max(self._taken[name] - self._written[name] for name in values) >= CHUNK:
            self.flush()

    def flush(self) -> None:
        """Write what is held in memory."""
        for name, data in self._data.items():
            if len(data) < self._taken["time"]:
                data.resize(self._taken["time"], axis=0)
            blocks = self._blocks[name]
            if blocks:
                rows = blocks[0] if len(blocks) == 1 else np.concatenate(blocks)
                data[self._written[name] : self._taken[name]] = rows
                blocks.clear()
        self._written = dict(self._taken)
        self._disk.flush()

    @property
    def rows(self) -> int:
        """Number of communication points recorded."""
        return self._taken["time"]

    def finish(self) -> None:
        """Write the rest and mark the result as complete."""
        self.flush()
        self._file.attrs["complete"] = 1

    def close(self) -> None:
        """Write the rest and close the file; `complete` stays as it is."""
        self.flush()
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


def _text() -> Any:
    import h5py

    return h5py.string_dtype("utf-8")


def _chunks(sizes: tuple[int, ...]) -> tuple[int, ...]:
    """About one megabyte per chunk, at least one row, at most `CHUNK` rows."""
    row = 8 * int(np.prod(sizes))
    return (max(1, min(CHUNK, 1_000_000 // max(1, row))), *sizes)
