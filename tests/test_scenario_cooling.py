"""A row of cooling lines from a scenario file: what [cooling] stands for, and comparisons."""

from __future__ import annotations

import contextlib
import io
import json
from pathlib import Path

import attrs
import h5py
import numpy as np
import pytest

from posmas_fmi import cli, load, run
from posmas_fmi.cooling import Loads, controller
from posmas_fmi.cooling.row import Row, simulate_row
from posmas_fmi.cosim import engine
from posmas_fmi.design.integral_certificate import slope_assumption
from posmas_fmi.errors import InputError, ScenarioError
from posmas_fmi.network import network_from_arcs
from posmas_fmi.report.reading import read_run
from posmas_fmi.scenario.build import shipped_scenarios
from posmas_fmi.scenario.compare import controllers
from posmas_fmi.scenario.cooling import INTEGRAL_TIME, cooling_law, proved, with_slope
from posmas_fmi.scenario.job import (
    extras,
    law_network,
    make_design_of,
    make_system,
    run_designed,
)
from posmas_fmi.scenario.plant import fmu_files, make_instances
from posmas_fmi.scenario.tables import AgentTable, CompareTable, ControlTable

pytestmark = pytest.mark.slow

ROW = """
[scenario]
name = "row"
until = 300.0
period = 5.0
seed = 1

[cooling]
sizes = [80e3, 40e3, 120e3]
shortage = 1.0
water_class = "W32"
air = {temperature = 297.15, humidity = 0.5}

[signals.load]
times = [0.0, 60.0]
values = [[80e3, 40e3, 120e3], [60e3, 50e3, 120e3]]

[network]
agents = 3
ring = [1]
pinned = [1]
pin_weight = 0.5

[channel]
delay = 5.0

[controllers.slow]
law = "pi"
parameters = {Ti = 240.0}

[compare]
controllers = ["integral_ff", "slow"]
practice = "slow"
"""


@pytest.fixture(scope="module")
def row(tmp_path_factory):
    path = tmp_path_factory.mktemp("row") / "row.toml"
    path.write_text(ROW, encoding="utf-8")
    return load(str(path))


@pytest.fixture(scope="module")
def designed(row):
    return make_design_of(row)


@pytest.fixture(scope="module")
def compared(row):
    """Exit code, folder and what was printed."""
    folder, printed = row.path.parent / "out", io.StringIO()
    with contextlib.redirect_stdout(printed):
        code = cli.main(["run", str(row.path), "--out", str(folder)])
    return code, folder, printed.getvalue()


def results(folder: Path) -> dict[str, np.ndarray]:
    with h5py.File(folder / "results.nc") as file:
        return {name: np.asarray(file[name]) for name in file if file[name].dtype.kind == "f"}


def test_a_comparison_leaves_a_run_of_each_controller(compared) -> None:
    code, folder, _ = compared
    assert code == 0
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    assert summary["verdict"] == "compared"
    assert list(summary["comparison"]) == ["integral_ff", "slow"]
    assert summary["practice"] == "slow"
    assert [limit["name"] for limit in summary["limits"]] == [
        "band", "positivity", "W32", "dew point",
    ]  # fmt: skip
    for name, figures in summary["comparison"].items():
        table = results(folder / name)
        deviation = table["supply_temperature"] - table["set_point"][:, None]
        assert figures["worst_K"] == pytest.approx(np.abs(deviation).max())
        assert figures["limits"]["dew point"] is True
        assert set(summary["kpi"]) <= set(figures)
        own = json.loads((folder / name / "summary.json").read_text(encoding="utf-8"))
        assert next(iter(own["comparison"].values()))["rms_K"] == figures["rms_K"]
        design = json.loads((folder / name / "design.json").read_text(encoding="utf-8"))
        assert design["certified"] == "no"  # the certificate is about (6), which neither is
    assert summary["comparison"]["slow"]["messages_per_h"] == 0
    assert summary["comparison"]["integral_ff"]["messages_per_h"] > 0
    assert "integral_ff" in (folder / "report.html").read_text(encoding="utf-8")


def test_controllers_of_a_comparison_have_the_same_loads_and_start(compared) -> None:
    _, folder, _ = compared
    ff, slow = (results(folder / name) for name in ("integral_ff", "slow"))
    np.testing.assert_array_equal(ff["heat_load"], slow["heat_load"])
    np.testing.assert_array_equal(ff["supply_temperature"][0], slow["supply_temperature"][0])
    assert np.abs(ff["supply_temperature"][-1] - slow["supply_temperature"][-1]).max() > 1e-3


def test_a_scenario_runs_as_the_same_row_from_python(row, designed, tmp_path) -> None:
    plant = attrs.evolve(row.plant, tolerance=None)
    exact = attrs.evolve(row, sensors=None, compare=None, plant=plant)
    run_designed(exact, designed, tmp_path / "out", report=False)
    network = network_from_arcs(3, [(3, 1), (1, 2), (2, 3)], [1])
    expected = simulate_row(
        Row(
            attrs.evolve(network, pinning=0.5 * network.pinning),
            Loads([0.0, 60.0], [[80e3, 40e3, 120e3], [60e3, 50e3, 120e3]]),
            controller(
                "integral_ff",
                K=designed.K[0],
                E=designed.E,
                K_q=float(designed.K.sum()) / INTEGRAL_TIME,
            ),
            until=300.0,
            size=np.array([1.0, 0.5, 1.5]),
            shortage=1.0,
            delay=5.0,
            sensor=None,
        )
    )
    table = results(tmp_path / "out")
    np.testing.assert_allclose(table["supply_temperature"], expected.supply, rtol=0, atol=1e-7)
    np.testing.assert_allclose(table["valve_position"], expected.valve, rtol=0, atol=1e-9)
    np.testing.assert_allclose(table["primary_flow"], expected.flow, rtol=0, atol=1e-9)


def test_what_a_scenario_says_itself_counts_more(row, tmp_path) -> None:
    path = tmp_path / "row.toml"
    path.write_text(ROW + "[plant.parameters]\nstroke_time = 60.0\n", encoding="utf-8")
    changed = load(str(path))
    assert changed.plant.parameters["stroke_time"] == 60.0
    assert changed.plant.parameters["UA"] == row.plant.parameters["UA"]


def test_what_a_scenario_says_of_a_line_counts_more_and_has_its_number(row, tmp_path) -> None:
    path = tmp_path / "row.toml"
    own = "[[plant.override]]\nagent = 3\nevery = 1\nparameters = {UA = 5e3}\n"
    path.write_text(ROW + own, encoding="utf-8")
    changed, generated = load(str(path)), {o.agent: o.parameters for o in row.plant.override}
    assert set(generated) == {2, 3}  # other sizes than the first
    told = [(o.agent, o.parameters) for o in changed.plant.override]
    assert told == [(3, generated[3] | {"UA": 5e3}), (2, generated[2])]
    path.write_text(ROW + own.replace("agent = 3", "agent = 4"), encoding="utf-8")
    with pytest.raises(InputError, match=r"\$.plant.override\[0\].agent: expected 1 to 3"):
        load(str(path))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("shortage = 1.0", "shortage = -1.0", r"\$.cooling.shortage: expected a number >= 0"),
        ("sizes = [80e3, 40e3", "sizes = [40e3", r"\$.cooling.sizes: expected a load > 0"),
        ('"W32"', '"W33"', r"\$.cooling.water_class: expected one of W17"),
        ("sizes =", "facility = 30.0\nsizes =", r"\$.cooling.facility: expected a temperature"),
        ("sizes =", "wet_bulb = 20.0\nsizes =", r"\$.cooling.wet_bulb: expected a temperature"),
        ("sizes =", "set_point = -3.0\nsizes =", r"\$.cooling.set_point: expected kelvin above"),
        (
            "sizes =",
            "set_point_step = {at = 10.0, to = 0.0}\nsizes =",
            r"\$.cooling.set_point_step.to: expected kelvin above",
        ),
        (
            "sizes =",
            "set_point_step = {at = -1.0, to = 6.0}\nsizes =",
            r"\$.cooling.set_point_step.at: expected seconds >= 0",
        ),
        ("= 297.15", "= 24.0", r"\$.cooling.air.temperature: expected air of"),
        ("humidity = 0.5", "humidity = 50.0", r"\$.cooling.air.humidity: expected a relative"),
        ("values = [[80e3,", "values = [[80e9,", r"\$.signals.load: thermal runaway"),
        ("[signals.load]", "[signals.power]", r"\$.cooling.load: there is no signal 'load'"),
        ("shortage", "shortages", r"\$.cooling.shortages: unknown key; did you mean shortage"),
        ("values = [[80e3,", "values = [[", "expected one value or 3"),
        ("ring = [1]", "ring = [3]", r"\$.network.ring\[0\]: expected different numbers"),
    ],
)
def test_mistakes_are_named(tmp_path, old, new, message) -> None:
    path = tmp_path / "row.toml"
    path.write_text(ROW.replace(old, new), encoding="utf-8")
    with pytest.raises(InputError, match=message):
        load(str(path))


def test_unknown_laws_and_parameters_are_named(row, designed) -> None:
    with pytest.raises(InputError, match=r"parameters.kq: unknown key; known keys: K, K_q"):
        cooling_law(ControlTable("integral", parameters={"kq": -1.0}), row.cooling, designed)
    with pytest.raises(InputError, match="expected a number > 0"):
        cooling_law(ControlTable("pi", parameters={"Ti": 0.0}), row.cooling, designed)
    twice = attrs.evolve(row, compare=CompareTable(["pi", "pi", "best"], "pid"))
    with pytest.raises(ScenarioError) as error:
        controllers(twice)
    assert [place for place, _ in error.value.problems] == [
        "$.compare.controllers[1]", "$.compare.controllers[2]", "$.compare.practice",
    ]  # fmt: skip


def test_only_the_law_with_the_gains_of_the_design_has_its_certificate(designed) -> None:
    assert "certified" not in proved(ControlTable("proportional"), designed)
    own = ControlTable("proportional", parameters={"K": [0.0, -1.0, -1.0]})
    assert proved(own, designed)["certified"] == "no"
    assert proved(ControlTable("integral"), designed)["certified"] == "no"
    with_integral = attrs.evolve(designed, K_q=np.array([[-70.0]]))
    assert "certified" not in proved(ControlTable("integral"), with_integral)
    assert proved(ControlTable("proportional"), with_integral)["certified"] == "no"


@pytest.mark.parametrize("law", ["integral_ff", "proportional"])
def test_the_command_says_what_is_proved_of_the_law_that_ran(law, tmp_path, capsys) -> None:
    path, out = tmp_path / "one.toml", tmp_path / "out"
    text = ROW[: ROW.index("[controllers.slow]")].replace("until = 300.0", "until = 60.0")
    path.write_text(f'{text}\n[control]\nlaw = "{law}"\n', encoding="utf-8")
    code = cli.main(["run", str(path), "--out", str(out), "--json"])
    told = json.loads(capsys.readouterr().out)["certified"]
    assert told == json.loads((out / "design.json").read_text(encoding="utf-8"))["certified"]
    assert told == ("no" if law == "integral_ff" else "yes")
    assert told == "yes" or code == 1
    cli.main(["run", str(path), "--out", str(out)])
    other = "no (the certificate of the design is not about the law that ran)"
    assert (other in capsys.readouterr().out) is (told == "no")


def test_the_law_says_what_is_measured(row) -> None:
    plant = attrs.evolve(row.plant, measured={"power": "load", "water": "load", "vale": "kv"})
    with pytest.raises(ScenarioError) as error:
        run(attrs.evolve(row, plant=plant, compare=None), row.path.parent / "measured")
    assert [place for place, _ in error.value.problems] == [
        "$.plant.measured.valve", "$.plant.measured.vale",
    ]  # fmt: skip


def test_the_command_prints_a_table(compared) -> None:
    *_, printed = compared
    assert printed.splitlines()[0].split() == ["integral_ff", "slow"]
    assert "RMS deviation [K]" in printed
    assert "slow: " in printed


SHIPPED = [path.stem for path in shipped_scenarios() if path.stem.startswith("cooling")]


def test_the_shipped_rows_are_there() -> None:
    assert len(SHIPPED) == 11


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_row_runs(name, designed) -> None:
    """Every controller for a minute, with the gains of another row."""
    scenario = load(name, until=60.0, seed=2)
    tables = controllers(scenario) if scenario.compare else {"one": scenario.control}
    own = attrs.evolve(designed, network=scenario.network)
    for table in tables.values():
        one = attrs.evolve(scenario, control=table, compare=None)
        network = law_network(one, own)
        made = attrs.evolve(own, network=network)
        instances = make_instances(one, fmu_files(one), extras(one))
        with instances.start() as plant:
            outcome = engine.run(make_system(one, made, instances), plant)
        assert outcome.ended == "complete"
        assert outcome.messages > 0


@pytest.mark.parametrize("delay", [0.0, 5.0])
def test_a_row_with_a_proved_integral_says_so_and_what_is_beyond_it(delay, tmp_path) -> None:
    """Design, run and report: no offset where the loads differ, and certificate I about that."""
    scenario = load("cooling_integral", until=1800.0)
    scenario = attrs.evolve(scenario, channel=attrs.evolve(scenario.channel, delay=delay))
    result = run(scenario, tmp_path)
    facts = json.loads((tmp_path / "design.json").read_text(encoding="utf-8"))
    assert facts["certified"] == "yes"
    assert facts["rate"] > 0
    assert {a["name"]: a["status"] for a in facts["assumptions"]}["slope"] == "verified"
    assert "I: sampled loop contracts" in [c["name"] for c in facts["conditions"]]
    assert result.summary["verdict"] == "converged"
    assert result.summary["tracking_error_final"] < 0.05
    rows = {row["what"]: row for row in result.summary["coverage"]}
    assert ("delay of messages" in rows) == (delay > 0)
    assert not any(row["covered"] for row in rows.values())
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "no offset" in page
    assert ("the loop without delay" in page) == (delay > 0)
    # the table and the drawing are about supply temperatures, not about states of other loads
    assert "of the supply temperature from the set-point" in page
    told = [agent["final_error"] for agent in result.summary["agents"]]
    np.testing.assert_allclose(read_run(tmp_path).final_error, told)
    # the same row under the proportional law keeps one
    droops = run(
        attrs.evolve(scenario, control=ControlTable("proportional")), tmp_path / "p", report=False
    )
    assert droops.summary["tracking_error_final"] > 0.2


def test_other_gains_or_another_line_have_no_proof_of_the_slope() -> None:
    scenario = load("cooling_integral")
    assert scenario.agent.slope is not None
    narrow = attrs.evolve(scenario.agent, sector=(0.3, scenario.agent.m_h))
    assert slope_assumption(narrow).status != "verified"
    own = AgentTable(A=[[-1.0]], B=[[1.0]], C=[[1.0]])
    assert scenario.cooling is not None
    bare = attrs.evolve(scenario.agent, slope=None)
    assert with_slope(bare, own, scenario.cooling) is bare


@pytest.mark.parametrize(
    ("text", "instead", "place", "message"),
    [
        ("[60e3, 50e3, 120e3]", "[60e3, -50e3, 120e3]", "$.signals.load", "line 2 at 60 s"),
        ("[[80e3, 40e3, 120e3], [60e3, 50e3, 120e3]]", "[80.0, 60.0]", "$.signals.load", "1e3"),
        ("times = [0.0, 60.0]", 'unit = "kW"\ntimes = [0.0, 60.0]', "$.signals.load.unit", "1e3"),
        ("agents = 3", "agents = 0", "$.network.agents", "2 agents or more"),
    ],
)
def test_nonsense_loads_and_rows_are_refused(tmp_path, text, instead, place, message) -> None:
    path = tmp_path / "row.toml"
    assert text in ROW
    path.write_text(ROW.replace(text, instead), encoding="utf-8")
    with pytest.raises(ScenarioError) as error:
        load(path)
    ((where, told),) = error.value.problems
    assert where == place
    assert message in told
