"""The schedule of a run: what it says, and that it is what is done."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from fmu_examples import tank_fmu
from fmu_scenarios import one_fmu
from test_scenario_wiring import folder, write  # noqa: F401  (a fixture)

from posmas_fmi import load
from posmas_fmi.cli import main
from posmas_fmi.errors import InputError
from posmas_fmi.fmu.about import read_about
from posmas_fmi.scenario.main_job import scheduled
from posmas_fmi.scenario.schedule import followed, schedule_of


def do(schedule) -> list[tuple[str, tuple[str, ...]]]:
    return [(action.do, action.who) for action in schedule.actions]


LINES = ("1", "2", "3")
ALL = (*LINES, "facility")
START = [("read", ALL), ("measure", LINES), ("send", LINES), ("control", LINES)]


def test_all_at_once(folder: Path) -> None:  # noqa: F811
    schedule = schedule_of(load(write(folder)))
    assert do(schedule) == [*START, ("set", ALL), ("step", ALL)]
    edges = {(edge.source, edge.target): edge for edge in schedule.edges}
    kv = edges["2.kv", "facility.kv[2]"]
    heat = edges["3.primary_heat_flow", "facility.heat"]
    assert (kv.delay, kv.feedthrough) == (1, False)
    assert (heat.delay, heat.feedthrough) == (1, True)  # it depends on the header at once
    assert edges["signal load[1]", "1.heat_load"].delay == 0
    assert schedule.loops == (ALL,)
    assert schedule.algebraic == ()  # the water follows the valves at once, but they are states


def test_the_facility_after_the_lines(folder: Path) -> None:  # noqa: F811
    text = ("tolerance = 100.0", 'tolerance = 100.0\ncoupling = "gauss-seidel"')
    schedule = schedule_of(load(write(folder, text)))
    stages = [("set", LINES), ("step", LINES), ("set", ("facility",)), ("step", ("facility",))]
    assert do(schedule) == [*START, *stages]
    delays = {(edge.source, edge.target): edge.delay for edge in schedule.edges}
    assert delays["2.kv", "facility.kv[2]"] == 0
    assert delays["facility.header", "2.header"] == 1


def test_repeated_steps_need_fmus_that_go_back(
    folder: Path,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scenario = load(write(folder, ("tolerance = 100.0", 'tolerance = 100.0\ncoupling = "iterate"')))
    names = [name for name, _ in do(schedule_of(scenario))]
    assert names == ["read", "measure", "send", "control", "save", "set", "step", "restore"]

    import posmas_fmi.scenario.schedule as module

    def stubborn(path: Path):
        about = original(path)
        about.description.coSimulation.canGetAndSetFMUstate = False
        return about

    original = module.read_about
    monkeypatch.setattr(module, "read_about", stubborn)
    with pytest.raises(InputError, match="cannot give and take back its state"):
        schedule_of(scenario)


def test_the_command_prints_it(
    folder: Path,  # noqa: F811
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = write(folder)
    assert main(["run", path, "--schedule"]) == 0
    text = capsys.readouterr().out
    assert "communication step 5 s" in text
    assert "1.kv -> facility.kv[1]: 1 step late" in text
    assert "loop: 1, 2, 3, facility act on each other" in text
    assert main(["run", path, "--schedule", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["period"] == 5.0
    assert not Path("out").exists() or not (Path("out") / "row").exists()


def test_what_follows_inputs_at_once_is_told_by_the_model_structure(tmp_path: Path) -> None:
    about = read_about(tank_fmu(tmp_path, 3))
    names = ("net", "flow", "temperature", "der(temperature)", "loss", "power")
    assert {name: sorted(followed(about, name)) for name in names} == {
        "net": ["power"],
        "flow": ["power"],  # a local variable: it may
        "temperature": [],
        "der(temperature)": ["power"],
        "loss": [],
        "power": ["power"],
    }


CIRCLE = """
[[component]]
name = "hall"
fmu = "{fmu}"

[[connection]]
source = "1.net"
to = "hall.power"

[[connection]]
source = "hall.{back}"
to = "1.power"
scale = 0.5
"""


@pytest.mark.parametrize(("back", "coupling"), [("net", "jacobi"), ("net", "iterate"), ("T", "")])
def test_algebraic_loops_are_found(back: str, coupling: str, tmp_path: Path) -> None:
    file, back = tank_fmu(tmp_path, 3), "temperature" if back == "T" else back
    engine = f'auto"\ncoupling = "{coupling or "jacobi"}'
    more = CIRCLE.format(fmu=file.name, back=back)
    # the controllers set what acts on nothing here
    path = one_fmu(tmp_path, file, '"loss"', '"temperature"', more, engine=engine)
    schedule = scheduled(load(path))
    assert schedule.loops == (("1", "hall"),)
    circle = ("1.net", "hall.power", "hall.net", "1.power")
    assert schedule.algebraic == ((circle,) if back == "net" else ())
    late = "broken by what comes a step late"
    how = "repeated until it settles" if coupling == "iterate" else late
    line = f"algebraic loop, {how}: {' -> '.join(circle)} -> 1.net"
    assert (line in schedule.to_text()) == (back == "net")


@pytest.mark.parametrize("name", ["cooling_row", "paper_example_2"])
def test_shipped_scenarios_have_one(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", name, "--schedule"]) == 0
    text = capsys.readouterr().out
    assert ("signal load[1] -> " in text) == (name == "cooling_row")
