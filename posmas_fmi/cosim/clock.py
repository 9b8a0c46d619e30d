"""Integer time: nanoseconds inside, nominal seconds outside, so that nothing drifts."""

from __future__ import annotations

import attrs

from posmas_fmi.errors import InputError

TICKS_PER_SECOND = 1_000_000_000
LONGEST = 9e9  # s: nanoseconds are counted in 64 bits


@attrs.frozen
class Clock:
    """Communication points ``t_k = t0 + k·h`` on a grid of nanoseconds.

    Attributes
    ----------
    period : int
        Communication step [ns].
    steps : int
        Number of communication steps.

    Examples
    --------
    >>> clock = Clock.of(until=10.0, period=0.005)
    >>> clock.steps, clock.time(3), clock.time(2000)
    (2000, 0.015, 10.0)
    """

    period: int
    steps: int

    @classmethod
    def of(cls, until: float, period: float) -> Clock:
        """Make the clock of a run.

        Raises
        ------
        InputError
            If the period is no whole number of nanoseconds, or `until` no multiple of it, or one
            of them is longer than `LONGEST`.
        """
        for name, value in (("period", period), ("until", until)):
            if not abs(value) <= LONGEST:
                raise InputError(
                    f"expected at most {LONGEST:g} s (got {value!r} s)", f"$.scenario.{name}"
                )
        ticks = round(period * TICKS_PER_SECOND)
        if ticks < 1 or abs(ticks - period * TICKS_PER_SECOND) > max(1e-3, 1e-14 * ticks):
            raise InputError(
                f"expected a period of whole nanoseconds (got {period!r} s)", "$.scenario.period"
            )
        end = round(until * TICKS_PER_SECOND)
        if end < ticks or end % ticks:
            raise InputError(
                f"expected until to be a multiple of the period {period:g} s (got {until!r} s); "
                f"{max(1, round(end / ticks)) * ticks / TICKS_PER_SECOND:.9g} s is one",
                "$.scenario.until",
            )
        return cls(ticks, end // ticks)

    @property
    def h(self) -> float:
        """The nominal communication step [s], the one that is passed to every FMU."""
        return self.period / TICKS_PER_SECOND

    def time(self, k: int) -> float:
        """Time of communication point k [s]."""
        return k * self.period / TICKS_PER_SECOND
