"""Each defect gives its finding; nothing an FMU does ends the process that checks it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import hostile
import pytest

from posmas_fmi.fmu.check.preflight import Preflight, check_fmu
from posmas_fmi.fmu.check.supervisor import Supervisor

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not hasattr(os, "fork"), reason="trials need fork"),
    pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory limits need /proc"),
]
GOOD = ("good 2", "good 3")
AT_ONCE = 4


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("hostile")


@pytest.fixture(scope="module")
def checked(folder: Path) -> dict[str, Preflight]:
    """All of them, four at a time, for many just wait; all temporary files in one folder."""
    defects = sorted(hostile.DEFECTS, key=lambda d: d.bounds.call)  # those that wait come first
    names = [*(d.name for d in defects), *GOOD]
    bounds = [*(d.bounds for d in defects), hostile.BOUNDS, hostile.BOUNDS]
    paths = [hostile.path(name) for name in names]

    def check_some(first: int) -> list[tuple[str, Preflight]]:
        with Supervisor() as supervisor:
            return [
                (
                    names[k],
                    check_fmu(paths[k], control=False, supervisor=supervisor, bounds=bounds[k]),
                )
                for k in range(first, len(names), AT_ONCE)
            ]

    with pytest.MonkeyPatch.context() as patch, ThreadPoolExecutor(AT_ONCE) as pool:
        patch.setattr(tempfile, "tempdir", str(folder))
        return dict(pair for some in pool.map(check_some, range(AT_ONCE)) for pair in some)


@pytest.mark.parametrize("name", GOOD)
def test_without_a_defect_there_is_nothing_to_say(checked: dict[str, Preflight], name: str) -> None:
    made = checked[name]
    assert made.findings == ()
    assert made.results["steps"] > 10
    assert made.results["replay_noise"] == made.results["reset_noise"] == 0


@pytest.mark.parametrize("defect", hostile.DEFECTS, ids=lambda d: d.name)
def test_each_defect_has_its_finding(checked: dict[str, Preflight], defect: hostile.Defect) -> None:
    made = checked[defect.name]
    found = [(f.severity, f.code) for f in made.findings]
    assert (defect.severity, defect.code) in found, [str(f) for f in made.findings]
    places = [f.place for f in made.findings if f.code == defect.code]
    assert any(defect.place.lower() in place.lower() for place in places), places
    assert made.exit_code == defect.exit_code, [str(f) for f in made.findings]


def test_no_file_and_no_process_is_left(checked: dict[str, Preflight], folder: Path) -> None:
    assert checked
    assert list(folder.iterdir()) == []
    left = []
    for process in Path("/proc").glob("[0-9]*/cwd"):
        with suppress(OSError):
            left += [process] if str(folder) in os.readlink(process) else []
    assert left == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_check_that_is_ended_leaves_nothing(tmp_path: Path, number: int) -> None:
    """While the FMU hangs in a step."""
    command = [sys.executable, "-m", "posmas_fmi", "check", str(hostile.path("DoStep hang"))]
    environment = {
        **os.environ,
        "TMPDIR": str(tmp_path),
        "PYTHONPATH": os.pathsep.join(p for p in sys.path if p),
    }
    with subprocess.Popen(
        command,
        env=environment,
        stderr=subprocess.DEVNULL,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as process:
        _until(lambda: any(tmp_path.glob("posmas-fmi-check-*/work")))
        process.send_signal(number)
        assert process.wait() == (130 if number == signal.SIGINT else -number)
    _until(lambda: not list(tmp_path.iterdir()))


def _until(true: Callable[[], bool]) -> None:
    for _ in range(600):
        if true():
            return
        time.sleep(0.1)
    raise AssertionError("it did not come to that in a minute")


def test_there_are_more_than_a_hundred() -> None:
    names = [defect.name for defect in hostile.DEFECTS]
    assert len(set(names)) == len(names) > 100
