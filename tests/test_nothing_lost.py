"""What was recorded stays readable, whatever ends a run; what it left is swept by the next."""

from __future__ import annotations

import ctypes
import gc
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
from posmas_fmi.errors import InputError, ResultsError
from posmas_fmi.fmu.build import write
from posmas_fmi.fmu.scratch import Scratch, sweep
from posmas_fmi.netcdf import recorded
from posmas_fmi.network import network_from_arcs
from posmas_fmi.scenario.folder import occupied

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="signals and limits")

KILLED = f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); " + (
    "import test_nothing_lost as t; t.killed_everywhere(*sys.argv[1:])"
)


def record(path: Path, blocks: int, told: Path | None = None, expected: int = 0) -> None:
    """Write blocks of rows whose values are their times, and tell how many are flushed."""
    layout = Layout(("1", "2"), ("x1",), ("u1",), ("y1",))
    network = network_from_arcs(2, [(1, 2)], [1])
    with Recorder(path, layout, network, ("x", "u"), {}, expected=expected) as one:
        for k in range(blocks):
            times = 600.0 * k + np.arange(600)
            values = np.repeat(times, 2).reshape(-1, 2, 1)
            one.record_block(times, {"x": values, "u": values})
            if told:
                one.flush()
                told.write_bytes(one.rows.to_bytes(4, "little"))
        if told:
            one.finish()


def readable(path: Path) -> int:
    """Number of rows: those that have a time are right, and all that follow are missing."""
    with h5py.File(path, "r") as file:
        times = file["time"][:]
        rows = recorded(times)
        assert np.isnan(times[rows:]).all()
        np.testing.assert_array_equal(times[:rows], np.arange(rows))
        for name in ("x", "u"):
            assert (file[name][:rows, :, 0] == times[:rows, None]).all()
    return rows


@pytest.mark.slow
@pytest.mark.parametrize(("torn", "partial", "at_least"), [(True, False, 12), (False, True, 6)])
def test_a_run_killed_at_any_write_leaves_its_results_readable(
    killer: Path, tmp_path: Path, torn: bool, partial: bool, at_least: int
) -> None:
    """Every change of the file is the last one once: what was flushed before it is there.

    Results of 600 rows are replaced by others, which outgrow their file and are cut to size. Of
    the changes of a file that has not got its name yet, some will do.
    """
    kinds = [str(int(kind)) for kind in (torn, partial)]
    command = [sys.executable, "-c", KILLED, str(tmp_path / "r.nc"), *kinds]
    environment = {**os.environ, "LD_PRELOAD": str(killer)}
    out = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert out.returncode == 0, out.stderr
    counts = [tuple(map(int, line.split())) for line in out.stdout.splitlines()]
    assert len(counts) >= at_least
    for flushed, rows in counts:
        assert rows >= flushed


@pytest.fixture(scope="module")
def killer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    library = tmp_path_factory.mktemp("killer") / "killer.so"
    source = Path(__file__).with_name("killer.c")
    command = ["cc", "-O1", "-shared", "-fPIC", str(source), "-o", str(library), "-ldl"]
    subprocess.run(command, check=True)
    return library


def killed_everywhere(file: str, torn: str, partial: str) -> None:
    """Print, for changes of a file, how many rows were flushed before it and are there."""
    library, path = ctypes.CDLL(None), Path(file)
    told = path.with_name("flushed")
    record(path, 1)
    before = path.read_bytes()
    for at in range(1, 1000, 16 if int(partial) else 1):
        path.write_bytes(before)
        told.write_bytes(bytes(4))
        child = os.fork()
        if child == 0:
            library.kill_at(at, int(torn), int(partial))
            record(path, 3, told)
            os._exit(0)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        if code == 0:
            return
        assert code == -signal.SIGKILL
        print(int.from_bytes(told.read_bytes(), "little"), readable(path), flush=True)  # noqa: T201


@pytest.mark.parametrize(("expected", "rows"), [(0, 600), (60_000, 0)])
def test_a_full_disk_is_an_error_and_the_results_stay(
    tmp_path: Path, expected: int, rows: int
) -> None:
    """A limit of the file size stands for the disk; a size that is known is told at once."""
    path = tmp_path / "r.nc"
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_FSIZE, (600_000, 600_000))
        try:
            record(path, 100, expected=expected)
        except ResultsError:
            os._exit(7)
        os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
    assert not list(tmp_path.glob("*.partial"))
    assert (readable(path) if path.exists() else 0) >= rows


def test_a_folder_is_for_one_run_at_a_time(tmp_path: Path) -> None:
    with (
        occupied(tmp_path / "out"),
        pytest.raises(InputError, match="another run"),
        occupied(tmp_path / "out"),
    ):
        pass
    with occupied(tmp_path / "out"):
        pass


@pytest.mark.slow
@pytest.mark.parametrize(("moment", "times"), [("manifest.json", 1), ("results.nc", 2)])
def test_ctrl_c_ends_the_command_and_leaves_nothing_half_done(
    tmp_path: Path, moment: str, times: int
) -> None:
    """While FMUs are loaded, and twice in a row while the run goes on."""
    out, temporary = tmp_path / "out", tmp_path / "tmp"
    temporary.mkdir()
    command = ["-m", "posmas_fmi", "run", "paper_example_1", "--until", "2000", "--out", str(out)]
    process = subprocess.Popen(
        [sys.executable, *command],
        env={**os.environ, "TMPDIR": str(temporary)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    while process.poll() is None and not (out / moment).exists():
        time.sleep(0.01)
    for _ in range(times):
        process.send_signal(signal.SIGINT)
        time.sleep(0.02)
    _, said = process.communicate()
    assert process.returncode in (130, -signal.SIGINT)  # Python's own way, 130 for a shell
    assert "Traceback" not in said
    assert not list(temporary.iterdir())
    assert not list(out.glob("*.partial"))
    if (out / "results.nc").exists():
        with h5py.File(out / "results.nc") as file:
            assert not file.attrs["complete"].any()
            assert np.isfinite(file["x"][: recorded(file["time"][:])]).all()


def test_parts_of_builds_that_were_killed_are_removed_by_a_later_one(tmp_path: Path) -> None:
    old, new = tmp_path / ".a.part", tmp_path / ".b.part"
    for part in (old, new):
        part.write_bytes(b"half")
    os.utime(old, (0, 0))
    write(tmp_path / "x.so", b"all")
    assert {path.name for path in tmp_path.iterdir()} == {".b.part", "x.so"}


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


def test_ctrl_c_while_a_folder_is_made_leaves_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = tempfile.mkdtemp

    def interrupted(prefix: str) -> str:
        folder = made(prefix=prefix, dir=tmp_path)
        signal.raise_signal(signal.SIGINT)
        return folder

    monkeypatch.setattr(tempfile, "mkdtemp", interrupted)
    with pytest.raises(KeyboardInterrupt):
        Scratch()
    gc.collect()
    assert not list(tmp_path.iterdir())
