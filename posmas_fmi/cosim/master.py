"""The master: the communication loop over plants, observers, controllers and the channel."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, Literal, NoReturn

import attrs
import numpy as np

from posmas_fmi.agent import Agent
from posmas_fmi.cosim.channel import Channel, Mailbox
from posmas_fmi.cosim.clock import Clock
from posmas_fmi.cosim.plant import Plant
from posmas_fmi.cosim.propagator import Propagator
from posmas_fmi.errors import FmuCallError
from posmas_fmi.expression import Array
from posmas_fmi.network import Network
from posmas_fmi.protocol import Protocol

log = logging.getLogger(__name__)

Progress = Callable[[int, int], None]  # (steps done, steps in all)
Record = Callable[[float, dict[str, Array]], None]

# Beyond this multiple of the largest initial value a run is called diverged and ends.
DIVERGED = 1e4


@attrs.frozen(eq=False)
class System:
    """Definition of a co-simulation: everything but its state.

    Parameters
    ----------
    agent : Agent
        The model that observers and leader compute with.
    network : Network
    protocol : Protocol
    channel : Channel
        Over the arcs of the network and then one arc from the leader to each pinned agent.
    clock : Clock
    xhat0 : (N, m) array
        Initial estimates.
    s0 : (m,) array
        Initial state of the leader.
    seed : int
        Of the channel's random numbers.
    """

    agent: Agent
    network: Network
    protocol: Protocol
    channel: Channel
    clock: Clock
    xhat0: Array
    s0: Array
    seed: int = 0

    @property
    def senders(self) -> Array:
        """Index of the agent that sends over each arc between agents."""
        return np.asarray(self.network.adjacency.indices)


@attrs.define(eq=False)
class State:
    """All state of a run outside the plants."""

    k: int
    xhat: Array
    s: Array
    mailbox: Mailbox


@attrs.frozen(eq=False)
class Outcome:
    """How a run ended.

    Attributes
    ----------
    ended : {"complete", "diverged", "failed", "cancelled"}
    steps : int
        Communication steps done.
    time : float
        Where it ended [s].
    tracking_error, estimation_error : (N,) array
        Largest modulus over the states at the end, against the leader and the estimate; the
        tracking error is that of the estimate where the plant does not show x.
    largest_initial : float
        Largest tracking error at the start.
    min_state, min_time : (N,) array
        Smallest state of each agent at a communication point, and when [s].
    messages, lost : int
    reason : str
        Empty for a complete run.
    """

    ended: Literal["complete", "diverged", "failed", "cancelled"]
    steps: int
    time: float
    tracking_error: Array
    estimation_error: Array
    largest_initial: float
    min_state: Array
    min_time: Array
    messages: int
    lost: int
    reason: str = ""
    failed_agent: str = ""


def simulate(
    system: System,
    plant: Plant,
    record: Record | None = None,
    progress: Progress | None = None,
) -> Outcome:
    """Run the sampled loop: at each communication point read, exchange, compute, then step.

    The input u_k that follows from the outputs at t_k is held from t_k to t_{k+1}; this is the
    loop that certificate T is about.

    Parameters
    ----------
    system : System
    plant : Plant
        Initialised at t = 0. Not closed here.
    record : callable, optional
        Gets the time [s] and the arrays ``x, xhat, u, sec_u, y, s`` at every communication point.
    progress : callable, optional
        Gets the number of steps done and in all.

    Returns
    -------
    Outcome
        Also where the run diverged, an FMU failed, or it was interrupted: what was recorded
        before stays.
    """
    return _Run(system, plant, record, progress).run()


class _Stop(Exception):  # noqa: N818  (ends the loop; no error)
    def __init__(self, ended: Any, reason: str, agent: str = "") -> None:
        self.ended, self.reason, self.agent = ended, reason, agent


class _Run:
    """One pass through the loop, with the figures that the outcome needs."""

    def __init__(
        self, system: System, plant: Plant, record: Record | None, progress: Progress | None
    ) -> None:
        self.system, self.plant = system, plant
        self.record, self.progress = record, progress
        self.step_estimate = Propagator.of(system.agent, system.clock.h)
        self.pinned = np.array(system.network.pinned, dtype=int)
        self.arcs = system.network.adjacency.nnz
        random = np.random.default_rng(system.seed)
        empty = np.zeros((self.arcs + len(self.pinned), system.agent.m + system.agent.q))
        self.state = State(
            0, system.xhat0.copy(), system.s0.copy(), Mailbox(system.channel, empty, random)
        )
        self.largest_initial = 0.0
        self.min_state = np.full(system.network.N, np.inf)
        self.min_time = np.zeros(system.network.N)
        self.tracking = self.estimation = np.zeros(system.network.N)
        self.limit = np.inf

    def run(self) -> Outcome:
        ended: Any = "complete"
        reason = agent = ""
        try:
            with np.errstate(invalid="ignore", over="ignore"):  # running away is a verdict
                self._loop()
        except _Stop as stop:
            ended, reason, agent = stop.ended, stop.reason, stop.agent
        except FmuCallError as error:
            ended, reason, agent = "failed", str(error), error.agent
        except KeyboardInterrupt:
            ended, reason = "cancelled", "interrupted"
        state = self.state
        return Outcome(
            ended=ended,
            steps=state.k,
            time=self.system.clock.time(state.k),
            tracking_error=self.tracking,
            estimation_error=self.estimation,
            largest_initial=self.largest_initial,
            min_state=self.min_state,
            min_time=self.min_time,
            messages=state.mailbox.sent,
            lost=state.mailbox.lost,
            reason=reason,
            failed_agent=agent,
        )

    def _loop(self) -> None:
        clock, system, state = self.system.clock, self.system, self.state
        agent, protocol = system.agent, system.protocol
        for k in range(clock.steps + 1):
            t = clock.time(k)
            y, x = self.plant.outputs(), self.plant.states()
            innovation = y - state.xhat @ agent.C.T
            heard, heard_innovation, s_known = self._exchange(k, innovation)
            U = protocol.control(state.xhat, heard, s_known)
            sec_u = agent.sec_numpy(U)
            self._observe(t, x, y, U, sec_u)
            if k == clock.steps:
                break
            self.plant.step(k, t, clock.h, U)
            held = sec_u @ agent.B.T + protocol.injection(innovation, heard_innovation)
            state.xhat = self.step_estimate(t, state.xhat, held)
            state.s = self.step_estimate(t, state.s[None, :], np.zeros((1, agent.m)))[0]
            state.k = k + 1
            if self.progress is not None:
                self.progress(state.k, clock.steps)

    def _exchange(self, k: int, innovation: Array) -> tuple[Array, Array, Array]:
        """Send (x̂, innovation) over every arc and s to the pinned; return what is now held."""
        state, m = self.state, self.system.agent.m
        sent = np.concatenate([state.xhat, innovation], axis=1)[self.system.senders]
        from_leader = np.zeros((len(self.pinned), sent.shape[1]))
        from_leader[:, :m] = state.s
        message = np.concatenate([sent, from_leader])
        if k == 0:
            state.mailbox.held = message
        received = state.mailbox.exchange(k, message)
        s_known = np.zeros_like(state.xhat)
        s_known[self.pinned] = received[self.arcs :, :m]
        return received[: self.arcs, :m], received[: self.arcs, m:], s_known

    def _observe(self, t: float, x: Array | None, y: Array, U: Array, sec_u: Array) -> None:
        """Record, and keep the figures of the outcome."""
        state = self.state
        if self.record is not None:
            row = {"xhat": state.xhat, "u": U, "sec_u": sec_u, "y": y, "s": state.s}
            if x is not None:
                row["x"] = x
            self.record(t, row)
        truth = state.xhat if x is None else x
        self.tracking, self.estimation = errors_at(truth, state.xhat, state.s)
        if state.k == 0:
            self.largest_initial = float(self.tracking.max())
            scale = max(np.abs(truth).max(), np.abs(state.s).max(), np.abs(state.xhat).max(), 1.0)
            self.limit = DIVERGED * float(scale)
        lowest = reduce(np.minimum, truth.T)
        falls = lowest < self.min_state
        self.min_state = np.where(falls, lowest, self.min_state)
        self.min_time = np.where(falls, t, self.min_time)
        size = np.maximum(_largest(truth), _largest(state.xhat))
        if not (size <= self.limit).all():
            self._diverged(t, size)

    def _diverged(self, t: float, size: Array) -> NoReturn:
        name, reason = diverged_reason(self.system.network.names, size, self.limit, t)
        raise _Stop("diverged", reason, name)


def errors_at(truth: Array, xhat: Array, s: Array) -> tuple[Array, Array]:
    """Largest modulus over the states of tracking and of estimation error, (N,) each."""
    with np.errstate(invalid="ignore", over="ignore"):
        return _largest(truth - s), _largest(truth - xhat)


def _largest(X: Array) -> Array:
    """Largest modulus in each row, (N,); column by column, for rows are short and many."""
    return np.asarray(reduce(np.maximum, np.abs(X).T))


def diverged_reason(names: Sequence[str], size: Array, limit: float, t: float) -> tuple[str, str]:
    """Name of the agent that is furthest beyond the limit, and the reason for the outcome."""
    worst = int(np.nanargmax(np.where(np.isfinite(size), size, np.inf)))
    name = names[worst]
    return name, f"agent {name} passed {limit:.3g} at t = {t:.6g} s; the run ends there"
