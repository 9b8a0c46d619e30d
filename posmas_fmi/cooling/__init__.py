"""The liquid-cooling domain: line physics, mapping to model (1), loads, limits, key figures.

The public names are those listed here.
"""

from posmas_fmi.cooling.classes import W_CLASSES, class_limit, class_of, dew_point, exceedance
from posmas_fmi.cooling.control import CONTROLLERS, Control, controller
from posmas_fmi.cooling.kpi import KeyFigures, key_figures, rainflow, settling_time, thermal_cycles
from posmas_fmi.cooling.line import LineParameters
from posmas_fmi.cooling.loads import (
    LoadModel,
    Loads,
    Training,
    generate_loads,
    read_loads,
    training_loads,
)
from posmas_fmi.cooling.mapping import (
    ValveMapping,
    line_agent,
    return_range,
    sector,
    slope_sector,
    valve_mapping,
)
from posmas_fmi.cooling.plant import header_values, line_values
from posmas_fmi.cooling.sensor import Sensor

__all__ = [
    "CONTROLLERS",
    "W_CLASSES",
    "Control",
    "KeyFigures",
    "LineParameters",
    "LoadModel",
    "Loads",
    "Sensor",
    "Training",
    "ValveMapping",
    "class_limit",
    "class_of",
    "controller",
    "dew_point",
    "exceedance",
    "generate_loads",
    "header_values",
    "key_figures",
    "line_agent",
    "line_values",
    "rainflow",
    "read_loads",
    "return_range",
    "sector",
    "settling_time",
    "slope_sector",
    "thermal_cycles",
    "training_loads",
    "valve_mapping",
]
