"""Conditions that change during a run: faults of sensors and actuators, losses, the digraph."""

from __future__ import annotations

import math
from typing import Any, Literal

import attrs
import numpy as np

from posmas_fmi.expression import Array

What = Literal["sensor_gain", "sensor_offset", "sensor_noise", "actuator_gain", "loss", "arc_off"]


@attrs.frozen(eq=False)
class Episode:
    """One thing that is otherwise from one communication point to another.

    Attributes
    ----------
    what : str
        ``sensor_gain``: 1 follows, 0 shows its last value; ``sensor_offset``: added to what is
        measured; ``sensor_noise``: standard deviation of noise that is added besides;
        ``actuator_gain``: 1 follows the command, 0 stays, between: goes that part of the
        way in each step; ``loss``: probability that a message is lost; ``arc_off``: 1 takes an arc
        out of the digraph.
    index : tuple or array
        Of the entries, in arrays (agents, measured), (agents, inputs) or (arcs,).
    value : float
    begin, end : int
        Communication points, end not included; an end that never comes is `NEVER`.
    """

    what: What
    index: Any
    value: float
    begin: int
    end: int


NEVER = 2**62


@attrs.frozen(eq=False)
class Conditions:
    """What holds from one communication point on.

    Attributes
    ----------
    sensor_gain, sensor_offset, sensor_noise : (N, measured) array
    actuator_gain : (N, p) array
    loss : (arcs,) array
        Arcs between agents, then those from the leader to the pinned.
    arc_off : (arcs,) array
        1: the arc is not in the digraph.
    """

    sensor_gain: Array
    sensor_offset: Array
    sensor_noise: Array
    actuator_gain: Array
    loss: Array
    arc_off: Array

    @property
    def exact_sensors(self) -> bool:
        """Whether every sensor shows what it measures."""
        return bool((self.sensor_gain == 1.0).all() and not self.sensor_offset.any())

    @property
    def exact_actuators(self) -> bool:
        """Whether every actuator does what it is told."""
        return bool((self.actuator_gain == 1.0).all())


@attrs.frozen(eq=False)
class Timeline:
    """All episodes of a run.

    Parameters
    ----------
    agents, measured, inputs : int
        Sizes.
    loss : (arcs,) array
        Of the channel, without episodes.
    episodes : tuple of Episode

    Examples
    --------
    >>> stuck = Episode("sensor_gain", (0, 0), 0.0, begin=5, end=8)
    >>> timeline = Timeline(2, 1, 1, np.zeros(1), (stuck,))
    >>> timeline.next_change(0), timeline.next_change(5), timeline.next_change(8) == NEVER
    (5, 8, True)
    >>> timeline.at(6).sensor_gain.ravel()
    array([0., 1.])
    """

    agents: int
    measured: int
    inputs: int
    loss: Array
    episodes: tuple[Episode, ...] = ()

    def at(self, k: int) -> Conditions:
        """Conditions that hold at communication point k; of two episodes the later one counts."""
        conditions = Conditions(
            np.ones((self.agents, self.measured)),
            np.zeros((self.agents, self.measured)),
            np.zeros((self.agents, self.measured)),
            np.ones((self.agents, self.inputs)),
            self.loss.copy(),
            np.zeros(len(self.loss)),
        )
        for episode in self.episodes:
            if episode.begin <= k < episode.end:
                getattr(conditions, episode.what)[episode.index] = episode.value
        return conditions

    def next_change(self, k: int) -> int:
        """First communication point after k at which conditions change; `NEVER` if none."""
        points = (point for e in self.episodes for point in (e.begin, e.end))
        return min((point for point in points if point > k), default=NEVER)

    def has(self, *what: What) -> bool:
        """Whether anything of that kind ever happens."""
        return any(episode.what in what for episode in self.episodes)


@attrs.frozen(eq=False)
class Sensors:
    """What the sensors make of what they measure, in every run alike.

    Attributes
    ----------
    noise : (N, measured) array
        Standard deviation.
    resolution : (N, measured) array
        Step between two values; 0 for none.
    """

    noise: Array
    resolution: Array

    def noise_at(self, begin: int, end: int, seed: int) -> Array:
        """Noise of the communication points begin … end - 1, the same however they are asked for.

        Returns
        -------
        (end - begin, N, measured) array
        """
        rows = np.empty((end - begin, *self.noise.shape))
        philox = np.random.Philox(key=[seed, 0x5E5], counter=[0, 0, 0, begin])
        random, state = np.random.Generator(philox), philox.state
        for row, k in enumerate(range(begin, end)):
            state["state"]["counter"][3] = k
            philox.state = state  # quicker than a new one for each point
            random.standard_normal(out=rows[row])
        return rows * self.noise


def rounded(value: Array, resolution: Array | float) -> Array:
    """Round to multiples of the resolution where it is not 0.

    Examples
    --------
    >>> rounded(np.array([1.26, 1.26]), np.array([0.5, 0.0]))
    array([1.5 , 1.26])
    """
    if not np.any(resolution):
        return value
    step = np.where(np.asarray(resolution) > 0, resolution, 1.0)
    return np.asarray(np.where(np.asarray(resolution) > 0, step * np.rint(value / step), value))


def steps_of(time: float | None, h: float) -> int:
    """Communication point at or after a time [s]; `NEVER` for none."""
    return NEVER if time is None else math.ceil(round(time / h, 9))
