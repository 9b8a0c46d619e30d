"""FMUs that crash, hang, leave or lie: each is a verdict that names it, and nothing is left."""

from __future__ import annotations

import contextlib
import gc
import json
import logging
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import attrs
import hostile
import numpy as np
import pytest
from faulty import faulty_fmu, faulty_plant, faulty_system, values

from posmas_fmi.cli import main
from posmas_fmi.cosim import engine
from posmas_fmi.cosim.channel import Channel
from posmas_fmi.cosim.fmu_plant import FmuPlant, Isolation, PlantSpec, PortMap
from posmas_fmi.cosim.master import Outcome
from posmas_fmi.cosim.worker.minder import Limits
from posmas_fmi.cosim.worker.process import Patience
from posmas_fmi.errors import FmuLostError
from posmas_fmi.scenario.verdict import summarise

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="counts in /proc")

VERDICTS = {
    "segfault": "ended by signal 11 (SIGSEGV)",
    "abort": "ended by signal 6 (SIGABRT)",
    "exit": "ended with exit code 0",
    "hang": "did not answer within 0.3 s",
    "error": "returned status 3 (Error)",
    "fatal": "returned status 4 (Fatal)",
    "discard": "returned status 2 (Discard)",
    "outside": "returned status -7 (outside the standard)",
    "not a number": "x is not finite (nan)",
    "stack": "ended by signal 11 (SIGSEGV)",
    "memory": "used more memory than it may",
    "opens": "opened more files than it may",
    "fills": "wrote more to its folder for temporary files than it may",
    "output": "wrote more output than it may",
}


@pytest.fixture(scope="module")
def fmu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return faulty_fmu(tmp_path_factory.mktemp("faulty"))


@pytest.fixture(scope="module")
def endless() -> dict[str, Path]:
    names = ("good 2", "DoStep fills 11", "DoStep log-endless 11")
    return {name: hostile.path(name) for name in names}


def isolation(on_failure: Any = "stop", patience: float = 20.0, **options: Any) -> Isolation:
    return Isolation(
        "process",
        **{"workers": 1, **options},
        on_failure=on_failure,
        limits=Limits(memory=0.3, output=8, files=2**-5),
        patience=Patience(step=patience, start=20.0),
    )


def run(
    fmu: Path, faults: dict[int, dict[str, float]], apart: Isolation, loop: Any = "c"
) -> tuple[Outcome, np.ndarray]:
    rows: list[np.ndarray] = []
    system = faulty_system()
    with faulty_plant(fmu, faults, apart) as plant:
        outcome = engine.run(
            system,
            plant,
            lambda t, values: rows.append(values["x"][..., 0].copy()),
            choice=engine.choose(system.law, loop),
        )
    return outcome, np.concatenate(rows)


# ---- what is left --------------------------------------------------------------------------------


def traces() -> Counter[str]:
    """What this process holds: children, descriptors, temporary folders, FMUs that are mapped."""
    gc.collect()
    found: Counter[str] = Counter()
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent = int(stat.read_text().rpartition(")")[2].split()[1])
        except (OSError, IndexError):
            continue
        found["child"] += parent == os.getpid()
    for link in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            found["descriptor"] += os.readlink(link).startswith(("socket:", "pipe:", "/memfd:"))
    found["folder"] = len(list(Path(tempfile.gettempdir()).glob("posmas-fmi-*")))
    maps = Path("/proc/self/maps").read_text()
    found["library"] = len({line.split()[-1] for line in maps.splitlines() if "faulty" in line})
    found["shared"] = maps.count("memfd:posmas-fmi-values")
    found["segment"] = len(list(Path("/dev/shm").glob("*posmas*")))
    return found


@pytest.fixture(autouse=True)
def nothing_is_left(fmu: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    before = traces()
    yield
    assert traces() == before


# ---- one fault, one verdict ----------------------------------------------------------------------


@pytest.mark.parametrize("fault", VERDICTS)
def test_a_fault_ends_the_run_with_a_verdict(fmu: Path, fault: str) -> None:
    """It names FMU, agent, call, time and inputs; what was recorded up to it stays."""
    patience = 0.3 if fault == "hang" else 20.0
    outcome, x = run(fmu, {1: values(fault, at=0.5)}, isolation(patience=patience))
    assert (outcome.ended, outcome.failed_agent) == ("failed", "2")
    assert VERDICTS[fault] in outcome.reason
    call = "fmi2GetReal" if fault == "not a number" else "fmi2DoStep"
    assert outcome.reason.startswith(f"faulty.fmu: 2: {call}: ")
    assert "at time 0.5 s; inputs u = 0.06" in outcome.reason
    (incident,) = outcome.incidents
    assert (incident.agent, incident.action, incident.time) == ("2", "stopped", 0.5)
    assert len(x) == 11


@pytest.mark.parametrize(
    ("fault", "apart"),
    [
        *(("segfault", "process"), ("hang", "process"), ("error", "process")),
        *(("not a number", "process"), ("error", "none"), ("not a number", "none")),
    ],
)
@pytest.mark.parametrize("action", ["stop", "freeze"])
def test_both_loops_say_and_do_the_same(fmu: Path, fault: str, apart: Any, action: str) -> None:
    how = attrs.evolve(isolation(action, 0.3), mode=apart)
    here, there = (run(fmu, {1: values(fault)}, how, loop) for loop in ("c", "numpy"))
    np.testing.assert_allclose(here[1], there[1], rtol=1e-12)
    assert here[0].ended == there[0].ended == ("failed" if action == "stop" else "complete")
    assert here[0].reason == there[0].reason
    strip = {"inputs": {}}
    told = [[i.to_dict() | strip for i in outcome.incidents] for outcome, _ in (here, there)]
    assert told[0] == told[1]


@pytest.mark.parametrize("apart", ["process", "none"])
def test_messages_come_as_before_when_one_agent_is_frozen(fmu: Path, apart: Any) -> None:
    """What was drawn for the rest of a slice is neither drawn again nor left out."""
    how = attrs.evolve(isolation("freeze"), mode=apart)
    channel = Channel.uniform(3, 0.05, delay=0.05, jitter=0.1, loss=0.3)
    system = attrs.evolve(faulty_system(until=10.0), channel=channel, seed=4)
    seen = []
    for loop in ("c", "numpy"):
        rows: list[np.ndarray] = []
        with faulty_plant(fmu, {1: values("error", at=4.0)}, how) as plant:
            choice = engine.choose(system.law, loop)
            outcome = engine.run(
                system, plant, lambda _, v, to=rows: to.append(v["u"].copy()), choice=choice
            )
        assert [i.action for i in outcome.incidents] == ["frozen"]
        seen.append((np.concatenate(rows), outcome.lost))
    np.testing.assert_allclose(seen[0][0], seen[1][0], rtol=1e-10, atol=1e-12)
    assert seen[0][1] == seen[1][1]


@pytest.mark.parametrize("action", ["stop", "freeze", "restart"])
@pytest.mark.parametrize(
    ("defect", "told", "said"),
    [
        ("fills", "it wrote more to its folder for temporary files than it may", ""),
        ("log-endless", "did not answer within 1 s", "all work and no play"),
    ],
)
def test_what_has_no_end_is_a_verdict(
    endless: dict[str, Path], defect: str, told: str, said: str, action: str
) -> None:
    """It fills its folder, or logs, for ever, from its 11th step on."""
    files = [endless["good 2"], endless[f"DoStep {defect} 11"], endless["good 2"]]
    ports = PortMap.plain(["u"]), PortMap.plain(["y"])
    specs = [PlantSpec(file) for file in files]
    apart = isolation(action, 1.0 if said else 20.0, workers=3)
    rows: list[np.ndarray] = []
    with FmuPlant.of_agents(("1", "2", "3"), specs, *ports, None, 1e9, apart) as plant:
        outcome = engine.run(
            faulty_system(), plant, lambda _, v: rows.append(v["y"][..., 0].copy())
        )
    y = np.concatenate(rows)
    first = outcome.incidents[0]
    assert (first.fmu, first.agent, first.call) == (files[1].name, "2", "fmi2DoStep")
    assert (first.time, list(first.inputs)) == (0.5, ["u"])
    assert told in first.cause
    assert said in "".join(first.messages)
    summary = summarise(outcome, ("1", "2", "3"), 1e-6)
    assert told in summary["incidents"][0]["verdict"]
    done = {"stop": "stopped", "freeze": "frozen", "restart": "restarted"}[action]
    assert summary["incidents"][0]["action"] == done
    if action == "stop":
        assert (summary["verdict"], len(y)) == ("failed", 11)
        for part in (files[1].name, ": 2: fmi2DoStep", told, "at time 0.5 s", "u = "):
            assert part in summary["reason"]
        return
    assert (summary["ended"], len(y)) == ("complete", 21)
    assert (np.diff(y[:, [0, 2]], axis=0) != 0).all(axis=1)[10:].all()
    assert (y[11:, 1] == y[10, 1]).all() == (action == "freeze")
    assert (summary["agents"][1]["status"] == "frozen") == (action == "freeze")


@pytest.mark.parametrize("apart", ["process", "none"])
@pytest.mark.parametrize("loop", ["c", "numpy"])
def test_a_frozen_agent_stays_and_the_others_go_on(fmu: Path, apart: Any, loop: str) -> None:
    outcome, x = run(
        fmu, {1: values("error", at=0.5)}, attrs.evolve(isolation("freeze"), mode=apart), loop
    )
    assert outcome.ended == "complete"
    assert [(i.agent, i.action) for i in outcome.incidents] == [("2", "frozen")]
    assert "u" in outcome.incidents[0].inputs
    assert (x[10:, 1] == x[10, 1]).all()
    assert (np.diff(x[:, [0, 2]], axis=0) != 0).all()


def test_a_restarted_agent_begins_again_where_the_same_fault_comes_back(fmu: Path) -> None:
    """A new instance cannot get past the same steps: one from its start values takes its place."""
    at_once, _ = run(fmu, {1: values("segfault", at=0.5)}, isolation("restart"))
    told = [(i.agent, i.action) for i in at_once.incidents]
    assert told == [("2", "restarted"), ("2", "frozen")]  # the clock of the fault runs on
    assert "start values at 0.55 s" in at_once.incidents[0].detail
    assert "so soon" in at_once.incidents[1].detail


def test_a_fault_that_does_not_come_back_leaves_no_mark(
    fmu: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The steps since the last snapshot are done again: the result is that of a healthy run."""
    monkeypatch.setenv("POSMAS_TEST_MARK", str(tmp_path / "mark"))
    outcome, x = run(fmu, {1: values("once", at=0.5)}, isolation("restart"))
    assert [(i.agent, i.action) for i in outcome.incidents] == [("2", "restarted")]
    assert "11 steps done again" in outcome.incidents[0].detail
    assert "1, 3 shared its process" in outcome.incidents[0].detail
    _, healthy = run(fmu, {}, isolation())
    np.testing.assert_array_equal(x, healthy)


def test_an_fmu_that_crashes_when_freed_harms_nobody(fmu: Path) -> None:
    outcome, x = run(fmu, {1: values("free crashes", at=0.5)}, isolation("restart"))
    assert {i.agent for i in outcome.incidents} == {"2"}
    assert outcome.ended == "complete"
    assert (np.diff(x[:, 2]) != 0).all()


def test_processes_that_an_fmu_leaves_behind_are_ended(
    fmu: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    outcome, _ = run(fmu, {1: values("daemon", at=0.2), 2: values("daemon", at=0.3)}, isolation())
    assert outcome.ended == "complete"
    assert "faulty.fmu: 1, 2 or 3 left 2 processes behind" in caplog.text
    wait_for(lambda: not working_in(tmp_path))


def test_log_floods_and_closed_descriptors(fmu: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    outcome, _ = run(fmu, {1: values("logs", at=0.5)}, isolation())
    assert outcome.ended == "complete"
    outcome, _ = run(fmu, {1: values("closes", at=0.2)}, isolation())
    assert outcome.ended in ("complete", "failed")  # it is over before the worker sees it, or not


@pytest.mark.parametrize("apart", ["process", "none"])
@pytest.mark.parametrize("n", [1, 3])
def test_messages_that_do_not_say_from_whom(fmu: Path, apart: Any, n: int) -> None:
    """A public water tank gives 1 for what it was given; `check` knows the others."""
    faults = {0: values("stranger", at=0.2)}
    with faulty_plant(fmu, faults, attrs.evolve(isolation(), mode=apart), n=n) as plant:
        outcome = engine.run(faulty_system(n), plant)
    assert outcome.ended == "complete", outcome.reason


def test_what_an_fmu_changes_in_its_process_is_put_back(fmu: Path) -> None:
    """Rounding would change the numbers of the others, the folder the files that they open."""
    _, healthy = run(fmu, {}, isolation())
    with faulty_plant(fmu, {1: values("changes", at=0.2)}, isolation()) as plant:
        rows: list[np.ndarray] = []
        pid = plant._instances[0].worker.pid
        before = os.readlink(f"/proc/{pid}/cwd")
        engine.run(faulty_system(), plant, lambda t, v: rows.append(v["x"][..., 0].copy()))
        plant._instances[0].get("x")  # it has answered: what the last step changed is put back
        assert os.readlink(f"/proc/{pid}/cwd") == before != "/"
    np.testing.assert_array_equal(np.concatenate(rows)[:, 0], healthy[:, 0])


def test_the_locale_is_put_back(fmu: Path) -> None:
    told = {}
    for fault in ("nothing", "changes"):
        faults = {0: values(fault, at=0.2), 1: values("tells", at=0.4)}
        with faulty_plant(fmu, faults, isolation()) as plant:
            assert engine.run(faulty_system(), plant).ended == "complete"
            changed, told[fault] = (one.messages for one in plant._instances[:2])
    assert len(told["nothing"]) == 1
    assert told["changes"] == told["nothing"] != changed


def test_a_fault_at_the_start_is_an_error_of_the_start(fmu: Path) -> None:
    for fault in ("segfault", "exit"):
        with pytest.raises(FmuLostError, match=r"faulty\.fmu: 2: fmi2ExitInitializationMode"):
            run(fmu, {1: values(fault, at=-1.0)}, isolation())


def test_a_worker_that_is_killed_from_outside(fmu: Path) -> None:
    system = faulty_system()
    with faulty_plant(fmu, {}, isolation("restart", workers=2)) as plant:
        pids = [one.worker.pid for one in plant._instances]

        def record(times: np.ndarray, rows: dict[str, np.ndarray]) -> None:
            if times[-1] >= 0.3 and pids:
                os.kill(pids.pop(), signal.SIGKILL)
                pids.clear()

        choice = engine.choose(system.law, "numpy")
        outcome = engine.run(system, plant, record, choice=choice)
    assert outcome.ended == "complete"
    assert [i.action for i in outcome.incidents] == ["restarted"]
    assert outcome.incidents[0].signal == signal.SIGKILL


@pytest.mark.parametrize("loop", ["c", "numpy"])
def test_a_worker_is_woken_once_in_a_step(fmu: Path, loop: Any) -> None:
    """However many instances it has."""
    system = faulty_system(n=8)
    with faulty_plant(fmu, {}, isolation(), n=8) as plant:
        worker = plant._instances[0].worker
        before = worker.head.bell
        outcome = engine.run(system, plant, choice=engine.choose(system.law, loop))
        rung = worker.head.bell - before
    assert (outcome.ended, outcome.steps) == ("complete", 20)
    assert 20 <= rung <= 20 + 8  # and for the first readings


def test_the_deadline_is_of_one_call(fmu: Path) -> None:
    """A step and the reading after it together take longer than one call may."""
    with faulty_plant(fmu, {0: values("slow", at=0.2)}, isolation(patience=1.5), n=1) as plant:
        outcome = engine.run(faulty_system(n=1), plant)
    assert outcome.ended == "complete", outcome.reason


def test_a_request_may_be_larger_than_the_socket_holds(fmu: Path) -> None:
    with faulty_plant(fmu, {}, isolation()) as plant:
        worker = plant._instances[0].worker
        again = {"do": "load", "path": str(fmu), "unpacked": "", "structure": {}}
        worker.request(again, bytes(4_000_000))
        assert worker.alive


def test_instances_that_want_a_process_each_get_one(tmp_path_factory: Any) -> None:
    once = faulty_fmu(tmp_path_factory.mktemp("once"), once=True)
    with faulty_plant(once, {}, isolation()) as plant:
        assert len({one.worker.pid for one in plant._instances}) == 3
        outcome = engine.run(faulty_system(), plant)
    assert outcome.ended == "complete"


def test_ctrl_c_ends_a_run_that_waits_for_an_fmu(fmu: Path) -> None:
    patient = Isolation("process", 1, patience=Patience(step=60.0))
    system = faulty_system()
    for loop in ("c", "numpy"):
        with faulty_plant(fmu, {1: values("hang", at=0.5)}, patient) as plant:
            choice = engine.choose(system.law, loop)
            threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
            outcome = engine.run(system, plant, choice=choice)
        assert (outcome.ended, outcome.steps) == ("cancelled", 10)


# ---- through the command -------------------------------------------------------------------------

SCENARIO = """
[scenario]
name = "faulty"
until = 1.0
period = 0.05
engine = "{loop}"
[agent]
A = [[-1.0]]
B = [[1.0]]
C = [[1.0]]
[network]
agents = 3
arcs = [[1, 2], [2, 3]]
pinned = [1]
[plant]
fmu = "faulty.fmu"
inputs = {{u1 = "u"}}
outputs = {{y1 = "x"}}
states = {{x1 = "x"}}
deadline = 0.3
workers = 1
on_failure = "{action}"
[[plant.override]]
agent = 2
parameters = {{fault = {fault}, at = {at}}}
[leader]
s0 = [0.0]
"""


def scenario(fmu: Path, folder: Path, fault: str, action: str = "stop", loop: str = "auto") -> Path:
    given = values(fault)
    folder.mkdir(exist_ok=True)
    (folder / "faulty.fmu").write_bytes(fmu.read_bytes())
    path = folder / "faulty.toml"
    path.write_text(SCENARIO.format(action=action, loop=loop, **given), encoding="utf-8")
    return path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "action", "code", "verdict"),
    [("abort", "stop", 3, "failed"), ("exit", "freeze", 1, "not converged")],
)
def test_the_command_tells_the_failure_in_all_its_files(
    fmu: Path, tmp_path: Path, capsys: Any, fault: str, action: str, code: int, verdict: str
) -> None:
    path = scenario(fmu, tmp_path / "s", fault, action)
    assert main(["run", str(path), "--out", str(tmp_path / "out")]) == code
    printed = capsys.readouterr().out
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert summary["verdict"] == verdict
    first = summary["incidents"][0]
    assert (first["agent"], first["call"], first["time"]) == ("2", "fmi2DoStep", 0.5)
    assert VERDICTS[fault] in first["verdict"]
    assert "Faults and incidents" in page
    assert VERDICTS[fault] in page
    assert f"u = {first['inputs']['u']:.6g}" in page
    assert "faulty.fmu: the process" in page
    if action == "stop":
        assert VERDICTS[fault] in printed
    else:
        assert summary["agents"][1]["status"] == "frozen"
        assert "frozen after a failure of the FMU: 2" in printed


@pytest.mark.slow
def test_the_command_tells_what_an_fmu_left_behind(
    fmu: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It stood in the log only; who it was is known where each has a process of its own."""
    path = scenario(fmu, tmp_path / "s", "daemon")
    shared = path.read_text()
    for workers, who in ((1, "1, 2 or 3"), (3, "2")):
        path.write_text(shared.replace("workers = 1", f"workers = {workers}"))
        assert main(["run", str(path), "--out", str(tmp_path / "out")]) == 0
        told = f"faulty.fmu: {who} left 1 process behind, which had to be ended"
        assert told in capsys.readouterr().out
        summary = json.loads((tmp_path / "out" / "summary.json").read_text())
        assert summary["verdict"] == "converged"  # as without it: that is no failure
        assert summary["incidents"] == [
            {
                "agent": who,
                "fmu": "faulty.fmu",
                "verdict": "left 1 process behind",
                "action": "ended",
                "processes": 1,
            }
        ]
        page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
        assert f'<th scope="row">{who}</th>' in page
        assert "faulty.fmu: left 1 process behind" in page
        assert "an FMU that failed" not in page


@pytest.mark.slow
def test_the_death_of_the_master_leaves_nothing(fmu: Path, tmp_path: Path) -> None:
    path = scenario(fmu, tmp_path / "s", "hang")
    daemon = "[[plant.override]]\nagent = 3\nparameters = {{fault = {fault}, at = 0.1}}\n[leader]"
    text = path.read_text().replace("deadline = 0.3", "deadline = 60.0")
    path.write_text(text.replace("[leader]", daemon.format(**values("daemon"))))
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    master = subprocess.Popen(
        [sys.executable, "-m", "posmas_fmi", "run", str(path), "--out", str(tmp_path / "out")],
        env={**os.environ, "TMPDIR": str(temporary)},
    )
    workers: list[int] = []
    until = time.monotonic() + 30
    while not workers and time.monotonic() < until:
        time.sleep(0.05)
        workers = descendants(master.pid)
    wait_for(lambda: len(working_in(temporary)) > len(workers))  # the daemon is there
    master.kill()
    master.wait()
    wait_for(lambda: not any(Path(f"/proc/{pid}/cmdline").exists() for pid in workers))
    wait_for(lambda: not list(temporary.glob("posmas-fmi-worker-*")))  # removed by the last one
    wait_for(lambda: not working_in(temporary))


def working_in(folder: Path) -> list[int]:
    """Processes with a working directory in a folder, also in one that was removed."""
    found = []
    for link in Path("/proc").glob("[0-9]*/cwd"):
        with contextlib.suppress(OSError):
            if os.readlink(link).startswith(f"{folder}/"):
                found.append(int(link.parent.name))
    return found


def wait_for(true: Callable[[], bool]) -> None:
    until = time.monotonic() + 30
    while not true():
        assert time.monotonic() < until
        time.sleep(0.02)


def descendants(pid: int) -> list[int]:
    text = Path(f"/proc/{pid}/task/{pid}/children")
    return [int(word) for word in text.read_text().split()] if text.exists() else []
