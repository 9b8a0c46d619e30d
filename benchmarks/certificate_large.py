"""One certificate for 100 000 agents with 5 arcs each, against the same proof agent by agent.

python benchmarks/certificate_large.py [agents]
"""

from __future__ import annotations

import resource
import sys
import time

import numpy as np
import scipy.sparse as sp

from posmas_fmi.agent import linear_agent
from posmas_fmi.design import DesignSettings, certify
from posmas_fmi.network import Network


def random_network(agents: int, arcs: int = 5, seed: int = 0) -> Network:
    """Digraph in which every agent hears `arcs` others at random; one agent in 1000 is pinned."""
    rng = np.random.default_rng(seed)
    hearing = np.repeat(np.arange(agents), arcs)
    heard = (hearing + rng.integers(1, agents, arcs * agents)) % agents
    adjacency = sp.csr_array((np.ones(len(hearing)), (hearing, heard)), shape=(agents, agents))
    adjacency.sum_duplicates()
    adjacency.data[:] = 1.0
    pinning = np.zeros(agents)
    pinning[:: max(1, min(1000, agents // 2))] = 1.0
    return Network(adjacency, pinning)


def timed(agents: int) -> tuple[float, float, str]:
    """Seconds of one certificate, of the wall and of the processor, and its verdict."""
    agent = linear_agent([[-0.2, 0.1], [0.1, -0.3]], [[1.0], [0.5]], np.eye(2), (0.9, 1.2))
    network = random_network(agents)
    K, E = np.array([[-0.005, -0.005]]), np.array([[0.05, 0.02], [0.02, 0.05]])
    begin, used = time.perf_counter(), time.process_time()
    made = certify(agent, network, K, E, DesignSettings(), 0.1)
    seconds, busy = time.perf_counter() - begin, time.process_time() - used
    return seconds, busy, made.certificate.certified


def dense(agents: int) -> float:
    """Seconds of the naive way: spectral radius of the whole sampled loop, which is no proof."""
    from scipy.linalg import expm

    A, B = np.array([[-0.2, 0.1], [0.1, -0.3]]), np.array([[1.0], [0.5]])
    K, h = np.array([[-0.005, -0.005]]), 0.1
    network = random_network(agents)
    begin = time.perf_counter()
    W = expm(np.block([[A, np.eye(2)], [np.zeros((2, 4))]]) * h)
    L_p = network.pinned_laplacian.toarray()
    step = np.kron(np.eye(agents), W[:2, :2]) + 0.9 * np.kron(L_p, W[:2, 2:] @ B @ K)
    np.abs(np.linalg.eigvals(step)).max()
    return time.perf_counter() - begin


if __name__ == "__main__":
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 100_000
    small = 500
    timed(100)  # imports
    seconds, busy, verdict = timed(count)
    quick, _, _ = timed(small)
    naive = dense(small)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(
        f"certificate of {count} agents: {seconds:.2f} s ({busy:.2f} s of processor), "
        f"{memory:.2f} GB, certified: {verdict}"
    )
    print(f"at {small} agents: {quick * 1e3:.0f} ms, dense eigenvalues {naive * 1e3:.0f} ms")
    print(f"ratio at {small} agents (naive / certificate): {naive / quick:.1f}")
