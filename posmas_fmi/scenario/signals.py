"""Signals from outside: read from files, checked, and sampled at communication points."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from posmas_fmi.bounded import require_regular
from posmas_fmi.cosim.clock import Clock
from posmas_fmi.errors import InputError
from posmas_fmi.expression import Array
from posmas_fmi.scenario.tables import Generated, SignalTable

LARGEST_FILE = 1_000_000_000  # bytes
NETCDF = (".nc", ".nc4", ".cdf")


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
    linear : bool
        Whether it goes on linearly between the times of its table.
    """

    first: int
    count: int
    unit: str | None = None
    linear: bool = False


@attrs.frozen(eq=False)
class Signals:
    """All signals of a scenario side by side; implements `posmas_fmi.cosim.wiring.Drive`.

    Attributes
    ----------
    signals : tuple of Signal
    clock : Clock
    rates : tuple of (int, int)
        A column and a number of communication steps, for a further column each: its mean rate of
        change over the steps that follow [1/s].
    """

    signals: tuple[Signal, ...]
    clock: Clock
    rates: tuple[tuple[int, int], ...] = ()

    @property
    def columns(self) -> int:
        """How many columns there are, those of rates last."""
        return sum(int(s.values.shape[1]) for s in self.signals) + len(self.rates)

    def rows(self, begin: int, end: int) -> Array:
        """Values at the communication points begin … end - 1."""
        longest = max((steps for _, steps in self.rates), default=0)
        times = np.array([self.clock.time(k) for k in range(begin, end + longest)])
        values = np.concatenate([signal.at(times) for signal in self.signals], axis=1)
        here = values[: end - begin]
        rates = [
            (values[steps : steps + len(here), [one]] - here[:, [one]]) / (steps * self.clock.h)
            for one, steps in self.rates
        ]
        return np.concatenate([here, *rates], axis=1)


def read_signal(
    name: str,
    table: SignalTable,
    agents: int,
    folder: Path,
    until: float = 0.0,
    period: float = 1.0,
    seed: int = 0,
) -> Signal:
    """Make a signal of its table.

    Parameters
    ----------
    name : str
    table : SignalTable
    agents : int
        A signal has one column, or one for each agent.
    folder : Path
        Of the scenario.
    until, period : float
        Of the scenario [s], for loads that are generated.
    seed : int

    Raises
    ------
    InputError
        If the file cannot be read, has gaps or times that do not increase, or lacks columns.
    """
    place = f"$.signals.{name}"
    given = [k for k in ("value", "values", "generated", "file") if getattr(table, k) is not None]
    if len(given) != 1:
        raise InputError(
            "expected one of value, values (with times), generated and file "
            f"(got {' and '.join(given) or 'none'})",
            place,
        )
    if table.generated is not None:
        return _scaled(_generate(table.generated, agents, until, period, seed), table)
    if table.values is not None:
        return _scaled(_listed(table, agents, place), table)
    if table.value is not None:
        return Signal(np.zeros(1), np.full((1, 1), table.scale * table.value + table.offset))
    path = folder / str(table.file)
    netcdf = path.suffix.lower() in NETCDF
    header, rows = _read_netcdf(path, place, table) if netcdf else _read(path, place)
    wanted = _wanted(table.columns, header)
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
        where = f"entry {late[0] + 2}" if netcdf else f"line {late[0] + 3}"
        raise InputError(
            f"{path.name}, {where}: expected increasing times (got "
            f"{time[late[0] + 1]:g} s after {time[late[0]]:g} s)",
            f"{place}.file",
        )
    values = rows[:, [header.index(column) for column in wanted]]
    gaps = np.argwhere(~np.isfinite(values))
    if len(gaps) or not np.isfinite(time).all():
        where = f"entry {gaps[0][0] + 1}: {wanted[gaps[0][1]]}" if len(gaps) else "time"
        raise InputError(f"{path.name}, {where} is not finite; fill the gap", f"{place}.file")
    return Signal(time, table.scale * values + table.offset, table.interpolation == "linear")


def _wanted(columns: list[str], header: list[str]) -> list[str]:
    """Columns that are asked for; the name of a variable with several columns stands for all."""
    found: list[str] = []
    for column in columns or header[1:]:
        several = [name for name in header if name.startswith(f"{column}[")]
        found += several if column not in header and several else [column]
    return found


def _scaled(signal: Signal, table: SignalTable) -> Signal:
    values = table.scale * signal.values + table.offset
    return Signal(signal.time, values, table.interpolation == "linear")


def _listed(table: SignalTable, agents: int, place: str) -> Signal:
    """Read a signal that stands in the scenario itself."""
    times, rows = table.times or [], table.values or []
    if len(times) != len(rows) or not rows:
        raise InputError(f"expected a time for each value (got {len(times)}, {len(rows)})", place)
    whole = [row if isinstance(row, list) else [row] for row in rows]
    columns = max(map(len, whole))
    for k, row in enumerate(whole):
        if len(row) not in (1, columns) or columns not in (1, agents):
            raise InputError(
                f"expected one value or {agents}, one for each agent (got {len(row)})",
                f"{place}.values[{k}]",
            )
    if (np.diff(times) <= 0).any():
        raise InputError("expected increasing times", f"{place}.times")
    return Signal(np.array(times), np.array([np.broadcast_to(row, columns) for row in whole]))


def _generate(table: Generated, agents: int, until: float, period: float, seed: int) -> Signal:
    """Generate heat loads, one column for each agent."""
    from posmas_fmi.cooling.loads import generate_loads, training_loads

    seed = seed if table.seed is None else table.seed
    if table.kind == "training":
        step = period if table.step is None else table.step
        loads = training_loads(agents, max(until, step), seed, table.maximum, step)
    else:
        step = 15.0 if table.step is None else table.step
        loads = generate_loads(agents, max(until, step), seed, table.maximum, step)
    return Signal(loads.time, loads.power)


def _read_netcdf(path: Path, place: str, table: SignalTable) -> tuple[list[str], Array]:
    """Names and numbers of the variables over ``time`` of a NetCDF-4 file, as of a CSV file.

    A variable over time and another dimension gives the columns ``name[1]``, ``name[2]``, …
    """
    from posmas_fmi.netcdf import read_netcdf

    where = f"{place}.file"
    if not path.is_file():
        raise InputError(f"there is no file {path.name!r} beside the scenario", where)
    try:
        file = read_netcdf(path, limit=LARGEST_FILE)
    except InputError as error:
        remedy = "export it again, or give it as CSV"
        raise InputError(f"{path.name}: {error.message}; {remedy}", where) from None
    time = file.variables.get("time")
    if time is None or time.numbers is None or time.dims != ("time",):
        raise InputError(f"{path.name}: expected a variable time over time [s]", where)
    _check_seconds(time.attrs.get("units", "s"), path, where)
    header, columns = ["time"], [time.numbers[:, None]]
    for name, variable in file.variables.items():
        numbers = variable.numbers
        if name == "time" or numbers is None or variable.dims[:1] != ("time",):
            continue
        if len(variable.dims) > 2 or len(numbers) != len(columns[0]):
            continue
        values = numbers.reshape(len(numbers), -1)
        one = len(variable.dims) == 1
        header += [name] if one else [f"{name}[{k + 1}]" for k in range(values.shape[1])]
        columns.append(values)
        if not table.columns or {name, *header[-values.shape[1] :]} & set(table.columns):
            _check_unit(variable.attrs.get("units"), table, f"{path.name}, {name}", place)
    if len(header) < 2 or not len(columns[0]):
        raise InputError(f"{path.name}: expected a variable over time beside time", where)
    return header, np.concatenate(columns, axis=1)


def _check_unit(unit: Any, table: SignalTable, what: str, place: str) -> None:
    """Refuse a file that contradicts the scenario, unless it is scaled there."""
    scaled = table.scale != 1.0 or table.offset != 0.0
    if unit is not None and table.unit is not None and unit != table.unit and not scaled:
        raise InputError(
            f"{what}: the file says {unit!r} and the scenario {table.unit!r}; write scale and "
            "offset, or the unit of the file",
            f"{place}.unit",
        )


def _check_seconds(unit: Any, path: Path, where: str) -> None:
    if unit not in ("s", "sec", "second", "seconds"):
        raise InputError(f"{path.name}: expected time in s (got {unit!r})", where)


def _read(path: Path, place: str) -> tuple[list[str], Array]:
    """Header and numbers of a CSV file; every cell must be a finite number."""
    where = f"{place}.file"
    try:
        require_regular(path)
        if path.stat().st_size > LARGEST_FILE:
            raise InputError(f"{path.name} is larger than {LARGEST_FILE:g} bytes", where)
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file) if row]
    except FileNotFoundError:
        raise InputError(f"there is no file {path.name!r} beside the scenario", where) from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path.name} cannot be read as CSV: {error}", where) from None
    if len(rows) < 2 or len(rows[0]) < 2:
        comma = "; columns are separated by commas" if rows and ";" in "".join(rows[0]) else ""
        raise InputError(
            f"{path.name}: expected a header, a column of times and one of values{comma}", where
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
