"""CPU time per agent and communication step: engine, numpy path and other masters over the floor.

    python benchmarks/engine.py [--agents 9 100 1000] [--repeat 5]

All in one run, 1 ms steps of the paper's Example 1. The floor is a loop in C over the same FMUs
that only sets u, steps and gets y, with the inputs of the controlled run. Engine and numpy path do
all of the master's work besides: observer, protocol, exchange, checks, reading x. The other masters
do less: they step the FMUs without any controller or connection.
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
import zipfile
from collections.abc import Callable
from pathlib import Path

import attrs
import numpy as np

from posmas_fmi.agent import Agent
from posmas_fmi.cosim import engine, native
from posmas_fmi.cosim.channel import Channel
from posmas_fmi.cosim.clock import Clock
from posmas_fmi.cosim.fmu_plant import FmuPlant, PlantSpec, PortMap
from posmas_fmi.cosim.law import ProtocolLaw
from posmas_fmi.cosim.master import System
from posmas_fmi.cosim.propagator import Propagator
from posmas_fmi.fmu.build import agent_fmu, fmu
from posmas_fmi.fmu.compile import find_compiler, host
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.model import Experiment, FmuModel, Variable
from posmas_fmi.network import network_from_arcs
from posmas_fmi.protocol import make_protocol
from posmas_fmi.scenario.build import load

H = 0.001  # s
FLOOR = Path(__file__).parent / "floor.c"


class Skip(Exception):  # noqa: N818
    """Why a peer is left out."""


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
        x0 = np.random.default_rng(1).uniform(0, 2, (self.n, 2))
        given = {} if path else {"A": agent.A, "H": agent.H, "B": agent.B, "C": agent.C}
        specs = [PlantSpec(path or self.fmu, {**given, "x": x}) for x in x0]
        ports = [PortMap.plain([f"{v}[{k + 1}]" for k in range(c)]) for v, c in PORTS]
        return FmuPlant.of_agents(self.network.names, specs, *ports, stop=math.inf)


PORTS = (("u", 1), ("y", 2), ("x", 2))


def per_step(setting: Setting, run: Callable[[], None], clock: Callable = time.process_time):
    began = clock()
    run()
    return (clock() - began) / setting.n / setting.steps * 1e9


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


def floor(setting: Setting, library: ctypes.CDLL, inputs: np.ndarray) -> float:
    pointer, size, word = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int64
    function = library.floor_run
    function.argtypes = [
        *(ctypes.c_int, pointer, pointer, pointer, pointer, word),
        *(pointer, size, size, pointer, size, size, ctypes.c_double, pointer, word, word),
    ]
    function.restype = word
    with FmuFile(setting.fmu) as file:
        instances = []
        for x in np.random.default_rng(1).uniform(0, 2, (setting.n, 2)):
            instances.append(file.instantiate("agent"))
            matrices = {k: getattr(setting.agent, k) for k in "AHBC"}
            instances[-1].initialise({**matrices, "x": x})
        u, y = file.ports(["u"]), file.ports(["y"])
        components = np.array([i.component for i in instances], dtype=np.uintp)
        address = [file.address(f"fmi3{f}") for f in ("SetFloat64", "DoStep", "GetFloat64")]

        def run() -> None:
            bad = function(
                *(3, *address, components.ctypes.data, setting.n),
                *(ctypes.addressof(u.references), 1, u.size),
                *(ctypes.addressof(y.references), 1, y.size),
                *(H, inputs.ctypes.data, 0, setting.steps),
            )
            assert bad == 0

        return per_step(setting, run)


def engine_run(setting: Setting, record: bool = False, which: engine.Wanted = "c") -> float:
    system = setting.system()
    choice = engine.choose(system.law, which)
    with setting.plant() as plant:
        if which == "numpy":
            return per_step(setting, lambda: engine.run(system, plant, choice=choice))
        library = native.load(choice.library)
        one = engine.Engine(system, plant, library, 1, engine.VARIABLES if record else ())
        keep = (lambda *_: None) if record else None
        return per_step(setting, lambda: one.run(keep, None))


def fmpy_loop(setting: Setting, controlled: bool = False) -> float:
    """The loop of FMPy's examples: one slave per agent, values by lists.

    If controlled, each agent has its observer and controller as a few lines of numpy.
    """
    import fmpy
    from fmpy.fmi3 import FMU3Slave

    folder = fmpy.extract(str(setting.fmu))
    description = fmpy.read_model_description(folder)
    reference = {v.name: v.valueReference for v in description.modelVariables}
    identifier = description.coSimulation.modelIdentifier
    slaves = []
    for k in range(setting.n):
        slave = FMU3Slave(
            guid=description.guid,
            unzipDirectory=folder,
            modelIdentifier=identifier,
            instanceName=str(k),
        )
        slave.instantiate()
        slave.enterInitializationMode()
        slave.exitInitializationMode()
        slaves.append(slave)

    system, agent = setting.system(), setting.agent
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

    def run() -> None:
        for k in range(setting.steps):
            for i, slave in enumerate(slaves):
                y = slave.getFloat64([reference["y"]], nValues=2)
                u = control(k * H, i, np.array(y)) if controlled else [0.1]
                slave.setFloat64([reference["u"]], u)
                slave.doStep(currentCommunicationPoint=k * H, communicationStepSize=H)

    return per_step(setting, run)


def fmpy_ssp(setting: Setting) -> float:
    from fmpy.ssp.simulation import simulate_ssp

    if setting.n > 20:
        raise Skip("it starts 100 agents in seconds; its cost per agent stays the same")
    setting = attrs.evolve(setting, steps=10_000 // setting.n)
    path = agent_fmu_2(setting)
    connector = '<Connector name="{}" kind="{}"><ssc:Real/></Connector>'
    ports = (("u[1]", "input"), ("y[1]", "output"), ("y[2]", "output"))
    connectors = "".join(connector.format(*port) for port in ports)
    component = (
        '<Component name="a{}" type="application/x-fmu-sharedlibrary" source="r/a.fmu">'
        f"<Connectors>{connectors}</Connectors></Component>"
    )
    space = "http://ssp-standard.org/SSP1/SystemStructure"
    text = (
        '<?xml version="1.0" encoding="UTF-8"?><SystemStructureDescription version="1.0" name="n" '
        f'xmlns="{space}Description" xmlns:ssc="{space}Common"><System name="s">'
        f"<Elements>{''.join(map(component.format, range(setting.n)))}</Elements></System>"
        "</SystemStructureDescription>"
    )
    with tempfile.TemporaryDirectory() as folder:
        archive = Path(folder, "n.ssp")
        with zipfile.ZipFile(archive, "w") as file:
            file.writestr("SystemStructure.ssd", text)
            file.write(path, "r/a.fmu")

        def run(steps: int) -> float:
            began = time.process_time()
            simulate_ssp(str(archive), stop_time=steps * H, step_size=H)
            return time.process_time() - began

        try:  # what it takes to start is taken off
            return (run(10 + setting.steps) - run(10)) / setting.steps / setting.n * 1e9
        except UnboundLocalError as error:
            raise Skip(f"simulate_ssp fails: {error}") from error


def agent_fmu_2(setting: Setting) -> Path:
    agent = setting.agent
    return agent_fmu(agent.g, agent.sec, agent.m, agent.p, agent.q, 2)


def libcosim(setting: Setting) -> float:
    try:
        from libcosimpy.CosimExecution import CosimExecution
        from libcosimpy.CosimLogging import CosimLogLevel, log_output_level
        from libcosimpy.CosimSlave import CosimLocalSlave
    except (ImportError, OSError) as error:
        raise Skip(str(error)) from error
    log_output_level(CosimLogLevel.FATAL)
    path = str(agent_fmu_2(setting))
    execution = CosimExecution.from_step_size(round(H * 1e9))
    for k in range(setting.n):
        if execution.add_local_slave(CosimLocalSlave(fmu_path=path, instance_name=f"a{k}")) < 0:
            raise Skip(f"it refuses instance {k + 1} of the FMU")
    execution.step()

    def run() -> None:
        if not execution.step(setting.steps):
            raise Skip("its step failed")

    return per_step(setting, run)


def ecos(setting: Setting) -> float:
    try:
        from ecospy import EcosSimulationStructure
    except (ImportError, OSError) as error:
        raise Skip(str(error)) from error
    structure = EcosSimulationStructure()
    for k in range(setting.n):
        structure.add_model(f"a{k}", str(agent_fmu_2(setting)))
    with structure.create_simulation(H) as simulation:
        simulation.init()
        return per_step(setting, lambda: simulation.step(setting.steps))


# ---- threads and start-up ------------------------------------------------------------------------

SLOW_C = """
#include <math.h>
#include "model.h"

void model_derivatives(double t, const double *p, const double *u, const double *x, double *dx)
{
    double sum = 0;
    for (int k = 0; k < 110; k++)
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


def threads(repeat: int) -> None:
    variables = (
        Variable("p", "parameter", (1,), (1.0,)),
        Variable("u", "input", (1,), (0.0,)),
        Variable("x", "state", (2,), (1.0, 1.0)),
        Variable("y", "output", (2,), depends=("x",)),
    )
    path = fmu(FmuModel("slow", "", variables, {"model.c": SLOW_C}, Experiment()))
    setting = Setting.of(100, 200)
    choice = engine.choose(setting.system().law, "c")
    wall: dict[int, float] = {}
    for _ in range(repeat):
        for count in (1, 2):
            with setting.plant(path) as plant:
                one = engine.Engine(setting.system(), plant, native.load(choice.library), count, ())
                took = per_step(setting, lambda one=one: one.run(None, None), time.perf_counter)
                wall[count] = min(wall.get(count, math.inf), took)
    print(
        f"\n{wall[1] / 1000:.1f} us per agent-step on one thread, two are {wall[1] / wall[2]:.2f} "
        f"times as fast (wall time; {os.cpu_count()} processors, load {os.getloadavg()[0]:.1f})"
    )


def start_up(repeat: int) -> None:
    best = {}
    for n in (1, 1000, 10_000):
        setting = Setting.of(n, 1)
        for _ in range(repeat):
            began = time.perf_counter()
            plant = setting.plant()
            best[n] = min(best.get(n, math.inf), time.perf_counter() - began)
            plant.close()
    print(
        f"\nstart-up: first instance {best[1] * 1e3:.1f} ms, 1000 instances "
        f"{(best[1000] - best[1]) * 1e3:.0f} ms more, 10000 {(best[10_000] - best[1]) * 1e3:.0f} ms"
    )


# ---- the table -----------------------------------------------------------------------------------


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--agents", type=int, nargs="+", default=[9, 100, 1000])
    parser.add_argument("--repeat", type=int, default=5)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        library = floor_library(Path(folder))
        for n in options.agents:
            table(n, library, options.repeat)
    threads(options.repeat)
    start_up(options.repeat)


def table(n: int, library: ctypes.CDLL, repeat: int) -> None:
    ours, theirs = Setting.of(n, max(500, 100_000 // n)), Setting.of(n, max(20, 2000 // n))
    inputs = inputs_of(ours)
    fast = {
        "floor": lambda: floor(ours, library, inputs),
        "engine": lambda: engine_run(ours),
        "engine, recording": lambda: engine_run(ours, record=True),
    }
    best = dict.fromkeys(fast, math.inf)
    for _ in range(repeat):
        for name, run in fast.items():
            best[name] = min(best[name], run())
    slow = {
        "numpy path": lambda: engine_run(attrs.evolve(ours, steps=ours.steps // 5), which="numpy"),
        "libcosimpy": lambda: libcosim(theirs),
        "ecospy": lambda: ecos(theirs),
        "fmpy.ssp": lambda: fmpy_ssp(theirs),
        "FMPy loop": lambda: fmpy_loop(theirs),
        "FMPy, controlled": lambda: fmpy_loop(theirs, controlled=True),
    }
    print(f"\n{n} agents, CPU time per agent and step of {H * 1e3:g} ms")
    for name, value in best.items():
        print(f"  {name:18} {value:10.0f} ns {value / best['floor']:8.2f}")
    for name, run in slow.items():
        try:
            value = min(run() for _ in range(2))
        except Skip as reason:
            print(f"  {name:18} left out: {str(reason)[:100]}")
            continue
        print(f"  {name:18} {value:10.0f} ns {value / best['floor']:8.2f}")


if __name__ == "__main__":
    main()
