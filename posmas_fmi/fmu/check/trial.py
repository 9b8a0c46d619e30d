"""The process that trials run in: `python -m posmas_fmi.fmu.check.trial`.

It reads jobs from standard input, one JSON object a line, and lets a copy of itself (fork) do each
of them, so that what is slow to import is imported once. For each job it writes two lines: the
process id of the copy, and how it ended.
"""

from __future__ import annotations

import ctypes
import json
import os
import select
import shutil
import signal
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

_LOOK = 0.005  # s between two looks at a copy
_DIE_WITH_PARENT = 1  # prctl's PR_SET_PDEATHSIG


def main() -> None:
    """Do jobs until standard input ends."""
    from importlib import import_module

    for name in ("fmpy.fmi2", "fmpy.fmi3", "scipy.linalg", "posmas_fmi.fmu.check.phases"):
        import_module(name)

    _say({"ready": True})
    while line := os.read(0, 1 << 20):  # one job at a time is sent
        while not line.endswith(b"\n"):
            line += os.read(0, 1 << 20) or b"\n"
        job = json.loads(line)
        copy = os.fork()
        if copy == 0:
            _attempt(job)
        _say({"process": copy})
        code, left = _wait(copy, Path(job["folder"]))
        _say({"ended": code, "left": left})


def _say(content: dict[str, Any]) -> None:
    os.write(1, json.dumps(content).encode() + b"\n")


def _wait(copy: int, folder: Path) -> tuple[int, int]:
    """Wait for the end of a copy: its code, and how many processes it left.

    End it and remove its files if nobody waits for us any more.
    """
    while True:
        process, status = os.waitpid(copy, os.WNOHANG)
        if process:
            break
        if select.select([0], [], [], _LOOK)[0]:  # no job is sent now: it was closed
            _end_group(copy)
            os.waitpid(copy, 0)
            _end_left()
            shutil.rmtree(folder, ignore_errors=True)
            os._exit(0)
    left = _end_left()
    _end_group(copy)
    return os.waitstatus_to_exitcode(status), left


def _end_left() -> int:
    from posmas_fmi.fmu.descendants import MARK, end_marked

    return end_marked(os.environ.get(MARK, ""))


def _end_group(leader: int) -> None:
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(leader, signal.SIGKILL)


def _attempt(job: dict[str, Any]) -> None:
    """Do a job in this process, and end it."""
    code = 1
    try:
        os.setsid()
        if sys.platform == "linux":
            ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGKILL)
        _bound(job["memory"], job["output"])
        folder = Path(job["folder"])
        with (folder / "output.txt").open("ab") as output, Path(os.devnull).open("rb") as nothing:
            os.dup2(nothing.fileno(), 0)
            os.dup2(output.fileno(), 1)
            os.dup2(output.fileno(), 2)
        work = folder / "work"
        work.mkdir(exist_ok=True)
        os.chdir(work)
        os.environ["TMPDIR"] = str(work)
        _try(folder / "board", job)
        code = 0
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        os._exit(code)


def _try(path: Path, job: dict[str, Any]) -> None:
    import logging

    from posmas_fmi.fmu.check.board import Board
    from posmas_fmi.fmu.check.journal import Journal
    from posmas_fmi.fmu.check.phases import Job, Trial
    from posmas_fmi.fmu.check.surroundings import Surroundings

    logging.disable()  # warnings of the FMU are findings here
    board = Board(path)
    facts = job["job"]
    for key in ("inputs", "outputs", "phases"):
        facts[key] = tuple(facts[key])
    Trial(Job(**facts), Journal(board, Surroundings())).run()
    board.finish()


def _bound(memory: float, output: float) -> None:
    """Bound memory [bytes] and the size of any file that is written [bytes]."""
    import resource

    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for limit, most in ((resource.RLIMIT_DATA, 2 * memory), (resource.RLIMIT_FSIZE, output)):
        _, hard = resource.getrlimit(limit)
        if hard == resource.RLIM_INFINITY or most < hard:
            resource.setrlimit(limit, (int(most), hard))
    signal.signal(signal.SIGXFSZ, signal.SIG_DFL)  # Python ignores it
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.SIG_DFL)


if __name__ == "__main__":
    main()
