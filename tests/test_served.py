"""FMUs whose calls go through Python, in the same loops as all others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray
from fmu_scenarios import one_fmu
from test_fmu_types import VALVE

from posmas_fmi import load, run
from posmas_fmi.cosim.fmu_plant import FmuPlant, PlantSpec, PortMap
from posmas_fmi.errors import FmuCallError


@pytest.fixture(scope="module")
def valve(tmp_path_factory: pytest.TempPathFactory) -> Path:
    builder = pytest.importorskip("pythonfmu.builder", reason="pythonfmu is not installed")
    script = tmp_path_factory.mktemp("pythonfmu") / "valve.py"
    script.write_text(VALVE, encoding="utf-8")
    return Path(builder.FmuBuilder.build_FMU(script, dest=script.parent))


def ports(*names: str, scale: float = 1.0, offset: float = 0.0) -> PortMap:
    n = len(names)
    return PortMap(names, (scale,) * n, (offset,) * n, (None,) * n, "here")


def test_integers_and_booleans_are_ports(valve: Path) -> None:
    spec = PlantSpec(
        valve,
        {"label": "a"},
        "v",
        ports("stage", "open", "flow", scale=2.0),
        ports("seen_flow", "seen_stage", "seen_open", scale=2.0),
    )
    which, readings = np.arange(2), np.zeros(6)
    inputs = np.array([3.2, 1.0, 0.25, -4.0, 0.0, 7.0])
    with FmuPlant([spec, spec], False, 10.0) as plant:
        plant.read(which, 0.0, readings)
        assert readings.tolist() == [0.0] * 6
        plant.step(which, np.zeros(2), np.full(2, 0.5), inputs, readings)
        plant.read(which, 0.5, readings)
    assert readings.tolist() == [0.25, 3.0, 0.5, 7.0, -4.0, 0.0]


def test_what_does_not_fit_is_an_error_of_the_instance(valve: Path) -> None:
    spec = PlantSpec(valve, {}, "v", ports("stage"), ports("seen_stage"))
    with FmuPlant([spec], False, 10.0) as plant:
        with pytest.raises(FmuCallError, match="from -2147483648 to 2147483647") as caught:
            plant.step(np.arange(1), np.zeros(1), np.ones(1), np.array([3e9]), np.zeros(1))
        assert caught.value.agent == "v"


@pytest.mark.parametrize("engine", ["c", "numpy"])
def test_in_a_scenario(valve: Path, tmp_path: Path, engine: str) -> None:
    stage = '{variable = "stage", scale = 10.0}'
    path = one_fmu(
        tmp_path, valve, stage, '"seen_stage"', 'record = ["seen_open"]', engine=engine, gain=-0.37
    )
    run(load(path), tmp_path / "out", report=False)
    with xarray.open_dataset(tmp_path / "out" / "results.nc") as data:
        u, y = data["u"].values, data["y"].values
    assert np.ptp(u) > 0.1
    np.testing.assert_array_equal(y[1:], np.rint(10.0 * u[:-1]))


@pytest.mark.parametrize("isolation", ["none", "process"])
def test_what_went_wrong_is_told_from_any_process(
    valve: Path, tmp_path: Path, isolation: str
) -> None:
    stage, more = '{variable = "stage", scale = 1e12}', f'isolation = "{isolation}"'
    path = one_fmu(tmp_path, valve, stage, '"seen_stage"', more, gain=-0.37)
    made = run(load(path), tmp_path / "out", report=False)
    assert made.summary["verdict"] == "failed"
    assert "expected values of type Integer from -2147483648" in made.summary["reason"]
