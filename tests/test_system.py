"""Systems beyond equal agents: wiring, shared FMUs, periods, faults; C against the numpy loop."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
from test_engine import assert_alike
from test_fmu_instance import described

from posmas_fmi.agent import linear_agent
from posmas_fmi.cosim import engine
from posmas_fmi.cosim.channel import Channel
from posmas_fmi.cosim.clock import Clock
from posmas_fmi.cosim.conditions import NEVER, Episode, Sensors
from posmas_fmi.cosim.fmu_plant import FmuPlant, Isolation, PlantSpec, PortMap
from posmas_fmi.cosim.law import ProtocolLaw
from posmas_fmi.cosim.master import Iteration, Outcome, System
from posmas_fmi.cosim.wiring import Extra, Term, Wiring, column
from posmas_fmi.fmu import build
from posmas_fmi.fmu.model import Experiment, FmuModel, Variable
from posmas_fmi.network import network_from_arcs
from posmas_fmi.protocol import make_protocol

H, N = 0.05, 4
TANK = """
#include "model.h"

/* x' = -x + u + d; x'' of the leak is seen through y and twice y */
void model_derivatives(double t, const double *p, const double *u, const double *x, double *dx)
{
    (void)t;
    dx[0] = -p[0] * x[0] + u[0] + u[1];
}

void model_outputs(double t, const double *p, const double *u, const double *x, double *y)
{
    (void)t, (void)p, (void)u;
    y[0] = x[0];
    y[1] = 2 * x[0];
}

void model_directional(double t, const double *p, const double *u, const double *x,
                       const double *su, const double *sx, double *sdx, double *sy)
{
    (void)t, (void)u, (void)x;
    sdx[0] = -p[0] * sx[0] + su[0] + su[1];
    sy[0] = sx[0];
    sy[1] = 2 * sx[0];
}
"""


def tank() -> FmuModel:
    variables = (
        Variable("p", "parameter", (), (1.0,)),
        Variable("u", "input", (), (0.0,)),
        Variable("d", "input", (), (0.0,)),
        Variable("x", "state", (), (1.0,)),
        Variable("y", "output", (2,), depends=("x",)),
    )
    return FmuModel("tank", "a tank with two inflows", variables, {"model.c": TANK}, Experiment())


@attrs.frozen(eq=False)
class Table:
    """Exogenous signals for a test: one column per agent."""

    columns: int = N

    def rows(self, begin: int, end: int) -> np.ndarray:
        k = np.arange(begin, end)[:, None]
        return 0.2 + 0.1 * np.sin(0.3 * k + np.arange(self.columns))


@pytest.fixture(scope="module")
def fmu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build.fmu(tank(), 3, cache=tmp_path_factory.mktemp("fmus"))


AGENT = linear_agent([[-1.0]], [[1.0]], [[1.0]])
NETWORK = network_from_arcs(N, [(1, 2), (2, 3), (3, 4), (4, 1), (1, 3)], [1, 3])
ARCS = NETWORK.adjacency.nnz + 2
# each agent's d: its signal, plus a little of the shared tank (instance N)
SHARED = 4 * N  # its y[1]: readings of an agent are y, x, y[2], d
OF_AGENTS = [(Extra((Term(column(i)), Term(SHARED, 0.3))),) for i in range(N)]
OF_SHARED = (Extra(()), Extra(tuple(Term(4 * i, 0.1) for i in range(N)), 0.05))
WIRED = Wiring(
    (*OF_AGENTS, OF_SHARED),
    np.array([[4 * i + 2, column(i)] for i in range(N)], dtype=np.int64),
    recorded=(SHARED, 3, column(1)),
    drive=Table(),
)


class TwoMore(ProtocolLaw):
    """The protocol, with two measurements beside y that it does not use."""

    extras = ("twice", "signal")

    def send(self, memory: np.ndarray, measured: np.ndarray) -> np.ndarray:
        return super().send(memory, measured[:, :1])


def system(observer: str = "local", **changes: Any) -> System:
    protocol = make_protocol(NETWORK, [[-0.5]], [[0.8]], 1.0, 0.3, observer)
    given: dict[str, Any] = {
        "law": ProtocolLaw(AGENT, protocol),
        "channel": Channel.uniform(ARCS, H, **changes.pop("channel", {})),
        "wiring": attrs.evolve(WIRED, measured=np.zeros((N, 0), dtype=np.int64)),
    }
    return System(
        AGENT,
        NETWORK,
        clock=Clock.of(3.0, H),
        xhat0=np.zeros((N, 1)),
        s0=np.ones(1),
        seed=5,
        **(given | changes),
    )


def plant(fmu: Path) -> FmuPlant:
    return FmuPlant(plant_specs(fmu), True, 1e9)


def plant_specs(fmu: Path) -> list[PlantSpec]:
    agents = [
        PlantSpec(
            fmu,
            {"x": 0.5 * i, "p": 1.0 + 0.1 * i},
            f"tank {i}",
            PortMap.plain(("u", "d")),
            PortMap.plain(("y[1]", "x", "y[2]", "d")),
        )
        for i in range(N)
    ]
    shared = PlantSpec(fmu, {}, "shared", PortMap.plain(("u", "d")), PortMap.plain(("y[1]",)))
    return [*agents, shared]


def run(
    definition: System, fmu: Path, which: engine.Wanted, threads: int = 1
) -> tuple[Outcome, dict[str, np.ndarray]]:
    rows: dict[str, list[np.ndarray]] = {}

    def record(times: np.ndarray, values: dict[str, np.ndarray]) -> None:
        for name, value in {"time": times, **values}.items():
            rows.setdefault(name, []).append(value.copy())

    with plant(fmu) as plants:
        choice = engine.choose(definition.law, which)
        outcome = engine.run(definition, plants, record, choice=choice, threads=threads)
    return outcome, {name: np.concatenate(blocks) for name, blocks in rows.items()}


def episode(what: str, index: Any, value: float, begin: int, end: int = NEVER) -> Episode:
    return Episode(what, index, value, begin, end)


SYSTEMS = {
    "wired": {},
    "distributed": {"observer": "distributed"},
    "delay": {"channel": {"delay": 0.15}},
    "coarse messages": {"channel": {"delay": 0.05, "resolution": 0.125}},
    "longer periods": {"every": np.array([1, 2, 3, 4, 5])},
    "longer periods, delay": {"every": np.array([2, 1, 1, 4, 2]), "channel": {"delay": 0.1}},
    "all periods alike": {"every": np.full(N + 1, 3)},
    "noise": {"sensors": Sensors(np.full((N, 1), 0.1), np.full((N, 1), 0.05))},
    "sensor stuck": {"episodes": (episode("sensor_gain", (1, 0), 0.0, 7, 20),)},
    "sensor biased": {"episodes": (episode("sensor_offset", (2, 0), 0.3, 0),)},
    "actuator stuck, then slow": {
        "episodes": (
            episode("actuator_gain", (0, 0), 0.0, 5, 12),
            episode("actuator_gain", (0, 0), 0.2, 12, 40),
        )
    },
    "arcs lost": {"episodes": (episode("loss", [0, 3], 1.0, 10, 30),)},
    "leader lost": {
        "episodes": (episode("loss", [ARCS - 2, ARCS - 1], 1.0, 15),),
        "channel": {"delay": 0.05, "jitter": 0.1, "loss": 0.2},
    },
    "digraph switches": {
        "episodes": (
            episode("arc_off", [0, 2], 1.0, 10, 25),
            episode("arc_off", [ARCS - 1], 1.0, 20),
        )
    },
    "digraph switches, distributed": {
        "observer": "distributed",
        "episodes": (episode("arc_off", [1], 1.0, 3, 30),),
    },
    "leader jumps": {"leader_changes": ((9, np.array([3.0])), (30, np.array([0.5])))},
    "everything": {
        "every": np.array([1, 2, 1, 2, 4]),
        "sensors": Sensors(np.full((N, 1), 0.1), np.zeros((N, 1))),
        "channel": {"delay": 0.05, "jitter": 0.1, "loss": 0.2, "resolution": 0.01},
        "episodes": (
            episode("sensor_gain", (1, 0), 0.0, 8, 20),
            episode("actuator_gain", (2, 0), 0.3, 4, 44),
            episode("loss", slice(None), 0.9, 12, 18),
            episode("arc_off", [4], 1.0, 14, 33),
        ),
        "leader_changes": ((10, np.array([2.0])),),
    },
}


@pytest.mark.parametrize("name", SYSTEMS)
def test_engine_agrees_with_the_numpy_loop(name: str, fmu: Path) -> None:
    definition = system(**SYSTEMS[name])
    expected = run(definition, fmu, "numpy")
    assert expected[0].ended == "complete"
    assert_alike(run(definition, fmu, "c"), expected)
    assert_alike(run(definition, fmu, "c", threads=3), expected)


@pytest.mark.parametrize("name", [n for n in SYSTEMS if n != "wired"])
def test_each_of_these_makes_a_difference(name: str, fmu: Path) -> None:
    _, plain = run(system(), fmu, "c")
    _, rows = run(system(**SYSTEMS[name]), fmu, "c")
    assert np.abs(rows["x"] - plain["x"]).max() > 1e-3


def test_an_input_is_what_it_is_wired_to(fmu: Path) -> None:
    """By hand: d of agent 0 over a step is its signal plus 0.3 of the shared tank at the start."""
    _, rows = run(system(), fmu, "c")
    shared, d0, signal1 = rows["extra"].T
    signals = Table().rows(0, 61)
    np.testing.assert_array_equal(signal1, signals[:, 1])
    np.testing.assert_allclose(d0[1:], signals[:-1, 0] + 0.3 * shared[:-1], rtol=1e-14)
    # the shared tank: x' = -x + 0.05 + 0.1 Σ y, held over each step
    inflow = 0.05 + 0.1 * rows["x"][:-1, :, 0].sum(axis=1)
    decay = np.exp(-H)
    np.testing.assert_allclose(
        shared[1:], decay * shared[:-1] + (1 - decay) * inflow, rtol=0, atol=1e-7
    )


def test_a_longer_period_holds_the_input_and_the_message(fmu: Path) -> None:
    every = np.array([1, 3, 1, 1, 1])
    _, rows = run(system(every=every), fmu, "c")
    for name in ("u", "x", "xhat"):
        held = rows[name][:60, 1].reshape(20, 3, -1)
        np.testing.assert_array_equal(held, np.broadcast_to(held[:, :1], held.shape))
        assert np.unique(rows[name][:60, 1]).size == 20
    assert np.unique(rows["x"][:, 0]).size == 61


def test_what_is_measured_beside_the_outputs(fmu: Path) -> None:
    """In the numpy loop: the law decides what it measures."""
    protocol = make_protocol(NETWORK, [[-0.5]], [[0.8]], 1.0)
    definition = system(law=TwoMore(AGENT, protocol), wiring=WIRED)
    _, rows = run(definition, fmu, "numpy")
    np.testing.assert_allclose(rows["measured"][:, :, 1], 2 * rows["measured"][:, :, 0])
    np.testing.assert_array_equal(rows["measured"][:, :, 2], Table().rows(0, 61))


def test_sensor_faults_are_seen_by_the_controller_only(fmu: Path) -> None:
    stuck = system(episodes=(episode("sensor_gain", (1, 0), 0.0, 7, 20),))
    _, rows = run(stuck, fmu, "c")
    seen, true = rows["measured"][:, 1, 0], rows["y"][:, 1, 0]
    np.testing.assert_array_equal(seen[:7], true[:7])
    np.testing.assert_array_equal(seen[7:20], np.full(13, seen[6]))
    np.testing.assert_array_equal(seen[20:], true[20:])
    assert np.abs(seen - true).max() > 1e-2


def test_noise_has_its_size_and_is_repeatable(fmu: Path) -> None:
    noisy = system(sensors=Sensors(np.full((N, 1), 0.1), np.zeros((N, 1))))
    _, rows = run(noisy, fmu, "c")
    _, again = run(noisy, fmu, "c")
    np.testing.assert_array_equal(rows["measured"], again["measured"])
    noise = (rows["measured"] - rows["y"]).ravel()
    assert 0.08 < noise.std() < 0.12
    assert abs(noise.mean()) < 0.03


# ---- other ways of coupling ----------------------------------------------------------------------


def pair(coupling: str) -> System:
    """Two tanks without control, each fed by the other: x' = -x + 0.5 z, z' = -z + 0.5 x."""
    one = network_from_arcs(1, [], [1])
    stages: dict[str, Any] = {
        "jacobi": {},
        "gauss-seidel": {"stages": (np.array([0]), np.array([1]))},
        "iterate": {"iteration": Iteration()},
    }
    return System(
        AGENT,
        one,
        ProtocolLaw(AGENT, make_protocol(one, [[0.0]], [[0.0]], 1.0)),
        Channel.uniform(1, 1.0),
        Clock.of(2.0, PAIR_H),
        np.zeros((1, 1)),
        np.zeros(1),
        wiring=Wiring(
            ((Extra((Term(2, 0.5),)),), (Extra(()), Extra((Term(0, 0.5),)))),
            np.zeros((1, 0), dtype=np.int64),
            recorded=(0, 2),
        ),
        **stages[coupling],
    )


PAIR_H = 0.1


def run_pair(coupling: str, fmu: Path, isolation: str = "none") -> np.ndarray:
    rows = []
    specs = [
        PlantSpec(fmu, {"x": 2.0}, "a", PortMap.plain(("u", "d")), PortMap.plain(("y[1]", "x"))),
        PlantSpec(fmu, {"x": 0.0}, "b", PortMap.plain(("u", "d")), PortMap.plain(("y[1]",))),
    ]
    with FmuPlant(specs, True, 1e9, Isolation(isolation)) as plants:
        definition = pair(coupling)
        choice = engine.choose(definition.law, "auto", engine.unfit(definition))
        assert choice.engine == ("c" if coupling == "jacobi" else "numpy")
        engine.run(definition, plants, lambda _, v: rows.append(v["extra"].copy()), choice=choice)
    return np.concatenate(rows)


def by_hand(coupling: str) -> np.ndarray:
    """The same in two lines: exact steps of scalar linear systems with held inputs."""
    decay = np.exp(-PAIR_H)
    x, z = 2.0, 0.0
    rows = [(x, z)]
    for _ in range(20):
        gain = 0.5 * (1 - decay)
        if coupling == "jacobi":
            x, z = decay * x + gain * z, decay * z + gain * x
        elif coupling == "gauss-seidel":
            x = decay * x + gain * z
            z = decay * z + gain * x
        else:  # inputs are those at the end of the step
            implicit = np.array([[1.0, -gain], [-gain, 1.0]])
            x, z = np.linalg.solve(implicit, [decay * x, decay * z])
        rows.append((x, z))
    return np.array(rows)


@pytest.mark.parametrize("coupling", ["jacobi", "gauss-seidel", "iterate"])
def test_a_coupled_pair_against_its_recursion(coupling: str, fmu: Path) -> None:
    np.testing.assert_allclose(run_pair(coupling, fmu), by_hand(coupling), atol=1e-6)


@pytest.mark.parametrize("serialises", [True, False])
def test_steps_are_repeated_in_worker_processes(
    fmu: Path, tmp_path: Path, serialises: bool
) -> None:
    """Also of FMUs whose states cannot leave the process."""
    flag = b'canSerializeFMUState="true"'
    one = fmu if serialises else described(fmu, tmp_path / "one.fmu", flag, b"")
    expected = run_pair("iterate", fmu)
    np.testing.assert_array_equal(run_pair("iterate", one, "process"), expected)


def test_a_coupled_pair_against_its_analytic_solution(
    fmu: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """First order in the period, whatever the coupling."""
    t = 2.0
    exact = np.array([np.exp(-0.5 * t) + np.exp(-1.5 * t), np.exp(-0.5 * t) - np.exp(-1.5 * t)])
    for coupling in ("jacobi", "gauss-seidel", "iterate"):
        errors = []
        for h in (0.1, 0.05, 0.025):
            monkeypatch.setattr(f"{__name__}.PAIR_H", h)
            errors.append(np.abs(run_pair(coupling, fmu)[-1] - exact).max())
        orders = np.log2(np.array(errors[:-1]) / errors[1:])
        assert ((orders > 0.9) & (orders < 1.1)).all(), (coupling, errors)


# ---- an FMU that fails while the others go on ----------------------------------------------------


def test_a_failing_instance_can_be_frozen(fmu: Path) -> None:
    definition = system()
    with plant(fmu) as plants:
        library = engine.native.load(engine.choose(definition.law, "c").library)
        one = engine.Engine(definition, plants, library, 1, ("x", "u"))
        one.freeze_failures()
        rows: list[np.ndarray] = []

        def record(times: np.ndarray, values: dict[str, np.ndarray]) -> None:
            rows.append(values["x"].copy())
            if times[-1] >= 1.0 and not one._frozen[2]:
                plants._instances[2].terminate()  # an FMU that is over refuses to step

        outcome = one.run(record, None)
    x = np.concatenate(rows)[:, :, 0]
    assert outcome.ended == "complete"
    assert [i.agent for i in outcome.incidents] == ["tank 2"]
    assert outcome.incidents[0].action == "frozen"
    assert "cannot be set in Terminated" in outcome.incidents[0].cause
    last = int(np.flatnonzero(np.diff(x[:, 2]))[-1]) + 1
    assert 20 <= last < 60
    assert (np.diff(x[last:, 0]) != 0).all()
