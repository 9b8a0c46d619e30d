"""A run as one frozen object, with the errors derived from its signals."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import attrs
import numpy as np

from posmas_fmi.agent import Assumption
from posmas_fmi.cosim.failure import ENDED
from posmas_fmi.errors import NetworkError
from posmas_fmi.expression import Array
from posmas_fmi.network import Network

# An agent counts as lost once its tracking error stays over this multiple of what the run
# started with.
LOST_FACTOR = 100.0


@attrs.frozen
class Condition:
    """One condition of the certificate."""

    name: str
    holds: bool
    margin: float | None
    proof: str
    detail: str


@attrs.frozen(eq=False)
class DesignFacts:
    """What ``design.json`` says; attributes are the keys of ``posmas-fmi design --json``."""

    method: str
    observer: str
    protocol: str
    phi: float | None
    mu: float | None
    K: Array
    E: Array
    certified: str
    assumptions: tuple[Assumption, ...]
    rate: float | None
    observer_rate: float | None
    rate_perron: float | None
    positive: bool
    p_max: float | None
    period: float | None
    conditions: tuple[Condition, ...]
    covers: tuple[str, ...]
    notes: tuple[str, ...]
    region: str
    baseline_rate: float | None
    sector: tuple[float, float] | None


@attrs.frozen
class AgentVerdict:
    """What ``summary.json`` says about one agent."""

    name: str
    status: str
    final_error: float | None
    min_state: float | None = None


@attrs.frozen
class Used:
    """What a run used beyond the loop that is certified, and whether the proof covers it."""

    what: str
    covered: bool
    why: str


@attrs.frozen
class Fault:
    """A fault of the scenario; times in seconds, None where it has no end.

    `covered` is a sentence; `proved` whether it says that a certificate covers the fault.
    """

    kind: str
    agent: str
    begin: float | None
    end: float | None
    detail: str
    covered: str
    proved: bool


@attrs.frozen
class Incident:
    """An FMU that failed while the run went on, or left processes behind that had to be ended.

    `inputs` are those of the step that failed, as text; `said` is what the instance logged and its
    process wrote last; `detail` is how the others went on.
    """

    agent: str
    time: float | None
    call: str
    verdict: str
    action: str
    fmu: str = ""
    inputs: str = ""
    said: str = ""
    detail: str = ""


@attrs.frozen
class Summary:
    """What ``summary.json`` says about the run; derived from the results if the run was cut off.

    `coverage` is None for a run that does not say what it used, `band` for one that is no cooling
    row: about such a row it says how far supply temperatures are from the set-point.
    """

    verdict: str
    reason: str
    agents: tuple[AgentVerdict, ...]
    tracking_error: float | None
    estimation_error: float | None
    min_state: float | None
    wall_s: float | None
    steps: int | None
    comparison: Mapping[str, Any]
    notes: tuple[str, ...]
    coverage: tuple[Used, ...] | None = None
    faults: tuple[Fault, ...] = ()
    incidents: tuple[Incident, ...] = ()
    band: float | None = None

    @property
    def uncovered(self) -> tuple[str, ...]:
        """What was used or went wrong and no certificate covers."""
        used = [row.what for row in self.coverage or () if not row.covered]
        faults = [fault.kind for fault in self.faults if not fault.proved]
        fails = any(incident.action != ENDED for incident in self.incidents)
        failed = ["an FMU that failed"] if fails else []
        return tuple(dict.fromkeys([*used, *faults, *failed]))


@attrs.frozen(eq=False)
class Run:
    """Everything the report shows.

    Attributes
    ----------
    time : (T,) array
        [s]
    labels : mapping
        ``"state"``, ``"input"``, ``"output"`` -> names of the components.
    x, xhat, x_baseline : (T, N, m) array
        States, estimates, states of the same run with K = 0. x and x_baseline may be None.
    s : (T, m) array
        Leader.
    u, sec_u : (T, N, p) array
        Input and what the sector nonlinearity makes of it. sec_u may be None.
    y : (T, N, q) array
        Outputs.
    recorded : mapping
        Name -> what was recorded besides, (T, N) of the agents or (T,).
    stride : int
        Every how many stored samples one was read.
    """

    scenario: str
    created_by: str
    complete: bool
    period: float | None
    stride: int
    units: Mapping[str, str]
    names: tuple[str, ...]
    labels: Mapping[str, tuple[str, ...]]
    network: Network
    time: Array
    x: Array | None
    xhat: Array
    x_baseline: Array | None
    s: Array
    u: Array
    sec_u: Array | None
    y: Array
    recorded: Mapping[str, Array]
    design: DesignFacts
    summary: Summary
    manifest: Mapping[str, Any]

    @property
    def N(self) -> int:
        """Number of agents."""
        return int(self.xhat.shape[1])

    @property
    def m(self) -> int:
        """Number of states of an agent."""
        return int(self.xhat.shape[2])

    @property
    def p(self) -> int:
        """Number of inputs of an agent."""
        return int(self.u.shape[2])

    @property
    def until(self) -> float:
        """Time of the last sample [s]; NaN without samples."""
        return float(self.time[-1]) if self.time.size else math.nan

    @cached_property
    def shown(self) -> Array:
        """The states where the plant shows them, the estimates elsewhere, (T, N, m)."""
        if self.x is None:
            return self.xhat
        hidden = np.asarray(np.isnan(self.x).all(axis=(0, 2)))
        return np.where(hidden[None, :, None], self.xhat, self.x)

    @cached_property
    def estimation_error(self) -> Array | None:
        """``e = x - xhat``, (T, N, m)."""
        with np.errstate(all="ignore"):
            return None if self.x is None else self.x - self.xhat

    @cached_property
    def tracking_error(self) -> Array:
        """``x - s``, or ``xhat - s`` for a plant that does not show x, (T, N, m)."""
        with np.errstate(all="ignore"):
            return self.shown - self.s[:, None, :]

    @cached_property
    def baseline_error(self) -> Array | None:
        """``x - s`` of the run with K = 0, (T, N, m)."""
        with np.errstate(all="ignore"):
            return None if self.x_baseline is None else self.x_baseline - self.s[:, None, :]

    @cached_property
    def final_error(self) -> Array:
        """Largest entry of the tracking error of each agent at the last sample, (N,).

        Lines of a cooling row have other loads than the leader: there it is what the summary says.
        """
        told = [agent.final_error for agent in self.summary.agents]
        if self.summary.band is not None and len(told) == self.N and None not in told:
            return np.array(told, dtype=float)
        if not self.time.size:
            return np.full(self.N, np.nan)
        return np.asarray(np.abs(self.tracking_error[-1]).max(axis=-1))

    @cached_property
    def worst(self) -> int:
        """Index of the agent with the largest final error; one that is not finite comes first."""
        return int(np.argmax(np.where(np.isfinite(self.final_error), self.final_error, np.inf)))

    @cached_property
    def lost_at(self) -> Array:
        """When each agent was lost for good [s], (N,): infinite for an agent that was not.

        Lost: not finite, or a tracking error over `LOST_FACTOR` times the larger of the leader
        and the first error, up to the last sample.
        """
        lost = np.full(self.N, np.inf)
        if not self.time.size:
            return lost
        error = np.abs(self.tracking_error).max(axis=-1)
        leader = np.abs(self.s[np.isfinite(self.s).all(axis=1)])
        scale = np.nanmax([leader.max(initial=0.0), np.nan_to_num(error[0]).max(), 1e-300])
        within = error <= LOST_FACTOR * scale  # False for NaN
        for i in np.flatnonzero(~within[-1]):
            ends = np.flatnonzero(within[:, i])
            lost[i] = self.time[ends[-1] + 1] if ends.size else self.time[0]
        return lost

    @property
    def first_lost(self) -> tuple[int, float] | None:
        """Agent (index) and time [s] of the first loss."""
        i = int(np.argmin(self.lost_at))
        return (i, float(self.lost_at[i])) if np.isfinite(self.lost_at[i]) else None

    @cached_property
    def p_profile(self) -> Array | None:
        """``p`` with ``L_p p = 1``, (N,), or None if the leader does not reach every agent."""
        try:
            return self.network.p
        except NetworkError:
            return None
