"""The master: the communication loop over plants, controllers and the channel."""

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
from posmas_fmi.cosim.conditions import Episode, Sensors, Timeline, rounded
from posmas_fmi.cosim.failure import Failure
from posmas_fmi.cosim.law import Heard, Law, Weights, columns
from posmas_fmi.cosim.plant import Plant
from posmas_fmi.cosim.snapshot import Snapshot, Snapshots
from posmas_fmi.cosim.wiring import Whole, Wiring
from posmas_fmi.errors import FmuCallError, FmuEndedError
from posmas_fmi.expression import Array
from posmas_fmi.interrupt import Interrupt
from posmas_fmi.network import Network

log = logging.getLogger(__name__)

Progress = Callable[[int, int], None]  # (steps done, steps in all)
Record = Callable[[float, dict[str, Array]], None]

# Beyond this multiple of the largest initial value a run is called diverged and ends.
DIVERGED = 1e4


@attrs.frozen
class Iteration:
    """When a repeated step is good enough.

    Attributes
    ----------
    tolerance : float
        Largest change of a reading, relative to its size or 1, that counts as none. Twice what
        a repetition of the first step with the same inputs differs by is added: not every FMU
        goes back exactly.
    most : int
        Repetitions of a step at most.
    """

    tolerance: float = 1e-8
    most: int = 100


@attrs.frozen(eq=False)
class System:
    """Definition of a co-simulation: everything but its state.

    Parameters
    ----------
    agent : Agent
        The model that observers and leader compute with.
    network : Network
    law : Law
        The controllers.
    channel : Channel
        Over the arcs of the network and then one arc from the leader to each pinned agent.
    clock : Clock
    xhat0 : (N, m) array
        Initial estimates.
    s0 : (m,) array
        Initial state of the leader.
    seed : int
        Of the random numbers of channel and sensors.
    wiring : Wiring, optional
        Of inputs that no controller sets; none by default.
    sensors : Sensors, optional
        Noise and resolution; exact by default.
    episodes : tuple of Episode
        What is otherwise for a time.
    leader_changes : tuple of (int, (m,) array)
        Communication points at which the leader jumps to another state.
    crashes : tuple of (int, int)
        Communication points at which the process of an instance, by its number, is killed.
    every : (instances,) array of int, optional
        Period of each instance and its controller, in communication steps; 1 by default.
    stages : tuple of arrays of int, optional
        Instances that step one after the other: those of a later stage are given the readings of
        earlier ones at the end of the step (Gauss-Seidel). All at once by default (Jacobi).
    iteration : Iteration, optional
        Repeat every step until the inputs that are wired fit the readings at its end.
    """

    agent: Agent
    network: Network
    law: Law
    channel: Channel
    clock: Clock
    xhat0: Array
    s0: Array
    seed: int = 0
    wiring: Wiring = attrs.field()
    sensors: Sensors | None = None
    episodes: tuple[Episode, ...] = ()
    leader_changes: tuple[tuple[int, Array], ...] = ()
    crashes: tuple[tuple[int, int], ...] = ()
    every: Whole = attrs.field()
    stages: tuple[Whole, ...] = attrs.field()
    iteration: Iteration | None = None

    @wiring.default
    def _no_wiring(self) -> Wiring:
        return Wiring.none(self.network.N)

    @every.default
    def _every_step(self) -> Whole:
        return np.ones(self.instances, dtype=np.int64)

    @stages.default
    def _one_stage(self) -> tuple[Whole, ...]:
        return (np.arange(self.instances),)

    @property
    def instances(self) -> int:
        """Number of plants, those that are no agents included."""
        return len(self.wiring.extras)

    @property
    def measured(self) -> int:
        """How many quantities an agent measures."""
        return self.agent.q + len(self.law.extras)

    @property
    def senders(self) -> Array:
        """Index of the agent that sends over each arc between agents."""
        return np.asarray(self.network.adjacency.indices)

    @property
    def timeline(self) -> Timeline:
        """The episodes, with what holds without them."""
        return Timeline(
            self.network.N, self.measured, self.agent.p, self.channel.loss, self.episodes
        )

    def next_change(self, k: int) -> int:
        """First communication point after k at which conditions or the leader change."""
        jumps = (point for point, _ in (*self.leader_changes, *self.crashes) if point > k)
        return min((self.timeline.next_change(k), *jumps))

    @property
    def noisy(self) -> bool:
        """Whether what is measured is ever noisy."""
        always = self.sensors is not None and bool(self.sensors.noise.any())
        return always or self.timeline.has("sensor_noise")

    def noise_at(self, begin: int, end: int) -> Array:
        """Noise of the sensors at the communication points begin … end - 1, (…, N, measured)."""
        shape, timeline = (self.network.N, self.measured), self.timeline
        zero = np.zeros(shape)
        sensors = Sensors(zero, zero) if self.sensors is None else self.sensors
        if not timeline.has("sensor_noise"):
            return sensors.noise_at(begin, end, self.seed)
        rows = [
            attrs.evolve(sensors, noise=sensors.noise + timeline.at(k).sensor_noise).noise_at(
                k, k + 1, self.seed
            )
            for k in range(begin, end)
        ]
        return np.concatenate(rows)

    def leader_at(self, k: int) -> Array | None:
        """State to which the leader jumps at communication point k, if it does."""
        return next((s for point, s in self.leader_changes if point == k), None)

    def weights_with(self, arc_off: Array) -> Weights:
        """Weights of the controllers where some arcs, numbered as in the channel, are missing."""
        if not arc_off.any():
            return self.law.weights
        arcs = self.network.adjacency.nnz
        from_leader = np.zeros(self.network.N)
        from_leader[list(self.network.pinned)] = arc_off[arcs:]
        return self.law.weights.without(np.concatenate([arc_off[:arcs], from_leader]) > 0)


@attrs.define(eq=False)
class State:
    """All state of a run outside the plants.

    Attributes
    ----------
    k : int
        Communication steps done.
    memory : (N, …) array
        What the controllers remember; the estimates come first.
    leader : (…) array
        What the leader remembers.
    mailbox : Mailbox
    readings : array
        Of all instances at k.
    measured : (N, measured) array
    pending : (N, …) array
        What agents with a longer period will remember at its end.
    u, applied, actuated : (N, p) array
        Last input, what the controller takes it for, and what the actuator makes of it.
    inputs : array
        Of all instances, held over their present step.
    """

    k: int
    memory: Array
    leader: Array
    mailbox: Mailbox
    readings: Array
    measured: Array
    pending: Array
    u: Array
    applied: Array
    actuated: Array
    inputs: Array


@attrs.frozen(eq=False)
class Outcome:
    """How a run ended.

    Attributes
    ----------
    ended : {"complete", "terminated", "diverged", "failed", "cancelled"}
        Terminated: an FMU asked for the end.
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
    failed_agent : str
        Or that whose FMU asked for the end.
    incidents : tuple of Failure
        FMUs that failed, and what was done about it.
    replay_noise : float or None
        What a step that was done again differed by, relative to the size of a reading or 1; None
        where none was.
    unsettled : int
        Steps in which the iteration of coupled FMUs did not settle.
    """

    ended: Literal["complete", "terminated", "diverged", "failed", "cancelled"]
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
    incidents: tuple[Failure, ...] = ()
    replay_noise: float | None = None
    unsettled: int = 0


def simulate(
    system: System,
    plant: Plant,
    record: Record | None = None,
    progress: Progress | None = None,
    snapshots: Snapshots | None = None,
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
        Gets the time [s] and the arrays ``x, xhat, u, sec_u, y, s, measured, extra`` at every
        communication point.
    progress : callable, optional
        Gets the number of steps done and in all.
    snapshots : Snapshots, optional
        What to do with snapshots, and which one the run must come to: it begins at the start in
        any case, for controllers of one's own cannot be saved.

    Returns
    -------
    Outcome
        Also where the run diverged, an FMU failed, or it was interrupted: what was recorded
        before stays.
    """
    return Run(system, plant, record, progress, snapshots or Snapshots()).run()


class _Stop(Exception):  # noqa: N818  (ends the loop; no error)
    def __init__(self, ended: Any, reason: str, agent: str = "") -> None:
        self.ended, self.reason, self.agent = ended, reason, agent


class Run:
    """One pass through the loop, with the figures that the outcome needs.

    Parameters
    ----------
    system, plant, record, progress, snapshots
        As for `simulate`.
    """

    def __init__(
        self,
        system: System,
        plant: Plant,
        record: Record | None,
        progress: Progress | None,
        snapshots: Snapshots,
    ) -> None:
        self.snapshots = snapshots
        self.system, self.plant = system, plant
        self.record, self.progress = record, progress
        network, agent, law = system.network, system.agent, system.law
        N = network.N
        # what stays the same is worked out here, once
        self.pinned = np.array(network.pinned, dtype=int)
        self.arcs = network.adjacency.nnz
        self.receivers = np.repeat(np.arange(N), np.diff(network.adjacency.indptr))
        self.timeline = system.timeline
        self.jumps = dict(reversed(system.leader_changes))
        self.change = 0  # the communication point at which conditions change next
        self.always_draws = self.timeline.has("loss")
        self.at_once = system.channel.ideal and not self.always_draws  # messages arrive
        self.held: Any = system.senders if self.at_once else np.arange(self.arcs)
        self.no_silence = np.zeros((N, 2))
        shown = agent.q + (agent.m if plant.shows_states else 0)
        self.table_of = _taker(plant.reading_at[: N + 1], shown)
        self.y = np.zeros((N, agent.q))  # at k, and the states if they are shown
        self.x: Array | None = None
        self.u_at = plant.input_at[:N, None] + np.arange(agent.p)
        is_u = np.zeros(plant.input_at[-1], dtype=bool)
        is_u[self.u_at] = True
        self.extra_at = np.flatnonzero(~is_u)
        self.lengths = system.clock.times(system.every)  # of the steps [s]
        self.everyone = np.arange(system.instances)
        self.begins = np.zeros(system.instances)  # of their steps, where all take them at once
        self.in_step = bool((system.every == 1).all())  # every period is one communication step
        self.all_act = self.in_step  # and none is frozen
        of_agents = system.every[:N]
        self.periods = [(int(period), of_agents == period) for period in np.unique(of_agents)]
        self.recorded = np.array(system.wiring.recorded, dtype=np.int64)
        memory = law.start(system.xhat0)
        leader = law.lead(system.s0)
        self.width = len(law.leader_message(leader))
        empty = np.zeros((self.arcs + len(self.pinned), self.width))
        random = np.random.default_rng(system.seed)
        self.state = State(
            k=0,
            memory=memory,
            leader=leader,
            mailbox=Mailbox(system.channel, empty, random),
            readings=np.zeros(plant.reading_at[-1]),
            measured=np.zeros((N, system.measured)),
            pending=memory.copy(),
            u=np.zeros((N, agent.p)),
            applied=np.zeros((N, agent.p)),
            actuated=np.zeros((N, agent.p)),
            inputs=np.zeros(plant.input_at[-1]),
        )
        self.drive = np.zeros(0)  # the exogenous signals at k
        self.before: Array | None = None  # readings at k - 1
        self.ahead = np.zeros(plant.reading_at[-1], dtype=bool)  # known (or guessed) at k + 1
        self.conditions = self.timeline.at(0)
        self.exact_sensors = self.exact_actuators = True
        self.weights = self._weights()
        self.leads: Array | None = None  # what the leader remembers next, where it is known
        self.largest_initial = 0.0
        self.min_state = np.full(N, np.inf)
        self.min_time = np.zeros(N)
        self.seen: tuple[Array, Array, Array] | None = None  # x, the estimates and s
        self.limit = np.inf
        self.noisy = system.noisy
        self.replay_noise = 0.0  # of a reading, relative to its size or 1
        self.unsettled = 0  # steps

    def run(self) -> Outcome:
        """Run to the end."""
        ended: Any = "complete"
        reason = agent = ""
        try:
            with (
                np.errstate(invalid="ignore", over="ignore"),  # running away is a verdict
                Interrupt() as interrupt,
            ):
                self.plant.obey(interrupt)
                self._loop(interrupt)
        except _Stop as stop:
            ended, reason, agent = stop.ended, stop.reason, stop.agent
        except FmuEndedError as error:
            ended, reason, agent = "terminated", str(error), error.agent
        except FmuCallError as error:
            ended, reason, agent = "failed", str(error), error.agent
        except KeyboardInterrupt:
            ended, reason = "cancelled", "interrupted"
        state, zero = self.state, np.zeros(self.system.network.N)
        tracking, estimation = (zero, zero) if self.seen is None else errors_at(*self.seen)
        return Outcome(
            ended=ended,
            steps=state.k,
            time=self.system.clock.time(state.k),
            tracking_error=tracking,
            estimation_error=estimation,
            largest_initial=self.largest_initial,
            min_state=self.min_state,
            min_time=self.min_time,
            messages=state.mailbox.sent,
            lost=state.mailbox.lost,
            reason=reason,
            failed_agent=agent,
            incidents=tuple(self.plant.failures),
            replay_noise=None if self.system.iteration is None else self.replay_noise,
            unsettled=self.unsettled,
        )

    def _loop(self, interrupt: Interrupt) -> None:
        clock, system, state = self.system.clock, self.system, self.state
        begins = self.everyone
        self.plant.read(begins, 0.0, state.readings)
        for k in range(clock.steps + 1):
            t = clock.time(k)
            self._change_conditions(k)
            self._measure(k, begins)
            sent = system.law.send(state.memory, state.measured)
            if system.channel.resolution:
                sent = rounded(sent, system.channel.resolution)
            heard = self._exchange(k, sent)
            self._control(t, k, sent, heard)
            self._observe(t)
            if k == clock.steps:
                break
            self._step(k)
            self._remember(t, k)
            state.k = k + 1
            self._keep_snapshot()
            if not self.all_act:
                begins = np.flatnonzero(((k + 1) % system.every == 0) & ~self.plant.frozen)
            self.plant.checkpoint()
            interrupt.check()
            if self.progress is not None:
                self.progress(state.k, clock.steps)

    def _keep_snapshot(self) -> None:
        """Hand over a snapshot if it is time, and see that the run comes to that it begins with."""
        k, snapshots, state = self.state.k, self.snapshots, self.state
        start = snapshots.start
        arrives = start is not None and k == start.k
        due = snapshots.every and k % snapshots.every == 0 and (start is None or k > start.k)
        if not (arrives or due):
            return
        arrays = {
            "loop_memory": np.array(state.memory),
            "loop_leader": np.array(state.leader),
            "loop_readings": state.readings.copy(),
            "loop_inputs": state.inputs.copy(),
        }
        if arrives:
            snapshots.compare(arrays)
        if due:
            snapshots.keep(Snapshot(k, arrays, {}, None))

    def _change_conditions(self, k: int) -> None:
        system, state = self.system, self.state
        if system.wiring.drive.columns:
            self.drive = system.wiring.drive.rows(k, k + 1)[0]
        if k == self.change:
            self.conditions = self.timeline.at(k)
            self.exact_sensors = self.conditions.exact_sensors
            self.exact_actuators = self.conditions.exact_actuators
            self.weights = self._weights()
            self.change = self.timeline.next_change(k)
        if k in self.jumps:
            state.leader = system.law.lead(self.jumps[k])
        for point, number in system.crashes:
            if point == k:
                self.plant.crash(number)

    def _weights(self) -> Weights:
        weights = self.system.weights_with(self.conditions.arc_off)
        if self.at_once:
            return weights.arriving(self.system.senders, self.width)
        return weights

    def _measure(self, k: int, begins: Whole) -> None:
        """Measure y, then the rest, through the sensors."""
        system, state, sensors = self.system, self.state, self.system.sensors
        table, q = self.table_of(state.readings), system.agent.q
        self.y, self.x = table[:q].T, table[q:].T if self.plant.shows_states else None
        value = self.y
        if system.law.extras:
            rest = system.wiring.take(system.wiring.measured, state.readings, self.drive)
            value = np.concatenate([value, rest], axis=1)
        if not self.exact_sensors:
            value = value + self.conditions.sensor_offset
        if self.noisy:
            value = value + system.noise_at(k, k + 1)[0]
        if sensors is not None:
            value = rounded(value, sensors.resolution)
        if k > 0 and not self.exact_sensors:
            gain = self.conditions.sensor_gain
            follows = state.measured + gain * (value - state.measured)
            value = np.where(gain == 1.0, value, follows)
        if len(begins) == system.instances:
            state.measured = value
            return
        agents = begins[begins < system.network.N]
        state.measured = state.measured.copy()
        state.measured[agents] = value[agents]

    def _exchange(self, k: int, sent: Array) -> Heard:
        """Send over every arc and from the leader to the pinned; return what is now held."""
        state, N, width = self.state, self.system.network.N, sent.shape[1]
        mailbox, pinned = self.state.mailbox, self.pinned
        from_leader = self.system.law.leader_message(state.leader)
        if self.at_once:
            mailbox.sent += self.arcs + len(pinned)
            pool = columns(N + 1, width)
            pool[:N], pool[N] = sent, from_leader
            return Heard(pool, self.held, pool[N:], pinned, self.no_silence)
        silence = np.zeros((N, 2))
        message = np.concatenate(
            [sent[self.system.senders], np.tile(from_leader, (len(self.pinned), 1))]
        )
        if k == 0:
            mailbox.held = message
        received = mailbox.exchange(k, message, self.conditions.loss if self.always_draws else None)
        age = self.system.clock.times(mailbox.age(k))
        np.maximum.at(silence[:, 0], self.receivers, age[: self.arcs])
        silence[pinned, 1] = age[self.arcs :]
        return Heard(received[: self.arcs], self.held, received[self.arcs :], pinned, silence)

    def _control(self, t: float, k: int, sent: Array, heard: Heard) -> None:
        """Let the controllers decide whose period begins; the others' inputs stay."""
        system, state = self.system, self.state
        for period, of_period in self.periods:
            mine = of_period if self.all_act else of_period & ~self.plant.frozen[: len(sent)]
            if k % period or not (self.all_act or mine.any()):
                continue
            h = system.clock.time(period)
            decision = system.law.step(
                t, h, state.measured, sent, heard, state.memory, self.weights, state.leader
            )
            if period == 1:
                self.leads = decision.leader
            actuated = decision.u
            if k > 0 and not self.exact_actuators:
                gain = self.conditions.actuator_gain
                follows = state.actuated + gain * (decision.u - state.actuated)
                actuated = np.where(gain == 1.0, decision.u, follows)
            if self.all_act:
                state.u, state.applied, state.actuated = decision.u, decision.applied, actuated
                state.pending = decision.memory
                continue
            state.u = _merged(mine, decision.u, state.u)
            state.applied = _merged(mine, decision.applied, state.applied)
            state.pending = _merged(mine, decision.memory, state.pending)
            state.actuated = _merged(mine, actuated, state.actuated)

    def _step(self, k: int) -> None:
        """Set the inputs of the instances whose step begins; step those whose step ends."""
        before = self.state.readings
        self._take_step(k)
        self.before = before

    def _take_step(self, k: int) -> None:
        system, state = self.system, self.state
        if system.iteration is None:
            state.readings = self._step_once(k, state.readings.copy())
            return
        saved = self.plant.save(np.arange(system.instances))
        latest = self._step_once(k, state.readings.copy())
        if k == 0:
            latest = self._measure_noise(saved, latest)
        tolerance = system.iteration.tolerance + 2 * self.replay_noise
        # readings at the end of the step are guesses until the inputs made of them confirm them
        for _ in range(system.iteration.most):
            self.plant.restore(saved)
            guess, latest = latest, self._step_once(k, latest.copy(), guessed=True)
            change = _change(latest, guess)
            if change <= tolerance:
                break
        else:
            if not self.unsettled:
                log.warning(
                    "the coupling did not settle at t = %g s: readings still change by %.2g",
                    system.clock.time(k),
                    change,
                )
            self.unsettled += 1
        state.readings = latest

    def _measure_noise(self, saved: Any, latest: Array) -> Array:
        """Do the first step again as it was; what differs is no fault of the coupling."""
        self.plant.restore(saved)
        again = self._step_once(0, self.state.readings.copy())
        self.replay_noise = _change(again, latest)
        if self.replay_noise:
            log.info(
                "repeated steps are not exact: replays differ by %.2g, which the tolerance of the "
                "coupling makes room for",
                self.replay_noise,
            )
        return again

    def _step_once(self, k: int, latest: Array, guessed: bool = False) -> Array:
        """Step stage after stage; inputs are made of `latest`, which is brought up to date."""
        system, state, clock = self.system, self.state, self.system.clock
        extrapolates = system.wiring.extrapolates
        if extrapolates:
            self.ahead[:] = guessed
        for stage in system.stages:
            begins = ends = stage
            if not self.all_act:
                alive = stage[~self.plant.frozen[stage]]
                begins = alive[k % system.every[alive] == 0]
                ends = alive[(k + 1) % system.every[alive] == 0]
            self._set_inputs(begins, latest)
            if not len(ends):
                continue
            if self.in_step:
                t = self.begins[: len(ends)]
                t.fill(clock.time(k))
            else:
                t = clock.times(k + 1 - system.every[ends])
            lengths = self.lengths if len(ends) == len(self.lengths) else self.lengths[ends]
            self.plant.step(ends, t, lengths, state.inputs, latest)
            state.k = k + 1  # a reading that fails belongs to the next point
            self.all_act = self.in_step and not self.plant.frozen.any()
            if not self.all_act:
                ends = ends[~self.plant.frozen[ends]]  # some may have failed in this very step
            self.plant.read(ends, clock.time(k + 1), latest)
            state.k = k
            if extrapolates:
                for i in ends:
                    self.ahead[self.plant.reading_at[i] : self.plant.reading_at[i + 1]] = True
        return latest

    def _set_inputs(self, which: Whole, readings: Array) -> None:
        state, at = self.state, self.plant.input_at
        if not len(self.extra_at) and len(which) == len(at) - 1:
            state.inputs = np.ascontiguousarray(state.actuated).ravel()
            return
        values = np.empty(at[-1])
        values[self.u_at] = state.actuated
        values[self.extra_at] = self._extra_inputs(readings)
        chosen = np.zeros(len(at) - 1, dtype=bool)
        chosen[which] = True
        mine = np.repeat(chosen, np.diff(at))
        state.inputs = np.where(mine, values, state.inputs)

    def _extra_inputs(self, latest: Array) -> Array:
        wiring, begin = self.system.wiring, self.state.readings
        if not wiring.extrapolates:
            return wiring.inputs(latest, self.drive)
        # over the step where its end is known, else as over the one before
        before = begin if self.before is None else self.before
        change = np.where(self.ahead, latest - begin, begin - before)
        return wiring.inputs(latest, self.drive, begin, change / self.system.clock.h)

    def _remember(self, t: float, k: int) -> None:
        state, system = self.state, self.system
        if self.all_act:
            state.memory = state.pending
        else:
            N = system.network.N
            ends = ((k + 1) % system.every[:N] == 0) & ~self.plant.frozen[:N]
            state.memory = _merged(ends, state.pending, state.memory)
        if self.leads is None:
            self.leads = system.law.leader_step(t, system.clock.h, state.leader)
        state.leader, self.leads = self.leads, None

    def _observe(self, t: float) -> None:
        """Record, and keep the figures of the outcome."""
        state, m = self.state, self.system.agent.m
        x, xhat, s = self.x, state.memory[:, :m], state.leader[:m]
        if self.record is not None:
            row = {"xhat": xhat, "u": state.u, "sec_u": state.applied, "y": self.y, "s": s}
            if x is not None:
                row["x"] = x
            row["measured"] = state.measured
            row["extra"] = self.system.wiring.take(self.recorded, state.readings, self.drive)
            self.record(t, row)
        truth = xhat if x is None else x
        self.seen = truth, xhat, s
        if state.k == 0:
            self.largest_initial = float(np.abs(truth - s).max())
            scale = max(np.abs(truth).max(), np.abs(s).max(), np.abs(xhat).max(), 1.0)
            self.limit = DIVERGED * float(scale)
        lowest = reduce(np.minimum, truth.T)
        np.putmask(self.min_time, lowest < self.min_state, t)
        np.fmin(self.min_state, lowest, out=self.min_state)  # NaN is no smaller
        if not (_is_within(truth, self.limit) and _is_within(xhat, self.limit)):
            self._diverged(t, np.maximum(_largest(truth), _largest(xhat)))

    def _diverged(self, t: float, size: Array) -> NoReturn:
        name, reason = diverged_reason(self.system.network.names, size, self.limit, t)
        raise _Stop("diverged", reason, name)


def errors_at(truth: Array, xhat: Array, s: Array) -> tuple[Array, Array]:
    """Largest modulus over the states of tracking and of estimation error, (N,) each."""
    with np.errstate(invalid="ignore", over="ignore"):
        return _largest(truth - s), _largest(truth - xhat)


def _change(a: Array, b: Array) -> float:
    """Largest difference, relative to the size of a value or 1."""
    return float((np.abs(a - b) / np.maximum(1.0, np.abs(a))).max(initial=0.0))


def _largest(X: Array) -> Array:
    """Largest modulus in each row, (N,); column by column, for rows are short and many."""
    return np.asarray(reduce(np.maximum, np.abs(X).T))


def _is_within(X: Array, limit: float) -> bool:
    """Whether no modulus is beyond the limit; NaN is. The sum of squares, if small, says it."""
    rows = X.T  # in one piece: read in order
    return bool(np.vdot(rows, rows) <= limit * limit or np.abs(rows).max() <= limit)


def _merged(chosen: Any, new: Array, old: Array) -> Array:
    """Rows of the new array where they are chosen, else of the old one."""
    return new if chosen.all() else np.where(chosen[:, None], new, old)


def _taker(starts: Whole, count: int) -> Callable[[Array], Array]:
    """Return a function that takes the first values of each agent, (count, N), from those of all.

    Agents with equally many values are the rows of a matrix. What it gives has a column for each
    agent: rows are few and long, and all that follows is done row by row.
    """
    widths = np.diff(starts)
    N, width = len(widths), int(widths[0])
    if (widths == width).all() and starts[0] == 0:
        return lambda values: values[: N * width].reshape(N, width).T[:count].copy()
    places = starts[:-1] + np.arange(count)[:, None]
    return lambda values: values[places]


def diverged_reason(names: Sequence[str], size: Array, limit: float, t: float) -> tuple[str, str]:
    """Name of the agent that is furthest beyond the limit, and the reason for the outcome."""
    worst = int(np.nanargmax(np.where(np.isfinite(size), size, np.inf)))
    name = names[worst]
    return name, f"agent {name} passed {limit:.3g} at t = {t:.6g} s; the run ends there"
