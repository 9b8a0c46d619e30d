"""Files that a scenario names, controllers of one's own among them."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import xarray
from fmu_examples import tank_fmu
from fmu_scenarios import one_fmu
from test_scenario_faults import scenario

from posmas_fmi import load, run
from posmas_fmi.cli import main
from posmas_fmi.cooling.loads import read_loads
from posmas_fmi.cosim.snapshot import Snapshot
from posmas_fmi.errors import InputError, ScenarioError
from posmas_fmi.fmu.compare import read_reference

MINE = """
import numpy as np


class Mine:
    def __init__(self, number, gain=1.0):
        self.number, self.gain = number, gain

    def step(self, t, y, neighbours, s):
        target = neighbours.mean(axis=0) if s is None else y
        return self.gain * (target - y).sum()


class Central:
    def __init__(self, gain=1.0):
        self.gain = gain

    def step_all(self, t, Y, s):
        return np.zeros((len(Y), 1)) + self.gain
"""


@pytest.mark.parametrize("name", ["Mine", "Central"])
def test_controllers_of_ones_own(name: str, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(MINE)
    control = f'[control]\npython = "mine.py:{name}"\nparameters = {{gain = 0.25}}\n'
    made = run(load(scenario(tmp_path, control), until=0.5), tmp_path / "out", report=False)
    covered = {row["what"]: row["covered"] for row in made.summary["coverage"]}
    assert covered["controllers of one's own"] is False
    with xarray.open_dataset(tmp_path / "out" / "results.nc") as data:
        u, y = data["u"].values, data["y"].values
    if name == "Central":
        np.testing.assert_array_equal(u, np.full_like(u, 0.25))
    else:  # agent 1 hears agents 2 and 3
        expected = 0.25 * (y[:, [1, 2]].mean(axis=1) - y[:, 0]).sum(axis=1)
        np.testing.assert_allclose(u[:, 0, 0], expected, rtol=1e-12)


WRONG = {
    "no class": ('python = "mine.py:None_"', "has no class"),
    "parameters": ('python = "mine.py:Mine"\nparameters = {speed = 1}', "cannot be made"),
    "no file": ('python = "other.py:Mine"', "beside the scenario"),
}


@pytest.mark.parametrize("name", WRONG)
def test_controllers_that_cannot_be_had(name: str, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(MINE)
    text, message = WRONG[name]
    with pytest.raises(InputError, match=message) as caught:
        run(load(scenario(tmp_path, f"[control]\n{text}\n"), until=0.1), tmp_path / "out")
    assert "$.control.python" in str(caught.value)


OUTSIDE = {
    "$.control.python": '[control]\npython = "../mine.py:Mine"',
    "$.signals.load.file": '[signals.load]\nfile = "../loads.csv"',
    "$.component[0].fmu": '[[component]]\nname = "a"\nfmu = "/there/is/none.fmu"',
    "$.plant.override[0].fmu": '[[plant.override]]\nagent = 1\nfmu = "../other.fmu"',
}


@pytest.mark.parametrize("place", OUTSIDE)
def test_files_outside_the_folder_need_a_word(place: str, tmp_path: Path) -> None:
    folder = tmp_path / "inside"
    folder.mkdir()
    (tmp_path / "mine.py").write_text(MINE)
    (tmp_path / "loads.csv").write_text("time,a\n0,1\n")
    path = scenario(folder, OUTSIDE[place])
    with pytest.raises(
        (InputError, ScenarioError), match="outside the scenario's folder"
    ) as caught:
        load(path)
    assert place in str(caught.value)
    load(path, outside=True)


@pytest.mark.parametrize("cooling", [False, True])
def test_nothing_outside_is_read_without_the_word(cooling: bool, tmp_path: Path) -> None:
    """A cooling scenario reads its loads to know what it stands for; a pipe would never end."""
    os.mkfifo(tmp_path / "endless")
    folder = tmp_path / "inside"
    folder.mkdir()
    text = '[signals.load]\nfile = "../endless"'
    path = scenario(folder, text)
    if cooling:
        path = str(folder / "row.toml")
        head = '[scenario]\nname = "row"\nuntil = 60.0\nperiod = 5.0\n'
        network = "[network]\nagents = 2\nring = [1]\npinned = [1]\n"
        Path(path).write_text(f"{head}[cooling]\n{network}{text}\n")
    with pytest.raises(ScenarioError, match=r"\$.signals.load.file: .*outside the scenario's"):
        load(path)


def test_a_link_does_not_lead_outside(tmp_path: Path) -> None:
    folder = tmp_path / "inside"
    folder.mkdir()
    (tmp_path / "mine.py").write_text(MINE)
    (folder / "link.py").symlink_to(tmp_path / "mine.py")
    with pytest.raises((InputError, ScenarioError), match="outside the scenario's folder"):
        load(scenario(folder, '[control]\npython = "link.py:Mine"'))


def test_the_word_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "inside"
    folder.mkdir()
    (tmp_path / "loads.csv").write_text("time,a\n0,1\n")
    path = scenario(folder, '[signals.load]\nfile = "../loads.csv"')
    assert main(["run", path, "--schedule"]) == 2
    assert "--outside" in capsys.readouterr().err
    assert main(["run", path, "--schedule", "--outside"]) == 0


def test_a_relative_path_holds_in_worker_processes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They stand in another folder."""
    more = 'isolation = "process"'
    one_fmu(tmp_path, tank_fmu(tmp_path, 2), '"power"', '"temperature"', more)
    monkeypatch.chdir(tmp_path)
    assert run(load("one.toml"), Path("out"), report=False).summary["ended"] == "complete"


def test_the_command_tells_what_the_proof_does_not_cover(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine.py").write_text(MINE)
    path = scenario(tmp_path, '[control]\npython = "mine.py:Mine"\n')
    main(["run", path, "--until", "0.1", "--out", str(tmp_path / "out")])
    assert (
        "(the certificate of the design is not about the law that ran)" in capsys.readouterr().out
    )


def test_an_fmu_that_cannot_be_read_is_a_mistake_of_the_scenario(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As for `check`; it was a failure of the FMU, without its place."""
    empty = tmp_path / "empty.fmu"
    empty.touch()
    path = one_fmu(tmp_path, empty, '"power"', '"temperature"')
    assert main(["run", path, "--out", str(tmp_path / "out")]) == 2
    assert "$.plant.fmu: empty.fmu: expected an FMU (the file is empty" in capsys.readouterr().err


PIPES = {
    "signal": ('[signals.a]\nfile = "pipe.csv"\n', "$.signals.a.file: pipe.csv"),
    "network": ("", "$.network.file: cannot read pipe.csv"),
}


@pytest.mark.parametrize("kind", PIPES)
def test_a_pipe_that_a_scenario_names_is_not_waited_for(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It hung for ever."""
    more, told = PIPES[kind]
    path = Path(one_fmu(tmp_path, tank_fmu(tmp_path, 2), '"power"', '"temperature"', more))
    os.mkfifo(tmp_path / "pipe.csv")
    if kind == "network":
        before, _, after = path.read_text().partition("[network]")
        _, _, after = after.partition("[plant]")
        path.write_text(f'{before}[network]\nfile = "pipe.csv"\npinned = [1]\n[plant]{after}')
    assert main(["run", str(path), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert told in said
    assert "it is no regular file" in said


def test_a_pipe_in_the_folder_of_a_run_is_not_waited_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    os.mkfifo(tmp_path / "manifest.json")
    assert main(["report", str(tmp_path)]) == 2
    assert "it is no regular file" in capsys.readouterr().err
    branch = ["--branch", str(tmp_path), "--at", "1", "--out", str(tmp_path / "out")]
    assert main(["run", "paper_example_1", *branch]) == 2
    assert "there is no run to go on with" in capsys.readouterr().err
    with pytest.raises(InputError, match="it is no regular file"):
        Snapshot.load(tmp_path / "manifest.json")
    with pytest.raises(InputError, match="it is no regular file"):
        read_loads(tmp_path / "manifest.json")


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="needs /dev/zero")
@pytest.mark.parametrize(
    "arguments",
    [["run", "/dev/zero"], ["certify", "paper_example_1", "--gains", "/dev/zero"]],
)
def test_a_file_without_an_end_is_not_read_to_it(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """It took all memory."""
    assert main(arguments) == 2
    assert "it is larger than" in capsys.readouterr().err
    with pytest.raises(InputError, match="it is larger than"):
        read_reference("/dev/zero")
