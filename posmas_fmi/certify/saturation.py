"""Certificate R: how far from the leader the network may start when the input saturates."""

from __future__ import annotations

import numpy as np

from posmas_fmi.certify.certificate import Region
from posmas_fmi.certify.loop import Loop
from posmas_fmi.certify.weights import Weights
from posmas_fmi.expression import Array


def region_of_attraction(loop: Loop, weights: Weights, v0: Array, limit: float) -> Region:
    """Largest ``c`` such that ``|δ_i| ≤ c ν_i v₀`` for all i keeps every input in its sector.

    A saturation at `limit` is in ``[m_l, 1]`` only while ``|u| ≤ limit/m_l``. The box is invariant
    under a certified contraction (with the estimation error at zero), so it is a region of
    attraction. ``|u_i| ≤ φ|K| v₀ c Σ_j |(L_p)_ij| ν_j``.

    Parameters
    ----------
    loop : Loop
    weights : Weights
        Those of the certificate.
    v0 : (m,) array
        Weights of the states, from the certificate.
    limit : float
        Bound at which the input saturates.
    """
    low = loop.agent.sector[0]
    coupling = abs(loop.network.pinned_laplacian) @ weights.nu
    per_c = loop.phi * (np.abs(loop.K) @ v0).max() * float(coupling.max()) * (1 + 1e-12)
    if per_c == 0 or low == 0:
        return Region(np.inf, np.inf, "the input never leaves its sector")
    c = limit / low / per_c * (1 - 1e-12)
    radius = c * float(weights.nu.min() * v0.min())
    worst = int(coupling.argmax())
    return Region(
        float(c),
        radius,
        f"|u| <= {limit:g}/{low:g} while |delta_i| <= c nu_i v0, v0 = "
        f"[{', '.join(f'{x:.6g}' for x in v0)}]; largest input at agent "
        f"{loop.network.names[worst]}; estimation error counted as zero",
    )
