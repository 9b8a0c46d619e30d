"""Small scenarios around one FMU, for tests."""

from __future__ import annotations

import shutil
from pathlib import Path

ONE = """
[scenario]
name = "one"
until = {until}
period = {period}
tolerance = 100.0
engine = "{engine}"

[agent]
A = [[-0.1]]
B = [[0.1]]
C = [[1.0]]

[network]
agents = 2
arcs = [[1, 2]]
pinned = [1]

[design]
method = "gains"
K = [[{gain}]]
E = [[0.01]]

[plant]
fmu = "{fmu}"
inputs = {{u1 = {inputs}}}
outputs = {{y1 = {outputs}}}
{more}

[leader]
s0 = [5.0]

[report]
baseline = false
"""


def one_fmu(
    folder: Path, fmu: Path, inputs: str, outputs: str, more: str = "", **other: object
) -> str:
    """Write a scenario of two agents that have this FMU; returns its path."""
    given = {"until": 1.0, "period": 0.1, "engine": "auto", "gain": 0.0, **other}
    if fmu.parent != folder:  # scenarios name files of their own folder
        fmu = Path(shutil.copy(fmu, folder))
    path = folder / "one.toml"
    path.write_text(
        ONE.format(fmu=fmu.name, inputs=inputs, outputs=outputs, more=more, **given),
        encoding="utf-8",
    )
    return str(path)
