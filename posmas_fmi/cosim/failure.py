"""What is told about an FMU that failed while the network was running."""

from __future__ import annotations

import math
from typing import Any, Literal

import attrs

Action = Literal["stopped", "frozen", "restarted"]


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
