"""Certificates C and T without positivity: moduli instead of signs, agent by agent.

Slower to prove and coarser than the positive forms, but needs no sign of K or E and no Metzler
condition. With ``R = (A_high-flow) - (A-flow)`` for the distance between the flow of A and that of
any ``A + H G(t)``, one period of agent i is bounded by ``|e^{Ah} - g M_ii Γ(A) N| + R + R_Γ g M_ii
|N| + g Σ_{j≠i} |M_ij| ν_j/ν_i Γ(A_high) |N|``: convex in the gain g, so its two ends suffice.
"""

from __future__ import annotations

from itertools import product

import attrs
import numpy as np

from posmas_fmi.certify.contraction import Rate, metzler_majorant, perron_vector
from posmas_fmi.certify.enclosure import magnitude, matmul, point, typed
from posmas_fmi.certify.flow import Flow
from posmas_fmi.certify.loop import Loop
from posmas_fmi.certify.proof import UNIT
from posmas_fmi.certify.weights import Weights
from posmas_fmi.expression import Array
from posmas_fmi.interval import Interval

_MAX_INPUTS = 8  # 2^p vertices of the sector


@attrs.frozen(eq=False)
class _Terms:
    """Rank-one parts of N with the two ends of each one's gain, and the rows of M that differ."""

    parts: list[Interval]  # (m, m) each: -B_a K_a, or EC
    low: Interval  # smallest gain
    high: Interval  # largest gain
    own: Array  # distinct M_ii
    others: Array  # with it, bound of Σ_{j≠i} |M_ij| ν_j/ν_i


def _terms(loop: Loop, name: str, weights: Weights) -> _Terms:
    agent = loop.agent
    if name == "controller":
        columns = range(agent.p)
        parts = [matmul(typed(agent.B[:, [a]]), -typed(loop.K[[a], :])) for a in columns]
        phi = typed(loop.phi)
        return _Terms(parts, phi * point(agent.m_l), phi * point(agent.m_h), *_rows(loop, weights))
    if loop.observer == "local":
        one = point(1.0)
        return _Terms([loop.EC], one, one, np.ones(1), np.zeros(1))
    mu = typed(loop.mu)
    return _Terms([loop.EC], mu, mu, *_rows(loop, weights))


def _rows(loop: Loop, weights: Weights) -> tuple[Array, Array]:
    network = loop.network
    own = network.in_degree + (-1 if loop.protocol == "printed" else 1) * network.pinning
    terms = int(np.diff(network.adjacency.indptr).max(initial=0)) + 4
    others = (network.adjacency @ weights.nu) / weights.nu * (1 + 4 * terms * UNIT)
    pairs = np.unique(np.column_stack([own, others]), axis=0)
    # of rows with the same M_ii only the one with the heaviest neighbours can be active
    last = np.append(pairs[1:, 0] != pairs[:-1, 0], True)
    return pairs[last, 0], pairs[last, 1]


def continuous_rate(loop: Loop, name: str, weights: Weights) -> Rate | None:
    """Certificate C with ``⌈·⌉``; None where the bound is not finite."""
    if not np.isfinite(loop.H_ell.high).all():
        return None
    rows = []
    for own, others, gains in _vertices(_terms(loop, name, weights)):
        fed, near = _sums(gains, own, others)
        J = metzler_majorant(loop.A + -fed)
        rows.append(J + loop.H_ell + near)
    v = perron_vector(np.max([r.high for r in rows], axis=0))
    bound = max(_worst(r, v) for r in rows)
    return Rate(-bound, -bound, v)


def sampled_factor(loop: Loop, name: str, weights: Weights) -> Rate | None:
    """Certificate T with moduli; None where the bound is not finite."""
    if loop.period is None or not np.isfinite(loop.H_ell.high).all():
        return None
    h = loop.period
    _, plain, _, held = Flow(loop.A, loop.A).over(h)
    plain_low, _, held_low, _ = Flow(loop.A, loop.A).over(h)
    plain, held = Interval(plain_low.low, plain.high), Interval(held_low.low, held.high)
    _, grown, _, grown_held = Flow(loop.A, loop.A_high).over(h)
    spread = Interval(np.zeros_like(plain.low), (grown + -plain).high)
    spread_held = Interval(np.zeros_like(plain.low), (grown_held + -held).high)
    rows = []
    for own, others, gains in _vertices(_terms(loop, name, weights)):
        fed, near = _sums(gains, own, others)
        moved = magnitude(plain + -matmul(held, fed))
        rows.append(moved + spread + matmul(spread_held, magnitude(fed)) + matmul(grown_held, near))
    top = np.max([r.high for r in rows], axis=0)
    if not np.isfinite(top).all():
        return None
    v = perron_vector(top)
    bound = max(_worst(r, v) for r in rows)
    return Rate(bound, bound, v)


def _vertices(terms: _Terms):  # type: ignore[no-untyped-def]
    """Every distinct row of M with every vertex of the gains."""
    same = bool((terms.low.low == terms.high.low).all())
    ends = [terms.low] if same else [terms.low, terms.high]
    count = len(terms.parts) if len(terms.parts) <= _MAX_INPUTS else 0
    for own, others in zip(terms.own, terms.others, strict=True):
        for choice in product(ends, repeat=count):
            yield own, others, list(zip(terms.parts, choice, strict=True))


def _sums(
    gains: list[tuple[Interval, Interval]], own: float, others: float
) -> tuple[Interval, Interval]:
    """``g M_ii N`` and ``g Σ|M_ij| |N|`` at one vertex."""
    M_ii = typed(own).widen(4) if own % 1 else point(own)
    fed = near = point(np.zeros_like(gains[0][0].low))
    for part, gain in gains:
        fed = fed + part * gain * M_ii
        near = near + magnitude(part) * gain * Interval(np.zeros(1), np.array([others]))
    return fed, near


def _worst(M: Interval, v: Array) -> float:
    value = matmul(M, point(v[:, None])).high[:, 0]
    return float(np.nextafter(value / v, np.inf).max())
