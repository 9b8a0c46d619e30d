"""What a worker process costs per communication step, against the same FMUs in this process.

    python benchmarks/isolation.py [--steps 20000] [--repeats 5]

Both run in turn in one process, with the engine in C; the smallest time of each counts. The FMU is
tests/faulty.c without a fault, whose steps cost nothing, or about 100 microseconds each.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # idle BLAS threads spin on a processor

import argparse
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from faulty import faulty_fmu, faulty_plant, faulty_system, values

from posmas_fmi.cosim import engine
from posmas_fmi.cosim.fmu_plant import Isolation

HERE, APART = Isolation("none"), Isolation("process")


def seconds(fmu: Path, n: int, steps: int, cost: float, isolation: Isolation) -> float:
    """Return the time of one run [s], without loading."""
    system = faulty_system(n, until=0.05 * steps)
    same = {k: values(at=1e9, cost=cost) for k in range(n)}
    choice = engine.choose(system.law, "c")
    with faulty_plant(fmu, same, isolation, n) as plant:
        began = time.perf_counter()
        outcome = engine.run(system, plant, choice=choice)
        took = time.perf_counter() - began
    assert outcome.ended == "complete", outcome.reason
    return took


def main() -> None:
    """Print a row for each number of workers and each cost of a step."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=20000)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        fmu = faulty_fmu(Path(folder))
        rate = seconds(fmu, 1, 2000, 1e5, HERE) / 2000 / 1e5  # s for one turn of its loop
        print(
            "agents  workers  step of an FMU   here   apart  [us per step]  ratio  more per worker"
        )
        for n, workers, cost in (
            *((1, 1, 0.0), (9, 1, 0.0), (9, 2, 0.0)),
            *((1, 1, 100.0), (9, 1, 100.0), (9, 2, 100.0)),
        ):
            steps = arguments.steps if not cost else arguments.steps // 10
            turns = cost * 1e-6 / rate
            apart = Isolation("process", workers)
            runs = [
                [seconds(fmu, n, steps, turns, one) for one in (HERE, apart)]
                for _ in range(arguments.repeats)
            ]
            here, there = (min(column) / steps * 1e6 for column in zip(*runs, strict=True))
            more = (there - here) / workers
            print(
                f"{n:6d}  {workers:7d}  {cost:11.0f} us  {here:6.1f}  {there:6.1f}"
                f"{there / here:21.2f}  {more:+12.1f} us"
            )


if __name__ == "__main__":
    main()
