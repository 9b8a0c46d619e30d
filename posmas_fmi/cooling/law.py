"""The cooling controllers in numpy, for all lines at once: what the C is tested against."""

from __future__ import annotations

import attrs
import numpy as np

from posmas_fmi.cooling.control import LAWS, Control, parameters
from posmas_fmi.cooling.exchanger import conductance
from posmas_fmi.cooling.line import LineParameters
from posmas_fmi.cooling.mapping import valve_mapping
from posmas_fmi.errors import InputError
from posmas_fmi.expression import Array

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
    pinned : (N,) array of bool
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
        np.asarray(np.asarray(pinned, bool) | control.everyone, float),
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
    power: Array
    last: Array
    mode: Array

    @classmethod
    def of(cls, rows: Array) -> Memory:
        """Read the rows of controller.h, (N, 9)."""
        return cls(rows[:, :3], *rows[:, 3:].T)

    def rows(self) -> Array:
        """Return the rows of controller.h, (N, 9)."""
        return np.column_stack(attrs.astuple(self, recurse=False))


def start_memory(xhat: Array, reference: float) -> Array:
    """Return what lines remember at the start, (N, 9)."""
    n = len(xhat)
    zero = np.zeros(n)
    return Memory(np.asarray(xhat), zero, zero, zero + reference, zero, zero, zero + START).rows()


def messages(control: Control, memory: Array, measured: Array) -> Array:
    """Return what each line sends, (N, 4): its estimate, and its supply or set-point."""
    shared = memory[:, 5] if control.law == "set_point" else measured[:, 1]
    return np.column_stack([memory[:, :3], shared])


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
    """

    def __init__(self, line: LineParameters, control: Control, own: Own, h: float) -> None:
        self.line, self.control, self.own, self.h = line, control, own, h
        self.valve = valve_mapping(line)
        self.values = parameters(line, control, h)

    def set_point(self, t: float) -> float:
        """Return the set-point at a time [K above the facility's nominal supply]."""
        v = self.values
        return float((v["set_before"] if t < v["set_at"][0] else v["set_after"])[0])

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
        power, water = measured[:, 2], measured[:, 4]
        load = np.where(np.isnan(power), 1.0, power / (self.own.size * line.P0)) - 1
        warm = np.where(np.isnan(water), 0.0, water - c["water0"][0])
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
        memory : (N, 9) array

        Returns
        -------
        (N, 1), (N, 1), (N, 9) ndarray
        """
        control, own, h, valve = self.control, self.own, self.h, self.valve
        was = Memory.of(memory)
        modes = self.modes(t, silence)
        starting = was.mode == START
        supply, power = measured[:, 1], measured[:, 2]
        low, high = (valve.y0 - own.high) / valve.gain, (valve.y0 - own.low) / valve.gain
        feedback = (valve.y0 - measured[:, 3]) / valve.gain
        known = ~np.isnan(feedback)
        last = np.where(starting, np.clip(np.where(known, feedback, 0.0), low, high), was.last)
        stuck = known & (np.abs(feedback - last) * valve.gain > control.tolerance)

        nominal = own.size * self.line.P0
        power = np.where(np.isnan(power), nominal, power)
        filtered = np.where(starting, power, was.power)
        filtered = filtered - np.expm1(-h / control.feedforward_time) * (power - filtered)
        p = filtered / nominal - 1
        f1, f2, f3 = self.values["ff"]
        forward = p * (f1 + p * (f2 + p * f3))

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
            filtered,
            v,
            modes.astype(float),
        )
        kappa = self._kappa(valve.y0 - valve.gain * v)
        applied = (self.line.kappa0 - kappa) * was.xhat[:, 1]
        return v[:, None], applied[:, None], after.rows()

    def leader_step(self, t: float, memory: Array) -> Array:
        """Return what the leader remembers next, (9,): the nominal line with a constant input."""
        c = self.values
        held = c["rest"] + [0.0, 0.0, c["lift"][0] * (self.set_point(t) - self.line.theta_s0)]
        after = np.zeros_like(memory)
        after[:3] = c["full"] @ memory[:3] + c["gamma"] @ held
        after[5] = self.set_point(t + self.h)
        return after
