"""The equations of an FMU, x' = f(t, x, u) and y = h(t, x, u), evaluated where they are asked."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, Protocol
from xml.etree import ElementTree

import attrs
import numpy as np
from numpy.typing import ArrayLike

from posmas_fmi.errors import ArchiveError, FmuCallError, FmuError, InputError
from posmas_fmi.expression import Array
from posmas_fmi.fmu.archive import require_file
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.instance import FmuInstance
from posmas_fmi.fmu.model_exchange import ModelExchangeFile, ModelExchangeInstance
from posmas_fmi.fmu.state import FmuState

Interface = Literal["Model Exchange", "Co-Simulation"]
Values = Mapping[str, ArrayLike]

TOLERANCE = 1e-12  # relative, of the solver inside a Co-Simulation FMU where it listens
_SET = 1e-9  # relative: a value read back is the one that was set


class Equations(Protocol):
    """The right-hand side and the outputs of one FMU.

    Attributes
    ----------
    how : str
        How the operating point is returned to: ``"state restored"`` or ``"fresh instances"``.
    """

    how: str

    def __call__(self, t: float, x: Array, u: Array) -> tuple[Array, Array]:
        """Return the derivatives and the outputs."""


@attrs.frozen
class Signals:
    """The variables that a linear model is about, elements of arrays by their own names.

    Attributes
    ----------
    inputs, outputs : tuple of str
    states, derivatives : tuple of str
        In the same order; `derivatives` is empty if the FMU shows none.
    """

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    states: tuple[str, ...]
    derivatives: tuple[str, ...]


@attrs.frozen(eq=False)
class Point:
    """An operating point.

    Attributes
    ----------
    time : float
        [s]
    x, u, y : ndarray
        In the order of `Signals`; x is empty where the states are unknown.
    """

    time: float
    x: Array
    u: Array
    y: Array


def open_fmu(path: str | Path, interface: Interface | None = None) -> FmuFile:
    """Load an FMU for Model Exchange if it can that, else for Co-Simulation.

    Parameters
    ----------
    path : path-like
    interface : {"Model Exchange", "Co-Simulation"}, optional
        Which one to take.

    Raises
    ------
    InputError
        If there is no such file.
    FmuError
        If it has no such interface, or cannot be loaded.
    """
    require_file(Path(path))
    if interface == "Model Exchange":
        return ModelExchangeFile(path)
    if interface == "Co-Simulation":
        return FmuFile(path)
    if interface is not None:
        raise InputError(f'expected "Model Exchange" or "Co-Simulation" (got {interface!r})')
    try:
        return ModelExchangeFile(path)
    except ArchiveError:
        raise
    except FmuError:  # no such interface, or no binary for it
        return FmuFile(path)


def signals(
    file: FmuFile,
    inputs: Sequence[str],
    outputs: Sequence[str],
    states: Sequence[str] | None = None,
) -> Signals:
    """Resolve names, and find the states.

    Parameters
    ----------
    file : FmuFile
    inputs, outputs : sequence of str
        Variables or elements (``u[1]``); the name of an array stands for all of its elements.
    states : sequence of str, optional
        Variables that are the states, for an FMU that does not declare any.

    Raises
    ------
    InputError
        If a name is unknown, no real variable, listed twice, or an input is none.
    """
    pairs = _declared(file)
    names = {"inputs": inputs, "outputs": outputs}
    if states is not None and not pairs:
        names["states"] = states
    found = {kind: _elements(file, kind, given) for kind, given in names.items()}
    for name in found["inputs"]:
        causality = file.variable(name).causality
        if causality != "input":
            raise InputError(
                f"expected an input (its causality is {causality})", f"{file.path.name}: {name}"
            )
    own = found.get("states", ())
    if pairs:
        own = tuple(n for state, _ in pairs for n in file.ports([state]).names)
    derivatives = tuple(n for _, rate in pairs for n in file.ports([rate]).names)
    if pairs and states is not None and set(_elements(file, "states", states)) != set(own):
        raise InputError(
            f"expected the states that the FMU declares: {', '.join(own)}", file.path.name
        )
    return Signals(found["inputs"], found["outputs"], own, derivatives)


def _declared(file: FmuFile) -> list[tuple[str, str]]:
    """Return states with their derivatives, in the order of the continuous states."""
    description = file.description
    rates = [unknown.variable for unknown in description.derivatives]
    rates = rates or [v for v in description.modelVariables if v.derivative is not None]
    return [(v.derivative.name, v.name) for v in rates if v.derivative is not None]


def _elements(file: FmuFile, kind: str, names: Sequence[str]) -> tuple[str, ...]:
    try:
        found = file.ports(names).names
    except FmuError as error:
        raise InputError(f"{error.message} ({kind})", file.path.name) from None
    twice = sorted({name for name in found if found.count(name) > 1})
    if twice:
        raise InputError(f"{twice[0]!r} is listed twice among the {kind}", file.path.name)
    return found


def check_values(file: FmuFile, values: Values) -> None:
    """Refuse values for variables that there are not.

    Raises
    ------
    InputError
    """
    for name in values:
        try:
            file.variable(name)
        except FmuError as error:
            raise InputError(error.message, file.path.name) from None


def bring_to(instance: FmuInstance, at: float, values: Values, step: float) -> None:
    """Initialise an instance and take it to a time, inputs held.

    Parameters
    ----------
    instance : FmuInstance
        Fresh.
    at : float
        [s]; the experiment begins at the file's start time, or at `at` if that is earlier.
    values : mapping
        Parameters, start values, inputs.
    step : float
        Communication step on the way [s].
    """
    start = min(start_time(instance.file), at)
    instance.initialise(values, start=start, tolerance=TOLERANCE)
    if isinstance(instance, ModelExchangeInstance):
        instance.start()
        instance.advance(at)
        return
    count = int((at - start) / step * (1 + 1e-12) + 1e-9)
    for k in range(count):
        instance.do_step(start + k * step, step)
    rest = at - (start + count * step)
    if rest > 1e-9 * step:
        instance.do_step(start + count * step, rest)


def start_time(file: FmuFile) -> float:
    """Start of the default experiment [s]; 0 if the FMU tells none."""
    return _experiment(file, "startTime") or 0.0


def default_step(file: FmuFile) -> float:
    """Communication step [s] that suits the FMU: its own, else a thousandth of its experiment."""
    fixed = _positive(getattr(file.description.coSimulation, "fixedInternalStepSize", None))
    step = fixed or _positive(_experiment(file, "stepSize"))
    duration = (_experiment(file, "stopTime") or 0.0) - start_time(file)
    return step or (duration / 1000 if duration > 0 else 1e-3)


def _experiment(file: FmuFile, key: str) -> float | None:
    """Return what the default experiment says; None if that is no finite number."""
    return _finite(getattr(file.description.defaultExperiment, key, None))


def _finite(text: object) -> float | None:
    try:
        value = float(str(text))
    except ValueError:
        return None
    return value if np.isfinite(value) else None


def _positive(text: object) -> float | None:
    value = _finite(text)
    return value if value is not None and value > 0 else None


# ---- the two interfaces -------------------------------------------------------------------------


class ModelExchangeEquations:
    """Equations through Model Exchange: time, states and inputs are set, the rest is read.

    Parameters
    ----------
    instance : ModelExchangeInstance
        In Continuous-Time Mode.
    names : Signals
    """

    how = "state restored"

    def __init__(self, instance: ModelExchangeInstance, names: Signals) -> None:
        self.instance = instance
        self._inputs = instance.file.ports(names.inputs)
        self._outputs = instance.file.ports(names.outputs)

    def __call__(self, t: float, x: Array, u: Array) -> tuple[Array, Array]:
        """Return the derivatives and the outputs."""
        instance = self.instance
        instance.set_time(t)
        instance.set_states(x)
        _write(instance, self._inputs, u)
        # outputs first: FMUs of OpenModelica 1.13 take all else as up to date after derivatives
        y = _read(instance, self._outputs)
        return instance.derivatives(), y


class InitialisationEquations:
    """Equations of a Co-Simulation FMU, read in Initialization Mode.

    There an FMU must answer for whatever start values it was given (FMI 2.0.5 section 2.1.6,
    FMI 3.0.2 section 2.3.3), with no step between setting and reading.

    Parameters
    ----------
    file : FmuFile
    names : Signals
        With states and derivatives.
    values : mapping
        Parameters and other start values.
    restores : bool
        Whether to come back to the start by a saved state, else by a new instance each time.

    Raises
    ------
    FmuError
        On a call, if the states do not take the values they are given.
    """

    def __init__(self, file: FmuFile, names: Signals, values: Values, restores: bool) -> None:
        self.how = "state restored" if restores else "fresh instances"
        self._restart = Restart(file, names, values)
        self._read = file.ports([*names.derivatives, *names.outputs])
        self._saved: tuple[float, FmuInstance, FmuState] | None = None
        self._restores = restores
        self._n = len(names.derivatives)

    def __call__(self, t: float, x: Array, u: Array) -> tuple[Array, Array]:
        """Return the derivatives and the outputs."""
        if self._restores:
            values = self._from_saved(t, x, u)
        else:
            with self._restart.prepared(t, x, u) as instance:
                values = instance.read(self._read)
        return values[: self._n], values[self._n :]

    def _from_saved(self, t: float, x: Array, u: Array) -> Array:
        if self._saved is None or self._saved[0] != t:
            if self._saved is not None:
                self._saved[1].free()
            instance = self._restart.prepared(t, x, u)
            self._saved = (t, instance, instance.get_state())
        _, instance, state = self._saved
        instance.set_state(state)
        self._restart.set(instance, x, u)
        return instance.read(self._read)


class Restart:
    """Instances of a Co-Simulation FMU that begin at a given time, state and input.

    Parameters
    ----------
    file : FmuFile
    names : Signals
    values : mapping
        Parameters and other start values.
    """

    def __init__(self, file: FmuFile, names: Signals, values: Values) -> None:
        self.file, self.values = file, values
        self._states, self._inputs = file.ports(names.states), file.ports(names.inputs)

    def prepared(self, t: float, x: Array, u: Array) -> FmuInstance:
        """Return a new instance in Initialization Mode.

        Raises
        ------
        FmuError
            If the states do not take the values.
        """
        instance = self.file.instantiate("restart")
        try:
            instance.set(self.values)
            _write(instance, self._states, x)
            _write(instance, self._inputs, u)
            instance.enter_initialization(start=t, tolerance=TOLERANCE)
            self.set(instance, x, u)
        except BaseException:
            instance.free()
            raise
        return instance

    def set(self, instance: FmuInstance, x: Array, u: Array) -> None:
        """In Initialization Mode: set state and inputs, and read the state back."""
        with suppress(FmuCallError):  # set before as well; what counts is what is read back
            _write(instance, self._states, x)
        _write(instance, self._inputs, u)
        back = _read(instance, self._states)
        if not np.allclose(back, x, rtol=_SET, atol=_SET):
            k = int(np.argmax(np.abs(back - x)))
            raise FmuError(
                f"the state {self._states.names[k]!r} does not start where it is told: set to "
                f"{x[k]:g}, it is {back[k]:g}",
                self.file.path.name,
            )

    def stepped(self, t: float, x: Array, u: Array, step: float) -> FmuInstance:
        """Return an instance that made one step from there."""
        instance = self.prepared(t, x, u)
        try:
            instance.exit_initialization()
            instance.do_step(t, step)
        except BaseException:
            instance.free()
            raise
        return instance


def saves_state(file: FmuFile) -> bool:
    """Whether the FMU says that its state can be saved and restored."""
    return _says(file, "canGetAndSetFMUstate", "canGetAndSetFMUState")


def differentiates(file: FmuFile) -> bool:
    """Whether the FMU says that it has directional derivatives."""
    return _says(file, "providesDirectionalDerivative", "providesDirectionalDerivatives")


def steps_vary(file: FmuFile) -> bool:
    """Whether a Co-Simulation FMU says that it takes communication steps of any length."""
    name = "canHandleVariableCommunicationStepSize"
    return _says(file, name, name)


def _says(file: FmuFile, fmi2: str, fmi3: str) -> bool:
    """Read a flag of the interface from the file: FMPy takes over some of FMI 3's only."""
    root = ElementTree.parse(file.folder / "modelDescription.xml").getroot()
    element = root.find(file.kind.replace(" ", "").replace("-", ""))
    flag = None if element is None else element.get(fmi2 if file.version == 2 else fmi3)
    return flag in ("true", "1")


def _write(instance: FmuInstance, ports: Any, values: Array) -> None:
    if ports.size:
        instance.write(ports, values)


def _read(instance: FmuInstance, ports: Any) -> Array:
    return instance.read(ports) if ports.size else np.zeros(0)


def equations(
    file: FmuFile, names: Signals, values: Values, instance: FmuInstance
) -> list[Callable[[], Equations]]:
    """Return the ways to evaluate the equations of this FMU, the best first.

    Parameters
    ----------
    file : FmuFile
    names : Signals
    values : mapping
        Parameters and other start values.
    instance : FmuInstance
        At the operating point; used with Model Exchange.
    """
    if isinstance(instance, ModelExchangeInstance):
        own = instance
        return [lambda: ModelExchangeEquations(own, names)]
    if not names.derivatives:
        return []
    ways: list[Callable[[], Equations]] = []
    if saves_state(file):
        ways.append(lambda: InitialisationEquations(file, names, values, restores=True))
    ways.append(lambda: InitialisationEquations(file, names, values, restores=False))
    return ways


def labels(names: Sequence[str]) -> list[str]:
    """Return names that python-control takes: it keeps dots for subsystems."""
    return [name.replace(".", "_") for name in names]
