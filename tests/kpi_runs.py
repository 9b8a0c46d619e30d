"""Result folders of cooling rows for the tests of the KPI page: first-order lines, with numpy."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from report_runs import design_facts

from posmas_fmi.cooling import key_figures

SET_POINT, FACILITY, BAND = 310.15, 305.15, 1.0
KPI = {
    "rms_K": ("RMS deviation", "K", "low"),
    "worst_K": ("Worst deviation", "K", "low"),
    "spread_K": ("Spread, largest", "K", "low"),
    "exceedance_Ks": ("Beyond ±1 K", "K·s", "low"),
    "settling_s": ("Settling", "s", "low"),
    "valve_strokes_per_h": ("Valve travel", "strokes/h", "low"),
    "thermal_cycles": ("Thermal cycles", "1/h", "low"),
    "messages_per_h": ("Messages", "1/h", None),
    "lowest_theta_K": ("Lowest above facility", "K", None),
    "worst_line": ("Worst line", "", None),
}
LIMITS = [
    {"name": "band", "kpi": "worst_K", "limit": BAND, "unit": "K", "text": "CDU band"},
    {"name": "positivity", "kpi": "lowest_theta_K", "limit": 0.0, "unit": "K", "above": True},
    {"name": "dew point", "kpi": "lowest_supply_K", "limit": 288.1, "unit": "K", "above": True},
]
# offset under load, overshoot, valve travel: what a controller makes of the same loads
CHARACTER = {
    "pi": (0.0, 1.45, 6.0),
    "proportional": (1.1, 0.7, 1.5),
    "integral": (0.0, 0.62, 2.0),
    "fixed": (2.6, 0.0, 0.0),
}


def loads(n: int, time: np.ndarray, seed: int = 1) -> np.ndarray:
    """Heat loads [W] that step together and stay unequal, (T, n)."""
    rng = np.random.default_rng(seed)
    level = np.where((time // 1800) % 2 == 0, 0.55, 1.0)[:, None]
    own = 80e3 * (0.6 + 0.8 * rng.random(n))
    return level * own * (1 + 0.02 * rng.standard_normal((len(time), n)))


def signals(controller: str, heat: np.ndarray, time: np.ndarray) -> dict[str, np.ndarray]:
    offset, overshoot, busy = CHARACTER.get(controller, (0.3, 0.9, 3.0))
    relative = heat / heat.mean(axis=0).max() - 0.8
    swing = np.zeros_like(heat)
    slow = np.zeros(heat.shape[1])
    for k in range(1, len(time)):
        slow = slow + 0.03 * (relative[k] - slow)
        swing[k] = relative[k] - slow
    deviation = 1.6 * offset * relative + 1.4 * overshoot * swing
    wander = np.sin(time[:, None] / 40.0 + np.arange(heat.shape[1]))
    valve = np.clip(0.55 + 0.4 * relative * (busy > 0) + 0.004 * busy * wander, 0, 1)
    return {
        "supply_temperature": SET_POINT + deviation,
        "valve_position": valve,
        "case_temperature": SET_POINT + 12 + 22 * heat / 80e3 + deviation,
        "heat_load": heat,
    }


def ring(n: int) -> list[tuple[int, int]]:
    return [(i, (i + 1) % n) for i in range(n)] + [(i, (i + 3) % n) for i in range(0, n, 2)]


def write_results(
    folder: Path, values: dict[str, np.ndarray], time: np.ndarray, names: Sequence[str]
) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    n = len(names)
    arcs = [a for a in ring(n) if a[0] != a[1]]
    pinning = np.zeros(n)
    pinning[:: max(1, n // 2)] = 1.0
    variables: dict[str, Any] = {
        name: (("time", "agent"), array.astype(np.float32)) for name, array in values.items()
    }
    variables |= {
        "set_point": ("time", np.full(len(time), SET_POINT)),
        "facility_temperature": ("time", np.full(len(time), FACILITY)),
        "pinning": ("agent", pinning),
        "arc_from": ("arc", np.array([a for a, _ in arcs], dtype=np.int64)),
        "arc_to": ("arc", np.array([b for _, b in arcs], dtype=np.int64)),
    }
    coords = {"time": ("time", time, {"units": "s"}), "agent": ("agent", list(names))}
    xr.Dataset(variables, coords=coords).to_netcdf(folder / "results.nc", engine="h5netcdf")
    (folder / "design.json").write_text(json.dumps(design_facts()), encoding="utf-8")


def figures(values: dict[str, np.ndarray], time: np.ndarray, messages: float) -> dict[str, Any]:
    made = key_figures(
        time, values["supply_temperature"], SET_POINT, FACILITY,
        values["valve_position"], values["case_temperature"],
    )  # fmt: skip
    facts = {
        "rms_K": made.rms,
        "worst_K": made.worst,
        "spread_K": made.spread,
        "exceedance_Ks": made.exceedance_band,
        "settling_s": made.settling if np.isfinite(made.settling) else None,
        "valve_strokes_per_h": made.strokes_per_hour,
        "thermal_cycles": made.cycles_per_hour,
        "messages_per_h": messages,
        "lowest_theta_K": made.lowest,
        "worst_line": made.worst_line + 1,
        "rms_K_by_line": made.rms_by_line.tolist(),
    }
    facts["limits"] = {
        "band": made.worst <= BAND,
        "positivity": made.lowest >= 0,
        "dew point": None,
    }
    return facts


def comparison(
    folder: Path,
    n: int = 8,
    until: float = 7200.0,
    step: float = 10.0,
    controllers: Sequence[str] = ("pi", "proportional", "integral"),
    names: Sequence[str] = (),
    practice: str | None = "pi",
    **changes: Any,
) -> Path:
    """A comparison as `[compare]` leaves it: a folder per controller and one summary."""
    time = np.arange(0.0, until + step / 2, step)
    heat = loads(n, time)
    names = list(names) or [str(k + 1) for k in range(n)]
    found = {}
    for controller in controllers:
        values = signals(controller, heat, time)
        write_results(folder / controller, values, time, names)
        local = controller in ("pi", "fixed")
        found[controller] = figures(values, time, 0.0 if local else 360.0 * len(ring(n)))
    summary = {
        "comparison": found,
        "kpi": {k: {"label": a, "unit": b, "better": c} for k, (a, b, c) in KPI.items()},
        "practice": practice,
        "limits": LIMITS,
        "set_point_K": SET_POINT,
        "facility_K": FACILITY,
        "band_K": BAND,
        "scenario": "cooling-row",
        "created_by": "posmas-fmi 0.1.0",
        **changes,
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    manifest = {"seed": 1, "command": "posmas-fmi run cooling_row", "scenario": "[scenario]\nx=1"}
    (folder / "manifest.json").write_text(json.dumps(manifest), encoding="utf-8")
    return folder
