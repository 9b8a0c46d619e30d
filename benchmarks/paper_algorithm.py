"""Algorithm 1 with the hull reduction, against one cvxpy LMI per agent: same α, how much faster.

python benchmarks/paper_algorithm.py [agents]
"""

from __future__ import annotations

import sys
import time

import numpy as np

from posmas_fmi.design.paper import Algorithm, active
from posmas_fmi.design.paper_examples import EXAMPLE_2


def algorithm(points: list[tuple[float, float, float]]) -> Algorithm:
    """Conditions of Theorem 1 at the given points (γ_i, 1/f_i, 1)."""
    return Algorithm(EXAMPLE_2.agent(), tuple(points), 1.0, 0.0, EXAMPLE_2.delta)


if __name__ == "__main__":
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000
    rng = np.random.default_rng(0)
    f = rng.uniform(0.5, 1.5, count)
    f /= f.sum()
    gamma, inverse = rng.uniform(1.0, 5.0, count), 1 / f
    Pi = np.full(2, 0.85)
    algorithm([(1.0, 9.0, 1.0)]).minimise(Pi, None, True)  # imports

    begin = time.perf_counter()
    kept = active(gamma, inverse)
    reduction = time.perf_counter() - begin
    reduced, *_ = algorithm([(gamma[i], inverse[i], 1.0) for i in kept]).minimise(Pi, None, True)
    fast = time.perf_counter() - begin

    begin = time.perf_counter()
    every = [(g, x, 1.0) for g, x in zip(gamma, inverse, strict=True)]
    full, *_ = algorithm(every).minimise(Pi, None, True)
    slow = time.perf_counter() - begin

    print(f"{count} agents: {len(kept)} LMIs kept in {reduction * 1e3:.1f} ms")
    print(f"alpha {reduced:.9f} reduced, {full:.9f} with all, difference {abs(reduced - full):.1e}")
    print(f"{fast:.3f} s against {slow:.1f} s: ratio {slow / fast:.0f}")
