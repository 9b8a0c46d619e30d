"""The digraph of agents and its pinning. Orientation: a_ij > 0 iff agent i hears agent j."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import attrs
import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph as csgraph
import scipy.sparse.linalg as spla

from posmas_fmi.errors import NetworkError
from posmas_fmi.expression import Array

LARGEST = 1_000_000  # agents
DENSE_LIMIT = 2000  # agents up to which dense O(N³) algorithms are used
DIRECT_LIMIT = 300  # agents up to which a sparse factorisation is never too expensive


@attrs.frozen(eq=False)
class Network:
    """A digraph with pinning.

    Parameters
    ----------
    adjacency : (N, N) sparse array
        ``a_ij`` ≥ 0; row i lists whom agent i hears, so row sums are in-degrees.
    pinning : (N,) array_like
        ``d_i`` ≥ 0, positive for the pinned agents.
    names : tuple of str, optional
        Names of the agents, "1" to "N" by default.

    Raises
    ------
    NetworkError
        On wrong shapes, negative or non-finite weights, an arc from an agent to itself.

    Examples
    --------
    >>> ring = network_from_arcs(3, [(1, 2), (2, 3), (3, 1)], pinned=[1])
    >>> ring.pinned_laplacian.toarray()
    array([[ 2.,  0., -1.],
           [-1.,  1.,  0.],
           [ 0., -1.,  1.]])
    >>> ring.p
    array([3., 4., 5.])
    """

    adjacency: sp.csr_array
    pinning: Array
    names: tuple[str, ...] = ()

    def __attrs_post_init__(self) -> None:
        n = self.adjacency.shape[0]
        pinning = np.array(self.pinning, dtype=float)
        pinning.flags.writeable = False
        object.__setattr__(self, "pinning", pinning)
        adjacency = sp.csr_array(self.adjacency, dtype=float)
        adjacency.sum_duplicates()
        adjacency.eliminate_zeros()
        object.__setattr__(self, "adjacency", adjacency)
        names = self.names or tuple(str(k + 1) for k in range(n))
        object.__setattr__(self, "names", names)
        self._check(n)

    def _check(self, n: int) -> None:
        if n == 0 or self.adjacency.shape != (n, n):
            raise NetworkError(
                f"expected a square adjacency of at least one agent (got {self.adjacency.shape})",
                "$.network",
            )
        weights = self.adjacency.data
        if not (np.isfinite(weights).all() and (weights > 0).all()):
            raise NetworkError("expected finite weights > 0 on the arcs", "$.network.arcs")
        loops = np.flatnonzero(self.adjacency.diagonal())
        if loops.size:
            name = self.names[loops[0]]
            raise NetworkError(f"agent {name} has an arc to itself; leave it out", "$.network.arcs")
        if self.pinning.shape != (n,) or len(self.names) != n:
            raise NetworkError(
                f"expected {n} pinning weights and names "
                f"(got {self.pinning.shape} and {len(self.names)})",
                "$.network",
            )
        if not (np.isfinite(self.pinning).all() and (self.pinning >= 0).all()):
            raise NetworkError("expected finite pinning weights >= 0", "$.network.pinned")

    @property
    def N(self) -> int:
        """Number of agents."""
        return int(self.adjacency.shape[0])

    @cached_property
    def in_degree(self) -> Array:
        """Row sums of the adjacency, (N,)."""
        return np.asarray(self.adjacency.sum(axis=1)).ravel()

    @property
    def pinned(self) -> tuple[int, ...]:
        """Indices (from 0) of the pinned agents."""
        return tuple(int(i) for i in np.flatnonzero(self.pinning))

    @cached_property
    def laplacian(self) -> sp.csr_array:
        """``L = diag(in-degree) - adjacency``, (N, N)."""
        return sp.csr_array(sp.diags_array(self.in_degree) - self.adjacency)

    @cached_property
    def pinned_laplacian(self) -> sp.csr_array:
        """``L_p = L + D``, (N, N): a non-singular M-matrix iff the leader reaches every agent."""
        return sp.csr_array(self.laplacian + sp.diags_array(self.pinning))

    def unreached(self) -> tuple[int, ...]:
        """Return the indices (from 0) of the agents that no message of the leader can reach."""
        n = self.N
        # one more node for the leader; csgraph follows i -> j, messages go from heard to hearing
        heard_by = self.adjacency.T
        leader = sp.csr_array(self.pinning[None, :])
        graph = sp.block_array([[heard_by, None], [leader, sp.csr_array((1, 1))]], format="csr")
        order = csgraph.breadth_first_order(graph, n, return_predecessors=False)
        missing = np.ones(n + 1, dtype=bool)
        missing[order] = False
        return tuple(int(i) for i in np.flatnonzero(missing))

    def require_reached(self) -> None:
        """Raise NetworkError, with names, unless the leader reaches every agent."""
        missing = self.unreached()
        if missing:
            shown = ", ".join(self.names[i] for i in missing[:10])
            more = f" and {len(missing) - 10} more" if len(missing) > 10 else ""
            raise NetworkError(
                f"no path leads from the leader to agent(s) {shown}{more}; "
                "pin one of them or add an arc towards them",
                "$.network",
            )

    @cached_property
    def p(self) -> Array:
        """The vector with ``L_p p = 1``, (N,): positive; large where the leader is far.

        Raises
        ------
        NetworkError
            If an agent cannot be reached from the leader.
        """
        return self.solve(np.ones(self.N))

    def solve(self, b: Array) -> Array:
        """Solve ``L_p x = b``, (N,).

        Above `DIRECT_LIMIT` agents first by a Krylov method, which digraphs without structure
        suit and where a factorisation would fill up; what does not converge is factorised.

        Raises
        ------
        NetworkError
            If an agent cannot be reached from the leader.
        """
        self.require_reached()
        if self.N > DIRECT_LIMIT:
            x = _krylov(self.pinned_laplacian, b)
            if x is not None:
                return x
        return np.asarray(spla.spsolve(sp.csc_array(self.pinned_laplacian), b))

    @property
    def p_max(self) -> float:
        """Largest entry of `p`."""
        return float(self.p.max())

    @cached_property
    def strongly_connected(self) -> bool:
        """Whether every agent is reached from every other."""
        parts, _ = csgraph.connected_components(self.adjacency, directed=True, connection="strong")
        return bool(parts == 1)

    @cached_property
    def perron(self) -> Array:
        """The left null vector f of L with ``f > 0`` and sum 1, (N,) (Definition 2 of the paper).

        Grassmann-Taksar-Heyman elimination up to `DENSE_LIMIT` agents, power iteration beyond;
        neither subtracts, so small entries keep their relative accuracy.

        Raises
        ------
        NetworkError
            If the digraph is not strongly connected.
        """
        if not self.strongly_connected:
            raise NetworkError(
                "the left eigenvector f is positive only on a strongly connected digraph; "
                "use the contraction design, which does not need it",
                "$.network.arcs",
            )
        if self.N <= DENSE_LIMIT:
            return _gth(self.adjacency.toarray())
        return _power_iteration(self.adjacency, self.in_degree)

    @cached_property
    def algebraic_connectivity(self) -> float:
        """Generalised algebraic connectivity a(L) of (4)."""
        return generalised_connectivity(self.laplacian, self.perron)

    def arc_numbers(self) -> dict[tuple[int, int], int]:
        """Return the number of each arc (from, to), agents counted from 1 and the leader being 0.

        Arcs between agents are numbered by receiver, those from the leader come after them.

        Examples
        --------
        >>> network_from_arcs(2, [(1, 2), (2, 1)], pinned=[2]).arc_numbers()
        {(2, 1): 0, (1, 2): 1, (0, 2): 2}
        """
        a = self.adjacency
        receiver = np.repeat(np.arange(self.N), np.diff(a.indptr))
        numbers = {
            (int(j) + 1, int(i) + 1): k
            for k, (j, i) in enumerate(zip(a.indices, receiver, strict=True))
        }
        return numbers | {(0, i + 1): a.nnz + k for k, i in enumerate(self.pinned)}

    def with_pinned(self, pinned: Sequence[int], weight: float = 1.0) -> Network:
        """Return the same digraph with other pinned agents (indices from 0)."""
        d = np.zeros(self.N)
        d[list(pinned)] = weight
        return attrs.evolve(self, pinning=d)


def _krylov(L_p: sp.csr_array, b: Array, iterations: int = 60) -> Array | None:
    """Solution by BiCGSTAB with the diagonal as preconditioner; None if it did not converge."""
    diagonal = L_p.diagonal()
    scaling = spla.LinearOperator(L_p.shape, lambda x: x / diagonal)
    size = float(np.abs(b).max())
    x, residual = np.zeros_like(b), b
    for _ in range(4):  # the method's own residual drifts: correct by the true one
        with np.errstate(all="ignore"):
            step, _ = spla.bicgstab(L_p, residual, rtol=1e-12, maxiter=iterations, M=scaling)
            following = b - L_p @ (x + step)
        if not np.abs(following).max() < 0.1 * np.abs(residual).max():
            break
        x, residual = x + step, following
        if np.abs(residual).max() <= 1e-10 * size:
            break
    return np.asarray(x) if np.abs(residual).max() <= 1e-6 * size else None


def generalised_connectivity(M: Any, f: Array) -> float:
    """Minimum of ``xᵀ M̂ x / xᵀ Γ x`` over x orthogonal to f, (4) of the paper.

    Parameters
    ----------
    M : (N, N) array or sparse array
        L, or what the paper puts in its place.
    f : (N,) array
        Left Perron vector.

    Returns
    -------
    float
    """
    import scipy.linalg

    dense = M.toarray() if sp.issparse(M) else np.asarray(M)
    weighted = f[:, None] * dense
    symmetric = 0.5 * (weighted + weighted.T)
    basis = scipy.linalg.null_space(f[None, :])
    numerator, denominator = basis.T @ symmetric @ basis, basis.T @ (f[:, None] * basis)
    return float(scipy.linalg.eigh(numerator, denominator, eigvals_only=True)[0])


def _gth(adjacency: Array) -> Array:
    """Stationary vector of the Laplacian's transpose by elimination without subtraction."""
    rates = adjacency.copy()
    n = len(rates)
    for k in range(n - 1, 0, -1):
        rates[:k, k] /= rates[k, :k].sum()
        rates[:k, :k] += np.outer(rates[:k, k], rates[k, :k])
    f = np.ones(n)
    for k in range(1, n):
        f[k] = f[:k] @ rates[:k, k]
    return np.asarray(f / f.sum())


def _power_iteration(adjacency: sp.csr_array, in_degree: Array) -> Array:
    # no eigenvalue of a step near -1: there rounding errors of either sign would not die out
    speed = 1.5 * in_degree.max()
    step = sp.csr_array((adjacency.T + sp.diags_array(speed - in_degree)) / speed)
    f = np.full(len(in_degree), 1.0 / len(in_degree))
    for _ in range(1_000_000):
        following = step @ f
        following /= following.sum()
        if np.abs(following - f).max() <= 1e-15 * following.max():
            return np.asarray(following)
        f = following
    raise NetworkError("the power iteration for f did not settle", "$.network.arcs")


def network_from_arcs(
    agents: int,
    arcs: Sequence[Sequence[float]],
    pinned: Sequence[int] | Mapping[int, float] = (),
    names: Sequence[str] = (),
) -> Network:
    """Build a network from arcs between agents numbered from 1.

    Parameters
    ----------
    agents : int
        N.
    arcs : sequence of (from, to) or (from, to, weight)
        "from" is heard by "to".
    pinned : sequence of int, or mapping of int to float
        Numbers of the pinned agents, or their weights.
    names : sequence of str, optional

    Returns
    -------
    Network

    Raises
    ------
    NetworkError
        Naming the arc or the pin that is wrong.

    Examples
    --------
    >>> network_from_arcs(2, [(1, 3)])
    Traceback (most recent call last):
        ...
    posmas_fmi.errors.NetworkError: $.network.arcs[0]: expected agents from 1 to 2 (got 3)
    """
    if agents < 1:
        raise NetworkError(f"expected at least one agent (got {agents})", "$.network.agents")
    check_size(agents, "$.network.agents")
    table = np.ones((len(arcs), 3))
    for k, arc in enumerate(arcs):
        if len(arc) not in (2, 3):
            raise NetworkError(
                f"expected [from, to] or [from, to, weight] (got {list(arc)})",
                f"$.network.arcs[{k}]",
            )
        table[k, : len(arc)] = arc
    _check_arcs(table, agents)
    d = np.zeros(agents)
    weights = pinned if isinstance(pinned, Mapping) else dict.fromkeys(pinned, 1.0)
    for k, (agent, weight) in enumerate(weights.items()):
        if not 1 <= agent <= agents:
            raise NetworkError(
                f"expected agents from 1 to {agents} (got {agent})", f"$.network.pinned[{k}]"
            )
        d[agent - 1] = weight
    row, column = table[:, 1].astype(int) - 1, table[:, 0].astype(int) - 1
    adjacency = sp.csr_array((table[:, 2], (row, column)), shape=(agents, agents))
    return Network(adjacency, d, tuple(names))


def check_size(agents: int, where: str) -> None:
    """Raise NetworkError for more agents than `LARGEST`, before anything as long is made."""
    if agents > LARGEST:
        raise NetworkError(f"expected at most {LARGEST} agents (got {str(agents)[:20]})", where)


def _check_arcs(table: Array, agents: int) -> None:
    ends = table[:, :2]
    bad = np.argwhere(~((ends >= 1) & (ends <= agents) & (ends == np.floor(ends))))
    if bad.size:
        k, end = bad[0]
        raise NetworkError(
            f"expected agents from 1 to {agents} (got {ends[k, end]:g})", f"$.network.arcs[{k}]"
        )
    loops = np.flatnonzero(ends[:, 0] == ends[:, 1])
    if loops.size:
        raise NetworkError(
            f"agent {ends[loops[0], 0]:g} has an arc to itself; leave it out",
            f"$.network.arcs[{loops[0]}]",
        )
    keys = ends[:, 0] * (agents + 1) + ends[:, 1]
    _, first = np.unique(keys, return_index=True)
    if len(first) < len(keys):
        repeated = sorted(set(range(len(keys))) - set(first.tolist()))[0]
        a, b = ends[repeated]
        raise NetworkError(
            f"the arc from {a:g} to {b:g} is there twice; give one with a weight",
            f"$.network.arcs[{repeated}]",
        )
