"""Units at the boundary of an FMU: converted exactly, or refused."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fmpy import read_model_description
from fmu_examples import tank_fmu
from hypothesis import given
from hypothesis import strategies as st

from posmas_fmi.errors import BuildError, InputError
from posmas_fmi.fmu.description import model_description
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.model import FmuModel, Variable
from posmas_fmi.fmu.units import BASES, Conversion, Units, parse_unit


@pytest.mark.parametrize(
    ("port", "variable", "value", "expected"),
    [
        ("degC", "K", 20.0, 293.15),
        ("°C", "K", -273.15, 0.0),
        ("degF", "K", 32.0, 273.15),
        ("degF", "degC", 212.0, 100.0),
        ("K", "degC", 300.0, 26.85),
        ("L/min", "m3/s", 60.0, 1e-3),
        ("m3/h", "L/min", 6.0, 100.0),
        ("g/s", "kg/s", 250.0, 0.25),
        ("kg/h", "kg/s", 3600.0, 1.0),
        ("t/h", "kg/s", 3.6, 1.0),
        ("%", "1", 50.0, 0.5),
        ("1", "%", 0.25, 25.0),
        ("kW", "W", 1.5, 1500.0),
        ("J/s", "W", 3.0, 3.0),
        ("kWh", "J", 1.0, 3.6e6),
        ("bar", "Pa", 2.5, 2.5e5),
        ("mbar", "hPa", 7.0, 7.0),
        ("psi", "Pa", 1.0, 6894.757293168362),
        ("kJ/(kg.K)", "J/(kg.degC)", 4.18, 4180.0),
        ("W/(cm2.K)", "W/(m2.K)", 1.0, 1e4),
        ("K/min", "degC/s", 6.0, 0.1),
        ("ms", "s", 5.0, 0.005),
        ("rpm", "rad/s", 60.0, 6.283185307179586),
        ("deg", "rad", 180.0, 3.141592653589793),
        ("min-1", "Hz", 60.0, 1.0),
        ("1/min", "1/s", 60.0, 1.0),
        ("m.s-2", "m/s2", 9.0, 9.0),
        ("uV", "mV", 1000.0, 1.0),
    ],
)
def test_values_are_converted(port: str, variable: str, value: float, expected: float) -> None:
    found = Units({}).conversion(port, variable)
    assert found.scale * value + found.offset == pytest.approx(expected, rel=1e-13, abs=1e-12)


@pytest.mark.parametrize(
    ("port", "variable"),
    [
        ("L/min", "kg/s"),
        ("K", "1"),
        ("W", "J"),
        ("Hz", "rad/s"),
        ("%", "K"),
        ("bar", "kW"),
        ("degC", "m3/s"),
    ],
)
def test_other_dimensions_are_refused(port: str, variable: str) -> None:
    with pytest.raises(InputError, match="cannot be converted"):
        Units({}).conversion(port, variable)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "furlong",
        "kg//s",
        "kg/",
        "kg/s/s",
        "kg/s.K",
        "/s",
        "2",
        "kg s",
        "kkg",
        "m99999",
        "kg/(s",
    ],
)
def test_what_is_no_unit_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="expected a unit"):
        parse_unit(text)
    with pytest.raises(InputError, match="neither known nor defined"):
        Units({}).conversion("K", text)


def test_a_variable_without_unit_takes_none() -> None:
    with pytest.raises(InputError, match=r"does not say in which unit .*; leave the unit out"):
        Units({}).conversion("K", None)


def described(**units: dict[str, float]) -> Units:
    """The units of a description that defines these."""
    zero = dict.fromkeys(BASES, 0) | {"factor": 1.0, "offset": 0.0}
    return Units.read(
        SimpleNamespace(
            unitDefinitions=[
                SimpleNamespace(name=name, baseUnit=SimpleNamespace(**{**zero, **base}))
                for name, base in units.items()
            ]
            + [SimpleNamespace(name="mystery", baseUnit=None)]
        )
    )


def test_what_the_fmu_defines_comes_first_for_its_variables() -> None:
    units = described(degC={"K": 1, "offset": 273.15}, gpm={"m": 3, "s": -1, "factor": 6.3e-5})
    assert units.conversion("K", "degC") == Conversion(1.0, -273.15)
    assert units.conversion("m3/s", "gpm").scale == pytest.approx(1 / 6.3e-5, rel=1e-15)
    assert units.conversion("gpm", "L/s").scale == pytest.approx(0.063, rel=1e-15)
    odd = described(K={"K": 1, "factor": 2.0})
    assert odd.conversion("mK", "K").scale == 0.0005


def test_the_same_name_is_the_same_unit_even_where_it_is_not_defined() -> None:
    units = described()
    assert units.conversion("mystery", "mystery") == Conversion()
    with pytest.raises(InputError, match="'mystery' is neither known nor defined"):
        units.conversion("K", "mystery")


def test_differences_have_no_offset() -> None:
    assert Units({}).conversion("degF", "K", relative=True) == Conversion(5 / 9, 0.0)


KNOWN = st.sampled_from(["K", "degC", "degF", "mK"])


@given(a=KNOWN, b=KNOWN, value=st.floats(-1e3, 1e3))
def test_there_and_back_is_the_same(a: str, b: str, value: float) -> None:
    there, back = Units({}).conversion(a, b), Units({}).conversion(b, a)
    returned = back.scale * (there.scale * value + there.offset) + back.offset
    assert returned == pytest.approx(value, rel=1e-9, abs=1e-9)


THERMAL = (
    *("1", "%", "s", "h", "K", "degC", "degF", "W", "kW", "J", "kWh", "J/(kg.K)", "kJ/(kg.K)"),
    *("W/K", "kW/K", "W/(m2.K)", "kg/s", "kg/h", "t/h", "m3/s", "m3/h", "L/min", "L/s"),
    *("Pa", "kPa", "bar", "mbar", "psi", "rpm", "Hz", "1/K", "m", "m2", "m3", "kg/m3", "Pa.s"),
)


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_units_of_generated_fmus_are_what_their_names_say(tmp_path: Path, fmi: Any) -> None:
    """Also those of the rates of their states; as FMPy reads them."""
    variables = [Variable(f"x{k}", "state", (), (0.0,), unit) for k, unit in enumerate(THERMAL)]
    model = FmuModel("units", "", tuple(variables), {})
    path = tmp_path / "modelDescription.xml"
    path.write_bytes(model_description(model, fmi, ["a.c"]))
    description = read_model_description(str(tmp_path), validate=True)
    defined = Units.read(description).defined
    for variable in model.table:
        unit, expected = defined[variable.unit], parse_unit(variable.unit)
        assert unit.exponents == expected.exponents
        assert float(unit.factor) == float(expected.factor)
        assert float(unit.offset) == float(expected.offset)
    assert float(defined["kPa/s"].factor) == 1000.0
    assert defined["degC/s"].offset == 0


@pytest.mark.parametrize("unit", ["furlong", "kPa/s/m", "", 7])
def test_a_unit_that_is_none_names_variable_and_remedy(unit: Any) -> None:
    told = r"'gap'.*expected a unit like kg/s|gap: expected a unit as text \(got 7\)"
    with pytest.raises(BuildError, match=told):
        model_description(FmuModel("units", "", (Variable("gap", "output", unit=unit),), {}), 3, [])


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_file_converts_to_the_units_of_its_variables(tmp_path: Path, fmi: int) -> None:
    with FmuFile(tank_fmu(tmp_path, fmi)) as file:
        assert file.units.defined["W/K"].dimension == "kg.m2.s-3.K-1"
        assert file.conversion("temperature", "degC") == Conversion(1.0, 273.15)
        assert file.conversion("power", "kW") == Conversion(1000.0, 0.0)
        with pytest.raises(InputError, match=r"tank.*: 'power': K \(K\) cannot be converted to W"):
            file.conversion("power", "K")
