"""Certificates C and S: one vector proves the rate of the whole network, in continuous time."""

from __future__ import annotations

import attrs
import numpy as np

from posmas_fmi.certify.enclosure import matmul, point
from posmas_fmi.certify.loop import Feedback
from posmas_fmi.expression import Array
from posmas_fmi.interval import Interval


@attrs.frozen(eq=False)
class Rate:
    """A proved rate.

    Attributes
    ----------
    value : float
        Lower bound of ρ [1/s], or upper bound of r per sample.
    estimate : float
        The same in plain floating point.
    v : (m,) array
        The weights of the states, positive.
    refuted : bool
        Whether it is proved that no v gives ρ > 0, or r < 1.
    """

    value: float
    estimate: float
    v: Array
    refuted: bool = False


def perron_vector(M: Array) -> Array:
    """Positive vector close to the Perron vector of a matrix with non-negative off-diagonals.

    Zeros of a reducible matrix are lifted: any positive vector proves something, and the bound
    that follows is computed for the vector returned.
    """
    m = len(M)
    off = np.where(np.eye(m, dtype=bool), M, np.maximum(M, 0.0))
    lifted = off + 1e-9 * max(1e-300, float(np.abs(off).max()))
    values, vectors = np.linalg.eig(lifted)
    v = np.abs(vectors[:, int(values.real.argmax())].real)
    return np.asarray(np.maximum(v / v.max(), 1e-12))


def continuous_rate(A_high: Interval, feedback: Feedback) -> Rate | None:
    """Certificate C with S: ``(A_high - weak·N) v ≤ -ρ v`` for the weakest agent.

    Where P holds the matrix is Metzler and decreasing in the gain, so the weakest agent covers all.

    Returns
    -------
    Rate or None
        None if the matrix is not finite; the rate may be negative.
    """
    if not np.isfinite(A_high.high).all() or not np.isfinite(feedback.weak):
        return None
    J = A_high + -(feedback.N * point(feedback.weak))
    majorant = metzler_majorant(J)
    v = perron_vector(majorant.high)
    value = matmul(majorant, point(v[:, None])).high[:, 0]
    bound = float(np.nextafter(value / v, np.inf).max())
    estimate = float(np.linalg.eigvals(majorant.high).real.max())
    # Collatz-Wielandt: no v gives more than the smallest quotient of this one
    most = float(np.nextafter(matmul(majorant, point(v[:, None])).low[:, 0] / v, -np.inf).min())
    return Rate(-bound, -estimate, v, most >= 0)


def metzler_majorant(J: Interval) -> Interval:
    """``⌈J⌉``: diagonal kept, moduli elsewhere."""
    diagonal = np.eye(J.low.shape[-1], dtype=bool)
    crosses = (J.low <= 0) & (J.high >= 0)
    low, high = np.abs(J.low), np.abs(J.high)
    small = np.where(crosses, 0.0, np.minimum(low, high))
    return Interval(
        np.where(diagonal, J.low, small), np.where(diagonal, J.high, np.maximum(low, high))
    )
