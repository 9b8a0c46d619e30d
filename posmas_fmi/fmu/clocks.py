"""The clocks of an FMU, and when they tick."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from fractions import Fraction

import attrs


@attrs.frozen
class Clock:
    """A clock of an FMI 3 model description.

    Attributes
    ----------
    name : str
    reference : int
        Value reference.
    causality, variability : str
        `variability` is that of the interval: ``constant``, ``countdown``, ``triggered``, …
    interval : Fraction or None
        [s]; None where the description does not say it.
    shift : Fraction
        Of the first tick after the start [s].
    """

    name: str
    reference: int
    causality: str
    variability: str
    interval: Fraction | None = None
    shift: Fraction = Fraction(0)

    @property
    def periodic(self) -> bool:
        """Whether the description says when it ticks."""
        return self.variability in ("constant", "fixed", "tunable") and bool(self.interval)

    @property
    def asked(self) -> bool:
        """Whether the FMU is asked for the time of the next tick."""
        known = ("calculated", "changing", "countdown", "tunable", "fixed", "constant")
        return self.variability in known and not self.periodic

    def tick(self, number: int) -> float:
        """Time of a tick, counted from 0, after the start [s].

        Examples
        --------
        >>> Clock("c", 1, "input", "constant", Fraction("0.1"), Fraction("0.05")).tick(3)
        0.35
        """
        return math.inf if self.interval is None else float(self.shift + number * self.interval)


def read_clocks(description: bytes) -> tuple[Clock, ...]:
    """Read the input clocks of a modelDescription.xml that are not triggered from outside.

    Parameters
    ----------
    description : bytes
        That `posmas_fmi.fmu.archive.examine` let through.
    """
    found = []
    for element in ET.fromstring(description).iter("Clock"):
        told = element.attrib
        clock = Clock(
            told["name"],
            int(told["valueReference"]),
            told.get("causality", "local"),
            told.get("intervalVariability", "triggered"),
            _time(told, "interval"),
            _time(told, "shift") or Fraction(0),
        )
        if clock.causality == "input" and clock.variability != "triggered":
            found.append(clock)
    return tuple(found)


def _time(told: dict[str, str], what: str) -> Fraction | None:
    if f"{what}Decimal" in told:
        return Fraction(told[f"{what}Decimal"])
    if f"{what}Counter" in told and int(told.get("resolution", 0)):
        return Fraction(int(told[f"{what}Counter"]), int(told["resolution"]))
    return None
