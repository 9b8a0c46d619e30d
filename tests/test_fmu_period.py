"""Which communication periods an FMU allows."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import test_engine
from fmu_examples import tank_fmu
from fmu_scenarios import one_fmu
from test_fmu_instance import described

from posmas_fmi import load, run
from posmas_fmi.errors import ScenarioError
from posmas_fmi.fmu.archive import read_entry
from posmas_fmi.fmu.check.preflight import check_fmu
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.period import (
    Experiment,
    allows_steps_of_different_length,
    check_period,
    default_experiment,
)

VARIABLE = b'canHandleVariableCommunicationStepSize="true"'


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fmus")


@pytest.fixture
def fixed(cache: Path, tmp_path: Path) -> Path:
    """An FMU whose solver has steps of 0.1 s."""
    new = VARIABLE + b' fixedInternalStepSize="0.1"'
    return described(tank_fmu(cache, 3), tmp_path / "fixed.fmu", VARIABLE, new)


@pytest.mark.parametrize("fmi", [2, 3])
def test_any_period_where_nothing_is_said(cache: Path, fmi: int) -> None:
    with FmuFile(tank_fmu(cache, fmi)) as file:
        assert check_period(file, 0.0123).allowed
        assert check_period(file, 0.1, last=0.05).allowed
        assert default_experiment(file) == Experiment(0.0, 100.0, 1.0, 1e-9)
        assert not check_period(file, 0.0).allowed
        assert not check_period(file, float("nan")).allowed


@pytest.mark.parametrize("period", [0.1, 0.3, 0.7, 1e4, 0.1 * 3])
def test_whole_multiples_of_the_internal_step(fixed: Path, period: float) -> None:
    with FmuFile(fixed) as file:
        assert check_period(file, period).allowed


@pytest.mark.parametrize(
    ("period", "nearest"), [(0.25, 0.2), (0.05, 0.1), (1e-6, 0.1), (0.36, 0.4), (100.04, 100.0)]
)
def test_others_are_refused_with_the_nearest_that_is_not(
    fixed: Path, period: float, nearest: float
) -> None:
    with FmuFile(fixed) as file:
        check = check_period(file, period)
        assert not check.allowed
        assert check.nearest == nearest
        assert f"the nearest is {nearest:g} s" in check.reason
        assert not check_period(file, 0.5, last=period).allowed


@pytest.mark.parametrize("fmi", [2, 3])
def test_steps_of_the_same_length(cache: Path, tmp_path: Path, fmi: int) -> None:
    new = VARIABLE.replace(b"true", b"false")
    path = described(tank_fmu(cache, fmi), tmp_path / "same.fmu", VARIABLE, new)
    with FmuFile(path) as file:
        assert not allows_steps_of_different_length(file)
        assert check_period(file, 0.3).allowed
        assert check_period(file, 0.3, last=0.1 * 3).allowed
        check = check_period(file, 0.3, last=0.1)
        assert not check.allowed
        assert "all of its communication steps have the same length" in check.reason


@pytest.mark.parametrize(
    ("period", "every", "message"),
    [
        (0.25, 1, r"steps of 0\.1 s.*the nearest is 0\.2 s"),
        (0.02, 3, r"0\.06 s is no whole multiple.*the nearest is 0\.1 s \(every = 3\)"),
    ],
)
def test_a_scenario_is_refused_before_anything_runs(
    fixed: Path, tmp_path: Path, period: float, every: int, message: str
) -> None:
    more = f"[[plant.override]]\nagent = 2\nevery = {every}"
    path = one_fmu(
        tmp_path, fixed, '"power"', '"temperature"', more, until=300 * period, period=period
    )
    with pytest.raises(ScenarioError, match=message) as caught:
        run(load(path), tmp_path / "out")
    assert "$.scenario.period: fixed.fmu" in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_a_scenario_with_a_period_that_is_allowed_runs(fixed: Path, tmp_path: Path) -> None:
    path = one_fmu(tmp_path, fixed, '"power"', '"temperature"', period=0.3, until=3.0)
    assert run(load(path), tmp_path / "out", report=False).summary["steps"] == 10


EXACT = """    if (communicationStepSize != 1.0 / 60 ||
        currentCommunicationPoint != rint(currentCommunicationPoint * 60) / 60)
        return fmi3Error;
"""


@pytest.fixture
def container(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An FMU of 60 Hz that takes its own points of time only, to the last bit."""
    test_engine.changed(monkeypatch, 3, test_engine.STEP, EXACT + test_engine.STEP)
    new = VARIABLE.replace(b"true", b"false") + b' fixedInternalStepSize="0.016666666666666666"'
    return described(tank_fmu(tmp_path, 3), tmp_path / "container.fmu", VARIABLE, new)


@pytest.mark.parametrize("isolation", ["none", "process"])
@pytest.mark.parametrize("which", ["c", "numpy"])
def test_an_fmu_gets_its_points_of_time_to_the_last_bit(
    container: Path, tmp_path: Path, which: str, isolation: str
) -> None:
    ports = (container, '"power"', '"temperature"', f'isolation = "{isolation}"')
    path = one_fmu(tmp_path, *ports, period=1 / 60, until=10.0, engine=which)
    summary = run(load(path), tmp_path / "out", report=False).summary
    assert (summary["steps"], summary["verdict"]) == (600, "converged")


def test_the_nearest_period_is_told_with_all_digits(container: Path) -> None:
    with FmuFile(container) as file:
        reason = check_period(file, 0.016666667).reason
    assert "0.016666667 s is no whole multiple" in reason
    assert "the nearest is 0.016666666666666666 s" in reason


def test_check_takes_the_steps_of_the_default_experiment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = "communicationStepSize != 0.25 || currentCommunicationPoint < 5.0"
    refuse = f"    if ({other})\n        return fmi3Error;\n"
    test_engine.changed(monkeypatch, 3, test_engine.STEP, refuse + test_engine.STEP)
    text = read_entry(tank_fmu(tmp_path, 3), "modelDescription.xml")
    old = re.search(rb"<DefaultExperiment[^>]*>", text)
    assert old is not None
    new = b'<DefaultExperiment startTime="5" stopTime="50" stepSize="0.25"/>'
    path = described(tank_fmu(tmp_path, 3), tmp_path / "later.fmu", old.group(), new)
    made = check_fmu(path, control=False)
    assert made.exit_code == 0, [str(f) for f in made.findings]
    assert made.results["steps"] > 10
