"""Methods "paper-1" and "paper-2": Algorithms 1 and 2, for reproduction rather than for use.

``form = "printed"`` follows the text, ``"joint"`` solves its steps 3 and 4 as one convex program.
``"corrected"`` keeps the quadratic idea with the errata of
theory.md put right, which is route L (`posmas_fmi.design.lmi`).
"""

from __future__ import annotations

from typing import Any, Literal

import attrs
import numpy as np

from posmas_fmi.agent import Agent
from posmas_fmi.design import lmi
from posmas_fmi.design.certified import certified
from posmas_fmi.design.result import Design
from posmas_fmi.design.rounding import nearest
from posmas_fmi.design.settings import DesignSettings, Reading
from posmas_fmi.design.solver import cvxpy, solve
from posmas_fmi.errors import DesignError
from posmas_fmi.expression import Array
from posmas_fmi.network import Network, generalised_connectivity

FIRST_PI = 0.5  # the paper's choice in step 3, times I
_ROUNDS = 10
_TANGENTS = 50
_LARGEST_PI = 2.0  # with Π free α has no minimum
_SMALLEST_F = 1e-12


@attrs.frozen(eq=False)
class Run:
    """Outcome of an algorithm.

    Attributes
    ----------
    alpha : float
        Best α found; conditions hold where it is negative.
    E : (m, q) array
    Pi : (m,) array
        Diagonal of Π.
    rounds : int
        Passes through steps 3 and 4.
    lmis : int
        Number of LMIs that had to be kept of the N.
    """

    alpha: float
    E: Array
    Pi: Array
    rounds: int
    lmis: int


def gammas(
    network: Network, sector: tuple[float, float], phi: float, eta: float, reading: Reading
) -> tuple[Array, Array]:
    """γ_i of (19) and f_i.

    Raises
    ------
    DesignError
        If an f_i is too small for 1/f_i to mean anything.
    """
    f = network.perron
    if f.min() < _SMALLEST_F:
        raise DesignError(
            f"1/f_i reaches {1 / f.min():.3g} on this digraph: the conditions of the paper are "
            'not usable here; use method = "contraction"',
            "$.network.arcs",
        )
    L, D = network.laplacian.toarray(), np.diag(network.pinning)
    connectivity = generalised_connectivity(L - D if reading.coupling == "L - D" else L + D, f)
    weighted = f[:, None] * L
    product = weighted @ weighted.T
    eigenvalues = np.linalg.eigvalsh(product)
    if reading.order == "descending":
        eigenvalues = eigenvalues[::-1]
    ratio = eigenvalues / f
    if reading.order == "rigorous":
        ratio = np.full(network.N, np.linalg.eigvalsh(product / np.sqrt(np.outer(f, f)))[-1])
    low, high = sector
    gain = phi * (reading.s * network.pinning + 1) * connectivity * (high + low) * eta
    return gain - ratio - eta**2 * (high - low) ** 2 / (4 * f), f


def active(gamma: Array, inverse_f: Array) -> Array:
    """Return which LMIs can be active: by (14) Σ = -δI, so LMI_i falls in γ_i and 1/f_i.

    The largest eigenvalue is convex in the pair, so of all points only vertices of the convex hull
    that nothing dominates can attain the maximum.

    Examples
    --------
    >>> active(np.array([1.0, 2.0, 1.5, 3.0]), np.array([2.0, 1.0, 1.5, 3.0])).tolist()
    [0, 1]
    """
    order = np.lexsort((inverse_f, gamma))
    kept: list[int] = []
    lowest = np.inf
    for i in order:  # Pareto front: γ rises, 1/f must fall
        if inverse_f[i] < lowest:
            lowest = inverse_f[i]
            while len(kept) >= 2 and _above(gamma, inverse_f, kept[-2], kept[-1], i):
                kept.pop()
            kept.append(int(i))
    return np.array(kept)


def _above(x: Array, y: Array, a: int, b: int, c: int) -> bool:
    """Whether b lies on or above the segment from a to c."""
    cross = (x[b] - x[a]) * (y[c] - y[a]) - (x[c] - x[a]) * (y[b] - y[a])
    return bool(cross <= 0)


@attrs.frozen(eq=False)
class Algorithm:
    """LMIs and sign conditions of Theorem 1 or 2.

    Attributes
    ----------
    agent : Agent
    points : tuple of (γ, 1/f, c)
        One per LMI that is kept; c multiplies EC: 1, or μ d_i.
    strong : float
        Largest multiple of EC in the Metzler condition on the observer.
    feedback : float
        ``max φ m̄/2 (l_ii - d_i) η`` of condition 1.
    delta : float
    """

    agent: Agent
    points: tuple[tuple[float, float, float], ...]
    strong: float
    feedback: float
    delta: float

    def first_pi(self) -> float:
        """0.5, or the least that condition 1 allows: ``A - feedback·BBᵀ/π`` Metzler."""
        A, BB = self.agent.A, self.agent.B @ self.agent.B.T
        off = ~np.eye(self.agent.m, dtype=bool) & (BB > 0)
        if (A[off] <= 0).any():
            raise DesignError(
                "condition 1 cannot hold for any Pi: A has a zero where BB^T has none",
                "$.agent.A",
            )
        least = self.feedback * float((BB[off] / A[off]).max(initial=0.0))
        return max(FIRST_PI, least * (1 + 1e-6))

    def minimise(
        self, Pi: Array | None, E: Array | None, symmetric: bool
    ) -> tuple[float, Array, Array]:
        """Minimise α over E for given Π (step 3), or over diagonal Π for given E (step 4)."""
        cp = cvxpy()
        A, H, B, C = self.agent.A, self.agent.H, self.agent.B, self.agent.C
        m, q = self.agent.m, self.agent.q
        alpha = cp.Variable()
        gain: Any = cp.Variable((m, q), symmetric=symmetric and m == q) if E is None else E
        diagonal: Any = cp.Variable(m, pos=True) if Pi is None else Pi
        P = cp.diag(diagonal)
        limits = []
        for gamma, inverse_f, c in self.points:
            EC = c * gain @ C
            # ΠΣΠ/f with Σ = -δI; concave in Π, so step 4 takes it at the last Π: left out there
            extra = -self.delta * inverse_f * np.diag(np.square(Pi)) if Pi is not None else 0
            top = (A + H) @ P + P @ (A + H).T - gamma * B @ B.T + extra
            side, low = (EC + H) @ P, (A - EC) @ P
            block = cp.bmat([[top, side], [side.T, low + low.T]])
            limits.append(block << alpha * np.eye(2 * m))
        off = [(i, j) for i in range(m) for j in range(m) if i != j]
        if E is None:
            limits.append(gain @ C >= 0)
            limits += [(A - self.strong * gain @ C)[i, j] >= 0 for i, j in off]
        else:
            BB = B @ B.T
            limits += [A[i, j] * diagonal[j] >= self.feedback * BB[i, j] for i, j in off]
            limits.append(diagonal <= _LARGEST_PI)
        program = cp.Problem(cp.Minimize(alpha), limits)
        if not solve(program, "Algorithm of the paper"):
            raise DesignError(
                "the sign conditions of the paper's algorithm have no solution", "$.design"
            )
        return (
            float(alpha.value),
            np.asarray(gain.value if E is None else E),
            np.asarray(diagonal.value if Pi is None else Pi),
        )

    def run(self, symmetric: bool) -> Run:
        """Go through steps 3 to 5."""
        Pi = np.full(self.agent.m, self.first_pi())
        alpha, E = np.inf, np.zeros((self.agent.m, self.agent.q))
        for turn in range(1, _ROUNDS + 1):
            alpha, E, _ = self.minimise(Pi, None, symmetric)
            if alpha <= 0:
                return Run(alpha, E, Pi, turn, len(self.points))
            alpha, _, Pi = self.minimise(None, E, symmetric)
            if alpha <= 0:
                return Run(alpha, E, Pi, turn, len(self.points))
        return Run(alpha, E, Pi, _ROUNDS, len(self.points))

    def joint(self, symmetric: bool) -> Run:
        """Minimise α over E and Π at once, instead of steps 3 and 4 in turn.

        The LMIs are linear in Π and ``X = ECΠ``. Any X is some E's where C has full column rank;
        else, and for symmetric E, Π = πI and ``X = (πE)C``. What is left is ``ΠΣΠ/f = -δΠ²/f``,
        concave in Π: its tangent lies above it, so each program proves its α, and the tangent at
        the last Π lowers α from turn to turn. The limit is a stationary point of the whole problem,
        its optimum but for that term.

        Raises
        ------
        DesignError
            If the sign conditions have no solution.
        """
        scalar = symmetric or np.linalg.matrix_rank(self.agent.C) < self.agent.m
        Pi = np.full(self.agent.m, self.first_pi())
        alpha, X, turns = np.inf, Pi, 0
        while turns < _TANGENTS:
            last, turns = alpha, turns + 1
            alpha, X, Pi = self._tangent(Pi, scalar, symmetric)
            if last - alpha <= 1e-7 * max(1.0, abs(alpha)):
                break
        E = X / Pi[0] if scalar else X / Pi @ np.linalg.pinv(self.agent.C)
        return Run(alpha, E, Pi, turns, len(self.points))

    def _tangent(self, at: Array, scalar: bool, symmetric: bool) -> tuple[float, Array, Array]:
        """α, X (or πE) and Π of the convex program with ``Π²`` replaced by its tangent at `at`."""
        cp = cvxpy()
        A, H, B, C = self.agent.A, self.agent.H, self.agent.B, self.agent.C
        m, q = self.agent.m, self.agent.q
        alpha = cp.Variable()
        pi = cp.Variable() * np.ones(m) if scalar else cp.Variable(m)
        X = cp.Variable((m, q) if scalar else (m, m), symmetric=symmetric and m == q)
        product, P, BB = X @ C if scalar else X, cp.diag(pi), B @ B.T
        square = cp.diag(2 * cp.multiply(at, pi) - at**2)
        limits = [product >= 0, pi >= 1e-6, pi <= max(_LARGEST_PI, self.first_pi())]
        for gamma, inverse_f, c in self.points:
            top = (A + H) @ P + P @ (A + H).T - gamma * BB - self.delta * inverse_f * square
            side, low = c * product + H @ P, A @ P - c * product
            block = cp.bmat([[top, side], [side.T, low + low.T]])
            limits.append(block << alpha * np.eye(2 * m))
        own, feedback = A @ P - self.strong * product, A @ P - self.feedback * BB
        off = ~np.eye(m, dtype=bool)
        limits += [cp.multiply(off, own) >= 0, cp.multiply(off, feedback) >= 0]
        if not solve(cp.Problem(cp.Minimize(alpha), limits), "joint form of Algorithm 1 or 2"):
            raise DesignError(
                "the sign conditions of the paper's algorithm have no solution", "$.design"
            )
        return float(alpha.value), np.asarray(X.value), np.asarray(pi.value)


def algorithm(
    agent: Agent,
    network: Network,
    which: Literal[1, 2],
    settings: DesignSettings,
    reading: Reading | None = None,
) -> Algorithm:
    """Conditions of Theorem 1 or 2 as printed, under one reading."""
    reading = reading or Reading()
    gamma, f = gammas(network, agent.sector, settings.phi, settings.eta, reading)
    factor = np.ones(network.N) if which == 1 else settings.mu * network.pinning
    points: list[tuple[float, float, float]] = []
    for c in np.unique(factor):
        same = np.flatnonzero(factor == c)
        kept = same[active(gamma[same], 1 / f[same])]
        points += [(float(gamma[i]), float(1 / f[i]), float(c)) for i in kept]
    degrees = network.in_degree + network.pinning
    low, high = agent.sector
    feedback = settings.phi * 0.5 * (high + low) * settings.eta
    return Algorithm(
        agent,
        tuple(points),
        1.0 if which == 1 else settings.mu * float(degrees.max()),
        feedback * float((network.in_degree - network.pinning).max()),
        settings.delta,
    )


def infeasible(agent: Agent) -> Array | None:
    """Return w > 0 with ``wᵀA ≥ 0``, or None: it proves (31) infeasible for unpinned agents.

    ``wᵀ Sym(AΠ) w = 2 Σ_k (wᵀA)_k π_k w_k ≥ 0`` for every diagonal Π ≻ 0 (erratum 3).
    """
    from posmas_fmi.certify.contraction import perron_vector
    from posmas_fmi.certify.proof import dyadic, rational

    w = np.round(perron_vector(agent.A.T), 2)
    if not (w > 0).all():
        return None
    product = dyadic(w) @ rational(agent.A)
    return w if all(x >= 0 for x in product) else None


def design(
    agent: Agent, network: Network, settings: DesignSettings, period: float | None
) -> Design:
    """Run Algorithm 1 or 2, and certify what comes out."""
    network.require_reached()
    which: Literal[1, 2] = 1 if settings.method == "paper-1" else 2
    settings = attrs.evolve(settings, observer="local" if which == 1 else "distributed")
    if settings.form == "corrected":
        return lmi.design(agent, network, settings, period)
    unpinned = bool((network.pinning == 0).any())
    if which == 2 and unpinned:
        w = infeasible(agent)
        if w is not None:
            shown = ", ".join(f"{x:g}" for x in w)
            raise DesignError(
                f"condition 2 of Theorem 2 is infeasible for every unpinned agent: with w = "
                f"({shown}) w^T A >= 0, hence w^T Sym(A Pi) w >= 0 for every diagonal Pi > 0 "
                '(erratum 3); use form = "corrected" or method = "contraction"',
                "$.design.method",
            )
    joint = settings.form == "joint"
    reading = settings.reading or Reading(symmetric_E=not joint)
    conditions = algorithm(agent, network, which, settings, reading)
    found = (conditions.joint if joint else conditions.run)(reading.symmetric_E)
    if found.alpha > 0:
        raise DesignError(
            f"Algorithm {which} stops at alpha = {found.alpha:.4g} > 0 after {found.rounds} "
            'rounds; use form = "corrected" or method = "contraction"',
            "$.design.method",
        )
    E = nearest(found.E, settings.digits, relative_zero=1e-6)
    K = nearest(-settings.eta * agent.B.T * found.Pi, settings.digits)
    notes = (
        f"Algorithm {which} {'in joint form' if joint else 'as printed'}: "
        f"alpha = {found.alpha:.6g}, Pi = {found.Pi.tolist()}, "
        f"{found.lmis} of {network.N} LMIs can be active, K = -eta B^T Pi; reading: {reading}",
        "the paper's conditions do not prove the closed loop (errata 3 to 9); the certificate is "
        "that of theory.md, section 4",
    )
    return certified(agent, network, K, E, settings, period, notes)
