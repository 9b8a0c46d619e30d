"""From the tables of a scenario file to agent, network, design settings and channel."""

from __future__ import annotations

from collections.abc import Callable
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar

import attrs
import numpy as np
import scipy.sparse as sp

from posmas_fmi import resources
from posmas_fmi.agent import Agent, state_names
from posmas_fmi.cosim.channel import Channel
from posmas_fmi.cosim.clock import Clock
from posmas_fmi.cosim.conditions import Sensors, steps_of
from posmas_fmi.design import DesignSettings
from posmas_fmi.errors import InputError, PosmasError, ScenarioError
from posmas_fmi.expression import Array, VectorFunction, parse
from posmas_fmi.network import Network, network_from_arcs
from posmas_fmi.network_file import read_adjacency
from posmas_fmi.scenario.faults import check_times, make_episodes
from posmas_fmi.scenario.paths import Named, data_files, leaving
from posmas_fmi.scenario.reading import read_tables
from posmas_fmi.scenario.signals import Columns, Signal, Signals, read_signal
from posmas_fmi.scenario.tables import (
    AgentTable,
    ChannelTable,
    CompareTable,
    ComponentTable,
    ConnectionTable,
    ControlTable,
    CoolingTable,
    Count,
    FaultTable,
    JumpTable,
    NetworkTable,
    PlantTable,
    RecordTable,
    ScenarioFile,
    ScenarioTable,
    SensorTable,
    SignalTable,
    Uniform,
)

T = TypeVar("T")


@attrs.frozen(eq=False)
class Scenario:
    """Everything a run needs, checked.

    Attributes
    ----------
    settings : ScenarioTable
        Name, tolerance and so on.
    agent : Agent
    network : Network
        Without pinned agents where `pins` says how many are to be chosen.
    pins : int
        How many agents the design is to pin; 0 if the scenario names them.
    design : DesignSettings
    plant : PlantTable
    clock : Clock
    channel : ChannelTable
    x0, xhat0 : (N, m) array
    s0 : (m,) array
    baseline : bool
        Whether the run without control is made as well.
    record : RecordTable
        What of a run is kept.
    control : ControlTable
    controllers : dict of str to ControlTable
        By the names that `compare` may use.
    compare : CompareTable or None
    cooling : CoolingTable or None
    components : tuple of ComponentTable
    connections : tuple of ConnectionTable
    faults : tuple of FaultTable
    sensors : Sensors or None
        Of the outputs; None: exact.
    jumps : tuple of (int, (m,) array)
        Communication points at which the leader goes on from another state.
    signals : Signals or None
        From outside.
    signal_columns : dict of str to Columns
        Where each signal stands.
    path : Path
        The file.
    inputs : tuple of Path
        Other files that it reads.
    text : str
        Its content.
    """

    settings: ScenarioTable
    agent: Agent
    network: Network
    pins: int
    design: DesignSettings
    plant: PlantTable
    clock: Clock
    channel: ChannelTable
    x0: Array
    xhat0: Array
    s0: Array
    baseline: bool
    record: RecordTable
    control: ControlTable
    controllers: dict[str, ControlTable]
    compare: CompareTable | None
    cooling: CoolingTable | None
    components: tuple[ComponentTable, ...]
    connections: tuple[ConnectionTable, ...]
    faults: tuple[FaultTable, ...]
    sensors: Sensors | None
    jumps: tuple[tuple[int, Array], ...]
    signals: Signals | None
    signal_columns: dict[str, Columns]
    path: Path
    inputs: tuple[Path, ...]
    text: str

    @property
    def name(self) -> str:
        """Name of the scenario."""
        return self.settings.name


def find(name_or_path: str) -> Path:
    """Return the file of a scenario given by path, or by the name of a shipped one.

    Raises
    ------
    InputError
        If there is neither, with the nearest shipped name.
    """
    path = Path(name_or_path)
    if path.exists() or path.suffix == ".toml" or len(path.parts) > 1:
        return path
    names = [file.stem for file in shipped_scenarios()]
    if name_or_path in names:
        return resources.shipped("models") / f"{name_or_path}.toml"
    near = get_close_matches(name_or_path, names, 1)
    hint = f"did you mean {near[0]}?" if near else "'posmas-fmi models' lists them"
    raise InputError(f"there is no shipped scenario {name_or_path!r} and no such file; {hint}")


def shipped_scenarios() -> list[Path]:
    """Return the files of the shipped scenarios."""
    return sorted(resources.shipped("models").glob("*.toml"))


def load(
    name_or_path: str,
    period: float | None = None,
    until: float | None = None,
    seed: int | None = None,
    outside: bool = False,
) -> Scenario:
    """Read and check a scenario.

    Parameters
    ----------
    name_or_path : str
        A file, or the name of a shipped scenario.
    period, until : float, optional
        Replace those of the file [s].
    seed : int, optional
        Replaces that of the file.
    outside : bool
        Whether the scenario may name files outside its own folder. FMUs and controllers are code:
        leave it off for scenarios of others.

    Returns
    -------
    Scenario

    Raises
    ------
    InputError
        ScenarioError where there are several mistakes, with all of them.

    Examples
    --------
    >>> load("paper_example_1").agent.m
    2
    """
    path = find(name_or_path)
    given: dict[str, Any] = {"period": period, "until": until, "seed": seed}
    instead = {k: v for k, v in given.items() if v is not None}
    tables, text = read_tables(path, instead, outside)
    return _Builder(tables, path, text, outside, until is not None).build()


class _Builder:
    """Builds part by part and gathers the problems of all parts."""

    def __init__(
        self, tables: ScenarioFile, path: Path, text: str, outside: bool, shortened: bool
    ) -> None:
        self.tables, self.path, self.text, self.outside = tables, path, text, outside
        self.shortened = shortened  # the run ends elsewhere than the file says
        self.problems: list[tuple[str, str]] = []

    def build(self) -> Scenario:
        tables = self.tables
        self.check_name()
        self.check_paths()  # before anything is read
        clock = self.attempt(lambda: Clock.of(tables.scenario.until, tables.scenario.period))
        agent = self.attempt(lambda: make_agent(tables.agent))
        if agent is not None and tables.cooling is not None:
            from posmas_fmi.scenario.cooling import with_slope

            agent = with_slope(agent, tables.agent, tables.cooling)
        network = self.attempt(lambda: make_network(tables.network, self.path.parent))
        design = self.attempt(lambda: make_design(tables.design))
        if tables.plant.fmi not in (2, 3):
            self.problems.append(("$.plant.fmi", f"expected 2 or 3 (got {tables.plant.fmi})"))
        for k, override in enumerate(tables.plant.override):
            if network and not 1 <= override.agent <= network.N:
                self.problems.append(
                    (
                        f"$.plant.override[{k}].agent",
                        f"expected 1 to {network.N} (got {override.agent})",
                    )
                )
        faults: list[FaultTable] | None = []
        if clock:
            faults = self.attempt(lambda: check_times(tables.fault, clock, self.shortened))
        x0 = xhat0 = s0 = None
        jumps: tuple[tuple[int, Array], ...] | None = ()
        sensors: Sensors | None = None
        if agent and network and clock:
            random = np.random.default_rng(abs(tables.scenario.seed))
            n, m = network.N, agent.m
            x0 = self.attempt(lambda: _start(tables, n, m, random))
            xhat0 = self.attempt(
                lambda: initial(tables.initial.xhat, n, m, random, "$.initial.xhat")
            )
            s0 = self.attempt(lambda: _leader(tables.leader.s0, m, "$.leader.s0"))
            q = agent.q
            sensors = self.attempt(lambda: _sensors(tables.sensors, n, q))
            jumps = self.attempt(lambda: _jumps(tables.leader.jump, m, clock, self.shortened))
            if agent is not None and not pins_open(tables.network):
                self.attempt(lambda: make_episodes(tables.fault, network, agent, clock))
            self.attempt(lambda: make_channel(tables.channel, network, clock.h))
        self.check_components(network)
        self.check_record()
        made: dict[str, Signal] = {}
        if network and clock:
            agents, head = network.N, tables.scenario
            for name, table in tables.signals.items():
                signal = self.attempt(
                    lambda n=name, t=table: read_signal(  # type: ignore[misc]
                        n, t, agents, self.path.parent, head.until, head.period, head.seed
                    )
                )
                if signal is not None:
                    made[name] = signal
        if self.problems:
            raise ScenarioError(tuple(self.problems), str(self.path))
        assert agent is not None
        assert network is not None
        assert design is not None
        assert clock is not None
        assert x0 is not None
        assert xhat0 is not None
        assert s0 is not None
        pinned = tables.network.pinned
        pins = pinned.count if isinstance(pinned, Count) else int(pinned == "auto")
        return Scenario(
            settings=tables.scenario,
            agent=agent,
            network=network,
            pins=pins,
            design=design,
            plant=tables.plant,
            clock=clock,
            channel=tables.channel,
            x0=x0,
            xhat0=xhat0,
            s0=s0,
            baseline=tables.report.baseline,
            record=tables.record,
            control=tables.control,
            controllers=tables.controllers,
            compare=tables.compare,
            cooling=tables.cooling,
            components=tuple(tables.component),
            connections=tuple(tables.connection),
            faults=tuple(faults or ()),
            sensors=sensors,
            jumps=jumps or (),
            signals=Signals(tuple(made.values()), clock) if made else None,
            signal_columns=_columns(made, tables.signals),
            path=self.path,
            inputs=self.inputs(),
            text=self.text,
        )

    def inputs(self) -> tuple[Path, ...]:
        files = [self.tables.network.file, *(s.file for s in self.tables.signals.values())]
        return tuple(dict.fromkeys(self.path.parent / f for f in files if f is not None))

    def check_components(self, network: Network | None) -> None:
        """Names of components must differ from each other and from the agents'."""
        taken = {"agents", *(network.names if network else ())}
        for k, table in enumerate(self.tables.component):
            place = f"$.component[{k}].name"
            if not table.name or table.name in taken or "." in table.name:
                self.problems.append(
                    (place, f"expected a name of its own without a dot (got {table.name!r})")
                )
            taken.add(table.name)

    def check_record(self) -> None:
        """Nothing may be missing that the KPIs of cooling runs are computed from."""
        record = self.tables.record
        if record.every < 1:
            self.problems.append(
                ("$.record.every", f"expected a whole number >= 1 (got {record.every})")
            )
        twice = [k for k, name in enumerate(record.variables) if name in record.variables[:k]]
        for k in twice:
            place = f"$.record.variables[{k}]"
            self.problems.append((place, f"{record.variables[k]!r} is there already"))
        if self.tables.cooling is not None and record.every > 1:
            self.problems.append(
                ("$.record.every", "expected 1: the KPIs of [cooling] need every point")
            )

    def attempt(self, make: Callable[[], T]) -> T | None:
        try:
            return make()
        except PosmasError as error:
            self.problems += [(place or "$", message) for place, message in error.problems]
        return None

    def check_paths(self) -> None:
        """Files must lie in the scenario's folder, unless the caller allows others."""
        if self.outside:
            return
        problems = leaving(self.path.parent, _named_files(self.tables))
        if problems:
            raise ScenarioError((*self.problems, *problems), str(self.path))

    def check_name(self) -> None:
        name = self.tables.scenario.name
        if not name or name in (".", "..") or any(c in name for c in '/\\:*?"<>|\0\n'):
            self.problems.append(
                ("$.scenario.name", f"expected a name that can be a folder (got {name!r})")
            )
        if self.tables.scenario.tolerance <= 0:
            self.problems.append(("$.scenario.tolerance", "expected a number > 0"))
        if self.tables.scenario.seed < 0:
            self.problems.append(("$.scenario.seed", "expected a whole number >= 0"))
        head = self.tables.scenario
        steps = head.snapshot / head.period if head.period > 0 else 0.0
        if head.snapshot < 0 or abs(steps - round(steps)) > 1e-9 * max(1.0, steps):
            self.problems.append(
                (
                    "$.scenario.snapshot",
                    f"expected a multiple of the period (got {head.snapshot:g})",
                )
            )
        if self.tables.scenario.threads < 1:
            self.problems.append(("$.scenario.threads", "expected a whole number >= 1"))


def _named_files(tables: ScenarioFile) -> list[Named]:
    """Every file that a scenario names, with its place; also names that may be shipped FMUs."""
    controls = {"$.control.python": tables.control.python}
    controls |= {f"$.controllers.{n}.python": c.python for n, c in tables.controllers.items()}
    return [
        *data_files(tables.network, tables.signals),
        ("$.plant.fmu", tables.plant.fmu),
        *((f"$.plant.override[{k}].fmu", o.fmu) for k, o in enumerate(tables.plant.override)),
        *((f"$.component[{k}].fmu", c.fmu) for k, c in enumerate(tables.component)),
        *((place, text and text.rpartition(":")[0]) for place, text in controls.items()),
    ]


def _columns(signals: dict[str, Signal], tables: dict[str, SignalTable]) -> dict[str, Columns]:
    """Where each signal stands, side by side."""
    first, columns = 0, {}
    for name, signal in signals.items():
        columns[name] = Columns(first, signal.values.shape[1], tables[name].unit, signal.linear)
        first += signal.values.shape[1]
    return columns


def make_agent(table: AgentTable) -> Agent:
    """Build the agent; every expression that cannot be read is reported.

    Raises
    ------
    InputError
    """
    m = len(table.A)
    p = len(table.B[0]) if table.B else 0
    matrices: dict[str, Any] = {
        name: _matrix(getattr(table, name), f"$.agent.{name}") for name in "ABC"
    }
    matrices["H"] = np.zeros((m, m)) if table.H is None else _matrix(table.H, "$.agent.H")
    inputs = [f"u{k + 1}" for k in range(p)]
    problems: list[tuple[str, str]] = []
    functions: dict[str, Any] = {}
    for name, texts, variables in (
        ("g", table.g or ["0"] * m, state_names(m)),
        ("sec", table.sec or inputs, inputs),
    ):
        expressions = []
        for k, text in enumerate(texts):
            try:
                expressions.append(parse(text, variables, f"$.agent.{name}[{k}]"))
            except PosmasError as error:
                problems.append((error.where, error.message))
        functions[name] = VectorFunction(tuple(expressions), tuple(variables))
    region = _region(table.region, m, p, problems)
    if problems:
        raise ScenarioError(tuple(problems))
    return Agent(
        **matrices,
        **functions,
        sector=table.sector,
        lipschitz=table.lipschitz,
        region=region,
    )


def _matrix(rows: list[list[float]], place: str) -> Array:
    if not rows or not rows[0]:
        raise InputError("expected a matrix with at least one entry", place)
    for k, row in enumerate(rows):
        if len(row) != len(rows[0]):
            raise InputError(
                f"expected {len(rows[0])} entries as in the first row (got {len(row)})",
                f"{place}[{k}]",
            )
    return np.array(rows, dtype=float)


def _region(
    table: dict[str, tuple[float, float]], m: int, p: int, problems: list[tuple[str, str]]
) -> dict[str, tuple[float, float]]:
    """Expand ``x`` and ``u`` to every state and input."""
    states, inputs = state_names(m)[1:], [f"u{k + 1}" for k in range(p)]
    groups = {"x": states, "u": inputs, **{name: [name] for name in ["t", *states, *inputs]}}
    region: dict[str, tuple[float, float]] = {}
    for name, (low, high) in sorted(table.items(), key=lambda item: len(item[0])):
        place = f"$.agent.region.{name}"
        if name not in groups:
            problems.append((place, f"expected one of {', '.join(groups)}"))
        elif low > high:
            problems.append((place, f"expected [low, high] (got [{low:g}, {high:g}])"))
        else:
            region |= dict.fromkeys(groups[name], (low, high))
    return region


def make_network(table: NetworkTable, folder: Path) -> Network:
    """Build the network from its arcs or its file.

    Raises
    ------
    InputError
    """
    pinned = table.pinned if isinstance(table.pinned, list) else []
    if sum(given is not None for given in (table.arcs, table.file, table.ring)) != 1:
        raise InputError("expected either arcs or ring (with agents), or file", "$.network")
    if table.pin_weight <= 0 or (table.pin_weight != 1 and pins_open(table)):
        raise InputError(
            f"expected a number > 0, and 1 where the design chooses the pins "
            f"(got {table.pin_weight:g})",
            "$.network.pin_weight",
        )
    if table.file is None:
        if table.agents is None:
            raise InputError("this key is missing: how many agents there are", "$.network.agents")
        arcs = _ring(table.agents, table.ring) if table.ring is not None else table.arcs or []
        network = network_from_arcs(table.agents, arcs, pinned, table.names)
    else:
        adjacency, names = read_adjacency(folder / str(table.file))
        _check_pins(pinned, adjacency.shape[0])
        weights = np.bincount([k - 1 for k in pinned], minlength=adjacency.shape[0]).clip(max=1)
        network = Network(sp.csr_array(adjacency), weights, tuple(table.names) or names)
    if table.pin_weight != 1:
        network = attrs.evolve(network, pinning=table.pin_weight * network.pinning)
    if len(set(network.names)) < network.N:
        raise InputError("expected a different name for each agent", "$.network.names")
    if isinstance(table.pinned, Count) and not 1 <= table.pinned.count <= network.N:
        raise InputError(
            f"expected 1 to {network.N} (got {table.pinned.count})", "$.network.pinned.count"
        )
    if isinstance(table.pinned, list):
        if not pinned:
            raise InputError(
                'expected at least one pinned agent, or "auto": somebody must know the leader',
                "$.network.pinned",
            )
        network.require_reached()
    return network


def _ring(agents: int, hops: list[int]) -> list[list[float]]:
    """Arcs of a ring in which agent i hears i - k for each of the hops k."""
    if agents < 2:
        raise InputError(f"expected 2 agents or more in a ring (got {agents})", "$.network.agents")
    for k, hop in enumerate(hops):
        if not 1 <= hop < agents or hop in hops[:k]:
            raise InputError(
                f"expected different numbers from 1 to {agents - 1} (got {hop})",
                f"$.network.ring[{k}]",
            )
    return [[(i - hop) % agents + 1, i + 1] for hop in hops for i in range(agents)]


def _check_pins(pinned: list[int], agents: int) -> None:
    for k, agent in enumerate(pinned):
        if not 1 <= agent <= agents:
            raise InputError(
                f"expected agents from 1 to {agents} (got {agent})", f"$.network.pinned[{k}]"
            )


def make_design(table: dict[str, Any]) -> DesignSettings:
    """Build the design settings.

    Raises
    ------
    InputError
    """
    return DesignSettings(**table)


def initial(value: Any, n: int, m: int, random: np.random.Generator, place: str) -> Array:
    """Make initial states (n, m) from a number, one value per state, one row per agent, or Uniform.

    Raises
    ------
    InputError

    Examples
    --------
    >>> initial([1.0, 2.0], 3, 2, np.random.default_rng(0), "x")
    array([[1., 2.],
           [1., 2.],
           [1., 2.]])
    """
    if isinstance(value, Uniform):
        low, high = value.uniform
        if low > high:
            raise InputError(f"expected [low, high] (got [{low:g}, {high:g}])", f"{place}.uniform")
        return random.uniform(low, high, (n, m))
    if isinstance(value, list) and value and isinstance(value[0], list):
        array = _matrix(value, place)
        if array.shape != (n, m):
            raise InputError(
                f"expected {n} rows, one per agent, of {m} states (got {array.shape})", place
            )
        return array
    array = np.atleast_1d(np.asarray(value, dtype=float))
    if array.size not in (1, m):
        raise InputError(f"expected one value or {m}, one per state (got {array.size})", place)
    return np.array(np.broadcast_to(array, (n, m)))


def _start(tables: ScenarioFile, n: int, m: int, random: np.random.Generator) -> Array:
    x = tables.initial.x
    if x is not None and tables.plant.fmu != "positive_agent":
        raise InputError(
            f"only positive_agent takes it; {tables.plant.fmu} starts from its own start values: "
            "set them in $.plant.parameters, or in [[plant.override]] for single agents",
            "$.initial.x",
        )
    return initial(0.0 if x is None else x, n, m, random, "$.initial.x")


def _leader(s0: list[float], m: int, place: str) -> Array:
    if len(s0) != m:
        raise InputError(f"expected {m} values, one per state (got {len(s0)})", place)
    if min(s0) < 0:
        raise InputError("expected a non-negative leader: agents are positive", place)
    return np.array(s0, dtype=float)


def _sensors(table: SensorTable, n: int, q: int) -> Sensors | None:
    rows = {}
    for name in ("noise", "resolution"):
        given = np.atleast_1d(np.asarray(getattr(table, name), dtype=float))
        if given.size not in (1, q) or (given < 0).any():
            raise InputError(
                f"expected one number >= 0 or {q}, one per output (got {given.tolist()})",
                f"$.sensors.{name}",
            )
        rows[name] = np.array(np.broadcast_to(given, (n, q)))
    return Sensors(**rows) if any(row.any() for row in rows.values()) else None


def _jumps(
    jumps: list[JumpTable], m: int, clock: Clock, shortened: bool
) -> tuple[tuple[int, Array], ...]:
    """Communication points and states; those after the end only where that is not the file's."""
    made: list[tuple[int, Array]] = []
    for k, jump in enumerate(jumps):
        place, point = f"$.leader.jump[{k}]", steps_of(jump.at, clock.h)
        if not jump.at > 0 or (made and point <= made[-1][0]):
            raise InputError(
                "expected times > 0 s, one after the other, at communication points of their own",
                f"{place}.at",
            )
        if point > clock.steps and not shortened:
            end = clock.time(clock.steps)
            raise InputError(
                f"expected a time before the end of the run, {end:g} s (got {jump.at:g} s)",
                f"{place}.at",
            )
        made.append((point, _leader(jump.s, m, f"{place}.s")))
    return tuple(made)


def pins_open(table: NetworkTable) -> bool:
    """Whether the design is to choose the pins."""
    return not isinstance(table.pinned, list)


def make_channel(table: ChannelTable, network: Network, h: float) -> Channel:
    """Build the channel over the arcs of the network and those from the leader.

    Raises
    ------
    InputError
    """
    arcs = network.adjacency.nnz + len(network.pinned)
    channel = Channel.uniform(arcs, h, table.delay, table.jitter, table.loss, table.resolution)
    delay, jitter, loss = channel.delay.copy(), channel.jitter.copy(), channel.loss.copy()
    numbers = network.arc_numbers()
    for k, arc in enumerate(table.arc):
        place = f"$.channel.arc[{k}]"
        number = numbers.get(arc.arc)
        if number is None:
            raise InputError(
                f"there is no arc from {arc.arc[0]} to {arc.arc[1]} in the network", f"{place}.arc"
            )
        try:
            one = Channel.uniform(1, h, arc.delay or 0.0, arc.jitter or 0.0, arc.loss or 0.0)
        except InputError as error:
            raise InputError(error.message, f"{place}.{error.where.split('.')[-1]}") from None
        for of_all, given, own in (
            (delay, arc.delay, one.delay),
            (jitter, arc.jitter, one.jitter),
            (loss, arc.loss, one.loss),
        ):
            if given is not None:
                of_all[number] = own[0]
    return Channel(delay, jitter, loss, table.resolution)
