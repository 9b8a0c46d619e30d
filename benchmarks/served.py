"""Cost of FMUs whose calls go through Python, relative to the same FMU called from C.

    python benchmarks/served.py [--steps 2000] [--agents 20]

Prints the time of a communication step per agent: with the calls from C, with the same calls
through Python (as for ports that are no doubles), and with the FMU integrated by LSODA (as for
FMUs that are for Model Exchange only). The FMU is model (1) of the first example.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from unittest import mock

import numpy as np

from posmas_fmi import load
from posmas_fmi.cosim import fmu_plant, fmus
from posmas_fmi.cosim.fmu_plant import FmuPlant, PlantSpec, PortMap
from posmas_fmi.fmu.stepped import SteppedFile
from posmas_fmi.scenario.plant import fmu_files


def measure(path: Path, values: dict[str, object], agents: int, steps: int, h: float) -> float:
    """Return seconds per agent and step; the inputs change at each."""
    ports = PortMap.plain(("u[1]",)), PortMap.plain(("y[1]", "y[2]", "x[1]", "x[2]"))
    specs = [PlantSpec(path, values, str(k), *ports) for k in range(agents)]
    which, readings = np.arange(agents), np.zeros(4 * agents)
    with FmuPlant(specs, True, 1e9) as plant:
        begin = time.perf_counter()
        for k in range(steps):
            inputs = np.full(agents, np.sin(0.1 * k))
            plant.step(which, np.full(agents, k * h), np.full(agents, h), inputs, readings)
            plant.read(which, (k + 1) * h, readings)
        return (time.perf_counter() - begin) / (agents * steps)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--agents", type=int, default=20)
    given = parser.parse_args()
    scenario = load("paper_example_1")
    path, agent, h = fmu_files(scenario)[0], scenario.agent, scenario.clock.h
    values = {"A": agent.A, "H": agent.H, "B": agent.B, "C": agent.C, "x": scenario.x0[0]}

    def one(steps: int) -> float:
        return measure(path, values, given.agents, steps, h)

    in_c = one(given.steps)
    with mock.patch.object(fmus, "needs_python", return_value=True):
        through_python = one(given.steps)
    with mock.patch.object(
        fmu_plant, "open_fmu", lambda path, *given, **more: SteppedFile(path, *given, **more)
    ):
        integrated = one(max(given.steps // 20, 1))
    for name, found in (
        ("calls from C", in_c),
        ("calls through Python", through_python),
        ("integrated by LSODA", integrated),
    ):
        print(f"{name:22} {1e6 * found:9.1f} µs per agent and step {found / in_c:8.1f} ×")


if __name__ == "__main__":
    main()
