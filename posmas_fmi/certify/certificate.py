"""What a proof says: conditions with their margins, assumptions, and the verdict over both."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import attrs

from posmas_fmi.agent import Assumption

Verdict = Literal["yes", "conditional", "no"]


@attrs.frozen
class Condition:
    """One condition of a certificate, proved or refuted.

    Attributes
    ----------
    name : str
        Letter of the certificate in theory.md and the condition, ``"T: controller contracts"``.
    holds : bool
        Whether it is proved; what could not be proved does not hold.
    margin : float
        Proved distance from failing, in the unit of the condition; positive iff it holds.
    proof : str
        Estimate, proved bound and method.
    detail : str
        Where it is tight or fails: the agent, the entry, what would help.
    refuted : bool
        Whether it is proved that the condition, as it stands, does not hold.
    """

    name: str
    holds: bool
    margin: float
    proof: str
    detail: str = ""
    refuted: bool = False

    @classmethod
    def from_margin(
        cls, name: str, margin: float, proof: str, detail: str = "", refuted: bool = False
    ) -> Condition:
        """Condition that holds iff its proved margin is positive; NaN counts as failed.

        Examples
        --------
        >>> Condition.from_margin("K <= 0", 0.5, "largest entry -0.5").holds
        True
        """
        if math.isnan(margin):
            margin = -math.inf
        return cls(name, margin > 0, float(margin), proof, detail, refuted and not margin > 0)

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "name": self.name,
            "holds": self.holds,
            "margin": json_number(self.margin),
            "proof": self.proof,
            "detail": self.detail,
            "refuted": self.refuted,
        }


@attrs.frozen
class Region:
    """Certified region of attraction under saturation (certificate R).

    Attributes
    ----------
    c : float
        With exact estimates start with ``|δ_i| ≤ c v_i`` for every agent, where δ is the tracking
        error of the estimate.
    radius : float
        Largest box in it: every entry of every ``|δ_i|`` at most this.
    c_estimation : float
        With an estimation error e, ``max |δ_i|/v_i / c + max |e_i|/w_i / c_estimation ≤ 1``, where
        w are the weights of the observer's certificate.
    radius_estimation : float
        Largest box in that: every entry of every ``|e_i|`` at most this.
    detail : str
        How it was obtained.
    """

    c: float
    radius: float
    c_estimation: float
    radius_estimation: float
    detail: str


@attrs.frozen
class Delayed:
    """Certified rates where messages are late.

    Attributes
    ----------
    delay : float
        Largest age of what is used of neighbours [s].
    steps : int or None
        The same in control periods.
    rate : float
        Proved rate of the tracking error [1/s], for a leader at rest.
    observer_rate : float
        Proved rate of the estimation error [1/s]; the local observer needs no messages.
    """

    delay: float
    steps: int | None
    rate: float
    observer_rate: float


@attrs.frozen
class Certificate:
    """What is proved about a closed loop, and on which assumptions.

    Attributes
    ----------
    assumptions : tuple of Assumption
        Everything the proof takes from outside.
    conditions : tuple of Condition
        All must hold for the loop to be certified.
    rate, observer_rate : float or None
        Proved exponential rates of tracking and estimation error [1/s]; None if there is none.
        Sampled, ``-ln(r)/h``, where there is a `period`, else continuous.
    positive : bool
        Whether states are proved non-negative, for observers started at or below the states.
    p_max : float or None
        Largest entry of the solution of ``L_p p = 1``; None if the leader misses an agent.
    period : float or None
        Control period h [s]; None for a continuous controller.
    rate_perron : float or None
        Rate with the Perron vector of L_p as weights instead of p: never below `rate`.
    rate_continuous, observer_rate_continuous : float or None
        Rates of certificate C, the limit of a fast sampling [1/s].
    covers : tuple of str
        What else the same proof covers: sector, start, delays, lost messages.
    delays : tuple of Delayed
        Rates that are proved where messages are late or lost (certificate D).
    region_of_attraction : Region or None
        Under saturation.
    band : tuple of float or None
        Guaranteed worst-case deviation per agent (certificate G).
    """

    assumptions: tuple[Assumption, ...]
    conditions: tuple[Condition, ...]
    rate: float | None
    observer_rate: float | None
    positive: bool
    p_max: float | None = None
    period: float | None = None
    rate_perron: float | None = None
    rate_continuous: float | None = None
    observer_rate_continuous: float | None = None
    covers: tuple[str, ...] = ()
    delays: tuple[Delayed, ...] = ()
    region_of_attraction: Region | None = None
    band: tuple[tuple[float, ...], ...] | None = None

    @property
    def certified(self) -> Verdict:
        """``"no"`` if a condition is not proved, ``"conditional"`` if an assumption is open.

        `refuted` tells the two kinds of ``"no"`` apart.
        """
        if not self.conditions or not all(c.holds for c in self.conditions):
            return "no"
        return "yes" if all(a.status == "verified" for a in self.assumptions) else "conditional"

    @property
    def failing(self) -> tuple[Condition, ...]:
        """Conditions that do not hold."""
        return tuple(c for c in self.conditions if not c.holds)

    @property
    def refuted(self) -> bool:
        """Whether a condition is proved not to hold; otherwise ``"no"`` means not proved."""
        return any(c.refuted for c in self.conditions)

    @property
    def open_assumptions(self) -> tuple[Assumption, ...]:
        """Assumptions that are declared or contradicted."""
        return tuple(a for a in self.assumptions if a.status != "verified")

    def to_dict(self) -> dict[str, Any]:
        """JSON form, without NaN or infinities."""
        region = self.region_of_attraction
        return {
            "certified": self.certified,
            "refuted": self.refuted,
            "assumptions": [attrs.asdict(a) for a in self.assumptions],
            "rate": json_number(self.rate),
            "observer_rate": json_number(self.observer_rate),
            "positive": self.positive,
            "p_max": json_number(self.p_max),
            "period": json_number(self.period),
            "rate_perron": json_number(self.rate_perron),
            "rate_continuous": json_number(self.rate_continuous),
            "observer_rate_continuous": json_number(self.observer_rate_continuous),
            "conditions": [c.to_dict() for c in self.conditions],
            "covers": list(self.covers),
            "delays": [attrs.asdict(d) for d in self.delays],
            "region_of_attraction": None
            if region is None
            else {
                "c": json_number(region.c),
                "radius": json_number(region.radius),
                "c_estimation": json_number(region.c_estimation),
                "radius_estimation": json_number(region.radius_estimation),
                "detail": region.detail,
            },
            "band": None if self.band is None else [json_list(row) for row in self.band],
        }


def json_number(value: float | None) -> float | None:
    """Return a number that JSON can hold: None for NaN and infinities, 0.0 for -0.0."""
    if value is None or not math.isfinite(value):
        return None
    return float(value) + 0.0


def json_list(values: Sequence[float]) -> list[float | None]:
    """Return a list that JSON can hold."""
    return [json_number(v) for v in values]
