"""The two examples of the paper as objects, for tests."""

from __future__ import annotations

from posmas_fmi.agent import Agent, state_names
from posmas_fmi.expression import VectorFunction
from posmas_fmi.network import Network, network_from_arcs

SEC = ("1.2*u1 - 0.3*u1*abs(sin(u1))",)
G = ("x1*sin(0.31*x1*t)", "x2*cos(0.31*x2*t)")
TANH = ("tanh(x1)", "tanh(x2)")
MATRICES = {
    1: {
        "A": [[-10.18, 9.98], [10.3, -9.84]],
        "H": [[0.698, -0.26], [0.682, -0.34]],
        "B": [[0.7], [0.7]],
        "C": [[0.7, -0.3], [0.1, 0.6]],
    },
    2: {
        "A": [[-13.23, 8.72], [9.41, -11.35]],
        "H": [[0.853, -0.35], [0.841, -0.44]],
        "B": [[0.82], [0.82]],
        "C": [[0.8, -0.4], [0.2, 0.5]],
    },
}
REGION = {"t": (0.0, 10.0), "x1": (0.0, 4.0), "x2": (0.0, 4.0)}
ARCS_1 = [(2, 1), (3, 1), (4, 2), (1, 3), (2, 3), (1, 4)]
EDGES_2 = [(1, 4), (1, 6), (1, 2), (2, 3), (2, 4), (3, 4), (4, 5), (6, 7), (7, 8), (8, 9)]

# printed gains: (K, E) by example and algorithm
PRINTED = {
    (1, 1): ([[-0.4410, -0.4410]], [[-0.1724, 3.7982], [3.7982, 3.0183]]),
    (1, 2): ([[-0.4410, -0.4410]], [[-0.0124, 0.0905], [0.0905, 0.0784]]),
    (2, 1): ([[-0.4182, -0.4182]], [[-0.1345, 2.3014], [2.3014, 2.6486]]),
    (2, 2): ([[-0.5904, -0.5904]], [[-0.0005, 0.0019], [0.0019, 0.0041]]),
}
PHI = {1: 10.0, 2: 30.0}
MU = {1: 15.0, 2: 410.0}


def agent(example: int, g: tuple[str, ...] = G) -> Agent:
    return Agent(
        **MATRICES[example],
        g=VectorFunction.parse(g, state_names(2)),
        sec=VectorFunction.parse(SEC, ["u1"]),
        sector=(0.9, 1.2),
        lipschitz=1.0,
        region=REGION,
    )


def network(example: int, pinned: int | None = None) -> Network:
    if example == 1:
        return network_from_arcs(4, ARCS_1, pinned=[pinned or 2])
    both = EDGES_2 + [(b, a) for a, b in EDGES_2]
    return network_from_arcs(9, both, pinned=[pinned or 1])
