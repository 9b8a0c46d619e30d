"""Random digraphs inside what one certificate S covers: no larger p, no larger (L_p)_ii."""

from __future__ import annotations

import attrs
import numpy as np

from posmas_fmi.expression import Array

_TRIES = 200  # rounds of proposals, each closer to agents that hear the leader alone
_SLACK = 1e-12  # relative rounding of the bounds


@attrs.frozen(eq=False)
class Digraphs:
    """Digraphs with the same number of agents.

    Attributes
    ----------
    adjacency : (draws, N, N) array
        ``a_ij``: how much agent i hears agent j.
    pinning : (draws, N) array
    p : (draws, N) array
        Solutions of ``L_p p = 1``.
    """

    adjacency: Array
    pinning: Array
    p: Array

    @property
    def N(self) -> int:
        """Number of agents of each digraph."""
        return int(self.adjacency.shape[1])

    @property
    def degree(self) -> Array:
        """``(L_p)_ii`` without the pinning, (draws, N, 1)."""
        return np.asarray(self.adjacency.sum(axis=2)[:, :, None])

    @property
    def d(self) -> Array:
        """Pinning, (draws, N, 1)."""
        return self.pinning[:, :, None]


def draw_digraphs(
    agents: int, p_max: float, degree: float, draws: int, rng: np.random.Generator
) -> Digraphs:
    """Draw digraphs with pins: ``p ≤ p_max``, ``(L_p)_ii ≤ degree`` (then ``p_i ≥ 1/degree``).

    Both bounds hold to 1e-12.

    Density, number of pins and weights vary from draw to draw. A third of the draws lies on the
    bound of p, a third on that of the degree: where a wrong certificate would show first.

    Raises
    ------
    ValueError
        If ``p_max·degree < 1``, when no digraph is that close to its leader, or none was found.

    Examples
    --------
    >>> found = draw_digraphs(4, 5.0, 2.0, 100, np.random.default_rng(0))
    >>> round(float(found.p.max()), 9), round(float((found.degree + found.d).max()), 9)
    (5.0, 2.0)
    """
    if p_max * degree < 1 - _SLACK:
        raise ValueError(f"no digraph has p <= {p_max:g} with (L_p)_ii <= {degree:g}")
    parts: list[Digraphs] = []
    missing, pinned = draws, 0.0
    for _ in range(_TRIES):
        adjacency, d = _propose(agents, degree, missing, pinned, rng)
        p = _distance(adjacency, d)
        kept = np.flatnonzero(p.max(axis=1) <= p_max * (1 + _SLACK))
        # L_p may be scaled down until p meets its bound: L_p/c has the solution c·p
        room = np.maximum(1.0, p_max / p[kept].max(axis=1))
        where = rng.choice([0.0, 1.0, 2.0], len(kept))
        share = np.where(where < 2, where, rng.random(len(kept)))
        c = (1 + (room - 1) * share)[:, None]
        parts.append(Digraphs(adjacency[kept] / c[:, :, None], d[kept] / c, p[kept] * c))
        missing -= len(kept)
        if missing == 0:
            break
        pinned = 0.5 * (1 + pinned)  # closer to the leader next time
    else:
        raise ValueError(f"found too few digraphs with p <= {p_max:g}, (L_p)_ii <= {degree:g}")
    return Digraphs(
        np.concatenate([x.adjacency for x in parts]),
        np.concatenate([x.pinning for x in parts]),
        np.concatenate([x.p for x in parts]),
    )


def _propose(
    agents: int, degree: float, draws: int, pinned: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Adjacency and pinning with every (L_p)_ii at most `degree`, one of them equal to it."""
    shape = (draws, agents, agents)
    density = (1 - pinned) * rng.random((draws, 1, 1))
    weights = np.where(rng.random((draws, 1, 1)) < 0.5, 1.0, rng.uniform(0.05, 1.0, shape))
    adjacency = weights * (rng.random(shape) < density) * ~np.eye(agents, dtype=bool)
    share = pinned + (1 - pinned) * rng.random((draws, 1))
    d = (rng.random((draws, agents)) < share) * rng.uniform(0.2, 1.0, (draws, 1))
    d[np.arange(draws), rng.integers(0, agents, draws)] = 1.0
    own = adjacency.sum(axis=2) + d
    # an agent that hears nobody stays unreached, and its draw is refused later
    even = rng.random((draws, 1)) < 0.5
    scale = degree / np.where(even, own.max(axis=1, keepdims=True), np.maximum(own, 1e-9))
    return adjacency * scale[:, :, None], d * scale


def _distance(adjacency: Array, d: Array) -> Array:
    """``p`` of every draw; infinite where the leader does not reach every agent."""
    agents = d.shape[1]
    reached = d > 0
    for _ in range(agents):
        reached = reached | ((adjacency > 0) & reached[:, None, :]).any(axis=2)
    p = np.full(d.shape, np.inf)
    held = reached.all(axis=1)
    own = adjacency.sum(axis=2) + d
    L_p = own[:, :, None] * np.eye(agents) - adjacency
    p[held] = np.linalg.solve(L_p[held], np.ones((int(held.sum()), agents, 1)))[:, :, 0]
    return np.where(p > 0, p, np.inf)
