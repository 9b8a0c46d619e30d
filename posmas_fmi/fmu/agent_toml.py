"""A fitted agent as the sections of a scenario file, ready to paste."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from posmas_fmi.fmu.evaluation import Values
    from posmas_fmi.fmu.fit import FittedAgent
    from posmas_fmi.fmu.linearise import Linearisation


def agent_toml(fitted: FittedAgent) -> str:
    """Return the ``[agent]`` and ``[plant]`` sections; see `FittedAgent.to_toml`."""
    agent, made = fitted.agent, fitted.linearisation
    lines = ["[agent]"]
    lines += [f"{name} = {getattr(agent, name).tolist()!r}" for name in "AHBC"]
    lines += [
        f"g = {json.dumps(fitted.g)}",
        f"sec = {json.dumps(fitted.sec)}",
        f"sector = {list(agent.sector)!r}",
    ]
    if agent.lipschitz is not None:
        declared = np.atleast_1d(np.asarray(agent.lipschitz, dtype=float)).tolist()
        lines.append(f"lipschitz = {declared!r}")
    lines += ["", "[agent.region]"]
    lines += [f"{name} = {[float(v) for v in pair]!r}" for name, pair in agent.region.items()]
    turned = fitted.input_scale.tolist()
    return "\n".join(lines) + "\n\n" + plant_toml(fitted.path, made, fitted.values, turned)


def plant_toml(
    path: Path, made: Linearisation, values: Values, input_scale: Sequence[float] | None = None
) -> str:
    """Return the ``[plant]`` section: ports in deviations from the operating point.

    Parameters
    ----------
    path : Path
        Of the FMU; only its name is written.
    made : Linearisation
    values : mapping
        Parameters that it is given.
    input_scale : sequence of float, optional
        Of each input; 1 by default.
    """
    lines = ["[plant]", f"fmu = {json.dumps(path.name)}"]
    for kind, letter, names, offset in (
        ("inputs", "u", made.inputs, made.u0),
        ("outputs", "y", made.outputs, made.y0),
        ("states", "x", made.states if made.named else (), made.x0),
    ):
        lines += ["", f"[plant.{kind}]"] if names else []
        for k, name in enumerate(names):
            factor = float(input_scale[k]) if input_scale and letter == "u" else 1.0
            port = f"variable = {json.dumps(name)}, scale = {factor!r}"
            port += f", offset = {float(offset[k]) + 0.0!r}"
            lines.append(f"{letter}{k + 1} = {{ {port} }}")
    if values:
        lines += ["", "[plant.parameters]"]
        lines += [
            f"{json.dumps(name)} = {np.asarray(value, dtype=float).tolist()!r}"
            for name, value in values.items()
        ]
    return "\n".join(lines) + "\n"


def report(fitted: FittedAgent) -> str:
    """Return what is known about the fit as comment lines, to go in front of the sections."""
    made, metzler = fitted.linearisation, fitted.metzler
    entries = "; ".join(f"A[{i},{j}] = {v:.4g}" for i, j, v in metzler.negative)
    error = "unknown" if made.error is None else f"{made.error:.3g} at most in an entry"
    lines = [
        f"Model (1) of {fitted.path.name} in deviations from its operating point at {made.at:g} s.",
        f"Linear part: {made.method}, estimated error {error}",
        f"Metzler: {'yes' if metzler.metzler else f'no, moved into g: {entries}'}",
        f"B >= 0: {_inputs(fitted)}",
    ]
    for name, sampled in zip(made.inputs, fitted.sector, strict=True):
        lines.append(f"Sector of {name}: sec(u)/u in [{sampled[0]:.6g}, {sampled[1]:.6g}]")
    if fitted.samples:
        lines += [
            f"Slopes: |df/dx - A| up to {fitted.lipschitz.max(initial=0.0):.6g} 1/s",
            f"Residual: {fitted.residual:.3g} (root mean square, relative), "
            f"{fitted.residual_max:.3g} at most, on {fitted.samples} fresh samples",
        ]
    else:
        lines.append("Residual: unknown, the nonlinearity was not sampled")
    lines += [f"Bound {a.name!r}: {a.status}: {a.detail}" for a in fitted.agent.assumptions()]
    lines.append("Sector, slopes and residual are of samples; statuses are of the fitted model.")
    lines += [f"Note: {note}" for note in fitted.notes]
    if not fitted.useful:
        lines.append(
            "Verdict: of no use, the error of the linear part or the residual is too large"
        )
    return "".join(f"# {' '.join(line.split())}\n" for line in lines)


def _inputs(fitted: FittedAgent) -> str:
    turned = [
        name
        for name, scale in zip(fitted.linearisation.inputs, fitted.input_scale, strict=True)
        if scale < 0
    ]
    return "yes" if not turned else f"after counting {', '.join(turned)} the other way round"
