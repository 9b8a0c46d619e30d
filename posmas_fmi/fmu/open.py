"""Opening an FMU by what it offers: Co-Simulation, else Model Exchange through an integrator."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from posmas_fmi.fmu.about import read_about
from posmas_fmi.fmu.binding import Trace
from posmas_fmi.fmu.callbacks import Messages
from posmas_fmi.fmu.event_mode import EventFile, needs_event_mode
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.fmi1 import Fmi1File, Fmi1SteppedFile
from posmas_fmi.fmu.stepped import SteppedFile


def open_fmu(
    path: str | Path,
    messages: Messages | None = None,
    trace: Trace | None = None,
    unpacked: Path | None = None,
    structure: Mapping[str, int] | None = None,
) -> FmuFile:
    """Open an FMU whose instances take communication steps; parameters as `FmuFile`.

    Raises
    ------
    ArchiveError
        If the file cannot be unpacked or its description not be read.
    FmuError
        If it is for Scheduled Execution only, or has no binary that loads here.
    """
    about = read_about(Path(path))
    about.require_interface()
    kind: type[FmuFile] = FmuFile if about.kind == "Co-Simulation" else SteppedFile
    if about.version == 1:
        kind = Fmi1File if about.kind == "Co-Simulation" else Fmi1SteppedFile
    if needs_event_mode(about):
        kind = EventFile
    return kind(path, messages, trace, unpacked, structure)
