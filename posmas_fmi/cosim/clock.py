"""Integer time: ticks inside, nominal seconds outside, so that nothing drifts."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import attrs
import numpy as np

from posmas_fmi.errors import InputError
from posmas_fmi.expression import Array

TICKS_PER_SECOND = 1_000_000_000
LONGEST = 9e9  # s: nanoseconds are counted in 64 bits
_MOST_PARTS = 100_000  # of a second, of which a period that is a fraction is a multiple
_SAME = 1e-9  # relative: ends that are equal but for the rounding of what was written


@attrs.frozen
class Clock:
    """Communication points ``t_k = t0 + k·h`` on a grid of ticks.

    Attributes
    ----------
    period : int
        Communication step [ticks].
    steps : int
        Number of communication steps.
    per_second : int
        Ticks in a second: nanoseconds, or the parts of a second of which the period is made.

    Examples
    --------
    >>> clock = Clock.of(until=10.0, period=0.005)
    >>> clock.steps, clock.time(3), clock.time(2000)
    (2000, 0.015, 10.0)
    >>> Clock.of(until=1.0, period=1 / 60)
    Clock(period=1, steps=60, per_second=60)
    """

    period: int
    steps: int
    per_second: int = TICKS_PER_SECOND

    @classmethod
    def of(cls, until: float, period: float) -> Clock:
        """Make the clock of a run.

        Raises
        ------
        InputError
            If the period is neither a whole number of nanoseconds nor the float of a fraction, or
            `until` no multiple of it, or one of them is longer than `LONGEST`.
        """
        for name, value in (("period", period), ("until", until)):
            if not abs(value) <= LONGEST:
                raise InputError(
                    f"expected at most {LONGEST:g} s (got {value!r} s)", f"$.scenario.{name}"
                )
        ticks, per_second = _ticks(period)
        end = round(until * per_second)
        fits = per_second == TICKS_PER_SECOND or abs(end - until * per_second) <= _SAME * end
        if end < ticks or end % ticks or not fits:
            raise InputError(
                f"expected until to be a multiple of the period {period:g} s (got {until!r} s); "
                f"{max(1, round(end / ticks)) * ticks / per_second:.9g} s is one",
                "$.scenario.until",
            )
        return cls(ticks, end // ticks, per_second)

    @property
    def h(self) -> float:
        """The nominal communication step [s], the one that is passed to every FMU."""
        return self.period / self.per_second

    def time(self, k: int) -> float:
        """Time of communication point k [s]."""
        return k * self.period / self.per_second

    def times(self, k: np.ndarray[Any, np.dtype[np.int64]]) -> Array:
        """Return the times of communication points, or the lengths of so many steps [s]."""
        return np.asarray(k * self.period / self.per_second)


def _ticks(period: float) -> tuple[int, int]:
    """Return a period in ticks, and how many of these a second has."""
    ticks = round(period * TICKS_PER_SECOND)
    if ticks >= 1 and abs(ticks - period * TICKS_PER_SECOND) <= max(1e-3, 1e-14 * ticks):
        return ticks, TICKS_PER_SECOND
    part = Fraction(period).limit_denominator(_MOST_PARTS)
    if part > 0 and float(part) == period:  # 1 / 60 s, of a display or of a container of FMUs
        return part.numerator, part.denominator
    raise InputError(
        "expected a period of whole nanoseconds, or a fraction of a second to all of its digits, "
        f"such as 0.016666666666666666 for 1/60 (got {period!r} s)",
        "$.scenario.period",
    )
