"""The C sources of an FMU: the common wrapper, the model's own code and the generated tables."""

from __future__ import annotations

import hashlib
import json
import uuid
from pathlib import Path
from typing import Literal

from posmas_fmi.fmu.model import FmuModel

FmiVersion = Literal[2, 3]

_CSRC = Path(__file__).parent / "csrc"
_COMMON = ("model.h", "instance.h", "instance.c", "advance.h", "export.h")


def sources(model: FmuModel, fmi: FmiVersion) -> dict[str, str]:
    """Return every source file of the FMU by name, sorted.

    Examples
    --------
    >>> from posmas_fmi.expression import VectorFunction
    >>> from posmas_fmi.fmu.positive_agent import positive_agent
    >>> g = VectorFunction.parse(["x1"], ["t", "x1"])
    >>> files = sources(positive_agent(g, VectorFunction.parse(["u1"], ["u1"]), 1, 1, 1), 3)
    >>> compiled(files)
    ['fmi3.c', 'instance.c', 'model.c', 'model_table.c', 'solver.c']
    """
    own = _own(model, fmi)
    files = own | {
        "model_data.h": _data(model, instantiation_token(model, fmi)),
        "model_table.c": _table(model),
    }
    return dict(sorted(files.items()))


def compiled(files: dict[str, str]) -> list[str]:
    """Names of the files that are given to the compiler."""
    return [name for name in files if name.endswith(".c")]


def instantiation_token(model: FmuModel, fmi: FmiVersion) -> str:
    """Identify the model in its description and binary; a function of their content alone."""
    text = json.dumps(
        {
            "fmi": fmi,
            "name": model.name,
            "description": model.description,
            "variables": [
                [v.name, v.role, v.shape, v.start, v.unit, v.description, v.nominal, v.depends]
                for v in model.table
            ],
            "experiment": [
                model.experiment.stop,
                model.experiment.step,
                model.experiment.tolerance,
            ],
            "period": model.period,
            "sources": sorted(_own(model, fmi).items()),
        }
    )
    digest = hashlib.sha256(text.encode()).digest()
    return f"{{{uuid.UUID(bytes=digest[:16], version=4)}}}"


def _own(model: FmuModel, fmi: FmiVersion) -> dict[str, str]:
    inside = "sampled.c" if model.sampled else "solver.c"
    names = (*_COMMON, inside, f"fmi{fmi}.h", f"fmi{fmi}.c")
    return {name: (_CSRC / name).read_text(encoding="utf-8") for name in names} | dict(model.code)


def _data(model: FmuModel, token: str) -> str:
    return f"""\
/* Identity and sizes of the model; generated. */
#ifndef MODEL_DATA_H
#define MODEL_DATA_H

#define MODEL_TOKEN "{token}"
#define MODEL_NP {model.count("parameter")}
#define MODEL_NU {model.count("input")}
#define MODEL_NX {model.count("state", "memory")}
#define MODEL_NM {model.count("memory")}
#define MODEL_SAMPLED {int(model.sampled)}
#define MODEL_PERIOD {model.period or 0.0!r}
#define MODEL_NY {model.count("output", "local")}

#endif
"""


def _table(model: FmuModel) -> str:
    start, size, names, nominal = ["0.0"], ["1"], ['"time"'], []
    for variable in model.table:
        start += [repr(value) for value in variable.start] or ["0.0"] * variable.size
        size += [str(variable.size)] + ["0"] * (variable.size - 1)
        names += [f'"{element}"' for element in variable.elements]
        if variable.role in ("state", "memory"):
            nominal += [repr(variable.nominal)] * variable.size
    return "\n\n".join(
        [
            "/* The table of values that model.h describes; generated. */",
            '#include "model.h"',
            _array("const double model_start[MODEL_NV]", start),
            _array("const uint32_t model_size[MODEL_NV]", size),
            _array("const char *const model_name[MODEL_NV]", names),
            _array("const double model_nominal[MODEL_NX_ROOM]", nominal or ["1.0"]),
            "",
        ]
    )


def _array(head: str, values: list[str]) -> str:
    lines, line = [], "   "
    for value in values:
        if len(line) + len(value) > 96:
            lines.append(line)
            line = "   "
        line += f" {value},"
    return "\n".join([f"{head} = {{", *lines, line, "};"])
