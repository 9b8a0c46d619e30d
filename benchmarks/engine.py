"""Time per agent and communication step: engine, numpy path and other masters over the floor.

    python benchmarks/engine.py [--agents 9 100 1000 10000] [--fmi 3 2] [--rounds 200]

All in one run, 1 ms steps of the paper's Example 1. The floor is a loop in C over the same FMUs
that only sets u, steps and gets y, with the inputs of the controlled run. Engine and numpy path do
all of the master's work besides: observer, protocol, exchange, checks, reading x.

Floor, engine and numpy path take turns every millisecond or so, each with FMUs of its own, and of
each the fastest turn counts (CPU time of the thread): what else the machine does falls on all alike
and is left out. The other masters are measured twice: stepping the plants alone, which is less than
the engine does, and on equal terms, with a controller FMU per agent and all connections
(`peers.py`). No master can be further ahead of another one than the floor is.

Against the other masters both wall time and CPU time (of the process) are told, for some use
several threads by default; the engine is measured like them, with one thread and with two. Each is
the best of ten stretches of the same part of the run, fewer where a stretch takes long, and that
begun anew up to eight times where it is quick: early in the run the FMUs have less to do.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # idle BLAS threads spin, and that counts

import argparse
import ctypes
import math
import subprocess
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import attrs
import numpy as np
import peers
from peers import Skip

from posmas_fmi.agent import Agent
from posmas_fmi.cosim import engine, native
from posmas_fmi.cosim.channel import Channel
from posmas_fmi.cosim.clock import Clock
from posmas_fmi.cosim.conditions import Sensors
from posmas_fmi.cosim.fmu_plant import FmuPlant, PlantSpec, PortMap
from posmas_fmi.cosim.law import ProtocolLaw
from posmas_fmi.cosim.master import System
from posmas_fmi.cosim.propagator import Propagator
from posmas_fmi.fmu.build import agent_fmu, fmu
from posmas_fmi.fmu.compile import find_compiler, host
from posmas_fmi.fmu.model import Experiment, FmuModel, Variable
from posmas_fmi.network import network_from_arcs
from posmas_fmi.protocol import make_protocol
from posmas_fmi.scenario.build import load

H = 0.001  # s
STRETCHES = 10
FLOOR = Path(__file__).parent / "floor.c"


# ---- the system ----------------------------------------------------------------------------------


@attrs.frozen(eq=False)
class Setting:
    """Example 1 on a ring of N agents."""

    agent: Agent
    n: int
    steps: int
    fmu: Path

    @classmethod
    def of(cls, n: int, steps: int, fmi: int = 3) -> Setting:
        agent = load("paper_example_1").agent
        return cls(agent, n, steps, agent_fmu(agent.g, agent.sec, agent.m, agent.p, agent.q, fmi))

    @property
    def network(self):
        ring = [(i, i % self.n + 1) for i in range(1, self.n + 1) if self.n > 1]
        return network_from_arcs(self.n, ring + [(i, i + 2) for i in range(1, self.n - 1)], [1])

    @property
    def x0(self) -> np.ndarray:
        return np.random.default_rng(1).uniform(0, 2, (self.n, 2))

    def system(self) -> System:
        K, E = [[-0.5725, -0.5786]], [[5.0, 2.5], [1.0, 4.0]]
        network = self.network
        return System(
            self.agent,
            network,
            ProtocolLaw(self.agent, make_protocol(network, K, E, phi=0.3)),
            Channel.uniform(network.adjacency.nnz + 1, H),
            Clock.of(self.steps * H, H),
            np.zeros((self.n, 2)),
            np.ones(2),
        )

    def plant(self, path: Path | None = None) -> FmuPlant:
        agent = self.agent
        given = {} if path else {"A": agent.A, "H": agent.H, "B": agent.B, "C": agent.C}
        specs = [PlantSpec(path or self.fmu, {**given, "x": x}) for x in self.x0]
        ports = [PortMap.plain([f"{v}[{k + 1}]" for k in range(c)]) for v, c in PORTS]
        return FmuPlant.of_agents(self.network.names, specs, *ports, stop=math.inf)


PORTS = (("u", 1), ("y", 2), ("x", 2))


@attrs.frozen
class Cost:
    """Time per agent and step [ns]."""

    cpu: float
    wall: float

    def least(self, other: Cost) -> Cost:
        """The best of two stretches, of each kind of time."""
        return Cost(min(self.cpu, other.cpu), min(self.wall, other.wall))


def timed(run: Callable[[], None], agent_steps: float) -> Cost:
    cpu, wall = time.process_time(), time.perf_counter()
    run()
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    return Cost(cpu / agent_steps * 1e9, wall / agent_steps * 1e9)


def stretches(setting: Setting, advance: Callable[[int], None]) -> Cost:
    """Best of ten stretches, of fewer if they take more than five seconds."""
    advance(1)
    began, best = time.perf_counter(), Cost(math.inf, math.inf)
    for _ in range(STRETCHES):
        best = best.least(timed(lambda: advance(setting.steps), setting.n * setting.steps))
        if time.perf_counter() - began > 5:
            break
    return best


Verdicts = list[tuple[str, float, float, bool]]  # what, value, target, whether less is better


def tell(verdicts: Verdicts) -> None:
    """Print each target with its figure."""
    print("\ntargets")
    for what, value, target, less in verdicts:
        met = value <= target if less else value >= target
        short = "met" if met else f"falls short by {abs(value / target - 1):.0%}"
        print(f"  {what:66} {value:8.3g} ({'at most' if less else 'at least'} {target:g}): {short}")


# ---- what is compared ----------------------------------------------------------------------------


def inputs_of(setting: Setting) -> np.ndarray:
    rows: list[np.ndarray] = []
    with setting.plant() as plant:
        engine.run(
            setting.system(), plant, lambda _, v: rows.append(v["u"].copy()), variables=("u",)
        )
    return np.ascontiguousarray(np.concatenate(rows))


def floor_library(folder: Path) -> ctypes.CDLL:
    target = host()
    output = folder / f"floor{target.extension}"
    subprocess.run([*find_compiler(target).arguments(target), "-o", output, FLOOR], check=True)
    return ctypes.CDLL(str(output))


class Turns:
    """Floor, engine and numpy path in turns over the same stretch of the run."""

    def __init__(self, setting: Setting, per_turn: int, library: ctypes.CDLL) -> None:
        self.setting, self.per_turn = setting, per_turn
        self._inputs = inputs_of(setting)
        self._plants = [setting.plant() for _ in range(5)]
        self._floor = self._bind(library)
        choice = engine.choose(setting.system().law, "c")
        self._engines = []
        for plant, variables in zip(self._plants[1:], ((), engine.VARIABLES), strict=False):
            one = engine.Engine(setting.system(), plant, native.load(choice.library), 1, variables)
            one._begin()
            self._engines.append(one)

    def _bind(self, library: ctypes.CDLL) -> Callable[[int, int], None]:
        pointer, size, word = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int64
        function = library.floor_run
        function.argtypes = [
            *(ctypes.c_int, pointer, pointer, pointer, pointer, word),
            *(pointer, size, size, pointer, size, size, ctypes.c_double, pointer, word, word),
        ]
        function.restype = word
        instances = self._plants[0]._instances
        file, n = instances[0].file, self.setting.n
        real = "Real" if file.version == 2 else "Float64"
        address = [
            file.address(f"fmi{file.version}{f}") for f in (f"Set{real}", "DoStep", f"Get{real}")
        ]
        u, y = file.ports(["u[1]"]), file.ports(["y[1]", "y[2]"])
        components = np.array([i.component for i in instances], dtype=np.uintp)

        def run(begin: int, end: int) -> None:
            bad = function(
                *(file.version, *address, components.ctypes.data, n),
                *(ctypes.addressof(u.references), len(u.references), u.size),
                *(ctypes.addressof(y.references), len(y.references), y.size),
                *(H, self._inputs[begin:].ctypes.data, begin, end),
            )
            assert bad == 0

        return run

    def _engine(self, one: engine.Engine, end: int) -> None:
        e = one._e
        while e.k < end:
            e.until = min(end, e.k + one._room) if one._rows else end
            one._call()

    def best(self, rounds: int) -> dict[str, float]:
        """Smallest CPU time per agent and step [ns] of each."""
        runs: dict[str, Callable[[int, int], None]] = {
            "floor": self._floor,
            "engine": lambda _, end: self._engine(self._engines[0], end),
            "engine, recording": lambda _, end: self._engine(self._engines[1], end),
        }
        best = dict.fromkeys(runs, math.inf)
        for turn in range(rounds):
            begin, end = turn * self.per_turn, (turn + 1) * self.per_turn
            for name, run in runs.items():
                began = time.thread_time()
                run(begin, end)
                best[name] = min(best[name], time.thread_time() - began)
        few = max(100, min(2000, 1_000_000 // self.setting.n))  # a second or less
        law = self.setting.system().law
        numpy = self._numpy(self._plants[3], few, engine.choose(law, "numpy"))
        alone = self._numpy(self._plants[4], few, engine.Choice("numpy"))
        steps = self.setting.n / 1e9
        return {
            **{name: value / steps / self.per_turn for name, value in best.items()},
            "numpy path": numpy / steps,  # the law in C
            "numpy path, all": alone / steps,  # in numpy as well
        }

    def _numpy(self, plant: FmuPlant, steps: int, choice: engine.Choice) -> float:
        times: list[float] = []
        short = attrs.evolve(self.setting, steps=steps)
        system = short.system()
        engine.run(
            system,
            plant,
            choice=choice,
            progress=lambda *_: times.append(time.thread_time()),
        )
        return float(np.diff(times).min())

    def close(self) -> None:
        for plant in self._plants:
            plant.close()


def fmpy_loop(setting: Setting, controlled: bool = False) -> Cost:
    """The loop of FMPy's examples: one slave per agent, values by lists.

    If controlled, each agent has its observer and controller as a few lines of numpy.
    """
    import fmpy
    from fmpy.fmi3 import FMU3Slave

    folder = fmpy.extract(str(setting.fmu))
    description = fmpy.read_model_description(folder)
    reference = {v.name: v.valueReference for v in description.modelVariables}
    identifier = description.coSimulation.modelIdentifier
    agent, slaves = setting.agent, []
    for k in range(setting.n):
        slave = FMU3Slave(
            guid=description.guid,
            unzipDirectory=folder,
            modelIdentifier=identifier,
            instanceName=str(k),
        )
        slave.instantiate()
        for name in "AHBC":
            slave.setFloat64([reference[name]], getattr(agent, name).ravel())
        slave.setFloat64([reference["x"]], setting.x0[k])
        slave.enterInitializationMode()
        slave.exitInitializationMode()
        slaves.append(slave)

    system = setting.system()
    estimates, heard = system.xhat0.copy(), system.network.adjacency.indptr
    observe, weights = Propagator.of(agent, H), system.law.protocol
    senders = system.senders

    def control(t: float, i: int, y: np.ndarray) -> list[float]:
        xhat = estimates[i]
        neighbours = estimates[senders[heard[i] : heard[i + 1]]]
        disagreement = (xhat - neighbours).sum(axis=0) + weights.leader[i] * (xhat - system.s0)
        u = weights.K @ disagreement
        correction = weights.E @ (y - agent.C @ xhat)
        held = agent.B @ agent.sec_numpy(u[None])[0] + correction
        estimates[i] = observe(t, xhat[None], held[None])[0]
        return list(u)

    done = 0

    def advance(steps: int) -> None:
        nonlocal done
        for k in range(done, done + steps):
            for i, slave in enumerate(slaves):
                y = slave.getFloat64([reference["y"]], nValues=2)
                u = control(k * H, i, np.array(y)) if controlled else [0.1]
                slave.setFloat64([reference["u"]], u)
                slave.doStep(currentCommunicationPoint=k * H, communicationStepSize=H)
        done += steps

    return stretches(setting, advance)


def fmpy_ssp(setting: Setting, controlled: bool) -> Cost:
    if setting.n > 20:
        raise Skip("it starts 100 agents in seconds; its cost per agent stays the same")
    loop, steps = loop_of(setting, controlled), 10_000 // setting.n

    def run(count: int) -> Cost:
        return timed(lambda: peers.fmpy_ssp(loop, count), steps * setting.n)

    long, short = run(10 + steps), run(10)  # what it takes to start is taken off
    return Cost(long.cpu - short.cpu, long.wall - short.wall)


def agent_fmu_2(setting: Setting) -> Path:
    agent = setting.agent
    return agent_fmu(agent.g, agent.sec, agent.m, agent.p, agent.q, 2)


def loop_of(setting: Setting, controlled: bool) -> peers.Loop:
    make = peers.closed_loop if controlled else peers.plants_alone
    return make(setting.system(), setting.x0)


def stepwise(master: Callable, setting: Setting, controlled: bool) -> Cost:
    if controlled and master is peers.libcosim and setting.n > 300:
        raise Skip("its start takes minutes; its cost per agent does not fall with their number")
    with master(loop_of(setting, controlled)) as peer:
        return stretches(setting, peer.advance)


def engine_as_peer(setting: Setting, threads: int) -> Cost:
    """The engine over the same stretches as the others, each in one call."""
    whole = attrs.evolve(setting, steps=setting.steps * STRETCHES + 2)
    system = whole.system()
    library = native.load(engine.choose(system.law, "c").library)
    with whole.plant() as plant:
        one = engine.Engine(system, plant, library, threads, ())
        one._begin()

        def advance(steps: int) -> None:
            one._e.until = one._e.k + steps
            one._call()

        return stretches(setting, advance)


def mosaik_master(setting: Setting) -> Cost:
    """A mosaik scenario whose simulator steps one FMU per entity with FMPy."""
    if setting.n > 300:
        raise Skip("its start takes minutes; its cost per agent does not fall with their number")
    try:
        import mosaik
        import mosaik_api_v3
    except ImportError as error:
        raise Skip(str(error)) from error
    import fmpy
    from fmpy.fmi2 import FMU2Slave

    folder = fmpy.extract(str(agent_fmu_2(setting)))
    description = fmpy.read_model_description(folder)
    identifier = description.coSimulation.modelIdentifier
    reference = {v.name: v.valueReference for v in description.modelVariables}
    values = list(loop_of(setting, controlled=False).values.values())

    class Plant(mosaik_api_v3.Simulator):
        """mosaik-fmi does not install (its fmipp does not build): this is what it would do."""

        def __init__(self) -> None:
            model = {"public": True, "params": [], "attrs": ["y"]}
            super().__init__({"type": "time-based", "models": {"Agent": model}})
            self.slaves: list[FMU2Slave] = []

        def init(self, sid: str, time_resolution: float = 1.0, **_: object) -> dict:
            return self.meta

        def create(self, num: int, model: str, **_: object) -> list[dict]:
            entities = []
            for _index in range(num):
                k = len(self.slaves)
                slave = FMU2Slave(
                    guid=description.guid,
                    unzipDirectory=folder,
                    modelIdentifier=identifier,
                    instanceName=str(k),
                )
                slave.instantiate()
                slave.setupExperiment()
                for name, value in values[k].items():
                    slave.setReal([reference[name]], [value])
                slave.enterInitializationMode()
                slave.exitInitializationMode()
                self.slaves.append(slave)
                entities.append({"eid": str(k), "type": model})
            return entities

        def step(self, now: int, inputs: dict, max_advance: int) -> int:
            for slave in self.slaves:
                slave.doStep(currentCommunicationPoint=now * H, communicationStepSize=H)
            return now + 1

        def get_data(self, outputs: dict) -> dict:
            return {}

    plants: list[Plant] = []

    class One(Plant):
        def __init__(self) -> None:
            super().__init__()
            plants.append(self)

    globals()["MosaikAgents"] = One
    try:
        from loguru import logger

        logger.remove()
    except (ImportError, ValueError):
        pass
    world = mosaik.World({"Agents": {"python": f"{__name__}:MosaikAgents"}}, skip_greetings=True)
    try:
        for _ in range(setting.n):  # one simulator per FMU, as mosaik-fmi has it
            world.start("Agents").Agent()
        steps = max(20, setting.steps // 10)  # in one go, with a part of its start
        return timed(lambda: world.run(until=steps, print_progress=False), steps * setting.n)
    finally:
        world.shutdown()


# ---- threads and start-up ------------------------------------------------------------------------

SLOW_C = """
#include <math.h>
#include "model.h"

void model_derivatives(double t, const double *p, const double *u, const double *x, double *dx)
{
    double sum = 0;
    for (int k = 0; k < 150; k++)
        sum += sin(t + k * x[0]);
    dx[0] = u[0] - x[0] + 1e-3 * sum;
    dx[1] = -p[0] * x[1];
}

void model_outputs(double t, const double *p, const double *u, const double *x, double *y)
{
    (void)t, (void)p, (void)u;
    y[0] = x[0];
    y[1] = x[1];
}

void model_directional(double t, const double *p, const double *u, const double *x,
                       const double *su, const double *sx, double *sdx, double *sy)
{
    (void)t, (void)p, (void)u, (void)x, (void)su;
    sdx[0] = -sx[0];
    sdx[1] = -sx[1];
    sy[0] = sx[0];
    sy[1] = sx[1];
}
"""


def threads(repeat: int) -> Verdicts:
    variables = (
        Variable("p", "parameter", (1,), (1.0,)),
        Variable("u", "input", (1,), (0.0,)),
        Variable("x", "state", (2,), (1.0, 1.0)),
        Variable("y", "output", (2,), depends=("x",)),
    )
    path = fmu(FmuModel("slow", "", variables, {"model.c": SLOW_C}, Experiment()))
    stretch, repeat = 4, 60 * repeat
    setting = Setting.of(100, stretch * repeat + 1)
    choice = engine.choose(setting.system().law, "c")
    library = native.load(choice.library)
    wall = dict.fromkeys(("one", "two", "apart"), math.inf)
    with ExitStack() as stack:

        def begun(of: Setting, count: int) -> engine.Engine:
            plant = stack.enter_context(of.plant(path))
            one = engine.Engine(of.system(), plant, library, count, ())
            one._begin()
            return one

        def go(one: engine.Engine) -> None:
            one._e.until = one._e.k + stretch
            one._call()

        one, two = begun(setting, 1), begun(setting, 2)
        halves = [begun(attrs.evolve(setting, n=setting.n // 2), 1) for _ in range(2)]
        pool = stack.enter_context(ThreadPoolExecutor(2))
        runs = {
            "one": lambda: go(one),
            "two": lambda: go(two),
            "apart": lambda: list(pool.map(go, halves)),
        }
        for _ in range(repeat):  # short stretches: now and then both processors are free
            for name, run in runs.items():
                began = time.perf_counter()
                run()
                took = (time.perf_counter() - began) / stretch / setting.n * 1e9
                wall[name] = min(wall[name], took)
    print(
        f"\n{wall['one'] / 1000:.1f} us per agent-step on one thread, two are "
        f"{wall['one'] / wall['two']:.2f} times as fast; two engines that do not wait for each "
        f"other {wall['one'] / wall['apart']:.2f} times: what the machine gives (wall time; "
        f"{os.cpu_count()} processors, load {os.getloadavg()[0]:.1f})"
    )
    times = wall["one"] / wall["two"]
    return [("two threads, 10 us per step: times as fast", times, 1.6, False)]


def arcs_and_sensors(n: int, repeat: int) -> None:
    """What delay, jitter and loss on every arc, and noise of every sensor, cost a whole run."""
    setting = Setting.of(n, 200_000 // n)
    ideal = setting.system()
    arcs, sensors = ideal.network.adjacency.nnz + 1, (n, ideal.agent.q)
    channel = Channel.uniform(arcs, H, delay=2 * H, jitter=3 * H, loss=0.1)
    runs = {
        "ideal": ideal,
        "arcs": attrs.evolve(ideal, channel=channel),
        "noise": attrs.evolve(ideal, sensors=Sensors(np.full(sensors, 1e-3), np.zeros(sensors))),
    }
    best = dict.fromkeys(runs, math.inf)
    for _ in range(repeat):
        for name, system in runs.items():
            with setting.plant() as plant:
                began = time.thread_time()
                engine.run(system, plant, choice=engine.choose(system.law, "c"))
                best[name] = min(best[name], time.thread_time() - began)
    times = {name: value / best["ideal"] for name, value in best.items()}
    print(
        f"\n{n} agents: with delay, jitter and loss on every arc {times['arcs']:.2f} times, "
        f"with noise of every sensor {times['noise']:.2f} times as long"
    )


def start_up(repeat: int) -> Verdicts:
    best = {}
    for n in (1, 1000, 10_000):
        setting = Setting.of(n, 1)
        for _ in range(repeat):
            began = time.process_time()
            plant = setting.plant()
            best[n] = min(best.get(n, math.inf), time.process_time() - began)
            plant.close()
    print(
        f"\nstart-up: first instance {best[1] * 1e3:.1f} ms, 1000 instances "
        f"{(best[1000] - best[1]) * 1e3:.0f} ms more, 10000 {(best[10_000] - best[1]) * 1e3:.0f} ms"
        " (CPU time)"
    )
    return [("start-up of 1000 instances after the first [s]", best[1000] - best[1], 0.1, True)]


def memory_per_agent() -> Verdicts:
    """All that an agent takes, in kB: Python objects, the engine's arrays, and its FMU as well."""
    n = 10_000
    setting = Setting.of(n, 100)
    Setting.of(10, 1).plant().close()  # everything is loaded
    began = _resident()
    with setting.plant() as plant:
        system = setting.system()
        choice = engine.choose(system.law, "c")
        one = engine.Engine(system, plant, native.load(choice.library), 1, engine.VARIABLES)
        one.run(lambda *_: None, None)
        per_agent = (_resident() - began) / n
    print(f"\nmemory: {per_agent:.1f} kB per agent of {n}, its FMU included")
    return [("memory per agent of 10000, its FMU included [kB]", per_agent, 20.0, True)]


def _resident() -> float:
    """Resident memory of this process [kB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1000


# ---- the table -----------------------------------------------------------------------------------

PEERS: dict[str, Callable[[Setting], Cost]] = {
    "libcosimpy": lambda setting: stepwise(peers.libcosim, setting, False),
    "ecospy": lambda setting: stepwise(peers.ecos, setting, False),
    "mosaik": mosaik_master,
    "fmpy.ssp": lambda setting: fmpy_ssp(setting, False),
    "FMPy loop": fmpy_loop,
}
# the same closed loop, with controllers and all connections
EQUAL: dict[str, Callable[[Setting], Cost]] = {
    "libcosimpy, equal": lambda setting: stepwise(peers.libcosim, setting, True),
    "ecospy, equal": lambda setting: stepwise(peers.ecos, setting, True),
    "fmpy.ssp, equal": lambda setting: fmpy_ssp(setting, True),
    "FMPy loop, equal": lambda setting: fmpy_loop(setting, controlled=True),
}
ENGINE = {9: 1.25, 1000: 1.15}  # targets, over the floor


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--agents", type=int, nargs="+", default=[9, 100, 1000, 10_000])
    parser.add_argument("--fmi", type=int, nargs="+", default=[3, 2])
    parser.add_argument("--rounds", type=int, default=600)
    parser.add_argument("--repeat", type=int, default=5)
    options = parser.parse_args()
    verdicts = memory_per_agent()  # first: what others free is not given back to the system
    with tempfile.TemporaryDirectory() as folder:
        library = floor_library(Path(folder))
        for fmi in options.fmi:
            cost = {}
            for n in options.agents:
                # the peers run FMI 2, and are compared once
                best, more = table(n, fmi, library, options.rounds, with_peers=fmi == 3)
                cost[n] = best["engine"]
                verdicts += more
            flat = [value for n, value in cost.items() if n >= 100]
            if len(flat) > 1:
                spread = max(flat) / min(flat)
                verdicts.append((f"FMI {fmi}: dearest over cheapest, N >= 100", spread, 1.15, True))
    for n in options.agents:
        if n <= 1000:
            arcs_and_sensors(n, min(options.repeat, 3))
    verdicts += threads(options.repeat) + start_up(options.repeat)
    tell(verdicts)


def table(
    n: int, fmi: int, library: ctypes.CDLL, rounds: int, with_peers: bool
) -> tuple[dict[str, float], Verdicts]:
    per_turn = max(2, 3000 // n)
    rounds = max(20, min(rounds, 600_000 // n))
    turns = Turns(Setting.of(n, rounds * per_turn + 1, fmi), per_turn, library)
    best = turns.best(rounds)
    turns.close()
    print(f"\n{n} agents, FMI {fmi}, CPU time per agent and step of {H * 1e3:g} ms")
    for name, value in best.items():
        print(f"  {name:18} {value:10.0f} ns {value / best['floor']:8.2f}", flush=True)
    over = {name: value / best["floor"] for name, value in best.items()}
    verdicts: Verdicts = []
    if n in ENGINE:
        verdicts.append(
            (f"FMI {fmi}, N = {n}: engine over the floor", over["engine"], ENGINE[n], True)
        )
    if n == 1000:
        for name, how in (("numpy path", "the law in C"), ("numpy path, all", "all by numpy")):
            what = f"FMI {fmi}, N = {n}: numpy path ({how}) over the floor"
            verdicts.append((what, over[name], 1.5, True))
    if with_peers and n <= 1000:
        verdicts += peers_table(n, best["floor"])
    return best, verdicts


def peers_table(n: int, floor: float) -> Verdicts:
    """The other masters and the engine, in wall and in CPU time."""
    setting = Setting.of(n, max(20, 20_000 // n))
    ours = {f"engine, {k} thread{'s' * (k > 1)}": k for k in (1, 2)}
    runs: dict[str, Callable[[Setting], Cost]] = {
        name: lambda of, k=k: engine_as_peer(of, k) for name, k in ours.items()
    }
    cost: dict[str, Cost] = {}
    missing: dict[str, str] = {}
    for _ in range(2):  # all, and all again: the machine has slower minutes
        for name, run in (runs | PEERS | EQUAL).items():
            began, times = time.perf_counter(), 0
            try:
                while times == 0 or (times < 8 and time.perf_counter() - began < 2):
                    cost[name] = run(setting).least(cost.get(name, Cost(math.inf, math.inf)))
                    times += 1
            except Skip as reason:
                missing[name] = str(reason)[:100]
    print(f"\n{n} agents: {'':12} CPU time, over the floor   wall time (load {load_now()})")
    for name, one in cost.items():
        print(
            f"  {name:18} {one.cpu:10.0f} ns {one.cpu / floor:8.2f} "
            f"{one.wall:10.0f} ns {one.wall / floor:8.2f}"
        )
    for name, why in missing.items():
        print(f"  {name:18} left out: {why}", flush=True)
    verdicts: Verdicts = []
    masters = [name for name in EQUAL if name in cost and name != "FMPy loop, equal"]
    for kind, who in (("cpu", 1), ("wall", 1), ("wall", 2)):
        value = {name: getattr(one, kind) for name, one in cost.items()}
        mine = value[next(name for name, k in ours.items() if k == who)]
        time_of = {"cpu": "CPU time", "wall": "wall time"}[kind]
        what = f"N = {n}, {time_of}, {who} thread{'s' * (who > 1)}: engine ahead of"
        if masters:
            name = min(masters, key=value.__getitem__)
            verdicts.append(
                (f"{what} {name.removesuffix(', equal')}", value[name] / mine, 8.0, False)
            )
        plain = value["FMPy loop, equal"]
        verdicts.append((f"{what} the plain FMPy loop", plain / mine, 200.0, False))
    alone = min(cost[name].cpu for name in PEERS if name in cost)
    print(
        f"  the best peer that steps the plants alone takes {alone / floor:.1f} floors of CPU "
        "time: no master can be further ahead of it"
    )
    return verdicts


def load_now() -> str:
    return f"{os.getloadavg()[0]:.1f}, {os.cpu_count()} processors"


if __name__ == "__main__":
    main()
