"""Agents' weights: ν > 0 with L_p ν ≥ λ ν, which says how strongly the leader holds the network.

``λ = min_i (L_p ν)_i/ν_i`` is positive for some ν exactly when L_p is a non-singular M-matrix. The
weights p of ``L_p p = 1`` give ``λ = 1/p_max``; the Perron vector of L_p gives the largest λ, its
smallest eigenvalue. Both come from solves with one sparse factorisation; the bound on λ is a
matrix-vector product with its rounding error bounded, and holds whatever the solver did.
"""

from __future__ import annotations

import attrs
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from posmas_fmi.certify.proof import UNIT
from posmas_fmi.expression import Array
from posmas_fmi.network import DIRECT_LIMIT, Network

_STEPS = 200  # of inverse iteration; the bound holds after any number of them


@attrs.frozen(eq=False)
class Weights:
    """Positive weights of the agents.

    Attributes
    ----------
    nu : (N,) array
    rate : float
        Proved lower bound of λ.
    weakest : str
        The agent where it is attained.
    """

    nu: Array
    rate: float
    weakest: str


def bounded(network: Network, nu: Array, label: str) -> Weights:
    """Prove λ for given weights ν > 0.

    Raises
    ------
    ValueError
        If ν is not positive.
    """
    if not (np.isfinite(nu).all() and (nu > 0).all()):
        raise ValueError("weights must be positive")
    L_p = network.pinned_laplacian
    value = L_p @ nu
    terms = int(np.diff(L_p.indptr).max(initial=0)) + 1
    # decimal weights, the sum on the diagonal, products, additions: (2·terms + 4) roundings each
    error = (2 * terms + 4) * UNIT * 1.01 * (abs(L_p) @ nu)
    ratio = (value - error) / nu * (1 - 4 * UNIT * np.sign(value - error))
    i = int(ratio.argmin())
    where = f"agent {network.names[i]} ({label} {nu[i]:.6g})"
    return Weights(nu, float(ratio[i]), where)


def p_weights(network: Network) -> Weights:
    """Weights p with ``L_p p = 1``.

    Examples
    --------
    >>> from posmas_fmi.network import network_from_arcs
    >>> chain = network_from_arcs(3, [(1, 2), (2, 3)], pinned=[1])
    >>> round(p_weights(chain).rate, 12)
    0.333333333333
    """
    return bounded(network, network.p, "p =")


def perron_weights(network: Network) -> Weights:
    """Weights with the largest λ: inverse iteration from p, kept positive.

    Where the digraph is not strongly connected the iteration tends to a vector with zeros: it
    stops at the best λ that is proved on the way.
    """
    solve = network.solve
    if network.N <= DIRECT_LIMIT:
        network.require_reached()
        solve = spla.splu(sp.csc_array(network.pinned_laplacian)).solve
    best = p_weights(network)
    nu, gained = best.nu, 0.0
    enough = 1e-13 if network.N <= DIRECT_LIMIT else 1e-6  # a step costs a large solve there
    for _ in range(_STEPS if network.N <= 2000 else 10):
        nu = solve(nu)
        nu = nu / nu.max()
        if not (nu > 1e-12).all():
            break
        tried = bounded(network, nu, "weight")
        gained, best = tried.rate - best.rate, tried if tried.rate > best.rate else best
        if gained < enough * abs(best.rate):
            break
    return best
