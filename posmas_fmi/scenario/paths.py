"""Which files a scenario may name: those in its own folder."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from posmas_fmi.scenario.tables import NetworkTable, SignalTable

Named = tuple[str, str | None]  # the place in the scenario, and the file if there is one


def data_files(network: NetworkTable, signals: Mapping[str, SignalTable]) -> list[Named]:
    """Files with the digraph and the signals."""
    return [
        ("$.network.file", network.file),
        *((f"$.signals.{name}.file", signal.file) for name, signal in signals.items()),
    ]


def leaving(folder: Path, named: Iterable[Named]) -> list[tuple[str, str]]:
    """Return a problem for each file that lies outside a folder, also by way of a link."""
    folder = folder.resolve()
    return [
        (
            place,
            f"{name!r} lies outside the scenario's folder; if you trust the scenario allow that "
            "with --outside (load(…, outside=True))",
        )
        for place, name in named
        if name and not (folder / name).resolve().is_relative_to(folder)
    ]
