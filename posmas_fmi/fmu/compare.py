"""Regression: an FMU against a reference result, inside a band as in the FMI cross-check."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from pathlib import Path

import attrs
import numpy as np

from posmas_fmi.bounded import read_bounded
from posmas_fmi.errors import InputError
from posmas_fmi.expression import Array
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.instance import FmuInstance

_BAND = re.compile(r"#\s*band:\s*height\s*=\s*(\S+?),?\s+width\s*=\s*(\S+)\s*$")

LARGEST_FILE = 200_000_000  # bytes


@attrs.frozen
class Band:
    """How far a result may be from its reference.

    Attributes
    ----------
    height : float
        Part of the range of the reference (of its size, where it is constant).
    width : float
        Part of the duration, to either side: the band is as high as the reference gets within it.

    The defaults are those of the FMI cross-check as FMPy applies them: 10 % of the range, 20 of
    1000 samples.
    """

    height: float = 0.1
    width: float = 0.01

    def limits(self, time: Array, reference: Array) -> tuple[Array, Array]:
        """Return the lower and the upper limit at each time.

        Examples
        --------
        >>> time, reference = np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0, 10.0])
        >>> Band(height=0.1, width=0.5).limits(time, reference)
        (array([-1., -1.,  0.]), array([ 2., 11., 11.]))
        """
        extent = float(np.ptp(reference)) or float(np.abs(reference).max()) or 1.0
        reach = self.width * (time[-1] - time[0])
        first = np.searchsorted(time, time - reach * (1 + 1e-12), side="left")
        last = np.searchsorted(time, time + reach * (1 + 1e-12), side="right")
        around = [reference[a:b] for a, b in zip(first, last, strict=True)]
        low = np.array([part.min() for part in around])
        high = np.array([part.max() for part in around])
        return low - self.height * extent, high + self.height * extent


@attrs.frozen
class Reference:
    """A reference result.

    Attributes
    ----------
    names : tuple of str
        Variables, without time.
    time : (n,) ndarray
        Increasing [s].
    values : (n, len(names)) ndarray
    band : Band
    """

    names: tuple[str, ...]
    time: Array
    values: Array
    band: Band


@attrs.frozen
class Deviation:
    """How one variable compares.

    Attributes
    ----------
    name : str
    inside : bool
        Whether it stays within the band.
    largest : float
        Largest distance from the reference, in the variable's unit.
    time : float
        When that was [s].
    """

    name: str
    inside: bool
    largest: float
    time: float


@attrs.frozen
class Comparison:
    """The verdict of `regress`.

    Attributes
    ----------
    passed : bool
        Whether every variable stays within the band.
    deviations : tuple of Deviation
        One per variable compared.
    band : Band
    """

    passed: bool
    deviations: tuple[Deviation, ...]
    band: Band


def read_reference(path: str | Path) -> Reference:
    """Read a reference CSV.

    The first row that is no comment names the columns, ``time`` first. A comment
    ``# band: height=1e-07, width=0`` narrows the band.

    Raises
    ------
    InputError
        If the file cannot be read, a value is missing or not finite, or time does not increase.
    """
    where = str(path)
    try:
        lines = read_bounded(Path(path), LARGEST_FILE).decode("utf-8").splitlines()
    except (OSError, ValueError) as error:
        raise InputError(f"expected a CSV file ({error})", where) from error
    band = Band()
    for line in lines:
        match = _BAND.match(line)
        if match:
            try:
                band = Band(float(match[1]), float(match[2]))
            except ValueError:
                raise InputError(f"expected numbers in {line!r}", where) from None
    rows = list(csv.reader(line for line in lines if line.strip() and not line.startswith("#")))
    if len(rows) < 3:
        raise InputError("expected a row of names and two rows of values or more", where)
    names = [name.strip() for name in rows[0]]
    if names[0] != "time" or len(names) < 2 or len(set(names)) < len(names):
        raise InputError(f"expected columns time, … without repetition (got {names})", where)
    for k, row in enumerate(rows[1:], 2):
        if len(row) != len(names):
            raise InputError(f"expected {len(names)} values (got {len(row)})", f"{where}: row {k}")
    try:
        table = np.array(rows[1:], dtype=float)
    except ValueError as error:
        raise InputError(f"expected numbers ({error})", where) from None
    if not np.isfinite(table).all():
        raise InputError("expected finite values", where)
    if not (np.diff(table[:, 0]) > 0).all():
        raise InputError("expected increasing times", where)
    return Reference(tuple(names[1:]), table[:, 0], table[:, 1:], band)


def regress(fmu: str | Path, reference: str | Path, band: Band | None = None) -> Comparison:
    """Simulate an FMU over a reference result and compare.

    Columns that are inputs of the FMU are set, each held from its row to the next; all others are
    compared. The rows are the communication points. Parameters and start values are the FMU's.

    Parameters
    ----------
    fmu, reference : path-like
    band : Band, optional
        Default: that of the reference file.

    Returns
    -------
    Comparison

    Raises
    ------
    InputError
        If the reference cannot be used, or there is nothing to compare.
    FmuError
        If the FMU has no such variable or fails.
    """
    wanted = read_reference(reference)
    with FmuFile(fmu) as file:
        causality = [file.variable(name).causality for name in wanted.names]
        inputs = [n for n, kind in zip(wanted.names, causality, strict=True) if kind == "input"]
        compared = [n for n in wanted.names if n not in inputs]
        if not compared:
            raise InputError("expected a column to compare (there are only inputs)", str(reference))
        columns = [wanted.names.index(name) for name in inputs]
        with file.instantiate("regress") as instance:
            result = _simulate(instance, wanted.time, inputs, wanted.values[:, columns], compared)
    band = band or wanted.band
    deviations = tuple(
        _deviation(
            name, wanted.time, result[:, k], wanted.values[:, wanted.names.index(name)], band
        )
        for k, name in enumerate(compared)
    )
    return Comparison(all(d.inside for d in deviations), deviations, band)


def _simulate(
    instance: FmuInstance, time: Array, inputs: Sequence[str], values: Array, outputs: Sequence[str]
) -> Array:
    to, of = instance.file.ports(inputs), instance.file.ports(outputs)
    experiment = instance.file.description.defaultExperiment
    tolerance = float(experiment.tolerance) if experiment and experiment.tolerance else None
    start = float(time[0])
    instance.enter_initialization(start=start, stop=float(time[-1]), tolerance=tolerance)
    instance.write(to, values[0])
    instance.exit_initialization()
    result = [instance.read(of)]
    for k in range(len(time) - 1):
        instance.write(to, values[k])
        instance.do_step(float(time[k]), float(time[k + 1] - time[k]))
        result.append(instance.read(of))
    return np.array(result)


def _deviation(name: str, time: Array, result: Array, reference: Array, band: Band) -> Deviation:
    low, high = band.limits(time, reference)
    distance = np.abs(result - reference)
    worst = int(distance.argmax())
    inside = bool(((low <= result) & (result <= high)).all())
    return Deviation(name, inside, float(distance[worst]), float(time[worst]))
