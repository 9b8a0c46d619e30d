"""Parameters and start values of the shipped FMUs `cooling_line` and `facility_header`."""

from __future__ import annotations

import math

from posmas_fmi.cooling.line import LineParameters
from posmas_fmi.errors import InputError

FACILITY = 305.15  # K: facility supply of class W32
_PIPE = 40e3 / 80e3  # J/K per W: 10 L of PG25 in each pipe of an 80 kW line (assumed)


def line_values(
    line: LineParameters,
    load: float | None = None,
    y: float | None = None,
    facility: float = FACILITY,
) -> dict[str, float]:
    """Return the values that make FMU `cooling_line` this line, started in a steady state.

    Parameters
    ----------
    line : LineParameters
    load : float, optional
        Heat load of the steady state [W]; default that of the operating point.
    y : float, optional
        Valve position of the steady state; default that of the operating point.
    facility : float
        Facility supply temperature [K].

    Returns
    -------
    dict of str to float
        Parameters, inputs and start values of the states, in the units of the FMU.

    Raises
    ------
    InputError
        If there is no such steady state, or ``G >= 2 ws`` (more than a plate of one temperature
        can give to the coolant).

    Examples
    --------
    >>> values = line_values(LineParameters())
    >>> round(values["T_supply"], 2), round(values["plate_UA"], 1)
    (310.15, 4941.3)
    """
    if line.ws <= line.G / 2:
        raise InputError(f"expected G < 2 ws = {2 * line.ws:g} W/K (got {line.G:g})", "line.G")
    load = line.P0 if load is None else load
    y = line.y0 if y is None else y
    theta_p, theta_r, theta_s = (float(v) for v in line.steady(load, y))
    return {
        "UA": line.UA,
        "plate_UA": 2 * line.ws * math.atanh(line.G / (2 * line.ws)),
        "coolant_flow": line.ws,
        "water_flow_max": line.wmax,
        "water_heat": line.cw,
        "plate_capacity": line.Cp,
        "return_capacity": line.Cr,
        "return_pipe_capacity": _PIPE * line.P0,
        "supply_capacity": line.Cs,
        "supply_pipe_capacity": _PIPE * line.P0,
        "leakage": line.kl,
        "leakage_from": FACILITY + line.theta_p0,
        "rangeability": line.R,
        "authority": line.N,
        "heat_load": load,
        "valve": y,
        "facility_temperature": facility,
        "T_plate": facility + theta_p,
        "T_return": facility + theta_r,
        "T_return_pipe": facility + theta_r,
        "T_supply": facility + theta_s,
        "T_supply_pipe": facility + theta_s,
        "position": y,
    }


def header_values(
    line: LineParameters,
    lines: int,
    shortage: float = 1.0,
    loads: float = 1.0,
    facility: float = FACILITY,
) -> dict[str, float]:
    """Return the values that make FMU `facility_header` the header of a row of equal lines.

    Parameters
    ----------
    line : LineParameters
    lines : int
        How many.
    shortage : float
        Shared part of the resistance, Rh of ``h = (1 + Rh)/(1 + Rh (S/Sn)²)``; 0: ample water.
    loads : float
        Heat that the facility is built for, relative to the nominal loads.
    facility : float
        Supply temperature at that heat [K].

    Returns
    -------
    dict of str to float
        Parameters, inputs and start values; ``kv`` of the lines are inputs and not among them.

    Raises
    ------
    InputError
        If `lines` or `loads` are not positive, or `shortage` is negative.

    Examples
    --------
    >>> round(header_values(LineParameters(), 8)["kv_nominal"], 3)
    3.548
    """
    if not (lines > 0 and loads > 0 and shortage >= 0):
        raise InputError(
            f"expected lines > 0, loads > 0 and shortage >= 0 (got {lines}, {loads}, {shortage})",
            "header",
        )
    heat = lines * line.P0 * loads
    return {
        "resistance": shortage,
        "kv_nominal": lines * float(line.kv(line.y0)),
        "capacity": 16.7e6 * heat / 640e3,
        "set_point": facility - 0.5,
        "control": heat / 0.5,
        "cooler": heat / 6.0,
        "heat": lines * line.P0,
        "T_supply": facility,
    }
