"""Going on with a run that ended early, and branching off another one, from the command line on."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
import xarray
from test_scenario_faults import scenario

from posmas_fmi import load, run
from posmas_fmi.cli import main
from posmas_fmi.errors import FmuError, InputError

LOSSY = "[channel]\nloss = 0.3\njitter = 0.02\n"


def made(folder: Path, more: str = LOSSY, snapshot: float = 0.25, until: float = 2.0) -> Any:
    path = Path(scenario(folder, more))
    text = path.read_text()
    path.write_text(text.replace("[scenario]", f"[scenario]\nsnapshot = {snapshot}", 1))
    return load(str(path), until=until)


def interrupted(at: int) -> Any:
    """Progress that is interrupted after so many steps."""

    def progress(done: int, _: int) -> None:
        if done >= at:
            raise KeyboardInterrupt

    return lambda label: progress


def results(folder: Path) -> xarray.Dataset:
    with xarray.open_dataset(folder / "results.nc") as data:
        return data.load()


def same(one: xarray.Dataset, other: xarray.Dataset) -> None:
    assert set(one) == set(other)
    for name in one:
        np.testing.assert_array_equal(one[name].values, other[name].values, err_msg=str(name))


@pytest.mark.parametrize(
    ("snapshot", "baseline", "every"),
    [(0.25, False, 1), (0.25, True, 7), (0.0, False, 1)],
)
def test_a_run_that_was_interrupted_ends_as_if_it_had_not(
    tmp_path: Path, snapshot: float, baseline: bool, every: int
) -> None:
    definition = made(tmp_path, f"{LOSSY}[record]\nevery = {every}\n", snapshot)
    definition = attrs.evolve(definition, baseline=baseline)
    whole = run(definition, tmp_path / "whole", report=False)
    broken = run(definition, tmp_path / "broken", interrupted(150), report=False)
    assert broken.summary["verdict"] == "cancelled"
    assert len(results(tmp_path / "broken")["time"]) < 401
    again = run(definition, tmp_path / "broken", report=False, resume=True)
    assert again.summary["verdict"] == whole.summary["verdict"]
    keys = ("tracking_error_final", "min_state", "steps", "messages_sent", "messages_lost")
    assert [again.summary[k] for k in keys] == [whole.summary[k] for k in keys]
    same(results(tmp_path / "broken"), results(tmp_path / "whole"))


def test_a_branch_has_the_same_past_and_another_future(tmp_path: Path) -> None:
    definition = made(tmp_path, "")
    run(definition, tmp_path / "first", report=False)
    (tmp_path / "other").mkdir()
    what_if = made(tmp_path / "other", "[[leader.jump]]\nat = 1.5\ns = [3.0, 3.0]\n")
    run(what_if, tmp_path / "second", report=False, branch=(tmp_path / "first", 1.0))
    first, second = results(tmp_path / "first"), results(tmp_path / "second")
    assert second["time"].values[0] == 1.0
    past = second["time"].values < 1.5
    at = np.isin(first["time"].values, second["time"].values[past])
    np.testing.assert_array_equal(second["x"].values[past], first["x"].values[at])
    assert np.abs(second["s"].values[-1] - first["s"].values[-1]).max() > 0.5


@pytest.mark.parametrize("at", [205, 270])
@pytest.mark.parametrize("every", [1, 7])
def test_a_branch_that_was_interrupted_goes_on_as_that_branch(
    tmp_path: Path, at: int, every: int
) -> None:
    """Before its first snapshot it begins where the branch did, not at the start."""
    run(made(tmp_path), tmp_path / "first", report=False)
    (tmp_path / "other").mkdir()
    jump = f"{LOSSY}[record]\nevery = {every}\n[[leader.jump]]\nat = 1.1\ns = [3.0, 3.0]\n"
    what_if, branch = made(tmp_path / "other", jump), (tmp_path / "first", 1.0)
    run(what_if, tmp_path / "whole", report=False, branch=branch)
    run(what_if, tmp_path / "broken", interrupted(at), report=False, branch=branch)
    again = run(what_if, tmp_path / "broken", report=False, resume=True)
    assert again.summary["ended"] == "complete"
    assert "baseline" not in again.summary
    same(results(tmp_path / "broken"), results(tmp_path / "whole"))
    assert results(tmp_path / "whole")["time"].values[0] == pytest.approx(1.0, abs=0.035)


def test_what_is_inside_of_a_snapshot_cannot_be_another(tmp_path: Path) -> None:
    """FMUs, their start values, the channel's arcs: nothing of another one is taken for them."""
    definition, first = made(tmp_path), tmp_path / "first"
    run(definition, first, report=False)
    network, plant = definition.network, definition.plant
    stable = attrs.evolve(plant, parameters={"A": [[-2.0, 0.0], [0.0, -2.0]]})
    heard = network.with_pinned(range(network.N))
    for other, told in (
        (attrs.evolve(definition, plant=attrs.evolve(plant, fmi=2)), "the FMUs are not those"),
        (attrs.evolve(definition, plant=stable), "start values are not those of that run"),
        (attrs.evolve(definition, network=heard), "another system: held"),
        (made(tmp_path, LOSSY, until=1.0), r"ends at 1 s, no later than that snapshot"),
    ):
        with pytest.raises(InputError, match=told):
            run(other, tmp_path / "b", report=False, branch=(first, 1.0))
    shots = first / "snapshots"
    (shots / "100.npz").write_bytes((shots / "200.npz").read_bytes())
    with pytest.raises(InputError, match="it is of communication point 200"):
        run(definition, tmp_path / "b", report=False, branch=(first, 0.5))


def test_a_run_that_is_cut_off_at_its_start_has_nothing_of_the_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from posmas_fmi.scenario import job

    run(made(tmp_path), tmp_path / "out", interrupted(150), report=False)

    def cut_off(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(job, "_recorder", cut_off)  # all FMUs run
        with pytest.raises(KeyboardInterrupt):
            run(made(tmp_path, ""), tmp_path / "out", report=False)
    assert {path.name for path in (tmp_path / "out").rglob("*.*")} == {
        "design.json",
        "manifest.json",
    }
    again = run(made(tmp_path, ""), tmp_path / "out", report=False, resume=True)
    assert again.summary["messages_lost"] == 0


def test_a_run_whose_fmus_do_not_start_leaves_the_one_before_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from posmas_fmi.scenario.plant import Instances

    def refuses(_: object) -> None:
        raise FmuError("refuses its start values")

    run(made(tmp_path), tmp_path / "out")
    before = {path: path.read_bytes() for path in (tmp_path / "out").rglob("*.*")}
    assert {"results.nc", "summary.json", "report.html"} <= {path.name for path in before}
    with monkeypatch.context() as patch:
        patch.setattr(Instances, "start", refuses)
        with pytest.raises(FmuError):
            run(made(tmp_path, ""), tmp_path / "out")
    assert {path: path.read_bytes() for path in (tmp_path / "out").rglob("*.*")} == before


def test_what_cannot_go_on(tmp_path: Path) -> None:
    definition = made(tmp_path)
    out = tmp_path / "out"
    with pytest.raises(InputError, match="no run to go on with"):
        run(definition, out, report=False, resume=True)
    run(definition, out, report=False)
    with pytest.raises(InputError, match="complete"):
        run(definition, out, report=False, resume=True)
    for between in (0.251, np.nan, np.inf):
        with pytest.raises(InputError, match="no snapshot at"):
            run(definition, tmp_path / "b", report=False, branch=(out, between))
    with pytest.raises(InputError, match=r"no snapshot at 0\.3 s \(there is: 0\.25, 0\.5"):
        run(definition, tmp_path / "b", report=False, branch=(out, 0.3))
    run(definition, out, interrupted(150), report=False)
    other = made(tmp_path, "[channel]\nloss = 0.4\njitter = 0.02\n")
    with pytest.raises(InputError, match="the scenario changed"):
        run(other, out, report=False, resume=True)
    newest = max((out / "snapshots").glob("*.npz"), key=lambda path: int(path.stem))
    newest.write_bytes(newest.read_bytes()[:100])
    with pytest.raises(InputError, match="not a snapshot"):
        run(made(tmp_path), out, report=False, resume=True)


def test_the_variables_that_are_recorded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One that stands there twice is a mistake; no report is promised that there is not."""
    with pytest.raises(InputError, match=r"variables\[1\]: 'u' is there already"):
        made(tmp_path, '[record]\nvariables = ["u", "u"]\n')
    path = made(tmp_path, '[record]\nvariables = ["u"]\n').path
    main(["run", str(path), "--out", str(tmp_path / "out")])
    assert "report     none" in capsys.readouterr().out
    assert not (tmp_path / "out" / "report.html").exists()


def test_mistakes_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = scenario(tmp_path, "")
    assert main(["run", path, "--branch", str(tmp_path), "--out", str(tmp_path / "b")]) == 2
    assert "--at" in capsys.readouterr().err
    arguments = ["run", path, "--branch", str(tmp_path), "--at", "1", "--out", str(tmp_path)]
    assert main(arguments) == 2
    assert "folder of its own" in capsys.readouterr().err


@pytest.mark.slow
def test_a_run_that_was_killed_goes_on(tmp_path: Path) -> None:
    definition = made(tmp_path, snapshot=5.0, until=1500.0)
    path, out = str(definition.path), tmp_path / "killed"
    command = [
        sys.executable,
        "-m",
        "posmas_fmi",
        "run",
        path,
        "--until",
        "1500",
        "--out",
        str(out),
    ]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    while process.poll() is None and len(list((out / "snapshots").glob("*.npz"))) < 5:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    run(definition, out, report=False, resume=True)
    run(definition, tmp_path / "whole", report=False)
    same(results(out), results(tmp_path / "whole"))
