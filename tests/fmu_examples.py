"""The agents and plants that the FMU tests use, and their equations in numpy."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from scipy.integrate import solve_ivp

from posmas_fmi.expression import VectorFunction
from posmas_fmi.fmu.build import agent_fmu, fmu
from posmas_fmi.fmu.model import FmuModel
from posmas_fmi.fmu.plant import read_plant
from posmas_fmi.fmu.positive_agent import positive_agent


@attrs.frozen(eq=False)
class Example:
    """Model (1) with numbers."""

    A: np.ndarray
    H: np.ndarray
    B: np.ndarray
    C: np.ndarray
    g: VectorFunction
    sec: VectorFunction

    @property
    def sizes(self) -> tuple[int, int, int]:
        return len(self.A), self.B.shape[1], len(self.C)

    @property
    def matrices(self) -> dict[str, np.ndarray]:
        return {"A": self.A, "H": self.H, "B": self.B, "C": self.C}

    def model(self) -> FmuModel:
        return positive_agent(self.g, self.sec, *self.sizes)

    def fmu(self, fmi: int, cache: Path, **options: Any) -> Path:
        return agent_fmu(self.g, self.sec, *self.sizes, fmi=fmi, cache=cache, **options)

    def derivative(self) -> Callable[..., np.ndarray]:
        g, sec = self.g.numpy(), self.sec.numpy()
        return lambda t, x, u: self.A @ x + self.H @ g(t, *x) + self.B @ sec(*u)

    def trajectory(self, x: Any, times: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """States at `times`, each row of `inputs` held to the next time."""
        f, states = self.derivative(), [np.array(x, dtype=float)]
        for k in range(len(times) - 1):
            solution = solve_ivp(
                lambda t, x, u=inputs[k]: f(t, x, u),
                (times[k], times[k + 1]),
                states[-1],
                method="DOP853",
                rtol=1e-10,
                atol=1e-12,
            )
            states.append(solution.y[:, -1])
        return np.array(states)


def example_1() -> Example:
    """The paper's Example 1: a g that varies with time."""
    return Example(
        A=np.array([[-10.18, 9.98], [10.3, -9.84]]),
        H=np.array([[0.698, -0.26], [0.682, -0.34]]),
        B=np.array([[0.7], [0.7]]),
        C=np.array([[0.7, -0.3], [0.1, 0.6]]),
        g=VectorFunction.parse(["x1*sin(0.31*x1*t)", "x2*cos(0.31*x2*t)"], ["t", "x1", "x2"]),
        sec=VectorFunction.parse(["1.2*u1 - 0.3*u1*abs(sin(u1))"], ["u1"]),
    )


def wide() -> Example:
    """Different numbers of states, inputs and outputs."""
    return Example(
        A=np.array([[-3.0, 0.4, 0.0], [0.2, -2.0, 0.5], [1.0, 0.3, -4.0]]),
        H=np.array([[0.1, 0.0, 0.2], [0.0, 0.3, 0.0], [0.1, 0.1, 0.1]]),
        B=np.array([[1.0, 0.0], [0.0, 0.5], [0.2, 0.2]]),
        C=np.array([[1.0, 0.5, 0.25]]),
        g=VectorFunction.parse(
            ["tanh(x1*x2)", "x2*exp(-x3)*cos(t)", "min(x3, sqrt(1 + x1**2))"],
            ["t", "x1", "x2", "x3"],
        ),
        sec=VectorFunction.parse(["tanh(u1)", "clip(u2, -1, 1)"], ["u1", "u2"]),
    )


def named(values: Mapping[str, Any], fmi: int) -> dict[str, Any]:
    """Arrays by name as FMI 3 takes them, or each element by its name as FMI 2 does."""
    if fmi == 3:
        return dict(values)
    return {
        f"{name}[{','.join(str(i + 1) for i in index)}]": float(value)
        for name, array in values.items()
        for index, value in np.ndenumerate(np.asarray(array, dtype=float))
    }


def vector(name: str, size: int) -> list[str]:
    """Names of the elements of a vector, in both versions of FMI."""
    return [f"{name}[{k + 1}]" for k in range(size)]


TANK_TOML = """
name = "tank"
description = "A heated tank: scalars, a local variable, feedthrough"

[[variable]]
name = "loss"
role = "parameter"
start = 2.0
unit = "W/K"

[[variable]]
name = "power"
role = "input"
start = 100.0
unit = "W"

[[variable]]
name = "temperature"
role = "state"
start = 300.0
unit = "K"
nominal = 300.0

[[variable]]
name = "flow"
role = "local"
unit = "W"
depends = ["temperature"]

[[variable]]
name = "net"
role = "output"
unit = "W"

[experiment]
stop = 100
step = 1.0
tolerance = 1e-9
"""

TANK_C = """
#include "model.h"

void model_derivatives(double t, const double *p, const double *u, const double *x, double *dx)
{
    (void)t;
    dx[0] = (u[0] - p[0] * (x[0] - 290.0)) / 50.0;
}

void model_outputs(double t, const double *p, const double *u, const double *x, double *y)
{
    (void)t;
    y[0] = p[0] * (x[0] - 290.0);
    y[1] = u[0] - y[0];
}

void model_directional(double t, const double *p, const double *u, const double *x,
                       const double *su, const double *sx, double *sdx, double *sy)
{
    (void)t, (void)u, (void)x;
    sdx[0] = (su[0] - p[0] * sx[0]) / 50.0;
    sy[0] = p[0] * sx[0];
    sy[1] = su[0] - sy[0];
}
"""


def tank(folder: Path) -> FmuModel:
    """A plant written by hand in C."""
    folder.mkdir(exist_ok=True)
    (folder / "model.toml").write_text(TANK_TOML, encoding="utf-8")
    (folder / "model.c").write_text(TANK_C, encoding="utf-8")
    return read_plant(folder)


def tank_fmu(folder: Path, fmi: int) -> Path:
    return fmu(tank(folder / "tank"), fmi, cache=folder)
