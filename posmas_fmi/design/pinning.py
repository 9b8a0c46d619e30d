"""Pin placement: which k agents should hear the leader, so that nobody is far from it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from typing import Any

import attrs
import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph

from posmas_fmi.errors import NetworkError
from posmas_fmi.network import DENSE_LIMIT, Network

Indices = np.ndarray[Any, np.dtype[np.intp]]

EXHAUSTIVE = 5000  # choices up to which all are tried,
OPERATIONS = 2e9  # if their solves together need no more floating-point operations than this
CANDIDATES = 16  # agents looked at in each step of the greedy choice on large networks
EXCHANGES = 3  # rounds of taking each pin out and placing it anew


@attrs.frozen
class Placement:
    """A choice of pinned agents and what it is worth.

    Attributes
    ----------
    pinned : tuple of int
        Indices from 0.
    p_max : float
        Largest entry of p, ``L_p p = 1``: the smaller, the faster the certified rate can be.
    lower_bound : float
        No choice of as many agents has a smaller p_max.
    worst : float or None
        p_max of the worst choice that reaches everybody, where all choices were tried.
    method : {"exhaustive", "greedy"}
    """

    pinned: tuple[int, ...]
    p_max: float
    lower_bound: float
    worst: float | None
    method: str

    def note(self, names: Sequence[str]) -> str:
        """Say in one sentence what was chosen and what the choice is worth."""
        chosen = ", ".join(names[i] for i in self.pinned)
        text = f"pinned by the design: {chosen}, with p_max = {self.p_max:.4g}"
        if self.worst is not None:
            return f"{text}, the best of all choices (the worst reaches {self.worst:.4g})"
        over = self.p_max / self.lower_bound - 1
        return f"{text}, at most {over:.0%} above the best possible ({self.method} choice)"


def place(network: Network, count: int) -> Placement:
    """Choose agents to pin, each with weight 1, so that ``p_max`` is small.

    Every choice is tried where there are few; else agents are added one by one, each time the one
    that lowers p_max most, and then each is exchanged while that helps.

    The bound: on a component that hears nobody outside, ``fᵀ L = 0`` with f of sum 1 gives
    ``Σ f_j d_j p_j = 1``, so p_max is at least ``1 / Σ f_j`` over the agents pinned there.

    Parameters
    ----------
    network : Network
        Its own pinning is not looked at.
    count : int
        How many agents to pin.

    Returns
    -------
    Placement

    Raises
    ------
    NetworkError
        If so few agents cannot reach all others.

    Examples
    --------
    >>> from posmas_fmi.network import network_from_arcs
    >>> path = network_from_arcs(3, [(1, 2), (2, 1), (2, 3), (3, 2)])
    >>> place(path, 1).pinned
    (1,)
    """
    if not 1 <= count <= network.N:
        raise NetworkError(f"expected 1 to {network.N} pins (got {count})", "$.network.pinned")
    roots = root_components(network)
    if len(roots) > count:
        example = ", ".join(network.names[int(root[0])] for root in roots[:10])
        raise NetworkError(
            f"expected at least {len(roots)} pins (got {count}): so many groups of agents hear "
            f"nobody outside, one agent of each: {example}",
            "$.network.pinned",
        )
    bound = _lower_bound(network, roots, count)
    choices = math.comb(network.N, count)
    if choices <= EXHAUSTIVE and choices * network.N**3 <= OPERATIONS:
        return _exhaustive(network, count, bound)
    if network.N <= DENSE_LIMIT:
        choice = _Dense(network)
        pinned = _exchange(choice, network, _greedy(choice, roots, count))
    else:
        pinned = _greedy(_Sparse(network), roots, count)
    return Placement(tuple(sorted(pinned)), _p_max(network, pinned), bound, None, "greedy")


def root_components(network: Network) -> list[Indices]:
    """Strongly connected groups of agents that hear nobody outside: each needs a pin.

    Examples
    --------
    >>> from posmas_fmi.network import network_from_arcs
    >>> [group.tolist() for group in root_components(network_from_arcs(3, [(1, 3), (2, 3)]))]
    [[0], [1]]
    """
    a = sp.coo_array(network.adjacency)
    count, label = csgraph.connected_components(a, directed=True, connection="strong")
    hears_outside = np.zeros(count, dtype=bool)
    hears_outside[label[a.row[label[a.row] != label[a.col]]]] = True
    return [np.flatnonzero(label == k) for k in np.flatnonzero(~hears_outside)]


def _lower_bound(network: Network, roots: list[Indices], count: int) -> float:
    """Bound p_max from below: even if all pins that can be spared are in one root component."""
    spare = count - len(roots)
    bounds = []
    for root in roots:
        part = sp.csr_array(network.adjacency[root][:, root])
        f = Network(part, np.zeros(len(root))).perron if len(root) > 1 else np.ones(1)
        bounds.append(1.0 / np.sort(f)[::-1][: 1 + spare].sum())
    return float(max(bounds))


def _p_max(network: Network, pinned: Iterable[int]) -> float:
    chosen = network.with_pinned(tuple(pinned))
    return chosen.p_max if not chosen.unreached() else math.inf


def _exhaustive(network: Network, count: int, bound: float) -> Placement:
    laplacian = network.laplacian.toarray()
    ones = np.ones(network.N)
    reach = _reached_from(network)
    best, best_value, worst = None, math.inf, 0.0
    for pinned in itertools.combinations(range(network.N), count):
        if not reach[list(pinned)].any(axis=0).all():
            continue
        M = laplacian.copy()
        M[pinned, pinned] += 1.0
        value = float(np.linalg.solve(M, ones).max())
        worst = max(worst, value)
        if value < best_value * (1 - 1e-12):  # the first of equals
            best, best_value = pinned, value
    assert best is not None
    return Placement(best, best_value, min(bound, best_value), worst, "exhaustive")


def _reached_from(network: Network) -> np.ndarray[tuple[int, int], np.dtype[np.bool_]]:
    """Row i: whom messages of agent i can reach, itself included."""
    distance = csgraph.shortest_path(network.adjacency.T, unweighted=True)
    return np.asarray(np.isfinite(distance))


class _Dense:
    """Tries every agent as the next pin, by one inverse and rank-one updates of it."""

    def __init__(self, network: Network) -> None:
        self.laplacian = network.laplacian.toarray()

    def first(self, root: Indices) -> int:
        """Best single pin inside a root component."""
        part = self.laplacian[np.ix_(root, root)].copy()
        part[0, 0] += 1.0
        W = np.linalg.inv(part)
        # move the pin from the first agent to j: two rank-one updates, all j at once
        values = [math.inf] * len(root)
        p = W.sum(axis=1)
        for j in range(len(root)):
            if j == 0:
                values[0] = p.max()
                continue
            plus = W - np.outer(W[:, j], W[j]) / (1.0 + W[j, j])
            gap = 1.0 - plus[0, 0]
            if gap > 1e-12:
                moved = plus.sum(axis=1) + plus[:, 0] * plus[0].sum() / gap
                values[j] = float(moved.max())
        return int(root[int(np.argmin(values))])

    def next(self, pinned: list[int]) -> int:
        """Best agent to add."""
        M = self.laplacian.copy()
        M[pinned, pinned] += 1.0
        W = np.linalg.inv(M)
        p = W.sum(axis=1)
        # Sherman-Morrison: p of one more pin at j is p - W_j p_j / (1 + W_jj), for every j at once
        after = p[:, None] - W * (p / (1.0 + np.diag(W)))[None, :]
        value = after.max(axis=0)
        value[pinned] = math.inf
        return int(value.argmin())


class _Sparse:
    """Tries a few promising agents as the next pin, by sparse solves."""

    def __init__(self, network: Network) -> None:
        self.network = network

    def first(self, root: Indices) -> int:
        """Pin of largest Perron weight: it attains the lower bound at the pin itself."""
        if len(root) == 1:
            return int(root[0])
        part = sp.csr_array(self.network.adjacency[root][:, root])
        f = Network(part, np.zeros(len(root))).perron
        promising = root[np.argsort(-f)[:CANDIDATES]]
        inside = Network(part, np.zeros(len(root)))
        place_of = {int(agent): k for k, agent in enumerate(root)}
        return min(
            (int(agent) for agent in promising),
            key=lambda agent: _p_max(inside, [place_of[agent]]),
        )

    def next(self, pinned: list[int]) -> int:
        """Best among the agents that are farthest from the leader and those that they hear."""
        network = self.network.with_pinned(pinned)
        p = network.p
        far = np.argsort(-p)[: CANDIDATES // 2]
        heard = network.adjacency[far].sum(axis=0)
        upstream = np.argsort(-np.asarray(heard).ravel() * p)[: CANDIDATES // 2]
        best, best_value = -1, math.inf
        for j in dict.fromkeys([*far.tolist(), *upstream.tolist()]):
            if j in pinned:
                continue
            unit = np.zeros(network.N)
            unit[j] = 1.0
            column = network.solve(unit)
            value = float((p - column * (p[j] / (1.0 + column[j]))).max())
            if value < best_value:
                best, best_value = j, value
        return best


def _greedy(choice: _Dense | _Sparse, roots: list[Indices], count: int) -> list[int]:
    pinned = [choice.first(root) for root in roots]
    while len(pinned) < count:
        pinned.append(choice.next(pinned))
    return pinned


def _exchange(choice: _Dense, network: Network, pinned: list[int]) -> list[int]:
    """Take out one pin after the other and place it anew, while that lowers p_max."""
    best, best_value = pinned, _p_max(network, pinned)
    for _ in range(EXCHANGES):
        before = best_value
        for pin in list(best):
            rest = [j for j in best if j != pin]
            if not rest or network.with_pinned(rest).unreached():
                continue
            tried = [*rest, choice.next(rest)]
            value = _p_max(network, tried)
            if value < best_value * (1 - 1e-9):
                best, best_value = tried, value
        if best_value >= before:
            break
    return best
