"""Figures of a row of cooling lines, side by side in one run.

python benchmarks/cooling.py [PART]... [DAY]

DAY: a CSV of heat loads (Frontier, 25 units) to use beside the generated day. Lines and header are
FMUs, run by the engine. Gains are those of the design for the network and period at hand.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from posmas_fmi.agent import Agent
from posmas_fmi.cooling import (
    LineParameters,
    Loads,
    controller,
    generate_loads,
    line_agent,
    read_loads,
    training_loads,
)
from posmas_fmi.cooling.law import team_network
from posmas_fmi.cooling.mpc import PredictiveLaw
from posmas_fmi.cooling.row import Row, RowResult, simulate_row
from posmas_fmi.design import Design, DesignSettings, design
from posmas_fmi.network import Network, network_from_arcs
from posmas_fmi.scenario.cooling import INTEGRAL_TIME

SHELL = ("set_point_at", "set_point_after", "feedforward_time")
UNEQUAL = np.linspace(40e3, 130e3, 8)
# what a prototype of the physics gave: RMS, worst upwards, spread at the end [K], strokes per 2 h
PROTOTYPE = {
    "fixed": (2.26, 3.65, 6.31, 0.0),
    "printed": (1.34, 1.00, 3.09, 2.8),
    "proportional": (0.91, 0.80, 1.77, 3.0),
    "integral": (0.15, 0.61, 0.09, 2.3),
    "integral_ff": None,
    "set_point": (0.25, 0.74, 0.17, 9.7),
    "pi": (0.09, 0.74, 0.13, 9.8),
    "pinned_pi": (1.94, 3.65, 5.70, None),
    "team": None,
}


def ring(n: int, pins: list[int], weight: float = 1.0) -> Network:
    """Every line hears the two before it."""
    arcs = [(i, (i + hop - 1) % n + 1) for hop in (1, 2) for i in range(1, n + 1)]
    network = network_from_arcs(n, arcs, pins)
    return attrs.evolve(network, pinning=weight * network.pinning)


def gains(made: Design) -> dict[str, Any]:
    """Gains of a design, as a scenario takes them."""
    K = made.phi * made.K[0]
    return {"K": K, "E": made.E, "K_q": float(K.sum()) / INTEGRAL_TIME}


def run(name: str, made: Design, loads: Loads, until: float, **changes: Any) -> RowResult:
    """Run one controller."""
    shell = {k: changes.pop(k) for k in SHELL if k in changes}
    row = Row(made.network, loads, controller(name, **gains(made), **shell), until, **changes)
    if name == "team":
        teams = team_network(made.network.N)
        row = attrs.evolve(row, network=teams)
    return simulate_row(row)


def ranking(agent: Agent) -> None:
    """Eight lines, unequal loads, then the set-point 1 K higher; delay 5 s."""
    print("\n1. Ranking: loads to 40 … 130 kW at 600 s, set-point + 1 K at 3600 s (prototype)")
    made = design(agent, ring(8, [1]), DesignSettings(), 5.0)
    loads = Loads([0.0, 600.0], [np.full(8, 80e3), UNEQUAL])
    print(
        f"   {'':13}{'RMS K':>16}{'worst up K':>16}{'spread end K':>16}{'strokes/2 h':>16}"
        "  lowest θ K"
    )
    for name, before in PROTOTYPE.items():
        result = run(name, made, loads, 7200.0, delay=5.0, set_point_at=3600.0,
                     set_point_after=agent_line.theta_s0 + 1)  # fmt: skip
        f = result.figures()
        ours = (f.rms, f.over, f.spread_end, 2 * (f.strokes_per_hour or 0.0))
        cells = [
            f"{a:.2f}" + (f" ({b:.2f})" if b is not None else "")
            for a, b in zip(ours, before or (None,) * 4, strict=True)
        ]
        print(f"   {name:13}" + "".join(f"{cell:>16}" for cell in cells) + f"{f.lowest:9.2f}")
        if name in ("printed", "proportional"):
            after, before = result.time >= 6600, (result.time > 3000) & (result.time < 3600)
            moved = float(result.supply[after, 0].mean() - result.supply[before, 0].mean())
            print(f"   {'':13}the pinned line moved by {moved:+.2f} K for + 1 K of the set-point")


def shortage(agent: Agent) -> None:
    """Too little water, loads 1.4 times as high, weak pin."""
    print("\n2. Shortage: Rh = 3, loads to 1.4 x 40 … 130 kW, pin 0.3")
    made = design(agent, ring(8, [1], 0.3), DesignSettings(), 5.0)
    loads = Loads([0.0, 600.0], [np.full(8, 80e3), 1.4 * UNEQUAL])
    base = None
    for name in ("pi", "pi_ff", "integral", "integral_ff", "set_point", "mpc"):
        if name == "mpc":
            law = PredictiveLaw(agent_line, made.network, shortage=3.0)
            f = simulate_row(Row(made.network, loads, law, 7200.0, shortage=3.0)).figures()
        else:
            f = run(name, made, loads, 7200.0, delay=5.0, shortage=3.0).figures()
        base = base or f
        print(
            f"   {name:13}worst {f.worst:5.2f} K ({f.worst / base.worst - 1:+.0%})   "
            f"spread {f.spread:5.2f} K ({f.spread / base.spread - 1:+.0%})   at the end "
            f"{f.spread_end:5.2f} K ({f.spread_end / base.spread_end - 1:+.0%})   hottest case "
            f"{(f.hottest_case or 0) - (base.hottest_case or 0):+.1f} K   lowest θ {f.lowest:.2f} K"
        )


def days(agent: Agent, path: Path | None) -> None:
    """A day that all lines share."""
    days: dict[str, Loads] = {
        f"generated, seed {s}": generate_loads(8, 86400.0, seed=s) for s in (1, 2, 3)
    }
    if path is not None:
        real = read_loads(path)
        power = real.power[:, :8]
        days["real day"] = Loads(real.time - real.time[0], power * 130e3 / power.max())
    for text, loads in days.items():
        print(f"\n3. Common-mode day ({text}), 8 lines, RMS deviation [K], strokes per hour")
        until = 5.0 * int(min(loads.time[-1], 86400.0) / 5)
        for pins in ([1], [1, 5], list(range(1, 9))):
            made = design(agent, ring(8, pins), DesignSettings(), 5.0)
            cells = []
            names = (
                ("pi", "pi_ff", "integral", "integral_ff") if len(pins) == 1 else ("integral_ff",)
            )
            for name in names:
                f = run(name, made, loads, until, delay=5.0).figures()
                cells.append(f"{name} {f.rms:.3f} ({f.strokes_per_hour:.1f}, worst {f.worst:.2f})")
            print(f"   {len(pins)} pinned: " + "   ".join(cells))


def filters(agent: Agent) -> None:
    """AI training: what the filter of the feedforward costs and saves."""
    print("\n4. Filter of the feedforward, AI training, 2 h: RMS [K], worst [K], strokes per hour")
    made = design(agent, ring(8, [1]), DesignSettings(), 5.0)
    kinds = {"mean power of a period": 5.0, "power of a moment": 0.1}
    for text, step in kinds.items():
        loads = training_loads(8, 7200.0, seed=1, maximum=120e3, step=step)
        for seconds in (5.0, None, 30.0, 60.0):
            cells = []
            for name in ("pi", "pi_ff", "integral_ff"):
                f = run(name, made, loads, 7200.0, delay=5.0, feedforward_time=seconds).figures()
                cells.append(f"{name} {f.rms:.3f}, {f.worst:.2f}, {f.strokes_per_hour:.1f}")
            print(f"   {text}, {seconds or 'default'} s: " + "   ".join(cells))


def periods(agent: Agent) -> None:
    """Longer periods: with the gains for 5 s, and with those designed for the period."""
    print("\n5. Period: RMS deviation [K] of `integral`, ranking case without the set-point step")
    loads = Loads([0.0, 600.0], [np.full(8, 80e3), UNEQUAL])
    network = ring(8, [1])
    five = design(agent, network, DesignSettings(), 5.0)
    for h in (5.0, 10.0, 15.0, 30.0, 60.0):
        own = design(agent, network, DesignSettings(), h)
        mixed = attrs.evolve(five, E=own.E)
        cells = []
        for text, made in (("K, E of 5 s", five), ("K of 5 s, own E", mixed), ("own K, E", own)):
            f = run("integral", made, loads, 7200.0, period=h, delay=h).figures()
            rho = max(abs(np.linalg.eigvals(observer_step(agent, made.E, h))))
            cells.append(f"{text}: {f.rms:6.3f} (observer {rho:.2f})")
        print(f"   {h:4.0f} s, own design {own.certificate.certified}: " + "   ".join(cells))


def observer_step(agent: Agent, E: Any, h: float) -> Any:
    """Matrix of the estimation error over one period, the innovation held: stable below 1."""
    from scipy.linalg import expm

    A = agent_line.A(agent_line.kappa0, agent_line.P0)
    both = expm(h * np.block([[A, np.eye(3)], [np.zeros((3, 6))]]))
    return both[:3, :3] - both[:3, 3:] @ E @ agent.C


def thousand(agent: Agent) -> None:
    """A thousand lines for two hours."""
    print("\n6. 1000 lines, every eighth pinned, 2 h at 5 s")
    network = ring(1000, list(range(1, 1001, 8)))
    began = time.perf_counter()
    made = design(agent, network, DesignSettings(), 5.0)
    print(
        f"   design {time.perf_counter() - began:.1f} s, certified: {made.certificate.certified}, "
        f"rate {made.certificate.rate:.4f} 1/s"
    )
    loads = generate_loads(1000, 7200.0, seed=1)
    began, cpu = time.perf_counter(), time.process_time()
    result = run("integral_ff", made, loads, 7200.0, delay=5.0)
    wall, cpu = time.perf_counter() - began, time.process_time() - cpu
    f = result.figures()
    print(
        f"   run {wall:.1f} s ({cpu:.1f} s of processor time), {7200 / wall:.0f} times as fast as "
        f"the plant; RMS {f.rms:.2f} K, lowest θ {f.lowest:.2f} K"
    )


agent_line = LineParameters()


def main() -> None:
    """Print all figures, or those that are named."""
    agent = line_agent(agent_line)
    names = [word for word in sys.argv[1:] if word in PARTS]
    files = [Path(word) for word in sys.argv[1:] if word not in PARTS]
    for name in names or PARTS:
        if name == "days":
            days(agent, files[0] if files else None)
        else:
            PARTS[name](agent)


PARTS: dict[str, Callable[..., None]] = {
    "ranking": ranking,
    "shortage": shortage,
    "days": days,
    "filters": filters,
    "periods": periods,
    "thousand": thousand,
}

if __name__ == "__main__":
    main()
