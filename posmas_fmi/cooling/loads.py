"""Heat loads of the lines over time: generated from fitted statistics, AI training, CSV files."""

from __future__ import annotations

import csv
import gzip
import math
import re
import zlib
from collections.abc import Sequence
from pathlib import Path

import attrs
import numpy as np

from posmas_fmi.bounded import require_regular
from posmas_fmi.errors import InputError
from posmas_fmi.expression import Array

_POWER = {"W": 1.0, "kW": 1e3, "MW": 1e6}
_TEMPERATURE = {"degC": 273.15, "K": 0.0}
_LARGEST_FILE = 1_000_000_000  # bytes, unpacked
_LARGEST = 1e8  # W for one line: beyond it a unit is wrong


def _array(value: object) -> Array:
    array = np.array(value, dtype=float)
    array.flags.writeable = False
    return array


@attrs.frozen(eq=False)
class Loads:
    """Heat loads of N lines, each value held until the next time.

    Parameters
    ----------
    time : (n,) array_like
        Increasing [s].
    power : (n, N) array_like
        Heat loads [W], not negative.
    names : tuple of str
        Of the lines; default 1, 2, …
    conditions : dict of str to (n,) array
        Temperatures given beside the loads, such as the outdoor wet bulb [K].

    Raises
    ------
    InputError
        On shapes that do not fit, times that do not increase, values that are not finite or loads
        that are negative; the message names time and line.

    Examples
    --------
    >>> loads = Loads([0.0, 10.0], [[80e3], [90e3]])
    >>> loads.at(9.9), loads.at(10.0)
    (array([80000.]), array([90000.]))
    """

    time: Array = attrs.field(converter=_array)
    power: Array = attrs.field(converter=_array)
    names: tuple[str, ...] = ()
    conditions: dict[str, Array] = attrs.field(factory=dict)

    def __attrs_post_init__(self) -> None:
        shape = self.power.shape
        if self.time.ndim != 1 or self.power.ndim != 2 or shape[0] != len(self.time):
            raise InputError(
                f"expected (n,) times and (n, N) loads (got {self.time.shape}, {shape})", "loads"
            )
        if self.power.size == 0:
            raise InputError("expected at least one time and one line", "loads")
        if not self.names:
            names = tuple(str(k + 1) for k in range(shape[1]))
            object.__setattr__(self, "names", names)
        if len(self.names) != shape[1]:
            raise InputError(f"expected {shape[1]} names (got {len(self.names)})", "loads")
        if not np.isfinite(self.time).all():
            raise InputError("expected finite times", "loads")
        late = np.flatnonzero(np.diff(self.time) <= 0)
        if late.size:
            k = int(late[0])
            raise InputError(
                f"expected increasing times (got {self.time[k + 1]:g} s after {self.time[k]:g} s); "
                "sort the rows and remove doubles",
                "loads",
            )
        for bad, what in ((~np.isfinite(self.power), "finite"), (self.power < 0, "non-negative")):
            if bad.any():
                k, i = (int(v) for v in np.argwhere(bad)[0])
                raise InputError(
                    f"expected {what} loads (got {self.power[k, i]:g} W for line "
                    f"{self.names[i]!r} at {self.time[k]:g} s)",
                    "loads",
                )

    @property
    def lines(self) -> int:
        """Number of lines."""
        return int(self.power.shape[1])

    def at(self, time: float) -> Array:
        """Return the load of each line [W] at a time [s], (N,); the ends are held."""
        k = int(np.searchsorted(self.time, time, side="right")) - 1
        return np.asarray(self.power[max(k, 0)])

    def sampled(self, times: Array) -> Array:
        """Return the loads at many times, (len(times), N)."""
        k = np.searchsorted(self.time, times, side="right") - 1
        return np.asarray(self.power[np.maximum(k, 0)])


# ---- generated ----------------------------------------------------------------------------------


@attrs.frozen
class LoadModel:
    """Statistics of the loads of a large machine, fitted to a day of Frontier.

    The day has 25 cooling units. A common two-state telegraph signal, followed at a limited rate,
    times an Ornstein-Uhlenbeck process of each line, plus jobs that start on single lines.

    Attributes
    ----------
    low, high : float
        The two levels, of the maximum.
    short, long, long_share : float
        Mean dwell times [s] of which each dwell draws one, and how often it is the long one: a
        single exponential would not give both the many short dwells and the slow decay of the
        autocorrelation that the day shows.
    ramp : float
        Largest change of the common signal [of the maximum per s].
    noise, noise_time : float
        Relative size and time constant [s] of the noise of a line.
    jobs, job_size, job_time : float
        Job starts per line and hour; their mean relative size; their mean duration [s].
    """

    low: float = 0.27
    high: float = 0.93
    short: float = 600.0
    long: float = 6600.0
    long_share: float = 0.35
    ramp: float = 0.004
    noise: float = 0.04
    noise_time: float = 90.0
    jobs: float = 0.5
    job_size: float = 0.05
    job_time: float = 1200.0


def generate_loads(
    lines: int,
    until: float,
    seed: int,
    maximum: float | Sequence[float] = 130e3,
    step: float = 15.0,
    model: LoadModel | None = None,
) -> Loads:
    """Generate loads with the statistics of `LoadModel`.

    Parameters
    ----------
    lines : int
    until : float
        Last time [s].
    seed : int
        The same seed gives the same loads.
    maximum : float or (N,) sequence of float
        Load of each line at the level 1 [W]; nothing is above it.
    step : float
        Between the values [s].
    model : LoadModel, optional

    Raises
    ------
    InputError
        If `lines`, `until`, `step` or a maximum are not positive.

    Examples
    --------
    >>> loads = generate_loads(8, until=3600.0, seed=1)
    >>> loads.power.shape
    (241, 8)
    """
    _check_sizes(lines, until, step)
    model = LoadModel() if model is None else model
    top = np.broadcast_to(np.asarray(maximum, dtype=float), (lines,))
    if not (np.isfinite(top) & (top > 0)).all():
        raise InputError(f"expected maxima > 0 (got {maximum})", "loads.maximum")
    # one stream each: more lines or noise leave the common signal as it is
    for_common, for_noise, for_jobs = np.random.default_rng(seed).spawn(3)
    time = _grid(until, step)
    common = _telegraph(time, model, for_common)
    own = 1 + model.noise * _ornstein_uhlenbeck(
        len(time), lines, step / model.noise_time, for_noise
    )
    own += _jobs(time, lines, model, for_jobs)
    return Loads(time, np.clip(common[:, None] * own, 0.0, 1.0) * top)


def _telegraph(time: Array, model: LoadModel, random: np.random.Generator) -> Array:
    mean = (1 - model.long_share) * model.short + model.long_share * model.long
    level = bool(random.random() < 0.5)
    edge, edges, levels = 0.0, [], []
    while edge <= time[-1]:
        edges.append(edge)
        levels.append(model.high if level else model.low)
        # the dwell that is running at the start is a long one more often than those that follow
        share = model.long_share if edge > 0 else model.long_share * model.long / mean
        edge += random.exponential(model.long if random.random() < share else model.short)
        level = not level
    target = np.array(levels)[np.searchsorted(edges, time, side="right") - 1]
    signal = np.empty(len(time))
    signal[0] = target[0]
    steps = model.ramp * np.diff(time)
    for k, most in enumerate(steps):
        signal[k + 1] = signal[k] + min(max(target[k + 1] - signal[k], -most), most)
    return signal


def _ornstein_uhlenbeck(
    n: int, lines: int, relative_step: float, random: np.random.Generator
) -> Array:
    """Stationary processes of unit variance, exactly discretised, (n, lines)."""
    from scipy.signal import lfilter

    kept = math.exp(-relative_step)
    noise = random.standard_normal((n, lines))
    noise[1:] *= math.sqrt(1 - kept**2)
    return np.asarray(lfilter([1.0], [1.0, -kept], noise, axis=0))


def _jobs(time: Array, lines: int, model: LoadModel, random: np.random.Generator) -> Array:
    """Relative load of single jobs, each from its start to its end, (n, lines)."""
    extra = np.zeros((len(time), lines))
    before = 3 * model.job_time  # jobs that run already
    counts = random.poisson(model.jobs * (time[-1] + before) / 3600, lines)
    for line, count in enumerate(counts):
        starts = random.uniform(-before, time[-1], count)
        ends = starts + random.exponential(model.job_time, count)
        sizes = random.exponential(model.job_size, count)
        for a, b, size in zip(starts, ends, sizes, strict=True):
            extra[(time >= a) & (time < b), line] += size
    return extra


@attrs.frozen
class Training:
    """AI training: all lines swing nearly in unison with each iteration, and stall at checkpoints.

    Attributes
    ----------
    low, high : float
        Levels of the trapezium, of the maximum.
    frequency : float
        Iterations per second, 0.2 to 3 as published for large training runs.
    rise, top : float
        Parts of the period that one edge and the upper level take.
    checkpoint, stall : float
        Time between checkpoints and duration of each, at the low level [s].
    skew : float
        Standard deviation of a line's phase, of the period.
    """

    low: float = 0.35
    high: float = 0.95
    frequency: float = 0.5
    rise: float = 0.1
    top: float = 0.5
    checkpoint: float = 900.0
    stall: float = 60.0
    skew: float = 0.02

    def __attrs_post_init__(self) -> None:
        if not 0 <= self.low <= self.high <= 1:
            raise InputError(f"expected 0 <= low <= high <= 1 (got {self.low}, {self.high})")
        if not (self.rise > 0 and self.top >= 0 and 2 * self.rise + self.top <= 1):
            raise InputError("expected 0 < rise, 0 <= top and 2 rise + top <= 1", "training")
        if not (self.frequency > 0 and 0 <= self.stall < self.checkpoint):
            raise InputError("expected frequency > 0 and 0 <= stall < checkpoint", "training")


def training_loads(
    lines: int,
    until: float,
    seed: int,
    maximum: float = 130e3,
    step: float = 0.1,
    mode: Training | None = None,
) -> Loads:
    """Generate loads of AI training: the exact mean of the swings over each step.

    So a coarse step loses the swings and not the energy, and does not alias.

    Parameters
    ----------
    lines : int
    until : float
        Last time [s].
    seed : int
    maximum : float
        Load of a line at the level 1 [W].
    step : float
        Between the values [s]; a tenth of the period or less shows the swings.
    mode : Training, optional

    Examples
    --------
    >>> fast = training_loads(4, until=60.0, seed=1, step=0.1)
    >>> slow = training_loads(4, until=60.0, seed=1, step=5.0)
    >>> round(float(fast.power[:-1].mean() / slow.power[:-1].mean()), 6)
    1.0
    """
    _check_sizes(lines, until, step)
    mode = Training() if mode is None else mode
    random = np.random.default_rng(seed)
    phase = 0.5 + mode.skew * random.standard_normal(lines)
    first = random.uniform(0, mode.checkpoint)  # when the first stall begins
    edges = _grid(until + step, step)
    stalled = _stalled(edges, first, mode)
    # iterations go on in the time without stalls, so their number is the phase
    swings = _swing_integral((edges - stalled)[:, None] * mode.frequency + phase, mode)
    energy = mode.low * edges[:, None] + (mode.high - mode.low) * swings / mode.frequency
    return Loads(edges[:-1], np.clip(np.diff(energy, axis=0) / step, 0.0, 1.0) * maximum)


def _stalled(time: Array, first: float, mode: Training) -> Array:
    """Return how much of the time up to each point was stalled [s]."""
    since = time - first
    whole = np.floor(since / mode.checkpoint)
    part = np.minimum(since - whole * mode.checkpoint, mode.stall)
    return np.where(since > 0, whole * mode.stall + part, 0.0)


def _swing_integral(phase: Array, mode: Training) -> Array:
    """Integral of the trapezium between 0 and 1 over the phase."""
    whole = np.floor(phase)
    x = phase - whole
    r, end = mode.rise, mode.rise + mode.top
    up = np.minimum(x, r)
    flat = np.clip(x - r, 0.0, mode.top)
    down = np.clip(x - end, 0.0, r)
    return whole * (r + mode.top) + up**2 / (2 * r) + flat + down - down**2 / (2 * r)


def _grid(until: float, step: float) -> Array:
    return np.arange(math.floor(until / step + 1e-9) + 1, dtype=float) * step


def _check_sizes(lines: int, until: float, step: float) -> None:
    if lines < 1:
        raise InputError(f"expected at least one line (got {lines})", "loads.lines")
    if not (0 < step <= until < math.inf):
        raise InputError(f"expected 0 < step <= until (got {step:g}, {until:g} s)", "loads")


# ---- files --------------------------------------------------------------------------------------


def read_loads(path: str | Path, max_gap: float | None = None) -> Loads:
    """Read loads from a CSV file, also compressed (``.csv.gz``).

    The header names the columns with their units: ``time_s`` first, then loads such as
    ``rack1_kW`` (W, kW, MW) and temperatures such as ``wet_bulb_degC`` (degC, K).

    Parameters
    ----------
    path : path-like
    max_gap : float, optional
        Longest time between two rows [s]; default five times the median. Over a gap the last
        values are held.

    Raises
    ------
    InputError
        If the file cannot be read, a unit is missing or not known, a value is missing or no
        number, times do not increase, there is a gap, a load is negative or absurdly large.
    """
    where = str(path)
    rows = _rows(Path(path), where)
    columns = [_column(name, where) for name in rows[0][1:]]
    if rows[0][0].strip() != "time_s":
        raise InputError(f"expected the first column time_s (got {rows[0][0]!r})", where)
    table = _table(rows, where)
    loads = [k for k, (_, unit) in enumerate(columns) if unit in _POWER]
    if not loads:
        raise InputError("expected a column with a load, such as rack1_kW", where)
    factors = np.array([_POWER[columns[k][1]] for k in loads])
    power = table[:, 1:][:, loads] * factors
    _check_power(power, [rows[0][k + 1] for k in loads], where)
    try:
        result = Loads(
            table[:, 0],
            power,
            tuple(columns[k][0] for k in loads),
            {
                name: table[:, k + 1] + _TEMPERATURE[unit]
                for k, (name, unit) in enumerate(columns)
                if unit in _TEMPERATURE
            },
        )
    except InputError as error:
        raise InputError(error.message, where) from None
    _check_gaps(result.time, max_gap, where)
    return result


def _rows(path: Path, where: str) -> list[list[str]]:
    try:
        require_regular(path)
        with path.open("rb") as file:
            packed = file.read(2) == b"\x1f\x8b"
            file.seek(0)
            source = gzip.GzipFile(fileobj=file) if packed else file
            data = source.read(_LARGEST_FILE + 1)
        if len(data) > _LARGEST_FILE:
            raise ValueError(f"it is larger than {_LARGEST_FILE:g} bytes")
        rows = [row for row in csv.reader(data.decode("utf-8").splitlines()) if row]
    except (OSError, EOFError, ValueError, zlib.error, csv.Error) as error:
        raise InputError(f"expected a CSV file ({error})", where) from error
    if len(rows) < 2:
        raise InputError("expected a row of names and a row of values or more", where)
    return rows


def _column(name: str, where: str) -> tuple[str, str]:
    match = re.fullmatch(r"\s*(.+)_([A-Za-z]+)\s*", name)
    if not match or match[2] not in _POWER | _TEMPERATURE:
        units = ", ".join(_POWER | _TEMPERATURE)
        raise InputError(
            f"expected a name that ends in a unit ({units}), such as rack1_kW (got {name!r})",
            where,
        )
    return match[1], match[2]


def _table(rows: list[list[str]], where: str) -> Array:
    width = len(rows[0])
    for k, row in enumerate(rows[1:], 2):
        if len(row) != width:
            raise InputError(f"expected {width} values (got {len(row)})", f"{where}: row {k}")
    table = np.empty((len(rows) - 1, width))
    for k, row in enumerate(rows[1:]):
        for i, text in enumerate(row):
            place = f"{where}: row {k + 2}, {rows[0][i]}"
            try:
                table[k, i] = float(text)
            except ValueError:
                raise InputError(f"expected a number (got {text!r})", place) from None
            if not math.isfinite(table[k, i]):
                raise InputError(f"expected a finite number (got {text!r})", place)
    return table


def _check_power(power: Array, names: Sequence[str], where: str) -> None:
    if power.max() > _LARGEST:
        i = int(power.max(axis=0).argmax())
        raise InputError(
            f"{power.max():.3g} W for one line ({names[i]}) cannot be; check the unit", where
        )


def _check_gaps(time: Array, max_gap: float | None, where: str) -> None:
    steps = np.diff(time)
    if not steps.size:
        return
    most = 5 * float(np.median(steps)) if max_gap is None else max_gap
    k = int(steps.argmax())
    if steps[k] > most * (1 + 1e-9):
        raise InputError(
            f"a gap of {steps[k]:g} s after {time[k]:g} s (longest allowed {most:g} s); fill it, "
            "or give max_gap to hold the last values over it",
            where,
        )
