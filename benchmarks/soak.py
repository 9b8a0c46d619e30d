"""A day of plant time with nine agents, faults and restarts: what is held, and what is left.

    python benchmarks/soak.py [--hours 24] [--rounds 24]

The run is made in rounds of equal length, each with fresh worker processes. In each, one worker is
killed and one is stopped for good, so that it does not answer: all instances in it are brought back
from their snapshots. Besides, sensors are biased, stuck and noisy, an actuator is slow and messages
are lost, each for a tenth of the round. After each round the memory of this process, its
descriptors, children, temporary folders and mapped FMUs are counted.
"""

from __future__ import annotations

import argparse
import gc
import os
import signal
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import numpy as np
from faulty import faulty_fmu, faulty_plant, faulty_system

from posmas_fmi.cosim import engine
from posmas_fmi.cosim.conditions import Episode
from posmas_fmi.cosim.fmu_plant import FmuPlant, Isolation
from posmas_fmi.cosim.master import Progress
from posmas_fmi.cosim.worker.minder import resident
from posmas_fmi.cosim.worker.process import Patience

AGENTS = 9


def held() -> tuple[float, int, int, int, int]:
    """Return memory [MiB], descriptors, children, temporary folders and mapped FMUs."""
    gc.collect()
    children = Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
    folders = list(Path(tempfile.gettempdir()).glob("posmas-fmi-*"))
    maps = Path("/proc/self/maps").read_text().count("faulty")
    return (
        resident() / 2**20,
        len(os.listdir("/proc/self/fd")),
        len(children),
        len(folders),
        maps,
    )


def strikes(plant: FmuPlant, steps: int) -> Progress:
    """Return a progress function that kills a worker, and later stops another."""
    blows = [(0.25 * steps, signal.SIGKILL, 2), (0.6 * steps, signal.SIGSTOP, 7)]

    def strike(k: int, _: int) -> None:
        if blows and k >= blows[0][0]:
            _, blow, agent = blows.pop(0)
            os.kill(plant._instances[agent].worker.pid, blow)

    return strike


def faults(steps: int) -> tuple[Episode, ...]:
    """Return faults, each for a tenth of a round."""
    arcs = np.arange(AGENTS)
    what = [
        ("sensor_offset", (2, 0), 0.1),
        ("sensor_gain", (4, 0), 0.0),
        ("sensor_noise", (6, 0), 0.05),
        ("actuator_gain", (1, 0), 0.2),
        ("loss", arcs, 0.5),
    ]
    tenth = steps // 10
    return tuple(
        Episode(kind, index, value, k * 2 * tenth, (k * 2 + 1) * tenth)
        for k, (kind, index, value) in enumerate(what)
    )


def main() -> None:
    """Print a row after each round."""
    import logging

    logging.disable(logging.WARNING)  # each restart is told
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--rounds", type=int, default=24)
    arguments = parser.parse_args()
    steps = round(arguments.hours * 3600 / arguments.rounds / 0.05)
    isolation = Isolation("process", 2, "restart", patience=Patience(step=1.0))
    with tempfile.TemporaryDirectory() as folder:
        tempfile.tempdir = folder
        fmu = faulty_fmu(Path(folder))
        system = faulty_system(AGENTS, until=0.05 * steps, episodes=faults(steps))
        choice = engine.choose(system.law, "c")
        print("round  plant h  wall s  MiB  descriptors  children  folders  maps  restarts")
        for number in range(1, arguments.rounds + 1):
            began = time.perf_counter()
            with faulty_plant(fmu, {}, isolation, AGENTS) as plant:
                outcome = engine.run(system, plant, progress=strikes(plant, steps), choice=choice)
            took = time.perf_counter() - began
            assert outcome.ended == "complete", outcome.reason
            restarts = sum(i.action == "restarted" for i in outcome.incidents)
            memory, *counts = held()
            hours = number * arguments.hours / arguments.rounds
            cells = "  ".join(f"{count:8d}" for count in counts)
            print(f"{number:5d}  {hours:7.1f}  {took:6.1f}  {memory:5.1f} {cells}  {restarts:8d}")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
