"""The control report: what the design needs to know about an FMU, from a linear model of it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import attrs
import numpy as np

from posmas_fmi.errors import PosmasError
from posmas_fmi.expression import Array
from posmas_fmi.fmu.about import About
from posmas_fmi.fmu.agent_toml import plant_toml
from posmas_fmi.fmu.evaluation import Signals, Values, bring_to, default_step, signals
from posmas_fmi.fmu.file import FmuFile
from posmas_fmi.fmu.linearise import Linearisation, linearise_open
from posmas_fmi.fmu.model_exchange import ModelExchangeInstance
from posmas_fmi.fmu.period import check_period

if TYPE_CHECKING:
    from posmas_fmi.fmu.fit import FittedAgent

_MOST_PORTS = 16
_MOST_STATES = 12  # that are fitted
_COUNTS = 0.01  # part of a response that a mode needs to be one of those that count
_PER_CONSTANT = 10  # periods in the shortest time constant that counts
_REACH = 0.1  # of the size of an input: where its sector is sampled
_NOTHING = 1e-6  # of the largest pole: a pole that is 0 but for rounding
_POINTS = np.array([-1.0, -0.5, -0.25, 0.25, 0.5, 1.0])
_STEPS = 5


def control_report(
    file: FmuFile,
    inputs: Sequence[str],
    outputs: Sequence[str],
    at: float,
    values: Values,
    run_as: About | None = None,
) -> Iterator[dict[str, Any]]:
    """Go through the parts of the report, each as soon as it is known.

    Parameters
    ----------
    file : FmuFile
    inputs, outputs : sequence of str
        Those that the FMU declares if empty.
    at : float
        Time of the operating point [s].
    values : mapping
        Parameters, start values and inputs.
    run_as : About, optional
        The FMU by the interface that a run uses, where `file` is another: its periods count.

    Yields
    ------
    dict
        ``linear``, ``signs``, those of `modes`, ``unseen``, ``period``, ``sectors``, ``fit`` and
        ``toml``; nothing if there is no input or no output.
    """
    names = _signals(file, inputs, outputs)
    if not names.inputs or not names.outputs:
        return
    made = linearise_open(file, names, at, values, None)
    yield {"linear": made.to_dict(), "signs": signs(made)}
    yield {**modes(made), "unseen": unseen(made), "period": period(made, file, run_as)}
    fitted, why = _fitted(file, names, made, at, values)
    if fitted is None:
        yield {
            "sectors": _sectors(file, names, at, values),
            "fit": {"why_not": why},
            "toml": plant_toml(file.path, made, values),
        }
        return
    residual = None if np.isnan(fitted.residual) else fitted.residual
    yield {
        "sectors": [
            {"input": name, "low": float(low), "high": float(high), "range": list(reach)}
            for name, (low, high), reach in zip(
                made.inputs,
                fitted.sector,
                [fitted.agent.region[f"u{k + 1}"] for k in range(len(made.inputs))],
                strict=True,
            )
        ],
        "fit": {"residual": residual, "notes": list(fitted.notes)},
        "toml": fitted.to_toml(),
    }


def signs(made: Linearisation) -> dict[str, list[str]]:
    """Return the signs of the entries of A, B, C and D, a text like ``"-+0"`` for each row.

    An entry within the estimated error is ``0``.
    """
    small = {"A": made.error or 0.0, "B": made.error or 0.0}
    found = {}
    for name in "ABCD":
        M = getattr(made, name)
        limit = max(small.get(name, 0.0), 1e-9 * float(np.abs(M).max(initial=0.0)))
        found[name] = ["".join(_sign(value, limit) for value in row) for row in M]
    return found


def _sign(value: float, limit: float) -> str:
    return "+" if value > limit else "-" if value < -limit else "0"


def unseen(made: Linearisation) -> list[str]:
    """Return the states that act on no output, not even through others."""
    pattern = signs(made)
    acts, seen = (
        np.array([[c != "0" for c in row] for row in pattern[name]]).reshape(M.shape)
        for name, M in (("A", made.A), ("C", made.C))
    )
    reached = np.asarray(seen.any(axis=0))
    for _ in made.states:
        reached = np.asarray(reached | acts[reached].any(axis=0))
    return [name for name, there in zip(made.states, reached, strict=True) if not there]


def modes(made: Linearisation) -> dict[str, Any]:
    """Return the time constants of A, the longest first, and what oscillates, integrates, grows.

    Examples
    --------
    >>> from posmas_fmi.expression import VectorFunction
    >>> from posmas_fmi.fmu.build import agent_fmu
    >>> from posmas_fmi.fmu.linearise import linearise
    >>> g = VectorFunction.parse(["0"], ["t", "x1"])
    >>> path = agent_fmu(g, VectorFunction.parse(["u1"], ["u1"]), 1, 1, 1)
    >>> modes(linearise(path, ["u"], ["y"], values={"A": [[-4.0]]}))["time_constants"]
    [0.25]
    """
    poles = _continuous(made)
    nothing = max(made.error or 0.0, _NOTHING * float(np.abs(poles).max(initial=0.0)))
    falling = {float(f"{-1 / p.real:.6g}") for p in poles if p.real < -nothing}
    waves = [
        {"period": 2 * math.pi / p.imag, "damping": -p.real / abs(p)}
        for p in poles
        if p.imag > nothing
    ]
    return {
        "time_constants": sorted(falling, reverse=True),
        "oscillations": waves,
        "integrators": sum(bool(abs(p) <= nothing) for p in poles),
        "growing": [float(1 / p.real) for p in poles if p.real > nothing],
    }


def period(made: Linearisation, file: FmuFile, run_as: About | None = None) -> dict[str, Any]:
    """Return a control period to begin with [s], and why.

    A tenth of the shortest time constant among the modes that the inputs move and the outputs
    show, rounded down to 1, 2 or 5; or what the FMU, as it is run, allows nearest to that.
    """
    sizes = _weights(made)
    poles = _continuous(made)
    counting = [abs(p) for p, w in zip(poles, sizes, strict=True) if w >= _COUNTS and abs(p) > 0]
    if not counting:
        h, why = default_step(file), "the FMU's own step: no mode tells"
    else:
        shortest = 1 / max(counting)
        h = _rounded(shortest / _PER_CONSTANT)
        why = f"a tenth of {shortest:.3g} s, the shortest time constant that counts"
    allowed = check_period(run_as or file, h)
    if not allowed.allowed and allowed.nearest:
        h, why = allowed.nearest, f"{why}; the FMU takes {allowed.nearest:g} s"
    return {"suggested": h, "reason": why}


def _continuous(made: Linearisation) -> Array:
    """Return the poles, those of a sampled model as of the system that it samples."""
    poles = np.linalg.eigvals(made.A).astype(complex)
    if not made.dt:
        return np.asarray(poles)
    return np.asarray([np.log(p) / made.dt for p in poles if abs(p) > 1e-12])


def _weights(made: Linearisation) -> list[float]:
    """Return the part of each mode in the responses, the largest 1."""
    values, vectors = np.linalg.eig(made.A.astype(complex))
    if made.dt or not len(values) or np.linalg.cond(vectors) > 1e8:
        return [1.0] * len(_continuous(made))
    rows = np.linalg.solve(vectors, made.B.astype(complex))
    parts = np.array(
        [
            np.abs(np.outer(made.C @ vectors[:, k], rows[k])).max(initial=0.0)
            / max(abs(values[k]), 1e-300)
            for k in range(len(values))
        ]
    )
    return list(parts / (parts.max() or 1.0))


def _rounded(value: float) -> float:
    power = math.floor(math.log10(value))
    first = max(d for d in (1, 2, 5) if d <= value / 10.0**power * (1 + 1e-9))
    return float(f"{first}e{power}")


# ---- sectors and the fit ------------------------------------------------------------------------


def _fitted(
    file: FmuFile, names: Signals, made: Linearisation, at: float, values: Values
) -> tuple[FittedAgent | None, str]:
    from posmas_fmi.fmu.fit import fit_open

    if not made.named or made.dt:
        return None, "it shows no states of a continuous system; name them for 'posmas-fmi fit'"
    if len(made.states) > _MOST_STATES:
        return None, f"it has {len(made.states)} states: choose a smaller model by hand"
    if not made.useful:
        return None, "the error of the linear model is too large"
    small = max(made.error or 0.0, 1e-9 * float(np.abs(made.C).max(initial=1.0)))
    kept = [k for k, row in enumerate(made.D) if np.abs(row).max(initial=0.0) <= small]
    if not kept:
        return None, "an input acts on every output directly"
    chosen = attrs.evolve(names, outputs=tuple(names.outputs[k] for k in kept))
    try:
        fitted = fit_open(file, chosen, None, at, values)
    except PosmasError as error:
        return None, error.message
    if not fitted.useful:
        return None, f"the fit is of no use: residual {fitted.residual:.2g}"
    return fitted, ""


def _sectors(file: FmuFile, names: Signals, at: float, values: Values) -> list[dict[str, Any]]:
    """Compare the responses to small and large steps of each input alone.

    The response to a step of size du, projected on that to a small one, over du, is 1 for a linear
    input.
    """
    h = default_step(file)
    found = []
    for k, name in enumerate(names.inputs):
        base = _response(file, names, at, values, h, k, 0.0)
        size = _REACH * max(abs(float(base[0])), abs(file.variable(name).nominal))
        rows = {d: _response(file, names, at, values, h, k, d * size)[1] for d in _POINTS}
        small = min(d for d in _POINTS if d > 0)
        direction = (rows[small] - base[1]) / small
        square = float((direction * direction).sum())
        if square <= 0:
            continue
        gains = [float((direction * (rows[d] - base[1])).sum()) / square / d for d in _POINTS]
        found.append({"input": name, "low": min(gains), "high": max(gains), "range": [-size, size]})
    return found


def _response(
    file: FmuFile, names: Signals, at: float, values: Values, h: float, k: int, by: float
) -> tuple[float, Array]:
    """Return an input's value, and the outputs over a few steps after it has moved."""
    with file.instantiate("sector") as instance:
        bring_to(instance, at, values, h)
        ports, shown = file.ports(names.inputs), file.ports(names.outputs)
        u = instance.read(ports)
        before = float(u[k])
        u[k] += by
        instance.write(ports, u)
        rows = []
        for n in range(_STEPS):
            if isinstance(instance, ModelExchangeInstance):
                instance.advance(at + (n + 1) * h)
            else:
                instance.do_step(at + n * h, h)
            rows.append(instance.read(shown))
        return before, np.array(rows)


def _signals(file: FmuFile, inputs: Sequence[str], outputs: Sequence[str]) -> Signals:
    jumps = file.kind == "Model Exchange"  # there discrete ones change at events only

    def declared(causality: str) -> list[str]:
        names = [
            v.name
            for v in file.variables.values()
            if v.causality == causality
            and v.type in ("Real", "Float64")
            and v.size
            and not (jumps and v.variability == "discrete")
        ]
        return list(file.ports(names).names[:_MOST_PORTS]) if names else []

    return signals(file, inputs or declared("input"), outputs or declared("output"))


# ---- in words -----------------------------------------------------------------------------------


def lines(report: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Return label and text of the lines of a report."""
    made = report.get("linear")
    if not made:
        return
    error = "unknown" if made["error"] is None else f"{made['error']:.2g}"
    yield "linear model", f"at {made['at']:g} s, by {made['method']}, error {error}"
    if not made["useful"]:
        yield "", "the error is too large: what follows is of little use"
    unnamed = "" if made["named"] or not made["states"] else " (coordinates: it names no states)"
    yield "states", (", ".join(made["states"]) or "none") + unnamed
    for name in "ABCD":
        rows = report["signs"][name]
        if rows:
            yield f"signs of {name}", " ".join(rows)
    yield "positive", _positive(made, report["signs"])
    constants = ", ".join(f"{value:.3g} s" for value in report.get("time_constants", []))
    yield "time constants", constants or "none"
    if report.get("integrators"):
        yield "", f"{report['integrators']} of its modes only add up (poles at 0)"
    for value in report.get("growing", []):
        yield "NOT STABLE", f"a mode grows e-fold in {value:.3g} s"
    for wave in report.get("oscillations", []):
        yield "oscillation", f"period {wave['period']:.3g} s, damping {wave['damping'] + 0.0:.2g}"
    if report.get("unseen"):
        text = ", ".join(report["unseen"])
        yield "not seen", f"{text}: on no output; a smaller model does without"
    if "period" in report:
        told = report["period"]
        yield "period to use", f"{told['suggested']:g} s ({told['reason']})"
    for one in report.get("sectors", []):
        reach = "{:.3g} … {:.3g}".format(*one["range"])
        yield "sector", f"{one['input']}: {one['low']:.4g} … {one['high']:.4g} (sampled, {reach})"
    fit = report.get("fit", {})
    if "why_not" in fit:
        yield "model (1)", f"not fitted: {fit['why_not']}"
    elif fit:
        residual = "unknown" if fit["residual"] is None else f"{fit['residual']:.2g}"
        yield "model (1)", f"fitted below, relative residual {residual}"


def _positive(made: dict[str, Any], pattern: dict[str, list[str]]) -> str:
    if made["metzler"] is None:
        return "unknown: the states are not known"
    if not pattern["A"]:
        return "there are no states"
    reasons = [
        f"A[{i},{j}] = {value:.3g} < 0: not Metzler"
        for i, j, value in made["metzler"]["negative"][:3]
    ]
    columns = ["".join(column) for column in zip(*pattern["B"], strict=True)]
    for name, column in zip(made["inputs"], columns, strict=True):
        if "-" in column:
            turned = "count it the other way round" if "+" not in column else "in both directions"
            reasons.append(f"{name} acts downwards ({turned})")
    reasons += [
        f"{name} falls where a state rises"
        for name, row in zip(made["outputs"], pattern["C"], strict=True)
        if "-" in row
    ]
    return "; ".join(reasons) or "yes: A is Metzler, B and C are not negative"
