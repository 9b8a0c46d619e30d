"""Key figures and limits of a cooling run as they stand in summary.json and in the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import attrs
import numpy as np

from posmas_fmi.cooling.kpi import KeyFigures

# key: label, unit, which direction is better. The order is that of the report's table.
KPIS: Mapping[str, tuple[str, str, str | None]] = {
    "rms_K": ("RMS deviation", "K", "low"),
    "worst_K": ("Worst deviation", "K", "low"),
    "over_K": ("Worst deviation upwards", "K", "low"),
    "spread_K": ("Spread between lines, largest", "K", "low"),
    "spread_end_K": ("Spread between lines, at the end", "K", "low"),
    "exceedance_Ks": ("Beyond the band, all lines", "K·s", "low"),
    "class_exceedance_Ks": ("Facility water above its class", "K·s", "low"),
    "settling_s": ("Settling", "s", "low"),
    "valve_strokes_per_h": ("Valve travel of a line", "strokes/h", "low"),
    "pump_energy_kWh": ("Pump energy, facility water", "kWh", "low"),
    "thermal_cycles": ("Thermal cycles of 2 K or more, of a line", "1/h", "low"),
    "hottest_case_K": ("Hottest case", "K", "low"),
    "messages_per_h": ("Messages", "1/h", None),
    "lowest_theta_K": ("Lowest temperature above the facility supply", "K", None),
    "lowest_supply_K": ("Lowest supply temperature", "K", None),
    "worst_line": ("Worst line", "", None),
}


def kpi_table() -> dict[str, dict[str, Any]]:
    """Return what the key figures are called, as in ``kpi`` of summary.json."""
    return {
        key: {"label": label, "unit": unit, "better": better}
        for key, (label, unit, better) in KPIS.items()
    }


def facts(figures: KeyFigures) -> dict[str, Any]:
    """Return key figures with the names and units of summary.json; None where not known."""
    energy = figures.pump_energy
    return {
        "rms_K": figures.rms,
        "worst_K": figures.worst,
        "over_K": figures.over,
        "spread_K": figures.spread,
        "spread_end_K": figures.spread_end,
        "exceedance_Ks": figures.exceedance_band,
        "class_exceedance_Ks": figures.exceedance_class,
        "settling_s": figures.settling if np.isfinite(figures.settling) else None,
        "valve_strokes_per_h": figures.strokes_per_hour,
        "pump_energy_kWh": None if energy is None else energy / 3.6e6,
        "thermal_cycles": figures.cycles_per_hour,
        "hottest_case_K": figures.hottest_case,
        "messages_per_h": figures.messages_per_hour,
        "lowest_theta_K": figures.lowest,
        "lowest_supply_K": figures.lowest_supply,
        "worst_line": figures.worst_line + 1,
        "rms_K_by_line": figures.rms_by_line.tolist(),
        "worst_K_by_line": figures.worst_by_line.tolist(),
    }


@attrs.frozen
class Limit:
    """A limit that a key figure must keep.

    Attributes
    ----------
    name, kpi : str
    limit : float
    unit : str
    text : str
        What it is, for a reader.
    above : bool
        Whether the figure has to be at least that, else at most.
    """

    name: str
    kpi: str
    limit: float
    unit: str
    text: str
    above: bool = False

    def holds(self, figures: Mapping[str, Any]) -> bool | None:
        """Return whether figures keep it; None where the figure is not known.

        Examples
        --------
        >>> limit = Limit("band", "worst_K", 1.0, "K", "band")
        >>> limit.holds({"worst_K": 0.5}), limit.holds({"worst_K": None})
        (True, None)
        """
        value = figures.get(self.kpi)
        if value is None:
            return None
        return bool(value >= self.limit if self.above else value <= self.limit)


def limits(
    band: float, water_class: str | None = None, floor: float | None = None
) -> tuple[Limit, ...]:
    """Return the limits of a row.

    Parameters
    ----------
    band : float
        Around the set-point [K].
    water_class : str, optional
        Of `posmas_fmi.cooling.W_CLASSES`.
    floor : float, optional
        Least supply temperature, from the dew point [K].
    """
    made = [
        Limit("band", "worst_K", band, "K", "Supply within the band of the cooling units"),
        Limit("positivity", "lowest_theta_K", 0.0, "K", "No line below the facility supply", True),
    ]
    if water_class is not None:
        made.append(
            Limit(
                water_class,
                "class_exceedance_Ks",
                0.0,
                "K·s",
                f"Facility water within class {water_class}",
            )
        )
    if floor is not None:
        text = "Supply 2 K above the dew point of the room"
        made.append(Limit("dew point", "lowest_supply_K", floor, "K", text, True))
    return tuple(made)


def verdicts(figures: Mapping[str, Any], wanted: Sequence[Limit]) -> dict[str, bool | None]:
    """Return which limits figures keep."""
    return {limit.name: limit.holds(figures) for limit in wanted}
