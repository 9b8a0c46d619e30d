"""A fitted agent as the sections of a scenario file, ready to paste."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from posmas_fmi.fmu.fit import FittedAgent


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
    lines += ["", "[plant]", f"fmu = {json.dumps(fitted.path.name)}"]
    scale = fitted.input_scale
    for kind, letter, names, offset in (
        ("inputs", "u", made.inputs, made.u0),
        ("outputs", "y", made.outputs, made.y0),
        ("states", "x", made.states, made.x0),
    ):
        lines += ["", f"[plant.{kind}]"]
        for k, name in enumerate(names):
            factor = float(scale[k]) if letter == "u" else 1.0
            port = f"variable = {json.dumps(name)}, scale = {factor!r}"
            port += f", offset = {float(offset[k])!r}"
            lines.append(f"{letter}{k + 1} = {{ {port} }}")
    if fitted.values:
        lines += ["", "[plant.parameters]"]
        lines += [
            f"{json.dumps(name)} = {np.asarray(value, dtype=float).tolist()!r}"
            for name, value in fitted.values.items()
        ]
    return "\n".join(lines) + "\n"
