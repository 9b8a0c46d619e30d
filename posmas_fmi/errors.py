"""The exception tree: every error says what was expected, what came, where, and what to do."""

from __future__ import annotations


class PosmasError(Exception):
    """Root of every error this package raises on purpose.

    Parameters
    ----------
    message : str
        What was expected, what came, and what to do about it.
    where : str, optional
        The place: a path in the scenario (``$.agent.A``), a file, an FMU and call.

    Examples
    --------
    >>> str(AgentError("A must be square (got shape (2, 3))", where="$.agent.A"))
    '$.agent.A: A must be square (got shape (2, 3))'
    """

    exit_code = 2

    def __init__(self, message: str, where: str = "") -> None:
        super().__init__(message, where)
        self.message = message
        self.where = where
        # (place, message) of every mistake found together; this error is about the first
        self.problems: tuple[tuple[str, str], ...] = ((where, message),)

    def __str__(self) -> str:
        return f"{self.where}: {self.message}" if self.where else self.message


class InputError(PosmasError):
    """The user's input cannot be used (exit code 2)."""


class ExpressionError(InputError):
    """An expression is outside the language of `posmas_fmi.expression`."""


class AgentError(InputError):
    """The agent is not a positive system of the form (1)."""


class NetworkError(InputError):
    """The digraph or its pinning is not usable."""


class ScenarioError(InputError):
    """A scenario file has one or more mistakes; `problems` holds all of them.

    Parameters
    ----------
    problems : tuple of (str, str)
        Pairs of place (``$.network.arcs[3]``) and message.
    where : str, optional
        The file.
    """

    def __init__(self, problems: tuple[tuple[str, str], ...], where: str = "") -> None:
        lines = [f"{place}: {text}" for place, text in problems]
        message = lines[0] if len(lines) == 1 else "\n  ".join([f"{len(lines)} problems", *lines])
        super().__init__(message, where)
        self.args = (problems, where)  # what a copy from another process is made of
        self.problems = problems


class NotBuiltError(InputError):
    """A command of the contract that this version does not have yet."""


class ResultsError(PosmasError):
    """Results cannot be written: the disk is full, say; what was written before stays readable."""


class DesignError(PosmasError):
    """No gains with the wanted properties exist, or the method did not find any (exit code 1)."""

    exit_code = 1


class FmuError(PosmasError):
    """An FMU could not be read, built, loaded or run (exit code 3)."""

    exit_code = 3


class ArchiveError(FmuError):
    """The .fmu file is not a safe, readable archive with a usable model description."""


class BuildError(FmuError):
    """Compiling an FMU failed."""


class FmuCallError(FmuError):
    """A call into an FMU returned a status other than OK or Warning, or a value that is not finite.

    Parameters
    ----------
    message : str
        What happened.
    where : str
        FMU, instance and call.
    agent : str
        Name of the agent that the instance belongs to.
    time : float
        Simulation time of the call [s].
    """

    def __init__(self, message: str, where: str = "", agent: str = "", time: float = 0.0) -> None:
        super().__init__(message, where)
        self.agent = agent
        self.time = time


class FmuEndedError(FmuCallError):
    """An FMU asked to end the simulation; a run ends there, and that is no failure."""


class FmuLostError(FmuCallError):
    """The process that ran an FMU ended, or did not answer in time.

    Parameters
    ----------
    message, where, agent, time
        As for `FmuCallError`.
    signal : int, optional
        That ended it.
    ended_with : int, optional
        That it ended with.
    """

    def __init__(
        self,
        message: str,
        where: str = "",
        agent: str = "",
        time: float = 0.0,
        signal: int | None = None,
        ended_with: int | None = None,
    ) -> None:
        super().__init__(message, where, agent, time)
        self.signal = signal
        self.ended_with = ended_with
