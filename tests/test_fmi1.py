"""FMUs of FMI 1.0: tried by `check`, and run."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray
from fmu_scenarios import one_fmu

from posmas_fmi import load, run
from posmas_fmi.errors import FmuCallError, FmuError
from posmas_fmi.fmu.check.preflight import check_fmu
from posmas_fmi.fmu.compile import host, shared_library
from posmas_fmi.fmu.fmi1 import Fmi1File, Fmi1SteppedFile
from posmas_fmi.fmu.open import open_fmu

SOURCE = Path(__file__).parent / "fmi1"


def packed(path: Path, description: str) -> Path:
    target, code = host(), (SOURCE / "model.c").read_text()
    library = shared_library({"model.c": code}, ["model.c"], "one", target)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", description)
        archive.writestr(f"binaries/{target.fmi2}/one{target.extension}", library)
    return path


@pytest.fixture(scope="module")
def fmus(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("fmi1")
    text = (SOURCE / "modelDescription.xml").read_text()
    model = re.sub("<Implementation>.*</Implementation>", "", text, flags=re.S)
    return {
        "cs": packed(folder / "slave.fmu", text),
        "me": packed(folder / "model.fmu", model),
        "wrong": packed(folder / "wrong.fmu", text.replace('guid="one"', 'guid="two"')),
    }


def by_hand(u: np.ndarray, h: float) -> np.ndarray:
    x = [0.0]
    for value in u[:-1]:
        x.append(value + (x[-1] - value) * np.exp(-h))
    return np.array(x)


@pytest.mark.parametrize("kind", ["cs", "me"])
@pytest.mark.parametrize(
    ("engine", "isolation"), [("c", "none"), ("numpy", "none"), ("c", "process")]
)
def test_they_run(
    fmus: dict[str, Path], tmp_path: Path, kind: str, engine: str, isolation: str
) -> None:
    more = f'isolation = "{isolation}"\nrecord = ["count", "open"]\nparameters = {{open = true}}'
    port = '{variable = "u", offset = -1.0}'  # the valve that is open adds 1
    path = one_fmu(tmp_path, fmus[kind], port, '"x"', more, engine=engine, gain=-2.0)
    run(load(path), tmp_path / "out", report=False)
    with xarray.open_dataset(tmp_path / "out" / "results.nc") as data:
        u, y = data["u"].values[..., 0], data["y"].values[..., 0]
        counts, opened = data["count"].values, data["open"].values
    rtol = 1e-12 if kind == "cs" else 1e-6
    for k in range(2):
        np.testing.assert_allclose(y[:, k], by_hand(u[:, k], 0.1), rtol=rtol)
    assert (opened == 1).all()
    assert counts[-1].tolist() == (y[-1] > 0.5).astype(int).tolist()
    assert counts[-1].max() == 1


def test_a_run_goes_on_by_doing_all_again(fmus: dict[str, Path], tmp_path: Path) -> None:
    path = Path(one_fmu(tmp_path, fmus["cs"], '"u"', '"x"', gain=-2.0))
    path.write_text(path.read_text().replace("[scenario]", "[scenario]\nsnapshot = 0.5", 1))
    run(load(path), tmp_path / "whole", report=False)
    run(load(path), tmp_path / "part", report=False, branch=(tmp_path / "whole", 0.5))
    whole, part = (xarray.load_dataset(tmp_path / n / "results.nc") for n in ("whole", "part"))
    np.testing.assert_array_equal(part["y"].values, whole["y"].values[5:])


@pytest.mark.parametrize(("kind", "code"), [("cs", "no-saved-state"), ("me", "no-reset")])
def test_they_are_tried(fmus: dict[str, Path], kind: str, code: str) -> None:
    made = check_fmu(fmus[kind])
    assert made.verdict == "fine", made.findings
    codes = {finding.code for finding in made.findings}
    assert {"fmi1", "no-saved-state", code} <= codes
    assert made.results["steps"] > 10  # as many as two seconds allow
    assert made.results["repeat_noise"] == 0.0
    assert ("reset_noise" in made.results) == (kind == "cs")
    assert made.results["control"]


def test_what_an_fmu_says_is_told(fmus: dict[str, Path]) -> None:
    with open_fmu(fmus["wrong"]) as file, pytest.raises(FmuCallError, match="GUID is not that"):
        file.instantiate("a")


def test_kinds_and_what_is_not_there(fmus: dict[str, Path]) -> None:
    for kind, expected in (("cs", Fmi1File), ("me", Fmi1SteppedFile)):
        with open_fmu(fmus[kind]) as file, file.instantiate("a") as instance:
            assert type(file) is expected
            instance.initialise({"x": 0.25, "open": True})
            values: Any = [instance.get(name) for name in ("x", "open", "count")]
            assert values == [0.25, 1, 0]
            with pytest.raises(FmuCallError, match="no saved states"):
                instance.get_state()
            with pytest.raises(FmuError, match="no variable 'minus'"):
                instance.get("minus")
            instance.do_step(0.0, 0.5)
            assert instance.get("x") == pytest.approx(1 - 0.75 * np.exp(-0.5), rel=1e-7)
            assert instance.get("count") == 1
            instance.terminate()
