"""The graph scalar γ₀ of route L: the diagonals Θ and T that prove the most for a network."""

from __future__ import annotations

import numpy as np

from posmas_fmi.certify.quadratic import GraphScalar, diagonal_scalar, graph_proof
from posmas_fmi.design.solver import cvxpy, feasible
from posmas_fmi.errors import DesignError
from posmas_fmi.expression import Array
from posmas_fmi.network import Network

_DENSE_AGENTS = 60  # beyond this the diagonal scaling is fixed and only one number is searched
_BISECTIONS = 40
_SAFETY = 1e-5  # relative distance of the proved scalar from its optimum


def graph_scalar(network: Network, sector: tuple[float, float]) -> GraphScalar:
    """Largest γ₀ for which diagonal Θ, T ≻ 0 are found, and its proof.

    Examples
    --------
    >>> from posmas_fmi.network import network_from_arcs
    >>> one = network_from_arcs(1, [], [1])
    >>> round(graph_scalar(one, (1.0, 1.0)).value, 3)
    2.0
    """
    M = network.pinned_laplacian
    eta = network.p
    xi = np.asarray(
        network.p if (abs(M - M.T)).nnz == 0 else np.linalg.solve(M.toarray().T, np.ones(network.N))
    )
    Theta = xi / eta
    Theta = Theta / Theta.mean()
    found = _search_scaling(network, sector, Theta)
    if network.N <= _DENSE_AGENTS:
        found = _bisect(network, sector, found)
    value, Theta, T = found
    for step in (_SAFETY, 1e-3, 1e-2, 1e-1):
        gamma = value - step * abs(value) - 1e-12
        proof = graph_proof(network, sector, gamma, Theta, T)
        if proof.positive:
            return diagonal_scalar(network, sector, gamma, Theta, T, proof)
    raise DesignError("no graph scalar could be proved for this network", "$.network")


def _search_scaling(
    network: Network, sector: tuple[float, float], Theta: Array
) -> tuple[float, Array, Array]:
    """Line search over T = tΘ for a fixed Θ."""
    from scipy.linalg import eigh
    from scipy.optimize import minimize_scalar

    M = network.pinned_laplacian.toarray()
    mean, half = 0.5 * (sector[1] + sector[0]), 0.5 * (sector[1] - sector[0])
    weighted = Theta[:, None] * M
    first, second = mean * (weighted + weighted.T), half**2 * (M.T @ weighted)

    def gamma(log_t: float) -> float:
        t = np.exp(log_t)
        scaled = first - t * second - np.diag(Theta) / t
        return float(eigh(scaled, np.diag(Theta), eigvals_only=True, subset_by_index=[0, 0])[0])

    best = minimize_scalar(lambda x: -gamma(x), bounds=(-15.0, 15.0), method="bounded")
    return gamma(best.x), Theta, np.exp(best.x) * Theta


def _bisect(
    network: Network, sector: tuple[float, float], start: tuple[float, Array, Array]
) -> tuple[float, Array, Array]:
    """Bisection over γ with free Θ and T."""
    cp = cvxpy()
    M = network.pinned_laplacian.toarray()
    n = network.N
    mean, half = 0.5 * (sector[1] + sector[0]), 0.5 * (sector[1] - sector[0])
    theta, t, slack = cp.Variable(n, pos=True), cp.Variable(n, pos=True), cp.Variable()
    gamma = cp.Parameter()
    D, S = cp.diag(theta), cp.diag(t)
    scaled = cp.Variable(n)  # γθ, so that the program stays affine in the parameter
    top = mean * (D @ M + M.T @ D) - half**2 * (M.T @ S @ M) - cp.diag(scaled)
    block = cp.bmat([[top, D], [D, S]])
    constraints = [
        block >> slack * np.eye(2 * n),
        cp.sum(theta) == n,
        scaled == gamma * theta,
        theta >= 1e-9,
        slack <= 1,
    ]
    program = cp.Problem(cp.Maximize(slack), constraints)
    value, Theta, T = start
    low, high = value, value + max(1.0, 2 * mean * float(np.abs(M).sum(axis=1).max()))
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        gamma.value = middle
        if feasible(program, slack):
            low, value, Theta, T = middle, middle, theta.value, t.value
        else:
            high = middle
        if high - low < 1e-5 * max(abs(high), 1e-3):
            break
    return value, Theta, T
