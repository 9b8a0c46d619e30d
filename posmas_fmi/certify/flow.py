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

    def shifted_bounds(self, times: Array) -> tuple[Interval, Interval, Interval]:
        """``e^{στ}`` times ``e^{A_low τ}``, ``(e^{A_low τ}-e^{-στ}I)/τ`` and ``Γ_τ(A_high)/τ``.

        Each (n, m, m); every entry increases with τ.
        """
        P = shifted(self.A_low, self.sigma)
        exponential, mean = exp_nonnegative(P, times)
        held = self._held(shifted(self.A_high, self.sigma), times, len(P.low))
        return exponential, _matmul_mean(P, mean), held

    def _held(self, P: Interval, times: Array, m: int) -> Interval:
        """``(1/τ) ∫₀^τ e^{P(τ-s)} e^{σs} ds``, by the exponential of ``[[P, I], [0, σI]]``."""
        W = _augmented(P, self.sigma)
        _, mean = exp_nonnegative(W, times)
        return block(_matmul_mean(W, mean), slice(0, m), slice(m, None))

    def over(self, h: float) -> tuple[Interval, Interval, Interval, Interval]:
        """``e^{A_low h}``, ``e^{A_high h}``, ``Γ(A_low)``, ``Γ(A_high)``, each (m, m)."""
        times, m = np.array([h]), len(self.A_low.low)
        factor = exp_scalar(-(point(self.sigma) * point(h)))
        parts = []
        for A in (self.A_low, self.A_high):
            P = shifted(A, self.sigma)
            exponential, _ = exp_nonnegative(P, times)
            held = self._held(P, times, m) * point(h)
            parts.append((_first(exponential * factor), _first(held * factor)))
        return parts[0][0], parts[1][0], parts[0][1], parts[1][1]


def _first(a: Interval) -> Interval:
    return Interval(a.low[0], a.high[0])


def _augmented(P: Interval, sigma: float) -> Interval:
    zero, identity = np.zeros_like(P.low), np.eye(len(P.low))
    low, high = (np.block([[end, identity], [zero, sigma * identity]]) for end in (P.low, P.high))
    return Interval(low, high)


def _matmul_mean(P: Interval, mean: Interval) -> Interval:
    return product(Interval(P.low[None], P.high[None]), mean)
