"""The cooling controllers in numpy, for all lines at once: what the C is tested against."""

from __future__ import annotations

from typing import Any

import attrs
import numpy as np
import scipy.sparse as sp

from posmas_fmi.cooling.control import EXTRAS, LAWS, MEMORY, TEAM, Control, parameters, valve_curve
from posmas_fmi.cooling.exchanger import conductance
from posmas_fmi.cooling.line import LineParameters
from posmas_fmi.cooling.mapping import valve_mapping
from posmas_fmi.cooling.plant import FACILITY
from posmas_fmi.cosim.law import CompiledLaw, Decision, Heard, Weights
from posmas_fmi.cosim.native import Sources, engine_sources
from posmas_fmi.errors import InputError
from posmas_fmi.expression import Array
from posmas_fmi.network import Network

START, LAW, FALLBACK, MANUAL = range(4)  # modes
_NEVER = 1e12  # s


@attrs.frozen(eq=False)
class Own:
    """What differs from line to line, (N,) each.

    Attributes
    ----------
    size : array
        Nominal load over that of the nominal line.
    low, high : array
        Least and largest valve position.
    knows : array
        1 if the line knows the set-point.
    degree : array
        Sum of the weights of its arcs and of its pin.
    manual_from, manual_until, manual_valve : array
        When the valve is under manual control [s], and its position then.
    """

    size: Array
    low: Array
    high: Array
    knows: Array
    degree: Array
    manual_from: Array
    manual_until: Array
    manual_valve: Array

    def rows(self) -> Array:
        """Return them as ``own`` of controller.h, (N, 8)."""
        columns = attrs.astuple(self, recurse=False)
        return np.ascontiguousarray(np.stack([np.asarray(c, float) for c in columns], axis=1))


def own_values(control: Control, degree: Array, pinned: Array, size: Array | float = 1.0) -> Own:
    """Return what differs from line to line, without manual control.

    Parameters
    ----------
    control : Control
    degree : (N,) array
        Sum of the weights of arcs and pin.
    pinned : (N,) array
        Positive where the line hears the leader.
    size : (N,) array or float
        Nominal load over that of the nominal line.
    """
    n = len(degree)
    size = np.broadcast_to(np.asarray(size, dtype=float), (n,))
    if not (np.isfinite(size) & (size > 0)).all():
        raise InputError(f"expected sizes > 0 (got {size})", "size")
    whole = np.ones(n)
    return Own(
        size,
        control.opening[0] * whole,
        control.opening[1] * whole,
        np.asarray((pinned > 0) | control.everyone, dtype=float),
        np.asarray(degree, float),
        _NEVER * whole,
        _NEVER * whole,
        whole,
    )


@attrs.frozen(eq=False)
class Memory:
    """What a line remembers from one communication point to the next, (N, …) each."""

    xhat: Array
    integral: Array
    dew: Array
    reference: Array
    load: Array
    water: Array
    last: Array
    mode: Array

    @classmethod
    def of(cls, rows: Array) -> Memory:
        """Read the rows of controller.h, (N, 10)."""
        return cls(rows[:, :3], *rows[:, 3:].T)

    def rows(self) -> Array:
        """Return the rows of controller.h, (N, 10)."""
        return np.column_stack(attrs.astuple(self, recurse=False))


def start_memory(xhat: Array, reference: float) -> Array:
    """Return what lines remember at the start, (N, 10)."""
    n = len(xhat)
    zero = np.zeros(n)
    return Memory(
        np.asarray(xhat), zero, zero, zero + reference, zero, zero, zero, zero + START
    ).rows()


def messages(control: Control, memory: Array, measured: Array) -> Array:
    """Return what each line sends, (N, 4): its estimate, and its supply or set-point."""
    was = Memory.of(memory)
    shared = was.reference if control.law == "set_point" else measured[:, 1]
    return np.column_stack([was.xhat, shared])


class LineControllers:
    """The controllers of all lines, stated line by line in arrays.

    Parameters
    ----------
    line : LineParameters
        The nominal line.
    control : Control
    own : Own
    h : float
        Communication step [s].
    water : float
        Facility supply of θ = 0 [K].
    """

    def __init__(
        self,
        line: LineParameters,
        control: Control,
        own: Own,
        h: float,
        water: float = FACILITY,
    ) -> None:
        self.line, self.control, self.own, self.h = line, control, own, h
        self.valve = valve_mapping(line)
        self.values = parameters(line, control, h, water)

    def set_point(self, t: float) -> float:
        """Return the set-point at a time [K above the facility's nominal supply]."""
        v = self.values
        return float((v["set_before"] if t < v["set_at"][0] else v["set_after"])[0])

    def loads(self, measured: Array) -> Array:
        """Return IT powers over the nominal loads; 1 where it is not measured."""
        load = measured[:, 2] / (self.own.size * self.line.P0)
        return np.where(np.isnan(load), 1.0, load)

    def waters(self, measured: Array) -> Array:
        """Return θ of the facility water; 0 where it is not measured."""
        water = measured[:, 4] - self.values["water0"][0]
        return np.where(np.isnan(water), 0.0, water)

    def ahead(self, load: Array, water: Array) -> Array:
        """Return the v that holds the set-point at relative loads and water temperatures [W]."""
        if not self.control.feedforward:
            return np.zeros(len(load))
        kappa, v = valve_curve(self.line)
        supply = self.values["set_before"][0]
        power = np.clip(load, 0.0, self.values["load_most"][0]) * self.line.P0
        heat = self.line.released(power, supply)
        drop = supply + heat / self.line.ws - water
        enough = heat < kappa[-1] * drop
        wanted = np.where(enough, heat / np.where(enough, drop, 1.0), kappa[-1])
        return np.interp(wanted, kappa, v)

    def modes(self, t: float, silence: Array) -> Array:
        """Return the mode of each line, (N,)."""
        networked = LAWS[self.control.law] in (1, 2, 5)
        silent = networked & (silence[:, 0] > self.control.silence)
        manual = (t >= self.own.manual_from) & (t < self.own.manual_until)
        return np.where(manual, MANUAL, np.where(silent, FALLBACK, LAW))

    def wishes(
        self, modes: Array, t: float, supply: Array, disagreement: Array, reference: Array
    ) -> tuple[Array, Array, Array]:
        """Return the proportional part, the growth of the integral, and whether that acts."""
        control, own, s = self.control, self.own, self.set_point(t)
        n = len(supply)
        kp = control.kp / self.valve.gain
        fallback = modes == FALLBACK
        if control.law == "fixed":
            return np.zeros(n), np.zeros(n), np.ones(n, bool)
        if control.law == "local":
            error = np.where(own.knows > 0, supply - s, 0.0)
        elif control.law == "team":
            mean = supply - disagreement[:, 3] / (own.degree + 1)
            error = np.where(fallback, supply, mean) - s
        elif control.law == "set_point":
            error = supply - reference
        else:
            error = np.where(fallback, supply - reference, 0.0)
        proportional, growth = -kp * error, -kp / control.Ti * error
        acts = np.ones(n, bool)
        if control.law in ("proportional", "integral"):
            K_q = control.K_q if control.law == "integral" else 0.0
            proportional = np.where(fallback, proportional, disagreement[:, :3] @ control.K)
            growth = np.where(fallback, growth, K_q * disagreement[:, 3])
            acts = fallback | (control.law == "integral")
        return proportional, growth, acts

    def references(
        self, modes: Array, supply: Array, disagreement: Array, reference: Array
    ) -> Array:
        """Return the estimates of the set-point at the next communication point."""
        control, degree = self.control, self.own.degree
        shared = disagreement[:, 3]
        if control.law == "set_point":
            with np.errstate(divide="ignore"):
                rate = np.minimum(self.h * control.consensus, 1 / np.maximum(degree, 1e-9))
            return np.asarray(reference - rate * shared)
        listens = (modes != FALLBACK) & (degree > 0)
        agreed = supply - shared / np.where(degree > 0, degree, 1.0)
        share = -np.expm1(-self.h / control.reference_time)
        return np.where(listens, reference + share * (agreed - reference), reference)

    def estimates(self, x: Array, measured: Array, v: Array) -> Array:
        """Return the estimates at the next communication point, (N, 3)."""
        line, c = self.line, self.values
        load, warm = self.loads(measured) - 1, self.waters(measured)
        kappa = self._kappa(
            np.clip(self.valve.y0 - self.valve.gain * v, self.own.low, self.own.high)
        )
        held = np.zeros_like(x)
        held[:, 0] = load * line.P0 / line.Cp * (1 + line.kl * (x[:, 0] - line.theta_p0))
        held[:, 2] = (kappa * warm - (kappa - line.kappa0) * x[:, 1]) / line.Cs
        held += (measured[:, :2] - x[:, 1:]) @ self.control.E.T
        return np.asarray(x @ c["full"].T + (held + c["rest"]) @ c["gamma"].T)

    def _kappa(self, y: Array) -> Array:
        return conductance(self.line.UA, self.line.ws, self.line.wp(y))

    def step(
        self, t: float, measured: Array, disagreement: Array, silence: Array, memory: Array
    ) -> tuple[Array, Array, Array]:
        """Return v, sec(v) and what is remembered next; see controller.h.

        Parameters
        ----------
        t : float
            [s]
        measured : (N, 5) array
        disagreement : (N, 4) array
        silence : (N, 2) array
            Of the neighbours and the leader [s].
        memory : (N, 10) array

        Returns
        -------
        (N, 1), (N, 1), (N, 10) ndarray
        """
        control, own, h, valve = self.control, self.own, self.h, self.valve
        was = Memory.of(memory)
        modes = self.modes(t, silence)
        starting = was.mode == START
        supply = measured[:, 1]
        low, high = (valve.y0 - own.high) / valve.gain, (valve.y0 - own.low) / valve.gain
        feedback = (valve.y0 - measured[:, 3]) / valve.gain
        known = ~np.isnan(feedback)
        last = np.where(starting, np.clip(np.where(known, feedback, 0.0), low, high), was.last)
        stuck = known & (np.abs(feedback - last) * valve.gain > control.tolerance)

        share = -np.expm1(-h / self.values["ff_time"][0])
        load_now, water_now = self.loads(measured), self.waters(measured)
        load = np.where(starting, load_now, was.load)
        water = np.where(starting, water_now, was.water)
        load, water = load + share * (load_now - load), water + share * (water_now - water)
        forward = self.ahead(load, water)

        proportional, growth, acts = self.wishes(modes, t, supply, disagreement, was.reference)
        taken_over = (modes != was.mode) & (acts | ~starting)
        integral = np.where(taken_over, last - proportional - forward, was.integral)
        wanted = proportional + integral + forward

        kp = control.kp / valve.gain
        cold = self.values["floor"][0] - supply
        override = was.dew + kp * cold
        guarded = np.where(starting, wanted, np.maximum(wanted, override))
        by_hand = modes == MANUAL
        asked = np.where(by_hand, (valve.y0 - own.manual_valve) / valve.gain, guarded)
        most = h / control.stroke_time / valve.gain
        v = np.clip(np.clip(asked, last - most, last + most), low, high)

        real = np.where(stuck, feedback, v)
        share = min(h / control.tracking, 1.0)
        integral = np.where(
            by_hand,
            v - proportional - forward,
            np.where(acts, integral + h * growth + share * (real - wanted), integral * (1 - share)),
        )
        overridden = ~starting & (override > wanted) & ~by_hand
        dew = np.clip(was.dew + h * kp / control.Ti * cold, low, high)
        during = np.where(stuck, feedback, (np.where(known, feedback, v) + v) / 2)
        after = Memory(
            self.estimates(was.xhat, measured, during),
            integral,
            np.where(overridden, dew, v),
            self.references(modes, supply, disagreement, was.reference),
            load,
            water,
            v,
            modes.astype(float),
        )
        kappa = self._kappa(valve.y0 - valve.gain * v)
        applied = (self.line.kappa0 - kappa) * was.xhat[:, 1]
        return v[:, None], applied[:, None], after.rows()

    def leader_step(self, t: float, memory: Array) -> Array:
        """Return what the leader remembers next, (10,): the nominal line with a constant input."""
        c = self.values
        held = c["rest"] + [0.0, 0.0, c["lift"][0] * (self.set_point(t) - self.line.theta_s0)]
        after = np.zeros_like(memory)
        after[:3] = c["full"] @ memory[:3] + c["gamma"] @ held
        after[5] = self.set_point(t + self.h)
        return after


class CoolingLaw(CompiledLaw):
    """The cooling controllers as the master runs them; in C where it can, else as stated here.

    Parameters
    ----------
    line : LineParameters
        The nominal line.
    control : Control
    network : Network
        For the law "team" a complete digraph of each team, see `team_network`.
    size : (N,) array_like or float
        Nominal load of each line over that of the nominal line.
    own : Own, optional
        Instead of what follows from the arguments before.
    water : float
        Facility supply of θ = 0 [K].

    Examples
    --------
    >>> from posmas_fmi.cooling.control import controller
    >>> from posmas_fmi.network import network_from_arcs
    >>> pair = network_from_arcs(2, [(1, 2), (2, 1)], pinned=[1])
    >>> law = CoolingLaw(LineParameters(), controller("integral"), pair)
    >>> law.extras
    ('power', 'valve', 'water')
    """

    extras: tuple[str, ...] = EXTRAS

    def __init__(
        self,
        line: LineParameters,
        control: Control,
        network: Network,
        size: Any = 1.0,
        own: Own | None = None,
        water: float = FACILITY,
    ) -> None:
        self.line, self.control, self.water = line, control, water
        self.weights = _weights(network, control)
        degree = network.in_degree + np.where(control.law == "team", 0.0, network.pinning)
        self.own = own or own_values(control, degree, np.sign(network.pinning), size)
        self._stated: dict[float, LineControllers] = {}

    def at(self, h: float) -> LineControllers:
        """Return the controllers for a period [s]."""
        if h not in self._stated:
            self._stated[h] = LineControllers(self.line, self.control, self.own, h, self.water)
        return self._stated[h]

    def set_point(self, t: float) -> float:
        """Return the set-point at a time [K above the facility's nominal supply]."""
        return self.at(1.0).set_point(t)

    def sources(self) -> Sources:
        """Return the sources of the engine."""
        return engine_sources("cooling", "/* no functions of an agent are needed */\n")

    def members(self, h: float) -> dict[str, Array]:
        """Return the members of csrc/cooling/controller.h's structure."""
        values = self.at(h).values.items()
        return {name: value if value.size > 1 else value[0] for name, value in values}

    @property
    def own_values(self) -> Array:
        """What differs from line to line, (N, 8)."""
        return self.own.rows()

    def start(self, xhat0: Array) -> Array:
        """Return what the lines remember at the start."""
        return start_memory(xhat0, self.at(1.0).set_point(0.0))

    def lead(self, s0: Array) -> Array:
        """Return what the leader remembers at a state (3,); its set-point is that of t = 0."""
        memory = np.zeros(MEMORY)
        memory[:3], memory[5] = s0, self.at(1.0).set_point(0.0)
        return memory

    def send(self, memory: Array, measured: Array) -> Array:
        """Return the message of each line."""
        return messages(self.control, memory, measured)

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
        """Return the inputs of all lines; see `LineControllers.step`."""
        disagreement = weights.disagreement(sent, heard)
        return Decision(*self.at(h).step(t, measured, disagreement, heard.silence, memory))

    def leader_message(self, memory: Array) -> Array:
        """Return the leader's state and its set-point."""
        return np.append(memory[:3], memory[5])

    def leader_step(self, t: float, h: float, memory: Array) -> Array:
        """Return what the leader remembers next."""
        return self.at(h).leader_step(t, memory)


def _weights(network: Network, control: Control) -> Weights:
    """Weights of (6), with L + D, with L - D as printed, or with L alone for teams."""
    a, n = network.adjacency, network.N
    pin = {"printed": -1.0, "corrected": 1.0}[control.sign] * network.pinning
    if control.law == "team":
        pin = 0.0 * network.pinning
    by_arc = sp.csr_array((a.data, np.arange(a.nnz), a.indptr), shape=(n, a.nnz))
    none = sp.csr_array((n, a.nnz))
    return Weights(network.in_degree + pin, by_arc, pin, np.ones(n), none)


def team_network(lines: int, largest: int = TEAM) -> Network:
    """Return the digraph of teams of equal sizes: complete within each, nothing between them.

    Parameters
    ----------
    lines : int
    largest : int
        Lines in a team at most.

    Examples
    --------
    >>> team_network(40).adjacency.sum(axis=1)[:2]
    array([19., 19.])
    """
    teams = np.array_split(np.arange(lines), -(-lines // largest))
    blocks = sp.block_diag([np.ones((len(t), len(t))) - np.eye(len(t)) for t in teams])
    return Network(sp.csr_array(blocks), np.arange(lines) == 0)
