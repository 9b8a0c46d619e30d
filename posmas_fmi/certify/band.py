"""Certificate G: a guaranteed worst-case deviation of every agent under bounded disturbances."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

from posmas_fmi.certify.flow import Flow
from posmas_fmi.certify.loop import Loop
from posmas_fmi.certify.proof import UNIT
from posmas_fmi.expression import Array
from posmas_fmi.interval import Interval

_SWEEPS = 50
_MARGIN = 1e-6  # of the disturbance: what absorbs the solver's error and rounding


def guaranteed_band(loop: Loop, disturbance: Array) -> Array | None:
    """Return ``z̄ ≥ 0`` with ``limsup |δ_i(t)| ≤ z̄_i``, (N, m), in continuous time or at samples.

    Smallest fixed point of the worst of the two ends of the sector in every row, found by policy
    iteration, then checked: ``-⌈J_M⌉ z̄ ≥ w̄`` (sampled ``z̄ - T_M z̄ ≥ Γ w̄``) at both ends.

    Parameters
    ----------
    loop : Loop
        Certificate P has to hold.
    disturbance : (m,) or (N, m) array
        Bound ``w̄`` on what is added to each state's derivative.

    Returns
    -------
    array or None
        None where nothing is proved.
    """
    n, m = loop.network.N, loop.agent.m
    w = np.broadcast_to(np.asarray(disturbance, dtype=float), (n, m))
    ends = _operators(loop)
    if ends is None:
        return None
    T, push = ends
    load = (w @ push.T).ravel()
    wider = load * (1 + _MARGIN) + _MARGIN * load.max(initial=0.0)
    choice = np.zeros(n * m, dtype=bool)
    z = np.zeros(n * m)
    for _ in range(_SWEEPS):
        chosen = sp.csr_array(
            sp.diags_array(~choice * 1.0) @ T[0] + sp.diags_array(choice * 1.0) @ T[1]
        )
        z = np.asarray(spla.spsolve(sp.csc_array(sp.eye_array(n * m) - chosen), wider))
        if not np.isfinite(z).all() or z.min() < 0:
            return None
        better = (T[1] @ z) > (T[0] @ z) * (1 + 1e-12)
        if (better == choice).all():
            break
        choice = better
    terms = int(np.diff(T[0].indptr).max(initial=0)) + 8
    slack = 2 * terms * UNIT * (abs(T[1]) @ z + abs(T[0]) @ z + z + load)
    proved = all(bool((z - M @ z - slack >= load).all()) for M in T)
    return z.reshape(n, m) if proved else None


def _operators(loop: Loop) -> tuple[tuple[sp.csr_array, sp.csr_array], Array] | None:
    """``T`` at both ends of the sector, and what a disturbance adds per step, as upper bounds."""
    flow = Flow(loop.A_low, loop.A_high)
    if not flow.metzler or not (loop.BK.low >= 0).all():
        return None
    n, m = loop.network.N, loop.agent.m
    L_p = loop.network.pinned_laplacian
    own = sp.diags_array(L_p.diagonal())
    near = sp.csr_array(own - L_p)
    if loop.period is None:
        # one small Euler step turns ⌈J⌉ z + w ≤ 0 into (I + hJ) z + h w ≤ z
        low_gain, high_gain = loop.agent.m_l, loop.agent.m_h
        degree = float(L_p.diagonal().max())
        size = np.abs(loop.A_low.low).max() + loop.phi * high_gain * degree * loop.BK.high.max()
        h = 0.5 / float(size)
        growth = np.eye(m) + h * loop.A_high.high
        pull, reach, push = h * np.eye(m), h * np.eye(m), h * np.eye(m)
    else:
        low_gain, high_gain = loop.agent.m_l, loop.agent.m_h
        _, grown, held_low, held_high = flow.over(loop.period)
        growth, pull, reach = grown.high, held_low.low, held_high.high
        push = held_high.high
    N: Interval = loop.BK
    operators = []
    for gain in (low_gain, high_gain):
        taken = loop.phi * gain * pull @ N.low
        given = loop.phi * gain * reach @ N.high
        operators.append(
            sp.csr_array(
                sp.kron(sp.eye_array(n), growth) - sp.kron(own, taken) + sp.kron(near, given)
            )
        )
    return (operators[0], operators[1]), push
