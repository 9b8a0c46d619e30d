"""From an FMU to model (1): what is recovered and reported, and what a scenario makes of it."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmu_examples import example_1, named, tank_fmu, wide
from test_fmu_linearise import INTERFACES, without_derivatives

from posmas_fmi.errors import AgentError, InputError
from posmas_fmi.expression import VectorFunction
from posmas_fmi.fmu.build import agent_fmu
from posmas_fmi.fmu.fit import FittedAgent, fit_agent
from posmas_fmi.scenario import load
from posmas_fmi.scenario.plant import fmu_files, make_instances

BOX = {"x": (0.0, 4.0), "u": (-3.0, 3.0), "t": (0.0, 10.0)}
AROUND = """
[scenario]
name = "fitted"
until = 0.1
period = 0.05

[network]
agents = 2
arcs = [[1, 2]]
pinned = [1]

[leader]
s0 = {s0}
"""


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fmus")


def as_scenario(fitted: FittedAgent, folder: Path) -> Any:
    """The scenario that the fitted sections are pasted into, loaded."""
    shutil.copy(fitted.path, folder / fitted.path.name)
    file = folder / "fitted.toml"
    text = AROUND.replace("{s0}", str([0.0] * fitted.agent.m)) + fitted.to_toml()
    file.write_text(text, encoding="utf-8")
    return load(str(file))


# ---- the reference FMU --------------------------------------------------------------------------


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("interface", INTERFACES)
def test_the_reference_fmu_gives_its_agent_back(
    cache: Path, tmp_path: Path, fmi: int, interface: Any
) -> None:
    example = example_1()
    made = fit_agent(
        example.fmu(fmi, cache),
        ["u[1]"],
        ["y[1]", "y[2]"],
        BOX,
        g=["x1*sin(0.31*x1*t)", "x2*cos(0.31*x2*t)"],
        sec=["1.2*u1 - 0.3*u1*abs(sin(u1))"],
        values=named(example.matrices, fmi),
        interface=interface,
    )
    for name, matrix in example.matrices.items():
        np.testing.assert_allclose(getattr(made.agent, name), matrix, atol=1e-9)
    assert made.residual < 1e-9
    assert made.samples >= 256
    assert made.metzler.metzler
    low, high = made.sector[0]
    assert 0.9 <= low < 0.91  # of [0.9, 1.2] as far as |u| <= 3 goes
    assert 1.15 < high <= 1.2
    assert made.agent.sector == pytest.approx((0.9, 1.2), abs=1e-6)
    # psi reaches 12.4: |sin psi + psi cos psi| up to 12.4 there, times |H|
    assert 6.0 < made.lipschitz.max() < 12.5 * 0.698
    scenario = as_scenario(made, tmp_path)
    assert (scenario.agent.A == made.agent.A).all()
    assert (scenario.agent.H == made.agent.H).all()
    assert scenario.agent.g.expressions == made.agent.g.expressions
    assert scenario.agent.sector == made.agent.sector
    assert scenario.agent.region == made.agent.region


def test_without_candidates_a_polynomial_is_fitted(cache: Path) -> None:
    example = wide()
    box = {"x": (0.0, 0.5), "u": (-0.8, 0.8)}
    rough, fine = (
        fit_agent(example.fmu(3, cache), ["u"], ["y"], box, values=example.matrices, degree=degree)
        for degree in (1, 3)
    )
    assert fine.residual < rough.residual / 3 < 0.1
    assert (np.eye(3) == fine.agent.H).all()
    # the FMU's slopes lie within the declared bound, which covers the model's as well
    declared = np.asarray(fine.agent.lipschitz)
    assert (fine.lipschitz.max(axis=0) <= declared).all()
    statuses = {a.name: a.status for a in fine.agent.assumptions()}
    assert statuses["lipschitz"] == "verified"
    assert statuses["sector"] == "verified"
    # tanh(0.8)/0.8 <= sec(u)/u <= 1 for the first input; clip(u2) is u2 here
    np.testing.assert_allclose(fine.sector[0], [np.tanh(0.8) / 0.8, 1.0], atol=1e-3)
    np.testing.assert_allclose(fine.sector[1], [1.0, 1.0], atol=1e-6)


# ---- plants that are not quite model (1) ---------------------------------------------------------


def test_a_plant_away_from_zero_gets_ports_with_offsets(cache: Path, tmp_path: Path) -> None:
    path = tank_fmu(cache, 2)
    box = {"x": (-10.0, 10.0), "u": (-50.0, 50.0)}
    made = fit_agent(path, ["power"], ["temperature"], box, values={"temperature": 340.0})
    np.testing.assert_allclose(made.agent.A, [[-0.04]])
    np.testing.assert_allclose(made.agent.B, [[0.02]])
    assert (made.g, made.sec, made.notes) == (("0",), ("u1",), ())  # 340 K is its equilibrium
    assert made.residual < 1e-9
    scenario = as_scenario(made, tmp_path)
    with make_instances(scenario, fmu_files(scenario)).start() as plant:
        both, readings = np.arange(2), np.full(4, np.nan)  # y and x of two agents
        plant.read(both, 0.0, readings)
        np.testing.assert_allclose(readings, 0.0, atol=1e-9)
        plant.step(both, np.zeros(2), np.full(2, 0.05), np.array([10.0, 0.0]), readings)
        plant.read(both, 0.05, readings)
        grown = 10 * 0.5 * (1 - np.exp(-0.04 * 0.05))
        np.testing.assert_allclose(readings, [grown, grown, 0.0, 0.0], atol=1e-9)


def test_a_drift_is_kept_and_told(cache: Path) -> None:
    box = {"x": (-10.0, 10.0), "u": (-50.0, 50.0)}
    made = fit_agent(tank_fmu(cache, 2), ["power"], ["temperature"], box)
    assert float(made.g[0]) == pytest.approx((100 - 2 * 10) / 50)
    assert "no equilibrium" in made.notes[0]


def linear_fmu(cache: Path, m: int = 2, p: int = 1) -> Path:
    g = VectorFunction.parse(["0"] * m, ["t", *(f"x{k + 1}" for k in range(m))])
    inputs = [f"u{k + 1}" for k in range(p)]
    return agent_fmu(g, VectorFunction.parse(inputs, inputs), m, p, m, cache=cache)


def test_a_negative_coupling_goes_into_g_and_the_model_stays_the_same(
    cache: Path, tmp_path: Path
) -> None:
    A = np.array([[-1.0, -0.25], [0.5, -2.0]])
    made = fit_agent(
        linear_fmu(cache),
        ["u"],
        ["y"],
        {"x": (0.0, 1.0), "u": (0.0, 1.0)},
        values={"A": A, "B": [[1.0], [0.0]]},
    )
    assert not made.metzler.metzler
    assert made.metzler.negative == ((1, 2, pytest.approx(-0.25)),)
    assert made.metzler.distance == pytest.approx(0.25)
    np.testing.assert_allclose(made.agent.A, [[-1.0, 0.0], [0.5, -2.0]], atol=1e-12)
    assert made.residual < 1e-9
    assert any("went into g: (1, 2): -0.25" in note for note in made.notes)
    np.testing.assert_allclose(made.agent.H_ell, [[0.0, 0.25], [0.0, 0.0]], atol=1e-6)
    assert as_scenario(made, tmp_path).agent.m == 2


def test_an_input_that_acts_downwards_is_turned_around(cache: Path, tmp_path: Path) -> None:
    made = fit_agent(
        linear_fmu(cache),
        ["u"],
        ["y"],
        {"x": (0.0, 1.0), "u": (-1.0, 1.0)},
        values={"B": [[-0.5], [-1.0]]},
    )
    np.testing.assert_allclose(made.agent.B, [[0.5], [1.0]], atol=1e-9)
    assert made.input_scale.tolist() == [-1.0]
    assert made.residual < 1e-9
    scenario = as_scenario(made, tmp_path)
    assert scenario.plant.inputs["u1"].scale == -1.0


# ---- what is refused ----------------------------------------------------------------------------


def test_what_is_no_model_1_is_refused(cache: Path, tmp_path: Path) -> None:
    box = {"x": (0.0, 1.0), "u": (0.0, 1.0)}
    with pytest.raises(AgentError, match=re.escape("upwards on one state and downwards")):
        fit_agent(linear_fmu(cache), ["u"], ["y"], box, values={"B": [[1.0], [-1.0]]})
    tank = tank_fmu(cache, 2)
    with pytest.raises(AgentError, match="acts on an output directly"):
        fit_agent(tank, ["power"], ["net"], box)
    closed = without_derivatives(tank, tmp_path / "closed.fmu")
    with pytest.raises(AgentError, match="expected named states"):
        fit_agent(closed, ["power"], ["flow"], box)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"region": {"x": (0.0, 1.0)}}, "a range for u1"),
        ({"region": {"x": (0.0, 1.0), "u": (0.0, 1.0), "v": (0, 1)}}, "region.v"),
        ({"region": {"x": (1.0, 0.0), "u": (0.0, 1.0)}}, "region.x"),
        ({"region": {"x": (0.0, 1.0), "u": (1.0, 1.0)}}, "region.u1"),
        ({"g": ["x1", "x2", "x1*x2"]}, "at most 2"),
        ({"g": ["import os"]}, "g[0]"),
        ({"sec": ["u1", "u2"]}, "1 expressions"),
        ({"inputs": ["w"]}, "'w'"),
    ],
)
def test_bad_input_is_refused(cache: Path, changes: dict[str, Any], message: str) -> None:
    given: dict[str, Any] = {
        "path": linear_fmu(cache),
        "inputs": ["u"],
        "outputs": ["y"],
        "region": {"x": (0.0, 1.0), "u": (0.0, 1.0)},
        **changes,
    }
    with pytest.raises(InputError, match=re.escape(message)):
        fit_agent(**given)


def test_an_fmu_that_hides_its_derivatives_gives_a_linear_agent(
    cache: Path, tmp_path: Path
) -> None:
    closed = without_derivatives(tank_fmu(cache, 2), tmp_path / "closed.fmu")
    made = fit_agent(
        closed,
        ["power"],
        ["temperature"],
        {"x": (-1.0, 1.0), "u": (-1.0, 1.0)},
        states=["temperature"],
    )
    np.testing.assert_allclose(made.agent.A, [[-0.04]], atol=1e-6)
    np.testing.assert_allclose(made.agent.B, [[0.02]], atol=1e-6)
    assert made.samples == 0
    assert np.isnan(made.residual)
    assert any("was not sampled" in note for note in made.notes)
    assert made.agent.lipschitz is None


# ---- another tool -------------------------------------------------------------------------------

LINE = """
import math

from pythonfmu import DefaultExperiment, Fmi2Causality, Fmi2Initial, Fmi2Slave, Real


class Line(Fmi2Slave):
    '''a' = -2 a + u, b' = a - b, exactly; y = a + b/2.'''

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.u, self.a, self.b = 0.0, 1.0, 2.0
        self.default_experiment = DefaultExperiment(step_size=0.01)
        self.register_variable(Real("u", causality=Fmi2Causality.input))
        for name in "ab":
            self.register_variable(
                Real(name, causality=Fmi2Causality.local, initial=Fmi2Initial.exact)
            )
        self.register_variable(
            Real("y", causality=Fmi2Causality.output, getter=lambda: self.a + self.b / 2)
        )

    def do_step(self, t, h):
        fast, slow, rest = math.exp(-2 * h), math.exp(-h), self.u / 2
        off = self.a - rest
        self.a = rest + off * fast
        self.b = self.b * slow + rest * (1 - slow) + off * (slow - fast)
        return True
"""


@pytest.fixture(scope="module", params=[True, False])
def line(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    builder = pytest.importorskip("pythonfmu.builder", reason="pythonfmu is not installed")
    folder = tmp_path_factory.mktemp("pythonfmu")
    (folder / "line.py").write_text(LINE, encoding="utf-8")
    options = {"canGetAndSetFMUstate": "true"} if request.param else {}
    return Path(builder.FmuBuilder.build_FMU(folder / "line.py", dest=folder, **options))


@pytest.mark.slow
@pytest.mark.parametrize("at", [0.0, 0.5])
def test_an_fmu_of_another_tool(line: Path, tmp_path: Path, at: float) -> None:
    from posmas_fmi.fmu.linearise import linearise

    A, B, C = [[-2.0, 0.0], [1.0, -1.0]], [[1.0], [0.0]], [[1.0, 0.5]]
    shown = linearise(line, ["u"], ["y"], at, states=["a", "b"])
    for found, true in ((shown.A, A), (shown.B, B), (shown.C, C), (shown.D, [[0.0]])):
        np.testing.assert_allclose(found, true, atol=1e-6)
    hidden = linearise(line, ["u"], ["y"], at)
    np.testing.assert_allclose(hidden.poles, [-1.0, -2.0], atol=1e-5)
    with_state = b'canGetAndSetFMUstate="true"' in _description(line)
    how = "state restored" if with_state else "fresh instances"
    assert hidden.method == f"central differences, {how}"
    box = {"x": (-1.0, 1.0), "u": (-1.0, 1.0)}
    made = fit_agent(line, ["u"], ["y"], box, at, states=["a", "b"])
    np.testing.assert_allclose(made.agent.A, A, atol=1e-6)
    assert made.metzler.metzler
    assert as_scenario(made, tmp_path).agent.p == 1


def _description(path: Path) -> bytes:
    import zipfile

    with zipfile.ZipFile(path) as archive:
        return archive.read("modelDescription.xml")
