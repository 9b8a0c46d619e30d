"""Controllers that users write in Python: one object per agent, or one for all."""

from __future__ import annotations

import importlib.util
import inspect
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from typing import Protocol as Interface

import numpy as np
import scipy.sparse as sp

from posmas_fmi.agent import Agent
from posmas_fmi.cosim.clock import Clock
from posmas_fmi.cosim.law import Decision, Heard, Weights
from posmas_fmi.cosim.propagator import Propagator
from posmas_fmi.errors import InputError
from posmas_fmi.expression import Array
from posmas_fmi.network import Network

PLACE = "$.control.python"


class Controller(Interface):
    """What a controller of one agent has to have: `step`.

    It may also have ``message(t, y)``, which returns what it tells its neighbours (by default y),
    the same number of values at all times; and ``xhat``, its estimate of the state, for the record.
    It is asked at its communication points only: an agent with a longer period, at every end of it.
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
            The last message of each agent that this one hears, by the numbers of the senders;
            without those whose arc is off.
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
        and the leader's state (None where nobody is pinned) to (N, p): a central controller
        without a network.
    every : (N,) array of int, optional
        Control period of each agent in communication steps; 1 by default.
    clock : Clock, optional
        Of the run, for the time of messages; by default what `step` is given says it.

    Raises
    ------
    InputError
        If there are not as many as agents, or one has no `step` of these arguments.

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

    def __init__(
        self,
        agent: Agent,
        network: Network,
        controllers: Sequence[Any] | Any,
        every: Sequence[int] | None = None,
        clock: Clock | None = None,
    ) -> None:
        self._clock = clock
        self._every = np.ones(network.N, dtype=int) if every is None else np.array(every)
        self._agent, self._network = agent, network
        self._central = None if isinstance(controllers, Sequence) else controllers
        self._each: list[Any] = list(controllers) if isinstance(controllers, Sequence) else []
        if self._central is None and len(self._each) != network.N:
            raise InputError(
                f"expected {network.N} controllers, one per agent (got {len(self._each)})", PLACE
            )
        if self._central is not None:
            _check_signature(self._central, "step_all", ("t", "Y", "s"))
        for one in {type(one): one for one in self._each}.values():
            _check_signature(one, "step", ("t", "y", "neighbours", "s"))
            if hasattr(one, "message"):
                _check_signature(one, "message", ("t", "y"))
        a = network.adjacency
        self.extras: tuple[str, ...] = tuple(getattr(self._some, "extras", ()))
        # the weights say which arcs are in the digraph, no more
        arcs = sp.csr_array((np.ones(a.nnz), np.arange(a.nnz), a.indptr), (network.N, a.nnz))
        nothing, zero = sp.csr_array((network.N, a.nnz)), np.zeros(network.N)
        pinned = np.isin(np.arange(network.N), network.pinned).astype(float)
        self.weights = Weights(zero, arcs, pinned, zero, nothing)
        self._width = 0
        self._u = np.zeros((network.N, agent.p))
        self._asked = -1.0
        self._read_back = np.linalg.pinv(agent.C)
        self._t, self._sends, self._h = 0.0, 0, 0.0  # of the communication points
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
        k, clock = self._sends, self._clock
        self._t = round(k * self._h, 9) if clock is None else clock.time(k)
        self._sends += 1
        told = measured
        if any(hasattr(one, "message") for one in self._each):
            told = self._messages(measured)
        self._width = told.shape[1]
        return np.concatenate([told, np.zeros((len(told), self._agent.m))], axis=1)

    def _messages(self, measured: Array) -> Array:
        rows: list[Array] = []
        for i, (one, y) in enumerate(zip(self._each, measured, strict=True)):
            what = f"message of agent {self._network.names[i]} at t = {self._t:.6g} s"
            answer = _ask(one.message, what, self._t, y) if hasattr(one, "message") else y
            width = self._width or (rows[0].size if rows else None)
            rows.append(_numbers(answer, width, what))
        return np.array(rows)

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
        w, messages, leaders = self._width, heard.messages, heard.leader
        self._h = self._h or h / int(self._every.min())
        if self._central is not None:
            if t != self._asked:  # once, however many periods begin here
                pinned = [i for i in self._network.pinned if weights.leader[i]]
                s = leaders[pinned[0]][w:] if pinned else None
                what = f"step_all at t = {t:.6g} s"
                answer = _ask(self._central.step_all, what, t, measured, s)
                self._u = _numbers(answer, self._u.size, what).reshape(self._u.shape)
            self._asked = t
        else:
            arcs = weights.heard
            self._u = self._u.copy()
            for i in np.flatnonzero(self._every == round(h / self._h)):
                what = f"step of agent {self._network.names[i]} at t = {t:.6g} s"
                row = slice(arcs.indptr[i], arcs.indptr[i + 1])
                hears = arcs.indices[row][arcs.data[row] != 0]
                s = leaders[i][w:] if weights.leader[i] else None
                answer = _ask(self._each[i].step, what, t, measured[i], messages[hears, :w], s)
                self._u[i] = _numbers(answer, self._agent.p, what)
        return Decision(self._u, self._agent.sec_numpy(self._u), self._estimates(measured))

    def _estimates(self, measured: Array) -> Array:
        """Return what the controllers take for the states; else what explains y best."""
        plain = measured[:, : self._agent.q] @ self._read_back.T
        for i, one in enumerate(self._each):
            if getattr(one, "xhat", None) is not None:
                plain[i] = _numbers(one.xhat, self._agent.m, f"xhat of agent {i + 1}")
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


def make(function: Callable[..., Any], *arguments: Any, **parameters: Any) -> Any:
    """Make a controller: whatever its code raises is bad input.

    Raises
    ------
    InputError
    """
    try:
        return function(*arguments, **parameters)
    except (Exception, SystemExit) as error:
        raise InputError(f"cannot be made: {_said(error)}", PLACE) from error


def _ask(function: Callable[..., Any], what: str, *arguments: Any) -> Any:
    """Call what a user wrote; say who raised what, and where."""
    try:
        return function(*arguments)
    except (Exception, SystemExit) as error:
        raise InputError(f"{what}: {_said(error)}", PLACE) from error


def _said(error: BaseException) -> str:
    """Return kind and text of an exception, with the last place in a user's file."""
    text = f"{type(error).__name__}: {error}".removesuffix(": ")
    frames = traceback.extract_tb(error.__traceback__)[1:]
    own = [f for f in frames if "site-packages" not in f.filename and "<" not in f.filename]
    return f"{text} ({Path(own[-1].filename).name}, line {own[-1].lineno})" if own else text


def _numbers(answer: Any, count: int | None, what: str) -> Array:
    """Return an answer as so many finite numbers."""
    expected = f"{what}: expected {_several(count)}"
    try:
        values = np.array([] if answer is None else answer, dtype=float).ravel()
    except (TypeError, ValueError):
        values = np.zeros(0)
    if count is None and values.size:
        count = values.size
    if values.size != count:
        got = "None: is there a return?" if answer is None else f"{answer!r}"
        raise InputError(f"{expected} (got {got})", PLACE)
    if not np.isfinite(values).all():
        raise InputError(f"{expected}, finite (got {answer!r})", PLACE)
    return values


def _several(count: int | None) -> str:
    return "numbers" if count is None else f"{count} number{'s' if count != 1 else ''}"


def _check_signature(controller: Any, name: str, arguments: tuple[str, ...]) -> None:
    """Refuse a method that does not take these arguments, before anything runs."""
    call = f"{name}({', '.join(arguments)})"
    method = getattr(controller, name, None)
    if not callable(method):
        raise InputError(f"expected a controller with {call}", PLACE)
    try:
        signature = inspect.signature(method)
    except (TypeError, ValueError):  # of compiled code, say: it will be seen when it is asked
        return
    try:
        signature.bind(*arguments)
    except TypeError:
        raise InputError(
            f"expected a controller with {call}, self not counted "
            f"(got {name}{str(signature).partition(' -> ')[0]})",
            PLACE,
        ) from None


def load_class(text: str, folder: Path) -> Callable[..., Any]:
    """Return the class that ``"file.py:Class"`` names. This runs the file.

    Raises
    ------
    InputError
        If there is no such file or class, or the file cannot be run.
    """
    file, colon, name = text.rpartition(":")
    path = folder / file
    if not colon or not path.is_file():
        raise InputError(f'expected "file.py:Class" beside the scenario (got {text!r})', PLACE)
    spec = importlib.util.spec_from_file_location(f"posmas_fmi_user_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise InputError(f"expected a Python file (got {file!r})", PLACE)
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise InputError(f"{file} cannot be run: {_said(error)}", PLACE) from error
    found = getattr(module, name, None)
    if not callable(found):
        raise InputError(f"{file} has no class {name!r}", PLACE)
    return found  # type: ignore[no-any-return]
