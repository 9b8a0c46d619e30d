"""A snapshot of a whole run: controllers, messages, channel and FMUs, to go on from there."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from posmas_fmi.bounded import require_regular
from posmas_fmi.errors import InputError
from posmas_fmi.expression import Array
from posmas_fmi.writing import whole

log = logging.getLogger(__name__)
SAME_PAST = 1e-3  # relative: what FMUs that do not repeat themselves exactly may differ by


@attrs.frozen(eq=False)
class Snapshot:
    """All state of a run at a communication point.

    Attributes
    ----------
    k : int
        The communication point: steps done.
    arrays : dict of str to array
        Of the engine.
    counts : dict
        Figures of the outcome so far, and the state of the random numbers.
    fmus : tuple of bytes or None
        Serialised FMU states, one per instance; None where one of them cannot give it: then the
        FMUs are brought there by running again from the start.
    """

    k: int
    arrays: dict[str, Array]
    counts: dict[str, Any]
    fmus: tuple[bytes, ...] | None

    def save(self, path: Path) -> None:
        """Write it to one file; it is there whole or not at all.

        Parameters
        ----------
        path : Path
            Ending in ``.npz``.

        Raises
        ------
        ResultsError
            If it cannot be written, on a full disk say.
        """
        facts = {"k": self.k, "counts": self.counts, "serialised": self.fmus is not None}
        content: dict[str, Any] = {f"array_{name}": value for name, value in self.arrays.items()}
        for number, data in enumerate(self.fmus or ()):
            content[f"fmu_{number}"] = np.frombuffer(data, dtype=np.uint8)
        content["facts"] = np.frombuffer(json.dumps(facts).encode(), dtype=np.uint8)
        with whole(path, "wb") as file:
            np.savez(file, **content)

    @classmethod
    def load(cls, path: Path) -> Snapshot:
        """Read it back.

        Raises
        ------
        InputError
            If the file is not a snapshot.
        """
        try:
            require_regular(path)
            with path.open("rb") as file, np.load(file, allow_pickle=False) as content:
                facts = json.loads(content["facts"].tobytes())
                names = [name for name in content.files if name.startswith("array_")]
                arrays = {name.removeprefix("array_"): content[name] for name in names}
                count = sum(name.startswith("fmu_") for name in content.files)
                states = tuple(content[f"fmu_{k}"].tobytes() for k in range(count))
            serialised = states if facts["serialised"] else None
            if path.stem.isdigit() and int(path.stem) != int(facts["k"]):
                raise ValueError(f"it is of communication point {facts['k']}")
            return cls(int(facts["k"]), arrays, dict(facts["counts"]), serialised)
        except Exception as error:  # whatever NumPy and zipfile raise on a broken file
            raise InputError(f"this is not a snapshot of a run: {error}", str(path)) from None


@attrs.frozen(eq=False)
class Snapshots:
    """Where a run begins, and what is done with its snapshots.

    Attributes
    ----------
    start : Snapshot, optional
    every : int
        Communication steps between snapshots; 0: none.
    keep : callable
        Gets each of them.
    branches : bool
        Whether the run is another one than that of the snapshot. Then what is done again to get
        there must come to the same.
    """

    start: Snapshot | None = None
    every: int = 0
    keep: Callable[[Snapshot], None] = lambda snapshot: None
    branches: bool = False

    def compare(self, arrays: dict[str, Array]) -> None:
        """See that a run that was done again up to the snapshot is what it was.

        Parameters
        ----------
        arrays : dict of str to array
            As they are now; those that the snapshot has are compared.

        Raises
        ------
        InputError
            If another run was to begin there, and its past is not the same.
        """
        assert self.start is not None
        worst = max(
            (
                float((np.abs(arrays[name] - kept) / np.maximum(1.0, np.abs(kept))).max(initial=0))
                for name, kept in self.start.arrays.items()
                if name in arrays
            ),
            default=0.0,
        )
        if self.branches and not worst <= SAME_PAST:
            raise InputError(
                "these FMUs or controllers cannot give their state, so the run is done again up to "
                f"the snapshot; with this scenario its past is another one (off by {worst:.2g}): "
                "what is to be different must begin at the snapshot or later, as a fault, a jump "
                "of the leader or a signal does"
            )
        if worst > 0:
            log.warning("run again, the FMUs do not repeat themselves: up to %.2g apart", worst)


def newest(folder: Path, at_most: int) -> Path | None:
    """Return the file of the last snapshot in a folder at or before a communication point."""
    found = [
        (int(path.stem), path)
        for path in folder.glob("*.npz")
        if path.stem.isdigit() and int(path.stem) <= at_most
    ]
    return max(found, default=(0, None))[1]
