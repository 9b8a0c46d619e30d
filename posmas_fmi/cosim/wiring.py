"""Wiring: inputs of FMUs that no controller sets: exogenous signals, readings of other FMUs."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any
from typing import Protocol as Interface

import attrs
import numpy as np
import scipy.sparse as sp

from posmas_fmi.expression import Array

Whole = np.ndarray[tuple[int], np.dtype[np.int64]]
Flags = np.ndarray[tuple[int], np.dtype[np.bool_]]


class Drive(Interface):
    """Exogenous signals, held from one communication point to the next."""

    @property
    def columns(self) -> int:
        """How many."""

    def rows(self, begin: int, end: int) -> Array:
        """Values at the communication points begin … end - 1, (end - begin, columns)."""


@attrs.frozen(eq=False)
class NoDrive:
    """No exogenous signals."""

    columns: int = 0

    def rows(self, begin: int, end: int) -> Array:
        """Return rows without columns."""
        return np.zeros((end - begin, 0))


@attrs.frozen
class Term:
    """One summand of an input: ``weight`` times a reading, or times a column of the drive.

    Attributes
    ----------
    source : int
        A reading by its place among those of all instances, or ``-1 - column``.
    weight : float
    """

    source: int
    weight: float = 1.0


def column(number: int) -> int:
    """Return the source of a term for a column of the drive."""
    return -1 - number


@attrs.frozen(eq=False)
class Extra:
    """An input of an FMU beside u: ``bias + Σ weight · source``.

    Attributes
    ----------
    terms : tuple of Term
    bias : float
    is_rate : bool
        Whether it is the derivative of an input: of readings, the rate of change counts.
    has_rate : bool
        Whether it goes on with such a derivative: readings are those where the step begins.
    """

    terms: tuple[Term, ...]
    bias: float = 0.0
    is_rate: bool = False
    has_rate: bool = False


@attrs.frozen(eq=False, slots=False)
class Wiring:
    """All inputs beside u, what is measured beside y, and what is recorded besides.

    Parameters
    ----------
    extras : sequence of tuple of Extra
        Of each instance, in the order of its inputs.
    measured : (N, k) array of int
        Source of what each agent measures beside y.
    recorded : tuple of int
        Sources that are recorded.
    drive : Drive

    Examples
    --------
    >>> pair = Wiring(((), (Extra((Term(0, 2.0),), 1.0),)), np.zeros((1, 0), int))
    >>> pair.inputs(np.array([3.0]), np.zeros(0))
    array([7.])
    """

    extras: Sequence[tuple[Extra, ...]]
    measured: np.ndarray[tuple[int, int], np.dtype[np.int64]]
    recorded: tuple[int, ...] = ()
    drive: Drive = attrs.field(factory=NoDrive)

    @classmethod
    def none(cls, agents: int, instances: int | None = None) -> Wiring:
        """Nothing is wired."""
        count = agents if instances is None else instances
        return cls(((),) * count, np.zeros((agents, 0), dtype=np.int64))

    # ---- as arrays, for the engine --------------------------------------------------------------

    @cached_property
    def flat(self) -> tuple[Extra, ...]:
        """The extra inputs of all instances, one after the other."""
        return tuple(extra for extras in self.extras for extra in extras)

    @cached_property
    def first_extra(self) -> Whole:
        """Where those of each instance begin, (instances + 1,)."""
        return _starts([len(extras) for extras in self.extras])

    @cached_property
    def first_term(self) -> Whole:
        """Where the terms of each extra input begin, (extras + 1,)."""
        return _starts([len(extra.terms) for extra in self.flat])

    @cached_property
    def sources(self) -> Whole:
        """Source of each term."""
        return np.array([t.source for e in self.flat for t in e.terms], dtype=np.int64)

    @cached_property
    def weights(self) -> Array:
        """Weight of each term."""
        return np.array([t.weight for e in self.flat for t in e.terms], dtype=float)

    @cached_property
    def bias(self) -> Array:
        """Bias of each extra input."""
        return np.array([extra.bias for extra in self.flat], dtype=float)

    # ---- as functions, for the numpy loop -------------------------------------------------------

    @cached_property
    def _matrices(self) -> tuple[sp.csr_array, sp.csr_array]:
        row = np.repeat(np.arange(len(self.flat)), np.diff(self.first_term))
        of_drive = self.sources < 0
        width = int(self.sources.max(initial=-1)) + 1
        made = []
        for chosen, place, columns in (
            (~of_drive, self.sources, width),
            (of_drive, -1 - self.sources, self.drive.columns),
        ):
            entries = (self.weights[chosen], (row[chosen], place[chosen]))
            made.append(sp.csr_array(entries, shape=(len(self.flat), columns)))
        return made[0], made[1]

    @cached_property
    def _rates(self) -> tuple[Flags, Flags]:
        """Which extra inputs are rates, and which go on with one."""
        extras = self.flat
        return np.array([e.is_rate for e in extras]), np.array([e.has_rate for e in extras])

    @cached_property
    def extrapolates(self) -> bool:
        """Whether an input goes on as the readings do that it is made of."""
        return any(e.is_rate and any(t.source >= 0 for t in e.terms) for e in self.flat)

    def inputs(
        self, readings: Array, drive: Array, begin: Array | None = None, rates: Array | None = None
    ) -> Array:
        """Values of all extra inputs, from the readings of all instances and a row of the drive.

        Parameters
        ----------
        readings, drive : array
        begin, rates : array, optional
            Readings where the step begins, and how they change over it [1/s]; needed where
            `extrapolates` is true.
        """
        if not self.flat:
            return np.zeros(0)
        of_readings, of_drive = self._matrices
        width = of_readings.shape[1]
        found = of_readings @ readings[:width]
        if begin is not None and rates is not None:
            is_rate, has_rate = self._rates
            found = np.where(has_rate, of_readings @ begin[:width], found)
            found = np.where(is_rate, of_readings @ rates[:width], found)
        return np.asarray(self.bias + found + of_drive @ drive)

    @staticmethod
    def take(sources: Any, readings: Array, drive: Array) -> Array:
        """Values of sources, in their shape."""
        both = np.concatenate([readings, drive[::-1]])  # source -1 is the last, as in Python
        return np.asarray(both[sources])


def _starts(sizes: Sequence[int]) -> Whole:
    return np.concatenate([[0], np.cumsum(np.array(sizes, dtype=np.int64))]).astype(np.int64)
