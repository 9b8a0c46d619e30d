"""The engine in C against the numpy loop, which defines the semantics."""

from __future__ import annotations

import json
import os
import signal
import threading
from pathlib import Path
from typing import Any, Literal

import attrs
import numpy as np
import pytest
from fmu_examples import Example, example_1, named, wide
from hypothesis import given
from hypothesis import strategies as st

from posmas_fmi.agent import Agent
from posmas_fmi.cosim import engine, native
from posmas_fmi.cosim.channel import Arrivals, Channel, Mailbox
from posmas_fmi.cosim.clock import Clock
from posmas_fmi.cosim.compiled_step import compiled_step
from posmas_fmi.cosim.fmu_plant import FmuPlant, Isolation, PlantSpec, PortMap
from posmas_fmi.cosim.law import ProtocolLaw
from posmas_fmi.cosim.master import Outcome, System
from posmas_fmi.errors import BuildError, FmuCallError, InputError
from posmas_fmi.expression import VectorFunction
from posmas_fmi.fmu import build
from posmas_fmi.fmu.check.preflight import check_fmu
from posmas_fmi.fmu.model import Experiment, FmuModel, Variable
from posmas_fmi.network import Network, network_from_arcs
from posmas_fmi.protocol import make_protocol

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
        agent = agent_of(self.example)
        protocol = make_protocol(network, K, E, self.phi, 0.5, self.observer, self.form)
        return System(
            agent,
            network,
            ProtocolLaw(agent, protocol),
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
        return FmuPlant.of_agents(
            names, specs, self.ports("u", p), self.ports("y", q), states, self.until
        )

    def ports(self, letter: str, count: int) -> PortMap:
        names = tuple(f"{letter}[{k + 1}]" for k in range(count))
        units = (None,) * count
        return PortMap(names, (self.scale,) * count, (self.offset,) * count, units, "")


def run(
    case: Case, cache: Path, which: engine.Wanted | Literal["numpy alone"], threads: int = 1
) -> tuple[Outcome, dict[str, np.ndarray]]:
    """Run a case; the numpy loop takes g and sec from the engine's library, or is alone."""
    system, rows = case.system(), {}

    def record(times: np.ndarray, values: dict[str, np.ndarray]) -> None:
        for name, value in {"time": times, **values}.items():
            rows.setdefault(name, []).append(value.copy())

    with case.plant(cache) as plant:
        alone = which == "numpy alone"
        choice = engine.Choice("numpy") if alone else engine.choose(system.law, which)
        outcome = engine.run(system, plant, record, choice=choice, threads=threads)
    return outcome, {name: np.concatenate(blocks) for name, blocks in rows.items()}


def assert_alike(actual, expected) -> None:
    (outcome, rows), (wanted, wanted_rows) = actual, expected
    assert rows.keys() == wanted_rows.keys()
    for name, value in wanted_rows.items():
        assert rows[name].shape == value.shape, name
        size = np.abs(value).max(initial=0)
        np.testing.assert_allclose(rows[name], value, rtol=0, atol=TOLERANCE * size, err_msg=name)
    for field in ("ended", "steps", "time", "messages", "lost", "reason", "failed_agent"):
        assert getattr(outcome, field) == getattr(wanted, field), field
    size = max(np.abs(value).max(initial=0) for value in wanted_rows.values())
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
    expected = run(CASES[name], cache, "numpy alone")
    assert expected[0].ended == ("diverged" if "diverges" in name else "complete")
    for which in ("c", "numpy"):
        assert_alike(run(CASES[name], cache, which), expected)


@pytest.mark.parametrize("example", [example_1(), wide()], ids=["example 1", "other sizes"])
def test_the_step_in_c_of_any_number_of_agents(example: Example) -> None:
    agent = agent_of(example)
    law = ProtocolLaw(agent, make_protocol(digraph(2), *GAINS[agent.m], 1.0))
    constants = law.constants(0.01)
    step = compiled_step(native.load(engine.choose(law, "c").library), constants, agent.p)
    random = np.random.default_rng(5)
    X = random.uniform(0, 2, (agent.m, 19))
    D, s = random.uniform(-1, 1, (agent.m + agent.q, 19)), random.uniform(0, 2, agent.m)
    u = law.protocol.K @ D[: agent.m]
    applied = agent.sec_numpy(u.T).T
    held = law.protocol.E @ D[agent.m :] + agent.B @ applied
    model = law.propagator(0.01)
    ahead = model(0.7, s[None], np.zeros((1, agent.m)))[0]
    wanted = {"memory": model(0.7, X.T, held.T).T, "u": u, "applied": applied}
    names = ("memory", "leader", "u", "applied")
    every = dict(zip(names, step(0.7, D, X, s), strict=True))
    for n in range(1, 20):  # whole groups of lanes, and what is left
        first = (np.ascontiguousarray(columns[:, :n]) for columns in (D, X))
        some = dict(zip(names, step(0.7, *first, s), strict=True))
        np.testing.assert_allclose(some["leader"], ahead, rtol=1e-13, atol=1e-13)
        for name, expected in wanted.items():
            np.testing.assert_allclose(some[name], expected[:, :n], rtol=1e-13, atol=1e-13)
            np.testing.assert_array_equal(some[name], every[name][:, :n])
    with pytest.raises(TypeError, match="contiguous"):
        step(0.7, D, X[:, ::2], s)


def test_the_numpy_loop_says_where_its_law_is_from(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken: list[Any] = []
    original = ProtocolLaw.compiled
    monkeypatch.setattr(
        ProtocolLaw, "compiled", lambda *given: taken.append(given) or original(*given)
    )
    case = Case(until=0.05)
    choice = engine.choose(case.system().law, "numpy")
    facts = choice.to_dict()
    assert (facts["used"], facts["functions"]) == ("numpy", "c")
    run(case, cache, "numpy alone")
    assert not taken
    assert engine.Choice("numpy").to_dict()["functions"] == "numpy"
    run(case, cache, "numpy")
    assert len(taken) == 1
    # what needs the numpy loop has them as well
    assert engine.choose(case.system().law, "auto", "it is coupled otherwise").library


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


# ---- what goes wrong -----------------------------------------------------------------------------

FRAGILE = """
#include <math.h>
#include "model.h"

/* p[0]: from when on the derivatives, p[1]: the outputs are not finite */
void model_derivatives(double t, const double *p, const double *u, const double *x, double *dx)
{
    dx[0] = t > p[0] ? NAN : u[0] - x[0];
    dx[1] = -x[1];
}

void model_outputs(double t, const double *p, const double *u, const double *x, double *y)
{
    (void)u;
    y[0] = t > p[1] ? NAN : x[0];
    y[1] = x[1];
}

void model_directional(double t, const double *p, const double *u, const double *x,
                       const double *su, const double *sx, double *sdx, double *sy)
{
    (void)t, (void)p, (void)u, (void)x;
    sdx[0] = su[0] - sx[0];
    sdx[1] = -sx[1];
    sy[0] = sx[0];
    sy[1] = sx[1];
}
"""


def fragile() -> FmuModel:
    variables = (
        Variable("p", "parameter", (2,), (1e9, 1e9)),
        Variable("u", "input", (1,), (0.0,)),
        Variable("x", "state", (2,), (1.0, 1.0)),
        Variable("y", "output", (2,), depends=("x",)),
    )
    return FmuModel("fragile", "fails on demand", variables, {"model.c": FRAGILE}, Experiment())


def changed(monkeypatch: pytest.MonkeyPatch, fmi: int, old: str, new: str) -> None:
    """Build FMUs from now on with other C code around the model."""

    def sources(model: FmuModel, version: int) -> dict[str, str]:
        files = original(model, version)
        assert old in files[f"fmi{fmi}.c"]
        return files | {f"fmi{fmi}.c": files[f"fmi{fmi}.c"].replace(old, new)}

    original = build.sources
    monkeypatch.setattr(build, "sources", sources)


@attrs.frozen
class Fragile(Case):
    """Agents that follow `FRAGILE`; `values` are the parameters of some of them."""

    values: dict[int, list[float]] = attrs.field(factory=dict)
    isolation: Isolation = attrs.field(factory=lambda: Isolation("none"))

    def plant(self, cache: Path) -> FmuPlant:
        fmu = build.fmu(fragile(), self.fmi, cache=cache)
        values = {k: named({"p": p}, self.fmi) for k, p in self.values.items()}
        specs = [PlantSpec(fmu, values.get(k, {})) for k in range(self.n)]
        states = self.ports("x", 2) if self.shows_states else None
        names = digraph(self.n).names
        return FmuPlant.of_agents(
            names,
            specs,
            self.ports("u", 1),
            self.ports("y", 2),
            states,
            self.until,
            self.isolation,
        )


NEVER = 1e9
FAILURES = {
    "step": ({2: [0.495, NEVER]}, "3", "DoStep"),
    "two steps": ({3: [0.495, NEVER], 1: [0.495, NEVER]}, "2", "DoStep"),
    "output": ({1: [NEVER, 0.495]}, "2", "Get"),
    "step before output": ({0: [NEVER, 0.495], 3: [0.495, NEVER]}, "4", "DoStep"),
    "at the start": ({3: [NEVER, -1.0]}, "4", "Get"),
}


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("name", FAILURES)
def test_a_failing_fmu_is_the_same_verdict(name: str, fmi: int, cache: Path) -> None:
    values, agent, call = FAILURES[name]
    case = Fragile(values=values, fmi=fmi)
    expected = run(case, cache, "numpy")
    assert expected[0].ended == "failed"
    assert expected[0].failed_agent == agent
    assert f"fragile-fmi{fmi}" in expected[0].reason
    assert f"fmi{fmi}{call}" in expected[0].reason
    if name == "at the start":
        outcome, rows = run(case, cache, "c")
        assert rows == {}
        assert outcome.reason == expected[0].reason
        return
    assert expected[0].steps in (49, 50)
    for threads in (1, 3):
        assert_alike(run(case, cache, "c", threads), expected)


LATE = "if (currentCommunicationPoint > 0.295)"
STEPPED = "    *lastSuccessfulTime = INSTANCE(instance)->state.v[AT_TIME];"


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        ("return (fmi3Status)-7;", "-7 (outside the standard)"),
        ("return fmi3Discard;", "2 (Discard)"),
    ],
)
def test_odd_answers_of_an_fmu(
    answer: str, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    changed(monkeypatch, 3, STEPPED, f"{STEPPED}\n    {LATE}\n        {answer}")
    expected = run(Fragile(), tmp_path, "numpy")
    assert expected[0].ended == "failed"
    assert reason in expected[0].reason
    assert_alike(run(Fragile(), tmp_path, "c"), expected)


ENDS = {
    2: (
        (
            "    return c ? (fmi2Status)instance_step(",
            "    if (currentCommunicationPoint > 0.295)\n        return fmi2Discard;\n"
            "    return c ? (fmi2Status)instance_step(",
        ),
        ("*value = fmi2False;", "*value = fmi2True;"),
    ),
    3: ((STEPPED, f"{STEPPED}\n    {LATE}\n        *terminateSimulation = true;"),),
}


@pytest.mark.parametrize("where", ["none", "process"])
@pytest.mark.parametrize("fmi", [2, 3])
def test_an_fmu_may_end_the_simulation(
    fmi: int, where: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That is no failure, also where failures do not end the run, and all before is kept."""
    for old, new in ENDS[fmi]:
        changed(monkeypatch, fmi, old, new)
    for what in ("stop", "freeze"):
        case = Fragile(fmi=fmi, isolation=Isolation(where, on_failure=what))
        for which in ("numpy", "c"):
            outcome, rows = run(case, tmp_path, which)
            assert (outcome.ended, outcome.failed_agent) == ("terminated", "1")
            assert f"fmi{fmi}DoStep: asked to end the simulation at 0.3" in outcome.reason
            assert outcome.incidents == ()
            assert outcome.steps == len(rows["time"]) - 1 == 30


@pytest.mark.parametrize("fmi", [2, 3])
def test_to_end_the_simulation_is_no_error_of_a_trial(
    fmi: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for old, new in ENDS[fmi]:
        changed(monkeypatch, fmi, old, new.replace("0.295", "0.0"))
    found = check_fmu(build.fmu(fragile(), fmi, cache=tmp_path), control=False).findings
    assert {f.severity for f in found if f.code == "terminates"} == {"note"}
    assert not [f for f in found if f.severity in ("error", "fatal")]


STEP = "    Status status =\n        instance_step("
EARLY = """    if (communicationStepSize > 0.004) {
        *eventHandlingNeeded = *terminateSimulation = false;
        *earlyReturn = true;
        *lastSuccessfulTime = currentCommunicationPoint + 0.4 * communicationStepSize;
        return (fmi3Status)instance_step(INSTANCE(instance), currentCommunicationPoint,
                                         0.4 * communicationStepSize);
    }
"""


def test_steps_that_return_early_are_continued(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = run(Fragile(), tmp_path, "c")
    changed(monkeypatch, 3, STEP, EARLY + STEP)
    for which in ("c", "numpy"):
        outcome, rows = run(Fragile(), tmp_path, which)
        assert outcome.ended == "complete"
        for name, values in whole[1].items():
            np.testing.assert_allclose(rows[name], values, rtol=1e-5, atol=1e-7, err_msg=name)


def test_an_fmu_that_never_gets_to_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stuck = EARLY.split("        return")[0].replace("0.4 * communicationStepSize", "0.0")
    changed(monkeypatch, 3, STEP, f"{stuck}        return fmi3OK;\n    }}\n{STEP}")
    outcome, _ = run(Fragile(), tmp_path, "c")
    assert outcome.ended == "failed"
    assert "returned early at 0.0 s" in outcome.reason


SETS = "    return instance ? (fmi3Status)instance_set(INSTANCE(instance), valueReferences,"
GETS = "    return instance ? (fmi3Status)instance_get(INSTANCE(instance), valueReferences,"


@pytest.mark.parametrize("where", ["none", "process"])
@pytest.mark.parametrize("which", ["c", "numpy"])
def test_nothing_is_read_between_an_input_and_the_step(
    which: str, where: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The FMU refuses what the standard forbids in Step Mode."""
    running = "INSTANCE(instance)->state.mode == MODE_STEP"
    set_now = f"    if ({running})\n        INSTANCE(instance)->state.unused = 1;\n"
    refuse = f"    if ({running} && INSTANCE(instance)->state.unused)\n        return fmi3Error;\n"
    changed(monkeypatch, 3, SETS, set_now + SETS)
    changed(monkeypatch, 3, GETS, refuse + GETS)
    changed(monkeypatch, 3, STEP, "    INSTANCE(instance)->state.unused = 0;\n" + STEP)
    case = Fragile(isolation=Isolation(where))
    outcome, _ = run(case, tmp_path, which)
    assert outcome.ended == "complete", outcome.reason


@pytest.mark.parametrize("reached", ["NAN", "-1.0", "1.5 * communicationStepSize"])
@pytest.mark.parametrize("which", ["c", "numpy"])
def test_an_early_return_at_no_time_of_the_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, which: str, reached: str
) -> None:
    """Beyond the end of the step, say, is another time than that of all others."""
    odd = EARLY.split("        return")[0].replace("0.4 * communicationStepSize", reached)
    changed(monkeypatch, 3, STEP, f"{odd}        return fmi3OK;\n    }}\n{STEP}")
    outcome, _ = run(Fragile(), tmp_path, which)
    assert outcome.ended == "failed"
    assert "expected times within the step" in outcome.reason


def test_an_fmu_that_gives_no_instance(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    call = "first.environment = functions->componentEnvironment;"
    why = (
        '((fmi2CallbackLogger *)functions->logger)(first.environment, "", fmi2Error, "", "no %s");'
    )
    changed(monkeypatch, 2, call, f"{call}\n        {why}\n        return NULL;")
    with pytest.raises(FmuCallError, match="no instance: no %s"):
        Fragile(fmi=2).plant(tmp_path)


WARNING = 1  # fmi2Warning, fmi3Warning


@pytest.mark.parametrize("which", ["numpy", "c"])
@pytest.mark.parametrize("fmi", [2, 3])
def test_warnings_are_told_with_their_messages(
    which: engine.Wanted,
    fmi: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    hot = "currentCommunicationPoint > 0.295 && currentCommunicationPoint < 0.325"
    component = "instance" if fmi == 3 else "c"
    step = f"instance_step(INSTANCE({component}), currentCommunicationPoint,"
    old = (
        f"    Status status =\n        {step}" if fmi == 3 else f"    return c ? (fmi2Status){step}"
    )
    new = (
        f'    if ({hot}) {{\n        instance_log(INSTANCE({component}), STATUS_WARNING, "hot");\n'
        f"        {step} communicationStepSize);\n        return {WARNING};\n    }}\n"
    )
    changed(monkeypatch, fmi, old, new + old)
    outcome, _ = run(Fragile(n=1, fmi=fmi), tmp_path, which)
    assert outcome.ended == "complete"
    texts = [record.getMessage() for record in caplog.records]
    assert any("DoStep warns: hot" in text for text in texts)


def test_fmus_called_one_by_one_give_the_same(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a compiler there is neither the engine nor the loop over FMUs."""
    cases = [
        CASES["nine, FMI 2"],
        CASES["scaled"],
        Fragile(values={2: [0.495, NEVER]}),
        Fragile(values={1: [NEVER, 0.495]}, fmi=2),
    ]
    expected = [run(case, cache, "numpy alone") for case in cases]

    def no_compiler(*_: object) -> Path:
        raise BuildError("found no C compiler")

    monkeypatch.setattr(native, "library", no_compiler)
    choice = engine.choose(cases[0].system().law)
    assert choice.to_dict() == {
        "used": "numpy",
        "functions": "numpy",
        "reason": "found no C compiler",
    }
    with pytest.raises(BuildError):
        engine.choose(cases[0].system().law, "c")
    for case, wanted in zip(cases, expected, strict=True):
        outcome, rows = run(case, cache, "numpy")
        assert outcome.reason == wanted[0].reason
        for name, value in wanted[1].items():
            np.testing.assert_array_equal(rows[name], value)


def test_functions_in_python_run_with_numpy() -> None:
    agent = attrs.evolve(agent_of(example_1()), g=lambda t, X: np.sin(X))
    network = digraph(2)
    law = ProtocolLaw(agent, make_protocol(network, *GAINS[2], 1.0))
    assert "Python functions" in engine.choose(law).reason
    with pytest.raises(InputError, match="expressions"):
        engine.choose(law, "c")


def test_an_interrupt_ends_the_run_and_keeps_the_rows(cache: Path) -> None:
    case = Case(n=9, h=0.001, until=10_000.0)
    system, times = case.system(), []
    with case.plant(cache) as plant:
        timer = threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT))
        timer.start()
        choice = engine.choose(system.law, "c")
        outcome = engine.run(system, plant, lambda t, _: times.append(t.copy()), choice=choice)
        timer.join()
    assert outcome.ended == "cancelled"
    recorded = np.concatenate(times)
    assert 0 < len(recorded) == outcome.steps < 10_000_000
    np.testing.assert_allclose(recorded, np.arange(outcome.steps) * 0.001, rtol=1e-15)


def test_halt_from_another_thread(cache: Path) -> None:
    case = Case(n=4, h=0.001, until=10_000.0)
    system = case.system()
    with case.plant(cache) as plant:
        library = native.load(engine.choose(system.law, "c").library)
        one = engine.Engine(system, plant, library, 2, ())
        timer = threading.Timer(0.1, one.halt)
        timer.start()
        assert one.run(None, None).ended == "cancelled"
        timer.join()


def test_progress_counts_to_the_end(cache: Path) -> None:
    case, seen = Case(), []
    with case.plant(cache) as plant:
        engine.run(case.system(), plant, progress=lambda k, n: seen.append((k, n)))
    assert seen == sorted(seen)
    assert seen[-1] == (100, 100)


def test_a_plant_can_be_used_again_from_python_after_a_run(cache: Path) -> None:
    case = Case(until=0.5)
    with case.plant(cache) as plant:
        engine.run(case.system(), plant, choice=engine.choose(case.system().law, "c"))
        x, everyone = np.zeros(plant.reading_at[-1]), np.arange(4)
        plant.read(everyone, 0.5, x)
        with pytest.raises(FmuCallError, match="stop"):
            plant.step(everyone, np.full(4, 0.5), np.full(4, 0.01), np.zeros(4), x)
    assert np.isfinite(x).all()
    assert x.any()


@given(st.integers(0, 2**32 - 1), st.integers(0, 3), st.integers(0, 4), st.floats(0, 1))
def test_arrivals_are_those_of_the_mailbox(seed: int, delay: int, jitter: int, loss: float) -> None:
    channel = Channel.uniform(5, 1.0, delay, jitter, loss)
    mailbox = Mailbox(channel, np.zeros((5, 1)), np.random.default_rng(seed))
    arrivals = Arrivals(channel, np.random.default_rng(seed))
    parts = [arrivals.draw(0, 7), arrivals.draw(7, 16)[:4]]  # the run stopped within the second
    lost = int(arrivals.lost[:4].sum())
    again = Arrivals(channel, np.random.default_rng())
    parts.append(arrivals.draw(11, 16))
    lost += int(arrivals.lost.sum())
    again.restore(16, json.loads(json.dumps(arrivals.state())))
    parts.append(again.draw(16, 20))
    ages, lost = np.concatenate(parts), lost + int(again.lost.sum())
    held, before = np.full(5, -1.0), 0
    mailbox.held = held[:, None].copy()
    for k in range(20):
        received = mailbox.exchange(k, np.full((5, 1), float(k)))
        held = np.where(ages[k] >= 0, k - ages[k], held)
        np.testing.assert_array_equal(received[:, 0], held)
        before = mailbox.lost if k == 6 else before if k > 6 else 0
    assert lost == mailbox.lost - before


@pytest.mark.parametrize("options", [{"delay": 1e300}, {"jitter": 2.0, "loss": 0.2}])
def test_messages_that_come_after_the_end_take_no_room(options: dict, cache: Path) -> None:
    case = Case(until=0.5, **options)
    here, there = (run(case, cache, which) for which in ("c", "numpy"))
    assert here[0].lost == there[0].lost
    for name, values in here[1].items():
        np.testing.assert_allclose(values, there[1][name], rtol=1e-12, atol=1e-12)


@given(st.integers(0, 2**32 - 1), st.integers(0, 4), st.integers(0, 3))
def test_messages_are_on_their_way_as_long_as_the_channel_says(
    seed: int, jitter: int, delay: int
) -> None:
    """Each of the delays comes, about as often as each other one."""
    channel = Channel.uniform(20, 1.0, delay, jitter)
    arrives, later = channel.drawn(np.random.default_rng(seed), 200, channel.loss)
    counts = np.bincount(later.ravel(), minlength=delay + jitter + 1)
    assert arrives.all()
    assert counts[:delay].sum() == 0
    assert abs(counts[delay:] / (4000 / (jitter + 1)) - 1).max() < 0.25  # over 6 deviations


def test_the_state_of_another_channel_is_refused() -> None:
    first, other = (Arrivals(Channel.uniform(n, 1.0, 2), np.random.default_rng(1)) for n in (3, 4))
    first.draw(0, 5)
    state = first.state()
    for wrong in (state | {"taken": [0]}, state | {"coming": [[9, 0, 1]]}, {"random": 1}):
        with pytest.raises(InputError, match="another channel"):
            first.restore(5, wrong)
    with pytest.raises(InputError, match="another channel"):
        other.restore(5, state)
