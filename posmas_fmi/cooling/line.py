"""One liquid-cooling line: cold plates, coolant loop, CDU heat exchanger, primary valve."""

from __future__ import annotations

import math
from functools import cached_property

import attrs
import numpy as np
from numpy.typing import ArrayLike

from posmas_fmi.cooling.exchanger import conductance, conductance_slope
from posmas_fmi.errors import InputError
from posmas_fmi.expression import Array


def _positive(instance: object, attribute: attrs.Attribute[float], value: float) -> None:
    if not (math.isfinite(value) and value > 0):
        raise InputError(f"expected a number > 0 (got {value!r})", f"line.{attribute.name}")


def _size(default: float) -> float:
    field: float = attrs.field(default=default, converter=float, validator=_positive)
    return field


@attrs.frozen(slots=False)
class LineParameters:
    """Physics of one line; temperatures are relative to the facility supply, ``θ = T - T_fac``.

    ::

        Cp θp' = P [1 + kl (θp - θp0)] - G (θp - (θr + θs)/2)     plate and silicon
        Cr θr' = G (θp - (θr + θs)/2) - ws (θr - θs)              return (hot) coolant
        Cs θs' = ws (θr - θs) - κ(y, h) θr                        supply (cold) coolant

    with κ from the ε-NTU method and an equal-percentage valve of authority N in series with the
    rest of the primary circuit. Defaults are an 80 kW line; `sized` gives others.

    Parameters
    ----------
    P0 : float
        Nominal heat load [W].
    theta_s0 : float
        Supply temperature at the operating point, above the facility supply [K].
    ws : float
        Heat capacity flow of the coolant [W/K]; 1.5 L/min per kW (Open Compute OAI guideline).
    G : float
        Plate to mean coolant temperature [W/K] (Open Compute 1 kW OAM cold-plate curve).
    UA : float
        Heat exchanger [W/K] (0.226-0.305 kW/K per kW in published CDU data).
    wmax : float
        Primary flow with the valve open and a nominal header [kg/s].
    cw : float
        Specific heat of the facility water [J/(kg K)].
    Cp, Cr, Cs : float
        Heat capacities of plates, return and supply coolant [J/K] (assumed).
    kl : float
        Leakage: more power per kelvin of the plate [1/K] (assumed).
    R, N : float
        Rangeability and authority of the valve.

    Raises
    ------
    InputError
        If a value is not positive, R <= 1, N > 1, ``ws < G/2`` (the plate could not be cooled by
        its mean coolant temperature), or no valve position gives the operating point.

    Examples
    --------
    >>> line = LineParameters()
    >>> [round(float(v), 1) for v in line.theta0]
    [26.7, 15.0, 5.0]
    >>> round(line.y0, 3)
    0.717
    """

    P0: float = _size(80e3)
    theta_s0: float = _size(5.0)
    ws: float = _size(8e3)
    G: float = _size(4.79e3)
    UA: float = _size(20e3)
    wmax: float = _size(3.64)
    cw: float = _size(4180.0)
    Cp: float = _size(24e3)
    Cr: float = _size(110e3)
    Cs: float = _size(110e3)
    kl: float = attrs.field(default=0.004, converter=float)
    R: float = _size(50.0)
    N: float = _size(0.5)

    def __attrs_post_init__(self) -> None:
        if self.R <= 1:
            raise InputError(f"expected a rangeability > 1 (got {self.R:g})", "line.R")
        if self.N > 1:
            raise InputError(f"expected an authority <= 1 (got {self.N:g})", "line.N")
        if not 0 <= self.kl < math.inf:
            raise InputError(f"expected a leakage >= 0 (got {self.kl:g})", "line.kl")
        if self.ws < self.G / 2:
            raise InputError(
                f"expected ws >= G/2 = {self.G / 2:g} W/K, else A is not Metzler "
                f"(got {self.ws:g}); more coolant or a smaller G",
                "line.ws",
            )
        self.y0  # noqa: B018  (raises if there is no operating point)

    def sized(self, power: float) -> LineParameters:
        """Return a line for another nominal load: flows, conductances and capacities in proportion.

        Parameters
        ----------
        power : float
            Nominal heat load [W].

        Examples
        --------
        >>> big = LineParameters().sized(120e3)
        >>> big.ws, round(big.y0, 3)
        (12000.0, 0.717)
        """
        scale = power / self.P0
        names = ("P0", "ws", "G", "UA", "wmax", "Cp", "Cr", "Cs")
        return attrs.evolve(self, **{name: scale * getattr(self, name) for name in names})

    # ---- valve and exchanger --------------------------------------------------------------------

    def kv(self, y: ArrayLike) -> Array:
        """Flow coefficient of the primary circuit at valve position y, 1 when open.

        ``1/√(N/φ² + 1 - N)`` with the equal-percentage characteristic ``φ = R^(y-1)``.
        """
        phi = self.R ** (np.asarray(y, dtype=float) - 1)
        return np.asarray(1 / np.sqrt(self.N / phi**2 + 1 - self.N))

    def kv_slope(self, y: ArrayLike) -> Array:
        """Return dkv/dy."""
        phi = self.R ** (np.asarray(y, dtype=float) - 1)
        return np.asarray(self.kv(y) ** 3 * self.N * math.log(self.R) / phi**2)

    def wp(self, y: ArrayLike, h: ArrayLike = 1.0) -> Array:
        """Heat capacity flow of the facility water [W/K] at header pressure factor h."""
        return np.asarray(self.cw * self.wmax * self.kv(y) * np.sqrt(h))

    def kappa(self, y: ArrayLike, h: ArrayLike = 1.0) -> Array:
        """Heat to the facility water per kelvin of θr [W/K]; below ws at every y and h."""
        return conductance(self.UA, self.ws, self.wp(y, h))

    def kappa_slope(self, y: ArrayLike, h: ArrayLike = 1.0) -> Array:
        """Return ∂κ/∂y [W/K]."""
        water = self.cw * self.wmax * np.sqrt(h) * self.kv_slope(y)
        return np.asarray(conductance_slope(self.UA, self.ws, self.wp(y, h)) * water)

    # ---- the line -------------------------------------------------------------------------------

    def A(self, kappa: float, P: float = 0.0) -> Array:
        """System matrix of (θp, θr, θs) [1/s], (3, 3); Metzler for 0 <= κ <= ws.

        Parameters
        ----------
        kappa : float
            From `kappa` [W/K].
        P : float
            Load whose leakage is included [W]; 0 leaves the leakage out.
        """
        half = self.G / 2
        return np.array(
            [
                [(P * self.kl - self.G) / self.Cp, half / self.Cp, half / self.Cp],
                [self.G / self.Cr, -(half + self.ws) / self.Cr, (self.ws - half) / self.Cr],
                [0.0, (self.ws - kappa) / self.Cs, -self.ws / self.Cs],
            ]
        )

    @property
    def kappa0(self) -> float:
        """κ at the operating point [W/K]."""
        return self.P0 / self.theta_r0

    @property
    def theta_r0(self) -> float:
        """Return temperature at the operating point [K]."""
        return self.theta_s0 + self.P0 / self.ws

    @property
    def theta_p0(self) -> float:
        """Plate temperature at the operating point, where leakage is counted from [K]."""
        return (self.theta_r0 + self.theta_s0) / 2 + self.P0 / self.G

    @property
    def theta0(self) -> Array:
        """Operating point (θp, θr, θs) at the load P0 [K]."""
        return np.array([self.theta_p0, self.theta_r0, self.theta_s0])

    @cached_property
    def y0(self) -> float:
        """Valve position of the operating point."""
        return self._position(self.kappa0, 1.0, f"P0 = {self.P0:g} W")

    @property
    def path(self) -> float:
        """Plate above supply temperature per heat released, in a steady state [K/W]."""
        return 1 / (2 * self.ws) + 1 / self.G

    def released(self, P: ArrayLike, theta_s: float) -> Array:
        """Heat with leakage [W] that a steady state at P [W] and a supply temperature releases."""
        P = np.asarray(P, dtype=float)
        leaked = self.kl * (theta_s - self.theta_p0)
        return np.asarray(P * (1 + leaked) / (1 - P * self.kl * self.path))

    def position(self, P: float, theta_s: float | None = None, h: float = 1.0) -> float:
        """Valve position that holds a supply temperature at a constant load.

        Parameters
        ----------
        P : float
            Heat load [W].
        theta_s : float, optional
            Supply temperature [K]; default that of the operating point.
        h : float
            Header pressure factor.

        Raises
        ------
        InputError
            If the line cannot do that with any valve position.
        """
        theta_s = self.theta_s0 if theta_s is None else theta_s
        released = float(self.released(P, theta_s))
        kappa = released / (theta_s + released / self.ws)
        return self._position(kappa, h, f"P = {P:g} W, theta_s = {theta_s:g} K, h = {h:g}")

    def nearest(self, P: float, theta_s: float | None = None, h: float = 1.0) -> float:
        """Return `position`, or the end of the valve's range that comes nearest to it."""
        try:
            return self.position(P, theta_s, h)
        except InputError:
            return float(P > self.P0)

    def _position(self, kappa: float, h: float, case: str) -> float:
        from scipy.optimize import brentq

        low, high = float(self.kappa(0.0, h)), float(self.kappa(1.0, h))
        if not low <= kappa <= high:
            raise InputError(
                f"{case} needs κ = {kappa:.5g} W/K; the valve gives {low:.5g} to {high:.5g}", "line"
            )
        return float(brentq(lambda y: float(self.kappa(y, h)) - kappa, 0.0, 1.0, xtol=1e-15))

    def steady(self, P: float, y: float | None = None, h: float = 1.0) -> Array:
        """Steady state (θp, θr, θs) [K] at load P [W] and valve position y, (3,).

        Raises
        ------
        InputError
            If there is none: leakage grows faster than the heat that the line can carry away.
        """
        A = self.A(float(self.kappa(self.y0 if y is None else y, h)), P)
        if np.linalg.eigvals(A).real.max() >= 0:
            raise InputError(
                f"thermal runaway: no steady state at P = {P:g} W, y = {y}, h = {h:g}", "line"
            )
        heat = P * (1 - self.kl * self.theta_p0) / self.Cp
        return np.asarray(np.linalg.solve(A, [-heat, 0.0, 0.0]))

    def time_constants(self, P: float | None = None, y: float | None = None) -> Array:
        """Time constants [s], slowest first, (3,), at load P [W] and valve position y.

        Examples
        --------
        >>> line = LineParameters()
        >>> round(line.time_constants()[0]), round(line.time_constants(y=0.3)[0])
        (38, 219)
        """
        kappa = float(self.kappa(self.y0 if y is None else y))
        poles = np.linalg.eigvals(self.A(kappa, self.P0 if P is None else P))
        return np.sort(-1 / poles.real)[::-1]

    def static_gains(self) -> tuple[float, float]:
        """Return g_d and g_u [K/W]: θs per heat load and per heat retained by the valve.

        At the operating point, with the leakage of P0.

        Examples
        --------
        >>> g_d, g_u = LineParameters().static_gains()
        >>> round(1e4 * g_d, 2), round(1e4 * g_u, 2)  # K per 10 kW
        (0.7, 1.92)
        """
        inverse = np.linalg.inv(self.A(self.kappa0, self.P0))
        return float(-inverse[2, 0] / self.Cp), float(-inverse[2, 2] / self.Cs)
