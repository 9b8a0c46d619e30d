"""Trials of FMUs from outside: starts them, bounds them, and says how they ended."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import attrs

import posmas_fmi
from posmas_fmi.errors import FmuError
from posmas_fmi.fmu.archive import unpack
from posmas_fmi.fmu.check.board import Board
from posmas_fmi.fmu.check.finding import Finding
from posmas_fmi.fmu.check.surroundings import handles_of, resident_of
from posmas_fmi.fmu.descendants import MARK, new_mark
from posmas_fmi.fmu.scratch import size_of

PARTS = ("life", "reset", "rollback", "second", "leaks", "unload")
CONTROL = ("control",)
_LOOK = 0.02  # s
_START = 60.0  # s for the process to be ready
_SELDOM = 0.3  # s between two looks at what it has written
_TAIL = 300  # characters of output that are told
# the package is found where this process has it, and nothing else comes from there
_CODE = (
    "import sys; sys.path.insert(0, sys.argv[1]); import posmas_fmi; del sys.path[0]; "
    "from posmas_fmi.fmu.check.trial import main; main()"
)
_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


@attrs.frozen
class Bounds:
    """What a trial may take.

    Attributes
    ----------
    call : float
        Longest call into the FMU [s].
    whole : float
        Longest trial [s].
    memory : int
        Resident memory [bytes].
    output : int
        Size of a file that it writes, its output among them [bytes].
    handles : int
        Open files, sockets and the like.
    files : int
        In its folder for temporary files [bytes].
    """

    call: float = 10.0
    whole: float = 120.0
    memory: int = 2 * 2**30
    output: int = 256 * 2**20
    handles: int = 4096
    files: int = 2 * 2**30


@attrs.frozen
class Outcome:
    """What trials of an FMU have shown.

    Attributes
    ----------
    findings : tuple of Finding
    results : dict
        Measurements by name; empty if it did not come that far.
    """

    findings: tuple[Finding, ...] = ()
    results: dict[str, Any] = attrs.field(factory=dict)


class Supervisor:
    """A process that tries FMUs, one after the other; started when it is first needed.

    Parameters
    ----------
    bounds : Bounds, optional

    Notes
    -----
    Use as a context manager, or call `close`. Needs a system that has fork (Linux, macOS).
    """

    def __init__(self, bounds: Bounds | None = None) -> None:
        self.bounds = bounds or Bounds()
        self._server: subprocess.Popen[bytes] | None = None
        self._pending = b""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the process, and a trial that is still going on."""
        server, self._server = self._server, None
        if server is not None:
            assert server.stdin is not None
            assert server.stdout is not None
            with suppress(OSError):
                server.stdin.close()
            try:
                server.wait(2.0)
            except subprocess.TimeoutExpired:
                server.kill()
                server.wait()
            server.stdout.close()

    def examine(
        self,
        fmu: Path,
        job: dict[str, Any],
        bounds: Bounds | None = None,
        control: bool = True,
    ) -> Outcome:
        """Try an FMU whose archive was found safe.

        Parameters
        ----------
        fmu : Path
        job : dict
            Attributes of `posmas_fmi.fmu.check.phases.Job` but for fmu, unpacked and phases.
        bounds : Bounds, optional
            In place of the usual ones.
        control : bool
            Whether the control report is made as well.
        """
        if not hasattr(os, "fork"):
            text = "trials need a system with fork (Linux, macOS): it was not run"
            return Outcome((Finding("note", "not-tried", "", text),))
        bounds = bounds or self.bounds
        with tempfile.TemporaryDirectory(
            prefix="posmas-fmi-check-", ignore_cleanup_errors=True
        ) as name:
            unpacked = Path(name, "fmu")
            unpack(fmu, unpacked)
            facts = {**job, "fmu": str(fmu), "unpacked": str(unpacked)}
            outcome = self._parts(Path(name), facts, PARTS, bounds)
            if control and not any(f.severity == "fatal" for f in outcome.findings):
                more = self._parts(Path(name), facts, CONTROL, bounds)
                known = {(f.code, f.place) for f in outcome.findings}
                outcome = Outcome(
                    (
                        *outcome.findings,
                        *(f for f in more.findings if (f.code, f.place) not in known),
                    ),
                    {**outcome.results, **more.results},
                )
        return outcome

    def _parts(
        self, folder: Path, job: dict[str, Any], left: Sequence[str], bounds: Bounds
    ) -> Outcome:
        """Go through parts of a trial, in a new process after each that was the end of one."""
        findings: list[Finding] = []
        results: dict[str, Any] = {}
        while left:
            attempt = self._attempt(folder, {**job, "phases": left}, bounds)
            known = {(f.code, f.place) for f in findings}
            new = [f for f in attempt.findings if (f.code, f.place) not in known]
            findings += new
            results.update(attempt.results)
            if attempt.done or attempt.phase not in left or _is_vital(attempt):
                break
            if not new:  # it would go on like this
                break
            left = left[left.index(attempt.phase) + 1 :]
        return Outcome(tuple(findings), results)

    def _attempt(self, folder: Path, facts: dict[str, Any], bounds: Bounds) -> _Attempt:
        Board.create(folder / "board")
        (folder / "output.txt").write_bytes(b"")
        board = Board(folder / "board")
        try:
            self._send(
                {
                    "folder": str(folder),
                    "memory": bounds.memory,
                    "output": bounds.output,
                    "job": facts,
                }
            )
            process = int(self._receive(_START)["process"])
            why = self._watch(process, folder / "work", board, bounds)
            end = self._receive(_START)
            code, left = int(end["ended"]), int(end["left"])
            board.look()
            findings, results = _read(board)
            if why is None and not board.done:
                why = _ending(code, board, findings)
            if why is not None:
                findings.append(_with_output(why, folder / "output.txt"))
            if left:
                text = f"{left} processes that it started had to be ended"
                findings.append(Finding("warning", "leaves-processes", "", text))
            phase = "rollback" if board.phase == "serialisation" else board.phase
            return _Attempt(tuple(findings), results, phase, board.done)
        finally:
            board.close()

    def _watch(self, process: int, work: Path, board: Board, bounds: Bounds) -> Finding | None:
        """Wait for the end of a trial; return why it was ended, if it was."""
        began = since = time.monotonic()
        calls, counted = -1, began
        handles = _most_handles(bounds)
        while not self._ready(_LOOK):
            board.look()
            now = time.monotonic()
            written = 0
            if now - counted > _SELDOM:
                written = size_of(work, bounds.files)
                counted = time.monotonic()
            if board.calls != calls:
                calls, since = board.calls, now
            why = None
            if board.calling and now - since > bounds.call:
                why = ("hang", f"it did not come back within {bounds.call:g} s")
            elif now - began > bounds.whole:
                why = ("too-slow", f"the trial took more than {bounds.whole:g} s")
            elif resident_of(process) > bounds.memory:
                text = f"it took more than {bounds.memory / 2**20:.0f} MiB of memory"
                why = ("memory-limit", text)
            elif handles_of(process) > handles:
                why = ("handles-limit", f"it opened more than {handles} files")
            elif written > bounds.files:
                text = f"it wrote more than {bounds.files / 2**20:.0f} MiB of temporary files"
                why = ("files-limit", text)
            if why is not None:
                with suppress(ProcessLookupError, PermissionError):
                    os.killpg(process, signal.SIGKILL)
                return Finding(_severity(board), why[0], _place(board), why[1])
        return None

    # ---- the process ----------------------------------------------------------------------------

    def _send(self, content: dict[str, Any]) -> None:
        server = self._started()
        assert server.stdin is not None
        server.stdin.write(json.dumps(content).encode() + b"\n")
        server.stdin.flush()

    def _started(self) -> subprocess.Popen[bytes]:
        if self._server is None:
            self._pending = b""
            self._server = subprocess.Popen(
                [sys.executable, "-P", "-c", _CODE, _package()],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                start_new_session=True,  # Ctrl-C is for us
                env={**os.environ, **_ONE_THREAD, MARK: new_mark()},
            )
            self._receive(_START)
        return self._server

    def _ready(self, patience: float) -> bool:
        if b"\n" in self._pending:
            return True
        assert self._server is not None
        assert self._server.stdout is not None
        return bool(select.select([self._server.stdout], [], [], patience)[0])

    def _receive(self, patience: float) -> dict[str, Any]:
        until = time.monotonic() + patience
        assert self._server is not None
        assert self._server.stdout is not None
        while b"\n" not in self._pending:
            data = b""
            if self._ready(max(0.0, until - time.monotonic())):
                data = os.read(self._server.stdout.fileno(), 1 << 16)
            if not data:
                self.close()
                raise FmuError("the process that tries FMUs has ended or does not answer")
            self._pending += data
        line, _, self._pending = self._pending.partition(b"\n")
        answer: dict[str, Any] = json.loads(line)
        return answer


@attrs.frozen
class _Attempt:
    """One process, from its start to its end."""

    findings: tuple[Finding, ...]
    results: dict[str, Any]
    phase: str
    done: bool


def _most_handles(bounds: Bounds) -> int:
    """How many descriptors it may open; it is told before the system refuses to open more."""
    import resource

    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return bounds.handles if soft == resource.RLIM_INFINITY else min(bounds.handles, soft - 16)


def _is_vital(attempt: _Attempt) -> bool:
    """Whether nothing more can be tried."""
    return any(f.severity == "fatal" for f in attempt.findings)


def _read(board: Board) -> tuple[list[Finding], dict[str, Any]]:
    findings: list[Finding] = []
    results: dict[str, Any] = {}
    for entry in board.entries():
        with suppress(TypeError, ValueError):  # damaged by the FMU
            if "finding" in entry:
                findings.append(Finding(**entry["finding"]))
            elif "result" in entry:
                results.update(entry["result"])
    return findings, results


def _severity(board: Board) -> Any:
    """Return how bad a failure is: one before the first step makes an FMU useless."""
    return "fatal" if board.vital else "error"


def _place(board: Board) -> str:
    if board.calling:
        return board.call
    return f"after {board.call}" if board.call else board.phase


def _ending(code: int, board: Board, findings: list[Finding]) -> Finding | None:
    """Return what the end of a process says that did not come to its own end."""
    severity, place = _severity(board), _place(board)
    if any(f.code == "log-endless" for f in findings):
        return None
    if code >= 0:
        text = f"it ended the process with exit code {code}"
        return Finding(severity, "exit", place, text, "it must not run in the master's process")
    if -code == getattr(signal, "SIGXFSZ", 0):
        return Finding(severity, "output-limit", place, "it wrote more to a file than is allowed")
    return Finding(
        severity,
        "crash",
        place,
        f"it ended the process with signal {-code} ({_signal_name(-code)})",
        "it must not run in the master's process",
    )


def _with_output(finding: Finding, path: Path) -> Finding:
    with suppress(OSError), path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - _TAIL))
        text = " ".join(file.read(_TAIL).decode("utf-8", "replace").replace("\0", "").split())
        if text:
            return attrs.evolve(finding, message=f"{finding.message}; it had written: {text}")
    return finding


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return "unknown"


def _package() -> str:
    return str(Path(posmas_fmi.__file__).resolve().parents[1])
