"""Refutation: one linear loop inside what a certificate covers, proved not to converge.

Every certificate covers ``sec(u) = g u`` with a constant g of the sector, and a g without slope. If
some symmetric P has ``TᵀPT ≻ s²P`` for the matrix T of one period, s ≥ 1, and ``zᵀPz > 0`` for some
z, then ``zᵀPz`` grows by s² in every period for ever, and no certificate of these gains can exist.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from fractions import Fraction

import attrs
import numpy as np

from posmas_fmi.certify.enclosure import matmul, middle, typed
from posmas_fmi.certify.flow import Flow
from posmas_fmi.certify.loop import Loop
from posmas_fmi.certify.proof import dyadic, identity, positive_definite
from posmas_fmi.expression import Array

LARGEST = 60  # states of the whole network up to which a refutation is looked for
_UP = 1 + 1e-9  # covers the rounding of a handful of norms
_SHARE = 0.7  # of the growth that is seen: what is proved of it


@attrs.frozen
class Divergence:
    """A loop that does not converge.

    Attributes
    ----------
    factor : float
        Proved growth per period, at least 1; without a period 1 as well.
    gain : float
        Constant gain of every input's nonlinearity.
    """

    factor: float
    gain: float

    def __str__(self) -> str:
        return (
            f"with sec(u) = {self.gain:.6g} u and a constant g the loop does not converge: a "
            f"quadratic function grows by {self.factor**2:.9g} in every period, exact rational"
        )


def divergence(loop: Loop, gain: Array, C_z: Array | None = None) -> Divergence | None:
    """Look for a constant gain of the sector with which the sampled tracking error diverges.

    Parameters
    ----------
    loop : Loop
        With a period.
    gain : (p, n) array
        Feedback of one agent, coupling included; with `C_z` the last columns act on integrals.
    C_z : (k, m) array, optional
        What is integrated.

    Returns
    -------
    Divergence or None
        None where nothing is refuted, or the network has more than `LARGEST` states.
    """
    n = loop.network.N
    if loop.period is None or n * gain.shape[1] > LARGEST:
        return None
    for g, T, loose in _periods(loop, gain, C_z):
        factor = growth(T, loose)
        if factor is not None:
            return Divergence(factor, g)
    return None


def _periods(loop: Loop, gain: Array, C_z: Array | None) -> Iterator[tuple[float, Array, float]]:
    """Gain, matrix of one period of the network, and a bound of what the matrix is off by."""
    h, agent = loop.period, loop.agent
    assert h is not None
    flow, _, held, _ = Flow(loop.A, loop.A).over(h)
    A, loose = middle(flow)
    B, loose_input = middle(matmul(held, typed(agent.B)))
    if not (np.isfinite(A).all() and np.isfinite(B).all()):
        return
    if C_z is not None:
        k = len(C_z)
        A = np.block([[A, np.zeros((agent.m, k))], [h * C_z, np.eye(k)]])
        B = np.vstack([B, np.zeros((k, agent.p))])
    M = loop.network.pinned_laplacian.toarray()
    size = float(np.linalg.norm(M) * np.linalg.norm(gain))
    for g in (agent.sector[1], agent.sector[0]):
        fed = np.kron(M, B @ gain)
        T = np.kron(np.eye(len(M)), A) + g * fed
        off = math.sqrt(len(M)) * loose + g * size * loose_input
        rounding = 1e-14 * (np.linalg.norm(T) + g * size * np.linalg.norm(B))
        yield g, T, float(off + rounding) * _UP


def growth(T: Array, loose: float = 0.0) -> float | None:
    """Prove that ``z⁺ = (T + E) z``, ``‖E‖ ≤ loose``, grows for some z; its factor per step.

    Examples
    --------
    >>> growth(np.diag([0.5, 1.2])) > 1.1
    True
    >>> growth(np.diag([0.5, 0.9])) is None
    True
    """
    from scipy.linalg import solve_discrete_lyapunov

    if not (np.isfinite(T).all() and math.isfinite(loose)):
        return None
    radius = float(np.abs(np.linalg.eigvals(T)).max())
    if not radius > 1 + 1e-9:
        return None
    factor = radius**_SHARE
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            P = solve_discrete_lyapunov((T / factor).T, -np.eye(len(T)))
    except (np.linalg.LinAlgError, RuntimeWarning, UserWarning):
        return None
    P = 0.5 * (P + P.T) / np.abs(P).max()
    start = np.linalg.eigh(P)[1][:, -1]
    exact, t, s = dyadic(P), dyadic(T), Fraction(factor)
    size = float(np.linalg.norm(P)) * (2 * float(np.linalg.norm(T)) + loose) * loose * _UP
    one = identity(len(T))
    grows = positive_definite(t.T @ exact @ t - s**2 * exact - Fraction(size) * one)
    z = dyadic(start)
    return factor if grows.positive and z @ exact @ z > 0 else None
