"""Plants as the master sees them: instances with readings, stepped with held inputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any
from typing import Protocol as Interface

import attrs
import numpy as np

from posmas_fmi.agent import Agent
from posmas_fmi.cosim.failure import Failure
from posmas_fmi.expression import Array
from posmas_fmi.interrupt import Interrupt

Whole = np.ndarray[tuple[int], np.dtype[np.int64]]
Truths = np.ndarray[tuple[int], np.dtype[np.bool_]]


class Plant(Interface):
    """All instances: the agents' first, then those that are no agents.

    Inputs and readings of all instances stand one after the other in one array. The readings of an
    agent begin with y, then x where it is shown; its inputs begin with u.

    Attributes
    ----------
    input_at, reading_at : (instances + 1,) array of int
        Where those of each instance begin.
    shows_states : bool
        Whether readings contain x.
    frozen : (instances,) array of bool
        Which have failed and are not stepped any more: their readings stay.
    """

    input_at: Whole
    reading_at: Whole
    shows_states: bool
    frozen: Truths

    @property
    def failures(self) -> Sequence[Failure]:
        """What has failed so far."""

    def read(self, which: Whole, time: float, readings: Array) -> None:
        """Write the readings of some instances, which stand at a time [s].

        At the start of all; then of those that have just been stepped.
        """

    def step(self, which: Whole, t: Array, h: Array, inputs: Array, readings: Array) -> None:
        """Advance some instances from t over h [s], (n,) each, with their inputs held.

        Readings may be written at once; what cannot be read is raised by `read`.
        """

    def save(self, which: Whole) -> Any:
        """Keep the states of some instances."""

    def restore(self, saved: Any) -> None:
        """Go back to states that were kept."""

    def obey(self, interrupt: Interrupt) -> None:
        """Wait for nothing longer than until Ctrl-C comes, in the run that begins."""

    def checkpoint(self) -> None:
        """Save states for later, if it is time; called between steps."""

    def crash(self, number: int) -> None:
        """Kill the process of an instance, as a fault."""

    def close(self) -> None:
        """Release what the plant holds."""


class _Agents:
    """Plants of equal agents whose states are one array, stepped all together."""

    x: Array
    shows_states = True

    @property
    def failures(self) -> Sequence[Failure]:
        """Nothing fails here."""
        return ()

    def _sizes(self, n: int, p: int, width: int) -> None:
        self.frozen = np.zeros(n, dtype=bool)
        self.input_at = p * np.arange(n + 1)
        self.reading_at = width * np.arange(n + 1)

    def save(self, which: Whole) -> Any:
        """Keep the states."""
        return self.x.copy()

    def restore(self, saved: Any) -> None:
        """Go back to states that were kept."""
        self.x = saved.copy()

    def obey(self, interrupt: Interrupt) -> None:
        """Nothing takes long."""

    def checkpoint(self) -> None:
        """Nothing to save."""

    def crash(self, number: int) -> None:
        """Refuse: there is no process to kill."""
        raise NotImplementedError

    def close(self) -> None:
        """Nothing to release."""


@attrs.define(eq=False, slots=False)
class ModelPlant(_Agents):
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

    def __attrs_post_init__(self) -> None:
        self._sizes(len(self.x), self.agent.p, self.agent.q + self.agent.m)

    def read(self, which: Whole, time: float, readings: Array) -> None:
        """Write y and x of every agent."""
        readings[:] = np.concatenate([self.x @ self.agent.C.T, self.x], axis=1).ravel()

    def step(self, which: Whole, t: Array, h: Array, inputs: Array, readings: Array) -> None:
        """Advance all agents with their inputs held."""
        from scipy.integrate import solve_ivp

        shape, U = self.x.shape, inputs.reshape(len(self.x), -1)

        def rhs(time: float, flat: Array) -> Array:
            return self.agent.derivative(time, flat.reshape(shape), U).ravel()

        solution = solve_ivp(
            rhs, (t[0], t[0] + h[0]), self.x.ravel(), "DOP853", rtol=self.rtol, atol=self.atol
        )
        self.x = solution.y[:, -1].reshape(shape)


@attrs.define(eq=False, slots=False)
class CallablePlant(_Agents):
    """Plant from functions: a mock for tests of the algorithms.

    Parameters
    ----------
    output : callable
        ``output(x) -> (N, q)``.
    advance : callable
        ``advance(t, h, x, U) -> (N, m)``.
    x : (N, m) array
    p : int
        Inputs of an agent, those that are wired included.
    """

    output: Callable[[Array], Array]
    advance: Callable[[float, float, Array, Array], Array]
    x: Array
    p: int = 1
    calls: list[str] = attrs.field(factory=list)

    def __attrs_post_init__(self) -> None:
        width = self.output(self.x).shape[1] + self.x.shape[1]
        self._sizes(len(self.x), self.p, width)

    def read(self, which: Whole, time: float, readings: Array) -> None:
        """Write the outputs and x of some agents."""
        self.calls.append("outputs")
        rows = readings.reshape(len(self.x), -1)
        rows[which] = np.concatenate([self.output(self.x), self.x], axis=1)[which]

    def step(self, which: Whole, t: Array, h: Array, inputs: Array, readings: Array) -> None:
        """Advance some agents by one call of `advance`."""
        self.calls.append("step")
        moved = self.advance(float(t[0]), float(h[0]), self.x, inputs.reshape(len(self.x), -1))
        self.x = self.x.copy()
        self.x[which] = moved[which]

    def close(self) -> None:
        """Note the call."""
        self.calls.append("close")
