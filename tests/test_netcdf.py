"""NetCDF files of others are read in a process of its own, which ends whatever HDF5 does."""

from __future__ import annotations

import base64
import os
import signal
import subprocess
import sys
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray
from report_runs import example_1
from test_resume import interrupted, made

from posmas_fmi import netcdf, run
from posmas_fmi.apart import ApartError, call_apart
from posmas_fmi.cli import main
from posmas_fmi.errors import InputError
from posmas_fmi.netcdf import read_netcdf
from posmas_fmi.report.results_file import read_results
from posmas_fmi.scenario.signals import read_signal
from posmas_fmi.scenario.tables import SignalTable

# found by fuzzing: HDF5 1.14 does not come back when it opens what is in this file
HANGS = zlib.decompress(base64.b85decode(
    "c-rll!A|2a5QfK2+l@*QMT?+tp+|0;19w`r1}c>lHArv*D%us5pd1>cKEm#8AA?8ON8n*N@CL<>XR5@aY_&o{?9O)?+2"
    "ipf&OeFcpNGx;<>FQm489LJC_|bl66|E#<iA8K(EdRCAgNy@z6$oQ;{5Kolde)`^wfd!1UYMcVE#uARsGo5Gi;Nd9%Xi"
    "1JiHwkdvn+8r*&ET%e(@Lb`C*pn^_3kLFvhQ+HX9o)jiZ|4R)7ccj{SxUiTWmlu}qd+xa{}($3aj2?ESp&;xvEwCho%+"
    "h1`c-CwhHq{67x2`{2Xy{&ZI4#wq^xUhbt0ORthI9jhV)nx(ej0QLr7loas(05B$Imy4heiU8xSi^7Wiq`+v7u&ve#xJ"
    "ZZ&+2Lks!3bSbn7Q?;{M?KO)nlmZuWdoe{%LrW%{9);27gqw7-(lS-TaT0BoWTH!z6mLO9<AV}nY%&v$hGdzL5GdAe#}"
    "bye6<m}gzuJpEqW8xP_?t}k6rU+a4`9^Q>$vG0e;Vb`XbsdM*!T-}%O4P)wbO=r0u4dbzHZ|eARrdIvA>mnC;zr07D`K"
    "9>0H#xt$tQEGOg#0D~E>nhK7>4;LG5_7-mH+PLdHW-010@&SS1}C3Fbwl~IcRj+$(aHk776G3Pv?BJFL*{fMoVW86nE;"
    "(|FFVq%rFeYFbu;m48t%V%?lbObpr"
))  # fmt: skip


@pytest.fixture
def hanging(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(netcdf, "DEADLINE", 1.0)
    path = tmp_path / "results.nc"
    path.write_bytes(HANGS)
    return path


def test_a_file_that_hangs_hdf5_is_an_error_of_the_scenario(hanging: Path) -> None:
    with pytest.raises(InputError, match=r"results\.nc: .*expected a NetCDF-4 file.*CSV") as caught:
        read_signal("load", SignalTable(file=hanging.name), 2, hanging.parent)
    assert caught.value.where == "$.signals.load.file"


def test_a_file_that_hangs_hdf5_is_an_error_of_the_report(
    hanging: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = example_1(hanging.parent / "run")
    (folder / "results.nc").write_bytes(HANGS)
    assert main(["report", str(folder)]) == 2
    assert f"{folder / 'results.nc'}: expected a NetCDF-4 file" in capsys.readouterr().err


def test_a_hang_is_told_as_one(hanging: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever version of HDF5 reads the file."""
    monkeypatch.setattr(netcdf, "DEADLINE", 1e-6)
    for read in (read_netcdf, read_results):
        with pytest.raises(InputError, match="it is damaged: HDF5 did not come to an end within"):
            read(hanging)


def test_a_file_that_may_not_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(self: Path, *given: object, **named: object) -> None:
        raise PermissionError(13, "Permission denied", str(self))

    (tmp_path / "a.nc").touch()
    monkeypatch.setattr(Path, "open", refused)  # root may read everything
    with pytest.raises(InputError, match=r"expected a NetCDF-4 file \(Permission denied\)"):
        read_netcdf(tmp_path / "a.nc")


def test_a_run_does_not_go_on_with_damaged_results(tmp_path: Path) -> None:
    """It began anew and replaced them."""
    scenario, out = made(tmp_path), tmp_path / "out"
    run(scenario, out, progress=interrupted(100), report=False)
    damaged = (out / "results.nc").read_bytes()[:5000]
    (out / "results.nc").write_bytes(damaged)
    with pytest.raises(InputError, match="cannot go on with these results: expected a NetCDF-4"):
        run(scenario, out, resume=True, report=False)
    assert (out / "results.nc").read_bytes() == damaged


def test_what_is_read_is_what_xarray_reads(tmp_path: Path) -> None:
    path = example_1(tmp_path) / "results.nc"
    ours = read_netcdf(path)
    with xarray.open_dataset(path, decode_times=False) as theirs:
        assert {str(name) for name in theirs.variables} == set(ours.variables)
        assert {str(d): n for d, n in theirs.sizes.items()} == ours.sizes
        for name, variable in theirs.variables.items():
            mine = ours.variables[str(name)]
            assert variable.dims == mine.dims
            np.testing.assert_array_equal(variable.values, np.asarray(mine.values))
            assert variable.attrs.get("units") == mine.attrs.get("units")


def test_long_files_are_thinned_and_keep_their_last_row(tmp_path: Path) -> None:
    time_ = np.append(np.arange(10.0), np.nan)  # a row that was not written any more
    data = {
        "time": time_,
        "a": ("time", np.arange(11.0)),
        "b": (("agent", "time"), np.ones((2, 11))),
    }
    xarray.Dataset(data).to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    thin = read_netcdf(tmp_path / "a.nc", largest=6)
    assert (thin.rows.count, thin.rows.stride) == (10, 4)
    np.testing.assert_array_equal(thin.variables["a"].numbers, [0, 4, 8, 9])
    assert np.shape(thin.variables["b"].values) == (2, 4)
    part = read_netcdf(tmp_path / "a.nc", names=("a",))
    assert part.variables["b"].values is None
    assert np.shape(part.variables["a"].values) == (11,)


# ---- the process --------------------------------------------------------------------------------


def test_a_call_that_ends_its_process_is_an_error() -> None:
    for function, arguments, told in (
        ("os:_exit", (3,), "ended with exit code 3"),
        ("os:kill", (0, int(signal.SIGSEGV)), r"was ended by signal 11 \(SIGSEGV\)"),
        ("time:sleep", (600,), "did not come to an end within 0.2 s"),
        ("posmas_fmi.no:thing", (), r"exit code 1 \(ModuleNotFoundError"),
    ):
        with pytest.raises(ApartError, match=told):
            call_apart(function, arguments, deadline=0.2, memory=2**32)
    with pytest.raises(MemoryError):
        call_apart("builtins:bytearray", (2**31,), deadline=10.0, memory=2**30)
    with pytest.raises(ValueError, match="math domain error"):
        call_apart("math:sqrt", (-1.0,), deadline=10.0, memory=2**32)
    printed = call_apart("os:write", (1, b"what it prints is no answer"), 10.0, 2**32)
    assert printed == 27


def _children(process: int) -> list[int]:
    tasks = Path(f"/proc/{process}/task").glob("*/children")
    return [int(child) for task in tasks for child in task.read_text().split()]


def _until(holds: Callable[[], bool]) -> bool:
    """Wait a minute for something; whether it came."""
    end = time.monotonic() + 60
    while not holds() and time.monotonic() < end:
        time.sleep(0.02)
    return holds()


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs /proc, to count")
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_no_process_is_left_when_the_caller_ends(how: signal.Signals) -> None:
    """On Ctrl-C it is ended; where nobody is left to end it, its own deadline does."""
    deadline = 600.0 if how == signal.SIGINT else 2.0
    code = (
        "from posmas_fmi.apart import call_apart; "
        f"call_apart('time:sleep', (600,), {deadline}, 2**32)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.DEVNULL) as caller:
        assert _until(lambda: bool(_children(caller.pid)))
        (child,) = _children(caller.pid)
        assert _until(lambda: b"posmas_fmi" in Path(f"/proc/{child}/cmdline").read_bytes())
        os.kill(caller.pid, how)
    assert _until(lambda: not Path(f"/proc/{child}").exists())
