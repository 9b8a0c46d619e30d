"""Snapshots of a whole run: going on from one is the same run, bit for bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
from test_system import SYSTEMS, H, fmu, plant, system  # noqa: F401  (fmu is a fixture)

from posmas_fmi.cosim import engine
from posmas_fmi.cosim.clock import Clock
from posmas_fmi.cosim.fmu_plant import FmuPlant
from posmas_fmi.cosim.master import Outcome, System
from posmas_fmi.cosim.snapshot import Snapshot, newest
from posmas_fmi.errors import InputError

Rows = dict[str, np.ndarray]


def go(
    definition: System, path: Path, snapshots: engine.Snapshots | None, which: Any = "c"
) -> tuple[Outcome, Rows]:
    rows: dict[str, list[np.ndarray]] = {}

    def record(times: np.ndarray, values: Rows) -> None:
        for name, value in {"time": times, **values}.items():
            rows.setdefault(name, []).append(value.copy())

    with plant(path) as plants:
        choice = engine.choose(definition.law, which)
        outcome = engine.run(definition, plants, record, choice=choice, snapshots=snapshots)
    return outcome, {name: np.concatenate(blocks) for name, blocks in rows.items()}


@pytest.fixture
def no_states(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FmuPlant, "serialise", lambda self: None)


def same_from(k: int, rows: Rows, expected: Rows) -> None:
    for name, value in expected.items():
        np.testing.assert_array_equal(rows[name], value[k:], err_msg=name)


def same_outcome(outcome: Outcome, expected: Outcome) -> None:
    assert (outcome.steps, outcome.messages, outcome.lost) == (
        expected.steps,
        expected.messages,
        expected.lost,
    )
    np.testing.assert_array_equal(outcome.min_state, expected.min_state)
    np.testing.assert_array_equal(outcome.tracking_error, expected.tracking_error)


NAMES = ["wired", "delay", "everything", "longer periods", "leader jumps", "noise", "distributed"]


@pytest.mark.parametrize("name", NAMES)
def test_going_on_is_the_same_run_bit_for_bit(name: str, fmu: Path, tmp_path: Path) -> None:  # noqa: F811
    kept: list[Snapshot] = []
    expected, rows = go(system(**SYSTEMS[name]), fmu, None)
    taking, taken_rows = go(system(**SYSTEMS[name]), fmu, engine.Snapshots(None, 10, kept.append))
    same_outcome(taking, expected)
    same_from(0, taken_rows, rows)
    assert [snapshot.k for snapshot in kept] == [10, 20, 30, 40, 50, 60]
    for snapshot in (kept[0], kept[2]):
        snapshot.save(tmp_path / f"{snapshot.k}.npz")
        again = Snapshot.load(tmp_path / f"{snapshot.k}.npz")
        outcome, after = go(system(**SYSTEMS[name]), fmu, engine.Snapshots(again))
        same_from(snapshot.k, after, rows)
        same_outcome(outcome, expected)


@pytest.mark.usefixtures("no_states")
@pytest.mark.parametrize("name", ["everything", "delay"])
def test_fmus_that_cannot_give_their_state_do_all_again(name: str, fmu: Path) -> None:  # noqa: F811
    kept: list[Snapshot] = []
    expected, rows = go(system(**SYSTEMS[name]), fmu, engine.Snapshots(None, 25, kept.append))
    assert kept[0].fmus is None
    outcome, after = go(system(**SYSTEMS[name]), fmu, engine.Snapshots(kept[0]))
    same_from(25, after, rows)
    same_outcome(outcome, expected)


def test_the_numpy_loop_records_from_there_on(fmu: Path) -> None:  # noqa: F811
    kept: list[Snapshot] = []
    go(system(), fmu, engine.Snapshots(None, 20, kept.append))
    _, rows = go(system(), fmu, None, "numpy")
    _, after = go(system(), fmu, engine.Snapshots(kept[0]), "numpy")
    same_from(20, after, rows)


def test_the_numpy_loop_keeps_them_too(fmu: Path) -> None:  # noqa: F811
    kept: list[Snapshot] = []
    _, rows = go(system(), fmu, engine.Snapshots(None, 20, kept.append), "numpy")
    assert [snapshot.k for snapshot in kept] == [20, 40, 60]
    _, after = go(system(), fmu, engine.Snapshots(kept[1]), "numpy")
    same_from(40, after, rows)


@pytest.mark.usefixtures("no_states")
@pytest.mark.parametrize("which", ["c", "numpy"])
def test_a_branch_that_is_done_again_has_the_same_past(fmu: Path, which: str) -> None:  # noqa: F811
    kept: list[Snapshot] = []
    _, rows = go(system(), fmu, engine.Snapshots(None, 20, kept.append), which)
    later = system(leader_changes=((30, np.array([5.0])),))
    _, after = go(later, fmu, engine.Snapshots(kept[0], branches=True), which)
    np.testing.assert_array_equal(after["x"][:11], rows["x"][20:31])
    assert np.abs(after["x"][-1] - rows["x"][-1]).max() > 0.1
    earlier = system(leader_changes=((10, np.array([5.0])),))
    with pytest.raises(InputError, match="its past is another one"):
        go(earlier, fmu, engine.Snapshots(kept[0], branches=True), which)


def test_a_branch_goes_on_otherwise(fmu: Path) -> None:  # noqa: F811
    """The same past, another leader from 30 on."""
    kept: list[Snapshot] = []
    _, rows = go(system(), fmu, engine.Snapshots(None, 20, kept.append))
    branch = system(leader_changes=((30, np.array([5.0])),))
    _, after = go(branch, fmu, engine.Snapshots(kept[0]))
    np.testing.assert_array_equal(after["x"][:11], rows["x"][20:31])
    assert np.abs(after["x"][-1] - rows["x"][-1]).max() > 0.1


def test_what_is_no_snapshot_of_this_system(fmu: Path, tmp_path: Path) -> None:  # noqa: F811
    (tmp_path / "7.npz").write_bytes(b"nonsense")
    with pytest.raises(InputError, match="not a snapshot"):
        Snapshot.load(tmp_path / "7.npz")
    kept: list[Snapshot] = []
    go(system(channel={"delay": 0.15}), fmu, engine.Snapshots(None, 20, kept.append))
    with pytest.raises(InputError, match="another system: message"):
        go(system(), fmu, engine.Snapshots(kept[0]))


def test_the_newest_snapshot_of_a_folder(tmp_path: Path) -> None:
    for name in ("10.npz", "200.npz", "30.npz", "x.npz", "40.partial.npz"):
        (tmp_path / name).touch()
    assert newest(tmp_path, 100) == tmp_path / "30.npz"
    assert newest(tmp_path, 5) is None


def test_thousands_of_snapshots_are_kept(fmu: Path) -> None:  # noqa: F811
    """Each ends what the engine does at a time, whose length follows from what was done."""
    kept: list[int] = []
    definition = attrs.evolve(system(), clock=Clock.of(1200 * H, H))
    outcome, _ = go(definition, fmu, engine.Snapshots(None, 1, lambda one: kept.append(one.k)))
    assert outcome.ended == "complete"
    assert kept == list(range(1, 1201))
