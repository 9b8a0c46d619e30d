"""The linear program behind a contraction design: one feedback, its gain for fixed weights v.

Unknown is the gain X ≥ 0 or free with ``N = left X right`` (``B|K|`` or ``EC``). Certificates P and
T (or C) are linear in X and in the bound r of the contraction. For the gain found, the Perron
vector of the contraction matrix is a better v: `alternate` goes back and forth.
"""

from __future__ import annotations

from typing import Literal

import attrs
import numpy as np

from posmas_fmi.certify.contraction import perron_vector
from posmas_fmi.expression import Array

_INSTANTS = 8  # of the period at which signs are asked for; the certificate proves all of it
_ROUNDS = 30
_FASTEST = 20.0  # continuous feedback of a state on itself, in units of the fastest diagonal of A
Goal = Literal["fast", "small", "tolerant", "band"]


@attrs.frozen(eq=False)
class Problem:
    """Data of one feedback in plain floating point.

    Attributes
    ----------
    A_low, A_high : (m, m) array
        Bounds of ``A + H G(t)``.
    floor : (m, m) array
        What ``strong·N`` must stay below off the diagonal.
    left, right : arrays
        ``N = left X right``.
    ratio : float
        weak/strong: how much less the weakest agent is fed back than the strongest.
    period : float or None
    signed : bool
        Whether X ≥ 0.
    tightening : float
        Relative distance kept from every active constraint.
    disturbance : (m,) array or None
        Bound of what is added to the derivative, for the goal "band".
    """

    A_low: Array
    A_high: Array
    floor: Array
    left: Array
    right: Array
    ratio: float
    period: float | None
    signed: bool
    tightening: float = 1e-5
    disturbance: Array | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of X."""
        return self.left.shape[1], self.right.shape[0]


@attrs.frozen(eq=False)
class Solution:
    """A gain X for ``strong = 1``, its v, and its rate [1/s] in plain floating point.

    `excess` is how far signs had to be violated, for the goal "tolerant".
    """

    X: Array
    v: Array
    rate: float
    excess: float = 0.0


def flows(A: Array, h: float) -> tuple[Array, Array]:
    """``e^{Ah}`` and ``Γ(A)``."""
    from scipy.linalg import expm

    m = len(A)
    if not np.abs(A).max() * h < 1e4:  # beyond it nothing is left to sample
        return np.full((m, m), np.nan), np.full((m, m), np.nan)
    W = expm(np.block([[A, np.eye(m)], [np.zeros((m, 2 * m))]]) * h)
    return W[:m, :m], W[:m, m:]


def alternate(
    problem: Problem, goal: Goal, rate: float | None = None, v: Array | None = None
) -> Solution | None:
    """Solve for X and v in turn until the objective stops improving.

    Parameters
    ----------
    problem : Problem
    goal : {"fast", "small", "tolerant", "band"}
        Largest rate; least Σ|X| for the given `rate`; least violation of signs for it; smallest
        band under the disturbance.
    rate : float, optional
        Wanted rate [1/s], for "small" and "tolerant".
    v : (m,) array, optional
        Where to start; for "small" one that admits the rate.

    Returns
    -------
    Solution or None
        None where not even the first program is feasible.
    """
    lines = _Constraints(problem)
    if not lines.finite:
        return None
    starts = [v] if v is not None else [np.ones(len(problem.A_low)), perron_vector(problem.A_high)]
    best: Solution | None = None
    best_value = np.inf
    for start in starts:
        current, previous = start, np.inf
        for _ in range(_ROUNDS):
            answer = lines.solve(current, goal, rate)
            if answer is None:
                break
            value, X, excess = answer
            if goal == "fast":
                X = lines.fill(X, current)
                value = -lines.rate(lines.contraction(X))
            T = lines.contraction(X)
            current = lines.band(T) if goal == "band" else perron_vector(T)
            if value < best_value:
                best = Solution(X, current, lines.rate(T), excess)
                best_value = value
            if not previous - value > 1e-10 * max(1.0, abs(value)):
                break
            previous = value
    return best


class _Constraints:
    """Rows of the program; those without v are set up once."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.m = len(problem.A_low)
        self.count = int(np.prod(problem.shape))
        h = problem.period
        if h is None:
            self.base, self.pull = problem.A_high, np.eye(self.m)
        else:
            self.base, self.pull = flows(problem.A_high, h)[0], flows(problem.A_low, h)[1]
        self.rows, self.limits, self.soft = self._signs()
        self.fixed = self._zeros()
        parts = (self.base, self.pull, self.rows, self.limits)
        self.finite = all(bool(np.isfinite(part).all()) for part in parts)

    def entries(self, left: Array) -> Array:
        """Coefficients of ``(left · problem.left) X right`` entry by entry, (m, m, count)."""
        full = left @ self.problem.left
        products: Array = np.einsum("ia,bj->ijab", full, self.problem.right)
        return products.reshape(len(left), self.problem.right.shape[1], self.count)

    def _signs(self) -> tuple[Array, Array, Array]:
        """``rows x <= limits`` for P and T, and which rows may give way."""
        problem, keep = self.problem, 1.0 - self.problem.tightening
        N = self.entries(np.eye(self.m))
        off = ~np.eye(self.m, dtype=bool)
        rows, limits = [N[off]], [problem.floor[off] * keep]
        if problem.period is not None:
            for tau in problem.period * np.arange(1, _INSTANTS + 1) / _INSTANTS:
                low, _ = flows(problem.A_low, tau)
                _, held = flows(problem.A_high, tau)
                scale = np.where(off, tau, 1.0)
                taken = self.entries(held) / scale[..., None]
                rows.append(taken.reshape(-1, self.count))
                limits.append((low / scale * keep).ravel())
        else:
            # in continuous time nothing else limits feedback of a state on itself
            rows.append(N[~off])
            limits.append(np.full(self.m, _FASTEST * np.abs(np.diag(problem.A_high)).max()))
        soft = np.ones(sum(len(r) for r in rows), dtype=bool)
        if not problem.signed:
            size = problem.tightening * 0.1 * np.abs(problem.A_low).max()
            reached = np.abs(N).sum(axis=2) > 0
            reached &= ~(off & (problem.floor <= 0))
            rows.append(-N[reached])
            limits.append(np.full(int(reached.sum()), -size))
            soft = np.append(soft, np.zeros(int(reached.sum()), dtype=bool))
        return np.concatenate(rows), np.concatenate(limits), soft

    def _zeros(self) -> Array:
        """Entries of X that must vanish: they feed an entry that has no room at all."""
        problem = self.problem
        off = ~np.eye(self.m, dtype=bool)
        none = off & (problem.floor <= 0)
        feeds = np.abs(self.entries(np.eye(self.m))) > 0
        return np.asarray((feeds & none[..., None]).any(axis=(0, 1)))

    def contraction(self, X: Array) -> Array:
        """Contraction matrix for a gain."""
        problem = self.problem
        return self.base - problem.ratio * self.pull @ problem.left @ X @ problem.right

    def rate(self, T: Array) -> float:
        """Rate that the matrix gives [1/s]."""
        radius = float(np.linalg.eigvals(T).real.max())
        h = self.problem.period
        if h is None:
            return -radius
        return float(-np.log(max(radius, 1e-300)) / h)

    def band(self, T: Array) -> Array:
        """Band of the weakest agent under the disturbance, scaled to 1: the v of the goal."""
        size = np.eye(self.m) - T if self.problem.period is not None else -T
        z = np.linalg.solve(size, self.load)
        return np.asarray(z / z.max()) if z.min() > 0 else perron_vector(T)

    @property
    def load(self) -> Array:
        """What the disturbance adds, per second or per period."""
        w = self.problem.disturbance
        w = np.ones(self.m) if w is None else w
        w = np.maximum(w, 1e-6 * w.max())
        h = self.problem.period
        return np.asarray(w if h is None else flows(self.problem.A_high, h)[1] @ w)

    def bound(self, rate: float) -> float:
        """Return what the contraction must reach for a rate."""
        h = self.problem.period
        wanted = rate * (1 + self.problem.tightening)
        return -wanted if h is None else float(np.exp(-wanted * h))

    def fill(self, X: Array, v: Array) -> Array:
        """Raise a gain X ≥ 0 to the limit of the signs, in the direction that helps the rate most.

        The first program cares for the worst row only; rows that no input reaches leave the gain
        undetermined there. The left Perron vector w says what lowers the eigenvalue of the whole.
        """
        from scipy.optimize import linprog

        if not self.problem.signed:
            return X
        w = perron_vector(self.contraction(X).T)
        gain = np.einsum("i,ijc,j->c", w, self.entries(self.pull), v)
        if not gain.max(initial=0.0) > 0:
            return X
        free = [
            (low, 0.0 if zero else None) for low, zero in zip(X.ravel(), self.fixed, strict=True)
        ]
        answer = linprog(
            -gain / gain.max(), A_ub=self.rows, b_ub=self.limits, bounds=free, method="highs"
        )
        return X if answer.status != 0 else np.asarray(answer.x).reshape(X.shape)

    def solve(self, v: Array, goal: Goal, rate: float | None) -> tuple[float, Array, float] | None:
        """One linear program; its value, X and the violation of signs."""
        from scipy.optimize import linprog

        n, signed = self.count, self.problem.signed
        pull = -self.problem.ratio * np.einsum("ijc,j->ic", self.entries(self.pull), v)
        sides = 1 if signed else 2  # a free gain is the difference of two parts
        extra = 0 if goal == "small" else 1
        signs = np.hstack([self.rows] + [-self.rows] * (sides - 1))
        moved = np.hstack([pull] + [-pull] * (sides - 1))
        cost = np.full(n * sides + extra, 1.0 if goal == "small" else 0.0)
        limits = np.concatenate([self.limits, -self.base @ v])
        if extra:
            cost[-1] = -1.0 if goal == "band" else 1.0
            first = -self.soft.astype(float) if goal == "tolerant" else np.zeros(len(signs))
            second = {"fast": -v, "band": self.load}.get(goal, np.zeros(self.m))
            signs = np.hstack([signs, first[:, None]])
            moved = np.hstack([moved, second[:, None]])
        if goal == "band" and self.problem.period is not None:
            limits[len(self.limits) :] += v
        if goal in ("small", "tolerant"):
            assert rate is not None
            limits[len(self.limits) :] += self.bound(rate) * v
        free = [(0.0, 0.0 if zero else None) for zero in self.fixed] * sides
        last = [(None, None)] if goal == "fast" else [(0.0, None)] * extra
        answer = linprog(
            cost, A_ub=np.vstack([signs, moved]), b_ub=limits, bounds=free + last, method="highs"
        )
        if answer.status != 0 or answer.x is None:
            return None
        x = answer.x[:n] - (answer.x[n : 2 * n] if sides == 2 else 0.0)
        excess = float(answer.x[-1]) if goal == "tolerant" else 0.0
        return float(answer.fun), x.reshape(self.problem.shape), excess
