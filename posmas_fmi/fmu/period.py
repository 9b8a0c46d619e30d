"""Which communication periods an FMU allows."""

from __future__ import annotations

from fractions import Fraction
from math import gcd
from typing import Any

import attrs

from posmas_fmi.fmu.about import About
from posmas_fmi.fmu.file import FmuFile

_SAME = 1e-9  # relative: periods that are equal but for the rounding of what was written


@attrs.frozen
class Experiment:
    """What an FMU proposes (DefaultExperiment); None where it says nothing.

    Attributes
    ----------
    start, stop, step : float or None
        [s]; `step` is the communication step size, in Model Exchange that of the solver.
    tolerance : float or None
        Relative, of the solver.
    """

    start: float | None = None
    stop: float | None = None
    step: float | None = None
    tolerance: float | None = None


@attrs.frozen
class PeriodCheck:
    """Whether a period is allowed.

    Attributes
    ----------
    allowed : bool
    reason : str
        Why it is not; empty if it is.
    nearest : float or None
        The nearest period that is allowed [s].
    """

    allowed: bool
    reason: str = ""
    nearest: float | None = None


def default_experiment(file: FmuFile | About) -> Experiment:
    """Return what the FMU proposes."""
    given = file.description.defaultExperiment
    if given is None:
        return Experiment()
    return Experiment(
        _number(given.startTime),
        _number(given.stopTime),
        _number(given.stepSize),
        _number(given.tolerance),
    )


def check_period(file: FmuFile | About, period: float, *, last: float | None = None) -> PeriodCheck:
    """Say whether an FMU allows a communication period.

    Parameters
    ----------
    file : FmuFile or About
    period : float
        [s]
    last : float, optional
        Length of the last step, where it is shorter [s].

    Returns
    -------
    PeriodCheck

    Notes
    -----
    Two attributes of the model description restrict it: ``fixedInternalStepSize`` (FMI 3.0), of
    which a period is a whole multiple, and ``canHandleVariableCommunicationStepSize``, without
    which all steps have the same length, so that clocks can tick at communication points only. For
    a Model Exchange FMU neither holds.
    """
    fixed = _number(getattr(_interface(file), "fixedInternalStepSize", None))
    for length in (period, *(() if last is None else (last,))):
        if not length > 0:
            return PeriodCheck(False, f"expected a period > 0 (got {length:g} s)")
        if fixed and not _multiple(length, fixed):
            whole = max(1, round(length / fixed))
            nearest = float(Fraction(repr(fixed)) * whole)
            return PeriodCheck(
                False,
                f"its solver has steps of {_written(fixed)} s, and {_written(length)} s is no "
                f"whole multiple of them; the nearest is {_written(nearest)} s",
                nearest,
            )
    different = last is not None and abs(last - period) > _SAME * period
    if different and not allows_steps_of_different_length(file):
        return PeriodCheck(
            False,
            "all of its communication steps have the same length "
            f"(the last one would take {last:g} s instead of {period:g} s)",
            period,
        )
    return _ticks_at_points(file, period)


def _ticks_at_points(file: FmuFile | About, period: float) -> PeriodCheck:
    """Whether clocks tick at communication points, where they cannot in between."""
    about = file if isinstance(file, About) else file.about
    if allows_steps_of_different_length(file):
        return PeriodCheck(True)
    for clock in about.clocks:
        if not clock.periodic or clock.interval is None:
            continue
        interval, shift = float(clock.interval), float(clock.shift)
        if not (_multiple(interval, period) and (not shift or _multiple(shift, period))):
            grid = _common(clock.interval, clock.shift)
            nearest = float(grid / max(1, round(float(grid) / period)))
            return PeriodCheck(
                False,
                f"its clock {clock.name!r} ticks every {interval:g} s, between communication "
                "points, and it takes no steps of different length; the nearest is "
                f"{_written(nearest)} s",
                nearest,
            )
    return PeriodCheck(True)


def _common(interval: Fraction, shift: Fraction) -> Fraction:
    """Largest time that both are whole multiples of."""
    denominator = interval.denominator * shift.denominator
    whole = gcd(int(interval * denominator), int(shift * denominator))
    return Fraction(whole, denominator)


def allows_steps_of_different_length(file: FmuFile | About) -> bool:
    """Return whether the communication step size may change during a run."""
    interface = _interface(file)
    return bool(getattr(interface, "canHandleVariableCommunicationStepSize", True))


def _interface(file: FmuFile | About) -> Any:
    about = file if isinstance(file, About) else file.about
    return about.interface


def _multiple(length: float, unit: float) -> bool:
    ratio = length / unit
    return round(ratio) >= 1 and abs(ratio - round(ratio)) <= _SAME * ratio


def _written(time: float) -> str:
    """Return a time as one may copy it: all digits where fewer are another time."""
    return f"{time:g}" if float(f"{time:g}") == time else repr(time)


def _number(given: Any) -> float | None:
    try:
        return None if given in (None, "") else float(given)
    except (TypeError, ValueError):  # as if it were not there; `posmas-fmi check` tells
        return None
