"""The engine in C against the numpy loop, which defines the semantics."""

from __future__ import annotations

from pathlib import Path

import attrs
import numpy as np
import pytest
from fmu_examples import Example, example_1, named, wide

from posmas_fmi.agent import Agent
from posmas_fmi.cosim import engine
from posmas_fmi.cosim.channel import Channel
from posmas_fmi.cosim.clock import Clock
from posmas_fmi.cosim.fmu_plant import FmuPlant, PlantSpec, PortMap
from posmas_fmi.cosim.master import Outcome, System
from posmas_fmi.cosim.protocol import make_protocol
from posmas_fmi.expression import VectorFunction
from posmas_fmi.network import Network, network_from_arcs

TOLERANCE = 1e-12
GAINS = {  # K and E by the number of states
    2: ([[-0.4, -0.4]], [[5.0, 3.0], [0.5, 4.0]]),
    3: (-0.1 * np.ones((2, 3)), np.ones((3, 1))),
}


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fmus")


def agent_of(example: Example) -> Agent:
    return Agent(A=example.A, H=example.H, B=example.B, C=example.C, g=example.g, sec=example.sec)


def digraph(n: int) -> Network:
    """A ring with short cuts; the first and the middle agent are pinned."""
    arcs = [(i, i % n + 1) for i in range(1, n + 1) if n > 1]
    arcs += [(i, i + 2, 0.5) for i in range(1, n - 1)]
    return network_from_arcs(n, arcs, sorted({1, (n + 1) // 2}))


def linear_saturation() -> Example:
    """Example 1 with a sec that lets errors of rounding grow no faster than the states."""
    return attrs.evolve(
        example_1(),
        g=VectorFunction.parse(["0.5*x1", "tanh(x2)"], ["t", "x1", "x2"]),
        sec=VectorFunction.parse(["u1"], ["u1"]),
    )


@attrs.frozen
class Case:
    """A system with its FMUs."""

    n: int = 4
    example: Example = attrs.field(factory=example_1)
    fmi: int = 3
    observer: str = "local"
    form: str = "corrected"
    h: float = 0.01
    until: float = 1.0
    phi: float = 1.0
    delay: float = 0.0
    jitter: float = 0.0
    loss: float = 0.0
    shows_states: bool = True
    scale: float = 1.0
    offset: float = 0.0

    def system(self) -> System:
        network, m = digraph(self.n), len(self.example.A)
        K, E = GAINS[m]
        arcs = network.adjacency.nnz + len(network.pinned)
        channel = Channel.uniform(arcs, self.h, self.delay, self.jitter, self.loss)
        return System(
            agent_of(self.example),
            network,
            make_protocol(network, K, E, self.phi, 0.5, self.observer, self.form),
            channel,
            Clock.of(self.until, self.h),
            np.random.default_rng(1).uniform(0, 1, (self.n, m)),
            np.linspace(1, 2, m),
            seed=3,
        )

    def plant(self, cache: Path) -> FmuPlant:
        m, p, q = self.example.sizes
        fmu = self.example.fmu(self.fmi, cache)
        x0 = np.random.default_rng(2).uniform(0, 2, (self.n, m))
        specs = [PlantSpec(fmu, named(self.example.matrices | {"x": x}, self.fmi)) for x in x0]
        states = self.ports("x", m) if self.shows_states else None
        names = digraph(self.n).names
        return FmuPlant(names, specs, self.ports("u", p), self.ports("y", q), states, self.until)

    def ports(self, letter: str, count: int) -> PortMap:
        names = tuple(f"{letter}[{k + 1}]" for k in range(count))
        units = (None,) * count
        return PortMap(names, (self.scale,) * count, (self.offset,) * count, units, "")


def run(
    case: Case, cache: Path, which: engine.Wanted, threads: int = 1
) -> tuple[Outcome, dict[str, np.ndarray]]:
    system, rows = case.system(), {}

    def record(times: np.ndarray, values: dict[str, np.ndarray]) -> None:
        for name, value in {"time": times, **values}.items():
            rows.setdefault(name, []).append(value.copy())

    with case.plant(cache) as plant:
        choice = engine.choose(system.agent, which)
        outcome = engine.run(system, plant, record, choice=choice, threads=threads)
    return outcome, {name: np.concatenate(blocks) for name, blocks in rows.items()}


def assert_alike(actual, expected) -> None:
    (outcome, rows), (wanted, wanted_rows) = actual, expected
    assert rows.keys() == wanted_rows.keys()
    for name, value in wanted_rows.items():
        assert rows[name].shape == value.shape, name
        size = np.abs(value).max()
        np.testing.assert_allclose(rows[name], value, rtol=0, atol=TOLERANCE * size, err_msg=name)
    for field in ("ended", "steps", "time", "messages", "lost", "reason", "failed_agent"):
        assert getattr(outcome, field) == getattr(wanted, field), field
    size = max(np.abs(value).max() for value in wanted_rows.values())
    for field in ("tracking_error", "estimation_error", "largest_initial", "min_state"):
        got, value = getattr(outcome, field), getattr(wanted, field)
        np.testing.assert_allclose(got, value, rtol=0, atol=TOLERANCE * size, err_msg=field)
    np.testing.assert_array_equal(outcome.min_time, wanted.min_time)


CASES = {
    "one agent": Case(n=1),
    "four": Case(n=4),
    "nine, FMI 2": Case(n=9, fmi=2),
    "hundred": Case(n=100, until=0.3),
    "distributed": Case(n=9, observer="distributed"),
    "distributed, FMI 2": Case(n=9, observer="distributed", fmi=2),
    "printed": Case(form="printed"),
    "distributed, printed": Case(observer="distributed", form="printed"),
    "delay": Case(n=9, delay=0.03),
    "delay, distributed": Case(n=9, delay=0.05, observer="distributed"),
    "delay longer than the run": Case(delay=2.0),
    "jitter and loss": Case(n=9, delay=0.02, jitter=0.05, loss=0.3, observer="distributed"),
    "all lost": Case(loss=1.0),
    "other sizes": Case(example=wide()),
    "other sizes, FMI 2": Case(example=wide(), fmi=2, observer="distributed"),
    "states not shown": Case(shows_states=False),
    "scaled": Case(scale=4.0, offset=0.25),
    "diverges": Case(example=linear_saturation(), form="printed", phi=20.0, until=5.0),
    "diverges, states not shown": Case(
        example=linear_saturation(), form="printed", phi=20.0, until=5.0, shows_states=False
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_engine_agrees_with_the_numpy_loop(name: str, cache: Path) -> None:
    expected = run(CASES[name], cache, "numpy")
    assert expected[0].ended == ("diverged" if "diverges" in name else "complete")
    assert_alike(run(CASES[name], cache, "c"), expected)


def test_both_see_example_1_diverge(cache: Path) -> None:
    # its sec contains sin(u): once u is large, errors of rounding decide about its value
    case = Case(form="printed", phi=20.0, until=5.0)
    (expected, rows), (actual, actual_rows) = (run(case, cache, e) for e in ("numpy", "c"))
    assert expected.ended == actual.ended == "diverged"
    assert abs(expected.steps - actual.steps) <= 5
    np.testing.assert_allclose(actual_rows["x"][:20], rows["x"][:20], rtol=1e-12)


@pytest.mark.parametrize("name", ["nine, FMI 2", "jitter and loss", "diverges", "hundred"])
@pytest.mark.parametrize("threads", [2, 3])
def test_threads_do_not_change_a_bit(name: str, threads: int, cache: Path) -> None:
    outcome, rows = run(CASES[name], cache, "c", threads)
    alone, rows_alone = run(CASES[name], cache, "c")
    assert outcome.reason == alone.reason
    np.testing.assert_array_equal(outcome.min_state, alone.min_state)
    for key, value in rows_alone.items():
        np.testing.assert_array_equal(rows[key], value)
