"""What is told about an FMU that failed while the network was running."""

from __future__ import annotations

import math
from typing import Any, Literal

import attrs

Action = Literal["stopped", "frozen", "restarted"]
ENDED = "ended"  # what is done about processes that are left behind
_TOLD = 6  # instances


@attrs.define
class Leftover:
    """Processes that FMUs had started and that were still there when theirs ended.

    Attributes
    ----------
    instances : dict of str to str
        Name and FMU of each instance that was in the process.
    number : int
        How many had to be ended; known when the process is closed.
    """

    instances: dict[str, str] = attrs.field(factory=dict)
    number: int = 0

    @property
    def agent(self) -> str:
        """The instance that started them; where several shared the process, which they may be.

        Examples
        --------
        >>> Leftover({"1": "a.fmu", "2": "b.fmu", "3": "b.fmu"}).agent
        '1, 2 or 3'
        """
        *others, last = self.instances or [""]
        if len(others) >= _TOLD:
            others = [*others[: _TOLD - 1], "…"]
        return f"{', '.join(others)} or {last}" if others else last

    @property
    def fmu(self) -> str:
        """Their FMU, or those that they may be of."""
        return " or ".join(dict.fromkeys(self.instances.values()))

    @property
    def text(self) -> str:
        """What was found, as a part of a sentence."""
        return f"left {self.number} process{'es' if self.number > 1 else ''} behind"

    def to_dict(self) -> dict[str, Any]:
        """Return what summary.json says about it, among the incidents."""
        return {
            "agent": self.agent,
            "fmu": self.fmu,
            "verdict": self.text,
            "action": ENDED,
            "processes": self.number,
        }


@attrs.frozen
class Failure:
    """One failure of one FMU.

    Attributes
    ----------
    agent : str
        Name of the instance.
    fmu : str
        File name.
    call : str
        The FMI function, if known.
    time : float
        Where the step began [s].
    inputs : dict of str to float
        FMU variables and the values that were set for that step.
    cause : str
        Signal, exit code, status, deadline or limit, as a part of a sentence.
    action : {"stopped", "frozen", "restarted"}
        What was done.
    detail : str
        How it was restarted, or why not; what became of others in its process.
    signal, exit_code, status : int or None
    messages : tuple of str
        What the instance logged last.
    output : str
        The end of what its process wrote to stdout and stderr.
    """

    agent: str
    fmu: str
    call: str
    time: float
    inputs: dict[str, float]
    cause: str
    action: Action = "stopped"
    detail: str = ""
    signal: int | None = None
    exit_code: int | None = None
    status: int | None = None
    messages: tuple[str, ...] = ()
    output: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return what summary.json says about it; the cause is the verdict there."""
        facts = attrs.asdict(self)
        facts["verdict"] = facts.pop("cause")
        finite = {n: v if math.isfinite(v) else None for n, v in self.inputs.items()}
        facts |= {"inputs": finite, "messages": list(self.messages)}
        return {k: v for k, v in facts.items() if v not in (None, "", [], {})}

    @property
    def where(self) -> str:
        """FMU, agent and call."""
        return f"{self.fmu}: {self.agent}: {self.call or 'between calls'}"

    @property
    def message(self) -> str:
        """What happened there, with time, inputs and what was said."""
        inputs = ", ".join(f"{name} = {value:.6g}" for name, value in self.inputs.items())
        text = f"{self.cause} (at time {self.time:g} s{'; inputs ' + inputs if inputs else ''})"
        if self.messages:
            text += f": {'; '.join(self.messages)}"
        if self.output:
            text += f"; its process had written: {self.output}"
        return text

    def __str__(self) -> str:
        return f"{self.where}: {self.message}"
