"""The protocol in continuous time, by scipy: the oracle that the sampled loop tends to."""

from __future__ import annotations

from typing import Any

import numpy as np

from posmas_fmi.agent import Agent
from posmas_fmi.expression import Array
from posmas_fmi.network import Network
from posmas_fmi.protocol import Protocol


def continuous(
    agent: Agent,
    network: Network,
    protocol: Protocol,
    x0: Array,
    xhat0: Array,
    s0: Array,
    times: Array,
    rtol: float = 1e-10,
) -> dict[str, Array]:
    """Integrate plant (1), observer (5) or (25), input (6) and leader (3) together.

    Parameters
    ----------
    agent, network, protocol
        As for `posmas_fmi.cosim.master.System`.
    x0, xhat0 : (N, m) array
    s0 : (m,) array
    times : (T,) array
        Where to evaluate [s]; starts at 0.
    rtol : float

    Returns
    -------
    dict of str to array
        ``x`` and ``xhat`` (T, N, m), ``s`` (T, m).

    Examples
    --------
    >>> from posmas_fmi.agent import linear_agent
    >>> from posmas_fmi.protocol import make_protocol
    >>> from posmas_fmi.network import network_from_arcs
    >>> agent, one = linear_agent([[-1.0]], [[1.0]], [[1.0]]), network_from_arcs(1, [], [1])
    >>> protocol = make_protocol(one, K=[[-1.0]], E=[[0.0]], phi=1.0)
    >>> x0, xhat0, s0 = np.zeros((1, 1)), np.ones((1, 1)), np.zeros(1)
    >>> run = continuous(agent, one, protocol, x0, xhat0, s0, np.array([0.0, 1.0]))
    >>> run["xhat"][-1].round(6)  # exp(-2)
    array([[0.135335]])
    """
    from scipy.integrate import solve_ivp

    n, m = x0.shape
    senders = network.adjacency.indices

    def rhs(t: float, flat: Array) -> Array:
        x, xhat, s = _split(flat, n, m)
        innovation = (x - xhat) @ agent.C.T
        U = protocol.control(xhat, xhat[senders], s)
        correction = protocol.injection(innovation, innovation[senders])
        dx = agent.derivative(t, x, U)
        dxhat = agent.derivative(t, xhat, U) + correction
        ds = agent.A @ s + agent.H @ agent.g_numpy(t, s[None, :])[0]
        return np.concatenate([dx.ravel(), dxhat.ravel(), ds])

    start = np.concatenate([x0.ravel(), xhat0.ravel(), s0])
    solution: Any = solve_ivp(
        rhs, (times[0], times[-1]), start, "DOP853", times, rtol=rtol, atol=1e-2 * rtol
    )
    rows = [_split(column, n, m) for column in solution.y.T]
    return {name: np.array([row[k] for row in rows]) for k, name in enumerate(("x", "xhat", "s"))}


def _split(flat: Array, n: int, m: int) -> tuple[Array, Array, Array]:
    return flat[: n * m].reshape(n, m), flat[n * m : 2 * n * m].reshape(n, m), flat[2 * n * m :]
