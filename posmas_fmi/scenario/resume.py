"""Going on with a run that ended early, or from a point of another run."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from posmas_fmi.bounded import require_regular
from posmas_fmi.cosim.snapshot import Snapshot, Snapshots, newest
from posmas_fmi.errors import InputError
from posmas_fmi.netcdf import read_netcdf, recorded
from posmas_fmi.scenario.build import Scenario

FOLDER = "snapshots"
SAME = {  # what must not have changed in a run that goes on
    "scenario_sha256": "the scenario",
    "seed": "the seed",
    "period": "the period",
    "fmus": "the FMUs",
    "inputs": "the input files",
}
INSIDE = {"fmus": "the FMUs", "start_values_sha256": "start values"}  # of what snapshots hold


@attrs.frozen(eq=False)
class Beginning:
    """Where a run begins.

    Attributes
    ----------
    snapshot : Snapshot or None
        None: at the start.
    keep : int or None
        Rows of the results that are kept; None: results of their own.
    origin : int
        The communication point where its results begin: of a branch, that of the snapshot that it
        began with.
    branch : dict
        What the manifest says about a branch; empty for other runs.
    """

    snapshot: Snapshot | None = None
    keep: int | None = None
    origin: int = 0
    branch: dict[str, Any] = attrs.field(factory=dict)

    @property
    def k(self) -> int:
        """The communication point."""
        return 0 if self.snapshot is None else self.snapshot.k


def resumed(scenario: Scenario, folder: Path, manifest: dict[str, Any]) -> Beginning:
    """Return where a run in a folder goes on: at its last snapshot, or at its start.

    Parameters
    ----------
    scenario : Scenario
    folder : Path
        With manifest.json, results.nc and perhaps snapshots.
    manifest : dict
        Of the run that is to go on.

    Raises
    ------
    InputError
        If there is no run, it is complete, or it was of something else.
    """
    before = _manifest(folder)
    for key, what in SAME.items():
        if before.get(key) != manifest[key]:
            raise InputError(
                f"{what} changed since that run ({key}); start it anew, or go on from one of its "
                "snapshots with --branch DIR --at S and another --out",
                str(folder / "manifest.json"),
            )
    rows, complete = _rows(folder / "results.nc")
    if complete:
        raise InputError("the run is complete: there is nothing to go on with", str(folder))
    every = scenario.record.every
    branch = before.get("branch") or {}
    origin = round(branch.get("at", 0.0) / scenario.clock.h)
    earlier = -(-origin // every)  # rows that a branch does not have
    found = newest(folder / FOLDER, min((rows + earlier) * every, scenario.clock.steps))
    if found is None:
        if branch:
            raise InputError(
                "the snapshot that this branch began with is gone; make the branch again",
                str(folder / FOLDER),
            )
        return Beginning()
    snapshot = Snapshot.load(found)
    keep = -(-snapshot.k // every) - earlier
    return Beginning(snapshot, keep or None, origin, branch)


def branched(scenario: Scenario, folder: Path, at: float, manifest: dict[str, Any]) -> Beginning:
    """Return a beginning at a snapshot of another run.

    Parameters
    ----------
    scenario : Scenario
        With which the run goes on: the same FMUs with the same start values, agents and network
        of the same sizes.
    folder : Path
        Of the other run.
    at : float
        Time of the snapshot [s].
    manifest : dict
        Of the run that begins.

    Raises
    ------
    InputError
        If there is none at that time, the run ends by then, or the period, an FMU or a start value
        is another.
    """
    before = _manifest(folder)
    if before.get("period") != scenario.clock.h:
        raise InputError(
            f"that run has the period {before.get('period')} s (here it is {scenario.clock.h:g} s)",
            str(folder),
        )
    h = scenario.clock.h
    k = round(at / h) if math.isfinite(at) else -1
    path = folder / FOLDER / f"{k}.npz"
    if not path.is_file() or abs(at - scenario.clock.time(k)) > 1e-6 * h:
        known = sorted(int(p.stem) for p in (folder / FOLDER).glob("*.npz") if p.stem.isdigit())
        times = ", ".join(f"{scenario.clock.time(n):g}" for n in known[:20]) or "none"
        raise InputError(
            f"there is no snapshot at {at:g} s (there is: {times}); [scenario] snapshot = S makes "
            "one every S seconds",
            str(folder),
        )
    if k >= scenario.clock.steps:
        raise InputError(
            f"the run ends at {scenario.clock.time(scenario.clock.steps):g} s, no later than that "
            "snapshot: give --until S",
            "$.scenario.until",
        )
    for key, what in INSIDE.items():
        if key in before and before[key] != manifest[key]:
            raise InputError(
                f"{what} are not those of that run ({key}), and they are part of its snapshots; "
                "what is to be different must begin at the snapshot or later, as a fault, a jump "
                "of the leader or a signal does",
                str(folder / "manifest.json"),
            )
    return Beginning(Snapshot.load(path), None, k, {"of": folder.name, "at": at})


def snapshots(scenario: Scenario, folder: Path, beginning: Beginning) -> Snapshots:
    """Return where the run begins, and keep snapshots in its folder as the scenario wants."""
    place = folder / FOLDER
    every = round(scenario.settings.snapshot / scenario.clock.h)
    forget_snapshots(folder, beginning.k if beginning.keep is not None else -1)
    if every or beginning.branch:
        place.mkdir(exist_ok=True)
    if beginning.branch and beginning.k == beginning.origin:  # to go on with, if it is cut off
        assert beginning.snapshot is not None
        beginning.snapshot.save(place / f"{beginning.k}.npz")

    def keep(snapshot: Snapshot) -> None:
        snapshot.save(place / f"{snapshot.k}.npz")

    return Snapshots(beginning.snapshot, every, keep, branches=beginning.keep is None)


def forget_snapshots(folder: Path, after: int = -1) -> None:
    """Remove those after a communication point, or all of them."""
    for path in (folder / FOLDER).glob("*.npz*"):
        if not path.stem.isdigit() or int(path.stem) > after:
            path.unlink()


def _manifest(folder: Path) -> dict[str, Any]:
    path = folder / "manifest.json"
    try:
        require_regular(path)
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise InputError("there is no run to go on with", str(folder)) from None
    return content if isinstance(content, dict) else {}


def _rows(path: Path) -> tuple[int, bool]:
    """Rows of a result, and whether it is complete; none where there is no file yet."""
    if not path.exists():
        return 0, False
    try:
        file = read_netcdf(path, ("time",))
    except InputError as error:
        raise InputError(
            f"cannot go on with these results: {error.message}; start the run anew", str(path)
        ) from None
    time = file.variables["time"].numbers if "time" in file.variables else None
    return (0 if time is None else recorded(time)), bool(np.all(file.attrs.get("complete", 0)))
