"""Centralised model-predictive control of a row: a reference that knows and commands everything.

It is no candidate for a plant: one computer gets every measurement at once and knows how the lines
share the header. What it reaches says how much is left for controllers that know less.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any

import attrs
import numpy as np
import scipy.sparse as sp

from posmas_fmi.cooling.control import EXTRAS
from posmas_fmi.cooling.line import LineParameters
from posmas_fmi.cooling.mapping import valve_mapping
from posmas_fmi.cooling.plant import FACILITY
from posmas_fmi.cosim.law import Decision, Heard, Weights
from posmas_fmi.design.solver import cvxpy, solve
from posmas_fmi.errors import DesignError, InputError
from posmas_fmi.expression import Array
from posmas_fmi.network import Network

MEMORY = 6  # estimate of θp, θr, θs; unexplained heat [K/s]; last valve position; 1 after the start
_OBSERVER = (0.02, 0.06, 0.08, 2e-4)  # 1/s, the last 1/s²: of the supply error, for 5 s to 15 s


def exponentials(M: Array) -> Array:
    """Exponentials of many small matrices (n, k, k): a series, scaled and squared.

    Examples
    --------
    >>> round(float(exponentials(np.array([[[-1.0]]]))[0, 0, 0]), 12)
    0.367879441171
    """
    size = float(np.abs(M).sum(axis=2).max(initial=0.0))
    halvings = max(0, math.ceil(math.log2(size)) + 1) if size > 0 else 0
    small = M / 2.0**halvings
    term = total = np.broadcast_to(np.eye(M.shape[1]), M.shape)
    for k in range(1, 15):  # the remainder is below 0.5**15/15!
        term = term @ small / k
        total = total + term
    for _ in range(halvings):
        total = total @ total
    return np.asarray(total)


@attrs.frozen
class Prediction:
    """What is predicted, and what it costs.

    Attributes
    ----------
    points : tuple of int
        Periods ahead at which temperatures count.
    moves : tuple of int
        Periods ahead at which valves may change; the first is 0.
    travel : float
        Cost of valve travel over that of deviations [K²].
    worst : float
        Cost of the worst deviation over that of all.
    """

    points: tuple[int, ...] = (4, 8, 12, 18, 24, 36)
    moves: tuple[int, ...] = (0, 4, 12)
    travel: float = 10.0
    worst: float = 4.0

    def __attrs_post_init__(self) -> None:
        for name in ("points", "moves"):
            value = getattr(self, name)
            if not value or list(value) != sorted(set(value)) or value[0] < 0:
                raise InputError(f"expected increasing whole numbers (got {value})", name)
        if self.moves[0] != 0 or self.moves[-1] >= self.points[-1] or self.points[0] < 1:
            raise InputError("expected moves from 0 on, all before the last point", "moves")
        if not (self.travel > 0 and self.worst >= 0):
            raise InputError("expected travel > 0 and worst >= 0", "prediction")


class PredictiveLaw:
    """Centralised predictive control; implements `posmas_fmi.cosim.law.Law`, for the numpy loop.

    At each communication point the lines are linearised at their estimates, with the header that
    they share, and one quadratic program over all valves is solved. It is compiled once.

    Parameters
    ----------
    line : LineParameters
        The nominal line.
    network : Network
        Its arcs carry nothing.
    size : (N,) array_like or float
        Nominal load of each line over that of the nominal line.
    shortage : float
        Shared part of the header's resistance, Rh.
    set_point : float, optional
        [K above the facility's nominal supply]; default the operating point's.
    prediction : Prediction, optional
    stroke_time : float
        Least time of a valve from closed to open [s].
    water : float
        Facility supply of θ = 0 [K].

    Examples
    --------
    >>> from posmas_fmi.network import network_from_arcs
    >>> law = PredictiveLaw(LineParameters(), network_from_arcs(2, [(1, 2), (2, 1)], [1]))
    >>> law.extras
    ('power', 'valve', 'water')
    """

    extras: tuple[str, ...] = EXTRAS

    def __init__(
        self,
        line: LineParameters,
        network: Network,
        size: Any = 1.0,
        shortage: float = 0.0,
        set_point: float | None = None,
        prediction: Prediction | None = None,
        stroke_time: float = 120.0,
        water: float = FACILITY,
    ) -> None:
        n = network.N
        self.line, self.shortage, self.water = line, shortage, water
        self.size = np.broadcast_to(np.asarray(size, dtype=float), (n,))
        self.set_point = line.theta_s0 if set_point is None else set_point
        self.prediction = Prediction() if prediction is None else prediction
        self.stroke_time = stroke_time
        self.valve = valve_mapping(line)
        none = sp.csr_array((n, network.adjacency.nnz))
        zero = np.zeros(n)
        self.weights = Weights(zero, none, zero, zero, none)
        self._nominal = float((self.size * line.kv(line.y0)).sum())

    # ---- the interface of a law -----------------------------------------------------------------

    def start(self, xhat0: Array) -> Array:
        """Return what is remembered at the start, (N, 6)."""
        memory = np.zeros((len(xhat0), MEMORY))
        memory[:, :3] = xhat0
        return memory

    def lead(self, s0: Array) -> Array:
        """Return the leader's state, which nothing depends on."""
        return np.concatenate([s0, np.zeros(MEMORY - 3)])

    def send(self, memory: Array, measured: Array) -> Array:
        """Return empty messages: what is centralised does not go over the network."""
        return np.zeros((len(memory), 1))

    def leader_message(self, memory: Array) -> Array:
        """Return an empty message."""
        return np.zeros(1)

    def leader_step(self, t: float, h: float, memory: Array) -> Array:
        """Return the leader's state unchanged."""
        return memory

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
        """Solve the program and apply its first move."""
        line, valve = self.line, self.valve
        y = np.clip(measured[:, 3], 0.0, 1.0)
        last = np.where(memory[:, 5] > 0, memory[:, 4], y)
        power, warm = measured[:, 2] / self.size, measured[:, 4] - self.water
        x, extra = memory[:, :3], memory[:, 3]
        header, by_valve = self.header(last)
        kappa = line.kappa(last, header)
        steps = self._steps(kappa, power, h)
        held = self._held(kappa, power, warm, extra)
        free = self._free(x, steps, held)
        reach = self._reach(x, warm, last, header, by_valve, steps)
        move = self._solve(free - self.set_point, reach, last, h)
        most = h / self.stroke_time
        wanted = np.clip(last + np.clip(move, -most, most), 0.0, 1.0)
        now, _ = self.header(y)
        real = line.kappa((y + wanted) / 2, now)
        error = measured[:, 1] - x[:, 2]
        at = self._steps(real, power, h)
        after = self._next(x, at, self._held(real, power, warm, extra))
        gain = np.array(_OBSERVER)
        after += h * error[:, None] * gain[:3]
        remembered = np.column_stack([after, extra + h * gain[3] * error, wanted, np.ones(len(x))])
        v = (valve.y0 - wanted) / valve.gain
        return Decision(v[:, None], ((line.kappa0 - kappa) * x[:, 1])[:, None], remembered)

    # ---- the model ------------------------------------------------------------------------------

    def header(self, y: Array) -> tuple[float, Array]:
        """Return the header pressure at valve positions (N,), and its slopes (N,)."""
        share = float((self.size * self.line.kv(y)).sum()) / self._nominal
        below = 1 + self.shortage * share**2
        h = (1 + self.shortage) / below
        slope = -h * 2 * self.shortage * share / below / self._nominal
        return h, slope * self.size * self.line.kv_slope(y)

    def _steps(self, kappa: Array, power: Array, h: float) -> Array:
        """Propagation over a period of each line, ``[e^{Ah}, Γ]``, (N, 3, 6)."""
        n = len(kappa)
        both = np.zeros((n, 6, 6))
        for i in range(n):
            both[i, :3, :3] = self.line.A(float(kappa[i]), float(power[i]))
        both[:, :3, 3:] = np.eye(3)
        return exponentials(h * both)[:, :3]

    def _held(self, kappa: Array, power: Array, warm: Array, extra: Array) -> Array:
        line = self.line
        held = np.zeros((len(kappa), 3))
        held[:, 0] = power * (1 - line.kl * line.theta_p0) / line.Cp
        held[:, 2] = kappa * warm / line.Cs + extra
        return held

    @staticmethod
    def _next(x: Array, steps: Array, held: Array) -> Array:
        return np.asarray(np.einsum("nij,nj->ni", steps, np.concatenate([x, held], axis=1)))

    def _free(self, x: Array, steps: Array, held: Array) -> Array:
        """Supply at the points if the valves stay, (N, points)."""
        found, points = [], self.prediction.points
        for k in range(1, points[-1] + 1):
            x = self._next(x, steps, held)
            if k in points:
                found.append(x[:, 2])
        return np.stack(found, axis=1)

    def _reach(
        self, x: Array, warm: Array, y: Array, header: float, by_valve: Array, steps: Array
    ) -> Array:
        """Supply at the points per move of each valve, (N points, N moves)."""
        line, points, moves = self.line, self.prediction.points, self.prediction.moves
        n = len(x)
        heat = np.zeros((n, 3))
        heat[:, 2] = -(x[:, 1] - warm) / line.Cs
        response = np.zeros((points[-1] + 1, n))
        state = np.zeros((n, 3))
        for k in range(1, points[-1] + 1):
            state = self._next(state, steps, heat)
            response[k] = state[:, 2]
        ends = (*moves[1:], points[-1])
        of_block = np.zeros((n, len(points), len(moves)))
        for b, (begin, end) in enumerate(zip(moves, ends, strict=True)):
            for k, point in enumerate(points):
                of_block[:, k, b] = response[max(point - begin, 0)]
                if b + 1 < len(moves):
                    of_block[:, k, b] -= response[max(point - end, 0)]
        small = 1e-4
        by_header = (line.kappa(y, header * (1 + small)) - line.kappa(y, header)) / (header * small)
        own = np.diag(line.kappa_slope(y, header)) + np.outer(by_header, by_valve)
        return np.asarray(np.einsum("ikb,ij->ikjb", of_block, own).reshape(n * len(points), -1))

    # ---- the program ----------------------------------------------------------------------------

    @cached_property
    def _program(self) -> dict[str, Any]:
        """The quadratic program with its parameters; compiled at its first solution."""
        cp = cvxpy()
        n, choice = len(self.size), self.prediction
        points, moves = len(choice.points), len(choice.moves)
        free = cp.Parameter(n * points)
        reach = cp.Parameter((n * points, n * moves))
        down, up = cp.Parameter((n, moves), nonneg=True), cp.Parameter((n, moves), nonneg=True)
        rate = cp.Parameter(moves, nonneg=True)
        z, worst = cp.Variable((n, moves)), cp.Variable()
        deviation = free + reach @ cp.reshape(z, (n * moves,), order="C")
        change = [z[:, b] - (z[:, b - 1] if b else 0) for b in range(moves)]
        cost = cp.sum_squares(deviation) / points + choice.worst * cp.square(worst)
        cost += choice.travel * sum(cp.sum_squares(c) for c in change)
        limits = [z >= -down, z <= up, deviation <= worst, deviation >= -worst]
        limits += [cp.abs(c) <= rate[b] for b, c in enumerate(change)]
        problem = cp.Problem(cp.Minimize(cost), limits)
        return {
            "problem": problem, "free": free, "reach": reach, "down": down, "up": up,
            "rate": rate, "z": z,
        }  # fmt: skip

    def _solve(self, free: Array, reach: Array, y: Array, h: float) -> Array:
        """Return the first move of each valve; none where there is no solution."""
        program, moves = self._program, self.prediction.moves
        ends = (*moves[1:], self.prediction.points[-1])
        program["free"].value, program["reach"].value = free.ravel(), reach
        program["down"].value = np.repeat(y[:, None], len(moves), axis=1)
        program["up"].value = np.repeat(1 - y[:, None], len(moves), axis=1)
        lengths = np.array([end - begin for begin, end in zip(moves, ends, strict=True)])
        program["rate"].value = lengths * h / self.stroke_time
        try:
            solved = solve(program["problem"], "predictive control")
        except DesignError:  # the solver broke down: the valves stay for a period
            solved = False
        z = program["z"].value
        if not solved or z is None or not math.isfinite(float(np.abs(z).max())):
            return np.zeros(len(y))
        return np.asarray(z[:, 0])
