"""The protocol: equation (6) for the input and (5) or (22) for the innovation of the observer."""

from __future__ import annotations

from typing import Any, Literal

import attrs
import numpy as np
import scipy.sparse as sp

from posmas_fmi.expression import Array
from posmas_fmi.network import Network


@attrs.frozen(eq=False)
class Protocol:
    """What each agent computes from its own estimate and from what it has received.

    Arcs are numbered in the order of the rows of the adjacency: all that agent 1 hears, then all
    that agent 2 hears, and so on.

    Parameters
    ----------
    K : (p, m) array
        Feedback gain, non-positive.
    E : (m, q) array
        Observer gain.
    own : (N,) array
        Weight of the own estimate in (6), φ included.
    heard : (N, arcs) sparse array
        Weights of the estimates received over each arc in (6).
    leader : (N,) array
        Weight of the leader in (6): zero unless pinned.
    own_innovation : (N,) array
        Weight of the own innovation ``y_i - C x̂_i`` in the observer.
    heard_innovation : (N, arcs) sparse array
        Weights of the innovations received.

    Examples
    --------
    >>> from posmas_fmi.network import network_from_arcs
    >>> pair = network_from_arcs(2, [(1, 2), (2, 1)], pinned=[1])
    >>> protocol = make_protocol(pair, K=[[-1.0]], E=[[1.0]], phi=2.0)
    >>> protocol.control(np.array([[3.0], [1.0]]), np.array([[1.0], [3.0]]), np.array([1.0]))
    array([[-8.],
           [ 4.]])
    """

    K: Array
    E: Array
    own: Array
    heard: sp.csr_array
    leader: Array
    own_innovation: Array
    heard_innovation: sp.csr_array

    def control(self, xhat: Array, received: Array, s: Array) -> Array:
        """Equation (6), the input of each agent.

        Parameters
        ----------
        xhat : (N, m) array
            Own estimates.
        received : (arcs, m) array
            The estimate that last came over each arc.
        s : (m,) or (N, m) array
            The leader, as each agent knows it.

        Returns
        -------
        (N, p) array
        """
        disagreement = self.own[:, None] * xhat - self.heard @ received - self.leader[:, None] * s
        return np.asarray(disagreement @ self.K.T)

    def injection(self, innovation: Array, received: Array) -> Array:
        """Return the observer's correction ``E(…)`` of (5) or (22).

        Parameters
        ----------
        innovation : (N, q) array
            ``y_i - C x̂_i``.
        received : (arcs, q) array
            The innovation that last came over each arc.

        Returns
        -------
        (N, m) array
        """
        weighted = self.own_innovation[:, None] * innovation - self.heard_innovation @ received
        return np.asarray(weighted @ self.E.T)


def make_protocol(
    network: Network,
    K: Any,
    E: Any,
    phi: float,
    mu: float = 1.0,
    observer: Literal["local", "distributed"] = "local",
    form: Literal["corrected", "printed"] = "corrected",
) -> Protocol:
    """Set the weights of section 3 of the theory, or those that the paper prints.

    Parameters
    ----------
    network : Network
    K : (p, m) array_like
    E : (m, q) array_like
    phi, mu : float
        Coupling intensities of the controller and of the distributed observer.
    observer : {"local", "distributed"}
        (5) or (22).
    form : {"corrected", "printed"}
        Printed: the pinning term of (6) with the opposite sign (erratum 1), and (22) with the
        opposite sign and the neighbours weighted by ``d_i`` (erratum 2).

    Returns
    -------
    Protocol
    """
    a, d, degree = network.adjacency, network.pinning, network.in_degree
    toward_leader = d if form == "corrected" else -d
    if observer == "local":
        own_innovation, row_weight = np.ones(network.N), np.zeros(network.N)
    elif form == "corrected":
        own_innovation, row_weight = mu * (degree + d), np.full(network.N, mu)
    else:
        own_innovation, row_weight = -mu * d * (1.0 + degree), -mu * d
    by_arc = sp.csr_array((a.data, np.arange(a.nnz), a.indptr), shape=(network.N, a.nnz))
    return Protocol(
        K=np.asarray(K, dtype=float),
        E=np.asarray(E, dtype=float),
        own=phi * (degree + toward_leader),
        heard=phi * by_arc,
        leader=phi * toward_leader,
        own_innovation=own_innovation,
        heard_innovation=sp.csr_array(sp.diags_array(row_weight) @ by_arc),
    )
