"""A row of cooling lines on one facility header, put together from Python: FMUs, loads, control."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import attrs
import numpy as np

from posmas_fmi.cooling.control import Control
from posmas_fmi.cooling.kpi import KeyFigures, key_figures
from posmas_fmi.cooling.law import CoolingLaw
from posmas_fmi.cooling.line import LineParameters
from posmas_fmi.cooling.loads import Loads
from posmas_fmi.cooling.mapping import line_agent, valve_mapping
from posmas_fmi.cooling.plant import FACILITY, header_values, line_values
from posmas_fmi.cooling.sensor import Sensor
from posmas_fmi.cosim import engine
from posmas_fmi.cosim.channel import Channel
from posmas_fmi.cosim.clock import Clock
from posmas_fmi.cosim.conditions import Episode, Sensors
from posmas_fmi.cosim.fmu_plant import FmuPlant, PlantSpec, PortMap
from posmas_fmi.cosim.law import Law
from posmas_fmi.cosim.master import Outcome, Progress, System
from posmas_fmi.cosim.wiring import Extra, Term, Wiring, column
from posmas_fmi.expression import Array
from posmas_fmi.fmu.build import fmu
from posmas_fmi.fmu.plant import read_plant, shipped_plants
from posmas_fmi.network import Network

# Readings of a line: y first.
_READ = (
    "return_temperature",
    "supply_temperature",
    "case_temperature",
    "valve_position",
    "kv",
    "primary_heat_flow",
    "primary_flow",
)


@attrs.frozen(eq=False)
class Row:
    """Lines, header, loads, network and controllers of a row.

    Parameters
    ----------
    network : Network
        One agent per line.
    loads : Loads
        One column per line, or one for all.
    control : Control or Law
        Of `posmas_fmi.cooling.controller`, or any other law for these lines.
    until : float
        [s]
    period : float
        Control period = communication step [s].
    line : LineParameters
        The nominal line.
    size : (N,) array_like or float
        Nominal load of each line over that of the nominal line.
    shortage : float
        Shared part of the header's resistance, Rh; 0: ample water.
    wet_bulb : float
        Outdoors [K].
    delay, loss : float
        Of messages: delay [s] and probability of loss.
    sensor : Sensor, optional
        Of the temperatures; None: exact.
    episodes : tuple of Episode
        Faults.
    seed : int
    fmi : int
        Version of the FMUs.
    """

    network: Network
    loads: Loads
    control: Control | Law
    until: float
    period: float = 5.0
    line: LineParameters = attrs.field(factory=LineParameters)
    size: Any = 1.0
    shortage: float = 0.0
    wet_bulb: float = 293.15
    delay: float = 0.0
    loss: float = 0.0
    sensor: Sensor | None = attrs.field(factory=Sensor)
    episodes: tuple[Episode, ...] = ()
    seed: int = 1
    fmi: int = 3

    @property
    def sizes(self) -> Array:
        """Size of each line, (N,)."""
        return np.broadcast_to(np.asarray(self.size, dtype=float), (self.network.N,))

    @property
    def law(self) -> Law:
        """The controllers."""
        if isinstance(self.control, Control):
            return CoolingLaw(self.line, self.control, self.network, self.sizes)
        return self.control


@attrs.frozen(eq=False)
class RowResult:
    """What a row did, at every communication point.

    Attributes
    ----------
    time : (n,) array
        [s]
    supply, back, case : (n, N) array
        Temperatures of supply, return and plates [K].
    valve, flow, power : (n, N) array
        Valve position, facility water [kg/s], IT power [W].
    header, facility : (n,) array
        Header pressure, 1 nominal, and facility supply [K].
    set_point : (n,) array
        [K]
    outcome : Outcome
    """

    time: Array
    supply: Array
    back: Array
    case: Array
    valve: Array
    flow: Array
    power: Array
    header: Array
    facility: Array
    set_point: Array
    outcome: Outcome

    def figures(self, since: float = 0.0) -> KeyFigures:
        """Return the key figures from a time on [s]."""
        k = self.time >= since
        return key_figures(
            self.time[k],
            self.supply[k],
            self.set_point[k],
            self.facility[k],
            self.valve[k],
            self.case[k],
            messages=self.outcome.messages,
        )


def simulate_row(
    row: Row, progress: Progress | None = None, wanted: engine.Wanted = "auto", threads: int = 1
) -> RowResult:
    """Co-simulate a row: every line and the header are FMUs.

    The lines start in the steady state of their first load at the operating point's supply.

    Parameters
    ----------
    row : Row
    progress : callable, optional
        Gets the number of steps done and in all.
    wanted : {"auto", "c", "numpy"}
        The loop.
    threads : int

    Raises
    ------
    PosmasError
        If an FMU fails at the start, or sizes do not fit.
    """
    n, law = row.network.N, row.law
    values = [
        line_values(line, load, line.nearest(load))
        for line, load in ((row.line.sized(size * row.line.P0), p) for size, p in _starts(row))
    ]
    drive = _Drive(row)
    specs, wiring = _wire(row, values, drive)
    x = np.array([[v["T_plate"], v["T_return"], v["T_supply"]] for v in values]) - FACILITY
    system = System(
        agent=line_agent(row.line),
        network=row.network,
        law=law,
        channel=Channel.uniform(
            row.network.adjacency.nnz + len(row.network.pinned),
            row.period,
            row.delay,
            0.0,
            row.loss,
        ),
        clock=Clock.of(row.until, row.period),
        xhat0=x,
        s0=row.line.theta0,
        seed=row.seed,
        wiring=wiring,
        sensors=_sensors(row),
        episodes=row.episodes,
    )
    choice = engine.choose(law, wanted, engine.unfit(system))
    kept: list[tuple[Array, Array, Array]] = []

    def record(times: Array, rows: dict[str, Array]) -> None:
        kept.append((times.copy(), rows["y"].copy(), rows["extra"].copy()))

    with FmuPlant(specs, shows_states=False, stop=row.until) as plant:
        outcome = engine.run(
            system, plant, record, progress, choice, threads, variables=("y", "extra")
        )
    time, y, extra = (np.concatenate(part) for part in zip(*kept, strict=True))
    more = extra[:, : n * 4].reshape(-1, n, 4)
    return RowResult(
        time=time,
        supply=y[:, :, 1] + FACILITY,
        back=y[:, :, 0] + FACILITY,
        case=more[:, :, 0],
        valve=more[:, :, 1],
        flow=more[:, :, 2],
        power=more[:, :, 3],
        header=extra[:, -2],
        facility=extra[:, -1],
        set_point=FACILITY + _set_points(law, time, row.line),
        outcome=outcome,
    )


def _starts(row: Row) -> list[tuple[float, float]]:
    first = np.broadcast_to(row.loads.at(0.0), (row.network.N,))
    return [(float(a), float(b)) for a, b in zip(row.sizes, first, strict=True)]


@attrs.frozen(eq=False)
class _Drive:
    """The IT power of each line, then the wet bulb."""

    row: Row

    @property
    def columns(self) -> int:
        return self.row.network.N + 1

    def rows(self, begin: int, end: int) -> Array:
        times = np.asarray(np.arange(begin, end) * self.row.period, dtype=float)
        power = np.broadcast_to(self.row.loads.sampled(times), (end - begin, self.columns - 1))
        return np.column_stack([power, np.full(end - begin, self.row.wet_bulb)])


def _wire(
    row: Row, values: list[dict[str, float]], drive: _Drive
) -> tuple[list[PlantSpec], Wiring]:
    """Return every instance, and how the header and the lines act on each other."""
    n, width, valve = row.network.N, len(_READ), valve_mapping(row.line)
    header, water = n * width, n * width + 1  # places of the header's readings
    inputs = PortMap(
        ("valve", "heat_load", "header", "facility_temperature"),
        (-valve.gain, 1.0, 1.0, 1.0),
        (valve.y0, 0.0, 0.0, 0.0),
        (None,) * 4,
        "row",
    )
    readings = PortMap(
        _READ, (1.0,) * width, (FACILITY, FACILITY) + (0.0,) * (width - 2), (None,) * width, "row"
    )
    plants = shipped_plants()
    line_fmu, header_fmu = (
        fmu(read_plant(plants[name]), row.fmi) for name in ("cooling_line", "facility_header")
    )
    specs = [
        PlantSpec(line_fmu, v, name, inputs, readings)
        for v, name in zip(values, row.network.names, strict=True)
    ]
    facility = header_values(row.line, 1, row.shortage)
    total = float(row.sizes.sum())
    for name in ("kv_nominal", "capacity", "control", "cooler"):
        facility[name] *= total
    facility["heat"] = float(sum(v["heat_load"] for v in values))
    kv = np.zeros(64)
    starts: dict[str, Any] = {**facility, "kv": kv, "kv_others": facility["kv_nominal"]}
    specs.append(
        PlantSpec(
            header_fmu,
            starts,
            "facility",
            PortMap.plain(("kv_others", "heat", "wet_bulb"), "row"),
            PortMap.plain(("header", "facility_temperature"), "row"),
        )
    )

    def of(name: str, line: int) -> int:
        return line * width + _READ.index(name)

    extras: list[tuple[Extra, ...]] = [
        tuple(Extra((Term(s),)) for s in (column(i), header, water)) for i in range(n)
    ]
    flows = [Term(of("kv", i), float(row.sizes[i])) for i in range(n)]
    heats = [Term(of("primary_heat_flow", i)) for i in range(n)]
    extras.append((Extra(tuple(flows)), Extra(tuple(heats)), Extra((Term(column(n)),))))
    sources: dict[str, Callable[[int], int]] = {
        "power": column,
        "valve": lambda i: of("valve_position", i),
        "water": lambda i: water,
    }
    measured = np.array([[sources[e](i) for e in row.law.extras] for i in range(n)], dtype=np.int64)
    recorded = [
        source
        for i in range(n)
        for source in (
            of("case_temperature", i),
            of("valve_position", i),
            of("primary_flow", i),
            column(i),
        )
    ]
    return specs, Wiring(extras, measured, (*recorded, header, water), drive)


def _sensors(row: Row) -> Sensors | None:
    if row.sensor is None:
        return None
    shape = (row.network.N, 2 + len(row.law.extras))
    noise, resolution = np.zeros(shape), np.zeros(shape)
    noise[:, :2], resolution[:, :2] = row.sensor.noise, row.sensor.resolution
    return Sensors(noise, resolution)


def _set_points(law: Law, time: Array, line: LineParameters) -> Array:
    if isinstance(law, CoolingLaw):
        return np.array([law.set_point(t) for t in time])
    return np.full(len(time), line.theta_s0)
