"""What a trial notes: calls with their times and results, findings, and what the FMU logs."""

from __future__ import annotations

import ctypes
import os
import re
import signal
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import attrs

from posmas_fmi.fmu.check.board import Board
from posmas_fmi.fmu.check.finding import Finding, Severity
from posmas_fmi.fmu.check.surroundings import Surroundings
from posmas_fmi.fmu.instance import status_label

_NO_STATUS = ("dlopen", "dlclose", "GetVersion", "GetTypesPlatform")
_CODES = ("", "warning", "discard", "error", "fatal", "pending")
_UNLIKELY = 0x5EED_0000  # added to what instances give back, which may be 1 by mistake
_LARGE = 64 * 1024  # bytes of one message
_QUOTED = 200  # characters of what an FMU said
_MOST_MESSAGES = 20_000  # in one call …
_MOST_BYTES = 64 * 2**20  # … and together, before the trial ends
_CONVERSION = re.compile(
    rb"%(?:%|[-+ #0]*(?:\d+|\*)?(?:\.(?:\d+|\*)?)?(hh|ll|[hlLqjzt])?(.)|$)", re.S
)


class Journal:
    """Notes of one trial.

    Parameters
    ----------
    board : Board
    surroundings : Surroundings

    Attributes
    ----------
    last : float
        Duration of the last call [s].
    discarded : bool
        Whether a step of FMI 2 returned Discard, which has not been judged.
    said : str
        The last message during the present call.
    """

    def __init__(self, board: Board, surroundings: Surroundings) -> None:
        self.board, self.surroundings = board, surroundings
        self.last = 0.0
        self._known: set[tuple[str, str]] = set()
        self._failed = self._judged = False
        self.discarded = False
        self.messages, self.bytes = 0, 0
        self.said = ""

    @property
    def severity(self) -> Severity:
        """Severity of a failure of the present call."""
        if self.board.phase == "control":  # there ways are tried that an FMU need not know
            return "note"
        return "fatal" if self.board.vital else "error"

    def note(
        self, severity: Severity, code: str, place: str, message: str, remedy: str = ""
    ) -> None:
        """Write a finding down, once for each code and place."""
        if (code, place) not in self._known:
            self._known.add((code, place))
            finding = attrs.asdict(Finding(severity, code, place, message, remedy))
            self.board.add({"finding": finding})

    def result(self, **values: Any) -> None:
        """Write results down."""
        self.board.add({"result": values})

    def judge_discard(self) -> None:
        """Note that a step was discarded, and not because the FMU wants to end the simulation."""
        if self.discarded:
            self.discarded, self._judged = False, True
            self._status("fmi2DoStep", 2)
            self._judged = False

    def told(self) -> bool:
        """Whether a status was noted since the last time this was asked."""
        failed, self._failed = self._failed, False
        return failed

    # ---- calls ----------------------------------------------------------------------------------

    def call(self, name: str) -> Callable[[Any], None]:
        """Note the begin of a call; what is returned notes its end."""
        self.messages = self.bytes = 0
        self.said = ""
        self.board.begin(name)
        began = time.perf_counter()

        def done(result: Any) -> None:
            self.last = time.perf_counter() - began
            self.board.end()
            self._status(name, result)
            for code, text in self.surroundings.changes():
                self.note("warning", code, name, text, "run it in a process of its own")

        return done

    def _status(self, name: str, result: Any) -> None:
        plain = name.endswith(_NO_STATUS) or "nstantiate" in name or "FreeInstance" in name
        if plain or not isinstance(result, int) or result == 0:
            return
        if result == 1:
            self.note("warning", "status-warning", name, "it returned Warning")
            return
        self._failed = True
        if (name, result) == ("fmi2DoStep", 2) and not self._judged:
            self.discarded = True  # whether it is a wish to end, it is asked next
            return
        code = f"status-{_CODES[result]}" if 0 < result < len(_CODES) else "status-unknown"
        self.note(
            self.severity,
            code,
            name,
            f"it returned status {result} ({status_label(result)})"
            + (f'; it said "{self.said}"' if self.said else ""),
            "give start values and inputs that suit it with --set" if self.board.vital else "",
        )


class TrialMessages:
    """Messages of the instances of a trial; implements `posmas_fmi.fmu.callbacks.Messages`."""

    def __init__(self, journal: Journal) -> None:
        from fmpy.fmi2 import fmi2CallbackLoggerTYPE
        from fmpy.fmi3 import fmi3LogMessageCallback

        self._journal = journal
        self._kept: deque[str] = deque(maxlen=20)
        self._thread = threading.get_native_id()
        self._environments: set[int] = set()
        self._functions = {
            2: fmi2CallbackLoggerTYPE(
                lambda key, name, s, c, text: self._take(key, s, (name, c, text), text, True)
            ),
            3: fmi3LogMessageCallback(
                lambda key, s, c, text: self._take(key, s, (c, text), text, False)
            ),
        }

    def logger(self, version: int) -> int:
        """Address of the function that FMUs of this FMI version call."""
        return int(ctypes.cast(self._functions[version], ctypes.c_void_p).value or 0)

    def environment(self, key: int) -> int:
        """Return what the instance gives to that function."""
        made = _UNLIKELY + key
        self._environments.add(made)
        return made

    def forget(self, key: int) -> None:
        """Leave out what was said so far."""
        self._kept.clear()

    def of(self, key: int) -> list[str]:
        """Return the last few messages."""
        return list(self._kept)

    def _take(
        self,
        key: int | None,
        status: int,
        texts: tuple[bytes | None, ...],
        text: bytes | None,
        formats: bool,
    ) -> None:
        journal = self._journal
        place = journal.board.call
        journal.messages += 1
        journal.bytes += len(text or b"")
        for code, message in self._abuses(key, status, texts, text or b"", formats):
            journal.note("warning", code, place, message)
        if journal.messages > _MOST_MESSAGES or journal.bytes > _MOST_BYTES:
            journal.note(
                journal.severity,
                "log-endless",
                place,
                f"it logged more than {_MOST_MESSAGES} messages or {_MOST_BYTES >> 20} MiB "
                "in one call",
            )
            os.kill(os.getpid(), signal.SIGKILL)
        self._kept.append((text or b"")[:500].decode("utf-8", "replace"))
        journal.said = " ".join(self._kept[-1][:_QUOTED].split())

    def _abuses(
        self,
        key: int | None,
        status: int,
        texts: tuple[bytes | None, ...],
        text: bytes,
        formats: bool,
    ) -> list[tuple[str, str]]:
        found = []
        if None in texts:
            found.append(("log-null", "it logged a NULL string"))
        try:
            b"".join(t for t in texts if t).decode("utf-8")
        except UnicodeDecodeError:
            found.append(("log-utf8", "it logged text that is not UTF-8"))
        if len(text) > _LARGE:
            found.append(("log-large", f"it logged a message of {len(text)} bytes"))
        if not 0 <= status <= 5:
            found.append(("log-status", f"it logged with status {status}"))
        if (key or 0) not in self._environments:
            found.append(("log-environment", "it did not give back what it was given"))
        if threading.get_native_id() != self._thread:
            found.append(("log-thread", "it logs from a thread of its own"))
        if formats and any(m[2] not in b"diouxXeEfFgGaAcsp" for m in _conversions(text[:_LARGE])):
            found.append(("log-format", "it logged a format that cannot be printed safely"))
        return found


def _conversions(text: bytes) -> list[tuple[bytes, bytes, bytes]]:
    """Return the conversions of a printf format; the last of each is its letter."""
    return [
        (m.group(0), m.group(1) or b"", m.group(2) or b"?")
        for m in _CONVERSION.finditer(text)
        if m.group(0) != b"%%"
    ]
