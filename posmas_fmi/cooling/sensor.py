"""What a temperature sensor makes of a temperature: noise, then the steps of its converter."""

from __future__ import annotations

import attrs
import numpy as np
from numpy.typing import ArrayLike

from posmas_fmi.expression import Array


@attrs.frozen
class Sensor:
    """A sensor with white noise and a finite resolution.

    Attributes
    ----------
    noise : float
        Standard deviation [K].
    resolution : float
        Step between two values [K]; 0 for none.

    Examples
    --------
    >>> Sensor(noise=0.0).read([310.13, 310.18], np.random.default_rng(1)).round(6)
    array([310.1, 310.2])
    """

    noise: float = 0.05
    resolution: float = 0.1

    def read(self, temperature: ArrayLike, random: np.random.Generator) -> Array:
        """Return what is measured, in the shape of `temperature`."""
        value = np.asarray(temperature, dtype=float)
        if self.noise > 0:
            value = value + self.noise * random.standard_normal(value.shape)
        if self.resolution > 0:
            value = np.round(value / self.resolution) * self.resolution
        return value
