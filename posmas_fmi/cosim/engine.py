"""The engine: the loop of `posmas_fmi.cosim.master` in C, for FMUs and compiled expressions."""

from __future__ import annotations

import ctypes
import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import attrs
import numpy as np

from posmas_fmi.agent import Agent
from posmas_fmi.cosim import native
from posmas_fmi.cosim.channel import Arrivals
from posmas_fmi.cosim.fmu_plant import FmuPlant
from posmas_fmi.cosim.fmus import Report
from posmas_fmi.cosim.master import (
    DIVERGED,
    Outcome,
    Progress,
    Record,
    System,
    diverged_reason,
    errors_at,
    simulate,
)
from posmas_fmi.cosim.plant import Plant
from posmas_fmi.cosim.propagator import Propagator
from posmas_fmi.errors import BuildError, InputError
from posmas_fmi.expression import Array, VectorFunction

log = logging.getLogger(__name__)

Wanted = Literal["auto", "c", "numpy"]
RecordBlock = Callable[[Array, dict[str, Array]], None]  # times (r,), arrays (r, …)

SLICE = 0.05  # s of wall time between returns to Python: how long Ctrl-C may take
BLOCK = 4_000_000  # bytes of rows that are kept until the slice ends
VARIABLES = ("x", "xhat", "u", "sec_u", "y", "s")


@attrs.frozen
class Choice:
    """Which loop runs a system.

    Attributes
    ----------
    engine : {"c", "numpy"}
    reason : str
        Why not C, where it is not.
    library : Path or None
        The engine's.
    """

    engine: Literal["c", "numpy"]
    reason: str = ""
    library: Path | None = None

    def to_dict(self) -> dict[str, str]:
        """Return what a manifest says about it."""
        facts: dict[str, str] = {"used": self.engine}
        if self.library is not None:
            facts["library"] = self.library.name  # the name holds a hash of its sources
        return facts | ({"reason": self.reason} if self.reason else {})


def choose(agent: Agent, wanted: Wanted = "auto") -> Choice:
    """Choose the loop for a system of these agents, and have the engine compiled.

    Parameters
    ----------
    agent : Agent
    wanted : {"auto", "c", "numpy"}
        Auto: the engine where it can be used.

    Raises
    ------
    InputError
        If the engine is wanted but g or sec are no expressions.
    BuildError
        If the engine is wanted but cannot be compiled.

    Examples
    --------
    >>> from posmas_fmi.agent import linear_agent
    >>> choose(linear_agent([[-1.0]], [[1.0]], [[1.0]]), "numpy").engine
    'numpy'
    """
    if wanted == "numpy":
        return Choice("numpy", "chosen in the scenario")
    g, sec = agent.g, agent.sec
    if not isinstance(g, VectorFunction) or not isinstance(sec, VectorFunction):
        reason = "g and sec are Python functions; the engine needs expressions"
        if wanted == "c":
            raise InputError(reason, "$.scenario.engine")
        return _fall_back(reason)
    try:
        sources = native.engine_sources(g, sec, agent.m, agent.p, agent.q)
        path = native.library(sources)
        native.load(path)
    except BuildError as error:
        if wanted == "c":
            raise
        return _fall_back(str(error))
    return Choice("c", library=path)


def _fall_back(reason: str) -> Choice:
    log.warning("running with numpy instead of the engine: %s", reason)
    return Choice("numpy", reason)


def run(
    system: System,
    plant: Plant,
    record: RecordBlock | None = None,
    progress: Progress | None = None,
    choice: Choice | None = None,
    threads: int = 1,
    variables: tuple[str, ...] = VARIABLES,
) -> Outcome:
    """Run the sampled loop; the same as `posmas_fmi.cosim.master.simulate`, faster.

    Parameters
    ----------
    system : System
    plant : Plant
        Initialised at t = 0. Not closed here.
    record : callable, optional
        Gets the times (r,) and the arrays, (r, …) each, of consecutive communication points. The
        arrays are used again: copy what is kept.
    progress : callable, optional
        Gets the number of steps done and in all.
    choice : Choice, optional
        From `choose`; made here by default.
    threads : int
        Of the engine. The FMUs must allow it; the results are the same bit for bit.
    variables : tuple of str
        What to record.

    Returns
    -------
    Outcome
    """
    choice = choice or choose(system.agent)
    if choice.engine == "c" and not isinstance(plant, FmuPlant):
        choice = _fall_back(f"the engine steps FMUs (the plant is a {type(plant).__name__})")
    if choice.engine == "numpy":
        return simulate(system, plant, _by_row(record, variables), progress)
    assert isinstance(plant, FmuPlant)
    assert choice.library is not None
    library = native.load(choice.library)
    return Engine(system, plant, library, threads, variables if record else ()).run(
        record, progress
    )


def _by_row(record: RecordBlock | None, variables: tuple[str, ...]) -> Record | None:
    if record is None:
        return None

    def row(t: float, values: dict[str, Array]) -> None:
        chosen = {name: value[None] for name, value in values.items() if name in variables}
        record(np.array([t]), chosen)

    return row


_int, _double, _pointer = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p
_GOES_ON, _COMPLETE, _DIVERGED, _FAILED, _NO_THREAD = range(5)


class _Engine(ctypes.Structure):
    """The structure of csrc/engine.h."""

    _fields_ = (
        ("fmus", _pointer),
        ("controller", _pointer),
        ("steps", _int),
        ("period", _int),
        ("shows_states", _int),
        ("all_arcs", _int),
        ("first_arc", _pointer),
        ("sender", _pointer),
        ("weight", _pointer),
        ("innovation_weight", _pointer),
        ("leader_arc", _pointer),
        ("own", _pointer),
        ("leader", _pointer),
        ("own_innovation", _pointer),
        ("delay", _pointer),
        ("slots", _int),
        ("k", _int),
        ("ready", _int),
        ("diverging", _int),
        ("xhat", _pointer),
        ("innovation", _pointer),
        ("readings", _pointer),
        ("held", _pointer),
        ("min_state", _pointer),
        ("min_time", _pointer),
        ("limit", _double),
        ("until", _int),
        ("threads", _int),
        ("scratch", _pointer),
        ("reports", _pointer),
        ("arrivals", _pointer),
        ("time", _pointer),
        ("x", _pointer),
        ("xhat_rows", _pointer),
        ("u", _pointer),
        ("sec_u", _pointer),
        ("y", _pointer),
        ("s", _pointer),
        ("rows", _int),
        ("halt", _int),
        ("ended", _int),
    )


class Engine:
    """One run in C: its memory, and the slices that Python drives.

    Parameters
    ----------
    system : System
    plant : FmuPlant
    library : ctypes.CDLL
    threads : int
    variables : tuple of str
        To be recorded.
    """

    def __init__(
        self,
        system: System,
        plant: FmuPlant,
        library: ctypes.CDLL,
        threads: int,
        variables: tuple[str, ...],
    ) -> None:
        self._system, self._plant = system, plant
        self._run = library.engine_run
        self._run.argtypes, self._run.restype = [_pointer], None
        self._keep: dict[str, Any] = {}  # what the structure points to
        self._e = _Engine()
        if library.engine_size() != ctypes.sizeof(_Engine):
            raise BuildError("the engine's library does not belong to this version")
        self._observed = -1  # the last communication point that was recorded
        self._pending = False
        self._sent = self._lost = 0
        self._largest_initial = 0.0
        self._threads = max(1, min(threads, system.network.N, int(library.engine_threads())))
        self._define(library)
        self._allocate()
        self._make_rows(variables)

    # ---- memory ---------------------------------------------------------------------------------

    def _point(self, name: str, array: Any, dtype: Any = np.float64) -> Any:
        """Let a member of the structure point to an array, and keep it."""
        self._keep[name] = kept = np.ascontiguousarray(array, dtype=dtype)
        setattr(self._e, name, kept.ctypes.data)
        return kept

    def _define(self, library: ctypes.CDLL) -> None:
        system, e = self._system, self._e
        network, protocol, channel = system.network, system.protocol, system.channel
        arcs, pinned = network.adjacency.nnz, network.pinned
        constants = self._point("controller", _constants(system))
        if library.engine_controller_size() != constants.nbytes:
            raise BuildError("the engine's library was made for an agent of other sizes")
        e.fmus = self._plant.fmus.address
        e.steps, e.period = system.clock.steps, system.clock.period
        e.shows_states = self._plant.shows_states
        e.all_arcs = arcs + len(pinned)
        self._point("first_arc", network.adjacency.indptr, np.int64)
        self._point("sender", system.senders, np.int64)
        receiver = np.repeat(np.arange(network.N), np.diff(network.adjacency.indptr))
        self._point("weight", _by_arc(protocol.heard, receiver))
        innovation_weight = _by_arc(protocol.heard_innovation, receiver)
        if innovation_weight.any():
            self._point("innovation_weight", innovation_weight)
        leader_arc = np.full(network.N, -1)
        leader_arc[list(pinned)] = arcs + np.arange(len(pinned))
        self._point("leader_arc", leader_arc, np.int64)
        for name in ("own", "leader", "own_innovation"):
            self._point(name, getattr(protocol, name))
        e.slots = channel.longest + 2
        self._arrivals = None
        if channel.jitter.any() or channel.loss.any():
            self._arrivals = Arrivals(channel, np.random.default_rng(system.seed))
        elif channel.delay.any():
            self._point("delay", channel.delay, np.int64)

    def _allocate(self) -> None:
        system, e = self._system, self._e
        n, m, q = system.network.N, system.agent.m, system.agent.q
        self._xhat = self._point("xhat", np.zeros((e.slots, n + 1, m)))
        self._xhat[0, :n], self._xhat[0, n] = system.xhat0, system.s0
        self._innovation = self._point("innovation", np.zeros((e.slots, n + 1, q)))
        width = q + (m if self._plant.shows_states else 0)
        self._readings = self._point("readings", np.zeros((2, n, width)))
        self._min_state = self._point("min_state", np.full(n, np.inf))
        self._min_time = self._point("min_time", np.zeros(n))
        e.limit = np.inf
        self._use_threads(self._threads)

    def _use_threads(self, threads: int) -> None:
        self._e.threads = threads
        self._point("scratch", np.zeros((threads, self._plant.fmus.room)))
        self._reports = (Report * threads)()
        self._e.reports = ctypes.addressof(self._reports)

    def _make_rows(self, variables: tuple[str, ...]) -> None:
        """Make the buffers of a slice; touched, so that the first slice is as fast as others."""
        system = self._system
        n, agent = system.network.N, system.agent
        shapes = {
            "x": (n, agent.m),
            "xhat": (n, agent.m),
            "u": (n, agent.p),
            "sec_u": (n, agent.p),
            "y": (n, agent.q),
            "s": (agent.m,),
        }
        wanted = {name: shape for name, shape in shapes.items() if name in variables}
        if not self._plant.shows_states:
            wanted.pop("x", None)
        row = 8 * sum(int(np.prod(shape)) for shape in wanted.values()) + 8
        arrivals = 0 if self._arrivals is None else 4 * self._e.all_arcs
        self._room = int(max(1, min(BLOCK // (row + arrivals), system.clock.steps + 1)))
        self._rows: dict[str, Array] = {}
        if wanted:
            self._time = self._point("time", np.full(self._room, 0.0))
        for name, shape in wanted.items():
            member = "xhat_rows" if name == "xhat" else name
            self._rows[name] = self._point(member, np.full((self._room, *shape), 0.0))

    # ---- the run --------------------------------------------------------------------------------

    def halt(self) -> None:
        """Stop at the next communication point; may be called from any thread."""
        self._e.halt = 1

    def run(self, record: RecordBlock | None, progress: Progress | None) -> Outcome:
        """Run to the end; see `run`."""
        ended: Any = "complete"
        reason = agent = ""
        try:
            self._begin()
            self._slices(record, progress)
        except KeyboardInterrupt:
            ended, reason = "cancelled", "interrupted"
            self._take(record)
        time_now = self._system.clock.time(self._e.k)
        if self._e.ended == _FAILED:
            error = self._plant.fmus.error(self._reports[0], time_now)
            ended, reason, agent = "failed", str(error), error.agent
        elif self._e.ended == _DIVERGED:
            agent, reason = self._diverged()
            ended = "diverged"
        elif self._e.halt:
            ended, reason = "cancelled", "halted"
        self._plant.stepped_to(time_now)
        return self._outcome(ended, reason, agent)

    def _begin(self) -> None:
        """Read the FMUs at the start, from which the limit of divergence follows."""
        self._e.until = 0
        self._call()
        if self._e.ended != _GOES_ON:
            return
        n, system = self._system.network.N, self._system
        truth = self._truth(0)
        xhat, s = self._xhat[0, :n], self._xhat[0, n]
        scale = max(np.abs(truth).max(), np.abs(s).max(), np.abs(xhat).max(), 1.0)
        self._e.limit = DIVERGED * float(scale)
        self._largest_initial = float(np.abs(truth - s).max())
        if self._arrivals is not None:
            message = np.concatenate([self._xhat[0], self._innovation[0]], axis=1)
            senders = np.concatenate([system.senders, np.full(len(system.network.pinned), n)])
            self._point("held", message[senders])

    def _slices(self, record: RecordBlock | None, progress: Progress | None) -> None:
        e, clock = self._e, self._system.clock
        length = 1
        while e.ended == _GOES_ON and not e.halt:
            room = min(length, self._room) if self._rows or self._arrivals else length
            e.until = min(e.k + room, clock.steps + 1)
            if self._arrivals is not None:
                self._point("arrivals", self._arrivals.draw(e.k, e.until), np.int32)
            began = time.perf_counter()
            self._call()
            took = time.perf_counter() - began
            self._take(record)
            if progress is not None:
                progress(e.k, clock.steps)
            length = int(min(2 * length, max(1, length * SLICE / max(took, 1e-6))))

    def _call(self) -> None:
        self._pending = True
        self._run(ctypes.addressof(self._e))
        if self._e.ended == _NO_THREAD:
            log.warning("the system gives no %d threads; going on with one", self._e.threads)
            self._use_threads(1)
            self._run(ctypes.addressof(self._e))
        self._plant.fmus.warn(self._reports[0], self._system.clock.time(self._e.k))

    def _take(self, record: RecordBlock | None) -> None:
        """Hand over the rows of the last slice and count its messages, once."""
        if not self._pending:
            return
        self._pending = False
        rows = self._e.rows
        self._observed += rows
        self._sent += rows * self._e.all_arcs
        if self._arrivals is not None:
            self._lost += int(self._arrivals.lost[:rows].sum())
        if record is not None and rows:
            record(self._time[:rows], {name: array[:rows] for name, array in self._rows.items()})

    # ---- the outcome ----------------------------------------------------------------------------

    def _truth(self, k: int) -> Array:
        """States at point k as far as they are known: the estimates where the FMU shows none."""
        if self._plant.shows_states:
            return np.asarray(self._readings[k % 2, :, self._system.agent.q :])
        return np.asarray(self._xhat[k % self._e.slots, :-1])

    def _diverged(self) -> tuple[str, str]:
        k = self._e.k
        xhat = self._xhat[k % self._e.slots, :-1]
        size = np.maximum(np.abs(self._truth(k)).max(axis=1), np.abs(xhat).max(axis=1))
        names = self._system.network.names
        return diverged_reason(names, size, self._e.limit, self._system.clock.time(k))

    def _outcome(self, ended: Any, reason: str, agent: str) -> Outcome:
        n, k = self._system.network.N, self._observed
        tracking = estimation = np.zeros(n)
        if k >= 0:
            here = self._xhat[k % self._e.slots]
            tracking, estimation = errors_at(self._truth(k), here[:n], here[n])
        return Outcome(
            ended=ended,
            steps=self._e.k,
            time=self._system.clock.time(self._e.k),
            tracking_error=tracking,
            estimation_error=estimation,
            largest_initial=self._largest_initial,
            min_state=self._min_state,
            min_time=self._min_time,
            messages=self._sent,
            lost=self._lost,
            reason=reason,
            failed_agent=agent,
        )


def _constants(system: System) -> Array:
    """Return the members of csrc/controller.h's structure, one after the other."""
    agent, protocol = system.agent, system.protocol
    step = Propagator.of(agent, system.clock.h)
    matrices = (
        *(protocol.K, protocol.E, agent.B, agent.C, agent.H),
        *(step.full, step.half, step.gamma, step.half_gamma),
        *(step.start, step.middle, step.end),
    )
    return np.concatenate([[step.h], *(matrix.ravel() for matrix in matrices)])


def _by_arc(weights: Any, receiver: Any) -> Array:
    """Weight of each arc from a matrix (N, arcs) that has it in the row of the receiver."""
    entries = weights.tocoo()
    if (entries.row != receiver[entries.col]).any():
        raise InputError("expected weights of what an agent hears itself (got those of others)")
    values = np.zeros(len(receiver))
    np.add.at(values, entries.col, entries.data)
    return values
