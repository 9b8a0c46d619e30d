"""A function that may crash or hang, called in a process of its own."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any

import posmas_fmi

START = 60.0  # s for the process to begin, and for its answer to come over, beside the deadline
# the package is found where this process has it, and nothing else comes from there
_CODE = (
    "import sys; sys.path.insert(0, sys.argv[1]); import posmas_fmi; del sys.path[0]; "
    "from posmas_fmi.apart import main; main()"
)
_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


class ApartError(Exception):
    """The call came to no end of its own; the text goes on after "it" or "the process"."""


def call_apart(function: str, arguments: tuple[Any, ...], deadline: float, memory: int) -> Any:
    """Call a function in a new process and return what it returned.

    Parameters
    ----------
    function : str
        As ``module:name``; its module should import little, for the process has to start.
    arguments : tuple
        They and the result are pickled.
    deadline : float
        Longest time of the call [s], without the start of the process.
    memory : int
        Most memory that the process may ask for [bytes], where the system can bound it.

    Raises
    ------
    ApartError
        If the process crashed, or did not end in time; it is gone by then.
    Exception
        Whatever the function raised.

    Examples
    --------
    >>> call_apart("math:hypot", (3.0, 4.0), deadline=10.0, memory=2**32)
    5.0
    >>> call_apart("os:abort", (), deadline=10.0, memory=2**32)
    Traceback (most recent call last):
        ...
    posmas_fmi.apart.ApartError: was ended by signal 6 (SIGABRT)
    """
    job = pickle.dumps((function, arguments, deadline, memory))
    package = str(Path(posmas_fmi.__file__).resolve().parents[1])
    with tempfile.TemporaryFile() as answer:  # for many numbers, much quicker than a pipe
        try:
            done = subprocess.run(  # which ends the process whatever happens here
                [sys.executable, "-P", "-c", _CODE, package],
                input=job,
                stdout=answer,
                stderr=subprocess.PIPE,
                timeout=deadline + START,
                start_new_session=True,  # Ctrl-C is for us
                env={**os.environ, **_ONE_THREAD},
            )
        except subprocess.TimeoutExpired:
            raise ApartError(_late(deadline)) from None
        if done.returncode:
            raise ApartError(_ending(done.returncode, done.stderr, deadline))
        answer.seek(0)
        good, result = pickle.load(answer)
    if not good:
        raise result
    return result


def _late(deadline: float) -> str:
    return f"did not come to an end within {deadline:.3g} s"


def _ending(code: int, said: bytes, deadline: float) -> str:
    if code == -getattr(signal, "SIGALRM", 0):
        return _late(deadline)
    if code < 0:
        try:
            name = signal.Signals(-code).name
        except ValueError:
            name = "unknown"
        return f"was ended by signal {-code} ({name})"
    last = said.decode("utf-8", "replace").strip().rpartition("\n")[2]
    return f"ended with exit code {code}" + (f" ({last[:200]})" if last else "")


# ---- in the new process -------------------------------------------------------------------------


def main() -> None:
    """Do what comes over stdin; the answer goes to what was stdout."""
    answer = os.dup(1)
    os.dup2(2, 1)  # what a library prints is no answer
    function, arguments, deadline, memory = pickle.load(sys.stdin.buffer)
    module, _, name = function.partition(":")
    called = getattr(import_module(module), name)
    _bound(memory)
    _alarm(deadline)
    try:
        result: tuple[bool, Any] = True, called(*arguments)
    except Exception as error:
        result = False, error
    _alarm(0.0)
    with os.fdopen(answer, "wb") as file:
        pickle.dump(result, file, protocol=5)
    os._exit(0)  # a library may be in no state to clean up


def _alarm(deadline: float) -> None:
    """Let the system end this process then: also where no Python runs and the caller is gone."""
    if hasattr(signal, "setitimer"):
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, deadline)


def _bound(memory: int) -> None:
    try:
        import resource
    except ImportError:
        return
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    if hard == resource.RLIM_INFINITY or memory < hard:
        resource.setrlimit(resource.RLIMIT_DATA, (memory, hard))
