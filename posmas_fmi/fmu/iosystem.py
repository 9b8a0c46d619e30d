"""An FMU as a python-control system, for `linearize`, `find_operating_point` and the rest."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from posmas_fmi.errors import FmuError, InputError
from posmas_fmi.expression import Array
from posmas_fmi.fmu.evaluation import (
    TOLERANCE,
    Interface,
    ModelExchangeEquations,
    Restart,
    Signals,
    Values,
    check_values,
    default_step,
    labels,
    open_fmu,
    signals,
    start_time,
)
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.model_exchange import ModelExchangeInstance

if TYPE_CHECKING:
    import control


def fmu_to_iosystem(
    path: str | Path,
    inputs: Sequence[str],
    outputs: Sequence[str],
    *,
    values: Values | None = None,
    states: Sequence[str] | None = None,
    interface: Interface | None = None,
    dt: float | None = None,
) -> control.NonlinearIOSystem:
    """Return an FMU as a `control.NonlinearIOSystem`.

    With Model Exchange it is continuous: x' and y are what the FMU answers for time, states and
    inputs. With Co-Simulation it is sampled: x₊ is the state after one communication step of a
    new instance that starts from x with the inputs held. Events are not handled: the system is
    the mode that the FMU starts in.

    Parameters
    ----------
    path : path-like
    inputs, outputs : sequence of str
        Variables or elements (``u[1]``); an array's name stands for all of its elements.
    values : mapping, optional
        Parameters and other start values by name; those of the file by default.
    states : sequence of str, optional
        Variables that are the states, if a Co-Simulation FMU does not declare any.
    interface : {"Model Exchange", "Co-Simulation"}, optional
        Model Exchange by default, if the FMU has it.
    dt : float, optional
        Communication step of a Co-Simulation FMU [s]; its own by default.

    Returns
    -------
    control.NonlinearIOSystem
        Signals are named after the variables, with ``_`` for a dot. It keeps the FMU loaded as
        long as it lives. Like the FMU it is not to be used by two threads at once.

    Raises
    ------
    InputError
        If there is no such file or variable, or `dt` is given for Model Exchange.
    FmuError
        If the FMU fails, or is for Co-Simulation and has no states that can be set;
        `posmas_fmi.fmu.linearise.linearise` may still find a linear model.

    Examples
    --------
    >>> import control
    >>> from posmas_fmi.expression import VectorFunction
    >>> from posmas_fmi.fmu.build import agent_fmu
    >>> g = VectorFunction.parse(["0"], ["t", "x1"])
    >>> path = agent_fmu(g, VectorFunction.parse(["tanh(u1)"], ["u1"]), 1, 1, 1)
    >>> plant = fmu_to_iosystem(path, ["u"], ["y"], values={"A": [[-2.0]], "B": [[3.0]]})
    >>> plant.state_labels, plant.isctime()
    (['x[1]'], True)
    >>> control.linearize(plant, [0.0], [0.0]).A.round(6)
    array([[-2.]])
    """
    values = dict(values or {})
    if dt is not None and not 0 < dt < np.inf:
        raise InputError(f"expected a communication step > 0 s (got {dt})")
    file = open_fmu(path, interface)
    try:
        names = signals(file, inputs, outputs, states)
        check_values(file, values)
        if file.kind == "Model Exchange":
            if dt is not None:
                raise InputError("expected no dt: Model Exchange is continuous", file.path.name)
            return _continuous(file, names, values)
        return _sampled(file, names, values, dt or default_step(file))
    except BaseException:
        file.close()
        raise


def _continuous(file: FmuFile, names: Signals, values: Values) -> control.NonlinearIOSystem:
    import control

    instance = file.instantiate("iosystem")
    assert isinstance(instance, ModelExchangeInstance)
    instance.initialise(values, start=start_time(file), tolerance=TOLERANCE)
    instance.start()
    equations = ModelExchangeEquations(instance, names)

    def update(t: float, x: Array, u: Array, params: object) -> Array:
        return equations(t, np.asarray(x), np.asarray(u))[0]

    def output(t: float, x: Array, u: Array, params: object) -> Array:
        return equations(t, np.asarray(x), np.asarray(u))[1]

    return control.NonlinearIOSystem(update, output, name=_name(file), **_signals(names))


def _sampled(file: FmuFile, names: Signals, values: Values, dt: float) -> control.NonlinearIOSystem:
    import control

    if not names.states:
        raise FmuError(
            "expected a Co-Simulation FMU that declares its states (name them, or use linearise)",
            file.path.name,
        )
    restart = Restart(file, names, values)
    states, outputs = file.ports(names.states), file.ports(names.outputs)

    def update(t: float, x: Array, u: Array, params: object) -> Array:
        with restart.stepped(t, np.asarray(x), np.asarray(u), dt) as instance:
            return instance.read(states)

    def output(t: float, x: Array, u: Array, params: object) -> Array:
        with restart.prepared(t, np.asarray(x), np.asarray(u)) as instance:
            return instance.read(outputs)

    # refuse at once what would fail at the first use
    with file.instantiate("start") as instance:
        instance.initialise(values, start=start_time(file), tolerance=TOLERANCE)
        x, u = instance.read(states), np.zeros(0)
        if names.inputs:
            u = instance.read(file.ports(names.inputs))
    update(start_time(file), x, u, None)
    return control.NonlinearIOSystem(update, output, dt=dt, name=_name(file), **_signals(names))


def _signals(names: Signals) -> dict[str, list[str]]:
    return {
        "inputs": labels(names.inputs),
        "outputs": labels(names.outputs),
        "states": labels(names.states),
    }


def _name(file: FmuFile) -> str:
    return "".join(c if c.isalnum() else "_" for c in file.path.stem)
