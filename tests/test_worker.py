"""FMUs in worker processes give what they give in this one, and take nobody with them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from fmu_examples import example_1, tank_fmu

from posmas_fmi.cosim.worker.pool import Isolation, WorkerPool
from posmas_fmi.cosim.worker.proxy import RemoteFile, built_here
from posmas_fmi.errors import FmuError, FmuLostError
from posmas_fmi.fmu.file import FmuFile

pytestmark = pytest.mark.skipif(os.name != "posix", reason="worker processes need POSIX")


@pytest.fixture(scope="module")
def fmu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return example_1().fmu(3, tmp_path_factory.mktemp("fmus"))


def values(x: list[float]) -> dict[str, object]:
    return {**example_1().matrices, "x": x}


def test_an_instance_in_a_worker_does_what_one_here_does(fmu: Path) -> None:
    pool = WorkerPool(Isolation("process"), 2)
    try:
        with FmuFile(fmu) as here, RemoteFile(fmu, pool.place) as there:
            one, other = here.instantiate("a"), there.instantiate("a")
            for instance in (one, other):
                instance.initialise(values([1.0, 2.0]))
                instance.set({"u": [0.5]})
                instance.do_step(0.0, 0.01)
            np.testing.assert_array_equal(other.get("y"), one.get("y"))
            assert other.serialise() == one.serialise()
            with pytest.raises(FmuError, match="nonsense"):
                other.set({"nonsense": 1.0})
    finally:
        pool.close()


def test_a_worker_that_is_killed_is_an_error_that_names_its_signal(fmu: Path) -> None:
    pool = WorkerPool(Isolation("process"), 1)
    try:
        with RemoteFile(fmu, pool.place) as file:
            instance = file.instantiate("a")
            instance.initialise(values([1.0, 2.0]))
            os.kill(instance.worker.pid, signal.SIGKILL)
            with pytest.raises(FmuLostError, match="KILL"):
                instance.do_step(0.0, 0.01)
    finally:
        pool.close()


def test_nothing_of_a_worker_is_left(fmu: Path) -> None:
    pool = WorkerPool(Isolation("process"), 1)
    with RemoteFile(fmu, pool.place) as file:
        instance = file.instantiate("a")
        pid = instance.worker.pid
        assert Path(f"/proc/{pid}").exists() or not Path("/proc").exists()
    pool.close()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="reads /proc")
def test_fmus_share_a_worker_and_each_is_loaded_once(fmu: Path, tmp_path: Path) -> None:
    """Some FMUs take thread-local storage with every load, which runs out."""
    other = tank_fmu(tmp_path, 2)
    pool = WorkerPool(Isolation("process", workers=1), 6)
    try:
        with RemoteFile(fmu, pool.place) as first, RemoteFile(other, pool.place) as second:
            instances = [f.instantiate(f"{k}") for k in range(3) for f in (first, second)]
            assert len({one.worker.pid for one in instances}) == 1
            instances[0].initialise(values([1.0, 2.0]))
            instances[1].initialise()
            for one in instances[:2]:
                one.do_step(0.0, 0.01)
            maps = Path(f"/proc/{instances[0].worker.pid}/maps").read_text().split()
            loaded = {word for word in maps if "/binaries/" in word}
            assert sorted(Path(name).stem for name in loaded) == ["positive_agent", "tank"]
    finally:
        pool.close()


def test_only_files_that_were_built_here_count_as_such(fmu: Path, tmp_path: Path) -> None:
    changed = tmp_path / "changed.fmu"
    changed.write_bytes(fmu.read_bytes()[:-1] + b"x")
    assert not built_here(changed)


def test_a_worker_starts_without_what_only_its_master_needs() -> None:
    """SymPy alone takes longer than all the rest."""
    code = "import sys, posmas_fmi.cosim.worker.server; print(*sys.modules)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "posmas_fmi.fmu.open" in out.stdout.split()
    assert not {"sympy", "scipy", "fmpy", "h5py"} & set(out.stdout.split())
