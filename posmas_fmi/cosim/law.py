"""The controllers of all agents as the master sees them: what is sent, and what follows from it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from copy import copy
from ctypes import CDLL
from typing import TYPE_CHECKING
from typing import Protocol as Interface

import attrs
import numpy as np
import scipy.sparse as sp

from posmas_fmi.agent import Agent
from posmas_fmi.cosim.compiled_step import Step, compiled_step
from posmas_fmi.cosim.propagator import Propagator
from posmas_fmi.errors import InputError
from posmas_fmi.expression import Array, VectorFunction
from posmas_fmi.protocol import Protocol

if TYPE_CHECKING:
    from posmas_fmi.cosim.native import Sources


@attrs.frozen(eq=False)
class Heard:
    """What the agents hold of others at a communication point.

    Attributes
    ----------
    pool : (k, w) array
        Messages.
    held : (arcs,) array of int
        Which of them is the last one over each arc between agents.
    from_leader : (pinned, w) array
        Last message from the leader, of each pinned agent.
    pinned : (pinned,) array of int
    silence : (N, 2) array
        How long ago the oldest of the last messages from neighbours was sent, and that of the
        leader [s].
    """

    pool: Array
    held: np.ndarray[tuple[int], np.dtype[np.int64]]
    from_leader: Array
    pinned: np.ndarray[tuple[int], np.dtype[np.int64]]
    silence: Array

    @property
    def leader(self) -> Array:
        """Last message from the leader, (N, w); zero where an agent is not pinned."""
        messages = columns(len(self.silence), self.pool.shape[1])
        messages[:] = 0.0
        messages[self.pinned] = self.from_leader
        return messages

    @property
    def messages(self) -> Array:
        """Last message over each arc between agents, (arcs, w)."""
        return np.asarray(self.pool[self.held])


@attrs.frozen(eq=False)
class Weights:
    """How a message enters the disagreement of the agents that hear it; see `Protocol`.

    The last `innovation` values of a message have the weights of the observer (22), those before
    them the weights of (6).

    Attributes
    ----------
    own, leader, own_innovation : (N,) array
    heard, heard_innovation : (N, arcs) sparse array
    innovation : int
    at_once : sparse array, optional
        Where all messages arrive at once: the weights of (6) as one matrix, see `arriving`.
    """

    own: Array
    heard: sp.csr_array
    leader: Array
    own_innovation: Array
    heard_innovation: sp.csr_array
    innovation: int = 0
    at_once: sp.csr_array | None = None

    @classmethod
    def of(cls, protocol: Protocol, innovation: int) -> Weights:
        """Take the weights of a protocol."""
        return cls(
            protocol.own,
            protocol.heard,
            protocol.leader,
            protocol.own_innovation,
            protocol.heard_innovation,
            innovation,
        )

    def disagreement(self, sent: Array, heard: Heard) -> Array:
        """Weighted disagreement of each agent with what it has heard, (N, w)."""
        N, width = sent.shape
        first = width - self.innovation
        result = columns(N, width)
        main, rest = result.T[:first], result.T[first:]  # rows are quantities
        if self.at_once is not None:  # own estimates, those heard and the leader's in one product
            main[:] = (self.at_once @ heard.pool.T[:first].ravel()).reshape(first, N)
        else:
            np.multiply(self.own, sent.T[:first], out=main)
            main -= (self.heard @ heard.messages[:, :first]).T
            main -= self.leader * heard.leader.T[:first]
        np.multiply(self.own_innovation, sent.T[first:], out=rest)
        if self.heard_innovation.data.size:
            rest -= (self.heard_innovation @ heard.messages[:, first:]).T
        return result

    def arriving(self, senders: Array, width: int) -> Weights:
        """Return weights for messages that all arrive at once.

        Then (6) is one matrix ``[own - heard, -leader]`` times what the agents and, in the last
        row, the leader have sent.

        Parameters
        ----------
        senders : (arcs,) array of int
            Who sends over each arc.
        width : int
            Of a message.
        """
        N, heard = len(self.own), self.heard
        by_sender = sp.csr_array((heard.data, senders[heard.indices], heard.indptr), shape=(N, N))
        leader = sp.csr_array(self.leader[:, None])
        matrix = sp.hstack([sp.diags_array(self.own) - by_sender, -leader])
        each = sp.block_diag([matrix] * (width - self.innovation), format="csr")
        return attrs.evolve(self, at_once=sp.csr_array(each))

    def without(self, off: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> Weights:
        """Leave arcs out of the digraph.

        Parameters
        ----------
        off : (arcs + N,) array of bool
            Arcs between agents, then the arc from the leader to each agent.
        """
        arcs = self.heard.shape[1]
        gone = sp.diags_array(off[:arcs].astype(float))
        lost = np.asarray((self.heard @ gone).sum(axis=1)).ravel()
        lost_innovation = np.asarray((self.heard_innovation @ gone).sum(axis=1)).ravel()
        unpinned = np.where(off[arcs:], self.leader, 0.0)
        keep = sp.diags_array(1.0 - off[:arcs])
        return attrs.evolve(
            self,
            own=self.own - lost - unpinned,
            heard=sp.csr_array(self.heard @ keep),
            leader=self.leader - unpinned,
            own_innovation=self.own_innovation - lost_innovation,
            heard_innovation=sp.csr_array(self.heard_innovation @ keep),
        )


@attrs.frozen(eq=False)
class Decision:
    """What the controllers make of a communication point.

    Attributes
    ----------
    u : (N, p) array
        Input of each agent.
    applied : (N, p) array
        What the controller takes it for: sec(u), or the limited input.
    memory : (N, k) array
        At the next communication point.
    leader : (k,) array, optional
        What the leader remembers there, where it was computed along with the others.
    """

    u: Array
    applied: Array
    memory: Array
    leader: Array | None = None


def columns(rows: int, width: int) -> Array:
    """Room for an array whose columns stand in one piece: rows are many and short."""
    return np.empty((width, rows)).T


class Law(Interface):
    """The controllers of all agents. Definition only: what they remember is given and returned.

    Attributes
    ----------
    weights : Weights
    extras : tuple of str
        What an agent measures beside its outputs.
    """

    weights: Weights
    extras: tuple[str, ...]

    def start(self, xhat0: Array) -> Array:
        """Return what the agents remember at the start, (N, k), from their first estimates."""

    def lead(self, s0: Array) -> Array:
        """Return what the leader remembers, (k,), at the state s0 (m,)."""

    def send(self, memory: Array, measured: Array) -> Array:
        """Return the message of each agent, (N, w)."""

    def step(
        self,
        t: float,
        h: float,
        measured: Array,
        sent: Array,
        heard: Heard,
        memory: Array,
        weights: Weights,
        leader: Array,
    ) -> Decision:
        """Return the inputs from t to t + h [s] and what is remembered there.

        `leader` is what the leader remembers; its next may be returned as well.
        """

    def leader_message(self, memory: Array) -> Array:
        """Return what the leader sends, (w,)."""

    def leader_step(self, t: float, h: float, memory: Array) -> Array:
        """Return what the leader remembers at t + h."""


class CompiledLaw(Law, ABC):
    """What a law needs so that the engine can run it: C sources and the data for them."""

    @abstractmethod
    def sources(self) -> Sources:
        """Return the sources of the engine with these controllers.

        Raises
        ------
        InputError
            If they cannot be had in C.
        """

    @abstractmethod
    def members(self, h: float) -> dict[str, Array]:
        """Return the members of the structure ``Controller`` for a period h [s], in order."""

    def constants(self, h: float) -> Array:
        """Return their values one after the other."""
        return np.concatenate([np.ravel(value) for value in self.members(h).values()])

    @property
    def own_values(self) -> Array:
        """The parameters in which agents differ, (N, k)."""
        return np.zeros((0, 0))


class ProtocolLaw(CompiledLaw):
    """The protocol: input (6), its saturation, and the sampled observer (5) or (22).

    Parameters
    ----------
    agent : Agent
        The model that observers and leader compute with.
    protocol : Protocol

    Examples
    --------
    >>> from posmas_fmi.agent import linear_agent
    >>> from posmas_fmi.network import network_from_arcs
    >>> from posmas_fmi.protocol import make_protocol
    >>> one = network_from_arcs(1, [], pinned=[1])
    >>> protocol = make_protocol(one, K=[[-1.0]], E=[[0.5]], phi=2.0)
    >>> law = ProtocolLaw(linear_agent([[-1.0]], [[1.0]], [[1.0]]), protocol)
    >>> law.send(memory=np.array([[3.0]]), measured=np.array([[4.0]]))
    array([[3., 1.]])
    """

    extras: tuple[str, ...] = ()

    def __init__(self, agent: Agent, protocol: Protocol) -> None:
        self.agent, self.protocol = agent, protocol
        self.weights = Weights.of(protocol, innovation=agent.q)
        self._propagators: dict[float, Propagator] = {}
        self._library: CDLL | None = None
        self._steps: dict[float, Step] = {}  # in C

    def propagator(self, h: float) -> Propagator:
        """Return the sampled propagation of the model over h [s]."""
        if h not in self._propagators:
            self._propagators[h] = Propagator.of(self.agent, h)
        return self._propagators[h]

    def compiled(self, library: CDLL) -> ProtocolLaw:
        """Return this law with its `step` in C, from the library of its `sources`."""
        law = copy(self)
        law._library, law._steps = library, {}
        return law

    def _in_c(self, h: float) -> Step | None:
        if self._library is not None and h not in self._steps:
            constants = self.constants(h)
            self._steps[h] = compiled_step(self._library, constants, self.agent.p)
        return self._steps.get(h)

    def sources(self) -> Sources:
        """Return the sources of the engine; g and sec must be expressions."""
        from posmas_fmi.cosim.native import engine_sources
        from posmas_fmi.fmu.positive_agent import functions_header

        agent = self.agent
        if not isinstance(agent.g, VectorFunction) or not isinstance(agent.sec, VectorFunction):
            raise InputError(
                "g and sec are Python functions; the engine needs expressions", "$.scenario.engine"
            )
        header = functions_header(agent.g, agent.sec, agent.m, agent.p, agent.q, lanes=True)
        return engine_sources("protocol", header)

    def members(self, h: float) -> dict[str, Array]:
        """Return the members of csrc/protocol/controller.h's structure."""
        agent, protocol = self.agent, self.protocol
        gains = {"h": np.array(h), "K": protocol.K, "E": protocol.E, "B": agent.B, "C": agent.C}
        return gains | self.propagator(h).in_c

    def start(self, xhat0: Array) -> Array:
        """Return the first estimates: that is all an agent remembers."""
        return np.array(xhat0)

    def lead(self, s0: Array) -> Array:
        """Return the leader's state."""
        return np.array(s0)

    def send(self, memory: Array, measured: Array) -> Array:
        """Return the estimate and the innovation ``y - C x̂`` of each agent, (N, m + q)."""
        agent = self.agent
        sent = columns(len(memory), agent.m + agent.q)
        sent[:, : agent.m] = memory
        np.subtract(measured.T, np.dot(agent.C, memory.T), out=sent.T[agent.m :])
        return sent

    def step(
        self,
        t: float,
        h: float,
        measured: Array,
        sent: Array,
        heard: Heard,
        memory: Array,
        weights: Weights,
        leader: Array,
    ) -> Decision:
        """Equation (6), and the observer over one communication step; the leader runs free."""
        agent, N, m = self.agent, len(memory), self.agent.m
        disagreement = weights.disagreement(sent, heard).T
        step = self._in_c(h)
        if step is not None:
            after, ahead, u, applied = step(t, disagreement, np.ascontiguousarray(memory.T), leader)
            return Decision(u.T, applied.T, after.T, ahead)
        propagator = self.propagator(h)
        known = propagator.room(N + 1)  # of the agents and the leader
        states, held = known[:m], known[m : 2 * m]
        u = np.dot(self.protocol.K, disagreement[:m])
        applied = agent.sec_numpy(u.T).T
        states[:, :N], states[:, N] = memory.T, leader
        held[:, :N] = np.dot(self.protocol.E, disagreement[m:])
        held[:, :N] += np.dot(agent.B, applied)
        held[:, N] = 0.0
        known_after = propagator.advance(t, known).T
        return Decision(u.T, applied.T, known_after[:N], known_after[N])

    def leader_message(self, memory: Array) -> Array:
        """Return the state, and no innovation."""
        message = np.zeros(self.agent.m + self.agent.q)
        message[: self.agent.m] = memory
        return message

    def leader_step(self, t: float, h: float, memory: Array) -> Array:
        """Return the leader's state (3) after one step."""
        return np.asarray(self.propagator(h)(t, memory[None, :], np.zeros((1, self.agent.m)))[0])
