"""Generated FMUs against SciPy and NumPy: Co-Simulation, Model Exchange, state, derivatives."""

from __future__ import annotations

from pathlib import Path

import fmpy
import numpy as np
import pytest
from fmu_examples import Example, example_1, named, tank_fmu, vector, wide
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from posmas_fmi.errors import FmuError
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.instance import FmuInstance

START = {"x": [1.0, 0.3]}


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fmus")


@pytest.fixture(scope="module", params=[2, 3])
def file(request: pytest.FixtureRequest, cache: Path):
    with FmuFile(example_1().fmu(request.param, cache)) as opened:
        yield opened


@pytest.fixture
def instance(file: FmuFile):
    with file.instantiate("agent") as made:
        made.initialise(named(example_1().matrices | START, file.version))
        yield made


def run(instance: FmuInstance, times: np.ndarray, inputs: np.ndarray, outputs: list[str]):
    to = instance.file.ports(vector("u", inputs.shape[1]))
    of = instance.file.ports(outputs)
    result = [instance.read(of)]
    for k in range(len(times) - 1):
        instance.write(to, inputs[k])
        instance.do_step(times[k], times[k + 1] - times[k])
        result.append(instance.read(of))
    return np.array(result)


def steps(times: np.ndarray, p: int = 1) -> np.ndarray:
    """A piecewise constant input with jumps, a pause and both signs."""
    held = 0.8 * np.sign(np.sin(2.3 * times)) * (times % 3 > 1)
    return np.column_stack([held * (k + 1) / p for k in range(p)])


# ---- Co-Simulation ------------------------------------------------------------------------------


@pytest.mark.parametrize("period", [0.5, 0.1, 0.01])
def test_co_simulation_agrees_with_scipy(instance: FmuInstance, period: float) -> None:
    times = np.arange(round(5 / period) + 1) * period
    inputs = steps(times)
    states = run(instance, times, inputs, vector("x", 2))
    expected = example_1().trajectory(START["x"], times, inputs)
    assert np.abs(states - expected).max() < 1e-8


@pytest.mark.parametrize("fmi", [2, 3])
def test_other_sizes_agree_with_scipy(cache: Path, fmi: int) -> None:
    example, x = wide(), [0.5, 1.5, 2.0]
    times = np.linspace(0, 4, 41)
    inputs = steps(times, 2)
    with FmuFile(example.fmu(fmi, cache)) as file, file.instantiate("wide") as instance:
        instance.initialise(named(example.matrices | {"x": x}, fmi))
        result = run(instance, times, inputs, [*vector("x", 3), *vector("y", 1)])
    expected = example.trajectory(x, times, inputs)
    assert np.abs(result[:, :3] - expected).max() < 1e-8
    assert np.abs(result[:, 3:] - expected @ example.C.T).max() < 1e-8


def test_steps_of_different_lengths_agree_with_scipy(instance: FmuInstance) -> None:
    rng = np.random.default_rng(1)
    times = np.concatenate([[0.0], np.cumsum(10.0 ** rng.uniform(-5, -0.3, size=60))])
    inputs = steps(times)
    states = run(instance, times, inputs, vector("x", 2))
    assert np.abs(states - example_1().trajectory(START["x"], times, inputs)).max() < 1e-8


def test_a_looser_tolerance_costs_accuracy_and_is_honoured(file: FmuFile) -> None:
    errors = []
    for tolerance in (1e-4, 1e-12):
        with file.instantiate("agent") as instance:
            values = named(example_1().matrices | START, file.version)
            instance.initialise(values, tolerance=tolerance)
            times = np.array([0.0, 5.0])
            states = run(instance, times, np.zeros((2, 1)), vector("x", 2))
        expected = example_1().trajectory(START["x"], times, np.zeros((2, 1)))
        errors.append(np.abs(states - expected).max())
    assert errors[1] < 1e-9 < errors[0] < 1e-2


def test_starts_later_and_stops_where_promised(file: FmuFile) -> None:
    with file.instantiate("agent") as instance:
        values = named(example_1().matrices | START, file.version)
        instance.initialise(values, start=2.0, stop=3.0)
        times = np.array([2.0, 2.4, 3.0])
        states = run(instance, times, np.zeros((3, 1)), vector("x", 2))
        expected = example_1().trajectory(START["x"], times, np.zeros((3, 1)))
        assert np.abs(states - expected).max() < 1e-8


def test_parameters_may_be_tuned_between_steps(file: FmuFile, instance: FmuInstance) -> None:
    instance.do_step(0.0, 0.5)
    x = instance.read(file.ports(vector("x", 2)))
    instance.set(named({"H": np.zeros((2, 2)), "u": [0.0]}, file.version))
    instance.do_step(0.5, 0.5)
    linear = solve_ivp(
        lambda _, x: example_1().A @ x, (0, 0.5), x, rtol=1e-10, atol=1e-12, method="DOP853"
    )
    assert instance.read(file.ports(vector("x", 2))) == pytest.approx(linear.y[:, -1], abs=1e-8)


def test_a_hundred_instances_are_independent(file: FmuFile) -> None:
    example, count = example_1(), 100
    rng = np.random.default_rng(2)
    starts = rng.uniform(0, 2, size=(count, 2))
    of, to = file.ports(vector("x", 2)), file.ports(["u[1]"])
    instances = [file.instantiate(f"agent {k}") for k in range(count)]
    for instance, x in zip(instances, starts, strict=True):
        instance.initialise(named(example.matrices | {"x": x}, file.version))
    for k in range(10):
        for j, instance in enumerate(instances):
            instance.write(to, [0.01 * j])
            instance.do_step(0.1 * k, 0.1)
    together = np.array([instance.read(of) for instance in instances])
    for instance in instances:
        instance.free()
    for j in range(0, count, 9):
        with file.instantiate("alone") as alone:
            alone.initialise(named(example.matrices | {"x": starts[j]}, file.version))
            for k in range(10):
                alone.write(to, [0.01 * j])
                alone.do_step(0.1 * k, 0.1)
            assert (alone.read(of) == together[j]).all()


# ---- FMPy as the importer -----------------------------------------------------------------------


def signals(fmi: int, times: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """FMPy's input table with each value held: two rows where it changes."""
    name, shape = ("u[1]", ()) if fmi == 2 else ("u", (1,))
    rows = []
    for k in range(len(times) - 1):
        rows += [(times[k], inputs[k]), (times[k + 1], inputs[k])]
    table = np.zeros(len(rows), dtype=[("time", float), (name, float, shape)])
    table["time"] = [t for t, _ in rows]
    table[name] = np.array([u for _, u in rows]).reshape(table[name].shape)
    return table


@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
@pytest.mark.parametrize("fmi", [2, 3])
def test_fmpy_simulates_and_records_x(cache: Path, fmi: int, kind: str) -> None:
    example = example_1()
    times = np.linspace(0, 2, 11)
    inputs = steps(times)
    values = {n: v.ravel() for n, v in example.matrices.items()} | START
    result = fmpy.simulate_fmu(
        str(example.fmu(fmi, cache)),
        fmi_type=kind,
        start_time=0,
        stop_time=2,
        output_interval=0.2,
        relative_tolerance=1e-12,
        start_values=named(values if fmi == 3 else example.matrices | START, fmi),
        input=signals(fmi, times, inputs),
        output=["x", "y"] if fmi == 3 else [*vector("x", 2), *vector("y", 2)],
        record_events=False,
    )
    found = np.array(
        [np.concatenate([np.ravel(row[n]) for n in result.dtype.names[1:]]) for row in result]
    )
    at = np.searchsorted(result["time"], times - 1e-9)
    expected = example.trajectory(START["x"], times, inputs)
    assert np.abs(found[at, :2] - expected).max() < 1e-8
    assert np.abs(found[at, 2:] - expected @ example.C.T).max() < 1e-8


@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
@pytest.mark.parametrize("fmi", [2, 3])
def test_fmpy_simulates_with_nothing_but_the_file(cache: Path, fmi: int, kind: str) -> None:
    result = fmpy.simulate_fmu(str(tank_fmu(cache, fmi)), fmi_type=kind, stop_time=50)
    temperature = 340 - 40 * np.exp(-result["time"] * 2 / 50)
    assert result["net"] == pytest.approx(100 - 2 * (temperature - 290), abs=1e-2)


# ---- state --------------------------------------------------------------------------------------


def test_a_saved_state_replays_bit_for_bit(instance: FmuInstance) -> None:
    times = np.linspace(0, 1, 14)
    inputs = steps(3 * times)
    names = [*vector("x", 2), *vector("y", 2)]
    run(instance, times, inputs, names)
    later = times + 1.0
    with instance.get_state() as state:
        first = run(instance, later, inputs, names)
        instance.set_state(state)
        assert instance.time == pytest.approx(1.0)
        again = run(instance, later, inputs, names)
    assert (first == again).all()


def test_serialised_state_continues_in_another_instance(
    file: FmuFile, instance: FmuInstance
) -> None:
    times = np.linspace(0, 1, 14)
    names = [*vector("x", 2), *vector("y", 2)]
    run(instance, times, steps(3 * times), names)
    data = instance.serialise()
    assert instance.serialise() == data
    first = run(instance, times + 1.0, steps(times), names)
    with file.instantiate("other") as other:
        other.deserialise(data, 1.0)
        assert other.serialise() == data
        assert (run(other, times + 1.0, steps(times), names) == first).all()


def test_reset_gives_a_fresh_instance(file: FmuFile, instance: FmuInstance) -> None:
    times, names = np.linspace(0, 1, 5), vector("x", 2)
    first = run(instance, times, steps(times), names)
    instance.reset()
    instance.initialise(named(example_1().matrices | START, file.version))
    assert (run(instance, times, steps(times), names) == first).all()


def test_a_state_outlives_neither_instance_nor_file(file: FmuFile) -> None:
    instance = file.instantiate("agent")
    instance.initialise()
    state = instance.get_state()
    instance.free()
    state.free()  # was freed with the instance: nothing happens
    with pytest.raises(FmuError, match="freed"):
        instance.set_state(state)


# ---- derivatives --------------------------------------------------------------------------------

VALUES = st.floats(-3, 3).map(lambda value: round(value, 3))


@settings(max_examples=40, deadline=None)
@given(
    matrices=st.lists(VALUES, min_size=2 * 9 + 6 + 3, max_size=2 * 9 + 6 + 3),
    x=st.lists(VALUES, min_size=3, max_size=3),
    u=st.lists(VALUES, min_size=2, max_size=2),
    seed=st.lists(VALUES, min_size=5, max_size=5),
    t=st.floats(0, 10),
    fmi=st.sampled_from([2, 3]),
)
def test_derivatives_are_those_of_the_equations(cache, matrices, x, u, seed, t, fmi) -> None:
    base, flat = wide(), np.array(matrices)
    example = Example(
        flat[:9].reshape(3, 3),
        flat[9:18].reshape(3, 3),
        flat[18:24].reshape(3, 2),
        flat[24:].reshape(1, 3),
        base.g,
        base.sec,
    )
    slope_g = base.g.derivative(["x1", "x2", "x3"]).numpy()(t, *x).reshape(3, 3)
    slope_sec = base.sec.derivative(["u1", "u2"]).numpy()(*u).reshape(2, 2)
    seed = np.array(seed)
    along = (example.A + example.H @ slope_g) @ seed[:3] + example.B @ slope_sec @ seed[3:]
    with FmuFile(base.fmu(fmi, cache)) as file, file.instantiate("wide") as instance:
        instance.initialise(named(example.matrices | {"x": x, "u": u}, fmi), start=t)
        found = instance.read(file.ports(f"der({name})" for name in vector("x", 3)))
        jvp = instance.directional_derivative(
            [*(f"der({name})" for name in vector("x", 3)), "y[1]"],
            [*vector("x", 3), *vector("u", 2)],
            seed,
        )
        assert found == pytest.approx(example.derivative()(t, x, u), rel=1e-12, abs=1e-12)
    assert jvp[:3] == pytest.approx(along, rel=1e-12, abs=1e-12)
    assert jvp[3:] == pytest.approx(example.C @ seed[:3], rel=1e-12, abs=1e-12)


def test_directional_derivatives_agree_with_finite_differences(file: FmuFile) -> None:
    example, x, u, h = example_1(), np.array([0.7, 1.9]), 0.4, 1e-6
    unknowns = ["der(x[1])", "der(x[2])", "y[1]", "y[2]"]

    def values(point: np.ndarray) -> np.ndarray:
        with file.instantiate("agent") as instance:
            start = {"x": point[:2], "u": point[2:]}
            instance.initialise(named(example.matrices | start, file.version), start=3.0)
            return instance.read(file.ports(unknowns))

    point = np.array([*x, u])
    with file.instantiate("agent") as instance:
        start = {"x": x, "u": [u]}
        instance.initialise(named(example.matrices | start, file.version), start=3.0)
        for k, known in enumerate(["x[1]", "x[2]", "u[1]"]):
            step = h * np.eye(3)[k]
            differences = (values(point + step) - values(point - step)) / (2 * h)
            found = instance.directional_derivative(unknowns, [known], [1.0])
            assert found == pytest.approx(differences, abs=1e-7)


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_plant_written_in_c(cache: Path, fmi: int) -> None:
    with FmuFile(tank_fmu(cache, fmi)) as file, file.instantiate("tank") as instance:
        assert file.variables["temperature"].unit == "K"
        assert file.variables["temperature"].nominal == 300.0
        assert file.variables["flow"].causality == "local"
        instance.initialise({"power": 50.0})
        assert instance.get("net") == pytest.approx(30.0)
        instance.do_step(0.0, 10.0)
        expected = 315 - 15 * np.exp(-10 * 2 / 50)
        assert instance.get("temperature") == pytest.approx(expected, abs=1e-6)
        assert instance.get("flow") == pytest.approx(2 * (expected - 290), abs=1e-6)
        slope = instance.directional_derivative(["net", "flow"], ["power"], [1.0])
        assert slope.tolist() == [1.0, 0.0]
