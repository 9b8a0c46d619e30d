"""Certificate P: what starts non-negative stays so, in continuous time and between samples."""

from __future__ import annotations

import numpy as np

from posmas_fmi.certify.certificate import Condition
from posmas_fmi.certify.enclosure import matmul, point
from posmas_fmi.certify.flow import Flow
from posmas_fmi.certify.loop import Feedback, Loop
from posmas_fmi.expression import Array
from posmas_fmi.interval import Interval

VACUOUS = 1.0  # margin where there is no entry that could fail
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
    )


def non_positive_gain(loop: Loop) -> Condition:
    """``K ≤ 0``: neighbours and leader pull upwards."""
    margin, index = margin_of(-point(loop.K))
    return Condition.from_margin(
        "P: K <= 0", margin, f"largest entry {float(loop.K.max()):.6g}, exact", _entry("K", index)
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
    )


def between_samples(flow: Flow, feedback: Feedback, h: float) -> Condition:
    """``e^{A_low τ} - strong·Γ_τ(A_high) N ≥ 0`` for every τ in [0, h].

    Both terms, times ``e^{στ}`` and divided by τ off the diagonal, increase with τ. On a piece
    [a, b] the first is taken at a and the second at b; pieces are halved until all are proved.
    """
    name = f"T: {feedback.name} keeps signs for every tau <= h"
    if not flow.metzler or not (feedback.N.low >= 0).all():
        return Condition(name, False, -np.inf, "needs certificate P", feedback.strongest)
    N = feedback.N * point(feedback.strong)
    off = ~np.eye(len(N.low), dtype=bool)
    left, right = np.array([0.0]), np.array([h])
    proved, pieces, index = np.inf, 0, None
    while True:
        slack = _slack(flow, N, left, right, off)
        least = slack.reshape(len(left), -1).min(axis=1)
        good = least >= 0
        if good.any():
            proved = min(proved, float(least[good].min()))
            pieces += int(good.sum())
        if good.all():
            break
        bad_left, bad_right = left[~good], right[~good]
        middle = 0.5 * (bad_left + bad_right)
        exact = _slack(flow, N, middle, middle, off)
        if 2 * len(middle) > _MAX_PIECES or exact.min() < 0:
            k, *entry = np.unravel_index(int(exact.argmin()), exact.shape)
            proved, index = min(float(exact.min()), -float(np.finfo(float).tiny)), tuple(entry)
            tau = float(middle[k])
            return Condition(
                name,
                False,
                proved,
                f"least entry {proved:.6g} at tau = {tau:.6g} s, interval arithmetic",
                f"{_entry('the matrix', tuple(int(i) for i in index))}; "
                f"a shorter period or a smaller gain helps; binding at {feedback.strongest}",
            )
        left, right = np.concatenate([bad_left, middle]), np.concatenate([middle, bad_right])
    margin = VACUOUS if np.isinf(proved) else max(proved, float(np.finfo(float).tiny))
    return Condition.from_margin(
        name,
        margin,
        f"least entry (off the diagonal per tau) >= {margin:.6g}, "
        f"{pieces} piece(s) of [0, h], interval arithmetic",
        f"binding at {feedback.strongest}",
    )


def _slack(flow: Flow, N: Interval, left: Array, right: Array, off: Array) -> Array:
    """Lower bound of both terms' difference on each piece, (n, m, m)."""
    exponential, increment, _, _ = flow.shifted_bounds(left)
    *_, held = flow.shifted_bounds(right)
    taken = matmul(held, Interval(N.low[None], N.high[None])).high
    own = np.where(off[None], increment.low, exponential.low)
    with np.errstate(invalid="ignore"):
        spent = np.where(off[None], taken, np.nextafter(taken * right[:, None, None], np.inf))
        slack = np.nextafter(own - spent, -np.inf)
    # nothing is taken from these entries, and e^{A_low τ} ≥ 0
    slack = np.where(taken == 0, np.inf, slack)
    return np.nan_to_num(slack, nan=-np.inf, posinf=np.inf, neginf=-np.inf)
