"""Plants as the master sees them: read outputs, step with held inputs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol as Interface

import attrs
import numpy as np

from posmas_fmi.agent import Agent
from posmas_fmi.expression import Array


class Plant(Interface):
    """All agents' plants. One call serves all of them, so that an engine may run them together."""

    def outputs(self) -> Array:
        """Return y, (N, q)."""

    def states(self) -> Array | None:
        """Return x, (N, m), where the plant shows it, else None."""

    def step(self, k: int, t: float, h: float, U: Array) -> None:
        """Advance all agents from t by h [s] with the inputs U, (N, p), held."""

    def close(self) -> None:
        """Release what the plant holds."""


@attrs.define(eq=False)
class ModelPlant:
    """Model (1) integrated by scipy, without an FMU: for tests and as an oracle.

    Parameters
    ----------
    agent : Agent
    x : (N, m) array
        Initial states.
    rtol, atol : float
        Tolerances of the integration.
    """

    agent: Agent
    x: Array
    rtol: float = 1e-10
    atol: float = 1e-12

    def outputs(self) -> Array:
        """Return y, (N, q)."""
        return np.asarray(self.x @ self.agent.C.T)

    def states(self) -> Array:
        """Return x, (N, m)."""
        return self.x

    def step(self, k: int, t: float, h: float, U: Array) -> None:
        """Advance all agents from t by h [s] with U held."""
        from scipy.integrate import solve_ivp

        shape = self.x.shape

        def rhs(time: float, flat: Array) -> Array:
            return self.agent.derivative(time, flat.reshape(shape), U).ravel()

        solution = solve_ivp(
            rhs, (t, t + h), self.x.ravel(), method="DOP853", rtol=self.rtol, atol=self.atol
        )
        self.x = solution.y[:, -1].reshape(shape)

    def close(self) -> None:
        """Nothing to release."""


@attrs.define(eq=False)
class CallablePlant:
    """Plant from functions: a mock for tests of the algorithms.

    Parameters
    ----------
    output : callable
        ``output(x) -> (N, q)``.
    advance : callable
        ``advance(k, t, h, x, U) -> (N, m)``.
    x : (N, m) array
    """

    output: Callable[[Array], Array]
    advance: Callable[[int, float, float, Array, Array], Array]
    x: Array
    calls: list[str] = attrs.field(factory=list)

    def outputs(self) -> Array:
        """Return y, (N, q)."""
        self.calls.append("outputs")
        return self.output(self.x)

    def states(self) -> Array | None:
        """Return x, (N, m)."""
        return self.x

    def step(self, k: int, t: float, h: float, U: Array) -> None:
        """Advance by one call of `advance`."""
        self.calls.append("step")
        self.x = self.advance(k, t, h, self.x, U)

    def close(self) -> None:
        """Note the call."""
        self.calls.append("close")
