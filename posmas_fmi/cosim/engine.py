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

from posmas_fmi.cosim import native
from posmas_fmi.cosim.channel import Arrivals
from posmas_fmi.cosim.fmu_plant import FmuPlant
from posmas_fmi.cosim.fmus import READING, Incident, Report
from posmas_fmi.cosim.law import CompiledLaw, Law, ProtocolLaw, Weights
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
from posmas_fmi.cosim.snapshot import Snapshot, Snapshots
from posmas_fmi.errors import BuildError, FmuEndedError, InputError
from posmas_fmi.expression import Array
from posmas_fmi.interrupt import Interrupt

log = logging.getLogger(__name__)

Wanted = Literal["auto", "c", "numpy"]
RecordBlock = Callable[[Array, dict[str, Array]], None]  # times (r,), arrays (r, …)

SLICE = 0.05  # s of wall time between returns to Python: how long Ctrl-C may take
BLOCK = 4_000_000  # bytes of rows that are kept until the slice ends
STATE = (  # what a snapshot keeps of the engine's memory
    *("memory", "pending", "message", "readings", "measured", "u", "applied", "actuated"),
    *("inputs", "frozen", "min_state", "min_time", "held", "sent_at"),
)
VARIABLES = ("x", "xhat", "u", "sec_u", "y", "s", "measured", "extra")


@attrs.frozen
class Choice:
    """Which loop runs a system.

    Attributes
    ----------
    engine : {"c", "numpy"}
    reason : str
        Why not C, where it is not.
    library : Path or None
        The engine's. The numpy loop takes the step of the law from it, where there is one.
    """

    engine: Literal["c", "numpy"]
    reason: str = ""
    library: Path | None = None

    def to_dict(self) -> dict[str, str]:
        """Return what a manifest says about it."""
        facts: dict[str, str] = {"used": self.engine}
        if self.engine == "numpy":
            facts["functions"] = "numpy" if self.library is None else "c"  # of the law
        if self.library is not None:
            facts["library"] = self.library.name  # the name holds a hash of its sources
        return facts | ({"reason": self.reason} if self.reason else {})


def choose(law: Law, wanted: Wanted = "auto", unfit: str = "") -> Choice:
    """Choose the loop for a system with these controllers, and have the engine compiled.

    Parameters
    ----------
    law : Law
    wanted : {"auto", "c", "numpy"}
        Auto: the engine where it can be used.
    unfit : str, optional
        Why the system needs the numpy loop, whatever its controllers.

    Raises
    ------
    InputError
        If the engine is wanted but g, sec or the controllers are Python functions.
    BuildError
        If the engine is wanted but cannot be compiled.

    Examples
    --------
    >>> from posmas_fmi.agent import linear_agent
    >>> from posmas_fmi.cosim.law import ProtocolLaw
    >>> from posmas_fmi.network import network_from_arcs
    >>> from posmas_fmi.protocol import make_protocol
    >>> protocol = make_protocol(network_from_arcs(1, [], [1]), [[-1.0]], [[0.5]], 1.0)
    >>> choose(ProtocolLaw(linear_agent([[-1.0]], [[1.0]], [[1.0]]), protocol), "numpy").engine
    'numpy'
    """
    if wanted == "c" and unfit:
        raise InputError(unfit, "$.scenario.engine")
    reason = "chosen in the scenario" if wanted == "numpy" else unfit
    path: Path | None = None
    try:
        if not reason or isinstance(law, ProtocolLaw):
            path = _compiled(law)
    except (InputError, BuildError) as error:
        if wanted == "c":
            raise
        reason = reason or (error.message if isinstance(error, InputError) else str(error))
    if not reason:
        return Choice("c", library=path)
    if wanted != "numpy":
        _warn(reason)
    return Choice("numpy", reason, path)


def _compiled(law: Law) -> Path:
    if not isinstance(law, CompiledLaw):
        raise InputError(
            "the controllers are Python functions; the engine needs them in C",
            "$.scenario.engine",
        )
    path = native.library(law.sources())
    native.load(path)
    return path


def _warn(reason: str) -> None:
    log.warning("running with numpy instead of the engine: %s", reason)


def run(
    system: System,
    plant: Plant,
    record: RecordBlock | None = None,
    progress: Progress | None = None,
    choice: Choice | None = None,
    threads: int = 1,
    variables: tuple[str, ...] = VARIABLES,
    snapshots: Snapshots | None = None,
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
    snapshots : Snapshots, optional
        Where to begin, and what to do with snapshots. The numpy loop does all again from the start
        and records from the snapshot on.

    Returns
    -------
    Outcome
    """
    choice = choice or choose(system.law, unfit=unfit(system))
    if choice.engine == "c" and not isinstance(plant, FmuPlant):
        choice = Choice(
            "numpy",
            f"the engine steps FMUs (the plant is a {type(plant).__name__})",
            choice.library,
        )
        _warn(choice.reason)
    if choice.engine == "numpy":
        begin = snapshots.start.k if snapshots is not None and snapshots.start else 0
        if choice.library is not None and isinstance(system.law, ProtocolLaw):
            law = system.law.compiled(native.load(choice.library))
            system = attrs.evolve(system, law=law)
        return simulate(
            system,
            plant,
            _by_row(record, variables, system.clock.time(begin)),
            progress,
            snapshots,
        )
    assert isinstance(plant, FmuPlant)
    assert choice.library is not None
    library = native.load(choice.library)
    one = Engine(system, plant, library, threads, variables if record else ())
    if snapshots is not None:
        if snapshots.every:
            one.keep_snapshots(snapshots.every, snapshots.keep)
        if snapshots.start is not None:
            one.start_from(snapshots)
    return one.run(record, progress)


def unfit(system: System) -> str:
    """Return why the engine cannot run a system; empty if it can."""
    if len(system.stages) > 1 or system.iteration is not None:
        return "the engine steps all FMUs at once; other ways of coupling run with numpy"
    if system.wiring.extrapolates:
        return "derivatives of inputs that are connected are computed with numpy"
    return ""


def _by_row(
    record: RecordBlock | None, variables: tuple[str, ...], begin: float = 0.0
) -> Record | None:
    if record is None:
        return None

    def row(t: float, values: dict[str, Array]) -> None:
        if t < begin:
            return
        chosen = {name: value[None] for name, value in values.items() if name in variables}
        record(np.array([t]), chosen)

    return row


_int, _double, _pointer = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p
_GOES_ON, _COMPLETE, _DIVERGED, _FAILED, _NO_THREAD = range(5)


class _Engine(ctypes.Structure):
    """The structure of csrc/engine.h."""

    _fields_ = (
        ("fmus", _pointer),
        ("agents", _int),
        ("controllers", _pointer),
        ("controller", _pointer),
        ("every", _pointer),
        ("own_values", _pointer),
        ("steps", _int),
        *(("period", _int), ("per_second", _int)),
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
        ("resolution", _double),
        ("first_extra", _pointer),
        ("first_term", _pointer),
        ("term", _pointer),
        ("term_weight", _pointer),
        ("extra_bias", _pointer),
        ("drives", _int),
        ("measured_from", _pointer),
        ("measures_others", _int),
        ("recorded", _pointer),
        ("extra_columns", _int),
        ("sensor_gain", _pointer),
        ("sensor_offset", _pointer),
        ("sensor_resolution", _pointer),
        ("actuator_gain", _pointer),
        ("frozen", _pointer),
        ("freezes", _int),
        ("incident", _pointer),
        ("k", _int),
        ("ready", _int),
        ("diverging", _int),
        ("memory", _pointer),
        ("pending", _pointer),
        ("message", _pointer),
        ("readings", _pointer),
        ("measured", _pointer),
        ("u", _pointer),
        ("applied", _pointer),
        ("actuated", _pointer),
        ("inputs", _pointer),
        ("held", _pointer),
        ("sent_at", _pointer),
        ("min_state", _pointer),
        ("min_time", _pointer),
        ("limit", _double),
        ("until", _int),
        ("threads", _int),
        ("scratch", _pointer),
        ("reports", _pointer),
        ("arrivals", _pointer),
        ("drive", _pointer),
        ("noise", _pointer),
        ("time", _pointer),
        ("x_rows", _pointer),
        ("xhat_rows", _pointer),
        ("u_rows", _pointer),
        ("applied_rows", _pointer),
        ("y_rows", _pointer),
        ("s_rows", _pointer),
        ("measured_rows", _pointer),
        ("extra_rows", _pointer),
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
        assert isinstance(system.law, CompiledLaw)
        self._system, self._plant, self._law = system, plant, system.law
        self._run = library.engine_run
        self._run.argtypes, self._run.restype = [_pointer], None
        self._keep: dict[str, Any] = {}  # what the structure points to
        self._e = _Engine()
        if library.engine_size() != ctypes.sizeof(_Engine):
            raise BuildError("the engine's library does not belong to this version")
        self._observed = -1  # the last communication point that was recorded
        self._pending = self._halted = False
        self._sent = self._lost = 0
        self._conditions = system.timeline.at(0)
        self._incidents: Any = None
        self._start: Snapshot | None = None
        self._snapshots = Snapshots()
        self._checkpoint: Callable[[Snapshot], None] | None = None
        self._checkpoint_every = 0
        self._largest_initial = 0.0
        most = 1 if plant.isolated else int(library.engine_threads())
        self._threads = max(1, min(threads, system.network.N, most))
        self._define(library)
        self._allocate()
        self._make_rows(variables)
        plant.fmus.inputs = self._keep["inputs"]
        if plant.goes_on:
            self.freeze_failures()

    # ---- memory ---------------------------------------------------------------------------------

    def _point(self, name: str, array: Any, dtype: Any = np.float64) -> Any:
        """Let a member of the structure point to an array, and keep it."""
        self._keep[name] = kept = np.ascontiguousarray(array, dtype=dtype)
        setattr(self._e, name, kept.ctypes.data)
        return kept

    def _define(self, library: ctypes.CDLL) -> None:
        system, e = self._system, self._e
        network, law, N = system.network, self._law, system.network.N
        # the first is the leader's, who moves at every communication point
        every, period_of = np.unique(np.append(system.every, 1), return_inverse=True)
        tick = system.clock.h
        constants = [law.constants(int(steps) * tick) for steps in every]
        if library.engine_controller_size() != constants[0].nbytes:
            raise BuildError("the engine's library was made for controllers of other sizes")
        self._point("controllers", np.concatenate(constants))
        self._point("controller", period_of[:N], np.int64)
        self._point("every", system.every, np.int64)
        self._point("own_values", law.own_values)
        e.fmus, e.agents = self._plant.fmus.address, N
        clock = system.clock
        e.steps, e.period, e.per_second = clock.steps, clock.period, clock.per_second
        e.shows_states = self._plant.shows_states
        e.all_arcs = network.adjacency.nnz + len(network.pinned)
        e.resolution = system.channel.resolution
        self._point("first_arc", network.adjacency.indptr, np.int64)
        self._point("sender", system.senders, np.int64)
        leader_arc = np.full(N, -1)
        leader_arc[list(network.pinned)] = network.adjacency.nnz + np.arange(len(network.pinned))
        self._point("leader_arc", leader_arc, np.int64)
        self._set_weights(law.weights)
        channel = attrs.evolve(system.channel, end=system.clock.steps + 1)
        e.slots = channel.longest + 2
        self._arrivals = None
        self._draws_loss = system.timeline.has("loss")
        if channel.jitter.any() or channel.loss.any() or self._draws_loss:
            self._arrivals = Arrivals(channel, np.random.default_rng(system.seed))
        elif channel.delay.any():
            self._point("delay", np.minimum(channel.delay, channel.end), np.int64)
        self._define_wiring()

    def _define_wiring(self) -> None:
        system, e, wiring = self._system, self._e, self._system.wiring
        self._point("first_extra", wiring.first_extra, np.int64)
        self._point("first_term", wiring.first_term, np.int64)
        self._point("term", wiring.sources, np.int64)
        self._point("term_weight", wiring.weights)
        self._point("extra_bias", wiring.bias)
        self._point("measured_from", wiring.measured, np.int64)
        e.measures_others = self._measures_others()
        self._point("recorded", wiring.recorded, np.int64)
        e.extra_columns = len(wiring.recorded)
        e.drives = wiring.drive.columns
        sensors, timeline = system.sensors, system.timeline
        if sensors is not None or timeline.has("sensor_gain", "sensor_offset"):
            shape = (system.network.N, system.measured)
            resolution = np.zeros(shape) if sensors is None else sensors.resolution
            self._point("sensor_resolution", resolution)
        self._noise = system.noisy

    def _measures_others(self) -> bool:
        """Whether agents measure readings of other instances."""
        sources, at = self._system.wiring.measured, self._plant.reading_at
        agents = np.arange(len(sources))[:, None]
        own = (sources >= at[agents]) & (sources < at[agents + 1])
        return bool(((sources >= 0) & ~own).any())

    def _set_weights(self, weights: Weights) -> None:
        """Set how messages count, for the digraph as it now is."""
        network = self._system.network
        receiver = np.repeat(np.arange(network.N), np.diff(network.adjacency.indptr))
        self._point("weight", _by_arc(weights.heard, receiver))
        innovation_weight = _by_arc(weights.heard_innovation, receiver)
        if innovation_weight.any():
            self._point("innovation_weight", innovation_weight)
        else:
            self._e.innovation_weight = None
        for name in ("own", "leader", "own_innovation"):
            self._point(name, getattr(weights, name))

    def _set_conditions(self, k: int) -> None:
        """Set what holds from communication point k on."""
        conditions = self._conditions = self._system.timeline.at(k)
        if "sensor_resolution" in self._keep:
            self._point("sensor_gain", conditions.sensor_gain)
            self._point("sensor_offset", conditions.sensor_offset)
        if self._system.timeline.has("actuator_gain"):
            self._point("actuator_gain", conditions.actuator_gain)
        if self._system.timeline.has("arc_off"):
            self._set_weights(self._system.weights_with(conditions.arc_off))
        jump = self._system.leader_at(k)
        if jump is not None:
            self._memory[k % 2, -1] = self._law.lead(jump)
        for point, number in self._system.crashes:
            if point == k:
                self._plant.crash(number)

    def _allocate(self) -> None:
        system, e, fmus, law = self._system, self._e, self._plant.fmus, self._law
        n, p = system.network.N, system.agent.p
        memory, leader = law.start(system.xhat0), law.lead(system.s0)
        self._memory = self._point("memory", np.zeros((2, n + 1, memory.shape[1])))
        self._memory[0, :n], self._memory[0, n] = memory, leader
        self._point("pending", memory)
        width = len(law.leader_message(leader))
        self._message = self._point("message", np.zeros((e.slots, n + 1, width)))
        self._readings = self._point("readings", np.zeros((2, int(fmus.reading_at[-1]))))
        self._point("measured", np.zeros((2, n, system.measured)))
        for name in ("u", "applied", "actuated"):
            self._point(name, np.zeros((n, p)))
        self._point("inputs", np.zeros(int(fmus.input_at[-1])))
        self._frozen = self._point("frozen", np.zeros(len(fmus)), np.int64)
        self._min_state = self._point("min_state", np.full(n, np.inf))
        self._min_time = self._point("min_time", np.zeros(n))
        e.limit = np.inf
        self._use_threads(self._threads)

    def _use_threads(self, threads: int) -> None:
        self._e.threads = threads
        self._point("scratch", np.zeros((threads, self._plant.fmus.room)))
        self._reports = (Report * threads)()
        self._e.reports = ctypes.addressof(self._reports)

    def freeze_failures(self) -> None:
        """Let the run go on without instances that fail: neighbours keep their last messages."""
        self._incidents = (Incident * len(self._plant.fmus))()
        self._e.incident = ctypes.addressof(self._incidents)
        self._e.freezes = 1

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
            "measured": (n, system.measured),
            "extra": (self._e.extra_columns,),
        }
        wanted = {name: shape for name, shape in shapes.items() if name in variables}
        if not self._plant.shows_states:
            wanted.pop("x", None)
        row = 8 * sum(int(np.prod(shape)) for shape in wanted.values()) + 8
        other = 0 if self._arrivals is None else 48 * self._e.all_arcs  # and what a draw needs
        other += 8 * self._e.drives
        other += 8 * n * system.measured if self._noise else 0
        self._room = int(max(1, min(BLOCK // (row + other), system.clock.steps + 1)))
        self._rows: dict[str, Array] = {}
        # also where nothing else is recorded, as x is not of FMUs that do not show it
        self._time = self._point("time", np.full(self._room, 0.0))
        for name, shape in wanted.items():
            member = "applied_rows" if name == "sec_u" else f"{name}_rows"
            self._rows[name] = self._point(member, np.full((self._room, *shape), 0.0))

    # ---- the run --------------------------------------------------------------------------------

    def halt(self) -> None:
        """Stop at the next communication point; may be called from any thread."""
        self._halted = True
        self._e.halt = 1

    def run(self, record: RecordBlock | None, progress: Progress | None) -> Outcome:
        """Run to the end; see `run`."""
        ended: Any = ""
        reason = agent = ""
        try:
            with Interrupt() as interrupt:
                self._plant.obey(interrupt)
                if self._start is None:
                    self._begin()
                else:
                    self._go_on_from(self._start)
                self._slices(record, progress)
        except KeyboardInterrupt:
            ended, reason = "cancelled", "interrupted"
            self._take(record)
        time_now = self._system.clock.time(self._e.k)
        if self._e.ended == _FAILED and not ended:
            try:
                error = self._plant.fmus.error(self._reports[0].failure, time_now)
                ended = "terminated" if isinstance(error, FmuEndedError) else "failed"
                reason, agent = str(error), error.agent
            except KeyboardInterrupt:  # during a call that goes through Python
                ended, reason = "cancelled", "interrupted"
        elif self._e.ended == _DIVERGED and not ended:
            agent, reason = self._diverged()
            ended = "diverged"
        elif self._halted:
            ended, reason = "cancelled", reason or "halted"
        self._plant.stepped_to(time_now)
        return self._outcome(ended or "complete", reason, agent)

    def _begin(self) -> None:
        """Read the FMUs at the start, from which the limit of divergence follows."""
        self._set_conditions(0)
        self._feed(0, 0)
        self._e.until = 0
        self._call()
        if self._e.ended != _GOES_ON:
            return
        n, m, system = self._system.network.N, self._system.agent.m, self._system
        truth = self._truth(0)
        xhat, s = self._memory[0, :n, :m], self._memory[0, n, :m]
        scale = max(np.abs(truth).max(), np.abs(s).max(), np.abs(xhat).max(), 1.0)
        self._e.limit = DIVERGED * float(scale)
        self._largest_initial = float(np.abs(truth - s).max())
        if self._arrivals is not None:
            senders = np.concatenate([system.senders, np.full(len(system.network.pinned), n)])
            self._point("held", self._message[0, senders])
            self._point("sent_at", np.zeros(len(senders)), np.int64)

    def _feed(self, begin: int, end: int) -> None:
        """Provide what a slice needs from outside: signals, noise, arrivals."""
        e = self._e
        if e.drives:
            self._point("drive", self._system.wiring.drive.rows(begin, end + 1))
        if self._noise:
            self._point("noise", self._system.noise_at(begin, end + 1))
        if self._arrivals is not None and end > begin:
            loss = self._conditions.loss if self._draws_loss else None
            self._point("arrivals", self._arrivals.draw(begin, end, loss), np.int32)

    # ---- snapshots ------------------------------------------------------------------------------

    def keep_snapshots(self, every: int, keep: Callable[[Snapshot], None]) -> None:
        """Hand over a snapshot after so many communication steps, again and again."""
        self._checkpoint_every, self._checkpoint = every, keep

    def start_from(self, snapshots: Snapshots) -> None:
        """Begin there instead of at the start; the plant must be as it is at the start.

        Raises
        ------
        InputError
            If the snapshot is of another system.
        """
        snapshot = snapshots.start
        assert snapshot is not None
        known = {name: self._keep[name].shape for name in STATE if name in self._keep}
        if self._arrivals is not None:  # what is held begins with the first messages
            count = len(self._system.senders) + len(self._system.network.pinned)
            known |= {"held": (count, self._message.shape[-1]), "sent_at": (count,)}
        for name, shape in known.items():
            array = snapshot.arrays.get(name)
            if array is None and snapshot.fmus is None:
                continue  # all is done again; the numpy loop keeps other arrays
            found = "nothing" if array is None else array.shape
            if found != shape:
                raise InputError(
                    f"the snapshot is of another system: {name} has the shape {found}, here {shape}"
                )
        if snapshot.fmus is not None and len(snapshot.fmus) != len(self._plant.fmus):
            raise InputError("the snapshot has another number of FMUs")
        self._start, self._snapshots = snapshot, snapshots

    def snapshot(self) -> Snapshot:
        """Return all state at the communication point that comes next."""
        counts: dict[str, Any] = {
            "limit": float(self._e.limit),
            "largest_initial": self._largest_initial,
            "observed": self._observed,
            "sent": self._sent,
            "lost": self._lost,
        }
        if self._arrivals is not None:
            counts["arrivals"] = self._arrivals.state()
        arrays = {name: self._keep[name].copy() for name in STATE if name in self._keep}
        return Snapshot(int(self._e.k), arrays, counts, self._plant.serialise())

    def _go_on_from(self, snapshot: Snapshot) -> None:
        k, counts = snapshot.k, snapshot.counts
        if snapshot.fmus is None:  # bring the FMUs there by doing all that was done before
            self._begin()
            self._slices(None, None, stop=k)
            self._pending = False
            self._snapshots.compare(self._keep)
            return
        self._plant.deserialise(snapshot.fmus, self._system.clock.time(k))
        for name, array in snapshot.arrays.items():
            if name in self._keep:
                self._keep[name][...] = array
            else:
                self._point(name, array, array.dtype)
        self._e.k, self._e.ready, self._e.limit = k, 1, counts["limit"]
        self._largest_initial, self._observed = counts["largest_initial"], counts["observed"]
        self._sent, self._lost = counts["sent"], counts["lost"]
        if self._arrivals is not None:
            self._arrivals.restore(k, counts["arrivals"])
        self._set_conditions(max(k - 1, 0))

    def _slices(
        self, record: RecordBlock | None, progress: Progress | None, stop: int | None = None
    ) -> None:
        e, clock = self._e, self._system.clock
        length, change = 1, self._system.next_change(max(e.k - 1, 0))
        while e.ended == _GOES_ON and not self._halted and e.k != stop:
            if e.k == change:
                self._set_conditions(e.k)
                e.ready, change = 2, self._system.next_change(e.k)
            e.until = min(e.k + length, e.k + self._room, clock.steps + 1, change)
            if stop is not None:
                e.until = min(e.until, stop)
            every = self._checkpoint_every
            if every:
                e.until = min(e.until, (e.k // every + 1) * every)
            self._feed(e.k, e.until)
            first, began = e.k, time.perf_counter()
            self._call()
            took = time.perf_counter() - began
            self._take(record)
            self._plant.checkpoint()
            if progress is not None:
                progress(e.k, clock.steps)
            due = every and e.k % every == 0 and stop is None
            if due and e.ended == _GOES_ON and self._checkpoint is not None:
                self._checkpoint(self.snapshot())
            # by what was done: a slice often ends earlier, at a snapshot say
            length = int(min(2 * length, max(1, (e.k - first) * SLICE / max(took, 1e-6))))

    def _call(self) -> None:
        self._pending = True
        self._run(ctypes.addressof(self._e))
        if self._e.ended == _NO_THREAD:
            log.warning("the system gives no %d threads; going on with one", self._e.threads)
            self._use_threads(1)
            self._run(ctypes.addressof(self._e))
        self._plant.fmus.check_interrupt()
        time_now = self._system.clock.time(self._e.k)
        self._plant.fmus.warn(self._reports[0], time_now)
        if self._incidents is not None and self._e.ended == _GOES_ON:
            self._note_incidents()

    def _note_incidents(self) -> None:
        """Take down which instances have failed in the last step of the slice."""
        assert self._incidents is not None
        begin, end = (self._system.clock.time(k) for k in (max(self._e.k - 1, 0), self._e.k))
        for number, incident in enumerate(self._incidents):
            if incident.call and not self._plant.fmus.is_remote(number):  # they tell themselves
                self._plant.fmus.freeze(incident, end if incident.call in READING else begin)
            incident.call = 0
        self._e.halt = int(self._halted)

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
        n, agent = self._system.network.N, self._system.agent
        if self._plant.shows_states:
            first = self._plant.fmus.reading_at[:n, None] + agent.q
            return np.asarray(self._readings[k % 2, first + np.arange(agent.m)])
        return np.asarray(self._memory[k % 2, :n, : agent.m])

    def _diverged(self) -> tuple[str, str]:
        k, m = self._e.k, self._system.agent.m
        xhat = self._memory[k % 2, :-1, :m]
        size = np.maximum(np.abs(self._truth(k)).max(axis=1), np.abs(xhat).max(axis=1))
        names = self._system.network.names
        return diverged_reason(names, size, self._e.limit, self._system.clock.time(k))

    def _outcome(self, ended: Any, reason: str, agent: str) -> Outcome:
        n, m, k = self._system.network.N, self._system.agent.m, self._observed
        tracking = estimation = np.zeros(n)
        if k >= 0:
            here = self._memory[k % 2, :, :m]
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
            incidents=tuple(self._plant.failures),
        )


def _by_arc(weights: Any, receiver: Any) -> Array:
    """Weight of each arc from a matrix (N, arcs) that has it in the row of the receiver."""
    entries = weights.tocoo()
    if (entries.row != receiver[entries.col]).any():
        raise InputError("expected weights of what an agent hears itself (got those of others)")
    values = np.zeros(len(receiver))
    np.add.at(values, entries.col, entries.data)
    return values
