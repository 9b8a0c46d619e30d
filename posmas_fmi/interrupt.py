"""Ctrl-C where nothing may be left half done: it is noted, and raised where that is over."""

from __future__ import annotations

import signal
import threading
from types import TracebackType
from typing import Any, Self


class Interrupt:
    """Takes note of Ctrl-C instead of raising KeyboardInterrupt wherever the program stands.

    The second Ctrl-C raises, unless what is done is over soon. In other threads than the main one,
    and where Ctrl-C means something else already, nothing is changed.

    Parameters
    ----------
    soon : bool
        Whether what is done is over soon, so that no further Ctrl-C raises either.

    Attributes
    ----------
    wanted : bool
        Whether Ctrl-C has come.

    Examples
    --------
    >>> with Interrupt() as interrupt:
    ...     signal.raise_signal(signal.SIGINT)
    ...     print(interrupt.wanted)
    True
    """

    def __init__(self, soon: bool = False) -> None:
        self.wanted = False
        self._soon = soon
        self._before: Any = None

    def __enter__(self) -> Self:
        if (
            threading.current_thread() is threading.main_thread()
            and signal.getsignal(signal.SIGINT) is signal.default_int_handler
        ):
            self._before = signal.signal(signal.SIGINT, self._note)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)

    def _note(self, number: int, frame: Any) -> None:
        if self.wanted and not self._soon:
            raise KeyboardInterrupt
        self.wanted = True

    def check(self) -> None:
        """Raise KeyboardInterrupt if Ctrl-C has come: called where nothing is half done."""
        if self.wanted:
            raise KeyboardInterrupt
