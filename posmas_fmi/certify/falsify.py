"""Monte-Carlo falsifier: it looks for what a certificate says cannot be.

Every draw is a loop that the certificate covers: ``g(t, x) = Θ(t) x`` with Θ switching inside the
declared bounds, a sector gain of every input switching inside the sector, initial states, delays
and losses of the messages of every arc, and with `falsify_networks` the digraph and its pins. A hit
is a counterexample; no hits prove nothing.
"""

from __future__ import annotations

import attrs
import numpy as np

from posmas_fmi.certify.closed_loop import Prover
from posmas_fmi.certify.delay import Rows, delayed_rate
from posmas_fmi.certify.drawn import Digraphs, draw_digraphs
from posmas_fmi.certify.loop import Loop
from posmas_fmi.certify.weights import Weights
from posmas_fmi.expression import Array
from posmas_fmi.interval import Mask
from posmas_fmi.network import Network

_LIBRARY = 48  # distinct Θ per call
_INSTANTS = 4  # of every period at which signs are looked at
_TOLERANCE = 1e-9
_BATCH = 2000
_ARCS = 10**6  # messages of a step at once
_SAME_SIZE = 500  # draws in a row with the same number of agents


@attrs.frozen
class Falsification:
    """What a search found.

    Attributes
    ----------
    draws, periods : int
    least_state : float
        Smallest entry of any state, estimate or estimation error, relative to the largest start.
    worst_factor : float or None
        Largest factor per period of the weighted tracking error, without delay and with e = 0.
    claimed_factor : float or None
        What the certificate claims for it; None where it claims nothing.
    worst_observer_factor, claimed_observer_factor : float or None
        The same for the estimation error.
    worst_late, worst_observer_late : float
        Largest ``‖δ_k‖/(‖δ_0‖ r^k)`` in the draws with delays and losses, e = 0 and a leader at
        rest, for the r that certificate D claims with messages of that age; the same for e.
    claimed_late_factor : float or None
        That r.
    oldest : int
        Largest age of a message there, in periods.
    growth : float
        Largest ``|δ|`` at the end over ``|δ|`` at the start.
    violations : tuple of str
        In words; empty where nothing was found.
    """

    draws: int
    periods: int
    least_state: float
    worst_factor: float
    claimed_factor: float | None
    worst_observer_factor: float
    claimed_observer_factor: float | None
    worst_late: float
    worst_observer_late: float
    claimed_late_factor: float | None
    oldest: int
    growth: float
    violations: tuple[str, ...]


def falsify(
    loop: Loop,
    draws: int = 1000,
    periods: int = 40,
    seed: int = 0,
    max_delay: int = 3,
    loss: float = 0.2,
) -> Falsification:
    """Search for a violation of positivity or of the certified rates.

    Parameters
    ----------
    loop : Loop
        With a control period.
    draws, periods, seed : int
    max_delay : int
        Messages arrive up to so many periods late in every second draw, arc by arc; in half of
        these all are twice as old all the time.
    loss : float
        Probability that a message is lost there; the last one received is used, until it is twice
        `max_delay` periods old.

    Raises
    ------
    ValueError
        If the loop has no period.
    """
    if loop.period is None:
        raise ValueError("expected a loop with a control period")
    claims = _own_claims(loop, 2 * max_delay)
    graph = _Same(loop.network)
    rng = np.random.default_rng(seed)
    batch = max(1, min(_BATCH, _ARCS // graph.N**2))
    found = [
        _Batch(loop, graph, claims, rng, min(batch, draws - k), max_delay, loss).run(periods)
        for k in range(0, draws, batch)
    ]
    return _judged(found, claims, draws, periods, 2 * max_delay)


def falsify_networks(
    loop: Loop,
    draws: int = 1000,
    periods: int = 40,
    seed: int = 0,
    agents: tuple[int, int] = (1, 8),
    max_delay: int = 3,
    loss: float = 0.2,
) -> Falsification:
    """Search over digraphs and pins too: every draw has its own.

    Certificate S of `loop` with the weights p covers every network, of any size, whose p is at
    most p_max and whose (L_p)_ii is at most the largest of the network of `loop`; such networks are
    drawn, weighted ones included, with the claims of that one certificate.

    Parameters
    ----------
    loop : Loop
        Agent, gains, period, and a network that says how far the certificate reaches.
    draws, periods, seed : int
    agents : (int, int)
        Least and largest number of agents of a drawn network.
    max_delay : int
    loss : float
        As in `falsify`.

    Returns
    -------
    Falsification
        `growth` is the largest over all networks.

    Raises
    ------
    ValueError
        If the loop has no period.
    NetworkError
        If the leader does not reach every agent of the network of `loop`.
    """
    if loop.period is None:
        raise ValueError("expected a loop with a control period")
    loop.network.require_reached()
    rng = np.random.default_rng(seed)
    degree = float((loop.network.in_degree + loop.network.pinning).max())
    held = 1 / loop.network.p_max
    rows = Rows(np.array([held * (1 - 1e-9)]), np.array([(degree - held) * (1 + 1e-9)]))
    parts = _proved(loop, loop.weights, rows, 2 * max_delay)
    claims, found = _Claims.nothing(1, loop.agent.m), []
    for k in range(0, draws, _SAME_SIZE):
        count = min(_SAME_SIZE, draws - k)
        size = int(rng.integers(agents[0], agents[1] + 1))
        graphs = draw_digraphs(size, loop.network.p_max, degree, count, rng)
        claims = _Claims.of(parts, graphs.p, loop)
        found.append(_Batch(loop, graphs, claims, rng, count, max_delay, loss).run(periods))
    return _judged(found, claims, draws, periods, 2 * max_delay)


def _judged(
    found: list[_Found], claims: _Claims, draws: int, periods: int, oldest: int
) -> Falsification:
    least = min(f.least for f in found)
    tracking, observer = max(f.tracking for f in found), max(f.observer for f in found)
    late, observer_late = max(f.late for f in found), max(f.observer_late for f in found)
    violations = []
    if least < -_TOLERANCE:
        violations.append(f"a state, estimate or estimation error falls to {least:.4g} (relative)")
    for name, factor, claim in (
        ("tracking", tracking, claims.factor),
        ("estimation", observer, claims.observer_factor),
    ):
        limit = 1.0 if claim is None else claim
        if factor > limit * (1 + _TOLERANCE):
            violations.append(
                f"the weighted {name} error grows by {factor:.6g} in a period"
                + ("" if claim is None else f" (claimed {claim:.6g})")
            )
    for name, ratio, claim in (
        ("tracking", late, claims.late_factor),
        ("estimation", observer_late, claims.observer_late_factor),
    ):
        if claim is not None and ratio > 1 + _TOLERANCE:
            violations.append(
                f"with messages up to {oldest} periods old the weighted {name} error is "
                f"{ratio:.6g} times what the factor {claim:.6g} per period allows"
            )
    return Falsification(
        draws, periods, least, tracking, claims.factor, observer, claims.observer_factor,
        late, observer_late, claims.late_factor, oldest,
        max(f.growth for f in found), tuple(violations),
    )  # fmt: skip


@attrs.frozen
class _Found:
    """What a batch found."""

    least: float
    tracking: float
    observer: float
    late: float
    observer_late: float
    growth: float


class _Same:
    """One network for all draws."""

    def __init__(self, network: Network) -> None:
        self.N, self.adjacency = network.N, network.adjacency.toarray()[None]
        self.degree, self.d = network.in_degree[:, None], network.pinning[:, None]


@attrs.frozen(eq=False)
class _Claims:
    """Norms and factors of the certificate; plain maximum norms where it claims nothing."""

    v: Array
    v_observer: Array
    v_late: Array
    v_observer_late: Array
    factor: float | None = None
    observer_factor: float | None = None
    late_factor: float | None = None
    observer_late_factor: float | None = None

    @classmethod
    def nothing(cls, agents: int, m: int) -> _Claims:
        one = np.ones((agents, m))
        return cls(one, one, one, one)

    @classmethod
    def of(cls, parts: _Parts, nu: Array, loop: Loop) -> _Claims:
        """Norms of agents with the weights `nu`, (..., N)."""
        flat = np.ones((*nu.shape, loop.agent.m))
        controller, observer = parts["controller"], parts["observer"]
        spread = np.ones_like(nu) if loop.observer == "local" else nu
        return cls(
            flat if controller is None else nu[..., None] * controller.v,
            flat if observer is None else spread[..., None] * observer.v,
            flat if controller is None else nu[..., None] * controller.v_late,
            flat if observer is None else spread[..., None] * observer.v_late,
            None if controller is None else controller.factor,
            None if observer is None else observer.factor,
            None if controller is None else controller.late,
            None if observer is None else observer.late,
        )


@attrs.frozen(eq=False)
class _Part:
    """What is claimed of one feedback: v and factor per period, without and with late messages."""

    v: Array
    factor: float
    v_late: Array
    late: float | None


_Parts = dict[str, _Part | None]


def _proved(loop: Loop, weights: Weights, rows: Rows, oldest: int) -> _Parts:
    """Claims of both feedbacks; None where none is proved."""
    assert loop.period is not None
    parts: _Parts = {"controller": None, "observer": None}
    if loop.protocol == "printed":
        return parts
    for feedback in (loop.controller(weights), loop.estimator(weights)):
        prover = Prover(loop, feedback, weights)
        if prover.v is None or prover.rate is None:
            continue
        late, v_late = None, prover.v
        if prover.positive and oldest:
            slower = delayed_rate(loop, feedback, rows, prover.rate, oldest * loop.period)
            late = float(np.exp(-slower.rate * loop.period))
            v_late = prover.v if slower.v is None else slower.v
        factor = float(np.exp(-prover.rate * loop.period))
        parts[feedback.name] = _Part(prover.v, factor, v_late, late)
    return parts


def _own_claims(loop: Loop, oldest: int) -> _Claims:
    """Claims of the certificate for the network of the loop."""
    if loop.protocol == "printed" or loop.network.unreached():
        return _Claims.nothing(loop.network.N, loop.agent.m)
    weights = loop.weights_perron
    rows = Rows.of(loop.network, weights)
    return _Claims.of(_proved(loop, weights, rows, oldest), weights.nu, loop)


class _Batch:
    """Many draws at once: arrays (draws, N, m)."""

    def __init__(
        self,
        loop: Loop,
        graph: _Same | Digraphs,
        claims: _Claims,
        rng: np.random.Generator,
        draws: int,
        max_delay: int,
        loss: float,
    ) -> None:
        self.loop, self.claims, self.rng, self.draws = loop, claims, rng, draws
        self.graph = graph
        n, m = graph.N, loop.agent.m
        self.Phi, self.Gamma = _library(loop, rng)
        # 0, 1: exact estimates; 2, 3: estimates below; odd: late messages, all very late in 5 and 7
        kind = np.arange(draws) % 8
        self.oldest = 2 * max_delay
        self.delayed = (kind % 2 == 1) & (max_delay > 0)
        self.always = self.delayed & (kind >= 4)
        self.exact = kind % 4 < 2
        self.max_delay, self.loss = max_delay, loss
        corner = rng.random((draws, n, m)) < 0.5
        self.x = np.where(corner, rng.choice([0.0, 1.0], (draws, n, m)), rng.random((draws, n, m)))
        # some start where the certificate is tight
        tight = (np.arange(draws) % 5 == 0)[:, None, None]
        self.x = np.where(
            tight, claims.v_late / claims.v_late.max(axis=(-1, -2), keepdims=True), self.x
        )
        below = rng.random((draws, n, 1)) * self.x
        self.xhat = np.where(self.exact[:, None, None], self.x, np.where(corner, 0.0, below))
        # certificate D is about a leader at rest: zero is a solution of the agent
        self.rest = self.delayed & self.exact
        self.s = np.where(self.rest[:, None, None], 0.0, rng.random((draws, 1, m)))
        zero = self.delayed.astype(int)[:, None, None] * np.zeros((1, n, n), dtype=int)
        self.age = np.where(self.always[:, None, None], self.oldest, zero)
        # before the start the leader's followers were as far off as the claim allows
        back = self.rest[:, None, None] * np.log(claims.late_factor or 1.0)
        self.sent = [self.xhat * np.exp(-k * back) for k in range(self.oldest + 1)]
        self.missed = [self.x - self.xhat] * (self.oldest + 1)

    def run(self, periods: int) -> _Found:
        """Look for the worst over some periods."""
        least, tracking, observer, late, observer_late = 0.0, 0.0, 0.0, 0.0, 0.0
        start = np.abs(self.x - self.s).max(axis=(1, 2))
        first = self._norms()
        fresh = ~self.delayed | (self.loop.observer == "local")
        slow = [c or 1.0 for c in (self.claims.late_factor, self.claims.observer_late_factor)]
        with np.errstate(over="ignore", invalid="ignore"):
            for k in range(1, periods + 1):
                before = self._norms()
                least = min(least, self._step())
                after = self._norms()
                fair = self.exact & ~self.delayed & (before[0] > 1e-12)
                tracking = max(tracking, _worst(after[0], before[0], fair))
                observer = max(observer, _worst(after[1], before[1], fresh & (before[1] > 1e-12)))
                late = max(
                    late, _worst(after[2], first[2] * slow[0] ** k, self.rest & (first[2] > 0))
                )
                some = self.delayed & (first[3] > 0)
                observer_late = max(observer_late, _worst(after[3], first[3] * slow[1] ** k, some))
            end = np.abs(self.x - self.s).max(axis=(1, 2))
            growth = float(np.nan_to_num(end / np.maximum(start, 1e-12), nan=np.inf).max())
        return _Found(least, tracking, observer, late, observer_late, growth)

    def _norms(self) -> tuple[Array, ...]:
        """Of tracking and estimation error, then the same with the weights for late messages."""
        claims, off, e = self.claims, self.xhat - self.s, self.x - self.xhat
        late = (off, claims.v_late), (e, claims.v_observer_late)
        pairs = ((off, claims.v), (e, claims.v_observer), *late)
        return tuple((np.abs(z) / v).max(axis=(1, 2)) for z, v in pairs)

    def _messages(self) -> None:
        """Let messages arrive, late or not at all: the age of what every arc uses."""
        if self.oldest == 0:
            return
        shape = self.age.shape
        fresh = self.rng.integers(0, self.max_delay + 1, shape)
        lost = (self.rng.random(shape) < self.loss) & (self.age < self.oldest)
        age = np.where(lost, self.age + 1, fresh)
        age = np.where(self.always[:, None, None], self.oldest, age)
        self.age = np.where(self.delayed[:, None, None], age, 0)

    def _near(self, memory: list[Array]) -> Array:
        """Add up over heard agents what their messages say: ``Σ_j a_ij z_j``."""
        if self.oldest == 0:
            return np.asarray(self.graph.adjacency @ memory[0])
        total = np.zeros_like(memory[0])
        for k, z in enumerate(memory):
            total += (self.graph.adjacency * (self.age == k)) @ z
        return total

    def _step(self) -> float:
        loop, agent = self.loop, self.loop.agent
        graph, d = self.graph, self.graph.d
        sign = -1.0 if loop.protocol == "printed" else 1.0
        self._messages()
        self.sent[0], self.missed[0] = self.xhat, self.x - self.xhat
        near = self._near(self.sent)
        w = graph.degree * self.xhat - near + sign * d * (self.xhat - self.s)
        u = loop.phi * w @ loop.K.T
        gains = self.rng.choice([agent.sector[0], agent.sector[1]], u.shape)
        push = (gains * u) @ agent.B.T
        e = self.x - self.xhat
        if loop.observer == "distributed":
            e = loop.mu * (graph.degree * e - self._near(self.missed) + d * e)
        innovation = e @ (loop.E @ agent.C).T
        pick = self.rng.integers(0, len(self.Phi), self.draws)
        least = 0.0
        for k in range(_INSTANTS):
            Phi, Gamma = self.Phi[pick, k], self.Gamma[pick, k]
            x, xhat = (
                z @ Phi.transpose(0, 2, 1) + p @ Gamma.transpose(0, 2, 1)
                for z, p in ((self.x, push), (self.xhat, push + innovation))
            )
            least = min(least, *(_least(z) for z in (x, xhat, x - xhat)))
        self.s = np.einsum("dij,dnj->dni", self.Phi[pick, -1], self.s)
        self.sent = [self.xhat, *self.sent[:-1]]
        self.missed = [self.x - self.xhat, *self.missed[:-1]]
        self.x, self.xhat = x, xhat
        return least


def _least(z: Array) -> float:
    size = np.maximum(1.0, np.abs(z).max(axis=(1, 2)))
    return float(np.nan_to_num((z.min(axis=(1, 2)) / size).min(), nan=-np.inf))


def _worst(after: Array, before: Array, which: Mask) -> float:
    if not which.any():
        return 0.0
    ratio = after[which] / before[which]
    return float(np.nan_to_num(ratio, nan=np.inf).max())


def _library(loop: Loop, rng: np.random.Generator) -> tuple[Array, Array]:
    """Φ and Γ at instants of a period for Θ inside the bounds, (library, instants, m, m)."""
    from scipy.linalg import expm

    agent, h, m = loop.agent, loop.period, loop.agent.m
    assert h is not None
    bound = np.minimum(agent.ell, np.where(np.eye(m) > 0, agent.growth, 0.0))
    bound = np.where(np.isfinite(bound), bound, 0.0)
    Phi = np.empty((_LIBRARY, _INSTANTS, m, m))
    Gamma = np.empty_like(Phi)
    for k in range(_LIBRARY):
        signs = rng.choice([-1.0, 1.0], (m, m)) if k % 3 else rng.uniform(-1, 1, (m, m))
        J = agent.A + agent.H @ (signs * bound)
        for i in range(_INSTANTS):
            block = np.block([[J, np.eye(m)], [np.zeros((m, 2 * m))]])
            W = expm(block * h * (i + 1) / _INSTANTS)
            Phi[k, i], Gamma[k, i] = W[:m, :m], W[:m, m:]
    return Phi, Gamma
