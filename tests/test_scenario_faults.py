"""Faults, jumps of the leader, longer periods and channels in a scenario file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray

from posmas_fmi import load, resources, run
from posmas_fmi.cosim.clock import Clock
from posmas_fmi.errors import InputError, ScenarioError
from posmas_fmi.network import network_from_arcs
from posmas_fmi.scenario.faults import describe
from posmas_fmi.scenario.tables import FaultTable

DESIGN = 'method = "contraction"\nphi = 10.0'
GIVEN = """method = "gains"
K = [[-0.541353, -0.548052]]
E = [[0.0, 9.27812], [0.0, 9.6018]]
phi = 10.0

[report]
baseline = false
"""


def scenario(folder: Path, more: str) -> str:
    text = (resources.shipped("models") / "paper_example_1_tanh.toml").read_text()
    assert DESIGN in text
    path = folder / "scenario.toml"
    path.write_text(f"{text.replace(DESIGN, GIVEN)}\n{more}")
    return str(path)


def result(folder: Path, more: str = "", until: float | None = 1.0) -> tuple[dict[str, Any], Any]:
    made = run(load(scenario(folder, more), until=until), folder / "out", report=False)
    with xarray.open_dataset(folder / "out" / "results.nc") as data:
        return made.summary, data.load()


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return result(tmp_path_factory.mktemp("plain"))


def steps(data: Any, time: float) -> int:
    return int(np.searchsorted(data["time"].values, time))


def test_a_stuck_sensor_deceives_its_observer_from_then_on(tmp_path: Path, plain: Any) -> None:
    summary, data = result(
        tmp_path, '[[fault]]\nkind = "sensor stuck"\nat = 0.2\nuntil = 0.6\nagents = [3]\n'
    )
    usual, k = plain[1], steps(data, 0.2)
    np.testing.assert_array_equal(data["xhat"][: k + 1], usual["xhat"][: k + 1])
    assert np.abs(data["xhat"][k + 5 :, 2] - usual["xhat"][k + 5 :, 2]).max() > 1e-3
    (fault,) = summary["faults"]
    assert (fault["from"], fault["until"], fault["agent"]) == (0.2, 0.6, "3")
    assert fault["covered"].startswith("not covered")


def test_a_noisy_sensor_is_noisy_for_its_time(tmp_path: Path, plain: Any) -> None:
    noisy = '[[fault]]\nkind = "sensor noise"\nat = 0.2\nuntil = 0.6\nagents = [3]\nvalue = 0.05\n'
    _, data = result(tmp_path, noisy)
    usual, begin = plain[1], steps(data, 0.2)
    np.testing.assert_array_equal(data["xhat"][: begin + 1], usual["xhat"][: begin + 1])
    moved = np.abs(data["xhat"][:, 2] - usual["xhat"][:, 2]).max(axis=1).values
    assert moved[begin + 1 : begin + 60].max() > 1e-3
    for which in ("c", "numpy"):  # the same noise in both loops
        text = Path(scenario(tmp_path, noisy))
        text.write_text(
            text.read_text().replace("[scenario]", f'[scenario]\nengine = "{which}"', 1)
        )
        run(load(str(text), until=1.0), tmp_path / which, report=False)
    both = [xarray.load_dataset(tmp_path / w / "results.nc")["xhat"] for w in ("c", "numpy")]
    np.testing.assert_allclose(both[0], both[1], rtol=0, atol=1e-12)


CRASH = """
[[fault]]
kind = "FMU crash"
at = 0.5
agents = [3]
"""


@pytest.mark.parametrize("engine", ["c", "numpy"])
@pytest.mark.parametrize("then", ["stop", "freeze", "restart"])
def test_an_fmu_crashes_when_it_is_told_to(tmp_path: Path, then: str, engine: str) -> None:
    """Its process is really killed; what the rest does is [plant] on_failure."""
    path = Path(scenario(tmp_path, CRASH))
    text = path.read_text().replace("[scenario]", f'[scenario]\nengine = "{engine}"', 1)
    isolated = f'[plant]\nisolation = "process"\non_failure = "{then}"\nworkers = 2'
    path.write_text(text.replace("[plant]", isolated, 1))
    made = run(load(str(path), until=1.0), tmp_path / "out", report=False)
    (incident,) = made.summary["incidents"]
    assert incident["agent"] == "3"
    assert incident["time"] == pytest.approx(0.5, abs=0.0051)
    assert "KILL" in incident["verdict"]
    with xarray.open_dataset(tmp_path / "out" / "results.nc") as data:
        x, times = data["x"].values, data["time"].values
    if then == "stop":
        assert made.summary["verdict"] == "failed"
        assert times[-1] == pytest.approx(0.5, abs=0.0051)
        return
    assert times[-1] == 1.0
    moves = np.abs(np.diff(x[times > 0.52], axis=0)).max(axis=(0, 2))
    assert (moves[[0, 1, 3]] > 0).all()
    assert (moves[2] > 0) == (then == "restart")


def test_an_fmu_in_this_process_is_not_killed(tmp_path: Path) -> None:
    with pytest.raises(InputError, match='isolation = "process"'):
        result(tmp_path, CRASH)


def test_a_stuck_actuator_keeps_the_input_of_the_plant(tmp_path: Path, plain: Any) -> None:
    _, data = result(tmp_path, '[[fault]]\nkind = "actuator stuck"\nat = 0.1\n')
    usual, k = plain[1], steps(data, 0.1)
    np.testing.assert_array_equal(data["x"][: k + 1], usual["x"][: k + 1])
    assert np.abs(data["x"][-1] - usual["x"][-1]).max() > 1e-2


def test_a_leader_that_is_lost_is_remembered(tmp_path: Path) -> None:
    jump = "[[leader.jump]]\nat = 0.3\ns = [2.0, 2.0]\n"
    text = jump + '[[fault]]\nkind = "leader lost"\nat = 0.2\n'
    _, lost = result(tmp_path, text)
    _, heard = result(tmp_path, jump)
    k = steps(heard, 0.3)
    assert (heard["s"][k] == 2.0).all()
    assert (heard["s"][k - 1] < 1.6).all()
    assert np.abs(heard["x"][-1] - lost["x"][-1]).max() > 0.1


def test_an_agent_with_a_longer_period_holds_its_input(tmp_path: Path) -> None:
    summary, data = result(tmp_path, "[[plant.override]]\nagent = 2\nevery = 4\n")
    u = data["u"].values[:200, 1, 0].reshape(50, 4)
    np.testing.assert_array_equal(u, u[:, :1].repeat(4, axis=1))
    assert len(np.unique(u)) > 40
    assert [row["covered"] for row in summary["coverage"]] == [False]


def test_an_agent_with_its_own_ports(tmp_path: Path, plain: Any) -> None:
    own = '[[plant.override]]\nagent = 1\noutputs = {y1 = "y[2]", y2 = "y[1]"}\n'
    _, data = result(tmp_path, own)
    np.testing.assert_array_equal(data["y"][0, 0], plain[1]["y"][0, 0, ::-1])
    np.testing.assert_array_equal(data["y"][0, 1:], plain[1]["y"][0, 1:])


def test_rounded_messages_and_delays_say_what_is_covered(tmp_path: Path) -> None:
    summary, _ = result(tmp_path, "[channel]\nresolution = 0.25\ndelay = 0.01\n")
    assert [(row["what"], row["covered"]) for row in summary["coverage"]] == [
        ("delay of messages", True),
        ("rounded messages", False),
    ]


def test_noise_of_sensors(tmp_path: Path, plain: Any) -> None:
    summary, data = result(tmp_path, "[sensors]\nnoise = [0.05, 0.1]\n")
    assert [(row["what"], row["covered"]) for row in summary["coverage"]] == [
        ("noise or quantisation of sensors", False)
    ]
    assert plain[0]["coverage"] == []
    assert np.abs(data["xhat"] - plain[1]["xhat"]).max() > 1e-3


WRONG = {
    "agent": ('[[fault]]\nkind = "sensor stuck"\nat = 0.1\nagents = [5]', "$.fault[0].agents[0]"),
    "port": ('[[fault]]\nkind = "sensor stuck"\nat = 0.1\nports = [3]', "$.fault[0].ports[0]"),
    "bias": ('[[fault]]\nkind = "sensor bias"\nat = 0.1', "$.fault[0].value"),
    "slow": ('[[fault]]\nkind = "actuator slow"\nat = 0.1\nvalue = 2.0', "$.fault[0].value"),
    "until": ('[[fault]]\nkind = "leader lost"\nat = 0.1\nuntil = 0.1', "$.fault[0].until"),
    "arc": ('[[fault]]\nkind = "arc off"\nat = 0.1\narcs = [[1, 2]]', "$.fault[0].arcs[0]"),
    "late": (
        '[[fault]]\nkind = "leader lost"\nat = 10.0\n[[fault]]\nkind = "leader lost"\nat = 9.99',
        "$.fault[0].at: begins at 10 s, but the run ends at 10 s: expected a time before",
    ),
    "late jump": ("[[leader.jump]]\nat = 11.0\ns = [1.0, 1.0]", "$.leader.jump[0].at"),
    "same point": (
        "".join(f"[[leader.jump]]\nat = {at}\ns = [1.0, 1.0]\n" for at in (0.0991, 0.0992)),
        "$.leader.jump[1].at",
    ),
    "agents of arcs": (
        '[[fault]]\nkind = "messages lost"\nat = 0.1\nagents = [1]',
        "$.fault[0].agents: 'messages lost' takes arcs and value, not agents",
    ),
    "arcs of agents": (
        '[[fault]]\nkind = "actuator stuck"\nat = 0.1\narcs = [[2, 1]]',
        "$.fault[0].arcs: 'actuator stuck' takes agents and ports, not arcs",
    ),
    "value for nothing": (
        '[[fault]]\nkind = "arc off"\nat = 0.1\nvalue = 0.0',
        "$.fault[0].value",
    ),
    "a long crash": (
        '[[fault]]\nkind = "FMU crash"\nat = 0.1\nuntil = 0.2',
        "$.fault[0].until: a crash happens once",
    ),
    "kind": ('[[fault]]\nkind = "broken"\nat = 0.1', "$.fault[0].kind"),
    "jump": ("[[leader.jump]]\nat = 0.1\ns = [1.0]", "$.leader.jump[0].s"),
    "order": (
        "[[leader.jump]]\nat = 0.2\ns = [1.0, 1.0]\n[[leader.jump]]\nat = 0.1\ns = [1.0, 1.0]",
        "$.leader.jump[1].at",
    ),
    "noise": ("[sensors]\nnoise = [0.1, 0.1, 0.1]", "$.sensors.noise"),
    "every": ("[[plant.override]]\nagent = 1\nevery = 7", "$.plant.override[0].every"),
    "ports": (
        '[[plant.override]]\nagent = 1\ninputs = {u2 = "u[1]"}',
        "$.plant.override[0].inputs.u1",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_mistakes_name_their_place(name: str, tmp_path: Path) -> None:
    text, place = WRONG[name]
    until = None if "late" in name else 1.0
    with pytest.raises((InputError, ScenarioError)) as caught:
        result(tmp_path, text, until)
    assert place in str(caught.value)


def test_a_run_that_ends_early_leaves_out_what_comes_later(
    tmp_path: Path, plain: Any, caplog: pytest.LogCaptureFixture
) -> None:
    late = '[[fault]]\nkind = "sensor stuck"\nat = 1.0\n[[leader.jump]]\nat = 2.0\ns = [1.0, 1.0]'
    summary, data = result(tmp_path, late)
    assert "$.fault[0].at: begins at 1 s, but the run ends at 1 s: left out" in caplog.text
    assert "faults" not in summary
    xarray.testing.assert_equal(data["x"], plain[1]["x"])


@pytest.mark.parametrize(
    ("fault", "delays", "covered"),
    [
        ({"kind": "leader lost", "until": 1.0}, True, True),
        ({"kind": "leader lost", "until": 1.0}, False, False),
        ({"kind": "leader lost"}, True, False),  # no bound on the delay
        ({"kind": "messages lost"}, True, False),
        ({"kind": "messages lost", "value": 0.5}, True, True),
        ({"kind": "arc off", "until": 1.0}, True, False),
    ],
)
def test_lost_messages_are_covered_as_delays_that_have_an_end(
    fault: dict[str, Any], delays: bool, covered: bool
) -> None:
    network = network_from_arcs(2, [(1, 2)], [1])
    (row,) = describe([FaultTable(at=0.5, **fault)], network, Clock.of(2.0, 0.1), delays)
    assert row["covered"].startswith("covered") is covered
    assert row["covered"].startswith("not covered") is not covered


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ('"messages lost"\narcs = [[2, 1], [0, 2]]', "arc 2 -> 1, arc leader -> 2"),
        ('"messages lost"', "all arcs"),
        ('"arc off"\narcs = [[2, 3]]', "arc 2 -> 3"),
        ('"leader lost"', "the arcs from the leader"),
        ('"sensor stuck"', "all"),
    ],
)
def test_the_summary_says_where_a_fault_is(text: str, where: str, tmp_path: Path) -> None:
    summary, _ = result(tmp_path, f"[[fault]]\nat = 0.1\nkind = {text}\n", until=0.2)
    assert summary["faults"][0]["agent"] == where
