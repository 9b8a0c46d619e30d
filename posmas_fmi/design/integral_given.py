"""Proof of integral gains that are given: a search for the quadratic function alone."""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import product
from typing import Any

import attrs
import numpy as np

from posmas_fmi.agent import Agent
from posmas_fmi.certify import Loop
from posmas_fmi.certify.quadratic import (
    GraphScalar,
    SampledProof,
    Step,
    lipschitz_norm,
    prove_sampled,
)
from posmas_fmi.design.integral_gains import (
    IntegralDesign,
    augmented,
    halvings,
    nothing,
    prove,
)
from posmas_fmi.design.sampled import sampled_feedback, sampled_gain
from posmas_fmi.design.settings import DesignSettings
from posmas_fmi.design.solver import cvxpy, solve
from posmas_fmi.errors import DesignError
from posmas_fmi.expression import Array

_SHARES = (0.01, 0.05, 0.2, 0.5)  # of the graph scalar
_PARTS = (0.9, 0.7, 0.5, 0.3, 0.1)  # of the rate of the loop that is closed with the gain γ₀/2


def judged(
    agent: Agent,
    graphs: Iterable[GraphScalar],
    C_z: Array,
    K: Array,
    K_q: Array,
    settings: DesignSettings,
) -> IntegralDesign:
    """Find V for gains that are given, and prove the fastest rate of a few."""
    gain, last = np.hstack([settings.phi * K, K_q]), no_graph()
    for graph in graphs:
        last = graph
        search = Analysis.of(augmented(agent, C_z), gain, graph, lipschitz_norm(agent))
        if search is None:
            continue
        for part, share, theta in product(_PARTS, _SHARES, search.thetas):
            rate = float(f"{part * search.fastest:.3g}")
            V = search.solve(rate, share, theta)
            if V is not None:
                proof = prove(
                    agent, C_z, settings.phi, K, K_q, V, graph, theta * search.unit, rate, share
                )
                if proof.positive:
                    return IntegralDesign(K, K_q, V, rate, graph, proof)
    return IntegralDesign(K, K_q, np.eye(agent.m + len(C_z)), 0.0, last, nothing())


@attrs.frozen(eq=False)
class Analysis:
    """The search for V of given gains, in coordinates in which a first guess is the identity.

    The guess is ``unit·SᵀS``, of the loop that is closed with the gain γ₀/2: V has to be near.
    """

    A: Array
    B: Array
    H: Array
    K: Array
    S: Array
    unit: float
    graph: GraphScalar
    slope: Array
    fastest: float

    @classmethod
    def of(
        cls,
        system: tuple[Array, Array, Array],
        gain: Array,
        graph: GraphScalar,
        beta: float,
    ) -> Analysis | None:
        """Set the search up; None where the guess is unstable already."""
        from scipy.linalg import solve_continuous_lyapunov

        A, B, H = system
        closed = A + 0.5 * graph.value * B @ gain
        fastest = -float(np.linalg.eigvals(closed).real.max())
        if not fastest > 0 or not np.abs(gain).max() > 0:
            return None
        guess = solve_continuous_lyapunov(
            (closed + 0.9 * fastest * np.eye(len(A))).T, -np.eye(len(A))
        )
        S = np.linalg.cholesky(0.5 * (guess + guess.T)).T
        back = np.linalg.inv(S)
        K, B = gain @ back, S @ B
        unit = float(np.linalg.norm(K) / np.linalg.norm(B))
        slope = beta * math.sqrt(graph.spread) * (1 + 1e-6) * back.T[:, : H.shape[1]]
        return cls(
            S @ A @ back,
            B * math.sqrt(unit),
            S @ H,
            K / math.sqrt(unit),
            S,
            unit,
            graph,
            slope,
            fastest,
        )

    @property
    def thetas(self) -> tuple[float, ...]:
        """Multipliers of the Lipschitz bound to try."""
        if not self.slope.any():
            return (1.0,)
        middle = float(np.linalg.norm(self.slope) / np.linalg.norm(self.H))
        return tuple(middle * f for f in (0.3, 1.0, 3.0))

    def solve(self, rate: float, share: float, theta: float) -> Array | None:
        """V with the largest slack in the inequality of `feedback_matrix`, Δ and VH as blocks."""
        cp = cvxpy()
        A, B, H, K = self.A, self.B, self.H, self.K
        n, p, m = len(A), B.shape[1], H.shape[1]
        gamma, cost = self.graph.left(share)
        V, slack = cp.Variable((n, n), symmetric=True), cp.Variable()
        top = -(V @ A + A.T @ V) + gamma * K.T @ K - 2 * rate * V
        off = math.sqrt(cost) * (K + B.T @ V)
        rows = [[top, off.T], [off, np.eye(p)]]
        if self.slope.any():
            zero, one = np.zeros((p, m)), np.eye(m)
            rows = [
                [top, off.T, V @ H, self.slope],
                [off, np.eye(p), zero, zero],
                [H.T @ V, zero.T, one / theta, np.zeros((m, m))],
                [self.slope.T, zero.T, np.zeros((m, m)), theta * one],
            ]
        block = cp.bmat(rows)
        limits = [block >> slack * np.eye(block.shape[0]), V >> slack * np.eye(n), slack <= 1]
        program = cp.Problem(cp.Maximize(slack), limits)
        try:
            if not solve(program, "given gains") or V.value is None or slack.value <= 0:
                return None
        except DesignError:
            return None
        found = self.unit * self.S.T @ V.value @ self.S
        return np.asarray(0.5 * (found + found.T))


def as_designed(
    step: Step, gain: Any, graph: GraphScalar, loop: Loop, settings: DesignSettings
) -> SampledProof | None:
    """Prove given gains with the P of a design for one of the rates that are tried."""
    period, m = loop.period, loop.agent.m
    assert period is not None
    for rate in halvings(loop.agent):
        factor = math.exp(-rate * period)
        made = sampled_gain(step, graph, factor, 1.0, m, 15)
        if made is None:
            continue
        for share in (1e-3, 1e-2, 0.05, 0.2):
            proof = prove_sampled(
                step, gain, made[1].P, graph, factor, 1e-4 * (1 - factor**2), share
            )
            if proof is not None:
                return proof
    return None


def guessed(
    step: Step, exact: Any, graph: GraphScalar, loop: Loop, C_z: Array
) -> SampledProof | None:
    """Prove given gains in the sampled loop, near the P of the loop closed with the gain γ₀/2."""
    from scipy.linalg import solve_discrete_lyapunov

    gain = np.array(exact, dtype=float)
    closed = step.A + 0.5 * graph.value * step.B @ gain
    radius = float(np.abs(np.linalg.eigvals(closed)).max())
    if not 0 < radius < 1 or loop.period is None:
        return None
    scaled = (closed / radius**0.9).T
    guess = solve_discrete_lyapunov(scaled, np.eye(len(scaled)))
    guess = 0.5 * (guess + guess.T)
    unit = np.linalg.norm(gain) / np.linalg.norm(step.B.T @ guess @ step.A) * loop.period
    rate = -math.log(radius) / loop.period
    return sampled_feedback(loop, exact, guess * float(unit), graph, rate, C_z)


def no_graph() -> GraphScalar:
    """Graph scalar where none was found."""
    one = np.ones(1)
    return GraphScalar(0.0, "diagonal", one, one, nothing(), 1.0, 1.0, 1.0, 1.0)
