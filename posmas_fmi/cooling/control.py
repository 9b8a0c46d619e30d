"""Controllers of a cooling line: which laws there are, their gains, and the shell around them.

The laws themselves are C (``cosim/csrc/cooling``); `posmas_fmi.cooling.law` states them in numpy.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from typing import Any

import attrs
import numpy as np

from posmas_fmi.cooling.line import LineParameters
from posmas_fmi.cooling.mapping import valve_mapping
from posmas_fmi.errors import InputError
from posmas_fmi.expression import Array

# Numbers of the laws in controller.h.
LAWS = {"fixed": 0, "proportional": 1, "integral": 2, "set_point": 3, "local": 4, "team": 5}
MEMORY, MESSAGE, MEASURED = 10, 4, 5
CURVE = 129  # points of the valve curve
EXTRAS = ("power", "valve", "water")  # measured beside y, in this order
TEAM = 32  # lines in a team at most, as in vendors' units

# Proved by certificate T for the 80 kW line, 40-130 kW, 5 s, in-degree 2 and one pin; the design of
# a scenario takes their place.
_K = (0.0, -319.179, -2768.08)  # W/K
_E = ((2.98721e-2, 2.21250e-7), (1.59084e-1, 1.30926e-2), (1.04490e-2, 1.66195e-1))  # 1/s
_NEVER = 1e12  # s


def _matrix(value: Any) -> Array:
    array = np.array(value, dtype=float)
    array.flags.writeable = False
    return array


@attrs.frozen(eq=False)
class Control:
    """One controller: a law, its gains, and the shell.

    Parameters
    ----------
    law : str
        One of `LAWS`.
    K : (3,) array
        Gain of the disagreement of the estimates [W/K].
    K_q : float
        Gain of the integral of the disagreement of measured supply temperatures [W/(K s)].
    E : (3, 2) array
        Gain of the observer [1/s].
    consensus : float
        Rate of the consensus on the set-point, per weight of an arc [1/s].
    kp, Ti : float
        PI controllers: valve position per kelvin, and integral time [s]. Also of the fallback and
        of the dew-point override.
    feedforward : bool
        Of the measured IT power and the temperature of the facility water: the valve position
        that holds the set-point in their steady state. It is that of `set_point`; a later one is
        left to the law.
    feedforward_time : float, optional
        Time constant of the filter of both [s]; default the difference of `mean_delays`.
    everyone : bool
        Every line knows the set-point; else only the pinned ones do.
    sign : {"corrected", "printed"}
        Of the pinning term in (6).
    tracking : float
        Time constant of the back-calculation against windup [s].
    stroke_time : float
        Least time of the valve from closed to open [s].
    tolerance : float
        A feedback further than this from the command is a valve that does not follow.
    floor : float, optional
        Least supply temperature [K], from the dew point; default none.
    silence : float
        Longest silence of the neighbours [s] before a line goes over to its own PI controller.
    reference_time : float
        Time constant [s] with which a line learns what its neighbours agree on.
    opening : (float, float)
        Range of the valve position.
    set_point : float, optional
        Supply temperature [K] above the facility's nominal one; default the operating point's.
    set_point_after : float, optional
        The same from `set_point_at` on [s].
    set_point_at : float

    Raises
    ------
    InputError
        If a law is not known or a number is out of range.
    """

    law: str
    K: Array = attrs.field(default=_K, converter=_matrix)
    K_q: float = -101.48  # K over the mean delay behind the valve
    E: Array = attrs.field(default=_E, converter=_matrix)
    consensus: float = 0.02
    kp: float = 0.1
    Ti: float = 120.0
    feedforward: bool = False
    feedforward_time: float | None = None
    everyone: bool = True
    sign: str = "corrected"
    tracking: float = 60.0
    stroke_time: float = 120.0
    tolerance: float = 0.1
    floor: float | None = None
    silence: float = 120.0
    reference_time: float = 300.0
    opening: tuple[float, float] = (0.0, 1.0)
    set_point: float | None = None
    set_point_after: float | None = None
    set_point_at: float = _NEVER

    def __attrs_post_init__(self) -> None:
        if self.law not in LAWS:
            raise InputError(f"expected one of {', '.join(LAWS)} (got {self.law!r})", "law")
        if self.sign not in ("corrected", "printed"):
            raise InputError(f"expected corrected or printed (got {self.sign!r})", "sign")
        for name, shape in (("K", (3,)), ("E", (3, 2))):
            value = getattr(self, name)
            if value.shape != shape or not np.isfinite(value).all():
                raise InputError(f"expected finite numbers of shape {shape} (got {value})", name)
        for name in ("kp", "Ti", "feedforward_time", "tracking", "stroke_time", "reference_time"):
            value = getattr(self, name)
            if not ((value is None and name == "feedforward_time") or 0 < value < math.inf):
                raise InputError(f"expected a number > 0 (got {value!r})", name)
        for name in ("consensus", "tolerance", "silence"):
            if not getattr(self, name) >= 0:
                raise InputError(f"expected a number >= 0 (got {getattr(self, name)!r})", name)
        if not (math.isfinite(self.K_q) and self.K_q <= 0):
            raise InputError(f"expected a finite number <= 0 (got {self.K_q!r})", "K_q")
        low, high = self.opening
        if not 0 <= low < high <= 1:
            raise InputError(f"expected 0 <= low < high <= 1 (got {self.opening})", "opening")


CONTROLLERS: Mapping[str, Control] = {
    "fixed": Control("fixed"),
    "printed": Control("proportional", sign="printed"),
    "proportional": Control("proportional"),
    "integral": Control("integral"),
    "integral_ff": Control("integral", feedforward=True),
    "set_point": Control("set_point"),
    "pi": Control("local"),
    "pi_ff": Control("local", feedforward=True),
    "pinned_pi": Control("local", everyone=False),
    "team": Control("team"),
}

WHAT_IS_PROVED = {
    "fixed": "Nothing is controlled; temperatures stay above the facility supply by physics.",
    "printed": "The paper's sign: no certificate holds (erratum 1).",
    "proportional": "Certificates P, C, T of the design: positive and contracting, also sampled, "
    "for every load in the stated range; D: for every bounded delay. It leaves an offset.",
    "integral": 'With [design] method = "integral" certificate I: the sampled loop of equal lines '
    "contracts, for every slope of the valve in the stated range of loads, and has no offset. Not "
    "proved: delays, losses, limits of the valve, the fallback. Positivity by physics.",
    "integral_ff": "As integral, for the loop about what is fed forward: the IT power does not "
    "depend on the valves. The facility water does, slowly; that path is not covered.",
    "set_point": "The consensus on the set-point converges (pinned Laplacian, step below one over "
    "the degree). Not proved: the PI loops, coupling through the header.",
    "pi": "Nothing; tuned as in practice.",
    "pi_ff": "Nothing; tuned as in practice.",
    "pinned_pi": "Nothing; lines without a set-point stand still.",
    "mpc": "Nothing; a reference that knows the header and every measurement at once.",
    "team": "Nothing; the mean of a team is controlled, not its lines.",
}


def controller(name: str, **changes: Any) -> Control:
    """Return a controller by name, with changes.

    Raises
    ------
    InputError
        If there is none of that name, or a change is out of range.

    Examples
    --------
    >>> controller("integral_ff", feedforward_time=90.0).feedforward
    True
    """
    if name not in CONTROLLERS:
        raise InputError(f"expected one of {', '.join(CONTROLLERS)} (got {name!r})", "controller")
    return attrs.evolve(CONTROLLERS[name], **changes)


@cache
def valve_curve(line: LineParameters, points: int = CURVE) -> tuple[Array, Array]:
    """Return the heat to retain over the exchanger's conductance: the inverse of valve and ε-NTU.

    Parameters
    ----------
    line : LineParameters
    points : int

    Returns
    -------
    kappa : (points,) ndarray
        Equally spaced, from the closed valve to the open one [W/K].
    v : (points,) ndarray
        [W]

    Examples
    --------
    >>> line = LineParameters()
    >>> kappa, v = valve_curve(line)
    >>> y = valve_mapping(line).position(float(np.interp(6000.0, kappa, v)))
    >>> round(float(line.kappa(y)))
    6000
    """
    from scipy.optimize import brentq

    valve = valve_mapping(line)
    kappa = np.linspace(float(line.kappa(0.0)), float(line.kappa(1.0)), points)
    inside = [brentq(lambda y, k=k: float(line.kappa(y)) - k, 0.0, 1.0) for k in kappa[1:-1]]
    return kappa, np.array([valve.retained(y) for y in (0.0, *inside, 1.0)])


def mean_delays(line: LineParameters) -> tuple[float, float]:
    """Return the mean delays of the supply temperature behind the load and behind the valve [s].

    Of the linear line at the operating point: the mean times of its two impulse responses. Their
    difference is the lag with which the feedforward should follow the load; the valve's is the
    integral time of the distributed integral, as in the usual tuning of a PI controller.

    Parameters
    ----------
    line : LineParameters

    Examples
    --------
    >>> [round(delay, 1) for delay in mean_delays(LineParameters())]
    [51.6, 30.4]
    """
    A = line.A(line.kappa0, line.P0)
    once = np.linalg.solve(A.T, [0.0, 0.0, 1.0])  # gain: -once b; gain times delay: twice b
    twice = np.linalg.solve(A.T, once)
    return float(-twice[0] / once[0]), float(-twice[2] / once[2])


def largest_load(line: LineParameters) -> float:
    """Return the load over P0 up to which feedforward goes: four, and far from thermal runaway."""
    runaway = math.inf if line.kl == 0 else 1 / (line.P0 * line.kl * line.path)
    return min(4.0, runaway / 2)


def parameters(
    line: LineParameters, control: Control, h: float, water: float = 305.15
) -> dict[str, Array]:
    """Values of ``Controller`` in controller.h, in its order.

    Parameters
    ----------
    line : LineParameters
        The nominal line.
    control : Control
    h : float
        Communication step [s].
    water : float
        Facility supply of θ = 0 [K].

    Returns
    -------
    dict of str to ndarray
    """
    from scipy.linalg import expm

    valve = valve_mapping(line)
    kappa, curve = valve_curve(line)
    behind_load, behind_valve = mean_delays(line)
    A = line.A(line.kappa0, line.P0)
    rest = np.array([line.P0 * (1 - line.kl * line.theta_p0) / line.Cp, 0.0, 0.0])
    both = expm(h * np.block([[A, np.eye(3)], [np.zeros((3, 6))]]))
    before = line.theta_s0 if control.set_point is None else control.set_point
    after = before if control.set_point_after is None else control.set_point_after
    values: dict[str, Any] = {
        "h": h,
        "law": LAWS[control.law],
        "set_before": before,
        "set_after": after,
        "set_at": control.set_point_at,
        "K": control.K,
        "K_q": control.K_q,
        "consensus": control.consensus,
        "kp": control.kp / valve.gain,
        "Ti": control.Ti,
        "forward": float(control.feedforward),
        "ff_time": control.feedforward_time or behind_load - behind_valve,
        "load_most": largest_load(line),
        "path": line.path,
        "kappa_low": kappa[0],
        "kappa_step": kappa[1] - kappa[0],
        "curve": curve,
        "tracking": control.tracking,
        "rate": 1 / control.stroke_time,
        "tolerance": control.tolerance,
        "floor": -1e6 if control.floor is None else control.floor - water,
        "silence": control.silence,
        "reference_time": control.reference_time,
        "y0": valve.y0,
        "gain": valve.gain,
        "full": both[:3, :3],
        "gamma": both[:3, 3:],
        "rest": rest,
        "E": control.E,
        "heating": line.P0 / line.Cp,
        "leakage": line.kl,
        "plate0": line.theta_p0,
        "nominal": line.P0,
        "Cs": line.Cs,
        "ws": line.ws,
        "UA": line.UA,
        "water_max": line.cw * line.wmax,
        "log_R": math.log(line.R),
        "N": line.N,
        "kappa0": line.kappa0,
        "water0": water,
        # θs per heat retained is g_u; the leader's heat input is in K/s of the supply volume
        "lift": 1 / (line.static_gains()[1] * line.Cs),
        "supply0": line.theta_s0,
    }
    return {name: np.atleast_1d(np.asarray(value, dtype=float)) for name, value in values.items()}
