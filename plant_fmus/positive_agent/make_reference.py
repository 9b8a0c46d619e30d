"""Makes reference.csv: model (1) with Example 1's values, integrated by SciPy, without any FMU."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from posmas_fmi.expression import VectorFunction

FOLDER = Path(__file__).resolve().parent
STOP, STEP = 10.0, 0.1  # s


def control(time: np.ndarray) -> np.ndarray:
    """Return the input that each step holds: steps, a pause, both signs."""
    return np.where((time > 3.0) & (time < 4.0), 0.0, 0.4 * np.cos(1.7 * time) - 0.3 * (time > 6.0))


def reference() -> np.ndarray:
    """Return the rows time, u1, x1, x2, y1, y2."""
    agent = tomllib.loads((FOLDER / "model.toml").read_text(encoding="utf-8"))["agent"]
    A, H, B, C = (np.array(agent[key]) for key in "AHBC")
    g = VectorFunction.parse(agent["g"], ["t", "x1", "x2"]).numpy()
    sec = VectorFunction.parse(agent["sec"], ["u1"]).numpy()

    times = np.arange(round(STOP / STEP) + 1) * STEP
    inputs = control(times)
    states = [np.array(agent["x"])]
    for start, u in zip(times[:-1], inputs[:-1], strict=True):
        solution = solve_ivp(
            lambda t, x, u=u: A @ x + H @ g(t, *x) + B @ sec(u),
            (start, start + STEP),
            states[-1],
            method="DOP853",
            rtol=1e-10,
            atol=1e-12,
        )
        states.append(solution.y[:, -1])
    x = np.array(states)
    return np.column_stack([times, inputs, x, x @ C.T])


def write(path: Path) -> None:
    """Write the file; the band is what an FMU with a relative tolerance of 1e-10 keeps."""
    lines = [
        "# made by make_reference.py; see README.md",
        "# band: height=1e-07, width=0",
        "time,u[1],x[1],x[2],y[1],y[2]",
        *(",".join(repr(round(float(value), 12)) for value in row) for row in reference()),
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    write(FOLDER / "reference.csv")
