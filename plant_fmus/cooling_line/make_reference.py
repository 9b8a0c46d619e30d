"""Makes reference.csv: the line of model.toml, integrated by SciPy from the equations of README.md.

Written apart from model.c: the exchanger by the textbook's effectiveness, the balances as matrices.
"""

from __future__ import annotations

import math
import tomllib
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

FOLDER = Path(__file__).resolve().parent
STOP, STEP = 2400.0, 10.0  # s
INPUTS = ("heat_load", "valve", "pump", "header", "facility_temperature")
COMPARED = (
    "supply_temperature",
    "return_temperature",
    "case_temperature",
    "valve_position",
    "kv",
    "primary_heat_flow",
    "primary_flow",
    "T_return",
    "T_supply_pipe",
    "speed",
    "heat_released",
    "stored_energy",
    "energy_in",
    "energy_out",
)


def schedule(time: np.ndarray) -> np.ndarray:
    """Return the inputs that each step holds: load steps, strokes, a pump trip, a shortage."""
    heat = 80e3 + 50e3 * (time >= 100) - 90e3 * (time >= 700) + 35e3 * np.sin(time / 37)
    valve = np.where(time < 300, 0.7, np.where(time < 450, 1.0, np.where(time < 700, 0.2, 0.55)))
    pump = np.where((time >= 1200) & (time < 1260), 0.0, np.where(time >= 1800, 0.85, 1.0))
    header = np.where(time >= 1500, 0.4, 1.0)
    facility = 305.15 + 3.0 * np.sin(time / 400)
    return np.column_stack([heat, valve, pump, header, facility])


def effectiveness(UA: float, hot: float, cold: float) -> float:
    """Counterflow effectiveness times the smaller heat capacity flow [W/K]."""
    least, most = min(hot, cold), max(hot, cold)
    if least <= 0:
        return 0.0
    ratio, ntu = least / most, UA / least
    if abs(1 - ratio) < 1e-9:
        return least * ntu / (1 + ntu)
    decay = math.exp(-ntu * (1 - ratio))
    return least * (1 - decay) / (1 - ratio * decay)


def kv(p: dict[str, float], position: float) -> float:
    """Flow coefficient of the primary circuit."""
    phi = p["rangeability"] ** (position - 1)
    return 1 / math.sqrt(p["authority"] / phi**2 + 1 - p["authority"])


def rates(p: dict[str, float], u: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the derivatives of the nine states."""
    heat, valve, pump, header, facility = u
    plate, hot, hot_pipe, cold, cold_pipe, position, speed = x[:7]
    w = p["coolant_flow"] * speed
    contact = 2 * w * math.tanh(p["plate_UA"] / (2 * w)) if w > 0 else 0.0
    water = p["water_flow_max"] * kv(p, position) * math.sqrt(header)
    kappa = effectiveness(p["UA"], w, p["water_heat"] * water)
    released = heat * (1 + p["leakage"] * (plate - p["leakage_from"]))
    picked_up = contact * (plate - (hot + cold_pipe) / 2)
    cooled = kappa * (hot_pipe - facility)
    fastest = 1 / p["stroke_time"]
    return np.array(
        [
            (released - picked_up) / p["plate_capacity"],
            (picked_up - w * (hot - cold_pipe)) / p["return_capacity"],
            w * (hot - hot_pipe) / p["return_pipe_capacity"],
            (w * (hot_pipe - cold) - cooled) / p["supply_capacity"],
            w * (cold - cold_pipe) / p["supply_pipe_capacity"],
            float(np.clip((valve - position) / p["positioner_time"], -fastest, fastest)),
            (pump - speed) / p["pump_time"],
            released,
            cooled,
        ]
    )


def computed(p: dict[str, float], u: np.ndarray, x: np.ndarray) -> list[float]:
    """Return the values of COMPARED."""
    heat, _, _, header, facility = u
    plate, hot, hot_pipe, cold, cold_pipe, position, speed, taken, given = x
    water = p["water_flow_max"] * kv(p, position) * math.sqrt(header)
    kappa = effectiveness(p["UA"], p["coolant_flow"] * speed, p["water_heat"] * water)
    volumes = ("plate", "return", "return_pipe", "supply", "supply_pipe")
    stored = sum(p[f"{name}_capacity"] * (T - 273.15) for name, T in zip(volumes, x, strict=False))
    released = heat * (1 + p["leakage"] * (plate - p["leakage_from"]))
    return [
        cold,
        hot_pipe,
        plate,
        position,
        kv(p, position),
        kappa * (hot_pipe - facility),
        water,
        hot,
        cold_pipe,
        speed,
        released,
        stored,
        taken,
        given,
    ]


def reference() -> np.ndarray:
    """Return the rows time, INPUTS, COMPARED."""
    content = tomllib.loads((FOLDER / "model.toml").read_text(encoding="utf-8"))
    of = {
        role: {v["name"]: v["start"] for v in content["variable"] if v["role"] == role}
        for role in ("parameter", "state")
    }
    p, x = of["parameter"], np.array(list(of["state"].values()))
    times = np.arange(round(STOP / STEP) + 1) * STEP
    inputs = schedule(times)
    rows = []
    for k, (start, u) in enumerate(zip(times, inputs, strict=True)):
        held = inputs[max(k - 1, 0)]  # an output is read before the next input is set
        rows.append([start, *u, *computed(p, held, x)])
        if k < len(times) - 1:
            solution = solve_ivp(
                lambda t, x, u=u: rates(p, u, x),
                (start, start + STEP),
                x,
                method="DOP853",
                rtol=1e-12,
                atol=1e-10,
                max_step=1.0,  # the valve's speed limit makes a kink
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
