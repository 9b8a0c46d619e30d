"""The channel: what each arc holds, with delay, jitter and loss; the last value is kept."""

from __future__ import annotations

import math
from typing import Any

import attrs
import numpy as np

from posmas_fmi.errors import InputError
from posmas_fmi.expression import Array


@attrs.frozen(eq=False)
class Channel:
    """Delay, jitter and loss of the messages on the arcs.

    Parameters
    ----------
    delay : (arcs,) array of int
        Communication steps that every message takes.
    jitter : (arcs,) array of int
        Largest additional delay, drawn for each message alike likely.
    loss : (arcs,) array
        Probability that a message does not arrive.
    resolution : float
        Messages are rounded to multiples of it; 0: they are not.
    """

    delay: np.ndarray[tuple[int], np.dtype[np.int64]]
    jitter: np.ndarray[tuple[int], np.dtype[np.int64]]
    loss: Array
    resolution: float = 0.0

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
            If a delay is negative or the loss not in [0, 1].

        Examples
        --------
        >>> Channel.uniform(2, h=0.1, delay=0.25).delay
        array([3, 3])
        """
        for name, value in (("delay", delay), ("jitter", jitter)):
            if not 0.0 <= value < math.inf:
                raise InputError(f"expected a time >= 0 s (got {value!r})", f"$.channel.{name}")
        if not 0.0 <= resolution < math.inf:
            raise InputError(f"expected a number >= 0 (got {resolution!r})", "$.channel.resolution")
        if not 0.0 <= loss <= 1.0:
            raise InputError(f"expected a probability in [0, 1] (got {loss!r})", "$.channel.loss")
        steps = [math.ceil(round(value / h, 9)) for value in (delay, jitter)]
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
        return int((self.delay + self.jitter).max(initial=0))


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
        arrives = self.random.random(len(message)) >= loss
        extra = self.random.integers(0, self.channel.jitter + 1)
        due = k + self.channel.delay + extra
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
    """What a `Mailbox` with the same seed would deliver, step after step, without the contents.

    Parameters
    ----------
    channel : Channel
    random : numpy.random.Generator

    Attributes
    ----------
    lost : (steps,) array of int
        Messages lost in each step of the last draw.
    """

    channel: Channel
    random: np.random.Generator
    lost: np.ndarray[tuple[int], np.dtype[np.int64]] = attrs.field(init=False)
    _stamp: np.ndarray[tuple[int], np.dtype[np.int64]] = attrs.field(init=False)
    _due: dict[int, list[tuple[np.ndarray[Any, np.dtype[np.intp]], int]]] = attrs.field(
        factory=dict, init=False
    )

    def __attrs_post_init__(self) -> None:
        self._stamp = np.full(len(self.channel.delay), -1)
        self.lost = np.zeros(0, dtype=np.int64)

    def draw(
        self, begin: int, end: int, loss: Array | None = None
    ) -> np.ndarray[tuple[int, int], np.dtype[np.int32]]:
        """Return the age of the message taken at each step and arc, -1 where none is.

        Parameters
        ----------
        begin, end : int
            Steps, end not included; begin where the last draw ended.
        loss : (arcs,) array, optional
            Probability of loss in these steps; default that of the channel.

        Returns
        -------
        (end - begin, arcs) array of int
        """
        arcs = len(self._stamp)
        loss = self.channel.loss if loss is None else loss
        ages = np.full((end - begin, arcs), -1, dtype=np.int32)
        self.lost = np.zeros(end - begin, dtype=np.int64)
        for row, k in enumerate(range(begin, end)):
            # the same two draws as in Mailbox.exchange
            arrives = self.random.random(arcs) >= loss
            due = k + self.channel.delay + self.random.integers(0, self.channel.jitter + 1)
            self.lost[row] = arcs - int(arrives.sum())
            for when in np.unique(due[arrives]):
                self._due.setdefault(int(when), []).append(
                    (np.flatnonzero(arrives & (due == when)), k)
                )
            for chosen, sent_at in self._due.pop(k, []):
                newer = chosen[self._stamp[chosen] < sent_at]
                self._stamp[newer] = sent_at
                ages[row, newer] = k - sent_at
        return ages
