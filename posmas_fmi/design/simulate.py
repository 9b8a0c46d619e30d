"""The continuous closed loop of the paper in small fixed steps; to look, not to prove."""

from __future__ import annotations

import attrs
import numpy as np

from posmas_fmi.certify import Loop
from posmas_fmi.expression import Array
from posmas_fmi.protocol import make_protocol


@attrs.frozen(eq=False)
class Trajectory:
    """What a look at a trajectory shows.

    Attributes
    ----------
    x, xhat : (N, m) array
        At the end.
    s : (m,) array
        Leader at the end.
    least, least_estimate : float
        Smallest entry of any state, and of any estimate, on the way.
    error : float
        Largest ``|x_i - s|`` at the end.
    """

    x: Array
    xhat: Array
    s: Array
    least: float
    least_estimate: float
    error: float


def simulate(
    loop: Loop, x: Array, xhat: Array, s: Array, until: float, step: float = 1e-3
) -> Trajectory:
    """Integrate agents, observers and leader with the classical Runge-Kutta method.

    Parameters
    ----------
    loop : Loop
        With ``protocol = "printed"`` the signs of (6), and of (22) for the distributed observer.
    x, xhat : (N, m) array
    s : (m,) array
    until, step : float
        [s].
    """
    agent, network = loop.agent, loop.network
    n, m, heard = network.N, agent.m, network.adjacency.indices
    protocol = make_protocol(
        network, loop.K, loop.E, loop.phi, loop.mu, loop.observer, loop.protocol
    )

    def slope(t: float, z: Array) -> Array:
        x, xhat, s = z[:n], z[n : 2 * n], z[2 * n]
        push = agent.sec_numpy(protocol.control(xhat, xhat[heard], s)) @ agent.B.T
        innovation = (x - xhat) @ agent.C.T
        free = z @ agent.A.T + agent.g_numpy(t, z) @ agent.H.T
        free[:n] += push
        free[n : 2 * n] += push + protocol.injection(innovation, innovation[heard])
        return np.asarray(free)

    z = np.vstack([x, xhat, s[None]]).astype(float)
    least, least_estimate, t = float(z[:n].min()), float(z[n : 2 * n].min()), 0.0
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(round(until / step)):
            t = k * step
            a = slope(t, z)
            b = slope(t + step / 2, z + step / 2 * a)
            c = slope(t + step / 2, z + step / 2 * b)
            e = slope(t + step, z + step * c)
            z = z + step / 6 * (a + 2 * b + 2 * c + e)
            least = min(least, float(np.nan_to_num(z[:n], nan=-np.inf).min()))
            estimate = float(np.nan_to_num(z[n : 2 * n], nan=-np.inf).min())
            least_estimate = min(least_estimate, estimate)
            if not np.isfinite(z).all():
                break
    error = float(np.abs(z[:n] - z[2 * n]).max())
    return Trajectory(z[:n, :m], z[n : 2 * n], z[2 * n], least, least_estimate, error)
