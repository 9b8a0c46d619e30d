"""Algorithm 1 with the hull reduction, against one cvxpy LMI per agent: same α, how much faster.

The naive way solves one LMI per agent and takes the worst α. A sample of them is timed and scaled,
so that the comparison ends within a minute at any number of agents; `--whole` solves one program
with all LMIs as well. The optimum of the reduced program is checked on every LMI with numpy.

python benchmarks/paper_algorithm.py [agents] [--sample K] [--whole]
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from posmas_fmi.design.paper import Algorithm, active
from posmas_fmi.design.paper_examples import EXAMPLE_2

PI = np.full(2, 0.85)


def algorithm(gamma: np.ndarray, inverse_f: np.ndarray) -> Algorithm:
    """Conditions of Theorem 1 at the given points (γ_i, 1/f_i)."""
    points = tuple((float(g), float(x), 1.0) for g, x in zip(gamma, inverse_f, strict=True))
    return Algorithm(EXAMPLE_2.agent(), points, 1.0, 0.0, EXAMPLE_2.delta)


def largest_eigenvalue(gamma: np.ndarray, inverse_f: np.ndarray, E: np.ndarray) -> float:
    """Largest eigenvalue over the LMIs of all agents at this E and Π: the least α they allow."""
    agent, P = EXAMPLE_2.agent(), np.diag(PI)
    EC, BB = E @ agent.C, agent.B @ agent.B.T
    top = (agent.A + agent.H) @ P + P @ (agent.A + agent.H).T
    side, low = (EC + agent.H) @ P, (agent.A - EC) @ P
    blocks = np.tile(np.block([[top, side], [side.T, low + low.T]]), (len(gamma), 1, 1))
    blocks[:, :2, :2] -= gamma[:, None, None] * BB
    blocks[:, :2, :2] -= EXAMPLE_2.delta * inverse_f[:, None, None] * P @ P
    return float(np.linalg.eigvalsh(blocks).max())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("agents", type=int, nargs="?", default=10_000)
    parser.add_argument("--sample", type=int, default=200)
    parser.add_argument("--whole", action="store_true")
    given = parser.parse_args()
    count, sample = given.agents, min(given.sample, given.agents)
    rng = np.random.default_rng(0)
    f = rng.uniform(0.5, 1.5, count)
    f /= f.sum()
    gamma, inverse = rng.uniform(1.0, 5.0, count), 1 / f
    algorithm(np.array([1.0]), np.array([9.0])).minimise(PI, None, True)  # imports

    begin = time.perf_counter()
    kept = active(gamma, inverse)
    reduction = time.perf_counter() - begin
    alpha, E, _ = algorithm(gamma[kept], inverse[kept]).minimise(PI, None, True)
    fast = time.perf_counter() - begin
    print(f"{count} agents: {len(kept)} LMIs kept in {reduction * 1e3:.1f} ms, {fast:.3f} s in all")
    every = largest_eigenvalue(gamma, inverse, E)
    print(f"alpha {alpha:.9f}; all {count} LMIs at its E: {every:.9f}, {every - alpha:+.1e}")

    begin = time.perf_counter()
    alone = [
        algorithm(gamma[i : i + 1], inverse[i : i + 1]).minimise(PI, None, True)[0]
        for i in rng.choice(count, sample, replace=False)
    ]
    seconds = time.perf_counter() - begin
    naive = seconds * count / sample
    print(
        f"naive: {sample} of {count} solved, scaled: {seconds:.2f} s -> {naive:.1f} s; "
        f"worst alpha among them {max(alone):.9f}"
    )
    print(f"ratio {naive / fast:.0f}")
    if given.whole:
        begin = time.perf_counter()
        full, _, _ = algorithm(gamma, inverse).minimise(PI, None, True)
        slow = time.perf_counter() - begin
        print(f"one program with all: {slow:.1f} s, alpha {full:.9f}, ratio {slow / fast:.0f}")
