"""Comparisons of controllers of one's own, without a cooling row."""

from __future__ import annotations

import pickle
import shutil
import zipfile
from pathlib import Path

import pytest
from fmu_examples import tank_fmu
from fmu_scenarios import one_fmu

from posmas_fmi import cli
from posmas_fmi.errors import ScenarioError

LAW = """
class Mine:
    def __init__(self, number, gain=0.0, fails=100.0):
        self.gain, self.fails = gain, fails

    def step(self, t, y, neighbours, s):
        if t >= self.fails:
            raise ValueError("enough")
        return self.gain * ((neighbours.mean(axis=0) if s is None else s) - y)
"""

MORE = """
[controllers.one]
python = "law.py:Mine"

[controllers.two]
python = "law.py:Mine"
parameters = {{{two}}}

[compare]
controllers = ["one", "two"]
processes = 1
"""


def scenario(folder: Path, two: str = "gain = 1.0") -> str:
    (folder / "law.py").write_text(LAW, encoding="utf-8")
    more = MORE.format(two=two)
    return one_fmu(folder, tank_fmu(folder, 3), '"power"', '"temperature"', more)


def run(folder: Path, path: str) -> int:
    return cli.main(["run", path, "--out", str(folder / "out")])


def content(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in (folder / "out").rglob("*.*") if path.is_file()}


def test_a_comparison_from_its_table_to_the_next_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What an earlier one left is given up when FMUs have started; mistakes name their table."""
    path = scenario(tmp_path)
    assert run(tmp_path, path) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["one", "two"]
    assert lines[1].startswith("error to the leader at the end")
    assert "two: not converged" in lines
    assert f"report     {tmp_path / 'out' / 'two' / 'report.html'}" in lines

    (tmp_path / "out" / "design.json").write_text("{}")  # of a plain run
    before = content(tmp_path)
    above = {path.name for path in before if path.parent.name == "out"}
    assert {"summary.json", "manifest.json", "design.json"} == above
    whole = next(tmp_path.glob("tank*.fmu"))
    kept = shutil.copy(whole, tmp_path / "kept")
    with zipfile.ZipFile(kept) as old, zipfile.ZipFile(whole, "w") as new:
        for name in old.namelist():
            new.writestr(name, b"no library" if name.startswith("binaries/") else old.read(name))
    assert run(tmp_path, path) == 3
    assert content(tmp_path) == before
    assert "the binary cannot be loaded" in capsys.readouterr().err

    shutil.copy(kept, whole)  # now the first starts, and the second fails
    assert run(tmp_path, scenario(tmp_path, "fails = 0.5")) == 2
    assert not [path for path in content(tmp_path) if path.parent.name == "out"]
    told = capsys.readouterr().err
    place = "$.controllers.two.python: step of agent 1 at t = 0.5 s"
    assert f"one.toml: {place}: ValueError: enough (law.py, line 8)" in told
    assert "Traceback" not in told

    assert run(tmp_path, scenario(tmp_path, "gian = 0.5")) == 2
    told = capsys.readouterr().err
    assert "$.controllers.two.python: cannot be made: TypeError" in told


def test_errors_come_out_of_another_process_as_they_are() -> None:
    error = ScenarioError((("$.a", "x"), ("$.b", "y")), "file")
    copy = pickle.loads(pickle.dumps(error))
    assert (str(copy), copy.problems, copy.where) == (str(error), error.problems, "file")
