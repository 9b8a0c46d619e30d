"""What was recorded stays readable, whatever ends a run; what it left is swept by the next."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from posmas_fmi.cosim.recorder import Layout, Recorder
from posmas_fmi.errors import ResultsError
from posmas_fmi.fmu.scratch import Scratch, sweep
from posmas_fmi.network import network_from_arcs

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="signals and limits")

RECORD = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); " + (
    "import test_nothing_lost as t; t.record(t.Path(sys.argv[1]), None)"
)


def record(path: Path, blocks: int | None) -> None:
    """Write rows whose values are their times, for ever or so many blocks."""
    layout = Layout(("1", "2"), ("x1",), ("u1",), ("y1",))
    with Recorder(path, layout, network_from_arcs(2, [(1, 2)], [1]), ("x", "u"), {}) as one:
        k = 0
        while blocks is None or k < blocks:
            times = 600.0 * k + np.arange(600)
            values = np.repeat(times, 2).reshape(-1, 2, 1)
            one.record_block(times, {"x": values, "u": values})
            k += 1


def readable(path: Path) -> int:
    """Number of rows; every value must be right, or missing at the very end."""
    with h5py.File(path, "r") as file:
        times = file["time"][:]
        for name in ("x", "u"):
            x = file[name][:][:, :, 0]
            there = np.isfinite(x).all(axis=1)
            assert (x[there] == times[there, None]).all()
            assert (np.diff(there.astype(int)) <= 0).all()
    return len(times)


@pytest.mark.slow
def test_a_killed_run_leaves_what_it_has_written(tmp_path: Path) -> None:
    path = tmp_path / "r.nc"
    for delay in (0.1, 0.17, 0.3):
        one = subprocess.Popen([sys.executable, "-c", RECORD, str(path)])
        while not path.exists() or path.stat().st_size < 100_000:
            time.sleep(0.01)
        time.sleep(delay)
        one.send_signal(signal.SIGKILL)
        one.wait()
        assert readable(path) > 0
        path.unlink()


def test_a_full_disk_is_an_error_and_the_results_stay(tmp_path: Path) -> None:
    """A limit of the file size stands for the disk."""
    path = tmp_path / "r.nc"
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_FSIZE, (600_000, 600_000))
        try:
            record(path, 100)
        except ResultsError:
            os._exit(7)
        os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
    assert readable(path) >= 600


def test_folders_of_the_dead_are_swept_and_those_of_the_living_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    mine = Scratch()
    make = "import tempfile, os; tempfile.tempdir = {!r}; " + (
        "from posmas_fmi.fmu.scratch import Scratch; s = Scratch(); print(s.folder, flush=True); "
        "os.kill(os.getpid(), 9)"
    )
    command = [sys.executable, "-c", make.format(str(tmp_path))]
    left = Path(subprocess.run(command, capture_output=True, text=True).stdout.strip())
    assert left.is_dir()
    assert sweep() == [left]
    assert mine.folder.is_dir()
    mine.cleanup()
    assert not list(tmp_path.iterdir())
