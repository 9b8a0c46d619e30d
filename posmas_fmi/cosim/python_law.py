"""Controllers that users write in Python: one object per agent, or one for all."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from typing import Protocol as Interface

import numpy as np
import scipy.sparse as sp

from posmas_fmi.agent import Agent
from posmas_fmi.cosim.law import Decision, Heard, Weights
from posmas_fmi.cosim.propagator import Propagator
from posmas_fmi.errors import InputError
from posmas_fmi.expression import Array
from posmas_fmi.network import Network


class Controller(Interface):
    """What a controller of one agent has to have: `step`.

    It may also have ``message(t, y)``, which returns what it tells its neighbours (by default y),
    and ``xhat``, its estimate of the state, for the record.
    """

    def step(self, t: float, y: Array, neighbours: Array, s: Array | None) -> Any:
        """Return the input of the agent, (p,), which is held until the next communication point.

        Parameters
        ----------
        t : float
            [s]
        y : (q,) array
            Measured outputs.
        neighbours : (degree, w) array
            The last message of each agent that this one hears, in the order of the arcs.
        s : (m,) array or None
            The leader's state as it last came; None unless the agent is pinned.
        """


class PythonLaw:
    """Controllers in Python, as the numpy loop runs them. They keep their own memory.

    Parameters
    ----------
    agent : Agent
        The leader moves by this model.
    network : Network
    controllers : sequence of Controller
        One per agent. Or a single object with ``step_all(t, Y, s) -> U`` for all of them, (N, q)
        and the leader's state to (N, p): a central controller without a network.

    Raises
    ------
    InputError
        If there are not as many as agents, or one has no `step`.

    Examples
    --------
    >>> from posmas_fmi.agent import linear_agent
    >>> from posmas_fmi.network import network_from_arcs
    >>> class Follow:
    ...     def step(self, t, y, neighbours, s):
    ...         return (neighbours.mean(axis=0) if s is None else s) - y
    >>> agent = linear_agent([[-1.0]], [[1.0]], [[1.0]])
    >>> law = PythonLaw(agent, network_from_arcs(2, [(1, 2)], [1]), [Follow(), Follow()])
    >>> law.extras
    ()
    """

    def __init__(self, agent: Agent, network: Network, controllers: Sequence[Any] | Any) -> None:
        self._agent, self._network = agent, network
        self._central = None if isinstance(controllers, Sequence) else controllers
        self._each: list[Any] = list(controllers) if isinstance(controllers, Sequence) else []
        if self._central is not None and not hasattr(self._central, "step_all"):
            raise InputError("expected a controller with step_all(t, Y, s)", "$.control.python")
        if self._central is None and len(self._each) != network.N:
            raise InputError(
                f"expected {network.N} controllers, one per agent (got {len(self._each)})",
                "$.control.python",
            )
        for one in self._each:
            if not hasattr(one, "step"):
                raise InputError(
                    "expected a controller with step(t, y, neighbours, s)", "$.control.python"
                )
        a = network.adjacency
        self._arcs_of = [np.arange(a.indptr[i], a.indptr[i + 1]) for i in range(network.N)]
        self._pinned = set(network.pinned)
        self.extras: tuple[str, ...] = tuple(getattr(self._some, "extras", ()))
        nothing = sp.csr_array((network.N, a.nnz))
        zero = np.zeros(network.N)
        self.weights = Weights(zero, nothing, zero, zero, nothing)
        self._width = 0
        self._read_back = np.linalg.pinv(agent.C)
        self._t = 0.0
        self._steps: dict[float, Propagator] = {}

    @property
    def _some(self) -> Any:
        return self._central if self._central is not None else self._each[0]

    def start(self, xhat0: Array) -> Array:
        """Return the first estimates."""
        return np.array(xhat0)

    def lead(self, s0: Array) -> Array:
        """Return the leader's state."""
        return np.array(s0)

    def send(self, memory: Array, measured: Array) -> Array:
        """Return the message of each agent, then room for the leader's state, (N, w + m)."""
        if self._central is not None:
            told = measured
        else:
            told = np.array(
                [
                    np.atleast_1d(one.message(self._t, y)) if hasattr(one, "message") else y
                    for one, y in zip(self._each, measured, strict=True)
                ],
                dtype=float,
            )
        self._width = told.shape[1]
        return np.concatenate([told, np.zeros((len(told), self._agent.m))], axis=1)

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
        """Ask every controller.

        Raises
        ------
        InputError
            If an answer has another size than the agent's input, or is not finite.
        """
        w, messages = self._width, heard.messages
        if self._central is not None:
            s = heard.leader[min(self._pinned)][w:] if self._pinned else None
            u = self._checked(self._central.step_all(t, measured, s), measured.shape[0], "step_all")
        else:
            u = np.concatenate(
                [
                    self._checked(
                        one.step(
                            t,
                            measured[i],
                            messages[self._arcs_of[i], :w],
                            heard.leader[i][w:] if i in self._pinned else None,
                        ),
                        1,
                        f"step of agent {self._network.names[i]}",
                    )
                    for i, one in enumerate(self._each)
                ]
            )
        self._t = t + h
        return Decision(u, self._agent.sec_numpy(u), self._estimates(measured))

    def _checked(self, answer: Any, rows: int, what: str) -> Array:
        try:
            u = np.array(answer, dtype=float).reshape(rows, self._agent.p)
        except (TypeError, ValueError):
            raise InputError(
                f"{what}: expected {rows * self._agent.p} numbers (got {answer!r})",
                "$.control.python",
            ) from None
        if not np.isfinite(u).all():
            raise InputError(f"{what}: expected finite inputs (got {u})", "$.control.python")
        return u

    def _estimates(self, measured: Array) -> Array:
        """Return what the controllers take for the states; else what explains y best."""
        plain = measured[:, : self._agent.q] @ self._read_back.T
        for i, one in enumerate(self._each):
            if getattr(one, "xhat", None) is not None:
                plain[i] = one.xhat
        return np.asarray(plain)

    def leader_message(self, memory: Array) -> Array:
        """Return room for a message, then the leader's state."""
        width = self._width or self._agent.q + len(self.extras)
        return np.concatenate([np.zeros(width), memory])

    def leader_step(self, t: float, h: float, memory: Array) -> Array:
        """Return the leader's state (3) after one step."""
        if h not in self._steps:
            self._steps[h] = Propagator.of(self._agent, h)
        return np.asarray(self._steps[h](t, memory[None, :], np.zeros((1, self._agent.m)))[0])


def load_class(text: str, folder: Path) -> Callable[..., Any]:
    """Return the class that ``"file.py:Class"`` names. This runs the file.

    Raises
    ------
    InputError
        If there is no such file or class, or the file cannot be run.
    """
    place = "$.control.python"
    file, colon, name = text.rpartition(":")
    path = folder / file
    if not colon or not path.is_file():
        raise InputError(f'expected "file.py:Class" beside the scenario (got {text!r})', place)
    spec = importlib.util.spec_from_file_location(f"posmas_fmi_user_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise InputError(f"expected a Python file (got {file!r})", place)
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise InputError(f"{file} cannot be run: {type(error).__name__}: {error}", place) from error
    found = getattr(module, name, None)
    if not callable(found):
        raise InputError(f"{file} has no class {name!r}", place)
    return found  # type: ignore[no-any-return]
