"""Regression against reference results: the shipped one passes, a changed one does not."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

from posmas_fmi.errors import FmuError, InputError
from posmas_fmi.fmu.build import build_plants
from posmas_fmi.fmu.compare import Band, read_reference, regress
from posmas_fmi.fmu.compile import host
from posmas_fmi.resources import shipped

FOLDER = shipped("plant_fmus") / "positive_agent"
REFERENCE = FOLDER / "reference.csv"


@pytest.fixture(scope="module")
def fmus(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("plants")
    return build_plants(["positive_agent"], folder, [host().name])


def test_the_shipped_reference_passes(fmus: list[Path]) -> None:
    for path in fmus:
        result = regress(path, REFERENCE)
        assert result.passed
        assert [d.name for d in result.deviations] == ["x[1]", "x[2]", "y[1]", "y[2]"]
        assert max(d.largest for d in result.deviations) < 1e-8


@pytest.mark.parametrize("size", [1e-5, 0.5])
def test_a_perturbed_reference_fails(fmus: list[Path], tmp_path: Path, size: float) -> None:
    rows = REFERENCE.read_text().splitlines()
    values = rows[40].split(",")
    values[3] = repr(float(values[3]) + size)
    rows[40] = ",".join(values)
    (tmp_path / "perturbed.csv").write_text("\n".join(rows))
    for path in fmus:
        result = regress(path, tmp_path / "perturbed.csv")
        assert not result.passed
        bad = [d for d in result.deviations if not d.inside]
        assert [d.name for d in bad] == ["x[2]"]
        assert bad[0].largest == pytest.approx(size, rel=1e-3)
        assert bad[0].time == pytest.approx(float(values[0]))


@pytest.mark.parametrize(("part", "passes"), [(0.05, True), (0.15, False)])
def test_the_default_band_is_a_tenth_of_the_range(
    fmus: list[Path], tmp_path: Path, part: float, passes: bool
) -> None:
    kept = read_reference(REFERENCE)
    values = kept.values.copy()
    values[:, 1] += part * np.ptp(values[:, 1])
    table = np.column_stack([kept.time, values])
    header = ",".join(["time", *kept.names])
    np.savetxt(tmp_path / "shifted.csv", table, delimiter=",", header=header, comments="")
    assert regress(fmus[0], tmp_path / "shifted.csv", Band(width=0)).passed == passes
    assert not regress(fmus[0], tmp_path / "shifted.csv", kept.band).passed


def test_a_perturbed_fmu_fails(fmus: list[Path], tmp_path: Path) -> None:
    """The other way round: the same reference, but for another input."""
    text = REFERENCE.read_text().replace("\n0.0,0.4,", "\n0.0,0.3,")
    (tmp_path / "other.csv").write_text(text)
    assert not regress(fmus[0], tmp_path / "other.csv").passed


def test_the_reference_is_what_its_script_makes() -> None:
    made = runpy.run_path(str(FOLDER / "make_reference.py"))["reference"]()
    kept = read_reference(REFERENCE)
    assert kept.names == ("u[1]", "x[1]", "x[2]", "y[1]", "y[2]")
    assert np.abs(made[:, 0] - kept.time).max() < 1e-12
    assert np.abs(made[:, 1:] - kept.values).max() < 1e-9


def test_the_band_follows_the_reference_in_time() -> None:
    time = np.linspace(0, 10, 101)
    step = (time > 5).astype(float)
    low, high = Band(height=0.01, width=0.02).limits(time, step)
    late = (time > 5.15).astype(float)
    assert ((low <= late) & (late <= high)).all()
    too_late = (time > 5.35).astype(float)
    assert not ((low <= too_late) & (too_late <= high)).all()
    low, high = Band(height=0.1, width=0).limits(time, np.full(101, -3.0))
    assert (low[0], high[0]) == pytest.approx((-3.3, -2.7))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "two rows"),
        ("time,x[1]\n0,1\n", "two rows"),
        ("x[1],time\n0,1\n1,1\n", "expected columns time"),
        ("time,x[1],x[1]\n0,1,1\n1,1,1\n", "without repetition"),
        ("time,x[1]\n0,1\n1\n", "row 3"),
        ("time,x[1]\n0,1\n1,hot\n", "expected numbers"),
        ("time,x[1]\n0,1\n1,nan\n", "finite"),
        ("time,x[1]\n0,1\n0,1\n", "increasing"),
        ("# band: height=tall, width=0\ntime,x[1]\n0,1\n1,1\n", "expected numbers in"),
        ("time,u[1]\n0,1\n1,1\n", "only inputs"),
    ],
)
def test_references_that_cannot_be_used(
    fmus: list[Path], tmp_path: Path, text: str, message: str
) -> None:
    (tmp_path / "reference.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        regress(fmus[1], tmp_path / "reference.csv")


def test_files_that_cannot_be_used(fmus: list[Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected a CSV file"):
        regress(fmus[0], tmp_path)
    (tmp_path / "binary.csv").write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match="expected a CSV file"):
        regress(fmus[0], tmp_path / "binary.csv")
    (tmp_path / "other.csv").write_text("time,z\n0,1\n1,1\n")
    with pytest.raises(FmuError, match="no variable 'z'"):
        regress(fmus[0], tmp_path / "other.csv")
