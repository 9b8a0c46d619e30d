"""Linear models of FMUs: the reference FMU's matrices, every way to find them, other tools."""

from __future__ import annotations

import math
import os
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest
from fmu_examples import TANK_C, TANK_TOML, example_1, named, tank, tank_fmu, wide
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from test_fmu_instance import changed, described

from posmas_fmi.errors import FmuCallError, FmuError, InputError
from posmas_fmi.fmu.build import fmu
from posmas_fmi.fmu.compile import host, shared_library
from posmas_fmi.fmu.differences import jacobian
from posmas_fmi.fmu.instance import FmuInstance
from posmas_fmi.fmu.iosystem import fmu_to_iosystem
from posmas_fmi.fmu.linearise import Linearisation, linearise, metzler_report
from posmas_fmi.fmu.model_exchange import ModelExchangeFile
from posmas_fmi.fmu.plant import read_plant
from posmas_fmi.fmu.sources import compiled, sources
from posmas_fmi.fmu.step_response import Sampled, continuous

INTERFACES = ("Model Exchange", "Co-Simulation")
POINTS = [(0.0, [0.0, 0.0], 0.0), (0.0, [1.0, 0.3], 0.4), (2.5, [0.2, 1.5], -0.7)]


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fmus")


def values_1(x: list[float], u: float, fmi: int) -> dict[str, Any]:
    return named(example_1().matrices | {"x": x, "u": [u]}, fmi)


def expect_example_1(made: Linearisation, tolerance: float = 1e-6) -> None:
    """Compare with the slopes of Example 1 worked out by hand, at the state that was reached."""
    example, psi, u = example_1(), 0.31 * made.x0 * made.at, float(made.u0[0])
    slope = np.diag(
        [
            math.sin(psi[0]) + psi[0] * math.cos(psi[0]),
            math.cos(psi[1]) - psi[1] * math.sin(psi[1]),
        ]
    )
    sine = math.sin(u)
    gain = 1.2 - 0.3 * (abs(sine) + u * math.cos(u) * np.sign(sine))
    np.testing.assert_allclose(made.A, example.A + example.H @ slope, atol=tolerance)
    np.testing.assert_allclose(made.B, example.B * gain, atol=tolerance)
    np.testing.assert_allclose(made.C, example.C, atol=tolerance)
    np.testing.assert_allclose(made.D, 0.0, atol=tolerance)


def without_derivatives(path: Path, to: Path) -> Path:
    """A copy whose description, FMI 2, tells of no derivatives, no Model Exchange."""

    def change(name: str, data: bytes) -> tuple[str, bytes]:
        if name == "modelDescription.xml":
            data = re.sub(rb' derivative="\d+"', b"", data)
            data = re.sub(rb"<Derivatives>.*?</Derivatives>", b"", data, flags=re.DOTALL)
            data = re.sub(rb"<ModelExchange.*?</ModelExchange>", b"", data, flags=re.DOTALL)
            data = data.replace(b'providesDirectionalDerivative="true"', b"")
        return name, data

    return changed(path, to, change)


# ---- the reference FMU --------------------------------------------------------------------------


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("interface", INTERFACES)
@pytest.mark.parametrize(("at", "x", "u"), POINTS)
def test_the_reference_fmu_gives_its_matrices_back(
    cache: Path, fmi: int, interface: Any, at: float, x: list[float], u: float
) -> None:
    path = example_1().fmu(fmi, cache)
    made = linearise(
        path, ["u[1]"], ["y[1]", "y[2]"], at, values=values_1(x, u, fmi), interface=interface
    )
    assert (made.interface, made.method) == (interface, "directional derivatives")
    assert made.states == ("x[1]", "x[2]")
    expect_example_1(made)
    assert made.error is not None
    assert made.error < 1e-4  # of the differences compared with: sec has a kink at 0
    assert made.notes == ()
    expected = example_1().trajectory(x, np.array([0.0, max(at, 1e-9)]), np.array([[u]]))[-1]
    np.testing.assert_allclose(made.x0, expected, atol=1e-6)
    f = example_1().derivative()
    np.testing.assert_allclose(made.rate0, f(at, made.x0, made.u0), atol=1e-6)


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("interface", INTERFACES)
def test_without_directional_derivatives_differences_give_the_same(
    cache: Path, tmp_path: Path, fmi: int, interface: Any
) -> None:
    word = b"providesDirectionalDerivative" + (b"s" if fmi == 3 else b"")
    path = example_1().fmu(fmi, cache)
    path = described(path, tmp_path / "plain.fmu", word + b'="true"', word + b'="false"')
    for at, x, u in POINTS[1:]:
        made = linearise(
            path, ["u[1]"], ["y[1]", "y[2]"], at, values=values_1(x, u, fmi), interface=interface
        )
        assert made.method == "central differences, state restored"
        assert made.step is None
        expect_example_1(made)


@pytest.mark.parametrize("fmi", [2, 3])
def test_without_saved_states_fresh_instances_give_the_same(
    cache: Path, tmp_path: Path, fmi: int
) -> None:
    path = example_1().fmu(fmi, cache)
    for k, (two, three) in enumerate(
        (
            ("providesDirectionalDerivative", "providesDirectionalDerivatives"),
            ("canGetAndSetFMUstate", "canGetAndSetFMUState"),
        )
    ):
        word = (two if fmi == 2 else three).encode()
        path = described(path, tmp_path / f"{k}.fmu", word + b'="true"', word + b'="false"')
    at, x, u = POINTS[2]
    made = linearise(
        path,
        ["u[1]"],
        ["y[1]", "y[2]"],
        at,
        values=values_1(x, u, fmi),
        interface="Co-Simulation",
    )
    assert made.method == "central differences, fresh instances"
    expect_example_1(made)


def test_a_declared_state_that_cannot_be_saved(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(self: FmuInstance) -> None:
        raise self.error("GetFMUstate", "returned status 3 (Error)")

    monkeypatch.setattr(FmuInstance, "get_state", refuse)
    word = b"providesDirectionalDerivative"
    path = example_1().fmu(2, cache)
    path = described(path, tmp_path / "plain.fmu", word + b'="true"', word + b'="false"')
    made = linearise(
        path,
        ["u[1]"],
        ["y[1]", "y[2]"],
        values=values_1([1.0, 0.3], 0.4, 2),
        interface="Co-Simulation",
    )
    assert made.method == "central differences, fresh instances"
    expect_example_1(made)
    assert "status 3" in made.notes[0]


# ---- directional derivatives that fail, or lie ---------------------------------------------------


def tank_with(cache: Path, name: str, old: str, new: str, fmi: int) -> Path:
    """The tank with a change in its C code."""
    folder = cache / name
    folder.mkdir(exist_ok=True)
    assert old in TANK_C
    (folder / "model.toml").write_text(TANK_TOML, encoding="utf-8")
    code = "#include <math.h>\n" + TANK_C.replace(old, new)
    (folder / "model.c").write_text(code, encoding="utf-8")
    return fmu(read_plant(folder), fmi, cache=cache)


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("interface", INTERFACES)
@pytest.mark.parametrize(
    ("name", "new", "note"),
    [("failing", "sdx[0] = NAN", "no finite derivative"), ("lying", "sdx[0] = 1", "off by")],
)
def test_directional_derivatives_declared_but_no_good(
    cache: Path, fmi: int, interface: Any, name: str, new: str, note: str
) -> None:
    old = "sdx[0] = (su[0] - p[0] * sx[0]) / 50.0"
    path = tank_with(cache, name, old, new, fmi)
    made = linearise(path, ["power"], ["net", "flow", "temperature"], 20.0, interface=interface)
    assert made.method == "central differences, state restored"
    assert note in made.notes[0]
    expect_tank(made)


def expect_tank(made: Linearisation, tolerance: float = 1e-6) -> None:
    np.testing.assert_allclose(made.A, [[-0.04]], atol=tolerance)
    np.testing.assert_allclose(made.B, [[0.02]], atol=tolerance)
    np.testing.assert_allclose(made.C, [[-2.0], [2.0], [1.0]], atol=tolerance)
    np.testing.assert_allclose(made.D, [[1.0], [0.0], [0.0]], atol=tolerance)


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("interface", INTERFACES)
def test_a_plant_with_feedthrough_and_a_state_among_its_outputs(
    cache: Path, fmi: int, interface: Any
) -> None:
    path = tank_fmu(cache, fmi)
    made = linearise(path, ["power"], ["net", "flow", "temperature"], 20.0, interface=interface)
    assert made.method == "directional derivatives"
    expect_tank(made)
    assert made.x0 == pytest.approx([340 - 40 * math.exp(-0.8)], rel=1e-8)


# ---- FMUs that do not tell their derivatives -----------------------------------------------------


@pytest.mark.parametrize("saved", [True, False])
def test_states_that_can_be_set_and_one_step(cache: Path, tmp_path: Path, saved: bool) -> None:
    path = without_derivatives(example_1().fmu(2, cache), tmp_path / "closed.fmu")
    if not saved:
        word = b"canGetAndSetFMUstate"
        path = described(path, tmp_path / "none.fmu", word + b'="true"', word + b'="false"')
    at, x, u = POINTS[2]
    errors = []
    for step in (0.01, 0.005, 0.0025):
        made = linearise(
            path,
            ["u[1]"],
            ["y[1]", "y[2]"],
            at,
            values=values_1(x, u, 2),
            states=["x[1]", "x[2]"],
            step=step,
        )
        assert made.method == "central differences, fresh instances"
        assert (made.step, made.dt, made.rate0) == (step, 0.0, None)
        exact = linearise(
            example_1().fmu(2, cache),
            ["u[1]"],
            ["y[1]", "y[2]"],
            at,
            values=values_1(x, u, 2),
            interface="Co-Simulation",
        )
        errors.append(float(np.abs(made.A - exact.A).max()))
        assert made.error is not None
        assert errors[-1] < made.error  # the estimate is a bound here
        np.testing.assert_allclose(made.C, exact.C, atol=1e-6)
    assert errors[0] / errors[1] > 3  # second order: the point moves and g depends on time
    assert errors[1] / errors[2] > 3


@pytest.mark.parametrize("saved", [True, False])
def test_pulses_find_a_system_without_visible_states(
    cache: Path, tmp_path: Path, saved: bool
) -> None:
    """With g = 0 the FMU is linear: poles and transfer function are those of (A, B, C)."""
    path = without_derivatives(example_1().fmu(2, cache), tmp_path / "closed.fmu")
    if not saved:
        word = b"canGetAndSetFMUstate"
        path = described(path, tmp_path / "none.fmu", word + b'="true"', word + b'="false"')
    values = values_1([0.5, 0.5], 0.4, 2) | named({"H": np.zeros((2, 2))}, 2)
    made = linearise(path, ["u[1]"], ["y[1]", "y[2]"], values=values, step=0.02)
    how = "state restored" if saved else "fresh instances"
    assert made.method == f"central differences, {how}"
    assert not made.named
    assert made.states == ("z1", "z2")
    assert any("shows no states" in note for note in made.notes)
    example = example_1()
    poles = np.sort(np.linalg.eigvals(example.A))
    np.testing.assert_allclose(np.sort(made.poles.real), poles, atol=1e-5)
    gain = 1.2 - 0.3 * (math.sin(0.4) + 0.4 * math.cos(0.4))
    truth = control.ss(example.A, gain * example.B, example.C, 0)
    for w in (0.1, 1.0, 10.0):
        np.testing.assert_allclose(made.to_statespace()(1j * w), truth(1j * w), atol=1e-6)
    assert made.to_dict()["metzler"] is None


def test_pulses_find_the_direct_term(cache: Path, tmp_path: Path) -> None:
    path = without_derivatives(tank_fmu(cache, 2), tmp_path / "closed.fmu")
    made = linearise(path, ["power"], ["net"], step=1.0)
    np.testing.assert_allclose(made.D, [[1.0]], atol=1e-6)
    np.testing.assert_allclose(made.A, [[-0.04]], atol=1e-6)
    np.testing.assert_allclose(made.C @ made.B, [[-2.0 * 0.02]], atol=1e-6)


def test_states_that_only_pulses_reach(cache: Path, tmp_path: Path, monkeypatch: Any) -> None:
    """States that can be read but not set: the realisation is in their coordinates."""
    from posmas_fmi.fmu import linearise as module

    def refuse(*_: object) -> None:
        raise FmuError("cannot be set")

    monkeypatch.setattr(module, "from_restarts", refuse)
    path = without_derivatives(example_1().fmu(2, cache), tmp_path / "closed.fmu")
    values = values_1([0.5, 0.5], 0.0, 2) | named({"H": np.zeros((2, 2))}, 2)
    made = linearise(
        path, ["u[1]"], ["y[1]", "y[2]"], values=values, states=["x[1]", "x[2]"], step=0.02
    )
    assert made.named
    np.testing.assert_allclose(made.A, example_1().A, atol=1e-4)
    np.testing.assert_allclose(made.C, example_1().C, atol=1e-5)


@given(
    st.lists(st.floats(-3, 1), min_size=4, max_size=4),
    st.lists(st.floats(-2, 2), min_size=2, max_size=2),
    st.floats(0.05, 0.5),
)
def test_a_sampled_system_has_its_continuous_one_back(
    a: list[float], b: list[float], h: float
) -> None:
    A, B = np.array(a).reshape(2, 2), np.array(b).reshape(2, 1)
    # principal logarithm: imaginary parts below pi/h (they are at most 3 here, pi/h at least 6)
    block = expm(np.block([[A, B], [np.zeros((1, 3))]]) * h)
    none = np.zeros((1, 1))
    sampled = Sampled(
        block[:2, :2], block[:2, 2:], np.eye(2), none, h, 0.0, 0.0, "", none, named=True
    )
    found = continuous(sampled)
    assert found is not None
    np.testing.assert_allclose(found[0], A, atol=1e-7)
    np.testing.assert_allclose(found[1], B, atol=1e-7)


def test_responses_of_no_linear_system_are_told(cache: Path, tmp_path: Path) -> None:
    """A limit that the pulse itself runs into: 41 samples of something else."""
    old = "dx[0] = (u[0] - p[0] * (x[0] - 290.0)) / 50.0"
    new = "dx[0] = x[0] > 300.0 + 1e-4 ? -sqrt(x[0] - 300.0) : u[0] - 100.0"
    path = tank_with(cache, "bent", old, new, 2)
    closed = without_derivatives(path, tmp_path / "closed.fmu")
    made = linearise(closed, ["power"], ["flow"], step=0.05)
    assert any("not those of a linear system" in note for note in made.notes)


def test_states_that_do_not_start_where_they_are_told(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where the initial state solves equations: there the derivatives are not used."""
    from posmas_fmi.fmu.evaluation import Restart

    def stubborn(self: Restart, instance: FmuInstance, x: np.ndarray, u: np.ndarray) -> None:
        if abs(x[0] - 300.0) > 1e-9:
            raise FmuError("the state 'temperature' does not start where it is told")

    monkeypatch.setattr(Restart, "set", stubborn)
    path = tank_fmu(cache, 2)
    made = linearise(path, ["power"], ["flow"], interface="Co-Simulation")
    assert (made.method, made.error) == ("directional derivatives", None)
    assert "does not start where it is told" in made.notes[0]
    assert "nothing to compare" in made.notes[1]
    np.testing.assert_allclose(made.A, [[-0.04]])


@pytest.mark.parametrize("pole", [0.0, -0.5])
def test_a_truly_discrete_system_has_none(pole: float) -> None:
    one = np.ones((1, 1))
    sampled = Sampled(pole * one, one, one, one, 0.1, 0.0, 0.0, "", one, named=True)
    assert continuous(sampled) is None


# ---- what else the result says -------------------------------------------------------------------


def test_the_metzler_report_names_what_is_negative() -> None:
    A = np.array([[-1.0, -0.2, 0.3], [-1e-9, -2.0, 0.1], [-0.5, 0.0, -3.0]])
    report = metzler_report(A, np.array([[1.0], [-0.3], [0.0]]), tolerance=1e-6)
    assert not report.metzler
    assert report.negative == ((3, 1, -0.5), (1, 2, -0.2))
    assert report.negative_B == ((2, 1, -0.3),)
    assert report.distance == pytest.approx(math.hypot(0.5, 0.2))
    assert (report.nearest >= np.diag(np.diag(A))).all()


def test_differences_say_how_well_they_know() -> None:
    noisy = iter(1e-9 * (-1.0) ** k for k in range(100))
    made = jacobian(lambda x: np.sin(x) + next(noisy), np.array([0.3]), np.array([1e-3]))
    off = abs(float(made.value[0, 0]) - math.cos(0.3))
    assert 1e-8 < off < float(made.error[0, 0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"inputs": ["w"]}, "'w'"),
        ({"outputs": ["z[1]"]}, "did you mean"),
        ({"inputs": ["y[1]"]}, "expected an input"),
        ({"outputs": ["y[1]", "y[1]"]}, "twice"),
        ({"values": {"nothing": 1.0}}, "nothing"),
        ({"states": ["u[1]"]}, "states that the FMU declares"),
        ({"at": math.nan}, "finite time"),
        ({"step": 0.0}, "step > 0"),
        ({"interface": "both"}, "Model Exchange"),
        ({"path": "missing.fmu"}, "no such file"),
    ],
)
def test_bad_input_is_refused(cache: Path, changes: Mapping[str, Any], message: str) -> None:
    given: dict[str, Any] = {
        "path": example_1().fmu(3, cache),
        "inputs": ["u"],
        "outputs": ["y"],
        **changes,
    }
    with pytest.raises(InputError, match=re.escape(message)):
        linearise(**given)


def test_an_fmu_that_fails_on_the_way_says_so(cache: Path) -> None:
    path = tank_with(cache, "sick", "dx[0] = (u[0]", "dx[0] = sqrt(5.0 - t) * (u[0]", 2)
    for interface in INTERFACES:
        with pytest.raises(FmuCallError, match="linearise"):
            linearise(path, ["power"], ["flow"], 10.0, interface=interface)  # type: ignore[arg-type]


# ---- Model Exchange instances -------------------------------------------------------------------


@pytest.mark.parametrize("fmi", [2, 3])
def test_model_exchange_goes_along_its_trajectory(cache: Path, fmi: int) -> None:
    example = wide()
    with ModelExchangeFile(example.fmu(fmi, cache)) as file, file.instantiate("agent") as instance:
        instance.initialise(named(example.matrices | {"x": [1.0, 0.5, 0.2], "u": [0.3, 2.0]}, fmi))
        instance.start()
        assert (instance.n_states, instance.n_indicators) == (3, 0)
        assert instance.next_event == math.inf
        instance.advance(2.0)
        expected = example.trajectory([1.0, 0.5, 0.2], np.array([0.0, 2.0]), np.array([[0.3, 2.0]]))
        np.testing.assert_allclose(instance.states(), expected[-1], atol=1e-7)
        f = example.derivative()
        np.testing.assert_allclose(
            instance.derivatives(), f(2.0, instance.states(), np.array([0.3, 2.0])), atol=1e-12
        )
        instance.handle_event()
        assert instance.nominals() == pytest.approx([1.0, 1.0, 1.0])
        with pytest.raises(FmuCallError, match="takes no steps"):
            instance.do_step(2.0, 0.1)
        with pytest.raises(FmuCallError, match="expected 3 states"):
            instance.set_states([1.0])
        with pytest.raises(FmuCallError, match="finite"):
            instance.set_states([1.0, np.nan, 0.0])


# ---- python-control -----------------------------------------------------------------------------


@pytest.mark.parametrize("fmi", [2, 3])
def test_model_exchange_is_a_continuous_system(cache: Path, fmi: int) -> None:
    example = example_1()
    plant = fmu_to_iosystem(
        example.fmu(fmi, cache), ["u[1]"], ["y[1]", "y[2]"], values=values_1([0.0, 0.0], 0.0, fmi)
    )
    assert plant.isctime()
    assert (plant.state_labels, plant.input_labels) == (["x[1]", "x[2]"], ["u[1]"])
    linear = control.linearize(plant, [0.0, 0.0], [0.0], t=0)
    slope = example.A + example.H @ np.diag([0.0, 1.0])
    np.testing.assert_allclose(linear.A, slope, atol=1e-6)
    np.testing.assert_allclose(linear.poles(), np.linalg.eigvals(slope), atol=1e-6)
    frequency = control.frequency_response(linear, [1.0])
    assert frequency.magnitude.shape == (2, 1, 1)
    times = np.linspace(0.0, 1.0, 6)
    response = control.input_output_response(
        plant, times, np.full((1, 6), 0.2), [1.0, 0.3], solve_ivp_kwargs={"rtol": 1e-9}
    )
    expected = example.trajectory([1.0, 0.3], times, np.full((6, 1), 0.2))
    np.testing.assert_allclose(response.states, expected.T, atol=1e-6)
    # at rest the tank's power covers its loss
    tank = fmu_to_iosystem(tank_fmu(cache, fmi), ["power"], ["temperature"])
    point = control.find_operating_point(tank, [310.0], [60.0])
    assert point.states == pytest.approx([320.0])


@pytest.mark.parametrize("fmi", [2, 3])
def test_co_simulation_is_a_sampled_system(cache: Path, fmi: int) -> None:
    path = tank_fmu(cache, fmi)
    plant = fmu_to_iosystem(path, ["power"], ["net"], interface="Co-Simulation", dt=5.0)
    assert plant.dt == 5.0
    linear = control.linearize(plant, [300.0], [100.0])
    np.testing.assert_allclose(linear.A, [[math.exp(-0.2)]], atol=1e-6)
    np.testing.assert_allclose(linear.B, [[(1 - math.exp(-0.2)) / 2]], atol=1e-6)
    np.testing.assert_allclose(linear.D, [[1.0]], atol=1e-6)
    times = 5.0 * np.arange(5)
    response = control.input_output_response(plant, times, np.full((1, 5), 100.0), [300.0])
    np.testing.assert_allclose(response.states[0], 340 - 40 * np.exp(-0.04 * times), atol=1e-6)


def test_a_system_that_cannot_be_made_is_refused_at_once(cache: Path, tmp_path: Path) -> None:
    path = tank_fmu(cache, 2)
    with pytest.raises(InputError, match="expected no dt"):
        fmu_to_iosystem(path, ["power"], ["net"], dt=1.0)
    closed = without_derivatives(path, tmp_path / "closed.fmu")
    with pytest.raises(FmuError, match="declares its states"):
        fmu_to_iosystem(closed, ["power"], ["net"])
    plant = fmu_to_iosystem(closed, ["power"], ["net"], states=["temperature"], dt=1.0)
    assert pytest.approx(math.exp(-0.04)) == control.linearize(plant, [300.0], [0.0]).A
    with pytest.raises(FmuError, match=r"flow.*(start|set)"):
        fmu_to_iosystem(closed, ["power"], ["net"], states=["flow"])


def eventful(cache: Path) -> Path:
    """The tank with a time event, 1 K more at 5 s, and a state event, twice the loss at 320 K."""
    model = tank(cache / "eventful")
    files = sources(model, 2)
    old = "memset(eventInfo, 0, sizeof *eventInfo);"
    assert old in files["fmi2.c"]
    new = """memset(eventInfo, 0, sizeof *eventInfo);
    State *s = &INSTANCE(c)->state;
    if (s->v[AT_TIME] >= 5.0 && !s->unused) {
        s->unused = 1;
        s->v[AT_X] += 1.0;
        eventInfo->valuesOfContinuousStatesChanged = fmi2True;
        eventInfo->newDiscreteStatesNeeded = fmi2True;
    }
    if (s->v[AT_X] >= 320.0)
        s->v[AT_P] = 4.0;
    s->dx_known = s->y_known = 0;
    eventInfo->nextEventTimeDefined = !s->unused;
    eventInfo->nextEventTime = 5.0;
"""
    files["fmi2.c"] = files["fmi2.c"].replace(old, new)
    old = "(void)eventIndicators;\n    return c && ni == 0 ?"
    assert old in files["fmi2.c"]
    new = "eventIndicators[0] = INSTANCE(c)->state.v[AT_X] - 320.0;\n    return c && ni == 1 ?"
    files["fmi2.c"] = files["fmi2.c"].replace(old, new)
    library = shared_library(files, compiled(files), model.name, host())
    whole = fmu(model, 2, cache=cache)

    def change(name: str, data: bytes) -> tuple[str, bytes]:
        if name.startswith("binaries/"):
            return name, library
        if name == "modelDescription.xml":
            data = data.replace(b'numberOfEventIndicators="0"', b'numberOfEventIndicators="1"')
        return name, data

    return changed(whole, cache / "eventful.fmu", change)


def test_events_are_handled_on_the_way_to_the_operating_point(cache: Path) -> None:
    path = eventful(cache)
    at_5 = 340 - 40 * math.exp(-0.2)  # before the time event
    crossing = 5 + 25 * math.log((340 - at_5 - 1) / 20)
    expected = {
        4.0: (340 - 40 * math.exp(-4 / 25), -0.04),
        6.0: (340 - (340 - at_5 - 1) * math.exp(-1 / 25), -0.04),
        30.0: (315 + 5 * math.exp(-0.08 * (30 - crossing)), -0.08),
    }
    for at, (temperature, slope) in expected.items():
        made = linearise(path, ["power"], ["flow"], at)
        assert made.interface == "Model Exchange"
        assert made.x0 == pytest.approx([temperature], rel=1e-8)
        np.testing.assert_allclose(made.A, [[slope]], atol=1e-6)


class _Lazy:
    """Takes its outputs as up to date once derivatives were asked for, as OpenModelica 1.13."""

    def __init__(self) -> None:
        self.file, self.x, self.y, self.old = self, np.zeros(1), np.zeros(1), True

    def ports(self, names: tuple[str, ...]) -> np.ndarray:
        return np.array(names)

    def set_time(self, t: float) -> None: ...

    def set_states(self, x: np.ndarray) -> None:
        self.x, self.old = np.array(x), True

    def derivatives(self) -> np.ndarray:
        self.old = False
        return -self.x

    def read(self, ports: np.ndarray) -> np.ndarray:
        if self.old:
            self.y, self.old = self.x, False
        return self.y


def test_outputs_are_read_before_the_derivatives() -> None:
    from posmas_fmi.fmu.evaluation import ModelExchangeEquations, Signals

    names = Signals((), ("y",), ("x",), ("der(x)",))
    f = ModelExchangeEquations(_Lazy(), names)  # type: ignore[arg-type]
    assert f(0.0, np.array([3.0]), np.zeros(0))[1] == [3.0]


def test_what_an_fmu_prints_is_no_result(capfd: pytest.CaptureFixture[str]) -> None:
    import ctypes

    from posmas_fmi.fmu.prints import prints_to_stderr

    with prints_to_stderr():
        ctypes.CDLL(None).puts(b"banner")
        os.write(1, b"more\n")
    sys.stdout.write("result\n")
    captured = capfd.readouterr()
    assert captured.out == "result\n"
    assert sorted(captured.err.split()) == ["banner", "more"]
