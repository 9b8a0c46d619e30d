"""Signals from outside: read from CSV files, checked, and sampled at communication points."""

from __future__ import annotations

import csv
from pathlib import Path

import attrs
import numpy as np

from posmas_fmi.cosim.clock import Clock
from posmas_fmi.errors import InputError
from posmas_fmi.expression import Array
from posmas_fmi.scenario.tables import SignalTable

LARGEST_FILE = 1_000_000_000  # bytes


@attrs.frozen(eq=False)
class Signal:
    """A table of values over time.

    Attributes
    ----------
    time : (n,) array
        Increasing [s].
    values : (n, columns) array
    linear : bool
        Whether values between two times are interpolated, else the last one holds.
    """

    time: Array
    values: Array
    linear: bool = False

    def at(self, times: Array) -> Array:
        """Values at some times, (len(times), columns); beyond the table they stay.

        Examples
        --------
        >>> ramp = Signal(np.array([0.0, 2.0]), np.array([[1.0], [3.0]]), linear=True)
        >>> ramp.at(np.array([1.0, 5.0])).ravel()
        array([2., 3.])
        """
        if self.linear:
            columns = [np.interp(times, self.time, column) for column in self.values.T]
            return np.stack(columns, axis=1)
        place = np.searchsorted(self.time, times, side="right") - 1
        return np.asarray(self.values[np.maximum(place, 0)])


@attrs.frozen
class Columns:
    """Where a signal stands among all.

    Attributes
    ----------
    first, count : int
        First column and number of columns.
    unit : str or None
    """

    first: int
    count: int
    unit: str | None = None


@attrs.frozen(eq=False)
class Signals:
    """All signals of a scenario side by side; implements `posmas_fmi.cosim.wiring.Drive`.

    Attributes
    ----------
    signals : tuple of Signal
    clock : Clock
    """

    signals: tuple[Signal, ...]
    clock: Clock

    @property
    def columns(self) -> int:
        """How many columns all signals have."""
        return sum(signal.values.shape[1] for signal in self.signals)

    def rows(self, begin: int, end: int) -> Array:
        """Values at the communication points begin … end - 1."""
        times = np.array([self.clock.time(k) for k in range(begin, end)])
        return np.concatenate([signal.at(times) for signal in self.signals], axis=1)


def read_signal(name: str, table: SignalTable, agents: int, folder: Path) -> Signal:
    """Make a signal of its table.

    Parameters
    ----------
    name : str
    table : SignalTable
    agents : int
        A signal has one column, or one for each agent.
    folder : Path
        Of the scenario.

    Raises
    ------
    InputError
        If the file cannot be read, has gaps or times that do not increase, or lacks columns.
    """
    place = f"$.signals.{name}"
    if (table.value is None) == (table.file is None):
        raise InputError("expected either value or file", place)
    if table.value is not None:
        return Signal(np.zeros(1), np.full((1, 1), table.scale * table.value + table.offset))
    path = folder / str(table.file)
    header, rows = _read(path, place)
    wanted = table.columns or header[1:]
    missing = [column for column in wanted if column not in header]
    if missing:
        raise InputError(
            f"{path.name} has no column {missing[0]!r} (it has {', '.join(header[:8])})",
            f"{place}.columns",
        )
    if len(wanted) not in (1, agents):
        raise InputError(
            f"expected one column or {agents}, one for each agent (got {len(wanted)})",
            f"{place}.columns",
        )
    time = rows[:, 0]
    late = np.flatnonzero(np.diff(time) <= 0)
    if late.size:
        raise InputError(
            f"{path.name}, line {late[0] + 3}: expected increasing times (got "
            f"{time[late[0] + 1]:g} s after {time[late[0]]:g} s)",
            f"{place}.file",
        )
    values = rows[:, [header.index(column) for column in wanted]]
    return Signal(time, table.scale * values + table.offset, table.interpolation == "linear")


def _read(path: Path, place: str) -> tuple[list[str], Array]:
    """Header and numbers of a CSV file; every cell must be a finite number."""
    where = f"{place}.file"
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise InputError(f"{path.name} is larger than {LARGEST_FILE:g} bytes", where)
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file) if row]
    except FileNotFoundError:
        raise InputError(f"there is no file {path.name!r} beside the scenario", where) from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path.name} cannot be read as CSV: {error}", where) from None
    if len(rows) < 2 or len(rows[0]) < 2:
        raise InputError(
            f"{path.name}: expected a header, a column of times and one of values", where
        )
    header = [name.strip() for name in rows[0]]
    numbers = np.empty((len(rows) - 1, len(header)))
    for k, row in enumerate(rows[1:]):
        try:
            if len(row) != len(header):
                raise ValueError(f"{len(row)} cells")
            numbers[k] = [float(cell) for cell in row]
        except ValueError as error:
            raise InputError(
                f"{path.name}, line {k + 2}: expected {len(header)} numbers ({error})", where
            ) from None
    bad = np.argwhere(~np.isfinite(numbers))
    if len(bad):
        k, column = bad[0]
        raise InputError(
            f"{path.name}, line {k + 2}: {header[column]} is not finite; fill the gap", where
        )
    return header, numbers
