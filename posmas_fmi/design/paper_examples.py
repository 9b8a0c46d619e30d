"""The two examples of the paper: agents, networks, and every number that it prints for them.

The figures with the topologies are not in the text. They are recovered from the printed spectra
(theory.md, section 2), so node labels, and hence which node is "node 1", stay unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import attrs

from posmas_fmi.agent import Agent
from posmas_fmi.expression import VectorFunction
from posmas_fmi.network import Network, network_from_arcs

Rows = tuple[tuple[float, ...], ...]

ARCS_1 = ((2, 1), (3, 1), (4, 2), (1, 3), (2, 3), (1, 4))
_EDGES_2 = ((1, 4), (1, 6), (1, 2), (2, 3), (2, 4), (3, 4), (4, 5), (6, 7), (7, 8), (8, 9))
ARCS_2 = tuple(arc for a, b in _EDGES_2 for arc in ((a, b), (b, a)))
REGION = {"t": (0.0, 10.0), "x1": (0.0, 4.0), "x2": (0.0, 4.0)}
G = {
    "paper": ["x1*sin(0.31*x1*t)", "x2*cos(0.31*x2*t)"],
    "tanh": ["tanh(x1)", "tanh(x2)"],
}


@attrs.frozen
class PrintedDesign:
    """What the paper prints for one algorithm on one example."""

    alpha: float
    E: Rows
    Pi: float  # Π = Pi·I
    K: Rows


@attrs.frozen
class Example:
    """One example with its printed numbers.

    Attributes
    ----------
    name : str
    A, H, B, C : tuple of tuple
    arcs : tuple of (from, to)
        From 1.
    agents : int
    phi, mu, eta, delta, beta : float
    spectrum : tuple of complex
        Printed eigenvalues of L, without the zero of Example 1 that is not printed.
    norm_H : float
        Printed ‖H‖.
    E0, P, Sigma : tuple of tuple
        Step 1 and 2 of the algorithms.
    designs : dict
        Algorithm 1 and 2.
    """

    name: str
    A: Rows
    H: Rows
    B: Rows
    C: Rows
    arcs: Sequence[tuple[int, int]]
    agents: int
    phi: float
    mu: float
    spectrum: tuple[complex, ...]
    norm_H: float
    E0: Rows
    P: Rows
    Sigma: Rows
    designs: dict[Literal[1, 2], PrintedDesign]
    eta: float = 0.6
    delta: float = 0.02
    beta: float = 1.0
    sector: tuple[float, float] = (0.9, 1.2)

    def agent(self, g: Literal["paper", "tanh"] = "paper") -> Agent:
        """Model (1) with the paper's g, or with one that has the claimed Lipschitz bound."""
        return Agent(
            A=self.A,
            H=self.H,
            B=self.B,
            C=self.C,
            g=VectorFunction.parse(G[g], ["t", "x1", "x2"]),
            sec=VectorFunction.parse(["1.2*u1 - 0.3*u1*abs(sin(u1))"], ["u1"]),
            sector=self.sector,
            lipschitz=self.beta,
            region=REGION,
        )

    def network(self, *pinned: int) -> Network:
        """Return the recovered digraph, pinned at agents counted from 1."""
        return network_from_arcs(self.agents, self.arcs, pinned)


EXAMPLE_1 = Example(
    name="Example 1",
    A=((-10.18, 9.98), (10.3, -9.84)),
    H=((0.698, -0.26), (0.682, -0.34)),
    B=((0.7,), (0.7,)),
    C=((0.7, -0.3), (0.1, 0.6)),
    arcs=ARCS_1,
    agents=4,
    phi=10.0,
    mu=15.0,
    spectrum=(3.0, 1.5 + 0.8660j, 1.5 - 0.8660j),
    norm_H=1.0641,
    E0=((17.1333, 21.8667), (12.3644, -3.5511)),
    P=((0.0219, 0.0112), (0.0112, 0.1357)),
    Sigma=((-0.0215, -0.0004), (-0.0004, -0.0198)),
    designs={
        1: PrintedDesign(
            -19.026, ((-0.1724, 3.7982), (3.7982, 3.0183)), 1.05, ((-0.4410, -0.4410),)
        ),
        2: PrintedDesign(
            -12.855, ((-0.0124, 0.0905), (0.0905, 0.0784)), 1.05, ((-0.4410, -0.4410),)
        ),
    },
)

EXAMPLE_2 = Example(
    name="Example 2",
    A=((-13.23, 8.72), (9.41, -11.35)),
    H=((0.853, -0.35), (0.841, -0.44)),
    B=((0.82,), (0.82,)),
    C=((0.8, -0.4), (0.2, 0.5)),
    arcs=ARCS_2,
    agents=9,
    phi=30.0,
    mu=410.0,
    spectrum=(0.0, 0.1719, 0.8359, 1.1134, 2.0, 2.8347, 3.5362, 4.3729, 5.1352),
    norm_H=1.3218,
    E0=((8.7937, 20.4750), (10.7813, -6.0750)),
    P=((0.0219, 0.0113), (0.0113, 0.1357)),
    Sigma=((-0.0207, -0.0022), (-0.0022, -0.0080)),
    designs={
        1: PrintedDesign(
            -20.632, ((-0.1345, 2.3014), (2.3014, 2.6486)), 0.85, ((-0.4182, -0.4182),)
        ),
        2: PrintedDesign(
            -20.525, ((-0.0005, 0.0019), (0.0019, 0.0041)), 1.20, ((-0.5904, -0.5904),)
        ),
    },
)

EXAMPLES = (EXAMPLE_1, EXAMPLE_2)
