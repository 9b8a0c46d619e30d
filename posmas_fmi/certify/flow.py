"""Bounds on one control period of ``z' = (A + H G(t)) z``, |G| ≤ ℓ, and of a held input."""

from __future__ import annotations

from functools import cached_property

import attrs
import numpy as np

from posmas_fmi.certify.enclosure import (
    block,
    exp_nonnegative,
    exp_scalar,
    point,
    product,
    shift_of,
    shifted,
)
from posmas_fmi.expression import Array
from posmas_fmi.interval import Interval


@attrs.frozen(eq=False)
class Orders:
    """Bounds times ``e^{στ}``, all (n, m, m); every entry increases with τ.

    Attributes
    ----------
    zeroth : Interval
        ``e^{A_low τ}``.
    first : Interval
        ``(e^{A_low τ} - e^{-στ} I)/τ``.
    second : Interval
        The same without its value at τ = 0, divided by τ once more.
    held : Interval
        ``Γ_τ(A_high)/τ``.
    held_second : Interval
        The same without its value I at τ = 0, divided by τ once more.
    """

    zeroth: Interval
    first: Interval
    second: Interval
    held: Interval
    held_second: Interval


@attrs.frozen(eq=False)
class Flow:
    """Transition matrices between ``A_low = A - |H|ℓ`` (Metzler) and ``A_high = A + |H|ℓ``.

    Comparison: ``e^{A_low τ} ≤ Φ(t+τ, t) ≤ e^{A_high τ}`` entrywise for every G(t), and the same
    for ``Γ(M) = ∫₀^τ e^{Ms} ds``, the response to a held input.
    """

    A_low: Interval
    A_high: Interval

    @cached_property
    def metzler(self) -> bool:
        """Whether A_low is proved Metzler and A_high is finite; all below needs it."""
        off = ~np.eye(len(self.A_low.low), dtype=bool)
        finite = np.isfinite(self.A_high.high).all() and np.isfinite(self.A_low.low).all()
        return bool(finite and (self.A_low.low[off] >= 0).all())

    @cached_property
    def sigma(self) -> float:
        """Shift that makes both matrices non-negative."""
        return shift_of(self.A_low, self.A_high)

    def shifted_bounds(self, times: Array) -> Orders:
        """Bounds over several times; see `Orders`."""
        P = shifted(self.A_low, self.sigma)
        zeroth, first, second = exp_nonnegative(P, times)
        W = _augmented(shifted(self.A_high, self.sigma), self.sigma)
        _, held_first, held_second = exp_nonnegative(W, times)
        return Orders(
            zeroth,
            _power(P, 1, first),
            _power(P, 2, second),
            _upper_right(_power(W, 1, held_first)),
            _upper_right(_power(W, 2, held_second)),
        )

    def _held(self, P: Interval, times: Array) -> Interval:
        """``(1/τ) ∫₀^τ e^{P(τ-s)} e^{σs} ds``, by the exponential of ``[[P, I], [0, σI]]``."""
        W = _augmented(P, self.sigma)
        _, mean, _ = exp_nonnegative(W, times)
        return _upper_right(_power(W, 1, mean))

    def over(self, h: float) -> tuple[Interval, Interval, Interval, Interval]:
        """``e^{A_low h}``, ``e^{A_high h}``, ``Γ(A_low)``, ``Γ(A_high)``, each (m, m)."""
        if h not in self._known:
            self._known[h] = self._over(h)
        return self._known[h]

    @cached_property
    def _known(self) -> dict[float, tuple[Interval, Interval, Interval, Interval]]:
        return {}

    def _over(self, h: float) -> tuple[Interval, Interval, Interval, Interval]:
        times = np.array([h])
        factor = exp_scalar(-(point(self.sigma) * point(h)))
        parts = []
        for A in (self.A_low, self.A_high):
            P = shifted(A, self.sigma)
            exponential, _, _ = exp_nonnegative(P, times)
            held = self._held(P, times) * point(h)
            parts.append((_first(exponential * factor), _first(held * factor)))
        return parts[0][0], parts[1][0], parts[0][1], parts[1][1]


def _first(a: Interval) -> Interval:
    return Interval(a.low[0], a.high[0])


def _augmented(P: Interval, sigma: float) -> Interval:
    zero, identity = np.zeros_like(P.low), np.eye(len(P.low))
    low, high = (np.block([[end, identity], [zero, sigma * identity]]) for end in (P.low, P.high))
    return Interval(low, high)


def _power(P: Interval, k: int, phi: Interval) -> Interval:
    """``P^k φ`` for k ≥ 1."""
    batch = Interval(P.low[None], P.high[None])
    for _ in range(k):
        phi = product(batch, phi)
    return phi


def _upper_right(W: Interval) -> Interval:
    m = W.low.shape[-1] // 2
    return block(W, slice(0, m), slice(m, None))
