"""Sampled propagation of x' = A x + H g(t, x) + w with w held: the observer's and leader's step."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import attrs
import numpy as np
import scipy.linalg

from posmas_fmi.agent import Agent
from posmas_fmi.expression import Array


@attrs.frozen(eq=False, slots=False)
class Propagator:
    """One communication step of ``x' = A x + H g(t, x) + w`` for many agents at once.

    The linear part and the held input are exact (matrix exponential); g is integrated by the
    exponential Runge-Kutta method ETDRK4 of Cox and Matthews (J. Comput. Phys. 176, 2002), fourth
    order in h and exact where g is constant. So the observer follows the same flow as the plant,
    as certificate T assumes, up to an error of order h⁵ per step.

    Parameters
    ----------
    agent : Agent
    h : float
        Communication step [s].

    Examples
    --------
    >>> from posmas_fmi.agent import linear_agent
    >>> step = Propagator.of(linear_agent([[-1.0]], [[1.0]], [[1.0]]), h=0.5)
    >>> step(0.0, np.array([[1.0]]), np.array([[2.0]])).round(6)  # 2 - exp(-0.5)
    array([[1.393469]])
    """

    h: float
    H: Array
    g: Callable[[float, Array, Array], None]  # g(t, X, out), a column per agent
    full: Array  # e^{Ah}
    half: Array  # e^{Ah/2}
    gamma: Array  # ∫₀ʰ e^{Aτ} dτ
    half_gamma: Array
    start: Array  # ETDRK4 weights of g at the start, the two middles and the end
    middle: Array
    end: Array

    @classmethod
    def of(cls, agent: Agent, h: float) -> Propagator:
        """Precompute the matrices for one agent model and step."""
        phi0, phi1, phi2, phi3 = _phi_functions(agent.A * h)
        half0, half1, _, _ = _phi_functions(agent.A * (0.5 * h))
        return cls(
            h=h,
            H=agent.H,
            g=agent.g_columns,
            full=phi0,
            half=half0,
            gamma=h * phi1,
            half_gamma=0.5 * h * half1,
            start=h * (phi1 - 3.0 * phi2 + 4.0 * phi3),
            middle=h * (2.0 * phi2 - 4.0 * phi3),
            end=h * (4.0 * phi3 - phi2),
        )

    @cached_property
    def weights_of_g(self) -> tuple[Array, ...]:
        """With H in them: over half a step, then at the start, the middle and the end of a step."""
        return tuple(W @ self.H for W in (self.half_gamma, self.start, self.middle, self.end))

    @cached_property
    def stages(self) -> tuple[Array, Array, Array, Array]:
        """Matrices of the stages a, b, c and of the end, (m, 3m) to (m, 6m).

        Each is a linear combination of the columns of x, w and of g at x, a, b and c.
        """
        A, G, zero = self.half, self.half_gamma, np.zeros_like(self.half)
        GH, start, middle, end = self.weights_of_g
        base = [A, G]
        a = np.hstack([*base, GH])
        b = np.hstack([*base, zero, GH])
        # A a + G (2 H g(b) - H g(x) + w)
        c = np.hstack([A @ A, A @ G + G, A @ GH - GH, zero, 2.0 * GH])
        return a, b, c, np.hstack([self.full, self.gamma, start, middle, middle, end])

    @property
    def in_c(self) -> dict[str, Array]:
        """The matrices (m, m) of csrc/protocol/controller.h by name, in order."""
        half_g, start_g, middle_g, end_g = self.weights_of_g
        return {
            "full": self.full,
            "half": self.half,
            "gamma": self.gamma,
            "half_gamma": self.half_gamma,
            "half_g": half_g,
            "twice_half_g": 2.0 * half_g,
            "start_g": start_g,
            "middle_g": middle_g,
            "end_g": end_g,
        }

    def __call__(self, t: float, X: Array, W: Array) -> Array:
        """Propagate the rows of X (N, m) from t to t + h with inputs W (N, m) held."""
        m = X.shape[1]
        known = self.room(len(X))
        known[:m], known[m : 2 * m] = X.T, W.T
        return self.advance(t, known).T

    def room(self, N: int) -> Array:
        """Room for what `advance` knows of N agents, a column each: x and w (to be set), then g."""
        return np.empty((6 * len(self.H), N))

    def advance(self, t: float, known: Array) -> Array:
        """Return the states (m, N) at t + h, a column per agent; see `room`.

        Products of a small matrix and a wide one are the fast ones.
        """
        m, half = len(self.H), 0.5 * self.h
        x = known[:m]
        for k, (time, stage) in enumerate(
            zip((t, t + half, t + half, t + self.h), self.stages, strict=True), start=2
        ):
            self.g(time, x, known[k * m : (k + 1) * m])
            x = np.dot(stage, known[: (k + 1) * m])
        return x


def _phi_functions(M: Array) -> tuple[Array, Array, Array, Array]:
    """φ₀…φ₃ of a matrix, φ₀ = e^M, φ_k = (φ_{k-1} - I/(k-1)!) / M, without the division."""
    m = len(M)
    augmented = np.zeros((4 * m, 4 * m))
    augmented[:m, :m] = M
    for k in range(3):  # e^[[M, I, 0], [0, 0, I], …] holds the φ functions in its first row
        augmented[k * m : (k + 1) * m, (k + 1) * m : (k + 2) * m] = np.eye(m)
    first_row = scipy.linalg.expm(augmented)[:m]
    phi0, phi1, phi2, phi3 = (first_row[:, k * m : (k + 1) * m] for k in range(4))
    return phi0, phi1, phi2, phi3
