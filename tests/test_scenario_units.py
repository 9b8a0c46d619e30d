"""Units in a scenario: at ports, signals and connections; converted or refused, with real FMUs."""

from __future__ import annotations

from pathlib import Path

import attrs
import numpy as np
import pytest
from fmu_examples import TANK_C, TANK_TOML
from test_scenario_wiring import LOADS, ROW

from posmas_fmi import load, run
from posmas_fmi.errors import InputError
from posmas_fmi.fmu.about import About, fitted, read_about
from posmas_fmi.fmu.build import fmu
from posmas_fmi.fmu.plant import read_plant
from posmas_fmi.fmu.units import Conversion
from posmas_fmi.scenario.plant import fmu_files, make_instances


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "loads.csv").write_text(LOADS)
    return tmp_path


def scenario(folder: Path, *changes: tuple[str, str]) -> str:
    text = ROW
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / "row.toml"
    path.write_text(text)
    return str(path)


IN_OTHER_UNITS = (
    ("offset = 305.15}", 'offset = 32.0, unit = "degC"}'),
    ("scale = 1e3", 'unit = "kW"'),
    ("value = 293.15", 'value = 68.0\nunit = "degF"'),
)


def test_a_run_in_other_units_is_the_same_run(folder: Path) -> None:
    import xarray

    found = []
    for name, changes in {"plain": (), "units": IN_OTHER_UNITS}.items():
        run(load(scenario(folder, *changes)), folder / name, report=False)
        with xarray.open_dataset(folder / name / "results.nc") as data:
            found.append({key: data[key].values for key in ("y", "heat_load", "facility.header")})
            assert (data["heat_load"].units, data["facility.header"].units) == ("W", "1")
            assert "units" not in data["y"].attrs  # of model (1), which has none
    for key, values in found[0].items():
        np.testing.assert_allclose(found[1][key], values, rtol=1e-9, atol=1e-9)
    assert np.ptp(found[0]["y"]) > 1e-3


WRONG = {
    "port": (("offset = 305.15}", 'unit = "kg/s"}'), "$.plant.outputs", "cannot be converted to K"),
    "signal": (
        ("scale = 1e3", 'scale = 1e3\nunit = "K"'),
        "$.plant.exogenous.heat_load",
        "cannot be converted to W",
    ),
    "connection": (
        ('source = "agents.primary_heat_flow"', 'source = "agents.supply_temperature"'),
        "$.connection[1]",
        "cannot be converted to W (kg.m2.s-3); give scale and offset",
    ),
    "source": (('"agents.kv"', '"agents.kw"'), "$.connection[0].source", "no variable 'kw'"),
    "input": (('"agents.header"', '"agents.heder"'), "$.connection[2].to", "did you mean 'header'"),
    "no input": (
        ('to = "agents.header"', 'to = "agents.supply_temperature"'),
        "$.connection[2].to",
        "'supply_temperature' cannot be set while it runs, its causality is",
    ),
    "array": (('"kv[2]", "heat"]', '"kv"]'), "$.component[0].record", "as 'kv[1]'"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_does_not_fit_is_refused_with_its_place(name: str, folder: Path) -> None:
    change, place, message = WRONG[name]
    read = load(scenario(folder, change))
    with pytest.raises(InputError) as caught:
        make_instances(read, fmu_files(read))
    assert place in str(caught.value)
    assert message in str(caught.value)


def test_a_connection_with_scale_is_the_users(folder: Path) -> None:
    change = ('to = "facility.heat"', 'to = "facility.heat"\nscale = 2.0\noffset = 1.0')
    wrong = ('"agents.primary_heat_flow"', '"agents.valve_position"')
    read = load(scenario(folder, change, wrong))
    made = make_instances(read, fmu_files(read))
    facility = made.specs[-1]
    at = facility.inputs.variables.index("heat")
    extra = made.wiring.extras[-1][at]
    assert [term.weight for term in extra.terms] == [2.0] * 3
    assert extra.bias == 1.0


def tank(folder: Path) -> About:
    (folder / "tank").mkdir()
    (folder / "tank" / "model.toml").write_text(TANK_TOML)
    (folder / "tank" / "model.c").write_text(TANK_C)
    return read_about(fmu(read_plant(folder / "tank"), 2, cache=folder))


def in_units(about: About, **units: str | None) -> About:
    """Return what the same FMU would say with other units."""
    named = dict(about.variables)
    for name, unit in units.items():
        named[name] = attrs.evolve(named[name], unit=unit)
    return attrs.evolve(about, names=attrs.evolve(about.names, by_name=named))


def test_between_two_fmus(tmp_path: Path) -> None:
    kelvin = tank(tmp_path)
    other = in_units(kelvin, temperature="degC", power="kW")
    there = fitted((kelvin, "temperature"), (other, "temperature"))
    assert (there.scale, there.offset) == (1.0, -273.15)
    back = fitted((other, "temperature"), (kelvin, "temperature"))
    assert (back.scale, back.offset) == (1.0, 273.15)
    assert fitted((kelvin, "flow"), (other, "power")).scale == 1e-3
    with pytest.raises(InputError, match=r"'flow' of tank.*\(W\) to 'temperature'.*give scale"):
        fitted((kelvin, "flow"), (other, "temperature"))


def test_one_unit_alone_is_not_guessed(tmp_path: Path) -> None:
    about = tank(tmp_path)
    bare = in_units(about, flow=None)
    with pytest.raises(InputError, match="only one of them has a unit; give scale and offset"):
        fitted((bare, "flow"), (about, "power"))
    assert fitted((bare, "flow"), (bare, "flow")) == Conversion()
