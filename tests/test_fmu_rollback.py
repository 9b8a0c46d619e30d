"""Going back to saved states is tested, and what it does not restore counts as noise."""

from __future__ import annotations

import logging
from pathlib import Path

import attrs
import numpy as np
import pytest
import test_engine
import test_system
from fmu_examples import example_1, named, tank_fmu
from test_fmu_events import CLOCKED, packed

from posmas_fmi.cosim import master
from posmas_fmi.cosim.master import Iteration
from posmas_fmi.fmu import build
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.open import open_fmu
from posmas_fmi.fmu.rollback import Replay, selftest_rollback

EXACT = Replay(True, True, 0.0)
BACK = (
    "    return instance ? (fmi3Status)instance_restore(INSTANCE(instance), FMUState) : fmi3Error;"
)
NOISY = """    static int count;
    fmi3Status back = instance ? (fmi3Status)instance_restore(INSTANCE(instance), FMUState)
                               : fmi3Error;
    if (back == fmi3OK)
        INSTANCE(instance)->state.v[AT_X] += (++count % 3) * 1e-5;
    return back;"""


@pytest.mark.parametrize("fmi", [2, 3])
def test_fmus_that_are_built_here_go_back_exactly(tmp_path: Path, fmi: int) -> None:
    example = example_1()
    values = named({**example.matrices, "x": [1.0, 0.3]}, fmi)
    with FmuFile(example.fmu(fmi, tmp_path)) as file:
        found = selftest_rollback(file, 0.1, values=values, inputs={"u[1]": 0.5})
    assert found.state == found.serialised == found.fresh == EXACT


def test_what_is_not_restored_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    test_engine.changed(monkeypatch, 3, BACK, NOISY)
    with FmuFile(tank_fmu(tmp_path, 3)) as file:
        found = selftest_rollback(file, 0.1, outputs=("temperature",), steps=1)
    assert found.state.works
    assert not found.state.exact
    # 1e-5 K of 300 K, after 0.1 s with a time constant of 25 s
    assert found.state.noise == pytest.approx(1e-5 * np.exp(-0.1 / 25) / 300, rel=0.1)


def test_what_cannot_be_done_is_said(tmp_path: Path) -> None:
    text = (CLOCKED / "model.c").read_text()
    path = packed(tmp_path, text.replace("fmi3SerializedFMUStateSize", "fmi3NothingSize"))
    with open_fmu(path) as file:
        found = selftest_rollback(file, 0.1, inputs={"u": 1.0})
    assert found.state == EXACT
    assert not found.serialised.works
    assert "fmi3SerializedFMUStateSize" in found.serialised.reason
    (tmp_path / "no").mkdir()
    path = packed(tmp_path / "no", text.replace("fmi3GetFMUState", "fmi3GetNothing"))
    with open_fmu(path) as file:
        found = selftest_rollback(file, 0.1)
    assert not found.state.works
    assert "fmi3GetFMUState" in found.state.reason
    assert found.state.noise == np.inf


@pytest.mark.parametrize("noisy", [False, True])
def test_noise_is_part_of_the_tolerance_of_the_coupling(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    noisy: bool,
) -> None:
    """Without it no step of a noisy FMU would ever be good enough."""
    if noisy:
        test_engine.changed(monkeypatch, 3, BACK, NOISY)
    fmu = build.fmu(test_system.tank(), 3, cache=tmp_path)
    definition = attrs.evolve(
        test_system.system(iteration=Iteration(1e-9, 8)), clock=master.Clock.of(0.5, 0.05)
    )
    with test_system.plant(fmu) as plant, caplog.at_level(logging.INFO):
        outcome = master.simulate(definition, plant)
    assert outcome.ended == "complete"
    assert "did not settle" not in caplog.text
    assert ("replays differ by" in caplog.text) == noisy
