"""The channel: what each arc holds, with delay, jitter and loss; the last value is kept."""

from __future__ import annotations

import math
import sys
from typing import Any

import attrs
import numpy as np

from posmas_fmi.errors import InputError
from posmas_fmi.expression import Array

Steps = np.ndarray[Any, np.dtype[np.int64]]
NEVER = 10**15  # steps


@attrs.frozen(eq=False)
class Channel:
    """Delay, jitter and loss of the messages on the arcs.

    Parameters
    ----------
    delay : (arcs,) array of int
        Communication steps that every message takes.
    jitter : (arcs,) array of int
        Largest additional delay; each one up to it is alike likely, for each message anew.
    loss : (arcs,) array
        Probability that a message does not arrive.
    resolution : float
        Messages are rounded to multiples of it; 0: they are not.
    end : int
        Delays of more steps count as this many: such messages arrive after the end of the run.
    """

    delay: np.ndarray[tuple[int], np.dtype[np.int64]]
    jitter: np.ndarray[tuple[int], np.dtype[np.int64]]
    loss: Array
    resolution: float = 0.0
    end: int = NEVER

    @classmethod
    def uniform(
        cls,
        arcs: int,
        h: float,
        delay: float = 0.0,
        jitter: float = 0.0,
        loss: float = 0.0,
        resolution: float = 0.0,
    ) -> Channel:
        """Every arc alike; delay and jitter [s] are rounded up to communication steps.

        Raises
        ------
        InputError
            If a delay is negative or the loss not in [0, 1]; `problems` has all of them.

        Examples
        --------
        >>> Channel.uniform(2, h=0.1, delay=0.25).delay
        array([3, 3])
        """
        found = [
            InputError(f"expected {what} (got {value!r})", f"$.channel.{name}")
            for name, value, most, what in (
                ("delay", delay, sys.float_info.max, "a time >= 0 s"),
                ("jitter", jitter, sys.float_info.max, "a time >= 0 s"),
                ("resolution", resolution, sys.float_info.max, "a number >= 0"),
                ("loss", loss, 1.0, "a probability in [0, 1]"),
            )
            if not 0.0 <= value <= most
        ]
        if found:
            found[0].problems = tuple((error.where, error.message) for error in found)
            raise found[0]
        steps = [math.ceil(min(round(value / h, 9), NEVER)) for value in (delay, jitter)]
        return cls(
            np.full(arcs, steps[0]),
            np.full(arcs, steps[1]),
            np.full(arcs, loss, dtype=float),
            resolution,
        )

    @property
    def ideal(self) -> bool:
        """Whether every message arrives at once."""
        return not (self.delay.any() or self.jitter.any() or self.loss.any())

    @property
    def longest(self) -> int:
        """Longest delay of a message that arrives [steps]."""
        return min(int((self.delay + self.jitter).max(initial=0)), self.end)

    def drawn(
        self, random: np.random.Generator, steps: int, loss: Array
    ) -> tuple[np.ndarray[Any, np.dtype[np.bool_]], np.ndarray[Any, np.dtype[np.int64]]]:
        """Draw what becomes of the messages of some steps, the same however steps are divided.

        Returns
        -------
        (steps, arcs) array of bool, (steps, arcs) array of int
            Whether each message arrives, and how many steps later it would.
        """
        arcs = len(self.delay)
        if not self.jitter.any():
            arrives, later = random.random((steps, arcs)) >= loss, self.delay
        else:
            draws = random.random((steps, 2, arcs))
            arrives = draws[:, 0] >= loss
            later = self.delay + (draws[:, 1] * (self.jitter + 1)).astype(np.int64)
        return arrives, np.broadcast_to(np.minimum(later, self.end), (steps, arcs))


@attrs.define(eq=False)
class Mailbox:
    """State of the channel: the newest message that has arrived over each arc.

    Until the first message has arrived over an arc the sender's initial message is held: agents
    are started together and know how the others start.

    Parameters
    ----------
    channel : Channel
    initial : (arcs, k) array
        First content.
    random : numpy.random.Generator
    """

    channel: Channel
    held: Array
    random: np.random.Generator
    stamp: np.ndarray[tuple[int], np.dtype[np.int64]] = attrs.field(init=False)
    transit: dict[int, list[tuple[Array, Array, int]]] = attrs.field(factory=dict, init=False)
    sent: int = attrs.field(default=0, init=False)
    lost: int = attrs.field(default=0, init=False)

    def __attrs_post_init__(self) -> None:
        self.stamp = np.full(len(self.held), -1)

    def exchange(self, k: int, message: Array, loss: Array | None = None) -> Array:
        """Send one message over each arc at step k and return what every arc now holds.

        Parameters
        ----------
        k : int
            Communication step.
        message : (arcs, width) array
        loss : (arcs,) array, optional
            Probability of loss now; default that of the channel.

        Returns
        -------
        (arcs, width) array
        """
        self.sent += len(message)
        if self.channel.ideal and loss is None:
            self.held = message
            self.stamp[:] = k
            return message
        loss = self.channel.loss if loss is None else loss
        arcs = np.arange(len(message))
        arrives, later = self.channel.drawn(self.random, 1, loss)
        arrives, due = arrives[0], k + later[0]
        self.lost += int((~arrives).sum())
        for when in np.unique(due[arrives]):
            chosen = arcs[arrives & (due == when)]
            self.transit.setdefault(int(when), []).append((chosen, message[chosen], k))
        held = self.held.copy()
        for chosen, content, sent_at in self.transit.pop(k, []):
            # with jitter an older message may come after a newer one: it is dropped
            newer = self.stamp[chosen] < sent_at
            held[chosen[newer]] = content[newer]
            self.stamp[chosen[newer]] = sent_at
        self.held = held
        return held

    def age(self, k: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        """How many steps ago what each arc holds was sent, (arcs,)."""
        return k - np.maximum(self.stamp, 0)


@attrs.define(eq=False)
class Arrivals:
    """What a `Mailbox` with the same seed would deliver, for many steps at once, without contents.

    Parameters
    ----------
    channel : Channel
    random : numpy.random.Generator

    Attributes
    ----------
    lost : (steps,) array of int
        Messages lost in each step of the last draw.

    Examples
    --------
    >>> channel = Channel.uniform(2, h=0.1, delay=0.2)
    >>> Arrivals(channel, np.random.default_rng(1)).draw(0, 4)  # the first arrive after two steps
    array([[-1, -1],
           [-1, -1],
           [ 2,  2],
           [ 2,  2]], dtype=int32)
    """

    channel: Channel
    random: np.random.Generator
    lost: Steps = attrs.field(init=False)
    _end: int = attrs.field(default=0, init=False)  # what is drawn ends here
    _ages: np.ndarray[tuple[int, int], np.dtype[np.int32]] = attrs.field(init=False)  # up to there
    _lost: Steps = attrs.field(init=False)
    _taken: Steps = attrs.field(init=False)  # (arcs,) when the newest that has arrived was sent
    _coming: Steps = attrs.field(init=False)  # and that which arrives so many steps after the end

    def __attrs_post_init__(self) -> None:
        arcs = len(self.channel.delay)
        self._ages = np.empty((0, arcs), dtype=np.int32)
        self._taken = np.full(arcs, -1)
        self._coming = np.full((self.channel.longest, arcs), -1)
        self.lost = self._lost = np.zeros(0, dtype=np.int64)

    def draw(
        self, begin: int, end: int, loss: Array | None = None
    ) -> np.ndarray[tuple[int, int], np.dtype[np.int32]]:
        """Return the age of the message taken at each step and arc, -1 where none is.

        Parameters
        ----------
        begin, end : int
            Steps, end not included; begin is not after the end of the last draw, and not before
            its beginning. What is drawn stays as it is, when a run stops before the end of a
            draw and goes on from there.
        loss : (arcs,) array, optional
            Probability of loss in these steps; default that of the channel.

        Returns
        -------
        (end - begin, arcs) array of int
        """
        rows = len(self._ages) - (self._end - begin)  # that are behind
        self._ages, self._lost = self._ages[rows:], self._lost[rows:]
        if end > self._end:
            ages, lost = self._drawn(self._end, end, self.channel.loss if loss is None else loss)
            self._ages = np.concatenate([self._ages, ages])
            self._lost = np.concatenate([self._lost, lost])
            self._end = end
        self.lost = self._lost[: end - begin]
        return self._ages[: end - begin]

    def _drawn(self, begin: int, end: int, loss: Array) -> tuple[Steps, Steps]:
        steps, sent_at = end - begin, np.arange(begin, end)[:, None]
        arrives, later = self.channel.drawn(self.random, steps, loss)
        newest = np.full((steps + len(self._coming), len(self._taken)), -1)  # of each arrival
        newest[: len(self._coming)] = self._coming
        for delay in np.flatnonzero(np.bincount(later.ravel()))[::-1]:  # the newer last
            np.copyto(newest[delay : delay + steps], sent_at, where=arrives & (later == delay))
        self._coming = newest[steps:].copy()
        # with jitter an older message may come after a newer one: it is dropped
        taken = np.maximum.accumulate(np.concatenate([self._taken[None], newest[:steps]]))
        self._taken = taken[-1].copy()
        ages = np.where(newest[:steps] > taken[:-1], sent_at - newest[:steps], -1)
        return ages.astype(np.int32), (~arrives).sum(axis=1)

    def state(self) -> dict[str, Any]:
        """Return what is under way where the last draw ended, and the random numbers, for JSON."""
        steps, arcs = np.nonzero(self._coming >= 0)
        return {
            "random": self.random.bit_generator.state,
            "taken": self._taken.tolist(),
            "coming": np.stack([steps, arcs, self._coming[steps, arcs]], axis=1).tolist(),
        }

    def restore(self, k: int, state: dict[str, Any]) -> None:
        """Go on from step k with what `state` returned there.

        Raises
        ------
        InputError
            If it is of another channel.
        """
        try:
            taken = np.array(state["taken"], dtype=np.int64)
            coming = np.array(state["coming"], dtype=np.int64).reshape(-1, 3).T
            if taken.shape != self._taken.shape or (coming < 0).any():
                raise ValueError(f"{taken.size} arcs, here {self._taken.size}")
            self._coming[:] = -1
            self._coming[coming[0], coming[1]] = coming[2]
            self.random.bit_generator.state = state["random"]
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise InputError(
                f"the snapshot is of another channel or version ({error}): run from the start"
            ) from None
        self._taken, self._end = taken, k
        self._ages, self._lost = self._ages[:0], self._lost[:0]
