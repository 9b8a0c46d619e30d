"""Model Exchange FMUs as if they were for Co-Simulation: an integrator takes them through time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from posmas_fmi.fmu.model_exchange import ModelExchangeFile, ModelExchangeInstance
from posmas_fmi.fmu.variables import Ports

if TYPE_CHECKING:
    from posmas_fmi.expression import Array  # SymPy, which a worker does not need

RTOL = 1e-8  # of the integration, unless the run says another one


class SteppedFile(ModelExchangeFile):
    """A Model Exchange FMU whose instances take communication steps.

    Parameters, attributes and errors are those of `posmas_fmi.fmu.file.FmuFile`.
    """

    @property
    def in_python(self) -> bool:
        """True: the integrator is here."""
        return True

    def _made(self, name: str, key: int) -> SteppedInstance:
        return SteppedInstance(self, name, key)


class SteppedInstance(ModelExchangeInstance):
    """An instance that `do_step` integrates, with the inputs held and events handled on the way.

    Attributes
    ----------
    rtol : float
        Relative tolerance of the integration; the absolute one is this times the nominal values.

    Raises
    ------
    FmuCallError
        As `posmas_fmi.fmu.instance.FmuInstance`.
    """

    def __init__(self, file: SteppedFile, name: str, key: int) -> None:
        super().__init__(file, name, key)
        self.rtol = RTOL
        self._held: dict[Ports, Array] = {}  # what was written last
        self._runs = False

    def enter_initialization(
        self, *, start: float = 0.0, stop: float | None = None, tolerance: float | None = None
    ) -> None:
        """Tell the experiment and enter Initialization Mode."""
        self.rtol = tolerance or self.rtol
        super().enter_initialization(start=start, stop=stop, tolerance=tolerance)

    def exit_initialization(self) -> None:
        """Leave Initialization Mode, settle the discrete states; the first step may follow."""
        super().exit_initialization()
        self.start()
        self._runs = True

    def reset(self) -> None:
        """Go back to the state after instantiation."""
        super().reset()
        self._runs = False
        self._held = {}

    def write(self, ports: Ports, values: ArrayLike) -> None:
        """Set the values at the ports; a change is an event, for inputs jump."""
        given = np.array(values, dtype=float).reshape(-1)
        before = self._held.get(ports)
        if not self._runs:
            super().write(ports, given)
        elif before is None or not np.array_equal(before, given):
            self.call("EnterEventMode")
            super().write(ports, given)
            self._settle()
            self._held[ports] = given

    def do_step(self, time: float, step: float) -> None:
        """Integrate from `time` over `step` [s]; state and time events are handled on the way."""
        self.advance(time + step, self.rtol)

    def _beside(self) -> dict[str, Any]:
        held = [[list(ports.names), values.tolist()] for ports, values in self._held.items()]
        return {**super()._beside(), "held": held}

    def _set_beside(self, kept: dict[str, Any]) -> None:
        super()._set_beside(kept)
        self._held = {self.file.ports(names): np.array(held) for names, held in kept["held"]}
