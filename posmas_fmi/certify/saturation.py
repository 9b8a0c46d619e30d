"""Certificate R: how far from the leader the network may start when the input saturates."""

from __future__ import annotations

import math

import attrs
import numpy as np
import scipy.sparse as sp

from posmas_fmi.certify.certificate import Region
from posmas_fmi.certify.enclosure import magnitude
from posmas_fmi.certify.flow import Flow
from posmas_fmi.certify.loop import Loop
from posmas_fmi.expression import Array

_UP = 1 + 1e-12  # covers the rounding of the short sums of non-negative terms below


@attrs.frozen(eq=False)
class Contraction:
    """A proved contraction: ``max |z_i|/(ν_i v)`` falls with the rate.

    Attributes
    ----------
    nu : (N,) array
    v : (m,) array
    rate : float
        Proved [1/s].
    """

    nu: Array
    v: Array
    rate: float


def region_of_attraction(
    loop: Loop, tracking: Contraction, estimation: Contraction, limit: float
) -> Region:
    """Largest ``c``, and ``c_e`` for it, such that every input stays in its sector for good.

    A saturation at `limit` is in ``[m_l, 1]`` only while ``|u| ≤ limit/m_l``, and
    ``|u_i| ≤ φ|K| v c Σ_j |(L_p)_ij| ν_j`` while ``|δ_i| ≤ c ν_i v``. Inputs cancel in the
    estimation error, which falls by r_o in a period whatever they are. It drives δ through the
    innovation: let b be the largest push on δ of an e with ``|e_i| ≤ w_i``, in the norm of δ:
    ``Γ(A_high) |EC| w`` over a period, or ``|EC| w`` in continuous time. With ``κ = b/(1 - r_o)``

        ``‖δ‖' + κ‖e‖' ≤ r‖δ‖ + b‖e‖ + κ r_o‖e‖ = r‖δ‖ + κ‖e‖``,

    so ``‖δ‖ + κ‖e‖ ≤ c`` is invariant, that is ``‖δ‖/c + ‖e‖/c_e ≤ 1`` with ``c_e = c/κ``; in
    continuous time the same with the rate ρ_o for ``1 - r_o``. e tends to zero, and so does δ.

    Parameters
    ----------
    loop : Loop
    tracking, estimation : Contraction
        What the certificate proves of δ and e, inside the sector.
    limit : float
        Bound at which the input saturates.
    """
    low = loop.agent.sector[0]
    coupling = abs(loop.network.pinned_laplacian) @ tracking.nu
    per_c = loop.phi * (np.abs(loop.K) @ tracking.v).max() * float(coupling.max()) * _UP
    if per_c == 0 or low == 0:
        return Region(np.inf, np.inf, np.inf, np.inf, "the input never leaves its sector")
    c = limit / low / per_c / _UP
    push = _push(loop, tracking, estimation)
    c_e = c * _left(estimation.rate, loop.period) / push / _UP if push > 0 else math.inf
    worst = int(coupling.argmax())
    weights = _shown(estimation.v) + ("" if loop.observer == "local" else " nu_i")
    radius_e = float(c_e) * float(estimation.nu.min() * estimation.v.min())
    return Region(
        float(c),
        float(c) * float(tracking.nu.min() * tracking.v.min()),
        float(c_e),
        radius_e,
        f"|u| <= {limit:g}/{low:g} while |delta_i| <= c nu_i v0, v0 = {_shown(tracking.v)}; "
        f"largest input at agent {loop.network.names[worst]}; that is for e = 0: with an "
        f"estimation error the share |delta|/c + |e|/c_e must start at most 1, where "
        f"|e| = max |e_i|/w_i, w_i = {weights}, c_e = {c_e:.6g}",
    )


def _left(rate: float, h: float | None) -> float:
    """``1 - r``, or ρ, rounded down."""
    return (rate if h is None else -math.expm1(-rate * h)) / _UP


def _push(loop: Loop, tracking: Contraction, estimation: Contraction) -> float:
    """Largest entry of the innovation's push over ``ν_i v``, for ``|e_i| ≤ w_i``."""
    M: sp.csr_array = sp.eye_array(loop.network.N, format="csr")
    if loop.observer == "distributed":
        M = loop.mu * abs(loop.network.pinned_laplacian)
    feedback = magnitude(loop.EC).high @ estimation.v
    if loop.period is not None:
        # |Φ| ≤ e^{A_high τ} entrywise: A is Metzler, so A_high bounds ⌈A + H G(t)⌉
        feedback = Flow(loop.A_high, loop.A_high).over(loop.period)[3].high @ feedback
    heard = (M @ estimation.nu) / tracking.nu
    return float(heard.max() * (feedback / tracking.v).max()) * _UP


def _shown(v: Array) -> str:
    return f"[{', '.join(f'{x:.6g}' for x in v)}]"
