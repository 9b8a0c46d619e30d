"""Limits of a cooling row: facility water classes, dew point, and how long a limit is exceeded."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from posmas_fmi.errors import InputError
from posmas_fmi.expression import Array

ZERO_CELSIUS = 273.15  # K

# Largest facility supply temperature of each class [°C] (ASHRAE TC 9.9, water-cooled servers).
W_CLASSES: dict[str, float] = {"W17": 17.0, "W27": 27.0, "W32": 32.0, "W40": 40.0, "W45": 45.0}

# Magnus formula over water (Sonntag 1990), -45 to 60 °C.
_MAGNUS_A, _MAGNUS_B = 17.62, 243.12
_MAGNUS_RANGE = (-45.0, 60.0)


def class_limit(name: str) -> float:
    """Return the largest facility supply temperature of a class [K].

    Raises
    ------
    InputError
        If there is no such class.

    Examples
    --------
    >>> class_limit("W32")
    305.15
    """
    if name not in W_CLASSES:
        raise InputError(f"expected one of {', '.join(W_CLASSES)} (got {name!r})", "class")
    return W_CLASSES[name] + ZERO_CELSIUS


def class_of(temperature: float) -> str:
    """Return the coolest class that a facility supply temperature [K] belongs to.

    Raises
    ------
    InputError
        If it is warmer than every class.

    Examples
    --------
    >>> class_of(300.15), class_of(300.2)
    ('W27', 'W32')
    """
    for name, limit in W_CLASSES.items():
        if temperature <= limit + ZERO_CELSIUS:
            return name
    raise InputError(
        f"{temperature:g} K is above W45 ({W_CLASSES['W45'] + ZERO_CELSIUS:g} K)", "temperature"
    )


def dew_point(temperature: ArrayLike, humidity: ArrayLike) -> Array:
    """Dew point of air [K]: no surface of the coolant loop may be colder.

    Parameters
    ----------
    temperature : array_like
        Air [K], 228.15 to 333.15.
    humidity : array_like
        Relative, above 0 to 1.

    Raises
    ------
    InputError
        Outside those ranges.

    References
    ----------
    Magnus formula with the coefficients of Sonntag, Z. Meteorol. 70 (1990) 340-344.

    Examples
    --------
    >>> round(float(dew_point(298.15, 0.5)) - 273.15, 1)
    13.9
    """
    celsius = np.asarray(temperature, dtype=float) - ZERO_CELSIUS
    humidity = np.asarray(humidity, dtype=float)
    low, high = _MAGNUS_RANGE
    if not ((celsius >= low) & (celsius <= high)).all():
        raise InputError(
            f"expected air of {low + ZERO_CELSIUS:g} to {high + ZERO_CELSIUS:g} K "
            f"(got {np.asarray(temperature)})",
            "temperature",
        )
    if not ((humidity > 0) & (humidity <= 1)).all():
        raise InputError(f"expected a relative humidity in (0, 1] (got {humidity})", "humidity")
    exponent = np.log(humidity) + _MAGNUS_A * celsius / (_MAGNUS_B + celsius)
    return np.asarray(_MAGNUS_B * exponent / (_MAGNUS_A - exponent) + ZERO_CELSIUS)


def exceedance(time: ArrayLike, values: ArrayLike, limit: ArrayLike) -> Array:
    """How far and how long values are above a limit, ``∫ max(v - limit, 0) dt`` [unit·s].

    Values are straight lines between samples, and the integral is exact for those.

    Parameters
    ----------
    time : (n,) array_like
        Increasing [s].
    values : (n, ...) array_like
    limit : array_like
        Broadcast against `values`.

    Returns
    -------
    (...) ndarray

    Examples
    --------
    >>> float(exceedance([0.0, 2.0], [-1.0, 1.0], 0.0))
    0.5
    """
    time = np.asarray(time, dtype=float)
    over = np.asarray(values, dtype=float) - limit
    a, b = over[:-1], over[1:]
    up, down = np.maximum(a, b), np.minimum(a, b)
    rise = np.where(up > down, up - down, 1.0)
    # area of the part above zero: a trapezium, or a triangle where the line crosses zero
    mean = np.where(down >= 0, (a + b) / 2, np.maximum(up, 0.0) ** 2 / (2 * rise))
    step = np.diff(time).reshape(-1, *[1] * (over.ndim - 1))
    return np.asarray((mean * step).sum(axis=0))
