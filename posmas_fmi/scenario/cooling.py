"""What ``[cooling]`` stands for: agent, FMUs, wiring, and the controllers of a row of lines."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import attrs
import numpy as np

from posmas_fmi.agent import Agent
from posmas_fmi.cooling.classes import ZERO_CELSIUS, class_limit, dew_point
from posmas_fmi.cooling.control import CONTROLLERS, WHAT_IS_PROVED, Control, controller, mean_delays
from posmas_fmi.cooling.figures import facts, kpi_table, limits, verdicts
from posmas_fmi.cooling.kpi import key_figures
from posmas_fmi.cooling.law import CoolingLaw, team_network
from posmas_fmi.cooling.line import LineParameters
from posmas_fmi.cooling.mapping import line_agent, line_texts, valve_mapping
from posmas_fmi.cooling.mpc import Prediction, PredictiveLaw
from posmas_fmi.cooling.plant import header_values, line_values
from posmas_fmi.cosim.law import Law
from posmas_fmi.cosim.master import Outcome
from posmas_fmi.design import Design
from posmas_fmi.errors import InputError
from posmas_fmi.expression import Array
from posmas_fmi.network import Network
from posmas_fmi.scenario.signals import Signal, read_signal
from posmas_fmi.scenario.tables import (
    AgentTable,
    ControlTable,
    CoolingTable,
    NetworkTable,
    ScenarioTable,
    SignalTable,
)
from posmas_fmi.scenario.verdict import not_about, overall

if TYPE_CHECKING:
    from posmas_fmi.scenario.build import Scenario

NOMINAL = LineParameters()
PREDICTIVE = "mpc"
FACILITY = "facility"
HELD_ABOVE_DEW_POINT = 2.0  # K
FACILITY_RANGE = (273.15, 363.15)  # K, of water that cools
WET_BULB_RANGE = (213.15, 333.15)  # K, of weather
SMALL_LOAD = 0.01  # of the nominal load: below it a unit is wrong
RECORDED = (
    "supply_temperature",
    "return_temperature",
    "case_temperature",
    "valve_position",
    "primary_flow",
    "heat_load",
    "header",
    "facility_temperature",
)
TOLERANCE = 1e-6  # of the solver in the FMUs: some 1e-5 K, a thousandth of the sensors' noise
# Integral time [s] of the integral law over its proportional part.
INTEGRAL_TIME = mean_delays(NOMINAL)[1]

LEAKAGE_NOTE = (
    "The leakage in model (1) is that of the nominal load; what another load leaks more or less "
    "counts as load."
)


def sizes(table: CoolingTable, lines: int) -> Array:
    """Return the nominal load of each line over that of the nominal line, (N,).

    Raises
    ------
    InputError
        If there are not as many as lines, or one is not positive.
    """
    watts = np.atleast_1d(np.asarray(table.sizes, dtype=float))
    if len(watts) not in (1, lines) or (watts <= 0).any():
        raise InputError(
            f"expected a load > 0 [W], or {lines}, one for each line (got {table.sizes})",
            "$.cooling.sizes",
        )
    return np.broadcast_to(watts / NOMINAL.P0, (lines,))


def expand(
    cooling: CoolingTable,
    network: NetworkTable,
    scenario: ScenarioTable,
    signals: Mapping[str, SignalTable],
    folder: Path,
    integral: bool = False,
) -> dict[str, Any]:
    """Return the tables that ``[cooling]`` stands for, as TOML would give them.

    Lines start in the steady state of their first load at the set-point, if a valve position holds
    it.

    Parameters
    ----------
    cooling : CoolingTable
    network : NetworkTable
    scenario : ScenarioTable
    signals : mapping of str to SignalTable
        With the load.
    folder : Path
        Of the scenario.
    integral : bool
        Whether the design is one with integral action.

    Raises
    ------
    InputError
        If sizes, loads or limits do not fit.
    """
    from posmas_fmi.scenario.build import make_network

    n = make_network(network, folder).N
    _check(cooling, signals)
    line, size = NOMINAL, sizes(cooling, n)
    load = read_signal(
        cooling.load,
        signals[cooling.load],
        n,
        folder,
        scenario.until,
        scenario.period,
        scenario.seed,
    )
    _check_load(load, signals[cooling.load], float(size.max()), f"$.signals.{cooling.load}")
    first = np.broadcast_to(load.at(np.zeros(1))[0], (n,))
    with at(f"$.signals.{cooling.load}"):
        values = [_start(cooling, float(s), float(p)) for s, p in zip(size, first, strict=True)]
    common = values[0]
    start = [[v["T_plate"], v["T_return"], v["T_supply"]] for v in values]
    above = (np.array(start) - cooling.facility).tolist()
    wet_bulb = cooling.wet_bulb
    named = wet_bulb if isinstance(wet_bulb, str) else "wet_bulb"
    return {
        "scenario": {"tolerance": cooling.band},
        "agent": _agent(cooling, line, integral),
        "plant": {
            **_ports(cooling, line),
            "parameters": common,
            "tolerance": TOLERANCE,
            "override": [
                {"agent": k + 1, "parameters": different}
                for k, own in enumerate(values)
                if (different := {name: v for name, v in own.items() if v != common[name]})
            ],
        },
        "leader": {"s0": line.theta0.tolist()},
        "initial": {"xhat": above},
        "signals": {} if isinstance(wet_bulb, str) else {named: {"value": wet_bulb}},
        "component": [_facility(cooling, line, size, float(first.sum()), named)],
        "connection": _connections(size),
        "control": {"law": "integral_ff"},
        "sensors": {"noise": cooling.noise, "resolution": cooling.resolution},
        "report": {"baseline": False},
    }


def _start(cooling: CoolingTable, size: float, load: float) -> dict[str, float]:
    """Values of the FMU of a line that holds the set-point, or is as near to it as it can be."""
    line = NOMINAL.sized(size * NOMINAL.P0)
    return line_values(line, load, line.nearest(load, cooling.set_point), cooling.facility)


def _check(cooling: CoolingTable, signals: Mapping[str, SignalTable]) -> None:
    for key in ("load", "pump", "wet_bulb"):
        name = getattr(cooling, key)
        if isinstance(name, str) and name not in signals:
            raise InputError(
                f"there is no signal {name!r}: write [signals.{name}]", f"$.cooling.{key}"
            )
    if cooling.water_class is not None:
        with at("$.cooling.water_class"):
            class_limit(cooling.water_class)
    _check_temperatures(cooling)
    if cooling.band <= 0:
        raise InputError(f"expected a number > 0 (got {cooling.band:g})", "$.cooling.band")
    for key in ("noise", "resolution", "shortage", "chiller"):
        if getattr(cooling, key) < 0:
            raise InputError(
                f"expected a number >= 0 (got {getattr(cooling, key):g})", f"$.cooling.{key}"
            )


def _check_temperatures(cooling: CoolingTable) -> None:
    """Temperatures are kelvin; set-points are kelvin above the facility supply."""
    for key, (low, high) in (("facility", FACILITY_RANGE), ("wet_bulb", WET_BULB_RANGE)):
        value = getattr(cooling, key)
        if not isinstance(value, str) and not low <= value <= high:
            raise InputError(
                f"expected a temperature of {low:g} to {high:g} K (got {value:g}); "
                f"{ZERO_CELSIUS:g} K is 0 °C",
                f"$.cooling.{key}",
            )
    step = cooling.set_point_step
    later = None if step is None else step.to
    wanted = {"set_point": cooling.set_point, "set_point_step.to": later}
    for key, above in wanted.items():
        if above is not None and not above > 0:
            raise InputError(
                f"expected kelvin above the facility supply, more than 0 (got {above:g}): coolant "
                "is never colder than the water that cools it",
                f"$.cooling.{key}",
            )
    if step is not None and step.at < 0:
        raise InputError(f"expected seconds >= 0 (got {step.at:g})", "$.cooling.set_point_step.at")
    with at("$.cooling.air", below=True):
        floor(cooling)


@contextmanager
def at(place: str, below: bool = False) -> Iterator[None]:
    """Name the place in the scenario that a value comes from, or that which it lies below."""
    try:
        yield
    except InputError as error:
        raise InputError(error.message, f"{place}.{error.where}" if below else place) from None


def _check_load(load: Signal, table: SignalTable, size: float, place: str) -> None:
    """Heat loads are watts and not negative."""
    if table.unit not in (None, "W"):
        raise InputError(
            f"heat loads are read in W (got {table.unit!r}); write scale = 1e3 for kW instead",
            f"{place}.unit",
        )
    if load.values.min() < 0:
        k, column = np.argwhere(load.values < 0)[0]
        value, line = load.values[k, column], f" of line {column + 1}" * (load.values.shape[1] > 1)
        raise InputError(
            f"expected heat loads >= 0 W (got {value:g}{line} at {load.time[k]:g} s)", place
        )
    largest, nominal = load.values.max(), NOMINAL.P0 * size
    if 0 < largest < SMALL_LOAD * nominal:
        raise InputError(
            f"the largest heat load is {largest:g} W, of lines of {nominal:g} W; for a table in kW "
            "write scale = 1e3",
            place,
        )


def _agent(cooling: CoolingTable, line: LineParameters, integral: bool) -> dict[str, Any]:
    agent = line_agent(line, cooling.loads, integral=integral)
    g, sec = line_texts(line, integral=integral)
    bound = agent.lipschitz
    return {
        **{name: getattr(agent, name).tolist() for name in "ABCH"},
        "g": [g, "0", "0"],
        "sec": [sec],
        "sector": list(agent.sector),
        **({} if bound is None else {"lipschitz": np.asarray(bound).tolist()}),
        "region": {name: list(limits) for name, limits in agent.region.items()},
    }


def with_slope(agent: Agent, table: AgentTable, cooling: CoolingTable) -> Agent:
    """Add the proved bounds of the slope of sec over the range of loads, if that is the line's."""
    if table.sec != [line_texts(NOMINAL)[1]]:
        return agent
    return attrs.evolve(agent, slope=line_agent(NOMINAL, cooling.loads).slope)


def _ports(cooling: CoolingTable, line: LineParameters) -> dict[str, Any]:
    valve = valve_mapping(line)
    pump = {} if cooling.pump is None else {"pump": cooling.pump}
    temperatures = ("return_temperature", "supply_temperature")
    return {
        "fmu": "cooling_line",
        "inputs": {"u1": {"variable": "valve", "scale": -valve.gain, "offset": valve.y0}},
        "outputs": {
            f"y{k + 1}": {"variable": name, "offset": cooling.facility, "unit": "K"}
            for k, name in enumerate(temperatures)
        },
        "exogenous": {"heat_load": cooling.load, **pump},
        "measured": {
            "power": cooling.load,
            "valve": "valve_position",
            "water": f"{FACILITY}.facility_temperature",
        },
        "record": list(RECORDED),
    }


def _facility(
    cooling: CoolingTable, line: LineParameters, size: Array, heat: float, wet_bulb: str
) -> dict[str, Any]:
    values: dict[str, Any] = header_values(line, 1, cooling.shortage, facility=cooling.facility)
    for name in ("kv_nominal", "capacity", "control", "cooler"):
        values[name] *= float(size.sum())
    values |= {
        "heat": heat,
        "kv": [0.0] * 64,
        "kv_others": values["kv_nominal"],
        "chiller": cooling.chiller,
    }
    return {
        "name": FACILITY,
        "fmu": "facility_header",
        "parameters": values,
        "exogenous": {"wet_bulb": wet_bulb},
    }


def _connections(size: Array) -> list[dict[str, Any]]:
    alike = bool((size == size[0]).all())
    return [
        {"source": f"{FACILITY}.header", "to": "agents.header"},
        {
            "source": f"{FACILITY}.facility_temperature",
            "to": "agents.facility_temperature",
        },
        {
            "source": "agents.kv",
            "to": f"{FACILITY}.kv_others",
            "sum": True,
            "scale": float(size[0]) if alike else size.tolist(),
        },
        {"source": "agents.primary_heat_flow", "to": f"{FACILITY}.heat", "sum": True},
    ]


# ---- controllers --------------------------------------------------------------------------------


def control(table: ControlTable, cooling: CoolingTable, designed: Design, place: str) -> Control:
    """Return the controllers of the lines: named law, gains of the design, parameters on top.

    Raises
    ------
    InputError
        If law or a parameter is not known, or out of range.
    """
    changes: dict[str, Any] = {
        "K": designed.phi * designed.K[0],
        "K_q": (
            designed.phi * float(designed.K[0].sum()) / INTEGRAL_TIME
            if designed.K_q is None
            else float(designed.K_q[0, 0])
        ),
        "E": designed.E,
        "set_point": cooling.set_point,
        "floor": floor(cooling),
    }
    if cooling.set_point_step is not None:
        step = cooling.set_point_step
        changes |= {"set_point_at": step.at, "set_point_after": step.to}
    known = [a.name for a in attrs.fields(Control) if a.name not in ("law", "sign")]
    for name in table.parameters:
        if name not in known:
            raise InputError(
                f"unknown key; known keys: {', '.join(known)}", f"{place}.parameters.{name}"
            )
    if table.law not in CONTROLLERS:
        raise InputError(
            f"expected one of {', '.join((*CONTROLLERS, PREDICTIVE))} (got {table.law!r})",
            f"{place}.law",
        )
    try:
        return controller(table.law, **changes | table.parameters)
    except (TypeError, ValueError) as error:
        raise InputError(str(error), f"{place}.parameters") from None
    except InputError as error:
        raise InputError(error.message, f"{place}.parameters.{error.where}") from None


def floor(cooling: CoolingTable) -> float | None:
    """Return the least supply temperature [K]; None where the air is not stated."""
    if cooling.air is None:
        return None
    dew = float(dew_point(cooling.air.temperature, cooling.air.humidity))
    return dew + HELD_ABOVE_DEW_POINT


def network_of(table: ControlTable, network: Network) -> Network:
    """Return the digraph that a law's messages go over."""
    if table.law != "team":
        return network
    return attrs.evolve(team_network(network.N), names=network.names)


def cooling_law(
    table: ControlTable, cooling: CoolingTable, designed: Design, place: str = "$.control"
) -> Law:
    """Return the law of ``[control]`` or ``[controllers.NAME]``.

    Parameters
    ----------
    table : ControlTable
    cooling : CoolingTable
    designed : Design
    place : str
        Of the table in the scenario.

    Raises
    ------
    InputError
        If law or a parameter is not known, or out of range.
    """
    network = designed.network
    if table.law == PREDICTIVE:
        return _predictive(table, cooling, network, place)
    return CoolingLaw(
        NOMINAL,
        control(table, cooling, designed, place),
        network_of(table, network),
        sizes(cooling, network.N),
        water=cooling.facility,
    )


def proved(table: ControlTable, designed: Design) -> dict[str, Any]:
    """Return what design.json says instead of the design where a law is not the protocol (6).

    The certificate of the design is about (6) with its gains, which only the proportional law is,
    or, of a design with an integral, about the integral laws. Other gains than the design's have
    no certificate.
    """
    note = WHAT_IS_PROVED.get(table.law, "")
    if is_certified(table, designed):
        leakage = [LEAKAGE_NOTE] if designed.K_q is not None else []
        return {"notes": [note, *leakage]} if note else {}
    return not_about(f"this law, {table.law!r}. {note}")


def is_certified(table: ControlTable, designed: Design) -> bool:
    """Whether the certificate of the design is about the law, with the gains that it runs."""
    if table.python is not None:
        return False
    certified = ("integral", "integral_ff") if designed.K_q is not None else ("proportional",)
    own = {"K", "E", "K_q"} & set(table.parameters)
    return table.law == "protocol" or (table.law in certified and not own)


def _predictive(
    table: ControlTable, cooling: CoolingTable, network: Network, place: str
) -> PredictiveLaw:
    if cooling.set_point_step is not None:
        raise InputError(f"{PREDICTIVE!r} knows one set-point only", f"{place}.law")
    try:
        prediction = Prediction(**table.parameters)
    except TypeError as error:
        raise InputError(str(error), f"{place}.parameters") from None
    except InputError as error:
        raise InputError(error.message, f"{place}.parameters.{error.where}") from None
    return PredictiveLaw(
        NOMINAL,
        network,
        sizes(cooling, network.N),
        cooling.shortage,
        cooling.set_point,
        prediction,
        water=cooling.facility,
    )


# ---- what came of it ----------------------------------------------------------------------------


def set_points(cooling: CoolingTable, law: Law) -> Callable[[Array], dict[str, Array]]:
    """Return what gives the set-point [K] at some times, as a recorded variable."""
    constant = NOMINAL.theta_s0 if cooling.set_point is None else cooling.set_point

    def at(times: Array) -> dict[str, Array]:
        above = [law.set_point(t) for t in times] if isinstance(law, CoolingLaw) else constant
        return {"set_point": cooling.facility + np.broadcast_to(above, times.shape)}

    return at


def judge(
    scenario: Scenario, designed: Design, outcome: Outcome, results: Path, summary: dict[str, Any]
) -> None:
    """Add key figures and limits to a summary, and let its verdict be about temperatures.

    A line has converged if its supply is within the tolerance of the set-point in the mean over the
    last tenth of the run. (The leader is the nominal line at the nominal load: lines with other
    loads have other states.)

    Parameters
    ----------
    scenario : Scenario
        With ``[cooling]``.
    designed : Design
    outcome : Outcome
    results : Path
        results.nc of the run.
    summary : dict
        Changed in place.
    """
    cooling, name = scenario.cooling, scenario.control.law
    assert cooling is not None
    wanted = limits(cooling.band, cooling.water_class, floor(cooling))
    summary |= {
        "kpi": kpi_table(),
        "practice": None,
        "limits": [attrs.asdict(limit) for limit in wanted],
        "facility_K": cooling.facility,
        "band_K": cooling.band,
        "scenario": scenario.name,
        "created_by": f"posmas-fmi {metadata.version('posmas-fmi')}",
    }
    table = _recorded(results)
    if len(table["time"]) < 2:
        return
    # what is centralised: a line's readings to the centre and a command back
    messages = 2 * designed.network.N * outcome.steps if name == PREDICTIVE else outcome.messages
    alone = name in CONTROLLERS and CONTROLLERS[name].law in ("fixed", "local")
    if not is_certified(scenario.control, designed):
        for row in summary.get("coverage", []):
            row |= {"covered": False, "why": "the certificate is not about this law"}
    figures = key_figures(
        table["time"],
        table["supply_temperature"],
        table["set_point"],
        table["facility_temperature"],
        table["valve_position"],
        table["case_temperature"],
        None if cooling.water_class is None else class_limit(cooling.water_class),
        0 if alone else messages,
        table["primary_flow"],
        table["header"],
    )
    found = facts(figures)
    found["limits"] = verdicts(found, wanted)
    found["proved"] = WHAT_IS_PROVED.get(name, "")
    deviation = table["supply_temperature"] - table["set_point"][:, None]
    lowest = table["supply_temperature"] - table["facility_temperature"]
    end = table["time"] >= table["time"][-1] - 0.1 * (table["time"][-1] - table["time"][0])
    final = np.abs(deviation[end].mean(axis=0))
    for k, agent in enumerate(summary["agents"]):
        agent["final_error"] = float(final[k])
        agent["min_state"] = float(lowest[:, k].min())
        agent["min_time"] = float(table["time"][lowest[:, k].argmin()])
        agent["non_negative"] = agent["min_state"] >= 0
        agent["converged"] = agent["final_error"] <= scenario.settings.tolerance
        if agent["status"] in ("converged", "not converged", "positivity lost"):
            agent["status"] = _status(agent)
    statuses = [agent["status"] for agent in summary["agents"]]
    if outcome.ended in ("complete", "terminated"):
        summary["verdict"] = overall(statuses, outcome.unsettled)
    summary |= {
        "tracking_error_final": float(final.max()),
        "min_state": figures.lowest,
        "comparison": {name: found},
    }


def _status(agent: Mapping[str, Any]) -> str:
    if not agent["non_negative"]:
        return "positivity lost"
    return "converged" if agent["converged"] else "not converged"


def _recorded(path: Path) -> dict[str, Array]:
    """Read what was recorded of a run, as far as it went."""
    import h5py

    wanted = ("time", "set_point", *RECORDED)
    with h5py.File(path, "r") as file:
        table = {name: np.asarray(file[name]) for name in wanted}
    rows = np.isfinite(table["time"]) & np.isfinite(table["supply_temperature"]).all(axis=1)
    return {name: values[rows] for name, values in table.items()}
