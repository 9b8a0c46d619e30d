"""Jacobians by central differences of fourth order, with an estimate of their error."""

from __future__ import annotations

from collections.abc import Callable

import attrs
import numpy as np

from posmas_fmi.expression import Array

RELATIVE_STEP = 1e-3  # of the size of the variable; the fourth order leaves about step**4


@attrs.frozen(eq=False)
class Jacobian:
    """A Jacobian and how well it is known.

    Attributes
    ----------
    value : (k, n) ndarray
    error : (k, n) ndarray
        Estimate: how much the last refinement changed, and what is not repeatable.
    steps : (n,) ndarray
        The larger of the two steps.
    noise : float
        Largest change of the function when it is evaluated again at the same place.
    """

    value: Array
    error: Array
    steps: Array
    noise: float


def jacobian(function: Callable[[Array], Array], at: Array, steps: Array) -> Jacobian:
    """Differentiate a function numerically.

    Central differences with each step and with half of it, extrapolated (Richardson).

    Parameters
    ----------
    function : callable
        (n,) to (k,).
    at : (n,) ndarray
    steps : (n,) ndarray
        Positive.

    Returns
    -------
    Jacobian

    Examples
    --------
    >>> made = jacobian(lambda x: np.sin(x), np.array([0.3]), np.array([1e-3]))
    >>> bool(abs(made.value[0, 0] - np.cos(0.3)) < 1e-12)
    True
    """
    before = function(at)
    value, error = np.zeros((before.size, at.size)), np.zeros((before.size, at.size))
    for j, step in enumerate(steps):
        coarse, fine = (_central(function, at, j, part) for part in (step, step / 2))
        value[:, j] = (4 * fine - coarse) / 3
        error[:, j] = np.abs(value[:, j] - fine)
    again = np.abs(function(at) - before)
    # a difference of values that are off by up to `again` and by the rounding of a double
    rounding = float(np.finfo(float).eps) * np.abs(before)
    error += np.outer(again + rounding, 2 / steps)
    return Jacobian(value, error, steps, float(again.max(initial=0.0)))


def _central(function: Callable[[Array], Array], at: Array, j: int, step: float) -> Array:
    ahead, behind = at.copy(), at.copy()
    ahead[j] += step
    behind[j] -= step
    return np.asarray((function(ahead) - function(behind)) / (ahead[j] - behind[j]))


def steps_for(at: Array, nominal: Array, relative: float = RELATIVE_STEP) -> Array:
    """Return a step for each variable from its value and its typical size."""
    return np.asarray(relative * np.maximum(np.abs(at), np.abs(nominal)))
