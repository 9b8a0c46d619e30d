"""The plants that ship: `plant_fmus/<name>/model.toml`, and `model.c` where there is one."""

from __future__ import annotations

import tomllib
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from posmas_fmi.errors import BuildError, ExpressionError
from posmas_fmi.expression import VectorFunction
from posmas_fmi.fmu.model import Experiment, FmuModel, Variable
from posmas_fmi.fmu.positive_agent import positive_agent
from posmas_fmi.resources import shipped


def shipped_plants() -> dict[str, Path]:
    """Return the folder of each plant that ships, by name.

    Examples
    --------
    >>> "positive_agent" in shipped_plants()
    True
    """
    files = sorted(shipped("plant_fmus").glob("*/model.toml"))
    return {file.parent.name: file.parent for file in files}


def read_plant(folder: Path) -> FmuModel:
    """Read a plant.

    Parameters
    ----------
    folder : Path
        With a ``model.toml`` that holds ``name``, optionally ``description`` and ``[experiment]``
        (``stop``, ``step`` [s], ``tolerance``), and either

        - ``[agent]``, from which model (1) is generated: A, H, B, C, g, sec, x; or
        - ``[[variable]]`` tables with the attributes of `posmas_fmi.fmu.model.Variable`; then the C
          files in the folder define the functions of ``csrc/model.h``, parameters, inputs, states
          and outputs in the order of the tables. A ``unit`` is one that
          `posmas_fmi.fmu.units.parse_unit` reads.

    Raises
    ------
    BuildError
        If the file cannot be read, has an unknown or missing key, or a value that does not fit.
    """
    file = folder / "model.toml"
    try:
        content = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise BuildError(f"cannot read the plant: {error}", str(file)) from error
    _known_keys(content, {"name", "description", "agent", "variable", "experiment"}, f"{file}: $")
    _known_keys(
        content.get("experiment", {}), {"stop", "step", "tolerance"}, f"{file}: $.experiment"
    )
    try:
        experiment = Experiment(**content.get("experiment", {}))
        if "agent" in content:
            return _agent(content["agent"], content["name"], experiment, f"{file}: $.agent")
        return FmuModel(
            content["name"],
            content.get("description", ""),
            tuple(_variable(entry, f"{file}: $.variable") for entry in content["variable"]),
            {c.name: c.read_text(encoding="utf-8") for c in sorted(folder.glob("*.[ch]"))},
            experiment,
        )
    except KeyError as error:
        raise BuildError(f"expected the key {error}", str(file)) from error
    except (TypeError, ValueError, IndexError) as error:
        raise BuildError(f"a value does not fit: {error}", str(file)) from error


def agent_functions(
    agent: Mapping[str, Any], where: str
) -> tuple[VectorFunction, VectorFunction, int, int, int]:
    """Return g, sec, m, p, q of an ``[agent]`` section.

    Raises
    ------
    BuildError
        If A, B, C, g or sec are missing or are no matrices and lists of text.
    """
    try:
        m, p, q = len(agent["A"]), len(agent["B"][0]), len(agent["C"])
        g = VectorFunction.parse(agent["g"], ["t", *(f"x{k + 1}" for k in range(m))], f"{where}.g")
        sec = VectorFunction.parse(agent["sec"], [f"u{k + 1}" for k in range(p)], f"{where}.sec")
    except (KeyError, TypeError, IndexError) as error:
        raise BuildError(f"expected A, B, C, g and sec ({error!r})", where) from error
    except ExpressionError as error:
        raise BuildError(error.message, error.where) from error
    return g, sec, m, p, q


def _agent(agent: Mapping[str, Any], name: str, experiment: Experiment, where: str) -> FmuModel:
    _known_keys(agent, {"A", "H", "B", "C", "g", "sec", "x"}, where)
    start: dict[str, Sequence[float]] = {
        key: [value for row in agent[key] for value in row] for key in "AHBC"
    }
    start["x"] = agent["x"]
    return positive_agent(
        *agent_functions(agent, where), start=start, experiment=experiment, name=name
    )


def _variable(entry: Mapping[str, Any], where: str) -> Variable:
    where = f"{where}[{entry.get('name')!r}]"
    known = {"name", "role", "shape", "start", "unit", "description", "nominal", "depends"}
    _known_keys(entry, known, where)
    values = dict(entry)
    for key in ("shape", "start", "depends"):
        if key in values:
            value = values[key]
            values[key] = tuple(value) if isinstance(value, list) else (float(value),)
    if "start" in values:
        values["start"] = tuple(float(value) for value in values["start"])
    return Variable(**values)


def _known_keys(section: Mapping[str, Any], known: Collection[str], where: str) -> None:
    unknown = sorted(set(section) - set(known))
    if unknown:
        raise BuildError(f"unknown key {unknown[0]!r}; known: {', '.join(sorted(known))}", where)
