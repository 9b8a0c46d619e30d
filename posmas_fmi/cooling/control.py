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
MEMORY, MESSAGE, MEASURED = 9, 4, 5
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
        From the filtered IT power.
    feedforward_time : float
        Time constant of that filter [s].
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
    K_q: float = -70.0
    E: Array = attrs.field(default=_E, converter=_matrix)
    consensus: float = 0.02
    kp: float = 0.1
    Ti: float = 120.0
    feedforward: bool = False
    feedforward_time: float = 60.0
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
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"expected a number > 0 (got {getattr(self, name)!r})", name)
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
    "integral": "Certificate I where [design] asks for it: the continuous loop contracts and has "
    "no offset. Not proved: sampling, delays, limits of the valve, the fallback. Positivity by "
    "physics.",
    "integral_ff": "As integral: what is fed forward does not come back, so the loop is the same.",
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
def feedforward(line: LineParameters, loads: tuple[float, float] = (30e3, 135e3)) -> Array:
    """Heat to retain over the relative load, ``f1 p + f2 p² + f3 p³`` [W], ``p = P/P0 - 1``.

    A least-squares fit to the valve positions that hold the operating point's supply temperature
    at constant loads; zero at P0.

    Parameters
    ----------
    line : LineParameters
    loads : (float, float)
        Range of the fit [W], for 80 kW lines; in proportion for others.

    Returns
    -------
    (3,) ndarray

    Examples
    --------
    >>> line = LineParameters()
    >>> p = 120e3 / line.P0 - 1
    >>> v = float(feedforward(line) @ [p, p**2, p**3])
    >>> y = valve_mapping(line).position(v)
    >>> round(float(line.steady(120e3, y)[2]), 2)
    5.01
    """
    valve = valve_mapping(line)
    low, high = (line.P0 * load / 80e3 for load in loads)
    grid = np.linspace(low, high, 43)
    v = [valve.retained(line.position(P)) for P in grid]
    p = grid / line.P0 - 1
    powers = np.stack([p, p**2, p**3], axis=1)
    return np.asarray(np.linalg.lstsq(powers, np.array(v), rcond=None)[0])


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
        "ff": feedforward(line) if control.feedforward else np.zeros(3),
        "ff_time": control.feedforward_time,
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
