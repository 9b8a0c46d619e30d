"""The sentences of the report: what the numbers say, in words a control engineer can act on."""

from __future__ import annotations

import math

import numpy as np

from posmas_fmi.expression import Array
from posmas_fmi.report.data import Run

ROUNDING = 1e-9  # a state above minus this counts as non-negative: the noise of the integration


def show(value: float | None, digits: int = 3) -> str:
    """Write a number for a reader; a dash for None.

    Examples
    --------
    >>> show(2.9e-5), show(1250.0), show(None), show(float("inf")), show(-3.86e12)
    ('2.9e-5', '1250', '–', '∞', '−3.86e12')
    """
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    text = f"{value:.{digits}g}"
    if "e" in text and 1e-3 <= abs(value) < 1e6:
        text = f"{value:.0f}"
    mantissa, e, exponent = text.partition("e")
    mantissa = mantissa.replace("-", "−")
    return f"{mantissa}e{int(exponent)}" if e else mantissa


def join(words: list[str]) -> str:
    """Join as in "a, b and c"."""
    return words[0] if len(words) == 1 else ", ".join(words[:-1]) + " and " + words[-1]


def tone(run: Run) -> str:
    """``good``, ``caution`` or ``bad``: the colour of the verdict, never the only sign of it."""
    if run.summary.verdict in ("diverged", "failed") or run.first_lost or negative(run):
        return "bad"
    converged = run.summary.verdict == "converged" and run.complete
    if converged and run.design.certified == "yes" and not run.summary.uncovered:
        return "good"
    return "caution" if run.design.certified != "no" else "bad"


def negative(run: Run) -> bool:
    """Whether a state became negative."""
    return run.summary.min_state is not None and run.summary.min_state < -ROUNDING


def headline(run: Run) -> str:
    """One sentence: what happened, whether it stayed non-negative, what is proved."""
    return f"{_outcome(run)}{_positivity(run)}; {_proof(run)}."


def _everyone(run: Run) -> str:
    return "the agent" if run.N == 1 else f"all {run.N} agents"


def _outcome(run: Run) -> str:
    verdict, error = run.summary.verdict, show(run.summary.tracking_error)
    at = f"t = {show(run.until)} s"
    how = "cancelled" if verdict == "cancelled" else "cut off"
    ended = run.complete or verdict in ("diverged", "failed")  # these end a run by themselves
    cut = "" if ended else f"The run was {how} at {at}: "
    if not run.time.size:
        return "Nothing was recorded before the run was cut off"
    if verdict == "diverged" or run.first_lost:
        where = ""
        if run.first_lost:
            agent, time = run.first_lost
            where = f" (agent {run.names[agent]} is lost from t = {show(time)} s)"
        text = f"the closed loop diverged{where}"
    elif verdict == "converged":
        close = f"to within {error}" if run.summary.tracking_error else "to the last digit"
        judge = ", as far as the observers tell" if run.x is None else ""
        text = f"{_everyone(run)} reached the leader, {close} at {at}{judge}"
    elif verdict == "failed":
        text = f"an FMU failed at {at}"
    elif verdict == "positivity lost":
        lowest = show(run.summary.min_state)
        text = f"positivity is lost (lowest state {lowest}), the tracking error is {error} at {at}"
    elif verdict in ("cut off", "cancelled"):
        text = f"the largest tracking error was {error} by then"
    else:
        text = f"{verdict}: the largest tracking error is {error} at {at}"
    return cut + text if cut else text[:1].upper() + text[1:]


def _positivity(run: Run) -> str:
    lowest = run.summary.min_state
    if lowest is None or not run.time.size or run.summary.verdict == "positivity lost":
        return ""
    if negative(run):
        return f" and positivity is lost (lowest state {show(lowest)})"
    return ", and no state became negative"


_DOUBT = {"contradicted": "which the model contradicts", "declared": "declared, not proved"}


def _proof(run: Run) -> str:
    design = run.design
    what = "convergence is proved"
    if design.rate is not None and design.rate > 0:
        what += f" at {show(design.rate)} 1/s"
    if run.summary.uncovered and design.certified != "no":
        what += " for the nominal loop, not for all that this run used,"
    if design.certified == "yes":
        return what.rstrip(",") if run.summary.uncovered else f"{what} without further conditions"
    if design.certified == "conditional":
        parts = [
            f"“{a.name}” ({_DOUBT[a.status]})" for a in design.assumptions if a.status != "verified"
        ]
        return f"{what} only on condition of {join(parts)}" if parts else f"{what} conditionally"
    failing = [f"“{c.name}”" for c in design.conditions if not c.holds]
    if not failing:
        return "convergence is not proved"
    more = f" and {len(failing) - 2} more" if len(failing) > 2 else ""
    return f"convergence is not proved: {', '.join(failing[:2])}{more} failed"


def advice(run: Run) -> str:
    """Say what to do next."""
    design = run.design
    diverged = run.summary.verdict == "diverged" or run.first_lost is not None
    if design.protocol == "printed" and (diverged or negative(run)):
        return (
            "Do not use this loop. The printed sign of the pinning term feeds the pinned agent "
            "back positively; use protocol = “corrected”."
        )
    if diverged:
        return "Do not use these gains. Start from the failed conditions of the certificate below."
    if run.summary.verdict == "failed":
        return "Look at the FMU that failed; the plots show what was recorded up to then."
    if negative(run):
        return (
            "These gains do not keep the network positive. Use the contraction design, "
            "or start the observers at or below the true states."
        )
    if not run.complete:
        return "Run it again to the end before judging it."
    if run.summary.verdict == "not settled":
        return (
            "The FMUs act on each other too strongly within a step for the iteration: take a "
            "shorter period, or another coupling, before judging it."
        )
    if design.certified == "no":
        return (
            "One simulated run is not a proof: another start, load or delay may behave otherwise. "
            "Change the gains, the pinning or the period until the certificate holds."
        )
    if run.summary.uncovered:
        return (
            f"The certificate does not cover {join(list(run.summary.uncovered))}: for that, this "
            "run is evidence only. See what it covers below the certificate."
        )
    if design.certified == "conditional":
        worst = [a for a in design.assumptions if a.status == "contradicted"]
        if worst:
            return (
                "Before relying on the proof, restrict the region or the model so that "
                f"{join([f'“{a.name}”' for a in worst])} is true; as declared, it is false "
                "somewhere on the stated region."
            )
        return "The proof is as good as the declared assumptions: have them checked for your plant."
    if run.summary.verdict != "converged":
        return "The proof covers the limit; simulate longer, or ask for a faster rate."
    return "The gains can be used as they are: the certificate covers the sampled loop that ran."


def tiles(run: Run) -> list[tuple[str, str, str, str]]:
    """Return key facts as (name, value, explanation, tone)."""
    summary, design = run.summary, run.design
    diverged = summary.verdict == "diverged" or run.first_lost is not None
    lowest = summary.min_state
    certified = {"yes": "proved", "conditional": "conditional", "no": "not proved"}
    open_count = sum(a.status != "verified" for a in design.assumptions)
    failing = sum(not c.holds for c in design.conditions)
    proof_detail = {
        "yes": f"{len(design.conditions)} conditions hold, every assumption verified",
        "conditional": f"{len(design.conditions)} conditions hold, {open_count} assumption"
        f"{'s' * (open_count != 1)} not verified",
        "no": f"{failing} of {len(design.conditions)} conditions failed"
        if failing
        else "there is no complete proof",
    }
    end = f"at t = {show(run.until)} s" if run.time.size else "no samples"
    return [
        (
            "Tracking",
            "diverged" if diverged else _tracked(summary.verdict),
            f"largest error {_size(summary.tracking_error, diverged)} {end}",
            "bad"
            if diverged or summary.verdict == "failed"
            else "good"
            if summary.verdict == "converged"
            else "caution",
        ),
        (
            "Certificate",
            certified[design.certified],
            proof_detail[design.certified],
            {"yes": "good", "conditional": "caution", "no": "bad"}[design.certified],
        ),
        (
            "Non-negativity",
            "unknown" if lowest is None else "lost" if negative(run) else "kept",
            "the plant does not show its states"
            if lowest is None
            else f"lowest state {show(lowest)}"
            + (
                ", against the proof: check its assumptions"
                if negative(run) and design.positive
                else "; proved for observers that start low"
                if design.positive
                else "; not proved"
            ),
            "caution"
            if lowest is None
            else "bad"
            if negative(run)
            else "good"
            if design.positive
            else "caution",
        ),
        (
            "Proved rate",
            f"{show(design.rate)} 1/s" if design.rate is not None else "none",
            f"without control (K = 0): {show(design.baseline_rate)} 1/s"
            if design.baseline_rate is not None
            else "no rate is proved without control (K = 0)",
            "good" if design.rate is not None and design.rate > 0 else "bad",
        ),
    ]


def _tracked(verdict: str) -> str:
    """Positivity has a tile of its own, and hides whether the error was small enough."""
    return "not judged" if verdict == "positivity lost" else verdict


def _size(error: float | None, diverged: bool) -> str:
    return "not finite" if error is None and diverged else show(error)


def sector_statement(run: Run, k: int) -> str:
    """Whether the samples lie in the declared sector, from the recorded numbers."""
    if run.sec_u is None:
        return "The run did not record sec(u)."
    u, force = run.u[:, :, k], run.sec_u[:, :, k]
    finite = np.isfinite(u) & np.isfinite(force)
    usable = finite & (np.abs(u) > 1e-9 * np.abs(u[finite]).max(initial=0.0))
    if not usable.any():
        return "The input is zero throughout."
    with np.errstate(all="ignore"):
        ratio = force[usable] / u[usable]
    seen = f"sec(u)/u ranges over [{show(float(ratio.min()))}, {show(float(ratio.max()))}]"
    if run.design.sector is None:
        return f"{seen}; the sector was not stored with this run."
    low, high = run.design.sector
    outside = int(np.count_nonzero((ratio < low - 1e-9) | (ratio > high + 1e-9)))
    bounds = f"the sector [{low:g}, {high:g}]"
    if outside:
        share = 100 * outside / ratio.size
        return f"{seen}: {show(share, 2)} % of the samples lie outside {bounds}, against the proof."
    return f"{seen}, inside {bounds}."


def baseline_statement(run: Run) -> str:
    """Compare the last errors with and without control."""
    if run.baseline_error is None or not run.time.size:
        return ""
    own, without = (
        float(np.abs(error[-1]).max()) for error in (run.tracking_error, run.baseline_error)
    )
    return f"At t = {show(run.until)} s: {show(own)} with it, {show(without)} without."


def describe(run: Run, values: Array, what: str) -> str:
    """Alternative text of a plot over time; ``values`` is (T, N), or (T,) for a single curve."""
    if not values.size:
        return f"{what}: no samples."
    whose = "" if values.ndim == 1 else f" of {run.N} agent{'s' * (run.N != 1)}"
    span = f"{what}{whose} from t = {show(float(run.time[0]))} to {show(run.until)} s"
    first, last = (_range(row) for row in (values[0], values[-1]))
    text = f"{span}. At the start {first}, at the end {last}."
    finite = values[np.isfinite(values)]
    return (
        f"{text} Extremes {show(finite.min())} and {show(finite.max())}." if finite.size else text
    )


def _range(row: Array) -> str:
    finite = np.atleast_1d(row)[np.isfinite(np.atleast_1d(row))]
    lost = np.size(row) - finite.size
    if not finite.size:
        return "not finite"
    low, high = show(float(finite.min())), show(float(finite.max()))
    text = low if low == high else f"between {low} and {high}"
    return f"{text} ({lost} not finite)" if lost else text


def describe_network(run: Run) -> str:
    """Alternative text of the network drawing."""
    pinned = [run.names[i] for i in run.network.pinned]
    shown = (
        join(pinned[:6])
        if len(pinned) <= 6
        else f"{', '.join(pinned[:6])} and {len(pinned) - 6} more"
    )
    return (
        f"Digraph of {run.N} agent{'s' * (run.N != 1)} and {run.network.adjacency.nnz} arcs. "
        f"The leader is heard by {shown or 'nobody'}. Final errors from "
        f"{_range(run.final_error)}; the largest is that of agent {run.names[run.worst]}."
    )
