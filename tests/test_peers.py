"""The closed loop in other masters agrees with ours, within the semantics that they document."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import peers
import pytest

from posmas_fmi.cosim.channel import Channel
from posmas_fmi.cosim.clock import Clock
from posmas_fmi.cosim.fmu_plant import FmuPlant, PlantSpec, PortMap
from posmas_fmi.cosim.law import ProtocolLaw
from posmas_fmi.cosim.master import System, simulate
from posmas_fmi.network import network_from_arcs
from posmas_fmi.protocol import make_protocol
from posmas_fmi.scenario.build import load

H, STEPS, N = 0.005, 400, 4
X0 = np.random.default_rng(1).uniform(0, 2, (N, 2))


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("peers")


def system(late: float = 0.0) -> System:
    """Messages take so long [s]."""
    agent = load("paper_example_1_tanh").agent
    network = network_from_arcs(N, [(1, 2), (2, 3), (3, 4), (1, 3), (4, 1)], [1, 3])
    protocol = make_protocol(network, [[-0.57, -0.58]], [[5.0, 2.5], [1.0, 4.0]], phi=0.3)
    return System(
        agent,
        network,
        ProtocolLaw(agent, protocol),
        Channel.uniform(network.adjacency.nnz + len(network.pinned), H, delay=late),
        Clock.of(STEPS * H, H),
        np.zeros((N, 2)),
        np.array([1.0, 1.0]),
    )


class Blind:
    """Plants that show 0 at first: no output has been passed on yet."""

    def __init__(self, plant: FmuPlant) -> None:
        self._plant = plant

    def __getattr__(self, name: str) -> Any:
        return getattr(self._plant, name)

    def read(self, which: Any, time: float, readings: np.ndarray) -> None:
        self._plant.read(which, time, readings)
        if time == 0:
            readings.reshape(N, -1)[:, :2] = 0.0


def ours(cache: Path, of: System, blind: bool = False) -> dict[str, np.ndarray]:
    """The run by our master, each variable (STEPS + 1, N, …)."""
    path = next(iter(peers.plants_alone(of, X0, cache).fmus.values()))
    specs = [PlantSpec(path, v) for v in peers.plants_alone(of, X0, cache).values.values()]
    ports = [PortMap.plain([f"{v}[{k + 1}]" for k in range(n)]) for v, n in (("u", 1), ("y", 2))]
    rows: dict[str, list[np.ndarray]] = {"y": [], "u": [], "xhat": [], "s": []}

    def record(_: float, values: dict[str, np.ndarray]) -> None:
        for name, kept in rows.items():
            kept.append(values[name].copy())

    with FmuPlant.of_agents(of.network.names, specs, *ports, None, STEPS * H) as plant:
        outcome = simulate(of, Blind(plant) if blind else plant, record)  # type: ignore[arg-type]
    assert outcome.ended == "complete", outcome.reason
    return {name: np.array(kept) for name, kept in rows.items()}


def theirs(run: Callable[..., Any], cache: Path) -> dict[str, np.ndarray]:
    """The run by a peer, read after every step, each variable (STEPS, N, …)."""
    loop = peers.closed_loop(system(), X0, cache)
    rows: dict[str, list[Any]] = {"y": [], "u": [], "xhat": []}
    try:
        with run(loop, observe=True) as peer:
            for _ in range(STEPS):
                peer.advance(1)
                for name, kind, count in (("y", "p", 2), ("u", "c", 1), ("xhat", "c", 2)):
                    values = [
                        [peer.read(one, f"{name}[{k + 1}]") for k in range(count)]
                        for one in loop.of(kind)
                    ]
                    rows[name].append(values)
    except peers.Skip as reason:
        pytest.skip(f"not installed: {reason}")
    return {name: np.array(kept) for name, kept in rows.items()}


def differences(peer: dict[str, np.ndarray], own: dict[str, np.ndarray]) -> float:
    """Largest one over the points after each step."""
    return max(np.abs(peer[name] - own[name][1:]).max() for name in ("y", "xhat", "u"))


@pytest.mark.parametrize("run", [peers.libcosim, peers.ecos], ids=["libcosimpy", "ecospy"])
def test_a_master_of_connected_fmus_agrees(run: Callable[..., Any], cache: Path) -> None:
    peer = theirs(run, cache)
    assert differences(peer, ours(cache, system(late=H))) < 1e-9
    # without the period that messages take between FMUs it is another run
    assert differences(peer, ours(cache, system())) > 1e-4


def test_fmpy_ssp_agrees(cache: Path) -> None:
    # in its first step all that is connected is 0: y, the estimates, and the leader as well
    of = system(late=H)
    loop = peers.closed_loop(system(), X0, cache)
    unheard = {  # nor does a controller know of the leader before
        name: {key: 0.0 if key.startswith("s[") else value for key, value in values.items()}
        for name, values in loop.values.items()
    }
    rows = peers.fmpy_ssp(attrs.evolve(loop, values=unheard), STEPS)
    assert len(rows) == STEPS

    def of_all(kind: str, name: str, count: int) -> np.ndarray:
        columns = [[f"{kind}{i:05}.{name}[{k + 1}]" for k in range(count)] for i in range(N)]
        return np.array([[rows[one] for one in agent] for agent in columns]).transpose(2, 0, 1)

    peer = {"y": of_all("p", "y", 2), "u": of_all("c", "u", 1), "xhat": of_all("c", "sent", 2)}
    s1 = of.law.leader_step(0.0, H, of.s0)
    blind = attrs.evolve(of, s0=np.zeros(2), leader_changes=((1, s1),))
    assert differences(peer, ours(cache, blind, blind=True)) < 1e-9
    assert differences(peer, ours(cache, of)) > 1e-4
