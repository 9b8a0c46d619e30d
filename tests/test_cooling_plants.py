"""The plants cooling_line and facility_header: energy, positivity, derivatives, state, coupling."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest

from posmas_fmi.cooling import LineParameters, header_values, line_values
from posmas_fmi.cooling.exchanger import conductance
from posmas_fmi.fmu.build import fmu
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.instance import FmuInstance
from posmas_fmi.fmu.plant import read_plant, shipped_plants
from posmas_fmi.fmu.sources import compiled, sources

LINE = LineParameters()
PLANTS = ("cooling_line", "facility_header")
TEMPERATURES = ("T_plate", "T_return", "T_return_pipe", "T_supply", "T_supply_pipe")
needs_cc = pytest.mark.skipif(not shutil.which("gcc"), reason="needs gcc")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[tuple[str, int], FmuFile]]:
    cache = tmp_path_factory.mktemp("plants")
    opened = {
        (name, fmi): FmuFile(fmu(read_plant(shipped_plants()[name]), fmi, cache=cache))
        for name in PLANTS
        for fmi in (2, 3)
    }
    yield opened
    for file in opened.values():
        file.close()


def names(model: str, role: str) -> list[str]:
    table = read_plant(shipped_plants()[model]).table
    return [name for v in table if v.role == role for name in v.elements]


def values_at(file: FmuFile, given: dict[str, float], wanted: list[str]) -> np.ndarray:
    """Computed values at a point, from an instance in Initialization Mode."""
    with file.instantiate("point") as instance:
        instance.enter_initialization()
        instance.set(given)
        return np.array([instance.get(name) for name in wanted])


def random_point(model: str, random: np.random.Generator) -> dict[str, float]:
    """Inputs and states in the range of operation, away from limits."""
    if model == "cooling_line":
        point = {
            "heat_load": random.uniform(0, 130e3),
            "valve": random.uniform(0.05, 0.95),
            "pump": random.uniform(0.05, 1.2),
            "header": random.uniform(0.1, 4.0),
            "facility_temperature": random.uniform(285, 320),
            "position": random.uniform(0, 1),
            "speed": random.uniform(0.01, 1.2),
            "energy_in": 0.0,
            "energy_out": 0.0,
        }
        return point | {name: random.uniform(290, 370) for name in TEMPERATURES}
    kv = {f"kv[{k + 1}]": random.uniform(0, 1) for k in range(64)}
    supply = random.uniform(290, 310)
    return kv | {
        "kv_others": random.uniform(0, 5),
        "heat": random.uniform(0, 1e6),
        "wet_bulb": random.uniform(280, 305),
        "pressure": random.uniform(0.2, 2),
        "T_supply": supply,
        "energy_in": 0.0,
        "energy_out": 0.0,
    }


# ---- sources ------------------------------------------------------------------------------------


@needs_cc
@pytest.mark.parametrize("name", PLANTS)
def test_the_c_sources_have_no_warnings(tmp_path: Path, name: str) -> None:
    written = sources(read_plant(shipped_plants()[name]), 3)
    for file, text in written.items():
        (tmp_path / file).write_text(text, encoding="utf-8")
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wshadow", "-Wconversion"]
    command = ["gcc", *flags, "-Wno-sign-conversion", "-O2", "-c", *compiled(written)]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert run.stderr == ""


@pytest.mark.parametrize("name", PLANTS)
def test_every_quantity_has_its_unit(files: Any, name: str) -> None:
    for fmi in (2, 3):
        file = files[name, fmi]
        for variable in file.variables:
            if variable.startswith(("T_", "energy", "heat")) or "temperature" in variable:
                assert file.variable(variable).unit in ("K", "J", "W"), variable


# ---- energy -------------------------------------------------------------------------------------


def drive(instance: FmuInstance, steps: int = 360, period: float = 10.0) -> None:
    """An hour of load swings, valve strokes and a pump trip."""
    for k in range(steps):
        t = k * period
        instance.set(
            {
                "heat_load": 80e3 + 50e3 * np.sin(t / 300),
                "valve": 0.6 + 0.5 * np.sin(t / 170),
                "pump": 0.0 if 1200 <= t < 1260 else 1.0,
                "header": 1.0 if t < 1800 else 0.4,
                "facility_temperature": 305.15 + 4 * np.sin(t / 900),
            }
        )
        instance.do_step(t, period)


@pytest.mark.parametrize("tolerance", [1e-10, 1e-4])
@pytest.mark.parametrize("fmi", [2, 3])
def test_the_lines_energy_balance_closes(files: Any, fmi: int, tolerance: float) -> None:
    with files["cooling_line", fmi].instantiate("line") as line:
        line.initialise(tolerance=tolerance)
        stored = line.get("stored_energy")
        drive(line)
        taken, given = line.get("energy_in"), line.get("energy_out")
        assert taken > 1e8  # J: there is something to balance
        assert abs(taken - given - (line.get("stored_energy") - stored)) <= 1e-9 * taken


def test_the_lines_heat_is_the_integral_of_its_heat_flows(files: Any) -> None:
    with files["cooling_line", 3].instantiate("line") as line:
        line.initialise()
        released, cooled = [line.get("heat_released")], [line.get("primary_heat_flow")]
        line.set({"heat_load": 100e3})
        for k in range(3000):
            if k == 0:
                released[0] = line.get("heat_released")
            line.do_step(0.1 * k, 0.1)
            released.append(line.get("heat_released"))
            cooled.append(line.get("primary_heat_flow"))
        for name, flow in (("energy_in", released), ("energy_out", cooled)):
            assert line.get(name) == pytest.approx(np.trapezoid(flow, dx=0.1), rel=1e-6)


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_headers_energy_balance_closes(files: Any, fmi: int) -> None:
    with files["facility_header", fmi].instantiate("header") as header:
        header.initialise()
        stored = header.get("stored_energy")
        for k in range(360):
            t = 10.0 * k
            header.set({"heat": 640e3 + 300e3 * np.sin(t / 300), "wet_bulb": 290 + 12 * (t > 1500)})
            header.do_step(t, 10.0)
        taken, given = header.get("energy_in"), header.get("energy_out")
        assert abs(taken - given - (header.get("stored_energy") - stored)) <= 1e-9 * taken


# ---- positivity ---------------------------------------------------------------------------------


def test_positivity_of_the_line_is_structural(files: Any) -> None:
    random = np.random.default_rng(1)
    with files["cooling_line", 3].instantiate("line") as line:
        line.enter_initialization()
        rates = [f"der({name})" for name in TEMPERATURES]
        for _ in range(300):
            line.set(random_point("cooling_line", random))
            knowns = [*TEMPERATURES, "facility_temperature"]
            slope = np.array(
                [line.directional_derivative(rates, knowns, e) for e in np.eye(len(knowns))]
            ).T
            off = slope - np.diag(np.diag(slope))[:, :5] @ np.eye(5, 6)
            assert (off >= -1e-15).all()  # κ = w to rounding where the coolant hardly flows


def test_no_command_takes_a_temperature_below_the_facility_supply(files: Any) -> None:
    """No load and a valve thrown open: there the additive form goes to -7 K."""
    with files["cooling_line", 3].instantiate("line") as line:
        line.initialise(line_values(LINE, load=5e3))
        lowest = np.inf
        for k in range(360):
            line.set({"heat_load": 0.0, "valve": float(k % 20 < 10) * 1e3 - 1, "header": 4.0})
            line.do_step(10.0 * k, 10.0)
            lowest = min(lowest, *(line.get(name) - 305.15 for name in TEMPERATURES))
        assert -1e-12 <= lowest < 0.01  # K: a temperature of 305 K is rounded to 6e-14


# ---- the plant and the design model -------------------------------------------------------------


@pytest.mark.parametrize("power", [40e3, 80e3, 130e3])
@pytest.mark.parametrize("fmi", [2, 3])
def test_the_steady_state_of_the_design_model_is_the_plants(
    files: Any, power: float, fmi: int
) -> None:
    """Pipes and valve change how a line gets there, not where it rests."""
    for line in (LINE, LINE.sized(power)):
        with files["cooling_line", fmi].instantiate("line") as instance:
            instance.initialise(line_values(line, load=power, y=0.8))
            rates = [instance.get(f"der({name})") for name in TEMPERATURES]
            np.testing.assert_allclose(rates, 0.0, atol=1e-9)
            assert instance.get("supply_temperature") == pytest.approx(
                305.15 + line.steady(power, 0.8)[2]
            )


def test_the_valve_takes_its_stroke_time(files: Any) -> None:
    with files["cooling_line", 3].instantiate("line") as line:
        line.initialise({"position": 0.0, "valve": 1.0})
        line.do_step(0.0, 60.0)
        assert line.get("valve_position") == pytest.approx(0.5, abs=1e-6)
        line.do_step(60.0, 80.0)
        assert line.get("valve_position") == pytest.approx(1.0, abs=1e-4)


def test_a_pump_trip_heats_the_plates_until_the_pump_is_back(files: Any) -> None:
    with files["cooling_line", 3].instantiate("line") as line:
        line.initialise({"pump": 0.0})
        line.do_step(0.0, 30.0)
        hot = line.get("case_temperature")
        line.set({"pump": 1.0})
        line.do_step(30.0, 600.0)
        assert hot > 331.85 + 15
        assert line.get("case_temperature") == pytest.approx(331.85, abs=0.1)


@pytest.mark.parametrize("resistance", [0.0, 3.0])
def test_the_headers_pressure(files: Any, resistance: float) -> None:
    values = header_values(LINE, 8, shortage=resistance)
    kv = np.zeros(64)
    kv[:3] = 1.0
    with files["facility_header", 3].instantiate("header") as header:
        header.initialise({**values, "kv": kv, "kv_others": 2.0})
        header.do_step(0.0, 60.0)
        share = 5.0 / values["kv_nominal"]
        expected = (1 + resistance) / (1 + resistance * share**2)
        assert header.get("header") == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    ("wet_bulb", "chiller", "expected"),
    [
        (285.15, 0.0, 305.15),  # the control holds the supply at nominal heat
        (303.15, 0.0, 309.15),  # wet bulb + approach of 6 K
        (303.15, 320e3, 306.15),  # half of the heat by the chiller: half the approach
    ],
)
def test_the_headers_supply_temperature(
    files: Any, wet_bulb: float, chiller: float, expected: float
) -> None:
    values = header_values(LINE, 8)
    with files["facility_header", 3].instantiate("header") as header:
        header.initialise({**values, "wet_bulb": wet_bulb, "chiller": chiller})
        header.do_step(0.0, 7200.0)
        assert header.get("facility_temperature") == pytest.approx(expected, abs=1e-3)


def test_a_line_that_opens_takes_water_from_the_others(files: Any) -> None:
    with (
        files["facility_header", 3].instantiate("header") as header,
        files["cooling_line", 3].instantiate("quiet") as quiet,
        files["cooling_line", 3].instantiate("greedy") as greedy,
    ):
        header.initialise({**header_values(LINE, 2, shortage=3.0), "kv": np.zeros(64)})
        lines = (quiet, greedy)
        for line in lines:
            line.initialise(line_values(LINE))
        greedy.set({"valve": 1.0})
        for k in range(240):
            t = 5.0 * k
            kv = np.zeros(64)
            kv[:2] = [line.get("kv") for line in lines]
            header.set({"kv": kv, "heat": sum(line.get("primary_heat_flow") for line in lines)})
            for line in lines:
                line.set({name: header.get(name) for name in ("header", "facility_temperature")})
            for instance in (header, *lines):
                instance.do_step(t, 5.0)
        assert header.get("header") < 0.6
        assert quiet.get("supply_temperature") > 310.15 + 0.5
        assert greedy.get("supply_temperature") < 310.15 - 0.5


# ---- interfaces ---------------------------------------------------------------------------------


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("model", PLANTS)
def test_directional_derivatives(files: Any, model: str, fmi: int) -> None:
    file, random = files[model, fmi], np.random.default_rng(2)
    knowns = [*names(model, "input"), *names(model, "state")]
    unknowns = [*names(model, "derivative"), *names(model, "output"), *names(model, "local")]
    size = np.array([max(abs(file.variable(n).nominal), 1.0) for n in knowns])
    size[[n in ("heat_load", "heat") for n in knowns]] = 1e3
    for _ in range(12):
        point = random_point(model, random)
        seed = size * random.standard_normal(len(knowns))
        with file.instantiate("point") as instance:
            instance.enter_initialization()
            instance.set(point)
            exact = instance.directional_derivative(unknowns, knowns, seed)
        step = 1e-6
        around = [
            values_at(
                file,
                {n: point[n] + sign * step * s for n, s in zip(knowns, seed, strict=True)},
                unknowns,
            )
            for sign in (1, -1)
        ]
        change = (around[0] - around[1]) / (2 * step)
        scale = np.abs(np.array(around)).max(axis=0)
        np.testing.assert_array_less(
            np.abs(exact - change), 1e-5 * np.abs(exact) + 3e-9 * scale + 1e-7
        )


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_state_replays_to_the_bit(files: Any, fmi: int) -> None:
    def end(line: FmuInstance) -> list[float]:
        for k in range(60):
            line.do_step(100.0 + 5 * k, 5.0)
        return [line.get(name) for name in names("cooling_line", "state")]

    with files["cooling_line", fmi].instantiate("line") as line:
        line.initialise({"heat_load": 120e3, "valve": 0.3})
        line.do_step(0.0, 100.0)
        data = line.serialise()
        with line.get_state() as state:
            first = end(line)
            line.set_state(state)
            assert end(line) == first
    with files["cooling_line", fmi].instantiate("other") as other:
        other.initialise()
        other.deserialise(data, 100.0)
        assert end(other) == first


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("model", PLANTS)
def test_model_exchange_agrees_with_co_simulation(files: Any, model: str, fmi: int) -> None:
    path = str(files[model, fmi].path)
    changed = {"cooling_line": {"heat_load": 120e3}, "facility_header": {"heat": 9e5}}[model]
    options: dict[str, Any] = {
        "stop_time": 300.0,
        "output_interval": 10.0,
        "start_values": changed,
        "output": names(model, "output"),
    }
    co = fmpy.simulate_fmu(path, fmi_type="CoSimulation", **options)
    me = fmpy.simulate_fmu(path, fmi_type="ModelExchange", relative_tolerance=1e-9, **options)
    for name in options["output"]:
        np.testing.assert_allclose(me[name][-1], co[name][-1], rtol=1e-6)


# ---- the Modelica source ------------------------------------------------------------------------


def modelica_equations(text: str) -> list[tuple[str, str, str]]:
    """Statements of the equation section: (unknown, its factor, right-hand side), as Python."""
    section = text.split("\nequation\n")[1].split("annotation")[0]
    found = []
    for statement in filter(None, (part.strip() for part in section.split(";"))):
        left, right = (side.strip() for side in statement.replace("\n", " ").split(" = ", 1))
        right = right.replace("^", "**")
        right = re.sub(r"^if (.*) then (.*) else (.*)$", r"(\2) if (\1) else (\3)", right)
        match = re.fullmatch(r"(?:(\w+)\*)?(der\(\w+\)|\w+)", left)
        assert match, left
        found.append((match[2], match[1] or "1", right))
    return found


@pytest.mark.parametrize(
    ("model", "file"),
    [("cooling_line", "CoolingLine.mo"), ("facility_header", "FacilityHeader.mo")],
)
def test_the_modelica_source_has_the_same_equations(files: Any, model: str, file: str) -> None:
    text = (shipped_plants()[model] / file).read_text(encoding="utf-8")
    parameters = dict(re.findall(r"parameter Real (\w+)(?:\(.*?\))? =\s*([-+.\de]+)", text))
    parameters = {name: float(value) for name, value in parameters.items()}
    table = read_plant(shipped_plants()[model]).table
    assert parameters == {v.name: v.start[0] for v in table if v.role == "parameter"}
    starts = dict(re.findall(r"Real (\w+)\((?:.*?, )?start=([-+.\de]+)", text))
    for v in table:
        if v.role in ("input", "state") and not v.shape:
            assert float(starts[v.name]) == v.start[0], v.name
    random = np.random.default_rng(3)
    wanted = [*names(model, "derivative"), *names(model, "output"), *names(model, "local")]
    functions = {"exchange": conductance, "tanh": np.tanh, "sqrt": np.sqrt, "min": min, "max": max}
    for _ in range(20):
        point = random_point(model, random)
        scope = {**functions, **parameters, **point, "sum": sum}
        if model == "facility_header":
            scope["kv"] = [point[f"kv[{k + 1}]"] for k in range(64)]
        rates = {}
        for unknown, factor, right in modelica_equations(text):
            value = eval(right, {"__builtins__": {}}, scope) / eval(factor, {}, scope)
            if unknown.startswith("der("):
                rates[unknown] = value
            else:
                scope[unknown] = value
        expected = values_at(files[model, 3], point, wanted)
        mine = [float(rates[n] if n.startswith("der(") else scope[n]) for n in wanted]
        np.testing.assert_allclose(mine, expected, rtol=1e-10, atol=1e-9)
