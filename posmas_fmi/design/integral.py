"""Method "integral": distributed integral action, no offset under unequal constant loads.

``u = (M̂ ⊗ φK) δ + (I ⊗ K_q) q`` with ``q_i' = Σ_j M̂_ij C_z (x_j - s)`` is the pinned protocol of
the augmented agent ``[[A, 0], [C_z, 0]]``, ``[B; 0]``: route L proves it with small programs
whatever the number of agents (certificate I). It needs the *slope* of sec in the sector, and gives
up certificates P and D; use it for plants whose positivity is structural.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from contextlib import suppress
from fractions import Fraction
from itertools import product
from typing import Any

import attrs
import numpy as np
import sympy

from posmas_fmi.agent import Agent, Assumption
from posmas_fmi.certify import Loop, baseline
from posmas_fmi.certify.assumptions import assumptions
from posmas_fmi.certify.certificate import Certificate, Condition
from posmas_fmi.certify.closed_loop import Prover, m_matrix
from posmas_fmi.certify.proof import Definiteness, positive_definite, rational
from posmas_fmi.certify.proof import dyadic as exactly
from posmas_fmi.certify.quadratic import (
    GraphScalar,
    SampledProof,
    Step,
    feedback_matrix,
    mismatch,
    prove_sampled,
    step_of,
    symmetric_scalar,
)
from posmas_fmi.design.gains import checked_gains, loop_of
from posmas_fmi.design.lmi import graph_scalar, lipschitz_norm
from posmas_fmi.design.result import Baseline, Design
from posmas_fmi.design.rounding import nearest
from posmas_fmi.design.sampled import (
    sampled_condition,
    sampled_feedback,
    sampled_gain,
    sampled_observer,
)
from posmas_fmi.design.settings import DesignSettings
from posmas_fmi.design.solver import cvxpy, solve
from posmas_fmi.errors import DesignError, InputError
from posmas_fmi.expression import Array, VectorFunction, symbol
from posmas_fmi.interval import bounds
from posmas_fmi.network import Network

_SAFETY = 1e-4
_HALVINGS = 14  # of the rate that is looked for, from the fastest pole of A on
_SHARES = (0.01, 0.05, 0.2, 0.5)  # of the graph scalar, for gains that are given
_PARTS = (0.9, 0.7, 0.5, 0.3, 0.1)  # of the rate of the loop that is closed with the gain γ₀/2
_GRID = 2001  # points at which the slope of sec is looked at


@attrs.frozen(eq=False)
class IntegralDesign:
    """Gains of the integral protocol and their proof.

    Attributes
    ----------
    K : (p, m) array
        On ``Σ_j (L_p)_ij δ_j``, to be multiplied by φ.
    K_q : (p, k) array
        On q_i.
    V : (m + k, m + k) array
        ``Σ_ij W_ij z_iᵀ V z_j`` falls at the rate 2κ.
    kappa : float
        Proved rate [1/s] of the continuous loop.
    graph : GraphScalar
    proof : Definiteness
        Of the rational matrix inequality, with the gains as they ship.
    """

    K: Array
    K_q: Array
    V: Array
    kappa: float
    graph: GraphScalar
    proof: Definiteness


def augmented(agent: Agent, C_z: Array) -> tuple[Array, Array, Array]:
    """Return ``[[A, 0], [C_z, 0]]``, ``[B; 0]`` and ``[H; 0]``."""
    m, k = agent.m, len(C_z)
    A = np.block([[agent.A, np.zeros((m, k))], [C_z, np.zeros((k, k))]])
    return A, np.vstack([agent.B, np.zeros((k, agent.p))]), np.vstack([agent.H, np.zeros((k, m))])


def design(
    agent: Agent, network: Network, settings: DesignSettings, period: float | None
) -> Design:
    """Design K, K_q and E: the fastest rate, or the least gain for the rate that is asked for."""
    network.require_reached()
    C_z, names = integrated(agent, settings)
    found: tuple[IntegralDesign, Loop, Certificate] | None = None
    weak = 0.0
    for graph in graphs_of(agent, network):
        weak = max(weak, graph.value)
        if period is not None and graph.value > 0:
            sampled = _sampled(agent, network, settings, period, graph, C_z)
            if sampled is not None:
                return _result(settings, *sampled, names)
        for rate in _rates(agent, settings) if graph.value > 0 else ():
            with suppress(DesignError):
                made = integral_design(agent, graph, C_z, rate, settings.phi, settings.digits)
                loop = _with_observer(agent, network, settings, period, made.K, rate)
                tried = _certificate(loop, made, C_z)
                if period is None or not any(a.name == "sampling" for a in tried.assumptions):
                    return _result(settings, made, loop, tried, names)
                found = found or (made, loop, tried)
        if found is not None:
            break
    if found is None:
        wanted = "any rate that was tried" if settings.rate is None else f"{settings.rate:.4g} 1/s"
        raise DesignError(
            f"no quadratic integral design has {wanted} (graph scalar {weak:.4g}); what helps: a "
            "lower rate, a narrower sector, more pins, an undirected network (there the width of "
            "the sector costs nothing), other outputs to integrate ($.design.integrates)",
            "$.design.rate" if settings.rate else "$.design",
        )
    return _result(settings, *found, names)


def _sampled(
    agent: Agent,
    network: Network,
    settings: DesignSettings,
    period: float,
    graph: GraphScalar,
    C_z: Array,
) -> tuple[IntegralDesign, Loop, Certificate] | None:
    """Fastest gains that are proved for the sampled loop itself."""
    bare = loop_of(
        agent, network, np.zeros((agent.p, agent.m)), np.zeros((agent.m, agent.q)), settings, period
    )
    step = step_of(bare, C_z)
    if step is None:
        return None
    for rate in _rates(agent, settings):
        factor = math.exp(-rate * period)
        made = sampled_gain(step, graph, factor, settings.phi, agent.m, settings.digits)
        if made is None:
            continue
        gain, proof = made
        K, K_q = gain[:, : agent.m], gain[:, agent.m :]
        loop = _with_observer(agent, network, settings, period, K, rate)
        shown = IntegralDesign(K, K_q, proof.P, rate * (1 - 1e-14), graph, proof.proof)
        return shown, loop, _certificate(loop, shown, C_z, proof)
    return None


def certify(
    agent: Agent, network: Network, settings: DesignSettings, period: float | None
) -> Design:
    """Prove given gains K, K_q and E; V is found by a small program."""
    assert settings.K is not None
    assert settings.E is not None
    assert settings.K_q is not None
    C_z, names = integrated(agent, settings)
    K, E = checked_gains(agent, settings.K, settings.E)
    if settings.K_q.shape != (agent.p, len(C_z)):
        raise InputError(
            f"expected a matrix of shape {(agent.p, len(C_z))}, one column per integrated output "
            f"(got {settings.K_q.shape})",
            "$.design.K_q",
        )
    loop = loop_of(agent, network, K, E, settings, period)
    if network.unreached() or loop.protocol == "printed":
        from posmas_fmi.certify import certify_loop

        failed = IntegralDesign(K, settings.K_q, np.eye(1), 0.0, _none(), _nothing())
        return _result(settings, failed, loop, certify_loop(loop), names)
    if period is not None:
        step, gain = step_of(loop, C_z), _exact(settings.phi, K, settings.K_q)
        for graph in graphs_of(agent, network):
            if step is None:
                break
            proof = _as_designed(step, gain, graph, loop, settings)
            proof = proof or _guessed(step, gain, graph, loop, C_z)
            if proof is not None:
                rate = -math.log(proof.factor) / period * (1 - 1e-14)
                shown = IntegralDesign(K, settings.K_q, proof.P, rate, graph, proof.proof)
                return _result(settings, shown, loop, _certificate(loop, shown, C_z, proof), names)
    made = judged(agent, graphs_of(agent, network), C_z, K, settings.K_q, settings)
    return _result(settings, made, loop, _certificate(loop, made, C_z), names)


def _as_designed(
    step: Step, gain: Any, graph: GraphScalar, loop: Loop, settings: DesignSettings
) -> SampledProof | None:
    """Prove given gains with the P of a design for one of the rates that are tried."""
    period, m = loop.period, loop.agent.m
    assert period is not None
    for rate in _rates(loop.agent, attrs.evolve(settings, rate=None)):
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


def _guessed(
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


def integrated(agent: Agent, settings: DesignSettings) -> tuple[Array, tuple[str, ...]]:
    """Rows of C that are integrated, and the names of these outputs.

    Raises
    ------
    InputError
        If an output is unknown, or there are more of them than inputs to hold them.
    """
    known = [f"y{k + 1}" for k in range(agent.q)]
    names = settings.integrates or tuple(known[: agent.p] if agent.q <= agent.p else known[-1:])
    for name in names:
        if name not in known:
            raise InputError(
                f"expected outputs out of {', '.join(known)} (got {name!r})", "$.design.integrates"
            )
    if len(set(names)) < len(names) or len(names) > agent.p:
        raise InputError(
            f"expected at most {agent.p} different outputs, one per input (got {list(names)})",
            "$.design.integrates",
        )
    return agent.C[[known.index(name) for name in names]], names


def graphs_of(agent: Agent, network: Network) -> Iterator[GraphScalar]:
    """Graph scalars to try: of an undirected network the one that any sector suits comes first."""
    sector = (agent.m_l, agent.m_h)
    symmetric = symmetric_scalar(network, sector)
    if symmetric is not None:
        yield symmetric
    if symmetric is None or lipschitz_norm(agent) > 0:
        with suppress(DesignError):
            yield graph_scalar(network, sector)


def _rates(agent: Agent, settings: DesignSettings) -> Iterator[float]:
    if settings.rate is not None:
        yield settings.rate
        return
    fastest = float(np.abs(np.linalg.eigvals(agent.A)).max()) or 1.0
    for k in range(_HALVINGS):
        yield float(f"{fastest * 0.5**k:.3g}")


def integral_design(
    agent: Agent,
    graph: GraphScalar,
    C_z: Array,
    rate: float,
    phi: float = 1.0,
    digits: int = 6,
) -> IntegralDesign:
    """Gains with the least bound on ``|K|`` that contract with the wanted rate.

    Parameters
    ----------
    agent : Agent
        Its sector has to bound the slope of sec.
    graph : GraphScalar
        Of the network.
    C_z : (k, m) array
        What is integrated, ``z = C_z x``.
    rate : float
        Wanted κ [1/s].
    phi : float
        Coupling, which K is divided by.
    digits : int
        Significant digits of the gains, which are rounded before anything is proved.

    Raises
    ------
    DesignError
        If no quadratic design has that rate, or the rounded gains could not be proved.

    Examples
    --------
    >>> from posmas_fmi.agent import linear_agent
    >>> from posmas_fmi.network import network_from_arcs
    >>> tank = linear_agent([[-0.1]], [[1.0]], [[1.0]])
    >>> one = symmetric_scalar(network_from_arcs(1, [], [1]), (1.0, 1.0))
    >>> made = integral_design(tank, one, np.eye(1), rate=0.05)
    >>> made.proof.positive, bool(made.K_q[0, 0] < 0)
    (True, True)
    """
    C_z = np.atleast_2d(np.asarray(C_z, dtype=float))
    if C_z.shape[1] != agent.m:
        raise DesignError(f"expected C_z with {agent.m} columns (got {C_z.shape})", "$.design")
    system = augmented(agent, C_z)
    V, theta = _program(system, graph, lipschitz_norm(agent), rate * (1 + _SAFETY))
    gain = -(system[1].T @ V)
    K = nearest(gain[:, : agent.m] / phi, digits)
    K_q = nearest(gain[:, agent.m :], digits)
    proof = _prove(agent, C_z, phi, K, K_q, V, graph, theta, rate)
    if not proof.positive:
        raise DesignError(
            f"the integral design could not be proved after rounding ({proof}); ask for a lower "
            "rate or more digits",
            "$.design",
        )
    return IntegralDesign(K, K_q, V, rate, graph, proof)


def _exact(phi: float, K: Array, K_q: Array) -> Any:
    """``[φK  K_q]`` in fractions."""
    return np.hstack([Fraction(repr(float(phi))) * rational(K), rational(K_q)])


def _prove(
    agent: Agent,
    C_z: Array,
    phi: float,
    K: Array,
    K_q: Array,
    V: Array,
    graph: GraphScalar,
    theta: float,
    rate: float,
    share: float | None = None,
) -> Definiteness:
    """Prove κ for gains as they are."""
    system = augmented(agent, C_z)
    if not positive_definite(exactly(V)).positive:
        return _nothing()
    exact = _exact(phi, K, K_q)
    gain = np.hstack([phi * K, K_q])
    if share is None:
        share = mismatch(system[1], gain, V, graph)
    return positive_definite(
        feedback_matrix(
            system, exact, exactly(V), graph, Fraction(theta), Fraction(repr(float(rate))),
            lipschitz_norm(agent), share,
        )
    )  # fmt: skip


def _program(
    system: tuple[Array, Array, Array], graph: GraphScalar, beta: float, rate: float
) -> tuple[Array, float]:
    """Least σ with Π ⪰ I, as ``K = -σ BᵀΠ⁻¹`` is then bounded by σ‖B‖; V = σ Π⁻¹ and θ."""
    cp = cvxpy()
    A, B, H = system
    n, m = len(A), H.shape[1]
    unit = float(np.abs(B).max(initial=0.0)) or 1.0
    B = B / unit
    slope = beta * math.sqrt(graph.spread) * (1 + 1e-6)
    if not math.isfinite(slope):
        raise DesignError("the integral design needs a finite Lipschitz bound", "$.agent.lipschitz")
    Pi = cp.Variable((n, n), symmetric=True)
    sigma, theta = cp.Variable(pos=True), cp.Variable(pos=True)
    seen = np.vstack([np.eye(m), np.zeros((n - m, m))])  # g depends on the agent's states only
    # γσ in place of σ: graph scalars of large networks are small
    top = A @ Pi + Pi @ A.T - sigma * B @ B.T + theta * H @ H.T + 2 * rate * Pi
    side = slope * Pi @ seen
    block = cp.bmat([[top, side], [side.T, -theta * np.eye(m)]])
    room = 1e-6 * max(1e-6, rate)
    limits = [block << -room * np.eye(n + m), Pi >> np.eye(n)]
    program = cp.Problem(cp.Minimize(sigma), limits)
    if not solve(program, "integral design") or Pi.value is None:
        raise DesignError(
            f"no quadratic integral design has the rate {rate:.4g} 1/s; ask for a lower one",
            "$.design.rate",
        )
    scale = float(sigma.value) / unit**2 / graph.value * (1 + _SAFETY)
    V = np.linalg.inv(np.asarray(Pi.value)) * scale
    return 0.5 * (V + V.T), float(theta.value) / scale


def judged(
    agent: Agent,
    graphs: Iterable[GraphScalar],
    C_z: Array,
    K: Array,
    K_q: Array,
    settings: DesignSettings,
) -> IntegralDesign:
    """Find V for gains that are given, and prove the fastest rate of a few."""
    gain, last = np.hstack([settings.phi * K, K_q]), _none()
    for graph in graphs:
        last = graph
        search = _Analysis.of(augmented(agent, C_z), gain, graph, lipschitz_norm(agent))
        if search is None:
            continue
        for part, share, theta in product(_PARTS, _SHARES, search.thetas):
            rate = float(f"{part * search.fastest:.3g}")
            V = search.solve(rate, share, theta)
            if V is not None:
                proof = _prove(
                    agent, C_z, settings.phi, K, K_q, V, graph, theta * search.unit, rate, share
                )
                if proof.positive:
                    return IntegralDesign(K, K_q, V, rate, graph, proof)
    return IntegralDesign(K, K_q, np.eye(agent.m + len(C_z)), 0.0, last, _nothing())


@attrs.frozen(eq=False)
class _Analysis:
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
    ) -> _Analysis | None:
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


def _with_observer(
    agent: Agent,
    network: Network,
    settings: DesignSettings,
    period: float | None,
    K: Array,
    rate: float,
) -> Loop:
    from posmas_fmi.design import contraction

    E = contraction.observer_gain(agent, network, settings, period, rate)
    return loop_of(agent, network, K, E, settings, period)


def _certificate(
    loop: Loop, made: IntegralDesign, C_z: Array, sampled: SampledProof | None = None
) -> Certificate:
    """Put what is proved together; what is neither proved nor refuted is an assumption."""
    agent, h, graph = loop.agent, loop.period, made.graph
    weights = loop.weights_perron
    conditions = [
        m_matrix(loop.network, weights),
        Condition.from_margin(
            "I: graph scalar",
            graph.value if graph.kind == "symmetric" else graph.proof.bound,
            f"gamma_0 = {graph.value:.9g} (W {graph.kind}): {graph.proof}",
        ),
    ]
    if sampled is None:
        conditions.append(
            Condition.from_margin(
                "I: feedback with integral contracts",
                made.proof.bound,
                f"kappa = {made.kappa:.9g} 1/s: {made.proof}",
            )
        )
    else:
        assert h is not None
        conditions.append(sampled_condition("I: sampled loop contracts", sampled, h))
    found = [*assumptions(loop), slope_assumption(agent)]
    rate: float | None = made.kappa if made.proof.positive else None
    if h is not None and rate is not None and sampled is None:
        gain = _exact(loop.phi, made.K, made.K_q)
        proof = sampled_feedback(loop, gain, made.V, graph, rate, C_z)
        if proof is None:
            found.append(
                Assumption(
                    "sampling",
                    "declared",
                    f"a period of {h:g} s is taken as continuous: no quadratic proof of the "
                    "sampled loop was found; a shorter period or a lower rate helps",
                )
            )
        else:
            conditions.append(sampled_condition("I: sampled loop contracts", proof, h))
            rate = -math.log(proof.factor) / h
    observer = Prover(loop, loop.estimator(weights), weights)
    contracts, observer_rate = observer.contracts, observer.rate
    if not contracts.holds and h is not None:
        proof = sampled_observer(loop)
        if proof is not None:
            contracts = sampled_condition("I: sampled observer contracts", proof, h)
            observer_rate = -math.log(proof.factor) / h
    conditions.append(contracts)
    return Certificate(
        assumptions=tuple(found),
        conditions=tuple(conditions),
        rate=rate,
        observer_rate=observer_rate,
        positive=False,
        p_max=loop.network.p_max,
        period=h,
        rate_continuous=made.kappa if sampled is None and made.proof.positive else None,
        observer_rate_continuous=observer.continuous,
        covers=_covers(agent) if all(c.holds for c in conditions) else (),
    )


def _covers(agent: Agent) -> tuple[str, ...]:
    low, high = agent.m_l, agent.m_h
    return (
        f"every nonlinearity with slopes in [{low:g}, {high:g}], per agent; within a period the "
        "input's effect is that of the state at its start",
        "constant loads, unequal from agent to agent: what is integrated has no offset",
        "not covered: delays and losses of messages (try them with the falsifier or in a run), "
        "saturation that the integrals wind up against, and positivity, which has to be structural",
    )


def slope_assumption(agent: Agent) -> Assumption:
    """Whether the sector bounds the slope of sec, which integral action needs."""
    if not isinstance(agent.sec, VectorFunction):
        return Assumption("slope", "declared", "sec is no expression: its slope is not known")
    low, high = agent.m_l, agent.m_h
    texts, statuses = [], []
    for k, expr in enumerate(agent.sec.expressions):
        name = f"u{k + 1}"
        region = agent.region.get(name, (-math.inf, math.inf))
        found = bounds(sympy.diff(expr, symbol(name)), {name: region}, (low, high))
        slack = 1e-9 * high
        if found.low >= low - slack and found.high <= high + slack:
            statuses.append("verified")
            texts.append(f"d sec/d{name} in [{found.low:.6g}, {found.high:.6g}]")
            continue
        least, most = _secants(agent, k, region)
        beyond = least < low * (1 - 1e-6) or most > high * (1 + 1e-6)
        statuses.append("contradicted" if beyond else "declared")
        texts.append(f"quotients of differences of sec({name}) in [{least:.6g}, {most:.6g}]")
    detail = f"[{low:g}, {high:g}] declared for the slope of sec; {'; '.join(texts)}"
    for status in ("contradicted", "declared"):
        if status in statuses:
            return Assumption("slope", status, detail)
    return Assumption("slope", "verified", detail)


def _secants(agent: Agent, k: int, region: tuple[float, float]) -> tuple[float, float]:
    """Least and largest quotient of differences on a grid: slopes are attained between."""
    low, high = (
        math.copysign(min(abs(end), 100.0), end) if math.isinf(end) else end for end in region
    )
    u = np.zeros((_GRID, agent.p))
    u[:, k] = np.linspace(low, high, _GRID)
    values = agent.sec_numpy(u)[:, k]
    slopes = np.diff(values) / np.diff(u[:, k])
    return float(slopes.min()), float(slopes.max())


def _result(
    settings: DesignSettings,
    made: IntegralDesign,
    loop: Loop,
    certificate: Certificate,
    names: tuple[str, ...],
) -> Design:
    free = baseline(loop)
    return Design(
        method=settings.method,
        observer=settings.observer,
        phi=settings.phi,
        mu=settings.mu,
        K=made.K,
        E=loop.E,
        network=loop.network,
        certificate=certificate,
        baseline=Baseline(free is not None and free > 0, free),
        protocol=settings.protocol,
        form=settings.form,
        K_q=made.K_q,
        integrates=names,
    )


def _nothing() -> Definiteness:
    return Definiteness(float("nan"), -math.inf, "no quadratic function was found")


def _none() -> GraphScalar:
    one = np.ones(1)
    return GraphScalar(0.0, "diagonal", one, one, _nothing(), 1.0, 1.0, 1.0, 1.0)
