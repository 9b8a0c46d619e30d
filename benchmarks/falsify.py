"""The falsifier's long search: the certified design of a shipped scenario, and a printed one.

python benchmarks/falsify.py [--draws N] [--seed N] [--periods N]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np

from posmas_fmi.certify import Loop
from posmas_fmi.certify.falsify import Falsification, falsify, falsify_networks
from posmas_fmi.design.paper_examples import EXAMPLE_1
from posmas_fmi.scenario import load
from posmas_fmi.scenario.job import make_design_of

SEARCHES = (falsify, falsify_networks)


def certified() -> Loop:
    """Return the loop of the shipped Example 1 whose g has the declared bound."""
    scenario = load("paper_example_1_tanh")
    made = make_design_of(scenario)
    print(f"certified: {made.certificate.certified}, rate {made.certificate.rate:.6g} 1/s")
    return Loop(
        scenario.agent, made.network, made.K, made.E, phi=made.phi, mu=made.mu,
        observer=made.observer, protocol=made.protocol, period=made.certificate.period,
    )  # fmt: skip


def printed() -> Loop:
    """Return Algorithm 1 of Example 1, gains and signs as printed."""
    example = EXAMPLE_1
    return Loop(
        example.agent("tanh"),
        example.network(2),
        np.array(example.designs[1].K),
        np.array(example.designs[1].E),
        phi=example.phi,
        protocol="printed",
        period=0.005,
    )


def report(
    name: str, loop: Loop, search: Callable[..., Falsification], draws: int, options: dict[str, int]
) -> None:
    """Search and print one line, and one more per violation."""
    begin = time.perf_counter()
    found = search(loop, draws=draws, **options)
    seconds = time.perf_counter() - begin
    print(
        f"{name}, {search.__name__}: {draws} draws in {seconds:.1f} s, {draws / seconds:.0f} "
        f"draws/s, {len(found.violations)} violations"
    )
    print(
        f"  least state {found.least_state:.3g}; factor per period {found.worst_factor:.9g} "
        f"(claimed {found.claimed_factor}), observer {found.worst_observer_factor:.9g} "
        f"(claimed {found.claimed_observer_factor})"
    )
    for text in found.violations:
        print(f"  {text}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--periods", type=int, default=40)
    given = parser.parse_args()
    options = {"seed": given.seed, "periods": given.periods}
    for search in SEARCHES:
        report("printed", printed(), search, min(given.draws, 200), options)
    loop = certified()
    for search in SEARCHES:
        report("certified", loop, search, given.draws, options)
