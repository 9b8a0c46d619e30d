"""The control report against systems whose answers are known."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import hostile
import numpy as np
import pytest
from fmu_examples import tank_fmu
from test_fmu_events import only_me
from test_fmu_instance import described

from posmas_fmi import load
from posmas_fmi.cli import main
from posmas_fmi.expression import VectorFunction
from posmas_fmi.fmu import build
from posmas_fmi.fmu.build import agent_fmu
from posmas_fmi.fmu.check.control import control_report, lines
from posmas_fmi.fmu.check.preflight import check_fmu
from posmas_fmi.fmu.check.text import to_text
from posmas_fmi.fmu.evaluation import open_fmu
from posmas_fmi.fmu.model import Experiment, FmuModel, Variable


def report_of(path: Path, inputs: list[str], outputs: list[str], **values: Any) -> dict[str, Any]:
    made: dict[str, Any] = {}
    with open_fmu(path) as file:
        for part in control_report(file, inputs, outputs, 0.0, values):
            made.update(part)
    return made


@pytest.fixture(scope="module")
def tank(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tank_fmu(tmp_path_factory.mktemp("tank"), 2)


def agent(sec: str, tmp_path: Path, m: int = 2) -> Path:
    g = VectorFunction.parse(["0"] * m, ["t", *(f"x{k + 1}" for k in range(m))])
    return agent_fmu(g, VectorFunction.parse([sec], ["u1"]), m, 1, 1, cache=tmp_path)


def test_a_tank(tank: Path) -> None:
    """x' = (u - 2 (x - 290)) / 50."""
    made = report_of(tank, ["power"], ["temperature"])
    assert made["signs"] == {"A": ["-"], "B": ["+"], "C": ["+"], "D": ["0"]}
    assert made["time_constants"] == [25.0]
    assert made["period"]["suggested"] == 2.0  # a tenth, rounded down
    (sector,) = made["sectors"]
    assert sector["low"] == pytest.approx(1.0)
    assert sector["high"] == pytest.approx(1.0)
    assert dict(lines(made))["positive"].startswith("yes")
    assert tomllib.loads(made["toml"])["agent"]["A"] == [[pytest.approx(-0.04)]]


def test_what_is_printed_is_a_part_of_a_scenario(tank: Path, tmp_path: Path) -> None:
    made = report_of(tank, ["power"], ["temperature"])
    text = f"""
[scenario]
name = "tanks"
until = 10.0
period = {made["period"]["suggested"]}

{made["toml"]}
[network]
agents = 3
arcs = [[1, 2], [2, 3], [3, 1]]
pinned = [1]

[leader]
s0 = [1.0]
"""
    (tmp_path / "tank.fmu").write_bytes(tank.read_bytes())
    path = tmp_path / "scenario.toml"
    path.write_text(text.replace(tank.name, "tank.fmu"), encoding="utf-8")
    scenario = load(path)
    assert scenario.agent.A.tolist() == [[pytest.approx(-0.04)]]


def test_an_output_that_an_input_acts_on_directly(tank: Path) -> None:
    made = report_of(tank, ["power"], ["net"])
    assert made["signs"]["D"] == ["+"]
    assert "directly" in made["fit"]["why_not"]
    assert set(tomllib.loads(made["toml"])) == {"plant"}
    assert "net falls where a state rises" in dict(lines(made))["positive"]


def test_a_saturating_input_has_a_sector(tmp_path: Path) -> None:
    path = agent("tanh(20*u1)/20", tmp_path, 1)
    made = report_of(path, ["u"], ["y"], A=[[-2.0]], B=[[1.0]], C=[[1.0]])
    (sector,) = made["sectors"]
    assert sector["low"] == pytest.approx(np.tanh(2.0) / 2.0, rel=1e-3)
    assert sector["high"] <= 1.0 + 1e-9


def test_signs_integrators_growth_and_states_that_nobody_sees(tmp_path: Path) -> None:
    path = agent("u1", tmp_path, 3)
    A = [[-1.0, -0.5, 0.0], [0.3, 0.5, 0.0], [1.0, 0.0, 0.0]]
    made = report_of(path, ["u"], ["y"], A=A, B=[[1.0], [0.0], [0.0]], C=[[1.0, 0.0, 0.0]])
    assert made["signs"]["A"] == ["--0", "++0", "+00"]
    assert made["integrators"] == 1
    assert len(made["growing"]) == 1
    assert made["unseen"] == ["x[3]"]
    said = dict(lines(made))
    assert "A[1,2] = -0.5 < 0: not Metzler" in said["positive"]
    assert "NOT STABLE" in said


def test_a_fast_mode_that_does_not_count_does_not_set_the_period(tmp_path: Path) -> None:
    path = agent("u1", tmp_path)
    values = {"A": [[-1.0, 0.0], [0.0, -1000.0]], "B": [[1.0], [1.0]], "C": [[1.0, 1.0]]}
    assert report_of(path, ["u"], ["y"], **values)["period"]["suggested"] == 0.1
    values["C"] = [[1.0, 1000.0]]  # as large as the slow one
    assert report_of(path, ["u"], ["y"], **values)["period"]["suggested"] == 1e-4


def test_the_period_is_one_that_a_run_takes(tmp_path: Path) -> None:
    """The linear model is that of Model Exchange; a run uses Co-Simulation, which allows less."""
    fixed = b'<CoSimulation fixedInternalStepSize="0.25" '
    made, to = agent("u1", tmp_path, 1), tmp_path / "stepped.fmu"
    stepped = described(made, to, b"<CoSimulation ", fixed)
    period = check_fmu(stepped).results["control"]["period"]
    assert period["suggested"] == 0.25
    assert "the FMU takes 0.25 s" in period["reason"]


def test_an_fmu_that_shows_no_states_is_sampled() -> None:
    """One Euler step of x' = u - x: x(k+1) = 0.9 x(k) + 0.1 u."""
    made = report_of(hostile.path("good 2"), ["u"], ["y"])
    assert made["time_constants"] == [pytest.approx(-0.1 / np.log(0.9))]
    (sector,) = made["sectors"]
    assert sector["low"] == pytest.approx(1.0)
    assert "no states" in made["fit"]["why_not"]


def test_the_trial_ends_with_the_report(tank: Path) -> None:
    made = check_fmu(tank, ["power"], ["temperature"])
    assert made.exit_code == 0
    assert made.results["control"]["time_constants"] == [25.0]
    text = to_text(made)
    assert "period to use   2 s" in text
    assert "[plant.inputs]" in text
    assert text.splitlines()[-1].startswith("fine")


def test_a_way_that_an_fmu_refuses_is_no_error_of_the_fmu() -> None:
    """Only the report sets inputs more than 150 times in one process."""
    made = check_fmu(hostile.path("Set error 150"), ["u"], ["y"])
    assert made.exit_code == 0, [str(f) for f in made.findings]
    assert [(f.severity, f.code) for f in made.findings] == [("note", "status-error")]


@pytest.mark.parametrize("defect", ["Get nan", "Get inf", "Get absurd"])
def test_json_is_json_whatever_an_fmu_returns(
    defect: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code = main(["check", str(hostile.path(defect)), "--in", "u", "--out", "y", "--json"])
    (made,) = json.loads(capsys.readouterr().out)["fmus"]
    assert made["exit_code"] == code
    assert made["findings"]


STATIC = """
#include "model.h"

void model_derivatives(double t, const double *p, const double *u, const double *x, double *dx)
{
    (void)t, (void)p, (void)u, (void)x, (void)dx;
}

void model_outputs(double t, const double *p, const double *u, const double *x, double *y)
{
    (void)t, (void)p, (void)x;
    y[0] = 2.0 * u[0];
}

void model_directional(double t, const double *p, const double *u, const double *x,
                       const double *su, const double *sx, double *sdx, double *sy)
{
    (void)t, (void)p, (void)u, (void)x, (void)sx, (void)sdx;
    sy[0] = 2.0 * su[0];
}
"""


def test_an_fmu_without_states(tmp_path: Path) -> None:
    u, y = Variable("u", "input", (1,), (0.0,)), Variable("y", "output", (1,), depends=("u",))
    static = FmuModel("static", "a gain", (u, y), {"model.c": STATIC}, Experiment())
    made = check_fmu(only_me(build.fmu(static, 2, cache=tmp_path), tmp_path / "me.fmu"))
    assert made.results["control"]["signs"]["D"] == ["+"]
    assert "there are no states" in to_text(made)
