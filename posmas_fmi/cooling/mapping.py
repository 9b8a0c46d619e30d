"""From a cooling line to model (1): x = [θp, θr, θs], u the heat retained by the valve [W]."""

from __future__ import annotations

import math
from functools import cache

import attrs
import numpy as np
import sympy

from posmas_fmi.agent import Agent
from posmas_fmi.cooling.enclosure import POLE, kappa_slope_range
from posmas_fmi.cooling.line import LineParameters
from posmas_fmi.errors import InputError
from posmas_fmi.expression import VectorFunction, parse, symbol
from posmas_fmi.interval import bounds

LOADS = (40e3, 130e3)  # W, per line of 80 kW nominal

_NEAR = 0.02  # in valve position: closer to y0 the slope encloses the secant


@attrs.frozen
class ValveMapping:
    """How the input u of model (1) becomes a valve position.

    ``y = y0 - gain·u``, limited to `opening`: u is the heat retained relative to the nominal flow,
    in units that make the sector gain 1 for small u at the operating point.

    Attributes
    ----------
    y0 : float
        Valve position for u = 0.
    gain : float
        Valve travel per heat retained [1/W].
    opening : (float, float)
        Least and largest position.

    Examples
    --------
    >>> valve = valve_mapping(LineParameters())
    >>> round(1e4 * valve.gain, 4)  # per 10 kW
    0.0777
    >>> round(valve.position(10e3), 3)
    0.639
    """

    y0: float
    gain: float
    opening: tuple[float, float]

    @property
    def inputs(self) -> tuple[float, float]:
        """Least and largest u before the valve is at a limit [W]."""
        return (self.y0 - self.opening[1]) / self.gain, (self.y0 - self.opening[0]) / self.gain

    def position(self, u: float) -> float:
        """Return the valve position for u [W]."""
        return min(max(self.y0 - self.gain * u, self.opening[0]), self.opening[1])

    def retained(self, y: float) -> float:
        """Return u [W] for a valve position, as read back from an actuator."""
        return (self.y0 - y) / self.gain


def valve_mapping(line: LineParameters, opening: tuple[float, float] = (0.0, 1.0)) -> ValveMapping:
    """Return the valve mapping of a line.

    Raises
    ------
    InputError
        If the operating point does not lie inside `opening`.
    """
    if not 0 <= opening[0] < line.y0 < opening[1] <= 1:
        raise InputError(
            f"expected 0 <= low < y0 = {line.y0:.4g} < high <= 1 (got {opening})", "opening"
        )
    slope = float(line.kappa_slope(line.y0))
    return ValveMapping(line.y0, 1 / (slope * line.theta_r0), opening)


def return_range(line: LineParameters, loads: tuple[float, float] = LOADS) -> tuple[float, float]:
    """Range of the steady return temperature θr over a range of loads [K].

    From the nominal valve position, where θr follows the load most, to a valve that holds the
    supply temperature, or is open where that is not enough. (θr rises with the load in both: A is
    Metzler and Hurwitz.)

    Parameters
    ----------
    line : LineParameters
    loads : (float, float)
        Least and largest heat load [W].

    Raises
    ------
    InputError
        If the loads are not ``0 < low <= high``, or a load has no steady state.

    Examples
    --------
    >>> [round(v, 1) for v in return_range(LineParameters())]
    [7.1, 26.3]
    """
    if not 0 < loads[0] <= loads[1] < math.inf:
        raise InputError(f"expected 0 < low <= high (got {loads})", "loads")
    ends = []
    for load in loads:
        fixed = line.steady(load)[1]
        held = line.steady(load, line.nearest(load))[1]
        ends.append((min(fixed, held), max(fixed, held)))
    return float(ends[0][0]), float(ends[1][1])


def sector(
    line: LineParameters,
    theta_r: tuple[float, float],
    opening: tuple[float, float] = (0.0, 1.0),
) -> tuple[float, float]:
    """Enclose the gain ``sec(u; θr)/u`` over valve positions and return temperatures.

    Valve curve, exchanger and the product with θr are one time-varying gain
    ``m = gain·θr (κ(y) - κ(y0))/(y - y0)``; its range is found by interval arithmetic on that
    quotient, near y0 on the slope of κ.

    Parameters
    ----------
    line : LineParameters
    theta_r : (float, float)
        Range of the return temperature [K].
    opening : (float, float)
        Range of the valve position.

    Returns
    -------
    (float, float)
        ``(m_l, m_h)``; no gain lies outside.

    Examples
    --------
    >>> [round(v, 2) for v in sector(LineParameters(), (14.0, 14.0))]
    [0.49, 1.18]
    """
    if not 0 <= theta_r[0] <= theta_r[1] < math.inf:
        raise InputError(f"expected 0 <= low <= high (got {theta_r})", "theta_r")
    least, most = _secants(line, opening)
    gain = valve_mapping(line, opening).gain
    return gain * theta_r[0] * least, gain * theta_r[1] * most


@cache
def _secants(line: LineParameters, opening: tuple[float, float]) -> tuple[float, float]:
    """Least and largest ``(κ(y) - κ(y0))/(y - y0)`` over valve positions [W/K]."""
    valve = valve_mapping(line, opening)
    y, y0 = symbol("y"), sympy.Rational(repr(valve.y0))
    kappa = parse(_kappa_text(line, "y"), ["y"])
    secant = (kappa - kappa.subs(y, y0)) / (y - y0)
    low, high = opening
    pieces = [bounds(sympy.diff(kappa, y), {"y": (valve.y0 - _NEAR, valve.y0 + _NEAR)})]
    for a, b in ((low, valve.y0 - _NEAR), (valve.y0 + _NEAR, high)):
        if a < b:
            pieces.append(bounds(secant, {"y": (a, b)}))
    return min(p.low for p in pieces), max(p.high for p in pieces)


def slope_sector(
    line: LineParameters,
    theta_r: tuple[float, float],
    opening: tuple[float, float],
    header: tuple[float, float] = (1.0, 1.0),
) -> tuple[float, float]:
    """Enclose the slope ``∂sec(u; θr, h)/∂u``: the incremental sector that integral action needs.

    A changed header pressure moves the operating point, which the integral takes care of; the
    slope is what its certificate (I) asks for. It is smallest where the valve is wide open or
    nearly closed, so a smaller `opening` narrows it.

    Parameters
    ----------
    line : LineParameters
    theta_r : (float, float)
        Range of the return temperature [K].
    opening : (float, float)
        Range of the valve position.
    header : (float, float)
        Range of the header pressure factor.

    Returns
    -------
    (float, float)

    Examples
    --------
    >>> low, high = slope_sector(LineParameters(), (10.0, 22.0), (0.4, 1.0))
    >>> low < 1.0 < high
    True
    """
    low, high = kappa_slope_range(line, opening, header)
    gain = valve_mapping(line).gain
    return gain * theta_r[0] * low, gain * theta_r[1] * high


def line_agent(
    line: LineParameters,
    loads: tuple[float, float] = LOADS,
    theta_r: tuple[float, float] | None = None,
    opening: tuple[float, float] = (0.0, 1.0),
    integral: bool = False,
) -> Agent:
    """Return the line as an agent of model (1), for design and certificates.

    Its `slope` is `slope_sector`, for method "integral".

    ``x = [θp, θr, θs]`` in kelvin above the facility supply, ``y = [θr, θs]``, u the heat
    retained [W], ``sec(u) = -(κ(y0 - gain·u) - κ0) θr`` written for the nominal θr; for the true
    θr(t) it is a time-varying sector gain, and `sector` covers all of the range. Load and leakage
    are ``H g``, with the load P0: a leader of this agent is the nominal line.

    Parameters
    ----------
    line : LineParameters
    loads : (float, float)
        Range of heat loads [W] that the sector and the Lipschitz bound hold for.
    theta_r : (float, float), optional
        Range of the return temperature [K]; default `return_range` of the loads.
    opening : (float, float)
        Range of the valve position.
    integral : bool
        For a design with integral action: the leakage is that of P0, in A. What another load
        leaks more is then part of the load.

    Returns
    -------
    Agent

    Examples
    --------
    >>> agent = line_agent(LineParameters())
    >>> [round(m, 2) for m in agent.sector]
    [0.25, 2.22]
    >>> [a.status for a in agent.assumptions()][:2]
    ['verified', 'verified']
    """
    theta_r = return_range(line, loads) if theta_r is None else theta_r
    low, high = sector(line, theta_r, opening)
    own_low, own_high = sector(line, (line.theta_r0, line.theta_r0), opening)
    with_own = min(theta_r[0], line.theta_r0), max(theta_r[1], line.theta_r0)
    valve = valve_mapping(line, opening)
    g, sec = line_texts(line, opening, integral)
    # H carries kl P0/Cp, so that g has slope P/P0 in θp; P0/kl - θp0 is the load without leakage
    leaks = line.kl > 0 and not integral
    return Agent(
        A=line.A(line.kappa0, line.P0 if integral else 0.0),
        H=np.diag([(line.kl if leaks else 1.0) * line.P0 / line.Cp, 0.0, 0.0]),
        B=[[0.0], [0.0], [1 / line.Cs]],
        C=[[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        g=VectorFunction.parse([g, "0", "0"], ["t", "x1", "x2", "x3"]),
        sec=VectorFunction.parse([sec], ["u1"]),
        sector=(min(low, own_low), max(high, own_high)),
        lipschitz=[max(1.0, loads[1] / line.P0), 0.0, 0.0] if leaks else None,
        region={"u1": valve.inputs},
        slope=slope_sector(line, with_own, opening),
    )


def line_texts(
    line: LineParameters, opening: tuple[float, float] = (0.0, 1.0), integral: bool = False
) -> tuple[str, str]:
    """Return g₁ and sec of `line_agent` as text, in the language of expressions."""
    valve = valve_mapping(line, opening)
    position = f"clip({valve.y0!r} - {valve.gain!r}*u1, {opening[0]!r}, {opening[1]!r})"
    nominal = _kappa_text(line, repr(valve.y0))  # as text, so that sec(0) = 0 exactly
    sec = f"({nominal} - {_kappa_text(line, position)})*{line.theta_r0!r}"
    if integral or line.kl == 0:
        return repr(1 - line.kl * line.theta_p0), sec
    return f"x1 + {1 / line.kl - line.theta_p0!r}", sec


def _kappa_text(line: LineParameters, y: str) -> str:
    """κ over the valve position, in the language of expressions."""
    resistance = f"sqrt({line.N!r}*{line.R!r}**(2 - 2*({y})) + {1 - line.N!r})"
    per_cold = f"({1 / (line.cw * line.wmax)!r}*{resistance})"
    x = f"max(abs({line.UA / 2!r}*({1 / line.ws!r} - {per_cold})), {POLE!r})"
    return f"(1/(({1 / line.ws!r} + {per_cold})/2 + {x}/tanh({x})/{line.UA!r}))"
