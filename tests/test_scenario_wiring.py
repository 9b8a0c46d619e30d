"""Signals, shared FMUs and connections in a scenario file, with real FMUs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from posmas_fmi import load, run
from posmas_fmi.errors import InputError, ScenarioError

ROW = """
[scenario]
name = "row"
until = 60.0
period = 5.0
tolerance = 100.0

[agent]
A = [[-0.1]]
B = [[0.1]]
C = [[1.0]]

[network]
agents = 3
arcs = [[1, 2], [2, 3], [3, 1]]
pinned = [1]

[design]
method = "gains"
K = [[0.0]]
E = [[0.01]]

[plant]
fmu = "cooling_line"
inputs = {u1 = {variable = "valve", scale = 0.01, offset = 0.7}}
outputs = {y1 = {variable = "supply_temperature", offset = 305.15}}
exogenous = {heat_load = "load"}
record = ["heat_load", "header", "kv"]

[leader]
s0 = [5.0]

[signals.load]
file = "loads.csv"
scale = 1e3

[signals.wet_bulb]
value = 293.15

[[component]]
name = "facility"
fmu = "facility_header"
parameters = {resistance = 1.0}
exogenous = {wet_bulb = "wet_bulb"}
record = ["header", "kv[2]", "heat"]

[[connection]]
source = "agents.kv"
to = "facility.kv[{agent}]"

[[connection]]
source = "agents.primary_heat_flow"
to = "facility.heat"
sum = true

[[connection]]
source = "facility.header"
to = "agents.header"

[report]
baseline = false
"""
LOADS = "time,a,b,c\n0,80,70,90\n22,100,70,60\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "loads.csv").write_text(LOADS)
    return tmp_path


def write(folder: Path, *changes: tuple[str, str]) -> str:
    text = ROW
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / "row.toml"
    path.write_text(text)
    return str(path)


def test_a_row_of_lines_shares_its_facility(folder: Path) -> None:
    import xarray

    result = run(load(write(folder)), folder / "out", report=False)
    assert result.summary["verdict"] in ("converged", "not converged")
    with xarray.open_dataset(folder / "out" / "results.nc") as data:
        assert data["heat_load"].dims == ("time", "agent")
        # while it initialises, an FMU has the first values of its signals already
        np.testing.assert_allclose(data["heat_load"][0], [80e3, 70e3, 90e3])
        # what an FMU shows at t was set for the step that ended there: 22 s is seen from 25 s on
        np.testing.assert_allclose(data["heat_load"][1], [80e3, 70e3, 90e3])
        np.testing.assert_allclose(data["heat_load"][5], [80e3, 70e3, 90e3])
        np.testing.assert_allclose(data["heat_load"][6], [100e3, 70e3, 60e3])
        header, kv = data["facility.header"].values, data["kv"].values
        assert data["facility.header"].dims == ("time",)
        np.testing.assert_array_equal(data["header"][1:, 0], header[:-1])
        np.testing.assert_array_equal(data["facility.kv[2]"][1:], kv[:-1, 1])
        assert np.ptp(header) > 1e-3


def test_a_start_value_of_an_input_goes_before_its_signal(folder: Path) -> None:
    import xarray

    given = ('record = ["heat_load",', 'parameters = {heat_load = 50e3}\nrecord = ["heat_load",')
    run(load(write(folder, given)), folder / "out", report=False)
    with xarray.open_dataset(folder / "out" / "results.nc") as data:
        np.testing.assert_allclose(data["heat_load"][0], 50e3)
        np.testing.assert_allclose(data["heat_load"][1], [80e3, 70e3, 90e3])


WRONG = {
    "signal": (('heat_load = "load"', 'heat_load = "loads"'), "$.plant.exogenous.heat_load"),
    "column": (("scale = 1e3", 'columns = ["a", "d", "c"]'), "$.signals.load.columns"),
    "count": (("scale = 1e3", 'columns = ["a", "b"]'), "$.signals.load.columns"),
    "both": (("value = 293.15", 'value = 1.0\nfile = "loads.csv"'), "$.signals.wet_bulb"),
    "component": (('"facility.header"', '"facilty.header"'), "$.connection[2].source"),
    "no sum": (("sum = true", "sum = false"), "$.connection[1].to"),
    "twice": (('to = "agents.header"', 'to = "agents.heat_load"'), "$.connection[2]"),
    "name": (('name = "facility"', 'name = "agents"'), "$.component[0].name"),
    "FMU": (('fmu = "facility_header"', 'fmu = "header"'), "$.component[0].fmu"),
    "for one": (
        ('wet_bulb = "wet_bulb"', 'wet_bulb = "load"'),
        "$.component[0].exogenous.wet_bulb",
    ),
    "variable": (('record = ["heat_load", "header"', 'record = ["heat", "header"'), "cooling_line"),
}


@pytest.mark.parametrize("name", WRONG)
def test_mistakes_name_their_place(name: str, folder: Path) -> None:
    change, place = WRONG[name]
    with pytest.raises((InputError, ScenarioError)) as caught:
        run(load(write(folder, change)), folder / "out", report=False)
    assert place in str(caught.value)


BAD_FILES = {
    "gap": ("time,a\n0,1\n5,\n", "line 3"),
    "semicolons": ("time;a\n0;1\n", "columns are separated by commas"),
    "not finite": ("time,a\n0,1\n5,nan\n", "line 3: a is not finite"),
    "order": ("time,a\n0,1\n5,2\n4,3\n", "line 4: expected increasing times"),
    "short row": ("time,a\n0\n", "line 2"),
    "empty": ("", "expected a header"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_files_of_signals_name_the_line(name: str, folder: Path) -> None:
    text, message = BAD_FILES[name]
    (folder / "loads.csv").write_text(text)
    with pytest.raises((InputError, ScenarioError), match=message):
        load(write(folder))


def test_a_missing_file_of_a_signal(folder: Path) -> None:
    with pytest.raises((InputError, ScenarioError), match=r"no file 'other\.csv'"):
        load(write(folder, ('file = "loads.csv"', 'file = "other.csv"')))


def netcdf(folder: Path, **changes: object) -> None:
    import xarray

    given = {
        "load": (("time", "agent"), np.array([[80.0, 70.0, 90.0], [100.0, 70.0, 60.0]])),
        "other": (("time",), np.array([1.0, 2.0])),
        "time": ("time", np.array([0.0, 22.0]), {"units": "s"}),
    } | changes
    xarray.Dataset(given).to_netcdf(folder / "loads.nc", engine="h5netcdf")


NC = (('file = "loads.csv"', 'file = "loads.nc"\ncolumns = ["load"]'),)


def test_signals_from_netcdf(folder: Path) -> None:
    netcdf(folder)
    of_csv, of_netcdf = (load(write(folder, *change)).signals for change in ((), NC))
    assert of_csv is not None
    assert of_netcdf is not None
    np.testing.assert_array_equal(of_csv.rows(0, 12), of_netcdf.rows(0, 12))


BAD_NETCDF = {
    "gap": ({"load": (("time", "agent"), np.array([[1.0, 2.0, 3.0], [1.0, np.nan, 3.0]]))}, "gap"),
    "unit": ({"time": ("time", np.array([0.0, 1.0]), {"units": "h"})}, "time in s"),
    "order": ({"time": ("time", np.array([1.0, 0.0]), {"units": "s"})}, "increasing times"),
    "columns": ({"load": (("time", "agent"), np.ones((2, 2)))}, "one for each agent"),
    "missing": (
        {"load": (("time", "agent"), np.array([[1.0, -99.0, 3.0]] * 2), {"missing_value": -99.0})},
        "fill the gap",
    ),
}


@pytest.mark.parametrize("name", BAD_NETCDF)
def test_netcdf_that_is_no_signal(name: str, folder: Path) -> None:
    changes, message = BAD_NETCDF[name]
    netcdf(folder, **changes)
    with pytest.raises((InputError, ScenarioError), match=message):
        load(write(folder, *NC))


def test_a_unit_that_contradicts_the_scenario(folder: Path) -> None:
    netcdf(folder, load=(("time", "agent"), np.ones((2, 3)), {"units": "MW"}))
    (change,) = NC
    for unit, more in (("kW", ""), ("kW", "scale = 1e3"), ("MW", "")):
        scale = ("scale = 1e3", f'unit = "{unit}"\n{more}')
        path = write(folder, change, scale)
        if unit == "kW" and not more:
            with pytest.raises((InputError, ScenarioError), match="the file says 'MW'"):
                load(path)
        else:
            assert load(path).signals is not None


def test_packed_netcdf(folder: Path) -> None:
    """Integers with scale_factor and add_offset, as weather services write them."""
    values = np.array([[80, 70, 90], [100, 70, 60]])
    how = {"scale_factor": 0.5, "add_offset": 10.0}
    netcdf(folder, load=(("time", "agent"), 2 * (values - 10), how))
    of_csv, of_netcdf = (load(write(folder, *change)).signals for change in ((), NC))
    assert of_csv is not None
    assert of_netcdf is not None
    np.testing.assert_array_equal(of_csv.rows(0, 12), of_netcdf.rows(0, 12))


def test_netcdf_that_says_to_hold_terabytes(folder: Path) -> None:
    import h5netcdf

    with h5netcdf.File(folder / "loads.nc", "w") as file:
        file.dimensions = {"time": 10**12}
        for name in ("time", "load"):
            file.create_variable(name, ("time",), float, chunks=(1000,))
    with pytest.raises((InputError, ScenarioError), match="more than 1e"):
        load(write(folder, *NC))


def test_what_is_no_netcdf(folder: Path) -> None:
    (folder / "loads.nc").write_bytes(b"nonsense")
    with pytest.raises((InputError, ScenarioError), match="expected a NetCDF-4 file"):
        load(write(folder, *NC))
