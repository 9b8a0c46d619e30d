"""What a user may ask of a design."""

from __future__ import annotations

import math
from typing import Any, Literal

import attrs
import numpy as np

from posmas_fmi.errors import InputError
from posmas_fmi.expression import Array

Method = Literal["contraction", "lmi", "integral", "paper-1", "paper-2", "gains"]
METHODS: tuple[Method, ...] = ("contraction", "lmi", "integral", "paper-1", "paper-2", "gains")


def _optional_matrix(value: Any) -> Array | None:
    if value is None:
        return None
    try:
        array = np.atleast_2d(np.array(value, dtype=float))
    except (TypeError, ValueError):
        raise InputError(f"expected a matrix of numbers (got {value!r})", "$.design") from None
    array.flags.writeable = False
    return array


def _one_of(*allowed: object) -> Any:
    def check(_: object, attribute: Any, value: object) -> None:
        if value not in allowed:
            raise InputError(
                f"expected one of {', '.join(map(str, allowed))} (got {value!r})",
                f"$.design.{attribute.name}",
            )

    return check


def _positive(_: object, attribute: Any, value: object) -> None:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if value is not None and not (number and 0.0 < float(value) < math.inf):  # type: ignore[arg-type]
        raise InputError(
            f"expected a finite number > 0 (got {value!r})", f"$.design.{attribute.name}"
        )


@attrs.frozen
class Reading:
    """``[design.reading]``: how to read what the text of Algorithms 1 and 2 leaves open.

    Attributes
    ----------
    coupling : {"L - D", "L + D"}
        Matrix in a(·); the first is printed.
    s : float
        The leader's state in the scalar γ_i (erratum 7): some number has to stand for a vector.
    order : {"ascending", "descending", "rigorous"}
        Which eigenvalue of ``ΓLLᵀΓ`` goes with which f_i; "rigorous" takes the largest of
        ``Γ^{-1/2} (ΓLLᵀΓ) Γ^{-1/2}`` for every i.
    symmetric_E : bool
        Search over symmetric E only, as the printed values show (erratum 11).
    """

    coupling: Literal["L - D", "L + D"] = attrs.field(
        default="L - D", validator=_one_of("L - D", "L + D")
    )
    s: float = attrs.field(default=1.0, validator=_positive)
    order: Literal["ascending", "descending", "rigorous"] = attrs.field(
        default="ascending",
        validator=_one_of("ascending", "descending", "rigorous"),
    )
    symmetric_E: bool = attrs.field(default=True, validator=_one_of(True, False))

    def __str__(self) -> str:
        kind = "symmetric" if self.symmetric_E else "free"
        return f"a({self.coupling}), s = {self.s:g}, eigenvalues {self.order}, E {kind}"


def _optional_reading(value: Any) -> Reading | None:
    if value is None or isinstance(value, Reading):
        return value
    known = [a.name for a in attrs.fields(Reading)]
    if not isinstance(value, dict) or set(value) - set(known):
        raise InputError(
            f"expected a table with keys out of {', '.join(known)} (got {value!r})",
            "$.design.reading",
        )
    try:
        return Reading(**value)
    except InputError as error:
        place = (error.where or "").replace("$.design.", "$.design.reading.")
        raise InputError(error.message, place) from None


@attrs.frozen(eq=False)
class DesignSettings:
    """Choices of a design; the defaults give the fastest certified contraction.

    Parameters
    ----------
    method : {"contraction", "lmi", "integral", "paper-1", "paper-2", "gains"}
        How gains are found; ``"gains"`` takes `K` and `E` (and `K_q`) as given.
    observer : {"local", "distributed"}
        Each agent from its own output, or from neighbours' output errors (25).
    phi, mu : float
        Coupling of controller and of the distributed observer.
    K, E : matrices, optional
        Gains (p, m) and (m, q), for ``"gains"``.
    K_q : matrix, optional
        Gain (p, k) of the integrals of the outputs `integrates`, for ``"gains"``.
    integrates : sequence of str, optional
        Outputs (``"y1"``) that the integral protocol brings to the leader's without offset; at
        most one per input. All of them by default, or the last one where there are too many.
    objective : {"rate", "gain", "band"}
        Fastest certified rate; least gains for the wanted `rate`; smallest guaranteed band.
    rate, observer_rate : float, optional
        Wanted rates [1/s]. An observer rate that is not given is ten times the tracking rate.
    weights : {"auto", "p", "perron"}
        Agents' weights in the norm: p of ``L_p p = 1`` (one solve), the Perron vector of L_p (a
        rate that is never lower), or p and, where p proves no rate, the Perron vector.
    disturbance : sequence of float, optional
        Bound on an additive disturbance of each state's derivative, for the band.
    saturation : float, optional
        Limit of ``|u|``, for the certified region of attraction.
    eta, delta : float
        Constants of Algorithms 1 and 2.
    form : {"corrected", "printed", "joint"}
        Form of Algorithms 1 and 2: route L in their place; as printed; the printed conditions with
        steps 3 and 4 solved jointly.
    reading : Reading, optional
        What the text of the algorithms leaves open; as printed by default, in the joint form with
        any E.
    protocol : {"corrected", "printed"}
        Signs in the running controller: L + D, or as printed (errata 1 and 2).
    digits : int
        Significant digits with which gains ship; the rounded gains are the certified ones.

    Raises
    ------
    InputError
        Naming the key.

    Examples
    --------
    >>> DesignSettings(phi=10.0).method
    'contraction'
    >>> DesignSettings(phi=-1.0)
    Traceback (most recent call last):
        ...
    posmas_fmi.errors.InputError: $.design.phi: expected a finite number > 0 (got -1.0)
    """

    method: Method = attrs.field(default="contraction", validator=_one_of(*METHODS))
    observer: Literal["local", "distributed"] = attrs.field(
        default="local", validator=_one_of("local", "distributed")
    )
    phi: float = attrs.field(default=1.0, validator=_positive)
    mu: float = attrs.field(default=1.0, validator=_positive)
    K: Array | None = attrs.field(default=None, converter=_optional_matrix)
    E: Array | None = attrs.field(default=None, converter=_optional_matrix)
    K_q: Array | None = attrs.field(default=None, converter=_optional_matrix)
    integrates: tuple[str, ...] | None = attrs.field(
        default=None, converter=attrs.converters.optional(tuple)
    )
    objective: Literal["rate", "gain", "band"] = attrs.field(
        default="rate", validator=_one_of("rate", "gain", "band")
    )
    rate: float | None = attrs.field(default=None, validator=_positive)
    observer_rate: float | None = attrs.field(default=None, validator=_positive)
    weights: Literal["auto", "p", "perron"] = attrs.field(
        default="auto", validator=_one_of("auto", "p", "perron")
    )
    disturbance: tuple[float, ...] | None = attrs.field(
        default=None, converter=attrs.converters.optional(tuple)
    )
    saturation: float | None = attrs.field(default=None, validator=_positive)
    eta: float = attrs.field(default=0.6, validator=_positive)
    delta: float = attrs.field(default=0.02, validator=_positive)
    form: Literal["corrected", "printed", "joint"] = attrs.field(
        default="corrected", validator=_one_of("corrected", "printed", "joint")
    )
    reading: Reading | None = attrs.field(default=None, converter=_optional_reading)
    protocol: Literal["corrected", "printed"] = attrs.field(
        default="corrected", validator=_one_of("corrected", "printed")
    )
    digits: int = 6

    def __attrs_post_init__(self) -> None:
        if self.method == "gains" and (self.K is None or self.E is None):
            missing = "K" if self.K is None else "E"
            raise InputError(
                f'method = "gains" needs both K and E (no {missing} given)', f"$.design.{missing}"
            )
        if self.objective == "gain" and self.rate is None:
            raise InputError('objective = "gain" needs the wanted rate', "$.design.rate")
        for name in ("K", "E", "K_q"):
            value: Array | None = getattr(self, name)
            if value is not None and not np.isfinite(value).all():
                raise InputError("expected finite numbers", f"$.design.{name}")
        for bound in self.disturbance or ():
            if not 0.0 <= bound < math.inf:
                raise InputError(
                    f"expected finite bounds >= 0 (got {bound!r})", "$.design.disturbance"
                )
        if not 2 <= self.digits <= 15:
            raise InputError(f"expected 2 to 15 (got {self.digits})", "$.design.digits")
