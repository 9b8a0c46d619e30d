"""The tables of a scenario file, as written: one frozen class per TOML table."""

from __future__ import annotations

from typing import Any, Literal

import attrs

Matrix = list[list[float]]
Derivatives = Literal["none", "signals", "all"]


@attrs.frozen
class Uniform:
    """Random initial values from the seed.

    Attributes
    ----------
    uniform : (float, float)
        Least and largest; all between are alike likely.
    """

    uniform: tuple[float, float]


@attrs.frozen
class Count:
    """Pins that the design places.

    Attributes
    ----------
    count : int
        How many agents to pin.
    """

    count: int


@attrs.frozen
class ScenarioTable:
    """``[scenario]``: what to run, for how long.

    Attributes
    ----------
    name : str
        Also the name of the output folder.
    until : float
        End of the run [s]; a multiple of `period`.
    period : float
        Control period = communication step [s]: whole nanoseconds, or a fraction of a second to all
        of its digits (0.016666666666666666 is 1/60). Refused where an FMU does not allow it, with
        the nearest that it allows.
    seed : int
        Of every random number of the run.
    tolerance : float
        Largest final error of an agent that counts as converged.
    engine : {"auto", "c", "numpy"}
        What runs the communication loop; auto: C where it can, else numpy. The results agree to
        1e-12.
    threads : int
        Over which the C engine spreads the agents; not every exporter's FMU allows more than one.
        The results do not depend on it.
    coupling : {"jacobi", "gauss-seidel", "iterate"}
        How FMUs that are connected step: all at once with readings of the last communication
        point; agents first, then each component with what those before it show by then; or all
        at once, again and again until inputs and readings fit (the FMUs must give their states).
    input_derivatives : {"none", "signals", "all"}
        Which inputs go on linearly during a communication step, of FMUs of FMI 2 that interpolate
        (canInterpolateInputs), instead of being held: those that follow a signal with
        ``interpolation = "linear"``; all: also those that are connected to other FMUs, as these
        went on in the step before. What a controller sets is held in any case.
    snapshot : float
        Keep all state of the run every so many seconds, to go on from there (`--resume`,
        `--branch`); 0: never.
    """

    name: str
    until: float
    period: float
    seed: int = 0
    tolerance: float = 1e-2
    engine: Literal["auto", "c", "numpy"] = "auto"
    threads: int = 1
    coupling: Literal["jacobi", "gauss-seidel", "iterate"] = "jacobi"
    snapshot: float = 0.0
    input_derivatives: Derivatives = "signals"


@attrs.frozen
class AgentTable:
    """``[agent]``: model (1), ``x' = A x + H g(t, x) + B sec(u)``, ``y = C x``.

    There are m states, p inputs and q outputs.

    Attributes
    ----------
    A : matrix
        m×m, Metzler: no negative entry off the diagonal.
    B : matrix
        m×p, non-negative.
    C : matrix
        q×m.
    H : matrix, optional
        m×m, weights of g; default zero.
    g : list of str, optional
        m expressions in ``t, x1, …, xm``; default zero.
    sec : list of str, optional
        p expressions, the k-th in ``uk`` only; default ``uk``.
    sector : (float, float)
        ``[m_l, m_h]`` with ``m_l u² ≤ u sec(u) ≤ m_h u²``.
    lipschitz : float or list of float, optional
        Declared bound on the slopes of g, one number or m; default computed on `region`.
    region : table
        ``t``, ``x`` for all states, ``x1``, …, ``u``, ``u1``, … = ``[low, high]``; default
        t, x ≥ 0 and all u.
    """

    A: Matrix
    B: Matrix
    C: Matrix
    H: Matrix | None = None
    g: list[str] | None = None
    sec: list[str] | None = None
    sector: tuple[float, float] = (1.0, 1.0)
    lipschitz: float | list[float] | None = None
    region: dict[str, tuple[float, float]] = attrs.field(factory=dict)


@attrs.frozen
class NetworkTable:
    """``[network]``: who hears whom, and who knows the leader.

    Attributes
    ----------
    agents : int, optional
        Number of agents, with `arcs`.
    arcs : list of [from, to] or [from, to, weight], optional
        ``[from, to]`` or ``[from, to, weight]``: "to" hears "from". Agents are numbered from 1.
    file : str, optional
        Instead of `arcs`: ``.csv`` (header ``from,to`` or ``from,to,weight``), ``.mtx`` (row i
        lists whom agent i hears) or ``.graphml``, beside the scenario file.
    ring : list of int, optional
        Instead of `arcs`: agent i hears the agents i - k of a ring, for each k listed.
    pinned : list of int, "auto" or {count = k}
        The agents that hear the leader; or chosen by the design: the best one, or k of them.
    pin_weight : float
        Weight of the arcs from the leader.
    names : list of str, optional
        Of the agents, for report and errors.
    """

    pinned: list[int] | Literal["auto"] | Count
    agents: int | None = None
    arcs: list[list[float]] | None = None
    file: str | None = None
    ring: list[int] | None = None
    pin_weight: float = 1.0
    names: list[str] = attrs.field(factory=list)


@attrs.frozen
class Port:
    """A protocol quantity and the FMU variable that carries it.

    Attributes
    ----------
    variable : str
        Name in the FMU, or an element of an array, ``u[1]``.
    scale, offset : float
        FMU value = scale × protocol value + offset.
    unit : str, optional
        In which that is; it is converted to the unit of the FMU's variable.
    """

    variable: str
    scale: float = 1.0
    offset: float = 0.0
    unit: str | None = None


@attrs.frozen
class Override:
    """``[[plant.override]]``: what is different for one agent (numbered from 1).

    Attributes
    ----------
    agent : int
        Which one.
    fmu : str, optional
        Another FMU.
    parameters : table
        Besides those of ``[plant]``.
    inputs, outputs, states : table, optional
        Its own ports.
    every : int
        Its control period in communication steps.
    """

    agent: int
    fmu: str | None = None
    parameters: dict[str, Any] = attrs.field(factory=dict)
    inputs: dict[str, str | Port] | None = None
    outputs: dict[str, str | Port] | None = None
    states: dict[str, str | Port] | None = None
    every: int = 1


@attrs.frozen
class PlantTable:
    """``[plant]``: the FMU of every agent and its ports.

    Attributes
    ----------
    fmu : str
        Name of a shipped FMU, or a path relative to the scenario file.
    fmi : int
        Version of a shipped FMU: 2 or 3.
    inputs, outputs, states : table
        ``u1 = "u[1]"`` or ``u1 = {variable = "u[1]", scale = 1.0, offset = 0.0, unit = "W"}``.
    parameters : table
        Start values by name. Those that the FMU does not let one set, or changes, are told and
        stand in ``manifest.json`` under ``start_values``.
    exogenous : table
        FMU input = "name of a signal". While the FMU initialises, the input has the first value
        of the signal already, or its start value where `parameters` give one.
    measured : table
        What the controllers measure beside y, ``name = "signal"``, ``"VARIABLE"`` of the agent's
        FMU or ``"component.VARIABLE"``; which names there are, the control law says.
    record : list of str
        FMU variables that are recorded in ``results.nc`` besides; one whose name a result has
        itself, as x, is ``agents.x`` there.
    tolerance : float, optional
        Relative, for the solver inside the FMU.
    isolation : {"auto", "process", "none"}
        Whether FMUs, those of components as well, run in worker processes; auto: those that this
        installation has not built.
    on_failure : {"stop", "freeze", "restart"}
        What happens to the rest when an FMU fails.
    deadline : float
        For one call of an FMU in a worker process [s].
    memory : float
        Of a worker process [GiB].
    workers : int
        Number of worker processes; 0: as many as processors.
    """

    fmu: str = "positive_agent"
    fmi: int = 3
    inputs: dict[str, str | Port] | None = None
    outputs: dict[str, str | Port] | None = None
    states: dict[str, str | Port] | None = None
    parameters: dict[str, Any] = attrs.field(factory=dict)
    override: list[Override] = attrs.field(factory=list)
    exogenous: dict[str, str] = attrs.field(factory=dict)
    measured: dict[str, str] = attrs.field(factory=dict)
    record: list[str] = attrs.field(factory=list)
    tolerance: float | None = None
    isolation: Literal["auto", "process", "none"] = "auto"
    on_failure: Literal["stop", "freeze", "restart"] = "stop"
    deadline: float = 10.0
    memory: float = 4.0
    workers: int = 0


@attrs.frozen
class Generated:
    """``generated`` of a signal: heat loads of cooling lines from fitted statistics.

    Attributes
    ----------
    kind : {"machine", "training"}
        A large machine with many jobs (fitted to a day of Frontier), or training of one model.
    maximum : float
        Largest load of a line [W].
    step : float, optional
        Between the values [s]; default 15, and the period for training.
    seed : int, optional
        Default: that of the scenario.
    """

    kind: Literal["machine", "training"]
    maximum: float = 130e3
    step: float | None = None
    seed: int | None = None


@attrs.frozen
class SignalTable:
    """``[signals.NAME]``: a signal from outside, the same for all agents or one for each.

    Attributes
    ----------
    value : float, optional
        Constant, instead of `file`.
    times, values : list, optional
        Instead of `file`: times [s], and for each the value, or one value for each agent.
    generated : table, optional
        Instead of `file`: heat loads, see `Generated`.
    file : str, optional
        CSV with a header and the time [s] in its first column; or NetCDF-4 (``.nc``), where the
        variables over ``time`` are the columns.
    columns : list of str
        Which columns; one, or one for each agent. Default: all but the time.
    scale, offset : float
        Signal = scale × what stands in the file + offset.
    unit : str, optional
        In which the signal is; it is converted to that of the input that follows it.
    interpolation : {"hold", "linear"}
        Between two times of the file. A signal is held over a communication step, unless it is
        linear and the FMU interpolates, see `input_derivatives` in ``[scenario]``.
    """

    value: float | None = None
    times: list[float] | None = None
    values: list[float | list[float]] | None = None
    generated: Generated | None = None
    file: str | None = None
    columns: list[str] = attrs.field(factory=list)
    scale: float = 1.0
    offset: float = 0.0
    unit: str | None = None
    interpolation: Literal["hold", "linear"] = "hold"


@attrs.frozen
class ComponentTable:
    """``[[component]]``: an FMU that is no agent, as a facility that agents share.

    Attributes
    ----------
    name : str
        Of the component: what is recorded of it is ``name.variable`` in ``results.nc``.
    fmu : str
        As in ``[plant]``.
    fmi : int
        Version of a shipped FMU: 2 or 3.
    parameters : table
        Start values by name.
    exogenous : table
        FMU input = "name of a signal".
    record : list of str
        FMU variables that are recorded.
    tolerance : float, optional
        Relative, for the solver inside the FMU.
    """

    name: str
    fmu: str
    fmi: int = 3
    parameters: dict[str, Any] = attrs.field(factory=dict)
    exogenous: dict[str, str] = attrs.field(factory=dict)
    record: list[str] = attrs.field(factory=list)
    tolerance: float | None = None


@attrs.frozen
class ConnectionTable:
    """``[[connection]]``: what one FMU shows is an input of another, one communication step later.

    Attributes
    ----------
    source, to : str
        ``"agents.VARIABLE"``, or the name of a component or an agent instead of ``agents``.
        ``{agent}`` in a variable stands for the agent's number.
    sum : bool
        Whether an input is the sum over all agents.
    scale : float or list of float, optional
        With `sum`, also one for each agent.
    offset : float, optional
        Input = scale × source + offset. Where neither is given, units are converted or refused.
    """

    source: str
    to: str
    sum: bool = False
    scale: float | list[float] | None = None
    offset: float | None = None


@attrs.frozen
class SensorTable:
    """``[sensors]``: what the sensors of the outputs make of them.

    Attributes
    ----------
    noise : float or list of float
        Standard deviation, of all outputs or of each.
    resolution : float or list of float
        Step between two values; 0: none.
    """

    noise: float | list[float] = 0.0
    resolution: float | list[float] = 0.0


@attrs.frozen
class FaultTable:
    """``[[fault]]``: what is otherwise for a time.

    Attributes
    ----------
    kind : str
        One of ``sensor stuck``, ``sensor bias``, ``sensor noise``, ``actuator stuck``,
        ``actuator slow``, ``messages lost``, ``leader lost``, ``arc off``, ``FMU crash``.
    at : float
        When it begins [s], before the end of the run; with ``--until`` a later one is left out.
    until : float, optional
        When it ends [s]; left out: never. Not for a crash.
    agents : list of int
        Whose sensors or actuators; default all.
    ports : list of int
        Which outputs or inputs of these, counted from 1; default all.
    arcs : list of [from, to]
        For ``messages lost`` and ``arc off``; 0 is the leader; default all.
    value : float, optional
        The bias; the standard deviation of noise; the part of the way that a slow actuator goes
        in each step (0 to 1); the
        probability of loss (default 1).
    """

    kind: Literal[
        "sensor stuck",
        "sensor bias",
        "sensor noise",
        "actuator stuck",
        "actuator slow",
        "messages lost",
        "leader lost",
        "arc off",
        "FMU crash",
    ]
    at: float
    until: float | None = None
    agents: list[int] = attrs.field(factory=list)
    ports: list[int] = attrs.field(factory=list)
    arcs: list[tuple[int, int]] = attrs.field(factory=list)
    value: float | None = None


@attrs.frozen
class JumpTable:
    """``[[leader.jump]]``: the leader goes on from another state.

    Attributes
    ----------
    at : float
        When [s].
    s : list of float
        That state.
    """

    at: float
    s: list[float]


@attrs.frozen
class LeaderTable:
    """``[leader]``: its initial state, and jumps to other states.

    Attributes
    ----------
    s0 : list of float
        Initial state, non-negative.
    jump : list of JumpTable
    """

    s0: list[float]
    jump: list[JumpTable] = attrs.field(factory=list)


@attrs.frozen
class InitialTable:
    """``[initial]``: a number, one value per state, one row per agent, or ``{uniform = […]}``.

    Attributes
    ----------
    x : number, list or table
        States at the start, of `positive_agent` only; another FMU starts from its start values, see
        `parameters` in ``[plant]`` and ``[[plant.override]]``. Default 0.
    xhat : number, list or table
        Estimates at the start. At or below the states is what the proof of positivity asks for.
    """

    x: float | list[float] | Matrix | Uniform | None = None
    xhat: float | list[float] | Matrix | Uniform = 0.0


@attrs.frozen
class ArcTable:
    """``[[channel.arc]]``: what is different on a single arc.

    Attributes
    ----------
    arc : (int, int)
        ``[from, to]``, by agent numbers from 1; 0 is the leader.
    delay, jitter, loss : float, optional
        As in ``[channel]``; what is left out is as there.
    """

    arc: tuple[int, int]
    delay: float | None = None
    jitter: float | None = None
    loss: float | None = None


@attrs.frozen
class ChannelTable:
    """``[channel]``: delay and jitter [s] and loss (probability) of every arc.

    Attributes
    ----------
    delay, jitter : float
        Of every message [s], rounded up to communication steps.
    loss : float
        Probability that a message is lost; the last value is kept.
    resolution : float
        Messages are rounded to multiples of it; 0: they are not.
    arc : list of ArcTable
        What is different on single arcs.
    """

    delay: float = 0.0
    jitter: float = 0.0
    loss: float = 0.0
    resolution: float = 0.0
    arc: list[ArcTable] = attrs.field(factory=list)


@attrs.frozen
class ControlTable:
    """``[control]`` and ``[controllers.NAME]``: the law of the agents' controllers.

    Attributes
    ----------
    law : str
        ``protocol``: (6) with the gains of ``[design]``. With ``[cooling]``: one of
        `posmas_fmi.cooling.CONTROLLERS`.
    parameters : table
        Of the law; for cooling those of `posmas_fmi.cooling.Control`.
    python : str, optional
        ``"file.py:Class"``, a controller of one's own instead of a law: an object per agent, made
        with its number and the parameters, or one for all if it has ``step_all``. Running the
        scenario runs that file.
    """

    law: str = "protocol"
    python: str | None = None
    parameters: dict[str, Any] = attrs.field(factory=dict)


@attrs.frozen
class CompareTable:
    """``[compare]``: several controllers on the same plant, loads, faults and random numbers.

    Attributes
    ----------
    controllers : list of str
        Laws, or names of ``[controllers.NAME]``.
    practice : str, optional
        Which of them the others are judged against; default ``pi`` where it is among them.
    processes : int, optional
        How many run at once; default one per processor.
    """

    controllers: list[str]
    practice: str | None = None
    processes: int | None = None


@attrs.frozen
class SetPointStep:
    """``set_point_step``: another set-point from a time on.

    Attributes
    ----------
    at : float
        From when on [s].
    to : float
        Supply temperature above `facility` [K].
    """

    at: float
    to: float


@attrs.frozen
class Air:
    """``air``: the air of the room, for the dew point.

    Attributes
    ----------
    temperature : float
        [K]
    humidity : float
        Relative, 0 to 1.
    """

    temperature: float
    humidity: float


@attrs.frozen
class CoolingTable:
    """``[cooling]``: a row of liquid-cooling lines on one facility header.

    It stands for ``[agent]``, ``[plant]``, ``[leader]``, ``[initial]``, two components and their
    connections; what a scenario says in those tables itself counts more.

    Attributes
    ----------
    sizes : float or list of float
        Nominal load of the lines, or of each [W].
    load : str
        Name of the signal with the IT power [W].
    loads : (float, float)
        Range of the loads that the design covers [W], of a line of 80 kW.
    pump : str, optional
        Name of the signal with the speed of the lines' pumps, 1 nominal.
    shortage : float
        Shared part of the resistance of the primary circuit over that of the lines; 0: ample water.
    facility : float
        Facility supply temperature at nominal heat [K].
    wet_bulb : float or str
        Outdoors [K], or the name of a signal.
    chiller : float
        Heat that a chiller can reject besides the cooler [W].
    water_class : str, optional
        W17, W27, W32, W40 or W45: the limit of the facility supply.
    air : table, optional
        Temperature and humidity of the room: supply stays 2 K above its dew point.
    noise, resolution : float
        Of the temperature sensors [K].
    set_point : float, optional
        Supply temperature above `facility` [K]; default 5.
    set_point_step : table, optional
        Another set-point from a time on.
    band : float
        Around the set-point that is to be kept [K].
    """

    sizes: float | list[float] = 80e3
    load: str = "load"
    loads: tuple[float, float] = (40e3, 130e3)
    pump: str | None = None
    shortage: float = 0.0
    facility: float = 305.15
    wet_bulb: float | str = 293.15
    chiller: float = 0.0
    water_class: str | None = None
    air: Air | None = None
    noise: float = 0.05
    resolution: float = 0.1
    set_point: float | None = None
    set_point_step: SetPointStep | None = None
    band: float = 1.0


@attrs.frozen
class RecordTable:
    """``[record]``: what of a run is kept.

    Attributes
    ----------
    every : int
        Only every k-th communication point, and the last one.
    variables : list of str
        Of ``x``, ``xhat``, ``u``, ``sec_u``, ``y``, ``s``. The report needs ``xhat``, ``u``, ``y``
        and ``s``: without one of them there is none.
    csv : bool
        Whether ``results.csv`` is written as well.
    """

    every: int = 1
    variables: list[Literal["x", "xhat", "u", "sec_u", "y", "s"]] = attrs.field(
        factory=lambda: ["x", "xhat", "u", "sec_u", "y", "s"]
    )
    csv: bool = False


@attrs.frozen
class ReportTable:
    """``[report]``: what the report shows.

    Attributes
    ----------
    baseline : bool
        Whether the run without control (K = 0) is made as well, for comparison.
    """

    baseline: bool = True


@attrs.frozen
class ScenarioFile:
    """A whole scenario file."""

    scenario: ScenarioTable
    agent: AgentTable
    network: NetworkTable
    leader: LeaderTable
    design: dict[str, Any] = attrs.field(factory=dict)
    plant: PlantTable = attrs.field(factory=PlantTable)
    initial: InitialTable = attrs.field(factory=InitialTable)
    channel: ChannelTable = attrs.field(factory=ChannelTable)
    report: ReportTable = attrs.field(factory=ReportTable)
    record: RecordTable = attrs.field(factory=RecordTable)
    signals: dict[str, SignalTable] = attrs.field(factory=dict)
    component: list[ComponentTable] = attrs.field(factory=list)
    connection: list[ConnectionTable] = attrs.field(factory=list)
    fault: list[FaultTable] = attrs.field(factory=list)
    sensors: SensorTable = attrs.field(factory=SensorTable)
    control: ControlTable = attrs.field(factory=ControlTable)
    controllers: dict[str, ControlTable] = attrs.field(factory=dict)
    compare: CompareTable | None = None
    cooling: CoolingTable | None = None
