"""Certificates C and T without positivity: moduli instead of signs, agent by agent.

Slower to prove and coarser than the positive forms, but needs no sign of K or E and no Metzler
condition. With ``R = (A_high-flow) - (A-flow)`` for the distance between the flow of A and that of
any ``A + H G(t)``, one period of agent i is bounded by ``|e^{Ah} - g M_ii Γ(A) N| + R + R_Γ g M_ii
|N| + g Σ_{j≠i} |M_ij| ν_j/ν_i Γ(A_high) |N|``: convex in the gain g, so its two ends suffice.
"""

from __future__ import annotations

from collections.abc import Iterator
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
    own: Interval  # distinct M_ii, (n,)
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
        return _Terms([loop.EC], one, one, point(1.0), np.zeros(1))
    mu = typed(loop.mu)
    return _Terms([loop.EC], mu, mu, *_rows(loop, weights))


def _rows(loop: Loop, weights: Weights) -> tuple[Interval, Array]:
    network = loop.network
    own = network.in_degree + network.pinning
    terms = int(np.diff(network.adjacency.indptr).max(initial=0)) + 4
    others = (network.adjacency @ weights.nu) / weights.nu * (1 + 4 * terms * UNIT)
    pairs = np.unique(np.column_stack([own, others]), axis=0)
    # of rows with the same M_ii only the one with the heaviest neighbours can be active
    last = np.append(pairs[1:, 0] != pairs[:-1, 0], True)
    exact = pairs[last, 0]
    rounded = 4 * terms * UNIT * np.abs(exact) * (exact % 1 != 0)
    return Interval(exact - rounded, exact + rounded), pairs[last, 1]


def continuous_rate(loop: Loop, name: str, weights: Weights) -> Rate | None:
    """Certificate C with ``⌈·⌉``; None where the bound is not finite."""
    if not np.isfinite(loop.H_ell.high).all():
        return None
    rows = [
        metzler_majorant(loop.A + -fed) + loop.H_ell + near
        for fed, near in _vertices(_terms(loop, name, weights))
    ]
    proved = _worst(rows)
    return (
        None
        if proved is None
        else attrs.evolve(proved, value=-proved.value, estimate=-proved.estimate)
    )


def sampled_factor(loop: Loop, name: str, weights: Weights) -> Rate | None:
    """Certificate T with moduli; None where the bound is not finite."""
    if loop.period is None or not np.isfinite(loop.H_ell.high).all():
        return None
    plain, grown, held, grown_held = Flow(loop.A, loop.A_high).over(loop.period)
    zero = np.zeros_like(plain.low)
    spread = Interval(zero, (grown + -plain).high)
    spread_held = Interval(zero, (grown_held + -held).high)
    rows = [
        magnitude(plain + -matmul(held, fed))
        + spread
        + matmul(spread_held, magnitude(fed))
        + matmul(grown_held, near)
        for fed, near in _vertices(_terms(loop, name, weights))
    ]
    return _worst(rows)


def _vertices(terms: _Terms) -> Iterator[tuple[Interval, Interval]]:
    """``g M_ii N`` and ``g Σ|M_ij| |N|`` for all distinct rows, at each vertex of the gains."""
    if len(terms.parts) > _MAX_INPUTS:
        return
    own = Interval(terms.own.low[:, None, None], terms.own.high[:, None, None])
    others = Interval(np.zeros_like(own.low), terms.others[:, None, None])
    same = bool((terms.low.low == terms.high.low).all())
    ends = [terms.low] if same else [terms.low, terms.high]
    for choice in product(ends, repeat=len(terms.parts)):
        fed = near = point(np.zeros_like(terms.parts[0].low[None]))
        for part, gain in zip(terms.parts, choice, strict=True):
            whole = Interval(part.low[None], part.high[None]) * gain
            fed = fed + whole * own
            near = near + magnitude(whole) * others
        yield fed, near


def _worst(rows: list[Interval]) -> Rate | None:
    """Bound of ``max_k (M v)_k / v_k`` over all matrices, with one v for all."""
    if not rows:
        return None
    top = np.max([r.high.max(axis=0) for r in rows], axis=0)
    if not np.isfinite(top).all():
        return None
    v = perron_vector(top)
    values = [matmul(M, point(v[:, None])).high[..., 0] for M in rows]
    bound = max(float(np.nextafter(value / v, np.inf).max()) for value in values)
    return Rate(bound, bound, v)
