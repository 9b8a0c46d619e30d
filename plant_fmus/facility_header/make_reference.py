"""Makes reference.csv: the header of model.toml by its closed-form solution, without any FMU.

Inputs are held from row to row, so the pressure relaxes exponentially and the supply temperature
follows one linear law at a time; SciPy integrates the switches between those laws.
"""

from __future__ import annotations

import math
import tomllib
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

FOLDER = Path(__file__).resolve().parent
STOP, STEP = 3600.0, 20.0  # s
LINES = 8  # the others of the 64 stay at 0
INPUTS = (*(f"kv[{k + 1}]" for k in range(LINES)), "kv_others", "heat", "wet_bulb")
COMPARED = (
    "header",
    "facility_temperature",
    "rejected_heat_flow",
    "stored_energy",
    "energy_in",
    "energy_out",
)


def schedule(time: np.ndarray) -> np.ndarray:
    """Return the inputs that each step holds: valves opening and closing, a hot afternoon."""
    lines = [0.44 + 0.3 * np.sin(time / 300 + k) for k in range(LINES)]
    others = np.where(time > 2000, 1.5, 0.0)
    heat = 640e3 + 250e3 * np.sin(time / 500) - 600e3 * (time > 3000)
    wet_bulb = 290.15 + 13.0 * np.exp(-(((time - 1500) / 600) ** 2))
    return np.column_stack([*lines, others, heat, wet_bulb])


def settles(p: dict[str, float], u: np.ndarray) -> float:
    """Return the pressure for these flow coefficients."""
    share = u[: LINES + 1].sum() / p["kv_nominal"]
    return float((1 + p["resistance"]) / (1 + p["resistance"] * share**2))


def rejected(p: dict[str, float], u: np.ndarray, supply: float) -> float:
    """Return the heat that leaves the facility [W]."""
    most = p["cooler"] * max(supply - u[-1], 0.0) + p["chiller"]
    return min(max(p["control"] * (supply - p["set_point"]), 0.0), most)


def reference() -> np.ndarray:
    """Return the rows time, INPUTS, COMPARED."""
    content = tomllib.loads((FOLDER / "model.toml").read_text(encoding="utf-8"))
    p = {v["name"]: v["start"] for v in content["variable"] if v["role"] == "parameter"}
    start = {v["name"]: v["start"] for v in content["variable"] if v["role"] == "state"}
    pressure, x = start["pressure"], np.array([start["T_supply"], 0.0, 0.0])
    times = np.arange(round(STOP / STEP) + 1) * STEP
    inputs, rows = schedule(times), []
    for k, (t, u) in enumerate(zip(times, inputs, strict=True)):
        heat, supply = u[-2], x[0]
        stored = p["capacity"] * (supply - 273.15)
        out = rejected(p, inputs[max(k - 1, 0)], supply)  # read before the next input is set
        rows.append([t, *u, pressure, supply, out, stored, x[1], x[2]])
        if k == len(times) - 1:
            break
        target = settles(p, u)
        pressure = target + (pressure - target) * math.exp(-STEP / p["header_time"])

        def rates(t: float, x: np.ndarray, u: np.ndarray = u, heat: float = heat) -> list[float]:
            out = rejected(p, u, x[0])
            return [(heat - out) / p["capacity"], heat, out]

        solution = solve_ivp(
            rates, (t, t + STEP), x, method="DOP853", rtol=1e-12, atol=1e-10, max_step=1.0
        )
        x = solution.y[:, -1]
    return np.array(rows)


def write(path: Path) -> None:
    """Write the file; the band is what an FMU with a relative tolerance of 1e-8 keeps."""
    lines = [
        "# made by make_reference.py; see README.md",
        "# band: height=1e-06, width=0",
        ",".join(["time", *INPUTS, *COMPARED]),
        *(",".join(f"{value:.13g}" for value in row) for row in reference()),
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    write(FOLDER / "reference.csv")
