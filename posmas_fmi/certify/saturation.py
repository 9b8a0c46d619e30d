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
    estimation error, so ``|e_i| ≤ c_e w_i`` is invariant by the observer's certificate alone. It
    drives δ through the innovation: with b the largest push on δ, in the norm of δ, of an e with
    ``|e_i| ≤ w_i``, the box of δ is invariant if

    - sampled, ``r c + b c_e ≤ c``, where the push is ``Γ(A_high) |EC| w`` over a period,
    - continuous, ``-ρ c + b c_e ≤ 0``, where it is ``|EC| w``.

    Then e tends to zero, and so does δ.

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
    c_e = c * _left(tracking.rate, loop.period) / push / _UP if push > 0 else math.inf
    worst = int(coupling.argmax())
    weights = _shown(estimation.v) + ("" if loop.observer == "local" else " nu_i")
    radius_e = c_e * float(estimation.nu.min() * estimation.v.min())
    return Region(
        float(c),
        c * float(tracking.nu.min() * tracking.v.min()),
        float(c_e),
        radius_e,
        f"|u| <= {limit:g}/{low:g} while |delta_i| <= c nu_i v0, v0 = {_shown(tracking.v)}; "
        f"largest input at agent {loop.network.names[worst]}; holds for estimation errors "
        f"|e_i| <= {c_e:.6g} w_i, w_i = {weights}: up to {radius_e:.3g} in every entry",
    )


def _left(rate: float, h: float | None) -> float:
    """How much of c the contraction leaves to the push: 1 - r, or ρ; rounded down."""
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
