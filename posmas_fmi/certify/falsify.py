"""Monte-Carlo falsifier: it looks for what a certificate says cannot be.

Every draw is a loop that the certificate covers: ``g(t, x) = Θ(t) x`` with Θ switching inside the
declared bounds, a sector gain of every input switching inside the sector, initial states, delays
and losses of messages, and with `falsify_networks` the digraph and its pins. A hit is a
counterexample; no hits prove nothing.
"""

from __future__ import annotations

import attrs
import numpy as np

from posmas_fmi.certify.closed_loop import Prover
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
        Messages are up to so many periods old in every second draw.
    loss : float
        Probability that a message is lost there; the last one received is used.

    Raises
    ------
    ValueError
        If the loop has no period.
    """
    if loop.period is None:
        raise ValueError("expected a loop with a control period")
    claims = _own_claims(loop)
    graph = _Same(loop.network)
    rng = np.random.default_rng(seed)
    found = [
        _Batch(loop, graph, claims, rng, min(_BATCH, draws - k), max_delay, loss).run(periods)
        for k in range(0, draws, _BATCH)
    ]
    return _judged(found, claims, draws, periods)


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
    parts = _proved(loop, loop.weights)
    claims, found = _Claims.nothing(1, loop.agent.m), []
    for k in range(0, draws, _SAME_SIZE):
        count = min(_SAME_SIZE, draws - k)
        size = int(rng.integers(agents[0], agents[1] + 1))
        graphs = draw_digraphs(size, loop.network.p_max, degree, count, rng)
        claims = _Claims.of(parts, graphs.p, loop)
        found.append(_Batch(loop, graphs, claims, rng, count, max_delay, loss).run(periods))
    return _judged(found, claims, draws, periods)


def _judged(
    found: list[tuple[float, float, float, float]], claims: _Claims, draws: int, periods: int
) -> Falsification:
    least = min(f[0] for f in found)
    tracking, observer = max(f[1] for f in found), max(f[2] for f in found)
    growth = max(f[3] for f in found)
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
    return Falsification(
        draws, periods, least, tracking, claims.factor, observer, claims.observer_factor,
        growth, tuple(violations),
    )  # fmt: skip


class _Same:
    """One network for all draws."""

    def __init__(self, network: Network) -> None:
        self.N, self.adjacency = network.N, network.adjacency
        self.degree, self.d = network.in_degree[:, None], network.pinning[:, None]

    def near(self, z: Array) -> Array:
        """Add up over heard agents: ``Σ_j a_ij z_j``."""
        draws, n, m = z.shape
        columns = z.transpose(1, 0, 2).reshape(n, draws * m)
        return np.asarray((self.adjacency @ columns).reshape(n, draws, m).transpose(1, 0, 2))


@attrs.frozen(eq=False)
class _Claims:
    """Norms and factors of the certificate; plain maximum norms where it claims nothing."""

    v: Array
    v_observer: Array
    factor: float | None = None
    observer_factor: float | None = None

    @classmethod
    def nothing(cls, agents: int, m: int) -> _Claims:
        return cls(np.ones((agents, m)), np.ones((agents, m)))

    @classmethod
    def of(cls, parts: _Parts, nu: Array, loop: Loop) -> _Claims:
        """Norms of agents with the weights `nu`, (..., N)."""
        flat = np.ones((*nu.shape, loop.agent.m))
        controller, observer = parts["controller"], parts["observer"]
        spread = np.ones_like(nu) if loop.observer == "local" else nu
        return cls(
            flat if controller is None else nu[..., None] * controller[0],
            flat if observer is None else spread[..., None] * observer[0],
            None if controller is None else controller[1],
            None if observer is None else observer[1],
        )


_Parts = dict[str, tuple[Array, float] | None]


def _proved(loop: Loop, weights: Weights) -> _Parts:
    """Weights v and factor r per period of each feedback; None where none is proved."""
    assert loop.period is not None
    parts: _Parts = {"controller": None, "observer": None}
    if loop.protocol == "printed":
        return parts
    for feedback in (loop.controller(weights), loop.estimator(weights)):
        prover = Prover(loop, feedback, weights)
        if prover.v is not None and prover.rate is not None:
            parts[feedback.name] = prover.v, float(np.exp(-prover.rate * loop.period))
    return parts


def _own_claims(loop: Loop) -> _Claims:
    """Claims of the certificate for the network of the loop."""
    if loop.protocol == "printed" or loop.network.unreached():
        return _Claims.nothing(loop.network.N, loop.agent.m)
    weights = loop.weights_perron
    return _Claims.of(_proved(loop, weights), weights.nu, loop)


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
        kind = np.arange(draws) % 4  # 0, 1: exact estimates; 2, 3: estimates below; odd: delays
        self.delayed = (kind % 2 == 1) & (max_delay > 0)
        self.exact = kind < 2
        self.max_delay, self.loss = max_delay, loss
        corner = rng.random((draws, n, m)) < 0.5
        self.x = np.where(corner, rng.choice([0.0, 1.0], (draws, n, m)), rng.random((draws, n, m)))
        below = rng.random((draws, n, 1)) * self.x
        self.xhat = np.where(self.exact[:, None, None], self.x, np.where(corner, 0.0, below))
        self.s = rng.random((draws, 1, m))
        self.memory = [self.xhat] * (max_delay + 1)
        self.last = self.xhat

    def run(self, periods: int) -> tuple[float, float, float, float]:
        """Least state, worst factors of tracking and estimation, growth."""
        least, tracking, observer = 0.0, 0.0, 0.0
        start = np.abs(self.x - self.s).max(axis=(1, 2))
        with np.errstate(over="ignore", invalid="ignore"):
            for _ in range(periods):
                before = self._norms()
                least = min(least, self._step())
                after = self._norms()
                fair = self.exact & ~self.delayed & (before[0] > 1e-12)
                tracking = max(tracking, _worst(after[0], before[0], fair))
                observer = max(observer, _worst(after[1], before[1], before[1] > 1e-12))
            end = np.abs(self.x - self.s).max(axis=(1, 2))
            growth = float(np.nan_to_num(end / np.maximum(start, 1e-12), nan=np.inf).max())
        return least, tracking, observer, growth

    def _norms(self) -> tuple[Array, Array]:
        tracking = np.abs(self.xhat - self.s) / self.claims.v
        estimation = np.abs(self.x - self.xhat) / self.claims.v_observer
        return tracking.max(axis=(1, 2)), estimation.max(axis=(1, 2))

    def _received(self) -> Array:
        """Estimates of neighbours as they arrive: late or lost in the draws with delays."""
        late = self.memory[int(self.rng.integers(0, self.max_delay + 1))]
        fresh = np.where(self.delayed[:, None, None], late, self.xhat)
        lost = self.delayed[:, None, None] & (self.rng.random((self.draws, 1, 1)) < self.loss)
        self.last = np.where(lost, self.last, fresh)
        return self.last

    def _step(self) -> float:
        loop, agent = self.loop, self.loop.agent
        graph, d = self.graph, self.graph.d
        sign = -1.0 if loop.protocol == "printed" else 1.0
        received = self._received()
        w = graph.degree * self.xhat - graph.near(received) + sign * d * (self.xhat - self.s)
        u = loop.phi * w @ loop.K.T
        gains = self.rng.choice([agent.sector[0], agent.sector[1]], u.shape)
        push = (gains * u) @ agent.B.T
        e = self.x - self.xhat
        if loop.observer == "distributed":
            e = loop.mu * (graph.degree * e - graph.near(e) + d * e)
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
        self.memory = [self.xhat, *self.memory[:-1]]
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
