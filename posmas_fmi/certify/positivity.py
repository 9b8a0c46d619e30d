"""Certificate P: what starts non-negative stays so, in continuous time and between samples."""

from __future__ import annotations

from typing import Any

import numpy as np

from posmas_fmi.certify.certificate import Condition
from posmas_fmi.certify.enclosure import point, product
from posmas_fmi.certify.flow import Flow
from posmas_fmi.certify.loop import Feedback, Loop
from posmas_fmi.expression import Array
from posmas_fmi.interval import Interval, Mask

Indices = np.ndarray[Any, np.dtype[np.intp]]
VACUOUS = 1.0  # margin where there is no entry that could fail
_FIRST_PIECES = 8
_MAX_PIECES = 4096


def margin_of(values: Interval, where: Array | None = None) -> tuple[float, tuple[int, ...] | None]:
    """Least proved value of entries that must be ≥ 0, and where; exact zeros cannot fail."""
    open_ = ~((values.low == 0) & (values.high == 0))
    if where is not None:
        open_ &= where
    if not open_.any():
        return VACUOUS, None
    low = np.where(open_, values.low, np.inf)
    k = np.unravel_index(int(low.argmin()), low.shape)
    least = float(low[k])
    index = tuple(int(i) for i in k)
    return (least if least != 0.0 else float(np.finfo(float).tiny)), index


def _below(values: Interval, where: Mask | None = None) -> bool:
    """Whether an entry is proved negative."""
    low = values.high < 0
    return bool((low if where is None else low & where).any())


def _entry(name: str, index: tuple[int, ...] | None) -> str:
    if index is None:
        return "no entry could fail"
    return f"least at {name}[{', '.join(str(i + 1) for i in index)}]"


def gain_sign(feedback: Feedback) -> Condition:
    """``B|K| ≥ 0`` and ``EC ≥ 0``: feedback that positivity can live with."""
    symbol = "-BK" if feedback.name == "controller" else "EC"
    margin, index = margin_of(feedback.N)
    return Condition.from_margin(
        f"P: {symbol} >= 0",
        margin,
        f"least entry >= {margin:.6g}, interval arithmetic",
        _entry(symbol, index),
        _below(feedback.N),
    )


def non_positive_gain(loop: Loop) -> Condition:
    """``K ≤ 0``: neighbours and leader pull upwards."""
    margin, index = margin_of(-point(loop.K))
    return Condition.from_margin(
        "P: K <= 0",
        margin,
        f"largest entry {float(loop.K.max()):.6g}, exact",
        _entry("K", index),
        bool((loop.K > 0).any()),
    )


def metzler(loop: Loop, feedback: Feedback) -> Condition:
    """Prove ``A - strong·N - |H|ℓ`` Metzler (for the controller with the growth bound as well)."""
    fed = feedback.N * point(feedback.strong)
    value = loop.A_low + -fed
    if feedback.name == "controller":
        grown = loop.A + -loop.H_growth + -fed
        value = Interval(np.minimum(value.low, grown.low), np.minimum(value.high, grown.high))
        name = "P: A + phi m_h max(Lp)_ii BK - |H|l Metzler"
    elif loop.observer == "local":
        name = "P: A - EC - |H|l Metzler"
    else:
        name = "P: A - mu max(Lp)_ii EC - |H|l Metzler"
    off = ~np.eye(loop.agent.m, dtype=bool)
    margin, index = margin_of(value, off)
    return Condition.from_margin(
        name,
        margin,
        f"least off-diagonal entry >= {margin:.6g} 1/s, interval arithmetic",
        f"{_entry('the matrix', index)}, binding at {feedback.strongest}",
        _below(value, off),
    )


def between_samples(flow: Flow, feedback: Feedback, h: float) -> Condition:
    """``e^{A_low τ} - strong·Γ_τ(A_high) N ≥ 0`` for every τ in [0, h].

    Both terms, times ``e^{στ}`` and divided by τ off the diagonal (by τ² where both vanish to first
    order), increase with τ. On a piece [a, b] the first is taken at a and the second at b; pieces
    are halved until all are proved.
    """
    name = f"T: {feedback.name} keeps signs for every tau <= h"
    if not flow.metzler or not (feedback.N.low >= 0).all():
        return Condition(name, False, -np.inf, "needs certificate P", feedback.strongest)
    N = feedback.N * point(feedback.strong)
    ends = _Ends(flow, N, np.linspace(0.0, h, _FIRST_PIECES + 1))
    first = np.arange(_FIRST_PIECES)
    pieces: Indices = np.column_stack([first, first + 1])
    proved, count = np.inf, 0
    while len(pieces):
        slack = ends.slack(pieces[:, 0], pieces[:, 1])
        least = slack.reshape(len(pieces), -1).min(axis=1)
        good = least >= 0
        proved, count = min(proved, float(least[good].min(initial=np.inf))), count + int(good.sum())
        pieces = pieces[~good]
        corners = np.unique(pieces)
        exact = ends.slack(corners, corners)
        if 2 * len(pieces) > _MAX_PIECES or exact.min(initial=np.inf) < 0:
            k, *entry = (int(i) for i in np.unravel_index(int(exact.argmin()), exact.shape))
            margin = min(float(exact.min()), -float(np.finfo(float).tiny))
            return Condition(
                name,
                False,
                margin,
                f"least entry {margin:.6g} at tau = {ends.times[corners[k]]:.6g} s, "
                "interval arithmetic",
                f"{_entry('the matrix', tuple(entry))}; a shorter period or a smaller gain "
                f"helps; binding at {feedback.strongest}",
                _refuted(flow, N, ends, float(ends.times[corners[k]])),
            )
        pieces = ends.halve(pieces)
    margin = VACUOUS if np.isinf(proved) else max(proved, float(np.finfo(float).tiny))
    return Condition.from_margin(
        name,
        margin,
        f"least entry (off the diagonal per tau) >= {margin:.6g}, "
        f"{count} pieces of [0, h], interval arithmetic",
        f"binding at {feedback.strongest}",
    )


def _refuted(flow: Flow, N: Interval, ends: _Ends, tau: float) -> bool:
    """Whether an entry is proved negative at that time."""
    with np.errstate(over="ignore", invalid="ignore"):
        bounds = flow.shifted_bounds(np.array([tau]))
        batch = Interval(N.low[None], N.high[None])
        own = np.where(ends.off, bounds.first.high, bounds.zeroth.high)
        own = np.where(ends.flat, bounds.second.high, own)
        second, first = product(bounds.held_second, batch).low, product(bounds.held, batch).low
        taken = np.where(ends.flat, second, first)
        spent = np.where(ends.off, taken, np.nextafter(taken * tau, -np.inf))
        return bool((np.nextafter(own - spent, np.inf) < 0).any())


class _Ends:
    """Both terms at the ends of pieces of [0, h], each computed once."""

    def __init__(self, flow: Flow, N: Interval, times: Array) -> None:
        self.flow, self.N = flow, N
        self.off = ~np.eye(len(N.low), dtype=bool)
        # entries that vanish to first order on both sides are compared to second order
        A = flow.A_low
        self.flat = self.off & (A.low == 0) & (A.high == 0) & (N.low == 0) & (N.high == 0)
        self.times = times
        self.own, self.spent = self._terms(times)

    def _terms(self, times: Array) -> tuple[Array, Array]:
        """Lower bound of what is there and upper bound of what feedback takes, (n, m, m)."""
        bounds = self.flow.shifted_bounds(times)
        N = Interval(self.N.low[None], self.N.high[None])
        first, second = product(bounds.held, N).high, product(bounds.held_second, N).high
        taken = np.where(self.flat, second, first)
        own = np.where(self.off, bounds.first.low, bounds.zeroth.low)
        own = np.where(self.flat, bounds.second.low, own)
        with np.errstate(invalid="ignore"):
            whole = np.nextafter(taken * times[:, None, None], np.inf)
        # nothing is taken from entries that are exactly zero, and e^{A_low τ} ≥ 0
        spent = np.where(self.off, taken, whole)
        return own, np.where(taken == 0, -np.inf, np.nan_to_num(spent, nan=np.inf, posinf=np.inf))

    def slack(self, left: Indices, right: Indices) -> Array:
        """Lower bound of the difference on the pieces between the ends with these numbers."""
        with np.errstate(invalid="ignore"):
            difference = np.nextafter(self.own[left] - self.spent[right], -np.inf)
        return np.asarray(
            np.nan_to_num(difference, nan=-np.inf, posinf=np.inf, neginf=-np.inf), dtype=float
        )

    def halve(self, pieces: Indices) -> Indices:
        """Add the middles of pieces as new ends; return the halves."""
        middle = 0.5 * (self.times[pieces[:, 0]] + self.times[pieces[:, 1]])
        new = len(self.times) + np.arange(len(pieces))
        own, spent = self._terms(middle) if len(pieces) else (self.own[:0], self.spent[:0])
        self.times = np.concatenate([self.times, middle])
        self.own = np.concatenate([self.own, own])
        self.spent = np.concatenate([self.spent, spent])
        return np.concatenate(
            [np.column_stack([pieces[:, 0], new]), np.column_stack([new, pieces[:, 1]])]
        )
