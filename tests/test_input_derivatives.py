"""Inputs that go on linearly during a step: a higher order in the period than held ones."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray

from posmas_fmi import load, run
from posmas_fmi.cli import main
from posmas_fmi.fmu.compile import host, shared_library
from posmas_fmi.scenario.schedule import schedule_of

RAMP = Path(__file__).parent / "ramp"
SCENARIO = """
[scenario]
name = "ramps"
until = 2.0
period = {period}
tolerance = 100.0
engine = "{engine}"
coupling = "{coupling}"
input_derivatives = "{which}"

[agent]
A = [[-1.0]]
B = [[1.0]]
C = [[1.0]]

[network]
agents = 1
arcs = []
pinned = [1]

[design]
method = "gains"
K = [[0.0]]
E = [[0.1]]

[plant]
fmu = "ramp.fmu"
inputs = {{u1 = "u"}}
outputs = {{y1 = "x"}}
isolation = "{isolation}"
{more}

[leader]
s0 = [1.0]

[report]
baseline = false
"""
SIGNAL = """
[signals.load]
file = "load.csv"
interpolation = "{interpolation}"
"""
PAIR = """
[plant.parameters]
x = 2.0

[[component]]
name = "other"
fmu = "ramp.fmu"
record = ["x"]

[[connection]]
source = "agents.x"
to = "other.v"
scale = 0.5

[[connection]]
source = "other.x"
to = "agents.v"
scale = 0.5
"""


@pytest.fixture(scope="module")
def ramp(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made(tmp_path_factory.mktemp("ramp"), (RAMP / "model.c").read_text())


def made(folder: Path, code: str) -> Path:
    target = host()
    library = shared_library({"model.c": code}, ["model.c"], "ramp", target)
    with zipfile.ZipFile(folder / "ramp.fmu", "w") as archive:
        archive.write(RAMP / "modelDescription.xml", "modelDescription.xml")
        archive.writestr(f"binaries/{target.fmi2}/ramp{target.extension}", library)
    t = np.linspace(0.0, 3.0, 6001)
    rows = "\n".join(
        f"{a!r},{b!r}" for a, b in zip(t.tolist(), np.sin(3 * t).tolist(), strict=True)
    )
    (folder / "load.csv").write_text(f"time,load\n{rows}\n")
    return folder


def results(folder: Path, name: str, **given: Any) -> xarray.Dataset:
    facts = {
        "period": 0.1,
        "engine": "auto",
        "coupling": "jacobi",
        "which": "signals",
        "isolation": "none",
        "interpolation": "linear",
        "more": 'exogenous = {{v = "load"}}' + SIGNAL,
        **given,
    }
    facts["more"] = facts["more"].format(**facts)
    path = folder / f"{name}.toml"
    path.write_text(SCENARIO.format(**facts))
    run(load(path), folder / name, report=False)
    with xarray.open_dataset(folder / name / "results.nc") as data:
        return data.load()


def forced(t: np.ndarray) -> np.ndarray:
    """x' = -x + sin 3t from 0."""
    return np.asarray((np.sin(3 * t) - 3 * np.cos(3 * t) + 3 * np.exp(-t)) / 10)


def orders(errors: list[float]) -> np.ndarray:
    return np.log2(np.array(errors[:-1]) / errors[1:])


@pytest.mark.parametrize(("which", "order"), [("none", 1), ("signals", 2)])
def test_signals_are_of_second_order(ramp: Path, which: str, order: int) -> None:
    errors = []
    for period in (0.1, 0.05, 0.025):
        data = results(ramp, which, which=which, period=period)
        error = data["y"].values[:, 0, 0] - forced(data["time"].values)
        errors.append(float(np.abs(error).max()))
    np.testing.assert_allclose(orders(errors), order, atol=0.2)


def test_they_are_the_same_in_every_loop(ramp: Path) -> None:
    expected = results(ramp, "c", engine="c")["y"].values
    for name, given in (
        ("numpy", {"engine": "numpy"}),
        ("process", {"isolation": "process"}),
        ("process-numpy", {"isolation": "process", "engine": "numpy"}),
    ):
        np.testing.assert_allclose(results(ramp, name, **given)["y"].values, expected, atol=1e-14)
    served = 'exogenous = {{v = "load", stage = "load"}}' + SIGNAL  # through Python
    np.testing.assert_allclose(results(ramp, "served", more=served)["y"], expected, atol=1e-14)
    held = results(ramp, "held", interpolation="hold")["y"].values
    assert np.abs(held - expected).max() > 1e-2


@pytest.mark.parametrize("coupling", ["jacobi", "gauss-seidel", "iterate"])
@pytest.mark.parametrize(("which", "order"), [("signals", 1), ("all", 2)])
def test_connections_are_of_second_order(ramp: Path, coupling: str, which: str, order: int) -> None:
    """The coupled pair x' = -x + 0.5 z, z' = -z + 0.5 x against its analytic solution."""
    exact = np.exp(-1.0) + np.exp(-3.0), np.exp(-1.0) - np.exp(-3.0)
    errors = []
    for period in (0.1, 0.05, 0.025):
        given = {"coupling": coupling, "which": which, "period": period, "more": PAIR}
        data = results(ramp, f"{coupling}-{which}", **given)
        summary = json.loads((ramp / f"{coupling}-{which}" / "summary.json").read_text())
        # the rollback is tried at the start where it is used
        assert summary.get("replay_noise") == (0.0 if coupling == "iterate" else None)
        found = float(data["y"][-1, 0, 0]), float(data["other.x"][-1])
        errors.append(max(abs(a - b) for a, b in zip(found, exact, strict=True)))
    assert (orders(errors) > order - 0.2).all(), errors


def test_the_replay_noise_is_told_in_the_report_and_at_the_end(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = (RAMP / "model.c").read_text()
    noisy = "    static int n;\n    *r = *state;\n    r->v[X] += (n++ % 3) * 1e-6;"
    folder = made(tmp_path, code.replace("    *r = *state;", noisy))
    results(folder, "noisy", coupling="iterate", more=PAIR)
    scenario, out = str(folder / "noisy.toml"), str(folder / "out")
    assert main(["run", scenario, "--out", out]) == 0
    noise = json.loads((folder / "out" / "summary.json").read_text())["replay_noise"]
    assert 1e-7 < noise < 1e-5
    assert f"replay     steps done again differ by {noise:.4g}" in capsys.readouterr().out
    assert f"differed by {noise:.3g}" in (folder / "out" / "report.html").read_text()


def test_the_schedule_says_so(ramp: Path) -> None:
    for which, told in (("signals", [True]), ("none", [False])):
        results(ramp, "told", which=which)
        schedule = schedule_of(load(ramp / "told.toml"))
        assert [edge.ramp for edge in schedule.edges] == told
        assert ("going on linearly" in schedule.to_text()) == told[0]


def test_an_fmu_that_does_not_interpolate_is_held(ramp: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(ramp / "ramp.fmu") as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    old = b'canInterpolateInputs="true"'
    content["modelDescription.xml"] = content["modelDescription.xml"].replace(old, b"")
    with zipfile.ZipFile(tmp_path / "ramp.fmu", "w") as archive:
        for name, data in content.items():
            archive.writestr(name, data)
    (tmp_path / "load.csv").write_text((ramp / "load.csv").read_text())
    expected = results(ramp, "none", which="none")["y"].values
    np.testing.assert_array_equal(results(tmp_path, "held")["y"].values, expected)


@pytest.mark.parametrize("isolation", ["none", "process"])
def test_an_fmu_that_only_says_so(
    tmp_path: Path, isolation: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Without the function inputs are held; where it returns Error, the remedy is named."""
    code = (RAMP / "model.c").read_text()
    name = "fmi2SetRealInputDerivatives"
    folder = made(tmp_path, code.replace(name, "other"))
    held = results(folder, "held", which="none", isolation=isolation)["y"].values
    found = results(folder, "lacking", isolation=isolation)["y"].values
    np.testing.assert_array_equal(found, held)
    assert "has no function for it" in caplog.text
    made(tmp_path, code.replace("references[k] > V ||", "").replace("orders[k] != 1", "1"))
    results(tmp_path, "refuses", isolation=isolation)
    summary = json.loads((tmp_path / "refuses" / "summary.json").read_text())
    assert summary["verdict"] == "failed"
    assert f"{name}: returned status 3 (Error)" in summary["reason"]
    assert 'input_derivatives = "none"' in summary["reason"]
