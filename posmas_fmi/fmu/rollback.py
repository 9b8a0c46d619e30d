"""Whether going back to a saved state is what it says: replayed and compared, with bytes too."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import attrs
import numpy as np

from posmas_fmi.errors import FmuError
from posmas_fmi.expression import Array
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.instance import FmuInstance
from posmas_fmi.fmu.variables import REAL, WHOLE

_MOST_VARIABLES = 1000  # that are compared


@attrs.frozen
class Replay:
    """What came of steps that were done again.

    Attributes
    ----------
    works : bool
        Whether the calls succeeded.
    exact : bool
        Whether all values were the same bit for bit.
    noise : float
        Largest difference, relative to the size of a value or 1; inf if it does not work.
    reason : str
        Why it does not work.
    """

    works: bool
    exact: bool = False
    noise: float = math.inf
    reason: str = ""


@attrs.frozen
class Rollback:
    """What `selftest_rollback` found.

    Attributes
    ----------
    state : Replay
        After going back to a saved state.
    serialised : Replay
        After going back to one that was bytes in between.
    fresh : Replay
        In a fresh instance that was given those bytes.
    """

    state: Replay
    serialised: Replay
    fresh: Replay


def selftest_rollback(
    file: FmuFile,
    period: float,
    *,
    steps: int = 3,
    values: Mapping[str, Any] | None = None,
    inputs: Mapping[str, float] | None = None,
    outputs: Sequence[str] | None = None,
) -> Rollback:
    """Save the state of an instance, step on, go back, step again, and compare.

    Parameters
    ----------
    file : FmuFile
        A fresh instance of it is made, and for `Rollback.fresh` a second one.
    period : float
        Communication step [s].
    steps : int
        That are repeated.
    values : mapping, optional
        Start values and parameters.
    inputs : mapping, optional
        Inputs at the beginning of the steps that are repeated; they grow by 1 % from step to step.
    outputs : sequence of str, optional
        What is compared; by default all outputs that are numbers, or where there are none all
        local variables.

    Returns
    -------
    Rollback

    Raises
    ------
    FmuError
        If the FMU cannot be initialised or does not step at all.

    Notes
    -----
    That an FMU declares canGetAndSetFMUstate does not say that a replay is exact: solvers keep
    step sizes and Jacobians, caches keep values. What differs must be part of the tolerance of
    whatever compares repeated steps.
    """
    run = _Run(file, period, steps, dict(values or {}), dict(inputs or {}), outputs)
    with file.instantiate("rollback") as instance:
        begin = run.start(instance)
        try:
            state = instance.get_state()
        except FmuError as error:
            refused = Replay(False, reason=error.message)
            return Rollback(refused, refused, refused)
        first = run.go(instance, begin)
        again = run.attempt(instance, begin, first, lambda: instance.set_state(state))
        data: list[bytes] = []

        def through_bytes() -> None:
            instance.set_state(state)
            data.append(instance.serialise())
            run.go(instance, begin)
            instance.deserialise(data[0], begin)

        serialised = run.attempt(instance, begin, first, through_bytes)
    if not serialised.works:
        return Rollback(again, serialised, serialised)
    try:
        with file.instantiate("fresh") as other:
            run.start(other)
            fresh = run.attempt(other, begin, first, lambda: other.deserialise(data[0], begin))
    except FmuError as error:
        fresh = Replay(False, reason=error.message)
    return Rollback(again, serialised, fresh)


@attrs.frozen
class _Run:
    file: FmuFile
    period: float
    steps: int
    values: dict[str, Any]
    inputs: dict[str, float]
    outputs: Sequence[str] | None

    def start(self, instance: FmuInstance) -> float:
        """Initialise and step once, away from the initial state; return the time."""
        instance.initialise(self.values)
        instance.do_step(0.0, self.period)
        return self.period

    def go(self, instance: FmuInstance, begin: float) -> Array:
        """Do the steps; return all that is compared, (steps, …)."""
        seen = self.file.ports(self._seen())
        known = self.file.ports(tuple(self.inputs))
        given, rows = np.array(list(self.inputs.values()), dtype=float), []
        for k in range(self.steps):
            if given.size:
                instance.write(known, given * (1 + 0.01 * k))
            instance.do_step(begin + k * self.period, self.period)
            rows.append(instance.read(seen))
        return np.array(rows)

    def attempt(self, instance: FmuInstance, begin: float, first: Array, back: Any) -> Replay:
        try:
            back()
            again = self.go(instance, begin)
        except FmuError as error:
            return Replay(False, reason=error.message)
        difference = np.abs(again - first) / np.maximum(1.0, np.abs(first))
        exact = again.tobytes() == first.tobytes()
        return Replay(True, exact, float(difference.max(initial=0.0)))

    def _seen(self) -> tuple[str, ...]:
        if self.outputs is not None:
            return tuple(self.outputs)
        for causality in ("output", "local"):
            names = [
                v.name
                for v in self.file.variables.values()
                if v.causality == causality and v.type in REAL | WHOLE
            ]
            if names:
                return tuple(names[:_MOST_VARIABLES])
        return ()
